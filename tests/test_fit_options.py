"""Options are said once, in signatures and docstrings: what help, manifests and completion make of them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from typing import TYPE_CHECKING, Annotated

import pytest

import imulab as il
from imulab.cli import app, main
from imulab.errors import OptionError
from imulab.options import PROGRAM, choice, either, file, measure, options_of, read_options
from imulab.procedures.registry import PROCEDURES

if TYPE_CHECKING:
    from collections.abc import Callable

COMMANDS = {command.path: command for command in app.commands()}
CASES = [(name, option) for name, entry in PROCEDURES.items() for option in entry.task.options]


@pytest.mark.parametrize(("name", "option"), CASES, ids=lambda case: getattr(case, "name", case))
def test_every_word_offered_is_taken_and_others_are_refused_by_name(name, option):
    for word in option.words:
        read_options([option], {option.name: word}, "column {}")
    if option.words and not option.reads.other:
        with pytest.raises(OptionError, match=f"column {option.name} 'nonsense': expected"):
            read_options([option], {option.name: "nonsense"}, "column {}")


@pytest.mark.parametrize("path", COMMANDS)
def test_the_help_of_a_command_has_a_sentence_on_every_option(path, capsys):
    assert main([*path.split(), "--help-all"], project=False) == 0
    shown = " ".join(capsys.readouterr().out.split())
    for option in COMMANDS[path].options:
        assert option.help.endswith("."), option.keyword
        assert " ".join(f"{option.spelling} {option.help}".split()) in shown
        assert f"default: {option.default}" in shown or option.default is None or not option.takes_value
    assert not re.search(r"<str>|<float>|``|Annotated|imulab\.options", shown)


def function(
    data: object,
    *,
    angle: Annotated[float | str | None, measure("angle", "deg")] = None,
    method: Annotated[str, choice(("one", "two"))] = "one",
    count: int | str = 3,
    share: float | str = 0.5,
    record: Annotated[str | None, file("RECORD")] = None,
    hidden: Annotated[str | None, PROGRAM] = None,
    upright: Annotated[bool | None, either("lying")] = None,
    with_: bool = False,
    progress: Callable[[int], None] | None = None,
) -> None:
    """Stand for a public function.

    Parameters
    ----------
    angle
        Angle of the table. In rad.
    method
        ``one`` or ``"two"``. What else there is to say.
    count, share
        How many e.g. 3 of them.
    record
        As for `fit_tumble`. No: `prior` is there.
    upright
        Whether it stands.
    with_
        A switch.
    """


def test_options_are_what_a_signature_and_its_docstring_say():
    options = {option.name: option for option in options_of(function)}
    assert [*options] == ["angle", "method", "count", "share", "record", "upright", "with"]
    assert {name: option.default for name, option in options.items()} == {
        "angle": None, "method": "one", "count": "3", "share": "0.5", "record": None, "upright": None, "with": "no",
    }  # fmt: skip
    assert {name: option.kind for name, option in options.items() if option.kind != "text"} == {
        "upright": "either",
        "with": "switch",
    }
    assert options["angle"].unit == "deg"
    assert options["angle"].help == "Angle of the table."
    assert options["method"].help == "one or two."
    assert options["share"].help == "How many e.g. 3 of them."
    assert options["upright"].spelling == "--upright / --lying"
    assert read_options([*options.values()], {"angle": "180", "count": "7", "with": "yes"}, "{}") == {
        "angle": pytest.approx(3.14159265), "method": "one", "count": 7, "share": 0.5, "record": None, "upright": None,
        "with": True,
    }  # fmt: skip
    with pytest.raises(OptionError, match="--count 'many': expected a whole number"):
        read_options([options["count"]], {"count": "many"}, "--{}")


def test_help_is_the_same_without_docstrings():
    words = ["-m", "imulab", "thermal", "check", "--help-all"]
    shown = [subprocess.run([sys.executable, *how, *words], capture_output=True, text=True) for how in ([], ["-OO"])]
    assert shown[0].stdout == shown[1].stdout
    assert "How far a hold tips while it warms or cools." in " ".join(shown[1].stdout.split())
    group = [subprocess.run([sys.executable, *how, "-m", "imulab", "tumble"], capture_output=True, text=True)
             for how in ([], ["-OO"])]  # fmt: skip
    assert group[0].stdout == group[1].stdout


def test_a_command_does_not_import_what_other_commands_have(tmp_path):
    il.write(il.simulate_tumble(attitudes=12, order=1, hold="2 s"), tmp_path / "r.csv")
    code = (
        "import sys; from imulab.cli import main; main(['tumble', 'fit', 'r.csv', '--gravity', '9.81', '-q']);"
        "print(sorted(m for m in sys.modules if m.startswith('imulab.procedures.') and m.split('.')[2] in "
        "('thermal', 'rate', 'warmup', 'noise', 'centrifuge', 'gyro_array') and m.split('.')[3:] == ['fit']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, env=os.environ)
    assert done.stdout.splitlines()[-1] == "[]"

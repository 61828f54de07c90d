"""One definition of a fit's options: what commands, manifests and the functions of Python take agrees with it."""

from __future__ import annotations

import inspect

import pytest
import typer

import imulab as il
from imulab.cli import app
from imulab.errors import OptionError
from imulab.procedures.procedure import read_options
from imulab.procedures.registry import PROCEDURES

COMMANDS = {
    "tumble": "tumble fit",
    "array": "array calibrate",
    "warmup": "warmup fit",
    "centrifuge": "centrifuge reduce",
    "noise": "noise fit",
    "thermal": "thermal fit",
    "rate": "rate fit",
}
FUNCTIONS = {
    "tumble": il.fit_tumble,
    "array": il.calibrate_array,
    "warmup": il.fit_warmup,
    "centrifuge": il.fit_centrifuge,
    "noise": il.fit_noise,
    "thermal": il.fit_thermal,
    "rate": il.fit_rate,
}
OF_FILES = ("layout", "topic", "instance", "window", "element", "interval", "method", "memory")
"""Options that say how files are read, what is taken of their heads, and what a record carries along."""
CASES = [(name, option) for name, entry in PROCEDURES.items() for option in entry.task.options]


def command_of(path):
    found = app.command()
    for name in path.split():
        found = found.commands[name]
    return found


@pytest.mark.parametrize(("name", "option"), CASES, ids=lambda case: getattr(case, "name", case))
def test_a_command_has_the_option_as_defined(name, option):
    (parameter,) = [p for p in command_of(COMMANDS[name]).params if option.flag in p.opts]
    assert parameter.help == option.help
    assert parameter.is_flag == option.switch
    if not option.switch:
        assert parameter.default == option.default
        assert parameter.metavar == option.shows


@pytest.mark.parametrize(("name", "option"), CASES, ids=lambda case: getattr(case, "name", case))
def test_the_function_has_the_same_default(name, option):
    parameter = inspect.signature(FUNCTIONS[name]).parameters.get(option.keyword)
    if parameter is None:
        assert option.name in OF_FILES
        return
    found = PROCEDURES[name].task.values({}, "--{}")[option.name]
    default = parameter.default
    if isinstance(default, str) and not isinstance(found, str):
        default = option.read(default, option.name)
    assert found == (list(default) if isinstance(found, list) else default)


@pytest.mark.parametrize(("name", "option"), CASES, ids=lambda case: getattr(case, "name", case))
def test_every_word_offered_is_taken_and_others_are_refused_by_name(name, option):
    for word in option.choices:
        read_options([option], {option.name: word}, "column {}")
    if option.choices and option.shows == "|".join(option.choices):
        with pytest.raises(OptionError, match=f"column {option.name} 'nonsense': expected"):
            read_options([option], {option.name: "nonsense"}, "column {}")


def test_no_help_shows_the_name_of_a_type():
    def walk(group):
        for command in group.commands.values():
            if hasattr(command, "commands"):
                walk(command)
            else:
                text = command.get_help(typer.Context(command))
                assert "<str>" not in text
                assert "<float>" not in text

    walk(app.command())

"""What the documentation shows is run: marked blocks of pages, in order, in an empty folder; examples in docstrings."""

import doctest
import re
import runpy
import shlex
import shutil
import subprocess
from decimal import Decimal
from pathlib import Path

import pytest

import imulab
import madeup
from imulab.cli import main

REPOSITORY = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"<!-- tested -->\n+```(\w*)\n(.*?)```", re.DOTALL)
# A block that is run; another one; a heading, below which nothing is output of the blocks above; an indented block.
STEP = re.compile(
    r"<!-- tested -->\n+```(?P<language>\w*)\n(?P<code>.*?)^```|^```.*?^```|^(?P<heading>#+ )|"
    r"(?<=\n\n)(?P<shown>(?: {4}[^\n]*\n)(?:\n* {4}[^\n]*\n)*)",
    re.DOTALL | re.MULTILINE,
)
TYPED = re.compile(r"^ {4}\$ (.*)\n", re.MULTILINE)
VERDICT = re.compile(r" *(good|look|bad|pass|fail): ")
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
PUBLIC = sorted(set(imulab.__all__) - {"__version__"})
README = REPOSITORY / "README.md"
FOLDER = sorted((REPOSITORY / "docs").glob("*.md"))


def _steps(page: Path) -> list[tuple[str, str]]:
    """Return what `page` has run ("python", "sh", "typed") and says is printed ("shown"), in order.

    What is typed stands in an indented block, a line `$ COMMAND` and below it what that prints, whatever its status."""
    steps, ran = [], False
    for block in STEP.finditer(page.read_text(encoding="utf-8")):
        language, code, heading, shown = block.group("language", "code", "heading", "shown")
        if code is not None:
            steps.append(("python", code) if language == "python" else ("sh", code.replace("\\\n", " ")))
            ran = True
        elif heading:
            ran = False
        elif shown and TYPED.match(shown):
            kinds = ("shown", "typed")
            steps += [(kinds[i % 2], text) for i, text in enumerate(TYPED.split(shown)) if text]
        elif shown and ran and not re.match(r" {4}imulab [a-z]+ ", shown):
            steps.append(("shown", shown))
    return steps


PAGES = [page for page in (README, *FOLDER) if _steps(page)]

# Of what a page shows, the part that the reduced run makes.
SHORTER = {"imulab array compare --experiment static": " --seeds 2"}


def _expanded(word: str) -> list[str]:
    """Return the files that a pattern names, as a shell has it; the word where it is none."""
    return sorted(str(path) for path in Path().glob(word)) if "*" in word else [word]


def _run(command: str, capsys) -> tuple[int, str]:
    """Return exit status and output of `command`, of imulab or make, or nothing of a line without one."""
    words = [name for word in shlex.split(command, comments=True) for name in _expanded(word)]
    if not words:
        return 0, ""
    assert words[0] in ("imulab", "make"), command
    if words[0] == "imulab":
        return main(words[1:]), "".join(capsys.readouterr())
    done = subprocess.run(words, capture_output=True, text=True, timeout=300)
    return done.returncode, done.stdout + done.stderr


def _same_word(shown: str, printed: str) -> bool:
    """Return whether words are equal. Numbers may differ by one of the last digit shown, as machines differ in it."""
    if shown == printed or not (NUMBER.fullmatch(shown) and NUMBER.fullmatch(printed)):
        return shown == printed
    value = Decimal(shown)
    last = Decimal(1).scaleb(int(value.as_tuple().exponent))
    return abs(value - Decimal(printed)) <= last and (last < 1 or abs(value) >= 1000)


def _not_printed(shown: str, printed: str) -> list[str]:
    """Return the parts of `shown`, which "..." separates, that do not stand in `printed` one after the other."""
    parts = [NUMBER.sub(r" \g<0> ", part).split() for part in shown.split("...")]
    words, at, missing = NUMBER.sub(r" \g<0> ", printed).split(), 0, []
    for part in filter(None, parts):
        places = range(at, len(words) - len(part) + 1)
        place = next((i for i in places if all(map(_same_word, part, words[i : i + len(part)]))), None)
        if place is None:
            missing.append(" ".join(part))
        else:
            at = place + len(part)
    return missing


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_what_a_page_shows_runs_and_is_what_it_prints(page, tmp_path, monkeypatch, capsys, reduced):
    monkeypatch.chdir(tmp_path)
    printed, stale = "", []
    for kind, text in _steps(page):
        if kind == "shown":
            stale += _not_printed(text, printed)
            printed = ""
        elif kind == "python":
            (tmp_path / "example.py").write_text(text, encoding="utf-8")
            runpy.run_path("example.py")
            printed += capsys.readouterr().out
        else:
            for line in text.splitlines():
                status, output = _run(line + (SHORTER.get(line.strip(), "") if reduced else ""), capsys)
                assert status == 0 or kind == "typed", f"{page.name}: {line}\n{output}"
                printed += output
    assert stale == [], f"{page.name} shows what is not printed"


@pytest.mark.parametrize("page", [README, *FOLDER], ids=lambda page: page.stem)
def test_a_command_stands_in_a_block(page):
    prose = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    assert re.findall(r"^imulab .* -+\w.*", prose, re.MULTILINE) == []


@pytest.mark.parametrize("page", [README, *FOLDER], ids=lambda page: page.stem)
def test_a_verdict_that_a_page_shows_is_of_a_run_above_it(page):
    blocks = STEP.finditer(page.read_text(encoding="utf-8"))
    verdicts = [block["shown"] for block in blocks if VERDICT.match(block["shown"] or "")]
    assert [block for block in verdicts if ("shown", block) not in _steps(page)] == []


@pytest.mark.parametrize(
    ("shown", "stale"),
    [("u 0.035 mg", False), ("u 0.036 mg", False), ("u 0.04\n", False), ("u 0.071 mg", True), ("u ...\n  end", False)],
)
def test_a_figure_that_is_not_printed_is_seen(shown, stale):
    assert bool(_not_printed(shown, "  u   0.035  mg\nthe end")) is stale


def test_five_lines_lead_from_a_data_frame_to_a_record_and_a_picture(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (text,) = (text for language, text in BLOCK.findall(README.read_text(encoding="utf-8")) if language == "python")
    assert len([line for line in text.splitlines() if line]) == 5
    imulab.simulate_tumble(gravity=9.81362).to_frame("pandas").to_csv("recording.csv", index=False)
    (tmp_path / "example.py").write_text(text, encoding="utf-8")
    runpy.run_path("example.py")
    assert len(imulab.load("sn42.json").parameters) >= 9
    assert "Residual |f| \u2212 g of each attitude" in (tmp_path / "residuals.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_sessions_and_the_fit_of_the_readme_end_in_good(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    commands = re.findall(r"^ *(imulab (?:live|tumble) .*)$", README.read_text(encoding="utf-8"), re.MULTILINE)
    for command in commands:
        assert main(shlex.split(command.replace("speed=5", "speed=0"))[1:]) == 0
    records = [imulab.load(name) for name in ("sn42.json", "live.json")]
    assert [record.verdict.state for record in records] == ["good", "good"]


def test_the_files_that_contributing_names_are_there():
    page = (REPOSITORY / "CONTRIBUTING.md").read_text(encoding="utf-8")
    named = re.findall(r"`((?:src|tests|docs|runtime)/[a-z_/.]+)`", page)
    assert len(named) > 25
    assert [name for name in named if not (REPOSITORY / name).exists()] == []


@pytest.mark.parametrize(
    "page",
    ["tumble", "gyro_array", "warmup", "centrifuge", "noise", "thermal", "rate", "magnetometer_alone", "whole_arrays"],
)
def test_every_procedure_has_a_worked_example(page):
    assert page in [found.stem for found in PAGES]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "check_noise")) for name in PUBLIC]
)
def test_the_example_of_a_public_name_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (example,) = doctest.DocTestFinder(recurse=False).find(getattr(imulab, name), name)
    assert example.examples
    assert doctest.DocTestRunner().run(example).failed == 0


def test_the_page_on_python_describes_every_public_name():
    page = (REPOSITORY / "docs" / "python.md").read_text(encoding="utf-8")
    described = re.findall(r"^\.\. auto\w+:: imulab\.(\w+)$", page, re.MULTILINE)
    assert sorted(described) == PUBLIC


@pytest.mark.parametrize("name", PUBLIC)
def test_magnitudes_in_docstrings_are_literals(name):
    """Between bars and outside backquotes, reStructuredText looks for a substitution, and the pages are not built."""
    text = re.sub(r"``.*?``|`.*?`|^ *(>>>|\.\.\.) .*$", "", getattr(imulab, name).__doc__ or "", flags=re.DOTALL)
    assert not re.search(r"\|\w[^|\n]*\|", text)


@pytest.mark.parametrize(("language", "compiler"), [("c", "cc"), ("cpp", "c++")])
def test_the_code_for_firmware_compiles(language, compiler, tmp_path):
    if shutil.which(compiler) is None:
        pytest.skip(f"no {compiler}")
    imulab.export("c", madeup.tumble(), tmp_path)
    page = (REPOSITORY / "docs" / "runtime.md").read_text(encoding="utf-8")
    (code,) = re.findall(rf"```{language}\n(.*?)```", page, re.DOTALL)
    source = tmp_path / f"shown.{language}"
    source.write_text(code, encoding="utf-8")
    flags = ["-Wall", "-Wextra", "-Werror", f"-I{tmp_path}", "-fsyntax-only"]
    subprocess.run([compiler, *flags, source], check=True, timeout=60)

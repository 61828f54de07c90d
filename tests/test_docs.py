"""What the documentation shows is run: marked blocks of pages, in order, in an empty folder; examples in docstrings."""

import doctest
import re
import runpy
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

import imulab
import madeup
from imulab.cli import main

REPOSITORY = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"<!-- tested -->\n+```(\w*)\n(.*?)```", re.DOTALL)
PUBLIC = sorted(set(imulab.__all__) - {"__version__"})
README = REPOSITORY / "README.md"
FOLDER = sorted((REPOSITORY / "docs").glob("*.md"))
PAGES = [page for page in (README, *FOLDER) if BLOCK.search(page.read_text(encoding="utf-8"))]


# Of what a page shows, the part that the reduced run makes.
SHORTER = {"imulab array compare --experiment static": ["--seeds", "2"]}


def _expanded(word: str) -> list[str]:
    """Return the files that a pattern names, as a shell has it; the word where it is none."""
    return sorted(str(path) for path in Path().glob(word)) if "*" in word else [word]


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_what_a_page_shows_runs(page, tmp_path, monkeypatch, capsys, reduced):
    monkeypatch.chdir(tmp_path)
    for language, text in BLOCK.findall(page.read_text(encoding="utf-8")):
        if language == "python":
            (tmp_path / "example.py").write_text(text, encoding="utf-8")
            runpy.run_path("example.py")
            continue
        for line in text.replace("\\\n", " ").splitlines():
            words = [name for word in shlex.split(line, comments=True) for name in _expanded(word)]
            if not words:
                continue
            assert words[0] in ("imulab", "make"), line
            if words[0] == "imulab":
                words += SHORTER.get(line.strip(), []) if reduced else []
                assert main(words[1:]) == 0, f"{page.name}: {line}\n{capsys.readouterr().err}"
                continue
            done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=300)
            assert done.returncode == 0, f"{page.name}: {line}\n{done.stderr}"


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


def test_the_quickstart_shows_what_its_fit_prints(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    page = (REPOSITORY / "docs" / "quickstart.md").read_text(encoding="utf-8")
    simulate, fit = re.findall(r"^(imulab tumble .*)$", page, re.MULTILINE)
    assert main(shlex.split(simulate)[1:]) == main(shlex.split(fit)[1:]) == 0
    printed = capsys.readouterr().out.splitlines()
    shown = page[page.index("    good: ") : page.index("The simulated unit knows")].splitlines()
    assert [line.strip() for line in shown if line.strip() not in (*map(str.strip, printed), "...")] == []


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

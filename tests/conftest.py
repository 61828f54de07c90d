"""Fixtures: real recordings where they are, a browser where there is one, and the command line."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import hypothesis
import numpy as np
import pytest

import madeup
from benchpage import PATIENCE, Workbench
from imulab.cli import main
from imulab.exporters import export
from imulab.recording import Array, Recording

REPOSITORY = Path(__file__).resolve().parents[1]

# What the make that runs these tests was told is not meant for the makefiles of exported units.
for flags in ("MAKEFLAGS", "MFLAGS", "MAKELEVEL"):
    os.environ.pop(flags, None)


# Kills, ports, terminals, full disks and bounds of memory are tried as Linux has them.
collect_ignore = [] if sys.platform == "linux" else [
    "test_fleet_engine.py", "test_fleet_history.py", "test_fleet_run.py", "test_front_nonsense.py",
    "test_live_late.py", "test_live_link.py", "test_live_page_guided.py", "test_live_process.py",
    "test_live_terminal.py", "test_live_wrong.py", "test_readers_formats.py",
]  # fmt: skip


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--reduced", action="store_true", help="fewer trials in the statistical tests, fewer seeds in all")


def pytest_configure(config: pytest.Config) -> None:
    """Draw fewer examples in the reduced run, where a test does not say how many; they are others in each run."""
    hypothesis.settings.register_profile("reduced", max_examples=25)
    if config.getoption("--reduced"):
        hypothesis.settings.load_profile("reduced")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the further seeds in the reduced run. What drives a browser is among the long tests."""
    for item in items:
        if "browser" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.slow)
    if config.getoption("--reduced"):
        further = [item for item in items if item.get_closest_marker("further")]
        config.hook.pytest_deselected(items=further)
        items[:] = [item for item in items if not item.get_closest_marker("further")]


def pytest_sessionstart(session: pytest.Session) -> None:
    """Import the tests, each worker from another place on: what one has compiled the others find compiled.

    Of a fresh checkout the rewriting of assertions takes longer than all imports, and workers that go through the
    files together would each do it all.
    """
    config, worker = session.config, os.environ.get("PYTEST_XDIST_WORKER", "")
    if worker and config.args == config.getini("testpaths"):
        names = sorted(path.stem for path in Path(__file__).parent.glob("test_*.py"))
        begin = int(worker.removeprefix("gw")) * len(names) // int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
        for name in names[begin:] + names[:begin]:
            with contextlib.suppress(Exception, pytest.skip.Exception):  # the collection reports it
                importlib.import_module(name)


def some_of(quick: int, values: Sequence[Any]) -> list[Any]:
    """Values of a parameter that differ by chance alone: the first few are in every run, the others in the full one."""
    tuples = (value if isinstance(value, tuple) else (value,) for value in values[quick:])
    return [*values[:quick], *(pytest.param(*each, marks=pytest.mark.further) for each in tuples)]


@pytest.fixture(scope="session")
def reduced(request: pytest.FixtureRequest) -> bool:
    return bool(request.config.getoption("--reduced"))


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], object]], Path]:
    """A function that returns the folder of a name; the first process of the run that asks for it fills it."""
    common = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        common = common.parent

    def folder_of(name: str, fill: Callable[[Path], object]) -> Path:
        folder, filled, failed = (common / f"{name}{ending}" for ending in ("", ".filled", ".failed"))
        try:
            folder.mkdir()
        except FileExistsError:  # somebody fills it, or has
            while not filled.exists():
                assert not failed.exists(), f"another process could not make {name}"
                time.sleep(0.05)
            return folder
        try:
            fill(folder)
        except BaseException:
            failed.touch()
            raise
        filled.touch()
        return folder

    return folder_of


# As the Makefile of an exported unit compiles, and every warning an error.
WARN = ["-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Werror"]
STRICT = ["-std=c99", "-ffp-contract=off", *WARN]


@pytest.fixture(scope="session")
def compiler() -> str:
    path = shutil.which("cc")
    if path is None:
        pytest.skip("no C compiler (cc) on this machine")
    return path


@pytest.fixture(scope="session")
def core(compiler: str, made_once: Callable[..., Path]) -> Path:
    """Folder of the exported core, which is the same for every unit: its sources, double.o and float.o."""

    def fill(folder: Path) -> None:
        export("c", [madeup.tumble(1)], folder)
        for real in ("double", "float"):
            command = [compiler, "-O2", *STRICT, f"-DIMULAB_REAL={real}", "-c", folder / "imulab.c"]
            subprocess.run([*command, "-o", folder / f"{real}.o"], check=True)

    return made_once("core", fill)


@pytest.fixture(scope="session")
def self_test(compiler: str, core: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """A function that builds and runs the self-test of an exported unit, with the core that is compiled once."""

    def run(folder: Path, real: str = "double") -> subprocess.CompletedProcess[str]:
        for name in ("imulab.c", "imulab.h"):
            assert (folder / name).read_bytes() == (core / name).read_bytes()
        files = [core / f"{real}.o", folder / "unit.c", folder / "selftest.c"]
        program = folder / f"selftest-{real}"
        command = [compiler, *STRICT, f"-DIMULAB_REAL={real}", f"-I{folder}", *files, "-o", program, "-lm"]
        subprocess.run(command, check=True)
        return subprocess.run([program], capture_output=True, text=True, check=False)

    return run


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real recordings: IMULAB_DATA, by default beside the checkout."""
    folder = Path(os.environ.get("IMULAB_DATA", REPOSITORY.parent / "shared" / "data"))
    if not (folder / "xsens_mti").is_dir():
        pytest.skip(f"real recordings are not here (IMULAB_DATA or {folder.name}/)")
    return folder


@pytest.fixture(scope="session")
def tools() -> None:
    for name in ("gcc", "g++"):
        if shutil.which(name) is None:
            pytest.skip(f"no {name} on this machine")


@pytest.fixture(scope="session")
def chromium() -> str:
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("no Chromium on this machine (Debian package chromium)")
    return path


@pytest.fixture(scope="session")
def browser(chromium: str) -> Iterator[Any]:
    """A real Chromium, driven by playwright."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="the browser tests need playwright")
    with sync_api.sync_playwright() as playwright:
        found = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        yield found
        found.close()


def _checked_function(text: str) -> str:
    assert "=>" in text, f"{text!r}: expected a function, which the policy of the page lets be called again"
    return text


@pytest.fixture
def new_page(browser: Any) -> Iterator[Callable[[str], Any]]:
    """A function that opens an address; at the end no page may have reported a fault, nor one of its policy.

    A test waits for a function, `() => ...`: a mere expression is evaluated anew in the page, which its policy forbids.
    """
    context = browser.new_context(viewport={"width": 1280, "height": 900}, accept_downloads=True)
    context.set_default_timeout(1000 * PATIENCE)
    faults: list[str] = []

    def opened(address: str) -> Any:
        page = context.new_page()
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("console", lambda said: faults.append(said.text) if "Content Security" in said.text else None)
        wait = page.wait_for_function
        page.wait_for_function = lambda function, **more: wait(_checked_function(function), **more)
        page.goto(address)
        return page

    yield opened
    context.close()
    assert not faults


@pytest.fixture
def workbench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Workbench]:
    """The workbench in an empty folder."""
    monkeypatch.chdir(tmp_path)
    running = Workbench()
    yield running
    running.close()


@pytest.fixture
def noise_as_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take the stated noise of attitudes as exact, where a bound or an equality supposes that it is."""

    def none(residuals: Array, variance: Array, spare: Array) -> tuple[Array, Array]:
        return np.zeros(len(residuals)), np.full(len(residuals), np.inf)

    for room in ("solve", "prior"):
        monkeypatch.setattr(f"imulab.procedures.tumble.{room}.plausible_excess", none)


Run = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def imulab(tmp_path: Path) -> Run:
    """Run the command line in an empty folder, within this process: starting Python takes longer than most commands."""

    def run(*arguments: object) -> subprocess.CompletedProcess[str]:
        words = list(map(str, arguments))
        streams = [io.TextIOWrapper(io.BytesIO(), encoding="utf-8", newline="") for _ in range(2)]
        with (
            contextlib.chdir(tmp_path),
            Path(os.devnull).open() as nothing,
            mock.patch.multiple(sys, argv=["imulab", *words], stdin=nothing, stdout=streams[0], stderr=streams[1]),
        ):
            status = main(words)
        said = []
        for stream in streams:
            stream.flush()
            said.append(stream.buffer.getvalue().decode())
        return subprocess.CompletedProcess(words, status, *said)

    return run


@pytest.fixture
def imulab_process(tmp_path: Path) -> Run:
    """Run the command line in a process of its own, in an empty folder."""

    def run(*arguments: object, stdin: str | None = None) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "imulab", *map(str, arguments)],
            cwd=tmp_path,
            input=stdin,
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
        )

    return run


def table(outputs: np.ndarray, unit: str = "m/s^2", sigma: float | np.ndarray | None = None) -> Recording:
    """A table of attitudes as a recording."""
    columns = {f"accel_{axis}": outputs[:, i].copy() for i, axis in enumerate("xyz")}
    units = dict.fromkeys(columns, unit)
    if sigma is not None:
        stated = np.broadcast_to(sigma, outputs.shape)
        columns |= {f"std_accel_{axis}": stated[:, i].copy() for i, axis in enumerate("xyz")}
        units |= {f"std_accel_{axis}": unit for axis in "xyz"}
    return Recording(columns=columns, units=units, name="table.csv", lines_before=1)


def sap5_table(path: Path) -> np.ndarray:
    """Attitudes of a cave-survey instrument, g, shape (n, 3): a flat list with null and NaN in unused slots."""
    flat = [value for value in json.loads(path.read_text())["shots"]["grav"] if value is not None and value == value]
    return np.array(flat).reshape(-1, 3)


@pytest.fixture(scope="session")
def accessibility() -> Callable[[Any], list[str]]:
    """A function that returns the violations that axe-core finds on a page, in light, and of colours in dark."""
    module = pytest.importorskip("axe_playwright_python", reason="the tests of accessibility need axe-core")
    script = (Path(module.__path__[0]) / "axe.min.js").read_text(encoding="utf-8")

    def violations(page: Any) -> list[str]:
        page.evaluate(script)
        found = []
        for scheme, rules in (("light", None), ("dark", ["color-contrast", "link-in-text-block"])):
            page.emulate_media(color_scheme=scheme)
            options = {"iframes": False, "resultTypes": ["violations"]} | ({"runOnly": rules} if rules else {})
            each = page.evaluate("options => axe.run(document, options).then(told => told.violations)", options)
            found += [f"{scheme}: {rule['id']}: {node['html'][:200]}" for rule in each for node in rule["nodes"]]
        return found

    return violations

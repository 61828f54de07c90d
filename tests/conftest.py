"""Fixtures: real recordings where they are, a browser where there is one, and the command line."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

from imulab.cli import main
from imulab.recording import Array, Recording

REPOSITORY = Path(__file__).resolve().parents[1]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--reduced", action="store_true", help="fewer trials in the statistical tests")


@pytest.fixture(scope="session")
def reduced(request: pytest.FixtureRequest) -> bool:
    return bool(request.config.getoption("--reduced"))


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real recordings: IMULAB_DATA, by default beside the checkout."""
    folder = Path(os.environ.get("IMULAB_DATA", REPOSITORY.parent / "shared" / "data"))
    if not (folder / "xsens_mti").is_dir():
        pytest.skip(f"real recordings are not here (IMULAB_DATA or {folder.name}/)")
    return folder


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


@pytest.fixture
def new_page(browser: Any) -> Iterator[Callable[[str], Any]]:
    """A function that opens an address; at the end no page may have reported a fault, nor one of its policy."""
    context = browser.new_context(viewport={"width": 1280, "height": 900}, accept_downloads=True)
    context.set_default_timeout(60_000)
    faults: list[str] = []

    def opened(address: str) -> Any:
        page = context.new_page()
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("console", lambda said: faults.append(said.text) if "Content Security" in said.text else None)
        page.goto(address)
        return page

    yield opened
    context.close()
    assert not faults


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

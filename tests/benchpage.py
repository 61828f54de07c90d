"""`imulab open` as a process, and what a person does on its page."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import imulab as il

PATIENCE = 180
"""Seconds after which a test takes for hung what it waits for: no measure of speed, on the slowest machine either."""

DROP = """([name, text]) => {
  const data = new DataTransfer();
  data.items.add(new File([text], name));
  for (const kind of ["dragover", "drop"])
    document.body.dispatchEvent(new DragEvent(kind, { dataTransfer: data, bubbles: true, cancelable: true }));
}"""


class Workbench:
    """`imulab open` in a process of its own, in the working folder."""

    def __init__(self, *files: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", "imulab", "open", *files, "--no-browser"],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self.process.stdout is not None
        self.address = self.process.stdout.readline().strip()

    def close(self) -> None:
        self.process.terminate()
        self.process.communicate(timeout=PATIENCE)


def tumble(name: str, **more: Any) -> str:
    """Write a recording, and return its text."""
    il.write_csv(il.simulate_tumble(attitudes=12, hold="3 s", gravity=9.81, **more), name)
    return Path(name).read_text()


def drop(page: Any, name: str, text: str) -> None:
    """Drop a file on the page, as a mouse does."""
    page.locator(".drop").wait_for()
    page.evaluate(DROP, [name, text])


def read(page: Any) -> None:
    """Wait until a recording of attitudes is read to its end, and its plots are of all its rows."""
    page.get_by_text("attitudes at rest").wait_for()
    page.locator(".plots[aria-busy='false'] svg.plot").first.wait_for()


def command(page: Any) -> str:
    """Return the command line of the form, once it is that of the form's values."""
    page.locator(".form:not([data-asked])").wait_for()
    return page.locator(".form .command code").inner_text()


def await_request(page: Any, held: list[Any]) -> None:
    """Wait until the page has asked for what a test holds back."""
    ends = time.monotonic() + PATIENCE
    while not held:
        assert time.monotonic() < ends, "the page has not asked"
        page.wait_for_timeout(20)


def run(page: Any) -> None:
    page.get_by_role("button", name="Run", exact=True).click()

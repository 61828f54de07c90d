"""Draw the pictures of the page: screenshots of a session with a simulated unit, and of the workbench (needs Chromium).

python docs/make_page_figures.py
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, sync_playwright

import imulab as il

FIGURES = Path(__file__).resolve().parent / "figures"
UNIT = "simulate:speed=4,order=1,gravity=9.81,noise=0.2mg,knock=5,seed=3"
GOAL = ["--order", "1", "--gravity", "9.81+-0", "--attitudes", "14"]
SIZE = {"width": 1000, "height": 620}


@contextmanager
def page_of(browser: Browser, folder: Path, *words: str) -> Iterator[Any]:
    """The page of a command that runs in a folder."""
    command = [sys.executable, "-P", "-m", "imulab", *words, "--no-browser"]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        page = browser.new_page(viewport=SIZE)
        page.goto(process.stdout.readline().strip())
        try:
            yield page
        finally:
            page.close()
            process.terminate()


def session(browser: Browser, folder: Path) -> None:
    """Its states, in the order in which a person sees them."""

    def picture(name: str, height: int = SIZE["height"]) -> None:
        page.set_viewport_size(SIZE | {"height": height})
        page.screenshot(path=FIGURES / f"{name}.png")

    with page_of(
        browser, folder, "live", UNIT, "--follow", *GOAL, "--save", "rec.csv", "-o", "sn42.json", "--page"
    ) as page:
        page.locator(".sphere .held").nth(3).wait_for(state="attached")
        page.wait_for_selector(".now[data-state='moving']")
        picture("live", 960)
        page.wait_for_selector(".said.bad:has-text('Attitude 5')")
        picture("live_knocked", 400)
        page.locator(".said.bad button").click()
        page.wait_for_selector(".enough:not([hidden])")
        picture("live_enough", 320)
        page.get_by_role("button", name="Make the record").click()
        page.wait_for_selector(".result .facts dd:text-matches('^9')")
        picture("live_done", 520)


def workbench(browser: Browser, folder: Path) -> None:
    il.write_csv(il.simulate_tumble(attitudes=24, gravity=9.81, seed=3), folder / "sn43.csv")
    with page_of(browser, folder, "open", "sn43.csv") as page:
        page.set_viewport_size(SIZE | {"height": 640})
        page.get_by_text("24 attitudes at rest (shaded)").wait_for()
        page.locator("svg.plot").first.wait_for()
        page.wait_for_timeout(1000)  # the last curves
        page.screenshot(path=FIGURES / "workbench.png")
        page.get_by_role("button", name="Run", exact=True).click()
        page.locator(".found .js-plotly-plot .point").first.wait_for()
        page.wait_for_timeout(1000)
        page.set_viewport_size(SIZE | {"height": 760})
        page.screenshot(path=FIGURES / "workbench_result.png")
    rec = il.read(folder / "sn43.csv")
    sensors = [f"{sensor}_{axis}" for sensor in ("accel", "gyro") for axis in "xyz"]
    rows = zip(1000 * rec.time, *(rec.columns[name] for name in sensors), strict=True)
    lines = [";".join(f"{value:.7g}" for value in row) for row in rows]
    (folder / "logger.csv").write_text("\n".join(["t;p;q;r;u;v;w", *lines]) + "\n")
    with page_of(browser, folder, "open", "logger.csv") as page:
        page.locator(".assistant").wait_for()
        page.get_by_label("column 2, p: what it is").select_option("accel_x")
        page.get_by_label("column 2, p: its unit").select_option("m/s^2")
        page.locator("svg.plot").first.wait_for()
        page.wait_for_timeout(1500)
        page.set_viewport_size(SIZE | {"height": 700})
        page.screenshot(path=FIGURES / "workbench_columns.png")


def main() -> None:
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        raise SystemExit("make_page_figures: no Chromium here (Debian package chromium)")
    with tempfile.TemporaryDirectory() as name, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        session(browser, Path(name))
        workbench(browser, Path(name))
        browser.close()


if __name__ == "__main__":
    main()

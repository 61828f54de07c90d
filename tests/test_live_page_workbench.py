"""The workbench in a real Chromium, by what a person drops, clicks and types; the command line beside it."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("starlette", reason="the page needs imulab[live]")

import imulab as il
from imulab.cli import main

EVIL = "<img src=x onerror=document.title='taken'>"
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
        self.process.communicate(timeout=30)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def workbench(folder) -> Iterator[Workbench]:
    found = Workbench()
    yield found
    found.close()


def tumble(name: str, **more: Any) -> str:
    """Write a recording, and return its text."""
    il.write_csv(il.simulate_tumble(attitudes=12, hold="3 s", gravity=9.81, **more), name)
    return Path(name).read_text()


def saved(page: Any, name: str) -> Path:
    """Click what saves a file, and return where it lies."""
    with page.expect_download() as download:
        page.get_by_role("link", name=name, exact=True).first.click()
    return Path(download.value.path())


def unsealed(path: Path) -> list[bytes]:
    lines = path.read_bytes().splitlines()
    assert len(lines) > 100
    return [line for line in lines if b'"created"' not in line and b'"content_sha256"' not in line]


def drop(page: Any, name: str, text: str) -> None:
    """Drop a file on the page, as a mouse does."""
    page.locator(".drop").wait_for()
    page.evaluate(DROP, [name, text])


def command(page: Any) -> str:
    """Return the command line of the form, once it is that of the form's values."""
    page.wait_for_timeout(600)
    return page.locator(".form .command code").inner_text()


def test_from_the_drop_to_record_report_and_firmware(workbench, new_page, folder):
    text = tumble("own.csv")
    page = new_page(workbench.address)
    page.get_by_text("Drop recordings or records here").wait_for()
    drop(page, "unit 7.csv", text)
    page.get_by_text("12 attitudes at rest (shaded)").wait_for()
    page.locator("svg.plot").first.wait_for()
    assert page.locator("#workbench").get_attribute("role") == "region"  # one area alone is no tab
    assert page.locator("svg.plot").count() == 4
    assert page.locator("svg.plot >> nth=0 >> rect.attitude").count() == 12
    page.get_by_label("gravity", exact=True).fill("9.81")
    typed = command(page)
    assert typed == (
        "imulab tumble fit 'imulab-files/unit 7.csv' --gravity 9.81 -o 'imulab-files/unit 7.json' "
        "--report 'imulab-files/unit 7.html'"
    )
    page.get_by_role("button", name="Run").click()
    page.locator(".job .chip.done").wait_for()
    assert page.locator(".job .state.look").inner_text().startswith("look: ")  # 12 attitudes are few
    assert page.locator(".job .command code").inner_text() == typed
    report = page.frame_locator(".job iframe")
    report.get_by_role("heading", name="Tumble calibration").wait_for()
    report.locator(".js-plotly-plot").first.wait_for()
    record = saved(page, "Save unit 7.json")
    assert main([*shlex.split(typed)[1:4], "--gravity", "9.81", "-o", "own.json"], project=False) == 0
    assert unsealed(record) == unsealed(Path("own.json"))
    page.locator("[data-name='imulab-files/unit 7.json']").click()
    page.get_by_role("button", name="Firmware (zip)").click()
    packed = saved(page, "Save unit 7-c.zip")
    assert "unit 7-c/imulab.h" in zipfile.ZipFile(packed).namelist()
    page.reload()
    page.locator(".job").nth(1).wait_for()  # what was done is still there
    assert page.locator(".job strong").all_inner_texts() == ["export", "tumble fit"]


def test_zooming_fetches_what_the_range_holds(workbench, new_page):
    page = new_page(workbench.address)
    drop(page, "rec.csv", tumble("own.csv"))
    page.get_by_text("attitudes at rest").wait_for()
    page.locator("svg.plot").first.wait_for()
    status = page.locator(".plotbar .range")
    whole = status.inner_text()
    box = page.locator("svg.plot").first.bounding_box()
    page.mouse.move(box["x"] + 200, box["y"] + 80)
    page.mouse.down()
    page.mouse.move(box["x"] + 300, box["y"] + 80, steps=4)
    page.mouse.up()
    page.wait_for_function("text => document.querySelector('.plotbar .range').textContent !== text", arg=whole)
    low, high = map(float, re.findall(r"[\d.]+", status.inner_text()))
    seconds = float(re.findall(r"[\d.]+", whole)[1])
    assert high - low == pytest.approx(seconds * 100 / (box["width"] - 72), rel=0.05)
    zoomed = status.inner_text()
    page.locator("svg.plot").first.focus()
    page.keyboard.press("+")
    page.wait_for_function("text => document.querySelector('.plotbar .range').textContent !== text", arg=zoomed)
    closer = [float(each) for each in re.findall(r"[\d.]+", status.inner_text())]
    assert closer[1] - closer[0] == pytest.approx((high - low) / 2, rel=0.05)
    page.keyboard.press("0")
    page.wait_for_function("text => document.querySelector('.plotbar .range').textContent === text", arg=whole)


def test_cancelling_ends_the_command_and_leaves_nothing(workbench, new_page, folder):
    page = new_page(workbench.address)
    drop(page, "rec.csv", tumble("own.csv"))
    page.get_by_text("More options").click()
    page.get_by_label("monte carlo", exact=True).fill("900000")
    assert "--monte-carlo 900000" in command(page)
    page.get_by_role("button", name="Run").click()
    page.locator(".job .chip.running").wait_for()
    page.get_by_role("button", name="Cancel").click()
    page.locator(".job .chip.cancelled").wait_for()
    assert [path.name for path in (folder / "imulab-files").iterdir()] == ["rec.csv"]


def test_what_is_refused_is_said_where_it_was_typed(workbench, new_page):
    page = new_page(workbench.address)
    drop(page, "rec.csv", tumble("own.csv"))
    page.get_by_label("gravity", exact=True).fill("nonsense")
    page.get_by_role("button", name="Run").click()
    page.locator(".job .chip.refused").wait_for()
    assert "--gravity 'nonsense'" in page.locator(".job .heard").inner_text()


def test_a_file_of_foreign_columns_asks_for_a_layout(workbench, new_page):
    page = new_page(workbench.address)
    drop(page, "phone.csv", "t;a\n1;x\n")
    page.locator(".file .refused").wait_for()
    assert "--layout" in page.locator(".file .refused").inner_text()
    drop(
        page,
        "mine.toml",
        'delimiter = ","\n[columns]\ntime = { from = "t", unit = "s" }\naccel_x = { from = "q", unit = "g" }\n',
    )
    drop(page, "phone2.csv", "t,q\n0,1\n1,2\n2,3\n")
    page.locator("[data-name='imulab-files/phone2.csv']").click()
    page.get_by_role("heading", name="phone2.csv").wait_for()
    page.locator(".file .refused").wait_for()  # and with it, the form of "How the file is read" is open
    page.locator("#reading-layout").fill("imulab-files/mine.toml")
    page.get_by_role("button", name="Read it so").click()
    page.locator("svg.plot", has_text="accel [g]").wait_for()
    assert "--layout imulab-files/mine.toml" in command(page)


def test_a_file_that_breaks_shows_its_good_part(workbench, new_page):
    page = new_page(workbench.address)
    text = tumble("own.csv")
    drop(page, "rec.csv", text + text.splitlines()[-1].replace(",", ",x", 1) + "\n")
    page.get_by_text("Read up to where it breaks: ").wait_for()
    page.locator("svg.plot").first.wait_for()
    rows = len(il.read("own.csv"))
    assert f"{rows:,} samples".replace(",", " ") in page.locator(".file .message").inner_text()
    assert f"row {rows + 1} (" in page.locator(".file .refused").inner_text()
    drop(page, "none.csv", "time [s],accel_x [g]\n0,1\n1,2\nx,2\n")  # and closing it leaves no fault behind
    page.get_by_role("heading", name="none.csv").wait_for()
    page.wait_for_timeout(500)


def test_an_older_list_of_files_takes_no_file_off(workbench, new_page):
    page = new_page(workbench.address)
    held: list[Any] = []
    page.route("**/api/workbench/files", lambda route: held.append((route, route.fetch())))
    page.reload()
    page.wait_for_function("document.querySelector('.drop')")
    while not held:
        page.wait_for_timeout(20)
    drop(page, "phone.csv", "t;a\n1;x\n")
    entry = page.locator("[data-name='imulab-files/phone.csv']")
    entry.wait_for()
    assert held[0][1].json()["files"] == []
    for route, answer in reversed(held):
        route.fulfill(response=answer)
    page.wait_for_timeout(300)
    assert entry.count() == 1


def test_a_file_that_comes_late_does_not_hide_the_one_that_was_clicked_on(workbench, new_page):
    page = new_page(workbench.address)
    drop(page, "one.csv", "t;a\n1;x\n")
    page.get_by_role("heading", name="one.csv").wait_for()
    held: list[Any] = []
    page.route("**/api/workbench/files/*", lambda route: held.append(route))
    drop(page, "two.csv", "t;a\n1;x\n")
    while not held:
        page.wait_for_timeout(20)
    page.locator("[data-name='imulab-files/one.csv']").click()
    held[0].continue_()
    page.locator("[data-name='imulab-files/two.csv']").wait_for()
    page.wait_for_timeout(300)
    assert page.get_by_role("heading", name="one.csv").count() == 1


def test_nothing_of_a_files_text_is_executed(workbench, new_page, folder):
    text = tumble("own.csv", seed=2)
    lines = text.splitlines()
    lines[0:0] = [f"# serial: {EVIL}", f"# model: <script>document.title='taken'</script>{EVIL}"]
    head = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    lines[head] += f",{EVIL} [1]"
    lines[head + 1 :] = [f"{line},1" for line in lines[head + 1 :]]
    page = new_page(workbench.address)
    page.on("dialog", lambda dialog: pytest.fail("a dialog was opened"))
    drop(page, f"{EVIL}.csv", "\n".join(line for line in lines if not line.startswith("# serial: S")) + "\n")
    page.get_by_text("12 attitudes at rest").wait_for()
    page.locator("svg.plot").first.wait_for()
    page.get_by_text("What the file says of itself").click()
    assert EVIL in page.locator(".file pre").inner_text()
    page.get_by_role("button", name="Run").click()
    page.locator(".job .chip.done").wait_for()
    report = page.frame_locator(".job iframe")
    report.get_by_role("heading", name="Tumble calibration").wait_for()
    page.get_by_role("button", name=re.compile("Look at")).click()
    page.get_by_role("button", name="What it says").click()
    page.get_by_text(f"calibration of {EVIL}").first.wait_for()
    assert page.locator("img, main script").count() == report.locator("img").count() == 0
    assert page.title() == "imulab"
    for name in ("../out.csv", "/etc/out.csv", "a\0b.csv", "x" * 400 + ".csv"):
        status = page.evaluate(
            "name => fetch('/api/workbench/files/' + encodeURIComponent(name), { method: 'PUT', body: 'x' })"
            ".then(answer => answer.status)",
            name,
        )
        assert status in (400, 404)
    assert sorted(path.name for path in folder.iterdir()) == ["imulab-files", "own.csv"]
    assert len(list((folder / "imulab-files").iterdir())) == 3


def test_a_report_cannot_reach_the_session(workbench, new_page):
    page = new_page(workbench.address)
    drop(page, "rec.csv", tumble("own.csv"))
    page.get_by_role("button", name="Run").click()
    page.locator(".job iframe").wait_for()
    page.frame_locator(".job iframe").get_by_role("heading", name="Tumble calibration").wait_for()
    frame = page.frames[-1]
    assert frame.evaluate("window.origin") == "null"
    assert (
        frame.evaluate("(() => { try { return parent.document.title } catch (error) { return error.name } })()")
        == "SecurityError"
    )


def test_a_wrong_token_shows_nothing_but_what_to_do(workbench, new_page):
    page = new_page(workbench.address.partition("token=")[0] + "token=wrong")
    assert "open that one, with its token" in page.locator("body").inner_text()
    assert page.locator("main").count() == 0


def test_two_records_are_compared(folder, new_page):
    for number in (1, 2):
        tumble(f"{number}.csv", seed=number)
        assert (
            main(
                ["tumble", "fit", f"{number}.csv", "--order", "1", "--gravity", "9.81", "-o", f"{number}.json"],
                project=False,
            )
            == 0
        )
    running = Workbench("1.json", "2.json")
    try:
        page = new_page(running.address)
        page.locator("[data-name='2.json']").click()
        page.get_by_role("button", name="Compare with it").click()
        page.locator(".job .chip.done").wait_for()
        assert page.locator(".job .command code").first.inner_text() == "imulab show 1.json 2.json"
        assert "2.json less 1.json" in page.locator(".job pre").first.inner_text()
    finally:
        running.close()
    assert not (folder / "imulab-files").exists()  # nothing was made


@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 768, 1280])
def test_every_control_has_a_name_and_fits_the_screen(workbench, new_page, width):
    page = new_page(workbench.address)
    page.set_viewport_size({"width": width, "height": 800})
    drop(page, "rec.csv", tumble("own.csv"))
    page.get_by_text("attitudes at rest").wait_for()
    page.locator("svg.plot").first.wait_for()
    page.evaluate("for (const each of document.querySelectorAll('details')) each.open = true")
    controls = page.locator("#workbench :is(input, select, button, a, svg.plot):visible")
    nameless = controls.evaluate_all(
        """all => all.filter(each =>
            !(each.getAttribute("aria-label") || each.labels?.length || each.textContent.trim())
        ).map(each => each.outerHTML)"""
    )
    assert nameless == []
    assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
    for _ in range(3):  # the drop zone, then the file, by the keyboard alone
        page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.matches('button, input, a')")

"""The workbench in a real Chromium, by what a person drops, clicks and types; the command line beside it."""

from __future__ import annotations

import os
import re
import shlex
import signal
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("starlette", reason="the page needs the extra live")

import imulab as il
from benchpage import PATIENCE, Workbench, await_request, command, drop, read, run, tumble
from imulab.cli import main

EVIL = "<img src=x onerror=document.title='taken'>"


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def saved(page: Any, name: str) -> Path:
    """Click what saves a file, and return where it lies."""
    with page.expect_download() as download:
        page.get_by_role("link", name=name, exact=True).first.click()
    return Path(download.value.path())


def unsealed(path: Path) -> list[bytes]:
    lines = path.read_bytes().splitlines()
    assert len(lines) > 100
    return [line for line in lines if b'"created"' not in line and b'"content_sha256"' not in line]


def test_from_the_drop_to_record_report_and_firmware(workbench, new_page, folder):
    text = tumble("own.csv")
    page = new_page(workbench.address)
    page.get_by_text("Drop recordings or records here").wait_for()
    drop(page, "unit 7.csv", text)
    page.get_by_text("12 attitudes at rest (shaded)").wait_for()
    read(page)
    assert page.locator("#workbench").get_attribute("role") == "region"  # one area alone is no tab
    assert page.locator("svg.plot").count() == 4
    assert page.locator("svg.plot >> nth=0 >> rect.attitude").count() == 12
    page.get_by_label("gravity", exact=True).fill("9.81")
    typed = command(page)
    assert typed == (
        "imulab tumble fit 'imulab-files/unit 7.csv' --gravity 9.81 -o 'imulab-files/unit 7.json' "
        "--report 'imulab-files/unit 7.html'"
    )
    run(page)
    page.locator(".job .found").wait_for()
    assert page.locator(".found .said.look").inner_text().startswith("Look first. After calibration")  # 12 are few
    assert page.locator(".found dd").count() == 3
    assert not page.locator(".settings").evaluate("each => each.open")  # the form has folded away
    page.locator(".found .js-plotly-plot .point").first.wait_for()
    page.get_by_text("All that it says").click()
    assert page.locator(".job .command code").inner_text() == typed
    page.get_by_role("button", name="Show unit 7.html").click()
    report = page.frame_locator(".job iframe")
    report.get_by_role("heading", name="Tumble calibration").wait_for()
    report.locator(".js-plotly-plot").first.wait_for()
    record = saved(page, "Save unit 7.json")
    assert main([*shlex.split(typed)[1:4], "--gravity", "9.81", "-o", "own.json"], project=False) == 0
    assert unsealed(record) == unsealed(Path("own.json"))
    page.locator("[data-name='imulab-files/unit 7.json']").click()
    page.locator(".file").get_by_role("button", name="Firmware (zip)").click()
    packed = saved(page, "Save unit 7-c.zip")
    assert "unit 7-c/imulab.h" in zipfile.ZipFile(packed).namelist()
    page.reload()
    page.locator(".job").nth(1).wait_for()  # what was done is still there
    assert page.locator(".job > summary strong").all_inner_texts() == ["export", "tumble fit"]


def test_zooming_fetches_what_the_range_holds(workbench, new_page):
    page = new_page(workbench.address)
    drop(page, "rec.csv", tumble("own.csv"))
    read(page)
    drop(page, "other.csv", "t;a\n1;x\n")
    page.get_by_role("heading", name="other.csv").wait_for()
    page.once("dialog", lambda dialog: dialog.accept())
    page.get_by_role("button", name="Remove").click()
    page.get_by_text("Choose a file in the list, or drop another one.").wait_for()
    page.locator("[data-name='imulab-files/rec.csv']").click()
    read(page)
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
    read(page)
    page.get_by_text("More options").click()
    page.get_by_label("monte carlo", exact=True).fill("900000")
    assert "--monte-carlo 900000" in command(page)
    run(page)
    page.locator(".job .chip.running").wait_for()
    page.get_by_role("button", name="Cancel").click()
    page.locator(".job .chip.cancelled").wait_for()
    assert [path.name for path in (folder / "imulab-files").iterdir()] == ["rec.csv"]


def test_what_is_refused_is_said_where_it_was_typed(workbench, new_page):
    page = new_page(workbench.address)
    drop(page, "rec.csv", tumble("own.csv"))
    read(page)  # until then the form may be made anew
    page.get_by_label("order", exact=True).fill("nonsense")
    page.get_by_text("order 'nonsense': expected one of").wait_for()  # before it is run
    page.get_by_label("gravity", exact=True).fill("nonsense")
    page.get_by_text("gravity 'nonsense': expected").wait_for()
    run(page)
    page.wait_for_function("() => document.activeElement.getAttribute('aria-invalid') === 'true'")
    assert page.locator(".job").count() == 0
    page.get_by_label("order", exact=True).fill("2")
    page.get_by_label("gravity", exact=True).fill("9.81")
    page.wait_for_function("() => !document.querySelector('.wrong:not([hidden])')")


def test_settings_that_are_refused_are_open_to_be_mended(workbench, new_page, folder):
    page = new_page(workbench.address)
    drop(page, "gyro.csv", gyro_log("own.csv"))
    page.locator("[data-path='rate fit'][aria-pressed='true']").wait_for()
    run(page)
    page.locator(".job .chip.refused").wait_for()
    page.locator(".settings[open]").get_by_label("rates", exact=True).wait_for()


def test_results_name_their_file_say_that_it_was_replaced_and_are_cleared(workbench, new_page):
    page = new_page(workbench.address)
    drop(page, "rec.csv", tumble("own.csv"))
    read(page)
    page.get_by_label("gravity", exact=True).fill("9.81")
    command(page)
    run(page)
    page.locator(".job .found").wait_for()
    title = page.locator(".job > summary").inner_text()
    assert title.startswith("tumble fit of rec.csv")
    assert re.search(r"\d\d:\d\d", title)
    drop(page, "rec.csv", tumble("own.csv", seed=7))
    page.get_by_text("rec.csv has been replaced by what came now").wait_for()
    page.get_by_text("Made from an older rec.csv, which has been replaced since.").wait_for()
    read(page)
    assert page.locator(".entry .filename").all_inner_texts() == ["rec.csv", "rec.html", "rec.json"]
    page.get_by_role("button", name="Clear the list of results").click()
    page.wait_for_function("() => !document.querySelector('.job')")
    page.reload()
    page.locator(".entry").first.wait_for()
    assert page.locator(".job").count() == 0


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
    page.locator(".assistant").wait_for()
    page.get_by_text("How the file is read").click()
    page.locator("#layout-list option").nth(40).wait_for(state="attached")  # the list may come later than the columns
    page.get_by_label("search the layouts").fill("mine")
    page.get_by_label("layouts", exact=True).select_option("imulab-files/mine.toml")
    page.get_by_role("button", name="Read it with this layout").click()
    page.locator(".plotbox", has_text="accel [g]").wait_for()
    assert "--layout imulab-files/mine.toml" in command(page)


def test_a_file_that_breaks_shows_its_good_part(workbench, new_page):
    page = new_page(workbench.address)
    text = tumble("own.csv")
    drop(page, "rec.csv", text + text.splitlines()[-1].replace(",", ",x", 1) + "\n")
    page.get_by_text("Read up to where it breaks: ").wait_for()
    page.locator("svg.plot").first.wait_for()
    rows = len(il.read("own.csv"))
    assert f"{rows:,} samples".replace(",", " ") in page.locator(".file .message").first.inner_text()
    assert f"row {rows + 1} (" in page.locator(".file .refused").inner_text()
    drop(page, "none.csv", "time [s],accel_x [g]\n0,1\n1,2\nx,2\n")  # and closing it leaves no fault behind
    page.get_by_role("heading", name="none.csv").wait_for()
    page.wait_for_timeout(500)


def test_an_older_list_of_files_takes_no_file_off(workbench, new_page):
    page = new_page(workbench.address)
    held: list[Any] = []
    page.route("**/api/workbench/files", lambda route: held.append((route, route.fetch())))
    page.reload()
    page.locator(".drop").wait_for()
    await_request(page, held)
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
    await_request(page, held)
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
    page.get_by_text("Mean, standard deviation").click()
    page.locator(".spectrum svg").wait_for()
    run(page)
    page.locator(".job .found").wait_for()
    page.get_by_role("button", name=re.compile(r"Show .*html")).click()
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
    run(page)
    page.get_by_role("button", name="Show rec.html").click()
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


def gyro_log(name: str) -> str:
    """Write the gyroscopes of a recording alone, and return their text."""
    tumble(name)
    rec = il.read(name)
    kept = {key: values for key, values in rec.columns.items() if key.startswith(("time", "gyro"))}
    il.write_csv(replace(rec, columns=kept, units={key: rec.units[key] for key in kept}), name)
    return Path(name).read_text()


def offered(page: Any) -> list[str]:
    page.locator(".formplace .form").wait_for()
    return page.locator(".procedure > .cards .card").evaluate_all("all => all.map(each => each.dataset.path)")


def test_only_what_a_file_is_for_is_offered_and_of_the_rest_it_is_said_why(workbench, new_page, folder):
    page = new_page(workbench.address)
    drop(page, "gyro.csv", gyro_log("own.csv"))
    page.locator("svg.plot").first.wait_for()
    paths = offered(page)
    assert paths[0] == "rate fit"
    assert not {"tumble fit", "tumble mag", "array calibrate", "warmup fit", "apply", "certificate"} & set(paths)
    assert not any(path.startswith("array") for path in paths)
    page.get_by_text("Not with this").click()
    card = page.locator("[data-path='tumble fit']")
    assert card.is_disabled()
    assert "There are no three accelerometers in it." in card.inner_text()
    il.simulate_rate(rates="0,100,-100", hold="1 s").save("table")
    for file in sorted(Path("table").iterdir(), reverse=True):
        drop(page, file.name, file.read_text())
    page.locator("[data-name$='.toml']").first.click()
    page.get_by_text("The manifest of a rate test: it names").wait_for()
    assert offered(page) == ["rate fit"]
    il.fit_tumble(il.simulate_tumble(gravity=9.81), order=1, gravity=9.81).save("unit.json")
    drop(page, "unit.json", Path("unit.json").read_text())
    page.locator("[data-name$='unit.json']").click()
    page.locator("[data-path='certificate']:not([disabled])").wait_for()
    cards = page.locator(".procedure > .cards .card").evaluate_all("all => all.map(each => each.dataset.path)")
    assert {"certificate", "report", "export"} <= set(cards)
    assert "noise fit" not in cards


def test_of_gyroscopes_at_rest_the_noise_is_offered_first(workbench, new_page, folder):
    il.write_csv(il.simulate_noise(white="0.3 deg/sqrt(h)", flicker="5 deg/h", duration="60 s"), "rest.csv")
    page = new_page(workbench.address)
    drop(page, "rest.csv", Path("rest.csv").read_text())
    page.locator("[data-path='noise fit'][aria-pressed='true']").wait_for()
    assert offered(page)[:2] == ["noise fit", "rate fit"]


def test_what_was_said_of_one_file_s_columns_is_not_said_of_the_next(workbench, new_page):
    page = new_page(workbench.address)
    text = tumble("own.csv")
    held: list[Any] = []  # the answer to what is said comes when the next file is shown

    def hold(route: Any) -> None:
        if "sample_rate" in route.request.post_data:
            held.append(route)
        else:
            route.continue_()

    page.route("**/columns*", hold, times=2)
    drop(page, "unknown.csv", "t;p;q;r\n" + text.partition("\n")[2].replace(",", ";"))
    page.locator(".assistant").wait_for()
    await_request(page, held)
    drop(page, "rec.csv", text)
    read(page)
    for each in held:
        each.continue_()
    page.wait_for_timeout(1500)
    assert page.locator(".assistant").count() == 0
    assert page.locator("h2", has_text="rec.csv").count() == 1


def test_a_board_of_whole_imus_is_offered_its_calibration(workbench, new_page, folder):
    page = new_page(workbench.address)
    il.write_csv(il.simulate_imus(elements=4, attitudes=6, duration="5 s", rate="50 Hz"), "board_log.csv")
    drop(page, "board.csv", Path("board_log.csv").read_text())
    page.locator("svg.plot").first.wait_for()
    paths = offered(page)
    assert paths[0] == "array calibrate --imus"
    assert not {"array fuse --imus", "array compare --imus"} & set(paths)  # these need the record of the board
    assert "--imus" not in page.locator(".formplace .form .caption").first.inner_text()
    assert page.locator(".formplace [name=imus], .formplace [id$=imus]").count() == 0


def test_a_channel_can_be_read_out_and_hidden_and_a_window_taken(workbench, new_page):
    page = new_page(workbench.address)
    drop(page, "rec.csv", tumble("own.csv"))
    read(page)
    plot = page.locator("svg.plot").first
    box = plot.bounding_box()
    page.mouse.move(box["x"] + 0.5 * (box["width"] - 72) + 62, box["y"] + 60)
    page.set_viewport_size({"width": 1260, "height": 900})  # the plots are drawn anew, and read out where they were
    narrower = "old => document.querySelector('svg.plot').getAttribute('width') < old - 10"
    page.wait_for_function(narrower, arg=box["width"])
    shown = page.locator(".plotbox .channel .value").all_inner_texts()
    assert all(shown)  # of every plot, not only of the one under the pointer
    rec = il.read("own.csv")
    middle = np.searchsorted(rec.time, (rec.time[0] + rec.time[-1]) / 2)
    near = rec.columns["gyro_x"][middle - 30 : middle + 30]
    value = float(shown[list(rec.units).index("gyro_x") - 1].replace("−", "-"))
    assert near.min() - 1e-3 <= value <= near.max() + 1e-3
    box = plot.bounding_box()
    page.get_by_role("button", name=re.compile("^accel_y")).click()
    page.locator(".channel[aria-pressed='false']").wait_for()
    assert page.locator("svg.plot").first.locator("path.curve").count() == 2
    page.mouse.move(box["x"] + 200, box["y"] + 30)  # down: a range of values
    page.mouse.down()
    page.mouse.move(box["x"] + 205, box["y"] + 90, steps=4)
    page.mouse.up()
    before = plot.get_attribute("aria-label")
    page.mouse.move(box["x"] + 200, box["y"] + 80)  # along: a range of time
    page.mouse.down()
    page.mouse.move(box["x"] + 400, box["y"] + 80, steps=4)
    page.mouse.up()
    page.get_by_role("button", name="Use this window").click()
    assert re.search(r"--window [\d.]+:[\d.]+", command(page))
    assert "from" in before
    assert page.locator(".part").inner_text().startswith("Only ")


def test_reload_and_back_lead_where_one_was(workbench, new_page):
    page = new_page(workbench.address)
    drop(page, "rec.csv", tumble("own.csv"))
    read(page)
    page.get_by_label("gravity", exact=True).fill("9.81")
    page.locator("[data-path='noise fit']").click()
    page.get_by_text("Fit a model of the noise to logs at rest").first.wait_for()
    page.go_back()
    page.locator("[data-path='tumble fit'][aria-pressed='true']").wait_for()
    assert page.get_by_label("gravity", exact=True).input_value() == "9.81"
    drop(page, "gyro.csv", gyro_log("own.csv"))
    page.get_by_role("heading", name="gyro.csv").wait_for()
    page.locator(".plots[aria-busy='false'] svg.plot").first.wait_for()
    whole = page.locator(".plotbar .range").inner_text()
    page.get_by_role("button", name="closer").click()
    page.wait_for_function("text => document.querySelector('.plotbar .range').textContent !== text", arg=whole)
    status = page.locator(".plotbar .range").inner_text()
    assert "from=" in page.url
    page.reload()
    page.get_by_role("heading", name="gyro.csv").wait_for()
    page.wait_for_function("text => document.querySelector('.plotbar .range')?.textContent === text", arg=status)
    page.go_back()
    page.get_by_role("heading", name="rec.csv").wait_for()
    page.get_by_text("attitudes at rest").wait_for()
    assert page.get_by_label("gravity", exact=True).input_value() == "9.81"
    other = new_page(page.url)  # a second tab has the address alone
    other.get_by_role("heading", name="rec.csv").wait_for()
    assert other.locator(".list [data-name]").count() == 2


def test_what_an_export_would_lose_is_a_choice(workbench, new_page, folder):
    page = new_page(workbench.address)
    drop(page, "rec.csv", tumble("own.csv"))
    read(page)
    page.get_by_label("order", exact=True).fill("1")
    run(page)
    page.locator(".job .found").wait_for()
    page.get_by_label("Write for another program").select_option("px4")
    page.get_by_role("button", name="Write", exact=True).click()
    page.get_by_role("button", name="Write it without that").wait_for()
    assert "--lossy" not in "".join(page.locator(".heard").all_text_contents())
    page.get_by_role("button", name="Write it without that").click()
    page.locator(".job").nth(2).wait_for()
    page.locator(".job >> nth=0 >> .chip.done").wait_for()
    assert list((folder / "imulab-files" / "rec-px4").iterdir())


COUNT = "window.clicks = 0; addEventListener('click', each => { window.clicks += each.detail > 0; }, true)"


@pytest.mark.slow
def test_an_unknown_file_becomes_a_corrected_one_without_leaving_the_page(workbench, new_page, folder):
    tumble("own.csv", unit="g")
    rec = il.read("own.csv")
    names = [f"{sensor}_{axis}" for sensor in ("accel", "gyro") for axis in "xyz"]
    rows = zip(rec.time, *(rec.columns[name] for name in names), strict=True)
    lines = ["zeit;p;q;r;u (deg/s);v (deg/s);w (deg/s)", *(";".join(f"{value:.6f}" for value in row) for row in rows)]
    page = new_page(workbench.address)
    page.evaluate(COUNT)
    drop(page, "foreign.csv", "\n".join(lines) + "\n")
    page.locator(".assistant").wait_for()
    page.get_by_label("column 2, p: what it is").select_option("accel_x")
    page.get_by_label("column 2, p: its unit").select_option("g")
    page.get_by_label("column 5, u (deg/s): what it is").select_option("gyro_x")
    assert page.get_by_label("column 7, w (deg/s): its unit").input_value() == "deg/s"  # its title says it
    page.locator(".plotbox", has_text="gyro [°/s]").wait_for()  # the preview
    page.get_by_role("button", name="Save as layout").click()
    page.locator(".assistant").wait_for(state="detached")
    read(page)
    page.get_by_label("gravity", exact=True).fill("9.81")
    run(page)
    page.locator(".job .found").wait_for()
    page.get_by_role("button", name="Correct a recording", exact=True).click()
    run(page)
    page.get_by_text(re.compile(r"^apply of foreign\.json.* done")).wait_for()
    assert page.evaluate("window.clicks") == 4
    layout = folder / "imulab-files" / "foreign.toml"
    assert il.read("imulab-files/foreign.csv", str(layout)).units["gyro_z"] == "deg/s"
    corrected = il.read("imulab-files/foreign-apply.csv")
    still = corrected.columns["accel_x"][:100] ** 2 + corrected.columns["accel_y"][:100] ** 2
    length = np.sqrt(still + corrected.columns["accel_z"][:100] ** 2).mean()
    assert length == pytest.approx(9.81, abs=5e-3)  # 0.3 m/s^2 off before


@pytest.mark.slow
def test_24_power_cycles_become_a_table_in_few_clicks(folder, new_page):
    running = Workbench()
    try:
        page = new_page(running.address)
        page.get_by_text("Plan and simulate").click()
        page.locator("[data-path='warmup simulate']").click()
        page.get_by_text("More options").click()
        page.get_by_label("duration", exact=True).fill("200 s")
        page.get_by_label("rate", exact=True).fill("2 Hz")
        run(page)
        page.get_by_text("warmup simulate done").wait_for()  # the folder that it made opens by itself
        page.get_by_role("heading", name="and 23 more").wait_for()
        page.evaluate(COUNT)
        with page.expect_response(lambda answer: answer.url.endswith("/open")):  # it shows the same before and after
            page.locator("[data-name='imulab-files/warmup-simulate'][aria-current]").click()
        page.get_by_role("heading", name="and 23 more").wait_for()
        page.locator("[data-path='warmup fit'][aria-pressed='true']").wait_for()
        run(page)
        page.locator(".job .found, .job .chip.refused").first.wait_for()
        assert page.locator(".job .found").count() == 1
        assert page.evaluate("window.clicks") == 2
        assert len(il.load("imulab-files/warmup-simulate.json").sources) == 24
        page.get_by_role("button", name="Only this one").click()
        page.get_by_role("button", name="Choose all 24 like this").click()
        page.get_by_role("heading", name="and 23 more").wait_for()
        page.reload()
        page.get_by_role("heading", name="and 23 more").wait_for()
    finally:
        running.close()


@pytest.mark.slow
def test_every_control_has_a_name_and_fits_the_screen(workbench, new_page):
    page = new_page(workbench.address)
    drop(page, "rec.csv", tumble("own.csv"))
    read(page)
    page.evaluate("for (const each of document.querySelectorAll('details')) each.open = true")
    controls = page.locator("#workbench :is(input, select, button, a, svg.plot):visible")
    for width in (390, 768, 1280):
        page.set_viewport_size({"width": width, "height": 800})
        page.wait_for_function("() => document.documentElement.scrollWidth <= innerWidth")  # once plots are drawn anew
        nameless = controls.evaluate_all(
            """all => all.filter(each =>
                !(each.getAttribute("aria-label") || each.labels?.length || each.textContent.trim())
            ).map(each => each.outerHTML)"""
        )
        assert nameless == []
        page.evaluate("document.activeElement.blur()")
        for _ in range(3):  # the drop zone, then the file, by the keyboard alone
            page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.matches('button, input, a')"), width


def test_the_file_that_is_shown_is_in_sight_in_the_list_of_a_small_screen(workbench, new_page):
    page = new_page(workbench.address)
    page.set_viewport_size({"width": 390, "height": 844})
    for number in range(9):
        drop(page, f"{number}.csv", "t;a\n1;x\n")
        page.get_by_role("heading", name=f"{number}.csv").wait_for()
    seen = """name => {
        const [row, list] = [document.querySelector(`[data-name$='${name}']`), document.querySelector(".side nav")]
            .map(each => each.getBoundingClientRect());
        return row.top >= list.top && row.bottom <= list.bottom;
    }"""
    page.wait_for_function(seen, arg="8.csv")
    page.go_back()
    page.get_by_role("heading", name="7.csv").wait_for()
    page.reload()
    page.get_by_role("heading", name="7.csv").wait_for()
    page.wait_for_function(seen, arg="7.csv")


@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 1280])
def test_axe_finds_nothing_in_any_state(workbench, new_page, accessibility, width):
    page = new_page(workbench.address)
    page.set_viewport_size({"width": width, "height": 800})
    page.locator(".drop").wait_for()
    assert accessibility(page) == []
    text = tumble("own.csv")
    drop(page, "unknown.csv", "t;p;q;r\n" + text.partition("\n")[2].replace(",", ";"))
    page.locator(".assistant").wait_for()
    assert accessibility(page) == []
    drop(page, "rec.csv", text)
    read(page)
    page.get_by_label("order", exact=True).fill("nonsense")
    page.get_by_text("order 'nonsense': expected one of").wait_for()
    page.evaluate("for (const each of document.querySelectorAll('details')) each.open = true")
    assert accessibility(page) == []
    page.get_by_label("order", exact=True).fill("1")
    command(page)
    run(page)
    page.locator(".found .js-plotly-plot .point").first.wait_for()
    page.evaluate("for (const each of document.querySelectorAll('details')) each.open = true")
    assert accessibility(page) == []
    drop(page, "rec.csv", tumble("own.csv", seed=7))
    page.get_by_text("Made from an older rec.csv").wait_for()
    assert accessibility(page) == []


@pytest.mark.skipif(sys.platform == "win32", reason="kill is another command there")
def test_a_workbench_without_a_terminal_says_how_to_end_it(folder):
    found = Workbench()
    assert "token=" in found.address
    assert found.process.stderr is not None
    hint = found.process.stderr.readline()
    assert hint == f"imulab: note: Ctrl-C ends it, or elsewhere: kill {found.process.pid}\n"
    os.kill(int(hint.split()[-1]), signal.SIGTERM)
    assert found.process.wait(PATIENCE) in (0, 143)
    out, error = found.process.communicate()
    assert (out, error) == ("", "")

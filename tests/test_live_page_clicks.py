"""No click and no typed letter is lost on the workbench, whatever comes while a person is at it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("starlette", reason="the page needs the extra live")

import imulab as il
from benchpage import await_request, command, drop, read, run, tumble


def arrive(page: Any, name: str) -> None:
    """Let a file reach the session from elsewhere, so that a message tells every page of it."""
    put = "name => fetch('/api/workbench/files/' + name, { method: 'PUT', body: 't;a' }).then(answer => answer.ok)"
    assert page.evaluate(put, name)


def test_a_click_on_run_runs_what_stands_there_whatever_comes_before_the_answer(workbench, new_page):
    page = new_page(workbench.address)
    drop(page, "rec.csv", tumble("own.csv"))
    read(page)
    page.get_by_label("order", exact=True).fill("1")
    command(page)
    held: list[Any] = []
    page.route("**/api/workbench/command", lambda route: held.append(route), times=1)
    run(page)
    await_request(page, held)
    arrive(page, "late.csv")
    page.locator("[data-name='imulab-files/late.csv']").wait_for()  # and the form asks again
    command(page)
    held[0].continue_()
    page.locator(".job .found").wait_for()
    assert "--order 1" in page.locator(".job .command code").text_content()


def test_a_run_that_is_answered_late_leaves_the_form_of_the_file_that_is_shown_by_then(workbench, new_page):
    page = new_page(workbench.address)
    text = tumble("own.csv")
    for name in ("other.csv", "rec.csv"):
        drop(page, name, text)
        page.get_by_role("heading", name=name).wait_for()
        read(page)
        if name == "other.csv":
            page.locator("[data-path='allan']").click()
        command(page)
    held: list[Any] = []
    page.route("**/api/workbench/command", lambda route: held.append(route), times=1)
    run(page)
    await_request(page, held)
    page.locator("[data-name='imulab-files/other.csv']").click()
    page.get_by_role("heading", name="other.csv").wait_for()
    read(page)
    held[0].continue_()
    page.locator(".job .found").wait_for()
    page.locator("[data-name$='.json']").wait_for()  # a record, by which what can be done is found anew
    command(page)
    assert page.locator(".settings > summary").inner_text() == "allan"


def test_what_comes_while_the_mouse_is_down_takes_no_click(workbench, new_page):
    page = new_page(workbench.address)
    drop(page, "one.csv", "t;a\n1;x\n")
    page.get_by_role("heading", name="one.csv").wait_for()
    drop(page, "rec.csv", tumble("own.csv"))
    read(page)
    held: list[Any] = []
    page.route("**/api/workbench/files/*", lambda route: held.append(route), times=1)
    drop(page, "late.csv", "t;a\n1;x\n")
    await_request(page, held)
    page.get_by_label("gravity", exact=True).focus()  # which the press takes away
    page.locator("[data-name='imulab-files/one.csv']").hover()
    page.mouse.down()
    held[0].continue_()  # above it in the list, and shown unless another file is clicked on
    page.wait_for_timeout(300)
    page.mouse.up()
    page.get_by_role("heading", name="one.csv").wait_for()
    page.locator("[data-name='imulab-files/late.csv']").wait_for()
    assert page.get_by_role("heading", name="one.csv").count() == 1


def test_what_is_told_of_a_recording_leaves_the_form_and_its_cursor(workbench, new_page):
    held: list[Any] = []

    def pass_on(message: str) -> None:
        told = json.loads(message)
        if told["type"] == "opening" and "attitudes" in told:
            held.append(message)
        else:
            socket[0].send(message)

    def between(route: Any) -> None:
        socket.append(route)
        route.connect_to_server().on_message(pass_on)

    socket: list[Any] = []
    page = new_page("about:blank")
    page.route_web_socket("**/ws", between)
    page.goto(workbench.address)
    drop(page, "rec.csv", tumble("own.csv"))
    gravity = page.get_by_label("gravity", exact=True)
    gravity.press_sequentially("9.")
    await_request(page, held)
    socket[0].send(held[-1])
    page.get_by_text("attitudes at rest").wait_for()
    page.keyboard.type("81")
    assert gravity.input_value() == "9.81"


class Held:
    """Requests to the workbench that wait until they are let go, and the number of all that start something."""

    def __init__(self, page: Any, *kinds: str) -> None:
        self.routes: list[Any] = []
        self.asked: list[str] = []
        self.released = False
        page.on("request", lambda request: self.asked.append(f"{request.method} {request.url.partition('bench/')[2]}"))
        for kind in kinds:
            page.route(f"**/api/workbench/{kind}", self._hold)

    def _hold(self, route: Any) -> None:
        if self.released:
            route.continue_()
        else:
            self.routes.append(route)

    def release(self) -> None:
        self.released = True
        for route in self.routes:
            route.continue_()


def press_twice(button: Any) -> None:
    """A double click, then single clicks and a key, as of a person who sees no answer."""
    button.dblclick()
    button.click()
    button.press("Enter")


def test_a_double_click_on_run_is_one_job_and_a_later_click_another(workbench, new_page):
    page = new_page(workbench.address)
    drop(page, "rec.csv", tumble("own.csv"))
    read(page)
    page.get_by_label("order", exact=True).fill("1")
    command(page)
    button = page.get_by_role("button", name="Run", exact=True)
    button.dblclick()  # answered at once
    page.locator("#job-1 .found").wait_for()
    page.locator(".settings > summary").click()
    held = Held(page, "jobs", "command")
    press_twice(button)
    await_request(page, held.routes)
    held.release()
    page.locator("#job-2 .found").wait_for()
    page.locator(".settings > summary").click()
    button.focus()
    page.keyboard.down("Enter")
    for _ in range(5):
        page.keyboard.down("Enter")  # held down
    page.keyboard.up("Enter")
    page.locator("#job-3 .found").wait_for()
    assert page.locator(".job").count() == 3
    assert held.asked.count("POST jobs") == 2


def test_other_values_that_are_run_before_the_answer_are_a_job_of_their_own(workbench, new_page):
    page = new_page(workbench.address)
    drop(page, "rec.csv", tumble("own.csv"))
    read(page)
    held = Held(page, "command")
    for order in ("1", "2"):
        page.get_by_label("order", exact=True).fill(order)
        run(page)
    await_request(page, held.routes)
    held.release()
    for number in (1, 2):
        page.locator(f"#job-{number} .found").wait_for(state="attached")
    texts = page.locator(".job .command code").all_text_contents()
    assert sorted("--order 1" in text for text in texts) == [False, True]


@pytest.mark.parametrize("name", ["Report", "What it says", "Firmware (zip)", "Write for another program"])
def test_a_double_click_on_what_a_record_is_for_is_one_job(workbench, new_page, name):
    il.fit_tumble(il.simulate_tumble(gravity=9.81), order=1, gravity=9.81).save("unit.json")
    page = new_page(workbench.address)
    drop(page, "unit.json", Path("unit.json").read_text())
    page.get_by_role("heading", name="unit.json").wait_for()
    button = page.locator(".file").get_by_role("button", name=name, exact=True)
    button.wait_for()
    held = Held(page, "jobs")
    press_twice(button)
    await_request(page, held.routes)
    held.release()
    page.locator("#job-1 .chip:is(.done, .refused)").wait_for()
    button.click()
    page.locator("#job-2 .chip:is(.done, .refused)").wait_for()
    assert held.asked.count("POST jobs") == page.locator(".job").count() == 2


def test_a_double_click_on_what_follows_a_fit_is_one_job_and_one_look(workbench, new_page):
    page = new_page(workbench.address)
    page.get_by_role("button", name="Simulate a recording").dblclick()
    read(page)
    page.get_by_label("order", exact=True).fill("1")
    run(page)
    found = page.locator("#job-2")
    found.locator(".found").wait_for()
    held = Held(page, "jobs")
    press_twice(found.get_by_role("button", name="Firmware (zip)"))
    await_request(page, held.routes)
    held.release()
    page.locator("#job-3 .chip.done").wait_for()
    found.locator("> summary").click()
    found.get_by_role("button", name="Show tumble.html").dblclick()
    found.locator("iframe").wait_for()
    found.get_by_role("button", name="Look at tumble.json").dblclick()
    page.get_by_role("heading", name="tumble.json").wait_for()
    page.go_back()
    page.get_by_role("heading", name="tumble.csv").wait_for()
    assert held.asked.count("POST jobs") == 1
    assert page.locator(".job").count() == 3


def test_a_double_click_saves_one_layout_and_removes_one_file(workbench, new_page, tmp_path):
    page = new_page(workbench.address)
    drop(page, "unknown.csv", "zeit;p;q;r\n" + "".join(f"{k / 100};0.1;0.2;{1 + k % 3 / 100}\n" for k in range(300)))
    page.get_by_label("column 2, p: what it is").select_option("accel_x")
    page.get_by_label("column 2, p: its unit").select_option("g")
    save = page.locator("button:text-is('Save as layout'):enabled")
    save.wait_for()
    held = Held(page, "columns", "files/*")
    press_twice(save)
    await_request(page, held.routes)
    held.release()
    page.locator(".assistant").wait_for(state="detached")
    page.locator("[data-name$='.toml']").click()
    page.get_by_role("heading", name="unknown.toml").wait_for()
    assert [path.name for path in sorted((tmp_path / "imulab-files").iterdir())] == ["unknown.csv", "unknown.toml"]
    questions: list[str] = []
    page.on("dialog", lambda dialog: (questions.append(dialog.message), dialog.accept()))
    page.get_by_role("button", name="Remove").dblclick()
    page.get_by_text("Choose a file in the list, or drop another one.").wait_for()
    assert len(questions) == 1
    assert page.locator("#said").inner_text() == ""

"""No click and no typed letter is lost on the workbench, whatever comes while a person is at it."""

from __future__ import annotations

import json
from typing import Any

import pytest

pytest.importorskip("starlette", reason="the page needs the extra live")

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

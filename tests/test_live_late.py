"""Streams that begin after the page or the terminal: unit, head and magnetometers are taken as from the first."""

from __future__ import annotations

import os
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import imulab as il
from benchpage import PATIENCE
from imulab.live.runner import Runner
from imulab.live.session import Session
from imulab.live.sources import open_source
from liveports import Device, lines_of, live
from test_live_terminal import Screen

pytest.importorskip("serial", reason="pyserial is in the extra [live]")


def tumble(unit: str, **options: object) -> il.Recording:
    given = {
        "attitudes": 9,
        "order": 1,
        "gravity": 9.81,
        "hold": "3 s",
        "move": "1 s",
        "gyro": False,
        "noise": "0.3 mg",
    } | options
    return il.simulate_tumble(unit=unit, **given)


@pytest.mark.parametrize("unit", ["g", "mg", "count", "m/s^2"])
def test_a_view_before_the_first_sample_changes_nothing(unit):
    recording = tumble(unit, field="48 uT")
    sessions = [Session(order=1, planned=9) for _ in range(2)]
    assert sessions[1].view().state == "waiting"
    events = []
    for session in sessions:
        events.append([])
        for start in range(0, len(recording), 50):
            part = {name: column[start : start + 50] for name, column in recording.columns.items()}
            events[-1] += session.feed(il.Recording(part, recording.units, recording.metadata))
    early, late = (session.view() for session in sessions)
    assert late == early
    assert events[1] == events[0]
    assert late.unit == unit
    assert late.parameters
    assert sessions[1].guide.metadata == recording.metadata
    assert "a quarter turn about the vertical" in next(e.text for e in events[1] if e.kind == "next")


@contextmanager
def late_unit(kind: str, lines: list[bytes], pace: float) -> Iterator[tuple[str, Callable[[], None], object]]:
    """A source's words, what begins its stream, and the standard input of who listens."""
    stop = threading.Event()

    def send(give: Callable[[bytes], object]) -> None:
        for start in range(0, len(lines), 20):
            if stop.is_set():
                return
            try:
                give(b"".join(lines[start : start + 20]))
            except OSError:
                return  # it was enough
            time.sleep(20 / pace)

    if kind == "serial":
        unit = Device(
            [b"".join(lines[start : start + 20]) for start in range(0, len(lines), 20)], pace / 20, patient=True
        )
        try:
            yield f"serial:{unit.port}", unit.begin, subprocess.DEVNULL
        finally:
            unit.close()
    elif kind == "-":
        theirs, ours = os.pipe()
        sender = threading.Thread(target=send, args=(lambda data: os.write(ours, data),), daemon=True)
        try:
            yield "-", sender.start, theirs
        finally:
            stop.set()
            os.close(theirs)
            os.close(ours)
    else:
        with socket.create_server(("127.0.0.1", 0)) as server, socket.socket(type=socket.SOCK_DGRAM) as link:
            port = server.getsockname()[1]
            server.settimeout(PATIENCE)
            accepted: list[socket.socket] = []

            def begin() -> None:
                if kind == "tcp":
                    accepted.append(server.accept()[0])
                    threading.Thread(target=send, args=(accepted[0].sendall,), daemon=True).start()
                else:
                    link.connect(("127.0.0.1", port))
                    threading.Thread(target=send, args=(link.send,), daemon=True).start()

            try:
                yield f"{kind}:127.0.0.1:{port}" if kind == "tcp" else f"udp:{port}", begin, subprocess.DEVNULL
            finally:
                stop.set()
                for other in accepted:
                    other.close()


@pytest.mark.parametrize("kind", ["tcp", "udp", "serial"])
def test_a_source_that_sends_late_keeps_its_unit(kind, tmp_path, monkeypatch):
    monkeypatch.setattr("imulab.live.formats.FIRST", 0.3)
    with late_unit(kind, lines_of(tumble("g", field="48 uT")), 4000) as (words, begin, _):
        session = Session(order=1, planned=20)
        runner = Runner.open(lambda: open_source(words), session, str(tmp_path / "rec.csv"), None, resume=False)
        try:
            for _ in range(3):
                runner.step(0.01)
                assert session.view().state == "waiting"
            begin()
            end = time.monotonic() + PATIENCE
            while not session.view().parameters and time.monotonic() < end:
                runner.step(0.05)
        finally:
            runner.close()
    view = session.view()
    assert view.unit == "g"
    assert view.parameters
    assert "quarter turn" in view.next_words
    assert not view.warnings


WORDS = ["--attitudes", "9", "--order", "1", "--gravity", "9.81", "--save", "rec.csv", "-o", "rec.json"]


def check_record(folder: Path) -> None:
    """The record has the scale factors of a unit that sends g."""
    parameters = il.load(folder / "rec.json").parameters
    for axis in "xyz":
        assert parameters[f"scale_factor_{axis}"].value * 9.80665 == pytest.approx(1, abs=0.05)


@pytest.mark.slow
def test_a_late_stream_in_a_plain_terminal(tmp_path):
    with (
        late_unit("-", lines_of(tumble("g")), 1600) as (words, begin, theirs),
        live([words, "--plain", *WORDS], tmp_path, stdin=theirs) as process,
    ):
        time.sleep(2.0)
        begin()
        assert process.ended() == 0, process.text
    assert "is its unit" not in process.text
    check_record(tmp_path)


@pytest.mark.slow
def test_a_late_stream_in_a_full_screen_terminal(tmp_path):
    with late_unit("tcp", lines_of(tumble("g", attitudes=14)), 1600) as (words, begin, _):
        screen = Screen([words, *WORDS], tmp_path)
        try:
            assert screen.until("waiting for samples"), screen.text[-2000:]
            begin()
            assert screen.until("enough: "), screen.text
            assert "is its unit" not in screen.text
            screen.press("q")
            assert screen.until("turn the unit and see: corrected |f|"), screen.text
            screen.press("x")
            assert screen.ended() == 0
        finally:
            screen.close()
    check_record(tmp_path)


@pytest.mark.slow
def test_a_late_stream_on_the_page(tmp_path, new_page):
    pytest.importorskip("starlette", reason="the page needs the extra live")
    lines = lines_of(tumble("g", field="48 uT"))
    longer = [{"9": "14"}.get(word, word) for word in WORDS]  # what to turn to next stays, however late the page looks
    with (
        late_unit("tcp", lines, 1600) as (words, begin, _),
        live([words, *longer, "--page", "--no-browser"], tmp_path) as process,
    ):
        assert process.said("http://") < float("inf"), process.text
        page = new_page(next(line for _, line in process.lines if line.startswith("http://")))
        page.wait_for_selector(".now[data-state='waiting'], .now[data-state='silent']")
        begin()
        page.wait_for_selector("figure figcaption:has-text('a quarter turn about the vertical')")
        page.get_by_role("button", name="Finish now").click()
        page.wait_for_selector(".result")
        assert "is its unit" not in page.inner_text("main")
        page.get_by_role("button", name="End the session").click()
        assert process.ended() == 0, process.text
    check_record(tmp_path)

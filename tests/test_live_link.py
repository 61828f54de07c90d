"""A link that is lost: the session keeps what it has, opens the link again by itself, and ends where nothing comes."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import pytest

import imulab as il
from imulab.live.runner import Runner
from imulab.live.session import Session
from imulab.live.sources import open_source
from liveports import Device, lines_of, live

pytest.importorskip("serial", reason="pyserial is in the extra [live]")
PACE = 2000  # samples a second, whose stamps are 100 a second
PIECE = 20  # samples sent at once


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr("imulab.live.formats.FIRST", 0.3)
    monkeypatch.setattr("imulab.live.sources._AGAIN", 0.1)
    monkeypatch.setattr("imulab.live.links._QUIET", 0.4)
    monkeypatch.setattr("imulab.live.runner._SILENT", 0.4)


@pytest.fixture(scope="module")
def recording() -> il.Recording:
    options = {"hold": "3 s", "move": "1 s", "gyro": False, "noise": "0.3 mg"}
    return il.simulate_tumble(attitudes=16, order=1, gravity=9.81, **options)


@pytest.fixture(scope="module")
def lines(recording) -> list[bytes]:
    return lines_of(recording)


def pieces(lines: list[bytes]) -> list[bytes]:
    return [b"".join(lines[start : start + PIECE]) for start in range(0, len(lines), PIECE)]


class Sender:
    """Sends lines with `give` at a pace from a thread, until it is told to stop."""

    def __init__(self, give: Callable[[bytes], object], lines: list[bytes]) -> None:
        self._stop = threading.Event()
        self.sent = 0
        self._thread = threading.Thread(target=self._run, args=(give, lines), daemon=True)
        self._thread.start()

    def _run(self, give: Callable[[bytes], object], lines: list[bytes]) -> None:
        for piece in pieces(lines):
            if self._stop.wait(PIECE / PACE):
                return
            with suppress(OSError):
                give(piece)
            self.sent += PIECE

    def stop(self) -> int:
        """Return how many lines have gone."""
        self._stop.set()
        self._thread.join(2.0)
        return self.sent


class Watched:
    """A session that is run until something is the case."""

    def __init__(self, source: str, folder: Path) -> None:
        self.path = folder / "rec.csv"
        self.session = Session(order=1, planned=12)
        self.events: list = []
        self.runner = Runner.open(lambda: open_source(source), self.session, str(self.path), None, resume=False)

    def until(self, case: Callable[[], object], seconds: float = 60.0) -> None:
        end = time.monotonic() + seconds
        while not case():
            assert time.monotonic() < end, (self.session.view(), self.events)
            self.events += self.runner.step_or_ask(0.02)

    def hold(self, more: int) -> None:
        """Take so many attitudes more."""
        wanted = len(self.session.guide.kept) + more
        self.until(lambda: len(self.session.guide.kept) >= wanted)

    def state(self, state: str) -> Callable[[], bool]:
        return lambda: self.session.view().state == state

    def check_lost(self, state: str) -> None:
        """The view keeps what is known, and says what is the case and what will happen."""
        view = self.session.view()
        count = len(view.attitudes)
        assert view.state == state
        if state == "lost":
            assert view.advice == f"link lost at {count} of 12; reconnecting"
        else:
            assert view.advice == "no samples come: is the unit on, and does it send?"
        assert count >= 3
        assert f"{self.path} keeps {count} attitudes: --resume goes on with it. In " in view.outlook
        assert "the record is made of what there is" in view.outlook

    def check_back(self) -> None:
        """The session has gone on as if nothing had been, and blames nobody for the pause."""
        view = self.session.view()
        assert view.state not in ("lost", "silent")
        assert not view.outlook
        assert view.counts.lost == 0
        assert not [text for text in view.warnings if "lost" in text]
        assert "samples come again" in [event.text for event in self.events]


@contextmanager
def watched(source: str, folder: Path) -> Iterator[Watched]:
    made = Watched(source, folder)
    try:
        yield made
    finally:
        made.runner.close()


@contextmanager
def serving(folder: Path) -> Iterator[tuple[socket.socket, Watched]]:
    """A server, and a session with it."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(10)
        with watched(f"tcp:127.0.0.1:{server.getsockname()[1]}", folder) as it:
            yield server, it


def reset(link: socket.socket) -> None:
    """Break a connection off without an orderly end."""
    link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    link.close()


@pytest.mark.parametrize("how", ["reset", "silent"])
def test_a_tcp_link_comes_back(how, lines, tmp_path):
    with serving(tmp_path) as (server, it):
        first = server.accept()[0]
        sender = Sender(first.sendall, lines)
        it.hold(3)
        gone = sender.stop()
        if how == "reset":
            reset(first)
        it.until(it.state("lost" if how == "reset" else "silent"))
        it.check_lost("lost" if how == "reset" else "silent")
        second = server.accept()[0]
        sender = Sender(second.sendall, lines[gone:])
        it.hold(2)
        it.check_back()
        sender.stop()
        second.close()
        it.until(lambda: it.runner.ended)  # an orderly end of the connection ends the session
        first.close()
    saved = il.read(it.path)
    assert len(saved) > 1500


def test_a_silent_server_that_sends_again_keeps_its_first_connection(lines, tmp_path):
    with serving(tmp_path) as (server, it):
        first = server.accept()[0]
        sender = Sender(first.sendall, lines)
        it.hold(3)
        gone = sender.stop()
        it.until(it.state("silent"))
        second = server.accept()[0]  # it was tried, and stays without a byte
        sender = Sender(first.sendall, lines[gone:])
        it.hold(2)
        it.check_back()
        sender.stop()
        second.settimeout(5)
        assert second.recv(10) in (b"", b"$M<\x00ff")  # closed again
        second.close()
        first.close()


def test_a_serial_port_that_vanished_comes_back(lines, tmp_path):
    port = tmp_path / "port"
    unit = Device(pieces(lines), PACE / PIECE, patient=True)
    port.symlink_to(unit.port)
    with watched(f"serial:{port}", tmp_path) as it:
        unit.begin()
        it.hold(3)
        unit.unplug()
        gone = len(unit.sent) * PIECE
        port.unlink()
        it.until(it.state("lost"))
        it.check_lost("lost")
        assert "unplugged?" in it.session.view().outlook
        again = Device(pieces(lines[gone:]), PACE / PIECE, patient=True)
        port.symlink_to(again.port)
        it.until(lambda: not it.runner.source.lost)
        again.begin()
        it.hold(2)
        it.check_back()
    unit.close()
    again.close()


def test_datagrams_come_back_from_another_port_of_the_unit(lines, tmp_path):
    with socket.socket(type=socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with (
        watched(f"udp:{port}", tmp_path) as it,
        socket.socket(type=socket.SOCK_DGRAM) as first,
        socket.socket(type=socket.SOCK_DGRAM) as second,
    ):
        sender = Sender(lambda data: first.sendto(data, ("127.0.0.1", port)), lines)
        it.hold(3)
        gone = sender.stop()
        it.until(it.state("silent"))
        it.check_lost("silent")
        sender = Sender(lambda data: second.sendto(data, ("127.0.0.1", port)), lines[gone:])
        it.hold(2)
        it.check_back()
        sender.stop()


def test_a_session_without_its_source_ends_with_what_there_is(lines, tmp_path, monkeypatch):
    monkeypatch.setattr("imulab.live.runner._GIVEN_UP", 1.0)
    with serving(tmp_path) as (server, it):
        first = server.accept()[0]
        server.close()
        sender = Sender(first.sendall, lines)
        it.hold(3)
        sender.stop()
        reset(first)
        it.until(lambda: it.runner.ended)
        assert it.events[-1].kind == "gone"
        assert it.events[-1].text.endswith(" for 1 s: the session ends with what there is")


def test_a_source_that_has_not_begun_is_waited_for(tmp_path, monkeypatch):
    monkeypatch.setattr("imulab.live.runner._GIVEN_UP", 0.6)
    with serving(tmp_path) as (server, it):
        first = server.accept()[0]
        it.until(it.state("silent"))
        end = time.monotonic() + 0.6
        it.until(lambda: time.monotonic() > end)
        assert not it.runner.ended
        first.close()


def test_what_is_missing_for_a_record_is_said(recording):
    session = Session(order=1, planned=12)
    assert session.view().missing == "at least 9 attitudes"
    missing = []
    for start in range(0, len(recording), 50):
        part = {name: column[start : start + 50] for name, column in recording.columns.items()}
        session.feed(il.Recording(part, recording.units))
        missing.append(session.view().missing)
    assert "at least 1 more attitude" in missing
    assert missing[-1] == ""


@pytest.mark.slow
def test_after_half_a_minute_a_record_is_made_of_what_there_is(lines, tmp_path):
    """Two sessions side by side: they wait for the same half minute."""
    words = ["--plain", "--order", "1", "--gravity", "9.81", "--save", "rec.csv", "-o", "rec.json"]
    units = {10: Device(pieces(lines), 400 / PIECE, patient=True), 3: Device(pieces(lines), 400 / PIECE, patient=True)}
    with ExitStack() as sessions:
        processes = {}
        for enough, unit in units.items():
            (tmp_path / str(enough)).mkdir()
            started = live([f"serial:{unit.port}", *words], tmp_path / str(enough))
            processes[enough] = sessions.enter_context(started)
        for unit in units.values():
            unit.await_listener()
        time.sleep(0.5)  # opening a port empties it
        for unit in units.values():
            unit.begin()
        lost = {}
        for count in (3, 10):
            assert processes[count].said(f"attitude {count} accepted") < float("inf"), processes[count].text
            units[count].unplug()
            lost[count] = processes[count].said("reconnecting")
        for count in (3, 10):
            assert processes[count].ended() == (0 if count == 10 else 2), processes[count].text
            assert 28 < time.monotonic() - lost[count] < 70
            units[count].close()
            assert "for 30 s: the session ends with what there is" in processes[count].text
            assert (tmp_path / str(count) / "rec.json").exists() == (count == 10)
    assert "rec.csv keeps 3 attitudes: --resume goes on with it" in processes[3].text


def test_a_server_where_nobody_listens_yet_is_waited_for(lines, tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    watched = Watched(f"tcp:127.0.0.1:{port}", tmp_path)
    why = f"nobody listens at tcp:127.0.0.1:{port} yet, trying again"
    watched.until(watched.state("absent"))
    assert watched.session.view().advice == why
    assert watched.runner.kept() == "no sample came, so nothing is kept"
    time.sleep(0.6)  # longer than silence is passed over in silence
    watched.events += watched.runner.step(0.02)
    assert [event.text for event in watched.events] == [why]  # it is said once
    with socket.create_server(("127.0.0.1", port)) as server:
        server.settimeout(20)
        link = server.accept()[0]
        sender = Sender(link.sendall, lines)
        watched.hold(2)
        sender.stop()
        link.close()
    watched.runner.close()


@pytest.mark.parametrize("titles", [b"ms;p;q;r\n", b""], ids=["titles sent once", "none"])
def test_the_guess_of_an_unknown_stream_is_taken_and_the_session_goes_on(recording, titles, tmp_path):
    time_, force = recording.si("time"), recording.triad("accel")
    rows = [b"%d;%.4f;%.4f;%.4f\n" % (1e3 * t, *f) for t, f in zip(time_, force / 9.81, strict=True)]
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(20)
        watched = Watched(f"tcp:127.0.0.1:{server.getsockname()[1]}", tmp_path)
        link = server.accept()[0]
        sender = Sender(link.sendall, [titles, *rows])
        watched.until(lambda: watched.runner.asked)
        assert watched.session.view().state == "unknown"
        assert watched.events[-1].text.startswith(f"{watched.session.source}: unknown format")
        watched.until(lambda: sender.sent > 2000)  # one looks at it for a while
        watched.events += watched.runner.take_guess()
        assert watched.session.view().samples > 0  # those before the question
        watched.hold(3)
        sender.stop()
        link.close()
    watched.runner.close()
    kept = il.read(watched.path)
    assert kept.units["accel_x"] == "g"
    assert kept.si("time")[0] - time_[0] < 1  # from before the question
    assert kept.si("time")[-1] - kept.si("time")[0] > 20

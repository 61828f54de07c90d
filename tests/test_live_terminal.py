"""The terminal of a live session: what is drawn at every size, and what its keys do in a real terminal."""

from __future__ import annotations

import fcntl
import os
import re
import select
import socket
import struct
import subprocess
import sys
import termios
import time
from contextlib import suppress
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

import imulab as il
from benchpage import PATIENCE
from imulab.live.guide import read_targets
from imulab.live.session import Session
from imulab.live.terminal import direction_of_key, draw
from test_live_link import Sender


def shown(session: Session, width: int, height: int) -> list[str]:
    console = Console(width=width, height=height, file=StringIO())
    console.print(draw(session.view(), width, height))
    return console.file.getvalue().rstrip("\n").split("\n")


@pytest.fixture(scope="module")
def session() -> Session:
    """Twelve attitudes, the last of them just put down."""
    made = Session(1, None, read_targets("bias 10 ug"))
    recording = il.simulate_tumble(attitudes=12, order=1, gravity=9.81, gyro=False)
    for start in range(0, len(recording), 50):
        part = {name: column[start : start + 50] for name, column in recording.columns.items()}
        made.feed(il.Recording(part, recording.units, recording.metadata))
    return made


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), [(80, 24), (120, 40), (60, 20), (40, 12)])
def test_what_to_do_is_first_and_nothing_is_wider_or_longer_than_the_terminal(session, width, height):
    lines = shown(session, width, height)
    assert len(lines) <= height
    assert max(map(len, lines)) <= width
    advice = session.view().advice
    assert lines[0].strip() == advice or advice.startswith(lines[0].strip())
    assert width < 60 or any(re.search(r"\|f\| \d+\.\d+ m/s\^2 uncorrected", line) for line in lines)
    if height >= 20:
        assert any(line.startswith("bias ") and "mg" in line for line in lines)
        assert "u: drop attitude 12   q: finish" in lines[-1]
    # The map needs room.
    assert any("N next" in line for line in lines) == (width >= 80)


def test_the_keys_of_a_simulated_unit_turn_it(session):
    console = Console(width=80, height=24, file=StringIO())
    console.print(draw(session.view(), 80, 24, by_hand=True))
    last = console.file.getvalue().rstrip("\n").split("\n")[-1]
    assert last.startswith("n xyz XYZ: turn   u: drop")
    assert last.endswith("Ctrl-C: stop")
    wanted = np.array([0.6, 0.0, 0.8])
    assert direction_of_key("n", wanted) is wanted
    np.testing.assert_array_equal(direction_of_key("y", wanted), [0, 1, 0])
    np.testing.assert_array_equal(direction_of_key("Z", None), [0, 0, -1])
    assert [direction_of_key(key, wanted) for key in ("", "u", "q", "\x1b")] == [None] * 4


def test_a_key_turns_the_simulated_unit_of_a_terminal(tmp_path):
    screen = Screen(["simulate:gravity=9.81,noise=0.1mg,speed=5", "--save", "rec.csv"], tmp_path)
    assert screen.until("turn it")
    screen.press("Z")
    assert screen.shows("now z down")
    screen.press("X")
    assert screen.shows("now x down")
    screen.press("q")
    screen.ended()


def test_a_terminal_without_samples_says_what_it_waits_for():
    assert shown(Session(1), 80, 24)[0].strip() == "waiting for samples"


class Screen:
    """A command in a pseudo-terminal of 80 by 24; reading never waits longer than is said."""

    def __init__(self, words: list[str], folder: os.PathLike[str], **environment: str) -> None:
        self.end, inner = os.openpty()
        fcntl.ioctl(inner, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        self.text = ""

        def own() -> None:
            os.setsid()
            fcntl.ioctl(0, termios.TIOCSCTTY, 0)

        self.process = subprocess.Popen(
            [sys.executable, "-m", "imulab", "live", *words],
            cwd=folder, stdin=inner, stdout=inner, stderr=inner, preexec_fn=own,
            env={**os.environ, "TERM": "xterm", **environment},
        )  # fmt: skip
        os.close(inner)

    def until(self, what: str, seconds: float = PATIENCE) -> bool:
        end = time.monotonic() + seconds
        while what not in self.text and time.monotonic() < end:
            if select.select([self.end], [], [], 0.1)[0]:
                try:
                    self.text += os.read(self.end, 1 << 16).decode("utf-8", "replace")
                except OSError:
                    break
        return what in self.text

    def shows(self, what: str, seconds: float = PATIENCE) -> bool:
        """Whether a text comes, whatever its style."""
        end = time.monotonic() + seconds
        while what not in re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", self.text) and time.monotonic() < end:
            self.until("\0", 0.1)
        return time.monotonic() < end

    def press(self, key: str) -> None:
        self.text = ""
        os.write(self.end, key.encode())

    def ended(self, seconds: float = PATIENCE) -> int:
        end = time.monotonic() + seconds
        while self.process.poll() is None and time.monotonic() < end:
            self.until("\0", 0.1)  # what nobody reads would hold the process up
        self.close()
        return self.process.wait(1.0)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait(5.0)
        with suppress(OSError):
            os.close(self.end)


WORDS = ["simulate:speed=20,order=1", "--follow", "--attitudes", "16", "--order", "1", "--save", "rec.csv"]


@pytest.mark.slow
def test_the_keys_drop_finish_and_show_that_it_works(tmp_path):
    screen = Screen([*WORDS, "-o", "rec.json"], tmp_path)
    try:
        assert screen.until("attitude 3 accepted"), screen.text
        screen.press("u")
        assert screen.until(" is dropped"), screen.text
        assert screen.until("enough: "), screen.text
        screen.press("q")
        assert screen.until("turn the unit and see: corrected |f|"), screen.text
        screen.press("x")
        assert screen.ended() == 0
    finally:
        screen.close()
    assert il.load(tmp_path / "rec.json").fit["attitudes"] >= 15


def test_a_key_takes_the_guess_of_an_unknown_stream(tmp_path):
    recording = il.simulate_tumble(attitudes=40, order=1, gravity=9.81, hold="3 s", move="1 s", gyro=False)
    values = zip(recording.si("time"), recording.triad("accel"), strict=True)
    rows = [b"%d;%.4f;%.4f;%.4f\n" % (1e3 * time, *force) for time, force in values]
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(20)
        words = [f"tcp:127.0.0.1:{server.getsockname()[1]}", "--order", "1", "--gravity", "9.81", "--save", "rec.csv"]
        screen = Screen(words, tmp_path)
        try:
            link = server.accept()[0]
            sender = Sender(link.sendall, [b"ms;p;q;r\n", *rows])
            assert screen.shows("g: read it as guessed"), screen.text
            screen.press("g")
            assert screen.until("attitude 2 accepted"), screen.text
            sender.stop()
            link.close()
        finally:
            screen.close()


def test_an_interrupt_keeps_the_recording_and_says_so(tmp_path):
    screen = Screen([*WORDS, "-o", "rec.json"], tmp_path, NO_COLOR="1")
    try:
        assert screen.until("attitude 2 accepted"), screen.text
        screen.press("\x03")
        assert screen.until("--resume goes on with it"), screen.text
        assert "Traceback" not in screen.text
        assert screen.ended() == 130
    finally:
        screen.close()
    assert not (tmp_path / "rec.json").exists()
    assert len(il.read(tmp_path / "rec.csv")) > 100

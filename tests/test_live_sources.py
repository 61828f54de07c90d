"""Sources of streams on real pseudo-terminals and sockets, and what is said where one cannot be opened."""

from __future__ import annotations

import errno
import os
import socket
import threading
import time
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

import imulab as il
from imulab.errors import ImulabError, OptionError, ReadError
from imulab.live.links import Link, LinkKind
from imulab.live.session import Session
from imulab.live.sources import Linked, LiveSource, open_source
from imulab.live.stamps import Counts
from imulab.live.terminal import draw
from streams import terminal, wait_for

serial = pytest.importorskip("serial", reason="pyserial is in the extra [live]")
SENT = [f"{k},{k * k},x{k}\n".encode() for k in range(3000)]


def everything(source: LiveSource, size: int) -> bytes:
    found = b""
    end = source.now() + 5
    while len(found) < size and source.now() < end and not source.ended:
        found += b"".join(arrived.data for arrived in source.get(0.05))
    return found


def test_a_serial_port_gives_every_byte_and_takes_some():
    with terminal() as (device, port):
        source = open_source(f"serial:{port}@57600")
        threading.Thread(target=lambda: [os.write(device, line) for line in SENT], daemon=True).start()
        assert everything(source, sum(map(len, SENT))) == b"".join(SENT)
        source.send(b"$M<\x00\x66\x66")
        assert os.read(device, 10) == b"$M<\x00\x66\x66"
        source.close()


def test_an_unplugged_device_is_named():
    with terminal() as (device, port):
        source = open_source(f"serial:{port}")
        os.write(device, b"1,2,3\n")
        assert everything(source, 6) == b"1,2,3\n"
        os.close(device)
        assert wait_for(lambda: bool(source.lost))
        assert f"serial:{port}@115200: the connection is lost" in source.lost
        assert "unplugged?" in source.lost
        source.close()


def test_a_busy_port_is_named():
    with terminal() as (_, port):
        first = open_source(f"serial:{port}")
        with pytest.raises(ReadError, match="the port is busy: another program has it open"):
            open_source(f"serial:{port}")
        first.close()


def test_a_missing_port_is_named_with_those_that_are_there():
    with pytest.raises(ReadError, match=r"serial:/dev/ttyNONE@9600: no such port; ports of this machine: "):
        open_source("serial:/dev/ttyNONE@9600")


def test_a_port_that_is_not_permitted_says_how_to_get_the_permission(monkeypatch):
    def refuse(*_: object, **__: object) -> None:
        raise serial.SerialException(errno.EACCES, "could not open port /dev/ttyUSB0: Permission denied")

    monkeypatch.setattr(serial, "Serial", refuse)
    with pytest.raises(ReadError, match=r"not permitted; add yourself to the group .* dialout"):
        open_source("serial:/dev/ttyUSB0")


def test_tcp_gives_every_byte_and_ends():
    with socket.create_server(("127.0.0.1", 0)) as server:
        source = open_source(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        link, _ = server.accept()
        threading.Thread(target=lambda: (link.sendall(b"".join(SENT)), link.close()), daemon=True).start()
        assert everything(source, sum(map(len, SENT))) == b"".join(SENT)
        assert wait_for(lambda: bool(source.get(0.05) or source.ended))
        assert not source.lost
        source.close()


def test_udp_gives_every_datagram_of_the_first_sender():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        port = free.getsockname()[1]
    source = open_source(f"udp:{port}")
    with pytest.raises(ReadError, match="the port is busy"):
        open_source(f"udp:{port}")
    one, other = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    one.sendto(b"first", ("127.0.0.1", port))
    assert everything(source, 6) == b"first\n"  # a line of its own, without its end
    other.sendto(b"nobody asked\n", ("127.0.0.1", port))
    for line in SENT[:200]:
        one.sendto(line, ("127.0.0.1", port))
    assert everything(source, sum(map(len, SENT[:200]))) == b"".join(SENT[:200])
    for each in (one, other, source):
        each.close()


def test_a_file_is_replayed_with_its_samples(tmp_path):
    recording = il.simulate_tumble(attitudes=2, gravity=9.81)
    il.write_csv(recording, tmp_path / "a@home.csv")
    source = open_source(f"replay:{tmp_path / 'a@home.csv'}@0")
    blocks = []
    while not source.ended:
        blocks += [arrived.data for arrived in source.get(0.0)]
    assert max(map(len, blocks)) <= 6
    np.testing.assert_array_equal(np.concatenate([b.columns["accel_x"] for b in blocks]), recording.columns["accel_x"])


def test_replay_keeps_the_pace(tmp_path):
    recording = il.simulate_tumble(attitudes=2, gravity=9.81)
    il.write_csv(recording, tmp_path / "a.csv")
    source = open_source(f"replay:{tmp_path / 'a.csv'}@20")
    begun = time.monotonic()
    while not source.ended:
        source.get(0.05)
    due = recording.time[-1] / 20
    assert due - 0.1 < time.monotonic() - begun < due + 10  # a busy machine is late, and never early


def test_a_simulated_unit_goes_where_it_is_told():
    source = open_source("simulate:seed=4,noise=0.1mg,speed=0", follow=True)
    wanted = np.array([0.6, 0.0, -0.8])
    blocks = [source.get(0.0)[0].data for _ in range(60)]
    source.turn_to(wanted)
    blocks += [source.get(0.0)[0].data for _ in range(100)]
    accel = np.concatenate([block.triad("accel") for block in blocks])
    time = np.concatenate([block.time for block in blocks])
    np.testing.assert_allclose(np.diff(time), 0.01, rtol=1e-9)
    last = accel[-50:].mean(axis=0)
    # A unit of MEMS size is off by 50 mg and 3 % and 2 deg at most.
    assert np.degrees(np.arccos(last @ wanted / np.linalg.norm(last))) < 8
    assert np.ptp(accel[150:300], axis=0).max() < 0.05  # it had rung out, and lay still until it was told
    assert blocks[0].metadata["serial"] == "SIM-0004"


def test_a_simulated_unit_that_is_taken_in_hand_is_left_alone():
    source = open_source("simulate:seed=4,noise=0.1mg,speed=0,hold=1s", follow=False)
    wanted = np.array([0.0, -1.0, 0.0])
    blocks = [source.get(0.0)[0].data for _ in range(20)]
    source.turn_by_hand(wanted)
    source.turn_to(-wanted)  # the guide does not turn what a person holds
    blocks += [source.get(0.0)[0].data for _ in range(600)]
    for block in (blocks[100], blocks[-1]):
        last = block.triad("accel").mean(axis=0)
        assert np.degrees(np.arccos(last @ wanted / np.linalg.norm(last))) < 8


def test_simulated_gyroscopes_stay_the_same_from_turn_to_turn():
    source = open_source("simulate:seed=4,speed=0,gyro=1", follow=True)
    blocks = []
    for wanted in np.vstack([np.eye(3), -np.eye(3)]):
        source.turn_to(wanted)
        blocks += [source.get(0.0)[0].data for _ in range(100)]
    names = [f"gyro_{axis}" for axis in "xyz"]
    rates = np.column_stack([np.concatenate([block.columns[name] for block in blocks]) for name in names])
    accel = np.concatenate([block.triad("accel") for block in blocks])
    still = np.array([abs(accel[k - 50 : k + 50] - accel[k]).max() < 0.05 for k in range(50, len(accel) - 50)])
    rests = rates[50:-50][still]
    truth = [np.degrees(float(blocks[0].metadata[f"truth_gyro_bias_{axis}"])) for axis in "xyz"]
    assert still.sum() > 500
    for part in np.array_split(rests, 4):  # 0.05 deg/s of noise a sample; biases of other units are 0.3 deg/s apart
        np.testing.assert_allclose(part.mean(axis=0), truth, atol=0.03)


def test_the_field_of_a_simulated_unit_goes_on_from_turn_to_turn():
    """One dip in every attitude, and a field that no hold jumps in."""
    source = open_source("simulate:seed=4,speed=0,field=48uT,dip=60deg", follow=True)
    up, field = [], []
    for wanted in np.vstack([np.eye(3), -np.eye(3)]):
        source.turn_to(wanted)
        blocks = [source.get(0.0)[0].data for _ in range(100)]
        up.append(wanted)
        field.append(np.concatenate([block.triad("mag") for block in blocks]))
    known = {key.removeprefix("truth_"): float(text) for key, text in blocks[0].metadata.items() if "truth_" in key}
    gain = 1e-6 * np.array([known[f"mag_scale_factor_{a}"] for a in "xyz"])
    soft = gain[:, None] * [[known.get(f"mag_misalignment_{a}{b}", 1.0) for b in "xyz"] for a in "xyz"]
    hard = gain * [known[f"mag_bias_{a}"] for a in "xyz"]
    for wanted, outputs in zip(up, field, strict=True):
        m = np.linalg.solve(soft, (1e-6 * outputs - hard).T).T
        assert abs(np.linalg.norm(m[-100:].mean(axis=0)) / 48e-6 - 1) < 0.002
        dip = np.degrees(np.arcsin(-m[-100:].mean(axis=0) @ wanted / 48e-6))
        assert abs(dip - 60) < 0.3
        steps = np.linalg.norm(np.diff(outputs, axis=0), axis=1)
        assert steps.max() < 2.5  # uT: 0.14 of noise an axis, and turns of 2 s


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("simulate:field=2T", "field 2: expected its magnitude in T"),
        ("simulate:field=48uT,dip=95deg", "dip 1.65.*within 90 deg"),
        ("serail:/dev/ttyUSB0", r"source 'serail:.*expected one of serial:PORT"),
        ("tcp:localhost", "expected tcp:HOST:PORT"),
        ("tcp:localhost:0", "port of 1 to 65535"),
        ("tcp:no.such.host.invalid:80", "no machine of this name|cannot be opened"),
        ("udp:seven", "expected a whole number"),
        ("serial:/dev/ttyS0@fast", "expected a whole number"),
        ("simulate:colour=red", r"the keys being seed order rate \[Hz\] noise \[mg\] .* bare numbers in these units$"),
        ("simulate:noise=1s", "acceleration"),
        ("simulate:rate=1", "sample rate 1"),
        ("simulate:speed=-1", "speed -1"),
        ("simulate:gyro=2", "gyro 2: expected 1"),
        ("replay:none.csv@0", "none.csv: no such file"),
    ],
)
def test_what_cannot_be_opened_is_one_line(text, said):
    with pytest.raises(ImulabError, match=said) as caught:
        open_source(text).get(0.0)
    assert "\n" not in str(caught.value)


def test_only_a_simulated_unit_follows():
    with pytest.raises(OptionError, match="--follow"):
        open_source("udp:5005", follow=True)


@pytest.mark.parametrize("held_back", [True, False])
def test_what_waits_is_bounded_and_a_sender_waits_or_its_losses_are_counted(held_back, monkeypatch):
    monkeypatch.setattr("imulab.live.sources._MOST_QUEUED", 20_000)
    sent = 0

    def read() -> bytes | None:
        nonlocal sent
        sent += 1
        return bytes([sent % 251]) * 1000 if sent <= 100 else None

    source = Linked(LinkKind("flood", lambda: Link(read), held_back=held_back))
    assert wait_for(lambda: sent >= 21)
    if held_back:
        time.sleep(0.1)
        assert sent == 21  # one more than fits is read, and waits
    else:
        assert wait_for(lambda: sent > 21)
    got = b""
    while not source.ended:
        got += b"".join(piece.data for piece in source.get(0.05))
    source.close()
    whole = b"".join(bytes([number % 251]) * 1000 for number in range(1, 101))
    assert got == (whole if held_back else whole[:20_000])
    assert source.unread_share == pytest.approx(0 if held_back else 0.8)


def test_lost_bytes_are_said_with_their_share():
    recording = il.simulate_tumble(attitudes=2, gyro=False)
    session, counts = Session(), Counts(unread_share=0.125)
    (said,) = [e.text for e in session.feed(recording, counts) if e.kind == "warning"]
    assert said.startswith("12 % of the bytes come faster than they are read and are lost: a lower rate")
    assert counts.summary() == "12 % of the bytes, which came faster than they are read"
    assert "12 % of bytes lost" in shown_facts(session)


def shown_facts(session: Session) -> str:
    console = Console(width=120, height=30, record=True, file=StringIO())
    console.print(draw(session.view(), 120, 30))
    return console.export_text()

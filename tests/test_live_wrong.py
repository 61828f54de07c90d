"""What goes wrong with a live stream: garbage, cut bytes, ports, silence, a full disk; and every network source."""

from __future__ import annotations

import resource
import signal
import socket
import subprocess
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.live.formats import LineStream
from imulab.live.sources import open_source
from imulab.readers import load_layout
from imulab.recording import Recording
from liveports import Device, device, lines_of, live
from streams import mavlink, motioncal, msp, native, ximu3

pytest.importorskip("serial", reason="pyserial is in the extra [live]")
RNG = np.random.default_rng(4)
NOISE = bytes(RNG.integers(128, 250, 37).tolist())
TEXTS = {"titles with units": native, "MotionCal Raw:": motioncal, "x-IMU3 ASCII": ximu3}
ASKED = b"$M<\x00\x66\x66"


def foreign(tmp_path: Path) -> tuple[list[bytes], dict[str, np.ndarray]]:
    values = RNG.normal(0, 1, (400, 3)).round(4)
    pieces = [f"IMU,{10 * k},{x:.4f},{y:.4f},{z:.4f}\n".encode() for k, (x, y, z) in enumerate(values.tolist())]
    (tmp_path / "l.toml").write_text(
        'delimiter = ","\nprefix = "IMU"\n[columns]\ntime = { from = 0, unit = "ms" }\n'
        + "".join(f'accel_{axis} = {{ from = {k}, unit = "g" }}\n' for k, axis in enumerate("xyz", 1))
    )
    return pieces, {f"accel_{axis}": values[:, k] for k, axis in enumerate("xyz")}


def heard(unit: Device, rows: int, layout: Path | None = None) -> tuple[LineStream, Recording]:
    """Listen at the port as a session does, until so many rows have come or nothing more does."""
    source = open_source(f"serial:{unit.port}")
    unit.begin()
    stream, blocks = LineStream(source.name, load_layout(layout) if layout else None, polled=True), []
    try:
        end = source.now() + 15
        while sum(map(len, blocks)) < rows and source.now() < end:
            found = source.get(0.02)
            for each in found:
                blocks += stream.feed(each.data, each.time)
                source.send(stream.to_send)
            if not found:
                blocks += stream.feed(b"", source.now())
                source.send(stream.to_send)
    finally:
        source.close()
    columns = {name: np.concatenate([block.columns[name] for block in blocks]) for name in blocks[0].columns}
    return stream, Recording(columns, blocks[0].units)


@pytest.mark.parametrize("name", [*TEXTS, "layout ", "MAVLink SCALED_IMU", "MAVLink HIGHRES_IMU"])
def test_garbage_and_cut_bytes_on_a_port_lose_only_what_they_hit(name, tmp_path, monkeypatch):
    monkeypatch.setattr("imulab.live.formats.FIRST", 0.3)
    text = not name.startswith("MAVLink")
    if text:
        pieces, sent = TEXTS[name]() if name in TEXTS else foreign(tmp_path)
    else:
        pytest.importorskip("pymavlink", reason="pymavlink is in the extra [live]")
        pieces, sent = mavlink(name.split()[1], 1 if "SCALED" in name else 2)
    values = sent["accel_x"]
    which = [k for k, piece in enumerate(pieces) if is_sample(name, k, piece)]
    assert len(which) == len(values)
    hit = [120, 200, 301]
    for row in hit:
        cut = pieces[which[row]]
        pieces[which[row]] = cut[: len(cut) // 2] + NOISE + (b"\n" if text else b"")
    # Between messages, where a line has ended or a frame has: nothing is lost by that.
    for row in (150, 250):
        pieces[which[row]] += NOISE + (b"\n" if text else b"")
    with device(pieces, 800, patient=True) as unit:
        stream, found = heard(unit, len(values) - len(hit), tmp_path / "l.toml" if name == "layout " else None)
    assert stream.format.startswith(name.split("/")[0])
    np.testing.assert_allclose(found.columns["accel_x"], np.delete(values, hit), rtol=1e-15)
    # Through a prefix, noise on a line of its own is another's message.
    assert stream.counts.damaged >= (3 if name == "layout " else 5)


def is_sample(name: str, k: int, piece: bytes) -> bool:
    if name.startswith("MAVLink"):
        return k % 41 > 0
    return piece[:1] not in (b"t", b"M", b"T")


@pytest.mark.parametrize("version", [1, 2])
def test_a_flight_controller_on_a_port_is_asked_and_damage_loses_an_answer(version):
    frames, sent = msp(version, 200)
    hit = [80, 150]
    for k in hit:
        frames[k] = frames[k][:11] + NOISE
    frames[100] += NOISE
    with device([], 1, patient=True) as unit:
        answers = threading.Thread(target=unit.answer, args=(ASKED, frames), daemon=True)
        answers.start()
        stream, found = heard(unit, len(frames) - len(hit))
        unit._stop.set()
        answers.join(2.0)
    assert stream.format == "MSP RAW_IMU"
    np.testing.assert_array_equal(found.columns["gyro_y"], np.delete(sent["gyro_y"], hit))


def tumble() -> il.Recording:
    return il.simulate_tumble(attitudes=20, order=1, gravity=9.81, hold="4 s", move="1 s", gyro=False, noise="0.3 mg")


WORDS = ["--plain", "--attitudes", "4", "--order", "0", "--save", "rec.csv"]


def same_as_sent(folder: Path, recording: il.Recording, unit: Device | None = None) -> None:
    saved = il.read(folder / "rec.csv")
    assert len(saved) > 1000
    places = np.searchsorted(np.round(recording.time * 1e6), np.round(saved.si("time") * 1e6))
    assert unit.follow(places) if unit else (np.diff(places) == 1).all()
    np.testing.assert_array_equal(saved.columns["accel_z"], recording.columns["accel_z"][places].round(5))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["udp", "tcp", "-"])
def test_every_sample_of_a_network_source_is_saved(kind, tmp_path):
    recording = tumble()
    lines, stop = lines_of(recording)[:4000], threading.Event()

    def send(give) -> None:
        for k, line in enumerate(lines):
            if stop.is_set():
                return
            give(line)
            if k % 10 == 9:
                time.sleep(0.01)

    with socket.create_server(("127.0.0.1", 0)) as server, socket.socket(type=socket.SOCK_DGRAM) as link:
        port = server.getsockname()[1]
        server.settimeout(20)
        source = {"udp": f"udp:{port}", "tcp": f"tcp:127.0.0.1:{port}", "-": "-"}[kind]
        with live([source, *WORDS], tmp_path, stdin=subprocess.PIPE if kind == "-" else subprocess.DEVNULL) as process:
            try:
                if kind == "tcp":
                    with server.accept()[0] as other:
                        send(other.sendall)
                elif kind == "udp":
                    assert listening(port)
                    link.connect(("127.0.0.1", port))
                    send(link.send)
                else:
                    send(lambda line: (process.stdin.write(line.decode()), process.stdin.flush()))
            except (BrokenPipeError, ConnectionError):
                pass  # it was enough
            assert process.ended() in (0, 2), process.text
    same_as_sent(tmp_path, recording)


def listening(port: int) -> bool:
    """Wait until somebody is bound to the port of datagrams."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        if any(line.split()[1].endswith(f":{port:04X}") for line in Path("/proc/net/udp").read_text().splitlines()[1:]):
            return True
        time.sleep(0.02)
    return False


def test_a_wrong_baud_rate_is_said_and_leaves_no_file(tmp_path):
    with device([NOISE] * 3000, 500) as unit, live([f"serial:{unit.port}@9600", *WORDS], tmp_path) as process:
        assert process.ended() == 2
    assert len(process.lines) == 1
    assert "the baud rate is probably another: try @9600 @57600" in process.text
    assert not (tmp_path / "rec.csv").exists()


def test_an_unknown_format_shows_its_lines_and_offers_a_layout(tmp_path):
    lines = [f"{10 * k} 0.01 -0.02 {0.99 + 0.001 * (k % 3)}\n".encode() for k in range(3000)]
    with device(lines, 400) as unit, live([f"serial:{unit.port}", *WORDS], tmp_path) as process:
        assert process.ended() == 2
    assert process.lines[-1][1].startswith(f"imulab: serial:{unit.port}@115200: unknown format: ")
    assert 'accel_z = { from = 3, unit = "g" }' in process.text
    assert "save it as layout.toml, and add --layout layout.toml" in process.text
    assert not (tmp_path / "rec.csv").exists()


@pytest.mark.slow
def test_a_stream_that_stops_is_said_and_what_came_is_kept(tmp_path):
    recording = tumble()
    with device(lines_of(recording)[:3200], 800) as unit:
        words = [f"serial:{unit.port}", "--plain", "--save", "rec.csv"]
        with live(words, tmp_path) as process:
            assert process.said(f"nothing has come from serial:{unit.port}@115200 for 3 s") < float("inf")
            assert process.running
            process.send(signal.SIGINT)
            assert process.ended() == 130
    assert "rec.csv keeps" in process.lines[-1][1]
    same_as_sent(tmp_path, recording, unit)


@pytest.mark.slow
def test_a_full_disk_is_one_sentence_and_keeps_whole_lines(tmp_path):
    limit = 100_000
    recording = tumble()

    def fill() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    with device(lines_of(recording), 800) as unit:
        words = [f"serial:{unit.port}", "--plain", "--save", "rec.csv"]
        with live(words, tmp_path, preexec_fn=fill) as process:
            assert process.ended() == 2
    assert process.lines[-1][1].startswith("imulab: rec.csv: cannot be written on: ")
    assert process.lines[-1][1].endswith("what came before is kept, and --resume goes on with it")
    assert (tmp_path / "rec.csv").stat().st_size <= limit
    assert (tmp_path / "rec.csv").read_bytes()[-1:] == b"\n"
    same_as_sent(tmp_path, recording, unit)


def test_a_session_without_a_usable_row_says_so(imulab_process, tmp_path):
    titles = "time [s],accel_x [g],accel_y [g],accel_z [g]\n"
    done = imulab_process("live", "-", "--plain", "--save", "l.csv", "-o", "l.json", stdin=titles)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == "imulab: l.csv: not written, as no row of readings came that could be used"
    assert not list(tmp_path.glob("l.*"))


@pytest.mark.slow
def test_a_stream_faster_than_its_reader_fills_no_memory(tmp_path):
    whole = b"".join(msp(2, 400)[0]) * 50
    with live(["-", "--plain", "--save", "rec.csv"], tmp_path, stdin=subprocess.PIPE) as process:
        enough = threading.Event()

        def flood() -> None:
            try:
                while not enough.is_set():
                    process.stdin.buffer.write(whole)
            except OSError:
                pass

        threading.Thread(target=flood, daemon=True).start()
        assert process.said("MSP RAW_IMU") < float("inf"), process.text
        time.sleep(3.0)
        assert process.peak_memory() < 300e6  # 924 MB within 6 s where all of it was kept
        enough.set()

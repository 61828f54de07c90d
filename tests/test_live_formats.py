"""Formats of streams: recognised unaided, equal to what was sent, and losing only what damage hits."""

from __future__ import annotations

import json
import os
import threading
import tomllib
from collections.abc import Callable

import numpy as np
import pytest

from imulab.errors import OptionError, ReadError
from imulab.live.formats import STRAIGHTENED, LineStream, UnknownFormatError
from imulab.live.sources import open_source
from imulab.readers import Layout, load_layout
from imulab.recording import Recording
from streams import drawn, mavlink, motioncal, msp, native, terminal, ximu3

pytest.importorskip("pymavlink", reason="pymavlink is in the extra [live]")
FORMATS: dict[str, Callable[[], tuple[list[bytes], dict[str, np.ndarray]]]] = {
    "titles with units": native,
    "MotionCal Raw:": motioncal,
    "x-IMU3 ASCII": ximu3,
    "MAVLink HIGHRES_IMU": lambda: mavlink("HIGHRES_IMU", 2),
    "MAVLink SCALED_IMU": lambda: mavlink("SCALED_IMU", 1),
    "MAVLink SCALED_IMU2": lambda: mavlink("SCALED_IMU2", 2),
    "MAVLink SCALED_IMU3": lambda: mavlink("SCALED_IMU3", 2),
    "MAVLink RAW_IMU": lambda: mavlink("RAW_IMU", 1),
}


def decoded(pieces: list[bytes], layout: Layout | None = None, step: float = 0.01) -> tuple[LineStream, Recording]:
    """Feed pieces at a steady pace, and join what comes out."""
    stream = LineStream("device", layout)
    blocks = [block for k, piece in enumerate(pieces) for block in stream.feed(piece, k * step)]
    blocks += stream.finish()
    columns = {name: np.concatenate([block.columns[name] for block in blocks]) for name in blocks[0].columns}
    return stream, Recording(columns, blocks[0].units, blocks[0].metadata)


@pytest.mark.parametrize("name", FORMATS)
def test_each_is_recognised_and_equals_what_was_sent(name):
    pieces, sent = FORMATS[name]()
    stream, found = decoded(pieces)
    assert stream.format == name
    for column, values in sent.items():
        np.testing.assert_allclose(found.columns[column], values, rtol=1e-15, atol=0)
    assert (stream.counts.damaged, stream.counts.lost) == (0, 0)


@pytest.mark.parametrize("name", FORMATS)
def test_pieces_may_be_cut_anywhere(name):
    pieces, sent = FORMATS[name]()
    whole = b"".join(pieces)
    cuts = np.sort(drawn().integers(0, len(whole), 300)).tolist()
    parts = [whole[a:b] for a, b in zip([0, *cuts], [*cuts, len(whole)], strict=True)]
    _, found = decoded(parts)
    np.testing.assert_allclose(found.columns["accel_y"], sent["accel_y"], rtol=1e-15)


@pytest.mark.parametrize("name", FORMATS)
def test_damage_loses_only_what_it_hits(name):
    pieces, sent = FORMATS[name]()
    hit = [100, 101, 170, 260, 333]
    marks = [k for k, piece in enumerate(pieces) if len(piece) == len(pieces[100]) or piece[:1] in b"IR0123456789"]
    number = {k: sum(other <= k for other in _samples(name, pieces)) - 1 for k in hit}
    assert marks
    damaged = list(pieces)
    for k in hit:
        damaged[k] = damaged[k][: len(damaged[k]) // 2]  # cut, so that the next follows in its middle
        if name[:3] != "MAV":
            damaged[k] += b"\x00\xff\x80\n"  # the end of the line came, after bytes of noise
    stream, found = decoded(damaged)
    gone = {number[k] for k in hit if k in _samples(name, pieces)}
    kept = [k for k in range(len(sent["accel_x"])) if k not in gone]
    np.testing.assert_allclose(found.columns["accel_x"], sent["accel_x"][kept], rtol=1e-15)
    assert stream.counts.damaged >= 4
    if "time" in sent:
        assert stream.counts.lost == len(gone)


def _samples(name: str, pieces: list[bytes]) -> list[int]:
    """Which of the pieces hold a sample of the accelerometers."""
    if name.startswith("MAVLink"):
        return [k for k in range(len(pieces)) if k % 41]
    return [k for k, piece in enumerate(pieces) if piece[:1] not in (b"t", b"M", b"T")]


def test_garbage_between_messages_of_mavlink_loses_none():
    pieces, sent = mavlink("HIGHRES_IMU", 2)
    for k in (60, 160, 250):
        pieces[k] += bytes(drawn().integers(0, 256, 40).tolist()) + b"\xfd\xfe\xff"
    stream, found = decoded(pieces)
    np.testing.assert_array_equal(found.columns["gyro_z"], sent["gyro_z"])
    assert stream.counts.damaged >= 3


@pytest.mark.parametrize("version", [1, 2])
def test_msp_is_asked_for(version):
    frames, sent = msp(version)
    stream = LineStream("serial:x", polled=True)
    blocks, now, waiting = [], 0.0, list(frames)
    asked = []
    while waiting:
        now += 0.01
        blocks += stream.feed(waiting.pop(0) if asked and asked[-1] == len(waiting) else b"", now)
        if stream.to_send:
            assert stream.to_send == b"$M<\x00\x66\x66"
            asked.append(len(waiting))
    blocks += stream.finish()
    assert stream.format == "MSP RAW_IMU"
    np.testing.assert_array_equal(np.concatenate([b.columns["gyro_x"] for b in blocks]), sent["gyro_x"])
    assert blocks[0].units["accel_x"] == "count"


def test_what_speaks_by_itself_is_not_asked():
    pieces, _ = motioncal()
    stream = LineStream("serial:x", polled=True)
    for k, piece in enumerate(pieces):
        stream.feed(piece, 0.01 * k)
        assert not stream.to_send


TITLES = b"time [ms],accel_x [g],accel_y [g],accel_z [g]\n"


def test_titles_that_come_again_in_another_order_are_followed():
    rows = [f"{10 * k},1,2,{k}\n".encode() for k in range(600)]
    rows[300:] = [f"{10 * k},2,1,{k}\n".encode() for k in range(300, 600)]
    again = b"time [ms],accel_y [g],accel_x [g],accel_z [g]\n"
    stream, found = decoded([TITLES, *rows[:300], again, *rows[300:]])
    np.testing.assert_array_equal(found.columns["accel_x"], 1)
    np.testing.assert_array_equal(found.columns["accel_y"], 2)
    assert stream.counts.damaged == 0
    cut = [TITLES, *rows[:300], b"time [ms],accel_x [g]\n", TITLES[:-3] + b"\n", *rows[:300]]
    assert decoded(cut)[0].counts.damaged == 2


def test_titles_that_become_others_end_the_stream_with_one_line():
    rows = [f"{10 * k},1,2,{k}\n".encode() for k in range(600)]
    stream, found = decoded([TITLES, *rows[:300], TITLES.replace(b"[g]", b"[m/s^2]"), *rows[300:]])
    assert stream.over.startswith("device: the stream's titles have changed from 'time [ms],accel_x [g],")
    assert stream.over.endswith(": expected the same columns and units to the end")
    assert len(found) == 300


def test_titles_of_a_layout_that_come_again_in_another_order_are_followed(tmp_path):
    (tmp_path / "l.toml").write_text(
        'delimiter = ","\n[columns]\n'
        + "".join(f'accel_{a} = {{ from = "a{a}", unit = "g" }}\n' for a in "xyz")
        + 'time = { from = "t", unit = "s" }\n'
    )
    rows = [b"t,ax,ay,az\n", *(f"{k / 100},1,2,3\n".encode() for k in range(300))]
    rows += [b"t,az,ay,ax\n", *(f"{k / 100},3,2,1\n".encode() for k in range(300, 600))]
    stream, found = decoded(rows, load_layout(tmp_path / "l.toml"))
    np.testing.assert_array_equal(found.columns["accel_x"], 1)
    assert (len(found), stream.counts.damaged) == (600, 0)


@pytest.mark.slow
def test_arrival_times_are_straightened(reduced):
    """Ten streams of 10 s: the rate of one scatters by .2 %, as late as its first and last samples happen to come."""
    trials = 4 if reduced else 10
    pieces, _ = motioncal(1000)
    rates = []
    for seed in range(trials):
        stream, late = LineStream("device"), np.random.default_rng(seed).exponential(0.02, 1000)
        late[500] = 0.4  # a driver that slept
        arrivals = np.maximum.accumulate(0.01 * np.arange(1000) + late)
        blocks = [b for piece, t in zip(pieces, arrivals.tolist(), strict=True) for b in stream.feed(piece, t)]
        time = np.concatenate([block.columns["time"] for block in blocks])
        assert blocks[0].metadata["time"] == STRAIGHTENED
        assert np.diff(time).min() > 0
        # What a straight line leaves of the times is a third at most of what it leaves of the arrivals.
        assert _about_a_line(time) < _about_a_line(arrivals) / 3
        assert stream.counts.gaps == 0
        rates.append((time[-1] - time[0]) / (len(time) - 1) / 0.01)
    assert abs(np.mean(rates) - 1) < 5e-3
    assert np.std(rates) < 5e-3


def _about_a_line(times: np.ndarray) -> float:
    number = np.arange(len(times))
    return float(np.std(times - np.polyval(np.polyfit(number, times, 1), number)))


def test_a_pause_without_stamps_is_a_gap():
    pieces, _ = motioncal(800)
    stream = LineStream("device")
    arrivals = [0.01 * k + 3.0 * (k >= 500) for k in range(800)]
    blocks = [b for piece, t in zip(pieces, arrivals, strict=True) for b in stream.feed(piece, t)]
    time = np.concatenate([block.columns["time"] for block in blocks])
    assert np.diff(time).max() == pytest.approx(3.0, abs=0.1)
    assert (stream.counts.gaps, abs(stream.counts.lost - 300) < 5) == (1, True)


LAYOUT = """delimiter = ","
prefix = "IMU"
[columns]
time = { from = 0, unit = "ms" }
accel_x = { from = 1, unit = "mg" }
accel_y = { from = 2, unit = "mg" }
accel_z = { from = 3, unit = "mg", scale = 0.5 }
"""


def test_layouts_of_text_with_a_prefix(tmp_path):
    (tmp_path / "l.toml").write_text(LAYOUT)
    rows = [f"IMU,{10 * k},{k},{-k},{2 * k}\nGPS,1,2,3\n".encode() for k in range(300)]
    stream, found = decoded(rows, load_layout(tmp_path / "l.toml"))
    np.testing.assert_array_equal(found.columns["accel_z"], np.arange(300.0))
    np.testing.assert_array_equal(found.si("time"), np.arange(300) * 10 * 1e-3)
    assert stream.counts.damaged == 0


def test_json_lines_through_a_layout(tmp_path):
    (tmp_path / "l.toml").write_text(
        '[columns]\naccel_x = { from = "a.x", unit = "g" }\naccel_y = { from = "a.y", unit = "g" }\n'
        'accel_z = { from = "a.z", unit = "g" }\ntime = { from = "t", unit = "s" }\n'
    )
    rows = [json.dumps({"t": k / 100, "a": {"x": k, "y": 1, "z": 2}}).encode() + b"\n" for k in range(300)]
    rows[150] = b'{"t": 1.5, "a": {"x"\n'
    stream, found = decoded(rows, load_layout(tmp_path / "l.toml"))
    assert len(found) == 299
    assert found.columns["accel_x"][-1] == 299.0
    assert stream.counts.damaged == 1


def test_unknown_lines_are_shown_with_a_guess_that_works(tmp_path):
    rows = [f"IMU,{20 * k},{0.02 * (k % 3)},0.01,0.99,{k % 5},0.1,0.2\n".encode() for k in range(300)]
    with pytest.raises(UnknownFormatError, match=r"device: unknown format: 'IMU,20,.*--layout") as caught:
        decoded(rows, step=0.02)
    assert caught.value.lines
    guess = caught.value.guess
    assert guess is not None
    columns = tomllib.loads(guess.toml)["columns"]
    assert (columns["time"]["unit"], columns["accel_z"]) == ("ms", {"from": 3, "unit": "g"})
    (tmp_path / "guess.toml").write_text(guess.toml)
    _, found = decoded(rows, load_layout(tmp_path / "guess.toml"))
    np.testing.assert_array_equal(found.columns["accel_z"], 0.99)
    assert found.units["gyro_x"] == "deg/s"


def test_a_guess_of_json_lines():
    rows = [json.dumps({"ms": 10 * k, "acc": [0.1, 9.8, 0.2]}).encode() + b"\n" for k in range(300)]
    with pytest.raises(UnknownFormatError) as caught:
        decoded(rows)
    assert caught.value.guess is not None
    assert tomllib.loads(caught.value.guess.toml)["columns"]["accel_y"] == {"from": "acc.1", "unit": "m/s^2"}


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (bytes(drawn().integers(128, 255, 4000).tolist()), "garbage: .* baud rate is probably another"),
        (b"\0" * 3000, "garbage"),
        (b"x" * 3000, "no line of text has an end"),
        (b"hello\nworld\n" * 100, "unknown format: 'world'"),
    ],
)
def test_what_is_no_format_is_said_in_one_line(data, said):
    stream = LineStream("serial:/dev/ttyUSB0@115200")
    stream.feed(data[:10], 0.0)
    with pytest.raises(ReadError, match=said) as caught:
        stream.feed(data[10:], 2.1)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", FORMATS)
def test_each_over_a_pseudo_terminal(name, monkeypatch):
    if name != "titles with units":  # one waits the whole two seconds
        monkeypatch.setattr("imulab.live.formats.FIRST", 0.3)
    pytest.importorskip("serial", reason="pyserial is in the extra [live]")
    pieces, sent = FORMATS[name]()
    with terminal() as (device, port):
        source = open_source(f"serial:{port}")
        try:

            def write():
                for piece in pieces:
                    os.write(device, piece)

            threading.Thread(target=write, daemon=True).start()
            stream, blocks, rows = LineStream(source.name, polled=True), [], 0
            end = source.now() + 8
            while rows < len(sent["accel_x"]) and source.now() < end:
                for arrived in source.get(0.05):
                    blocks += stream.feed(arrived.data, arrived.time)
                blocks += stream.feed(b"", source.now())
                rows = sum(map(len, blocks))
        finally:
            source.close()
    assert stream.format == name
    for column in sent:
        found = np.concatenate([block.columns[column] for block in blocks])
        np.testing.assert_allclose(found, sent[column], rtol=1e-15)


def test_a_counter_of_stated_width_is_carried_on_in_a_stream(tmp_path):
    """20 bits of ms wrap after 17.5 minutes, which no guess would find."""
    layout = tmp_path / "l.toml"
    layout.write_text(
        'delimiter = ","\n[columns]\ntime = { from = 0, unit = "ms", bits = 20 }\n'
        + "".join(f'accel_{axis} = {{ from = {k}, unit = "g" }}\n' for k, axis in enumerate("xyz", start=1))
    )
    stamps = (2**20 - 2000 + 10 * np.arange(600)) % 2**20
    stream = LineStream("device", load_layout(layout))
    blocks = []
    for k in range(0, 600, 10):
        rows = "".join(f"{stamp},0,0,1\n" for stamp in stamps[k : k + 10])
        blocks += stream.feed(rows.encode(), 0.1 * k)
    blocks += stream.finish()
    assert np.diff(np.concatenate([block.column("time") for block in blocks])) == pytest.approx(10)
    assert (stream.counts.restarts, stream.counts.lost) == (0, 0)


def test_a_stream_takes_no_packets(tmp_path):
    layout = tmp_path / "l.toml"
    columns = 'time = { from = 0, unit = "ms" }\naccel_x = { from = 1, unit = "g" }\n'
    layout.write_text(f'delimiter = ","\npacket = "last"\n[columns]\n{columns}')
    stream = LineStream("device", load_layout(layout))
    stream.feed(b"1,2\n" * 100, 0.0)
    with pytest.raises(OptionError, match="takes no packets"):
        stream.feed(b"1,2\n" * 100, 3.0)


@pytest.mark.parametrize("unit", ["g", "m/s^2"])
def test_stated_units_stand_for_those_of_a_stream(unit):
    pieces, sent = native()
    stream = LineStream("device", units={"accel": unit, "time": "ms"})
    blocks = [block for k, piece in enumerate(pieces) for block in stream.feed(piece, 0.01 * k)]
    assert {blocks[0].units[f"accel_{axis}"] for axis in "xyz"} == {unit}
    assert blocks[0].units["time"] == "ms"
    np.testing.assert_array_equal(
        np.concatenate([block.columns["accel_x"] for block in blocks]), sent["accel_x"][: sum(map(len, blocks))]
    )
    wrong = LineStream("device", units={"pressure": "g"})
    with pytest.raises(OptionError, match=r"device: unit of pressure: no such column"):
        [wrong.feed(piece, 0.01 * k) for k, piece in enumerate(pieces)]


def test_a_stated_unit_is_used_in_the_layout_that_is_offered():
    lines = b"".join(b"%d,%.3f,0.1,0.2,0.01,0.02,0.03\n" % (10 * k, 9.8 + 1e-3 * (k % 7)) for k in range(400))
    stream = LineStream("device", units={"gyro": "rad/s"})
    with pytest.raises(UnknownFormatError) as caught:
        stream.feed(b"t,ax,ay,az,gx,gy,gz\n" + lines, 0.0), stream.feed(b"", 3.0)
    assert caught.value.guess is not None
    assert 'gyro_x = { from = "gx", unit = "rad/s" }' in caught.value.guess.toml
    assert "supposed" not in " ".join(caught.value.guess.supposed)


def test_a_clock_that_stands_still_among_shared_stamps_is_refused(monkeypatch):
    monkeypatch.setattr("imulab.live.formats._MOST_WAITING", 500)
    stream = LineStream("device")
    rows = b"".join(b"7,1,0,%d\n" % k for k in range(2000))
    with pytest.raises(ReadError, match=r"device: time stands still at 7 ms for more than 500 samples"):
        stream.feed(b"time [ms],accel_x [g],accel_y [g],accel_z [g]\n" + rows, 0.0), stream.feed(b"", 3.0)

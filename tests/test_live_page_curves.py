"""Curves of a recording for a screen, against minimum and maximum of the samples themselves."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from benchpage import PATIENCE
from imulab.live.page import contents, curves
from imulab.live.page.curves import BUCKET, Writer, statistics, view
from imulab.recording import Recording


def recording(rows, *, seed=1, step=1e-3):
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.5, 1.5, rows)) * step
    columns = {"time": time, "accel_x": rng.normal(size=rows), "gyro_x": np.cumsum(rng.normal(size=rows))}
    columns["gyro_x"][rng.integers(0, rows, rows // 50)] = np.nan
    return Recording(columns, {"time": "s", "accel_x": "g", "gyro_x": "deg/s"})


def written(given, folder, sizes=(1000,)):
    """Write a recording in blocks of these sizes."""
    writer, row, number = Writer(folder), 0, 0
    while row < len(given):
        size = sizes[number % len(sizes)]
        writer.add(replace(given, columns={name: values[row : row + size] for name, values in given.columns.items()}))
        row, number = row + size, number + 1
    return writer.head


@pytest.mark.parametrize("sizes", [(1000,), (7, 300, 5000), (10**9,)])
@pytest.mark.parametrize("part", [None, (0.2, 0.7), (0.5, 0.5004), (-3, 0.001), (0.999, 9)])
@pytest.mark.parametrize("fine", [10**9, 1000], ids=["samples", "buckets"])
def test_each_column_of_pixels_has_the_extremes_of_its_samples(tmp_path, monkeypatch, sizes, part, fine):
    monkeypatch.setattr(curves, "_FINE", fine)
    given = recording(20_011)
    head = written(given, tmp_path, sizes)
    time = given.columns["time"]
    start, stop = (None, None) if part is None else (time[-1] * part[0], time[-1] * part[1])
    found = view(tmp_path, head, start, stop, 100)
    inside = np.ones(len(time), bool) if part is None else (time >= start) & (time <= stop)
    assert found.rows[0] <= np.flatnonzero(inside)[0]
    assert found.rows[-1] > np.flatnonzero(inside)[-1]
    assert 2 <= len(found.at) <= 202
    assert (np.diff(found.rows) > 0).all()
    for name in ("accel_x", "gyro_x"):
        pieces = [given.columns[name][a:b] for a, b in zip(found.rows, found.rows[1:], strict=False)]
        pieces = [piece[~np.isnan(piece)] for piece in pieces]
        for extreme, values in ((np.min, found.low), (np.max, found.high)):
            assert np.array_equal(values[name], [extreme(p) if len(p) else np.nan for p in pieces], equal_nan=True)
    assert np.array_equal(found.at, time[found.rows[:-1]])
    assert np.array_equal(found.until, time[found.rows[1:] - 1])


def test_a_narrow_range_shows_every_sample(tmp_path):
    given = recording(50_000)
    head = written(given, tmp_path)
    time = given.columns["time"]
    found = view(tmp_path, head, time[30_000], time[30_100], 800)
    assert found.rows.tolist() == list(range(29_999, 30_103))
    assert (
        found.low["accel_x"].tolist()
        == found.high["accel_x"].tolist()
        == given.columns["accel_x"][29_999:30_102].tolist()
    )


def test_columns_of_pixels_are_of_equal_time(tmp_path):
    given = recording(100_000)
    found = view(tmp_path, written(given, tmp_path), None, None, 50)
    span = found.until[-1] - found.at[0]
    assert np.abs((found.at - found.at[0]) / span * 50 - np.arange(50)).max() < 0.01


def test_gaps_are_told_and_break_the_curves(tmp_path):
    time = np.concatenate([np.arange(0, 10, 0.01), np.arange(13, 20, 0.01), np.arange(20.2, 30, 0.01)])
    given = Recording({"time": time, "accel_x": np.sin(time)}, {"time": "s", "accel_x": "g"})
    for number, sizes in enumerate([(300,), (1000,), (5000,)]):
        folder = tmp_path / str(number)
        folder.mkdir()
        head = written(given, folder, sizes)
        assert head.gap_count == 1  # 0.2 s is none
        assert head.gaps == [(pytest.approx(9.99), 13.0)]
        found = view(folder, head, None, None, 100)
        assert found.at[found.breaks].tolist() == [13.0]
        found = view(folder, head, 9.5, 13.5, 1000)
        assert found.at[found.breaks].tolist() == [13.0]


@pytest.mark.parametrize("time", [None, [0.0, 1, 2, 1.5, 3], [0, 1, np.nan, 3, 4], [0, np.inf, 2, 3, 4]])
@pytest.mark.parametrize("size", [1, 2, 10])
def test_without_rising_time_rows_are_shown(tmp_path, time, size):
    columns = {"accel_x": np.arange(5.0)} | ({} if time is None else {"time": np.array(time, float)})
    head = written(Recording(columns, {"accel_x": "g", "time": "s"}), tmp_path, (size,))
    assert (head.timed, head.rows, head.first, head.last) == (False, 5, 1.0, 5.0)
    found = view(tmp_path, head, None, None, 100)
    assert found.at.tolist() == [1, 2, 3, 4, 5]
    assert view(tmp_path, head, 2.5, 3.5, 100).at.tolist() == [2, 3, 4]
    assert found.low["accel_x"].tolist() == [0, 1, 2, 3, 4]


def test_what_is_written_so_far_can_be_viewed(tmp_path):
    writer, seen = Writer(tmp_path), []
    given = recording(3000)
    for row in range(0, 3000, 500):
        writer.add(replace(given, columns={name: values[row : row + 500] for name, values in given.columns.items()}))
        found = view(tmp_path, writer.head, None, None, 50)
        seen.append(int(found.rows[-1]))
    assert seen == [500, 1000, 1500, 2000, 2500, 3000]


def test_nothing_is_a_view_of_nothing(tmp_path):
    writer = Writer(tmp_path)
    assert view(tmp_path, writer.head, None, None, 100).at.tolist() == []


def test_memory_is_that_of_a_block(tmp_path):
    writer = Writer(tmp_path)
    writer.add(recording(100_000))
    assert sum(map(len, writer._rest)) < 2 * BUCKET


def test_contents_tell_of_a_file_and_its_attitudes(tmp_path):
    file = tmp_path / "tumble.csv"
    il.write_csv(il.simulate_tumble(attitudes=6, gravity=9.81), file)
    (tmp_path / "curves").mkdir()
    *heads, last = contents.contents(str(file), tmp_path / "curves", {})
    assert heads[-1]["done"]
    assert heads[-1]["head"]["rows"] == len(il.read(file))
    assert heads[-1]["metadata"]["serial"] == "SIM-0001"
    attitudes = il.find_attitudes(file)
    assert last["attitudes"] == np.column_stack([attitudes.start, attitudes.stop]).tolist()


@pytest.mark.parametrize(
    ("text", "reading", "said"),
    [
        ("time [s],accel_x [g]\n0,1\nx,2\n", {}, "row 2 (line 3), column time"),
        ("a,b\n1,2\n", {"window": "5:1"}, "window 5:1"),
        ("a,b\n1,2\n", {"element": "x"}, "--element 'x'"),
        ("", {}, "empty"),
    ],
)
def test_what_cannot_be_read_is_a_sentence(tmp_path, text, reading, said):
    file = tmp_path / "rec.csv"
    file.write_text(text)
    words = [sys.executable, "-m", "imulab.live.page.contents", str(file), str(tmp_path), json.dumps(reading)]
    ran = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert ran.returncode == 2
    assert ran.stderr == ""
    assert said in next(filter(None, (json.loads(line).get("error") for line in ran.stdout.splitlines())))


@pytest.mark.parametrize("rows", [100, 120_000], ids=["within the first block", "beyond it"])
def test_of_a_file_that_breaks_the_rows_before_are_shown(tmp_path, rows):
    file = tmp_path / "tumble.csv"
    il.write_csv(il.simulate_tumble(attitudes=6, hold="1 s", gravity=9.81), file)
    lines = file.read_text().splitlines()
    head = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    values = lines[head + 1].partition(",")[2]
    whole = [*lines[: head + 1], *(f"{0.01 * k:.2f},{values}" for k in range(rows))]
    file.write_text("\n".join([*whole, f"{0.01 * rows:.2f},broken"]) + "\n")
    (tmp_path / "curves").mkdir()
    *heads, last = contents.contents(str(file), tmp_path / "curves", {})
    assert f"row {rows + 1} (line {len(whole) + 1})" in heads[-1]["error"]
    assert heads[-1]["done"]
    assert heads[-1]["head"]["rows"] == rows
    assert heads[-1]["head"]["last"] == pytest.approx(0.01 * (rows - 1))
    assert heads[-1]["metadata"]["serial"] == "SIM-0001"
    assert "attitudes" in last
    assert sorted(path.suffix for path in (tmp_path / "curves").iterdir() if path.suffix == ".csv") == []


def test_statistics_are_those_of_the_samples_of_the_range(tmp_path):
    given = recording(20_000)
    head = written(given, tmp_path)
    time = given.columns["time"]
    found = statistics(tmp_path, head, time[2000], time[9000])
    for name in ("accel_x", "gyro_x"):
        values = given.columns[name][2000:9001]
        values = values[np.isfinite(values)]
        assert found.mean[name] == pytest.approx(values.mean(), rel=1e-12)
        assert found.sigma[name] == pytest.approx(values.std(ddof=1), rel=1e-12)
    assert found.rows == 7001
    assert "gyro_x" not in found.density  # it has gaps
    empty = statistics(tmp_path, head, time[-1] + 1, time[-1] + 2)
    assert (empty.rows, len(empty.frequencies)) == (0, 0)
    assert np.isnan(empty.mean["accel_x"])


def test_a_spectrum_has_the_level_of_white_noise_and_the_power_of_a_line(tmp_path):
    rate, rows = 200.0, 40_000
    rng = np.random.default_rng(3)
    time = np.arange(rows) / rate
    tone = 0.5 * np.sin(2 * np.pi * 20.0 * time)
    columns = {"time": time, "accel_x": rng.normal(scale=0.1, size=rows), "accel_y": tone}
    head = written(Recording(columns, {"time": "s", "accel_x": "g", "accel_y": "g"}), tmp_path)
    found = statistics(tmp_path, head, None, None)
    inner = (found.frequencies > 1) & (found.frequencies < 90)
    assert found.density["accel_x"][inner].mean() == pytest.approx(2 * 0.1**2 / rate, rel=0.1)  # one-sided
    peak = found.frequencies[np.argmax(found.density["accel_y"])]
    assert peak == pytest.approx(20.0, rel=0.02)
    assert np.isfinite(found.density["accel_y"]).all()

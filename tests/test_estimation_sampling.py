"""Sampling rates, units of time, and rows without numbers."""

from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.display import Finding, Note
from imulab.errors import DataError
from imulab.estimation.column_noise import analyse
from imulab.estimation.sampling import bridged, sampling_rate, steady_part
from imulab.recording import Recording


def noise(time, unit="s", seed=1):
    samples = np.random.default_rng(seed).standard_normal(len(time))
    return Recording({"time": time, "gyro_x": samples}, {"time": unit, "gyro_x": "deg/s"}, name="r.csv", lines_before=1)


@pytest.mark.parametrize(
    ("step", "unit", "said"),
    [
        (10.0, "s", "10 s from row to row (0.1 Hz): is the unit of time right: 100 Hz if it is in ms?"),
        (1e4, "s", "1e+04 s from row to row (0.0001 Hz): is the unit of time right: 100 Hz if it is in us?"),
        (2.0, "s", "500 Hz if it is in ms"),
        (1.0, "s", "1000 Hz if it is in ms"),
        (0.005, "ms", "200 Hz if it is in s"),
        (0.01, "s", ""),
        (10.0, "ms", ""),
        (100.0, "us", ""),
        (0.1, "s", ""),
        (0.2, "s", "5000 Hz if it is in ms"),
        (0.19, "s", ""),
        (1 / 32_000, "s", ""),
        (1 / 32, "ms", "32 Hz if it is in s"),
        (1 / 50_000, "s", "(5e+04 Hz): is the unit of time right?"),
        (200.0, "s", "(0.005 Hz): is the unit of time right: 5 Hz if it is in ms or 5000 Hz if it is in us?"),
    ],
)
def test_a_unit_of_time_that_cannot_be_right_is_said(step, unit, said):
    _, notes = sampling_rate(noise(np.arange(100_000) * step, unit))
    assert len(notes) == bool(said)
    assert said in "".join(notes)


@pytest.mark.parametrize(
    ("step", "unit", "likely"),
    [(200.0, "s", "5 Hz if it is in ms"), (0.1, "ms", "10 Hz if it is in s"), (1 / 300, "min", None), (0.2, "s", None)],
)
def test_a_unit_is_named_only_if_rate_and_duration_are_likely_then(step, unit, likely):
    """Of 1000 samples: 5000 Hz would be over in 0.2 s, and who logs 10 kHz logs for longer than 0.1 s."""
    _, notes = sampling_rate(noise(np.arange(1000) * step, unit))
    assert [line.partition("right: ")[2].partition("?")[0] for line in notes] == ([likely] if likely else [])


@pytest.mark.parametrize(
    ("start", "step", "kind"), [(0, 0.4, Note), (1.7e9, 0.4, Note), (1.7e12, 0.4, Finding), (0, 0.5, Finding)]
)
def test_a_slow_log_is_only_asked_for_its_unit_of_time_unless_its_dates_are_to_come(start, step, kind):
    _, (line,) = sampling_rate(noise(start + np.arange(100_000) * step))
    assert isinstance(line, Finding)
    assert isinstance(line, Note) == (kind is Note)


def test_a_unit_of_time_that_was_stated_is_not_asked_for(tmp_path):
    """Of samples at 1 kHz in ms titled s every figure would be wrong; who states s has answered that."""
    slow = noise(np.arange(12_000.0))
    slow = slow.with_columns({"gyro_x": 0.01 * slow.column("gyro_x")}, {})
    assert il.fit_noise(slow).calibration.verdict.state == "look"
    assert sampling_rate(replace(slow, time_stated=True))[1] == []
    assert sampling_rate(il.Recording.from_arrays(gyro_x=slow.column("gyro_x"), rate=1.0, unit="deg/s"))[1] == []
    il.write(slow, tmp_path / "r.csv")
    assert sampling_rate(il.read(tmp_path / "r.csv", units={"time": "s"}))[1] == []
    (line,) = sampling_rate(il.read(tmp_path / "r.csv"))[1]
    assert "1000 Hz if it is in ms" in line


@pytest.mark.parametrize("split", [0.3, 0.5, 0.8])
def test_a_rate_that_changes_is_said_and_the_longest_steady_part_counts(split):
    n = 20_000
    step = np.where(np.arange(n) < split * n, 0.01, 0.005)
    changed = noise(np.cumsum(step))
    found = analyse(changed)
    (line,) = [w for w in found["warnings"] if "sampling rate changes near row" in w]
    for rate in ("100 Hz", "200 Hz"):
        assert rate in line
    longest = max(split, 1 - split)
    assert found["samples"] == pytest.approx(longest * n, abs=0.011 * n)
    rate = 100.0 if split >= 0.5 else 200.0
    assert found["sample_rate"]["value"] == pytest.approx(rate, rel=1e-6)
    white = found["columns"]["gyro_x"]["angle_random_walk"]
    assert abs(white["value"] - np.radians(1) / np.sqrt(rate)) < 3 * white["standard_uncertainty"]
    assert any("sampling rate changes" in note for note in sampling_rate(changed)[1])


@pytest.mark.parametrize("kind", ["jitter", "coarse stamps", "gap", "burst", "short"])
def test_one_rate_is_one_rate(kind):
    rng = np.random.default_rng(3)
    time = np.arange(20_000) / 130.0
    if kind == "jitter":
        time = time + 0.2 / 130 * rng.uniform(-1, 1, len(time))
    elif kind == "coarse stamps":
        time = np.unique(np.round(time, 2))
    elif kind == "gap":
        time = time + 7.0 * (time > 60)
    elif kind == "burst":
        time = np.delete(time, np.arange(7000, 7100, 2))
    else:
        time = time[:60]
    part, notes = steady_part(noise(time))
    assert notes == []
    assert len(part) == len(time)


def test_a_few_rows_without_numbers_are_bridged_and_counted(imulab, tmp_path):
    recording = noise(np.arange(5000) / 50)
    samples, time = recording.columns["gyro_x"].copy(), recording.columns["time"].copy()
    samples[[99, 100, 3000]] = np.nan
    time[200] = np.nan
    bad = recording.with_columns({"gyro_x": samples, "time": time}, {})
    whole, part = analyse(recording), analyse(bad)
    assert part["samples"] == 4999
    assert part["warnings"][0] == (
        "r.csv: 4 rows without numbers (the first row 100 (line 101)) bridged from their neighbours"
    )
    name = "angle_random_walk"
    assert part["columns"]["gyro_x"][name]["value"] == pytest.approx(
        whole["columns"]["gyro_x"][name]["value"], rel=0.02
    )
    il.write_csv(recording, tmp_path / "r.csv")
    lines = (tmp_path / "r.csv").read_text().splitlines()
    lines[50] = lines[50].split(",")[0] + ",nan"
    (tmp_path / "r.csv").write_text("\n".join(lines) + "\n")
    done = imulab("allan", "r.csv")
    assert done.returncode == 0, done.stderr
    assert "1 row without numbers (row 50 (line 51)) bridged" in done.stderr


def test_many_rows_without_numbers_are_refused():
    recording = noise(np.arange(1000) / 50)
    samples = recording.columns["gyro_x"].copy()
    samples[::50] = np.inf
    with pytest.raises(DataError, match=r"row 1 \(line 2\), column gyro_x: expected a finite number.*and 19 more"):
        bridged(recording.with_columns({"gyro_x": samples}, {}), ["gyro_x"])

"""Elements of an array that answer late: found to a fraction of a sample, said, and kept out of scale factors."""

import re

import numpy as np
import pytest

import imulab as il
from reference.moving_array import columns, moving_array

NOISE = np.radians(0.05)
SAMPLE = 0.01


def recordings(seed, late, axes=1, duration=40.0, spread=0.01, keep=None):
    rng = np.random.default_rng(seed)
    n = len(late)
    sensing = np.eye(axes) + rng.normal(0, spread, (n, axes, axes))
    time = np.arange(0, duration, SAMPLE)
    made = []
    for still in (True, False):
        values = columns(moving_array(rng, time, sensing, late, NOISE, still=still))
        rows = slice(None) if still or keep is None else keep(time)
        data = {"time": time[rows], **{name: column[rows] for name, column in values.items()}}
        units = {name: "s" if name == "time" else "rad/s" for name in data}
        made.append(il.Recording(columns=data, units=units, name="still.csv" if still else "moving.csv"))
    return sensing, made


def found_latency(record):
    listed = [element["latency"] for element in record.sections["elements"]]
    return np.array([[entry["value"], entry["standard_uncertainty"]] for entry in listed]).T


def late_lines(record):
    return [line for line in record.warnings if "come later than" in line]


@pytest.mark.parametrize("axes", [1, 3])
def test_latency_is_found_to_a_fraction_of_a_sample_and_said(axes, reduced):
    trials = 2 if reduced else 4
    late = np.array([0.010, -0.004, 0.0, 0.0, 0.0037, 0.0])
    scores = []
    for seed in range(trials):
        _, (still, moving) = recordings(seed, late, axes)
        record = il.calibrate_array(still, moving).calibration
        value, u = found_latency(record)
        scores.append((value - late) / u)
        assert u.max() < 5e-5
        (line,) = late_lines(record)
        named = re.findall(r"(\d) by ([-+][\d.]+) ms", line)
        assert [number for number, _ in named] == ["1", "2", "5"]
        assert [float(ms) for _, ms in named] == pytest.approx([10, -4, 3.7], abs=0.1)
    assert np.sqrt(np.mean(np.square(scores))) < 1.6


def test_scale_factors_are_right_in_spite_of_latency(reduced):
    trials = 8 if reduced else 25
    inside, errors = [], []
    for seed in range(trials):
        sensing, (still, moving) = recordings(seed, [0.010, -0.020, 0.005, 0.0, 0.0, 0.0], duration=30.0)
        record = il.calibrate_array(still, moving).calibration
        true = sensing[:, 0, 0] / sensing[:, 0, 0].mean()
        found = [record.parameters[f"scale_factor_{i}"] for i in range(1, 7)]
        error = np.array([p.value for p in found]) - true
        inside += (np.abs(error) < 2.09 * np.array([p.standard_uncertainty for p in found])).tolist()
        errors += error.tolist()
    assert 0.88 < np.mean(inside) <= 1.0
    assert np.sqrt(np.mean(np.square(errors))) < 4e-5  # 1,800 ppm as they come


def test_elements_that_are_not_late_are_left_as_they_are(reduced):
    trials = 4 if reduced else 12
    said = 0
    for seed in range(trials):
        _, (still, moving) = recordings(seed, np.zeros(6), duration=20.0)
        said += len(late_lines(il.calibrate_array(still, moving).calibration))
    assert said == 0


def test_a_tenth_of_a_second_is_no_reason_to_refuse_the_motion():
    late = [0.1, 0.0, 0.0, 0.0]
    sensing, (still, moving) = recordings(3, late, axes=3)
    record = il.calibrate_array(still, moving).calibration
    assert found_latency(record)[0] == pytest.approx(late, abs=1e-4)
    inverse = np.array([element["matrix"]["value"] for element in record.sections["elements"]])
    # The frame is the array's own: relative to element 1 it drops out.
    np.testing.assert_allclose(np.linalg.inv(inverse) @ inverse[0], sensing @ np.linalg.inv(sensing[0]), atol=3e-4)


def test_gaps_do_not_disturb_it():
    late = [0.0123, 0.0, 0.0, 0.0]

    def gaps(time):
        return (time % 5.0) > 0.3

    sensing, (still, moving) = recordings(4, late, keep=gaps)
    record = il.calibrate_array(still, moving).calibration
    assert found_latency(record)[0] == pytest.approx(late, abs=1e-4)
    found = np.array([record.value(f"scale_factor_{i}") for i in range(1, 5)])
    np.testing.assert_allclose(found, sensing[:, 0, 0] / sensing[:, 0, 0].mean(), atol=2e-4)


def test_against_a_known_rate_latency_is_absolute():
    late = [0.004, 0.004, 0.004]
    rng = np.random.default_rng(5)
    time = np.arange(0, 40, SAMPLE)
    sensing = np.ones((4, 1, 1))
    readings = moving_array(rng, time, sensing, [*late, 0.0], 1e-6)
    still = {"time": time, **columns(rng.normal(0, NOISE, (len(time), 1, 3)))}
    noisy = readings[:, :, :3] + rng.normal(0, NOISE, (len(time), 1, 3))
    moving = {"time": time, **columns(noisy), "truth_rate": readings[:, 0, 3]}
    made = [
        il.Recording(columns=data, units={n: "s" if n == "time" else "rad/s" for n in data}, name="a.csv")
        for data in (still, moving)
    ]
    record = il.calibrate_array(*made).calibration
    assert found_latency(record)[0] == pytest.approx(late, abs=1e-4)
    assert "come later than the truth" in late_lines(record)[0]

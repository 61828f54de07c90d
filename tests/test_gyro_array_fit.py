"""Calibration of an array's elements against the truth that was put in, its record, and its report."""

import json
import re

import numpy as np
import pytest

import imulab as il
from imulab.errors import DataError, ObservabilityError, RecordError, UnitError
from imulab.procedures.gyro_array import elements, fit
from imulab.procedures.gyro_array.alignment import align, nominal_orientation
from imulab.procedures.gyro_array.fit import calibrate_array
from imulab.procedures.gyro_array.fuse import Fuser, fuse
from imulab.procedures.gyro_array.simulate import NoiseModel, simulate_array
from imulab.procedures.gyro_array.stream import FuseOptions
from imulab.procedures.views import exhibits_of
from imulab.recording import Recording
from reference.moving_array import columns, moving_array
from test_gyro_array_fuse import array_recording

UPSIDE_DOWN = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])


def motion(count: int, axes: int, rng: np.random.Generator) -> np.ndarray:
    """Rates by hand, deg/s, made here apart from the simulator."""
    time = np.arange(count) / 100
    rates = np.zeros((count, axes))
    for frequency in (0.13, 0.31, 0.7):
        rates += 40 * np.sin(
            2 * np.pi * frequency * time[:, None] * (1 + 0.17 * np.arange(axes)) + rng.uniform(0, 6, axes)
        )
    return rates


def array_of(
    seed: int, axes: int, n: int = 5, count: int = 12_000
) -> tuple[Recording, Recording, np.ndarray, np.ndarray]:
    """A still and a moving recording of one array, what its elements sense, and their biases, deg/s."""
    rng = np.random.default_rng(seed)
    sensing = np.eye(axes) + 0.02 * rng.standard_normal((n, axes, axes))
    if axes == 3:
        sensing[1::2] = sensing[1::2] @ UPSIDE_DOWN
    else:
        sensing[1::2] *= -1
    bias = rng.standard_normal((axes, n))
    shape = (count, axes, n)
    still = bias + 0.05 * rng.standard_normal(shape)
    moving = np.einsum("iab,tb->tai", sensing, motion(count, axes, rng)) + bias + 0.05 * rng.standard_normal(shape)
    rate = 100.0
    if axes == 1:
        still, moving = still[:, 0], moving[:, 0]
    return array_recording(still, rate, "still.csv"), array_recording(moving, rate, "moving.csv"), sensing, bias


def in_gauge(sensing: np.ndarray) -> np.ndarray:
    """The truth in the record's frame: the mean over the elements of P_i' A_i is the unit matrix."""
    nominal = np.array([nominal_orientation(a @ np.linalg.inv(sensing[0])) for a in sensing])
    mean = np.mean([p.T @ a for p, a in zip(nominal, sensing, strict=True)], axis=0)
    return sensing @ np.linalg.inv(mean)


@pytest.mark.slow
@pytest.mark.parametrize("axes", [1, 3])
def test_alignment_covers_the_truth(axes, reduced):
    within = []
    for seed in range(4 if reduced else 12):
        still, moving, sensing, bias = array_of(seed, axes)
        record = calibrate_array(still, moving).calibration
        truth = in_gauge(sensing)
        for i, element in enumerate(record.sections["elements"]):
            if axes == 1:
                error = np.array([[element["scale_factor"]["value"]]]) - truth[i]
                u = np.array([[element["scale_factor"]["standard_uncertainty"]]])
            else:
                error = np.array(element["matrix"]["value"]) - np.linalg.inv(truth[i])
                u = np.array(element["matrix"]["standard_uncertainty"])
            assert u.max() < 1e-4
            within += (np.abs(error) < 2 * u).ravel().tolist()
            found = np.degrees(element["bias"]["value"])
            np.testing.assert_allclose(np.atleast_1d(found), bias[:, i], atol=0.003)
    assert 0.9 <= np.mean(within) <= 0.995


def test_the_bias_is_the_plain_mean():
    recording = simulate_array(experiment="static", duration=60.0)
    record = calibrate_array(recording).calibration
    for element in record.sections["elements"]:
        mean = np.radians(recording.columns[element["name"]].mean())
        assert element["bias"]["value"] == pytest.approx(mean, abs=1e-15)
        assert element["bias"]["unit"] == "rad/s"
        assert record.parameters[element["name"].replace("gyro", "bias")].value == element["bias"]["value"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("noise", "duration", "least"),
    [
        (NoiseModel(), 30.0, 0.7),
        (NoiseModel(), 120.0, 0.7),
        (NoiseModel(walk=np.radians(2e-3)), 60.0, 0.8),
        (NoiseModel(gauss_markov=0.0, walk=0.0), 60.0, 0.9),
    ],
)
def test_the_uncertainty_of_the_bias_holds_what_the_stretch_shows_and_the_rest_is_said(noise, duration, least, reduced):
    # Of noise slower than itself a stretch says nothing: the turn-on bias is covered as far as it shows.
    ratios, spreads = [], []
    for seed in range(6 if reduced else 20):
        recording = simulate_array(experiment="static", duration=duration, rate=50.0, seed=seed, **vars(noise))
        record = calibrate_array(recording).calibration
        for i, element in enumerate(record.sections["elements"]):
            truth = float(recording.metadata[f"truth_bias_{i + 1}"].split()[0])
            ratios.append(abs(element["bias"]["value"] - truth) / element["bias"]["standard_uncertainty"])
            if noise.walk == 0:
                white = element["angle_random_walk"]["value"] / np.sqrt(duration)
                spreads.append(element["bias"]["standard_uncertainty"] / white)
        assert sum("times as large" in line for line in record.warnings) == 1
    assert np.mean(np.array(ratios) < 2) > least
    if noise.walk == 0:
        assert np.median(spreads) < 1.2  # u of white noise alone; a guard against what does not show made it 5


def test_truth_rate_gives_absolute_scale_factors():
    still, moving, sensing, _ = array_of(3, 1)
    rng = np.random.default_rng(3)
    truth = np.linalg.lstsq(
        sensing[:, :, 0], np.column_stack([moving.columns[f"gyro_{i + 1}"] for i in range(5)]).T, rcond=None
    )
    known = moving.with_columns({"truth_rate": truth[0][0] + 0 * rng.standard_normal(1)}, {"truth_rate": "deg/s"})
    record = calibrate_array(still, known).calibration
    found = [e["scale_factor"]["value"] for e in record.sections["elements"]]
    np.testing.assert_allclose(found, sensing[:, 0, 0], atol=2e-3)
    assert record.model["gauge"] == "truth_rate"


def test_a_calibrated_array_of_mixed_orientation_fuses_as_one():
    still, moving, _, _ = array_of(7, 3)
    record = calibrate_array(still, moving).calibration
    fused = fuse(moving, FuseOptions(calibration=record))
    assert not (fused.flags & 16).any()
    spread = fused.rate - motion(12_000, 3, _after_draws(7))
    # The frame is the elements' mean, a few mrad from the body's: what is left is a constant 3 x 3 map of the motion.
    body = motion(12_000, 3, _after_draws(7))
    left = fused.rate - body @ np.linalg.lstsq(body, fused.rate, rcond=None)[0]
    assert left.std() < 1.1 * 0.05 / np.sqrt(5)
    assert np.abs(spread).max() < 5


def _after_draws(seed: int) -> np.random.Generator:
    """The generator of `array_of` as it is when the motion is drawn."""
    rng = np.random.default_rng(seed)
    rng.standard_normal((5, 3, 3))
    rng.standard_normal((3, 5))
    rng.standard_normal((12_000, 3, 5))
    return rng


def test_the_covariance_is_that_of_the_noise():
    rng = np.random.default_rng(5)
    shared = rng.standard_normal((30_000, 1))
    noise = rng.standard_normal((30_000, 3)) + 0.7 * shared
    record = calibrate_array(array_recording(noise, 100.0), averaging_time=0.05).calibration
    found = record.sections["correlation"]
    truth = 0.49 / 1.49
    off = np.array(found["matrix"][0])[~np.eye(3, dtype=bool)]
    u = np.array(found["standard_uncertainty"][0])[~np.eye(3, dtype=bool)]
    assert (np.abs(off - truth) < 3 * u).all()
    covariance = np.degrees(np.degrees(found["covariance"][0]))
    np.testing.assert_allclose(np.diag(covariance), 1.49 / 5, rtol=0.06)
    limit = np.degrees(found["limit"][0]["value"])
    assert limit == pytest.approx(np.sqrt((1 / 3 + 0.49) / 5), rel=0.05)


def test_a_long_recording_is_looked_at_in_parts_with_the_same_result(monkeypatch):
    still, moving, _, _ = array_of(2, 3)
    whole = calibrate_array(still, moving, averaging_time=0.7).calibration
    for module in (fit, elements):
        monkeypatch.setattr(module, "ROWS_AT_ONCE", 700)
    parts = calibrate_array(still, moving, averaging_time=0.7).calibration
    assert parts.warnings == whole.warnings
    covariance, found = (np.array(each.sections["correlation"]["covariance"]) for each in (whole, parts))
    np.testing.assert_allclose(found, covariance, rtol=0, atol=1e-13 * covariance.max())


def test_the_record_survives_saving_and_draws_its_report(tmp_path):
    still, moving, _, _ = array_of(1, 3)
    record = calibrate_array(still, moving).calibration
    record.save(tmp_path / "r.json")
    again = il.load(tmp_path / "r.json")
    assert again.to_json() == record.to_json()
    shown = exhibits_of(again)
    assert [item.title for item in shown.items][:2] == ["Elements", "Alignment"]
    il.write_report(again, tmp_path / "r.html")
    assert "Gyro array" in (tmp_path / "r.html").read_text()
    json.dumps([item.traces for item in shown.items if hasattr(item, "traces")], allow_nan=False)


@pytest.mark.parametrize("axes", [1, 3])
def test_an_element_without_noise_coefficients_still_serves(tmp_path, axes):
    still, moving, _, _ = array_of(2, axes)
    name = "gyro_y_2" if axes == 3 else "gyro_2"
    coarse = {name: 0.3 * np.round(still.columns[name] / 0.3)}  # steps of six times its noise
    record = calibrate_array(still.with_columns(coarse, {name: "deg/s"}), moving).calibration
    found = record.sections["elements"][1]["angle_random_walk"]
    assert (found["value"][1] if axes == 3 else found["value"]) is None
    assert "steps that are" in found["reason"]
    assert any(f"column {name}: noise coefficients not determined" in line for line in record.warnings)
    record.save(tmp_path / "r.json")
    again = il.load(tmp_path / "r.json")
    il.write_report(again, tmp_path / "r.html")
    assert "not determined" in (tmp_path / "r.html").read_text()
    il.export("blob", [again], tmp_path / "unit")
    for method in ("robust", "kalman", "covariance"):
        assert np.isfinite(fuse(moving, FuseOptions(method=method, calibration=again)).rate).all()


@pytest.mark.slow
def test_the_real_array_is_calibrated(real_data):
    recording = il.read(real_data / "mimu4444" / "exp_1.bin")
    quiet = (recording.time > 468.5) & (recording.time < 495.5)
    still = Recording({n: c[quiet] for n, c in recording.columns.items()}, recording.units, name="still")
    record = calibrate_array(still, recording).calibration
    for i, element in enumerate(record.sections["elements"]):
        nominal = UPSIDE_DOWN if i % 2 else np.eye(3)
        matrix = np.array(element["matrix"]["value"])
        assert np.abs(matrix - nominal).max() < 0.03
        assert np.max(element["matrix"]["standard_uncertainty"]) < 1e-3
    assert any("at the end of a gyro's range" in message for message in record.warnings)


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        (lambda c: c | {"gyro_2": np.full(12_000, 0.25)}, DataError,
         r"still.csv: column gyro_2: all samples are 0.25: a dead"),
        (lambda c: c | {"gyro_2": np.where(np.arange(12_000) % 2, 0.5, 0.25)}, DataError,
         r"still.csv: column gyro_2: its means over .* s do not differ: a dead gyro"),
        (lambda c: c | {"gyro_2": np.where(np.arange(12_000) == 11_999, 0.3, 0.25)}, DataError,
         r"still.csv: column gyro_2: 11999 samples of 0.25 from row 1 \(line 2\) on, .* a stuck sensor; leave it out"),
        (
            lambda c: c | {"gyro_2": np.where(np.abs(np.arange(12_000) - 4500) < 1500, 0.25, c["gyro_2"])},
            DataError, r"still.csv: column gyro_2: 2999 samples of 0.25 from row 3002 \(line 3003\) on, .* a stuck",
        ),
        (
            lambda c: c | {"gyro_2": np.where(np.arange(12_000) == 5, np.nan, c["gyro_2"])},
            DataError, r"still.csv: row 6 \(line 7\), column gyro_2: expected a finite number, found nan",
        ),
        (lambda c: {k: v[:100] for k, v in c.items()}, DataError, "100 samples at rest are too few"),
        (lambda c: {k: v for k, v in c.items() if k != "time"}, DataError, "no column time"),
        (lambda c: {k: v for k, v in c.items() if k != "gyro_3"}, DataError, "no column gyro_3; expected 5 elements"),
        (
            lambda c: {k: v + (k != "time") * 40 * np.sin(np.arange(12_000) / 300) for k, v in c.items()},
            DataError, "the array moves: its elements go together by 28",
        ),
        (lambda c: {k: v for k, v in c.items() if k in ("time", "gyro_1")}, DataError, "1 element on each axis"),
    ],
)  # fmt: skip
def test_a_bad_recording_at_rest_is_refused(change, error, text):
    still, _, _, _ = array_of(1, 1)
    columns = change(dict(still.columns))
    units = {k: "s" if k == "time" else "deg/s" for k in columns}
    with pytest.raises(error, match=text):
        calibrate_array(Recording(columns, units, name="still.csv", lines_before=1))


def test_a_gyro_that_sticks_in_motion_is_refused():
    still, moving, _, _ = array_of(1, 1)
    columns = dict(moving.columns)
    columns["gyro_3"] = np.where(np.abs(np.arange(12_000) - 4500) < 500, columns["gyro_3"][4500], columns["gyro_3"])
    with pytest.raises(
        DataError, match=r"moving.csv: column gyro_3: 999 samples of .* from row 4002 .* a stuck sensor"
    ):
        calibrate_array(still, Recording(columns, moving.units, name="moving.csv"))


def test_a_level_that_changes_at_rest_is_said():
    """Its uncertainty covers the change, 70 times that of the other gyros, and the verdict was good."""
    still, moving, _, _ = array_of(1, 1)
    columns = {**still.columns, "gyro_2": still.columns["gyro_2"] + 0.04 * (np.arange(12_000) > 7000)}
    record = calibrate_array(Recording(columns, still.units, name="still.csv"), moving).calibration
    (reason,) = record.verdict.reasons
    assert record.verdict.state == "look"
    assert re.search(r"still.csv: the level changes at rest: gyro_2 by \+0.0\d+ deg/s near (69|70|71)\.?\d* s;", reason)
    assert calibrate_array(still, moving).calibration.verdict.state == "good"


@pytest.mark.parametrize(("factor", "state"), [(1.06, "good"), (2.0, "bad")])
def test_a_gyro_of_another_range_shifts_the_scale_of_all(factor, state):
    still, moving, sensing, _ = array_of(1, 1)
    moving = Recording({**moving.columns, "gyro_4": factor * moving.columns["gyro_4"]}, moving.units, name="moving.csv")
    verdict = calibrate_array(still, moving).calibration.verdict
    assert verdict.state == state
    if state == "bad":
        size = np.abs(sensing[:, 0, 0]) * np.where(np.arange(5) == 3, factor, 1.0)
        relative = size / np.median(size)
        assert verdict.reasons[0] == (
            f"moving.csv: in motion gyro_4 reads {relative[3]:.3g} times the rate of most gyros: another range or unit?"
            f" The scale of the array is the mean of all, and so {100 * (relative.mean() - 1):.2g} % off"
        )


def test_gyros_at_their_limits_together_are_no_repeated_rows():
    still, moving, _, _ = array_of(1, 1)
    columns = {name: np.clip(x, -105, 105) if name != "time" else x for name, x in moving.columns.items()}
    warnings = calibrate_array(still, Recording(columns, moving.units, name="moving.csv")).calibration.warnings
    assert any("at the end of a gyro's range" in message for message in warnings)
    assert not any("exact repeats" in message for message in warnings)


def test_a_false_reading_beyond_its_range_does_not_hide_that_a_gyro_is_at_its_end():
    still, moving, _, _ = array_of(1, 1)
    found = []
    for wrong in (0.0, -300.0):
        columns = {n: np.append(still.columns[n][:2000], np.clip(x, -105, 105)) for n, x in moving.columns.items()}
        columns |= {"time": np.arange(14_000) / 100}
        columns["gyro_5"][1000] += wrong  # which is at its lower end in rows in which no other is at one
        warnings = calibrate_array(still, Recording(columns, moving.units, name="moving.csv")).calibration.warnings
        found += [message for message in warnings if "at the end of a gyro's range" in message]
    assert found[0] == found[1]


@pytest.mark.parametrize("axes", [1, 3])
@pytest.mark.parametrize(("factor", "text"), [
    (1.0, ""), (30.0, ""),
    (np.pi / 180, r"5[678]\.\d times as small as in the record: another unit \(rad/s labelled deg/s"),
    (3600.0, r"3[56]\d\d times as large as in the record: another unit \(deg/h labelled deg/s"),
])  # fmt: skip
def test_a_recording_whose_unit_is_not_the_records_is_told_by_noise_and_biases(axes, factor, text):
    """In motion, with every gyro in the wrong unit alike: nothing but the record can tell."""
    still, moving, _, _ = array_of(1, axes)
    record = calibrate_array(still, moving).calibration
    columns = {name: x if name == "time" else factor * x for name, x in moving.columns.items()}
    fused = fuse(Recording(columns, moving.units, name="flight.csv"), FuseOptions(calibration=record))
    said = [note for note in fused.notes if "in the record: another unit" in note]
    assert bool(said) == bool(text)
    assert all(re.search(rf"flight.csv: noise and biases of the gyros are {text}", note) for note in said)


def test_another_unit_is_told_from_blocks_of_any_length():
    still, moving, _, _ = array_of(1, 1)
    options = FuseOptions(calibration=calibrate_array(still, moving).calibration)
    radians = {name: x if name == "time" else np.radians(x) for name, x in moving.columns.items()}
    said = []
    for size in (12_000, 500):
        fuser = Fuser(options)
        blocks = (
            Recording({n: x[i : i + size] for n, x in radians.items()}, moving.units, name="f.csv", first_row=i + 1)
            for i in range(0, 12_000, size)
        )
        assert list(fuser.fuse(blocks))
        said += [note for note in fuser.notes() if "another unit" in note]
    assert said[0] == said[1]


def test_turned_on_again_and_filtered_gyros_are_no_other_unit():
    still, moving, _, _ = array_of(1, 1)
    record = calibrate_array(still, moving).calibration
    rng, columns = np.random.default_rng(5), dict(moving.columns)
    for name in columns.keys() - {"time"}:
        window = np.ones(40) / 40
        columns[name] = np.convolve(columns[name] + rng.normal(0, 1.0), window, mode="same")
    fused = fuse(Recording(columns, moving.units, name="flight.csv"), FuseOptions(calibration=record))
    assert not any("another unit" in note for note in fused.notes)


def test_units_and_motion_that_cannot_serve_are_refused():
    still, _, sensing, _ = array_of(1, 3)
    counts = Recording(still.columns, {k: "s" if k == "time" else "count" for k in still.columns}, name="c.csv")
    with pytest.raises(UnitError, match="needs rates"):
        calibrate_array(counts)
    level = motion(12_000, 3, np.random.default_rng(2)) * [1, 1, 0]
    noise = 0.05 * np.random.default_rng(3).standard_normal((12_000, 3, 5))
    flat = array_recording(np.einsum("iab,tb->tai", sensing, level) + noise, 100.0, "m.csv")
    with pytest.raises(ObservabilityError, match=r"m\.csv: the motion .* alignment about z"):
        calibrate_array(still, flat)
    with pytest.raises(DataError, match=r"6 elements on 1 axes; expected 5 on 3"):
        calibrate_array(still, simulate_array(duration=20.0))


def test_alignment_needs_motion():
    rng = np.random.default_rng(1)
    with pytest.raises(ObservabilityError, match="expected a recording that turns"):
        align(rng.standard_normal((2000, 1, 4)), np.ones((1, 4)))


def test_a_record_of_another_array_is_refused():
    still, _, _, _ = array_of(1, 1)
    record = calibrate_array(still).calibration
    with pytest.raises(
        RecordError, match="simulated dynamic array: 6 gyros on 1 axis; the record of the calibration holds 5 on 1 axis"
    ):
        fuse(simulate_array(duration=2.0), FuseOptions(calibration=record))
    tumble = il.fit_tumble(il.find_attitudes(il.simulate_tumble(order=1, attitudes=16, hold=3.0)), order=1, gravity=9.8)
    with pytest.raises(RecordError, match="expected the record of an array calibration, found one of a tumble"):
        fuse(simulate_array(duration=2.0), FuseOptions(calibration=tumble.calibration))


@pytest.mark.slow
@pytest.mark.parametrize("axes", [1, 3])
@pytest.mark.parametrize("bend", [0.0, 1e-3, -6e-3])
def test_an_element_that_is_not_linear_is_named_and_its_scale_factor_covered(axes, bend):
    """The ratio of element 3 changes by `bend` at 200 deg/s: without the test errors of 11 standard uncertainties."""
    rng = np.random.default_rng(7)
    n, count = 6, 4000
    sensing = np.eye(axes) + 0.01 * rng.standard_normal((n, axes, axes))
    sensed = np.einsum("iab,tb->tai", sensing, 2 * motion(count, axes, rng))
    sensed[:, :, 2] *= 1 + bend * (sensed[:, :, 2] / 200) ** 2
    still, moving = (part + 0.05 * rng.standard_normal(sensed.shape) for part in (np.zeros_like(sensed), sensed))
    recorded = [array_recording(part[:, 0] if axes == 1 else part, 100.0, "m.csv") for part in (still, moving)]
    record = calibrate_array(*recorded).calibration
    lines = [line for line in record.verdict.reasons if "output over rate is not the same at all rates" in line]
    assert bool(lines) == bool(bend)
    assert not lines or (": element 3 by" if axes == 3 else ": gyro_3 by") in lines[0]
    truth = in_gauge(sensing)
    key = "scale_factor" if axes == 1 else "matrix"
    for element, own in zip(record.sections["elements"], truth, strict=True):
        error = np.array(element[key]["value"]) - (own[0, 0] if axes == 1 else np.linalg.inv(own))
        assert (np.abs(error) < 4 * np.array(element[key]["standard_uncertainty"])).all()


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


@pytest.mark.slow
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


@pytest.mark.slow
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

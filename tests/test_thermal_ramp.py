"""Rest ramps: the biases of gyroscopes over temperature without a turn, from the fit to what a unit and autopilots do.

The simulator is `tests.reference.rest_ramp`, which shares nothing with the fit.
"""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from tests.reference.rest_ramp import Ramp, flicker

import imulab as il
from imulab.errors import DataError, OptionError, RecordError

AXES = "xyz"


def recorded(ramp: Ramp, unit: str = "deg/s", **metadata: str) -> il.Recording:
    columns = {"time": ramp.time, **{f"gyro_{a}": ramp.output[:, k] for k, a in enumerate(AXES)}}
    columns["temperature"] = ramp.reading
    units = {"time": "s", **{f"gyro_{a}": unit for a in AXES}, "temperature": "degC"}
    return il.Recording(columns=columns, units=units, metadata=metadata, name="ramp.csv")


@cache
def fitted(seed: int = 3) -> il.ThermalFit:
    return il.fit_thermal(recorded(Ramp(seed)))


def laws(record: il.Calibration, temperature: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the laws of a record by powers of T - T0, deg/s, and their uncertainties, shapes (n, 3)."""
    offset = temperature - record.model["reference_temperature"]["value"]
    values, spread = [], []
    for axis in AXES:
        names = [n for n in record.covariance.names if n.startswith(f"gyro_bias_{axis}")]
        powers = np.vander(offset, len(names), increasing=True)
        values.append(powers @ [record.value(n) for n in names])
        spread.append(np.sqrt(np.einsum("ni,ij,nj->n", powers, record.cov(*names), powers)))
    return np.degrees(np.array(values).T), np.degrees(np.array(spread).T)


def shares(seeds: range, **form: object) -> tuple[float, float]:
    """Return in which share intervals hold the biases over temperature, and in which a lag is found."""
    inside, lags = [], []
    for seed in seeds:
        ramp = Ramp(seed, **form)  # type: ignore[arg-type]
        record = il.fit_thermal(recorded(ramp), degrees="3,0,0").calibration
        at = np.linspace(*record.model["range"], 9)
        values, u = laws(record, at)
        inside.append(np.abs(values - ramp.bias(at)) < 1.96 * u)
        lag = record.fit["gyro"]["lag"]
        lags.append(lag is not None and lag["fitted"])
    return float(np.mean(inside)), float(np.mean(lags))


def test_record_names_what_is_told_and_what_is_not() -> None:
    record = fitted().calibration
    assert record.procedure == "thermal"
    assert {f"gyro_bias_{a}" for a in AXES} <= set(record.parameters)
    assert all(name.startswith("gyro_bias") for name in record.parameters)
    assert record.parameters["gyro_bias_x_t1"].unit == "rad/s/K"
    assert {"gyro_scale_factor_x", "bias_z", "scale_factor_y", "gyro_g_sensitivity_xx"} <= set(record.fit["not_told"])
    assert any("scale factors" in w and "not told" in w for w in record.warnings)


def test_f18_within_uncertainty() -> None:
    rng = np.random.default_rng(111)
    time = np.arange(9000) / 10
    read = 12 + 35 * (1 - np.exp(-time / 400))
    d = read - 25
    law = np.array([0.3, -0.5, 0.1]) + np.outer(d, [0.02, -0.011, 0.03]) + np.outer(d**2, [2e-4, 0, -1e-4])
    columns = {"time": time, "temperature": read}
    columns |= dict(zip(("gyro_x", "gyro_y", "gyro_z"), (law + 0.07 * rng.standard_normal((9000, 3))).T, strict=True))
    units = {"time": "s", "temperature": "degC", **{f"gyro_{a}": "deg/s" for a in AXES}}
    record = il.fit_thermal(il.Recording(columns=columns, units=units, metadata={}, name="f18")).calibration
    values, u = laws(record, np.array([25.0, 24.9, 25.1]))
    assert (np.abs(values[0] - [0.3, -0.5, 0.1]) < 2 * u[0]).all()
    assert u.max() < 0.006  # the Earth's rate, 0.0024 deg/s on an axis, and little more
    assert np.abs((values[2] - values[1]) / 0.2 - [0.02, -0.011, 0.03]).max() < 1e-3


def test_correction_by_record_blob_and_c_agree(tmp_path: Path) -> None:
    ramp = Ramp(3)
    record = fitted().calibration
    (blob,) = il.export("blob", record, tmp_path)
    by_record, by_blob = (il.apply(each, recorded(ramp)) for each in (record, str(blob)))
    values, _ = laws(record, np.clip(ramp.reading, *record.model["range"]))
    for k, axis in enumerate(AXES):
        got = by_record.column(f"gyro_{axis}")
        np.testing.assert_allclose(got, ramp.output[:, k] - values[:, k], atol=1e-9)
        np.testing.assert_allclose(by_blob.column(f"gyro_{axis}"), got, atol=2e-5)  # single precision


def test_autopilots_get_the_gyroscopes_alone(tmp_path: Path) -> None:
    record = fitted().calibration
    at = np.linspace(*record.model["range"], 7)
    values, _ = laws(record, at)
    (px4,) = il.export("px4", record, tmp_path)
    rows = dict(line.split("\t")[2:4] for line in px4.read_text().splitlines() if not line.startswith("#"))
    assert not any("ACC" in name or "TC_A" in name for name in rows)
    powers = np.vander(at - float(rows["TC_G0_TREF"]), 4, increasing=True)
    for k, axis in enumerate("XYZ"):
        held = [float(rows[f"CAL_GYRO0_{axis}OFF"]), *(float(rows[f"TC_G0_X{p}_{k}"]) for p in (1, 2, 3))]
        np.testing.assert_allclose(np.degrees(powers @ held), values[:, k], atol=2e-6)
    (ardupilot,) = il.export("ardupilot", record, tmp_path)
    rows = dict(line.split(",") for line in ardupilot.read_text().splitlines() if not line.startswith("#"))
    assert not any("ACC" in name for name in rows)
    powers = np.vander(at - 35.0, 4, increasing=True)[:, 1:]
    about = np.vander([float(rows["INS_GYR1_CALTEMP"]) - 35.0], 4, increasing=True)[:, 1:]
    for k, axis in enumerate("XYZ"):
        held = 1e-6 * np.array([float(rows[f"INS_TCAL1_GYR{p}_{axis}"]) for p in (1, 2, 3)])
        whole = (powers - about) @ held + float(rows[f"INS_GYROFFS_{axis}"])
        np.testing.assert_allclose(np.degrees(whole), values[:, k], atol=2e-6)


def test_record_is_read_shown_and_compared(tmp_path: Path) -> None:
    record = fitted().calibration
    record.save(tmp_path / "r.json")
    again = il.load(tmp_path / "r.json")
    assert again.parameters == record.parameters
    il.write_report(again, tmp_path / "r.html")
    assert "not told" in (tmp_path / "r.html").read_text()
    other = fitted(4).calibration
    assert il.compare_records(record, other) is not None


def test_accelerometers_beside_do_not_matter() -> None:
    (made,) = il.simulate_thermal([0, 40], attitudes=0, ramps=1, gyro=True, duration="20 min")
    record = il.fit_thermal(made).calibration
    alone = replace(
        made,
        columns={n: v for n, v in made.columns.items() if "accel" not in n},
        units={n: v for n, v in made.units.items() if "accel" not in n},
    )
    assert record.parameters == il.fit_thermal(alone).calibration.parameters


def test_latitude_takes_the_vertical_part_of_the_earths_rate_off_where_up_is_known() -> None:
    (made,) = il.simulate_thermal([0, 40], attitudes=0, ramps=1, gyro=True, duration="20 min")
    without, record = il.fit_thermal(made).calibration, il.fit_thermal(made, latitude="90 deg").calibration
    up = np.array([made.column(f"accel_{a}").mean() for a in AXES])
    up /= np.linalg.norm(up)
    less = [without.value(f"gyro_bias_{a}") - record.value(f"gyro_bias_{a}") for a in AXES]
    np.testing.assert_allclose(less, 7.292115e-5 * up, atol=3e-6)
    with pytest.raises(OptionError, match="no accelerometers"):
        il.fit_thermal(recorded(Ramp(3)), latitude="48 deg")


def test_lag_of_a_ramp_up_and_down_is_named() -> None:
    record = il.fit_thermal(recorded(Ramp(1, back=True, lag=60.0)), degrees="3,0,0").calibration
    assert record.fit["gyro"]["lag"]["value"] == pytest.approx(60.0, abs=15.0)
    assert any("those of" in w and "s before" in w for w in record.warnings)


def test_one_way_says_what_a_lag_would_cost() -> None:
    """From four times the uncertainty on it asks to look, by the two figures that are said."""
    page = il.simulate_thermal(attitudes=0, ramps=1, gyro=True)[0]
    for record in (fitted().calibration, il.fit_thermal(page).calibration):
        (text,) = [w for w in record.warnings if "usual lag of 20 s" in w]
        shift, u = map(float, re.search(r"up to (\S+) deg/h, where their uncertainty is (\S+)$", text).groups())
        assert (text in record.verdict.reasons) == (shift > 4 * u)


def test_gap_is_noted_and_bridged() -> None:
    recording = recorded(Ramp(3))
    kept = (recording.si("time") < 300) | (recording.si("time") > 500)
    holed = replace(recording, columns={n: v[kept] for n, v in recording.columns.items()})
    record = il.fit_thermal(holed).calibration
    assert any("gaps" in w and "too few samples" in w for w in record.warnings)
    at = np.linspace(*record.model["range"], 5)
    values, u = laws(record, at)
    assert (np.abs(values - Ramp(3).bias(at)) < 4 * u).all()


def test_refusals_by_name() -> None:
    ramp = Ramp(3)
    turned = Ramp(3)
    turned.output = turned.output + 40 * np.sin(turned.time / 7)[:, None]
    with pytest.raises(DataError, match="at rest"):
        il.fit_thermal(recorded(turned))
    without = recorded(ramp)
    without = replace(without, columns={n: v for n, v in without.columns.items() if n != "temperature"},
                      units={n: v for n, v in without.units.items() if n != "temperature"})  # fmt: skip
    with pytest.raises(DataError, match="no column temperature"):
        il.fit_thermal(without)
    narrow = Ramp(3)
    narrow.reading = 20 + 0.1 * narrow.reading
    with pytest.raises(DataError, match="expected at least 10 K: imulab noise fit"):
        il.fit_thermal(recorded(narrow))
    with pytest.raises(DataError, match="are in count, and a unit at rest does not tell its scale"):
        il.fit_thermal(recorded(ramp, "count"))
    loud = il.fit_thermal(recorded(ramp, "rad/s")) if np.degrees(np.abs(ramp.output).max()) < 60 else None
    assert loud is None or loud.calibration.verdict.state == "bad"


def test_no_prior_by_a_record_of_rest_ramps() -> None:
    record = fitted().calibration
    tumble = il.simulate_tumble()
    with pytest.raises(RecordError, match="rest ramps"):
        il.fit_tumble(tumble, prior=record)


def test_check_passes_the_same_unit_and_fails_a_changed_law() -> None:
    record = fitted().calibration
    again = Ramp(3, noise=1)
    passed = il.check_thermal(record, recorded(again))
    assert passed.passed
    assert "agree" in passed.meaning()
    again.output = again.output + 0.01 * (again.temperature - 25)[:, None]
    failed = il.check_thermal(record, recorded(again))
    assert not failed.passed
    assert failed.to_json()["verdict"] == "fail"


def test_intervals_hold_one_way(reduced: bool) -> None:
    share, _ = shares(range(6 if reduced else 100))
    assert (0.8 if reduced else 0.92) < share <= 1.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "found"),
    [
        ({}, None),
        ({"back": True}, (0.0, 0.03)),
        ({"back": True, "lag": 20.0}, (0.9, 1.0)),
        ({"back": True, "loop": 0.05}, None),
    ],
)
def test_intervals_hold_in_a_thousand(
    form: dict[str, object], found: tuple[float, float] | None, reduced: bool
) -> None:
    share, lag = shares(range(16 if reduced else 250), **form)
    assert (0.88 if reduced else 0.93) <= share <= (1.0 if reduced else 0.97)
    one = 1 / 16 if reduced else 0.0  # may be otherwise by chance
    assert found is None or found[0] - one <= lag <= found[1] + one


UP = np.array([0.6, -0.48, 0.64])
G = 9.81


def with_accelerometers(ramp: Ramp, seed: int) -> tuple[il.Recording, np.ndarray]:
    """Return the ramp with accelerometers of known bias and scale over temperature, and their change along gravity."""
    rng = np.random.default_rng([seed, 7])
    d = ramp.temperature - 25.0
    bias = np.outer(d, rng.normal(0, 2e-3, 3)) + np.outer(d**2, rng.normal(0, 3e-5, 3))
    scale = np.outer(d, rng.normal(0, 5e-5, 3))
    white = rng.choice([3e-3, 2e-2])
    slow = np.column_stack([flicker(len(d), rng) for _ in UP]) * np.exp(rng.uniform(*np.log([1e-4, 2e-3])))
    outputs = G * UP * (1 + scale) + bias + white * rng.standard_normal((len(d), 3)) + slow
    recording = recorded(ramp)
    columns = {f"accel_{a}": outputs[:, k] for k, a in enumerate(AXES)}
    recording = recording.with_columns(columns, dict.fromkeys(columns, "m/s^2"))
    return recording, (G * UP * scale + bias) @ UP


def changes(recording: il.Recording) -> dict[str, np.ndarray]:
    held = il.fit_thermal(recording, degrees="3,0,0").calibration.data["accel_change"]
    assert held["recording"] == [recording.name]
    return {name: np.array(values[0]) for name, values in held.items() if name != "recording"}


def test_accelerometers_change_along_gravity_and_nothing_is_said_across(tmp_path: Path) -> None:
    recording, along = with_accelerometers(Ramp(3), 3)
    record = il.fit_thermal(recording).calibration
    held = record.data["accel_change"]
    np.testing.assert_allclose(held["up"][0], UP, atol=5e-3)  # biases of mg lean it
    order = np.argsort(recording.column("temperature"))
    truth = np.interp(held["temperature"][0], Ramp(3).temperature[order], along[order])
    change, u = np.array(held["change"][0]), np.array(held["standard_uncertainty"][0])
    assert (np.abs(change - (truth - truth[4])) < 3 * u + 1e-9).all()
    assert (u < 0.2 * np.ptp(truth)).all()
    assert any("along gravity" in each and "tilt" in each for each in record.warnings)
    assert not any(name.startswith(("bias_", "scale_factor")) for name in record.parameters)
    record.save(tmp_path / "r.json")
    assert il.load(tmp_path / "r.json").data["accel_change"] == held
    il.write_report(record, tmp_path / "r.html")
    assert "along gravity" in (tmp_path / "r.html").read_text()
    corrected = il.apply(record, recording)
    np.testing.assert_array_equal(corrected.column("accel_x"), recording.column("accel_x"))


@pytest.mark.slow
def test_intervals_of_the_change_along_gravity_hold(reduced: bool) -> None:
    """They are half as wide again as they need be: one direction alone tells a random walk from 1/f noise poorly."""
    errors = []
    for seed in range(30 if reduced else 200):
        ramp = Ramp(seed)
        recording, along = with_accelerometers(ramp, seed)
        held = changes(recording)
        order = np.argsort(ramp.temperature)
        truth = np.interp(held["temperature"], ramp.temperature[order], along[order])
        apart, u = held["change"] - (truth - truth[4]), held["standard_uncertainty"]
        errors.append(np.delete(apart, 4) / np.delete(u, 4))
    assert np.mean(np.abs(errors) < 1.96) > 0.95 - 0.03 * reduced
    assert 0.55 < np.sqrt(np.mean(np.square(errors))) < 1


def test_counts_and_a_missing_axis_tell_no_change_and_of_one_ramp_alone_a_lag_is_asked_about() -> None:
    recording, _ = with_accelerometers(Ramp(3), 3)
    columns = {f"accel_{a}": np.round(recording.column(f"accel_{a}") * 1000) for a in AXES}
    counts = recording.with_columns(columns, dict.fromkeys(columns, "count"))
    assert "accel_change" not in il.fit_thermal(counts).calibration.data
    assert "accel_change" not in fitted().calibration.data
    record = il.fit_thermal(recording).calibration
    (reason,) = record.verdict.reasons
    assert "usual lag of 20 s" in reason
    assert any("one recording is one power cycle" in each for each in record.warnings)

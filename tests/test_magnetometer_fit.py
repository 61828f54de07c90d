"""A magnetometer alone, waved or turned level: at the bound, what is told and what is not, and what disturbs it."""

import json
import re

import numpy as np
import pytest
from tests.reference.field_alone import Sensor, circle, sphere
from tests.reference.field_alone import waved as by_hand
from tests.test_tumble_mag_check import SAP5, G, sap5_recording

import imulab as il
from imulab.cli import main
from imulab.device.unit import DeviceUnit
from imulab.errors import DataError, ObservabilityError, OptionError, RecordError
from imulab.procedures.magnetometer.device import tables_of
from imulab.procedures.magnetometer.solve import evaluate, find_disturbed, fit_surface

NOISE = 0.4  # uT
NAMES = [f"mag_bias_{a}" for a in "xyz"] + [f"mag_soft_{a}" for a in ("xx", "xy", "xz", "yy", "yz", "zz")]


def recorded(outputs, unit="uT", rate=20.0, **more):
    """Return outputs as a recording over time."""
    columns = {"time": np.arange(len(outputs)) / rate}
    columns |= {f"mag_{axis}": outputs[:, k] for k, axis in enumerate("xyz")}
    return il.Recording(columns | more, dict.fromkeys(columns | more, unit) | {"time": "s"}, {"serial": "SN7"})


def waved(seed, count=600, noise=NOISE):
    rng = np.random.default_rng(seed)
    sensor = Sensor(seed)
    return sensor, sensor.outputs(sphere(count, rng), noise, rng)


def levelled(seed, count=400, turns=2.0, noise=0.2, tilt=0.0):
    """Return a sensor turned about z, whose z column is the steady vertical field and its own offset."""
    rng = np.random.default_rng(seed)
    sensor = Sensor(seed, axes=2, field=20.0)
    upright = 43.0 + noise * rng.standard_normal(count)
    return sensor, np.column_stack([sensor.outputs(circle(count, turns), noise, rng), upright])


@pytest.mark.parametrize("axes", [3, 2])
def test_derivatives_are_those_of_the_residual(axes):
    rng = np.random.default_rng(1)
    sensor = Sensor(1, axes=axes, field=1.0)
    outputs = sensor.outputs(sphere(20, rng) if axes == 3 else circle(20, 0.9), 0.0, rng)
    r, jacobian, weight = evaluate(sensor.theta, outputs)
    assert np.abs(r).max() < 1e-14
    for k in range(len(sensor.theta)):
        step = np.zeros(len(sensor.theta))
        step[k] = 1e-6
        slope = (evaluate(sensor.theta + step, outputs)[0] - evaluate(sensor.theta - step, outputs)[0]) / 2e-6
        np.testing.assert_allclose(jacobian[:, k], slope, atol=1e-8)
    np.testing.assert_allclose(weight, np.linalg.norm(jacobian[:, :axes], axis=1))


@pytest.mark.parametrize("axes", [3, 2])
def test_errors_are_at_the_bound_and_intervals_hold(axes, reduced):
    """Over simulated recordings of one sensor: errors over the Cramer-Rao bound, stated uncertainty, coverage, bias."""
    trials, count, noise = (80 if reduced else 2000), 400, 0.6
    sensor = Sensor(5, axes=axes)
    errors, stated, inside = [], [], []
    directions = sphere(count, np.random.default_rng(1)) if axes == 3 else circle(count, 2)
    for seed in range(trials):
        rng = np.random.default_rng([seed, axes])
        surface = fit_surface(sensor.outputs(directions, noise, rng))
        scale = np.concatenate([np.ones(axes), np.full(len(sensor.theta) - axes, 1 / sensor.field)])
        errors.append(scale * surface.theta - sensor.theta)
        stated.append(scale * np.sqrt(np.diag(surface.covariance)))
        inside.append(np.abs(errors[-1]) < 1.966 * stated[-1])
    bound = np.sqrt(np.diag(sensor.bound(directions, noise)))
    ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / bound
    slack = 3 / np.sqrt(2 * trials)
    assert ratio.mean() == pytest.approx(1, abs=0.03 + slack / np.sqrt(len(bound)))
    assert ratio.max() < 1.04 + slack
    assert np.mean(stated, axis=0) / bound == pytest.approx(1, abs=0.06)
    assert 0.93 < np.mean(inside) < 0.97
    bias = np.mean(errors, axis=0) / bound
    assert np.abs(bias).max() < 0.04 + 3.3 / np.sqrt(trials)


def test_large_noise_lengthens_nothing():
    """With 5 % of noise an uncorrected magnitude would be too long by 0.25 %, tenfold the uncertainty."""
    rng = np.random.default_rng(3)
    sensor = Sensor(3)
    surface = fit_surface(sensor.outputs(sphere(60_000, rng), 0.05 * sensor.field, rng))
    assert surface.theta[3:] / sensor.field == pytest.approx(sensor.theta[3:], abs=8e-4)


def test_waved_gives_nine_parameters_and_says_that_the_rotation_is_not_told():
    sensor, outputs = waved(7)
    record = il.fit_mag(recorded(outputs), field="48 uT").calibration
    assert list(record.parameters) == NAMES
    assert record.model["gauge"] == "body, rotation not told"
    assert record.fit["not_told"] == ["rotation"]
    assert record.verdict.state == "good"
    truth = sensor.theta * np.array([1e-6] * 3 + [1.0] * 6)
    for name, value in zip(NAMES, truth, strict=True):
        parameter = record.parameters[name]
        assert abs(parameter.value - value) < 4 * parameter.standard_uncertainty, name
        assert parameter.unit == ("T" if "bias" in name else "1")
    corrected = il.apply(record, recorded(outputs))
    length = np.linalg.norm(corrected.triad("mag"), axis=1)
    assert length.mean() == pytest.approx(48, rel=1e-3)
    assert length.std() == pytest.approx(NOISE, rel=0.15)


def test_a_level_turn_gives_an_ellipse_and_says_what_it_does_not():
    sensor, outputs = levelled(8)
    fit = il.fit_magnetometer(recorded(outputs))
    record = fit.calibration
    assert list(record.parameters) == ["mag_bias_x", "mag_bias_y", "mag_soft_xx", "mag_soft_xy", "mag_soft_yy"]
    assert record.model["turned"] == "level"
    assert record.fit["not_told"] == ["rotation", "mag_bias_z", "mag_soft_xz", "mag_soft_yz", "mag_soft_zz"]
    assert 1e6 * record.value("mag_bias_x") == pytest.approx(sensor.hard[0], abs=0.06)
    ratio = record.value("mag_soft_xx") / record.value("mag_soft_yy")
    assert ratio == pytest.approx(sensor.soft[0, 0] / sensor.soft[1, 1], abs=4e-3)
    corrected = il.apply(record, recorded(outputs))
    level = np.hypot(corrected.column("mag_x"), corrected.column("mag_y"))
    assert level.std() / level.mean() < 0.013
    np.testing.assert_allclose(corrected.column("mag_z"), outputs[:, 2])
    assert record.verdict.state == "good"


@pytest.mark.parametrize(("unit", "factor"), [("mgauss", 10.0), ("nT", 1000.0), ("gauss", 0.01), ("mT", 1e-3)])
def test_units_of_field_give_the_same(unit, factor):
    _, outputs = waved(2)
    expected = il.fit_magnetometer(recorded(outputs)).calibration
    record = il.fit_magnetometer(recorded(factor * outputs, unit)).calibration
    for name in NAMES:
        assert record.value(name) == pytest.approx(expected.value(name), rel=1e-8)


def test_counts_are_in_units_of_the_field_or_per_tesla():
    sensor, outputs = waved(2)
    alone = il.fit_magnetometer(recorded(15 * outputs, "count"))
    stated = il.fit_magnetometer(recorded(15 * outputs, "count"), field="48uT")
    assert alone.calibration.parameters["mag_soft_xx"].unit == "count"
    assert stated.calibration.parameters["mag_soft_xx"].unit == "count/T"
    assert stated.calibration.value("mag_soft_xx") == pytest.approx(15e6 * sensor.soft[0, 0], rel=2e-3)
    for fit, size in ((alone, 1.0), (stated, 48.0)):
        length = np.linalg.norm(fit.apply(recorded(15 * outputs, "count")).triad("mag"), axis=1)
        assert length.mean() == pytest.approx(size, rel=1e-3)


@pytest.mark.parametrize(("unit", "factor"), [("uT", 1000.0), ("gauss", 1.0), ("nT", 1.0)])
def test_a_wrong_unit_is_refused(unit, factor):
    _, outputs = waved(4)
    with pytest.raises(DataError, match="is the unit wrong"):
        il.fit_magnetometer(recorded(factor * outputs, unit))


def test_the_core_computes_it_and_a_blob_keeps_it(tmp_path, monkeypatch):
    _, outputs = waved(6)
    record = il.fit_magnetometer(recorded(outputs), field="48uT").calibration
    (table,) = tables_of(record)
    field, _ = DeviceUnit.of(table).mag(list(outputs.T))
    soft = np.array([[record.value(f"mag_soft_{min(a, b)}{max(a, b)}") for b in "xyz"] for a in "xyz"])
    hard = 1e6 * np.array([record.value(f"mag_bias_{a}") for a in "xyz"])
    np.testing.assert_allclose(1e6 * np.column_stack(field), np.linalg.solve(soft, (outputs - hard).T).T, rtol=1e-12)
    monkeypatch.chdir(tmp_path)
    record.save("r.json")
    il.write_csv(recorded(outputs), "w.csv")
    assert il.load("r.json") == record
    assert main(["export", "--to", "blob", "r.json", "-o", "."]) == 0
    assert main(["apply", "unit.blob", "w.csv", "-o", "by_blob.csv"]) == 0
    expected = il.apply(record, recorded(outputs)).triad("mag")
    np.testing.assert_allclose(il.read("by_blob.csv").triad("mag"), expected, atol=2e-5)


def test_the_field_of_a_place_is_used_whole_or_its_level_part():
    pytest.importorskip("pygeomag")
    where = {"place": "48.1,11.6,520", "date": "2026-11-28"}
    _, outputs = waved(7)
    record = il.fit_magnetometer(recorded(outputs), **where).calibration
    place = record.model["place"]
    assert record.model["field"]["value"] == place["field"]["value"]
    _, outputs = levelled(8)
    record = il.fit_magnetometer(recorded(outputs), **where).calibration
    level = place["field"]["value"] * np.cos(place["dip"]["value"])
    assert record.model["field"]["value"] == pytest.approx(level)
    with pytest.raises(OptionError, match="level part of the field only"):
        il.fit_magnetometer(recorded(outputs), field="20uT")


# Too few directions.


def test_half_a_level_turn_is_refused_by_name():
    _, outputs = levelled(3, turns=0.35)
    with pytest.raises(ObservabilityError, match=r"in one plane, across axis z.*leaves out 2\d\d of 360 deg"):
        il.fit_magnetometer(recorded(outputs))


def test_readings_about_one_direction_are_refused_by_name():
    rng = np.random.default_rng(1)
    directions = sphere(4000, rng)
    outputs = Sensor(1).outputs(directions[directions[:, 2] > 0.75], NOISE, rng)
    with pytest.raises(ObservabilityError, match=r"do not determine hard and soft iron: .*none is within"):
        il.fit_magnetometer(recorded(outputs))


def test_half_a_sphere_is_fitted_and_looked_at():
    rng = np.random.default_rng(1)
    directions = sphere(1200, rng)
    sensor = Sensor(1)
    outputs = sensor.outputs(directions[directions[:, 2] > 0.2], 0.4, rng)
    record = il.fit_magnetometer(recorded(outputs)).calibration
    assert record.verdict.state == "look"
    assert "leave out directions" in record.verdict.reasons[0]
    off = abs(1e6 * record.value("mag_bias_z") - sensor.hard[2])
    assert off < 4e6 * record.parameters["mag_bias_z"].standard_uncertainty


def test_a_turn_oblique_to_all_axes_is_refused():
    angle = np.linspace(0, 12, 300)
    across = np.linalg.svd(np.ones((1, 3)))[2][1:]
    outputs = 30 * np.column_stack([np.cos(angle), np.sin(angle)]) @ across + 15
    outputs += 0.1 * np.random.default_rng(1).standard_normal(outputs.shape)
    with pytest.raises(ObservabilityError, match="oblique to all axes"):
        il.fit_magnetometer(recorded(outputs))


# What disturbs it.


def test_steel_that_passes_is_set_aside_by_its_time():
    clean = il.fit_magnetometer(recorded(waved(9, 1200)[1])).calibration
    _, outputs = waved(9, 1200)
    bump = 10 * np.exp(-(((np.arange(1200) - 500) / 15) ** 2))
    record = il.fit_magnetometer(recorded(outputs + bump[:, None] * np.array([1.0, 0.4, -0.7]))).calibration
    assert record.verdict.state == "look"
    (reason,) = record.verdict.reasons
    assert "was steel or a magnet near" in reason
    assert re.search(r"\(24\.\d to 2[56]\.\d s\): \|m\| is up to 3\d % high", reason)
    for name in NAMES:
        u = clean.parameters[name].standard_uncertainty
        assert abs(record.value(name) - clean.value(name)) < 2 * u, name


def test_single_spikes_are_a_note():
    _, outputs = waved(9, 3000)
    outputs[1500] += 40
    record = il.fit_magnetometer(recorded(outputs)).calibration
    assert record.verdict.state == "good"
    assert any("1 of 3000 readings set aside" in text for text in record.warnings)


def test_a_field_that_changes_is_seen():
    _, outputs = waved(5, 2000)
    sensor = Sensor(5)
    outputs[1200:] = sensor.hard + 1.01 * (outputs[1200:] - sensor.hard)
    record = il.fit_magnetometer(recorded(outputs)).calibration
    assert any(text.startswith("mag: from 60.") and "% higher" in text for text in record.verdict.reasons)


def test_repeated_rows_count_once():
    _, outputs = waved(5)
    once = il.fit_magnetometer(recorded(outputs)).calibration
    four = il.fit_magnetometer(recorded(np.repeat(outputs, 4, axis=0), rate=80.0)).calibration
    for name in NAMES:
        assert four.parameters[name].standard_uncertainty == pytest.approx(
            once.parameters[name].standard_uncertainty, rel=1e-9
        )
    assert any("1800 rows that repeat" in text for text in four.warnings)


def test_errors_in_common_widen_the_uncertainties(reduced):
    """An error that lasts for 20 readings is no independent one of each."""
    sensor, _ = waved(5)
    inside = []
    for seed in range(15 if reduced else 60):
        rng = np.random.default_rng(seed)
        slow = np.repeat(rng.standard_normal((80, 3)), 25, axis=0)
        walk = np.cumsum(0.15 * rng.standard_normal((2000, 3)), axis=0)  # a hand that turns slowly
        directions = np.array([1.0, 0, 0]) + walk - walk.mean(axis=0)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        surface = fit_surface(sensor.outputs(directions, 0.1, rng) + 0.5 * slow)
        scale = np.concatenate([np.ones(3), np.full(6, 1 / sensor.field)])
        error = scale * surface.theta - sensor.theta
        inside.append(np.abs(error) < 2.0 * scale * np.sqrt(np.diag(surface.covariance)))
    assert np.mean(inside) > (0.85 if reduced else 0.90)
    assert surface.inflation > 5


def test_no_reading_of_clean_recordings_is_set_aside():
    assert sum(int(find_disturbed(waved(seed, 800)[1], 12)[1].sum()) for seed in range(40)) <= 1


def test_clipped_and_dead_axes_are_refused():
    _, outputs = waved(5, 2000)
    clipped = np.minimum(outputs, np.quantile(outputs, 0.9, axis=0))
    with pytest.raises(DataError, match=r"mag_x: 200 of \d+ readings are .* saturated"):
        il.fit_magnetometer(recorded(clipped))
    outputs[:, 1] = 3.0
    with pytest.raises(DataError, match=r"mag_y: .* a dead axis"):
        il.fit_magnetometer(recorded(outputs))


def test_readings_that_lie_on_no_ellipsoid_are_refused_with_their_scatter():
    _, outputs = waved(3)
    outputs[300:] += 40.0  # a magnet beside it
    with pytest.raises(DataError, match=r"no ellipsoid fits the readings: \|m\| scatters by \d\d %"):
        il.fit_magnetometer(recorded(outputs))
    with pytest.raises(DataError, match="these are no readings"):
        il.fit_magnetometer(recorded(1e200 * outputs, "count"))


def test_clean_tests_are_good(reduced):
    verdicts = [
        il.fit_magnetometer(recorded(waved(seed, 500)[1])).calibration.verdict.state
        for seed in range(25 if reduced else 300)
    ]
    assert np.mean([state != "good" for state in verdicts]) <= 0.04


# The command, and what cannot be done with such a record.


def test_the_command_of_both_names_writes_the_same_record(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["magnetometer", "simulate", "--duration", "20 s", "-o", "w.csv"]) == 0
    assert main(["tumble", "mag", "w.csv", "--field", "48uT", "-o", "a.json", "--report", "a.html"]) == 0
    assert main(["magnetometer", "fit", "w.csv", "--field", "48uT", "-o", "b.json"]) == 0
    one, other = (json.loads((tmp_path / f"{name}.json").read_text()) for name in "ab")
    assert one["parameters"] == other["parameters"]
    truth = il.read("w.csv").metadata
    for name in NAMES:
        off = one["parameters"][name]["value"] - float(truth[f"truth_{name}"])
        assert abs(off) < 4 * one["parameters"][name]["standard_uncertainty"], name
    assert "is not told" in capsys.readouterr().out
    page = (tmp_path / "a.html").read_text()
    assert "What the magnitude is known to in each direction" in page


@pytest.mark.parametrize("option", ["hemisphere", "dip", "accel"])
def test_options_that_need_accelerometers_are_refused(option):
    _, outputs = waved(2)
    value = {"hemisphere": "north", "dip": "67 deg", "accel": "other.json"}[option]
    with pytest.raises(OptionError, match=f"{option} needs accelerometers"):
        il.fit_mag(recorded(outputs), **{option: value})


def test_a_unit_that_was_waved_beside_accelerometers_is_pointed_to_the_other_fit():
    _, outputs = waved(2)
    rng = np.random.default_rng(1)
    accel = {f"accel_{a}": 9.81 * rng.standard_normal(600) for a in "xyz"}
    both = recorded(outputs)
    both = il.Recording(both.columns | accel, both.units | dict.fromkeys(accel, "m/s^2"))
    with pytest.raises(il.ImulabError):
        il.fit_mag(both, gravity=9.81)
    table = {key: values[:5] for key, values in both.columns.items() if key != "time"}
    few = il.Recording(table, {key: both.units[key] for key in table})
    with pytest.raises(DataError, match="'imulab magnetometer fit' takes a unit that was waved by hand"):
        il.fit_mag(few, gravity=9.81)
    expected = il.fit_magnetometer(recorded(outputs)).calibration
    assert il.fit_magnetometer(both).calibration.parameters == expected.parameters


def test_headings_are_refused_since_the_rotation_is_not_told():
    _, outputs = waved(2)
    record = il.fit_magnetometer(recorded(outputs)).calibration
    with pytest.raises(RecordError, match="does not tell how they are turned"):
        il.apply(record, recorded(outputs), heading=True)


@pytest.mark.parametrize("target", ["px4", "ardupilot", "fusion", "ros", "motioncal"])
def test_other_programs_hold_it(target, tmp_path):
    sensor, outputs = waved(2)
    record = il.fit_magnetometer(recorded(outputs), field="48uT").calibration
    (file,) = il.export(target, record, tmp_path)
    inverse = np.linalg.inv(sensor.soft)
    text = file.read_text()
    for value in (inverse[0, 0], inverse[0, 1]):
        assert f"{value:.2f}" in text
    assert "ROT" not in text.replace("ROT (K", "") or target != "px4"
    _, outputs = levelled(2)
    with pytest.raises(RecordError, match="level turn, and tells nothing of axis z"):
        il.export(target, il.fit_magnetometer(recorded(outputs)).calibration, tmp_path)


@pytest.mark.parametrize("level", [False, True])
def test_a_phone_that_comes_to_the_unit_is_named_with_its_time(level):
    _, outputs = levelled(3) if level else waved(3)
    assert not any(
        "hard iron is another" in each for each in il.fit_magnetometer(recorded(outputs)).calibration.warnings
    )
    middle = len(outputs) // 2
    outputs[middle:] += np.array([1.8, -1.5, 0.0 if level else 1.9])
    record = il.fit_magnetometer(recorded(outputs)).calibration
    (said,) = [each for each in record.warnings if "hard iron is another" in each]
    begin = float(re.search(r"from ([\d.]+) s on the hard iron", said)[1])
    assert abs(begin - middle / 20.0) < 0.1 * len(outputs) / 20.0
    assert record.verdict.state == "look"
    assert any("nothing else near" in each for each in record.verdict.next)


# What an ellipsoid leaves out, and what is noise.


def bent(seed, size, count=3000, noise=0.4):
    """Return the hard iron, uT, and the record of a sensor whose outputs have a square, uT at the field's size."""
    rng, sensor = np.random.default_rng(seed), Sensor(seed)
    sensor.hard[:] = rng.uniform(-5, 5, 3)
    exact = sensor.outputs(by_hand(count, 50.0, rng), 0.0, rng)
    outputs = exact + size * ((exact - sensor.hard) / sensor.field) ** 2 + noise * rng.standard_normal(exact.shape)
    return sensor.hard, il.fit_magnetometer(recorded(outputs, rate=50.0), field="48uT").calibration


def off(hard, record):
    """Return errors of the hard iron over their stated uncertainties."""
    stated = [record.parameters[f"mag_bias_{axis}"] for axis in "xyz"]
    return [(1e6 * each.value - h) / (1e6 * each.standard_uncertainty) for each, h in zip(stated, hard, strict=True)]


def test_outputs_that_bend_a_little_widen_the_hard_iron(reduced):
    """A square of .2 % of the field hides .06 uT in the hard iron, five times its uncertainty by noise alone."""
    trials = [bent(seed, 0.1) for seed in range(8 if reduced else 40)]
    errors = np.array([off(*each) for each in trials])
    assert np.sqrt(np.mean(errors**2)) < 2.2
    assert np.mean(np.abs(errors) > 3) < 0.15
    assert all("square of the field" in reason for _, record in trials for reason in record.verdict.reasons)
    straight = np.array([off(*bent(seed, 0.0)) for seed in range(8 if reduced else 60)])
    assert np.mean(np.abs(straight) < 2) > 0.88
    assert np.sqrt(np.mean(straight**2)) > 0.7


def few(directions, seed, repeated=40, third=0.0, exact=False):
    """Return the record of readings in few directions, with a third power of the x output, and its true soft iron."""
    rng, sensor = np.random.default_rng(seed), Sensor(seed, axes=directions.shape[1], field=20.0)
    kept = np.repeat(directions, 1 if exact else repeated, axis=0)
    outputs = sensor.outputs(kept, 0.05, rng) + third * kept**3 * np.eye(directions.shape[1])[0]
    outputs = np.tile(outputs, (repeated, 1)) if exact else outputs
    if outputs.shape[1] == 2:
        outputs = np.column_stack([outputs, np.full(len(outputs), 44.0)])
    return sensor, il.fit_magnetometer(recorded(outputs, rate=50.0)).calibration


@pytest.mark.parametrize(
    ("count", "axes", "exact"), [(1200, 2, False), (7, 2, False), (12, 2, True), (10, 3, False), (600, 3, False)]
)
def test_bends_that_readings_cannot_tell_do_not_swell_the_uncertainties(count, axes, exact, reduced):
    """Third powers of two axes are alike in a level turn, and few directions tell no bend: both cost thousands of u."""
    for seed in range(5 if reduced else 25):
        rng = np.random.default_rng(100 + seed)
        directions = circle(count + 1, 1.0)[:-1] if axes == 2 else sphere(count, rng)
        repeated = 1 if count > 100 else 40
        sensor, record = few(directions, seed, repeated=repeated, exact=exact)
        bound = sensor.bound(np.repeat(directions, 1 if exact else repeated, axis=0), 0.05)
        least = np.sqrt(np.diag(bound)[axes:]).max()
        stated = [record.parameters[f"mag_soft_{'xyz'[i]}{'xyz'[j]}"] for i, j in sensor.places]
        assert max(each.standard_uncertainty for each in stated) < 12 * least


def test_a_third_power_in_a_level_turn_is_named_without_an_axis_and_is_in_the_uncertainty(reduced):
    for seed in range(2 if reduced else 6):
        sensor, record = few(circle(1200, 2.0), seed, repeated=1, third=0.4)
        (text,) = [text for text in record.verdict.reasons if "third power" in text]
        assert 0.2 < float(re.findall(r"not told\) ([\d.]+) uT", text)[0]) < 0.4
        ratio = sensor.soft[0, 0] / sensor.soft[1, 1]
        xx, yy = (record.parameters[f"mag_soft_{name}"] for name in ("xx", "yy"))
        assert abs(xx.value / yy.value - ratio) < 2.5 * np.hypot(xx.standard_uncertainty, yy.standard_uncertainty)


def test_outputs_that_bend_are_named_with_their_size():
    (said,) = [text for text in bent(3, 0.2, noise=0.05)[1].warnings if "square of the field" in text]
    sizes = [float(value) for value in re.findall(r"[xyz] ([+-][\d.]+)", said)]
    assert sizes == pytest.approx([0.2] * 3, abs=0.04)
    hard, record = bent(3, 0.8, noise=0.1)
    assert record.verdict.state == "look"
    assert "near the end of its range" in record.verdict.reasons[0]
    assert np.abs(off(hard, record)).max() < 2


@pytest.mark.parametrize("level", [False, True])
def test_noise_alone_is_no_iron(level):
    rng, sensor = np.random.default_rng(5), Sensor(5, axes=2 if level else 3, field=20.0)
    directions = circle(3000, 2.0) if level else by_hand(3000, 50.0, rng)
    outputs = sensor.outputs(directions, 0.6, rng)
    if level:
        outputs = np.column_stack([outputs, 40 + 0.6 * rng.standard_normal(3000)])
    record = il.fit_magnetometer(recorded(outputs, rate=50.0)).calibration
    assert record.verdict.state == "good"
    assert any("noise of single readings" in text for text in record.warnings)
    walk = np.repeat(rng.standard_normal((60, outputs.shape[1])), 50, axis=0)
    record = il.fit_magnetometer(recorded(outputs + 0.8 * walk, rate=50.0)).calibration
    assert any("no iron near that moved" in text for text in record.verdict.reasons)


def test_a_slow_drift_is_noted_and_widens_the_hard_iron(reduced):
    """A drift of .2 uT, .4 % of the field, is no phone."""
    notes = 0
    for seed in range(4 if reduced else 20):
        rng, sensor = np.random.default_rng(seed), Sensor(seed)
        drift = np.linspace(-0.1, 0.1, 3000)[:, None] * np.array([1.0, -0.6, 0.4])
        outputs = sensor.outputs(by_hand(3000, 50.0, rng), 0.2, rng) + drift
        record = il.fit_magnetometer(recorded(outputs, rate=50.0)).calibration
        assert record.verdict.state == "good"
        notes += sum("noise that is slow or a drift" in text for text in record.warnings)
        assert np.abs(off(sensor.hard, record)).max() < 3.5
    assert notes


# Real instruments.


@pytest.mark.parametrize("name", SAP5)
def test_sap5_the_magnetometers_alone_fit_as_well_as_beside_the_accelerometers(real_data, name):
    recording = sap5_recording(real_data / "sap5" / f"{name}.json")
    both = il.fit_mag(recording, gravity=G, order=2).calibration.fit["mag"]["magnitude"]["rms"]
    columns = {key: values for key, values in recording.columns.items() if key.startswith("mag")}
    alone = il.fit_mag(il.Recording(columns, dict.fromkeys(columns, "count"))).calibration
    assert 0.85 * both < alone.fit["rms"] < 1.05 * both  # |m| alone has no dip to agree with
    assert alone.verdict.state == "good"

"""New readings against a record of a magnetometer alone: false alarms, changes that are found, and the command."""

import json
import re

import numpy as np
import pytest
from tests.reference.field_alone import Sensor, circle, sphere
from tests.test_magnetometer_fit import NOISE, levelled, recorded, waved

import imulab as il
from imulab.cli import main
from imulab.errors import RecordError, UnitError


def pair(seed, axes, shift=0.0, field=1.0, count=300):
    """Return the record of a sensor, and new readings of it in a field of another size, with a shift of one output."""
    sensor, rng = Sensor(3, axes=axes, field=48.0 if axes == 3 else 20.0), np.random.default_rng([seed, axes])
    outputs = []
    for size, readings in ((1.0, 400), (field, count)):
        sensor.field = size * (48.0 if axes == 3 else 20.0)
        made = sensor.outputs(sphere(readings, rng) if axes == 3 else circle(readings, 2), NOISE / 2, rng)
        if axes == 2:
            made = np.column_stack([made, 43 + 0.2 * rng.standard_normal(readings)])
        outputs.append(made)
    outputs[1][:, 0] += shift
    return il.fit_magnetometer(recorded(outputs[0])).calibration, recorded(outputs[1])


def level(dip=63.3, turns=2, count=1500):
    """Return directions of the field in a unit that is turned level, shape (n, 3)."""
    angle, dip = np.linspace(0, 2 * np.pi * turns, count), np.radians(dip)
    return np.column_stack([np.cos(dip) * np.cos(angle), np.cos(dip) * np.sin(angle), np.full(count, -np.sin(dip))])


@pytest.mark.parametrize("axes", [3, 2])
def test_a_record_that_holds_fails_once_in_twenty(axes, reduced):
    trials = 60 if reduced else 600
    failed = [not il.check_magnetometer(*pair(seed, axes, field=1.1)).passed for seed in range(trials)]
    assert abs(np.mean(failed) - 0.05) < 3.3 * np.sqrt(0.05 * 0.95 / trials)


@pytest.mark.parametrize("axes", [3, 2])
@pytest.mark.parametrize("shift", [0.4, 5.0])
def test_a_change_of_hard_iron_is_found_and_named(axes, shift):
    check = il.check_magnetometer(*pair(1, axes, shift))
    assert not check.passed
    assert 1e6 * check.hard_iron[0] == pytest.approx(shift, abs=0.08)
    assert check.explained > 0.001
    assert "a hard iron that changed by x +" in check.meaning()


def test_another_field_is_of_the_place_and_passes():
    check = il.check_magnetometer(*pair(4, 3, field=0.8))
    assert check.passed
    assert check.field == pytest.approx(0.8, rel=3e-3)


def test_steel_that_passes_is_set_aside_and_said():
    record, fresh = pair(4, 3)
    columns = dict(fresh.columns)
    columns["mag_y"] = columns["mag_y"] + 8 * np.exp(-(((np.arange(300) - 100) / 4) ** 2))
    check = il.check_magnetometer(record, il.Recording(columns, fresh.units))
    assert check.passed
    assert "set aside" in check.notes[-1]


@pytest.mark.parametrize("shift", [(-40.0, -8.0), (-8.0, 3.0)])
def test_level_readings_of_a_record_of_all_directions_name_no_change_upwards(shift, reduced):
    """In a level turn a change upwards is one of the field's size: it reached 600 uT with nothing said of it."""
    named, errors = [], []
    for seed in range(5 if reduced else 40):
        sensor, outputs = waved(seed)
        record = il.fit_magnetometer(recorded(outputs)).calibration
        fresh = sensor.outputs(level(), 0.05, np.random.default_rng([seed, 4])) + np.array([*shift, 0.0])
        check = il.check_magnetometer(record, recorded(fresh))
        assert not check.passed
        text = r"changed by x -\d.*, y [-+]\d.* uT explains .*; along z they tell no change"
        named.append(re.search(text, check.meaning()) is not None)
        errors.append((1e6 * check.hard_iron[:2] - shift) / (1e6 * check.hard_iron_std[:2]))
        assert (1e6 * check.hard_iron_std[:2] < 3).all()
    assert np.mean(named) > 0.75  # a change that explains them is not thought to in 1 of 20
    assert 0.3 < np.sqrt(np.mean(np.square(errors))) < 1.2
    assert np.abs(errors).max() < 4


@pytest.mark.parametrize("noise", [0.05, 0.4])
def test_level_readings_of_a_record_of_all_directions_that_holds_pass(noise, reduced):
    """Derivatives share the noise of the readings where they are evaluated: 3 of 4 records that held had failed."""
    failed, explained = [], []
    for seed in range(30 if reduced else 200):
        sensor, outputs = waved(seed)
        fresh = sensor.outputs(level(), noise, np.random.default_rng([seed, 9]))
        check = il.check_magnetometer(il.fit_magnetometer(recorded(outputs)).calibration, recorded(fresh))
        failed.append(not check.passed)
        explained.append(check.explained < 0.05)
    slack = 3.3 * np.sqrt(0.05 * 0.95 / len(failed))
    assert abs(np.mean(failed) - 0.05) < slack
    assert np.mean(explained) < 0.05 + slack


@pytest.mark.parametrize("axes", [3, 2])
def test_readings_of_another_kind_fail(axes):
    """Waved readings of the record of a level turn, another range, and noise: nothing of them may tell a parameter."""
    record, fresh = pair(1, axes)
    rng = np.random.default_rng(1)
    outputs = fresh.triad("mag")
    hard = 1e6 * np.array([record.value(f"mag_bias_{axis}") for axis in "xyz"[:axes]])
    waved_about = np.zeros((300, 3))
    waved_about[:, :axes] = hard + 20 * sphere(300, rng)[:, :axes]
    noise = rng.standard_normal((300, 3))
    kinds = {
        "a quarter": outputs / 4, "tenfold": 10 * outputs, "far": outputs + 1e6, "noise": 40 * noise,
        "noisy": outputs + 25 * noise, "still": outputs[:1] + 0.3 * noise,
    }  # fmt: skip
    if axes == 2:
        kinds |= {"waved": waved_about, "few": waved_about[:12]}
    for kind, values in kinds.items():
        check = il.check_magnetometer(record, recorded(values))
        assert kind == "still" or not check.passed, kind
        assert "changed by  uT" not in check.meaning(), kind
        assert all(value is None or np.isfinite(value) for value in check.content()["hard_iron_change"]["value"])


def test_other_records_and_units_are_refused():
    _, outputs = waved(2)
    record = il.fit_magnetometer(recorded(outputs)).calibration
    with pytest.raises(UnitError, match="count, but the record calibrates outputs in uT"):
        il.check_magnetometer(record, recorded(outputs, "count"))
    tumble = il.fit_tumble(il.simulate_tumble(gravity=9.81, attitudes=12), order=1, gravity=9.81).calibration
    with pytest.raises(RecordError, match="expected a magnetometer record, found a tumble record"):
        il.check_magnetometer(tumble, recorded(outputs))
    with pytest.raises(RecordError, match="magnetometer"):
        il.check_tumble(record, il.simulate_tumble(gravity=9.81, attitudes=12))


def test_the_command_says_pass_and_fail(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    record, fresh = pair(1, 3)
    record.save("r.json")
    il.write_csv(fresh, "same.csv")
    il.write_csv(pair(1, 3, 4.0)[1], "other.csv")
    assert main(["magnetometer", "check", "r.json", "same.csv"]) == 0
    assert capsys.readouterr().out.startswith("pass: the readings agree with the record")
    assert main(["magnetometer", "check", "r.json", "other.csv", "--report", "c.html"]) == 1
    assert "a hard iron that changed by x +4" in capsys.readouterr().out
    assert "Magnitude of the field under the record" in (tmp_path / "c.html").read_text()
    assert main(["magnetometer", "check", "r.json", "other.csv", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["hard_iron_change"]["value"][0] == pytest.approx(4e-6, abs=1e-7)


def test_the_records_own_recording_is_warned_of(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name, seed in (("a.csv", 1), ("b.csv", 2)):
        il.write_csv(recorded(waved(seed)[1]), name)
    assert main(["magnetometer", "fit", "a.csv", "-o", "r.json"]) == 0
    warnings = []
    for name in ("a.csv", "b.csv"):
        capsys.readouterr()
        main(["magnetometer", "check", "r.json", name])
        warnings.append("warning: a.csv: the record was made from this recording, which" in capsys.readouterr().err)
    assert warnings == [True, False]


def test_units_of_a_line_are_fitted_by_a_fleet(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for k in (1, 2):
        il.write_csv(recorded(waved(k)[1]), f"{k}.csv")
    il.write_csv(recorded(levelled(3)[1]), "3.csv")
    rows = "".join(f"SN{k},magnetometer,{k}.csv\n" for k in (1, 2, 3))
    (tmp_path / "line.csv").write_text("serial,procedure,file\n" + rows)
    assert main(["fleet", "run", "line.csv", "-o", "out", "--workers", "1"]) == 0
    assert capsys.readouterr().out.startswith("3 units: 3 done, 0 failed")
    assert il.load("out/SN1.json").fit["not_told"] == ["rotation"]
    assert main(["fleet", "report", "out", "-o", "line.html"]) == 0

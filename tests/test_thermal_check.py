"""New recordings against a thermal record: false alarms, what is found, and what cannot be tested."""

import json
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from reference import thermal as reference

G = reference.G
TEMPERATURES = (-20, 0, 25, 45, 60)
NOISE, TAU = 60e-6, 1e-4


def table(outputs, temperature, name):
    """A table of attitudes with its noise stated."""
    columns = {f"accel_{axis}": outputs[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"std_accel_{axis}": np.full(len(outputs), NOISE * G) for axis in "xyz"}
    units = dict.fromkeys(columns, "m/s^2") | {"temperature": "degC"}
    columns |= {"temperature": np.asarray(temperature, dtype=float)}
    return il.Recording(columns=columns, units=units, metadata={"gravity": f"{G} m/s^2"}, name=name)


def measured(triad, rng, temperature, count, turn_on=TAU):
    return table(*reference.soak(triad, rng, temperature, count, NOISE * G, turn_on * G), f"at_{temperature:g}")


def calibrated(rng, visits=TEMPERATURES, turn_on=TAU):
    triad = reference.Triad(rng)
    recordings = [replace(measured(triad, rng, t, 12, turn_on), name=f"soak_{k}") for k, t in enumerate(visits)]
    return triad, il.fit_thermal(recordings, degrees="3,2,1").calibration


def share_of_alarms(trials, at, count, change=None, **unit):
    alarms = 0
    for trial in range(trials):
        rng = np.random.default_rng([11, trial])
        triad, record = calibrated(rng, **unit)
        if change is not None:
            change(triad)
        turn_on = unit.get("turn_on", TAU)
        alarms += not il.check_thermal(record, measured(triad, rng, at, count, turn_on)).passed
    return alarms / trials


def moved(group, axis, power, by):
    def change(triad):
        triad.laws[group][axis][power] += by

    return change


@pytest.mark.slow
@pytest.mark.parametrize(
    ("at", "count", "unit"),
    [
        (33.0, 12, {}),
        (60.0, 6, {}),
        (33.0, 12, {"turn_on": 0.0}),
        (33.0, 12, {"visits": (-20, -20, 0, 25, 25, 45, 60, 60)}),
    ],
)
def test_a_record_that_holds_fails_once_in_twenty(at, count, unit, reduced):
    """At most 5 %, within what trials tell: a binomial of 5 % lies below 9 % of 200, below 15 % of 50, with 99 %."""
    trials, most = (50, 0.15) if reduced else (200, 0.09)
    assert share_of_alarms(trials, at, count, **unit) < most


@pytest.mark.slow
def test_what_has_changed_is_found(reduced):
    """A scale factor by 500 ppm always, by 200 ppm mostly; a bias by 1 mg, ten times tau, mostly, though q is 3."""
    trials = 10 if reduced else 40
    assert share_of_alarms(trials, 33.0, 12, moved(1, 0, 0, 5e-4)) > 0.95
    assert share_of_alarms(trials, 33.0, 12, moved(1, 0, 0, 2e-4)) > 0.5
    assert share_of_alarms(trials, 33.0, 12, moved(0, 0, 0, 1e-3 * G)) > 0.5


@pytest.fixture(scope="module")
def unit():
    return calibrated(np.random.default_rng(5))


def test_fresh_attitudes_agree_and_a_changed_scale_factor_does_not(unit):
    triad, record = unit
    rng = np.random.default_rng(6)
    assert il.check_thermal(record, measured(triad, rng, 33.0, 12)).passed
    other = reference.Triad(np.random.default_rng(5))
    other.laws[1][0][0] += 1e-3
    found = il.check_thermal(record, [measured(other, rng, 10.0, 8), measured(other, rng, 50.0, 8)])
    assert not found.passed
    assert found.within < 1e-6
    assert "between attitudes or temperatures" in found.exhibits().headline


def test_residuals_are_those_of_the_model_inverted_by_hand(unit):
    triad, record = unit
    new = measured(triad, np.random.default_rng(7), 33.0, 6)
    held = reference.Triad(np.random.default_rng(0))
    held.laws = [
        [[record.value(f"{kind}_{axis}" + (f"_t{k}" if k else "")) for k in range(degree + 1)] for axis in axes]
        for kind, axes, degree in (
            ("bias", "xyz", 3), ("scale_factor", "xyz", 2), ("misalignment", ("yx", "zx", "zy"), 1)
        )
    ]  # fmt: skip
    middle = record.model["reference_temperature"]["value"]
    force = np.array([held.correct(row, 33.0 - middle + 20.0) for row in new.triad("accel")])
    lengthening = NOISE**2 * G  # two axes across, half of sigma^2 / g each, to the 2 % that scale factors are off 1
    expected = np.linalg.norm(force, axis=1) - G - lengthening
    assert il.check_thermal(record, new).residuals == pytest.approx(expected, abs=3e-9)


def test_an_offset_that_power_cycles_explain_is_no_alarm_and_a_larger_one_is(unit):
    triad, record = unit
    rng = np.random.default_rng(8)
    outputs, at = reference.soak(triad, rng, 33.0, 12, NOISE * G, 0.0)
    assert il.check_thermal(record, table(outputs + np.array([TAU * G, 0, 0]), at, "new")).passed
    found = il.check_thermal(record, table(outputs + np.array([5e-3 * G, 0, 0]), at, "new"))
    assert not found.passed
    assert found.between < found.within
    assert il.check_thermal(
        record, table(outputs + np.array([5e-3 * G, 0, 0]), at, "new"), turn_on_scatter="5 mg"
    ).passed


def test_holds_outside_the_range_are_said_and_left_out(unit):
    triad, record = unit
    rng = np.random.default_rng(9)
    both = [measured(triad, rng, 33.0, 6), measured(triad, rng, 75.0, 6)]
    found = il.check_thermal(record, both)
    assert len(found.holds) == 6
    assert any("6 of 12 holds are at 75.0 degC, outside the -20.0 to 60.0 degC" in note for note in found.notes)
    with pytest.raises(il.ImulabError, match=r"all holds are at 75\.0 degC, outside"):
        il.check_thermal(record, both[1])


def test_a_rest_ramp_is_tested_by_its_directions_too():
    recordings = il.simulate_thermal(ramps=2, turn_on=0.0)
    record = il.fit_thermal([recordings[k] for k in range(5)]).calibration
    assert il.check_thermal(record, recordings[5], turn_on_scatter="0.05 mg").passed
    bent = recordings[6].triad("accel") + 1e-4 * G * (recordings[6].column("temperature")[:, None] - 20) * [0, 1, 0]
    ramp = recordings[6].with_columns({f"accel_{a}": bent[:, k] for k, a in enumerate("xyz")}, {})
    found = il.check_thermal(record, ramp)
    assert not found.passed
    assert found.within < 1e-3


def test_without_a_scatter_what_recordings_have_in_common_is_not_tested():
    rng = np.random.default_rng(4)
    triad = reference.Triad(rng)
    record = il.fit_thermal([measured(triad, rng, t, 12) for t in (0, 60)], degrees="1,1,0").calibration
    found = il.check_thermal(record, measured(triad, rng, 0.0, 12))
    assert found.between is None
    assert any("state --turn-on-scatter" in note for note in found.notes)


def test_a_check_goes_all_the_way(tmp_path, monkeypatch, capsys, unit):
    monkeypatch.chdir(tmp_path)
    triad, record = unit
    record.save("unit.json")
    il.write(measured(triad, np.random.default_rng(6), 33.0, 8), "new.csv")
    assert main(["thermal", "check", "unit.json", "new.csv", "--report", "check.html"], project=False) == 0
    said = capsys.readouterr().out
    assert said.startswith("pass: the recordings agree with the record")
    assert "Thermal check: pass" in (tmp_path / "check.html").read_text(encoding="utf-8")
    assert main(["thermal", "check", "unit.json", "new.csv", "--limit", "1ug", "--json"], project=False) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "fail"
    assert len(found["holds"]) == 8


@pytest.mark.parametrize(
    ("change", "options", "said"),
    [
        (lambda r: r.with_columns({}, {f"accel_{a}": "V" for a in "xyz"}), {}, "are in V, but the record calibrates"),
        (lambda r: replace(r, columns={k: v for k, v in r.columns.items() if k != "temperature"}), {},
         "no column temperature"),
        (lambda r: r.with_columns({"temperature": r.column("temperature") + 273.15}, {}), {}, "are these kelvins?"),
        (lambda r: r.with_columns({a: r.column(a) * 10 for a in ("accel_x", "accel_y", "accel_z")}, {}), {},
         "is the unit wrong?"),
        (lambda r: r, {"limit": "-1 mg"}, "expected more than 0"),
        (lambda r: r, {"tilt": "0"}, "expected a size above 0"),
        (lambda r: r, {"turn_on_scatter": "-1 mg"}, "expected 0 or more"),
        (lambda r: r, {"gyro_turn_on_scatter": "1 deg/h"}, "the record holds no gyroscopes"),
        (lambda r: [], {}, "expected one recording or more"),
    ],
    ids=["volts", "no temperature", "kelvins", "ten g", "limit", "tilt", "scatter", "no gyroscopes", "none"],
)  # fmt: skip
def test_what_cannot_be_checked_is_refused_in_one_line(unit, change, options, said):
    triad, record = unit
    with pytest.raises(il.ImulabError) as refused:
        il.check_thermal(record, change(measured(triad, np.random.default_rng(6), 33.0, 6)), **options)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_another_procedures_record_is_refused():
    record = il.fit_tumble(il.simulate_tumble(gravity=9.81), order=1, gravity=9.81).calibration
    with pytest.raises(il.errors.RecordError, match="a tumble record cannot be checked over temperature"):
        il.check_thermal(record, il.simulate_thermal(attitudes=6)[0])

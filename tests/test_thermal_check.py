"""New recordings against a thermal record: false alarms, what is found, and what cannot be tested."""

import json
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.errors import OptionError, UnitError
from reference import thermal as reference
from reference import thermal_gyro as reference_gyro

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
        pytest.param(60.0, 6, {}, marks=pytest.mark.further),
        pytest.param(33.0, 12, {"turn_on": 0.0}, marks=pytest.mark.further),
        (33.0, 12, {"visits": (-20, -20, 0, 25, 25, 45, 60, 60)}),
    ],
)
def test_a_record_that_holds_fails_once_in_twenty(at, count, unit, reduced):
    """At most 5 %, within what trials tell: of a binomial of 5 %, 99 % lie below 9 % of 200, 92 % below 15 % of 20."""
    trials, most = (20, 0.15) if reduced else (200, 0.09)
    assert share_of_alarms(trials, at, count, **unit) < most


@pytest.mark.slow
def test_what_has_changed_is_found(reduced):
    """A scale factor by 500 ppm always, by 200 ppm mostly; a bias by 1 mg, ten times tau, mostly, though q is 3."""
    trials = 4 if reduced else 40
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


G_GYRO = reference_gyro.G


AT = (-20.0, 0.0, 20.0, 40.0, 60.0)


TAU_GYRO, NOISE_GYRO, EARTH = np.radians(0.01), np.radians(0.05), np.radians(15.0 / 3600)


UNITS = {"time": "s", "temperature": "degC"}


UNITS |= {f"accel_{a}": "m/s^2" for a in "xyz"} | {f"gyro_{a}": "rad/s" for a in "xyz"}


def recording(columns, name):
    return il.Recording(columns=columns, units=UNITS, name=name, metadata={"gravity": f"{G_GYRO} m/s^2"})


def calibrated_gyro(seed):
    rng = np.random.default_rng([31, seed])
    triad, gyros, made = reference_gyro.chamber(
        rng, AT, count=12, turn_on=TAU_GYRO, earth=EARTH, noise=NOISE_GYRO, accel_noise=3e-3, hold=4.0
    )
    given = [recording(columns, f"soak_{k}.csv") for k, columns in enumerate(made)]
    return rng, triad, gyros, il.fit_thermal(given, with_="gyro", degrees="3,2,1").calibration


def measured_gyro(rng, triad, gyros, at=33.0, offset=(0.0, 0.0, 0.0)):
    time, up, rates = reference_gyro.motion(rng, 12, earth=EARTH, hold=4.0)
    moved = TAU_GYRO * rng.standard_normal(3) + np.array(offset)
    return recording(
        reference_gyro.columns(triad, gyros, rng, at, time, up, rates, NOISE_GYRO, 3e-3, moved), "later.csv"
    )


@pytest.fixture(scope="module")
def unit_gyro():
    return calibrated_gyro(0)


@pytest.mark.slow
def test_gyroscopes_that_have_not_changed_pass(reduced):
    """Four tests, each at a quarter of 5 %: at most 9 of 60 units fail (binomial: 99.9 %), one of 4 (98.6 %)."""
    trials = 4 if reduced else 60
    failed = 0
    for seed in range(1, trials + 1):
        rng, triad, gyros, record = calibrated_gyro(seed)
        failed += not il.check_thermal(record, measured_gyro(rng, triad, gyros)).passed
    assert failed <= (1 if reduced else 9)


def test_a_record_with_turns_is_checked_by_its_scale_factors(unit_gyro):
    _, triad, gyros, record = unit_gyro
    assert record.model["gyro"]["scale"] == "turns"
    check = il.check_thermal(record, measured_gyro(np.random.default_rng(1), triad, gyros))
    assert check.gyro is not None
    assert check.passed
    assert check.gyro.residuals.shape == (12, 3)
    assert np.abs(check.gyro.residuals / check.gyro.standard_uncertainty).max() < 4
    # An output in deg/s is the same output.
    later = measured_gyro(np.random.default_rng(1), triad, gyros)
    names = [f"gyro_{a}" for a in "xyz"]
    turned = later.with_columns({n: np.degrees(later.columns[n]) for n in names}, dict.fromkeys(names, "deg/s"))
    np.testing.assert_allclose(il.check_thermal(record, turned).gyro.residuals, check.gyro.residuals, atol=1e-12)


def test_one_bias_that_has_moved_is_found_and_said(unit_gyro, tmp_path, capsys):
    _, triad, gyros, record = unit_gyro
    later = measured_gyro(np.random.default_rng(2), triad, gyros, offset=(0.0, np.radians(1.0), 0.0))
    check = il.check_thermal(record, later)
    assert not check.passed
    assert check.within > 0.01
    assert check.gyro.between < 1e-3
    assert check.gyro.worst[1] == 1
    assert check.gyro.residuals[:, 1].mean() == pytest.approx(-np.radians(1.0), rel=0.1)
    il.write_csv(later, tmp_path / "later.csv")
    record.save(tmp_path / "r.json")
    page = tmp_path / "c.html"
    assert main(["thermal", "check", str(tmp_path / "r.json"), str(tmp_path / "later.csv"), "--report", str(page)]) == 1
    said = capsys.readouterr().out
    assert "an offset of the gyroscopes that whole recordings have in common is larger than power cycles" in said
    assert "gyroscopes: within recordings p = " in said
    assert "The gyroscopes at rest under the record" in page.read_text()
    assert main(["thermal", "check", str(tmp_path / "r.json"), str(tmp_path / "later.csv"), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["gyro"]["p_between"] == pytest.approx(check.gyro.between, rel=0.2)
    assert il.check_thermal(record, later, gyro_turn_on_scatter="2 deg/s").passed


def test_what_cannot_be_tested_is_said(unit_gyro):
    _, triad, gyros, record = unit_gyro
    later = measured_gyro(np.random.default_rng(3), triad, gyros)
    accelerometers = {n: c for n, c in later.columns.items() if not n.startswith("gyro")}
    bare = replace(later, columns=accelerometers, units={n: later.units[n] for n in accelerometers})
    check = il.check_thermal(record, bare)
    assert check.gyro is None
    assert any("no columns gyro_x gyro_y gyro_z over time" in str(note) for note in check.notes)
    counts = later.with_columns({}, dict.fromkeys([f"gyro_{a}" for a in "xyz"], "count"))
    with pytest.raises(UnitError, match="gyro_x gyro_y gyro_z are in count, but the record calibrates outputs in"):
        il.check_thermal(record, counts)
    with pytest.raises(OptionError, match="gyro_turn_on_scatter -1: expected 0 or more"):
        il.check_thermal(record, later, gyro_turn_on_scatter=-1)
    plain = json.loads(json.dumps(record.fit))
    plain["gyro"]["between_recordings"]["from"] = "unknown"
    said = il.check_thermal(replace(record, fit=plain), later)
    assert said.gyro.between is None
    assert any("state --gyro-turn-on-scatter" in str(note) for note in said.notes)


def test_a_hold_with_a_slow_turn_about_the_vertical_is_left_out_as_by_the_fit(unit_gyro):
    """5 deg/s during the whole of the fifth hold, which no accelerometer sees."""
    _, triad, gyros, record = unit_gyro
    later = measured_gyro(np.random.default_rng(4), triad, gyros)
    hold, turn = round(4.0 * 50), round(2.0 * 50)
    during = slice(4 * (hold + turn), 4 * (hold + turn) + hold)
    up = later.triad("accel")[during].mean(axis=0) / G_GYRO
    columns = {}
    for k, a in enumerate("xyz"):
        columns[f"gyro_{a}"] = later.columns[f"gyro_{a}"].copy()
        columns[f"gyro_{a}"][during] += np.radians(5.0) * up[k]
    turning = later.with_columns(columns, dict.fromkeys(columns, "rad/s"))
    check = il.check_thermal(record, turning)
    assert check.passed
    assert check.gyro.holds.tolist() == [0, 1, 2, 3, 5, 6, 7, 8, 9, 10, 11]
    said = [note for note in check.notes if "left out" in note]
    assert len(said) == 1
    assert said[0].startswith("gyro: later.csv, ")
    assert said[0].endswith("the unit turned")
    both = [turning, replace(measured_gyro(np.random.default_rng(6), triad, gyros, at=50.0), name="warmer.csv")]
    fitted = il.fit_thermal(both, degrees="1,0,0", with_="gyro", gyro_turn_on_scatter=TAU_GYRO).calibration
    assert said[0] in fitted.warnings


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        (lambda v: 0 * v + 0.01, "column gyro_x: the same output in every sample at rest: a dead axis"),
        (lambda v: np.where(np.arange(len(v)) % 20 == 3, np.nan, v), "column gyro_x: expected a finite number"),
    ],
)
def test_faulty_columns_of_gyroscopes_leave_the_verdict_on_the_accelerometers(unit_gyro, broken, said):
    _, triad, gyros, record = unit_gyro
    later = measured_gyro(np.random.default_rng(5), triad, gyros)
    faulty = later.with_columns({"gyro_x": broken(later.columns["gyro_x"])}, {"gyro_x": "rad/s"})
    check, sound = (il.check_thermal(record, one) for one in (faulty, later))
    assert check.gyro is None
    assert (check.passed, check.within, check.between) == (True, sound.within, sound.between)
    assert any(note.startswith("gyroscopes not tested: later.csv: ") and said in note for note in check.notes)
    with pytest.raises(OptionError, match="gyro_turn_on_scatter -1: expected 0 or more"):
        il.check_thermal(record, faulty, gyro_turn_on_scatter=-1)

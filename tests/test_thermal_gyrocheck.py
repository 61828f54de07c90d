"""New recordings against the gyroscopes of a thermal record: false alarms, what is found, what cannot be tested."""

import json
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.errors import OptionError, UnitError
from reference import thermal_gyro as reference

G = reference.G
AT = (-20.0, 0.0, 20.0, 40.0, 60.0)
TAU, NOISE, EARTH = np.radians(0.01), np.radians(0.05), np.radians(15.0 / 3600)
UNITS = {"time": "s", "temperature": "degC"}
UNITS |= {f"accel_{a}": "m/s^2" for a in "xyz"} | {f"gyro_{a}": "rad/s" for a in "xyz"}


def recording(columns, name):
    return il.Recording(columns=columns, units=UNITS, name=name, metadata={"gravity": f"{G} m/s^2"})


def calibrated(seed):
    rng = np.random.default_rng([31, seed])
    triad, gyros, made = reference.chamber(
        rng, AT, count=12, turn_on=TAU, earth=EARTH, noise=NOISE, accel_noise=3e-3, hold=4.0
    )
    given = [recording(columns, f"soak_{k}.csv") for k, columns in enumerate(made)]
    return rng, triad, gyros, il.fit_thermal(given, with_="gyro", degrees="3,2,1").calibration


def measured(rng, triad, gyros, at=33.0, offset=(0.0, 0.0, 0.0)):
    time, up, rates = reference.motion(rng, 12, earth=EARTH, hold=4.0)
    moved = TAU * rng.standard_normal(3) + np.array(offset)
    return recording(reference.columns(triad, gyros, rng, at, time, up, rates, NOISE, 3e-3, moved), "later.csv")


@pytest.fixture(scope="module")
def unit():
    return calibrated(0)


@pytest.mark.slow
def test_gyroscopes_that_have_not_changed_pass(reduced):
    """Four tests, each at a quarter of 5 %: of 60 units at most 9 fail (binomial of 5 %: 99.9 %)."""
    trials = 15 if reduced else 60
    failed = 0
    for seed in range(1, trials + 1):
        rng, triad, gyros, record = calibrated(seed)
        failed += not il.check_thermal(record, measured(rng, triad, gyros)).passed
    assert failed <= (4 if reduced else 9)


def test_a_record_with_turns_is_checked_by_its_scale_factors(unit):
    _, triad, gyros, record = unit
    assert record.model["gyro"]["scale"] == "turns"
    check = il.check_thermal(record, measured(np.random.default_rng(1), triad, gyros))
    assert check.gyro is not None
    assert check.passed
    assert check.gyro.residuals.shape == (12, 3)
    assert np.abs(check.gyro.residuals / check.gyro.standard_uncertainty).max() < 4
    # An output in deg/s is the same output.
    later = measured(np.random.default_rng(1), triad, gyros)
    names = [f"gyro_{a}" for a in "xyz"]
    turned = later.with_columns({n: np.degrees(later.columns[n]) for n in names}, dict.fromkeys(names, "deg/s"))
    np.testing.assert_allclose(il.check_thermal(record, turned).gyro.residuals, check.gyro.residuals, atol=1e-12)


def test_one_bias_that_has_moved_is_found_and_said(unit, tmp_path, capsys):
    _, triad, gyros, record = unit
    later = measured(np.random.default_rng(2), triad, gyros, offset=(0.0, np.radians(1.0), 0.0))
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


def test_what_cannot_be_tested_is_said(unit):
    _, triad, gyros, record = unit
    later = measured(np.random.default_rng(3), triad, gyros)
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


def test_a_hold_with_a_slow_turn_about_the_vertical_is_left_out_as_by_the_fit(unit):
    """5 deg/s during the whole of the fifth hold, which no accelerometer sees."""
    _, triad, gyros, record = unit
    later = measured(np.random.default_rng(4), triad, gyros)
    hold, turn = round(4.0 * 50), round(2.0 * 50)
    during = slice(4 * (hold + turn), 4 * (hold + turn) + hold)
    up = later.triad("accel")[during].mean(axis=0) / G
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
    both = [turning, replace(measured(np.random.default_rng(6), triad, gyros, at=50.0), name="warmer.csv")]
    fitted = il.fit_thermal(both, degrees="1,0,0", with_="gyro", gyro_turn_on_scatter=TAU).calibration
    assert said[0] in fitted.warnings


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        (lambda v: 0 * v + 0.01, "column gyro_x: the same output in every sample at rest: a dead axis"),
        (lambda v: np.where(np.arange(len(v)) % 20 == 3, np.nan, v), "column gyro_x: expected a finite number"),
    ],
)
def test_faulty_columns_of_gyroscopes_leave_the_verdict_on_the_accelerometers(unit, broken, said):
    _, triad, gyros, record = unit
    later = measured(np.random.default_rng(5), triad, gyros)
    faulty = later.with_columns({"gyro_x": broken(later.columns["gyro_x"])}, {"gyro_x": "rad/s"})
    check, sound = (il.check_thermal(record, one) for one in (faulty, later))
    assert check.gyro is None
    assert (check.passed, check.within, check.between) == (True, sound.within, sound.between)
    assert any(note.startswith("gyroscopes not tested: later.csv: ") and said in note for note in check.notes)
    with pytest.raises(OptionError, match="gyro_turn_on_scatter -1: expected 0 or more"):
        il.check_thermal(record, faulty, gyro_turn_on_scatter=-1)

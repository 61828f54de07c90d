"""Magnetometers in a check by fresh attitudes: false alarms, what is found, another place, and what is said."""

import json
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.recording import Recording
from reference import magnetometer as reference

G = 9.80665
DIP = np.radians(67.0)
SWAY = np.radians(0.17)


def table(outputs, mag, unit="uT", name="table.csv"):
    columns = {f"accel_{a}": outputs[:, i].copy() for i, a in enumerate("xyz")}
    columns |= {f"mag_{a}": mag[:, i].copy() for i, a in enumerate("xyz")}
    return Recording(columns=columns, units={c: "g" if c[0] == "a" else unit for c in columns}, name=name)


def measured(truth, rng, count, place=1.0, name="table.csv"):
    turned = np.array([reference.random_rotation(rng) for _ in range(count)])
    outputs, mag = reference.simulate(truth, turned, rng, accel=5e-4, field=3e-3, dip=SWAY)
    return table(outputs, (mag - truth.hard_iron) * place + truth.hard_iron, name=name)


def unit(seed):
    """A unit mounted straight, its record, and random numbers to go on with."""
    rng = np.random.default_rng(seed)
    truth = replace(reference.random_unit(rng, DIP, np.eye(3), size=48.0), k2=np.zeros(3))
    record = il.fit_mag(measured(truth, rng, 24), gravity=G, order=1, field="48 uT", loss="square").calibration
    return truth, record, rng


def moved(truth, by):
    """The same unit with a hard iron that changed by so much of the field, in uT of the body."""
    return replace(truth, hard_iron=truth.hard_iron + np.diag(np.diag(truth.matrix)) @ by)


def test_a_record_that_holds_fails_once_in_twenty_and_a_change_is_found(reduced):
    trials = 30 if reduced else 100
    both, alone, found = 0, 0, 0
    for seed in range(trials):
        truth, record, rng = unit(seed)
        check = il.check_tumble(record, measured(truth, rng, 12), gravity=G)
        both += not check.passed
        alone += check.mag.probability < 0.05
        found += not il.check_tumble(record, measured(moved(truth, [0.02, 0, 0]), rng, 12), gravity=G).passed
    assert alone <= (5 if reduced else 11)  # 5 % and three standard deviations
    assert both <= (5 if reduced else 12)
    assert found >= 0.9 * trials


def test_a_hard_iron_that_moved_far_is_told_from_what_it_leaves():
    truth, record, rng = unit(200)
    check = il.check_tumble(record, measured(moved(truth, [0.15, -0.1, 0.0]), rng, 16), gravity=G)
    assert not check.passed
    assert check.accelerometers_agree
    assert check.mag.explained > 0.01
    np.testing.assert_allclose(
        1e6 * check.mag.hard_iron, 48 * np.array([0.15, -0.1, 0.0]), atol=0.4
    )  # 3 sigma of record and check


def test_another_place_is_no_change_of_the_unit():
    truth, record, rng = unit(201)
    elsewhere = replace(truth, dip=np.radians(52.0))
    check = il.check_tumble(record, measured(elsewhere, rng, 16, place=0.9), gravity=G)
    assert check.passed
    assert abs(check.mag.common[0] + 0.1) < 4 * check.mag.common_uncertainty[0]
    assert abs(check.mag.common[1] - np.radians(-15)) < 4 * check.mag.common_uncertainty[1]


def test_iron_near_one_attitude_is_named():
    truth, record, rng = unit(202)
    fresh = measured(truth, rng, 16)
    fresh.columns["mag_x"][6] += 4.0
    check = il.check_tumble(record, fresh, gravity=G)
    assert not check.passed
    assert check.mag.worst == 6
    assert check.mag.explained < 0.01


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    place = tmp_path_factory.mktemp("check")
    truth, record, rng = unit(203)
    record.save(place / "unit.json")
    for name, which in (("same.csv", truth), ("changed.csv", moved(truth, [0.05, 0, 0]))):
        il.write(measured(which, rng, 14, name=name), place / name)
    bare = measured(truth, rng, 14)
    il.write(Recording({k: v for k, v in bare.columns.items() if k[0] == "a"}, bare.units), place / "bare.csv")
    il.write(Recording({k: v[:3] for k, v in bare.columns.items()}, bare.units), place / "few.csv")
    return place


def test_the_command_says_which_triad_and_what_would_explain_it(files, tmp_path, capsys):
    record, gravity = str(files / "unit.json"), ["--gravity", str(G)]
    page = tmp_path / "check.html"
    assert main(["tumble", "check", record, str(files / "same.csv"), *gravity]) == 0
    said = capsys.readouterr().out
    assert said.startswith("pass")
    assert "magnetometers: |m| and dip stay the same, p = " in said
    assert "not tested: of the place" in said
    assert main(["tumble", "check", record, str(files / "changed.csv"), *gravity, "--report", str(page)]) == 1
    said = capsys.readouterr().out
    assert said.startswith("fail: hard or soft iron has changed since the record was made, or iron was near")
    assert "a hard iron that changed by (+2." in said
    assert "uT explains it" in said
    assert "Magnitude and dip of the field in each fresh attitude" in page.read_text()
    assert main(["tumble", "check", record, str(files / "changed.csv"), *gravity, "--json"]) == 1
    found = json.loads(capsys.readouterr().out)["mag"]
    assert found["p"] < 0.01 < found["hard_iron_change"]["p"]
    assert len(found["magnitude"]) == 14


def test_without_magnetometers_the_accelerometers_alone_are_tested_and_that_is_said(files, capsys):
    for name, why in (
        ("bare.csv", "no magnetometers in it"),
        ("few.csv", "3 attitudes; magnetometers are tested by 4"),
    ):
        assert main(["tumble", "check", str(files / "unit.json"), str(files / name), "--gravity", str(G)]) == 0
        captured = capsys.readouterr()
        assert "magnetometers" not in captured.out
        assert why in captured.err


def test_another_unit_of_the_outputs_is_named(files, capsys):
    fresh = il.read(files / "same.csv")
    counts = Recording(fresh.columns, {k: "g" if k[0] == "a" else "count" for k in fresh.columns}, name="c.csv")
    with pytest.raises(il.ImulabError, match="columns mag_x mag_y mag_z are in count, but the record calibrates"):
        il.check_tumble(il.load(files / "unit.json"), counts, gravity=G)

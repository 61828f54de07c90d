"""Headings of a plan: the figures of the methods document, what a fit then finds, and the sheet."""

import json

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.procedures.tumble.mag.heading import plan_headings
from imulab.procedures.tumble.plan import roll_pitch
from imulab.recording import Recording
from reference import magnetometer as reference

G = 9.80665
DIP = np.radians(67.0)
NOMINAL = reference.Truth(np.zeros(3), np.ones(3), np.zeros(3), np.zeros(3), np.eye(3), np.zeros(3), DIP)


@pytest.fixture(scope="module")
def plan():
    return il.plan_tumble(24, noise="20ug", order=2, with_="mag")


def turned(up, north):
    """Attitudes as the reference has them: columns east, north and up in body components."""
    return np.stack([np.cross(north, up), north, up], axis=2)


def predicted(attitudes):
    """Worst scale, symmetric off-diagonal, rotation, hard iron, and heading, per noise of |m| and dip."""
    up, field = reference.directions(attitudes, DIP)
    vector, rows = NOMINAL.vector(), []
    for k in range(13):
        ends = [reference.residuals(vector + s * 1e-6 * (np.arange(25) == k), up, field)[:, 1:] for s in (1, -1)]
        rows.append((ends[0] - ends[1]) / 2e-6)
    jacobian = np.stack(rows, axis=-1).reshape(-1, 13)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    pairs = [(1, 3), (2, 6), (5, 7)]  # of D by rows: xy yx, xz zx, yz zy
    mean = [covariance[np.ix_(p, p)] @ [s / 2, 0.5] @ [s / 2, 0.5] for s in (1, -1) for p in pairs]
    east, north = attitudes[:, :, 0], attitudes[:, :, 1]
    # m = D^-1 (M - h) turns by -(dD m + dh) . east / |m| cos(dip)
    slope = np.concatenate([np.einsum("ni,nj->nij", east, field).reshape(-1, 9), east], axis=1) / np.cos(DIP)
    heading = np.einsum("np,pq,nq->n", slope, covariance[:12, :12], slope).mean()
    assert north.shape == east.shape
    worst = [np.diag(covariance)[[0, 4, 8]].max(), max(mean[:3]), max(mean[3:]), np.diag(covariance)[9:12].max()]
    return np.sqrt([*worst, heading])


def test_quarter_turns_give_the_figures_of_the_document(plan):
    found = predicted(turned(plan.directions, plan.headings.north))
    np.testing.assert_allclose(found, [0.42, 0.31, 0.37, 0.26, 1.37], rtol=0.06)
    stated = plan.headings.uncertainties()
    assert abs(stated["heading"] / 3e-3 / found[4] - 1) < 1e-4
    assert abs(max(stated[f"mag_bias_{a}"] for a in "xyz") / 3e-3 / found[3] - 1) < 1e-4
    assert abs(max(stated[f"mag_scale_factor_{a}"] for a in "xyz") / 3e-3 / found[0] - 1) < 1e-4
    roll, pitch = roll_pitch(plan.directions).T
    one_way = np.column_stack([np.cos(pitch), np.sin(pitch) * np.sin(roll), np.sin(pitch) * np.cos(roll)])
    assert predicted(turned(plan.directions, one_way))[4] > 1e3  # one rotation of the magnetometers is blind
    assert predicted(turned(plan.directions, plan_headings(plan.directions, steps=1).north))[4] > 1.05 * found[4]


def test_quarter_turns_are_within_three_percent_of_steps_of_fifteen_degrees(plan):
    fine = plan_headings(plan.directions, steps=24)
    assert np.trace(plan.headings.covariance) < 1.03 * np.trace(fine.covariance)
    assert any("deg clockwise from north" in fine.facing(i) for i in range(24))


def test_what_the_sheet_names_points_where_it_says(plan):
    names = {"north": 0.0, "east": 90.0, "south": 180.0, "west": 270.0}
    seen = set()
    for index, (up, north) in enumerate(zip(plan.directions, plan.headings.north, strict=True)):
        axis, _, where = plan.headings.facing(index).partition(" to the ")
        pointer = np.eye(3)["xyz".index(axis[1])]
        assert abs(up @ north) < 1e-12
        heading = np.degrees(np.arctan2(pointer @ np.cross(north, up), pointer @ north)) % 360
        assert abs((heading - names[where] + 180) % 360 - 180) < 1e-6
        assert abs(pointer @ up) <= np.abs(up).min() + 1e-6
        seen.add(where)
    assert seen == {*names}


def test_a_fit_of_such_attitudes_is_as_certain_as_predicted(plan, reduced):
    trials = 5 if reduced else 12
    rng = np.random.default_rng(4)
    attitudes, found = turned(plan.directions, plan.headings.north), []
    for _ in range(trials):
        outputs, mag = reference.simulate(NOMINAL, attitudes, rng, accel=1e-6, field=3e-3, dip=0.0)
        mag += 1e-9  # the noise of the dip is 0.17 deg by that of the field already
        columns = {f"accel_{a}": outputs[:, i] for i, a in enumerate("xyz")}
        columns |= {f"mag_{a}": mag[:, i] for i, a in enumerate("xyz")}
        units = {name: "g" if name[0] == "a" else "count" for name in columns}
        record = il.fit_mag(Recording(columns, units), gravity=G, order=2, loss="square").calibration
        found.append([record.parameters[name].standard_uncertainty for name in ("mag_bias_x", "mag_misalignment_yz")])
    stated = plan.headings.uncertainties()
    expected = [stated["mag_bias_x"], stated["mag_misalignment_yz"]]
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(found), axis=0)), expected, rtol=0.1)


def test_the_plan_on_disk_is_planned_on_from(tmp_path, capsys):
    first, second = tmp_path / "first.csv", tmp_path / "second.csv"
    common = ["--order", "1", "--noise", "20ug", "--with", "mag"]
    assert main(["tumble", "plan", "--attitudes", "12", *common, "-o", str(first), "--report",
                 str(tmp_path / "sheet.html")]) == 0  # fmt: skip
    assert "mag_misalignment_zy" in capsys.readouterr().out
    sheet = (tmp_path / "sheet.html").read_text()
    assert sheet.count(" to the ") >= 12
    assert sheet.count(">N</text>") == 12
    assert "does not matter" not in sheet
    assert main(["tumble", "plan", "--attitudes", "6", *common, "--add", str(first), "--json", "-o", str(second)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert len(found["attitudes"]) == 6
    assert {"north", "facing"} <= {*found["attitudes"][0]}
    assert found["parameters"]["heading"]["unit"] == "rad"
    alone = il.plan_tumble(12, noise="20ug", order=1, with_="mag")
    both = il.plan_tumble(6, noise="20ug", order=1, with_="mag", add=alone)
    assert both.headings.already == 12
    assert both.headings.heading < 0.9 * alone.headings.heading
    again = found["parameters"]["heading"]["standard_uncertainty"]
    assert abs(again / both.headings.uncertainties()["heading"] - 1) < 1e-3
    plain = il.plan_tumble(12, noise="20ug", order=1)
    assert plain.headings is None
    assert "north" not in plain.sheet()


def test_a_record_with_magnetometers_counts_what_it_faced(tmp_path):
    recording = il.simulate_tumble(attitudes=16, order=1, hold="2 s", gravity=G, field="48 uT")
    record = il.fit_mag(recording, order=1, gravity=G).calibration
    plan = il.plan_tumble(4, noise="20ug", order=1, with_="mag", add=record)
    assert plan.headings.already == 16
    plain = il.fit_tumble(recording, order=1, gravity=G).calibration
    alone = il.plan_tumble(12, noise="20ug", order=1, with_="mag", add=plain)
    assert alone.headings.already == 0


def test_headings_that_cannot_be_are_refused(capsys):
    plan = ["tumble", "plan", "--noise", "20ug", "--order", "1"]
    assert main([*plan, "--attitudes", "9", "--with", "mag"]) == 2
    assert "--with mag: 9 attitudes; a magnetometer needs 10 or more" in capsys.readouterr().err
    assert main([*plan, "--attitudes", "12", "--with", "gyro"]) == 2
    assert "--with 'gyro': expected mag" in capsys.readouterr().err
    two_faces = np.tile([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], (8, 1))
    with pytest.raises(il.ImulabError, match="no headings of these 16 attitudes determine a magnetometer"):
        plan_headings(two_faces)

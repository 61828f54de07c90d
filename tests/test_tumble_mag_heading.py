"""Heading and dip columns: against the attitudes themselves, a Monte Carlo of the record, and errors of whole fits."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import imulab as il
import madeup
from imulab.cli import main
from imulab.errors import RecordError
from imulab.procedures.apply import add_heading, loaded
from imulab.procedures.tumble.mag.heading import plan_headings, read_law
from imulab.procedures.tumble.plan import roll_pitch
from imulab.procedures.tumble.procedure import TumbleProcedure
from imulab.recording import Recording
from reference import magnetometer as reference

G = 9.80665


DIP = np.radians(67.0)


COLUMNS = ("heading", "std_heading", "dip", "std_dip")


def table(outputs, mag, unit="uT"):
    columns = {f"accel_{a}": outputs[:, i].copy() for i, a in enumerate("xyz")}
    columns |= {f"mag_{a}": mag[:, i].copy() for i, a in enumerate("xyz")}
    return Recording(columns=columns, units={c: "g" if c[0] == "a" else unit for c in columns}, name="table.csv")


def attitudes(rng, count=24):
    return np.array([reference.random_rotation(rng) for _ in range(count)])


def fitted(seed, accel=5e-4, field=3e-3, dip=0.0, mag_order=1):
    """A unit mounted straight, so that its outputs keep their names, and its record."""
    rng = np.random.default_rng(seed)
    truth = reference.random_unit(rng, DIP, np.eye(3), size=48.0)
    data = reference.simulate(truth, attitudes(rng), rng, accel=accel, field=field, dip=dip)
    fit = il.fit_mag(table(*data), gravity=G, order=2, field="48 uT", loss="square", mag_order=mag_order)
    return truth, fit.calibration


def headings(turned):
    """Of the body's x axis, clockwise from north, rad, by the attitudes themselves."""
    return np.arctan2(turned[:, 0, 0], turned[:, 0, 1]) % (2 * np.pi)


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def exact_outputs(truth, turned):
    up, field = reference.directions(turned, truth.dip)
    return reference.accelerometer_output(truth, up), field @ truth.matrix.T + truth.hard_iron


def test_heading_and_dip_are_those_of_the_attitudes():
    truth, record = fitted(1, accel=0.0, field=0.0)
    turned = attitudes(np.random.default_rng(2), 200)
    found = il.apply(record, table(*exact_outputs(truth, turned)), heading=True)
    assert [found.units[name] for name in COLUMNS] == ["deg"] * 4
    assert np.abs(wrapped(np.radians(found.column("heading")) - headings(turned))).max() < 1e-8
    np.testing.assert_allclose(found.column("dip"), 67.0, atol=1e-7)
    assert ((found.column("heading") >= 0) & (found.column("heading") < 360)).all()


def drawn_vectors(record, outputs, mag, rng, count):
    """f and m of each sample under parameters drawn from the record, by inverting the model anew, (count, n, 3)."""
    names = [name for name in record.covariance.names if name != "dip"]
    mean = np.array([record.value(name) for name in names])
    spread = np.sqrt(np.diag(record.cov(*names)))
    root = np.linalg.cholesky(record.cov(*names) / np.outer(spread, spread))
    values = mean + spread * (rng.standard_normal((count, len(names))) @ root.T)
    draws = dict(zip(names, values.T[:, :, None], strict=True))

    def vectors(stem, samples, free):
        s = []
        for i, a in enumerate("xyz"):
            y = samples[:, i] / draws[f"{stem}scale_factor_{a}"] - draws[f"{stem}bias_{a}"]
            k2 = draws.get(f"{stem}k2_{a}")
            s.append(y if k2 is None else 2 * y / (1 + np.sqrt(1 + 4 * k2 * y)))
        turn = np.zeros((count, 3, 3)) + np.eye(3)
        for pair in free:
            turn[:, "xyz".index(pair[0]), "xyz".index(pair[1])] = draws[f"{stem}misalignment_{pair}"][:, 0]
        return np.linalg.solve(turn[:, None], np.stack(s, axis=-1)[..., None])[..., 0]

    force = vectors("", outputs, ("yx", "zx", "zy"))
    return force, vectors("mag_", mag, ("xy", "xz", "yx", "yz", "zx", "zy"))


@pytest.mark.parametrize("mag_order", [1, 2])
def test_uncertainties_are_those_of_a_monte_carlo_of_the_record(mag_order):
    truth, record = fitted(3, mag_order=mag_order)
    rng = np.random.default_rng(4)
    turned = attitudes(rng, 12)
    outputs, mag = exact_outputs(truth, turned)
    found = il.apply(record, table(outputs, mag), heading=True)
    law = read_law(record)
    force, field = drawn_vectors(record, outputs, mag, rng, 4000)
    force = force + law.force_noise * rng.standard_normal(force.shape)
    field = field + law.field_noise * 48e-6 * rng.standard_normal(field.shape)
    up = force / np.linalg.norm(force, axis=-1, keepdims=True)
    level = field - np.einsum("kni,kni->kn", field, up)[..., None] * up
    north = level / np.linalg.norm(level, axis=-1, keepdims=True)
    heading = np.arctan2(np.cross(north, up)[..., 0], north[..., 0])
    middle = np.radians(found.column("heading"))
    spread = np.degrees(np.sqrt(np.mean(wrapped(heading - middle) ** 2, axis=0)))
    clear = found.column("std_heading") < 5
    assert clear.sum() >= 10
    np.testing.assert_allclose(found.column("std_heading")[clear], spread[clear], rtol=0.06)
    dip = np.arcsin(-np.einsum("kni,kni->kn", field, up) / np.linalg.norm(field, axis=-1))
    np.testing.assert_allclose(found.column("std_dip"), np.degrees(dip.std(axis=0)), rtol=0.06)


def test_whole_fits_err_by_what_the_record_predicts(reduced):
    """Sixty units calibrated at 0.3 %: heading errors of fresh attitudes over their predicted uncertainties."""
    trials = 20 if reduced else 60
    ratios = []
    for seed in range(trials):
        truth, record = fitted(100 + seed, dip=np.radians(0.17))
        turned = attitudes(np.random.default_rng(seed), 30)
        law = replace(read_law(record), force_noise=0.0, field_noise=0.0)
        corrected = il.apply(record, table(*exact_outputs(truth, turned)))
        found = law.angles(corrected.triad("accel"), corrected.triad("mag") * 1e-6)
        ratios.append(np.mean((wrapped(found.heading - headings(turned)) / found.heading_uncertainty) ** 2))
    assert 0.85 < np.sqrt(np.mean(ratios)) < 1.15


def test_samples_scatter_by_what_is_stated():
    """Within each attitude of a recording the parameters' part is common, and here far below the noise."""
    recording = il.simulate_tumble(attitudes=16, order=1, hold="3 s", gravity=G, field="48 uT", seed=5)
    found = il.apply(il.fit_mag(recording, order=1, gravity=G), recording, heading=True)
    attitudes, ratios = il.find_attitudes(recording), []
    for start, stop in zip(attitudes.start, attitudes.stop, strict=True):
        rows = (found.column("time") > start + 0.3) & (found.column("time") < stop - 0.3)
        for angle in ("heading", "dip"):
            error, u = np.radians(found.column(angle)[rows]), np.radians(found.column(f"std_{angle}")[rows])
            ratios.append(wrapped(error - error[0]).std() / np.median(u))
    assert np.median(ratios) == pytest.approx(1.0, abs=0.06)


def test_motion_and_a_vertical_axis_are_uncertain():
    truth, record = fitted(5)
    north_up = np.array([[[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]] * 3)  # x east, y north, z up
    outputs, mag = exact_outputs(truth, north_up)
    outputs[1] = reference.accelerometer_output(truth, np.array([[0.1, 0.0, 1.0]]))[0]
    outputs[2] = reference.accelerometer_output(truth, np.array([[0.5, 0.0, 1.0]]))[0]
    found = il.apply(record, table(outputs, mag), heading=True)
    assert abs(found.column("heading")[0] - 90) < 2
    steady, slow, fast = found.column("std_heading")
    assert slow == pytest.approx(steady, rel=0.05)
    assert fast > 5
    stood = np.array([[[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]])  # x up
    found = il.apply(record, table(*exact_outputs(truth, stood)), heading=True)
    assert found.column("std_heading")[0] > 10
    assert found.column("std_dip")[0] < 1


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    place = tmp_path_factory.mktemp("heading")
    recording = il.simulate_tumble(attitudes=16, order=1, hold="2 s", gravity=G, field="48 uT")
    il.write(recording, place / "rec.csv")
    il.fit_tumble(recording, order=1, gravity=G).save(place / "six.json")
    nine = il.fit_mag(recording, order=1, gravity=G, field="48 uT")
    nine.save(place / "nine.json")
    nine.export("blob", place / "fw")
    return place


def test_the_command_writes_the_columns_of_the_function(files, tmp_path):
    assert (
        main(["apply", str(files / "nine.json"), str(files / "rec.csv"), "--heading", "-o", str(tmp_path / "o.csv")])
        == 0
    )
    read, record = il.read(tmp_path / "o.csv"), il.load(files / "nine.json")
    for found in (il.apply(record, files / "rec.csv", heading=True), record.apply(files / "rec.csv", heading=True)):
        for name in COLUMNS:
            np.testing.assert_array_equal(read.column(name), found.column(name))
    plain = il.apply(record, files / "rec.csv")
    assert not {*COLUMNS} & {*plain.columns}
    np.testing.assert_array_equal(plain.column("mag_x"), read.column("mag_x"))


def test_rows_without_a_field_have_no_heading(files):
    recording = il.read(files / "rec.csv")
    slow = np.where(np.arange(len(recording)) % 5 == 0, recording.column("mag_y"), np.nan)
    found = il.apply(il.load(files / "nine.json"), recording.with_columns({"mag_y": slow}, {}), heading=True)
    for name in COLUMNS:
        np.testing.assert_array_equal(np.isnan(found.column(name)), np.isnan(slow))


def test_what_cannot_tell_a_heading_is_refused_by_name(files, tmp_path, capsys):
    out = tmp_path / "o.csv"

    def refused(record, file="rec.csv"):
        assert main(["apply", str(files / record), str(files / file), "--heading", "-o", str(out)]) == 2
        assert not out.exists()
        (line,) = capsys.readouterr().err.splitlines()
        return line

    assert "six.json: heading needs magnetometers, which the record does not hold; 'imulab tumble mag" in refused(
        "six.json"
    )
    assert "unit.blob: heading needs a record with magnetometers, found a blob" in refused("fw/unit.blob")
    recording = il.read(files / "rec.csv")
    kept = {name: values for name, values in recording.columns.items() if not name.startswith("mag")}
    il.write(Recording(kept, recording.units), files / "bare.csv")
    assert "bare.csv: no column mag_x; found " in refused("nine.json", "bare.csv")
    with pytest.raises(RecordError, match="heading needs magnetometers"):
        il.apply(il.load(files / "six.json"), recording, heading=True)


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


@pytest.mark.slow
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


@pytest.mark.slow
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


def test_true_headings_are_magnetic_ones_turned_by_the_declination_of_the_place(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pygeomag")
    monkeypatch.chdir(tmp_path)
    il.write_csv(il.simulate_tumble(order=1, gravity=G, field="48.8 uT", dip="64.4 deg", seed=3), "r.csv")
    place = ["--place", "48.1,11.6", "--date", "2026-11-28"]
    assert main(["tumble", "mag", "r.csv", "--gravity", str(G), "--order", "1", *place, "-o", "r.json"]) == 0
    for words, name in (
        (["--heading"], "m.csv"),
        (["--heading", "magnetic"], "n.csv"),
        (["--heading", "true"], "t.csv"),
    ):
        assert main(["apply", "r.json", "r.csv", *words, "-o", name]) == 0
    assert (tmp_path / "m.csv").read_bytes() == (tmp_path / "n.csv").read_bytes()
    magnetic, true = il.read("m.csv"), il.read("t.csv")
    declination = il.load("r.json").model["place"]["declination"]
    turned = np.radians(true.column("heading") - magnetic.column("heading"))
    np.testing.assert_allclose(wrapped(turned), declination["value"], atol=1e-9)
    np.testing.assert_allclose(
        true.column("std_heading"),
        np.minimum(np.hypot(magnetic.column("std_heading"), np.degrees(declination["standard_uncertainty"])), 103.93),
        rtol=1e-3,
    )
    assert true.metadata["heading"].startswith("from true north, declination +4.3")
    capsys.readouterr()
    assert main(["apply", "--heading", "r.json", "r.csv", "-o", "o.csv"]) == 0
    assert main(["apply", "--heading=up", "r.json", "r.csv", "-o", "o.csv"]) == 2
    assert "--heading 'up': expected one of no magnetic true" in capsys.readouterr().err
    assert main(["apply", "r.json", "r.csv", "--heading", "magnetc", "-o", "o.csv"]) == 2
    assert capsys.readouterr().err.endswith("no magnetic true; did you mean 'magnetic'?\n")
    (tmp_path / "r.csv").rename(tmp_path / "tru")  # a file, and no misspelt word
    assert main(["apply", "r.json", "--heading", "tru", "-o", "o.csv"]) == 0


def test_a_later_record_without_magnetometers_does_not_change_the_kind_of_heading(monkeypatch):
    asked = []
    monkeypatch.setattr(TumbleProcedure, "heading", lambda self, record, *, true=False: asked.append(true))
    written = Path(__file__).parent / "data" / "written_by" / "0.2.0"
    records = [madeup.tumble(), il.load(written / "warmup.json")]
    add_heading([loaded(record) for record in records], records, "true")
    assert asked == [True]


def test_true_headings_of_a_record_without_a_place_are_refused():
    truth, record = fitted(1)
    with pytest.raises(RecordError, match="true headings need the declination of the place"):
        il.apply(record, table(*exact_outputs(truth, attitudes(np.random.default_rng(2), 20))), heading="true")

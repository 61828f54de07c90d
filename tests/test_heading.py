"""Heading and dip columns: against the attitudes themselves, a Monte Carlo of the record, and errors of whole fits."""

from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.errors import RecordError
from imulab.procedures.tumble.mag.heading import law_of
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
    law = law_of(record)
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
        law = replace(law_of(record), force_noise=0.0, field_noise=0.0)
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
    assert "no column mag_x; heading needs" in refused("nine.json", "bare.csv")
    with pytest.raises(RecordError, match="heading needs magnetometers"):
        il.apply(il.load(files / "six.json"), recording, heading=True)

"""Magnetometers under what people do to them: the answer is right within its uncertainty, or the record says so.

The recordings are made here: a unit that is put down and turned by hand, its outputs those of the reference's unit.
"""

from __future__ import annotations

import importlib.util
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.errors import ImulabError, OptionError, SegmentError
from imulab.procedures.tumble.mag.heading import read_law
from imulab.recording import Recording
from reference import magnetometer as reference

G = 9.80665


DIP = np.radians(67.0)


F = 48.0


RATE, HOLD, MOVE = 50.0, 2.4, 1.2


def attitudes(rng, count=24):
    return np.array([reference.random_rotation(rng) for _ in range(count)])


def world_field(count):
    """The field in each attitude, east north up, uT."""
    return np.tile(F * np.array([0.0, np.cos(DIP), -np.sin(DIP)]), (count, 1))


def outputs(truth, turned, field, rng, noise=1e-3):
    """Tables of both triads for attitudes that carry the world (east, north, up) into the body, and their field."""
    m = np.einsum("nij,nj->ni", turned, field) / F
    accel = reference.accelerometer_output(truth, turned[:, :, 2]) + 3e-4 * rng.standard_normal((len(turned), 3))
    return accel, (m + noise * rng.standard_normal(m.shape)) @ truth.matrix.T + truth.hard_iron


def table(accel, mag, unit="uT"):
    columns = {f"accel_{a}": accel[:, i].copy() for i, a in enumerate("xyz")}
    columns |= {f"mag_{a}": mag[:, i].copy() for i, a in enumerate("xyz")}
    return Recording(columns, {c: "g" if c[0] == "a" else unit for c in columns}, name="table.csv")


def unit(rng, mounting=None):
    straight = np.eye(3) if mounting is None else mounting
    return reference.random_unit(rng, DIP, straight, size=F)


def heading_errors(record, truth):
    """Heading errors of fresh attitudes without noise in the undisturbed field, and what the record says of them, rms.

    Errors are about their mean: what is in the room may turn the whole field, which is declination.
    """
    rng = np.random.default_rng(99)
    turned = attitudes(rng, 60)
    corrected = il.apply(record, table(*outputs(truth, turned, world_field(60), rng, noise=0.0)))
    f, m = corrected.triad("accel"), corrected.triad("mag")
    up = f / np.linalg.norm(f, axis=1)[:, None]
    north = m - np.einsum("ni,ni->n", m, up)[:, None] * up
    north /= np.linalg.norm(north, axis=1)[:, None]
    angle = np.arcsin(np.clip(np.einsum("ni,ni->n", np.cross(turned[:, :, 1], north), up), -1, 1))
    stated = read_law(record).horizontal_uncertainty(f, m * (1e-6 if corrected.units["mag_x"] == "uT" else 1.0))[0]
    return float(np.std(angle)), float(np.sqrt(np.mean(stated**2)))


def fitted(recording, **options):
    """The record, or None where the recording is refused."""
    try:
        return il.fit_mag(recording, **{"gravity": G, "order": 2, "field": f"{F} uT", **options}).calibration
    except il.ImulabError:
        return None


def judged(recording, truth, **options):
    """``right``, ``said`` or ``silent``: wrong by more than thrice the stated uncertainty with the verdict good."""
    record = fitted(recording, **options)
    if record is None:
        return "said"
    error, stated = heading_errors(record, truth)
    if error < 3 * stated:
        return "right"
    return "silent" if record.verdict.state == "good" else "said"


def count(found):
    return {word: found.count(word) for word in ("right", "said", "silent")}


def turned_between(first, second, share):
    """The attitudes on the shortest way from one to another, shape (k, 3, 3), for the parts of it that are done."""
    turn = second @ first.T
    angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / (2 * np.sin(angle))
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    done = (angle * share)[:, None, None]
    return (np.eye(3) + np.sin(done) * cross + (1 - np.cos(done)) * cross @ cross) @ first


def by_hand(truth, rng, late=0.0, count=16):
    """A recording of attitudes that are held and turned between, with a magnetometer whose stamps are late."""
    stations = attitudes(rng, count)
    held, moved = np.zeros(round(HOLD * RATE)), np.arange(1, round(MOVE * RATE) + 1) / (round(MOVE * RATE) + 1)
    share = np.concatenate([held, moved])
    parts = [turned_between(a, b, share) for a, b in zip(stations, np.roll(stations, -1, axis=0), strict=True)]
    turned = np.concatenate(parts)[: -len(moved)]
    accel, mag = outputs(truth, turned, world_field(len(turned)), rng)
    shift = round(late * RATE)
    columns = {"time": np.arange(len(turned)) / RATE}
    columns |= {f"accel_{a}": accel[:, i] for i, a in enumerate("xyz")}
    columns |= {
        f"mag_{a}": np.concatenate([np.repeat(mag[:1, i], shift), mag[: len(mag) - shift, i]])
        for i, a in enumerate("xyz")
    }
    units = {name: {"t": "s", "a": "g", "m": "uT"}[name[0]] for name in columns}
    return Recording(columns, units, name="hand.csv")


def trial(make, seeds=6, **options):
    """How a few units fare: `make` gets random numbers, the unit and its attitudes, and returns a recording."""
    found = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        truth, turned = unit(rng), attitudes(rng)
        found.append(judged(make(rng, truth, turned), truth, **options))
    return count(found)


def direction(rng):
    vector = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)


@pytest.mark.parametrize("share", [0.02, 0.1, 0.3])
def test_a_phone_in_the_pocket_for_half_of_the_attitudes_is_never_silent(share):
    def phone(rng, truth, turned):
        field = world_field(24)
        field[12:] += share * F * direction(rng)
        return table(*outputs(truth, turned, field, rng))

    assert trial(phone)["silent"] == 0


def test_iron_that_comes_near_half_way_is_found_and_the_attitude_named(reduced):
    """One per cent of the field is found in nine units of ten, and once in a hundred what is not there."""
    trials = 8 if reduced else 20
    found = false = 0
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        truth, turned = unit(rng), attitudes(rng)
        field = world_field(24)
        false += any("than before" in w for w in fitted(table(*outputs(truth, turned, field, rng))).warnings)
        field[12:] += 0.01 * F * direction(rng)
        record = fitted(table(*outputs(truth, turned, field, rng)))
        said = [w for w in record.warnings if "than before" in w]
        found += bool(said) and record.verdict.state != "good"
    assert found >= 0.8 * trials
    assert false <= 0.1 * trials
    field[12:] += 0.1 * F * np.array([0.0, np.cos(DIP), -np.sin(DIP)])
    record = fitted(table(*outputs(truth, turned, field, rng)))
    (said,) = [w for w in record.warnings if "than before" in w]
    assert said.startswith("mag: from row 13 on |m| is ")
    assert "% higher and the dip" in said


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_a_magnet_that_stays_put_is_another_field_and_does_no_harm(share):
    def magnet(rng, truth, turned):
        field = world_field(24) + share * F * direction(rng)
        return table(*outputs(truth, turned, field, rng))

    assert trial(magnet, field=None)["silent"] == 0


def indoor(rng, share, lever):
    """Errors and what is stated of a unit that turns about a point beside it in a gradient, or is put down anywhere."""
    truth, turned = unit(rng), attitudes(rng)
    gradient = rng.standard_normal((3, 3))
    gradient = (gradient + gradient.T) / 2
    gradient -= np.eye(3) * np.trace(gradient) / 3  # no sources in the room's air
    places = np.einsum("nji,j->ni", turned, direction(rng)) if lever else rng.uniform(-1, 1, (24, 3))
    field = world_field(24) + share * F * places @ (gradient / np.linalg.norm(gradient))
    return heading_errors(fitted(table(*outputs(truth, turned, field, rng))), truth)


@pytest.mark.slow
def test_an_indoor_gradient_is_in_the_uncertainty_where_the_unit_is_put_down_anywhere(reduced):
    """And where it turns about a point beside the magnetometer, where much of it looks like hard iron."""
    trials = 12 if reduced else 24
    ratio = {}
    for lever in (False, True):
        found = [indoor(np.random.default_rng(seed), 0.02, lever) for seed in range(trials)]
        error, stated = np.sqrt(np.mean(np.square(found), axis=0))
        ratio[lever] = error / stated
    assert 0.7 < ratio[False] < 1.2
    assert 0.7 < ratio[True] < 1.3


@pytest.mark.parametrize("most", [0.3, 3.0])
def test_attitudes_of_one_heading_are_refused_or_called_so(most, reduced):
    trials = 2 if reduced else 5
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        turned = []
        for _ in range(24):
            yaw, pitch, roll = np.radians(most) * rng.uniform(-1, 1), *rng.uniform(-1, 1, 2) * [np.pi / 2, np.pi]
            c, s = np.cos([yaw, pitch, roll]), np.sin([yaw, pitch, roll])
            z = np.array([[c[0], s[0], 0], [-s[0], c[0], 0], [0, 0, 1]])
            x = np.array([[1, 0, 0], [0, c[1], s[1]], [0, -s[1], c[1]]])
            y = np.array([[c[2], 0, -s[2]], [0, 1, 0], [s[2], 0, c[2]]])
            turned.append(y @ x @ z)
        record = fitted(table(*outputs(unit(rng), np.array(turned), world_field(24), rng)))
        assert record is None or any("face nearly one way" in warning for warning in record.warnings)


@pytest.mark.parametrize("clipped", [1, 3, 6, 10])
def test_a_saturated_axis_is_refused_or_the_attitudes_are_left_out(clipped):
    def saturated(rng, truth, turned):
        accel, mag = outputs(truth, turned, world_field(24), rng)
        mag[:, 0] = np.minimum(mag[:, 0], np.sort(mag[:, 0])[-clipped])
        return table(accel, mag)

    found = trial(saturated)
    assert found["silent"] == 0
    assert (found["said"] == 6) == (clipped == 10)


def test_an_attitude_beside_a_strong_magnet_is_named_before_it_bends_the_fit():
    rng = np.random.default_rng(4)
    truth, turned = unit(rng), attitudes(rng)
    for size, refused in ((50.0, False), (400.0, True)):
        field = world_field(24)
        field[7] += size * direction(rng)
        recording = table(*outputs(truth, turned, field, rng))
        if refused:
            with pytest.raises(il.ImulabError, match=r"row 8: the outputs .* was a magnet near.* --drop 8$"):
                il.fit_mag(recording, gravity=G, order=2, field=f"{F} uT")
            recording = il.fit_mag(recording, gravity=G, order=2, field=f"{F} uT", drop=["8"])
        else:
            recording = il.fit_mag(recording, gravity=G, order=2, field=f"{F} uT")
            assert [one.index for one in recording.set_aside] == [7]
        error, stated = heading_errors(recording.calibration, truth)
        assert error < 3 * stated


def test_axes_that_are_saturated_in_some_attitudes_are_named_with_what_they_leave():
    rng = np.random.default_rng(9)
    accel, mag = outputs(unit(rng), attitudes(rng), world_field(24), rng)
    middle = mag.mean(axis=0)
    clipped = np.clip(mag, middle - 0.8 * F, middle + 0.7 * F)
    record = fitted(table(accel, clipped))
    (said,) = [warning for warning in record.warnings if "scatters by" in warning]
    found = re.search(r"is mag_([xyz]) saturated at (\S+) uT \((\d+) attitudes\)", said)
    values = clipped[:, "xyz".index(found[1])]
    assert min(abs(float(found[2]) - end) for end in (values.min(), values.max())) < 0.01
    assert int(found[3]) == max((values == values.max()).sum(), (values == values.min()).sum()) > 2


@pytest.mark.parametrize(("factor", "stated"), [(0.01, F), (10.0, F), (0.01, None), (10.0, None)])
def test_gauss_and_milligauss_taken_for_microtesla_are_refused(factor, stated):
    rng = np.random.default_rng(3)
    accel, mag = outputs(unit(rng), attitudes(rng), world_field(24), rng)
    with pytest.raises(il.ImulabError, match="is the unit wrong") as refused:
        il.fit_mag(table(accel, factor * mag), gravity=G, order=1, field=stated and f"{stated} uT")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("late", [0.0, 0.5, 1.0, 3.6])
@pytest.mark.slow
def test_a_magnetometer_on_another_clock_is_right_or_said(late):
    found = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        truth = unit(rng)
        recording = by_hand(truth, rng, late)
        found.append(judged(recording, truth, order=1))
        if late > HOLD:  # the field of the attitude before
            record = fitted(recording, order=1)
            assert record is None or record.verdict.state != "good"
    assert count(found)["silent"] == 0
    if late <= 0.3:
        assert count(found)["said"] == 0


@pytest.mark.parametrize("order", [[1, 2, 0], [2, 0, 1]])
def test_axes_that_are_named_in_another_turn_are_found_and_do_no_harm(order):
    rng = np.random.default_rng(11)
    truth = unit(rng)
    accel, mag = outputs(truth, attitudes(rng), world_field(24), rng)
    record = fitted(table(accel, mag[:, order]))
    named = [word[1] for word in record.model["mag_axes"].split()]
    assert named == ["xyz"[order.index(axis)] for axis in range(3)]
    straight = fitted(table(accel, mag))
    swapped = il.apply(record, table(accel, mag[:, order])).triad("mag")
    np.testing.assert_allclose(swapped, il.apply(straight, table(accel, mag)).triad("mag"), atol=1e-6)


def test_two_exchanged_axes_are_found_from_the_dip_where_the_latitude_is_known():
    rng = np.random.default_rng(12)
    accel, mag = outputs(unit(rng), attitudes(rng), world_field(24), rng)
    swapped = table(accel, mag[:, [1, 0, 2]])
    record = il.fit_mag(swapped, gravity=G, order=2).calibration
    (said,) = [warning for warning in record.warnings if "hemisphere" in warning]
    assert "the dip of -67.0 deg" in said or "the dip of -66.9 deg" in said or "the dip of -67.1 deg" in said
    assert "a magnetometer axis is reversed, two are exchanged" in said
    for known in ({"hemisphere": "north", "gravity": G}, {"latitude": "47 deg"}):
        with pytest.raises(il.ImulabError, match="that of the southern hemisphere: an odd number of magnetometer axes"):
            il.fit_mag(swapped, order=2, **known)
    il.fit_mag(table(accel, mag), order=2, latitude="47 deg")
    il.fit_mag(swapped, order=2, latitude="5 deg")  # near the equator the dip has either sign


@pytest.mark.parametrize(
    ("factor", "said"), [(1.0, False), (1.8, False), (1 / 1.8, False), (2.2, True), (4.0, True), (0.2, True)]
)
def test_a_magnitude_that_the_earth_does_not_have_is_said_without_a_field(factor, said):
    rng = np.random.default_rng(7)
    truth = unit(rng)
    accel, mag = outputs(truth, attitudes(rng), world_field(24), rng)
    record = il.fit_mag(table(accel, factor * mag), gravity=G, order=2).calibration
    assert any("the Earth's field has 22 to 67 uT" in one for one in record.warnings) == said
    assert any("the field's magnitude was not stated" in one for one in record.warnings) != said
    if said:
        assert record.verdict.state != "good"


def test_attitudes_that_leave_nothing_to_tell_the_noise_from_are_refused():
    rng = np.random.default_rng(5)
    accel, mag = outputs(unit(rng), attitudes(rng, 12), world_field(12), rng)
    with pytest.raises(il.ImulabError, match="12 attitudes for the 12 parameters of the accelerometers leave nothing"):
        il.fit_mag(table(accel, mag), gravity=G, order=2)
    il.fit_mag(table(accel, mag), gravity=G, order=1)


@pytest.fixture(scope="module")
def recording():
    return il.simulate_tumble(attitudes=16, order=1, hold="3 s", gravity=G, field="48 uT")


@pytest.fixture(scope="module")
def folder(recording, tmp_path_factory):
    place = tmp_path_factory.mktemp("nine")
    il.write(recording, place / "rec.csv")
    return place


def content(file):
    """A record, but for when it was made."""
    found = json.loads(file.read_text())
    del found["created"], found["content_sha256"]
    found.pop("fleet", None)
    return found


def ran(*words, status=0):
    assert main([str(word) for word in words], project=False) == status


def one_after_the_other(folder, *, field=()):
    """The three commands, each on the record of the one before."""
    rec = folder / "rec.csv"
    ran("tumble", "fit", rec, "-o", folder / "a.json")
    ran("tumble", "mag", rec, "--accel", folder / "a.json", *field, "-o", folder / "am.json")
    ran("tumble", "gyro", rec, "--accel", folder / "am.json", "-o", folder / "amg.json")
    return folder / "amg.json"


@pytest.mark.slow
def test_one_command_gives_what_three_give_one_after_the_other(folder):
    field = ["--field", "48uT"]
    three = one_after_the_other(folder, field=field)
    ran("tumble", "fit", folder / "rec.csv", "--with", "gyro,mag", *field, "-o", folder / "nine.json")
    assert content(folder / "nine.json") == content(three)
    ran("tumble", "fit", folder / "rec.csv", "--with", "mag", *field, "-o", folder / "mag.json")
    assert content(folder / "mag.json") == content(folder / "am.json")
    ran("tumble", "fit", folder / "rec.csv", "--with", "gyro", "-o", folder / "six.json")
    ran("tumble", "gyro", folder / "rec.csv", "--accel", folder / "a.json", "-o", folder / "ag.json")
    assert content(folder / "six.json") == content(folder / "ag.json")
    nine = il.load(folder / "nine.json")
    assert len([name for name in nine.parameters if name.startswith("gyro_")]) >= 12
    assert len([name for name in nine.parameters if name.startswith("mag_")]) == 12
    assert {*nine.covariance.names} == {*nine.parameters}


def test_a_fleet_gives_the_same(folder, recording):
    il.write(il.simulate_tumble(attitudes=16, order=1, hold="3 s", gravity=G, field="48 uT", seed=2), folder / "2.csv")
    rows = ["serial,procedure,file,with,field", 'A,tumble,rec.csv,"gyro,mag",48uT', "B,tumble,2.csv,mag,"]
    (folder / "line.csv").write_text("\n".join(rows) + "\n")
    state = il.run_fleet(folder / "line.csv", folder / "records", workers=1)
    assert state.count("done") == 2
    nine = il.fit_tumble(folder / "rec.csv", with_=("gyro", "mag"), field="48 uT").calibration
    assert il.load(folder / "records" / "A.json").parameters == nine.parameters
    assert "mag_bias_x" in (folder / "records" / "parameters.csv").read_text()
    (folder / "line.csv").write_text(rows[0] + "\nA,tumble,rec.csv,magnet,\n")
    with pytest.raises(OptionError, match=r"row 1 .*: column with 'magnet': expected gyro, mag or both"):
        il.run_fleet(folder / "line.csv", folder / "records", workers=1)


def test_triads_are_named_in_any_order_and_as_text(recording):
    texts = il.fit_tumble(recording, order=1, gravity=G, with_="mag, gyro").calibration
    names = il.fit_tumble(recording, order=1, gravity=G, with_=["gyro", "mag"]).calibration
    assert texts.parameters == names.parameters
    alone = il.fit_tumble(recording, order=1, gravity=G)
    both = il.fit_tumble(recording, order=1, gravity=G, with_="gyro")
    assert both.calibration.value("bias_x") == alone.calibration.value("bias_x")
    np.testing.assert_array_equal(both.residuals, alone.residuals)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"order": 0}, "order 0"),
        ({"order": "blend"}, "order blend"),
        ({"order": 1, "method": "linearised"}, "method linearised"),
        ({"order": 2, "cross": True}, "cross"),
        ({"monte_carlo": 1000}, "monte-carlo 1000"),
        ({"nonlinearity": (1e-5, 1e-5)}, "nonlinearity"),
        ({"prior": "unit.json"}, "prior"),
    ],
)
def test_what_the_joint_fit_does_not_have_is_refused_before_there_is_data(options, said):
    with pytest.raises(OptionError) as refused:
        il.fit_tumble("nowhere.csv", with_="gyro,mag", **options)
    assert str(refused.value).startswith(f"with_ mag does not go with {said}: ")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"with_": "magnet"}, "with_ 'magnet': expected gyro, mag or both"),
        ({"with_": ("mag", "mag")}, "with_ mag,mag: expected each triad once"),
        ({"with_": ""}, "with_ '': expected gyro, mag or both"),
        ({"field": "48 uT"}, "field without magnetometers: expected it with mag"),
        ({"with_": "gyro", "field": "48 uT"}, "field without magnetometers"),
        ({"with_": "mag", "field": 48.0}, "field 48 T: expected its magnitude"),
    ],
)
def test_a_triad_or_field_that_cannot_be_is_refused(options, said, capsys):
    with pytest.raises(OptionError) as refused:
        il.fit_tumble("nowhere.csv", **options)
    assert str(refused.value).startswith(said)


def test_each_triad_keeps_its_own_refusals(recording, folder, capsys):
    table = il.find_attitudes(recording)
    means = il.Recording.from_arrays(accel=table.mean, unit="m/s^2")
    with pytest.raises(SegmentError, match="a table of attitudes has no turns between them"):
        il.fit_tumble(means, gravity=G, order=1, with_="gyro")
    with pytest.raises(ImulabError, match="no column mag_x mag_y mag_z"):
        il.fit_tumble(means, gravity=G, order=1, with_="mag")
    ran("tumble", "fit", folder / "rec.csv", "--with", "mag", "--method", "linearised", "-o", folder / "x", status=2)
    assert capsys.readouterr().err.startswith("imulab: --with mag does not go with method linearised: ")
    assert not (folder / "x").exists()


def load_bench():
    path = Path(__file__).parent.parent / "benchmarks" / "truth" / "_magnetometer_bench.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    sys.modules[path.stem] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


truth_bench = load_bench()


def bench(**disturbance):
    """The record of a simulated test by another simulator, and the error of its scale factors over their size."""
    made = truth_bench.record(np.random.default_rng(3), truth_bench.Disturbance(**disturbance))
    record = il.fit_mag(made.recording, gravity=G, order=1, field="48 uT").calibration
    found = np.array([record.value(f"mag_scale_factor_{a}") for a in "xyz"])
    return made, record, found / (1e6 * np.diag(made.matrix)) - 1


def test_slow_magnetometers_are_carried_to_where_they_come_to_rest():
    """Without that, a low pass at 0.3 Hz costs 1.4 % of scale factor."""
    _, record, off = bench(corner=0.3)
    assert np.abs(off).max() < 1e-3
    assert record.verdict.state == "good"
    (note,) = [warning for warning in record.warnings if "low pass near" in warning]
    assert "0.3 Hz" in note or "0.29 Hz" in note or "0.31 Hz" in note
    assert not any("low pass near" in warning for warning in bench()[1].warnings)


@pytest.mark.parametrize("sway", [1e-3, 2e-3])
def test_sway_seen_in_the_dip_does_not_widen_the_accelerometers(sway):
    made, record, _ = bench(sway=sway)
    alone = il.fit_tumble(made.recording, gravity=G, order=1).calibration
    for name in made.accel:
        u, before = (each.parameters[name].standard_uncertainty for each in (record, alone))
        assert u < 1.1 * before  # 24 attitudes, of which the dip may set one aside


def test_a_phone_is_told_from_poses():
    assert any("phone" in warning for warning in bench(phone=1.0)[1].warnings)
    assert not any("phone" in warning for warning in bench(poses=True, gradient=10.0)[1].warnings)


def test_a_gradient_about_a_lever_is_in_the_uncertainty_of_the_hard_iron():
    made, record, _ = bench(gradient=10.0)
    scale = np.diag(made.matrix)
    clean = bench()[1]
    for i, axis in enumerate("xyz"):
        parameter = record.parameters[f"mag_bias_{axis}"]
        low, high = parameter.interval_95
        assert low < 1e-6 * made.hard_iron[i] / scale[i] < high
        assert parameter.standard_uncertainty > 3 * clean.parameters[f"mag_bias_{axis}"].standard_uncertainty

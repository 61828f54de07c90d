"""Accelerometers, magnetometers and gyroscopes of one recording in one command and one record."""

import json

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.errors import ImulabError, OptionError, SegmentError

G = 9.80665


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

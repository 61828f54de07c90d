"""The Earth's rate where the latitude is known: its vertical part comes off the gyroscopes, the level part stays.

The units are made by hand, turned and held at rest on a turning Earth, north and south of the equator.
"""

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.procedures.thermal.record import predict_gyro_bias
from reference import thermal_gyro as reference

G, EARTH = reference.G, reference.EARTH
AT = (-20.0013, 0.0021, 25.0034, 45.0017, 60.0042)
UNITS = {
    "time": "s",
    "temperature": "degC",
    **{f"accel_{a}": "m/s^2" for a in "xyz"},
    **{f"gyro_{a}": "rad/s" for a in "xyz"},
}
PLACES = (48.0, -48.0)


def recordings(latitude, temperatures=AT, count=8):
    """Gyroscopes and a recording at each temperature, almost without noise.

    Eight attitudes, whose turns are too few to tell scale factors: gyroscopes with no error of these.
    """
    rng = np.random.default_rng(5)
    gyros = reference.Gyros(rng)
    if count == 8:
        gyros.scale[:], gyros.matrix = [[1.0] * 3, [0.0] * 3], np.eye(3)
    triad, _, made = reference.chamber(rng, temperatures, count, gyros, noise=1e-6, latitude=np.radians(latitude))
    found = [il.Recording(columns=each, units=UNITS, name=f"soak_{k}.csv") for k, each in enumerate(made)]
    return triad, gyros, found


def sensitivities(record):
    return np.array([[record.value(f"gyro_g_sensitivity_{a}{b}") for b in "xyz"] for a in "xyz"])


@pytest.mark.parametrize("latitude", PLACES)
def test_over_temperature_the_g_sensitivity_is_free_of_the_vertical_part(latitude):
    """Without the latitude it is there in full, since it follows f exactly, whatever the attitudes, and u says so."""
    _, gyros, given = recordings(latitude)
    plain, known = (
        il.fit_thermal(given, gravity=G, with_="gyro", gyro_turn_on_scatter=0.0, latitude=place).calibration
        for place in (None, f"{latitude} deg")
    )
    vertical = EARTH * np.sin(np.radians(latitude)) / G
    without, left = (np.diag(sensitivities(each) - gyros.sensitivity) for each in (plain, known))
    assert without.mean() == pytest.approx(vertical, rel=0.15)
    assert np.abs(left).max() < 0.1 * abs(vertical)
    assert plain.fit["gyro"]["latitude"] is None
    assert known.fit["gyro"]["latitude"] == pytest.approx(np.radians(latitude))
    assert any("vertical part" in each for each in known.warnings)
    # Without the latitude the three have one unknown in common, whose variance is a third of the Earth's rate squared.
    covariance = plain.cov(*(f"gyro_g_sensitivity_{a}{a}" for a in "xyz"))
    assert np.sqrt(covariance) == pytest.approx(np.full((3, 3), EARTH / np.sqrt(3) / G), rel=0.05)
    assert (np.abs(without) < 1.96 * np.sqrt(np.diag(covariance))).all()
    # Along up nothing else of the Earth's rate is unknown, but for axes askew: such gyroscopes gain a lot by it.
    places = np.linspace(-20, 60, 9)
    for record in (plain, known):
        values, u = predict_gyro_bias(record, places)
        assert u.max() < 0.03 * EARTH
        assert (np.abs(values - gyros.bias_at(places).T) < 3 * u).all()


@pytest.mark.parametrize("latitude", [*PLACES, 90.0])
def test_the_vertical_part_is_not_taken_for_a_g_sensitivity(latitude):
    """Gyroscopes without any: quiet ones show the vertical part as clearly as a sensitivity of 8 to 15 deg/h/g."""
    rng = np.random.default_rng(8)
    gyros = reference.Gyros(rng, sensitivity=0.0)
    _, _, made = reference.chamber(rng, AT, 10, gyros, noise=1e-6, latitude=np.radians(latitude))
    given = [il.Recording(columns=each, units=UNITS, name=f"soak_{k}.csv") for k, each in enumerate(made)]
    record = il.fit_thermal(given, gravity=G, with_="gyro", gyro_turn_on_scatter=0.0).calibration
    assert record.model["gyro"]["g_sensitivity"] is False
    places = np.linspace(-20, 60, 9)
    values, u = predict_gyro_bias(record, places)
    assert (np.abs(values - gyros.bias_at(places).T) < 3.5 * u).all()


def test_at_a_pole_nothing_is_left_unknown():
    _, gyros, given = recordings(90.0)
    record = il.fit_thermal(given, gravity=G, with_="gyro", gyro_turn_on_scatter=0.0, latitude="90 deg").calibration
    assert np.abs(sensitivities(record) - gyros.sensitivity).max() < 1e-3 * EARTH / G
    assert record.parameters["gyro_bias_x"].standard_uncertainty < 0.03 * EARTH


@pytest.mark.parametrize("latitude", PLACES)
def test_turns_at_one_temperature_too(latitude):
    _, gyros, (given,) = recordings(latitude, (25.0034,), 24)
    accel = il.fit_tumble(given, order=1, gravity=G).calibration
    vertical = EARTH * np.sin(np.radians(latitude)) / G
    plain, known = (
        il.fit_gyro(accel, given, g_sensitivity="yes", latitude=place).calibration
        for place in (None, np.radians(latitude))
    )
    # What is found acts inside the misalignment: S (T w + b + G f) with w = vertical f.
    assert np.allclose(sensitivities(known) - sensitivities(plain), -vertical * gyros.matrix, atol=1e-3 * abs(vertical))
    off = [np.abs(np.diag(sensitivities(each) - gyros.sensitivity)).mean() for each in (plain, known)]
    assert off[1] < 0.3 * off[0]
    common = plain.cov(*(f"gyro_g_sensitivity_{a}{a}" for a in "xyz")) * G**2
    statistical = known.cov(*(f"gyro_g_sensitivity_{a}{a}" for a in "xyz")) * G**2
    assert common - statistical == pytest.approx(np.full((3, 3), EARTH**2 / 3), rel=0.02)
    assert (np.abs(np.diag(sensitivities(plain) - gyros.sensitivity)) * G < 1.96 * np.sqrt(np.diag(common))).all()
    assert known.fit["gyro"]["latitude"] == pytest.approx(np.radians(latitude))
    joint = il.fit_tumble(given, order=1, gravity=G, latitude=f"{latitude} deg", with_="gyro").calibration
    assert joint.fit["gyro"]["latitude"] == pytest.approx(np.radians(latitude))
    assert joint.model["gravity"]["value"] == G


@pytest.mark.parametrize("latitude", [*PLACES, 90.0])
def test_at_one_temperature_the_vertical_part_is_not_taken_for_a_g_sensitivity_either(latitude):
    rng = np.random.default_rng(8)
    gyros = reference.Gyros(rng, sensitivity=0.0)
    _, _, (columns,) = reference.chamber(rng, (25.0034,), 24, gyros, noise=1e-5, latitude=np.radians(latitude))
    given = il.Recording(columns=columns, units=UNITS, name="t.csv")
    accel = il.fit_tumble(given, order=1, gravity=G).calibration
    assert il.fit_gyro(accel, given).calibration.fit["gyro"]["g_sensitivity"] == "none"


def test_without_a_g_sensitivity_the_vertical_part_is_no_scatter():
    """At a pole nothing else of the Earth's rate is there, and the biases are known the better."""
    rng = np.random.default_rng(3)
    gyros = reference.Gyros(rng, sensitivity=0.0)
    gyros.bias[:] = 0  # else the clock's uncertainty is in theirs
    _, _, (columns,) = reference.chamber(rng, (25.0,), 24, gyros, noise=1e-6, latitude=np.radians(-90.0))
    given = il.Recording(columns=columns, units=UNITS, name="t.csv")
    accel = il.fit_tumble(given, order=1, gravity=G).calibration
    plain, known = (
        il.fit_gyro(accel, given, g_sensitivity="no", latitude=place).calibration for place in (None, "-90 deg")
    )
    for axis in "xyz":
        before, after = (each.parameters[f"gyro_bias_{axis}"] for each in (plain, known))
        assert after.standard_uncertainty < 0.01 * before.standard_uncertainty
        assert abs(after.value) < 4 * after.standard_uncertainty


def test_a_check_takes_off_what_the_fit_took_off():
    """Gyroscopes that are checked where they were calibrated pass, and with the latitude more is seen."""
    triad, gyros, given = recordings(48.0)
    options = {"gravity": G, "with_": "gyro", "gyro_turn_on_scatter": 0.0}
    known = il.fit_thermal(given, latitude="48 deg", **options).calibration
    time, up, rates = reference.motion(np.random.default_rng(9), 8, latitude=np.radians(48.0))
    columns = reference.columns(triad, gyros, np.random.default_rng(10), 25.0, time, up, rates, 1e-6, 1e-5)
    fresh = il.Recording(columns=columns, units=UNITS, name="later.csv")
    checks = [
        il.check_thermal(known, fresh, gravity=G, gyro_turn_on_scatter=0.0, latitude=place)
        for place in (None, "48 deg")
    ]
    assert all(each.gyro.within > 0.01 for each in checks)
    sizes = [np.sqrt(np.mean(each.gyro.residuals**2)) for each in checks]
    assert sizes[1] < 0.85 * sizes[0]
    assert checks[1].gyro.standard_uncertainty.max() < checks[0].gyro.standard_uncertainty.max()


def test_the_command_line_takes_a_latitude_and_refuses_what_is_none(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    _, _, (given,) = recordings(48.0, (25.0034,), 12)
    il.write(given, "t.csv")
    assert main(["tumble", "fit", "t.csv", "--gravity", "9.81+-0", "-o", "accel.json"], project=False) == 0
    gyro = ["tumble", "gyro", "t.csv", "--accel", "accel.json"]
    both = ["tumble", "fit", "t.csv", "--gravity", "9.81+-0", "--with", "gyro"]
    assert main([*gyro, "--latitude", "48", "-o", "a.json"], project=False) == 0
    assert main([*both, "--latitude", "48", "-o", "b.json"], project=False) == 0
    a, b = il.load("a.json"), il.load("b.json")
    assert a.fit["gyro"]["latitude"] == pytest.approx(np.radians(48.0))
    assert {n: p for n, p in a.parameters.items() if n.startswith("gyro")} == {
        n: p for n, p in b.parameters.items() if n.startswith("gyro")
    }
    for command in (gyro, both):
        capsys.readouterr()
        assert main([*command, "--latitude", "95", "-o", "c.json"], project=False) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert "latitude 95 deg: expected -90 to 90 deg" in error
    capsys.readouterr()
    assert main(["tumble", "fit", "t.csv", "--gravity", "9.81", "--latitude", "48", "-o", "c.json"], project=False) == 2
    assert "--gravity together with --latitude" in capsys.readouterr().err
    assert not (tmp_path / "c.json").exists()

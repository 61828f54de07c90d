"""What is known of local gravity, and what is not: its value, its uncertainty, and what they do to a record."""

import math
import sys

import numpy as np
import pytest

import imulab as il
from conftest import table
from imulab.cli import main
from imulab.errors import OptionError
from imulab.gravity import ANOMALY, at_latitude, field_at, gravity_option, normal_gravity, site, stated_gravity
from imulab.procedures.views import compare_records
from reference import tumble as reference

G = 9.81362


SIGMA = 1e-4


def recording_of(truth, order=3, seed=1, unit="m/s^2", head=None):
    rng = np.random.default_rng(seed)
    ups = reference.random_attitudes(rng, 40)
    data = np.array([reference.forward(G * u, truth, order) for u in ups])
    found = table(data + SIGMA * truth["scale_factor_x"] * rng.standard_normal(data.shape), unit)
    return found if head is None else il.Recording(found.columns, found.units, metadata={"gravity": head}, name="t.csv")


def fit(recording, gravity, order=3, **options):
    return il.fit_tumble(il.find_attitudes(recording), order=order, gravity=gravity, **options).calibration


@pytest.mark.parametrize(
    ("text", "value", "uncertainty"),
    [
        ("9.81362+-0.00002", 9.81362, 2e-5),
        ("9.81362 ± 0.00002", 9.81362, 2e-5),
        ("9.81362+/-20ug", 9.81362, 20e-6 * 9.80665),
        ("981.362e-2 m/s^2 +- 0", 9.81362, 0.0),
        ("9.81362", 9.81362, 0.0),
        ("9.8136", 9.8136, 0.5e-4 / np.sqrt(3)),
        ("9.81", 9.81, 0.5e-2 / np.sqrt(3)),
        ("9.8 m/s^2", 9.8, 0.5e-1 / np.sqrt(3)),
        ("1.0007 g", 1.0007 * 9.80665, 0.5e-4 * 9.80665 / np.sqrt(3)),
    ],
)
def test_a_stated_gravity_has_the_uncertainty_that_is_said_or_that_its_digits_say(text, value, uncertainty):
    found = stated_gravity(text, "--gravity")
    assert found.value == pytest.approx(value, rel=1e-15)
    assert found.standard_uncertainty == pytest.approx(uncertainty, rel=1e-12, abs=1e-15)


@pytest.mark.parametrize("text", ["9.8+-", "9.8+--0.1", "9.8+-2", "9.8+-soft", "9.8+-1e-5+-1e-6", "9.8+-0.1 s"])
def test_an_uncertainty_that_is_none_is_refused(imulab, text):
    with pytest.raises(OptionError, match=r"^--gravity '9\.8"):
        stated_gravity(text, "--gravity")
    done = imulab("tumble", "fit", "nothing.csv", "--gravity", text)
    assert done.returncode == 2
    assert done.stderr.startswith("imulab: --gravity '9.8")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("text", ["0", "0.000000", "-9.81", "981", "0+-0"])
def test_a_gravity_of_no_place_is_refused(imulab, text):
    with pytest.raises(OptionError, match=rf"^gravity {float(text.split('+')[0]):g}: expected the local value"):
        stated_gravity(text, "--gravity")
    done = imulab("tumble", "fit", "nothing.csv", "--gravity", text)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    truth = reference.random_truth(np.random.default_rng(3), 3)
    silent = fit(recording_of(truth, head=text), None)
    assert silent.model["gravity"]["from"] == "standard gravity, none given"


def test_normal_gravity_has_the_uncertainty_of_the_anomaly_and_of_a_height_that_is_not_given():
    known, guessed = (gravity_option(None, "48.137", height, "--{}") for height in ("520", None))
    assert known.standard_uncertainty == pytest.approx(ANOMALY, rel=0.01)
    assert 9e-6 < ANOMALY / G < 51e-6
    assert guessed.standard_uncertainty == pytest.approx(np.hypot(ANOMALY, 400 * 3.086e-6), rel=0.01)
    assert "--height lowers it" in guessed.note
    coarse = gravity_option(None, "48", "520", "--{}").standard_uncertainty
    slope = 9.7803 * 0.0053 * np.sin(2 * np.radians(48))  # of normal gravity, m/s^2/rad, to a percent
    assert np.sqrt(coarse**2 - ANOMALY**2) == pytest.approx(slope * np.radians(0.5) / np.sqrt(3), rel=0.02)
    assert gravity_option(None, "90", "0", "--{}").standard_uncertainty == pytest.approx(ANOMALY)


@pytest.mark.parametrize("unit", ["m/s^2", "count"])
def test_what_gravity_does_to_the_parameters_is_what_another_gravity_does_to_a_fit(unit):
    truth = reference.random_truth(np.random.default_rng(2), 3, 1.0 if unit == "m/s^2" else 400.0)
    recording, u = recording_of(truth, unit=unit), 1e-3
    record = fit(recording, f"{G}+-{u}")
    exact, low, high = (fit(recording, g) for g in (G, G - u, G + u))
    shared = record.fit["shared"][f"gravity {G!r} +- {u!r} m/s^2"]
    for name in record.parameters:
        moved = (high.value(name) - low.value(name)) / 2
        assert shared[name] == pytest.approx(moved, rel=1e-3, abs=1e-6 * abs(record.value(name))), name
        own = exact.parameters[name].standard_uncertainty
        assert record.parameters[name].standard_uncertainty == pytest.approx(np.hypot(own, moved), rel=1e-3), name
        assert record.value(name) == exact.value(name)
    block = record.covariance.block([f"scale_factor_{axis}" for axis in "xyz"])
    sigma = np.sqrt(np.diag(block))
    assert (block / np.outer(sigma, sigma)).min() > 0.9
    assert record.model["gravity"] == {"value": G, "unit": "m/s^2", "standard_uncertainty": u, "from": "argument"}
    assert "shared" not in exact.fit
    assert record.options["gravity"] == f"{G}+-{u}"
    assert exact.model["gravity"]["from"] == "argument, taken as exact"
    assert exact.options["gravity"] == G


@pytest.mark.parametrize("text", ["9.81362", "9.81362+-0", "9.81362+-0.00002", "9.81"])
def test_the_option_in_a_record_is_the_same_gravity_again(text):
    stated = stated_gravity(text, "gravity")
    again = stated_gravity(str(stated.option), "gravity")
    assert (again.value, again.standard_uncertainty) == (stated.value, stated.standard_uncertainty)


def test_trials_draw_gravity_too():
    truth = reference.random_truth(np.random.default_rng(2), 1)
    trials = fit(recording_of(truth, 1), f"{G}+-0.001", 1, monte_carlo=2000)
    for name, found in trials.fit["monte_carlo"]["parameters"].items():
        expected = trials.parameters[name].standard_uncertainty
        assert found["standard_deviation"] == pytest.approx(expected, rel=0.1), name


def test_two_records_of_one_place_have_its_gravity_in_common():
    truth = reference.random_truth(np.random.default_rng(2), 1)
    moved = truth | {"scale_factor_x": truth["scale_factor_x"] * (1 + 1e-4)}
    pairs = {g: [fit(recording_of(t, 1, s), g, 1) for s, t in ((1, truth), (2, moved))] for g in (G, f"{G}+-0.01")}
    exact, known = (compare_records(*pair) for pair in pairs.values())
    for one, other in zip(exact.changes, known.changes, strict=True):
        assert other.standard_uncertainty == pytest.approx(one.standard_uncertainty, rel=1e-3)
    assert known.probability == pytest.approx(exact.probability, rel=1e-2)
    assert [change.name for change in known.changes if change.significant] == ["scale_factor_x"]
    elsewhere = compare_records(pairs[f"{G}+-0.01"][0], fit(recording_of(moved, 1, 2), f"{G}+-0.011", 1))
    assert not any(change.significant for change in elsewhere.changes)


def test_the_head_of_a_file_is_believed_and_named():
    truth = reference.random_truth(np.random.default_rng(2), 1)
    record = fit(recording_of(truth, 1, head="9.81362+-0.00002 m/s^2"), None, 1)
    assert record.model["gravity"]["value"] == G
    assert record.model["gravity"]["standard_uncertainty"] == 2e-5
    assert record.model["gravity"]["from"] == "head of t.csv"
    assert any("(± 2.04 ppm) was taken from the head of t.csv" in w for w in record.warnings)
    assert record.verdict.state == "good"
    silent = fit(recording_of(truth, 1, head="unknown"), None, 1)
    assert silent.model["gravity"]["value"] == 9.80665
    assert silent.verdict.state == "look"
    expected = 0.0265 / np.sqrt(3) / 9.80665
    for axis in "xyz":
        scale = silent.parameters[f"scale_factor_{axis}"]
        assert scale.standard_uncertainty / scale.value == pytest.approx(expected, rel=0.01)
        assert abs(scale.value / truth[f"scale_factor_{axis}"] - 1) < 2 * expected


# NIMA TR8350.2 (3rd edition): gravity at the equator and at the pole of WGS 84, m/s^2; 45 deg as printed by the usual
# tables of WGS 84 normal gravity.
@pytest.mark.parametrize(
    ("degrees", "published"),
    [(0, 9.7803253359), (45, 9.8061977694), (-45, 9.8061977694), (90, 9.8321849379), (-90, 9.8321849379)],
)
def test_gravity_on_the_ellipsoid_is_the_published_one(degrees, published):
    assert normal_gravity(math.radians(degrees)) == pytest.approx(published, abs=0.6e-10)


def test_the_first_metres_cost_the_usual_free_air_gradient():
    # 0.3086 mGal/m, a number of four digits for middle latitudes; the second-order term is 7e-10 m/s^2 at 100 m.
    latitude = math.radians(45)
    fall = normal_gravity(latitude) - normal_gravity(latitude, 100.0)
    assert fall / 100.0 == pytest.approx(3.086e-6, abs=0.0006e-6)


A, F = 6378137.0, 1 / 298.257223563  # m; TR8350.2 tables 3.1 to 3.4


GM, OMEGA = 3986004.418e8, 7292115e-11  # m^3/s^2, rad/s


def exact_gravity(latitude: float, height: float) -> float:
    """Length of the gradient of the normal potential, Heiskanen and Moritz, Physical Geodesy (1967), 2-62."""
    b = A * (1 - F)
    e = math.sqrt(A * A - b * b)

    def q(u: float) -> float:  # as its series in e/u, which does not cancel
        return 2 * sum((-1) ** (n + 1) * n / ((2 * n + 1) * (2 * n + 3)) * (e / u) ** (2 * n + 1) for n in range(1, 12))

    def potential(p: float, z: float) -> float:
        r2 = p * p + z * z - e * e
        u = math.sqrt(r2 / 2 * (1 + math.sqrt(1 + 4 * e * e * z * z / (r2 * r2))))
        sine2 = (z / u) ** 2
        ring = OMEGA**2 * (A * A * q(u) / q(b) * (sine2 - 1 / 3) + (u * u + e * e) * (1 - sine2)) / 2
        return GM / e * math.atan2(e, u) + ring

    n = A / math.sqrt(1 - F * (2 - F) * math.sin(latitude) ** 2)
    p = (n + height) * math.cos(latitude)
    z = (n * (1 - F) ** 2 + height) * math.sin(latitude)
    step = 100.0  # m: truncation g (step/a)^2 = 2.4e-9, rounding 1e-16 * 6e7 / 200 = 4e-11 m/s^2
    along_p = (potential(p + step, z) - potential(p - step, z)) / (2 * step)
    along_z = (potential(p, z + step) - potential(p, z - step)) / (2 * step)
    return math.hypot(along_p, along_z)


@pytest.mark.parametrize("degrees", [0, 23, 47.3, -61, 89])
@pytest.mark.parametrize("height", [-500.0, 0.0, 250.0, 3000.0, 10000.0])
def test_gravity_above_the_ellipsoid_is_the_gradient_of_the_normal_potential(degrees, height):
    latitude = math.radians(degrees)
    # The series in h/a stops after the second term: the third is 4 g (h/a)^3. The second-order coefficient neglects
    # the flattening; the first-order one, by Bruns' formula gamma (1/M + 1/N) + 2 omega^2, 3/2 (f^2 + m^2).
    ratio, m = abs(height) / A, 0.00345
    bound = 9.9 * (4 * ratio**3 + 9 * F * ratio**2 + 3.2 * (F**2 + m**2) * ratio) + 4e-9
    assert normal_gravity(latitude, height) == pytest.approx(exact_gravity(latitude, height), abs=bound)


def test_north_and_south_are_alike():
    assert normal_gravity(0.7, 1234.0) == normal_gravity(-0.7, 1234.0)


@pytest.mark.parametrize("degrees", [90.001, -91, 180, math.nan, math.inf])
def test_a_latitude_beyond_the_pole_is_refused(degrees):
    with pytest.raises(OptionError, match=rf"latitude {degrees:g} deg: expected -90 to 90 deg"):
        normal_gravity(math.radians(degrees))


@pytest.mark.parametrize("height", [-500.1, 10000.5, math.nan])
def test_a_height_out_of_range_is_refused(height):
    with pytest.raises(OptionError, match=rf"height {height:g} m: expected -500 to 10000 m"):
        normal_gravity(0.5, height)


def test_a_place_may_be_a_text_and_degrees_without_one_are_told_how_to_be_written():
    assert normal_gravity("48.1 deg", "520 m") == normal_gravity(math.radians(48.1), 520.0)
    with pytest.raises(OptionError, match=r'expected -90 to 90 deg; numbers are rad, degrees are written "48.1 deg"'):
        normal_gravity(48.1)


def test_the_earth_turns_eastward_a_full_turn_in_a_sidereal_day():
    """So the rate points to the celestial north pole: up in the north, level at the equator, down in the south."""
    sidereal_day = 86164.0905  # s
    pole, equator, south = (at_latitude(f"{degrees} deg") for degrees in (90, 0, -30))
    assert pole.vertical == pytest.approx(2 * math.pi / sidereal_day, rel=1e-6)
    assert (equator.vertical, equator.level) == pytest.approx((0.0, 2 * math.pi / sidereal_day), rel=1e-6)
    assert south.vertical == pytest.approx(-math.pi / sidereal_day, rel=1e-6)
    assert at_latitude(None) is None


@pytest.mark.parametrize(
    ("place", "total", "dip", "declination"),
    [("80,0,0", 55000.1, 83.14, -1.28), ("0,120,0", 41104.9, -15.42, 0.16), ("-80,-120,0", 55120.6, -72.20, 69.36)],
)
def test_the_field_of_a_place_is_that_of_the_table_in_the_report_on_the_world_magnetic_model_of_2020(
    place, total, dip, declination
):
    found = field_at(site(place), "2020-01-01")
    assert found.model == "WMM-2020"
    assert found.magnitude[0] == pytest.approx(total * 1e-9, abs=0.051e-9)
    assert np.degrees([found.dip[0], found.declination[0]]) == pytest.approx([dip, declination], abs=0.0051)
    level = math.sqrt(total**2 - (total * math.sin(math.radians(dip))) ** 2)
    assert found.magnitude[1] == 148e-9  # of the report's error model
    assert np.degrees([found.dip[1], found.declination[1]]) == pytest.approx(
        [0.21, math.hypot(0.26, 5625 / level)], 1e-3
    )


@pytest.mark.parametrize(
    ("place", "part"),
    [
        ("151.2,-33.9", "are latitude and longitude exchanged? expected -33.9,151.2"),
        ("200,10", "latitude 200 deg: expected -90 to 90"),
        ("10,200", "longitude 200 deg: expected -180 to 180"),
        ("48.1,11.6,20000", "height 20000 m: expected -500 to 10000"),
        ("48.1", "expected latitude and longitude, deg, and perhaps the height, m: 48.1,11.6,520"),
        ("48.1,north", "48.1,north"),
    ],
)
def test_a_place_that_cannot_be_is_refused_by_name(place, part):
    with pytest.raises(OptionError, match=r"^--place") as refused:
        site(place, "--place")
    assert part in str(refused.value)


@pytest.mark.parametrize(
    ("date", "part"), [("2014-12-31", "2015 to 2029"), ("2030-01-01", "2015 to 2029"), ("yesterday", "2026-11-28")]
)
def test_a_day_that_no_model_covers_is_refused(date, part):
    with pytest.raises(OptionError, match=part):
        field_at(site("48.1,11.6"), date)


def test_without_the_package_of_the_models_the_refusal_names_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygeomag", None)
    with pytest.raises(OptionError, match=r"needs pygeomag, which is not here: pip install '\.\[place\]'"):
        field_at(site("48.1,11.6"), "2026-11-28")


def test_a_place_stands_for_latitude_and_height(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    expected = normal_gravity(math.radians(48.1), 520.0)
    tumble = il.simulate_tumble(attitudes=14, order=1, gravity=expected, hold="3 s", seed=2)
    il.write_csv(tumble, "t.csv")
    assert main(["tumble", "fit", "t.csv", "--order", "1", "--place", "48.1,11.6,520", "-o", "r.json"]) == 0
    record = il.load("r.json")
    assert record.model["gravity"]["value"] == pytest.approx(expected, rel=1e-12)
    assert record.model["gravity"]["standard_uncertainty"] == pytest.approx(ANOMALY)
    same = il.fit_tumble(tumble, order=1, place="48.1,11.6,520").calibration
    assert same.model["gravity"]["value"] == record.model["gravity"]["value"]
    assert main(["tumble", "check", "r.json", "t.csv", "--place", "48.1,11.6,520"]) == 0
    stated = il.fit_tumble(tumble, order=1, place="48.1,11.6,520", gravity=9.81, with_="gyro").calibration
    assert stated.model["gravity"]["value"] == 9.81
    assert stated.fit["gyro"]["latitude"] == pytest.approx(math.radians(48.1))
    warm = il.simulate_thermal([0, 30], attitudes=14, ramps=0, seed=1)
    thermal = il.fit_thermal(warm, degrees="1,0,0", place="48.1,11.6,520").calibration
    assert thermal.model["gravity"]["value"] == pytest.approx(expected, rel=1e-12)
    assert il.check_thermal(thermal, warm[0], place="48.1,11.6,520").gravity.value == pytest.approx(expected)
    capsys.readouterr()
    for command in (["tumble", "fit", "t.csv"], ["tumble", "check", "r.json", "t.csv"], ["thermal", "fit", "t.csv"]):
        assert main([*command, "--place", "48.1,11.6", "--latitude", "48.1"]) == 2
        assert "--place together with --latitude or --height" in capsys.readouterr().err


def test_a_place_that_is_typed_wins_over_the_gravity_of_the_project_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "imulab.toml").write_text('gravity = "9.7"\n')
    il.write_csv(il.simulate_tumble(attitudes=14, order=1, gravity=9.80739, hold="3 s", seed=2), "t.csv")
    assert main(["tumble", "fit", "t.csv", "--order", "1", "--place", "48.1,11.6", "-o", "r.json"]) == 0
    assert il.load("r.json").model["gravity"]["value"] == pytest.approx(normal_gravity(math.radians(48.1)))

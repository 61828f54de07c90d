"""Nine axes in the files of other programs, read back by those programs' own formulas."""

import re
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.errors import OptionError
from imulab.records.calibration import Calibration, Covariance, Parameter
from reference import programs

G = 9.80665


AXES = "xyz"


FIELD = 48e-6


PER_TESLA = {"uT": 1e6, "nT": 1e9, "mT": 1e3, "gauss": 1e4, "mgauss": 1e7}


def record(
    seed=1, *, unit="uT", per_tesla=1e6, field=FIELD, axes="+x +y +z", turned=0.1, quadratic=0.0, gyro="deg/s", order=1
):
    """A record of nine axes, with magnetometers that are turned by some `turned` rad."""
    rng = np.random.default_rng(seed)
    p = {}

    def put(name, value, its):
        p[name] = Parameter(float(value), 1e-4, its)

    size = 1.0 if field is None else field  # of the field, in its unit
    its = "1" if field is None else "T"
    turn = rng.normal(size=3) * turned
    cross = np.array([[0, -turn[2], turn[1]], [turn[2], 0, -turn[0]], [-turn[1], turn[0], 0]])
    for i, a in enumerate(AXES):
        put(f"bias_{a}", rng.normal() * 0.2, "m/s^2")
        put(f"scale_factor_{a}", 1 + 0.02 * rng.uniform(-1, 1), "m/s^2/(m/s^2)")
        if order == 2:
            put(f"k2_{a}", 1e-3 * rng.normal(), "1/(m/s^2)")
        put(f"gyro_bias_{a}", 0.01 * rng.normal(), "rad/s")
        put(f"gyro_scale_factor_{a}", 180 / np.pi * (1 + 0.02 * rng.normal()), f"{gyro}/(rad/s)")
        put(f"mag_bias_{a}", 0.3 * size * rng.normal(), its)
        put(f"mag_scale_factor_{a}", per_tesla * FIELD / size * (1 + 0.1 * rng.uniform(-1, 1)), f"{unit}/{its}")
        if quadratic:
            put(f"mag_k2_{a}", quadratic / size, f"1/{its}")
        for j, b in enumerate(AXES):
            if i != j:
                put(f"gyro_misalignment_{a}{b}", 0.02 * rng.normal(), "rad")
                put(f"mag_misalignment_{a}{b}", cross[i, j] + 0.05 * rng.normal(), "rad")
    for pair in ("yx", "zx", "zy"):
        put(f"misalignment_{pair}", 0.01 * rng.normal(), "rad")
    put("dip", 1.1, "rad")
    model = {
        "order": order,
        "gravity": {"value": G, "unit": "m/s^2", "from": "argument"},
        "output_unit": "m/s^2",
        "gyro_output_unit": gyro,
        "mag_output_unit": unit,
        "mag_order": 2 if quadratic else 1,
        "mag_axes": axes,
        "field": {"value": size, "unit": its},
    }
    return Calibration(
        procedure="tumble", parameters=p, covariance=Covariance((), ()), model=model, fit={}, sensor={"serial": "SN9"}
    )


def recording(unit="uT", per_tesla=1e6, seed=2):
    rng = np.random.default_rng(seed)
    return il.Recording.from_arrays(
        accel=rng.uniform(-20, 20, (200, 3)),
        gyro=rng.uniform(-200, 200, (200, 3)),
        mag=rng.normal(size=(200, 3)) * FIELD * per_tesla,
        units={"accel": "m/s^2", "gyro": "deg/s", "mag": unit},
    )


def one(target, rec, folder, **options):
    (file,) = il.export(target, rec, folder, **options)
    return file


def microtesla(of):
    """A recording's magnetometers in uT, or as they are."""
    factor = {unit: 1e6 / size for unit, size in PER_TESLA.items()}
    return of.triad("mag") * factor.get(of.units["mag_x"], 1.0)


# --- Fusion -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "per_tesla", "field", "axes"),
    [
        ("uT", 1e6, FIELD, "+x +y +z"),
        ("gauss", 1e4, FIELD, "+y -x +z"),
        ("count", 2e7, FIELD, "+x -z +y"),
        ("count", 2e7, None, "+x +y +z"),
    ],
)
def test_fusion_corrects_nine_axes_as_apply_does(tmp_path, unit, per_tesla, field, axes):
    rec, raw = record(unit=unit, per_tesla=per_tesla, field=field, axes=axes), recording(unit, per_tesla)
    file = one("fusion", rec, tmp_path)
    accel, gyro, mag = programs.fusion(file, raw.triad("accel") / G, raw.triad("gyro"), microtesla(raw))
    expected = il.apply(rec, raw)
    np.testing.assert_allclose(accel, expected.triad("accel") / G, atol=3e-6)
    np.testing.assert_allclose(gyro, expected.triad("gyro"), atol=1e-4)
    truth = microtesla(expected)
    np.testing.assert_allclose(mag, truth, atol=3e-6 * np.abs(truth).max())
    text = file.read_text()
    assert "softIronMatrix (raw - hardIronOffset)" in text
    assert "lossy" not in text
    assert f"raw in {'count' if unit == 'count' else 'uT'}, calibrated in" in text


def test_the_hard_iron_for_fusion_before_1_2_is_that_of_its_formula(tmp_path):
    """softIronMatrix raw - hardIronOffset."""
    rec, raw = record(), recording()
    text = one("fusion", rec, tmp_path).read_text()
    old = text.rpartition("hardIronOffset = {")[2].partition("}")[0]
    offset = np.array([float(word.rstrip("f")) for word in old.split(", ")])
    soft = text.partition("softIronMatrix = {{{")[2].partition("}}}")[0].replace("}", "").replace("{", "")
    matrix = np.array([float(word.rstrip("f")) for word in soft.split(", ")]).reshape(3, 3)
    expected = il.apply(rec, raw).triad("mag")
    np.testing.assert_allclose(raw.triad("mag") @ matrix.T - offset, expected, atol=3e-6 * np.abs(expected).max())


def test_fusion_is_told_what_it_loses(tmp_path):
    with pytest.raises(OptionError, match=r"fusion cannot hold mag_k2, 2 % of the field; add --lossy"):
        il.export("fusion", record(quadratic=0.02), tmp_path)
    with pytest.raises(OptionError, match=r"fusion cannot hold k2_x k2_y k2_z, which changes outputs by up to .* mg"):
        il.export("fusion", record(order=2), tmp_path)
    assert not list(tmp_path.iterdir())
    told = []
    file = one("fusion", record(quadratic=0.02, order=2), tmp_path, lossy=True, tell=told.append)
    assert "left out (lossy): mag_k2, 2 % of the field" in file.read_text()
    assert len(told) >= 2


# --- MotionCal and Adafruit -------------------------------------------------------------------------------------------


def straight(rec):
    """The record with a symmetric correction, which is what MotionCal holds."""
    p = dict(rec.parameters)
    for a in AXES:
        p[f"mag_scale_factor_{a}"] = replace(p[f"mag_scale_factor_{a}"], value=p["mag_scale_factor_x"].value)
        for b in AXES:
            if a < b:
                p[f"mag_misalignment_{b}{a}"] = p[f"mag_misalignment_{a}{b}"]
    return replace(rec, parameters=p)


@pytest.mark.parametrize("unit", PER_TESLA)
def test_motioncal_corrects_a_symmetric_soft_iron_as_apply_does(tmp_path, unit):
    rec, raw = straight(record(unit=unit, per_tesla=PER_TESLA[unit])), recording(unit, PER_TESLA[unit])
    file = one("motioncal", rec, tmp_path)
    corrected, field = programs.adafruit(file)
    assert field == np.float32(48.0)
    truth = il.apply(rec, raw).triad("mag")
    np.testing.assert_allclose(corrected(microtesla(raw)), truth, atol=3e-6 * np.abs(truth).max())
    text = file.read_text()
    assert "corrected = invW (raw - V), uT" in text
    assert "lossy" not in text


def test_motioncal_keeps_magnitudes_where_the_triads_are_turned_and_says_by_how_much(tmp_path):
    rec, raw = record(turned=0.3), recording()
    with pytest.raises(
        OptionError, match=r"motioncal cannot hold how the magnetometers are turned .* deg; add --lossy"
    ):
        il.export("motioncal", rec, tmp_path)
    told = []
    corrected, _ = programs.adafruit(one("motioncal", rec, tmp_path, lossy=True, tell=told.append))
    truth = il.apply(rec, raw).triad("mag")
    found = corrected(raw.triad("mag"))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), np.linalg.norm(truth, axis=1), rtol=1e-5)
    # The angle that is said is that of the best rotation between the two (Kabsch).
    u, _, v = np.linalg.svd(found.T @ truth)
    angle = np.degrees(np.arccos((np.trace(u @ v) - 1) / 2))
    assert f"{angle:.3g} deg" in told[0]


def test_the_field_of_motioncal_is_that_of_the_outputs_where_none_was_stated(tmp_path):
    rec = straight(record(field=None))
    corrected, field = programs.adafruit(one("motioncal", rec, tmp_path))
    raw = recording()
    truth = il.apply(rec, raw).triad("mag")  # in units of the local field
    np.testing.assert_allclose(corrected(raw.triad("mag")) / field, truth, atol=1e-5)


@pytest.mark.parametrize(
    ("rec", "message"),
    [
        (
            record(unit="count", per_tesla=1e7),
            "corrects magnetometers in units of field, but the record has outputs in",
        ),
        (record(axes="-x +y +z"), "the magnetometers' axes are left-handed"),
    ],
)
def test_what_motioncal_cannot_hold_is_refused(tmp_path, rec, message):
    with pytest.raises(OptionError, match=message):
        il.export("motioncal", rec, tmp_path, lossy=True)
    assert not list(tmp_path.iterdir())


def test_a_record_without_magnetometers_is_refused_with_what_makes_one(tmp_path):
    six = il.fit_tumble(il.simulate_tumble(gravity=G), order=1, gravity=G)
    with pytest.raises(OptionError, match=r"motioncal: holds magnetometers only, and the record has none \(imulab tum"):
        il.export("motioncal", six, tmp_path)
    assert "softIron" not in one("fusion", six, tmp_path).read_text()
    assert "initial_mag" not in one("ros", six, tmp_path).read_text()


# --- ROS --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("unit", "axes"), [("uT", "+x +y +z"), ("mgauss", "+y -x +z"), ("nT", "-x +y +z")])
def test_magnetometer_pipeline_corrects_as_apply_does(tmp_path, unit, axes):
    rec, raw = record(unit=unit, per_tesla=PER_TESLA[unit], axes=axes), recording(unit, PER_TESLA[unit])
    file = one("ros", rec, tmp_path, lossy=True)  # imu_calib holds no gyroscopes
    found = programs.magnetometer_pipeline(file)(microtesla(raw) / 1e6) * 1e6
    truth = il.apply(rec, raw).triad("mag")
    np.testing.assert_allclose(found, truth, atol=1e-12 * np.abs(truth).max())
    programs.imu_calib(file)
    assert "field = initial_mag_scaling_matrix (raw - initial_mag_bias), T" in file.read_text()


@pytest.mark.parametrize(("target", "reason"), [("ros", "with outputs in count"), ("kalibr", ""), ("openvins", "")])
def test_magnetometers_that_have_no_place_are_left_out_and_it_is_said(tmp_path, target, reason):
    told = []
    rec = record(unit="count", per_tesla=1e7)
    file = one(target, rec, tmp_path, lossy=True, tell=told.append)
    said = f"its file has no place for magnetometers{' ' if reason else ''}{reason}: theirs are left out"
    assert f"{target}: {said}" in told
    assert f"# {said}" in file.read_text()
    assert "initial_mag" not in file.read_text()


def test_the_command_names_the_new_targets(imulab, tmp_path):
    record().save(tmp_path / "r.json")
    done = imulab("export", "r.json", "--to", "fusion", "-o", "out")
    assert (done.returncode, done.stdout) == (0, "fusion: out/imulab_fusion.h\n")
    done = imulab("export", "r.json", "--to", "motioncal", "-o", "out2")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out2").exists()


TARGETS = ("px4", "ardupilot")


@pytest.fixture(scope="module")
def chamber():
    """A record of tumbles at five temperatures."""
    return il.fit_thermal(il.simulate_thermal(seed=3, turn_on=0.0)).calibration


def unit_of(record):
    """The record's laws in the reference's own form: powers of T less 20 degC there, of T less T0 here."""
    zero = record.model["reference_temperature"]["value"]
    degrees = record.model["degrees"]

    def law(kind, axis, temperature):
        name = f"{kind}_{axis}"
        value = record.parameters[name].value
        for power in range(1, degrees[kind] + 1):
            value += record.parameters[f"{name}_t{power}"].value * (temperature - zero) ** power
        return value

    def output(force, temperature):
        low, high = record.model["range"]
        t = min(max(temperature, low), high)
        x, y, z = force
        yx, zx, zy = (law("misalignment", pair, t) for pair in ("yx", "zx", "zy"))
        sensed = (x, yx * x + y, zx * x + zy * y + z)
        return np.array([law("scale_factor", a, t) * (sensed[i] + law("bias", a, t)) for i, a in enumerate("xyz")])

    return output


def corrected_by(target, file):
    if target == "px4":
        _, accel, _ = programs.px4(file)
        return accel
    values, _, _ = programs.ardupilot(file)
    return programs.ardupilot_thermal(values)[0]


def rates_by(target, file):
    if target == "px4":
        return programs.px4(file)[2]
    return programs.ardupilot_thermal(programs.ardupilot(file)[0])[1]


def in_mg(text):
    value, unit = re.fullmatch(r"([\d.]+) (mg|ug)", text).groups()
    return float(value) * (1.0 if unit == "mg" else 1e-3)


@pytest.mark.parametrize("target", TARGETS)
def test_what_is_lost_is_what_the_programs_formula_leaves(target, chamber, tmp_path):
    told = []
    file = il.export(target, chamber, tmp_path, lossy=True, device_id=77, tell=told.append)[0]
    rms, worst, low, high = re.search(
        r"at 1 g by (\S+ \S+) rms, up to (\S+ \S+), from (\S+) to (\S+) degC", told[0]
    ).groups()
    low, high = float(low), float(high)
    correct, output = corrected_by(target, file), unit_of(chamber)
    rng = np.random.default_rng(5)
    errors = []
    for temperature in 0.5 * (low + high) + 0.5 * (high - low) * np.cos(np.pi * (np.arange(64) + 0.5) / 64):
        direction = rng.normal(size=(40, 3))
        forces = G * direction / np.linalg.norm(direction, axis=1)[:, None]
        errors += [correct(output(force, temperature), temperature) - force for force in forces]
    errors = 1e3 * np.array(errors) / G
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(in_mg(rms), rel=0.15)
    assert 0.8 * in_mg(worst) < np.abs(errors).max() < 1.15 * in_mg(worst)


@pytest.mark.parametrize("target", TARGETS)
def test_biases_are_held_to_single_precision(target, tmp_path):
    """With scale factors that do not follow the temperature, and no misalignment, nothing is lost over temperature."""
    recordings = il.simulate_thermal(seed=4, turn_on=0.0)
    record = il.fit_thermal(recordings, degrees="3,0,0").calibration
    file = il.export(target, record, tmp_path, lossy=True)[0]
    correct, output = corrected_by(target, file), unit_of(record)
    low, high = record.model["range"]
    places = np.linspace(low - 10, high + 10, 41)
    still = np.array([correct(output(np.zeros(3), t), t) for t in places])
    # At no specific force, misalignment does nothing: what is left is the rounding of the parameters.
    assert np.abs(still).max() < 3e-6 * G


def test_px4_needs_all_of_a_sensor_and_says_how_it_reads_temperature(chamber, tmp_path):
    file = il.export("px4", chamber, tmp_path, lossy=True, device_id=77)[0]
    values, _, _ = programs.px4(file)
    assert values["TC_A0_ID"] == values["CAL_ACC0_ID"] == 77
    assert [values[f"TC_A0_X0_{axis}"] for axis in range(3)] == [0, 0, 0]
    assert "more than 1 K" in file.read_text()
    assert re.search(r"changes by up to \S+ [mµ]g per K", file.read_text(encoding="utf-8"))


@pytest.mark.parametrize("target", TARGETS)
def test_what_is_lost_is_refused_unless_asked_for(target, chamber, tmp_path):
    with pytest.raises(OptionError, match=r"scale factor over temperature and misalignment.*mg.*add --lossy"):
        il.export(target, chamber, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("target", TARGETS)
def test_a_thermal_record_goes_alone(target, chamber, tmp_path):
    tumble = il.fit_tumble(il.simulate_tumble(gravity=G), order=1, gravity=G).calibration
    with pytest.raises(OptionError, match="a thermal record goes alone, found 2 records"):
        il.export(target, [tumble, chamber], tmp_path, lossy=True)


def test_other_programs_take_no_laws(chamber, tmp_path):
    with pytest.raises(OptionError, match="takes no laws over temperature"):
        il.export("kalibr", chamber, tmp_path, lossy=True)


@pytest.fixture(scope="module")
def six_axes():
    """A record of both triads."""
    return il.fit_thermal(il.simulate_thermal(seed=3, turn_on=0.0, gyro=True), with_="gyro").calibration


@pytest.mark.parametrize("target", TARGETS)
def test_the_offsets_of_gyroscopes_follow_the_temperature_in_the_programs_formula(target, six_axes, tmp_path):
    told = []
    file = il.export(target, six_axes, tmp_path, lossy=True, device_id=77, tell=told.append)[0]
    correct = rates_by(target, file)

    def value(name, power):
        return six_axes.value(name + (f"_t{power}" if power else ""))

    zero, (low, high) = six_axes.model["reference_temperature"]["value"], six_axes.model["range"]
    for temperature in np.linspace(low - 10, high + 10, 41):
        t = min(max(temperature, low), high) - zero
        bias, scale = (
            np.array([sum(value(f"gyro_{kind}_{a}", k) * t**k for k in range(degree + 1)) for a in "xyz"])
            for kind, degree in (("bias", 3), ("scale_factor", 1))
        )
        # The fourth power of the product, some 1e-4/K times 2e-6 deg/s/K^3, is what a cubic leaves: 40^4 / 8 of it.
        assert np.abs(correct(np.radians(scale) * bias, temperature)).max() < np.radians(1e-4 * 2e-6 * 40**4 * 3 / 8)
    felt = [sum(abs(six_axes.value(f"gyro_g_sensitivity_{a}{b}")) for b in "xyz") for a in "xyz"]
    said = r"gyro_g_sensitivity, which changes outputs by up to (\S+) % of the rate, up to (\S+) deg/s within"
    ((share, drift),) = re.findall(said, told[0])
    matrix = np.eye(3)
    for i, a in enumerate("xyz"):
        for j, b in enumerate("xyz"):
            if i != j:
                matrix[i, j] = six_axes.value(f"gyro_misalignment_{a}{b}")
    ends = [
        np.radians(
            [value(f"gyro_scale_factor_{a}", 0) + value(f"gyro_scale_factor_{a}", 1) * (t - zero) for a in "xyz"]
        )
        for t in (low, high)
    ]
    worst = max(np.abs(end[:, None] * matrix - np.eye(3)).sum(axis=1).max() for end in ends)
    assert float(share) == pytest.approx(100 * worst, rel=0.01)
    assert float(drift) == pytest.approx(np.degrees(max(felt)) * G, rel=0.01)
    assert re.search(r"the offset of the gyroscopes changes by up to \S+ deg/h per K", file.read_text())


def test_px4_needs_all_of_the_gyroscopes_too(six_axes, tmp_path):
    values, _, _ = programs.px4(il.export("px4", six_axes, tmp_path, lossy=True, device_id=77)[0])
    assert values["TC_G0_ID"] == values["CAL_GYRO0_ID"] == 77
    assert values["TC_G_ENABLE"] == 1
    assert [values[f"TC_G0_X0_{axis}"] for axis in range(3)] == [0, 0, 0]


def test_every_number_that_px4_lacks_is_said_in_one_line(six_axes, tmp_path):
    told = []
    file = il.export("px4", six_axes, tmp_path, lossy=True, tell=told.append)[0]
    names = "TC_A0_ID CAL_ACC0_ID TC_G0_ID CAL_GYRO0_ID"
    line = f"px4: {names} = 0: PX4 ignores this calibration until it is the sensor's number (--device-id)"
    assert [message for message in told if "_ID" in message] == [line]
    comments = [comment for comment in file.read_text(encoding="utf-8").splitlines() if "device id 0" in comment]
    assert [names in comment for comment in comments] == [True]


@pytest.mark.parametrize("target", TARGETS)
def test_accelerometers_alone_leave_the_programs_gyroscopes_as_they_are(target, chamber, tmp_path):
    text = il.export(target, chamber, tmp_path, lossy=True)[0].read_text()
    assert not re.search("TC_G|GYR", text)

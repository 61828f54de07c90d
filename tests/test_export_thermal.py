"""Laws over temperature in the autopilots' files, read back by the programs' own formulas."""

import re

import numpy as np
import pytest

import imulab as il
from imulab.errors import OptionError
from reference import programs

G = 9.80665
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
    assert re.search(r"changes by up to \S+ [mu]g per K", file.read_text())


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


@pytest.mark.parametrize("target", TARGETS)
def test_accelerometers_alone_leave_the_programs_gyroscopes_as_they_are(target, chamber, tmp_path):
    text = il.export(target, chamber, tmp_path, lossy=True)[0].read_text()
    assert not re.search("TC_G|GYR", text)

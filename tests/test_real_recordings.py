"""Real recordings against the figures in their README (independent fits of the same data)."""

import numpy as np
import pytest

import imulab as il
from conftest import sap5_table, table
from reference import tumble as reference

XSENS_LAYOUT = """
delimiter = "whitespace"
[columns]
time = { from = 0, unit = "s" }
accel_x = { from = 1, unit = "count" }
accel_y = { from = 2, unit = "count" }
accel_z = { from = 3, unit = "count" }
"""

MPU_LAYOUT = """
delimiter = "whitespace"
sample_rate = { value = 100, unit = "Hz" }
[columns]
accel_x = { from = 0, unit = "m/s^2" }
accel_y = { from = 1, unit = "m/s^2" }
accel_z = { from = 2, unit = "m/s^2" }
gyro_x = { from = 3, unit = "rad/s" }
gyro_y = { from = 4, unit = "rad/s" }
gyro_z = { from = 5, unit = "rad/s" }
"""
MICRO_G = 9.80665e-6


@pytest.fixture(scope="module")
def xsens(real_data, tmp_path_factory):
    layout = tmp_path_factory.mktemp("layout") / "xsens.toml"
    layout.write_text(XSENS_LAYOUT)
    return il.find_attitudes(il.read(real_data / "xsens_mti" / "xsens_acc.mat", layout))


def test_xsens_attitudes_are_found(xsens):
    assert len(xsens) == 38
    assert 45 < xsens.stop[0] - xsens.start[0] < 53  # the first about 50 s are static


def test_xsens_reaches_the_reference_figures(xsens):
    fit = il.fit_tumble(xsens, order="auto", gravity=9.81744)
    record = fit.calibration
    assert record.model["order"] == 1
    assert record.fit["rms"]["value"] <= 105 * MICRO_G
    assert record.fit["leave_one_out"]["value"] <= 150 * MICRO_G
    # scipy reference in our gauge, and one standard uncertainty of it
    for axis, scale, zero, ppm, bias in (
        ("x", 414.4422, 33123.831, 65, 60),
        ("y", 412.1227, 33275.155, 34, 34),
        ("z", 414.5079, 32364.494, 39, 37),
    ):
        found = record.value(f"scale_factor_{axis}")
        assert found == pytest.approx(scale, rel=ppm * 1e-6)
        assert found * record.value(f"bias_{axis}") == pytest.approx(zero, abs=bias * MICRO_G * scale)
    for pair, value, sigma in (("yx", 3.584e-3, 134e-6), ("zx", 9.251e-3, 476e-6), ("zy", 21.331e-3, 120e-6)):
        assert record.value(f"misalignment_{pair}") == pytest.approx(value, abs=sigma)
    for axis, ppm in (("x", 65), ("y", 34), ("z", 39)):
        p = record.parameters[f"scale_factor_{axis}"]
        assert p.standard_uncertainty_given_order / p.value == pytest.approx(ppm * 1e-6, rel=0.15)
        assert p.standard_uncertainty_given_order < p.standard_uncertainty < 3 * p.standard_uncertainty_given_order


def test_xsens_table_of_orders_tells_why(xsens):
    rows = il.fit_tumble(xsens, order="auto", gravity=9.81744).orders
    assert rows[0].condition_number == pytest.approx(3.6, abs=0.2)
    assert rows[3].rms == pytest.approx(0.092e-3 * 9.80665, rel=0.03)
    assert rows[3].condition_number == pytest.approx(1600, rel=0.1)
    assert rows[3].leave_one_out > 3e-3 * 9.80665
    assert not rows[3].observable


def test_xsens_agrees_with_the_upper_triangular_model_after_the_change_of_gauge(xsens):
    converted = reference.to_lower_gauge(reference.upper_triangular_fit(xsens.mean, 9.81744))
    record = il.fit_tumble(_table(xsens), order=1, gravity=9.81744).calibration
    for name, value in converted.items():
        assert record.value(name) == pytest.approx(value, abs=2e-2 * record.parameters[name].standard_uncertainty), name


def _table(attitudes):
    return il.find_attitudes(table(attitudes.mean, attitudes.unit))


@pytest.mark.parametrize("name", ["ab", "ai", "bh", "fb", "hj", "hj2"])
def test_sap5_order_two_is_chosen(real_data, name):
    fit = il.fit_tumble(
        il.find_attitudes(table(sap5_table(real_data / "sap5" / f"{name}.json"), "g")), order="auto", gravity=9.80665
    )
    assert fit.calibration.model["order"] == 2
    rows = fit.orders
    assert rows[1].leave_one_out < rows[0].leave_one_out
    assert rows[1].leave_one_out < min(row.leave_one_out for row in rows[2:])


def test_sap5_nonlinearity_of_the_same_instrument_twice(real_data):
    for name, expected in (("hj", [0.2, 6.1, 0.7]), ("hj2", [-1.9, 4.9, -0.8])):
        data = table(sap5_table(real_data / "sap5" / f"{name}.json"), "g")
        record = il.fit_tumble(il.find_attitudes(data), order=2, gravity=9.80665).calibration
        k2 = np.array([record.value(f"k2_{a}") for a in "xyz"]) * 9.80665 * 1e3
        sigma = np.array([record.parameters[f"k2_{a}"].standard_uncertainty for a in "xyz"]) * 9.80665 * 1e3
        np.testing.assert_allclose(k2, expected, atol=0.06)  # the README gives one decimal
        np.testing.assert_allclose(sigma, [0.6, 1.7, 0.7], rtol=0.35)


@pytest.mark.parametrize("name", ["imu0.log", "imu1.log"])
def test_mpu9150_reaches_the_reference_figures(real_data, tmp_path, name):
    (tmp_path / "mpu.toml").write_text(MPU_LAYOUT)
    attitudes = il.find_attitudes(il.read(real_data / "mpu9150" / name, tmp_path / "mpu.toml"))
    record = il.fit_tumble(attitudes, order="auto", gravity=9.80665).calibration
    assert 20 <= len(attitudes) <= 24
    assert record.model["order"] == 1
    assert record.fit["rms"]["value"] <= 260 * MICRO_G
    assert record.fit["leave_one_out"]["value"] <= 430 * MICRO_G


def test_the_gyroscope_file_of_the_same_unit_is_refused(real_data, tmp_path):
    (tmp_path / "xsens.toml").write_text(XSENS_LAYOUT)
    attitudes = il.find_attitudes(il.read(real_data / "xsens_mti" / "xsens_gyro.mat", tmp_path / "xsens.toml"))
    with pytest.raises(il.ImulabError, match="is this a gyroscope's recording"):
        il.fit_tumble(attitudes, order=1, gravity=9.81744)


def test_xsens_by_the_command_line(real_data, imulab, tmp_path):
    (tmp_path / "xsens.toml").write_text(XSENS_LAYOUT)
    file = real_data / "xsens_mti" / "xsens_acc.mat"
    done = imulab("tumble", "fit", file, "--layout", "xsens.toml", "--gravity", "9.81744", "--order", "auto",
                  "-o", "xsens.json", "--report", "xsens.html")  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Choice of the order" in done.stdout
    record = il.load(tmp_path / "xsens.json")
    assert record.model["order"] == 1
    assert record.parameters["scale_factor_x"].unit == "count/(m/s^2)"
    assert (tmp_path / "xsens.html").stat().st_size > 1e6

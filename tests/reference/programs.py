"""The correction formulas of other programs, read from their files; nothing of imulab.

PX4: sensor_calibration. ArduPilot: AP_InertialSensor_Backend. Kalibr: IccScaledMisalignedImu. OpenVINS: propagation
derivations. imu_calib: accel_calib.cpp. magnetometer_pipeline: bias_remover.cpp. Fusion: FusionCalibration.h. Adafruit
and MotionCal: Adafruit_Sensor_Calibration and its EEPROM.
"""

import re
import struct
import subprocess
from pathlib import Path

import numpy as np
import yaml


def px4(path: Path):
    """Parameters, and functions raw -> corrected for accelerometer and gyroscope, in single precision."""
    values, kinds = {}, {}
    for line in path.read_text().splitlines():
        if line.startswith("#") or not line:
            continue
        vehicle, component, name, value, kind = line.split("\t")
        assert (vehicle, component) == ("1", "1")
        kinds[name] = kind
        values[name] = int(value) if kind == "6" else np.float32(value)
    assert set(kinds.values()) <= {"6", "9"}

    def accel(raw, temperature=None):
        off = np.array([values[f"CAL_ACC0_{a}OFF"] for a in "XYZ"], dtype=np.float64)
        scale = np.array([values[f"CAL_ACC0_{a}SCALE"] for a in "XYZ"], dtype=np.float64)
        thermal = 0.0 if temperature is None else px4_thermal_offset(values, temperature)
        return (raw - thermal - off) * scale

    def gyro(raw, temperature=None):
        thermal = 0.0 if temperature is None else px4_thermal_offset(values, temperature, "G")
        return raw - thermal - np.array([values[f"CAL_GYRO0_{a}OFF"] for a in "XYZ"], dtype=np.float64)

    return values, accel, gyro


def px4_thermal_offset(values, temperature, sensor="A"):
    """TemperatureCompensation::calc_thermal_offsets_3D, with the parameters of sensor 0: A, or G for gyroscopes."""
    assert values[f"TC_{sensor}_ENABLE"] == 1
    temperature = min(max(temperature, values[f"TC_{sensor}0_TMIN"]), values[f"TC_{sensor}0_TMAX"])
    delta = float(temperature) - float(values[f"TC_{sensor}0_TREF"])
    offset = []
    for axis in range(3):
        temp_var = delta
        total = float(values[f"TC_{sensor}0_X0_{axis}"]) + float(values[f"TC_{sensor}0_X1_{axis}"]) * temp_var
        temp_var *= delta
        total += float(values[f"TC_{sensor}0_X2_{axis}"]) * temp_var
        temp_var *= delta
        offset.append(total + float(values[f"TC_{sensor}0_X3_{axis}"]) * temp_var)
    return np.array(offset)


def ardupilot_thermal(values):
    """AP_InertialSensor_TCal::correct_accel and correct_gyro of the first sensor: (raw, temperature) -> corrected."""
    assert values["INS_TCAL1_ENABLE"] == 1

    def polynomial(temperature, sensor="ACC"):
        low, high = float(values["INS_TCAL1_TMIN"]), float(values["INS_TCAL1_TMAX"])
        t = min(max(temperature, low), high) - 35.0
        c = [np.array([float(values[f"INS_TCAL1_{sensor}{k}_{a}"]) for a in "XYZ"]) for k in (1, 2, 3)]
        return (c[0] + (c[1] + c[2] * t) * t) * t * 1.0e-6

    def corrected(raw, temperature):
        accel = raw - polynomial(temperature) + polynomial(float(values["INS_ACC1_CALTEMP"]))
        offset, scale = (np.array([float(values[f"INS_{what}_{a}"]) for a in "XYZ"]) for what in ("ACCOFFS", "ACCSCAL"))
        return (accel - offset) * scale

    def rate(raw, temperature):
        moved = raw - polynomial(temperature, "GYR") + polynomial(float(values["INS_GYR1_CALTEMP"]), "GYR")
        return moved - np.array([float(values[f"INS_GYROFFS_{a}"]) for a in "XYZ"])

    return corrected, rate


def ardupilot(path: Path):
    values = {}
    for line in path.read_text().splitlines():
        if not line.startswith("#"):
            name, value = line.split(",")
            values[name] = np.float32(value)

    def triple(stem):
        return np.array([values[f"{stem}_{a}"] for a in "XYZ"], dtype=np.float64)

    return (
        values,
        lambda raw: (raw - triple("INS_ACCOFFS")) * triple("INS_ACCSCAL"),
        lambda raw: raw - triple("INS_GYROFFS"),
    )


def _numbers(value):
    array = np.array(value)
    assert array.dtype == np.float64, "YAML read a number as text"
    return array


def kalibr(path: Path):
    """Forward model inverted: (a_meas, w_meas, biases) -> a, w."""
    imu = yaml.safe_load(path.read_text())["imu0"]
    m_a = _numbers(imu["accelerometers"]["M"])
    m_w, c, a_matrix = (_numbers(imu["gyroscopes"][key]) for key in ("M", "C_gyro_i", "A"))
    assert imu["model"] == "scale-misalignment"
    assert np.array_equal(m_a, np.tril(m_a))
    assert np.array_equal(m_w, np.tril(m_w))
    np.testing.assert_allclose(c @ c.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(c) > 0

    def corrected(a_meas, w_meas, b_a, b_w):
        a = np.linalg.solve(m_a, (a_meas - b_a).T)
        w = np.linalg.solve(m_w @ c, (w_meas - b_w).T - a_matrix @ (c @ a))
        return a.T, w.T

    return imu, corrected


def openvins(path: Path):
    first, _, rest = path.read_text().partition("\n")
    assert first == "%YAML:1.0"
    lines = rest.splitlines()
    for i, line in enumerate(lines):  # OpenCV's parser: rows deeper than the key
        if line.strip().startswith("- ["):
            above = next(k for k in reversed(lines[:i]) if k.rstrip().endswith(":"))
            assert len(line) - len(line.lstrip()) > len(above) - len(above.lstrip())
    imu = yaml.safe_load(rest)["imu0"]
    tw, r_gyro, ta, r_acc, tg = (_numbers(imu[key]) for key in ("Tw", "R_IMUtoGYRO", "Ta", "R_IMUtoACC", "Tg"))
    dw, da = np.linalg.inv(tw), np.linalg.inv(ta)
    assert np.allclose(dw, np.tril(dw), atol=1e-15)
    assert np.allclose(da, np.tril(da), atol=1e-15)
    for r in (r_gyro, r_acc):
        np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(r) > 0

    def corrected(a_meas, w_meas, b_a, b_w):
        a = r_acc.T @ da @ (a_meas - b_a).T
        w = r_gyro.T @ dw @ ((w_meas - b_w).T - tg @ a)
        return a.T, w.T

    return imu, corrected


def imu_calib(path: Path):
    content = yaml.safe_load(path.read_text())
    sm, bias = _numbers(content["SM"]), _numbers(content["bias"])
    assert sm.shape == (9,)
    assert bias.shape == (3,)
    return lambda raw: raw @ sm.reshape(3, 3).T - bias


def magnetometer_pipeline(path: Path):
    """lastScale * (field - lastBias), tesla."""
    content = yaml.safe_load(path.read_text())
    bias = np.array([content[f"initial_mag_bias_{a}"] for a in "xyz"])
    scale = _numbers(content["initial_mag_scaling_matrix"]).reshape(3, 3)
    return lambda raw: (raw - bias) @ scale.T


FUSION = r"""
#include <stdio.h>
typedef union { float array[3]; struct { float x; float y; float z; } axis; } FusionVector;
typedef union { float array[3][3]; struct { float xx, xy, xz, yx, yy, yz, zx, zy, zz; } element; } FusionMatrix;
static FusionVector multiply(const FusionMatrix m, const FusionVector v) {
    FusionVector r;
    r.axis.x = m.element.xx * v.axis.x + m.element.xy * v.axis.y + m.element.xz * v.axis.z;
    r.axis.y = m.element.yx * v.axis.x + m.element.yy * v.axis.y + m.element.yz * v.axis.z;
    r.axis.z = m.element.zx * v.axis.x + m.element.zy * v.axis.y + m.element.zz * v.axis.z;
    return r;
}
static FusionVector subtract(FusionVector a, const FusionVector b) {
    for (int i = 0; i < 3; i++) a.array[i] -= b.array[i];
    return a;
}
static FusionVector hadamard(FusionVector a, const FusionVector b) {
    for (int i = 0; i < 3; i++) a.array[i] *= b.array[i];
    return a;
}
static FusionVector FusionModelInertial(const FusionVector uncalibrated, const FusionMatrix misalignment,
                                        const FusionVector sensitivity, const FusionVector offset) {
    return multiply(misalignment, hadamard(subtract(uncalibrated, offset), sensitivity));
}
static FusionVector FusionModelMagnetic(const FusionVector uncalibrated, const FusionMatrix softIronMatrix,
                                        const FusionVector hardIronOffset) {
    return multiply(softIronMatrix, subtract(uncalibrated, hardIronOffset));
}
#include "imulab_fusion.h"
int main(void) {
    FusionVector a, w, m;
    while (scanf("%f %f %f %f %f %f %f %f %f", &a.axis.x, &a.axis.y, &a.axis.z, &w.axis.x, &w.axis.y, &w.axis.z,
                 &m.axis.x, &m.axis.y, &m.axis.z) == 9) {
        a = FusionModelInertial(a, accelerometerMisalignment, accelerometerSensitivity, accelerometerOffset);
        w = FusionModelInertial(w, gyroscopeMisalignment, gyroscopeSensitivity, gyroscopeOffset);
        m = FusionModelMagnetic(m, softIronMatrix, hardIronOffset);
        printf("%.9g %.9g %.9g %.9g %.9g %.9g %.9g %.9g %.9g\n", a.axis.x, a.axis.y, a.axis.z, w.axis.x, w.axis.y,
               w.axis.z, m.axis.x, m.axis.y, m.axis.z);
    }
    return 0;
}
"""


def fusion(path: Path, accel, gyro, mag):
    """The header compiled with Fusion's types and formulas: calibrated accelerometer, gyroscope and magnetometer."""
    source = path.parent / "main.c"
    source.write_text(FUSION)
    program = path.parent / "main"
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-Wno-missing-braces", f"-I{path.parent}"]
    subprocess.run(["cc", *strict, str(source), "-o", str(program)], check=True, timeout=60)
    rows = "\n".join(" ".join(map(repr, row)) for row in np.hstack([accel, gyro, mag]).tolist())
    done = subprocess.run([str(program)], input=rows, capture_output=True, text=True, check=True, timeout=60)
    found = np.array([line.split() for line in done.stdout.splitlines()], dtype=float)
    return found[:, :3], found[:, 3:6], found[:, 6:]


def adafruit(path: Path):
    """The bytes as Adafruit's EEPROM calibration loads them, and the lines for its sketches: raw -> corrected, uT."""
    text = path.read_text()
    data = bytes.fromhex(text.splitlines()[-1])
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ 0xA001 if crc & 1 else crc >> 1
    assert (crc, len(data), data[0], data[1]) == (0, 68, 0x75, 0x54)
    offsets = struct.unpack("<16f", data[2:66])
    assert offsets[:6] == (0.0,) * 6
    hard, field = np.array(offsets[6:9]), offsets[9]
    soft = np.array(offsets)[[10, 13, 14, 13, 11, 15, 14, 15, 12]]
    cal = {"mag_hardiron": np.zeros(3), "mag_softiron": np.zeros(9)}
    for name, index, value in re.findall(r"^cal\.(mag_\w+)\[(\d)\] = (\S+)f;$", text, re.M):
        cal[name][int(index)] = np.float32(value)
    np.testing.assert_array_equal(cal["mag_hardiron"], hard)
    np.testing.assert_array_equal(cal["mag_softiron"], soft)
    assert np.float32(re.search(r"cal\.mag_field = (\S+)f;", text)[1]) == field
    shown = {key: re.findall(rf"^{key} +(.*)$", text, re.M) for key in ("V", "B", "invW")}
    rows = {key: np.array(" ".join(lines).split(), dtype=np.float32) for key, lines in shown.items()}
    np.testing.assert_array_equal(rows["V"], hard)
    np.testing.assert_array_equal(rows["invW"], soft)
    assert rows["B"] == field
    return lambda raw: (raw - hard) @ soft.reshape(3, 3).T, field

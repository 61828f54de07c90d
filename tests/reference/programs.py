"""The correction formulas of other programs, read from their files; nothing of imulab.

PX4: sensor_calibration. ArduPilot: AP_InertialSensor_Backend. Kalibr: IccScaledMisalignedImu. OpenVINS: propagation
derivations. imu_calib: accel_calib.cpp.
"""

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

    def accel(raw):
        off = np.array([values[f"CAL_ACC0_{a}OFF"] for a in "XYZ"], dtype=np.float64)
        scale = np.array([values[f"CAL_ACC0_{a}SCALE"] for a in "XYZ"], dtype=np.float64)
        thermal = 0.0
        return (raw - thermal - off) * scale

    def gyro(raw):
        return raw - np.array([values[f"CAL_GYRO0_{a}OFF"] for a in "XYZ"], dtype=np.float64)

    return values, accel, gyro


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

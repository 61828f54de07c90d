"""Command lines for Betaflight and INAV: their formulas, transcribed apart, correct as the record does."""

import re
from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.errors import OptionError

HARD = np.array([143.0, -310.0, 57.0])
FIELD = 480.0  # counts


def turned(soft: np.ndarray, seed: int = 4, count: int = 800) -> tuple[np.ndarray, np.ndarray]:
    """Return directions, and the counts that a sensor gives of them."""
    rng = np.random.default_rng(seed)
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions, np.round(FIELD * directions @ soft.T + HARD + 2 * rng.standard_normal((count, 3)))


def fitted(outputs: np.ndarray, unit: str = "count") -> il.Calibration:
    columns = {f"mag_{a}": outputs[:, k] for k, a in enumerate("xyz")}
    columns["time"] = np.arange(len(outputs)) / 20
    units = dict.fromkeys(columns, unit) | {"time": "s"}
    return il.fit_magnetometer(il.Recording(columns, units, {"serial": "FC7"}, name="log")).calibration


def settings(file: Path) -> dict[str, list[int]]:
    lines = [line for line in file.read_text().splitlines() if not line.startswith("#")]
    assert lines[-1] == "save"
    pairs = [re.fullmatch(r"set (\w+) = (-?\d+(?:,-?\d+)*)", line) for line in lines[:-1]]
    return {pair[1]: [int(part) for part in pair[2].split(",")] for pair in pairs if pair}


def angles(found: np.ndarray, directions: np.ndarray) -> np.ndarray:
    cosine = np.sum(found * directions, axis=1) / np.linalg.norm(found, axis=1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def test_inav_corrects_offsets_and_scales_of_the_axes(tmp_path):
    directions, outputs = turned(np.diag([1.08, 0.95, 0.99]))
    (file,) = il.export("inav", fitted(outputs), tmp_path, lossy=True)
    held = settings(file)
    zero = np.array([held[f"magzero_{a}"][0] for a in "xyz"])
    gain = np.array([held[f"maggain_{a}"][0] for a in "xyz"])
    corrected = (outputs - zero) * 1024 / gain  # INAV, compass.c
    assert np.sqrt(np.mean(angles(corrected, directions) ** 2)) < 0.5  # noise of 2 counts
    np.testing.assert_allclose(np.linalg.norm(corrected, axis=1).mean(), 1024, rtol=2e-3)
    assert "of outputs logged with magzero 0" in file.read_text()


def test_betaflight_takes_the_offset_and_says_what_its_lack_of_scales_costs(tmp_path):
    directions, outputs = turned(np.diag([1.08, 0.95, 0.99]))
    record = fitted(outputs)
    with pytest.raises(OptionError, match=r"betaflight cannot hold soft iron, which turns directions by up to \d"):
        il.export("betaflight", record, tmp_path)
    assert not list(tmp_path.iterdir())
    told: list[str] = []
    (file,) = il.export("betaflight", record, tmp_path, lossy=True, tell=told.append)
    stated = float(re.search(r"up to ([\d.]+) deg", told[0])[1])
    corrected = outputs - settings(file)["mag_calibration"]  # Betaflight, compass.c
    assert stated == pytest.approx(angles((corrected - 0.0), directions).max(), abs=1.0)
    np.testing.assert_allclose(settings(file)["mag_calibration"], HARD, atol=2)


def test_nothing_is_lost_of_a_sensor_without_soft_iron(tmp_path):
    _, outputs = turned(np.eye(3), count=20000)
    told: list[str] = []
    il.export("betaflight", fitted(outputs), tmp_path, tell=told.append)
    assert told == []


def test_off_diagonal_soft_iron_is_lost_and_said(tmp_path):
    soft = np.array([[1.0, 0.04, 0.0], [0.04, 1.0, 0.0], [0.0, 0.0, 1.0]])
    with pytest.raises(OptionError, match="inav cannot hold off-diagonal soft iron, which turns directions by up to 2"):
        il.export("inav", fitted(turned(soft)[1]), tmp_path)


@pytest.mark.parametrize("target", ["betaflight", "inav"])
def test_what_they_cannot_hold_is_refused(target, tmp_path):
    _, outputs = turned(np.eye(3))
    with pytest.raises(
        OptionError, match=f"{target}: subtracts counts of the sensor, but the record has outputs in uT"
    ):
        il.export(target, fitted(outputs / 10, "uT"), tmp_path)
    with pytest.raises(OptionError, match=f"{target}: takes at most 32767 counts of hard iron"):
        il.export(target, fitted(outputs * 100 + 1e5), tmp_path, lossy=True)
    accelerometers = il.fit_tumble(il.simulate_tumble(gravity=9.81), order=1, gravity=9.81)
    with pytest.raises(OptionError, match=f"{target}: holds magnetometers only, and the record has none"):
        il.export(target, accelerometers.calibration, tmp_path)

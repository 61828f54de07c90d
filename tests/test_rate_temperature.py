"""Scale factors over the temperature, where a rate test tells them from a drift over time."""

import dataclasses

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.procedures.rate.simulate import RateRecordings


def warmed(temperatures, slope=50e-6, within=0.0):
    """Runs about z, each at a temperature, whose scale factor follows it; `within` K more over each run."""
    made = il.simulate_rate(faces="+z", cycles=len(temperatures), hold="4 s", rate="25 Hz", noise="0.005 deg/s")
    recordings = []
    for one, start in zip(made.recordings, temperatures, strict=True):
        temperature = start + within * np.linspace(0, 1, len(one))
        gyro = one.column("gyro_z") * (1 + slope * (temperature - 25.0))
        columns = {**one.columns, "gyro_z": gyro, "temperature": temperature}
        recordings.append(dataclasses.replace(one, columns=columns, units={**one.units, "temperature": "degC"}))
    return RateRecordings(made.test, tuple(recordings), {})


def test_the_slope_of_the_scale_factor_is_found(tmp_path, capsys):
    found = il.fit_rate(warmed([20, 30, 22, 28]), order=1)
    slope = found.calibration.parameters["gyro_scale_factor_slope_z"]
    assert slope.unit == "1/K"
    assert abs(slope.value - 50e-6) < 4 * slope.standard_uncertainty < 8e-6
    found.save(tmp_path / "r.json")
    assert main(["show", str(tmp_path / "r.json")], project=False) == 0
    assert "gyro_scale_factor_slope_z" in capsys.readouterr().out
    level = il.fit_rate(warmed([20, 30, 22, 28], slope=0.0), order=1).calibration
    none = level.parameters["gyro_scale_factor_slope_z"]
    assert abs(none.value) < 4 * none.standard_uncertainty


@pytest.mark.parametrize("temperatures", [[20, 22, 24, 23], [20, 25, 30, 35]])
def test_a_small_span_or_one_that_follows_time_tells_nothing(temperatures):
    found = il.fit_rate(warmed(temperatures), order=1).calibration
    assert not any("slope" in name for name in found.parameters)


def test_a_slope_is_not_joined_with_a_prior(tmp_path):
    prior = il.fit_rate(warmed([20, 30, 22, 28]), order=1)
    both = il.fit_rate(warmed([20, 30, 22, 29]), order=1, prior=prior).calibration
    assert both.parameters["gyro_scale_factor_slope_z"].value == pytest.approx(50e-6, rel=0.2)

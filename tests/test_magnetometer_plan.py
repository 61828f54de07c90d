"""What a plan of a magnetometer alone predicts is what simulated fits scatter by, and what they state."""

import json

import numpy as np
import pytest
from tests.reference.field_alone import Sensor, circle, sphere

import imulab as il
from imulab.cli import main
from imulab.errors import OptionError
from imulab.procedures.magnetometer.solve import fit_surface


@pytest.mark.parametrize("axes", [3, 2])
def test_the_prediction_is_the_bound(axes):
    turn = "wave" if axes == 3 else "level"
    plan = il.plan_magnetometer(turn=turn, readings=400, noise="0.4 uT", dip="60 deg")
    sensor = Sensor(1, axes=axes, field=48.0 if axes == 3 else 24.0)
    sensor.soft = np.eye(axes)
    directions = sphere(400, np.random.default_rng(1)) if axes == 3 else circle(401, 1)[:-1]
    bound = np.sqrt(np.diag(sensor.bound(directions, 0.4)))
    assert 1e6 * plan.chosen.hard == pytest.approx(bound[:axes].max(), rel=0.08 if axes == 3 else 1e-6)
    assert plan.chosen.soft == pytest.approx(bound[axes:].max(), rel=0.12 if axes == 3 else 1e-6)


def test_the_direction_is_known_as_well_as_predicted():
    plan = il.plan_magnetometer(readings=300, noise="0.6 uT")
    off, every = [], sphere(500, np.random.default_rng(2))
    for seed in range(60):
        rng = np.random.default_rng(seed)
        sensor = Sensor(4)
        surface = fit_surface(sensor.outputs(sphere(300, rng), 0.6, rng))
        soft = np.array(
            [[surface.theta[3 + [0, 1, 2, 1, 3, 4, 2, 4, 5][3 * i + j]] for j in range(3)] for i in range(3)]
        )
        field = np.linalg.solve(soft, (sensor.outputs(every, 0.0, rng) - surface.theta[:3]).T).T
        turn = np.linalg.svd(field.T @ every)  # the rotation, which is not told, taken off
        field = field @ (turn[0] @ turn[2])
        field /= np.linalg.norm(field, axis=1, keepdims=True)
        off.append(np.mean(np.sum((field - every) ** 2, axis=1)))
    assert np.sqrt(np.mean(off)) == pytest.approx(plan.chosen.direction, rel=0.12)


def test_as_many_readings_as_are_wanted_and_more_tilt_is_better():
    plan = il.plan_magnetometer(wanted="0.1 deg", tilt="60 deg")
    assert plan.chosen.direction <= plan.wanted
    fewer = il.plan_magnetometer(readings=plan.chosen.readings - 1, tilt="60 deg")
    assert fewer.chosen.direction > plan.wanted
    worst = [each.magnitude for each in plan.tilts]
    assert worst == sorted(worst, reverse=True)


def test_what_cannot_be_is_refused():
    with pytest.raises(OptionError, match="that takes"):
        il.plan_magnetometer(wanted="0.001 deg", tilt="5 deg")
    with pytest.raises(OptionError, match="readings 5: expected 12"):
        il.plan_magnetometer(readings=5)
    with pytest.raises(OptionError, match="expected wave or level"):
        il.plan_magnetometer(turn="roll")


def test_the_command_prints_and_writes_json(capsys):
    assert main(["magnetometer", "plan", "--turn", "level", "--readings", "16"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("16 readings evenly around, the unit level: one each 22")
    assert main(["magnetometer", "plan", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["direction"]["value"] <= content["wanted"]["value"] + 1e-12
    assert len(content["tilts"]) == 6

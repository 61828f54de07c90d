"""What a target can hold of a record is fitted anew to its attitudes where it cannot hold all."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize

import imulab as il
from conftest import table
from imulab.exporters import ExportOptions, export
from imulab.procedures.tumble.device import refit_linear as linear_record
from reference import programs
from reference import tumble as reference

G = 9.80665


def made(order=3, count=30, sigma=2e-3, misalignment=True, stated=True, seed=11):
    """Return a record of some order of a linear unit, its outputs, and the truth."""
    rng = np.random.default_rng(seed)
    truth = reference.random_truth(rng, 1)
    if not misalignment:
        truth |= {name: 0.0 for name in truth if name.startswith("mis")}
    u = reference.random_attitudes(rng, count)
    data = np.array([reference.forward(G * d, truth, 1) for d in u]) + sigma * rng.standard_normal((count, 3))
    attitudes = il.find_attitudes(table(data, sigma=sigma if stated else None))
    return il.fit_tumble(attitudes, order=order, gravity=G).calibration, data, truth


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("misalignment", [True, False])
def test_a_smaller_model_is_the_least_squares_fit_of_its_own(misalignment, stated):
    record, data, _ = made(stated=stated)
    found = linear_record(record, misalignment=misalignment)
    count = 9 if misalignment else 6

    def residual(p):
        b, s, m = p[:3], p[3:6], np.concatenate([p[6:], np.zeros(9 - len(p))])
        a = data / s - b
        x = a[:, 0]
        y = a[:, 1] - m[0] * x
        return np.sqrt(x**2 + y**2 + (a[:, 2] - m[1] * x - m[2] * y) ** 2) - G

    start = np.concatenate([np.zeros(3), np.ones(3), np.zeros(count - 6)])
    expected = optimize.least_squares(residual, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    spread = np.linalg.inv(expected.jac.T @ expected.jac) * 2 * expected.cost / (len(data) - count)
    for (name, p), value, u in zip(found.parameters.items(), expected.x, np.sqrt(np.diag(spread)), strict=False):
        assert p.value == pytest.approx(value, abs=0.02 * u), name  # the noise lengthens |f| by a little
        assert p.standard_uncertainty == pytest.approx(u, rel=0.1 if stated else 0.01), name
    assert found.model["order"] == 1
    assert [found.value(f"misalignment_{p}") != 0 for p in ("yx", "zx", "zy")] == [misalignment] * 3


def test_px4_gets_the_best_scale_factors_and_not_those_of_order_3(tmp_path):
    record, _, truth = made(misalignment=False, count=24, sigma=0.02)
    told = []
    (file,) = export("px4", [record], tmp_path, ExportOptions(lossy=True, device_id=77, tell=told.append))
    values = programs.px4(file)[0]
    error = [values[f"CAL_ACC0_{a}SCALE"] * truth[f"scale_factor_{a.lower()}"] - 1 for a in "XYZ"]
    kept = [truth[f"scale_factor_{a}"] / record.value(f"scale_factor_{a}") - 1 for a in "xyz"]
    assert np.linalg.norm(error) < 0.5 * np.linalg.norm(kept)
    (line,) = [
        line for line in file.read_text().splitlines() if "were fitted anew to the record's 24 attitudes" in line
    ]
    ppm = float(re.search(r"and ([0-9.]+) ppm", line)[1])
    assert max(map(abs, error)) < 4e-6 * ppm
    assert [message.startswith("px4: ") for message in told] == [True, True]
    assert told[1].removeprefix("px4: ") in line


def test_a_smaller_fit_that_is_not_to_be_had_is_said(tmp_path):
    record, _, _ = made(order=1, count=9)
    assert linear_record(record, misalignment=True) is None
    bare = replace(made()[0], data={})
    (file,) = export("ros", [bare], tmp_path, ExportOptions(lossy=True))
    assert "those of the whole model: the record holds no attitudes" in file.read_text()


def test_the_command_says_what_is_lost(tmp_path, imulab):
    made()[0].save(tmp_path / "unit.json")
    done = imulab("export", "--to", "kalibr", "unit.json", "-o", "out", "--lossy")
    assert done.returncode == 0
    assert "left out (lossy): k2_x" in done.stderr
    assert "bias, scale factor and misalignment were fitted anew" in done.stderr


def test_too_few_attitudes_to_fit_anew_are_called_so(tmp_path):
    record, _, _ = made()
    few = {key: value[:5] for key, value in record.data["attitudes"].items() if value is not None}
    told = []
    with_few = replace(record, data={**record.data, "attitudes": few})
    export("kalibr", [with_few], tmp_path, ExportOptions(lossy=True, device_id=77, tell=told.append))
    (line,) = [line for line in told if "whole model" in line]
    assert "the record's 5 attitudes are too few, or not the ones, to fit them to anew" in line


@pytest.mark.parametrize("target", ["px4", "ardupilot", "kalibr", "openvins", "ros"])
def test_every_lossy_target_says_on_standard_error_what_it_leaves_out(imulab, tmp_path, target):
    made(misalignment=True)[0].save(tmp_path / "unit.json")
    done = imulab("export", "--to", target, "unit.json", "-o", "out", "--lossy")
    assert done.returncode == 0, done.stderr
    assert f"imulab: warning: {target}: left out (lossy): " in done.stderr
    assert "k2_x" in done.stderr
    assert "fitted anew to the record's 30 attitudes" in done.stderr

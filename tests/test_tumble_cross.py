"""Cross terms: what of them |f| can show, their fit, and the same correction on the desk and in a unit."""

import re
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from conftest import table
from imulab.device.unit import load_blob
from imulab.errors import OptionError, RecordError
from imulab.exporters import ExportOptions, export
from imulab.procedures.tumble.model import norm_and_jacobian, parameter_count
from reference import tumble as reference

G = 9.80665
UG = G * 1e-6
CROSS = ("k_xy", "k_yz", "k_zx")


def unit(seed, order=2, size=3e-4):
    """Return the truth of a triad, cross terms included, 1/(m/s^2)."""
    rng = np.random.default_rng(seed)
    truth = reference.random_truth(rng, order)
    return truth | dict(zip(CROSS, rng.uniform(-size, size, 3) / G, strict=True))


def outputs(truth, order, force):
    """M = S (A + b), A = s + k2 s^2 + ..., with k_xy s_x s_y in A_x, k_yz s_y s_z in A_y, k_zx s_z s_x in A_z."""
    x, y, z = force.T
    s = [x, y + truth["misalignment_yx"] * x, z + truth["misalignment_zx"] * x + truth["misalignment_zy"] * y]
    columns = []
    for i, axis in enumerate("xyz"):
        a = s[i] + truth[CROSS[i]] * s[i] * s[(i + 1) % 3]
        for power in range(2, order + 1):
            a = a + truth[f"k{power}_{axis}"] * s[i] ** power
        columns.append(truth[f"scale_factor_{axis}"] * (a + truth[f"bias_{axis}"]))
    return np.column_stack(columns)


def fitted(truth, order, count=36, sigma=None, noise=0.0, seed=1, **options):
    rng = np.random.default_rng(seed)
    data = outputs(truth, order, G * reference.random_attitudes(rng, count)) + noise * rng.standard_normal((count, 3))
    return il.fit_tumble(il.find_attitudes(table(data, sigma=sigma)), order=order, gravity=G, **options).calibration


def test_bias_k2_and_cross_terms_leave_one_function_of_third_degree():
    """Of ten: x, y, z times 1, the cubes, three products; xyz is what is left, and other pairs add nothing."""
    u = reference.random_attitudes(np.random.default_rng(1), 400)
    x, y, z = u.T
    held = np.column_stack([u, u**3, x * x * y, y * y * z, z * z * x])
    others = np.column_stack([x * y * y, y * z * z, z * x * x])
    assert np.linalg.matrix_rank(held, tol=1e-9 * 20) == 9
    assert np.linalg.matrix_rank(np.column_stack([held, others]), tol=1e-9 * 20) == 9
    assert np.linalg.matrix_rank(np.column_stack([held, x * y * z]), tol=1e-9 * 20) == 10


@pytest.mark.parametrize("order", [1, 2, 3])
def test_exact_data_give_every_parameter_back(order):
    truth = unit(order, order)
    record = fitted(truth, order, cross=True)
    for name, value in truth.items():
        scale = max(abs(value), 1e-3 if name.startswith("k") else 1.0)
        assert record.value(name) == pytest.approx(value, abs=2e-8 * scale), name
    assert {record.parameters[name].unit for name in CROSS} == {"1/(m/s^2)"}
    assert record.model["cross"] is True


def test_derivatives_are_those_of_the_lengths():
    rng = np.random.default_rng(4)
    theta = np.zeros((2, parameter_count(2, True)))
    theta[:, 3:6] = 1.01
    theta += 1e-3 * rng.standard_normal(theta.shape)
    reading = rng.standard_normal((2, 5, 3))
    jacobian = norm_and_jacobian(theta, reading, 2)[1]
    for j in range(theta.shape[1]):
        step = np.zeros(theta.shape[1])
        step[j] = 1e-6
        ends = [norm_and_jacobian(theta + s * step, reading, 2)[0] for s in (1, -1)]
        # The coupling of the axes is left out of the derivatives: a share of |k s| of them.
        np.testing.assert_allclose(jacobian[:, :, j], (ends[0] - ends[1]) / 2e-6, atol=1e-2)


def test_intervals_cover_and_the_pattern_is_gone(reduced):
    """What the same attitudes give without cross terms is off, and says so."""
    trials = 20 if reduced else 60
    covered = []
    for seed in range(trials):
        truth = unit(seed, 1, size=0.0) | dict(zip(CROSS, np.array([2e-4, -2e-4, 2e-4]) / G, strict=True))
        options = {"count": 36, "sigma": 20 * UG, "noise": 20 * UG, "seed": seed}
        record = fitted(truth, 1, cross=True, **options)
        factor = record.fit["coverage_factor_95"]
        covered += [
            abs(record.value(n) - v) <= factor * record.parameters[n].standard_uncertainty for n, v in truth.items()
        ]
        if seed < 5:
            assert not any("function of the direction" in w for w in record.warnings)
            assert any("--cross --order 1 fits these" in w for w in fitted(truth, 1, **options).warnings)
    assert 0.93 <= np.mean(covered) <= 0.985  # 60 tests: 1.3 % of spread


@pytest.mark.parametrize("order", [1, 3])
def test_apply_undoes_the_equations_on_the_desk_and_from_a_blob(tmp_path, order):
    truth = unit(7, order)
    record = fitted(truth, order, cross=True)
    force = 1.5 * G * np.random.default_rng(2).uniform(-1, 1, (500, 3))
    raw = table(outputs(truth, order, force))
    np.testing.assert_allclose(il.apply(record, raw).triad("accel"), force, rtol=0, atol=1e-6 * G)
    (blob,) = export("blob", [record], tmp_path)
    np.testing.assert_allclose(il.apply(load_blob(blob), raw).triad("accel"), force, rtol=0, atol=1e-4)
    export("c", [record], tmp_path / "c")


def test_targets_without_cross_terms_refuse_them_and_fit_anew(tmp_path):
    record = fitted(unit(8, 1), 1, cross=True, count=36)
    with pytest.raises(OptionError, match="kalibr cannot hold k_xy k_yz k_zx, which changes outputs by up to"):
        export("kalibr", [record], tmp_path)
    (file,) = export("kalibr", [record], tmp_path, ExportOptions(lossy=True))
    assert re.search("left out \\(lossy\\): k_xy k_yz k_zx", file.read_text())


def test_what_cross_terms_do_not_go_with_is_refused(imulab):
    record = fitted(unit(9), 2, cross=True)
    attitudes = il.find_attitudes(table(np.ones((3, 3))))
    for options in ({"method": "linearised"}, {"monte_carlo": 1000}, {"order": "auto"}, {"order": 0}):
        with pytest.raises(OptionError, match="cross needs method norm and an order of 1 to 5"):
            il.fit_tumble(attitudes, **{"order": 2, "gravity": G, "cross": True} | options)
    with pytest.raises(RecordError, match="a record with cross terms cannot be a prior"):
        fitted(unit(9), 2, sigma=1e-4, noise=1e-4, prior=record)
    broken = {name: p for name, p in record.parameters.items() if name != "k_yz"}
    with pytest.raises(RecordError, match="lacks k_yz"):
        il.apply(replace(record, parameters=broken), table(np.ones((3, 3))))


def test_a_record_with_cross_terms_is_not_checked():
    record = fitted(unit(3), 2, sigma=1e-4, noise=1e-4, cross=True)
    attitudes = il.find_attitudes(table(G * reference.random_attitudes(np.random.default_rng(4), 12), sigma=1e-4))
    for limit in (None, 1e-3 * G):
        with pytest.raises(RecordError, match="a record with cross terms cannot be checked"):
            il.check_tumble(record, attitudes, limit=limit)


def test_the_command_fits_and_shows_them(imulab, tmp_path):
    truth = unit(10, 1)
    rng = np.random.default_rng(3)
    rows = outputs(truth, 1, G * reference.random_attitudes(rng, 30)) + 1e-4 * rng.standard_normal((30, 3))
    np.savetxt(
        tmp_path / "r.csv", rows, delimiter=",", header="accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2]", comments=""
    )
    fit = ("tumble", "fit", "r.csv", "--order", "1", "--gravity", "9.80665", "--cross")
    done = imulab(*fit, "-o", "r.json", "--report", "r.html")
    assert done.returncode == 0, done.stderr
    value, u = map(float, re.search(r"k_xy +(-?[\d.]+) +([\d.]+) .*µg/g²", done.stdout).groups())
    assert abs(value - 1e6 * G * truth["k_xy"]) < 5 * u
    assert "k_zx" in (tmp_path / "r.html").read_text()
    assert imulab("tumble", "gyro", "r.csv", "--accel", "r.json").returncode == 2  # no gyroscopes in it, and said so

"""The inverse model and its derivatives against equations transcribed apart."""

import re
from dataclasses import replace
from decimal import Decimal, getcontext

import numpy as np
import pytest
from scipy import optimize

import imulab as il
import madeup
from conftest import table
from imulab.device.unit import DeviceUnit, load_blob
from imulab.errors import OptionError, RecordError
from imulab.exporters import ExportOptions, export
from imulab.procedures.apply import tables_of
from imulab.procedures.tumble.model import (
    fit_lengths,
    invert,
    left_out_lengths,
    length_noise,
    norm_and_jacobian,
    parameter_count,
    parameter_names,
)
from reference import tumble as reference

G = 9.80665


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_names_are_those_of_the_record(order):
    assert parameter_names(order) == list(reference.names(order))


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_inversion_undoes_the_transcribed_forward_model(order):
    rng = np.random.default_rng(order)
    truth = reference.random_truth(rng, order)
    force = G * reference.random_attitudes(rng, 50)
    output = np.array([reference.forward(f, truth, order) for f in force])
    scale = np.array([truth[f"scale_factor_{a}"] for a in "xyz"])
    bias = np.array([truth[f"bias_{a}"] for a in "xyz"])
    misalignment = np.array([truth[f"misalignment_{p}"] for p in ("yx", "zx", "zy")])
    k = np.array([[truth[f"k{j}_{a}"] for a in "xyz"] for j in range(2, order + 1)]).reshape(order - 1, 3)
    found = invert(output / scale - bias, misalignment, k).force
    np.testing.assert_allclose(found, force, rtol=0, atol=1e-13 * G)


def test_nan_stays_in_the_components_it_touches():
    reading = np.array([[1.0, 2.0, np.nan], [1.0, np.nan, 3.0], [np.nan, 2.0, 3.0], [1.0, 2.0, 3.0]])
    found = invert(reading, np.array([0.01, 0.02, 0.03]), np.full((1, 3), 1e-3)).force
    expected = [[False, False, True], [False, True, True], [True, True, True], [False, False, False]]
    assert np.isnan(found).tolist() == expected


def test_an_axis_that_gives_no_such_output_leaves_the_others_alone():
    """s - s^2 / 4 is 1 at most; the axes are inverted side by side, each for as long as it needs."""
    k = np.array([[0.0, 0.0, -0.25]])
    found = invert(np.array([[0.3, -0.7, 0.9], [0.3, -0.7, 1.1]]), np.zeros(3), k).force
    np.testing.assert_allclose(found[0], [0.3, -0.7, 2 - 2 * np.sqrt(0.1)], rtol=0, atol=1e-14)
    np.testing.assert_array_equal(found[1], [0.3, -0.7, np.nan])


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_the_unit_inverts_the_law_that_was_fitted_to_the_last_bit(order):
    record = madeup.tumble(order)
    flat = {
        name: 1.0 if name.startswith("scale") else 0.0 for name in record.parameters if name[:4] in ("scal", "bias")
    }
    parameters = {n: replace(p, value=flat.get(n, p.value)) for n, p in record.parameters.items()}
    unit = DeviceUnit.of(*tables_of(replace(record, parameters=parameters)))
    reading = np.random.default_rng(order).uniform(-25.0, 25.0, (20_000, 3))
    k = np.array([[parameters[f"k{j}_{a}"].value for a in "xyz"] for j in range(2, order + 1)]).reshape(order - 1, 3)
    fitted = invert(reading, np.array([parameters[f"misalignment_{p}"].value for p in ("yx", "zx", "zy")]), k).force
    applied, _ = unit.tumble(list(reading.T))
    assert np.isfinite(fitted).all()
    np.testing.assert_array_equal(np.column_stack(applied), fitted)


def test_the_second_order_is_inverted_to_the_last_digits_up_to_the_turning_point():
    """Against 50 digits. Where the slope is small, rounding of the reading is worth 1 / slope of it in the force."""
    k = np.concatenate([[-0.25, 0.0, 1e-300, 1e-9], np.random.default_rng(2).uniform(-0.3, 0.3, 200)])
    share = np.concatenate([[0.999999, 0.5, -3.0, 1.0], np.random.default_rng(3).uniform(-1.0, 0.9999, 200)])
    reading = np.where(np.abs(k) > 1e-6, -share / np.where(k == 0.0, 1.0, 4 * k), share)
    found = invert(np.repeat(reading[:, None], 3, axis=1), np.zeros(3), np.repeat(k[:, None, None], 3, axis=2)).force
    getcontext().prec = 50
    for a, k2, s in zip(reading.tolist(), k.tolist(), found[:, 0].tolist(), strict=True):
        slope = (1 + 4 * Decimal(k2) * Decimal(a)).sqrt()
        assert s == pytest.approx(float(2 * Decimal(a) / (1 + slope)), rel=4e-16 / float(slope))


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_jacobian_equals_central_differences(order):
    rng = np.random.default_rng(10 + order)
    reading = reference.random_attitudes(rng, 20)[None] * 1.02
    theta = np.zeros((1, 3 * (order + 2)))
    theta[:, 3:6] = 1.0
    theta += 0.02 * rng.standard_normal(theta.shape)
    jacobian = norm_and_jacobian(theta, reading, order)[1][0]
    for index in range(theta.shape[1]):
        step = np.zeros_like(theta)
        step[0, index] = 1e-6
        up, down = (norm_and_jacobian(theta + s * step, reading, order)[0][0] for s in (1, -1))
        np.testing.assert_allclose(jacobian[:, index], (up - down) / 2e-6, rtol=0, atol=1e-9)


def test_a_batch_gives_each_problem_what_it_gets_alone():
    rng = np.random.default_rng(5)
    reading = reference.random_attitudes(rng, 4 * 12).reshape(4, 12, 3)
    theta = np.tile([0.0] * 3 + [1.0] * 3 + [0.0] * 6, (4, 1)) + 0.01 * rng.standard_normal((4, 12))
    norm, jacobian, _, q = norm_and_jacobian(theta, reading, 2)
    for i in range(4):
        alone = norm_and_jacobian(theta[i : i + 1], reading[i : i + 1], 2)
        np.testing.assert_allclose(norm[i], alone[0][0], rtol=1e-15)
        np.testing.assert_allclose(jacobian[i], alone[1][0], rtol=0, atol=1e-15)
        np.testing.assert_allclose(q[i], alone[3][0], rtol=1e-14)


def by_scipy(start, reading, weights, lengthening, order):
    """The root of the gradient beside the solution, which is sharper than where the cost is flat to rounding."""

    def model(theta):
        norm, jacobian, _, _ = norm_and_jacobian(theta[None], reading[None], order)
        return np.sqrt(weights) * (norm[0] - 1 - lengthening), np.sqrt(weights)[:, None] * jacobian[0]

    found = optimize.least_squares(
        lambda p: model(p)[0], start, lambda p: model(p)[1], xtol=1e-12, ftol=1e-15, gtol=1e-15
    )
    return optimize.root(lambda p: model(p)[1].T @ model(p)[0], found.x, tol=1e-14).x


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_the_fit_in_c_finds_the_solutions_of_scipy(order):
    rng = np.random.default_rng(20 + order)
    start = np.zeros((6, 3 * (order + 2)))
    start[:, 3:6] = 1.0
    reading = reference.random_attitudes(rng, 30)[None] * 1.03 + 0.01
    weights = rng.uniform(0.5, 2.0, (6, 30))
    weights[np.arange(6), np.arange(6)] = 0.0
    lengthening = rng.uniform(0, 1e-4, (6, 30))
    found = fit_lengths(start, reading, weights, lengthening, order, tolerance=1e-9, most=60)
    assert found.converged.all()
    for b in range(6):
        expected = by_scipy(start[b], reading[0], weights[b], lengthening[b], order)
        np.testing.assert_allclose(found.parameters[b], expected, rtol=0, atol=5e-9)
        norm, jacobian, _, _ = norm_and_jacobian(found.parameters[b : b + 1], reading, order)
        np.testing.assert_allclose(found.residuals[b], norm[0] - 1 - lengthening[b], rtol=0, atol=1e-14)
        np.testing.assert_allclose(found.jacobian[b], jacobian[0], rtol=0, atol=1e-14)
    short = fit_lengths(start, reading, weights, lengthening, order, tolerance=1e-9, most=1)
    assert not short.converged.any()
    assert short.iterations.tolist() == [1] * 6


def test_a_first_step_is_that_of_gauss_and_newton():
    rng = np.random.default_rng(4)
    start = np.array([[0.0] * 3 + [1.0] * 3 + [0.0] * 6])
    reading, weights = reference.random_attitudes(rng, 30)[None] * 1.01 + 0.01, rng.uniform(0.5, 2.0, (1, 30))
    norm, jacobian, _, _ = norm_and_jacobian(start, reading, 2)
    root = np.sqrt(weights[0])
    step = np.linalg.lstsq(root[:, None] * jacobian[0], -root * (norm[0] - 1), rcond=None)[0]
    found = fit_lengths(start, reading, weights, np.zeros((1, 30)), 2, tolerance=1e-9, most=1)
    np.testing.assert_allclose(found.parameters[0], start[0] + step, rtol=0, atol=1e-11)


def test_a_bad_start_and_what_nothing_senses_are_met():
    rng = np.random.default_rng(3)
    reading = reference.random_attitudes(rng, 24)[None].copy()
    reading[..., 2] = 0.0  # z is never seen
    start = np.array([[0.4, -0.4, 0.1, 1.9, 0.6, 1.0, 0.3, 0.1, 0.1, 0.05, 0.05, 0.05]])
    costs = []
    for most in (0, 1, 2, 4, 8, 200):
        found = fit_lengths(start, reading, np.ones((1, 24)), np.zeros((1, 24)), 2, tolerance=1e-9, most=most)
        assert np.isfinite(found.parameters).all()
        costs.append(float((found.residuals**2).sum()))
    assert costs == sorted(costs, reverse=True)
    start[:] = np.nan
    lost = fit_lengths(start, reading, np.ones((1, 24)), np.zeros((1, 24)), 2, tolerance=1e-9, most=6)
    assert not lost.converged[0]


@pytest.mark.parametrize("alike", [True, False])
def test_noise_of_the_length_is_that_of_the_matrices(alike):
    rng = np.random.default_rng(6)
    theta = np.tile([0.0] * 3 + [1.0] * 3 + [0.0] * 6, (4, 1)) + 0.05 * rng.standard_normal((4, 12))
    reading = reference.random_attitudes(rng, 4 * 7).reshape(4, 7, 3)
    root = 0.01 * rng.standard_normal((1 if alike else 4, 7, 3, 3))
    covariance = root @ np.swapaxes(root, 2, 3)
    jacobian = norm_and_jacobian(theta, reading, 2)[1]
    lengthening, variance = length_noise(theta, jacobian, covariance)
    for b in range(4):
        yx, zx, zy = theta[b, 6:9]
        carried = np.linalg.inv([[1, 0, 0], [yx, 1, 0], [zx, zy, 1]]) @ np.diag(1 / theta[b, 3:6])
        for i in range(7):
            c, q = covariance[0 if alike else b, i], -jacobian[b, i, :3]
            np.testing.assert_allclose(variance[b, i], q @ c @ q, rtol=1e-13)
            np.testing.assert_allclose(
                lengthening[b, i], (np.trace(carried @ c @ carried.T) - q @ c @ q) / 2, rtol=0, atol=1e-13 * np.trace(c)
            )


def test_noise_that_is_not_finite_stays_in_its_attitude():
    theta = np.array([[0.0] * 3 + [1.0] * 3 + [0.0] * 3])
    reading = reference.random_attitudes(np.random.default_rng(7), 5)[None]
    covariance = np.tile(np.eye(3), (1, 5, 1, 1))
    covariance[0, 2, 1, 1] = np.nan
    lengthening, variance = length_noise(theta, norm_and_jacobian(theta, reading, 1)[1], covariance)
    assert np.isfinite(variance[0]).tolist() == np.isfinite(lengthening[0]).tolist() == [True, True, False, True, True]


def test_arrays_that_do_not_go_together_are_refused():
    with pytest.raises(ValueError, match="do not go together"):
        norm_and_jacobian(np.zeros((2, 9)), np.zeros((3, 5, 3)), 1)
    with pytest.raises(ValueError, match="do not go together"):
        fit_lengths(np.ones((1, 9)), np.ones((1, 5, 3)), np.ones((1, 4)), np.ones((1, 4)), 1, tolerance=1.0, most=1)
    with pytest.raises(ValueError, match="do not go together"):
        length_noise(np.ones((2, 9)), np.ones((2, 5, 9)), np.ones((3, 5, 3, 3)))


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_attitudes_left_out_one_by_one_are_predicted_by_fits_to_the_others(order):
    rng = np.random.default_rng(30 + order)
    start = np.array([[0.0] * 3 + [1.0] * 3 + [0.0] * (3 * order)])
    reading = reference.random_attitudes(rng, 26)[None] * 1.01 + 0.01 + 1e-3 * rng.standard_normal((1, 26, 3))
    weights, lengthening = rng.uniform(0.5, 2.0, (1, 26)), rng.uniform(0, 1e-4, (1, 26))

    start = fit_lengths(start, reading, weights, lengthening, order, tolerance=1e-9, most=60).parameters
    found = left_out_lengths(start, reading, weights, lengthening, order, tolerance=1e-9, most=60)
    for i in range(0, 26, 5):
        others = np.where(np.arange(26) == i, 0.0, weights[0])
        theta = by_scipy(start[0], reading[0], others, lengthening[0], order)
        norm = norm_and_jacobian(theta[None], reading, order)[0]
        assert found[i] == pytest.approx(norm[0, i] - 1 - lengthening[0, i], rel=0, abs=2e-8)
    for most in (0, 1, 2):
        found = left_out_lengths(start, reading, weights, lengthening, order, tolerance=1e-9, most=most)
        others = weights * (1 - np.eye(26))
        starts, lengthenings = np.repeat(start, 26, axis=0), np.repeat(lengthening, 26, axis=0)
        cut = fit_lengths(starts, reading, others, lengthenings, order, tolerance=1e-9, most=most)
        np.testing.assert_allclose(found, np.diagonal(cut.residuals), rtol=0, atol=1e-10)


def test_an_attitude_that_is_not_finite_spoils_its_predictions_and_no_more():
    reading = reference.random_attitudes(np.random.default_rng(8), 12)[None].copy()
    reading[0, 3, 1] = np.nan
    start, ones = np.array([[0.0] * 3 + [1.0] * 3 + [0.0] * 3]), np.ones((1, 12))
    found = left_out_lengths(start, reading, ones, 0 * ones, 1, tolerance=1e-9, most=15)
    # With a residual that is no number no step is better than the start.
    np.testing.assert_array_equal(found, norm_and_jacobian(start, reading, 1)[0][0] - 1)
    with pytest.raises(ValueError, match="do not go together"):
        left_out_lengths(start, reading, ones, np.ones((1, 11)), 1, tolerance=1e-9, most=15)


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

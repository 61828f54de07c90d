"""Least squares and its statistics against scipy, certified results and formulas transcribed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, linalg, optimize, stats

from imulab.estimation.least_squares import (
    bayesian_information,
    blend,
    chi_square_limit,
    covariance,
    coverage_factor,
    excess_variance,
    f_test,
    huber_inflation,
    huber_weights,
    least_squares,
    leverage,
    median,
    noise_share,
    observability,
    plausible_excess,
    restricted_log_likelihood,
    robust_scale,
)

# --- least squares ---------------------------------------------------------------------------------------------

TIMES = np.linspace(0, 3, 25)


START = np.array([1.5, 1.0, 0.0])


def decay(p):
    """``a exp(-b t) + c`` and its Jacobian."""
    e = np.exp(-p[1] * TIMES)
    return p[0] * e + p[2], np.stack([e, -p[0] * TIMES * e, np.ones_like(e)], axis=-1)


def decays(count: int, noise: float, seed: int = 1):
    """Truth and noisy decays; random weights, some of them zero."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform([1, 0.5, -1], [3, 2, 1], (count, 3))
    data = np.array([decay(p)[0] for p in truth]) + noise * rng.standard_normal((count, len(TIMES)))
    weights = rng.uniform(0.5, 2.0, data.shape) / max(noise, 1e-3) ** 2
    weights[rng.uniform(size=weights.shape) < 0.1] = 0.0
    return truth, data, weights


def fitted(data, weights, **options):
    return least_squares(lambda p: (decay(p)[0] - data, decay(p)[1]), START, weights, **options)


def test_the_solution_is_where_the_gradient_vanishes():
    for data, weights in zip(*decays(40, 0.05)[1:], strict=True):
        fit = fitted(data, weights)
        assert fit.converged.all()

        def gradient(p, data=data, weights=weights):
            return decay(p)[1].T @ (weights * (decay(p)[0] - data))

        exact = optimize.root(gradient, fit.parameters[0], tol=1e-14).x
        # scipy stops where the cost is flat to rounding, far within what the noise leaves open.
        deviation = np.sqrt(np.diag(covariance(fit.jacobian, fit.weights)[0]))
        np.testing.assert_allclose((fit.parameters[0] - exact) / deviation, 0, atol=1e-6)


def test_the_covariance_is_that_of_scipys_curve_fit():
    for data, weights in zip(*decays(40, 0.05)[1:], strict=True):
        fit, used = fitted(data, weights), weights > 0
        ours = covariance(fit.jacobian, fit.weights)[0]
        _, theirs = optimize.curve_fit(
            lambda t, a, b, c: a * np.exp(-b * t) + c,
            TIMES[used],
            data[used],
            p0=fit.parameters[0],
            sigma=1 / np.sqrt(weights[used]),
            absolute_sigma=True,
            jac=lambda t, a, b, c: decay(np.array([a, b, c]))[1][used],  # noqa: B023
        )
        np.testing.assert_allclose(ours, theirs, rtol=1e-6)
        jacobian = fit.jacobian[0]
        np.testing.assert_allclose(ours, np.linalg.inv(jacobian.T @ (weights[:, None] * jacobian)), rtol=1e-10)


def test_exact_data_give_back_the_truth():
    for truth, data, weights in zip(*decays(40, 0.0), strict=True):
        np.testing.assert_allclose(fitted(data, weights).parameters[0], truth, rtol=0, atol=1e-12)


def test_weight_zero_leaves_an_observation_out():
    _, (data,), (weights,) = decays(1, 0.05)
    without = fitted(data, weights).parameters
    data[weights == 0] = 1e3
    np.testing.assert_array_equal(fitted(data, weights).parameters, without)


def test_a_problem_that_cannot_be_evaluated_has_not_converged():
    _, (data,), (weights,) = decays(1, 0.05)
    data[np.flatnonzero(weights)[3]] = np.nan
    fit = fitted(data, weights)
    assert not fit.converged[0]
    np.testing.assert_array_equal(fit.parameters[0], START)


def test_too_few_evaluations_are_not_called_converged():
    _, (data,), (weights,) = decays(1, 0.05)
    assert not fitted(data, weights, max_evaluations=2).converged[0]


# Moré, Garbow, Hillstrom, Testing unconstrained optimization software, ACM TOMS 7 (1981) 17, problems 1, 8 and 15:
# start and minimum sum of squares as printed there.
BARD_Y = np.array([0.14, 0.18, 0.22, 0.25, 0.29, 0.32, 0.35, 0.39, 0.37, 0.58, 0.73, 0.96, 1.34, 2.10, 4.39])


KOWALIK_Y = np.array([0.1957, 0.1947, 0.1735, 0.1600, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246])


KOWALIK_U = np.array([4, 2, 1, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625])


def rosenbrock(x):
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def bard(x):
    u = np.arange(1, 16)
    v = 16 - u
    return BARD_Y - (x[0] + u / (v * x[1] + np.minimum(u, v) * x[2]))


def kowalik_osborne(x):
    u = KOWALIK_U
    return KOWALIK_Y - x[0] * (u**2 + u * x[1]) / (u**2 + u * x[2] + x[3])


def differenced(function):
    """A model whose Jacobian is by complex steps, exact to rounding."""

    def model(x):
        return function(x), np.stack([function(x + s).imag / 1e-30 for s in 1e-30j * np.eye(len(x))], axis=-1)

    return model


@pytest.mark.parametrize(
    ("function", "start", "minimum", "last_digit"),
    [
        (rosenbrock, [-1.2, 1.0], 0.0, 1e-20),
        (bard, [1.0, 1.0, 1.0], 8.21487e-3, 1e-8),
        (kowalik_osborne, [0.25, 0.39, 0.415, 0.39], 3.07505e-4, 1e-9),
    ],
)
def test_published_problems_reach_their_published_minimum(function, start, minimum, last_digit):
    model = differenced(function)
    fit = least_squares(model, np.array(start), np.ones(len(function(np.array(start)))))
    assert fit.converged[0]
    assert (fit.residuals[0] ** 2).sum() == pytest.approx(minimum, rel=0, abs=last_digit)


def test_misra1a_has_the_certified_parameters_and_deviations():
    # NIST Statistical Reference Datasets, Misra1a: y = b1 (1 - exp(-b2 x)), certified to 11 digits.
    x = np.array([77.6, 114.9, 141.1, 190.8, 239.9, 289.0, 332.8, 378.4, 434.8, 477.3, 536.8, 593.1, 689.1, 760.0])
    y = [10.07, 14.73, 17.94, 23.93, 29.61, 35.18, 40.02, 44.82, 50.76, 55.05, 61.01, 66.40, 75.47, 81.78]
    scale = np.array([100.0, 1e-4])

    def model(p):
        b1, b2 = p * scale
        e = np.exp(-b2 * x)
        return b1 * (1 - e) - y, np.stack([scale[0] * (1 - e), scale[1] * b1 * x * e], axis=-1)

    fit = least_squares(model, np.array([500.0, 1e-4]) / scale, np.ones(14), max_evaluations=200)
    assert fit.converged[0]
    np.testing.assert_allclose(fit.parameters[0] * scale, [2.3894212918e2, 5.5015643181e-4], rtol=1e-10)
    squares = (fit.residuals[0] ** 2).sum()
    assert squares == pytest.approx(1.2455138894e-1, rel=1e-10)
    deviations = np.sqrt(np.diag(covariance(fit.jacobian, fit.weights)[0]) * squares / 12) * scale
    np.testing.assert_allclose(deviations, [2.7070075241, 7.2668688436e-6], rtol=1e-9)


# --- observability and leverage --------------------------------------------------------------------------------

NAMES = ["bias_x", "bias_y", "scale_x", "scale_y", "k2_x"]


KNOWN = np.full(60, 1e16)  # noise so small that only the geometry counts


def design(seed=3):
    return np.random.default_rng(seed).standard_normal((60, 5))


def test_independent_columns_are_all_determined_with_the_condition_of_numpy():
    jacobian = design() * [1, 1e3, 1e-3, 1, 1]
    weights = KNOWN * np.random.default_rng(4).uniform(0.5, 2, 60)
    seen = observability(jacobian, weights)
    weighted = jacobian * np.sqrt(weights)[:, None]
    assert (seen.rank, seen.blind.shape) == (5, (0, 5))
    assert seen.condition == pytest.approx(np.linalg.cond(weighted / np.linalg.norm(weighted, axis=0)), rel=1e-12)


@pytest.mark.parametrize("scale", [1.0, 1e-4, 1e4])
@pytest.mark.parametrize(
    ("make", "rank", "confused"),
    [
        (lambda j: {2: 3 * j[:, 0]}, 4, {"bias_x", "scale_x"}),
        (lambda j: {4: j[:, 1] + j[:, 3]}, 4, {"bias_y", "scale_y", "k2_x"}),
        (lambda j: {1: 0 * j[:, 0]}, 4, {"bias_y"}),
        (lambda j: {1: 0 * j[:, 0], 4: 0 * j[:, 0]}, 3, {"bias_y", "k2_x"}),
        (lambda j: {0: -j[:, 3], 2: j[:, 1]}, 3, {"bias_x", "scale_y", "bias_y", "scale_x"}),
    ],
)
def test_what_cannot_be_told_apart_is_named(make, rank, confused, scale):
    jacobian = design()
    for column, values in make(jacobian).items():
        jacobian[:, column] = scale * values
    seen = observability(jacobian, KNOWN)
    assert seen.rank == rank
    assert seen.blind.shape == (5 - rank, 5)
    assert set(seen.confused(NAMES)) == confused


def test_fewer_observations_than_parameters_determine_no_more_than_there_are():
    seen = observability(design()[:3], KNOWN[:3])
    assert seen.rank == 3
    weights = KNOWN.copy()
    weights[3:] = 0
    assert observability(design(), weights).rank == 3


def test_the_weakest_combination_is_named_where_all_are_determined():
    jacobian = design()
    jacobian[:, 2] = jacobian[:, 0] + 0.01 * jacobian[:, 2]
    seen = observability(jacobian, KNOWN)
    assert seen.rank == 5
    assert set(seen.confused(NAMES)) == {"bias_x", "scale_x"}


@pytest.mark.parametrize(("sigma", "rank"), [(0.99 * 16, 1), (1.01 * 16, 0)])
def test_a_parameter_whose_curvature_drowns_in_noise_is_not_determined(sigma, rank):
    # Four observations of one parameter: its uncertainty is sigma / 2, and (sigma / 2)^2 / 2 = 2 sigma at sigma = 16.
    assert observability(np.ones((4, 1)), np.full(4, sigma**-2.0)).rank == rank


def test_leverage_is_the_diagonal_of_the_hat_matrix():
    jacobian = np.stack([design(1), design(2) * [1, 1e-6, 1e6, 1, 1]])
    weights = np.random.default_rng(5).uniform(0, 3, (2, 60))
    found = leverage(jacobian, weights)
    for j, w, h in zip(jacobian, weights, found, strict=True):
        x = np.sqrt(w)[:, None] * j / np.linalg.norm(j, axis=0)
        np.testing.assert_allclose(h, np.diag(x @ np.linalg.pinv(x)), atol=1e-13)
    np.testing.assert_allclose(found.sum(axis=1), 5, rtol=1e-13)


# --- robust loss and excess ------------------------------------------------------------------------------------


def test_huber_weights_fall_beyond_1_345():
    z = np.array([0.0, 0.5, -1.345, 1.345 * 2, -13.45, 1e6])
    np.testing.assert_allclose(huber_weights(z), [1, 1, 1, 0.5, 0.1, 1.345e-6], rtol=1e-15)


def test_huber_inflation_is_hubers_formula():
    # As statsmodels' robust linear model forms it (cov "H1"): Huber 1981, 7.6.12, with var(psi') in K.
    z = np.random.default_rng(6).standard_t(3, (4, 30))
    for size in (3, 12):
        expected = []
        for row in z:
            psi = [max(-1.345, min(1.345, value)) for value in row]
            slope = [1.0 if abs(value) <= 1.345 else 0.0 for value in row]
            m = np.mean(slope)
            k = 1 + size / 30 * np.var(slope) / m**2
            expected.append(k**2 * sum(value**2 for value in psi) / (30 - size) / m**2)
        np.testing.assert_allclose(huber_inflation(z, size), expected, rtol=1e-13)


def test_huber_inflation_of_normal_errors_is_the_price_of_95_percent_efficiency():
    count, c = 1_000_000, 1.345
    z = np.random.default_rng(7).standard_normal((1, count))
    inside = stats.norm.cdf(c) - stats.norm.cdf(-c)
    square = inside - 2 * c * stats.norm.pdf(c) + c**2 * (1 - inside)  # E psi^2
    fourth = 3 * inside - 2 * (c**3 + 3 * c) * stats.norm.pdf(c) + c**4 * (1 - inside)  # E psi^4
    spread = np.hypot(np.sqrt(fourth - square**2) / square, 2 * np.sqrt(inside * (1 - inside)) / inside)
    found = huber_inflation(z, 1)[0]
    assert found == pytest.approx(square / inside**2, rel=4 * spread / np.sqrt(count))
    assert 1 / (square / inside**2) == pytest.approx(0.95, abs=5e-4)


def test_huber_inflation_states_the_scatter_of_contaminated_fits():
    # Straight lines through 60 points, a tenth of them with five times the noise; 4000 trials tell 2.2 % of a variance.
    rng = np.random.default_rng(8)
    trials, n = 4000, 60
    x = np.column_stack([np.ones(n), np.linspace(-1, 1, n)])
    y = rng.standard_normal((trials, n)) * np.where(rng.uniform(size=(trials, n)) < 0.1, 5.0, 1.0)
    z = y
    for _ in range(30):
        w = huber_weights(z)
        normal = np.einsum("np,bn,nq->bpq", x, w, x)
        beta = np.linalg.solve(normal, np.einsum("np,bn,bn->bp", x, w, y)[:, :, None])[:, :, 0]
        z = y - beta @ x.T
    stated = huber_inflation(z, 2).mean() * np.diag(np.linalg.inv(x.T @ x))
    np.testing.assert_allclose(beta.var(axis=0), stated, rtol=4 * np.sqrt(2 / trials))
    assert np.all(np.linalg.inv(x.T @ x).diagonal() < 0.8 * beta.var(axis=0))  # without it the variance is too small


def test_the_excess_makes_chi_square_what_it_should_be():
    rng = np.random.default_rng(9)
    variance = rng.uniform(0.5, 2, (60, 30)) * 10.0 ** rng.uniform(-14, 6, (60, 1))
    residuals = rng.standard_normal((60, 30)) * np.sqrt(variance + 1.0)
    found = excess_variance(residuals, variance, 30)
    for r, v, tau in zip(residuals, variance, found, strict=True):
        if (r**2 / v).sum() <= 30:
            assert tau == 0
        else:
            most = (r**2).sum() / 30
            root = optimize.brentq(lambda t, r=r, v=v: (r**2 / (v + t)).sum() - 30, 0, most, xtol=1e-300, rtol=1e-14)
            assert tau == pytest.approx(root, rel=1e-11)  # the last step is below 1e-6, and convergence is quadratic
    assert 5 < np.count_nonzero(found == 0) < 30


@pytest.mark.parametrize("ratio", [0.01, 0.5, 1.0, 2.0, 50.0, 1e8])
@pytest.mark.parametrize(("count", "freedom"), [(12, 3), (24, 15), (400, 391)])
def test_the_plausible_excess_has_the_mean_precision_of_its_posterior(ratio, count, freedom):
    """All variances alike: chi-square is sufficient, and the posterior of the precision an integral over (0, 1)."""
    v, residuals = 1e-9, np.random.default_rng(count).standard_normal((1, count))
    chi_square = ratio * freedom
    residuals *= np.sqrt(v * chi_square / (residuals**2).sum())
    spare = np.full((1, count), freedom / count)
    excess, effective = plausible_excess(residuals, np.full((1, count), v), spare)
    b = min(0.25, freedom / 40, (freedom / 19) ** 2)
    # kappa = 1 - y^(1/b) takes the singularity at 1 away: a sum over equal steps of y.
    kappa = 1 - ((np.arange(400_000) + 0.5) / 400_000) ** (1 / b)
    density = stats.gamma.logpdf(kappa, freedom / 2, scale=2 / chi_square)
    share = np.exp(density - density.max())
    share /= share.sum()
    mean, square = share @ kappa, share @ kappa**2
    if ratio < 1e3:
        assert v / (v + excess[0]) == pytest.approx(mean, rel=3e-3)
        assert effective[0] == pytest.approx(2 * mean**2 / (square - mean**2), rel=0.1)
    else:  # all scatter, no own noise: its mean square and its degrees of freedom
        assert excess[0] == pytest.approx(v * ratio, rel=0.02)
        assert effective[0] == pytest.approx(freedom, rel=0.05)


def test_nothing_is_added_where_nothing_is_left_to_tell():
    excess, effective = plausible_excess(np.full((1, 9), 1e-3), np.full((1, 9), 1e-12), np.zeros((1, 9)))
    assert excess[0] == 0
    assert effective[0] == np.inf


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [1.0, 1.5, 2.0, 4.0])
@pytest.mark.parametrize(("count", "size"), [(24, 9), (24, 15), (48, 12)])
def test_intervals_with_the_plausible_excess_cover(ratio, count, size):
    """Linear fits whose observations scatter `ratio` times as much (in variance) as is stated of them."""
    rng = np.random.default_rng(3)
    trials = 2500
    design = rng.standard_normal((count, size))
    stated = rng.uniform(0.5, 2.0, count)
    noise = rng.standard_normal((trials, count)) * np.sqrt(stated + (ratio - 1) * stated.mean())
    weights = np.tile(1 / stated, (trials, 1))
    for _ in range(3):
        normal = np.einsum("np,tn,nq->tpq", design, weights, design)
        found = np.linalg.solve(normal, np.einsum("np,tn->tp", design, weights * noise)[:, :, None])[:, :, 0]
        spare = 1 - leverage(np.broadcast_to(design, (trials, count, size)), weights)
        excess, freedom = plausible_excess(noise - found @ design.T, np.tile(stated, (trials, 1)), spare)
        weights = 1 / (stated + excess[:, None])
    inverse = np.linalg.inv(np.einsum("np,tn,nq->tpq", design, weights, design))
    half = stats.t.ppf(0.975, freedom)[:, None] * np.sqrt(np.einsum("tpp->tp", inverse))
    covered = (np.abs(found) <= half).mean()
    print(f"scatter {ratio}, {count} observations, {size} parameters: {100 * covered:.1f} %")
    assert 0.925 <= covered <= 0.972


def test_robust_scale_is_the_median_deviation_about_zero_of_what_the_fit_leaves():
    z = np.random.default_rng(10).standard_normal((3, 41)) + 0.3
    left = np.array([sorted(row, key=abs)[9:] for row in z])  # nine parameters make nine residuals small
    theirs = stats.median_abs_deviation(left, axis=1, center=lambda a, axis: np.zeros(3), scale="normal")
    # 1.4826 is 1 / 0.67449 = 1.482602 rounded.
    np.testing.assert_allclose(robust_scale(z, 9), theirs, rtol=2e-6)


# --- tests and quantiles ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cost", "size", "larger", "larger_size", "count"),
    [(10, 9, 4, 12, 30), (10, 9, 9.9, 12, 30), (1e-9, 3, 1e-12, 4, 9)],
)
def test_the_f_test_is_that_of_scipy(cost, size, larger, larger_size, count):
    ratio = (cost - larger) / (larger_size - size) / (larger / (count - larger_size))
    expected = stats.f.sf(ratio, larger_size - size, count - larger_size)
    assert f_test(cost, size, larger, larger_size, count) == pytest.approx(expected, rel=1e-10)


def test_the_f_test_at_its_ends():
    assert f_test(10.0, 9, 5.0, 12, 12) == 1.0  # nothing left to judge the noise by
    assert f_test(10.0, 9, 0.0, 12, 20) == 0.0
    assert f_test(0.0, 9, 0.0, 12, 20) == 1.0
    assert f_test(10.0, 9, 10.0 + 1e-12, 12, 20) == 1.0


def test_the_bayesian_information_is_that_of_normal_residuals():
    r = np.random.default_rng(11).standard_normal(40)
    cost = float((r**2).sum())
    likelihood = stats.norm.logpdf(r, scale=np.sqrt(cost / 40)).sum()
    expected = -2 * likelihood + 7 * np.log(40) - 40 * (1 + np.log(2 * np.pi))  # constants that no order changes
    assert bayesian_information(cost, 7, 40) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("freedom", [1, 2, 29, 1000])
@pytest.mark.parametrize("probability", [0.05, 1e-3])
def test_the_chi_square_limit_is_that_of_scipy(freedom, probability):
    assert chi_square_limit(freedom, probability) == pytest.approx(stats.chi2.isf(probability, freedom), rel=1e-10)
    assert chi_square_limit(0, 0.01) == np.inf


def test_coverage_factors_are_students_and_the_normal_ones():
    # GUM (JCGM 100:2008), table G.2: t_95 for 1, 10 and 50 degrees of freedom; 1.96 and 2.576 for infinitely many.
    for freedom, printed in ((1, 12.71), (10, 2.23), (50, 2.01), (None, 1.960)):
        assert round(coverage_factor(freedom), 2) == printed
    assert round(coverage_factor(None, 0.99), 3) == 2.576
    for freedom in (1, 2.5, 29, 1000):
        assert coverage_factor(freedom, 0.9) == pytest.approx(stats.t.ppf(0.95, freedom), rel=1e-10)


@pytest.mark.parametrize(
    "values", [[3.0], [2.0, 1.0], [5.0, 1.0, 2.0], [1.0, np.inf, -np.inf, 0.0], [1.0, np.nan, 2.0]]
)
def test_the_median_is_that_of_numpy(values):
    np.testing.assert_equal(median(np.array(values)), np.median(values))


def test_a_step_of_three_terms_without_gain_is_two_thirds_noise_and_a_large_gain_leaves_four_over_it() -> None:
    mean, spread = noise_share([0.0, 200.0, 1e5], [3, 3, 3])
    assert mean == pytest.approx([2 / 3, 4 / 200, 4 / 1e5], rel=1e-3)
    assert spread == pytest.approx([1 / 18, 2 * (2 / 200) ** 2, 2 * (2 / 1e5) ** 2], rel=1e-2)


@pytest.mark.parametrize("added", [1, 2, 3])
@pytest.mark.parametrize("gain", [0.3, 4.0, 25.0])
@pytest.mark.parametrize("freedom", [None, 9])
@pytest.mark.parametrize("prior", [0.0, 0.5])
def test_shares_are_moments_of_the_stated_density(added: int, gain: float, freedom: int | None, prior: float) -> None:
    def density(root: float) -> float:  # in the square root, which has no pole at zero
        k = root**2
        tail = np.exp(-k * gain / 2) if freedom is None else (1 + k * gain / freedom) ** (-(freedom + added) / 2)
        return float(root ** (added + 2 * prior - 1) * tail)

    mass, first, second = (integrate.quad(lambda r, n=n: r ** (2 * n) * density(r), 0, 1)[0] for n in (0, 1, 2))
    mean, spread = noise_share([gain], [added], freedom, prior)
    assert mean[0] == pytest.approx(first / mass, rel=5e-3)
    assert spread[0] == pytest.approx(second / mass - (first / mass) ** 2, rel=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.0, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("estimated", [False, True])
def test_intervals_hold_the_truth_whichever_of_two_nested_models_is_right(
    size: float, estimated: bool, reduced: bool
) -> None:
    """A straight line that may bend: 95 % intervals of its value at zero, bend of `size` standard deviations."""
    x = np.linspace(-1, 1, 12)
    design = np.stack([np.ones(12), x, x**2], axis=1)
    small, large = (np.linalg.inv(design[:, :n].T @ design[:, :n]) for n in (2, 3))
    bend = size * np.sqrt(large[2, 2])
    rng = np.random.default_rng(4)
    covariances = np.zeros((2, 3, 3))
    covariances[0, :2, :2], covariances[1] = small, large
    inside = 0
    trials = 800 if reduced else 2000
    for _ in range(trials):
        y = bend * x**2 + rng.standard_normal(12)
        values = np.zeros((2, 3))
        values[0, :2], values[1] = small @ design[:, :2].T @ y, large @ design.T @ y
        squares = [float(((y - design @ v) ** 2).sum()) for v in values]
        freedom, factor = (9, stats.t.ppf(0.975, 9)) if estimated else (None, 1.96)
        found = blend(
            values, covariances, [squares[0] - squares[1]], [1], scale=squares[1] / 9 if estimated else 1.0,
            freedom=freedom, prior=0.0,
        )  # fmt: skip
        chosen = values[int(squares[0] - squares[1] > 3.84)]
        inside += abs(chosen[0]) < factor * np.sqrt(found.about(chosen)[0, 0])
    assert 0.925 <= inside / trials <= 0.99


def test_the_restricted_likelihood_is_that_of_what_the_design_cannot_change():
    """Of K' y, K the directions across the design: normal with covariance K' V K (scipy); up to one constant."""
    rng = np.random.default_rng(5)
    design, values = rng.standard_normal((9, 3)), rng.standard_normal(9)
    roots = rng.standard_normal((4, 9, 9))
    matrices = roots @ np.swapaxes(roots, 1, 2) + np.eye(9)
    across = linalg.null_space(design.T)
    expected = [
        stats.multivariate_normal(cov=across.T @ matrix @ across).logpdf(across.T @ values) for matrix in matrices
    ]
    logs = restricted_log_likelihood(matrices, design, values)
    np.testing.assert_allclose(np.diff(logs), np.diff(expected), rtol=1e-9)
    # Turns of many revolutions lie along the design, a million times as far as what tells the noise.
    far = restricted_log_likelihood(matrices, design, values + 1e6 * design @ [1.0, -2.0, 3.0])
    np.testing.assert_allclose(far, logs, rtol=1e-8)
    # White noise is as if it were in the covariance. Without any noise there is a number still.
    white = restricted_log_likelihood(matrices, design, values, np.array([0.0, 0.7]))
    alike = restricted_log_likelihood(matrices + 0.7 * np.eye(9), design, values)
    np.testing.assert_allclose(white, np.column_stack([logs, alike]), rtol=1e-9)
    assert np.isfinite(restricted_log_likelihood(np.zeros((1, 9, 9)), design, values)).all()


@pytest.mark.parametrize("seed", range(6))
def test_one_problem_is_solved_as_by_scipy_from_a_start_that_is_far_too(seed):
    """Exponentials with noise: from far away the plain Gauss-Newton step goes astray."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 4.0, 60)
    truth = np.array([2.0, 0.7, -1.0, 3.0]) * rng.uniform(0.7, 1.3, 4)
    weights = rng.uniform(0.5, 2.0, len(t)) / 0.02**2
    weights[::7] = 0.0

    def model(p):
        first, second = np.exp(-p[1] * t), np.exp(-p[3] * t)
        jacobian = np.column_stack([first, -t * p[0] * first, second, -t * p[2] * second])
        return p[0] * first + p[2] * second - measured, jacobian

    measured = 0.0
    measured = model(truth)[0] + 0.02 * rng.standard_normal(len(t))
    root = np.sqrt(weights)
    start = truth * np.array([0.3, 2.0, 3.0, 0.6])
    expected = optimize.least_squares(lambda p: root * model(p)[0], start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    fit = least_squares(model, start, weights)
    assert fit.converged[0]
    cost = float(np.sum(weights * model(fit.parameters[0])[0] ** 2))
    assert cost <= 2 * expected.cost * (1 + 1e-9)
    pairs = (sorted(p.reshape(2, 2).tolist(), key=lambda pair: pair[1]) for p in (fit.parameters[0], expected.x))
    np.testing.assert_allclose(*pairs, rtol=1e-5)  # either exponential may come first


def test_a_problem_that_leads_out_of_its_domain_or_nowhere_is_not_called_solved():
    def leaves(p):
        return np.array([np.log(p[0]) + 20.0, 0.0]), np.array([[1 / p[0]], [0.0]])

    fit = least_squares(leaves, np.array([5.0]), np.ones(2))
    assert fit.converged[0]
    assert fit.parameters[0, 0] == pytest.approx(np.exp(-20.0), rel=1e-6)
    assert not least_squares(lambda p: (np.full(2, np.nan), np.ones((2, 1))), np.zeros(1), np.ones(2)).converged[0]
    far = least_squares(leaves, np.array([5.0]), np.ones(2), max_evaluations=3)
    assert not far.converged[0]
    assert far.iterations[0] == 3

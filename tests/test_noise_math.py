"""Noise models: against dense covariance matrices, the minimum of the likelihood, and the ends of its intervals."""

import numpy as np
import pytest
from scipy.fft import dct
from scipy.optimize import minimize

from imulab.estimation.noise.likelihood import deviance, fit, time_limits
from imulab.estimation.noise.terms import NAMES, Bins, allan_terms, letters, mean_terms, prepare, terms
from noise_models import LONG, TRUTHS, drawn, empty, intervals, unit
from reference import noise as reference


@pytest.mark.parametrize(
    ("letter", "time", "within"),
    [
        ("N", 1, 1e-9),
        ("K", 1, 1e-9),
        ("Q", 1, 5e-4),
        ("B", 1, 5e-4),
        ("G", 0.03, 5e-4),
        ("G", 0.3, 5e-4),
        ("G", 3, 5e-4),
    ],
)
def test_variances_of_coefficients_are_those_of_dense_covariances(letter, time, within):
    n, dt = 600, 0.01
    rows = dct(np.eye(n), axis=0, norm="ortho")[1:]
    dense = np.einsum("ij,jk,ik->i", rows, reference.covariance(letter, n, dt, time), rows)
    found = prepare([empty(n, dt, each=True)]).variances(unit(letter, time)[None])[0]
    np.testing.assert_allclose(found, dense, rtol=within)


@pytest.mark.parametrize(
    ("letter", "time"), [("N", 1), ("B", 1), ("K", 1), ("Q", 1), ("G", 0.5), ("G", 40), ("G", 3e3)]
)
def test_a_bin_has_the_mean_of_its_variances(letter, time):
    n, dt = 30_000, 0.1
    each = prepare([empty(n, dt, each=True)]).variances(unit(letter, time)[None])[0]
    spectrum = empty(n, dt)
    means = np.add.reduceat(each, spectrum.first - 1) / spectrum.freedom
    np.testing.assert_allclose(prepare([spectrum]).variances(unit(letter, time)[None])[0], means, rtol=5e-4)


@pytest.mark.parametrize(("letter", "time"), [("N", 1), ("K", 1), ("Q", 1), ("G", 0.02), ("G", 0.3), ("G", 30)])
@pytest.mark.parametrize("count", [1, 3, 20, 250])
def test_allan_variance_and_variance_of_a_mean_are_those_of_dense_covariances(letter, time, count):
    n, dt = 500, 0.01
    covariance = reference.covariance(letter, n, dt, time)
    weights, model, tau = reference.allan_weights(n, count), unit(letter, time), np.array([count * dt])
    assert allan_terms(model, tau, dt).sum() == pytest.approx(
        weights @ covariance @ weights, rel=1e-12 if time < 9 else 1e-10
    )
    if letter != "K":  # a walk has no mean, and counts by its Allan variance
        weights = reference.mean_weights(n, 0, count)
        assert mean_terms(model, tau, dt).sum() == pytest.approx(weights @ covariance @ weights, rel=1e-12)


def test_one_over_f_has_its_allan_variance_at_long_times():
    covariance, weights = reference.covariance("B", 2000, 1.0), reference.allan_weights(2000, 1000)
    assert allan_terms(unit("B"), np.array([1000.0]), 1.0).sum() == pytest.approx(
        weights @ covariance @ weights, rel=1e-5
    )


def test_models_are_named_by_letters():
    assert [letters(terms(name)) for name in ("N", "KN", "BN", "GN", "NGKG", "NQ")] == [
        "N",
        "NK",
        "NB",
        "NG",
        "NGGK",
        "NQ",
    ]


@pytest.mark.parametrize("name", [name for name in TRUTHS if "L/10" not in name])
def test_the_fit_is_the_minimum_that_another_minimiser_finds(name):
    truth = TRUTHS[name]
    has = truth > 0
    power = drawn(np.random.default_rng(4), LONG, truth, 3)
    frame, limits = prepare([LONG]), time_limits([LONG])
    found = fit(frame, has[None], limits, power, np.broadcast_to(LONG.freedom, power.shape))
    for k in range(3):
        own = Bins(**{**vars(frame), "power": power[k]})

        def depth(logarithms, own=own):
            model = np.zeros(len(NAMES))
            model[has] = np.exp(logarithms)
            return deviance(own, model[None])[0] - found.deviance[0]

        other = minimize(
            depth, np.log(truth[has]), method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-7, "maxiter": 4000}
        )
        assert depth(np.log(found.values[k, has])) == pytest.approx(other.fun, abs=1e-4)
        np.testing.assert_allclose(np.log(found.values[k, has]), other.x, atol=3e-3)


def test_a_model_never_fits_worse_than_one_inside_it():
    models = np.array([terms(name) for name in ("N", "NK", "NB", "NG", "NBK", "NGK", "NGB", "NGG", "NGGK")])
    rng = np.random.default_rng(5)
    power = np.concatenate([drawn(rng, LONG, truth, 12) for truth in TRUTHS.values()])
    found = fit(prepare([LONG]), models, time_limits([LONG]), power, np.broadcast_to(LONG.freedom, power.shape))
    reached = found.deviance.reshape(len(power), -1)
    for outer in range(len(models)):
        inside = (models <= models[outer]).all(axis=1)
        assert (reached[:, [outer]] <= reached[:, inside] + 1e-3).all()


def test_segments_add_up():
    truth = TRUTHS["N B"]
    rng = np.random.default_rng(6)
    parts = [empty(40_000, 0.1), empty(60_000, 0.05)]
    power = np.concatenate([drawn(rng, part, truth, 20) for part in parts], axis=1)
    freedom = np.broadcast_to(np.concatenate([part.freedom for part in parts]), power.shape)
    found = fit(prepare(parts), terms("NB")[None], time_limits(parts), power, freedom)
    scatter = np.log(found.values[:, :2] / truth[:2])
    spread = np.sqrt(np.einsum("rpp->rp", found.covariance)[:, :2])
    assert (np.abs(scatter.mean(axis=0)) < 4 * spread.mean(axis=0) / np.sqrt(20)).all()
    np.testing.assert_allclose(scatter.std(axis=0), spread.mean(axis=0), rtol=0.5)


@pytest.mark.parametrize("name", TRUTHS)
def test_an_interval_ends_where_the_deviance_has_risen_by_3_84(name):
    truth = TRUTHS[name]
    power = drawn(np.random.default_rng(7), LONG, truth, 2)
    found, lower, upper = intervals(truth, power)
    for ends in (lower, upper):
        for p in np.flatnonzero(truth):
            if ends[0, p] == 0 or ends[0, p] in time_limits([LONG]):
                continue
            own = Bins(**{**vars(prepare([LONG])), "power": power[0]})
            others = [k for k in np.flatnonzero(truth) if k != p]

            def depth(logarithms, p=p, others=others, own=own, end=ends[0, p], truth=truth):
                model = np.zeros(len(NAMES))
                model[others], model[p] = np.exp(logarithms), end
                model[5] = np.clip(model[5], *time_limits([LONG])) if truth[5] else 0
                return deviance(own, model[None])[0] - found.deviance[0]

            start = np.log(np.maximum(found.values[0, others], 1e-3))
            held = minimize(depth, start, method="Nelder-Mead", options={"fatol": 1e-5, "maxiter": 4000})
            assert held.fun == pytest.approx(3.84, abs=0.06), (p, ends[0, p])

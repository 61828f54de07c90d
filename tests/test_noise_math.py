"""Noise models: against dense covariance matrices, the likelihood's minimum, its intervals, and simulated records."""

import numpy as np
import pytest
from scipy.fft import dct
from scipy.optimize import minimize

from imulab.errors import OptionError
from imulab.estimation.noise.choice import CANDIDATES, Averaged, average, choose
from imulab.estimation.noise.duration import accuracy, length_for, visible
from imulab.estimation.noise.intervals import profile
from imulab.estimation.noise.likelihood import deviance, fit, time_limits
from imulab.estimation.noise.spectrum import Spectrum, bins
from imulab.estimation.noise.terms import NAMES, Bins, allan_terms, allan_variance, letters, mean_terms, prepare, terms
from imulab.estimation.noise.use import bias_square, walk_square, white_square
from imulab.estimation.special import ndtr, ndtri
from reference import noise as reference


def values(**sizes):
    return np.array([sizes.get(name, 0.0) for name in NAMES])


def unit(letter, time=1.0):
    return values(gm1_sigma=1.0, gm1_time=time) if letter == "G" else np.where(terms(letter), 1.0, 0.0)


def empty(count, interval, each=False):
    first, last = (np.arange(1, count),) * 2 if each else bins(count)
    return Spectrum(interval, count, first, last, np.ones(len(first)), (last - first + 1).astype(float))


def drawn(rng, spectrum, truth, trials):
    """Mean squares as the model has them: chi-square variables about the variances, shape (trials, b)."""
    lam = prepare([spectrum]).variances(truth[None])[0]
    return lam * rng.chisquare(spectrum.freedom, (trials, len(lam))) / spectrum.freedom


def transformed(samples, spectrum):
    """Mean squares of the coefficients of samples, shape (t, n)."""
    squares = dct(samples, norm="ortho", axis=-1)[..., 1:] ** 2
    return np.add.reduceat(squares, spectrum.first - 1, axis=-1) / spectrum.freedom


LONG = empty(100_000, 0.1)
CORNER = 1 / np.sqrt(2 * np.log(2) / np.pi)
TRUTHS = {
    "N K": values(white=1, walk=np.sqrt(3) / 100),
    "N K, corner at L/10": values(white=1, walk=np.sqrt(3) / 1000),
    "N B": values(white=1, flicker=CORNER / np.sqrt(30)),
    "N B K": values(white=1, flicker=CORNER / np.sqrt(30), walk=np.sqrt(3) / 200),
    "N K Q": values(white=1, walk=np.sqrt(3) / 100, quantisation=0.3),
    "N G, T = 100 s": values(white=1, gm1_sigma=np.sqrt(0.1), gm1_time=100),
    "N G, T = 1000 s": values(white=1, gm1_sigma=0.1, gm1_time=1000),
}
"""White noise of 1; corners at 100 or 1000 s with a walk, 30 s with 1/f; a Gauss-Markov density of 20 at 0."""


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


def _intervals(truth, power):
    has = np.broadcast_to(truth > 0, (len(power), len(NAMES)))
    freedom = np.broadcast_to(LONG.freedom, power.shape)
    frame, limits = prepare([LONG]), time_limits([LONG])
    found = fit(frame, has[:1], limits, power, freedom)
    return found, *profile(frame, found.values, has, limits, power, freedom)


@pytest.mark.parametrize("name", TRUTHS)
def test_an_interval_ends_where_the_deviance_has_risen_by_3_84(name):
    truth = TRUTHS[name]
    power = drawn(np.random.default_rng(7), LONG, truth, 2)
    found, lower, upper = _intervals(truth, power)
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


def test_how_long_to_record_follows_the_rules_of_thumb():
    """u(K)/K = sqrt(2 N/(K L)), u(B)/B = 1.25 N/(B sqrt L), Gauss-Markov .8 and 2.2 sqrt(T/L)."""
    walk, flicker, markov = (TRUTHS[name] for name in ("N K", "N B", "N G, T = 100 s"))
    assert accuracy(walk, 0.1, 1e4)[[0, 2]] == pytest.approx([1 / np.sqrt(2e5), np.sqrt(2 / (walk[2] * 1e4))], rel=0.02)
    assert accuracy(flicker, 0.1, 1e4)[1] == pytest.approx(1.25 / (flicker[1] * 100), rel=0.05)
    assert accuracy(markov, 0.1, 1e4)[4:6] == pytest.approx([0.08, 0.22], rel=0.03)
    assert length_for(walk, 0.1, 2, 0.1) == pytest.approx(115 * 100, rel=0.03)
    assert length_for(markov, 0.1, 4, 0.1) == pytest.approx(65 * 100, rel=0.03)
    assert length_for(markov, 0.1, 5, 0.1) == pytest.approx(500 * 100, rel=0.03)
    with pytest.raises(OptionError, match="expected a term that the model has"):
        length_for(walk, 0.1, 1, 0.1)


def test_limits_of_slow_noise_from_a_record_of_white_noise():
    """K below about 11 N/L and B below 3.9 N/sqrt(L), twice the length and a half, or by root 2."""
    white = values(white=1)
    short, long = (visible(white, terms("NBK"), 0.1, length) for length in (1e4, 2e4))
    assert short[[1, 2]] == pytest.approx([3.9e-2, 11.5e-4], rel=0.1)
    assert (short / long)[[1, 2]] == pytest.approx([np.sqrt(2), 2.0], rel=0.1)


AUTO = {"N": values(white=1), **TRUTHS}


@pytest.mark.parametrize(("name", "expected"), [("N", "N"), ("N K", "NK"), ("N B", "NB"), ("N G, T = 100 s", "NG")])
def test_the_terms_are_chosen_and_all_candidates_speak(name, expected):
    power = drawn(np.random.default_rng(11), LONG, AUTO[name], 40)
    choice = choose(prepare([LONG]), time_limits([LONG]), power, np.broadcast_to(LONG.freedom, power.shape))
    assert np.mean([CANDIDATES[index] == expected for index in choice.chosen]) >= 0.9
    assert not choice.rivals[np.arange(40), choice.chosen].any()
    np.testing.assert_allclose(choice.weights.sum(axis=1), 1)
    tau = np.array([100.0])
    found = average(choice, lambda models: allan_variance(models, tau, 0.1))
    low, middle, high = (found.quantile(level) for level in (0.025, 0.5, 0.975))
    true = allan_variance(AUTO[name], tau, 0.1)
    assert ((low < middle) & (middle < high)).all()
    assert np.mean((low < true) & (true < high)) >= 0.85


def test_quantisation_joins_where_it_shows():
    rng = np.random.default_rng(12)
    power = np.concatenate([drawn(rng, LONG, AUTO["N K Q"], 5), drawn(rng, LONG, AUTO["N K"], 5)])
    freedom = np.broadcast_to(LONG.freedom, power.shape)
    choice = choose(prepare([LONG]), time_limits([LONG]), power, freedom, full_band=True)
    assert choice.models[:, :, 3].all(axis=1).tolist() == [True] * 5 + [False] * 5
    partial = choose(prepare([LONG]), time_limits([LONG]), power, freedom)
    assert not partial.models[:, :, 3].any()


def test_quantiles_of_a_mixture_are_those_of_its_draws():
    rng = np.random.default_rng(13)
    centre, spread, weights = np.array([0.0, 1.0, 3.0]), np.array([0.1, 0.5, 0.2]), np.array([0.3, 0.5, 0.2])
    mixture = Averaged(np.exp(centre)[None, :, None], spread[None, :, None], weights[None])
    which = rng.choice(3, 400_000, p=weights)
    draws = np.exp(centre[which] + np.sqrt(spread[which]) * rng.standard_normal(len(which)))
    for level in (0.025, 0.5, 0.975):
        assert mixture.quantile(level)[0, 0] == pytest.approx(np.quantile(draws, level), rel=0.01)
    assert mixture.expected[0, 0] == pytest.approx(draws.mean(), rel=0.01)
    nothing = Averaged(np.array([[[0.0], [1.0]]]), np.array([[[0.0], [0.1]]]), np.array([[0.1, 0.9]]))
    assert nothing.quantile(0.025)[0, 0] == 0
    assert nothing.quantile(0.5)[0, 0] == pytest.approx(np.exp(np.sqrt(0.1) * ndtri(0.4 / 0.9)), rel=1e-6)


def test_a_filter_gets_white_noise_for_what_is_too_fast_to_be_slow():
    model = values(white=1, gm1_sigma=2, gm1_time=0.02, gm2_sigma=0.1, gm2_time=100, walk=1e-3)
    h, dt = np.array([10.0]), 0.01
    slow = values(gm1_sigma=0.1, gm1_time=100, walk=1e-3)
    assert walk_square(model, h, dt, shortest=0.02) == pytest.approx(3 * allan_variance(slow, h, dt) / 10)
    assert white_square(model, shortest=0.02) == pytest.approx(1 + 2 * 4 * 0.02)
    # A pure walk and pure white noise come back as they are.
    assert walk_square(values(walk=0.3), h, dt) == pytest.approx(0.09, rel=1e-5)
    assert white_square(values(white=0.3)) == pytest.approx(0.09)


@pytest.mark.slow
@pytest.mark.parametrize("name", TRUTHS)
def test_profiles_cover_and_estimates_reach_the_bound(name, request):
    """95 % of intervals hold the truth; the scatter is the Cramer-Rao bound's where that is below 15 %."""
    trials = 400 if request.config.getoption("--reduced") else 5000
    truth = TRUTHS[name]
    has = truth > 0
    found, lower, upper = _intervals(truth, drawn(np.random.default_rng(8), LONG, truth, trials))
    cover = ((lower <= truth) & (truth <= upper)).mean(axis=0)[has]
    margin = 2.5 * np.sqrt(0.05 * 0.95 / trials)
    assert (np.abs(cover - 0.95) < 0.02 + margin).all(), cover
    frame = prepare([LONG])
    own = Bins(**{**vars(frame), "power": frame.variances(truth[None])[0]})
    h, logs = 1e-4, np.log(truth[has])

    def depth(logarithms):
        model = np.zeros(len(NAMES))
        model[has] = np.exp(logarithms)
        return deviance(own, model[None])[0]

    steps = h * np.eye(len(logs))
    hessian = [
        [
            (depth(logs + a + b) - depth(logs + a - b) - depth(logs - a + b) + depth(logs - a - b)) / (8 * h * h)
            for b in steps
        ]
        for a in steps
    ]
    bound = np.sqrt(np.diag(np.linalg.inv(hessian)))
    errors = np.log(np.maximum(found.values[:, has], 1e-9)) - logs
    ratio = np.sqrt((errors**2).mean(axis=0)) / bound
    print(name, "cover", cover.round(3), "RMS/CRB", ratio.round(3), "CRB", bound.round(3))
    allowed = np.where(np.flatnonzero(has) == 2, 1.15, 1.05) + 2.5 / np.sqrt(2 * trials)
    assert (ratio < allowed)[bound < 0.15].all(), ratio


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "expected", "share"),
    [
        ("N", "N", 0.94),
        ("N K", "NK", 0.9),
        ("N B", "NB", 0.92),
        ("N G, T = 100 s", "NG", 0.93),
        ("N K, corner at L/10", "NK", 0.24),
        ("N G, T = 1000 s", "", 0),
    ],
)
def test_chosen_terms_and_averages_over_many_records(name, expected, share, request):
    trials = 200 if request.config.getoption("--reduced") else 1000
    truth, dt, length = AUTO[name], LONG.interval, LONG.length
    power = drawn(np.random.default_rng(14), LONG, truth, trials)
    choice = choose(
        prepare([LONG]), time_limits([LONG]), power, np.broadcast_to(LONG.freedom, power.shape), full_band=True
    )
    chosen = [letters(choice.models[k, index]) for k, index in enumerate(choice.chosen)]
    right = chosen.count(expected) / trials
    tau = np.array([length / 100, length / 10])
    found, true = average(choice, lambda models: allan_variance(models, tau, dt)), allan_variance(truth, tau, dt)
    cover = ((found.quantile(0.025) <= true) & (true <= found.quantile(0.975))).mean(axis=0)
    mean = np.array([length / 10])
    ratio = np.sqrt(
        average(choice, lambda models: bias_square(models, mean, dt)).expected / bias_square(truth, mean, dt)
    )
    within = (2 * ndtr(2 * ratio) - 1).mean()  # the error of a mean is normal, of the true variance
    print(name, "right", right, "sigma covers", cover, "bias covers", within, "median u/u_true", np.median(ratio))
    assert right >= share - 2.5 * np.sqrt(0.05 / trials)
    assert cover[0] >= 0.88
    assert cover[1] >= 0.83
    assert within >= (0.88 if "T = 1000" in name else 0.91)  # a time constant of L/10 is no longer told from a walk
    if name == "N":
        assert np.median(ratio) <= 1.05

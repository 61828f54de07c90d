"""Efficiency and coverage over thousands of trials, against the Cramér-Rao bound."""

import numpy as np
import pytest

import imulab as il
from conftest import table
from reference import tumble as reference

G = 9.80665
SIGMA = 2e-4  # m/s^2, 20 µg: the regime in which the bound is attainable


@pytest.mark.slow
@pytest.mark.parametrize(("order", "count"), [(1, 24), (2, 24), (4, 24), (4, 48)])
@pytest.mark.parametrize("known", [True, False], ids=["noise-known", "noise-estimated"])
def test_errors_reach_the_bound_and_intervals_cover(order, count, known, reduced):
    rng = np.random.default_rng(1000 * order + count)
    truth = reference.random_truth(rng, order)
    directions = reference.random_attitudes(rng, count)
    clean = np.array([reference.forward(G * d, truth, order) for d in directions])
    bound = np.sqrt(np.diag(reference.bound(directions, truth, order, G, np.full((count, 3), SIGMA))))
    true = np.array(list(truth.values()))
    trials = 250 if reduced else 5000
    errors, covered = np.empty((trials, len(true))), np.empty((trials, len(true)), dtype=bool)
    for trial in range(trials):
        noisy = clean + SIGMA * rng.standard_normal((count, 3))
        record = il.fit_tumble(
            il.find_attitudes(table(noisy, sigma=SIGMA if known else None)), order=order, gravity=G
        ).calibration
        errors[trial] = [p.value for p in record.parameters.values()] - true
        half = record.fit["coverage_factor_95"] * np.array([p.standard_uncertainty for p in record.parameters.values()])
        covered[trial] = np.abs(errors[trial]) <= half
    ratio = np.sqrt(np.mean(errors**2, axis=0)) / bound
    print(
        f"order {order}, {count} attitudes: rms / bound {ratio.min():.3f} to {ratio.max():.3f}, "
        f"pooled {np.sqrt(np.mean(ratio**2)):.3f}; coverage {100 * covered.mean():.1f} %"
    )
    assert ratio.max() <= (1.15 if reduced else 1.05)
    assert np.sqrt(np.mean(ratio**2)) <= 1.05
    assert 0.93 <= covered.mean() <= 0.97

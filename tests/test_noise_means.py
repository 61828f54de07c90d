"""The uncertainty of a mean at rest, from the noise of a log ten times as long, and of the stretch itself."""

import numpy as np
import pytest

from imulab.estimation.column_noise import columns_noise
from imulab.estimation.special import ndtr
from reference import noise as reference

COUNT, INTERVAL, WHITE = 20_000, 0.1, 0.1
MEAN = COUNT // 10
TRUTHS = {
    "white": {"N": WHITE},
    "walk": {"N": WHITE, "K": np.sqrt(3) * WHITE / 100},
    "1/f": {"N": WHITE, "B": WHITE / np.sqrt(2 * np.log(2) / np.pi * 30)},
    "Gauss-Markov": {"N": WHITE, "G": (np.sqrt(0.1) * WHITE, 100.0)},
}


def true_uncertainty(kind, duration):
    """Of a mean as the document has it: Allan variance of 1/f noise and walk, variance of a Gauss-Markov mean."""
    square, truth = WHITE**2 / duration, TRUTHS[kind]
    square += truth.get("B", 0.0) ** 2 * 2 * np.log(2) / np.pi + truth.get("K", 0.0) ** 2 * duration / 3
    if "G" in truth:
        sigma, time = truth["G"]
        x = duration / time
        square += 2 * sigma**2 / x**2 * (x - 1 + np.exp(-x))
    return np.sqrt(square)


def ratios(kind, count, duration, trials, seed=1):
    """Stated over true uncertainty of means over a duration, from records of `count` samples drawn in time."""
    rng = np.random.default_rng(seed)
    samples = [reference.draw(rng, TRUTHS[kind], count, INTERVAL) for _ in range(trials)]
    found = columns_noise(samples, 1 / INTERVAL)
    return np.array([each.mean_uncertainty(duration) for each in found]) / true_uncertainty(kind, duration)


@pytest.mark.parametrize("kind", TRUTHS)
def test_a_log_ten_times_as_long_tells_the_uncertainty_of_a_mean(kind):
    """Of a true normal error 2u cover so much, u being what each log says."""
    found = ratios(kind, COUNT, MEAN * INTERVAL, 25)
    assert np.mean(2 * ndtr(2 * found) - 1) >= 0.9
    if kind == "white":
        assert np.median(found) <= 1.05


def test_of_white_noise_a_stretch_tells_its_own_mean():
    found = ratios("white", MEAN, MEAN * INTERVAL, 25)
    assert 0.95 <= np.median(found) <= 1.6  # 5 with the guard against noise that does not show
    assert np.mean(2 * ndtr(2 * found) - 1) >= 0.9

"""Over many seeds: `robust` against the best weights that anyone could know, and its alarms on healthy gyros."""

import numpy as np
import pytest

from imulab.procedures.gyro_array.elements import find_elements
from imulab.procedures.gyro_array.fuse import FuseOptions, open_stream
from test_gyro_array_fuse import array_recording

pytestmark = pytest.mark.slow


def case(kind: str, seed: int, long: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """One of the source's two set-ups, made here: readings (m, 6), truth, white noise of each gyro, sampling rate."""
    from scipy.signal import lfilter

    rng = np.random.default_rng(seed)
    rate = 100.0 if kind == "static" else 50.0
    count = (200_000 if long else 50_000) if kind == "static" else 5000
    time = np.arange(count) / rate
    truth = np.zeros(count) if kind == "static" else -12.5 * np.cos(0.2 * np.pi * time - 0.2 * np.pi)
    sigma = 0.05 * rng.uniform(0.6, 1.6, 6)
    decay = np.exp(-1 / (200 * rate))
    slow = lfilter([0.003 * np.sqrt(1 - decay**2)], [1, -decay], rng.standard_normal((count, 6)), axis=0)
    walk = 2e-4 / np.sqrt(rate) * np.cumsum(rng.standard_normal((count, 6)), axis=0)
    readings = truth[:, None] + 0.02 * rng.standard_normal(6) + slow + walk + sigma * rng.standard_normal((count, 6))
    return readings, truth, sigma, rate


@pytest.mark.parametrize("kind", ["dynamic", "static"])
def test_robust_is_within_2_percent_of_known_variances_and_raises_no_alarm(kind, reduced):
    ratios, gains = [], []
    for seed in range(6 if reduced else 40):
        readings, truth, sigma, rate = case(kind, seed, not reduced)
        recording = array_recording(readings, rate)
        stream = open_stream(FuseOptions(), find_elements(recording), rate, readings[:100, None])
        out = stream.process(readings[:, None, :])
        assert not out.flags.any(), seed
        best = readings @ (sigma**-2 / np.sum(sigma**-2)) - truth
        ours = out.rate[:, 0] - truth
        ratios.append(ours.std() / best.std())
        gains.append(ours.std() / (readings.mean(axis=1) - truth).std())
    assert max(ratios) < 1.02
    assert np.median(ratios) < 1.005
    assert np.median(gains) < 0.95

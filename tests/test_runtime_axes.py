"""Three axes in one call are three times one to the last bit: rates, flags, weights and what the streams remember."""

from dataclasses import replace

import numpy as np
import pytest

from imulab.device import METHODS
from imulab.device.unit import ArraySettings, Stream

SAMPLES = 2000


def any_settings(rng, method):
    """Settings of three axes, a calibrated start and a fixed gain among them."""
    n = int(rng.integers(3, 10))
    more = {}
    if method == "robust":
        more = {
            "weights": rng.uniform(0.5, 2, (3, n)) if rng.random() < 0.4 else None,
            "memory_time": float(rng.choice([4.0, 100.0])),
            "weight_cap": float(rng.choice([0.3, 0.5, 0.9])),
        }
    if method == "covariance":
        more["weights"] = rng.uniform(0.5, 2, (3, n))
    if method == "kalman":
        more["gain"] = 0.01 * rng.uniform(0.5, 2, (3, n + 1, n))
    return ArraySettings(
        method,
        n,
        3,
        rate=50.0,
        memory=0.01 if rng.random() < 0.3 else None,
        start=int(rng.choice([1, 50])),
        initial_bias=[lambda: "first", lambda: "zero", lambda: 0.01 * rng.standard_normal((3, n))][rng.integers(3)](),
        bias=0.02 * rng.standard_normal((3, n)) if rng.random() < 0.3 else None,
        **more,
    )


def of_axis(settings, axis):
    """The same for one of the axes."""

    def row(value):
        return value if value is None or isinstance(value, str) else value[axis : axis + 1]

    return replace(
        settings,
        axes=1,
        initial_bias=row(settings.initial_bias),
        bias=row(settings.bias),
        weights=row(settings.weights),
        gain=row(settings.gain),
    )


def any_readings(rng, n):
    """Gyros of unlike quality, coarse ones at times, in motion, with faults of single gyros of single axes."""
    deviation = 0.05 * rng.uniform(0.5, 1.5, (3, n)) * np.where(rng.random((3, n)) < 0.1, 0.1, 1.0)
    z = 0.3 * np.sin(0.01 * np.arange(SAMPLES))[:, None, None] + deviation * rng.standard_normal((SAMPLES, 3, n))
    if rng.random() < 0.25:
        step = rng.choice([0.002, 0.02, 0.05])
        z = step * np.round(z / step)
    for _ in range(rng.integers(4)):
        begin = int(rng.integers(SAMPLES))
        end = min(SAMPLES, begin + int(rng.integers(1, rng.choice([10, SAMPLES]))))
        one = z[begin:end, rng.integers(3), rng.integers(n)]
        match rng.integers(7):
            case 0:
                one[:] = np.nan
            case 1:
                one[:] = 0.0
            case 2:
                one[:] = one[0]
            case 3:
                one[::7] += 5.0
            case 4:
                one += 0.4
            case 5:
                one += 0.03
            case 6:
                z[begin:end, rng.integers(3)] = np.nan
    return z


def compare(rng, method):
    settings = any_settings(rng, method)
    z = any_readings(rng, settings.elements)
    still = np.arange(SAMPLES) % 400 < 40 if rng.random() < 0.3 else None
    flags, weights = rng.random() < 0.6, rng.random() < 0.3
    together = Stream(settings)
    cuts = np.sort(rng.integers(0, SAMPLES, rng.integers(6)))
    parts = [
        together.process(z[rows], flags=flags, weights=weights, still=None if still is None else still[rows])
        for rows in np.split(np.arange(SAMPLES), cuts)
    ]
    share = len(together._state) // 3
    for axis in range(3):
        alone = Stream(of_axis(settings, axis))
        fused = alone.process(z[:, axis], flags=flags, weights=weights, still=still)
        np.testing.assert_array_equal(np.concatenate([part.rate[:, axis] for part in parts]), fused.rate[:, 0])
        if flags:
            np.testing.assert_array_equal(np.concatenate([part.flags[:, axis] for part in parts]), fused.flags[:, 0])
        if weights:
            found = np.concatenate([part.weights[:, axis] for part in parts])
            np.testing.assert_array_equal(found, fused.weights[:, 0])
        assert together._state[axis * share : (axis + 1) * share] == alone._state[:share]


def test_robust(reduced):
    for seed in range(40 if reduced else 120):
        compare(np.random.default_rng(seed), "robust")


@pytest.mark.parametrize("method", [method for method in METHODS if method != "robust"])
def test_the_other_methods(method):
    for seed in range(10):
        compare(np.random.default_rng([seed, 1]), method)

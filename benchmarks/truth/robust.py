"""Gyro arrays under `robust`: one gyro late in motion, two at the end of their range, one much better than the others.

Readings are made here, of plain sines and noise; the error is that of the fused rate against the rate put in, in deg/s.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from scenario import Scenario, Trial

GROUP = "Gyro array: robust fusion"
SIGMA = 0.05  # deg/s, white, of a usual gyro


def sines(rng: np.random.Generator, rms: float, highest: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return sizes, angular frequencies and phases of a motion of this rms, deg/s, below this frequency, Hz."""
    size = rng.standard_normal(12)
    size *= rms * np.sqrt(2 / np.sum(size**2))
    return size, 2 * np.pi * rng.uniform(0.05, highest, 12), rng.uniform(0, 2 * np.pi, 12)


def rate_of(motion: tuple[np.ndarray, np.ndarray, np.ndarray], time: np.ndarray) -> np.ndarray:
    """Return the rate of a motion."""
    size, frequency, phase = motion
    return np.asarray(np.sin(np.outer(time, frequency) + phase) @ size)


def fused(readings: np.ndarray, sampling: float) -> tuple[np.ndarray, bool]:
    """Return the fused rate, and whether a gyro is said to have failed."""
    import imulab as il

    columns = {f"gyro_{i + 1}": np.ascontiguousarray(row) for i, row in enumerate(readings.T)}
    columns["time"] = np.arange(len(readings)) / sampling
    units = dict.fromkeys(columns, "deg/s") | {"time": "s"}
    result = il.fuse(il.Recording(columns=columns, units=units, name="array"), il.FuseOptions(rate=sampling))
    failed = any(word in line for line in result.health.lines() for word in ("stuck", "jumped", "held"))
    return result.rate[:, 0], failed


def in_motion(seed: int, delay: float, highest: float) -> Trial:
    """Start in motion of 49 deg/s rms for 100 s at 100 Hz; mean error."""
    rng = np.random.default_rng([17, seed])
    motion, time = sines(rng, 49.0, highest), np.arange(10_000) / 100
    truth = rate_of(motion, time)
    bias = 0.02 * rng.standard_normal(6)
    noise = SIGMA * rng.uniform(0.6, 1.6, 6) * rng.standard_normal((len(time), 6))
    readings = truth[:, None] + bias - bias.mean() + noise
    readings[:, 2] += rate_of(motion, time - delay) - truth
    rate, failed = fused(readings, 100.0)
    return Trial(warned=failed, error=float((rate - truth).mean()))


def saturating(seed: int, limit: float) -> Trial:
    """Two of six end at `limit` on a rate table of 12.5 deg/s at 0.1 Hz; largest error after the first second."""
    rng = np.random.default_rng([18, seed])
    truth = -12.5 * np.cos(0.2 * np.pi * (np.arange(5000) / 50 - 1))
    sigma = SIGMA * rng.uniform(0.6, 1.6, 6)
    readings = truth[:, None] + 0.02 * rng.standard_normal(6) + sigma * rng.standard_normal((5000, 6))
    readings[:, [1, 4]] = np.clip(readings[:, [1, 4]], -limit, limit)
    rate, failed = fused(readings, 50.0)
    return Trial(warned=failed, error=float(np.abs(rate - truth)[50:].max()))


def one_better(seed: int, times: float) -> Trial:
    """One of six gyros so many times better, at rest for 200 s; noise over that of the best weights, after 100 s."""
    rng = np.random.default_rng([19, seed])
    sigma = SIGMA / np.array([1, times, 1, 1, 1, 1])
    readings = 0.02 * rng.standard_normal(6) + sigma * rng.standard_normal((20_000, 6))
    rate, failed = fused(readings, 100.0)
    return Trial(warned=failed, error=float(rate[10_000:].std() * np.sqrt(np.sum(sigma**-2))))


def _scenario(
    name: str, trial: partial[Trial], trials: int, largest: float, unit: str, *, fault: bool = False
) -> Scenario:
    """Return a scenario that asks for a largest error; a gyro that has failed must be named, a healthy one not."""
    return Scenario(
        GROUP, name, trial, trials, None, 95.0 if fault else None, None if fault else 5.0, largest, unit,
        source="errors asked for the array, docs/gyro_array_method.md",
    )  # fmt: skip


SCENARIOS = [
    _scenario(
        "starts in motion of 49 deg/s rms, all in time", partial(in_motion, delay=0.0, highest=2.0), 40, 0.002, "deg/s"
    ),
    *(
        _scenario(
            f"the same with one gyro {1000 * delay:.0f} ms late, motion below {highest:g} Hz",
            partial(in_motion, delay=delay, highest=highest),
            40,
            0.015,
            "deg/s",
        )
        for delay in (0.002, 0.005, 0.010)
        for highest in (0.5, 2.0, 5.0)
    ),
    _scenario("rate table of 12.5 deg/s, no gyro at its end", partial(saturating, limit=20.0), 40, 0.15, "deg/s"),
    _scenario("two of six end at 10 deg/s", partial(saturating, limit=10.0), 40, 0.40, "deg/s", fault=True),
    _scenario("two of six end at 4 deg/s", partial(saturating, limit=4.0), 40, 0.40, "deg/s", fault=True),
    _scenario("at rest, gyros alike", partial(one_better, times=1.0), 40, 1.02, "of the best"),
    _scenario("at rest, one of six ten times better", partial(one_better, times=10.0), 40, 1.2, "of the best"),
]

"""Simulated noise of a sensor at rest, drawn in the time domain, block by block. Nothing here is shared with the fit.

Source of the sum for 1/f noise: Keshner (1982): Gauss-Markov processes with evenly spaced logarithms of their time
constants.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from imulab.errors import OptionError, listed
from imulab.recording import Array

_BLOCK = 1 << 17  # samples drawn together; it bounds memory, and the drawn numbers depend on it
_PER_DECADE, _SHORTEST, _LONGEST = 2.5, 0.25, 10.0
"""Time constants of the 1/f sum in a decade; the shortest, in samples; the longest, in lengths of the record."""
TERMS = ("white", "flicker", "walk", "quantisation", "gm1_sigma", "gm1_time", "gm2_sigma", "gm2_time", "ramp")


@dataclass(frozen=True)
class FlickerSum:
    """Gauss-Markov processes whose sum is 1/f noise of unit B: time constants, s, and variances, shapes (k,)."""

    time: Array
    variance: Array
    white: float


def simulated(values: Mapping[str, float], interval: float, count: int, seed: int) -> Iterator[Array]:
    """Yield blocks of samples of a sum of noises, `count` samples in all blocks together.

    Parameters
    ----------
    values
        Sizes by name: ``white`` (u s^1/2), ``flicker`` (u), ``walk`` (u/s^1/2), ``quantisation`` (u s), ``gm1_sigma``,
        ``gm2_sigma`` (u), ``gm1_time``, ``gm2_time`` (s), ``ramp`` (u/s); u is the unit of the samples.
    interval
        Time between samples, s.
    count, seed
        Number of samples, and seed of the noise.

    Raises
    ------
    OptionError
        A name is unknown, a value is no number or negative, or a time constant is missing.

    Examples
    --------
    >>> blocks = simulated({"white": 0.1, "walk": 0.01}, 0.01, 300_000, seed=1)
    >>> [len(block) for block in blocks]
    [131072, 131072, 37856]
    """
    _check(values, interval, count)
    return _blocks({name: float(value) for name, value in values.items() if value}, interval, count, seed)


def _check(values: Mapping[str, float], interval: float, count: int) -> None:
    for name, value in values.items():
        if name not in TERMS:
            raise OptionError(f"noise term {name!r}: expected one of {listed(TERMS, name)}")
        if not math.isfinite(value) or (value < 0 and name != "ramp"):
            raise OptionError(f"noise term {name}: {value:g}; expected a size, zero or more")
    for k in (1, 2):
        if values.get(f"gm{k}_sigma", 0) and not values.get(f"gm{k}_time", 0):
            raise OptionError(f"noise term gm{k}_sigma: expected a time constant gm{k}_time with it, s")
    if not (interval > 0 and math.isfinite(interval)) or count < 1:
        raise OptionError(f"{count} samples every {interval:g} s: expected positive numbers")


def _blocks(values: Mapping[str, float], interval: float, count: int, seed: int) -> Iterator[Array]:
    from scipy.signal import lfilter

    rng = np.random.default_rng(seed)
    markov = [(values[f"gm{k}_sigma"] ** 2, values[f"gm{k}_time"]) for k in (1, 2) if f"gm{k}_sigma" in values]
    white = values.get("white", 0.0) ** 2 / interval
    if "flicker" in values:
        flicker = flicker_sum(interval, count)
        size = values["flicker"] ** 2
        markov += [(size * v, t) for v, t in zip(flicker.variance.tolist(), flicker.time.tolist(), strict=True)]
        white += size * flicker.white
    last = [math.sqrt(variance) * rng.standard_normal() for variance, _ in markov]
    walk, angle = 0.0, rng.standard_normal() if "quantisation" in values else 0.0
    for start in range(0, count, _BLOCK):
        n = min(_BLOCK, count - start)
        total = math.sqrt(white) * rng.standard_normal(n) if white else np.zeros(n)
        for k, (variance, time) in enumerate(markov):
            p = math.exp(-interval / time)
            driving = math.sqrt(-variance * math.expm1(-2 * interval / time)) * rng.standard_normal(n)
            part, _ = lfilter([1.0], [1.0, -p], driving, zi=[p * last[k]])
            last[k] = float(part[-1])
            total += part
        if "walk" in values:
            part = walk + values["walk"] * math.sqrt(interval) * np.cumsum(rng.standard_normal(n))
            walk = float(part[-1])
            total += part
        if "quantisation" in values:
            angles = np.concatenate([[angle], rng.standard_normal(n)])
            angle = float(angles[-1])
            total += values["quantisation"] / interval * np.diff(angles)
        if "ramp" in values:
            total += values["ramp"] * interval * (start + np.arange(n))
        yield total


def flicker_sum(interval: float, count: int) -> FlickerSum:
    """Return the Gauss-Markov processes that make 1/f noise of unit B over `count` samples.

    Their variances, none negative, fit the sum of their spectra to ``1/(2 |sin(w/2)|)`` from a third of the lowest
    frequency of the record, w = pi/n, up to half the sampling rate, within 0.05 %.

    Examples
    --------
    >>> sum_ = flicker_sum(0.01, 1_000_000)
    >>> len(sum_.time)
    20
    """
    from scipy.optimize import nnls

    steps = math.ceil(_PER_DECADE * math.log10(_LONGEST * count / _SHORTEST)) + 1
    time = np.geomspace(_SHORTEST, _LONGEST * max(count, 2), steps)
    w = np.geomspace(math.pi / count / 3, math.pi, 40 * steps)
    p = np.exp(-1 / time)[:, None]
    markov = -np.expm1(-2 / time)[:, None] / (np.expm1(-1 / time)[:, None] ** 2 + 4 * p * np.sin(w / 2) ** 2)
    relative = np.vstack([markov, np.ones_like(w)]) * 2 * np.sin(w / 2)
    scale = relative.max(axis=1)
    size = nnls((relative / scale[:, None]).T, np.ones_like(w))[0] / scale
    used = size[:-1] > 0
    return FlickerSum(time[used] * interval, size[:-1][used], float(size[-1]))

"""Recordings at rest while the temperature drifts: what knocks leave of them, and how far their direction wanders.

A bench that is knocked or walked around tips a little each time and does not tip back, so that the error of the
direction is a random walk. Beside what is smooth in the temperature, polynomials of degree 8, and a part that is new in
each hold, its size follows by restricted maximum likelihood (Patterson and Thompson, Biometrika 58 (1971) 545).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.ranked import MAD_TO_SIGMA
from imulab.recording import Array

_FEW, _TURNED = 0.005, 0.1
"""A recording whose outputs but for a few move by less than this share of g is one at rest."""
_BLOCK, _SHAKEN, _OFF, _BESIDE = 0.5, 4.0, 8.0, 5
"""A knock: blocks (s) that scatter with so many times the usual variance, or lie so many standard deviations off the
median of those beside, so many on each side."""
_LEAST_BLOCK, _MOSTLY = 8, 0.5
"""Samples of a block, and share of the time that knocks leave of a recording at rest."""
_SMOOTH = 8
_SURE = 5.0
"""Twice the logarithm of a likelihood ratio, which chance exceeds in 1.3 % of ramps."""
_RATIOS = np.concatenate([[0.0], np.geomspace(1e-4, 1e4, 81)])


def stretches_at_rest(outputs: Array, time: Array) -> NDArray[np.int64] | None:
    """Return the stretches of a unit that rests throughout, rows (first, last + 1); None where it is turned.

    Knocks lie between them; a change of its direction does not end one.
    """
    still = _between_knocks(outputs, time)
    ends = np.quantile(outputs[still], [_FEW, 1 - _FEW], axis=0)
    if np.ptp(ends, axis=0).max() > _TURNED * np.linalg.norm(ends.mean(axis=0)):
        return None
    return np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8))).reshape(-1, 2)


def _between_knocks(outputs: Array, time: Array) -> NDArray[np.bool_]:
    """Return which samples lie in no knock, nor beside one, shape (n,); all, where little would be left."""
    every = np.ones(len(time), dtype=np.bool_)
    size = max(_LEAST_BLOCK, round(_BLOCK * (len(time) - 1) / (time[-1] - time[0])))
    count = len(time) // size
    if count < 4 * _BESIDE:
        return every
    blocks = outputs[: count * size].reshape(count, size, 3)
    mean, scatter = blocks.mean(axis=1), blocks.var(axis=1)
    padded = np.pad(mean, ((_BESIDE, _BESIDE), (0, 0)), "reflect")
    beside = np.lib.stride_tricks.sliding_window_view(padded, 2 * _BESIDE + 1, axis=0)
    off = np.abs(mean - np.median(beside, axis=-1))
    usual = np.maximum(np.median(scatter, axis=0), np.finfo(float).tiny)
    far = _OFF * np.maximum(MAD_TO_SIGMA * np.median(off, axis=0), np.sqrt(usual / size))
    bad = ((scatter / usual).mean(axis=1) > _SHAKEN) | (off > far).any(axis=1)
    bad = np.convolve(bad, np.ones(3), "same") > 0.5
    still = np.append(np.repeat(~bad, size), np.full(len(time) - count * size, not bad[-1]))
    return still if still.mean() > _MOSTLY else every


def wandering(direction: Array, temperature: Array, time: Array) -> float:
    """Return the variance per second of the random walk of a direction, rad^2/s, 0 where none is significant.

    Parameters
    ----------
    direction
        Mean outputs of holds that were not moved between, in units of their length, shape (n, 3).
    temperature, time
        Of each hold, shape (n,).
    """
    count = len(direction)
    if count < 2 * _SMOOTH:
        return 0.0
    up = direction.mean(axis=0)
    across = np.linalg.svd(up[None])[2][1:]
    place = (temperature - temperature.mean()) / max(float(np.ptp(temperature)), 1e-9)
    smooth = np.polynomial.legendre.legvander(2 * place, _SMOOTH)
    free = np.linalg.svd(smooth, full_matrices=True)[0][:, _SMOOTH + 1 :]
    begun = time - time.min()
    sizes, modes = np.linalg.eigh(free.T @ np.minimum(begun[:, None], begun) @ free)
    squares = ((modes.T @ free.T @ direction @ across.T) ** 2).sum(axis=1)
    # Variances c (1 + r s) of two components each: c has its most likely value at every ratio r.
    unit = float(np.median(sizes))
    relative = 1 + _RATIOS[:, None] * np.maximum(sizes, 0.0) / unit
    level = (squares / relative).mean(axis=1) / 2
    likelihood = -2 * (len(sizes) * np.log(level) + np.log(relative).sum(axis=1))
    best = int(np.argmax(likelihood))
    if likelihood[best] - likelihood[0] < _SURE:
        return 0.0
    return float(level[best] * _RATIOS[best] / unit)

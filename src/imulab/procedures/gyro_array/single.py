"""What a comparison compares with: the gyros of an array that work, and the least noise of any fixed weights."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from imulab.procedures.gyro_array.health import EXCLUDED, JUMPED, NON_FINITE, STUCK
from imulab.procedures.gyro_array.model import fixed_weights
from imulab.recording import Array

_IN_USE = 0.5
_FEWEST = 2


@dataclass(frozen=True)
class Singles:
    """The gyros of one axis on their own.

    Attributes
    ----------
    working
        Whether each gyro counts, shape (n,): never stuck nor jumped, finite and in use under `robust` in half of the
        samples or more.
    noise
        Mean over these of the standard deviation of the rate error, in the samples in which each was in use.
    limit
        (1' C^-1 1)^-1/2, C the covariance of the noise from sample to sample of all gyros that are in use in half of
        the samples or more; 0 where it is unknown.
    middle
        The gyro with the median noise.
    """

    working: np.ndarray
    noise: float
    limit: float
    middle: int


def single_gyros(error: Array, flags: np.ndarray | None) -> Singles:
    """Return what the gyros of one axis do on their own.

    A gyro that failed says nothing of what fusing buys: the mean of all would be the size of the fault. Where none
    works, or health is not known, every gyro with a finite reading counts.

    Parameters
    ----------
    error
        Readings less the truth, shape (m, n).
    flags
        Health under `robust`, shape (m, n), or None.
    """
    used: np.ndarray = np.isfinite(error)
    if flags is not None:
        used = used & ((flags & (NON_FINITE | EXCLUDED)) == 0)
    there: np.ndarray = np.mean(used, axis=0) >= _IN_USE
    working = there.copy()
    if flags is not None:
        working &= ((flags & (STUCK | JUMPED)) == 0).all(axis=0)
    if not working.any():
        used = np.isfinite(error)
        there = working = np.any(used, axis=0)
    noise = np.full(len(working), np.nan)
    for i in np.flatnonzero(working):
        noise[i] = error[used[:, i], i].std()
    order = [int(i) for i in np.argsort(noise) if working[i]]
    return Singles(
        working=working,
        noise=float(np.mean(noise[working])) if working.any() else 0.0,
        limit=_limit(np.where(used, error, np.nan)[:, there]),
        middle=order[len(order) // 2] if order else 0,
    )


def _limit(error: Array) -> float:
    """Limit of errors with nan where a gyro was out of use, each pair over the samples that it shares."""
    step = np.diff(error, axis=0)
    known = np.isfinite(step)
    step = np.where(known, step, 0.0)
    shared = known.T.astype(np.float64) @ known
    covariance = step.T @ step / np.maximum(2 * shared, 1)
    live = np.diag(covariance) > 0
    if not live.any() or shared.min() < _FEWEST:
        return 0.0
    try:
        limit = fixed_weights(covariance[np.ix_(live, live)])[1]
    except np.linalg.LinAlgError:
        return 0.0
    return limit if math.isfinite(limit) else 0.0

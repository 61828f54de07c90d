"""Errors of whole turns that stops at the fence do not hold: a tilted axis, lost samples, and the Earth's rate.

Tilt (`tilt_shift`): the unit turns about an axis that lies ``t`` off a gyroscope's own, in the directions of the two
others. These see ``q_j = T_ji + t_j``, so that composed turns state ``1 + sum (q_j^2 - t_j^2) / 2 + T_ij t_j`` times
the scale factor. How q divides between misalignment and tilt is not seen: it is averaged over Student's t of either.
Units lie several times farther off than is stated more often than their sensors do, so that the tilt has one degree of
freedom (Cauchy), and T eight. T_ij is not seen at all.

Lost samples (`share_lost`): a share p of samples, lost at random, takes p off an angle and scatters it by
``p sum (w dt)^2``. Stops scatter neighbouring turns with opposite signs. Restricted likelihood weighs the two.

Earth (`bias_at_rest`): the mean at rest holds the Earth's rate, of which gravity and latitude tell the vertical part.

Sources: `restricted_log_likelihood`; GUM (JCGM 100:2008).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.estimation.least_squares import restricted_log_likelihood
from imulab.gravity import EARTH
from imulab.recording import Array

MISALIGNMENT = 0.01
"""Usual misalignment of a gyroscope, rad: data sheets of MEMS units state 1 % across the axes."""
_FREEDOM, _FREEDOM_OF_TILT = 8.0, 1.0
_SHARES = np.concatenate([[0.0], np.geomspace(1e-5, 0.1, 40)])
_STOPS = np.concatenate([[1.0], np.geomspace(1.5, 100.0, 12)])
"""Shares of samples that may be lost, and factors of the variance of stops, that are tried."""
LIKELY = 0.5  # probability from which lost samples are said
_LOSE, _STOP = 0.1, 0.05  # share beforehand of recordings that lose samples, and of stops worse than was stated


def tilt_shift(across: Array, tilt: float) -> tuple[float, float]:
    """Return what a composed turn states too much by tilt and misalignment, relative, and its standard uncertainty.

    Parameters
    ----------
    across
        Integrals of the two other gyroscopes over 2 pi times the turns, shape (2,).
    tilt
        Standard uncertainty of the axis of the turns in the body, about either axis, rad.
    """
    shift = variance = 0.0
    for q in across.tolist():
        t = np.linspace(-1, 1, 1601) * (abs(q) + 10 * tilt) if tilt else np.zeros(1)
        weight = (1 + ((q - t) / MISALIGNMENT) ** 2 / _FREEDOM) ** (-(_FREEDOM + 1) / 2)
        weight *= (1 + ((t / tilt) ** 2 if tilt else 0.0) / _FREEDOM_OF_TILT) ** (-(_FREEDOM_OF_TILT + 1) / 2)
        weight /= weight.sum()
        half = (q**2 - t**2) / 2
        mean = float(weight @ half)
        shift += mean
        unseen = MISALIGNMENT**2 * _FREEDOM / (_FREEDOM - 2)  # variance of T_ij
        variance += float(weight @ (half - mean) ** 2) + unseen * float(weight @ t**2)
    return shift, float(np.sqrt(variance))


def share_lost(angle: Array, turned: Array, stops: Array, zero: Array, square: Array) -> tuple[float, float]:
    """Return the root mean square share of lost samples, and the probability that any were lost.

    Parameters
    ----------
    angle, turned
        Stated and true angles of n turns, rad, shape (n,).
    stops, zero
        Covariance of the angles by stops, shape (n, n), and variances by the zero, shape (n,).
    square
        Sum of squares of the angles from sample to sample of each turn, rad^2, shape (n,).
    """
    if len(angle) < 3:
        return 0.0, 0.0
    share, wide = np.repeat(_SHARES, len(_STOPS)), np.tile(_STOPS, len(_SHARES))
    alone = (zero + share[:, None] * square)[:, :, None] * np.eye(len(angle))
    logs = restricted_log_likelihood(wide[:, None, None] * stops + alone, turned[:, None], angle)
    logs += np.log(np.where(share == 0, 1 - _LOSE, _LOSE / (len(_SHARES) - 1)))
    logs += np.log(np.where(wide == 1, 1 - _STOP, _STOP / (len(_STOPS) - 1)))
    weight = np.exp(logs - logs.max())
    weight /= weight.sum()
    return float(np.sqrt(weight @ share**2)), float(weight[share > 0].sum())


@dataclass(frozen=True)
class RestingBias:
    """Bias of each gyroscope by its means at rest, rad/s, shape (3,).

    Attributes
    ----------
    value, noise
        Mean, less what is known of the Earth's rate, and its standard uncertainty by the scatter of the rests.
    earth
        Standard uncertainty by what is not known of the Earth's rate.
    rests
        Number of rests.
    """

    value: Array
    noise: Array
    earth: Array
    rests: int


def bias_at_rest(zeros: Array, force: Array | None, upright: Array, latitude: float | None) -> RestingBias:
    """Return the bias by the means of n rests; rests of one attitude face one way, and share the Earth's rate.

    Parameters
    ----------
    zeros
        Mean outputs at rest, rad/s, shape (n, 3).
    force
        Mean specific force at rest, shape (n, 3); None where it is not known.
    upright
        Axis that is upright at each rest by the turns beside it, or -1, shape (n,); used without `force`.
    latitude
        Latitude, rad; None where it is not known.
    """
    count = len(zeros)
    if force is None:
        up = np.where(upright[:, None] == np.arange(3), 1.0, 0.0)
        attitude = upright
    else:
        up = force / np.maximum(np.linalg.norm(force, axis=1), 1e-300)[:, None]
        axis = np.argmax(np.abs(up), axis=1)
        attitude = axis + 3 * (up[np.arange(count), axis] < 0)
    vertical, level = (0.0, 0.0) if latitude is None else (EARTH * np.sin(latitude), EARTH * np.cos(latitude))
    known = vertical * up if force is not None else np.zeros((count, 3))
    unknown = level**2 / 2 * (1 - up**2) + (0.0 if force is not None else (vertical * up) ** 2)
    nothing_known = (attitude[:, None] < 0) | (latitude is None)
    unknown = np.where(nothing_known, EARTH**2 / 3, unknown)
    shared = np.zeros(3)
    for which in (attitude == each for each in np.unique(attitude)):
        shared += (which.sum() / count) ** 2 * unknown[which].mean(axis=0)
    left = zeros - known
    return RestingBias(left.mean(axis=0), left.std(axis=0, ddof=1) / np.sqrt(count), np.sqrt(shared), count)

"""Nested models blended: what their estimates say together, whichever of them is right.

A model chosen from the data states an uncertainty as if it were right. Here each step from a model to the next larger
one is shrunk by the share of it that is likely to be noise, and that share's own uncertainty is part of the covariance.

Source: a normal prior of unknown variance for the terms of each step, with a Beta(b, 1) distribution of the share
(Strawderman, Annals of Mathematical Statistics 42 (1971) 385); limit for every such method: Pratt, Journal of the
American Statistical Association 56 (1961) 549.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from imulab.recording import Array

_MIDPOINTS = 160
_ROOTS = (np.arange(_MIDPOINTS) + 0.5) / _MIDPOINTS
_SHARES = _ROOTS**3
"""Midpoints in the cube root: a large gain leaves shares far below 1 / 160."""
_WIDER = 1.3
"""Calibrated by simulation: without it intervals of tumble's biases cover 88 %, with it 93 %."""


@dataclass(frozen=True)
class Blend:
    """What nested models say together.

    Attributes
    ----------
    values, covariance
        Shapes (p,), (p, p).
    noise
        Share of each step that is noise, shape (m - 1,).
    """

    values: Array
    covariance: Array
    noise: Array

    def about(self, chosen: Array) -> Array:
        """Return the covariance of other values, shape (p,): ``V + (chosen - theta)(chosen - theta)'``."""
        away = chosen - self.values
        return np.asarray(self.covariance + np.outer(away, away))


def blend(
    values: Array, covariances: Array, gains: ArrayLike, added: ArrayLike, *, scale: float = 1.0,
    freedom: float | None = None, prior: float = 0.5,
) -> Blend:  # fmt: skip
    """Blend m nested models, the smallest first.

    ``theta = theta_1 + sum (1 - kappa_e) d_e``, ``d_e = theta_e - theta_(e-1)``;
    ``V = s^2 V_1 + 1.3 sum [(1 - kappa_e) s^2 (V_e - V_(e-1)) + var(kappa_e) d_e d_e']``, kappa_e as in `noise_share`.

    Parameters
    ----------
    values
        Estimates of each model, terms that it lacks as zero, shape (m, p).
    covariances
        For observations whose variance is the stated one, ``(J' W J)^-1`` padded with zeros, shape (m, p, p).
    gains
        What chi-square loses with each step, shape (m - 1,).
    added
        How many terms each step adds, shape (m - 1,).
    scale
        s^2, variance of the observations over the stated one.
    freedom
        Degrees of freedom from which `scale` was estimated, or None where it is known.
    prior
        b of `noise_share`: 1/2 for steps of three terms; 0 for steps of one, whose gain says less.
    """
    kept, spread = noise_share(np.asarray(gains) / scale, added, freedom, prior)
    steps = np.diff(values, axis=0)
    total = values[0] + np.einsum("e,ep->p", 1 - kept, steps)
    growth = scale * np.einsum("e,epq->pq", 1 - kept, np.diff(covariances, axis=0))
    growth += np.einsum("e,ep,eq->pq", spread, steps, steps)
    return Blend(total, scale * covariances[0] + _WIDER * growth, kept)


def noise_share(
    gains: ArrayLike, added: ArrayLike, freedom: float | None = None, prior: float = 0.5
) -> tuple[Array, Array]:
    """Return mean and variance of the share of a step that is noise, from its gain in chi-square.

    The density of kappa on (0, 1) is proportional to ``kappa^(d / 2 + b - 1) exp(-kappa q / 2)``, with the noise
    estimated from nu degrees of freedom to ``kappa^(d / 2 + b - 1) (1 + kappa q / nu)^(-(nu + d) / 2)``, for a step of
    d terms and the gain q.

    Parameters
    ----------
    gains
        q, of any shape (n,).
    added
        d, broadcast.
    freedom
        nu, or None where the noise is known.
    prior
        b: before the data, the share is distributed as Beta(b, 1).
    """
    q = np.maximum(np.asarray(gains, dtype=np.float64), 0.0)[..., None]
    d = np.asarray(added, dtype=np.float64)[..., None]
    logarithm = (d / 2 + prior - 1) * np.log(_SHARES) + 2 * np.log(_ROOTS)
    if freedom is None:
        logarithm = logarithm - _SHARES * q / 2
    else:
        logarithm = logarithm - (freedom + d) / 2 * np.log1p(_SHARES * q / freedom)
    weight = np.exp(logarithm - logarithm.max(axis=-1, keepdims=True))
    weight /= weight.sum(axis=-1, keepdims=True)
    mean = (weight * _SHARES).sum(axis=-1)
    return mean, (weight * (_SHARES - mean[..., None]) ** 2).sum(axis=-1)

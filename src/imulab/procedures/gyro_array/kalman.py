"""Gain of the virtual gyro: a rate that walks, and a bias of each gyro that walks.

Source: Bayard and Ploen, US patent 6882964 (2003). The bias that all gyros share cannot be told from the rate, so the
biases are kept to a sum that does not change; what is left is observable and has one steady-state gain.
"""

from __future__ import annotations

import math

import numpy as np

from imulab.estimation.ranked import MAD_TO_SIGMA
from imulab.recording import Array

RATE_WALK = math.radians(1.4)
"""Default process noise, rad/s/sqrt(s): follows 12.5 deg/s at 0.1 Hz, sampled at 50 Hz, without a visible lag."""
_BIAS_WALK = 0.004
_LOWEST = 0.05


def steady_gain(white: Array, walk: Array, rate_walk: float, step: float) -> Array:
    """Return the steady-state gain of the state (rate, bias_1 .. bias_n), shape (n + 1, n).

    ``x' = x + (q, V c) sqrt(step)``, ``z = x_0 + b + white``; V spans the vectors of sum 0, from the discrete Riccati
    equation in (rate, c).

    Parameters
    ----------
    white
        Standard deviation of one sample, shape (n,).
    walk
        Rate random walk of each gyro, per sqrt(s), shape (n,).
    rate_walk
        Walk of the true rate, per sqrt(s).
    step
        Time between samples, s.
    """
    from scipy.linalg import solve_discrete_are

    n = len(white)
    basis = np.linalg.qr(np.column_stack([np.ones(n), np.eye(n)[:, : n - 1]]))[0][:, 1:]
    size = float(np.mean(white**2))
    h = np.column_stack([np.ones(n), basis])
    q = np.zeros((n, n))
    q[0, 0] = rate_walk**2 * step / size
    q[1:, 1:] = basis.T @ np.diag(walk**2) @ basis * step / size
    q[1:, 1:] += 1e-12 * np.eye(n - 1)
    r = np.diag(white**2) / size
    ahead = solve_discrete_are(np.eye(n), h.T, q, r)
    gain = ahead @ h.T @ np.linalg.inv(h @ ahead @ h.T + r)
    full: Array = np.vstack([gain[:1], basis @ gain[1:]])
    return full


def noise_about_mean(readings: Array) -> Array:
    """Standard deviation of each gyro's noise from its residuals about the array mean, shape (axes, n).

    ``var_i = n / (n - 2) [m_i - sum_j m_j / (n (n - 1))]``, m_i the variance of the residual (the N-cornered hat); not
    below 5 % of the mean variance. Rows with readings that are not finite are left out; ones where nothing is left.
    """
    _, axes, n = readings.shape
    found = np.ones((axes, n))
    for a in range(axes):
        rows = readings[np.isfinite(readings[:, a]).all(axis=1), a]
        if n < 3 or len(rows) < 50:
            continue
        residual = rows - rows.mean(axis=1, keepdims=True)
        # Successive differences: a scale factor that differs shows in motion, but hardly from sample to sample.
        # The median of their size, so that spikes do not count.
        m = (MAD_TO_SIGMA * np.median(np.abs(np.diff(residual, axis=0)), axis=0)) ** 2 / 2
        variance = n / (n - 2) * (m - m.sum() / (n * (n - 1)))
        if variance.mean() > 0:
            found[a] = np.sqrt(np.maximum(variance, _LOWEST * variance.mean()))
    return found


def default_bias_walk(white: Array) -> Array:
    """Rate random walk where no record states one: 0.4 % of a sample's noise per sqrt(s)."""
    return _BIAS_WALK * white

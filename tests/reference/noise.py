"""Noises by their covariance matrices, and drawn in the time domain: nothing here knows of cosine coefficients."""

import numpy as np
from scipy.linalg import toeplitz
from scipy.signal import fftconvolve, lfilter


def covariance(term, n, dt, time=1.0):
    """Covariance of n samples of a unit term; of 1/f noise and walk that of their differences, which is enough."""
    lag = np.arange(n)
    if term == "N":
        return np.eye(n) / dt
    if term == "K":
        return np.minimum.outer(lag, lag) * dt
    if term == "Q":
        return toeplitz(np.r_[2.0, -1.0, np.zeros(n - 2)]) / dt**2
    if term == "G":
        return toeplitz(np.exp(-lag * dt / time))
    # 1/f: spectrum 1/(2 |sin w/2|); E (x_i - x_{i+k})^2 = (1/2 pi) int 2 (1 - cos k w)/(2 |sin w/2|) dw
    return toeplitz(-2 / np.pi * np.r_[0.0, np.cumsum(1 / (2 * lag[1:] - 1))])


def mean_weights(n, start, count):
    weights = np.zeros(n)
    weights[start : start + count] = 1 / count
    return weights


def allan_weights(n, count):
    return (mean_weights(n, count, count) - mean_weights(n, 0, count)) / np.sqrt(2)


def draw(rng, terms, n, dt, burn=0):
    """Samples of a sum of noises, shape (n,): terms map a letter to its size, G to (S, T) or a list of these."""
    total = np.zeros(n)
    for term, size in terms.items():
        if term == "N":
            total += size / np.sqrt(dt) * rng.standard_normal(n)
        elif term == "K":
            total += size * np.sqrt(dt) * np.cumsum(rng.standard_normal(n))
        elif term == "Q":
            total += size / dt * np.diff(rng.standard_normal(n + 1))
        elif term == "G":
            for sigma, time in size if isinstance(size, list) else [size]:
                p = np.exp(-dt / time)
                steps = sigma * np.sqrt(1 - p * p) * rng.standard_normal(n)
                steps[0] = sigma * rng.standard_normal()
                total += lfilter([1.0], [1.0, -p], steps)
        elif term == "B":  # half an integration of white noise, long before the record
            before = burn or 4 * n
            k = np.arange(1, n + before)
            response = np.cumprod(np.r_[1.0, (k - 0.5) / k])
            total += size * fftconvolve(rng.standard_normal(n + before), response)[before : n + before]
    return total


def filtered_angle(rng, rates, dt, white, walk, aided):
    """Errors of the angle of a filter of angle and bias, and its own variance of them, after aiding has ended.

    rates: errors of a gyro, shape (trials, n); white, walk: what the filter is told; the angle is measured at the first
    `aided` samples, with 0.3 of the white noise of a sample. Textbook discretisation of d(angle) = -bias + white.
    """
    measured = (0.3 * white) ** 2 * dt
    step = np.array([[1.0, -dt], [0.0, 1.0]])
    noise = np.array(
        [[white**2 * dt + walk**2 * dt**3 / 3, -(walk**2) * dt**2 / 2], [-(walk**2) * dt**2 / 2, walk**2 * dt]]
    )
    state, covariance = np.zeros((2, len(rates))), np.diag([measured, 100 * white**2 / dt])
    for index, rate in enumerate(rates.T):
        state = step @ state
        state[0] += rate * dt
        covariance = step @ covariance @ step.T + noise
        if index < aided:
            gain = covariance[:, 0] / (covariance[0, 0] + measured)
            seen = np.sqrt(measured) * rng.standard_normal(len(rates))
            state = state + np.outer(gain, seen - state[0])
            covariance = covariance - np.outer(gain, covariance[0])
    return state[0], covariance[0, 0]

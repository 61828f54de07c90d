"""Lines in the spectrum of a sensor at rest: mains, motors, aliases of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from imulab.recording import Array

_FIRST, _WIDTH, _GROWTH = 16, 16, 1.25
"""First bin that is searched, bins of a block at least, and how blocks widen: noise is level over a block."""
_FALSE_ALARM = 1e-3  # of a spectrum without lines
_SKIRT = 2  # bins
_LEAST_POWER = 1e-3  # of the samples' variance, all lines together


@dataclass(frozen=True)
class Lines:
    """Spectral lines, the largest first, and what is left of the samples without them.

    Attributes
    ----------
    frequency
        Hz, shape (k,).
    amplitude
        Of the sine, in the unit of the samples, shape (k,).
    samples
        The samples with the lines brought down to the noise beside them, shape (n,); as they were where k = 0.
    """

    frequency: Array
    amplitude: Array
    samples: Array


def spectral_lines(samples: Array, rate: float) -> Lines:
    """Find the lines of a spectrum that rise from the noise beside them, and take them out.

    In noise the power of a bin is exponential about its mean. A line is a bin beyond ``ln(n / 0.001)`` times the mean
    that the median of its block gives; its neighbours belong to it.

    Parameters
    ----------
    samples
        Evenly spaced, shape (n,).
    rate
        Sampling rate, Hz.
    """
    count = len(samples)
    spectrum = np.fft.rfft(samples - samples.mean())
    power = spectrum.real**2 + spectrum.imag**2
    level = np.full(len(power), np.inf)
    start = _FIRST
    while start + _WIDTH <= len(power):
        stop = max(start + _WIDTH, int(_GROWTH * start))
        stop = len(power) if stop + _WIDTH > len(power) else stop
        level[start:stop] = np.median(power[start:stop]) / math.log(2)
        start = stop
    above = np.flatnonzero(power > math.log(count / _FALSE_ALARM) * level)
    none = np.empty(0)
    if not above.size or power[above].sum() < _LEAST_POWER * power.sum():
        return Lines(none, none, samples)
    groups = np.split(above, np.flatnonzero(np.diff(above) > 2 * _SKIRT) + 1)
    frequency, amplitude = [], []
    for group in groups:
        span = slice(max(group[0] - _SKIRT, _FIRST), group[-1] + _SKIRT + 1)
        size = np.sqrt(power[span])
        frequency.append(float(group[np.argmax(power[group])]) * rate / count)
        amplitude.append(2 * math.sqrt(float(power[span].sum())) / count)
        spectrum[span] *= np.minimum(np.sqrt(level[span]) / np.maximum(size, 1e-300), 1.0)
    order = np.argsort(amplitude)[::-1]
    left = np.fft.irfft(spectrum, count) + samples.mean()
    return Lines(np.array(frequency)[order], np.array(amplitude)[order], left)

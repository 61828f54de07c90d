"""Up to which frequency a noise model is held against a spectrum, and how exactly: no spectrum is quite the model's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.noise.cosine import frequencies
from imulab.estimation.noise.spectrum import Spectrum
from imulab.recording import Array

_AGREE, _SIGMAS, _SHARP = 0.03, 3.0, 0.2
"""How far two octaves may be apart, beyond so many sigma; up to where these sigma tell of an agreement at all."""
_FULL, _NEARLY_FULL = 0.999, 0.24
_MANY, _FEWEST = 200, 16
"""Coefficients of a bin that tells the ripple; such bins that are needed to tell it."""
_OFF_SIGMAS, _OFF = 5.0, 0.10
_BOUND, _EXPECTED = 6.635, 0.9819
"""Of the squared deviation of a bin in terms of its variance: at most so much counts, and what is then expected."""


@dataclass(frozen=True)
class Band:
    """The usable band of a spectrum.

    Attributes
    ----------
    highest
        f_max, Hz: half the sampling rate where the band is full.
    full
        Whether that is the whole band of the samples.
    flat
        Whether there is white noise at its end: where no two octaves agree, the band is full and this is False.
    roll_off
        Relative standard uncertainty of N from what may be left of a filter's roll-off.
    """

    highest: float
    full: bool
    flat: bool = True
    roll_off: float = field(default=0.0, compare=False)

    def filtered(self, interval: float) -> bool:
        """Return whether it ends below a sensor's filter; at a quarter of the sampling rate it does where none is."""
        return self.flat and self.highest * interval < _NEARLY_FULL


def usable_band(spectra: Sequence[Spectrum]) -> Band:
    """Return the band whose two highest octaves agree: f_max is halved from half the rate until they do, and once more.

    They agree within 3 % + 3 sigma. Of these 3 % a long record makes a term of its own, and N comes out too small: so
    the band ends an octave lower, unless 3 sigma are more than 20 %. Quantisation of an angle rises with frequency:
    where white noise and quantisation together, ``a + b s^2``, bring the three highest octaves to agreement, or the
    highest octave is plainly above the next, the band is full.
    """
    nyquist = 0.5 / spectra[0].interval
    f, p, d = (np.concatenate(each) for each in zip(*((frequencies(s), s.power, s.freedom) for s in spectra)))  # noqa: B905
    highest = nyquist
    if not _same_level(f, p, d, highest, 2) and _rising(f, p, d, nyquist):
        return Band(nyquist, True)
    while highest == nyquist or d[f <= highest / 4].sum() > _MANY:
        if _same_level(f, p, d, highest, 2):
            far, u = _apart(f, p, d, highest, 2)
            full = highest > _FULL * nyquist
            if _SIGMAS * u[0] > _SHARP or (full and far[0] < -_SIGMAS * u[0]):
                # One of first order takes 0.76 of what these octaves are apart from the band, and N half of that.
                left = 0.0 if full else 0.38 * float(max(far[0], 0.0) + u[0]) / math.sqrt(3)
                return Band(highest, full, roll_off=left)
            # One of first order leaves a quarter of it an octave lower, and N has half of that at most.
            return Band(highest / 2, False, roll_off=float(_AGREE + _SIGMAS * u[0]) / 8 / math.sqrt(3))
        highest /= 2
    return Band(nyquist, True, False)


def _same_level(f: Array, p: Array, d: Array, highest: float, octaves: int) -> bool:
    """Whether the highest octaves have the same level, each against the highest."""
    far, u = _apart(f, p, d, highest, octaves)
    return bool((np.abs(far) <= _AGREE + _SIGMAS * u).all())


def _apart(f: Array, p: Array, d: Array, highest: float, octaves: int) -> tuple[Array, Array]:
    """Logarithms of the levels of octaves in terms of the highest one, and their uncertainties; inf where one is 0."""
    level, freedom = [], []
    for k in range(octaves):
        inside = (f <= highest / 2**k * (1 + 1e-9)) & (f > highest / 2 ** (k + 1)) & (d > 0)
        freedom.append(float(d[inside].sum()))
        level.append(float((p * d)[inside].sum()) / max(freedom[-1], 1.0))
    if min(freedom) <= 0 or min(level) <= 0:
        return np.full(octaves - 1, np.inf), np.zeros(octaves - 1)
    u = np.sqrt(2 / np.array(freedom[1:]) + 2 / freedom[0])
    return np.asarray(np.log(np.array(level[1:]) / level[0])), np.asarray(u)


def _rising(f: Array, p: Array, d: Array, nyquist: float) -> bool:
    """Whether white noise and quantisation of an angle explain the three highest octaves."""
    top = (f > nyquist / 8) & (d > 0) & (p > 0)
    square = 4 * np.sin(np.pi / 2 * f[top] / nyquist) ** 2
    root = np.sqrt(d[top]) / p[top]
    a, b = np.linalg.lstsq(np.column_stack([root, root * square]), root * p[top])[0]
    if b <= 0 or a <= 0:
        return False
    return _same_level(f[top], p[top] / (a + b * square), d[top], nyquist, 3)


def within(spectrum: Spectrum, highest: float) -> Spectrum:
    """Return a spectrum whose bins beyond a frequency, Hz, count nothing."""
    inside = spectrum.last / (2 * spectrum.length) <= highest * (1 + 1e-9)
    return replace(spectrum, freedom=np.where(inside, spectrum.freedom, 0.0))


@dataclass(frozen=True)
class Allowance:
    """What a spectrum may be off its model, and where it is farther off.

    Attributes
    ----------
    ripple
        eps, the relative standard deviation of the level of bins beyond their scatter.
    spectra
        With the freedom that this leaves, and nothing for the bins that are off.
    off
        Lowest and highest frequency of each run of bins that were left out, Hz, and by which factor they are off.
    """

    ripple: float
    spectra: tuple[Spectrum, ...]
    off: tuple[tuple[float, float, float], ...]


def allow(spectra: Sequence[Spectrum], variances: Sequence[Array]) -> Allowance:
    """Return spectra that count no more than they agree with the variances of a model in their bins, shapes (b,).

    ``eps^2`` is the variance of ``ln(P/lambda)`` beyond 2/d over bins with d > 200, by maximum likelihood with bounded
    influence: the bins that count most decide, where a median over all bins would find ripple of 1 to 4 % in noise that
    has none. d becomes ``d/(1 + d eps^2/2)``. Bins that are then off by 5 sigma and 10 % are left out.
    """
    logarithm = [
        np.log(np.maximum(s.power, 1e-300) / v) + 1 / np.maximum(s.freedom, 1)
        for s, v in zip(spectra, variances, strict=True)
    ]
    log = np.concatenate(logarithm)
    freedom = np.concatenate([s.freedom for s in spectra])
    ripple = _ripple(log, freedom)
    far = _far_bins(log, freedom, ripple)
    ripple = _ripple(log[~far], freedom[~far])  # what is left out is no ripple
    far = _far_bins(log, freedom, ripple)
    edges = np.cumsum([len(s.power) for s in spectra])[:-1]
    parts, off = [], []
    for spectrum, part, out in zip(spectra, logarithm, np.split(far, edges), strict=True):
        left = spectrum.freedom / (1 + spectrum.freedom * ripple**2 / 2)
        parts.append(replace(spectrum, freedom=np.where(out, 0.0, left)))
        runs = np.flatnonzero(np.diff(np.concatenate([[0], out.astype(int), [0]]))).reshape(-1, 2)
        for start, stop in runs.tolist():
            low, high = (each / (2 * spectrum.length) for each in (spectrum.first[start], spectrum.last[stop - 1]))
            off.append((float(low), float(high), float(np.exp(part[start:stop].mean()))))
    return Allowance(ripple, tuple(parts), tuple(off))


def _far_bins(logarithm: Array, freedom: Array, ripple: float) -> NDArray[np.bool_]:
    """Which bins are off by 5 sigma and 10 %, the ripple allowed for."""
    u = np.sqrt(2 / np.maximum(freedom, 1) + ripple**2)
    size = np.abs(logarithm)
    return np.asarray((freedom > _FEWEST) & (size > np.log1p(_OFF)) & (size > _OFF_SIGMAS * u))


def _ripple(logarithm: Array, freedom: Array) -> float:
    """Scatter of the levels of bins beyond what their numbers of coefficients explain."""
    many = freedom > _MANY
    if np.count_nonzero(many) < _FEWEST:
        return 0.0
    square, chance = logarithm[many] ** 2, 2 / freedom[many]

    def beyond(eps: float) -> float:
        spread = chance + eps**2
        return float(np.sum((np.minimum(square / spread, _BOUND) - _EXPECTED) / spread))

    if beyond(0.0) <= 0:
        return 0.0
    low, high = 0.0, float(np.sqrt(square.max()))
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if beyond(middle) > 0 else (low, middle)
    return high

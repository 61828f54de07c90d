"""Truths of noise, spectra drawn from them, and their fits: shared by the tests of noise models."""

import numpy as np
from scipy.fft import dct

from imulab.estimation.noise.likelihood import fit, profile, time_limits
from imulab.estimation.noise.spectrum import Spectrum, bins
from imulab.estimation.noise.terms import NAMES, prepare, terms


def values(**sizes):
    return np.array([sizes.get(name, 0.0) for name in NAMES])


def unit(letter, time=1.0):
    return values(gm1_sigma=1.0, gm1_time=time) if letter == "G" else np.where(terms(letter), 1.0, 0.0)


def empty(count, interval, each=False):
    first, last = (np.arange(1, count),) * 2 if each else bins(count)
    return Spectrum(interval, count, first, last, np.ones(len(first)), (last - first + 1).astype(float))


def drawn(rng, spectrum, truth, trials):
    """Mean squares as the model has them: chi-square variables about the variances, shape (trials, b)."""
    lam = prepare([spectrum]).variances(truth[None])[0]
    return lam * rng.chisquare(spectrum.freedom, (trials, len(lam))) / spectrum.freedom


def transformed(samples, spectrum):
    """Mean squares of the coefficients of samples, shape (t, n)."""
    squares = dct(samples, norm="ortho", axis=-1)[..., 1:] ** 2
    return np.add.reduceat(squares, spectrum.first - 1, axis=-1) / spectrum.freedom


LONG = empty(100_000, 0.1)
CORNER = 1 / np.sqrt(2 * np.log(2) / np.pi)
TRUTHS = {
    "N K": values(white=1, walk=np.sqrt(3) / 100),
    "N K, corner at L/10": values(white=1, walk=np.sqrt(3) / 1000),
    "N B": values(white=1, flicker=CORNER / np.sqrt(30)),
    "N B K": values(white=1, flicker=CORNER / np.sqrt(30), walk=np.sqrt(3) / 200),
    "N K Q": values(white=1, walk=np.sqrt(3) / 100, quantisation=0.3),
    "N G, T = 100 s": values(white=1, gm1_sigma=np.sqrt(0.1), gm1_time=100),
    "N G, T = 1000 s": values(white=1, gm1_sigma=0.1, gm1_time=1000),
}
"""White noise of 1; corners at 100 or 1000 s with a walk, 30 s with 1/f; a Gauss-Markov density of 20 at 0."""
AUTO = {
    "N": values(white=1),
    "N B, corner at 3 s": values(white=1, flicker=CORNER / np.sqrt(3)),
    "N G, T = 3 s": values(white=1, gm1_sigma=np.sqrt(10 / 3), gm1_time=3),
    **TRUTHS,
}
IN_TIME = {
    "N K": {"N": 1, "K": np.sqrt(3) / 100},
    "N B": {"N": 1, "B": CORNER / np.sqrt(30)},
    "N B, corner at 3 s": {"N": 1, "B": CORNER / np.sqrt(3)},
    "N G, T = 3 s": {"N": 1, "G": (np.sqrt(10 / 3), 3)},
    "N B K": {"N": 1, "B": CORNER / np.sqrt(30), "K": np.sqrt(3) / 200},
    "N G, T = 100 s": {"N": 1, "G": (np.sqrt(0.1), 100)},
}
"""The truths of the same names, for drawing in the time domain."""


def intervals(truth, power):
    has = np.broadcast_to(truth > 0, (len(power), len(NAMES)))
    freedom = np.broadcast_to(LONG.freedom, power.shape)
    frame, limits = prepare([LONG]), time_limits([LONG])
    found = fit(frame, has[:1], limits, power, freedom)
    return found, *profile(frame, found.values, has, limits, power, freedom)

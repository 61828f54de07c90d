"""Response of a method of fusion to a small white probe that all gyros see."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from imulab.estimation.ranked import MAD_TO_SIGMA
from imulab.procedures.gyro_array.fuse import FuseOptions, open_stream
from imulab.procedures.gyro_array.model import Elements, array_calibration
from imulab.recording import Array
from imulab.records.calibration import Calibration

_PROBE_SAMPLES = 16_384
_SEGMENT = 256
_HALF_POWER = math.sqrt(0.5)
_FROZEN, _UNUSUAL = 0.5, 20.0  # s; times as long as usual
_FOLLOWED = 0.95
_FEWEST_PAIRS = 4


@dataclass(frozen=True)
class Response:
    """Bandwidth, Hz, at -3 dB (half the sampling rate where nothing is filtered), and gain for slow motion.

    `gain_uncertainty` is the standard uncertainty of the gain, `blind` the gyros that do not move.
    """

    bandwidth: float
    gain: float
    gain_uncertainty: float
    blind: tuple[str, ...] = ()


def responses(
    readings: Array, elements: Elements, options: FuseOptions, record: Calibration | None, rate: float
) -> list[Response]:
    """Return the response of each axis.

    The method runs twice, with and without the probe: |S_pr| / S_pp of probe p and response r (Welch, windowed halves
    that overlap). The probe is as large as the gyros' noise. A gyro does not see it while it repeats itself for longer
    than the steps of its output make it (`_frozen`), as a dead gyro sees no motion.

    Parameters
    ----------
    readings
        As logged, shape (m, axes, n); the first 16,384 samples are used.
    record
        The calibration in `options`, where there is one: the probe goes through the elements' matrices.
    """
    readings = readings[:_PROBE_SAMPLES]
    step = np.diff(readings, axis=0)
    rng = np.random.default_rng(0)
    probe = rng.standard_normal(readings.shape[:2]) * _noise(step)
    seen = np.repeat(probe[:, :, None], elements.count, axis=2)
    if record is not None:
        matrices = array_calibration(record, elements).matrices
        if matrices is not None:
            seen = np.einsum("nab,mb->man", np.linalg.inv(matrices), probe)
    frozen = _frozen(step, rate)
    seen[frozen] = 0.0
    plain, shaken = (
        open_stream(options, elements, rate, readings).process(np.ascontiguousarray(part)).rate
        for part in (readings, readings + seen)
    )
    response = shaken - plain
    skip = len(response) // 4
    found = []
    for a in range(len(elements.axes)):
        gain, uncertainty = _transfer(probe[skip:, a], np.nan_to_num(response[skip:, a]))
        frequency = np.linspace(0, rate / 2, len(gain))
        below = np.flatnonzero(gain[1:] < _HALF_POWER)
        edge = rate / 2
        if below.size:
            k = int(below[0]) + 1
            high, low = gain[k - 1], gain[k]
            share = (high - _HALF_POWER) / (high - low) if high > _HALF_POWER else 0.0
            edge = float(frequency[k - 1] + share * (frequency[k] - frequency[k - 1]))
        blind = tuple(name for i, name in enumerate(elements.names[a]) if frozen[:, a, i].mean() > 1 - _FOLLOWED)
        found.append(Response(edge, float(gain[0]), uncertainty, blind))
    return found


def _noise(step: Array) -> Array:
    """Typical noise of the gyros on each axis, from the median of their changes, shape (axes,); 1 where there is none.

    The median gyro's: neither spikes nor a turn during a part of the recording make the probe larger.
    """
    found = np.ones(step.shape[1])
    for a in range(step.shape[1]):
        sizes = [np.median(np.abs(column[np.isfinite(column)])) for column in step[:, a].T if np.isfinite(column).any()]
        size = MAD_TO_SIGMA * float(np.median(sizes)) / math.sqrt(2) if sizes else 0.0
        found[a] = size if size > 0 else 1.0
    return found


def _frozen(step: Array, rate: float) -> np.ndarray:
    """Samples at which a gyro repeats itself, shape (m, axes, n), by its changes from sample to sample.

    That is for half a second or more, and for 20 times as long as it usually does: the output of a healthy gyro whose
    steps are as large as its noise repeats itself, too.
    """
    same = np.concatenate([np.zeros((1, *step.shape[1:]), dtype=bool), step == 0])
    frozen = np.zeros(same.shape, dtype=bool)
    for a, i in np.ndindex(*same.shape[1:]):
        changes = np.append(np.flatnonzero(~same[:, a, i]), len(same))
        runs = np.diff(changes)
        long = (runs > _FROZEN * rate) & (runs > _UNUSUAL * np.median(runs) * (len(runs) > 1))
        frozen[:, a, i] = np.repeat(long, runs)
    return frozen


def _transfer(probe: Array, response: Array) -> tuple[Array, float]:
    """Size of the transfer function, by half-overlapping windowed segments (Welch), and its u at the lowest frequency.

    The uncertainty is a jackknife that leaves out pairs of segments, which overlap.
    """
    size = min(_SEGMENT, len(probe))
    window = np.hanning(size)
    starts = range(0, len(probe) - size + 1, max(1, size // 2))
    spectra = [
        (np.fft.rfft(window * probe[s : s + size]), np.fft.rfft(window * response[s : s + size])) for s in starts
    ]
    cross = np.array([np.conj(p) * r for p, r in spectra])
    own = np.array([np.abs(p) ** 2 for p, _ in spectra])
    gain: Array = np.abs(cross.sum(axis=0)) / np.maximum(own.sum(axis=0), 1e-300)
    pairs = np.arange(0, len(spectra), 2)
    if len(pairs) < _FEWEST_PAIRS:
        return gain, math.inf
    left = [np.add.reduceat(part[:, 0], pairs) for part in (cross, own)]
    without = np.abs(cross[:, 0].sum() - left[0]) / np.maximum(own[:, 0].sum() - left[1], 1e-300)
    return gain, float(np.sqrt((len(pairs) - 1) / len(pairs) * ((without - without.mean()) ** 2).sum()))

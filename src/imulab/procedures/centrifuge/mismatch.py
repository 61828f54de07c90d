"""How the channels of a test differ besides the drift: tilt and delay of the FOG, scale mismatch and azimuth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.procedures.centrifuge.levels import RunLine
from imulab.procedures.centrifuge.rates import three_sigma
from imulab.procedures.centrifuge.regress import Complex
from imulab.procedures.centrifuge.run import LoadedRun
from imulab.recording import Array

_STEPS = 12
_LEAST = 3e-4
"""Gravity terms at the net rate, on a base that is not level, look like a mismatch of this size."""


class Measured:
    """Arrays over the runs, X axis: signed rates, forces, lines of FOG and residual with variances of a component."""

    def __init__(self, runs: list[LoadedRun], lines: dict[int, RunLine]) -> None:
        self.runs = runs
        self.arm = np.array([run.run.sense * run.run.arm_rate for run in runs])
        self.table = np.array([run.rates.table_rate for run in runs])
        self.force = np.array([run.force for run in runs])
        self.x = np.array([run.line[0] for run in runs])
        self.fog = np.array([run.line[-1] for run in runs])
        self.fog_variance = np.array([run.covariance[-1, -1].real / 2 for run in runs])
        self.line = np.array([lines[run.index].line[0] for run in runs])
        self.line_variance = np.array([np.trace(lines[run.index].noise[:2, :2]) / 2 for run in runs])
        self.encoder = all(run.encoder for run in runs)
        self.top = self.force > 0.999 * self.force.max()
        self.K = float(np.abs(self.line[self.top]).mean())
        labels = np.round(np.abs(self.arm), 6)
        self.levels = len(np.unique(labels))
        self.both = self.encoder and all(len(set(np.sign(self.arm[labels == label]))) == 2 for label in labels)
        self.fog_share = float((np.abs(self.fog) / self.force)[self.top].mean()) / self.K


def weighted(design: Array, values: Array, variance: Array) -> tuple[Array, Array]:
    """Return the weighted least-squares solution and its covariance."""
    weight = 1 / np.sqrt(np.maximum(variance, 1e-12 * variance.max() + 1e-300))
    inverse = np.linalg.pinv(design * weight[:, None])
    return inverse @ (values * weight), inverse @ inverse.T


def _scatter(left: Array, variance: Array, used: int) -> float:
    """Chi-square per degree of freedom where it is above one: what a model leaves beyond the noise is no noise."""
    floor = np.maximum(variance, 1e-12 * variance.max() + 1e-300)
    return max(1.0, float((left**2 / floor).sum()) / max(len(left) - used, 1))


def _pairs(values: Complex) -> Array:
    return np.concatenate([values.real, values.imag])


def tilted(test: Measured) -> tuple[Array, Array, bool]:
    """Fit the FOG's lines by ``-w_t (delta + kappa a) exp(i w_s tau)``; parameters, covariance, and tau or not."""
    with_flexure, with_delay = test.levels >= 2, test.levels >= 3
    parameters = np.zeros(5)
    variance = np.concatenate([test.fog_variance / test.arm**2] * 2)
    measured = -test.fog / test.arm
    covariance = np.zeros((5, 5))
    everything = [0, 1, *([2, 3] if with_flexure else []), *([4] if with_delay else [])]
    for step_number in range(_STEPS):
        # Without a first value of the tilt nothing senses the delay.
        kept = everything if step_number else [index for index in everything if index < 4]
        tilt = parameters[0] + 1j * parameters[1] + (parameters[2] + 1j * parameters[3]) * test.force
        # A late channel shows an earlier angle: its line, as a function of the true angle, turns back by w_s tau.
        turn = np.exp(1j * test.table * parameters[4])
        columns = [turn, 1j * turn, turn * test.force, 1j * turn * test.force, 1j * test.table * tilt * turn]
        design = np.stack([_pairs(column) for column in columns], axis=1)[:, kept]
        scale = np.maximum(np.abs(design).max(axis=0), 1e-300)
        step, matrix = weighted(design / scale, _pairs(measured - tilt * turn), variance)
        parameters[kept] += step / scale
        covariance[np.ix_(kept, kept)] = matrix / np.outer(scale, scale)
    tilt = parameters[0] + 1j * parameters[1] + (parameters[2] + 1j * parameters[3]) * test.force
    left = _pairs(measured - tilt * np.exp(1j * test.table * parameters[4]))
    return parameters, covariance * _scatter(left, variance, len(everything)), with_delay


@dataclass(frozen=True)
class Mismatch:
    """How an axis shows Earth rate beside the FOG: 1 + scale + i sense azimuth, standard uncertainty of each."""

    scale: float
    azimuth: float
    uncertainty: float
    freedom: int


def mismatch(test: Measured, axis: int = 0, delay: float = 0.0) -> Mismatch | None:
    """Return scale mismatch and azimuth of an axis against the FOG by Earth rate; None where that is not seen.

    `delay` is that of the FOG against the axis, s.
    """
    seen = [run for run in test.runs if run.rates.net_rate is not None]
    if not seen:
        return None
    # What is fixed in the room passes Y a quarter turn before X.
    quarter = (1.0, -1j)[axis]
    expected = np.array([quarter * run.room[-1] * np.exp(-1j * (run.rates.net_rate or 0.0) * delay) for run in seen])
    ratio = np.array([run.room[axis] for run in seen]) / expected - 1
    share = [np.array([1.0, -quarter]) for _ in seen]
    noise = [run.room_covariance[np.ix_([axis, -1], [axis, -1])] for run in seen]
    variance = (
        np.array([(s @ C @ s.conj()).real / 2 for s, C in zip(share, noise, strict=True)]) / np.abs(expected) ** 2
    )
    # A run's own noise at the net rate comes from a few blocks: that of all runs together is known better.
    seconds = np.array([run.duration for run in seen])
    variance = np.maximum((variance * seconds).mean() / seconds, 1e-300)
    weight = 1 / variance
    turned = ratio.real + 1j * ratio.imag * [run.run.sense for run in seen]
    value = complex((weight * turned).sum() / weight.sum())
    u = np.sqrt(_scatter(_pairs(turned - value), np.concatenate([variance] * 2), 2) / weight.sum())
    return Mismatch(value.real, value.imag, float(u), max(2 * len(seen) - 2, 1))


def _seen(found: Mismatch | None, sense: Array) -> Complex:
    """How an axis shows the FOG's rotation: what is not clear of its uncertainty counts as none."""
    share = np.ones(len(sense), dtype=np.complex128)
    if found is not None:
        reach = max(three_sigma(found.freedom) * found.uncertainty, _LEAST)
        share += found.scale * (abs(found.scale) > reach) + 1j * sense * found.azimuth * (abs(found.azimuth) > reach)
    return share


@dataclass(frozen=True)
class Delays:
    """Delays against the encoder, s, with standard uncertainties: of the FOG, of X and Y, and of their difference."""

    fog: float
    fog_uncertainty: float
    own: float
    own_uncertainty: float
    uncertainty: float

    @property
    def late(self) -> float:
        """How much later than X the FOG is, s."""
        return self.fog - self.own


def delays(test: Measured) -> Delays | None:
    """Return the delays that the lines' turning with the table rate shows; None without encoder or three levels.

    That of the FOG from its own lines, ``-w_t (delta + kappa a) exp(i w_s tau)``; that of X from what is left of X
    without them, ``exp(i w_s own) K a exp(i theta)``. Differential flexure across the drift looks like `own`.
    """
    if not test.encoder or test.levels < 3:
        return None
    parameters, covariance, _ = tilted(test)
    tau, u_tau = float(parameters[4]), float(np.sqrt(covariance[4, 4]))
    own, u_own = _own_delay(test, tau)
    lever = (_own_delay(test, tau + u_tau)[0] - own) / max(u_tau, 1e-300)
    return Delays(tau, u_tau, own, float(np.hypot(u_own, lever * u_tau)), float(np.hypot(u_own, (1 - lever) * u_tau)))


def _own_delay(test: Measured, tau: float) -> tuple[float, float]:
    """Delay of X and its uncertainty, that of the FOG given, s."""
    own = u = 0.0
    sense = np.array([run.run.sense for run in test.runs])
    design = np.stack([np.ones(len(test.table)), test.table], axis=1)
    for _ in range(_STEPS):
        share = _seen(mismatch(test, 0, tau - own), sense)
        drift = (test.x - share * test.fog * np.exp(-1j * test.table * (tau - own))) / test.force
        angle = np.angle(drift / (drift / np.maximum(test.line_variance, 1e-300)).sum())
        variance = test.line_variance / np.abs(drift) ** 2
        slope, matrix = weighted(design, angle, variance)
        u = float(np.sqrt(matrix[1, 1] * _scatter(angle - design @ slope, variance, 2)))
        before, own = own, float(slope[1])
        if abs(own - before) < 1e-9:
            break
    return own, u

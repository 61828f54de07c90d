"""Errors that survive the subtraction of the FOG: which of them the data bound, and by how much.

Each entry gives a value with its uncertainty where the data determine it, and what it does to K at the highest level,
as a fraction of K. What the data do not bound is given as the effect of a stated size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from imulab.centrifuge.levels import RunLine
from imulab.centrifuge.manifest import Manifest
from imulab.centrifuge.regress import Complex
from imulab.centrifuge.run import LoadedRun
from imulab.recording import Array
from imulab.units import STANDARD_GRAVITY

_FLEXURE = 1e-7 / STANDARD_GRAVITY
_DELAY = 1e-3
_MISMATCH = 5e-3
_STEPS = 12


@dataclass(frozen=True)
class Entry:
    """One error.

    Attributes
    ----------
    error
        Its name.
    bounded
        Whether these data bound it.
    value, standard_uncertainty, unit
        As measured (an angle, a time, a fraction); where it is not bounded, the size that the effect is stated for.
    effect
        On K at the highest level, as a fraction: of the measured value and its uncertainty, after what the reduction
        does against it; where it is not bounded, of the size stated.
    removed
        The same without the subtraction or combination that removes it, where there is one.
    basis
        Where this comes from, or what it would need.
    """

    error: str
    bounded: bool
    value: float | None
    standard_uncertainty: float | None
    unit: str
    effect: float
    removed: float | None
    basis: str


def error_budget(runs: Sequence[LoadedRun], lines: dict[int, RunLine], manifest: Manifest) -> list[dict[str, Any]]:
    """Return the error budget of the X axis as plain values, largest remaining effect first among the bounded."""
    used = [run for run in runs if run.index in lines]
    test = _Test(used, lines)
    mismatch = _scale_mismatch(test)
    entries = [
        *_tilt(test), _flexure(test), *mismatch, *_delays(test), _table_rate(test), _arm_rate(test, manifest),
        _radius(test, manifest),
    ]  # fmt: skip
    return [asdict(entry) for entry in entries]


class _Test:
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
        self.levels = len(np.unique(np.round(np.abs(self.arm), 6)))
        self.fog_share = float((np.abs(self.fog) / self.force)[self.top].mean()) / self.K


def _weighted(design: Array, values: Array, variance: Array) -> tuple[Array, Array]:
    weight = 1 / np.sqrt(np.maximum(variance, 1e-12 * variance.max() + 1e-300))
    inverse = np.linalg.pinv(design * weight[:, None])
    return inverse @ (values * weight), inverse @ inverse.T


def _pairs(values: Complex) -> Array:
    return np.concatenate([values.real, values.imag])


def _tilted(test: _Test) -> tuple[Array, Array, bool]:
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
        step, matrix = _weighted(design / scale, _pairs(measured - tilt * turn), variance)
        parameters[kept] += step / scale
        covariance[np.ix_(kept, kept)] = matrix / np.outer(scale, scale)
    return parameters, covariance, with_delay


def _tilt(test: _Test) -> list[Entry]:
    if not test.encoder:
        size = np.abs(test.fog / test.arm)
        variance = test.fog_variance / test.arm**2
        weight = 1 / np.maximum(variance, 1e-300)
        value, u = float((weight * size).sum() / weight.sum()), float(1 / np.sqrt(weight.sum()))
        basis = "FOG line, flexure included"
        return [Entry("tilt", True, value, u, "rad", 0.0, test.fog_share, basis)]
    parameters, covariance, _ = _tilted(test)
    entries = []
    top = float(test.force.max())
    for error, index, factor, unit, basis in (
        ("tilt", 0, 1.0, "rad", "FOG line at a = 0"),
        ("common flexure", 2, top, "rad/(m/s^2)", "FOG line, growth with a"),
    ):
        if index == 2 and test.levels < 2:
            continue
        pair = parameters[index] + 1j * parameters[index + 1]
        u = float(np.sqrt((covariance[index, index] + covariance[index + 1, index + 1]) / 2))
        removed = abs(pair) * factor * float(np.abs(test.arm).max()) / top / test.K
        entries.append(Entry(error, True, float(abs(pair)), u, unit, 0.0, removed, basis))
    return entries


def _flexure(test: _Test) -> Entry:
    """Differential flexure: what changes sign with the sense of rotation."""
    reach = float(np.abs(test.arm).max()) / test.K
    senses = np.sign(test.arm)
    if not test.encoder or len(np.unique(senses)) < 2:
        return Entry(
            "differential flexure", False, _FLEXURE, None, "rad/(m/s^2)", _FLEXURE * reach, None,
            "needs both senses, encoder",
        )  # fmt: skip
    # Per unit of force: Z = D(level) + w_t kappa_d; the levels' own lines are free.
    labels = np.round(np.abs(test.arm), 6)
    design = np.zeros((len(labels), test.levels + 1))
    for column, label in enumerate(np.unique(labels)):
        design[labels == label, column] = 1.0
    design[:, -1] = test.arm
    found = [_weighted(design, part, test.line_variance) for part in (test.line.real, test.line.imag)]
    value = abs(complex(found[0][0][-1], found[1][0][-1]))
    u = float(np.sqrt(found[0][1][-1, -1]))
    return Entry(
        "differential flexure", True, value, u, "rad/(m/s^2)", 0.0, value * reach,
        "difference of the senses",
    )  # fmt: skip


def _scale_mismatch(test: _Test) -> list[Entry]:
    """Scale mismatch and azimuth of X against the FOG, by Earth rate."""
    room = [(run.room, run.room_covariance, run.run.sense) for run in test.runs if run.rates.net_rate is not None]
    both = len(np.unique(np.sign(test.arm))) == 2 and test.encoder
    if not room:
        return [
            Entry("scale mismatch", False, _MISMATCH, None, "1", _MISMATCH * test.fog_share, None,
                  "needs an Earth-rate line"),
        ]  # fmt: skip
    ratio = np.array([line[0] / line[-1] - 1 for line, _, _ in room])
    variance = np.array([(C[0, 0] + C[-1, -1] - 2 * C[0, -1]).real / 2 / abs(line[-1]) ** 2 for line, C, _ in room])
    weight = 1 / np.maximum(variance, 1e-300)
    sense = np.array([s for *_, s in room])
    u = float(1 / np.sqrt(weight.sum()))
    entries = []
    for error, values, unit in (
        ("scale mismatch", ratio.real, "1"),
        ("FOG azimuth", ratio.imag * sense, "rad"),
    ):
        value = float((weight * values).sum() / weight.sum())
        effect = float(np.hypot(value, u)) * test.fog_share
        entries.append(
            Entry(error, True, value, u, unit, 0.0 if both else effect, effect if both else None,
                  "Earth-rate line"),
        )  # fmt: skip
    return entries


def _delays(test: _Test) -> list[Entry]:
    """Delays of FOG and X against the encoder: by the turning of their lines with the table rate."""
    per_second = float(np.abs(test.table).max()) * test.fog_share
    if not test.encoder or test.levels < 3:
        basis = "needs encoder, 3 levels"
        return [Entry("delay, FOG to X", False, _DELAY, None, "s", _DELAY * per_second, None, basis)]
    parameters, covariance, _ = _tilted(test)
    tau, u_tau = float(parameters[4]), float(np.sqrt(covariance[4, 4]))
    drift = (test.x - test.fog * np.exp(-1j * test.table * tau)) / test.force
    angle = np.angle(drift / (drift / np.maximum(test.line_variance, 1e-300)).sum())
    variance = test.line_variance / np.abs(drift) ** 2
    slope, matrix = _weighted(np.stack([np.ones(len(angle)), test.table], axis=1), angle, variance)
    own, u_own = float(slope[1]), float(np.sqrt(matrix[1, 1]))
    effect = float(np.hypot(tau - own, np.hypot(u_tau, u_own))) * per_second
    return [
        Entry("delay of the FOG", True, tau, u_tau, "s", effect, None, "FOG phase over table rate"),
        Entry("delay of X", True, own, u_own, "s", effect, None, "drift phase over table rate"),
    ]


def _table_rate(test: _Test) -> Entry:
    origins = {run.rates.origin for run in test.runs}
    if "manifest" in origins:
        return Entry(
            "table rate", False, None, None, "rad/s", 0.0, None,
            "needs FOG line or encoder",
        )  # fmt: skip
    if origins == {"encoder"}:
        return Entry("table rate", True, 0.0, 0.0, "rad/s", 0.0, None, "encoder")
    u = np.array([run.rates.table_uncertainty or 0.0 for run in test.runs])
    lost = (u * [run.duration for run in test.runs]) ** 2 / 24
    off = np.array([abs(run.rates.table_rate) - run.run.table_rate for run in test.runs])
    removed = (off * [run.duration for run in test.runs]) ** 2 / 24
    worst = int(np.argmax(np.abs(off)))
    return Entry(
        "table rate", True, float(off[worst]), float(u[worst]), "rad/s", float(lost.max()),
        float(min(removed.max(), 1.0)),
        "FOG line",
    )  # fmt: skip


def _arm_rate(test: _Test, manifest: Manifest) -> Entry:
    """Arm rate, table rate plus net rate as measured, against the manifest's."""
    runs = [run for run in test.runs if run.rates.net_rate is not None and run.rates.origin != "manifest"]
    stated = manifest.rate_uncertainty / float(np.abs(test.arm).max())
    if not runs:
        return Entry("arm rate", False, None, manifest.rate_uncertainty, "rad/s", 2 * stated, None, "manifest")
    off = np.array([r.run.sense * (r.rates.table_rate + (r.rates.net_rate or 0.0)) - r.run.arm_rate for r in runs])
    u = np.array([np.hypot(r.rates.net_uncertainty or 0.0, r.rates.table_uncertainty or 0.0) for r in runs])
    arm = np.array([r.run.arm_rate for r in runs])
    worst = int(np.argmax(np.abs(off)))
    effect = 2 * float((np.hypot(off, u) / arm).max())
    return Entry(
        "arm rate", True, float(off[worst]), float(u[worst]), "rad/s", effect, None,
        "table + net rate",
    )  # fmt: skip


def _radius(test: _Test, manifest: Manifest) -> Entry:
    relative = manifest.radius_uncertainty / manifest.radius
    return Entry(
        "radius",
        False,
        None,
        manifest.radius_uncertainty,
        "m",
        relative,
        None,
        "manifest; not in zeta",
    )

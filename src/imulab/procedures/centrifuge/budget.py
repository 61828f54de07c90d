"""Errors that survive the subtraction of the FOG: which of them the data bound, and by how much.

Each entry gives a value with its uncertainty where the data determine it, and what it does to K at the highest level,
as a fraction of K. What the data do not bound is given as the effect of a stated size.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from imulab.procedures.centrifuge.levels import RunLine, arm_rate_off
from imulab.procedures.centrifuge.manifest import Manifest
from imulab.procedures.centrifuge.mismatch import Measured, delays, mismatch, tilted, weighted
from imulab.procedures.centrifuge.run import LoadedRun
from imulab.units import STANDARD_GRAVITY

FLEXURE = 1e-7 / STANDARD_GRAVITY
_DELAY = 1e-3
_MISMATCH = 5e-3


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


def error_budget(
    runs: Sequence[LoadedRun], lines: dict[int, RunLine], manifest: Manifest, corrected: Collection[str] = ()
) -> list[dict[str, Any]]:
    """Return the error budget of the X axis as plain values.

    `runs` and `lines` are those before any correction; `corrected` names the entries that the reduction corrected.
    """
    test = Measured([run for run in runs if run.index in lines], lines)
    entries = [
        *_tilt(test), _flexure(test), *_scale_mismatch(test), *_delays(test), _table_rate(test),
        _arm_rate(test, manifest), _radius(test, manifest),
    ]  # fmt: skip
    return [asdict(_corrected_entry(entry) if entry.error in corrected else entry) for entry in entries]


def _corrected_entry(entry: Entry) -> Entry:
    """An entry once its value is corrected: what is left is its uncertainty."""
    share = (entry.standard_uncertainty or 0.0) / max(
        np.hypot(entry.value or 0.0, entry.standard_uncertainty or 0.0), 1e-300
    )
    return replace(entry, effect=entry.effect * share, removed=entry.effect, basis=f"{entry.basis}; corrected")


def _tilt(test: Measured) -> list[Entry]:
    if not test.encoder:
        size = np.abs(test.fog / test.arm)
        variance = test.fog_variance / test.arm**2
        weight = 1 / np.maximum(variance, 1e-300)
        value, u = float((weight * size).sum() / weight.sum()), float(1 / np.sqrt(weight.sum()))
        basis = "FOG line, flexure included"
        return [Entry("tilt", True, value, u, "rad", 0.0, test.fog_share, basis)]
    parameters, covariance, _ = tilted(test)
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


def _flexure(test: Measured) -> Entry:
    """Differential flexure: what changes sign with the sense of rotation."""
    reach = float(np.abs(test.arm).max()) / test.K
    senses = np.sign(test.arm)
    if not test.encoder or len(np.unique(senses)) < 2:
        return Entry(
            "differential flexure", False, FLEXURE, None, "rad/(m/s^2)", FLEXURE * reach, None,
            "needs both senses, encoder",
        )  # fmt: skip
    # Per unit of force: Z = D(level) + w_t kappa_d; the levels' own lines are free.
    labels = np.round(np.abs(test.arm), 6)
    design = np.zeros((len(labels), test.levels + 1))
    for column, label in enumerate(np.unique(labels)):
        design[labels == label, column] = 1.0
    design[:, -1] = test.arm
    found = [weighted(design, part, test.line_variance) for part in (test.line.real, test.line.imag)]
    value = abs(complex(found[0][0][-1], found[1][0][-1]))
    u = float(np.sqrt(found[0][1][-1, -1]))
    return Entry(
        "differential flexure", True, value, u, "rad/(m/s^2)", 0.0, value * reach,
        "difference of the senses",
    )  # fmt: skip


def _scale_mismatch(test: Measured) -> list[Entry]:
    """Scale mismatch and azimuth of X against the FOG, by Earth rate."""
    found = mismatch(test)
    if found is None:
        return [
            Entry("scale mismatch", False, _MISMATCH, None, "1", _MISMATCH * test.fog_share, None,
                  "needs an Earth-rate line"),
        ]  # fmt: skip
    entries = []
    for error, value, unit in (("scale mismatch", found.scale, "1"), ("FOG azimuth", found.azimuth, "rad")):
        effect = float(np.hypot(value, found.uncertainty)) * test.fog_share
        entries.append(
            Entry(error, True, value, found.uncertainty, unit, 0.0 if test.both else effect,
                  effect if test.both else None, "Earth-rate line"),
        )  # fmt: skip
    return entries


def _delays(test: Measured) -> list[Entry]:
    """Delays of FOG and X against the encoder: by the turning of their lines with the table rate."""
    per_second = float(np.abs(test.table).max()) * test.fog_share
    found = delays(test)
    if found is None:
        basis = "needs encoder, 3 levels"
        return [Entry("delay, FOG to X", False, _DELAY, None, "s", _DELAY * per_second, None, basis)]
    effect = float(np.hypot(found.late, found.uncertainty)) * per_second
    return [
        Entry("delay of the FOG", True, found.fog, found.fog_uncertainty, "s", effect, None,
              "FOG phase over table rate"),
        Entry("delay of X", True, found.own, found.own_uncertainty, "s", effect, None, "drift phase over table rate"),
    ]  # fmt: skip


def _table_rate(test: Measured) -> Entry:
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


def _arm_rate(test: Measured, manifest: Manifest) -> Entry:
    """Arm rate, table rate plus net rate as measured, against the manifest's."""
    runs = [run for run in test.runs if run.rates.net_rate is not None and run.rates.origin != "manifest"]
    stated = manifest.rate_uncertainty / float(np.abs(test.arm).max())
    if not runs:
        return Entry("arm rate", False, None, manifest.rate_uncertainty, "rad/s", 2 * stated, None, "manifest")
    off, u = np.array([arm_rate_off(run) for run in runs]).T
    arm = np.array([r.run.arm_rate for r in runs])
    worst = int(np.argmax(np.abs(off)))
    effect = 2 * float((np.hypot(off, u) / arm).max())
    return Entry(
        "arm rate", True, float(off[worst]), float(u[worst]), "rad/s", effect, None,
        "table + net rate",
    )  # fmt: skip


def _radius(test: Measured, manifest: Manifest) -> Entry:
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

"""The magnetometers in the attitudes that the accelerometers found: means, and how certain they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.columns import triad
from imulab.errors import DataError, OptionError
from imulab.estimation.rows import LeftOut, leave_out
from imulab.procedures.tumble.attitude_table import stated_covariance
from imulab.procedures.tumble.attitudes import POOL_DEGREES, Attitudes
from imulab.recording import Array, Recording, check_finite
from imulab.units import parse_unit

FEWEST = 10
_BATCHES = 8
_DEAD = 1e-3
_CLIPPED = 0.3
"""Share of the attitudes at one extreme of an axis from which it is taken for saturated."""
_FLAT = 0.05
_FAR = 4.5
"""Distance from the middle of the outputs, over its median: up to 4.1 where axes differ in scale by a factor of 2."""
_FIELDS = (5e-6, 2e-4)
"""Magnitudes that the field can have near the Earth's surface, T: from a quarter of the least to thrice the most."""


@dataclass(frozen=True)
class FieldMeans:
    """Outputs of the magnetometers in each attitude.

    `mean` has shape (n, 3), `covariance` (n, 3, 3), or None for a table that does not state it, not a number where an
    attitude was not asked for; `unit` is that of the columns, `notes` what was left out. `of_one_sample` is the
    standard deviation of one axis of accelerometers and magnetometers at rest, each in the unit of its columns, None
    for a table.
    """

    mean: Array
    covariance: Array | None
    unit: str
    notes: tuple[str, ...] = ()
    of_one_sample: tuple[float, float] | None = None


def field_means(attitudes: Attitudes, kept: NDArray[np.intp]) -> FieldMeans:
    """Return the magnetometers' outputs in the attitudes `kept`, from 0, that a fit can be made of.

    Raises
    ------
    DataError
        A constant or saturated axis, outputs in one plane, an attitude far from all others, too few attitudes, and as
        for `outputs_of`.
    OptionError, UnitError
        As for `outputs_of`.
    """
    found = outputs_of(attitudes, kept)
    _check(replace(found, mean=found.mean[kept]), attitudes.recording.name, triad("mag"))
    _check_far(found.mean[kept], [attitudes.label(i) for i in kept], kept, attitudes.recording.name)
    return found


def outputs_of(attitudes: Attitudes, kept: NDArray[np.intp]) -> FieldMeans:
    """Return the magnetometers' outputs in the attitudes `kept`, from 0, of a recording that has them.

    A magnetometer that is slower than its log has samples in some of the rows, and no numbers in the others.

    Raises
    ------
    DataError
        No such columns, or no samples in an attitude.
    OptionError
        Some of the attitudes were taken out by hand.
    UnitError
        The columns have different units, or one of something else.
    """
    recording = attitudes.recording
    names = triad("mag")
    missing = [name for name in names if name not in recording]
    if missing:
        raise DataError(
            f"{recording.name}: no column {' '.join(missing)}; expected mag_x mag_y mag_z beside accel_x accel_y "
            "accel_z, in the same attitudes"
        )
    unit = recording.triad_unit("mag")
    if parse_unit(unit).quantity not in ("magnetic field", "output", "number"):
        raise DataError(
            f"{recording.name}: columns {' '.join(names)}: expected a unit of field or output such as uT, mgauss or "
            f"count, found {unit!r}"
        )
    if attitudes.pieces is not None:
        return _of_stretches(attitudes, kept, recording, names, unit)
    if attitudes.trace is None:
        return _of_table(attitudes, recording, names, unit)
    raise OptionError(f"{recording.name}: expected all attitudes that were found; drop says which to leave out")


def _of_table(attitudes: Attitudes, recording: Recording, names: list[str], unit: str) -> FieldMeans:
    check_finite(recording, names)
    rows = attitudes.start.astype(np.int64) - recording.first_row
    covariance = stated_covariance(recording, names, unit)
    return FieldMeans(recording.triad("mag")[rows], None if covariance is None else covariance[rows], unit)


def _of_stretches(
    attitudes: Attitudes, kept: NDArray[np.intp], recording: Recording, names: list[str], unit: str
) -> FieldMeans:
    """Means over the stretches at rest, and their covariance from batches, shrunk towards what all have in common."""
    left_out, there = _readings(recording, names)
    samples = left_out.recording.triad("mag")
    pieces = attitudes.pieces
    assert pieces is not None
    mean, own = np.full((len(attitudes), 3), np.nan), np.full((len(attitudes), 3, 3), np.nan)
    freedom = np.ones(len(attitudes))
    rest = np.zeros(len(samples), dtype=np.bool_)
    force, scatter = recording.triad("accel"), np.empty((len(kept), 2))
    for place, number in enumerate(kept.tolist()):
        index = np.concatenate([np.arange(a, b) for a, b, at in pieces.tolist() if at == number])
        scatter[place, 0] = force[index].var(axis=0, ddof=1).mean()
        index = index[there[index]]
        if len(index) < 2:
            raise DataError(
                f"{recording.name}: {attitudes.label(number)}: {len(index)} samples of {' '.join(names)}; expected 2 "
                f"or more: leave it out with --drop {number + 1}"
            )
        rest[index] = True
        mean[number] = samples[index].mean(axis=0)
        scatter[place, 1] = samples[index].var(axis=0, ddof=1).mean()
        parts = np.array_split(index, min(_BATCHES, len(index)))
        batches = np.array([samples[part].mean(axis=0) for part in parts])
        own[number], freedom[number] = np.cov(batches.T) / len(batches), len(batches) - 1.0
    level = np.trace(own, axis1=1, axis2=2)
    usual = level <= 3 * np.median(level[kept])
    weight = freedom[:, None, None]
    covariance = (weight * own + POOL_DEGREES * own[usual].mean(axis=0)) / (weight + POOL_DEGREES)
    step = np.array([_step(samples[rest, axis]) for axis in range(3)])
    covariance[:, range(3), range(3)] += np.where(
        covariance[kept][:, range(3), range(3)].mean(axis=0) < 1e-3 * step**2, step**2 / 12, 0.0
    )
    of_accel, of_mag = np.sqrt(np.median(scatter, axis=0)).tolist()
    return FieldMeans(mean, covariance, unit, tuple(left_out.notes(rest)), (of_accel, of_mag))


def _readings(recording: Recording, names: list[str]) -> tuple[LeftOut, NDArray[np.bool_]]:
    """Return what is left out among the rows that hold a sample of the magnetometers, and which rows these are."""
    there = np.logical_not(np.isnan(recording.triad("mag")).all(axis=1))
    filled = {name: np.where(there, recording.column(name), 0.0) for name in names}
    check_finite(recording.with_columns(filled, {}), names)
    if there.all():
        return leave_out(recording, names), there
    found = leave_out(replace(recording, columns={name: recording.column(name)[there] for name in names}), names)
    columns = {name: np.array(recording.column(name)) for name in names}
    kinds = {kind: np.zeros(len(recording), dtype=np.bool_) for kind in found.kinds}
    for name in names:
        columns[name][there] = found.recording.column(name)
    for kind, rows in found.kinds.items():
        kinds[kind][there] = rows
    return LeftOut(recording.with_columns(columns, {}), found.names, kinds), there


def _step(values: Array) -> float:
    """Smallest step between the values of a channel, 0 for one value."""
    different = np.unique(values)
    return float(np.diff(different).min()) if len(different) > 1 else 0.0


def _check(found: FieldMeans, name: str, names: list[str]) -> None:
    n = len(found.mean)
    if n < FEWEST:
        raise DataError(f"{name}: {n} attitudes; a magnetometer needs {FEWEST} or more, better 16, at several headings")
    span = np.ptp(found.mean, axis=0)
    for axis, column in enumerate(names):
        if span[axis] <= _DEAD * span.max():
            raise DataError(
                f"{name}: column {column}: the output changes by {span[axis]:.3g} {found.unit} over the {n} attitudes, "
                f"other axes by {span.max():.3g} {found.unit}: a dead axis?"
            )
    count, axis, extreme = most_at_an_extreme(found.mean)
    if count > max(2, _CLIPPED * n):
        word = "largest" if extreme > found.mean[:, axis].mean() else "smallest"
        raise DataError(
            f"{name}: column {names[axis]}: {count} of {n} attitudes have the {word} output, {extreme:.6g} "
            f"{found.unit}: the axis is saturated; expected a wider range, or less iron near"
        )
    flat = np.linalg.svd(found.mean - found.mean.mean(axis=0), compute_uv=False)
    if flat[2] < _FLAT * flat[0]:
        raise DataError(
            f"{name}: the outputs of {' '.join(names)} lie in one plane over the {n} attitudes (spread across it "
            f"{100 * flat[2] / flat[0]:.1f} % of that along it); turn the unit about two axes"
        )


def most_at_an_extreme(mean: Array) -> tuple[int, int, float]:
    """Return in how many attitudes an axis has its largest or smallest output, and which axis and output that is."""
    ends = [(axis, float(end(mean[:, axis]))) for axis in range(3) for end in (np.max, np.min)]
    near = 1e-6 * np.ptp(mean, axis=0)
    return max((int((np.abs(mean[:, axis] - value) <= near[axis]).sum()), axis, value) for axis, value in ends)


def _check_far(mean: Array, labels: Sequence[str], kept: NDArray[np.intp], name: str) -> None:
    """Refuse outputs of one attitude that no field of the others' magnitude gives, which would bend the whole fit."""
    distance = np.linalg.norm(mean - np.median(mean, axis=0), axis=1)
    distance /= np.median(distance)
    worst = int(np.argmax(distance))
    if distance[worst] > _FAR:
        raise DataError(
            f"{name}: {labels[worst]}: the outputs of mag_x mag_y mag_z lie {distance[worst]:.1f} times as far from "
            f"the middle of all as usual: was a magnet near? leave the attitude out with --drop {kept[worst] + 1}"
        )


def check_magnitude(length: float, unit: str, name: str, field: float | None) -> None:
    """Check that the magnitude that the outputs turn through, in the columns' unit, can be that of the field, T.

    Raises
    ------
    DataError
        The unit is one of field, and the magnitude is off by a factor of 2 of what was stated, or nowhere on Earth.
    """
    known = parse_unit(unit)
    if known.quantity != "magnetic field":
        return
    found = length * known.factor
    low, high = (field / 2, 2 * field) if field is not None else _FIELDS
    if not low <= found <= high:
        expected = f"{1e6 * field:.4g} uT" if field is not None else "25 to 65 uT on Earth"
        raise DataError(
            f"{name}: columns mag_x mag_y mag_z: the field turns through {length:.4g} {unit} ({1e6 * found:.4g} uT), "
            f"expected {expected}: is the unit wrong?"
        )

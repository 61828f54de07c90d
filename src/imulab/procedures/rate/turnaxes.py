"""Misalignment from whole turns by hand, whose axis in the body accelerometers tell.

Of turn k about the vertical, n_k times round, the gyroscopes' integrals are ``2 pi n_k B a_k``, ``B = diag(S) T``, with
a_k the axis in the body: the mean of f, weighted by the rate, of ``f = g a + c cos + s sin + w^2 r + w' q``, in which
the lever arm and the tilt of the table come apart from it. Source: rotation about a fixed axis; least squares.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from imulab.errors import DataError, ObservabilityError, RecordError
from imulab.estimation.least_squares import chi_square_probability
from imulab.procedures.rate.axes import (
    BY_ACCELEROMETERS,
    corrected_means,
    length_said,
    length_uncertainty,
    moved_by_parameters,
    unit_vectors,
)
from imulab.procedures.rate.choices import AXES
from imulab.procedures.rate.turnrests import Motions
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.units import from_si
from imulab.verdict import UNJUDGED

if TYPE_CHECKING:
    from imulab.procedures.rate.turnrests import AxisTurns

_TURN = 2 * np.pi
_SMOOTH = 0.05  # s
_BATCHES = 8
_FACE = np.cos(np.radians(30))
_CHANCE = 0.01
_EXACT = 1e-12


def check_accel(accel: Calibration, recording: Recording) -> None:
    """Refuse a record without accelerometers, and a recording without their columns.

    Raises
    ------
    RecordError, DataError
        See above.
    """
    if "bias_x" not in accel.parameters:
        raise RecordError(f"accel: a {accel.procedure} record without accelerometers; expected one of tumble fit")
    for name in (f"accel_{axis}" for axis in AXES):
        if name not in recording:
            raise DataError(f"{recording.name}: no column {name}; the axis of turns by accelerometers needs all three")


def with_axes(
    record: Calibration, recording: Recording, motions: Motions, found: Mapping[str, AxisTurns], accel: Calibration
) -> Calibration:
    """Return the record of turns with scale factors and misalignments in the frame of the accelerometers.

    Raises
    ------
    ObservabilityError
        The unit was not turned about x, y and z.
    DataError
        The accelerometers see another axis upright than that of a turn.
    """
    lacking = [axis for axis in AXES if axis not in found]
    if lacking:
        raise ObservabilityError(
            f"{recording.name}: no turns about {' '.join(lacking)}; accel tells misalignments from turns about x, y "
            "and z: lay the unit on three faces"
        )
    turned = [(axis, k) for axis in range(3) for k in found[AXES[axis]].motion]
    outputs = recording.triad("accel")
    count = np.concatenate([found[axis].count for axis in AXES])
    seen = [_upright(outputs, motions, k, axis, n) for (axis, k), n in zip(turned, count.tolist(), strict=True)]
    force, spread = np.array([mean for mean, _ in seen]), np.array([u for _, u in seen])
    unit = recording.triad_unit("accel")

    def corrected(by: Calibration) -> Array:
        return corrected_means(by, force, unit)

    seen_force = corrected(accel)
    direction = _axes(seen_force, turned, motions, recording.name)
    shifts, correlation = moved_by_parameters(accel, corrected)
    sign = np.sign(np.sum(direction * seen_force, axis=1))[:, None]
    changes = sign * unit_vectors(seen_force + shifts) - direction
    of_length = np.linalg.norm(seen_force, axis=1) * np.linalg.norm(spread, axis=1)
    of_length = np.hypot(of_length, length_uncertainty(seen_force, shifts, correlation))
    places = [f"the turn at {motions.start[k]:.1f} to {motions.stop[k]:.1f} s" for _, k in turned]
    said = length_said(accel, seen_force, of_length, places)
    scale = np.array([found[axis].scale for axis in AXES])
    u_scale = np.array([found[axis].scale_uncertainty for axis in AXES])
    across = np.array([motions.angle[k] for _, k in turned]) / _TURN
    noise = np.array([motions.zero[k] for _, k in turned]) / _TURN
    noise = np.hypot(noise, count[:, None] * spread * scale)
    groups = [np.array([axis == j for axis, _ in turned]) for j in range(3)]

    def gains(of: Array, c: Array, y: Array) -> Array:
        """Return B from the axes, what the composed turns say along their own axis, and the integrals across."""
        sides = np.column_stack([_by_count(of[own], count[own]) for own in groups])
        felt = y.copy()
        for j in range(3):
            felt[j, j] = np.sqrt(c[j] ** 2 - np.sum(np.delete(y[:, j], j) ** 2))
        return np.asarray(felt @ np.linalg.inv(sides))

    crossed = np.column_stack([(count[own] @ across[own]) / (count[own] @ count[own]) for own in groups])
    matrix = gains(direction, scale, crossed)
    u_crossed = np.zeros((3, 3))
    for j, own in enumerate(groups):
        left = across[own] - count[own][:, None] * (direction[own] @ matrix.T)
        u_crossed[:, j] = _scattered(left, count[own], noise[own])
    covariance = _covariance(gains, direction, scale, crossed, u_scale, u_crossed, changes, correlation)
    return replace(_extended(record, matrix, covariance), warnings=(*record.warnings, *said), verdict=UNJUDGED)


def _upright(outputs: Array, motions: Motions, k: int, axis: int, count: float) -> tuple[Array, Array]:
    """Return the mean output along the axis of a turn, shape (3,), and its uncertainty over g by parts of the turn."""
    first, last = motions.span[k]
    step, size = motions.steps[k], np.linalg.norm(motions.steps[k], axis=1)
    angle = np.cumsum(step[:, axis])
    angle *= _TURN * count / angle[-1]
    period = motions.period
    width = max(1, round(_SMOOTH / period))
    rate = np.convolve(step[:, axis], np.full(width, 1 / width), mode="same") / period
    rise = np.gradient(rate)
    columns = [np.ones(len(rate)), np.cos(angle), np.sin(angle), rate**2, rise]
    matrix = np.column_stack([column / max(float(np.abs(column).max()), 1e-300) for column in columns])
    values = (outputs[first + 1 : last + 1] + outputs[first:last]) / 2
    weight = np.sqrt(size / size.max())[:, None]
    normal = np.linalg.pinv((matrix * weight).T @ (matrix * weight))
    found = normal @ (matrix * weight**2).T @ values
    left = (values - matrix @ found) * weight**2
    edges = np.linspace(0, len(left), _BATCHES + 1).astype(np.int64)[:-1]
    scores = np.add.reduceat(left[:, None, :] * matrix[:, :, None], edges, axis=0)
    shift = np.einsum("j,bjk->bk", normal[0], scores)
    return found[0], np.sqrt(np.sum(shift**2, axis=0)) / float(np.linalg.norm(found[0]))


def _axes(force: Array, turned: list[tuple[int, int]], motions: Motions, name: str) -> Array:
    """Return the axis of each turn in the body, of unit length, along the positive axis that it is next to."""
    direction = force / np.linalg.norm(force, axis=1)[:, None]
    for (axis, k), along in zip(turned, direction, strict=True):
        if abs(along[axis]) < _FACE:
            upright = AXES[int(np.argmax(np.abs(along)))]
            raise DataError(
                f"{name}: the turn at {motions.start[k]:.1f} to {motions.stop[k]:.1f} s is about {AXES[axis]} by the "
                f"gyroscopes, but by the accelerometers {upright} is upright; expected turns on a level table"
            )
    signs = [np.sign(along[axis]) for (axis, _), along in zip(turned, direction, strict=True)]
    return np.asarray(direction * np.array(signs)[:, None])


def _by_count(direction: Array, count: Array) -> Array:
    """Return the mean of axes, weighted as the integrals of the turns about them are."""
    return np.asarray(count**2 @ direction / (count @ count))


def _scattered(left: Array, count: Array, noise: Array) -> Array:
    """Return the uncertainty of slopes over turns made, of three gyroscopes; by the scatter where it exceeds noise."""
    noise = np.maximum(noise, _EXACT * np.abs(count)[:, None])  # data without noise leave rounding
    variance = (count**2 @ noise**2) / (count @ count) ** 2
    freedom = len(count) - 1
    if not freedom:
        return np.asarray(np.sqrt(variance))
    chi_square = np.sum((left / noise) ** 2, axis=0)
    beyond = np.array([chi_square_probability(float(value), freedom) < _CHANCE for value in chi_square])
    return np.asarray(np.sqrt(variance * np.where(beyond, chi_square / freedom, 1.0)))


def _values(matrix: Array) -> Array:
    """Return scale factors and then misalignments of ``B = diag(S) T``, shape (9,)."""
    scale = np.diag(matrix)
    turn = matrix / scale[:, None]
    return np.concatenate([scale, turn[~np.eye(3, dtype=bool)]])


def _covariance(
    gains: Callable[[Array, Array, Array], Array], direction: Array, scale: Array, crossed: Array, u_scale: Array,
    u_crossed: Array, changes: Array, correlation: Array,
) -> Array:  # fmt: skip
    """Return the covariance of `_values` by stops, by integrals across, and by the accelerometers' record."""
    at = _values(gains(direction, scale, crossed))
    rows = []
    for j in range(3):
        moved = scale.copy()
        moved[j] += u_scale[j]
        rows.append(_values(gains(direction, moved, crossed)) - at)
        for i in range(3):
            if i != j:
                other = crossed.copy()
                other[i, j] += u_crossed[i, j]
                rows.append(_values(gains(direction, scale, other)) - at)
    own = np.array(rows)
    of_record = np.array([_values(gains(direction + change, scale, crossed)) - at for change in changes])
    of_record = of_record.reshape(-1, len(at))
    return np.asarray(own.T @ own + of_record.T @ correlation @ of_record)


def _extended(record: Calibration, matrix: Array, covariance: Array) -> Calibration:
    """Return the record of turns with these scale factors, misalignments and their covariance."""
    unit = str(record.model["gyro_output_unit"])
    clock = float(record.fit["clock"] or 0.0)
    values = _values(matrix) * np.concatenate([np.full(3, from_si(1.0, unit)), np.ones(6)])
    factor = values / _values(matrix)
    names = [f"gyro_scale_factor_{a}" for a in AXES]
    names += [f"gyro_misalignment_{a}{b}" for a in AXES for b in AXES if a != b]
    common = np.where(np.arange(9) < 3, values, 0.0) * clock
    joined = covariance * np.outer(factor, factor) + np.outer(common, common)
    biases = {name: p for name, p in record.parameters.items() if name.startswith("gyro_bias")}
    parameters = dict(biases)
    for name, value, u in zip(names, values.tolist(), np.sqrt(np.diag(joined)).tolist(), strict=True):
        before = record.parameters.get(name)
        interval = None if before is None else before.interval_95
        if before is not None and interval is not None and before.standard_uncertainty:
            wide = (interval[1] - interval[0]) / 2 / before.standard_uncertainty * u
            interval = (value - wide, value + wide)
        kind = "rad" if "misalignment" in name else f"{unit}/(rad/s)"
        parameters[name] = Parameter(value, u, kind, interval_95=interval)
    whole = np.zeros((len(parameters),) * 2)
    whole[:3, :3] = record.covariance.block(list(biases))
    whole[3:, 3:] = joined
    return replace(
        record,
        parameters=parameters,
        covariance=Covariance(tuple(parameters), tuple(map(tuple, whole.tolist()))),
        model={**record.model, "frame": BY_ACCELEROMETERS},
    )

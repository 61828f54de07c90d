"""From a recording of a board to what is fitted: rests, samples in motion, and a board to start from."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise, permutations, product

import numpy as np
from numpy.typing import NDArray

from imulab.display import Finding, Note
from imulab.errors import DataError, ObservabilityError, UnitError
from imulab.estimation.clock import GAP
from imulab.estimation.rows import FAR, REPEATED, LeftOut, leave_out, medians, stuck_message, stuck_run
from imulab.procedures.gyro_array.alignment import align, nominal_orientation
from imulab.procedures.gyro_array.imus.model import ACCEL, GYRO, GYRO_BIAS, NUMBERS, POSITION, RATE, Board, lever
from imulab.procedures.gyro_array.imus.solve import Measured
from imulab.recording import Array, Recording, check_time
from imulab.units import parse_unit

_WINDOW = 0.5  # s
_QUIET, _THIRD = 3.0, 1 / 30  # times the scatter of the quietest parts, of which a share of three percent
MOVING = math.radians(30.0)
"""Root mean square of the rate in a window from which the board moves, rad/s."""
_BESIDE = 4  # samples beside a reading at its limit, or a gap
_FEWEST, _SHORTEST = 300, 6  # samples in motion, and of an unbroken run of them
_FEW_LOST = 0.01  # share of rows without a reading up to which it is a note
_RARER = 0.5  # times as often as throughout: repeats in motion, where those at rest are chance
_LONGEST_TURN, _FEWEST_TURNS = 30.0, 3  # s from rest to rest
_LEAST_TURN, _UNLIKE_TURN = math.radians(20.0), math.radians(25.0)
_UNLIKE_G, _UNLIKE_RATE, _SKEW = 0.2, 0.3, 3.0
_NUMBERED = re.compile(r"(accel|gyro)_([xyz])_([1-9][0-9]*)")


@dataclass(frozen=True)
class Prepared:
    """What is fitted, a start, and what the recording is like.

    Attributes
    ----------
    measured, start, motion
        For `solve`.
    time, broken
        Of all samples: s, and which have a gyroscope at its limit or stand beside a gap.
    rests
        First and one past the last sample of each rest, shape (rests, 2).
    clipped
        Share of the samples in motion that have a reading at its limit.
    duration, rate
        Of the motion that is used, s, and of the samples, Hz.
    axis_rates
        Root mean square of the rate about each axis in motion, rad/s, shape (3,).
    notes
        What was left out.
    correlation
        By what the noise of accelerometers and of gyroscopes in `measured` is larger than at rest, because a filter
        makes it alike from sample to sample.
    """

    measured: Measured
    start: Board
    motion: Array
    time: Array
    broken: NDArray[np.bool_]
    rests: NDArray[np.intp]
    clipped: float
    duration: float
    rate: float
    axis_rates: Array
    notes: tuple[str, ...]
    correlation: tuple[float, float] = (1.0, 1.0)


def names_of(recording: Recording) -> Mapping[str, list[list[str]]]:
    """Return the columns of accelerometers and gyroscopes by IMU and axis.

    Raises
    ------
    DataError
        Fewer than two IMUs, or one lacks an axis.
    UnitError
        A column has a unit of something else.
    """
    numbers = {int(m[3]) for name in recording.columns if (m := _NUMBERED.fullmatch(name))}
    count = max(numbers, default=0)
    names = {
        sensor: [[f"{sensor}_{axis}_{k + 1}" for axis in "xyz"] for k in range(count)] for sensor in ("accel", "gyro")
    }
    if count < 2 and "accel_x" in recording and "gyro_x" in recording:
        raise DataError(
            f"{recording.name}: one IMU, accel_x .. gyro_z; expected two or more, accel_x_1 .. gyro_z_K, on one clock "
            "(of a log of PX4 or ArduPilot all instances: --instance all)"
        )
    if count < 2:
        raise DataError(
            f"{recording.name}: expected columns accel_x_1 .. accel_z_K and gyro_x_1 .. gyro_z_K of two or more IMUs; "
            f"found {' '.join(list(recording.columns)[:12])}"
        )
    for sensor, quantity in (("accel", "acceleration"), ("gyro", "rate")):
        for name in (name for triad in names[sensor] for name in triad):
            if name not in recording:
                raise DataError(f"{recording.name}: no column {name}; expected {count} whole IMUs, numbered from 1")
            if parse_unit(recording.units[name]).quantity != quantity:
                raise UnitError(
                    f"{recording.name}: column {name}: {recording.units[name]}: expected a unit of {quantity}"
                )
    return names


def prepare(recording: Recording, gravity: float) -> Prepared:
    """Return the rests, the samples in motion and a start.

    Raises
    ------
    DataError
        A dead sensor or a wrong unit, no rest, too little or too clipped motion.
    ObservabilityError
        The motion does not turn about every axis.
    """
    names = names_of(recording)
    flat = [name for sensor in names.values() for triad in sensor for name in triad]
    recording, notes = _finite(recording, flat)
    time = check_time(recording)
    _check_alive(recording, flat)
    accel, gyro = (
        np.stack([np.stack([recording.si(name) for name in triad], axis=1) for triad in names[sensor]], axis=1)
        for sensor in ("accel", "gyro")
    )
    step = float(np.median(np.diff(time)))
    size = max(4, round(_WINDOW / step))
    rests, still = _rests(accel, gyro, size)
    if not rests:
        raise DataError(f"{recording.name}: no rest of {_WINDOW:g} s; expected a board that lies still between motions")
    _check_units(recording, accel, rests, gravity)
    at_limit, gyro_limit = _at_limit(recording, flat), _at_limit(recording, flat[len(flat) // 2 :])
    gap = _after_gap(time, step)
    bias = np.concatenate([gyro[part] for part in rests]).mean(axis=0)
    turning = _moving(gyro - bias, size) & ~still
    bad, more = _no_readings(recording, [triad for sensor in names.values() for triad in sensor], rests, turning)
    _check_frames(recording, time, (accel, gyro - bias), rests, gyro_limit | gap | bad)
    first, kept = _runs(turning & ~_spread(at_limit | gap | bad, _BESIDE))
    clipped = float((at_limit & turning).sum() / max(turning.sum(), 1))
    if len(kept) < _FEWEST:
        raise DataError(
            f"{recording.name}: {len(kept)} samples in motion without a reading at its limit; expected {_FEWEST} or "
            f"more, turned and shaken by hand above {math.degrees(MOVING):.0f} deg/s"
        )
    noise = [np.sqrt(np.mean([readings[part].var(axis=0) for part in rests], axis=0)) for readings in (accel, gyro)]
    floor = [np.maximum(each, 0.1 * each.mean()) for each in noise]
    sensing = _sensing(recording, gyro[kept] - bias, floor[1])
    measured = Measured(
        _splines(time, accel), _splines(time, gyro), time[kept], first,
        np.array([accel[part].mean(axis=0) for part in rests]), np.array([gyro[part].mean(axis=0) for part in rests]),
        np.array([part.stop - part.start for part in rests], dtype=np.float64), floor[0], floor[1],
        np.array([nominal_orientation(each) for each in sensing]), gravity,
    )  # fmt: skip
    start, motion = _start(measured, sensing, bias)
    return Prepared(
        measured, start, motion, time, gyro_limit | gap | bad, np.array([[part.start, part.stop] for part in rests]),
        clipped, len(kept) * step, 1 / step,
        np.sqrt(np.square(motion[:, RATE]).mean(axis=0)), (*notes, *more),
    )  # fmt: skip


def _finite(recording: Recording, names: list[str]) -> tuple[Recording, list[str]]:
    """Return the recording without rows that have no finite reading, and what to say of them."""
    good = np.logical_and.reduce([np.isfinite(recording.columns[name]) for name in names])
    count = int((~good).sum())
    if not count:
        return recording, []
    if not good.any():
        raise DataError(f"{recording.name}: no row has a finite reading of every IMU")
    kind = Note if count < _FEW_LOST * len(good) else Finding
    message = f"{count} of {len(good)} rows left out: not finite, first at {recording.place(int(np.argmin(good)))}"
    columns = {name: values[good] for name, values in recording.columns.items()}
    return replace(recording, columns=columns), [kind(message, "check the link to the sensors, and record again")]


def _no_readings(
    recording: Recording, triads: list[list[str]], rests: list[slice], turning: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], list[str]]:
    """Return the rows in which a triad repeats itself or reads zeros, and what to say of them.

    Repeats that are rarer in motion are chance, as quiet and coarse sensors repeat themselves at rest.
    """
    bad, notes = np.zeros(len(recording), dtype=bool), []
    at_rest = np.zeros(len(recording), dtype=bool)
    for part in rests:
        at_rest[part] = True
    for triad in triads:
        left_out = leave_out(recording, triad)
        repeats = left_out.kinds.get(REPEATED)
        if repeats is not None and repeats[turning].sum() < _RARER * turning.mean() * repeats.sum():
            kinds = {kind: rows for kind, rows in left_out.kinds.items() if kind != REPEATED}
            left_out = LeftOut(left_out.recording, left_out.names, kinds)
        for kind, rows in left_out.kinds.items():
            bad |= rows & (at_rest if kind == FAR else True)
        notes += left_out.notes(at_rest)
    return bad, notes


def _check_alive(recording: Recording, names: list[str]) -> None:
    """Refuse columns that stand still throughout, or for a second or more while others move."""
    for name in names:
        values = recording.columns[name]
        if np.ptp(values) == 0:
            raise DataError(
                f"{recording.name}: column {name}: all samples are {values[0]:g}: a dead sensor; leave its IMU out"
            )
        others = [recording.columns[other] for other in names if other[:4] == name[:4] and other != name]
        if (run := stuck_run(values, others, moving=True)) is not None:
            raise DataError(f"{recording.name}: {stuck_message(recording, name, run)}; leave its IMU out")


def _check_units(recording: Recording, accel: Array, rests: list[slice], gravity: float) -> None:
    """Refuse accelerometers whose magnitude at rest cannot be gravity in the unit of their columns."""
    length = np.median([np.linalg.norm(accel[part].mean(axis=0), axis=1) for part in rests], axis=0)
    wrong = np.flatnonzero(np.abs(length / gravity - 1) > _UNLIKE_G)
    if wrong.size:
        k = int(wrong[0])
        raise DataError(
            f"{recording.name}: accelerometers of IMU {k + 1}: {length[k]:.4g} m/s^2 at rest; expected gravity, "
            f"{gravity:.4g} m/s^2: is the unit of accel_x_{k + 1} .. accel_z_{k + 1} right (--unit), or its range?"
        )


def _check_frames(
    recording: Recording, time: Array, readings: tuple[Array, Array], rests: list[slice], broken: NDArray[np.bool_]
) -> None:
    """Refuse an IMU whose gyroscopes have another unit, or other axes, than its accelerometers.

    The gyroscopes must turn gravity from rest to rest as the accelerometers read it. Where they do not, but would with
    another unit, or with axes exchanged or reversed, that is the reason. `readings` are accelerations and rates.
    """
    accel, gyro = readings
    pairs = [
        (before, after, slice(before.stop - 1, after.start + 1))
        for before, after in pairwise(rests)
        if not broken[before.stop - 1 : after.start + 1].any() and time[after.start] - time[before.stop] < _LONGEST_TURN
    ]
    for k in range(accel.shape[1]):
        ends = [(_direction(accel[before, k]), _direction(accel[after, k])) for before, after, _ in pairs]
        turns = [
            (time[part], gyro[part, k], begin, end)
            for (begin, end), (_, _, part) in zip(ends, pairs, strict=True)
            if float(begin @ end) < math.cos(_LEAST_TURN)
        ]
        if len(turns) < _FEWEST_TURNS or (off := _misfit(turns, np.eye(3))) < _UNLIKE_TURN:
            continue
        best = min(_FRAMES, key=lambda frame: _misfit(turns, frame.factor * frame.axes))
        if _misfit(turns, best.factor * best.axes) < off / 3:
            raise DataError(
                f"{recording.name}: gyroscopes and accelerometers of IMU {k + 1} disagree by {math.degrees(off):.0f} "
                f"deg on how gravity turns from rest to rest; they agree {best.words(k + 1)}"
            )


@dataclass(frozen=True)
class _Frame:
    """What gyroscopes may read instead of the rate: ``rate = factor axes reading``."""

    factor: float
    axes: Array

    def words(self, number: int) -> str:
        """Return how the columns of an IMU would be right, and what to check."""
        names = [f"gyro_{axis}_{number}" for axis in "xyz"]
        if self.factor != 1.0:
            size = f"{1 / self.factor:.3g} times too large" if self.factor < 1 else f"{self.factor:.3g} times too small"
            turned = "" if np.array_equal(self.axes, np.eye(3)) else ", with other axes"
            return f"if {names[0]} .. {names[2]} are {size}{turned}: is their unit right (--unit)?"
        read = [f"{'-' if row.sum() < 0 else ''}{names[int(np.abs(row).argmax())]}" for row in self.axes]
        right = ", ".join(
            f"{axis} is {name}" for axis, name in zip("xyz", read, strict=True) if name not in names or name[5] != axis
        )
        hand = "" if np.linalg.det(self.axes) > 0 else " (left-handed)"
        return f"if {right}{hand}: are columns of either exchanged, or signs reversed?"


_FRAMES = tuple(
    _Frame(factor, np.diag(signs)[list(order)].astype(np.float64))
    for factor in (1.0, math.pi / 180, 180 / math.pi)
    for order in permutations(range(3))
    for signs in product((1, -1), repeat=3)
)


def _direction(readings: Array) -> Array:
    mean = readings.mean(axis=0)
    return np.asarray(mean / np.linalg.norm(mean))


def _misfit(turns: list[tuple[Array, Array, Array, Array]], frame: Array) -> float:
    """Return the median angle between gravity after a turn and where the rates turn it, rad."""
    from scipy.spatial.transform import Rotation

    angles = []
    for time, rate, begin, end in turns:
        turn = Rotation.from_rotvec(-(rate[1:] + rate[:-1]) / 2 * np.diff(time)[:, None] @ frame.T)
        while len(turn) > 1:
            last = turn[-1:] if len(turn) % 2 else None
            turn = turn[1::2] * turn[: len(turn) - 1 : 2]
            turn = turn if last is None else Rotation.concatenate([turn, last])
        angles.append(math.acos(float(np.clip(turn[0].apply(begin) @ end, -1.0, 1.0))))
    return float(np.median(angles))


def _sensing(recording: Recording, rate: Array, noise: Array) -> Array:
    """Return the gyroscopes' matrices, shape (K, 3, 3), from their alignment; `rate` has shape (n, K, 3)."""
    unseen = ObservabilityError(
        f"{recording.name}: the motion does not turn about every axis, so that positions and gyroscopes' matrices "
        "cannot be told; turn the board about all three axes"
    )
    size = np.sqrt(np.square(rate).sum(2).mean(0))
    unlike = np.flatnonzero(np.abs(size / np.median(size) - 1) > _UNLIKE_RATE)
    if unlike.size:
        k = int(unlike[0])
        raise DataError(
            f"{recording.name}: gyroscopes of IMU {k + 1} read {size[k] / np.median(size):.3g} times the rate of the "
            f"others: is the unit of gyro_x_{k + 1} .. gyro_z_{k + 1} right, or is a sensor dead?"
        )
    try:
        sensing = align(np.moveaxis(rate, 1, 2), noise.T, strict=False).sensing
    except np.linalg.LinAlgError:
        raise unseen from None
    if not np.isfinite(sensing).all() or np.linalg.cond(sensing).max() > _SKEW:
        raise unseen
    return sensing


def _splines(time: Array, readings: Array) -> list[object]:
    from scipy.interpolate import make_interp_spline

    return [make_interp_spline(time, readings[:, k], k=5) for k in range(readings.shape[1])]


def _windows(readings: Array, size: int) -> Array:
    """Return readings in windows of half the size beside each other, shape (windows, size, ...)."""
    count = len(readings) // size
    return readings[: count * size].reshape(count, size, *readings.shape[1:])


def _rests(accel: Array, gyro: Array, size: int) -> tuple[list[slice], NDArray[np.bool_]]:
    """Return the rests, stretches of quiet windows less one at either end, and the samples of quiet windows."""
    quiet = np.ones(len(accel) // size, dtype=bool)
    for readings in (accel, gyro):
        scatter = np.sqrt(_windows(readings, size).var(axis=1).mean(axis=(1, 2)))
        quiet &= scatter < _QUIET * np.quantile(scatter, _THIRD)
    still = np.zeros(len(accel), dtype=bool)
    still[: len(quiet) * size] = np.repeat(quiet, size)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], quiet, [False]]).astype(np.int8)))
    begins, ends = edges[::2], edges[1::2]
    parts = []
    for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
        cut = 1 if end - begin > 3 else 0
        if end - begin - 2 * cut >= 2:
            parts.append(slice((begin + cut) * size, (end - cut) * size))
    return parts, still


def _moving(rate: Array, size: int) -> NDArray[np.bool_]:
    """Return the samples in windows that turn, by the median IMU."""
    square = medians(np.square(rate).sum(axis=2)) if rate.shape[1] > 2 else np.square(rate).sum(axis=2).mean(axis=1)
    windows = np.sqrt(_windows(square, size).mean(axis=1)) > MOVING
    moving = np.zeros(len(rate), dtype=bool)
    moving[: len(windows) * size] = np.repeat(windows, size)
    return moving


def _at_limit(recording: Recording, names: list[str]) -> NDArray[np.bool_]:
    """Return the samples at which some reading stands at the end of its range, several in a row at least once."""
    clipped = np.zeros(len(recording), dtype=bool)
    for name in names:
        values = recording.columns[name]
        for extreme in (values.min(), values.max()):
            at = values == extreme
            if (at[1:] & at[:-1]).any():
                clipped |= at
    return clipped


def _after_gap(time: Array, step: float) -> NDArray[np.bool_]:
    gap = np.diff(time) > GAP * step
    return np.asarray(np.append(gap, False) | np.insert(gap, 0, False))


def _spread(at: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    return np.asarray(np.convolve(at, np.ones(2 * reach + 1), mode="same") > 0.5)


def _runs(fine: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return where each unbroken run of the kept samples begins among them, and the kept samples."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], fine, [False]]).astype(np.int8)))
    runs = [(a, b) for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True) if b - a >= _SHORTEST]
    if not runs:
        return np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    first = np.cumsum([0, *(b - a for a, b in runs[:-1])])
    return first, np.concatenate([np.arange(a, b) for a, b in runs])


def _start(measured: Measured, sensing: Array, bias: Array) -> tuple[Board, Array]:
    """Return a board from the gyroscopes' alignment and, for the positions, one linear least squares for each IMU."""
    count = measured.count
    numbers = np.zeros((count, NUMBERS))
    numbers[:, ACCEL] = measured.nominal.reshape(count, 9)
    numbers[:, GYRO] = sensing.reshape(count, 9)
    numbers[:, GYRO_BIAS] = bias
    accel, gyro = measured.at(Board(numbers))
    inverse = np.linalg.inv(sensing)
    rate = np.einsum("kij,nkj->ni", inverse, gyro - bias) / count
    motion = np.zeros((len(rate), 9))
    motion[:, 6:9] = rate
    motion[:, 3:6] = _slope(measured, rate)
    forces = np.einsum("kji,nkj->nki", measured.nominal, accel)
    by_position = lever(rate, motion[:, 3:6])
    n = len(rate)
    others = np.zeros((n, 3, 12))
    for row in range(3):
        others[:, row, 3 * row : 3 * row + 3] = forces[:, 0]
        others[:, row, 9 + row] = 1.0
    design = np.concatenate([by_position, others], axis=2).reshape(3 * n, 15)
    for k in range(1, count):
        numbers[k, POSITION] = np.linalg.lstsq(design, (forces[:, k] - forces[:, 0]).ravel(), rcond=None)[0][:3]
    by_lever = np.einsum("nij,kj->nki", by_position, numbers[:, POSITION])
    motion[:, 0:3] = (forces - by_lever).mean(axis=1)
    return Board(numbers), motion


def _slope(measured: Measured, values: Array) -> Array:
    slope = np.zeros_like(values)
    for begin, end in zip(measured.first.tolist(), [*measured.first[1:].tolist(), len(values)], strict=True):
        slope[begin:end] = np.gradient(values[begin:end], measured.time[begin:end], axis=0)
    return slope

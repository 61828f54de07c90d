"""Files of one gyroscope each, joined by time into the recording of an array."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from imulab.columns import kind_of, triad
from imulab.display import Finding, Note, Shown
from imulab.errors import DataError, UnitError
from imulab.estimation.clock import read_clock
from imulab.estimation.sampling import WIDEST_GAP
from imulab.procedures.gyro_array.elements import MOST_ELEMENTS
from imulab.recording import Array, Recording, check_time
from imulab.units import conversion_factor, parse_unit

_MOST_POINTS = 1 << 20  # of the common time over which recordings are correlated
_FEWEST_POINTS, _FEWEST_LEVELS = 100, 8  # samples, and different readings, of recordings that can be correlated
_LEAST_MOTION = 1e-6  # of the variance of the whole: less is no motion
_ALIKE = 0.8  # correlation from which two recordings show one motion
_SECOND = 0.9  # of the best correlation: a second maximum this high leaves the offset open


@dataclass(frozen=True, repr=False)
class Merged(Shown):
    """The recording of the array, and notes on how its elements were joined."""

    recording: Recording
    notes: tuple[str, ...]

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return what was joined, and the notes."""
        gyros = sum(kind_of(name) == "gyro" for name in self.recording.columns)
        return f"{len(self.recording)} samples, {gyros} gyros", ["note"], [[note] for note in self.notes]


def merge_recordings(
    recordings: Sequence[Recording], *, axis: str | None = None, column: str | None = None, align: bool = False
) -> Merged:
    """Join recordings of one gyroscope each to one of an array, by time.

    The rows are those of the first recording that lie within the time of all. The others are interpolated to them,
    linearly; in a gap of more than 10 of their sampling intervals they are NaN. Nothing is extrapolated.

    Parameters
    ----------
    recordings
        At least two, on clocks that agree unless `align` is chosen.
    axis
        ``x``, ``y`` or ``z``: take this axis of each; all three (or the only one) if not given.
    column
        Take the column of this name instead.
    align
        Move the clocks so that the motion of each recording fits that of the first.

    Raises
    ------
    DataError
        There is only one recording, or one twice; a recording has no gyroscope or no time; they have no time in
        common; `align` finds no motion that fits.
    UnitError
        The units of two gyroscopes cannot be converted to each other.
    """
    if not 2 <= len(recordings) <= MOST_ELEMENTS:
        raise DataError(f"expected 2 to {MOST_ELEMENTS} recordings, a gyroscope each, found {len(recordings)}")
    _refuse_twice(recordings)
    names = [_gyro_columns(recording, axis, column) for recording in recordings]
    first = recordings[0]
    for recording, gyro_names in zip(recordings, names, strict=True):
        if len(gyro_names) != len(names[0]):
            raise DataError(
                f"{recording.name}: {_axes(gyro_names)}, but {first.name} has {_axes(names[0])}; "
                "--axis x, y or z takes one axis of each"
            )
    times = [_time(recording) for recording in recordings]
    values = [_convert_units(first, names[0], r, gyro_names) for r, gyro_names in zip(recordings, names, strict=True)]
    notes: list[str] = []
    for i in range(1, len(recordings)):
        name, offset = recordings[i].name, _clock_offset(times[0], values[0], times[i], values[i])
        if align:
            if offset is None:
                raise DataError(f"{name}: --align: found no motion that fits {first.name} at one offset of time only")
            times[i] = times[i] - offset
            notes.append(Note(f"{name}: moved by {-offset:+.6g} s, where its motion fits that of {first.name}"))
        elif offset is not None and abs(offset) > max(read_clock(times[k]).step for k in (0, i)):
            later = f"{abs(offset):.4g} s {'later' if offset > 0 else 'earlier'}"
            notes.append(
                Finding(
                    f"{name}: its motion comes {later} than that of {first.name}: the clocks differ; --align moves it",
                    "merge with --align",
                )
            )
    start, stop = max(t[0] for t in times), min(t[-1] for t in times)
    rows = np.flatnonzero((times[0] >= start) & (times[0] <= stop))
    if not rows.size:
        i = int(np.argmax([max(t[0] - times[0][-1], times[0][0] - t[-1]) for t in times]))
        raise DataError(
            f"{recordings[i].name}: {times[i][0]:.9g} to {times[i][-1]:.9g} s, no time in common with {first.name}, "
            f"{times[0][0]:.9g} to {times[0][-1]:.9g} s; clocks that began apart are moved by --align"
        )
    for recording, time in zip(recordings[1:], times[1:], strict=True):
        notes += _note_joining(recording, time, times[0], times[0][rows])
    columns, units = {"time": first.column("time")[rows]}, {"time": first.units["time"]}
    for i, (time, readings) in enumerate(zip(times, values, strict=True), start=1):
        joined = readings[rows] if i == 1 else _interpolate(times[0][rows], time, readings)
        for k, name in enumerate(names[0]):
            title = f"gyro_{'xyz'[k]}_{i}" if len(names[0]) > 1 else f"gyro_{i}"
            columns[title], units[title] = np.ascontiguousarray(joined[:, k]), first.units[name]
    merged = Recording(
        columns=columns,
        units=units,
        metadata=_head(recordings),
        name="the merged recording",
        corrected_by=tuple(dict.fromkeys(entry for recording in recordings for entry in recording.corrected_by)),
        from_file=all(recording.from_file for recording in recordings),
    )
    return Merged(merged, tuple(notes))


def _head(recordings: Sequence[Recording]) -> dict[str, str]:
    """Return the entries on which all heads agree, without a truth, and each element's own file and serial."""
    first = recordings[0].metadata
    head = {
        key: text
        for key, text in first.items()
        if not key.startswith("truth_") and all(recording.metadata.get(key) == text for recording in recordings)
    }
    serials = [recording.metadata.get("serial", "unknown") for recording in recordings]
    if len(set(serials)) > 1:
        head["element_serials"] = " ".join(serials)
    return head | {f"element_{i}": Path(recording.name).name for i, recording in enumerate(recordings, start=1)}


def _refuse_twice(recordings: Sequence[Recording]) -> None:
    name_of_digest: dict[str, str] = {}
    for recording in recordings:
        digest = recording.source.sha256 if recording.source else ""
        if digest and digest in name_of_digest:
            same = (
                "given twice"
                if name_of_digest[digest] == recording.name
                else f"the same file as {name_of_digest[digest]}"
            )
            raise DataError(f"{recording.name}: {same}; expected a file for each gyroscope")
        name_of_digest[digest] = recording.name


def _gyro_columns(recording: Recording, axis: str | None, column: str | None) -> list[str]:
    """Return the columns of the gyroscope: three, or one."""
    if column is not None or axis is not None:
        name = column if column is not None else f"gyro_{axis}"
        recording.column(name)
        quantity = parse_unit(recording.units[name]).quantity
        if quantity not in ("rate", "output"):
            raise UnitError(f"{recording.name}: column {name} is in {recording.units[name]}; expected a rate")
        return [name]
    axes = [name for name in triad("gyro") if name in recording]
    gyros = axes or [name for name in recording.columns if kind_of(name) == "gyro"]
    if not gyros:
        raise DataError(
            f"{recording.name}: no gyroscope; expected gyro_x gyro_y gyro_z or one column gyro, found "
            f"{' '.join(recording.columns)}; --column NAME says which column it is"
        )
    if len(gyros) not in (1, 3) or (len(gyros) == 3 and not axes):
        raise DataError(
            f"{recording.name}: found {' '.join(gyros)}; expected one gyroscope in each file; "
            "--column NAME says which column it is"
        )
    return gyros


def _axes(names: Sequence[str]) -> str:
    return "three axes" if len(names) == 3 else "one axis"


def _time(recording: Recording) -> Array:
    if "time" not in recording:
        recording.column("time")  # raises the message of a missing column
    time = check_time(recording)
    if len(time) < 2:
        raise DataError(f"{recording.name}: a single sample; expected a recording")
    return time


def _convert_units(first: Recording, wanted: Sequence[str], recording: Recording, names: Sequence[str]) -> Array:
    """Return the readings in the units of the first recording, shape (n, axes)."""
    columns = []
    for name, target in zip(names, wanted, strict=True):
        try:
            factor = conversion_factor(recording.units[name], first.units[target])
        except UnitError as error:
            raise UnitError(f"{recording.name}: column {name}: {error}, the unit of {first.name}") from None
        columns.append(recording.columns[name] * factor)
    return np.column_stack(columns)


def _interpolate(wanted: Array, time: Array, values: Array) -> Array:
    """Return readings at other times, shape (m, axes); NaN across gaps."""
    values_wanted = np.column_stack([np.interp(wanted, time, column) for column in values.T])
    away, across = _distance_to_samples(wanted, time)
    values_wanted[across & (away > 0)] = np.nan
    return values_wanted


def _distance_to_samples(wanted: Array, time: Array) -> tuple[Array, np.ndarray]:
    """Return the distance of times, shape (m,), to the nearest sample, s, and whether they lie in a wide gap."""
    right = np.clip(np.searchsorted(time, wanted), 1, len(time) - 1)
    away = np.minimum(np.abs(time[right] - wanted), np.abs(wanted - time[right - 1]))
    return away, time[right] - time[right - 1] > WIDEST_GAP * read_clock(time).step


def _note_joining(recording: Recording, time: Array, clock: Array, wanted: Array) -> list[str]:
    """Return a note on the two rates, and how far the recording's samples lie from the common times."""
    away, across = _distance_to_samples(wanted, time)
    most = float(away[~across].max(initial=0.0))
    if most == 0:
        return []
    rates = [read_clock(t).rate for t in (time, clock)]
    return [
        Note(
            f"{recording.name}: {rates[0]:.6g} Hz interpolated to the times of the first file, {rates[1]:.6g} Hz, "
            f"which lie up to {most:.2g} s from its own samples"
        )
    ]


def _clock_offset(time: Array, values: Array, other: Array, others: Array) -> float | None:
    """Return by how much the other clock shows the same motion later, s; None where no single offset fits clearly.

    The size of the rate does not depend on how a gyroscope is mounted; it is correlated over all shifts that leave half
    of the shorter recording.
    """
    step = max(read_clock(time).step, read_clock(other).step)
    step = max(step, max(time[-1] - time[0], other[-1] - other[0]) / _MOST_POINTS)
    a, b = _size_of_rate(time, values, step), _size_of_rate(other, others, step)
    shorter = min(len(a), len(b))
    if shorter < _FEWEST_POINTS or not (_is_moving(values) and _is_moving(others)):
        return None
    length = 1 << (len(a) + len(b)).bit_length()

    def correlated(p: Array, q: Array) -> Array:
        spectrum = np.fft.rfft(q, length) * np.conj(np.fft.rfft(p, length))
        both = np.fft.irfft(spectrum, length)
        return np.concatenate([both[length - len(a) + 1 :], both[: len(b)]])

    ones = [np.ones(len(a)), np.ones(len(b))]
    count = np.maximum(np.round(correlated(ones[0], ones[1])), 1)
    mean_a, mean_b = correlated(a, ones[1]) / count, correlated(ones[0], b) / count
    power_a = correlated(a**2, ones[1]) / count - mean_a**2
    power_b = correlated(ones[0], b**2) / count - mean_b**2
    # Where one of the two hardly changes there is no motion to compare, and no correlation.
    moves = (power_a > _LEAST_MOTION * a.var()) & (power_b > _LEAST_MOTION * b.var()) & (count >= shorter / 2)
    together = correlated(a, b) / count - mean_a * mean_b
    spread = np.sqrt(np.where(moves, power_a, 1.0)) * np.sqrt(np.where(moves, power_b, 1.0))
    alike = np.where(moves, together / spread, -1.0)
    best = int(np.argmax(alike))
    if alike[best] < _ALIKE:
        return None
    below = np.flatnonzero(alike < alike[best] / 2)
    left, right = below[below < best], below[below > best]
    outside = np.concatenate([alike[: left[-1] if left.size else 0], alike[right[0] if right.size else len(alike) :]])
    if outside.size and outside.max() > _SECOND * alike[best]:
        return None  # a motion that repeats fits at several offsets
    shift = float(best - (len(a) - 1))
    if 0 < best < len(alike) - 1:
        left_of, peak, right_of = alike[best - 1 : best + 2]
        curve = left_of - 2 * peak + right_of
        shift += 0.5 * (left_of - right_of) / curve if curve < 0 else 0.0
    return float(other[0] - time[0] + shift * step)


def _is_moving(values: Array) -> bool:
    """Return whether readings, shape (n, axes), take more values than the last digits of a gyroscope at rest."""
    return any(len(np.unique(column[np.isfinite(column)])) >= _FEWEST_LEVELS for column in values.T)


def _size_of_rate(time: Array, values: Array, step: float) -> Array:
    """Return the size of the rate, without its median, at even steps of time."""
    grid = np.arange(time[0], time[-1], step)
    size = np.zeros(len(grid))
    for column in values.T:
        known = np.isfinite(column)
        if known.any():
            size += (np.interp(grid, time[known], column[known]) - np.median(column[known])) ** 2
    return np.sqrt(size)

"""Rows of a log at rest that are no readings, and units that cannot be right.

Sources: data sheets of InvenSense and Bosch (16 bits over 125 to 2000 deg/s) and ST (4.375 to 70 mdeg/s) for the steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from imulab.columns import kind_of, triad
from imulab.display import Bad, Finding, Note
from imulab.errors import DataError
from imulab.estimation.decisions import COLUMN_STUCK
from imulab.estimation.likely_unit import STATE_UNIT, no_gravity
from imulab.estimation.rows import count_changes, deviation_of_steps, distinct, long_runs, median, resolution
from imulab.estimation.sampling import FEW
from imulab.recording import Array, Recording, stored_as
from imulab.units import to_si

# Whether the unit of samples at rest can be right: by the steps of known sensors, gravity and the Earth's rate.


_MOST_SAMPLES, _OF_STEPS = 100_000, 20_000  # samples that are used; samples that show the step of an output
_STEPS = (*(full / 32768 for full in (125, 250, 500, 1000, 2000)), *(1 / lsb for lsb in (262.4, 131, 65.5, 32.8, 16.4)),
          0.004375, 0.00875, 0.0175, 0.035, 0.07)  # fmt: skip
"""deg/s, steps of 16-bit gyroscopes in use."""
_ALIKE = 1e-3  # relative: a step of the output this near to a known sensor's is that sensor's
_LOUDEST_GYRO, _QUIET = 0.3, 0.035
"""deg/s/sqrt(Hz), more noise than any gyroscope in use; deg/sqrt(h), so little that the Earth's rate shows."""
_EARTH, _PLAIN_OFFSET = (4.0, 100.0), 10.0
"""deg/h that three such gyroscopes show at rest: the Earth's 15 and their offsets. Zeroed ones, whose mean is within
ten standard uncertainties of 0, are passed over."""


def doubtful_units(recording: Recording, names: Sequence[str], rate: float) -> list[str]:
    """Return findings on units that are wrong, from the first samples of a recording at rest, at a rate, Hz."""
    notes: list[str] = []
    for kind, why in (("gyro", _doubt_gyros), ("accel", _doubt_accelerometers)):
        its = [name for name in names if kind_of(name) == kind]
        if its and (reason := why(recording, its, rate)):
            named = its[0] if len(its) == 1 else f"{its[0]} .. {its[-1]}"
            unit = recording.units[its[0]]
            text = f"{recording.name}: {named}: {reason}; is their unit, {unit}, right?"
            notes.append(Bad(text, reason.action if isinstance(reason, Finding) else STATE_UNIT))
    return notes


def _doubt_gyros(recording: Recording, names: Sequence[str], rate: float) -> str:
    """Return why the unit of gyroscopes is doubtful, or nothing."""
    degrees = [np.degrees(_first(recording, name)) for name in names]
    step = max(map(_step, degrees))
    for factor, other in ((math.degrees(1), "rad/s"), (math.radians(1), "deg/s")):
        if any(abs(factor * step / known - 1) < _ALIKE for known in _STEPS):
            return (
                f"no usual gyroscope has steps of {step:.3g} deg/s, but many have {factor * step:.3g} deg/s, as the "
                f"same numbers make in {other}"
            )
    white = max(deviation_of_steps(each) for each in degrees) / math.sqrt(2 * rate)
    if white > _LOUDEST_GYRO:
        return f"white noise of {white:.2g} deg/s/√Hz is more than that of any gyroscope in use"
    shown = 3600 * math.hypot(*(float(each.mean()) for each in degrees))
    chance = 3600 * white * math.sqrt(rate / len(degrees[0]))
    if (
        len(names) == 3
        and 0 < 60 * white < _QUIET
        and shown > _PLAIN_OFFSET * chance
        and not _EARTH[0] < shown < _EARTH[1]
    ):
        return (
            f"gyroscopes of so little white noise, {60 * white:.2g} deg/√h, show the Earth's 15 deg/h and little more "
            f"at rest, these {shown:.3g} deg/h"
        )
    return ""


def _doubt_accelerometers(recording: Recording, names: Sequence[str], rate: float) -> str:
    """Return why the unit of accelerometers is doubtful, or nothing; |f| of each second, so that they may turn."""
    if list(names) != triad("accel"):
        return ""
    samples = [_first(recording, name) for name in names]
    size = max(1, min(round(rate), len(samples[0])))
    means = [each[: len(each) // size * size].reshape(-1, size).mean(axis=1) for each in samples]
    return no_gravity(median(np.sqrt(sum(np.square(each) for each in means))), recording.units[names[0]])


def _first(recording: Recording, name: str) -> Array:
    return to_si(np.asarray(recording.column(name)[:_MOST_SAMPLES], dtype=np.float64), recording.units[name])


def _step(samples: Array) -> float:
    """Return the step of an output, shape (n,): the mean of the smallest steps, which a file has rounded; 0 if none."""
    steps = np.diff(distinct(samples[:_OF_STEPS]))
    return float(steps[steps < 1.5 * steps.min()].mean()) if len(steps) else 0.0


# Rows at rest that are no readings: zeros in place of lost readings, and readings repeated over several rows.


_SEEN, _SOME, _FIRST = 100_000, 5000, 100  # samples that are used; samples that show the levels of an output
LEVELS = 6
"""Fewest different values of an output among which lost readings can be recognised."""
_CHANCE_ZEROS, _PILED, _MOST = 10, 4, 0.05
"""Zeros are lost readings beyond so many, and beyond so many times the number at the next level (a reading cut to whole
counts has twice as many). Above this share they are refused."""
_BESIDE, _STEPS_BESIDE, _SHARE = 0.5, 5.0, 0.15
"""Standard deviations, or steps, beside a limit within which more than this share of those at the limit must lie."""
_COARSE = 0.25
"""Standard deviations: with larger steps of the output, zeros cannot be recognised as lost readings."""
_LONGEST, _REGULAR, _FEWEST_READINGS = 50, 0.98, 20
"""Most rows of one reading; least share of readings that stand for a multiple of these rows; fewest readings."""
_REPEATED = 0.01  # share of repeated rows above what chance makes: the white noise is that much too large
_STUCK = 20  # rows of one value from which a column may be stuck
_FINE, _REPEATS_PER_STEP = 4.0, 0.27
"""Steps of output in the usual change from which repeats are no chance, which makes 0.27 over their number of them."""


def own_readings(recording: Recording, names: Sequence[str]) -> tuple[Recording, list[str]]:
    """Return a recording with lost readings bridged by straight lines, and with one row for each reading.

    Where readings of all columns `names` stand for k rows each, as of a sensor slower than its log, every k-th row is
    kept. Where columns differ, or rows repeat irregularly, only a note says so.

    Raises
    ------
    DataError
        More than 5 % of a column are zeros in place of lost readings.
    """
    recording, notes = _bridge_dropouts(recording, names)
    notes += _stuck(recording, names)
    held = {name: _rows_of_a_reading(recording.column(name)[:_SEEN]) for name in names}
    rows = set(held.values())
    if len(rows) == 1 and (count := rows.pop()) > 1:
        kept = _first_rows([recording.column(name) for name in names], count)
        columns = {name: stored_as(values[kept], values) for name, values in recording.columns.items()}
        notes.append(
            Note(
                f"{recording.name}: every reading stands in {count} rows, of a sensor slower than its log: fitted are "
                f"the {len(kept)} readings, each once"
            )
        )
        return replace(recording, columns=columns), notes
    for count in sorted(set(held.values()) - {1}):
        its = [name for name in names if held[name] == count]
        notes.append(
            Finding(
                f"{recording.name}: {_columns(its)}: every reading stands in {count} rows, of a sensor slower than its "
                f"log: fitted alone (--columns), each counts once",
                "fit these columns alone (--columns)",
            )
        )
    single = [name for name in names if held[name] == 1]
    kinds = [kind_of(name) or name for name in single]
    if share := _repeated([recording.column(name)[:_SEEN] for name in single], kinds):
        notes.append(
            Finding(
                f"{recording.name}: {100 * share:.0f} % of the rows repeat the readings before, more than chance "
                "makes: of a sensor slower than its log the white noise is that of the log, repeats and all, larger "
                "than the sensor's",
                "log each reading once, at the rate of the sensor",
            )
        )
    return recording, notes


def takes_levels(values: Array) -> bool:
    """Return whether samples take so many different values that lost readings can be recognised among them."""
    return any(len(distinct(part)) >= LEVELS for part in (values[:_FIRST], values))  # the first tell it as a rule


def dropouts(values: Array) -> NDArray[np.bool_] | None:
    """Return which samples, shape (n,), are zeros in place of lost readings; None if none are.

    Zeros at the outermost level, next to the other readings, are readings at the sensor's limit.
    """
    zero: NDArray[np.bool_] = np.asarray(values == 0)
    count = int(np.count_nonzero(zero))
    if not _CHANCE_ZEROS < count < len(values) / 2:
        return None
    rest = values[~zero]
    levels = distinct(rest[:_SOME])
    if len(levels) < LEVELS:
        return None
    sigma, step = float(rest.std()), float(np.diff(levels).min())
    near = np.abs(rest) < max(_BESIDE * sigma, _STEPS_BESIDE * step)
    if np.count_nonzero(near) < _SHARE * count:
        return zero
    above, below = rest[rest > 0], -rest[rest < 0]
    if step > _COARSE * sigma or not (len(above) and len(below)):
        return None
    next_to = max(int(np.count_nonzero(side == side.min())) for side in (above, below))
    return zero if count > _PILED * next_to + _CHANCE_ZEROS else None


def _bridge_dropouts(recording: Recording, names: Sequence[str]) -> tuple[Recording, list[str]]:
    lost_rows = {name: lost for name in names if (lost := dropouts(recording.column(name))) is not None}
    if not lost_rows:
        return recording, []
    columns, row = {}, np.arange(len(recording), dtype=np.float64)
    for name, lost in lost_rows.items():
        share = float(lost.mean())
        if share > _MOST:
            raise DataError(
                f"{recording.name}: {recording.place(int(np.argmax(lost)))}, column {name}: {100 * share:.0f} % of the "
                f"samples are exact zeros in place of lost readings; expected at most {100 * _MOST:.0f} %, which are "
                "left out"
            )
        mended = np.array(recording.column(name), dtype=np.float64)
        mended[lost] = np.interp(row[lost], row[~lost], mended[~lost])
        columns[name] = stored_as(mended, recording.column(name))
    bad = np.logical_or.reduce(list(lost_rows.values()))
    count = int(np.count_nonzero(bad))
    kind = Note if count < FEW * len(recording) else Finding
    note = kind(
        f"{recording.name}: {_columns(list(lost_rows))}: exact zeros in {count} rows, the first "
        f"{recording.place(int(np.argmax(bad)))}, in place of lost readings: bridged by straight lines",
        "check the link to the sensor, and record it again",
    )
    return recording.with_columns(columns, {}), [note]


def _stuck(recording: Recording, names: Sequence[str]) -> list[str]:
    """Return a message for each column that keeps one value for longer than its noise allows by chance."""
    notes: list[str] = []
    for name in names:
        begin, end = long_runs(recording.column(name), _STUCK)
        if not begin.size:
            continue
        length = end - begin
        others = len(recording) - int(length.sum())  # rows, in so many runs
        runs = count_changes(recording.column(name)) + 1 - len(length)
        repeats = (others - runs) / max(others, 1)
        # A row is like the one before in the share that is the sum of p_k^2, p_k the share of value k, so that the most
        # frequent value follows itself no more often than by the root of it.
        again = np.sqrt(max(repeats, 1e-3))
        long = len(recording) * again ** (np.minimum(length, 1000.0) - 1) < COLUMN_STUCK.level
        rows = int(length[long].sum())
        if not 0 < rows < len(recording) / 2 or repeats > 0.5:  # steps coarser than the noise repeat by themselves
            continue
        time = recording.si("time")
        first, last = int(begin[long][0]), int(end[long][-1]) - 1
        kind = Note if rows < FEW * len(recording) else Finding
        notes.append(
            kind(
                f"{recording.name}: column {name} keeps one value for {rows} rows, {time[first]:.6g} to "
                f"{time[last]:.6g} s, while it is noisy elsewhere: a stuck link, which makes all its noises wrong",
                "choose a part without it (--window), or check the link and record it again",
            )
        )
    return notes


def _rows_of_a_reading(values: Array) -> int:
    """Return the rows that every reading stands for; 1 where that varies or every row is a reading."""
    changes = np.diff(np.flatnonzero(values[1:] != values[:-1]))
    if len(changes) < _FEWEST_READINGS or 2 * np.count_nonzero(changes == 1) > len(changes):
        return 1
    many = range(_LONGEST, 1, -1)
    return next((count for count in many if np.mean(changes % count == 0) >= _REGULAR), 1)


def _first_rows(columns: Sequence[Array], count: int) -> NDArray[np.intp]:
    """Return the first row of each reading that stands for `count` rows, also where two readings are alike."""
    change = np.logical_or.reduce([values[1:] != values[:-1] for values in columns])
    start = np.concatenate([[0], np.flatnonzero(change) + 1])
    length = np.diff(np.append(start, len(columns[0])))
    many = np.maximum((length + (count - 1) // 2) // count, 1)
    before = np.cumsum(many) - many
    return np.asarray(np.repeat(start, many) + count * (np.arange(many.sum()) - np.repeat(before, many)))


def _repeated(columns: Sequence[Array], kinds: Sequence[str]) -> float:
    """Return the largest share of rows, over sensors, that repeat the row before more often than by chance."""
    largest = 0.0
    for kind in dict.fromkeys(kinds):
        same = [values[1:] == values[:-1] for values, its in zip(columns, kinds, strict=True) if its == kind]
        if not same[0].size:  # a single row
            continue
        share = float(np.mean(np.logical_and.reduce(same)))
        chance = float(np.prod([each.mean() for each in same]))
        if len(same) == 1:
            (values,) = (each for each, its in zip(columns, kinds, strict=True) if its == kind)
            steps = np.abs(np.diff(values))
            usual = median(steps[steps > 0]) / resolution(values) if steps.any() else 0.0
            chance = _REPEATS_PER_STEP / usual if usual >= _FINE else 1.0
        if share > 3 * chance + _REPEATED:
            largest = max(largest, share)
    return largest


def _columns(names: Sequence[str]) -> str:
    return f"column{'s' * (len(names) > 1)} {' '.join(names)}"

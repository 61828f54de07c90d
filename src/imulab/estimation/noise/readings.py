"""Rows of a log at rest that are no readings of their own: zeros in place of lost readings, and repeated readings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from imulab.columns import kind_of
from imulab.disk import stored_as
from imulab.errors import DataError
from imulab.estimation.noise_coefficients import resolution
from imulab.estimation.ranked import distinct, median
from imulab.recording import Array, Recording
from imulab.verdict import Note

_SEEN, _SOME = 100_000, 5000
LEVELS = 6
"""Different values of an output at least, for what is at one of them to be told."""
_FEW, _PILED, _MOST = 10, 4, 0.05
"""Zeros are dropouts beyond so many, and so many times as many as the next level holds: a reading cut to whole counts
has twice as many. So large a share is refused."""
_BESIDE, _STEPS, _SHARE = 0.5, 5.0, 0.15
"""Standard deviations, or steps, next to a limit in which there are readings: more than this share of those at it."""
_COARSE = 0.25
"""Standard deviations: zeros among readings of larger steps are not told from lost ones."""
_LONGEST, _REGULAR, _FEWEST = 50, 0.98, 20
"""Rows for which a reading stands at most; share of the readings that stand for a multiple of them; readings needed."""
_FINE, _BY_CHANCE = 4.0, 0.27
"""Steps of output in the usual change that tell repeats from chance, which makes 0.27 over their number of them."""


def own_readings(recording: Recording, names: Sequence[str]) -> tuple[Recording, list[str]]:
    """Return a recording with straight lines for zeros that were lost readings and one row for each reading held.

    Readings of all columns `names` that stand for k rows each, as of a sensor slower than its log, leave every k-th
    row. Where columns differ, or rows repeat irregularly, it is said alone.

    Raises
    ------
    DataError
        More than 5 % of a column are such zeros.
    """
    recording, notes = _without_dropouts(recording, names)
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
            f"{recording.name}: {_columns(its)}: every reading stands in {count} rows, of a sensor slower than its "
            f"log: fitted alone (--columns), each counts once"
        )
    single = [name for name in names if held[name] == 1]
    kinds = [kind_of(name) or name for name in single]
    if share := _repeated([recording.column(name)[:_SEEN] for name in single], kinds):
        notes.append(
            f"{recording.name}: {100 * share:.0f} % of the rows repeat the readings before, more than chance makes: of "
            "a sensor slower than its log the white noise is that of the log, repeats and all, larger than the sensor's"
        )
    return recording, notes


def dropouts(values: Array) -> NDArray[np.bool_] | None:
    """Return which samples, shape (n,), are zeros in place of lost readings; None where no zeros are.

    Zeros that are the outermost level and next to the other readings are those of a limit.
    """
    zero: NDArray[np.bool_] = np.asarray(values == 0)
    count = int(np.count_nonzero(zero))
    if not _FEW < count < len(values) / 2:
        return None
    rest = values[~zero]
    levels = distinct(rest[:_SOME])
    if len(levels) < LEVELS:
        return None
    sigma, step = float(rest.std()), float(np.diff(levels).min())
    near = np.abs(rest) < max(_BESIDE * sigma, _STEPS * step)
    if np.count_nonzero(near) < _SHARE * count:
        return zero
    above, below = rest[rest > 0], -rest[rest < 0]
    if step > _COARSE * sigma or not (len(above) and len(below)):
        return None
    next_to = max(int(np.count_nonzero(side == side.min())) for side in (above, below))
    return zero if count > _PILED * next_to + _FEW else None


def _without_dropouts(recording: Recording, names: Sequence[str]) -> tuple[Recording, list[str]]:
    found = {name: lost for name in names if (lost := dropouts(recording.column(name))) is not None}
    if not found:
        return recording, []
    columns, row = {}, np.arange(len(recording), dtype=np.float64)
    for name, lost in found.items():
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
    bad = np.logical_or.reduce(list(found.values()))
    note = (
        f"{recording.name}: {_columns(list(found))}: exact zeros in {int(np.count_nonzero(bad))} rows, the first "
        f"{recording.place(int(np.argmax(bad)))}, in place of lost readings: bridged by straight lines"
    )
    return recording.with_columns(columns, {}), [note]


def _rows_of_a_reading(values: Array) -> int:
    """For how many rows every reading stands, 1 where they are as many as rows or stand for different numbers."""
    changes = np.diff(np.flatnonzero(values[1:] != values[:-1]))
    if len(changes) < _FEWEST or 2 * np.count_nonzero(changes == 1) > len(changes):
        return 1
    many = range(_LONGEST, 1, -1)
    return next((count for count in many if np.mean(changes % count == 0) >= _REGULAR), 1)


def _first_rows(columns: Sequence[Array], count: int) -> NDArray[np.intp]:
    """The rows in which readings that stand for `count` rows begin; two that are alike are told by their rows."""
    change = np.logical_or.reduce([values[1:] != values[:-1] for values in columns])
    start = np.concatenate([[0], np.flatnonzero(change) + 1])
    length = np.diff(np.append(start, len(columns[0])))
    many = np.maximum((length + (count - 1) // 2) // count, 1)
    before = np.cumsum(many) - many
    return np.asarray(np.repeat(start, many) + count * (np.arange(many.sum()) - np.repeat(before, many)))


def _repeated(columns: Sequence[Array], kinds: Sequence[str]) -> float:
    """The largest share of rows, over sensors, that repeat the readings of the row before more often than by chance."""
    found = 0.0
    for kind in dict.fromkeys(kinds):
        same = [values[1:] == values[:-1] for values, its in zip(columns, kinds, strict=True) if its == kind]
        share = float(np.mean(np.logical_and.reduce(same)))
        chance = float(np.prod([each.mean() for each in same]))
        if len(same) == 1:
            (values,) = (each for each, its in zip(columns, kinds, strict=True) if its == kind)
            steps = np.abs(np.diff(values))
            usual = median(steps[steps > 0]) / resolution(values) if steps.any() else 0.0
            chance = _BY_CHANCE / usual if usual >= _FINE else 1.0
        if share > 3 * chance + _MOST:
            found = max(found, share)
    return found


def _columns(names: Sequence[str]) -> str:
    return f"column{'s' * (len(names) > 1)} {' '.join(names)}"

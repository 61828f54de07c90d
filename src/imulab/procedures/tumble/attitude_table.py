"""A table of attitudes: a recording without time, each of whose rows is an attitude at rest."""

from __future__ import annotations

import numpy as np

from imulab.errors import SegmentError, UnitError
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.recording import Array, Recording, check_finite
from imulab.units import conversion_factor

_LONG_TABLE = 1000
_NO_TIME = (
    "no time column: each of the {} rows was taken as an attitude at rest; is this a recording with "
    "motion? Then it needs a column time, or a layout with sample_rate"
)


def attitude_table(
    recording: Recording, sensor: str, names: list[str], unit: str, temperature: float | None
) -> Attitudes:
    """Return the rows of a table as attitudes; a row that repeats an earlier one exactly is not measured again."""
    mean, covariance = recording.triad(sensor), stated_covariance(recording, names, unit)
    kept = np.sort(np.unique(mean, axis=0, return_index=True)[1])
    row = (kept + recording.first_row).astype(np.float64)
    notes = [_NO_TIME.format(len(recording))] if len(recording) > _LONG_TABLE else []
    if len(kept) < len(mean):
        again = int(np.setdiff1d(np.arange(len(mean)), kept)[0])
        first = int(np.argmax((mean == mean[again]).all(axis=1)))
        notes.append(
            f"{len(mean) - len(kept)} of {len(mean)} rows are duplicates of earlier ones, such as "
            f"{recording.place(again)} of {recording.place(first)}: they were left out, being no measurements"
        )
    return Attitudes(
        mean=mean[kept],
        covariance=None if covariance is None else covariance[kept],
        samples=np.ones(len(kept), dtype=np.int64),
        start=row,
        stop=row.copy(),
        unit=unit,
        recording=recording,
        temperature=temperature,
        notes=tuple(notes),
    )


def stated_covariance(recording: Recording, names: list[str], unit: str) -> Array | None:
    """Covariances from the ``std_*`` columns of a table, in the unit of the means, or None."""
    long, short = [f"std_{name}" for name in names], [f"std_{name[-1]}" for name in names]
    stated = short if any(name in recording for name in short) else long
    if not any(name in recording for name in stated):
        return None
    check_finite(recording, stated)
    try:
        factors = [conversion_factor(recording.units[name], unit) for name in stated]
    except UnitError as error:
        raise UnitError(f"{recording.name}: columns {' '.join(stated)}: {error}") from None
    std = np.column_stack([recording.column(name) for name in stated]) * factors
    if not (std > 0).all():
        row, axis = np.argwhere(std <= 0)[0]
        raise SegmentError(
            f"{recording.name}: {recording.place(row)}, column {stated[axis]}: "
            f"expected a positive standard deviation, found {std[row, axis]:g}"
        )
    covariance = np.zeros((len(std), 3, 3))
    covariance[:, range(3), range(3)] = std**2
    return covariance

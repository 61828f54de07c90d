"""Clipped samples: a flat top where an axis reached the end of its range."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imulab.errors import DataError
from imulab.estimation.ranked import median
from imulab.recording import Array, Recording

_FEWEST_SAMPLES = 5
_FEWEST_ROWS = 4
_USUAL_TIES = 3.0
"""A flat top is held by this many times more samples than values otherwise share (coarse counts share many)."""


def check_clipping(recording: Recording, names: list[str], pieces: NDArray[np.int64]) -> None:
    """Check that no axis is clipped in a stretch at rest.

    The extreme value of an axis is suspect where far more samples hold it exactly than values usually share.

    Parameters
    ----------
    recording, names
        The columns to look at.
    pieces
        Stretches at rest as rows (first sample, last sample + 1, attitude).

    Raises
    ------
    DataError
        The message names column and row.
    """
    for column in names:
        values = recording.column(column)
        smallest, largest = values.min(), values.max()
        if smallest == largest:
            continue  # not clipped but dead, which is for the procedure to say
        for extreme, side in ((largest, "largest"), (smallest, "smallest")):
            ties = values == extreme
            if np.count_nonzero(ties) < _FEWEST_SAMPLES:
                continue
            shares, held = [], []
            for start, stop, _ in pieces:
                count = int(np.count_nonzero(ties[start:stop]))
                if count >= _FEWEST_SAMPLES:
                    held.append((count / (stop - start), start + int(np.argmax(ties[start:stop]))))
                else:
                    shares.append(_largest_share(values[start:stop]))
            usual = median(np.array(shares)) if shares else 0.0
            if held and max(held)[0] > _USUAL_TIES * usual:
                share, first = max(held)
                raise DataError(
                    f"{recording.name}: {recording.place(first)}, column {column}: clipped: {100 * share:.0f} % of the "
                    f"samples of an attitude at rest have exactly the {side} value {extreme:.9g} "
                    f"{recording.units[column]}; expected a range that holds 1 g with its noise"
                )


def check_clipped_rows(recording: Recording, names: list[str]) -> None:
    """Check the rows of a table of attitudes for a value at the end of the range that many of them hold exactly.

    Raises
    ------
    DataError
        The message names column and row.
    """
    for column in names:
        values = recording.column(column)
        if values.min() == values.max():
            continue
        for extreme, side in ((values.max(), "largest"), (values.min(), "smallest")):
            rows = np.flatnonzero(values == extreme)
            others = np.unique(values[values != extreme], return_counts=True)[1]
            if len(rows) >= _FEWEST_ROWS and len(rows) > _USUAL_TIES * others.max():
                raise DataError(
                    f"{recording.name}: {recording.place(int(rows[0]))}, column {column}: clipped: "
                    f"{len(rows)} attitudes have exactly the {side} value {extreme:.9g} {recording.units[column]}"
                )


def _largest_share(values: Array) -> float:
    """Share of the most frequent value among (at most 1000) samples."""
    few = values[:1000]
    return float(np.unique(few, return_counts=True)[1].max() / len(few))

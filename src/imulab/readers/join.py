"""Recordings of one unit whose sensors have a file each, as phones and the x-IMU3 write them, to one recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from imulab.columns import kind_of
from imulab.errors import DataError, OptionError
from imulab.readers.streams import LoggedStream, Piece, on_one_clock
from imulab.recording import Recording, check_time

_PER_SECOND = 10**9


def join_recordings(recording: Recording, others: Sequence[Recording]) -> Recording:
    """Join recordings of one unit's sensors, whose times count from the same instant, on the clock of the first.

    Magnetometers are not interpolated: each sample stands in the row nearest in time, other rows hold NaN. All else is
    interpolated linearly, but not across gaps; rows end with the first recording that ends.

    Parameters
    ----------
    recording
        Whose rows, metadata and source are kept.
    others
        Whose columns are added, but for their time.

    Returns
    -------
    Recording
        With the time in s.

    Raises
    ------
    DataError
        A recording has no time, a time that does not rise or has nothing in common with the first, or a column that
        another has.
    OptionError
        There is no other recording.

    Examples
    --------
    >>> import imulab as il
    >>> nine = il.simulate_tumble(gravity=9.81, field="48 uT")
    >>> mag = il.Recording.from_arrays(mag=nine.triad("mag")[::5], time=nine.time[::5], unit="uT", name="mag.csv")
    >>> accel = il.Recording.from_arrays(accel=nine.triad("accel"), time=nine.time, unit="m/s^2")
    >>> list(il.join_recordings(accel, [mag]).columns)
    ['time', 'accel_x', 'accel_y', 'accel_z', 'mag_x', 'mag_y', 'mag_z']
    """
    if not others:
        raise OptionError("others: expected one recording or more to join, found none")
    every = [recording, *others]
    streams, pieces, taken = [], [], {"time": recording.name}
    for number, one in enumerate(every):
        if one.time is None:
            raise DataError(f"{one.name}: no column time, by which it could be joined")
        time = check_time(one)
        _check_overlap(recording, one)
        names = [name for name in one.columns if name != "time"]
        for name in names:
            if name in taken:
                raise DataError(f"{one.name}: column {name}, which {taken[name]} has too; expected other sensors")
            taken[name] = one.name
        kinds = {kind_of(name) for name in names}
        units = {name: one.units[name] for name in names}
        streams.append(
            LoggedStream(one.name, units, slow=kinds == {"temperature"}, placed="mag" in kinds and number > 0)
        )
        ticks = np.rint(time * _PER_SECOND).astype(np.int64)
        pieces.append(Piece(number, ticks, np.column_stack([one.columns[name] for name in names])))
    # The first comes last, when all that its rows need is there.
    blocks = list(
        on_one_clock(
            streams,
            [*pieces[1:], pieces[0]],
            name=recording.name,
            per_second=_PER_SECOND,
            origin=0,
            metadata=lambda _: recording.metadata,
        )
    )
    columns = {name: np.concatenate([block.columns[name] for block in blocks]) for name in blocks[0].columns}
    notes = dict.fromkeys(note for one in (*every, *blocks) for note in one.notes)
    return replace(blocks[0], columns=columns, source=recording.source, notes=tuple(notes))


def _check_overlap(first: Recording, other: Recording) -> None:
    """Refuse recordings of different times."""
    ends = [(float(one.si("time")[0]), float(one.si("time")[-1])) for one in (first, other)]
    if ends[1][0] > ends[0][1] or ends[0][0] > ends[1][1]:
        (a, b), (c, d) = ends
        raise DataError(
            f"{other.name}: time {c:.6g} to {d:.6g} s has nothing in common with {first.name}, {a:.6g} to {b:.6g} s; "
            "expected recordings whose times count from the same instant"
        )


def file_and_layout(text: str) -> tuple[str, str | None]:
    """Split ``FILE@LAYOUT``; a file whose own name holds an @ is taken as it is.

    Raises
    ------
    OptionError
        There is no file in front of the @, or no layout behind it.
    """
    file, at, layout = text.rpartition("@")
    if not at or Path(text).exists():
        return text, None
    if not file or not layout:
        raise OptionError(f"{text!r}: expected FILE or FILE@LAYOUT")
    return file, layout

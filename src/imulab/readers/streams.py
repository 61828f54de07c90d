"""Streams of one unit, each on its own clock in one recording, or all brought to one clock.

Logs interleave the samples of several sensors, and phones write a file for each. Their samples are kept as they are: a
stream whose time stamps are not those of the first has a column of time of its own, such as ``time_gyro``.

Where one clock is needed, one stream's samples are the clock, and the others are interpolated linearly between their
neighbours, as they pass, without holding the file. Before a stream's first sample and after its last nothing is known
of it, and nothing is made up: rows end with the first stream that ends, and the few rows before one that begins a
little later are left out; more of them hold no numbers of it. Magnetometers are not interpolated: each of their samples
stands in the row nearest in time, other rows hold no number.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imulab.columns import kind_of
from imulab.display import Finding, Note
from imulab.errors import DataError, OptionError, ReadError
from imulab.estimation.clock import begins_later
from imulab.estimation.sampling import WIDEST_GAP, mend_stamps
from imulab.recording import RESAMPLED, Array, Recording, check_time, joined, packed, padded
from imulab.units import from_si

# Streams of different clocks to one recording.


Ticks = NDArray[np.int64]

_ROWS = 1 << 16  # samples of the slowest stream after which rows are joined
_PATIENCE = 1 << 20  # most samples that wait for a late stream in a log
_MUCH = 0.1
"""Lost part of a stream from which every command warns."""
_WHOLE = "check that the log is whole, or record again"


@dataclass(frozen=True, slots=True)
class LoggedStream:
    """The columns of one stream, and its name in messages.

    `slow`: its values change so little that any gap is bridged. `placed`: each sample goes into the row of the clock
    that is nearest in time, and is not interpolated. Rows end with neither kind.
    """

    what: str
    units: Mapping[str, str]
    slow: bool = False
    placed: bool = False

    @property
    def sensor(self) -> str:
        """What its columns measure first: ``gyro``, by which its clock is called ``time_gyro``."""
        return kind_of(next(iter(self.units))) or "other"

    @property
    def bounds(self) -> bool:
        """Whether rows begin and end with this stream."""
        return not (self.slow or self.placed)


@dataclass(frozen=True, slots=True)
class Piece:
    """Consecutive samples of a stream: integer time stamps (n,), values (n, columns)."""

    stream: int
    ticks: Ticks
    values: Array


class _Buffer:
    """Samples of a stream that are still needed."""

    def __init__(self, stream: LoggedStream) -> None:
        self.stream = stream
        self.ticks: Ticks = np.empty(0, dtype=np.int64)
        self.values: Array = np.empty((0, len(stream.units)))
        self._waiting: list[Piece] = []
        self.count = 0
        self.step = np.nan
        self.first: int | None = None
        self.last: int | None = None
        self.left_out = 0
        self.total = 0
        self.rows = 0
        self.exact = True

    def add(self, piece: Piece) -> None:
        if piece.ticks.size:
            last = int(piece.ticks.max())
            self.last = last if self.last is None else max(self.last, last)
        self._waiting.append(piece)
        self.count += len(piece.ticks)
        self.total += len(piece.ticks)

    def join(self) -> None:
        """Join the pieces."""
        if self._waiting:
            self.ticks = np.concatenate([self.ticks, *(piece.ticks for piece in self._waiting)])
            self.values = np.concatenate([self.values, *(piece.values for piece in self._waiting)])
            self._waiting = []
        if self.first is None and self.count:
            self.first = int(self.ticks[0])
        if np.isnan(self.step) and self.count > 1:
            self.step = float(np.median(np.diff(self.ticks)))

    def drop(self, count: int) -> None:
        self.ticks, self.values = self.ticks[count:], self.values[count:]
        self.count -= count


def on_one_clock(
    streams: Sequence[LoggedStream],
    pieces: Iterable[Piece],
    *,
    name: str,
    per_second: int,
    origin: int | None,
    metadata: Callable[[int], Mapping[str, str]],
    notes: Sequence[str] = (),
    patience: int = _PATIENCE,
) -> Iterator[Recording]:
    """Yield blocks on the clock of the first stream.

    Parameters
    ----------
    streams
        The clock's first.
    pieces
        In the order of the file.
    per_second
        Ticks in a second.
    origin
        Tick of time 0; None: the clock's first sample.
    metadata
        Of the recording, for a given origin.
    notes
        What is known of the data; what is added to a list while pieces are taken is in the blocks from there on.
    patience
        Most samples of the clock that wait for a late stream.

    Raises
    ------
    ReadError
        There is no sample, or a stream to interpolate runs backwards or lies far behind the clock in the file.
    """
    buffers = [_Buffer(stream) for stream in streams]
    clock, others = buffers[0], buffers[1:]
    row, done = 1, np.iinfo(np.int64).min
    held: Recording | None = None  # until it is known whether it is the last, which says how the streams ended
    for piece in _with_end(pieces):
        if piece is not None:
            if piece.stream and piece.ticks.size and piece.ticks[-1] < done:
                if streams[piece.stream].placed:
                    buffers[piece.stream].total += len(piece.ticks)
                    continue
                _refuse_late(buffers[piece.stream], clock, name)
            buffers[piece.stream].add(piece)
            if piece.stream or clock.count < _ROWS:
                continue
        for buffer in buffers:
            buffer.join()
        whole = _ready(clock, others)
        ready = clock.count if piece is None else whole
        ended = piece is None
        if clock.count > patience and whole < clock.count // 2:
            # A stream that has ended does not delay the others; a late one may lag by half of the waiting samples.
            ended = True
            ready = clock.count // 2
            done = max(done, int(clock.ticks[:ready].max()))
        if ready == 0:
            continue
        kept = _kept(clock, others, ready, ended=ended)
        ticks, values = clock.ticks[:ready][kept], clock.values[:ready][kept]
        clock.drop(ready)
        if not ticks.size:
            continue
        origin = int(ticks[0]) if origin is None else origin
        following = int(clock.ticks[0]) if clock.count else None
        block = _block(buffers, (ticks, following), values, origin, per_second, name)
        if held is not None:
            yield held
        held = replace(block, metadata=metadata(origin), first_row=row, notes=(*notes, *block.notes))
        row += len(ticks)
    if held is None:
        apart = [other.stream.what for other in others if other.left_out]
        if apart:
            raise ReadError(f"{name}: the {clock.stream.what} and the {apart[0]} have no time in common")
        raise ReadError(f"{name}: no samples of the {clock.stream.what}")
    more = (*_left_out(clock, others), *_ends(buffers, per_second), *_placements(clock, others, row - 1, per_second))
    yield replace(held, notes=(*held.notes, *more))


def _with_end(pieces: Iterable[Piece]) -> Iterator[Piece | None]:
    yield from pieces
    yield None


def _refuse_late(buffer: _Buffer, clock: _Buffer, name: str) -> None:
    """Refuse a stream whose samples come after the clock's rows of that time were written without them."""
    raise ReadError(
        f"{name}: the samples of the {buffer.stream.what} lie more than {_PATIENCE // 2} samples behind those of the "
        f"{clock.stream.what} in the file; expected streams written side by side, as they are recorded"
    )


def _ready(clock: _Buffer, others: list[_Buffer]) -> int:
    """Return how many samples of the clock have their neighbours in all other streams."""
    if not others:
        return clock.count
    if any(other.count == 0 for other in others):
        return 0
    horizon = min(int(other.ticks[-1]) for other in others)
    ready = int(np.searchsorted(np.maximum.accumulate(clock.ticks), horizon, side="right"))
    # Which samples are nearer to the last row than to the next is known when the next is there.
    return max(ready - 1, 0) if any(other.stream.placed for other in others) else ready


def _bounds(clock: _Buffer, other: _Buffer, *, ended: bool) -> tuple[float, float]:
    """Return the first and last tick of the clock's rows, for a stream that begins later or ends earlier.

    Rows before it are left out where they are few, and kept without its values where they are many.
    """
    if not other.stream.bounds or other.first is None or other.last is None:
        return -np.inf, np.inf
    late = other.first - clock.first if clock.first is not None else 0
    low = other.first if 0 < late <= WIDEST_GAP * np.nan_to_num(other.step) else -np.inf
    return low, other.last if ended else np.inf


def _kept(clock: _Buffer, others: list[_Buffer], ready: int, *, ended: bool) -> NDArray[np.bool_]:
    """Return which of the clock's next rows are kept, shape (ready,), and count the others."""
    ticks = clock.ticks[:ready]
    kept = np.ones(ready, dtype=np.bool_)
    for other in others:
        from_tick, to_tick = _bounds(clock, other, ended=ended)
        within = (ticks >= from_tick) & (ticks <= to_tick)
        other.left_out += int(np.count_nonzero(~within))
        kept &= within
    return kept


def _block(
    buffers: list[_Buffer], rows: tuple[Ticks, int | None], values: Array, origin: int, per_second: int, name: str
) -> Recording:
    """Return rows of the clock with the other streams at their ticks, and a note for each that was interpolated.

    `rows`: their ticks, and the tick of the row behind them if there is one.
    """
    clock, ticks = buffers[0], rows[0]
    columns: dict[str, Array] = {"time": (ticks - origin) / per_second}
    units = {"time": "s"}
    notes = []
    for buffer in buffers:
        if buffer.stream.placed:
            values = _placed(buffer, clock.step, *rows)
        elif buffer is not clock:
            values, moved = _interpolated(buffer, ticks, origin, per_second, name)
            if moved:
                notes.append(_note(buffer, clock, per_second))
        columns |= {key: np.ascontiguousarray(values[:, i]) for i, key in enumerate(buffer.stream.units)}
        units |= buffer.stream.units
    return Recording(columns=columns, units=units, name=name, notes=tuple(notes), from_file=True)


def _left_out(clock: _Buffer, others: list[_Buffer]) -> list[str]:
    return [
        Note(
            f"{other.left_out} row{'s' * (other.left_out > 1)} of the {clock.stream.what} left out where the "
            f"{other.stream.what} has not begun or has ended"
        )
        for other in others
        if other.left_out
    ]


def _ends(buffers: list[_Buffer], per_second: int) -> list[str]:
    """Return a note by how much the first stream to end ends before the others; a warning if that is a large part."""
    timed = [(b.last, b.first, b) for b in buffers if b.last is not None and b.first is not None and b.stream.bounds]
    end, _, first = min(timed, key=lambda ending: ending[0])
    messages: list[str] = []
    for last, start, buffer in timed:
        left = last - end
        if left > WIDEST_GAP * np.nan_to_num(max(first.step, buffer.step)):
            names = f"the {first.stream.what}", f"the {buffer.stream.what}"
            messages.append(loss(*names, left / per_second, left / max(last - start, 1)))
    return messages


def loss(bound: str, other: str, lost: float, share: float, *, at_start: bool = False) -> Finding:
    """Return what another stream loses, s and as a share, where rows end, or begin, with the stream that bounds them.

    Every command warns of a large share.
    """
    does, when, rows = ("begins", "after", "begin") if at_start else ("ends", "before", "end")
    return Finding(
        f"{'truncated stream: ' if share > _MUCH else ''}{bound} {does} {lost:.4g} s {when} {other}: rows {rows} "
        f"there, and {lost:.4g} s ({100 * share:.2g} %) of {other} are left out",
        _WHOLE,
    )


def _placements(clock: _Buffer, others: list[_Buffer], rows: int, per_second: int) -> list[str]:
    """Return notes on streams that were not interpolated: how many samples stand in how many rows."""
    notes: list[str] = []
    for other in others:
        if not other.stream.placed or (other.exact and other.total == other.rows == rows):
            continue
        notes.append(
            Note(
                f"{other.stream.what}{_rate(other, per_second)} not interpolated: {other.rows} of its {other.total} "
                f"samples stand in the rows of the {clock.stream.what}{_rate(clock, per_second)} nearest in time; the "
                f"other {rows - other.rows} of {rows} rows hold none (nan)"
            )
        )
    return notes


def _placed(buffer: _Buffer, step: float, ticks: Ticks, following: int | None) -> Array:
    """Return the values of a stream in the rows nearest in time to each sample, (n, columns), NaN in other rows.

    Samples further than a step of the clock from any row have none, nor have those whose time runs backwards; of
    several in one row the nearest stays.
    """
    rising = buffer.ticks == np.maximum.accumulate(buffer.ticks)
    buffer.ticks, buffer.values = buffer.ticks[rising], buffer.values[rising]
    buffer.count = len(buffer.ticks)
    middles = ticks[:-1] + np.diff(ticks) // 2
    end = buffer.count
    if following is not None:
        end = int(np.searchsorted(buffer.ticks, ticks[-1] + (following - ticks[-1]) // 2, side="right"))
    at = buffer.ticks[:end]
    row = np.searchsorted(middles, at)
    off = np.abs(at - ticks[row])
    near = np.flatnonzero(np.logical_not(off > step))
    near = near[np.argsort(-off[near], kind="stable")]
    values = np.full((len(ticks), buffer.values.shape[1]), np.nan)
    values[row[near]] = buffer.values[near]
    buffer.rows += len(np.unique(row[near]))
    buffer.exact = buffer.exact and not off.any()
    buffer.drop(end)
    return values


def _check_rising(buffer: _Buffer, origin: int, per_second: int, name: str) -> None:
    """Refuse a stream whose time runs backwards, which cannot be interpolated."""
    step = np.diff(buffer.ticks)
    if step.size and step.min() < 0:
        index = int(np.argmax(step < 0))
        before, after = ((int(t) - origin) / per_second for t in buffer.ticks[index : index + 2])
        raise ReadError(
            f"{name}: the time of the {buffer.stream.what} runs backwards: "
            f"expected more than {before:.9g} s, found {after:.9g} s"
        )


def _interpolated(buffer: _Buffer, ticks: Ticks, origin: int, per_second: int, name: str) -> tuple[Array, bool]:
    """Return the values of a stream at the clock's ticks, (n, columns), and whether any were interpolated."""
    if buffer.count == 0:
        return np.full((len(ticks), buffer.values.shape[1]), np.nan), False
    _check_rising(buffer, origin, per_second, name)
    outside = (ticks < buffer.ticks[0]) | (ticks > buffer.ticks[-1])
    known, wanted = (buffer.ticks - origin).astype(np.float64), (ticks - origin).astype(np.float64)
    values = np.column_stack([np.interp(wanted, known, column) for column in buffer.values.T])
    right = np.clip(np.searchsorted(buffer.ticks, ticks), 0, buffer.count - 1)
    met = buffer.ticks[right] == ticks
    left = np.clip(right - 1, 0, None)
    if not buffer.stream.slow and not np.isnan(buffer.step):
        # No readings are made up across a gap.
        values[~met & (buffer.ticks[right] - buffer.ticks[left] > WIDEST_GAP * buffer.step)] = np.nan
    values[outside] = np.nan
    # The sample before the last tick is kept, because the next block may begin right after it.
    buffer.drop(max(int(np.searchsorted(buffer.ticks, ticks.max(), side="right")) - 1, 0))
    return values, not met.all()


def _rate(buffer: _Buffer, per_second: int) -> str:
    return f" ({per_second / buffer.step:.6g} Hz)" if buffer.step > 0 else ""


def _note(buffer: _Buffer, clock: _Buffer, per_second: int) -> str:
    return (
        f"{buffer.stream.what}{_rate(buffer, per_second)} interpolated to the clock of the "
        f"{clock.stream.what}{_rate(clock, per_second)}"
    )


# Streams that keep their clocks in one recording.


_SHOWN = 64  # samples of a stream that show whether it has the time stamps of another
_LOOKED_AT = 1 << 16  # samples of a log that are read until that is known


def side_by_side(
    streams: Sequence[LoggedStream],
    pieces: Iterable[Piece],
    *,
    name: str,
    per_second: int,
    origin: int | None,
    metadata: Callable[[int], Mapping[str, str]],
    notes: Sequence[str] = (),
) -> Iterator[Recording]:
    """Yield blocks in which a stream with other time stamps than the first keeps them, as ``time_gyro``.

    Parameters and errors are those of `on_one_clock`. Slow streams are interpolated to the first, and so are samples of
    a stream whose first time stamps are the same but later ones are not.
    """
    begun: list[Piece] = []
    shared = _sharing(streams, pieces := iter(pieces), begun)
    place = {number: k for k, number in enumerate(shared)}
    apart: dict[int, list[Piece]] = {number: [] for number in range(len(streams)) if number not in place}
    spans = [_Span(stream) for stream in streams]
    first: list[int] = []

    def common() -> Iterator[Piece]:
        for piece in (*begun, *pieces):
            spans[piece.stream].add(piece.ticks)
            if piece.stream in place:
                yield replace(piece, stream=place[piece.stream])
            else:
                apart[piece.stream].append(piece)

    def known(tick: int) -> Mapping[str, str]:
        first[:] = [tick]
        return metadata(tick)

    row, held = 1, None
    for block in on_one_clock(
        [streams[k] for k in shared], common(), name=name, per_second=per_second, origin=origin, metadata=known,
        notes=notes,
    ):  # fmt: skip
        columns, units = [block.columns], dict(block.units)
        for number, waiting in apart.items():
            stream = streams[number]
            ticks = np.concatenate([np.empty(0, dtype=np.int64), *(piece.ticks for piece in waiting)])
            values = np.concatenate([np.empty((0, len(stream.units))), *(piece.values for piece in waiting)])
            waiting.clear()
            clock = f"time_{stream.sensor}"
            columns.append({clock: (ticks - first[0]) / per_second, **dict(zip(stream.units, values.T, strict=True))})
            units |= {clock: "s", **stream.units}
        if held is not None:
            yield held
        held = replace(block, columns=padded(columns), units=units, first_row=row)
        row += len(held)
    assert held is not None  # without samples of the first stream it has been refused
    yield replace(held, notes=(*held.notes, *_ends_apart(spans, apart, per_second, name)))


class _Span:
    """The first and last time stamp of a stream, and how many there are."""

    def __init__(self, stream: LoggedStream) -> None:
        self.stream, self.count = stream, 0
        self.first, self.last = np.iinfo(np.int64).max, np.iinfo(np.int64).min

    def add(self, ticks: Ticks) -> None:
        if ticks.size:
            self.first, self.last = min(self.first, int(ticks.min())), max(self.last, int(ticks.max()))
            self.count += len(ticks)

    @property
    def step(self) -> float:
        return (self.last - self.first) / max(self.count - 1, 1)


def _ends_apart(spans: list[_Span], apart: Iterable[int], per_second: int, name: str) -> list[str]:
    """Return a note by how much a stream with a clock of its own ends before the others, or the others before it.

    Raises
    ------
    ReadError
        It has no time in common with them.
    """
    timed = [spans[0], *(spans[k] for k in apart if spans[k].stream.bounds and spans[k].count)]
    for span in timed[1:]:
        if span.first > timed[0].last or span.last < timed[0].first:
            what = f"{timed[0].stream.what} and the {span.stream.what}"
            raise ReadError(f"{name}: the {what} have no time in common")
    ends = min(timed, key=lambda span: span.last)
    messages: list[str] = []
    for span in timed:
        left, length = span.last - ends.last, max(span.last - span.first, 1)
        if left > WIDEST_GAP * max(ends.step, span.step):
            cut = "truncated stream: " if left > _MUCH * length else ""
            messages.append(
                Finding(
                    f"{cut}the {ends.stream.what} ends {left / per_second:.4g} s ({100 * left / length:.2g} %) before "
                    f"the {span.stream.what}",
                    _WHOLE,
                )
            )
    return messages


def _sharing(streams: Sequence[LoggedStream], pieces: Iterator[Piece], begun: list[Piece]) -> list[int]:
    """Return the numbers of the streams with the first's time stamps, and the slow; `begun` gets what was read."""
    ticks: list[list[Ticks]] = [[] for _ in streams]
    wanted = {k for k, stream in enumerate(streams) if k == 0 or not stream.slow}
    total = 0
    while total < _LOOKED_AT and any(sum(map(len, ticks[k])) < _SHOWN for k in wanted):
        if (piece := next(pieces, None)) is None:
            break
        begun.append(piece)
        ticks[piece.stream].append(piece.ticks)
        total += len(piece.ticks)
    stamps = [np.concatenate([np.empty(0, dtype=np.int64), *each]) for each in ticks]
    return [k for k, stream in enumerate(streams) if k == 0 or stream.slow or _same_stamps(stamps[0], stamps[k])]


def _same_stamps(first: Ticks, other: Ticks) -> bool:
    if not first.size or not other.size:
        return False
    low, high = max(first[0], other[0]), min(first[-1], other[-1])
    return np.array_equal(*(ticks[(ticks >= low) & (ticks <= high)] for ticks in (first, other))) and low <= high


# Recordings with a file for each sensor, as of phones and the x-IMU3.


_PER_SECOND = 10**9  # ticks that times are joined by: 1 ns


def join_recordings(recording: Recording, others: Sequence[Recording]) -> Recording:
    """Join recordings of one unit's sensors, whose times count from the same instant.

    A sensor whose times are not those of the first recording keeps them, as ``time_gyro``. A recording that holds
    nothing but temperature is interpolated to the first.

    Parameters
    ----------
    recording
        Whose rows, metadata and source are kept.
    others
        Whose columns are added.

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
    ['time', 'accel_x', 'accel_y', 'accel_z', 'time_mag', 'mag_x', 'mag_y', 'mag_z']
    """
    if not others:
        raise OptionError("others: expected one recording or more to join, found none")
    every = [recording, *(_from_instant_of(recording, each) for each in others)]
    streams: list[LoggedStream] = []
    pieces: list[Piece] = []
    taken, mended = {"time": recording.name}, list[Recording]()
    for part in (stream for each in every for stream in _streams_of(each)):
        if part.time is None:
            raise DataError(f"{part.name}: no column time, by which it could be joined")
        part = mend_stamps(part)
        mended.append(part)
        time = check_time(part)
        _check_overlap(recording, part)
        names = [name for name in part.columns if name != "time"]
        for name in names:
            if name in taken:
                raise DataError(f"{part.name}: column {name}, which {taken[name]} has too; expected other sensors")
            taken[name] = part.name
        pieces.append(
            Piece(
                len(streams),
                np.rint(time * _PER_SECOND).astype(np.int64),
                np.column_stack([part.columns[name] for name in names]),
            )
        )
        streams.append(_stream(part.name, part, names, placed=bool(streams)))
    # The first recording comes last, when all samples that its rows need have been read.
    blocks = list(
        side_by_side(
            streams,
            [*pieces[1:], pieces[0]],
            name=recording.name,
            per_second=_PER_SECOND,
            origin=0,
            metadata=lambda _: recording.metadata,
        )
    )
    notes = dict.fromkeys(note for part in (*every, *mended, *blocks) for note in part.notes)
    return packed(replace(joined(blocks), source=recording.source, notes=tuple(notes)))


def _from_instant_of(first: Recording, other: Recording) -> Recording:
    """Return a recording whose times count from the same instant as those of the first, where both heads tell theirs.

    A note says by how much they were moved.
    """
    late = begins_later(first, other) if len(first) and len(other) and "time" in first and "time" in other else 0.0
    if not late:
        return other
    clocks = {clock: other.column(clock) + from_si(late, other.units[clock]) for clock in other.clocks}
    moved = (
        f"{other.name}: begins {abs(late):.9g} s {'after' if late > 0 else 'before'} {first.name}, by the dates of both"
    )
    return replace(other.with_columns(clocks, {}), notes=(*other.notes, Note(moved)))


def _streams_of(recording: Recording) -> list[Recording]:
    return [recording.stream(clock) for clock in recording.clocks]


def _stream(what: str, part: Recording, names: Sequence[str], *, placed: bool) -> LoggedStream:
    kinds = {kind_of(name) for name in names}
    units = {name: part.units[name] for name in names}
    return LoggedStream(what, units, slow=kinds == {"temperature"}, placed=placed and "mag" in kinds)


def _check_overlap(first: Recording, other: Recording) -> None:
    """Refuse recordings of different times."""
    times = [part.stream("time").si("time") for part in (first, other)]
    ends = [(float(time[0]), float(time[-1])) for time in times]
    if ends[1][0] > ends[0][1] or ends[0][0] > ends[1][1]:
        (a, b), (c, d) = ends
        raise DataError(
            f"{other.name}: time {c:.6g} to {d:.6g} s has nothing in common with {first.name}, {a:.6g} to {b:.6g} s; "
            "expected recordings whose times count from the same instant"
        )


def file_and_layout(text: str) -> tuple[str, str | None]:
    """Return file and layout of ``FILE@LAYOUT``; a file whose name contains an @ is used as it is.

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


# A recording whose sensors have clocks of their own, brought to one clock.


_NEARLY = 0.05  # relative: of clocks whose rates are this close, ``time`` is taken
_ENDLESS = 1 << 62
_WORDS = {"accel": "accelerometer", "gyro": "gyroscope", "mag": "magnetometer"}


def one_clock(recording: Recording, sensor: str | None = None) -> Recording:
    """Return a recording with all sensors on one clock; see `on_clock_of`."""
    if recording.on_one_clock:
        return recording
    return replace(joined(list(on_clock_of([recording], sensor))), source=recording.source)


def on_clock_of(blocks: Iterable[Recording], sensor: str | None = None) -> Iterator[Recording]:
    """Yield blocks with all sensors on the clock of one, or of the fastest; those of one clock as they are.

    What was interpolated is said in the notes, and in the head, as ``resampled``.

    Raises
    ------
    ReadError
        Two clocks have no time in common, or one runs backwards.
    """
    blocks = iter(blocks)
    if (first := next(blocks, None)) is None:
        return
    clocks = first.clocks
    if first.on_one_clock:
        yield first
        yield from blocks
        return
    parts = {clock: first.stream(clock) for clock in clocks}
    rates = {clock: _mean_rate(part) for clock, part in parts.items()}
    chosen = next((clock for clock, names in clocks.items() if sensor in map(kind_of, names)), None)
    if chosen is None:
        chosen = max(rates, key=lambda clock: rates[clock] * (1 + _NEARLY * (clock == "time")))
    order = [chosen, *(clock for clock in clocks if clock != chosen)]
    streams, resampled = [], []
    for clock in order:
        kinds = list(dict.fromkeys(kind for name in clocks[clock] if (kind := kind_of(name)) in _WORDS))
        what = " and ".join(map(_WORDS.__getitem__, kinds)) or f"column {clocks[clock][0]}"
        streams.append(_stream(what, first, clocks[clock], placed=clock != chosen))
        if clock != chosen and streams[-1].bounds:
            sensors = " and ".join(kinds or clocks[clock])
            resampled.append(f"{sensors} from {rates[clock]:.6g} Hz to {rates[chosen]:.6g} Hz")
    notes: list[str] = []
    head = {**first.metadata, **({RESAMPLED: "; ".join(resampled)} if resampled else {})}

    def pieces() -> Iterator[Piece]:
        for block in chain([first], blocks):
            notes.extend(note for note in block.notes if note not in notes)
            for number, clock in reversed([*enumerate(order)]):
                part = block.stream(clock)
                time = part.si("time")
                timed = np.isfinite(time)
                yield Piece(
                    number,
                    np.rint(time[timed] * _PER_SECOND).astype(np.int64),
                    np.column_stack([part.columns[name][timed] for name in clocks[clock]]),
                )

    kept = [name for name in first.columns if name != "time" and name not in clocks]
    for block in on_one_clock(
        streams, pieces(), name=first.name, per_second=_PER_SECOND, origin=0, metadata=lambda _: head, notes=notes,
        patience=_ENDLESS,
    ):  # fmt: skip
        columns = {name: block.columns[name] for name in ("time", *kept)}
        yield replace(
            block, columns=columns, units={name: block.units[name] for name in columns},
            corrected_by=first.corrected_by, from_file=first.from_file,
        )  # fmt: skip


def own_clock(recording: Recording, sensor: str) -> Recording:
    """Return the samples of a sensor on its own clock, as ``time``, with the temperature interpolated to it.

    A recording of one clock is returned as it is.
    """
    if recording.on_one_clock:
        return recording
    part, name = recording.stream(sensor), "temperature"
    if name in part or name not in recording or "time" not in part:
        return part
    other = recording.stream(name)
    if other.time is None:
        return part
    values = np.interp(part.si("time"), other.si("time"), other.column(name))
    return part.with_columns({name: values}, {name: recording.units[name]})


def _mean_rate(part: Recording) -> float:
    """Return the mean rate of a stream by its first and last time, Hz, 0 where that is not known."""
    time = part.si("time")
    time = time[np.isfinite(time)]
    return (len(time) - 1) / float(time[-1] - time[0]) if len(time) > 1 and time[-1] > time[0] else 0.0

"""One run of a centrifuge test, streamed: channels, steady part, lines with their noise, or means at rest."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.display import Finding, Note
from imulab.errors import DataError, ImulabError, UnitError
from imulab.estimation.rows import MAD_TO_SIGMA
from imulab.procedures.centrifuge.lines import (
    COLUMNS,
    CONSTANT,
    FAINT,
    LINE,
    PEAK,
    ROOM,
    SEARCH,
    SECOND,
    THIRD,
    Cells,
    CellSamples,
    Complex,
    LineRegression,
    PeriodResult,
    PeriodSums,
    Rates,
    TooSlowError,
    compress,
    detrended,
    even_series,
    find_rates,
    hann_spectrum,
    in_degrees,
    interpolated,
    pieces_of,
    refine,
    residual_noise,
    scatter,
    search_line,
    solve,
)
from imulab.procedures.centrifuge.manifest import Manifest, Run
from imulab.recording import Array, Recording, check_finite, check_time
from imulab.units import from_si, parse_unit, to_si

# The channels of a run: its columns as rates in SI, checked block by block.


class Channels:
    """Samples of a run; the names of its channels are known after the first block.

    Attributes
    ----------
    names
        `dtg_x`, [`dtg_y`,] `fog`.
    """

    def __init__(self, blocks: Iterable[Recording], manifest: Manifest, index: int) -> None:
        self._blocks, self._manifest, self._index = blocks, manifest, index
        self.names: tuple[str, ...] = ()

    def __iter__(self) -> Iterator[CellSamples]:
        """Yield the blocks of the run in SI, checked.

        Raises
        ------
        DataError
            A column is missing, a sample is not finite, time does not rise.
        UnitError
            A column in count or V without a scale factor in that unit; an angle that is none.
        ImulabError
            An error of the reader, with the run's name.
        """
        place = self._manifest.place(self._index)
        file = self._manifest.runs[self._index].file
        try:
            yield from self._samples()
        except ImulabError as error:
            name, colon, rest = str(error).partition(": ")
            # An error that does not name the run names only its file, as it was opened: that is in `place` already.
            raise type(error)(f"{place}: {rest if colon and name.endswith(file) else error}") from None

    def _samples(self) -> Iterator[CellSamples]:
        end = -np.inf
        for block in self._blocks:
            for name in ("time", "dtg_x", "fog"):
                if name not in block:
                    raise DataError(f"no column {name}; found {' '.join(block.columns)}")
            self.names = ("dtg_x", "dtg_y", "fog") if "dtg_y" in block else ("dtg_x", "fog")
            if not len(block):
                continue
            angle = None
            checked = [*self.names]
            if "table_angle" in block:
                if parse_unit(block.units["table_angle"]).quantity != "angle":
                    raise UnitError(f"column table_angle is in {block.units['table_angle']}; expected deg or rad")
                checked.append("table_angle")
                angle = block.si("table_angle")
            check_finite(block, checked)
            time = check_time(block)
            if not time[0] > end:
                raise DataError(
                    f"{block.place(0)}, column time: time runs backwards or stands still: expected more than "
                    f"{end:.9g} s, found {time[0]:.9g} s"
                )
            end = float(time[-1])
            yield CellSamples(time, np.stack([_rate(block, name, self._manifest) for name in self.names]), angle)


def _rate(block: Recording, name: str, manifest: Manifest) -> Array:
    """Return a column as rate, rad/s."""
    unit = parse_unit(block.units[name])
    if unit.quantity == "rate":
        return block.si(name)
    known = manifest.scale_factors.get(name)
    if known is None:
        raise UnitError(
            f"column {name} is in {unit.symbol}: expected a unit of rate, or {name} under [scale_factor] in the "
            "manifest"
        )
    if known[1] != unit.symbol:
        raise UnitError(f"column {name} is in {unit.symbol}, but its scale factor is in {known[1]} per rate")
    rate: Array = block.column(name) / known[0]
    return rate


# The steady part of a run: rate ramps at its ends are cut, ramps elsewhere are refused.


_MISMATCH = to_si(0.5, "deg/s")
_STANDS_OUT = 8.0  # sigma beyond which a cell is a disturbance, besides the share of the signal below
_UNSTEADY = 0.05  # of the size of the signal in a cell
_SLOW, _SLOW_WARNING = 0.1, 0.02  # of the amplitude: larger slow changes are refused, or warned of
_RATE_CHANGE = 1e-3  # of the table's rate within a run
_ROUNDS = 8  # most rounds in which disturbed cells are left out
# Parts of a run; correlation with time from which lines drift in one direction
_SEGMENTS, _STEADILY = 8, 0.9


def steady_part(cells: Cells, place: str) -> tuple[Cells, list[str]]:
    """Return a run without rate ramps at its ends, and the warnings about them.

    With an encoder a ramp shows in its rate, otherwise in the lines' phase and size from block to block.

    Raises
    ------
    DataError
        The rate changes in the middle or all along, or most of the run would be cut.
    """
    whole = cells
    first, last = 0, len(cells.centre)
    if cells.series_angle is not None:
        first, last = _steady_encoder(cells, place)
        cells = whole.cut(first, last)
    warnings: list[str] = []
    for _ in range(_ROUNDS):
        unsteady = _unsteady_blocks(cells, place)
        if unsteady is None:
            break
        low, high, message = unsteady
        if low == 0 and high == len(cells.centre):
            warnings += message
            break
        first, last = first + low, first + high
        cells = whole.cut(first, last)
    if last - first < len(whole.centre) / 2:
        raise DataError(f"{place}: the rates are steady in less than half of the run; expected a run at steady rates")
    period = whole.cell * whole.step
    begin, end = whole.start + first * period, whole.start + last * period
    total = whole.start + whole.duration
    if first:
        warnings.append(
            Note(f"{place}: a rate ramp in the first {begin - whole.start:.1f} s was cut; used from {begin:.1f} s")
        )
    if last < len(whole.centre):
        warnings.append(Note(f"{place}: a rate ramp in the last {total - end:.1f} s was cut; used up to {end:.1f} s"))
    return cells, warnings


def _steady_encoder(cells: Cells, place: str) -> tuple[int, int]:
    """Return the first cell, and the last + 1, over which the encoder's rate is steady."""
    angle = cells.series_angle
    assert angle is not None
    begin = cells.series_begin
    deviation = np.unwrap(angle - cells.table_rate * (begin - cells.start))[:: cells.bins]
    rate = np.diff(deviation) / np.diff(begin[:: cells.bins])
    count = len(deviation)
    if count < 4:
        return 0, count
    usual = float(np.median(rate))
    if abs(usual) > _MISMATCH:
        measured = cells.table_rate + usual
        sense = "; is the sense of the run wrong?" if measured * cells.table_rate < 0 else ""
        raise DataError(
            f"{place}: column table_angle turns at {in_degrees(measured)}, expected table_rate "
            f"{in_degrees(cells.table_rate)}{sense}"
        )
    spread = MAD_TO_SIGMA * float(np.median(np.abs(rate - usual)))
    limit = max(_RATE_CHANGE * abs(cells.table_rate), 6 * spread)
    good = np.abs(rate - usual) <= limit
    runs = good[:-2] & good[1:-1] & good[2:] if count >= 5 else good
    if not runs.any():
        raise DataError(
            f"{place}: column table_angle: the rate is nowhere steady; expected {in_degrees(cells.table_rate)}"
        )
    first = int(np.argmax(runs))
    last = len(good) - int(np.argmax(runs[::-1]))
    if not good[first:last].all():
        index = first + int(np.argmin(good[first:last]))
        raise DataError(
            f"{place}: column table_angle: the rate changes from {in_degrees(cells.table_rate + usual)} to "
            f"{in_degrees(cells.table_rate + float(rate[index]))} at {cells.centre[index]:.1f} s; expected steady rates"
        )
    quarter = max(1, (last - first) // 4)
    ends = rate[first : first + quarter], rate[last - quarter : last]
    change = float(ends[1].mean() - ends[0].mean())
    noise = float(np.hypot(*(part.std() / np.sqrt(quarter) for part in ends)))
    if abs(change) > max(_RATE_CHANGE * abs(cells.table_rate), 5 * noise):
        raise DataError(
            f"{place}: column table_angle: the rate drifts by {in_degrees(change)} over the run; expected steady rates"
        )
    # A cell whose end is still ramping belongs to the ramp.
    return first if first == 0 else first + 1, count if last == len(good) else last


def _unsteady_blocks(cells: Cells, place: str) -> tuple[int, int, list[str]] | None:
    """Return the cells to keep, and warnings, where some blocks show other lines than the rest; None if all agree."""
    shift = 0.0 if cells.series_angle is not None else _strongest_shift(cells)
    if shift is None:
        _check_wandering(cells, place)
        return None
    solution = solve(cells, shift, _peak_shift(cells, cells.net_rate))
    scattered = scatter(cells, solution)
    if scattered is None or len(scattered.centre) < 6:
        return None
    size = np.abs(solution.line(LINE))
    # The comparison is with the median of the blocks, because the line of the whole run contains the disturbance.
    middle = np.median(scattered.deviation.real, axis=0) + 1j * np.median(scattered.deviation.imag, axis=0)
    deviation = np.abs(scattered.deviation - middle)
    sigma = np.median(deviation, axis=0) / 1.1774
    # Below `FAINT` a gyroscope shows nothing: a simulated line without noise has no scatter to compare with.
    bad: NDArray[np.bool_] = np.any(deviation > _STANDS_OUT * sigma + _UNSTEADY * size + FAINT, axis=1)
    count = len(bad)
    low = int(np.argmin(bad))
    high = count - int(np.argmin(bad[::-1]))
    if bad.all() or bad[low:high].any():
        index = low + int(np.argmax(bad[low:high]))
        raise DataError(
            f"{place}: the line at the table rate changes near {scattered.centre[index]:.1f} s; expected steady rates "
            "(a rate ramp or a disturbance inside the run)"
        )
    if low > 0 or high < count:
        return int(scattered.edges[low]), int(scattered.edges[high]), []
    return 0, len(cells.centre), _slow_change(scattered.deviation, size, place)


def _check_wandering(cells: Cells, place: str) -> None:
    """Refuse a run without a line at the table rate in which a clear line moves steadily: a ramp all along."""
    series = [even_series(cells, values - values.mean()) for values in cells.series]
    count = len(series[0]) // _SEGMENTS
    if count < 4 * _SEGMENTS:
        return
    window = 1 - np.cos(2 * np.pi * (np.arange(count) + 0.5) / count)
    rates = 2 * np.pi * np.fft.rfftfreq(count, cells.series_step)
    above = rates > max(1.5 * abs(cells.net_rate), 2.5 * rates[1])
    for values in series:
        segments = values[: count * _SEGMENTS].reshape(_SEGMENTS, count)
        height = np.abs(np.fft.rfft(window * (segments - segments.mean(axis=1, keepdims=True)), axis=1))[:, above]
        clear = height.max(axis=1) > PEAK * np.median(height, axis=1)
        peak = rates[above][np.argmax(height, axis=1)]
        if clear.sum() < 0.6 * _SEGMENTS or np.ptp(peak[clear]) < 3 * rates[1]:
            continue
        if abs(np.corrcoef(np.flatnonzero(clear), peak[clear])[0, 1]) > _STEADILY:
            raise DataError(
                f"{place}: a line moves from {in_degrees(float(peak[clear][0]))} to "
                f"{in_degrees(float(peak[clear][-1]))}; "
                f"expected steady rates, table_rate {in_degrees(abs(cells.table_rate))} (a rate ramp?)"
            )


def _slow_change(deviation: Complex, size: Array, place: str) -> list[str]:
    """Return a warning of a line that wanders slowly, by steps much smaller than the wandering; refuse a large one."""
    if len(deviation) < 16:
        return []
    power = (np.abs(deviation) ** 2).mean(axis=0)
    steps = (np.abs(np.diff(deviation, axis=0)) ** 2).mean(axis=0)
    slow = np.where(steps < 0.5 * power, np.sqrt(power) / np.maximum(size, 1e-300), 0.0)
    slow = np.where(np.sqrt(power) > FAINT, slow, 0.0)
    worst = float(slow.max())
    if worst > _SLOW:
        raise DataError(
            f"{place}: the line at the table rate wanders by {100 * worst:.0f} % over the run; expected steady rates "
            "(a slow rate ramp?)"
        )
    if worst > _SLOW_WARNING:
        return [
            Finding(
                f"{place}: the line at the table rate wanders by {100 * worst:.1f} % over the run; are the rates "
                "steady?",
                "hold arm rate and table rate steady, and record this run again",
            )
        ]
    return []


def _strongest_shift(cells: Cells) -> float | None:
    """Return the shift of the table rate by the channel with the clearest line; None where no line is clear."""
    best, where = 0.0, None
    for channel in range(len(cells.series)):
        shift, height = search_line(cells, cells.series[channel], cells.table_rate, SEARCH)
        if height > best:
            best, where = height, (channel, shift)
    if where is None or best < PEAK:
        return None
    refined = refine(cells, where[0], where[1], None)
    return where[1] if refined is None else refined.table_shift


def _peak_shift(cells: Cells, rate: float) -> float:
    """Return the shift of the FOG's strongest line within the search range of the net rate; 0 where none is clear."""
    shift, height = search_line(cells, cells.series[-1], rate, SEARCH)
    return shift if height > PEAK else 0.0


# Static runs: the mean of each channel, after a check that nothing moved.


_STEP = to_si(5.0, "deg/h")
"""A mean over 1 s closer to the straight line through the record is no motion, however small the noise."""
# A jump at rest exceeds so many sigma within blocks, and steps of the output
_STEP_SIGMA, _STEP_STEPS = 10.0, 8.0
_DRIFT = to_si(20.0, "deg/h")
"""More than the drift of a warm gyroscope over a static record, or the shaking of a table held by its servo."""
_LINE = to_si(1.0, "deg/h")
"""Larger than any line at rest at a rate that the table has in this test."""
_LOWEST_BIN = 3
"""The first bins of a spectrum show a drift that bends."""
_AROUND = 16  # bins on both sides whose median is the floor of a spectrum
_FEWEST = 64  # samples of a spectrum
_TURNED = np.radians(0.05)


@dataclass(frozen=True)
class StaticRun:
    """Mean of each channel over a static run, rad/s, shape (k,), and the run's duration, s."""

    run: Run
    index: int
    channels: tuple[str, ...]
    mean: Array
    samples: int
    duration: float


def reduce_static(blocks: Iterable[Recording], manifest: Manifest, index: int) -> StaticRun:
    """Return the means of a static run.

    Raises
    ------
    DataError
        It moves: a channel steps, drifts or shows a line at a rate that a centrifuge may have, or the table turns.
    """
    place = manifest.place(index)
    channels = Channels(blocks, manifest, index)
    try:
        cells = compress(channels, 2 * np.pi, 1.0)  # cells of one second
    except TooSlowError:
        raise DataError(f"{place}: expected 8 samples per second or more in a static run") from None
    if cells is None:
        raise DataError(f"{place}: shorter than one second; expected a static run of some minutes")
    count = cells.moments[:, CONSTANT, CONSTANT]
    sums = cells.moments[:, CONSTANT, COLUMNS:]
    fastest = max((run.table_rate for run in manifest.runs), default=0.0)
    motion = _find_turn(cells) or _find_line(cells, channels.names, 1.1 * fastest) or _find_step(cells, channels.names)
    if motion:
        raise DataError(f"{place}: a static run that moves: column {motion}; expected a record at rest")
    mean = sums.sum(axis=0) / count.sum() + cells.offset
    return StaticRun(manifest.runs[index], index, channels.names, mean, cells.samples, cells.duration)


def _find_turn(cells: Cells) -> str | None:
    if cells.series_angle is None:
        return None
    reach = float(np.ptp(np.unwrap(cells.series_angle)))
    return f"table_angle goes over {np.degrees(reach):.3g} deg" if reach > _TURNED else None


def _find_line(cells: Cells, names: tuple[str, ...], fastest: float) -> str | None:
    """Return what a channel shows as a line: Earth rate at the net rate, or tilt at the table rate, if it turns."""
    for name, values in zip(names, cells.series, strict=True):
        series = even_series(cells, detrended(cells.series_time, values))
        count = len(series)
        if count < _FEWEST:
            return None
        window = 1 - np.cos(2 * np.pi * (np.arange(count) + 0.5) / count)
        height: Array = np.asarray(2 * np.abs(np.fft.rfft(window * series)) / window.sum(), dtype=np.float64)
        rates: Array = np.asarray(2 * np.pi * np.fft.rfftfreq(count, cells.series_step), dtype=np.float64)
        padded = np.pad(height, _AROUND, mode="reflect")
        floor = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * _AROUND + 1), axis=1)
        high = height > np.maximum(
            PEAK * np.maximum(floor, np.median(height)), np.where(rates > fastest, _DRIFT, _LINE)
        )
        high[:_LOWEST_BIN] = False
        if high.any():
            index = int(np.argmax(np.where(high, height, 0.0)))
            rate = interpolated(rates[index - 1 : index + 2], height[index - 1 : index + 2])
            return (
                f"{name} shows a line of {from_si(float(height[index]), 'deg/h'):.3g} deg/h at {in_degrees(rate, 4)}, "
                "as if the gyroscope turned"
            )
    return None


def _find_step(cells: Cells, names: tuple[str, ...]) -> str | None:
    """Return what the means over 1 s show: a step, or a larger drift than that of a warm gyroscope; None if neither."""
    count = cells.moments[:, CONSTANT, CONSTANT]
    means = cells.moments[:, CONSTANT, COLUMNS:] / count[:, None]
    squares = np.einsum("ckk->ck", cells.moments[:, COLUMNS:, COLUMNS:])
    within = np.sqrt(np.median(np.maximum(squares / count[:, None] - means**2, 0.0), axis=0) / count[0])
    time = cells.centre - cells.centre.mean()
    slope = time @ means / max(float(time @ time), 1e-300)
    flat = means - time[:, None] * slope
    left = np.abs(flat - np.median(flat, axis=0))
    steps = MAD_TO_SIGMA / np.sqrt(2) * np.median(np.abs(np.diff(flat, axis=0)), axis=0) if len(flat) > 3 else 0.0
    limit = np.maximum(np.maximum(_STEP_SIGMA * within, _STEP_STEPS * steps), _STEP)
    if (left > limit).any():
        cell, channel = np.unravel_index(int(np.argmax(left / limit)), left.shape)
        return (
            f"{names[channel]} is {from_si(float(left[cell, channel]), 'deg/h'):.3g} deg/h off its mean at "
            f"{cells.centre[cell]:.1f} s"
        )
    drift = np.abs(slope) * np.ptp(cells.centre)
    if (drift > np.maximum(limit, _DRIFT)).any():
        worst = int(np.argmax(drift / np.maximum(limit, _DRIFT)))
        return f"{names[worst]} drifts by {from_si(float(drift[worst]), 'deg/h'):.3g} deg/h over the record"
    return None


# Loaded runs: blocks to lines with their noise.


_MOST_LOST = 0.5  # share of a run that gaps and bad samples may take
_SPECTRUM_HALF_WIDTH = 24  # resolutions of the run drawn on both sides of a line
_SPECTRUM_POINTS = 4  # points drawn in a resolution


@dataclass(frozen=True)
class LoadedRun:
    """The lines of a loaded run.

    Attributes
    ----------
    run, index, channels
        Run and index of the manifest; columns as `dtg_x`, [`dtg_y`,] `fog`.
    force
        Specific force, m/s^2.
    line, second, third
        ``A + i B`` at chi, 2 chi, 3 chi, rad/s, shape (k,), with chi as in `manifest`.
    covariance
        ``E[z z*]`` of the errors of `line`, (rad/s)^2, shape (k, k).
    freedom
        Degrees of freedom of the covariance.
    blocks
        Number of blocks that it comes from; 0 where the run is too short and white noise is assumed.
    room, room_covariance
        Line at the net rate and its ``E[z z*]``.
    mean
        Mean of each channel, rad/s, shape (k,).
    rates
        Measured rates.
    encoder
        Whether chi was measured.
    duration, periods, samples
        Of the part that is used.
    whole_periods
        Lines by whole-period sums, where they were asked for.
    spectrum
        Rates about the line, rad/s, (f,), and height of each channel and residual, rad/s, (2k - 1, f); or None.
    fog_factor
        Factors of the FOG's line as each axis sees it, shape (k - 1,); None where the test shows no difference.
    common
        Change of the axes' lines by a standard uncertainty of each correction, rad/s, shape (c, k - 1); or None.
    """

    run: Run
    index: int
    channels: tuple[str, ...]
    force: float
    line: Complex
    second: Complex
    third: Complex
    covariance: Complex
    freedom: float
    blocks: int
    room: Complex
    room_covariance: Complex
    mean: Array
    rates: Rates
    encoder: bool
    duration: float
    periods: float
    samples: int
    whole_periods: PeriodResult | None
    spectrum: tuple[Array, Array] | None
    warnings: tuple[str, ...]
    fog_factor: Complex | None = None
    common: Complex | None = None


def _warn_short_run(solution: LineRegression, blocks: int, place: str) -> list[str]:
    """Return messages on a run that is too short for its noise, or for all of its lines."""
    action = "record longer runs"
    messages: list[str] = []
    if not blocks:
        text = f"{place}: too short for noise from blocks of the run; white noise is assumed"
        messages.append(Finding(text, action))
    if not solution.kept.all():
        text = f"{place}: too short to tell all lines apart; some harmonics or the net rate were left out"
        messages.append(Finding(text, action))
    return messages


def _warn_dead_channels(names: Sequence[str], cells: Cells, place: str) -> list[str]:
    """Return a message for each channel that never changes."""
    action = "check the cable of this channel, and record the run again"
    return [
        Finding(f"{place}: column {name} never changes; is it connected?", action)
        for name, values in zip(names, cells.series, strict=True)
        if np.ptp(values) == 0
    ]


def reduce_run(
    blocks: Iterable[Recording],
    manifest: Manifest,
    index: int,
    static: Array | None = None,
    *,
    spectrum: bool = True,
) -> LoadedRun:
    """Return the lines of a loaded run in one pass over its blocks.

    Parameters
    ----------
    blocks
        Consecutive blocks of the recording.
    manifest, index
        The test, and which of its runs this is, counted from 0.
    static
        Means of the static records of its power cycle, rad/s, shape (k,); with them, whole-period sums are made too.
    spectrum
        Whether to keep the spectrum around the table line.

    Raises
    ------
    DataError
        Too short, not steady, or at other rates than the manifest says.
    UnitError
        A unit that does not lead to a rate.
    """
    run, place = manifest.runs[index], manifest.place(index)
    channels = Channels(blocks, manifest, index)
    sums = PeriodSums(run.sense * run.table_rate) if static is not None else None
    pieces = pieces_of(channels)
    cells = _cells(pieces if sums is None else sums.watch(pieces), run, place)
    _check_gaps(cells, place)
    _check_resolution(cells, run, place)
    used, warnings = steady_part(cells, place)
    rates = find_rates(used, place)
    solution = rates.solution
    scattered = scatter(used, solution)
    if scattered is None:
        noise, freedom, blocks_used = residual_noise(used, solution), float(max(used.samples - 10, 1)), 0
    else:
        noise, freedom, blocks_used = scattered.noise, scattered.freedom, len(scattered.centre)
    warnings += _warn_short_run(solution, blocks_used, place)
    warnings += _warn_dead_channels(channels.names, cells, place)
    encoder = cells.series_angle is not None
    # The regression's phase is that of the cells' rate at the middle of the run; chi starts at 0 without encoder.
    turn = np.exp(1j * solution.table_shift * (solution.middle - cells.start))
    whole = None
    if sums is not None and static is not None:
        whole = _whole_periods(sums, static, cells, used, place)
    return LoadedRun(
        run=run,
        index=index,
        channels=channels.names,
        force=manifest.force(run),
        line=solution.line(LINE) * turn,
        second=solution.line(SECOND) * turn**2,
        third=solution.line(THIRD) * turn**3,
        covariance=2 * solution.gain(LINE) * noise,
        freedom=freedom,
        blocks=blocks_used,
        room=solution.line(ROOM),
        room_covariance=2 * solution.gain(ROOM) * rates.net_noise,
        mean=solution.coefficients[0] + cells.offset,
        rates=rates,
        encoder=encoder,
        duration=used.duration,
        periods=used.duration * abs(rates.table_rate) / (2 * np.pi),
        samples=used.samples,
        whole_periods=whole,
        spectrum=_spectrum(used, rates) if spectrum else None,
        warnings=(*warnings, *rates.warnings),
    )


def _cells(pieces: Iterable[CellSamples], run: Run, place: str) -> Cells:
    """Return the sums of a run over cells; refuse a run with too few samples, or shorter than a period."""
    try:
        cells = compress(pieces, run.sense * run.table_rate, run.net_rate)
    except TooSlowError as error:
        raise DataError(
            f"{place}: {float(error.args[0]):.1f} samples per table period; expected 8 or more (a higher sample rate)"
        ) from None
    if cells is None:
        raise DataError(
            f"{place}: less than one period of the table ({2 * np.pi / run.table_rate:.4g} s at "
            f"{from_si(run.table_rate, 'deg/s'):.6g} deg/s)"
        )
    return cells


def _check_gaps(cells: Cells, place: str) -> None:
    span = float(cells.series_time[-1] - cells.series_time[0]) + cells.series_step
    if cells.duration < (1 - _MOST_LOST) * span:
        raise DataError(f"{place}: gaps: {cells.duration:.4g} s of samples in a run of {span:.4g} s")


def _check_resolution(cells: Cells, run: Run, place: str) -> None:
    """Refuse a run that is too short to separate table line and Earth-rate line."""
    net = abs(run.net_rate)
    for times in (1, 2):
        beat = abs(times * run.table_rate - net)
        if beat * cells.duration < 2 * np.pi:
            raise DataError(
                f"{place}: {cells.duration:.4g} s are too short to tell the line at {times} x table_rate from the "
                f"net rate; "
                f"expected {2 * np.pi / beat:.4g} s or more, or another net rate"
            )


def _whole_periods(sums: PeriodSums, static: Array, cells: Cells, used: Cells, place: str) -> PeriodResult:
    if not sums.even:
        raise DataError(f"{place}: gaps or uneven sampling; method fourier needs evenly spaced samples")
    first = float(used.centre[0]) - cells.start - cells.cell * cells.step / 2
    result = sums.result(static, max(first, 0.0), first + used.duration + cells.step)
    if result is None:
        raise DataError(f"{place}: less than one period of the table in the part used")
    if cells.series_angle is None:
        return result
    begin = cells.series_angle[0] - sums.turn  # the first sample has the number 1
    return PeriodResult(result.line * np.exp(1j * begin), result.periods, result.samples)


def _spectrum(cells: Cells, rates: Rates) -> tuple[Array, Array]:
    """Return Hann spectra around the table line: of every channel, then of each axis without the FOG."""
    width = 2 * np.pi / cells.duration
    points = _SPECTRUM_HALF_WIDTH * _SPECTRUM_POINTS
    shifts = np.arange(-points, points + 1) * width / _SPECTRUM_POINTS
    rate = abs(rates.table_rate)
    series = [even_series(cells, detrended(cells.series_time, values)) for values in cells.series]
    spectra = [hann_spectrum(cells.series_step, values, rate + shifts) for values in series]
    heights = [np.abs(spectrum) for spectrum in spectra]
    # Y sees vectors fixed in the arm a quarter turn after X; in a spectrum at positive rates that is a factor -i.
    quarter = -1j if rates.table_rate > 0 else 1j
    heights += [np.abs(s - (1.0, quarter)[i] * spectra[-1]) for i, s in enumerate(spectra[:-1])]
    return rate + shifts, np.array(heights)

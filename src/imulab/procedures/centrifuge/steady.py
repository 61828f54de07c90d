"""Where a run is steady: rate ramps at its ends are cut, others are refused."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imulab.errors import DataError
from imulab.estimation.ranked import MAD_TO_SIGMA
from imulab.procedures.centrifuge.cells import Cells
from imulab.procedures.centrifuge.regress import LINE, Complex, refine, scatter, solve
from imulab.procedures.centrifuge.spectra import FAINT, PEAK, SEARCH, even_series, in_degrees, search_line
from imulab.recording import Array
from imulab.units import to_si

_MISMATCH = to_si(0.5, "deg/s")
_STANDS_OUT = 8.0
_UNSTEADY = 0.05
_SLOW, _SLOW_WARNING = 0.1, 0.02
_RATE_CHANGE = 1e-3
_ROUNDS = 8
_SEGMENTS, _STEADILY = 8, 0.9


def steady_part(cells: Cells, place: str) -> tuple[Cells, list[str]]:
    """Cut a rate ramp at either end of a run, and say so.

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
        found = _unsteady_blocks(cells, place)
        if found is None:
            break
        low, high, message = found
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
            f"{place}: a rate ramp in the first {begin - whole.start:.1f} s was cut; used from {begin:.1f} s"
        )
    if last < len(whole.centre):
        warnings.append(f"{place}: a rate ramp in the last {total - end:.1f} s was cut; used up to {end:.1f} s")
    return cells, warnings


def _steady_encoder(cells: Cells, place: str) -> tuple[int, int]:
    """Cells (half-open) over which the encoder's rate is steady."""
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
        found = cells.table_rate + usual
        sense = "; is the sense of the run wrong?" if found * cells.table_rate < 0 else ""
        raise DataError(
            f"{place}: column table_angle turns at {in_degrees(found)}, expected table_rate "
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
    # A cell whose end is still ramping counts as ramp.
    return first if first == 0 else first + 1, count if last == len(good) else last


def _unsteady_blocks(cells: Cells, place: str) -> tuple[int, int, list[str]] | None:
    """Cells to keep and warnings, where blocks of the run show other lines than the rest; None where all agree."""
    shift = 0.0 if cells.series_angle is not None else _strongest_shift(cells)
    if shift is None:
        _check_wandering(cells, place)
        return None
    solution = solve(cells, shift, _peak_shift(cells, cells.net_rate))
    found = scatter(cells, solution)
    if found is None or len(found.centre) < 6:
        return None
    size = np.abs(solution.line(LINE))
    # Against the median of the blocks: the line of the whole run has the disturbance in it.
    middle = np.median(found.deviation.real, axis=0) + 1j * np.median(found.deviation.imag, axis=0)
    deviation = np.abs(found.deviation - middle)
    sigma = np.median(deviation, axis=0) / 1.1774
    # Below `FAINT` nothing is seen of a gyroscope: a simulated line without noise has no scatter to compare with.
    bad: NDArray[np.bool_] = np.any(deviation > _STANDS_OUT * sigma + _UNSTEADY * size + FAINT, axis=1)
    count = len(bad)
    low = int(np.argmin(bad))
    high = count - int(np.argmin(bad[::-1]))
    if bad.all() or bad[low:high].any():
        index = low + int(np.argmax(bad[low:high]))
        raise DataError(
            f"{place}: the line at the table rate changes near {found.centre[index]:.1f} s; expected steady rates "
            "(a rate ramp or a disturbance inside the run)"
        )
    if low > 0 or high < count:
        return int(found.edges[low]), int(found.edges[high]), []
    return 0, len(cells.centre), _slow_change(found.deviation, size, place)


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
    """Judge a line that wanders slowly: steps from block to block much smaller than the wandering itself."""
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
            f"{place}: the line at the table rate wanders by {100 * worst:.1f} % over the run; are the rates steady?"
        ]
    return []


def _strongest_shift(cells: Cells) -> float | None:
    """Shift of the table rate by the channel whose line stands out most; None where none does."""
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
    """Shift of the FOG's strongest line within the search range of the net rate, or none where it is not clear."""
    shift, height = search_line(cells, cells.series[-1], rate, SEARCH)
    return shift if height > PEAK else 0.0

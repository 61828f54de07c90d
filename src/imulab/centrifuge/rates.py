"""The rates of a run: where its lines really are, whether they match the manifest, and where the run is steady."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.centrifuge.cells import Cells
from imulab.centrifuge.model import EARTH_RATE
from imulab.centrifuge.regress import LINE, ROOM, Complex, Solution, basis, refine, scatter, solve
from imulab.errors import DataError
from imulab.recording import Array
from imulab.units import from_si, to_si

MISMATCH = to_si(0.5, "deg/s")
_DOUBT = to_si(0.01, "deg/s")
_SEARCH = to_si(1.0, "deg/s")
_FAINT = to_si(0.001, "deg/h")
"""A line below this is none, however quiet the channel."""
_SIGNIFICANT = 20.0
"""Power of a line over the expected power of noise there: one false alarm in 1e8."""
_PEAK = 6.0
"""Height of a peak of the spectrum over the median: one false alarm in 1e10 bins of noise."""
_PLAUSIBLE = to_si(1.0, "deg/h")
_POLAR = to_si(0.05, "deg/h")
_STANDS_OUT = 8.0
_UNSTEADY = 0.05
_SLOW, _SLOW_WARNING = 0.1, 0.02
_RATE_CHANGE = 1e-3
_ROUNDS = 8
_SEGMENTS, _STEADILY = 8, 0.9


@dataclass(frozen=True)
class Rates:
    """Rates of a run and its regression at them.

    Attributes
    ----------
    solution
        At these rates.
    table_rate, table_uncertainty
        Signed rate of chi, rad/s, and its standard uncertainty (None where it is the manifest's).
    origin
        ``encoder``, ``fog`` or ``manifest``.
    net_rate, net_uncertainty
        As measured; None where the FOG shows no line.
    net_noise
        Variance of a sample that the scatter of the net line stands for, shape (k, k).
    warnings
        What a user should know.
    """

    solution: Solution
    table_rate: float
    table_uncertainty: float | None
    origin: str
    net_rate: float | None
    net_uncertainty: float | None
    net_noise: Complex
    warnings: tuple[str, ...]


# --- steady ------------------------------------------------------------------------------------------------------


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
    inside = cells.series_step - cells.step
    time = cells.series_time - inside / 2
    deviation = np.unwrap(angle - cells.table_rate * (time - cells.start))[:: cells.bins]
    rate = np.diff(deviation) / (cells.cell * cells.step)
    count = len(deviation)
    if count < 4:
        return 0, count
    usual = float(np.median(rate))
    if abs(usual) > MISMATCH:
        found = cells.table_rate + usual
        sense = "; is the sense of the run wrong?" if found * cells.table_rate < 0 else ""
        raise DataError(
            f"{place}: column table_angle turns at {_deg(found)}, expected table_rate {_deg(cells.table_rate)}{sense}"
        )
    spread = 1.4826 * float(np.median(np.abs(rate - usual)))
    limit = max(_RATE_CHANGE * abs(cells.table_rate), 6 * spread)
    good = np.abs(rate - usual) <= limit
    runs = good[:-2] & good[1:-1] & good[2:] if count >= 5 else good
    if not runs.any():
        raise DataError(f"{place}: column table_angle: the rate is nowhere steady; expected {_deg(cells.table_rate)}")
    first = int(np.argmax(runs))
    last = len(good) - int(np.argmax(runs[::-1]))
    if not good[first:last].all():
        index = first + int(np.argmin(good[first:last]))
        raise DataError(
            f"{place}: column table_angle: the rate changes from {_deg(cells.table_rate + usual)} to "
            f"{_deg(cells.table_rate + float(rate[index]))} at {cells.centre[index]:.1f} s; expected steady rates"
        )
    quarter = max(1, (last - first) // 4)
    ends = rate[first : first + quarter], rate[last - quarter : last]
    change = float(ends[1].mean() - ends[0].mean())
    noise = float(np.hypot(*(part.std() / np.sqrt(quarter) for part in ends)))
    if abs(change) > max(_RATE_CHANGE * abs(cells.table_rate), 5 * noise):
        raise DataError(
            f"{place}: column table_angle: the rate drifts by {_deg(change)} over the run; expected steady rates"
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
    bad: NDArray[np.bool_] = np.any(deviation > _STANDS_OUT * sigma + _UNSTEADY * size, axis=1)
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
    count = len(cells.series_time) // _SEGMENTS
    if count < 4 * _SEGMENTS:
        return
    window = 1 - np.cos(2 * np.pi * (np.arange(count) + 0.5) / count)
    rates = 2 * np.pi * np.fft.rfftfreq(count, cells.series_step)
    above = rates > max(1.5 * abs(cells.net_rate), 2.5 * rates[1])
    for values in cells.series:
        segments = values[: count * _SEGMENTS].reshape(_SEGMENTS, count)
        height = np.abs(np.fft.rfft(window * (segments - segments.mean(axis=1, keepdims=True)), axis=1))[:, above]
        clear = height.max(axis=1) > _PEAK * np.median(height, axis=1)
        peak = rates[above][np.argmax(height, axis=1)]
        if clear.sum() < 0.6 * _SEGMENTS or np.ptp(peak[clear]) < 3 * rates[1]:
            continue
        if abs(np.corrcoef(np.flatnonzero(clear), peak[clear])[0, 1]) > _STEADILY:
            raise DataError(
                f"{place}: a line moves from {_deg(float(peak[clear][0]))} to {_deg(float(peak[clear][-1]))}; "
                f"expected steady rates, table_rate {_deg(abs(cells.table_rate))} (a rate ramp?)"
            )


def _slow_change(deviation: Complex, size: Array, place: str) -> list[str]:
    """Judge a line that wanders slowly: steps from block to block much smaller than the wandering itself."""
    if len(deviation) < 16:
        return []
    power = (np.abs(deviation) ** 2).mean(axis=0)
    steps = (np.abs(np.diff(deviation, axis=0)) ** 2).mean(axis=0)
    slow = np.where(steps < 0.5 * power, np.sqrt(power) / np.maximum(size, 1e-300), 0.0)
    slow = np.where(np.sqrt(power) > _FAINT, slow, 0.0)
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
        shift, height = _search(cells, cells.series[channel], cells.table_rate, _SEARCH)
        if height > best:
            best, where = height, (channel, shift)
    if where is None or best < _PEAK:
        return None
    refined = refine(cells, where[0], where[1], None)
    return where[1] if refined is None else refined.table_shift


# --- rates -------------------------------------------------------------------------------------------------------


def find_rates(cells: Cells, place: str) -> Rates:
    """Refine table rate and net rate on the FOG, the last channel, and regress all channels at them.

    Raises
    ------
    DataError
        A rate does not match the manifest, or Earth rate has an impossible size (a wrong unit).
    """
    fog = len(cells.offset) - 1
    encoder = cells.series_angle is not None
    warnings: list[str] = []
    table_shift: float | None = None
    if not encoder:
        table_shift = _search(cells, cells.series[fog], cells.table_rate, _SEARCH)[0]
        alone = refine(cells, fog, table_shift, None)
        table_shift = table_shift if alone is None else alone.table_shift
    net_start = _net_start(cells, table_shift or 0.0, fog, place)
    refined = refine(cells, fog, table_shift, net_start)
    if refined is None and net_start is not None:
        refined, net_start = refine(cells, fog, table_shift, None), None
    if refined is None:
        refined = refine(cells, fog, None, net_start)
        table_shift = None
    shifts = [0.0, 0.0] if refined is None else [refined.table_shift, refined.net_shift]
    solution = solve(cells, *shifts)
    table_noise = _noise(cells, solution, LINE)
    net_noise = _noise(cells, solution, ROOM)
    origin, table_uncertainty = ("encoder", None) if encoder else ("fog", None)
    if not encoder and (table_shift is None or not _significant(solution, LINE, fog, table_noise)):
        origin, shifts[0] = "manifest", 0.0
        warnings.append(f"{place}: no significant FOG line at the table rate; the manifest's rate was used as it is")
    elif not encoder and refined is not None:
        table_uncertainty = float(np.sqrt(refined.table_gain * table_noise[fog, fog].real))
        if abs(shifts[0]) > max(MISMATCH, 3 * table_uncertainty):
            raise DataError(
                f"{place}: the FOG's line is at {_deg(cells.table_rate + shifts[0])}, expected table_rate "
                f"{_deg(cells.table_rate)}"
            )
    net_rate = net_uncertainty = None
    if net_start is None or not solution.kept[ROOM] or not _significant(solution, ROOM, fog, net_noise):
        shifts[1] = 0.0
        warnings.append(f"{place}: no significant Earth-rate line of the FOG at the net rate {_deg(cells.net_rate)}")
    else:
        assert refined is not None
        net_rate = cells.net_rate + shifts[1]
        net_uncertainty = float(np.sqrt(refined.net_gain * net_noise[fog, fog].real))
        warnings += _check_net(cells.net_rate, net_rate, net_uncertainty, place)
        _check_units(solution, net_noise, place)
    solution = solve(cells, *shifts)
    rate = _encoder_rate(cells) if encoder else cells.table_rate + shifts[0]
    return Rates(
        solution, rate, table_uncertainty, origin, net_rate, net_uncertainty, _noise(cells, solution, ROOM),
            tuple(warnings)
    )  # fmt: skip


def _check_net(expected: float, found: float, uncertainty: float, place: str) -> list[str]:
    off = abs(found - expected)
    if off > max(MISMATCH, 3 * uncertainty):
        raise _mismatch(expected, found, place)
    if off > max(_DOUBT, 3 * uncertainty):
        return [
            f"{place}: the net rate measured on Earth rate is {_deg(found)} ± {_deg(uncertainty)}, "
            f"{_deg(found - expected)} from arm_rate less table_rate"
        ]
    return []


def _mismatch(expected: float, found: float, place: str) -> DataError:
    return DataError(
        f"{place}: rates do not match: the FOG's Earth-rate line is at {_deg(abs(found))}, expected the net rate "
        f"{_deg(abs(expected))} (arm_rate less table_rate)"
    )


def _check_units(solution: Solution, noise: Complex, place: str) -> None:
    """Check Earth rate for a size that it cannot have, and the gyroscope's against the FOG's."""
    size = np.abs(solution.line(ROOM))
    if not _POLAR < size[-1] < 1.2 * EARTH_RATE:
        raise DataError(
            f"{place}: column fog shows Earth rate as {from_si(float(size[-1]), 'deg/h'):.4g} deg/h, expected up to "
            f"15.04 deg/h: "
            "is its unit or scale factor wrong?"
        )
    sigma = np.sqrt(solution.gain(ROOM) * np.diagonal(noise).real)
    for name, value, u in zip(("dtg_x", "dtg_y"), size[:-1], sigma[:-1], strict=False):
        if not size[-1] / 2 - 5 * u < value < 2 * size[-1] + 5 * u:
            raise DataError(
                f"{place}: column {name} shows Earth rate as {from_si(float(value), 'deg/h'):.4g} deg/h, column fog as "
                f"{from_si(float(size[-1]), 'deg/h'):.4g} deg/h: wrong or mixed units or scale factors?"
            )


def _noise(cells: Cells, solution: Solution, row: int) -> Complex:
    """Noise of a line by its scatter over blocks, or by the residuals where the run is too short for that."""
    least = 2 * np.pi / max(abs(cells.net_rate), 1e-9) if row == ROOM else 0.0
    found = scatter(cells, solution, row, least=min(least, cells.duration / 3))
    return residual_noise(cells, solution) if found is None else found.noise


def residual_noise(cells: Cells, solution: Solution) -> Complex:
    """Return the covariance of a sample's residuals: that of white noise, shape (k, k)."""
    columns = cells.moments.shape[1] - len(cells.offset)
    P = basis(cells, solution.middle, solution.half, solution.table_shift, solution.net_shift) @ solution.coefficients
    cross = np.tensordot(P, cells.moments[:, :columns, columns:], axes=((0, 1), (0, 1)))
    square = cells.moments[:, columns:, columns:].sum(axis=0)
    fitted = np.tensordot(P, cells.moments[:, :columns, :columns] @ P, axes=((0, 1), (0, 1)))
    left = square - cross - cross.T + fitted
    noise: Complex = (left / max(cells.samples - int(solution.kept.sum()), 1)).astype(np.complex128)
    return noise


def _significant(solution: Solution, row: int, channel: int, noise: Complex) -> bool:
    size = abs(solution.line(row)[channel])
    power = 2 * solution.gain(row) * float(noise[channel, channel].real)
    return bool(size > _FAINT and size**2 > _SIGNIFICANT * power)


def _encoder_rate(cells: Cells) -> float:
    """Slope of the encoder's angle, rad/s."""
    assert cells.series_angle is not None
    deviation = np.unwrap(cells.series_angle - cells.table_rate * (cells.series_time - cells.start))
    return cells.table_rate + float(np.polyfit(cells.series_time - cells.series_time.mean(), deviation, 1)[0])


# --- spectra -----------------------------------------------------------------------------------------------------


def hann_spectrum(time: Array, values: Array, frequencies: Array) -> Complex:
    """Return the Hann-windowed spectrum at angular frequencies, a line showing as its ``A - i B``, shape (f,)."""
    window = 1 - np.cos(2 * np.pi * (np.arange(len(time)) + 0.5) / len(time))
    weighted = window * values / window.sum() * 2
    # Times as start of a stretch plus a multiple of the step: few exponentials, and the rest is a matrix product.
    stretch = max(1, int(np.sqrt(len(time))))
    padded = np.append(weighted, np.zeros(-len(time) % stretch)).reshape(-1, stretch)
    step = (time[-1] - time[0]) / max(len(time) - 1, 1)
    inner = padded @ np.exp(-1j * np.outer(np.arange(stretch) * step, frequencies))
    outer = np.exp(-1j * np.outer(time[::stretch] - time[0], frequencies))
    spectrum: Complex = (inner * outer).sum(axis=0)
    return spectrum


def _detrended(time: Array, values: Array) -> Array:
    middle = time - time.mean()
    slope = (middle @ values) / (middle @ middle)
    left: Array = values - values.mean() - slope * middle
    return left


def _search(cells: Cells, series: Array, rate: float, within: float) -> tuple[float, float]:
    """Return the shift of a line from `rate`, rad/s, and its height over the median of the spectrum around it."""
    time = cells.series_time
    seconds = cells.duration
    values = _detrended(time, series)
    bin_width = 2 * np.pi / seconds
    near = rate + np.concatenate([np.arange(-24, -3.9), np.arange(4, 24.1)]) * bin_width
    height = np.abs(hann_spectrum(time, values, near))
    floor = max(float(np.median(height)), 1e-300)
    if within < bin_width / 2:
        return 0.0, float(np.abs(hann_spectrum(time, values, np.array([rate])))[0]) / floor
    grid = np.arange(-within, within + bin_width / 8, bin_width / 4)
    found = np.abs(hann_spectrum(time, values, rate + grid))
    return _interpolated(grid, found), float(found.max()) / floor


def _interpolated(grid: Array, height: Array) -> float:
    """Abscissa of the highest point, by a parabola through it and its neighbours."""
    index = int(np.argmax(height))
    if not 0 < index < len(grid) - 1:
        return float(grid[index])
    low, top, high = height[index - 1 : index + 2]
    curvature = low - 2 * top + high
    part = 0.5 * (low - high) / curvature if curvature < 0 else 0.0
    return float(grid[index] + part * (grid[1] - grid[0]))


def _peak_shift(cells: Cells, rate: float) -> float:
    """Shift of the FOG's strongest line within the search range of the net rate, or none where it is not clear."""
    shift, height = _search(cells, cells.series[-1], rate, _SEARCH)
    return shift if height > _PEAK else 0.0


def _net_start(cells: Cells, table_shift: float, fog: int, place: str) -> float | None:
    """Where the FOG's Earth-rate line is, as a shift from the manifest's net rate; None where there is none.

    The whole spectrum is searched, table lines removed, for a peak; the one nearest to the net rate is taken.
    """
    seconds = cells.duration
    bin_width = 2 * np.pi / seconds
    net = abs(cells.net_rate)
    if net < 1.5 * bin_width:
        return None
    time, values = cells.series_time, _without_table_lines(cells, table_shift, fog)
    count = len(time)
    window = 1 - np.cos(2 * np.pi * (np.arange(count) + 0.5) / count)
    height: Array = np.asarray(2 * np.abs(np.fft.rfft(window * values)) / window.sum(), dtype=np.float64)
    rates: Array = np.asarray(2 * np.pi * np.fft.rfftfreq(count, cells.series_step), dtype=np.float64)
    floor = float(np.median(height))
    peak = np.zeros(len(height), dtype=np.bool_)
    peak[1:-1] = (
        (height[1:-1] >= height[:-2]) & (height[1:-1] > height[2:]) & (height[1:-1] > max(_PEAK * floor, _FAINT / 10))
    )
    tolerance = max(MISMATCH, 1.5 * bin_width)
    near = peak & (np.abs(rates - net) <= tolerance)
    if near.any():
        index = int(np.argmax(np.where(near, height, 0.0)))
        grid = rates[max(index - 2, 0) : index + 3]
        sign = 1.0 if cells.net_rate > 0 else -1.0
        return sign * (_interpolated(grid, height[max(index - 2, 0) : index + 3]) - net)
    far = peak & (height > _PLAUSIBLE) & (height < 1.1 * EARTH_RATE) & (rates > 2 * bin_width)
    for times in (1, 2, 3):
        far &= np.abs(rates - times * abs(cells.table_rate)) > 3 * bin_width
    if far.any():
        candidates = rates[far]
        raise _mismatch(net, float(candidates[np.argmin(np.abs(candidates - net))]), place)
    return None


def _without_table_lines(cells: Cells, table_shift: float, channel: int) -> Array:
    """The series of a channel less constant, trend and table lines, by least squares on the series itself."""
    time = cells.series_time
    if cells.series_angle is not None:
        chi = np.unwrap(cells.series_angle) + cells.table_rate * (cells.series_step - cells.step) / 2
    else:
        chi = (cells.table_rate + table_shift) * (time - cells.start)
    columns = [np.ones(len(time)), (time - time.mean()) / cells.duration]
    for times in (1, 2, 3):
        columns += [np.cos(times * chi), np.sin(times * chi)]
    design = np.stack(columns, axis=1)
    left: Array = cells.series[channel] - design @ np.linalg.lstsq(design, cells.series[channel], rcond=None)[0]
    return left


def _deg(rate: float) -> str:
    return f"{from_si(rate, 'deg/s'):.6g} deg/s"

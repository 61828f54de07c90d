"""The rates of a run: where its lines really are, and whether they match the manifest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.errors import DataError
from imulab.estimation.least_squares import coverage_factor
from imulab.procedures.centrifuge.cells import Cells
from imulab.procedures.centrifuge.model import EARTH_RATE
from imulab.procedures.centrifuge.regress import LINE, ROOM, Complex, Regression, basis, refine, scatter, solve
from imulab.procedures.centrifuge.spectra import (
    FAINT,
    PEAK,
    SEARCH,
    even_series,
    in_degrees,
    interpolated,
    search_line,
    strongest_line,
)
from imulab.recording import Array
from imulab.units import from_si, to_si

MISMATCH = to_si(0.5, "deg/s")
_DOUBT = to_si(0.01, "deg/s")
_SIGNIFICANT = 20.0
"""Power of a line over the expected power of noise there: one false alarm in 1e8."""
_PLAUSIBLE = to_si(1.0, "deg/h")
_POLAR = to_si(0.05, "deg/h")


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
    net_noise, net_freedom
        Variance of a sample that the scatter of the net line stands for, shape (k, k), and its degrees of freedom.
    warnings
        What a user should know.
    """

    solution: Regression
    table_rate: float
    table_uncertainty: float | None
    origin: str
    net_rate: float | None
    net_uncertainty: float | None
    net_noise: Complex
    warnings: tuple[str, ...]
    net_freedom: float = 1e9


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
        table_shift = search_line(cells, cells.series[fog], cells.table_rate, SEARCH)[0]
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
    table_noise, _ = _noise(cells, solution, LINE)
    net_noise, net_freedom = _noise(cells, solution, ROOM)
    origin, table_uncertainty = ("encoder", None) if encoder else ("fog", None)
    if not encoder and (table_shift is None or not _significant(solution, LINE, fog, table_noise)):
        origin, shifts[0] = "manifest", 0.0
        warnings.append(
            f"{place}: no significant FOG line at the table rate{_strongest_elsewhere(cells, fog)}; the manifest's "
            "rate was used as it is"
        )
    elif not encoder and refined is not None:
        table_uncertainty = float(np.sqrt(refined.table_gain * table_noise[fog, fog].real))
        if abs(shifts[0]) > max(MISMATCH, 3 * table_uncertainty):
            raise DataError(
                f"{place}: the FOG's line is at {in_degrees(cells.table_rate + shifts[0])}, expected table_rate "
                f"{in_degrees(cells.table_rate)}"
            )
    net_rate = net_uncertainty = None
    if net_start is None or not solution.kept[ROOM] or not _significant(solution, ROOM, fog, net_noise):
        shifts[1] = 0.0
        warnings.append(
            f"{place}: no significant Earth-rate line of the FOG at the net rate {in_degrees(cells.net_rate)}"
        )
    else:
        assert refined is not None
        net_rate = cells.net_rate + shifts[1]
        net_uncertainty = float(np.sqrt(refined.net_gain * net_noise[fog, fog].real))
        warnings += _check_net(cells.net_rate, net_rate, net_uncertainty * three_sigma(net_freedom), place)
        warnings += _check_units(solution, net_noise, place)
    solution = solve(cells, *shifts)
    rate = _encoder_rate(cells) if encoder else cells.table_rate + shifts[0]
    return Rates(
        solution, rate, table_uncertainty, origin, net_rate, net_uncertainty, _noise(cells, solution, ROOM)[0],
        tuple(warnings), net_freedom,
    )  # fmt: skip


def three_sigma(freedom: float | None) -> float:
    """Return the factor of a standard uncertainty of so many degrees of freedom that is exceeded as seldom as 3."""
    return coverage_factor(freedom, 0.9973)


def _check_net(expected: float, found: float, reach: float, place: str) -> list[str]:
    off = abs(found - expected)
    if off > max(MISMATCH, reach):
        raise _mismatch(expected, found, place)
    if off > max(_DOUBT, reach):
        return [
            f"{place}: the net rate measured on Earth rate is {in_degrees(found)} ± {in_degrees(reach / 3)}, "
            f"{in_degrees(found - expected)} from arm_rate less table_rate: the difference is in u of this run's K"
        ]
    return []


def _mismatch(expected: float, found: float, place: str) -> DataError:
    return DataError(
        f"{place}: rates do not match: the FOG's Earth-rate line is at {in_degrees(abs(found))}, expected the net rate "
        f"{in_degrees(abs(expected))} (arm_rate less table_rate)"
    )


def _check_units(solution: Regression, noise: Complex, place: str) -> list[str]:
    """Check Earth rate for a size that it cannot have, and the gyroscope's size and direction against the FOG's."""
    line = solution.line(ROOM)
    fog, earth = line[-1], float(abs(line[-1]))
    if not _POLAR < earth < 1.2 * EARTH_RATE:
        raise DataError(
            f"{place}: column fog shows Earth rate as {from_si(earth, 'deg/h'):.4g} deg/h, expected up to 15.04 deg/h: "
            "is its unit or scale factor wrong?"
        )
    warnings = []
    sigma = np.sqrt(solution.gain(ROOM) * np.diagonal(noise).real)
    # What is fixed in the room passes Y a quarter turn before X.
    for name, value, expected, u in zip(("dtg_x", "dtg_y"), line[:-1], (fog, -1j * fog), sigma[:-1], strict=False):
        if not earth / 2 - 5 * u < abs(value) < 2 * earth + 5 * u:
            raise DataError(
                f"{place}: column {name} shows Earth rate as {from_si(float(abs(value)), 'deg/h'):.4g} deg/h, column "
                f"fog as {from_si(earth, 'deg/h'):.4g} deg/h: wrong or mixed units or scale factors?"
            )
        turned = value * expected.conjugate() / earth
        if abs(turned.imag) - turned.real > 5 * np.sqrt(2) * u:
            message = (
                f"{place}: column {name} shows Earth rate {np.degrees(np.angle(turned)):.0f} deg from where column fog "
                "says: is an axis or a sign reversed, or are columns exchanged?"
            )
            if name == "dtg_x":
                raise DataError(message)
            warnings.append(message)
    return warnings


def _noise(cells: Cells, solution: Regression, row: int) -> tuple[Complex, float]:
    """Noise of a line by its scatter over blocks, or by the residuals where the run is too short, and its freedom."""
    least = 2 * np.pi / max(abs(cells.net_rate), 1e-9) if row == ROOM else 0.0
    found = scatter(cells, solution, row, least=min(least, cells.duration / 3))
    return (residual_noise(cells, solution), 1e9) if found is None else (found.noise, found.freedom)


def residual_noise(cells: Cells, solution: Regression) -> Complex:
    """Return the covariance of a sample's residuals: that of white noise, shape (k, k)."""
    columns = cells.moments.shape[1] - len(cells.offset)
    P = basis(cells, solution.middle, solution.half, solution.table_shift, solution.net_shift) @ solution.coefficients
    cross = (P.transpose(0, 2, 1) @ cells.moments[:, :columns, columns:]).sum(axis=0)
    square = cells.moments[:, columns:, columns:].sum(axis=0)
    fitted = (P.transpose(0, 2, 1) @ cells.moments[:, :columns, :columns] @ P).sum(axis=0)
    left = square - cross - cross.T + fitted
    noise: Complex = (left / max(cells.samples - int(solution.kept.sum()), 1)).astype(np.complex128)
    return noise


def _significant(solution: Regression, row: int, channel: int, noise: Complex) -> bool:
    size = abs(solution.line(row)[channel])
    power = 2 * solution.gain(row) * float(noise[channel, channel].real)
    return bool(size > FAINT and size**2 > _SIGNIFICANT * power)


def _encoder_rate(cells: Cells) -> float:
    """Slope of the encoder's angle, rad/s."""
    assert cells.series_angle is not None
    begin = cells.series_begin
    deviation = np.unwrap(cells.series_angle - cells.table_rate * (begin - cells.start))
    return cells.table_rate + float(np.polyfit(begin - begin.mean(), deviation, 1)[0])


def _net_start(cells: Cells, table_shift: float, fog: int, place: str) -> float | None:
    """Where the FOG's Earth-rate line is, as a shift from the manifest's net rate; None where there is none.

    The whole spectrum is searched, table lines removed, for a peak; the one nearest to the net rate is taken.
    """
    seconds = cells.duration
    bin_width = 2 * np.pi / seconds
    net = abs(cells.net_rate)
    if net < 1.5 * bin_width:
        return None
    values = even_series(cells, _without_table_lines(cells, table_shift, fog))
    count = len(values)
    window = 1 - np.cos(2 * np.pi * (np.arange(count) + 0.5) / count)
    height: Array = np.asarray(2 * np.abs(np.fft.rfft(window * values)) / window.sum(), dtype=np.float64)
    rates: Array = np.asarray(2 * np.pi * np.fft.rfftfreq(count, cells.series_step), dtype=np.float64)
    floor = float(np.median(height))
    peak = np.zeros(len(height), dtype=np.bool_)
    peak[1:-1] = (
        (height[1:-1] >= height[:-2]) & (height[1:-1] > height[2:]) & (height[1:-1] > max(PEAK * floor, FAINT / 10))
    )
    tolerance = max(MISMATCH, 1.5 * bin_width)
    near = peak & (np.abs(rates - net) <= tolerance)
    if near.any():
        index = int(np.argmax(np.where(near, height, 0.0)))
        sign = 1.0 if cells.net_rate > 0 else -1.0
        return sign * (_peak_rate(index, rates, height) - net)
    far = peak & (height > _PLAUSIBLE) & (height < 1.1 * EARTH_RATE) & (rates > 2 * bin_width)
    for times in (1, 2, 3):
        far &= np.abs(rates - times * abs(cells.table_rate)) > 3 * bin_width
    if far.any():
        candidates = np.flatnonzero(far)
        index = int(candidates[np.argmin(np.abs(rates[candidates] - net))])
        raise _mismatch(net, _peak_rate(index, rates, height), place)
    return None


def _peak_rate(index: int, rates: Array, height: Array) -> float:
    """Rate of a peak of a spectrum, by its neighbours."""
    part = slice(max(index - 2, 0), index + 3)
    return interpolated(rates[part], height[part])


def _strongest_elsewhere(cells: Cells, fog: int) -> str:
    """Where the FOG's strongest line is instead: the rate of another run, perhaps."""
    found = strongest_line(cells, cells.series[fog], 1.5 * abs(cells.net_rate))
    return (
        ""
        if found is None
        else f" {in_degrees(abs(cells.table_rate))} (its strongest line is at {in_degrees(found, 5)})"
    )


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
    normal = np.einsum("ni,nj->ij", design, design)
    right = np.einsum("ni,n->i", design, cells.series[channel])
    left: Array = cells.series[channel] - np.einsum("ni,i->n", design, np.linalg.lstsq(normal, right, rcond=None)[0])
    return left

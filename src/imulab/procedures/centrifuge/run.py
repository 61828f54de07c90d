"""One run of a centrifuge test, streamed: its blocks to lines with their noise."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from imulab.errors import DataError
from imulab.procedures.centrifuge.cells import Cells, Samples, TooSlowError, compress, pieces_of
from imulab.procedures.centrifuge.channels import Channels
from imulab.procedures.centrifuge.fourier import PeriodResult, PeriodSums
from imulab.procedures.centrifuge.manifest import Manifest, Run
from imulab.procedures.centrifuge.rates import Rates, find_rates, residual_noise
from imulab.procedures.centrifuge.regress import LINE, ROOM, SECOND, THIRD, Complex, scatter
from imulab.procedures.centrifuge.spectra import detrended, even_series, hann_spectrum
from imulab.procedures.centrifuge.steady import steady_part
from imulab.recording import Array, Recording
from imulab.units import from_si

_MOST_LOST = 0.5
_SPECTRUM_HALF_WIDTH = 24
_SPECTRUM_POINTS = 4


@dataclass(frozen=True)
class LoadedRun:
    """Lines of a loaded run.

    Attributes
    ----------
    run, index, channels
        Of the manifest; columns as `dtg_x`, [`dtg_y`,] `fog`.
    force
        Specific force, m/s^2.
    line, second, third
        ``A + i B`` at chi, 2 chi, 3 chi, rad/s, shape (k,); phase of chi as the contract has it.
    covariance
        ``E[z z*]`` of the errors of `line`, (rad/s)^2, shape (k, k).
    freedom
        Degrees of freedom of that estimate.
    blocks
        Number of blocks behind it; 0 where the run was too short and white noise was assumed.
    room, room_covariance
        Line at the net rate and its ``E[z z*]``.
    mean
        Of each channel, rad/s, shape (k,).
    rates
        As measured.
    encoder
        Whether chi was measured.
    duration, periods, samples
        Of the part used.
    whole_periods
        What the source's sums give, where they were asked for.
    spectrum
        Rates about the line, rad/s, (f,), and height of each channel and residual, rad/s, (2k - 1, f); or None.
    fog_factor
        Of the FOG's line as each axis saw it, shape (k - 1,); None where the test shows no difference.
    common
        What a standard uncertainty of each correction does to the axes' lines, rad/s, shape (c, k - 1); or None.
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
        Means of the static records of its power cycle, rad/s, shape (k,); given, the source's sums are formed too.
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
    found = scatter(used, solution)
    if found is None:
        noise, freedom, blocks_used = residual_noise(used, solution), float(max(used.samples - 10, 1)), 0
        warnings.append(f"{place}: too short for noise from blocks of the run; white noise is assumed")
    else:
        noise, freedom, blocks_used = found.noise, found.freedom, len(found.centre)
    if not solution.kept.all():
        warnings.append(f"{place}: too short to tell all lines apart; some harmonics or the net rate were left out")
    warnings += [
        f"{place}: column {name} never changes; is it connected?"
        for name, values in zip(channels.names, cells.series, strict=True)
        if np.ptp(values) == 0
    ]
    encoder = cells.series_angle is not None
    # The regression's phase is that of the cells' rate in the middle of the run; chi starts at 0 without encoder.
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


def _cells(pieces: Iterable[Samples], run: Run, place: str) -> Cells:
    """Return a run averaged over cells; a run that is too slow or too short is refused."""
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
    """Check that the run is long enough to tell table line and Earth-rate line apart."""
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
    return PeriodResult(result.line * np.exp(1j * cells.series_angle[0]), result.periods, result.samples)


def _spectrum(cells: Cells, rates: Rates) -> tuple[Array, Array]:
    """Hann spectra around the table line: every channel, then what is left of each without the FOG."""
    width = 2 * np.pi / cells.duration
    points = _SPECTRUM_HALF_WIDTH * _SPECTRUM_POINTS
    shifts = np.arange(-points, points + 1) * width / _SPECTRUM_POINTS
    rate = abs(rates.table_rate)
    series = [even_series(cells, detrended(cells.series_time, values)) for values in cells.series]
    spectra = [hann_spectrum(cells.series_step, values, rate + shifts) for values in series]
    heights = [np.abs(spectrum) for spectrum in spectra]
    # Y sees what is fixed in the arm a quarter turn after X, which in a spectrum at positive rates is a factor -i.
    quarter = -1j if rates.table_rate > 0 else 1j
    heights += [np.abs(s - (1.0, quarter)[i] * spectra[-1]) for i, s in enumerate(spectra[:-1])]
    return rate + shifts, np.array(heights)

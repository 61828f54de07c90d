"""One run of a centrifuge test, streamed: its blocks to lines with their noise."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from imulab.centrifuge.cells import COLUMNS, CONSTANT, Cells, Samples, TooSlowError, compress, pieces_of
from imulab.centrifuge.fourier import PeriodResult, PeriodSums
from imulab.centrifuge.manifest import Manifest, Run
from imulab.centrifuge.rates import Rates, find_rates, residual_noise
from imulab.centrifuge.regress import LINE, ROOM, SECOND, THIRD, Complex, scatter
from imulab.centrifuge.spectra import hann_spectrum
from imulab.centrifuge.steady import steady_part
from imulab.errors import DataError, UnitError
from imulab.recording import Array, Recording, check_finite, check_time
from imulab.units import from_si, parse_unit, to_si

_STILL = to_si(5.0, "deg/h")
_STILL_SIGMA, _STILL_STEPS = 10.0, 8.0
_STILL_LINE = to_si(1.0, "deg/h")
_SINE_SAMPLES, _SINE_SHARE = 20, 0.8
_STILL_ANGLE = np.radians(0.05)
_SPECTRUM_HALF_WIDTH = 24
_SPECTRUM_POINTS = 4


@dataclass(frozen=True)
class StaticRun:
    """Mean of each channel over a static run, rad/s, shape (k,), and its duration, s."""

    run: Run
    index: int
    channels: tuple[str, ...]
    mean: Array
    samples: int
    duration: float


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


def samples_of(
    blocks: Iterable[Recording], manifest: Manifest, index: int
) -> Iterator[tuple[tuple[str, ...], Samples]]:
    """Yield the blocks of a run in SI, checked, with the names of their channels.

    Raises
    ------
    DataError
        A column is missing, a sample is not finite, time does not rise.
    UnitError
        A column in count or V without a scale factor in that unit; an angle that is none.
    """
    place = manifest.place(index)
    end = -np.inf
    for block in blocks:
        for name in ("time", "dtg_x", "fog"):
            if name not in block:
                raise DataError(f"{place}: no column {name}; found {' '.join(block.columns)}")
        channels = ("dtg_x", "dtg_y", "fog") if "dtg_y" in block else ("dtg_x", "fog")
        if not len(block):
            continue
        angle = None
        names = [*channels]
        if "table_angle" in block:
            if parse_unit(block.units["table_angle"]).quantity != "angle":
                raise UnitError(f"{place}: column table_angle is in {block.units['table_angle']}; expected deg or rad")
            names.append("table_angle")
            angle = block.si("table_angle")
        check_finite(block, names)
        time = check_time(block)
        if not time[0] > end:
            raise DataError(
                f"{place}: {block.place(0)}, column time: time runs backwards or stands still: expected more than "
                f"{end:.9g} s, found {time[0]:.9g} s"
            )
        end = float(time[-1])
        yield channels, Samples(time, np.stack([_rate(block, name, manifest, place) for name in channels]), angle)


def _rate(block: Recording, name: str, manifest: Manifest, place: str) -> Array:
    """A column as rate, rad/s."""
    unit = parse_unit(block.units[name])
    if unit.quantity == "rate":
        return block.si(name)
    known = manifest.scale_factors.get(name)
    if known is None:
        raise UnitError(
            f"{place}: column {name} is in {unit.symbol}: expected a unit of rate, or {name} under [scale_factor] in "
            f"the manifest"
        )
    if known[1] != unit.symbol:
        raise UnitError(f"{place}: column {name} is in {unit.symbol}, but its scale factor is in {known[1]} per rate")
    rate: Array = block.column(name) / known[0]
    return rate


class _Named:
    """Samples of a run, with the names of their channels once the first block has come."""

    def __init__(self, blocks: Iterable[Recording], manifest: Manifest, index: int) -> None:
        self._source = samples_of(blocks, manifest, index)
        self._place = manifest.place(index)
        self.channels: tuple[str, ...] = ()
        self.encoder = False

    def __iter__(self) -> Iterator[Samples]:
        for channels, samples in self._source:
            self.channels, self.encoder = channels, samples.angle is not None
            yield samples


def reduce_static(blocks: Iterable[Recording], manifest: Manifest, index: int) -> StaticRun:
    """Return the means of a static run.

    Raises
    ------
    DataError
        It moves: a mean over one second lies further from a straight line than noise explains, or the table turns.
    """
    place = manifest.place(index)
    named = _Named(blocks, manifest, index)
    try:
        cells = compress(named, 2 * np.pi, 1.0)  # cells of one second
    except TooSlowError:
        raise DataError(f"{place}: expected 8 samples per second or more in a static run") from None
    if cells is None:
        raise DataError(f"{place}: shorter than one second; expected a static run of some minutes")
    count = cells.moments[:, CONSTANT, CONSTANT]
    sums = cells.moments[:, CONSTANT, COLUMNS:]
    means = sums / count[:, None]
    squares = np.einsum("ckk->ck", cells.moments[:, COLUMNS:, COLUMNS:])
    within = np.sqrt(np.median(np.maximum(squares / count[:, None] - means**2, 0.0), axis=0) / count[0])
    time = cells.centre - cells.centre.mean()
    slope = time @ means / max(float(time @ time), 1e-300)
    flat = means - time[:, None] * slope
    left = np.abs(flat - np.median(flat, axis=0))
    steps = 1.4826 / np.sqrt(2) * np.median(np.abs(np.diff(flat, axis=0)), axis=0) if len(flat) > 3 else 0.0
    limit = np.maximum(np.maximum(_STILL_SIGMA * within, _STILL_STEPS * steps), _STILL)
    for number, height in enumerate(_turning(flat)):
        if height > _STILL_LINE:
            raise DataError(
                f"{place}: a static run that moves: column {named.channels[number]} shows a sine of "
                f"{from_si(height, 'deg/h'):.3g} deg/h, as if the gyroscope turned; expected a record at rest"
            )
    if (left > limit).any():
        cell, channel = np.unravel_index(int(np.argmax(left / limit)), left.shape)
        raise DataError(
            f"{place}: a static run that moves: column {named.channels[channel]} is "
            f"{from_si(float(left[cell, channel]), 'deg/h'):.3g} deg/h off its mean at {cells.centre[cell]:.1f} s; "
            "expected a record at rest"
        )
    if cells.series_angle is not None:
        angle = np.unwrap(cells.series_angle)
        if np.ptp(angle) > _STILL_ANGLE:
            raise DataError(
                f"{place}: a static run that moves: column table_angle goes over {np.degrees(np.ptp(angle)):.3g} deg; "
                "expected a record at rest"
            )
    return StaticRun(
        manifest.runs[index], index, named.channels, sums.sum(axis=0) / count.sum() + cells.offset, cells.samples,
            cells.duration
    )  # fmt: skip


def _turning(flat: Array) -> list[float]:
    """Height of the sine that holds most of each channel's means over seconds; 0 where none does."""
    count = len(flat)
    if count < _SINE_SAMPLES:
        return [0.0] * flat.shape[1]
    window = 1 - np.cos(2 * np.pi * (np.arange(count) + 0.5) / count)
    power = np.abs(np.fft.rfft(window[:, None] * (flat - flat.mean(axis=0)), axis=0)) ** 2
    # A sine under this window keeps all its power within two bins of its own.
    top = np.argmax(power[2:], axis=0) + 2
    held = np.array([power[max(k - 2, 0) : k + 3, c].sum() for c, k in enumerate(top)]) / np.maximum(
        power.sum(axis=0), 1e-300
    )
    height = 2 * np.sqrt(power[top, range(len(top))]) / window.sum()
    return [float(h) if share > _SINE_SHARE else 0.0 for h, share in zip(height, held, strict=True)]


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
    named = _Named(blocks, manifest, index)
    table_rate = run.sense * run.table_rate
    sums = PeriodSums(table_rate) if static is not None else None
    pieces = pieces_of(named)
    try:
        cells = compress(pieces if sums is None else sums.watch(pieces), table_rate, run.net_rate)
    except TooSlowError as error:
        raise DataError(
            f"{place}: {float(error.args[0]):.1f} samples per table period; expected 8 or more (a higher sample rate)"
        ) from None
    if cells is None:
        raise DataError(
            f"{place}: less than one period of the table ({2 * np.pi / run.table_rate:.4g} s at "
            f"{from_si(run.table_rate, 'deg/s'):.6g} deg/s)"
        )
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
    encoder = cells.series_angle is not None
    # The regression's phase is that of the cells' rate in the middle of the run; chi starts at 0 without encoder.
    turn = np.exp(1j * solution.table_shift * (solution.middle - cells.start))
    whole = None
    if sums is not None and static is not None:
        whole = _whole_periods(sums, static, cells, used, place)
    return LoadedRun(
        run=run,
        index=index,
        channels=named.channels,
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
    time = cells.series_time
    heights = []
    rate = abs(rates.table_rate)
    spectra = [hann_spectrum(time, values - values.mean(), rate + shifts) for values in cells.series]
    heights = [np.abs(spectrum) for spectrum in spectra]
    # Y sees what is fixed in the arm a quarter turn after X, which in a spectrum at positive rates is a factor -i.
    quarter = -1j if rates.table_rate > 0 else 1j
    heights += [np.abs(s - (1.0, quarter)[i] * spectra[-1]) for i, s in enumerate(spectra[:-1])]
    return rate + shifts, np.array(heights)

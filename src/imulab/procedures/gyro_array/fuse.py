"""Fusion of an array's readings into one rate by the C core, block by block, and the figures of the fused rate."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from imulab.device.unit import Blob
from imulab.display import Bad, Finding, prefixed
from imulab.errors import DataError
from imulab.estimation.rows import HISTORY, zero_rows
from imulab.procedures.gyro_array.elements import (
    EXCLUDED,
    FEWEST_ROBUST,
    HELD,
    JUMPED,
    NEAR_UNIT,
    NON_FINITE,
    STUCK,
    UNIT_FACTORS,
    ArrayCalibration,
    Checks,
    Elements,
    Health,
    SampleClock,
    array_calibration,
    feedback_notes,
    find_elements,
    to_one_clock,
)
from imulab.procedures.gyro_array.figures import axis_suffix, curves
from imulab.procedures.gyro_array.schema import model_of
from imulab.procedures.gyro_array.stream import FuseOptions, deviations_after_alignment, noise_about_mean, open_stream
from imulab.procedures.result import Drawn
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration, warn_other_unit
from imulab.report.noise_figures import thinned
from imulab.report.traces import (
    BAD,
    DASHES,
    GOOD,
    INK,
    QUIET,
    TIME,
    Exhibits,
    Figure,
    ReportTable,
    figure_axis,
    plain_number,
    rounded,
    scatter,
)

# The fused rate with its figures: rate over time, and states of each gyro.


STATES = (
    (EXCLUDED, "excluded", "circle-open", QUIET),
    (STUCK, "stuck", "square", BAD),
    (NON_FINITE, "non-finite", "x", INK),
    (JUMPED, "jumped", "triangle-up", "#c99a2e"),
    (HELD, "held (end of its range?)", "diamond", "#8e6bbd"),
)
"""Flag, its meaning, its mark and its colour."""
_PIECES = 240  # parts of the time over which health is drawn
_COLOURS = (GOOD, BAD, "#8e6bbd")


@dataclass(frozen=True, repr=False)
class Fused(Drawn):
    """The fused rate.

    Attributes
    ----------
    time
        s, shape (m,).
    rate
        Rate in the unit of the readings, shape (m, axes).
    weights, flags
        Weight and flags of each gyro in each sample, shape (m, axes, n), or None where they were not asked for.
    elements
        The columns that were fused.
    health
        States of each gyro.
    block
        The samples that were fused.
    notes
        Gaps in time, and other messages for the user.

    Examples
    --------
    >>> import imulab as il
    >>> fused = il.fuse(il.simulate_array(experiment="static", duration=10.0))
    >>> fused.rate.shape == (len(fused.time), 1)
    True
    """

    time: Array
    rate: Array
    weights: Array | None
    flags: np.ndarray | None
    elements: Elements
    health: Health
    block: Recording
    notes: tuple[str, ...] = ()

    subject: ClassVar[str] = "Fused rate"

    def exhibits(self) -> Exhibits:
        """Return the rate and the state of the gyros over time."""
        return _exhibits(self)

    def recording(self) -> Recording:
        """Return the fused rate as a recording with the time and the head of the readings: ``write`` takes it."""
        columns, units = {"time": self.block.columns["time"]}, {"time": self.block.units["time"]}
        for a, (name, unit) in enumerate(zip(self.elements.rate_names(), self.elements.units, strict=True)):
            columns[name], units[name] = np.ascontiguousarray(self.rate[:, a]), unit
        return replace(self.block, columns=columns, units=units, notes=())

    def __repr__(self) -> str:
        gyros, axes = self.elements.count, len(self.elements.axes)
        return f"Fused({len(self.time)} samples of {gyros} gyros on {axes} axes, in {' '.join(self.elements.units)})"


def _exhibits(fused: Fused) -> Exhibits:
    """Return the rate over time and, for each axis with flags, the states of its gyros, and a table of them."""
    elements = fused.elements
    length = f"{fused.time[-1] - fused.time[0]:.4g} s"
    health = fused.health.lines()
    return Exhibits(
        headline=f"{len(fused.time)} samples of {elements.count} gyros fused over {length}; "
        + (f"not all gyros were in use: {'; '.join(health[:2])}." if health else "every gyro was in use throughout."),
        facts=[],
        items=[_rate(fused), *_states(fused), _table(fused)],
    )


def _rate(fused: Fused) -> Figure:
    names, units = fused.elements.rate_names(), list(dict.fromkeys(fused.elements.units))
    traces = []
    for a, name in enumerate(names):
        time, rate = thinned(fused.time, fused.rate[:, a])
        line = {"color": _COLOURS[a], "width": 1.2, "dash": DASHES[a]}
        traces.append(scatter(rounded(time, 10), rounded(rate), "lines", name=name, line=line))
    for bit, label, symbol, colour in STATES:
        k, axes, gyros = _begins(fused, bit)
        if not k.size:
            continue
        who = [fused.elements.names[a][i] for a, i in zip(axes, gyros, strict=True)]
        marker = {"symbol": symbol, "color": colour, "size": 9}
        hover = f"%{{text}}: {label} from %{{x:.6g}} s<extra></extra>"
        points = rounded(fused.time[k], 10), rounded(fused.rate[k, axes])
        traces.append(scatter(*points, "markers", name=label, text=who, marker=marker, hovertemplate=hover))
    return curves(
        title="Fused rate over time",
        caption="Marks: where a gyro began to be in such a state."
        if len(traces) > len(names)
        else "No gyro was flagged.",
        traces=traces,
        x=figure_axis(TIME),
        y=figure_axis(f"rate, {' '.join(units)}"),
    )


def _begins(fused: Fused, bit: int) -> tuple[np.ndarray, ...]:
    """Return where flags of gyros begin: samples, axes and gyros, each of shape (k,)."""
    if fused.flags is None:
        return (np.empty(0, dtype=np.intp),) * 3
    held = (fused.flags & bit) != 0
    held[1:] &= ~held[:-1]
    return np.nonzero(held)


def _states(fused: Fused) -> list[Figure]:
    """Return the figures of the times of flags, one for each axis with flags."""
    if fused.flags is None:
        return []
    edges = np.linspace(0, len(fused.time), min(_PIECES, len(fused.time)) + 1).astype(int)[:-1]
    pieces = np.bitwise_or.reduceat(fused.flags, edges, axis=0)
    figures = []
    for a, letter in enumerate(fused.elements.axes):
        names = fused.elements.names[a]
        traces = []
        for bit, label, symbol, colour in STATES:
            k, i = np.nonzero(pieces[:, a] & bit)
            if k.size:
                at, who = rounded(fused.time[edges[k]], 10), [names[index] for index in i]
                marker = {"symbol": symbol, "color": colour, "size": 7}
                hover = f"%{{y}} {label}, %{{x:.4g}} s<extra></extra>"
                traces.append(scatter(at, who, "markers", marker=marker, name=label, hovertemplate=hover))
        if traces:
            figures.append(
                curves(
                    title=f"State of each gyro{axis_suffix(letter)}",
                    caption=f"A mark where a gyro was in that state in one of {len(edges)} equal pieces of time.",
                    traces=traces,
                    x=figure_axis(TIME, range=[float(fused.time[0]), float(fused.time[-1])]),
                    y={"automargin": True, "categoryorder": "array", "categoryarray": [*names],
                       "range": [len(names) - 0.5, -0.5]},
                    height=max(260, 30 * len(names) + 120),
                )
            )  # fmt: skip
    return figures


def _table(fused: Fused) -> ReportTable:
    labels = [label for _, label, _, _ in STATES]
    events, rows = fused.health.events, []
    for a, row in enumerate(fused.elements.names):
        for i, name in enumerate(row):
            row_events = [events.get((a, i, label)) for label in labels]
            rows.append([name, *("–" if event is None else str(event.samples) for event in row_events)])
    return ReportTable("Samples in each state", "", ["gyro", *labels], rows)


# Fusion of recordings, as a whole or block by block.


_NEED_THREE = ("robust", "support", "least-squares")
_MISALIGNED = 0.3  # of a reading: noise of the first element, which explains so much of the others, makes less
_FOR_NOISE = 10_000  # samples that show the noise where none is stated
_FOR_SCALE = 1000  # samples whose noise and means are compared with a record's
_NEAR_BIASES = 4.0  # times: the ratio of biases may be as far off that of noise


def fuse(
    recording: Recording, options: FuseOptions | None = None, *, weights: bool = False, flags: bool = True
) -> Fused:
    """Return the fused rate of a whole recording.

    Raises
    ------
    DataError, UnitError, RecordError, OptionError
        As for `fuse_blocks`.
    """
    fuser = Fuser(options or FuseOptions(), weights=weights)
    parts = list(fuser.fuse([recording]))
    if not parts:
        raise DataError(f"{recording.name}: no samples to fuse")
    (whole,) = parts
    return replace(whole, flags=whole.flags if flags else None, notes=tuple(fuser.notes()))


@dataclass
class Fuser:
    """Fusion over the blocks of a recording: the state between them, and the warnings at the end."""

    options: FuseOptions
    weights: bool = False
    clock: SampleClock = field(default_factory=SampleClock)
    health: Health | None = None
    tell: Callable[[str], None] | None = None
    name: str = "recording"
    checks: Checks | None = None
    before: Array | None = None
    lost: int = 0
    other: list[str] = field(default_factory=list)
    held: ArrayCalibration | None = None
    first: Array | None = None

    def fuse(self, blocks: Iterable[Recording]) -> Iterator[Fused]:
        """Yield the fused rates of consecutive blocks; the result does not depend on where they are cut.

        Raises
        ------
        DataError
            No elements, too few for the method, no time, or time that does not rise.
        UnitError
            The elements of an axis have different units, or others than the record.
        RecordError
            The record is not of this array.
        """
        self.clock.nominal = self.options.rate
        elements: Elements | None = None
        stream: Any = None
        head: Array | None = None  # the first samples and their times, until the sampling rate is known
        early = np.empty(0)
        for block in to_one_clock(blocks):
            self.name = block.name
            if elements is None:
                elements = find_elements(block)
                self._check(block, elements)
                self._warn_other_unit(block)
                if isinstance(self.options.calibration, Calibration):
                    self.held = array_calibration(self.options.calibration, elements, block.name)
                self.health = Health(elements.names)
                self.checks = Checks(elements.names)
            settled = stream is not None and self.clock.settled
            before = self.clock.rate
            self.clock.watch(block)
            readings, time = elements.readings(block), block.si("time")
            self._drop_zeros(readings)
            if self.checks is not None:
                self.checks.watch(readings)
            if self.held is not None and (self.first is None or len(self.first) < _FOR_NOISE):
                before_it = [] if self.first is None else [self.first]
                self.first = np.concatenate([*before_it, readings])[:_FOR_NOISE]
            fused_before = 0
            if not settled:
                early = np.concatenate([early, time])
                fused_before = 0 if head is None else len(head)
                head = readings if head is None else np.concatenate([head, readings])
                if stream is None or self.clock.rate != before:
                    # The settings' times are another number of samples now: start again from the first sample.
                    stream = self._open(block, elements, head)
                    readings, time = head, early
                else:
                    fused_before = 0
            still = self.options.still
            at_rest = None if still is None else (time >= still[0]) & (time < still[1])
            out = stream.process(np.ascontiguousarray(readings), weights=self.weights, still=at_rest)
            if not settled and self.clock.settled:
                head = None
            yield self._fused(block, out, fused_before, elements)

    def notes(self) -> list[str]:
        """Return messages after the last block: gaps, rows of zeros, and the results of `Checks`."""
        more: list[str] = []
        if self.options.method == "feedback" and self.health is not None:
            more = feedback_notes(len(self.health.names[0]), self.clock.rate)
        known = self.health.stuck() if self.health is not None else ()
        lines = []
        if self.checks is not None:
            lines = self.checks.lines(turned=not self._aligns(), known=known)
            if self.held is None or self.first is None:
                lines += warn_misaligned(self.checks, None)
            else:
                scale = warn_other_scale(self.held, self.first, self.clock.rate)
                lines += scale or warn_misaligned(self.checks, self.held.matrices)
        if self.lost:
            rows = f"{self.lost} row{'s' * (self.lost > 1)}"
            text = f"{rows} left out: every gyro is exactly zero; the output is nan there"
            lines = [*lines, Finding(text, "check the link to the array, and record again")]
        return [*self.other, *self.clock.lines(self.name), *(prefixed(self.name, line) for line in [*lines, *more])]

    def _warn_other_unit(self, block: Recording) -> None:
        records = (self.options.calibration, self.options.initial_bias)
        known = [each.sensor for each in records if not isinstance(each, str | None)]
        lines = [*dict.fromkeys(line for sensor in known for line in warn_other_unit(sensor, block))]
        if self.tell is None:
            self.other = lines
            return
        for line in lines:  # said now, and not at the end again
            self.tell(line)

    def _drop_zeros(self, readings: Array) -> None:
        """Set rows of a block, (m, axes, n), in which every gyro is exactly zero to NaN."""
        flat = readings.reshape(len(readings), -1)
        if not (flat[:, 0] == 0).any():
            before = [] if self.before is None or len(flat) >= HISTORY else [self.before]
            self.before = np.vstack([*before, flat[-HISTORY:]])[-HISTORY:]
            return
        joined = flat if self.before is None else np.vstack([self.before, flat])
        zero = zero_rows(list(joined.T))[len(joined) - len(flat) :]
        self.before = joined[(joined != 0).any(axis=1)][-HISTORY:]
        self.lost += int(np.count_nonzero(zero))
        readings[zero] = np.nan

    def _aligns(self) -> bool:
        record = self.options.calibration
        return isinstance(record, Blob) or (record is not None and model_of(record).aligned)

    def _fused(self, block: Recording, out: Any, fused_before: int, elements: Elements) -> Fused:
        time, rate = block.si("time"), out.rate[fused_before:]
        flags = out.flags[fused_before:] if out.flags is not None else None
        if self.health is not None:
            for key in self.health.watch(time, flags, rate):
                if self.tell is not None:
                    self.tell(self.health.first(key))
        return Fused(
            time=time,
            rate=rate,
            weights=out.weights[fused_before:] if out.weights is not None else None,
            flags=flags,
            elements=elements,
            health=self.health or Health(elements.names),
            block=block,
        )

    def _check(self, block: Recording, elements: Elements) -> None:
        if self.options.method in _NEED_THREE and elements.count < FEWEST_ROBUST:
            known = " ".join(name for row in elements.names for name in row)
            raise DataError(
                f"{block.name}: method {self.options.method} needs {FEWEST_ROBUST} gyros on each axis, "
                f"found {elements.count} ({known}); --method mean fuses fewer"
            )

    def _open(self, block: Recording, elements: Elements, first: Array) -> Any:
        return open_stream(self.options, elements, self.clock.rate, first[:_FOR_NOISE], block.name)


def warn_other_scale(held: ArrayCalibration, readings: Array, rate: float) -> list[str]:
    """Return a warning where noise and biases are as much smaller or larger than in the record as another unit is.

    Both are taken about the mean of the array, from which motion drops out; filters change the noise, and turning on
    the biases, but not both by the factor between two units. `readings` have the shape (m, axes, n).
    """
    finite = readings[np.isfinite(readings).all(axis=(1, 2))]
    if len(finite) < _FOR_SCALE or readings.shape[2] < FEWEST_ROBUST:
        return []
    aligned = finite if held.matrices is None else np.einsum("iab,mbi->mai", held.matrices, finite)
    zero = held.bias if held.matrices is None else np.einsum("iab,bi->ai", held.matrices, held.bias)
    apart = aligned.mean(axis=0)
    spreads = [np.std(each - each.mean(axis=1, keepdims=True)) for each in (apart, zero)]
    noise = noise_about_mean(aligned) / (deviations_after_alignment(held.matrices, held.white) * math.sqrt(rate))
    ratio = float(np.median(noise))
    if not (ratio > 0 and spreads[0] > 0 and spreads[1] > 0):
        return []
    by_bias, size = float(spreads[0] / spreads[1]), max(ratio, 1 / ratio)
    unit = next((words for factor, words in UNIT_FACTORS.items() if 1 / NEAR_UNIT < size / factor < NEAR_UNIT), None)
    if unit is None or not 1 / _NEAR_BIASES < by_bias / ratio < _NEAR_BIASES:
        return []
    return [
        Bad(
            f"noise and biases of the gyros are {plain_number(size, 3)} times as {'large' if ratio > 1 else 'small'} "
            f"as in the record: another unit ({unit})? The fused rate is off as much",
            "correct the unit of the columns (--unit)",
        )
    ]


def warn_misaligned(checks: Checks, matrices: Array | None) -> list[str]:
    """Return a warning where elements turn otherwise than the matrices of a record say, (n, axes, axes), if any."""
    turns = None if matrices is None else checks.regression()
    if matrices is None or turns is None:
        return []
    weights, follows, _ = turns
    gains = np.einsum("iab,bic,cd->iad", matrices, weights, np.linalg.inv(matrices[0]))
    off = np.abs(gains - np.eye(len(gains[0]))).max(axis=(1, 2))
    wrong = np.flatnonzero(follows.all(axis=0) & (off > _MISALIGNED)).tolist()
    if not wrong:
        return []
    row = checks.names[0]
    return [
        Finding(
            f"in motion {' '.join(row[i] for i in wrong)}, corrected by the record, differ from {row[0]} by up to "
            f"{100 * off[wrong].max():.0f} %: the record does not hold for this recording",
            "calibrate the array again, with --moving",
        )
    ]

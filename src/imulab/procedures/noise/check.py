"""The test of a new log at rest against the noise of a record: whether they agree, what differs, and its report.

Source: `imulab.estimation.noise.agreement` (likelihood ratio and octaves of the spectra).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import Annotated, Any, ClassVar, TypeAlias, Unpack

import numpy as np

from imulab.display import Note
from imulab.errors import DataError, OptionError, RecordError, UnitError, listed
from imulab.estimation.decisions import NOISE_CHECK
from imulab.estimation.distributions import probability_fact, probability_text
from imulab.estimation.noise.agreement import Agreement, agreement
from imulab.estimation.noise.analysis import CANDIDATES
from imulab.estimation.noise.likelihood import fit, time_limits, within
from imulab.estimation.noise.rest import Rest
from imulab.estimation.noise.spectrum import Spectrum, frequencies
from imulab.estimation.noise.terms import NAMES, edge_as_white, prepare
from imulab.estimation.rows import NORMAL_95
from imulab.options import text
from imulab.procedures.noise.fit import fit_recordings, given_log
from imulab.procedures.noise.schema import Column, NoiseSummary, drawn_of, fit_of, label
from imulab.procedures.result import RecordCheck, as_record, warn_made_from
from imulab.quantities import fraction
from imulab.recording import Array, Data, Reading, Recording
from imulab.records.calibration import Calibration
from imulab.records.comparison import different_units
from imulab.report import traces as panels
from imulab.report.traces import BAD, GOOD, Exhibits, Figure, rounded, scatter, table
from imulab.units import si_unit

# The result: verdict, changes of the terms, and octaves of both spectra.


_DIGITS = 5  # of the numbers in a drawing
_TICKS = [0.01, 0.1, 0.2, 0.5, 1, 2, 5, 10, 100]  # of an axis of ratios
# Changes of size below this are stated in per cent; octaves of a smaller probability are named
_HALF, _CERTAIN = 0.5, 0.05


@dataclass(frozen=True)
class TermChange:
    """A term in the log over that in the record, with its 95 % interval."""

    term: str
    ratio: float
    low: float
    high: float

    @property
    def score(self) -> float:
        """Standard uncertainties by which the logarithm of the ratio differs from 0."""
        return abs(math.log(self.ratio)) / (math.log(self.high / self.low) / 2 / NORMAL_95)


@dataclass(frozen=True)
class ColumnCheck:
    """Result of the test of one column.

    Attributes
    ----------
    name, unit
        Name of the column, and its unit in SI.
    agreement
        The tests.
    changes
        Changes of the terms of the record's model.
    """

    name: str
    unit: str
    agreement: Agreement
    changes: tuple[TermChange, ...]

    @property
    def probability(self) -> float:
        """Probability of so large a difference if nothing changed."""
        return self.agreement.probability

    def text(self) -> str:
        """Return what changed, by how much, with 95 % intervals: the certain changes, or the most certain one."""
        certain = [each for each in self.changes if not each.low < 1 < each.high] or list(self.changes[:1])
        parts = [f"{label(each.term, self.unit)} {times(each.ratio, each.low, each.high)}" for each in certain]
        octaves = self.agreement.octaves
        if float(octaves.probability) < min(_CERTAIN, self.agreement.terms_probability):
            worst = int(np.argmax(np.abs(octaves.scores)))
            low, high = (float(np.sqrt(end[worst])) for end in octaves.interval)
            size = times(float(np.sqrt(octaves.ratio[worst])), low, high)
            parts.append(f"noise from {octaves.low[worst]:.2g} to {octaves.high[worst]:.2g} Hz {size}")
        return "; ".join(parts)

    def content(self) -> dict[str, Any]:
        """Return the result for scripts."""
        octaves = self.agreement.octaves
        return {
            "p": self.probability,
            "p_terms": self.agreement.terms_probability,
            "p_octaves": float(octaves.probability),
            "changes": {
                change.term: {"ratio": change.ratio, "interval_95": [change.low, change.high]}
                for change in self.changes
            },
            "octaves": [
                {"from": float(low), "to": float(high), "unit": "Hz", "ratio": float(np.sqrt(ratio))}
                for low, high, ratio in zip(octaves.low, octaves.high, octaves.ratio, strict=True)
            ],
        }


@dataclass(frozen=True, repr=False)
class NoiseCheck(RecordCheck):
    """Result of the test of a log against a record's noise.

    Attributes
    ----------
    columns
        Results by column.
    false_alarm
        Largest share of logs of unchanged noise that fail.
    tolerance
        Relative change of size that the test allows.
    notes
        Notes on the test, a sentence each.
    log
        Record of the log, as `fit_noise` makes it.
    """

    columns: Mapping[str, ColumnCheck]
    false_alarm: float
    tolerance: float
    notes: tuple[str, ...]
    log: Calibration

    subject: ClassVar[str] = "Noise check"
    data: ClassVar[str] = "log"

    @property
    def probability(self) -> float:
        """Probability of so large a difference in any column if nothing changed: ``1 - (1 - min p)^k``, k columns."""
        least = min(each.probability for each in self.columns.values())
        return -math.expm1(len(self.columns) * math.log1p(-min(least, 1 - 1e-16)))

    @property
    def passed(self) -> bool:
        """Whether the log agrees with the record."""
        return self.probability >= self.false_alarm

    def differs(self, name: str) -> bool:
        """Return whether a column alone fails."""
        share = -math.expm1(math.log1p(-self.false_alarm) / len(self.columns))
        return self.columns[name].probability < share

    @property
    def worst(self) -> ColumnCheck:
        """The column that differs most."""
        return min(self.columns.values(), key=lambda column: column.probability)

    def meaning(self) -> str:
        """Return the result in words."""
        if self.passed:
            return "the log agrees with the noise of the record"
        return f"the noise is not that of the record; most in {self.worst.name}: {self.worst.text()}"

    def next_step(self, record: str, files: Sequence[str]) -> str:
        """Return how to follow the change."""
        return (
            f"'imulab noise fit {' '.join(files)} -o NEW.json' makes a record that follows the change, "
            f"'imulab show {record} NEW.json' compares the two"
        )

    def measured(self) -> list[str]:
        """Return the result of every column, a line each."""
        many = len(self.columns)
        lines = [f"{probability_text(self.probability)} over {many} column{'s' if many > 1 else ''}"]
        for name, column in self.columns.items():
            lines.append(f"{name}: {probability_text(column.probability)}; {column.text()}")
        return lines

    def content(self) -> dict[str, Any]:
        """Return what was measured, for scripts."""
        return {
            "p": self.probability,
            "false_alarm": self.false_alarm,
            "tolerance": self.tolerance,
            "columns": {name: column.content() for name, column in self.columns.items()},
        }

    def exhibits(self) -> Exhibits:
        """Return what its report shows."""
        columns: dict[str, Callable[[ColumnCheck], str]] = {
            "column": lambda column: column.name,
            "result": lambda column: "differs" if self.differs(column.name) else "agrees",
            "p": lambda column: probability_fact(column.probability),
            "the log against the record": ColumnCheck.text,
        }
        shown = table(
            "Columns",
            "p: of so large a difference in this column, if nothing changed. Then the terms of the record's model in "
            "the log against the record, with 95 % intervals, the most certain change first.",
            columns,
            self.columns.values(),
            highlight=None if self.passed else list(self.columns).index(self.worst.name),
        )
        pages = panels.pages(list(self.columns))
        facts = [
            ("p, if nothing changed", probability_fact(self.probability)),
            ("false alarms", f"{100 * self.false_alarm:.3g} %"),
            ("not held against it", f"{100 * self.tolerance:.3g} %"),
        ]
        figures = [_octaves(self, page, k, len(pages)) for k, page in enumerate(pages)]
        return self.exhibits_with(facts, [shown, *figures], f"; {probability_text(self.probability)}")


def times(ratio: float, low: float, high: float) -> str:
    """Return a ratio in words: ``10 % larger (9 to 11 %)``, ``2.1 times the record's (1.7 to 2.6)``."""
    if not 1 - _HALF < low < high < 1 + _HALF:
        return f"{ratio:.2g} times the record's ({low:.2g} to {high:.2g})"
    change, ends = 100 * (ratio - 1), sorted((100 * (low - 1), 100 * (high - 1)))
    if change < 0:
        ends = [-ends[1], -ends[0]]
    places = max(0, -math.floor(math.log10(max(ends[1] - ends[0], 1e-9) / 2)))
    word = "larger" if change >= 0 else "smaller"
    return f"{abs(change):.{places}f} % {word} ({ends[0]:z.{places}f} to {ends[1]:z.{places}f} %)"


def _octaves(check: NoiseCheck, names: Sequence[str], page: int, pages: int) -> Figure:
    layout = panels.grid()
    traces: list[dict[str, Any]] = []
    outside = count = 0
    for index, name in enumerate(names):
        octaves = check.columns[name].agreement.octaves
        x, y = panels.names(index)
        ratio = np.sqrt(octaves.ratio)
        low, high = (np.sqrt(end) for end in octaves.interval)
        off = (low > 1) | (high < 1)
        outside, count = outside + int(off.sum()), count + len(off)
        for part, colour in ((~off, GOOD), (off, BAD)):
            error = {"type": "data", "array": rounded((high - ratio)[part], _DIGITS), "color": colour, "width": 0,
                     "arrayminus": rounded((ratio - low)[part], _DIGITS)}  # fmt: skip
            f = np.sqrt(octaves.low * octaves.high)[part]
            traces.append(
                scatter(rounded(f, _DIGITS), rounded(ratio[part], _DIGITS), "markers", xaxis=x, yaxis=y, error_y=error,
                        marker={"color": colour, "size": 6}, hovertemplate="%{x:.3g} Hz: %{y:.3g}<extra></extra>")
            )  # fmt: skip
        panels.panel(layout, index, len(names), name)
        title = {"text": "frequency, Hz", "font": {"size": 11}, "standoff": 4}
        layout[panels.axis_key(x)] |= {"type": "log", "dtick": 1, "title": title}
        reach = float(np.log10(max(2.0, 1.1 * ratio.max(initial=1.0), 1.1 / ratio.min(initial=1.0))))
        layout[panels.axis_key(y)] |= {"type": "log", "range": [-reach, reach], "tickvals": _TICKS}
    return Figure(
        title=panels.paged("Size of the noise in the log over that in the record, by octaves", page, pages),
        message=f"{outside} of {count} octaves are off 1 beyond their 95 % interval; one in twenty is by chance.",
        caption="Root of the ratio of mean squares, with its 95 % interval; 1 where nothing changed, whatever the "
        "model. Slow noise, on the left, is of few coefficients.",
        traces=traces,
        layout=layout,
        height=panels.height(len(names)),
    )


# The test.


FALSE_ALARM, TOLERANCE = f"{100 * NOISE_CHECK.level:g} %", "1 %"
_SAME_RATE = 0.01  # relative: a log of another rate has another spectrum
Choose: TypeAlias = Callable[[Recording], Sequence[str]]
"""Names of the columns of a log to test, from its first rows."""


def check_noise(
    record: Calibration | str | PathLike[str],
    data: Data | Sequence[Data],
    *,
    tolerance: Annotated[float | str, text("FRACTION")] = TOLERANCE,
    false_alarm: Annotated[float | str, text("FRACTION")] = FALSE_ALARM,
    **reading: Unpack[Reading],
) -> NoiseCheck:
    """Test whether a new log at rest is of the noise of a record, column by column.

    Two tests of each column, on mean squares of cosine coefficients: the likelihood ratio of one model for record and
    log against one for each, over its mean under the common model; and the ratios of both in octaves of frequency, F
    variables whatever the model. The smallest probability of all tests is corrected for their number.

    Parameters
    ----------
    record
        Of `fit_noise`, or its file.
    data
        A log of the same sampling rate, or a list of logs, as for `fit_noise`.
    tolerance
        Change of size that is not held against the log. Relative change of the size of the noise, in an octave, however
        long the log is: no sensor keeps its noise to better than about 1 %. 0: none.
    false_alarm
        Share of logs of unchanged noise that fail; with a tolerance, at most.
    reading
        How arrays and files are to be understood, as for `fit_noise`.

    Raises
    ------
    RecordError
        The record is of another procedure.
    DataError, UnitError
        The log has another sampling rate, none of the record's columns, or other units; and as for `fit_noise`.
    OptionError
        An option has a value that cannot be used.

    Examples
    --------
    >>> import imulab as il
    >>> noise = {"white": "0.3 deg/sqrt(h)", "walk": "30 deg/h/sqrt(h)", "duration": "10 min"}
    >>> record = il.fit_noise(il.simulate_noise(**noise)).calibration
    >>> il.check_noise(record, il.simulate_noise(**noise, seed=3)).passed
    True
    >>> noise["white"] = "0.33 deg/sqrt(h)"
    >>> il.check_noise(record, il.simulate_noise(**noise, seed=3)).passed
    False

    Source: Bartlett (1937), the mean of a likelihood ratio; Whittle (1953).
    """
    held = as_record(record, "check_noise")
    alone = not isinstance(data, list | tuple) or not data or not all(_is_log(each) for each in data)
    logs = [data] if alone else list(data)  # type: ignore[arg-type]

    def read(choose: Choose) -> list[Recording | Rest]:
        return [given_log(each, reading, check_noise, choose) for each in logs]  # type: ignore[arg-type]

    return check_logs(held, read, tolerance, false_alarm)


def _is_log(data: object) -> bool:
    from imulab.frames import is_frame

    return isinstance(data, str | PathLike | Recording | Mapping) or is_frame(data)


def check_logs(
    record: Calibration,
    read: Callable[[Choose], Sequence[Recording | Rest]],
    tolerance: float | str,
    false_alarm: float | str,
) -> NoiseCheck:
    """Return the test of logs against a record; `read` returns them from a choice of columns. Else as `check_noise`."""
    if record.procedure != "noise":
        raise RecordError(f"a {record.procedure} record holds no model of noise; expected a record of noise fit")
    allowed, share = fraction(tolerance, "tolerance"), fraction(false_alarm, "false_alarm")
    if not 0 <= allowed < 1:
        raise OptionError(f"tolerance {tolerance}: expected a share from 0 to 1, such as 1 %")
    if not 0 < share < 1:
        raise OptionError(f"false_alarm {false_alarm}: expected a share between 0 and 1, such as 5 %")
    fit = fit_of(record)
    logs = read(lambda first: [name for name in fit.columns if name in first])
    recordings = [log.recording if isinstance(log, Rest) else log for log in logs]
    names, notes = _shared_columns(record, fit, recordings)
    options = record.options
    log_record = fit_recordings(
        logs, terms="auto", horizon=fit.columns[names[0]].interval.value, band=None,
        regress=options.get("regress"), columns=names, steps=options.get("steps"),
    ).calibration  # fmt: skip
    rate = fit_of(log_record).sample_rate.value
    if abs(rate / fit.sample_rate.value - 1) > _SAME_RATE:
        raise DataError(
            f"{recordings[0].name}: {rate:.4g} samples in a second, but the record is of {fit.sample_rate.value:.4g}; "
            "expected a log of the record's rate"
        )
    notes += [f"log: {reason}" for reason in log_record.verdict.reasons]
    checked = {name: _check_column(record, log_record, name, allowed) for name in names}
    return NoiseCheck(checked, share, allowed, tuple(notes), log_record)


def _shared_columns(
    record: Calibration, fit: NoiseSummary, recordings: Sequence[Recording]
) -> tuple[list[str], list[str]]:
    """Return the record's columns that all logs have in its units, and notes on the others."""
    notes: list[str] = []
    names = [name for name in fit.columns if all(name in each for each in recordings)]
    for recording in recordings:
        if not names:
            raise DataError(
                f"{recording.name}: none of the record's columns {' '.join(fit.columns)}; "
                f"found {listed(recording.columns, '')}"
            )
        for name in names:
            if si_unit(recording.units[name]) != fit.columns[name].unit:
                raise UnitError(
                    f"{recording.name}: column {name} in {recording.units[name]}, but the record has it in "
                    f"{fit.columns[name].unit}; expected the same quantity"
                )
        if other := different_units((recording.name, recording.metadata), ("the record", record.sensor)):
            notes.append(other)
        notes += warn_made_from(record, [recording])
    if missing := [name for name in fit.columns if name not in names]:
        notes.append(Note(f"not in the log, and not checked: {' '.join(missing)}"))
    return names, notes


def _check_column(record: Calibration, log: Calibration, name: str, tolerance: float) -> ColumnCheck:
    column, highest = fit_of(record).columns[name], fit_of(record).band[name].value
    first, off = _spectra(record, name)
    second, _ = _spectra(log, name)
    before, after = ([_limit_band(each, highest, off) for each in part] for part in (first, second))
    chosen = str(record.options.get("terms", "auto"))
    candidates = CANDIDATES if chosen == "auto" else (chosen,)
    comparison = agreement(
        before, after, highest, tolerance=tolerance, candidates=candidates, full_band=column.full_band
    )
    return ColumnCheck(name, column.unit, comparison, _fit_changes((before, after), column))


def _spectra(record: Calibration, name: str) -> tuple[list[Spectrum], list[tuple[float, float]]]:
    """Return the spectra of a column without lines, and the ranges of frequency, Hz, left out of its model's fit."""
    spectra, off = [], []
    for each in drawn_of(record, name).spectra:
        first, last = np.array(each.first), np.array(each.last)
        spectrum = Spectrum(each.interval, each.count, first, last, np.array(each.power), np.array(each.freedom))
        left = np.flatnonzero((np.array(each.counted) == 0) & (spectrum.freedom > 0)).tolist()
        off += [((first[k] - 0.5) / (2 * spectrum.length), (last[k] + 0.5) / (2 * spectrum.length)) for k in left]
        spectra.append(spectrum)
    return spectra, off


def _limit_band(spectrum: Spectrum, highest: float, off: Sequence[tuple[float, float]]) -> Spectrum:
    f = frequencies(spectrum)
    out = np.zeros(len(f), dtype=np.bool_)
    for low, high in off:
        if high <= highest:
            out |= (f > low) & (f < high)
    return within(replace(spectrum, freedom=np.where(out, 0.0, spectrum.freedom)), highest)


def _fit_changes(sets: Sequence[Sequence[Spectrum]], column: Column) -> tuple[TermChange, ...]:
    """Return the changes of the terms of the record's model, fitted to both, the most certain change first."""
    model = np.array(column.values) > 0
    fitted: list[tuple[Array, Array]] = []
    for spectra in sets:
        bins = prepare(spectra)
        refitted = fit(bins, model[None], time_limits(spectra), bins.power[None], bins.freedom[None])
        fitted.append(edge_as_white(refitted.values[0], refitted.covariance[0], column.shortest_time.value))
    (before, covariance), (after, other) = fitted
    changes = []
    for k, term in enumerate(NAMES):
        if before[k] > 0 and after[k] > 0:
            ratio, u = float(after[k] / before[k]), float(np.sqrt(covariance[k, k] + other[k, k]))
            changes.append(TermChange(term, ratio, ratio * math.exp(-NORMAL_95 * u), ratio * math.exp(NORMAL_95 * u)))
    return tuple(sorted(changes, key=lambda each: -each.score))

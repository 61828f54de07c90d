"""The plan of a record at rest: the length that a wanted uncertainty of each noise term needs.

Source: the Cramer-Rao bound, `imulab.estimation.noise.duration`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from imulab.errors import OptionError, listed
from imulab.estimation.noise.duration import accuracy, accuracy_curve, length_for, visible
from imulab.estimation.noise.rest import FEWEST, SHORT
from imulab.estimation.noise.terms import NAMES, edge_as_white
from imulab.options import measure, repeated, text
from imulab.procedures.noise.schema import Markov, fit_of, given_terms, label, term_reading, term_unit
from imulab.procedures.noise.simulate import RATE, read_names, terms_of
from imulab.procedures.result import PlannedTest, Record, amount, as_record, finite
from imulab.quantities import fraction, in_si
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration
from imulab.report.plots import Plot
from imulab.report.traces import DASHES, LEGEND, QUIET, Figure, log_axis, plain_number, rounded, scatter
from imulab.writers import write_csv

WANTED = "10 %"
_DRAWS = 30  # records drawn for the limits of a record of another length
_ANY = ""
_HOUR = 3600.0  # s
_UNITS = ((1.0, "s", 120.0), (60.0, "min", 120.0), (_HOUR, "h", 100.0), (24 * _HOUR, "d", math.inf))
_COLOURS = ("#1f6f8b", "#c8553d", "#8e6bbd", "#c99a2e", "#4f9d69", "#22303a")


@dataclass(frozen=True)
class PlannedTerm:
    """A term of a column, and the uncertainty that a record gives it.

    Attributes
    ----------
    column, term, unit
        Names, as in a record, and the SI unit of the column.
    value
        SI; 0 of a term that does not show.
    uncertainty
        Relative standard uncertainty from a record of the plan's length; NaN of a term that does not show.
    limit
        Upper limit from such a record with 95 %, SI; NaN of a term that shows.
    wanted
        Relative standard uncertainty; NaN where none is wanted.
    length
        Length of the record that reaches it, s; infinite where none does.
    """

    column: str
    term: str
    unit: str
    value: float
    uncertainty: float
    limit: float
    wanted: float
    length: float


@dataclass(frozen=True, repr=False)
class NoisePlan(PlannedTest):
    """The planned record at rest.

    Attributes
    ----------
    terms
        Terms, column by column.
    length
        Length of the record that the uncertainties belong to, s.
    lengths
        Lengths of records, s, shape (t,).
    reached
        Relative standard uncertainty of each parameter from them, by column, shape (t, 8), in the order of the terms
        white flicker walk quantisation gm1_sigma gm1_time gm2_sigma gm2_time; NaN where there is none.
    """

    terms: tuple[PlannedTerm, ...]
    length: float
    lengths: Array
    reached: Mapping[str, Array]

    @property
    def needed(self) -> float:
        """Length of the record that reaches every wanted uncertainty, s."""
        return max((each.length for each in self._wanted), default=0.0)

    @property
    def _wanted(self) -> list[PlannedTerm]:
        return [each for each in self.terms if each.wanted > 0 and each.value > 0]

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return which record is needed, and the uncertainty of each term."""
        titles = ["column", "term", "value", "unit", f"u, {duration_text(self.length)}", "wanted", "needs"]
        return self._lead(), titles, [_row(each) for each in self.terms]

    def _lead(self) -> str:
        if not self._wanted:
            return "No term that is wanted is seen; a longer record shows it, or lowers its limit."
        longest = max(self._wanted, key=lambda each: each.length)
        what = f"{longest.column}, {label(longest.term, longest.unit)}"
        if math.isinf(longest.length):
            return f"No record reaches {_percent(longest.wanted)} of {what}."
        return f"A record of {duration_text(longest.length)} reaches what is wanted; longest for {what}."

    def content(self) -> dict[str, Any]:
        """Return the plan for scripts, in SI; null where a number is none."""
        terms = [
            {
                "column": planned.column,
                "term": planned.term,
                "value": planned.value,
                "unit": term_unit(planned.term, planned.unit),
                "relative_standard_uncertainty": finite(planned.uncertainty),
                "limit": finite(planned.limit),
                "wanted": finite(planned.wanted),
                "length": amount(planned.length, "s") if math.isfinite(planned.length) else None,
            }
            for planned in self.terms
        ]
        return {"length": amount(self.length, "s"), "terms": terms}

    def save(self, path: str | Path) -> None:
        """Write the relative standard uncertainties over the length of a record as CSV.

        Raises
        ------
        OptionError
            The file cannot be written.
        """
        write_csv(self.curves(), path)

    def curves(self) -> Recording:
        """Return the relative standard uncertainty of each term over the length of a record, s."""
        columns = {"length": self.lengths}
        columns |= {
            f"u_{each.column}_{each.term}": self.reached[each.column][:, NAMES.index(each.term)]
            for each in self.terms
            if each.value > 0
        }
        return Recording(columns, {"length": "s", **dict.fromkeys(list(columns)[1:], "1")}, {}, name="noise plan")

    def plot(self) -> Plot:
        """Return the accuracy of each term over the length of the record."""
        return Plot(plan_figure(self), "Noise plan")


def plan_figure(plan: NoisePlan) -> Figure:
    """Return the relative standard uncertainty of each term over the length of the record, in h."""
    known = [each for each in plan.terms if each.value > 0]
    columns = list(dict.fromkeys(each.column for each in known))
    kinds = list(dict.fromkeys(each.term for each in known))
    top = min(max((each.length for each in plan._wanted if math.isfinite(each.length)), default=_HOUR) * 30, 1e9)
    shown_ = plan.lengths <= max(top, 10 * plan.length)
    traces: list[dict[str, Any]] = []
    for each in known:
        reached = 100 * plan.reached[each.column][shown_, NAMES.index(each.term)]
        line = {
            "color": _COLOURS[kinds.index(each.term) % len(_COLOURS)],
            "dash": DASHES[columns.index(each.column) % len(DASHES)],
        }
        name = f"{each.column}, {label(each.term, each.unit)}"
        traces.append(
            scatter(rounded(plan.lengths[shown_] / _HOUR, 5), rounded(np.where(reached < 300, reached, np.nan), 5),
                    "lines", name=name, line=line, hovertemplate="%{x:.3g} h: %{y:.2g} %<extra>" + name + "</extra>")
        )  # fmt: skip
    levels = sorted({each.wanted for each in plan._wanted})
    least = min(levels, default=0.1)
    for wanted in levels:
        ends = plan.lengths[shown_][[0, -1]] / _HOUR
        traces.append(
            scatter(ends.tolist(), [100 * wanted] * 2, "lines", name=f"wanted, {_percent(wanted)}", hoverinfo="skip",
                    line={"color": QUIET, "width": 1, "dash": "dot"})
        )  # fmt: skip
    return Figure(
        title="Accuracy of each noise term over the length of the record",
        caption="Relative standard uncertainty that a record at rest can reach (the Cramer-Rao bound). Four times the "
        "record halves it, once the term is seen at all.",
        traces=traces,
        layout={"xaxis": log_axis("length of the record, h"), "legend": LEGEND,
                "yaxis": log_axis("standard uncertainty, %", range=np.log10([100 * least / 30, 300]).tolist())},
        height=430,
        message=plan._lead(),
    )  # fmt: skip


def duration_text(seconds: float) -> str:
    """Return a duration with a usual unit: ``35 min``, ``6.4 h``, ``12 d``."""
    factor, unit = next((factor, unit) for factor, unit, most in _UNITS if seconds / factor < most)
    return f"{plain_number(seconds / factor, 2)} {unit}"


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"


def _row(each: PlannedTerm) -> list[str]:
    unit, factor = term_reading(each.term, each.unit).scale
    name = label(each.term, each.unit)
    if not each.value > 0:
        return [each.column, name, "not seen", unit, f"below {plain_number(each.limit * factor, 2)}", "–", "–"]
    wanted = _percent(each.wanted) if each.wanted > 0 else "–"
    needs = "–" if not each.wanted > 0 else "no record" if math.isinf(each.length) else duration_text(each.length)
    value = plain_number(each.value * factor, 3)
    predicted = f"{plain_number(100 * each.uncertainty, 2)} %" if each.uncertainty < 1 else "not told"
    return [each.column, name, value, unit, predicted, wanted, needs]


def plan_noise(
    *,
    from_: Record | None = None,
    for_: Annotated[float | str | Mapping[str, float | str], text("10%|walk=10%,..")] = WANTED,
    white: Annotated[float | str | None, text("N")] = None,
    flicker: Annotated[float | str | None, text("B")] = None,
    walk: Annotated[float | str | None, text("K")] = None,
    quantisation: Annotated[float | str | None, text("Q")] = None,
    gm: Annotated[Markov | Sequence[Markov] | None, repeated("SIGMA:TIME")] = None,
    rate: Annotated[float | str | None, measure("frequency", "Hz")] = None,
    duration: Annotated[float | str | None, measure("time", "s")] = None,
    columns: Annotated[str | Sequence[str] | None, text("A,A,...")] = None,
) -> NoisePlan:
    """Say how long to record at rest for a wanted accuracy of each noise term.

    The relative standard uncertainty of a parameter is the root of the diagonal of the inverse of
    ``1/2 sum_b d_b (d ln lambda_b)(d ln lambda_b)'``, lambda_b the variance of the d_b cosine coefficients of
    bin b: the Cramer-Rao bound of their logarithms, which the fit reaches.

    Parameters
    ----------
    from_
        In place of terms: those of a record of noise fit. Or its file: its terms, band and rate.
    for_
        Wanted standard uncertainty, of all terms or by name. Relative, of their sizes: ``"10 %"``,
        ``"walk=10%,gm1_time=30%"``.
    white, flicker, walk, quantisation, gm, rate
        As for `simulate_noise`. In place of a record, for example those of a data sheet. A noise density of a data
        sheet is often one-sided: N is that over the root of 2.
    duration
        What a record of this length tells. In s; if not given, that of the record, or the one that is needed.
    columns
        Columns of the record.

    Raises
    ------
    OptionError
        There are neither terms nor a record, a term that is wanted is none of them or comes twice, or the duration is
        shorter than what a fit needs.
    RecordError
        The record is of another procedure.

    Examples
    --------
    >>> import imulab as il
    >>> il.plan_noise(white="0.3 deg/sqrt(h)", walk="10 deg/h/sqrt(h)", for_="walk=10%")
    A record of 6.1 h reaches what is wanted; longest for gyro, rate random walk.
    column  term               value  unit           u, 6.1 h  wanted  needs
    gyro    angle random walk  0.300  deg/sqrt(h)     0.048 %       –      –
    gyro    rate random walk    10.0  deg/h/sqrt(h)    10.0 %    10 %  6.1 h
    """
    terms = {"white": white, "flicker": flicker, "walk": walk, "quantisation": quantisation, "gm": gm}
    wanted = _read_wanted(for_)
    seconds = None if duration is None else in_si(duration, "duration", "time", "s")
    if seconds is not None and not 0 < seconds < 1e9:
        raise OptionError(f"duration {seconds:g} s: expected more than 0")
    if from_ is None:
        stated_terms = given_terms("rad/s", **terms)  # type: ignore[arg-type]
        name = {"rad/s": "gyro", "m/s^2": "accel"}.get(stated_terms.unit, "output")
        hertz = in_si(RATE if rate is None else rate, "rate", "frequency", "Hz")
        if not 1e-3 <= hertz <= 1e6:
            raise OptionError(f"rate {hertz:g} Hz: expected 0.001 to 1e6")
        noise = {name: _Column(stated_terms.values, stated_terms.unit, 1 / hertz, None, 0.0, {}, 0.0)}
        record_length = None
    else:
        for name, value in {**terms, "rate": rate}.items():
            if value not in (None, (), []):
                raise OptionError(f"{name}: the record says that already; expected either terms or a record")
        noise, record_length = _record_columns(as_record(from_, "plan_noise"), columns)
    return _plan_terms(noise, wanted, seconds or record_length)


@dataclass(frozen=True)
class _Column:
    """Noise of a column: parameters, SI unit, time between samples, f_max, ripple, limits of absent terms, length."""

    values: Array
    unit: str
    interval: float
    highest: float | None
    ripple: float
    limits: Mapping[str, float]
    length: float


def _record_columns(record: Calibration, columns: str | Sequence[str] | None) -> tuple[dict[str, _Column], float]:
    values, units, _ = terms_of(record, read_names(columns))
    fit = fit_of(record)
    by_column = {}
    for name in values:
        column = fit.columns[name]
        unseen = {
            term: p.interval_95[1]
            for term in NAMES
            if (p := record.parameters.get(f"{name}_{term}")) is not None and p.value == 0 and p.interval_95
        }
        inside = edge_as_white(values[name], np.eye(len(NAMES)), column.shortest_time.value)[0]
        dt, band, length = column.interval.value, fit.band[name].value, column.length.value
        by_column[name] = _Column(inside, units[name], dt, band, column.ripple, unseen, length)
    return by_column, max(fit.columns[name].length.value for name in values)


def _plan_terms(noise: Mapping[str, _Column], wanted: Mapping[str, float], length: float | None) -> NoisePlan:
    known = {
        name
        for column in noise.values()
        for k, name in enumerate(NAMES)
        if column.values[k] > 0 or name in column.limits
    }
    for name in wanted:
        if name != _ANY and name not in known:
            raise OptionError(f"for_ {name}: not among the terms; expected {listed(sorted(known), name)}")
    reached: dict[str, Array] = {}
    lengths: dict[tuple[str, str], float] = {}
    grid = np.empty(0)
    for name, column in noise.items():
        grid, reached[name] = accuracy_curve(column.values, column.interval, column.highest, column.ripple)
        for k, term in enumerate(NAMES):
            want = _wanted(wanted, term)
            if column.values[k] > 0:
                needed = length_for(grid, reached[name][:, k], want) if want > 0 else math.nan
                lengths[name, term] = max(needed, _least(column, slow=k > 0))
    shortest = max(_least(column, slow=False) for column in noise.values())
    if length is not None and length < shortest:
        raise OptionError(
            f"duration {length:g} s: expected at least {shortest:g} s, {FEWEST} samples, which a fit needs"
        )
    at = length or max((each for each in lengths.values() if math.isfinite(each)), default=_HOUR)
    terms = [each for name, column in noise.items() for each in _terms(name, column, wanted, lengths, at, length)]
    return NoisePlan(tuple(terms), at, grid, reached)


def _least(column: _Column, slow: bool) -> float:
    """Return the length of the shortest record that `fit_noise` takes, s, or that shows a slow term."""
    return max(FEWEST * column.interval, SHORT if slow else 0.0)


def _terms(
    name: str,
    column: _Column,
    wanted: Mapping[str, float],
    lengths: Mapping[tuple[str, str], float],
    at: float,
    duration: float | None,
) -> list[PlannedTerm]:
    """Return the terms of a column with their uncertainty from a record of length `at`; limits for that length."""
    u = accuracy(column.values, column.interval, at, column.highest, column.ripple)
    limits = dict(column.limits)
    if limits and duration is not None and not math.isclose(duration, column.length, rel_tol=1e-3):
        more = np.array([name in limits or value > 0 for name, value in zip(NAMES, column.values, strict=True)])
        smallest = visible(column.values, more, column.interval, at, column.highest, _DRAWS)
        limits = {term: float(smallest[NAMES.index(term)]) for term in limits}
    terms = []
    for k, term in enumerate(NAMES):
        value, want = float(column.values[k]), _wanted(wanted, term)
        if value > 0:
            terms.append(PlannedTerm(name, term, column.unit, value, float(u[k]), math.nan, want, lengths[name, term]))
        elif term in limits:
            terms.append(PlannedTerm(name, term, column.unit, 0.0, math.nan, limits[term], want, math.nan))
    return terms


def _wanted(wanted: Mapping[str, float], term: str) -> float:
    """Return the wanted uncertainty of a term; that of all terms leaves out correlation times, which take longest."""
    return wanted.get(term, math.nan if term.endswith("_time") else wanted.get(_ANY, math.nan))


def _read_wanted(stated: float | str | Mapping[str, float | str]) -> dict[str, float]:
    """Return the wanted relative uncertainties by the name of a term; under '' that of all terms."""
    pairs: Mapping[str, float | str]
    if isinstance(stated, Mapping):
        pairs = stated
    elif isinstance(stated, str) and "=" in stated:
        parts = [part.partition("=") for part in stated.split(",")]
        names = [name.strip() for name, _, _ in parts]
        if "" in names:
            raise OptionError(f"for_ {stated!r}: expected the name of a term before each =, such as walk=10%")
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise OptionError(f"for_ {stated!r}: {twice} twice; expected each term once")
        pairs = dict(zip(names, (value for _, _, value in parts), strict=True))
    else:
        pairs = {_ANY: stated}
    wanted = {}
    for name, value in pairs.items():
        wanted[name] = fraction(value, f"for_ {name}".strip())
        if not 1e-6 <= wanted[name] <= 1:
            called = f"{name}={value}" if name != _ANY else value
            raise OptionError(f"for_ {called}: expected a share above 0 and up to 1, such as 10 % or walk=10%")
    return wanted

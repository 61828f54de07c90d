"""Statistics of a line: spread of a parameter over the units, outliers, drift, and capability within limits."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import zip_longest

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.decisions import FLEET_CHANGE, FLEET_DRIFT
from imulab.estimation.distributions import normal_quantile, t_cdf, t_quantile
from imulab.fleet.engine import Summary
from imulab.fleet.history import Past, sources_of
from imulab.fleet.limits import Limits
from imulab.procedures.procedure import OnLine
from imulab.recording import Array
from imulab.records.calibration import Parameter

_MAD_TO_SIGMA = 1.482602218505602  # unrounded, as these numbers are shown in full
# Sqrt(pi / 2): mean distance from the median to standard deviation of normal values
_MEAN_TO_SIGMA = 1.2533141373155001
FEWEST_FOR_OUTLIERS = 8  # units among which one can stand out
# Numbers of units; between them the limit is interpolated in the logarithm
_SIZES = (8, 10, 12, 15, 20, 30, 50, 100, 300, 1000, 10000)
_BEYOND = (7.90, 6.90, 6.29, 5.92, 5.24, 4.80, 4.46, 4.31, 4.34, 4.52, 4.84)
"""Largest robust z of so many normal values, exceeded by one in a hundred (simulated, 400 to 200 000 samples)."""
_FEWEST_FOR_DRIFT = 8  # units whose scatter about a line is known
_SHORTEST_SPAN = 1.0 / 24  # days: an hour; calibrations within it show no drift
_ONE_SIDED_95 = 1.6448536269514722  # standard uncertainties


@dataclass(frozen=True)
class FleetDrift:
    """Straight line over the date: change per day with its standard uncertainty, and whether it is beyond chance."""

    per_day: float
    standard_uncertainty: float
    significant: bool
    start: float
    value_at_start: float
    days: float


@dataclass(frozen=True)
class Capability:
    """``Cpk = min(USL - mean, mean - LSL) / 3 s``, and its one-sided 95 % lower bound."""

    cpk: float
    at_least: float


@dataclass(frozen=True)
class ParameterStatistics:
    """One parameter over the units.

    Attributes
    ----------
    procedure, name, unit
        Which.
    serials, values, uncertainties, days
        Of each unit: value, standard uncertainty (nan where none is stated), date in days since 1970, shape (n,).
    mean, deviation
        Sample mean and standard deviation (0 for one unit).
    median, robust_deviation
        Median, and 1.4826 times the median absolute deviation from it (`robust_deviation`).
    z
        Robust z of each unit, shape (n,): its distance from the median in robust deviations.
    outlier_limit
        A healthy line of this size shows a unit beyond this z, either way, in one of a hundred cases; infinite for few
        units.
    limits
        None where there are none.
    drift, capability
        None where there are too few units, no span of dates, no limits.
    """

    procedure: str
    name: str
    unit: str
    serials: tuple[str, ...]
    values: Array
    uncertainties: Array
    days: Array
    mean: float
    deviation: float
    median: float
    robust_deviation: float
    z: Array
    outlier_limit: float
    limits: Limits | None
    drift: FleetDrift | None
    capability: Capability | None

    @property
    def enough(self) -> bool:
        """Whether there are enough units to find outliers."""
        return math.isfinite(self.outlier_limit)

    @property
    def outliers(self) -> NDArray[np.bool_]:
        """Whether each unit stands out, shape (n,)."""
        return np.abs(self.z) > self.outlier_limit

    @property
    def beyond(self) -> NDArray[np.bool_]:
        """Whether each unit is beyond the limits, shape (n,)."""
        if self.limits is None:
            return np.zeros(len(self.values), dtype=bool)
        return ~((self.limits.lower <= self.values) & (self.values <= self.limits.upper))


@dataclass(frozen=True)
class FleetChange:
    """Change of a parameter of a unit since its last calibration.

    Attributes
    ----------
    before
        Date of the last calibration.
    old, new, standard_uncertainty
        ``u = sqrt(u_new^2 + u_old^2)``, None where one is not stated.
    deviations
        The same chance in a normal distribution as ``(new - old) / u`` has in Student's, with the degrees of freedom
        of both uncertainties (Welch and Satterthwaite); None without u.
    same_files
        Both were made from the same files: their errors are shared, and u does not apply.
    """

    serial: str
    procedure: str
    name: str
    unit: str
    before: str
    old: float
    new: float
    standard_uncertainty: float | None
    deviations: float | None
    same_files: bool


def days_of(text: str) -> float | None:
    """Return an ISO 8601 date as days since 1970 (UTC where it names no zone), or None."""
    try:
        date = datetime.fromisoformat(text.strip())
    except ValueError:
        return None
    return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp() / 86400.0


def outlier_limit(count: int) -> float:
    """Return the robust z beyond which a healthy line of this size shows a unit in one of a hundred cases."""
    if count < FEWEST_FOR_OUTLIERS:
        return math.inf
    return float(np.interp(math.log(count), np.log(_SIZES), _BEYOND))


def parameter_units(summaries: Sequence[Summary]) -> dict[tuple[str, str], str]:
    """Return the unit of every parameter; where records differ, the most frequent one."""
    units: dict[tuple[str, str], Counter[str]] = {}
    for summary in summaries:
        for name, parameter in summary.parameters.items():
            units.setdefault((summary.procedure, name), Counter())[parameter.unit] += 1
    return {key: count.most_common(1)[0][0] for key, count in units.items()}


def not_compared(summaries: Sequence[Summary]) -> dict[tuple[str, str], str]:
    """Return the parameters that are not compared between units, because they are different quantities, and why."""
    reasons: dict[tuple[str, str], str] = {}
    for procedure in dict.fromkeys(summary.procedure for summary in summaries):
        lines = [s.on_line for s in summaries if s.procedure == procedure and s.on_line is not None]
        if not all(_mean_the_same(lines[0], line) for line in lines):
            name, unit = lines[0].about
            values = [line.means[0] for line in lines]
            why = f"{name.replace('_', ' ')} from {min(values):z.1f} to {max(values):z.1f} {unit}"
            if max(values) - min(values) <= lines[0].tolerance:
                why = "model of different forms"
            reasons |= {(procedure, coefficient): why for line in lines for coefficient in line.own}
    return reasons


def _mean_the_same(first: OnLine, second: OnLine) -> bool:
    pairs = zip_longest(first.means, second.means, fillvalue=math.inf)
    return all(abs(a - b) <= first.tolerance for a, b in pairs)


def line_statistics(
    summaries: Sequence[Summary], limits: Mapping[tuple[str, str], Limits]
) -> list[ParameterStatistics]:
    """Return the statistics of every parameter that can be compared between units, in the order of the records."""
    statistics = []
    left_out = not_compared(summaries)
    for (procedure, name), unit in parameter_units(summaries).items():
        if (procedure, name) in left_out:
            continue
        mine = [
            (summary, parameter)
            for summary in summaries
            if summary.procedure == procedure
            and (parameter := summary.parameters.get(name)) is not None
            and parameter.unit == unit
        ]
        statistics.append(
            _statistics(
                procedure, name, unit,
                tuple(summary.serial for summary, _ in mine),
                np.array([parameter.value for _, parameter in mine]),
                np.array([_nan(parameter.standard_uncertainty) for _, parameter in mine]),
                np.array([_day(summary) for summary, _ in mine]),
                limits.get((procedure, name)),
            )
        )  # fmt: skip
    return statistics


def _statistics(
    procedure: str,
    name: str,
    unit: str,
    serials: tuple[str, ...],
    values: Array,
    uncertainties: Array,
    days: Array,
    limits: Limits | None,
) -> ParameterStatistics:
    count = len(values)
    median = float(np.median(values))
    robust = robust_deviation(values, median)
    z = (values - median) / robust if robust > 0 else np.zeros(count)
    limit = outlier_limit(count)
    mean = float(values.mean())
    deviation = float(values.std(ddof=1)) if count > 1 else 0.0
    return ParameterStatistics(
        procedure=procedure,
        name=name,
        unit=unit,
        serials=serials,
        values=values,
        uncertainties=uncertainties,
        days=days,
        mean=mean,
        deviation=deviation,
        median=median,
        robust_deviation=robust,
        z=z,
        outlier_limit=limit,
        limits=limits,
        drift=line_drift(days, values, np.abs(z) <= limit),
        capability=None if limits is None else capability(values, limits),
    )


def robust_deviation(values: Array, median: float) -> float:
    """Return 1.4826 times the median distance from the median, or where more than half are equal 1.2533 times the mean.

    Source: Iglewicz and Hoaglin (1993), who replace a median distance of zero by the mean one; each factor makes it the
    standard deviation of a normal population.
    """
    distance = np.abs(values - median)
    return _MAD_TO_SIGMA * float(np.median(distance)) or _MEAN_TO_SIGMA * float(distance.mean())


def line_drift(days: Array, values: Array, used: NDArray[np.bool_]) -> FleetDrift | None:
    """Return the straight line over the date through units that do not stand out; None for few units or one date.

    ``value = a + slope (day - mean day)``; ``u(slope) = s / sqrt(sum (day - mean)^2)``, s from the residuals.
    """
    day, value = days[used], values[used]
    if len(day) < _FEWEST_FOR_DRIFT or np.ptp(day) < _SHORTEST_SPAN:
        return None
    centred = day - day.mean()
    spread = float(centred @ centred)
    slope = float(centred @ value) / spread
    left = value - value.mean() - slope * centred
    freedom = len(day) - 2
    uncertainty = math.sqrt(float(left @ left) / freedom / spread)
    start = float(day.min())
    return FleetDrift(
        per_day=slope,
        standard_uncertainty=uncertainty,
        significant=abs(slope) > uncertainty * float(t_quantile(1 - FLEET_DRIFT.level / 2, freedom)),
        start=start,
        value_at_start=float(value.mean() + slope * (start - day.mean())),
        days=float(np.ptp(day)),
    )


def capability(values: Array, limits: Limits) -> Capability | None:
    """Return Cpk with the overall standard deviation; None for fewer than two units or no spread.

    Source: NIST/SEMATECH e-Handbook of Statistical Methods, 6.1.6; the bound is Bissell's,
    ``Cpk - 1.645 sqrt(1 / 9n + Cpk^2 / (2 (n - 1)))``.
    """
    count = len(values)
    spread = float(values.std(ddof=1)) if count > 1 else 0.0
    if spread <= 0:
        return None
    mean = float(values.mean())
    cpk = min(limits.upper - mean, mean - limits.lower) / (3 * spread)
    at_least = cpk - _ONE_SIDED_95 * math.sqrt(1 / (9 * count) + cpk**2 / (2 * (count - 1)))
    return Capability(cpk, at_least)


def changes_since(summaries: Sequence[Summary], past: Mapping[str, Sequence[Past]]) -> list[FleetChange]:
    """Return the changes of every unit since the previous calibration by the same procedure."""
    changes = []
    for summary in summaries:
        last = _last(summary, past.get(summary.serial, ()))
        if last is None:
            continue
        same = last.sources == sources_of(summary)
        for name, new in summary.parameters.items():
            old = last.parameters.get(name)
            # A history does not say what a calibration's own coefficients are about.
            by_coefficients = summary.on_line is not None and name in summary.on_line.own
            if old is None or old.unit != new.unit or by_coefficients:
                continue
            u, z = _compared(new, summary.freedom, old, last.freedom)
            changes.append(
                FleetChange(
                    summary.serial, summary.procedure, name, new.unit, last.when, old.value, new.value, u, z, same
                )
            )  # fmt: skip
    return changes


def change_limit(count: int) -> float:
    """Return the limit that one of so many normal deviations exceeds in one set out of a hundred."""
    return float(-normal_quantile(FLEET_CHANGE.level / 2 / max(count, 1)))


def _compared(
    new: Parameter, new_freedom: float | None, old: Parameter, old_freedom: float | None
) -> tuple[float | None, float | None]:
    """Return the standard uncertainty of a change, and the change in equivalent normal deviations."""
    if new.standard_uncertainty is None or old.standard_uncertainty is None:
        return None, None
    u = math.hypot(new.standard_uncertainty, old.standard_uncertainty)
    if not u > 0:
        return None, None
    ratio = (new.value - old.value) / u
    parts = [(p.standard_uncertainty or 0.0, f) for p, f in ((new, new_freedom), (old, old_freedom)) if f is not None]
    share = sum((part / u) ** 4 / freedom for part, freedom in parts)
    if share <= 0:
        return u, ratio
    chance = max(float(t_cdf(-abs(ratio), 1 / share)), 1e-300)
    return u, math.copysign(-float(normal_quantile(chance)), ratio)


def _last(summary: Summary, past: Sequence[Past]) -> Past | None:
    """Return the calibration made last before this one; the history is in the order in which records were made."""
    mine = [item for item in past if item.procedure == summary.procedure]
    index = next((i for i, item in enumerate(mine) if item.content_sha256 == summary.content_sha256), None)
    if index is None:
        mine = [item for item in mine if item.created <= summary.created]
        index = len(mine)
    return mine[index - 1] if index > 0 else None


def _day(summary: Summary) -> float:
    day = days_of(summary.when)
    if day is None:
        day = days_of(summary.created)
    return math.nan if day is None else day


def _nan(value: float | None) -> float:
    return math.nan if value is None else value

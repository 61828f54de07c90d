"""Limits of parameters, and the decision whether a value with an uncertainty lies within them.

[tumble]
"bias_*" = { lower = -20, upper = 20, unit = "mg" }
misalignment_yx = { upper = 3, unit = "mrad" }

Sources: ILAC-G8:09/2019, 4.2 (guard bands); JCGM 106:2012, 7 (probability of conformity); JCGM 101:2008, 6.4.9
(Student's t); A. Genz, J. Comput. Graph. Stat. 1 (1992) 141 (several parameters together).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, Literal

import numpy as np

from imulab.errors import ReadError, UnitError, listed, quoted
from imulab.estimation.distributions import chi_square_upper_quantile, normal_cdf, normal_quantile, t_cdf
from imulab.files import check_keys, load_toml, number_of
from imulab.procedures.registry import PROCEDURES
from imulab.recording import Array
from imulab.report.parameters import reading_unit, with_superscripts
from imulab.units import conversion_factor

Rule = Literal["simple", "guarded", "bands"]
STATES = ("pass", "conditionalPass", "conditionalFail", "fail")
"""Of a decision, the best first; the words of a Digital Calibration Certificate."""
_POINTS = 20_001


@dataclass(frozen=True)
class Limits:
    """Lower and upper limit of a parameter in its unit; either may be infinite."""

    lower: float
    upper: float


def load_limits(
    path: str, units: Mapping[tuple[str, str], str], *, only: str | None = None
) -> dict[tuple[str, str], Limits]:
    """Return limits from a file; a later line overrides an earlier one, so that a name may follow a pattern.

    Parameters
    ----------
    path
        TOML file: a table for each procedure, a line for each parameter or pattern (``"bias_*"``).
    units
        Procedure and parameter to unit, of every parameter there is.
    only
        The procedure whose limits are wanted, where others' are passed over.

    Raises
    ------
    ReadError
        The file cannot be read, names a procedure or parameter that is not there, or has a limit that cannot be.
    UnitError
        A unit is not one of the parameter's.
    """
    table = load_toml(path, str(path), "limits")
    limits: dict[tuple[str, str], Limits] = {}
    for procedure, entries in table.items():
        if procedure not in PROCEDURES:
            raise ReadError(
                f"{path}: unknown procedure {quoted(procedure)}; known procedures: {listed(PROCEDURES, procedure)}"
            )
        if not isinstance(entries, dict):
            raise ReadError(f'{path}: {procedure}: expected lines such as bias_x = {{ upper = 20, unit = "mg" }}')
        if only not in (None, procedure):
            continue
        known = [name for owner, name in units if owner == procedure]
        for pattern, entry in entries.items():
            names = [name for name in known if fnmatchcase(name, pattern)]
            if not names:
                shown = listed(known, pattern) or "none, there is no record of this procedure"
                raise ReadError(f"{path}: {procedure}: no parameter {quoted(pattern)}; parameters: {shown}")
            for name in names:
                key = procedure, name
                limits[key] = _limits(entry, name, units[key], f"{path}: {procedure}: {pattern}")
    return limits


def _limits(entry: Any, name: str, unit: str, place: str) -> Limits:
    ends = {"lower": -math.inf, "upper": math.inf}
    if not isinstance(entry, dict):
        raise ReadError(f'{place}: expected {{ lower = -20, upper = 20, unit = "{unit}" }}, found {quoted(entry)}')
    check_keys(entry, (*ends, "unit"), place)
    if "unit" not in entry or not ends.keys() & entry.keys():
        raise ReadError(f"{place}: expected a unit, and lower or upper or both")
    for end in ends.keys() & entry.keys():
        value = number_of(entry[end], f"{place}: {end}")
        try:
            ends[end] = to_parameter_unit(value, str(entry["unit"]), unit, name)
        except UnitError as error:
            raise UnitError(f"{place}: {error}") from None
    if not ends["lower"] < ends["upper"]:
        raise ReadError(f"{place}: lower {entry['lower']} is not below upper {entry['upper']}")
    return Limits(ends["lower"], ends["upper"])


def to_parameter_unit(value: float, unit: str, target: str, name: str = "") -> float:
    """Return a value in a parameter's unit; `unit` is that, one of its quantity, or its reading unit.

    Raises
    ------
    UnitError
        It is none of these.
    """
    read = reading_unit(target, name)
    if unit == target:
        return value
    plain = with_superscripts(unit).replace("µ", "u")
    if plain in (read.symbol.replace("µ", "u"), read.of_difference):
        return (value - read.offset) / read.factor
    try:
        return value * conversion_factor(unit, target)
    except UnitError:
        also = "" if read.symbol == target else f" or {read.of_difference}"
        raise UnitError(f"unit {unit!r}: expected {target}{also}") from None


# Decisions, with the uncertainty of the value.


@dataclass(frozen=True)
class Conformity:
    """Whether a value conforms.

    Attributes
    ----------
    state
        One of `STATES`.
    probability
        That the true value lies within the limits.
    acceptance
        Limits less the guard band, within which the value passes; none are left where the band is wider than they are.
    """

    state: str
    probability: float
    acceptance: Limits


def decide(
    value: float, uncertainty: float, factor: float, limits: Limits, rule: Rule, freedom: float | None = None
) -> Conformity:
    """Return the decision on a value with its standard uncertainty; an end that equals its limit passes.

    ``simple`` passes within the limits, ``guarded`` within the limits less ``U = k u``. ``bands`` says in between
    that it passes on condition, and beyond the limits by at most U that it fails on condition.

    Parameters
    ----------
    value, uncertainty
        y and its standard uncertainty u, above 0.
    factor
        Coverage factor k.
    limits
        In the unit of the value.
    rule
        Which of the three.
    freedom
        Degrees of freedom of u, infinite if None.
    """
    guard = 0.0 if rule == "simple" else factor * uncertainty
    acceptance = Limits(limits.lower + guard, limits.upper - guard)
    states = [(acceptance, "pass")]
    if rule == "bands":
        reach = Limits(limits.lower - guard, limits.upper + guard)
        states += [(limits, "conditionalPass"), (reach, "conditionalFail")]
    state = next((state for ends, state in states if ends.lower <= value <= ends.upper), "fail")
    ends = (np.array([limits.lower, limits.upper]) - value) / uncertainty
    low, high = normal_cdf(ends) if freedom is None else t_cdf(ends, freedom)
    return Conformity(state, float(high - low), acceptance)


def probability_of_all(
    values: Sequence[float], covariance: Array, limits: Sequence[Limits], freedom: float | None = None
) -> float:
    """Return the probability that all true values lie within their limits, to 3 digits, the same each time.

    Each value is drawn within its limits, given those before it, at the points of a lattice (roots of primes).
    """
    scale = np.sqrt(np.diag(covariance))
    ends = [
        (np.array([each.lower, each.upper]) - value) / u for each, value, u in zip(limits, values, scale, strict=True)
    ]
    factor = np.linalg.cholesky(covariance / np.outer(scale, scale) + 1e-12 * np.eye(len(scale)))
    places = np.abs(2 * (np.arange(1.0, _POINTS)[:, None] * np.sqrt(_primes(len(scale) + 1)) % 1.0) - 1)
    size = np.ones(len(places))
    if freedom is not None:
        size = np.sqrt(chi_square_upper_quantile(places[:, -1], freedom) / freedom)
    drawn, inside = np.empty((len(places), len(scale))), np.ones(len(places))
    for k, (low, high) in enumerate(ends):
        before = drawn[:, :k] @ factor[k, :k]
        below, upto = (normal_cdf((size * end - before) / factor[k, k]) for end in (low, high))
        inside *= upto - below
        drawn[:, k] = normal_quantile(np.clip(below + places[:, k] * (upto - below), 1e-300, 1 - 1e-16))
    return round(float(inside.mean()), 3)


def _primes(count: int) -> Array:
    numbers = np.arange(2, 20 * count + 20)
    return numbers[[not np.any(n % np.arange(2, n) == 0) for n in numbers.tolist()]][:count].astype(np.float64)


def worst(states: Sequence[str]) -> str:
    """Return the worst of some states."""
    return max(states, key=STATES.index)

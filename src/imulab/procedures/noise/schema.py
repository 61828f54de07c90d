"""What a noise record holds, with types, and the units and coefficients in which people read and write noise."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, TypeAlias

import numpy as np

from imulab.errors import LackingError, OptionError, RecordError, UnitError, quoted
from imulab.estimation.noise.terms import NAMES, SIGMA, TIME, is_model
from imulab.quantities import in_si, split_quantity
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.sections import Above0, Length, Part, Positive, Quantity, Size, part
from imulab.records.sections import read as read_section
from imulab.report.parameters import ReadingUnit, reading_unit
from imulab.units import parse_unit, si_unit

# What code reads of a noise record, with types.


class NoiseConditions(Part):
    """``model``."""

    terms: dict[str, str]
    horizon: Above0


class ForFilter(Part):
    """One of ``fit.filter_white`` and ``fit.filter_walk``."""

    value: Size
    unit: str
    interval_95: Annotated[list[Size], 2]


class Values(Part):
    """Several values with their unit."""

    value: list[float]
    unit: str


class Bias(Part):
    """One of ``fit.bias_uncertainty``."""

    time: Values
    standard_uncertainty: Values


class Candidate(Part):
    """One of ``fit.columns.NAME.candidates``."""

    model: str
    deviance: float
    weight: Size
    values: Annotated[list[Size], 8]


class SpectralLine(Part):
    """A line of the spectrum."""

    frequency: Above0
    amplitude: Length


class LevelStep(Part):
    """A change of level."""

    time: Length
    size: Quantity


class TestOfFit(Part):
    """The test of fit."""

    statistic: float
    degrees_of_freedom: int
    probability: Size


class ColumnDrift(Part):
    """Dependence of a column on time or temperature."""

    follows: str
    slope: Quantity
    significant: bool
    removed: bool


class Column(Part):
    """One of ``fit.columns``."""

    unit: str
    interval: Above0
    length: Above0
    samples: int
    spikes: int
    lines: list[SpectralLine]
    steps: list[LevelStep]
    full_band: bool
    ripple: Size
    shortest_time: Above0
    test: TestOfFit
    chosen: str
    candidates: list[Candidate]
    drifts: list[ColumnDrift]

    @property
    def values(self) -> list[float]:
        """The parameters of the chosen candidate."""
        return next(each.values for each in self.candidates if each.model == self.chosen)


class NoiseSummary(Part):
    """``fit``."""

    horizon: Above0
    sample_rate: Above0
    length: Above0
    logs: int
    band: dict[str, Above0]
    test: dict[str, Size]
    filter_white: dict[str, ForFilter]
    filter_walk: dict[str, ForFilter]
    bias_uncertainty: dict[str, Bias]
    columns: dict[str, Column]


class BinnedSpectrum(Part):
    """One of ``data.columns.NAME.spectra``."""

    interval: Positive
    count: int
    first: Annotated[list[int], "bins"]
    last: Annotated[list[int], "bins"]
    power: Annotated[list[Size], "bins"]
    freedom: Annotated[list[Size], "bins"]
    counted: Annotated[list[Size], "bins"]
    variance: Annotated[list[Positive], "bins"]


class Allan(Part):
    """``data.columns.NAME.allan``."""

    tau: Annotated[list[Positive], "times"]
    measured: Annotated[list[Size], "times"]
    fitted: Annotated[list[Size], "times"]
    low: Annotated[list[Size], "times"]
    high: Annotated[list[Size], "times"]


class Noise(Part):
    """A noise record, its ``data`` apart, whose columns differ in length."""

    model: NoiseConditions
    fit: NoiseSummary


@dataclass(frozen=True)
class ColumnFigures:
    """Data of the figures of a column."""

    spectra: list[BinnedSpectrum]
    allan: Allan


def check(record: Calibration) -> None:
    """Check the sections of a record as it is read from its file; raises RecordError."""
    noise = part(record, Noise)
    models = {f"model.terms.{name}": letters for name, letters in noise.model.terms.items()}
    for name, column in noise.fit.columns.items():
        drawn_of(record, name)
        where = f"fit.columns.{name}"
        models |= {f"{where}.candidates[{k}].model": each.model for k, each in enumerate(column.candidates)}
        if column.chosen not in (each.model for each in column.candidates):
            raise RecordError(f"{where}.chosen: expected the model of a candidate, found {quoted(column.chosen)}")
    for place, letters in models.items():
        if not is_model(letters):
            raise RecordError(f"{place}: expected letters of NBKQG, each once, G up to twice, found {quoted(letters)}")
    for name in record.parameters:
        if split(name)[0] not in noise.fit.columns or not split(name)[1]:
            raise RecordError(
                f"parameters.{name}: expected a column of fit.columns and one of the terms {' '.join(_LONGEST_FIRST)}"
            )


def fit_of(record: Calibration) -> NoiseSummary:
    """Return the section ``fit``; a part that is wrong raises RecordError, one that is missing when it is read."""
    return part(record, NoiseSummary, "fit")


def drawn_of(record: Calibration, column: str) -> ColumnFigures:
    """Return the data of the figures of a column.

    Raises
    ------
    RecordError
        The record lacks it, or its lists do not fit each other.
    """
    where = f"data.columns.{column}"
    columns = record.data.get("columns")
    held = columns.get(column) if isinstance(columns, Mapping) else None
    if not isinstance(held, Mapping) or not isinstance(held.get("spectra"), Sequence) or not held["spectra"]:
        raise LackingError(f"the record lacks {where}.spectra")
    spectra = [read_section(BinnedSpectrum, each, f"{where}.spectra[{k}]") for k, each in enumerate(held["spectra"])]
    for k, each in enumerate(spectra):
        edges = list(zip(each.first, each.last, strict=True))
        if any(not 1 <= low <= high < each.count for low, high in edges):
            raise RecordError(f"{where}.spectra[{k}]: expected bins from 1 to {each.count - 1}")
    return ColumnFigures(spectra, read_section(Allan, held.get("allan"), f"{where}.allan"))


# Texts of noise coefficients: 0.3 deg/sqrt(h), 100 ug/sqrt(Hz), 5 deg/h, and so on.


Markov: TypeAlias = str | tuple[float | str, float | str]
"""Standard deviation and correlation time of a Gauss-Markov term: ``"20 deg/h:300 s"``, or the two of them."""
EXAMPLES = {
    "white": "0.3 deg/sqrt(h)",
    "flicker": "5 deg/h",
    "walk": "3 deg/h/sqrt(h)",
    "quantisation": "1 arcsec",
    "gm": "20 deg/h:300 s",
}
_LEVELS = ("rate", "acceleration", "output", "number")
_INTEGRALS = {"m/s": ("m/s^2", 1.0), "mm/s": ("m/s^2", 1e-3)}
_HOUR = math.sqrt(3600.0)
# Endings of a unit after that of a level, or of its integral, with their factors.
_OF_LEVEL = {
    "white": {"/sqrt(Hz)": 1.0},
    "walk": {"/s/sqrt(Hz)": 1.0, "/sqrt(h)": 1 / _HOUR, "/sqrt(s)": 1.0},
    "flicker": {"": 1.0},
}
_OF_INTEGRAL = {"white": {"/sqrt(h)": 1 / _HOUR, "/sqrt(s)": 1.0}, "quantisation": {"": 1.0}}
_SPELLINGS = (
    (re.compile(r"√\(?(Hz|hr?|s)\)?"), r"sqrt(\1)"),
    (re.compile(r"sqrt\(hr\)"), "sqrt(h)"),
    (re.compile(r"^(rad|deg)/s(?:\^2|²)/sqrt\(Hz\)$"), r"\1/s/s/sqrt(Hz)"),
    (re.compile(r"^m/s(?:\^3|³)/sqrt\(Hz\)$"), "m/s^2/s/sqrt(Hz)"),
)


@dataclass(frozen=True)
class GivenTerms:
    """Stated noise: coefficients in SI, shape (8,) in the order of `NAMES`, and the SI unit of its level."""

    values: Array
    unit: str


_MOST = {"rad/s": 0.01, "m/s^2": 1.0}  # of a coefficient in SI: 34 deg/sqrt(h), 2063 deg/h; 0.1 g/sqrt(Hz)
_SENSOR = {"rad/s": "gyroscope", "m/s^2": "accelerometer"}


def given_terms(
    unit: str,
    *,
    white: float | str | None,
    flicker: float | str | None,
    walk: float | str | None,
    quantisation: float | str | None,
    gm: Markov | Sequence[Markov] | None,
) -> GivenTerms:
    """Return noise from its stated coefficients; numbers are in SI, texts have units.

    Parameters
    ----------
    unit
        SI unit of the level where no text has one.
    white, flicker, walk, quantisation
        N, B, K, Q.
    gm
        One or two Gauss-Markov terms.

    Raises
    ------
    OptionError
        A coefficient cannot be read, is not above 0, or is of another kind of sensor; or there is none.
    """
    values = np.zeros(len(NAMES))
    stated: dict[str, float | str | None] = {
        "white": white, "flicker": flicker, "walk": walk, "quantisation": quantisation,
    }  # fmt: skip
    levels: dict[str, str] = {}
    for name, value in stated.items():
        if value is not None:
            values[NAMES.index(name)], level = coefficient(value, name, name)
            levels |= {} if level is None else {name: level}
    for k, (sigma, time) in enumerate(_pairs(gm)):
        values[SIGMA[k]], level = coefficient(sigma, "gm", "flicker")
        values[TIME[k]] = in_si(time, "gm", "time", "s")
        levels |= {} if level is None else {"gm": level}
        if not 0 < values[TIME[k]] < math.inf:
            raise OptionError(f"gm {time}: expected a correlation time above 0")
    common = next(iter(levels.values()), unit)
    for name, level in levels.items():
        if level != common:
            raise OptionError(f"{name}: noise of an output in {level}; expected that of one in {common}")
    for name, value in stated.items():
        if isinstance(value, str) and name not in levels and values[NAMES.index(name)] > _MOST.get(common, math.inf):
            raise OptionError(
                f"{name} {value!r}: without a unit that is in SI, and more than any {_SENSOR[common]} has; expected a "
                f"unit, as in '{EXAMPLES[name] if common == 'rad/s' else '100 ug/sqrt(Hz)'}'"
            )
    if not values.any():
        options = " ".join(f"--{name}" for name in EXAMPLES)
        raise OptionError(f'no noise is given: expected one of {options}, such as --white "{EXAMPLES["white"]}"')
    return GivenTerms(values, common)


def coefficient(value: float | str, option: str, term: str) -> tuple[float, str | None]:
    """Return a coefficient in SI, and the SI unit of its level, None for a bare number.

    Raises
    ------
    OptionError
        It is none; the message gives an example.
    """
    unit: str | None = None
    if isinstance(value, str):
        number, text = split_quantity(value, option, EXAMPLES[term])
        factor = 1.0
        if text:
            factor, unit = _unit(text, term, f"{option} {value!r}")
        size = number * factor
    else:
        size = in_si(value, option, "", EXAMPLES[term])
    if not 0 < size < math.inf:
        raise OptionError(f"{option} {value}: expected more than 0")
    return size, unit


def _unit(text: str, term: str, called: str) -> tuple[float, str]:
    """Return the factor to SI of a coefficient's unit, and the SI unit of the level."""
    for pattern, instead in _SPELLINGS:
        text = pattern.sub(instead, text)
    for endings, read in ((_OF_LEVEL, _level), (_OF_INTEGRAL, _integral)):
        for ending, factor in endings.get(term, {}).items():
            if text.endswith(ending) and (level := read(text[: len(text) - len(ending)])):
                return factor * level[0], level[1]
    raise OptionError(f"{called}: expected a number with a unit such as {EXAMPLES[term]}")


def _level(text: str) -> tuple[float, str] | None:
    try:
        unit = parse_unit(text)
    except UnitError:
        return None
    return (unit.factor, si_unit(text)) if unit.quantity in _LEVELS else None


def _integral(text: str) -> tuple[float, str] | None:
    if text in _INTEGRALS:
        level, factor = _INTEGRALS[text]
        return factor, level
    if text.endswith(" s") and (factor_and_level := _level(text[:-2])):
        return factor_and_level
    try:
        unit = parse_unit(text)
    except UnitError:
        return None
    return (unit.factor, "rad/s") if unit.quantity == "angle" else None


def _pairs(gm: Markov | Sequence[Markov] | None) -> list[tuple[float | str, float | str]]:
    alone = isinstance(gm, str) or (isinstance(gm, tuple) and len(gm) == 2 and not any(map(_is_pair, gm)))
    several: Sequence[object] = [gm] if alone else list(gm or ())
    pairs = []
    for each in several:
        parts = each.split(":") if isinstance(each, str) else each
        if not isinstance(parts, list | tuple) or len(parts) != 2:
            raise OptionError(f"gm {each!r}: expected standard deviation and time, such as {EXAMPLES['gm']}")
        pairs.append((parts[0], parts[1]))
    if len(pairs) > len(SIGMA):
        raise OptionError(f"gm: expected at most {len(SIGMA)} Gauss-Markov terms, found {len(pairs)}")
    return pairs


def _is_pair(value: object) -> bool:
    return isinstance(value, tuple | list) or (isinstance(value, str) and ":" in value)


def by_name(values: Array) -> Mapping[str, float]:
    """Return the terms that are not 0, SI, by the names of `NAMES`."""
    return {name: float(value) for name, value in zip(NAMES, values, strict=True) if value}


# Usual names and reading units of the terms.


_LONGEST_FIRST = sorted([*NAMES, "ramp"], key=len, reverse=True)


def term_unit(term: str, unit: str) -> str:
    """Return the SI unit of a term of a column in `unit`."""
    integral = {"rad/s": "rad", "m/s^2": "m/s"}.get(unit, f"{unit} s")
    rate = {"rad/s": "rad/s^2", "m/s^2": "m/s^3"}.get(unit, f"{unit}/s")
    units = {"white": f"{unit}/sqrt(Hz)", "walk": f"{unit}/sqrt(s)", "quantisation": integral, "ramp": rate}
    return "s" if term.endswith("_time") else units.get(term, unit)


def term_reading(term: str, unit: str) -> ReadingUnit:
    """Return the reading unit of a term of a column in `unit`."""
    return reading_unit(term_unit(term, unit), f"column_{term}")


def label(term: str, unit: str) -> str:
    """Return the usual name of a term of a column in `unit`."""
    accel = unit == "m/s^2"
    names = {
        "white": "velocity random walk" if accel else "angle random walk",
        "flicker": "bias instability (1/f noise)",
        "walk": "acceleration random walk" if accel else "rate random walk",
        "quantisation": "quantisation",
        "ramp": "ramp",
        "gm1_sigma": "Gauss-Markov noise",
        "gm1_time": "its correlation time",
        "gm2_sigma": "second Gauss-Markov noise",
        "gm2_time": "its correlation time",
    }
    return names[term]


def split(name: str) -> tuple[str, str]:
    """Return column and term of a parameter's name."""
    for term in _LONGEST_FIRST:
        if name.endswith(f"_{term}"):
            return name[: -len(term) - 1], term
    return name, ""


# Two records.


def same_meaning(name: str, first: Calibration, second: Calibration) -> bool:
    """Return whether a parameter means the same in two records: where its column has the same terms in both.

    A term takes up what another model gives to another term. White noise alone is the same beside slow noise of any
    kind, but not beside Gauss-Markov noise or quantisation, which may be as fast.
    """
    terms: list[dict[str, str]] = [record.model.get("terms", {}) for record in (first, second)]
    column = max((each for each in terms[0] if name.startswith(f"{each}_")), key=len, default="")
    models = [each.get(column, "") for each in terms]
    return models[0] == models[1] or (name == f"{column}_white" and not set("GQ") & set("".join(models)))

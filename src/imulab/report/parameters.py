"""Parameters as people read them: in the units of the IEEE standards, as rows and as a table.

One table of units serves every procedure, reports, comparisons and fleets. Biases are read in mg and deg/h, scale
factors in ppm off nominal or output per g and per deg/s, misalignments in mrad, nonlinearity in µg/g² and
ppm/(deg/s), acceleration-sensitive drift in deg/h/g; noise, and what changes in a kelvin, in smaller units.
Records, blobs and exported C stay in SI.

Source: IEEE Std 528, 836, 952 and 1293, the units in which they state a model's coefficients.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from typing import overload

import numpy as np
from msgspec import Struct

from imulab.recording import Array
from imulab.records.calibration import Calibration, unseen_limit
from imulab.report.traces import ReportTable, format_uncertain, plain_number
from imulab.units import STANDARD_GRAVITY, from_si, parse_unit

_DEG, _DEG_H, _MG = (from_si(1.0, symbol) for symbol in ("deg", "deg/h", "mg"))
_PER_G, _HOUR, _ROOT_HOUR = STANDARD_GRAVITY, 3600.0, 60.0
_BY_UNIT = {
    "m/s^2": ("mg", _MG),
    "rad/s": ("deg/h", _DEG_H),
    "rad": ("mrad", 1e3),
    "T": ("uT", 1e6),
    "rad/s/(m/s^2)": ("deg/h/g", _DEG_H * _PER_G),
    "rad/s/(m/s^2)^2": ("deg/h/g²", _DEG_H * _PER_G**2),
    "1/K": ("ppm/K", 1e6),
    "rad/s/sqrt(Hz)": ("deg/sqrt(h)", _DEG * _ROOT_HOUR),
    "m/s^2/sqrt(Hz)": ("m/s/sqrt(h)", _ROOT_HOUR),
    "rad/s/sqrt(s)": ("deg/h/sqrt(h)", _DEG_H * _ROOT_HOUR),
    "m/s^2/sqrt(s)": ("µg/sqrt(h)", 1e3 * _MG * _ROOT_HOUR),
    "rad/s^2": ("deg/h/h", _DEG_H * _HOUR),
    "m/s^3": ("µg/h", 1e3 * _MG * _HOUR),
    "m/s": ("mm/s", 1e3),
}
"""SI unit to the unit in which it is read, and the factor."""
_SMALL = {"m/s^2": ("µg", 1e3 * _MG)}
_BY_NAME = (
    (r"dip|(.*_)?direction(_\d+)?", {"rad": ("deg", _DEG)}),
    (r".*_quantisation", {"rad": ("arcsec", 3600 * _DEG)}),
    (r".*_(flicker|sigma)|(repeatability|unit_spread|\w+_error|\w+_jump)_.*", _SMALL),
    (r"gyro_delay_\w", {"s": ("ms", 1e3)}),
    (r"gyro_\w+", {"1": ("ppm", 1e6)}),
    (r"mag_bias_\w", {"1": ("of the field", 1.0)}),
    (r"(.*_)?zeta_\d+", {"1": ("%", 100.0)}),
    (r"(.*_)?c[12]", {"1/(m/s^2)": ("ppm/g", 1e6 * _PER_G), "1/(m/s^2)^2": ("ppm/g²", 1e6 * _PER_G**2)}),
)
"""Parameters, by patterns of their names, whose reading unit differs from that of their SI unit."""
_SENSED = {"/(m/s^2)": ("acceleration", "/g", _PER_G), "/(rad/s)": ("rate", "/(deg/s)", 1 / _DEG),
           "/T": ("magnetic field", "/uT", 1e-6)}  # fmt: skip
"""Denominators of scale factors: their quantity, and the reading unit of an output per it, with its factor."""
_PER_KELVIN = re.compile(r"(.+?)(/K(?:\^\d)?)")
_PER_KELVIN_SMALL = {"mg": ("µg", 1e3), "mrad": ("µrad", 1e3)}
_NONLINEARITY = re.compile(r"1/\((m/s\^2|rad/s)\)(?:\^(\d))?")
_POWERS = "⁰¹²³⁴⁵⁶⁷⁸⁹"
_EXPONENT = re.compile(r"(/[sKg]|\))\^(\d)")


def with_superscripts(text: str) -> str:
    """Return a text whose units have their powers as people write them: ``m/s²`` for ``m/s^2``."""
    return _EXPONENT.sub(lambda power: power[1] + _POWERS[int(power[2])], text)


class ReadingUnit(Struct, frozen=True):
    """The unit in which a value in SI is read: ``reading = factor value + offset``, in `symbol`."""

    symbol: str
    factor: float = 1.0
    offset: float = 0.0

    @overload
    def of(self, value: float) -> float: ...
    @overload
    def of(self, value: Array) -> Array: ...
    def of(self, value: float | Array) -> float | Array:
        """Return a value in this unit."""
        return value * self.factor + self.offset

    def texts(self, value: float, uncertainty: float | None) -> tuple[str, str]:
        """Return a value and its standard uncertainty as texts."""
        return format_uncertain(self.of(value), None if uncertainty is None else uncertainty * abs(self.factor))

    @property
    def scale(self) -> tuple[str, float]:
        """Symbol and factor, of a unit without an offset."""
        return self.symbol, self.factor

    @property
    def of_difference(self) -> str:
        """The symbol of a difference, which has no offset."""
        return "ppm" if self.offset else self.symbol


class Row(Struct, frozen=True):
    """A parameter in its reading unit: bias in mg, misalignment in mrad, k2 in µg/g² ...

    `given_order` is the standard uncertainty if the order chosen from the data is right, None where none was chosen.
    `interval` is the 95 % interval where the record states one.
    """

    name: str
    value: float
    standard_uncertainty: float | None
    unit: str
    given_order: float | None = None
    interval: tuple[float, float] | None = None

    def text(self) -> tuple[str, str]:
        """Return value and uncertainty as text; of what was not seen, what it is below."""
        limit = unseen_limit(self.value, self.standard_uncertainty, self.interval)
        if limit is not None:
            return f"< {plain_number(limit, 2)}", ""
        return format_uncertain(self.value, self.standard_uncertainty)


@cache
def reading_unit(unit: str, name: str = "") -> ReadingUnit:
    """Return the reading unit of a parameter by its SI unit, and by its name where that matters."""
    for pattern, by_unit in _BY_NAME:
        if unit in by_unit and re.fullmatch(pattern, name):
            return ReadingUnit(*by_unit[unit])
    if unit in _BY_UNIT:
        return ReadingUnit(*_BY_UNIT[unit])
    if name.endswith("_ramp"):
        return ReadingUnit(f"{unit.removesuffix('/s')}/h", _HOUR)
    if (law := _PER_KELVIN.fullmatch(unit)) is not None:
        whole = reading_unit(law[1], name)
        symbol, more = _PER_KELVIN_SMALL.get(whole.symbol, (whole.of_difference, 1.0))
        return ReadingUnit(with_superscripts(symbol + law[2]), whole.factor * more)
    if (power := _NONLINEARITY.fullmatch(unit)) is not None:
        degree = int(power[2] or 1)
        if power[1] == "m/s^2":
            return ReadingUnit(f"µg/g{_POWERS[degree + 1]}", 1e6 * STANDARD_GRAVITY**degree)
        return ReadingUnit(f"ppm/(deg/s){'' if degree == 1 else _POWERS[degree]}", 1e6 / _DEG**degree)
    for over, (quantity, per, factor) in _SENSED.items():
        output = unit.removesuffix(over)
        if output != unit:
            nominal = parse_unit(output)
            if nominal.quantity == quantity:
                return ReadingUnit("ppm off nominal", 1e6 * nominal.factor, -1e6)
            return ReadingUnit(output + per, factor)
    return ReadingUnit(unit)


def small_unit(unit: str) -> ReadingUnit:
    """Return the reading unit of noise, drift and residuals: µg and deg/h, all others in their own unit."""
    return ReadingUnit(*_SMALL.get(unit, _BY_UNIT.get(unit, (unit, 1.0))))


def sample_unit(unit: str) -> ReadingUnit:
    """Return the reading unit of samples less their mean: mg and deg/s, all others in their own unit."""
    return ReadingUnit(*{"rad/s": ("deg/s", _DEG), "m/s^2": ("mg", _MG)}.get(unit, (unit, 1.0)))


def text_in(value: float, unit: str, digits: int = 3) -> str:
    """Return a value in SI as the text of its number in another unit, with so many significant digits."""
    return f"{from_si(value, unit):.{digits}g}"


def small_text(value: float, unit: str, digits: int = 3) -> str:
    """Return a drift or residual with its unit as text."""
    read = small_unit(unit)
    return f"{plain_number(value * read.factor, digits)} {read.symbol}"


def micro_g(value: float) -> float:
    """Return an acceleration, m/s^2, in µg."""
    return float(from_si(value, "ug"))


def small_g(value: float) -> str:
    """Return an acceleration, m/s^2, as text in µg, mg or g, three significant digits."""
    micro = micro_g(value)
    if abs(micro) < 999.5:
        return f"{micro:.3g} µg"
    return f"{micro / 1e3:.4g} mg" if abs(micro) < 1e6 else f"{micro / 1e6:.3g} g"


def rows_of(record: Calibration) -> list[Row]:
    """Return the parameters of a record in their reading units."""
    rows = []
    for name, parameter in record.parameters.items():
        read = reading_unit(parameter.unit, name)
        u, for_order, interval = (
            parameter.standard_uncertainty, parameter.standard_uncertainty_given_order, parameter.interval_95,
        )  # fmt: skip
        low_high = None if interval is None else sorted(read.of(end) for end in interval)
        rows.append(
            Row(
                name,
                read.of(parameter.value),
                None if u is None else u * abs(read.factor),
                read.symbol,
                None if for_order is None else for_order * abs(read.factor),
                None if low_high is None else (low_high[0], low_high[1]),
            )
        )
    return rows


def with_zero_outputs(record: Calibration, table: list[Row], prefix: str, output: str) -> list[Row]:
    """Return the rows with what each axis puts out at zero input, ``S b``, after the biases: of counts and volts.

    `prefix` is that of the parameters' names, such as ``gyro_``, `output` the unit of the outputs.
    """
    if parse_unit(output).quantity != "output":
        return table
    zeros, place = [], 0
    for number, row in enumerate(table, start=1):
        if not row.name.startswith(f"{prefix}bias_"):
            continue
        names, place = [row.name, row.name.replace("bias", "scale_factor")], number
        b, s = (record.value(name) for name in names)
        uncertainty = None
        if set(names) <= set(record.covariance.names):
            gradient = np.array([s, b])
            uncertainty = float(np.sqrt(max(gradient @ record.covariance.block(names) @ gradient, 0.0)))
        zeros.append(Row(row.name.replace("bias", "zero_output"), s * b, uncertainty, output))
    return table[:place] + zeros + table[place:]


def parameters_table(rows: Iterable[Row], caption: str, title: str = "Parameters") -> ReportTable:
    """Return a table of parameters, with a dash for an uncertainty that is not stated."""
    cells = []
    for row in rows:
        texts = (plain_number(row.value, 3), "–") if row.standard_uncertainty is None else row.text()
        cells.append([row.name, *texts, row.unit])
    return ReportTable(title, caption, ["parameter", "value", "u", "unit"], cells)

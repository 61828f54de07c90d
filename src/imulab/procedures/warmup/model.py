"""The warm-up table: what is subtracted from an output, as a function of time and temperature at power-on.

``Z(t; T) = sum_k c_k(T) b_k(t)`` for ``t < T_M``. The basis is 1, u, u^2, u^3 with ``u = t / T_M`` (models
``interval-cubic`` and ``knot-cubic``) or ``u = ln(1 + t / tau0) / ln(1 + T_M / tau0)`` (``knot-log-cubic``), or
``exp(-t / tau_j)`` (``exponential``). The coefficients are constant in half-open intervals of power-on temperature, or
interpolated between knots: linearly, or for exponentials by cubic Hermite polynomials.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from imulab.errors import RecordError, UnitError
from imulab.procedures.warmup.choices import BEYOND, EXITS, MODELS
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.units import conversion_factor, parse_unit

MOST_CONSTANTS = 3
"""Time constants of an exponential that the unit has room for."""
SOURCE_TEMPERATURES = (-40.0, -30.0, -20.0, -10.0, 0.0, 40.0, 50.0, 60.0)
"""Calibration temperatures of the source, degC."""


@dataclass(frozen=True)
class WarmupTable:
    """The warm-up table of one unit, or of one type.

    Attributes
    ----------
    model
        One of `MODELS`.
    temperatures
        Edges of the intervals, shape (r + 1,) (``interval-cubic``), or knots, shape (r,); ascending, degC.
    axes, units
        Columns that are corrected and the unit of each one's coefficients: rad/s, m/s^2, count or V.
    coefficients
        Shape (r, axes, p): p = 4, or the number of time constants.
    settling_time
        T_M, s.
    exit
        From T_M on: ``zero``; ``hold``, Z(T_M) for good; ``taper``, from Z(T_M) to zero within `taper_time`.
    taper_time
        s; used with exit ``taper`` only.
    time_scale
        tau0 of ``knot-log-cubic``, s.
    time_constants
        Of ``exponential``, s.
    slopes
        Derivatives of the amplitudes by temperature at the knots, 1/K, shape of `coefficients` (``exponential``).
    beyond
        At power-on temperatures beyond the outer ones: ``zero``, no correction; ``hold``, that of the outer one.
    tolerance
        Beyond the outer temperatures by no more than this, K, the correction is that of the outer one in either case.
    """

    model: str
    temperatures: Array
    axes: tuple[str, ...]
    units: tuple[str, ...]
    coefficients: Array
    settling_time: float
    exit: str = "zero"
    taper_time: float = 60.0
    time_scale: float | None = None
    time_constants: tuple[float, ...] = ()
    slopes: Array | None = None
    beyond: str = "zero"
    tolerance: float = 0.0

    @property
    def scales(self) -> tuple[float, ...]:
        """The time constants, tau0 alone, or nothing: what `basis` takes."""
        return self.time_constants or (() if self.time_scale is None else (self.time_scale,))

    def to_section(self) -> dict[str, Any]:
        """Return the section ``table`` of a record, the interface to the C core."""
        section: dict[str, Any] = {
            "model": self.model,
            "temperatures": self.temperatures.tolist(),
            "axes": list(self.axes),
            "units": list(self.units),
            "coefficients": self.coefficients.tolist(),
        }
        if self.slopes is not None:
            section["slopes"] = self.slopes.tolist()
        section["settling_time"] = self.settling_time
        if self.time_scale is not None:
            section["time_scale"] = self.time_scale
        if self.time_constants:
            section["time_constants"] = list(self.time_constants)
        section["exit"] = self.exit
        section["taper_time"] = self.taper_time
        if self.beyond != "zero":
            section["beyond"] = self.beyond
        if self.tolerance:
            section["tolerance"] = self.tolerance
        return section

    def coefficients_at(self, temperature: float) -> Array | None:
        """Return the coefficients at a power-on temperature, shape (axes, p); None outside the table or for NaN."""
        edges = self.temperatures
        if self.beyond != "hold" and not edges[0] - self.tolerance <= temperature <= edges[-1] + self.tolerance:
            return None
        temperature = float(np.clip(temperature, edges[0], edges[-1]))
        if np.isnan(temperature):
            return None
        row = min(int(np.searchsorted(edges, temperature, side="right")) - 1, len(edges) - 2)
        c = self.coefficients
        if self.model == "interval-cubic":
            found: Array = c[row]
            return found
        width = edges[row + 1] - edges[row]
        s = (temperature - edges[row]) / width
        if self.slopes is None:
            return np.asarray((1 - s) * c[row] + s * c[row + 1])
        ends = (1 + 2 * s) * (1 - s) ** 2 * c[row] + s * s * (3 - 2 * s) * c[row + 1]
        turns = s * (1 - s) ** 2 * self.slopes[row] - s * s * (1 - s) * self.slopes[row + 1]
        return np.asarray(ends + width * turns)

    def with_rules(self, rule: str, taper_time: float, beyond: str, tolerance: float) -> WarmupTable:
        """Return the table with another exit rule, and another rule and tolerance beyond its temperatures."""
        return replace(self, exit=rule, taper_time=taper_time, beyond=beyond, tolerance=tolerance)


def evaluate(table: WarmupTable, time: Array, temperature: float) -> Array | None:
    """Return Z at times since power-on, shape (n,), for a power-on temperature: shape (axes, n), units of the table.

    None outside the table or where the temperature is not a number. NaN in time gives NaN; times before power-on count
    as power-on itself. For figures and judging: what corrects recordings is the C core (`imulab.apply`).
    """
    coefficients = table.coefficients_at(temperature)
    if coefficients is None:
        return None
    end = table.settling_time
    z = coefficients @ basis(table.model, np.clip(time, 0.0, end), end, table.scales).T
    late = time >= end
    share = np.ones(len(time))
    if table.exit == "zero":
        share[late] = 0.0
    elif table.exit == "taper":
        share[late] = np.maximum(1 - (time[late] - end) / table.taper_time, 0.0)
    return np.asarray(z * share)


def reduced_time(time: Array, settling_time: float, time_scale: float | None) -> Array:
    """Return u, which runs from 0 at power-on to 1 at T_M, of the shape of `time`."""
    if time_scale is None:
        return time / settling_time
    u: Array = np.log1p(time / time_scale) / np.log1p(settling_time / time_scale)
    return u


def basis(model: str, time: Array, settling_time: float, scales: Sequence[float] = ()) -> Array:
    """Return the basis functions at `time`, of any shape, along a new last axis.

    `scales` is () for the cubics in time, (tau0,) for ``knot-log-cubic``, the time constants for ``exponential``.
    """
    if model == "exponential":
        return np.asarray(np.exp(-time[..., None] / np.asarray(scales)))
    u = reduced_time(time, settling_time, scales[0] if model == "knot-log-cubic" else None)
    return np.stack([np.ones_like(u), u, u * u, u * u * u], axis=-1)


def table_from(section: Mapping[str, Any]) -> WarmupTable:
    """Return the table of a record's section ``table``.

    Raises
    ------
    RecordError
        Something is missing, of the wrong shape, or out of range; the message names it.
    """
    try:
        model = str(section["model"])
        table = WarmupTable(
            model=model,
            temperatures=np.array(section["temperatures"], dtype=np.float64),
            axes=tuple(map(str, section["axes"])),
            units=tuple(map(str, section["units"])),
            coefficients=np.array(section["coefficients"], dtype=np.float64),
            settling_time=float(section["settling_time"]),
            exit=str(section["exit"]),
            taper_time=float(section.get("taper_time", 60.0)),
            beyond=str(section.get("beyond", "zero")),
            tolerance=float(section.get("tolerance", 0.0)),
            time_scale=float(section["time_scale"]) if model == "knot-log-cubic" else None,
            time_constants=tuple(map(float, section["time_constants"])) if model == "exponential" else (),
            slopes=np.array(section["slopes"], dtype=np.float64) if model == "exponential" else None,
        )
    except KeyError as error:
        raise RecordError(f"table: {error.args[0]} is missing") from None
    except (TypeError, ValueError, AttributeError) as error:
        raise RecordError(f"table: {error}") from None
    check_table(table)
    return table


def check_table(table: WarmupTable) -> None:
    """Check that a table can be evaluated.

    Raises
    ------
    RecordError
        It cannot; the message says why.
    """
    rows = len(table.temperatures) - (table.model == "interval-cubic")
    size = len(table.time_constants) or 4
    shape = (rows, len(table.axes), size)
    problems = [
        (table.model not in MODELS, f"model {table.model!r}; known models: {' '.join(MODELS)}"),
        (table.beyond not in BEYOND, f"beyond {table.beyond!r}; known rules: {' '.join(BEYOND)}"),
        (table.exit not in EXITS, f"exit {table.exit!r}; known rules: {' '.join(EXITS)}"),
        (
            table.temperatures.ndim != 1 or len(table.temperatures) < 2 or not (np.diff(table.temperatures) > 0).all(),
            f"temperatures {table.temperatures.tolist()}; expected two or more, ascending",
        ),
        (not table.axes or len(set(table.axes)) < len(table.axes), f"axes {' '.join(table.axes)!r}; expected names"),
        (len(table.units) != len(table.axes), f"{len(table.units)} units for {len(table.axes)} axes"),
        (table.coefficients.shape != shape, f"coefficients of shape {table.coefficients.shape}, expected {shape}"),
        (
            table.slopes is not None and table.slopes.shape != shape,
            f"slopes of shape {getattr(table.slopes, 'shape', ())}, expected {shape}",
        ),
        (not np.isfinite(table.coefficients).all(), "coefficients that are not finite"),
        (not 0 < table.settling_time < np.inf, f"settling_time {table.settling_time:g}; expected more than 0"),
        (not 0 <= table.tolerance < np.inf, f"tolerance {table.tolerance:g}; expected 0 or more"),
        (not 0 < table.taper_time < np.inf, f"taper_time {table.taper_time:g}; expected more than 0"),
        (
            table.time_scale is not None and not 0 < table.time_scale < np.inf,
            f"time_scale {table.time_scale}; expected more than 0",
        ),
        (
            table.model == "exponential"
            and (
                not 1 <= len(table.time_constants) <= MOST_CONSTANTS
                or not all(0 < tau < np.inf for tau in table.time_constants)
            ),
            f"time_constants {' '.join(f'{tau:g}' for tau in table.time_constants)}; expected one to {MOST_CONSTANTS}, "
            "each more than 0",
        ),
    ]
    for wrong, what in problems:
        if wrong:
            raise RecordError(f"table: {what}")
    for unit in table.units:
        try:
            conversion_factor(unit, parse_unit(unit).symbol)
        except UnitError as error:
            raise RecordError(f"table: {error}") from None


def edge_jumps(table: WarmupTable, times: Array) -> Array:
    """Return the largest jump of |Z| over `times` at each inner edge of temperature, shape (edges, axes).

    Only ``interval-cubic`` jumps; the other models are continuous.
    """
    if table.model != "interval-cubic":
        return np.zeros((len(table.temperatures) - 2, len(table.axes)))
    steps = np.diff(table.coefficients, axis=0)
    jumps: Array = np.abs(steps @ basis(table.model, times, table.settling_time).T).max(axis=2)
    return jumps


def exit_jump(table: WarmupTable) -> Array:
    """Return Z(T_M) at each interval or knot, shape (r, axes): what is dropped at T_M under exit ``zero``."""
    last = basis(table.model, np.array(table.settling_time), table.settling_time, table.scales)
    found: Array = table.coefficients @ last
    return found


def record_table(record: Calibration) -> WarmupTable:
    """Return the table of a warm-up record.

    Raises
    ------
    RecordError
        The record has none, or one that cannot be evaluated.
    """
    if "table" not in record.sections:
        raise RecordError("the warm-up record lacks its table")
    return table_from(record.sections["table"])

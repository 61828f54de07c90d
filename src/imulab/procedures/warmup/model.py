"""The warm-up table, a curve over time for each temperature at power-on, and its fit to power cycles.

``Z(t; T) = sum_k c_k(T) b_k(t)`` for ``t < T_M``. The basis is 1, u, u^2, u^3 with ``u = t / T_M`` (models
``interval-cubic`` and ``knot-cubic``) or ``u = ln(1 + t / tau0) / ln(1 + T_M / tau0)`` (``knot-log-cubic``), or
``exp(-t / tau_j)`` (``exponential``). The coefficients are constant in half-open intervals of power-on temperature, or
interpolated between knots: linearly, or for exponentials by cubic Hermite polynomials.

The fit is linear least squares, with a search for the shared time scales. It needs only the normal matrix, the moments
and the sum of squares of each cycle, so that leaving out cycles or temperatures costs no further pass over the data.

Source: start-up zero error compensation of MEMS inertial instruments (patent record 38161583) for ``interval-cubic``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.errors import LackingError, RecordError, UnitError
from imulab.procedures.warmup import BEYOND, EXITS, MODELS
from imulab.procedures.warmup.cycles import Curves, Index
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.units import conversion_factor, parse_unit

# The table: what is subtracted from an output, over time and temperature at power-on.


MOST_CONSTANTS = 3
"""Most time constants of an exponential that the unit has room for."""
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
        Coefficients, shape (r, axes, p): p = 4, or the number of time constants.
    settling_time
        T_M, s.
    exit
        From T_M on: ``zero``; ``hold``, Z(T_M) for good; ``taper``, from Z(T_M) to zero within `taper_time`.
    taper_time
        s; used with exit ``taper`` only.
    time_scale
        tau0 of ``knot-log-cubic``, s.
    time_constants
        Time constants of ``exponential``, s.
    slopes
        Derivatives of the amplitudes by temperature at the knots, 1/K, shape of `coefficients` (``exponential``).
    beyond
        Beyond the outer power-on temperatures: ``zero``, no correction; ``hold``, that of the outer one.
    tolerance
        Up to this distance beyond the outer temperatures, K, the correction is always that of the outer one.
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
        """Arguments of `basis`: the time constants, tau0 alone, or nothing."""
        return self.time_constants or (() if self.time_scale is None else (self.time_scale,))

    def to_section(self) -> dict[str, Any]:
        """Return the section ``table`` of a record, which the C core is filled from."""
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
            coefficients: Array = c[row]
            return coefficients
        width = edges[row + 1] - edges[row]
        s = (temperature - edges[row]) / width
        if self.slopes is None:
            return np.asarray((1 - s) * c[row] + s * c[row + 1])
        ends = (1 + 2 * s) * (1 - s) ** 2 * c[row] + s * s * (3 - 2 * s) * c[row + 1]
        turns = s * (1 - s) ** 2 * self.slopes[row] - s * s * (1 - s) * self.slopes[row + 1]
        return np.asarray(ends + width * turns)

    def with_rules(self, rule: str, taper_time: float, beyond: str, tolerance: float) -> WarmupTable:
        """Return the table with other rules after T_M and beyond its temperatures, and another tolerance."""
        return replace(self, exit=rule, taper_time=taper_time, beyond=beyond, tolerance=tolerance)


def evaluate(table: WarmupTable, time: Array, temperature: float) -> Array | None:
    """Return Z at times since power-on, shape (n,), for a power-on temperature: shape (axes, n), units of the table.

    None outside the table, or where the temperature is not a number. NaN in time gives NaN; times before power-on count
    as power-on. This is for figures and judgements: recordings are corrected by the C core (`imulab.apply`).
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
    """Return u, which goes from 0 at power-on to 1 at T_M, in the shape of `time`."""
    if time_scale is None:
        return time / settling_time
    u: Array = np.log1p(time / time_scale) / np.log1p(settling_time / time_scale)
    return u


def basis(model: str, time: Array, settling_time: float, scales: Sequence[float] = ()) -> Array:
    """Return the basis functions at `time`, of any shape, with a new last axis of functions.

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
    """Refuse a table that cannot be evaluated.

    Raises
    ------
    RecordError
        It cannot be evaluated; the message says why.
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
    """Return Z(T_M) at each interval or knot, shape (r, axes): the step at T_M with exit ``zero``."""
    last = basis(table.model, np.array(table.settling_time), table.settling_time, table.scales)
    jump: Array = table.coefficients @ last
    return jump


def record_table(record: Calibration) -> WarmupTable:
    """Return the table of a warm-up record.

    Raises
    ------
    RecordError
        The record has none, or one that cannot be evaluated.
    """
    if "table" not in record.sections:
        raise LackingError("the warm-up record lacks its table")
    return table_from(record.sections["table"])


# The fit: linear least squares per interval or knot, and a search for the shared time scales.


Mask = NDArray[np.bool_]

_START = {1: (20.0,), 2: (0.1, 0.4), 3: (0.06, 0.2, 0.6)}
_CLOSEST = 1.6
"""Least factor between neighbouring time constants: the data do not separate closer ones."""
SCALE_LIMIT = 3.0
"""Longest time scale that is tried, in units of T_M."""
_MOST_SIMPLEXES = 200
_PASSES = 3  # times that cycles are carried to their knot along the slopes of the amplitudes
_WORST_CONDITION = 1e8  # beyond it exponentials are the same function
_SHRINK = 2.0
"""Degrees of freedom that the scatter over all temperatures counts for at each one."""


@dataclass(frozen=True)
class Statistics:
    """Weighted sums over the bins of each cycle, with basis b and data y of one model.

    Attributes
    ----------
    normal
        ``sum w b b'``, shape (c, p, p).
    moment
        ``sum w b y``, shape (c, p, axes).
    square
        ``sum w y^2``, shape (c, axes).
    weight
        ``sum w``, shape (c,).
    total
        ``sum w b``, shape (c, p).
    """

    normal: Array
    moment: Array
    square: Array
    weight: Array
    total: Array

    def mean_square(self, coefficients: Array) -> Array:
        """Return the mean squared residual of each cycle: ``(sum w y^2 - 2 c' sum w b y + c' N c) / sum w``, (c, axes).

        N is `normal`; the coefficients c have shape (c, axes, p).
        """
        cross = np.einsum("cap,cpa->ca", coefficients, self.moment)
        fitted = np.einsum("cap,cpq,caq->ca", coefficients, self.normal, coefficients)
        square: Array = np.maximum(self.square - 2 * cross + fitted, 0.0) / self.weight[:, None]
        return square


def statistics(curves: Curves, model: str, scales: Sequence[float]) -> Statistics:
    """Return the sums of all cycles for the basis of a model."""
    average = _averages(model, curves.nodes, curves.shares, curves.settling_time, scales)
    weighted = (average * curves.seconds[:, :, None]).swapaxes(1, 2)
    return Statistics(
        normal=weighted @ average,
        moment=weighted @ curves.mean,
        square=np.einsum("cb,cba->ca", curves.seconds, curves.mean**2),
        weight=curves.seconds.sum(axis=1),
        total=weighted.sum(axis=2),
    )


def _averages(model: str, nodes: Array, shares: Array, settling_time: float, scales: Sequence[float]) -> Array:
    """Return the mean of each basis function over each bin, shape (c, b, p)."""
    average: Array = np.einsum("cbn,cbnp->cbp", shares, basis(model, nodes, settling_time, scales))
    return average


def hats(curves: Curves, knots: Index) -> Array:
    """Return the weights of linear interpolation between some of the temperatures, shape (c, knots).

    A power-on temperature beyond the outer knots counts as the outer knot.
    """
    at = curves.temperatures[knots]
    inside = np.clip(curves.power_on, at[0], at[-1])
    return np.stack([np.interp(inside, at, unit) for unit in np.eye(len(at))], axis=1)


def membership(curves: Curves, knots: Index) -> Array:
    """Return whether a cycle is fitted in an interval, that is, lies at one of its end points, shape (c, knots - 1)."""
    position = np.searchsorted(knots, curves.group)
    interval = np.arange(len(knots) - 1)
    serves = (position[:, None] == interval) | (position[:, None] == interval + 1)
    return np.asarray(serves, dtype=np.float64)


@dataclass(frozen=True)
class CurveSolution:
    """A fitted table, with what its uncertainty is computed from.

    Attributes
    ----------
    table
        The table, with exit ``zero``.
    scales
        tau0, or the time constants.
    weights
        Weight of each cycle, shape (c,).
    """

    table: WarmupTable
    scales: tuple[float, ...]
    weights: Array


def solve(
    curves: Curves, model: str, scales: Sequence[float], sums: Statistics, weights: Array, knots: Index | None = None
) -> CurveSolution:
    """Return the table fitted to the cycles with positive weight, at all calibration temperatures or at some.

    ``sum_l (sum_c w h_k h_l N) c_l = sum_c w h_k m``: N and m are the `normal` and `moment` of a cycle, h_k its weights
    at the knots (`hats`) or intervals (`membership`), w the weights of the cycles.

    Parameters
    ----------
    curves
        The cycles.
    model, scales
        Model and time scales.
    sums
        Sums for that model and these scales.
    weights
        Weights of the cycles, shape (c,).
    knots
        Indices of the temperatures that the table keeps; each needs a cycle.
    """
    kept = np.arange(len(curves.temperatures)) if knots is None else knots
    used = weights * np.isin(curves.group, kept)
    slopes = None
    if model == "interval-cubic":
        c = _solve_intervals(sums, membership(curves, kept) * used[:, None])
    elif model == "exponential":
        c, slopes = _solve_amplitudes(curves, sums, used, kept, scales)
    else:
        c = _solve_knots(sums, hats(curves, kept), used)
    table = WarmupTable(
        model=model,
        temperatures=curves.temperatures[kept],
        axes=curves.axes,
        units=curves.units,
        coefficients=c,
        settling_time=curves.settling_time,
        time_scale=float(scales[0]) if model == "knot-log-cubic" else None,
        time_constants=tuple(map(float, scales)) if model == "exponential" else (),
        slopes=slopes,
    )
    return CurveSolution(table, tuple(map(float, scales)), used)


def _solve_intervals(sums: Statistics, share: Array) -> Array:
    normal = np.einsum("cr,cpq->rpq", share, sums.normal)
    moment = np.einsum("cr,cpa->rpa", share, sums.moment)
    return np.linalg.solve(normal, moment).transpose(0, 2, 1)


def _solve_knots(sums: Statistics, hat: Array, used: Array) -> Array:
    normal = knot_normal(sums, hat, used)
    moment = np.einsum("c,ck,cpa->kpa", used, hat, sums.moment)
    k, p, a = moment.shape
    coefficients: Array = np.linalg.solve(normal, moment.reshape(k * p, a)).reshape(k, p, a).transpose(0, 2, 1)
    return coefficients


def knot_normal(sums: Statistics, hat: Array, used: Array) -> Array:
    """Return the normal matrix of all knots' coefficients, shape (k p, k p)."""
    size = hat.shape[1] * sums.normal.shape[1]
    normal: Array = np.einsum("c,cj,ck,cpq->jpkq", used, hat, hat, sums.normal, optimize=True).reshape(size, size)
    return normal


def _solve_amplitudes(
    curves: Curves, sums: Statistics, used: Array, kept: Index, constants: Sequence[float]
) -> tuple[Array, Array]:
    """Return amplitudes and slopes at the knots; the slopes carry each cycle from its temperature to its knot."""
    member = (curves.group[:, None] == kept).astype(np.float64) * used[:, None]
    normal = np.einsum("ck,cpq->kpq", member, sums.normal)
    at = curves.temperatures[kept]
    position = np.minimum(np.searchsorted(kept, curves.group), len(kept) - 1)
    apart = np.where(used > 0, curves.power_on - at[position], 0.0)
    moment = sums.moment
    for _ in range(_PASSES):
        amplitude = np.linalg.solve(normal, np.einsum("ck,cpa->kpa", member, moment)).transpose(0, 2, 1)
        slopes = amplitude_slopes(at, amplitude, constants)
        shift = apart[:, None, None] * slopes[position]
        moment = sums.moment - np.einsum("cpq,caq->cpa", sums.normal, shift)
    return amplitude, slopes


def amplitude_slopes(knots: Array, amplitudes: Array, constants: Sequence[float]) -> Array:
    """Return the derivatives by temperature, 1/K, of amplitudes (k, axes, p) at knots (k,), degC, shape (k, axes, p).

    They are those of monotone piecewise cubics (Fritsch and Butland) through the curve's values at the p time
    constants. Neighbouring amplitudes err in opposite directions and their errors nearly cancel in the curve. Monotone
    cubics through each amplitude are not linear in it and would undo that between the knots.
    """
    values = np.ascontiguousarray(amplitudes, dtype=np.float64)
    at = np.asarray(constants, dtype=np.float64)
    curve = np.exp(-at[:, None] / at)
    if not np.linalg.cond(curve) < _WORST_CONDITION:  # constants that coincide, in a table edited by hand
        return _pchip_slopes(knots, values)
    slopes = np.linalg.solve(curve, _pchip_slopes(knots, values @ curve.T).swapaxes(1, 2))
    return np.asarray(slopes.swapaxes(1, 2), dtype=np.float64)


def _pchip_slopes(knots: Array, values: Array) -> Array:
    """Return the slopes at knots (k,) of the monotone cubics through values (k, ...) (PCHIP), shape of the values.

    A weighted harmonic mean of the secants beside a knot, 0 where they have two signs (F. N. Fritsch and J. Butland,
    SIAM J. Sci. Stat. Comput. 5 (1984) 300); at the ends a parabola's slope, kept monotone (C. Moler, Numerical
    Computing with MATLAB, 3.6).
    """
    step = np.diff(knots).reshape(-1, *[1] * (values.ndim - 1))
    secant = np.diff(values, axis=0) / step
    if len(knots) == 2:
        return np.concatenate([secant, secant])
    left, right = 2 * step[1:] + step[:-1], step[1:] + 2 * step[:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = (left + right) / (left / secant[:-1] + right / secant[1:])
    inner = np.where(secant[:-1] * secant[1:] > 0, mean, 0.0)
    ends = []
    for near, far in ((0, 1), (-1, -2)):
        nearest, other = secant[near], secant[far]
        slope = ((2 * step[near] + step[far]) * nearest - step[near] * other) / (step[near] + step[far])
        beyond = (np.sign(nearest) != np.sign(other)) & (np.abs(slope) > 3 * np.abs(nearest))
        ends.append(np.where(np.sign(slope) != np.sign(nearest), 0.0, np.where(beyond, 3 * nearest, slope))[None])
    return np.concatenate([ends[0], inner, ends[1]])


def find_scales(
    curves: Curves, model: str, count: int, weights: Array, start: Sequence[float] | None = None
) -> tuple[float, ...]:
    """Return tau0, or the shared time constants, with the least squares of all mean curves.

    Each temperature and axis has its own coefficients; axes are weighted by their size and noise. Nelder-Mead in the
    logarithms, over at most 3 numbers.
    """
    sums = statistics(curves, "knot-cubic", ())
    size = (weights @ sums.square) / max(float(weights @ sums.weight), 1e-9)
    scale = curves.noise / 100 + 1e-4 * size
    scale = np.where(scale > 0, scale, 1.0)
    square = weights @ sums.square
    used = weights > 0
    nodes, shares, mean, seconds = (x[used] for x in (curves.nodes, curves.shares, curves.mean, curves.seconds))
    member = (np.unique(curves.group[used])[:, None] == curves.group[used]) * weights[used]
    end = curves.settling_time
    low, high = np.log(0.5), np.log(SCALE_LIMIT * end)

    def cost(logs: Array) -> float:
        logs = np.sort(logs)
        outside = np.maximum(low - logs, 0).sum() + np.maximum(logs - high, 0).sum()
        outside += np.maximum(np.log(_CLOSEST) - np.diff(logs), 0).sum()
        if outside > 0:
            return 1e300 * (1 + float(outside))
        average = _averages(model, nodes, shares, end, np.exp(logs).tolist())
        weighted = (average * seconds[:, :, None]).swapaxes(1, 2)
        moment = np.tensordot(member, weighted @ mean, 1)
        try:
            best = np.linalg.solve(np.tensordot(member, weighted @ average, 1), moment)
        except np.linalg.LinAlgError:
            return 1e300
        left = square - (best * moment).sum(axis=(0, 1))
        return float((left / scale).sum())

    if start is None:
        first = np.log(np.array(_START[count]) * (1.0 if model == "knot-log-cubic" else end))
        step, tolerance = 0.4, 1e-3
    else:
        first, step, tolerance = np.log(np.array(start)), 0.1, 3e-3
    best = _nelder_mead(cost, np.vstack([first, first + step * np.eye(count)]), tolerance, 1e-9 * abs(cost(first)))
    return tuple(np.exp(np.sort(best)).tolist())


def _nelder_mead(cost: Callable[[Array], float], simplex: Array, near: float, alike: float) -> Array:
    """Return the minimum that a simplex (n + 1, n) closes in on, to `near` in place and `alike` in cost.

    J. C. Lagarias et al., SIAM J. Optim. 9 (1998) 112, as scipy has it, which takes as long to load as the fit takes.
    """
    costs = np.array([cost(corner) for corner in simplex])
    for _ in range(_MOST_SIMPLEXES):
        order = np.argsort(costs)
        simplex, costs = simplex[order], costs[order]
        if np.abs(simplex[1:] - simplex[0]).max() <= near and np.abs(costs[1:] - costs[0]).max() <= alike:
            break
        middle = simplex[:-1].mean(axis=0)

        def along(share: float, middle: Array = middle, worst: Array = simplex[-1]) -> tuple[float, Array]:
            place = middle + share * (middle - worst)
            return cost(place), place

        tried = along(1.0)
        if tried[0] < costs[0]:
            tried = min(tried, along(2.0), key=itemgetter(0))
        elif tried[0] >= costs[-2]:
            outside = tried[0] < costs[-1]
            nearer = along(0.5 if outside else -0.5)
            worse = nearer[0] > tried[0] if outside else nearer[0] >= costs[-1]
            if worse:
                simplex = simplex[0] + 0.5 * (simplex - simplex[0])
                costs = np.array([costs[0], *(cost(corner) for corner in simplex[1:])])
                continue
            tried = nearer
        costs[-1], simplex[-1] = tried
    return np.asarray(simplex[np.argmin(costs)])


def coefficients_of(curves: Curves, table: WarmupTable) -> Array:
    """Return the coefficients that the unit uses in each cycle, shape (c, axes, p).

    A power-on temperature beyond the table (a recording at -41 for a table from -40) counts as its end.
    """
    inside = np.clip(curves.power_on, table.temperatures[0], table.temperatures[-1])
    rows = [table.coefficients_at(float(temperature)) for temperature in inside]
    return np.stack([row for row in rows if row is not None])


def fitted_noise(curves: Curves, solution: CurveSolution, sums: Statistics) -> Array:
    """Return the mean square of white noise in the residuals of each cycle of a fit, shape (c, axes).

    It is less than in cycles outside the fit, because the fit follows some of the noise. With y = X theta for a cycle
    of b bins, N = X' W X, B = N + X' W 1 1' W X / s for a reference of s seconds, M = sum w N and Q = sum w^2 B, it is
    ``b + T / s - 2 w tr(B M^-1) + tr(N M^-1 Q M^-1)`` per T seconds. Amplitudes carried along slopes count as fixed.
    """
    w, kept = solution.weights, np.arange(len(curves.temperatures))
    both = sums.normal + sums.total[:, :, None] * sums.total[:, None, :] / curves.reference_seconds[:, None, None]
    if solution.table.model == "interval-cubic":
        edges = curves.temperatures
        row = np.clip(np.searchsorted(edges, curves.power_on, side="right") - 1, 0, len(edges) - 2)
        share, taken = membership(curves, kept), np.zeros(len(w))
        for r in range(len(edges) - 1):
            taken[row == r] = _followed_noise(sums.normal, both, np.ones((len(w), 1)), w * share[:, r])[row == r]
    elif solution.table.model == "exponential":
        taken = _followed_noise(sums.normal, both, (curves.group[:, None] == kept).astype(np.float64), w)
    else:
        taken = _followed_noise(sums.normal, both, hats(curves, kept), w)
    share = np.maximum((curves.seconds > 0).sum(axis=1) + sums.weight / curves.reference_seconds - taken, 0.0)
    return np.asarray((share / sums.weight)[:, None] * curves.noise)


def _followed_noise(normal: Array, both: Array, hat: Array, weights: Array) -> Array:
    """Return the noise in each cycle that a fit follows, shape (c,), in units of the variance of one second's mean."""
    size = hat.shape[1] * normal.shape[1]
    spread = np.einsum("cj,ck->cjk", hat, hat)
    normals = np.einsum("cjk,cpq->cjpkq", spread, normal).reshape(-1, size, size)
    noisy = np.einsum("cjk,cpq->cjpkq", spread, both).reshape(-1, size, size)
    inverse = np.linalg.inv(np.einsum("c,cxy->xy", weights, normals))
    spread_of_noise = inverse @ np.einsum("c,cxy->xy", weights**2, noisy) @ inverse
    share: Array = 2 * weights * np.einsum("cxy,yx->c", noisy, inverse) - np.einsum(
        "cxy,yx->c", normals, spread_of_noise
    )
    return share


def scatter(curves: Curves, sums: Statistics, cluster: Index) -> tuple[Array, Array, float]:
    """Return the covariance of a cluster's coefficients by temperature, the pooled one, and its degrees of freedom.

    Shapes (k, axes, p, p) and (axes, p, p). A cluster is a cycle or, where units are pooled, all cycles of one unit at
    one temperature. Few clusters make a poor estimate: each temperature's covariance is averaged with the pooled one,
    which counts as two degrees of freedom.
    """
    groups = len(curves.temperatures)
    owners = np.unique(cluster)
    by_owner = np.array([np.linalg.solve(*_sum(sums, cluster == o)) for o in owners])  # (o, p, axes)
    place = np.array([curves.group[cluster == o][0] for o in owners])
    p, a = by_owner.shape[1:]
    total, freedom = np.zeros((groups, a, p, p)), np.zeros(groups)
    for k in range(groups):
        rows = by_owner[place == k]
        deviation = rows - rows.mean(axis=0) if len(rows) else rows
        total[k] = np.einsum("opa,oqa->apq", deviation, deviation)
        freedom[k] = max(len(rows) - 1, 0)
    if freedom.sum() == 0:
        return np.full((groups, a, p, p), np.nan), np.full((a, p, p), np.nan), 0.0
    pooled = total.sum(axis=0) / freedom.sum()
    each = (total + _SHRINK * pooled) / (freedom + _SHRINK)[:, None, None, None]
    return each, pooled, float(freedom.sum())


def _sum(sums: Statistics, chosen: Mask) -> tuple[Array, Array]:
    return sums.normal[chosen].sum(axis=0), sums.moment[chosen].sum(axis=0)


def coefficient_covariance(curves: Curves, solution: CurveSolution, sums: Statistics, cluster: Index) -> Array | None:
    """Return the covariance of each interval's or knot's coefficients, shape (r, axes, p, p), from repeatability.

    ``V = G [sum_c (h h') x (N S N)] G'`` with G the inverse normal matrix, N that of a cluster and S the covariance of
    its coefficients about those of its temperature. None where no temperature has two clusters.
    """
    each, _, freedom = scatter(curves, sums, cluster)
    if freedom == 0:
        return None
    owners = np.unique(cluster)
    w = solution.weights
    normal = np.array([np.einsum("c,cpq->pq", w * (cluster == o), sums.normal) for o in owners])
    place = np.array([curves.group[cluster == o][0] for o in owners])
    middle = np.einsum("opq,oaqr,ors->oaps", normal, each[place], normal)
    kept = np.arange(len(curves.temperatures))
    model = solution.table.model
    if model in ("interval-cubic", "exponential"):
        if model == "interval-cubic":
            share = membership(curves, kept)
        else:
            share = (curves.group[:, None] == kept).astype(np.float64)
        share = np.array([share[cluster == o][0] for o in owners])
        inverse = np.linalg.inv(np.einsum("or,opq->rpq", share, normal))
        return np.asarray(np.einsum("rpq,or,oaqs,rst->rapt", inverse, share, middle, inverse, optimize=True))
    hat = hats(curves, kept)
    hat = np.array([np.average(hat[cluster == o], axis=0, weights=w[cluster == o]) for o in owners])
    k, p, a = hat.shape[1], normal.shape[1], middle.shape[1]
    whole = np.einsum("oj,ok,opq->jpkq", hat, hat, normal, optimize=True).reshape(k * p, k * p)
    inverse = np.linalg.inv(whole).reshape(k, p, k * p)
    inner = np.einsum("oj,ok,oaps->ajpks", hat, hat, middle, optimize=True).reshape(a, k * p, k * p)
    return np.asarray(np.einsum("kpx,axy,kqy->kapq", inverse, inner, inverse, optimize=True))

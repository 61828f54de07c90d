"""The quality of a warm-up model: its errors on cycles and temperatures left out of the fit, jumps, and warnings.

Models are compared by cross-validation; the chosen one predicts best. The floor is the repeatability of power cycles.
Sources: Efron and Tibshirani, An Introduction to the Bootstrap (1993), chapter 11 (jackknife).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from imulab.columns import triad
from imulab.display import Bad, Finding, Note
from imulab.errors import DataError, first_of
from imulab.estimation.decisions import STILL_DRIFTS
from imulab.estimation.likely_unit import STATE_UNIT, no_gravity
from imulab.estimation.rows import median, medians, quantile
from imulab.procedures.correction_order import parse_thermals
from imulab.procedures.warmup.cycles import SETTLED, Curves, Cycle
from imulab.procedures.warmup.model import (
    SCALE_LIMIT,
    CurveSolution,
    WarmupTable,
    coefficients_of,
    edge_jumps,
    exit_jump,
    find_scales,
    fitted_noise,
    solve,
    statistics,
)
from imulab.recording import Array
from imulab.report.parameters import small_text

# Errors of a model on cycles and temperatures that were left out of the fit, and its jumps.


CANDIDATES = (("interval-cubic", 0), ("knot-cubic", 0), ("knot-log-cubic", 1), ("exponential", 2), ("exponential", 3))
"""Models that are compared, and their number of time scales."""
_SMOOTH_SCALE = 20.0  # s


@dataclass(frozen=True)
class Judged:
    """A fitted model and its errors: root mean squares over t < T_M without white noise, per axis.

    Attributes
    ----------
    model, count
        Name and number of time scales (0 for ``none`` and the cubics in time).
    solution
        Fit to all cycles; None for ``none``.
    training
        Error at the cycles of the fit, shape (axes,).
    left_cycle
        Error at cycles (or units, where these are pooled) left out of the fit; None where that is impossible.
    left_temperature
        Error at inner temperatures, each left out of the fit, or None.
    by_temperature, left_by_temperature
        `training` and `left_temperature` at each calibration temperature, shape (k, axes); NaN where there is none.
    edge_jump, exit_jump
        Largest jump at an edge, largest |Z(T_M)|, shape (axes,).
    scales_covariance
        Covariance of the time scales by a jackknife over temperatures, shape (count, count); None if there are too few.
    """

    model: str
    count: int
    solution: CurveSolution | None
    training: Array
    left_cycle: Array | None
    left_temperature: Array | None
    by_temperature: Array
    left_by_temperature: Array
    edge_jump: Array
    exit_jump: Array
    scales_covariance: Array | None

    @property
    def label(self) -> str:
        """Name in tables; exponentials have their number of time constants."""
        return f"{self.model} ({self.count})" if self.model == "exponential" else self.model

    @property
    def table(self) -> WarmupTable:
        """The fitted table."""
        if self.solution is None:
            raise DataError("there is no table of no model")
        return self.solution.table


def judge_none(curves: Curves) -> Judged:
    """Return the errors without compensation."""
    square = statistics(curves, "knot-cubic", ())
    left = square.square / square.weight[:, None] - curves.expected_noise()
    a = len(curves.axes)
    none = np.full((len(curves.temperatures), a), np.nan)
    return Judged(
        model="none",
        count=0,
        solution=None,
        training=_root(left),
        left_cycle=_root(left),
        left_temperature=None,
        by_temperature=_by_group(curves, left),
        left_by_temperature=none,
        edge_jump=np.zeros(a),
        exit_jump=np.zeros(a),
        scales_covariance=None,
    )


def judge(curves: Curves, model: str, count: int, weights: Array, *, by_unit: bool = False) -> Judged:
    """Return a fitted model with its errors.

    Where a cycle is left out, the shared time scales are kept; where a temperature is left out, they are fitted again.
    """
    scales = find_scales(curves, model, count, weights) if count else ()
    sums = statistics(curves, model, scales)
    solution = solve(curves, model, scales, sums, weights)
    noise = curves.expected_noise()
    left = sums.mean_square(coefficients_of(curves, solution.table)) - fitted_noise(curves, solution, sums)
    cycle = _leave_cycles(curves, model, scales, weights, noise, by_unit)
    temperature, others = _leave_temperatures(curves, model, scales, weights, noise)
    times = np.linspace(0.0, curves.settling_time, 301)
    jumps = edge_jumps(solution.table, times)
    return Judged(
        model=model,
        count=count,
        solution=solution,
        training=_root(left),
        left_cycle=cycle,
        left_temperature=None if temperature is None else _root(temperature[np.isfinite(temperature[:, 0])]),
        by_temperature=_by_group(curves, left),
        left_by_temperature=np.full((len(curves.temperatures), len(curves.axes)), np.nan)
        if temperature is None
        else _by_group(curves, temperature),
        edge_jump=jumps.max(axis=0, initial=0.0),
        exit_jump=np.abs(exit_jump(solution.table)).max(axis=0),
        scales_covariance=_jackknife(np.array(others), len(scales)),
    )


def _leave_cycles(
    curves: Curves, model: str, scales: tuple[float, ...], weights: Array, noise: Array, by_unit: bool
) -> Array | None:
    """Return the root mean square error, shape (axes,), of cycles (or units) predicted from the others."""
    sums = statistics(curves, model, scales)
    owner = curves.unit if by_unit else np.arange(len(curves.cycles))
    groups = len(curves.temperatures)
    errors = []
    for o in np.unique(owner):
        kept = weights * (owner != o)
        if np.unique(curves.group[kept > 0]).size < groups:
            continue  # no other cycle has its temperature
        out = owner == o
        table = solve(curves, model, scales, sums, kept).table
        errors.append((sums.mean_square(coefficients_of(curves, table)) - noise)[out])
    return _root(np.concatenate(errors)) if errors else None


def _leave_temperatures(
    curves: Curves, model: str, scales: tuple[float, ...], weights: Array, noise: Array
) -> tuple[Array | None, list[tuple[float, ...]]]:
    """Return the mean square errors of the cycles at each inner temperature, predicted from the others, and the scales.

    Shape (c, axes), NaN at the outer temperatures; None where fewer than three temperatures were measured.
    """
    groups = len(curves.temperatures)
    if groups < 3:
        return None, []
    errors = np.full((len(curves.cycles), len(curves.axes)), np.nan)
    all_scales = []
    for k in range(groups):
        out = curves.group == k
        kept = weights * ~out
        kept_scales = find_scales(curves, model, len(scales), kept, scales) if scales else ()
        all_scales.append(kept_scales)
        if 0 < k < groups - 1:
            sums = statistics(curves, model, kept_scales)
            table = solve(curves, model, kept_scales, sums, kept, np.delete(np.arange(groups), k)).table
            errors[out] = (sums.mean_square(coefficients_of(curves, table)) - noise)[out]
    return errors, all_scales


@dataclass(frozen=True)
class Worst:
    """Expected error at the power-on temperature, between calibration temperatures, where a table is worst.

    Attributes
    ----------
    temperature
        Temperature, degC.
    error
        Root mean square over t < T_M of one start there, with its repeatability, shape (axes,).
    """

    temperature: float
    error: Array


def worst_between(curves: Curves, chosen: Judged, spread: CycleSpread) -> Worst | None:
    """Return the expected error at the worst power-on temperature, from temperatures left out of the fit.

    Interpolation over a gap h errs by up to ``f'' h^2 / 8``; at a temperature that was left out, h1 and h2 from its
    neighbours, by ``f'' h1 h2 / 2``. Each gap takes the larger f'' of its two ends. None with fewer than three
    temperatures, and for ``interval-cubic``, whose errors at its end points already show its wide intervals.
    """
    t = curves.temperatures
    left = np.nan_to_num(chosen.left_by_temperature)
    if len(t) < 3 or chosen.model == "interval-cubic":
        return None
    gap = np.diff(t)
    repeated = np.nan_to_num(spread.cycle)
    interpolation = np.sqrt(np.maximum(left[1:-1] ** 2 - repeated**2, 0.0))
    bend = np.zeros_like(left)
    bend[1:-1] = interpolation / (gap[:-1] * gap[1:])[:, None]
    between = np.maximum(bend[:-1], bend[1:]) * (gap**2 / 4)[:, None]
    total = np.sqrt(between**2 + np.nan_to_num(chosen.training) ** 2 + repeated**2)
    size = np.sqrt(np.mean(curves.mean**2, axis=(0, 1)))
    place = int(np.argmax((total / np.maximum(size, 1e-300)).max(axis=1)))
    return Worst(float(t[place] + gap[place] / 2), total[place])


def _jackknife(values: Array, count: int) -> Array | None:
    """Return the jackknife covariance of the time scales fitted without each temperature (Efron and Tibshirani, 11)."""
    n = len(values)
    if not count or n < 3:
        return None
    deviation = values - values.mean(axis=0)
    return np.asarray((n - 1) / n * deviation.T @ deviation)


def choose(curves: Curves, rows: list[Judged]) -> Judged:
    """Return the model that best predicts cycles and temperatures left out, with both kinds of sensors weighted alike.

    The score is the sum of both mean squares relative to those without compensation; of models within 2 % of the best
    the one with the fewest time scales is taken.
    """
    none = next(row for row in rows if row.model == "none")
    fitted = [row for row in rows if row.model != "none"]
    scores = np.array([_score(curves, row, none) for row in fitted])
    good = [row for row, score in zip(fitted, scores, strict=True) if score <= 1.02 * scores.min()]
    return min(good, key=lambda row: row.count)


def _score(curves: Curves, row: Judged, none: Judged) -> float:
    parts = [part for part in (row.left_cycle, row.left_temperature) if part is not None] or [row.training]
    total = 0.0
    for index in curves.kinds().values():
        size = max(float(np.mean(none.training[index] ** 2)), 1e-300)
        total += sum(float(np.mean(part[index] ** 2)) for part in parts) / size
    return total


def _root(mean_squares: Array) -> Array:
    """Return the root of the mean over cycles (c, axes); a mean below the noise counts as zero."""
    return np.asarray(np.sqrt(np.maximum(mean_squares.mean(axis=0), 0.0)))


def _by_group(curves: Curves, mean_squares: Array) -> Array:
    return np.stack([_root(mean_squares[curves.group == k]) for k in range(len(curves.temperatures))])


@dataclass(frozen=True)
class CycleSpread:
    """Repeatability of cycles: root mean squares over t < T_M without white noise, per axis.

    Attributes
    ----------
    cycle
        Deviation of a cycle from the mean of its unit and temperature, shape (axes,); NaN where none was repeated.
    uncertainty
        Standard uncertainty of `cycle`, shape (axes,). With n degrees of freedom and a white part w^2 subtracted, its
        square r^2 is known to (r^2 + w^2) sqrt(2 / n); below the noise (r = 0), r is known to w (2 / n)^(1/4).
    freedom
        Degrees of freedom.
    by_temperature
        `cycle` at each calibration temperature, shape (k, axes).
    unit
        Deviation of a unit's mean from that of its temperature beyond repeatability, shape (axes,), or None.
    """

    cycle: Array
    uncertainty: Array
    freedom: int
    by_temperature: Array
    unit: Array | None


def repeatability(curves: Curves) -> CycleSpread:
    """Return the repeatability of power cycles, the floor that no table can beat, and the spread of units.

    Each cycle's curve is first smoothed by a cubic in ln(1 + t / 20 s), whose four coefficients contain far less noise
    than the bins; the white noise left in them is subtracted.
    """
    scales = (_SMOOTH_SCALE,)
    sums = statistics(curves, "knot-log-cubic", scales)
    coefficients = np.linalg.solve(sums.normal, sums.moment)
    metric = sums.normal.sum(axis=0) / sums.weight.sum()
    size = coefficients.shape[1]
    noise = curves.noise * (size / sums.weight + 1 / curves.reference_seconds)[:, None]
    groups, a = len(curves.temperatures), len(curves.axes)
    within, freedom = np.zeros((groups, a)), np.zeros(groups)
    between, units, members = np.zeros(a), 0, 0.0
    for k in range(groups):
        means = []
        for u in np.unique(curves.unit[curves.group == k]):
            chosen = (curves.group == k) & (curves.unit == u)
            n = int(chosen.sum())
            mean = coefficients[chosen].mean(axis=0)
            within[k] += _squares(coefficients[chosen] - mean, metric) - (n - 1) * noise[chosen].mean(axis=0)
            freedom[k] += n - 1
            means.append(mean)
            members += 1 / n
        if len(means) > 1:
            between += _squares(np.array(means) - np.mean(means, axis=0), metric)
            units += len(means) - 1
    total = int(freedom.sum())
    cycle = np.sqrt(np.maximum(within.sum(axis=0) / total, 0.0)) if total else np.full(a, np.nan)
    known = (np.nan_to_num(cycle) ** 2 + noise.mean(axis=0)) * np.sqrt(2 / max(total, 1))
    uncertainty = np.sqrt(cycle**2 + known) - cycle
    each = np.sqrt(np.maximum(within / np.maximum(freedom, 1)[:, None], 0.0))
    each[freedom == 0] = np.nan
    unit = None
    if units:
        pairs = len(set(zip(curves.unit.tolist(), curves.group.tolist(), strict=True)))
        cycle_variance = np.where(np.isfinite(cycle), cycle, 0.0) ** 2 + noise.mean(axis=0)
        unit = np.sqrt(np.maximum(between / units - cycle_variance * members / pairs, 0.0))
    return CycleSpread(cycle, uncertainty, total, each, unit)


def _squares(deviations: Array, metric: Array) -> Array:
    """Return the sum over curves of their mean squares, from coefficients (n, p, axes), shape (axes,)."""
    squares: Array = np.einsum("npa,pq,nqa->a", deviations, metric, deviations)
    return squares


def cycle_weights(curves: Curves, spread: CycleSpread) -> Array:
    """Return the weight of each cycle with a random effect of the unit, shape (c,).

    ``1 / (1 + n rho)`` for each of the n cycles of a unit at a temperature, rho the variance between units over that
    between cycles: all cycles count alike where units do not differ, all units alike where they differ much.
    """
    if spread.unit is None:
        return np.ones(len(curves.cycles))
    cycle_variance = np.where(np.isfinite(spread.cycle), spread.cycle, 0.0) ** 2 + curves.expected_noise().mean(axis=0)
    rho = float(np.mean(spread.unit**2 / np.maximum(cycle_variance, 1e-300)))
    same = (curves.unit[:, None] == curves.unit) & (curves.group[:, None] == curves.group)
    weights: Array = 1 / (1 + rho * same.sum(axis=1))
    return np.asarray(weights / weights.max())


# Warnings on a warm-up test, a sentence each.


_COLD = 1.0  # K above the chamber at power-on: the unit was still warm
_OFF_SET_POINT = 0.5  # K from the set point
_LATE = 0.5  # s after power-on: the fastest part of the curve is missing
_DRIFT_SHARE = 0.5  # of the residual: a smaller drift of the settled part is not warned of
_FEWEST_TEMPERATURES, _EXCHANGED = 5, 3.0
"""Temperatures that show two of them exchanged; by how many times the bends between neighbours must then lessen."""
_USUAL_SCATTER = 0.04
"""Of a curve, from cycle to cycle: taken where there is one cycle at each temperature."""
_MOST_NAMED = 3  # cycles that a warning names
_WIDE = 20.0  # K between knots from which one curve for the whole interval is doubted
_AT_LIMIT = 1.02  # a time constant within 2 % of the limit of the search is at the limit
_COUNTS = 0.05  # of a curve: smaller parts are not warned of
_ROUNDING = 1e-12  # of the reference, relative
_SHARE_NOTED = 1e-3  # of all rows: exact zeros up to which there is only a note
_PAUSE, _MOSTLY = 5, 0.5
"""Seconds of exact repeats that are a stuck output; share of the time in which a column that is not coarse changes."""
_MORE, _ODD = 1.2, 4.0  # times the error at temperatures left out that is reported; medians beyond which a cycle is odd
_IMPROBABLE = {"rad/s": np.radians(5.0), "m/s^2": 1.0}
"""A larger change after power-on, 5 deg/s or 0.1 g, is no warm-up: the unit of the column is wrong."""


def quality_warnings(curves: Curves, chosen: Judged, settled: bool) -> list[str]:
    """Return the warnings on a test and the table made from it."""
    return [
        *_warn_dead_columns(curves),
        *_warn_ends(curves, settled),
        *_warn_starts(curves),
        *_warn_sizes(curves),
        *_warn_gravity(curves),
        *_warn_motion(curves),
        *_warn_drifts(curves, chosen),
        *_warn_temperatures(curves),
        *_warn_single(curves),
        *_warn_odd_cycles(curves),
        *_warn_exchanged(curves),
        *_note_start(curves),
        *_warn_intervals(curves, chosen),
        *_warn_constants(curves, chosen),
    ]


def expectations(curves: Curves, chosen: Judged, worst: Worst | None) -> list[str]:
    """Return the errors to expect in use beyond those that the tests show."""
    messages: list[str] = []
    stated = chosen.left_temperature
    if worst is not None and stated is not None and (worst.error > _MORE * stated + _ROUNDING).any():
        axes = [max(index, key=lambda i: worst.error[i]) for index in curves.kinds().values()]
        sizes = [f"{small_text(worst.error[i], curves.units[i])} ({curves.axes[i]})" for i in axes]
        messages.append(
            Note(
                f"at the worst power-on temperature, near {worst.temperature:.3g} degC, expect {' and '.join(sizes)} "
                "rms in the worst axis, more than the temperatures left out of the fit show: measure there"
            )
        )
    return messages


def _warn_dead_columns(curves: Curves) -> list[str]:
    """Return messages on columns that never change, or not for a while, while others do, and on rows of zeros."""
    messages: list[str] = []
    stuck: dict[str, list[str]] = {}
    paused: dict[str, list[str]] = {}
    for cycle in curves.cycles:
        still = (cycle.bins.variance == 0) & (cycle.bins.count > 1)[:, None]
        constant = still.all(axis=0) & (np.ptp(cycle.bins.mean, axis=0) == 0)
        # where steps are larger than the noise, repeats are no fault, and a variance is at most step^2 / 4
        coarse = [quantile(v, 0.75) < step**2 for v, step in zip(cycle.bins.variance.T, cycle.steps, strict=True)]
        for i, axis in enumerate(cycle.axes):
            if constant[i]:
                stuck.setdefault(axis, []).append(cycle.name)
            elif (longest := _longest(still[:, i])) >= _PAUSE and still[:, i].mean() < _MOSTLY and not coarse[i]:
                paused.setdefault(axis, []).append(f"{cycle.name} ({longest} s)")
    for axis, names in stuck.items():
        messages.append(
            Bad(
                f"{axis} never changes in {_named(names)}: is it connected? --axes leaves a column out",
                "check the cable and record the cycles again, or leave the column out (--axes)",
            )
        )
    for axis, names in paused.items():
        messages.append(
            Bad(
                f"{axis} is stuck for a while in {_named(names)}: its samples repeat exactly",
                "check the link to the sensor, and record those cycles again",
            )
        )
    empty = [f"{cycle.name} ({cycle.zeros})" for cycle in curves.cycles if cycle.zeros]
    if empty:
        zeros = sum(cycle.zeros for cycle in curves.cycles)
        rows = zeros + int(sum(cycle.bins.count.sum() for cycle in curves.cycles))
        kind = Note if zeros < _SHARE_NOTED * rows else Finding
        messages.append(
            kind(
                f"rows in which every axis is exactly zero were left out: {_named(empty)}",
                "check the link to the sensor, and record those cycles again",
            )
        )
    return messages


def _longest(flags: NDArray[np.bool_]) -> int:
    """Return the length of the longest run of true values."""
    ends = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return int((ends[1::2] - ends[::2]).max(initial=0))


def _named(names: list[str]) -> str:
    return first_of(names, _MOST_NAMED)


def _warn_ends(curves: Curves, settled: bool) -> list[str]:
    messages: list[str] = []
    if not settled:
        messages.append(
            "not settled: the curves still change when the recordings end; the settling time of "
            f"{curves.settling_time:g} s leaves {SETTLED:g} s for the reference: record longer"
        )
    reached = np.array([curves.end[curves.group == k].max() for k in range(len(curves.temperatures))])
    beyond = [f"{t:g}" for t, e in zip(curves.temperatures, reached, strict=True) if e < curves.settling_time - 1]
    if beyond:
        messages.append(
            Finding(
                f"no cycle at {' '.join(beyond)} degC lasts to T_M = {curves.settling_time:g} s: the table goes on "
                f"from {reached.min():g} s without data, and a cubic may go anywhere there",
                "record there beyond T_M, or state a shorter one (--settling-time)",
            )
        )
    short = [
        f"{c.name} ({end:.6g} s)" for c, end, half in zip(curves.cycles, curves.end, curves.halved, strict=True) if half
    ]
    if short:
        messages.append(
            Finding(
                f"not settled: ends before T_M + {SETTLED:g} s = {curves.settling_time + SETTLED:g} s, so that the "
                f"second half of the cycle is its reference: {_named(short)}",
                "record longer, or state a shorter T_M (--settling-time)",
            )
        )
    return messages


def _warn_starts(curves: Curves) -> list[str]:
    late = [f"{c.name} ({c.first:.3g} s)" for c in curves.cycles if c.first > _LATE]
    action = "start the log before power comes on, and record those cycles again"
    return [Finding(f"the first sample comes late after power-on: {_named(late)}", action)] if late else []


def _warn_sizes(curves: Curves) -> list[str]:
    """Return messages on changes so large that the column's title probably states a wrong unit."""
    largest = np.nanmax(np.abs(curves.mean), axis=(0, 1))
    return [
        Bad(
            f"{axis} changes by {small_text(change, unit)} after power-on: does its column have the right unit?",
            STATE_UNIT,
        )
        for axis, change, unit in zip(curves.axes, largest, curves.units, strict=True)
        if change > _IMPROBABLE.get(unit, np.inf)
    ]


def _warn_gravity(curves: Curves) -> list[str]:
    """Return a message on three accelerometers that, settled, show no gravity."""
    places = [curves.axes.index(axis) for axis in triad("accel") if axis in curves.axes]
    if len(places) < 3:
        return []
    unit = curves.cycles[0].file_units[places[0]]
    reason = no_gravity(median(np.linalg.norm(curves.reference[:, places], axis=1)), unit)
    return [Bad(f"accel_x .. accel_z: {reason}; is their unit, {unit}, right?", reason.action)] if reason else []


def _warn_motion(curves: Curves) -> list[str]:
    moved = [
        f"{c.name} ({seconds:g} s, first at {began:g} s)"
        for c, (seconds, began) in zip(curves.cycles, curves.moved, strict=True)
        if seconds > 0
    ]
    action = "fix the unit to something heavy, and record those cycles again"
    return [Finding(f"the unit moved; those seconds are left out: {_named(moved)}", action)] if moved else []


def still_drifting(curves: Curves, chosen: Judged) -> NDArray[np.bool_]:
    """Return which settled parts still drift by much of the residual, shape (c, axes)."""
    clear = np.abs(curves.drift) > STILL_DRIFTS.limit * curves.drift_uncertainty
    largest = np.sqrt((curves.mean**2).mean(axis=(0, 1)))
    return np.asarray(clear & (np.abs(curves.drift) > np.maximum(_DRIFT_SHARE * chosen.training, 0.05 * largest)))


def _warn_drifts(curves: Curves, chosen: Judged) -> list[str]:
    """Return messages on settled parts that still drift by much of the residual."""
    drifting = still_drifting(curves, chosen)
    messages: list[str] = []
    for kind, index in curves.kinds().items():
        share = drifting[:, index]
        if share.any():
            row, column = np.unravel_index(np.argmax(np.abs(curves.drift[:, index]) * share), share.shape)
            axis = index[column]
            messages.append(
                Finding(
                    f"not settled: {kind} still drifts in the settled part of {int(share.any(axis=1).sum())} of "
                    f"{len(curves.cycles)} cycles, most in {curves.cycles[row].name} ({curves.axes[axis]}, "
                    f"{small_text(curves.drift[row, axis], curves.units[axis])} from the settling time to its "
                    "end); the curve is counted from the mean of that part, which is not yet the settled zero",
                    "record longer, and state a later --settling-time",
                )
            )
    return messages


def _warn_temperatures(curves: Curves) -> list[str]:
    warm, far = [], []
    for cycle, nominal in zip(curves.cycles, curves.temperatures[curves.group], strict=True):
        chamber = nominal if cycle.chamber is None else cycle.chamber
        reading = cycle.temperature if cycle.first_reading is None else max(cycle.temperature, cycle.first_reading)
        if reading - chamber > _COLD:
            warm.append(f"{cycle.name} ({reading - chamber:+.2g} K)")
        elif abs(cycle.temperature - nominal) > _OFF_SET_POINT:
            far.append(f"{cycle.name} ({cycle.temperature - nominal:+.2g} K)")
    messages: list[str] = []
    if warm:
        messages.append(
            Finding(
                "not cold: at power-on warmer than the chamber, so that the curve starts half-way (soaked too briefly, "
                f"or logged from some time after power-on): {_named(warm)}",
                "soak longer with the unit off, start the log before power comes on, and record those cycles again",
            )
        )
    if far:
        messages.append(Note(f"power-on temperature more than {_OFF_SET_POINT:g} K from the set point: {_named(far)}"))
    return messages


def _warn_single(curves: Curves) -> list[str]:
    count = np.bincount(curves.group, minlength=len(curves.temperatures))
    alone = [f"{t:g}" for t, n in zip(curves.temperatures, count, strict=True) if n == 1]
    if not alone:
        return []
    return [
        Finding(
            f"one cycle only at {' '.join(alone)} degC: its repeatability is not known there",
            "record a second cycle there",
        )
    ]


def _warn_odd_cycles(curves: Curves) -> list[str]:
    """Return a message on cycles that differ from others at their temperature far more than usual in this test."""
    means, _ = curves.group_means()
    apart = np.einsum("cb,cba->ca", curves.seconds, (curves.mean - means[curves.group]) ** 2)
    apart = np.sqrt(apart / curves.seconds.sum(axis=1)[:, None])
    several = np.bincount(curves.group)[curves.group] > 1
    if several.sum() < _MOST_NAMED + 1:
        return []
    usual = medians(apart[several], 0)
    limit = _ODD * np.maximum(usual, np.sqrt(curves.expected_noise().mean(axis=0)))
    odd = (apart > limit + _ROUNDING * np.abs(curves.reference).max(axis=0)) & several[:, None]
    if not odd.any():
        return []
    row, column = np.unravel_index(int(np.argmax(np.where(odd, apart / np.maximum(limit, 1e-300), 0.0))), odd.shape)
    unit = curves.units[column]
    names = [curves.cycles[i].name for i in np.flatnonzero(odd.any(axis=1))]
    return [
        f"a power cycle differs from the others at its temperature by {small_text(apart[row, column], unit)} "
        f"({curves.axes[column]}), where cycles usually differ by {small_text(usual[column], unit)}: look at "
        f"{_named(names)}, and leave out what is wrong"
    ]


def _warn_exchanged(curves: Curves) -> list[str]:
    """Return a message on two temperatures whose curves fit those of their neighbours only when they are exchanged."""
    t, (means, seconds) = curves.temperatures, curves.group_means()
    count = len(t)
    if count < _FEWEST_TEMPERATURES:
        return []
    counted = np.asarray((seconds > 0).all(axis=0))
    width = np.sqrt(np.diff(curves.edges))[:, None] * counted[:, None]
    scale = np.maximum(np.sqrt(np.mean(means**2, axis=(0, 1))), _ROUNDING * np.abs(curves.reference).max(axis=0))
    scale = np.where(scale > 0, scale, np.inf)
    flat = (means * width / scale).reshape(count, -1)
    share = (t[1:-1] - t[:-2]) / (t[2:] - t[:-2])
    bend = np.zeros((count - 2, count))
    for k in range(count - 2):
        bend[k, k : k + 3] = share[k] - 1, 1.0, -share[k]
    cycles = np.bincount(curves.group, minlength=count)
    if (cycles < 2).all():  # nothing tells what cycles scatter by
        scatter = _USUAL_SCATTER**2 * float(np.square(flat).sum()) / count
    else:
        apart = np.square((curves.mean - means[curves.group]) * width / scale).sum(axis=(1, 2))
        scatter = float(apart.sum()) / int((cycles - 1).sum())
    floor = float((np.square(bend).sum(axis=0) / cycles).sum()) * scatter

    def roughness(order: Sequence[int]) -> float:
        return float(np.square(bend @ flat[list(order)]).sum())

    as_stated = roughness(range(count))
    others = []
    for a, b in combinations(range(count), 2):
        order = list(range(count))
        order[a], order[b] = b, a
        others.append((roughness(order), a, b))
    least, a, b = min(others)
    if as_stated < _EXCHANGED * (least + floor):
        return []
    names = [cycle.name for cycle, group in zip(curves.cycles, curves.group.tolist(), strict=True) if group in (a, b)]
    return [
        f"the curves at {t[a]:g} and {t[b]:g} degC fit those at the temperatures beside them only when they are "
        f"exchanged, {np.sqrt(as_stated / (least + floor)):.2g} times better (rms): look at power_on_temperature of "
        f"{_named(names)}"
    ]


def _note_start(curves: Curves) -> list[str]:
    """Return a note on what logs that all begin late, which no curve shows, would make of the table."""
    means, seconds = curves.group_means()
    early = np.flatnonzero((seconds > 0).all(axis=0))[:2]
    if len(early) < 2:
        return []
    middle = (curves.edges[1:] + curves.edges[:-1]) / 2
    steep = np.abs(means[:, early[1]] - means[:, early[0]]).max(axis=0) / (middle[early[1]] - middle[early[0]])
    noise = 2 * np.sqrt(2 * curves.noise / seconds[:, early].min()) / (middle[early[1]] - middle[early[0]])
    sizes = [
        f"{small_text(float(steep[index].max()), curves.units[index[0]])} ({kind})"
        for kind, index in curves.kinds().items()
        if (steep[index] > noise[index]).any()
    ]
    if not sizes:
        return []
    return [
        Note(
            f"time 0 of each file is taken for power-on: all logs begun 1 s late would put up to {' and '.join(sizes)} "
            "of error into the first seconds"
        )
    ]


def _warn_intervals(curves: Curves, chosen: Judged) -> list[str]:
    if chosen.model != "interval-cubic":
        return []
    wide = [
        f"{low:g} to {high:g}"
        for low, high in zip(curves.temperatures[:-1], curves.temperatures[1:], strict=True)
        if high - low > _WIDE
    ]
    if not wide:
        return []
    return [
        f"interval-cubic uses one curve for all of {', '.join(wide)} degC, the mean of both ends: measure in between, "
        "or use a model with knots"
    ]


def at_limit(curves: Curves, scale: float) -> bool:
    """Return whether a time scale, s, is the longest that is sought, which tells only that it may be longer."""
    return scale >= SCALE_LIMIT * curves.settling_time / _AT_LIMIT


def _warn_constants(curves: Curves, chosen: Judged) -> list[str]:
    """Return a message on a time constant at the limit of the search, if its part of the curve matters."""
    if chosen.model != "exponential" or chosen.solution is None:
        return []
    tau = chosen.solution.scales[-1]
    changes = np.abs(chosen.table.coefficients[..., -1]).max(axis=0) * (1 - np.exp(-curves.settling_time / tau))
    whole = np.nanmax(np.abs(curves.mean), axis=(0, 1))
    # An axis with one value has only rounding errors as its curve.
    counts = changes > np.maximum(_COUNTS * whole, _ROUNDING * np.abs(curves.reference).max(axis=0))
    if not at_limit(curves, tau) or not counts.any():
        return []
    return [
        Finding(
            f"the time constant {tau:.4g} s is the longest that is sought, {SCALE_LIMIT:g} T_M: the cycles only show "
            "that something changes more slowly than they last",
            "record longer cycles",
        )
    ]


def after_of(cycles: Sequence[Cycle]) -> str | None:
    """Return the SHA-256 of the thermal record that all cycles were corrected by; None for none.

    Raises
    ------
    DataError
        It is not the same for all cycles.
    """
    first = cycles[0]
    sensors = {axis.partition("_")[0] for axis in first.axes}
    digests = [next((t.hashes[0] for t in parse_thermals(c.corrected_by) if t.sensor in sensors), None) for c in cycles]
    for cycle, after in zip(cycles, digests, strict=True):
        if after != digests[0]:
            mine, its = (
                f"the thermal record sha256:{digest[:12]}" if digest else "none" for digest in (after, digests[0])
            )
            raise DataError(
                f"{cycle.name}: corrected over temperature by {mine}, but {first.name} by {its}; expected all cycles "
                "as the unit put them out, or all corrected by the same thermal record"
            )
    return digests[0]

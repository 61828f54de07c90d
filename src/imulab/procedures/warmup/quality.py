"""What is wrong with a warm-up test, a sentence each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from imulab.errors import DataError, first_of
from imulab.procedures.order import thermals_of
from imulab.procedures.warmup.curves import SETTLED, Curves
from imulab.procedures.warmup.cycles import Cycle
from imulab.procedures.warmup.engineering import in_engineering
from imulab.procedures.warmup.judge import Judged, Worst
from imulab.procedures.warmup.solve import SCALE_LIMIT
from imulab.verdict import Bad, Note

_COLD = 1.0
_FAR = 0.5
_LATE = 0.5
_CLEAR = 4.0
_DRIFT_SHARE = 0.5
_MOST_NAMED = 3
_WIDE = 20.0
_AT_LIMIT = 1.02
_COUNTS = 0.05
_ROUNDING = 1e-12
_PAUSE, _MOSTLY = 5, 0.5
"""Seconds of exactly repeated samples that are no coarse output, in a column that changes most of the time."""
_MORE, _ODD = 1.2, 4.0
_IMPROBABLE = {"rad/s": np.radians(5.0), "m/s^2": 1.0}
"""A change after power-on that no instrument with a warm-up table has: 5 deg/s, 0.1 g."""


def quality_warnings(curves: Curves, chosen: Judged, settled: bool) -> list[str]:
    """Return the warnings on a test and the table made from it."""
    return [
        *_dead_columns(curves),
        *_ends(curves, settled),
        *_starts(curves),
        *_sizes(curves),
        *_motion(curves),
        *_drifts(curves, chosen),
        *_temperatures(curves),
        *_single(curves),
        *_odd_cycles(curves),
        *_intervals(curves, chosen),
        *_constants(curves, chosen),
    ]


def expectations(curves: Curves, chosen: Judged, worst: Worst | None) -> list[str]:
    """Return what a unit in use has to expect of a table, beyond what the tests show of it."""
    found: list[str] = []
    stated = chosen.left_temperature
    if worst is not None and stated is not None and (worst.error > _MORE * stated + _ROUNDING).any():
        said = [
            f"{in_engineering(max(worst.error[i] for i in index), curves.units[index[0]])} ({kind})"
            for kind, index in curves.kinds().items()
        ]
        found.append(
            Note(
                f"at the worst power-on temperature, near {worst.temperature:.3g} degC, expect {' and '.join(said)} "
                "rms, more than the temperatures left out of the fit show: measure there"
            )
        )
    return found


def _dead_columns(curves: Curves) -> list[str]:
    """Columns that never change while others do, for a cycle or for a while, and rows of zeros."""
    found: list[str] = []
    stuck: dict[str, list[str]] = {}
    paused: dict[str, list[str]] = {}
    for cycle in curves.cycles:
        still = (cycle.bins.variance == 0) & (cycle.bins.count > 1)[:, None]
        constant = still.all(axis=0) & (np.ptp(cycle.bins.mean, axis=0) == 0)
        for i, axis in enumerate(cycle.axes):
            if constant[i]:
                stuck.setdefault(axis, []).append(cycle.name)
            elif (longest := _longest(still[:, i])) >= _PAUSE and still[:, i].mean() < _MOSTLY:
                paused.setdefault(axis, []).append(f"{cycle.name} ({longest} s)")
    for axis, names in stuck.items():
        found.append(Bad(f"{axis} never changes in {_named(names)}: is it connected? --axes leaves a column out"))
    for axis, names in paused.items():
        found.append(Bad(f"{axis} is stuck for a while in {_named(names)}: its samples repeat exactly"))
    empty = [f"{cycle.name} ({cycle.zeros})" for cycle in curves.cycles if cycle.zeros]
    if empty:
        found.append(f"rows in which every axis is exactly zero were left out: {_named(empty)}")
    return found


def _longest(flags: NDArray[np.bool_]) -> int:
    """Length of the longest run of true."""
    ends = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return int((ends[1::2] - ends[::2]).max(initial=0))


def _named(names: list[str]) -> str:
    return first_of(names, _MOST_NAMED)


def _ends(curves: Curves, settled: bool) -> list[str]:
    found = []
    if not settled:
        found.append(
            f"not settled: the curves still change when the recordings end; T_M = {curves.settling_time:g} s leaves "
            f"{SETTLED:g} s for the reference: record longer"
        )
    reached = np.array([curves.end[curves.group == k].max() for k in range(len(curves.temperatures))])
    beyond = [f"{t:g}" for t, e in zip(curves.temperatures, reached, strict=True) if e < curves.settling_time - 1]
    if beyond:
        found.append(
            f"no cycle at {' '.join(beyond)} degC lasts to T_M = {curves.settling_time:g} s: the table goes on from "
            f"{reached.min():g} s without data, and a cubic may go anywhere there"
        )
    short = [
        f"{c.name} ({end:.6g} s)" for c, end, half in zip(curves.cycles, curves.end, curves.halved, strict=True) if half
    ]
    if short:
        found.append(
            f"not settled: ends before T_M + {SETTLED:g} s = {curves.settling_time + SETTLED:g} s, so that the second "
            f"half of the cycle is its reference: {_named(short)}"
        )
    return found


def _starts(curves: Curves) -> list[str]:
    late = [f"{c.name} ({c.first:.3g} s)" for c in curves.cycles if c.first > _LATE]
    return [f"the first sample comes late after power-on: {_named(late)}"] if late else []


def _sizes(curves: Curves) -> list[str]:
    """What a unit in a column's title that is not that of its numbers looks like."""
    largest = np.nanmax(np.abs(curves.mean), axis=(0, 1))
    return [
        f"{axis} changes by {in_engineering(change, unit)} after power-on: does its column have the right unit?"
        for axis, change, unit in zip(curves.axes, largest, curves.units, strict=True)
        if change > _IMPROBABLE.get(unit, np.inf)
    ]


def _motion(curves: Curves) -> list[str]:
    moved = [
        f"{c.name} ({seconds:g} s, first at {began:g} s)"
        for c, (seconds, began) in zip(curves.cycles, curves.moved, strict=True)
        if seconds > 0
    ]
    return [f"the unit moved; those seconds are left out: {_named(moved)}"] if moved else []


def _drifts(curves: Curves, chosen: Judged) -> list[str]:
    """Settled parts that go on changing by much of what the model leaves over."""
    clear = np.abs(curves.drift) > _CLEAR * curves.drift_uncertainty
    largest = np.sqrt((curves.mean**2).mean(axis=(0, 1)))
    big = np.abs(curves.drift) > np.maximum(_DRIFT_SHARE * chosen.training, 0.05 * largest)
    found = []
    for kind, index in curves.kinds().items():
        share = (clear & big)[:, index]
        if share.any():
            row, column = np.unravel_index(np.argmax(np.abs(curves.drift[:, index]) * share), share.shape)
            axis = index[column]
            found.append(
                f"not settled: {kind} still drifts in the settled part of {int(share.any(axis=1).sum())} of "
                f"{len(curves.cycles)} cycles, most in {curves.cycles[row].name} ({curves.axes[axis]}, "
                f"{in_engineering(curves.drift[row, axis], curves.units[axis])} from T_M to its end); Z is relative to "
                "the mean of that part"
            )
    return found


def _temperatures(curves: Curves) -> list[str]:
    warm, far = [], []
    for cycle, nominal in zip(curves.cycles, curves.temperatures[curves.group], strict=True):
        chamber = nominal if cycle.chamber is None else cycle.chamber
        reading = cycle.temperature if cycle.first_reading is None else max(cycle.temperature, cycle.first_reading)
        if reading - chamber > _COLD:
            warm.append(f"{cycle.name} ({reading - chamber:+.2g} K)")
        elif abs(cycle.temperature - nominal) > _FAR:
            far.append(f"{cycle.name} ({cycle.temperature - nominal:+.2g} K)")
    found = []
    if warm:
        found.append(
            "not cold: at power-on warmer than the chamber, so that the curve starts half-way (soak longer): "
            f"{_named(warm)}"
        )
    if far:
        found.append(f"power-on temperature more than {_FAR:g} K from the set point: {_named(far)}")
    return found


def _single(curves: Curves) -> list[str]:
    count = np.bincount(curves.group, minlength=len(curves.temperatures))
    alone = [f"{t:g}" for t, n in zip(curves.temperatures, count, strict=True) if n == 1]
    if not alone:
        return []
    return [f"one cycle only at {' '.join(alone)} degC: its repeatability is not known there"]


def _odd_cycles(curves: Curves) -> list[str]:
    """Cycles that differ from the others at their temperature far more than cycles of this test do."""
    means, _ = curves.group_means()
    apart = np.einsum("cb,cba->ca", curves.seconds, (curves.mean - means[curves.group]) ** 2)
    apart = np.sqrt(apart / curves.seconds.sum(axis=1)[:, None])
    several = np.bincount(curves.group)[curves.group] > 1
    if several.sum() < _MOST_NAMED + 1:
        return []
    usual = np.median(apart[several], axis=0)
    limit = _ODD * np.maximum(usual, np.sqrt(curves.expected_noise().mean(axis=0)))
    odd = (apart > limit + _ROUNDING * np.abs(curves.reference).max(axis=0)) & several[:, None]
    if not odd.any():
        return []
    row, column = np.unravel_index(int(np.argmax(np.where(odd, apart / np.maximum(limit, 1e-300), 0.0))), odd.shape)
    unit = curves.units[column]
    names = [curves.cycles[i].name for i in np.flatnonzero(odd.any(axis=1))]
    return [
        f"a power cycle differs from the others at its temperature by {in_engineering(apart[row, column], unit)} "
        f"({curves.axes[column]}), where cycles usually differ by {in_engineering(usual[column], unit)}: look at "
        f"{_named(names)}, and leave out what is wrong"
    ]


def _intervals(curves: Curves, chosen: Judged) -> list[str]:
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


def _constants(curves: Curves, chosen: Judged) -> list[str]:
    """A time constant that the search was stopped at, not led to, where its part of the curve is one that counts."""
    if chosen.model != "exponential" or chosen.solution is None:
        return []
    tau = chosen.solution.scales[-1]
    changes = np.abs(chosen.table.coefficients[..., -1]).max(axis=0) * (1 - np.exp(-curves.settling_time / tau))
    whole = np.nanmax(np.abs(curves.mean), axis=(0, 1))
    # An axis of one value has no curve but what rounding leaves of the difference from its reference.
    counts = changes > np.maximum(_COUNTS * whole, _ROUNDING * np.abs(curves.reference).max(axis=0))
    if tau < SCALE_LIMIT * curves.settling_time / _AT_LIMIT or not counts.any():
        return []
    return [
        f"the time constant {tau:.4g} s is the longest that is sought, {SCALE_LIMIT:g} T_M: the cycles only show that "
        "something changes more slowly than they last"
    ]


def after_of(cycles: Sequence[Cycle]) -> str | None:
    """Return the SHA-256 of the thermal record that the axes of all cycles were corrected by; None for none.

    Raises
    ------
    DataError
        It is not the same for all.
    """
    first = cycles[0]
    sensors = {axis.partition("_")[0] for axis in first.axes}
    found = [next((t.hashes[0] for t in thermals_of(c.corrected_by) if t.sensor in sensors), None) for c in cycles]
    for cycle, after in zip(cycles, found, strict=True):
        if after != found[0]:
            mine, its = (f"the thermal record sha256:{one[:12]}" if one else "none" for one in (after, found[0]))
            raise DataError(
                f"{cycle.name}: corrected over temperature by {mine}, but {first.name} by {its}; expected all cycles "
                "as the unit put them out, or all corrected by the same thermal record"
            )
    return found[0]

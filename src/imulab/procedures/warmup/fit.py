"""The fit of a warm-up test: from recordings of power cycles to the warm-up table and its record.

Stages: `cycles` averages recordings, `model` fits tables by least squares, `quality` compares models and chooses one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, TypeAlias, Unpack

import numpy as np

from imulab.errors import DataError, OptionError, listed
from imulab.options import RARE, choice, measure, names_of_columns, parsed
from imulab.procedures.result import Result, as_blocks
from imulab.procedures.warmup import BEYOND, EXITS, MODELS, POOLS, settling_size
from imulab.procedures.warmup.cycles import Curves, Cycle, common_axes, find_power_cycle, make_curves, with_axes
from imulab.procedures.warmup.model import SOURCE_TEMPERATURES, WarmupTable, coefficient_covariance, statistics
from imulab.procedures.warmup.quality import (
    CANDIDATES,
    CycleSpread,
    Judged,
    after_of,
    choose,
    cycle_weights,
    judge,
    judge_none,
    repeatability,
    still_drifting,
    worst_between,
)
from imulab.procedures.warmup.record import make_record
from imulab.quantities import in_si, number, temperature_list
from imulab.recording import Array, Data, Reading
from imulab.records.calibration import Calibration
from imulab.records.comparison import different_units

TOLERANCE = 1.0
"""How far a power-on temperature may lie from its calibration temperature, K."""
SETTLING_SHARE = 0.05
"""Share of the largest |Z| of its kind below which a curve counts as settled."""
_LATER, _SETTLED_BY, _SLOWED = 1.2, 2 / 3, 0.5
"""Ratio of a settling time to the one tried before, share of the shortest cycle that it takes at most, and how much
slower what is left must drift."""


@dataclass(frozen=True, repr=False)
class WarmupFit(Result):
    """Result of a warm-up fit.

    Attributes
    ----------
    calibration
        The record.
    table
        The table that the unit subtracts.
    models
        The compared models with their errors; the first is no compensation.
    repeatability
        Repeatability of power cycles, and spread of units.
    curves
        The cycles side by side.

    Examples
    --------
    >>> import imulab as il
    >>> cycles = il.simulate_warmup((-20.0, 0.0, 20.0), cycles=2, rate=5.0)
    >>> fit = il.fit_warmup(cycles, temperatures=(-20.0, 0.0, 20.0), model="exponential")
    >>> fit.table.model
    'exponential'
    """

    calibration: Calibration
    table: WarmupTable
    models: tuple[Judged, ...]
    repeatability: CycleSpread
    curves: Curves


Temperatures: TypeAlias = Annotated[Sequence[float] | str, parsed(temperature_list, "T,T,...", unit="degC")]


def fit_warmup(
    cycles: Annotated[Sequence[Cycle | Data], "a list of power cycles, one for each test"],
    *,
    model: Annotated[str, choice(("auto", *MODELS))] = "auto",
    temperatures: Temperatures = SOURCE_TEMPERATURES,
    tolerance: Annotated[float | str, parsed(number, "K"), RARE] = TOLERANCE,
    settling_time: Annotated[float | str | None, measure("time", "s")] = None,
    settling_limit: Annotated[Mapping[str, float] | str, parsed(settling_size, "LIMIT")] = "5 %",
    exit: Annotated[str, choice(EXITS)] = "zero",  # noqa: A002
    taper_time: Annotated[float | str, measure("time", "s"), RARE] = "60 s",
    pool: Annotated[str, choice(POOLS)] = "unit",
    axes: Annotated[str | Sequence[str] | None, parsed(names_of_columns, "A,A,...")] = None,
    beyond: Annotated[str, choice(BEYOND), RARE] = "zero",
    latest_start: Annotated[float | str, measure("time", "s"), RARE] = "5 s",
    temperature_column: Annotated[bool, RARE] = False,
    **reading: Unpack[Reading],
) -> WarmupFit:
    """Fit the curve of an output's zero after power-on, ``Z(t; T)``, to power cycles at several temperatures.

    Each cycle is referenced to its own settled mean (t >= T_M); the fit is to t < T_M.

    Parameters
    ----------
    cycles
        One per power cycle: files, recordings, data frames or arrays by name, with ``power_on_temperature`` in their
        heads (``metadata=`` of `Recording.from_frame`), or what `find_power_cycle` returned.
    model
        How the bias goes with time; auto compares them. ``interval-cubic`` is the source's; ``auto`` takes the one that
        best predicts cycles and temperatures left out of the fit.
    temperatures
        Calibration temperatures, ascending. Edges of the intervals, or knots, degC.
    tolerance
        A power-on temperature within this of one of them fits, K.
    settling_time
        T_M; chosen from the data if not given. In s.
    settling_limit
        Settled below this: percent of the peak, or deg/h, mg ... A share of the largest Z, a rate or an acceleration
        as a text; or kind (``gyro``, ``accel``) to size in SI, 5 % of the largest for one that is not named.
    exit
        What the table gives from T_M on.
    taper_time
        How long a taper takes. In s.
    pool
        unit, or type: several units share one table. ``type`` has a random effect for each unit.
    axes
        Columns to fit; all if not given. As a list or a text such as ``"gyro_x,gyro_y"``; all gyro_* and accel_*.
    beyond
        Beyond the outer temperatures: zero (no correction) or hold (as there).
    latest_start
        A first sample later after power-on is refused. In s.
    temperature_column
        Take a missing power-on temperature from the first row's column. Both are of cycles that `find_power_cycle` has
        not averaged before.
    reading
        How arrays and files are to be understood, of all cycles alike: `units`, `layout`, `window` ...

    Raises
    ------
    DataError
        The cycles do not make a test: too few, at other temperatures, of several units, too short, moving.
    UnitError
        Units differ between files.
    OptionError
        An option has a value that cannot be used.

    Source: start-up zero error compensation of MEMS inertial instruments (patent record 38161583), and
    Fritsch and Butland, SIAM J. Sci. Stat. Comput. 5 (1984) 300 (interpolation of amplitudes).

    Examples
    --------
    >>> import imulab as il
    >>> cycles = il.simulate_warmup((-20.0, 0.0, 20.0), cycles=2, rate=5.0)
    >>> fit = il.fit_warmup(cycles, temperatures=(-20.0, 0.0, 20.0), model="exponential")
    >>> fit.calibration.procedure
    'warmup'
    """
    temperatures = temperature_list(temperatures, "temperatures")
    tolerance = number(tolerance, "tolerance") if isinstance(tolerance, str) else tolerance
    settling_time = None if settling_time is None else in_si(settling_time, "settling_time", "time", "s")
    taper_time = in_si(taper_time, "taper_time", "time", "s")
    at = check_options(model, temperatures, tolerance, settling_time, exit, taper_time, pool, beyond)
    used = _cycles(cycles, reading, in_si(latest_start, "latest_start", "time", "s"), from_column=temperature_column)
    if axes is not None:
        used = [with_axes(cycle, _names(axes)) for cycle in used]
    order = common_axes(used)
    used = [with_axes(cycle, order) for cycle in used]
    _check_together(used, pool)
    limits = _limits(settling_limit)
    made = partial(make_curves, used, at, tolerance=tolerance, limit=limits)
    curves, settled = made(settling_time=settling_time)
    by_unit = pool == "type" and np.unique(curves.unit).size > 1
    spread, rows, chosen = _judge_all(curves, model, by_unit)
    if settling_time is None and (later := _settle_later(curves, chosen, made)):
        curves = later
        spread, rows, chosen = _judge_all(curves, model, by_unit)
    covariance = _covariance(curves, chosen, by_unit)
    table = chosen.table.with_rules(exit, taper_time, beyond, tolerance)
    record = make_record(
        curves=curves,
        rows=rows,
        chosen=chosen,
        table=table,
        spread=spread,
        covariance=covariance,
        settled=settled,
        by_unit=by_unit,
        worst=worst_between(curves, chosen, spread),
        options={
            "model": model,
            "temperatures": at.tolist(),
            "tolerance": tolerance,
            "settling_time": settling_time,
            "exit": exit,
            "pool": pool,
            "beyond": beyond,
        },
    )
    return WarmupFit(record, table, tuple(rows), spread, curves)


def _judge_all(curves: Curves, model: str, by_unit: bool) -> tuple[CycleSpread, list[Judged], Judged]:
    """Return the repeatability of curves, the models that are compared, and the one that is chosen."""
    spread = repeatability(curves)
    weights = cycle_weights(curves, spread) if by_unit else np.ones(len(curves.cycles))
    rows = [judge_none(curves)] + [
        judge(curves, name, count, weights, by_unit=by_unit) for name, count in CANDIDATES if model in ("auto", name)
    ]
    return spread, rows, choose(curves, rows)


def _settle_later(curves: Curves, chosen: Judged, made: Callable[..., tuple[Curves, bool]]) -> Curves | None:
    """Return the curves with the first later T_M after which no cycle drifts any more; None where there is no such one.

    The drift must have slowed by half: one that goes on evenly is no warm-up, and only hides in a shorter part.
    """
    drifting, rate = still_drifting(curves, chosen), _drift_rates(curves)
    time, last = curves.settling_time, _SETTLED_BY * float(curves.end.min())
    kinds = [index for index in curves.kinds().values() if drifting[:, index].any()]  # of one unit each
    while kinds and (time := 10 * np.ceil(_LATER * time / 10)) <= last:
        later, _ = made(settling_time=float(time))
        left = rate * _drift_rates(later)
        slowed = all(left[:, index].sum() < _SLOWED * (rate[:, index] ** 2).sum() for index in kinds)
        if slowed and not still_drifting(later, chosen).any():
            return later
    return None


def _drift_rates(curves: Curves) -> Array:
    """Return the mean rate at which settled parts drift at each temperature, shape (k, axes)."""
    rate = curves.drift / (curves.end - curves.settling_time)[:, None]
    return np.array([rate[curves.group == k].mean(axis=0) for k in np.unique(curves.group)])


def _names(axes: str | Sequence[str]) -> tuple[str, ...]:
    return tuple(names_of_columns(axes, "axes") if isinstance(axes, str) else axes)


def _limits(stated: Mapping[str, float] | str) -> dict[str, float]:
    """Return, by kind, the size of Z that counts as settled, in SI; if negative, its share of the largest."""
    named = settling_size(stated, "settling_limit") if isinstance(stated, str) else stated
    limits = dict.fromkeys(("gyro", "accel"), -SETTLING_SHARE)
    for kind in named:
        if kind not in limits:
            raise OptionError(f"settling_limit {kind!r}: expected limits for {listed(limits, kind)}")
    return limits | dict(named)


def _cycles(
    items: Sequence[Cycle | Data], reading: Mapping[str, Any], latest_start: float, *, from_column: bool
) -> list[Cycle]:
    """Return power cycles; recordings are averaged over bins of a second."""
    averaged = [
        item if isinstance(item, Cycle) else _averaged(item, reading, latest_start, from_column=from_column)
        for item in items
    ]
    if not averaged:
        raise DataError("no power cycles: expected at least one file for each calibration temperature")
    return averaged


def _averaged(data: Data, reading: Mapping[str, Any], latest_start: float, *, from_column: bool) -> Cycle:
    """Return one power cycle averaged over bins of a second."""
    blocks, source = as_blocks(data, reading, fit_warmup, name="cycles", clock="gyro")
    return find_power_cycle(blocks, source=source, latest_start=latest_start, temperature_from_column=from_column)


def _covariance(curves: Curves, chosen: Judged, by_unit: bool) -> Array | None:
    if chosen.solution is None:
        return None
    cluster = np.arange(len(curves.cycles))
    if by_unit:
        cluster = curves.unit * len(curves.temperatures) + curves.group
    sums = statistics(curves, chosen.model, chosen.solution.scales)
    return coefficient_covariance(curves, chosen.solution, sums, cluster)


def check_options(
    model: str,
    temperatures: Sequence[float],
    tolerance: float,
    settling_time: float | None,
    exit: str,  # noqa: A002
    taper_time: float,
    pool: str,
    beyond: str = "zero",
) -> Array:
    """Return the calibration temperatures, degC, shape (k,), after checks of all options before any data are read.

    Raises
    ------
    OptionError
        An option has a value that cannot be used.
    """
    for name, value, known in (
        ("model", model, (*MODELS, "auto")),
        ("exit", exit, EXITS),
        ("pool", pool, POOLS),
        ("beyond", beyond, BEYOND),
    ):
        if value not in known:
            raise OptionError(f"{name} {value!r}: expected one of {listed(known, value)}")
    at = np.array(temperatures, dtype=np.float64)
    if at.ndim != 1 or len(at) < 2 or not np.isfinite(at).all() or not (np.diff(at) > 0).all():
        raise OptionError(
            f"temperatures {' '.join(f'{t:g}' for t in np.ravel(at))}: expected two or more, ascending, in degC"
        )
    if not 0 < tolerance < np.diff(at).min() / 2:
        raise OptionError(
            f"tolerance {tolerance:g} K: expected more than 0 and less than half of the {np.diff(at).min():g} K "
            "between neighbouring temperatures"
        )
    if settling_time is not None and not 0 < settling_time < 1e6:
        raise OptionError(f"settling time {settling_time:g} s: expected more than 0")
    if not 0 < taper_time < 1e6:
        raise OptionError(f"taper time {taper_time:g} s: expected more than 0")
    return at


def _check_together(cycles: Sequence[Cycle], pool: str) -> None:
    after_of(cycles)
    if pool == "type":
        unnamed = [cycle.name for cycle in cycles if not cycle.serial]
        if unnamed:
            raise DataError(
                f"{unnamed[0]}: no serial in the head of the file; --pool type needs it to tell units apart"
            )
        return
    if second_name := different_units(*((cycle.name, {"serial": cycle.serial or ""}) for cycle in cycles)):
        raise DataError(f"{second_name}; expected power cycles of one unit (--pool type fits one table to several)")

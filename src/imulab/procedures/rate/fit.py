"""The fit of a rate test, from recordings to the record; the mathematics is in `dwells`, `solve` and `axes`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Unpack

import numpy as np
from numpy.typing import NDArray

from imulab.errors import DataError, ObservabilityError, OptionError, UnitError, listed
from imulab.estimation.rows import resolution
from imulab.gravity import EARTH, checked_latitude
from imulab.options import choice, measure, parsed
from imulab.procedures.rate import AXES, MOUNTINGS, ORDERS, name_gyroscopes, parse_fraction, parse_rates
from imulab.procedures.rate.axes import (
    TableAxes,
    find_axes,
    prior_at,
    warn_force_length,
    warn_other_unit,
    with_accelerometers,
    with_prior,
)
from imulab.procedures.rate.dwells import Dwells, find_dwells, gyro_columns
from imulab.procedures.rate.record import make_record
from imulab.procedures.rate.schema import RateTest, Run, load_test, refuse_folder
from imulab.procedures.rate.simulate import RateRecordings
from imulab.procedures.rate.solve import (
    Linearity,
    RateProblem,
    RateSolution,
    choose_orders,
    g_sensitivity,
    measure_linearity,
    solve,
    subtract_lean,
)
from imulab.procedures.result import Record, Result, as_record, as_recording
from imulab.quantities import in_si
from imulab.recording import Data, Reading, Recording
from imulab.records.calibration import Calibration
from imulab.records.comparison import different_units

_OF_STEPS = 500  # samples of a dwell that show the steps of an output


@dataclass(frozen=True, repr=False)
class RateFit(Result):
    """Result of a rate test.

    Attributes
    ----------
    calibration
        The record: bias, scale factor, misalignment and nonlinearity of each gyroscope, in SI.
    dwells
        The dwells of each run.
    linearity
        Nonlinearity, asymmetry and hysteresis, by body axis.

    Examples
    --------
    >>> import imulab as il
    >>> fit = il.fit_rate(il.simulate_rate(hold="3 s"))
    >>> fit.calibration.parameters["gyro_bias_x"].unit
    'rad/s'
    """

    calibration: Calibration
    dwells: tuple[Dwells, ...]
    linearity: dict[str, Linearity]


def fit_rate(
    data: Data | RateRecordings,
    *,
    rates: Annotated[str | Sequence[float] | None, parsed(parse_rates, "R,R,...", unit="deg/s")] = None,
    axis: Annotated[str, choice(MOUNTINGS)] = "+z",
    order: Annotated[int | str, choice(ORDERS)] = "auto",
    latitude: Annotated[float | str | None, measure("angle", "deg")] = None,
    table_uncertainty: Annotated[float | str | None, parsed(parse_fraction, "FRACTION")] = None,
    accel: Record | None = None,
    prior: Record | None = None,
    **reading: Unpack[Reading],
) -> RateFit:
    """Calibrate gyroscopes from recordings on a rate table.

    ``M_i = S_i (A_i + b_i)``, ``A_i = s_i + k2_i s_i^2 + ...``, ``s = T w``: by generalised least squares of the means
    of the output M over dwells at the rates w of the table.

    Parameters
    ----------
    data
        A manifest (``TEST.toml``, docs/rate.md), what `simulate_rate` returns, or one recording: a file, a recording, a
        data frame or arrays with ``gyro_*``, and ``table_rate`` or ``table_angle`` where the table wrote it.
    rates
        Of the table, in any order; for one recording without a column table_rate. In rad/s, or deg/s in a text.
    axis
        Body axis along the table axis, about which positive rates turn; for one recording.
    order
        Highest power of the rate in the model. 1 to 5; ``"auto"``: of each gyroscope, as many as its dwells support.
    latitude
        Of the place, for the Earth's rate. In rad; without it that rate stays in the bias.
    table_uncertainty
        Standard uncertainty that all rates have in common, such as 20ppm. A fraction.
    accel
        Tumble record of the unit, whose accelerometers tell the table axis. Of `fit_tumble` of the same unit, or its
        file, whose ``accel_*`` are in each recording: they tell the table axis in the body, and the result is a record
        of both triads.
    prior
        Earlier record of the same gyroscopes, as prior knowledge. Or its file: both are one fit, and the record says
        whether they agree. A thermal record is one at the mean temperature of the recordings.
    reading
        How data are to be understood: `rate` or `time`, `unit`; `layout`, `topic`, `instance`, `window`, `element`.

    Raises
    ------
    SegmentError
        The dwells cannot be found, or do not go with the rates.
    ObservabilityError
        The rates cannot separate the parameters: one direction only, or too few of them.
    DataError
        The gyroscopes cannot be those of such a test.
    OptionError
        An option has an unknown value, or does not go with a manifest.

    Source: IEEE Std 528; GUM (JCGM 100:2008).

    Examples
    --------
    >>> import imulab as il
    >>> fit = il.fit_rate(il.simulate_rate(hold="3 s"))
    >>> sorted(fit.linearity)
    ['x', 'y', 'z']
    """
    highest = str(order)
    if highest not in ORDERS:
        raise OptionError(f"order {highest!r}: expected one of {listed(ORDERS, highest)}")
    place = None if latitude is None else checked_latitude(in_si(latitude, "latitude", "angle", "deg"))
    common = None if table_uncertainty is None else parse_fraction(table_uncertainty, "table_uncertainty")
    manifest = isinstance(data, str | os.PathLike) and os.fspath(data).lower().endswith(".toml")
    if isinstance(data, RateRecordings) or manifest:
        if rates is not None or axis != "+z":
            raise OptionError("rates: the manifest says the rates and axes of its runs; expected neither with it")
        if isinstance(data, RateRecordings):
            test, recordings = data.test, list(data.recordings)
        else:
            path = Path(os.fspath(data))  # type: ignore[arg-type]
            test = load_test(path)
            recordings = [as_recording(path.parent / run.file, reading, fit_rate, clock="gyro") for run in test.runs]
    else:
        if axis not in MOUNTINGS:
            raise OptionError(f"axis {axis!r}: expected one of {listed(MOUNTINGS, axis)}")
        if isinstance(data, str | os.PathLike):
            refuse_folder(Path(os.fspath(data)), os.fspath(data))
        recordings = [as_recording(data, reading, fit_rate, name_gyroscopes, clock="gyro")]
        steps = parse_rates(rates, "rates") if isinstance(rates, str) else None if rates is None else tuple(rates)
        test = RateTest((Run(recordings[0].name, axis, steps),), name=recordings[0].name)
    if place is not None:
        test = replace(test, latitude=place)
    if common is not None:
        test = replace(test, relative_uncertainty=common)
    held = [
        None if earlier is None else as_record(earlier, f"fit_rate: {name}")
        for name, earlier in (("accel", accel), ("prior", prior))
    ]
    return fit_test(test, recordings, highest, *held)


def fit_test(
    test: RateTest,
    recordings: Sequence[Recording],
    order: str,
    accel: Calibration | None = None,
    prior: Calibration | None = None,
) -> RateFit:
    """Calibrate the gyroscopes of a test from the recordings of its runs; what is raised is as for `fit_rate`."""
    names, unit = _check_recordings(test, recordings)
    dwells = [find_dwells(recording, test, index) for index, recording in enumerate(recordings)]
    problem, axes = _with_rounding(_join_dwells(test, dwells, names), recordings, dwells, names), None
    if accel is not None:
        axes = find_axes(test, recordings, dwells, accel)
        problem = _apply_table_axes(test, problem, axes)
    _check_rates(test, problem, 1 if order == "auto" else int(order))
    first = solve(problem, (1,) * len(names)) if order == "auto" and axes is not None else None
    orders = (int(order) if order != "auto" else 1,) * len(names)
    if order == "auto":
        orders = choose_orders(problem if first is None else _subtract_lean(problem, first))
    solution = solve(problem, orders)
    felt = None if axes is None else g_sensitivity(problem, solution)
    if axes is not None and felt is not None:  # w^2 times the lever arm acts by g-sensitivity, and is no k2
        pull = problem.table[:, None] ** 2 * axes.arm[problem.run]
        problem = replace(problem, mean=problem.mean - pull @ felt.T)
        solution = solve(problem, orders)
    measured = [i for i, axis in enumerate(problem.gyros) if axis in problem.faces]
    _check_signs(test, problem, solution, measured)
    linearity = {}
    for i in measured:
        scale = float(solution.coefficients[i][problem.faces.index(problem.gyros[i])])
        linearity[AXES[problem.gyros[i]]] = measure_linearity(
            _subtract_lean(problem, solution), i, scale, orders[i], float(solution.walk[i])
        )
    record = make_record(test, recordings, dwells, problem, solution, linearity, unit, order, axes)
    if prior is not None:
        record = with_prior(record, prior_at(prior, recordings), str(record.model["frame"]))
    if accel is not None and axes is not None:
        places = [test.place(k) for k in range(len(test.runs))]
        remarks = warn_force_length(accel, axes.force, axes.length_uncertainty, places)
        record = with_accelerometers(accel, record, [*warn_other_unit(accel, record.sensor, "accel"), *remarks])
    return RateFit(record, tuple(dwells), linearity)


def _subtract_lean(problem: RateProblem, solution: RateSolution) -> RateProblem:
    """Return the problem less what the lean of the table axis adds through misalignment."""
    gains = [row[: len(problem.faces)] for row in solution.coefficients]
    return replace(problem, mean=subtract_lean(problem, gains))


def _apply_table_axes(test: RateTest, problem: RateProblem, axes: TableAxes) -> RateProblem:
    """Return the problem with the table axes as the accelerometers see them."""
    if len(problem.faces) < 3 or len(problem.gyros) < 3:
        raise ObservabilityError(f"{test.name}: accel needs runs about x, y and z, and three gyroscopes")
    direction = axes.direction[problem.run]
    along = direction[np.arange(len(direction)), problem.axis]
    return replace(
        problem, rate=problem.rate * along * problem.sign, lean=direction / along[:, None], force=axes.force
    )  # fmt: skip


def _check_recordings(test: RateTest, recordings: Sequence[Recording]) -> tuple[list[str], str]:
    """Return the gyroscopes and the unit that all recordings of a test share."""
    first = gyro_columns(recordings[0])
    if not first:
        recordings[0].column("gyro_x")
    unit = recordings[0].units[first[0]]
    heads = ((run.file, recording.metadata) for run, recording in zip(test.runs, recordings, strict=True))
    if apart := different_units(*heads, keys=("serial", "element")):
        raise DataError(f"{apart}; expected recordings of one unit")
    run_of_digest: dict[str, int] = {}
    for index, recording in enumerate(recordings):
        digest = "" if recording.source is None else recording.source.sha256
        if digest in run_of_digest:
            raise DataError(
                f"{test.place(index)}: run {index + 1} is the same recording as run {run_of_digest[digest] + 1} "
                f"({test.runs[run_of_digest[digest]].file}), which would count twice"
            )
        run_of_digest |= {digest: index} if digest else {}
        if gyro_columns(recording) != first:
            raise DataError(
                f"{test.place(index)}: columns {' '.join(gyro_columns(recording)) or 'without gyroscopes'}, but "
                f"{' '.join(first)} in {test.runs[0].file}"
            )
        for name in first:
            if recording.units[name] != unit:
                raise UnitError(f"{test.place(index)}: column {name} is in {recording.units[name]}, expected {unit}")
    return first, unit


def _join_dwells(test: RateTest, dwells: Sequence[Dwells], names: list[str]) -> RateProblem:
    """Return the dwells of all runs as one problem; the Earth's rate is added where the latitude is known."""
    counts = [len(run_dwells.rate) for run_dwells in dwells]
    each: dict[str, Any] = {
        key: np.repeat([getattr(run, key) for run in test.runs], counts) for key in ("axis", "sign")
    }
    earth = 0.0 if test.latitude is None else EARTH * np.sin(test.latitude)
    table = np.concatenate([run_dwells.rate for run_dwells in dwells])
    return RateProblem(
        gyros=tuple(AXES.index(name[-1]) for name in names),
        run=np.repeat(np.arange(len(dwells)), counts),
        axis=each["axis"],
        sign=each["sign"],
        rate=each["sign"] * (table + earth),
        table=table,
        mean=np.vstack([run_dwells.mean for run_dwells in dwells]),
        variance=np.vstack([_pool_variance(run_dwells) for run_dwells in dwells]),
        level=np.vstack([run_dwells.level for run_dwells in dwells]),
        rate_uncertainty=test.rate_spread(table),
        scale_error=np.repeat(
            [0.0 if run_dwells.sweep is None else run_dwells.sweep.scale_error for run_dwells in dwells], counts
        ),
        zero_error=np.repeat(
            [
                np.zeros(len(names)) if run_dwells.sweep is None else run_dwells.sweep.zero_error
                for run_dwells in dwells
            ],
            counts,
            axis=0,
        ),
        loop_error=np.repeat([_loop_error(run_dwells) for run_dwells in dwells], counts),
        reach=np.repeat(
            [0.0 if run_dwells.sweep is None else run_dwells.sweep.largest for run_dwells in dwells], counts
        ),
        branch=np.concatenate([_rising_or_falling(run_dwells) for run_dwells in dwells]),
        time=np.concatenate([(run_dwells.start + run_dwells.stop) / 2 for run_dwells in dwells]),
    )


def _with_rounding(
    problem: RateProblem, recordings: Sequence[Recording], dwells: Sequence[Dwells], names: list[str]
) -> RateProblem:
    """Return the problem with the uncertainty of means by steps that are coarser than the noise of a dwell.

    Up to half a step, as uniform; noise of half a step and more leaves less than a hundredth of it. Visits of one rate
    are rounded alike, but for a hundredth.
    """
    largest = np.zeros(len(names))
    for recording, run_dwells in zip(recordings, dwells, strict=True):
        if run_dwells.sweep is not None:
            continue
        edges = np.searchsorted(recording.si("time"), np.column_stack([run_dwells.start, run_dwells.stop]))
        for i, name in enumerate(names):
            parts = [recording.column(name)[a:b] for a, b in edges.tolist()]
            step = min(resolution(part[:_OF_STEPS]) or np.inf for part in parts)
            if np.median([part.std() for part in parts]) < step / 2 < np.inf:
                largest[i] = max(largest[i], step / np.sqrt(12))
    return replace(problem, rounding=largest, variance=problem.variance + (0.01 * largest) ** 2)


def _rising_or_falling(dwells: Dwells) -> NDArray[np.int64]:
    """Return 1 for each mean of a sweep at a rising rate, -1 at a falling one, 0 for steps."""
    if dwells.sweep is None:
        return np.zeros(len(dwells.rate), dtype=np.int64)
    return np.where(np.arange(len(dwells.rate)) < dwells.sweep.rising, 1, -1)


def _loop_error(dwells: Dwells) -> float:
    """Return `Sweep.loop_error`: 0 for steps, infinite for sweeps that do not distinguish loop and delay."""
    if dwells.sweep is None:
        return 0.0
    return float(np.inf) if dwells.sweep.loop_error is None else dwells.sweep.loop_error


def _pool_variance(dwells: Dwells) -> Any:
    """Return the variances of the means, pooled over the dwells of a run in proportion to one over their length."""
    length = (dwells.stop - dwells.start)[:, None]
    return np.mean(dwells.variance * length, axis=0) / length


def _check_rates(test: RateTest, problem: RateProblem, order: int) -> None:
    """Refuse rates that do not separate bias, scale factor, asymmetry and powers of the rate."""
    for face in problem.faces:
        if face not in problem.gyros:
            continue
        rates = problem.rate[problem.axis == face]
        near = 1e-3 * float(np.abs(rates).max())
        if not ((rates > near).any() and (rates < -near).any()):
            raise ObservabilityError(
                f"{test.name}: body axis {AXES[face]} was turned one way round only: bias and asymmetry cannot be told "
                "from the scale factor; add rates of the other sign"
            )
        different = len(np.unique(np.round(rates / (10 * near))))
        if different < order + 2:
            raise ObservabilityError(
                f"{test.name}: {different} different rates about body axis {AXES[face]}, expected {order + 2} or more "
                f"for order {order}"
            )


def _check_signs(test: RateTest, problem: RateProblem, solution: RateSolution, measured: list[int]) -> None:
    """Refuse a gyroscope whose output falls where the table's rate rises."""
    for i in measured:
        axis = problem.gyros[i]
        if solution.coefficients[i][problem.faces.index(axis)] < 0:
            run = int(problem.run[np.argmax(problem.axis == axis)])
            raise DataError(
                f"{test.place(run)}: gyro_{AXES[axis]} falls where the table's rate rises: is the sign of "
                "mounting wrong?"
            )

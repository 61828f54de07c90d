"""The fit of recordings at several temperatures, from files to the record.

The mathematics is in `solve` (least squares), `degrees` (choice of the laws), and `gyro` and `turns` (gyroscopes).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Unpack

import numpy as np

from imulab.display import UNJUDGED
from imulab.errors import OptionError, RecordError
from imulab.estimation.least_squares import Observability
from imulab.gravity import (
    EarthRate,
    Height,
    Latitude,
    LocalGravity,
    StatedSite,
    at_latitude,
    at_place,
    local_gravity,
    of_place,
)
from imulab.options import FURTHER_TRIADS, measure, parsed, text
from imulab.procedures.result import OWN_CLOCKS, Record, Result, as_record, as_recording
from imulab.procedures.thermal import check_degrees, parse_further, parse_laws
from imulab.procedures.thermal.degrees import (
    Degrees,
    DegreesStep,
    LeftOutCluster,
    choose_laws,
    drift_rates,
    fit_lag_and_loops,
)
from imulab.procedures.thermal.gyro import check_gyroscopes, fit_gyroscopes, rates_at_rest
from imulab.procedures.thermal.hidden import cover_hidden
from imulab.procedures.thermal.holds import (
    Holds,
    check_holds,
    find_holds,
    prepare_gyroscopes,
    prepare_recordings,
    read_sides,
)
from imulab.procedures.thermal.model import GROUPS, Laws, forces
from imulab.procedures.thermal.ramp import are_rest_ramps, fit_ramps
from imulab.procedures.thermal.record import make_record, with_gyroscopes
from imulab.procedures.thermal.solve import ThermalProblem, ThermalSolution
from imulab.procedures.thermal.turns import nominal_output, scale_from_turns
from imulab.quantities import in_si
from imulab.readers.streams import one_clock, own_clock
from imulab.recording import Array, Data, Reading, Recording
from imulab.records.calibration import Calibration
from imulab.units import conversion_factor, parse_unit

_SENSORS = [f"{kind}_{axis}" for kind, axes in GROUPS for axis in axes]


@dataclass(frozen=True, repr=False)
class ThermalFit(Result):
    """Result of a calibration over temperature.

    Attributes
    ----------
    calibration
        The record: coefficients of each parameter in powers of T - T0, in SI, with their covariance.
    observability
        Rank and condition number of the joint rows.
    degrees
        The degrees that were compared, where they were chosen from the data.
    left_out
        The error at each interior temperature under the fit to all others, g.

    Examples
    --------
    >>> import imulab as il
    >>> fit = il.fit_thermal(il.simulate_thermal(attitudes=12), degrees="2,1,1")
    >>> fit.calibration.parameters["bias_x_t1"].unit
    'm/s^2/K'
    """

    calibration: Calibration
    observability: Observability
    degrees: tuple[DegreesStep, ...]
    left_out: tuple[LeftOutCluster, ...]


def fit_thermal(
    data: Data | Sequence[Data],
    *,
    degrees: Annotated[str | Degrees, parsed(check_degrees, "auto|B,S,M", ("auto",))] = "auto",
    gravity: LocalGravity = None,
    latitude: Latitude = None,
    height: Height = None,
    place: StatedSite = None,
    prior: Record | None = None,
    with_: Annotated[str | Sequence[str], parsed(parse_further, "gyro", ("gyro",)), FURTHER_TRIADS] = (),
    tilt: Annotated[float | str, measure("angle", "mrad")] = "0.2 mrad",
    turn_on_scatter: Annotated[float | str | None, measure("acceleration", "mg", "SIZE")] = None,
    gyro_turn_on_scatter: Annotated[float | str | None, measure("rate", "deg/s", "SIZE"), FURTHER_TRIADS] = None,
    settle: Annotated[float | str | None, measure("time", "s")] = None,
    temperature_column: Annotated[str | None, text("NAME")] = None,
    **reading: Unpack[Reading],
) -> ThermalFit:
    """Calibrate an accelerometer triad over temperature from recordings of one unit, each a power cycle.

    Minimises ``sum_p w_p (|f(M_p, T_p)| - g)^2`` over the holds of all recordings, each parameter a polynomial of the
    temperature; holds in which the temperature drifts and nothing is moved add that they share one direction.
    Recordings of gyroscopes at rest, without accelerometers or too few for these, give the gyroscopes' biases alone.

    Parameters
    ----------
    data
        One recording or several: files, recordings or data frames with columns ``accel_*`` and ``temperature``.
    degrees
        Of the laws of bias, scale factor and misalignment, 3,2,1, or spline,2,1; auto: from there down, or a spline.
        ``"spline,2,1"``: biases are natural cubic splines with a knot at each temperature; ``"auto"``: from 3,2,1 down,
        as data allow, or the spline where it predicts as well.
    gravity, latitude, height, place
        As for `fit_tumble`.
    prior
        Tumble record of this unit at a known temperature: counts as one recording. A record of order 1, or its file.
    with_
        Further triads of the recordings, in one record. ``"gyro"``: the gyroscopes of the same recordings; their
        biases, at rest, over temperature.
    tilt
        How far a hold tips while it warms or cools. Standard deviation of the direction of a hold in which the
        temperature drifts, rad.
    turn_on_scatter
        What biases move by from one power cycle to the next, if known. Standard deviation of each, m/s^2; from the
        recordings if not given.
    gyro_turn_on_scatter
        The same of the gyroscopes' biases, if known. Standard deviation, rad/s.
    settle
        Left out at the start of a recording; 300 s where time is from power-on. In s; that is where the head has
        ``power_on_temperature``.
    temperature_column
        Column of the unit's own thermometer, where there are several.
    reading
        How files are to be understood: `layout`, `topic`, `instance`, `window`, `element`.

    Raises
    ------
    ObservabilityError
        The holds cannot separate the coefficients; the message names them.
    DataError
        The recordings cannot be those of one unit over temperature.
    OptionError
        An option has an unknown value.

    Examples
    --------
    >>> import imulab as il
    >>> fit = il.fit_thermal(il.simulate_thermal(attitudes=12))
    >>> fit.calibration.model["degrees"]["bias"]
    3
    """
    further = parse_further(with_, "with_")
    wanted, spline = parse_laws(",".join(map(str, degrees)) if isinstance(degrees, tuple) else degrees, "degrees")
    settling = None if settle is None else in_si(settle, "settle", "time", "s")
    latitude, height = of_place(place, gravity, latitude, height)
    as_read = [as_recording(item, reading, fit_thermal, clock=OWN_CLOCKS) for item in _as_list(data)]
    if prior is None and are_rest_ramps(as_read):
        return _fit_ramps(as_read, wanted, spline, gyro_turn_on_scatter, settling, temperature_column, latitude)
    recordings = prepare_recordings([one_clock(each, "accel") for each in as_read], temperature_column, settling)
    gyroscopes = _gyroscopes(as_read, recordings, temperature_column, settling) if further else recordings
    earth = at_latitude(latitude) if further else None
    local = local_gravity(at_place(gravity, latitude, height, beside=bool(earth or place)), recordings[0])
    holds = replace(find_holds(recordings), gyroscopes=tuple(gyroscopes))
    nominal = conversion_factor(holds.unit, "m/s^2") if parse_unit(holds.unit).quantity == "acceleration" else None
    doubts = check_holds(holds, local.value, nominal)
    scale, zero = _nominal_scale(holds, local.value, nominal)
    leaning = _read_tilt(tilt)
    scatter = _read_scatter(turn_on_scatter, "turn_on_scatter", "acceleration", "mg", local.value)
    rates = _read_gyro_scatter(gyro_turn_on_scatter, further)
    known = None if prior is None else _read_prior(as_record(prior, "fit_thermal: prior"), holds, local.value, scale)
    problem = _make_problem(holds, scale, zero, leaning, known)
    laws = Laws(float(holds.temperature.min()), float(holds.temperature.max()), (0, 0, 0))
    name = recordings[0].name + (f" and {len(recordings) - 1} more" if len(recordings) > 1 else "")
    choice = choose_laws(problem, laws, wanted, scatter, name, spline=spline)
    drift = fit_lag_and_loops(problem, choice.solution, scatter)
    if drift.free:
        problem = replace(problem, free=drift.free)
        choice = choose_laws(problem, laws, wanted, scatter, name, spline=spline)
    covered, hidden = cover_hidden(problem, choice.solution, drift, name)
    options = {
        "degrees": wanted if isinstance(wanted, str) else ["spline", *wanted[1:]] if spline else list(wanted),
        "gravity": local.option, "tilt": leaning, "with": list(further) or None,
        "latitude": None if earth is None else earth.latitude,
        "turn_on_scatter": None if scatter is None else scatter * local.value,
        "gyro_turn_on_scatter": rates, "temperature_column": temperature_column, "settle": settling,
    }  # fmt: skip
    choice = replace(choice, solution=covered)
    record = make_record(holds, problem, choice, drift, local, scale, _drop_unstated(options), name)
    record = replace(record, warnings=(*doubts, *record.warnings, *hidden), verdict=UNJUDGED)
    if further:
        record = _with_gyroscopes(record, holds, problem, choice.solution, scale, wanted, spline, rates, name, earth)
    return ThermalFit(record, choice.view, tuple(choice.steps), tuple(choice.left_out))


def _fit_ramps(
    as_read: Sequence[Recording],
    wanted: str | Degrees,
    spline: bool,
    turn_on_scatter: float | str | None,
    settling: float | None,
    temperature_column: str | None,
    latitude: Latitude,
) -> ThermalFit:
    """Return the fit of recordings at rest, which tell the gyroscopes' biases alone."""
    recordings = [own_clock(each, "gyro") for each in as_read]
    recordings = prepare_recordings(recordings, temperature_column, settling, sensor="gyro")
    earth, tau = at_latitude(latitude), _read_gyro_scatter(turn_on_scatter, ("gyro",))
    options = {
        "degrees": wanted if isinstance(wanted, str) else ["spline" if spline else wanted[0]],
        "latitude": None if earth is None else earth.latitude,
        "gyro_turn_on_scatter": tau,
        "temperature_column": temperature_column,
        "settle": settling,
    }
    record, view = fit_ramps(recordings, wanted, spline, tau, _drop_unstated(options), earth)
    return ThermalFit(record, view, (), ())


def _gyroscopes(
    as_read: Sequence[Recording], recordings: list[Recording], temperature_column: str | None, settling: float | None
) -> list[Recording]:
    """Return the recordings on the gyroscopes' clock, which may be that of the accelerometers."""
    check_gyroscopes(recordings)
    if all(each.on_one_clock for each in as_read):
        return recordings
    return prepare_gyroscopes([own_clock(each, "gyro") for each in as_read], temperature_column, settling)


def _as_list(data: Data | Sequence[Data]) -> list[Any]:
    """Return the recordings as a list."""
    single = not isinstance(data, Sequence) or isinstance(data, str | os.PathLike)
    items: list[Any] = [data] if single else list(data)  # type: ignore[arg-type]
    if not items:
        raise OptionError("fit_thermal: data: expected one recording or more, found none")
    return items


def _with_gyroscopes(
    record: Calibration,
    holds: Holds,
    problem: ThermalProblem,
    solution: ThermalSolution,
    scale: Array,
    wanted: str | Degrees,
    spline: bool,
    tau: float | None,
    name: str,
    earth: EarthRate | None,
) -> Calibration:
    """Return the record of the accelerometers with the gyroscopes: biases at rest, then scale factors from turns."""
    laws = solution.laws
    force, _ = forces(laws.design(problem.temperature) @ solution.coefficients[: laws.size], problem.reading)
    nominal = nominal_output(holds, record, holds.recordings[0].triad_unit("gyro"))
    rest = replace(rates_at_rest(holds, force, nominal), earth=earth)
    gyros = fit_gyroscopes(rest, laws.low, laws.high, wanted, tau, name, spline=spline)
    turned = scale_from_turns(holds, problem, solution, record, gyros, scale)
    return with_gyroscopes(record, holds, gyros, turned, name)


def _read_tilt(tilt: float | str) -> float:
    """Return the standard deviation of a hold's tilt, rad."""
    angle = in_si(tilt, "tilt", "angle", "mrad")
    if not 0 < angle < np.inf:
        raise OptionError(f"tilt {angle:g}: expected a size above 0")
    return angle


def _read_scatter(stated: float | str | None, name: str, quantity: str, unit: str, size: float = 1.0) -> float | None:
    """Return a stated scatter between power cycles in SI over `size`, None where it is not stated."""
    if stated is None:
        return None
    value = in_si(stated, name, quantity, unit)
    if not 0 <= value < np.inf:
        raise OptionError(f"{name} {value:g}: expected a size of 0 or above")
    return value / size


def _read_gyro_scatter(stated: float | str | None, further: Sequence[str]) -> float | None:
    """Return the stated scatter of the gyroscopes' biases between power cycles, rad/s."""
    if stated is not None and not further:
        raise OptionError("gyro_turn_on_scatter: no gyroscopes are fitted; expected --with gyro beside it")
    return _read_scatter(stated, "gyro_turn_on_scatter", "rate", "deg/s")


def _drop_unstated(options: dict[str, Any]) -> dict[str, Any]:
    """Return the options that have a value."""
    return {key: value for key, value in options.items() if value is not None}


def _nominal_scale(holds: Holds, gravity: float, nominal: float | None) -> tuple[Array, Array]:
    """Return the nominal scale factor, output per g, and the biases to start from, in g."""
    if nominal is not None:
        return np.full(3, gravity / nominal), np.zeros(3)
    high, low = holds.mean.max(axis=0), holds.mean.min(axis=0)
    scale = np.maximum((high - low) / 2, (high - low).max() / 20)
    return scale, (high + low) / 2 / scale


def _make_problem(
    holds: Holds, scale: Array, zero: Array, tilt: float, known: tuple[float, Array, Array] | None
) -> ThermalProblem:
    """Return the holds in units of g."""
    return ThermalProblem(
        holds.mean / scale,
        holds.covariance / (scale[:, None] * scale),
        holds.temperature,
        drift_rates(holds),
        holds.step,
        holds.shared,
        holds.recording,
        holds.group,
        tilt,
        zero,
        known,
        side=read_sides(holds),
        wander=holds.wander,
    )


def _read_prior(record: Calibration, holds: Holds, gravity: float, scale: Array) -> tuple[float, Array, Array]:
    """Return the parameters of a tumble record at its temperature, with their covariance, in units of g."""
    if record.procedure != "tumble" or not record.covariance.names or record.model.get("order") != 1:
        raise RecordError("prior: expected a tumble record of order 1 that states uncertainties (tumble fit --order 1)")
    if "temperature" not in record.model:
        raise RecordError("prior: the record does not say at which temperature it was made")
    if record.model["output_unit"] != holds.unit:
        raise RecordError(
            f"prior: made for outputs in {record.model['output_unit']}, the recordings are in {holds.unit}"
        )
    factor = np.concatenate([np.full(3, 1 / gravity), gravity / scale, np.ones(3)])
    values = np.array([record.value(name) for name in _SENSORS]) * factor
    covariance = record.cov(*_SENSORS) * np.outer(factor, factor)
    return float(record.model["temperature"]["value"]), values, covariance

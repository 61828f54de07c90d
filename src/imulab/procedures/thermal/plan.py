"""How many soaks at which temperatures, and which attitudes in each: what a time in the chamber gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from imulab.errors import ObservabilityError, OptionError
from imulab.procedures.thermal.choices import APART, DEGREES, LEAST_SPAN, degrees_of, further_of
from imulab.procedures.thermal.design import Design, exchange, nodes, way
from imulab.procedures.thermal.gyroplan import noise_and_scatter, plan_gyroscopes
from imulab.procedures.thermal.model import Laws
from imulab.procedures.thermal.planned import PlannedSoak, ThermalPlan, Tried
from imulab.procedures.tumble.plan import shortest_path, sphere_candidates
from imulab.procedures.tumble.planning import Known, candidates_of, noise_of
from imulab.quantities import in_si, temperature_list
from imulab.reading import Data
from imulab.recording import Array
from imulab.units import STANDARD_GRAVITY

_FEWEST, _MOST, _SOAKS = 3, 40, 24
"""Attitudes of a soak; soaks."""
_SCANNED = 12
"""Attitudes of a soak by which numbers of soaks are compared: more of them change sizes, not the order."""
_STARTS, _AS_GOOD = 4, 1.02
_ROOM = 23.0  # degC, from which the chamber starts


def plan_thermal(
    temperatures: Sequence[float] | str = "-20,60",
    *,
    time: float | str = "8 h",
    soak: float | str = "45 min",
    attitude: float | str = "1 min",
    noise: float | Known = "60 ug",
    turn_on_scatter: float | str = "0.1 mg",
    degrees: str | tuple[int, int, int] = DEGREES,
    from_: Data = "sphere",
    with_: str | Sequence[str] = (),
    gyro_noise: float | str | None = None,
    gyro_turn_on_scatter: float | str | None = None,
) -> ThermalPlan:
    """Choose soaks and attitudes for a calibration over temperature, and predict the corrected force over the range.

    Numbers of soaks that the time allows are compared by the mean variance of the corrected force over temperature and
    direction, with the offsets of each power cycle in it: ``tr(W (sum_k B_k' R_k' R_k B_k)^-1)``, R_k the gradients of
    ``|f|`` in soak k and B_k the basis at its temperature. Temperatures are the ends of the range and the extrema of
    the Legendre polynomial; what is left of the soaks comes back to inner ones from the other side.

    Parameters
    ----------
    temperatures
        Lowest and highest temperature, degC.
    time
        In the chamber, s, all told.
    soak, attitude
        Until the unit has the next temperature, and for one attitude, the turn to it included, s.
    noise
        Of ``|f|`` in one attitude, m/s^2, or what has it, as for `plan_tumble`.
    turn_on_scatter
        Standard deviation of each bias from one power cycle to the next, m/s^2.
    degrees
        Of the laws of bias, scale factor and misalignment that the plan is for.
    from_
        Where attitudes may lie, as for `plan_tumble`.
    with_
        ``"gyro"``: predict what the same soaks give of the gyroscopes, too.
    gyro_noise
        Angle random walk of the gyroscopes, rad/sqrt(s), over all of an attitude's time; 0.3 deg/sqrt(h) if not given.
    gyro_turn_on_scatter
        Standard deviation of each of their biases from one power cycle to the next, rad/s; 0.01 deg/s if not given.

    Raises
    ------
    OptionError
        A value is out of range, the time too short, or one is of gyroscopes that nobody asked for.
    ObservabilityError
        No choice among the attitudes determines the laws.

    Source: Fedorov, Theory of Optimal Experiments (1972); Atkinson, Donev and Tobias (2007).

    Examples
    --------
    >>> import imulab as il
    >>> plan = il.plan_thermal("-20,60", time="8 h", noise="60 ug")
    >>> len(plan.soaks), [round(soak.temperature) for soak in plan.soaks][:5]
    (8, [-20, -6, 20, 46, 60])
    """
    laws, count = _laws(temperatures, degrees)
    sizes = {
        name: _above(in_si(value, name, "time", "min"), name)
        for name, value in (("time", time), ("soak", soak), ("attitude", attitude))
    }
    sigma, source = noise_of(noise)
    tau = in_si(turn_on_scatter, "turn_on_scatter", "acceleration", "mg") / STANDARD_GRAVITY
    if not 0 <= tau < 1:
        raise OptionError(f"turn_on_scatter {turn_on_scatter!r}: expected 0 or more, less than 1 g")
    further = noise_and_scatter(gyro_noise, gyro_turn_on_scatter, asked=bool(further_of(with_, "with_")))
    given = candidates_of(from_)
    points = sphere_candidates() if given is None else given
    options = _allowed(count, **sizes)
    found = [(each, _scan(laws, count, each, tau / sigma, points)) for each in options]
    if not np.isfinite([cost for _, (cost, _) in found]).any():
        where = from_ if isinstance(from_, str) else "from_"
        raise ObservabilityError(
            f"{where}: {len(points)} candidate attitudes, {options[-1][1]} in each soak, cannot separate the "
            f"coefficients of degrees {','.join(map(str, laws.degrees))}; expected more time, lower degrees or other "
            "candidates"
        )
    (soaks, _), _ = min(found, key=lambda each: each[1][0])
    design = _design(laws, count, soaks, tau / sigma)
    covariance, sets = _best(design, points, _counts(design, **sizes))
    deviation = sigma * STANDARD_GRAVITY * design.deviations(covariance)
    unit = sigma * STANDARD_GRAVITY
    soaks_of = tuple(_scheduled(design, sets, sizes["soak"], sizes["attitude"]))
    gyro = None
    if further is not None:
        placed = [(each.temperature, each.directions) for each in soaks_of]
        gyro = plan_gyroscopes(laws, design.places, placed, (sizes["soak"], sizes["attitude"]), *further)
    return ThermalPlan(
        soaks=soaks_of,
        degrees=laws.degrees,
        temperature=design.places,
        deviation=deviation,
        mean=unit * float(np.sqrt(design.cost(covariance))),
        noise=unit,
        noise_from=source,
        turn_on_scatter=tau * STANDARD_GRAVITY,
        time=sizes["time"],
        tried=tuple(
            Tried(k, n, unit * float(np.sqrt(cost)), unit * worst) for (k, n), (cost, worst) in found if cost < np.inf
        ),
        gyro=gyro,
    )


def _laws(temperatures: Sequence[float] | str, degrees: Any) -> tuple[Laws, int]:
    """Return the laws that a plan is for, and at how many temperatures."""
    ends = temperature_list(temperatures, "temperatures")
    if len(ends) != 2 or not -100 <= ends[0] < ends[1] <= 150 or ends[1] - ends[0] < LEAST_SPAN:
        raise OptionError(
            f"temperatures {temperatures!r}: expected the lowest and the highest temperature, -100 to 150 degC, "
            f"{LEAST_SPAN:g} K or more apart, such as -20,60"
        )
    wanted = degrees_of(degrees if isinstance(degrees, str) else ",".join(map(str, degrees)), "degrees")
    if isinstance(wanted, str):
        raise OptionError("degrees 'auto': a plan needs degrees, such as 3,2,1, the highest that auto tries")
    count = max(wanted) + 2
    laws = Laws(ends[0], ends[1], wanted)
    if np.diff(nodes(count)).min() * laws.half <= APART:
        raise OptionError(
            f"temperatures {temperatures!r}: {count} temperatures, which degree {max(wanted)} takes, would lie within "
            f"{APART:g} K of each other: expected a wider range, or lower degrees"
        )
    return laws, count


def _above(value: float, name: str) -> float:
    if not 0 < value < 1e8:
        raise OptionError(f"{name} {value:g} s: expected more than 0 s")
    return value


def _allowed(count: int, time: float, soak: float, attitude: float) -> list[tuple[int, int]]:
    """Return the numbers of soaks that the time allows, each with its attitudes in the mean."""
    most = min(int((time + 1e-6) // (soak + _FEWEST * attitude)), _SOAKS)
    if most < count:
        least = count * (soak + _FEWEST * attitude)
        raise OptionError(
            f"time {time / 60:.6g} min: allows {most} soaks of {soak / 60:.6g} min and {_FEWEST} attitudes of "
            f"{attitude / 60:.6g} min; expected {least / 60:.6g} min or more for {count} temperatures, or lower degrees"
        )
    return [(k, min(int((time + 1e-6 - k * soak) // (k * attitude)), _MOST)) for k in range(count, most + 1)]


def _design(laws: Laws, count: int, soaks: int, tau: float) -> Design:
    return Design(laws, (laws.middle + laws.half * nodes(count))[way(count, soaks)], tau)


def _scan(laws: Laws, count: int, option: tuple[int, int], tau: float, points: Array) -> tuple[float, float]:
    """Return mean variance and worst deviation that a number of soaks gives, by fewer and better attitudes if many."""
    soaks, attitudes = option
    used = min(attitudes, _SCANNED, len(points))
    design = replace(_design(laws, count, soaks, tau), variance=used / attitudes)
    _, covariance = exchange(design, points, [used] * soaks, 1)
    return design.cost(covariance), float(design.deviations(covariance).max())


def _counts(design: Design, time: float, soak: float, attitude: float) -> list[int]:
    """Return the attitudes of each soak: as many as there is time for, what is left over at the ends first."""
    soaks = len(design.temperatures)
    whole = min(int((time + 1e-6 - soaks * soak) // attitude), soaks * _MOST)
    far = np.argsort(-np.abs(design.laws.place(design.temperatures)), kind="stable")
    found = np.full(soaks, whole // soaks)
    found[far[: whole % soaks]] += 1
    return [int(n) for n in found]


def _best(design: Design, points: Array, counts: Sequence[int]) -> tuple[Array, list[Array]]:
    """Return covariance and attitudes of several starts: the least at its worst of those as good in the mean."""
    counts = [min(count, len(points)) for count in counts]
    found = [exchange(design, points, counts, seed) for seed in range(1, _STARTS + 1)]
    least = min(design.cost(covariance) for _, covariance in found)
    good = [each for each in found if design.cost(each[1]) <= _AS_GOOD * least]
    sets, covariance = min(good, key=lambda each: float(design.deviations(each[1]).max()))
    return covariance, sets


def _scheduled(design: Design, sets: Sequence[Array], soak: float, attitude: float) -> list[PlannedSoak]:
    """Return the soaks in their order, with the side that each temperature is reached from."""
    found, start, before = list[PlannedSoak](), 0.0, _ROOM
    for temperature, directions in zip(design.temperatures.tolist(), sets, strict=True):
        duration = soak + len(directions) * attitude
        found.append(PlannedSoak(temperature, temperature > before, shortest_path(directions), start, duration))
        start, before = start + duration, temperature
    return found

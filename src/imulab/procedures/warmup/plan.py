"""The chamber programme of a warm-up test, how long it takes, and what it will give."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from imulab.errors import OptionError
from imulab.procedures.warmup.model import SOURCE_TEMPERATURES
from imulab.recording import Recording

WIDEST = 20.0
"""Intervals of power-on temperature wider than this are warned about, K."""
_FREE = 4


@dataclass(frozen=True)
class Step:
    """One step of the programme: its start and duration, s, the set point, degC, and which cycle it belongs to."""

    start: float
    duration: float
    set_point: float
    action: str
    cycle: int


@dataclass(frozen=True)
class WarmupPlan:
    """A chamber programme.

    Attributes
    ----------
    steps
        In order.
    duration
        Of the whole, s.
    temperatures
        Set points, degC, ascending.
    cycles
        Power cycles at each.
    warnings
        What is wrong with the temperatures, and what would be better.
    proposal
        Temperatures with the wide intervals divided; the same where none is wide.
    """

    steps: tuple[Step, ...]
    duration: float
    temperatures: tuple[float, ...]
    cycles: int
    warnings: tuple[str, ...]
    proposal: tuple[float, ...]

    def curve_uncertainty(self, random_walk: float, record: float, settling_time: float) -> float:
        """Return what white noise alone adds to a curve at its temperature, `random_walk` per root second.

        ``N sqrt(p / T_M + 1 / (t_end - T_M)) / sqrt(n)`` for p = 4 coefficients, n cycles and the settled reference.
        """
        rest = max(record - settling_time, record / 2)
        return float(random_walk * np.sqrt(_FREE / settling_time + 1 / rest) / np.sqrt(self.cycles))


def plan_warmup(
    *,
    temperatures: Sequence[float] = SOURCE_TEMPERATURES,
    cycles: int = 5,
    soak: float = 3600.0,
    record: float = 600.0,
    ramp: float = 2.0 / 60,
    start: float = 23.0,
) -> WarmupPlan:
    """Write the chamber programme of a warm-up test.

    At each set point, from cold to warm: soak with the unit off, power on and record, power off; and soak again before
    the next cycle, so that each one starts cold.

    Parameters
    ----------
    temperatures
        Set points, degC, ascending.
    cycles
        Power cycles at each.
    soak
        With the unit off, until its inside has the chamber's temperature, s.
    record
        From power-on, s.
    ramp
        Of the chamber, K/s.
    start
        Chamber temperature at the beginning, degC.

    Raises
    ------
    OptionError
        A value is out of range.
    """
    at = tuple(map(float, temperatures))
    if len(at) < 2 or not (np.diff(at) > 0).all():
        raise OptionError(f"temperatures {' '.join(f'{t:g}' for t in at)}: expected two or more, ascending, in degC")
    for name, value, low, high in (
        ("cycles", cycles, 1, 1000),
        ("soak", soak, 0, 1e6),
        ("record", record, 60, 1e6),
        ("ramp", ramp, 1e-4, 10),
    ):
        if not low <= value <= high:
            raise OptionError(f"{name} {value:g}: expected {low:g} to {high:g}")
    steps: list[Step] = []
    clock, here = 0.0, start

    def add(duration: float, set_point: float, action: str, cycle: int) -> None:
        nonlocal clock
        if duration > 0:
            steps.append(Step(clock, duration, set_point, action, cycle))
            clock += duration

    for set_point in at:
        add(abs(set_point - here) / ramp, set_point, "ramp, unit off", 0)
        for cycle in range(1, cycles + 1):
            add(soak, set_point, "soak, unit off", cycle)
            add(record, set_point, "power on and record", cycle)
        here = set_point
    add(abs(start - here) / ramp, start, "ramp back, unit off", 0)
    wide = [(low, high) for low, high in pairwise(at) if high - low > WIDEST]
    proposal = sorted(
        {*at, *(round(float(t), 6) for low, high in wide for t in np.linspace(low, high, _pieces(low, high) + 1))}
    )
    warnings = tuple(
        f"the interval {low:g} to {high:g} degC is {high - low:g} K wide: interval-cubic uses the mean of both ends "
        "for all of it, wrong by half of their difference just inside each end, and no model sees a bend between them; "
        f"measure also at {' '.join(f'{t:g}' for t in proposal if low < t < high)} degC"
        for low, high in wide
    )
    if cycles < 2:
        warnings += ("one cycle at each temperature does not show how well cycles repeat: expected two or more",)
    if record < 330:
        warnings += (
            f"recordings of {record:g} s: warm-up takes about 300 s, and 30 s more make the settled reference: "
            "record longer",
        )
    return WarmupPlan(tuple(steps), clock, at, cycles, warnings, tuple(proposal))


def _pieces(low: float, high: float) -> int:
    return int(np.ceil((high - low) / WIDEST - 1e-9))


def programme(plan: WarmupPlan) -> Recording:
    """Return the programme as a table: step, start [min], duration [min], set_point [degC], record (1 or 0), cycle."""
    steps = plan.steps
    return Recording(
        columns={
            "step": np.arange(1.0, len(steps) + 1),
            "start": np.array([step.start / 60 for step in steps]),
            "duration": np.array([step.duration / 60 for step in steps]),
            "set_point": np.array([step.set_point for step in steps]),
            "power": np.array([float("power on" in step.action) for step in steps]),
            "cycle": np.array([float(step.cycle) for step in steps]),
        },
        units={"start": "min", "duration": "min", "set_point": "degC"},
        metadata={
            "programme": "ramp and soak with power 0; with power 1 switch the unit on and record from that instant"
        },
        name="warm-up plan",
    )

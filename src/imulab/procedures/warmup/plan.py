"""The plan of a warm-up test: the chamber programme, its duration, and the uncertainty that it will reach."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from imulab.errors import OptionError
from imulab.options import measure, parsed, text
from imulab.procedures.result import PlannedTest, amount
from imulab.procedures.warmup import TEMPERATURES
from imulab.quantities import RANDOM_WALK, fraction, in_si, of_units, temperature_list, whole
from imulab.recording import Recording
from imulab.report.plots import Plot
from imulab.report.traces import GOOD, LEGEND, QUIET, Figure
from imulab.units import from_si
from imulab.writers import write_csv

WIDEST = 20.0
"""Widest interval of power-on temperature without a warning, K."""
_FREE = 4  # coefficients of a curve at one temperature


@dataclass(frozen=True)
class PlanStep:
    """One step of the programme: start and duration, s, set point, degC, what is done, and in which cycle."""

    start: float
    duration: float
    set_point: float
    action: str
    cycle: int


FIXTURE = "levelled, on a three-axis table in the chamber; x, y and z of the unit point east, up and south, and stay so"
"""How the unit lies during the test, as in the source: the Earth's rate and gravity are constant on each axis."""


@dataclass(frozen=True, repr=False)
class WarmupPlan(PlannedTest):
    """A chamber programme.

    Attributes
    ----------
    steps
        Steps in order.
    duration
        Duration of the programme, s.
    temperatures
        Set points, degC, ascending.
    cycles
        Power cycles at each.
    warnings
        Shortcomings of the temperatures, with better ones.
    proposal
        Temperatures with the wide intervals divided; the same where none is wide.
    record
        Duration of a recording, s.
    noise, repeatability
        Angle random walk, rad/sqrt(s), and repeatability of cycles, as a fraction of the curve.
    """

    steps: tuple[PlanStep, ...]
    duration: float
    temperatures: tuple[float, ...]
    cycles: int
    warnings: tuple[str, ...]
    proposal: tuple[float, ...]
    record: float
    noise: float
    repeatability: float

    @property
    def curve_uncertainty(self) -> float:
        """Standard uncertainty of a curve at its temperature by white noise, rad/s.

        ``N sqrt(p / T_M + 1 / (t_end - T_M)) / sqrt(n)`` for p = 4 coefficients, n cycles and the settled reference.
        """
        settling = min(300.0, self.record / 2)
        rest = max(self.record - settling, self.record / 2)
        return float(self.noise * np.sqrt(_FREE / settling + 1 / rest) / np.sqrt(self.cycles))

    @property
    def repeatability_uncertainty(self) -> float:
        """Standard uncertainty of a curve by the repeatability of cycles, as a fraction of the curve."""
        return self.repeatability / math.sqrt(self.cycles)

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return how long the programme takes, and the times of each temperature."""
        head = (
            f"{len(self.temperatures) * self.cycles} power cycles: {len(self.temperatures)} temperatures, "
            f"{self.cycles} at each; the chamber is busy for {_hours(self.duration)}"
        )
        rows = []
        for at in self.temperatures:
            steps = [step for step in self.steps if step.cycle and step.set_point == at]
            end = steps[-1].start + steps[-1].duration
            rows.append([f"{at:g}", str(self.cycles), _hours(steps[0].start), _hours(end)])
        return head, ["set point, degC", "cycles", "from, h:min", "to, h:min"], rows

    def remarks(self) -> list[str]:
        """Return the uncertainty that a curve will have, and better temperatures if there are any."""
        lines = [
            "standard uncertainty of a curve at its temperature: "
            f"{from_si(self.curve_uncertainty, 'deg/h'):.2g} deg/h from noise, and "
            f"{100 * self.repeatability_uncertainty:.2g} % of the curve from repeatability"
        ]
        lines.append(f"fixture: {FIXTURE}")
        if self.proposal != self.temperatures:
            lines.append(f"better: --temperatures {','.join(f'{t:g}' for t in self.proposal)}")
        return lines

    def content(self) -> dict[str, Any]:
        """Return the plan for scripts, in SI."""
        return {
            "temperatures": list(self.temperatures),
            "cycles": self.cycles,
            "duration": amount(self.duration, "s"),
            "steps": [asdict(step) for step in self.steps],
            "curve_uncertainty": amount(self.curve_uncertainty, "rad/s"),
            "repeatability": amount(self.repeatability_uncertainty, "1"),
            "proposal": list(self.proposal),
            "warnings": list(self.warnings),
        }

    def findings(self) -> tuple[str, ...]:
        """Return the shortcomings of the temperatures, with better ones."""
        return self.warnings

    def save(self, path: str | Path) -> None:
        """Write the programme as CSV.

        Raises
        ------
        OptionError
            The file cannot be written.
        """
        write_csv(programme(self), path)

    def plot(self) -> Plot:
        """Return the chamber's set point over the time of the programme, with the recordings marked."""
        ends = [(step, step.start / 3600, (step.start + step.duration) / 3600) for step in self.steps]
        chamber = [(end, step.set_point) for step, _, end in ends]
        on = [(step.set_point, start, end) for step, start, end in ends if step.action.startswith("power on")]
        traces: list[dict[str, Any]] = [
            {"type": "scatter", "mode": "lines", "name": "chamber", "line": {"color": QUIET, "width": 2},
             "x": [end for end, _ in chamber], "y": [at for _, at in chamber]},
            {"type": "scatter", "mode": "lines", "name": "unit on, recorded", "line": {"color": GOOD, "width": 8},
             "x": [x for _, start, end in on for x in (start, end, None)],
             "y": [y for at, _, _ in on for y in (at, at, None)]},
        ]  # fmt: skip
        layout = {
            "xaxis": {"title": {"text": "time from the start, h"}},
            "yaxis": {"title": {"text": "set point, °C"}, "zeroline": False},
            "legend": LEGEND,
        }
        return Plot(Figure("Chamber programme", f"{self.shown()[0]}.", traces, layout), "Warm-up plan")


def plan_warmup(
    temperatures: Annotated[Sequence[float] | str, parsed(temperature_list, "T,T,...", unit="degC")] = TEMPERATURES,
    *,
    cycles: int | str = 5,
    soak: Annotated[float | str, measure("time", "s")] = "60 min",
    record: Annotated[float | str, measure("time", "s")] = "10 min",
    ramp: Annotated[float | str, text("K/MIN", unit="K/min")] = "2 K/min",
    noise: Annotated[float | str, text("N", unit="deg/sqrt(h)")] = "0.3 deg/sqrt(h)",
    repeatability: Annotated[float | str, text("FRACTION", unit="%")] = "2 %",
    start: float = 23.0,
) -> WarmupPlan:
    """Write the chamber programme of a warm-up test.

    At each set point, from cold to warm: soak with the unit off, power on and record, power off; and soak again before
    the next cycle, so that each one starts cold.

    Parameters
    ----------
    temperatures
        Calibration temperatures, ascending. Set points of the chamber, degC.
    cycles
        Power cycles at each temperature.
    soak
        Before each power-on, unit off. Until its inside has the chamber's temperature, s.
    record
        Recording from power-on on. In s.
    ramp
        Ramp of the chamber. In K/s.
    noise
        Angle random walk. In rad/sqrt(s).
    repeatability
        Repeatability of the curve from cycle to cycle. A fraction of it.
    start
        Chamber temperature at the beginning, degC.

    Raises
    ------
    OptionError
        A value is out of range.

    Examples
    --------
    >>> import imulab as il
    >>> plan = il.plan_warmup([-40, -20, 0, 20, 40, 60], cycles=3, soak="30 min")
    >>> print(plan)
    18 power cycles: 6 temperatures, 3 at each; the chamber is busy for 13:40 h
    set point, degC  cycles  from, h:min  to, h:min
                -40       3       0:32 h     2:32 h
                -20       3       2:42 h     4:42 h
                  0       3       4:52 h     6:52 h
                 20       3       7:02 h     9:02 h
                 40       3       9:12 h    11:12 h
                 60       3      11:22 h    13:22 h
    """
    at = tuple(temperature_list(temperatures, "temperatures"))
    count, soak, record = (
        whole(cycles, "cycles"),
        in_si(soak, "soak", "time", "s"),
        in_si(record, "record", "time", "s"),
    )
    ramp = of_units(ramp, "ramp", {"K/min": 1 / 60, "K/s": 1.0})
    walk, share = of_units(noise, "noise", RANDOM_WALK), fraction(repeatability, "repeatability", "%")
    if len(at) < 2 or not (np.diff(at) > 0).all():
        raise OptionError(f"temperatures {' '.join(f'{t:g}' for t in at)}: expected two or more, ascending, in degC")
    for name, value, low, high in (
        ("cycles", count, 1, 1000),
        ("soak", soak, 0, 1e6),
        ("record", record, 60, 1e6),
        ("ramp", ramp, 1e-4, 10),
    ):
        if not low <= value <= high:
            raise OptionError(f"{name} {value:g}: expected {low:g} to {high:g}")
    steps: list[PlanStep] = []
    clock, here = 0.0, start

    def add(duration: float, set_point: float, action: str, cycle: int) -> None:
        nonlocal clock
        if duration > 0:
            steps.append(PlanStep(clock, duration, set_point, action, cycle))
            clock += duration

    for set_point in at:
        add(abs(set_point - here) / ramp, set_point, "ramp, unit off", 0)
        for cycle in range(1, count + 1):
            add(soak, set_point, "soak, unit off", cycle)
            add(record, set_point, "power on and record", cycle)
        here = set_point
    add(abs(start - here) / ramp, start, "ramp back, unit off", 0)
    wide = [(low, high) for low, high in pairwise(at) if high - low > WIDEST]
    proposal = sorted(
        {*at, *(round(float(t), 6) for low, high in wide for t in np.linspace(low, high, _pieces(low, high) + 1))}
    )
    warnings = _warnings(wide, proposal, count, record)
    return WarmupPlan(tuple(steps), clock, at, count, warnings, tuple(proposal), record, walk, share)


def _warnings(
    wide: Sequence[tuple[float, float]], proposal: Sequence[float], count: int, record: float
) -> tuple[str, ...]:
    """Return warnings of what the test cannot show: within wide intervals, with one cycle, in short recordings."""
    warnings = tuple(
        f"the interval {low:g} to {high:g} degC is {high - low:g} K wide: interval-cubic uses the mean of both ends "
        "for all of it, wrong by half of their difference just inside each end, and no model sees a bend between them; "
        f"measure also at {' '.join(f'{t:g}' for t in proposal if low < t < high)} degC"
        for low, high in wide
    )
    if count < 2:
        warnings += ("one cycle at each temperature does not show how well cycles repeat: expected two or more",)
    if record < 330:
        warnings += (
            f"recordings of {record:g} s: warm-up takes about 300 s, and 30 s more make the settled reference: "
            "record longer",
        )
    return warnings


def _hours(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{minutes // 60}:{minutes % 60:02d} h"


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
            "programme": "ramp and soak with power 0; with power 1 switch the unit on and record from that instant",
            "fixture": FIXTURE,
        },
        name="warm-up plan",
    )

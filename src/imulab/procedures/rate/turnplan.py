"""How many whole turns by hand against a fence reach a wanted uncertainty of scale factors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from imulab.errors import OptionError
from imulab.recording import Array
from imulab.report.elements import BAD, GOOD, LEGEND, Figure
from imulab.report.plots import Plot
from imulab.report.traces import axis, short_log_axis
from imulab.shown import Shown

_TURNS = 1000


@dataclass(frozen=True, repr=False)
class TurnPlan(Shown):
    """How many whole turns by hand reach a wanted uncertainty: n on and n back, with a stop after each.

    Attributes
    ----------
    turns
        n.
    wanted
        Of the scale factor, relative.
    reached
        Relative standard uncertainty for 1 to n turns on and as many back, shape (n,).
    """

    turns: int
    wanted: float
    reached: Array

    @property
    def stops(self) -> int:
        """Rests at the fence, the first included."""
        return 2 * self.turns + 1

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return how many turns it takes, and what fewer would give."""
        rows = [[str(n), str(2 * n + 1), f"{1e6 * u:.3g}"] for n, u in enumerate(self.reached.tolist(), 1)]
        head = (
            f"{self.turns} turn{'s' * (self.turns > 1)} on and {self.turns} back about each axis, {self.stops} stops, "
            f"reach {1e6 * self.reached[-1]:.3g} ppm; wanted {1e6 * self.wanted:.6g} ppm"
        )
        return head, ["turns each way", "stops", "u of the scale factor, ppm"], rows

    def plot(self) -> Plot:
        """Return the uncertainty over the number of turns, beside the wanted one."""
        number = list(range(1, self.turns + 1))
        traces: list[dict[str, Any]] = [
            {"type": "scatter", "mode": "lines+markers", "name": "reached", "x": number,
             "y": (1e6 * self.reached).tolist(), "line": {"color": GOOD, "width": 2}},
            {"type": "scatter", "mode": "lines", "name": "wanted", "x": number, "y": [1e6 * self.wanted] * self.turns,
             "line": {"color": BAD, "width": 1.5, "dash": "dash"}},
        ]  # fmt: skip
        layout = {
            "xaxis": axis("turns each way", dtick=max(1, round(self.turns / 20))),
            "yaxis": short_log_axis("u(S)/S, ppm"),
            "legend": LEGEND,
        }
        caption = "u(S)/S: relative standard uncertainty of the scale factor."
        return Plot(Figure("Turns by hand", caption, traces, layout, message=f"{self.shown()[0]}."), "Plan of turns")


def plan_turns(wanted: float, fence: float) -> TurnPlan:
    """Return the plan of turns by hand: ``u = fence / sqrt(2) / (2 pi sqrt(sum (j_k - mean j)^2))``."""
    if not 0 < fence < 1:
        raise OptionError(f"fence {fence:g}: expected the uncertainty of the difference of two stops, such as 0.5 deg")
    reached: list[float] = []
    for n in range(1, _TURNS + 1):
        made = np.concatenate([np.arange(n + 1), np.arange(n)])  # turns made at each stop, on and back
        reached.append(fence / math.sqrt(2) / (2 * math.pi * float(np.sqrt(np.sum((made - made.mean()) ** 2)))))
        if reached[-1] <= wanted:
            return TurnPlan(n, wanted, np.array(reached))
    raise OptionError(
        f"turn {1e6 * wanted:.3g} ppm: {_TURNS} turns on and back reach {1e6 * reached[-1]:.3g} ppm; expected a rate "
        "table (rate fit) for that"
    )

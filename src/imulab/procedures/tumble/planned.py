"""A plan as its user has it: what it predicts, its CSV to measure by, its sheet to print, its figure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from imulab.atomic_write import write_page
from imulab.procedures.tumble.engineering import predicted_rows
from imulab.procedures.tumble.findings import freedom_finding
from imulab.procedures.tumble.mag.headings import Headings
from imulab.procedures.tumble.plan import Plan, roll_pitch, turning
from imulab.procedures.tumble.sheet import attitude_picture, plan_recording
from imulab.recording import Recording
from imulab.report import render_plan
from imulab.report.elements import GOOD, Figure
from imulab.report.plots import Plot
from imulab.report.traces import axis
from imulab.shown import Shown
from imulab.units import STANDARD_GRAVITY, from_si
from imulab.writers import write_csv


@dataclass(frozen=True, repr=False)
class TumblePlan(Shown, Plan):
    """Attitudes to measure, in the order that turns least, and what they will give.

    Attributes
    ----------
    criterion
        By which they were chosen.
    noise
        Of |f| in one attitude, in units of g.
    noise_from
        What said so, in brackets; empty where it was given as a number.
    distinct_verticals
        Whether no two attitudes have the same of x, y and z vertical.
    headings
        Which way each attitude faces, for a magnetometer; None where that was not asked for.
    """

    criterion: str
    noise: float
    noise_from: str
    distinct_verticals: bool
    headings: Headings | None = None

    @property
    def finding(self) -> str | None:
        """What too few attitudes leave open; None where they are enough."""
        return freedom_finding(len(self.directions) + self.already, len(self.covariance), self.order)

    @property
    def lead(self) -> str:
        """What the plan is and predicts, and why it differs from what was asked for."""
        noise = f"{from_si(self.noise * STANDARD_GRAVITY, 'ug'):.4g} µg"
        there = f" with the {self.already} already there" if self.already else ""
        lead = (
            f"{len(self.directions)} attitudes{there} for order {self.order}, criterion {self.criterion}: condition "
            f"number {self.condition_number:.1f}, {np.degrees(turning(self.directions)):.0f} deg of turning. Predicted "
            f"for a noise of {noise} in |f| per attitude{self.noise_from} and a nominal sensor."
        )
        if self.order == 3:
            lead += " Order 3 because attitudes for a lower one cannot show what that would leave in the scale factors."
        if self.again:
            pairs = ", ".join(f"{one} and {other}" for one, other in self.again)
            lead += (
                f" Put down twice: {pairs}. No more candidates lie 3 deg apart; the second time, after the others, "
                "lowers the noise and shows what drifts, but no new direction."
            )
        if self.distinct_verticals:
            lead += " Of the new attitudes no two have the same of x, y and z vertical, nor one that had it before."
        if self.finding is not None:
            lead += f" Too few to check the order: {self.finding}."
        return lead if self.headings is None else lead + self.headings.lead

    @property
    def predicted(self) -> list[tuple[str, str, str]]:
        """Predicted uncertainties as people read them: name, text and unit."""
        rows = predicted_rows(self.uncertainties(self.noise))
        return rows if self.headings is None else rows + self.headings.rows()

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return the plan in a few sentences, and the predicted uncertainties."""
        return self.lead, ["parameter", "predicted u", "unit"], [list(row) for row in self.predicted]

    def save(self, path: str | Path) -> None:
        """Write the attitudes as CSV: number, upward direction in the body frame (and that of north), roll and pitch.

        Raises
        ------
        OptionError
            The file cannot be written.
        """
        write_csv(self.recording(), path)

    def recording(self) -> Recording:
        """Return the same as a table."""
        return plan_recording(self, None if self.headings is None else self.headings.north)

    def sheet(self) -> str:
        """Return the sheet to print, a picture for each attitude, as HTML text."""
        return render_plan("Tumble plan", self.lead, self._pictures(), self.predicted)

    def report(self, path: str | Path) -> None:
        """Write the sheet to print as an HTML file; errors as for `save`."""
        write_page(path, self.sheet())

    def plot(self) -> Plot:
        """Return roll and pitch of the attitudes, numbered in their order."""
        roll, pitch = np.degrees(roll_pitch(self.directions)).T.tolist()
        numbers = [str(number) for number in range(1, len(roll) + 1)]
        sides = [("top center", "bottom center")[k % 2] for k in range(len(roll))]
        trace = {
            "type": "scatter", "mode": "lines+markers+text", "x": roll, "y": pitch, "text": numbers,
            "textposition": sides, "line": {"color": GOOD, "width": 1}, "marker": {"color": GOOD, "size": 8},
        }  # fmt: skip
        layout = {
            "xaxis": axis("roll, deg", dtick=90, range=[-195, 195]),
            "yaxis": axis("pitch, deg", dtick=45, range=[-110, 110]),
        }
        return Plot(Figure("Attitudes to measure", self.lead, [trace], layout), "Tumble plan")

    def _pictures(self) -> list[dict[str, str]]:
        angles = np.degrees(roll_pitch(self.directions))
        pictures = []
        for index, (up, (roll, pitch)) in enumerate(zip(self.directions, angles, strict=True)):
            north = None if self.headings is None else self.headings.north[index]
            pictures.append(
                {
                    "number": str(index + 1),
                    "picture": attitude_picture(up, north),
                    "facing": "" if self.headings is None else self.headings.facing(index),
                    "up": "(" + ", ".join(f"{value:+.2f}" for value in up) + ")",
                    "roll": f"{roll:.1f}",
                    "pitch": f"{pitch:.1f}",
                }
            )
        return pictures

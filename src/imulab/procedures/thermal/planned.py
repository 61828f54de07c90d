"""A plan over temperature as its user has it: what it predicts, its CSV to measure by, its sheet, its figure."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from imulab.atomic_write import write_page
from imulab.procedures.thermal.degrees import spoken_degrees
from imulab.procedures.thermal.gyroplan import GyroPlan, hourly
from imulab.procedures.tumble.plan import roll_pitch
from imulab.procedures.tumble.sheet import attitude_picture
from imulab.recording import Array, Recording
from imulab.report import render_plan
from imulab.report.elements import BAD, GOOD, LEGEND, Figure
from imulab.report.plots import Plot
from imulab.report.traces import axis
from imulab.shown import Shown
from imulab.units import from_si
from imulab.writers import write_csv

_ROWS = 9
_RATE = "#7a4f9a"


@dataclass(frozen=True)
class PlannedSoak:
    """One power cycle at one temperature.

    Attributes
    ----------
    temperature
        degC.
    warming
        Whether it is reached from below.
    directions
        Upward directions in the body frame, in the order that turns least, shape (n, 3).
    start, duration
        Of soak and attitudes, s.
    """

    temperature: float
    warming: bool
    directions: Array
    start: float
    duration: float


@dataclass(frozen=True)
class Tried:
    """A number of soaks that the time allows, attitudes in each, and sd of the corrected force, m/s^2."""

    soaks: int
    attitudes: int
    mean: float
    worst: float


@dataclass(frozen=True, repr=False)
class ThermalPlan(Shown):
    """Soaks and attitudes of a calibration over temperature, and what they will give.

    Attributes
    ----------
    soaks
        In their order.
    degrees
        Of bias, scale factor and misalignment.
    temperature, deviation
        Temperatures over the range, degC, and the standard deviation of a component of the corrected force there, root
        mean square over directions, m/s^2, shape (m,).
    mean
        Root of the mean of its square, m/s^2.
    noise
        Of ``|f|`` in one attitude, m/s^2.
    noise_from
        What said so, in brackets; empty where it was given as a number.
    turn_on_scatter
        Of the biases from one power cycle to the next, m/s^2.
    time
        That was available, s.
    tried
        The numbers of soaks that were compared.
    gyro
        What is predicted of the gyroscopes, None unless it was asked for.
    """

    soaks: tuple[PlannedSoak, ...]
    degrees: tuple[int, int, int]
    temperature: Array
    deviation: Array
    mean: float
    noise: float
    noise_from: str
    turn_on_scatter: float
    time: float
    tried: tuple[Tried, ...]
    gyro: GyroPlan | None = None

    @property
    def duration(self) -> float:
        """Of all soaks and attitudes, s."""
        return self.soaks[-1].start + self.soaks[-1].duration

    @property
    def lead(self) -> str:
        """What the plan is and predicts."""
        counts = [len(soak.directions) for soak in self.soaks]
        each = f"{counts[0]}" if min(counts) == max(counts) else f"{min(counts)} or {max(counts)}"
        again = len(self.soaks) - len({soak.temperature for soak in self.soaks})
        places = len(self.soaks) - again
        spoken = spoken_degrees(self.degrees)
        back = f" ({again} of them back at one)" if again else ""
        low, high = self.temperature[[0, -1]]
        worst = int(np.argmax(self.deviation))
        free = 3 * (len(self.soaks) - self.degrees[0] - 1)  # beside laws of the biases
        return (
            f"{len(self.soaks)} soaks, a power cycle each, at {places} temperatures{back}, {each} attitudes in each "
            f"({sum(counts)} in all), {_hours(self.duration)} of {_hours(self.time)}. For degrees {spoken}, a "
            f"noise of {_ug(self.noise)} ug in |f| per attitude{self.noise_from} and {_ug(self.turn_on_scatter)} ug of "
            f"turn-on scatter the laws will give a component of the force to {_ug(self.mean)} ug (standard deviation, "
            f"mean over {low:g} to {high:g} degC), {_ug(self.deviation[worst])} ug where they are worst, at "
            f"{self.temperature[worst]:.0f} degC; the turn-on offset of each later power cycle comes on top. "
            f"{free} independent offsets will tell the turn-on scatter."
            + ("" if self.gyro is None else f" {self.gyro.said(self.temperature)}")
        )

    @property
    def predicted(self) -> list[tuple[str, str, str]]:
        """Standard deviation of the corrected force, and rate, at temperatures over the range: name, text and unit."""
        places = np.linspace(0, len(self.temperature) - 1, _ROWS).round().astype(int).tolist()
        at = [f"at {self.temperature[k]:.0f} degC" for k in places]
        found = [(f"corrected force {one}", _ug(self.deviation[k]), "ug") for one, k in zip(at, places, strict=True)]
        if self.gyro is not None:
            rates = self.gyro.deviation[places].tolist()
            found += [(f"corrected rate {one}", hourly(u), "deg/h") for one, u in zip(at, rates, strict=True)]
        return found

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return the plan in a few sentences, and the schedule."""
        rows = [
            [str(k), f"{soak.temperature:.1f}", _side(soak), str(len(soak.directions)), _hours(soak.start),
             _hours(soak.start + soak.duration)]
            for k, soak in enumerate(self.soaks, 1)
        ]  # fmt: skip
        return self.lead, ["soak", "degC", "reached by", "attitudes", "from, h:min", "to, h:min"], rows

    def compared(self) -> tuple[list[str], list[list[str]]]:
        """Return the numbers of soaks that were compared, as titles and rows."""
        rows = [[str(each.soaks), str(each.attitudes), _ug(each.mean), _ug(each.worst)] for each in self.tried]
        return ["soaks", "attitudes in each", "mean sd, ug", "worst sd, ug"], rows

    def save(self, path: str | Path) -> None:
        """Write the attitudes as CSV: soak, set point, side, start, number, upward direction, roll and pitch.

        Raises
        ------
        OptionError
            The file cannot be written.
        """
        write_csv(self.recording(), path)

    def recording(self) -> Recording:
        """Return the same as a table."""
        counts = [len(soak.directions) for soak in self.soaks]
        up = np.vstack([soak.directions for soak in self.soaks])

        def each(values: list[float]) -> Array:
            return np.repeat(np.array(values, dtype=np.float64), counts)

        columns = {
            "soak": each([float(k) for k in range(1, len(counts) + 1)]),
            "set_point": each([round(soak.temperature, 1) for soak in self.soaks]),
            "warming": each([float(soak.warming) for soak in self.soaks]),
            "start": each([round(soak.start / 60, 3) for soak in self.soaks]),
            "number": np.concatenate([np.arange(1.0, n + 1) for n in counts]),
            **{f"up_{name}": np.round(up[:, i], 6) + 0.0 for i, name in enumerate("xyz")},
        }
        angles = np.round(np.degrees(roll_pitch(up)), 3) + 0.0
        columns |= {"roll": angles[:, 0], "pitch": angles[:, 1]}
        units = dict.fromkeys(columns, "1") | {"set_point": "degC", "start": "min", "roll": "deg", "pitch": "deg"}
        degrees = ",".join(map(str, self.degrees))
        return Recording(columns=columns, units=units, metadata={"degrees": degrees}, name="thermal plan")

    def sheet(self) -> str:
        """Return the sheet to print, a picture for each attitude, as HTML text."""
        pictures: list[dict[str, Any]] = []
        for number, soak in enumerate(self.soaks, 1):
            heading = f"Soak {number}: {soak.temperature:.1f} degC, reached by {_side(soak)}, {_hours(soak.start)}"
            for index, up in enumerate(soak.directions):
                roll, pitch = np.degrees(roll_pitch(up[None]))[0]
                pictures.append(
                    {
                        "heading": "" if index else heading,
                        "number": f"{number}.{index + 1}",
                        "picture": attitude_picture(up),
                        "facing": "",
                        "up": "(" + ", ".join(f"{value:+.2f}" for value in up) + ")",
                        "roll": f"{roll:.1f}",
                        "pitch": f"{pitch:.1f}",
                    }
                )
        return render_plan("Thermal plan", self.lead, pictures, self.predicted)

    def report(self, path: str | Path) -> None:
        """Write the sheet to print as an HTML file; errors as for `save`."""
        write_page(path, self.sheet())

    def plot(self) -> Plot:
        """Return the standard deviation of the corrected force, and rate, over temperature, and where soaks are."""
        at = np.array([soak.temperature for soak in self.soaks])
        traces: list[dict[str, Any]] = [
            {"type": "scatter", "mode": "lines", "name": "predicted", "x": np.round(self.temperature, 3).tolist(),
             "y": [float(_ug(value)) for value in self.deviation], "line": {"color": GOOD, "width": 2}},
            {"type": "scatter", "mode": "markers", "name": "soaks", "x": np.round(at, 2).tolist(),
             "y": [float(_ug(value)) for value in np.interp(at, self.temperature, self.deviation)],
             "marker": {"color": BAD, "size": 8}},
        ]  # fmt: skip
        layout = {
            "xaxis": axis("temperature, degC"),
            "yaxis": axis("sd of the corrected force, ug", rangemode="tozero"),
            "legend": LEGEND,
        }
        if self.gyro is not None:
            traces[0]["name"] = "force"
            own = [float(hourly(value)) for value in self.gyro.deviation]
            line = {"color": _RATE, "width": 2, "dash": "dash"}
            traces.insert(1, {**traces[0], "name": "rate at rest", "y": own, "yaxis": "y2", "line": line})
            right = axis("sd of the rate at rest, deg/h", rangemode="tozero", overlaying="y", side="right")
            layout |= {"yaxis2": {**right, "showgrid": False}, "margin": {"r": 75}}
        caption = "Of a component, root mean square over directions, without the turn-on offset of the day."
        return Plot(Figure("What the laws will give", caption, traces, layout, message=self.lead), "Thermal plan")


def _side(soak: PlannedSoak) -> str:
    return "warming" if soak.warming else "cooling"


def _ug(value: float) -> str:
    return f"{from_si(float(value), 'ug'):.3g}"


def _hours(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{minutes // 60}:{minutes % 60:02d} h"

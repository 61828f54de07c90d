"""What a rate record holds of its sweeps: delay and bandwidth of each gyroscope, and a sine's frequency."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from imulab.procedures.rate.choices import AXES
from imulab.procedures.rate.dwells import Dwells
from imulab.procedures.rate.manifest import RateTest
from imulab.procedures.rate.sections import Swept
from imulab.records.calibration import Parameter
from imulab.report.elements import ReportTable, format_uncertain, plain_number
from imulab.verdict import Note


def dynamics_of(test: RateTest, dwells: Sequence[Dwells]) -> dict[str, Parameter]:
    """Return ``gyro_delay_i`` and ``gyro_bandwidth_i`` of the gyroscopes that were swept, runs by inverse variance."""
    found: dict[str, Parameter] = {}
    for kind, unit in (("delay", "s"), ("bandwidth", "Hz")):
        for number, axis in enumerate(AXES):
            pairs = [
                pair
                for run, one in zip(test.runs, dwells, strict=True)
                if run.axis == number and one.sweep is not None and (pair := getattr(one.sweep, kind)) is not None
            ]
            if pairs:
                values, spread = np.array(pairs).T
                weight = 1 / np.maximum(spread, 1e-12 * np.abs(values).max()) ** 2
                value, u = float(weight @ values / weight.sum()), float(1 / np.sqrt(weight.sum()))
                found[f"gyro_{kind}_{axis}"] = Parameter(value, u, unit)
    return found


def motion_of(dwells: Sequence[Dwells]) -> str:
    """Return how the table moved, ``model.from`` of the record."""
    kinds = {one.sweep is None for one in dwells}
    return "steps" if kinds == {True} else "sweeps" if kinds == {False} else "steps and sweeps"


def swept(test: RateTest, dwells: Sequence[Dwells]) -> dict[str, Any]:
    """Return ``fit.sweeps``: of each run that was one its file, and what it says; nothing where there was none."""
    found = [
        {
            "file": run.file,
            "axis": AXES[run.axis],
            "frequency": one.sweep.frequency,
            "delay": one.sweep.delay[0],
            "delay_uncertainty": one.sweep.delay[1],
            "bandwidth": None if one.sweep.bandwidth is None else one.sweep.bandwidth[0],
            "bandwidth_uncertainty": None if one.sweep.bandwidth is None else one.sweep.bandwidth[1],
            "bandwidth_beyond": one.sweep.beyond,
        }
        for run, one in zip(test.runs, dwells, strict=True)
        if one.sweep is not None
    ]
    return {"sweeps": found} if found else {}


def of_sweeps(test: RateTest, dwells: Sequence[Dwells]) -> list[str]:
    """Say of each run at one frequency that its scale factor is the amplitude there, and which tell no hysteresis."""
    said = []
    for index, one in enumerate(dwells):
        if one.sweep is None or one.sweep.loop_error is not None:
            continue
        place = test.place(index)
        if one.sweep.frequency is None:
            said.append(
                f"{place}: the rate passes each value always equally fast: hysteresis cannot be told from the delay, "
                "which holds it; a sweep of frequencies, or steps, tells it"
            )
        else:
            said.append(
                f"{place}: the rate is one sine of {one.sweep.frequency:.4g} Hz: the scale factor is the amplitude at "
                "that frequency, the delay holds hysteresis, and no bandwidth can be told from it; a sweep of "
                "frequencies, or steps, shows that at rest, and the hysteresis"
            )
    return [Note(line) for line in said]


def sweep_table(sweeps: Sequence[Swept]) -> ReportTable:
    """Return the table of the sweeps of a record."""
    rows = []
    for of in sweeps:
        delay, u = format_uncertain(1e3 * of.delay, 1e3 * of.delay_uncertainty)
        width, of_width = ("–", "–")
        if of.bandwidth is not None:
            width, of_width = format_uncertain(of.bandwidth, of.bandwidth_uncertainty)
        elif of.bandwidth_beyond is not None:
            width = f"> {plain_number(of.bandwidth_beyond, 2)}"
        at = "–" if of.frequency is None else plain_number(of.frequency, 4)
        rows.append([of.file, of.axis, at, delay, u, width, of_width])
    return ReportTable(
        "Sweeps",
        "Delay of the gyroscope behind the table, and the frequency where a first-order lag with the same fall of "
        "amplitude is at -3 dB. Of one sine, whose frequency is given, the scale factor is the amplitude there.",
        ["file", "gyro", "sine, Hz", "delay, ms", "u", "bandwidth, Hz", "u"],
        rows,
    )

"""Rows that are not readings: what loggers do, and sensors whose rows only look like it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from _hold import G, Hand, samples
from hold import judged, recording
from scenario import Scenario, Trial

Fault = Callable[[np.ndarray, np.ndarray], None]


def zeros(outputs: np.ndarray, rows: np.ndarray) -> None:
    """All columns at zero."""
    outputs[rows] = 0.0


def one_zero(outputs: np.ndarray, rows: np.ndarray) -> None:
    """The first column at zero."""
    outputs[rows, 0] = 0.0


def repeats(outputs: np.ndarray, rows: np.ndarray) -> None:
    """The row before again."""
    outputs[rows] = outputs[rows - 1]


def spikes(outputs: np.ndarray, rows: np.ndarray) -> None:
    """Far beyond the noise."""
    outputs[rows, 1] += 0.5 * G


def torn(outputs: np.ndarray, rows: np.ndarray) -> None:
    """Columns that have changed places."""
    outputs[rows] = np.roll(outputs[rows], 1, axis=1)


def nothing(outputs: np.ndarray, rows: np.ndarray) -> None:
    """No fault."""


def tumble(seed: int, fault: Fault, every: int, step: float) -> Trial:
    """Fit one test at order 1, with a fault in every so-manieth row, in steps of the output."""
    import imulab as il
    from imulab.errors import DataError

    time, outputs = samples(seed, Hand())
    if step:
        outputs = step * np.round(outputs / step)
    fault(outputs, np.arange(every - 1, len(outputs), every))
    try:
        record = il.fit_tumble(il.find_attitudes(recording(time, outputs)), order=1, gravity=G).calibration
    except DataError as error:
        return Trial(warned="left out" in str(error))
    return judged(record, "left out")


def array(seed: int, command: str, every: int) -> Trial:
    """Six gyros at rest, every so-manieth row at zero: error of biases or rate, deg/s, or relative one of the noise."""
    import imulab as il
    from imulab.estimation.column_noise import analyse
    from imulab.recording import Recording

    rng = np.random.default_rng(seed)
    level, noise = 0.2 * np.arange(1, 7), 0.05
    readings = level + noise * rng.standard_normal((4000, 6))
    if every:
        readings[every - 1 :: every] = 0.0
    columns = {"time": np.arange(4000) / 100.0} | {f"gyro_{i + 1}": readings[:, i].copy() for i in range(6)}
    log = Recording(columns, dict.fromkeys(columns, "deg/s") | {"time": "s"}, name="array.csv")
    if command == "calibrate":
        record = il.calibrate_array(log).calibration
        biases = np.array([record.parameters[f"bias_{i}"].value for i in range(1, 7)])
        said, error = record.warnings, np.degrees(biases) - level
    elif command == "allan":
        result = analyse(log)
        first = np.array([result["columns"][f"gyro_{i}"]["deviation"][0] for i in range(1, 7)])
        said, error = result["warnings"], np.degrees(first) / noise - 1
    else:
        fused = il.fuse(log, il.FuseOptions(method="mean"))
        said, error = fused.notes, np.array([np.nanmin(fused.rate) - level.mean()])
    return Trial(warned=any("left out" in line for line in said), error=float(np.sqrt(np.mean(error**2))))


FAULTS = {
    "zeros": zeros,
    "a zero in one column": one_zero,
    "the row before": repeats,
    "spikes of 0.5 g": spikes,
    "torn frames": torn,
}
ARRAY = {"calibrate": 0.01, "allan": 0.05, "fuse": 0.15}
FEW = 30
SCENARIOS = [
    *(
        Scenario(
            "Tumble: lost rows", f"every 50th row: {name}", partial(tumble, fault=fault, every=50, step=0.0),
            FEW, (93.0, 98.5), warned=95.0, largest_error=10.0, unit="ppm",
        )
        for name, fault in FAULTS.items()
    ),
    Scenario(
        "Tumble: lost rows", "every 10th row: zeros", partial(tumble, fault=zeros, every=10, step=0.0),
        FEW, None, warned=95.0,
    ),
    *(
        Scenario(
            "Tumble: lost rows", f"steps of {1e3 * step:g} mg, nothing lost",
            partial(tumble, fault=nothing, every=50, step=step * G), FEW, None, false_alarms=5.0, unit="ppm",
        )
        for step in (6e-5, 1e-3, 4e-3)
    ),
    *(
        Scenario(
            "Arrays, Allan: lost rows", f"{command}: {'every 50th row zeros' if every else 'nothing lost'}",
            partial(array, command=command, every=every), 20, None,
            warned=95.0 if every else None, false_alarms=None if every else 5.0, largest_error=limit,
        )
        for command, limit in ARRAY.items()
        for every in (50, 0)
    ),
]  # fmt: skip

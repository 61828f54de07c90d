"""Magnetometers beside accelerometers in fields and hands that people have."""

from __future__ import annotations

from functools import partial

import numpy as np
from _magnetometer_bench import Bench, Disturbance, G, record
from scenario import Scenario, Trial

import imulab as il
from imulab.display import Note
from imulab.records.calibration import Calibration

GROUP = "Tumble: magnetometers"
UG = 1e-6 * G


def magnetometer_truth(bench: Bench) -> dict[str, float]:
    """Return the true parameters of the magnetometers under the names of a record, SI."""
    scale = np.diag(bench.matrix)
    truth = {f"mag_scale_factor_{a}": float(1e6 * scale[i]) for i, a in enumerate("xyz")}
    truth |= {f"mag_bias_{a}": float(1e-6 * bench.hard_iron[i] / scale[i]) for i, a in enumerate("xyz")}
    truth |= {
        f"mag_misalignment_{a}{b}": float(bench.matrix[i, j] / scale[i])
        for i, a in enumerate("xyz")
        for j, b in enumerate("xyz")
        if i != j
    }
    return truth | {"dip": bench.dip}


def covers(calibration: Calibration, truth: dict[str, float]) -> tuple[bool, ...]:
    """Return for each parameter whether its 95 % interval holds the truth."""
    covered = []
    for name, value in truth.items():
        interval = calibration.parameters[name].interval_95
        assert interval is not None
        covered.append(interval[0] <= value <= interval[1])
    return tuple(covered)


def trial(seed: int, *, disturbance: Disturbance, accelerometers: bool = False) -> Trial:
    """Fit one recording; quantities are the magnetometers' parameters, or the accelerometers'; warned: not good."""
    bench = record(np.random.default_rng(seed), disturbance)
    calibration = il.fit_mag(bench.recording, gravity=G, order=1, field="48 uT").calibration
    warned = any(not isinstance(warning, Note) for warning in calibration.warnings)
    truth = magnetometer_truth(bench)
    if accelerometers:
        error = np.mean([(calibration.value(f"bias_{a}") - bench.accel[f"bias_{a}"]) ** 2 for a in "xyz"]) ** 0.5 / UG
        return Trial(covers(calibration, bench.accel), warned, float(error))
    off = [calibration.value(f"mag_scale_factor_{a}") / truth[f"mag_scale_factor_{a}"] - 1 for a in "xyz"]
    return Trial(covers(calibration, truth), warned, float(100 * np.sqrt(np.mean(np.square(off)))))


def exchanged(seed: int, *, sensor: str) -> Trial:
    """Fit one recording without a hemisphere whose columns x and y of a sensor changed places; whether that is said."""
    bench = record(np.random.default_rng(seed), Disturbance())
    columns = {name: bench.recording.column(name) for name in bench.recording.units}
    columns[f"{sensor}_x"], columns[f"{sensor}_y"] = columns[f"{sensor}_y"], columns[f"{sensor}_x"]
    made = il.Recording(columns, bench.recording.units)
    reasons = il.fit_mag(made, gravity=G, order=1, field="48 uT").calibration.verdict.reasons
    return Trial(warned=any("two are exchanged" in reason for reason in reasons))


def row(
    name: str,
    disturbance: Disturbance,
    *,
    accelerometers: bool = False,
    coverage: tuple[float, float] | None = (93.0, 97.0),
    warned: float | None = None,
    largest_error: float | None = None,
) -> Scenario:
    """Return a scenario of one disturbance, of which nothing is to be said unless `warned` asks for it."""
    return Scenario(
        GROUP,
        name,
        partial(trial, disturbance=disturbance, accelerometers=accelerometers),
        trials=30,
        coverage=coverage,
        warned=warned,
        false_alarms=4.0 if warned is None else None,
        largest_error=largest_error,
        unit="µg of bias" if accelerometers else "% of scale factor",
    )


SCENARIOS = [
    row("magnetometers, nothing disturbed", Disturbance()),
    row(
        "accelerometers beside magnetometers, sway of 1.5 mrad", Disturbance(sway=1.5e-3), accelerometers=True,
        largest_error=16.0,
    ),
    row("slow magnetometers, low pass 0.3 Hz", Disturbance(corner=0.3), largest_error=0.05),
    row("alias of the mains at 0.1 Hz, 0.5 µT", Disturbance(mains=0.5), coverage=(93.0, 99.0)),
    row("gradient of 10 µT/m, magnetometers 5 cm off", Disturbance(gradient=10.0), coverage=(91.0, 98.0)),
    row(
        "half of the attitudes in two pointing directions, gradient", Disturbance(gradient=10.0, poses=True),
        coverage=None,
    ),
    row("a phone of 1 µT from the middle on", Disturbance(phone=1.0), coverage=None, warned=95.0),
    *(
        Scenario(GROUP, f"x and y of the {name} exchanged", partial(exchanged, sensor=sensor), 10, None, 95.0)
        for name, sensor in (("accelerometers", "accel"), ("magnetometers", "mag"))
    ),
]  # fmt: skip

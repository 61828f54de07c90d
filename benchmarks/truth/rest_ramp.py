"""Gyroscopes at rest while they warm, and what benches, thermometers and loggers do to that."""

from __future__ import annotations

from functools import partial

import numpy as np
from scenario import Scenario, Trial

import imulab as il
from imulab.display import Note
from imulab.procedures.thermal.record import predict_gyro_bias

GROUP = "Gyroscopes at rest over temperature"
RATE, LENGTH = 10.0, 1500.0  # Hz, s


def trial(seed: int, *, back: bool = False, what: str = "", size: float = 0.0) -> Trial:
    """Fit one ramp of one unit; quantities are the biases at nine temperatures."""
    rng = np.random.default_rng(seed)
    count = int(RATE * LENGTH)
    time = np.arange(count) / RATE
    path = 1 - np.abs(2 * time / LENGTH - 1) if back else 1 - np.exp(-3 * time / LENGTH)
    temperature = 12 + 36 * path
    law = rng.standard_normal((4, 3)) * np.array([[0.5], [0.02], [2e-4], [2e-6]])  # deg/s
    late = np.interp(time - (size if what == "lag" else 0.0), time, temperature)
    earth = rng.standard_normal(3)
    output = np.vander(late - 25, 4, increasing=True) @ law + 15 / 3600 * earth / np.linalg.norm(earth)
    output += 0.05 * rng.standard_normal((count, 3))
    # 1/f noise as relaxations over five decades, each begun in its steady state.
    for constant in (1.0, 10.0, 100.0, 1000.0):
        keep = np.exp(-1 / RATE / constant)
        drive = rng.standard_normal((count, 3)) * np.sqrt(1 - keep**2)
        drive[0] = rng.standard_normal(3)
        state = np.zeros(3)
        for block in range(0, count, 1000):  # y_k = keep^k (y_0 + sum of drives / keep^k), in blocks that stay finite
            powers = keep ** np.arange(1, len(drive[block : block + 1000]) + 1)[:, None]
            part = powers * (state + np.cumsum(drive[block : block + 1000] / powers, axis=0))
            output[block : block + 1000] += 2e-3 * part
            state = part[-1]
    if what == "knock":
        for begin in rng.integers(0, count - 20, 4):
            output[begin : begin + 20] += size * rng.standard_normal((20, 3))
    if what == "turned":
        output[count // 4 : count // 4 + 300, 2] += size  # taken up and put down again
    read = np.round(temperature + 0.02 * rng.standard_normal(count), 2)
    keep_rows = np.ones(count, dtype=bool)
    if what == "lost":
        keep_rows = rng.random(count) > size
        keep_rows[count // 2 : count // 2 + 400] = False
    if what == "repeated":
        output = output[np.arange(count) // int(size) * int(size)]
    columns = {"time": time, **{f"gyro_{a}": output[:, k] for k, a in enumerate("xyz")}, "temperature": read}
    units = {"time": "s", **{f"gyro_{a}": "deg/s" for a in "xyz"}, "temperature": "degC"}
    recording = il.Recording({n: c[keep_rows] for n, c in columns.items()}, units, name="bench.csv")
    try:
        record = il.fit_thermal(recording).calibration
    except il.ImulabError:
        return Trial(warned=True)
    at = np.linspace(*record.model["range"], 9)
    values, u = (np.degrees(each) for each in predict_gyro_bias(record, at))
    error = values - (np.vander(at - 25, 4, increasing=True) @ law).T
    covered = (np.abs(error) < 1.96 * u).ravel().tolist()
    warned = any(not isinstance(each, Note) for each in record.warnings) or record.verdict.state != "good"
    if what == "lag":
        lag = record.fit["gyro"]["lag"]
        warned = (lag is not None and lag["fitted"]) or any("lag" in each for each in record.warnings)
    return Trial(tuple(covered), warned, float(3600 * np.sqrt(np.mean(error**2))))


def row(name: str, **options: object) -> Scenario:
    """Return a scenario of one disturbance."""
    asked = {key: options.pop(key) for key in ("coverage", "warned", "false_alarms", "largest_error") if key in options}
    return Scenario(GROUP, name, partial(trial, **options), trials=40, unit="deg/h", **asked)  # type: ignore[arg-type]


_WIDE = (90.0, 100.0)

SCENARIOS = [
    row("a ramp that warms, 4 K/min at first", coverage=_WIDE),
    row("up and down, nothing disturbed", back=True, coverage=_WIDE, false_alarms=4.0),
    row("up and down, a lag of 20 s: found", back=True, what="lag", size=20.0, coverage=_WIDE, warned=95.0),
    row("one way, a lag of 20 s: said", what="lag", size=20.0, coverage=None, warned=95.0),
    row("four knocks of 5 deg/s", what="knock", size=5.0, coverage=_WIDE),
    row("taken up and turned for 30 s", what="turned", size=2.0, coverage=_WIDE),
    row("5 % of the rows lost, and 40 s", what="lost", size=0.05, coverage=_WIDE),
    row("each reading in two rows", what="repeated", size=2, coverage=_WIDE),
]

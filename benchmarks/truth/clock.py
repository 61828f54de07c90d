"""Gyroscopes whose clock, samples, turns or unit are not what a person takes them for."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import numpy as np
from scenario import Scenario, Trial
from scipy.stats import t as student

import imulab as il
from imulab.display import Note
from imulab.errors import ImulabError
from imulab.procedures.tumble.gyro.fit import fit_gyro_triad, with_gyro

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
from reference import moving_array, turns

GYRO, ARRAY = "Gyroscopes of a tumble", "Gyro array, calibration in motion"
RATE = 100.0


def gyro(
    seed: int,
    *,
    words: str = "",
    clock: float = 50e-6,
    fast: float = 0.0,
    late: float = 0.0,
    apart: bool = False,
    clock_of: str = "gyro",
    sensitivity: float = 0.0,
    cubic: float = 0.0,
    limit: float | None = None,
    lost: tuple[int, bool] | None = None,
    knock: float = 0.0,
    scale: float = 1.0,
    jitter: float = 0.0,
    noted: bool = False,
) -> Trial:
    """Calibrate a unit; warned means that a finding, a note only if `noted`, holds the words, where there are some.

    `clock`: standard deviation of the clocks' rates; `fast`: what the gyroscopes' clock is off by beyond that; `lost`:
    samples lost in a turn, and whether the time stamps show it; `jitter`: a host stamps samples so late at most, s.
    """
    rng = np.random.default_rng(seed)
    unit = turns.random_unit(rng, sensitivity)
    path = turns.random_path(rng)
    true = np.arange(0, path.end, 1 / RATE)
    accel = turns.accelerometers(unit, path, true, rng)
    columns = turns.gyroscopes(unit, path, true - late, rng, cubic=cubic, limit=limit)
    columns = {name: scale * values for name, values in columns.items()}
    time, own = (true * (1 + extra + rng.normal(0, clock)) for extra in (fast, 0.0))
    turn = int(rng.integers(2, 20))
    middle = path.begin[turn] + path.duration[turn] * rng.uniform(0.35, 0.65)
    if knock:
        columns["gyro_x"] = columns["gyro_x"] + knock * np.exp(-0.5 * ((true - middle) / 0.03) ** 2)
    if lost is not None:
        count, stamped = lost
        keep = np.abs(true - middle) > count / RATE / 2
        columns, accel = ({n: v[keep] for n, v in values.items()} for values in (columns, accel))
        time = time[keep] if stamped else time[: keep.sum()]
    if jitter:
        time = np.maximum.accumulate(time + rng.uniform(0, jitter, len(time))) + 1e-9 * np.arange(len(time))
    units = {"time": "s"} | {f"gyro_{a}": "rad/s" for a in "xyz"} | {f"accel_{a}": "m/s^2" for a in "xyz"}
    accelerometers = recording = il.Recording(columns={"time": time, **columns, **accel}, units=units, name="both.csv")
    if apart:
        accelerometers = il.Recording(columns={"time": own, **accel}, units=units, name="accel.csv")
        recording = il.Recording(columns={"time": time, **columns}, units=units, name="gyro.csv")
    try:
        attitudes = il.find_attitudes(accelerometers)
        record = il.fit_tumble(attitudes, order=1, gravity=turns.GRAVITY).calibration
        fit = fit_gyro_triad(record, attitudes, recording, clock_of=clock_of)
        both = with_gyro(record, fit, recording, accelerometers)
    except ImulabError as error:
        return Trial(warned=words in str(error))
    i, j = np.nonzero(~np.eye(3, dtype=bool))
    found = np.concatenate([fit.scale_factor, fit.misalignment[i, j], fit.bias])
    wanted = np.concatenate([unit.scale, unit.misalignment[i, j], unit.bias])
    half = student.ppf(0.975, 2 * len(fit.residuals) - 9) * np.sqrt(np.diag(fit.covariance))
    said = [w for w in both.warnings if w.startswith("gyro") and (noted or not isinstance(w, Note))]
    error = 1e6 * float(np.sqrt(np.mean((fit.scale_factor / unit.scale - 1) ** 2)))
    return Trial(tuple((np.abs(found - wanted) < half).tolist()), any(words in w for w in said), error)


def array(seed: int, *, late: tuple[float, ...], axes: int = 1) -> Trial:
    """Calibrate six elements at rest and in motion, and ask for their scale factors (three axes: matrices) and u."""
    rng = np.random.default_rng(seed)
    every = (*late, *([0.0] * (6 - len(late))))
    sensing = np.eye(axes) + rng.normal(0, 0.01, (6, axes, axes))
    time, noise = np.arange(0, 30, 1 / RATE), np.radians(0.05)
    made = []
    for still in (True, False):
        data = moving_array.columns(moving_array.moving_array(rng, time, sensing, every, noise, still=still))
        units = {"time": "s"} | dict.fromkeys(data, "rad/s")
        made.append(il.Recording(columns={"time": time, **data}, units=units, name="array.csv"))
    record = il.calibrate_array(*made).calibration
    said = any("come later than" in w for w in record.warnings)
    if axes == 3:  # the frame is the array's own: what can be compared is an element against the first
        matrices = [np.linalg.inv(np.array(e["matrix"]["value"])) for e in record.sections["elements"]]
        relative = np.array([m @ np.linalg.inv(matrices[0]) for m in matrices])
        error = relative - sensing @ np.linalg.inv(sensing[0])
        return Trial((), said, 1e6 * float(np.sqrt(np.mean(error[1:] ** 2))))
    wanted = sensing[:, 0, 0] / sensing[:, 0, 0].mean()
    found = [record.parameters[f"scale_factor_{i + 1}"] for i in range(6)]
    error = np.array([p.value for p in found]) - wanted
    half = student.ppf(0.975, 19) * np.array([p.standard_uncertainty for p in found])
    return Trial(tuple((np.abs(error) < half).tolist()), said, 1e6 * float(np.sqrt(np.mean(error**2))))


def row(name: str, **options: object) -> Scenario:
    """Return a scenario of the gyroscopes: settings of `Scenario` and arguments of `gyro`."""
    settings = {key: options.pop(key) for key in ("coverage", "warned", "false_alarms", "trials") if key in options}
    settings = {"trials": 8, "unit": "ppm of scale factor", **settings}
    return Scenario(GYRO, name, partial(gyro, **options), **settings)  # type: ignore[arg-type]


SCENARIOS = [
    row("nothing wrong, clocks of 50 ppm", false_alarms=5.0, trials=24),
    row("the same, each triad on a clock of its own", apart=True, false_alarms=5.0),
    row("clock 2000 ppm fast, the accelerometers' true", apart=True, fast=2e-3, words="clock runs", coverage=None,
        warned=95.0),
    row("clock 500 ppm fast, the accelerometers' true", apart=True, fast=5e-4, words="clock runs", coverage=None,
        warned=95.0),
    row("clock 2000 ppm fast, `--clock-of accel`", apart=True, fast=2e-3, clock_of="accel"),
    row("samples 10 ms late", late=0.01, false_alarms=5.0),
    row("stamps late by up to 40 ms, each by its own", jitter=0.04),
    row("scale factor 0.1 % larger at 100 deg/s", cubic=1e-3, words="depends on the rate", coverage=None, warned=95.0),
    row("g-sensitivity of 0.001 deg/s/g", sensitivity=np.radians(0.001) / turns.GRAVITY),
    row("g-sensitivity of 0.002 deg/s/g", sensitivity=np.radians(0.002) / turns.GRAVITY),
    row("g-sensitivity of 0.05 deg/s/g", sensitivity=np.radians(0.05) / turns.GRAVITY),
    row("a knock in a turn", knock=0.3, words="set aside", warned=95.0),
    row("12 samples lost in a turn, stamps run on", lost=(12, False), words="set aside", warned=95.0),
    row("12 samples lost in a turn, stamps show it: noted", lost=(12, True), words="samples are missing", warned=95.0,
        noted=True),
    row("a range of 130 deg/s", limit=np.radians(130.0)),
    row("deg/s labelled rad/s", scale=57.29578, words="in deg/s?", coverage=None, warned=95.0, trials=8),
    row("time stamps of half the rate", fast=1.0, words="twice what", coverage=None, warned=95.0, trials=8),
    Scenario(ARRAY, "no latency", partial(array, late=()), 10, false_alarms=5.0, unit="ppm"),
    Scenario(ARRAY, "one element 10 ms late", partial(array, late=(0.01,)), 10, warned=95.0, largest_error=50,
             unit="ppm"),
    Scenario(ARRAY, "three late: 10, -20, 5 ms", partial(array, late=(0.01, -0.02, 0.005)), 10, warned=95.0,
             largest_error=50, unit="ppm"),
    Scenario(ARRAY, "the same, three axes", partial(array, late=(0.01, -0.02, 0.005), axes=3), 8, None, warned=95.0,
             largest_error=100, unit="ppm"),
]  # fmt: skip

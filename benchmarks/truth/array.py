"""Gyro arrays: motion taken for rest, elements mounted otherwise, mixed units, dead gyros, comparisons at rest."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from scenario import Scenario, Trial

RATE, NOISE = 100.0, 0.05  # Hz, deg/s a sample
SWAPPED = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])
UPSIDE_DOWN = np.array([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]])


def _rotation(rng: np.random.Generator) -> np.ndarray:
    """A rotation at random."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def _motion(count: int, axes: int, rng: np.random.Generator, size: float = 40.0, slow: float = 1.0) -> np.ndarray:
    time = np.arange(count) / RATE
    rates = np.zeros((count, axes))
    for frequency in (0.13, 0.31, 0.7):
        turns = 2 * np.pi * frequency / slow * (1 + 0.17 * np.arange(axes))
        rates += size * np.sin(turns * time[:, None] + rng.uniform(0, 6, axes))
    return rates


def _readings(
    rates: np.ndarray, sensing: np.ndarray, rng: np.random.Generator, bias: np.ndarray | float = 0.3
) -> np.ndarray:
    """Readings (m, axes, n), deg/s, of elements that sense `sensing` (n, axes, axes), with white noise and walk."""
    count, axes = rates.shape
    n = len(sensing)
    noise = NOISE * rng.uniform(0.6, 1.6, (axes, n))
    out = np.einsum("iab,tb->tai", sensing, rates) + bias
    out += noise * rng.standard_normal((count, axes, n))
    return out + np.cumsum(2e-4 / math.sqrt(RATE) * rng.standard_normal((count, axes, n)), axis=0)


def _recording(readings: np.ndarray, name: str):
    from imulab.recording import Recording

    count, axes, n = readings.shape
    columns, units = {"time": np.arange(count) / RATE}, {"time": "s"}
    for a in range(axes):
        for i in range(n):
            key = f"gyro_{'xyz'[a]}_{i + 1}" if axes == 3 else f"gyro_{i + 1}"
            columns[key], units[key] = np.ascontiguousarray(readings[:, a, i]), "deg/s"
    return Recording(columns, units, name=name)


def _sensing(kind: str, axes: int, n: int, rng: np.random.Generator) -> np.ndarray:
    sensing = np.eye(axes) + 0.01 * rng.standard_normal((n, axes, axes))
    if kind == "alternate":
        sensing[1::2] = (UPSIDE_DOWN if axes == 3 else -np.eye(1)) @ sensing[1::2]
    elif kind == "any":
        sensing = np.array([_rotation(rng) @ one for one in sensing])
    elif kind == "swapped":
        sensing[2] = SWAPPED @ sensing[2]
    return sensing


def _calibrate(seed: int, *, kind: str, axes: int, size: float, slow: float, part: float) -> Trial:
    """`array calibrate` of a recording that moves by `size`, deg/s, in all but the first `part` of it."""
    from imulab.errors import ImulabError
    from imulab.procedures.gyro_array.fit import calibrate_array

    rng = np.random.default_rng([seed, 12])
    count, n = 6000, 6
    rates = _motion(count, axes, rng, size, slow)
    rates[: int(part * count)] = 0.0
    sensing = _sensing(kind, axes, n, rng)
    bias = rng.normal(0, 0.5, (axes, n))
    readings = _readings(rates, sensing, rng, bias)
    try:
        record = calibrate_array(_recording(readings, "still")).calibration
    except ImulabError as error:
        return Trial((), "moves" in str(error) or "at rest" in str(error))
    found = np.array([np.atleast_1d(e["bias"]["value"]) for e in record.sections["elements"]]).T
    u = np.array([np.atleast_1d(e["bias"]["standard_uncertainty"]) for e in record.sections["elements"]]).T
    wrong = found - np.radians(bias)
    inside = tuple((np.abs(wrong) < 1.96 * u).ravel().tolist())
    said = any("longest stretch at rest" in line for line in record.warnings)
    return Trial(inside, said, math.degrees(float(np.sqrt(np.mean(wrong**2)))))


def _bent(seed: int, *, bend: float, axes: int) -> Trial:
    """Scale factors, and matrices, where the ratio of element 3 changes by `bend` at 200 deg/s as the rate's square."""
    from imulab.procedures.gyro_array.fit import calibrate_array

    rng = np.random.default_rng([seed, 14])
    n, count = 6, 6000
    sensing = _sensing("", axes, n, rng)
    still = _readings(np.zeros((3000, axes)), sensing, rng)
    moving = np.einsum("iab,tb->tai", sensing, _motion(count, axes, rng, 80.0))
    moving[:, :, 2] *= 1 + bend * (moving[:, :, 2] / 200) ** 2
    moving += 0.3 + NOISE * rng.uniform(0.6, 1.6, (axes, n)) * rng.standard_normal(moving.shape)
    record = calibrate_array(_recording(still, "still"), _recording(moving, "moving")).calibration
    relative = sensing @ np.linalg.inv(sensing[0])
    truth = relative @ np.linalg.inv(relative.mean(axis=0))
    entries = record.sections["elements"]
    if axes == 1:
        stated, truth = [each["scale_factor"] for each in entries], truth[:, 0, 0]
    else:
        stated, truth = [each["matrix"] for each in entries], np.linalg.inv(truth)
    wrong = np.array([each["value"] for each in stated]) - truth
    u = np.array([each["standard_uncertainty"] for each in stated])
    said = any("output over rate" in line for line in record.warnings)
    # Student's t of the 20 stretches that the uncertainties come from
    inside = np.abs(wrong) < 2.09 * u
    return Trial(tuple(inside.ravel().tolist()), said, 1e6 * float(np.sqrt(np.mean(wrong**2))))


def _said(seed: int, *, what: str, command: str, kind: str = "", fault: str = "", word: str = "") -> Trial:
    """Whether a command says a word of an array on which something is wrong."""
    from imulab.errors import ImulabError
    from imulab.procedures.gyro_array.compare import compare_methods
    from imulab.procedures.gyro_array.fit import calibrate_array
    from imulab.procedures.gyro_array.fuse import fuse
    from imulab.procedures.gyro_array.stream import FuseOptions

    rng = np.random.default_rng([seed, 13])
    axes, n, count = (3 if kind == "swapped" else 1), 6, 4000
    sensing = _sensing(kind, axes, n, rng)
    still = _readings(np.zeros((count, axes)), sensing, rng)
    moving = _readings(_motion(count, axes, rng), sensing, rng)
    if fault == "mixed":
        still[:, :, :3] /= 180 / math.pi
        moving[:, :, :3] /= 180 / math.pi
    elif fault == "dead":
        still[:], moving[:] = still[0], still[0]
    elif fault == "coarse":
        still, moving = (0.061 * np.round(part / 0.061) for part in (still, moving))
    one = _recording(still if what == "rest" else moving, what)
    try:
        if command == "fuse":
            lines = list(fuse(one, FuseOptions()).notes)
        elif command == "compare":
            lines = list(compare_methods(one).warnings)
        else:
            lines = list(calibrate_array(_recording(still, "still"), _recording(moving, "moving")).calibration.warnings)
    except ImulabError as error:  # a refusal says it as well
        lines = [str(error)]
    return Trial((), any(word in line for line in lines))


def _rest(name: str, kind: str, axes: int, size: float, slow: float = 1.0, part: float = 0.0) -> Scenario:
    return Scenario(
        "Gyro array",
        name,
        partial(_calibrate, kind=kind, axes=axes, size=size, slow=slow, part=part),
        trials=10,
        coverage=(93.0, 100.0) if part > 0 else None,
        warned=95.0 if size > 0 else None,
        false_alarms=5.0 if size == 0 else None,
        unit="deg/s of bias" if part > 0 else "",
        source="u(bias) counts what a curve cannot show (docs/gyro_array_method.md): more than 97 % is no fault",
    )


def _word(name: str, word: str, *, false: bool = False, **how: str) -> Scenario:
    return Scenario(
        "Gyro array",
        name,
        partial(_said, word=word, **how),
        trials=10,
        coverage=None,
        warned=None if false else 95.0,
        false_alarms=5.0 if false else None,
    )


def _bend(name: str, bend: float, axes: int) -> Scenario:
    return Scenario(
        "Gyro array",
        f"{name}, {'one axis' if axes == 1 else 'three axes'}: scale factors",
        partial(_bent, bend=bend, axes=axes),
        trials=10,
        coverage=(93.0, 100.0) if bend else (93.0, 97.0),
        warned=95.0 if bend else None,
        false_alarms=None if bend else 5.0,
        unit="ppm",
        source="what the bend makes of the scale factors is in u whole, so that more than 97 % is no fault",
    )


SCENARIOS = [
    *[_bend("all elements linear", 0.0, axes) for axes in (1, 3)],
    *[
        _bend(f"element 3 not linear, {100 * bend:g} % at 200 deg/s", bend, axes)
        for bend in (2e-4, 1e-3, 6e-3)
        for axes in (1, 3)
    ],
    _rest("at rest, one axis", "same", 1, 0.0, part=1.0),
    _rest("at rest, three axes, mounted in any way", "any", 3, 0.0, part=1.0),
    _rest("moving by 70 deg/s, same mounting", "same", 3, 40.0),
    _rest("moving, every second element upside down", "alternate", 3, 40.0),
    _rest("moving, one axis, every second element reversed", "alternate", 1, 40.0),
    _rest("moving, mounted in any way", "any", 3, 40.0),
    _rest("swaying by 0.5 deg/s over 20 to 100 s, mounted in any way", "any", 3, 0.3, slow=13.0),
    _rest("moving after the first half, mounted in any way: the first half is used", "any", 3, 40.0, part=0.5),
    _word("x and y of element 3 interchanged, fuse", "x reads +y", what="moving", command="fuse", kind="swapped"),
    _word("x and y of element 3 interchanged, calibrate", "x reads +y", what="", command="calibrate", kind="swapped"),
    *[
        _word(f"three of six gyros in rad/s, {command} {what}", "unit", what=what, command=command, fault="mixed")
        for command, what in (("calibrate", ""), ("fuse", "rest"), ("fuse", "moving"), ("compare", "rest"))
    ],
    *[
        _word(f"all six gyros dead, {command}", "dead", what="rest", command=command, fault="dead")
        for command in ("calibrate", "fuse", "compare")
    ],
    _word("compare at rest, healthy: no word of motion", "follows only", false=True, what="rest", command="compare"),
    _word(
        "compare at rest, outputs in steps of the noise: no word of motion", "follows only", false=True, what="rest",
        command="compare", fault="coarse",
    ),
    _word("healthy in motion, fuse: nothing said", "", false=True, what="moving", command="fuse"),
]  # fmt: skip

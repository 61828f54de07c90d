"""Warm-up: wrong clocks, starts beyond the table, dead columns, and what is stated of a start in use."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
from _warmup_chamber import AXES, DEG_PER_HOUR, TEMPERATURES, Chamber
from scenario import Scenario, Trial

import imulab as il

_SMALL = (-20.0, 0.0, 20.0)
_MODEL = {"model": "knot-log-cubic", "settling_time": 300.0}


def _small(seed: int, change=None, **options):
    """Record of a small test, each cycle changed if asked for."""
    chamber = Chamber(cycles=2, scatter=0.0)
    cycles = chamber.test(seed, _SMALL)
    return il.fit_warmup(
        [r if change is None else change(r) for r in cycles], temperatures=_SMALL, **{**_MODEL, **options}
    )


def _columns(recording, **columns):
    return replace(recording, columns={**recording.columns, **columns})


def _milliseconds(recording):
    return _columns(recording, time=1e3 * recording.columns["time"])


def _stuck(recording):
    return _columns(recording, gyro_y=np.full(len(recording), recording.columns["gyro_y"][0]))


def _zeros(recording):
    gone = np.arange(len(recording)) % 50 == 7
    return _columns(recording, **{axis: np.where(gone, 0.0, recording.columns[axis]) for axis in AXES})


def _knocked(recording):
    x = recording.columns["gyro_x"].copy()
    x[500:510] += 3e4
    return _columns(recording, gyro_x=x)


_FAULTS = ("stuck", "never changes", "exactly zero", "unit of time", "unit moved", "differs from")


def fitted(change, word: str, seed: int) -> Trial:
    """Whether a fit refuses or names what was done to every cycle; any such fault where the word is empty."""
    try:
        record = _small(seed, change).calibration
    except il.ImulabError as error:
        return Trial(warned=word in str(error))
    words = (word,) if word else _FAULTS
    return Trial(warned=any(w in finding for w in words for finding in record.warnings))


def exchanged(swap: bool, cycles: int, seed: int) -> Trial:
    """Whether a fit names two set points whose power-on temperatures were exchanged."""
    rng = np.random.default_rng([seed, 15])
    tests = Chamber(cycles=cycles).test(seed)
    stated = [test.metadata["power_on_temperature"] for test in tests]
    a, b = rng.choice(len(TEMPERATURES), 2, replace=False) if swap else (0, 0)
    for number in range(cycles):
        i, j = a * cycles + number, b * cycles + number
        stated[i], stated[j] = stated[j], stated[i]
    tests = [
        replace(test, metadata={**test.metadata, "power_on_temperature": label}, name=f"{number}_{test.name}")
        for number, (test, label) in enumerate(zip(tests, stated, strict=True))
    ]
    return Trial(warned=any("exchanged" in line for line in il.fit_warmup(tests, **_MODEL).calibration.warnings))


def begun(late: float, seed: int) -> Trial:
    """Whether a fit says that all logs began late, where they hold a temperature."""
    chamber = Chamber(cycles=2, late=late, thermometer=True)
    warnings = il.fit_warmup(chamber.test(seed), temperatures=TEMPERATURES, **_MODEL).calibration.warnings
    return Trial(warned=any("logged from some time after power-on" in line for line in warnings))


def applied(change, word: str, seed: int) -> Trial:
    """Whether `apply` refuses a recording that was changed, and says why."""
    from imulab.procedures.apply import apply_blocks

    record = _small(seed).calibration
    start = change(Chamber(scatter=0.0).cycle(10.0, np.random.default_rng(10_000 + seed)))
    try:
        list(apply_blocks([record], [start]))
    except il.ImulabError as error:
        return Trial(warned=word in str(error))
    return Trial(warned=False)


def corrected(temperature: float, beyond: str, seed: int) -> Trial:
    """What is left of one start's curve, rms, deg/h."""
    chamber = Chamber(scatter=0.0)
    record = _small(seed, beyond=beyond).calibration
    start = chamber.cycle(temperature, np.random.default_rng(20_000 + seed))
    time = start.columns["time"]
    before = time < 300
    after = il.apply(record, start)
    bins = after.columns["gyro_x"] - after.columns["gyro_x"][~before].mean()
    smooth = bins[: 50 * (len(bins) // 50)].reshape(-1, 50).mean(axis=1)[time[::50][: len(bins) // 50] < 300]
    return Trial(error=float(np.sqrt(np.mean(smooth**2))))


def worst(bend: float, seed: int) -> Trial:
    """Whether the actual error at the worst power-on temperature is at most 1.4 times what the record states."""
    chamber = Chamber(bend=bend)
    fit = il.fit_warmup(chamber.test(seed), **_MODEL)
    record = fit.calibration
    time = np.arange(0.0, 600.0, 2.0)
    rng = np.random.default_rng(30_000 + seed)
    actual = 0.0
    for low, high in pairwise(TEMPERATURES):
        squares = []
        for _ in range(6):
            start = 0.5 * (low + high)
            curve = chamber.curve(time, start, 1 + chamber.repeat * rng.standard_normal(3))
            recording = il.Recording(
                columns={"time": time} | {axis: curve[:, i] for i, axis in enumerate(AXES)},
                units={"time": "s"} | dict.fromkeys(AXES, "deg/h"),
                metadata={"power_on_temperature": f"{start:g}"},
            )
            after = il.apply(record, recording)
            left = np.stack([after.columns[axis] for axis in AXES], axis=1)
            left = left - chamber.curve(time, start)[time >= 300].mean(axis=0)
            squares.append((left[time < 300] ** 2).mean(axis=0))
        actual = max(actual, float(np.sqrt(np.mean(squares, axis=0)).max()))
    said = max(record.value(f"worst_temperature_error_{axis}") for axis in AXES) / DEG_PER_HOUR
    return Trial((actual <= 1.4 * said,), False, actual / said)


def _refused(name: str, change, word: str) -> Scenario:
    return Scenario("Warm-up", name, partial(applied, change, word), 8, None, warned=95)


def _moved(offset: float, recording):
    return _columns(recording, time=recording.columns["time"] + offset)


def _backwards(recording):
    time = recording.columns["time"].copy()
    time[200] = time[198]
    return _columns(recording, time=time)


def _not_a_number(recording):
    time = recording.columns["time"].copy()
    time[200] = np.nan
    return _columns(recording, time=time)


def _hot(recording):
    return replace(recording, metadata={"power_on_temperature": "21.4"})


_STATED = "actual error at the worst temperature at most 1.4 times the stated one; rms error: actual over stated"
SCENARIOS = [
    Scenario("Warm-up", "fit: nothing wrong", partial(fitted, None, ""), 12, None, false_alarms=5),
    Scenario("Warm-up", "fit: ms titled as s", partial(fitted, _milliseconds, "unit of time"), 8, None, warned=95),
    Scenario("Warm-up", "fit: a stuck gyro", partial(fitted, _stuck, "never changes"), 8, None, warned=95),
    Scenario("Warm-up", "fit: a knock of 2 s, 8 deg/s", partial(fitted, _knocked, "moved"), 8, None, warned=95),
    Scenario("Warm-up", "fit: every 50th row zero", partial(fitted, _zeros, "exactly zero"), 8, None, warned=95),
    *[
        Scenario(
            "Warm-up", f"fit: {'two temperatures exchanged' if swap else 'no temperatures exchanged'}, {cycles} cycles",
            partial(exchanged, swap, cycles), 12, None, warned=95 if swap else None, false_alarms=None if swap else 5,
        )
        for cycles in (1, 3)
        for swap in (False, True)
    ],
    Scenario("Warm-up", "fit: logs begun in time, thermometer", partial(begun, 0.0), 8, None, false_alarms=5),
    Scenario("Warm-up", "fit: all logs begun 10 s late, thermometer", partial(begun, 10.0), 8, None, warned=95),
    _refused("apply: ms titled as s", _milliseconds, "unit of time"),
    _refused("apply: starts 20 s late", partial(_moved, 20.0), "after power-on"),
    _refused("apply: negative times", partial(_moved, -3.0), "before power-on"),
    _refused("apply: time runs backwards", _backwards, "row 201"),
    _refused("apply: a time that is not a number", _not_a_number, "row 201"),
    _refused("apply: 0.4 K beyond the table", _hot, "temperature"),
    Scenario(
        "Warm-up", "start 0.4 K beyond the table, --beyond hold", partial(corrected, 21.4, "hold"), 8, None,
        largest_error=12.0, unit="deg/h",
    ),
    Scenario(
        "Warm-up", "stated for the worst temperature, smooth law", partial(worst, 0.0), 8, (90.0, 100.0), unit="",
        source=_STATED,
    ),
    Scenario(
        "Warm-up", "stated for the worst temperature, bent law", partial(worst, 20.0), 8, (90.0, 100.0), unit="",
        source=_STATED,
    ),
]  # fmt: skip

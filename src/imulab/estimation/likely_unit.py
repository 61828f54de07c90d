"""Whether sensors can be in the unit that is stated for them, by gravity; and the unit that would explain it.

Accelerometers show gravity itself, gyroscopes how it turns in the body. At rest nothing tells the unit of gyroscopes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from imulab.columns import KINDS, kind_of, triad
from imulab.display import Finding, Note
from imulab.estimation.rows import median
from imulab.recording import Array, Recording
from imulab.units import STANDARD_GRAVITY, parse_unit, to_si

STATE_UNIT = "state the right unit by --unit, in the column's title or in a layout, and fit again"
ANOTHER_RANGE = "set the range that the driver assumes to that of the sensor, or state counts: --unit accel=count"
"""What to do where outputs are a simple fraction or multiple of what they should be."""
_NO_GRAVITY = 0.2  # relative: |f| at rest farther than this off g is no gravity, whatever the zeros of the sensor
_NEAR_STEP = 0.03  # relative: |f| at rest this near to g in another unit or range makes that the likely one
_NEAR_GRAVITY = 0.1  # relative: corrected |f| half the time this near to g in another unit makes that the right one
_ONE_DIRECTION = 3.0  # deg: a sensor that rests, or is on a centrifuge, turns by less
_ON_A_CENTRIFUGE = {("g", "m/s^2"), ("m/s^2", "mg")}  # units that 10 g and 100 g look like
_NO_SENSOR = 1000.0  # g: |f| is no more than this for half of a log
_AVERAGED = 0.1  # s: vibration is averaged over it; a turn hardly shortens f
MOST_SAMPLES, _FEWEST_TIMES = 100_000, 3  # samples that are used; of a log with a rate
_TURNING = 20  # tenths of a second that may show a turn
_AGREE = 0.6  # least correlation of the turns that rates and accelerometers show: 0.7 where a hand turns them
_TWICE = 2.0  # times its unit's, which the factor of the rates may be off: pushes at a turn's ends shrink it to 0.7
_UNITS = {unit: to_si(1.0, unit) for unit in ("m/s^2", "g", "mg")}
_OTHERS = {**_UNITS, "ft/s^2": 0.3048}
"""Units that accelerometers are logged in, in m/s^2; the last one must be converted before."""


def no_gravity(force: float, unit: str) -> Finding:
    """Return why |f| at rest, SI, is no gravity, and what would make it one; empty of gravity, counts and volts."""
    if parse_unit(unit).quantity != "acceleration" or abs(force / STANDARD_GRAVITY - 1) <= _NO_GRAVITY:
        return Finding("")
    shown = f"|f| at rest is {force / to_si(1.0, unit):.4g} {unit}, which is no gravity"
    ratio = force / STANDARD_GRAVITY
    if other := unit_instead(ratio, unit, _NEAR_STEP, _OTHERS):
        return Finding(f"{shown}, as {other} would be", STATE_UNIT)
    if ratio < _NEAR_STEP:
        action = "record the acceleration with gravity in it"
        return Finding(f"{shown}: was it taken off, as of a linear acceleration?", action)
    power = round(math.log2(ratio))
    if abs(ratio / 2.0**power - 1) < _NEAR_STEP:
        factor = f"{2**power} times" if power > 0 else f"1/{2**-power} of"
        return Finding(f"{shown}, but {factor} g, as counts or another range of the sensor would be", ANOTHER_RANGE)
    return Finding(shown, STATE_UNIT)


def unit_instead(ratio: float, unit: str, near: float, units: Mapping[str, float] = _UNITS) -> str:
    """Return the unit in which outputs that are `ratio` times g in a stated one are g within `near`; else nothing."""
    others = (other for other in units if other != unit)
    return next((other for other in others if abs(ratio * units[other] / to_si(1.0, unit) - 1) < near), "")


@np.errstate(over="ignore", invalid="ignore")  # of wild readings
def doubt_by_correction(recording: Recording, correct: Callable[[Recording], Recording]) -> str:
    """Return why the unit of accelerometers is doubtful: corrected, most of it would show gravity in another; or "".

    So it is of a sensor that rests, turns or is under way. A log at many g or in free fall, in its own unit, shows g in
    another by chance only, but for a centrifuge's 10 g and 100 g, which differ from 9.81 m/s^2 and 1000 m/s^2 (mg) by
    as much as biases do: a log of one direction gives a note.
    """
    unit = recording.triad_unit("accel")
    means = _short_means(recording)
    if parse_unit(unit).quantity != "acceleration" or not len(means):
        return ""
    force = means.triad("accel")
    usual = median(np.linalg.norm(force, axis=1))
    shown = f"accel_x .. accel_z: |f| is {usual:.4g} {unit}"
    for other in (other for other in _UNITS if other != unit):
        scaled = force * _UNITS[other] / to_si(1.0, unit)
        known = correct(means.with_columns(dict(zip(triad("accel"), scaled.T, strict=True)), {})).triad("accel")
        known = known[np.isfinite(known).all(axis=1)]  # a law over temperature knows none without it
        size = np.linalg.norm(known, axis=1)
        if not len(size) or not median(np.abs(size / STANDARD_GRAVITY - 1)) < _NEAR_GRAVITY:
            continue
        if (unit, other) in _ON_A_CENTRIFUGE and _widest_angle(known / size[:, None]) < _ONE_DIRECTION:
            return Note(f"{shown}; if the sensor is at rest, their unit is {other}, not {unit}: --unit accel={other}")
        return (
            f"{shown}, which is no gravity, as {other} would be; is their unit, {unit}, right? "
            f"--unit accel={other} states another"
        )
    if to_si(usual, unit) > _NO_SENSOR * STANDARD_GRAVITY:
        return f"{shown}, more than any accelerometer reads, as counts would be; is their unit, {unit}, right?"
    return ""


def doubt_rates(recording: Recording) -> str:
    """Return why the unit of corrected gyroscopes is doubtful: gravity turns as in another; or ""."""
    unit, time = recording.triad_unit("gyro"), recording.time
    if parse_unit(unit).quantity != KINDS["gyro"].quantity or time is None or len(time) < _FEWEST_TIMES:
        return ""
    force, rate = recording.triad("accel"), recording.triad("gyro")
    whole = np.isfinite(force).all(axis=1) & np.isfinite(rate).all(axis=1)
    step = median(np.diff(time))
    other = unit_by_turns(force[whole], rate[whole], step) if step > 0 else ""
    if not other or parse_unit(other).factor == parse_unit(unit).factor:
        return ""
    return (
        f"gyro_x .. gyro_z: gravity turns in the accelerometers as by rates in {other}; is their unit, {unit}, right? "
        f"--unit gyro={other} states another"
    )


@np.errstate(over="ignore", invalid="ignore")  # of wild readings
def unit_by_turns(force: Array, rate: Array, step: float) -> str:
    """Return the unit of rates, (n, 3), in which they explain how gravity turns in the body, or "".

    df/dt = -w x f, whatever the unit of f, (n, 3); samples are `step` s apart. The factor of the rates is that of least
    squares over all rows, both smoothed over a tenth of a second. These units are 57 times apart or more, and half and
    twice them are no scales of counts, as those of mrad/s are: of 8,399 parts of eight real recordings, 2 s or longer,
    it told 2,036, all rightly.
    """
    lag = max(1, round(0.1 / step))
    if len(force) < _TURNING * lag:
        return ""
    smooth = np.ones(lag) / lag
    f, w = (np.column_stack([np.convolve(c, smooth, "valid") for c in columns.T]) for columns in (force, rate))
    w = w - np.median(w, axis=0)
    change = (f[2 * lag :] - f[: -2 * lag]) / (2 * lag * step)
    turned = -np.cross(w, f)[lag:-lag]
    shared, of_rates, of_force = float((change * turned).sum()), float((turned**2).sum()), float((change**2).sum())
    if not of_rates or not of_force or not shared / np.sqrt(of_rates * of_force) >= _AGREE:
        return ""
    factor = shared / of_rates
    units = ("rad/s", "deg/s", "mdeg/s")
    return next((unit for unit in units if 1 / _TWICE < factor / parse_unit(unit).factor < _TWICE), "")


def _widest_angle(directions: Array) -> float:
    """Return the angle that one in ten directions, shape (n, 3), are farther off their mean, deg."""
    mean = directions.mean(axis=0)
    cosine = directions @ mean / max(float(np.linalg.norm(mean)), 1e-9)
    return float(np.degrees(np.arccos(np.clip(np.percentile(cosine, 10), -1, 1))))


def _short_means(recording: Recording) -> Recording:
    """Return means of accelerometers and temperatures over tenths of a second, without rows of no specific force."""
    kept = [name for name in recording.columns if kind_of(name) == "accel" or name.startswith("temperature")]
    rows = np.column_stack([recording.column(name)[:MOST_SAMPLES] for name in kept])
    rows = rows[np.isfinite(rows[:, [kept.index(name) for name in triad("accel")]]).all(axis=1)]
    time = recording.time
    step = 0.0 if time is None or len(time) < _FEWEST_TIMES else median(np.diff(time[:MOST_SAMPLES]))
    size = max(1, min(round(_AVERAGED / step), len(rows))) if step > 0 else 1
    means = rows[: len(rows) // size * size].reshape(-1, size, len(kept)).mean(axis=1)
    columns = dict(zip(kept, means.T, strict=True))
    return replace(recording, columns=columns, units={name: recording.units[name] for name in kept})

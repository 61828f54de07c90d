"""Noise models of logs at rest that are contaminated or wrongly read; simulated here, in the time domain."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from scenario import Scenario, Trial

DEG = math.pi / 180
RATE, COUNT = 100.0, 40_000
WHITE, FLICKER = 0.005 * DEG, 10 * DEG / 3600  # rad/s/sqrt(Hz), rad/s
SIGMA = WHITE * math.sqrt(RATE)
LSB = 250 / 32768 * DEG  # of a gyro for 250 deg/s with 16 bits
KELVIN = 0.002 * DEG  # rad/s
ODD = ("zeros", "stands in", "repeat the readings", "knock", "right?", "level changes", "not level", "spikes", "line")


def _slow(rng: np.random.Generator, count: int) -> np.ndarray:
    """1/f noise: white noise integrated by half, from long before the log on."""
    before = 2 * count
    k = np.arange(1, count + before)
    response = np.concatenate([[1.0], np.cumprod((k - 0.5) / k)])
    size = 1 << (2 * len(response)).bit_length()
    drawn = np.fft.rfft(rng.standard_normal(len(response)), size) * np.fft.rfft(response, size)
    return FLICKER * np.fft.irfft(drawn, size)[before : before + count]


def _wander(rng: np.random.Generator, count: int) -> np.ndarray:
    """A temperature that wanders by 2 K over 60 s, K."""
    p = math.exp(-1 / (60 * RATE))
    steps = 2 * math.sqrt(1 - p * p) * rng.standard_normal(count)
    kernel = p ** np.arange(min(count, int(600 * RATE)))
    size = 1 << (count + len(kernel)).bit_length()
    return 20 + np.fft.irfft(np.fft.rfft(steps, size) * np.fft.rfft(kernel, size), size)[:count]


def _disturbed(fault: str, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Samples of a gyro, rad/s, and its true white noise."""
    t = np.arange(COUNT) / RATE
    white = SIGMA * rng.standard_normal(COUNT)
    if fault == "filter":
        pole = math.exp(-2 * math.pi * 5 / RATE)
        kernel = (1 - pole) * pole ** np.arange(400)
        white = np.convolve(SIGMA * rng.standard_normal(COUNT + 400), kernel)[400 : COUNT + 400]
    x = white + _slow(rng, COUNT) + 0.2 * DEG
    if fault == "held":
        return np.repeat(x[: COUNT // 2], 2), WHITE * math.sqrt(2)
    if fault == "repeats":
        return x[np.floor(0.83 * np.arange(COUNT)).astype(int)], math.nan
    if fault == "zeros":
        x[rng.choice(COUNT, COUNT // 200, replace=False)] = 0.0
    elif fault == "knock":
        x[COUNT // 2 :] += np.where(t[: COUNT // 2] < 0.4, 4 * SIGMA, 0.0)
    elif fault == "spikes":
        struck = rng.choice(COUNT, COUNT // 1000, replace=False)
        x[struck] += 20 * SIGMA * rng.choice([-1, 1], len(struck))
        for frequency in (3.1, 17.0, 33.0):
            x += 0.5 * SIGMA * np.sin(2 * np.pi * frequency * t + rng.uniform(0, 6))
    elif fault == "step":
        x += np.where(t > t[-1] * rng.uniform(0.2, 0.8), 60 * DEG / 3600, 0.0)
    elif fault == "small step":
        x = white + np.where(t > t[-1] * rng.uniform(0.2, 0.8), 0.007 * DEG, 0.0)
    elif fault == "vibration":
        swing = 1 + 0.6 * np.sin(2 * np.pi * t / 50 + rng.uniform(0, 6))
        x += SIGMA * rng.uniform(1, 6) * swing * np.sin(2 * np.pi * rng.uniform(8, 15) * t)
    elif fault == "radians":
        return LSB * np.round(x / LSB) * DEG, math.nan
    return x, WHITE


def _fitted(columns: dict[str, np.ndarray]):
    import imulab as il

    time = np.arange(COUNT) / RATE
    units = {"time": "s", "gyro_x": "rad/s", "temperature": "degC"}
    log = il.Recording({"time": time, **columns}, {name: units[name] for name in ("time", *columns)}, name="log")
    return il.fit_noise(log).calibration


def _trial(seed: int, fault: str, word: str) -> Trial:
    rng = np.random.default_rng([seed, 20])
    samples, truth = _disturbed(fault, rng)
    record = _fitted({"gyro_x": samples})
    said = any(word in line for line in record.warnings) if word else any(
        odd in line for line in record.warnings for odd in ODD
    )  # fmt: skip
    if math.isnan(truth):
        return Trial((), said)
    found = record.parameter("gyro_x_white")
    return Trial((found.interval_95[0] <= truth <= found.interval_95[1],), said, 100 * (found.value / truth - 1))


def _drift(seed: int, slope: float) -> Trial:
    rng = np.random.default_rng([seed, 21])
    temperature = _wander(rng, COUNT)
    samples = SIGMA * rng.standard_normal(COUNT) + _slow(rng, COUNT) + slope * temperature
    record = _fitted({"gyro_x": samples, "temperature": temperature})
    (found,) = (each for each in record.fit["columns"]["gyro_x"]["drifts"] if each["follows"] == "temperature")
    size = found["slope"]
    held = abs(size["value"] - slope) < 1.96 * size["standard_uncertainty"]
    return Trial((held,), bool(found["significant"]), (size["value"] - slope) / DEG)


def _degrees(seed: int, rounded: bool) -> Trial:
    """Slope against a temperature that is logged in whole degrees, taken out."""
    import imulab as il

    rng = np.random.default_rng([seed, 22])
    time = np.arange(COUNT) / 20
    temperature = 25 + rng.uniform() + 2 * np.sin(2 * np.pi * time / 1500 + rng.uniform(0, 6))
    slope = 108 * DEG / 3600
    samples = WHITE * math.sqrt(20) * rng.standard_normal(COUNT) + slope * temperature
    shown = temperature + 0.02 * rng.standard_normal(COUNT)
    columns = {"time": time, "gyro_x": samples, "temperature": np.round(shown) if rounded else shown}
    log = il.Recording(columns, {"time": "s", "gyro_x": "rad/s", "temperature": "degC"}, name="log")
    record = il.fit_noise(log, regress="temperature").calibration
    (found,) = (each for each in record.fit["columns"]["gyro_x"]["drifts"] if each["follows"] == "temperature")
    off = found["slope"]["value"] - slope
    # A walk that is claimed, or a doubt of the fit, is no note; that steps hide something is one.
    said = record.verdict.state != "good" or record.model["terms"]["gyro_x"] != "N"
    return Trial((abs(off) < 1.96 * found["slope"]["standard_uncertainty"],), said, 3600 * off / DEG)


GRAVITIES = {"right": 9.80665, "half": 4.903, "twice": 19.61, "g read as m/s^2": 1.0, "counts": 16384 * 9.80665,
             "ft/s^2": 32.17, "none": 0.0}  # fmt: skip


def _gravity(seed: int, kind: str) -> Trial:
    """Whether a record of three accelerometers at rest, in m/s^2, is bad."""
    import imulab as il

    rng = np.random.default_rng([seed, 23])
    samples = 0.01 * rng.standard_normal((6000, 3)) + GRAVITIES[kind] * np.array([0.0, 0.6, 0.8])
    columns = {"time": np.arange(6000) / RATE} | {f"accel_{a}": samples[:, k] for k, a in enumerate("xyz")}
    log = il.Recording(columns, {n: "s" if n == "time" else "m/s^2" for n in columns}, name="log")
    return Trial((), il.fit_noise(log).calibration.verdict.state == "bad")


def _row(name: str, fault: str, word: str, coverage: tuple[float, float] | None = (92.0, 100.0)) -> Scenario:
    return Scenario(
        "Noise at rest",
        name,
        partial(_trial, fault=fault, word=word),
        trials=12,
        coverage=coverage,
        warned=95.0 if word else None,
        false_alarms=None if word else 5.0,
        unit="% of N" if coverage else "",
        source="of N; its interval allows for terms that do not show, so more than 97 % is no fault",
    )


SCENARIOS = [
    _row("N and B of a gyro, 400 s at 100 Hz", "", ""),
    _row("every reading logged twice: N of the sensor", "held", "stands in 2 rows"),
    _row("every sixth row a repeat", "repeats", "repeat the readings before", None),
    _row("0.5 % of the rows zeros for lost readings", "zeros", "exact zeros in 200 rows"),
    _row("a knock of 0.4 s, four sigma", "knock", "a knock or other part"),
    _row("0.1 % spikes of 20 sigma, three lines of half a sigma", "spikes", "spikes replaced"),
    _row("the level changes by 60 deg/h", "step", "the level changes by"),
    _row("behind the sensor's own filter of 5 Hz", "filter", "level", (88.0, 100.0)),
    _row("rad/s read as deg/s, a gyro of 16 bits", "radians", "right?", None),
    _row("a step of 25 deg/h, 10 u, that looks like a random walk", "small step", "the level changes by"),
    Scenario("Noise at rest", "vibration of 8 to 15 Hz that swings, one to six sigma: no change of level",
             partial(_trial, fault="vibration", word="level changes"), trials=12, coverage=None, false_alarms=5.0),
    *[
        Scenario("Noise at rest", f"accelerometers of 9.8 m/s^2, f: {kind}", partial(_gravity, kind=kind), trials=5,
                 coverage=None, warned=None if kind == "right" else 95.0,
                 false_alarms=5.0 if kind == "right" else None)
        for kind in GRAVITIES
    ],
    *[
        Scenario("Noise at rest", f"--regress temperature, {'in whole degrees' if rounded else 'fine'}: slope; no walk",
                 partial(_degrees, rounded=rounded), trials=12, coverage=(92.0, 100.0),
                 false_alarms=5.0, unit="(deg/h)/K")
        for rounded in (False, True)
    ],
    Scenario("Noise at rest", "a temperature that the gyro does not follow", partial(_drift, slope=0.0), trials=12,
             coverage=(92.0, 98.0), false_alarms=6.0, unit="(deg/s)/K"),
    Scenario("Noise at rest", "a gyro that follows its temperature by 0.002 (deg/s)/K", partial(_drift, slope=KELVIN),
             trials=12, coverage=(92.0, 98.0), warned=95.0, unit="(deg/s)/K"),
]  # fmt: skip

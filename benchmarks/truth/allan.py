"""Allan deviation: filters, lines, quantisation, clocks and rows, simulated in the time and frequency domain here."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from scenario import Scenario, Trial

DEG = math.pi / 180
ARW, BI = 0.3 * DEG / 60, 10.8 * DEG / 3600  # rad/s/sqrt(Hz), rad/s


def _flicker(n: int, size: float, rng: np.random.Generator) -> np.ndarray:
    lines = rng.standard_normal(n // 2) + 1j * rng.standard_normal(n // 2)
    lines *= size * np.sqrt(n * n / (4 * np.pi * np.arange(1, n // 2 + 1)))
    return np.fft.irfft(np.concatenate([[0], lines]), n)


def _sensor(n: int, rate: float, corner: float, rng: np.random.Generator) -> np.ndarray:
    """White noise, low-pass filtered where `corner` is not 0, and flicker; rad/s."""
    white = ARW * math.sqrt(rate) * rng.standard_normal(n)
    if corner:
        frequency = np.fft.rfftfreq(n, 1 / rate)
        pole = math.exp(-2 * math.pi * corner / rate)
        answer = (1 - pole) / (1 - pole * np.exp(-2j * np.pi * frequency / rate))
        white = np.fft.irfft(np.fft.rfft(white) * answer, n)
    return white + _flicker(n, BI, rng)


def _analysed(time: np.ndarray, samples: np.ndarray, unit: str = "s") -> tuple[dict, list[str]]:
    from imulab.estimation.column_noise import analyse
    from imulab.recording import Recording

    recording = Recording({"time": time, "gyro_x": samples}, {"time": unit, "gyro_x": "rad/s"}, name="still")
    found = analyse(recording)
    return found["columns"]["gyro_x"], found["warnings"]


def _trial(seed: int, *, fault: str, word: str, corner: float = 0.0, rate: float = 200.0) -> Trial:
    rng = np.random.default_rng([seed, 16])
    n = 120_000
    samples, time, unit = _sensor(n, rate, corner, rng), np.arange(n) / rate, "s"
    if fault == "line":
        samples += 5 * ARW * math.sqrt(rate) * np.sin(2 * np.pi * 17.3 * time)
    elif fault == "sway":
        wander = np.cumsum(rng.standard_normal(n)) * 0.3 / math.sqrt(rate)
        samples += 0.2 * DEG * np.sin(2 * np.pi * time / 25 + wander)
    elif fault == "coarse":
        step = 6 * ARW * math.sqrt(rate)
        samples = step * np.round(samples / step)
    elif fault == "ms as s":
        time = 1000 * time
    elif fault == "rate":
        time = np.cumsum(np.where(np.arange(n) < n // 3, 2.0, 1.0)) / rate
    elif fault == "bad row":
        samples[rng.integers(1, n)] = np.nan
    elif fault == "dead":
        samples[:] = 0.01
    column, warnings = _analysed(time, samples, unit)
    covered, error = [], math.nan
    for name, truth in (("angle_random_walk", ARW), ("bias_instability", BI)):
        value, u = column[name]["value"], column[name]["standard_uncertainty"]
        if value is None:
            continue
        covered.append(abs(value - truth) < 1.96 * u)
        if name == "angle_random_walk":
            error = 100 * (value / truth - 1)
    hits = [w for w in warnings if (word in w if word else "taken out" not in w)]
    return Trial(tuple(covered), bool(hits), error)


def _row(name: str, fault: str, word: str, *, states: bool = True, corner: float = 0.0, trials: int = 24) -> Scenario:
    clean = not word
    return Scenario(
        "Allan deviation",
        name,
        partial(_trial, fault=fault, word=word, corner=corner),
        trials=trials,
        coverage=(93.0, 100.0) if states else None,
        warned=None if clean else 95.0,
        false_alarms=5.0 if clean else None,
        unit="% of N" if states else "",
        source="B is bounded from above where it does not show, so more than 97 % is no fault",
    )


SCENARIOS = [
    _row("N and B of a gyro without a filter, 10 minutes at 200 Hz", "", ""),
    _row("behind a low-pass filter of 42 Hz", "", "correlated from sample to sample", corner=42.0),
    _row("behind a low-pass filter of 5 Hz", "", "correlated from sample to sample", corner=5.0),
    _row("a line of five sigma at 17.3 Hz, taken out", "line", "spectral lines"),
    _row("irregular sway of 0.2 deg/s: no number for B", "sway", "not that of the model", trials=10),
    _row("steps of six sigma: no number", "coarse", "steps that are", states=False, trials=30),
    _row("milliseconds labelled s", "ms as s", "unit of time", states=False, trials=10),
    _row("the rate doubles after a third", "rate", "sampling rate changes", trials=24),
    _row("one row without a number", "bad row", "bridged", trials=24),
    _row("a dead gyro", "dead", "dead sensor", states=False, trials=10),
]

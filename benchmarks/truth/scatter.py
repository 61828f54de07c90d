"""What scatters in a tumble test beyond white noise, and what only seems to: written apart from imulab's own models."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray
from scenario import Scenario, Trial

import imulab as il
from imulab.recording import Recording

G = 9.80665
UG = G * 1e-6
RATE, HOLD, MOVE = 50.0, 6.0, 2.0
NOISE = 300 * UG  # of a sample: 17 ug of the mean of a hold
NAMES = [f"{kind}_{axis}" for kind in ("bias", "scale_factor") for axis in "xyz"] + [
    f"misalignment_{pair}" for pair in ("yx", "zx", "zy")
]
GROUP = "Tumble: scatter"
Array = NDArray[np.float64]


def directions(rng: np.random.Generator, count: int) -> Array:
    """Return attitudes as a hand makes them: spread over the sphere, each off by some degrees, in no order."""
    index = np.arange(count) + 0.5
    height = 1 - 2 * index / count
    angle = np.pi * (1 + 5**0.5) * index + rng.uniform(0, 2 * np.pi)
    ring = np.sqrt(1 - height**2)
    u = np.column_stack([ring * np.cos(angle), ring * np.sin(angle), height]) + 0.1 * rng.standard_normal((count, 3))
    return rng.permutation(u / np.linalg.norm(u, axis=1)[:, None])


def outputs(force: Array, truth: dict[str, float], cross: Array) -> Array:
    """Return what the triad puts out: s = T f, A_x = s_x + k_xy s_x s_y (and y z, z x), M = S (A + b)."""
    s = force.copy()
    s[:, 1] += truth["misalignment_yx"] * force[:, 0]
    s[:, 2] += truth["misalignment_zx"] * force[:, 0] + truth["misalignment_zy"] * force[:, 1]
    a = s + cross / G * s * s[:, [1, 2, 0]]
    scale, bias = (np.array([truth[f"{kind}_{axis}"] for axis in "xyz"]) for kind in ("scale_factor", "bias"))
    return scale * (a + bias)


def flicker(rng: np.random.Generator, count: int, instability: float) -> Array:
    """Return noise of the spectrum B^2 / (2 pi f), shape (count, 3)."""
    f = np.fft.rfftfreq(count, 1 / RATE)
    size = np.zeros_like(f)
    size[1:] = np.sqrt(instability**2 / (2 * np.pi * f[1:]) * RATE * count / 2)
    spectrum = rng.standard_normal((len(f), 3)) + 1j * rng.standard_normal((len(f), 3))
    return np.fft.irfft(spectrum * size[:, None] / np.sqrt(2), count, axis=0)


def recording(
    rng: np.random.Generator, count: int, cross: float, wander: float, drift: float, shaking: float
) -> tuple[Recording, dict[str, float]]:
    """Return a recording of a unit turned through `count` attitudes, and the truth; sizes in units of g."""
    truth = {
        name: value * rng.standard_normal()
        for name, value in zip(NAMES, np.repeat([0.02 * G, 0.01, 0.01], 3), strict=True)
    }
    truth |= {f"scale_factor_{axis}": 1 + truth[f"scale_factor_{axis}"] for axis in "xyz"}
    hold, move = int(HOLD * RATE), int(MOVE * RATE)
    u = directions(rng, count)
    rows, still = [], []
    for here, there in zip(u, np.roll(u, -1, axis=0), strict=True):
        rows.append(np.repeat(here[None], hold, axis=0))
        path = here + np.linspace(0, 1, move)[:, None] * (there - here) + 0.05 * rng.standard_normal((move, 3))
        rows.append(path)
        still += [True] * hold + [False] * move
    force = G * np.vstack(rows)
    time = np.arange(len(force)) / RATE
    found = outputs(force, truth, cross * rng.choice([-1.0, 1.0], 3))
    found += NOISE * rng.standard_normal(found.shape)
    found += drift * G * np.outer(time / time[-1] - 0.5, rng.choice([-1.0, 1.0], 3))  # about the zero of the middle
    if wander:
        found += flicker(rng, len(found), wander * G)
    if shaking:
        # A building that moves: normal noise of all frequencies to 3 Hz.
        f = np.fft.rfftfreq(len(found), 1 / RATE)
        noise = np.fft.rfft(rng.standard_normal(found.shape), axis=0) * (f < 3.0)[:, None]
        moved = np.fft.irfft(noise, len(found), axis=0)
        found += shaking * G * moved / moved.std()
    columns = {"time": time, **{f"accel_{axis}": found[:, i] for i, axis in enumerate("xyz")}}
    return Recording(columns, {"time": "s", **{f"accel_{axis}": "m/s^2" for axis in "xyz"}}), truth


def trial(
    seed: int,
    *,
    count: int = 24,
    cross: float = 0.0,
    wander: float = 0.0,
    drift: float = 0.0,
    shaking: float = 0.0,
    order: int | str = 1,
    fit_cross: bool = False,
    sign: str = "",
) -> Trial:
    """Fit one recording; `sign` is what a warning that names the fault contains."""
    rng = np.random.default_rng([seed, count, int(1e7 * (cross + wander + drift + shaking))])
    made, truth = recording(rng, count, cross, wander, drift, shaking)
    record = il.fit_tumble(il.find_attitudes(made), order=order, gravity=G, cross=fit_cross).calibration
    factor = record.fit["coverage_factor_95"]
    covered = []
    for name in NAMES:
        p = record.parameters[name]
        covered.append(abs(p.value - truth[name]) <= factor * p.standard_uncertainty)
    error = np.sqrt(np.mean([(record.value(f"bias_{axis}") - truth[f"bias_{axis}"]) ** 2 for axis in "xyz"])) / UG
    patterns = ("function of the direction", "zeros drift", "scatter more than")
    warned = any(sign in w if sign else any(p in w for p in patterns) for w in record.warnings)
    return Trial(tuple(covered), warned, float(error))


def row(name: str, **options: float | int | str) -> Scenario:
    """Return a scenario of one disturbance."""
    limits = {key: options.pop(key) for key in ("coverage", "warned", "false_alarms", "trials") if key in options}
    return Scenario(GROUP, name, partial(trial, **options), unit="µg of bias", **({"trials": 120} | limits))


SCENARIOS = [
    row("white noise alone, 24 attitudes", trials=200, false_alarms=5.0),
    row("white noise alone, 48 attitudes", trials=120, count=48, false_alarms=5.0),
    row("flicker of 20 µg", wander=20e-6, trials=200),
    row("every zero drifts by 0.1 mg over the test", drift=100e-6, trials=200),
    row("vibration of 0.2 mg below 3 Hz", shaking=2e-4, trials=200),
    row(
        "cross-axis nonlinearity of 200 µg/g², 24 attitudes",
        cross=200e-6, coverage=None, warned=95.0, sign="function of the direction",
    ),
    row(
        "cross-axis nonlinearity of 200 µg/g², 48 attitudes",
        cross=200e-6, count=48, coverage=None, warned=95.0, sign="function of the direction",
    ),
    row("cross-axis nonlinearity of 200 µg/g², 48 attitudes, --cross", cross=200e-6, count=48, fit_cross=True),
    row(
        "cross-axis nonlinearity of 200 µg/g², 48 attitudes, --order auto",
        cross=200e-6, count=48, order="auto", coverage=None, warned=95.0, sign="function of the direction", trials=60,
    ),
]  # fmt: skip

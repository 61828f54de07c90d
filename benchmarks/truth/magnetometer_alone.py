"""Magnetometers alone, waved by hand or turned level, and what hands and rooms do to them."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray
from scenario import Scenario, Trial

import imulab as il
from imulab.display import Note

GROUP = "Magnetometers alone"
FIELD, NOISE, RATE = 48.0, 0.3, 20.0  # uT, uT, Hz
Array = NDArray[np.float64]


def waved(count: int, rng: np.random.Generator) -> Array:
    """Return directions of the field in a body that a hand waves about: slow turns about axes that wander."""
    time = np.arange(count) / RATE
    sway = [sum(rng.normal() * np.sin(w * time + rng.uniform(0, 6.28)) for w in (0.3, 0.7, 1.1)) for _ in range(3)]
    polar = np.arccos(np.clip(np.sin(0.13 * time + 0.3 * sway[0]), -1, 1))
    turn = 1.7 * time + sway[1] + 0.2 * sway[2]
    return np.column_stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)])


def level(count: int, rng: np.random.Generator) -> Array:
    """Return directions in a body that turns level twice and a half around, a little unevenly."""
    turn = np.linspace(0, 5 * np.pi, count) + 0.2 * np.sin(np.linspace(0, 20, count)) + rng.uniform(0, 6.28)
    dip = 1.1
    return np.column_stack([np.cos(dip) * np.cos(turn), -np.cos(dip) * np.sin(turn), np.full(count, -np.sin(dip))])


def trial(seed: int, *, flat: bool = False, what: str = "", size: float = 0.0) -> Trial:
    """Fit one recording of one sensor; quantities are its hard iron and its soft iron."""
    rng = np.random.default_rng(seed)
    count = 700
    hard, lower = rng.normal(0, 25, 3), np.eye(3) + np.tril(rng.normal(0, 0.04, (3, 3)))
    soft = lower @ lower.T
    soft /= np.cbrt(np.linalg.det(soft))  # outputs are right on the average, as without a stated field
    axes = 2 if flat else 3
    if flat:
        soft[:2, 2] = soft[2, :2] = 0.0
        soft[:2, :2] /= np.sqrt(np.linalg.det(soft[:2, :2]))
    directions = level(count, rng) if flat else waved(count, rng)
    field = FIELD * directions
    noise = NOISE * rng.standard_normal((count, 3))
    if what == "phone":
        field[count // 2 :] += size * np.array([0.6, -0.5, 0.62])
    outputs = field @ soft.T + hard
    if what == "steel":  # a table leg that the hand comes by, fixed in the room
        near = np.exp(-0.5 * ((np.arange(count) - count // 3) / 12) ** 2)
        outputs += size * near[:, None] * directions[:, ::-1]
    if what == "slow noise":  # each value the mean of those of a second
        slow = np.cumsum(rng.standard_normal((count + int(RATE), 3)), axis=0)
        noise += size * (slow[int(RATE) :] - slow[: -int(RATE)]) / np.sqrt(RATE)
    if what == "wander":
        walk = np.cumsum(rng.standard_normal((count, 3)), axis=0)
        noise += size * (walk - walk.mean(axis=0)) / walk.std(axis=0)
    outputs += noise
    if what == "repeated":
        outputs = outputs[np.arange(count) // int(size) * int(size)]
    if what == "clipped":
        limit = np.quantile(outputs[:, 0], 1 - size)
        outputs[:, 0] = np.minimum(outputs[:, 0], limit)
    columns = {"time": np.arange(count) / RATE, **{f"mag_{a}": outputs[:, k] for k, a in enumerate("xyz")}}
    recording = il.Recording(
        columns, {"time": "s", **dict.fromkeys(("mag_x", "mag_y", "mag_z"), "uT")}, name="hand.csv"
    )
    try:
        record = il.fit_magnetometer(recording).calibration
    except il.ImulabError:
        return Trial(warned=True)
    warned = any(not isinstance(each, Note) for each in record.warnings) or record.verdict.state != "good"
    scale = FIELD * np.cos(1.1) if flat else FIELD
    names = [f"mag_bias_{a}" for a in "xyz"[:axes]]
    truth = [*(1e-6 * hard[:axes])]
    # Soft iron by its ratios, which do not depend on how the length of the field is taken.
    covered = [
        abs(record.value(n) - t) < 1.96 * record.parameters[n].standard_uncertainty
        for n, t in zip(names, truth, strict=True)
    ]
    for i in range(axes):
        for j in range(i, axes):
            name = f"mag_soft_{'xyz'[i]}{'xyz'[j]}"
            found = record.value(name) * (scale * 1e-6 if record.parameters[name].unit == "T" else 1.0)
            covered.append(abs(found - soft[i, j]) < 1.96 * record.parameters[name].standard_uncertainty)
    error = 1e6 * record.value("mag_bias_x") - hard[0]
    return Trial(tuple(map(bool, covered)), warned, float(error))


def row(name: str, **options: object) -> Scenario:
    """Return a scenario of one disturbance."""
    asked = {key: options.pop(key) for key in ("coverage", "warned", "false_alarms", "largest_error") if key in options}
    return Scenario(GROUP, name, partial(trial, **options), trials=60, unit="µT of bias_x", **asked)  # type: ignore[arg-type]


SCENARIOS = [
    row("waved, nothing disturbed", false_alarms=4.0),
    row("turned level, nothing disturbed", flat=True, false_alarms=4.0),
    row("each reading in three rows", what="repeated", size=3),
    row("noise of 0.3 uT slow over 1 s", what="slow noise", size=0.3, coverage=(88.0, 100.0)),
    row("a field that wanders by 0.3 uT over the time", what="wander", size=0.3, coverage=None),
    row("a table leg of 10 uT for a second", what="steel", size=10.0, largest_error=0.3, coverage=(88.0, 100.0)),
    row("a phone of 3 uT from the middle on", what="phone", size=3.0, coverage=None, warned=95.0),
    row("x clipped in 8 % of the readings", what="clipped", size=0.08, coverage=None, warned=95.0),
]

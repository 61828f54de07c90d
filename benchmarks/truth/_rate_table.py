"""A triad of gyroscopes on a rate table, by plain equations: nothing of the package."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

EARTH = 7.292115e-5
LATITUDE = np.radians(48.1)
UP = [0, 10, 50, 100, 200, 300, 200, 100, 50, 10, 0]
WAY = np.array([*UP, *[-rate for rate in UP[1:]]], dtype=float)


@dataclass(frozen=True)
class Table:
    """What is disturbed: width of a loop at rate 0 over the largest rate, its shape; a walk of zeros, deg/s/sqrt(s)."""

    loop: float = 0.0
    shape: str = "ellipse"
    walk: float = 0.0
    drift: float = 0.0
    cycles: int = 1
    noise: float = 0.05
    hold: float = 5.0
    rate: float = 50.0


@dataclass(frozen=True)
class Triad:
    """A unit: scale factors, zeros in rad/s, and unit-diagonal misalignment."""

    scale: np.ndarray
    zero: np.ndarray
    turn: np.ndarray


def triad(rng: np.random.Generator) -> Triad:
    """A unit as they come: scale factors to 0.5 %, zeros of 0.2 deg/s, misalignments of 10 mrad."""
    turn = np.eye(3) + 0.01 * rng.standard_normal((3, 3)) * (1 - np.eye(3))
    return Triad(1 + 0.005 * rng.standard_normal(3), np.radians(0.2) * rng.standard_normal(3), turn)


def commanded(table: Table) -> tuple[np.ndarray, np.ndarray]:
    """Rate of the table, deg/s, and the branch: 1 where the rate was last raised, -1 where lowered; shape (n,)."""
    rates, branches = [], []
    before, branch = WAY[0], 1.0
    for target in WAY:
        if target != before:
            branch = np.sign(target - before)
            ramp = np.linspace(before, target, max(2, round(abs(target - before) / 100 * table.rate)))
            rates.append(ramp)
            branches.append(np.full(len(ramp), branch))
        rates.append(np.full(round(table.hold * table.rate), target))
        branches.append(np.full(len(rates[-1]), branch))
        before = target
    return np.concatenate(rates), np.concatenate(branches)


def run(rng: np.random.Generator, unit: Triad, table: Table, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Time, s, and outputs, deg/s, (n, 3), of a run with one body axis up."""
    w, branch = commanded(table)
    rate, angle = np.radians(w), np.cumsum(np.radians(w)) / table.rate
    time = np.arange(len(w)) / table.rate
    body = np.zeros((len(w), 3))
    body[:, axis] = rate + EARTH * np.sin(LATITUDE)
    body[:, (axis + 1) % 3] = EARTH * np.cos(LATITUDE) * np.cos(angle)
    body[:, (axis + 2) % 3] = -EARTH * np.cos(LATITUDE) * np.sin(angle)
    x = np.abs(w) / np.abs(WAY).max()
    half = {"ellipse": 1 - x**2, "play": (x < 0.999).astype(float), "triangle": 1 - x}[table.shape]
    felt = body @ unit.turn.T
    felt[:, axis] += table.loop / 2 * np.radians(np.abs(WAY).max()) * half * branch
    walk = np.cumsum(np.radians(table.walk) / np.sqrt(table.rate) * rng.standard_normal(felt.shape), axis=0)
    drift = (1 + table.drift * (time / time[-1] - 0.5))[:, None]
    out = np.degrees(unit.scale * (felt + unit.zero + walk) * drift)
    return time, out + table.noise * rng.standard_normal(out.shape)

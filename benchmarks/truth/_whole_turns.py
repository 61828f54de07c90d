"""A unit that is turned by hand against a fence, by plain equations: nothing of the package."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

EARTH, G = 7.292115e-5, 9.81
LATITUDE = np.radians(48.0)


@dataclass(frozen=True)
class Hand:
    """How the turns are made: whole turns in order, fence and tilt in deg, share of samples lost, noise in deg/s."""

    turns: tuple[int, ...] = (1, 1, 1, -1, -1, -1)
    fence: float = 0.5
    tilt: float = 0.0
    lost: float = 0.0
    noise: float = 0.05
    duration: float = 4.0
    wait: float = 3.0
    rate: float = 100.0


@dataclass(frozen=True)
class Unit:
    """Scale factors, zeros in rad/s, and misalignment with a diagonal of ones."""

    scale: np.ndarray
    zero: np.ndarray
    turn: np.ndarray


def unit(rng: np.random.Generator) -> Unit:
    """A unit as they come."""
    turn = np.eye(3) + 0.01 * rng.standard_normal((3, 3)) * (1 - np.eye(3))
    return Unit(1 + 0.005 * rng.standard_normal(3), np.radians(0.2) * rng.standard_normal(3), turn)


def session(
    rng: np.random.Generator, triad: Unit, hand: Hand, axes: tuple[int, ...] = (2,)
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, s, outputs, deg/s, and specific force, m/s^2, of turns about one body axis after the other, (n, 3)."""
    gyro, force = [], []
    for axis in axes:
        stop = np.radians(hand.fence) / np.sqrt(2) * rng.standard_normal(len(hand.turns) + 1)
        still = np.zeros(round(hand.wait * hand.rate))
        parts = [still]
        for k, number in enumerate(hand.turns):
            whole = 2 * np.pi * number + stop[k + 1] - stop[k]
            count = round(hand.duration * abs(number) * hand.rate)
            x = np.arange(1, count + 1) / count
            angle = whole * (x**3 * (10 - 15 * x + 6 * x**2))
            parts += [np.diff(angle, prepend=0.0) * hand.rate, still]
        w = np.concatenate(parts)
        up = np.zeros(3)
        lean = np.radians(hand.tilt)
        up[axis], up[(axis + 1) % 3] = np.cos(lean), np.sin(lean)
        east = np.cross(up, np.roll(up, 1))
        east /= np.linalg.norm(east)
        north = np.cross(up, east)
        heading = rng.uniform(0, 2 * np.pi) + np.cumsum(w) / hand.rate
        level = np.cos(heading)[:, None] * north - np.sin(heading)[:, None] * east
        rate = w[:, None] * up + EARTH * (np.sin(LATITUDE) * up + np.cos(LATITUDE) * level)
        gyro.append(np.degrees(triad.scale * (rate @ triad.turn.T + triad.zero)))
        force.append(np.tile(G * up, (len(w), 1)))
        if axis != axes[-1]:  # carried to the next attitude
            move = round(1.0 * hand.rate)
            gyro.append(np.degrees(0.8 * np.sin(np.pi * np.arange(move) / move))[:, None] * np.array([1.0, -1.0, 0.5]))
            force.append(np.tile(G * np.ones(3) / np.sqrt(3), (move, 1)))
    out, felt = np.vstack(gyro), np.vstack(force)
    out = out + hand.noise * rng.standard_normal(out.shape)
    felt = felt + 3e-3 * G * rng.standard_normal(felt.shape)
    kept = rng.random(len(out)) >= hand.lost
    out, felt = out[kept], felt[kept]
    return np.arange(len(out)) / hand.rate, out, felt

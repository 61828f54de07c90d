"""Gyroscopes on a rate table, transcribed apart: samples of steps of rate, and Earth's rate as the table turns.

M_i = S_i (A_i + b_i), A_i = s_i + k2 s_i^2 + k3 s_i^3, s = T w (IEEE Std 528 terms); the Earth's rate has the axial
part Omega sin(latitude) upward and a level part that turns against the table.
"""

import math

import numpy as np

OMEGA = 2 * math.pi / 86164.0905  # a sidereal day
DEGREE = math.pi / 180


def steps(rates, hold, frequency):
    """Rate of the table, rad/s, for rates in deg/s held one after the other, without ramps."""
    return np.repeat(np.asarray(rates, dtype=float) * DEGREE, round(hold * frequency))


def outputs(table, frequency, axis, sign, scale, turn, bias, powers=(), latitude=None, noise=0.0, rng=None):
    """Outputs of three gyroscopes, rad/s, while body axis `axis` (0 to 2) points up (1) or down (-1) on the table."""
    body = []
    angle = 0.0
    for rate in table:
        up, one, two = rate, 0.0, 0.0
        if latitude is not None:
            up += OMEGA * math.sin(latitude)
            one = OMEGA * math.cos(latitude) * math.cos(angle)
            two = -OMEGA * math.cos(latitude) * math.sin(angle)
        angle += rate / frequency
        w = [0.0, 0.0, 0.0]
        w[axis] = sign * up
        w[(axis + 1) % 3], w[(axis + 2) % 3] = one, sign * two
        body.append(w)
    s = np.array([[sum(turn[i][j] * w[j] for j in range(3)) for i in range(3)] for w in body])
    a = s + sum(np.asarray(k) * s ** (p + 2) for p, k in enumerate(powers))
    out = np.asarray(scale) * (a + np.asarray(bias))
    return out if rng is None else out + noise * rng.standard_normal(out.shape)


def mounted(table, frequency, axis, arm, tilt=0.0):
    """Body rate and specific force of a unit on a table about `axis` (3,), which is off level by `tilt` rad, at `arm`.

    ``f = g u + w x (w x r) + w' x r``: the upward direction u goes round the table axis as the table turns under it.
    """
    axis = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    one = np.cross(axis, [0.3, 0.5, 0.8])
    one /= np.linalg.norm(one)
    two = np.cross(axis, one)
    angle = np.cumsum(table) / frequency
    up = axis + tilt * (np.cos(angle)[:, None] * one - np.sin(angle)[:, None] * two)
    rate = np.asarray(table)[:, None] * axis
    force = 9.80665 * up / np.linalg.norm(up, axis=1)[:, None] + np.cross(rate, np.cross(rate, arm))
    return rate, force + np.cross(np.gradient(rate, axis=0) * frequency, arm)


def hand_turns(axes, counts, frequency, arm, tilt=0.0, speed=120.0, stops=None):
    """Body rate and specific force of a unit turned `counts` times each on faces z, x and y, with rests of 3 s.

    `axes` (3, 3): rows are the vertical in the body on each of these faces; between them the unit is tipped by 90 deg.
    """
    rates, forces = [], []
    rest, number = np.zeros(round(3 * frequency)), 0
    for face, axis in enumerate(axes):
        parts = [rest]
        for count in counts:
            angle = 360.0 * count + (0.0 if stops is None else stops[number])
            number += 1
            length = round(abs(angle) / speed * frequency)
            shape = np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 2
            parts += [angle * DEGREE * shape / shape.sum() * frequency, rest]
        table = np.concatenate(parts)
        rate, force = mounted(table, frequency, axis, arm, tilt)
        unit = np.asarray(axis) / np.linalg.norm(axis)
        force = force + np.gradient(table)[:, None] * frequency * np.cross(unit, arm)
        rates.append(rate)
        forces.append(force)
        if face < 2:
            tip, length = np.array([0.0, -1.0, 0.0] if face == 0 else [0.0, 0.0, -1.0]), round(frequency)
            shape = np.sin(np.pi * (np.arange(length) + 0.5) / length)
            rates.append(np.pi / 2 * (shape / shape.sum() * frequency)[:, None] * tip)
            share = np.linspace(0, 1, length)[:, None]
            between = (1 - share) * np.asarray(axes[face]) + share * np.asarray(axes[face + 1])
            forces.append(9.80665 * between / np.linalg.norm(between, axis=1)[:, None])
    return np.vstack(rates), np.vstack(forces)


def wobbling_turns(counts, frequency, wobble, rounds, stops, speed=180.0, rest=1.5):
    """Body rate of a unit that is turned by hand, rests between, while its axis cones at `wobble` deg.

    The attitude is ``Rz(psi) Rx(alpha) Ry(beta)``, ``alpha = d sin(m psi)``, ``beta = d cos(m psi)``, m rounds a turn;
    d, which is 0 at the rests, is `wobble` in between. Stops are off by `stops`, deg.
    """
    still = np.zeros((round(rest * frequency), 3))
    parts = [still]
    for k, count in enumerate(counts):
        whole = (360.0 * count + stops[k + 1] - stops[k]) * DEGREE
        duration = round(2 * abs(whole) / (speed * DEGREE) * frequency) / frequency
        u = np.arange(1, round(duration * frequency)) / frequency / duration
        psi, turn = whole * (u - np.sin(2 * np.pi * u) / (2 * np.pi)), whole / duration * (1 - np.cos(2 * np.pi * u))
        d = wobble * DEGREE * (1 - np.cos(np.pi * u) ** 8)
        grows = wobble * DEGREE * 8 * np.pi / duration * np.cos(np.pi * u) ** 7 * np.sin(np.pi * u)
        sine, cosine = np.sin(rounds * psi), np.cos(rounds * psi)
        a, b = d * sine, d * cosine
        of_a, of_b = grows * sine + d * rounds * turn * cosine, grows * cosine - d * rounds * turn * sine
        x = of_a * np.cos(b) - turn * np.cos(a) * np.sin(b)
        y = of_b + turn * np.sin(a)
        z = of_a * np.sin(b) + turn * np.cos(a) * np.cos(b)
        parts += [np.column_stack([x, y, z]), still]
    return np.vstack(parts)

"""Recordings of six axes over temperature, written apart from the package: attitudes at rest and turns between them.

Gyroscopes: M = S(T) (T w + b(T) + G f), IEEE Std 528 for the acceleration-sensitive drift.
"""

import numpy as np

from reference.thermal import Triad, directions, natural_spline

G = 9.81


class Gyros:
    """Bias (rad/s) and scale factor as polynomials of (T - 20 degC), misalignment and g-sensitivity constant."""

    def __init__(self, rng, scale_per_kelvin=0.0, sensitivity=3.6e-5):
        sizes = np.radians([1.0, 0.03, 2e-4, 2e-6])
        self.bias = sizes[:, None] * rng.standard_normal((4, 3))
        self.scale = np.array([1 + 0.02 * rng.standard_normal(3), scale_per_kelvin * rng.standard_normal(3)])
        self.matrix = np.eye(3) + 0.01 * rng.standard_normal((3, 3)) * (1 - np.eye(3))
        self.sensitivity = sensitivity * rng.standard_normal((3, 3))

    def bias_at(self, temperature):
        """(n, 3)."""
        t = np.atleast_1d(temperature)[:, None] - 20.0
        return sum(self.bias[k] * t**k for k in range(4))

    def scale_at(self, temperature):
        """(n, 3)."""
        return self.scale[0] + self.scale[1] * (np.atleast_1d(temperature)[:, None] - 20.0)

    def output(self, rate, force, temperature, offset=0.0):
        """Outputs (n, 3) for rates and specific forces (n, 3)."""
        sensed = rate @ self.matrix.T + force @ self.sensitivity.T
        return self.scale_at(temperature) * (sensed + self.bias_at(temperature) + offset)

    def correct(self, output, force, temperature):
        """Rate (3,) of one output: the model inverted by hand."""
        scaled = output / self.scale_at(temperature)[0] - self.bias_at(temperature)[0] - self.sensitivity @ force
        return np.linalg.solve(self.matrix, scaled)


class BentGyros(Gyros):
    """Gyroscopes whose biases have more than a cubic: a kink of 0.025 deg/s/K, bends of some 25 K, or own splines."""

    def __init__(self, rng, law, knots=(), **sizes):
        super().__init__(rng, **sizes)
        self.law, self.knots = law, knots
        self.place, self.sign = rng.uniform(0, 40), rng.choice([-1.0, 1.0], 3)
        self.size, self.phase = rng.uniform(0.3, 1.0, 3), rng.uniform(0, 2 * np.pi, 3)
        self.values = np.radians(0.5) * rng.standard_normal((3, len(knots)))

    def bias_at(self, temperature):
        """(n, 3)."""
        t = np.atleast_1d(temperature)
        if self.law == "spline":
            return np.array([[natural_spline(self.knots, own, each) for own in self.values.tolist()] for each in t])
        bias = super().bias_at(t)
        if self.law == "kink":
            bias = bias + np.radians(0.025) * self.sign * np.maximum(t - self.place, 0.0)[:, None]
        elif self.law == "rough":
            bias = bias + np.radians(0.03) * self.size * np.sin(t[:, None] / 8.0 + self.phase)
        return bias


def turned(up, axis, angle):
    """Directions `up`, (3,) or (n, 3), turned about a unit vector by angles (n,): Rodrigues' formula."""
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return up * c + np.cross(axis, up) * s + axis * np.reshape(up @ axis, (-1, 1)) * (1 - c)


EARTH = 7.292115e-5


def motion(rng, count, hold=6.0, turn=2.0, rate=50.0, earth=0.0, latitude=None):
    """Time, upward direction (n, 3) and rate of the body (n, 3), rad/s: attitudes with a smooth turn between two.

    In holds a rate of size `earth` in any direction; or, at a `latitude`, the Earth's rate all the time, in headings
    that the unit takes at random by a twist about up in each turn.
    """
    points = directions(rng, count)
    points = points[rng.permutation(count)]
    up, rates, norths = [], [], []
    if latitude is not None:
        level = np.cross(points[0], rng.standard_normal(3))
        north = level / np.linalg.norm(level)
    resting, moving = round(hold * rate), round(turn * rate)
    for k in range(count):
        about = earth * rng.standard_normal(3) / np.sqrt(3)
        up.append(np.tile(points[k], (resting, 1)))
        rates.append(np.tile(about, (resting, 1)))
        if latitude is not None:
            norths.append(np.tile(north, (resting, 1)))
        if k + 1 < count:
            axis = np.cross(points[k], points[k + 1])
            angle = np.arctan2(np.linalg.norm(axis), points[k] @ points[k + 1])
            axis /= np.linalg.norm(axis)
            share = np.arange(moving) / moving
            angles = angle * (share - np.sin(2 * np.pi * share) / (2 * np.pi))
            speed = angle / turn * (1 - np.cos(2 * np.pi * share))
            up.append(turned(points[k], axis, angles))
            rates.append(-speed[:, None] * axis)
            if latitude is not None:
                twist = rng.uniform(-np.pi, np.pi)
                rates[-1] = rates[-1] + twist / angle * speed[:, None] * up[-1]
                whole = np.append(angles, angle)
                carried = turned(turned(north, points[k], -twist / angle * whole), axis, whole)
                norths.append(carried[:-1])
                north = carried[-1]
    up, rates = np.vstack(up), np.vstack(rates)
    if latitude is not None:
        rates = rates + EARTH * (np.sin(latitude) * up + np.cos(latitude) * np.vstack(norths))
    return np.arange(len(up)) / rate, up, rates


def columns(triad, gyros, rng, temperature, time, up, rates, noise=0.0, accel_noise=0.0, offset=0.0, accel_offset=0.0):
    """Columns of one recording, SI; the temperature (n,) or a number."""
    temperature = np.broadcast_to(np.asarray(temperature, dtype=float), (len(time),))
    places, where = np.unique(temperature, return_inverse=True)
    b, s, m = (np.array([triad.at(t)[k] for t in places])[where] for k in range(3))
    shaken = (np.linalg.norm(rates, axis=1) > 1e-3)[:, None] * 0.4 * np.sin(37.0 * time)[:, None]
    f = G * up + shaken
    sensed = np.stack([f[:, 0], m[:, 0] * f[:, 0] + f[:, 1], m[:, 1] * f[:, 0] + m[:, 2] * f[:, 1] + f[:, 2]], axis=1)
    accel = s * (sensed + b + accel_offset) + accel_noise * rng.standard_normal(f.shape)
    gyro = gyros.output(rates, f, temperature, offset) + noise * rng.standard_normal(f.shape)
    found = {"time": time, "temperature": temperature}
    found |= {f"accel_{a}": accel[:, k] for k, a in enumerate("xyz")}
    return found | {f"gyro_{a}": gyro[:, k] for k, a in enumerate("xyz")}


def chamber(rng, temperatures, count=8, gyros=None, turn_on=0.0, earth=0.0, noise=0.0, accel_noise=1e-5, **sizes):
    """The triads and the columns of a recording at each temperature; `turn_on` in rad/s."""
    triad, gyros = Triad(rng), gyros or Gyros(rng)
    made = []
    for temperature in temperatures:
        time, up, rates = motion(rng, count, earth=earth, **sizes)
        offset = turn_on * rng.standard_normal(3)
        made.append(columns(triad, gyros, rng, temperature, time, up, rates, noise, accel_noise, offset))
    return triad, gyros, made

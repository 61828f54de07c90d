"""Simulated holds of an accelerometer triad over temperature, and its laws, written apart from the package.

Source of the sizes: MEMS data sheets; the model is that of IEEE Std 1293 with parameters that follow temperature.
"""

import numpy as np

G = 9.81


class Triad:
    """Bias b (m/s^2), scale factor S, misalignment m, each a polynomial of (T - 20 degC) with rows of coefficients."""

    def __init__(self, rng, degrees=(3, 2, 1)):
        sizes = (
            (0.05 * G, 3e-4 * G, 4e-6 * G, 4e-8 * G),
            (0.02, 1e-4, 1e-6, 0.0),
            (0.02, 1e-5, 0.0, 0.0),
        )
        self.laws = [
            [[size * rng.standard_normal() * (k <= degree) for k, size in enumerate(row)] for _ in range(3)]
            for row, degree in zip(sizes, degrees, strict=True)
        ]
        for law in self.laws[1]:
            law[0] += 1.0

    def at(self, temperature):
        """Bias, scale factor, misalignment at a temperature: three lists of three numbers."""
        t = temperature - 20.0
        return [[sum(c * t**k for k, c in enumerate(law)) for law in group] for group in self.laws]

    def output(self, force, temperature, offset=(0.0, 0.0, 0.0)):
        """Output for one specific force (3,) at one temperature."""
        b, s, (yx, zx, zy) = self.at(temperature)
        fx, fy, fz = force
        sensed = (fx, yx * fx + fy, zx * fx + zy * fy + fz)
        return np.array([s[i] * (sensed[i] + b[i] + offset[i]) for i in range(3)])

    def correct(self, output, temperature):
        """Specific force of one output: the model inverted by hand."""
        b, s, (yx, zx, zy) = self.at(temperature)
        x = output[0] / s[0] - b[0]
        y = output[1] / s[1] - b[1] - yx * x
        z = output[2] / s[2] - b[2] - zx * x - zy * y
        return np.array([x, y, z])


def directions(rng, count):
    """Upward directions spread over the sphere (golden spiral) and turned at random."""
    k = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * k / count), np.pi * (1 + 5**0.5) * k
    points = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1)
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    return points @ (q * np.sign(np.diag(r))).T


def soak(triad, rng, temperature, count, noise=60e-6 * G, turn_on=0.0):
    """Means of `count` attitudes at one temperature: outputs (n, 3), readings of the temperature (n,)."""
    offset = turn_on * rng.standard_normal(3)
    means = [triad.output(G * u, temperature, offset) for u in directions(rng, count)]
    return np.array(means) + noise * rng.standard_normal((count, 3)), np.full(count, temperature)


def natural_spline(knots, values, t):
    """Natural cubic spline through values at knots, at one t (de Boor 1978; Thomas' algorithm)."""
    n = len(knots)
    h = [knots[i + 1] - knots[i] for i in range(n - 1)]
    slope = [(values[i + 1] - values[i]) / h[i] for i in range(n - 1)]
    upper, right = [0.0] * n, [0.0] * n
    for i in range(1, n - 1):
        pivot = 2 * (h[i - 1] + h[i]) - h[i - 1] * upper[i - 1]
        upper[i] = h[i] / pivot
        right[i] = (6 * (slope[i] - slope[i - 1]) - h[i - 1] * right[i - 1]) / pivot
    second = [0.0] * n
    for i in range(n - 2, 0, -1):
        second[i] = right[i] - upper[i] * second[i + 1]
    i = next((k for k in range(n - 2) if t < knots[k + 1]), n - 2)
    a, b = (knots[i + 1] - t) / h[i], (t - knots[i]) / h[i]
    bent = ((a**3 - a) * second[i] + (b**3 - b) * second[i + 1]) * h[i] ** 2 / 6
    return a * values[i] + b * values[i + 1] + bent


class BentTriad(Triad):
    """A triad whose biases have more than a cubic: a kink of 0.25 mg/K, bends of some 25 K, or splines of their own."""

    def __init__(self, rng, law, knots=(), bend=1.4e-4 * G):
        super().__init__(rng)
        self.law, self.knots, self.bend = law, knots, bend
        self.place, self.sign = rng.uniform(0, 40), rng.choice([-1.0, 1.0], 3)
        self.size, self.phase = rng.uniform(0.3, 1.0, 3), rng.uniform(0, 2 * np.pi, 3)
        self.values = 5e-3 * G * rng.standard_normal((3, len(knots)))

    def at(self, temperature):
        bias, scale, misalignment = super().at(temperature)
        if self.law == "kink":
            bias = [
                b + s * 2.5e-4 * G * max(temperature - self.place, 0.0) for b, s in zip(bias, self.sign, strict=True)
            ]
        elif self.law == "rough":
            bend = self.bend * self.size * np.sin(temperature / 8.0 + self.phase)
            bias = [b + more for b, more in zip(bias, bend.tolist(), strict=True)]
        else:
            bias = [natural_spline(self.knots, own, temperature) for own in self.values.tolist()]
        return bias, scale, misalignment

"""A gyroscope triad at rest while its temperature changes, with slow noise, lag and loops; nothing of imulab."""

import numpy as np

EARTH = 7.292115e-5  # rad/s
RATE, LENGTH = 10.0, 1200.0  # Hz, s


def flicker(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return 1/f noise of variance 1 by its spectrum, a part of a record four times as long."""
    frequency = np.fft.rfftfreq(4 * count)
    lines = rng.standard_normal(len(frequency)) + 1j * rng.standard_normal(len(frequency))
    lines[0], lines[1:] = 0.0, lines[1:] / np.sqrt(frequency[1:])
    values = np.fft.irfft(lines, 4 * count)
    begin = int(rng.integers(0, 3 * count))
    return values[begin : begin + count] / values.std()


class Ramp:
    """One unit and one recording; sizes in deg/s are drawn over decades, as sensors differ by these."""

    def __init__(self, seed: int, *, back: bool = False, lag: float = 0.0, loop: float = 0.0, noise: int = 0) -> None:
        rng = np.random.default_rng(seed)
        count = int(RATE * LENGTH)
        self.time = np.arange(count) / RATE
        if back:
            self.temperature = 5 + 40 * (1 - np.abs(2 * self.time / LENGTH - 1))
        else:
            self.temperature = 8 + 38 * (1 - np.exp(-self.time / rng.uniform(400, 1200)))
        self.low, self.high = self.temperature.min(), self.temperature.max()
        self.law = rng.standard_normal((4, 3)) * np.array([[1.0], [0.02], [2e-4], [2e-6]])
        white, slow, walk = 0.07, np.exp(rng.uniform(*np.log([5e-4, 2e-2]))), np.exp(rng.uniform(*np.log([2e-5, 1e-3])))
        if noise:  # the same unit, another run
            rng = np.random.default_rng([seed, noise])
        before = self.temperature - lag * np.gradient(self.temperature, self.time)
        way = np.sign(np.gradient(self.temperature, self.time))
        place = (2 * self.temperature - self.low - self.high) / (self.high - self.low)
        turn = rng.standard_normal(3)
        earth = np.degrees(EARTH) * turn / np.linalg.norm(turn)
        self.output = self.bias(before) + earth + (way * (1 - place**2))[:, None] * loop * np.array([1.0, -0.8, 0.6])
        for axis in range(3):
            self.output[:, axis] += white * rng.standard_normal(count) + slow * flicker(count, rng)
            self.output[:, axis] += np.cumsum(walk / np.sqrt(RATE) * rng.standard_normal(count))
        self.reading = np.round(self.temperature + 0.02 * rng.standard_normal(count), 2)

    def bias(self, temperature: np.ndarray) -> np.ndarray:
        """Return the true biases at temperatures (n,), deg/s, shape (n, 3)."""
        return np.vander(temperature - 25.0, 4, increasing=True) @ self.law

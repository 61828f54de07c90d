"""A magnetometer triad alone: readings in any directions, and the Cramer-Rao bound; nothing of imulab."""

import numpy as np

PLACES = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]


def sphere(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return directions, evenly likely, shape (n, 3)."""
    vectors = rng.standard_normal((count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def circle(count: int, turns: float) -> np.ndarray:
    """Return directions once around or more, shape (n, 2)."""
    angle = np.linspace(0, 2 * np.pi * turns, count)
    return np.column_stack([np.cos(angle), np.sin(angle)])


class Sensor:
    """``M = D m + h``, uT, D symmetric, in 3 axes or 2."""

    def __init__(self, seed: int, axes: int = 3, field: float = 48.0) -> None:
        rng = np.random.default_rng(seed)
        half = rng.uniform(-0.08, 0.08, (axes, axes))
        self.soft = np.eye(axes) + half + half.T
        self.hard = rng.uniform(-0.6, 0.6, axes) * field
        self.field = field

    @property
    def places(self) -> list[tuple[int, int]]:
        """Places of the free elements of D."""
        return [place for place in PLACES if max(place) < len(self.hard)]

    @property
    def theta(self) -> np.ndarray:
        """Hard iron, uT, and the free elements of D."""
        return np.array([*self.hard, *(self.soft[i, j] for i, j in self.places)])

    def outputs(self, directions: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
        """Return outputs, uT, with white noise of this standard deviation, uT."""
        exact = self.field * directions @ self.soft.T + self.hard
        return exact + noise * rng.standard_normal(exact.shape)

    def bound(self, directions: np.ndarray, noise: float) -> np.ndarray:
        """Return the Cramer-Rao bound of theta, shape (p, p), where the direction of each reading is unknown too.

        The information of a reading about theta and its direction, less what the direction takes (Schur complement).
        """
        axes = len(self.hard)
        total = 0.0
        for u in directions:
            by_theta = np.zeros((axes, axes + len(self.places)))
            by_theta[:, :axes] = np.eye(axes)
            for k, (i, j) in enumerate(self.places):
                by_theta[i, axes + k] += self.field * u[j]
                if i != j:
                    by_theta[j, axes + k] += self.field * u[i]
            across = np.linalg.svd(u[None])[2][1:].T  # directions in which the field may turn
            by_turn = self.field * self.soft @ across
            taken = by_turn @ np.linalg.solve(by_turn.T @ by_turn, by_turn.T)
            total = total + by_theta.T @ (np.eye(axes) - taken) @ by_theta
        return noise**2 * np.linalg.inv(total)


def waved(count: int, rate: float, rng: np.random.Generator) -> np.ndarray:
    """Return directions of the field in a unit that a hand turns about axes that wander, shape (n, 3)."""
    time = np.arange(count) / rate
    sway = [sum(rng.normal() * np.sin(w * time + rng.uniform(0, 6.28)) for w in (0.3, 0.7, 1.1)) for _ in range(2)]
    polar = np.arccos(np.clip(np.sin(0.13 * time + 0.3 * sway[0]), -1, 1))
    turn = 1.7 * time + sway[1]
    return np.column_stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)])

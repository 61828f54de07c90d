"""Which temperatures and attitudes show the laws best: the search behind a plan.

The information of an attitude is the gradient of ``|f|`` for a nominal sensor, whose nine parameters are polynomials of
the temperature. The offsets of the biases in each power cycle are unknowns beside them, known to a standard deviation
tau; everything is in units of the noise of ``|f|`` in one attitude. Attitudes are exchanged one by one (Fedorov 1972)
for those that lower the mean variance of the corrected force over temperature and direction most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import legendre

from imulab.procedures.thermal.model import SHARES, Laws, forces
from imulab.recording import Array

_PLACES = 41
_SWEEPS = 3
_CLOSEST = np.cos(np.radians(3.0))
"""Two attitudes of a soak closer than this are one attitude."""
_RIDGE = 1e-6
"""Information that keeps the matrix regular while the attitudes of a start determine too little."""
_UNDETERMINED = 1e4


def nodes(count: int) -> Array:
    """Return -1, the extrema of the Legendre polynomial of degree `count` - 1, and 1, shape (count,)."""
    polynomial = np.eye(count)[-1]
    inner = np.sort(legendre.legroots(legendre.legder(polynomial)).real)
    return np.concatenate([[-1.0], inner, [1.0]])


def way(count: int, soaks: int) -> list[int]:
    """Return the order of soaks at `count` temperatures: up through all, then back and forth through what is left.

    The way back takes inner temperatures first, spread over the range: they are what can be reached from either side.
    """
    found, last = list(range(min(count, soaks))), count - 1
    while len(found) < soaks:
        left = soaks - len(found)
        if left > count - 2:
            leg = list(range(1, count))
        else:
            leg = np.round(np.linspace(1, count - 2, left) if left > 1 else [(count - 1) / 2]).astype(int).tolist()
        found += [last - k if found[-1] == last else k for k in leg]
    return found


@dataclass(frozen=True)
class Design:
    """Soaks at temperatures (degC), a power cycle each; tau and the variance of an attitude in units of its noise."""

    laws: Laws
    temperatures: Array
    tau: float
    variance: float = 1.0

    @cached_property
    def carried(self) -> Array:
        """Derivatives of the nine parameters in each soak by coefficients and offsets, shape (K, 9, c + 3 K)."""
        design, count = self.laws.design(self.temperatures), len(self.temperatures)
        found = np.zeros((count, 9, self.laws.size + 3 * count))
        found[:, :, : self.laws.size] = design
        for k in range(count):
            at = self.laws.size + 3 * k
            found[k, :3, at : at + 3] = self.tau * np.eye(3)
        return found

    @cached_property
    def places(self) -> Array:
        """Temperatures at which the variance counts, degC."""
        return np.linspace(self.laws.low, self.laws.high, _PLACES)

    @cached_property
    def weights(self) -> Array:
        """Mean variance of a component of the corrected force at each place, as matrices (places, c, c).

        Over all directions: that of the bias, and a third of those of scale factor and misalignment.
        """
        design = self.laws.design(self.places)
        found: Array = np.einsum("p,tpa,tpb->tab", SHARES, design, design)
        return found

    @cached_property
    def weight(self) -> Array:
        """Mean of `weights`."""
        found: Array = self.weights.mean(axis=0)
        return found

    def covariance(self, sets: Sequence[Array]) -> Array:
        """Covariance of coefficients and offsets with these attitudes, in units of the noise of an attitude squared."""
        information = np.diag(np.append(np.full(self.laws.size, _RIDGE), np.ones(3 * len(self.temperatures))))
        for own, directions in zip(self.carried, sets, strict=True):
            rows = gradients(directions) @ own
            information += rows.T @ rows / self.variance
        return np.asarray(np.linalg.inv(information), dtype=np.float64)

    def cost(self, covariance: Array) -> float:
        """Mean variance of a component of the corrected force; infinite where attitudes do not determine the laws."""
        own = covariance[: self.laws.size, : self.laws.size]
        return np.inf if np.diag(own).max() > _UNDETERMINED * (1 + self.tau**2) else float(np.trace(self.weight @ own))

    def deviations(self, covariance: Array) -> Array:
        """Standard deviation of a component of the corrected force at each place, its mean over directions."""
        own = covariance[: self.laws.size, : self.laws.size]
        found: Array = np.sqrt(np.einsum("tab,ba->t", self.weights, own))
        return found


def gradients(directions: Array) -> Array:
    """Return the derivatives of ``|f|`` / g by the nine parameters of a nominal sensor, shape (n, 9)."""
    nominal = np.tile(np.repeat([0.0, 1.0, 0.0], 3), (len(directions), 1))
    force, change = forces(nominal, directions)
    found: Array = np.einsum("ni,nij->nj", force, change)
    return found


def exchange(design: Design, points: Array, counts: Sequence[int], seed: int) -> tuple[list[Array], Array]:
    """Choose attitudes of each soak among `points`, shape (m, 3), and return them with the covariance they give."""
    rng = np.random.default_rng(seed)
    rows = gradients(points)
    products = (rows[:, :, None] * rows[:, None, :]).reshape(len(points), 81)
    chosen = [rng.choice(len(points), count, replace=False) for count in counts]
    covariance = design.covariance([points[own] for own in chosen])
    for _ in range(_SWEEPS):
        moved = False
        for soak, own in enumerate(chosen):
            carried = design.carried[soak] / np.sqrt(design.variance)
            taken = (points @ points[own].T > _CLOSEST).sum(axis=1)
            for place in range(len(own)):
                old = int(own[place])
                covariance = _added(covariance, rows[old] @ carried, -1.0)
                taken -= points @ points[old] > _CLOSEST
                seen = carried @ covariance
                known = seen[:, : design.laws.size]
                drop = products @ (known @ design.weight @ known.T).ravel()
                gain = drop / (1 + products @ (seen @ carried.T).ravel())
                gain[taken > 0] = -np.inf
                best = int(np.argmax(gain))
                best = best if gain[best] > gain[old] * (1 + 1e-9) else old
                moved |= best != old
                own[place] = best
                covariance = _added(covariance, rows[best] @ carried, 1.0)
                taken += points @ points[best] > _CLOSEST
        if not moved:
            break
    sets = [points[own] for own in chosen]
    return sets, design.covariance(sets)


def _added(covariance: Array, row: Array, sign: float) -> Array:
    """Return the covariance with one row of information more, or less."""
    carried = covariance @ row
    found: Array = covariance - np.outer(carried, carried) / (sign + row @ carried)
    return found

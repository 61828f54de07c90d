"""The search behind a plan: sets of attitudes that are D- or A-optimal for a tumble test.

The information of an attitude is the gradient of |f| for a nominal sensor, a function of its upward direction alone.
Attitudes are exchanged one by one for the best of a list of candidates (Fedorov 1972; Atkinson, Donev and Tobias,
Optimum Experimental Designs, 2007, ch. 12) from several starts, and on the free sphere then moved to where they are
best. Many sets come within 1 % of the least sum of variances; the one whose worst axis is known best is taken,
because a triad is as good as its worst axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from imulab.procedures.tumble.model import norm_and_jacobian, parameter_count
from imulab.procedures.tumble.solve import start_parameters
from imulab.recording import Array

CLOSEST = np.radians(3.0)
"""Two attitudes closer than this are the same attitude: the same axis vertical."""
_KEPT_CLEAR = 2 * CLOSEST
"""What a plan with distinct verticals keeps from a vertical axis, so that an attitude put down 3 deg off does too."""
_STARTS = 12
_ENOUGH = 600  # attitudes over all starts: with many attitudes the first start is as good as the best
_SWEEPS = 40
_POLISH_RADII = np.repeat(np.radians([8.0, 3.0, 1.0]), 4)
_CAP = 48
_BALANCED = 3
"""So many of the best starts are polished and balanced."""
_BALANCE_ROUNDS = 6
_BALANCE_RADII = np.repeat(np.radians([3.0, 1.0]), 3)
_AS_GOOD = 1.01
"""Sums of variances within this factor of the least are taken for equal."""
_RIDGE = 1e-9
"""Information that keeps the matrix regular while attitudes are still missing."""
_UNDETERMINED = 1e6
_QUICK_ROUNDS = 2
_QUICK_RADII = np.radians([8.0, 3.0, 3.0, 1.0])


def information_rows(directions: Array, order: int) -> Array:
    """Return the gradient of |f| with respect to the scaled parameters of a nominal sensor, shape (n, p)."""
    rows: Array = norm_and_jacobian(start_parameters(order), directions[None], order)[1][0]
    return rows


def near_vertical(directions: Array, angle: float) -> NDArray[np.bool_]:
    """Return which of x, y and z is vertical within `angle`, up or down, at each upward direction, shape (n, 3)."""
    vertical: NDArray[np.bool_] = np.abs(directions) > np.cos(angle) * np.linalg.norm(directions, axis=1, keepdims=True)
    return vertical


def inverse(information: Array) -> Array:
    """Return the covariance that belongs to an information matrix."""
    return np.asarray(np.linalg.inv(information), dtype=np.float64)


@dataclass(frozen=True)
class Search:
    """What a set of attitudes is for.

    Attributes
    ----------
    order
        Order of the model.
    criterion
        ``"A"``, least sum of variances, or ``"D"``, least volume of the confidence region.
    before
        Upward directions already measured, shape (k, 3).
    distinct_verticals
        Whether x, y and z are each to be vertical, up or down, in one attitude at most.
    """

    order: int
    criterion: str
    before: Array
    distinct_verticals: bool = False

    @cached_property
    def base(self) -> Array:
        """Information of the attitudes already measured."""
        fixed = information_rows(self.before, self.order)
        information: Array = fixed.T @ fixed + _RIDGE * np.eye(parameter_count(self.order))
        return information

    def covariance(self, directions: Array) -> Array:
        """Covariance of the parameters with these attitudes added, per variance of |f| / g."""
        rows = information_rows(directions, self.order)
        return inverse(self.base + rows.T @ rows)

    def gain(self, rows: Array, kept: Array, weight: Array | float = 1.0) -> Array:
        """What adding each row to those kept improves.

        By A the drop of the sum of weight times variance, by D the growth of the determinant.
        """
        carried = rows @ inverse(self.base + kept.T @ kept)
        variance: Array = 1 + np.einsum("ij,ij->i", carried, rows)
        if self.criterion == "D":
            return variance
        gain: Array = (carried**2 * weight).sum(axis=1) / variance
        return gain

    def taken(self, points: Array, others: Array) -> NDArray[np.bool_]:
        """Points that would repeat an attitude: it measures nothing new that a longer hold would not."""
        near = np.vstack([others, self.before])
        repeated: NDArray[np.bool_] = (points @ near.T).max(axis=1, initial=-1.0) > np.cos(CLOSEST)
        if self.distinct_verticals:
            used = near_vertical(near, _KEPT_CLEAR).any(axis=0)
            repeated |= (near_vertical(points, _KEPT_CLEAR) & used).any(axis=1)
        return repeated


def optimal_set(search: Search, points: Array, count: int, seed: int, *, free: bool) -> Array | None:
    """Choose `count` of the candidate `points`, shape (m, 3), and move them from there if `free`.

    Returns the directions, shape (count, 3), or None where no choice determines the model.
    """
    rng = np.random.default_rng(seed)
    rows = information_rows(points, search.order)
    starts = [_exchange(search, points, rows, count, rng) for _ in range(max(2, min(_STARTS, _ENOUGH // count)))]
    starts.sort(key=lambda directions: _cost(search.covariance(directions), search.criterion))
    if not np.isfinite(_cost(search.covariance(starts[0]), search.criterion)):
        return None
    if not free:
        return _most_alike(search, starts)
    polished = [_polish(search, directions, rng, _POLISH_RADII) for directions in starts[:_BALANCED]]
    if search.criterion == "D":
        return _most_alike(search, polished)
    return _most_alike(search, polished + [each for one in polished for each in _balance(search, one, rng)])


def quick_set(
    search: Search, points: Array, count: int, seed: int, *, weight: Array | float = 1.0, move: bool = True
) -> Array | None:
    """Choose as `optimal_set` does, but from one start: within hundredths of a second, for who waits for the answer.

    The sum of weight times variance is made least. Returns the directions, shape (count, 3), or None where this choice
    does not determine the model.
    """
    rng = np.random.default_rng(seed)
    chosen = _exchange(search, points, information_rows(points, search.order), count, rng, weight)
    if np.diag(search.covariance(chosen)).max() > _UNDETERMINED:
        return None
    if not move:
        return chosen
    for _ in range(_QUICK_ROUNDS):
        variance = np.diag(search.covariance(chosen)).reshape(-1, 3)
        weight = weight * (variance / variance.mean(axis=1, keepdims=True)).ravel() ** 2
        chosen = _polish(search, chosen, rng, _QUICK_RADII, weight)
    return chosen


def _exchange(
    search: Search, points: Array, rows: Array, count: int, rng: np.random.Generator, weight: Array | float = 1.0
) -> Array:
    """Exchange attitudes from a random start until no exchange helps."""
    chosen = rng.choice(len(rows), count, replace=False)
    for _ in range(_SWEEPS):
        moved = False
        for place in range(count):
            others = np.delete(chosen, place)
            gain = search.gain(rows, rows[others], weight)
            gain[search.taken(points, points[others])] = -np.inf
            best = int(np.argmax(gain))
            if gain[best] > gain[chosen[place]] * (1 + 1e-9) or gain[chosen[place]] == -np.inf:
                chosen[place], moved = best, True
        if not moved:
            break
    directions: Array = points[chosen]
    return directions


def _polish(
    search: Search, directions: Array, rng: np.random.Generator, radii: Array, weight: Array | float = 1.0
) -> Array:
    """Move each attitude within shrinking caps to where it gives most."""
    best = directions.copy()
    for radius in radii:
        for place in range(len(best)):
            others = np.delete(best, place, axis=0)
            cap = best[place] + radius * rng.uniform(-1, 1, (_CAP, 3))
            cap = np.vstack([best[place], cap / np.linalg.norm(cap, axis=1, keepdims=True)])
            gain = search.gain(information_rows(cap, search.order), information_rows(others, search.order), weight)
            gain[1:][search.taken(cap[1:], others)] = -np.inf
            best[place] = cap[int(np.argmax(gain))]
    return best


def _balance(search: Search, directions: Array, rng: np.random.Generator) -> list[Array]:
    """Sets made from one by weighting up, again and again, the variances of axes that are worse than the others."""
    sets = [directions]
    weight: Array = np.ones(parameter_count(search.order))
    for _ in range(_BALANCE_ROUNDS):
        variance = np.diag(search.covariance(sets[-1])).reshape(-1, 3)
        weight = weight * (variance / variance.mean(axis=1, keepdims=True)).ravel() ** 2
        sets.append(_polish(search, sets[-1], rng, _BALANCE_RADII, weight))
    return sets[1:]


def _most_alike(search: Search, sets: list[Array]) -> Array:
    """The set with the least cost; by A the one of the least worst axes among those as good as it."""
    cost = [_cost(search.covariance(directions), search.criterion) for directions in sets]
    if search.criterion == "D":
        return sets[int(np.argmin(cost))]
    good = [directions for directions, each in zip(sets, cost, strict=True) if each <= _AS_GOOD * min(cost)]
    return min(good, key=lambda directions: _worst_axes(search.covariance(directions)))


def _worst_axes(covariance: Array) -> float:
    """Sum over bias, scale factor, misalignment, k2 ... of the variance of the worst of its three."""
    return float(np.diag(covariance).reshape(-1, 3).max(axis=1).sum())


def _cost(covariance: Array, criterion: str) -> float:
    if criterion == "D":
        return float(np.linalg.slogdet(covariance)[1])
    return float(np.trace(covariance))

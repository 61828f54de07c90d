"""Which attitudes were knocked: those that no order up to 3 explains, found before the order is chosen.

With whitened residuals r = R y, R = I - H, the shifts of a set S of attitudes are estimated by ``g = R_SS^-1 r_S`` and
lower the sum of squares by ``r_S' g``. Of all sets of up to three attitudes (beyond 60 attitudes: by greedy search with
swaps) and of orders 1 to 3 the one with the least information criterion is set aside, if chance gives its weakest
member once in 300 tests at most.

Sources: Belsley, Kuh and Welsch, Regression Diagnostics (1980), ch. 2; Schwarz, Annals of Statistics 6 (1978) 461.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations
from math import comb, lgamma, log

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.least_squares import chi_square_limit
from imulab.procedures.tumble.solve import Problem, Solution, evaluate
from imulab.recording import Array

Index = NDArray[np.intp]

HIGHEST_TESTED = 3
_MOST = 3
_EXHAUSTIVE = 60
_MOST_OF_MANY = 12
_SHARE_OF_MANY = 20
FREEDOM = {True: 3, False: 5}
"""Least degrees of freedom that are left to tell a knock by, noise known or not: on a real recording of 17 attitudes,
order 2 with 4 left agreed by chance to 0.02 mg without one attitude, and predicted nine times worse."""
_CHANCE = 0.003
_SEPARABLE = 0.02
"""Least eigenvalue of R_SS: below it the others do not say where these attitudes should be."""
_DETERMINED = 2000.0
_PASSES, _SEARCHES = 5, 5
_FIRST_LOOK = 32


@dataclass(frozen=True)
class Aside:
    """Attitudes that stand out: their indices, rising, and their shifts over the standard uncertainties, shape (m,)."""

    index: tuple[int, ...]
    deviations: tuple[float, ...]

    def others(self, count: int) -> Index:
        """Return the indices of the other ones of `count` attitudes."""
        return np.delete(np.arange(count), self.index)


NONE_ASIDE = Aside((), ())


@dataclass(frozen=True)
class _Whitened:
    """Residuals of one order in units of their noise, (n,), and an orthonormal basis of what the model explains."""

    residual: Array
    basis: Array

    @property
    def squares(self) -> float:
        return float(self.residual @ self.residual)


def set_aside(problem: Problem, fits: Callable[[Problem], dict[int, Solution]]) -> tuple[Aside, dict[int, Solution]]:
    """Find the attitudes that no order explains; return them and the fits of the others, by order.

    The search starts from the fits of all attitudes and is repeated about those of the others until it rests. Where
    nothing stands out the fits returned are those of all.

    Parameters
    ----------
    problem
        All attitudes of one unit (a batch of one), without a prior.
    fits
        Fits the orders that are to be tested to a problem.
    """
    known = problem.covariance is not None
    plain = solutions = fits(problem)
    aside = standing_out(plain, known=known)
    for _ in range(_SEARCHES):
        if not aside.index:
            return aside, plain
        solutions = fits(problem.only(aside.others(problem.reading.shape[1])))
        about = {order: evaluate(replace(problem, order=order), found) for order, found in solutions.items()}
        # What even the best order leaves unexplained is noise of the others, and no sign of a knock.
        excess = min(float(about[order].excess[0]) for order in _tested(about))
        before, aside = aside, standing_out(about, known=known, excess=excess)
        if aside.index == before.index:
            break
    return before, solutions


def standing_out(solutions: Mapping[int, Solution], *, known: bool, excess: float = 0.0) -> Aside:
    """Find the attitudes that stand out.

    Parameters
    ----------
    solutions
        Residuals and Jacobians of all attitudes, by order; orders above 3 are left alone if there are lower ones.
    known
        Whether the attitudes' noise is known.
    excess
        Standard deviation that is added to each attitude's own noise.
    """
    best, least = NONE_ASIDE, np.inf
    for order in _tested(solutions):
        white = _whitened(solutions[order], excess)
        if white is None:
            continue
        for found, criterion in _candidates(white, known):
            if criterion < least:
                best, least = found, criterion
    return best


def _tested(solutions: Mapping[int, Solution]) -> list[int]:
    return [order for order in solutions if order <= HIGHEST_TESTED] or list(solutions)


def _whitened(solution: Solution, excess: float) -> _Whitened | None:
    """Return None where the attitudes do not determine the parameters."""
    root = np.sqrt(solution.own_variance[0] + excess**2)
    rows = solution.jacobian[0] / root[:, None]
    length = np.linalg.norm(rows, axis=0)
    if rows.shape[0] < rows.shape[1] + FREEDOM[True] or not (np.isfinite(rows).all() and length.all()):
        return None
    basis, values, _ = np.linalg.svd(rows / length, full_matrices=False)
    if values[-1] * _DETERMINED < values[0]:
        return None
    y = solution.residuals[0] / root
    return _Whitened(y - basis @ (basis.T @ y), basis)


def _candidates(white: _Whitened, known: bool) -> Iterator[tuple[Aside, float]]:
    """Every admissible set of this order, the empty one first, with its information criterion."""
    n, size = white.basis.shape
    yield NONE_ASIDE, _criterion(white.squares, n, size, 0, known)
    most = _MOST if n <= _EXHAUSTIVE else min(n // _SHARE_OF_MANY, _MOST_OF_MANY)
    chosen: Index = np.empty(0, dtype=np.intp)
    for m in range(1, most + 1):
        freedom = n - size - m
        if freedom < FREEDOM[known]:
            return
        found = _best_subset(white, m) if n <= _EXHAUSTIVE else _extended(white, chosen)
        if found is None:
            return
        chosen = found
        shift, spread, gain = _shifts(white, chosen)
        rss = max(white.squares - gain, 1e-12 * white.squares, 1e-300)
        z = shift / spread
        if _admissible(z, gain, rss, n, freedom, known):
            scale = 1.0 if known and rss <= chi_square_limit(freedom) else np.sqrt(rss / freedom)
            order = np.argsort(chosen)
            aside = Aside(tuple(chosen[order].tolist()), tuple((z[order] / scale).tolist()))
            yield aside, _criterion(rss, n, size, m, known)


def _shifts(white: _Whitened, chosen: Index) -> tuple[Array, Array, float]:
    """Estimated shifts g of a set, their standard deviations, and the sum of squares that they explain."""
    rows = white.basis[chosen]
    inverse = np.linalg.inv(np.eye(len(chosen)) - rows @ rows.T)
    shift = inverse @ white.residual[chosen]
    return shift, np.sqrt(np.diag(inverse)), float(white.residual[chosen] @ shift)


def _admissible(z: Array, gain: float, rss: float, n: int, freedom: int, known: bool) -> bool:
    """Whether chance hardly gives the weakest member of a set, nor the set."""
    from imulab.estimation.special import fdtrc, ndtr, stdtr

    m, least = len(z), float(np.abs(z).min())
    tests = n - m + 1
    return bool(
        2 * tests * stdtr(freedom, -least / np.sqrt(rss / freedom)) < _CHANCE
        and (not known or 2 * tests * ndtr(-least) < _CHANCE)
        and comb(n, m) * fdtrc(m, freedom, gain * freedom / (m * rss)) < _CHANCE
    )


def _criterion(rss: float, n: int, size: int, m: int, known: bool) -> float:
    """``(n - m) ln s^2 + rss / s^2`` and the price of order, set and scale."""
    freedom = n - size - m
    scale, price = max(rss / freedom, 1e-300), 0.0
    if known:
        fits = rss <= chi_square_limit(freedom)
        scale, price = (1.0, 0.0) if fits else (max(1.0, scale), log(n))
    sets = lgamma(n + 1) - lgamma(m + 1) - lgamma(n - m + 1)
    return (n - m) * log(scale) + rss / scale + (size + 1.5 * m) * log(n) + 2 * sets + price


@cache
def _subsets(n: int, m: int) -> Index:
    """All subsets of m of n, shape (m, count)."""
    return np.array(list(combinations(range(n), m)), dtype=np.intp).T.copy()


def _best_subset(white: _Whitened, m: int) -> Index | None:
    """Return the m attitudes that explain most of the sum of squares; None if no set can be separated."""
    subsets = _subsets(len(white.residual), m)
    r, off = white.residual, -white.basis @ white.basis.T
    diagonal = 1 + np.diag(off)
    with np.errstate(all="ignore"):
        if m == 1:
            gain, separable = r**2 / diagonal, diagonal >= _SEPARABLE
        else:
            gain, separable = _explained(r, diagonal, off, subsets), np.ones(subsets.shape[1], dtype=np.bool_)
    gain = np.where(separable & np.isfinite(gain), gain, -np.inf)
    for count in (_FIRST_LOOK, len(gain)):
        first = np.argpartition(-gain, min(count, len(gain)) - 1)[:count]
        members = subsets[:, first].T
        blocks = off[members[:, :, None], members[:, None, :]] + np.eye(m)
        allowed = (np.linalg.eigvalsh(blocks)[:, 0] >= _SEPARABLE) & np.isfinite(gain[first])
        if allowed.any():
            best: Index = members[np.argmax(np.where(allowed, gain[first], -np.inf))]
            return best
    return None


def _explained(r: Array, diagonal: Array, off: Array, subsets: Index) -> Array:
    """``r_S' R_SS^-1 r_S`` of pairs or triples, by cofactors; negative where R_SS is no better than singular."""
    i, j = subsets[0], subsets[1]
    a, b, x = diagonal[i], diagonal[j], off[i, j]
    p, q = r[i], r[j]
    pair = a * b - x * x
    if len(subsets) == 2:
        return np.asarray(np.where(pair > 0, (b * p * p - 2 * x * p * q + a * q * q) / pair, -1.0))
    k = subsets[2]
    c, y, z, s = diagonal[k], off[i, k], off[j, k], r[k]
    # Cofactors of [[a, x, y], [x, b, z], [y, z, c]].
    xx, yy, xy = b * c - z * z, a * c - y * y, y * z - x * c
    xz, yz = x * z - b * y, x * y - a * z
    determinant = a * xx + x * xy + y * xz
    whole = p * p * xx + q * q * yy + s * s * pair + 2 * (p * q * xy + p * s * xz + q * s * yz)
    return np.asarray(np.where((pair > 0) & (determinant > 0), whole / determinant, -1.0))


def _extended(white: _Whitened, chosen: Index) -> Index | None:
    """Add the attitude that explains most, then exchange members while that explains more."""
    added = _best_addition(white, chosen)
    if added is None:
        return None
    members = np.append(chosen, added)
    for _ in range(_PASSES):
        before = set(members.tolist())
        for place in range(len(members)):
            rest = np.delete(members, place)
            best = _best_addition(white, rest)
            if best is not None:
                members = np.append(rest, best)
        if set(members.tolist()) == before:
            break
    return members


def _best_addition(white: _Whitened, chosen: Index) -> int | None:
    """Return the attitude that, added to a set, lowers the sum of squares most."""
    r, basis = white.residual, white.basis
    diagonal = 1 - np.einsum("np,np->n", basis, basis)
    if len(chosen):
        rows = basis[chosen]
        cross = -basis @ rows.T
        share = cross @ np.linalg.inv(np.eye(len(chosen)) - rows @ rows.T)
        r = r - share @ r[chosen]
        diagonal = diagonal - np.einsum("nm,nm->n", share, cross)
    diagonal[chosen] = 0.0
    allowed = diagonal >= _SEPARABLE
    if not allowed.any():
        return None
    return int(np.argmax(np.where(allowed, r**2 / np.where(allowed, diagonal, 1.0), -np.inf)))

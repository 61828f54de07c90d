"""Which order of the model the attitudes support.

Tests of the order, knocked attitudes, and residuals that are no scatter.

Nested orders are compared by F-test, by the Bayesian information criterion and by the error of each attitude predicted
from all others. The F-test and BIC alone have picked order 4 on real recordings where it predicts ten times worse than
order 2; prediction decides, by more than the error of the comparison, among the orders that the attitudes can see all
over the sphere.

A group of columns B (n, k) that the model does not have is regressed on the weighted residuals beside the model's own
Jacobian J (n, p): with the parts of both that J cannot absorb (the hat matrix accounted for), the F-test asks whether
the group explains more than chance would.

In the directions u = f / |f| the model's own columns span: bias, the first degree; scale factor and misalignment, the
second; k2 and k3, the pure powers of the third and fourth. What is left of the third degree are three products of two
axes (cross terms) and xyz, of the fourth six products.

With whitened residuals r = R y, R = I - H, the shifts of a set S of attitudes are estimated by ``g = R_SS^-1 r_S`` and
lower the sum of squares by ``r_S' g``. Of all sets of up to three attitudes (beyond 60 attitudes: by greedy search with
swaps) and of orders 1 to 3 the one with the least information criterion is set aside, if chance gives its weakest
member once in 300 tests at most.

Sources: Belsley, Kuh and Welsch, Regression Diagnostics (1980), ch. 2; Schwarz, Annals of Statistics 6 (1978) 461.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import cache, cached_property
from math import comb, lgamma, log

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

import imulab.procedures.tumble._model as _model
from imulab.display import Finding
from imulab.estimation.decisions import (
    ATTITUDE_SET_ASIDE,
    ATTITUDES_FIT_STATED_NOISE,
    RESIDUALS_FOLLOW_DIRECTION,
    RESIDUALS_FOLLOW_TIME,
    TUMBLE_ORDER_ABOVE_TWO,
    TUMBLE_ORDER_TWO,
)
from imulab.estimation.distributions import f_tail, normal_cdf, probability_fact, t_cdf
from imulab.estimation.least_squares import (
    Observability,
    bayesian_information,
    chi_square_limit,
    f_test,
    factorise,
    inverse_root,
    observability,
)
from imulab.procedures.tumble import HIGHEST_ORDER
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.model import AXES, MISALIGNMENTS, parameter_count
from imulab.procedures.tumble.schema import OrderRow
from imulab.procedures.tumble.solve import (
    TumbleProblem,
    TumbleSolution,
    evaluate,
    forces,
    information_rows,
    leave_one_out,
    solve_norm,
    sphere_points,
)
from imulab.recording import Array
from imulab.records.triads import CROSS_TERMS

# Which order of the model the attitudes support.


BLIND_SPOT = 4.0
"""Predicted standard uncertainty of |f| anywhere on the sphere, over the scatter at order 1, where an order guesses."""
_DIRECTIONS = 400  # over the sphere, 10 deg apart, in which an order's |f| is judged
_ROUNDING = 1e-30
"""Smallest variance of |f| that is told from rounding, g^2."""
_NOTHING_KNOWN = 1e12
"""Inverse variance where no residual tells the noise: only the geometry is judged then."""


class OrderChoice(Struct, frozen=True):
    """The table of orders, lowest first, the order that it leads to, and the solution of each order that was fitted."""

    order: int
    rows: tuple[OrderRow, ...]
    solutions: Mapping[int, TumbleSolution]
    observability: Observability

    @property
    def solution(self) -> TumbleSolution:
        """That of the order chosen."""
        return self.solutions[self.order]


def solve_orders(problem: TumbleProblem) -> dict[int, TumbleSolution]:
    """Fit the orders that the attitudes are enough for: more than parameters, or as many at order 1."""
    n = problem.reading.shape[1]
    return {
        order: solve_norm(replace(problem, order=order))
        for order in range(1, HIGHEST_ORDER + 1)
        if n > parameter_count(order) or (order == 1 and n == parameter_count(1))
    }


def choose_order(problem: TumbleProblem, gravity: float, solutions: Mapping[int, TumbleSolution]) -> OrderChoice:
    """Compare orders 1 to 5 and choose the one that predicts best and can be observed.

    All orders are compared with the same weights: each attitude's own noise, with the excess that order 1 and 2 leave
    unexplained at most. A higher order is taken only if

    - the mean of its squared leave-one-out errors is below that of the order chosen so far by more than the standard
      error of the difference, each attitude weighted by 1 less its leverage: one that no other attitude is near is
      predicted badly by any order, and tells nothing of which is better,
    - the F-test finds its gain significant, at 5 % (1 % above order 2), against the order chosen so far and against
      the next lower one,
    - its predicted standard uncertainty of |f| is nowhere on the sphere above 4 times the scatter of the residuals at
      order 1 (their sum of squares over degrees of freedom).

    Parameters
    ----------
    problem
        Attitudes of one unit (a batch of one), as many as order 1 has parameters or more; its order is ignored.
    gravity
        Magnitude of gravity, m/s^2, the scale of the figures in the table.
    solutions
        From `solve_orders`.
    """
    n = problem.reading.shape[1]
    smallest = min((fit.excess[0] for order, fit in solutions.items() if order <= 2), default=0.0)
    trials = {order: replace(problem, order=order) for order in solutions}
    conditioning = {
        order: observability(fit.jacobian[0], absolute_weights(trials[order], fit)) for order, fit in solutions.items()
    }
    rows: list[OrderRow] = []
    chosen, best = 1, None
    costs: dict[int, float] = {}
    for order, fit in solutions.items():
        common = 1 / (fit.own_variance[0] + smallest**2)
        costs[order] = float((fit.down_weights[0] * common * fit.residuals[0] ** 2).sum())
        squares = _left_out_squares(trials[order], fit)
        row = _row(trials[order], fit, conditioning[order], costs, squares, gravity)
        rows.append(row)
        if not row.observable or squares is None:
            continue
        if best is None or (
            _is_clearly_smaller(squares, best, 1 - fit.leverage[0])
            and _significant(costs, chosen, order, n)
            and (row.largest_uncertainty or 0.0) <= BLIND_SPOT * rows[0].scatter
        ):
            chosen, best = order, squares
    return OrderChoice(chosen, tuple(rows), solutions, conditioning[chosen])


def _left_out_squares(problem: TumbleProblem, fit: TumbleSolution) -> Array | None:
    """Return the squared leave-one-out error of each attitude, shape (n,); None without degrees of freedom.

    Huber's psi replaces the residual: no order can predict an attitude that was knocked.
    """
    if problem.reading.shape[1] <= parameter_count(problem.order):
        return None
    squares: Array = (fit.down_weights[0] * leave_one_out(problem, fit)) ** 2
    return squares if np.isfinite(squares).all() else None


def _is_clearly_smaller(squares: Array, best: Array, weights: Array) -> bool:
    """Whether one mean of paired squares is below the other by more than the standard error of the difference."""
    gain = weights * (best - squares)
    return bool(gain.mean() > gain.std(ddof=1) / np.sqrt(len(gain)))


def _significant(costs: Mapping[int, float], chosen: int, order: int, n: int) -> bool:
    level = (TUMBLE_ORDER_TWO if order <= 2 else TUMBLE_ORDER_ABOVE_TWO).level
    return all(
        f_test(costs[below], parameter_count(below), costs[order], parameter_count(order), n) < level
        for below in {chosen, order - 1}
    )


def _row(
    problem: TumbleProblem,
    fit: TumbleSolution,
    conditioning: Observability,
    costs: Mapping[int, float],
    squares: Array | None,
    gravity: float,
) -> OrderRow:
    order = problem.order
    size, n = parameter_count(order), problem.reading.shape[1]
    below = order - 1
    observable = conditioning.rank == size and bool(fit.converged[0])
    return OrderRow(
        order=order,
        parameters=size,
        degrees_of_freedom=n - size,
        rms=gravity * float(np.sqrt(np.mean((fit.down_weights[0] * fit.deviations[0]) ** 2))),
        leave_one_out=None if squares is None else gravity * float(np.sqrt(squares.mean())),
        f_probability=f_test(costs[below], parameter_count(below), costs[order], size, n) if below else None,
        bic=bayesian_information(costs[order], size, n),
        condition_number=conditioning.condition,
        rank=conditioning.rank,
        observable=observable,
        largest_uncertainty=gravity * _worst_direction_uncertainty(problem, fit) if observable and n > size else None,
    )


def _worst_direction_uncertainty(problem: TumbleProblem, fit: TumbleSolution) -> float:
    """Predicted standard uncertainty of |f|, in g, in the direction where it is largest."""
    weights = absolute_weights(problem, fit)
    level = weights[0] / fit.weights[0, 0]  # the same for all attitudes
    root = inverse_root(fit.jacobian, weights[None])[0] if problem.robust else fit.inverse_root[0] / np.sqrt(level)
    return float(np.sqrt(((_rows_over_the_sphere(problem.order) @ root) ** 2).sum(axis=1).max()))


@cache
def _rows_over_the_sphere(order: int) -> Array:
    """Derivatives of |f| by the parameters of a nominal sensor in all directions, shape (d, p)."""
    return information_rows(sphere_points(_DIRECTIONS), order)


def absolute_weights(problem: TumbleProblem, fit: TumbleSolution) -> Array:
    """Return weights as inverse variances, shape (n,); an unknown noise level is estimated from the residuals."""
    weights: Array = fit.weights[0] / max(fit.scale[0] ** 2, _ROUNDING)  # as many attitudes as parameters leave nothing
    n, size = problem.reading.shape[1], fit.theta.shape[1]
    if problem.covariance is None and n > size and not problem.robust:
        mean_square = float((weights * fit.residuals[0] ** 2).sum()) / (n - size)
        weights = weights / max(mean_square, _ROUNDING)
    elif problem.covariance is None and n <= size:
        weights = weights * _NOTHING_KNOWN
    return weights


# Systematic residuals: functions of the direction of gravity, or of time.


_FEWEST = 4  # degrees of freedom that must be left beside a pattern
_TOLD_APART = 0.02  # share of a column that the model must leave of it
_TINY = 1e-7  # g: patterns below 0.1 µg are rounding
_MICRO = 1e6  # to µg and ppm


class Pattern(Struct, frozen=True):
    """What a group of columns explains of the residuals.

    Attributes
    ----------
    probability
        Of so large a gain by chance (F-test).
    value, uncertainty
        Coefficients of the columns, and their standard uncertainties, shape (k,).
    size
        Root mean square of the pattern over the attitudes, in units of the residuals.
    """

    probability: float
    value: Array
    uncertainty: Array
    size: float


def find_patterns(groups: Mapping[str, Array], solution: TumbleSolution) -> dict[str, Pattern]:
    """Regress the residuals of a batch of one on groups of columns, shapes (n, k), each beside the model.

    Attitudes of weight 0 do not count. Groups that cannot be told from the model, or leave too few degrees of freedom,
    are left out.
    """
    used, size = solution.weights[0] > 0, solution.jacobian.shape[2]
    root, basis = np.sqrt(solution.weights[0, used]), solution.factors.basis[0, used]
    weighted = np.column_stack([solution.residuals[0], *groups.values()])[used] * root[:, None]
    left, scale = weighted - basis @ (basis.T @ weighted), np.sqrt((weighted**2).sum(axis=0))
    y, n, patterns, start = left[:, 0], len(root), dict[str, Pattern](), 1
    for name, columns in groups.items():
        k = columns.shape[1]
        which, start = slice(start, start + k), start + k
        if n - size - k < _FEWEST or not scale[which].all():
            continue
        u, values, vt = np.linalg.svd(left[:, which] / scale[which], full_matrices=False)
        if values[-1] < _TOLD_APART:
            continue
        inverse, along = vt.T / values, u.T @ y
        value = inverse @ along / scale[which]
        cost, gain = float(y @ y), float(along @ along)
        noise = (cost - gain) / (n - size - k)
        patterns[name] = Pattern(
            probability=f_test(cost, size, cost - gain, size + k, n),
            value=value,
            uncertainty=np.sqrt(max(noise, 0.0) * (inverse**2).sum(axis=1)) / scale[which],
            size=float(np.sqrt((((left[:, which] @ value) / root) ** 2).sum() / n)),
        )
    return patterns


def direction_findings(problem: TumbleProblem, solution: TumbleSolution, *, order_chosen: bool) -> list[str]:
    """Say where the residuals are a function of direction that the model does not hold.

    Parameters
    ----------
    problem, solution
        A batch of one.
    order_chosen
        Whether the order was chosen from the data, which has tried the next power then.
    """
    force = forces(problem, solution)[0]
    x, y, z = (force / np.linalg.norm(force, axis=1)[:, None]).T
    power = problem.order + 2
    groups = {
        "cross": np.column_stack([x * x * y, y * y * z, z * z * x]),
        "other": np.column_stack([x * y * z, x**3 * y, y**3 * z, z**3 * x, x * y**3, y * z**3, z * x**3]),
    }
    if not order_chosen and problem.order < HIGHEST_ORDER:
        alike = [x**power, y**power, z**power] if problem.order else [x * y, z * x, z * y]
        groups["order"] = np.column_stack(alike)
    if problem.cross:
        del groups["cross"]
    patterns = {name: each for name, each in find_patterns(groups, solution).items() if each.size > _TINY}
    if not patterns:
        return []
    likeliest = min(patterns, key=lambda name: patterns[name].probability)
    pattern = patterns[likeliest]
    if pattern.probability * len(patterns) > RESIDUALS_FOLLOW_DIRECTION.level:
        return []
    unit, terms = "µg/g²", list(CROSS_TERMS)
    if likeliest == "order" and problem.order:
        unit, terms = f"µg/g{'²³⁴⁵'[power - 3]}", [f"k{power - 1}_{axis}" for axis in AXES]
    elif likeliest == "order":
        unit, terms = "µrad", [f"misalignment_{pair}" for pair in MISALIGNMENTS]
    sizes = ", ".join(
        f"{name} {_MICRO * value:+.0f} ± {_MICRO * u:.0f}"
        for name, value, u in zip(terms, pattern.value, pattern.uncertainty, strict=False)
    )
    looks, remedy, action = {
        "cross": (
            f"they look like products of two axes ({sizes} {unit})",
            f"--cross --order {problem.order or 1} fits these",
            f"fit with --cross --order {problem.order or 1}",
        ),
        "order": (
            f"they look like the next order ({sizes} {unit})",
            f"--order {problem.order + 1} fits it, or --order auto",
            f"fit with --order {problem.order + 1}, or --order auto",
        ),
        "other": (
            "they look like products of the third and fourth degree",
            "no option fits these; repeat the test",
            "repeat the test",
        ),
    }[likeliest]
    return [
        Finding(
            f"the residuals are a function of the direction of gravity, {_MICRO * pattern.size:.3g} µg rms "
            f"(probability by chance {probability_fact(pattern.probability)}): {looks}, which the "
            f"uncertainties do not hold; {remedy}",
            action,
        )
    ]


def time_findings(attitudes: Attitudes, problem: TumbleProblem, solution: TumbleSolution) -> list[str]:
    """Say where the residuals show that the zeros drift: columns ``q_i (t - mean t)``, q = d|f|/d reading."""
    if attitudes.trace is None:
        return []
    middle = (attitudes.start + attitudes.stop) / 2
    span = float(attitudes.stop[-1] - attitudes.start[0])
    time = (middle - middle.mean()) / span
    pattern = find_patterns({"zeros": -solution.jacobian[0][:, 0:3] * time[:, None]}, solution).get("zeros")
    if pattern is None or pattern.size < _TINY or pattern.probability > RESIDUALS_FOLLOW_TIME.level:
        return []
    sizes = ", ".join(
        f"{axis} {1e3 * value:+.2g} ± {1e3 * u:.1g} mg"
        for axis, value, u in zip(AXES, pattern.value, pattern.uncertainty, strict=True)
    )
    return [
        f"the zeros drift over the test: the residuals show {sizes} from its beginning to its end (probability by "
        f"chance {probability_fact(pattern.probability)}); let the unit warm up, and put the attitudes in no "
        "particular order"
    ]


# Which attitudes were knocked: those that no order up to 3 explains, found before the order is chosen.


Index = NDArray[np.intp]

HIGHEST_TESTED = 3  # order for which knocks are looked for: higher ones explain a knock by themselves
_MOST = 3  # attitudes that are set aside of few
_EXHAUSTIVE = 60  # attitudes up to which all sets are tried
_MOST_OF_MANY = 12  # attitudes that are set aside of many, and one in so many at most
_SHARE_OF_MANY = 20  # one attitude in so many
FREEDOM = {True: 3, False: 5}
"""Least degrees of freedom that are left to tell a knock by, noise known or not: on a real recording of 17 attitudes,
order 2 with 4 left agreed by chance to 0.02 mg without one attitude, and predicted nine times worse."""
_SEPARABLE = 0.02
"""Least eigenvalue of R_SS: below it the others do not say where these attitudes should be."""
_DETERMINED = 2000.0  # singular values apart, beyond which the others do not determine the model
_PASSES, _SEARCHES = 5, 5  # exchanges of members of a set; searches, each by the fit without the set found before


class Aside(Struct, frozen=True):
    """Attitudes that stand out: their indices, rising, and their shifts over the standard uncertainties, shape (m,)."""

    index: tuple[int, ...]
    deviations: tuple[float, ...]

    def others(self, count: int) -> Index:
        """Return the indices of the other ones of `count` attitudes."""
        return np.delete(np.arange(count), self.index)


NONE_ASIDE = Aside((), ())


class _Whitened(Struct, frozen=True, dict=True):
    """Residuals of one order in units of their noise, (n,), and an orthonormal basis of what the model explains."""

    residual: Array
    basis: Array

    @cached_property
    def matrix(self) -> Array:
        """R = I - H, shape (n, n)."""
        return np.eye(len(self.residual)) - self.basis @ self.basis.T

    @property
    def squares(self) -> float:
        return float(self.residual @ self.residual)


def find_disturbed(
    problem: TumbleProblem, fits: Callable[[TumbleProblem], dict[int, TumbleSolution]]
) -> tuple[Aside, dict[int, TumbleSolution]]:
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
    aside = find_outliers(plain, known=known)
    for _ in range(_SEARCHES):
        if not aside.index:
            return aside, plain
        solutions = fits(problem.only(aside.others(problem.reading.shape[1])))
        about = {order: evaluate(replace(problem, order=order), solution) for order, solution in solutions.items()}
        # What even the best order leaves unexplained is noise of the others, and no sign of a knock.
        excess = min(float(about[order].excess[0]) for order in _tested(about))
        before, aside = aside, find_outliers(about, known=known, excess=excess)
        if aside.index == before.index:
            break
    return before, solutions


def find_outliers(solutions: Mapping[int, TumbleSolution], *, known: bool, excess: float = 0.0) -> Aside:
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
    return _best_set(solutions, known, excess)[0]


def explaining_order(problem: TumbleProblem, solution: TumbleSolution) -> int | None:
    """Return the higher order that explains all attitudes, some of which an order alone would take for knocked.

    Parameters
    ----------
    problem, solution
        All attitudes of one unit (a batch of one), and their fit of the problem's order; None where none does.
    """
    n, known = problem.reading.shape[1], problem.covariance is not None
    best, least = None, _best_set({problem.order: solution}, known, 0.0)[1]
    for order in range(problem.order + 1, HIGHEST_TESTED + 1):
        size = parameter_count(order)
        if n - size < (1 if known else FREEDOM[False]):
            break
        fit = solve_norm(replace(problem, order=order))
        criterion = _criterion(float((fit.residuals[0] ** 2 / fit.own_variance[0]).sum()), n, size, 0, known)
        if fit.converged[0] and criterion < least:
            best, least = order, criterion
    return best


def _best_set(solutions: Mapping[int, TumbleSolution], known: bool, excess: float) -> tuple[Aside, float]:
    """Return the set with the least information criterion, and that."""
    best, least = NONE_ASIDE, np.inf
    for order in _tested(solutions):
        white = _whitened(solutions[order], excess)
        if white is None:
            continue
        for candidate, criterion in _candidates(white, known):
            if criterion < least:
                best, least = candidate, criterion
    return best, least


def _tested(solutions: Mapping[int, TumbleSolution]) -> list[int]:
    return [order for order in solutions if order <= HIGHEST_TESTED] or list(solutions)


def _whitened(solution: TumbleSolution, excess: float) -> _Whitened | None:
    """Return None where the attitudes do not determine the parameters."""
    variance = solution.own_variance + excess**2
    rows = solution.jacobian[0] / np.sqrt(variance[0, :, None])
    if rows.shape[0] < rows.shape[1] + FREEDOM[True] or not (np.isfinite(rows).all() and rows.any(axis=0).all()):
        return None
    same = np.array_equal(solution.weights, 1 / variance)
    factors = solution.factors if same else factorise(solution.jacobian, 1 / variance)
    values, basis = np.linalg.svd(factors.triangle[0], compute_uv=False), factors.basis[0]
    if values[-1] * _DETERMINED < values[0]:
        return None
    y = solution.residuals[0] / np.sqrt(variance[0])
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
        best = _best_subset(white, m) if n <= _EXHAUSTIVE else _extended(white, chosen)
        if best is None:
            return
        chosen, gain = best
        rss = max(white.squares - gain, 1e-12 * white.squares, 1e-300)
        if comb(n, m) * f_tail(gain * freedom / (m * rss), m, freedom) >= ATTITUDE_SET_ASIDE.level:
            continue
        shift, spread = _shifts(white, chosen)
        z = shift / spread
        if _members_stand_out(z, rss, n, freedom, known):
            scale = (
                1.0
                if known and rss <= chi_square_limit(freedom, ATTITUDES_FIT_STATED_NOISE.level)
                else np.sqrt(rss / freedom)
            )
            order = np.argsort(chosen)
            aside = Aside(tuple(chosen[order].tolist()), tuple((z[order] / scale).tolist()))
            yield aside, _criterion(rss, n, size, m, known)


def _shifts(white: _Whitened, chosen: Index) -> tuple[Array, Array]:
    """Estimated shifts g of a set, and their standard deviations."""
    inverse = np.linalg.inv(white.matrix[np.ix_(chosen, chosen)])
    return inverse @ white.residual[chosen], np.sqrt(np.diag(inverse))


def _members_stand_out(z: Array, rss: float, n: int, freedom: int, known: bool) -> bool:
    """Return whether the weakest member of a set is significant."""
    tests, least = n - len(z) + 1, float(np.abs(z).min())
    return bool(
        2 * tests * t_cdf(-least / np.sqrt(rss / freedom), freedom) < ATTITUDE_SET_ASIDE.level
        and (not known or 2 * tests * normal_cdf(-least) < ATTITUDE_SET_ASIDE.level)
    )


def _criterion(rss: float, n: int, size: int, m: int, known: bool) -> float:
    """``(n - m) ln s^2 + rss / s^2`` and the price of order, set and scale."""
    freedom = n - size - m
    scale, price = max(rss / freedom, 1e-300), 0.0
    if known:
        fits = rss <= chi_square_limit(freedom, ATTITUDES_FIT_STATED_NOISE.level)
        scale, price = (1.0, 0.0) if fits else (max(1.0, scale), log(n))
    sets = lgamma(n + 1) - lgamma(m + 1) - lgamma(n - m + 1)
    return (n - m) * log(scale) + rss / scale + (size + 1.5 * m) * log(n) + 2 * sets + price


def _best_subset(white: _Whitened, m: int) -> tuple[Index, float] | None:
    """Return the m attitudes that explain most of the sum of squares, and how much; None if no set can be separated."""
    best: Index = np.empty(m, dtype=np.int64)
    gain = _model.best_subset(white.residual, white.matrix, _SEPARABLE, best)
    return None if gain < 0 else (best, gain)


def _extended(white: _Whitened, chosen: Index) -> tuple[Index, float] | None:
    """Add the attitude that explains most, then exchange members while that explains more; return what they explain."""
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
    return members, float(white.residual[members] @ _shifts(white, members)[0])


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

"""Which attitudes to measure: D- or A-optimal sets for a tumble test, and what they will give.

What the user may choose from (the sphere, a fixture's steps, a list), what is chosen (optimal.py), what it predicts for
every parameter, and the order of the attitudes that turns least.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from imulab.errors import ObservabilityError, OptionError, listed
from imulab.estimation.least_squares import observability
from imulab.procedures.tumble.advice import sphere_points
from imulab.procedures.tumble.choices import CRITERIA, HIGHEST_ORDER
from imulab.procedures.tumble.model import parameter_count, parameter_names
from imulab.procedures.tumble.optimal import CLOSEST, Search, information_rows, inverse, optimal_set
from imulab.recording import Array

MOST_ATTITUDES = 300
_CANDIDATES = 900


@dataclass(frozen=True)
class Plan:
    """Attitudes to measure, in the order that turns least.

    Attributes
    ----------
    directions
        Upward direction in the body frame, shape (n, 3).
    order
        Order of the model that they are for.
    covariance
        Predicted covariance of the parameters for a nominal sensor, in units of g, per variance of |f| / g in one
        attitude; attitudes already there included. Shape (p, p).
    condition_number
        Of the scaled Jacobian.
    already
        Number of attitudes that were there before.
    """

    directions: Array
    order: int
    covariance: Array
    condition_number: float
    already: int

    @property
    def again(self) -> list[tuple[int, int]]:
        """Numbers, from 1, of attitudes that are one attitude put down twice."""
        near = self.directions @ self.directions.T > np.cos(CLOSEST)
        return [(int(i) + 1, int(j) + 1) for i, j in np.argwhere(np.triu(near, 1)).tolist()]

    def uncertainties(self, noise: float) -> dict[str, float]:
        """Return the standard uncertainty of every parameter in units of g, for a noise of |f| in g."""
        sigma = noise * np.sqrt(np.diag(self.covariance))
        return dict(zip(parameter_names(self.order), sigma.tolist(), strict=True))


def plan_tumble(
    *,
    attitudes: int,
    order: int = 3,
    criterion: str = "A",
    candidates: Array | None = None,
    already: Array | None = None,
    source: str = "sphere",
    seed: int = 1,
    distinct_verticals: bool = False,
) -> Plan:
    """Choose attitudes for a tumble test.

    Criterion A minimises the sum of the parameters' variances (in units of g), D the volume of their confidence region.
    Of sets whose sums are within 1 % of the least, A takes that whose worst axes have the least sum. Where fewer
    candidates lie 3 deg apart than attitudes are asked for, some are put down again, those first that gain most.

    Parameters
    ----------
    attitudes
        Number of attitudes to choose.
    order
        Order of the model, 0 to 5. Attitudes for order 3 show what an order 2 would silently leave in scale factors.
    criterion
        ``"A"`` or ``"D"``.
    candidates
        Upward directions that the fixture allows, shape (m, 3); the whole sphere if not given.
    already
        Upward directions already measured, shape (k, 3).
    source
        Name of the candidates, for messages.
    seed
        Of the random starts.
    distinct_verticals
        Whether x, y and z are each vertical, up or down, in one attitude at most, as the source of method linearised
        has it; no attitude is put down again then.

    Raises
    ------
    OptionError
        Too few or too many attitudes, too few candidates or none far enough apart, or an unknown criterion.
    ObservabilityError
        No choice among the candidates determines the model.
    """
    size = parameter_count(order) if 0 <= order <= HIGHEST_ORDER else 0
    if not size:
        raise OptionError(f"order {order}: expected 0 to {HIGHEST_ORDER}")
    if criterion not in CRITERIA:
        raise OptionError(f"criterion {criterion!r}: expected one of {listed(CRITERIA, criterion)}")
    before = np.empty((0, 3)) if already is None else already
    if not 1 <= attitudes <= MOST_ATTITUDES:
        raise OptionError(f"{attitudes} attitudes: expected 1 to {MOST_ATTITUDES}")
    if attitudes + len(before) < size:
        known = f" with the {len(before)} already there" if len(before) else ""
        raise OptionError(
            f"{attitudes} attitudes{known}: order {order} has {size} parameters; expected at least as many"
        )
    free = candidates is None
    points = sphere_candidates() if candidates is None else _distinct(candidates)
    if len(points) + len(before) < size:
        raise OptionError(f"{source}: {len(points)} different candidate attitudes; expected at least {size}")
    search = Search(order, criterion, before, distinct_verticals)
    best = optimal_set(search, points, attitudes, seed, free=free) if len(points) >= attitudes else None
    if not free and (best is None or len(_without_repeats(search, best)) < attitudes):
        apart = _without_repeats(search, points)
        if distinct_verticals and len(apart) < attitudes:
            raise OptionError(
                f"{source}: {len(apart)} candidate attitudes lie 3 deg apart and repeat no vertical axis; expected at "
                f"least {attitudes}: ask for fewer, or allow more candidates or --repeated-verticals"
            )
        best = apart if len(apart) <= attitudes else optimal_set(search, apart, attitudes, seed, free=free)
    if best is None:
        raise ObservabilityError(
            f"{source}: no {attitudes} of the {len(points)} candidate attitudes determine order {order}"
        )
    rounds = [best, *_repeated(search, points, best, attitudes)]
    best = np.vstack(rounds)
    everything = np.vstack([before, best])
    jacobian = information_rows(everything, order)
    seen = observability(jacobian, np.full(len(everything), 1e16))
    if seen.rank < size:
        confused = " ".join(seen.confused(parameter_names(order)))
        raise ObservabilityError(f"{source}: the candidate attitudes cannot separate {confused} of order {order}")
    paths = np.vstack([shortest_path(each) for each in rounds if len(each)])
    return Plan(paths, order, inverse(jacobian.T @ jacobian), seen.condition, len(before))


def _without_repeats(search: Search, points: Array) -> Array:
    """Candidates that repeat neither one another nor an attitude already there, in their order, shape (k, 3)."""
    found = np.empty((0, 3))
    for point in points:
        if not search.taken(point[None], found)[0]:
            found = np.vstack([found, point])
    return found


def _repeated(search: Search, points: Array, best: Array, attitudes: int) -> list[Array]:
    """Attitudes that make up the number, in rounds: no attitude is put down a third time before all were twice."""
    everywhere = best if len(best) else _without_repeats(replace(search, before=np.empty((0, 3))), points)
    rows, rounds = information_rows(everywhere, search.order), list[Array]()
    kept, left = information_rows(best, search.order), attitudes - len(best)
    while left > 0:
        chosen: list[int] = []
        while len(chosen) < min(left, len(everywhere)):
            gain = search.gain(rows, np.vstack([kept, rows[chosen]]))
            gain[chosen] = -np.inf
            chosen.append(int(np.argmax(gain)))
        rounds.append(everywhere[chosen])
        kept, left = np.vstack([kept, rows[chosen]]), left - len(chosen)
    return rounds


def fixture_candidates(step: float) -> Array:
    """Return the directions of a two-axis fixture that turns in steps of `step`, rad: roll and pitch."""
    count = _steps(step)
    angle = np.arange(count) * (2 * np.pi / count)
    roll, pitch = (grid.ravel() for grid in np.meshgrid(angle, angle))
    return _distinct(np.column_stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)]))


def head_candidates(step: float) -> Array:
    """Return the directions of a dividing head, its axis level, with the unit mounted along x, y and z in turn."""
    count = _steps(step)
    angle = np.arange(count) * (2 * np.pi / count)
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
    return _distinct(np.vstack([np.roll(circle, shift, axis=1) for shift in range(3)]))


def roll_pitch(directions: Array) -> Array:
    """Return roll and pitch, rad, shape (n, 2), of a body with z up when level: up = R_x(roll)' R_y(pitch)' e_z."""
    x, y, z = directions.T
    return np.column_stack([np.arctan2(y, z), np.arctan2(-x, np.hypot(y, z))])


def turning(directions: Array) -> float:
    """Return the sum of the angles from each direction to the next, rad."""
    return float(np.arccos(np.clip(np.einsum("ni,ni->n", directions[:-1], directions[1:]), -1, 1)).sum())


def _steps(step: float) -> int:
    count = round(2 * np.pi / step) if step > 0 else 0
    if not 4 <= count <= 720 or abs(count * step - 2 * np.pi) > 1e-6:
        raise OptionError(f"step {np.degrees(step):g} deg: expected a whole part of 360 deg, 0.5 to 90 deg")
    return count


def sphere_candidates() -> Array:
    """Return an even lattice, with the faces, edges and corners of a cube, which fixtures give exactly, (n, 3)."""
    cube = np.array([v for v in product((-1.0, 0.0, 1.0), repeat=3) if any(v)])
    return np.vstack([cube / np.linalg.norm(cube, axis=1, keepdims=True), sphere_points(_CANDIDATES)])


def _distinct(directions: Array) -> Array:
    """Unit directions without repetitions."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    _, first = np.unique(np.round(unit, 6) + 0.0, axis=0, return_index=True)
    distinct: Array = unit[np.sort(first)]
    return distinct


def shortest_path(directions: Array) -> Array:
    """Order the attitudes so that little is turned between them: nearest neighbour, then 2-opt, level first."""
    count = len(directions)
    angle = np.arccos(np.clip(directions @ directions.T, -1, 1))
    start = int(np.argmax(directions[:, 2]))
    path, left = [start], set(range(count)) - {start}
    while left:
        path.append(min(left, key=lambda k: angle[path[-1], k]))
        left.remove(path[-1])
    improved = True
    while improved:
        improved = False
        for i in range(count - 2):
            for j in range(i + 2, count):
                a, b, c = path[i], path[i + 1], path[j]
                after = angle[b, path[j + 1]] - angle[c, path[j + 1]] if j + 1 < count else 0.0
                if angle[a, c] - angle[a, b] + after < -1e-9:
                    path[i + 1 : j + 1] = path[i + 1 : j + 1][::-1]
                    improved = True
    return directions[path]

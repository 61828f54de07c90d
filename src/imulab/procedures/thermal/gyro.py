"""The gyroscopes over temperature: the bias from all holds at rest, linear, with the accelerometers' nuisances.

    M / S = b(T) + G f + W + offset of the power cycle,   b(T) as in `imulab.procedures.thermal.model`

W is the Earth's rate: what is known of it, and what counts as random, is in `imulab.procedures.thermal.gyroearth`.
Errors of the temperature, offsets between power cycles (tau) and what holds scatter by beyond their noise are those of
`imulab.procedures.thermal.solve`. The g-sensitivity G, the same at all temperatures, is fitted where it is significant
at 1 % (F).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.earth import EARTH
from imulab.errors import ObservabilityError
from imulab.estimation.ranked import MAD_TO_SIGMA
from imulab.procedures.thermal.choices import DEGREES, LEAST_KNOTS
from imulab.procedures.thermal.degrees import (
    Degrees,
    LeftOut,
    bends,
    bounded,
    clusters_of,
    knots_at,
    left_out,
    may_be_taken,
    predicts,
    rms_of,
    splits,
    step_down,
    wald,
)
from imulab.procedures.thermal.gyroearth import earth_at_rest
from imulab.procedures.thermal.gyroholds import RatesAtRest
from imulab.procedures.thermal.holds import Holds
from imulab.procedures.thermal.lag import ALL, Drift, tested, untold
from imulab.procedures.thermal.model import Laws
from imulab.procedures.thermal.rows import Rows, one_hot, whitener
from imulab.procedures.thermal.solve import Scatter, Solution, between, concluded, excess_of
from imulab.recording import Array

_PASSES = 4
_SIGNIFICANT = 0.01
_FAR = 8.0
"""Standard deviations beyond which a hold differs from the others of its recording by a turn."""
_TELL = 4
"""Holds of a recording that tell which of them differs."""
_RANK = 1e-7


@dataclass(frozen=True)
class Gyroscopes:
    """What was found: the holds, and the solution whose coefficients are those of the biases and then G, rad/s per g.

    `probability` is that of so large a G if there were none, None where the attitudes do not tell it; `aside` are the
    holds, of all, that differ from the others of their recording by a turn.
    """

    held: RatesAtRest
    solution: Solution
    sensitivity: bool
    probability: float | None
    left_out: tuple[LeftOut, ...]
    aside: NDArray[np.int64]
    drift: Drift

    def at_rest(self, temperature: Array) -> Array:
        """Return the biases at temperatures (n,), rad/s, shape (n, 3)."""
        laws = self.solution.laws
        rows = self.solution.coefficients[: self.size].reshape(3, -1)
        found: Array = laws.of_bias(temperature) @ rows.T
        return found

    def sensitivities(self, gravity: float) -> Array:
        """Return G, rad/s per m/s^2, shape (3, 3)."""
        return self.solution.coefficients[self.size : self.size + 9].reshape(3, 3) / gravity

    def again(self, held: RatesAtRest) -> Gyroscopes:
        """Return the same terms fitted to other means of the same holds, with the scatter that was found."""
        laws, scatter = self.solution.laws, self.solution.scatter
        found = solve(held, laws, float(scatter.tau[0]), sensitivity=self.sensitivity, free=self.drift.free)
        assert found is not None
        return replace(self, held=held, solution=replace(found, scatter=scatter))

    @property
    def count(self) -> int:
        """Number of coefficients but for lag and loops."""
        return self.size + 9 * self.sensitivity

    @property
    def size(self) -> int:
        """Number of coefficients of the biases."""
        return 3 * self.solution.laws.terms[0]


def fit_gyroscopes(
    held: RatesAtRest,
    low: float,
    high: float,
    wanted: str | Degrees,
    tau: float | None,
    name: str,
    *,
    spline: bool = False,
) -> Gyroscopes:
    """Fit the biases over the range of temperature, degC; `tau` is their scatter between power cycles, rad/s, if known.

    `spline`: they are natural cubic splines with a knot at each temperature; `wanted` ``auto`` chooses between these
    and polynomials.

    Raises
    ------
    ObservabilityError
        The holds are at too few temperatures.
    """
    count = int(clusters_of(held.temperature).max(initial=0)) + 1
    degree = min(DEGREES[0], max(count - 2, 0)) if wanted == "auto" else int(wanted[0])
    least = LEAST_KNOTS if spline else degree + 1
    if count < least:
        what = "a spline" if spline else f"a bias of degree {degree}"
        raise ObservabilityError(
            f"{name}: the gyroscopes are at rest at {count} temperatures (5 K apart), too few for {what}: record at "
            "more temperatures, or lower --degrees"
        )
    laws = Laws(low, high, (degree, 0, 0))
    held, aside = without_turns(held, laws)
    cluster = clusters_of(held.temperature)
    found = _Search(held, cluster, tau).chosen(laws, auto=wanted == "auto", spline=spline)
    solution = found.solution
    if solution.scatter.bound:
        tau = float(solution.scatter.tau[0])
    drift = _drift(held, solution, found.sensitivity, tau)
    if drift.free:
        solution = solve(held, solution.laws, tau, sensitivity=found.sensitivity, free=drift.free) or solution
        if found.solution.scatter.bound:
            solution = replace(solution, scatter=found.solution.scatter)
    places = [
        replace(e, temperature=float(held.temperature[cluster == e.temperature].mean()), holds=e.holds // 3)
        for e in _left_out(solution, cluster)
    ]
    return Gyroscopes(held, solution, found.sensitivity, found.probability, tuple(places), aside, drift)


@dataclass(frozen=True)
class _Solved:
    """A solution, whether G is in it, and the probability of so large a G."""

    solution: Solution
    sensitivity: bool
    probability: float | None


@dataclass(frozen=True)
class _Search:
    """What a choice of laws starts from: holds, the number of the temperature of each, and tau."""

    held: RatesAtRest
    cluster: NDArray[np.int64]
    tau: float | None

    def chosen(self, laws: Laws, *, auto: bool, spline: bool) -> _Solved:
        """Return the solution of laws as stated, or that of the laws that the data support."""
        knots = knots_at(self.held.temperature, self.cluster, laws)
        bent = replace(laws, degrees=(DEGREES[0], 0, 0), knots=knots)
        if spline:
            return self._bounded(_solved(self.held, bent, self.tau))
        found = _solved(self.held, laws, self.tau)
        while auto and found.solution.laws.degrees[0]:
            lower = _lower(found.solution, self.cluster)
            if lower is None:
                break
            found = _solved(self.held, lower, self.tau)
        if not auto or len(knots) < LEAST_KNOTS:
            return found
        try:
            by_knots = _solved(self.held, bent, self.tau)
        except ObservabilityError:
            return found  # the holds do not tell so many values of the bias
        errors = (_left_out(each.solution, self.cluster) for each in (by_knots, found))
        return self._bounded(by_knots) if bends(by_knots.solution, self.tau) and predicts(*errors) else found

    def _bounded(self, found: _Solved) -> _Solved:
        def solved(laws: Laws, tau: float | None) -> Solution:
            solution = solve(self.held, laws, tau, sensitivity=found.sensitivity)
            assert solution is not None
            return solution

        return replace(found, solution=bounded(found.solution, self.tau, solved))


def _left_out(solution: Solution, cluster: NDArray[np.int64]) -> list[LeftOut]:
    return left_out(splits(solution, cluster), np.ones(len(solution.coefficients), dtype=np.bool_))


def _solved(held: RatesAtRest, laws: Laws, tau: float | None) -> _Solved:
    """Solve with the g-sensitivity where it is told and significant, else without."""
    whole = solve(held, laws, tau, sensitivity=True)
    probability = None
    if whole is not None:
        probability = wald(whole, np.eye(len(whole.coefficients))[-9:])
        if probability < _SIGNIFICANT:
            return _Solved(whole, True, probability)
    plain = solve(held, laws, tau, sensitivity=False)
    if plain is None:
        raise ObservabilityError(f"{len(held)} holds do not determine the biases of the gyroscopes")
    return _Solved(plain, False, probability)


def _lower(solution: Solution, cluster: NDArray[np.int64]) -> Laws | None:
    """Return laws of a degree less, or None where that step may not be taken."""
    given = splits(solution, cluster)
    before = rms_of(left_out(given, np.ones(len(solution.coefficients), dtype=np.bool_)))
    step = step_down(solution, 0, given)
    return replace(solution.laws, degrees=step.degrees) if may_be_taken(step, before) else None


def _drift(held: RatesAtRest, solution: Solution, sensitivity: bool, tau: float | None) -> Drift:
    """Return lag and loops of the biases, each tested given the other."""
    size = len(solution.coefficients)
    reason = untold(held.temperature, held.rate, solution, size, 0)
    if reason is not None:
        return Drift(reason=reason)
    whole = solve(held, solution.laws, tau, sensitivity=sensitivity, free=ALL)
    if whole is None:
        return Drift(reason="the holds in which the temperature drifts do not tell lag, loop and laws apart")
    return tested(whole, size)


def solve(
    held: RatesAtRest, laws: Laws, tau: float | None, *, sensitivity: bool, free: tuple[int, ...] = ()
) -> Solution | None:
    """Return the least-squares solution, None where the holds do not determine the coefficients.

    Those of the biases, of G where it is taken, and of what is `free` of lag and loops, as in `Problem`.
    """
    count = 3 * laws.terms[0] + 9 * sensitivity
    coefficients = np.zeros(count + len(free))
    if free:  # a lag is the shift of laws that must be there first
        begun = solve(held, laws, tau, sensitivity=sensitivity)
        if begun is None:
            return None
        coefficients[:count] = begun.coefficients
    excess, freedom, scatter = 0.0, np.inf, Scatter() if tau is None else Scatter(np.array([tau, 0.0]))
    for _ in range(_PASSES):
        rows = rows_of(held, laws, coefficients, free)
        white = whitener(rows, excess, scatter.tau)
        columns = white(rows.jacobian)
        size = np.linalg.norm(columns, axis=0)
        if not size.min() > 0 or np.linalg.matrix_rank(columns / size, tol=_RANK * np.sqrt(len(size))) < len(size):
            return None
        step = np.linalg.lstsq(columns / size, white(rows.residual), rcond=None)[0] / size
        coefficients = coefficients - step
        excess, freedom = excess_of(rows, excess)
        if tau is None:
            scatter = between(rows, excess)
    rows = rows_of(held, laws, coefficients, free)
    return concluded(laws, coefficients, rows, (excess, freedom), scatter, converged=True)


def rows_of(held: RatesAtRest, laws: Laws, coefficients: Array, free: tuple[int, ...]) -> Rows:
    """Return the rows at these coefficients, three for each hold."""
    n, size = len(held), 3 * laws.terms[0]
    jacobian = laws.design(held.temperature)[:, :3, :size].reshape(3 * n, size)
    slope = laws.slope(held.temperature)[:, :3, :size] @ coefficients[:size]
    if len(coefficients) - len(free) > size:
        felt = np.einsum("nj,ik->nikj", held.force, np.eye(3)).reshape(3 * n, 9)
        jacobian = np.hstack([jacobian, felt])
    drift = np.zeros((n, 3, 4))
    drift[:, :, 0] = -held.rate[:, None] * slope
    turn = np.sign(held.rate) * (1 - laws.place(held.temperature) ** 2)
    drift[:, range(3), range(1, 4)] = turn[:, None]
    jacobian = np.hstack([jacobian, drift.reshape(3 * n, 4)[:, list(free)]])
    noise = np.zeros((n, 3, n, 3))
    noise[range(n), :, range(n), :] = held.covariance
    number = np.where(held.shared, held.recording, int(held.recording.max()) + 1 + np.arange(n))
    heat = _spread(number) * (slope * held.step[:, None]).ravel()[:, None]
    known, earth = earth_at_rest(held.force, held.attitude, held.earth)
    return Rows(
        residual=jacobian @ coefficients + known - held.mean.ravel(),
        jacobian=jacobian,
        noise=noise.reshape(3 * n, 3 * n),
        offsets=(_by_axis(held.recording), np.zeros((3 * n, 3))),
        errors=np.hstack([heat, earth]),
        drift=drift.reshape(3 * n, 4),
        owner=np.repeat(np.arange(n), 3),
        magnitude=np.ones(3 * n, dtype=np.bool_),
    )


def _by_axis(number: NDArray[np.int64]) -> Array:
    """Return a column for each axis of each number, shape (3 n, 3 k)."""
    found: Array = np.asarray(np.kron(one_hot(number), np.eye(3)), dtype=np.float64)
    return found


def _spread(number: NDArray[np.int64]) -> Array:
    return np.repeat(one_hot(number), 3, axis=0)


def without_turns(held: RatesAtRest, laws: Laws) -> tuple[RatesAtRest, NDArray[np.int64]]:
    """Leave out holds whose outputs lie far from those of the others in their recording: a slow turn the whole time.

    Return the others, and the places of what is left out among the holds of all recordings.
    """
    n, size = len(held), 3 * laws.terms[0]
    columns = np.hstack([
        laws.design(held.temperature)[:, :3, :size].reshape(3 * n, size),
        _by_axis(held.recording),
    ])  # fmt: skip
    weight: Array = np.ones(n)
    for _ in range(_PASSES):
        root = np.repeat(np.sqrt(weight), 3)
        found = np.linalg.lstsq(columns * root[:, None], held.mean.ravel() * root, rcond=1e-9)[0]
        left = (held.mean.ravel() - columns @ found).reshape(n, 3)
        sigma = MAD_TO_SIGMA * float(np.median(np.abs(left))) + 1e-12
        far = np.abs(left).max(axis=1) / sigma
        weight = 1 / (1 + (far / 2) ** 2)
    many = np.bincount(held.recording)[held.recording] >= _TELL
    own = np.sqrt(np.einsum("nii->ni", held.covariance)).max(axis=1)
    out = (far > _FAR) & many & (np.abs(left).max(axis=1) > np.maximum(_FAR * own, EARTH))
    return held.part(~out), held.index[out]


def notes_on_turns(holds: Holds, aside: NDArray[np.int64]) -> list[str]:
    """Return what is said of the holds that `without_turns` left out."""
    return [
        f"gyro: {holds.label(index)} left out: its outputs differ from the others of its recording: the unit turned"
        for index in aside.tolist()
    ]

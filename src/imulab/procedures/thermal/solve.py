"""Least squares of ``|f(M_p, T_p)| = g`` over the holds of all recordings, and of each recording by itself.

Rows are the magnitudes of all holds and, for holds between which the unit was not moved, their components across the
common direction (two unknowns for each such group). Everything is in units of g.

The covariance V of the rows is the sum of the holds' noise; of an excess variance of the magnitudes; of the error of
the temperature's reading, N(0, u_T^2), and of an offset of each bias (and scale factor) in each power cycle,
N(0, tau^2), both of which several rows share.

tau^2 (`fit_turn_on_scatter`) is the value at which the generalised sum of squares exceeds that with free offsets by q,
the rank that free offsets add: the method of moments of Mandel and Paule, Anal. Chem. 42 (1970) 1194, for a vector.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.decisions import SCALES_SCATTER_BETWEEN_CYCLES
from imulab.estimation.least_squares import chi_square_probability, excess_variance, plausible_excess
from imulab.procedures.thermal.model import Laws, forces
from imulab.recording import Array

# The rows of the least squares: residuals of holds, their derivatives, and the parts of V.


@dataclass(frozen=True)
class ThermalProblem:
    """The holds of a fit in units of g; `temperature`, `step`, `shared`, `recording` and `group` as in `Holds`.

    Attributes
    ----------
    reading, covariance
        Mean outputs over the nominal scale factor, shape (n, 3), and their covariances, shape (n, 3, 3).
    rate
        Change of the temperature, K/s, 0 where it counts as steady, shape (n,).
    tilt
        Standard deviation of the direction of an unmoved hold, rad.
    zero
        Biases to start from, shape (3,).
    known
        A prior: its temperature, nine parameters and their covariance.
    free
        Fitted beside the laws: the lag (s) as 0, the loops of x, y and z (g) as 1 to 3.
    side
        1 for a soak that was reached by warming, -1 by cooling, 0 if not stated.
    wander
        Covariance of the holds' directions beside the tilt, rad^2, shape (n, n).
    """

    reading: Array
    covariance: Array
    temperature: Array
    rate: Array
    step: Array
    shared: NDArray[np.bool_]
    recording: NDArray[np.int64]
    group: NDArray[np.int64]
    tilt: float
    zero: Array
    known: tuple[float, Array, Array] | None = None
    free: tuple[int, ...] = ()
    side: Array | None = None
    wander: Array | None = None


@dataclass(frozen=True)
class Rows:
    """The linearised rows at some coefficients: residuals (N,), Jacobian (N, c), covariance of the noise (N, N).

    `offsets` are the derivatives by offsets of bias and of scale factor in each power cycle, (N, 3 R) each; `errors`
    the derivatives by errors of the temperature, of unit variance; `drift` those by lag and loops, (N, 4), fitted or
    not; `owner` is the hold of each row, -1 for a prior; `magnitude` marks rows that are magnitudes; `recording` is the
    number of each row's recording, that of a prior its own: but for `errors`, noise of two recordings is uncorrelated.
    """

    residual: Array
    jacobian: Array
    noise: Array
    offsets: tuple[Array, Array]
    errors: Array
    drift: Array
    owner: NDArray[np.int64]
    magnitude: NDArray[np.bool_]
    recording: NDArray[np.int64]

    @cached_property
    def blocks(self) -> tuple[list[Block], Array]:
        """The blocks of V, one for all recordings of equally many rows, and the columns of `errors` that they share."""
        order, count = np.argsort(self.recording, kind="stable"), np.bincount(self.recording)
        first = np.cumsum(count) - count
        members = [order[first[count == m][:, None] + np.arange(m)] for m in sorted({*count.tolist()} - {0})]
        shared = np.concatenate([self.errors[which].any(axis=1) for which in members]).sum(axis=0) > 1
        alone, common = (self.errors.compress(each, axis=1) for each in (~shared, shared))
        return [Block.of(self, which, alone) for which in members], common


@dataclass(frozen=True)
class LawsAtHolds:
    """What the rows keep at any coefficients: the laws' `design` and `slope` at the holds, shape (n, 9, size) each.

    `owner` and `kind`, shape (N,), are each row's hold and its direction, 0 along the force, 1 and 2 across; `error`
    marks the column of its temperature's error; `together` are the pairs of rows of one hold, and `wander` the
    covariance of rows by that of directions, shape (N, N), if there is any.
    """

    design: Array
    slope: Array
    owner: NDArray[np.int64]
    kind: NDArray[np.int64]
    error: Array
    together: tuple[NDArray[np.intp], ...]
    wander: Array | None

    @classmethod
    def of(cls, problem: ThermalProblem, laws: Laws) -> LawsAtHolds:
        """Return those of the laws at the holds of a problem."""
        n = len(problem.reading)
        member = np.flatnonzero(problem.group >= 0)
        rows = np.concatenate([np.arange(n) * 3, (member[:, None] * 3 + np.array([1, 2])).ravel()])
        owner, kind = rows // 3, rows % 3
        # One error for a recording, or for each hold of one that drifts.
        number = np.where(problem.shared, problem.recording, problem.recording.max(initial=0) + 1 + np.arange(n))
        design, slope = laws.design(problem.temperature), laws.slope(problem.temperature)
        together, wander = np.nonzero(owner[:, None] == owner) if member.size else (), None
        if problem.wander is not None and problem.wander.any():
            wander = np.where((kind[:, None] == kind) & (kind > 0), problem.wander[owner[:, None], owner], 0.0)
        return cls(design, slope, owner, kind, one_hot(number[owner]), together, wander)


@dataclass(frozen=True)
class Block:
    """What V is at any excess and scatter for r recordings of m rows each.

    Attributes
    ----------
    which
        The rows of each recording, shape (r, m).
    fixed
        Covariances by noise and errors of the temperature, shape (r, m, m).
    held
        1 for rows of holds, 0 for those of a prior, shape (r, m).
    offsets
        Columns of the offsets of bias and scale factor that these rows feel, shape (r, m, k) each.
    """

    which: NDArray[np.intp]
    fixed: Array
    held: Array
    offsets: list[Array]

    @classmethod
    def of(cls, rows: Rows, which: NDArray[np.intp], errors: Array) -> Block:
        """Return that of some of the rows, with these errors of the temperature, shape (N, e)."""
        every = [columns[which] for columns in (errors, *rows.offsets)]
        felt, *offsets = [columns[:, :, columns.any(axis=(0, 1))] for columns in every]
        fixed = rows.noise.take(which[:, :, None] * len(rows.noise) + which[:, None, :]) + felt @ felt.swapaxes(1, 2)
        return cls(which, fixed, np.where(rows.owner[which] >= 0, 1.0, 0.0), offsets)

    def covariance(self, excess: float, tau: Array) -> Array:
        """Return V of these rows, shape (r, m, m)."""
        whole, diagonal = self.fixed.copy(), np.arange(self.which.shape[1])
        whole[:, diagonal, diagonal] += excess * self.held
        for size, columns in zip(tau.tolist(), self.offsets, strict=True):
            if size > 0:
                whole += size**2 * columns @ columns.swapaxes(1, 2)
        return whole


def linearise(problem: ThermalProblem, laws: Laws, coefficients: Array, at: LawsAtHolds | None = None) -> Rows:
    """Return the rows at these coefficients and the mean direction of each unmoved group there."""
    at = at or LawsAtHolds.of(problem, laws)
    count, owner, kind = int(problem.recording.max(initial=0)) + 1, at.owner, at.kind
    parameters, design, drift, slope = evaluate_parameters(problem, laws, coefficients, at)
    force, change = forces(parameters, problem.reading)
    length = np.linalg.norm(force, axis=1)
    sensed = change[:, :, 0:3] / -parameters[:, None, 3:6]  # df / d reading
    noise = sensed @ problem.covariance @ sensed.swapaxes(1, 2)
    directions = _mean_directions(force, problem.group)
    base, basis = _frames(force / length[:, None], directions, problem.group)
    full = basis @ noise @ basis.swapaxes(1, 2)
    lengthening = 0.5 * (np.trace(noise, axis1=1, axis2=2) - full[:, 0, 0])
    side, pick = kind > 0, basis[owner, kind]  # (N, 3)
    felt = (pick[:, None, :] @ change[owner])[:, 0]
    turns = np.zeros((len(owner), 2 * len(directions)))
    turns[side, 2 * problem.group[owner[side]] + kind[side] - 1] = -1.0
    residual = np.where(
        side, np.einsum("Ni,Ni->N", pick, force[owner] - base[owner]), (length - 1 - lengthening)[owner]
    )
    offsets = tuple(_columns_by_recording(felt[:, 3 * k : 3 * k + 3], problem.recording[owner], count) for k in (0, 1))
    heat = np.einsum("Nj,Nj->N", felt, slope[owner]) * problem.step[owner]
    by_drift = (felt[:, None, :] @ drift[owner])[:, 0]
    jacobian = np.hstack([(felt[:, None, :] @ design[owner])[:, 0], by_drift[:, list(problem.free)], turns])
    linearised = Rows(
        residual, jacobian, _row_noise(problem, full, at), (offsets[0], offsets[1]), at.error * heat[:, None],
        by_drift, owner, ~side, problem.recording[owner],
    )  # fmt: skip
    return (
        linearised
        if problem.known is None
        else _add_prior(linearised, problem.known, laws, coefficients, problem.step.max())
    )


def _row_noise(problem: ThermalProblem, full: Array, at: LawsAtHolds) -> Array:
    """Return the covariance of the rows by the noise of each hold along and across, shape (n, 3, 3), and by tilts."""
    owner, kind = at.owner, at.kind
    if not kind.any():
        return np.diag(full[owner, 0, 0])
    full[:, 1, 1] += problem.tilt**2
    full[:, 2, 2] += problem.tilt**2
    first, second = at.together
    noise = np.zeros((len(owner), len(owner))) if at.wander is None else at.wander.copy()
    noise[at.together] += full[owner[first], kind[first], kind[second]]
    return noise


def evaluate_parameters(
    problem: ThermalProblem, laws: Laws, coefficients: Array, at: LawsAtHolds | None = None
) -> tuple[Array, Array, Array, Array]:
    """Return the parameters of each hold (n, 9), and their derivatives by coefficients, by lag and loops, and by T.

    ``p(T - L dT/dt)`` is taken to first order; the error ``p'' (L dT/dt)^2 / 2`` is a microgram at 20 s and 1 K/min.
    The loop of a bias, ``h sign(dT/dt) (1 - theta^2)``, is 0 at the ends of the range, where the temperature turns.
    """
    at = at or LawsAtHolds.of(problem, laws)
    size, lag_and_loops = laws.size, np.zeros(4)
    lag_and_loops[list(problem.free)] = coefficients[size:]
    slope = at.slope @ coefficients[:size]
    drift = np.zeros((len(slope), 9, 4))
    drift[:, :, 0] = -problem.rate[:, None] * slope
    way = np.sign(problem.rate)
    if problem.side is not None:
        way = np.where(way == 0, problem.side, way)
    turn = way * (1 - laws.place(problem.temperature) ** 2)
    drift[:, range(3), range(1, 4)] = turn[:, None]
    parameters, design = at.design @ coefficients[:size], at.design
    if problem.free:
        parameters = parameters + drift @ lag_and_loops
        design = design - lag_and_loops[0] * problem.rate[:, None, None] * at.slope
    return parameters, design, drift, slope


def _mean_directions(force: Array, group: NDArray[np.int64]) -> Array:
    """Return the mean direction of the forces of each group, shape (G, 3)."""
    means = [force[group == k].mean(axis=0) for k in range(int(group.max(initial=-1)) + 1)]
    directions: Array = np.array(means).reshape(-1, 3)
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    return directions


def _frames(unit: Array, directions: Array, group: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return the direction of each hold's group, shape (n, 3); and of the hold, and two across the group's, (n, 3, 3).

    Holds of no group have 0 for directions across.
    """
    member = group >= 0
    base, basis = unit.copy(), np.zeros((len(unit), 3, 3))
    basis[:, 0] = unit
    if member.any():
        base[member] = directions[group[member]]
        helper = np.eye(3)[np.argmin(np.abs(base[member]), axis=1)]
        first = np.cross(base[member], helper)
        first /= np.linalg.norm(first, axis=1)[:, None]
        basis[member, 1], basis[member, 2] = first, np.cross(base[member], first)
    return base, basis


def _columns_by_recording(felt: Array, recording: NDArray[np.int64], count: int) -> Array:
    """Return three columns for each recording, `felt` in its own rows and 0 elsewhere, shape (N, 3 count)."""
    columns = np.zeros((len(felt), count, 3))
    columns[np.arange(len(felt)), recording] = felt
    return columns.reshape(len(felt), -1)


def one_hot(number: NDArray[np.int64]) -> Array:
    """Return a column for each of the numbers (n,), 1 where it stands and 0 elsewhere, shape (n, k)."""
    which, index = np.unique(number, return_inverse=True)
    columns = np.zeros((len(number), len(which)))
    columns[np.arange(len(number)), index] = 1.0
    return columns


def _add_prior(rows: Rows, known: tuple[float, Array, Array], laws: Laws, coefficients: Array, step: float) -> Rows:
    """Return the rows with nine more for the parameters of a prior at its temperature; it counts as one recording."""
    temperature, values, covariance = known
    at = np.array([temperature])
    design, heat = laws.design(at)[0], laws.slope(at)[0] @ coefficients[: laws.size] * step
    n, extra = len(rows.residual), rows.jacobian.shape[1] - laws.size
    noise = np.zeros((n + 9, n + 9))
    noise[:n, :n], noise[n:, n:] = rows.noise, covariance
    offsets = []
    for k, columns in enumerate(rows.offsets):
        extended = np.zeros((n + 9, columns.shape[1] + 3))
        extended[:n, :-3] = columns
        extended[n + 3 * k : n + 3 * k + 3, -3:] = np.eye(3)
        offsets.append(extended)
    return Rows(
        np.append(rows.residual, design @ coefficients[: laws.size] - values),
        np.vstack([rows.jacobian, np.hstack([design, np.zeros((9, extra))])]),
        noise,
        (offsets[0], offsets[1]),
        np.block([[rows.errors, np.zeros((n, 1))], [np.zeros((9, rows.errors.shape[1])), heat[:, None]]]),
        np.vstack([rows.drift, np.zeros((9, 4))]),
        np.append(rows.owner, np.full(9, -1)),
        np.append(rows.magnitude, np.zeros(9, dtype=np.bool_)),
        np.append(rows.recording, np.full(9, rows.recording.max(initial=-1) + 1)),
    )


def row_covariance(rows: Rows, excess: float, tau: Array) -> Array:
    """Return V, shape (N, N)."""
    whole: Array = Block.of(rows, np.arange(len(rows.residual))[None], rows.errors).covariance(excess, tau)[0]
    return whole


def whitener(rows: Rows, excess: float, tau: Array) -> Callable[[Array], Array]:
    """Return a function that multiplies by the inverse of the Cholesky factor of V.

    V has a block for each recording, whose factors are small, beside ``c c'`` of each column that several recordings
    share. What this adds, once whitened, has the factor of ``1 + c c'``: row i less ``c_i`` times the mean of the
    unknown as told by the rows before, over the root of its variance.
    """
    parts, shared = rows.blocks
    blocks = [(block.which, whitener_of(block.covariance(excess, tau))) for block in parts]
    common: list[Array] = []

    def white(columns: Array) -> Array:
        beside = columns.reshape(len(columns), -1)
        whitened: Array = np.empty(beside.shape)
        for which, block in blocks:
            whitened[which] = block(beside[which])
        for loading in common:
            known = 1 + np.append(0.0, np.cumsum(loading**2))
            summed = np.cumsum(loading[:, None] * whitened, axis=0)
            whitened[1:] -= (loading[1:] / known[1:-1])[:, None] * summed[:-1]
            whitened *= np.sqrt(known[:-1] / known[1:])[:, None]
        return whitened.reshape(np.shape(columns))

    for column in shared.T:
        common += [white(column)]  # by all before
    return white


def whitener_of(covariance: Array) -> Callable[[Array], Array]:
    """Return a function that multiplies by the inverse of a covariance's Cholesky factor, or by those of a stack.

    It substitutes forward, block by block; scipy's solver of triangles takes as long to load as a fit takes.
    """
    factor = np.linalg.cholesky(covariance)
    blocks = [slice(start, start + _BLOCK) for start in range(0, factor.shape[-1], _BLOCK)]
    inverses = [np.linalg.inv(factor[..., block, block]) for block in blocks]

    def white(columns: Array) -> Array:
        whitened = np.array(columns if columns.ndim > 1 else columns[:, None], dtype=np.float64)
        for block, inverse in zip(blocks, inverses, strict=True):
            left = whitened[..., block, :]
            if block.start:
                left = left - factor[..., block, : block.start] @ whitened[..., : block.start, :]
            whitened[..., block, :] = inverse @ left
        return whitened.reshape(columns.shape)

    return white


_BLOCK = 24  # rows that are substituted at once: more take longer to invert than fewer to substitute


# The fit.


_PASSES, _STEPS = 4, 12  # passes until scatter and solution agree; Gauss-Newton steps in each
_RESTS = 1e-10  # relative change of the coefficients that ends the steps
_FAST = 0.1  # ratio of two steps below which the next one is taken to have it too
_LOOSE = 0.01
"""Scatter that is assumed at the start, since the first fit has no laws of the temperature, g."""
_SEEN = 1e-7
"""Share of the largest singular value, below which columns are dependent."""

_TELLS = 0.1
"""Least part of an offset's column beside the laws, over its length, from which it counts for the scatter."""
_ALL = slice(None)


@dataclass(frozen=True)
class Scatter:
    """Scatter between power cycles: tau of bias and scale factor, rank q that free offsets add, variance of an offset.

    `bound`: tau is an upper bound from the residuals of polynomials, where a spline takes offsets for the law.
    """

    tau: Array = field(default_factory=lambda: np.zeros(2))
    rank: int = 0
    spread: Array = field(default_factory=lambda: np.zeros(2))
    probability: float | None = None
    bound: bool = False

    @property
    def resolution(self) -> float:
        """Standard uncertainty of one offset of a bias as measured by the recordings."""
        return float(np.sqrt(max(self.spread[0] - self.tau[0] ** 2, 0.0)))


@dataclass(frozen=True)
class ThermalSolution:
    """A fit: coefficients (c,), their covariance, rows, excess (g), scatter tau, and degrees of freedom.

    The coefficients are those of the laws, then the lag and the loops that were fitted beside them.
    """

    laws: Laws
    coefficients: Array
    covariance: Array
    rows: Rows
    excess: float
    excess_freedom: float
    scatter: Scatter
    by_tau: Array
    chi_square: float
    freedom: int
    converged: bool

    @cached_property
    def white(self) -> Callable[[Array], Array]:
        """What whitens the rows: the inverse of the Cholesky factor of V."""
        return whitener(self.rows, self.excess**2, self.scatter.tau)

    def degrees_of_freedom(self, weights: Array) -> float:
        """Return Satterthwaite's degrees of freedom of ``weights . coefficients``, which may be the first ones only."""
        n = len(weights)
        whole = float(weights @ self.covariance[:n, :n] @ weights)
        reciprocal = 1 / self.excess_freedom if np.isfinite(self.excess_freedom) else 0.0
        if self.scatter.rank:
            share = float(weights @ self.by_tau[:n, :n] @ weights) * self.scatter.spread[0] / max(whole, 1e-300)
            reciprocal += min(share, 1.0) ** 2 / self.scatter.rank
        return 1 / reciprocal if reciprocal > 0 else np.inf


def solve(problem: ThermalProblem, laws: Laws, *, tau: float | None = None) -> ThermalSolution:
    """Return the fit of the laws; `tau` is the scatter of the biases between power cycles, g, if it is known.

    Gauss-Newton steps of ``r' V^-1 r`` alternate with estimates of excess and tau, which V depends on.
    """
    still, at = replace(problem, free=()), LawsAtHolds.of(problem, laws)
    coefficients = _start(still, laws)
    if problem.free:  # the derivative by a lag is the slope of laws, which must be fitted first
        begun = linearise(still, laws, coefficients, at)
        coefficients = _iterate(still, laws, coefficients, at, begun, _LOOSE**2, np.zeros(2), 1e-6)[0]
        coefficients = np.append(coefficients, np.zeros(len(problem.free)))
    rows = linearise(problem, laws, coefficients, at)
    excess, excess_freedom, scatter, converged = 0.0, np.inf, Scatter(), False
    if tau is not None:
        scatter = Scatter(np.array([tau, 0.0]))
    for number in range(_PASSES):
        coefficients, rows, converged = _iterate(
            problem, laws, coefficients, at, rows, excess, scatter.tau, _RESTS if number else 1e-6
        )
        if not converged:
            break
        before = excess, scatter.tau
        if number < _PASSES - 1:
            excess, excess_freedom = fit_excess(rows, excess)
            if tau is None:
                scatter = fit_turn_on_scatter(rows, excess)
        if number and np.allclose([excess, *scatter.tau**2], [before[0], *before[1] ** 2], rtol=1e-3, atol=1e-16):
            break
    return conclude(laws, coefficients, rows, (excess, excess_freedom), scatter, converged=converged)


def conclude(
    laws: Laws, coefficients: Array, rows: Rows, excess: tuple[float, float], scatter: Scatter, *, converged: bool
) -> ThermalSolution:
    """Return the solution with covariance ``(J' V^-1 J)^-1``; `excess` is a variance and its degrees of freedom."""
    white = whitener(rows, excess[0], scatter.tau)
    jacobian, residual = white(rows.jacobian), white(rows.residual)
    inverse = np.linalg.pinv(jacobian, rcond=1e-13)
    loading = inverse @ white(rows.offsets[0])
    count = len(coefficients)
    left = residual - jacobian @ (inverse @ residual)
    return ThermalSolution(
        laws, coefficients, (inverse @ inverse.T)[:count, :count], rows, float(np.sqrt(excess[0])), excess[1],
        scatter, (loading @ loading.T)[:count, :count], float(left @ left), len(residual) - jacobian.shape[1],
        converged,
    )  # fmt: skip


def _start(problem: ThermalProblem, laws: Laws) -> Array:
    """Return the coefficients to start from: those of a fit with constant parameters."""
    flat = replace(laws, degrees=(0, 0, 0), knots=())
    start, at = nominal(flat, problem.zero), LawsAtHolds.of(problem, flat)
    rows = linearise(problem, flat, start, at)
    return laws.constant(_iterate(problem, flat, start, at, rows, _LOOSE**2, np.zeros(2), 1e-3)[0])


def nominal(laws: Laws, zero: Array) -> Array:
    """Return the coefficients of an ideal sensor with these biases, shape (3,)."""
    return laws.constant(np.concatenate([zero, np.ones(3), np.zeros(3)]))


def _iterate(
    problem: ThermalProblem,
    laws: Laws,
    coefficients: Array,
    at: LawsAtHolds,
    rows: Rows,
    excess: float,
    tau: Array,
    tolerance: float,
) -> tuple[Array, Rows, bool]:
    """Return coefficients and rows after Gauss-Newton steps with fixed V, and whether they converged.

    They have where a step is below the tolerance, or where steps shrink fast and the next one would be.
    """
    before = 0.0
    for _ in range(_STEPS):
        columns = whitener(rows, excess, tau)(np.column_stack([rows.jacobian, rows.residual]))
        jacobian = columns[:, :-1]
        scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
        step = -np.linalg.lstsq(jacobian / scale, columns[:, -1], rcond=1e-11)[0] / scale
        coefficients = coefficients + step[: len(coefficients)]
        rows = linearise(problem, laws, coefficients, at)
        size = float(np.abs(step[: laws.size]).max())
        if size < tolerance or size < before * min(_FAST, tolerance / size):
            return coefficients, rows, True
        before = size
    return coefficients, rows, False


def fit_excess(rows: Rows, excess: float) -> tuple[float, float]:
    """Return the variance of magnitudes beyond noise, with free offsets of power cycles, and degrees of freedom."""
    variance, freedom = fit_excesses(rows, excess, [np.ones(len(rows.residual), dtype=np.bool_)])
    return float(variance[0]), float(freedom[0])


def fit_excesses(rows: Rows, excess: float, parts: Sequence[NDArray[np.bool_]]) -> tuple[Array, Array]:
    """Return `fit_excess` of several parts of the rows, whole recordings that share no error with the others."""
    white = whitener(rows, excess, np.zeros(2))
    columns = white(np.column_stack([rows.jacobian, rows.offsets[0], rows.residual]))
    noise, held = np.diag(rows.noise), rows.magnitude & (rows.owner >= 0)
    terms = []
    for part in parts:
        laws, beside, residual = np.hsplit(columns[part], [rows.jacobian.shape[1], -1])
        basis = _basis(laws)
        u = np.hstack([basis, _basis_beside(beside, beside - basis @ (basis.T @ beside))])
        left, used, variance = (residual - u @ (u.T @ residual))[:, 0], held[part], noise[part & held]
        terms.append((left[used] * np.sqrt(variance + excess), variance, (1 - (u**2).sum(axis=1))[used]))
    if len({len(residual) for residual, _, _ in terms}) == 1:
        return plausible_excess(*(np.array(each) for each in zip(*terms, strict=True)))
    excesses = [plausible_excess(*(each[None] for each in values)) for values in terms]
    return np.concatenate([each for each, _ in excesses]), np.concatenate([freedom for _, freedom in excesses])


def fit_turn_on_scatter(rows: Rows, excess: float, part: NDArray[np.bool_] | slice = _ALL) -> Scatter:
    """Return the scatter of biases between power cycles, and of scale factors where that is significant.

    tau is the root of ``sum c_k^2 / (1 + s_k^2 tau^2) = q``: c_k the components of the whitened residual along the q
    modes of offsets beside the laws, s_k their singular values. A `part` of the rows is as for `fit_excesses`.
    """
    bias, scale, columns, beside = _offsets_beside_laws(rows, excess, np.zeros(2), part)
    s, force, second, probability = np.empty(0), np.empty(0), 0.0, None
    if rows.offsets[1].any():  # gyroscopes have none
        u = _basis_beside(columns[:, bias], beside[:, bias])
        further = beside - u @ (u.T @ beside)
        s, force = _modes(columns[:, scale], further[:, scale], further[:, -1])
    if len(s):
        probability = chi_square_probability(float((force**2).sum()), len(s))
        if probability < SCALES_SCATTER_BETWEEN_CYCLES.level:
            second = _moments(s, force)
            bias, _, columns, beside = _offsets_beside_laws(rows, excess, np.array([0.0, second]), part)
    s, force = _modes(columns[:, bias], beside[:, bias], beside[:, -1])
    if not len(s):
        return Scatter(np.array([0.0, second]), 0, np.zeros(2), probability)
    tau = _moments(s, force)
    typical = 1 / float(np.mean(s**2)) if len(s) else 0.0
    return Scatter(np.array([tau, second]), len(s), np.array([tau**2 + typical, 0.0]), probability)


def offset_modes(laws: Array, offsets: Array, residual: Array) -> tuple[Array, Array]:
    """Return the singular values of the offsets' columns beside the laws, and the residual's component along each."""
    beside = _beside(laws, np.column_stack([offsets, residual]))
    return _modes(offsets, beside[:, :-1], beside[:, -1])


def _offsets_beside_laws(
    rows: Rows, excess: float, tau: Array, part: NDArray[np.bool_] | slice
) -> tuple[slice, slice, Array, Array]:
    """Return the whitened offsets of biases and scale factors, and the residual as last column, beside the laws.

    Returned are the places of both among these columns, the whole columns, and their parts beside the laws.
    """
    bias, scale = (offsets.shape[1] for offsets in rows.offsets)
    columns = whitener(rows, excess, tau)(np.column_stack([rows.jacobian, *rows.offsets, rows.residual]))[part]
    laws, others = columns[:, : rows.jacobian.shape[1]], columns[:, rows.jacobian.shape[1] :]
    return slice(0, bias), slice(bias, bias + scale), others, _beside(laws, others)


def _modes(offsets: Array, beside: Array, residual: Array) -> tuple[Array, Array]:
    """Return the singular values of the offsets beside the laws, and the component along each of the residual there."""
    v, s, _ = np.linalg.svd(beside, full_matrices=False)
    observable = s > _TELLS * np.linalg.norm(offsets, axis=0).max()
    return s[observable], v[:, observable].T @ residual


def _beside(laws: Array, columns: Array) -> Array:
    """Return the part of columns (N, c) beside the laws, in any orthonormal basis of what the laws leave free."""
    size = laws.shape[1]
    laws = laws / np.maximum(np.linalg.norm(laws, axis=0), 1e-300)
    triangle = np.asarray(np.linalg.qr(np.hstack([laws, columns]), mode="r"))
    if len(triangle) > size and _is_independent(triangle[:size, :size]):
        return triangle[size:, size:]
    u = _basis(laws)
    return columns - u @ (u.T @ columns)


def _basis(columns: Array) -> Array:
    """Return an orthonormal basis of columns, shape (N, rank)."""
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    q, triangle = np.linalg.qr(columns)
    if len(triangle) == triangle.shape[1] and _is_independent(triangle):
        return np.asarray(q)
    u, values, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(u[:, values > _SEEN * values[0]])


def _basis_beside(columns: Array, beside: Array) -> Array:
    """Return an orthonormal basis of what of columns lies beside others, shape (N, rank)."""
    u, values, _ = np.linalg.svd(beside / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), full_matrices=False)
    return np.asarray(u[:, values > _SEEN])


def _is_independent(triangle: Array) -> bool:
    """Return whether the columns of a triangle, each of length 1, are independent."""
    size = len(triangle)
    if np.abs(triangle.diagonal()).min() > _SEEN:  # then often a bound of the smallest singular value tells
        inverse = np.linalg.inv(triangle)
        if np.vdot(inverse, inverse) * size * _SEEN**2 < 1:
            return True
    values = np.linalg.svd(triangle, compute_uv=False)
    return bool(values[-1] > _SEEN * values[0])


def _moments(s: Array, force: Array) -> float:
    """Return the tau at which ``sum force^2 / (1 + s^2 tau^2)`` is the number of terms; 0 if it is less at tau = 0."""
    return float(np.sqrt(excess_variance((force / s)[None], 1 / s[None] ** 2, len(s))[0]))


# The calibration of each recording at a steady temperature by itself, to be drawn beside the laws.


_FEWEST = 12
"""Fewest holds for nine parameters."""
_CONDITION = 1e3
"""Largest condition number of the nine parameters' columns, each scaled to length 1."""


@dataclass(frozen=True)
class OwnCalibration:
    """The nine parameters of one recording and their standard uncertainties, in units of g, at its temperature, degC.

    `recording` is its number, -1 for the prior.
    """

    recording: int
    temperature: float
    values: Array
    standard_uncertainty: Array


def own_calibrations(problem: ThermalProblem, solution: ThermalSolution) -> list[OwnCalibration]:
    """Return the calibration by each recording alone, where its holds determine one, and that of a prior.

    Nine constants are added to the laws and fitted to ``|f| = g`` of the recording's holds: one Gauss-Newton step,
    since the laws are near already. The uncertainty includes that of the temperature.
    """
    parameters, _, _, slope = evaluate_parameters(problem, solution.laws, solution.coefficients)
    force, change = forces(parameters, problem.reading)
    length = np.linalg.norm(force, axis=1)
    columns = np.einsum("ni,nij->nj", force / length[:, None], change)
    rows = solution.rows
    used = np.flatnonzero(rows.magnitude & (rows.owner >= 0))
    used = used[np.argsort(rows.owner[used])]
    residual = rows.residual[used]
    weight = 1 / np.sqrt(np.diag(rows.noise)[used] + solution.excess**2)
    calibrations = []
    for number in np.unique(problem.recording).tolist():
        members = (problem.recording == number) & problem.shared
        if members.sum() < _FEWEST:
            continue
        matrix = columns[members] * weight[members, None]
        size = np.linalg.norm(matrix, axis=0)
        u, spread, v = np.linalg.svd(matrix / size, full_matrices=False)
        if not spread[0] <= _CONDITION * spread[-1]:
            continue
        inverse = v.T / spread @ u.T / size[:, None]
        values = parameters[members].mean(axis=0) - inverse @ (weight[members] * residual[members])
        by_heat = (slope[members] * problem.step[members, None]).mean(axis=0)
        u = np.sqrt((inverse**2).sum(axis=1) + by_heat**2)
        calibrations.append(OwnCalibration(number, float(problem.temperature[members].mean()), values, u))
    if problem.known is not None:
        temperature, values, covariance = problem.known
        calibrations.append(OwnCalibration(-1, temperature, values, np.sqrt(np.diag(covariance))))
    return calibrations

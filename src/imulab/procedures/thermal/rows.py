"""The rows of the least squares over temperature: residuals of holds, derivatives, and what of V they carry.

Rows are the magnitudes of all holds and, where holds were not moved between, their components across the common
direction u (two unknowns for each such group). Everything is in units of g.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.procedures.thermal.model import Laws, forces
from imulab.recording import Array


@dataclass(frozen=True)
class Problem:
    """Holds in units of g: readings (n, 3), covariances of the mean (n, 3, 3), temperature, step, as in `Holds`.

    `rate`: change of the temperature, K/s, 0 where it counts as still; `tilt`: standard deviation of the direction of
    an unmoved hold, rad; `zero`: biases to start from, shape (3,); `known`: a prior as rows of nine parameters,
    ``(temperature, values (9,), covariance (9, 9))``; `free`: what is fitted beside the laws, the lag (s) as 0, the
    loops of x, y and z (g) as 1 to 3; `side`: whether a soak was reached by warming (1) or
    cooling (-1), 0 where nobody says; `wander`: covariance of the holds' directions beside the tilt, rad^2, (n, n).
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
    """The linearised rows at some coefficients: residuals (N,), Jacobian (N, c), own covariance as blocks.

    `offsets` are the derivatives by an offset of bias (and scale factor) of each power cycle, (N, 3 R) each; `errors`
    the loadings of errors of the temperature; `drift` the derivatives by lag and loops, (N, 4), fitted or not; `owner`
    the hold of each row, -1 for a prior's; `magnitude` those that are magnitudes.
    """

    residual: Array
    jacobian: Array
    noise: Array
    offsets: tuple[Array, Array]
    errors: Array
    drift: Array
    owner: NDArray[np.int64]
    magnitude: NDArray[np.bool_]


def linearise(problem: Problem, laws: Laws, coefficients: Array, directions: Array) -> Rows:
    """Return the rows at these coefficients; `directions` are those of the unmoved groups, shape (G, 3)."""
    n, count = len(problem.reading), int(problem.recording.max(initial=0)) + 1
    parameters, design, drift, slope = parameters_of(problem, laws, coefficients)
    force, change = forces(parameters, problem.reading)
    length = np.linalg.norm(force, axis=1)
    unit = force / length[:, None]
    sensed = -change[:, :, 0:3] / parameters[:, None, 3:6]  # df / d reading
    noise = np.einsum("nij,njk,nlk->nil", sensed, problem.covariance, sensed)
    along = np.einsum("ni,nij,nj->n", unit, noise, unit)
    lengthening = 0.5 * (np.trace(noise, axis1=1, axis2=2) - along)
    by_heat = np.einsum("nij,nj->ni", change, slope)
    member = np.flatnonzero(problem.group >= 0)
    base, across = _frames(unit, directions, problem.group)
    basis = np.concatenate([unit[:, None, :], across], axis=1)  # (n, 3, 3): along, two across
    rows = np.concatenate([np.arange(n) * 3, (member[:, None] * 3 + np.array([1, 2])).ravel()])
    owner, kind = rows // 3, rows % 3
    pick = basis[owner, kind]  # (N, 3)
    full = np.einsum("nai,nij,nbj->nab", basis, noise, basis)
    full[:, 1, 1] += problem.tilt**2
    full[:, 2, 2] += problem.tilt**2
    own = np.where(owner[:, None] == owner, full[owner[:, None], kind[:, None], kind[None, :]], 0.0)
    if problem.wander is not None and problem.wander.any():
        tipped = np.where((kind[:, None] == kind) & (kind > 0), problem.wander[owner[:, None], owner], 0.0)
        own = own + tipped
    jacobian = np.einsum("Ni,Nij,Njc->Nc", pick, change[owner], design[owner])
    turns = np.zeros((len(rows), 2 * len(directions)))
    side = kind > 0
    turns[side, 2 * problem.group[owner[side]] + kind[side] - 1] = -1.0
    residual = np.where(
        side, np.einsum("Ni,Ni->N", pick, force[owner] - base[owner]), (length - 1 - lengthening)[owner]
    )
    felt = np.einsum("Ni,Nij->Nj", pick, change[owner])
    offsets = tuple(_per_recording(felt[:, 3 * k : 3 * k + 3], problem.recording[owner], count) for k in (0, 1))
    heat = np.einsum("Ni,Ni->N", pick, by_heat[owner]) * problem.step[owner]
    errors = _errors(heat, owner, problem, count)
    by_drift = np.einsum("Nj,Njk->Nk", felt, drift[owner])
    jacobian = np.hstack([jacobian, by_drift[:, list(problem.free)], turns])
    found = Rows(residual, jacobian, own, (offsets[0], offsets[1]), errors, by_drift, owner.astype(np.int64), ~side)
    return found if problem.known is None else _with_prior(found, problem.known, laws, coefficients, problem.step.max())


def parameters_of(problem: Problem, laws: Laws, coefficients: Array) -> tuple[Array, Array, Array, Array]:
    """Return the parameters of each hold (n, 9), their derivatives by the laws' coefficients, by lag and loops, by T.

    ``p(T - L dT/dt)`` is taken to first order, which leaves p'' (L dT/dt)^2 / 2: a microgram at 20 s and 1 K/min; the
    loop of a bias is ``h sign(dT/dt) (1 - theta^2)``, none at the ends, where the temperature turns.
    """
    size, own = laws.size, np.zeros(4)
    own[list(problem.free)] = coefficients[size:]
    design, slopes = laws.design(problem.temperature), laws.slope(problem.temperature)
    slope = slopes @ coefficients[:size]
    drift = np.zeros((len(slope), 9, 4))
    drift[:, :, 0] = -problem.rate[:, None] * slope
    way = np.sign(problem.rate)
    if problem.side is not None:
        way = np.where(way == 0, problem.side, way)
    turn = way * (1 - laws.place(problem.temperature) ** 2)
    drift[:, range(3), range(1, 4)] = turn[:, None]
    parameters = design @ coefficients[:size] + drift @ own
    return parameters, design - own[0] * problem.rate[:, None, None] * slopes, drift, slope


def _frames(unit: Array, directions: Array, group: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return the direction of each hold's group, and two unit vectors across it, shapes (n, 3) and (n, 2, 3)."""
    base = unit.copy()
    base[group >= 0] = directions[group[group >= 0]]
    helper = np.eye(3)[np.argmin(np.abs(base), axis=1)]
    first = np.cross(base, helper)
    first /= np.linalg.norm(first, axis=1)[:, None]
    return base, np.stack([first, np.cross(base, first)], axis=1)


def _per_recording(felt: Array, recording: NDArray[np.int64], count: int) -> Array:
    columns = np.zeros((len(felt), count, 3))
    columns[np.arange(len(felt)), recording] = felt
    return columns.reshape(len(felt), -1)


def _errors(heat: Array, owner: NDArray[np.int64], problem: Problem, count: int) -> Array:
    """Loadings of the temperature's errors: one for a recording, or for each hold of one that drifts."""
    number = np.where(problem.shared, problem.recording, count + np.arange(len(problem.recording)))[owner]
    return one_hot(number) * heat[:, None]


def one_hot(number: NDArray[np.int64]) -> Array:
    """Return a column for each of the numbers (n,), 1 where it stands and 0 elsewhere, shape (n, k)."""
    which, index = np.unique(number, return_inverse=True)
    found = np.zeros((len(number), len(which)))
    found[np.arange(len(number)), index] = 1.0
    return found


def _with_prior(rows: Rows, known: tuple[float, Array, Array], laws: Laws, coefficients: Array, step: float) -> Rows:
    """Add the nine parameters of a prior at its temperature, read in steps too, which counts as one recording."""
    temperature, values, covariance = known
    at = np.array([temperature])
    design, heat = laws.design(at)[0], laws.slope(at)[0] @ coefficients[: laws.size] * step
    n, extra = len(rows.residual), rows.jacobian.shape[1] - laws.size
    noise = np.zeros((n + 9, n + 9))
    noise[:n, :n], noise[n:, n:] = rows.noise, covariance
    offsets = []
    for k, given in enumerate(rows.offsets):
        own = np.zeros((n + 9, given.shape[1] + 3))
        own[:n, :-3] = given
        own[n + 3 * k : n + 3 * k + 3, -3:] = np.eye(3)
        offsets.append(own)
    return Rows(
        np.append(rows.residual, design @ coefficients[: laws.size] - values),
        np.vstack([rows.jacobian, np.hstack([design, np.zeros((9, extra))])]),
        noise,
        (offsets[0], offsets[1]),
        np.block([[rows.errors, np.zeros((n, 1))], [np.zeros((9, rows.errors.shape[1])), heat[:, None]]]),
        np.vstack([rows.drift, np.zeros((9, 4))]),
        np.append(rows.owner, np.full(9, -1)),
        np.append(rows.magnitude, np.zeros(9, dtype=np.bool_)),
    )


def together(rows: Rows, excess: float, tau: Array) -> Array:
    """Return V, shape (N, N)."""
    whole = rows.noise + rows.errors @ rows.errors.T
    whole[np.diag_indices(len(whole))] += np.where(rows.owner >= 0, excess, 0.0)
    for size, offsets in zip(tau, rows.offsets, strict=True):
        if size > 0:
            whole += size**2 * offsets @ offsets.T
    return whole


def whitener(rows: Rows, excess: float, tau: Array) -> Callable[[Array], Array]:
    """Return what multiplies by the inverse of the Cholesky factor of V."""
    from scipy.linalg import solve_triangular

    factor = np.linalg.cholesky(together(rows, excess, tau))

    def white(columns: Array) -> Array:
        found: Array = solve_triangular(factor, columns, lower=True, check_finite=False)
        return found

    return white

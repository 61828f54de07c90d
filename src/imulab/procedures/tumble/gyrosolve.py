"""The fit of the turns: from which outputs at rest, and without which turns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.errors import DataError
from imulab.estimation.least_squares import Fit, covariance, f_test, least_squares
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.gyrorest import Rest, at_rest, find_holds
from imulab.procedures.tumble.gyroturns import COLUMNS, ROWS, Segments, find_turns, model, start_scale
from imulab.recording import Array
from imulab.units import parse_unit, to_si
from imulab.verdict import Bad, Note

_WORST_TURN = np.radians(20.0)
_FAR = np.radians(8.0)
_STANDS_OUT = 3.0  # medians; of 30 turns whose misses are normal, none is so far out in 94 % of tests
_BY_CHANCE = 1e-3
_REWEIGHTED = 6
_MANY = 3  # one turn in so many
_FEWEST_LEFT = 6  # degrees of freedom


@dataclass(frozen=True)
class Case:
    """What does not change when the time, or the choice of the sensitivity, does."""

    name: str
    attitudes: Attitudes
    force: Array
    own: Array
    own_force: Array
    output: Array
    unit: str
    fit_bias: bool
    knocked: NDArray[np.bool_]
    """Attitudes that the accelerometers' record set aside, shape (n,)."""
    earth: Array | float = 0.0
    """Output by what is known of the Earth's rate in each attitude, shape (n, 3)."""
    vertical: Array | None = None
    """Output by the Earth's whole rate along up in each, shape (n, 3), where nobody knows which part of it is there."""

    def force_at(self, time: Array) -> Array:
        """Specific force at the gyroscopes' sample times, m/s^2, shape (n, 3)."""
        if len(self.own) == len(time) and np.array_equal(self.own, time):
            return self.own_force
        return np.column_stack([np.interp(time, self.own, column) for column in self.own_force.T])


@dataclass(frozen=True)
class Solved:
    """Scaled parameters (p,) that fit the turns, residuals (3 m,), Jacobian (3 m, p), and what was set aside."""

    segments: Segments
    rest: Rest
    scale: Array
    theta: Array
    residual: Array
    jacobian: Array
    converged: bool
    aside: Array
    notes: tuple[str, ...]

    def rate(self, output: Array) -> Array:
        """Body rate of samples, rad/s, shape (n, 3); what acceleration adds is left in."""
        t = np.eye(3)
        t[ROWS, COLUMNS] = self.theta[3:9]
        moved = self.scale * self.theta[9:12] if self.theta.size > 9 else 0.0
        scaled = (output - self.rest.zero - moved) / (self.scale * (1 + self.theta[:3]))
        return np.asarray(np.linalg.solve(t, scaled.T).T, dtype=np.float64)

    def output_of(self, rate: Array) -> Array:
        """Output that body rates, rad/s, shape (n, 3), add."""
        t = np.eye(3)
        t[ROWS, COLUMNS] = self.theta[3:9]
        return self.scale * (1 + self.theta[:3]) * (rate @ t.T)

    @property
    def typical_miss(self) -> float:
        """Median angle by which the turns miss, rad."""
        return float(np.median(np.linalg.norm(self.residual.reshape(-1, 3), axis=1)))

    def cost(self, attitudes: NDArray[np.intp]) -> float:
        """Sum of squares, rad^2, over the turns that begin at some of the attitudes."""
        chosen = np.isin(self.segments.attitude, attitudes)
        return float((self.residual.reshape(-1, 3)[chosen] ** 2).sum())


def solve_turns(case: Case, time: Array, sensitivity: str) -> Solved:
    """Solve with what the outputs at rest say; a sensitivity with which the turns miss more is not taken by itself."""
    holds = find_holds(case.attitudes, time, case.output, case.name)

    def solved(wanted: str) -> Solved:
        rest = at_rest(holds, case.output, case.force, wanted, case.earth, case.vertical)
        moving = None if rest.slope is None else case.force_at(time)
        segments, notes = find_turns(holds, time, case.output, case.force, rest, moving, case.name)
        beside = case.knocked[segments.attitude] | case.knocked[segments.attitude + 1]
        if beside.any():
            numbers = " ".join(map(str, (np.flatnonzero(case.knocked) + 1).tolist()))
            left_out = (
                f"gyro: {int(beside.sum())} turns left out, beside attitudes that the record set aside ({numbers})"
            )
            segments, notes = segments.part(~beside), [*notes, Note(left_out)]
        return _solve(case, segments, rest, notes)

    found = solved(sensitivity)
    if sensitivity != "auto" or found.rest.slope is None:
        return found
    without = solved("no")
    both = np.intersect1d(found.segments.attitude, without.segments.attitude)
    return found if found.cost(both) < without.cost(both) else without


def _solve(case: Case, segments: Segments, rest: Rest, notes: list[str]) -> Solved:
    """Fit the turns; those that stand out from all others are set aside one by one."""
    known = parse_unit(case.unit)
    scale = np.full(3, 1 / to_si(1.0, known.symbol)) if known.quantity == "rate" else start_scale(segments)
    theta = np.zeros(12 if case.fit_bias else 9)
    residual = model(segments, scale, theta, case.fit_bias)[0].reshape(-1, 3)
    if known.quantity == "rate" and np.median(np.linalg.norm(residual, axis=1)) > _FAR:
        scale = start_scale(segments)  # the stated unit may be wrong
    weights: Array = np.ones(len(segments.before))
    fit = _fitted(segments, scale, theta, weights)
    out, missed = _outliers(segments, scale, fit)
    kept = segments
    if out.any():
        kept = segments.part(~out)
        fit = _fitted(kept, scale, fit.parameters[0], weights[~out])
    theta, residual, jacobian = fit.parameters[0], fit.residuals[0], fit.jacobian[0]
    miss = float(np.median(np.linalg.norm(residual.reshape(-1, 3), axis=1)))
    if not miss < _WORST_TURN:
        raise DataError(
            f"{case.name}: columns gyro_x gyro_y gyro_z: the turns miss the change of gravity's direction by "
            f"{np.degrees(miss):.0f} deg (median of {len(residual) // 3}): swapped or reversed axes, or a wrong unit?"
        )
    others = float(np.sqrt((residual**2).sum() / (len(residual) // 3)))
    aside = np.column_stack([segments.start, segments.stop, missed])[out]
    notes = notes + [
        f"gyro: the turn at {start:.1f} to {stop:.1f} s set aside: it misses by {np.degrees(size):.3g} deg, the "
        f"others by {np.degrees(others):.3g} deg rms: knocked, or samples lost?"
        for start, stop, size in aside.tolist()
    ]
    if out.sum() * _MANY > len(out):
        notes.append(
            Bad(
                f"gyro: {int(out.sum())} of {len(out)} turns stand out from the others: too many to tell which are "
                "right; record again, without knocks and without lost samples"
            )
        )
    return Solved(kept, rest, scale, theta, residual, jacobian, bool(fit.converged[0]), aside, tuple(notes))


def _fitted(segments: Segments, scale: Array, theta: Array, weights: Array) -> Fit:
    """Return the fit of some turns, weighted (m,), from the parameters theta."""
    return least_squares(
        lambda parameters: model(segments, scale, parameters, theta.size > 9),
        theta,
        np.repeat(weights, 3),
        tolerance=1e-8,
    )


def _outliers(segments: Segments, scale: Array, fit: Fit) -> tuple[NDArray[np.bool_], Array]:
    """Return which turns stand out (m,), and what the others' fit misses each by, rad, (m,).

    Candidates are far out under a fit that bounds the pull of each turn (Cauchy's weights on the scale of the median);
    one stands out if the fit without all candidates predicts it so badly by chance in 0.1 % of tests of all turns
    (F-test). Where the median turn is not far below the worst, there are none.
    """
    m, size = len(segments.before), fit.parameters.shape[1]
    miss = np.linalg.norm(fit.residuals[0].reshape(m, 3), axis=1)
    nothing = np.zeros(m, dtype=np.bool_)
    if miss.max() <= _STANDS_OUT * np.median(miss) or 2 * m < size + _FEWEST_LEFT:
        return nothing, miss
    for _ in range(_REWEIGHTED):
        fit = _fitted(segments, scale, fit.parameters[0], 1 / (1 + (miss / (2 * np.median(miss))) ** 2))
        miss = np.linalg.norm(fit.residuals[0].reshape(m, 3), axis=1)
    out = miss > _STANDS_OUT * np.median(miss)
    left = 2 * int((~out).sum()) - size
    if not out.any() or left < _FEWEST_LEFT:
        return nothing, miss
    fit = _fitted(segments, scale, fit.parameters[0], np.where(out, 0.0, 1.0))
    residual, rows = fit.residuals[0].reshape(m, 3), fit.jacobian[0].reshape(m, 3, size)
    spread = rows @ covariance(fit.jacobian, np.repeat(np.where(out, 0.0, 1.0), 3)[None])[0] @ np.swapaxes(rows, 1, 2)
    far = np.einsum("mi,mi->m", residual, np.linalg.solve(np.eye(3) + spread, residual[:, :, None])[:, :, 0])
    cost = float((residual[~out] ** 2).sum())
    for k in np.flatnonzero(out).tolist():
        out[k] = m * f_test(cost + float(far[k]), size, cost, size + 2, left + size + 2) < _BY_CHANCE
    return out, np.linalg.norm(residual, axis=1)


def turn_covariance(found: Solved, shared: Array, freedom: int) -> tuple[Array, float]:
    """Return the covariance of the parameters, (p, p), and the variance that each residual has of its own.

    `shared`, (3 m, 3 m), is what the residuals have in common; what they scatter beyond it is taken to be alike in all.
    """
    residual, jacobian = found.residual, found.jacobian
    bread = covariance(jacobian[None], np.ones((1, len(residual))))[0]
    pulled = jacobian.T @ shared @ jacobian
    left = float(residual @ residual) - float(np.trace(shared)) + float(np.trace(bread @ pulled))
    variance = max(left, 0.0) / freedom
    return bread @ pulled @ bread + variance * bread, variance

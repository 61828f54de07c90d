"""Uncertainty of a tumble fit by propagation of distributions (JCGM 101, GUM Supplement 1).

Each trial draws the attitudes' outputs about what was measured and runs the estimator again; thousands of trials are
one batch of the solver. Where the noise was estimated, each trial scales it by ``sqrt(nu / chi2_nu)``, which makes the
parameters' distribution a Student t with nu degrees of freedom (JCGM 101, 6.4.9).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from imulab.errors import OptionError
from imulab.procedures.tumble.solve import TumbleProblem, TumbleSolution, solve_norm
from imulab.recording import Array

_AT_ONCE = 2000  # trials fitted as one batch: it bounds memory
FEWEST_TRIALS, MOST_TRIALS = 1000, 10_000_000  # from 1000 on a standard deviation is known to 2 %


@dataclass(frozen=True)
class MonteCarlo:
    """Trials of a fit.

    Attributes
    ----------
    theta
        Scaled parameters of every trial that converged, shape (trials, p).
    failed
        Number of trials that did not converge.
    """

    theta: Array
    failed: int


def check_trials(trials: int) -> None:
    """Check the number of trials.

    Raises
    ------
    OptionError
        Too few or too many.
    """
    if not FEWEST_TRIALS <= trials <= MOST_TRIALS:
        raise OptionError(f"monte-carlo {trials}: expected {FEWEST_TRIALS} to {MOST_TRIALS} trials")


def propagate(
    problem: TumbleProblem,
    solution: TumbleSolution,
    *,
    trials: int,
    freedom: float | None,
    seed: int = 1,
    progress: Callable[[int], None] = lambda _: None,
) -> MonteCarlo:
    """Draw the attitudes' outputs and fit them again, `trials` times.

    Parameters
    ----------
    problem, solution
        What was fitted, a batch of one.
    trials
        1000 to 10,000,000.
    freedom
        Degrees of freedom of the noise where it was estimated, else None.
    seed
        Of the random numbers.
    progress
        Called with the number of trials done so far.

    Raises
    ------
    OptionError
        Too few or too many trials.
    """
    check_trials(trials)
    rng = np.random.default_rng(seed)
    problem = problem.held_still(solution)
    covariance = _noise(problem, solution)
    root = np.linalg.cholesky(covariance)
    n = problem.reading.shape[1]
    parameters, failed, done = [], 0, 0
    while done < trials:
        count = min(_AT_ONCE, trials - done)
        factor = np.ones(count) if freedom is None else np.sqrt(freedom / rng.chisquare(freedom, count))
        noise = np.einsum("nij,bnj->bni", root, rng.standard_normal((count, n, 3))) * factor[:, None, None]
        known = None if problem.covariance is None else covariance[None]
        batch = replace(problem, reading=problem.reading + noise, covariance=known, excess=False)
        fit = solve_norm(batch, np.repeat(solution.theta, count, axis=0))
        parameters.append(fit.theta[fit.converged])
        failed += int(count - np.count_nonzero(fit.converged))
        done += count
        progress(done)
    return MonteCarlo(np.vstack(parameters), failed)


def _noise(problem: TumbleProblem, solution: TumbleSolution) -> Array:
    """Covariance of each attitude's output to draw from, shape (n, 3, 3): as known with its excess, or as estimated."""
    n, size = problem.reading.shape[1], solution.theta.shape[1]
    identity = np.eye(3)
    if problem.covariance is not None:
        # Along the vertical, where it is seen, an isotropic excess has the variance that was found.
        known: Array = problem.covariance[0] * solution.scale[0] ** 2 + solution.excess[0] ** 2 * identity
        return known
    if problem.robust:
        variance = float(solution.scale[0] ** 2)
    else:
        variance = float((solution.residuals[0] ** 2).sum()) / max(n - size, 1)
    return np.broadcast_to(variance * identity, (n, 3, 3)).copy()

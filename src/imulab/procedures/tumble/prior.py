"""An earlier record as prior knowledge that may have aged, and whether fresh attitudes contradict it.

The record's covariance is widened by ``diag(tau_b^2, tau_s^2, tau_m^2)`` for biases, scale factors and misalignments.
Each tau is unknown: half-Cauchy of scale 2 sigma, sigma the noise of one attitude (Gelman, Bayesian Analysis 1 (2006)
515), on a grid of logarithms, weighted by how probable it makes the attitudes. Mean and covariance are those of the
mixture, so that an old record counts for as much as it still agrees. A test of the record as it stands only warns:
widening after a test that failed would leave what the test missed uncovered.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from msgspec.structs import replace

from imulab.display import Bad, Finding
from imulab.errors import RecordError
from imulab.estimation.decisions import ATTITUDES_DISTURBED, PRIOR_CONTRADICTED, PRIOR_EXPLAINS_NOTHING
from imulab.estimation.distributions import probability_text
from imulab.estimation.least_squares import chi_square_probability, plausible_excess
from imulab.gravity import Gravity
from imulab.procedures.tumble.checks import check_prior
from imulab.procedures.tumble.model import GROUPS, length_noise, norm_and_jacobian, parameter_names
from imulab.procedures.tumble.record import Scaling, scaled_parameters, si_derivative
from imulab.procedures.tumble.schema import PriorShares, fit_of, model_of
from imulab.procedures.tumble.solve import Prior, TumbleProblem, TumbleSolution
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration
from imulab.records.comparison import different_units
from imulab.records.sections import Quantity

_SCALE = 2.0  # half width of the half-Cauchy prior of an ageing, in the noise of an attitude
_STEPS = np.geomspace(0.05, 50.0, 12)
_PASSES = 8  # in which ageing and solution agree
_AT_REST = 1e-3  # of the standard uncertainty: smaller changes end the passes
_NO_WEIGHT = 1e-8  # of the mixture, below which a component is left out
_DETERMINED = 1e-6  # of the largest singular value: directions below it are left to the prior
_ASKED = 9  # attitudes below which several parameters may have changed without being told apart
_ALIKE = 1e-12  # keeps a correlation matrix of rounded decimals invertible


@dataclass(frozen=True)
class PriorNormal:
    """A record in the scaled parameters of a fit: normal, mean (p,) and covariance (p, p).

    `shared` says that the record rests on the same gravity, whose error is then not in the covariance.
    """

    mean: Array
    covariance: Array
    shared: bool


@dataclass(frozen=True)
class AgedPrior:
    """Posterior of a record, widened by its ageing, and new attitudes.

    Attributes
    ----------
    problem
        With the prior widened by its estimated ageing.
    solution
        Mean of the parameters, and residuals there.
    covariance
        Of the scaled parameters, shape (p, p).
    freedom
        Degrees of freedom where an excess scatter was estimated, else None.
    probability
        Of attitudes that contradict the record as much, had nothing changed.
    ageing
        Root mean square of each tau, in the order of `GROUPS`: g, 1, rad.
    widened
        Covariance of the prior with what it aged, shape (p, p).
    with_gravity
        Whether the covariance already holds the uncertainty of gravity.
    """

    problem: TumbleProblem
    solution: TumbleSolution
    covariance: Array
    freedom: float | None
    probability: float
    ageing: tuple[float, ...]
    widened: Array
    with_gravity: bool


def known_of(record: Calibration, scaling: Scaling, gravity: Gravity, unit: str) -> PriorNormal:
    """Return a record in the scaled parameters of attitudes measured under `gravity`.

    Raises
    ------
    RecordError
        The record cannot be a prior, or its outputs have another unit.
    """
    check_prior(record)
    model = model_of(record)
    if model.output_unit != unit:
        raise RecordError(f"the prior has outputs in {model.output_unit}, the recording in {unit}")
    names = parameter_names(model.order)
    covariance = record.covariance.block(names)
    common = (fit_of(record).shared or {}).get(gravity.name)
    if common is not None:
        slope = np.array([common[name] for name in names])
        covariance = covariance - np.outer(slope, slope)
    mean = scaled_parameters(np.array([record.value(name) for name in names]), scaling, gravity.value)
    inverse = np.linalg.inv(si_derivative(mean, scaling, gravity.value))
    return PriorNormal(mean, inverse @ covariance @ inverse.T, common is not None)


def contradiction(residuals: Array, jacobian: Array, known: Array, noise: Array) -> tuple[float, float]:
    """Return ``r' (J V J' + C)^-1 r`` and its probability by chi-square with as many degrees as residuals.

    Parameters
    ----------
    residuals, jacobian
        Of |f| under the record, shapes (n,) and (n, p).
    known, noise
        Covariances V of the record's parameters, (p, p), and C of the attitudes, (n, n).
    """
    total = jacobian @ known @ jacobian.T + noise
    scale = np.sqrt(np.diag(total))
    white = residuals / scale
    # equal attitudes without noise make the matrix singular
    correlation = total / np.outer(scale, scale) + _ALIKE * np.eye(len(scale))
    value = float(white @ np.linalg.solve(correlation, white))
    return value, chi_square_probability(value, len(residuals))


def combine_with_prior(
    problem: TumbleProblem, known: PriorNormal, gravity: Gravity, ageing: tuple[float | None, ...]
) -> AgedPrior:
    """Combine a record with attitudes of known noise.

    Parameters
    ----------
    problem
        The attitudes of one unit, without a prior; of the record's order.
    known
        The record.
    gravity
        Where the attitudes were measured.
    ageing
        A known tau of each group, in g, 1 and rad, or None where the data are to say.
    """
    theta, n = known.mean, problem.reading.shape[1]
    common = 0.0 if known.shared else (gravity.standard_uncertainty / gravity.value) ** 2
    assert problem.covariance is not None
    probability, excess, freedom, passes, rests = 1.0, 0.0, np.inf, 0, False
    while True:
        norm, jacobian, _, _ = norm_and_jacobian(theta[None], problem.reading, problem.order)
        lengthening, noise_variance = length_noise(theta[None], jacobian, problem.covariance, problem.motion)
        residuals = norm - 1 - lengthening
        if rests or passes == _PASSES:
            break
        rows, residual = jacobian[0], residuals[0]
        innovation = rows @ (theta - known.mean) - residual
        excess, freedom = unexplained_variance(rows, innovation, noise_variance[0])
        noise = np.diag(noise_variance[0] + excess) + common
        if not passes:
            doubtful = np.diag(noise_variance[0] + scatter_beyond_noise(rows, residual, noise_variance[0])) + common
            probability = contradiction(residual, rows, known.covariance, doubtful)[1]
        mixed = _mixture(rows, innovation, noise, known.covariance, ageing)
        change = known.mean + mixed.mean - theta
        theta = theta + change
        rests = bool((np.abs(change) < _AT_REST * np.sqrt(np.diag(mixed.covariance))).all())
        passes += 1
    spread = np.sqrt(np.diag(mixed.prior))
    root = np.linalg.inv(np.linalg.cholesky(mixed.prior / np.outer(spread, spread))) / spread
    solution = TumbleSolution(
        theta=theta[None],
        residuals=residuals,
        deviations=residuals if problem.motion is not None else norm - 1,
        lengthening=lengthening,
        jacobian=jacobian,
        variance=noise_variance + excess,
        own_variance=noise_variance,
        down_weights=np.ones((1, n)),
        scale=np.ones(1),
        excess=np.array([np.sqrt(excess)]),
        freedom=np.array([freedom]),
        iterations=np.array([passes]),
        converged=np.array([rests]),
    )
    return AgedPrior(
        problem=replace(problem, prior=Prior(known.mean, root)),
        solution=solution,
        covariance=mixed.covariance,
        freedom=freedom if np.isfinite(freedom) else None,
        probability=probability,
        ageing=mixed.ageing,
        widened=mixed.prior,
        with_gravity=not known.shared,
    )


def scatter_beyond_noise(jacobian: Array, values: Array, variance: Array) -> float:
    """Return the excess variance of the attitudes that a test must allow for: 0 unless significant at 1 %.

    A disturbed hold is no change of the unit. Allowing for scatter that is not there would hide changes.
    """
    missed, left = _residuals_of_fit(jacobian, values, variance)
    freedom = len(variance) - left.shape[1]
    if freedom < 1 or chi_square_probability(float((missed**2 / variance).sum()), freedom) > ATTITUDES_DISTURBED.level:
        return 0.0
    return unexplained_variance(jacobian, values, variance)[0]


def unexplained_variance(jacobian: Array, values: Array, variance: Array) -> tuple[float, float]:
    """Return the excess variance of the attitudes that no parameters explain, and its effective degrees of freedom.

    Residuals are those of a fit to the attitudes alone, whatever a record says (`estimate.plausible_excess`).
    """
    missed, left = _residuals_of_fit(jacobian, values, variance)
    excess, freedom = plausible_excess(missed[None], variance[None], 1 - (left**2).sum(axis=1)[None])
    return float(excess[0]), float(freedom[0])


def _residuals_of_fit(jacobian: Array, values: Array, variance: Array) -> tuple[Array, Array]:
    """Return the residuals that a weighted fit leaves of `values`, and a basis of the fitted space, (n, rank)."""
    white = jacobian / np.sqrt(variance)[:, None]
    scale = np.maximum(np.linalg.norm(white, axis=0), np.finfo(float).tiny)
    left, size, _ = np.linalg.svd(white / scale, full_matrices=False)
    left = left[:, size > _DETERMINED * size[0]]
    return values - np.sqrt(variance) * (left @ (left.T @ (values / np.sqrt(variance)))), left


@dataclass(frozen=True)
class _Mixture:
    mean: Array
    covariance: Array
    prior: Array
    ageing: tuple[float, ...]


def _mixture(
    jacobian: Array, innovation: Array, noise: Array, known: Array, ageing: tuple[float | None, ...]
) -> _Mixture:
    """Mean and covariance of the changes of the parameters, given ``seen = J change + N(0, noise)``."""
    white = np.linalg.inv(np.linalg.cholesky(noise))
    q, r = np.linalg.qr(white @ jacobian)
    data = q.T @ (white @ innovation)
    sigma = float(np.sqrt(np.median(np.diag(noise))))
    groups = [part for part in GROUPS.values() if part.start < jacobian.shape[1]]
    grids = [sigma * _STEPS if tau is None else np.array([tau]) for tau in ageing[: len(groups)]]
    steps = np.array(list(product(*grids)))
    logs = np.zeros(len(steps))
    for column, tau in enumerate(ageing[: len(groups)]):
        if tau is None:
            logs += np.log(steps[:, column]) - np.log1p((steps[:, column] / (_SCALE * sigma)) ** 2)
    inner = r @ known @ r.T + np.eye(len(r))
    by_group = np.stack([r[:, part] @ r[:, part].T for part in groups])
    total = inner + np.einsum("kg,gij->kij", steps**2, by_group)
    inverse = np.linalg.inv(total)
    logs -= (np.linalg.slogdet(total)[1] + np.einsum("i,kij,j->k", data, inverse, data)) / 2
    weights = np.exp(logs - logs.max())
    kept = weights > _NO_WEIGHT
    weights, inverse, steps = weights[kept] / weights[kept].sum(), inverse[kept], steps[kept]
    widened = np.repeat(known[None], len(steps), axis=0)
    for column, part in enumerate(groups):
        for i in range(part.start, part.stop):
            widened[:, i, i] += steps[:, column] ** 2
    gain = widened @ r.T @ inverse
    means = gain @ data
    mean = weights @ means
    spread = means - mean
    covariance = np.einsum("k,kij->ij", weights, widened - gain @ (r @ widened)) + (spread.T * weights) @ spread
    return _Mixture(
        mean,
        (covariance + covariance.T) / 2,
        np.einsum("k,kij->ij", weights, widened),
        tuple(np.sqrt(weights @ steps**2).tolist()),
    )


def prior_shares(
    record: Calibration, known: PriorNormal, aged: AgedPrior, scaling: Scaling, gravity: Gravity
) -> PriorShares:
    """Return what a record says of its prior: what it aged, the test, and each parameter's share of the knowledge.

    The share is the variance now over that of the prior with what it aged, 1 where the data added nothing.
    """
    theta, g = aged.solution.theta[0], gravity.value
    now, before = (
        derivative @ matrix @ derivative.T
        for derivative, matrix in (
            (si_derivative(theta, scaling, g), aged.covariance),
            (si_derivative(known.mean, scaling, g), aged.widened),
        )
    )
    names = parameter_names(aged.problem.order)
    common = (fit_of(record).shared or {}).get(gravity.name, {}) if known.shared else {}
    shared = np.array([common.get(name, 0.0) ** 2 for name in names])
    shares = np.minimum((np.diag(now) + shared) / (np.diag(before) + shared), 1.0)
    units = ((g, "m/s^2"), (1.0, "1"), (1.0, "rad"))
    return PriorShares(
        content_sha256=record.to_dict()["content_sha256"],
        created=record.created,
        probability=aged.probability,
        ageing={
            name: Quantity(value=factor * tau, unit=unit)
            for name, tau, (factor, unit) in zip(GROUPS, aged.ageing, units, strict=False)
        },
        shares=dict(zip(names, shares.tolist(), strict=True)),
    )


def prior_warnings(record: Calibration, aged: AgedPrior, recording: Recording, count: int) -> list[str]:
    """Return what a user must know of a prior, a sentence each."""
    messages: list[str] = []
    if other := different_units(("the prior", record.sensor), ("the recording", recording.metadata)):
        messages.append(Finding(other, "use a prior of this unit (--prior)"))
    if aged.probability < PRIOR_CONTRADICTED.level:
        sizes = [f"{1e6 * tau:.3g} {unit}" for tau, unit in zip(aged.ageing, ("µg", "ppm", "µrad"), strict=False)]
        few = (
            f"; with {count} attitudes intervals may be too narrow where several parameters changed at once, "
            f"{_ASKED} or more are asked for"
        )
        messages.append(
            Finding(
                f"prior and attitudes contradict each other ({probability_text(aged.probability)}): the unit has "
                "changed since the prior was made, or attitudes were disturbed; the prior was widened as far as they "
                f"ask (bias, scale factor{', misalignment' if len(sizes) > 2 else ''}: "
                f"{', '.join(sizes)}){few if count < _ASKED else ''}",
                "fit without the prior (leave --prior out), or record the attitudes again",
            )
        )
    residuals, variance = aged.solution.residuals[0], aged.solution.variance[0]
    rms, times = float(np.sqrt(np.mean(residuals**2))), float(np.sqrt(np.mean(residuals**2 / variance)))
    if chi_square_probability(float((residuals**2 / variance).sum()), len(residuals)) < PRIOR_EXPLAINS_NOTHING.level:
        messages.append(
            Bad(
                "no ageing of bias, scale factor and misalignment explains these attitudes: they miss the result by "
                f"{1e6 * rms:.3g} µg rms, {times:.0f} times their uncertainty; fit without the prior"
            )
        )
    return messages

"""The start of the joint fit of both triads, its observability, and the attitudes that disagree with the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.display import Finding
from imulab.errors import DataError, ObservabilityError, OptionError, RecordError, quoted
from imulab.estimation.decisions import ACCELEROMETERS_CONTRADICT_RECORD
from imulab.estimation.distributions import f_tail, probability_text
from imulab.estimation.least_squares import chi_square_probability
from imulab.gravity import Gravity, check_field_magnitude, local_gravity
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.checks import check_prior, made_from
from imulab.procedures.tumble.estimate import checked_scaling, estimate_triad
from imulab.procedures.tumble.mag.model import (
    ACCELEROMETERS,
    FEWEST,
    MAGNETOMETERS,
    FieldMeans,
    field_means,
    invert_triad,
)
from imulab.procedures.tumble.mag.solve import (
    Joint,
    MagScaling,
    Pair,
    Ready,
    find_held_directions,
    find_start,
    scale_magnetometers,
    weighted_jacobian,
    world_axes,
)
from imulab.procedures.tumble.prior import known_of
from imulab.procedures.tumble.record import Estimate, Scaling
from imulab.procedures.tumble.schema import data_of, model_of
from imulab.recording import Array
from imulab.records.calibration import Calibration

# Leave-one-out errors, disturbed attitudes, steps of the field, and observability.


WORST_CONDITION = 30.0
"""Largest condition number of a fit; attitudes that all face one way have 45 and more, at any heading 3."""
_BLIND = 1 / 2000
"""Singular value, relative to the largest, below which a combination is not determined."""
_HELPS = 0.05  # mean square of magnetic east along a direction, below which a turn about it does not show in the dip
_OF_POSE, _LEAST_REDUNDANCY = 1e-6, 6.0
"""Relative singular value of a function of the pose that the fit leaves free, and redundancy that a test beside all of
them must keep."""
_LEAST_PART = 3
"""Fewest attitudes before and after a step; fewer are tested one by one."""


@dataclass(frozen=True)
class Predicted:
    """Errors of each attitude under the fit to all others, shape (n, 3), and the hat matrix's blocks, (n, 3, 3).

    Both are to first order in the change of the parameters: on real recordings refits differ by less than 0.1 %.
    """

    errors: Array
    hat: Array

    def rms(self, which: int) -> float:
        """Return the root mean square of the errors of |f| (0), |m| (1) or dip (2)."""
        return float(np.sqrt(np.mean(self.errors[:, which] ** 2)))


def leave_one_out(joint: Joint) -> Predicted:
    """Return the errors of each attitude under the fit to all others: ``L (I - H_pp)^-1 L^-1 r_p``, ``V = L L'``."""
    n, k = joint.found.residuals.shape
    jacobian = weighted_jacobian(joint)
    q = np.linalg.qr(jacobian / np.linalg.norm(jacobian, axis=0))[0][: n * k].reshape(n, k, -1)[:, :3]
    hat = np.einsum("nip,njp->nij", q, q)
    root = np.linalg.cholesky(joint.information[:, :3, :3]).transpose(0, 2, 1)
    whitened = np.einsum("nij,nj->ni", root, joint.found.residuals[:, :3])
    free = np.linalg.solve(np.eye(3) - hat + 1e-12 * np.eye(3), whitened[:, :, None])
    return Predicted(np.linalg.solve(root, free)[:, :, 0], hat)


@dataclass(frozen=True)
class Disturbed:
    """The attitude that fits the others worst, and how improbable that is among so many."""

    index: int
    probability: float
    magnitude: float
    dip: float


def find_most_disturbed(joint: Joint) -> Disturbed:
    """Return the attitude whose |m| and dip agree least with the others, and the probability of that.

    ``d = x' (I - H)^-1 x`` of the whitened |m| and dip, ``(d/2) / ((c - d) / (nu - 2))`` against F(2, nu - 2), with c
    and nu the sum of squares and the redundancy of all |m| and dips; p is that times the number of attitudes.
    """
    n = len(joint.down_weights)
    predicted = leave_one_out(joint)
    root = np.linalg.cholesky(joint.information[:, :3, :3]).transpose(0, 2, 1)
    x = np.einsum("nij,nj->ni", root, joint.found.residuals[:, :3])[:, 1:]
    free = np.eye(2) - predicted.hat[:, 1:, 1:]
    d = np.einsum("ni,nij,nj->n", x, np.linalg.inv(free + 1e-12 * np.eye(2)), x)
    total, redundancy = float((x**2).sum()), float(np.einsum("nii->", free))
    rest = np.maximum(total - d, 1e-300) / max(redundancy - 2, 1e-9)
    p = np.array([float(f_tail(value, 2.0, max(redundancy - 2, 1.0))) for value in d / 2 / rest]) * n
    index = int(np.argmin(p))
    error = predicted.errors[index]
    return Disturbed(index, float(min(p[index], 1.0)), float(error[1]), float(error[2]))


@dataclass(frozen=True)
class FieldStep:
    """First attitude after a step of |m| and dip, the size of the step, and its probability by chance.

    `beside_pose` is the probability of the step beside what any linear function of the pose explains; 1 where too few
    attitudes tell the two apart.
    """

    first: int
    magnitude: float
    dip: float
    probability: float
    beside_pose: float


def find_step(joint: Joint) -> FieldStep | None:
    """Return the most significant step of |m| and dip from one attitude on, in their order; None for too few.

    Each split adds two unknowns to the fit, one to |m| and one to the dips after it. By what they lower the sum of
    squares of |m| and dips, of nu degrees of freedom, is tested by F(2, nu - 2), times the number of splits.
    """
    n, k = joint.found.residuals.shape
    splits = np.arange(_LEAST_PART, n - _LEAST_PART + 1)
    if not splits.size:
        return None
    jacobian = weighted_jacobian(joint)
    q = np.linalg.qr(jacobian / np.linalg.norm(jacobian, axis=0))[0]
    root = np.zeros((n, k, 3))
    root[:, :3] = np.linalg.cholesky(joint.information[:, :3, :3]).transpose(0, 2, 1)
    whitened = np.einsum("nij,nj->ni", root, joint.found.residuals[:, :3])
    after = np.arange(n)[:, None, None, None] >= splits[:, None]
    steps = (root[:, :, None, 1:] * after).reshape(n * k, len(splits), 2)
    redundancy = 2 * n - joint.pair.layout.mag - 1.0
    first, size, gain = _best_split(steps, q[: n * k], whitened.ravel())
    p = _probability_of_split(gain, float((whitened[:, 1:3] ** 2).sum()), max(redundancy, 3.0), len(splits))
    axes = world_axes(joint.found.field.vector, joint.found.force.vector)
    poses = (root[:, :, 1:, None, None] * axes[:, None, None]).reshape(n * k, -1)
    free, values, _ = np.linalg.svd(poses - q[: n * k] @ (q[: n * k].T @ poses), full_matrices=False)
    free = free[:, values > _OF_POSE * values[0]]
    left = whitened.ravel() - free @ (free.T @ whitened.ravel())
    redundancy -= free.shape[1]
    beside = 1.0
    if redundancy > _LEAST_REDUNDANCY:
        gain = _best_split(steps, np.hstack([q[: n * k], free]), left)[2]
        total = float((whitened[:, 1:3] ** 2).sum()) - float(((free.T @ whitened.ravel()) ** 2).sum())
        beside = _probability_of_split(gain, total, redundancy, len(splits))
    return FieldStep(int(splits[first]), float(size[0]), float(size[1]), p, beside)


def _best_split(steps: Array, known: Array, residuals: Array) -> tuple[int, Array, float]:
    """Return the split, of (rows, splits, 2), that explains most beside orthonormal columns; its steps and its gain."""
    rows, splits, _ = steps.shape
    flat = steps.reshape(rows, -1)
    columns = (flat - known @ (known.T @ flat)).reshape(rows, splits, 2)
    normal = np.einsum("rsa,rsb->sab", columns, columns)
    normal += 1e-9 * np.trace(np.einsum("rsa,rsb->sab", steps, steps), axis1=1, axis2=2)[:, None, None] * np.eye(2)
    moment = np.einsum("rsa,r->sa", columns, residuals)
    size = np.linalg.solve(normal, moment[:, :, None])[:, :, 0]
    gain = (size * moment).sum(axis=1)
    best = int(np.argmax(gain))
    return best, size[best], float(gain[best])


def _probability_of_split(gain: float, total: float, redundancy: float, splits: int) -> float:
    ratio = gain / 2 / (max(total - gain, 1e-300) / (redundancy - 2))
    return min(float(f_tail(ratio, 2.0, redundancy - 2)) * splits, 1.0)


@dataclass(frozen=True)
class MagObservability:
    """Observability of the magnetometers' parameters and the dip.

    Attributes
    ----------
    rank, size
        Number of determined combinations, and number of parameters.
    condition
        Largest over smallest singular value, columns scaled to length 1.
    blind
        Body axes about which a rotation of the magnetometers changes nothing, shape (k, 3).
    heading
        Attitudes that would help most if they faced another way, best first.
    """

    rank: int
    size: int
    condition: float
    blind: Array
    heading: tuple[int, ...]

    @property
    def enough(self) -> bool:
        """Whether all parameters are determined, with a condition number below the largest allowed."""
        return self.rank == self.size and self.condition < WORST_CONDITION


def judge_observability(pair: Pair, theta: Array) -> MagObservability:
    """Return the observability of the magnetometers by these attitudes at parameters theta."""
    layout = pair.layout
    evaluated = pair.evaluate(theta)
    jacobian = evaluated.by_parameters[:, 1:3, : layout.mag + 1]
    if pair.held is not None:
        jacobian = np.concatenate([jacobian, evaluated.by_parameters[:, 3:, : layout.mag + 1]], axis=1)
    rows = jacobian.reshape(-1, layout.mag + 1)
    scaled = rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    values = np.linalg.svd(scaled, compute_uv=False)
    values = np.append(values, np.zeros(max(0, scaled.shape[1] - len(values))))
    east = world_axes(evaluated.field.vector, evaluated.force.vector)[:, 0]
    # A rotation of the magnetometers changes the dip by its part along magnetic east.
    spread, axes = np.linalg.eigh(east.T @ east / len(east))
    blind = axes[:, spread < _HELPS].T
    rank = int((values > _BLIND * values[0]).sum())
    lacking = axes[:, 0]
    order = np.argsort(np.abs(east @ lacking), kind="stable")
    up = evaluated.force.vector / np.linalg.norm(evaluated.force.vector, axis=1)[:, None]
    # A quarter turn of heading moves an attitude's east to its north: most gains where north is along the weak axis.
    gain = np.abs(np.cross(up, east) @ lacking)
    heading = tuple(int(i) for i in order[np.argsort(-gain[order], kind="stable")][:4])
    return MagObservability(rank, layout.mag + 1, float(values[0] / max(values[-1], 1e-300)), blind, heading)


def heading_uncertainty(joint: Joint, covariance: Array) -> tuple[float, float]:
    """Return the standard uncertainty of magnetic heading, rad: by the parameters, rms of the attitudes; of a reading.

    An error dm of the field turns its horizontal part by ``east . dm / |m| cos(dip)``; an error df of the specific
    force turns the vertical. `covariance` is that of the parameters, shape (p, p).
    """
    layout, evaluated = joint.pair.layout, joint.found
    m, f = evaluated.field.vector, evaluated.force.vector
    axes = world_axes(m, f)
    east, north = axes[:, 0], axes[:, 1]
    horizontal = np.einsum("ni,ni->n", north, m)
    slope = np.zeros((len(m), layout.size))
    slope[:, : layout.mag] = np.einsum("ni,nip->np", east, evaluated.field.by_parameters) / horizontal[:, None]
    vertical = np.einsum("ni,ni->n", axes[:, 2], m) / np.linalg.norm(f, axis=1) / horizontal
    slope[:, layout.of_accel] = -np.einsum("ni,nip->np", east, evaluated.force.by_parameters) * vertical[:, None]
    known = np.einsum("np,pq,nq->n", slope, covariance, slope)
    # V of |m| is that of one component of the field, whatever the direction.
    reading_variance = np.linalg.inv(joint.information[:, :3, :3])[:, 1, 1]
    reading = float(np.median(reading_variance)) / np.cos(joint.theta[layout.dip_at]) ** 2
    return float(np.sqrt(np.mean(known))), float(np.sqrt(reading))


# The start of the joint fit: the accelerometers by themselves, and first values of the magnetometers.


def prepare(
    attitudes: Attitudes,
    known: Calibration | None,
    *,
    gravity: float | str | Gravity | None,
    order: int | str,
    field: float | None,
    same_direction: Sequence[str | Sequence[int]],
    drop: Sequence[int | str],
) -> Ready:
    """Return both triads ready for the joint fit, with the accelerometers fitted by themselves.

    Attitudes that do not determine the magnetometers are refused.
    """
    name, count = attitudes.recording.name, len(attitudes)
    dropped = _parse_numbers(drop, count, "drop")
    kept = np.setdiff1d(np.arange(count), dropped)
    means = field_means(attitudes, kept)
    groups = [_parse_numbers(group, count, "same-direction") for group in same_direction]
    if known is not None:
        check_prior(known)
    local = _choose_gravity(gravity, known, attitudes)
    order, loss = _choose_order_and_loss(known, order, attitudes)
    used = attitudes.only(kept) if dropped.size else attitudes
    scaling = checked_scaling(used, local.value)
    estimate = estimate_triad(used, local, scaling, order, loss)
    kept = kept[estimate.found.aside.others(len(kept))] if estimate.found.aside.index else kept
    if len(kept) < FEWEST:
        raise DataError(f"{name}: {len(kept)} attitudes are left; a magnetometer needs {FEWEST} or more")
    prior, notes = _read_prior(known, attitudes, estimate, scaling, local)
    theta = estimate.solution.theta[0]
    force = invert_triad(theta, estimate.problem.reading[0], ACCELEROMETERS).vector
    begin = find_start(means.mean[kept], force / np.linalg.norm(force, axis=1)[:, None])
    mag, first = scale_magnetometers(begin, field)
    check_field_magnitude(mag.size, means.unit, name, field)
    pair, start = _make_pair(estimate, means, kept, mag, prior), np.concatenate([first, [begin.dip], theta])
    if groups:
        places = [np.flatnonzero(np.isin(kept, group)).tolist() for group in groups]
        _check_groups(places, name)
        held, more = find_held_directions(invert_triad(first, pair.mag, MAGNETOMETERS).vector, force, places)
        pair, start = replace(pair, held=held), np.concatenate([start, more])
    try:
        check_observability(judge_observability(pair, start), kept, name)
    except np.linalg.LinAlgError:
        raise DataError(f"{name}: the attitudes determine no field: are both triads of the same attitudes?") from None
    return Ready(estimate, scaling, local, means, kept, mag, pair, start, order, loss, notes)


def _choose_order_and_loss(known: Calibration | None, order: int | str, attitudes: Attitudes) -> tuple[int | str, str]:
    """Return order and loss of the accelerometers' own fit: as stated, or as in their record."""
    if known is None:
        return order if order == "auto" else int(order), "auto"
    record_order = model_of(known).order
    if record_order < 1:
        raise OptionError(f"accel: a record of order {record_order}; magnetometers need one of 1 or more")
    if str(order) not in ("auto", str(record_order)):
        raise OptionError(f"order {order} with a record of order {record_order}: expected that or auto")
    if not is_made_from(known, attitudes):
        return record_order, "auto"
    asked, loss = known.options.get("order"), known.options.get("loss")
    return "auto" if asked == "auto" else record_order, "square" if loss == "square" else "auto"


def is_made_from(known: Calibration, attitudes: Attitudes) -> bool:
    """Return whether a record was made from these attitudes, or from the recording that they are from."""
    held = data_of(known).attitudes
    same = held is not None and np.array_equal(held.mean, attitudes.mean)
    return same or made_from(known, attitudes.recording)


def _parse_numbers(numbers: str | Sequence[int | str], count: int, option: str) -> NDArray[np.intp]:
    """Return indices from 0 of attitudes by numbers from 1, or by texts such as ``"8"``, ``"9-16"``, ``"3,9-16"``."""
    indices: list[int] = []
    for entry in [numbers] if isinstance(numbers, str) else numbers:
        for part in str(entry).split(","):
            first, dash, last = part.strip().partition("-")
            ends = (first, last if dash else first)
            if not all(end.strip().isdecimal() and 1 <= int(end) <= count for end in ends) or int(ends[0]) > int(
                ends[1]
            ):
                raise OptionError(
                    f"{option} {quoted(entry)}: expected the number of an attitude, 1 to {count}, or a range as 9-16"
                )
            indices += range(int(ends[0]) - 1, int(ends[1]))
    return np.unique(np.array(indices, dtype=np.intp))


def _check_groups(places: Sequence[Sequence[int]], name: str) -> None:
    """Refuse groups of attitudes that overlap, or are too small to determine a direction."""
    every = [place for group in places for place in group]
    if len(set(every)) < len(every):
        raise OptionError(f"same-direction: an attitude of {name} is in two groups; expected each in one")
    if any(len(group) < 2 for group in places) or 2 * len(every) <= 2 + 2 * len(places):
        raise OptionError(
            "same-direction: too few attitudes in the groups to tell a direction from; expected three or more of one "
            "group"
        )


def _choose_gravity(
    requested: float | str | Gravity | None, known: Calibration | None, attitudes: Attitudes
) -> Gravity:
    """Return the stated gravity, else that of the accelerometers' record, else that for the recording."""
    local = local_gravity(requested, attitudes.recording)
    if requested is not None or known is None:
        return local
    stated = model_of(known).gravity
    if is_made_from(known, attitudes) and stated.value == local.value:
        return local
    return local_gravity(Gravity(stated.value, stated.from_, stated.standard_uncertainty or 0.0), attitudes.recording)


def _read_prior(
    known: Calibration | None, attitudes: Attitudes, estimate: Estimate, scaling: Scaling, local: Gravity
) -> tuple[tuple[Array, Array] | None, list[str]]:
    """Return mean and rows of another test's record as prior knowledge, None if these attitudes contradict it."""
    if known is None or is_made_from(known, attitudes):
        return None, []
    if model_of(known).output_unit != attitudes.unit:
        raise RecordError(
            f"accel: a record of outputs in {model_of(known).output_unit}, {attitudes.recording.name} has them in "
            f"{attitudes.unit}"
        )
    held = known_of(known, scaling, local, attitudes.unit)
    accel_alone = estimate.given_order or estimate.stated
    if accel_alone is not None:
        off = estimate.solution.theta[0] - held.mean
        distance = float(off @ np.linalg.solve(accel_alone.covariance + held.covariance, off))
        p = chi_square_probability(distance, len(off))
        if p < ACCELEROMETERS_CONTRADICT_RECORD.level:
            gyroscopes = "; its gyroscopes were left out" if "gyro_output_unit" in known.model else ""
            return None, [
                Finding(
                    f"mag: the accelerometers of {attitudes.recording.name} contradict their record "
                    f"({probability_text(p)}): it was not used; they were calibrated anew from "
                    f"these attitudes{gyroscopes}",
                    "calibrate the accelerometers again (imulab tumble fit)",
                )
            ]
    return (held.mean, np.linalg.inv(np.linalg.cholesky(held.covariance))), []


def _make_pair(
    estimate: Estimate, means: FieldMeans, kept: NDArray[np.intp], mag: MagScaling, prior: tuple[Array, Array] | None
) -> Pair:
    """Return the scaled outputs of both triads, with their noise as far as it is known."""
    problem, solution = estimate.problem, estimate.solution
    n, size = problem.reading.shape[1], solution.theta.shape[1]
    variance, freedom = solution.variance[0], float(solution.freedom[0])
    if problem.covariance is None:
        if n <= size:
            raise DataError(
                f"{estimate.attitudes.recording.name}: {n} attitudes for the {size} parameters of the accelerometers "
                f"leave nothing to tell their noise from; expected {size + 1} or more, a lower order, or std_ columns"
            )
        freedom = float(n - size)
        variance = np.full(n, float((solution.residuals[0] ** 2).sum()) / freedom)
    noise = None
    if problem.covariance is not None and means.covariance is not None:
        noise = np.zeros((n, 6, 6))
        noise[:, :3, :3], noise[:, 3:, 3:] = problem.covariance[0], mag.covariance(means.covariance[kept])
    return Pair(
        problem.reading[0],
        mag.outputs(means.mean[kept]),
        noise,
        variance,
        solution.lengthening[0],
        freedom,
        size,
        prior,
    )


def check_observability(what: MagObservability, kept: NDArray[np.intp], name: str) -> None:
    """Refuse attitudes that do not determine all parameters; the message says which further ones would."""
    if what.enough:
        return
    blind = " and ".join(f"({', '.join(f'{part:+.2f}' for part in axis)})" for axis in what.blind)
    cannot = (
        f": a rotation of the magnetometers about the body axis {blind} changes neither |m| nor the dip"
        if blind
        else ""
    )
    which = " ".join(str(int(kept[i]) + 1) for i in sorted(what.heading))
    raise ObservabilityError(
        f"{name}: {len(kept)} attitudes determine {what.rank} of {what.size} combinations of "
        f"the magnetometers' parameters and the dip{cannot}; turn the heading between attitudes: attitudes {which} "
        "once more with the unit facing a quarter turn away would help most"
    )

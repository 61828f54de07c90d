"""What the joint fit of both triads starts from: the accelerometers by themselves, and where the magnetometers are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from imulab.errors import DataError, ObservabilityError, OptionError, RecordError, quoted
from imulab.estimation.least_squares import chi_square_probability
from imulab.gravity import Gravity, local_gravity
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.checks import check_attitudes, check_prior, made_from
from imulab.procedures.tumble.estimate import estimate_triad, nominal_scaling
from imulab.procedures.tumble.findings import Estimate
from imulab.procedures.tumble.mag.field import FEWEST, FieldMeans, check_magnitude, field_means
from imulab.procedures.tumble.mag.judge import Seen, seen
from imulab.procedures.tumble.mag.model import ACCELEROMETERS, MAGNETOMETERS, triad
from imulab.procedures.tumble.mag.pointing import find_held
from imulab.procedures.tumble.mag.scaling import MagScaling, Ready, nominal_mag
from imulab.procedures.tumble.mag.solve import Pair
from imulab.procedures.tumble.mag.start import find_start
from imulab.procedures.tumble.prior import known_of
from imulab.procedures.tumble.record import Scaling
from imulab.procedures.tumble.sections import data_of, model_of
from imulab.recording import Array
from imulab.records.calibration import Calibration

_DISAGREES = 1e-3


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
    """Fit the accelerometers by themselves, find where the joint fit starts, and refuse what it cannot see."""
    name, count = attitudes.recording.name, len(attitudes)
    dropped = _numbers(drop, count, "drop")
    kept = np.setdiff1d(np.arange(count), dropped)
    means = field_means(attitudes, kept)
    groups = [_numbers(group, count, "same-direction") for group in same_direction]
    if known is not None:
        check_prior(known)
    local = _gravity(gravity, known, attitudes)
    order, loss = _as_before(known, order, attitudes)
    used = attitudes.only(kept) if dropped.size else attitudes
    check_attitudes(used, local.value)
    scaling = nominal_scaling(used, local.value)
    estimate = estimate_triad(used, local, scaling, order, loss)
    kept = kept[estimate.found.aside.others(len(kept))] if estimate.found.aside.index else kept
    if len(kept) < FEWEST:
        raise DataError(f"{name}: {len(kept)} attitudes are left; a magnetometer needs {FEWEST} or more")
    prior, notes = _prior(known, attitudes, estimate, scaling, local)
    theta = estimate.solution.theta[0]
    force = triad(theta, estimate.problem.reading[0], ACCELEROMETERS).vector
    begin = find_start(means.mean[kept], force / np.linalg.norm(force, axis=1)[:, None])
    mag, first = nominal_mag(begin, field)
    check_magnitude(mag.size, means.unit, name, field)
    pair, start = _pair(estimate, means, kept, mag, prior), np.concatenate([first, [begin.dip], theta])
    if groups:
        places = [np.flatnonzero(np.isin(kept, group)).tolist() for group in groups]
        _check_groups(places, name)
        held, more = find_held(triad(first, pair.mag, MAGNETOMETERS).vector, force, places)
        pair, start = replace(pair, held=held), np.concatenate([start, more])
    try:
        check_seen(seen(pair, start), kept, name)
    except np.linalg.LinAlgError:
        raise DataError(f"{name}: the attitudes determine no field: are both triads of the same attitudes?") from None
    return Ready(estimate, scaling, local, means, kept, mag, pair, start, order, loss, notes)


def _as_before(known: Calibration | None, order: int | str, attitudes: Attitudes) -> tuple[int | str, str]:
    """Return order and loss of the accelerometers' own fit: as asked, or as their record says that they were fitted."""
    if known is None:
        return order if order == "auto" else int(order), "auto"
    own = model_of(known).order
    if own < 1:
        raise OptionError(f"accel: a record of order {own}; magnetometers need one of 1 or more")
    if str(order) not in ("auto", str(own)):
        raise OptionError(f"order {order} with a record of order {own}: expected that or auto")
    if not made_of(known, attitudes):
        return own, "auto"
    asked, loss = known.options.get("order"), known.options.get("loss")
    return "auto" if asked == "auto" else own, "square" if loss == "square" else "auto"


def made_of(known: Calibration, attitudes: Attitudes) -> bool:
    """Return whether a record was made from these attitudes, or from the recording that they are from."""
    held = data_of(known).attitudes
    same = held is not None and np.array_equal(held.mean, attitudes.mean)
    return same or made_from(known, attitudes.recording)


def _numbers(given: str | Sequence[int | str], count: int, option: str) -> NDArray[np.intp]:
    """Attitudes by their numbers from 1, or texts such as ``"8"``, ``"9-16"``, ``"3,9-16"``, as places from 0."""
    found: list[int] = []
    for entry in [given] if isinstance(given, str) else given:
        for part in str(entry).split(","):
            first, dash, last = part.strip().partition("-")
            ends = (first, last if dash else first)
            if not all(end.strip().isdecimal() and 1 <= int(end) <= count for end in ends) or int(ends[0]) > int(
                ends[1]
            ):
                raise OptionError(
                    f"{option} {quoted(entry)}: expected the number of an attitude, 1 to {count}, or a range as 9-16"
                )
            found += range(int(ends[0]) - 1, int(ends[1]))
    return np.unique(np.array(found, dtype=np.intp))


def _check_groups(places: Sequence[Sequence[int]], name: str) -> None:
    """Refuse groups of attitudes from which no direction can be told."""
    every = [place for group in places for place in group]
    if len(set(every)) < len(every):
        raise OptionError(f"same-direction: an attitude of {name} is in two groups; expected each in one")
    if any(len(group) < 2 for group in places) or 2 * len(every) <= 2 + 2 * len(places):
        raise OptionError(
            "same-direction: too few attitudes in the groups to tell a direction from; expected three or more of one "
            "group"
        )


def _gravity(given: float | str | Gravity | None, known: Calibration | None, attitudes: Attitudes) -> Gravity:
    """Gravity as given, else that of the accelerometers' record, else as for the accelerometers."""
    local = local_gravity(given, attitudes.recording)
    if given is not None or known is None:
        return local
    stated = model_of(known).gravity
    if made_of(known, attitudes) and stated.value == local.value:
        return local
    return local_gravity(Gravity(stated.value, stated.from_, stated.standard_uncertainty or 0.0), attitudes.recording)


def _prior(
    known: Calibration | None, attitudes: Attitudes, estimate: Estimate, scaling: Scaling, local: Gravity
) -> tuple[tuple[Array, Array] | None, list[str]]:
    """Mean and rows of a record of another test as prior knowledge, unless these attitudes contradict it."""
    if known is None or made_of(known, attitudes):
        return None, []
    if model_of(known).output_unit != attitudes.unit:
        raise RecordError(
            f"accel: a record of outputs in {model_of(known).output_unit}, {attitudes.recording.name} has them in "
            f"{attitudes.unit}"
        )
    held = known_of(known, scaling, local, attitudes.unit)
    own = estimate.given_order or estimate.stated
    if own is not None:
        off = estimate.solution.theta[0] - held.mean
        distance = float(off @ np.linalg.solve(own.covariance + held.covariance, off))
        p = chi_square_probability(distance, len(off))
        if p < _DISAGREES:
            gyroscopes = "; its gyroscopes were left out" if "gyro_output_unit" in known.model else ""
            return None, [
                f"mag: the accelerometers of {attitudes.recording.name} contradict their record (p = {p:.2g}): it was "
                f"not used; they were calibrated anew from these attitudes{gyroscopes}"
            ]
    return (held.mean, np.linalg.inv(np.linalg.cholesky(held.covariance))), []


def _pair(
    estimate: Estimate, means: FieldMeans, kept: NDArray[np.intp], mag: MagScaling, prior: tuple[Array, Array] | None
) -> Pair:
    """Both triads' scaled outputs, with what is known of their noise."""
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


def check_seen(what: Seen, kept: NDArray[np.intp], name: str) -> None:
    """Refuse attitudes that leave something blind, and say what would help."""
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

"""What a fit found besides its values: attitudes set aside, and what its uncertainties hold for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.errors import first_of
from imulab.estimation.least_squares import Observability, coverage_factor
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.blend import Blended
from imulab.procedures.tumble.model import AXES, MISALIGNMENTS, parameter_count
from imulab.procedures.tumble.optimal import CLOSEST, near_vertical
from imulab.procedures.tumble.orders import OrderRow
from imulab.procedures.tumble.outliers import FREEDOM, HIGHEST_TESTED, Aside
from imulab.procedures.tumble.sections import data_of, fit_of
from imulab.procedures.tumble.solve import Problem, Solution, forces
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.units import parse_unit
from imulab.verdict import Note

_SELDOM_MISSED = 6
"""Degrees of freedom at the highest order tested from which a knock is seldom missed."""
_NEGLIGIBLE = 0.01
FEW_DEGREES, _ENOUGH_DEGREES = 5, 9
_WORST_SCALE = 0.1
_WORST_MISALIGNMENT = 0.1
_MOST_NAMED = 8


@dataclass(frozen=True)
class Found:
    """All attitudes that were found, those set aside included, under the solution for the others."""

    attitudes: Attitudes
    problem: Problem
    solution: Solution
    aside: Aside


@dataclass(frozen=True)
class Stated:
    """Covariance in units of g and its degrees of freedom (None: noise known), as stated, and if the order is right."""

    covariance: Array
    freedom: float | None
    given_order: Array | None = None
    freedom_given_order: float | None = None
    blended: Blended | None = None


@dataclass(frozen=True)
class Estimate:
    """What the attitudes that were not set aside say of the unit, in units of g.

    `with_gravity` says that the covariance holds gravity's own uncertainty already; `prior` is the record's entry on an
    earlier record, and `notes` are findings about that.
    """

    attitudes: Attitudes
    problem: Problem
    solution: Solution
    given_order: Stated | None
    stated: Stated | None
    found: Found
    observability: Observability
    orders: tuple[OrderRow, ...]
    with_gravity: bool = False
    prior: Mapping[str, Any] | None = None
    notes: Sequence[str] = ()


def uncertainty_entries(stated: Stated | None) -> dict[str, Any]:
    """Return the record's entries on the stated uncertainty."""
    entries: dict[str, Any] = {
        "effective_degrees_of_freedom": None if stated is None else stated.freedom,
        "coverage_factor_95": None if stated is None else coverage_factor(stated.freedom),
    }
    if stated is None or stated.blended is None:
        return entries
    if stated.given_order is not None:
        entries["coverage_factor_95_given_order"] = coverage_factor(stated.freedom_given_order)
    noise = {str(order): share for order, share in stated.blended.noise.items()}
    return entries | {"blend": {"highest_order": stated.blended.order, "noise_share": noise}}


def aside_of(record: Calibration, attitudes: Attitudes) -> NDArray[np.bool_]:
    """Return which of the attitudes a record set aside, if it was made from these, shape (n,)."""
    found = np.zeros(len(attitudes), dtype=np.bool_)
    held = data_of(record).attitudes
    if held is not None and np.array_equal(held.mean, attitudes.mean):
        found[[number - 1 for number in fit_of(record).set_aside]] = True
    return found


def aside_warnings(found: Found, options: Mapping[str, Any]) -> list[str]:
    """Name the attitudes that were set aside, or say why a knocked one may not have been."""
    if options["loss"] != "auto":
        return []
    if options["method"] != "norm":
        return [Note("method linearised keeps every attitude: only method norm sets knocked ones aside")]
    if options.get("cross"):
        return [
            Note(
                "with cross terms every attitude is kept: a knocked one is not looked for (fit without --cross to see)"
            )
        ]
    aside = found.aside
    named = [
        f"{found.attitudes.label(index)} set aside: {1e3 * found.solution.residuals[0, index]:+.3f} mg "
        f"({abs(deviations):.0f} standard uncertainties) from what the others give, as if it had been knocked or had "
        "not settled; --loss square keeps it"
        for index, deviations in zip(aside.index, aside.deviations, strict=True)
    ]
    n = len(found.attitudes)
    lowest, highest = (options["order"],) * 2 if isinstance(options["order"], int) else (1, HIGHEST_TESTED)
    enough = parameter_count(lowest) + 1 + FREEDOM[found.problem.covariance is not None]
    if n < enough:
        named.append(Note(f"{n} attitudes are too few to tell a knocked one from the others: {enough} or more can"))
    elif n - parameter_count(highest) < _SELDOM_MISSED:
        named.append(
            Note(
                f"a knocked attitude among only {n} may stay unseen: of those that are off by more than 8 standard "
                "uncertainties 18 attitudes show 60 to 97 %, 24 show 97 % or more"
            )
        )
    return named


def freedom_finding(attitudes: int, size: int, order: int) -> str | None:
    """Say that so many attitudes are few for the parameters of an order, where they are."""
    freedom = attitudes - size
    if freedom >= FEW_DEGREES:
        return None
    return (
        f"only {freedom} degree{'' if freedom == 1 else 's'} of freedom: {attitudes} attitudes hardly check whether "
        f"order {order} is enough, and the uncertainties hold only if it is; {size + _ENOUGH_DEGREES} or more would "
        "tell"
    )


def vertical_warnings(found: Found, method: str) -> list[str]:
    """Name the axes that are vertical, up or down, in more than one attitude, which the linearised's source forbids."""
    if method != "linearised":
        return []
    vertical = near_vertical(forces(found.problem, found.solution)[0], CLOSEST)
    warnings = []
    for axis, column in zip(AXES, vertical.T, strict=True):
        which = np.flatnonzero(column).tolist()
        if len(which) > 1:
            named = first_of([found.attitudes.label(index) for index in which], _MOST_NAMED)
            warnings.append(
                f"axis {axis} is vertical within {np.degrees(CLOSEST):.0f} deg in {len(which)} attitudes ("
                f"{named}): the source of method linearised has no axis vertical in two; "
                "tumble plan --method linearised chooses attitudes without such"
            )
    return warnings


def size_warnings(attitudes: Attitudes, solution: Solution) -> list[str]:
    """Errors that no accelerometer in physical units has: more likely the columns are not what they are said to be."""
    theta, found = solution.theta[0], []
    if parse_unit(attitudes.unit).quantity == "acceleration":
        found += [
            f"scale factor of {axis} is off by {100 * (value - 1):+.0f} %: is the unit right?"
            for axis, value in zip(AXES, theta[3:6], strict=True)
            if abs(value - 1) > _WORST_SCALE
        ]
    found += [
        f"misalignment_{pair} of {1e3 * value:+.0f} mrad: do the columns belong together?"
        for pair, value in zip(MISALIGNMENTS, theta[6:9], strict=False)  # order 0 has none
        if abs(value) > _WORST_MISALIGNMENT
    ]
    return found


def assumption_notes(stated: Stated | None) -> list[str]:
    """Say which nonlinearity the attitudes do not show, and what it would move."""
    if stated is None or stated.blended is None:
        return []
    notes: list[str] = []
    for order, (bias, scale) in stated.blended.assumed.items():
        unit = f"µg/g{'⁰¹²³'[order]}"
        moved = [
            f"{value:.2g} {of}"
            for value, of in ((bias, "µg of bias"), (scale, "ppm of scale factor"))
            if value > _NEGLIGIBLE
        ]
        notes.append(
            Note(
                f"these attitudes do not show k{order}: the uncertainties assume k{order} = 0; 1 {unit} of it moves up "
                f"to {' and '.join(moved)} (tumble plan --order 3 chooses attitudes that show it)"
            )
        )
    return notes

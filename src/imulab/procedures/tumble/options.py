"""The options of a tumble fit, checked before there is data."""

from __future__ import annotations

import numbers
from collections.abc import Sequence

import numpy as np

from imulab.errors import OptionError, listed
from imulab.procedures.tumble.choices import FROM_DATA, FURTHER, HIGHEST_ORDER, LOSSES, METHODS
from imulab.procedures.tumble.montecarlo import check_trials
from imulab.procedures.tumble.prior import GROUPS

_FAINTEST, _STRONGEST = 1e-6, 1e-2  # T


def check_method(method: str, order: int | str) -> None:
    """Check that there is such a method, and that it fits such an order.

    Raises
    ------
    OptionError
        It is unknown, or cannot.
    """
    if method not in METHODS:
        raise OptionError(f"method {method!r}: expected one of {listed(METHODS, method)}")
    if order == 0 and method == "linearised":
        raise OptionError("order 0 needs method norm, found method linearised")


def check_options(
    order: int | str,
    method: str,
    loss: str,
    *,
    monte_carlo: int | None = None,
    with_prior: bool = False,
    ageing: Sequence[float] = (),
    nonlinearity: tuple[float, float] | None = None,
    cross: bool = False,
    threshold: Sequence[float] | None = None,
    further: Sequence[str] = (),
    field: float | None = None,
    hemisphere: str | None = None,
    dip: object = None,
) -> None:
    """Check what can be checked before there is data.

    Raises
    ------
    OptionError
        An option has an unknown value, or does not go with another.
    """
    known = ("auto", *range(HIGHEST_ORDER + 1), "blend")
    if order not in known or isinstance(order, bool):
        raise OptionError(f"order {order!r}: expected one of {listed(map(str, known), order)}")
    check_method(method, order)
    if loss not in LOSSES:
        raise OptionError(f"loss {loss!r}: expected one of {listed(LOSSES, loss)}")
    if loss == "huber" and method == "linearised":
        raise OptionError("loss huber needs method norm, found method linearised")
    if threshold is not None:
        _check_threshold(threshold, method)
    if with_prior and (method != "norm" or loss == "huber"):
        raise OptionError(f"a prior needs method norm and loss square or auto, found method {method} and loss {loss}")
    if ageing and not with_prior:
        raise OptionError("ageing without a prior: expected both, it is that of the prior's unit")
    if len(ageing) > len(GROUPS) or not all(0 <= value < np.inf for value in ageing):
        raise OptionError(
            f"ageing {' '.join(f'{value:g}' for value in ageing)}: expected up to three standard deviations of 0 or "
            "more, of biases (m/s^2), scale factors (1) and misalignments (rad)"
        )
    if order == "blend" and (method != "norm" or with_prior or monte_carlo is not None):
        raise OptionError("order blend needs method norm, and goes neither with a prior nor with monte-carlo")
    if nonlinearity is not None:
        if order not in FROM_DATA or with_prior:
            raise OptionError(f"nonlinearity needs order auto or blend without a prior, found order {order}")
        if not all(0 < value < np.inf for value in nonlinearity):
            raise OptionError(f"nonlinearity {nonlinearity}: expected two standard deviations above 0, of k2 and k3")
    if cross and (method != "norm" or order in (0, *FROM_DATA) or with_prior or monte_carlo is not None):
        raise OptionError(
            f"cross needs method norm and an order of 1 to {HIGHEST_ORDER}, and goes with no prior and no monte-carlo"
        )
    if "mag" in further:
        _check_with_mag(
            method=None if method == "norm" else method, order=order if order in (0, "blend") else None,
            cross=cross or None, prior=with_prior or None, nonlinearity=nonlinearity, monte_carlo=monte_carlo,
        )  # fmt: skip
    check_field(field)
    _check_of_mag("mag" in further, field=field, hemisphere=hemisphere, dip=dip)
    if monte_carlo is None:
        return
    check_trials(monte_carlo)
    if method != "norm":
        raise OptionError(f"monte-carlo needs method norm, found method {method}")
    if with_prior:
        raise OptionError("monte-carlo draws the attitudes anew, not a prior: expected one of the two options")


def _check_threshold(threshold: Sequence[float], method: str) -> None:
    if method != "linearised":
        raise OptionError(f"threshold needs method linearised, found method {method}")
    if len(threshold) != 3 or not all(0 < value < np.inf for value in threshold):
        raise OptionError(
            f"threshold {' '.join(f'{value:g}' for value in threshold)}: expected three changes above 0, of scale "
            "factors (1), biases (m/s^2) and misalignments (rad)"
        )


def further_triads(given: str | Sequence[str], called: str) -> tuple[str, ...]:
    """Return the names of further triads, given as a text such as ``"gyro,mag"`` or one by one.

    Raises
    ------
    OptionError
        There is no such triad, or one is named twice.
    """
    names = tuple(name.strip() for name in given.split(",")) if isinstance(given, str) else tuple(given)
    for name in names:
        if name not in FURTHER:
            raise OptionError(f"{called} {name!r}: expected gyro, mag or both, as in gyro,mag")
    if len(set(names)) < len(names):
        raise OptionError(f"{called} {','.join(names)}: expected each triad once")
    return names


def _check_with_mag(**others: object) -> None:
    """Refuse what the joint fit of accelerometers and magnetometers does not have."""
    for name, value in others.items():
        if value is not None:
            shown = name.replace("_", "-") + (f" {value}" if isinstance(value, str | int) and value is not True else "")
            raise OptionError(
                f"with_ mag does not go with {shown}: both triads are fitted together by method norm, order auto or 1 "
                "to 5, from these attitudes alone"
            )


def _check_of_mag(asked: bool, **stated: object) -> None:
    """Refuse what is stated of a field where no magnetometers are asked for."""
    for name, value in stated.items():
        if value is not None and not asked:
            raise OptionError(f"{name} without magnetometers: expected it with mag, or with gyro,mag")


def check_field(field: float | None) -> None:
    """Check that a magnitude, T, can be that of the field.

    Raises
    ------
    OptionError
        It is far from any on Earth.
    """
    if field is not None and not (isinstance(field, numbers.Real) and _FAINTEST < field < _STRONGEST):
        raise OptionError(f"field {field:g} T: expected its magnitude, such as 48.2uT (25 to 65 uT on Earth)")

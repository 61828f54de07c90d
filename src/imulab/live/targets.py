"""What the parameters are to be known to: ``bias 100 ug, scale_factor 200 ppm``."""

from __future__ import annotations

import re
from dataclasses import dataclass

from imulab.errors import OptionError, listed
from imulab.quantities import quantity
from imulab.records.calibration import Calibration

_KINDS = {
    "bias": ("acceleration", "ug"),
    "scale_factor": ("number", "ppm"),
    "misalignment": ("angle", "urad"),
    "k2": ("acceleration", "ug"),
    "k3": ("acceleration", "ug"),
}
"""Parameters by the stem of their names; a nonlinearity in what it makes at 1 g."""


@dataclass(frozen=True)
class Target:
    """A standard uncertainty that the parameters of one stem are to have: SI, relative for scale factors."""

    stem: str
    value: float
    text: str


def read_targets(text: str | None) -> tuple[Target, ...]:
    """Return the targets of a text; none of None.

    Raises
    ------
    OptionError
        It is no list of parameters with an uncertainty each.
    """
    found = []
    for part in (text or "").split(",") if text is not None else []:
        match = re.fullmatch(r"\s*([a-z_0-9]+)\s+(.+?)\s*", part)
        if match is None:
            raise OptionError(f"--target {text!r}: expected a list such as 'bias 100 ug, scale_factor 200 ppm'")
        stem = match[1]
        if stem not in _KINDS:
            raise OptionError(f"--target {text!r}: unknown parameter {stem!r}; known: {listed(_KINDS, stem)}")
        value = quantity(match[2], "--target", *_KINDS[stem])
        if not 0 < value < float("inf"):
            raise OptionError(f"--target {text!r}: expected standard uncertainties above 0")
        found.append(Target(stem, value, match[2]))
    return tuple(found)


def share_of(target: Target, record: Calibration, gravity: float) -> float:
    """Return the largest standard uncertainty of the target's parameters over the target; infinite without them."""
    return max(shares_of(target, record, gravity).values(), default=float("inf"))


def shares_of(target: Target, record: Calibration, gravity: float) -> dict[str, float]:
    """Return the standard uncertainty over the target for each of its parameters."""
    shares = {}
    for name, parameter in record.parameters.items():
        if name.rpartition("_")[0] != target.stem or parameter.standard_uncertainty is None:
            continue
        size = parameter.standard_uncertainty
        if target.stem == "scale_factor":
            size /= abs(parameter.value)
        elif target.stem[0] == "k":
            size *= gravity ** int(target.stem[1:])
        shares[name] = size / target.value
    return shares


def predicted_share(target: Target, uncertainties: dict[str, float], gravity: float) -> float:
    """Return the same of predicted uncertainties in units of g; 0 where the model lacks the parameter."""
    factor = gravity if target.stem == "bias" or target.stem[0] == "k" else 1.0
    sizes = [u for name, u in uncertainties.items() if name.rpartition("_")[0] == target.stem]
    return max(sizes, default=0.0) * factor / target.value

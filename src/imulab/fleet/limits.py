"""Limits of parameters, from a TOML file: what a line may let pass.

[tumble]
"bias_*" = { lower = -20, upper = 20, unit = "mg" }
misalignment_yx = { upper = 3, unit = "mrad" }
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

from imulab.errors import ReadError, UnitError, listed, quoted
from imulab.fleet.display import to_parameter_unit
from imulab.procedures.registry import PROCEDURES
from imulab.quantity_entries import check_keys, number_of
from imulab.toml import load_toml


@dataclass(frozen=True)
class Limits:
    """Lower and upper limit of a parameter in its unit; either may be infinite."""

    lower: float
    upper: float


def load_limits(path: str, units: Mapping[tuple[str, str], str]) -> dict[tuple[str, str], Limits]:
    """Read limits; a later line overrides an earlier one, so that a name may follow a pattern.

    Parameters
    ----------
    path
        TOML file: a table for each procedure, a line for each parameter or pattern (``"bias_*"``).
    units
        Procedure and parameter to unit, of every parameter there is.

    Raises
    ------
    ReadError
        The file cannot be read, names a procedure or parameter that is not there, or has a limit that cannot be.
    UnitError
        A unit is not one of the parameter's.
    """
    table = load_toml(path, str(path), "limits")
    found: dict[tuple[str, str], Limits] = {}
    for procedure, entries in table.items():
        if procedure not in PROCEDURES:
            raise ReadError(
                f"{path}: unknown procedure {quoted(procedure)}; known procedures: {listed(PROCEDURES, procedure)}"
            )
        if not isinstance(entries, dict):
            raise ReadError(f'{path}: {procedure}: expected lines such as bias_x = {{ upper = 20, unit = "mg" }}')
        known = [name for owner, name in units if owner == procedure]
        for pattern, entry in entries.items():
            names = [name for name in known if fnmatchcase(name, pattern)]
            if not names:
                shown = listed(known, pattern) or "none, there is no record of this procedure"
                raise ReadError(f"{path}: {procedure}: no parameter {quoted(pattern)}; parameters: {shown}")
            for name in names:
                key = procedure, name
                found[key] = _limits(entry, units[key], f"{path}: {procedure}: {pattern}")
    return found


def _limits(entry: Any, unit: str, place: str) -> Limits:
    ends = {"lower": -math.inf, "upper": math.inf}
    if not isinstance(entry, dict):
        raise ReadError(f'{place}: expected {{ lower = -20, upper = 20, unit = "{unit}" }}, found {quoted(entry)}')
    check_keys(entry, (*ends, "unit"), place)
    if "unit" not in entry or not ends.keys() & entry.keys():
        raise ReadError(f"{place}: expected a unit, and lower or upper or both")
    for name in ends.keys() & entry.keys():
        value = number_of(entry[name], f"{place}: {name}")
        try:
            ends[name] = to_parameter_unit(value, str(entry["unit"]), unit)
        except UnitError as error:
            raise UnitError(f"{place}: {error}") from None
    if not ends["lower"] < ends["upper"]:
        raise ReadError(f"{place}: lower {entry['lower']} is not below upper {entry['upper']}")
    return Limits(ends["lower"], ends["upper"])

"""What a centrifuge record says of each axis: its curve, a headline, facts, and a summary with uncertainties."""

from __future__ import annotations

import numpy as np

from imulab.procedures.centrifuge.model import curve
from imulab.procedures.centrifuge.sections import centrifuge_of, force_of
from imulab.procedures.centrifuge.tables import ENGINEERING, PER_G, relative
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.report.elements import format_uncertain
from imulab.units import from_si


def summary(record: Calibration) -> tuple[list[str], list[list[str]]]:
    """Return the curve of each axis, and what it changes up to the highest level, with uncertainties."""
    sets, top = prefixes(record), force_of(record, max(level.level for level in centrifuge_of(record).levels))
    rows = []
    for prefix in sets:
        cells = []
        for name in ("K0", "c1", "c2"):
            factor, _ = ENGINEERING[name]
            found = record.parameters.get(f"{prefix}{name}")
            u = 0.0 if found is None else (found.standard_uncertainty or 0.0) * factor
            cells.append("–" if found is None else " ± ".join(format_uncertain(found.value * factor, u)))
        K, _ = curve_at(record, prefix, np.array([top]))
        change = 100 * relative(float(K[0]), record.value(f"{prefix}K0"))
        cells.append(" ± ".join(format_uncertain(change, 100 * change_uncertainty(record, prefix, top))))
        rows.append([axis_label(prefix), *cells])
    return [
        "axis",
        *(f"{name}, {ENGINEERING[name][1]}" for name in ("K0", "c1", "c2")),
        f"change at {text_in_g(top)}, %",
    ], rows


def headline(record: Calibration, prefix: str) -> str:
    """Return the g-sensitivity in one sentence, and by how much it departs from the linear."""
    levels = numbers(record, prefix)
    last = levels[-1]
    first, top = text_in_g(force_of(record, levels[0])), text_in_g(force_of(record, last))
    if last == levels[0]:
        return f"{axis_label(prefix)} drifts by {_per_g(record, f'{prefix}K_{last}')} at {first}."
    zeta = record.parameter(f"{prefix}zeta_{last}")
    measured = _change(zeta.value, zeta.standard_uncertainty)
    curved = change_uncertainty(record, prefix, force_of(record, last))
    if centrifuge_of(record).model.curve[prefix.rstrip("_")] == "constant":
        return (
            f"{axis_label(prefix)} drifts linearly with g, by {_per_g(record, f'{prefix}K0')} from {first} to {top}; "
            f"the factor at {top} is {measured} than that at {first}."
        )
    K, _ = curve_at(record, prefix, np.array([force_of(record, last)]))
    fitted = _change(relative(float(K[0]), record.value(f"{prefix}K0")), curved)
    return (
        f"{axis_label(prefix)} drifts by {_per_g(record, f'{prefix}K_{levels[0]}')} at {first}, its drift factor; "
        f"at {top} the factor is {measured} measured directly against {first}, and {fitted} by the curve through all "
        "levels."
    )


def facts(record: Calibration, sets: list[str]) -> list[tuple[str, str]]:
    """Return the figures that the head of a report shows: name and value."""
    found = []
    for prefix in sets[:2]:
        K0 = record.parameter(f"{prefix}K0")
        value, u = format_uncertain(K0.value * PER_G, (K0.standard_uncertainty or 0.0) * PER_G, digits=1)
        digits = u.replace(".", "").lstrip("0")
        found.append((f"K0 {axis_label(prefix)}, deg/h/g", f"{value}({digits})"))
    r = centrifuge_of(record)
    loaded = [row for row in r.runs if row.role == "loaded"]
    found += [
        ("curve", ", ".join(dict.fromkeys(r.model.curve.values()))),
        ("levels", str(len(r.levels))),
        ("loaded runs", str(len(loaded))),
        ("highest level", text_in_g(r.model.highest_specific_force.value)),
    ]
    return found


def _per_g(record: Calibration, name: str) -> str:
    K = record.parameter(name)
    value, u = format_uncertain(K.value * PER_G, (K.standard_uncertainty or 0.0) * PER_G)
    return f"{value} ± {u} deg/h per g"


def _change(share: float, uncertainty: float | None) -> str:
    change, u = format_uncertain(100 * abs(share), 100 * (uncertainty or 0.0))
    return f"{change} ± {u} % {'smaller' if share < 0 else 'larger'}"


def change_uncertainty(record: Calibration, prefix: str, force: float) -> float:
    """Return the standard uncertainty of K(a)/K0 - 1 from those of c1 and c2."""
    names = [n for n in (f"{prefix}c1", f"{prefix}c2") if n in record.parameters]
    if not names:
        return 0.0
    C = record.covariance.block(names)
    gradient = np.array([force if n.endswith("c1") else force**2 for n in names])
    return float(np.sqrt(max(gradient @ C @ gradient, 0.0)))


def curve_at(record: Calibration, prefix: str, force: Array) -> tuple[Array, Array]:
    """Return K(a), rad/s/(m/s^2), and its standard uncertainty at specific forces, m/s^2, shapes (n,)."""
    terms = {
        t: record.value(f"{prefix}{t}") if f"{prefix}{t}" in record.parameters else 0.0 for t in ("K0", "c1", "c2")
    }
    K = curve(force, **terms)
    names = [n for n in ("K0", "c1", "c2") if f"{prefix}{n}" in record.parameters]
    C = record.covariance.block([f"{prefix}{n}" for n in names])
    gradient = {"K0": K / terms["K0"], "c1": terms["K0"] * force, "c2": terms["K0"] * force**2}
    J = np.stack([gradient[n] for n in names], axis=1)
    return K, np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", J, C, J), 0.0))


def prefixes(record: Calibration) -> list[str]:
    """Return the sets of parameters that a record has: ``x_``, ``y_``, ``x_down_`` ..."""
    return [p for p in ("x_", "y_", "x_down_", "y_down_") if f"{p}K0" in record.parameters]


def numbers(record: Calibration, prefix: str) -> list[int]:
    """Return the levels of a set, rising."""
    return [row.level for row in centrifuge_of(record).levels if f"{prefix}K_{row.level}" in record.parameters]


def axis_label(prefix: str) -> str:
    """Return what people call a set of parameters: ``X``, or ``X, spin axis down``."""
    return prefix[0].upper() + (", spin axis down" if "down" in prefix else "")


def text_in_g(force: float) -> str:
    """Return a specific force, m/s^2, in g."""
    return f"{from_si(force, 'g'):.3g} g"

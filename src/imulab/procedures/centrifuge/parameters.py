"""Levels to parameters: K, zeta, the curve, its direction and the cross terms, with one covariance over all of them.

Every parameter is a function of the levels' lines; its derivative carries their covariance. The radius is common:
with a relative error rho of R every K is off by -rho, c1 by -rho, c2 by -2 rho, zeta not at all.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from imulab.estimation.least_squares import chi_square_probability, coverage_factor
from imulab.procedures.centrifuge.curve import CurveFit, fit_curve
from imulab.procedures.centrifuge.levels import Level, Levels, as_vector
from imulab.procedures.centrifuge.manifest import Manifest
from imulab.procedures.centrifuge.model import CROSS_UNIT, CURVE_UNITS, K_UNIT
from imulab.recording import Array

_ROUNDING = 1e-7
"""Turning of the drift, rad, below which it is not warned of however small the noise."""


@dataclass
class _Row:
    """A parameter under construction: value, derivative with respect to the levels' vectors, and to ln R."""

    name: str
    value: float
    unit: str
    derivative: Array
    radius: float


@dataclass(frozen=True)
class Estimates:
    """Parameters of a test.

    Attributes
    ----------
    names, units
        In the order of the record.
    values, covariance
        SI, shapes (p,), (p, p).
    levels
        Covariance of the levels' (Re, Im) of each axis, in the order of the levels, rad/s/(m/s^2) squared.
    freedom, coverage
        Effective degrees of freedom (Welch-Satterthwaite) and the factor of the 95 % interval, shapes (p,).
    curves
        Prefix (``x_``, ``y_``, ``x_down_`` ..) to the fitted curve.
    turning
        Prefix to the probability that the line's direction turns so much between levels by chance.
    cross
        Level to the complex cross term and half-sum of each axis, rad/s/(m/s^2)^2 and rad/s/(m/s^2).
    given
        Standard uncertainties if the chosen model of the curve is right, shape (p,).
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    covariance: Array
    levels: Array
    freedom: Array
    coverage: Array
    curves: dict[str, CurveFit]
    turning: dict[str, float]
    cross: dict[int, tuple[np.ndarray, np.ndarray]]
    given: Array
    warnings: tuple[str, ...] = field(default=())


def estimate(levels: Levels, manifest: Manifest, *, method: str, curve: str = "auto") -> Estimates:
    """Return the parameters of all axes and both positions of the spin axis.

    Parameters
    ----------
    levels
        Pooled.
    manifest
        For radius and gravity.
    method
        ``least-squares`` (noise in magnitudes corrected) or ``fourier`` (not).
    curve
        Model of K(a), or ``auto``.

    Raises
    ------
    OptionError
        The curve's model is unknown or too large.
    """
    items = levels.items
    axes = len(items[0].line)
    width = 2 * axes
    size = width * len(items)
    common = _cycles(levels, size, width)
    V = _covariance(items, common, width)
    rows: list[_Row] = []
    curves: dict[str, CurveFit] = {}
    turning: dict[str, float] = {}
    warnings: list[str] = []
    for axis, letter in enumerate("xy"[:axes]):
        for spin_axis, mark in (("up", ""), ("down", "down_")):
            mine = [index for index, level in enumerate(items) if level.spin_axis == spin_axis]
            if not mine:
                continue
            prefix = f"{letter}_{mark}"
            K = [
                _magnitude(items[index], index, axis, size, width, f"{prefix}K_{items[index].number}", method)
                for index in mine
            ]
            rows += K
            rows += [
                _zeta(row, K[0], f"{prefix}zeta_{items[i].number}") for row, i in zip(K[1:], mine[1:], strict=True)
            ]
            curves[prefix], more = _curve(prefix, K, items, mine, V, curve)
            rows += more
            if all(items[index].directed for index in mine):
                direction, probability = _direction(prefix, items, mine, axis, V, size, width)
                rows.append(direction)
                turning[prefix] = probability
            for row, index in zip(K, mine, strict=True):
                u = float(np.sqrt(items[index].component_variance[axis]))
                if row.value < 4 * u:
                    warnings.append(
                        f"{row.name}: the line is hardly above the noise ({row.value / max(u, 1e-300):.1f} sigma)"
                    )
    cross = _cross(items, axes, size, width, manifest, rows, warnings)
    J = np.array([row.derivative for row in rows])
    values = np.array([row.value for row in rows])
    radius = np.array([row.radius for row in rows]) * manifest.radius_uncertainty / manifest.radius
    covariance = J @ V @ J.T + np.outer(radius, radius)
    given = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    for prefix, chosen in curves.items():
        _widen(covariance, [row.name for row in rows], prefix, chosen, J, V)
    freedom = _freedom(J, V, common, radius, levels, width)
    return Estimates(
        names=tuple(row.name for row in rows),
        units=tuple(row.unit for row in rows),
        values=values,
        covariance=(covariance + covariance.T) / 2,
        levels=V,
        freedom=freedom,
        coverage=np.array([coverage_factor(float(nu) if nu < 1e6 else None) for nu in freedom]),
        curves=curves,
        turning=turning,
        cross=cross,
        given=given,
        warnings=tuple(warnings),
    )


def _covariance(items: tuple[Level, ...], common: Array, width: int) -> Array:
    """Covariance of the levels' lines: of each its own, what power cycles do to all, and what corrections leave."""
    V = np.zeros_like(common)
    for index, level in enumerate(items):
        V[index * width : (index + 1) * width, index * width : (index + 1) * width] = level.covariance
    V += common
    corrections = np.concatenate([level.common for level in items], axis=1)
    V += corrections.T @ corrections
    return V


def _magnitude(level: Level, index: int, axis: int, size: int, width: int, name: str, method: str) -> _Row:
    line = level.line[axis]
    modulus = max(abs(line), 1e-300)
    derivative = np.zeros(size)
    place = index * width + 2 * axis
    derivative[place : place + 2] = line.real / modulus, line.imag / modulus
    value = modulus
    if level.directed and method == "least-squares":
        value = modulus - level.component_variance[axis] / (2 * modulus)
    return _Row(name, float(value), K_UNIT, derivative, -float(value))


def _zeta(row: _Row, first: _Row, name: str) -> _Row:
    ratio = row.value / first.value
    return _Row(name, ratio - 1, "1", row.derivative / first.value - ratio / first.value * first.derivative, 0.0)


def _curve(
    prefix: str, K: list[_Row], items: tuple[Level, ...], mine: list[int], V: Array, model: str
) -> tuple[CurveFit, list[_Row]]:
    G = np.array([row.derivative for row in K])
    force = np.array([items[index].force for index in mine])
    fitted = fit_curve(force, np.array([row.value for row in K]), G @ V @ G.T, model)
    p, D = fitted.coefficients, fitted.from_levels @ G
    rows = [_Row(f"{prefix}K0", float(p[0]), CURVE_UNITS["K0"], D[0], -float(p[0]))]
    for power, term in ((1, "c1"), (2, "c2")):
        if fitted.covariance[power, power] > 0:  # a term that was chosen away is 0, with an uncertainty
            value = float(p[power] / p[0])
            rows.append(
                _Row(f"{prefix}{term}", value, CURVE_UNITS[term], (D[power] - value * D[0]) / p[0], -power * value)
            )
    return fitted, rows


def _widen(covariance: Array, names: list[str], prefix: str, fitted: CurveFit, J: Array, V: Array) -> None:
    """Add to the curve's part of the covariance what the choice of its model leaves open."""
    powers = {"K0": 0, "c1": 1, "c2": 2}
    mine = [(names.index(f"{prefix}{term}"), power) for term, power in powers.items() if f"{prefix}{term}" in names]
    place, power = (np.array(part) for part in zip(*mine, strict=True))
    p = fitted.coefficients
    turn = np.eye(3) / p[0]
    turn[:, 0] = -p / p[0] ** 2
    turn[0] = 1.0, 0.0, 0.0
    stated = (turn @ fitted.covariance @ turn.T)[np.ix_(power, power)]
    covariance[np.ix_(place, place)] += stated - J[place] @ V @ J[place].T


def _direction(
    prefix: str, items: tuple[Level, ...], mine: list[int], axis: int, V: Array, size: int, width: int
) -> tuple[_Row, float]:
    """Angle of the pooled line, and the probability that the levels' angles differ so much by chance."""
    lines = np.array([items[index].line[axis] for index in mine])
    weights = 1 / np.maximum([items[index].component_variance[axis] for index in mine], 1e-60)
    weights = weights / weights.sum()
    pooled = complex((weights * lines).sum())
    unit = pooled / max(abs(pooled), 1e-300)
    derivative = np.zeros(size)
    across = np.zeros((len(mine), size))
    for number, (index, weight) in enumerate(zip(mine, weights, strict=True)):
        place = index * width + 2 * axis
        normal = np.array([-unit.imag, unit.real])
        derivative[place : place + 2] = weight * normal / max(abs(pooled), 1e-300)
        across[number, place : place + 2] = normal / max(abs(lines[number]), 1e-300)
    # Angles of the levels against the pooled one; their covariance has one degree less than levels.
    angle = np.angle(lines / unit)
    spread = across - derivative
    covariance = spread @ V @ spread.T + _ROUNDING**2 * np.eye(len(mine))
    probability = 1.0
    if len(mine) > 1:
        chi_square = float(angle @ np.linalg.pinv(covariance, rcond=1e-9, hermitian=True) @ angle)
        probability = chi_square_probability(chi_square, len(mine) - 1)
    return _Row(f"{prefix}direction", float(np.angle(pooled)), "rad", derivative, 0.0), probability


def _cross(
    items: tuple[Level, ...],
    axes: int,
    size: int,
    width: int,
    manifest: Manifest,
    rows: list[_Row],
    warnings: list[str],
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Add the cross terms where a level has the spin axis both ways: half the difference of its lines over g."""
    where = {(level.spin_axis, level.number): index for index, level in enumerate(items)}
    found: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for (spin_axis, number), up in where.items():
        down = where.get(("down", number))
        if spin_axis != "up" or down is None:
            continue
        if not (items[up].directed and items[down].directed):
            warnings.append(f"level {number}: no table_angle, so that spin-axis cross terms cannot be separated")
            continue
        difference = (items[up].line - items[down].line) / (2 * manifest.gravity)
        found[number] = (difference, (items[up].line + items[down].line) / 2)
        for axis in range(axes):
            modulus = max(abs(difference[axis]), 1e-300)
            derivative = np.zeros(size)
            pair = as_vector(difference[axis : axis + 1]) / modulus / (2 * manifest.gravity)
            derivative[up * width + 2 * axis : up * width + 2 * axis + 2] = pair
            derivative[down * width + 2 * axis : down * width + 2 * axis + 2] = -pair
            rows.append(_Row(f"{'xy'[axis]}_cross_{number}", float(modulus), CROSS_UNIT, derivative, -float(modulus)))
    return found


def _cycles(levels: Levels, size: int, width: int) -> Array:
    """Covariance of the levels' lines by what each power cycle does to all of them alike, axis by axis.

    In units of the mean K of a set, not of each level's own: a noisy level would take a share of its own noise.
    """
    found = levels.repeatability
    total = np.zeros((size, size))
    if not found.cycle and not found.turn:
        return total
    for axis in range(width // 2):
        for cycle in {cycle for level in levels.items for cycle in level.cycles}:
            along, across = np.zeros(size), np.zeros(size)
            for index, level in enumerate(levels.items):
                if cycle not in level.cycles:
                    continue
                unit = level.line[axis] / max(abs(level.line[axis]), 1e-300)
                share = level.cycles[cycle][axis] * _mean_size(levels, level.spin_axis, axis)
                place = index * width + 2 * axis
                along[place : place + 2] = share * unit.real, share * unit.imag
                across[place : place + 2] = -share * unit.imag, share * unit.real
            total += found.cycle * np.outer(along, along) + found.turn * np.outer(across, across)
    return total


def _mean_size(levels: Levels, spin_axis: str, axis: int) -> float:
    mine = [level for level in levels.items if level.spin_axis == spin_axis]
    weights = [1 / max(float(level.component_variance[axis]), 1e-60) for level in mine]
    return float(np.average([abs(level.line[axis]) for level in mine], weights=weights))


def _freedom(J: Array, V: Array, common: Array, radius: Array, levels: Levels, width: int) -> Array:
    """Effective degrees of freedom of each parameter's variance."""
    cycles = np.einsum("pi,ij,pj->p", J, common, J)
    variance = cycles.copy()
    spent = cycles**2 / max(levels.repeatability.freedom, 1)
    for index, level in enumerate(levels.items):
        part = slice(index * width, (index + 1) * width)
        own = V[part, part] - common[part, part]
        mine = np.einsum("pi,ij,pj->p", J[:, part], own, J[:, part])
        # An axis's own share decides which of the degrees of freedom counts.
        shares = np.abs(J[:, part]).reshape(len(J), -1, 2).sum(axis=2)
        nu = level.freedom[np.argmax(shares, axis=1)]
        variance += mine
        spent += mine**2 / nu
    total = variance + radius**2
    result: Array = np.clip(total**2 / np.maximum(spent, 1e-300), 1.0, 1e9)
    return result

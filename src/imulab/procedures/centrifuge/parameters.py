"""Levels to parameters: K, zeta, the curve K(a) and its terms, corrected for errors that the test shows.

The FOG's line is subtracted from X and Y as the axis sees it: turned back by the FOG's delay, scaled and turned by the
mismatch that the Earth's rate shows. The uncertainty of each correction is common to all runs.

Every parameter is a function of the levels' lines; its derivative propagates their covariance. The radius is common:
with a relative error rho of R every K is off by -rho, c1 by -rho, c2 by -2 rho, zeta not at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from imulab.display import Finding
from imulab.errors import OptionError, listed
from imulab.estimation.decisions import CURVE_TERM
from imulab.estimation.least_squares import blend, chi_square_limit, chi_square_probability, coverage_factor
from imulab.procedures.centrifuge import CURVES
from imulab.procedures.centrifuge.levels import (
    Level,
    Levels,
    MeasuredRuns,
    Repeatability,
    RunLine,
    as_vector,
    delays,
    mismatch,
    pooled,
)
from imulab.procedures.centrifuge.lines import Complex, three_sigma
from imulab.procedures.centrifuge.manifest import CROSS_UNIT, CURVE_UNITS, K_UNIT, Manifest
from imulab.procedures.centrifuge.run import LoadedRun
from imulab.recording import Array

# The fitted curve K(a) = K0 (1 + c1 a + c2 a^2), and the choice of its terms.


_NESTED = ("constant", "c1", "c1+c2")
_CURVE_ROUNDING = 1e-9  # of K, relative: least noise, which exact data get


@dataclass(frozen=True)
class CurveFit:
    """A curve through the K_i of one axis.

    Attributes
    ----------
    model
        Name of the model, a key of `CURVES`.
    coefficients
        Those of 1, a, a^2: ``K(a) = p0 + p1 a + p2 a^2``; zero where the model has no such term.
    from_levels
        Matrix from the K_i to the coefficients, shape (3, n).
    from_levels_largest
        The same of the largest model that the levels allow, whose noise an unchosen term would have.
    covariance
        Of the coefficients, shape (3, 3): for a stated model, given that model; for a chosen one, whichever model is
        right (`imulab.estimation.least_squares`).
    chi_square, freedom
        Chi-square of the residuals and its degrees of freedom.
    tried
        For every model that the levels allow: name, number of coefficients, chi-square, and whether it was chosen.
        Model, number of coefficients, chi-square and whether it was chosen, of every model that the levels allow.
    """

    model: str
    coefficients: Array
    from_levels: Array
    covariance: Array
    chi_square: float
    freedom: int
    tried: tuple[tuple[str, int, float, bool], ...]
    from_levels_largest: Array

    @property
    def probability(self) -> float | None:
        """Probability of so large a chi-square if the model holds; None without degrees of freedom."""
        return chi_square_probability(self.chi_square, self.freedom) if self.freedom > 0 else None


def fit_curve(force: Array, K: Array, covariance: Array, model: str = "auto") -> CurveFit:
    """Return K(a) fitted by generalised least squares: ``p = (A' V^-1 A)^-1 A' V^-1 K``, A the columns 1, a, a^2.

    A term is taken where it lowers chi-square by more than the 5 % point of chi-square with one degree of freedom;
    where even the largest model leaves more scatter than the covariance explains, chi-square counts in units of that
    scatter (F-test). A chosen model keeps its own values and has the uncertainty of all models together.

    Parameters
    ----------
    force
        Specific force of the levels, m/s^2, shape (n,).
    K, covariance
        Values at the levels and their covariance, shapes (n,), (n, n).
    model
        ``auto``, ``constant``, ``c1``, ``c2`` or ``c1+c2``.

    Raises
    ------
    OptionError
        The model is unknown, or has more coefficients than there are levels.
    """
    if model != "auto" and model not in CURVES:
        raise OptionError(f"curve {model!r}: expected one of {listed(('auto', *CURVES), model)}")
    if model != "auto" and len(CURVES[model]) + 1 > len(K):
        raise OptionError(f"curve {model!r}: {len(K)} levels; expected at least {len(CURVES[model]) + 1}")
    names = [name for name, terms in CURVES.items() if len(terms) + 1 <= max(len(K) - 1, 1) or name == model]
    whitened = np.asarray(np.linalg.cholesky(_regular(covariance, K)), dtype=np.float64)
    solutions = {name: _solve(force, K, whitened, CURVES[name]) for name in names}
    chosen = model
    if model == "auto":
        largest = max(names, key=lambda name: len(CURVES[name]))
        freedom = len(K) - 1 - len(CURVES[largest])
        scale = max(1.0, min(value[2] for value in solutions.values()) / freedom) if freedom > 0 else 1.0
        chosen = min(
            names,
            key=lambda name: solutions[name][2] / scale + chi_square_limit(1, CURVE_TERM.level) * len(CURVES[name]),
        )
    coefficients, matrix, chi_square = solutions[chosen]
    matrix_of_noise = matrix @ covariance @ matrix.T
    return CurveFit(
        chosen, coefficients, matrix,
        _blended(force, K, whitened, covariance, coefficients, matrix_of_noise) if model == "auto" else matrix_of_noise,
        chi_square, len(K) - 1 - len(CURVES[chosen]),
        tuple((name, 1 + len(CURVES[name]), solutions[name][2], name == chosen) for name in names),
        solutions[max(names, key=lambda name: len(CURVES[name]))][1],
    )  # fmt: skip


def _blended(force: Array, K: Array, root: Array, covariance: Array, chosen: Array, chosen_covariance: Array) -> Array:
    """Return the covariance of the chosen coefficients whichever model is right, at least that given the model."""
    nested = [name for name in _NESTED if len(CURVES[name]) < len(K)]
    steps = [_solve(force, K, root, CURVES[name]) for name in nested]
    squares = np.array([chi_square for *_, chi_square in steps])
    blended = blend(
        np.array([coefficients for coefficients, *_ in steps]),
        np.array([matrix @ covariance @ matrix.T for _, matrix, _ in steps]),
        -np.diff(squares), np.ones(len(steps) - 1), prior=0.0,
    )  # fmt: skip
    scale = np.max(force) ** np.arange(3.0)
    values, vectors = np.linalg.eigh((blended.about(chosen) - chosen_covariance) * np.outer(scale, scale))
    more: Array = (vectors * np.maximum(values, 0.0)) @ vectors.T / np.outer(scale, scale)
    return chosen_covariance + more


def _regular(covariance: Array, K: Array) -> Array:
    """Return a covariance that stays invertible for noise-free data and keeps rounding from looking significant."""
    floor = max(float(np.diagonal(covariance).max()) * 1e-12, (_CURVE_ROUNDING * float(np.abs(K).max())) ** 2, 1e-60)
    regular: Array = covariance + floor * np.eye(len(covariance))
    values, vectors = np.linalg.eigh(regular)
    if values[0] > 0:
        return regular
    # One error that all levels share may be so much larger than their noise that rounding hides the noise.
    return np.asarray((vectors * np.maximum(values, floor)) @ vectors.T)


def _solve(force: Array, K: Array, root: Array, terms: tuple[int, ...]) -> tuple[Array, Array, float]:
    top = float(force.max())
    powers = (0, *terms)
    design = np.stack([(force / top) ** power for power in powers], axis=1)
    white = np.linalg.solve(root, design)
    matrix = np.zeros((3, len(K)))
    matrix[list(powers)] = np.linalg.pinv(white) @ np.linalg.inv(root) / (top ** np.array(powers, dtype=float))[:, None]
    coefficients = matrix @ K
    left = np.linalg.solve(root, K - design @ (coefficients[list(powers)] * top ** np.array(powers, dtype=float)))
    return coefficients, matrix, float(left @ left)


# Errors of rig and channels that the test shows beyond three standard uncertainties: corrected, the rest added to u.


_FLOOR = 1e-4
"""An effect on K below this part is left alone, however small its uncertainty."""
_QUARTER = np.array([1.0, 1j])
"""Y sees vectors fixed in the arm a quarter turn from X."""


@dataclass(frozen=True)
class Corrections:
    """Corrections for errors that the test shows.

    Attributes
    ----------
    fog
        By run index: factors of the FOG's line in each axis, shape (axes,).
    common
        By run index: change of the run's lines by one standard uncertainty of each correction, rad/s, shape (k, axes).
    corrected
        Names of the entries of the error budget that are corrected.
    warnings
        A sentence for each error.
    """

    fog: dict[int, Complex] = field(default_factory=dict)
    common: dict[int, Complex] = field(default_factory=dict)
    corrected: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def find_corrections(runs: Sequence[LoadedRun], lines: dict[int, RunLine], *, correct: bool = True) -> Corrections:
    """Return the corrections that the lines of a test call for.

    Parameters
    ----------
    runs, lines
        Reduced runs and their lines, without any correction.
    correct
        Whether errors are corrected; otherwise all of them are uncertainty (method ``fourier``).
    """
    test = MeasuredRuns([run for run in runs if run.index in lines], lines)
    axes = len(test.runs[0].channels) - 1
    late, shown = _correct_delay(test, lines, axes, correct=correct)
    turn: Complex = np.exp(-1j * test.table * late)
    factor: Complex = turn[:, None] * np.ones(axes)
    if not test.both:
        for axis in range(axes):
            change, more = _correct_mismatch(test, axis, axes, late, correct=correct)
            factor[:, axis] += turn * change
            shown += more
    if not shown:
        return Corrections()
    stacked = np.stack([item.common for item in shown], axis=1)
    return Corrections(
        {run.index: factor[i] for i, run in enumerate(test.runs)} if correct else {},
        {run.index: stacked[i] for i, run in enumerate(test.runs)},
        tuple(name for item in shown for name in item.named) if correct else (),
        tuple(item.warning for item in shown),
    )


@dataclass(frozen=True)
class _Finding:
    """An error that the test shows; `common` is the change of the lines by one u of it, shape (runs, axes)."""

    common: Complex
    warning: str
    named: tuple[str, ...] = ()


def _correct_delay(
    test: MeasuredRuns, lines: dict[int, RunLine], axes: int, *, correct: bool
) -> tuple[float, list[_Finding]]:
    """Return by how much the FOG's line is turned back, s, and the delays that the test shows."""
    delay = delays(test)
    if delay is None:
        return 0.0, []
    late = 0.0
    shown: list[_Finding] = []
    top = float(np.abs(test.table).max())
    turning = _is_clear(delay.axis, delay.axis_uncertainty) and abs(delay.axis) * top > _FLOOR
    size = max(abs(delay.fog), abs(delay.late)) if turning else abs(delay.late)
    clear = _is_clear(delay.fog, delay.fog_uncertainty) or (_is_clear(delay.late, delay.uncertainty) and not turning)
    if clear and size * top * test.fog_share > _FLOOR:
        named: tuple[str, ...] = ()
        if correct and not turning:
            late, size, named = delay.late, delay.uncertainty, ("delay of the FOG", "delay of X")
            done = "its line was turned back by that, and what is uncertain of it is in u"
        else:
            done = "added to u, not corrected, since " + (
                "X turns against table_angle too, which a delay of X or differential flexure may do"
                if turning
                else "method fourier corrects nothing"
            )
        turn = np.exp(-1j * test.table * late)
        shown.append(
            _Finding(
                (1j * size * test.table * turn * test.fog)[:, None] * _QUARTER[:axes],
                f"the FOG is {1e3 * delay.fog:.3g} ± {1e3 * delay.fog_uncertainty:.1g} ms late against table_angle, "
                f"which changes K at the highest level by up to {100 * abs(delay.fog) * top * test.fog_share:.2g} %: "
                f"{done}; mend the timing or the filters of the channels",
                named,
            )
        )
    if turning:
        drift = np.array([lines[run.index].line * run.force for run in test.runs])
        shown.append(
            _Finding(
                1j * delay.axis * test.table[:, None] * drift,
                Finding(
                    f"X turns against table_angle as if it were {1e3 * delay.axis:.3g} ± "
                    f"{1e3 * delay.axis_uncertainty:.1g} ms late (differential flexure looks the same): "
                    "added to the uncertainty of the direction, which it "
                    f"changes by up to {np.degrees(abs(delay.axis) * top):.2g} deg at the highest level",
                    "take table_angle and the gyroscope's channels by one clock",
                ),
            )
        )
    return late, shown


def _correct_mismatch(
    test: MeasuredRuns, axis: int, axes: int, late: float, *, correct: bool
) -> tuple[Complex, list[_Finding]]:
    """Return, by run, the term to add to the factor of the FOG's line in an axis, and the mismatch found."""
    change = np.zeros(len(test.runs), dtype=np.complex128)
    shown: list[_Finding] = []
    ratio = mismatch(test, axis, late)
    if ratio is None:
        return change, shown
    sense = np.array([run.run.sense for run in test.runs])
    turn = np.exp(-1j * test.table * late)
    for name, scale, value, unit in (
        ("scale mismatch", "per mille", ratio.scale, np.ones(len(sense))),
        ("FOG azimuth", "mrad", ratio.azimuth, 1j * sense),
    ):
        if not (_is_clear(value, ratio.uncertainty, ratio.freedom) and abs(value) * test.fog_share > _FLOOR):
            continue
        change += unit * value
        size = ratio.uncertainty if correct else abs(value)
        shown.append(
            _Finding(
                -size * (unit * turn * test.fog)[:, None] * _QUARTER[:axes] * (np.arange(axes) == axis),
                Finding(
                    f"Earth rate shows a {name} of {1e3 * value:.3g} ± {1e3 * ratio.uncertainty:.1g} {scale} between "
                    f"{'XY'[axis]} and the FOG, which would change K at the highest level by up to "
                    f"{100 * abs(value) * test.fog_share:.2g} %: "
                    f"{'corrected' if correct else 'method fourier does not correct it'}, and what is uncertain of it "
                    "is in u; both senses of rotation remove it",
                    "run both senses of rotation",
                ),
                (name,) if axis == 0 else (),
            )
        )
    return change, shown


def corrected(runs: Sequence[LoadedRun], corrections: Corrections) -> list[LoadedRun]:
    """Return the runs with the factors of their FOG's line and the common uncertainties set."""
    return [
        replace(run, fog_factor=corrections.fog.get(run.index), common=corrections.common.get(run.index))
        for run in runs
    ]


def _is_clear(value: float, uncertainty: float, freedom: float | None = None) -> bool:
    return abs(value) > three_sigma(freedom) * uncertainty


# Parameters: K, zeta, the curve, its direction and the cross terms, with one covariance over all of them.


_ROUNDING = 1e-7
"""Turning of the drift, rad, below which no warning is given, however small the noise."""


@dataclass
class _Row:
    """A parameter under construction: value, unit, and its derivatives by the levels' vectors and by ln R.

    Of a term of the curve that was not chosen and is 0, `unchosen` is the derivative that it would have had.
    """

    name: str
    value: float
    unit: str
    derivative: Array
    radius: float
    unchosen: Array | None = None


@dataclass(frozen=True)
class Estimates:
    """Parameters of a test.

    Attributes
    ----------
    names, units
        Names and units in the order of the record.
    values, covariance
        SI, shapes (p,), (p, p).
    levels
        Covariance of the levels' (Re, Im) of each axis, in the order of the levels, rad/s/(m/s^2) squared.
    freedom, coverage
        Effective degrees of freedom (Welch-Satterthwaite) and the factor of the 95 % interval, shapes (p,).
    curves
        Fitted curve by prefix (``x_``, ``y_``, ``x_down_`` ..).
    turning
        By prefix: probability that the line's direction turns so much between levels by chance.
    cross
        By level: complex cross term and half-sum of each axis, rad/s/(m/s^2)^2 and rad/s/(m/s^2).
    given_model
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
    given_model: Array
    warnings: tuple[str, ...] = field(default=())


def _warn_weak_lines(factors: Sequence[_Row], uncertainties: Sequence[float]) -> list[str]:
    """Return a message for each level whose line is below four standard uncertainties, (rad/s)/(m/s^2)."""
    action = "record longer runs at this level, or start at a higher one"
    return [
        Finding(f"{row.name}: the line is hardly above the noise ({row.value / max(u, 1e-300):.1f} sigma)", action)
        for row, u in zip(factors, uncertainties, strict=True)
        if row.value < 4 * u
    ]


def estimate(levels: Levels, manifest: Manifest, *, method: str, curve: str = "auto") -> Estimates:
    """Return the parameters of all axes and both positions of the spin axis.

    Parameters
    ----------
    levels
        Pooled levels.
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
            warnings += _warn_weak_lines(K, [float(np.sqrt(items[index].component_variance[axis])) for index in mine])
    cross = _cross(items, axes, size, width, manifest, rows, warnings)
    J = np.array([row.derivative for row in rows])
    values = np.array([row.value for row in rows])
    radius = np.array([row.radius for row in rows]) * manifest.radius_uncertainty / manifest.radius
    covariance = J @ V @ J.T + np.outer(radius, radius)
    given_model = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    for prefix, chosen in curves.items():
        _widen(covariance, [row.name for row in rows], prefix, chosen, J, V)
    spread = np.array([row.derivative if row.unchosen is None else row.unchosen for row in rows])
    freedom = _freedom(spread, V, common, radius, levels, width)
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
        given_model=given_model,
        warnings=tuple(warnings),
    )


def _covariance(items: tuple[Level, ...], common: Array, width: int) -> Array:
    """Return the covariance of the levels' lines: each level's part, the power cycles' and the corrections'."""
    V = np.zeros_like(common)
    for index, level in enumerate(items):
        V[index * width : (index + 1) * width, index * width : (index + 1) * width] = level.covariance
    V += common
    corrections = np.concatenate([level.common for level in items], axis=1)
    V += corrections.T @ corrections
    return V


def _magnitude(level: Level, index: int, axis: int, size: int, width: int, name: str, method: str) -> _Row:
    """Return ``K_i = |Z|``, less ``sigma^2 / 2 |Z|`` of the noise (Rice), with its derivative by the level's line."""
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
    """Return ``zeta_i = K_i / K_1 - 1`` with its derivative by the levels' lines."""
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
            derivative = (D[power] - value * D[0]) / p[0]
            unchosen = None if derivative.any() else fitted.from_levels_largest[power] @ G / p[0]
            rows.append(_Row(f"{prefix}{term}", value, CURVE_UNITS[term], derivative, -power * value, unchosen))
    return fitted, rows


def _widen(covariance: Array, names: list[str], prefix: str, fitted: CurveFit, J: Array, V: Array) -> None:
    """Add to the curve's part of the covariance the uncertainty of the choice of its model."""
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
    """Return the angle of the pooled line, and the probability that the levels' angles differ so much by chance."""
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
    # Angles of the levels against the pooled one; their covariance has the rank of the number of levels less one.
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
    """Add and return the cross terms of levels with the spin axis both ways: half the lines' difference over g."""
    where = {(level.spin_axis, level.number): index for index, level in enumerate(items)}
    by_level: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for (spin_axis, number), up in where.items():
        down = where.get(("down", number))
        if spin_axis != "up" or down is None:
            continue
        if not (items[up].directed and items[down].directed):
            warnings.append(
                Finding(
                    f"level {number}: no table_angle, so that spin-axis cross terms cannot be separated",
                    "record table_angle in every run",
                )
            )
            continue
        difference = (items[up].line - items[down].line) / (2 * manifest.gravity)
        by_level[number] = (difference, (items[up].line + items[down].line) / 2)
        for axis in range(axes):
            modulus = max(abs(difference[axis]), 1e-300)
            derivative = np.zeros(size)
            pair = as_vector(difference[axis : axis + 1]) / modulus / (2 * manifest.gravity)
            derivative[up * width + 2 * axis : up * width + 2 * axis + 2] = pair
            derivative[down * width + 2 * axis : down * width + 2 * axis + 2] = -pair
            rows.append(_Row(f"{'xy'[axis]}_cross_{number}", float(modulus), CROSS_UNIT, derivative, -float(modulus)))
    return by_level


def _cycles(levels: Levels, size: int, width: int) -> Array:
    """Return the covariance of the levels' lines by the common effect of each power cycle, axis by axis.

    It is in units of the mean K of all levels: in units of a noisy level's own K it would take up that level's noise.
    """
    repeatability = levels.repeatability
    total = np.zeros((size, size))
    if not repeatability.cycle and not repeatability.turn:
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
            total += repeatability.cycle * np.outer(along, along) + repeatability.turn * np.outer(across, across)
    return total


def _mean_size(levels: Levels, spin_axis: str, axis: int) -> float:
    mine = [level for level in levels.items if level.spin_axis == spin_axis]
    weights = [1 / max(float(level.component_variance[axis]), 1e-60) for level in mine]
    return float(np.average([abs(level.line[axis]) for level in mine], weights=weights))


def _freedom(J: Array, V: Array, common: Array, radius: Array, levels: Levels, width: int) -> Array:
    """Return the effective degrees of freedom of each parameter's variance."""
    cycles = np.einsum("pi,ij,pj->p", J, common, J)
    variance = cycles.copy()
    spent = cycles**2 / max(levels.repeatability.freedom, 1)
    for index, level in enumerate(levels.items):
        part = slice(index * width, (index + 1) * width)
        run_noise = V[part, part] - common[part, part]
        mine = np.einsum("pi,ij,pj->p", J[:, part], run_noise, J[:, part])
        # The share of each axis decides which degrees of freedom count.
        shares = np.abs(J[:, part]).reshape(len(J), -1, 2).sum(axis=2)
        nu = level.freedom[np.argmax(shares, axis=1)]
        variance += mine
        spent += mine**2 / nu
    total = variance + radius**2
    result: Array = np.clip(total**2 / np.maximum(spent, 1e-300), 1.0, 1e9)
    return result


# K and zeta of each power cycle alone: how far a test repeats.


def power_cycles(levels: Levels, method: str) -> list[dict[str, Any]]:
    """Return K_i and zeta_i of every power cycle, with their uncertainty by noise and rates.

    ``zeta_i = K_i / K_1 - 1`` with both K of the same cycle; a cycle without the reference has no zeta. Prefixes are
    those of the parameters.
    """
    repeatability = Repeatability(run=levels.repeatability.run, run_freedom=levels.repeatability.run_freedom)
    rows: list[dict[str, Any]] = []
    for cycle in sorted({cycle for level in levels.items for cycle in level.cycles}):
        row: dict[str, Any] = {"power_cycle": cycle}
        for level in levels.items:
            group = [levels.lines[index] for index in level.runs]
            mine = [line for line in group if line.source.run.power_cycle == cycle]
            if not mine:
                continue
            level_of_cycle = pooled(level.number, level.spin_axis, mine, repeatability, level.directed)
            for axis, letter in enumerate("xy"[: len(level_of_cycle.line)]):
                size = float(abs(level_of_cycle.line[axis]))
                unit = np.array([level_of_cycle.line[axis].real, level_of_cycle.line[axis].imag]) / max(size, 1e-300)
                pair = slice(2 * axis, 2 * axis + 2)
                u = float(np.sqrt(unit @ level_of_cycle.covariance[pair, pair] @ unit))
                if level.directed and method == "least-squares":
                    size -= float(level_of_cycle.component_variance[axis]) / (2 * max(size, 1e-300))
                values = row.setdefault(letter if level.spin_axis == "up" else f"{letter}_down", {})
                values[f"K_{level.number}"] = {"value": size, "standard_uncertainty": u, "unit": K_UNIT}
        for values in row.values():
            if isinstance(values, dict) and "K_1" in values:
                values |= _cycle_zeta(values)
        rows.append(row)
    return rows


def _cycle_zeta(values: dict[str, Any]) -> dict[str, Any]:
    first = values["K_1"]
    zeta = {}
    for name, K in values.items():
        if name == "K_1":
            continue
        ratio = K["value"] / first["value"]
        relative = np.hypot(K["standard_uncertainty"] / K["value"], first["standard_uncertainty"] / first["value"])
        zeta[name.replace("K", "zeta")] = {
            "value": ratio - 1, "standard_uncertainty": float(abs(ratio) * relative), "unit": "1",
        }  # fmt: skip
    return zeta

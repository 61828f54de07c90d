"""From the coefficients of a rate test to bias, scale factor, misalignment, powers of the rate and g-sensitivity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imulab.procedures.rate.axes import TableAxes
from imulab.procedures.rate.choices import AXES
from imulab.procedures.rate.manifest import RateTest
from imulab.procedures.rate.solve import Problem, Solution
from imulab.recording import Array
from imulab.units import STANDARD_GRAVITY

_APART = 0.3


@dataclass(frozen=True)
class _Entry:
    """A parameter: its derivative by all coefficients, what the table's common error does to it, and the mounting's."""

    name: str
    unit: str
    value: float
    line: Array
    common: float = 0.0
    mounted: float = 0.0


def _entries(problem: Problem, solution: Solution, i: int, unit: str) -> list[_Entry]:
    """Return the parameters of gyroscope number `i`: quotients of its coefficients by its scale factor."""
    faces, size, found, order = problem.faces, len(problem.faces), solution.coefficients[i], solution.orders[i]
    axis, first = AXES[problem.gyros[i]], sum(map(len, solution.coefficients[:i]))
    own, count = faces.index(problem.gyros[i]), sum(map(len, solution.coefficients))
    scale = float(found[own])
    unity = np.eye(len(found))
    zeros = [np.concatenate([np.zeros(size + order - 1), row]) for row in _of_zeros(problem)[0]]

    def spread(part: Array) -> Array:
        return np.concatenate([np.zeros(first), part, np.zeros(count - first - len(part))])

    def quotient(name: str, of: str, at: Array, mounted: float = 0.0) -> _Entry:
        value = float(at @ found) / scale
        return _Entry(name, of, value, spread((at - value * unity[own]) / scale), mounted=mounted)

    return [
        quotient(f"gyro_bias_{axis}", "rad/s", zeros[0]),
        _Entry(f"gyro_scale_factor_{axis}", f"{unit}/(rad/s)", scale, spread(unity[own]), common=scale),
        *(
            quotient(f"gyro_misalignment_{axis}{AXES[face]}", "rad", unity[k], 1.0)
            for k, face in enumerate(faces)
            if k != own
        ),
        *(
            quotient(f"gyro_k{p}_{axis}", "1/(rad/s)" + (f"^{p - 1}" if p > 2 else ""), unity[size + p - 2])
            for p in range(2, order + 1)
        ),
        *(
            quotient(f"gyro_g_sensitivity_{axis}{b}", "rad/s/(m/s^2)", at)
            for b, at in zip(AXES, zeros[1:], strict=False)
        ),
    ]


def model_parameters(
    test: RateTest, problem: Problem, solution: Solution, unit: str, axes: TableAxes | None = None
) -> tuple[list[str], Array, Array, list[str], dict[str, float]]:
    """Return names, values, covariance and units of bias, scale factor, misalignment and powers of the rate.

    And the degrees of freedom of those whose uncertainty few faces show.
    """
    measured = [i for i, axis in enumerate(problem.gyros) if axis in problem.faces]
    found = [entry for i in measured for entry in _entries(problem, solution, i, unit)]
    found.sort(key=lambda entry: _ORDER.index(entry.name.rpartition("_")[0]))
    jacobian = np.array([entry.line for entry in found])
    shared = np.array([entry.common for entry in found]) * (test.relative_uncertainty or 0.0)
    mounting = (test.mounting_uncertainty or 0.0) if axes is None else 0.0
    own = np.array([entry.mounted for entry in found]) * mounting**2
    names = [entry.name for entry in found]
    few: dict[str, tuple[float, float]] = {}
    for i in measured:
        axis = AXES[problem.gyros[i]]
        added, freedom = _between_faces(problem, solution, problem.gyros[i])
        of_zeros = [f"gyro_bias_{axis}", *(f"gyro_g_sensitivity_{axis}{b}" for b in AXES)]
        for name, value in zip(of_zeros, added.tolist(), strict=False):
            own[names.index(name)] = value
            if value:
                few[name] = (value, freedom)
    matrix = np.asarray(jacobian @ solution.covariance @ jacobian.T + np.outer(shared, shared) + np.diag(own))
    if axes is not None:
        matrix += _by_axes(problem, found, axes)
    values = np.array([entry.value for entry in found])
    # Welch and Satterthwaite: the share that few faces show has few degrees of freedom
    variance = dict(zip(names, np.diag(matrix).tolist(), strict=True))
    freedoms = {name: nu * (variance[name] / added) ** 2 for name, (added, nu) in few.items()}
    return names, values, matrix, [entry.unit for entry in found], freedoms


def _by_axes(problem: Problem, found: Sequence[_Entry], axes: TableAxes) -> Array:
    """Return the covariance that the table axes' own makes: ``dT = -T dA A^-1``, columns of A the axes of the faces."""
    groups = _faces_of_runs(problem)
    sides = {axis: sum(1 for other, _ in groups if other == axis) for axis, _ in groups}

    def faces(of: Array) -> Array:
        matrix = np.zeros((3, 3))
        for (axis, sign), runs in groups.items():
            matrix[:, axis] += sign * of[runs].mean(axis=0) / sides[axis]
        return matrix

    inverse, values = np.linalg.inv(faces(axes.direction)), {entry.name: entry.value for entry in found}
    turn = np.array([[values[f"gyro_misalignment_{a}{b}"] if a != b else 1.0 for b in AXES] for a in AXES])

    def moved(change: Array) -> Array:
        x = -turn @ change @ inverse
        row = []
        for entry in found:
            kind, _, pair = entry.name.rpartition("_")
            i = AXES.index(pair[0])
            if kind == "gyro_scale_factor":
                row.append(entry.value * x[i, i])
            elif kind == "gyro_misalignment":
                row.append(x[i, AXES.index(pair[1])] - entry.value * x[i, i])
            else:
                row.append(0.0)
        return np.array(row)

    by_record = np.array([moved(faces(change)) for change in axes.changes]).reshape(-1, len(found))
    by_dwells = []
    for (axis, _), runs in groups.items():
        u = float(np.sqrt(np.sum(axes.spread[runs] ** 2))) / len(runs) / sides[axis]
        for k in range(3):
            if k != axis:
                change = np.zeros((3, 3))
                change[k, axis] = u
                by_dwells.append(moved(change))
    rest = np.array(by_dwells)
    return np.asarray(by_record.T @ axes.correlation @ by_record + rest.T @ rest)


_ORDER = ["gyro_bias", "gyro_scale_factor", "gyro_misalignment", *(f"gyro_k{power}" for power in range(2, 6)),
          "gyro_g_sensitivity"]  # fmt: skip


def _faces_of_runs(problem: Problem) -> dict[tuple[int, int], list[int]]:
    """Return the runs of each face: body axis along the table's, and which way it points."""
    found: dict[tuple[int, int], list[int]] = {}
    for run in range(problem.runs):
        first = int(np.argmax(problem.run == run))
        found.setdefault((int(problem.axis[first]), int(problem.sign[first])), []).append(run)
    return found


def _of_zeros(problem: Problem) -> tuple[Array, float]:
    """Return the weights of the runs' zeros in the bias and, where the faces tell them apart, in G, and the freedom.

    Every face counts alike, and its runs alike; shape (4, runs), or (1, runs) where the bias holds the mean of G f.
    """
    groups = list(_faces_of_runs(problem).values())
    first = [int(np.argmax(problem.run == runs[0])) for runs in groups]
    force = np.array(
        [STANDARD_GRAVITY * problem.sign[at] * np.eye(3)[problem.axis[at]] for at in first]
        if problem.force is None
        else [problem.force[runs].mean(axis=0) for runs in groups]
    )
    columns = np.column_stack([np.ones(len(groups)), force / STANDARD_GRAVITY])
    weights = np.zeros((4, problem.runs))
    if len(groups) < 4 or np.linalg.svd(columns, compute_uv=False)[-1] < _APART:
        axes = [int(problem.axis[at]) for at in first]
        for axis, runs in zip(axes, groups, strict=True):
            weights[0, runs] = 1 / len(set(axes)) / axes.count(axis) / len(runs)
        return weights[:1], len(groups) - 1
    inverse = np.linalg.pinv(columns)
    inverse[1:] /= STANDARD_GRAVITY
    for k, runs in enumerate(groups):
        weights[:, runs] = inverse[:, [k]] / len(runs)
    return weights, len(groups) - 4


def g_sensitivity(problem: Problem, solution: Solution) -> Array | None:
    """Return S G of each gyroscope, output per m/s^2, shape (g, 3); None where the faces do not tell it from b."""
    weights, _ = _of_zeros(problem)
    if len(weights) < 4:
        return None
    return np.array([weights[1:] @ found[len(found) - problem.runs :] for found in solution.coefficients])


def _between_faces(problem: Problem, solution: Solution, axis: int) -> tuple[Array, float]:
    """Return what faces scatter beyond noise adds to the variances of b and G of a gyroscope, and its freedom.

    (rad/s)^2 .., shape (k,): the expected share of the noise is taken off, so that it does not count twice.
    """
    i = problem.gyros.index(axis)
    found, first = solution.coefficients[i], sum(map(len, solution.coefficients[:i]))
    scale, at = float(found[problem.faces.index(axis)]), len(found) - problem.runs
    zeros = found[at:] / scale
    noise = solution.covariance[first + at : first + len(found), first + at : first + len(found)] / scale**2
    weights, freedom = _of_zeros(problem)
    groups = list(_faces_of_runs(problem).values())
    if freedom < 1:
        return np.zeros(len(weights)), 0
    mean = np.zeros((len(groups), problem.runs))
    for row, runs in zip(mean, groups, strict=True):
        row[runs] = 1 / len(runs)
    share = np.array([weights[:, runs].sum(axis=1) for runs in groups])
    # the columns whose pseudoinverse the weights are: one, and the force where there are four
    columns = np.linalg.pinv(share.T) if len(weights) > 1 else np.ones((len(groups), 1))
    rest = (np.eye(len(groups)) - columns @ np.linalg.pinv(columns)) @ mean
    beyond = max(float(np.sum((rest @ zeros) ** 2) - np.trace(rest @ noise @ rest.T)), 0.0) / freedom
    return np.asarray(np.sum(share**2, axis=0) * beyond), freedom

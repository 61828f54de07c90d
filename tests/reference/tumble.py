r"""The equations of the accelerometer tumble calibration, written out plainly.

This is the yardstick for the package's own tumble code, so it shares nothing with it: no import, no
vectorised solver, no analytic derivative.  Clarity comes before speed.

Model, for the axes i = x, y, z and the order e >= 1::

    s   = T f,    T = [[1, 0, 0], [m_yx, 1, 0], [m_zx, m_zy, 1]]
    A_i = s_i + k2_i s_i^2 + ... + ke_i s_i^e
    M_i = S_i (A_i + b_i)

with f the specific force [m/s^2], M what the unit puts out, S the scale factor [output/(m/s^2)], b the bias
[m/s^2], m the misalignment [rad] and kj the nonlinearity [1/(m/s^2)^(j-1)].  The x input axis is the body x
axis and the y input axis lies in the body xy plane.  A parameter set is a dict from name to value, in SI.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq, least_squares

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Parameters = dict[str, float]

AXES = ("x", "y", "z")
STANDARD_GRAVITY = 9.80665  # m/s^2 in one g
ARCSECOND = math.pi / (180.0 * 3600.0)  # rad

# One standard deviation of a MEMS-size error, in units of g, rad and 1/g^(j-1).
MEMS_SCALE_FACTOR = 0.03
MEMS_BIAS = 50e-3
MEMS_MISALIGNMENT = math.radians(2.0)
MEMS_NONLINEARITY = {2: 5e-3, 3: 2e-3, 4: 1e-3, 5: 0.5e-3}


# ---------------------------------------------------------------------------------------------------------
# The model
# ---------------------------------------------------------------------------------------------------------


def names(order: int) -> list[str]:
    """Return the names of the 3 (order + 2) parameters, in the order of every vector and matrix here."""
    result = [f"bias_{axis}" for axis in AXES]
    result += [f"scale_factor_{axis}" for axis in AXES]
    result += ["misalignment_yx", "misalignment_zx", "misalignment_zy"]
    for power in range(2, order + 1):
        result += [f"k{power}_{axis}" for axis in AXES]
    return result


def polynomial(s: float, axis: str, parameters: Mapping[str, float], order: int) -> float:
    """Return A = s + k2 s^2 + ... + ke s^e of one axis."""
    total = s
    for power in range(2, order + 1):
        total += parameters[f"k{power}_{axis}"] * s**power
    return total


def forward(force: ArrayLike, truth: Mapping[str, float], order: int) -> Vector:
    """Return the three outputs M for one specific-force vector [m/s^2]."""
    fx, fy, fz = np.asarray(force, dtype=float)
    sensed = {
        "x": fx,
        "y": truth["misalignment_yx"] * fx + fy,
        "z": truth["misalignment_zx"] * fx + truth["misalignment_zy"] * fy + fz,
    }
    output = []
    for axis in AXES:
        distorted = polynomial(sensed[axis], axis, truth, order)
        output.append(truth[f"scale_factor_{axis}"] * (distorted + truth[f"bias_{axis}"]))
    return np.array(output)


def inverse(output: ArrayLike, parameters: Mapping[str, float], order: int) -> Vector:
    """Return the specific force [m/s^2] that makes one output vector.

    Each axis's polynomial is inverted inside a bracket, then T f = s is solved by forward substitution.
    """
    sensed = {}
    for axis, reading in zip(AXES, np.asarray(output, dtype=float), strict=True):
        distorted = reading / parameters[f"scale_factor_{axis}"] - parameters[f"bias_{axis}"]
        sensed[axis] = _invert_polynomial(float(distorted), axis, parameters, order)
    fx = sensed["x"]
    fy = sensed["y"] - parameters["misalignment_yx"] * fx
    fz = sensed["z"] - parameters["misalignment_zx"] * fx - parameters["misalignment_zy"] * fy
    return np.array([fx, fy, fz])


def _invert_polynomial(distorted: float, axis: str, parameters: Mapping[str, float], order: int) -> float:
    """Return the s with A(s) = `distorted`, looked for near s = `distorted` because A(s) is nearly s.

    The bracket starts at twice the size of the nonlinear terms; each end moves out until A passes the target.
    """
    if order == 1:
        return distorted

    def excess(s: float) -> float:
        return polynomial(s, axis, parameters, order) - distorted

    width = 1e-9 * max(1.0, abs(distorted))
    for power in range(2, order + 1):
        width += 2.0 * abs(parameters[f"k{power}_{axis}"] * distorted**power)
    low, high = distorted - width, distorted + width
    for _ in range(40):
        if excess(low) <= 0.0 <= excess(high):
            return float(brentq(excess, low, high, xtol=1e-15, rtol=4.0 * np.finfo(float).eps))
        width *= 2.0
        if excess(low) > 0.0:
            low = distorted - width
        if excess(high) < 0.0:
            high = distorted + width
    raise ValueError(f"axis {axis}: no specific force gives the distorted value {distorted!r} m/s^2")


# ---------------------------------------------------------------------------------------------------------
# Random units and attitudes
# ---------------------------------------------------------------------------------------------------------


def random_truth(rng: np.random.Generator, order: int, scale: float = 1.0) -> Parameters:
    """Return a random unit of MEMS size, every error normal and clipped at two standard deviations.

    `scale` is the nominal scale factor [output/(m/s^2)] about which the 3 % of scale-factor error lie.
    """

    def draw(sigma: float) -> float:
        return sigma * float(np.clip(rng.standard_normal(), -2.0, 2.0))

    truth = {}
    for axis in AXES:
        truth[f"bias_{axis}"] = draw(MEMS_BIAS) * STANDARD_GRAVITY
    for axis in AXES:
        truth[f"scale_factor_{axis}"] = scale * (1.0 + draw(MEMS_SCALE_FACTOR))
    for pair in ("yx", "zx", "zy"):
        truth[f"misalignment_{pair}"] = draw(MEMS_MISALIGNMENT)
    for power in range(2, order + 1):
        for axis in AXES:
            truth[f"k{power}_{axis}"] = draw(MEMS_NONLINEARITY[power]) / STANDARD_GRAVITY ** (power - 1)
    return truth


def random_attitudes(rng: np.random.Generator, count: int) -> Matrix:
    """Return `count` unit vectors, uniform on the sphere: normal vectors divided by their length."""
    vectors = rng.standard_normal((count, 3))
    lengths = np.sqrt(np.sum(vectors**2, axis=1))
    return np.array([vector / length for vector, length in zip(vectors, lengths, strict=True)])


# ---------------------------------------------------------------------------------------------------------
# The norm of gravity: residual and Cramer-Rao bound
# ---------------------------------------------------------------------------------------------------------


def residual(outputs: ArrayLike, parameters: Mapping[str, float], order: int, gravity: float) -> Vector:
    """Return |f(M)| - g [m/s^2] of every attitude."""
    rows = np.asarray(outputs, dtype=float)
    return np.array([_length(row, parameters, order) - gravity for row in rows])


def _length(output: Vector, parameters: Mapping[str, float], order: int) -> float:
    """Return h = |f(M)| of one output vector."""
    return float(np.linalg.norm(inverse(output, parameters, order)))


def _units(order: int, scale: ArrayLike, gravity: float) -> Vector:
    """Return the size of each parameter that makes its effect on |f| of the order of g.

    Bias: g.  Scale factor: the nominal one of that axis, `scale`.  Misalignment: 1.  kj: 1/g^(j-1).
    """
    units = [gravity] * 3 + [float(s) for s in np.broadcast_to(np.asarray(scale, dtype=float), 3)] + [1.0] * 3
    for power in range(2, order + 1):
        units += [gravity ** (1 - power)] * 3
    return np.array(units)


def bound(
    directions: ArrayLike, truth: Mapping[str, float], order: int, gravity: float, sigma_output: ArrayLike
) -> Matrix:
    r"""Return the Cramer-Rao covariance of the parameters, in the order of `names`.

    Observed are, in attitude p, three outputs M = F(u, theta) + noise with the known covariance C_M =
    diag(sigma^2); unknown are the parameters theta and the direction u of gravity, two angles phi.  With
    A = dF/dtheta (3 by p) and B = dF/dphi (3 by 2), Fisher's information about (theta, phi) is
    [A B]' C_M^-1 [A B], and no other attitude knows of these phi.  Eliminating them (Schur complement) leaves

        I_p = A' [C_M^-1 - C_M^-1 B (B' C_M^-1 B)^-1 B' C_M^-1] A = A' [n n' / (n' C_M n)] A,

    where n is the one direction with n'B = 0: the bracket annihilates B and maps C_M n to n, which fixes it.
    The constraint names n.  Let h(M, theta) = |f(M)|, so that h(F(u, theta), theta) = g for every theta and
    phi; differentiating, (dh/dM) B = 0 and (dh/dM) A = -dh/dtheta =: -J_h.  Hence n' = dh/dM = u' df/dM and

        I_p = J_h' J_h / (n' C_M n) = J_h' J_h / (u' C_f u),    C_f = (df/dM) C_M (df/dM)'.

    The information of all attitudes adds up, and the bound is its inverse.  J_h and n are central differences
    of `inverse`, with a step of the cube root of the rounding unit times the size of each variable.
    """
    rows = np.asarray(directions, dtype=float)
    sigmas = np.asarray(sigma_output, dtype=float)
    scale = np.array([truth[f"scale_factor_{axis}"] for axis in AXES])
    units = _units(order, scale, gravity)
    step = np.finfo(float).eps ** (1.0 / 3.0)

    information = np.zeros((len(units), len(units)))  # of the parameters divided by their units
    for direction, sigma in zip(rows, sigmas, strict=True):
        output = forward(gravity * direction, truth, order)

        slope_theta = np.zeros(len(units))
        for j, name in enumerate(names(order)):
            above, below = dict(truth), dict(truth)
            above[name] += step * units[j]
            below[name] -= step * units[j]
            slope_theta[j] = (_length(output, above, order) - _length(output, below, order)) / (2.0 * step)

        variance = 0.0  # n' C_M n = u' C_f u
        for i in range(3):
            above_m, below_m = output.copy(), output.copy()
            above_m[i] += step * scale[i] * gravity
            below_m[i] -= step * scale[i] * gravity
            change = _length(above_m, truth, order) - _length(below_m, truth, order)
            variance += (change / (above_m[i] - below_m[i]) * sigma[i]) ** 2

        information += np.outer(slope_theta, slope_theta) / variance

    return np.diag(units) @ np.linalg.inv(information) @ np.diag(units)


# ---------------------------------------------------------------------------------------------------------
# Estimators
# ---------------------------------------------------------------------------------------------------------


def _half_span(outputs: Matrix) -> tuple[Vector, Vector]:
    """Return half the span and the middle of the span of each axis: +1 g and -1 g lie at its ends."""
    top, bottom = outputs.max(axis=0), outputs.min(axis=0)
    return (top - bottom) / 2.0, (top + bottom) / 2.0


def reference_fit(
    outputs: ArrayLike,
    order: int,
    gravity: float,
    start: Mapping[str, float] | None = None,
    weights: ArrayLike | None = None,
) -> Parameters:
    """Minimise sum w (|f(M)| - g)^2 over the parameters with a general-purpose solver.

    The start is half the span of each axis over g as scale factor, the mid span as bias, and no other error.
    """
    rows = np.asarray(outputs, dtype=float)
    root_weight = np.ones(len(rows)) if weights is None else np.sqrt(np.asarray(weights, dtype=float))
    keys = names(order)

    half, middle = _half_span(rows)
    first = dict.fromkeys(keys, 0.0)
    for i, axis in enumerate(AXES):
        first[f"scale_factor_{axis}"] = half[i] / gravity
        first[f"bias_{axis}"] = middle[i] / (half[i] / gravity)
    if start is not None:
        first.update({key: start[key] for key in keys if key in start})

    units = _units(order, [first[f"scale_factor_{axis}"] for axis in AXES], gravity)

    def parameters(scaled: Vector) -> Parameters:
        return {key: float(value) for key, value in zip(keys, scaled * units, strict=True)}

    def weighted_residual(scaled: Vector) -> Vector:
        return root_weight * residual(rows, parameters(scaled), order, gravity)

    begin = np.array([first[key] for key in keys]) / units
    solution = _solve(weighted_residual, begin)
    return parameters(solution)


def _solve(function: Any, begin: Vector) -> Vector:
    """Return the least-squares minimum of `function`, whose variables are of order one.

    Levenberg-Marquardt, its Jacobian by 3-point differences, started again where it stopped.  It stops when
    the sum of squares no longer changes; one whole Gauss-Newton step more then sharpens the variables.
    """
    point = begin
    for _ in range(2):
        result = least_squares(
            function, point, jac="3-point", method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=20_000
        )
        point = result.x
    if not result.success:
        raise RuntimeError(f"the reference fit did not converge: {result.message}")
    step, *_ = np.linalg.lstsq(result.jac, -result.fun, rcond=1e-8)
    return np.asarray(point + step)


def linearised(outputs: ArrayLike, order: int, gravity: float, start: Mapping[str, float] | None = None) -> Parameters:
    """Return the parameters by the source's own estimator; see `linearised_passes`."""
    return linearised_passes(outputs, order, gravity, start)[0]


def linearised_passes(
    outputs: ArrayLike,
    order: int,
    gravity: float,
    start: Mapping[str, float] | None = None,
    threshold: tuple[float, float, float] = (5e-6, 2e-6, 3.0 * ARCSECOND),
) -> tuple[Parameters, int]:
    r"""Return the parameters by the source's own estimator, and the number of passes it took.

    In units of g, with a = M/S - b the corrected reading (its nonlinearity taken as zero) and B = T^-1 a,
    each attitude gives one linear equation

        sum_i sum_{j=0..e} d_ji a_i^(j+1) + m_yx a_x a_y + m_zx a_z a_x + m_zy a_y a_z = (|B|^2 - 1) / 2.

    A pass solves them by least squares and updates S_i *= 1 + d_1i, b_i += d_0i and the misalignment by m,
    until every change is below the threshold (of d_1, d_0 and m).  The nonlinearity is d_2 ... d_e of the last pass.
    Start: half the span of each axis over g as scale factor, bias and misalignment zero, or those in `start`.
    """
    rows = np.asarray(outputs, dtype=float)
    half, _ = _half_span(rows)
    given = {} if start is None else start
    scale = np.array([given.get(f"scale_factor_{axis}", half[i] / gravity) for i, axis in enumerate(AXES)])
    bias = np.array([given.get(f"bias_{axis}", 0.0) / gravity for axis in AXES])  # in g
    yx, zx, zy = (given.get(f"misalignment_{pair}", 0.0) for pair in ("yx", "zx", "zy"))

    passes, settled = 0, False
    while not settled:
        if passes == 50:
            raise RuntimeError("the linearised estimator did not settle within 50 passes")
        passes += 1

        equations, right = [], []
        for row in rows:
            a = row / (scale * gravity) - bias
            bx = a[0]
            by = a[1] - yx * bx
            bz = a[2] - zx * bx - zy * by
            bias_terms = [a[i] for i in range(3)]
            scale_terms = [a[i] ** 2 for i in range(3)]
            misalignment_terms = [a[0] * a[1], a[2] * a[0], a[1] * a[2]]
            nonlinear_terms = [a[i] ** (j + 1) for j in range(2, order + 1) for i in range(3)]
            equations.append(bias_terms + scale_terms + misalignment_terms + nonlinear_terms)
            right.append((bx**2 + by**2 + bz**2 - 1.0) / 2.0)
        unknowns, *_ = np.linalg.lstsq(np.array(equations), np.array(right), rcond=None)
        d0, d1, m = unknowns[0:3], unknowns[3:6], unknowns[6:9]

        bias = bias + d0
        scale = scale * (1.0 + d1)
        yx, zx, zy = yx + m[0], zx + m[1], zy + m[2]

        changes = zip((d1, d0, m), threshold, strict=True)
        settled = all(bool(np.all(np.abs(change) < limit)) for change, limit in changes)

    values = [*(bias * gravity), *scale, yx, zx, zy]
    for j in range(2, order + 1):
        values += [d / gravity ** (j - 1) for d in unknowns[3 * (j + 1) : 3 * (j + 2)]]
    return {name: float(value) for name, value in zip(names(order), values, strict=True)}, passes


# ---------------------------------------------------------------------------------------------------------
# The upper-triangular gauge of other toolkits
# ---------------------------------------------------------------------------------------------------------


def upper_triangular_fit(outputs: ArrayLike, gravity: float) -> dict[str, float]:
    """Fit a = T K (x - b), T = [[1, -yz, zy], [0, 1, -zx], [0, 0, 1]], K diagonal, to |a| = g.

    Returned are 1/K as inverse_k_x.. [output/(m/s^2)], b as zero_x.. [output], and yz, zy, zx [rad].
    """
    rows = np.asarray(outputs, dtype=float)
    half, middle = _half_span(rows)
    keys = [*(f"inverse_k_{axis}" for axis in AXES), *(f"zero_{axis}" for axis in AXES), "yz", "zy", "zx"]

    # Variables of order one: 1/K over its start, the zero's shift from mid span over half the span, angles.
    def numbers(scaled: Vector) -> dict[str, float]:
        values = [*(scaled[0:3] * half / gravity), *(middle + scaled[3:6] * half), *scaled[6:9]]
        return {key: float(value) for key, value in zip(keys, values, strict=True)}

    def misfit(scaled: Vector) -> Vector:
        nine = numbers(scaled)
        lengths = []
        for row in rows:
            x, y, z = ((row[i] - nine[f"zero_{axis}"]) / nine[f"inverse_k_{axis}"] for i, axis in enumerate(AXES))
            ax = x - nine["yz"] * y + nine["zy"] * z
            ay = y - nine["zx"] * z
            az = z
            lengths.append(math.sqrt(ax**2 + ay**2 + az**2))
        return np.array(lengths) - gravity

    return numbers(_solve(misfit, np.array([1.0] * 3 + [0.0] * 6)))


def to_lower_gauge(upper: Mapping[str, float]) -> Parameters:
    r"""Convert the nine numbers of `upper_triangular_fit` to the order-1 parameters of this module.

    The upper model reads x - b = W a with W = K^-1 T_u^-1; ours reads x - b = L f with L = S T, lower
    triangular.  Both a and f have the length g and describe the same outputs, so they differ by a rotation,
    f = R a, and W = L R.  (That is the QR, or rather LQ, decomposition of W.)  R drops out of
    W W' = L R R' L' = L L', so L is the Cholesky factor of W W'.  T has a unit diagonal: S = diag(L) and
    T = S^-1 L.  The zero b, in output units, does not see the rotation; in ours it is S times the bias.
    """
    w = _w(upper)
    lower = np.linalg.cholesky(w @ w.T)
    scale = np.diag(lower)
    t_lower = np.diag(1.0 / scale) @ lower
    result = {}
    for i, axis in enumerate(AXES):
        result[f"bias_{axis}"] = float(upper[f"zero_{axis}"] / scale[i])
    for i, axis in enumerate(AXES):
        result[f"scale_factor_{axis}"] = float(scale[i])
    result["misalignment_yx"] = float(t_lower[1, 0])
    result["misalignment_zx"] = float(t_lower[2, 0])
    result["misalignment_zy"] = float(t_lower[2, 1])
    return result


def gyro_inverse_k(accelerometers: Mapping[str, float], s: ArrayLike, t: ArrayLike) -> Vector:
    r"""Return 1/K [output/(rad/s)] of w = T K (M - b) in the upper gauge from M = S (T w + b) in the lower one.

    f = R a between the frames of `to_lower_gauge`, with R = L^-1 W.  The body rate turns with it, so M = S T R w + ..,
    and T K = (S T R)^-1 with T's diagonal 1.
    """
    lower = to_lower_gauge(accelerometers)
    t_lower = np.eye(3)
    t_lower[1, 0], t_lower[2, 0], t_lower[2, 1] = (lower[f"misalignment_{pair}"] for pair in ("yx", "zx", "zy"))
    rotation = np.linalg.inv(np.diag([lower[f"scale_factor_{axis}"] for axis in AXES]) @ t_lower) @ _w(accelerometers)
    return 1.0 / np.diag(np.linalg.inv(np.diag(np.asarray(s)) @ np.asarray(t) @ rotation))


def _w(upper: Mapping[str, float]) -> Matrix:
    t_upper = np.array([[1.0, -upper["yz"], upper["zy"]], [0.0, 1.0, -upper["zx"]], [0.0, 0.0, 1.0]])
    return np.diag([upper[f"inverse_k_{axis}"] for axis in AXES]) @ np.linalg.inv(t_upper)


def directions(upper: Mapping[str, float], outputs: ArrayLike) -> Matrix:
    """Return the unit vectors of a = T K (x - b) of rows of outputs."""
    zero = np.array([upper[f"zero_{axis}"] for axis in AXES])
    found = (np.asarray(outputs) - zero) @ np.linalg.inv(_w(upper)).T
    return found / np.linalg.norm(found, axis=1)[:, None]


def gyro_turns_fit(
    time: ArrayLike,
    outputs: ArrayLike,
    turns: Sequence[tuple[int, int]],
    up: ArrayLike,
    zero: ArrayLike,
    fit_bias: bool,
) -> tuple[Vector, float]:
    r"""Fit w = T K (M - b) to the turns of gravity's direction; no sensitivity to acceleration.

    Tedaldi, Pretto, Menegatti (2014), eq. (11) to (13): minimise the sum of |u_after - C u_before|^2 over the turns,
    C composed of Rodrigues rotations about the mean of two neighbouring samples.  Returned are 1/K and *half* the sum,
    which is what Ceres and scipy call the cost.
    """
    t, m, u, b = np.asarray(time), np.asarray(outputs), np.asarray(up), np.asarray(zero)
    longest = max(stop - start for start, stop in turns)
    mean, step = np.zeros((longest, len(turns), 3)), np.zeros((longest, len(turns)))
    for k, (start, stop) in enumerate(turns):
        mean[: stop - start, k] = (m[start:stop] + m[start + 1 : stop + 1]) / 2 - b
        step[: stop - start, k] = np.diff(t[start : stop + 1])
    typical = 4800.0

    def misfit(p: Vector) -> Vector:
        tk = np.array([[1, p[3], p[4]], [p[5], 1, p[6]], [p[7], p[8], 1]]) @ np.diag((1 + p[:3]) / typical)
        shift = p[9:12] * typical if fit_bias else np.zeros(3)
        angles = (mean - shift) @ tk.T * step[:, :, None]
        moved = u[:-1].copy()
        for angle in angles:  # the body turns by +angle, so what is fixed in space turns by -angle in the body
            size = np.linalg.norm(angle, axis=1)[:, None]
            axis = angle / np.maximum(size, 1e-300)
            along = np.sum(axis * moved, axis=1)[:, None] * axis
            moved = along + np.cos(size) * (moved - along) - np.sin(size) * np.cross(axis, moved)
        return np.asarray((moved - u[1:]).ravel())

    solution = least_squares(misfit, np.zeros(12 if fit_bias else 9), xtol=1e-10)
    return typical / (1 + solution.x[:3]), float(np.sum(solution.fun**2) / 2)


# ---------------------------------------------------------------------------------------------------------
# Means of samples that are not white
# ---------------------------------------------------------------------------------------------------------


def batch_covariance_of_mean(samples: ArrayLike, batch: int) -> Matrix:
    r"""Return the covariance of the mean by non-overlapping batch means.

    With the m = n // batch batch means Y_j and their mean Y: sum_j (Y_j - Y)(Y_j - Y)' / (m (m - 1)).
    Samples left over after the last whole batch are not used.
    """
    rows = np.asarray(samples, dtype=float)
    count = len(rows) // batch
    if count < 2:
        raise ValueError(f"{len(rows)} samples do not make two batches of {batch}")
    means = np.array([rows[j * batch : (j + 1) * batch].mean(axis=0) for j in range(count)])
    grand_mean = means.mean(axis=0)
    total = np.zeros((3, 3))
    for mean in means:
        total += np.outer(mean - grand_mean, mean - grand_mean)
    return total / (count * (count - 1))

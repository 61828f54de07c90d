"""Error model of an accelerometer triad, inverted: outputs to specific force.

    s = T f,  T = [[1, 0, 0], [m_yx, 1, 0], [m_zx, m_zy, 1]]
    A_i = s_i + k2_i s_i^2 + ... + ke_i s_i^e
    M_i = S_i (A_i + b_i)

With cross terms A_x has k_xy s_x s_y more, A_y k_yz s_y s_z, A_z k_zx s_z s_x: with bias (3) and k2 (3) they leave of
the ten functions of third degree that |f| can show only xyz. Products of other pairs (k_xz in A_x ...) differ from
these, in |f|, by biases and k2 alone.

The gauge: the x input axis is the body x axis, the y input axis lies in the body xy plane (IEEE Std 1293 calls the
off-diagonals input-axis misalignments). Gravity's magnitude cannot see a rotation of the whole triad.
"""

from __future__ import annotations

import numpy as np
from msgspec import Struct

import imulab.procedures.tumble._model as _model
from imulab.estimation.least_squares import Fit, least_squares
from imulab.estimation.rows import medians
from imulab.procedures.tumble.attitudes import POOL_DEGREES, Motion
from imulab.recording import Array
from imulab.records.triads import CROSS_TERMS

AXES = ("x", "y", "z")
MISALIGNMENTS = ("yx", "zx", "zy")
GROUPS = {"bias": slice(0, 3), "scale_factor": slice(3, 6), "misalignment": slice(6, 9)}
"""What ages, and where it stands among the parameters."""
_UNUSUAL = 3.0  # times the median of own over expected noise: such a hold says nothing of the others
_NEXT = [1, 2, 0]  # axis after x, y, z
_CROSS_PASSES = 30  # at most; the error shrinks by 2 |k s| in each
GAUGE = "x input axis along body x, y input axis in the body xy plane"


def parameter_count(order: int, cross: bool = False) -> int:
    """Return the number of parameters, 3 (order + 2), with cross terms three more; order 0 has no misalignment."""
    return 3 * (order + 2 + cross)


def parameter_names(order: int, cross: bool = False) -> list[str]:
    """Return the names of the parameters in the order of the parameter vector."""
    return [
        *(f"bias_{axis}" for axis in AXES),
        *(f"scale_factor_{axis}" for axis in AXES),
        *(f"misalignment_{pair}" for pair in MISALIGNMENTS if order > 0),
        *(f"k{power}_{axis}" for power in range(2, order + 1) for axis in AXES),
        *(CROSS_TERMS if cross else ()),
    ]


def parameter_units(order: int, output: str, cross: bool = False) -> list[str]:
    """Return the units of the parameters in a record, in the same order."""
    nonlinearity = ["1/(m/s^2)" if j == 1 else f"1/(m/s^2)^{j}" for j in range(1, order)]
    return (
        ["m/s^2"] * 3
        + [f"{output}/(m/s^2)"] * 3
        + ["rad"] * 3 * (order > 0)
        + [
            *(unit for unit in nonlinearity for _ in AXES),
            *(["1/(m/s^2)"] * 3 if cross else []),
        ]
    )


def gravity_slope(values: Array, order: int) -> Array:
    """Return the derivatives of the parameters, in SI, by the logarithm of gravity, shapes (p,).

    Outputs say how large the parameters are in units of gravity: ``dS/S = -dg/g``, ``db/b = dg/g``,
    ``dk_j/k_j = -(j - 1) dg/g``, and misalignment stays.
    """
    slope = np.zeros_like(values)
    slope[:3], slope[3:6] = values[:3], -values[3:6]
    slope[9:] = -powers_of_gravity(order, len(values)) * values[9:]
    return slope


def powers_of_gravity(order: int, size: int) -> Array:
    """Return the power of an inverse acceleration that each parameter after the ninth is, shape (size - 9,)."""
    powers: Array = np.concatenate([np.repeat(np.arange(1.0, order), 3), np.ones(size - parameter_count(order))])
    return powers


class Inversion(Struct, frozen=True):
    """Specific force of a batch of outputs, shape (..., 3); NaN where no specific force gives this output."""

    force: Array


def invert(reading: Array, misalignment: Array, nonlinearity: Array) -> Inversion:
    """Invert the model from ``A = M / S - b`` to the specific force.

    Newton's method on each axis's polynomial, then forward substitution; NaN passes into the components it touches.

    Parameters
    ----------
    reading
        A, shape (..., 3).
    misalignment
        m_yx, m_zx, m_zy, shape (..., 3).
    nonlinearity
        k2 ... ke, shape (..., e - 1, 3), in the inverse powers of the unit of `reading`.
    """
    order = nonlinearity.shape[-2] + 1
    powers = nonlinearity.reshape(*nonlinearity.shape[:-2], 3 * (order - 1))
    shape = np.broadcast_shapes(reading.shape[:-1], misalignment.shape[:-1], powers.shape[:-1])
    theta = np.zeros((*shape, parameter_count(order)))
    theta[..., 3:6], theta[..., 6:9], theta[..., 9:] = 1.0, misalignment, powers
    each = np.broadcast_to(reading, (*shape, 3)).reshape(-1, 1, 3)
    return Inversion(norm_and_jacobian(theta.reshape(len(each), -1), each, order)[2].reshape(*shape, 3))


def norm_and_jacobian(theta: Array, reading: Array, order: int) -> tuple[Array, Array, Array, Array]:
    """Return |f| and its derivatives for a batch of parameter vectors.

    With ``T' v = f / |f|`` it is ``d|f| = v . (ds - dT f)``, and ``ds = (dA - sum dk_j s^j) / A'(s)``. The loop over
    problems and attitudes is in C (`_model`).

    Parameters
    ----------
    theta
        Scaled parameters, shape (b, p): zero (in the unit of `reading`), relative scale factor, misalignment,
        nonlinearity, and cross terms where there are three more.
    reading
        Outputs, shape (b, n, 3), or (1, n, 3) for all problems alike, already divided by a nominal scale factor.
    order
        Order e of the model.

    Returns
    -------
    tuple
        |f| (b, n); its derivatives with respect to theta (b, n, p); f (b, n, 3); ``q = d|f|/d reading`` (b, n, 3).
    """
    if theta.shape[1] > parameter_count(order):
        return _crossed(theta, reading, order)
    problems, n = len(theta), reading.shape[1]
    norm, force = np.empty((problems, n)), np.empty((problems, n, 3))
    jacobian = np.empty((problems, n, theta.shape[1]))
    _model.lengths(
        np.ascontiguousarray(theta, dtype=np.float64), np.ascontiguousarray(reading, dtype=np.float64), order,
        norm, jacobian, force,
    )  # fmt: skip
    return norm, jacobian, force, -jacobian[:, :, 0:3]


def _crossed(theta: Array, reading: Array, order: int) -> tuple[Array, Array, Array, Array]:
    """`norm_and_jacobian` with cross terms: their products, from the last solution, are taken off until they rest.

    An error shrinks by about 2 |k s| a pass. The derivatives leave out how one axis's term moves the others' products,
    which is smaller by the same factor.
    """
    plain, k = np.ascontiguousarray(theta[:, :-3]), theta[:, None, -3:]
    scale, m = theta[:, None, 3:6], theta[:, None, 6:9]
    products = np.zeros((len(theta), reading.shape[1], 3))
    for _ in range(_CROSS_PASSES):
        norm, jacobian, force, slope = norm_and_jacobian(plain, reading - scale * k * products, order)
        s = force.copy()
        s[..., 1] += m[..., 0] * force[..., 0]
        s[..., 2] += m[..., 1] * force[..., 0] + m[..., 2] * force[..., 1]
        before, products = products, s * s[..., _NEXT]
        if not np.any(np.abs(products - before) > 1e-14):
            break
    jacobian[:, :, 3:6] += jacobian[:, :, 0:3] * k * products
    return norm, np.concatenate([jacobian, jacobian[:, :, 0:3] * scale * products], axis=2), force, slope


def length_noise(theta: Array, jacobian: Array, covariance: Array, motion: Motion | None = None) -> tuple[Array, Array]:
    """Return the lengthening ``(tr C_f - u' C_f u) / 2`` of |f| by noise, and its variance ``q' C q``, shapes (b, n).

    ``q = d|f|/d reading`` is the negative of the Jacobian's columns for the zero; |f| is 1 to first order. Where the
    attitudes are known to move while they are held, the lengthening is that of the noise less the shortening by the
    motion, and the variance is that of the mean of the magnitudes ``|f(x_k)|`` of the blocks of a hold, by batch means

        u^2 = (nu v + 10 m e) / (nu + 10),   m = sum nu v / sum nu e

    with v the attitude's own variance, of nu degrees of freedom, and e what the noise of its axes lets expect.

    Parameters
    ----------
    theta, jacobian
        As for, and from, `norm_and_jacobian`.
    covariance
        C, of the outputs, shape (b, n, 3, 3), or (1, n, 3, 3) for all problems alike.
    motion
        Of n attitudes, the same for all problems; `covariance` is not used then.
    """
    if motion is None:
        return _lengthening(theta, jacobian, covariance)
    lengthening = _lengthening(theta, jacobian, motion.lengthening)[0]
    expected = _lengthening(theta, jacobian, motion.usual)[1]
    attitude_variance = np.empty(jacobian.shape[:2])
    _model.noise(
        np.ascontiguousarray(theta), np.ascontiguousarray(jacobian), motion.moments, np.empty(0), attitude_variance
    )
    # An attitude that was knocked, or moved in other ways, says nothing of the others' noise.
    ratio = attitude_variance / expected
    counts = motion.freedom * (ratio <= _UNUSUAL * medians(ratio)[:, None])
    level = (counts * attitude_variance).sum(axis=1) / np.maximum((counts * expected).sum(axis=1), np.finfo(float).tiny)
    usual = level[:, None] * expected
    return lengthening, (motion.freedom * attitude_variance + POOL_DEGREES * usual) / (motion.freedom + POOL_DEGREES)


def _lengthening(theta: Array, jacobian: Array, covariance: Array) -> tuple[Array, Array]:
    """Lengthening and variance of |f| by a covariance of the outputs, shapes (b, n)."""
    lengthening, variance = np.empty(jacobian.shape[:2]), np.empty(jacobian.shape[:2])
    _model.noise(
        np.ascontiguousarray(theta), np.ascontiguousarray(jacobian), np.ascontiguousarray(covariance),
        lengthening, variance,
    )  # fmt: skip
    return lengthening, variance


def fit_lengths(
    start: Array, reading: Array, weights: Array, lengthening: Array, order: int, *, tolerance: float, most: int
) -> Fit:
    """Minimise ``sum w (|f| - 1 - lengthening)^2`` of each problem by Levenberg-Marquardt steps in C.

    With cross terms there is one problem, which scipy solves.

    Parameters
    ----------
    start, reading, order
        As for `norm_and_jacobian`.
    weights, lengthening
        Shape (b, n).
    tolerance, most
        Largest step that counts as converged, and how many steps are tried.
    """
    if start.shape[1] > parameter_count(order):

        def model(theta: Array) -> tuple[Array, Array]:
            norm, jacobian = norm_and_jacobian(theta[None], reading, order)[:2]
            return norm[0] - 1 - lengthening[0], jacobian[0]

        return least_squares(model, start[0], weights[0], tolerance=tolerance, max_evaluations=most)
    count, n = weights.shape
    theta = np.array(start, dtype=np.float64)
    residuals, jacobian = np.empty((count, n)), np.empty((count, n, theta.shape[1]))
    iterations, converged = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.bool_)
    _model.fit(
        theta, np.ascontiguousarray(reading), np.ascontiguousarray(weights), np.ascontiguousarray(lengthening), order,
        tolerance, most, residuals, jacobian, iterations, converged,
    )  # fmt: skip
    return Fit(theta, residuals, jacobian, weights, iterations, converged)


def left_out_lengths(
    start: Array, reading: Array, weights: Array, lengthening: Array, order: int, *, tolerance: float, most: int
) -> Array:
    """Return ``|f| - 1 - lengthening`` of each attitude under the fit to all others, shape (n,), for a batch of one.

    Parameters
    ----------
    start, reading, weights, lengthening, order, tolerance, most
        As for `fit_lengths`, a batch of one; all n fits start alike.
    """
    errors = np.empty(weights.shape[1])
    _model.left_out(
        np.ascontiguousarray(start), np.ascontiguousarray(reading), np.ascontiguousarray(weights),
        np.ascontiguousarray(lengthening), order, tolerance, most, errors,
    )  # fmt: skip
    return errors

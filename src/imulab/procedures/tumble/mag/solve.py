"""The joint fit of accelerometers and magnetometers.

Fit (`solve`): ``min sum_p r_p' V_p^-1 r_p`` over both triads and the dip, r_p the residuals of `model` in attitude p.
The accelerometers are fitted anew, from the result of their own fit, because their errors are common to all dips.
Unknown noise is estimated by restricted maximum likelihood, where i and j run over the blocks k and l,

    sum_l S_kl (sigma_l'^2 - sigma_l^2) = q_k - tr_k P,   q_k = sum (P r)_i^2,   S_kl = sum P_ij^2

with ``P = V^-1 - V^-1 J (J' V^-1 J)^-1 J' V^-1`` and blocks |m|, dip and held directions. Intervals are those of
Student's t with ``nu = v^2 / (a' K a)``: v the variance of a parameter, ``a_k = dv/dsigma_k^2``, K half the covariance
of sigma_k^2.

Start (`find_start`): the magnitude gives hard iron h and ``U'U``, linear in the ten coefficients of an ellipsoid. With
``u = U (M - h)`` and the direction e of gravity the constant dip is ``e' R u + sin(dip) = 0``, linear in the ten
numbers R, sin(dip): these are the least singular vector of the rows ``[e_i u_j, 1]``.

Held directions (`add_held_directions`): the rows of C are east, north and up in body components, ``up = e``,
``east = u x e / |u x e|``, ``north = up x east``. A body axis x with the same direction d in several attitudes adds the
two components of ``C x - d`` across d.

Sources: Patterson and Thompson, Biometrika 58 (1971) 545 (REML); Satterthwaite, Biometrics Bulletin 2 (1946) 110;
Papafotis and Sotiriadis, IEEE Sensors J. 19 (2019) 8241 (ellipsoid, then alignment).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations, product
from numbers import Real

import numpy as np
from numpy.typing import NDArray

from imulab.errors import OptionError, meant, quoted
from imulab.estimation.decisions import FIELD_SCATTERS, HEMISPHERE_OF_DIP
from imulab.estimation.least_squares import chi_square_probability
from imulab.gravity import Gravity
from imulab.procedures import tumble
from imulab.procedures.tumble import HEMISPHERES
from imulab.procedures.tumble.mag.model import (
    MAGNETOMETERS,
    FieldMeans,
    Invariants,
    ParameterLayout,
    evaluate_invariants,
)
from imulab.procedures.tumble.record import Estimate, Scaling
from imulab.quantities import in_si
from imulab.recording import Array

# Hemisphere and dip of the place, as stated.


_EQUATOR = math.radians(20.0)
"""The magnetic equator lies within 16 deg of the geographic one."""

Dip = float | str | tuple[float, float]


@dataclass(frozen=True)
class Place:
    """The hemisphere, ``north`` or ``south``, and the dip with its standard uncertainty, rad; None where unknown."""

    hemisphere: str | None = None
    dip: tuple[float, float] | None = None


def hemisphere_at(latitude: float | str | None) -> str | None:
    """Return the magnetic hemisphere at a latitude, rad or a text; None near the equator, and where none is given."""
    angle = 0.0 if latitude is None else in_si(latitude, "latitude", "angle", "deg")
    return None if abs(angle) < _EQUATOR else "north" if angle > 0 else "south"


def parse_place(hemisphere: str | None, latitude: float | str | None, dip: Dip | None) -> Place:
    """Return hemisphere and dip of a place as stated.

    Raises
    ------
    OptionError
        There is no such hemisphere or dip, or they contradict one another.
    """
    if hemisphere is not None and hemisphere not in HEMISPHERES:
        hint = meant(HEMISPHERES, hemisphere)
        raise OptionError(f"hemisphere {quoted(hemisphere)}: expected {' or '.join(HEMISPHERES)}{hint}")
    known = None if dip is None else parse_dip(dip)
    sides = {"hemisphere": hemisphere, "latitude": hemisphere_at(latitude)}
    if known is not None and abs(known[0]) > HEMISPHERE_OF_DIP.limit * known[1]:
        sides["dip"] = "north" if known[0] > 0 else "south"
    stated = {name: side for name, side in sides.items() if side is not None}
    first = next(iter(stated), "")
    for name, side in stated.items():
        if side != stated[first]:
            raise OptionError(
                f"{name} of the {side}ern hemisphere, {first} of the {stated[first]}ern: expected both of one; the dip "
                "is positive where the field points down, in the north"
            )
    return Place(stated.get(first), known)


def parse_dip(dip: Dip) -> tuple[float, float]:
    """Return a dip and its standard uncertainty, rad; that of a model of the field where none is given.

    Raises
    ------
    OptionError
        It is no dip.
    """
    if isinstance(dip, str):
        return tumble.dip(dip, "dip")
    value, uncertainty = dip if isinstance(dip, tuple) and len(dip) == 2 else (dip, tumble.OF_FIELD_MODELS)
    if not all(isinstance(part, Real) and not isinstance(part, bool) for part in (value, uncertainty)):
        raise OptionError(f"dip {quoted(dip)}: expected rad, rad with a standard uncertainty, or a text '67 deg+-0.2'")
    return tumble.check_dip(float(value), float(uncertainty), "dip")


# The start: an ellipsoid for the magnetometers, and the rotation that keeps the dip constant.


@dataclass(frozen=True)
class Start:
    """``m = W (M - h)`` in units of the field, shapes (3, 3) and (3,), and the dip, rad."""

    matrix: Array
    hard_iron: Array
    dip: float


def find_start(mag: Array, direction: Array) -> Start:
    """Return matrix, hard iron and dip to start from.

    Parameters
    ----------
    mag
        Outputs, of any scale, shape (n, 3).
    direction
        Unit vectors of the specific force in the body frame, shape (n, 3).
    """
    centre, size = mag.mean(axis=0), float(np.linalg.norm(mag.std(axis=0)))
    scaled = (mag - centre) / size
    shape = _fit_ellipsoid(scaled)
    if shape is None:
        shape = _fit_sphere(scaled)
        rotation, sine = _find_axis_permutation((scaled - shape[1]) @ shape[0].T, direction)
    else:
        rotation, sine = _find_alignment((scaled - shape[1]) @ shape[0].T, direction)
    upper, hard_iron = shape
    dip = float(np.arcsin(np.clip(sine, -0.999, 0.999)))
    return Start(rotation @ upper / size, centre + size * hard_iron, dip)


def _fit_ellipsoid(points: Array) -> tuple[Array, Array] | None:
    """Return U and h of ``|U (x - h)| = 1``, by algebraic least squares; None where the surface is no ellipsoid."""
    x, y, z = points.T
    design = np.column_stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z, 2 * x, 2 * y, 2 * z])
    if np.linalg.matrix_rank(design) < design.shape[1]:
        return None
    a = np.linalg.lstsq(design, np.ones(len(points)), rcond=None)[0]
    form = np.array([[a[0], a[3], a[4]], [a[3], a[1], a[5]], [a[4], a[5], a[2]]])
    sign = 1.0 if np.trace(form) > 0 else -1.0
    if np.linalg.eigvalsh(sign * form).min() <= 0:
        return None
    h = -np.linalg.solve(form, a[6:])
    level = 1 + h @ form @ h
    if level * sign <= 0:
        return None
    return np.linalg.cholesky(form / level).T, h


def _fit_sphere(points: Array) -> tuple[Array, Array]:
    """Return U and h of the sphere ``|x - h| = r`` through the points, by algebraic least squares."""
    design = np.column_stack([2 * points, np.ones(len(points))])
    coefficients = np.linalg.lstsq(design, (points**2).sum(axis=1), rcond=None)[0]
    radius = np.sqrt(max(coefficients[3] + coefficients[:3] @ coefficients[:3], 1e-12))
    return np.eye(3) / radius, coefficients[:3]


def _find_alignment(field: Array, direction: Array) -> tuple[Array, float]:
    """Return the rotation and the sine of the dip that make ``e' R u + sin(dip)`` least; R is right-handed."""
    rows = np.column_stack([(direction[:, :, None] * field[:, None, :]).reshape(len(field), 9), np.ones(len(field))])
    coefficients = np.linalg.svd(rows, full_matrices=False)[2][-1]
    matrix = coefficients[:9].reshape(3, 3)
    if np.linalg.det(matrix) < 0:
        matrix, coefficients = -matrix, -coefficients
    left, _, right = np.linalg.svd(matrix)
    rotation: Array = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return rotation, float(-np.mean(np.einsum("ni,ij,nj->n", direction, rotation, field)))


def _find_axis_permutation(field: Array, direction: Array) -> tuple[Array, float]:
    """Return the rotation, of the 24 that turn axes into axes, under which the dip varies least, and its sine."""
    candidates = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        rotation = np.diag(signs)[:, order]
        if np.linalg.det(rotation) > 0:
            cosine = np.einsum("ni,ij,nj->n", direction, rotation, field)
            candidates.append((float(cosine.var()), rotation, float(-cosine.mean())))
    _, rotation, sine = min(candidates, key=lambda candidate: candidate[0])
    return rotation, sine


def name_axes(matrix: Array) -> Array:
    """Return the signed permutation P, shape (3, 3), that names outputs: ``sum |(D P')_ii| / |row i|`` is largest.

    Parameters
    ----------
    matrix
        D, field in the body frame to output, shape (3, 3).
    """
    rows = matrix / np.linalg.norm(matrix, axis=1)[:, None]
    best = max(permutations(range(3)), key=lambda order: float(np.abs(rows[list(order), range(3)]).sum()))
    named: Array = np.zeros((3, 3))
    for axis, output in enumerate(best):
        named[axis, output] = np.sign(rows[output, axis])
    return named


# Attitudes in which one axis of the body points the same way, which determine heading beyond magnitude and dip.


@dataclass(frozen=True)
class HeldDirections:
    """Groups of attitudes with one common direction of a body axis, relative to the start of axis and directions.

    Attributes
    ----------
    group
        Number of the group that each attitude is in, -1 for none, shape (n,).
    axis, axis_across
        The body axis at the start, shape (3,), and two directions across it, shape (2, 3).
    across
        Two directions across the direction of each group in the world, shape (groups, 2, 3).
    """

    group: Array
    axis: Array
    axis_across: Array
    across: Array

    @property
    def size(self) -> int:
        """Number of parameters: two of the axis, two of each group."""
        return 2 + 2 * len(self.across)

    def only(self, kept: NDArray[np.intp]) -> HeldDirections:
        """Return the groups of some of the attitudes, by index."""
        return replace(self, group=self.group[kept])


def find_held_directions(field: Array, force: Array, groups: Sequence[Sequence[int]]) -> tuple[HeldDirections, Array]:
    """Return the groups, relative to the axis that keeps its directions best, and the start of their parameters.

    Parameters
    ----------
    field, force
        m and f of each attitude, shape (n, 3).
    groups
        Numbers of the attitudes of each group, from 0.
    """
    axes = world_axes(field, force)
    number = np.full(len(field), -1)
    scatter = np.zeros((3, 3))
    for index, group in enumerate(groups):
        number[list(group)] = index
        off = axes[list(group)] - axes[list(group)].mean(axis=0)
        scatter += np.einsum("nij,nik->jk", off, off)
    axis = np.linalg.eigh(scatter)[1][:, 0]
    means = [axes[list(group)].mean(axis=0) @ axis for group in groups]
    across = np.array([_perpendicular_pair(mean / np.linalg.norm(mean)) for mean in means])
    start = np.concatenate([np.zeros(2), *(b @ mean for b, mean in zip(across, means, strict=True))])
    return HeldDirections(number, axis, _perpendicular_pair(axis), across), start


def world_axes(field: Array, force: Array) -> Array:
    """Return C, rows east, north and up in body components, shape (n, 3, 3)."""
    up = force / np.linalg.norm(force, axis=1)[:, None]
    east = np.cross(field, up)
    east /= np.linalg.norm(east, axis=1)[:, None]
    return np.stack([east, np.cross(up, east), up], axis=1)


def add_held_directions(
    evaluated: Invariants, theta: Array, layout: ParameterLayout, held: HeldDirections
) -> Invariants:
    """Return the invariants with two more residuals of each attitude, ``B (C x - d)``; nil outside of the groups."""
    held_parameters = theta[layout.of_directions]
    longer = held.axis + held_parameters[:2] @ held.axis_across
    length = np.linalg.norm(longer)
    x = longer / length
    by_tilt = (held.axis_across - np.outer(held.axis_across @ x, x)) / length  # dx by its two parameters, (2, 3)
    axes = world_axes(evaluated.field.vector, evaluated.force.vector)
    turned = _direction_derivatives(evaluated, axes, x, layout)
    member = held.group >= 0
    across = np.where(member[:, None, None], held.across[held.group], 0.0)
    residuals = np.einsum("nki,nij,j->nk", across, axes, x)
    slope = np.einsum("nki,nip->nkp", across, turned)
    first = layout.of_directions.start
    slope[:, :, first : first + 2] = np.einsum("nki,nij,lj->nkl", across, axes, by_tilt)
    for index in range(len(held.across)):
        inside = held.group == index
        at = first + 2 + 2 * index
        residuals[inside] -= held_parameters[2 + 2 * index : 4 + 2 * index]
        slope[inside, :, at : at + 2] = -np.eye(2)
    return replace(
        evaluated,
        residuals=np.hstack([evaluated.residuals, residuals]),
        by_parameters=np.concatenate([evaluated.by_parameters, slope], axis=1),
    )


def _direction_derivatives(evaluated: Invariants, axes: Array, x: Array, layout: ParameterLayout) -> Array:
    """Return the derivatives of ``C x`` by the triads' parameters, shape (n, 3, p)."""
    n = len(axes)
    du, de = np.zeros((n, 3, layout.size)), np.zeros((n, 3, layout.size))
    du[:, :, : layout.mag] = evaluated.field.by_parameters
    de[:, :, layout.of_accel] = (
        evaluated.force.by_parameters / np.linalg.norm(evaluated.force.vector, axis=1)[:, None, None]
    )
    east, _, up = axes.transpose(1, 0, 2)
    de -= up[:, :, None] * np.einsum("ni,nip->np", up, de)[:, None, :]
    cross = np.cross(evaluated.field.vector, up)
    length = np.linalg.norm(cross, axis=1)[:, None, None]
    da = (np.cross(du, up[:, :, None], axis=1) + np.cross(evaluated.field.vector[:, :, None], de, axis=1)) / length
    d_east = da - east[:, :, None] * np.einsum("ni,nip->np", east, da)[:, None, :]
    d_north = np.cross(de, east[:, :, None], axis=1) + np.cross(up[:, :, None], d_east, axis=1)
    return np.stack([np.einsum("i,nip->np", x, part) for part in (d_east, d_north, de)], axis=1)


def _perpendicular_pair(direction: Array) -> Array:
    """Return two unit vectors across a unit vector and each other, shape (2, 3)."""
    basis: Array = np.linalg.svd(direction[None])[2][1:]
    return basis


# The fit: |f|, |m| and dip of every attitude, each with its variance.


_STEPS = 60  # of Levenberg and Marquardt
_TOLERANCE = 1e-11  # step in scaled parameters at which the fit ends
_CLOSE = 0.03
"""Change of the whitened residuals at which a fit is close enough for an update of the variances."""
_DAMPING, _NEAR = 1e-4, 1e-9
"""First damping of a minimisation, and that of one which begins near its end."""
_PASSES = 50  # until noise and solution agree
_RESTS = 1e-3
"""Chi-square probability below which attitudes scatter beyond their known noise."""
_HUBER = 2.0  # standard deviations of |m| and dip together from which the pull of an attitude is bounded
_LEAST = 1e-24  # variance that is assumed of exact data, by rounding
_PARTS = np.linspace(0.0, 1.0, 11)
"""Shares of the scatter beyond the known noise that a gradient of the field may have."""
_BLOCKS = np.array([0, 1, 2, 3, 3])
"""The variance that each residual of an attitude has: of |f|, |m|, dip, held direction."""


@dataclass(frozen=True)
class Pair:
    """Outputs of both triads in the attitudes, scaled so that both vectors have a length of about 1.

    Attributes
    ----------
    accel, mag
        Outputs of both triads, shape (n, 3).
    noise
        Covariance of the six outputs, shape (n, 6, 6); None where the magnetometers' is not known.
    accel_variance
        Variance of |f|, from the accelerometers' own fit, shape (n,).
    lengthening
        Bias of |f| by noise, shape (n,).
    accel_freedom
        Degrees of freedom of `accel_variance`, infinite where it is known.
    accel_size
        Number of the accelerometers' parameters.
    prior
        Mean and rows ``rows (theta - mean) = 0 ± 1`` of the accelerometers' parameters; None without.
    mag_order
        Order of the magnetometers' model, 1 or 2.
    held
        Attitudes in which a body axis points one way.
    """

    accel: Array
    mag: Array
    noise: Array | None
    accel_variance: Array
    lengthening: Array
    accel_freedom: float
    accel_size: int
    prior: tuple[Array, Array] | None = None
    mag_order: int = 1
    held: HeldDirections | None = None

    @property
    def layout(self) -> ParameterLayout:
        """Places of the parameters."""
        return ParameterLayout(9 + 3 * self.mag_order, self.accel_size, 0 if self.held is None else self.held.size)

    def only(self, kept: NDArray[np.intp]) -> Pair:
        """Return the pair with some of the attitudes, by index."""
        return replace(
            self,
            accel=self.accel[kept],
            mag=self.mag[kept],
            noise=None if self.noise is None else self.noise[kept],
            accel_variance=self.accel_variance[kept],
            lengthening=self.lengthening[kept],
            held=None if self.held is None else self.held.only(kept),
        )

    def evaluate(self, theta: Array) -> Invariants:
        """Return residuals, less the lengthening of |f|, and derivatives."""
        evaluated = evaluate_invariants(theta, self.accel, self.mag, self.layout)
        evaluated.residuals[:, 0] -= self.lengthening
        return evaluated if self.held is None else add_held_directions(evaluated, theta, self.layout, self.held)


@dataclass(frozen=True)
class Joint:
    """The joint fit.

    Attributes
    ----------
    pair
        The outputs of both triads.
    theta
        Parameters in the layout of `pair`, shape (p,).
    found
        Residuals and derivatives at the solution.
    information
        V_p^-1 without Huber's weights, shape (n, k, k); 0 for directions that are not held.
    covariance
        Covariance of theta, shape (p, p).
    freedom
        Degrees of freedom of each parameter's variance, shape (p,).
    sigma
        Standard deviations of |m|, dip and held directions: estimated, or added to the known noise.
    down_weights
        Huber's factors of |m| and dip, shape (n,).
    converged
        Whether both loops converged.
    """

    pair: Pair
    theta: Array
    found: Invariants
    information: Array
    covariance: Array
    freedom: Array
    sigma: Array
    down_weights: Array
    converged: bool


def solve(pair: Pair, start: Array, *, robust: bool = False) -> Joint:
    """Return the fit of both triads from start parameters (p,); `robust` limits the influence of single attitudes.

    Where both are unknown, the dip's standard deviation is not below the field's: the fit could otherwise bend the
    magnitudes until a few attitudes have no dip residuals at all.

    Raises
    ------
    numpy.linalg.LinAlgError
        The parameters diverge, or end where they are not determined.
    """
    theta, down = start, np.ones(len(pair.mag))
    unknown = pair.noise is None
    first = float(np.median(pair.accel_variance))
    extra = np.array([first if unknown else 0.0] * 2 + [first])
    free = np.array([unknown, unknown, pair.held is not None])
    rested = False
    evaluated = pair.evaluate(theta)
    for number in range(_PASSES):
        weigh = _root_of_information(_information(pair, _known_covariance(pair, evaluated), extra, down))
        theta, evaluated, settled = _minimise(pair, weigh, theta, evaluated, _NEAR if number else _DAMPING, _CLOSE)
        known = _known_covariance(pair, evaluated)
        before, weights_before = extra, down
        if number == 0 and not unknown:
            free[:2] = _exceeds_known_noise(evaluated, known)
        if free.any():
            extra = _update_variances(pair, evaluated, _information(pair, known, extra, down), extra, down, free)
        if robust:
            down = _huber_weights(evaluated, known, extra)
        rests = np.abs(extra - before) <= _RESTS * extra + _LEAST
        if settled and rests.all() and np.abs(down - weights_before).max() < _RESTS:
            rested = True
            break
    weigh = _root_of_information(_information(pair, known, extra, down))
    theta, evaluated, settled = _minimise(pair, weigh, theta, evaluated)
    known = _known_covariance(pair, evaluated)
    information = _information(pair, known, extra, np.ones(len(down)))
    covariance, freedom = _estimate_uncertainty(pair, evaluated, _information(pair, known, extra, down), extra, free)
    if extra[:2].any():
        gained, of_gradient = _covariance_of_gradient(pair, evaluated, information, covariance, extra)
        before, covariance = np.diag(covariance), covariance + gained
        with np.errstate(divide="ignore"):
            freedom = np.diag(covariance) ** 2 / (before**2 / freedom + np.diag(gained) ** 2 / of_gradient)
    if not (np.diag(covariance) > 0).all():
        raise np.linalg.LinAlgError("the fit ends where parameters are not determined")
    return Joint(pair, theta, evaluated, information, covariance, freedom, np.sqrt(extra), down, rested and settled)


def _known_covariance(pair: Pair, evaluated: Invariants) -> Array:
    """Return V_0 of |f|, |m| and dip, shape (n, 3, 3): ``B C B'``, of |f| the variance of its own fit.

    Sway turns the outputs of a hold without changing |f|. It is in C, and may enter the dip, but not the
    accelerometers' parameters beyond what their own fit allows for.
    """
    v = np.zeros((len(pair.mag), 3, 3))
    if pair.noise is not None:
        v = evaluated.by_outputs @ pair.noise @ evaluated.by_outputs.transpose(0, 2, 1)
        less = np.sqrt(np.minimum(pair.accel_variance / np.maximum(v[:, 0, 0], _LEAST), 1.0))
        v[:, 0, 1:] *= less[:, None]
        v[:, 1:, 0] *= less[:, None]
    v[:, 0, 0] = pair.accel_variance + _LEAST
    return v


def _information(pair: Pair, known: Array, extra: Array, down: Array) -> Array:
    """Return V^-1 of each attitude, shape (n, k, k), with variances `extra` added and Huber's weights."""
    v = known.copy()
    v[:, 1, 1] += extra[0] + _LEAST
    v[:, 2, 2] += extra[1] + _LEAST
    factor = np.column_stack([np.ones(len(down)), np.sqrt(down), np.sqrt(down)])
    inverse: Array = np.linalg.inv(v) * factor[:, :, None] * factor[:, None, :]
    if pair.held is None:
        return inverse
    whole = np.zeros((len(v), 5, 5))
    whole[:, :3, :3] = inverse
    whole[:, 3, 3] = whole[:, 4, 4] = (pair.held.group >= 0) / (extra[2] + _LEAST)
    return whole


def _root_of_information(information: Array) -> Array:
    """Return R with ``R' R = V^-1``, shape (n, k, k)."""
    upper = np.zeros_like(information)
    upper[:, :3, :3] = np.linalg.cholesky(information[:, :3, :3]).transpose(0, 2, 1)
    for k in range(3, information.shape[1]):
        upper[:, k, k] = np.sqrt(information[:, k, k])
    return upper


def _whiten_rows(pair: Pair, evaluated: Invariants, theta: Array, weigh: Array) -> tuple[Array, Array]:
    """Return whitened residuals and Jacobian of all attitudes, one after the other, and of the prior."""
    residuals = np.einsum("nij,nj->ni", weigh, evaluated.residuals).ravel()
    jacobian = (weigh @ evaluated.by_parameters).reshape(-1, len(theta))
    if pair.prior is None:
        return residuals, jacobian
    mean, rows = pair.prior
    prior_rows = np.zeros((len(rows), len(theta)))
    prior_rows[:, pair.layout.of_accel] = rows
    return np.concatenate([residuals, rows @ (theta[pair.layout.of_accel] - mean)]), np.vstack([jacobian, prior_rows])


def _minimise(
    pair: Pair, weigh: Array, theta: Array, evaluated: Invariants, damping: float = _NEAR, close: float = 0.0
) -> tuple[Array, Invariants, bool]:
    """Return parameters and residuals of least sum of squares, and whether the iteration converged.

    Levenberg-Marquardt with columns scaled to length 1, until a step is below the tolerance or changes the whitened
    residuals by less than `close`.

    Raises
    ------
    numpy.linalg.LinAlgError
        The parameters diverge.
    """
    residuals, jacobian = _whiten_rows(pair, evaluated, theta, weigh)
    cost = float(residuals @ residuals)
    for _ in range(_STEPS):
        scale = np.maximum(np.linalg.norm(jacobian, axis=0), np.finfo(float).tiny)
        scaled = np.vstack([jacobian / scale, np.sqrt(damping) * np.eye(len(theta))])
        if not (np.isfinite(scaled).all() and np.isfinite(residuals).all()):
            raise np.linalg.LinAlgError("the fit runs away")
        step = np.linalg.lstsq(scaled, -np.append(residuals, np.zeros(len(theta))), rcond=None)[0] / scale
        with np.errstate(all="ignore"):
            there = pair.evaluate(theta + step)
            new, slope = _whiten_rows(pair, there, theta + step, weigh)
        reached = float(new @ new)
        small = np.abs(step).max() < _TOLERANCE or np.linalg.norm(jacobian @ step) < close
        if reached <= cost * (1 + 1e-12):
            theta, evaluated, residuals, jacobian = theta + step, there, new, slope
            cost, damping = reached, damping / 10
        else:
            damping *= 10
        if small or damping > 1e12:
            return theta, evaluated, bool(small)
    return theta, evaluated, False


def weighted_jacobian(joint: Joint) -> Array:
    """Return the Jacobian of the solution over the standard deviations of its rows, with those of the prior."""
    return _whiten_rows(joint.pair, joint.found, joint.theta, _root_of_information(joint.information))[1]


def _covariance(pair: Pair, evaluated: Invariants, information: Array) -> Array:
    """Return ``(J' V^-1 J)^-1``, shape (p, p)."""
    size = evaluated.by_parameters.shape[2]
    carried = information @ evaluated.by_parameters
    normal = evaluated.by_parameters.reshape(-1, size).T @ carried.reshape(-1, size)
    if pair.prior is not None:
        prior_information = np.zeros((size, size))
        prior_information[pair.layout.of_accel, pair.layout.of_accel] = pair.prior[1].T @ pair.prior[1]
        normal = normal + prior_information
    scale = np.sqrt(np.diag(normal))
    inverse: Array = np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
    return inverse


def _trace_blocks(information: Array, evaluated: Invariants, covariance: Array) -> tuple[Array, Array]:
    """Return ``tr_k P``, shape (4,), and S, shape (4, 4), without forming P."""
    k = evaluated.residuals.shape[1]
    carried = information @ evaluated.by_parameters  # V^-1 J
    inside = carried @ covariance @ carried.transpose(0, 2, 1)
    gram = np.zeros((4, *covariance.shape))
    trace, squares = np.zeros(4), np.zeros((4, 4))
    for i, block in enumerate(_BLOCKS[:k]):
        gram[block] += carried[:, i].T @ carried[:, i]
        trace[block] += (information[:, i, i] - inside[:, i, i]).sum()
        for j, other in enumerate(_BLOCKS[:k]):
            squares[block, other] += (information[:, i, j] * (information[:, i, j] - 2 * inside[:, i, j])).sum()
    spread = gram @ covariance
    squares += spread.reshape(4, -1) @ spread.transpose(0, 2, 1).reshape(4, -1).T
    return trace, squares


def _update_variances(
    pair: Pair, evaluated: Invariants, information: Array, extra: Array, down: Array, free: Array
) -> Array:
    """Return the variances of |m|, dip and held directions after one pass of restricted maximum likelihood."""
    covariance = _covariance(pair, evaluated, information)
    trace, squares = _trace_blocks(information, evaluated, covariance)
    carried = information @ evaluated.by_parameters
    weighted = (information @ evaluated.residuals[:, :, None])[:, :, 0]
    felt = weighted - carried @ (covariance @ np.tensordot(carried, evaluated.residuals, ((0, 1), (0, 1))))
    weights = np.ones_like(felt)
    weights[:, 1:3] = 1 / np.maximum(down, 1e-12)[:, None]
    square = np.bincount(_BLOCKS[: felt.shape[1]], (weights * felt**2).sum(axis=0), 4)
    new = extra.copy()
    which = np.flatnonzero(free)
    change = np.linalg.solve(squares[1:, 1:][np.ix_(which, which)], (square - trace)[1:][which])
    new[which] = np.maximum(extra[which] + change, 0.0)
    if pair.noise is None and new[1] < new[0]:
        both = slice(1, 3)
        change = (square - trace)[both].sum() / squares[both, both].sum()
        new[:2] = max(float(extra[:2].mean()) + change, 0.0)
    new[np.logical_not(free)] = 0.0
    return new


def _covariance_of_gradient(
    pair: Pair, evaluated: Invariants, information: Array, covariance: Array, extra: Array
) -> tuple[Array, float]:
    """Return what a gradient of the field adds to the covariance of theta, as far as it is likely, and its freedom.

    A part rho of the scatter beyond the known noise may be that of a gradient G about a centre of the turns d off the
    magnetometers, whose |m| and dips are ``a' G C_i d``: C_i the axes of the world in attitude i, a the directions of u
    and t. With G and d in any direction, their covariance is s^2 K. Much of it looks like hard iron and leaves no
    residual. Each rho has the weight that its restricted likelihood gives it; before, rho = 0 has half of all weight.
    """
    n, k = evaluated.residuals.shape
    kernel = np.zeros((n, k, n, k))
    kernel[:, 1:3, :, 1:3] = _gradient_kernel(evaluated)
    white = np.zeros((n, k))
    white[:, 1:3] = extra[:2]
    weigh = _root_of_information(information)
    blocks = np.zeros((n, k, n, k))
    blocks[np.arange(n), :, np.arange(n), :] = weigh
    whiten: Array = blocks.reshape(n * k, n * k)
    jacobian = whiten @ evaluated.by_parameters.reshape(n * k, -1)
    rotated = np.linalg.qr(jacobian, mode="complete")[0]
    free = rotated[:, jacobian.shape[1] :]
    residual = free.T @ (whiten @ evaluated.residuals.ravel())
    smooth = whiten @ kernel.reshape(n * k, n * k) @ whiten.T
    rough = (whiten * white.ravel()) @ whiten.T
    smooth_free, rough_free = free.T @ smooth @ free, free.T @ rough @ free
    size = np.trace(rough_free) / max(float(np.trace(smooth_free)), 1e-300)
    values, vectors = np.linalg.eigh(size * smooth_free - rough_free)
    relative = np.maximum(1 + _PARTS[:, None] * values, 1e-9)
    squares = ((vectors.T @ residual) ** 2 / relative).sum(axis=1)
    likelihood = -0.5 * (np.log(relative).sum(axis=1) + len(residual) * np.log(squares))
    weights = np.append(0.5, np.full(len(_PARTS) - 1, 0.5 / (len(_PARTS) - 1)))
    pull = covariance @ jacobian.T  # of whitened residuals on theta
    weights *= np.exp(likelihood - likelihood.max())
    part = float(weights @ _PARTS / weights.sum())
    gained: Array = part * (pull @ (size * smooth - rough) @ pull.T)
    values, vectors = np.linalg.eigh(gained)
    # A product of two vectors scatters as half as many numbers would.
    freedom = max(np.trace(smooth_free) ** 2 / max(float((smooth_free**2).sum()), 1e-300) / 2, 1.0)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T, dtype=np.float64), float(freedom)


def _gradient_kernel(evaluated: Invariants) -> Array:
    """Return K of |m| and dip of all attitudes, (n, 2, n, 2): E[(a'Gb)(c'Gd)] = a'c b'd + a'd b'c - 2/3 a'b c'd."""
    m, f = evaluated.field.vector, evaluated.force.vector
    u = m / np.linalg.norm(m, axis=1)[:, None]
    axes = world_axes(m, f)
    up = axes[:, 2]
    t = -up - u * -np.einsum("ni,ni->n", u, up)[:, None]
    t /= np.linalg.norm(t, axis=1)[:, None]
    along = np.stack([u, t], axis=1)  # directions of |m| and dip in the body, (n, 2, 3)
    inner = np.einsum("ipk,jqk->ipjq", along, along)
    kernel: Array = np.einsum("jpk,iqk->ipjq", along, along) - 2 / 3 * inner
    both = np.einsum("irk,jrk->ij", axes, axes)
    for p in range(2):
        kernel[:, p, :, p] += both
    return kernel


def _exceeds_known_noise(evaluated: Invariants, known: Array) -> Array:
    """Return whether |m|, and the dip, scatter beyond their known noise; each loses a third of the parameters."""
    n, size = len(known), evaluated.by_parameters.shape[2]
    chi = (evaluated.residuals[:, :3] ** 2 / (np.einsum("nii->ni", known) + _LEAST))[:, 1:].sum(axis=0)
    freedom = max(n - size / 3, 1.0)
    return np.array([chi_square_probability(float(value), freedom) < FIELD_SCATTERS.level for value in chi])


def _huber_weights(evaluated: Invariants, known: Array, extra: Array) -> Array:
    """Return Huber's weights: ``min(1, 2/d)``, ``d^2 = r1^2/sigma_m^2 + r2^2/sigma_delta^2``, shape (n,)."""
    variance = np.einsum("nii->ni", known)[:, 1:] + extra[:2] + _LEAST
    d = np.sqrt((evaluated.residuals[:, 1:3] ** 2 / variance).sum(axis=1))
    weights: Array = np.minimum(1.0, _HUBER / np.maximum(d, 1e-300))
    return weights


def _estimate_uncertainty(
    pair: Pair, evaluated: Invariants, information: Array, extra: Array, free: Array
) -> tuple[Array, Array]:
    """Return the covariance of theta, and the degrees of freedom of each variance in it."""
    covariance = _covariance(pair, evaluated, information)
    squares = _trace_blocks(information, evaluated, covariance)[1]
    carried = (information @ evaluated.by_parameters) @ covariance
    each = (carried**2).sum(axis=0)
    by_block = np.zeros((4, len(covariance)))
    np.add.at(by_block, _BLOCKS[: len(each)], each)  # dv/dsigma_k^2
    spread = np.zeros((4, 4))
    if np.isfinite(pair.accel_freedom):
        spread[0, 0] = float(np.median(pair.accel_variance)) ** 2 / pair.accel_freedom
    which = np.flatnonzero(free) + 1
    spread[np.ix_(which, which)] = np.linalg.inv(squares[np.ix_(which, which)])
    with np.errstate(divide="ignore"):
        freedom = np.diag(covariance) ** 2 / np.einsum("kp,kl,lp->p", by_block, spread, by_block)
    return covariance, freedom


# Scaling of the magnetometers' outputs, and both triads ready for the fit.


@dataclass(frozen=True)
class MagScaling:
    """Scaling of outputs to those of a field of length 1: a signed permutation, less a zero, over a size.

    Attributes
    ----------
    axes
        Row k names the output that becomes axis k, shape (3, 3).
    zero
        Zero of the renamed outputs, shape (3,).
    size
        Output per unit of the field.
    field
        Magnitude of the field, T; None where it is the unit.
    """

    axes: Array
    zero: Array
    size: float
    field: float | None

    def outputs(self, mean: Array) -> Array:
        """Return outputs, shape (n, 3), scaled."""
        scaled: Array = (mean @ self.axes.T - self.zero) / self.size
        return scaled

    def covariance(self, matrices: Array) -> Array:
        """Return covariances of outputs, shape (n, 3, 3), scaled."""
        scaled: Array = self.axes @ matrices @ self.axes.T / self.size**2
        return scaled

    def in_si(self, theta: Array) -> tuple[Array, Array]:
        """Return the parameters of a record, shape (p,), and their derivatives by theta, shape (p, p).

        ``S = size s / F``, ``b = (zero + size z) / S``, ``k2 = theta / F``; misalignments are the same.
        """
        unit = 1.0 if self.field is None else self.field
        scale = self.size * theta[3:6] / unit
        bias = (self.zero + self.size * theta[:3]) / scale
        values = np.concatenate([bias, scale, theta[6:12], theta[12:] / unit])
        slope = np.diag(
            np.concatenate(
                [self.size / scale, np.full(3, self.size / unit), np.ones(6), np.ones(len(theta[12:])) / unit]
            )
        )
        slope[range(3), range(3, 6)] = -bias / theta[3:6]
        return values, slope


def scale_magnetometers(start: Start, magnitude: float | None) -> tuple[MagScaling, Array]:
    """Return the scaling of outputs, and the magnetometers' parameters at the start, order 1, shape (12,)."""
    turned: Array = np.asarray(np.linalg.inv(start.matrix), dtype=np.float64)
    axes = name_axes(turned)
    renamed = axes @ turned
    size = float(np.abs(np.diag(renamed)).mean())
    scale = np.diag(renamed) / size
    off = (renamed / np.diag(renamed)[:, None])[tuple(np.transpose(MAGNETOMETERS))]
    return MagScaling(axes, axes @ start.hard_iron, size, magnitude), np.concatenate([np.zeros(3), scale, off])


@dataclass(frozen=True)
class Ready:
    """Both triads before the joint fit.

    Attributes
    ----------
    estimate, scaling, gravity
        The accelerometers by themselves, their scaling, and local gravity.
    means
        The magnetometers' outputs in all attitudes.
    kept
        Indices of the attitudes that are used, from 0.
    mag
        Scaling of the magnetometers.
    pair, start
        Outputs to be fitted, and start parameters.
    order, loss
        Options of the accelerometers' own fit.
    notes
        Notes on the prior.
    """

    estimate: Estimate
    scaling: Scaling
    gravity: Gravity
    means: FieldMeans
    kept: NDArray[np.intp]
    mag: MagScaling
    pair: Pair
    start: Array
    order: int | str
    loss: str
    notes: list[str] = field(default_factory=list)

"""Where the joint fit of both triads starts: an ellipsoid for the magnetometers, and the rotation that keeps the dip.

The magnitude gives hard iron h and ``U'U``, linear in the ten coefficients of an ellipsoid. With u = U (M - h) and the
direction e of gravity the constant dip is ``e' R u + sin(dip) = 0``, linear in the ten numbers R, sin(dip): their
direction is the least singular vector of the rows ``[e_i u_j, 1]``.

Source: Papafotis and Sotiriadis, IEEE Sensors J. 19 (2019) 8241 (ellipsoid, then alignment).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from imulab.recording import Array


@dataclass(frozen=True)
class Start:
    """``m = W (M - h)`` in units of the field, shapes (3, 3) and (3,), and the dip, rad."""

    matrix: Array
    hard_iron: Array
    dip: float


def find_start(mag: Array, direction: Array) -> Start:
    """Return where to start from.

    Parameters
    ----------
    mag
        Outputs, of any scale, shape (n, 3).
    direction
        Unit vectors of the specific force in the body frame, shape (n, 3).
    """
    centre, size = mag.mean(axis=0), float(np.linalg.norm(mag.std(axis=0)))
    scaled = (mag - centre) / size
    shape = _ellipsoid(scaled)
    if shape is None:
        shape = _sphere(scaled)
        rotation, sine = _best_permutation_of_axes((scaled - shape[1]) @ shape[0].T, direction)
    else:
        rotation, sine = _alignment((scaled - shape[1]) @ shape[0].T, direction)
    upper, hard_iron = shape
    dip = float(np.arcsin(np.clip(sine, -0.999, 0.999)))
    return Start(rotation @ upper / size, centre + size * hard_iron, dip)


def _ellipsoid(points: Array) -> tuple[Array, Array] | None:
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


def _sphere(points: Array) -> tuple[Array, Array]:
    """Return U and h of the sphere ``|x - h| = r`` through the points, by algebraic least squares."""
    design = np.column_stack([2 * points, np.ones(len(points))])
    found = np.linalg.lstsq(design, (points**2).sum(axis=1), rcond=None)[0]
    radius = np.sqrt(max(found[3] + found[:3] @ found[:3], 1e-12))
    return np.eye(3) / radius, found[:3]


def _alignment(field: Array, direction: Array) -> tuple[Array, float]:
    """Return the rotation and the sine of the dip that make ``e' R u + sin(dip)`` least; R is right-handed."""
    rows = np.column_stack([(direction[:, :, None] * field[:, None, :]).reshape(len(field), 9), np.ones(len(field))])
    found = np.linalg.svd(rows, full_matrices=False)[2][-1]
    matrix = found[:9].reshape(3, 3)
    if np.linalg.det(matrix) < 0:
        matrix, found = -matrix, -found
    left, _, right = np.linalg.svd(matrix)
    rotation: Array = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return rotation, float(-np.mean(np.einsum("ni,ij,nj->n", direction, rotation, field)))


def _best_permutation_of_axes(field: Array, direction: Array) -> tuple[Array, float]:
    """Return, of the 24 rotations that carry axes into axes, the one under which the dip varies least."""
    candidates = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        rotation = np.diag(signs)[:, order]
        if np.linalg.det(rotation) > 0:
            cosine = np.einsum("ni,ij,nj->n", direction, rotation, field)
            candidates.append((float(cosine.var()), rotation, float(-cosine.mean())))
    _, rotation, sine = min(candidates, key=lambda candidate: candidate[0])
    return rotation, sine


def axes_of(matrix: Array) -> Array:
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

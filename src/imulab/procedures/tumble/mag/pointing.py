"""Attitudes in which one axis of the body points the same way: what they say of heading beyond magnitude and dip.

The rows of C are east, north and up in body components: ``up = e``, ``east = u x e / |u x e|``, ``north = up x east``.
A body axis x that keeps its direction d in the world leaves ``C x - d``, of which the two parts across d are taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.procedures.tumble.mag.model import Invariants, Layout
from imulab.recording import Array


@dataclass(frozen=True)
class Held:
    """Groups of attitudes that point one way, relative to where the axis and the directions were at the start.

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

    def only(self, kept: NDArray[np.intp]) -> Held:
        """Return what is held of some of the attitudes."""
        return replace(self, group=self.group[kept])


def find_held(field: Array, force: Array, groups: Sequence[Sequence[int]]) -> tuple[Held, Array]:
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
    across = np.array([_across(mean / np.linalg.norm(mean)) for mean in means])
    start = np.concatenate([np.zeros(2), *(b @ mean for b, mean in zip(across, means, strict=True))])
    return Held(number, axis, _across(axis), across), start


def world_axes(field: Array, force: Array) -> Array:
    """Return C, rows east, north and up in body components, shape (n, 3, 3)."""
    up = force / np.linalg.norm(force, axis=1)[:, None]
    east = np.cross(field, up)
    east /= np.linalg.norm(east, axis=1)[:, None]
    return np.stack([east, np.cross(up, east), up], axis=1)


def with_held(found: Invariants, theta: Array, layout: Layout, held: Held) -> Invariants:
    """Return the invariants with two more residuals of each attitude, ``B (C x - d)``; nil outside of the groups."""
    own = theta[layout.of_directions]
    longer = held.axis + own[:2] @ held.axis_across
    length = np.linalg.norm(longer)
    x = longer / length
    by_own = (held.axis_across - np.outer(held.axis_across @ x, x)) / length  # dx by its two parameters, (2, 3)
    axes = world_axes(found.field.vector, found.force.vector)
    turned = _change(found, axes, x, layout)
    member = held.group >= 0
    across = np.where(member[:, None, None], held.across[held.group], 0.0)
    residuals = np.einsum("nki,nij,j->nk", across, axes, x)
    slope = np.einsum("nki,nip->nkp", across, turned)
    first = layout.of_directions.start
    slope[:, :, first : first + 2] = np.einsum("nki,nij,lj->nkl", across, axes, by_own)
    for index in range(len(held.across)):
        inside = held.group == index
        at = first + 2 + 2 * index
        residuals[inside] -= own[2 + 2 * index : 4 + 2 * index]
        slope[inside, :, at : at + 2] = -np.eye(2)
    return replace(
        found,
        residuals=np.hstack([found.residuals, residuals]),
        by_parameters=np.concatenate([found.by_parameters, slope], axis=1),
    )


def _change(found: Invariants, axes: Array, x: Array, layout: Layout) -> Array:
    """Return how ``C x`` changes with the triads' parameters, shape (n, 3, p)."""
    n = len(axes)
    du, de = np.zeros((n, 3, layout.size)), np.zeros((n, 3, layout.size))
    du[:, :, : layout.mag] = found.field.by_parameters
    de[:, :, layout.of_accel] = found.force.by_parameters / np.linalg.norm(found.force.vector, axis=1)[:, None, None]
    east, _, up = axes.transpose(1, 0, 2)
    de -= up[:, :, None] * np.einsum("ni,nip->np", up, de)[:, None, :]
    cross = np.cross(found.field.vector, up)
    length = np.linalg.norm(cross, axis=1)[:, None, None]
    da = (np.cross(du, up[:, :, None], axis=1) + np.cross(found.field.vector[:, :, None], de, axis=1)) / length
    d_east = da - east[:, :, None] * np.einsum("ni,nip->np", east, da)[:, None, :]
    d_north = np.cross(de, east[:, :, None], axis=1) + np.cross(up[:, :, None], d_east, axis=1)
    return np.stack([np.einsum("i,nip->np", x, part) for part in (d_east, d_north, de)], axis=1)


def _across(direction: Array) -> Array:
    """Return two unit vectors across a unit vector and each other, shape (2, 3)."""
    basis: Array = np.linalg.svd(direction[None])[2][1:]
    return basis

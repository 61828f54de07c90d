"""What the attitudes say of the fit itself: predicted errors, attitudes that were disturbed, what cannot be seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.estimation.special import fdtrc
from imulab.procedures.tumble.mag.pointing import world_axes
from imulab.procedures.tumble.mag.solve import Joint, Pair, weighted_jacobian
from imulab.recording import Array

FALSE_ALARM = 0.05
WORST_CONDITION = 30.0
"""Attitudes that all face one way have 45 and more; within 20 deg of one way 7, at any heading 3."""
_BLIND = 1 / 2000
"""Singular value, relative to the largest, below which a combination is not determined."""
_HELPS = 0.05
_LEAST_PART = 3
"""Attitudes before and after a step: of fewer each is held against all others."""


@dataclass(frozen=True)
class Predicted:
    """Errors of each attitude under the fit to all others, shape (n, 3), and the hat matrix's blocks, (n, 3, 3).

    Both are to first order in the change of the parameters: on real recordings refits differ by less than 0.1 %.
    """

    errors: Array
    hat: Array

    def rms(self, which: int) -> float:
        """Return the root mean square of the errors of |f| (0), |m| (1) or dip (2)."""
        return float(np.sqrt(np.mean(self.errors[:, which] ** 2)))


def leave_one_out(joint: Joint) -> Predicted:
    """Return ``L (I - H_pp)^-1 L^-1 r_p`` of each attitude, ``V = L L'``."""
    n, k = joint.found.residuals.shape
    jacobian = weighted_jacobian(joint)
    q = np.linalg.qr(jacobian / np.linalg.norm(jacobian, axis=0))[0][: n * k].reshape(n, k, -1)[:, :3]
    hat = np.einsum("nip,njp->nij", q, q)
    root = np.linalg.cholesky(joint.information[:, :3, :3]).transpose(0, 2, 1)
    own = np.einsum("nij,nj->ni", root, joint.found.residuals[:, :3])
    free = np.linalg.solve(np.eye(3) - hat + 1e-12 * np.eye(3), own[:, :, None])
    return Predicted(np.linalg.solve(root, free)[:, :, 0], hat)


@dataclass(frozen=True)
class Disturbed:
    """The attitude that fits the others worst, and how improbable that is among so many."""

    index: int
    probability: float
    magnitude: float
    dip: float


def most_disturbed(joint: Joint) -> Disturbed:
    """Hold each attitude's |m| and dip against the others.

    ``d = x' (I - H)^-1 x`` of the whitened |m| and dip, ``(d/2) / ((c - d) / (nu - 2))`` against F(2, nu - 2), with c
    and nu the sum of squares and the redundancy of all |m| and dips; p is that times the number of attitudes.
    """
    n = len(joint.down_weights)
    predicted = leave_one_out(joint)
    root = np.linalg.cholesky(joint.information[:, :3, :3]).transpose(0, 2, 1)
    x = np.einsum("nij,nj->ni", root, joint.found.residuals[:, :3])[:, 1:]
    free = np.eye(2) - predicted.hat[:, 1:, 1:]
    d = np.einsum("ni,nij,nj->n", x, np.linalg.inv(free + 1e-12 * np.eye(2)), x)
    total, redundancy = float((x**2).sum()), float(np.einsum("nii->", free))
    rest = np.maximum(total - d, 1e-300) / max(redundancy - 2, 1e-9)
    p = np.array([float(fdtrc(2.0, max(redundancy - 2, 1.0), value)) for value in d / 2 / rest]) * n
    index = int(np.argmin(p))
    error = predicted.errors[index]
    return Disturbed(index, float(min(p[index], 1.0)), float(error[1]), float(error[2]))


@dataclass(frozen=True)
class Step:
    """From which attitude on |m| and dip are others than before, by how much, and how improbable that is by chance."""

    first: int
    magnitude: float
    dip: float
    probability: float


def likeliest_step(joint: Joint) -> Step | None:
    """Return the split of the attitudes, in their order, at which |m| and dip change most; None of too few attitudes.

    Both change by a number of their own, which the fit would have found beside its parameters; the gain, in the sum of
    squares c of |m| and dips with nu degrees of freedom, is held against F(2, nu - 2), times the number of splits.
    """
    n, k = joint.found.residuals.shape
    splits = np.arange(_LEAST_PART, n - _LEAST_PART + 1)
    if not splits.size:
        return None
    jacobian = weighted_jacobian(joint)
    q = np.linalg.qr(jacobian / np.linalg.norm(jacobian, axis=0))[0][: n * k]
    root = np.zeros((n, k, 3))
    root[:, :3] = np.linalg.cholesky(joint.information[:, :3, :3]).transpose(0, 2, 1)
    whitened = np.einsum("nij,nj->ni", root, joint.found.residuals[:, :3])
    after = np.arange(n)[:, None, None, None] >= splits[:, None]
    steps = (root[:, :, None, 1:] * after).reshape(n * k, -1)
    columns = (steps - q @ (q.T @ steps)).reshape(n * k, len(splits), 2)
    normal = np.einsum("rsa,rsb->sab", columns, columns)
    moment = np.einsum("rsa,r->sa", columns, whitened.ravel())
    size = np.linalg.solve(normal, moment[:, :, None])[:, :, 0]
    gain = (size * moment).sum(axis=1)
    total = float((whitened[:, 1:3] ** 2).sum())
    redundancy = max(2 * n - joint.pair.layout.mag - 1.0, 3.0)
    at = int(np.argmax(gain))
    ratio = gain[at] / 2 / (max(total - float(gain[at]), 1e-300) / (redundancy - 2))
    p = min(float(fdtrc(2.0, redundancy - 2, ratio)) * len(splits), 1.0)
    return Step(int(splits[at]), float(size[at, 0]), float(size[at, 1]), p)


@dataclass(frozen=True)
class Seen:
    """What |m| and the dip determine of the magnetometers' parameters and the dip.

    Attributes
    ----------
    rank, size
        Combinations that are determined, and their number.
    condition
        Largest over smallest singular value, columns scaled to length 1.
    blind
        Body axes about which a rotation of the magnetometers changes nothing, shape (k, 3).
    heading
        Attitudes that would help most if they faced another way, best first.
    """

    rank: int
    size: int
    condition: float
    blind: Array
    heading: tuple[int, ...]

    @property
    def enough(self) -> bool:
        """Whether everything is determined, and well enough to be of use."""
        return self.rank == self.size and self.condition < WORST_CONDITION


def seen(pair: Pair, theta: Array) -> Seen:
    """Judge what the attitudes can tell, at start parameters or at the solution."""
    layout = pair.layout
    found = pair.evaluate(theta)
    jacobian = found.by_parameters[:, 1:3, : layout.mag + 1]
    if pair.held is not None:
        jacobian = np.concatenate([jacobian, found.by_parameters[:, 3:, : layout.mag + 1]], axis=1)
    rows = jacobian.reshape(-1, layout.mag + 1)
    scaled = rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    values = np.linalg.svd(scaled, compute_uv=False)
    values = np.append(values, np.zeros(max(0, scaled.shape[1] - len(values))))
    east = world_axes(found.field.vector, found.force.vector)[:, 0]
    # A rotation of the magnetometers changes the dip by its part along magnetic east.
    spread, axes = np.linalg.eigh(east.T @ east / len(east))
    blind = axes[:, spread < _HELPS].T
    rank = int((values > _BLIND * values[0]).sum())
    lacking = axes[:, 0]
    order = np.argsort(np.abs(east @ lacking), kind="stable")
    up = found.force.vector / np.linalg.norm(found.force.vector, axis=1)[:, None]
    # Turned by a quarter the east of an attitude becomes its north: those gain whose north lies along what is lacking.
    gain = np.abs(np.cross(up, east) @ lacking)
    heading = tuple(int(i) for i in order[np.argsort(-gain[order], kind="stable")][:4])
    return Seen(rank, layout.mag + 1, float(values[0] / max(values[-1], 1e-300)), blind, heading)


def heading_uncertainty(joint: Joint, covariance: Array) -> tuple[float, float]:
    """Return the standard uncertainty of magnetic heading, rad: by the parameters, rms of the attitudes; of a reading.

    `covariance` is that of the parameters, shape (p, p).

    An error dm of the field turns its horizontal part by ``east . dm / |m| cos(dip)``, one df of the specific force the
    vertical.
    """
    layout, found = joint.pair.layout, joint.found
    m, f = found.field.vector, found.force.vector
    axes = world_axes(m, f)
    east, north = axes[:, 0], axes[:, 1]
    horizontal = np.einsum("ni,ni->n", north, m)
    slope = np.zeros((len(m), layout.size))
    slope[:, : layout.mag] = np.einsum("ni,nip->np", east, found.field.by_parameters) / horizontal[:, None]
    vertical = np.einsum("ni,ni->n", axes[:, 2], m) / np.linalg.norm(f, axis=1) / horizontal
    slope[:, layout.of_accel] = -np.einsum("ni,nip->np", east, found.force.by_parameters) * vertical[:, None]
    known = np.einsum("np,pq,nq->n", slope, covariance, slope)
    # V of |m| is that of one component of the field, whatever the direction.
    own = np.linalg.inv(joint.information[:, :3, :3])[:, 1, 1]
    reading = float(np.median(own)) / np.cos(joint.theta[layout.dip_at]) ** 2
    return float(np.sqrt(np.mean(known))), float(np.sqrt(reading))

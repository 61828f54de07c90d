"""The fit of an ellipsoid, or of an ellipse in the plane of a level turn, to outputs of magnetometers.

The field has one magnitude, whatever way the unit points: ``M = D m + h``, ``|m| = 1``, D symmetric, in as many axes as
were turned, d = 3 or 2. With ``m = W (M - h)``, ``W = D^-1``, ``u = m / |m|`` and ``v = W u`` one reading says

    r = |m| - 1 - sigma^2 (tr W^2 - v'v) / 2,    var r = sigma^2 v'v,
    dr/dh_i = -v_i,   dr/dD_ii = -v_i u_i,   dr/dD_ij = -(v_i u_j + v_j u_i)

for noise of one standard deviation sigma on each output. The term with sigma^2 is the lengthening of |m| by the noise
across it. The derivatives are taken at u, not at m, since m has the noise of r: with m, D would be too large by
sigma^2. What u has of it, ``E[du r] = sigma^2 q``, ``q = (1 - u u') W v``, is taken off:

    sum_k  w dr/dtheta r - sigma^2 (w d(dr/dtheta)/du q - 2 w^2 v'W q dr/dtheta) = 0,    w = 1 / v'v

has no bias of second order, and reaches the Cramer-Rao bound, in which the direction of each reading is unknown.

Readings in a row can have errors in common. With B blocks of consecutive readings, scores ``s_b = sum q_k r_k`` of
orthonormal columns q, and ``G_b = sum q_k q_k'``,

    f = sum_b |s_b|^2 / (sigma^2 (p - sum_b tr G_b^2))

is how many times larger the covariance is than with independent errors; it is 1 on the average where they are.

Sources: Vasconcelos et al., IEEE Trans. Aerosp. Electron. Syst. 47 (2011) 1293; Al-Sharadqah and Chernov, Electron. J.
Statist. 3 (2009) 886 (bias of geometric fits).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.decisions import READINGS_SET_ASIDE
from imulab.estimation.distributions import f_tail
from imulab.estimation.rows import MAD_TO_SIGMA, median
from imulab.recording import Array

BLOCKS, LEAST_IN_BLOCK = 30, 8
"""Blocks of consecutive readings, by which errors in common are seen; fewest readings in one, else all are taken as
independent."""
_LONG_BLOCKS = 10  # by which errors that last longer are seen, where what they are taken for lasts long, too
_STEPS, _CLOSE = 60, 1e-10
_FARTHEST = 1e3  # largest parameter of a fit, where the readings spread by about 1
_HUBER = 2.0  # robust standard deviations, from which a reading pulls by its sign alone
_DAMPING = 1e-3


def pairs(dimension: int) -> list[tuple[int, int]]:
    """Return the places (i, j), i <= j, of the free elements of D."""
    return [(i, j) for i in range(dimension) for j in range(i, dimension)]


def unpack(theta: Array, dimension: int) -> tuple[Array, Array]:
    """Return hard iron h, shape (d,), and soft iron D, shape (d, d), of parameters."""
    soft: Array = np.zeros((dimension, dimension))
    for value, (i, j) in zip(theta[dimension:].tolist(), pairs(dimension), strict=True):
        soft[i, j] = soft[j, i] = value
    return theta[:dimension], soft


@dataclass(frozen=True)
class Surface:
    """A fitted ellipsoid or ellipse, in units in which the field has length 1.

    Attributes
    ----------
    theta
        Hard iron, then the free elements of D, shape (p,).
    residual, jacobian
        r over |v|, and its derivatives, of the readings that were fitted, shapes (n,) and (n, p).
    sigma
        Standard deviation of one output.
    inflation
        Factor f of the covariance by errors that readings in a row have in common.
    converged
        Whether the fit came to rest.
    beyond
        Covariance of theta by terms that the surface does not have, shape (p, p), or 0.
    """

    theta: Array
    residual: Array
    jacobian: Array
    sigma: float
    inflation: float
    converged: bool
    beyond: Array | float = 0.0

    @property
    def dimension(self) -> int:
        """Number of axes that were turned."""
        return 3 if len(self.theta) == 9 else 2

    @property
    def covariance(self) -> Array:
        """Covariance of theta, shape (p, p)."""
        size = np.linalg.norm(self.jacobian, axis=0)
        scaled = self.jacobian / size
        matrix: Array = self.inflation * self.sigma**2 * np.linalg.inv(scaled.T @ scaled) / np.outer(size, size)
        return matrix + self.beyond

    @property
    def freedom(self) -> float:
        """Degrees of freedom of sigma."""
        return max(len(self.residual) / self.inflation - len(self.theta), 1.0)

    @property
    def gain(self) -> float:
        """Output per field, the geometric mean over the axes."""
        return float(np.abs(np.linalg.det(unpack(self.theta, self.dimension)[1])) ** (1 / self.dimension))

    @property
    def condition(self) -> float:
        """Condition number of the derivatives, columns scaled to length 1."""
        values = np.linalg.svd(self.jacobian / np.linalg.norm(self.jacobian, axis=0), compute_uv=False)
        return float(values[0] / max(values[-1], 1e-300))


def evaluate(theta: Array, outputs: Array, sigma: float = 0.0) -> tuple[Array, Array, Array]:
    """Return r, shape (n,), its derivatives, shape (n, p), and |v|, shape (n,), for outputs of shape (n, d)."""
    length, u, v, inverse = _directions(theta, outputs)
    square = (v**2).sum(axis=1)
    lengthening = sigma**2 * (float(np.trace(inverse @ inverse)) - square) / 2
    return length - 1 - lengthening, np.hstack([-v, -_products(v, u)]), np.sqrt(square)


def _directions(theta: Array, outputs: Array) -> tuple[Array, Array, Array, Array]:
    """Return |m|, shape (n,), u and v, shape (n, d), and W."""
    hard, soft = unpack(theta, outputs.shape[1])
    inverse = np.asarray(np.linalg.inv(soft), dtype=np.float64)
    field = (outputs - hard) @ inverse
    length = np.sqrt((field**2).sum(axis=1))
    u = field / length[:, None]
    return length, u, u @ inverse, inverse


def _products(v: Array, u: Array) -> Array:
    """Return ``v_i u_i`` and ``v_i u_j + v_j u_i`` at the places of D, shape (n, p - d)."""
    return np.column_stack(
        [v[:, i] * u[:, j] + (v[:, j] * u[:, i] if i != j else 0.0) for i, j in pairs(v.shape[1])]
    )  # fmt: skip


def _noise_score(theta: Array, outputs: Array) -> Array:
    """Return what the noise of u adds to the sum of scores, over sigma^2, shape (p,)."""
    _, u, v, inverse = _directions(theta, outputs)
    weight = 1 / (v**2).sum(axis=1)
    back = v @ inverse
    q = back - u * (u * back).sum(axis=1)[:, None]
    dv = q @ inverse
    change = -np.hstack([dv, _products(dv, u) + _products(v, q)])
    jacobian = -np.hstack([v, _products(v, u)])
    score: Array = weight @ change - 2 * (weight**2 * (v * dv).sum(axis=1)) @ jacobian
    return score


def direction_rows(theta: Array, directions: Array) -> tuple[Array, Array]:
    """Return the derivatives of the corrected field by theta: of its length, (n, p), and across it, (n, d, p).

    Of fields of length 1 in given directions, shape (n, d). A rotation of all of them, which the outputs do not tell,
    is taken off.
    """
    d = directions.shape[1]
    inverse = np.linalg.inv(unpack(theta, d)[1])
    eye = np.eye(d)
    columns = [-np.tile(inverse[:, i], (len(directions), 1)) for i in range(d)]
    columns += [
        -(np.outer(directions[:, j], inverse[:, i]) + (np.outer(directions[:, i], inverse[:, j]) if i != j else 0.0))
        for i, j in pairs(d)
    ]
    change = np.stack(columns, axis=2)
    along = np.einsum("ni,nip->np", directions, change)
    across = change - directions[:, :, None] * along[:, None, :]
    turns = [np.outer(eye[i], eye[j]) - np.outer(eye[j], eye[i]) for i in range(d) for j in range(i)]
    for turn in turns:  # orthogonal to one another over directions that are spread evenly
        moved = directions @ turn.T
        moved /= np.sqrt((moved**2).sum())
        across -= moved[:, :, None] * np.einsum("ni,nip->p", moved, across)
    return along, across


def fit_surface(outputs: Array) -> Surface:
    """Return the ellipsoid or ellipse through outputs, shape (n, d), n above the number of parameters.

    Raises
    ------
    numpy.linalg.LinAlgError
        The outputs determine none.
    """
    d = outputs.shape[1]
    centre, size = fit_sphere(outputs)
    theta = np.concatenate([np.zeros(d), [1.0 if i == j else 0.0 for i, j in pairs(d)]])
    scaled = (outputs - centre) / size
    theta = _approach(scaled, theta)
    sigma = _scatter(*evaluate(theta, scaled)[::2], len(theta))
    rest = False
    for _ in range(_STEPS):
        r, jacobian, weight = evaluate(theta, scaled, sigma)
        whitened, rows = r / weight, jacobian / weight[:, None]
        step = np.linalg.solve(rows.T @ rows, sigma**2 * _noise_score(theta, scaled) - rows.T @ whitened)
        theta = theta + step
        if not np.abs(theta).max() < _FARTHEST:
            raise np.linalg.LinAlgError
        sigma = _scatter(*evaluate(theta, scaled, sigma)[::2], len(theta))
        if rest := float(np.abs(step).max()) < _CLOSE:
            break
    hard, soft = unpack(theta, d)
    if np.linalg.eigvalsh(soft).min() <= 0:
        raise np.linalg.LinAlgError
    r, jacobian, weight = evaluate(theta, scaled, sigma)
    whitened, rows = r / weight, jacobian / weight[:, None]
    whole = np.concatenate([centre + size * hard, size * theta[d:]])
    # In outputs: r has no unit, so that the derivatives by h and D are those over the size.
    return Surface(whole, whitened * size, rows, size * sigma, find_inflation(whitened, orthonormal(rows), sigma), rest)


def fit_sphere(points: Array) -> tuple[Array, float]:
    """Return centre and radius of the sphere or circle through points (n, d), by algebraic least squares."""
    middle = points.mean(axis=0)
    spread = float(np.sqrt(((points - middle) ** 2).sum(axis=1).mean()))
    if not spread:
        raise np.linalg.LinAlgError
    scaled = (points - middle) / spread
    design = np.column_stack([2 * scaled, np.ones(len(points))])
    sphere = np.linalg.lstsq(design, (scaled**2).sum(axis=1))[0]
    radius = float(np.sqrt(max(sphere[-1] + float(sphere[:-1] @ sphere[:-1]), 1e-6)))
    return middle + spread * sphere[:-1], spread * radius


def _approach(outputs: Array, theta: Array) -> Array:
    """Return parameters near the least of Huber's loss of the residuals, by damped Gauss-Newton steps."""
    damping = _DAMPING
    r, jacobian, weight = evaluate(theta, outputs)
    for _ in range(_STEPS):
        x, rows = r / weight, jacobian / weight[:, None]
        limit = _HUBER * max(MAD_TO_SIGMA * median(np.abs(x)), 1e-12)
        root = np.sqrt(np.minimum(1.0, limit / np.maximum(np.abs(x), 1e-300)))
        normal = (rows * root[:, None]).T @ (rows * root[:, None])
        gradient = rows.T @ (root**2 * x)
        cost = _huber(x, limit)
        while True:
            step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
            try:
                next_r, next_jacobian, next_weight = evaluate(theta + step, outputs)
                better = _huber(next_r / weight, limit) <= cost * (1 + 1e-12)
            except np.linalg.LinAlgError:
                better = False
            if better or damping > 1e6:
                break
            damping *= 10
        if not better:
            break
        theta, r, jacobian, weight = theta + step, next_r, next_jacobian, next_weight
        damping = max(damping / 10, 1e-12)
        if float(np.abs(step).max()) < 1e-6:
            break
    return theta


def _huber(x: Array, limit: float) -> float:
    size = np.abs(x)
    return float(np.sum(np.where(size <= limit, x**2 / 2, limit * (size - limit / 2))))


def _scatter(r: Array, weight: Array, size: int) -> float:
    """Return sigma by the residuals."""
    return float(np.sqrt(((r / weight) ** 2).sum() / max(len(r) - size, 1)))


def orthonormal(rows: Array) -> Array:
    """Return orthonormal columns that span those of a matrix."""
    return np.linalg.qr(rows / np.linalg.norm(rows, axis=0))[0]


def find_inflation(whitened: Array, q: Array, sigma: float, blocks: int = BLOCKS) -> float:
    """Return by how much errors in common of readings in a row increase the covariance, 1 or more; q is orthonormal."""
    count = min(blocks, len(whitened) // LEAST_IN_BLOCK)
    if count < blocks // 2 or not sigma:
        return 1.0
    edges = np.linspace(0, len(whitened), count + 1).astype(np.intp)[:-1]
    scores = np.add.reduceat(q * whitened[:, None], edges, axis=0)
    shares = np.add.reduceat(q[:, :, None] * q[:, None, :], edges, axis=0)
    free = q.shape[1] - float((shares**2).sum())
    return float(np.maximum(1.0, (scores**2).sum() / (sigma**2 * max(free, 1.0))))


# What an ellipsoid leaves out: outputs that are not straight, and a hard iron that changed.


@dataclass(frozen=True)
class Unmodelled:
    """Terms that the residuals hold beside the parameters, tested together.

    Attributes
    ----------
    size
        Of each term, in outputs.
    probability
        Of terms as large where there are none.
    covariance
        What they leave open of theta, shape (p, p).
    first
        The reading from which they count.
    determined
        Whether the readings tell the size of each.
    """

    size: Array
    probability: float
    covariance: Array
    first: int = 0
    determined: bool = True


@dataclass(frozen=True)
class _Added:
    """The fit of added columns to what the parameters leave.

    Attributes
    ----------
    size, covariance
        Coefficients of the columns, shape (a,), and their covariance; 0 in directions that the readings do not tell.
    unknown
        Projector on these directions, shape (a, a).
    ratio, probability
        F of the columns together, and its probability where none of them is there.
    """

    size: Array
    covariance: Array
    unknown: Array
    ratio: float
    probability: float


def _test_added(q: Array, left: Array, columns: Array, least: float, *blocks: int) -> _Added:
    """Return the fit of columns beside orthonormal ones to what these leave.

    Of the columns, with length 1, directions count of which `least` or more is beside the parameters and each other.
    Errors that readings in a row have in common count, by the worst of some numbers of blocks.
    """
    norm = np.linalg.norm(columns, axis=0)
    base, part, turn = np.linalg.svd((columns - q @ (q.T @ columns)) / norm, full_matrices=False)
    kept = part > least
    base, back = base[:, kept], (turn[kept] / part[kept, None]).T / norm[:, None]
    count = base.shape[1]
    unknown = np.eye(len(norm)) - back @ np.linalg.pinv(back)
    if not count:
        return _Added(np.zeros(len(norm)), np.zeros_like(unknown), unknown, 0.0, 1.0)
    explained = base.T @ left
    both = np.hstack([q, base])
    remain = left - base @ explained
    sigma = float(np.sqrt((remain**2).sum() / (len(left) - both.shape[1])))
    inflation = max(find_inflation(remain, both, sigma, each) for each in blocks)
    ratio = float((explained**2).sum()) / max(count * inflation * sigma**2, 1e-300)
    freedom = max(len(left) / inflation - both.shape[1], 1.0)
    p = float(f_tail(ratio, float(count), freedom))
    return _Added(back @ explained, inflation * sigma**2 * back @ back.T, unknown, ratio, p)


def _left_over(theta: Array, outputs: Array) -> tuple[Array, Array, Array, Array]:
    """Return rows over the noise, orthonormal columns that span them, what these leave of the residuals, and |v|."""
    r, jacobian, weight = evaluate(theta, outputs)
    rows = jacobian / weight[:, None]
    q = orthonormal(rows)
    return rows, q, r / weight - q @ (q.T @ (r / weight)), weight


# Part of added terms, of length 1, beside the parameters and each other that counts. Noise of 0.25 % of the field makes
# 0.004 where there is nothing, soft iron 0.06 of third powers in a level turn; half a turn has 0.03 of a square.
_TOLD, _TOLD_AFTER = {2: 0.03, 3: 0.1}, 0.1


def find_bend(theta: Array, outputs: Array, power: int) -> Unmodelled:
    """Return by how much outputs bend with a power of the field along each axis, 2 or 3, at its full size.

    An output ``D m + h + k s^2``, s the field along its axis over the field, makes |m| follow ``k u^3``. Of this 3/5 u
    is as a hard iron is, and shows in no residual; the rest is of the third degree, which no ellipsoid has. So k is
    fitted by the rest, and what the surface took for its parameters is G k: it is uncertain by ``G (k k' + C) G'``.
    How much of it is real the data say by the ratio F of what k explains to noise: with ``k ~ N(0, t C)`` the most
    probable t is ``F - 1``, by which k is a part ``b = 1 - 1 / F`` of the one that was fitted, with covariance b C:
    ``b^2 k k' + b C`` counts for ``k k' + C``, nothing where F is below 1.

    With the third power ``u^4`` is divided between soft iron and the fourth degree. In a level turn those of both axes
    are alike: what readings do not tell of k is taken to be as large as what they do.
    """
    d = outputs.shape[1]
    rows, q, left, _ = _left_over(theta, outputs)
    soft = unpack(theta, d)[1]
    along = _directions(theta, outputs)[1] @ soft / np.abs(np.linalg.det(soft)) ** (1 / d)
    columns = -rows[:, :d] * along**power
    bend = _test_added(q, left, columns, _TOLD[power], BLOCKS)
    absorbed = np.linalg.lstsq(rows, columns)[0]
    real, size = 1 - 1 / max(bend.ratio, 1.0), bend.size
    square = real**2 * (np.outer(size, size) + size @ size * bend.unknown) + real * bend.covariance
    determined = float(np.trace(bend.unknown)) < 0.5  # its eigenvalues are 0 and 1
    return Unmodelled(size, bend.probability, absorbed @ square @ absorbed.T, determined=determined)


_LEAST_PART = 3  # blocks before and after a change


def find_change(theta: Array, outputs: Array) -> Unmodelled:
    """Return the most probable change of the hard iron from some reading on.

    A change of the hard iron shows in no mean of |m|. For each split the residuals are fitted by a change of the hard
    iron and of |m| after it, beside all parameters. The one that explains most is tested by F over what is left, with
    the errors that readings in a row have in common, times the number of splits. The hard iron before, or after, is off
    the fitted one by up to the greater part of the change.
    """
    d = outputs.shape[1]
    rows, q, left, weight = _left_over(theta, outputs)
    edges = np.linspace(0, len(left), BLOCKS + 1).astype(np.intp)[_LEAST_PART : BLOCKS - _LEAST_PART + 1].tolist()

    def after(edge: int) -> Array:
        columns = np.zeros((len(left), d + 1))
        columns[edge:] = np.column_stack([rows[edge:, :d], 1 / weight[edge:]])
        return columns

    def explained(edge: int) -> float:
        columns = after(edge)
        return float(((orthonormal(columns - q @ (q.T @ columns)).T @ left) ** 2).sum())

    first = max(edges, key=explained)
    added = _test_added(q, left, after(first), _TOLD_AFTER, BLOCKS, _LONG_BLOCKS)
    covariance = np.zeros((len(theta), len(theta)))
    greater = max(first, len(left) - first) / len(left)
    covariance[:d, :d] = np.outer(added.size[:d], added.size[:d]) * greater**2
    return Unmodelled(added.size[:d], min(added.probability * len(edges), 1.0), covariance, first)


# What the parameters leave open of the corrected field, and directions without readings.


_DIRECTIONS = 400  # over which uncertainties are averaged


def uncertainties(surface: Surface) -> tuple[float, float, float]:
    """Return standard uncertainties of the corrected field: of |m|, rms and largest over all directions; of direction.

    As parts of the field, and in rad. A rotation of all directions, which is not told, is not in the last.
    """
    along, across = direction_rows(surface.theta, even_directions(surface.dimension))
    covariance = surface.covariance
    magnitude = np.maximum(np.einsum("np,pq,nq->n", along, covariance, along), 0.0)
    direction = np.maximum(np.einsum("nip,pq,niq->n", across, covariance, across), 0.0)
    return float(np.sqrt(magnitude.mean())), float(np.sqrt(magnitude.max())), float(np.sqrt(direction.mean()))


def even_directions(dimension: int) -> Array:
    """Return directions spread evenly over the sphere (a spiral) or the circle, shape (400, d)."""
    k = np.arange(_DIRECTIONS) + 0.5
    if dimension == 2:
        angle = 2 * np.pi * k / _DIRECTIONS
        return np.column_stack([np.cos(angle), np.sin(angle)])
    up = 1 - 2 * k / _DIRECTIONS
    angle = np.pi * (1 + np.sqrt(5)) * k
    level = np.sqrt(1 - up**2)
    return np.column_stack([level * np.cos(angle), level * np.sin(angle), up])


def widest_gap(field: Array) -> tuple[float, Array]:
    """Return the angle, rad, of the direction farthest from all readings, shape (n, d), and that direction."""
    unit = field / np.linalg.norm(field, axis=1)[:, None]
    every = even_directions(field.shape[1])
    near = (every @ unit[:: max(1, len(unit) // 4000)].T).max(axis=1)
    worst = int(np.argmin(near))
    return float(np.arccos(np.clip(near[worst], -1, 1))), every[worst]


# Readings that do not belong to the others.

_WINDOWS = (1, 4, 16, 64)
_LEAST_WINDOWS = 24  # windows of one length that tell what is usual
_ROUNDS = 8


def find_disturbed(outputs: Array, least: int) -> tuple[Surface, NDArray[np.bool_]]:
    """Return the fit without readings that were disturbed, and which these are, shape (n,).

    Means of residuals over 1, 4, 16 and 64 readings are held against their own usual scatter, that of the median, so
    that errors that all readings have in common set none aside. `least` readings are kept.
    """
    aside = np.zeros(len(outputs), dtype=np.bool_)
    surface = fit_surface(outputs)
    for _ in range(_ROUNDS):
        r, _, weight = evaluate(surface.theta, outputs)
        marked = mark_far(r / weight, aside)
        if (marked == aside).all() or len(outputs) - int(marked.sum()) < least:
            break
        aside = marked
        surface = fit_surface(outputs[~aside])
    return surface, aside


def mark_far(x: Array, aside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the readings in windows whose mean residual is far from 0; a window's mean is of those not yet far."""
    far, single = np.zeros(len(x), dtype=np.bool_), 0.0
    for width in _WINDOWS:
        count = len(x) // width
        if count < _LEAST_WINDOWS:
            break
        near = (~far[: count * width]).reshape(count, width)
        left = near.sum(axis=1)
        means = (x[: count * width].reshape(count, width) * near).sum(axis=1) / np.maximum(left, 1)
        kept = means[~aside[: count * width].reshape(count, width).any(axis=1)]
        if len(kept) < _LEAST_WINDOWS // 2:
            break
        usual = MAD_TO_SIGMA * median(np.abs(kept))
        single = usual if width == 1 else single  # a median of few windows is uncertain: not below white noise
        limit = READINGS_SET_ASIDE.limit * max(usual, single / np.sqrt(width), 1e-12)
        bad = np.abs(means) * np.sqrt(left / width) > limit
        if width > 1:
            bad |= np.append(bad[1:], False) | np.append(False, bad[:-1])  # a disturbance comes and goes
        far[: count * width] |= np.repeat(bad, width)
    return far

"""Whole IMUs on a rigid board, fused sample by sample by plain least squares over all rows; with its simulator.

Everything is dense: the unknowns of a sample are the specific force s at the centroid of the accelerometers used, the
angular acceleration al and the rate w; the rows are the 3 K readings of accelerometers and the 3 K of gyroscopes, each
turned into the body frame. Source: Skog, Nilsson, Haendel, Nehorai, IEEE Trans. Signal Process. 64(16) 4218 (2016).
The rules for faulty triads are the project's own.
"""

from dataclasses import dataclass, field

import numpy as np


def skew(v):
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


@dataclass
class Board:
    """Ta, Tg (K, 3, 3), ba, bg, r (K, 3), noises and limits (K,), SI; `at` is where the force is wanted."""

    accel: np.ndarray
    accel_bias: np.ndarray
    accel_noise: np.ndarray
    gyro: np.ndarray
    gyro_bias: np.ndarray
    gyro_noise: np.ndarray
    position: np.ndarray
    accel_limit: np.ndarray
    gyro_limit: np.ndarray
    at: np.ndarray = field(default_factory=lambda: np.zeros(3))
    gate: float = 30.664849706213795  # scipy.stats.chi2.isf(1e-6, 3)
    stuck: int = 20
    quiet: int = 25

    def readings(self, force, rate, acceleration):
        """What the IMUs read without noise, (n, 2, K, 3), for the force at the origin."""
        w, al = np.asarray(rate)[:, None], np.asarray(acceleration)[:, None]
        felt = np.asarray(force)[:, None] + np.cross(al, self.position) + np.cross(w, np.cross(w, self.position))
        accel = np.einsum("kij,nkj->nki", self.accel, felt) + self.accel_bias
        return np.stack([accel, np.einsum("kij,nj->nki", self.gyro, np.asarray(rate)) + self.gyro_bias], axis=1)


def make_board(position, rng, *, accel_noise=0.03, gyro_noise=1.75e-3, limit=34.9):
    """A board with misalignments of 2 deg, scale factors of 1 %, cross-axis of .5 %, biases of .2 m/s^2 and 1 deg/s."""
    position = np.asarray(position, dtype=float)
    count = len(position)

    def matrices():
        turn = np.array([np.eye(3) + skew(rng.normal(0, np.radians(2.0), 3)) for _ in range(count)])
        scale = np.eye(3) + 0.01 * rng.normal(size=(count, 3, 1)) * np.eye(3)
        return turn @ (scale + rng.normal(0, 0.005, (count, 3, 3)))

    accel, gyro = matrices(), matrices()
    noises = [noise * np.ones(count) for noise in (accel_noise, gyro_noise)]
    return Board(
        accel, rng.normal(0, 0.2, (count, 3)), noises[0], gyro, np.radians(rng.normal(0, 1.0, (count, 3))), noises[1],
        position, np.full(count, 1e4), np.full(count, limit), np.average(position, axis=0, weights=noises[0] ** -2.0),
    )  # fmt: skip


class Fusion:
    """The law of the C core; `step` returns 18 numbers, whether bridged, accelerometers and gyroscopes used."""

    def __init__(self, board):
        self.board = board
        count = len(board.position)
        self.owed = np.zeros((2, count), dtype=int)
        self.repeats = np.zeros((2, count), dtype=int)
        self.changed = np.zeros((2, count), dtype=int)
        self.compared = np.zeros((2, count), dtype=int)
        self.last = np.full((2, count, 3), np.nan)
        self.before = self.turned = None

    def step(self, dt, reading):
        b = self.board
        usable = np.isfinite(reading).all(axis=2)
        self._count(reading, usable)
        clipped = np.abs(reading[1]) >= b.gyro_limit[:, None]
        usable[0] &= (np.abs(reading[0]) < b.accel_limit[:, None]).all(axis=1)
        for sensor in range(2):
            self._stuck(sensor, usable[sensor])
        body = [np.linalg.solve(t, (y - c)[..., None])[..., 0]
                for t, y, c in zip((b.accel, b.gyro), reading, (b.accel_bias, b.gyro_bias), strict=False)]  # fmt: skip
        gyros, rate, bridged = self._gyroscopes(body[1], usable[1], clipped)
        turning, spread, trusted = self._turning(rate, bridged, gyros, dt)
        accels = self._accelerometers(body[0], usable[0], rate, bridged, turning if trusted else None, spread)
        out = np.full(18, np.nan)
        if rate is not None and len(accels):
            out = self._solve(body, accels, gyros, clipped, rate, bridged, turning, spread)
        return out, bridged, accels, gyros

    def _turning(self, rate, bridged, gyros, dt):
        """Backward difference of the gyroscopes' rate, its variance by noise and delay, whether that is known."""
        known = rate is not None and not bridged
        turning, spread, before = None, np.inf, self.turned
        if known and self.before is not None and dt > 0:
            turning = (rate - self.before) / dt
            late = np.square(turning - (0 if before is None else before)).sum() / 4
            spread = 2 / ((self.board.gyro_noise[gyros] ** -2.0).sum() * dt**2) + late
        self.before, self.turned = rate if known else None, turning
        return turning, spread, turning is not None and before is not None

    def _count(self, reading, usable):
        for sensor, k in np.argwhere(usable):
            if self.compared[sensor, k] and (reading[sensor, k] == self.last[sensor, k]).all():
                self.repeats[sensor, k] += 1
            else:
                self.repeats[sensor, k] = 0
                self.changed[sensor, k] += self.compared[sensor, k] > 0
            self.compared[sensor, k] += 1
            self.last[sensor, k] = reading[sensor, k]

    def _stuck(self, sensor, usable):
        long = self.repeats[sensor] >= self.board.stuck
        shares = self.changed[sensor] / np.maximum(self.compared[sensor] - 1 - self.repeats[sensor], 1)
        alive = usable & ~long
        for k in np.flatnonzero(usable & long):
            share = shares[k] if self.changed[sensor, k] else shares[alive].mean() if alive.any() else 0.0
            if alive.any() and self.repeats[sensor, k] * share >= 20:
                usable[k] = False
                self.owed[sensor, k] = self.board.quiet

    def _candidates(self, sensor, usable):
        free = np.flatnonzero(usable & (self.owed[sensor] == 0))
        return free if len(free) else np.flatnonzero(usable)

    def _blame(self, sensor, k):
        self.owed[sensor, k] = min(self.owed[sensor, k] + 4, self.board.quiet)

    def _gyroscopes(self, rates, usable, clipped):
        b = self.board
        used = self._candidates(1, usable)
        whole = used[~clipped[used].any(axis=1)]
        blamed = []
        weight = b.gyro_noise**-2.0
        apart = 0.0 if self.turned is None else (1.5e-3) ** 2 * (self.turned @ self.turned)
        while len(whole) > 2:
            mean = np.average(rates[whole], axis=0, weights=weight[whole])
            squares = weight[whole] * np.square(rates[whole] - mean).sum(axis=1)
            chi = squares / (1 - weight[whole] / weight[whole].sum())
            worst = int(np.argmax(chi))
            rest = (squares.sum() - chi[worst]) / (3 * len(whole) - 6)
            if not chi[worst] > b.gate * max(1.0, rest) or np.square(rates[whole[worst]] - mean).sum() <= apart:
                break
            blamed.append(whole[worst])
            self._blame(1, whole[worst])
            whole = np.delete(whole, worst)
        used = np.array([k for k in used if k not in blamed], dtype=int)
        if len(whole):
            mean = np.average(rates[whole], axis=0, weights=weight[whole])
            squares = (weight[whole] * np.square(rates[whole] - mean).sum(axis=1)).sum()
            usual = max(1.0, squares / (3 * len(whole) - 3)) if len(whole) > 1 else 1.0
            for k in np.flatnonzero(usable & (self.owed[1] > 0) & ~clipped.any(axis=1)):
                if k in blamed:
                    continue
                chi = np.square(rates[k] - mean).sum() / (1 / weight[k] + 1 / weight[whole].sum())
                if chi <= b.gate * usual or np.square(rates[k] - mean).sum() <= apart:
                    self.owed[1, k] -= 1
                elif k not in used:
                    self._blame(1, k)
        if not len(used):
            return used, None, False
        return used, np.average(rates[used], axis=0, weights=weight[used]), bool(clipped[used].any())

    def _design(self, members):
        """Weights, centroid, lever arms, and the axes about which they tell no angular acceleration."""
        b = self.board
        weight = b.accel_noise[members] ** -2.0
        centre = np.average(b.position[members], axis=0, weights=weight)
        rho = b.position - centre
        moments, axes = np.linalg.eigh(np.einsum("k,ki,kj->ij", weight, rho[members], rho[members]))
        lengths = moments > 1e-5 * max(moments.sum(), 1e-300)
        line = axes[:, ~(np.array([lengths[[1, 2]].any(), lengths[[0, 2]].any(), lengths[[0, 1]].any()]))]
        return weight, centre, rho, line

    def _fit(self, forces, members, rate, turning):
        """A dense fit of s and, where it is not known, al: columns, residuals, covariance, and what is known of al."""
        weight, _, rho, line = self._design(members)
        by_gyros = len(members) < 4 or line.shape[1] > 0
        if by_gyros and turning is None:
            return None
        columns = np.array([np.eye(3) if by_gyros else np.hstack([np.eye(3), -skew(r)]) for r in rho])
        known = turning if by_gyros else np.zeros(3)
        target = forces - rho @ (skew(rate) @ skew(rate) + skew(known)).T
        a, y, w = np.vstack(columns[members]), target[members].ravel(), np.repeat(weight, 3)
        covariance = np.linalg.inv(a.T @ (w[:, None] * a))
        residual = target - columns @ (covariance @ a.T @ (w * y))
        return residual, columns @ covariance @ np.swapaxes(columns, 1, 2), rho, by_gyros, len(y) - a.shape[1]

    def _chi(self, fit, members, k, spread):
        """Chi-square of triad k against the members."""
        residual, owed, rho, by_gyros, _ = fit
        variance = self.board.accel_noise[k] ** 2
        cov = variance * np.eye(3) + (-owed[k] if k in members else owed[k])
        chi = residual[k] @ np.linalg.pinv(cov) @ residual[k]
        return chi / (1 + spread * (rho[k] @ rho[k]) / variance) if by_gyros else chi

    def _accelerometers(self, forces, usable, rate, bridged, turning, spread):
        members = list(self._candidates(0, usable))
        blamed = []
        if not members or rate is None or bridged:
            return members
        while True:
            fit = self._fit(forces, members, rate, turning)
            if fit is None:
                return members
            squares = sum(fit[0][m] @ fit[0][m] / self.board.accel_noise[m] ** 2 for m in members)
            chi = [self._chi(fit, members, k, spread) for k in members]
            worst = int(np.argmax(chi))
            rest = (squares - chi[worst]) / max(fit[4] - 3, 1)
            if len(members) < 3 or not chi[worst] > self.board.gate * max(1.0, rest):
                break
            blamed.append(members.pop(worst))
            self._blame(0, blamed[-1])
        usual = max(1.0, squares / fit[4]) if fit[4] > 0 else 1.0
        for k in np.flatnonzero(usable & (self.owed[0] > 0)):
            if k in blamed:
                continue
            if k in members or self._chi(fit, members, k, spread) <= self.board.gate * usual:
                self.owed[0, k] -= 1
            else:
                self._blame(0, k)
        return members

    def _solve(self, body, accels, gyros, clipped, rate, bridged, turning, spread):
        """Gauss-Newton on (s, al, w) over all rows; a direction of al that no row has is held at 0 or at `turning`."""
        b = self.board
        weight, centre, rho, line = self._design(accels)
        q = b.gyro_noise**-2.0
        rows = np.array([(q[k], *b.gyro[k][i], b.gyro[k][i] @ body[1][k])
                         for k in gyros for i in range(3) if not clipped[k, i]]).reshape(-1, 5)  # fmt: skip
        if not bridged:  # each triad of gyroscopes is one reading of the rate
            rows = np.array([(q[k], *np.eye(3)[i], body[1][k][i]) for k in gyros for i in range(3)])
        free = np.linalg.svd(line.T)[2][line.shape[1] :].T if line.shape[1] else np.eye(3)
        w, s, al = rate.copy(), None, None
        for _ in range(4 if bridged else 1):
            lever = [skew(w) @ skew(w) @ r for r in rho]
            a = np.vstack([np.hstack([np.eye(3), -skew(rho[m]) @ free]) for m in accels])
            y = np.concatenate([body[0][m] - lever[m] for m in accels])
            root = np.sqrt(np.repeat(weight, 3))
            start = np.linalg.lstsq(root[:, None] * a, root * y, rcond=None)[0]
            slope = [(w @ rho[m]) * np.eye(3) + np.outer(w, rho[m]) - 2 * np.outer(rho[m], w) for m in accels]
            top = np.hstack([a, np.vstack(slope)]) * root[:, None]
            below = np.hstack([np.zeros((len(rows), a.shape[1])), rows[:, 1:4]]) * np.sqrt(rows[:, :1])
            h = np.vstack([top, below])
            e = np.concatenate([root * (y - a @ start), np.sqrt(rows[:, 0]) * (rows[:, 4] - rows[:, 1:4] @ w)])
            covariance = np.linalg.inv(h.T @ h)
            step = covariance @ h.T @ e
            n = 3 + free.shape[1]
            s, al, w = (start + step[:n])[:3], free @ (start + step[:n])[3:], w + step[n:]
        lost = len(accels) < len(b.position) and turning is not None
        known = line.shape[1] and lost
        if known:
            al = al + line @ (line.T @ turning)
        spot = np.zeros((9, covariance.shape[0]))
        spot[:3, :3], spot[3:6, 3:n], spot[6:, n:] = np.eye(3), free, np.eye(3)
        full = spot @ covariance @ spot.T
        if known:
            full[3:6, 3:6] += spread * line @ line.T
        d = b.at - centre
        force = s + (skew(w) @ skew(w) + skew(al)) @ d
        at = np.hstack([np.eye(3), -skew(d), (w @ d) * np.eye(3) + np.outer(w, d) - 2 * np.outer(d, w)])
        out = np.concatenate([force, w, al, np.sqrt(np.diag(at @ full @ at.T)), np.sqrt(np.diag(full)[6:]),
                              np.sqrt(np.diag(full)[3:6])])  # fmt: skip
        if not known:
            for v in line.T:
                out[6:9][np.abs(v) > 1e-3] = out[15:18][np.abs(v) > 1e-3] = np.nan
                arm = np.abs(np.cross(v, d)) > 1e-6
                out[0:3][arm] = out[9:12][arm] = np.nan
        return out


def hand_motion(n, step, rng, *, size=6.0):
    """Force at the origin, rate and angular acceleration of a board turned and shaken by hand, (n, 3) each."""
    t = np.arange(n) * step
    rate, acceleration, force = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
    for axis in range(3):
        for f in (0.31, 0.7, 1.3, 2.6):
            a, phase = size / 2 * rng.uniform(0.5, 1.0), rng.uniform(0, 2 * np.pi)
            rate[:, axis] += a * np.sin(2 * np.pi * f * t + phase)
            acceleration[:, axis] += a * 2 * np.pi * f * np.cos(2 * np.pi * f * t + phase)
            force[:, axis] += 8 * rng.uniform(0.2, 1.0) * np.sin(2 * np.pi * f * t + rng.uniform(0, 6))
    return force, rate, acceleration


CUBE = 0.02 * np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], dtype=float)
FOUR = 0.02 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=float)
PLANE = 0.02 * np.array([[x, y, 0] for y in (-1, 0, 1) for x in (-1, 0, 1)], dtype=float)

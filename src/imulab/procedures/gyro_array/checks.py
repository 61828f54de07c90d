"""What readings say of an array before any alignment: dead gyros, mixed units, elements mounted otherwise."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from imulab.recording import Array
from imulab.verdict import Bad

_FEWEST = 100  # samples
_EVERY_ROW, _THINNED = 20_000, 16
_FOLLOWS = 0.81
"""Share of a gyro's variance that the first element must explain: a correlation of 0.9."""
_ONE_AXIS = 0.8  # of what is explained
_APART = 20.0
_WITHIN = 8.0
_FACTORS = {
    180 / math.pi: "rad/s labelled deg/s, or the other way round",
    3600.0: "deg/h labelled deg/s, or the other way round",
    3600 * 180 / math.pi: "rad/s labelled deg/h, or the other way round",
    1000.0: "thousandths, or the other way round",
}
_NEAR = 1.6
_UNTURNED = "array calibrate --moving finds it, and --calibration puts it right"

Map = tuple[tuple[int, int] | None, ...]
"""For each axis of an element the axis of the reference that it reads and the sign, or None where nothing tells."""


@dataclass
class Checks:
    """Watches the readings of an array, block by block."""

    names: Sequence[Sequence[str]]
    seen: int = 0
    count: int = 0
    moments: list[Array] = field(default_factory=list)
    pivot: Array | None = None
    last: Array | None = None
    first: Array | None = None
    still: np.ndarray | None = None
    twins: list[tuple[int, int]] | None = None

    def watch(self, readings: Array) -> None:
        """Add readings, shape (m, axes, n); rows with a reading that is not finite do not count for the moments.

        The moments are of every row of the first 20,000, and of every 16th after them.
        """
        rows, axes, n = readings.shape
        if not rows:
            return
        flat = readings.reshape(rows, axes * n)
        self._watch_still(flat)
        self._watch_twins(flat, n)
        number = np.arange(self.seen, self.seen + rows)
        chosen = np.flatnonzero((number < _EVERY_ROW) | (number % _THINNED == 0))
        self.seen += rows
        if not chosen.size:
            self.last = flat[-1]
            return
        before = flat[np.maximum(chosen - 1, 0)]
        if chosen[0] == 0:
            before[0] = np.nan if self.last is None else self.last
        self.last = flat[-1]
        part = flat[chosen]
        fine = np.isfinite(part).all(axis=1)
        part = part[fine]
        step = part - before[fine]
        if not len(part):
            return
        if self.pivot is None:
            self.pivot = part[0]  # moments about it: a constant has none, to the last bit
        part = part - self.pivot
        step[~np.isfinite(step).all(axis=1)] = 0.0
        found = [
            part.sum(axis=0).reshape(axes, n),
            np.einsum("mk,mk->k", part, part).reshape(axes, n),
            (part.T @ part[:, ::n]).reshape(axes, n, axes),
            np.einsum("mk,mk->k", step, step).reshape(axes, n),
        ]
        self.moments = [a + b for a, b in zip(self.moments, found, strict=True)] if self.moments else found
        self.count += len(part)

    def _watch_still(self, flat: Array) -> None:
        """Keep the gyros that have read one number so far."""
        if self.still is None or self.first is None:
            self.still, self.first = np.ones(flat.shape[1], dtype=bool), np.full(flat.shape[1], np.nan)
        for k in np.flatnonzero(self.still).tolist():
            column = flat[np.isfinite(flat[:, k]), k]
            if len(column):
                self.first[k] = column[0] if np.isnan(self.first[k]) else self.first[k]
                self.still[k] = bool((column == self.first[k]).all())

    def _watch_twins(self, flat: Array, n: int) -> None:
        """Keep the pairs of an axis that have read the same so far, by their places among the columns."""
        if self.twins is None:
            self.twins = [(i, j) for i in range(flat.shape[1]) for j in range(i + 1, (i // n + 1) * n)]
        self.twins = [
            (i, j)
            for i, j in self.twins
            if np.array_equal(flat[:1, i], flat[:1, j], equal_nan=True)
            and np.array_equal(flat[:, i], flat[:, j], equal_nan=True)
        ]

    def lines(self, *, turned: bool = True, known: Collection[str] = ()) -> list[str]:
        """Return what there is to say; of `turned` elements only if asked, and not of dead gyros `known` already."""
        found = self.dead(known) + self.doubled() + self.units()
        if turned:
            found += [f"{line}: mounted the other way round? {_UNTURNED}" for line in self.turned()]
        return found

    def dead(self, known: Collection[str] = ()) -> list[str]:
        """Return a line on gyros whose readings never change, and one on axes without any that do."""
        if self.still is None or self.first is None or self.seen < _FEWEST:
            return []
        still = (self.still & np.isfinite(self.first)).reshape(len(self.names), -1)
        found: list[str] = []
        for row, dead in zip(self.names, still, strict=True):
            named = [name for name, gone in zip(row, dead, strict=True) if gone]
            if len(named) == len(row):
                found.append(
                    Bad(f"{_listed(named)}: no reading ever changes: all gyros are dead, and so is the result")
                )
            elif set(named) - set(known):
                found.append(f"{' '.join(n for n in named if n not in known)}: no reading ever changes: a dead gyro")
        return found

    def doubled(self) -> list[str]:
        """Return a line on gyros that read the same throughout: one that was logged twice counts twice."""
        if self.still is None or self.first is None or self.seen < _FEWEST:
            return []
        flat = [name for row in self.names for name in row]
        live = ~self.still
        return [
            Bad(f"{flat[i]} and {flat[j]} read the same throughout: one gyro, logged twice? It counts as two")
            for i, j in self.twins or []
            if live[i]
        ]

    def units(self) -> list[str]:
        """Return a line where the readings of an axis fall into two groups of very different size."""
        if self.count < _FEWEST:
            return []
        spread, explained = self._spread()
        found: list[str] = []
        for a, row in enumerate(self.names):
            if len(row) < 2:
                continue
            moves = bool(np.median(explained[a]) > _FOLLOWS)
            size = spread[a] if moves else np.sqrt(self.moments[3][a] / self.count)
            alive = np.flatnonzero(size > 0)
            order = alive[np.argsort(size[alive])]
            ordered = np.log(size[order])
            if len(order) < 2:
                continue
            cut = int(np.argmax(np.diff(ordered))) + 1
            low, high = ordered[:cut], ordered[cut:]
            if high[0] - low[-1] < math.log(_APART) or max(np.ptp(low), np.ptp(high)) > math.log(_WITHIN):
                continue
            ratio = math.exp(float(high.mean() - low.mean()))
            likely = [text for factor, text in _FACTORS.items() if 1 / _NEAR < ratio / factor < _NEAR]
            smaller, larger = (" ".join(row[i] for i in sorted(part.tolist())) for part in (order[:cut], order[cut:]))
            what = "readings" if moves else "noise"
            kind = Bad if moves or min(cut, len(order) - cut) > 1 else str
            found.append(
                kind(
                    f"the {what} of {larger} is {ratio:.3g} times as large as that of {smaller}: another unit"
                    f"{f' ({likely[0]})' if likely else ''} or another kind of gyro? Unlike units must not be fused"
                )
            )
        return found

    def turned(self) -> list[str]:
        """Return a line for each way in which elements are mounted unlike the others, or wired."""
        maps = self.maps()
        if not maps:
            return []
        axes = len(self.names)
        plain: Map = tuple((a, 1) for a in range(axes))
        votes = Counter(found for found in maps if None not in found)
        usual = max(votes, key=lambda found: (votes[found], found == plain), default=plain)
        back = {found: (a, found[1]) for a, found in enumerate(usual) if found is not None}
        origin = {axis: (a, sign) for (axis, sign), (a, _) in back.items()}
        told: dict[Map, list[int]] = {}
        for i, found in enumerate(maps):
            seen: Map = tuple(None if one is None else (origin[one[0]][0], one[1] * origin[one[0]][1]) for one in found)
            if any(one is not None and one != plain[a] for a, one in enumerate(seen)):
                told.setdefault(seen, []).append(i)
        others = "first gyro of the axis" if usual == plain else "other gyros of the axis"
        lines = []
        for seen, elements in told.items():
            if axes == 1:
                verb = "turns" if len(elements) == 1 else "turn"
                lines.append(f"{' '.join(self.names[0][i] for i in elements)} {verb} against the {others}")
                continue
            numbers = " ".join(str(i + 1) for i in elements)
            reads = ", ".join(
                f"{'xyz'[a]} reads {'+' if one[1] > 0 else '-'}{'xyz'[one[0]]}"
                for a, one in enumerate(seen)
                if one is not None and one != plain[a]
            )
            against = "the first" if usual == plain else "most elements"
            lines.append(
                f"element{'s' * (len(elements) > 1)} {numbers} ({self.names[0][elements[0]]} ..): {reads} of {against}"
                f"{_mirrored(seen)}"
            )
        return lines

    def maps(self) -> list[Map]:
        """Return for each element which axis of the first it reads on each of its own, where motion tells."""
        if self.count < _FEWEST or not np.isfinite(self.moments[1]).all():
            return []
        axes, n = self.moments[0].shape
        own, cross = self._covariance()
        inner = own[:, 0]
        weights = np.linalg.lstsq(_regular(cross[:, 0]), np.moveaxis(cross, 2, 0).reshape(axes, -1), rcond=None)[0]
        weights = np.moveaxis(weights.reshape(axes, axes, n), 0, 2)
        explained = np.einsum("aib,aib->ai", weights, cross)
        shares = weights**2 * inner
        found: list[Map] = []
        for i in range(n):
            row: list[tuple[int, int] | None] = []
            for a in range(axes):
                axis = int(np.argmax(shares[a, i]))
                sure = (
                    own[a, i] > 0
                    and explained[a, i] > _FOLLOWS * own[a, i]
                    and shares[a, i, axis] > _ONE_AXIS * shares[a, i].sum()
                )
                row.append((axis, 1 if weights[a, i, axis] > 0 else -1) if sure else None)
            read = [one[0] for one in row if one is not None]
            found.append(tuple(row) if len(set(read)) == len(read) else (None,) * axes)
        return found

    def _covariance(self) -> tuple[Array, Array]:
        """Variance of each gyro, shape (axes, n), and covariance with the axes of element 1, (axes, n, axes)."""
        mean, square, product = (moment / self.count for moment in self.moments[:3])
        own = np.maximum(square - mean * mean, 0.0)
        return own, product - mean[:, :, None] * mean[None, None, :, 0]

    def _spread(self) -> tuple[Array, Array]:
        """Standard deviation of each gyro, (axes, n), and share of the others that goes with an axis of element 1."""
        own, cross = self._covariance()
        both = own[:, :, None] * own[None, None, :, 0]
        share = np.where(both > 0, cross**2 / np.where(both > 0, both, 1.0), 0.0).max(axis=2)
        return np.sqrt(own), share[:, 1:]


def _regular(matrix: Array) -> Array:
    return matrix + 1e-9 * max(float(np.trace(matrix)), 1e-300) * np.eye(len(matrix))


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"


def _mirrored(seen: Map) -> str:
    """Say that a known map is left-handed."""
    if any(one is None for one in seen):
        return ""
    matrix = np.zeros((len(seen), len(seen)))
    for a, one in enumerate(seen):
        if one is not None:
            matrix[a, one[0]] = one[1]
    return (
        " (left-handed, which no mounting does: columns interchanged or reversed)" if np.linalg.det(matrix) < 0 else ""
    )

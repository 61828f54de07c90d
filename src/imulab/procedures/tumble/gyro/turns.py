"""The turns between holds: which can be used, what the gyroscopes say of them, and how that moves with the parameters.

Source of the change of a turn with the rate: Bortz, IEEE Trans. AES-7 (1971) 61.
"""

from __future__ import annotations

import numpy as np
from msgspec import Struct
from msgspec.structs import asdict, replace
from numpy.typing import NDArray

from imulab.display import Finding, Note
from imulab.errors import SegmentError
from imulab.estimation.rows import median, quantile
from imulab.estimation.sampling import TOO_SLOW, doubt_unit_of_time
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.gyro.rotation import Turns, composed_turns, weighted_turns
from imulab.procedures.tumble.gyro.windows import Readings, Windows, pieces_of, read_between
from imulab.recording import Array

ROWS, COLUMNS = (0, 0, 1, 1, 2, 2), (1, 2, 0, 2, 0, 1)  # of the six misalignments in their matrix
_FEWEST_TURNS = 8  # turns that tell nine parameters, two equations each
_LONGEST_TURN = 60.0  # s
_AROUND = 0.1  # s: by as much segmentation may see a turn later, or end it earlier, than the gyroscopes
# S, usual steps, and usual bursts of steps: a gap in a turn loses part of it
_GAP_SECONDS, _GAP_STEPS, _GAP_BURSTS = 0.05, 4.5, 2.0
_FEW_BROKEN = 0.1  # of the turns: the others are as good without them
_COARSE = 8  # pieces of steps taken as one where a scale factor is only to be found roughly
_STEP = 1e-9  # s^2, s^3: of a numerical derivative
_START_FACTORS = np.geomspace(0.4, 1.25, 24)


class Segments(Struct, frozen=True):
    """Turns as pieces of steps between samples: output less what acceleration adds, (m, n, 3), and durations, (m, n).

    The durations are weighted by the ramp of each turn (`windows`). `before` and `after` are the upward directions at
    both ends, (m, 3); `start` and `stop` are where the hold before ends and the next one begins, s, (m,).
    """

    output: Array
    half: Array
    """Half the difference of the two readings of the output, (m, n, 3)."""
    step: Array
    squared: Array
    """Integral of the squared ramp, s, (m,): by this times its density, noise of the rate moves a direction, rad^2."""
    before: Array
    after: Array
    start: Array
    stop: Array
    attitude: NDArray[np.intp]
    """Index of the attitude before each turn; the one after it is the next."""

    def part(self, chosen: NDArray[np.intp] | NDArray[np.bool_]) -> Segments:
        """Return some of the turns."""
        return Segments(**{name: values[chosen] for name, values in asdict(self).items()})


class Stamps(Struct, frozen=True):
    """Times of the gyroscopes' samples, s, (n,): by the clock that measures the turns, and on the accelerometers'."""

    time: Array
    on_accel: Array


class Span(Struct, frozen=True):
    """Turns from windows to later ones, (m,), as pieces of steps between samples, whatever the output in them.

    `first` and `last` are their samples; the durations, (m, n), are weighted by the ramp. The other fields are those of
    `Segments`.
    """

    first: NDArray[np.intp]
    last: NDArray[np.intp]
    pieces: int
    step: Array
    squared: Array
    start: Array
    stop: Array
    attitude: NDArray[np.intp]

    def read(self, values: Array) -> Readings:
        """Return columns of the recording's samples, (n, 3), in the pieces."""
        return read_between(values, self.first, self.last, self.pieces)

    def whole_steps(self) -> Span:
        """Return it with the pieces of each step taken as one."""
        return replace(self, pieces=1, step=self.step.reshape(len(self.step), -1, self.pieces).sum(axis=2))

    def over_steps(self, values: Array) -> Array:
        """Return the means of values in the pieces, (m, n, 3), over the steps."""
        shape = (len(self.step), -1, self.pieces)
        size = np.maximum(self.step.reshape(shape).sum(axis=2), 1e-300)[:, :, None]
        return np.asarray(np.einsum("mnp,mnpc->mnc", self.step.reshape(shape) / size, values.reshape(*shape, 3)))

    def segments(self, output: Array, half: Array, up: tuple[Array, Array]) -> Segments:
        """Return the turns of an output and half the difference of its readings, with the directions at both ends."""
        return Segments(output, half, self.step, self.squared, *up, self.start, self.stop, self.attitude)


def span_between(stamps: Stamps, windows: tuple[Windows, Windows], attitude: NDArray[np.intp]) -> Span:
    """Return the turns from windows to later ones, (m,) each; `attitude` are the indices of those before each turn."""
    (first, last), clock, final = windows, stamps.on_accel, len(stamps.time) - 1
    begin = np.maximum(np.searchsorted(clock, first.start) - 1, 0)
    end = np.minimum(np.searchsorted(clock, last.stop), final)
    steps, pieces = max(int((end - begin).max()), 1), pieces_of(median(np.diff(stamps.time)))
    index = begin[:, None] + np.arange(steps)
    here, there = np.minimum(index, final), np.minimum(index + 1, final)
    share, shape = (np.arange(pieces) + 0.5) / pieces, (len(begin), steps * pieces)
    placed = (clock[here][:, :, None] + (clock[there] - clock[here])[:, :, None] * share).reshape(shape)
    ramp = first.weight(placed) - last.weight(placed)
    duration = np.where(index < end[:, None], stamps.time[there] - stamps.time[here], 0.0) / pieces
    duration = np.repeat(duration, pieces, axis=1)
    edges = [stamps.time[np.minimum(np.searchsorted(clock, at), final)] for at in (first.stop, last.start)]
    return Span(begin, end, pieces, ramp * duration, (ramp**2 * duration).sum(axis=1), edges[0], edges[1], attitude)


def choose_turns(
    attitudes: Attitudes, stamps: Stamps, beyond: NDArray[np.bool_], name: str
) -> tuple[NDArray[np.intp], list[str]]:
    """Return the attitudes after which a turn can be used, and notes on turns that cannot: clipped ones, and gaps.

    `beyond` says which samples are clipped (`beyond_range`), (n, 3).

    Raises
    ------
    SegmentError
        Fewer than eight turns can be used.
    """
    leave, arrive = attitudes.stop[:-1], attitudes.start[1:]
    final = len(stamps.time) - 1
    begin = np.maximum(np.searchsorted(stamps.on_accel, leave - _AROUND), 0)
    end = np.minimum(np.searchsorted(stamps.on_accel, arrive + _AROUND), final)
    begin = np.minimum(begin, end)
    time = stamps.time
    turns = (end > begin) & (arrive - leave <= _LONGEST_TURN)
    clipped = _any_during(beyond, begin, end) & turns[:, None]
    step = np.diff(time)
    # What lies in a gap is taken as a straight line: no turn is known to a milliradian across a longer one.
    usual = median(step), quantile(step, 0.99)  # the second where stamps come in bursts
    wide = step > max(_GAP_SECONDS, _GAP_STEPS * usual[0], _GAP_BURSTS * usual[1])
    broken = _any_during(np.append(wide, False)[:, None], begin, np.maximum(end - 1, begin))[:, 0] & turns
    chosen = np.flatnonzero(turns & ~clipped.any(axis=1) & ~broken)
    notes: list[str] = []

    def times(which: NDArray[np.bool_]) -> str:
        where = np.flatnonzero(which)
        return " ".join(f"{t:.1f}" for t in leave[where[:6]].tolist()) + (" ..." if len(where) > 6 else "")

    def count(which: NDArray[np.bool_]) -> str:
        number = int(which.sum())
        return f"{number} turn{'' if number == 1 else 's'}"

    if clipped.any():
        axes = " ".join(f"gyro_{'xyz'[axis]}" for axis in range(3) if clipped[:, axis].any())
        which = np.asarray(clipped.any(axis=1))
        notes.append(
            Finding(
                f"gyro: {count(which)} left out, clipped: {axes} stay at the end of their range (from {times(which)} "
                "s)",
                "turn more slowly, or set the gyroscopes to a larger range, and record again",
            )
        )
    if broken.any():
        longest = float(step[wide].max())
        sentence = Finding(
            f"gyro: {count(broken)} left out, samples are missing during them: gaps of up to {longest:.3g} s "
            f"(turns from {times(broken)} s)",
            "record again without lost samples, by a faster link or at a lower rate",
        )
        notes.append(Note(sentence) if broken.sum() <= _FEW_BROKEN * turns.sum() else sentence)
    if len(chosen) < _FEWEST_TURNS:
        unit, duration = attitudes.recording.units["time"], float(time[-1] - time[0])
        if doubt := doubt_unit_of_time(unit, 1 / usual[0], duration, rare=1 / usual[0] <= TOO_SLOW):
            raise SegmentError(f"{name}: {doubt} --unit time=UNIT states it")
        aside = f" ({int(clipped.any(axis=1).sum())} more are clipped)" if clipped.any() else ""
        aside += f" ({int(broken.sum())} more have gaps)" if broken.any() else ""
        tilt = "" if len(chosen) else ": the unit was never tilted"
        raise SegmentError(
            f"{name}: {len(chosen)} turns between attitudes{aside}{tilt}; expected at least {_FEWEST_TURNS}"
        )
    return chosen, notes


def _any_during(flags: NDArray[np.bool_], first: NDArray[np.intp], last: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Whether a flag (n, k) is up from sample `first` to sample `last`, both (m,); shape (m, k)."""
    count = np.vstack([np.zeros((1, flags.shape[1]), dtype=np.int64), np.cumsum(flags, axis=0)])
    result: NDArray[np.bool_] = count[np.maximum(last, first) + 1] > count[first]
    return result


def start_scale(segments: Segments) -> Array:
    """Return the output per rad/s to start from, what makes the turns fit best with ideal axes, shape (3,)."""
    angle = np.arccos(np.clip(np.einsum("mi,mi->m", segments.before, segments.after), -1, 1))
    turned = np.linalg.norm((segments.output * segments.step[:, :, None]).sum(axis=1), axis=1)
    # A turn goes at least as far as the direction of gravity does.
    guess = median((turned / np.maximum(angle, 1e-3))[angle > 0.3]) if (angle > 0.3).any() else 1.0
    few = slice(None, 40)
    angle_steps = segments.output[few] * segments.step[few, :, None]
    missing = -angle_steps.shape[1] % _COARSE
    coarse = np.pad(angle_steps, ((0, 0), (0, missing), (0, 0))).reshape(len(angle_steps), -1, _COARSE, 3).sum(axis=2)
    costs = []
    for factor in _START_FACTORS:
        miss = (
            np.einsum("mij,mj->mi", composed_turns(coarse / (guess * factor)), segments.before[few])
            - segments.after[few]
        )
        costs.append(median(np.linalg.norm(miss, axis=1)))
    return np.full(3, guess * float(_START_FACTORS[int(np.argmin(costs))]))


def by_directions(segments: Segments, scale: Array, theta: Array, holds: int) -> Array:
    """Return the derivatives of the residuals by the upward directions of all holds, shape (3 m, 3 holds)."""
    m = len(segments.before)
    spread = np.zeros((m, 3, holds, 3))
    spread[range(m), :, segments.attitude, :] = carried(segments, scale, theta)
    spread[range(m), :, segments.attitude + 1, :] -= np.eye(3)
    return spread.reshape(3 * m, -1)


def carried(segments: Segments, scale: Array, theta: Array) -> Array:
    """Return the matrices of the turns under given parameters, shape (m, 3, 3)."""
    rate = body_rate(segments, scale, theta)
    return weighted_turns(rate, segments.step, rate[:, :, :0]).matrix


def directions_missed(segments: Segments, scale: Array, theta: Array) -> Array:
    """Return the carried less the found direction of each turn, shape (3 m,)."""
    missed: Array = np.einsum("mij,mj->mi", carried(segments, scale, theta), segments.before) - segments.after
    return missed.ravel()


def directions_smeared(segments: Segments, derivatives: Array, scale: Array, theta: Array) -> Array:
    """Return how `directions_missed` change per unit of each derivative that is added to the output, shape (3 m, k).

    `derivatives` are those of the output over time, such as the second and the third, shape (k, m, n, 3).
    """
    missed = directions_missed(segments, scale, theta)
    columns = [
        directions_missed(replace(segments, output=segments.output + _STEP * each), scale, theta) - missed
        for each in derivatives
    ]
    return np.column_stack(columns) / _STEP


def body_rate(segments: Segments, scale: Array, theta: Array) -> Array:
    """Return the body rate under given parameters, rad/s, shape (m, n, 3)."""
    moved = scale * theta[9:12] if theta.size > 9 else 0.0
    per_output = np.linalg.inv(misalignment(theta)) / (scale * (1 + theta[:3]))
    return np.asarray((segments.output - moved) @ per_output.T)


def misalignment(theta: Array) -> Array:
    """Return T of scaled parameters, (3, 3)."""
    t = np.eye(3)
    t[ROWS, COLUMNS] = theta[3:9]
    return t


def model(segments: Segments, scale: Array, theta: Array, fit_bias: bool) -> tuple[Array, Array]:
    """Return the carried less the found direction of each turn, (3 m,), and derivatives, (3 m, p).

    An error ``dw`` of the rate changes a carried direction u by ``C (u x sum C' dw dt)``; dw is linear in the scaled
    output, the rate and a constant, so that four sums per turn hold all derivatives.
    """
    s = scale * (1 + theta[:3])
    inverse = np.linalg.inv(misalignment(theta))
    rate = body_rate(segments, scale, theta if fit_bias else theta[:9])
    weights = np.concatenate([rate, np.ones((*rate.shape[:2], 1))], axis=2) if fit_bias else rate
    turns: Turns = weighted_turns(rate, segments.step, weights)
    # The scaled output is T times the rate, and so are its sums.
    of_rate = turns.weighted[:, :3]
    of_scaled = np.tensordot(of_rate, misalignment(theta), (1, 1)).transpose(0, 3, 1, 2)
    carried_up = np.einsum("mij,mj->mi", turns.matrix, segments.before)
    columns = [of_scaled[:, k] @ inverse[:, k] * -(scale / s)[k] for k in range(3)]
    columns += [of_rate[:, j] @ -inverse[:, i] for i, j in zip(ROWS, COLUMNS, strict=True)]
    if fit_bias:
        columns += [turns.weighted[:, 3] @ inverse[:, k] * -(scale / s)[k] for k in range(3)]
    moved = np.cross(segments.before[:, None, :], np.stack(columns, axis=1))
    jacobian = turns.matrix @ np.swapaxes(moved, 1, 2)
    return (carried_up - segments.after).ravel(), jacobian.reshape(-1, len(columns))

"""The fit of the turns.

The clock of the gyroscopes, and which turns are left out.

A scale factor is output per angle and time: a clock that runs fast by 1000 ppm makes all three 1000 ppm too large, and
no turn shows it. Where the accelerometers are stamped by another clock, both see the same turns. In each of them the
accelerometers' direction of gravity follows the one that the gyroscopes carry, with a delay; the line through the
delays over time is the difference of the clocks. Acceleration of the unit along its path is odd about the middle of a
turn, the speed even: it does not move the delay to first order.
"""

from __future__ import annotations

import math
from functools import cached_property
from itertools import pairwise

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from imulab.display import Bad, Finding, Note
from imulab.errors import DataError
from imulab.estimation.decisions import (
    CLOCKS_DISAGREE,
    SAMPLES_COME_LATE,
    TURN_DISAGREEMENT,
)
from imulab.estimation.least_squares import Fit, covariance, f_test, least_squares
from imulab.estimation.rows import MAD_TO_SIGMA, median
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.gyro.rest import (
    GyroRest,
    RestHolds,
    StillMeans,
    at_rest,
    beyond_range,
    find_holds,
    resolution,
    still_means,
)
from imulab.procedures.tumble.gyro.rotation import frame_rotations
from imulab.procedures.tumble.gyro.turns import (
    Segments,
    Span,
    Stamps,
    choose_turns,
    directions_missed,
    misalignment,
    model,
    span_between,
    start_scale,
)
from imulab.procedures.tumble.gyro.windows import (
    HoldEnds,
    Readings,
    Windows,
    hann_means,
    hold_ends,
    neighbouring_pairs,
    noise_density,
)
from imulab.recording import Array
from imulab.units import parse_unit, to_si

# The clock of the gyroscopes: how far it can be trusted, and what the accelerometers' clock says of it.


CRYSTAL = 50 * 1e-6  # as '50 ppm' is read, so that the two compare equal
"""Standard uncertainty of the rate of a clock that nothing is known of but that a crystal drives it."""
_KNOT = 0.05  # s
_LAGS = np.linspace(-2.0, 2.0, 21)  # s
_STEPS = 6  # of Newton's method for a turn's delay, each 0.3 s at most
_OUTLIER = 4.0 * MAD_TO_SIGMA  # medians of the distance from the line, 5.9 of them: farther turns do not tell the clock
_FEWEST = 6  # turns through which a line has a scatter
_LATENCY = 5e-3  # s
_JITTER, _COUNTED = 0.02, 1e-6  # of a step
_FEWEST_STAMPS = 100  # between gaps, through which a line is drawn


class ClockComparison(Struct, frozen=True):
    """The accelerometers' time less the gyroscopes', ``delay + rate (t - middle)``, with standard uncertainties; s."""

    delay: float
    delay_uncertainty: float
    rate: float
    rate_uncertainty: float
    middle: float
    turns: int

    def on_other(self, time: Array) -> Array:
        """Return times of the gyroscopes' clock on that of the accelerometers."""
        return np.asarray(time + self.delay + self.rate * (time - self.middle), dtype=np.float64)

    def variance(self, clock: float) -> float:
        """Of the difference of the rates, if each clock has this relative standard uncertainty."""
        return 2 * clock**2 + self.rate_uncertainty**2

    def clear(self, clock: float) -> bool:
        """Whether two such clocks do not explain the difference (at 1 %)."""
        return bool(abs(self.rate) > CLOCKS_DISAGREE.limit * math.sqrt(self.variance(clock)))


class ScaleClock(Struct, frozen=True):
    """Clock that the scale factors of the gyroscopes refer to.

    Attributes
    ----------
    uncertainty, assumed
        Relative standard uncertainty of the rate of the clock in use, and as assumed of any.
    of
        Whose it is.
    comparison
        Of the two clocks, or None.
    counted
        Whether the gyroscopes' time stamps are a count times a nominal step, which no clock measured.
    """

    uncertainty: float
    assumed: float
    of: str
    comparison: ClockComparison | None
    counted: bool = False

    def notes(self, *, apart: bool) -> list[str]:
        """Say what a user should know; `apart`: the two triads come from two recordings."""
        drift = self.comparison
        if drift is None:
            return []
        if self.of == "gyro" and drift.clear(self.assumed):
            return [
                Finding(
                    f"gyro: the accelerometers' clock runs {1e6 * drift.rate:+.0f} ppm (u "
                    f"{1e6 * drift.rate_uncertainty:.0f} ppm) against the gyroscopes': if the gyroscopes' is wrong, so "
                    "are all their scale factors, by as much; their uncertainty covers it. If the accelerometers' "
                    "clock is the true one, use --clock-of accel",
                    "compare both clocks with a third, and state the true one (--clock-of)",
                )
            ]
        late = -drift.delay
        if not apart and abs(late) > max(_LATENCY, SAMPLES_COME_LATE.limit * drift.delay_uncertainty):
            return [
                Note(
                    f"gyro: its samples come {1e3 * late:+.1f} ms after the accelerometers' of the same time (u "
                    f"{1e3 * drift.delay_uncertainty:.1f} ms): a delay does no harm here, where turns go from hold to "
                    "hold, but in a filter that uses both"
                )
            ]
        return []


def clock_of_scale(comparison: ClockComparison | None, clock: float, triad: str, *, counted: bool) -> ScaleClock:
    """Return what is known of the clock that the scale factors are referred to.

    Parameters
    ----------
    comparison
        Of the two clocks, or None.
    clock
        Relative standard uncertainty of the rate of the clock that `triad` names.
    triad
        ``gyro``: the gyroscopes' own stamps count; what two such clocks leave of the difference is added to it.
        ``accel``: they were carried over to the accelerometers' clock.
    """
    more = 0.0
    if comparison is not None and triad == "accel":
        more = comparison.rate_uncertainty**2
    elif comparison is not None:
        more = max(comparison.rate**2 - comparison.variance(clock), 0.0)
    return ScaleClock((clock**2 + more) ** 0.5, clock, triad, comparison, counted)


def is_counted(time: Array) -> bool:
    """Whether time stamps are a count times a step, to rounding."""
    step = np.diff(time)
    return bool(np.ptp(step) < _COUNTED * float(step.mean()) + 8 * np.spacing(np.abs(time).max()))


def even_stamps(time: Array) -> tuple[Array, float] | None:
    """Return evenly spaced time stamps and the rms jitter of the original ones, s; None where they do not jitter.

    A sensor with its own clock samples evenly, but the host stamps each sample when it arrives. Stamps are
    replaced by a line through them, between gaps.
    """
    step = np.diff(time)
    middle = median(step)
    gap = step > 1.5 * float(step.mean()) + 8 * MAD_TO_SIGMA * median(np.abs(step - middle))
    even = time.copy()
    edges = np.concatenate([[0], np.flatnonzero(gap) + 1, [len(time)]])
    for start, stop in pairwise(edges.tolist()):
        if stop - start >= _FEWEST_STAMPS:
            number = np.arange(stop - start) - (stop - start - 1) / 2
            stamps = time[start:stop] - time[start:stop].mean()
            even[start:stop] -= stamps - number * float(number @ stamps) / float(number @ number)
    jitter = float(np.sqrt(np.mean((time - even) ** 2)))
    return (even, jitter) if jitter > _JITTER * float(step.mean()) and (np.diff(even) > 0).all() else None


def compare_clocks(
    accel_time: Array, force: Array, time: Array, rate: Array, segments: Segments, *, search: bool
) -> ClockComparison | None:
    """Compare the clocks of the two triads; None where fewer than six turns tell.

    Parameters
    ----------
    accel_time, force
        Time of the accelerometers' samples, s, (k,), and their specific force, m/s^2, (k, 3).
    time, rate
        Time of the gyroscopes' samples, s, (n,), and the body rate, rad/s, (n, 3).
    segments
        The turns, on the gyroscopes' clock.
    search
        Whether delays up to two seconds are to be expected.
    """
    step = max(_KNOT, 2 * median(np.diff(accel_time)))
    knots, carried = _carried_gravity(time, rate, segments, step)
    moved = np.gradient(carried, axis=1)
    spacing = np.gradient(knots, axis=1)
    speed = moved / np.where(spacing > 0, spacing, np.inf)[:, :, None]
    sums = np.concatenate(
        [np.zeros((1, 3)), np.cumsum(0.5 * (force[1:] + force[:-1]) * np.diff(accel_time)[:, None], axis=0)]
    )

    def missing(delay: Array) -> Array:
        """Direction that the accelerometers see, later by `delay` (m,), less what the gyroscopes carry."""
        at = knots + delay[:, None]
        parts = [
            np.interp(at + step / 2, accel_time, column) - np.interp(at - step / 2, accel_time, column)
            for column in sums.T
        ]
        vector = np.stack(parts, axis=2)
        length = np.linalg.norm(vector, axis=2, keepdims=True)
        return np.asarray(vector / np.maximum(length, 1e-300) - carried, dtype=np.float64)

    delay = np.zeros(len(carried))
    if search:
        costs = np.array([(missing(delay + lag) ** 2).sum(axis=(1, 2)) for lag in _LAGS.tolist()])
        delay = _LAGS[np.argmin(costs, axis=0)]
    power = (speed**2).sum(axis=(1, 2))
    for _ in range(_STEPS):
        delay = delay - np.clip((missing(delay) * speed).sum(axis=(1, 2)) / np.maximum(power, 1e-300), -0.3, 0.3)
    return _fit_delay_line((segments.start + segments.stop) / 2, delay)


def _carried_gravity(time: Array, rate: Array, segments: Segments, step: float) -> tuple[Array, Array]:
    """Knots of each turn (m, k), the last one repeated, and the direction of gravity there, (m, k, 3).

    By how much a turn misses at its end is spread over it in proportion to the angle turned.
    """
    start, stop = np.searchsorted(time, segments.start), np.searchsorted(time, segments.stop)
    samples = max(1, round(step / median(np.diff(time[start[0] : stop[0] + 1]))))
    count = -(-int((stop - start).max()) // samples)
    index = np.minimum(start[:, None] + samples * np.arange(count + 1), stop[:, None])
    m = len(start)
    turn = frame_rotations(rate, time, index[:, :-1].ravel(), index[:, 1:].ravel()).reshape(m, count, 3, 3)
    up = np.empty((m, count + 1, 3))
    up[:, 0] = segments.before
    for k in range(count):
        up[:, k + 1] = np.einsum("mij,mj->mi", turn[:, k], up[:, k])
    path = np.concatenate([np.zeros((m, 1)), np.cumsum(np.linalg.norm(np.diff(up, axis=1), axis=2), axis=1)], axis=1)
    share = path / np.maximum(path[:, -1:], 1e-300)
    return time[index], up + share[:, :, None] * (segments.after - up[:, -1])[:, None, :]


def _fit_delay_line(when: Array, delay: Array) -> ClockComparison | None:
    """Line through the delays, those left out that stand out from it (by the median slope of all pairs)."""
    if len(when) < _FEWEST:
        return None
    i, j = np.triu_indices(len(when), 1)
    slope = median((delay[j] - delay[i]) / (when[j] - when[i]))
    left = delay - slope * when
    left = left - median(left)
    kept = np.abs(left) <= max(_OUTLIER * median(np.abs(left)), 1e-9)
    n = int(kept.sum())
    if n < _FEWEST:
        return None
    middle = float(when[kept].mean())
    centred, mean = when[kept] - middle, float(delay[kept].mean())
    spread = float((centred**2).sum())
    rate = float((centred * delay[kept]).sum()) / spread
    scatter = float(np.sqrt(((delay[kept] - mean - rate * centred) ** 2).sum() / (n - 2)))
    return ClockComparison(mean, scatter / n**0.5, rate, scatter / spread**0.5, middle, n)


# The fit of the turns: from which outputs at rest, and without which turns.


_WORST_TURN = np.radians(20.0)
_UNIT_DOUBTED = np.radians(8.0)
_STANDS_OUT = 3.0  # medians; of 30 turns whose misses are normal, none is so far out in 94 % of tests
_TOLERANCE = 1e-6  # of the parameters: turns miss by mrad, so that a step leaves a hundredth of itself or less
_REWEIGHTED = 6  # fits with bounded influence before turns are called out
_TOO_MANY_OUT = 3  # one turn in so many
_FEWEST_LEFT = 6  # degrees of freedom that the test of a turn must leave
_LATER = 0.5  # lengths of a window by which one in the same hold is another


class TurnProblem(Struct, frozen=True, dict=True):
    """Data of the fit that depend neither on the time base nor on the choice of the sensitivity."""

    name: str
    attitudes: Attitudes
    force: Array
    own: Array
    own_force: Array
    output: Array
    unit: str
    fit_bias: bool
    knocked: NDArray[np.bool_]
    """Attitudes that the accelerometers' record set aside, shape (n,)."""
    earth: Array | float = 0.0
    """Output by what is known of the Earth's rate in each attitude, shape (n, 3)."""
    vertical: Array | None = None
    """Output by the Earth's whole rate along up in each, shape (n, 3), where nobody knows which part of it is there."""
    later: int = 0
    """Windows by which turns end later than the accelerometers come to rest: a low-pass filter has settled then."""
    smear: tuple[float, float] = (0.0, 0.0)
    """Coefficients of the output's second and third derivative, s^2 and s^3, which are taken off the turns."""

    @cached_property
    def beyond(self) -> NDArray[np.bool_]:
        """Which samples are clipped, shape (n, 3)."""
        return beyond_range(self.output, self.smallest)

    @cached_property
    def smallest(self) -> Array:
        """The smallest steps of the output, shape (3,)."""
        return resolution(self.output)

    def force_at(self, time: Array) -> Array:
        """Specific force at the gyroscopes' sample times, m/s^2, shape (n, 3)."""
        if len(self.own) == len(time) and np.array_equal(self.own, time):
            return self.own_force
        return np.column_stack([np.interp(time, self.own, column) for column in self.own_force.T])

    def up(self, windows: Windows, hold: NDArray[np.intp] | slice = slice(None)) -> Array:
        """Upward directions in windows of holds, (n, 3); that of the whole hold where the accelerometers have a gap."""
        mean = hann_means(self.own, self.own_force, windows)
        mean = np.where(np.isfinite(mean), mean, self.force[hold])
        return np.asarray(mean / np.linalg.norm(mean, axis=1, keepdims=True), dtype=np.float64)


class TurnReadings(Struct, frozen=True, dict=True):
    """What a time base makes of a problem's turns, before anything is fitted.

    `density` is the noise of the outputs, (3,).
    """

    case: TurnProblem
    stamps: Stamps
    holds: RestHolds
    density: Array
    ends: HoldEnds
    span: Span
    notes: tuple[str, ...]

    @cached_property
    def up(self) -> tuple[Array, Array]:
        """Upward directions before and after each turn, both (m, 3)."""
        before = self.span.attitude
        return self.case.up(self.ends.last)[before], self.case.up(self.ends.first)[before + 1]

    @cached_property
    def output(self) -> Readings:
        """The output in the pieces of the turns."""
        readings = self.span.read(self.case.output)
        if not any(self.case.smear):
            return readings
        taken_off = np.tensordot(self.case.smear, self.derivatives, 1)
        return replace(readings, middle=readings.middle - taken_off)

    @cached_property
    def derivatives(self) -> Array:
        """The second and the third derivative of the output there, by differences of samples, (2, m, n, 3)."""
        step, output = median(np.diff(self.stamps.time)), self.case.output
        second = np.zeros_like(output)
        second[1:-1] = np.diff(output, 2, axis=0) / step**2
        third = np.gradient(second, step, axis=0)
        return np.stack([self.span.read(second).middle, self.span.read(third).middle])

    @cached_property
    def force(self) -> Readings:
        """The specific force there, m/s^2."""
        return self.span.read(self.case.force_at(self.stamps.on_accel))

    @cached_property
    def still(self) -> StillMeans:
        """What the gyroscopes put out in the holds."""
        return still_means(self.holds, self.stamps.time, self.case.output)

    @cached_property
    def step_output(self) -> Array:
        """The output in whole steps, for a first fit."""
        return self.span.over_steps(self.output.middle)

    @cached_property
    def step_force(self) -> Array:
        """The specific force in whole steps."""
        return self.span.over_steps(self.force.middle)

    def in_steps(self, rest: GyroRest) -> Segments:
        """Return the turns with the pieces of each step taken as one, for a fit; without half differences."""
        output = self.step_output if rest.slope is None else self.step_output - self.step_force @ rest.slope.T
        output = output - self._zero(rest)
        return self.span.whole_steps().segments(output, np.empty((len(output), 0, 3)), self.up)

    def in_pieces(self, rest: GyroRest) -> Segments:
        """Return the turns less zero and what acceleration adds."""
        output, half = self.output.middle, self.output.half
        if rest.slope is not None:
            output, half = output - self.force.middle @ rest.slope.T, half - self.force.half @ rest.slope.T
        return self.span.segments(output - self._zero(rest), half, self.up)

    def within(self, rest: GyroRest) -> Segments:
        """Return the turns from each window to the next in a hold."""
        first, last, hold = neighbouring_pairs(self.ends)
        return self._inside(first, last, hold, rest, (rest.moved * np.ones((len(self.case.force), 3)))[hold])

    def after_arrival(self, rest: GyroRest) -> Segments | None:
        """Return the turns from the first window of each hold to one that is later by its length, or at its end.

        None where fewer than half of the holds have room for one.
        """
        first, last = self.ends.first, self.ends.last
        start = np.minimum(first.start + first.length, last.start)
        hold = np.flatnonzero(start - first.start > _LATER * first.length)
        if 2 * len(hold) < len(start):
            return None
        return self._inside(first.part(hold), Windows(start[hold], first.length[hold]), hold, rest, 0.0)

    def _inside(
        self, first: Windows, last: Windows, hold: NDArray[np.intp], rest: GyroRest, moved: Array | float
    ) -> Segments:
        """Return the turns from windows to later ones of the same holds; the zero of each hold differs by `moved`."""
        output = self.case.output
        if rest.slope is not None:
            output = output - self.case.force_at(self.stamps.on_accel) @ rest.slope.T
        span = span_between(self.stamps, (first, last), hold)
        read, zero = span.read(output), (rest.zero + moved) * np.ones((len(hold), 3))
        up = self.case.up(first, hold), self.case.up(last, hold)
        return span.segments(read.middle - zero[:, None, :], read.half, up)

    def _zero(self, rest: GyroRest) -> Array:
        """Return the output at rest of each turn, (m, 1, 3)."""
        moved, before = rest.moved * np.ones((len(self.case.force), 3)), self.span.attitude
        return np.asarray((rest.zero + (moved[before] + moved[before + 1]) / 2)[:, None, :])


def read_turns(case: TurnProblem, stamps: Stamps, *, rough: bool = False) -> TurnReadings:
    """Return the turns on a time base; `rough` ones go from the middle of a hold to that of the next."""
    holds = find_holds(case.attitudes, stamps.time if rough else stamps.on_accel, case.output, case.smallest, case.name)
    step = median(np.diff(case.own))
    ends = hold_ends(case.attitudes.start, case.attitudes.stop, step)
    if case.later:
        start = np.minimum(ends.first.start + case.later * ends.first.length, ends.last.start) + step / 2
        ends = hold_ends(start, case.attitudes.stop, step)
        holds = replace(holds, start=np.searchsorted(stamps.on_accel, start))
    if rough:
        middle = Windows((case.attitudes.start + case.attitudes.stop) / 2, np.full(len(case.force), step))
        ends = replace(ends, first=middle, last=middle)
    density = noise_density(stamps.on_accel, case.output, holds.still, ends)
    chosen, notes = choose_turns(case.attitudes, stamps, case.beyond, case.name)
    beside = case.knocked[chosen] | case.knocked[chosen + 1]
    if beside.any():
        numbers = " ".join(map(str, (np.flatnonzero(case.knocked) + 1).tolist()))
        left_out = f"gyro: {int(beside.sum())} turns left out, beside attitudes that the record set aside ({numbers})"
        chosen, notes = chosen[~beside], [*notes, Note(left_out)]
    span = span_between(stamps, (ends.last.part(chosen), ends.first.part(chosen + 1)), chosen)
    return TurnReadings(case, stamps, holds, density, ends, span, tuple(notes))


class TurnSolution(Struct, frozen=True, dict=True):
    """Scaled parameters (p,) that fit the turns, residuals (3 m,), Jacobian (3 m, p), and what was set aside.

    `kept` are the turns that were not, among those of the readings.
    """

    readings: TurnReadings
    kept: NDArray[np.bool_]
    rest: GyroRest
    scale: Array
    theta: Array
    residual: Array
    jacobian: Array
    converged: bool
    aside: Array
    notes: tuple[str, ...]

    @cached_property
    def segments(self) -> Segments:
        """The turns that were kept."""
        return self.readings.in_pieces(self.rest).part(self.kept)

    @property
    def scale_factor(self) -> Array:
        """Output per rad/s, (3,)."""
        return np.asarray(self.scale * (1 + self.theta[:3]))

    def rate(self, output: Array) -> Array:
        """Body rate of samples, rad/s, shape (n, 3); what acceleration adds is left in."""
        moved = self.scale * self.theta[9:12] if self.theta.size > 9 else 0.0
        per_output = np.linalg.inv(misalignment(self.theta)) / self.scale_factor
        return np.asarray((output - self.rest.zero - moved) @ per_output.T)

    def output_of(self, rate: Array) -> Array:
        """Output that body rates, rad/s, shape (n, 3), add."""
        return np.asarray(self.scale_factor * (rate @ misalignment(self.theta).T))

    @property
    def typical_miss(self) -> float:
        """Median angle by which the turns miss, rad."""
        return median(np.linalg.norm(self.residual.reshape(-1, 3), axis=1))

    @property
    def cost(self) -> float:
        """Mean square of the angles by which the turns miss, rad^2."""
        return float(np.mean(self.residual**2)) * 3


def solve_turns(
    case: TurnProblem, stamps: Stamps, sensitivity: str, *, near: TurnSolution | None = None, rough: bool = False
) -> TurnSolution:
    """Return the fit of the turns with zero and g-sensitivity from rest; ``auto`` drops a slope that fits worse.

    `near` is an earlier solution, where the fit starts: outputs of unknown size need no fit of their own to find their
    scale factors then. A `rough` one is for clocks that differ by unknown delays: its turns go from the middle of a
    hold to that of the next.
    """
    same = near is not None and near.readings.stamps is stamps
    if near is None:
        readings = read_turns(case, stamps, rough=rough)
    else:
        readings = near.readings if same else read_turns(near.readings.case, stamps)
    known = parse_unit(case.unit)
    theta = np.zeros(12 if case.fit_bias else 9)
    nominal = None if near is None else near.scale_factor
    if known.quantity == "rate":
        nominal = np.full(3, 1 / to_si(1.0, known.symbol))
    if near is not None and nominal is not None:
        theta[:9] = np.concatenate([near.scale_factor / nominal - 1, near.theta[3:9]])

    def solved(wanted: str, scale: Array | None, theta: Array) -> TurnSolution:
        rest = at_rest(readings.still, case.force, wanted, readings.density, scale, case.earth, case.vertical)
        segments = readings.in_steps(rest)
        if scale is not None:
            return _solve(readings, segments, rest, scale, theta)
        # Coning is taken off the zero once the scale is known.
        first = _solve(readings, segments, rest, start_scale(segments), theta)
        return solved(wanted, first.scale_factor, np.concatenate([np.zeros(3), first.theta[3:]]))

    with_slope = solved(sensitivity, nominal, theta)
    if sensitivity != "auto" or with_slope.rest.slope is None:
        return with_slope
    # What is unknown of the Earth's rate changes nothing where no slope is fitted.
    known_without = near is not None and same and case.vertical is not None and near.rest.slope is None
    without = near if near is not None and known_without else solved("no", nominal, theta)
    return with_slope if with_slope.cost < without.cost else without


def _solve(readings: TurnReadings, segments: Segments, rest: GyroRest, scale: Array, theta: Array) -> TurnSolution:
    """Fit the turns from the parameters theta; those that stand out from all others are set aside one by one."""
    case = readings.case
    known = parse_unit(case.unit)
    if known.quantity == "rate":
        miss = np.linalg.norm(directions_missed(segments, scale, np.zeros_like(theta)).reshape(-1, 3), axis=1)
        if median(miss) > _UNIT_DOUBTED:  # the stated unit may be wrong
            scale, theta = start_scale(segments), np.concatenate([np.zeros(3), theta[3:]])
    weights: Array = np.ones(len(segments.before))
    fit = _fitted(segments, scale, theta, weights)
    out, missed = _outliers(segments, scale, fit)
    if out.any():
        fit = _fitted(segments.part(~out), scale, fit.parameters[0], weights[~out])
    residual = fit.residuals[0]
    typical = median(np.linalg.norm(residual.reshape(-1, 3), axis=1))
    if not typical < _WORST_TURN:
        raise DataError(
            f"{case.name}: columns gyro_x gyro_y gyro_z: the turns miss the change of gravity's direction by "
            f"{np.degrees(typical):.0f} deg (median of {len(residual) // 3}): swapped or reversed axes, or a wrong "
            "unit?"
        )
    others = float(np.sqrt((residual**2).sum() / (len(residual) // 3)))
    aside = np.column_stack([segments.start, segments.stop, missed])[out]
    return TurnSolution(
        readings, ~out, rest, scale, fit.parameters[0], residual, fit.jacobian[0], bool(fit.converged[0]), aside,
        (*readings.notes, *_aside_notes(aside, others, len(out))),
    )  # fmt: skip


def _aside_notes(aside: Array, others: float, turns: int) -> list[str]:
    """Name turns that were set aside, where the others miss by `others`, rad rms."""
    notes: list[str] = [
        Finding(
            f"gyro: the turn at {start:.1f} to {stop:.1f} s set aside: it misses by {np.degrees(size):.3g} deg, the "
            f"others by {np.degrees(others):.3g} deg rms: knocked, or samples lost?",
            "record this turn again, without knocks and without lost samples",
        )
        for start, stop, size in aside.tolist()
    ]
    if len(aside) * _TOO_MANY_OUT > turns:
        notes.append(
            Bad(
                f"gyro: {len(aside)} of {turns} turns stand out from the others: too many to tell which are "
                "right; record again, without knocks and without lost samples"
            )
        )
    return notes


def _fitted(segments: Segments, scale: Array, theta: Array, weights: Array) -> Fit:
    """Return the fit of some turns, weighted (m,), from the parameters theta."""
    return least_squares(
        lambda parameters: model(segments, scale, parameters, theta.size > 9),
        theta,
        np.repeat(weights, 3),
        tolerance=_TOLERANCE,
    )


def _outliers(segments: Segments, scale: Array, fit: Fit) -> tuple[NDArray[np.bool_], Array]:
    """Return which turns stand out (m,), and what the others' fit misses each by, rad, (m,).

    Candidates are far out under a fit that bounds the pull of each turn (Cauchy's weights on the scale of the median);
    one stands out if the fit without all candidates predicts it so badly by chance in 0.1 % of tests of all turns
    (F-test). Where the median turn is not far below the worst, there are none.
    """
    m, size = len(segments.before), fit.parameters.shape[1]
    miss = np.linalg.norm(fit.residuals[0].reshape(m, 3), axis=1)
    nothing = np.zeros(m, dtype=np.bool_)
    if miss.max() <= _STANDS_OUT * median(miss) or 2 * m < size + _FEWEST_LEFT:
        return nothing, miss
    for _ in range(_REWEIGHTED):
        fit = _fitted(segments, scale, fit.parameters[0], 1 / (1 + (miss / (2 * median(miss))) ** 2))
        miss = np.linalg.norm(fit.residuals[0].reshape(m, 3), axis=1)
    out = miss > _STANDS_OUT * median(miss)
    left = 2 * int((~out).sum()) - size
    if not out.any() or left < _FEWEST_LEFT:
        return nothing, miss
    fit = _fitted(segments, scale, fit.parameters[0], np.where(out, 0.0, 1.0))
    residual, rows = fit.residuals[0].reshape(m, 3), fit.jacobian[0].reshape(m, 3, size)
    spread = rows @ covariance(fit.jacobian, np.repeat(np.where(out, 0.0, 1.0), 3)[None])[0] @ np.swapaxes(rows, 1, 2)
    far = np.einsum("mi,mi->m", residual, np.linalg.solve(np.eye(3) + spread, residual[:, :, None])[:, :, 0])
    cost = float((residual[~out] ** 2).sum())
    for k in np.flatnonzero(out).tolist():
        out[k] = m * f_test(cost + float(far[k]), size, cost, size + 2, left + size + 2) < TURN_DISAGREEMENT.level
    return out, np.linalg.norm(residual, axis=1)

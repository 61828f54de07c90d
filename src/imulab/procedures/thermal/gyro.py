"""The biases of the gyroscopes over temperature, from holds at rest.

`fit_gyroscopes`: ``M / S = b(T) + G f + W + offset of the power cycle``, b(T) as in
`imulab.procedures.thermal.model`, with the covariance of `imulab.procedures.thermal.solve`. The g-sensitivity G, the
same at all temperatures, is fitted where it is significant (F). A turn about the vertical does not show in the
accelerometers, so the gyroscopes' own scatter decides which samples are at rest.

The Earth's rate W (`model_earth_rate`): its vertical part v is along up in all holds, as a g-sensitivity is. Without a
latitude v is one unknown of variance EARTH^2 / 3, the mean over all directions of the Earth's axis. The horizontal part
has another heading in each attitude; only its size is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from imulab.columns import triad
from imulab.display import Finding, prefixed
from imulab.errors import DataError, ObservabilityError, UnitError
from imulab.estimation.decisions import BIAS_FOLLOWS_GRAVITY, TURNED_IN_HOLD
from imulab.estimation.rows import MAD_TO_SIGMA, distinct, leave_out, median, medians
from imulab.gravity import EARTH, EarthRate
from imulab.procedures.thermal import DEGREES, LEAST_KNOTS
from imulab.procedures.thermal.degrees import (
    ALL,
    Degrees,
    LagAndLoops,
    LeftOutCluster,
    Split,
    bound_scatter,
    drift_rates,
    explain_unobservable_lag,
    judge_lag_and_loops,
    law_bends,
    may_be_taken,
    number_temperatures,
    place_knots,
    predict_left_out,
    rms_left_out,
    spline_predicts,
    split_temperatures,
    step_down,
    wald_probability,
)
from imulab.procedures.thermal.holds import Cut, Holds, average_cuts, pool_covariance
from imulab.procedures.thermal.model import Laws
from imulab.procedures.thermal.solve import (
    Rows,
    Scatter,
    ThermalSolution,
    conclude,
    fit_excess,
    fit_turn_on_scatter,
    one_hot,
    whitener,
)
from imulab.procedures.tumble.gyro.rest import QUIET_SHARE, STILL_SIGMAS
from imulab.recording import Array, Recording, check_finite
from imulab.units import parse_unit, to_si

# The Earth's rate in gyroscopes at rest.


VERTICAL = EARTH / np.sqrt(3)
"""Standard deviation of v without a latitude, rad/s; that of each horizontal component is as large."""
_ASKEW_SHARE = 0.03
"""Error of the Earth's rate as sensed, over that rate, by misalignments and scale factors that are not known yet."""


def attitude_columns(up: Array, earth: EarthRate | None) -> Array:
    """Return the columns, of unit variance, of the unknown Earth's rate in each attitude, rad/s, shape (n, 3, 3).

    They hold the horizontal part and the error of the vertical part as sensed; `up` is the direction up, (n, 3).
    """
    along = up[:, :, None] * up[:, None, :]
    level = VERTICAL if earth is None else earth.level / np.sqrt(2)
    columns: Array = level * (np.eye(3) - along) + _ASKEW_SHARE * EARTH * along
    return columns


def model_earth_rate(force: Array, attitude: NDArray[np.int64], earth: EarthRate | None) -> tuple[Array, Array]:
    """Return the known part of the Earth's rate, (3 n,), and columns of unit variance for the unknown, (3 n, k).

    Under specific forces (n, 3); `attitude` is the number of the attitude of each hold, (n,).
    """
    up = force / np.linalg.norm(force, axis=1, keepdims=True)
    by_attitude = np.einsum("nk,nij->nikj", one_hot(attitude), attitude_columns(up, earth)).reshape(up.size, -1)
    if earth is None:
        return np.zeros(up.size), np.hstack([by_attitude, VERTICAL * up.reshape(-1, 1)])
    return (earth.vertical * up).ravel(), by_attitude


# Mean outputs of the gyroscopes in the holds of the accelerometers, while the gyroscopes were still too.


_COLUMNS = triad("gyro")
_FEWEST = 12  # fewest still samples of a hold
_QUIET_PART, _ENDS = 0.35, 0.02
"""Share of still samples of a hold, between slow ends, that tells the zero; and share of moving ones that makes such
an end."""
_LARGEST = np.radians(60.0)
"""Largest plausible bias, rad/s."""


@dataclass(frozen=True)
class RatesAtRest:
    """Holds in which the gyroscopes were still.

    Attributes
    ----------
    mean, covariance
        Mean outputs, shape (n, 3), and their covariances, (n, 3, 3), in rad/s by the nominal scale factors.
    force
        Specific force, in g, shape (n, 3).
    temperature, rate, step, shared, recording
        As in `Holds`, shape (n,).
    attitude
        Number of the attitude: cuts of one hold share it, shape (n,).
    index
        Place among the holds, shape (n,).
    unit
        Unit of the outputs as read.
    size
        Nominal output per rad/s, by which outputs were divided, shape (3,): 1 for a unit of rate.
    notes
        Notes on samples and holds that were left out.
    earth
        The Earth's rate, where the latitude is known.
    slow
        Covariance of the means by slow noise on each axis, (rad/s)^2, shape (3, n, n); None where it is not known.
    """

    mean: Array
    covariance: Array
    force: Array
    temperature: Array
    rate: Array
    step: Array
    shared: NDArray[np.bool_]
    recording: NDArray[np.int64]
    attitude: NDArray[np.int64]
    index: NDArray[np.int64]
    unit: str
    size: Array
    notes: tuple[str, ...]
    earth: EarthRate | None = None
    slow: Array | None = None

    def __len__(self) -> int:
        return len(self.mean)

    @cached_property
    def noise(self) -> Array:
        """Covariance of the means of all axes by noise, shape (3 n, 3 n)."""
        n = len(self)
        noise = np.zeros((n, 3, n, 3))
        noise[range(n), :, range(n), :] = self.covariance
        if self.slow is not None:
            noise[:, range(3), :, range(3)] += self.slow
        return noise.reshape(3 * n, 3 * n)

    @cached_property
    def offsets(self) -> Array:
        """A column for each axis of each of r recordings, 1 in its rows, shape (3 n, 3 r)."""
        return np.asarray(np.kron(one_hot(self.recording), np.eye(3)), dtype=np.float64)

    @cached_property
    def errors(self) -> Array:
        """A column for each of k errors of the temperature, 1 in the rows that have it, shape (3 n, k)."""
        number = np.where(self.shared, self.recording, int(self.recording.max()) + 1 + np.arange(len(self)))
        return np.repeat(one_hot(number), 3, axis=0)

    @cached_property
    def earth_rate(self) -> tuple[Array, Array]:
        """The known part of the Earth's rate and the columns of the unknown one, as by `model_earth_rate`."""
        return model_earth_rate(self.force, self.attitude, self.earth)

    def part(self, kept: NDArray[np.bool_]) -> RatesAtRest:
        """Return some of the holds."""
        return RatesAtRest(
            self.mean[kept], self.covariance[kept], self.force[kept], self.temperature[kept], self.rate[kept],
            self.step[kept], self.shared[kept], self.recording[kept], self.attitude[kept], self.index[kept],
            self.unit, self.size, self.notes, self.earth,
            None if self.slow is None else self.slow[:, kept][:, :, kept],
        )  # fmt: skip


def check_gyroscopes(recordings: Sequence[Recording]) -> str:
    """Return the unit of the gyroscopes of all recordings.

    Raises
    ------
    DataError
        One has none, or no time.
    UnitError
        Their units differ.
    """
    for recording in recordings:
        missing = [name for name in _COLUMNS if name not in recording]
        if missing:
            why = "expected the gyroscopes in every recording, or no --with gyro"
            raise recording.lacking(f"column {missing[0]}", missing[0], why)
        if recording.time is None:
            raise DataError(
                f"{recording.name}: a table of attitudes; expected a recording with a column time for --with gyro, "
                "since the gyroscopes tell when they were still"
            )
    first = recordings[0].triad_unit("gyro")
    for recording in recordings:
        if recording.triad_unit("gyro") != first:
            raise UnitError(
                f"{recording.name}: columns gyro_x gyro_y gyro_z are in {recording.triad_unit('gyro')}, but in {first} "
                f"in {recordings[0].name}; expected one unit"
            )
    return first


def scale_output(recording: Recording, size: Array) -> Array:
    """Return the outputs over the nominal scale factors, rad/s, shape (n, 3); `size` is output per rad/s."""
    unit, output = recording.triad_unit("gyro"), recording.triad("gyro")
    return (to_si(output, unit) if parse_unit(unit).quantity == "rate" else output) / size


def rates_at_rest(holds: Holds, force: Array, size: Array) -> RatesAtRest:
    """Return the mean rates over the holds, under specific forces in g, shape (n, 3), by nominal scale factors (3,).

    Raises
    ------
    DataError
        There are none, an axis is dead, or turns all the time.
    UnitError
        Their units differ between recordings.
    """
    unit = check_gyroscopes(holds.gyroscopes)
    cuts: list[Cut | None] = [None] * len(holds)
    notes: list[str] = []
    for number, recording in enumerate(holds.gyroscopes):
        check_finite(recording, _COLUMNS)
        left_out = leave_out(recording, _COLUMNS)
        output = scale_output(left_out.recording, size)
        members = np.flatnonzero(holds.recording == number)
        rest, hold_averages, moved = _average_still(holds, members, output, recording)
        notes += [prefixed(f"gyro: {recording.name}", note) for note in left_out.notes(rest)] + moved
        for index, cut in zip(members.tolist(), hold_averages, strict=True):
            cuts[index] = cut
    kept = np.array([cut is not None for cut in cuts])
    averages = [cut for cut in cuts if cut is not None]
    if not averages:
        raise DataError(f"{holds.recordings[0].name}: columns gyro_x gyro_y gyro_z: they turn in every hold")
    mean = np.array([cut.mean for cut in averages])
    if np.abs(medians(mean, 0)).max() > _LARGEST:
        worst = int(np.argmax(np.abs(medians(mean, 0))))
        raise DataError(
            f"{holds.recordings[0].name}: column {_COLUMNS[worst]}: "
            f"{np.degrees(median(mean[:, worst])):.3g} deg/s at rest; expected a bias below "
            f"{np.degrees(_LARGEST):.0f} deg/s: is the unit {unit} wrong?"
        )
    alone = holds.group < 0
    attitude = np.where(alone, len(holds) + np.arange(len(holds)), holds.group)
    return RatesAtRest(
        mean, pool_covariance(averages), force[kept], holds.temperature[kept], drift_rates(holds)[kept],
        holds.step[kept], holds.shared[kept], holds.recording[kept], attitude[kept], np.flatnonzero(kept), unit, size,
        tuple(notes),
    )  # fmt: skip


def _average_still(
    holds: Holds, members: NDArray[np.intp], output: Array, recording: Recording
) -> tuple[NDArray[np.bool_], list[Cut | None], list[str]]:
    """Return the samples at rest, the mean of each hold of a recording (None where it turned), and notes on these."""
    time, temperature = recording.time, recording.si("temperature")
    assert time is not None
    first = np.searchsorted(time, holds.start[members])
    last = np.searchsorted(time, holds.stop[members], side="right")
    rest = np.zeros(len(time), dtype=np.bool_)
    pieces = [slice(a, b) for a, b in zip(first.tolist(), last.tolist(), strict=True)]
    for piece in pieces:
        rest[piece] = True
    at_rest = np.ascontiguousarray(output[rest].T)
    swing = np.ptp(at_rest, axis=1)
    if (swing == 0).any():
        name = _COLUMNS[int(np.argmin(swing))]
        raise DataError(f"{recording.name}: column {name}: the same output in every sample at rest: a dead axis")
    middle = [medians(output[piece], 0) for piece in pieces]
    spread = [medians(np.abs(output[piece] - m), 0) for piece, m in zip(pieces, middle, strict=True)]
    steps = [np.diff(distinct(column)) for column in at_rest]
    sigma = np.maximum(MAD_TO_SIGMA * medians(np.array(spread), 0), [step.min() for step in steps])
    kept: dict[int, NDArray[np.intp]] = {}
    notes: list[str] = []
    for index, piece, m in zip(members.tolist(), pieces, middle, strict=True):
        still = between_turns(np.all(np.abs(output[piece] - m) <= STILL_SIGMAS * sigma, axis=1))
        if still.sum() < max(_QUIET_PART * len(still), _FEWEST):
            notes.append(
                Finding(
                    f"gyro: {holds.label(index)} left out: the gyroscopes turn, which accelerometers do not see",
                    "record this hold again, with the unit at rest",
                )
            )
            continue
        kept[index] = np.flatnonzero(still) + piece.start
    cuts: dict[int, Cut] = {}
    if kept:
        which, count = np.concatenate(list(kept.values())), np.array([len(each) for each in kept.values()])
        begin, number = np.zeros_like(count), np.array(list(kept))
        averages = average_cuts(output[which], temperature[which], time[which], np.cumsum(count) - count, begin, number)
        cuts = dict(zip(kept, averages, strict=True))
    return rest, [cuts.get(index) for index in members.tolist()], notes


def between_turns(still: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which samples of a hold lie between its slow beginning and end, shape (n,); none where it turns inside.

    A smooth turn ends after the accelerometers are at rest. Beside samples that turn, so many again are left out. A few
    samples in the middle that stand out are left out alone.
    """
    count, moved = len(still), np.flatnonzero(~still)
    begun, ended = moved[moved < count // 4], moved[moved >= count - count // 4]
    inside = len(moved) - len(begun) - len(ended)
    if inside > (1 - QUIET_SHARE) * count:
        return np.zeros(count, dtype=np.bool_)
    first = 2 * (int(begun[-1]) + 1) if len(begun) > _ENDS * count else 0
    last = count - 2 * (count - int(ended[0])) if len(ended) > _ENDS * count else count
    place = np.arange(count)
    return still & (place >= min(first, count * 3 // 10)) & (place < max(last, count * 7 // 10))


# Biases over temperature from all holds at rest.


_PASSES = 4  # of weights, or of excess and scatter
_TELL = 4
"""Fewest holds of a recording of which one can be an outlier."""
_RANK = 1e-7  # relative singular value below which columns are dependent


@dataclass(frozen=True)
class ThermalGyroscopes:
    """The fit of the biases: holds, and solution with the coefficients of the biases and then G, rad/s per g.

    `probability` is that of so large a G by chance, None where the attitudes do not determine it; `aside` are the
    indices of holds that were left out since the unit turned.
    """

    held: RatesAtRest
    solution: ThermalSolution
    sensitivity: bool
    probability: float | None
    left_out: tuple[LeftOutCluster, ...]
    aside: NDArray[np.int64]
    drift: LagAndLoops

    def at_rest(self, temperature: Array) -> Array:
        """Return the biases at temperatures (n,), rad/s, shape (n, 3)."""
        laws = self.solution.laws
        rows = self.solution.coefficients[: self.size].reshape(3, -1)
        biases: Array = laws.bias_functions(temperature) @ rows.T
        return biases

    def sensitivities(self, gravity: float) -> Array:
        """Return G, rad/s per m/s^2, shape (3, 3)."""
        return self.solution.coefficients[self.size : self.size + 9].reshape(3, 3) / gravity

    def refit(self, held: RatesAtRest) -> ThermalGyroscopes:
        """Return the same terms fitted to other means of the same holds, with the same scatter."""
        laws, scatter = self.solution.laws, self.solution.scatter
        refitted = solve(held, laws, float(scatter.tau[0]), sensitivity=self.sensitivity, free=self.drift.free)
        assert refitted is not None
        return replace(self, held=held, solution=replace(refitted, scatter=scatter))

    @property
    def count(self) -> int:
        """Number of coefficients without lag and loops."""
        return self.size + 9 * self.sensitivity

    @property
    def size(self) -> int:
        """Number of coefficients of the biases."""
        return 3 * self.solution.laws.terms[0]


def fit_gyroscopes(
    held: RatesAtRest,
    low: float,
    high: float,
    wanted: str | Degrees,
    tau: float | None,
    name: str,
    *,
    spline: bool = False,
) -> ThermalGyroscopes:
    """Return the fit of the biases over the range of temperature, degC.

    `tau` is their scatter between power cycles, rad/s, if known. With `spline` they are natural cubic splines with a
    knot at each temperature; `wanted` ``auto`` chooses between these and polynomials.

    Raises
    ------
    ObservabilityError
        The holds are at too few temperatures.
    """
    count = int(number_temperatures(held.temperature).max(initial=0)) + 1
    degree = min(DEGREES[0], max(count - 2, 0)) if wanted == "auto" else int(wanted[0])
    least = LEAST_KNOTS if spline else degree + 1
    if count < least:
        what = "a spline" if spline else f"a bias of degree {degree}"
        raise ObservabilityError(
            f"{name}: the gyroscopes are at rest at {count} temperatures (5 K apart), too few for {what}: record at "
            "more temperatures, or lower --degrees"
        )
    laws = Laws(low, high, (degree, 0, 0))
    held, aside = leave_out_turns(held, laws)
    cluster = number_temperatures(held.temperature)
    choice = _Search(held, cluster, tau).choose(laws, auto=wanted == "auto", spline=spline)
    solution = choice.solution
    if solution.scatter.bound:
        tau = float(solution.scatter.tau[0])
    drift = _fit_lag_and_loops(held, solution, choice.sensitivity, tau)
    if drift.free:
        solution = solve(held, solution.laws, tau, sensitivity=choice.sensitivity, free=drift.free) or solution
        if choice.solution.scatter.bound:
            solution = replace(solution, scatter=choice.solution.scatter)
        choice = replace(choice, solution=solution)
    places = [
        replace(e, temperature=float(held.temperature[cluster == e.temperature].mean()), holds=e.holds // 3)
        for e in choice.left_out
    ]
    return ThermalGyroscopes(held, solution, choice.sensitivity, choice.probability, tuple(places), aside, drift)


@dataclass(frozen=True)
class _Solved:
    """A solution, the number of each hold's temperature, whether G is in it, and how probable such G is by chance."""

    solution: ThermalSolution
    cluster: NDArray[np.int64]
    sensitivity: bool
    probability: float | None

    @cached_property
    def splits(self) -> list[Split]:
        """What remains of the rows without each interior temperature."""
        return split_temperatures(self.solution, self.cluster)

    @cached_property
    def left_out(self) -> list[LeftOutCluster]:
        """The errors at each interior temperature, left out."""
        return predict_left_out(self.splits, np.ones(len(self.solution.coefficients), dtype=np.bool_))


@dataclass(frozen=True)
class _Search:
    """The choice of the laws of the biases from holds, the number of each hold's temperature, and tau."""

    held: RatesAtRest
    cluster: NDArray[np.int64]
    tau: float | None

    def choose(self, laws: Laws, *, auto: bool, spline: bool) -> _Solved:
        """Return the solution of the stated laws, or that of the laws that the data support."""
        knots = place_knots(self.held.temperature, self.cluster, laws)
        bent = replace(laws, degrees=(DEGREES[0], 0, 0), knots=knots)
        if spline:
            return self._bound(self._solved(bent))
        straight = self._solved(laws)
        while auto and straight.solution.laws.degrees[0]:
            step = step_down(straight.solution, 0, straight.splits)
            if not may_be_taken(step, rms_left_out(straight.left_out)):
                break
            straight = self._solved(replace(straight.solution.laws, degrees=step.degrees))
        if not auto or len(knots) < LEAST_KNOTS:
            return straight
        try:
            by_knots = self._solved(bent)
        except ObservabilityError:
            return straight  # the holds do not determine so many values of the bias
        bends = law_bends(by_knots.solution, self.tau) and spline_predicts(by_knots.left_out, straight.left_out)
        return self._bound(by_knots) if bends else straight

    def _solved(self, laws: Laws) -> _Solved:
        """Return the solution with the g-sensitivity where it is observable and significant, else without."""
        whole = solve(self.held, laws, self.tau, sensitivity=True)
        probability = None
        if whole is not None:
            probability = wald_probability(whole, np.eye(len(whole.coefficients))[-9:])
            if probability < BIAS_FOLLOWS_GRAVITY.level:
                return _Solved(whole, self.cluster, True, probability)
        plain = solve(self.held, laws, self.tau, sensitivity=False)
        if plain is None:
            raise ObservabilityError(f"{len(self.held)} holds do not determine the biases of the gyroscopes")
        return _Solved(plain, self.cluster, False, probability)

    def _bound(self, solved_laws: _Solved) -> _Solved:
        def solved(laws: Laws, tau: float | None) -> ThermalSolution:
            solution = solve(self.held, laws, tau, sensitivity=solved_laws.sensitivity)
            assert solution is not None
            return solution

        return replace(solved_laws, solution=bound_scatter(solved_laws.solution, self.tau, solved))


def _fit_lag_and_loops(
    held: RatesAtRest, solution: ThermalSolution, sensitivity: bool, tau: float | None
) -> LagAndLoops:
    """Return lag and loops of the biases, each tested given the other."""
    size = len(solution.coefficients)
    reason = explain_unobservable_lag(held.temperature, held.rate, solution, size, 0)
    if reason is not None:
        return LagAndLoops(reason=reason)
    whole = solve(held, solution.laws, tau, sensitivity=sensitivity, free=ALL)
    if whole is None:
        return LagAndLoops(reason="the holds in which the temperature drifts do not tell lag, loop and laws apart")
    return judge_lag_and_loops(whole, size)


def solve(
    held: RatesAtRest, laws: Laws, tau: float | None, *, sensitivity: bool, free: tuple[int, ...] = ()
) -> ThermalSolution | None:
    """Return the least-squares solution, None where the holds do not determine the coefficients.

    The coefficients are those of the biases, of G with `sensitivity`, and of lag and loops as far as `free`.
    """
    count = 3 * laws.terms[0] + 9 * sensitivity
    coefficients = np.zeros(count + len(free))
    if free:  # the derivative by a lag is the slope of laws, which must be fitted first
        begun = solve(held, laws, tau, sensitivity=sensitivity)
        if begun is None:
            return None
        coefficients[:count] = begun.coefficients
    excess, freedom, scatter = 0.0, np.inf, Scatter() if tau is None else Scatter(np.array([tau, 0.0]))
    for _ in range(_PASSES):
        rows = linearise_rates(held, laws, coefficients, free)
        white = whitener(rows, excess, scatter.tau)
        columns = white(rows.jacobian)
        size = np.linalg.norm(columns, axis=0)
        if not size.min() > 0 or not len(rows.residual) >= len(size):
            return None
        step, _, _, values = np.linalg.lstsq(columns / size, white(rows.residual), rcond=None)
        if not values[-1] > _RANK * np.sqrt(len(size)):
            return None
        coefficients = coefficients - step / size
        excess, freedom = fit_excess(rows, excess)
        if tau is None:
            scatter = fit_turn_on_scatter(rows, excess)
    rows = linearise_rates(held, laws, coefficients, free)
    return conclude(laws, coefficients, rows, (excess, freedom), scatter, converged=True)


def linearise_rates(held: RatesAtRest, laws: Laws, coefficients: Array, free: tuple[int, ...]) -> Rows:
    """Return the rows at these coefficients, three for each hold."""
    n, size = len(held), 3 * laws.terms[0]
    jacobian = laws.design(held.temperature)[:, :3, :size].reshape(3 * n, size)
    slope = laws.slope(held.temperature)[:, :3, :size] @ coefficients[:size]
    if len(coefficients) - len(free) > size:
        felt = np.einsum("nj,ik->nikj", held.force, np.eye(3)).reshape(3 * n, 9)
        jacobian = np.hstack([jacobian, felt])
    drift = np.zeros((n, 3, 4))
    drift[:, :, 0] = -held.rate[:, None] * slope
    turn = np.sign(held.rate) * (1 - laws.place(held.temperature) ** 2)
    drift[:, range(3), range(1, 4)] = turn[:, None]
    jacobian = np.hstack([jacobian, drift.reshape(3 * n, 4)[:, list(free)]])
    heat = held.errors * (slope * held.step[:, None]).ravel()[:, None]
    known, earth = held.earth_rate
    return Rows(
        residual=jacobian @ coefficients + known - held.mean.ravel(),
        jacobian=jacobian,
        noise=held.noise,
        offsets=(held.offsets, np.zeros((3 * n, 3))),
        errors=np.hstack([heat, earth]),
        drift=drift.reshape(3 * n, 4),
        owner=np.repeat(np.arange(n), 3),
        magnitude=np.ones(3 * n, dtype=np.bool_),
        recording=np.repeat(held.recording, 3),
    )


def leave_out_turns(held: RatesAtRest, laws: Laws) -> tuple[RatesAtRest, NDArray[np.int64]]:
    """Return the holds without those in which the unit turned slowly, and the indices of these among all holds.

    Such a hold is far from the others of its recording in a fit with bounded influence.
    """
    n, size = len(held), 3 * laws.terms[0]
    columns = np.hstack([
        laws.design(held.temperature)[:, :3, :size].reshape(3 * n, size),
        held.offsets,
    ])  # fmt: skip
    weight: Array = np.ones(n)
    for _ in range(_PASSES):
        root = np.repeat(np.sqrt(weight), 3)
        coefficients = np.linalg.lstsq(columns * root[:, None], held.mean.ravel() * root, rcond=1e-9)[0]
        left = (held.mean.ravel() - columns @ coefficients).reshape(n, 3)
        sigma = MAD_TO_SIGMA * median(np.abs(left)) + 1e-12
        far = np.abs(left).max(axis=1) / sigma
        weight = 1 / (1 + (far / 2) ** 2)
    many = np.bincount(held.recording)[held.recording] >= _TELL
    noise = np.sqrt(np.einsum("nii->ni", held.covariance)).max(axis=1)
    out = (
        (far > TURNED_IN_HOLD.limit)
        & many
        & (np.abs(left).max(axis=1) > np.maximum(TURNED_IN_HOLD.limit * noise, EARTH))
    )
    return held.part(~out), held.index[out]


def note_turns(holds: Holds, aside: NDArray[np.int64]) -> list[str]:
    """Return a warning for each hold that `leave_out_turns` left out."""
    return [
        Finding(
            f"gyro: {holds.label(index)} left out: its outputs differ from the others of its recording: the unit "
            "turned",
            "record this hold again, with the unit at rest",
        )
        for index in aside.tolist()
    ]

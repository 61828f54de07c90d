"""Recordings to holds, mean outputs at a known temperature; and checks that all are of one unit over temperature.

Holds (`find_holds`): a hold in which the temperature drifts is cut where it has changed by 1 K, so that the curvature
within a cut adds less than 0.1 ug. The cuts of a hold are *unmoved*: the unit was not turned between them.
Interruptions and invalid rows are left out of the means. The variance of a mean comes from batch means after their
regression on the temperature, as in `imulab.procedures.tumble.attitudes`.

Wander (`fit_wander`): a bench that is knocked or walked around tips a little each time and does not tip back, so that
the error of the direction is a random walk. Its size is estimated beside a polynomial of degree 8 in the temperature
and white noise, by restricted maximum likelihood (Patterson and Thompson, Biometrika 58 (1971) 545).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

import imulab.procedures.tumble._segment as _segment
from imulab.columns import triad
from imulab.display import Bad, Finding, Note, prefixed
from imulab.errors import DataError, OptionError
from imulab.estimation.decisions import DIRECTION_WANDERS
from imulab.estimation.likely_unit import no_gravity
from imulab.estimation.rows import MAD_TO_SIGMA, distinct, median, medians, quantile
from imulab.estimation.sampling import TimeUnitFinding, TimeUnitNote
from imulab.procedures.thermal import LEAST_SPAN, SETTLE
from imulab.procedures.tumble.attitudes import POOL_DEGREES, Attitudes, attitudes_and_samples
from imulab.recording import Array, Recording, check_finite
from imulab.records.comparison import different_units
from imulab.units import parse_unit

# Recordings at rest while the temperature drifts: knocks, and wander of the direction.


_SHARE_IN_TAILS, _TURNED = 0.005, 0.1
"""A recording is at rest if its outputs, without this share at either end, change by less than that share of g."""
_BLOCK, _SHAKEN, _OFF, _BESIDE = 0.5, 4.0, 8.0, 5
"""A knock is a block (s) with so many times the usual variance, or so many standard deviations off the median of its
neighbours, so many on each side."""
_LEAST_BLOCK, _MOSTLY = 8, 0.5
"""Fewest samples of a block, and share of the time that must remain without knocks."""
_SMOOTH = 8  # degree of the polynomial in temperature that a direction at rest may follow
_RATIOS = np.concatenate([[0.0], np.geomspace(1e-4, 1e4, 81)])


def find_stretches_at_rest(outputs: Array, time: Array) -> NDArray[np.int64] | None:
    """Return the stretches between knocks of a unit at rest, rows (first, last + 1); None where it is turned."""
    columns = np.ascontiguousarray(outputs.T)
    still = _exclude_knocks(columns, time)
    at_rest = columns if still.all() else columns.compress(still, axis=1)
    if _clearly_turns(at_rest):
        return None
    low, high = (
        np.array([quantile(column, share) for column in at_rest]) for share in (_SHARE_IN_TAILS, 1 - _SHARE_IN_TAILS)
    )
    if (high - low).max() > _TURNED * np.linalg.norm((low + high) / 2):
        return None
    return np.flatnonzero(np.diff(still, prepend=False, append=False)).reshape(-1, 2)


def _clearly_turns(columns: Array) -> bool:
    """Return whether so many outputs, shape (3, n), lie at either end of an axis that quantiles need not be formed."""
    low, high = columns.min(axis=1), columns.max(axis=1)
    axis = int(np.argmax(high - low))
    quarter = (high[axis] - low[axis]) / 4
    beyond = min(
        np.count_nonzero(columns[axis] <= low[axis] + quarter), np.count_nonzero(columns[axis] >= high[axis] - quarter)
    )
    longest = float(np.linalg.norm(np.maximum(-low, high)))
    return bool(beyond > _SHARE_IN_TAILS * columns.shape[1] + 1 and 2 * quarter > _TURNED * longest)


def _exclude_knocks(columns: Array, time: Array) -> NDArray[np.bool_]:
    """Return which samples (3, n) lie in no knock nor beside one, shape (n,); all of them if few would remain."""
    every = np.ones(len(time), dtype=np.bool_)
    size = max(_LEAST_BLOCK, round(_BLOCK * (len(time) - 1) / (time[-1] - time[0])))
    count = len(time) // size
    if count < 4 * _BESIDE:
        return every
    mean, scatter = np.empty((count, 3)), np.empty((count, 3))
    x, y, z = columns
    _segment.blocks(x, y, z, time, size, mean, scatter, np.empty(count))
    beside = np.arange(count)[:, None] + np.arange(-_BESIDE, _BESIDE + 1)
    beside = count - 1 - np.abs(count - 1 - np.abs(beside))  # reflected at both ends
    off = np.abs(mean - medians(mean.T[:, beside]).T)
    usual = np.maximum(medians(scatter, 0), np.finfo(float).tiny)
    far = _OFF * np.maximum(MAD_TO_SIGMA * medians(off, 0), np.sqrt(usual / size))
    bad = ((scatter / usual).mean(axis=1) > _SHAKEN) | (off > far).any(axis=1)
    bad = np.convolve(bad, np.ones(3), "same") > 0.5
    still = np.append(np.repeat(~bad, size), np.full(len(time) - count * size, not bad[-1]))
    return still if still.mean() > _MOSTLY else every


def fit_wander(direction: Array, temperature: Array, time: Array) -> float:
    """Return the variance per second of the random walk of a direction, rad^2/s, 0 where none is significant.

    Parameters
    ----------
    direction
        Mean outputs of unmoved holds over their length, shape (n, 3).
    temperature, time
        Temperature and time of each hold, shape (n,).
    """
    count = len(direction)
    if count < 2 * _SMOOTH:
        return 0.0
    up = direction.mean(axis=0)
    across = np.linalg.svd(up[None])[2][1:]
    place = (temperature - temperature.mean()) / max(float(np.ptp(temperature)), 1e-9)
    smooth = np.polynomial.legendre.legvander(2 * place, _SMOOTH)
    free = np.linalg.svd(smooth, full_matrices=True)[0][:, _SMOOTH + 1 :]
    begun = time - time.min()
    sizes, modes = np.linalg.eigh(free.T @ np.minimum(begun[:, None], begun) @ free)
    squares = ((modes.T @ free.T @ direction @ across.T) ** 2).sum(axis=1)
    # Variances c (1 + r s) of two components each; c takes its most likely value at every ratio r.
    unit = median(sizes)
    relative = 1 + _RATIOS[:, None] * np.maximum(sizes, 0.0) / unit
    level = (squares / relative).mean(axis=1) / 2
    likelihood = -2 * (len(sizes) * np.log(level) + np.log(relative).sum(axis=1))
    best = int(np.argmax(likelihood))
    if likelihood[best] - likelihood[0] < DIRECTION_WANDERS.limit:
        return 0.0
    return float(level[best] * _RATIOS[best] / unit)


# Holds.


_CUT = 1.0  # K
_BATCHES = 10  # parts of a hold whose scatter gives the variance of its mean
_FEWEST = 20
"""Fewest samples of a cut."""
_SIDES = {"warming": 1.0, "cooling": -1.0}


@dataclass(frozen=True)
class Holds:
    """The holds of all recordings of a unit.

    Attributes
    ----------
    mean, covariance
        Mean outputs, shape (n, 3), and the covariance of each mean, shape (n, 3, 3), in `unit`.
    temperature, rate
        Mean temperature, degC, and its change, K/s, shape (n,).
    step
        Standard uncertainty of the reading of the temperature, K, shape (n,).
    shared
        Whether that error is the same for the whole recording, shape (n,).
    recording, group
        Number of the recording, and of the unmoved group or -1, shape (n,).
    start, stop
        Times, s, shape (n,).
    unit
        Unit of the outputs.
    recordings
        The recordings after their settling time, on the accelerometers' clock.
    gyroscopes
        The same on the gyroscopes' clock.
    attitudes
        Attitudes of each recording; one where it rests throughout.
    wander
        Covariance of the holds' directions by tipping of the bench, rad^2, shape (n, n).
    notes
        Notes on samples that were left out, and on wander.
    """

    mean: Array
    covariance: Array
    temperature: Array
    rate: Array
    step: Array
    shared: NDArray[np.bool_]
    recording: NDArray[np.int64]
    group: NDArray[np.int64]
    start: Array
    stop: Array
    unit: str
    recordings: tuple[Recording, ...]
    attitudes: tuple[Attitudes, ...]
    wander: Array
    notes: tuple[str, ...] = ()
    gyroscopes: tuple[Recording, ...] = ()

    def __len__(self) -> int:
        return len(self.mean)

    def label(self, index: int) -> str:
        """Return the name of a hold for messages: recording, times and temperature."""
        name = self.recordings[int(self.recording[index])].name
        return f"{name}, {self.start[index]:.0f} to {self.stop[index]:.0f} s, {self.temperature[index]:.1f} degC"


class Cut(Struct, frozen=True):
    """A stretch of a hold: mean, covariance of the mean and its degrees of freedom, temperature and change, times."""

    mean: Array
    covariance: Array
    freedom: float
    temperature: float
    rate: float
    start: float
    stop: float
    attitude: int


def find_holds(recordings: Sequence[Recording]) -> Holds:
    """Return the holds of recordings that have a column temperature.

    Raises
    ------
    DataError
        There is no temperature, or the noise of a table's rows is not stated.
    """
    cuts: list[Cut] = []
    owner: list[int] = []
    steps: list[float] = []
    attitudes: list[Attitudes] = []
    for number, item in enumerate(recordings):
        temperature = item.si("temperature")
        at_rest, read = attitudes_and_samples(item, "accel")
        if at_rest.trace is None:
            stretches = _cut_table(at_rest, temperature)
        else:
            outputs = read.triad("accel")
            at_rest = _join_rest(at_rest, outputs)
            stretches = _cut_recording(at_rest, outputs, temperature)
        attitudes.append(at_rest)
        cuts += stretches
        owner += [number] * len(stretches)
        steps += [reading_uncertainty(temperature)] * len(stretches)
    recording = np.array(owner)
    held = np.array([[number, cut.attitude] for number, cut in zip(owner, cuts, strict=True)])
    _, hold, parts = np.unique(held, axis=0, return_inverse=True, return_counts=True)
    group = np.where(parts > 1, np.cumsum(parts > 1) - 1, -1)[hold.reshape(-1)]  # (n, 1) in NumPy 2.0
    shared = group < 0
    wander, drift_notes = _wander_covariance(cuts, group, [recordings[number].name for number in owner])
    return Holds(
        mean=np.array([cut.mean for cut in cuts]),
        covariance=pool_covariance(cuts),
        temperature=np.array([cut.temperature for cut in cuts]),
        rate=np.array([cut.rate for cut in cuts]),
        step=np.array(steps),
        shared=shared,
        recording=recording,
        group=group,
        start=np.array([cut.start for cut in cuts]),
        stop=np.array([cut.stop for cut in cuts]),
        unit=attitudes[0].unit,
        recordings=tuple(recordings),
        gyroscopes=tuple(recordings),
        attitudes=tuple(attitudes),
        wander=wander,
        notes=(
            *(prefixed(at_rest.recording.name, note) for at_rest in attitudes for note in at_rest.notes),
            *drift_notes,
        ),
    )


def _wander_covariance(cuts: Sequence[Cut], group: NDArray[np.int64], names: Sequence[str]) -> tuple[Array, list[Note]]:
    """Return the covariance of the holds' directions by the random walk of each unmoved group, and notes on it."""
    covariance, notes = np.zeros((len(cuts), len(cuts))), []
    for number in range(int(group.max(initial=-1)) + 1):
        members = np.flatnonzero(group == number)
        members_cuts = [cuts[k] for k in members.tolist()]
        mean, time = (
            np.array([cut.mean for cut in members_cuts]),
            np.array([(cut.start + cut.stop) / 2 for cut in members_cuts]),
        )
        direction = mean / np.linalg.norm(mean, axis=1).mean()
        density = fit_wander(direction, np.array([cut.temperature for cut in members_cuts]), time)
        if not density:
            continue
        begun = time - time[0]
        covariance[np.ix_(members, members)] = density * np.minimum(begun[:, None], begun)
        notes.append(
            Note(
                f"{names[members[0]]}: its direction wanders by {1e3 * np.sqrt(density * begun[-1]):.2g} mrad while it "
                "rests (standard deviation), which the uncertainties hold: does its support tip, or is it knocked?"
            )
        )
    return covariance, notes


def _join_rest(attitudes: Attitudes, outputs: Array) -> Attitudes:
    """Return a single attitude if the unit rests throughout, without knocks; else the attitudes unchanged."""
    time = attitudes.recording.time
    assert time is not None
    edges = find_stretches_at_rest(outputs, time)
    if edges is None:
        return attitudes
    # A ramp through the temperatures needs no more than a sample now and then.
    notes = tuple(note for note in attitudes.notes if not isinstance(note, TimeUnitNote | TimeUnitFinding))
    if len(edges) > 1:
        first, lost = time[edges[0, 1]], 100 * (1 - np.diff(edges).sum() / len(time))
        sentence = (
            f"knocked while it rested, {len(edges) - 1} times, first at {first:.0f} s: {lost:.2g} % of its samples "
            "left out"
        )
        notes = (*notes, Finding(sentence, "let the unit rest undisturbed, and record again"))
    return replace(attitudes, pieces=np.column_stack([edges, np.zeros(len(edges), dtype=np.int64)]), notes=notes)


def _cut_table(rests: Attitudes, temperature: Array) -> list[Cut]:
    """Return the rows of a table of attitudes as cuts, with the noise of its columns std_*."""
    if rests.covariance is None:
        raise DataError(
            f"{rests.recording.name}: a table of attitudes without columns std_accel_x, std_accel_y and std_accel_z; "
            "expected them, or a recording with a column time, since attitudes at several temperatures are weighed"
        )
    return [
        Cut(rests.mean[k], rests.covariance[k], np.inf, float(temperature[k]), 0.0, float(k), float(k), k)
        for k in range(len(rests))
    ]


def _cut_recording(attitudes: Attitudes, outputs: Array, temperature: Array) -> list[Cut]:
    """Return the cuts of each attitude, in which the temperature changes by 1 K at most, without interruptions."""
    whole = attitudes.recording.time
    assert whole is not None
    assert attitudes.pieces is not None
    pieces = attitudes.pieces[np.argsort(attitudes.pieces[:, 2], kind="stable")]
    samples = np.concatenate([np.arange(a, b) for a, b, _ in pieces.tolist()])
    number, index = np.unique(pieces[:, 2], return_index=True)
    size = np.add.reduceat(pieces[:, 1] - pieces[:, 0], index)
    first = np.cumsum(size) - size
    time, read = whole[samples], temperature[samples]
    drift = np.abs(_slopes(time, read, first)) * (time[first + size - 1] - time[first])
    count = np.maximum(np.minimum(np.ceil(drift / _CUT), size // _FEWEST), 1).astype(np.int64)
    hold, begin = _divide(size, count, np.zeros_like(size))
    return average_cuts(outputs[samples], read, time, first[hold] + begin, begin, number[hold])


def _divide(
    size: NDArray[np.int64], count: NDArray[np.int64], begin: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the parts of stretches, each cut into `count` of equal length: whose they are, and where they begin."""
    whose = np.repeat(np.arange(len(count)), count)
    part = np.arange(len(whose)) - np.repeat(np.cumsum(count) - count, count)
    return whose, (part * (size / count)[whose] + begin[whose]).astype(np.int64)


def average_cuts(
    outputs: Array,
    temperature: Array,
    time: Array,
    first: NDArray[np.int64],
    begin: NDArray[np.int64],
    attitude: NDArray[np.int64],
) -> list[Cut]:
    """Return the means of outputs (n, 3) over cuts that follow each other, with their covariances by batches.

    `first` is the first sample of each cut, `begin` its number within its hold, shape (k,).
    """
    size = np.diff(first, append=len(time))
    batches = np.clip(size // 4, 3, _BATCHES)
    whose, edges = _divide(size, batches, begin)
    edges += (first - begin)[whose]
    counts, starts = np.diff(edges, append=len(time)), np.cumsum(batches) - batches
    left = np.add.reduceat(outputs, edges) / counts[:, None]
    at = np.add.reduceat(temperature, edges) / counts
    left -= (np.add.reduceat(left, starts) / batches[:, None])[whose]
    heated = at - (np.add.reduceat(at, starts) / batches)[whose]
    warmed = np.maximum.reduceat(at, starts) > np.minimum.reduceat(at, starts)
    along = np.add.reduceat(heated[:, None] * left, starts)
    along /= np.where(warmed, np.add.reduceat(heated**2, starts), np.inf)[:, None]
    left -= heated[:, None] * along[whose]
    freedom = batches - 1.0 - warmed
    covariance = np.add.reduceat(left[:, :, None] * left[:, None, :], starts) / (freedom * batches)[:, None, None]
    values = (freedom, np.add.reduceat(temperature, first) / size, _slopes(time, temperature, first), time[first])
    ends = time[first + size - 1].tolist(), attitude.tolist()
    mean = np.add.reduceat(outputs, first) / size[:, None]
    return [Cut(*each) for each in zip(mean, covariance, *(each.tolist() for each in values), *ends, strict=True)]


def _slopes(time: Array, values: Array, first: NDArray[np.int64]) -> Array:
    """Return the slopes of straight lines through values over time, one for the samples from each `first` on."""
    size = np.diff(first, append=len(time))
    centred, high = (each - np.repeat(np.add.reduceat(each, first) / size, size) for each in (time, values))
    slopes: Array = np.add.reduceat(centred * high, first) / np.add.reduceat(centred**2, first)
    return slopes


def pool_covariance(cuts: Sequence[Cut]) -> Array:
    """Return the covariance of each mean, shrunk towards the usual one for its length, since batches are few."""
    covariance = np.array([cut.covariance for cut in cuts])
    freedom = np.array([cut.freedom for cut in cuts])
    if np.isinf(freedom).any():
        return covariance
    length = np.array([max(cut.stop - cut.start, 1e-9) for cut in cuts])
    density = covariance * length[:, None, None]
    level = np.trace(density, axis1=1, axis2=2)
    usual = level <= 3 * median(level)
    common = np.einsum("n,nij->ij", freedom[usual], density[usual]) / freedom[usual].sum()
    common += 1e-3 * np.trace(common) * np.eye(3)
    weights = freedom[:, None, None]
    shrunk: Array = (weights * density + POOL_DEGREES * common) / (weights + POOL_DEGREES)
    shrunk /= length[:, None, None]
    return shrunk


def reading_uncertainty(temperature: Array) -> float:
    """Return the standard uncertainty of a thermometer by the step of its readings, K: step / sqrt(12)."""
    values = distinct(np.round(temperature, 6))
    few = values[:9]
    digits = next((k for k in range(6) if all(np.array_equal(np.round(each, k), each) for each in (few, values))), 6)
    step = min(10.0**-digits, float(np.diff(values).min()) if len(values) > 1 else np.inf)
    return step / float(np.sqrt(12))


def read_sides(holds: Holds) -> Array:
    """Return 1 for holds of a soak that was reached by warming, -1 by cooling, as its head says; else 0.

    Raises
    ------
    DataError
        A head says neither.
    """
    signs = []
    for recording in holds.recordings:
        word = recording.metadata.get("reached_by", "").strip()
        if word not in ("", *_SIDES):
            raise DataError(f"{recording.name}: reached_by {word!r} in the head: expected warming or cooling")
        signs.append(_SIDES.get(word, 0.0))
    which: Array = np.array(signs)[holds.recording]
    return which


# Checks that recordings are of one unit over temperature.


_KELVIN = 150.0  # degC; no unit is calibrated above it, and all kelvins above -120 degC are larger
_JUMP, _QUICK = 5.0, 2.0  # K within so many s that no thermometer of a unit changes by
_COLDEST = -120.0  # degC
_STUCK, _SHORT, _READINGS, _STEPS = 200, 20.0, 20, 1.5
"""A thermometer is stuck if one reading lasts so many samples, and so many times as long as 95 % of the others, and if
there are so many others, which change by more than so many steps."""
_LATER = (1.5, 1.25)
"""Ratios of the last steps' durations from which readings settle exponentially."""
_SHARED, _DISTINCT = 0.3, 0.9
"""Two recordings overlap if they share more than this share of rows, and that share of rows is unique in both."""
_MIX, _LAST_BITS = np.uint64(0x9E3779B97F4A7C15), np.uint64(47)


def prepare_recordings(
    recordings: Sequence[Recording],
    column: str | None,
    settle: float | None,
    *,
    span: float = LEAST_SPAN,
    sensor: str = "accel",
) -> list[Recording]:
    """Return recordings with a column temperature that spans `span` K, without their settling time.

    Raises
    ------
    DataError
        They are of two units, of two sensors' temperatures, one is there twice, or their temperature cannot be.
    OptionError
        The settling time is less than 0.
    """
    with_temperature = [_choose_temperature(recording, column) for recording in recordings]
    _check_together(with_temperature, sensor)
    for recording in with_temperature:
        _check_temperature(recording)
    with_temperature = _note_constant(with_temperature)
    low = min(float(recording.si("temperature").min()) for recording in with_temperature)
    high = max(float(recording.si("temperature").max()) for recording in with_temperature)
    if high - low < span:
        where = (
            with_temperature[0].name
            if len(with_temperature) == 1
            else f"{with_temperature[0].name} and {len(with_temperature) - 1} more"
        )
        raise DataError(
            f"{where}: column temperature: spans {high - low:.1f} K ({low:.1f} to {high:.1f} degC); expected at least "
            f"{span:g} K: imulab {'tumble' if sensor == 'accel' else 'noise'} fit is for one temperature"
        )
    return [_skip_settling(recording, settle) for recording in with_temperature]


def prepare_gyroscopes(recordings: Sequence[Recording], column: str | None, settle: float | None) -> list[Recording]:
    """Return the same of gyroscopes on their own clock, whose recordings `prepare_recordings` has accepted."""
    return [_skip_settling(_choose_temperature(recording, column), settle) for recording in recordings]


def _choose_temperature(recording: Recording, column: str | None) -> Recording:
    """Return the recording with the chosen column as its temperature."""
    candidates = [
        name
        for name, unit in recording.units.items()
        if name.startswith("temperature") and parse_unit(unit).quantity == "temperature"
    ]
    if column is not None:
        recording.column(column)
        if column not in candidates:
            raise DataError(
                f"{recording.name}: column {column}: expected a temperature, found {recording.units[column]}"
            )
        return _use_temperature(recording, column)
    if len(candidates) > 1:
        raise DataError(
            f"{recording.name}: {len(candidates)} columns of temperature: {' '.join(candidates)}; expected one, that "
            "of the unit's own sensor: choose it with --temperature-column"
        )
    if candidates:
        return _use_temperature(recording, candidates[0])
    advice = "expected what the unit's own thermometer says (--temperature-column NAME where it is called otherwise)"
    raise recording.lacking("column temperature", "temperature", advice)


def _use_temperature(recording: Recording, column: str) -> Recording:
    """Return the recording with a column as its temperature."""
    if column == "temperature":
        return recording
    return recording.with_columns({"temperature": recording.column(column)}, {"temperature": recording.units[column]})


def _check_together(recordings: Sequence[Recording], sensor: str) -> None:
    """Refuse recordings of two units, with outputs in two units, or with rows that another has too."""
    first = recordings[0]
    if apart := different_units(*((r.name, r.metadata) for r in recordings), keys=("serial", "element")):
        raise DataError(f"{apart}; expected recordings of one unit")
    hashes = []
    for recording in recordings:
        unit, other = first.triad_unit(sensor), recording.triad_unit(sensor)
        if unit != other:
            raise DataError(
                f"{recording.name}: columns {' '.join(triad(sensor))} are in {other}, but in {unit} in {first.name}; "
                "expected one unit"
            )
        hashes.append(_hash_rows(recording, sensor))
    every = np.concatenate(hashes)
    place = (every >> _LAST_BITS).astype(np.intp)
    crowded = np.sort(every[(np.bincount(place) > 1)[place]])  # a hash with first bits of its own is there once
    if (crowded[1:] == crowded[:-1]).any():  # else no row is there twice
        _check_overlap(recordings, [np.sort(each) for each in hashes])


def _check_overlap(recordings: Sequence[Recording], marks_of_rows: Sequence[NDArray[np.uint64]]) -> None:
    """Refuse a recording with many of the rows of an earlier one; marks of rows are sorted."""
    earlier: list[tuple[str, NDArray[np.uint64]]] = []
    for recording, row_marks in zip(recordings, marks_of_rows, strict=True):
        for before, marks in earlier:
            if np.array_equal(row_marks, marks):
                raise DataError(f"{recording.name}: the same recording as {before}, which would count twice")
            shared = _shared_rows(row_marks, marks)
            if shared > _SHARED and min(len(np.unique(each)) / len(each) for each in (row_marks, marks)) > _DISTINCT:
                raise DataError(
                    f"{recording.name}: {100 * shared:.0f} % of its rows are in {before}, too, and would count twice; "
                    "expected recordings of their own"
                )
        earlier.append((recording.name, row_marks))


def _shared_rows(marks: NDArray[np.uint64], other: NDArray[np.uint64]) -> float:
    """Return the share of rows that another recording has too, by a few thousand of them; both are sorted."""
    if not (len(marks) and len(other)):
        return 0.0
    few = marks[:: max(1, len(marks) // 4000)]
    return float((other[np.searchsorted(other, few).clip(max=len(other) - 1)] == few).mean())


def _hash_rows(recording: Recording, sensor: str) -> NDArray[np.uint64]:
    """Return a hash of each row of outputs, shape (n,)."""
    hashes = np.zeros(len(recording), dtype=np.uint64)
    for name in triad(sensor):
        bits = np.ascontiguousarray(recording.column(name), dtype=np.float64).view(np.uint64)
        hashes = (hashes ^ bits ^ (bits >> np.uint64(29))) * _MIX
        hashes ^= hashes >> np.uint64(32)
    return hashes


def _check_temperature(recording: Recording) -> None:
    """Refuse temperatures that cannot be: kelvins, too cold, stuck, or with a jump."""
    check_finite(recording, ["temperature"])
    values, time = recording.si("temperature"), recording.time
    if not values.size:
        raise DataError(f"{recording.name}: no samples")
    if values.min() > _KELVIN:
        raise DataError(
            f"{recording.name}: column temperature: {values.min():.1f} to {values.max():.1f} degC cannot be; are these "
            "kelvins? expected a title such as 'temperature [K]'"
        )
    if values.min() < _COLDEST:
        raise DataError(
            f"{recording.name}: column temperature: {values.min():.1f} degC cannot be; expected {_COLDEST:g} to "
            f"{_KELVIN:g} degC"
        )
    if time is not None:
        _check_stuck(recording, values)
    if time is not None and values.size > 1:
        jump = np.abs(np.diff(values))
        index = int(np.argmax(jump))
        if jump[index] > _JUMP and time[index + 1] - time[index] < _QUICK:
            raise DataError(
                f"{recording.name}: {recording.place(index + 1)}, column temperature: jumps from {values[index]:.1f} "
                f"to {values[index + 1]:.1f} degC in {time[index + 1] - time[index]:.2g} s; expected a "
                "thermometer of the unit, which follows within minutes"
            )


def _check_stuck(recording: Recording, values: Array) -> None:
    """Refuse a thermometer that is stuck: one long reading, where others change every few samples."""
    edges = np.concatenate([[0], np.flatnonzero(np.diff(values)) + 1, [len(values)]])
    runs, changes = np.diff(edges), np.abs(np.diff(values[edges[:-1]]))
    longest = int(np.argmax(runs))
    if len(runs) < _READINGS or runs[longest] < _STUCK:
        return
    # Readings with steps larger than their noise rest at one value wherever the temperature is steady.
    if median(changes) < _STEPS * changes.min() or runs[longest] < _SHORT * quantile(np.delete(runs, longest), 0.95):
        return
    first, last = int(edges[longest]), int(edges[longest + 1]) - 1
    if _settles(values[:first], values[first]):
        return
    raise DataError(
        f"{recording.name}: {recording.place(first)} to {recording.place(last)}, column temperature: stuck at "
        f"{values[first]:.6g} degC over {runs[longest]} samples, where others change every few; expected a thermometer "
        "that goes on: choose the part before it (--window)"
    )


def _settles(before: Array, value: float) -> bool:
    """Return whether readings approached a value exponentially, each step later than the one before it.

    Then the last step takes at least 1.71 times as long as the one before, and that at least 1.41 times as long as its
    predecessor. Readings that stop within a drift have steps of one length.
    """
    away = np.round(np.abs(before - value), 6)
    levels = np.unique(away[away > 0])[: len(_LATER) + 2]
    if len(levels) < len(_LATER) + 2:
        return False
    left = np.array([int(np.flatnonzero(away >= level)[-1]) for level in levels])
    steps = -np.diff(left)
    return bool(np.all(steps[:-1] > np.array(_LATER) * steps[1:]))


def _note_constant(recordings: Sequence[Recording]) -> list[Recording]:
    """Return the recordings with a note on each whose temperature is constant while that of others changes."""
    constant = [each.time is not None and not np.ptp(each.column("temperature")) for each in recordings]
    if not any(constant) or not any(
        len(distinct(each.column("temperature"))) >= _READINGS for each in recordings if each.time is not None
    ):
        return list(recordings)
    note = Finding(
        "column temperature: the same value in every row, while it changes in other recordings: a thermometer stuck?",
        "check the thermometer, and record this file again",
    )
    return [
        replace(recording, notes=(*recording.notes, prefixed(recording.name, note))) if is_constant else recording
        for recording, is_constant in zip(recordings, constant, strict=True)
    ]


def _skip_settling(recording: Recording, settle: float | None) -> Recording:
    """Return the recording after the settling time, by default 300 s if its time counts from power-on."""
    time = recording.time
    if settle is not None and not settle >= 0:
        raise OptionError(f"settle {settle:g} s: expected 0 s or more")
    if settle is None:
        settle = SETTLE if "power_on_temperature" in recording.metadata else 0.0
    if time is None or not settle:
        return recording
    kept = time >= settle
    if np.count_nonzero(kept) < 2:
        raise DataError(
            f"{recording.name}: ends {time[-1]:.0f} s after power-on, inside the settling time of {settle:g} s; "
            "expected a longer recording, or another --settle"
        )
    return replace(
        recording,
        columns={name: values[kept] for name, values in recording.columns.items()},
        first_row=recording.first_row + int(np.argmax(kept)),
    )


def check_holds(holds: Holds, gravity: float, nominal: float | None) -> list[str]:
    """Return why |f| at rest is no gravity, and refuse holds that cannot be those of accelerometers.

    `gravity` is in m/s^2, `nominal` in m/s^2 per output.

    Raises
    ------
    DataError
        A magnitude is below half or above twice gravity, or an axis is dead.
    """
    if nominal is not None:
        length = np.linalg.norm(holds.mean, axis=1) * nominal
        far = np.flatnonzero((length < gravity / 2) | (length > 2 * gravity))
        if far.size:
            reason = no_gravity(float(length[far[0]]), holds.unit)
            raise DataError(
                f"{holds.label(int(far[0]))}: columns accel_x accel_y accel_z: the specific force at rest is "
                f"{length[far[0]]:.4g} m/s^2, expected {gravity:.4g} m/s^2: is the unit wrong? {reason}"
            )
    doubts: list[str] = []
    if nominal is not None and (reason := no_gravity(median(length), holds.unit)):
        doubts.append(
            Bad(
                f"{holds.recordings[0].name}: columns accel_x accel_y accel_z: {reason}",
                reason.action,
            )
        )
    span = np.ptp(holds.mean, axis=0)
    if span.min() <= 0:
        name = triad("accel")[int(np.argmin(span))]
        raise DataError(f"{holds.recordings[0].name}: column {name}: the same output in every hold: a dead axis")
    return doubts

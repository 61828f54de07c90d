"""Recordings to holds: mean outputs at a known temperature, and which of them lie in one direction.

A hold in which the temperature drifts is cut where it has moved by 1 K: the curvature within a cut then leaves less
than 0.1 ug. The cuts of a hold are *unmoved*: nothing was turned between them. What interrupts a hold, and rows that
are no readings, are left out of its means. The scatter of a mean comes from batch
means after their regression on the temperature, as in `imulab.procedures.tumble.held`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from imulab.columns import triad
from imulab.errors import DataError
from imulab.estimation.rows import leave_out
from imulab.procedures.thermal.rest import stretches_at_rest, wandering
from imulab.procedures.tumble.attitudes import POOL_DEGREES, Attitudes
from imulab.procedures.tumble.segment import find_attitudes
from imulab.recording import Array, Recording
from imulab.verdict import Note

_CUT = 1.0  # K
_BATCHES = 10
_FEWEST = 20
"""Samples of a cut: what is shorter joins the one before."""
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
        s, shape (n,).
    unit
        Of the outputs.
    recordings
        As they were given, after the settling time.
    attitudes
        Those of each recording; one where it rests throughout.
    wander
        Covariance of their directions by what tips a unit that is not moved, rad^2, shape (n, n).
    notes
        What a user should know of how they were found.
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

    def __len__(self) -> int:
        return len(self.mean)

    def label(self, index: int) -> str:
        """Return how messages name a hold."""
        name = self.recordings[int(self.recording[index])].name
        return f"{name}, {self.start[index]:.0f} to {self.stop[index]:.0f} s, {self.temperature[index]:.1f} degC"


@dataclass(frozen=True)
class Cut:
    """One stretch: its means, covariance of the mean, batches behind it, temperature and change, times, attitude."""

    mean: Array
    covariance: Array
    freedom: float
    temperature: float
    rate: float
    start: float
    stop: float
    attitude: int


def find_holds(recordings: Sequence[Recording]) -> Holds:
    """Find the holds of recordings that have a column temperature.

    Raises
    ------
    DataError
        There is no temperature, or the noise of a table's rows is not stated.
    """
    cuts: list[Cut] = []
    owner: list[int] = []
    steps: list[float] = []
    attitudes: list[Attitudes] = []
    for number, given in enumerate(recordings):
        temperature = given.si("temperature")
        found = find_attitudes(given)
        if found.trace is None:
            own = _of_rows(found, temperature)
        else:
            columns = triad("accel")
            read = leave_out(given, columns).recording
            outputs = np.column_stack([read.column(name) for name in columns])
            found = _at_rest(found, outputs)
            own = _of_time(found, outputs, temperature)
        attitudes.append(found)
        cuts += own
        owner += [number] * len(own)
        steps += [_step(temperature)] * len(own)
    recording = np.array(owner)
    attitude = np.array([cut.attitude for cut in cuts])
    group, shared = np.full(len(cuts), -1), np.ones(len(cuts), dtype=np.bool_)
    for number in range(len(recordings)):
        for each in np.unique(attitude[recording == number]):
            members = np.flatnonzero((recording == number) & (attitude == each))
            if len(members) > 1:
                group[members] = group.max() + 1
                shared[members] = False
    wander, said = _wander(cuts, group, [recordings[number].name for number in owner])
    return Holds(
        mean=np.array([cut.mean for cut in cuts]),
        covariance=pooled(cuts),
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
        attitudes=tuple(attitudes),
        wander=wander,
        notes=(
            *(
                (Note if isinstance(note, Note) else str)(f"{found.recording.name}: {note}")
                for found in attitudes
                for note in found.notes
            ),
            *said,
        ),
    )


def _wander(cuts: Sequence[Cut], group: NDArray[np.int64], names: Sequence[str]) -> tuple[Array, list[Note]]:
    """Return the covariance of the holds' directions by the random walk of each unmoved group, and what is said."""
    covariance, notes = np.zeros((len(cuts), len(cuts))), []
    for number in range(int(group.max(initial=-1)) + 1):
        members = np.flatnonzero(group == number)
        own = [cuts[k] for k in members.tolist()]
        mean, time = np.array([cut.mean for cut in own]), np.array([(cut.start + cut.stop) / 2 for cut in own])
        direction = mean / np.linalg.norm(mean, axis=1).mean()
        density = wandering(direction, np.array([cut.temperature for cut in own]), time)
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


def _at_rest(found: Attitudes, outputs: Array) -> Attitudes:
    """Return one hold where the unit rests throughout: drift must not cut it, nor do knocks, which are left out."""
    time = found.recording.time
    assert time is not None
    edges = stretches_at_rest(outputs, time)
    if edges is None:
        return found
    notes = found.notes
    if len(edges) > 1:
        first, lost = time[edges[0, 1]], 100 * (1 - np.diff(edges).sum() / len(time))
        said = f"knocked while it rested, {len(edges) - 1} times, first at {first:.0f} s: {lost:.2g} % of its samples"
        notes = (*notes, f"{said} left out")
    return replace(found, pieces=np.column_stack([edges, np.zeros(len(edges), dtype=np.int64)]), notes=notes)


def _of_rows(found: Attitudes, temperature: Array) -> list[Cut]:
    """Rows of a table of attitudes, whose noise its columns std_* state."""
    if found.covariance is None:
        raise DataError(
            f"{found.recording.name}: a table of attitudes without columns std_accel_x, std_accel_y and std_accel_z; "
            "expected them, or a recording with a column time, since attitudes at several temperatures are weighed"
        )
    return [
        Cut(found.mean[k], found.covariance[k], np.inf, float(temperature[k]), 0.0, float(k), float(k), k)
        for k in range(len(found))
    ]


def _of_time(found: Attitudes, outputs: Array, temperature: Array) -> list[Cut]:
    """Stretches of each attitude, what interrupted it left out, in which the temperature moves by 1 K at most."""
    whole = found.recording.time
    assert whole is not None
    assert found.pieces is not None
    cuts = []
    for attitude in np.unique(found.pieces[:, 2]).tolist():
        own = np.concatenate([np.arange(a, b) for a, b, number in found.pieces.tolist() if number == attitude])
        time, read, output = whole[own], temperature[own], outputs[own]
        drift = abs(np.polyfit(time, read, 1)[0]) * (time[-1] - time[0])
        count = int(max(1, min(np.ceil(drift / _CUT), len(own) // _FEWEST)))
        edges = np.linspace(0, len(own), count + 1).astype(np.int64)
        cuts += [averaged(output, read, time, a, b, attitude) for a, b in pairwise(edges.tolist())]
    return cuts


def averaged(outputs: Array, temperature: Array, time: Array, first: int, last: int, attitude: int) -> Cut:
    """Return the means of outputs (n, 3) from sample `first` to before `last`, and how well they are known."""
    batches = max(3, min(_BATCHES, (last - first) // 4))
    edges = np.linspace(first, last, batches + 1).astype(np.int64)[:-1]
    counts = np.diff(np.append(edges, last))[:, None]
    means = np.add.reduceat(outputs[first:last], edges - first) / counts
    at = np.add.reduceat(temperature[first:last], edges - first) / counts[:, 0]
    functions = np.column_stack([np.ones(batches), at - at.mean()]) if np.ptp(at) > 0 else np.ones((batches, 1))
    left = means - functions @ np.linalg.lstsq(functions, means, rcond=None)[0]
    freedom = max(batches - functions.shape[1], 1)
    middle = time[first:last]
    rate = float(np.polyfit(middle - middle.mean(), temperature[first:last], 1)[0])
    return Cut(
        outputs[first:last].mean(axis=0), left.T @ left / freedom / batches, float(freedom),
        float(temperature[first:last].mean()), rate, float(middle[0]), float(middle[-1]), int(attitude),
    )  # fmt: skip


def pooled(cuts: Sequence[Cut]) -> Array:
    """Covariance of each mean, shrunk towards what all holds have for their length: few batches are poor weights."""
    covariance = np.array([cut.covariance for cut in cuts])
    freedom = np.array([cut.freedom for cut in cuts])
    if np.isinf(freedom).any():
        return covariance
    length = np.array([max(cut.stop - cut.start, 1e-9) for cut in cuts])
    density = covariance * length[:, None, None]
    level = np.trace(density, axis1=1, axis2=2)
    usual = level <= 3 * np.median(level)
    common = np.einsum("n,nij->ij", freedom[usual], density[usual]) / freedom[usual].sum()
    common += 1e-3 * np.trace(common) * np.eye(3)
    own = freedom[:, None, None]
    shrunk: Array = (own * density + POOL_DEGREES * common) / (own + POOL_DEGREES)
    shrunk /= length[:, None, None]
    return shrunk


def _step(temperature: Array) -> float:
    """Return the standard uncertainty that the step of the reading leaves, K: of its digits, or its values if less."""
    values = np.unique(np.round(temperature, 6))
    digits = next((k for k in range(6) if np.array_equal(np.round(values, k), values)), 6)
    step = min(10.0**-digits, float(np.diff(values).min()) if len(values) > 1 else np.inf)
    return step / float(np.sqrt(12))


def sides(holds: Holds) -> Array:
    """Return whether each hold is of a soak that was reached by warming (1) or cooling (-1), as its head says; else 0.

    Raises
    ------
    DataError
        A head says something else.
    """
    found = []
    for recording in holds.recordings:
        said = recording.metadata.get("reached_by", "").strip()
        if said not in ("", *_SIDES):
            raise DataError(f"{recording.name}: reached_by {said!r} in the head: expected warming or cooling")
        found.append(_SIDES.get(said, 0.0))
    which: Array = np.array(found)[holds.recording]
    return which

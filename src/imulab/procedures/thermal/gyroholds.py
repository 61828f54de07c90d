"""The gyroscopes in the holds of the accelerometers: mean outputs while they, too, were still.

A turn about the vertical moves no accelerometer, so the gyroscopes' own stillness decides which samples count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.columns import triad
from imulab.earth import EarthRate
from imulab.errors import DataError, UnitError
from imulab.estimation.ranked import MAD_TO_SIGMA
from imulab.estimation.rows import leave_out
from imulab.procedures.thermal.holds import Cut, Holds, averaged, pooled
from imulab.procedures.thermal.lag import moving
from imulab.recording import Array, Recording, check_finite
from imulab.units import parse_unit, to_si

_COLUMNS = triad("gyro")
_STILL = 5.0
_QUIET = 0.75
_FEWEST = 12
_LARGEST = np.radians(60.0)
"""No gyroscope that anyone calibrates has a larger bias, rad/s."""


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
        Of the outputs, as read.
    size
        Nominal output per rad/s that the means are in units of, shape (3,): 1 where the unit is one of rate.
    notes
        What a user should know of how they were found.
    earth
        The Earth's rate, where the latitude is known.
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

    def __len__(self) -> int:
        return len(self.mean)

    def part(self, kept: NDArray[np.bool_]) -> RatesAtRest:
        """Return some of the holds."""
        return RatesAtRest(
            self.mean[kept], self.covariance[kept], self.force[kept], self.temperature[kept], self.rate[kept],
            self.step[kept], self.shared[kept], self.recording[kept], self.attitude[kept], self.index[kept],
            self.unit, self.size, self.notes, self.earth,
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
            raise DataError(
                f"{recording.name}: no column {missing[0]}; found {' '.join(recording.columns)}: expected the "
                "gyroscopes in every recording, or no --with gyro"
            )
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


def output_in(recording: Recording, size: Array) -> Array:
    """Return the outputs in rad/s by nominal scale factors, output per rad/s for what is no rate, shape (n, 3)."""
    unit, output = recording.triad_unit("gyro"), recording.triad("gyro")
    return (to_si(output, unit) if parse_unit(unit).quantity == "rate" else output) / size


def rates_at_rest(holds: Holds, force: Array, size: Array) -> RatesAtRest:
    """Average the gyroscopes over the holds, under specific forces in g, shape (n, 3), by nominal scale factors (3,).

    Raises
    ------
    DataError
        There are none, an axis is dead, or turns all the time.
    UnitError
        Their units differ between recordings.
    """
    unit = check_gyroscopes(holds.recordings)
    cuts: list[Cut | None] = [None] * len(holds)
    notes: list[str] = []
    for number, recording in enumerate(holds.recordings):
        check_finite(recording, _COLUMNS)
        left_out = leave_out(recording, _COLUMNS)
        output = output_in(left_out.recording, size)
        own = np.flatnonzero(holds.recording == number)
        rest, found, moved = _still_cuts(holds, own, output, recording)
        notes += [f"gyro: {recording.name}: {note}" for note in left_out.notes(rest)] + moved
        for index, cut in zip(own.tolist(), found, strict=True):
            cuts[index] = cut
    kept = np.array([cut is not None for cut in cuts])
    averages = [cut for cut in cuts if cut is not None]
    if not averages:
        raise DataError(f"{holds.recordings[0].name}: columns gyro_x gyro_y gyro_z: they turn in every hold")
    mean = np.array([cut.mean for cut in averages])
    if np.abs(np.median(mean, axis=0)).max() > _LARGEST:
        worst = int(np.argmax(np.abs(np.median(mean, axis=0))))
        raise DataError(
            f"{holds.recordings[0].name}: column {_COLUMNS[worst]}: "
            f"{np.degrees(np.median(mean[:, worst])):.3g} deg/s at rest; expected a bias below "
            f"{np.degrees(_LARGEST):.0f} deg/s: is the unit {unit} wrong?"
        )
    alone = holds.group < 0
    attitude = np.where(alone, len(holds) + np.arange(len(holds)), holds.group)
    return RatesAtRest(
        mean, pooled(averages), force[kept], holds.temperature[kept], moving(holds)[kept], holds.step[kept],
        holds.shared[kept], holds.recording[kept], attitude[kept], np.flatnonzero(kept), unit, size, tuple(notes),
    )  # fmt: skip


def _still_cuts(
    holds: Holds, own: NDArray[np.intp], output: Array, recording: Recording
) -> tuple[NDArray[np.bool_], list[Cut | None], list[str]]:
    """Return the samples at rest, the average of each hold of a recording or None where it turned, and what is said."""
    time, temperature = recording.time, recording.si("temperature")
    assert time is not None
    first = np.searchsorted(time, holds.start[own])
    last = np.searchsorted(time, holds.stop[own], side="right")
    rest = np.zeros(len(time), dtype=np.bool_)
    pieces = [slice(a, b) for a, b in zip(first.tolist(), last.tolist(), strict=True)]
    for piece in pieces:
        rest[piece] = True
    if (np.ptp(output[rest], axis=0) == 0).any():
        name = _COLUMNS[int(np.argmin(np.ptp(output[rest], axis=0)))]
        raise DataError(f"{recording.name}: column {name}: the same output in every sample at rest: a dead axis")
    median = [np.median(output[piece], axis=0) for piece in pieces]
    spread = [np.median(np.abs(output[piece] - m), axis=0) for piece, m in zip(pieces, median, strict=True)]
    steps = [np.diff(np.unique(column)) for column in output[rest].T]
    sigma = np.maximum(MAD_TO_SIGMA * np.median(spread, axis=0), [step.min() for step in steps])
    found: list[Cut | None] = []
    notes = []
    for index, piece, m in zip(own.tolist(), pieces, median, strict=True):
        still = (np.abs(output[piece] - m) <= _STILL * sigma).all(axis=1)
        if still.sum() < max(_QUIET * len(still), _FEWEST):
            notes.append(f"gyro: {holds.label(index)} left out: the gyroscopes turn, which accelerometers do not see")
            found.append(None)
            continue
        kept = np.flatnonzero(still) + piece.start
        found.append(averaged(output[kept], temperature[kept], time[kept], 0, len(kept), index))
    return rest, found, notes

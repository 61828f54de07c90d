"""A recording at rest, column by column, as stretches that a noise model can be fitted to; or why that cannot be."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from imulab.errors import DataError
from imulab.estimation.column_noise import moved_columns
from imulab.estimation.noise.cosine import Stretch, slow_coefficients, transformed
from imulab.estimation.noise.plausible import doubtful_units
from imulab.estimation.noise.readings import LEVELS, own_readings
from imulab.estimation.noise_coefficients import resolution
from imulab.estimation.ranked import distinct
from imulab.estimation.sampling import WIDEST_GAP, bridged, sampling_rate, steady_part, usual_step
from imulab.estimation.steps import deviation_of_steps
from imulab.recording import Array, Recording, check_time
from imulab.verdict import Note

FEWEST, SHORT = 500, 100.0
"""Samples of a stretch at least; s below which only white noise and limits of the rest can be told."""
MOST, SHARE = 16, 0.05
"""Stretches between gaps at most, and how long each must be in terms of the longest."""
_PILED, _A_FEW = 2, 10
_SEEN = 100_000


@dataclass(frozen=True)
class Rest:
    """A recording at rest.

    Attributes
    ----------
    recording
        Its part of one sampling rate, with bad rows bridged.
    interval
        Time between samples, s.
    parts
        First row, last + 1, and of these rows the place among evenly spaced samples (None where no row is missing), of
        each stretch between gaps.
    bridged
        Samples in gaps that were short enough for a straight line.
    notes
        What there is to say.
    """

    recording: Recording
    interval: float
    parts: tuple[tuple[int, int, Array | None], ...]
    bridged: int
    notes: tuple[str, ...]

    @property
    def duration(self) -> float:
        """Length of all stretches, s."""
        return self.interval * sum(_length(part) for part in self.parts)

    @property
    def short(self) -> bool:
        """Whether only white noise and limits of slow noise can be told."""
        return self.duration < SHORT

    def samples(self, name: str) -> list[Array]:
        """Return the evenly spaced samples of a column, SI, stretch by stretch."""
        values = self.recording.si(name)
        return [
            values[start:stop] if place is None else np.interp(np.arange(place[-1] + 1), place, values[start:stop])
            for start, stop, place in self.parts
        ]

    def stretches(self, name: str) -> list[Stretch]:
        """Return the spectra of a column, stretch by stretch.

        Raises
        ------
        DataError
            The column is constant or clipped.
        """
        self._check(name)
        return [transformed(each, self.interval) for each in self.samples(name)]

    def slow(self, name: str) -> list[Array] | None:
        """Return the slow coefficients of a covariate, stretch by stretch; None where it does not change."""
        if name not in self.recording:
            return None
        samples = self.samples(name)
        if not all(np.isfinite(each).all() and float(np.ptp(each)) > 0 for each in samples):
            return None
        return [slow_coefficients(each, self.interval) for each in samples]

    def _check(self, name: str) -> None:
        values, unit = self.recording.column(name), self.recording.units[name]
        where = f"{self.recording.name}: column {name}"
        for start, stop, _ in self.parts:
            part = values[start:stop]
            if part.min() == part.max():
                raise DataError(
                    f"{where}: all samples are {part[0]:.6g} {unit}; expected the noise of a sensor at rest"
                )
            limit = _clipped(part)
            if limit is not None:
                count = int(np.count_nonzero(part == limit))
                lost = " (or are zeros in place of lost readings)" if limit == 0 else ""
                raise DataError(
                    f"{where}: {count} samples are at its limit, {limit:.6g} {unit}{lost}; expected a range that holds "
                    "the noise of a sensor at rest"
                )


def at_rest(recording: Recording, names: Sequence[str]) -> Rest:
    """Return a recording as stretches at rest of the columns `names`.

    A few rows without numbers and gaps of up to 10 samples become straight lines, longer gaps end a stretch; of a rate
    that changes, the longest part counts.

    Raises
    ------
    DataError
        There is no time or it does not rise, more than 1 % of the rows hold no numbers, a column moves, or no stretch
        holds 500 samples.
    """
    recording, notes = bridged(recording, list(names))
    recording, more = own_readings(recording, names)
    recording, trimmed = steady_part(recording)
    notes = [*(f"{recording.name}: {note}" for note in recording.notes), *notes, *more, *trimmed]
    if len(recording) < FEWEST:
        raise _too_few(recording, len(recording))
    rate, timing = sampling_rate(recording)
    for name, why in moved_columns(recording, list(names), rate).items():
        raise DataError(f"{recording.name}: column {name}: {why} Expected a unit at rest; choose its rest by --window")
    time = check_time(recording)
    usual = 1 / rate
    parts, filled, left_out = _parts(time)
    if not parts:
        raise _too_few(recording, left_out)
    # Lines about gaps are said here, for other figures than those of an Allan curve follow from them.
    notes += [line for line in timing if " in time, the longest " not in line]
    notes += [*notes_of_steps(recording, names), *doubtful_units(recording, names, rate)]
    notes += notes_of_gaps(recording.name, usual, list(map(_length, parts)), filled, left_out, len(time))
    return Rest(recording, usual, tuple(parts), filled, tuple(notes))


def notes_of_steps(recording: Recording, names: Sequence[str]) -> list[str]:
    """Say of a recording, by its first samples, which outputs take larger steps than their noise."""
    notes = []
    for name in names:
        samples = recording.column(name)[:_SEEN]
        step, noise = resolution(samples), deviation_of_steps(samples) / math.sqrt(2)
        if step > noise > 0:
            notes.append(
                f"{recording.name}: column {name}: steps of {step:.3g} {recording.units[name]}, {step / noise:.2g} "
                "times the noise of a sample: the white noise holds what rounding adds, up to all of it"
            )
    return notes


def notes_of_gaps(
    name: str, interval: float, lengths: Sequence[int], filled: int, left_out: int, rows: int
) -> list[str]:
    """Say of a log what was bridged and left out, and whether its stretches, of so many samples each, are short."""
    notes: list[str] = []
    if filled:
        kind: type[str] = Note if filled < 0.01 * rows else str
        notes.append(kind(f"{name}: {filled} samples missing in short gaps are bridged by straight lines"))
    duration = sum(lengths) * interval
    if len(lengths) > 1 or left_out:
        words = f"{len(lengths)} stretches of {duration:.4g} s in all" if len(lengths) > 1 else "one stretch"
        lost = f"; {left_out} samples in shorter ones are left out" if left_out else ""
        notes.append(f"{name}: gaps in time leave {words}, which are taken as records of the same noise{lost}")
    if duration < SHORT:
        notes.append(
            Note(f"{name}: {duration:.3g} s; below {SHORT:g} s only white noise and limits of slow noise can be told")
        )
    return notes


def _too_few(recording: Recording, count: int) -> DataError:
    return DataError(f"{recording.name}: {count} samples in a row; expected at least {FEWEST}, better 100 s and more")


def _length(part: tuple[int, int, Array | None]) -> int:
    start, stop, place = part
    return stop - start if place is None else int(place[-1]) + 1


def _parts(time: Array) -> tuple[list[tuple[int, int, Array | None]], int, int]:
    """Stretches between gaps, samples bridged within them, and samples that are in none."""
    step = np.diff(time)
    usual, longest = usual_step(step)
    wide = np.flatnonzero(step > longest)
    steps = np.round(step[wide] / usual)
    edges = [0, *(wide[steps > WIDEST_GAP] + 1).tolist(), len(time)]
    parts: list[tuple[int, int, Array | None]] = []
    filled = 0
    for start, stop in pairwise(edges):
        inside = (wide >= start) & (wide < stop - 1) & (steps > 1)
        place = None
        if inside.any():
            between = np.ones(stop - start - 1)
            between[wide[inside] - start] = steps[inside]
            place = np.concatenate([[0.0], np.cumsum(between)])
        parts.append((start, stop, place))
    lengths = np.array([stop - start for start, stop, _ in parts])
    least = max(FEWEST, SHARE * int(lengths.max()))
    order = np.argsort(-lengths, kind="stable")[:MOST]
    kept = [parts[k] for k in sorted(order.tolist()) if lengths[k] >= least]
    filled = sum(_length(part) - (part[1] - part[0]) for part in kept)
    return kept, filled, int(len(time) - sum(stop - start for start, stop, _ in kept))


def is_clipped(piled: int, next_to: int) -> bool:
    """Whether the outermost level has too many samples for noise, by how many the next level has."""
    return piled > _A_FEW and piled > _PILED * next_to + _A_FEW


def _clipped(values: Array) -> float | None:
    """Return the limit at which samples pile up: more than twice as many as at the next level; noise has fewer."""
    if len(distinct(values[:_SEEN])) < LEVELS:
        return None
    for limit, outside, nearest in ((values.max(), np.less, np.max), (values.min(), np.greater, np.min)):
        piled = int(np.count_nonzero(values == limit))
        if piled > _A_FEW:
            below = nearest(values[outside(values, limit)])
            if is_clipped(piled, int(np.count_nonzero(values == below))):
                return float(limit)
    return None

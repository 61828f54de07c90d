"""Defects of a recording of turns: time stamps in bursts, gaps within a turn, and saturated outputs."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from imulab.display import Note
from imulab.errors import DataError
from imulab.procedures.rate import AXES
from imulab.recording import Array

_QUICK, _SHARE_IN_BURSTS = 0.25, 0.25  # of the mean step; share of such short steps from which stamps come in bursts
_KEEPS = 0.1  # s by which such stamps are off a straight line at most
_GAP = 3.0  # usual steps: within a longer one motion may be hidden
_SHAKE = (2 * np.pi * 2.0) ** 2 / 12
"""Angle error across a gap, over rate and gap cubed: a straight line in place of a rate that a hand varies at 2 Hz."""
_STILL_SAMPLES = 10  # equal samples in a row from which an output stands still
_QUIET = 0.5  # share of equal neighbours at rest from which this is usual for the output


def even_stamps(time: Array, name: str) -> tuple[Array, list[str]]:
    """Return time stamps, s, evened where they come in bursts, and the note that says so.

    A quarter of the steps or more are shorter than a quarter of the mean, as no sensor samples, and the stamps keep to
    a straight line within 0.1 s and ten samples.
    """
    step = np.diff(time)
    mean = float(step.mean())
    if float((step < _QUICK * mean).mean()) < _SHARE_IN_BURSTS:
        return time, []
    count = np.arange(len(time), dtype=np.float64)
    even = np.polynomial.Polynomial.fit(count, time, 1)(count)
    if float(np.abs(time - even).max()) > _KEEPS + _STILL_SAMPLES * mean:
        return time, []
    note = Note(
        f"{name}: the time stamps come in bursts (steps of {1e3 * float(step.min()):.3g} to "
        f"{1e3 * float(step.max()):.3g} ms): taken as even, {1 / float(even[1] - even[0]):.5g} Hz"
    )
    return np.asarray(even), [note]


def check_motions(time: Array, rate: Array, rests: list[tuple[int, int]], fence: float, name: str) -> None:
    """Refuse a gap inside a turn that may hide more motion than the fence, and an output that is saturated.

    Raises
    ------
    DataError
        There is one; the message names the time.
    """
    usual = float(np.median(np.diff(time)))
    repeats = np.mean([np.mean(np.diff(rate[a:b], axis=0) == 0, axis=0) for a, b in rests], axis=0)
    for (_, end), (start, _) in pairwise(rests):
        part, at = rate[end - 1 : start + 1], time[end - 1 : start + 1]
        step = np.diff(at)
        beside = np.maximum(np.linalg.norm(part[1:], axis=1), np.linalg.norm(part[:-1], axis=1))
        hidden = np.where(step > _GAP * usual, _SHAKE * beside * step**3, 0.0)
        worst = int(np.argmax(hidden))
        if hidden[worst] > fence:
            raise DataError(
                f"{name}: samples are missing from {at[worst]:.2f} to {at[worst + 1]:.2f} s, while the unit turned at "
                f"{np.degrees(beside[worst]):.0f} deg/s: the angle of that turn is not known; leave it out (--window)"
            )
        for axis in range(3):
            values = np.abs(part[:, axis])
            top = values == values.max()
            edges = np.flatnonzero(np.diff(np.concatenate([[False], top, [False]]).astype(int))).reshape(-1, 2)
            longest = edges[int(np.argmax(edges[:, 1] - edges[:, 0]))]
            if longest[1] - longest[0] >= _STILL_SAMPLES and repeats[axis] < _QUIET:
                raise DataError(
                    f"{name}: gyro_{AXES[axis]} stands still at {np.degrees(values.max()):.5g} deg/s from "
                    f"{at[longest[0]]:.2f} to {at[longest[1] - 1]:.2f} s: its output is saturated; turn more slowly"
                )

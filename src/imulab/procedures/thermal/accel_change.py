"""What the accelerometers of a rest ramp tell: how their output along gravity changes with the temperature.

At rest the sum of forces along gravity is g, whatever the temperature. So the mean outputs of parts of the ramp along
the direction of their mean are ``g + offset + g * scale error`` there: a change over temperature is one of bias and
scale factor together. Across gravity a change cannot be told from a tilt of what the unit stands on, and nothing is
said of it; along gravity a tilt of 1 mrad counts as 0.5 ug.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from imulab.columns import triad
from imulab.display import Note
from imulab.estimation.rows import leave_out
from imulab.procedures.thermal.holds import Holds
from imulab.procedures.thermal.schema import AccelChange
from imulab.procedures.thermal.slow_noise import fit_noise
from imulab.recording import Array, Recording
from imulab.report.parameters import small_unit
from imulab.units import parse_unit

_DEGREE, _PLACES = 3, 9
_FEWEST = 20  # samples of a part


def find_changes(recordings: Sequence[Recording], holds: Holds) -> AccelChange | None:
    """Return the changes of each recording that has accelerometers in a unit of acceleration, None where none has."""
    names, fits = list[str](), list[tuple[Array, Array, Array, Array]]()
    for number, recording in enumerate(recordings):
        if not set(triad("accel")) <= set(recording.columns):
            continue
        if parse_unit(recording.triad_unit("accel")).quantity != "acceleration":
            continue
        parts = np.flatnonzero(holds.recording == number)
        kept = leave_out(recording, triad("accel")).recording
        mean, count = _average(kept, holds.start[parts], holds.stop[parts])
        parts, mean = parts[count >= _FEWEST], mean[count >= _FEWEST]
        if len(parts) > 2 * (_DEGREE + 1):
            names.append(recording.name)
            fits.append(_fit(mean, holds.temperature[parts], 0.5 * (holds.start + holds.stop)[parts]))
    up, temperature, change, u = ([each[k].tolist() for each in fits] for k in range(4))
    return None if not names else AccelChange(
        recording=names, up=up, temperature=temperature, change=change, standard_uncertainty=u
    )  # fmt: skip


def _average(recording: Recording, start: Array, stop: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return the mean outputs of the parts, m/s^2, shape (n, 3), and their numbers of samples."""
    time = recording.si("time")
    output = np.column_stack([recording.si(name) for name in triad("accel")])
    first, last = np.searchsorted(time, start), np.searchsorted(time, stop)
    total = np.vstack([np.zeros(3), np.cumsum(output, axis=0)])
    return (total[last] - total[first]) / np.maximum(last - first, 1)[:, None], last - first


def _fit(mean: Array, temperature: Array, time: Array) -> tuple[Array, Array, Array, Array]:
    """Return up in the body, temperatures over the range, and there the changes from its middle, with their u."""
    up: Array = mean.mean(axis=0)
    up = np.asarray(up / np.linalg.norm(up), dtype=np.float64)
    low, high = float(temperature.min()), float(temperature.max())
    places: Array = np.linspace(low, high, _PLACES)

    def terms(at: Array) -> Array:
        return np.asarray(
            np.polynomial.chebyshev.chebvander((2 * at - low - high) / (high - low), _DEGREE), dtype=np.float64
        )

    design = terms(temperature)
    whitened = np.linalg.inv(np.linalg.cholesky(fit_noise((mean @ up)[:, None], design, time)[0]))
    information = whitened @ design
    covariance = np.linalg.inv(information.T @ information)
    law = covariance @ information.T @ (whitened @ (mean @ up))
    apart = terms(places) - terms(places[[_PLACES // 2]])
    spread = np.einsum("na,ab,nb->n", apart, covariance, apart)
    u: Array = np.sqrt(np.maximum(spread, 0.0))
    return up, places, np.asarray(apart @ law, dtype=np.float64), u


def note_on(change: AccelChange | None) -> list[str]:
    """Return what the changes are of, and how large, for each recording."""
    notes: list[str] = []
    if change is None:
        return notes
    read = small_unit("m/s^2")
    rows = zip(change.recording, change.up, change.temperature, change.change, change.standard_uncertainty, strict=True)
    for name, up, at, values, u in rows:
        ends = []
        for end in (0, -1):
            value, spread = read.texts(values[end], u[end])
            ends.append(f"{value} {read.symbol} (u {spread}) at {at[end]:.0f} degC")
        notes.append(
            Note(
                f"accel: {name}: from {at[len(at) // 2]:.0f} degC the output along gravity changes by "
                f"{' and '.join(ends)}, bias and scale factor together (up in the body is "
                f"{' '.join(f'{each:.2f}' for each in up)}); across gravity a change of bias cannot be told from a tilt"
            )
        )
    return notes

"""What a user of noise models must know, a sentence each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from imulab.estimation.noise.rest import Rest
from imulab.estimation.noise.use import at_band_edge, edge_as_white, letters_inside
from imulab.procedures.noise.choices import rejected
from imulab.procedures.noise.engineering import density, shown
from imulab.report.elements import plain_number
from imulab.verdict import Note

if TYPE_CHECKING:
    from imulab.procedures.noise.model import ColumnModel, Drift

_MANY_SPIKES = 0.01
_MOST_NAMED = 3
_SLOW, _LEANS = 10.0, 0.005


def findings(columns: Mapping[str, ColumnModel], rests: Sequence[Rest], horizon: float) -> tuple[str, ...]:
    """Return the findings on all columns, those that several have in one sentence."""
    said: dict[tuple[type[str], str], list[str]] = {}
    for name, column in columns.items():
        if rejected(p := column.analysis.test.probability, len(columns)):
            text = f"no model of these terms fits (p = {p:.1g}); the numbers tell the size of the noise alone"
            said[(str, text)] = [name]
        for kind, text in _of_column(column):
            said.setdefault((kind, text), []).append(name)
    found = [note for rest in rests for note in rest.notes]
    for (kind, text), names in said.items():
        found.append(kind(f"{_named(names)}: {text}"))
    longest = max(column.analysis.length for column in columns.values())
    if horizon > longest / _SLOW:
        found.append(
            Note(
                f"horizon {horizon:g} s: more than a tenth of the record of {longest:.4g} s, whose slow noise is "
                "hardly known over such times"
            )
        )
    return tuple(dict.fromkeys(found))


def _named(names: Sequence[str]) -> str:
    return " ".join(names) if len(names) == 1 else f"columns {' '.join(names)}"


def _of_column(column: ColumnModel) -> list[tuple[type[str], str]]:
    analysis = column.analysis
    found: list[tuple[type[str], str]] = []
    if not analysis.band.flat:
        found.append((str, "the spectrum is level nowhere, so that white noise is not told apart from other noise"))
    elif analysis.band.filtered(analysis.interval):
        highest, low = analysis.band.highest, 2 * analysis.band.roll_off
        lean = (
            f", which may leave the white noise up to {plain_number(100 * low, 1)} % too small" if low > _LEANS else ""
        )
        text = f"fitted up to {highest:.3g} Hz; from about {2 * highest:.3g} Hz on the spectrum is not level"
        found.append((Note, text + lean))
    if at_band_edge(analysis.values, analysis.limits[0]).any():
        found.append((Note, _edge(column)))
    samples = sum(each.count for each in analysis.stretches)
    if column.spikes:
        kind: type[str] = str if column.spikes > _MANY_SPIKES * samples else Note
        found.append((kind, f"{column.spikes} spikes replaced, of {samples} samples"))
    if column.knocks:
        start, lost = column.knocks[0][0], sum(length for _, length in column.knocks)
        many = f"{len(column.knocks)} knocks or other parts" if len(column.knocks) > 1 else "a knock or other part"
        text = f"{many} unlike the noise around, {lost:.2g} s from {start:.5g} s on, bridged by straight lines"
        found.append((str if lost > _MANY_SPIKES * samples * analysis.interval else Note, text))
    if column.lines:
        found.append((Note, _lines(column)))
    for low, high, factor in analysis.allowance.off[:_MOST_NAMED]:
        found.append((Note, f"from {low:.3g} to {high:.3g} Hz the spectrum, left out, is {factor:.2g} of the model"))
    for step in column.steps:
        text = f"the level changes by {_sized(step.size, column.unit)} at {step.time:.4g} s"
        found.append((str, f"{text}, which slow noise does not make; --steps remove takes it out"))
    found += [each for drift in column.drifts if (each := _drift(drift, column)) is not None]
    choice, shortest = analysis.choice, analysis.limits[0]
    near = [analysis.index, *np.flatnonzero(choice.rivals[0]).tolist()]
    models = (letters_inside(choice.models[0, k], choice.values[0, k], shortest) for k in near)
    chosen, *rivals = dict.fromkeys(models)
    if rivals:
        found.append((Note, f"{chosen} and {', '.join(rivals)} describe the record about equally well"))
    return found


def _edge(column: ColumnModel) -> str:
    """Say what a Gauss-Markov term of the shortest time constant is, and what the white noise is with it."""
    analysis = column.analysis
    factor, unit = density(column.unit)
    level = float(edge_as_white(analysis.values, analysis.covariance, analysis.limits[0])[0][0])
    return (
        f"the white noise, {plain_number(level * factor, 3)} {unit} at low frequencies, falls to "
        f"{plain_number(float(analysis.values[0]) * factor, 3)} at the end of the band, as behind a filter or beside "
        "vibration: no slow noise; filters get the white noise of low frequencies"
    )


def _lines(column: ColumnModel) -> str:
    named = ", ".join(
        f"{line.frequency:.4g} Hz of {_sized(line.amplitude, column.unit)}" for line in column.lines[:_MOST_NAMED]
    )
    many = len(column.lines)
    return f"{many} line{'s' if many > 1 else ''} of the spectrum left out, the largest {named}"


def _drift(drift: Drift, column: ColumnModel) -> tuple[type[str], str] | None:
    if not drift.found.follows:
        return None
    factor, unit = shown("bias", column.unit)
    per = "h" if drift.covariate == "time" else "K"
    scale = factor * (3600.0 if drift.covariate == "time" else 1.0)
    slope = f"{drift.slope * scale:.2g} ± {drift.standard_uncertainty * scale:.1g} ({unit})/{per}"
    if drift.taken:
        return Note, f"follows the {drift.covariate}, {slope}, which was taken out"
    return (
        str,
        f"follows the {drift.covariate}, {slope}; model {drift.letters[0]}, without that drift {drift.letters[1]} "
        f"(--regress {drift.covariate})",
    )


def _sized(value: float, unit: str) -> str:
    factor, name = shown("bias", unit)
    return f"{value * factor:.3g} {name}"

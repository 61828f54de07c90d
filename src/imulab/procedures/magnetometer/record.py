"""The record of a magnetometer alone: parameters in SI, what is left of the readings, and what is said of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.display import UNJUDGED, Bad, Finding, Note
from imulab.estimation.decisions import FIELD_ALONE_STEP, OUTPUTS_BEND_CLEARLY
from imulab.estimation.distributions import f_tail, probability_text
from imulab.estimation.least_squares import coverage_factor
from imulab.procedures.magnetometer import ALL_WAYS, GAUGE, LEVEL
from imulab.procedures.magnetometer.model import FittedTurn, MagReadings, not_told, parameter_names
from imulab.procedures.magnetometer.schema import FieldModel, FieldReadings, FieldSummary
from imulab.procedures.magnetometer.solve import BLOCKS, LEAST_IN_BLOCK, uncertainties, widest_gap
from imulab.recording import Array
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.records.sections import Length, Quantity, entries
from imulab.units import parse_unit

_POORLY, _POOR_DIRECTION = 0.01, np.radians(1.0)
"""Standard uncertainty of |m| where it is largest, as a part of the field, and of its direction, from which there is a
warning."""
_LARGE_RMS, _HOPELESS = 0.02, 0.10
"""Scatter of |m| that readings in one field do not have, and that from which the record is bad."""
_OF_NOISE = 0.5  # of the scatter: what is left of it without noise of single readings, up to which that is all
_SHARE_NOTED, _SHARE_BAD = 1e-3, 0.3
"""Share of disturbed readings up to which there is only a note, and from which the record is bad."""
_OF_THE_EARTH, _BUILDING = (22e-6, 67e-6), 1.4
"""Least and largest magnitude of the Earth's field, T, and the factor by which iron of a building may change it."""
_KEPT = 600  # readings that a record keeps for figures
_MOST_NAMED = 3  # disturbed stretches
_LEAST_PART = 3  # blocks before and after a step
_NOTICED = 0.005  # of the field: smaller terms beside the surface, and steps of |m|, are notes
_POWER_NAMES = {2: "square", 3: "third power"}


def make_record(turned: FittedTurn, known: float | None, origin: str, options: Mapping[str, Any]) -> Calibration:
    """Return the record; `known` is the field's magnitude, T, from `origin`, None for that of the outputs."""
    readings, surface = turned.readings, turned.surface
    unit = parse_unit(readings.unit)
    in_field = unit.quantity == "magnetic field"
    if in_field and known is None:  # the outputs' mean sensitivity counts as right
        known, origin = unit.factor * surface.gain, "outputs"
    field = Quantity(value=1.0, unit="1") if known is None else Quantity(value=known, unit="T")
    parameters, covariance = _make_parameters(turned, field)
    residual = turned.residual
    summary = _summarize(turned, residual)
    recording = readings.recording
    return Calibration(
        procedure="magnetometer",
        parameters=parameters,
        covariance=covariance,
        model=entries(
            FieldModel(
                mag_output_unit=readings.unit, field=field, field_from="unit" if known is None else origin,
                gauge=GAUGE, turned=LEVEL if turned.upright else ALL_WAYS, upright=turned.upright,
            )
        ),
        fit=entries(summary),
        options=dict(options),
        data=entries(_kept_readings(turned, residual)),
        sensor={key: word for key in ("serial", "model", "element") if (word := recording.metadata.get(key))},
        sources=() if recording.source is None else (recording.source,),
        warnings=(
            *recording.notes,
            *readings.notes,
            *_notes_on_turn(turned.upright),
            *_notes_on_field(turned.upright, known, origin, in_field=in_field),
            *_warn_disturbed(readings, residual, turned.aside),
            *_warn_scatter(turned),
            *_warn_coverage(turned, summary),
            *_warn_bends(turned),
            *(_warn_step(readings, residual, turned.aside) or _warn_change(turned)),
        ),
        verdict=UNJUDGED,
    )  # fmt: skip


def _make_parameters(turned: FittedTurn, field: Quantity) -> tuple[dict[str, Parameter], Covariance]:
    """Return hard iron, T or the unit of the outputs, and soft iron per `field`, with their covariance."""
    surface, unit = turned.surface, parse_unit(turned.readings.unit)
    in_field = unit.quantity == "magnetic field"
    factor, d = unit.factor if in_field else 1.0, len(turned.axes)
    scale = np.concatenate([np.full(d, factor), np.full(len(surface.theta) - d, factor / field.value)])
    of_bias = "T" if in_field else unit.symbol
    of_soft = "1" if in_field else unit.symbol if field.unit == "1" else f"{unit.symbol}/T"
    names, matrix = parameter_names(turned.axes), surface.covariance * np.outer(scale, scale)
    coverage = coverage_factor(surface.freedom)
    parameters = {}
    for k, (name, value, variance) in enumerate(
        zip(names, (scale * surface.theta).tolist(), np.diag(matrix).tolist(), strict=True)
    ):
        u = float(np.sqrt(variance))
        limits = (value - coverage * u, value + coverage * u)
        parameters[name] = Parameter(value, u, of_bias if k < d else of_soft, interval_95=limits)
    return parameters, Covariance(tuple(names), tuple(map(tuple, matrix.tolist())))


def _summarize(turned: FittedTurn, residual: Array) -> FieldSummary:
    """Return ``fit``."""
    surface, unit = turned.surface, parse_unit(turned.readings.unit)
    in_field = unit.quantity == "magnetic field"
    noise = Length(value=surface.sigma * (unit.factor if in_field else 1.0), unit="T" if in_field else unit.symbol)
    mean, largest, direction = uncertainties(surface)
    return FieldSummary(
        readings=len(residual),
        set_aside=int(turned.aside.sum()),
        rms=turned.scatter(),
        noise=noise,
        inflation=surface.inflation,
        degrees_of_freedom=surface.freedom,
        coverage_factor_95=coverage_factor(surface.freedom),
        condition_number=surface.condition,
        magnitude=mean,
        largest_magnitude=largest,
        direction=Length(value=direction, unit="rad"),
        widest_gap=Length(value=widest_gap(turned.field[~turned.aside])[0], unit="rad"),
        not_told=not_told(turned.axes),
    )


def _kept_readings(turned: FittedTurn, residual: Array) -> FieldReadings:
    """Return some readings, evenly over the recording, for figures."""
    some = np.unique(np.linspace(0, len(residual) - 1, min(len(residual), _KEPT)).astype(np.intp))
    time = turned.readings.time
    return FieldReadings(
        time=[None] * len(some) if time is None else time[some].tolist(),
        output=turned.readings.output[some].tolist(),
        field=turned.field[some].tolist(),
        magnitude=residual[some].tolist(),
        used=(~turned.aside[some]).tolist(),
    )


# What is said of a fit.


def _notes_on_turn(upright: str | None) -> list[str]:
    """Return what the test does not tell."""
    notes: list[str] = [
        Note(
            "mag: how the magnetometers are turned against the body shows in no magnitude and is not told, nor whether "
            "an axis is reversed or two are exchanged (fit.not_told); tumble mag with accelerometers tells it"
        )
    ]
    if upright is not None:
        notes.append(
            Note(
                f"mag: a level turn about axis {upright} tells two offsets, their ratio and its angle. Axis {upright} "
                "is not told (fit.not_told): apply leaves it as it is, and the record holds for a level unit only"
            )
        )
    return notes


def _notes_on_field(upright: str | None, known: float | None, origin: str, *, in_field: bool) -> list[str]:
    """Return what the magnitude of the field rests on, where it was not stated."""
    if known is None:
        text = "mag: the field's magnitude was not stated: the corrected field is in units of the local one (--field)"
        return [Note(text)]
    if origin != "outputs":
        return []
    part, (low, high) = "level part of the " if upright else "", _OF_THE_EARTH
    notes: list[str] = [
        Note(
            "mag: the field's magnitude was not stated: the outputs' mean sensitivity counts as right, by which the "
            f"{part}field is {1e6 * known:.4g} uT (--field, --place)"
        )
    ]
    if in_field and upright is None and not low / _BUILDING < known < high * _BUILDING:
        notes.append(
            Finding(
                f"mag: |m| is {1e6 * known:.3g} uT, but the Earth's field has {1e6 * low:.0f} to {1e6 * high:.0f} uT: "
                "is the unit of the outputs right?",
                "state the unit of the outputs (--unit mag=...), or the field (--field)",
            )
        )
    return notes


def _warn_disturbed(readings: MagReadings, r: Array, aside: NDArray[np.bool_]) -> list[str]:
    """Return a warning of readings that were set aside, with where they are and how large |m| was."""
    share = float(aside.mean())
    if not share:
        return []
    where = readings.stretches(aside)
    most = float(r[aside][np.argmax(np.abs(r[aside]))])
    more = f" and {len(where) - _MOST_NAMED} more" if len(where) > _MOST_NAMED else ""
    text = (
        f"mag: {int(aside.sum())} of {len(r)} readings set aside ({', '.join(where[:_MOST_NAMED])}{more}): |m| is up "
        f"to {100 * abs(most):.2g} % {'high' if most > 0 else 'low'} there: was steel or a magnet near?"
    )
    kind = Note if share < _SHARE_NOTED else Bad if share > _SHARE_BAD else Finding
    return [kind(text, "record again, away from steel, phones and vehicles")]


def _warn_scatter(turned: FittedTurn) -> list[str]:
    """Return a warning where |m| scatters more than in one field, and more than the noise of single readings."""
    scatter, white = turned.scatter(), turned.white()
    slow = float(np.sqrt(scatter**2 - white**2))
    if scatter <= _LARGE_RMS:
        return []
    if slow < _OF_NOISE * scatter and scatter <= _HOPELESS:
        return [
            Note(
                f"mag: |m| scatters by {100 * scatter:.2g} % of the field, which is noise of single readings: "
                f"{100 * white:.2g} % from each to the next. More readings make up for it"
            )
        ]
    kind = Bad if scatter > _HOPELESS else Finding
    level = "was the turn level, and was" if turned.upright else "was"
    return [
        kind(
            f"mag: |m| scatters by {100 * scatter:.2g} % of the field: {level} no iron near that moved, or the unit "
            "carried through a field that changes from place to place?",
            "record again on one spot, away from iron",
        )
    ]


def _warn_coverage(turned: FittedTurn, fit: FieldSummary) -> list[str]:
    """Return a warning where the directions leave the corrected field poorly known."""
    _, largest, direction = uncertainties(replace(turned.surface, beyond=0.0))
    if largest <= _POORLY and direction <= _POOR_DIRECTION:
        return []
    return [
        Finding(
            f"mag: the readings leave out directions {np.degrees(fit.widest_gap.value):.0f} deg off the nearest, where "
            f"|m| is known to {100 * largest:.2g} %; the direction of the field is known to "
            f"{np.degrees(direction):.2g} deg",
            "turn the unit once around or more, evenly"
            if turned.upright
            else "turn the unit through all directions, each axis up and down",
        )
    ]


def _warn_step(readings: MagReadings, r: Array, aside: NDArray[np.bool_]) -> list[str]:
    """Return a warning of a step of |m| at some time, by means of residuals over blocks of readings.

    The step that explains most is tested by F(1, B - 2) over the scatter of the B means, times the number of splits.
    """
    kept = np.flatnonzero(~aside)
    if len(kept) < LEAST_IN_BLOCK * BLOCKS:
        return []
    parts = np.array_split(kept, BLOCKS)
    means = np.array([r[part].mean() for part in parts])
    means -= means.mean()
    splits = np.arange(_LEAST_PART, BLOCKS - _LEAST_PART + 1)
    sums = np.cumsum(means)[splits - 1]
    gain = sums**2 * BLOCKS / (splits * (BLOCKS - splits))
    best = int(np.argmax(gain))
    ratio = gain[best] / (max(float((means**2).sum()) - gain[best], 1e-300) / (BLOCKS - 2))
    p = min(float(f_tail(float(ratio), 1.0, BLOCKS - 2.0)) * len(splits), 1.0)
    if p > FIELD_ALONE_STEP.level:
        return []
    first = int(splits[best])
    size = float(means[first:].mean() - means[:first].mean())
    time = readings.time
    row = int(parts[first][0])
    where = f"row {readings.row[row] + 1}" if time is None else f"{time[row]:.1f} s"
    way = "higher" if size > 0 else "lower"
    text = f"mag: from {where} on |m| is {100 * abs(size):.2g} % {way} than before ({probability_text(p)})"
    if abs(size) < _NOTICED:
        return [Note(f"{text}, as by noise that is slow or a drift")]
    return [
        Finding(
            f"{text}: did iron come near, or did the place change?",
            "record again at one place, away from phones and iron",
        )
    ]


def _warn_change(turned: FittedTurn) -> list[str]:
    """Return what is said of another hard iron from some time on: a magnet or a current that turns with the unit."""
    change, readings = turned.change, turned.readings
    if change is None:
        return []
    row = int(np.flatnonzero(~turned.aside)[change.first])
    where = f"row {readings.row[row] + 1}" if readings.time is None else f"{readings.time[row]:.1f} s"
    share = float(np.linalg.norm(change.size)) / turned.surface.gain
    shown = f"{100 * share:.2g} % of the field ({probability_text(change.probability)})"
    text = f"mag: from {where} on the hard iron is another by {shown}"
    if share < _NOTICED:
        return [Note(f"{text}, as by noise that is slow or a drift; its uncertainty holds both")]
    return [
        Finding(
            f"{text}: did a phone, a magnet or a current come to the unit?",
            "record again with all that belongs to the unit in place and switched on, and nothing else near",
        )
    ]


def _warn_bends(turned: FittedTurn) -> list[str]:
    """Return what is said of outputs that are not straight."""
    warnings: list[str] = []
    for power, bend in turned.bends.items():
        if bend.probability > OUTPUTS_BEND_CLEARLY.level:
            continue
        unit = parse_unit(turned.readings.unit)
        factor, symbol = (1e6 * unit.factor, "uT") if unit.quantity == "magnetic field" else (1.0, unit.symbol)
        largest = float(np.linalg.norm(bend.size)) if not bend.determined else float(np.abs(bend.size).max())
        each = zip(turned.axes, (factor * bend.size).tolist(), strict=True)
        sizes = ", ".join(f"{axis} {value:+.2g}" for axis, value in each)
        if not bend.determined:
            sizes = f"(of an axis that is not told) {factor * largest:.2g}"
        text = (
            f"mag: |m| follows the direction as no ellipsoid does: outputs with a {_POWER_NAMES[power]} of the field, "
            f"at its full size {sizes} {symbol} ({probability_text(bend.probability)}), explain it. "
            "What of it looks like hard and soft iron is in the uncertainties"
        )
        if largest < _NOTICED * turned.surface.gain:
            warnings.append(Note(text))
            continue
        level = "was the turn level, and is" if turned.upright else "is"
        warnings.append(
            Finding(
                f"{text}: {level} the sensor near the end of its range?",
                "take magnets and steel off the unit, or set a wider range of the sensor, and record again",
            )
        )
    return warnings

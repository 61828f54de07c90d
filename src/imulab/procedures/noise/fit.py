"""The fit of noise models to logs at rest, column by column, and the record: parameters, filter's numbers, findings.

The mathematics stands in `imulab.estimation.noise`: `spectrum` makes binned cosine spectra, `likelihood` fits models to
them, `analysis` chooses among models and tests the fit, `terms` gives white noise and walk for filters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, NoReturn, Unpack

import numpy as np
from numpy.typing import NDArray

from imulab.arguments import checked
from imulab.columns import kind_of
from imulab.display import Finding, Note, join_alike, prefixed
from imulab.errors import DataError, OptionError, RecordError, UnitError, listed, several
from imulab.estimation.column_noise import noise_columns
from imulab.estimation.distributions import probability_text
from imulab.estimation.noise.analysis import (
    CANDIDATES,
    Analysis,
    Regression,
    allan_of_bins,
    analysed,
    analyses,
    ramp_coefficients,
    without_steps,
)
from imulab.estimation.noise.changes import WarmUp, changes_of_level, loudness_change, warm_up
from imulab.estimation.noise.cleaning import LevelChange, Line
from imulab.estimation.noise.likelihood import Flags
from imulab.estimation.noise.rest import Rest, at_rest, long_rest
from imulab.estimation.noise.spectrum import Stretch
from imulab.estimation.noise.terms import (
    NAMES,
    SIGMA,
    TIME,
    allan_variance,
    at_band_edge,
    bias_square,
    edge_as_white,
    letters,
    letters_inside,
    terms,
    walk_square,
    white_square,
)
from imulab.estimation.rows import NORMAL_95, distinct
from imulab.frames import is_frame
from imulab.options import choice, measure, names_of_columns, parsed
from imulab.procedures.noise import (
    COVARIATES,
    HORIZON,
    NO_COVARIATE,
    SAY_STEPS,
    STEPS,
    check_options,
    check_terms,
    rejected,
    spelled,
)
from imulab.procedures.noise.schema import term_unit
from imulab.procedures.result import OWN_CLOCKS, Result, as_blocks, as_recording
from imulab.quantities import in_si
from imulab.readers.streams import own_clock
from imulab.recording import Array, Data, Reading, Recording, Source, check_not_resampled, is_large, on_disk
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.records.comparison import different_units
from imulab.report.parameters import reading_unit, small_unit
from imulab.report.traces import plain_number
from imulab.units import parse_unit, si_unit

# Results of one column.


_COVARIATE_UNITS = {"time": "s", "temperature": "K"}


@dataclass(frozen=True)
class CovariateDrift:
    """Dependence of a column on time or temperature, and the terms of its model without and with that dependence.

    `taken` says whether the dependence was removed before the model was fitted; `rounding` is the step of the
    covariate's readings, SI, where that is coarse.
    """

    covariate: str
    regression: Regression
    letters: tuple[str, str]
    taken: bool
    rounding: float = 0.0

    @property
    def slope(self) -> float:
        """Slope, in the column's unit over that of the covariate, SI."""
        return float(self.regression.slope[0])

    @property
    def standard_uncertainty(self) -> float:
        """Standard uncertainty of the slope."""
        return float(self.regression.standard_uncertainty[0])


@dataclass(frozen=True)
class ColumnModel:
    """The noise of a column.

    Attributes
    ----------
    name, unit
        Name of the column, and its unit in SI.
    analysis
        Spectrum, candidates, chosen model.
    spikes, knocks, lines, steps
        What is not noise; of knocks start and length, s.
    drifts
        Dependence on time and temperature.
    warming
        Drift of a sensor that warms up.
    """

    name: str
    unit: str
    analysis: Analysis
    spikes: int
    knocks: tuple[tuple[float, float], ...]
    lines: tuple[Line, ...]
    steps: tuple[LevelChange, ...]
    drifts: tuple[CovariateDrift, ...]
    warming: WarmUp | None = None


# Logs: short ones as recordings, large files block by block or with columns on disk.


def given_log(
    data: Data,
    reading: Reading,
    function: Callable[..., Any],
    choose: Callable[[Recording], Sequence[str]],
    named: Callable[[NDArray[Any]], Mapping[str, Any]] | None = None,
) -> Recording | Rest:
    """Return a log from the data of a call, as a recording or as `read_log` does; errors as for `as_recording`."""
    return read_log(
        Path(data) if isinstance(data, str | PathLike) else None,
        lambda: as_blocks(data, reading, function, clock=OWN_CLOCKS),
        lambda: as_recording(data, reading, function, columns=named, clock=OWN_CLOCKS),
        choose,
    )


def read_log(
    path: Path | None,
    blocks: Callable[[], tuple[Iterator[Recording], Source | None]],
    whole: Callable[[], Recording],
    choose: Callable[[Recording], Sequence[str]],
) -> Recording | Rest:
    """Return a log; of a large file at rest, read block by block, the stretches without their rows.

    If a large file has to be read as a whole, its columns lie in temporary files.

    Parameters
    ----------
    path
        Path of the file, None if there is none.
    blocks
        Returns the file's blocks and its source.
    whole
        Reads the file as a whole if it is short.
    choose
        Returns the columns to fit, from the first block.
    """
    if not is_large(path):
        return whole()
    read, source = blocks()
    first = next(read)
    names = choose(first) if first.on_one_clock else []
    rest = long_rest(chain([first], read), names) if names else None
    if rest is None:
        return replace(on_disk(blocks()[0]), source=source)
    return replace(rest, recording=replace(rest.recording, source=source))


# Findings for the user, a sentence each.


_MANY_SPIKES = 0.01  # share of samples, or of the time, from which spikes or knocks are a warning and no note
_MOST_NAMED = 3  # lines of a spectrum that are named
# Largest horizon in parts of a record; largest share of white noise that a roll-off may take without a note
_SLOW_FACTOR, _LEANS = 10.0, 0.005


def findings(columns: Mapping[str, ColumnModel], rests: Sequence[Rest], horizon: float) -> tuple[str, ...]:
    """Return the findings on all columns; columns with the same finding share a sentence."""
    on_columns: list[tuple[str, str]] = []
    warm_from = max((column.warming.lasts for column in columns.values() if column.warming), default=0.0)
    for name, column in columns.items():
        if column.warming:
            on_columns.append((name, _describe_warming(column.warming, column, warm_from)))
        if rejected(p := column.analysis.test.probability, len(columns)):
            text = f"no model of these terms fits ({probability_text(p)}); the numbers tell the size of the noise alone"
            on_columns.append((name, Finding(text, "take the white noise alone, or fit a quieter part (--window)")))
        on_columns += [(name, finding) for finding in _describe_column(column)]
    messages = [note for rest in rests for note in rest.notes]
    left = [name for name in rests[0].recording.columns if kind_of(name) == "mag" and name not in columns]
    if left and len(left) == sum(kind_of(name) == "mag" for name in rests[0].recording.columns):
        messages.append(Note(f"{_named(left)}: magnetometers are not fitted unless --columns names them"))
    messages += [prefixed(_named(names), finding) for names, finding in join_alike(on_columns)]
    longest = max(column.analysis.length for column in columns.values())
    if horizon > longest / _SLOW_FACTOR:
        messages.append(
            Note(
                f"horizon {horizon:g} s: more than a tenth of the record of {longest:.4g} s, whose slow noise is "
                "hardly known over such times"
            )
        )
    return tuple(dict.fromkeys(messages))


def _named(names: Sequence[str]) -> str:
    return " ".join(names) if len(names) == 1 else f"columns {' '.join(names)}"


def _describe_column(column: ColumnModel) -> list[str]:
    """Return the findings on one column."""
    analysis = column.analysis
    messages: list[str] = []
    if not analysis.band.flat:
        text = "the spectrum is level nowhere, so that white noise is not told apart from other noise"
        messages.append(Finding(text, "log at a higher rate, or with a wider filter"))
    elif analysis.band.filtered(analysis.interval):
        highest, low = analysis.band.highest, 2 * analysis.band.roll_off
        lean = (
            f", which may leave the white noise up to {plain_number(100 * low, 1)} % too small" if low > _LEANS else ""
        )
        text = f"fitted up to {highest:.3g} Hz; from about {2 * highest:.3g} Hz on the spectrum is not level"
        messages.append(Note(text + lean))
    if at_band_edge(analysis.values, analysis.limits[0]).any():
        messages.append(Note(_describe_edge(column)))
    samples = sum(each.count for each in analysis.stretches)
    if column.spikes:
        kind = Finding if column.spikes > _MANY_SPIKES * samples else Note
        text = f"{column.spikes} spikes replaced, of {samples} samples"
        messages.append(kind(text, "check the link to the sensor, and record again"))
    if column.knocks:
        start, lost = column.knocks[0][0], sum(length for _, length in column.knocks)
        many = f"{len(column.knocks)} knocks or other parts" if len(column.knocks) > 1 else "a knock or other part"
        text = f"{many} unlike the noise around, {lost:.2g} s from {start:.5g} s on, bridged by straight lines"
        kind = Finding if lost > _MANY_SPIKES * samples * analysis.interval else Note
        messages.append(kind(text, "let the unit rest undisturbed, and record again"))
    if change := loudness_change(_longest(analysis.stretches)):
        text = (
            f"noise is {change.factor:.3g} times as loud from {change.time:.5g} s on; the model is a mean of both parts"
        )
        action = "fit both parts apart (--window), or record again at one temperature, fans and motors as in use"
        messages.append(Finding(text, action))
    if column.lines:
        messages.append(Note(_describe_lines(column)))
    for low, high, factor in analysis.allowance.off[:_MOST_NAMED]:
        messages.append(Note(f"from {low:.3g} to {high:.3g} Hz the spectrum, left out, is {factor:.2g} of the model"))
    if column.steps:
        times, sizes = sorted(step.time for step in column.steps), [step.size for step in column.steps]
        text = f"the level changes by {_sized(sizes[0], column.unit)} at {times[0]:.4g} s"
        if len(times) > 1:
            largest = _sized(max(map(abs, sizes)), column.unit)
            text = f"{len(times)} steps, {times[0]:.4g} to {times[-1]:.4g} s: the level changes by up to {largest}"
        messages.append(Finding(f"{text}, which slow noise does not make; take it out by --steps remove"))
    messages += [each for drift in column.drifts if (each := _drift_sentence(drift, column)) is not None]
    choice, shortest = analysis.choice, analysis.limits[0]
    near = [analysis.index, *np.flatnonzero(choice.rivals[0]).tolist()]
    models = (letters_inside(choice.models[0, k], choice.values[0, k], shortest) for k in near)
    chosen, *rivals = map(spelled, dict.fromkeys(models))
    if rivals:
        messages.append(Note(f"{chosen} and {', '.join(rivals)} describe the record about equally well"))
    return messages


def _describe_warming(warming: WarmUp, column: ColumnModel, warm_from: float) -> Finding:
    """Return the sentence about a sensor that warms up, and what to leave out, all columns being warm from then on."""
    text = (
        f"drifts by {_sized(-warming.size, column.unit)} as while warming up, with a time constant of "
        f"{warming.time:.4g} s; the model takes that for slow noise"
    )
    start = 10 * math.ceil(warm_from / 10)
    if start > column.analysis.length / 2:
        return Finding(text, "record again once the sensor is warm")
    return Finding(text, f"leave out the first {start} s (--window +{start}:), or fit the warm-up (imulab warmup fit)")


def _describe_edge(column: ColumnModel) -> str:
    """Return the sentence about a Gauss-Markov term of the shortest time constant, and the white noise with it."""
    analysis = column.analysis
    unit, factor = reading_unit(f"{column.unit}/sqrt(Hz)").scale
    level = float(edge_as_white(analysis.values, analysis.covariance, analysis.limits[0])[0][0])
    return (
        f"the white noise, {plain_number(level * factor, 3)} {unit} at low frequencies, falls to "
        f"{plain_number(float(analysis.values[0]) * factor, 3)} at the end of the band, as behind a filter or beside "
        "vibration: no slow noise; filters get the white noise of low frequencies"
    )


def _describe_lines(column: ColumnModel) -> str:
    named = ", ".join(
        f"{line.frequency:.4g} Hz of {_sized(line.amplitude, column.unit)}" for line in column.lines[:_MOST_NAMED]
    )
    many = len(column.lines)
    return f"{many} lines of the spectrum left out, the largest {named}"


def _drift_sentence(drift: CovariateDrift, column: ColumnModel) -> str | None:
    if not drift.regression.follows:
        return None
    unit, factor = small_unit(column.unit).scale
    per = "h" if drift.covariate == "time" else "K"
    scale = factor * (3600.0 if drift.covariate == "time" else 1.0)
    slope = f"{drift.slope * scale:.2g} ± {drift.standard_uncertainty * scale:.1g} ({unit})/{per}"
    if drift.taken and drift.rounding:
        hidden = _sized(abs(drift.slope) * drift.rounding / 2, column.unit)
        return Note(
            f"follows the {drift.covariate}, {slope}, which was taken out as far as readings in steps of "
            f"{drift.rounding:.3g} K show it: slow noise below {hidden} may be what the steps hide, and the "
            "frequencies that these move are left out; record the temperature in finer steps"
        )
    if drift.taken:
        return Note(f"follows the {drift.covariate}, {slope}, which was taken out")
    return Finding(
        f"follows the {drift.covariate}, {slope}; model {spelled(drift.letters[0])}, without that drift "
        f"{spelled(drift.letters[1])} (--regress {drift.covariate})",
        f"fit with --regress {drift.covariate}",
    )


def _sized(value: float, unit: str) -> str:
    symbol, factor = small_unit(unit).scale
    return f"{value * factor:.3g} {symbol}"


# The record: parameters with intervals, numbers for filters, and the data of the figures.


_DIGITS = 7  # of the numbers in a record
_TAILS = (0.025, 0.975)  # of a 95 % interval
_PAIRS = tuple(zip(SIGMA, TIME, strict=True))
_SLOW = ("flicker", "walk")
"""Terms that get an upper limit where the chosen model lacks them."""
_PART = 10.0
"""Part of a record up to which the uncertainty of a mean can be determined from the record."""


def no_tables(record: Calibration) -> NoReturn:
    """Refuse to make tables for the device."""
    raise RecordError("a noise record corrects nothing, so firmware has no table for it; expected a calibration")


def make_record(
    columns: Mapping[str, ColumnModel],
    groups: Sequence[Sequence[Rest]],
    options: Mapping[str, Any],
    sources: tuple[Source, ...] = (),
) -> Calibration:
    """Turn fitted models into a record; the logs at rest come in a group for each clock."""
    rests = [rest for group in groups for rest in group]
    more = terms("NBK" if options["terms"] == "auto" else options["terms"])
    parameters, names, blocks = _parameters(columns, more, short=all(rest.short for rest in rests))
    size = sum(map(len, blocks))
    matrix, start = np.zeros((size, size)), 0
    for block in blocks:
        matrix[start : start + len(block), start : start + len(block)] = block
        start += len(block)
    horizon = float(options["horizon"])
    use = {name: _use(column, horizon) for name, column in columns.items()}
    metadata = rests[0].recording.metadata
    return Calibration(
        procedure="noise",
        parameters=parameters,
        covariance=Covariance(tuple(names), tuple(map(tuple, matrix.tolist()))),
        model={
            "terms": {
                name: letters_inside(analysis.model, analysis.values, analysis.limits[0])
                for name, analysis in ((name, column.analysis) for name, column in columns.items())
            },
            "horizon": {"value": horizon, "unit": "s"},
        },
        fit={
            "horizon": {"value": horizon, "unit": "s"},
            "sample_rate": {"value": max(1 / rest.interval for rest in rests), "unit": "Hz"},
            "length": {"value": sum(rest.duration for rest in groups[0]), "unit": "s"},
            "logs": len(groups[0]),
            "band": {name: _value(column.analysis.band.highest, "Hz") for name, column in columns.items()},
            "test": {name: _number(column.analysis.test.probability) for name, column in columns.items()},
            "filter_white": {name: column_use["white"] for name, column_use in use.items()},
            "filter_walk": {name: column_use["walk"] for name, column_use in use.items()},
            "bias_uncertainty": {name: column_use["bias"] for name, column_use in use.items()},
            "columns": {name: _column_section(column) for name, column in columns.items()},
        },
        options={key: value for key, value in options.items() if value is not None},
        data={"columns": {name: _data(column) for name, column in columns.items()}},
        sensor={key: metadata[key] for key in ("serial", "model") if key in metadata},
        sources=sources,
        warnings=findings(columns, rests, horizon),
    )


def _parameters(
    columns: Mapping[str, ColumnModel], more: Flags, short: bool
) -> tuple[dict[str, Parameter], list[str], list[Array]]:
    """Return parameters, and names and covariance of those of each column that have an uncertainty.

    Intervals allow for the terms `more` beside the chosen ones. A short record gives only limits of slow terms.
    """
    parameters: dict[str, Parameter] = {}
    names, blocks = [], []
    for name, column in columns.items():
        analysis, unit = column.analysis, column.unit
        values, covariance = edge_as_white(analysis.values, analysis.covariance, analysis.limits[0])
        low, high = _intervals(analysis, more, values, covariance)
        white = analysis.average(lambda each, t=analysis.limits[0]: white_square(each, np.zeros(1), t))  # type: ignore[misc]
        ends_of_all = np.sqrt(white.quantiles(*_TAILS)[:, 0, 0]).tolist()
        low[0], high[0] = min(float(low[0]), ends_of_all[0]), max(float(high[0]), ends_of_all[1])
        if analysis.band.filtered(analysis.interval):  # the model has no term for the rest of the filter's roll-off
            covariance, more_of_white = covariance.copy(), analysis.band.roll_off * values[0]
            covariance[0, 0] += analysis.band.roll_off**2
            low[0] = values[0] - np.hypot(values[0] - low[0], NORMAL_95 * more_of_white)
            high[0] = values[0] + np.hypot(high[0] - values[0], NORMAL_95 * more_of_white)
        elif not analysis.band.flat:
            covariance = _widen_white(analysis, float(values[0]), covariance, low, high)
        has, known = np.where(analysis.values > 0, values > 0, analysis.model), []
        for k, term in enumerate(NAMES):
            slow = term in _SLOW
            value = float(values[k])
            if not (has[k] or (more[k] and slow)) or (short and k and not slow):
                continue
            limit = value == 0 or (short and slow)
            u = None if limit else value * float(np.sqrt(covariance[k, k]))
            ends = (0.0 if limit else min(float(low[k]), value), max(float(high[k]), value))
            parameters[f"{name}_{term}"] = Parameter(
                0.0 if limit else value, u, term_unit(term, unit), interval_95=ends
            )
            known += [] if limit else [k]
        names += [f"{name}_{NAMES[k]}" for k in known]
        size = values[known]
        blocks.append(covariance[np.ix_(known, known)] * np.outer(size, size))
        for drift in column.drifts:
            if drift.covariate == "time" and (drift.regression.follows or drift.taken):
                b, u = drift.slope, drift.standard_uncertainty
                parameters[f"{name}_ramp"] = Parameter(
                    b, u, term_unit("ramp", unit), interval_95=(b - NORMAL_95 * u, b + NORMAL_95 * u)
                )
                names.append(f"{name}_ramp")
                blocks.append(np.array([[u**2]]))
    return parameters, names, blocks


def _widen_white(analysis: Analysis, white: float, covariance: Array, low: Array, high: Array) -> Array:
    """Widen the interval of a white noise that no octave shows; return the covariance with its uncertainty.

    It lies between the level at the end of the band and that below all Gauss-Markov terms, one of which may be the
    filter of the sensor: ``N^2 + sum 2 S^2 T``.
    """
    below = analysis.average(
        lambda each: np.square(each[..., :1]) + sum(2 * each[..., s, None] ** 2 * each[..., t, None] for s, t in _PAIRS)
    )
    least = analysis.values[0] * np.exp(-NORMAL_95 * np.sqrt(analysis.covariance[0, 0]))
    low[0], high[0] = (
        min(float(low[0]), least),
        max(float(high[0]), float(np.sqrt(below.quantiles(_TAILS[1])[0, 0, 0]))),
    )
    covariance = covariance.copy()
    if white > 0:
        covariance[0, 0] = (max(high[0] - white, white - low[0]) / NORMAL_95 / white) ** 2
    return covariance


def _intervals(analysis: Analysis, more: Flags, values: Array, covariance: Array) -> tuple[Array, Array]:
    """Return the ends of the 95 % intervals of the parameters, with terms at the edge of the band as white noise."""
    low, high = analysis.intervals(more)
    if np.array_equal(values, analysis.values):
        return low, high
    if values[TIME[0]] == analysis.values[TIME[1]]:
        for ends in (low, high):
            ends[[SIGMA[0], TIME[0]]] = ends[[SIGMA[1], TIME[1]]]
    reach = np.exp(NORMAL_95 * np.sqrt(covariance[0, 0]))
    low[0], high[0] = values[0] / reach, values[0] * reach
    return low, high


def _use(column: ColumnModel, horizon: float) -> dict[str, Any]:
    """Return white noise and walk for a filter, and the uncertainty of means, averaged over all candidates."""
    analysis, dt = column.analysis, column.analysis.interval
    h = np.array([max(round(horizon / dt), 1) * dt])
    shortest = analysis.limits[0]
    white = analysis.average(lambda values: white_square(values, h, shortest))
    walk = analysis.average(lambda values: walk_square(values, h, dt, shortest))
    times = durations(analysis.length)
    bias = analysis.average(lambda values: bias_square(values, times, dt))
    return {
        "white": {**_value(np.sqrt(white.mean[0, 0]), term_unit("white", column.unit)), **_ends(white)},
        "walk": {**_value(np.sqrt(walk.mean[0, 0]), term_unit("walk", column.unit)), **_ends(walk)},
        "bias": {
            "time": _value(times, "s"),
            "standard_uncertainty": _value(np.sqrt(bias.expected[0]), column.unit),
        },
    }


def durations(length: float) -> Array:
    """Return 1, 10, 100 s ... up to a tenth of a record, and that tenth, shape (t,)."""
    longest = length / _PART
    decades = 10.0 ** np.arange(0, max(int(np.floor(np.log10(max(longest, 1)))) + 1, 0))
    return distinct(np.append(decades[decades <= longest], longest))


def _ends(averaged: Any) -> dict[str, Any]:
    return {"interval_95": _numbers(np.sqrt(averaged.quantiles(*_TAILS)[:, 0, 0]))}


def _column_section(column: ColumnModel) -> dict[str, Any]:
    """Return the section of a column: everything but its parameters."""
    analysis, choice = column.analysis, column.analysis.choice
    return {
        "unit": column.unit,
        "interval": _value(analysis.interval, "s"),
        "length": _value(analysis.length, "s"),
        "samples": sum(each.count for each in analysis.stretches),
        "stretches": len(analysis.stretches),
        "spikes": column.spikes,
        "knocks": [{"time": _value(start, "s"), "length": _value(length, "s")} for start, length in column.knocks],
        "lines": [
            {"frequency": _value(line.frequency, "Hz"), "amplitude": _value(line.amplitude, column.unit)}
            for line in column.lines
        ],
        "steps": [_step(step, column.unit) for step in column.steps],
        "full_band": analysis.band.full,
        "flat": analysis.band.flat,
        "ripple": _number(analysis.allowance.ripple),
        "off": [
            {"from": _value(low, "Hz"), "to": _value(high, "Hz"), "factor": _number(factor)}
            for low, high, factor in analysis.allowance.off
        ],
        "shortest_time": _value(analysis.limits[0], "s"),
        "test": {
            "statistic": _number(analysis.test.statistic),
            "degrees_of_freedom": analysis.test.freedom,
            "probability": _number(analysis.test.probability),
        },
        "chosen": analysis.letters,
        "candidates": [
            {
                "model": letters(choice.models[0, k]),
                "deviance": _number(choice.deviance[0, k] - choice.deviance[0].min()),
                "weight": _number(choice.weights[0, k]),
                "rival": bool(choice.rivals[0, k]),
                "values": _numbers(choice.values[0, k]),
            }
            for k in range(choice.deviance.shape[1])
        ],
        "drifts": [_drift_section(drift, column.unit) for drift in column.drifts],
    }


def _step(step: LevelChange, unit: str) -> dict[str, Any]:
    size = {**_value(step.size, unit), "standard_uncertainty": _number(step.standard_uncertainty)}
    return {"time": _value(step.time, "s"), "size": size}


def _drift_section(drift: CovariateDrift, unit: str) -> dict[str, Any]:
    return {
        "follows": drift.covariate,
        "slope": {
            "value": _number(drift.slope),
            "unit": drift_unit(drift.covariate, unit),
            "standard_uncertainty": _number(drift.standard_uncertainty),
        },
        "gain": _number(drift.regression.gain),
        "significant": drift.regression.follows,
        "removed": drift.taken,
        "model_without": drift.letters[0],
        "model_with": drift.letters[1],
    }


def drift_unit(covariate: str, unit: str) -> str:
    """Return the SI unit of a slope."""
    return term_unit("ramp", unit) if covariate == "time" else f"({unit})/K"


def _data(column: ColumnModel) -> dict[str, Any]:
    """Return the binned spectra, and the Allan deviation with the 95 % band of all candidates."""
    analysis = column.analysis
    tau, measured = allan_of_bins([stretch.spectra for stretch in analysis.stretches])
    fitted = analysis.average(lambda values: allan_variance(values, tau, analysis.interval))
    low, high = np.sqrt(fitted.quantiles(*_TAILS)[:, 0])
    spectra = [each for stretch in analysis.stretches for each in stretch.spectra]
    return {
        "spectra": [
            {
                "interval": _number(whole.interval),
                "count": whole.count,
                "first": whole.first.tolist(),
                "last": whole.last.tolist(),
                "power": _numbers(whole.power),
                "freedom": _numbers(whole.freedom),
                "counted": _numbers(counted.freedom),
                "variance": _numbers(variance),
            }
            for whole, counted, variance in zip(spectra, analysis.spectra, analysis.variances(), strict=True)
        ],
        "allan": {
            "tau": _numbers(tau),
            "measured": _numbers(np.sqrt(measured)),
            "fitted": _numbers(np.sqrt(allan_variance(analysis.values, tau, analysis.interval))),
            "low": _numbers(low),
            "high": _numbers(high),
        },
    }


def _value(value: Any, unit: str) -> dict[str, Any]:
    return {"value": _numbers(value) if np.ndim(value) else _number(value), "unit": unit}


def _number(value: Any) -> float:
    return float(f"{float(value):.{_DIGITS}g}")


def _numbers(values: Array) -> list[float]:
    return [_number(value) for value in np.asarray(values).tolist()]


# The fit.


_SAME_RATE = 0.01  # relative: logs of other rates have no common spectrum


@dataclass(frozen=True, repr=False)
class NoiseFit(Result):
    """Result of a fit of noise models.

    Attributes
    ----------
    calibration
        The record.
    columns
        The models by column.

    Examples
    --------
    >>> import imulab as il
    >>> fit = il.fit_noise(il.simulate_noise(white="0.3 deg/sqrt(h)", rate=50.0, duration="10 min", columns=["gyro_z"]))
    >>> list(fit.columns)
    ['gyro_z']
    >>> list(fit.wants("kalibr"))
    ['gyroscope_noise_density', 'gyroscope_random_walk', 'update_rate']
    """

    calibration: Calibration
    columns: Mapping[str, ColumnModel]

    @checked
    def wants(self, for_: str, *, rate: float | str | None = None, step: float | str | None = None) -> dict[str, float]:
        """Return what a program's filter wants, by its own keys and in its own units, as ``noise fit --for`` prints it.

        Parameters
        ----------
        for_
            ``kalibr openvins vins px4 ardupilot gtsam ros matlab``.
        rate
            Samples per second that the program gets, Hz; those of the logs if not given.
        step
            Time between predictions of the filter, s; 10 ms of px4 and 12 ms of ardupilot if not given.

        Raises
        ------
        OptionError
            The program is not known, or `rate` or `step` is not above 0.
        RecordError
            No column is of a gyroscope or an accelerometer in SI.
        """
        from imulab.procedures.noise.wants import noise_for

        hertz = None if rate is None else in_si(rate, "rate", "frequency", "Hz")
        return noise_for(
            self.calibration, for_, rate=hertz, step=None if step is None else in_si(step, "step", "time", "s")
        )


def fit_noise(
    data: Data | Sequence[Data],
    *,
    terms: Annotated[str, parsed(check_terms, "auto|NBK", ("auto",))] = "auto",
    horizon: Annotated[float | str | None, measure("time", "s")] = None,
    band: Annotated[float | str | None, measure("frequency", "Hz")] = None,
    regress: Annotated[str | None, choice((NO_COVARIATE, *COVARIATES))] = NO_COVARIATE,
    columns: Annotated[str | Sequence[str] | None, parsed(names_of_columns, "A,A,...")] = None,
    steps: Annotated[str | None, choice(STEPS)] = SAY_STEPS,
    **reading: Unpack[Reading],
) -> NoiseFit:
    """Fit a model of the noise to every sensor column of logs at rest, by maximum likelihood of its spectrum.

    ``-2 ln L = sum_b d_b [ln lambda_b + P_b/lambda_b]``, P_b the mean square of the cosine coefficients in bin b, d_b
    their number, lambda_b their variance under the model: white noise N, 1/f noise B, random walk K, Gauss-Markov terms
    and quantisation.

    Parameters
    ----------
    data
        A log, or a list of logs of the same unit, whose likelihoods add up; each a file, recording, data frame or
        arrays.
    terms
        Noises: auto, or letters of N B K G Q. N is white, B 1/f, K random walk, G Gauss-Markov (GG for two), Q
        quantisation.
    horizon
        Time that a filter predicts without aiding; 10 s if not given, or the length of a shorter log. In s; the random
        walk for filters is that which predicts a mean over it.
    band
        Highest frequency to use; up to where the spectrum is flat if not given. In Hz.
    regress
        Take out what follows it. ``no``: nothing.
    columns
        Columns to fit; all sensors if not given. As a list or a text such as ``"gyro_x,gyro_y"``.
    steps
        Changes of level: say them, or remove them too.
    reading
        How arrays and files are to be understood: `rate` and `unit`; `layout`, `window` ...

    Raises
    ------
    DataError
        The unit moves, a column is constant or clipped, there are fewer than 500 samples, time does not rise.
    UnitError
        Units differ between logs.
    OptionError
        An option has a value that cannot be used.

    Examples
    --------
    White noise of .01 deg/s/sqrt(Hz) at 100 Hz, for 10 minutes:

    >>> import numpy as np
    >>> import imulab as il
    >>> rate = 0.1 * np.random.default_rng(1).standard_normal((60_000, 3))
    >>> fit = il.fit_noise({"gyro": rate}, rate=100.0, unit="deg/s")
    >>> bool(abs(np.degrees(fit.calibration.value("gyro_x_white")) - 0.01) < 2e-4)
    True

    Source: Whittle (1953); IEEE Std 952 and 647 (terms).
    """
    horizon = None if horizon is None else in_si(horizon, "horizon", "time", "s")
    band = None if band is None else in_si(band, "band", "frequency", "Hz")
    columns = names_of_columns(columns, "columns") if isinstance(columns, str) else columns
    check_options(terms, horizon, band, regress, steps)
    alone = isinstance(data, str | PathLike | Recording | Mapping | np.ndarray) or is_frame(data)
    several_logs = not alone and isinstance(data, list | tuple) and all(_is_log(each) for each in data)
    logs: list[Any] = list(data) if several_logs else [data]  # type: ignore[arg-type]
    if not logs:
        raise DataError("fit_noise: expected a log at rest, found an empty list")

    def named(samples: NDArray[Any]) -> Mapping[str, Any]:
        gyro = parse_unit(reading.get("unit") or "m/s^2").quantity == "rate"
        return {"gyro" if gyro else "accel": samples}

    sources: list[Source] = []

    def read() -> Iterator[Recording | Rest]:
        for each in logs:
            log = given_log(each, reading, fit_noise, lambda first: chosen_columns(first, columns), named)
            source = (log.recording if isinstance(log, Rest) else log).source
            sources.extend([source] if source is not None else [])
            yield log

    return fit_recordings(
        read(), terms=terms, horizon=horizon, band=band, regress=regress, columns=columns, steps=steps, sources=sources
    )  # fmt: skip


def _is_log(data: object) -> bool:
    return isinstance(data, str | PathLike | Recording | Mapping | np.ndarray) or is_frame(data)


def fit_recordings(
    recordings: Iterable[Recording | Rest],
    *,
    terms: str,
    horizon: float | None,
    band: float | None,
    regress: str | None,
    columns: Sequence[str] | None,
    steps: str | None,
    sources: Iterable[Source] = (),
) -> NoiseFit:
    """Return noise models fitted to recordings at rest, or to stretches of long ones: as `fit_noise`."""
    # A record holds only options that are not the default, so that older records can be fitted again.
    regress, steps = None if regress == NO_COVARIATE else regress, None if steps == SAY_STEPS else steps
    groups = read_rests(recordings, columns)
    longest = min(
        max(stop[1] - stop[0] for rest in rests for stop in rest.parts) * rests[0].interval for rests in groups
    )
    if horizon is not None and horizon > longest:
        raise OptionError(
            f"horizon {horizon:g} s: expected at most the length of the record, {longest:.4g} s in one stretch"
        )
    horizon = min(HORIZON, longest) if horizon is None else horizon
    candidates = CANDIDATES if terms == "auto" else (terms,)
    models: dict[str, ColumnModel] = {}
    for rests in groups:
        temperatures = [rest.slow("temperature") for rest in rests]
        if regress == "temperature" and None in temperatures:
            where = rests[temperatures.index(None)].recording.name
            raise DataError(
                f"{where}: regress temperature: expected a column temperature that changes, by more than one step of "
                "its readings, found none"
            )
        names = _columns_there(rests[0].recording, columns)
        stretches = [[each for rest in rests for each in rest.stretches(name)] for name in names]
        for name, analysis in zip(names, analyses(stretches, candidates, band), strict=True):
            models[name] = _fit_column(
                name, rests, analysis, temperatures, candidates, band, regress, steps == "remove"
            )
    options = {"terms": terms, "horizon": horizon, "band": band, "regress": regress, "steps": steps}
    options["columns"] = None if columns is None else list(models)
    return NoiseFit(make_record(models, groups, options, tuple(sources)), models)


def chosen_columns(recording: Recording, columns: Sequence[str] | None) -> list[str]:
    """Return the names of the columns to fit.

    Raises
    ------
    OptionError
        One is not there.
    DataError
        There is no output of a sensor.
    """
    names = [name for stamped in recording.clocks.values() for name in stamped]
    if columns is not None:
        if not columns:
            raise OptionError("columns: expected one or more, found none")
        for name in columns:
            if name not in names:
                raise OptionError(f"{recording.name}: no column {name!r}; expected one of {listed(names, name)}")
        return list(columns)
    sensors = list(noise_columns(recording))
    if not sensors:
        raise recording.lacking("sensor column (gyro_.. accel_.. dtg_.. fog)", "gyro_x")
    return sensors


def read_rests(recordings: Iterable[Recording | Rest], columns: Sequence[str] | None) -> list[list[Rest]]:
    """Return recordings of one unit as stretches at rest, a list for each clock; errors as for `fit_noise`."""
    groups: dict[str, list[Rest]] = {}
    for log in recordings:
        for clock, rest in [("time", log)] if isinstance(log, Rest) else _rests_by_clock(log, columns):
            rests = groups.setdefault(clock, [])
            if rests:
                _check_alike(rests[0], rest, columns)
            rests.append(rest)
    return list(groups.values())


def _rests_by_clock(log: Recording, columns: Sequence[str] | None) -> Iterator[tuple[str, Rest]]:
    names = chosen_columns(log, columns)
    check_not_resampled(log, names)
    for clock, stamped in log.clocks.items():
        mine = [name for name in names if name in stamped]
        if mine:
            yield clock, at_rest(own_clock(log, clock), mine)


def _columns_there(recording: Recording, columns: Sequence[str] | None) -> list[str]:
    """Return the columns to fit that stand on the clock of a recording."""
    return chosen_columns(recording, None if columns is None else [name for name in columns if name in recording])


def _check_alike(first: Rest, other: Rest, columns: Sequence[str] | None) -> None:
    name, first_log = other.recording.name, first.recording
    if not set(noise_columns(other.recording)) & set(noise_columns(first_log)):
        raise DataError(
            f"{name}: no sensor of {first_log.name} in it; sensors of one unit in a file each are joined by "
            f"imulab convert {first_log.name} --with {name} -o both.csv"
        )
    if abs(other.interval / first.interval - 1) > _SAME_RATE:
        raise DataError(
            f"{name}: {1 / other.interval:.4g} samples in a second, but {first_log.name} has {1 / first.interval:.4g}; "
            "expected logs of one rate"
        )
    names = _columns_there(first_log, columns)
    if _columns_there(other.recording, columns) != names:
        raise DataError(f"{name}: other columns than {first_log.name}; expected {several(names)}")
    for column in names:
        unit, expected = (si_unit(each.units[column]) for each in (other.recording, first_log))
        if unit != expected:
            raise UnitError(f"{name}: column {column} in {unit}, but {first_log.name} has it in {expected}")
    if differ := different_units((name, other.recording.metadata), (first_log.name, first_log.metadata)):
        raise DataError(f"{differ}; expected logs of one unit")


def _fit_column(
    name: str,
    rests: Sequence[Rest],
    analysis: Analysis,
    temperatures: Sequence[list[Array] | None],
    candidates: tuple[str, ...],
    band: float | None,
    regress: str | None,
    flat: bool,
) -> ColumnModel:
    stretches = analysis.stretches
    spikes, lines = sum(each.spikes for each in stretches), _longest(stretches).lines
    covariates = _covariates(temperatures, stretches)
    starts = [not number for rest in rests for number in range(len(rest.parts))]
    warming = None if regress else warm_up(analysis, starts, list(covariates.values()), candidates)
    rested = warming.left if warming else analysis
    steps = changes_of_level(rested.stretches, rested, candidates, band)
    if flat and any(steps):
        analysis = analysed(without_steps(stretches, steps), candidates, band)
    drifts = []
    for covariate, slow in covariates.items():
        if warming and covariate == "time":
            continue
        hidden = [each for rest in rests for each in rest.hidden(covariate)] if covariate == "temperature" else []
        regression = analysis.regressed(slow, hidden)
        taken, left = covariate == regress, analysis.letters
        if regression.follows or taken:
            left = analysed(regression.residual, candidates, band).letters
        coarse = max(rest.rounding(covariate) for rest in rests) if covariate == "temperature" else 0.0
        drifts.append(CovariateDrift(covariate, regression, (analysis.letters, left), taken, coarse))
    for drift in drifts:
        if drift.taken:
            analysis = analysed(drift.regression.residual, candidates, band)
    # Steps have the time of their log; those of several logs are listed one log after the other.
    return ColumnModel(
        name,
        si_unit(rests[0].recording.units[name]),
        analysis,
        spikes,
        tuple(knock for each in stretches for knock in each.knocks),
        lines,
        tuple(step for each in steps for step in each),
        tuple(drifts),
        warming,
    )


def _longest(stretches: Sequence[Stretch]) -> Stretch:
    return max(stretches, key=lambda each: each.count)


def _covariates(temperatures: Sequence[list[Array] | None], stretches: Sequence[Stretch]) -> dict[str, list[Array]]:
    """Return the slow coefficients of each stretch for time, and for temperature where it changes in all logs."""
    covariates = {"time": [ramp_coefficients(each)[None] for each in stretches]}
    known = [each for each in temperatures if each is not None]
    if len(known) == len(temperatures):
        covariates["temperature"] = [each[None] for rest in known for each in rest]
    return covariates

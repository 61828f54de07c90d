"""The record of noise models: parameters with intervals, what filters want, and what the figures are drawn from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from imulab.errors import RecordError
from imulab.estimation.noise.analysis import Analysis
from imulab.estimation.noise.likelihood import Flags
from imulab.estimation.noise.moments import allan_of_bins
from imulab.estimation.noise.rest import Rest
from imulab.estimation.noise.terms import NAMES, SIGMA, TIME, allan_variance, letters, terms
from imulab.estimation.noise.use import bias_square, edge_as_white, letters_inside, walk_square, white_square
from imulab.estimation.ranked import NORMAL_95
from imulab.procedures.noise.findings import findings
from imulab.recording import Array, Source
from imulab.records.calibration import Calibration, Covariance, Parameter

if TYPE_CHECKING:
    from imulab.estimation.noise.cleaning import Step
    from imulab.procedures.noise.model import ColumnModel, Drift

_DIGITS = 7
_TAILS = (0.025, 0.975)
_PAIRS = tuple(zip(SIGMA, TIME, strict=True))
_SLOW = ("flicker", "walk")
"""Terms that have a limit where the chosen model has not got them."""
_PART = 10.0
"""Of a record: the mean over so much of it still has an uncertainty that the rest of the record tells."""


def unit_of(term: str, unit: str) -> str:
    """Return the SI unit of a term of a column in `unit`."""
    integral = {"rad/s": "rad", "m/s^2": "m/s"}.get(unit, f"{unit} s")
    rate = {"rad/s": "rad/s^2", "m/s^2": "m/s^3"}.get(unit, f"{unit}/s")
    units = {"white": f"{unit}/sqrt(Hz)", "walk": f"{unit}/sqrt(s)", "quantisation": integral, "ramp": rate}
    return "s" if term.endswith("_time") else units.get(term, unit)


def no_tables(record: Calibration) -> NoReturn:
    """Refuse to make tables for a unit."""
    raise RecordError("a noise record corrects nothing, so firmware has no table for it; expected a calibration")


def make_record(
    columns: Mapping[str, ColumnModel],
    rests: Sequence[Rest],
    options: Mapping[str, Any],
    sources: tuple[Source, ...] = (),
) -> Calibration:
    """Turn fitted models into a record."""
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
                name: letters_inside(found.model, found.values, found.limits[0])
                for name, found in ((name, column.analysis) for name, column in columns.items())
            },
            "horizon": {"value": horizon, "unit": "s"},
        },
        fit={
            "horizon": {"value": horizon, "unit": "s"},
            "sample_rate": {"value": 1 / rests[0].interval, "unit": "Hz"},
            "length": {"value": sum(rest.duration for rest in rests), "unit": "s"},
            "logs": len(rests),
            "band": {name: _value(column.analysis.band.highest, "Hz") for name, column in columns.items()},
            "test": {name: _number(column.analysis.test.probability) for name, column in columns.items()},
            "filter_white": {name: one["white"] for name, one in use.items()},
            "filter_walk": {name: one["walk"] for name, one in use.items()},
            "bias_uncertainty": {name: one["bias"] for name, one in use.items()},
            "columns": {name: _column(column) for name, column in columns.items()},
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
    """Parameters, and the names and covariance of those of each column that have an uncertainty.

    Intervals allow for the terms `more` beside those that were chosen. Of a short record the slow terms are limits
    alone.
    """
    found: dict[str, Parameter] = {}
    names, blocks = [], []
    for name, column in columns.items():
        analysis, unit = column.analysis, column.unit
        values, covariance = edge_as_white(analysis.values, analysis.covariance, analysis.limits[0])
        low, high = _intervals(analysis, more, values, covariance)
        white = analysis.average(lambda each, t=analysis.limits[0]: white_square(each, np.zeros(1), t))  # type: ignore[misc]
        ends_of_all = [float(np.sqrt(white.quantile(tail)[0, 0])) for tail in _TAILS]
        low[0], high[0] = min(float(low[0]), ends_of_all[0]), max(float(high[0]), ends_of_all[1])
        if analysis.band.filtered(analysis.interval):  # what its roll-off leaves in the band is not in the model
            covariance, more_of_white = covariance.copy(), analysis.band.roll_off * values[0]
            covariance[0, 0] += analysis.band.roll_off**2
            low[0] = values[0] - np.hypot(values[0] - low[0], NORMAL_95 * more_of_white)
            high[0] = values[0] + np.hypot(high[0] - values[0], NORMAL_95 * more_of_white)
        elif not analysis.band.flat:
            covariance = _level_nowhere(analysis, float(values[0]), covariance, low, high)
        has, known = np.where(analysis.values > 0, values > 0, analysis.model), []
        for k, term in enumerate(NAMES):
            slow = term in _SLOW
            value = float(values[k])
            if not (has[k] or (more[k] and slow)) or (short and k and not slow):
                continue
            limit = value == 0 or (short and slow)
            u = None if limit else value * float(np.sqrt(covariance[k, k]))
            ends = (0.0 if limit else min(float(low[k]), value), max(float(high[k]), value))
            found[f"{name}_{term}"] = Parameter(0.0 if limit else value, u, unit_of(term, unit), interval_95=ends)
            known += [] if limit else [k]
        names += [f"{name}_{NAMES[k]}" for k in known]
        size = values[known]
        blocks.append(covariance[np.ix_(known, known)] * np.outer(size, size))
        for drift in column.drifts:
            if drift.covariate == "time" and (drift.found.follows or drift.taken):
                b, u = drift.slope, drift.standard_uncertainty
                found[f"{name}_ramp"] = Parameter(
                    b, u, unit_of("ramp", unit), interval_95=(b - NORMAL_95 * u, b + NORMAL_95 * u)
                )
                names.append(f"{name}_ramp")
                blocks.append(np.array([[u**2]]))
    return found, names, blocks


def _level_nowhere(analysis: Analysis, white: float, covariance: Array, low: Array, high: Array) -> Array:
    """Widen the interval of a white noise that no octave shows, and return the covariance with its uncertainty.

    It lies between the level at the end of the band and that below all Gauss-Markov terms, of which one may be the
    filter of the sensor: ``N^2 + sum 2 S^2 T``.
    """
    below = analysis.average(
        lambda each: np.square(each[..., :1]) + sum(2 * each[..., s, None] ** 2 * each[..., t, None] for s, t in _PAIRS)
    )
    least = analysis.values[0] * np.exp(-NORMAL_95 * np.sqrt(analysis.covariance[0, 0]))
    low[0], high[0] = min(float(low[0]), least), max(float(high[0]), float(np.sqrt(below.quantile(_TAILS[1])[0, 0])))
    covariance = covariance.copy()
    if white > 0:
        covariance[0, 0] = (max(high[0] - white, white - low[0]) / NORMAL_95 / white) ** 2
    return covariance


def _intervals(analysis: Analysis, more: Flags, values: Array, covariance: Array) -> tuple[Array, Array]:
    """Ends of the 95 % intervals of the parameters in a record, in which the edge of the band is white noise."""
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
    """White noise and walk for a filter, and the uncertainty of means, over all candidates."""
    analysis, dt = column.analysis, column.analysis.interval
    h = np.array([max(round(horizon / dt), 1) * dt])
    shortest = analysis.limits[0]
    white = analysis.average(lambda values: white_square(values, h, shortest))
    walk = analysis.average(lambda values: walk_square(values, h, dt, shortest))
    times = durations(analysis.length)
    bias = analysis.average(lambda values: bias_square(values, times, dt))
    return {
        "white": {**_value(np.sqrt(white.mean[0, 0]), unit_of("white", column.unit)), **_ends(white)},
        "walk": {**_value(np.sqrt(walk.mean[0, 0]), unit_of("walk", column.unit)), **_ends(walk)},
        "bias": {
            "time": _value(times, "s"),
            "standard_uncertainty": _value(np.sqrt(bias.expected[0]), column.unit),
        },
    }


def durations(length: float) -> Array:
    """Return 1, 10, 100 s ..., up to a tenth of a record, and that, shape (t,)."""
    longest = length / _PART
    decades = 10.0 ** np.arange(0, max(int(np.floor(np.log10(max(longest, 1)))) + 1, 0))
    return np.unique(np.append(decades[decades <= longest], longest))


def _ends(found: Any) -> dict[str, Any]:
    return {"interval_95": [_number(np.sqrt(found.quantile(tail)[0, 0])) for tail in _TAILS]}


def _column(column: ColumnModel) -> dict[str, Any]:
    """What was found of a column beside its parameters."""
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
        "drifts": [_drift(drift, column.unit) for drift in column.drifts],
    }


def _step(step: Step, unit: str) -> dict[str, Any]:
    size = {**_value(step.size, unit), "standard_uncertainty": _number(step.standard_uncertainty)}
    return {"time": _value(step.time, "s"), "size": size}


def _drift(drift: Drift, unit: str) -> dict[str, Any]:
    return {
        "follows": drift.covariate,
        "slope": {
            "value": _number(drift.slope),
            "unit": drift_unit(drift.covariate, unit),
            "standard_uncertainty": _number(drift.standard_uncertainty),
        },
        "gain": _number(drift.found.gain),
        "significant": drift.found.follows,
        "removed": drift.taken,
        "model_without": drift.letters[0],
        "model_with": drift.letters[1],
    }


def drift_unit(covariate: str, unit: str) -> str:
    """Return the SI unit of a slope."""
    return unit_of("ramp", unit) if covariate == "time" else f"({unit})/K"


def _data(column: ColumnModel) -> dict[str, Any]:
    """The binned spectra, and the Allan deviation with the 95 % band of all candidates."""
    analysis = column.analysis
    tau, measured = allan_of_bins([stretch.spectra for stretch in analysis.stretches])
    fitted = analysis.average(lambda values: allan_variance(values, tau, analysis.interval))
    low, high = (np.sqrt(fitted.quantile(tail)[0]) for tail in _TAILS)
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

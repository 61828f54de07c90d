"""An earlier record of the same gyroscopes beside a new one: whether they agree, and both as one fit.

With the difference d of what both hold, ``z - cov(z, d) cov(d)^-1 d`` is generalised least squares of both together:
the Kalman update. Biases are left out, since they change from power-on to power-on. What both have of one table or one
clock is common to both, and no average makes it smaller.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from imulab.errors import DataError, RecordError
from imulab.procedures.rate.axes import BY_ACCELEROMETERS, other_unit_said, with_accelerometers
from imulab.procedures.rate.choices import AXES, GAINS
from imulab.procedures.rate.engineering import shown
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.records.comparison import compared
from imulab.units import parse_unit
from imulab.verdict import UNJUDGED, Note

_TINY = 1e-12
_CHANCE = 0.01
_APART = 5.0  # K, beyond which a thermal record counts temperatures as different


def with_prior(record: Calibration, prior: Calibration, frame: str | None) -> Calibration:
    """Return a rate record with a prior's knowledge; one of both triads where that holds accelerometers in its frame.

    `frame` is that of the record's misalignments, None where it has none.

    Raises
    ------
    RecordError
        The prior holds no such gyroscopes, or in another unit.
    DataError
        It was made from one of the same recordings.
    """
    unit, its = record.model["gyro_output_unit"], prior.model.get("gyro_output_unit")
    if its is None:
        raise RecordError(f"prior: a {prior.procedure} record without gyroscopes; expected one of tumble gyro or rate")
    if its != unit:
        raise RecordError(f"prior: its gyroscopes are in {its}, those of the recording in {unit}; expected one unit")
    twice = {source.sha256 for source in prior.sources} & {source.sha256 for source in record.sources}
    if twice:
        name = next(source.file for source in record.sources if source.sha256 in twice)
        raise DataError(f"{name}: the prior was made from this recording, which would count twice")
    turned = prior.model.get("frame", BY_ACCELEROMETERS)
    alike = frame is None or frame == turned
    known = [
        name
        for name in prior.covariance.names
        if name.startswith(GAINS)
        and not name.startswith("gyro_scale_factor_slope")
        and (alike or not name.startswith("gyro_misalignment"))
    ]
    own = list(record.covariance.names)
    common = [name for name in own if name in known and not name.startswith("gyro_bias")]
    if not common:
        raise RecordError("prior: it holds none of the parameters found here; expected gyroscopes of the same axes")
    # a record without misalignments of its own takes over what it lacks
    further = [name for name in known if name not in own] if frame is None else []
    comparison = compared(_part(prior, common), _part(record, common))
    values, matrix = _updated(record, prior, own, common, further)
    parameters: dict[str, Parameter] = {}
    for name, value, u in zip(own + further, values.tolist(), np.sqrt(np.diag(matrix)).tolist(), strict=True):
        source = record.parameters.get(name) or prior.parameters[name]
        parameters[name] = Parameter(value, u, source.unit, interval_95=_interval(source, value, u))
    axes = "".join(axis for axis in AXES if f"gyro_scale_factor_{axis}" in parameters)
    found = replace(
        record,
        parameters={**record.parameters, **parameters},
        covariance=Covariance((*own, *further), tuple(map(tuple, matrix.tolist()))),
        model={
            **record.model,
            "gyro_order": _order(parameters),
            "axes": axes,
        },
        fit={**record.fit, "prior": _beside(prior, record, common, comparison.probability)},
        sources=tuple({source.file: source for source in (*prior.sources, *record.sources)}.values()),
        warnings=(
            *record.warnings,
            *other_unit_said(prior, record.sensor, "prior"),
            _said(comparison.probability, comparison.changes),
        ),
        verdict=UNJUDGED,
    )
    return with_accelerometers(prior, found) if frame is None and "bias_x" in prior.parameters else found


def prior_at(prior: Calibration, recordings: Sequence[Recording]) -> Calibration:
    """Return a prior as it is at the mean temperature of the recordings, where it is a thermal record.

    Raises
    ------
    RecordError
        Their temperature is not known, or outside the record's range, or the record holds no scale factors.
    DataError
        Their temperatures differ, so that no one scale factor is theirs.
    """
    if prior.procedure != "thermal":
        return prior
    from imulab.procedures.thermal.prior import gyros_at_temperature

    known = [
        (float(np.nanmean(one.si("temperature"))), one.name)
        for one in recordings
        if "temperature" in one
        and parse_unit(one.units["temperature"]).quantity == "temperature"
        and np.isfinite(one.si("temperature")).any()
    ]
    (coldest, cold), (hottest, hot) = min(known, default=(0.0, "")), max(known, default=(0.0, ""))
    if hottest - coldest > _APART:
        raise DataError(
            f"prior: {cold} was made at {coldest:.1f} degC, {hot} at {hottest:.1f}; a thermal record is a prior of "
            f"recordings at one temperature, {_APART:g} K apart at most: fit each temperature alone"
        )
    whole = float(np.mean([each for each, _ in known])) if len(known) == len(recordings) else None
    return gyros_at_temperature(prior, whole, recordings[0].name)


def _order(parameters: Mapping[str, Parameter]) -> int:
    return max((int(name[6]) for name in parameters if name.startswith("gyro_k")), default=1)


def _part(record: Calibration, names: list[str]) -> Calibration:
    """Return a record of these parameters alone, as two are compared."""
    matrix = record.covariance.block(names)
    return replace(
        record,
        procedure="rate",
        parameters={name: record.parameters[name] for name in names},
        covariance=Covariance(tuple(names), tuple(map(tuple, matrix.tolist()))),
        model={},
    )


def _shared(record: Calibration) -> dict[str, float]:
    """Return what all scale factors of a record have in common, a fraction, by whose it is."""
    fit: Any = record.fit.get("rate", record.fit)
    if "fence" in fit:  # of turns by hand
        return {"clock": fit.get("clock") or 0.0}
    if record.procedure == "rate" or "rate" in record.fit:
        return {"table": fit.get("table_uncertainty") or 0.0}
    return {"clock": fit.get("gyro", {}).get("clock", {}).get("standard_uncertainty") or 0.0}


def _updated(
    record: Calibration, prior: Calibration, own: list[str], common: list[str], further: list[str]
) -> tuple[Array, Array]:
    """Return values and covariance of `own` and `further` parameters by both records as one fit."""
    mine, its = record.covariance.array(), prior.covariance.block(common + further)
    both = {name: _shared(record).get(name, 0.0) * u for name, u in _shared(prior).items()}
    scales = [
        np.array([one.parameters[name].value if name.startswith("gyro_scale_factor") else 0.0 for name in names])
        for one, names in ((record, own), (prior, common + further))
    ]
    across = sum(both.values()) * np.outer(*scales)
    k, n = len(common), len(own)
    at = [own.index(name) for name in common]
    whole = np.block([[mine, across[:, k:]], [across[:, k:].T, its[k:, k:]]])
    values = np.array(
        [record.parameters[name].value for name in own] + [prior.parameters[name].value for name in further]
    )
    other = np.array([prior.value(name) for name in common])
    with_difference = np.vstack([mine[:, at] - across[:, :k], across[at, k:].T - its[k:, :k]])
    of_difference = mine[np.ix_(at, at)] + its[:k, :k] - across[at, :k] - across[at, :k].T
    size = np.sqrt(np.maximum(np.diag(of_difference), 1e-300))
    inverse = np.linalg.pinv(of_difference / np.outer(size, size), rcond=_TINY, hermitian=True) / np.outer(size, size)
    gain = with_difference @ inverse
    matrix = whole - gain @ with_difference.T
    return values - gain @ (values[:n][at] - other), (matrix + matrix.T) / 2


def _interval(source: Parameter, value: float, u: float) -> tuple[float, float] | None:
    """Return the interval of a parameter, as many standard uncertainties wide as before."""
    if source.interval_95 is None or not source.standard_uncertainty:
        return None
    wide = (source.interval_95[1] - source.interval_95[0]) / 2 / source.standard_uncertainty * u
    return value - wide, value + wide


def _beside(prior: Calibration, record: Calibration, names: list[str], probability: float | None) -> dict[str, Any]:
    """Return ``fit.prior``: what each record says of the parameters of both, alone."""
    pairs = {"prior": prior, "test": record}
    return {
        "probability": probability,
        "parameters": {
            name: {
                key: {"value": (p := one.parameters[name]).value, "standard_uncertainty": p.standard_uncertainty,
                      "unit": p.unit}
                for key, one in pairs.items()
            }
            for name in names
        },
    }  # fmt: skip


def _said(probability: float | None, changes: Any) -> str:
    chance = "" if probability is None else f" (probability {probability:.2g})"
    differing = [change for change in changes if change.significant]
    if not differing and probability is not None and probability < _CHANCE:
        return (
            f"the prior does not agree{chance}: all parameters together, no one parameter by itself; both are one fit "
            "all the same (see show A B)"
        )
    if not differing:
        return Note(f"the prior agrees{chance}; both are one fit, but for the biases, which are new")
    worst = max(differing, key=lambda change: abs(change.deviations or 0.0))
    factor, offset, unit = shown(worst.name, worst.unit)
    return (
        f"the prior does not agree{chance}: {worst.name} differs by {factor * worst.difference:+.3g} "
        f"{'ppm' if offset else unit}, {abs(worst.deviations or 0.0):.1f} times its uncertainty; both are one fit all "
        "the same (see show A B)"
    )

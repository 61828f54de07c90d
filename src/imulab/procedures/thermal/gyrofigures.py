"""What a thermal record shows of its gyroscopes: their biases over temperature with the band, and what is left."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.procedures.thermal.gyrorecord import gyro_predicted, gyro_scale_predicted
from imulab.procedures.thermal.model import AXES
from imulab.procedures.thermal.sections import thermal_of
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.report.elements import GOOD, LEGEND, Figure, plain_number
from imulab.report.traces import DASHES, axis, band, rounded, scatter
from imulab.units import from_si

COLOURS = (GOOD, "#b58a1b", "#7a4f9a")
SYMBOLS = ("circle", "diamond", "square")


def gyro_exhibits(record: Calibration, temperature: Array) -> tuple[list[tuple[str, str]], list[Figure]]:
    """Return the facts and figures of the gyroscopes of a record over temperatures, degC."""
    found = thermal_of(record)
    fit, data = found.fit.gyro, found.data.gyro
    assert fit is not None
    assert data is not None
    values, spread = (from_si(each, "deg/s") for each in gyro_predicted(record, temperature))
    tau = fit.between_recordings
    told = f"{plain_number(_hourly(tau.bias.value), 2)} deg/h"
    told = {"unknown": "not known", "polynomials": f"at most {told}"}.get(tau.from_, f"{told} ({tau.from_})")
    left = fit.left_out_temperature
    worst = f"{plain_number(_hourly(max(row.rms for row in left)), 2)} deg/h rms at worst" if left else "–"
    facts = [
        ("gyroscope biases", f"known to {plain_number(float(spread.max()) * 3600, 2)} deg/h or better"),
        ("gyroscope biases, power cycle to power cycle", told),
        ("gyroscope biases at left-out temperatures", worst),
    ]
    if fit.turns is not None:
        facts.append(
            ("turns", f"{fit.turns.turns}, missed by {plain_number(np.degrees(fit.turns.rms.value), 2)} deg rms")
        )
    traces = _laws(temperature, values, spread)
    for k in range(3):
        at, own = _recordings(record, k)
        traces.append(own_points(at, own, None, k, AXES[k]))
    residual = from_si(np.array(data.residual), "deg/h")
    points = [
        scatter(rounded(np.array(data.temperature)), rounded(residual[:, k], 4), "markers", name=name,
                marker={"symbol": SYMBOLS[k], "color": COLOURS[k], "size": 7})
        for k, name in enumerate(AXES)
    ]  # fmt: skip
    place = axis("temperature, degC")
    figures = [
        Figure(
            title="Bias of the gyroscopes over temperature",
            caption="Bands: two standard uncertainties, all that power cycles differ by included. Points: the mean of "
            "each recording that stayed at its temperature.",
            traces=traces,
            layout={"xaxis": place, "yaxis": axis("bias, deg/s"), "legend": LEGEND},
        ),
        Figure(
            title="What the laws leave of the gyroscopes at rest",
            caption="Law less output of each hold. A recording whose points lie together away from zero is a power "
            "cycle whose biases are offset; within it they scatter by noise, the Earth's rate (15 deg/h) and drift.",
            traces=points,
            layout={"xaxis": place, "yaxis": axis("law less output, deg/h"), "legend": LEGEND},
        ),
    ]
    if fit.turns is not None:
        figures.insert(1, _scale_factors(record, temperature, fit.turns.recordings))
    return facts, figures


def _laws(temperature: Array, values: Array, spread: Array) -> list[dict[str, Any]]:
    """Return the curves of three axes with their bands of two standard uncertainties."""
    traces = []
    for k, name in enumerate(AXES):
        low, high = values[k] - 2 * spread[k], values[k] + 2 * spread[k]
        traces += [
            band(temperature, low, high, COLOURS[k], showlegend=False),
            scatter(rounded(temperature), rounded(values[k]), "lines", name=name,
                    line={"color": COLOURS[k], "dash": DASHES[k]}),
        ]  # fmt: skip
    return traces


def _recordings(record: Calibration, axis: int) -> tuple[Array, Array]:
    """Return the temperature and the mean bias of each recording that stayed at its temperature, degC and deg/s."""
    data = thermal_of(record).data.gyro
    assert data is not None
    steady = np.array(data.rate) == 0
    names, index = np.unique(np.array(data.recording)[steady], return_inverse=True)
    at = np.array(data.temperature)[steady]
    values = gyro_predicted(record, at)[0][axis] - np.array(data.residual).reshape(-1, 3)[steady, axis]
    count = np.maximum(np.bincount(index, minlength=len(names)), 1)
    means = (np.bincount(index, weights=each, minlength=len(names)) / count for each in (at, values))
    temperature, bias = means
    return temperature, from_si(bias, "deg/s")


def _scale_factors(record: Calibration, temperature: Array, recordings: int) -> Figure:
    values, spread = gyro_scale_predicted(record, temperature)
    middle = values[:, [len(temperature) // 2]]
    return Figure(
        title="Scale factor of the gyroscopes over temperature",
        caption=f"From turns in {recordings} recordings. Change from the value at "
        f"{temperature[len(temperature) // 2]:.3g} degC; bands: two standard uncertainties.",
        traces=_laws(temperature, (values / middle - 1) * 1e6, spread / np.abs(middle) * 1e6),
        layout={
            "xaxis": axis("temperature, degC"),
            "yaxis": axis("scale factor, ppm", exponentformat="none"),
            "legend": LEGEND,
        },
    )


def own_points(temperature: Array, values: Array, reach: Array | None, axis: int, label: str) -> dict[str, Any]:
    """Return the values of single recordings as points with bars, beside the law of an axis."""
    bars = {} if reach is None else {
        "error_y": {"type": "data", "array": rounded(np.abs(reach)), "thickness": 1, "color": COLOURS[axis]}
    }  # fmt: skip
    marker = {"symbol": SYMBOLS[axis], "color": COLOURS[axis], "size": 7}
    return scatter(
        rounded(temperature), rounded(values), "markers", name=f"{label} alone", showlegend=False, marker=marker, **bars
    )


def _hourly(rate: float) -> float:
    return float(from_si(rate, "deg/h"))

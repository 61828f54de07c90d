"""What a thermal record shows of its gyroscopes: their biases over temperature with the band, and what is left."""

from __future__ import annotations

import numpy as np

from imulab.procedures.thermal.gyrorecord import gyro_predicted
from imulab.procedures.thermal.model import AXES
from imulab.procedures.thermal.sections import thermal_of
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.report.elements import GOOD, LEGEND, Figure, plain_number
from imulab.report.traces import DASHES, axis, band, rounded, scatter
from imulab.units import from_si

COLOURS = (GOOD, "#b58a1b", "#7a4f9a")
_SYMBOLS = ("circle", "diamond", "square")


def gyro_exhibits(record: Calibration, temperature: Array) -> tuple[list[tuple[str, str]], list[Figure]]:
    """Return the facts and figures of the gyroscopes of a record over temperatures, degC."""
    found = thermal_of(record)
    fit, data = found.fit.gyro, found.data.gyro
    assert fit is not None
    assert data is not None
    values, spread = (from_si(each, "deg/s") for each in gyro_predicted(record, temperature))
    tau = fit.between_recordings
    told = "not known" if tau.from_ == "unknown" else f"{plain_number(_hourly(tau.bias.value), 2)} deg/h ({tau.from_})"
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
    traces = []
    for k, name in enumerate(AXES):
        low, high = values[k] - 2 * spread[k], values[k] + 2 * spread[k]
        traces += [
            band(temperature, low, high, COLOURS[k], showlegend=False),
            scatter(rounded(temperature), rounded(values[k]), "lines", name=name,
                    line={"color": COLOURS[k], "dash": DASHES[k]}),
        ]  # fmt: skip
    residual = from_si(np.array(data.residual), "deg/h")
    points = [
        scatter(rounded(np.array(data.temperature)), rounded(residual[:, k], 4), "markers", name=name,
                marker={"symbol": _SYMBOLS[k], "color": COLOURS[k], "size": 7})
        for k, name in enumerate(AXES)
    ]  # fmt: skip
    place = axis("temperature, degC")
    return facts, [
        Figure(
            title="Bias of the gyroscopes over temperature",
            caption="Bands: two standard uncertainties, all that power cycles differ by included.",
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


def _hourly(rate: float) -> float:
    return float(from_si(rate, "deg/h"))

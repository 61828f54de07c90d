"""What a thermal record shows of its gyroscopes: their biases over temperature with the band, and what is left."""

from __future__ import annotations

import numpy as np

from imulab.procedures.thermal.gyrorecord import gyro_predicted, gyro_scale_predicted
from imulab.procedures.thermal.lawfigures import (
    COLOURS,
    SYMBOLS,
    Alone,
    Curves,
    law_figure,
    power_cycles,
    values_at_middle,
)
from imulab.procedures.thermal.model import AXES
from imulab.procedures.thermal.sections import thermal_of
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.report.elements import LEGEND, Figure, plain_number
from imulab.report.traces import axis, rounded, scatter
from imulab.units import from_si


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
        turns = f"{fit.turns.turns}, missed by {plain_number(np.degrees(fit.turns.rms.value), 2)} deg rms"
        facts.append(("turns", turns))
        if not found.model.gyro_laws.degrees[1]:
            # A law that nothing could bend is no figure over temperature.
            scale, u = gyro_scale_predicted(record, temperature)
            known = plain_number(1e6 * float((u / np.abs(scale)).max()), 2)
            told = f"known to {known} ppm where the turns were, and taken as the same at all temperatures"
            facts.append(("gyroscope scale factors", told))
    residual = from_si(np.array(data.residual), "deg/h")
    points = [
        scatter(rounded(np.array(data.temperature)), rounded(residual[:, k], 4), "markers", name=name,
                marker={"symbol": SYMBOLS[k], "color": COLOURS[k], "size": 7})
        for k, name in enumerate(AXES)
    ]  # fmt: skip
    place = axis("temperature, degC")
    figures = [
        law_figure(
            "Bias of the gyroscopes over temperature",
            "bias",
            "deg/s",
            Curves(AXES, temperature, values, spread),
            _recordings(record),
            read=power_cycles(tau.from_) + " Points: the mean of each recording that stayed at its temperature.",
        ),
        Figure(
            title="What the laws leave of the gyroscopes at rest",
            caption="Law less output of each hold. A recording whose points lie together away from zero is a power "
            "cycle whose biases are offset; within it they scatter by noise, the Earth's rate (15 deg/h) and drift.",
            traces=points,
            layout={"xaxis": place, "yaxis": axis("law less output, deg/h"), "legend": LEGEND},
        ),
    ]
    if fit.turns is not None and found.model.gyro_laws.degrees[1]:
        figures.insert(1, _scale_factors(record, temperature, fit.turns.recordings))
    return facts, figures


def _recordings(record: Calibration) -> Alone | None:
    """Return the mean bias of each recording that stayed at its temperature, deg/s; None where there are none."""
    data = thermal_of(record).data.gyro
    assert data is not None
    steady = np.array(data.rate) == 0
    names, index = np.unique(np.array(data.recording)[steady], return_inverse=True)
    if not len(names):
        return None
    at = np.array(data.temperature)[steady]
    laws = gyro_predicted(record, at)[0]
    values = laws - np.array(data.residual).reshape(-1, 3)[steady].T
    mean = np.array([np.bincount(index, weights=each) for each in (at, *values, *laws)]) / np.bincount(index)
    return Alone(mean[0], from_si(mean[1:4], "deg/s"), from_si(mean[4:], "deg/s"))


def _scale_factors(record: Calibration, temperature: Array, recordings: int) -> Figure:
    values, spread = gyro_scale_predicted(record, temperature)
    factors = 1e6 / np.abs(values[:, [len(temperature) // 2]])
    return law_figure(
        "Scale factor of the gyroscopes over temperature",
        "scale factor",
        "ppm",
        Curves(AXES, temperature, factors * values, factors * spread),
        None,
        read=f"from turns in {recordings} recordings.",
        at_middle=values_at_middle(record, [f"gyro_scale_factor_{axis}" for axis in AXES]),
    )


def _hourly(rate: float) -> float:
    return float(from_si(rate, "deg/h"))

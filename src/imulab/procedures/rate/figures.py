"""What a rate record shows: what the best line leaves over the rate, up and down apart, and what each source adds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from imulab.procedures.rate.record import sweep_table
from imulab.procedures.rate.schema import AxisFit, DwellResiduals, RateRecord, prior_table, rate_of
from imulab.procedures.rate.turns import turns_exhibits
from imulab.records.calibration import Calibration
from imulab.report.parameters import parameters_table, rows_of
from imulab.report.traces import (
    GOOD,
    INK,
    LEGEND,
    Exhibits,
    Figure,
    ReportTable,
    figure_axis,
    format_uncertain,
    plain_number,
    rounded,
    scatter,
)
from imulab.units import from_si

_PPM = 1e6  # to ppm
_LOOKS = (("rising", "triangle-up", "#c8553d"), ("falling", "triangle-down", GOOD), ("turning", "circle", INK))


def exhibits(record: Calibration) -> Exhibits:
    """Return the figures and tables of a record."""
    if record.model.get("from") == "turns":
        return turns_exhibits(record)
    rate_record = rate_of(record)
    axes = rate_record.model.axes
    largest = from_si(rate_record.model.largest_rate.value, "deg/s")
    worst = max(record.value(f"gyro_nonlinearity_{a}") for a in axes) * _PPM
    headline = (
        f"Gyroscopes {' '.join(axes)} over {largest:.4g} deg/s: a line leaves {plain_number(worst, 3)} ppm of the "
        "largest rate at most."
    )
    common = rate_record.fit.table_uncertainty
    facts = [
        ("runs", str(rate_record.fit.runs)),
        ("dwells", str(rate_record.fit.dwells)),
        ("rates from", rate_record.fit.rates_from),
        ("common to all rates", "not stated" if common is None else f"{plain_number(common * _PPM, 3)} ppm"),
    ]
    items: list[Figure | ReportTable] = [
        parameters_table(
            rows_of(record),
            "Bias, scale factor and misalignment in the frame of the faces on which the unit was mounted; nonlinearity "
            "and hysteresis as parts of the largest rate.",
        ),
        *([] if rate_record.fit.prior is None else [prior_table(rate_record.fit.prior, record)]),
        *(_left(a, rate_record.data.dwells) for a in axes),
        _of_line(record, rate_record),
        *([] if rate_record.fit.sweeps is None else [sweep_table(rate_record.fit.sweeps)]),
        _budget(record, rate_record),
    ]
    return Exhibits(headline, facts, items)


def exhibits_of_joined(record: Calibration) -> Exhibits:
    """Return what a record of both triads (``--accel``) shows of its gyroscopes beside the parameters."""
    fit, data = record.fit["rate"], record.data["rate"]
    by_hand = "turns" in data
    axes = sorted(set(data["turns" if by_hand else "dwells"]["axis"]))
    rate_part = replace(
        record,
        procedure="rate",
        parameters={name: p for name, p in record.parameters.items() if name.startswith("gyro_")},
        model={**record.model, "axes": "".join(axes), "from": "turns" if by_hand else "steps"},
        fit=fit,
        data=data,
    )
    exhibits_of_own = exhibits(rate_part)
    return replace(exhibits_of_own, items=exhibits_of_own.items[1:])


def _left(name: str, dwells: DwellResiduals) -> Figure:
    rate, left = (np.array(values) for values in (dwells.rate, dwells.residual))
    u = np.array(dwells.standard_uncertainty) * _PPM
    traces: list[dict[str, Any]] = []
    for label, symbol, colour in _LOOKS:
        which = np.array([a == name and d == label for a, d in zip(dwells.axis, dwells.direction, strict=True)])
        if which.any():
            traces.append(
                scatter(
                    rounded(from_si(rate[which], "deg/s")), rounded(left[which] * _PPM), "markers", name=label,
                    marker={"symbol": symbol, "color": colour, "size": 8},
                    error_y={"type": "data", "array": rounded(u[which]), "thickness": 1, "width": 2},
                )
            )  # fmt: skip
    return Figure(
        title=f"What the best line leaves of gyro_{name}",
        caption="Each dwell, in ppm of the largest rate; bars: one standard uncertainty by its noise. Rising and "
        "falling rates that lie apart are hysteresis; a bend that both follow is nonlinearity.",
        traces=traces,
        layout={
            "xaxis": figure_axis("rate, deg/s"),
            "yaxis": figure_axis("residual, ppm of the largest rate"),
            "legend": LEGEND,
        },
    )


def _of_line(record: Calibration, rate_record: RateRecord) -> ReportTable:
    def ppm(value: float | None) -> str:
        return "–" if value is None else plain_number(value * _PPM, 3)

    rows = []
    for name in rate_record.model.axes:
        fit = rate_record.fit.axes[name]
        sizes = [
            record.value(f"gyro_{kind}_{name}") if f"gyro_{kind}_{name}" in record.parameters else None
            for kind in ("nonlinearity", "asymmetry", "hysteresis")
        ]
        rows.append(
            [name, ppm(sizes[0]), ppm(fit.by_noise), f"{fit.probability:.3f}", *_of_powers(record, fit, name),
             ppm(sizes[1]), ppm(sizes[2]), *_of_loop(record, fit, name),
             "–" if fit.loop is None else f"{fit.loop:.3f}", ppm(fit.repeatability), ppm(fit.repeatability_by_noise)]
        )  # fmt: skip
    return ReportTable(
        "What a line does not hold, ppm",
        "Nonlinearity: largest residual of a rate over the largest rate; noise alone stays below the next column with "
        "95 %, and leaves as much as was found with probability p. Order: highest power of the rate in the model; "
        "what its powers leave is the largest residual beside them. Asymmetry: slope of positive less slope of "
        "negative rates. Hysteresis: largest rising less falling, of which noise alone makes some; loop: the same at "
        "rate 0 by all rates, with its u; p of loop is the probability that noise makes it. "
        "Repeatability: standard deviation of the scale factor over runs, and that which noise makes.",
        [
            "gyro",
            "nonlinearity",
            "95 % by noise",
            "p of noise",
            "order",
            "powers leave",
            "asymmetry",
            "hysteresis",
            "loop",
            "u",
            "p of loop",
            "repeatability",
            "by noise",
        ],
        rows,
    )


def _of_loop(record: Calibration, axis_fit: AxisFit, name: str) -> tuple[str, str]:
    """Return the fitted loop and its uncertainty, ppm; records of before have none."""
    if "fitted_loop" not in record.fit["axes"][name] or axis_fit.fitted_loop is None:
        return "–", "–"
    return format_uncertain(axis_fit.fitted_loop * _PPM, (axis_fit.fitted_loop_uncertainty or 0.0) * _PPM)


def _of_powers(record: Calibration, axis_fit: AxisFit, name: str) -> tuple[str, str]:
    """Return the order of a gyroscope, and what its powers leave, ppm; records of before have but one order."""
    if "order" not in record.fit["axes"][name]:
        return str(record.model["gyro_order"]), "–"
    return str(axis_fit.order), plain_number(axis_fit.by_polynomial * _PPM, 3)


def _budget(record: Calibration, rate_record: RateRecord) -> ReportTable:
    common = (rate_record.fit.table_uncertainty or 0.0) * _PPM
    rows = []
    for name in rate_record.model.axes:
        scale = record.parameter(f"gyro_scale_factor_{name}")
        whole = (scale.standard_uncertainty or 0.0) / abs(scale.value) * _PPM
        rest = float(np.sqrt(max(whole**2 - common**2, 0.0)))
        rows.append([f"gyro_scale_factor_{name}", *(plain_number(value, 3) for value in (rest, common, whole))])
    earlier = ", of the earlier record too" if "prior" in record.fit else ""
    return ReportTable(
        "What the uncertainty of a scale factor is made of, ppm",
        f"Dwells: noise, errors of single rates, and what scatters beyond them{earlier}; more dwells make it smaller. "
        "Table: what all rates have in common, which no number of dwells makes smaller.",
        ["parameter", "dwells", "table", "all"],
        rows,
    )

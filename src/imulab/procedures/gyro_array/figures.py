"""The figures and tables of an array's record, from the record alone; those of a comparison in `compare_figures`."""

from __future__ import annotations

import math

import numpy as np

from imulab.errors import RecordError
from imulab.procedures.gyro_array.compare_figures import exhibits_of_comparison
from imulab.procedures.gyro_array.sections import ArrayRecord, PerGyro, array_of, model_of
from imulab.procedures.gyro_array.traces import allan_trace, curves, of_axis
from imulab.records.calibration import Calibration
from imulab.report.elements import Exhibits, Figure, ReportTable, format_uncertain, plain_number
from imulab.report.traces import correlation_map, log_axis, strongest_pair
from imulab.units import from_si

_ELEMENT_SHADES = ("#1f6f8b", "#c8553d", "#8e6bbd", "#c99a2e", "#4f9d69", "#2e4057", "#d081a5", "#6f7f3f")


def exhibits(record: Calibration) -> Exhibits:
    """Return what a report on this record shows."""
    return exhibits_of_comparison(record) if model_of(record).kind == "comparison" else _calibration(array_of(record))


def summary(record: Calibration) -> tuple[list[str], list[list[str]]]:
    """Return the first table of the report: each gyro with its uncertainties, or each method."""
    first = next(item for item in exhibits(record).items if isinstance(item, ReportTable))
    return first.columns, first.rows


def _calibration(record: ArrayRecord) -> Exhibits:
    elements, model, shared = record.elements, record.model, record.correlation
    limit = float(np.mean([_deg(limit.value) for limit in shared.limit]))
    tau = shared.averaging_time.value
    spread = float(np.degrees(np.ptp(np.array([element.bias.values for element in elements]), axis=0)).max())
    worst = float(np.degrees(max(element.bias.uncertainties.max() for element in elements)))
    facts = [
        ("elements", f"{model.elements} × {len(model.axes)} {'axes' if len(model.axes) > 1 else 'axis'}"),
        ("at rest", f"{plain_number(record.fit.duration.value, 3)} s"),
        ("spread of biases", f"{plain_number(spread, 3)} deg/s"),
        ("worst u(bias)", f"{plain_number(worst, 2)} deg/s"),
        (f"limit at {tau:g} s", f"{plain_number(limit, 3)} deg/s"),
        ("alignment", "from motion" if model.aligned else "not measured"),
    ]
    items: list[Figure | ReportTable] = [_elements_table(record)]
    if model.aligned and len(model.axes) == 3:
        items.append(_matrix_table(record))
    items += [_allan_elements(record, a) for a in range(len(model.axes))]
    items += [_correlation(record, a) for a in range(len(model.axes))]
    single = _deg(float(np.mean([math.sqrt(c) for m in shared.covariance for c in np.diag(np.array(m))])))
    return Exhibits(
        headline=f"{model.elements} gyros whose biases differ by up to {plain_number(spread, 3)} deg/s; best "
        f"weights would bring {plain_number(single, 3)} deg/s of a single one at {tau:g} s down to "
        f"{plain_number(limit, 3)} deg/s.",
        facts=facts,
        items=items,
    )


def _deg(value: float) -> float:
    return float(from_si(value, "deg/s"))


def _elements_table(record: ArrayRecord) -> ReportTable:
    rows = []
    one = len(record.model.axes) == 1
    for element in record.elements:
        scale = element.scale_factor if one else None
        for a, axis in enumerate(record.model.axes):
            rows.append(
                [
                    element.name if not axis else f"{axis} {element.name}",
                    _text(element.bias, a, 180 / math.pi),
                    *([] if scale is None else [" ± ".join(format_uncertain(scale.value, scale.standard_uncertainty))]),
                    _text(element.angle_random_walk, a, 60 * 180 / math.pi),
                    _text(element.bias_instability, a, 3600 * 180 / math.pi),
                    _text(element.rate_random_walk, a, 3600 * 60 * 180 / math.pi),
                ]
            )
    scaled = one and record.model.aligned
    return ReportTable(
        title="Elements",
        caption="Value ± standard uncertainty. Bias is the plain mean at rest, the part that all share (Earth rate "
        "too) included. Angle random walk (ARW), bias instability and rate random walk (RRW) are those of the noise "
        "model whose Allan curves are below; 0 ± u means that the recording is too short or the effect too small to be "
        "seen, not determined that the noise is not that of the model (the warnings say why).",
        columns=[
            "gyro",
            "bias, deg/s",
            *(["scale factor"] if scaled else []),
            "ARW, deg/√h",
            "bias instability, deg/h",
            "RRW, deg/h/√h",
        ],
        rows=rows,
    )


def _text(found: PerGyro, a: int, factor: float) -> str:
    """Value and standard uncertainty on an axis, in a unit that is so much smaller."""
    value, u = float(found.values[a]) * factor, float(found.uncertainties[a]) * factor
    if math.isnan(value):
        return "not determined"
    return " ± ".join(format_uncertain(value, None if math.isnan(u) else u))


def _matrix_table(record: ArrayRecord) -> ReportTable:
    rows = []
    for element in record.elements:
        if element.matrix is None or element.residual is None:
            raise RecordError(f"the record lacks the matrix or residual of element {element.name}")
        cells = ["  ".join(f"{value:+.4f}" for value in row) for row in element.matrix.value]
        worst = 1e6 * np.max(element.matrix.standard_uncertainty)
        rows.append([element.name, *cells, f"{worst:.0f}", plain_number(_deg(element.residual.values.max()), 3)])
    return ReportTable(
        title="Alignment",
        caption=f"Rate = matrix (reading − bias); rows of the matrix are x, y, z. Gauge: {record.model.gauge}. u: "
        "largest standard uncertainty of an entry. A residual far above the noise means errors that a matrix cannot "
        "hold (nonlinearity, timing, g-sensitivity).",
        columns=["element", "x", "y", "z", "u, 10⁻⁶", "residual, deg/s"],
        rows=rows,
    )


def _allan_elements(record: ArrayRecord, a: int) -> Figure:
    traces = []
    for i, curve in enumerate(record.data.allan[a]):
        traces.append(allan_trace(curve, record.elements[i].name, _ELEMENT_SHADES[i % 8], math.degrees(1), number=i))
    return curves(
        title=f"Allan deviation of each gyro{of_axis(record.model.axes[a])}",
        caption="Slope −1/2: angle random walk. Flat: bias instability. Slope +1/2: rate random walk. A curve apart "
        "from the others is a gyro apart from the others; the last points on the right are few averages.",
        traces=traces,
        x=log_axis("averaging time, s"),
        y=log_axis("Allan deviation, deg/s"),
    )


def _correlation(record: ArrayRecord, a: int) -> Figure:
    shared = record.correlation
    names = [f"{record.model.axes[a]} {element.name}".strip() for element in record.elements]
    matrix = np.array(shared.matrix[a])
    text = [[f"{value:.2f}" for value in row] for row in matrix]
    noise = float(np.median(shared.standard_uncertainty[a]))
    return Figure(
        message=f"The pair that goes together most: {strongest_pair(matrix, names)}." if len(names) > 1 else "",
        title=f"Correlation of the noise{of_axis(record.model.axes[a])}",
        caption=f"At {shared.averaging_time.value:g} s, ± {noise:.2f} each. What all share, no weights remove; "
        "a pair that goes together counts for less than two.",
        traces=[correlation_map(matrix, names, text=text, texttemplate="%{text}" if len(names) <= 12 else "")],
        layout={"xaxis": {"automargin": True}, "yaxis": {"autorange": "reversed", "automargin": True}},
        height=max(360, 28 * len(names) + 120),
    )

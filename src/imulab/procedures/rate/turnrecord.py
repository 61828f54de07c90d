"""The calibration record of whole turns, and what its report shows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from imulab.estimation.least_squares import coverage_factor
from imulab.procedures.rate.choices import AXES
from imulab.procedures.rate.engineering import prior_table
from imulab.procedures.rate.engineering import rows as engineering_rows
from imulab.procedures.rate.sections import turns_of
from imulab.procedures.rate.turnrests import Motions
from imulab.recording import Recording
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.report.elements import BAD, GOOD, INK, LEGEND, Exhibits, Figure, ReportTable, format_uncertain, plain_number
from imulab.report.traces import axis, rounded, scatter
from imulab.units import from_si
from imulab.verdict import Bad, Note

if TYPE_CHECKING:
    from imulab.procedures.rate.turnrests import AxisTurns

_FAR = 0.1
_LOOKS = {"x": ("circle", INK), "y": ("diamond", GOOD), "z": ("square", BAD)}


def turns_record(
    recording: Recording, motions: Motions, found: Mapping[str, AxisTurns], fence: float, clock: float | None
) -> Calibration:
    """Turn the scale factors found into the record."""
    unit = recording.triad_unit("gyro")
    nominal = float(from_si(1.0, unit))
    parameters = {
        f"gyro_bias_{a}": Parameter(
            float(motions.bias[AXES.index(a)]) / of.scale,
            float(motions.bias_uncertainty[AXES.index(a)]) / of.scale,
            "rad/s",
        )
        for a, of in found.items()
    }
    for a, of in found.items():
        u = float(np.hypot(of.scale_uncertainty, of.scale * (clock or 0.0)))
        reach = None if of.freedom is None else coverage_factor(float(of.freedom)) * u
        parameters[f"gyro_scale_factor_{a}"] = Parameter(
            of.scale * nominal,
            u * nominal,
            f"{unit}/(rad/s)",
            interval_95=None if reach is None else ((of.scale - reach) * nominal, (of.scale + reach) * nominal),
        )
    spread = np.array([p.standard_uncertainty or 0.0 for p in parameters.values()])
    matrix = np.diag(spread**2)
    names = list(parameters)
    for i, a in enumerate(names):
        for k, b in enumerate(names):
            if i != k and a.startswith("gyro_scale") and b.startswith("gyro_scale"):
                matrix[i, k] = parameters[a].value * parameters[b].value * (clock or 0.0) ** 2
    turned = sorted((k, a, j) for a, of in found.items() for j, k in enumerate(of.motion))
    return Calibration(
        procedure="rate",
        parameters=parameters,
        covariance=Covariance(tuple(names), tuple(map(tuple, matrix.tolist()))),
        model={"gyro_order": 1, "gyro_output_unit": unit, "axes": "".join(found), "from": "turns"},
        fit={"turns": len(turned), "fence": {"value": fence, "unit": "rad"}, "clock": clock},
        options={"fence": fence},
        data={
            "turns": {
                "axis": [a for _, a, _ in turned],
                "start": [float(motions.start[k]) for k, _, _ in turned],
                "stop": [float(motions.stop[k]) for k, _, _ in turned],
                "count": [float(found[a].count[j]) for _, a, j in turned],
                "angle": [float(found[a].angle[j]) for _, a, j in turned],
                "residual": [float(found[a].residual[j]) for _, a, j in turned],
                "standard_uncertainty": [float(found[a].uncertainty[j]) for _, a, j in turned],
            }
        },
        sensor={key: text for key in ("serial", "model", "element") if (text := recording.metadata.get(key))},
        sources=() if recording.source is None else (recording.source,),
        warnings=(*motions.notes, *_findings(found, clock)),
    )


def _findings(found: Mapping[str, AxisTurns], clock: float | None) -> list[str]:
    said: list[str] = []
    for a, of in found.items():
        if abs(of.scale - 1) > _FAR:
            said.append(Bad(f"gyro_{a}: the scale factor is off by {100 * (of.scale - 1):+.3g} %: is the unit right?"))
        if of.freedom is not None:
            said.append(Note(f"gyro_{a}: the turns scatter more than the fence; its interval is Student's t of them"))
        if not ((of.count > 0).any() and (of.count < 0).any()):
            said.append(
                Note(
                    f"gyro_{a} was turned one way round only: what is even in the rate, and an error of the zero, "
                    "is in its scale factor; turn as many back"
                )
            )
    if clock is None:
        said.append(
            Note(
                "the scale factors are those per clock: a sample rate that is off is in them; state what it is known "
                "to (--clock)"
            )
        )
    return said


def turns_exhibits(record: Calibration) -> Exhibits:
    """Return the figures and tables of a record of turns."""
    found = turns_of(record)
    seen = found.data.turns
    rows = []
    for row in engineering_rows(record):
        value, u = format_uncertain(row.value, row.standard_uncertainty)
        rows.append([row.name, value, u, row.unit])
    worst = max(
        (p.standard_uncertainty or 0.0) / abs(p.value) for n, p in record.parameters.items() if "scale_factor" in n
    )
    degrees = [[float(np.degrees(v)) for v in c] for c in (seen.angle, seen.residual, seen.standard_uncertainty)]
    table = [
        [a, f"{start:.1f}", f"{stop:.1f}", f"{count:+.0f}", f"{angle:.2f}", f"{left:+.3f}", f"{u:.2g}"]
        for a, start, stop, count, angle, left, u in zip(
            seen.axis, seen.start, seen.stop, seen.count, *degrees, strict=True
        )
    ]
    number = list(range(1, len(table) + 1))
    traces: list[dict[str, Any]] = []
    for name, (symbol, colour) in _LOOKS.items():
        which = [k for k, of in enumerate(seen.axis) if of == name]
        if which:
            rest, bars = (rounded([degrees[k][j] for j in which]) for k in (1, 2))
            traces.append(
                scatter(
                    [number[j] for j in which], rest, "markers", name=f"gyro_{name}",
                    marker={"color": colour, "symbol": symbol, "size": 8},
                    error_y={"type": "data", "array": bars, "thickness": 1, "width": 2},
                )
            )  # fmt: skip
    several = len(table) > len(set(seen.axis))  # of one turn about each axis nothing is left
    figure = Figure(
        title="What is left of each turn",
        caption="By the scale factor of these turns. Bars: one standard uncertainty, of both stops and of the zero.",
        traces=traces,
        layout={"xaxis": axis("turn", dtick=1), "yaxis": axis("residual, deg"), "legend": LEGEND},
    )
    fence = float(np.degrees(found.fit.fence.value))
    return Exhibits(
        f"{found.fit.turns} turns against a fence of {plain_number(fence, 2)} deg: scale factors are known to "
        f"{plain_number(1e6 * worst, 3)} ppm or better.",
        [("turns", str(found.fit.turns)), ("fence", f"{plain_number(fence, 2)} deg")],
        [
            ReportTable("Parameters", "Per clock where no uncertainty of it was stated.",
                        ["parameter", "value", "u", "unit"], rows),
            *([prior_table(found.fit.prior, record)] if "prior" in record.fit else []),
            ReportTable(
                "Turns",
                "Stated angle of each, and what is left of it by the scale factor of these turns.",
                ["gyro", "from, s", "to, s", "turns", "angle, deg", "residual, deg", "u, deg"],
                table,
            ),
            *([figure] if several else []),
        ],
    )  # fmt: skip

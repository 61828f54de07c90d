"""What a check of a record over temperature shows: the verdict, and each residual beside its uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from imulab._version import VERSION
from imulab.procedures.thermal.lawfigures import own_points
from imulab.procedures.thermal.model import AXES
from imulab.records.calibration import Calibration
from imulab.report import render_page
from imulab.report.elements import BAD, GOOD, LEGEND, QUIET, Exhibits, Figure, ReportTable
from imulab.report.traces import axis, rounded, scatter
from imulab.units import from_si
from imulab.verdict import Bad, Note, verdict_of

if TYPE_CHECKING:
    from imulab.procedures.thermal.check import ThermalCheck

_BEYOND = 2.0


def _ug(value: float, sign: str = "+") -> str:
    micro = from_si(float(value), "ug")
    return f"{micro:{sign}.3g}" if abs(micro) < 999.5 else f"{micro:{sign}.0f}"


def _p(value: float | None) -> str:
    return "not tested" if value is None else f"p = {value:.2g}" if value >= 1e-12 else "p below 1e-12"


_SAID = (
    "|f| differs from g between attitudes or temperatures by more than the record explains",
    "an offset that whole recordings have in common is larger than power cycles explain",
    "the gyroscopes at rest differ between attitudes or temperatures by more than the record explains",
    "an offset of the gyroscopes that whole recordings have in common is larger than power cycles explain",
)


def meaning(check: ThermalCheck) -> str:
    """Return what the test says, in words."""
    if check.passed:
        return "the recordings agree with the record"
    if check.probability >= 0.05:
        return "no change of the unit is shown, but a hold is beyond the limit"
    gyro = check.gyro
    each = (check.within, check.between, *((gyro.within, gyro.between) if gyro else ()))
    what = _SAID[int(np.argmin([2.0 if p is None else p for p in each]))]
    return f"{what}: the unit has changed since the record was made, or gravity, unit or temperature are not as assumed"


def as_text(check: ThermalCheck, verdict: str) -> str:
    """Return the verdict with its p, what to do next, and the residual of every hold."""
    lines = [f"{verdict}: {meaning(check)}"]
    if not check.passed:
        lines.append(
            "measure again; 'imulab thermal fit' of the old recordings with this one says where they disagree, and a "
            "record that follows the change takes recordings over temperature anew"
        )
    worst = check.worst
    lines.append(
        f"{_p(check.probability)} over {len(check.holds)} holds (within recordings {_p(check.within)}, common to each "
        f"{_p(check.between)}), largest |f| - g {_ug(check.residuals[worst])} ug ({check.holds.label(worst)})"
    )
    if check.gyro is not None:
        gyro, (row, k) = check.gyro, check.gyro.worst
        lines.append(
            f"gyroscopes: within recordings {_p(gyro.within)}, common to each {_p(gyro.between)}, largest law less "
            f"output {_hourly(gyro.residuals[row, k]):+.3g} ± {_hourly(gyro.standard_uncertainty[row, k]):.2g} deg/h "
            f"({AXES[k]}, {check.holds.label(int(gyro.holds[row]))})"
        )
    pairs = zip(check.residuals.tolist(), check.standard_uncertainty.tolist(), strict=True)
    for index, (value, u) in enumerate(pairs):
        beyond = "  beyond the limit" if check.limit is not None and abs(value) > check.limit else ""
        lines.append(f"{check.holds.label(index)}: {_ug(value)} ± {_ug(u, '')} ug{beyond}")
    return "\n".join(lines)


def as_json(check: ThermalCheck) -> dict[str, Any]:
    """Return the same for scripts, in SI."""
    rows = zip(
        check.holds.temperature.tolist(), check.residuals.tolist(), check.standard_uncertainty.tolist(), strict=True
    )
    return {
        "verdict": "pass" if check.passed else "fail",
        "p": check.probability,
        "p_within": check.within,
        "p_between": check.between,
        "limit": None if check.limit is None else {"value": check.limit, "unit": "m/s^2"},
        "gravity": check.gravity.entry(),
        "holds": [
            {"label": check.holds.label(k), "temperature": at, "residual": value, "standard_uncertainty": u}
            for k, (at, value, u) in enumerate(rows)
        ],
        **({} if check.gyro is None else {"gyro": _gyro_as_json(check)}),
        "notes": [str(note) for note in check.notes],
    }


def _gyro_as_json(check: ThermalCheck) -> dict[str, Any]:
    gyro = check.gyro
    assert gyro is not None
    rows = zip(gyro.holds.tolist(), gyro.residuals.tolist(), gyro.standard_uncertainty.tolist(), strict=True)
    return {
        "p_within": gyro.within,
        "p_between": gyro.between,
        "holds": [
            {"label": check.holds.label(k), "residual": residual, "standard_uncertainty": u} for k, residual, u in rows
        ],
    }


def exhibits_of_check(check: ThermalCheck) -> Exhibits:
    """Return what the report shows."""
    worst = f"{_ug(check.residuals[check.worst])} µg"
    facts = [
        *(
            (name, _p(value).removeprefix("p ").removeprefix("= "))
            for name, value in (
                ("p, if nothing changed", check.probability),
                ("p within recordings", check.within),
                ("p of what each has in common", check.between),
                *(
                    (
                        ("gyroscopes: p within recordings", check.gyro.within),
                        ("gyroscopes: p of what each has in common", check.gyro.between),
                    )
                    if check.gyro
                    else ()
                ),
            )
        ),
        ("largest |f| − g", worst),
    ]
    rows = [
        [check.holds.label(k), _ug(value), _ug(u, ""), f"{value / u:+.1f}"]
        for k, (value, u) in enumerate(zip(check.residuals.tolist(), check.standard_uncertainty.tolist(), strict=True))
    ]
    table = ReportTable(
        "Holds",
        "Residual |f| − g under the record, its standard uncertainty u, and their ratio. The test weighs all together, "
        "with what their errors share.",
        ["hold", "|f| − g, µg", "u, µg", "(|f| − g) / u"],
        rows,
    )
    return Exhibits(
        f"{'Pass' if check.passed else 'Fail'}: {meaning(check)}.",
        facts,
        [_figure(check), *([_gyro_figure(check)] if check.gyro else []), table],
    )


def _figure(check: ThermalCheck) -> Figure:
    residual, u = (from_si(values, "ug") for values in (check.residuals, check.standard_uncertainty))
    far = np.abs(residual) > _BEYOND * u
    traces = []
    for which, colour, symbol in ((~far, GOOD, "circle"), (far, BAD, "diamond")):
        if which.any():
            bars = {"type": "data", "array": rounded(_BEYOND * u[which]), "color": QUIET, "thickness": 1, "width": 3}
            traces.append(
                scatter(rounded(check.holds.temperature[which]), rounded(residual[which]), "markers", error_y=bars,
                        marker={"size": 8, "color": colour, "symbol": symbol},
                        text=[check.holds.label(k) for k in np.flatnonzero(which).tolist()],
                        hovertemplate="%{text}<br>%{y:.1f} µg<extra></extra>")
            )  # fmt: skip
    return Figure(
        title="Residual |f| − g of each hold under the record, over temperature",
        message=f"{int(far.sum())} of {len(far)} holds lie beyond twice the standard uncertainty.",
        caption="Bars: twice the standard uncertainty, from laws, power cycle, temperature and noise; the holds of a "
        "recording have most of it in common. Red diamonds lie beyond.",
        traces=traces,
        layout={"xaxis": axis("temperature, degC"), "yaxis": axis("|f| − g, µg", zeroline=True), "showlegend": False},
    )


def _gyro_figure(check: ThermalCheck) -> Figure:
    gyro = check.gyro
    assert gyro is not None
    at = check.holds.temperature[gyro.holds]
    residual, u = (from_si(values, "deg/h") for values in (gyro.residuals, gyro.standard_uncertainty))
    far = int((np.abs(residual) > _BEYOND * u).sum())
    traces = [
        own_points(at, residual[:, k], _BEYOND * u[:, k], k, name) | {"name": name, "showlegend": True}
        for k, name in enumerate(AXES)
    ]
    return Figure(
        title="The gyroscopes at rest under the record, over temperature",
        message=f"{far} of {residual.size} outputs lie beyond twice the standard uncertainty.",
        caption="Bars: twice the standard uncertainty, from laws, power cycle, temperature, Earth's rate and noise.",
        traces=traces,
        layout={
            "xaxis": axis("temperature, degC"),
            "yaxis": axis("law less output, deg/h", zeroline=True),
            "legend": LEGEND,
        },
    )


def _hourly(rate: float) -> float:
    return float(from_si(float(rate), "deg/h"))


def check_page(
    check: ThermalCheck, held: Calibration, *, record: str, files: Sequence[str], warnings: Sequence[str]
) -> str:
    """Return the report; `warnings` are those of the command."""
    failed = [] if check.passed else [Bad(meaning(check))]
    return render_page(
        f"Thermal check: {'pass' if check.passed else 'fail'}",
        held.sensor.get("serial", "unit without serial number"),
        exhibits_of_check(check),
        verdict=verdict_of([*failed, *warnings]),
        notes=[note for note in warnings if isinstance(note, Note)],
        provenance=[
            ("record", f"{record}, created {held.created}"),
            *(("recording", file) for file in files),
            ("gravity", f"{check.gravity.value:.9g} m/s^2"),
            ("software", f"imulab {VERSION}"),
        ],
    )

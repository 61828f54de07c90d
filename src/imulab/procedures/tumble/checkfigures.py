"""The report of a test of a record by fresh attitudes: verdict, and each residual beside its uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from imulab._version import VERSION
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.engineering import micro_g, small_g
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.report import render_page
from imulab.report.bulk import bulk, edge_marks, edge_note
from imulab.report.elements import BAD, GOOD, QUIET, Exhibits, Figure, ReportTable, format_uncertain
from imulab.report.traces import axis, rounded, scatter
from imulab.verdict import Bad, Note, verdict_of

if TYPE_CHECKING:
    from imulab.procedures.tumble.compare import Check

_BEYOND = 2.0
"""Standard uncertainties beyond which a residual is marked."""
_BEYOND_BOTH = float(np.sqrt(2 * np.log(20.0)))
"""The same of two at once, which one in twenty exceeds by chance."""


def meaning(check: Check) -> str:
    """Return what the test says, in words."""
    if check.passed:
        return "the attitudes agree with the record"
    if _limit_alone(check):
        return "no change of the unit is shown, but an attitude is beyond the limit"
    if check.accelerometers_agree:
        return "hard or soft iron has changed since the record was made, or iron was near"
    return "the unit has changed since the record was made, or gravity, unit or attitudes are not as assumed"


def next_step(check: Check, record: str, file: str) -> list[str]:
    """Return what to do or to know where the test failed."""
    if check.passed:
        return []
    if _limit_alone(check):
        return ["the limit is smaller than the uncertainty of the attitudes can tell"]
    if check.accelerometers_agree:
        return [
            "measure again away from iron, or 'imulab tumble mag FILE -o NEW.json' with 16 or more attitudes for a "
            "record that follows the change"
        ]
    return [
        f"measure again, or 'imulab tumble fit {file} --prior {record} -o NEW.json' for a record that follows the "
        "change"
    ]


def measured(check: Check, attitudes: Attitudes) -> str:
    """Return p and the largest residual."""
    n = len(attitudes)
    test = "not tested, the record states no uncertainties"
    if check.probability is not None:
        p = f"p = {check.probability:.2g}" if check.probability else "p below 1e-300"
        test = f"{p} (chi-square {check.chi_square:.3g} of {n})"
    limit = "" if check.limit is None else f", limit {small_g(check.limit)}"
    return (
        f"{test}, {n} attitudes, largest |f| - g {small_g(check.residuals[check.worst])} "
        f"({attitudes.label(check.worst)}){limit}"
    )


def of_magnetometers(check: Check, attitudes: Attitudes, unit: str) -> list[str]:
    """Return what the test of the magnetometers says; `unit` is that of the record's biases."""
    mag = check.mag
    if mag is None:
        return []
    p = f"p = {mag.probability:.2g}" if mag.probability else "p below 1e-300"
    worst = mag.worst
    lines = [
        f"magnetometers: |m| and dip {'stay the same' if check.magnetometers_agree else 'do not stay the same'}, {p}, "
        f"farthest off |m| {100 * mag.magnitude[worst]:+.2g} %, dip {np.degrees(mag.dip[worst]):+.2g} deg "
        f"({attitudes.label(worst)})",
        f"field against that of the record: |m| {format_both(100 * mag.common[0], 100 * mag.common_uncertainty[0])} %, "
        f"dip {format_both(*np.degrees([mag.common[1], mag.common_uncertainty[1]]).tolist())} deg (not tested: of the "
        "place)",
    ]
    if not check.magnetometers_agree and mag.explained >= check.false_alarm:
        of = "uT" if unit == "T" else "of the field"
        shown = ", ".join(f"{1e6 * v:+.2f}" if unit == "T" else f"{v:+.4f}" for v in mag.hard_iron.tolist())
        lines.append(f"a hard iron that changed by ({shown}) {of} explains it (p = {mag.explained:.2g})")
    return lines


def format_both(value: float, uncertainty: float) -> str:
    """Return ``+0.12 ± 0.05``."""
    return " ± ".join(format_uncertain(value, uncertainty))


def _limit_alone(check: Check) -> bool:
    return check.probability is not None and check.accelerometers_agree and check.magnetometers_agree


def check_page(
    check: Check, attitudes: Attitudes, held: Calibration, *, record: str, file: str, warnings: Sequence[str]
) -> str:
    """Return the report; `warnings` are those of the command."""
    failed = [] if check.passed else [Bad(meaning(check)), *next_step(check, record, file)]
    return render_page(
        f"Tumble check: {'pass' if check.passed else 'fail'}",
        held.sensor.get("serial", "unit without serial number"),
        exhibits_of_check(check, attitudes),
        verdict=verdict_of([*failed, *warnings]),
        notes=[note for note in warnings if isinstance(note, Note)],
        provenance=[
            ("record", f"{record}, created {held.created}"),
            ("file", file),
            ("gravity", f"{check.gravity.value:.9g} m/s^2"),
            ("software", f"imulab {VERSION}"),
        ],
    )


def exhibits_of_check(check: Check, attitudes: Attitudes) -> Exhibits:
    """Return what the report shows."""
    facts = [("attitudes", str(len(attitudes))), ("largest |f| − g", small_g(check.residuals[check.worst]))]
    if check.probability is not None:
        facts.insert(0, ("p, if nothing changed", f"{check.probability:.2g}" if check.probability else "below 1e-300"))
    if check.limit is not None:
        facts.append(("limit", small_g(check.limit)))
    return Exhibits(
        f"{'Pass' if check.passed else 'Fail'}: {meaning(check)}; {measured(check, attitudes)}.",
        facts,
        [_figure(check, attitudes), *_mag_figures(check, attitudes), _table(check, attitudes)],
    )


def _beyond(check: Check) -> NDArray[np.bool_]:
    """Return which attitudes are beyond the limit, or beyond twice their uncertainty."""
    size = np.abs(check.residuals)
    beyond = np.zeros(len(size), dtype=bool)
    if check.limit is not None:
        beyond |= size > check.limit
    if check.standard_uncertainty is not None:
        beyond |= size > _BEYOND * check.standard_uncertainty
    return beyond


def _figure(check: Check, attitudes: Attitudes) -> Figure:
    number = list(range(1, len(attitudes) + 1))
    residual = np.array([micro_g(value) for value in check.residuals.tolist()])
    beyond = _beyond(check)
    trace = _points(attitudes, residual, beyond)
    room, bars = 0.0, " The record states no uncertainties."
    if check.standard_uncertainty is not None:
        half = [_BEYOND * micro_g(value) for value in check.standard_uncertainty.tolist()]
        trace["error_y"] = {"type": "data", "array": half, "color": QUIET, "thickness": 1, "width": 3}
        room = float(np.median(half))
        bars = (
            " Bars: twice the standard uncertainty, from record and attitude; one in twenty lies farther off by chance."
        )
    far = bulk(residual, room=room)
    marks = [] if far is None else edge_marks(far, residual, number, [small_g(v) for v in check.residuals.tolist()])
    limit = [] if check.limit is None else [-micro_g(check.limit), micro_g(check.limit)]
    count = int(beyond.sum())
    return Figure(
        title="Residual |f| − g of each fresh attitude under the record",
        message=f"{count} of {len(number)} attitudes {'lies' if count == 1 else 'lie'} beyond "
        f"{'the limit or ' if limit else ''}twice the standard uncertainty.",
        caption=f"f is the specific force by the record, g local gravity.{bars}"
        f"{' Dashed: the limit.' if limit else ''} Red diamonds lie beyond."
        + edge_note(0 if far is None else int(far.beyond.sum())),
        traces=[trace, *marks],
        layout={
            "xaxis": {
                "title": {"text": "attitude"},
                "dtick": max(1, round(len(number) / 20)),
                "range": [0.4, len(number) + 0.6],
                "gridcolor": "#e6eaed",
                "zeroline": False,
            },
            "yaxis": {
                "title": {"text": "|f| − g, µg"},
                "gridcolor": "#e6eaed",
                "zerolinecolor": QUIET,
                **({} if far is None else {"range": [far.low, far.high]}),
            },
            "showlegend": False,
            "shapes": [
                {
                    "type": "line",
                    "xref": "paper",
                    "x0": 0,
                    "x1": 1,
                    "y0": end,
                    "y1": end,
                    "line": {"color": BAD, "dash": "dash", "width": 1.5},
                }
                for end in limit
            ],
        },
    )


def _points(attitudes: Attitudes, residual: Array, beyond: NDArray[np.bool_]) -> dict[str, Any]:
    """Return the residual of each attitude, µg, as a point, marked where it is beyond."""
    return {
        "type": "scatter",
        "mode": "markers",
        "x": list(range(1, len(attitudes) + 1)),
        "y": residual.tolist(),
        "marker": {
            "size": 9,
            "color": [BAD if mark else GOOD for mark in beyond.tolist()],
            "symbol": ["diamond" if mark else "circle" for mark in beyond.tolist()],
        },
        "text": [attitudes.label(i) for i in range(len(attitudes))],
        "hovertemplate": "%{text}<br>%{y:.1f} µg<extra></extra>",
    }


def _mag_figures(check: Check, attitudes: Attitudes) -> list[Figure]:
    """Return |m| and dip of each fresh attitude, less what all have in common."""
    mag = check.mag
    if mag is None:
        return []
    number = list(range(1, len(attitudes) + 1))
    far = np.hypot(mag.magnitude / mag.magnitude_uncertainty, mag.dip / mag.dip_uncertainty) > _BEYOND_BOTH
    marker = {
        "size": 8, "color": [BAD if mark else GOOD for mark in far.tolist()],
        "symbol": ["diamond" if mark else "circle" for mark in far.tolist()],
    }  # fmt: skip
    texts, traces = [attitudes.label(i) for i in range(len(attitudes))], []
    for values, sigma, unit, place in (
        (100 * mag.magnitude, 100 * mag.magnitude_uncertainty, "%", "y2"),
        (np.degrees(mag.dip), np.degrees(mag.dip_uncertainty), "deg", "y"),
    ):
        bars = {"type": "data", "array": rounded(2 * sigma), "color": QUIET, "thickness": 1, "width": 3}
        traces.append(
            scatter(number, rounded(values), "markers", marker=marker, error_y=bars, text=texts, yaxis=place,
                    hovertemplate=f"%{{text}}<br>%{{y:+.2f}} {unit}<extra></extra>")
        )  # fmt: skip
    return [
        Figure(
            title="Magnitude and dip of the field in each fresh attitude under the record",
            message=f"{int(far.sum())} of {len(number)} attitudes {'lies' if far.sum() == 1 else 'lie'} beyond what "
            "one in twenty does by chance.",
            caption="|m| and dip less what all attitudes have in common, which is of the place. Bars: twice the "
            "standard uncertainty, from the record and the scatter of its attitudes.",
            traces=traces,
            layout={
                "xaxis": axis("attitude", dtick=max(1, round(len(number) / 20)), range=[0.4, len(number) + 0.6]),
                "yaxis": axis("dip, deg", domain=[0, 0.46], zeroline=True),
                "yaxis2": axis("|m|, %", domain=[0.54, 1], zeroline=True),
                "showlegend": False,
            },
            height=460,
        )
    ]


def _table(check: Check, attitudes: Attitudes) -> ReportTable:
    rows = []
    beyond = _beyond(check)
    for i, value in enumerate(check.residuals.tolist()):
        u, ratio = "not stated", "–"
        if check.standard_uncertainty is not None:
            own = float(check.standard_uncertainty[i])
            u, ratio = small_g(own), f"{value / own:+.1f}"
        rows.append([attitudes.label(i), small_g(value), u, ratio, "beyond" if beyond[i] else ""])
    return ReportTable(
        "Attitudes",
        "Residual |f| − g under the record, its standard uncertainty u, and their ratio. The test weighs all attitudes "
        f"together, with what their errors share; it fails where p is below {100 * check.false_alarm:g} %.",
        ["attitude", "|f| − g", "u", "(|f| − g) / u", "remark"],
        rows,
    )

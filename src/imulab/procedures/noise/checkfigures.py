"""What a check of a noise record by a log shows: the verdict, what changed, and the octaves of both spectra."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from imulab._version import VERSION
from imulab.records.calibration import Calibration
from imulab.report import panels, render_page
from imulab.report.elements import BAD, GOOD, Exhibits, Figure, ReportTable
from imulab.report.traces import rounded, scatter
from imulab.verdict import Bad, Note, verdict_of

if TYPE_CHECKING:
    from imulab.procedures.noise.check import NoiseCheck

_DIGITS = 5
_TICKS = [0.01, 0.1, 0.2, 0.5, 1, 2, 5, 10, 100]


def meaning(check: NoiseCheck) -> str:
    """Return what the test says, in words."""
    if check.passed:
        return "the log agrees with the noise of the record"
    worst = min(check.columns.values(), key=lambda each: each.probability)
    return f"the noise is not that of the record; most in {worst.name}: {worst.text()}"


def p_text(probability: float) -> str:
    """Return a probability for a sentence."""
    return f"p = {probability:.2g}" if probability >= 1e-12 else "p below 1e-12"


def _number_of(probability: float) -> str:
    return p_text(probability).removeprefix("p ").removeprefix("= ")


def exhibits_of_check(check: NoiseCheck) -> Exhibits:
    """Return what the report shows."""
    rows = [
        [
            name,
            "differs" if check.differs(name) else "agrees",
            p_text(each.probability).removeprefix("p ").removeprefix("= "),
            each.text(),
        ]
        for name, each in check.columns.items()
    ]
    table = ReportTable(
        "Columns",
        "p: of so large a difference in this column, if nothing changed. Then the terms of the record's model in the "
        "log against the record, with 95 % intervals, the most certain change first.",
        ["column", "result", "p", "the log against the record"],
        rows,
        None if check.passed else min(range(len(rows)), key=lambda k: list(check.columns.values())[k].probability),
    )
    pages = panels.pages(list(check.columns))
    return Exhibits(
        f"{'Pass' if check.passed else 'Fail'}: {meaning(check)}; {p_text(check.probability)}.",
        [
            ("p, if nothing changed", _number_of(check.probability)),
            ("false alarms", f"{100 * check.false_alarm:.3g} %"),
            ("not held against it", f"{100 * check.tolerance:.3g} %"),
        ],
        [table, *(_octaves(check, page, k, len(pages)) for k, page in enumerate(pages))],
    )


def _octaves(check: NoiseCheck, names: Sequence[str], page: int, pages: int) -> Figure:
    layout = panels.grid()
    traces: list[dict[str, Any]] = []
    outside = count = 0
    for index, name in enumerate(names):
        octaves = check.columns[name].agreement.octaves
        x, y = panels.names(index)
        ratio = np.sqrt(octaves.ratio)
        low, high = (np.sqrt(end) for end in octaves.interval)
        off = (low > 1) | (high < 1)
        outside, count = outside + int(off.sum()), count + len(off)
        for part, colour in ((~off, GOOD), (off, BAD)):
            error = {"type": "data", "array": rounded((high - ratio)[part], _DIGITS), "color": colour, "width": 0,
                     "arrayminus": rounded((ratio - low)[part], _DIGITS)}  # fmt: skip
            f = np.sqrt(octaves.low * octaves.high)[part]
            traces.append(
                scatter(rounded(f, _DIGITS), rounded(ratio[part], _DIGITS), "markers", xaxis=x, yaxis=y, error_y=error,
                        marker={"color": colour, "size": 6}, hovertemplate="%{x:.3g} Hz: %{y:.3g}<extra></extra>")
            )  # fmt: skip
        panels.panel(layout, index, len(names), name)
        title = {"text": "frequency, Hz", "font": {"size": 11}, "standoff": 4}
        layout[panels.axis_key(x)] |= {"type": "log", "dtick": 1, "title": title}
        reach = float(np.log10(max(2.0, 1.1 * ratio.max(initial=1.0), 1.1 / ratio.min(initial=1.0))))
        layout[panels.axis_key(y)] |= {"type": "log", "range": [-reach, reach], "tickvals": _TICKS}
    return Figure(
        title=panels.paged("Size of the noise in the log over that in the record, by octaves", page, pages),
        message=f"{outside} of {count} octaves are off 1 beyond their 95 % interval; one in twenty is by chance.",
        caption="Root of the ratio of mean squares, with its 95 % interval; 1 where nothing changed, whatever the "
        "model. Slow noise, on the left, is of few coefficients.",
        traces=traces,
        layout=layout,
        height=panels.height(len(names)),
    )


def check_page(check: NoiseCheck, held: Calibration, *, record: str, files: Sequence[str]) -> str:
    """Return the report."""
    failed = [] if check.passed else [Bad(meaning(check))]
    return render_page(
        f"Noise check: {'pass' if check.passed else 'fail'}",
        held.sensor.get("serial", "unit without serial number"),
        exhibits_of_check(check),
        verdict=verdict_of([*failed, *check.notes]),
        notes=[note for note in check.notes if isinstance(note, Note)],
        provenance=[
            ("record", f"{record}, created {held.created}"),
            *(("log", file) for file in files),
            ("software", f"imulab {VERSION}"),
        ],
    )


def as_text(check: NoiseCheck, record: str, files: Sequence[str], verdict: str) -> str:
    """Return the verdict with its p, what to do next, and what is said of every column."""
    lines = [f"{verdict}: {meaning(check)}"]
    if not check.passed:
        lines.append(
            f"'imulab noise fit {' '.join(files)} -o NEW.json' makes a record that follows the change, "
            f"'imulab show {record} NEW.json' compares the two"
        )
    many = len(check.columns)
    lines.append(f"{p_text(check.probability)} over {many} column{'s' if many > 1 else ''}")
    lines += [f"{name}: {p_text(each.probability)}; {each.text()}" for name, each in check.columns.items()]
    return "\n".join(lines)


def as_json(check: NoiseCheck) -> dict[str, Any]:
    """Return the same for scripts."""
    return {
        "verdict": "pass" if check.passed else "fail",
        "p": check.probability,
        "false_alarm": check.false_alarm,
        "tolerance": check.tolerance,
        "columns": {
            name: {
                "p": each.probability,
                "p_terms": each.agreement.terms_probability,
                "p_octaves": float(each.agreement.octaves.probability),
                "changes": {
                    change.term: {"ratio": change.ratio, "interval_95": [change.low, change.high]}
                    for change in each.changes
                },
                "octaves": [
                    {"from": float(low), "to": float(high), "unit": "Hz", "ratio": float(np.sqrt(ratio))}
                    for low, high, ratio in zip(
                        each.agreement.octaves.low,
                        each.agreement.octaves.high,
                        each.agreement.octaves.ratio,
                        strict=True,
                    )
                ],
            }
            for name, each in check.columns.items()
        },
        "notes": [str(note) for note in check.notes],
    }

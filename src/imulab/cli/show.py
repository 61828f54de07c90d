"""Records and recordings in a few lines of plain text."""

from __future__ import annotations

import numpy as np

from imulab.blob import Blob
from imulab.calibration import Calibration
from imulab.exhibit import Table
from imulab.present import exhibits_of
from imulab.recording import Recording
from imulab.tumble.compare import Comparison
from imulab.tumble.engineering import change_rows

_GAP = 1.5


def describe_record(record: Calibration, *, provenance: bool = True) -> str:
    """Return what a record holds: its headline, its tables, and where it comes from."""
    exhibits = exhibits_of(record)
    serial = record.sensor.get("serial", "unit without serial number")
    lines = [f"{record.procedure} calibration of {serial}", exhibits.headline, ""]
    for item in exhibits.items:
        if isinstance(item, Table):
            mark = [["*" if i == item.highlight else "", *row] for i, row in enumerate(item.rows)]
            chosen = " (* chosen)" if item.highlight is not None else ""
            lines += [f"{item.title}{chosen}", *aligned(["", *item.columns], mark), ""]
    if provenance:
        lines += [f"created {record.created} by {record.software}"]
        lines += [f"source {source.file} SHA-256 {source.sha256}" for source in record.sources]
        lines += [f"warning: {message}" for message in record.warnings]
    return "\n".join(lines).rstrip()


def describe_blob(blob: Blob) -> str:
    """Return what a blob holds: its unit, its size, and the columns and units of each section."""
    serial = blob.text["sensor"].get("serial", "a unit without serial number")
    lines = [f"blob of {serial}: {len(blob.data)} bytes, float numbers, written by {blob.text['software']}"]
    for section in blob.text["sections"]:
        about = ", ".join(f"{key} {_joined(value)}" for key, value in section.items() if key != "kind")
        lines.append(f"  {section['kind']}: {about}")
    lines += [f"record SHA-256 {digest}" for digest in blob.text["records"]]
    return "\n".join(lines)


def _joined(value: object) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)


def describe_changes(first: str, second: str, comparison: Comparison, output: str) -> str:
    """Return what changed from one record to the other."""
    rows = change_rows(comparison, output)
    changed = [row[0] for row in rows if row[-1]]
    verdict = (
        f"{len(changed)} of {len(rows)} parameters changed: {' '.join(changed)}" if changed else "no significant change"
    )
    titles = ["parameter", "change", "u", "change / u", "unit", ""]
    lines = [f"{second} less {first}: {verdict}", "", *aligned(titles, rows)]
    if comparison.probability is not None:
        lines += ["", f"all together: probability {comparison.probability:.2g} if nothing had changed"]
    return "\n".join(lines)


def describe_recording(recording: Recording) -> str:
    """Return what a recording holds: samples, rate, gaps, duration, and each column's range."""
    lines = [f"{recording.name}: {len(recording)} samples"]
    time = recording.time
    if time is None:
        lines.append("no time column: a table of attitudes, a row each")
    elif len(time) > 1 and np.isfinite(time).all():
        step = np.diff(time)
        usual = float(np.median(step))
        gaps = int(np.count_nonzero(step > _GAP * usual)) if usual > 0 else 0
        rate = f"{1 / usual:.6g} Hz" if usual > 0 else "unknown, time does not rise"
        lines.append(f"duration {time[-1] - time[0]:.6g} s, rate {rate}, gaps {gaps}")
    lines += [f"{key}: {value}" for key, value in recording.metadata.items()]
    rows = []
    for name, values in recording.columns.items():
        finite = values[np.isfinite(values)]
        shown = [f"{x:.6g}" for x in (finite.min(), finite.mean(), finite.max())] if finite.size else ["–"] * 3
        rows.append([name, recording.units[name], *shown, str(len(values) - finite.size)])
    lines += ["", *aligned(["column", "unit", "min", "mean", "max", "missing"], rows)]
    lines += [f"note: {note}" for note in recording.notes]
    return "\n".join(lines)


def aligned(titles: list[str], rows: list[list[str]]) -> list[str]:
    """Return a table as lines of text; texts to the left, numbers to the right."""
    table = [titles, *rows]
    widths = [max(len(row[i]) for row in table) for i in range(len(titles))]
    numeric = [all(_numeric(row[i]) for row in rows) for i in range(len(titles))]
    return [
        "  ".join(
            cell.rjust(width) if right else cell.ljust(width)
            for cell, width, right in zip(row, widths, numeric, strict=True)
        ).rstrip()
        for row in table
    ]


def _numeric(text: str) -> bool:
    return text in ("–", "not stated") or text.lstrip("+-")[:1].isdigit()

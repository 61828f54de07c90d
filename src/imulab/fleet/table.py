"""The table of a fleet: one row per unit with every parameter, its uncertainty, and verdict and warnings."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from imulab.errors import OptionError
from imulab.files import real_path, replacing
from imulab.fleet.engine import Summary
from imulab.fleet.manifest import FleetUnit
from imulab.writers import check_writable

HEAD = (
    "serial", "procedure", "status", "verdict", "reason", "warnings", "date", "created", "software", "files",
    "content_sha256",
)  # fmt: skip


@dataclass(frozen=True)
class FleetRow:
    """One unit: ``done``, ``failed`` or ``missing``, with its reason or the summary of its record."""

    unit: FleetUnit
    status: str
    reason: str
    summary: Summary | None

    @property
    def verdict(self) -> str:
        """``good``, ``look`` or ``bad``, as in its record; empty without one."""
        return "" if self.summary is None else self.summary.verdict.state

    @property
    def first_reason(self) -> str:
        """The gravest reason of a verdict that is not good, and how many more there are."""
        reasons = () if self.summary is None else self.summary.verdict.reasons
        more = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
        return reasons[0] + more if reasons else ""


def columns_of(rows: Sequence[FleetRow]) -> dict[str, list[Any]]:
    """Return the table by columns: head, then ``name [unit]`` and ``std_name [unit]`` of every parameter.

    ``reason`` is why a unit failed, or why its verdict is not good; ``warnings`` all that its record says.
    """
    columns: dict[str, list[Any]] = {name: [] for name in HEAD}
    for number, row in enumerate(rows):
        summary = row.summary
        head = (
            row.unit.serial,
            row.unit.procedure,
            row.status,
            row.verdict,
            row.reason if summary is None else " | ".join(summary.verdict.reasons),
            "" if summary is None else " | ".join(summary.warnings),
            "" if summary is None else summary.date or "",
            "" if summary is None else summary.created,
            "" if summary is None else summary.software,
            ";".join(row.unit.files),
            "" if summary is None else summary.content_sha256,
        )
        for name, value in zip(HEAD, head, strict=True):
            columns[name].append(value)
        if summary is not None and summary.on_line is not None:
            title = "{} [{}]".format(*summary.on_line.about)
            columns.setdefault(title, [None] * len(rows))[number] = summary.on_line.means[0]
        for name, parameter in {} if summary is None else summary.parameters.items():
            for title, number_found in (
                (f"{name} [{parameter.unit}]", parameter.value),
                (f"std_{name} [{parameter.unit}]", parameter.standard_uncertainty),
            ):
                columns.setdefault(title, [None] * len(rows))[number] = number_found
    return columns


def check_table(path: str) -> None:
    """Refuse a name that a table cannot have, before the work.

    Raises
    ------
    OptionError
        It ends neither in .csv nor in .parquet, the library for Parquet is not here, or there is no such folder.
    """
    check_writable(path)
    if not real_path(path).parent.is_dir():
        raise OptionError(f"{path}: cannot be written: no such folder")


def write_table(rows: Sequence[FleetRow], path: str | Path) -> None:
    """Write the table, CSV or Parquet by the ending of the name, whole or not at all; numbers read back exactly."""
    columns = columns_of(rows)
    if Path(path).suffix.lower() == ".parquet":
        import pyarrow
        from pyarrow import parquet

        kinds = [pyarrow.string() if name in HEAD else pyarrow.float64() for name in columns]
        arrays = [pyarrow.array(values, kind) for values, kind in zip(columns.values(), kinds, strict=True)]
        with replacing(path) as stream:
            parquet.write_table(pyarrow.table(arrays, names=list(columns)), stream)
        return
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for cells in zip(*columns.values(), strict=True):
        writer.writerow(["" if cell is None else repr(cell) if isinstance(cell, float) else cell for cell in cells])
    with replacing(path) as stream:
        stream.write(text.getvalue().encode("utf-8"))

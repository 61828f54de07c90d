"""What a procedure shows of a record: its report, and the comparison of two records of a unit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from imulab import report
from imulab.atomic_write import write_page
from imulab.procedures.inputs import Record, as_record
from imulab.procedures.procedure import Row
from imulab.procedures.registry import joined_of, procedure_of
from imulab.records.calibration import Calibration
from imulab.records.comparison import Change
from imulab.report.elements import Exhibits


def exhibits_of(record: Calibration) -> Exhibits:
    """Return the figures and tables of a record.

    Raises
    ------
    RecordError
        Its procedure is not known, or it lacks the data that they need.
    """
    exhibits = procedure_of(record).exhibits(record)
    for procedure in joined_of(record):
        more = procedure.joined(record)
        exhibits = replace(
            exhibits,
            headline=f"{exhibits.headline} {more.headline}",
            facts=[*exhibits.facts, *more.facts],
            items=[*exhibits.items, *more.items],
        )
    return exhibits


def change_unit(change: Change, record: Calibration) -> tuple[float, str]:
    """Return the factor from SI and the unit in which people read the change of a parameter."""
    return procedure_of(record).change_unit(change, record)


def parameter_rows(record: Calibration) -> Sequence[Row]:
    """Return the parameters of a record in the units in which people read them."""
    return procedure_of(record).rows(record)


def rendered(record: Calibration) -> str:
    """Return the report of a record as HTML text; errors as for `exhibits_of`."""
    return report.render(record, exhibits_of(record), procedure_of(record).title)


def write_report(record: Record, path: str | Path) -> None:
    """Write the report of a record as one HTML file that opens without a network.

    Parameters
    ----------
    record
        A record, or its file.
    path
        HTML file to write.

    Raises
    ------
    RecordError
        The record cannot be read, or lacks the data that its figures need.
    OptionError
        The file cannot be written there, or what is given is no record.

    Examples
    --------
    >>> import imulab as il
    >>> fit = il.fit_tumble(il.simulate_tumble(gravity=9.81), order=1, gravity=9.81)
    >>> il.write_report(fit.calibration, "sn42.html")
    """
    write_page(path, rendered(as_record(record, "write_report")))

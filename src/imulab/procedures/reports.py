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
from imulab.units import STANDARD_GRAVITY, from_si

_READ = {
    "rad/s": (from_si(1.0, "deg/h"), "deg/h"),
    "m/s^2": (from_si(1.0, "ug"), "µg"),
    "rad": (1e3, "mrad"),
    "rad/s/(m/s^2)": (from_si(STANDARD_GRAVITY, "deg/h"), "deg/h/g"),
}


def exhibits_of(record: Calibration) -> Exhibits:
    """Return the figures and tables of a record.

    Raises
    ------
    RecordError
        Its procedure is not known, or it lacks the data that they need.
    """
    exhibits: Exhibits = procedure_of(record).exhibits(record)
    for entry in joined_of(record):
        assert entry.joined is not None
        more = entry.joined(record)
        exhibits = replace(
            exhibits,
            headline=f"{exhibits.headline} {more.headline}",
            facts=[*exhibits.facts, *more.facts],
            items=[*exhibits.items, *more.items],
        )
    return exhibits


def change_unit(change: Change, record: Calibration) -> tuple[float, str]:
    """Return the factor from SI and the unit in which people read the change of a parameter."""
    own = procedure_of(record).change_unit
    return _READ.get(change.unit, (1.0, change.unit)) if own is None else own(change, record)


def parameter_rows(record: Calibration) -> Sequence[Row]:
    """Return the parameters of a record in the units in which people read them."""
    own = procedure_of(record).rows
    if own is not None:
        rows: Sequence[Row] = own(record)
        return rows
    found = []
    for name, p in record.parameters.items():
        factor, unit = _READ.get(p.unit, (1.0, p.unit))
        u = p.standard_uncertainty
        found.append(Row(name, p.value * factor, None if u is None else u * factor, unit))
    return found


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

"""Records to reports: picks the procedure's exhibits and hands them to the layout; units in which changes are read."""

from __future__ import annotations

from pathlib import Path

from imulab import report
from imulab.errors import RecordError
from imulab.procedures.centrifuge import figures as centrifuge
from imulab.procedures.gyro_array import figures as gyro_array
from imulab.procedures.tumble import engineering
from imulab.procedures.tumble import figures as tumble
from imulab.procedures.warmup import figures as warmup
from imulab.records.calibration import Calibration
from imulab.records.comparison import Change
from imulab.report.elements import Exhibits
from imulab.units import STANDARD_GRAVITY, from_si

_EXHIBITS = {
    "tumble": tumble.exhibits,
    "gyro_array": gyro_array.exhibits,
    "warmup": warmup.exhibits,
    "centrifuge": centrifuge.exhibits,
}


def exhibits_of(record: Calibration) -> Exhibits:
    """Return the figures and tables of a record.

    Raises
    ------
    RecordError
        There are none for its procedure, or the record lacks the data that they need.
    """
    if record.procedure not in _EXHIBITS:
        raise RecordError(f"no report for a {record.procedure} record; known procedures: {' '.join(_EXHIBITS)}")
    try:
        return _EXHIBITS[record.procedure](record)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise RecordError(f"the record lacks data that its report needs ({error!r})") from None


_READ = {
    "rad/s": (from_si(1.0, "deg/h"), "deg/h"),
    "m/s^2": (from_si(1.0, "ug"), "µg"),
    "rad": (1e3, "mrad"),
    "rad/s/(m/s^2)": (from_si(STANDARD_GRAVITY, "deg/h"), "deg/h/g"),
}


def change_unit(change: Change, record: Calibration) -> tuple[float, str]:
    """Return the factor from SI and the unit in which people read the change of a parameter."""
    if record.procedure == "tumble":
        return engineering.change_unit(change, record)
    return _READ.get(change.unit, (1.0, change.unit))


def write_report(record: Calibration, path: str | Path) -> None:
    """Write the report of a record as one HTML file that opens without a network.

    Raises
    ------
    RecordError
        The record lacks the data that its figures need.
    OptionError
        The file cannot be written there.
    """
    report.write(record, exhibits_of(record), path)

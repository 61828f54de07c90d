"""A magnetometer alone as the registry knows it: its fit from files, and what its record gives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from imulab.errors import RecordError
from imulab.options import part_of, read_options
from imulab.procedures.procedure import Files, MagnetometerSection, Procedure, Task
from imulab.quantities import labelled

if TYPE_CHECKING:
    from imulab.device.tables import DeviceTable, Fusion
    from imulab.procedures.magnetometer.fit import MagnetometerFit
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration
    from imulab.records.triads import Magnetometers
    from imulab.report.traces import Exhibits


def _function() -> Callable[..., MagnetometerFit]:
    from imulab.procedures.magnetometer.fit import fit_magnetometer

    return fit_magnetometer


def _values(texts: Mapping[str, str], label: str) -> dict[str, Any]:
    values = read_options(TASK.options, texts, label)
    return {**values, "part": part_of(values), "label": label}


def _fit(
    files: Sequence[str], values: Mapping[str, Any], access: Files, progress: Callable[[int], None]
) -> Calibration:
    from imulab.procedures.magnetometer.fit import fit_magnetometer

    recording = access.recording(files[0], values["layout"], **values["part"])
    with labelled(values["label"], ("field", "place", "date")):
        return fit_magnetometer(
            recording, field=values["field"], place=values["place"], date=values["date"]
        ).calibration


TASK = Task(
    files="one recording or table of readings",
    count=(1, 1),
    function=_function,
    values=_values,
    fit=_fit,
)


class MagnetometerProcedure(Procedure):
    """A magnetometer triad alone, waved or turned level."""

    name = "magnetometer"
    command = "magnetometer"
    title = "Magnetometer alone"
    line_title = "Magnetometer"
    elsewhere = "{target} wants accelerometers too, and this record holds magnetometers alone"
    has_heading = True
    task = TASK
    sections = (MagnetometerSection(),)

    def check(self, record: Calibration) -> None:
        from imulab.procedures.magnetometer.schema import check

        check(record)

    def exhibits(self, record: Calibration) -> Exhibits:
        from imulab.procedures.magnetometer.figures import exhibits

        return exhibits(record)

    def tables(self, record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
        from imulab.procedures.magnetometer.device import tables_of

        return tables_of(record)

    def heading(self, record: Calibration, *, true: bool = False) -> Callable[[Recording], Recording]:
        raise RecordError(
            "the record is of magnetometers alone, and does not tell how they are turned against the accelerometers; "
            "headings need a record of tumble mag with accelerometers"
        )

    def magnetometers(self, record: Calibration) -> Magnetometers:
        from imulab.procedures.magnetometer.device import magnetometers_of

        return magnetometers_of(record)

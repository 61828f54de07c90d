"""The rate test as the registry knows it: its fit from files, and what its record gives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from imulab.errors import OptionError
from imulab.gravity import checked_latitude
from imulab.options import part_of, read_options
from imulab.procedures.procedure import Files, GyroscopeSection, Procedure, Task, source_of

if TYPE_CHECKING:
    from imulab.device.tables import DeviceTable, Fusion
    from imulab.procedures.rate.fit import RateFit
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration
    from imulab.report.parameters import Row
    from imulab.report.traces import Exhibits


def _function() -> Callable[..., RateFit]:
    from imulab.procedures.rate.fit import fit_rate

    return fit_rate


def _values(texts: Mapping[str, str], label: str) -> dict[str, Any]:
    return read_options(TASK.options, texts, label)


def _fit(
    files: Sequence[str], values: Mapping[str, Any], access: Files, progress: Callable[[int], None]
) -> Calibration:
    from imulab.procedures.rate.fit import fit_rate, fit_test
    from imulab.procedures.rate.schema import load_test, refuse_folder
    from imulab.readers.streams import one_clock

    (name,) = files
    part = part_of(values)
    accel, prior = (None if values[key] is None else access.record(values[key]) for key in ("accel", "prior"))
    if not name.lower().endswith(".toml"):
        refuse_folder(access.path(name), name)
        recording = access.recording(name, values["layout"], **part)
        chosen = {key: values[key] for key in ("rates", "axis", "order", "latitude", "table_uncertainty")}
        return fit_rate(recording, accel=accel, prior=prior, **chosen).calibration
    if values["rates"] is not None or values["axis"] != "+z":
        raise OptionError(
            f"{name}: a manifest says the rates and axes of its runs; expected neither --rates nor --axis"
        )
    test = load_test(access.path(name), name)
    if values["latitude"] is not None:
        test = replace(test, latitude=checked_latitude(values["latitude"]))
    if values["table_uncertainty"] is not None:
        test = replace(test, relative_uncertainty=values["table_uncertainty"])
    recordings = [
        one_clock(access.recording(access.beside(name, run.file), values["layout"], **part), "gyro")
        for run in test.runs
    ]
    record = fit_test(test, recordings, str(values["order"]), accel, prior).calibration
    manifest = source_of(access, name)
    return record if manifest is None else replace(record, sources=(manifest, *record.sources))


TASK = Task(
    files="the manifest of one test, or one recording",
    count=(1, 1),
    function=_function,
    values=_values,
    fit=_fit,
)


class RateProcedure(Procedure):
    """The test of gyroscopes at known rates or by whole turns."""

    name = "rate"
    command = "rate"
    title = "Gyroscopes at known rates"
    line_title = "Rate"
    elsewhere = "{target} wants accelerometers too, and a rate record holds gyroscopes alone"
    joins = True
    task = TASK
    sections = (GyroscopeSection(),)

    def check(self, record: Calibration) -> None:
        from imulab.procedures.rate.schema import check

        check(record)

    def exhibits(self, record: Calibration) -> Exhibits:
        from imulab.procedures.rate.figures import exhibits

        return exhibits(record)

    def joined(self, record: Calibration) -> Exhibits:
        from imulab.procedures.rate.figures import exhibit_gyroscopes

        return exhibit_gyroscopes(record)

    def rows(self, record: Calibration) -> Sequence[Row]:
        from imulab.procedures.rate.figures import rows

        return rows(record)

    def tables(self, record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
        from imulab.procedures.rate.device import tables_of

        return tables_of(record)

    def beyond(self, record: Calibration, recording: Recording) -> tuple[int, float]:
        from imulab.device.tables import beyond_rates

        return beyond_rates(record, recording)

    def beyond_message(self, record: Calibration, count: int, largest: float) -> str:
        from imulab.device.tables import beyond_message

        return beyond_message(record, count, largest)

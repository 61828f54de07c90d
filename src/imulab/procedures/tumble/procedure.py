"""The tumble test in the registry: its options, its fit from files, and what its record gives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from imulab.errors import DataError, RecordError
from imulab.options import part_of, read_options
from imulab.procedures.procedure import Files, GyroscopeSection, MagnetometerSection, Procedure, Section, Task
from imulab.quantities import labelled

if TYPE_CHECKING:
    import numpy as np

    from imulab.device.tables import DeviceTable, Fusion
    from imulab.device.unit import DeviceUnit
    from imulab.procedures.tumble.attitudes import Attitudes
    from imulab.procedures.tumble.fit import TumbleFit
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration
    from imulab.records.triads import LinearFit, Triads
    from imulab.report.parameters import Row
    from imulab.report.traces import Exhibits


# An accelerometer triad from one recording or table of attitudes.


_NAMED = (
    "order", "method", "loss", "threshold", "preset", "ageing", "nonlinearity", "asymmetry", "cross", "monte-carlo",
    "with_", "field", "hemisphere", "latitude", "dip",
)  # fmt: skip


def _fit(
    files: Sequence[str], values: Mapping[str, Any], access: Files, progress: Callable[[int], None]
) -> Calibration:
    from imulab.procedures.tumble.attitudes import find_attitudes
    from imulab.procedures.tumble.fit import fit_tumble

    recording = access.recording(files[0], values["layout"], **values["part"])
    attitudes = find_attitudes(recording)
    prior = None if values["prior"] is None else _prior(values["prior"], attitudes, access)
    return fit_tumble(
        attitudes,
        order=values["order"],
        gravity=values["gravity"],
        method=values["method"],
        loss=values["loss"],
        nonlinearity=values["nonlinearity"],
        asymmetry=values["asymmetry"],
        prior=prior,
        ageing=values["ageing"],
        monte_carlo=values["monte_carlo"],
        cross=values["cross"],
        threshold=values["threshold"],
        preset=values["preset"],
        with_=values["with"],
        field=values["field"],
        hemisphere=values["hemisphere"],
        dip=values["dip"],
        latitude=values["earth"],
        progress=progress,
    ).calibration


def _prior(file: str, attitudes: Attitudes, access: Files) -> Calibration:
    """Read a record that can be a prior for these attitudes."""
    from imulab.procedures.tumble.checks import check_prior, made_from
    from imulab.procedures.tumble.fit import prior_record
    from imulab.procedures.tumble.schema import model_of

    record, recording = access.record(file), attitudes.recording
    try:
        record = prior_record(record, attitudes)
        check_prior(record)
    except RecordError as error:
        raise RecordError(f"{file}: {error}") from None
    unit, needed = recording.triad_unit("accel"), model_of(record).output_unit
    if unit != needed:
        raise RecordError(f"{file}: the prior has outputs in {needed}, {recording.name} in {unit}")
    if made_from(record, recording):
        raise DataError(f"{recording.name}: the prior {file} was made from this recording, which would count twice")
    return record


def _function() -> Callable[..., TumbleFit]:
    from imulab.procedures.tumble.fit import fit_tumble

    return fit_tumble


def _values(texts: Mapping[str, str], label: str) -> dict[str, Any]:
    from imulab.gravity import at_latitude, gravity_option, of_place
    from imulab.procedures.tumble.estimate import check_options

    values = read_options(TASK.options, texts, label)
    values["ageing"], values["with"] = values["ageing"] or (), values["with"] or ()
    place = values["place"]
    latitude, height = of_place(place, values["gravity"], values["latitude"], values["height"], label)
    with labelled(label, _NAMED):
        check_options(
            values["order"], values["method"], values["loss"],
            monte_carlo=values["monte_carlo"], with_prior=values["prior"] is not None, ageing=values["ageing"],
            nonlinearity=values["nonlinearity"], asymmetry=values["asymmetry"], cross=values["cross"],
            threshold=values["threshold"], preset=values["preset"], further=values["with"], field=values["field"],
            hemisphere=values["hemisphere"], dip=values["dip"],
        )  # fmt: skip
        if "mag" in values["with"]:
            from imulab.procedures.tumble.mag.solve import parse_place

            values["hemisphere"] = parse_place(values["hemisphere"], latitude, values["dip"]).hemisphere
    earth = at_latitude(latitude, label.format("latitude")) if "gyro" in values["with"] else None
    values["earth"] = None if earth is None else earth.latitude
    beside = earth is not None or place is not None
    values["gravity"] = gravity_option(values["gravity"], latitude, height, label, beside=beside)
    return {**values, "part": part_of(values)}


TASK = Task(
    files="one recording or table of attitudes",
    count=(1, 1),
    function=_function,
    values=_values,
    fit=_fit,
)


# The tumble test as the registry knows it.


class AccelerometerSection(Section):
    """Bias, scale factor, misalignment and nonlinearity of accelerometers."""

    kind = "tumble"
    triad = "accel"

    def golden(self, table: DeviceTable, random: np.random.Generator) -> dict[str, Any]:
        from imulab.procedures.tumble.device import golden_accelerometers

        return golden_accelerometers(table, random)

    def apply(self, unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
        from imulab.procedures.tumble.device import apply_tumble

        return apply_tumble(unit, columns, recording)


class TumbleProcedure(Procedure):
    """The tumble test of an accelerometer triad, with gyroscopes and magnetometers on the same attitudes."""

    name = "tumble"
    command = "tumble"
    title = "Tumble calibration"
    line_title = "Tumble"
    states_triads = True
    has_heading = True
    task = TASK
    sections = (AccelerometerSection(), GyroscopeSection(), MagnetometerSection())

    def check(self, record: Calibration) -> None:
        from imulab.procedures.tumble.schema import check

        check(record)

    def exhibits(self, record: Calibration) -> Exhibits:
        from imulab.procedures.tumble.figures import exhibits

        return exhibits(record)

    def rows(self, record: Calibration) -> Sequence[Row]:
        from imulab.procedures.tumble.record import rows

        return rows(record)

    def same_meaning(self, name: str, first: Calibration, second: Calibration) -> bool:
        from imulab.procedures.tumble.record import same_meaning

        return same_meaning(name, first, second)

    def tables(self, record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
        from imulab.procedures.tumble.device import tables_of

        return tables_of(record)

    def heading(self, record: Calibration, *, true: bool = False) -> Callable[[Recording], Recording]:
        from imulab.procedures.tumble.mag.heading import make_heading_function

        return make_heading_function(record, true=true)

    def beyond(self, record: Calibration, recording: Recording) -> tuple[int, float]:
        from imulab.procedures.tumble.device import beyond_test

        return beyond_test(record, recording)

    def beyond_message(self, record: Calibration, count: int, largest: float) -> str:
        from imulab.procedures.tumble.device import beyond_message

        return beyond_message(record, count, largest)

    def triads(self, record: Calibration) -> Triads:
        from imulab.procedures.tumble.device import triads_of

        return triads_of(record)

    def linear_fit(self, record: Calibration, *, misalignment: bool) -> LinearFit:
        from imulab.procedures.tumble.device import linear_fit

        return linear_fit(record, misalignment=misalignment)

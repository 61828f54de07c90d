"""What a report on a board of whole IMUs shows."""

from __future__ import annotations

import math

from imulab.procedures.gyro_array.imus.schema import Imu, ImusRecord, Three
from imulab.report.traces import Exhibits, Figure, ReportTable, format_uncertain, plain_number

_SOURCES = {
    "gravity": "gravity turned from rest to rest",
    "stated": "a stated distance",
    "gyro scale": "the nominal scale of the gyroscopes",
}


def exhibits(record: ImusRecord) -> Exhibits:
    """Return headline, facts, figures and tables of a board's record."""
    fit = record.fit
    largest = max(u or 0.0 for imu in record.imus for u in imu.position.standard_uncertainty)
    facts = [
        ("IMUs", f"{record.model.imus}"),
        ("rests", f"{fit.rests}"),
        ("in motion", f"{plain_number(fit.duration.value, 3)} s"),
        ("largest u(position)", f"{plain_number(1e3 * largest, 2)} mm"),
        ("size from", record.size_from),
        ("age of readings", f"{plain_number(1e3 * fit.age.value, 2)} ms"),
    ]
    return Exhibits(
        headline=f"{record.model.imus} IMUs: positions known to {plain_number(1e3 * largest, 2)} mm or better, the "
        f"size of the board from {_SOURCES[record.size_from]}",
        facts=facts,
        items=_items(record),
    )


def summary(record: ImusRecord) -> tuple[list[str], list[list[str]]]:
    """Return the table of the IMUs."""
    first = _imus_table(record)
    return first.columns, first.rows


def _items(record: ImusRecord) -> list[Figure | ReportTable]:
    return [_imus_table(record)]


def _cell(value: float, uncertainty: float | None, factor: float) -> str:
    text, u = format_uncertain(value * factor, None if uncertainty is None else uncertainty * factor)
    return f"{text} ± {u}" if uncertainty else text


def _three(values: Three, factor: float) -> list[str]:
    return [_cell(v, u, factor) for v, u in zip(values.value, values.standard_uncertainty, strict=True)]


def _imus_table(record: ImusRecord) -> ReportTable:
    def row(imu: Imu) -> list[str]:
        late = [_cell(each.value, each.standard_uncertainty, 1e3) for each in (imu.accel_latency, imu.gyro_latency)]
        return [imu.name, *_three(imu.position, 1e3), *_three(imu.rotation, math.degrees(1)), *late]

    titles = ["IMU", *(f"{axis} mm" for axis in "xyz"), *(f"rotation {axis} deg" for axis in "xyz")]
    return ReportTable(
        "Where each IMU sits, and how late it answers",
        "Positions of the sensing elements from IMU 1, rotation vectors from its frame, latencies against the "
        "gyroscopes of IMU 1; standard uncertainties.",
        [*titles, "accel latency ms", "gyro latency ms"],
        [row(imu) for imu in record.imus],
    )

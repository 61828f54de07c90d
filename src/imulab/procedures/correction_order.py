"""The order of corrections: no error is taken off twice, and a warm-up table comes after the thermal record.

Namely after that by which its cycles were corrected.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

from imulab.columns import KINDS
from imulab.errors import RecordError

SENSORS = {"thermal": "accel", "thermal_gyro": "gyro"}
"""The triad that each section of a thermal record corrects."""
_ENTRY = re.compile(r" \(thermal: ([a-z ]+)\) sha256:([0-9a-f]{64})$")
_LINEAR = "bias and scale factor"
_ERRORS = {
    "tumble": (_LINEAR, "accel"),
    "thermal": (_LINEAR, "accel"),
    "gyro": (_LINEAR, "gyro"),
    "thermal_gyro": (_LINEAR, "gyro"),
    "mag": ("hard and soft iron", "mag"),
    "centrifuge": ("drift under acceleration", "dtg"),
    "warmup": ("the change after power-on", ""),
}
"""What each kind of section takes off, and the sensor; the columns of a warm-up table name theirs."""


@dataclass(frozen=True)
class Thermal:
    """Laws over temperature that were applied: the SHA-256 of their record or blob, and the triad they correct."""

    hashes: Sequence[str]
    sensor: str


class Correction(str):
    """A line of `corrected_by` that knows what was taken off: the kind and columns of sections. A file does not."""

    __slots__ = ("sections",)
    sections: Sequence[tuple[str, Mapping[str, Any]]]

    def __new__(cls, line: str, sections: Sequence[tuple[str, Mapping[str, Any]]] = ()) -> Self:
        """Return a line with its sections."""
        correction = super().__new__(cls, line)
        correction.sections = sections
        return correction


def name_correction(name: str, digest: str, kinds: Iterable[str]) -> str:
    """Return the line of `corrected_by` for a record: ``thermal.json (thermal: accel) sha256:...``."""
    over = " ".join(SENSORS[kind] for kind in kinds if kind in SENSORS)
    return f"{name} (thermal: {over}) sha256:{digest}" if over else f"{name} sha256:{digest}"


def _list_errors(kind: str, columns: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return what a section takes off, once for each column."""
    error, sensor = _ERRORS.get(kind, ("", ""))
    axes = columns.get("axes", "xyz") if error else ()
    return [(error, f"{sensor}_{axis}" if sensor else str(axis)) for axis in axes]


def check_once(
    sections: Iterable[tuple[str, str, Mapping[str, Any]]], corrected_by: Iterable[str] = (), instead: str = ""
) -> None:
    """Refuse sections that take off an error a second time: name of their record, kind, and columns.

    `corrected_by` are the lines of a recording that was corrected before; `instead` is what else may be done.

    Raises
    ------
    RecordError
        Two of them take off the same error of one column.
    """
    earlier = [
        (line.rpartition(" sha256:")[0], *section)
        for line in corrected_by
        if isinstance(line, Correction)
        for section in line.sections
    ]
    new_sections = list(sections)
    triads: dict[str, set[str]] = {}  # of each record, by its hash where a blob tells it, else by its name
    for name, kind, columns in [*earlier, *new_sections]:
        triads.setdefault(columns.get("record", name), set()).add(_ERRORS.get(kind, ("", ""))[1])
    before = {error: (name, columns) for name, kind, columns in earlier for error in _list_errors(kind, columns)}
    for name, kind, columns in new_sections:
        errors = _list_errors(kind, columns)
        if twice := [error for error in errors if error in before]:
            first, sensor, expected = before[twice[0]], _ERRORS[kind][1], "one of them"
            for holder, held in (first, (name, columns)):
                if sensor in ("gyro", "mag") and "accel" in triads[held.get("record", holder)]:
                    expected = f"{holder} alone, or one fitted without {KINDS[sensor].sensors} (no --with {sensor})"
            names = " ".join(column for _, column in twice)
            raise RecordError(
                f"{first[0]} and {name} both take off {twice[0][0]} of {names}: expected {expected}{instead}"
            )
        before |= dict.fromkeys(errors, (name, columns))


def parse_thermals(corrected_by: Iterable[str]) -> list[Thermal]:
    """Return the laws over temperature in the lines of a recording's `corrected_by`."""
    matches = filter(None, map(_ENTRY.search, corrected_by))
    return [Thermal((match[2],), sensor) for match in matches for sensor in match[1].split()]


def check_order(kinds: Sequence[str]) -> None:
    """Refuse sections, by kind in the order of application, that would correct one error twice or out of turn.

    Raises
    ------
    RecordError
        A tumble is beside a thermal record, which contains it, or gyroscopes beside one that holds them; or a warm-up
        table comes before the thermal record.
    """
    if not SENSORS.keys() & set(kinds):
        return
    if "tumble" in kinds and "thermal" in kinds:
        raise RecordError(
            "a tumble and a thermal record together: both take off bias, scale factor and misalignment; expected the "
            "thermal record alone (thermal fit --prior takes the tumble's knowledge in)"
        )
    if "gyro" in kinds and "thermal_gyro" in kinds:
        raise RecordError(
            "a gyroscope record beside a thermal one that holds gyroscopes too: both take off their biases; expected "
            "the thermal record alone, or one fitted without --with gyro"
        )
    if "warmup" in kinds[: max(place for place, kind in enumerate(kinds) if kind in SENSORS)]:
        raise RecordError(
            "a warm-up record before a thermal one: expected the thermal record first, since the warm-up is what is "
            "left after the laws over temperature"
        )


def order_warnings(kinds: Sequence[str]) -> list[str]:
    """Return a warning where a warm-up table comes before the ordinary compensation, by kind in the order applied."""
    after = set(kinds[list(kinds).index("warmup") :]) if "warmup" in kinds else set()
    if not after & {"tumble", "gyro"}:
        return []
    return [
        "a warm-up record before that of the ordinary compensation: its source subtracts the table from corrected "
        "outputs; expected the warm-up record last, fitted to cycles that the other had corrected"
    ]


def check_after(
    sections: Iterable[tuple[str, Mapping[str, Any], Sequence[str]]], before: Iterable[Thermal] = ()
) -> None:
    """Refuse a warm-up table whose cycles were corrected by other laws over temperature than the recording.

    Sections are in the order of application: kind, columns, and the SHA-256 of their record or blob.

    Raises
    ------
    RecordError
        The table was fitted to cycles that no thermal record had corrected, or that another had.
    """
    applied = list(before)
    for kind, columns, hashes in sections:
        if kind in SENSORS:
            applied.append(Thermal(hashes, SENSORS[kind]))
        if kind != "warmup":
            continue
        sensors = {str(axis).partition("_")[0] for axis in columns["axes"]}
        earlier, after = [each for each in applied if each.sensor in sensors], columns.get("after")
        if after is None and earlier:
            raise RecordError(
                f"a warm-up record after a thermal one, both of columns {earlier[0].sensor}_*, whose cycles no thermal "
                "record had corrected: what follows the temperature would be taken off twice; expected a warm-up "
                "record of cycles that were corrected by the thermal one (imulab apply, then warmup fit)"
            )
        if after is not None and not any(after in each.hashes for each in earlier):
            raise RecordError(
                f"a warm-up record whose cycles were corrected by the thermal record sha256:{after[:12]}, "
                f"with {'another' if earlier else 'none'} before it: expected that one"
            )

"""A gyro array from a recording at rest and, if there is one, a recording in motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from imulab.errors import OptionError
from imulab.procedures.procedure import Files, Task
from imulab.quantities import chosen, interval, quantity

if TYPE_CHECKING:
    from imulab.device.array_settings import Fusion
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration


def _array_values(texts: Mapping[str, str], label: str) -> dict[str, Any]:
    name, between = label.format("interval"), texts.get("interval")
    if between is not None and texts.get("window"):
        raise OptionError(f"{name} together with {label.format('window')}: expected one of them, they say the same")
    return {
        "interval": None if between is None else interval(between, name),
        "averaging": quantity(texts.get("averaging", "1 s"), label.format("averaging"), "time", "s"),
        "layout": texts.get("layout"),
        "part": chosen(texts.get("topic"), texts.get("instance"), texts.get("window"), label=label),
        "fusion": _fusion(texts, label),
    }


def _fusion(texts: Mapping[str, str], label: str) -> Fusion | None:
    """Method and memory that the record is to carry; None where neither is given."""
    from imulab.procedures.gyro_array.memory import fusion_text

    if texts.get("method") is None and texts.get("memory") is None:
        return None
    return fusion_text(texts.get("method"), texts.get("memory"), label)


def _array_fit(
    files: Sequence[str], values: Mapping[str, Any], access: Files, progress: Callable[[int], None]
) -> Calibration:
    from imulab.procedures.gyro_array.fit import calibrate_array

    part = values["part"]
    still = _between(access.recording(files[0], values["layout"], **part), values["interval"])
    moving = access.recording(files[1], values["layout"], **{**part, "window": None}) if len(files) > 1 else None
    return calibrate_array(still, moving, averaging_time=values["averaging"], fusion=values["fusion"]).calibration


def _between(recording: Recording, ends: Sequence[float] | None) -> Recording:
    """Cut a recording to an interval of its time."""
    if ends is None:
        return recording
    import numpy as np

    shown = f"{ends[0]:g} to {ends[1]:g} s"
    if "time" not in recording:
        raise OptionError(f"{recording.name}: interval {shown} needs a column time")
    inside = np.flatnonzero((recording.si("time") >= ends[0]) & (recording.si("time") < ends[1]))
    if not inside.size:
        raise OptionError(f"{recording.name}: interval {shown}: no samples there")
    columns = {name: values[inside] for name, values in recording.columns.items()}
    return replace(recording, columns=columns, first_row=recording.first_row + int(inside[0]))


TASK = Task(
    files="STILL, or STILL;MOVING",
    count=(1, 2),
    options=("interval", "averaging", "method", "memory", "layout", "topic", "instance", "window"),
    paths=("layout",),
    modules=("imulab.readers", "imulab.procedures.gyro_array.fit", "scipy.special"),
    values=_array_values,
    fit=_array_fit,
)

"""A gyro array from a recording at rest and, if there is one, a recording in motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from imulab.device.methods import METHODS
from imulab.errors import OptionError
from imulab.procedures.options import READING, Option, file_option, measure, part_of, read_options, text_option
from imulab.procedures.procedure import Files, Task
from imulab.quantities import span

if TYPE_CHECKING:
    from imulab.records.calibration import Calibration


def _fit(
    files: Sequence[str], values: Mapping[str, Any], access: Files, progress: Callable[[int], None]
) -> Calibration:
    from imulab.procedures.gyro_array.fit import calibrate_array

    part = values["part"]
    still = access.recording(files[0], values["layout"], **{**part, "window": values["interval"] or part["window"]})
    moving = access.recording(files[1], values["layout"], **{**part, "window": None}) if len(files) > 1 else None
    noise = None if values["noise"] is None else access.record(values["noise"])
    return calibrate_array(
        still, moving, averaging_time=values["averaging"], fusion=values["fusion"], noise=noise
    ).calibration


METHOD = text_option(
    "method", "Method that fuse and export take from the record; robust if not given.", shows="METHOD", choices=METHODS
)
MEMORY = text_option(
    "memory",
    "Its memory: growing, growing:COUNT, or a gain between 0 and 1.",
    shows="growing|growing:N|GAIN",
    choices=("growing",),
)
OPTIONS = (
    Option("interval", "The same as window, by its older name.", span, shows="FROM:TO"),
    measure("averaging", "Averaging time of the covariance matrix, s.", "time", "s", "1 s", shows="TIME"),
    METHOD,
    MEMORY,
    file_option("noise", "Noise record of the same gyros, for the uncertainties of the biases.", "RECORD"),
    *READING,
)


def _values(texts: Mapping[str, str], label: str) -> dict[str, Any]:
    from imulab.procedures.gyro_array.memory import fusion_text

    values = read_options(OPTIONS, texts, label)
    if values["interval"] is not None and values["window"]:
        names = label.format("interval"), label.format("window")
        raise OptionError(f"{names[0]} together with {names[1]}: expected one of them, they say the same")
    by = (values["method"], values["memory"])
    fusion = None if by == (None, None) else fusion_text(*by, label)
    return {**values, "fusion": fusion, "part": part_of(values)}


TASK = Task(
    files="STILL, or STILL;MOVING",
    count=(1, 2),
    options=OPTIONS,
    values=_values,
    fit=_fit,
)

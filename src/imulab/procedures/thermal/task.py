"""The accelerometer triad of a unit over temperature, from recordings that are a power cycle each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from imulab.procedures.options import (
    ELEMENT,
    READING,
    Option,
    file_option,
    measure,
    part_of,
    read_options,
    text_option,
)
from imulab.procedures.procedure import Files, Task
from imulab.procedures.thermal.choices import degrees_text, further_of

if TYPE_CHECKING:
    from imulab.records.calibration import Calibration


def _fit(
    files: Sequence[str], values: Mapping[str, Any], access: Files, progress: Callable[[int], None]
) -> Calibration:
    from imulab.procedures.thermal.fit import fit_thermal

    recordings = [access.recording(name, values["layout"], **values["part"]) for name in files]
    prior = None if values["prior"] is None else access.record(values["prior"])
    return fit_thermal(recordings, prior=prior, **values["fit"]).calibration


GRAVITY = (
    text_option("gravity", "Local gravity, m/s^2, as 9.81362 or 9.81362+-0.00002; else of the head.", shows="G"),
    text_option("latitude", "Latitude, deg, for normal gravity; with gyro for the Earth's rate.", shows="DEG"),
    text_option("height", "Height above the ellipsoid, m.", shows="M"),
)
OPTIONS = (
    Option(
        "degrees",
        "Of the laws of bias, scale factor and misalignment, 3,2,1, or spline,2,1; auto: from there down, or a spline.",
        degrees_text,
        "auto",
        "auto|B,S,M",
    ),
    *GRAVITY,
    file_option("prior", "Tumble record of this unit at a known temperature: counts as one recording.", "RECORD"),
    Option("with", "Further triads of the recordings, in one record.", further_of, shows="gyro", choices=("gyro",)),
    measure("tilt", "How far a hold tips while it warms or cools, mrad.", "angle", "mrad", "0.2 mrad"),
    measure(
        "turn_on_scatter", "What biases move by from one power cycle to the next, mg, if known.", "acceleration", "mg",
        shows="SIZE",
    ),
    measure(
        "gyro_turn_on_scatter", "The same of the gyroscopes' biases, deg/s, if known.", "rate", "deg/s", shows="SIZE"
    ),
    measure("settle", "Left out at the start of a recording, s; 300 s where time is from power-on.", "time", "s",
            shows="TIME"),
    text_option("temperature_column", "Column of the unit's own thermometer, where there are several.", shows="NAME"),
    *READING,
    ELEMENT,
)  # fmt: skip
_OF_THE_FIT = ("degrees", "tilt", "turn_on_scatter", "gyro_turn_on_scatter", "settle", "temperature_column")


def _values(texts: Mapping[str, str], label: str) -> dict[str, Any]:
    from imulab.earth import at_latitude
    from imulab.gravity import gravity_option

    values = read_options(OPTIONS, texts, label)
    values["with"] = values["with"] or ()
    earth = at_latitude(values["latitude"], label.format("latitude")) if values["with"] else None
    gravity = gravity_option(values["gravity"], values["latitude"], values["height"], label, beside=earth is not None)
    fit = {name: values[name] for name in _OF_THE_FIT}
    fit |= {"gravity": gravity, "with_": values["with"], "latitude": None if earth is None else earth.latitude}
    return {**values, "fit": fit, "part": part_of(values)}


TASK = Task(
    files="the recordings of one unit at several temperatures",
    count=(1, None),
    options=OPTIONS,
    values=_values,
    fit=_fit,
)

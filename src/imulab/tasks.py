"""A procedure's fit, from files and the texts of its options to a record: what single commands and the fleet both run.

Going through one function is what makes a fleet's parameters equal the single command's to the last bit. A further
procedure is one entry of `TASKS` and one module-level pair of functions: texts to values, files and values to a record.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from imulab.errors import OptionError, ReadError
from imulab.recording import Source
from imulab.texts import chosen, quantity, whole_number

if TYPE_CHECKING:
    from imulab.calibration import Calibration
    from imulab.recording import Recording
    from imulab.tumble.record import Gravity

FLAG = "--{}"
"""How the command line calls an option in its messages."""


class Files(Protocol):
    """Where a fit gets what its files hold; `name` is what the command line or the manifest calls a file."""

    def recording(self, name: str, layout: str | None, **part: Any) -> Recording:
        """Return a recording as a whole; options as for `imulab.read`."""

    def record(self, name: str) -> Calibration:
        """Return a calibration record."""

    def blocks(self, name: str, layout: str | None) -> Iterator[Recording]:
        """Return a recording in blocks; options as for `imulab.read_blocks`."""

    def path(self, name: str) -> Path:
        """Return where a file lies on this machine."""

    def beside(self, name: str, file: str) -> str:
        """Return the name of a file that file `name` names relative to itself."""


def _silent(_: int) -> None:
    pass


@dataclass(frozen=True)
class Task:
    """How a procedure is run on the files of one unit.

    Attributes
    ----------
    procedure
        Its name in records.
    files
        What the files are, for messages.
    count
        Fewest and most files; None for any number.
    options
        Names of the options of its fit.
    paths
        Those of them that name a file.
    values
        Texts of options and how messages call an option (``"--{}"``) to checked values; raises OptionError.
    fit
        Names of the files, values, access to files and a progress callback to the record.
    """

    procedure: str
    files: str
    count: tuple[int, int | None]
    options: tuple[str, ...]
    paths: tuple[str, ...]
    values: Callable[[Mapping[str, str], str], dict[str, Any]]
    fit: Callable[[Sequence[str], Mapping[str, Any], Files, Callable[[int], None]], Calibration]


def run_task(
    name: str,
    files: Sequence[str],
    options: Mapping[str, str | None],
    access: Files,
    *,
    label: str = FLAG,
    progress: Callable[[int], None] = _silent,
) -> Calibration:
    """Fit one unit; `options` are texts, None where not given.

    Raises
    ------
    ImulabError
        What the procedure's fit, its readers and its options raise.
    """
    task = TASKS[name]
    values = task.values({key: text for key, text in options.items() if text is not None}, label)
    return task.fit(files, values, access, progress)


# ---- tumble --------------------------------------------------------------------------------------------------------


def _tumble_values(texts: Mapping[str, str], label: str) -> dict[str, Any]:
    from imulab.tumble.fit import check_options

    order = texts.get("order", "auto")
    trials = texts.get("monte_carlo")
    values: dict[str, Any] = {
        "order": int(order) if order.isascii() and order.isdecimal() and len(order) < 3 else order,
        "method": texts.get("method", "norm"),
        "loss": texts.get("loss", "square"),
        "gravity": _gravity(texts.get("gravity"), texts.get("latitude"), texts.get("height"), label),
        "monte_carlo": None if trials is None else whole_number(trials, label.format("monte-carlo")),
        "prior": texts.get("prior"),
        "layout": texts.get("layout"),
        "part": chosen(texts.get("topic"), texts.get("instance"), texts.get("window"), label),
    }
    check_options(values["order"], values["method"], values["loss"])
    return values


def _tumble_fit(
    files: Sequence[str], values: Mapping[str, Any], access: Files, progress: Callable[[int], None]
) -> Calibration:
    from imulab.segment import find_attitudes
    from imulab.tumble.fit import fit_tumble

    attitudes = find_attitudes(access.recording(files[0], values["layout"], **values["part"]))
    return fit_tumble(
        attitudes,
        order=values["order"],
        gravity=values["gravity"],
        method=values["method"],
        loss=values["loss"],
        prior=None if values["prior"] is None else access.record(values["prior"]),
        monte_carlo=values["monte_carlo"],
        progress=progress,
    ).calibration


def _gravity(gravity: str | None, latitude: str | None, height: str | None, label: str) -> Gravity | float | None:
    from imulab.gravity import normal_gravity
    from imulab.tumble.record import Gravity

    names = {name: label.format(name) for name in ("gravity", "latitude", "height")}
    if gravity is not None:
        if latitude is not None or height is not None:
            raise OptionError(
                f"{names['gravity']} together with {names['latitude']} or {names['height']}: expected one or the other"
            )
        return quantity(gravity, names["gravity"], "acceleration", "m/s^2")
    if latitude is None:
        if height is not None:
            raise OptionError(f"{names['height']} without {names['latitude']}: expected both")
        return None
    angle = quantity(latitude, names["latitude"], "angle", "deg")
    above = quantity(height, names["height"], "length", "m") if height is not None else 0.0
    value = normal_gravity(angle, above)
    return Gravity(value, f"normal gravity at latitude {math.degrees(angle):.6g} deg, height {above:g} m (WGS 84)")


# ---- gyro array ----------------------------------------------------------------------------------------------------


def _array_values(texts: Mapping[str, str], label: str) -> dict[str, Any]:
    name, interval = label.format("interval"), texts.get("interval")
    ends: list[float] | None = None
    if interval is not None:
        ends = [quantity(part, name, "time", "s") for part in interval.split(",")]
        if len(ends) != 2 or not ends[0] < ends[1]:
            raise OptionError(f"{name} {interval!r}: expected START,STOP, such as 468,496")
    return {
        "interval": ends,
        "averaging": quantity(texts.get("averaging", "1 s"), label.format("averaging"), "time", "s"),
        "layout": texts.get("layout"),
    }


def _array_fit(
    files: Sequence[str], values: Mapping[str, Any], access: Files, progress: Callable[[int], None]
) -> Calibration:
    from imulab.gyro_array.fit import calibrate_array

    still = _between(access.recording(files[0], values["layout"]), values["interval"])
    moving = access.recording(files[1], values["layout"]) if len(files) > 1 else None
    return calibrate_array(still, moving, averaging_time=values["averaging"]).calibration


def _between(recording: Recording, ends: Sequence[float] | None) -> Recording:
    """Cut a recording to an interval of its time."""
    if ends is None:
        return recording
    import numpy as np

    shown = f"{ends[0]:g},{ends[1]:g}"
    if "time" not in recording:
        raise OptionError(f"{recording.name}: interval {shown} needs a column time")
    inside = np.flatnonzero((recording.si("time") >= ends[0]) & (recording.si("time") < ends[1]))
    if not inside.size:
        raise OptionError(f"{recording.name}: interval {shown}: no samples there")
    columns = {name: values[inside] for name, values in recording.columns.items()}
    return replace(recording, columns=columns, first_row=recording.first_row + int(inside[0]))


# ---- centrifuge ----------------------------------------------------------------------------------------------------


def _centrifuge_values(texts: Mapping[str, str], label: str) -> dict[str, Any]:
    from imulab.centrifuge.fit import check_options

    method, curve = texts.get("method", "least-squares"), texts.get("curve", "auto")
    check_options(method, curve)
    return {"method": method, "curve": curve, "layout": texts.get("layout")}


def _centrifuge_fit(
    files: Sequence[str], values: Mapping[str, Any], access: Files, progress: Callable[[int], None]
) -> Calibration:
    from imulab.centrifuge.fit import fit_centrifuge
    from imulab.centrifuge.manifest import load_manifest

    (manifest,) = files
    test = load_manifest(access.path(manifest), manifest)
    names = {run.file: access.beside(manifest, run.file) for run in test.runs}
    for index, run in enumerate(test.runs):  # what is missing is said before hours of data are read
        if not access.path(names[run.file]).is_file():
            raise ReadError(f"{test.place(index)}: no such file")

    def sources() -> list[Source]:
        found = []
        for name, path in [(manifest, manifest), *((run.file, names[run.file]) for run in test.runs)]:
            with access.path(path).open("rb") as stream:
                found.append(Source(name, hashlib.file_digest(stream, "sha256").hexdigest()))
        return found

    return fit_centrifuge(
        test,
        lambda run: access.blocks(names[run.file], values["layout"]),
        method=values["method"],
        curve=values["curve"],
        sources=sources,
        progress=progress,
    ).calibration


TASKS: dict[str, Task] = {
    "tumble": Task(
        procedure="tumble",
        files="one recording or table of attitudes",
        count=(1, 1),
        options=(
            "order",
            "method",
            "gravity",
            "latitude",
            "height",
            "loss",
            "monte_carlo",
            "prior",
            "layout",
            "topic",
            "instance",
            "window",
        ),
        paths=("prior", "layout"),
        values=_tumble_values,
        fit=_tumble_fit,
    ),
    "array": Task(
        procedure="gyro_array",
        files="STILL, or STILL;MOVING",
        count=(1, 2),
        options=("interval", "averaging", "layout"),
        paths=("layout",),
        values=_array_values,
        fit=_array_fit,
    ),
    "centrifuge": Task(
        procedure="centrifuge",
        files="the manifest of one test",
        count=(1, 1),
        options=("method", "curve", "layout"),
        paths=("layout",),
        values=_centrifuge_values,
        fit=_centrifuge_fit,
    ),
}

"""Export of records to firmware, autopilots and toolboxes: records or their files, options as keywords."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Annotated, Any

from imulab import exporters
from imulab.arguments import Folder
from imulab.device import METHODS
from imulab.device.tables import Fusion
from imulab.display import SENTENCES
from imulab.errors import ImulabError, OptionError, listed
from imulab.exporters import EXPORTERS, MAG_MOUNTS, ExportOptions
from imulab.files import open_file
from imulab.options import RARE, choice, file, measure, text
from imulab.procedures.apply import tables_of
from imulab.procedures.registry import load, procedure_of
from imulab.procedures.result import Record, as_record
from imulab.quantities import whole
from imulab.records.calibration import Calibration

_FIRMWARE = ("c", "blob")
_DEVICE_IDS = 2**32  # numbers of 32 bits
_TAKEN_BY = {
    "device_id": ("px4",),
    "mag_device_id": ("px4",),
    "noise": ("kalibr", "openvins"),
    "mag_mount": ("px4", "ardupilot"),
}
"""Targets in which an option has an effect."""


def _nothing(message: str) -> None:
    """Ignore a message."""


def export(
    to: Annotated[str, text("TARGET", tuple(EXPORTERS))],
    records: Record | Sequence[Record],
    folder: Folder,
    *,
    lossy: bool = False,
    device_id: int | str = 0,
    mag_device_id: int | str = 0,
    noise: Annotated[str | PathLike[str] | Mapping[str, Any] | Calibration | None, file()] = None,
    method: Annotated[str | None, text("METHOD", METHODS)] = None,
    memory: Annotated[str | float | None, text("growing|growing:N|GAIN", ("growing",))] = None,
    at: Annotated[str | None, text("centroid|imu:N|X,Y,Z", ("centroid",)), RARE] = None,
    gyro_range: Annotated[float | str | None, measure("rate", "deg/s"), RARE] = None,
    accel_range: Annotated[float | str | None, measure("acceleration", "g"), RARE] = None,
    mag_mount: Annotated[str, choice(("external", "internal"))] = "external",
    tell: Callable[[str], object] = _nothing,
) -> list[Path]:
    """Write records in the form of firmware, an autopilot or a toolbox.

    Parameters
    ----------
    to
        c blob px4 ardupilot kalibr openvins ros fusion motioncal betaflight inav.
    records
        The unit's records, or their files; one or several.
    folder
        Where to; made where it is not there.
    lossy
        Leave out what the target cannot hold, and fit the rest anew.
    device_id
        PX4: number of the sensor, without which PX4 ignores the file.
    mag_device_id
        PX4: number of the magnetometers, which are another chip to it.
    noise
        Noise record, or what 'allan --json' printed. Or the file of either, for noise keys.
    method
        c, blob: how an array fuses; what its record carries if not given. As for `fuse`.
    memory
        c, blob: growing, growing:COUNT, or a gain between 0 and 1.
    at
        c, blob: where whole IMUs give the specific force; their centroid if not given. As for `fuse_imus`.
    gyro_range, accel_range
        c, blob: largest reading of whole IMUs, beyond which the unit believes none; else as the record holds it.
    mag_mount
        px4, ardupilot: whether the magnetometers have a rotation of their own there, which holds their mounting.
        ``external`` where the autopilot turns the magnetometers by a rotation of their own, which then holds their
        mounting exactly; ``internal`` where it does not.
    tell
        Called with a sentence on each loss that was allowed, on each record that is not good, on PX4's device number
        where it is not given, and on an option that has no effect.

    Returns
    -------
    list
        The files written.

    Raises
    ------
    OptionError
        An unknown target, or one that cannot hold the records; nothing is written then.
    RecordError
        A record cannot be read, or lacks what is needed.

    Examples
    --------
    >>> import imulab as il
    >>> fit = il.fit_tumble(il.simulate_tumble(gravity=9.81), order=1, gravity=9.81)
    >>> [file.name for file in il.export("ros", fit.calibration, "calibration")]
    ['imu_calib.yaml']
    """
    if to not in EXPORTERS:
        raise OptionError(f"to {to!r}: unknown target; known targets: {listed(EXPORTERS, to)}")
    if mag_mount not in MAG_MOUNTS:
        raise OptionError(f"mag_mount {mag_mount!r}: expected one of {listed(MAG_MOUNTS, str(mag_mount))}")
    number, mag_number = _device_numbers(device_id, mag_device_id)
    if Path(folder).exists() and not Path(folder).is_dir():
        raise OptionError(f"{os.fspath(folder)}: expected a folder to write to, found a file")
    listed_records = list(records) if isinstance(records, Sequence) and not isinstance(records, str) else [records]
    if not listed_records:
        raise OptionError("export: records: expected one or more, found none")
    loaded = [
        load(os.fspath(item)) if isinstance(item, str | PathLike) else as_record(item, "export")
        for item in listed_records
    ]
    files = [os.fspath(item) if isinstance(item, str | PathLike) else "" for item in listed_records]
    names = [each or "the record" for each in files]
    named = {"method": method, "memory": memory, "at": at, "gyro_range": gyro_range, "accel_range": accel_range}
    stated = {name: value for name, value in named.items() if value is not None}
    fusions = _choose_fusions(to, stated, loaded) if stated else [None] * len(loaded)
    if to in _FIRMWARE:
        for name, record, fusion in zip(names, loaded, fusions, strict=True):
            try:
                tables_of(record, fusion)
            except ImulabError as error:
                raise (error if str(error).startswith(name) else type(error)(f"{name}: {error}")) from None
    for name, record in zip(names, loaded, strict=True):
        if record.verdict.state == "bad":
            tell(f"{name}: the record's verdict is bad, {SENTENCES['bad']}: {record.verdict.reasons[0]}")
    file = os.fspath(noise) if isinstance(noise, str | PathLike) else "the noise"
    noise_keys: Mapping[str, Any] = _state_noise(noise, file) if isinstance(noise, Calibration) else {}
    if noise and not isinstance(noise, Calibration):
        noise_keys = noise if isinstance(noise, Mapping) else _read_noise(file)
    source = file if noise else ""
    options = ExportOptions(lossy, number, noise_keys, source, fusions, mag_mount, tell, mag_number, files)
    written = exporters.export(to, loaded, Path(folder), options)
    chosen = {"device_id": number, "mag_device_id": mag_number, "noise": noise, "mag_mount": mag_mount != MAG_MOUNTS[0]}
    for line in _without_effect(to, [name for name, value in chosen.items() if value], loaded):
        tell(line)
    return written


def _device_numbers(device_id: int | str, mag_device_id: int | str) -> tuple[int, int]:
    """Return PX4's numbers of the sensors and of the magnetometers; 0 is not known."""
    number, mag_number = whole(device_id, "device_id"), whole(mag_device_id, "mag_device_id")
    for name, each in (("device_id", number), ("mag_device_id", mag_number)):
        if not 0 <= each < _DEVICE_IDS:
            raise OptionError(f"{name} {each}: expected a number from 0 to {_DEVICE_IDS - 1}")
    if number and number == mag_number:
        raise OptionError(f"mag_device_id {number}: expected another number than device_id, as of another chip")
    return number, mag_number


def _without_effect(to: str, names: Sequence[str], records: Sequence[Calibration]) -> Iterator[str]:
    """Yield a sentence on each option that has no effect."""
    parameters = {name for record in records for name in record.parameters}
    with_mag = any(name.startswith("mag_") for name in parameters)
    for name in names:
        if to not in _TAKEN_BY[name]:
            yield f"{to}: --{name.replace('_', '-')} has no effect: it is for {' and '.join(_TAKEN_BY[name])}"
        elif name.startswith("mag_") and not with_mag:
            yield f"{to}: --{name.replace('_', '-')} has no effect: the record holds no magnetometers"


def _choose_fusions(to: str, stated: Mapping[str, Any], records: Sequence[Calibration]) -> list[Fusion | None]:
    """Return how each record is fused by the keywords that its kind takes, None where none of them is stated.

    Keywords that no record takes are refused.
    """
    taken = [procedure_of(record).fused_by(record) if to in _FIRMWARE else () for record in records]
    if not any(taken):
        raise OptionError(
            f"{' and '.join(stated)}: how a gyro array or whole IMUs are fused; expected its record, and target c or "
            "blob"
        )
    strange = stated.keys() - {name for names in taken for name in names}  # the first record that fuses refuses them
    fusions: list[Fusion | None] = []
    for record, names in zip(records, taken, strict=True):
        chosen = {name: value for name, value in stated.items() if name in names or name in strange}
        fusions.append(procedure_of(record).fusion(record, chosen) if names and chosen else None)
    return fusions


def _state_noise(record: Calibration, name: str) -> Mapping[str, Any]:
    """Return the noise that a record states; errors name its file."""
    try:
        return procedure_of(record).noise(record)
    except OptionError as error:
        raise OptionError(f"{name}: {error}") from None


def _read_noise(file: str) -> Mapping[str, Any]:
    """Return the noise in the file of a noise record, or of ``allan --json``."""
    try:
        with open_file(file) as stream:
            content = json.loads(stream.read().decode("utf-8"))
    except FileNotFoundError:
        raise OptionError(f"{file}: no such file") from None
    except (OSError, ValueError) as error:
        raise OptionError(f"{file}: expected what 'imulab allan --json' printed, found no JSON ({error})") from None
    if isinstance(content, dict) and "procedure" in content:
        return _state_noise(load(file), file)
    if not isinstance(content, dict) or "columns" not in content:
        raise OptionError(f"{file}: expected what 'imulab allan --json' printed, found JSON without 'columns'")
    return dict(content)

"""Records to the files of other programs: one module per program, one dispatch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from imulab.device.tables import Fusion
from imulab.errors import OptionError, listed
from imulab.records.calibration import Calibration

_HOMES = {
    "c": "firmware_c",
    "blob": "firmware_c",
    "px4": "autopilots",
    "ardupilot": "autopilots",
    "kalibr": "kalibr",
    "openvins": "kalibr",
    "ros": "matrices",
    "fusion": "matrices",
    "motioncal": "matrices",
    "betaflight": "betaflight",
    "inav": "betaflight",
}
"""Targets and their modules, which have ``export_TARGET(records, folder, options) -> list of the files written``."""
EXPORTERS = tuple(_HOMES)


def _nothing(message: str) -> None:
    """Ignore a message."""


MAG_MOUNTS = ("external", "internal")


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """Options of ``export``.

    Attributes
    ----------
    lossy
        Whether parameters that the target cannot hold may be left out; what it can hold is then fitted anew.
    device_id
        PX4's number of the accelerometers and gyroscopes; 0 where it is not known.
    mag_device_id
        PX4's number of the magnetometers; 0 where it is not known.
    noise
        What ``allan --json`` found, for targets with noise keys.
    noise_file
        What messages call the file that it came from.
    fusions
        How each record is fused in firmware or a blob; what it carries where None or empty.
    mag_mount
        ``external``: the autopilot turns the magnetometers by a rotation of their own; ``internal``: it does not.
    tell
        Called with a sentence on each loss that was allowed.
    files
        The files of the records, by which refusals name them; empty where one has none.
    """

    lossy: bool = False
    device_id: int = 0
    noise: Mapping[str, Any] = field(default_factory=dict)
    noise_file: str = "the noise file"
    fusions: Sequence[Fusion | None] = ()
    mag_mount: str = "external"
    tell: Callable[[str], object] = _nothing
    mag_device_id: int = 0
    files: Sequence[str] = ()


def export(
    target: str, records: Sequence[Calibration], folder: str | Path, options: ExportOptions | None = None
) -> list[Path]:
    """Write records in the form of another program.

    Arguments, result and what is raised are those of `imulab.export`, the options in one value.
    """
    if target not in EXPORTERS:
        raise OptionError(f"unknown target {target!r}; known targets: {listed(EXPORTERS, target)}")
    chosen = options or ExportOptions()
    module = import_module(f"imulab.exporters.{_HOMES[target]}")
    files: list[Path] = getattr(module, f"export_{target}")(records, Path(folder), chosen)
    return files

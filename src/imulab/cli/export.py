"""``imulab export``: records to firmware, autopilots and toolboxes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from imulab.cli.options import naming, warn, whole_number
from imulab.errors import OptionError, listed

if TYPE_CHECKING:
    from imulab.device.array_settings import Fusion
    from imulab.records.calibration import Calibration

_DEVICE_IDS = 2**32


def export(
    records: Annotated[list[str], typer.Argument(metavar="RECORD...", help="Calibration records of one unit.")],
    to: Annotated[str, typer.Option("--to", metavar="TARGET", help="c blob px4 ardupilot kalibr openvins ros.")],
    output: Annotated[str, typer.Option("-o", "--output", metavar="DIR", help="Folder to write to.")],
    lossy: Annotated[
        bool, typer.Option("--lossy", help="Leave out what the target cannot hold, and fit the rest anew.")
    ] = False,
    device_id: Annotated[str, typer.Option("--device-id", metavar="N", help="PX4: number of the sensor.")] = "0",
    noise: Annotated[
        str | None, typer.Option("--noise", metavar="FILE", help="What 'allan --json' printed, for noise keys.")
    ] = None,
    method: Annotated[
        str | None, typer.Option("--method", help="c, blob: how an array fuses; what its record carries if not given.")
    ] = None,
    memory: Annotated[
        str | None, typer.Option("--memory", help="c, blob: growing, growing:COUNT, or a gain between 0 and 1.")
    ] = None,
) -> None:
    """Write calibration records in the form of firmware, an autopilot or a toolbox."""
    from imulab.exporters import EXPORTERS, ExportOptions
    from imulab.exporters import export as write
    from imulab.procedures.loading import load
    from imulab.procedures.unit_tables import tables_of
    from imulab.verdict import SENTENCES

    if to not in EXPORTERS:
        raise OptionError(f"--to {to!r}: unknown target; known targets: {listed(EXPORTERS, to)}")
    number = whole_number(device_id, "--device-id")
    if not 0 <= number < _DEVICE_IDS:
        raise OptionError(f"--device-id {number}: expected a number from 0 to {_DEVICE_IDS - 1}")
    if not output:
        raise OptionError("-o '': expected a folder to write to")
    if Path(output).exists() and not Path(output).is_dir():
        raise OptionError(f"{output}: expected a folder to write to, found a file")
    options = ExportOptions(
        lossy=lossy, device_id=number, noise=_noise(noise) if noise else {}, noise_file=noise or "", tell=warn
    )
    loaded = [load(name) for name in records]
    if method is not None or memory is not None:
        options = replace(options, fusion=_fusion(to, method, memory, loaded))
    if to in ("c", "blob"):
        for name, record in zip(records, loaded, strict=True):
            with naming(name):
                tables_of(record, options.fusion)
    for name, record in zip(records, loaded, strict=True):
        if record.verdict.state == "bad":
            warn(f"{name}: the record's verdict is bad, {SENTENCES['bad']}: {record.verdict.reasons[0]}")
    for file in write(to, loaded, output, options):
        print(f"{to}: {file}")


def _fusion(to: str, method: str | None, memory: str | None, records: list[Calibration]) -> Fusion:
    from imulab.procedures.gyro_array.memory import carried, fusion_text

    array = next((record for record in records if record.procedure == "gyro_array"), None)
    if to not in ("c", "blob") or array is None:
        raise OptionError("--method and --memory say how a gyro array fuses: expected its record, and --to c or blob")
    return fusion_text(method, memory, held=carried(array))


def _noise(file: str) -> dict[str, Any]:
    try:
        content = json.loads(Path(file).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise OptionError(f"{file}: no such file") from None
    except (OSError, ValueError) as error:
        raise OptionError(f"{file}: expected what 'imulab allan --json' printed, found no JSON ({error})") from None
    if not isinstance(content, dict) or "columns" not in content:
        raise OptionError(f"{file}: expected what 'imulab allan --json' printed, found JSON without 'columns'")
    return content

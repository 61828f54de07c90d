"""``imulab export``: records to firmware, autopilots and toolboxes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from imulab.cli.options import naming, warn, whole_number
from imulab.errors import OptionError, listed

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
) -> None:
    """Write calibration records in the form of firmware, an autopilot or a toolbox."""
    from imulab.calibration import load
    from imulab.exporters import EXPORTERS, ExportOptions
    from imulab.exporters import export as write
    from imulab.tables import tables_of
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
    if to in ("c", "blob"):
        for name, record in zip(records, loaded, strict=True):
            with naming(name):
                tables_of(record)
    for name, record in zip(records, loaded, strict=True):
        if record.verdict.state == "bad":
            warn(f"{name}: the record's verdict is bad, {SENTENCES['bad']}: {record.verdict.reasons[0]}")
    for file in write(to, loaded, output, options):
        print(f"{to}: {file}")


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

"""``imulab export``: records to firmware, autopilots and toolboxes."""

from __future__ import annotations

from typing import Annotated

import typer

from imulab.cli.fit_options import lists, one_of
from imulab.cli.options import call, warn
from imulab.errors import OptionError


def export(
    records: Annotated[list[str], typer.Argument(metavar="RECORD...", help="Calibration records of one unit.")],
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="TARGET",
            help="c blob px4 ardupilot kalibr openvins ros fusion motioncal.",
            autocompletion=lists("imulab.exporters:EXPORTERS"),
        ),
    ],
    output: Annotated[str, typer.Option("-o", "--output", metavar="DIR", help="Folder to write to.")],
    lossy: Annotated[
        bool, typer.Option("--lossy", help="Leave out what the target cannot hold, and fit the rest anew.")
    ] = False,
    device_id: Annotated[str, typer.Option("--device-id", metavar="N", help="PX4: number of the sensor.")] = "0",
    noise: Annotated[
        str | None, typer.Option("--noise", metavar="FILE", help="Noise record, or what 'allan --json' printed.")
    ] = None,
    method: Annotated[
        str | None, typer.Option("--method", help="c, blob: how an array fuses; what its record carries if not given.")
    ] = None,
    memory: Annotated[
        str | None, typer.Option("--memory", help="c, blob: growing, growing:COUNT, or a gain between 0 and 1.")
    ] = None,
    mag_mount: Annotated[
        str,
        one_of(
            ("external", "internal"),
            "px4, ardupilot: whether the magnetometers have a rotation of their own there, which holds their mounting.",
            "--mag-mount",
        ),
    ] = "external",
) -> None:
    """Write calibration records in the form of firmware, an autopilot or a toolbox."""
    from imulab.procedures.exporting import export as write

    if not output:
        raise OptionError("-o '': expected a folder to write to")
    files = call(
        write, to=to, records=records, folder=output, lossy=lossy, device_id=device_id, noise=noise, method=method,
        memory=memory, mag_mount=mag_mount, tell=warn,
    )  # fmt: skip
    for file in files:
        print(f"{to}: {file}")

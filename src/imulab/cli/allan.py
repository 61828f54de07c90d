"""``imulab allan``: the noise of any recording."""

from __future__ import annotations

from typing import Annotated, Any

from imulab.cli.fit_options import READ, one_of, reading, with_options
from imulab.cli.options import (
    AsJson,
    RecordingFile,
    ReportFile,
    check_outputs,
    warn,
)
from imulab.estimation import TAUS
from imulab.printable import printable


@with_options(READ)
def allan(
    file: RecordingFile,
    *,
    taus: Annotated[str, one_of(TAUS, "dense: 24 a decade.")] = "octave",
    options: dict[str, str | None],
    report: ReportFile = None,
    json: AsJson = False,
) -> None:
    """Print Allan deviation and noise coefficients of every sensor column of a recording at rest."""
    from imulab.disk import is_large, on_disk
    from imulab.estimation.column_noise import analyse
    from imulab.quantities import labelled
    from imulab.readers import read, read_blocks

    check_outputs([report], [name for name in (file, options["layout"]) if name])
    how = reading(options)
    recording = on_disk(read_blocks(file, **how)) if is_large(file) else read(file, **how)
    with labelled("--{}", ["taus"]):
        found = analyse(recording, taus)
    if report:
        from imulab.atomic_write import write_text
        from imulab.report.noise_figures import noise_page

        write_text(report, noise_page(found, recording))
    if json:
        from json import dumps

        print(dumps(found, indent=1, ensure_ascii=False, allow_nan=False))
    else:
        print(describe(found))
        if report:
            print(f"report: {report}")
    for message in found["warnings"]:
        warn(message)


def describe(found: dict[str, Any]) -> str:
    """Return coefficients and curves as tables."""
    from imulab.report.elements import plain_number
    from imulab.report.noise_figures import coefficient_rows, shown_unit
    from imulab.shown import aligned

    lines = [f"{printable(found['file'])}: {found['samples']} samples at {found['sample_rate']['value']:.6g} Hz", ""]
    lines += aligned(["column", "coefficient", "value", "u", "unit"], coefficient_rows(found))
    names = list(found["columns"])
    units = {name: shown_unit(found["columns"][name]["unit"], "bias_instability") for name in names}
    lines += ["", "Allan deviation"]
    tau = found["columns"][names[0]]["tau"]
    body = [
        [plain_number(t, 4), *(plain_number(found["columns"][n]["deviation"][k] * units[n][1], 4) for n in names)]
        for k, t in enumerate(tau)
    ]
    lines += aligned(["tau s", *(f"{n} {units[n][0]}" for n in names)], body)
    return "\n".join(lines)

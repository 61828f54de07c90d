"""``imulab allan``: the noise of any recording."""

from __future__ import annotations

import math
from typing import Annotated, Any

import typer

from imulab.cli.options import AsJson, Element, Instance, LayoutFile, RecordingFile, Topic, Window, chosen, warn
from imulab.printable import printable

_HOUR = 3600.0
_DEGREE = math.pi / 180


def allan(
    file: RecordingFile,
    taus: Annotated[str, typer.Option(help="octave, or dense (24 a decade).")] = "octave",
    layout: LayoutFile = None,
    topic: Topic = None,
    instance: Instance = None,
    window: Window = None,
    element: Element = None,
    json: AsJson = False,
) -> None:
    """Print Allan deviation and noise coefficients of every sensor column of a recording at rest."""
    from imulab.allan import analyse
    from imulab.readers import read

    found = analyse(read(file, layout, **chosen(topic, instance, window, element)), taus)
    if json:
        from json import dumps

        print(dumps(found, indent=1, ensure_ascii=False, allow_nan=False))
    else:
        print(describe(found))
    for message in found["warnings"]:
        warn(message)


def describe(found: dict[str, Any]) -> str:
    """Return coefficients and curves as tables."""
    from imulab.cli.show import aligned
    from imulab.exhibit import format_uncertain, plain_number

    rows = []
    for name, column in found["columns"].items():
        for key, title in (
            ("angle_random_walk", "angle random walk"),
            ("bias_instability", "bias instability"),
            ("rate_random_walk", "rate random walk"),
            ("quantisation", "quantisation"),
        ):
            if key == "quantisation" and not _visible(column[key]):
                continue
            unit, factor = _shown(column["unit"], key)
            texts = ("not determined", "")
            if column[key]["value"] is not None:
                texts = format_uncertain(*(column[key][part] * factor for part in ("value", "standard_uncertainty")))
            label = (
                title
                if column["unit"] != "m/s^2"
                else title.replace("angle", "velocity").replace("rate", "acceleration")
            )
            rows.append([name, label, *texts, unit])
    lines = [f"{printable(found['file'])}: {found['samples']} samples at {found['sample_rate']['value']:.6g} Hz", ""]
    lines += aligned(["column", "coefficient", "value", "u", "unit"], rows)
    names = list(found["columns"])
    units = {name: _shown(found["columns"][name]["unit"], "bias_instability") for name in names}
    lines += ["", "Allan deviation"]
    tau = found["columns"][names[0]]["tau"]
    body = [
        [plain_number(t, 4), *(plain_number(found["columns"][n]["deviation"][k] * units[n][1], 4) for n in names)]
        for k, t in enumerate(tau)
    ]
    lines += aligned(["tau s", *(f"{n} {units[n][0]}" for n in names)], body)
    return "\n".join(lines)


def _visible(found: dict[str, Any]) -> bool:
    """Whether a coefficient is beyond three times its uncertainty."""
    return found["value"] is not None and bool(found["value"] > 3 * found["standard_uncertainty"])


def _shown(unit: str, key: str) -> tuple[str, float]:
    """Engineering unit of a coefficient, and the factor from SI to it."""
    hour = math.sqrt(_HOUR)
    if unit == "rad/s":
        return {
            "angle_random_walk": ("deg/sqrt(h)", hour / _DEGREE),
            "bias_instability": ("deg/h", _HOUR / _DEGREE),
            "rate_random_walk": ("deg/h/sqrt(h)", _HOUR * hour / _DEGREE),
            "quantisation": ("arcsec", _HOUR / _DEGREE),
        }[key]
    if unit == "m/s^2":
        return {
            "angle_random_walk": ("m/s/sqrt(h)", hour),
            "bias_instability": ("ug", 1e6 / 9.80665),
            "rate_random_walk": ("ug/sqrt(h)", 1e6 * hour / 9.80665),
            "quantisation": ("mm/s", 1e3),
        }[key]
    return {
        "angle_random_walk": (f"{unit}/sqrt(Hz)", 1.0),
        "bias_instability": (unit, 1.0),
        "rate_random_walk": (f"{unit}/sqrt(s)", 1.0),
        "quantisation": (f"{unit} s", 1.0),
    }[key]

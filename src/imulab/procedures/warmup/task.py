"""The warm-up of a unit, or of a type, from recordings of power cycles."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from imulab.errors import OptionError
from imulab.procedures.procedure import Files, Task, source_of
from imulab.quantities import chosen, number, quantity

if TYPE_CHECKING:
    from imulab.procedures.warmup.cycles import Cycle
    from imulab.records.calibration import Calibration

TEMPERATURES = "-40,-30,-20,-10,0,40,50,60"
"""Calibration temperatures of the source, degC."""
_SWITCH = {"yes": True, "true": True, "1": True, "no": False, "false": False, "0": False}


def _values(texts: Mapping[str, str], label: str) -> dict[str, Any]:
    from imulab.procedures.warmup.fit import check_options

    def name(option: str) -> str:
        return label.format(option)

    settling = texts.get("settling_time")
    axes = texts.get("axes")
    column = texts.get("temperature_column", "no").lower()
    if column not in _SWITCH:
        raise OptionError(f"{name('temperature-column')} {column!r}: expected yes or no")
    fit: dict[str, Any] = {
        "model": texts.get("model", "auto"),
        "temperatures": temperature_list(texts.get("temperatures", TEMPERATURES), name("temperatures")),
        "tolerance": number(texts.get("tolerance", "1"), name("tolerance")),
        "settling_time": None if settling is None else quantity(settling, name("settling-time"), "time", "s"),
        "settling_limit": _limit(texts.get("settling_limit", "5 %"), name("settling-limit")),
        "exit_rule": texts.get("exit", "zero"),
        "taper_time": quantity(texts.get("taper_time", "60 s"), name("taper-time"), "time", "s"),
        "pool": texts.get("pool", "unit"),
        "axes": None if axes is None else _names(axes, name("axes")),
        "beyond": texts.get("beyond", "zero"),
    }
    check_options(
        *(
            fit[key]
            for key in (
                "model",
                "temperatures",
                "tolerance",
                "settling_time",
                "exit_rule",
                "taper_time",
                "pool",
                "beyond",
            )
        )
    )
    return {
        "fit": fit,
        "latest_start": quantity(texts.get("latest_start", "5 s"), name("latest-start"), "time", "s"),
        "temperature_column": _SWITCH[column],
        "layout": texts.get("layout"),
        "part": chosen(*(texts.get(key) for key in ("topic", "instance", "window", "element")), label=label),
    }


def _fit(
    files: Sequence[str], values: Mapping[str, Any], access: Files, progress: Callable[[int], None]
) -> Calibration:
    from imulab.procedures.warmup.cycles import find_power_cycle
    from imulab.procedures.warmup.fit import fit_warmup

    def cycle(name: str) -> Cycle:
        return find_power_cycle(
            access.blocks(name, values["layout"], **values["part"]),
            latest_start=values["latest_start"],
            temperature_from_column=values["temperature_column"],
            source=source_of(access, name),
        )

    return fit_warmup([cycle(name) for name in files], **values["fit"]).calibration


def temperature_list(text: str, option: str = "--temperatures") -> list[float]:
    """Return ``-40,-30,...`` as numbers.

    Raises
    ------
    OptionError
        It is no such list.
    """
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise OptionError(f"{option} {text!r}: expected numbers such as -40,-30,0") from None


def _names(text: str, option: str) -> list[str]:
    names = [name.strip() for name in text.split(",")]
    if not all(names) or len(set(names)) < len(names):
        raise OptionError(f"{option} {text!r}: expected names of columns, each once, such as gyro_x,gyro_y")
    return names


def _limit(text: str, option: str) -> dict[str, float]:
    """Kind to the |Z| that counts as settled; a share of the peak is negative."""
    if text.rstrip().endswith("%"):
        share = number(text.rstrip()[:-1], option) / 100
        if not 0 < share < 1:
            raise OptionError(f"{option} {text!r}: expected more than 0 and less than 100 %")
        return {"gyro": -share, "accel": -share}
    for kind, what, unit in (("gyro", "rate", "deg/h"), ("accel", "acceleration", "mg")):
        try:
            value = quantity(text, option, what, unit)
        except OptionError:
            continue
        if any(symbol in text for symbol in ("deg", "rad")) == (kind == "gyro") and value > 0:
            return {kind: value}
    raise OptionError(f"{option} {text!r}: expected a percentage such as '5 %', a rate or an acceleration")


TASK = Task(
    files="the recordings of its power cycles",
    count=(1, None),
    options=(
        "model",
        "temperatures",
        "tolerance",
        "settling_time",
        "settling_limit",
        "exit",
        "taper_time",
        "pool",
        "axes",
        "beyond",
        "latest_start",
        "temperature_column",
        "layout",
        "topic",
        "instance",
        "window",
        "element",
    ),
    paths=("layout",),
    modules=("imulab.readers", "imulab.procedures.warmup.cycles", "imulab.procedures.warmup.fit", "scipy.special"),
    values=_values,
    fit=_fit,
)

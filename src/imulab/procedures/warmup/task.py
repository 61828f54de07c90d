"""The warm-up of a unit, or of a type, from recordings of power cycles."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from imulab.procedures.options import (
    ELEMENT,
    READING,
    Option,
    choice,
    finite,
    measure,
    names_of_columns,
    part_of,
    read_options,
    switch,
)
from imulab.procedures.procedure import Files, Task, source_of
from imulab.procedures.warmup.choices import BEYOND, EXITS, MODELS, POOLS, TEMPERATURES, settling_size
from imulab.quantities import temperature_list

if TYPE_CHECKING:
    from imulab.procedures.warmup.cycles import Cycle
    from imulab.records.calibration import Calibration


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


OPTIONS = (
    choice("model", "How the bias goes with time; auto compares them.", ("auto", *MODELS), "auto"),
    Option("temperatures", "Calibration temperatures, degC, ascending.", temperature_list, TEMPERATURES, "T,T,..."),
    finite("tolerance", "A power-on temperature within this fits, K.", "1", "K"),
    measure("settling_time", "T_M, s; chosen from the data if not given.", "time", "s", shows="TIME"),
    Option("settling_limit", "Settled below this: percent of the peak, or deg/h, mg ..", settling_size, "5 %", "LIMIT"),
    choice("exit", "What the table gives from T_M on.", EXITS, "zero"),
    measure("taper_time", "How long a taper takes, s.", "time", "s", "60 s", shows="TIME"),
    choice("pool", "unit, or type: several units share one table.", POOLS, "unit"),
    choice("beyond", "Beyond the outer temperatures: zero (no correction) or hold (as there).", BEYOND, "zero"),
    Option("axes", "Columns to fit; all if not given.", names_of_columns, shows="A,A,..."),
    measure("latest_start", "A first sample later after power-on, s, is refused.", "time", "s", "5 s", shows="TIME"),
    switch("temperature_column", "Take a missing power-on temperature from the first row's column."),
    *READING,
    ELEMENT,
)
_OF_THE_FIT = ("model", "temperatures", "tolerance", "settling_time", "taper_time", "pool", "axes", "beyond")


def _values(texts: Mapping[str, str], label: str) -> dict[str, Any]:
    from imulab.procedures.warmup.fit import check_options

    values = read_options(OPTIONS, texts, label)
    fit = {name: values[name] for name in _OF_THE_FIT}
    fit |= {"settling_limit": values["settling_limit"], "exit": values["exit"]}
    check_options(**{name: value for name, value in fit.items() if name not in ("axes", "settling_limit")})
    return {**values, "fit": fit, "part": part_of(values)}


TASK = Task(
    files="the recordings of its power cycles",
    count=(1, None),
    options=OPTIONS,
    values=_values,
    fit=_fit,
)

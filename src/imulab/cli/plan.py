"""``imulab tumble plan`` and ``thermal plan``: a plan to CSV, sheet and what is printed."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from imulab.atomic_write import replacing
from imulab.cli.options import call, check_outputs
from imulab.errors import OptionError
from imulab.procedures.tumble.model import parameter_units
from imulab.procedures.tumble.plan import roll_pitch
from imulab.procedures.tumble.planned import TumblePlan
from imulab.procedures.tumble.planning import plan_tumble
from imulab.records.json_text import json_text
from imulab.shown import aligned
from imulab.units import STANDARD_GRAVITY
from imulab.writers import write_csv_to

if TYPE_CHECKING:
    from imulab.procedures.thermal.planned import ThermalPlan


def run(*, output: str | None, report: str | None, json: bool, **options: Any) -> None:
    """Plan, print the prediction, and write what was asked for."""
    check_plan_outputs(output, report, [name for name in (options["add"], options["from_"]) if name])
    plan = call(plan_tumble, **options)
    write_plan(plan, output, report)
    if json:
        print(_as_json(plan), end="")
        return
    lead, titles, rows = plan.shown()
    print("\n".join([lead, *aligned(titles, rows)]))
    say_written(output, report)


def check_plan_outputs(output: str | None, report: str | None, inputs: list[str]) -> None:
    """Check before the work that the plan can be written; errors as for `check_outputs`."""
    check_outputs([output, report], inputs)
    if output is not None and not output.lower().endswith(".csv"):
        raise OptionError(f"{output}: expected a name that ends in .csv")


def write_plan(plan: TumblePlan | ThermalPlan, output: str | None, report: str | None) -> None:
    """Write the table and the sheet, both or neither."""
    with ExitStack() as stack:
        to_csv = stack.enter_context(replacing(output)) if output else None
        to_sheet = stack.enter_context(replacing(report)) if report else None
        if to_csv:
            write_csv_to(plan.recording(), to_csv)
        if to_sheet:
            to_sheet.write(plan.sheet().encode("utf-8"))


def say_written(output: str | None, report: str | None) -> None:
    """Say what was written."""
    for name, what in ((output, "plan"), (report, "sheet")):
        if name:
            print(f"{what}: {name}")


def _as_json(plan: TumblePlan) -> str:
    """Return the plan for scripts, in SI under the names of a record."""
    angles = roll_pitch(plan.directions)
    units = parameter_units(plan.order, "m/s^2")
    # A bias in units of g is so many times gravity, a k_n in 1/g^(n-1) so many times its inverse power.
    powers = {"m/s^2": 1, "1/(m/s^2)": -1} | {f"1/(m/s^2)^{n}": -n for n in range(2, plan.order)}
    predicted = plan.uncertainties(plan.noise)
    headings = plan.headings
    attitudes = [
        {"up": up, "roll": {"value": roll, "unit": "rad"}, "pitch": {"value": pitch, "unit": "rad"}}
        for up, (roll, pitch) in zip(plan.directions.tolist(), angles.tolist(), strict=True)
    ]
    parameters = {
        name: {"standard_uncertainty": u * STANDARD_GRAVITY ** powers.get(unit, 0), "unit": unit}
        for (name, u), unit in zip(predicted.items(), units, strict=True)
    }
    if headings is not None:
        for index, (attitude, north) in enumerate(zip(attitudes, headings.north.tolist(), strict=True)):
            attitude |= {"north": north, "facing": headings.facing(index)}
        parameters |= {
            name: {"standard_uncertainty": u, "unit": "1" if name.startswith(("mag_bias", "mag_scale")) else "rad"}
            for name, u in headings.uncertainties().items()
        }
    return json_text(
        {
            "order": plan.order,
            "criterion": plan.criterion,
            "condition_number": float(plan.condition_number),
            "noise": {"value": plan.noise * STANDARD_GRAVITY, "unit": "m/s^2"},
            "already": plan.already,
            "warnings": [] if plan.finding is None else [plan.finding],
            "attitudes": attitudes,
            "again": [list(pair) for pair in plan.again],
            "parameters": parameters,
        }
    )

"""``imulab tumble plan``: options to candidates, plan to CSV and sheet."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import numpy as np

from imulab.calibration import load
from imulab.cli.options import check_outputs, is_json, quantity, whole_number
from imulab.cli.show import aligned
from imulab.errors import ImulabError, OptionError, RecordError
from imulab.files import replacing
from imulab.readers import read
from imulab.recording import Array
from imulab.report import render_plan
from imulab.segment import find_attitudes
from imulab.tumble.engineering import predicted_rows
from imulab.tumble.fit import fit_tumble
from imulab.tumble.plan import Plan, fixture_candidates, head_candidates, plan_tumble, roll_pitch, turning
from imulab.tumble.sheet import attitude_picture, directions_of, plan_recording
from imulab.units import STANDARD_GRAVITY, from_si
from imulab.writers import write_csv_to


def run(
    *,
    order: str,
    attitudes: str,
    output: str | None,
    noise: str,
    criterion: str,
    source: str,
    add: str | None,
    report: str | None,
) -> None:
    """Plan, print the prediction, and write what was asked for."""
    check_outputs([output, report], [name for name in (add, source) if name])
    if output is not None and not output.lower().endswith(".csv"):
        raise OptionError(f"{output}: expected a name that ends in .csv")
    sigma = from_si(quantity(noise, "--noise", "acceleration", "ug"), "g")
    if not sigma > 0:
        raise OptionError(f"--noise {noise!r}: expected more than 0")
    plan = plan_tumble(
        order=whole_number(order, "--order"),
        attitudes=whole_number(attitudes, "--attitudes"),
        criterion=criterion,
        candidates=_candidates(source),
        already=None if add is None else _already(add),
        source=source,
    )
    predicted = predicted_rows(plan.uncertainties(sigma))
    there = f" with the {plan.already} already there" if plan.already else ""
    noise_text = f"{from_si(sigma * STANDARD_GRAVITY, 'ug'):g} µg"
    lead = (
        f"{len(plan.directions)} attitudes{there} for order {plan.order}, criterion {criterion}: condition number "
        f"{plan.condition_number:.1f}, {np.degrees(turning(plan.directions)):.0f} deg of turning. Predicted for a "
        f"noise of {noise_text} in |f| per attitude and a nominal sensor."
    )
    with ExitStack() as stack:
        to_csv = stack.enter_context(replacing(output)) if output else None
        to_sheet = stack.enter_context(replacing(report)) if report else None
        if to_csv:
            write_csv_to(plan_recording(plan), to_csv)
        if to_sheet:
            to_sheet.write(render_plan("Tumble plan", lead, _pictures(plan), predicted).encode("utf-8"))
    print(lead)
    print("\n".join(aligned(["parameter", "predicted u", "unit"], [list(row) for row in predicted])))
    for name, what in ((output, "plan"), (report, "sheet")):
        if name:
            print(f"{what}: {name}")


def _candidates(source: str) -> Array | None:
    if source == "sphere":
        return None
    kind, colon, step = source.partition(":")
    if colon and kind in ("fixture", "head"):
        angle = quantity(step, f"--from {kind}", "angle", "deg")
        return fixture_candidates(angle) if kind == "fixture" else head_candidates(angle)
    if colon and not Path(source).exists():
        raise OptionError(
            f"--from {source!r}: expected sphere, fixture:15, head:15 (steps in deg) or a file of directions"
        )
    found = directions_of(read(source))
    if found is None:
        raise OptionError(f"{source}: expected columns up_x up_y up_z, or roll [deg] and pitch [deg]")
    return found


def _already(file: str) -> Array:
    """Upward directions of a plan, of a record's attitudes, or of a recording's under an order-1 fit."""
    if is_json(file):
        record = load(file)
        if record.procedure != "tumble":
            raise RecordError(f"{file}: a {record.procedure} record holds no attitudes; expected a tumble record")
        force = np.array(record.data["attitudes"]["force"])
    else:
        recording = read(file)
        listed = directions_of(recording)
        if listed is not None:
            return listed
        found = find_attitudes(recording)
        # The directions need no better than a percent, and too few attitudes for a fit are no reason to refuse.
        try:
            force = np.array(fit_tumble(found, order=1).calibration.data["attitudes"]["force"])
        except ImulabError:
            force = found.mean
    directions: Array = force / np.linalg.norm(force, axis=1, keepdims=True)
    return directions


def _pictures(plan: Plan) -> list[dict[str, str]]:
    angles = np.degrees(roll_pitch(plan.directions))
    return [
        {
            "number": str(number),
            "picture": attitude_picture(up),
            "up": "(" + ", ".join(f"{value:+.2f}" for value in up) + ")",
            "roll": f"{roll:.1f}",
            "pitch": f"{pitch:.1f}",
        }
        for number, (up, (roll, pitch)) in enumerate(zip(plan.directions, angles, strict=True), start=1)
    ]

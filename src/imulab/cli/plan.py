"""``imulab tumble plan``: options to candidates, plan to CSV and sheet."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import numpy as np

from imulab.atomic_write import replacing
from imulab.cli.options import check_outputs, is_json, quantity, whole_number
from imulab.errors import ImulabError, OptionError, RecordError
from imulab.procedures.loading import load
from imulab.procedures.tumble.engineering import predicted_rows
from imulab.procedures.tumble.findings import freedom_finding
from imulab.procedures.tumble.fit import fit_tumble
from imulab.procedures.tumble.model import parameter_units
from imulab.procedures.tumble.options import check_method
from imulab.procedures.tumble.plan import Plan, fixture_candidates, head_candidates, plan_tumble, roll_pitch, turning
from imulab.procedures.tumble.sections import attitudes_of, fit_of, model_of
from imulab.procedures.tumble.segment import find_attitudes
from imulab.procedures.tumble.sheet import attitude_picture, directions_of, plan_recording
from imulab.readers import read
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.json_text import json_text
from imulab.report import render_plan
from imulab.shown import aligned
from imulab.units import STANDARD_GRAVITY, from_si
from imulab.writers import write_csv_to


def run(
    *,
    order: str,
    attitudes: str,
    output: str | None,
    noise: str | None,
    criterion: str,
    source: str,
    add: str | None,
    report: str | None,
    method: str,
    distinct_verticals: bool | None,
    json: bool,
) -> None:
    """Plan, print the prediction, and write what was asked for."""
    check_outputs([output, report], [name for name in (add, source) if name])
    if output is not None and not output.lower().endswith(".csv"):
        raise OptionError(f"{output}: expected a name that ends in .csv")
    number = whole_number(order, "--order")
    check_method(method, number)
    sigma, source_of_noise = _noise(noise)
    distinct = method == "linearised" if distinct_verticals is None else distinct_verticals
    plan = plan_tumble(
        order=number,
        attitudes=whole_number(attitudes, "--attitudes"),
        criterion=criterion,
        candidates=_candidates(source),
        already=None if add is None else _already(add),
        source=source,
        distinct_verticals=distinct,
    )
    predicted = predicted_rows(plan.uncertainties(sigma))
    few = freedom_finding(len(plan.directions) + plan.already, len(predicted), plan.order)
    lead = _lead(plan, f"{from_si(sigma * STANDARD_GRAVITY, 'ug'):.4g} µg", source_of_noise, criterion)
    if distinct:
        lead += " Of the new attitudes no two have the same of x, y and z vertical, nor one that had it before."
    if few is not None:
        lead += f" Too few to check the order: {few}."
    with ExitStack() as stack:
        to_csv = stack.enter_context(replacing(output)) if output else None
        to_sheet = stack.enter_context(replacing(report)) if report else None
        if to_csv:
            write_csv_to(plan_recording(plan), to_csv)
        if to_sheet:
            to_sheet.write(render_plan("Tumble plan", lead, _pictures(plan), predicted).encode("utf-8"))
    if json:
        print(_as_json(plan, criterion, sigma, few), end="")
        return
    print(lead)
    print("\n".join(aligned(["parameter", "predicted u", "unit"], [list(row) for row in predicted])))
    for name, what in ((output, "plan"), (report, "sheet")):
        if name:
            print(f"{what}: {name}")


def _lead(plan: Plan, noise: str, source_of_noise: str, criterion: str) -> str:
    """Return what a plan is and predicts, and why it differs from what was asked for."""
    there = f" with the {plan.already} already there" if plan.already else ""
    lead = (
        f"{len(plan.directions)} attitudes{there} for order {plan.order}, criterion {criterion}: condition number "
        f"{plan.condition_number:.1f}, {np.degrees(turning(plan.directions)):.0f} deg of turning. Predicted for a "
        f"noise of {noise} in |f| per attitude{source_of_noise} and a nominal sensor."
    )
    if plan.order == 3:
        lead += " Order 3 because attitudes for a lower one cannot show what that would leave in the scale factors."
    if plan.again:
        pairs = ", ".join(f"{one} and {other}" for one, other in plan.again)
        lead += (
            f" Put down twice: {pairs}. No more candidates lie 3 deg apart; the second time, after the others, lowers "
            "the noise and shows what drifts, but no new direction."
        )
    return lead


def _as_json(plan: Plan, criterion: str, sigma: float, few: str | None) -> str:
    """Return the plan for scripts, in SI under the names of a record."""
    angles = roll_pitch(plan.directions)
    units = parameter_units(plan.order, "m/s^2")
    # A bias in units of g is so many times gravity, a k_n in 1/g^(n-1) so many times its inverse power.
    powers = {"m/s^2": 1, "1/(m/s^2)": -1} | {f"1/(m/s^2)^{n}": -n for n in range(2, plan.order)}
    predicted = plan.uncertainties(sigma)
    return json_text(
        {
            "order": plan.order,
            "criterion": criterion,
            "condition_number": float(plan.condition_number),
            "noise": {"value": sigma * STANDARD_GRAVITY, "unit": "m/s^2"},
            "already": plan.already,
            "warnings": [] if few is None else [few],
            "attitudes": [
                {"up": up, "roll": {"value": roll, "unit": "rad"}, "pitch": {"value": pitch, "unit": "rad"}}
                for up, (roll, pitch) in zip(plan.directions.tolist(), angles.tolist(), strict=True)
            ],
            "again": [list(pair) for pair in plan.again],
            "parameters": {
                name: {"standard_uncertainty": u * STANDARD_GRAVITY ** powers.get(unit, 0), "unit": unit}
                for (name, u), unit in zip(predicted.items(), units, strict=True)
            },
        }
    )


def _noise(text: str | None) -> tuple[float, str]:
    """Noise of |f| in one attitude, g: a quantity, or what the attitudes of a recording or record have; and whose."""
    if text is None:
        raise OptionError(
            "--noise: expected the noise of |f| in one attitude, such as 20ug, or a recording or record that has it"
        )
    if not Path(text).is_file():
        sigma = from_si(quantity(text, "--noise", "acceleration", "ug"), "g")
        if not sigma > 0:
            raise OptionError(f"--noise {text!r}: expected more than 0")
        return sigma, ""
    if is_json(text):
        record = load(text)
        if record.procedure != "tumble":
            raise RecordError(f"{text}: a {record.procedure} record holds no attitudes; expected a tumble record")
        return _noise_of(record), f" (that of {text})"
    found = find_attitudes(read(text))
    if found.covariance is None:
        raise OptionError(f"{text}: a table without std_* columns does not say what noise its attitudes have")
    try:
        return _noise_of(fit_tumble(found).calibration), f" (that of {text})"
    except ImulabError:  # too few for a fit: any direction and length are good enough for a noise
        up = found.mean / np.linalg.norm(found.mean, axis=1, keepdims=True)
        variance = np.einsum("ni,nij,nj->n", up, found.covariance, up) / (found.mean**2).sum(axis=1)
        return float(np.sqrt(np.median(variance))), f" (that of {text})"


def _noise_of(record: Calibration) -> float:
    """Noise of |f| in the usual attitude of a record, with what they scatter beyond their own, g."""
    stated, fit, g = attitudes_of(record).standard_uncertainty, fit_of(record), model_of(record).gravity.value
    if stated:
        return float(np.hypot(np.median(stated), fit.excess.value)) / g
    reduced = fit.reduced_chi_square
    if not reduced:
        raise RecordError("--noise: the record's attitudes do not say what noise they have; expected a value, as 20ug")
    return float(np.sqrt(reduced)) / g


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
        held = attitudes_of(record)
        force = np.array(held.force)[np.array(held.down_weight) > 0]
    else:
        recording = read(file)
        listed = directions_of(recording)
        if listed is not None:
            return listed
        found = find_attitudes(recording)
        # The directions need no better than a percent, and too few attitudes for a fit are no reason to refuse.
        try:
            force = np.array(attitudes_of(fit_tumble(found, order=1).calibration).force)
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

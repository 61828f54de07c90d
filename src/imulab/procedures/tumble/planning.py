"""A plan from what people have: noise, candidates and earlier attitudes as numbers, texts, files, records or arrays."""

from __future__ import annotations

import os
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from imulab.errors import ImulabError, OptionError, RecordError
from imulab.procedures.inputs import as_recording
from imulab.procedures.loading import load
from imulab.procedures.tumble import plan
from imulab.procedures.tumble.choices import STARTS
from imulab.procedures.tumble.fit import fit_tumble
from imulab.procedures.tumble.mag.headings import plan_headings
from imulab.procedures.tumble.mag.pointing import world_axes
from imulab.procedures.tumble.options import check_method
from imulab.procedures.tumble.plan import Plan, fixture_candidates, head_candidates
from imulab.procedures.tumble.planned import TumblePlan
from imulab.procedures.tumble.sections import attitudes_of, data_of, fit_of, model_of
from imulab.procedures.tumble.segment import find_attitudes
from imulab.procedures.tumble.sheet import directions_of, norths_of
from imulab.quantities import in_si, quantity, whole
from imulab.reading import Data
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.recognition import is_json
from imulab.units import from_si

Known: TypeAlias = Calibration | Data


def plan_tumble(
    attitudes: int | str,
    *,
    noise: float | Known | None = None,
    order: int | str = 3,
    criterion: str = "A",
    from_: Data = "sphere",
    add: Known | Plan | None = None,
    method: str = "norm",
    distinct_verticals: bool | None = None,
    with_: str | None = None,
) -> TumblePlan:
    """Choose the attitudes to measure, and predict the uncertainty of every parameter.

    Criterion A minimises the sum of the parameters' variances (in units of g), D the volume of their confidence region.
    Of sets whose sums are within 1 % of the least, A takes that whose worst axes have the least sum. Where fewer
    candidates lie 3 deg apart than attitudes are asked for, some are put down again, those first that gain most.

    Parameters
    ----------
    attitudes
        Number of attitudes to choose.
    noise
        Of ``|f|`` in one attitude: m/s^2, or a text such as ``"20ug"``; or the recording or record, or its file, that
        has it.
    order
        Order of the model, 0 to 5; attitudes for order 3 show what an order 2 would silently leave in scale factors.
    criterion
        ``"A"`` or ``"D"``.
    from_
        Where attitudes may lie: ``sphere``, ``fixture:15`` or ``head:15`` (steps in deg), a file that lists them, or
        upward directions in the body frame, shape (m, 3).
    add
        Attitudes already there: a plan, a record or a recording, or its file; or upward directions, shape (k, 3).
    method
        Of the fit that they are for: ``norm`` or ``linearised``.
    distinct_verticals
        Whether x, y and z are each vertical, up or down, in one attitude at most, as the source of method linearised
        has it; as `method` demands if not given.
    with_
        ``"mag"``: each attitude gets a heading too, in quarter turns, for the magnetometers beside the accelerometers;
        of `add` the headings of a plan with headings, or of a record with magnetometers, count.

    Raises
    ------
    OptionError
        An option cannot be; too few or too many attitudes, too few candidates or none far enough apart.
    ObservabilityError
        No choice among the candidates determines the model, or no headings the magnetometers.
    RecordError, ReadError, DataError
        A record or recording cannot be read, or does not say what it is asked.

    Examples
    --------
    >>> import imulab as il
    >>> plan = il.plan_tumble(18, noise="20ug", order=2, from_="fixture:45")
    >>> len(plan.directions), round(plan.condition_number, 1)
    (18, 5.8)
    >>> plan.save("plan.csv")
    >>> plan.report("plan.html")
    >>> il.plan_tumble(16, noise="20ug", order=1, with_="mag").headings.facing(0)
    '+y to the east'
    """
    number = whole(order, "order")
    check_method(method, number)
    if with_ not in (None, "mag"):
        raise OptionError(f"with_ {with_!r}: expected mag: only magnetometers ask for headings")
    sigma, source = noise_of(noise)
    distinct = method == "linearised" if distinct_verticals is None else distinct_verticals
    found = plan.plan_tumble(
        order=number,
        attitudes=whole(attitudes, "attitudes"),
        criterion=criterion,
        candidates=candidates_of(from_),
        already=None if add is None else _measured_directions(add),
        source=from_ if isinstance(from_, str) else "from_",
        distinct_verticals=distinct,
    )
    headings = None
    if with_ is not None:
        headings = plan_headings(found.directions, before=None if add is None else _measured_headings(add))
    return TumblePlan(
        **vars(found), criterion=criterion, noise=sigma, noise_from=source, distinct_verticals=distinct,
        headings=headings,
    )  # fmt: skip


def _record(data: object) -> Calibration | None:
    """Return a tumble record, given or named; None for what is none."""
    name = os.fspath(data) if isinstance(data, str | PathLike) else "the record"
    if isinstance(data, str | PathLike) and is_json(name):
        data = load(name)
    if not isinstance(data, Calibration):
        return None
    if data.procedure != "tumble":
        raise RecordError(f"{name}: a {data.procedure} record holds no attitudes; expected a tumble record")
    return data


def noise_of(given: Any) -> tuple[float, str]:
    """Noise of |f| in one attitude, g: a quantity, or what the attitudes of a recording or record have; and whose."""
    if given is None:
        raise OptionError(
            "noise: expected the noise of |f| in one attitude, such as 20ug, or a recording or record that has it"
        )
    if isinstance(given, float | int) or (isinstance(given, str) and not Path(given).is_file()):
        sigma = from_si(in_si(given, "noise", "acceleration", "ug"), "g")
        if not sigma > 0:
            raise OptionError(f"noise {given!r}: expected more than 0")
        return sigma, ""
    record = _record(given)
    if record is not None:
        whose = os.fspath(given) if isinstance(given, str | PathLike) else "the record"
        return _noise_of(record), f" (that of {whose})"
    found = find_attitudes(as_recording(given, {}, plan_tumble, name="noise"))
    whose = f" (that of {os.fspath(given) if isinstance(given, str | PathLike) else found.recording.name})"
    if found.covariance is None:
        name = found.recording.name
        raise OptionError(f"{name}: a table without std_* columns does not say what noise its attitudes have")
    try:
        return _noise_of(fit_tumble(found).calibration), whose
    except ImulabError:  # too few for a fit: any direction and length are good enough for a noise
        up = found.mean / np.linalg.norm(found.mean, axis=1, keepdims=True)
        variance = np.einsum("ni,nij,nj->n", up, found.covariance, up) / (found.mean**2).sum(axis=1)
        return float(np.sqrt(np.median(variance))), whose


def _noise_of(record: Calibration) -> float:
    """Noise of |f| in the usual attitude of a record, with what they scatter beyond their own, g."""
    stated, fit, g = attitudes_of(record).standard_uncertainty, fit_of(record), model_of(record).gravity.value
    if stated:
        return float(np.hypot(np.median(stated), fit.excess.value)) / g
    reduced = fit.reduced_chi_square
    if not reduced:
        raise RecordError("noise: the record's attitudes do not say what noise they have; expected a value, as 20ug")
    return float(np.sqrt(reduced)) / g


def candidates_of(given: Any) -> Array | None:
    """Return the upward directions among which a plan chooses, as ``--from`` names them; None for the whole sphere."""
    if isinstance(given, str):
        if given == STARTS[0]:
            return None
        kind, colon, step = given.partition(":")
        if colon and kind in ("fixture", "head"):
            angle = quantity(step, f"from_ {kind}", "angle", "deg")
            return fixture_candidates(angle) if kind == "fixture" else head_candidates(angle)
        if colon and not Path(given).exists():
            raise OptionError(f"from_ {given!r}: expected {', '.join(STARTS)} (steps in deg) or a file of directions")
    if isinstance(given, np.ndarray | list | tuple):
        return _units(given, "from_")
    recording = as_recording(given, {}, plan_tumble, name="from_")
    found = directions_of(recording)
    if found is None:
        raise OptionError(f"{recording.name}: expected columns up_x up_y up_z, or roll [deg] and pitch [deg]")
    return found


def _units(given: object, name: str) -> Array:
    """Return directions as unit vectors, shape (n, 3)."""
    try:
        found = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        found = np.empty(0)
    length = np.linalg.norm(found, axis=-1, keepdims=True)
    if found.ndim != 2 or found.shape[1] != 3 or not (np.isfinite(length) & (length > 0)).all():
        raise OptionError(f"{name}: expected upward directions, shape (n, 3), found the shape {found.shape}")
    units: Array = found / length
    return units


def _measured_directions(given: Any) -> Array:
    """Upward directions of a plan, of a record's attitudes, or of a recording's under an order-1 fit."""
    if isinstance(given, Plan):
        return given.directions
    if isinstance(given, np.ndarray | list | tuple):
        return _units(given, "add")
    record = _record(given)
    if record is not None:
        held = attitudes_of(record)
        force = np.array(held.force)[np.array(held.down_weight) > 0]
    else:
        recording = as_recording(given, {}, plan_tumble, name="add")
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


def _measured_headings(given: Any) -> tuple[Array, Array] | None:
    """Upward directions and those of north of a plan with headings or a record with magnetometers; None of others."""
    if isinstance(given, TumblePlan):
        return None if given.headings is None else (given.directions, given.headings.north)
    if isinstance(given, Plan | np.ndarray | list | tuple):
        return None
    record = _record(given)
    if record is None:
        recording = as_recording(given, {}, plan_tumble, name="add")
        up, north = directions_of(recording), norths_of(recording)
        return None if up is None or north is None else (up, north)
    held = data_of(record).mag
    if held is None:
        return None
    axes = world_axes(np.array(held.field)[held.used], np.array(held.force)[held.used])
    return axes[:, 2], axes[:, 1]

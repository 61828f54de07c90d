"""An accelerometer triad from one recording or table of attitudes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from imulab.errors import DataError, OptionError, RecordError
from imulab.procedures.procedure import Files, Task
from imulab.quantities import chosen, quantity, whole_number
from imulab.units import STANDARD_GRAVITY

if TYPE_CHECKING:
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration


_CHANGES = (("number", "ppm"), ("acceleration", "ug"), ("angle", "arcsec"))


def _tumble_values(texts: Mapping[str, str], label: str) -> dict[str, Any]:
    from imulab.gravity import gravity_option
    from imulab.procedures.tumble.options import check_options

    order = texts.get("order", "auto")
    trials = texts.get("monte_carlo")
    values: dict[str, Any] = {
        "order": int(order) if order.isascii() and order.isdecimal() and len(order) < 3 else order,
        "method": texts.get("method", "norm"),
        "loss": texts.get("loss", "auto"),
        "nonlinearity": _spread(texts.get("nonlinearity"), label.format("nonlinearity")),
        "gravity": gravity_option(texts.get("gravity"), texts.get("latitude"), texts.get("height"), label),
        "monte_carlo": None if trials is None else whole_number(trials, label.format("monte-carlo")),
        "prior": texts.get("prior"),
        "ageing": _ageing(texts.get("ageing"), label.format("ageing")),
        "cross": _yes(texts.get("cross", "no"), label.format("cross")),
        "threshold": _threshold(texts.get("threshold"), label.format("threshold")),
        "layout": texts.get("layout"),
        "part": chosen(*(texts.get(key) for key in ("topic", "instance", "window", "element")), label=label),
    }
    check_options(
        values["order"], values["method"], values["loss"],
        monte_carlo=values["monte_carlo"], with_prior=values["prior"] is not None, ageing=values["ageing"],
        nonlinearity=values["nonlinearity"], cross=values["cross"], threshold=values["threshold"],
    )  # fmt: skip
    return values


def _yes(text: str, name: str) -> bool:
    if text not in ("yes", "no"):
        raise OptionError(f"{name} {text!r}: expected yes or no")
    return text == "yes"


def _tumble_fit(
    files: Sequence[str], values: Mapping[str, Any], access: Files, progress: Callable[[int], None]
) -> Calibration:
    from imulab.procedures.tumble.fit import fit_tumble
    from imulab.procedures.tumble.segment import find_attitudes

    recording = access.recording(files[0], values["layout"], **values["part"])
    prior = None if values["prior"] is None else _prior(values["prior"], recording, access)
    attitudes = find_attitudes(recording)
    return fit_tumble(
        attitudes,
        order=values["order"],
        gravity=values["gravity"],
        method=values["method"],
        loss=values["loss"],
        nonlinearity=values["nonlinearity"],
        prior=prior,
        ageing=values["ageing"],
        monte_carlo=values["monte_carlo"],
        cross=values["cross"],
        threshold=values["threshold"],
        progress=progress,
    ).calibration


def _ageing(text: str | None, name: str) -> tuple[float, ...]:
    """Standard deviations of what biases, scale factors and misalignments changed, in SI, as many as are given."""
    if text is None:
        return ()
    kinds = (("acceleration", "ug"), ("number", "ppm"), ("angle", "urad"))
    parts = text.split(",")
    if len(parts) > len(kinds):
        raise OptionError(f"{name} {text!r}: expected up to three, as in 100ug,100ppm,50urad")
    return tuple(quantity(part, name, *kind) for part, kind in zip(parts, kinds, strict=False))


def _threshold(text: str | None, name: str) -> tuple[float, ...] | None:
    """Changes of scale factors, biases and misalignments at which method linearised rests, in SI."""
    if text is None:
        return None
    parts = text.split(",")
    if len(parts) != len(_CHANGES):
        raise OptionError(
            f"{name} {text!r}: expected three changes, of scale factors, biases and misalignments, such as "
            "5ppm,2ug,3arcsec"
        )
    found = tuple(quantity(part.strip(), name, *kind) for part, kind in zip(parts, _CHANGES, strict=True))
    if not all(0 < value < math.inf for value in found):
        raise OptionError(f"{name} {text!r}: expected three finite changes above 0")
    return found


def _spread(text: str | None, option: str) -> tuple[float, float] | None:
    """Return the standard deviations of k2 and k3 in units of 1/g and 1/g^2: ``20ug,20ug`` is 20 ug/g^2, 20 ug/g^3."""
    if text is None:
        return None
    parts = text.split(",")
    if len(parts) != 2:
        raise OptionError(f"{option} {text!r}: expected two standard deviations, of k2 and k3, such as 20ug,20ug")
    first, second = (quantity(part.strip(), option, "acceleration", "ug") / STANDARD_GRAVITY for part in parts)
    return first, second


def _prior(file: str, recording: Recording, access: Files) -> Calibration:
    """Read a record that can be a prior for this recording."""
    from imulab.procedures.tumble.checks import check_prior, made_from

    record = access.record(file)
    try:
        check_prior(record)
    except RecordError as error:
        raise RecordError(f"{file}: {error}") from None
    unit, needed = recording.triad_unit("accel"), record.model["output_unit"]
    if unit != needed:
        raise RecordError(f"{file}: the prior has outputs in {needed}, {recording.name} in {unit}")
    if made_from(record, recording):
        raise DataError(f"{recording.name}: the prior {file} was made from this recording, which would count twice")
    return record


TASK = Task(
    files="one recording or table of attitudes",
    count=(1, 1),
    options=(
        "order",
        "method",
        "gravity",
        "latitude",
        "height",
        "loss",
        "nonlinearity",
        "monte_carlo",
        "prior",
        "ageing",
        "cross",
        "threshold",
        "layout",
        "topic",
        "instance",
        "window",
        "element",
    ),
    paths=("prior", "layout"),
    modules=("imulab.readers", "imulab.procedures.tumble.segment", "imulab.procedures.tumble.fit", "scipy.special"),
    values=_tumble_values,
    fit=_tumble_fit,
)

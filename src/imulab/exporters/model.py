"""The record whose triads a target can hold, the terms that it leaves out, and the error that this makes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from imulab._version import VERSION
from imulab.errors import OptionError, RecordError
from imulab.exporters import ExportOptions
from imulab.files import write_text
from imulab.procedures.registry import PROCEDURES, procedure_of
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.triads import CROSS_TERMS, Accelerometers, Gyroscopes, Magnetometers, text_in_g
from imulab.units import STANDARD_GRAVITY

AXES = "xyz"
NEGLIGIBLE = 1e-6  # of g: smaller terms are left out without a comment
_GRID = np.linspace(-STANDARD_GRAVITY, STANDARD_GRAVITY, 21)


@dataclass(frozen=True)
class UnitModel:
    """The triads of one unit, and the record they come from."""

    record: Calibration
    accel: Accelerometers
    gyro: Gyroscopes | None
    mag: Magnetometers | None

    @property
    def origin(self) -> list[str]:
        """Origin of the numbers, for the comments of a file."""
        return origin_of(self.record)


def origin_of(record: Calibration) -> list[str]:
    """Return the program that wrote the file, the unit, and the record, for a comment."""
    content = record.to_dict()["content_sha256"]
    serial = record.sensor.get("serial", "without serial number")
    return [
        f"written by imulab {VERSION} for unit {serial}",
        f"from the record of {record.created}, content_sha256 {content}",
    ]


def one_unit(records: Sequence[Calibration], target: str) -> UnitModel:
    """Return the triads of the one record among the records, of a procedure that states triads.

    Raises
    ------
    OptionError
        There is another record, which the target cannot hold, or not exactly one.
    RecordError
        The record lacks a parameter.
    """
    for record in records:
        procedure = procedure_of(record)
        if not procedure.states_triads:
            reason = procedure.elsewhere.format(target=target)
            instead = "; use --to c or --to blob" if procedure.sections else ""
            raise OptionError(f"{target}: a {record.procedure} record cannot be exported: {reason}{instead}")
    if len(records) != 1:
        known = " or ".join(procedure.name for procedure in PROCEDURES.values() if procedure.states_triads)
        raise OptionError(f"{target}: expected one {known} record, found {len(records)}")
    (record,) = records
    try:
        triads = procedure_of(record).triads(record)
    except RecordError as error:
        raise RecordError(f"{target}: {error}") from None
    return UnitModel(record, triads.accel, triads.gyro, triads.mag)


def magnetometers_alone(records: Sequence[Calibration], target: str) -> tuple[Calibration, Magnetometers] | None:
    """Return the one record and its magnetometers where it holds them alone, else None.

    Raises
    ------
    RecordError
        The record lacks a parameter, or is of a level turn.
    """
    if len(records) != 1:
        return None
    try:
        mag = procedure_of(records[0]).magnetometers(records[0])
    except RecordError as error:
        raise RecordError(f"{target}: {error}") from None
    return None if mag is None else (records[0], mag)


ROTATION_NOT_TOLD = "how the magnetometers are turned against the body is not told, and not written: set it by hand"


def refuse_raw(unit: UnitModel, target: str) -> None:
    """Refuse a record of outputs in counts or volts.

    Raises
    ------
    OptionError
        It is one; the message names the unit.
    """
    for sensors, triad in (("accelerometers", unit.accel), ("gyroscopes", unit.gyro)):
        if triad is not None:
            check_si(target, sensors, triad.unit)


def check_si(target: str, sensors: str, unit: str) -> None:
    """Refuse accelerometers or gyroscopes with outputs that are not in SI; errors as for `refuse_raw`."""
    if unit not in ("m/s^2", "rad/s"):
        raise OptionError(
            f"{target}: corrects outputs in {'m/s^2' if sensors == 'accelerometers' else 'rad/s'}, but the record is "
            f"for {sensors} with outputs in {unit}; fit a log of the autopilot itself, or export to c or blob, which "
            f"take outputs in {unit}"
        )


# --- what is lost --------------------------------------------------------------------------------------------------


def accel_loss(accel: Accelerometers, correct: Callable[[Array], Any]) -> float:
    """Return the largest error, m/s^2, of a target's correction over specific forces of +-1 g on each axis."""
    force = np.stack(np.meshgrid(_GRID, _GRID, _GRID, indexing="ij"), axis=-1).reshape(-1, 3)
    return float(np.abs(correct(accel.output(force)) - force).max())


def inverse_gain(held: Accelerometers) -> Callable[[Array], Array]:
    """Return the correction of a target with a full matrix and a bias: ``(S T)^-1 (output - S b)``."""
    inverse = np.linalg.inv(held.gain).T
    return lambda output: (output - held.scale * held.bias) @ inverse


def held_accelerometers(
    unit: UnitModel, correction: Callable[[Accelerometers], Callable[[Array], Any]], *, misalignment: bool
) -> tuple[Accelerometers, float, list[str]]:
    """Return the linear model for a target: the record's, or one fitted again where the target leaves out more.

    Parameters
    ----------
    unit
        Whose record may have nonlinearity (and misalignment) that the target has not.
    correction
        From a linear model to what the target makes of outputs, shape (n, 3), with it.
    misalignment
        Whether the target holds misalignment.

    Returns
    -------
    tuple
        The model; the largest error, m/s^2, against the record's within +-1 g; and comments on how it was found.
    """
    accel = unit.accel
    error = accel_loss(accel, correction(accel))
    if error <= NEGLIGIBLE * STANDARD_GRAVITY:
        return accel, error, []
    what = "bias, scale factor and misalignment" if misalignment else "bias and scale factor"
    fit = procedure_of(unit.record).linear_fit(unit.record, misalignment=misalignment)
    held = fit.accel or accel
    return held, accel_loss(accel, correction(held)), [f"{what} {fit.remark}"]


def accel_terms(accel: Accelerometers, *, misalignment: bool) -> list[str]:
    """Return the names of the accelerometers' parameters that a target leaves out."""
    names = []
    if misalignment and np.abs(accel.matrix - np.eye(3)).max() > 0:
        names += [f"misalignment_{AXES[i]}{AXES[j]}" for i, j in ((1, 0), (2, 0), (2, 1)) if accel.matrix[i, j] != 0]
    names += [
        f"k{power + 2}_{axis}"
        for power, row in enumerate(accel.nonlinearity)
        for axis, k in zip(AXES, row, strict=True)
        if k
    ]
    names += [name for name, k in zip(CROSS_TERMS, accel.cross, strict=True) if k]
    return names


def gyro_terms(gyro: Gyroscopes, *, bias: bool) -> tuple[list[str], list[str]]:
    """Return the names of the gyroscopes' parameters that a target without gain (or bias) leaves out, and the error.

    Returns
    -------
    tuple
        Names; and a phrase for each kind of error that they would leave.
    """
    names, costs = [], []
    share = float(np.abs(gyro.gain - np.eye(3)).sum(axis=1).max()) if gyro.unit == "rad/s" else np.inf
    if share > NEGLIGIBLE:
        names += ["gyro_scale_factor", "gyro_misalignment"]
        costs.append(
            f"up to {100 * share:.3g} % of the rate" if np.isfinite(share) else "as much as the gyroscopes' scale"
        )
    drift = float((np.abs(gyro.sensitivity).sum(axis=1) * STANDARD_GRAVITY).max())
    if drift > 0:
        names.append("gyro_g_sensitivity")
        costs.append(f"up to {np.degrees(drift):.3g} deg/s within +-1 g")
    bent, cost = gyro_powers_lost(gyro)
    names, costs = names + bent, costs + cost
    if bias and np.abs(gyro.bias).max() > 0:
        names.append("gyro_bias")
        costs.append(f"up to {np.degrees(np.abs(gyro.bias).max()):.3g} deg/s of bias")
    return names, costs


def gyro_powers_lost(gyro: Gyroscopes) -> tuple[list[str], list[str]]:
    """Return the powers of the rate, which no target holds, and their largest error within +-300 deg/s."""
    rate = np.radians(300.0) * np.array([[-1.0], [1.0]])
    left = sum((k * rate ** (power + 2) for power, k in enumerate(gyro.nonlinearity)), start=np.zeros((2, 3)))
    names = [f"gyro_k{power + 2}" for power, k in enumerate(gyro.nonlinearity) if k.any()]
    return names, [f"up to {np.degrees(np.abs(left).max()):.3g} deg/s within +-300 deg/s"] if names else []


def settle_losses(
    target: str,
    accel: tuple[list[str], float],
    gyro: tuple[list[str], list[str]] = ([], []),
    *,
    how: Sequence[str] = (),
    options: ExportOptions,
) -> list[str]:
    """Refuse losses, or return and report the comments on them.

    Parameters
    ----------
    accel
        Names of the accelerometers' parameters that are left out, and the largest error that this causes, m/s^2.
    gyro
        Names of the gyroscopes', and phrases for the errors.
    how
        Comments on what was done about it.
    options
        Whether anything may be lost, and who is told.

    Raises
    ------
    OptionError
        Something that matters would be lost, and that was not asked for.
    """
    names, costs = list(gyro[0]), list(gyro[1])
    if accel[0] and accel[1] > NEGLIGIBLE * STANDARD_GRAVITY:
        names = accel[0] + names
        costs.insert(0, f"up to {text_in_g(accel[1])} within +-1 g")
    if not costs:
        return []
    what = f"{' '.join(names)}, which changes outputs by {', '.join(costs)}"
    if not options.lossy:
        raise OptionError(f"{target} cannot hold {what}; add --lossy to leave it out")
    comments = [f"left out (lossy): {what}", *how]
    for comment in comments:
        options.tell(f"{target}: {comment}")
    return comments


# --- writing -------------------------------------------------------------------------------------------------------


def write_one(folder: Path, name: str, lines: Sequence[str]) -> list[Path]:
    """Write the single file of a target, in a folder that is made if it does not exist.

    Raises
    ------
    OptionError
        It cannot be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OptionError(f"{folder}: cannot be made: {error.strerror}") from None
    file = folder / name
    write_text(file, "\n".join(lines) + "\n")
    return [file]


def single_precision(value: float) -> str:
    """Return a parameter as the shortest plain decimal that gives its nearest single-precision number."""
    return np.format_float_positional(np.float32(value), unique=True, trim="0")


def yaml_number(value: Any) -> str:
    """Return a number in YAML 1.1: ``4.0e-06``, because ``4e-06`` would be a text."""
    text = repr(float(value) + 0.0)
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def yaml_matrix(matrix: Array, indent: str) -> list[str]:
    """Return the rows of a matrix as lines of YAML."""
    return [f"{indent}- [{', '.join(yaml_number(value) for value in row)}]" for row in matrix]


def lower_times_rotation(matrix: Array) -> tuple[Array, Array]:
    """Return L and C with ``matrix = L C``: L lower triangular, C a rotation or its product with -1.

    From the QR decomposition of the transpose (G. H. Golub and C. F. Van Loan, Matrix Computations, 5.2); signs are
    chosen so that C is nearest to the identity.
    """
    q, r = np.linalg.qr(matrix.T)
    sign = np.where(np.diag(q) < 0, -1.0, 1.0)
    return np.tril((sign[:, None] * r).T), sign[:, None] * q.T

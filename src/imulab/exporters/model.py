"""A tumble record as matrices, what a target leaves out of it, and what that costs.

Accelerometers: ``s = T f``, ``A = s + k2 s^2 + ...``, ``M = S (A + b)``. Gyroscopes: ``M = S (T w + G f + b)``.
Outputs M are in SI, or in counts or volts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from imulab._version import VERSION
from imulab.atomic_write import write_text
from imulab.errors import OptionError, RecordError
from imulab.exporters import ExportOptions
from imulab.printable import printable
from imulab.procedures.registry import procedure_of
from imulab.procedures.tumble.sections import data_of, fit_of, model_of
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.report.elements import plain_number
from imulab.units import STANDARD_GRAVITY, conversion_factor, parse_unit

AXES = "xyz"
_CROSS = ("k_xy", "k_yz", "k_zx")
_NEGLIGIBLE = 1e-6
_GRID = np.linspace(-STANDARD_GRAVITY, STANDARD_GRAVITY, 21)


@dataclass(frozen=True)
class Gyroscopes:
    """``M = S (T w + G f + b)``: scale factor (3,), matrix T (3, 3), g-sensitivity G (3, 3), bias (3,), unit of M."""

    scale: Array
    matrix: Array
    sensitivity: Array
    bias: Array
    unit: str

    @property
    def gain(self) -> Array:
        """``S T``: output per rate, shape (3, 3)."""
        return self.scale[:, None] * self.matrix


@dataclass(frozen=True)
class Accelerometers:
    """``M = S (A + b)``: scale factor (3,), lower-triangular T (3, 3), bias (3,), k2 .. ke (e - 1, 3), unit of M.

    With cross terms k_xy, k_yz, k_zx (3,) in A.
    """

    scale: Array
    matrix: Array
    bias: Array
    nonlinearity: Array
    cross: Array
    unit: str

    @property
    def gain(self) -> Array:
        """``S T``: output per specific force, shape (3, 3)."""
        return self.scale[:, None] * self.matrix

    def output(self, force: Array) -> Array:
        """Return the outputs for specific forces, m/s^2, shape (n, 3)."""
        sensed = force @ self.matrix.T
        reading = sensed + sum(k * sensed ** (power + 2) for power, k in enumerate(self.nonlinearity))
        reading = reading + self.cross * sensed * np.roll(sensed, -1, axis=1)
        output: Array = self.scale * (reading + self.bias)
        return output


@dataclass(frozen=True)
class UnitModel:
    """The triads of one unit, and the record they come from."""

    record: Calibration
    accel: Accelerometers
    gyro: Gyroscopes | None

    @property
    def origin(self) -> list[str]:
        """Where the numbers come from, for the comments of a file."""
        content = self.record.to_dict()["content_sha256"]
        serial = printable(str(self.record.sensor.get("serial", "without serial number")))
        return [
            f"written by imulab {VERSION} for unit {serial}",
            f"from the record of {printable(self.record.created)}, content_sha256 {content}",
        ]


def one_unit(records: Sequence[Calibration], target: str) -> UnitModel:
    """Return the triads of the one tumble record among the records.

    Raises
    ------
    OptionError
        There is another record, which the target cannot hold, or not exactly one.
    RecordError
        The record lacks a parameter.
    """
    for record in records:
        reason = procedure_of(record).elsewhere
        if reason is not None:
            instead = "; use --to c or --to blob" if procedure_of(record).sections else ""
            raise OptionError(
                f"{target}: a {record.procedure} record cannot be exported: {reason.format(target=target)}{instead}"
            )
    if len(records) != 1:
        raise OptionError(f"{target}: expected one tumble record, found {len(records)}")
    (record,) = records
    try:
        return UnitModel(record, _accelerometers(record), _gyroscopes(record))
    except RecordError as error:
        raise RecordError(f"{target}: {error}") from None


def _accelerometers(record: Calibration) -> Accelerometers:
    model = model_of(record)
    factor, kept = _to_si(model.output_unit, "m/s^2")
    matrix = np.eye(3)
    for i, j in ((1, 0), (2, 0), (2, 1)):
        matrix[i, j] = record.value(f"misalignment_{AXES[i]}{AXES[j]}")
    order = model.order
    terms = [[record.value(f"k{power}_{axis}") for axis in AXES] for power in range(2, order + 1)]
    return Accelerometers(
        scale=np.array([record.value(f"scale_factor_{axis}") for axis in AXES]) * factor,
        matrix=matrix,
        bias=np.array([record.value(f"bias_{axis}") for axis in AXES]),
        nonlinearity=np.array(terms).reshape(-1, 3),
        cross=np.array([record.value(name) for name in _CROSS]) if _CROSS[0] in record.parameters else np.zeros(3),
        unit=kept,
    )


def _gyroscopes(record: Calibration) -> Gyroscopes | None:
    if "gyro_output_unit" not in record.model:
        return None
    factor, kept = _to_si(model_of(record).gyro_output_unit, "rad/s")
    matrix, sensitivity = np.eye(3), np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            pair = AXES[i] + AXES[j]
            if i != j:
                matrix[i, j] = record.value(f"gyro_misalignment_{pair}")
            if "gyro_g_sensitivity_xx" in record.parameters:
                sensitivity[i, j] = record.value(f"gyro_g_sensitivity_{pair}")
    return Gyroscopes(
        scale=np.array([record.value(f"gyro_scale_factor_{axis}") for axis in AXES]) * factor,
        matrix=matrix,
        sensitivity=sensitivity,
        bias=np.array([record.value(f"gyro_bias_{axis}") for axis in AXES]),
        unit=kept,
    )


def _to_si(unit: str, si: str) -> tuple[float, str]:
    """Return the factor from outputs to SI, and the unit that they then have; counts and volts stay."""
    if parse_unit(unit).quantity == "output":
        return 1.0, parse_unit(unit).symbol
    return conversion_factor(unit, si), si


def refuse_raw(unit: UnitModel, target: str) -> None:
    """Refuse a record of outputs in counts or volts.

    Raises
    ------
    OptionError
        It is one; the message names the unit.
    """
    for sensor, triad in (("accelerometers", unit.accel), ("gyroscopes", unit.gyro)):
        if triad is not None and triad.unit not in ("m/s^2", "rad/s"):
            raise OptionError(
                f"{target}: corrects outputs in {'m/s^2' if sensor == 'accelerometers' else 'rad/s'}, but the record "
                f"is for {sensor} with outputs in {triad.unit}"
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
    """Return the linear model that a target should hold: the record's own, or one fitted anew where more is left out.

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
    if error <= _NEGLIGIBLE * STANDARD_GRAVITY:
        return accel, error, []
    what = "bias, scale factor and misalignment" if misalignment else "bias and scale factor"
    refit = procedure_of(unit.record).refit
    record = None if refit is None else refit(unit.record, misalignment=misalignment)
    if record is None:
        there = data_of(unit.record).attitudes
        why = (
            f"the record's {len(there.mean)} attitudes are too few, or not the ones, to fit them to anew"
            if there is not None
            else "the record holds no attitudes to fit them to anew"
        )
        return accel, error, [f"{what} are those of the whole model: {why}"]
    held = _accelerometers(record)
    uncertain = {name: p.standard_uncertainty or 0.0 for name, p in record.parameters.items()}
    bias = max(uncertain[f"bias_{axis}"] for axis in AXES)
    scale = max(uncertain[f"scale_factor_{axis}"] / record.value(f"scale_factor_{axis}") for axis in AXES)
    return (
        held,
        accel_loss(accel, correction(held)),
        [
            f"{what} were fitted anew to the record's {fit_of(record).attitudes} attitudes, without what is left out: "
            f"|f| - g there is {_in_g(fit_of(record).rms.value)} rms, {_in_g(fit_of(unit.record).rms.value)} by "
            f"the whole model; standard uncertainties up to {_in_g(bias)} and {plain_number(1e6 * scale, 3)} ppm"
        ],
    )


def accel_terms(accel: Accelerometers, *, misalignment: bool) -> list[str]:
    """Name the accelerometers' parameters that a target leaves out."""
    names = []
    if misalignment and np.abs(accel.matrix - np.eye(3)).max() > 0:
        names += [f"misalignment_{AXES[i]}{AXES[j]}" for i, j in ((1, 0), (2, 0), (2, 1)) if accel.matrix[i, j] != 0]
    names += [
        f"k{power + 2}_{axis}"
        for power, row in enumerate(accel.nonlinearity)
        for axis, k in zip(AXES, row, strict=True)
        if k
    ]
    names += [name for name, k in zip(_CROSS, accel.cross, strict=True) if k]
    return names


def gyro_terms(gyro: Gyroscopes, *, bias: bool) -> tuple[list[str], list[str]]:
    """Name the gyroscopes' parameters that a target without gain (if `bias`: without bias) leaves out, and the cost.

    Returns
    -------
    tuple
        Names; and a phrase for each kind of error that they would leave.
    """
    names, costs = [], []
    share = float(np.abs(gyro.gain - np.eye(3)).sum(axis=1).max()) if gyro.unit == "rad/s" else np.inf
    if share > _NEGLIGIBLE:
        names += ["gyro_scale_factor", "gyro_misalignment"]
        costs.append(
            f"up to {100 * share:.3g} % of the rate" if np.isfinite(share) else "as much as the gyroscopes' scale"
        )
    drift = float((np.abs(gyro.sensitivity).sum(axis=1) * STANDARD_GRAVITY).max())
    if drift > 0:
        names.append("gyro_g_sensitivity")
        costs.append(f"up to {np.degrees(drift):.3g} deg/s within +-1 g")
    if bias and np.abs(gyro.bias).max() > 0:
        names.append("gyro_bias")
        costs.append(f"up to {np.degrees(np.abs(gyro.bias).max()):.3g} deg/s of bias")
    return names, costs


def settle_losses(
    target: str,
    accel: tuple[list[str], float],
    gyro: tuple[list[str], list[str]] = ([], []),
    *,
    how: Sequence[str] = (),
    options: ExportOptions,
) -> list[str]:
    """Refuse what would be lost, or return the comments that say so, and tell them.

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
    if accel[0] and accel[1] > _NEGLIGIBLE * STANDARD_GRAVITY:
        names = accel[0] + names
        costs.insert(0, f"up to {_in_g(accel[1])} within +-1 g")
    if not costs:
        return []
    what = f"{' '.join(names)}, which changes outputs by {', '.join(costs)}"
    if not options.lossy:
        raise OptionError(f"{target} cannot hold {what}; add --lossy to leave it out")
    comments = [f"left out (lossy): {what}", *how]
    for comment in comments:
        options.tell(f"{target}: {comment}")
    return comments


def _in_g(error: float) -> str:
    g = error / STANDARD_GRAVITY
    return f"{1e3 * g:.3g} mg" if g >= 1e-3 else f"{1e6 * g:.3g} ug"


# --- writing -------------------------------------------------------------------------------------------------------


def write_one(folder: Path, name: str, lines: Sequence[str]) -> list[Path]:
    """Write the one file of a target; the folder is made where it is not there.

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
    """Return a number as YAML 1.1 understands it: ``4.0e-06``, since ``4e-06`` is text to it."""
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

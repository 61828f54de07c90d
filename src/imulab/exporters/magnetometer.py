"""Magnetometers for programs that hold a symmetric matrix, with or without a rotation beside it.

``m = W (M - h)``, outputs M in a unit of field. The polar forms of W are ``W = P Q = Q R``: P and R symmetric, Q a
rotation. A program that turns outputs by Q first takes P and ``Q h``, one that turns them last takes R and h; one that
turns nothing takes R and h, and is off by the angle of Q.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.errors import OptionError
from imulab.exporters import ExportOptions
from imulab.recording import Array
from imulab.records.triads import Magnetometers
from imulab.units import parse_unit

_NEGLIGIBLE = np.radians(0.01)
_NEGLIGIBLE_QUADRATIC = 1e-4


@dataclass(frozen=True)
class FieldCorrection:
    """``m = W (M - h)`` in the unit of the outputs: W, shape (3, 3), keeps the field's magnitude; h, shape (3,).

    `unit` is that of the outputs; `magnitude` the field's in it; `quadratic` is the largest quadratic term, as a part
    of the field.
    """

    matrix: Array
    hard_iron: Array
    unit: str
    magnitude: float
    quadratic: float

    @property
    def rotation(self) -> Array:
        """Q, shape (3, 3)."""
        left, _, right = np.linalg.svd(self.matrix)
        q: Array = left @ right
        return q

    @property
    def angle(self) -> float:
        """Angle of Q, rad."""
        return float(np.arccos(np.clip((np.trace(self.rotation) - 1) / 2, -1.0, 1.0)))

    def in_unit(self, symbol: str) -> Array:
        """Return the hard iron in a unit of field."""
        return self.hard_iron * parse_unit(self.unit).factor / parse_unit(symbol).factor


def largest_quadratic(mag: Magnetometers) -> float:
    """Return the largest quadratic term, as a part of the field."""
    return float(np.abs(mag.quadratic).max()) * (1.0 if mag.field is None else mag.field)


def in_field(mag: Magnetometers) -> bool:
    """Return whether the outputs are in a unit of field."""
    return parse_unit(mag.unit).quantity == "magnetic field"


def field_correction(mag: Magnetometers, target: str) -> FieldCorrection:
    """Return the correction of a unit's magnetometers in the unit of their outputs.

    Where the field's magnitude was not stated, the mean sensitivity of the outputs is taken as right.

    Raises
    ------
    OptionError
        Their outputs are no field.
    """
    if not in_field(mag):
        raise OptionError(
            f"{target}: corrects magnetometers in units of field, but the record has outputs in {mag.unit}"
        )
    matrix = mag.soft_iron
    if mag.field is not None:
        scale = 1 / parse_unit(mag.unit).factor
        magnitude = mag.field * scale
    else:
        magnitude = scale = 1 / float(np.cbrt(abs(np.linalg.det(matrix))))
    return FieldCorrection(scale * matrix, mag.hard_iron, mag.unit, magnitude, largest_quadratic(mag))


def quadratic_loss(part: float) -> list[str]:
    """Name quadratic terms that a target leaves out, where they matter; `part` is the largest, of the field."""
    return [f"mag_k2, {100 * part:.2g} % of the field"] if part > _NEGLIGIBLE_QUADRATIC else []


def settle_magnetometers(lost: list[str], target: str, options: ExportOptions) -> list[str]:
    """Refuse what a target would lose of the magnetometers, or return comments that say so, and tell them.

    Raises
    ------
    OptionError
        Something that matters would be lost, and that was not asked for.
    """
    if not lost:
        return []
    if not options.lossy:
        raise OptionError(f"{target} cannot hold {' and '.join(lost)}; add --lossy to leave it out")
    comment = f"left out (lossy): {' and '.join(lost)}"
    options.tell(f"{target}: {comment}")
    return [comment]


def symmetric(
    magnetometers: Magnetometers, target: str, options: ExportOptions, *, turned: bool
) -> tuple[FieldCorrection, list[str]]:
    """Return the correction for a target that holds a symmetric matrix, with a rotation if `turned`, and what is lost.

    Raises
    ------
    OptionError
        The axes are mirrored, which no rotation is, or something would be lost and that was not asked for.
    """
    mag = field_correction(magnetometers, target)
    if np.linalg.det(mag.matrix) < 0:
        raise OptionError(
            f"{target}: the magnetometers' axes are left-handed: no rotation turns them into the body frame"
        )
    lost = []
    if not turned and mag.angle > _NEGLIGIBLE:
        lost.append(f"how the magnetometers are turned against the accelerometers, {np.degrees(mag.angle):.3g} deg")
    return mag, settle_magnetometers([*lost, *quadratic_loss(mag.quadratic)], target, options)


def euler(rotation: Array) -> tuple[float, float, float]:
    """Return roll, pitch, yaw, deg, of ``R = Rz(yaw) Ry(pitch) Rx(roll)``, as both autopilots have it."""
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    pitch = -np.arcsin(np.clip(rotation[2, 0], -1.0, 1.0))
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    return float(np.degrees(roll)), float(np.degrees(pitch)), float(np.degrees(yaw))


def px4_rows(mag: FieldCorrection, options: ExportOptions) -> list[tuple[str, float | str]]:
    """Return PX4's parameters: ``Rot (K (M - OFF))``, gauss, K symmetric.

    Raises
    ------
    OptionError
        A scale is one that PX4 does not take.
    """
    q = mag.rotation
    matrix = q.T @ mag.matrix
    for axis, value in zip("xyz", np.diag(matrix).tolist(), strict=True):
        if not 0.1 <= value <= 3:
            raise OptionError(f"px4: magnetometer scale of axis {axis} is {value:.4g}; PX4 takes 0.1 to 3")
    offset = mag.in_unit("gauss")
    rows: list[tuple[str, float | str]] = [("CAL_MAG0_ID", str(options.device_id))]
    rows += [(f"CAL_MAG0_{a}OFF", float(offset[i])) for i, a in enumerate("XYZ")]
    rows += [(f"CAL_MAG0_{a}SCALE", float(matrix[i, i])) for i, a in enumerate("XYZ")]
    pairs = (("X", 0, 1), ("Y", 0, 2), ("Z", 1, 2))
    rows += [(f"CAL_MAG0_{a}ODIAG", float(matrix[i, j])) for a, i, j in pairs]
    if options.mag_mount == "internal":
        return [*rows, ("CAL_MAG0_ROT", "-1")]
    angles = zip(("ROLL", "PITCH", "YAW"), euler(q), strict=True)
    return [*rows, ("CAL_MAG0_ROT", "100"), *((f"CAL_MAG0_{name}", angle) for name, angle in angles)]


def ardupilot_rows(mag: FieldCorrection, options: ExportOptions) -> list[tuple[str, float]]:
    """Return ArduPilot's parameters: ``K (M + OFS)`` after COMPASS_ORIENT, mgauss, K symmetric.

    Raises
    ------
    OptionError
        A value is one that ArduPilot does not take.
    """
    q = mag.rotation
    external = options.mag_mount == "external"
    matrix = mag.matrix @ q.T if external else q.T @ mag.matrix
    offset = -(q @ mag.in_unit("mgauss") if external else mag.in_unit("mgauss"))
    off = np.array([matrix[0, 1], matrix[0, 2], matrix[1, 2]])
    if (np.diag(matrix) < 0.2).any() or not (np.diag(matrix) <= 5).all() or (np.abs(off) >= 1).any():
        raise OptionError(
            "ardupilot: takes magnetometer scales of 0.2 to 5 and off-diagonals below 1, found "
            f"{' '.join(f'{value:.3g}' for value in (*np.diag(matrix), *off))}"
        )
    if np.abs(offset).max() > 1800:
        raise OptionError(f"ardupilot: takes at most 1800 mgauss of hard iron, found {np.abs(offset).max():.4g}")
    rows = [(f"COMPASS_OFS_{a}", float(offset[i])) for i, a in enumerate("XYZ")]
    rows += [(f"COMPASS_DIA_{a}", float(matrix[i, i])) for i, a in enumerate("XYZ")]
    rows += [(f"COMPASS_ODI_{a}", float(off[i])) for i, a in enumerate("XYZ")]
    rows.append(("COMPASS_SCALE", 0.0))
    if not external:
        return rows
    angles = zip(("ROLL", "PITCH", "YAW"), euler(q), strict=True)
    rows += [("COMPASS_EXTERNAL", 1.0), ("COMPASS_ORIENT", 101.0), ("CUST_ROT_ENABLE", 1.0)]
    return rows + [(f"CUST_ROT1_{name}", angle) for name, angle in angles]

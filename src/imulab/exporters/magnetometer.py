"""Magnetometers for programs that hold a symmetric matrix, with or without a rotation beside it.

``m = W (M - h)``, outputs M in a unit of field. The polar forms of W are ``W = P Q = Q R``: P and R symmetric, Q a
rotation. A program that turns outputs by Q first takes P and ``Q h``, one that turns them last takes R and h; one that
turns nothing takes R and h, and is off by the angle of Q.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.device.tables import DeviceTable, field_of
from imulab.errors import OptionError
from imulab.exporters import ExportOptions
from imulab.procedures.unit_tables import tables_of
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.units import parse_unit

_NEGLIGIBLE = np.radians(0.01)
_NEGLIGIBLE_QUADRATIC = 1e-4


@dataclass(frozen=True)
class Magnetometers:
    """``m = W (M - h)`` in the unit of the outputs: W, shape (3, 3), keeps the field's magnitude; h, shape (3,).

    `unit` is that of the outputs; `quadratic` is the largest quadratic term, as a part of the field.
    """

    matrix: Array
    hard_iron: Array
    unit: str
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


def magnetometers(record: Calibration, target: str) -> Magnetometers | None:
    """Return the magnetometers of a record, None where it has none.

    Raises
    ------
    OptionError
        Their outputs are no field, or are mirrored: no rotation turns them into the body frame.
    """
    table = next((table for table in tables_of(record, None) if table.kind == "mag"), None)
    if table is None:
        return None
    unit = str(table.columns["output_unit"])
    if parse_unit(unit).quantity != "magnetic field":
        raise OptionError(f"{target}: corrects magnetometers in units of field, but the record has outputs in {unit}")
    matrix, hard_iron = _linear(table)
    # Where the field's magnitude was not stated, the mean sensitivity of the outputs is taken as right.
    known = table.columns["field_unit"] == "T"
    scale = 1 / parse_unit(unit).factor if known else 1 / float(np.cbrt(abs(np.linalg.det(matrix))))
    if np.linalg.det(matrix) < 0:
        raise OptionError(
            f"{target}: the magnetometers' axes are left-handed: no rotation turns them into the body frame"
        )
    quadratic = field_of(table, "quadratic") if int(field_of(table, "order")) == 2 else np.zeros(3)
    largest = float(np.abs(quadratic).max()) * (5e-5 if known else 1.0)
    return Magnetometers(scale * matrix, hard_iron, unit, largest)


def _linear(table: DeviceTable) -> tuple[Array, Array]:
    """W and h of raw outputs, without quadratic terms."""
    gain = field_of(table, "gain")
    return field_of(table, "turn") * gain, field_of(table, "bias") / gain


def settle(mag: Magnetometers, target: str, options: ExportOptions, *, turned: bool) -> list[str]:
    """Refuse what the target would lose, or return comments that say so; `turned`: it holds the rotation.

    Raises
    ------
    OptionError
        Something that matters would be lost, and that was not asked for.
    """
    lost = []
    if not turned and mag.angle > _NEGLIGIBLE:
        lost.append(f"how the magnetometers are turned against the accelerometers, {np.degrees(mag.angle):.3g} deg")
    if mag.quadratic > _NEGLIGIBLE_QUADRATIC:
        lost.append(f"mag_k2, {100 * mag.quadratic:.2g} % of the field")
    if not lost:
        return []
    if not options.lossy:
        raise OptionError(f"{target} cannot hold {' and '.join(lost)}; add --lossy to leave it out")
    comment = f"left out (lossy): {' and '.join(lost)}"
    options.tell(f"{target}: {comment}")
    return [comment]


def euler(rotation: Array) -> tuple[float, float, float]:
    """Return roll, pitch, yaw, deg, of ``R = Rz(yaw) Ry(pitch) Rx(roll)``, as both autopilots have it."""
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    pitch = -np.arcsin(np.clip(rotation[2, 0], -1.0, 1.0))
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    return float(np.degrees(roll)), float(np.degrees(pitch)), float(np.degrees(yaw))


def px4_rows(mag: Magnetometers, options: ExportOptions) -> list[tuple[str, float | str]]:
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


def ardupilot_rows(mag: Magnetometers, options: ExportOptions) -> list[tuple[str, float]]:
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

"""A plan on disk: CSV to measure by and to plan on from, and a printable sheet with a picture of each attitude."""

from __future__ import annotations

import numpy as np

from imulab.errors import DataError, UnitError
from imulab.procedures.tumble.plan import Plan, roll_pitch
from imulab.recording import Array, Recording, check_finite
from imulab.units import parse_unit

_SIZE = 62.0
_LARGEST_LETTER, _SMALLEST_LETTER = 13.0, 6.5
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float) * [1.0, 0.7, 0.35]
_FACES = (
    (0, (4, 5, 7, 6), "+x"), (0, (0, 1, 3, 2), "−x"), (1, (2, 3, 7, 6), "+y"),
    (1, (0, 1, 5, 4), "−y"), (2, (1, 3, 7, 5), "+z"), (2, (0, 2, 6, 4), "−z"),
)  # fmt: skip
_SHADES = ("#c8553d", "#1f6f8b", "#d9c27a")
_LETTERS = ("#ffffff", "#ffffff", "#22303a")


def plan_recording(plan: Plan) -> Recording:
    """Return a plan as a table: number, upward direction in the body frame, roll and pitch."""
    angles = roll_pitch(plan.directions)
    columns = {"number": np.arange(1.0, len(plan.directions) + 1)}
    columns |= {f"up_{axis}": np.round(plan.directions[:, i], 6) + 0.0 for i, axis in enumerate("xyz")}
    columns |= {name: np.round(np.degrees(angles[:, i]), 3) + 0.0 for i, name in enumerate(("roll", "pitch"))}
    units = {"number": "1", "up_x": "1", "up_y": "1", "up_z": "1", "roll": "deg", "pitch": "deg"}
    return Recording(columns=columns, units=units, metadata={"order": str(plan.order)}, name="plan")


def directions_of(recording: Recording) -> Array | None:
    """Return the upward directions of a plan or a list of attitudes, shape (n, 3); None where it has none.

    Raises
    ------
    DataError
        A direction has no length or is not finite.
    UnitError
        Roll or pitch is no angle.
    """
    if all(f"up_{axis}" in recording for axis in "xyz"):
        up = np.column_stack([recording.column(f"up_{axis}") for axis in "xyz"])
        check_finite(recording, [f"up_{axis}" for axis in "xyz"])
    elif "roll" in recording and "pitch" in recording:
        for name in ("roll", "pitch"):
            if parse_unit(recording.units[name]).quantity != "angle":
                raise UnitError(
                    f"{recording.name}: column {name}: expected an angle, as in {name} [deg]; found the unit "
                    f"{recording.units[name]}"
                )
        check_finite(recording, ["roll", "pitch"])
        roll, pitch = recording.si("roll"), recording.si("pitch")
        up = np.column_stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])
    else:
        return None
    length = np.linalg.norm(up, axis=1)
    bad = ~(length > 0.1)
    if bad.any():
        index = int(np.argmax(bad))
        raise DataError(f"{recording.name}: {recording.place(index)}: expected a direction, found one without length")
    directions: Array = up / length[:, None]
    return directions


def attitude_picture(up: Array) -> str:
    """Return an SVG of the unit as a box in one attitude, seen slightly from above, axes lettered."""
    turned = _CORNERS @ _to_level(up).T
    view = turned @ _camera().T
    points = view[:, :2] * [_SIZE * 0.5, -_SIZE * 0.5] + _SIZE
    normals = np.repeat(np.eye(3), 2, axis=0) * np.tile([1.0, -1.0], 3)[:, None]
    facing = (normals @ _to_level(up).T @ _camera().T)[:, 2]
    shapes = []
    for (axis, corners, text), toward in zip(_FACES, facing, strict=True):
        if toward <= 0.02:
            continue
        outline = " ".join(f"{x:.1f},{y:.1f}" for x, y in points[list(corners)])
        middle = points[list(corners)].mean(axis=0)
        shapes.append(
            f'<polygon points="{outline}" fill="{_SHADES[axis]}" fill-opacity="{0.45 + 0.5 * toward:.2f}" '
            'stroke="#22303a"/>'
        )
        size = min(_LARGEST_LETTER, 0.7 * _narrowest(points[list(corners)]))
        if size >= _SMALLEST_LETTER:
            shapes.append(
                f'<text x="{middle[0]:.1f}" y="{middle[1]:.1f}" font-size="{size:.1f}" text-anchor="middle" '
                f'dominant-baseline="central" fill="{_LETTERS[axis]}">{text}</text>'
            )
    side = 2 * _SIZE
    return f'<svg viewBox="0 0 {side:.0f} {side:.0f}" width="150" height="150" role="img">{"".join(shapes)}</svg>'


def _narrowest(outline: Array) -> float:
    """Distance between the nearer pair of sides of a parallelogram, shape (4, 2)."""
    one, two = outline[1] - outline[0], outline[3] - outline[0]
    area = abs(float(one[0] * two[1] - one[1] * two[0]))
    return area / max(float(np.linalg.norm(one)), float(np.linalg.norm(two)))


def _to_level(up: Array) -> Array:
    """Rotation that turns the body so that `up` points up, by the shortest way."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine, cosine = float(np.linalg.norm(axis)), float(up[2])
    if sine < 1e-9:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    x, y, z = axis / sine
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation: Array = np.eye(3) + sine * cross + (1 - cosine) * cross @ cross
    return rotation


def _camera() -> Array:
    """Rows: right, up and toward the viewer, who looks down by 25 deg from the front left."""
    a, e = np.radians(-55.0), np.radians(25.0)
    toward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    return np.array([right, np.cross(toward, right), toward])

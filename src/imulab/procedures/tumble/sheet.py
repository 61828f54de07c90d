"""A plan on disk: CSV to measure by and to plan on from, and a printable sheet with a picture of each attitude."""

from __future__ import annotations

import numpy as np

from imulab.columns import triad
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


def plan_recording(plan: Plan, north: Array | None = None) -> Recording:
    """Return a plan as a table: number, upward direction in the body frame (and that of north), roll and pitch."""
    angles = roll_pitch(plan.directions)
    columns = {"number": np.arange(1.0, len(plan.directions) + 1)}
    columns |= {f"up_{axis}": np.round(plan.directions[:, i], 6) + 0.0 for i, axis in enumerate("xyz")}
    if north is not None:
        columns |= {f"north_{axis}": np.round(north[:, i], 6) + 0.0 for i, axis in enumerate("xyz")}
    columns |= {name: np.round(np.degrees(angles[:, i]), 3) + 0.0 for i, name in enumerate(("roll", "pitch"))}
    units = {name: "deg" if name in ("roll", "pitch") else "1" for name in columns}
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
    if all(name in recording for name in triad("up")):
        check_finite(recording, triad("up"))
        up = recording.triad("up")
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
    return _units(up, recording)


def norths_of(recording: Recording) -> Array | None:
    """Return the directions of north of a plan with headings, shape (n, 3), level; None where it has none.

    Raises
    ------
    DataError
        A direction has no level part or is not finite.
    """
    if not all(name in recording for name in (*triad("up"), *triad("north"))):
        return None
    check_finite(recording, triad("north"))
    up, north = _units(recording.triad("up"), recording), recording.triad("north")
    return _units(north - np.einsum("ni,ni->n", up, north)[:, None] * up, recording)


def _units(vectors: Array, recording: Recording) -> Array:
    length = np.linalg.norm(vectors, axis=1)
    bad = ~(length > 0.1)
    if bad.any():
        index = int(np.argmax(bad))
        raise DataError(f"{recording.name}: {recording.place(index)}: expected a direction, found one without length")
    directions: Array = vectors / length[:, None]
    return directions


def attitude_picture(up: Array, north: Array | None = None) -> str:
    """Return an SVG of the unit as a box in one attitude, seen slightly from above, axes lettered.

    With the direction of north in the body frame the box faces as it is to lie, beside an arrow to the north.
    """
    level = _to_level(up) if north is None else np.array([np.cross(north, up), north, up])
    turned = _CORNERS @ level.T
    view = turned @ _camera().T
    points = view[:, :2] * [_SIZE * 0.5, -_SIZE * 0.5] + _SIZE
    normals = np.repeat(np.eye(3), 2, axis=0) * np.tile([1.0, -1.0], 3)[:, None]
    facing = (normals @ level.T @ _camera().T)[:, 2]
    shapes = [] if north is None else [_arrow()]
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


def _arrow() -> str:
    """An arrow on the floor, from the lower left to where north is, which is away from the viewer and to the right."""
    tip = _camera()[:2, 1] * [_SIZE * 0.35, -_SIZE * 0.35]
    start = np.array([8.0, 2 * _SIZE - 6.0])
    end = start + tip
    along = tip / np.hypot(*tip)
    across = np.array([-along[1], along[0]])
    head = " ".join(f"{x:.1f},{y:.1f}" for x, y in (end, end - 6 * along + 3 * across, end - 6 * along - 3 * across))
    x, y = end + 7 * along
    return (
        f'<path d="M{start[0]:.1f} {start[1]:.1f}L{end[0]:.1f} {end[1]:.1f}" stroke="#22303a"/>'
        f'<polygon points="{head}" fill="#22303a"/>'
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="10" text-anchor="middle" dominant-baseline="central" '
        'fill="#22303a">N</text>'
    )


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

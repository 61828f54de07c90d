"""Which attitudes to measure: D- or A-optimal sets for a tumble test, what they will give, and the plan on disk.

What the user may choose from (the sphere, a fixture's steps, a list), what is chosen (optimal.py), what it predicts for
every parameter, and the order of the attitudes that turns least.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from itertools import product
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeAlias

import numpy as np
from msgspec.structs import replace

from imulab.columns import triad
from imulab.errors import DataError, ImulabError, ObservabilityError, OptionError, RecordError, UnitError, listed, meant
from imulab.estimation.least_squares import observability
from imulab.options import choice, either, file, parsed, text
from imulab.procedures.registry import load
from imulab.procedures.result import PlannedAttitudes, Result, amount, as_recording
from imulab.procedures.tumble import CRITERIA, HIGHEST_ORDER, METHODS, SOURCE_ORDER
from imulab.procedures.tumble.attitudes import find_attitudes
from imulab.procedures.tumble.estimate import check_method
from imulab.procedures.tumble.fit import fit_tumble
from imulab.procedures.tumble.model import parameter_count, parameter_names, parameter_units
from imulab.procedures.tumble.record import freedom_finding, predicted_rows
from imulab.procedures.tumble.schema import attitudes_of, data_of, fit_of, model_of
from imulab.procedures.tumble.solve import CLOSEST, Search, information_rows, inverse, optimal_set, sphere_points
from imulab.quantities import in_si, quantity, split_quantity, whole, whole_number
from imulab.recording import Array, Data, Recording, check_finite
from imulab.records import is_json
from imulab.records.calibration import Calibration
from imulab.report.traces import GOOD, Figure, figure_axis
from imulab.units import STANDARD_GRAVITY, from_si, parse_unit

if TYPE_CHECKING:
    from imulab.procedures.tumble.mag.heading import Headings
    from imulab.report.plots import Plot

STARTS = ("sphere", "fixture:15", "head:15")
"""Where attitudes may lie, with steps of any number of degrees."""

# Which attitudes to measure: D- or A-optimal sets for a tumble test, and what they will give.


MOST_ATTITUDES = 300  # of a plan: nobody turns a unit more often
_CANDIDATES = 900  # directions over the sphere, 7 deg apart


@dataclass(frozen=True)
class Plan:
    """Attitudes to measure, in the order that turns least.

    Attributes
    ----------
    directions
        Upward direction in the body frame, shape (n, 3).
    order
        Order of the model that they are for.
    covariance
        Predicted covariance of the parameters for a nominal sensor, in units of g, per variance of |f| / g in one
        attitude; attitudes already there included. Shape (p, p).
    condition_number
        Of the scaled Jacobian.
    already
        Number of attitudes that were there before.
    """

    directions: Array
    order: int
    covariance: Array
    condition_number: float
    already: int

    @property
    def again(self) -> list[tuple[int, int]]:
        """Numbers, from 1, of attitudes that are one attitude put down twice."""
        near = self.directions @ self.directions.T > np.cos(CLOSEST)
        return [(int(i) + 1, int(j) + 1) for i, j in np.argwhere(np.triu(near, 1)).tolist()]

    def uncertainties(self, noise: float | str) -> dict[str, float]:
        """Return the standard uncertainty of every parameter in units of g, for a noise of |f| in g or such as 20ug."""
        size = from_si(in_si(noise, "noise", "acceleration", "ug"), "g") if isinstance(noise, str) else noise
        sigma = size * np.sqrt(np.diag(self.covariance))
        return dict(zip(parameter_names(self.order), sigma.tolist(), strict=True))


def plan_attitudes(
    *,
    attitudes: int,
    order: int = 3,
    criterion: str = "A",
    candidates: Array | None = None,
    already: Array | None = None,
    source: str = "sphere",
    seed: int = 1,
    distinct_verticals: bool = False,
) -> Plan:
    """Choose attitudes for a tumble test.

    Criterion A minimises the sum of the parameters' variances (in units of g), D the volume of their confidence region.
    Of sets whose sums are within 1 % of the least, A takes that whose worst axes have the least sum. Where fewer
    candidates lie 3 deg apart than attitudes are asked for, some are put down again, those first that gain most.

    Parameters
    ----------
    attitudes
        Number of attitudes to choose.
    order
        Order of the model, 0 to 5. Attitudes for order 3 show what an order 2 would silently leave in scale factors.
    criterion
        ``"A"`` or ``"D"``.
    candidates
        Upward directions that the fixture allows, shape (m, 3); the whole sphere if not given.
    already
        Upward directions already measured, shape (k, 3).
    source
        Name of the candidates, for messages.
    seed
        Of the random starts.
    distinct_verticals
        Whether x, y and z are each vertical, up or down, in one attitude at most, as the source of method linearised
        has it; no attitude is put down again then.

    Raises
    ------
    OptionError
        Too few or too many attitudes, too few candidates or none far enough apart, or an unknown criterion.
    ObservabilityError
        No choice among the candidates determines the model.
    """
    size = parameter_count(order) if 0 <= order <= HIGHEST_ORDER else 0
    if not size:
        raise OptionError(f"order {order}: expected 0 to {HIGHEST_ORDER}")
    if criterion not in CRITERIA:
        raise OptionError(f"criterion {criterion!r}: expected one of {listed(CRITERIA, criterion)}")
    before = np.empty((0, 3)) if already is None else already
    if not 1 <= attitudes <= MOST_ATTITUDES:
        raise OptionError(f"{attitudes} attitudes: expected 1 to {MOST_ATTITUDES}")
    if attitudes + len(before) < size:
        known = f" with the {len(before)} already there" if len(before) else ""
        raise OptionError(
            f"{attitudes} attitudes{known}: order {order} has {size} parameters; expected at least as many"
        )
    free = candidates is None
    points = sphere_candidates() if candidates is None else _distinct(candidates)
    if len(points) + len(before) < size:
        raise OptionError(f"{source}: {len(points)} different candidate attitudes; expected at least {size}")
    search = Search(order, criterion, before, distinct_verticals)
    best = optimal_set(search, points, attitudes, seed, free=free) if len(points) >= attitudes else None
    if not free and (best is None or len(_without_repeats(search, best)) < attitudes):
        apart = _without_repeats(search, points)
        if distinct_verticals and len(apart) < attitudes:
            raise OptionError(
                f"{source}: {len(apart)} candidate attitudes lie 3 deg apart and repeat no vertical axis; expected at "
                f"least {attitudes}: ask for fewer, or allow more candidates or --repeated-verticals"
            )
        best = apart if len(apart) <= attitudes else optimal_set(search, apart, attitudes, seed, free=free)
    if best is None:
        raise ObservabilityError(
            f"{source}: no {attitudes} of the {len(points)} candidate attitudes determine order {order}"
        )
    rounds = [best, *_repeated(search, points, best, attitudes)]
    best = np.vstack(rounds)
    everything = np.vstack([before, best])
    jacobian = information_rows(everything, order)
    conditioning = observability(jacobian, np.full(len(everything), 1e16))
    if conditioning.rank < size:
        confused = " ".join(conditioning.confused(parameter_names(order)))
        raise ObservabilityError(f"{source}: the candidate attitudes cannot separate {confused} of order {order}")
    paths = np.vstack([shortest_path(each) for each in rounds if len(each)])
    return Plan(paths, order, inverse(jacobian.T @ jacobian), conditioning.condition, len(before))


def _without_repeats(search: Search, points: Array) -> Array:
    """Candidates that repeat neither one another nor an attitude already there, in their order, shape (k, 3)."""
    kept = np.empty((0, 3))
    for point in points:
        if not search.taken(point[None], kept)[0]:
            kept = np.vstack([kept, point])
    return kept


def _repeated(search: Search, points: Array, best: Array, attitudes: int) -> list[Array]:
    """Attitudes that make up the number, in rounds: no attitude is put down a third time before all were twice."""
    everywhere = best if len(best) else _without_repeats(replace(search, before=np.empty((0, 3))), points)
    rows, rounds = information_rows(everywhere, search.order), list[Array]()
    kept, left = information_rows(best, search.order), attitudes - len(best)
    while left > 0:
        chosen: list[int] = []
        while len(chosen) < min(left, len(everywhere)):
            gain = search.gain(rows, np.vstack([kept, rows[chosen]]))
            gain[chosen] = -np.inf
            chosen.append(int(np.argmax(gain)))
        rounds.append(everywhere[chosen])
        kept, left = np.vstack([kept, rows[chosen]]), left - len(chosen)
    return rounds


def fixture_candidates(step: float) -> Array:
    """Return the directions of a two-axis fixture that turns in steps of `step`, rad: roll and pitch."""
    count = _steps(step)
    angle = np.arange(count) * (2 * np.pi / count)
    roll, pitch = (grid.ravel() for grid in np.meshgrid(angle, angle))
    return _distinct(np.column_stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)]))


def head_candidates(step: float) -> Array:
    """Return the directions of a dividing head, its axis level, with the unit mounted along x, y and z in turn."""
    count = _steps(step)
    angle = np.arange(count) * (2 * np.pi / count)
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])
    return _distinct(np.vstack([np.roll(circle, shift, axis=1) for shift in range(3)]))


def roll_pitch(directions: Array) -> Array:
    """Return roll and pitch, rad, shape (n, 2), of a body with z up when level: up = R_x(roll)' R_y(pitch)' e_z."""
    x, y, z = directions.T
    return np.column_stack([np.arctan2(y, z), np.arctan2(-x, np.hypot(y, z))])


def turning(directions: Array) -> float:
    """Return the sum of the angles from each direction to the next, rad."""
    return float(np.arccos(np.clip(np.einsum("ni,ni->n", directions[:-1], directions[1:]), -1, 1)).sum())


def _steps(step: float) -> int:
    count = round(2 * np.pi / step) if step > 0 else 0
    if not 4 <= count <= 720 or abs(count * step - 2 * np.pi) > 1e-6:
        raise OptionError(f"step {np.degrees(step):g} deg: expected a whole part of 360 deg, 0.5 to 90 deg")
    return count


def sphere_candidates() -> Array:
    """Return an even lattice, with the faces, edges and corners of a cube, which fixtures give exactly, (n, 3)."""
    cube = np.array([v for v in product((-1.0, 0.0, 1.0), repeat=3) if any(v)])
    return np.vstack([cube / np.linalg.norm(cube, axis=1, keepdims=True), sphere_points(_CANDIDATES)])


def _distinct(directions: Array) -> Array:
    """Unit directions without repetitions."""
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    _, first = np.unique(np.round(unit, 6) + 0.0, axis=0, return_index=True)
    distinct: Array = unit[np.sort(first)]
    return distinct


def shortest_path(directions: Array) -> Array:
    """Order the attitudes so that little is turned between them: nearest neighbour, then 2-opt, level first."""
    count = len(directions)
    angle = np.arccos(np.clip(directions @ directions.T, -1, 1))
    start = int(np.argmax(directions[:, 2]))
    path, left = [start], set(range(count)) - {start}
    while left:
        path.append(min(left, key=lambda k: angle[path[-1], k]))
        left.remove(path[-1])
    improved = True
    while improved:
        improved = False
        for i in range(count - 2):
            for j in range(i + 2, count):
                a, b, c = path[i], path[i + 1], path[j]
                after = angle[b, path[j + 1]] - angle[c, path[j + 1]] if j + 1 < count else 0.0
                if angle[a, c] - angle[a, b] + after < -1e-9:
                    path[i + 1 : j + 1] = path[i + 1 : j + 1][::-1]
                    improved = True
    return directions[path]


# A plan on disk: CSV to measure by and to plan on from, and a printable sheet with a picture of each attitude.


_SIZE = 62.0  # pixels from the middle of a drawing to its edge
_LARGEST_LETTER, _SMALLEST_LETTER = 13.0, 6.5  # pixels
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
    return _directions(up, recording)


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
    up, north = _directions(recording.triad("up"), recording), recording.triad("north")
    return _directions(north - np.einsum("ni,ni->n", up, north)[:, None] * up, recording)


def _directions(vectors: Array, recording: Recording) -> Array:
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
    for (axis, corners, label), toward in zip(_FACES, facing, strict=True):
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
                f'dominant-baseline="central" fill="{_LETTERS[axis]}">{label}</text>'
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
    first, second = outline[1] - outline[0], outline[3] - outline[0]
    area = abs(float(first[0] * second[1] - first[1] * second[0]))
    return area / max(float(np.linalg.norm(first)), float(np.linalg.norm(second)))


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


# A plan as its user has it: what it predicts, its CSV to measure by, its sheet to print, its figure.


@dataclass(frozen=True, repr=False)
class TumblePlan(PlannedAttitudes, Plan):
    """Attitudes to measure, in the order that turns least, and what they will give.

    Attributes
    ----------
    criterion
        By which they were chosen.
    noise
        Of |f| in one attitude, in units of g.
    noise_from
        What said so, in brackets; empty where it was given as a number.
    distinct_verticals
        Whether no two attitudes have the same of x, y and z vertical.
    headings
        Which way each attitude faces, for a magnetometer; None where that was not asked for.
    """

    sheet_title: ClassVar[str] = "Tumble plan"
    criterion: str
    noise: float
    noise_from: str
    distinct_verticals: bool
    headings: Headings | None = None

    def uncertainties(self, noise: float | str | None = None) -> dict[str, float]:
        """Return the standard uncertainty of every parameter in units of g, for the plan's noise or another of |f|.

        In g, or a text such as ``"20 ug"``.
        """
        return super().uncertainties(self.noise if noise is None else noise)

    @property
    def finding(self) -> str | None:
        """What too few attitudes leave open; None where they are enough."""
        return freedom_finding(len(self.directions) + self.already, len(self.covariance), self.order)

    @property
    def lead(self) -> str:
        """What the plan is and predicts, and why it differs from what was asked for."""
        noise = f"{from_si(self.noise * STANDARD_GRAVITY, 'ug'):.4g} µg"
        there = f" with the {self.already} already there" if self.already else ""
        lead = (
            f"{len(self.directions)} attitudes{there} for order {self.order}, criterion {self.criterion}: condition "
            f"number {self.condition_number:.1f}, {np.degrees(turning(self.directions)):.0f} deg of turning. Predicted "
            f"for a noise of {noise} in |f| per attitude{self.noise_from} and a nominal sensor."
        )
        if self.order == 3:
            lead += " Order 3 because attitudes for a lower one cannot show what that would leave in the scale factors."
        if self.again:
            pairs = ", ".join(f"{attitude} and {other}" for attitude, other in self.again)
            lead += (
                f" Put down twice: {pairs}. No more candidates lie 3 deg apart; the second time, after the others, "
                "lowers the noise and shows what drifts, but no new direction."
            )
        if self.distinct_verticals:
            lead += " Of the new attitudes no two have the same of x, y and z vertical, nor one that had it before."
        if self.finding is not None:
            lead += f" Too few to check the order: {self.finding}."
        return lead if self.headings is None else lead + self.headings.lead

    @property
    def predicted(self) -> list[tuple[str, str, str]]:
        """Predicted uncertainties as people read them: name, text and unit."""
        rows = predicted_rows(self.uncertainties(self.noise))
        return rows if self.headings is None else rows + self.headings.rows()

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return the plan in a few sentences, and the predicted uncertainties."""
        return self.lead, ["parameter", "predicted u", "unit"], [list(row) for row in self.predicted]

    def content(self) -> dict[str, Any]:
        """Return the plan for scripts, in SI under the names of a record."""
        units = parameter_units(self.order, "m/s^2")
        # A bias in units of g is so many times gravity, a k_n in 1/g^(n-1) so many times its inverse power.
        powers = {"m/s^2": 1, "1/(m/s^2)": -1} | {f"1/(m/s^2)^{n}": -n for n in range(2, self.order)}
        predicted, angles = self.uncertainties(self.noise), roll_pitch(self.directions)
        attitudes: list[dict[str, Any]] = [
            {"up": up, "roll": amount(roll, "rad"), "pitch": amount(pitch, "rad")}
            for up, (roll, pitch) in zip(self.directions.tolist(), angles.tolist(), strict=True)
        ]
        parameters = {
            name: {"standard_uncertainty": u * STANDARD_GRAVITY ** powers.get(unit, 0), "unit": unit}
            for (name, u), unit in zip(predicted.items(), units, strict=True)
        }
        if self.headings is not None:
            for index, (attitude, north) in enumerate(zip(attitudes, self.headings.north.tolist(), strict=True)):
                attitude |= {"north": north, "facing": self.headings.facing(index)}
            parameters |= {
                name: {"standard_uncertainty": u, "unit": "1" if name.startswith(("mag_bias", "mag_scale")) else "rad"}
                for name, u in self.headings.uncertainties().items()
            }
        return {
            "order": self.order,
            "criterion": self.criterion,
            "condition_number": float(self.condition_number),
            "noise": amount(self.noise * STANDARD_GRAVITY, "m/s^2"),
            "already": self.already,
            "warnings": [] if self.finding is None else [self.finding],
            "attitudes": attitudes,
            "again": [list(pair) for pair in self.again],
            "parameters": parameters,
        }

    def recording(self) -> Recording:
        """Return the same as a table."""
        return plan_recording(self, None if self.headings is None else self.headings.north)

    def plot(self) -> Plot:
        """Return roll and pitch of the attitudes, numbered in their order."""
        roll, pitch = np.degrees(roll_pitch(self.directions)).T.tolist()
        numbers = [str(number) for number in range(1, len(roll) + 1)]
        sides = [("top center", "bottom center")[k % 2] for k in range(len(roll))]
        trace = {
            "type": "scatter", "mode": "lines+markers+text", "x": roll, "y": pitch, "text": numbers,
            "textposition": sides, "line": {"color": GOOD, "width": 1}, "marker": {"color": GOOD, "size": 8},
        }  # fmt: skip
        layout = {
            "xaxis": figure_axis("roll, deg", dtick=90, range=[-195, 195]),
            "yaxis": figure_axis("pitch, deg", dtick=45, range=[-110, 110]),
        }
        from imulab.report.plots import Plot

        return Plot(Figure("Attitudes to measure", self.lead, [trace], layout), "Tumble plan")

    def pictures(self) -> list[dict[str, Any]]:
        """Return what the sheet shows of each attitude."""
        headings = self.headings
        return [
            attitude_entry(str(k + 1), up)
            if headings is None
            else attitude_entry(str(k + 1), up, headings.north[k], headings.facing(k))
            for k, up in enumerate(self.directions)
        ]


def attitude_entry(number: str, up: Array, north: Array | None = None, facing: str = "") -> dict[str, str]:
    """Return what a sheet shows of an attitude: its number, picture, upward direction, roll and pitch, deg."""
    roll, pitch = np.degrees(roll_pitch(up[None]))[0]
    return {
        "number": number,
        "picture": attitude_picture(up, north),
        "facing": facing,
        "up": "(" + ", ".join(f"{value:+.2f}" for value in up) + ")",
        "roll": f"{roll:.1f}",
        "pitch": f"{pitch:.1f}",
    }


# A plan from what people have: noise, candidates and earlier attitudes as numbers, texts, files, records or arrays.


_TINY = 1e-8  # g: below it a noise without a unit, which is in ug, was meant in another


Known: TypeAlias = Calibration | Data


def plan_tumble(
    attitudes: Annotated[int | str, parsed(whole_number, "N")],
    *,
    noise: Annotated[float | Known | None, text("20ug|FILE")] = None,
    order: int | str | None = None,
    criterion: Annotated[str, choice(CRITERIA)] = "A",
    from_: Annotated[Data, text("sphere|FILE", STARTS)] = "sphere",
    add: Annotated[Known | Plan | None, file()] = None,
    method: Annotated[str, choice(METHODS)] = "norm",
    distinct_verticals: Annotated[bool | None, either("repeated-verticals")] = None,
    with_: Annotated[str | None, text("mag", ("mag",))] = None,
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
        Noise of ``|f|`` in one attitude, in ug without a unit, or a recording or record that has it. A number is in
        m/s^2, a text such as ``"20ug"``; or the file of either.
    order
        Order of the model, 0 to 5; 3, or with method linearised 4, if not given. Attitudes for order 3 show what an
        order 2 would silently leave in scale factors.
    criterion
        A: least sum of variances; D: smallest confidence region.
    from_
        Where attitudes may lie: sphere, fixture:15 or head:15 (steps in deg), or a file that lists them. Or upward
        directions in the body frame, shape (m, 3).
    add
        Attitudes already there: a plan, a record or a recording. Or its file; or upward directions, shape (k, 3).
    method
        Method of the fit that the attitudes are for.
    distinct_verticals
        Whether x, y and z are each vertical in one attitude at most, as the source of method linearised demands; as the
        method demands if not given. Up or down.
    with_
        mag: give each attitude a heading too, for the magnetometers beside the accelerometers. In quarter turns; of
        `add` the headings of a plan with headings, or of a record with magnetometers, count.

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
    number = whole(SOURCE_ORDER if method == "linearised" else 3, "order") if order is None else whole(order, "order")
    check_method(method, number)
    if with_ not in (None, "mag"):
        raise OptionError(f"with_ {with_!r}: expected mag: only magnetometers ask for headings{meant(['mag'], with_)}")
    sigma, source = noise_of(noise)
    distinct = method == "linearised" if distinct_verticals is None else distinct_verticals
    chosen = plan_attitudes(
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
        from imulab.procedures.tumble.mag.heading import plan_headings

        headings = plan_headings(chosen.directions, before=None if add is None else _measured_headings(add))
    return TumblePlan(
        **vars(chosen), criterion=criterion, noise=sigma, noise_from=source, distinct_verticals=distinct,
        headings=headings,
    )  # fmt: skip


def _record(data: object) -> Calibration | None:
    """Return a tumble record, given or named; None for what is none."""
    name = os.fspath(data) if isinstance(data, str | PathLike) else "the record"
    if isinstance(data, str | PathLike) and is_json(name):
        data = load(name)
    elif isinstance(data, Result):
        data = data.calibration
    if not isinstance(data, Calibration):
        return None
    if data.procedure != "tumble":
        raise RecordError(f"{name}: a {data.procedure} record holds no attitudes; expected a tumble record")
    return data


def noise_of(source: Any) -> tuple[float, str]:
    """Noise of |f| in one attitude, g: a quantity, or what the attitudes of a recording or record have; and whose."""
    if source is None:
        raise OptionError(
            "noise: expected the noise of |f| in one attitude, such as 20ug, or a recording or record that has it"
        )
    if isinstance(source, float | int) or (isinstance(source, str) and not Path(source).is_file()):
        sigma = from_si(in_si(source, "noise", "acceleration", "ug"), "g")
        if not sigma > 0:
            raise OptionError(f"noise {source!r}: expected more than 0")
        if isinstance(source, str) and sigma < _TINY and not split_quantity(source, "noise", "20 ug")[1]:
            raise OptionError(
                f"noise {source!r}: without a unit that is in ug, and less than any accelerometer has; expected one, "
                f"such as '{source.strip()} g'"
            )
        return sigma, ""
    record = _record(source)
    if record is not None:
        whose = os.fspath(source) if isinstance(source, str | PathLike) else "the record"
        return _noise_of(record), f" (that of {whose})"
    attitudes = find_attitudes(as_recording(source, {}, plan_tumble, name="noise"))
    whose = f" (that of {os.fspath(source) if isinstance(source, str | PathLike) else attitudes.recording.name})"
    if attitudes.covariance is None:
        name = attitudes.recording.name
        raise OptionError(f"{name}: a table without std_* columns does not say what noise its attitudes have")
    try:
        return _noise_of(fit_tumble(attitudes).calibration), whose
    except ImulabError:  # too few for a fit: any direction and length are good enough for a noise
        up = attitudes.mean / np.linalg.norm(attitudes.mean, axis=1, keepdims=True)
        variance = np.einsum("ni,nij,nj->n", up, attitudes.covariance, up) / (attitudes.mean**2).sum(axis=1)
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


def candidates_of(source: Any) -> Array | None:
    """Return the upward directions among which a plan chooses, as ``--from`` names them; None for the whole sphere."""
    if isinstance(source, str):
        if source == STARTS[0]:
            return None
        kind, colon, step = source.partition(":")
        if colon and kind in ("fixture", "head"):
            angle = quantity(step, f"from_ {kind}", "angle", "deg")
            return fixture_candidates(angle) if kind == "fixture" else head_candidates(angle)
        hint = meant((each.partition(":")[0] for each in STARTS), kind)
        if (colon or hint) and not Path(source).exists():
            raise OptionError(
                f"from_ {source!r}: expected {', '.join(STARTS)} (steps in deg) or a file of directions{hint}"
            )
    if isinstance(source, np.ndarray | list | tuple):
        return _unit_vectors(source, "from_")
    recording = as_recording(source, {}, plan_tumble, name="from_")
    directions = directions_of(recording)
    if directions is None:
        raise OptionError(f"{recording.name}: expected columns up_x up_y up_z, or roll [deg] and pitch [deg]")
    return directions


def _unit_vectors(values: object, name: str) -> Array:
    """Return directions as unit vectors, shape (n, 3)."""
    try:
        vectors = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        vectors = np.empty(0)
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    if vectors.ndim != 2 or vectors.shape[1] != 3 or not (np.isfinite(length) & (length > 0)).all():
        raise OptionError(f"{name}: expected upward directions, shape (n, 3), found the shape {vectors.shape}")
    units: Array = vectors / length
    return units


def _measured_directions(source: Any) -> Array:
    """Upward directions of a plan, of a record's attitudes, or of a recording's under an order-1 fit."""
    if isinstance(source, Plan):
        return source.directions
    if isinstance(source, np.ndarray | list | tuple):
        return _unit_vectors(source, "add")
    record = _record(source)
    if record is not None:
        held = attitudes_of(record)
        force = np.array(held.force)[np.array(held.down_weight) > 0]
    else:
        recording = as_recording(source, {}, plan_tumble, name="add")
        listed = directions_of(recording)
        if listed is not None:
            return listed
        attitudes = find_attitudes(recording)
        # The directions need no better than a percent, and too few attitudes for a fit are no reason to refuse.
        try:
            force = np.array(attitudes_of(fit_tumble(attitudes, order=1).calibration).force)
        except ImulabError:
            force = attitudes.mean
    directions: Array = force / np.linalg.norm(force, axis=1, keepdims=True)
    return directions


def _measured_headings(source: Any) -> tuple[Array, Array] | None:
    """Upward directions and those of north of a plan with headings or a record with magnetometers; None of others."""
    if isinstance(source, TumblePlan):
        return None if source.headings is None else (source.directions, source.headings.north)
    if isinstance(source, Plan | np.ndarray | list | tuple):
        return None
    record = _record(source)
    if record is None:
        recording = as_recording(source, {}, plan_tumble, name="add")
        up, north = directions_of(recording), norths_of(recording)
        return None if up is None or north is None else (up, north)
    held = data_of(record).mag
    if held is None:
        return None
    from imulab.procedures.tumble.mag.solve import world_axes

    axes = world_axes(np.array(held.field)[held.used], np.array(held.force)[held.used])
    return axes[:, 2], axes[:, 1]

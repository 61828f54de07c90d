"""Magnetic heading and dip of each sample, and headings of the attitudes of a plan.

Heading (`Law.angles`): with the corrected f and m, ``a = m x f`` points to magnetic east and ``n = f x a`` to magnetic
north. The heading of the body's x axis, clockwise from north, and the dip are

    heading = atan2(|f| a_x, n_x),    dip = atan2(-m.f, |a|)

Their uncertainty is that of the parameters of both triads, by ``dv = T^-1 (ds - dT v)`` with
``ds = (-(A + b) dS/S - db - sum dk_j s^j) / A'(s)``; of the scatter of the record's attitudes; and of the noise of one
sample. A moving unit has ``|f|^2 = g^2 + a^2`` with a horizontal acceleration a: where |f| is off g by more than 1 %,
more than gravity and calibration are, a counts as noise of each axis of f.

Plan (`plan_headings`): an attitude is the direction up in the body frame; its heading is the direction of the body axis
that is nearest to the horizontal. Headings are exchanged one by one, from several starts, for the least sum of the
variances of the magnetometers' parameters and the dip (A-optimal), with known accelerometers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.columns import triad
from imulab.errors import ObservabilityError, OptionError, RecordError
from imulab.procedures.tumble.mag.model import (
    ACCELEROMETERS,
    FEWEST,
    MAGNETOMETERS,
    Pairs,
    ParameterLayout,
    evaluate_invariants,
    mag_names,
)
from imulab.procedures.tumble.mag.solve import world_axes
from imulab.procedures.tumble.model import parameter_names
from imulab.procedures.tumble.schema import fit_of, mag_model_of, model_of
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration
from imulab.report.traces import plain_number
from imulab.units import from_si

# Magnetic heading and dip of each sample, with their uncertainties.


_AT_REST = 1e-2
"""Parts of g by which |f| may be off at rest: gravity differs by 0.5 % from pole to equator."""
_UNKNOWN = np.pi / np.sqrt(3)
"""Standard deviation of an angle that may be any."""


@dataclass(frozen=True)
class Triad:
    """A calibrated triad: bias, scale factor, shape (3,), T, (3, 3), its free places, and k2, k3 ..., (orders, 3)."""

    bias: Array
    scale: Array
    turn: Array
    pairs: Pairs
    powers: Array

    @classmethod
    def of(cls, values: Array, pairs: Pairs) -> Triad:
        """Return that of parameters in SI, in the order of a record."""
        fixed, turn = 6 + len(pairs), np.eye(3)
        turn[tuple(np.transpose(pairs))] = values[6:fixed]
        return cls(values[:3], values[3:6], turn, pairs, values[fixed:].reshape(-1, 3))

    def slopes(self, vectors: Array, gradient: Array) -> Array:
        """Return the derivatives by the parameters, (n, p), of a function with a `gradient` by the vectors, (n, 3)."""
        s = vectors @ self.turn.T
        along = gradient @ np.linalg.inv(self.turn)
        orders = range(2, len(self.powers) + 2)
        bent = sum((k * s**j for j, k in zip(orders, self.powers, strict=True)), s)
        steep = sum((j * k * s ** (j - 1) for j, k in zip(orders, self.powers, strict=True)), np.ones_like(s))
        by_bias = -along / steep
        columns = [by_bias, by_bias * (bent + self.bias) / self.scale]
        columns += [-along[:, i : i + 1] * vectors[:, j : j + 1] for i, j in self.pairs]
        columns += [by_bias * s**j for j in orders]
        return np.hstack(columns)


@dataclass(frozen=True)
class Angles:
    """Heading and dip, rad, with their standard uncertainties, each of shape (n,)."""

    heading: Array
    heading_uncertainty: Array
    dip: Array
    dip_uncertainty: Array


@dataclass(frozen=True)
class Law:
    """Both triads, covariance of their parameters, noise of f and m, and gravity, which give heading and dip.

    `force_noise` is in m/s^2, `field_noise` a part of the field, each of one axis.
    """

    accel: Triad
    mag: Triad
    covariance: Array
    force_noise: float
    field_noise: float
    gravity: float

    @np.errstate(all="ignore")
    def angles(self, force: Array, field: Array) -> Angles:
        """Return heading and dip of f, m/s^2, and m, both calibrated, shape (n, 3)."""
        f_length, m_length = np.linalg.norm(force, axis=1), np.linalg.norm(field, axis=1)
        inner = np.einsum("ni,ni->n", field, force)
        (fx, fy, fz), (mx, my, mz) = force.T, field.T
        zero, x_axis = np.zeros_like(fx), np.eye(3)[0]
        a_x, n_x = my * fz - mz * fy, mx * f_length**2 - fx * inner
        by_field = (
            (f_length * np.stack([zero, fz, -fy]) * n_x).T
            - (f_length * a_x)[:, None] * (np.outer(f_length**2, x_axis) - fx[:, None] * force)
        )  # fmt: skip
        by_force = (
            ((f_length * np.stack([zero, -mz, my]) + a_x * force.T / f_length) * n_x).T
            - (f_length * a_x)[:, None] * (2 * mx[:, None] * force - np.outer(inner, x_axis) - fx[:, None] * field)
        )  # fmt: skip
        squared = (n_x**2 + (f_length * a_x) ** 2)[:, None]
        heading = np.arctan2(f_length * a_x, n_x) % (2 * np.pi)
        u_heading = self._uncertainty(force, field, by_force / squared, by_field / squared)
        u, e = field / m_length[:, None], force / f_length[:, None]
        dip = np.arctan2(-inner, np.linalg.norm(np.cross(field, force), axis=1))
        sine, cosine = np.sin(dip)[:, None], np.cos(dip)[:, None]
        t, v = -(e + u * sine) / cosine / m_length[:, None], -(u + e * sine) / cosine / f_length[:, None]
        return Angles(heading, np.minimum(u_heading, _UNKNOWN), dip, self._uncertainty(force, field, v, t))

    def horizontal_uncertainty(self, force: Array, field: Array) -> tuple[Array, Array]:
        """Return the standard uncertainty of magnetic heading of any body axis, rad: by the parameters, of a reading.

        Shapes (n,). An error dm turns the horizontal part of the field by ``east . dm / |m| cos(dip)``; an error df
        turns the vertical. That of a reading includes the noise.
        """
        east, north, up = world_axes(field, force).transpose(1, 0, 2)
        by_field = east / np.einsum("ni,ni->n", north, field)[:, None]
        by_force = -by_field * (np.einsum("ni,ni->n", up, field) / np.linalg.norm(force, axis=1))[:, None]
        silent = replace(self, force_noise=0.0, field_noise=0.0)
        return silent._uncertainty(force, field, by_force, by_field), self._uncertainty(
            force, field, by_force, by_field
        )

    def _uncertainty(self, force: Array, field: Array, by_force: Array, by_field: Array) -> Array:
        """Return the standard uncertainty of an angle with these gradients by f and m, rad, shape (n,)."""
        slopes = np.hstack([self.mag.slopes(field, by_field), self.accel.slopes(force, by_force)])
        known = np.einsum("np,pq,nq->n", slopes, self.covariance, slopes, optimize=True)
        off = np.abs((force**2).sum(axis=1) - self.gravity**2)
        moving = np.maximum(off - 2 * _AT_REST * self.gravity**2, 0.0)
        noise = (by_force**2).sum(axis=1) * (self.force_noise**2 + moving)
        noise += (by_field**2).sum(axis=1) * self.field_noise**2 * (field**2).sum(axis=1)
        total: Array = np.sqrt(known + noise)
        return total


def read_law(record: Calibration) -> Law:
    """Return the law of heading and dip of a record with magnetometers.

    Raises
    ------
    RecordError
        It holds none, or lacks a parameter or its covariance.
    """
    model, fit = model_of(record), fit_of(record)
    if fit.mag is None:
        raise RecordError(
            "heading needs magnetometers, which the record does not hold; 'imulab tumble mag FILE --accel RECORD' adds "
            "them"
        )
    of_mag, of_accel = mag_names(mag_model_of(record).mag_order)[:-1], parameter_names(model.order)
    values = np.array([record.value(name) for name in (*of_mag, *of_accel)])
    return Law(
        accel=Triad.of(values[len(of_mag) :], ACCELEROMETERS),
        mag=Triad.of(values[: len(of_mag)], MAGNETOMETERS),
        covariance=record.covariance.block([*of_mag, *of_accel]),
        force_noise=fit.rms.value,
        field_noise=fit.mag.heading.of_one_reading.value * float(np.cos(record.value("dip"))),
        gravity=model.gravity.value,
    )


def add_sample_noise(law: Law, record: Calibration) -> Law:
    """Return the law for samples of a recording, which are noisier than the means of attitudes."""
    mag = fit_of(record).mag
    if mag is None or mag.of_one_sample is None:
        return law
    sample = mag.of_one_sample
    return replace(
        law,
        force_noise=float(np.hypot(law.force_noise, sample.accel.value)),
        field_noise=float(np.hypot(law.field_noise, sample.mag.value)),
    )


def make_heading_function(record: Calibration, *, true: bool = False) -> Callable[[Recording], Recording]:
    """Return a function that adds heading, std_heading, dip and std_dip, deg, to a recording corrected by the record.

    Headings are clockwise from magnetic north; `true` ones from true north, by the declination of the record's place.

    Raises
    ------
    RecordError
        As for `read_law`; true headings are asked of a record without a place.
    """
    of_means = read_law(record)
    turn, known, metadata = 0.0, 0.0, {}
    if true:
        place = mag_model_of(record).place
        if place is None:
            raise RecordError(
                "true headings need the declination of the place, which the record does not hold: state it in the fit "
                "(tumble mag --place LAT,LON --date DAY)"
            )
        turn, known = place.declination.value, place.declination.standard_uncertainty or 0.0
        metadata = {
            "heading": f"from true north, declination {np.degrees(turn):+.2f} deg by {place.model}, {place.date}"
        }
    of_each = add_sample_noise(of_means, record)

    def with_heading(recording: Recording) -> Recording:
        for name in (*triad("accel"), *triad("mag")):
            if name not in recording:
                raise recording.lacking(f"column {name}", name, "heading needs accelerometers and magnetometers")
        force = np.column_stack([recording.si(name) for name in triad("accel")])
        field = np.column_stack([recording.si(name) for name in triad("mag")])
        # A table of attitudes has no time: its rows are means.
        angles = (of_each if "time" in recording else of_means).angles(force, field)
        columns = {
            "heading": (angles.heading + turn) % (2 * np.pi),
            "std_heading": np.minimum(np.hypot(angles.heading_uncertainty, known), _UNKNOWN),
            "dip": angles.dip, "std_dip": angles.dip_uncertainty,
        }  # fmt: skip
        added = recording.with_columns(
            {name: from_si(values, "deg") for name, values in columns.items()}, dict.fromkeys(columns, "deg")
        )
        return replace(added, metadata={**added.metadata, **metadata}) if metadata else added

    return with_heading


# Headings of the attitudes of a plan.


QUARTERS = ("north", "east", "south", "west")
_DIP = np.radians(67.0)
_SCATTER = 3e-3
"""Scatter of |m|, as a part of the field, and of the dip, rad, in good recordings (0.1 to 0.5 %, 0.16 to 0.29 deg)."""
_STARTS, _ATTITUDES_OVER_STARTS, _SWEEPS = 12, 600, 40
"""Starts of the search, fewer with many attitudes: at most so many over all starts; and sweeps of one start."""
_RIDGE = 1e-9  # keeps a design that is not determined yet invertible
_LAYOUT = ParameterLayout(6 + len(MAGNETOMETERS), 6 + len(ACCELEROMETERS))


@dataclass(frozen=True)
class Headings:
    """The heading of each attitude of a plan, and the predicted uncertainty of a magnetometer.

    Attributes
    ----------
    axis
        The body axis whose heading is meant, 0 to 2, shape (n,).
    step
        Its heading, in steps of a full turn over `steps`, clockwise from north, shape (n,).
    steps
        Steps of a full turn.
    north
        The direction of north in the body frame, shape (n, 3).
    covariance
        Covariance of biases and scale factors (parts of the field and of themselves), misalignments and dip, rad, over
        the variance of |m| and dip, shape (13, 13).
    heading
        Standard uncertainty of magnetic heading by the parameters, rad, over the standard deviation of |m| and dip,
        rms over attitudes.
    condition_number
        Condition number of the scaled Jacobian.
    already
        Number of earlier attitudes with a known heading.
    """

    axis: NDArray[np.int64]
    step: NDArray[np.int64]
    steps: int
    north: Array
    covariance: Array
    heading: float
    condition_number: float
    already: int

    def facing(self, index: int) -> str:
        """Return which way an attitude faces: ``+x to the north``."""
        turn = 4 * int(self.step[index]) / self.steps
        where = QUARTERS[round(turn)] if turn.is_integer() else f"{90 * turn:g} deg clockwise from north"
        return f"+{'xyz'[self.axis[index]]} to the {where}"

    def uncertainties(self) -> dict[str, float]:
        """Return the predicted standard uncertainty of every parameter, as parts of the field or of 1, and rad."""
        sigma = _SCATTER * np.sqrt(np.diag(self.covariance))
        return dict(zip(mag_names(1), sigma.tolist(), strict=True)) | {"heading": _SCATTER * self.heading}

    def rows(self) -> list[tuple[str, str, str]]:
        """Return the same as name, text and unit."""
        kinds = {
            "mag_bias": (100.0, "% of the field"),
            "mag_scale_factor": (100.0, "%"),
            "mag_misalignment": (1e3, "mrad"),
        }
        table = []
        for name, value in self.uncertainties().items():
            factor, unit = kinds.get(name.rpartition("_")[0], (np.degrees(1.0), "deg"))
            table.append((name, plain_number(value * factor, 2), unit))
        return table

    @property
    def lead(self) -> str:
        """The purpose of the headings, and their prediction, in a few sentences."""
        there = f", with {self.already} that were there before" if self.already else ""
        return (
            f" Every attitude faces one of four ways{there}, so that a magnetometer is seen too: condition number "
            f"{self.condition_number:.1f}. North is magnetic north within 30 deg (any other direction that stays the "
            f"same costs 15 %). Predicted for |m| and dip that scatter by {100 * _SCATTER:g} % of the field and "
            f"{np.degrees(_SCATTER):.2g} deg, at a dip of {np.degrees(_DIP):.0f} deg: heading "
            f"{np.degrees(_SCATTER * self.heading):.2g} deg."
        )


def plan_headings(
    directions: Array, *, before: tuple[Array, Array] | None = None, steps: int = 4, seed: int = 1
) -> Headings:
    """Return the best heading of each attitude.

    Parameters
    ----------
    directions
        Upward directions in the body frame, shape (n, 3).
    before
        Directions up and north of earlier attitudes.
    steps
        Headings to choose from in a full turn.
    seed
        Seed of the random starts.

    Raises
    ------
    OptionError
        There are too few attitudes.
    ObservabilityError
        No headings of these attitudes determine the parameters.
    """
    from imulab.procedures.tumble.mag.prepare import WORST_CONDITION

    count = len(directions) + (0 if before is None else len(before[0]))
    if count < FEWEST:
        raise OptionError(f"with_ mag: {count} attitudes; a magnetometer needs {FEWEST} or more, better 16")
    axis = np.argmin(np.abs(np.round(directions, 6)), axis=1)
    norths = np.stack(
        [_direction_of_north(directions, axis, 2 * np.pi * step / steps) for step in range(steps)], axis=1
    )
    known, of_heading = _derivatives(np.repeat(directions, steps, axis=0), norths.reshape(-1, 3))
    rows = known.reshape(len(directions), steps, 2, -1)
    base = np.zeros((0, rows.shape[-1])) if before is None else _derivatives(*before)[0].reshape(-1, rows.shape[-1])
    chosen = _exchange_headings(rows, base, np.random.default_rng(seed))
    place = np.arange(len(directions))
    every = np.vstack([base, rows[place, chosen].reshape(-1, rows.shape[-1])])
    scaled = every / np.maximum(np.linalg.norm(every, axis=0), 1e-300)
    condition = float(np.linalg.cond(scaled))
    if not condition < WORST_CONDITION:
        raise ObservabilityError(
            f"with_ mag: no headings of these {count} attitudes determine a magnetometer (condition number "
            f"{condition:.0f}); expected attitudes over the whole sphere"
        )
    covariance: Array = np.asarray(np.linalg.inv(every.T @ every), dtype=np.float64)
    slope = of_heading.reshape(len(directions), steps, -1)[place, chosen]
    heading = float(np.sqrt(np.einsum("np,pq,nq->n", slope, covariance[:-1, :-1], slope).mean()))
    return Headings(axis, chosen, steps, norths[place, chosen], covariance, heading, condition, count - len(directions))


def _direction_of_north(up: Array, axis: NDArray[np.int64], heading: float) -> Array:
    """Return the direction of north, (n, 3), where the horizontal part of a body axis points `heading` from it."""
    pointer = np.eye(3)[axis]
    pointer = pointer - np.einsum("ni,ni->n", pointer, up)[:, None] * up
    pointer /= np.linalg.norm(pointer, axis=1)[:, None]
    north: Array = np.cos(heading) * pointer + np.sin(heading) * np.cross(up, pointer)
    return north


def _derivatives(up: Array, north: Array) -> tuple[Array, Array]:
    """Return the derivatives of |m| and dip, (n, 2, 13), and of heading, (n, 12), for nominal magnetometers."""
    field = np.cos(_DIP) * north - np.sin(_DIP) * up
    theta = np.zeros(_LAYOUT.size)
    theta[3:6] = 1.0
    theta[_LAYOUT.of_accel] = np.repeat([0.0, 1.0, 0.0], 3)
    theta[_LAYOUT.dip_at] = _DIP
    evaluated = evaluate_invariants(theta, up, field, _LAYOUT)
    east = world_axes(field, up)[:, 0]
    of_heading = np.einsum("ni,nip->np", east, evaluated.field.by_parameters) / np.cos(_DIP)
    return evaluated.by_parameters[:, 1:3, : _LAYOUT.mag + 1], of_heading


def _exchange_headings(rows: Array, base: Array, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return the best headings of several random starts, each exchanged until no exchange helps, shape (n,)."""
    count, steps, _, size = rows.shape
    each = np.einsum("nkri,nkrj->nkij", rows, rows)
    fixed = base.T @ base + _RIDGE * np.eye(size)
    best: NDArray[np.int64] = np.zeros(count, dtype=np.int64)
    least = np.inf
    for _ in range(max(2, min(_STARTS, _ATTITUDES_OVER_STARTS // count))):
        chosen = np.asarray(rng.integers(steps, size=count), dtype=np.int64)
        total = fixed + each[np.arange(count), chosen].sum(axis=0)
        for _ in range(_SWEEPS):
            moved = False
            for place in range(count):
                others = total - each[place, chosen[place]]
                cost = np.trace(np.linalg.inv(others + each[place]), axis1=1, axis2=2)
                step = int(np.argmin(cost))
                if cost[step] < cost[chosen[place]] * (1 - 1e-9):
                    chosen[place], moved = step, True
                total = others + each[place, chosen[place]]
            if not moved:
                break
        reached = float(np.trace(np.linalg.inv(total)))
        if reached < least:
            best, least = chosen, reached
    return best

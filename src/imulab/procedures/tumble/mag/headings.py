"""Which way to face in each attitude of a plan, so that magnetometers are seen as well as accelerometers.

An attitude is the upward direction in the body frame; which way it faces is the direction of one body axis, the one
nearest the horizontal. Headings are exchanged one by one, from several starts, for those with the least sum of the
variances of the magnetometers' parameters and the dip (A-optimal), the accelerometers being known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.errors import ObservabilityError, OptionError
from imulab.procedures.tumble.mag.field import FEWEST
from imulab.procedures.tumble.mag.judge import WORST_CONDITION
from imulab.procedures.tumble.mag.model import ACCELEROMETERS, MAGNETOMETERS, Layout, invariants, mag_names
from imulab.procedures.tumble.mag.pointing import world_axes
from imulab.recording import Array
from imulab.report.elements import plain_number

QUARTERS = ("north", "east", "south", "west")
_DIP = np.radians(67.0)
_SCATTER = 3e-3
"""Of |m|, as a part of the field, and of the dip, rad: what good recordings show (0.1 to 0.5 %, 0.16 to 0.29 deg)."""
_STARTS, _ENOUGH, _SWEEPS = 12, 600, 40
_RIDGE = 1e-9
_LAYOUT = Layout(6 + len(MAGNETOMETERS), 6 + len(ACCELEROMETERS))


@dataclass(frozen=True)
class Headings:
    """Which way each attitude of a plan faces, and what that gives for a magnetometer.

    Attributes
    ----------
    axis
        The body axis that points the way, 0 to 2, shape (n,).
    step
        Its heading, in steps of a full turn over `steps`, clockwise from north, shape (n,).
    steps
        Steps of a full turn.
    north
        The direction of north in the body frame, shape (n, 3).
    covariance
        Of biases and scale factors (parts of the field and of themselves), misalignments and dip, rad, per variance of
        |m| and dip, shape (13, 13).
    heading
        Standard uncertainty of magnetic heading by the parameters, rad, per standard deviation of |m| and dip, rms.
    condition_number
        Of the scaled Jacobian.
    already
        Number of attitudes with a known heading that were there before.
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
        """Return the same as name, text and unit as people read it."""
        kinds = {
            "mag_bias": (100.0, "% of the field"),
            "mag_scale_factor": (100.0, "%"),
            "mag_misalignment": (1e3, "mrad"),
        }
        found = []
        for name, value in self.uncertainties().items():
            factor, unit = kinds.get(name.rpartition("_")[0], (np.degrees(1.0), "deg"))
            found.append((name, plain_number(value * factor, 2), unit))
        return found

    @property
    def lead(self) -> str:
        """What the headings are for, and what they give."""
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
    """Choose which way each attitude faces.

    Parameters
    ----------
    directions
        Upward directions in the body frame, shape (n, 3).
    before
        The same, and that of north, of attitudes already there.
    steps
        Headings to choose from in a full turn.
    seed
        Of the random starts.

    Raises
    ------
    OptionError
        There are too few attitudes.
    ObservabilityError
        No headings of these attitudes determine the parameters.
    """
    count = len(directions) + (0 if before is None else len(before[0]))
    if count < FEWEST:
        raise OptionError(f"with_ mag: {count} attitudes; a magnetometer needs {FEWEST} or more, better 16")
    axis = np.argmin(np.abs(np.round(directions, 6)), axis=1)
    norths = np.stack([_north(directions, axis, 2 * np.pi * step / steps) for step in range(steps)], axis=1)
    known, of_heading = _rows(np.repeat(directions, steps, axis=0), norths.reshape(-1, 3))
    rows = known.reshape(len(directions), steps, 2, -1)
    base = np.zeros((0, rows.shape[-1])) if before is None else _rows(*before)[0].reshape(-1, rows.shape[-1])
    chosen = _exchange(rows, base, np.random.default_rng(seed))
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


def _north(up: Array, axis: NDArray[np.int64], heading: float) -> Array:
    """Return the direction of north, (n, 3), where the horizontal part of a body axis points `heading` from it."""
    pointer = np.eye(3)[axis]
    pointer = pointer - np.einsum("ni,ni->n", pointer, up)[:, None] * up
    pointer /= np.linalg.norm(pointer, axis=1)[:, None]
    north: Array = np.cos(heading) * pointer + np.sin(heading) * np.cross(up, pointer)
    return north


def _rows(up: Array, north: Array) -> tuple[Array, Array]:
    """Return the derivatives of |m| and dip, (n, 2, 13), and of heading, (n, 12), for nominal magnetometers."""
    field = np.cos(_DIP) * north - np.sin(_DIP) * up
    theta = np.zeros(_LAYOUT.size)
    theta[3:6] = 1.0
    theta[_LAYOUT.of_accel] = np.repeat([0.0, 1.0, 0.0], 3)
    theta[_LAYOUT.dip_at] = _DIP
    found = invariants(theta, up, field, _LAYOUT)
    east = world_axes(field, up)[:, 0]
    of_heading = np.einsum("ni,nip->np", east, found.field.by_parameters) / np.cos(_DIP)
    return found.by_parameters[:, 1:3, : _LAYOUT.mag + 1], of_heading


def _exchange(rows: Array, base: Array, rng: np.random.Generator) -> NDArray[np.int64]:
    """Exchange headings until none helps, from several random starts; return the best set's, shape (n,)."""
    count, steps, _, size = rows.shape
    each = np.einsum("nkri,nkrj->nkij", rows, rows)
    fixed = base.T @ base + _RIDGE * np.eye(size)
    best: NDArray[np.int64] = np.zeros(count, dtype=np.int64)
    least = np.inf
    for _ in range(max(2, min(_STARTS, _ENOUGH // count))):
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

"""Errors that a test shows beyond three standard uncertainties: corrected, and what is left of them made part of u.

The FOG's line is taken off X and Y as the axis would have seen it: turned back by the FOG's delay, scaled and turned
by the mismatch that Earth rate shows. Each correction's uncertainty is common to all runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from imulab.procedures.centrifuge.levels import RunLine
from imulab.procedures.centrifuge.mismatch import Measured, delays, mismatch
from imulab.procedures.centrifuge.rates import three_sigma
from imulab.procedures.centrifuge.regress import Complex
from imulab.procedures.centrifuge.run import LoadedRun

_FLOOR = 1e-4
"""What changes K by less than this part is left alone, however small its uncertainty."""
_QUARTER = np.array([1.0, 1j])
"""Y sees what is fixed in the arm a quarter turn from X."""


@dataclass(frozen=True)
class Corrections:
    """What the reduction does about errors that the test shows.

    Attributes
    ----------
    fog
        Run index to the factors of the FOG's line in each axis, shape (axes,).
    common
        What one standard uncertainty of each correction does to each run's lines: run index to rad/s, shape
        (k, axes).
    corrected
        Names of entries of the error budget.
    warnings
        What was found, a sentence each.
    """

    fog: dict[int, Complex] = field(default_factory=dict)
    common: dict[int, Complex] = field(default_factory=dict)
    corrected: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def find_corrections(runs: Sequence[LoadedRun], lines: dict[int, RunLine], *, correct: bool = True) -> Corrections:
    """Return what the lines of a test call for.

    Parameters
    ----------
    runs, lines
        As reduced, without any correction.
    correct
        Whether to correct what is found; otherwise all of it is uncertainty (method ``fourier``).
    """
    test = Measured([run for run in runs if run.index in lines], lines)
    axes = len(test.runs[0].channels) - 1
    late, shown = _delay(test, lines, axes, correct=correct)
    turn: Complex = np.exp(-1j * test.table * late)
    factor: Complex = turn[:, None] * np.ones(axes)
    if not test.both:
        for axis in range(axes):
            change, more = _difference(test, axis, axes, late, correct=correct)
            factor[:, axis] += turn * change
            shown += more
    if not shown:
        return Corrections()
    stacked = np.stack([item.common for item in shown], axis=1)
    return Corrections(
        {run.index: factor[i] for i, run in enumerate(test.runs)} if correct else {},
        {run.index: stacked[i] for i, run in enumerate(test.runs)},
        tuple(name for item in shown for name in item.named) if correct else (),
        tuple(item.warning for item in shown),
    )


@dataclass(frozen=True)
class _Finding:
    """An error that a test shows; `common` is what a standard uncertainty of it does to the lines, (runs, axes)."""

    common: Complex
    warning: str
    named: tuple[str, ...] = ()


def _delay(test: Measured, lines: dict[int, RunLine], axes: int, *, correct: bool) -> tuple[float, list[_Finding]]:
    """How much the FOG's line is turned back by, s, and what was found of delays."""
    found = delays(test)
    if found is None:
        return 0.0, []
    late = 0.0
    shown: list[_Finding] = []
    top = float(np.abs(test.table).max())
    turning = _is_clear(found.own, found.own_uncertainty) and abs(found.own) * top > _FLOOR
    size = max(abs(found.fog), abs(found.late)) if turning else abs(found.late)
    clear = _is_clear(found.fog, found.fog_uncertainty) or (_is_clear(found.late, found.uncertainty) and not turning)
    if clear and size * top * test.fog_share > _FLOOR:
        named: tuple[str, ...] = ()
        if correct and not turning:
            late, size, named = found.late, found.uncertainty, ("delay of the FOG", "delay of X")
            done = "its line was turned back by that, and what is uncertain of it is in u"
        else:
            done = "added to u, not corrected, since " + (
                "X turns against table_angle too, which a delay of X or differential flexure may do"
                if turning
                else "method fourier corrects nothing"
            )
        turn = np.exp(-1j * test.table * late)
        shown.append(
            _Finding(
                (1j * size * test.table * turn * test.fog)[:, None] * _QUARTER[:axes],
                f"the FOG is {1e3 * found.fog:.3g} ± {1e3 * found.fog_uncertainty:.1g} ms late against table_angle, "
                f"which changes K at the highest level by up to {100 * abs(found.fog) * top * test.fog_share:.2g} %: "
                f"{done}; mend the timing or the filters of the channels",
                named,
            )
        )
    if turning:
        drift = np.array([lines[run.index].line * run.force for run in test.runs])
        shown.append(
            _Finding(
                1j * found.own * test.table[:, None] * drift,
                f"X turns against table_angle as if it were {1e3 * found.own:.3g} ± {1e3 * found.own_uncertainty:.1g} "
                "ms late (differential flexure looks the same): added to the uncertainty of the direction, which it "
                f"changes by up to {np.degrees(abs(found.own) * top):.2g} deg at the highest level",
            )
        )
    return late, shown


def _difference(test: Measured, axis: int, axes: int, late: float, *, correct: bool) -> tuple[Complex, list[_Finding]]:
    """What to add to the factor of the FOG's line in an axis, by run, and what Earth rate shows of it."""
    change = np.zeros(len(test.runs), dtype=np.complex128)
    shown: list[_Finding] = []
    ratio = mismatch(test, axis, late)
    if ratio is None:
        return change, shown
    sense = np.array([run.run.sense for run in test.runs])
    turn = np.exp(-1j * test.table * late)
    for name, scale, value, unit in (
        ("scale mismatch", "per mille", ratio.scale, np.ones(len(sense))),
        ("FOG azimuth", "mrad", ratio.azimuth, 1j * sense),
    ):
        if not (_is_clear(value, ratio.uncertainty, ratio.freedom) and abs(value) * test.fog_share > _FLOOR):
            continue
        change += unit * value
        size = ratio.uncertainty if correct else abs(value)
        shown.append(
            _Finding(
                -size * (unit * turn * test.fog)[:, None] * _QUARTER[:axes] * (np.arange(axes) == axis),
                f"Earth rate shows a {name} of {1e3 * value:.3g} ± {1e3 * ratio.uncertainty:.1g} {scale} between "
                f"{'XY'[axis]} and the FOG, which would change K at the highest level by up to "
                f"{100 * abs(value) * test.fog_share:.2g} %: "
                f"{'corrected' if correct else 'method fourier does not correct it'}, and what is uncertain of it "
                "is in u; both senses of rotation remove it",
                (name,) if axis == 0 else (),
            )
        )
    return change, shown


def corrected(runs: Sequence[LoadedRun], found: Corrections) -> list[LoadedRun]:
    """Return the runs with the factors of their FOG's line and what is common to all of them."""
    return [replace(run, fog_factor=found.fog.get(run.index), common=found.common.get(run.index)) for run in runs]


def _is_clear(value: float, uncertainty: float, freedom: float | None = None) -> bool:
    return abs(value) > three_sigma(freedom) * uncertainty

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
    quarter = np.array([1.0, 1j])[:axes]
    turn = np.ones(len(test.runs), dtype=np.complex128)
    common: list[Complex] = []
    named: list[str] = []
    warnings: list[str] = []
    top = float(np.abs(test.table).max())
    found = delays(test)
    late = 0.0
    if found is not None:
        turning = _clear(found.own, found.own_uncertainty) and abs(found.own) * top > _FLOOR
        size = max(abs(found.fog), abs(found.late)) if turning else abs(found.late)
        clear = _clear(found.fog, found.fog_uncertainty) or (_clear(found.late, found.uncertainty) and not turning)
        if clear and size * top * test.fog_share > _FLOOR:
            if correct and not turning:
                late, size = found.late, found.uncertainty
                turn = np.exp(-1j * test.table * late)
                named += ["delay of the FOG", "delay of X"]
                done = "its line was turned back by that, and what is uncertain of it is in u"
            else:
                done = "added to u, not corrected, since " + (
                    "X turns against table_angle too, which a delay of X or differential flexure may do"
                    if turning
                    else "method fourier corrects nothing"
                )
            common.append((1j * size * test.table * turn * test.fog)[:, None] * quarter)
            warnings.append(
                f"the FOG is {1e3 * found.fog:.3g} ± {1e3 * found.fog_uncertainty:.1g} ms late against table_angle, "
                f"which changes K at the highest level by up to {100 * abs(found.fog) * top * test.fog_share:.2g} %: "
                f"{done}; mend the timing or the filters of the channels"
            )
        if turning:
            drift = np.array([lines[run.index].line * run.force for run in test.runs])
            common.append(1j * found.own * test.table[:, None] * drift)
            warnings.append(
                f"X turns against table_angle as if it were {1e3 * found.own:.3g} ± {1e3 * found.own_uncertainty:.1g} "
                "ms late (differential flexure looks the same): added to the uncertainty of the direction, which it "
                f"changes by up to {np.degrees(abs(found.own) * top):.2g} deg at the highest level"
            )
    factor = turn[:, None] * np.ones(axes)
    if not test.both:
        sense = np.array([run.run.sense for run in test.runs])
        for axis in range(axes):
            ratio = mismatch(test, axis, late)
            if ratio is None:
                continue
            for name, scale, value, unit in (
                ("scale mismatch", "per mille", ratio.scale, np.ones(len(sense))),
                ("FOG azimuth", "mrad", ratio.azimuth, 1j * sense),
            ):
                if not (_clear(value, ratio.uncertainty, ratio.freedom) and abs(value) * test.fog_share > _FLOOR):
                    continue
                factor[:, axis] += turn * unit * value
                size = ratio.uncertainty if correct else abs(value)
                common.append(-size * (unit * turn * test.fog)[:, None] * quarter * (np.arange(axes) == axis))
                named += [name] if axis == 0 else []
                warnings.append(
                    f"Earth rate shows a {name} of {1e3 * value:.3g} ± {1e3 * ratio.uncertainty:.1g} {scale} between "
                    f"{'XY'[axis]} and the FOG, which would change K at the highest level by up to "
                    f"{100 * abs(value) * test.fog_share:.2g} %: "
                    f"{'corrected' if correct else 'method fourier does not correct it'}, and what is uncertain of it "
                    "is in u; both senses of rotation remove it"
                )
    if not common:
        return Corrections()
    stacked = np.stack(common, axis=1)
    return Corrections(
        {run.index: factor[i] for i, run in enumerate(test.runs)} if correct else {},
        {run.index: stacked[i] for i, run in enumerate(test.runs)},
        tuple(named) if correct else (),
        tuple(warnings),
    )


def corrected(runs: Sequence[LoadedRun], found: Corrections) -> list[LoadedRun]:
    """Return the runs with the factors of their FOG's line and what is common to all of them."""
    return [replace(run, fog_factor=found.fog.get(run.index), common=found.common.get(run.index)) for run in runs]


def _clear(value: float, uncertainty: float, freedom: float | None = None) -> bool:
    return abs(value) > three_sigma(freedom) * uncertainty

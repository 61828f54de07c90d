"""Gyroscopes whose output is low-passed, by a filter of the device or by a moving average of its driver.

A filter whose gain at rest is 1 keeps the integral of the rate: a turn about a fixed axis is right once its output has
settled. Until then a share of each turn is missing, of all scale factors alike. It shows within the hold after the
turn: from one window to the next the gyroscopes go on turning, in proportion to the turn, and gravity does not. Turns
are then taken to end a window later.

A turn whose axis moves is another one after the filter, since rotations do not commute. For a filter that is fast
against the turns, with cumulants of its impulse response

M(t) = M_0(t - delay) + a M_0''(t) + b M_0'''(t) + ...

The delay changes no turn from rest to rest. a and b are found where the turns show them, and a M'' + b M''' taken off.

Source: Oppenheim, Willsky, Signals and systems, 1997, chapters 4 and 9 (filters, moments of the impulse response);
Savage, J. Guidance Control Dynamics 21 (1998) 19 (why the order of small rotations counts).
"""

from __future__ import annotations

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from imulab.display import Finding, Note
from imulab.estimation.decisions import GYROS_LOW_PASSED, GYROS_UNSETTLED
from imulab.estimation.least_squares import f_test
from imulab.procedures.tumble.gyro.estimate import normals
from imulab.procedures.tumble.gyro.solve import TurnProblem, TurnSolution, solve_turns
from imulab.procedures.tumble.gyro.turns import Stamps, body_rate, directions_missed, directions_smeared, model
from imulab.recording import Array

_LATEST = 3  # windows
_MOMENTS = 3  # of the rate over a turn: the tail of a filter of second order goes with its last part, too
_ROUNDS = 4
_SETTLED = 0.3  # standard uncertainties
_CORRECTED = 0.15  # of the rate, rms: with less, what the next terms leave is below the uncertainties of 23 turns
_DIVERGES = 0.5  # of the rate: with more the next terms are no smaller


class _Explained(Struct, frozen=True):
    """Coefficients of some columns, (k,), their covariance, (k, k), and the probability of them by chance (F-test)."""

    values: Array
    covariance: Array
    probability: float


def without_filter(
    case: TurnProblem, stamps: Stamps, sensitivity: str, solved: TurnSolution
) -> tuple[TurnProblem, TurnSolution, list[str]]:
    """Return the problem and its solution without what a low-pass filter does to turns, and what is to be said."""
    settling = explain_settling(solved)
    while settling is not None and settling.probability < GYROS_UNSETTLED.level and case.later < _LATEST:
        case = replace(case, later=case.later + 1)
        solved = solve_turns(case, stamps, sensitivity)
        settling = explain_settling(solved)
    settled = settling is not None and settling.probability >= GYROS_UNSETTLED.level
    notes = _settling_notes(case.later, settled=settled or not case.later)
    smear = explain_smear(solved)
    if smear.probability >= GYROS_LOW_PASSED.level:
        return case, solved, notes
    for _ in range(_ROUNDS):
        second, third = (case.smear + smear.values).tolist()
        share = _share_of_rate(solved, np.array([second, third]))
        if share > _DIVERGES:
            break
        case = replace(case, smear=(second, third))
        solved = solve_turns(case, stamps, sensitivity)
        smear = explain_smear(solved)
        if (np.abs(smear.values) < _SETTLED * np.sqrt(np.diag(smear.covariance))).all():
            break
    return case, solved, [*notes, _smear_note(share)]


def _settling_notes(later: int, *, settled: bool) -> list[str]:
    """Say that turns were taken to end so many windows later, and whether the gyroscopes have settled then."""
    if not later:
        return []
    shown = f"gyro: the gyroscopes go on turning for {later} s after the accelerometers come to rest"
    if settled:
        return [Note(f"{shown}, as behind a low-pass filter: turns are taken to end there")]
    return [
        Finding(
            f"{shown} or longer, as behind a low-pass filter: what is missing of each turn moves all scale factors",
            f"record again with a higher cut-off of the gyroscopes' filter, or with holds of {2 * later + 4} s",
        )
    ]


def _smear_note(share: float) -> str:
    shown = f"gyro: a low-pass filter changes the rates of the turns by {100 * share:.2g} % rms"
    if share <= _CORRECTED:
        return Note(f"{shown}, which is taken off")
    return Finding(
        f"{shown}, too much to be taken off: the parameters are less certain than stated",
        "record again with a higher cut-off of the gyroscopes' filter, or with slower turns",
    )


def _share_of_rate(solved: TurnSolution, smear: Array) -> float:
    """Return the root mean square of what is taken off, over that of the rate."""
    readings = solved.readings
    taken_off = np.tensordot(smear, readings.derivatives, 1) / solved.scale
    rate = readings.in_pieces(solved.rest).output / solved.scale
    step = readings.span.step[:, :, None]
    return float(np.sqrt((step * taken_off**2).sum() / (step * rate**2).sum()))


def explain_settling(solved: TurnSolution) -> _Explained | None:
    """Return the part that the last turn has in what gyroscopes put out after the window at which it is taken to end.

    None where too few holds are long enough to tell.
    """
    within = solved.readings.after_arrival(solved.rest)
    if within is None:
        return None
    segments = solved.readings.in_steps(solved.rest)
    angle = body_rate(segments, solved.scale, solved.theta) * segments.step[:, :, None]
    before_end = np.cumsum(np.where(segments.step > 0, segments.step, 0.0)[:, ::-1], axis=1)[:, ::-1]
    turned = np.zeros((len(solved.readings.case.force), _MOMENTS, 3))
    for k in range(_MOMENTS):
        turned[segments.attitude + 1, k] = (angle * (before_end**k)[:, :, None]).sum(axis=1)
    columns = np.cross(within.before[:, None, :], turned[within.attitude]).swapaxes(1, 2)
    missed = directions_missed(within, solved.scale, solved.theta)
    return _explain(np.empty((len(missed), 0)), columns.reshape(-1, _MOMENTS), missed, 2 * len(within.start))


def explain_smear(solved: TurnSolution) -> _Explained:
    """Return by how much the coefficients of the derivatives seem to be more than was taken off, in the kept turns.

    Turns that were set aside may be so for other reasons: a knock misses by any amount. A filter shows in the others.
    """
    readings, kept = solved.readings, solved.kept
    segments = solved.segments
    left, slopes = model(segments, solved.scale, solved.theta, solved.theta.size > 9)
    columns = directions_smeared(segments, readings.derivatives[:, kept], solved.scale, solved.theta)
    across = normals(segments.after)

    def project(vectors: Array) -> Array:
        turns = vectors.reshape(len(across), 3, -1)
        return np.asarray(np.einsum("mij,mjk->mik", across, turns).reshape(2 * len(across), -1))

    design = project(slopes)
    return _explain(design, project(columns), project(left)[:, 0], len(design))


def _explain(design: Array, columns: Array, values: Array, count: int) -> _Explained:
    """Return what columns beside a design explain of values, of which `count` are independent."""
    length = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    whole = np.column_stack([design, columns / length])
    size, larger = design.shape[1], whole.shape[1]
    answer = np.linalg.lstsq(whole, values, rcond=None)[0]
    left = values - whole @ answer
    plain = values - design @ np.linalg.lstsq(design, values, rcond=None)[0] if size else values
    cost = float(left @ left)
    spread = np.linalg.pinv(whole.T @ whole)[size:, size:] * cost / max(count - larger, 1)
    probability = f_test(float(plain @ plain), size, cost, larger, count)
    return _Explained(answer[size:] / length, spread / np.outer(length, length), probability)

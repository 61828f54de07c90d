"""Whole turns by hand against a fence to the scale factors of gyroscopes.

Between two rests at the fence the unit went through a whole number of turns n, so that the turns which the gyroscopes
state, composed, miss by ``2 pi n dS/S``. Each stop lies at the fence but for its own error, and belongs to the turn
before and to that after: ``u(S)/S = u_stop / (2 pi sqrt(sum (j_k - mean j)^2))``, j_k the turns made at stop k.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Unpack

import numpy as np

from imulab.errors import DataError, OptionError
from imulab.estimation.least_squares import chi_square_probability
from imulab.procedures.inputs import Record, as_record, as_recording
from imulab.procedures.rate.axes import BY_ACCELEROMETERS, other_unit_said, with_accelerometers
from imulab.procedures.rate.choices import AXES, FENCE, gyros_of, part_of_one
from imulab.procedures.rate.prior import prior_at, with_prior
from imulab.procedures.rate.turnaxes import check_accel, with_axes
from imulab.procedures.rate.turnrecord import turns_record
from imulab.procedures.rate.turnrests import AxisTurns, Motions, carried, composed, find_motions
from imulab.procedures.result import Result
from imulab.quantities import in_si
from imulab.reading import Data, Reading
from imulab.recording import Array
from imulab.records.calibration import Calibration

_TURN = 2 * np.pi
_SAME, _OTHER = np.radians(10), np.radians(30)
_PART, _WHOLE, _FIRST, _OFF = 0.4, 0.12, 0.2, 0.1
"""Parts of a turn: less is none; what whole turns miss by at most, and the first that tell the scale; of the scale."""
_ASKEW = 0.4
"""Turn about a second axis over that about the first, beyond which the axes of a turn cannot be told."""
_CHANCE = 0.01
_FACTORS = np.geomspace(0.4, 2.5, 41)
_CARRIES = np.radians(15)


@dataclass(frozen=True, repr=False)
class TurnsFit(Result):
    """Result of whole turns by hand.

    Attributes
    ----------
    calibration
        The record: scale factor and bias of each gyroscope that was turned.
    turns
        By body axis.

    Examples
    --------
    >>> import imulab as il
    >>> import numpy as np
    >>> gyro = np.zeros((1200, 3))
    >>> gyro[300:900, 2] = 60.6
    >>> float(round(il.fit_turns({"gyro": gyro}, rate=100, unit="deg/s").turns["z"].scale, 3))
    1.01
    """

    calibration: Calibration
    turns: dict[str, AxisTurns]


def fit_turns(
    data: Data,
    *,
    fence: float | str = FENCE,
    turns: str | Sequence[int] | None = None,
    clock: float | str | None = None,
    accel: Record | None = None,
    prior: Record | None = None,
    **reading: Unpack[Reading],
) -> TurnsFit:
    """Find the scale factors of gyroscopes from whole turns by hand, with a rest against a fence before and after each.

    ``S = sum of stated angles / (2 pi sum of turns)``, by generalised least squares over stops that two turns share.

    Parameters
    ----------
    data
        A file, recording, data frame or arrays with ``time`` and ``gyro_x``, ``_y``, ``_z`` in a unit of rate; with
        ``accel_*`` a wrong sample rate is found from turns that change the attitude.
    fence
        Standard uncertainty of the difference of two stops, rad.
    turns
        Number of turns of each in order, ``"1,5,-6"``; counted from the gyroscopes if not given.
    clock
        Relative standard uncertainty of the sample rate; without it the scale factors are those per clock.
    accel
        Record of `fit_tumble` of the same unit or its file, for turns about x, y and z on a level table: its
        ``accel_*`` tell the axes of the turns, and the result is a record of both triads, with misalignments.
    prior
        Earlier record of the same gyroscopes, of `fit_gyro` or of a rate test, or its file: both are one fit. The
        record says whether they agree, and holds what turns do not show as the prior has it. A thermal record is one at
        the mean temperature of the recording.
    reading
        How data are to be understood: `rate` or `time`, `unit`; `layout`, `topic`, `instance`, `window`, `element`.

    Raises
    ------
    SegmentError
        There are no rests between turns.
    DataError
        No motion is a whole turn, one is none, the sample rate cannot be right, or the accelerometers see another
        axis upright.
    ObservabilityError
        With accel: the unit was not turned about x, y and z.
    RecordError
        `accel` or `prior` is not such a record.
    OptionError
        An option has an unknown value.

    Source: GUM (JCGM 100:2008); Bortz, IEEE Trans. AES-7 (1971) 61.

    Examples
    --------
    >>> import imulab as il
    >>> import numpy as np
    >>> gyro = np.zeros((1200, 3))
    >>> gyro[300:900, 2] = 60.6
    >>> il.fit_turns({"gyro": gyro}, rate=100, unit="deg/s").calibration.parameters["gyro_scale_factor_z"].unit
    'deg/s/(rad/s)'
    """
    width = in_si(fence, "fence", "angle", "deg")
    if not 0 < width < 1:
        raise OptionError(f"fence {fence}: expected the uncertainty of the difference of two stops, such as 0.5 deg")
    of_clock = None if clock is None else part_of_one(clock, "clock")
    stated = None if turns is None else _counts(turns)
    held = None if accel is None else as_record(accel, "fit_turns: accel")
    recording = as_recording(data, reading, fit_turns, gyros_of)
    if held is not None:
        check_accel(held, recording)
    motions = find_motions(recording, width)
    _check_sample_rate(motions, recording.name)
    which = _turning(motions, recording.name)
    if stated is not None and len(stated) != len(which):
        raise OptionError(f"turns: {len(stated)} given, {len(which)} found in {recording.name}; expected one for each")
    found = {}
    for axis in range(3):
        own = [k for k in which if np.argmax(np.abs(motions.angle[k])) == axis]
        if own:
            angle = np.array([_whole_angle(motions, k, axis) for k in own])
            given = None if stated is None else np.array([stated[which.index(k)] for k in own], dtype=np.float64)
            count = _numbered(angle, motions, own, recording.name) if given is None else given
            _check_counts(angle / _TURN, count, motions, own, recording.name)
            found[AXES[axis]] = _scale(motions, own, axis, angle, count, width)
    record = turns_record(recording, motions, found, width, of_clock)
    if held is not None:
        record = with_axes(record, recording, motions, found, held)
    if prior is not None:
        frame = None if held is None else BY_ACCELEROMETERS
        record = with_prior(record, prior_at(as_record(prior, "fit_turns: prior"), [recording]), frame)
    if held is not None:
        record = with_accelerometers(held, record, other_unit_said(held, record.sensor, "accel"))
    return TurnsFit(record, found)


def _counts(turns: str | Sequence[int]) -> list[int]:
    try:
        found = [int(part) for part in (turns.split(",") if isinstance(turns, str) else turns)]
    except ValueError:
        found = []
    if not found or not all(found):
        raise OptionError(f"turns {turns!r}: expected whole numbers such as 1,5,-6")
    return found


def _tilt(motions: Motions, k: int) -> float:
    """Return the angle between gravity at the rests before and after a motion, rad; 0 where it is not known."""
    if motions.before is None or motions.after is None:
        return 0.0
    a, b = motions.before[k], motions.after[k]
    return float(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


def _check_sample_rate(motions: Motions, name: str) -> None:
    """Refuse a sample rate with which the motions do not carry gravity from one attitude to the next."""
    if motions.before is None or motions.after is None:
        return
    tipped = [k for k in range(len(motions.steps)) if _tilt(motions, k) > _OTHER]
    if len(tipped) < 2:
        return
    before, after = (v / np.linalg.norm(v, axis=1)[:, None] for v in (motions.before, motions.after))

    def misses(factor: float) -> float:
        turned = [carried(composed(motions.steps[k] * factor), before[k]) for k in tipped]
        angles = [np.arccos(np.clip(v @ after[k], -1, 1)) for v, k in zip(turned, tipped, strict=True)]
        return float(np.median(angles))

    best = min(_FACTORS.tolist(), key=misses)
    best = min((best * np.linspace(0.95, 1.05, 41)).tolist(), key=misses)
    if abs(best - 1) > _OFF and misses(best) < _CARRIES:
        way = "high" if best > 1 else "low"
        raise DataError(
            f"{name}: gravity is carried from attitude to attitude only if every turn was {best:.2f} times what the "
            f"gyroscopes and the sample rate say: is the stated sample rate {max(best, 1 / best):.2g} times too {way}, "
            "or the unit of the gyroscopes another?"
        )


def _turning(motions: Motions, name: str) -> list[int]:
    """Return which motions are turns: from an attitude to the same, and far enough round."""
    found = []
    for k in range(len(motions.start)):
        part = float(np.abs(motions.angle[k]).max()) / _TURN
        if _tilt(motions, k) > _SAME or part < _PART:
            continue
        if part < 1 - _PART:
            raise DataError(
                f"{name}: the turn at {motions.start[k]:.1f} to {motions.stop[k]:.1f} s is of {360 * part:.0f} deg by "
                "the gyroscopes: half a turn, or a whole one with a stated sample rate twice too high; expected whole "
                "turns"
            )
        first, second = np.argsort(-np.abs(motions.angle[k]))[:2].tolist()
        if abs(motions.angle[k, second]) > _ASKEW * abs(motions.angle[k, first]):
            degrees = np.degrees(motions.angle[k])
            raise DataError(
                f"{name}: the turn at {motions.start[k]:.1f} to {motions.stop[k]:.1f} s is about {AXES[first]} and "
                f"{AXES[second]} together ({degrees[first]:.0f} and {degrees[second]:.0f} deg): was the unit lifted or "
                "tipped, or do its axes lie askew? Expected turns about one axis"
            )
        found.append(k)
    if not found:
        raise DataError(f"{name}: no whole turn between two rests; expected one turn or more back to the same place")
    return found


def _whole_angle(motions: Motions, k: int, axis: int) -> float:
    """Return the angle about a body axis that the composed turn states, whole turns included, rad."""
    closing, rough = float(motions.closing[k, axis]), float(motions.angle[k, axis])
    return closing + _TURN * round((rough - closing) / _TURN)


def _numbered(angle: Array, motions: Motions, own: list[int], name: str) -> Array:
    """Return the number of turns of each angle, signed: the smaller ones tell the scale for the larger."""
    ratio, count, scale = angle / _TURN, np.zeros(len(angle)), 1.0
    done: list[int] = []
    for k in np.argsort(np.abs(ratio)).tolist():
        low, high = (int(f(abs(ratio[k]) / (1 + s * _OFF))) for f, s in ((np.ceil, 1), (np.floor, -1)))
        where = f"{name}: the turn at {motions.start[own[k]]:.1f} to {motions.stop[own[k]]:.1f} s"
        if not done and high > low:
            raise DataError(
                f"{where} is of {360 * abs(ratio[k]):.0f} deg by the gyroscopes: {low} to {high} turns; begin with one "
                "turn, or say how many there were (--turns)"
            )
        number = abs(ratio[k]) / scale
        missing, whole = abs(number - round(number)), round(number)
        if not done and whole > 1 and _FIRST < missing < 1.5 * _OFF * whole:
            raise DataError(
                f"{where} is of {360 * number:.0f} deg by the gyroscopes: {whole} turns with a scale factor of "
                f"{number / whole:.3f}, or {number:.2f} turns, which are not whole; begin with one turn, or say "
                "how many there were (--turns)"
            )
        if whole == 0 or missing > (_WHOLE if done or whole == 1 else _FIRST):
            raise DataError(
                f"{where} is of {360 * number:.0f} deg: {number:.2f} turns; expected a whole number, back to the same "
                "place at the fence"
            )
        count[k] = np.sign(ratio[k]) * round(number)
        done.append(k)
        scale = float(np.abs(ratio[done]).sum() / np.abs(count[done]).sum())
    return count


def _check_counts(ratio: Array, count: Array, motions: Motions, own: list[int], name: str) -> None:
    """Refuse a stated number of turns that does not go with the others."""
    scale = float(np.median(ratio / count))
    off = np.abs(ratio / scale - count)
    k = int(np.argmax(off))
    if off[k] > 0.5:
        raise DataError(
            f"{name}: the turn at {motions.start[own[k]]:.1f} to {motions.stop[own[k]]:.1f} s is of "
            f"{360 * ratio[k]:.0f} deg, {count[k]:+.0f} turns as stated, but {ratio[k] / scale:+.2f} as the others go: "
            "is --turns right?"
        )


def _scale(motions: Motions, own: list[int], axis: int, angle: Array, count: Array, fence: float) -> AxisTurns:
    """Return the scale factor: turns one after the other share a stop, whose error is opposite in both."""
    covariance = np.diag(fence**2 + motions.zero[own, axis] ** 2)
    for k in range(len(own) - 1):
        if own[k + 1] == own[k] + 1:
            covariance[k, k + 1] = covariance[k + 1, k] = -(fence**2) / 2
    turned = _TURN * count
    weight = np.linalg.solve(covariance, turned)
    variance = 1 / float(turned @ weight)
    scale = variance * float(weight @ angle)
    left = angle - scale * turned
    chi_square, freedom = float(left @ np.linalg.solve(covariance, left)), len(own) - 1
    beyond = freedom > 0 and chi_square_probability(chi_square, freedom) < _CHANCE
    wide = chi_square / freedom if beyond else 1.0
    return AxisTurns(
        count=count,
        angle=angle,
        residual=left,
        uncertainty=np.sqrt(np.diag(covariance)),
        scale=scale,
        scale_uncertainty=float(np.sqrt(variance * wide)),
        freedom=freedom if beyond else None,
        motion=tuple(own),
    )

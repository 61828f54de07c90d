"""Accelerometers over temperature as autopilots hold them: a cubic of the offset in the temperature, and one scale.

Both programs subtract an offset that follows the temperature, clipped to a range, and multiply by a scale factor that
does not. So ``O(T) = S(T) b(T)`` of each axis becomes a cubic (least squares at 64 Chebyshev nodes), the scale the
reciprocal of the middle of S; what S and misalignment do over temperature is lost, and said in figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from imulab.errors import OptionError
from imulab.exporters import ExportOptions
from imulab.exporters.model import gyro_terms, origin_of
from imulab.procedures.registry import procedure_of
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.triads import AccelerometerLaws, text_in_g
from imulab.units import STANDARD_GRAVITY

_NODES = np.cos(np.pi * (np.arange(64) + 0.5) / 64)
_NEGLIGIBLE = 1e-6
_CORNERS = np.array([corner for corner in product((-1.0, 0.0, 1.0), repeat=3) if any(corner)])
_FORCES = STANDARD_GRAVITY * _CORNERS / np.linalg.norm(_CORNERS, axis=1)[:, None]


@dataclass(frozen=True)
class OffsetLaw:
    """``(raw - offset(T)) * scale``, m/s^2: offsets as cubics of ``T - reference``, rows of powers, (4, 3).

    `rest`: the same of the gyroscopes, rad/s, ``raw - rest(T)``, None without; `lost`: comments on what is left out;
    `origin`: where the numbers come from.
    """

    low: float
    high: float
    reference: float
    offset: Array
    scale: Array
    rest: Array | None
    lost: list[str]
    origin: list[str]


def offset_law(
    records: Sequence[Calibration], target: str, options: ExportOptions, reference: float | None = None
) -> OffsetLaw | None:
    """Return what an autopilot takes of a record over temperature, about `reference` or the middle of its range.

    None where no record is over temperature.

    Raises
    ------
    OptionError
        There is another record beside it, outputs are in counts or volts, or something is lost and that was not asked
        for.
    RecordError
        The record lacks a coefficient.
    """
    over = [record for record in records if procedure_of(record).over_temperature]
    if not over:
        return None
    if len(records) != 1:
        raise OptionError(f"{target}: a {over[0].procedure} record goes alone, found {len(records)} records")
    laws = procedure_of(over[0]).laws(over[0])
    if laws.unit != "m/s^2":
        raise OptionError(
            f"{target}: corrects outputs in m/s^2, but the record is for accelerometers with outputs in {laws.unit}"
        )
    middle, half = 0.5 * (laws.low + laws.high), 0.5 * (laws.high - laws.low)
    about = middle if reference is None else reference
    temperature = middle + half * _NODES
    held = laws.parameters(temperature)
    design = ((temperature - about) / half)[:, None] ** np.arange(4)
    exact = held[:, 3:6] * held[:, :3]
    offset = np.linalg.lstsq(design, exact)[0]
    bent = float(np.abs(design @ offset - exact).max())
    scale = 2 / (held[:, 3:6].max(axis=0) + held[:, 3:6].min(axis=0))
    error = (laws.output(_FORCES, temperature) - (design @ offset)[:, None, :]) * scale - _FORCES
    slope = np.abs(np.diff(design @ offset, axis=0) / np.diff(temperature)[:, None]).max() * scale.max()
    size = half ** np.arange(4.0)[:, None]
    rest, costs, follows = _rest(over[0], target, temperature, design)
    if len(laws.knots) > 2:
        costs = [f"the bends of the bias beyond a cubic, up to {text_in_g(bent)}", *costs]
    lost = _settle(target, laws, error, float(slope), costs, options) + follows
    return OffsetLaw(
        laws.low,
        laws.high,
        about,
        offset / size,
        scale,
        None if rest is None else rest / size,
        lost,
        origin_of(over[0]),
    )


def _rest(
    record: Calibration, target: str, temperature: Array, design: Array
) -> tuple[Array | None, list[str], list[str]]:
    """Return the gyroscopes' offset as coefficients of a design, what its lack of all else costs, and a comment."""
    laws = procedure_of(record).gyro_laws(record)
    if laws is None:
        return None, [], []
    if laws.unit != "rad/s":
        raise OptionError(
            f"{target}: corrects rates in rad/s, but the record is for gyroscopes with outputs in {laws.unit}; fit "
            "without --with gyro"
        )
    triads = laws.at(temperature)
    exact = np.array([triad.scale * triad.bias for triad in triads])
    rest = np.linalg.lstsq(design, exact)[0]
    slope = np.abs(np.diff(design @ rest, axis=0) / np.diff(temperature)[:, None]).max()
    worst = max(triads, key=lambda triad: float(np.abs(triad.gain - np.eye(3)).sum(axis=1).max()))
    names, costs = gyro_terms(worst, bias=False)
    lost = [f"{' '.join(names)}, which changes outputs by {', '.join(costs)}"] if names else []
    if len(laws.knots) > 2:
        bent = np.degrees(3600 * np.abs(design @ rest - exact).max())
        lost.insert(0, f"the bends of the gyroscopes' bias beyond a cubic, up to {bent:.3g} deg/h")
    follows = f"the offset of the gyroscopes changes by up to {np.degrees(slope) * 3600:.3g} deg/h per K"
    return rest, lost, [follows]


def _settle(
    target: str, laws: AccelerometerLaws, error: Array, slope: float, costs: list[str], options: ExportOptions
) -> list[str]:
    """Refuse what would be lost, the costs of all else included, or return the comments that say so, and tell them."""
    span = f"from {laws.low:g} to {laws.high:g} degC"
    follows = [f"the offset changes by up to {text_in_g(slope)} per K {span}"]
    worst, left = float(np.abs(error).max()), list(costs)
    if worst > _NEGLIGIBLE * STANDARD_GRAVITY:
        rms = float(np.sqrt(np.mean(error**2)))
        left.insert(
            0,
            "scale factor over temperature and misalignment, which changes outputs at 1 g by "
            f"{text_in_g(rms)} rms, up to {text_in_g(worst)}, {span}",
        )
    if not left:
        return follows
    what = "; ".join(left)
    if not options.lossy:
        raise OptionError(f"{target} cannot hold {what}; add --lossy to leave it out")
    options.tell(f"{target}: left out (lossy): {what}")
    return [f"left out (lossy): {what}", *follows]

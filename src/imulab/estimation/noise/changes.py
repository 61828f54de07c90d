"""Changes of a log at rest that a model takes for slow noise, though no noise makes them: steps, and a warm-up.

Each is taken out, the noise is fitted again, and both fits are compared by their deviance plus 4 a parameter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imulab.estimation.decisions import LEVEL_STEP_PERHAPS, NOISE_CHANGES_SIZE, SENSOR_WARMS_UP, WARM_UP_PERHAPS
from imulab.estimation.distributions import chi_square_upper_quantile
from imulab.estimation.noise.analysis import CANDIDATES, PER_PARAMETER, Analysis, analysed, counted, without_steps
from imulab.estimation.noise.cleaning import LevelChange
from imulab.estimation.noise.spectrum import Stretch, variances_of_coefficients
from imulab.recording import Array

_FEW_STEPS, _WITHOUT_SLOW = 2, ("N", "NQ")
"""Most steps that are taken for what looks like slow noise; models that have no slow noise."""
_STEP_GAIN, _BESIDE_SLOW = 20.0, 25.0
"""What each step must gain where no slow noise is left: of 400 columns with a walk that hardly shows five gained more,
of steps of 13 standard uncertainties all of 40, of 10 32 of 40. And where it is left: steps said of 60 logs with random
walk gained 24 and 27, those of ten logs with a step of nine times the 1/f noise 26 to 43."""
_SHORTEST, _LONGEST, _TIMES = 0.01, 0.25, 14
"""Shortest and longest time constant of a warm-up that is tried, in lengths of its stretch, and how many are tried."""
_FEWEST_PARTS, _EITHER_SIDE, _LOUDER = 32, 5, 1.2
"""Fewest parts that tell a change of the noise's size, and fewest before and after it; a lesser change is not told."""
_COEFFICIENTS = 1 << 12  # lowest coefficients of a warm-up that are used: they fall with the square of the frequency


def changes_of_level(
    stretches: Sequence[Stretch], analysis: Analysis, candidates: tuple[str, ...], highest: float | None
) -> list[tuple[LevelChange, ...]]:
    """Return the changes of level of stretches, which explain them better than slow noise does; [] for none.

    Under a model with random walk a step is lost among its steps, so that it is looked for under white noise alone,
    too, as what leaves no slow noise.
    """
    steps = _steps_for_slow_noise(stretches, analysis, candidates)
    perhaps = [] if steps else analysis.steps(stretches, LEVEL_STEP_PERHAPS.limit)
    if any(perhaps):  # with the steps in the data, the model takes some of them for random walk
        after = analysed(cleaned := without_steps(stretches, perhaps), candidates, highest)
        gain = after.cost(stretches, analysis.model) - after.cost(cleaned, after.model)
        steps = after.steps(stretches) if gain > _BESIDE_SLOW * sum(map(len, perhaps)) else steps
    return steps


def _steps_for_slow_noise(
    stretches: Sequence[Stretch], analysis: Analysis, candidates: tuple[str, ...]
) -> list[tuple[LevelChange, ...]]:
    """Return the changes of level without which a column has no slow noise, where they explain it better."""
    if candidates != CANDIDATES or analysis.letters in _WITHOUT_SLOW:
        return []
    highest = analysis.band.highest
    steps = analysed(stretches, ("N",), highest).steps(stretches, LEVEL_STEP_PERHAPS.limit, _FEW_STEPS + 1)
    count = sum(map(len, steps))
    if not 0 < count <= _FEW_STEPS:
        return []
    cleaned = without_steps(stretches, steps)
    left = analysed(cleaned, candidates, highest)
    if left.letters not in _WITHOUT_SLOW:
        return []
    gain = left.cost(stretches, analysis.model) - left.cost(cleaned, left.model)
    return steps if gain > _STEP_GAIN * count else []


@dataclass(frozen=True)
class WarmUp:
    """A drift ``size exp(-t / time)`` after the start of a log, and the noise without it.

    Attributes
    ----------
    size, time
        In the unit of the samples, and s.
    lasts
        Time after which it is below the standard uncertainty of its size, s.
    gain
        Fall of the deviance, plus 4 a parameter, by taking it out.
    left
        The noise of the stretches without it.
    """

    size: float
    time: float
    lasts: float
    gain: float
    left: Analysis


def warm_up(
    analysis: Analysis, starts: Sequence[bool], others: Sequence[Sequence[Array]], candidates: tuple[str, ...]
) -> WarmUp | None:
    """Return the drift of a sensor that warms up, where it explains a column better than slow noise does; else None.

    Its size is sought beside the chosen noise, and beside white noise alone: what drifts for a third of a log is small
    beside the random walk that it is taken for.

    Parameters
    ----------
    analysis
        The column.
    starts
        For each stretch, whether a log starts with it.
    others
        Covariates, each with its slow coefficients (1, J) of each stretch: None where one of them explains more.
    candidates
        Letters of the models.
    """
    stretches = analysis.stretches
    longest = max(each.count * each.interval for each, is_start in zip(stretches, starts, strict=True) if is_start)
    times = longest * np.geomspace(_SHORTEST, _LONGEST, _TIMES)
    curves = [_curves(each, times, is_start) for each, is_start in zip(stretches, starts, strict=True)]
    white = [] if analysis.letters == "N" else [analysed(stretches, ("N",), analysis.band.highest)]
    best = None
    gain_needed = PER_PARAMETER + chi_square_upper_quantile(SENSOR_WARMS_UP.level, 2)
    for beside in (*white, analysis):
        z = np.abs(_scores(beside, curves))
        place = int(np.argmax(z))
        if z[place] < max(WARM_UP_PERHAPS.limit, *(np.abs(_scores(beside, each)).max() for each in others)):
            return best
        regression = beside.regressed([each[place : place + 1] for each in curves])
        left = analysed(regression.residual, candidates, analysis.band.highest)
        gain = left.cost(stretches, analysis.model) - left.cost(regression.residual, left.model)
        if gain > (best.gain if best else gain_needed):
            size, u = float(regression.slope[0]), float(regression.standard_uncertainty[0])
            best = WarmUp(size, float(times[place]), float(times[place] * np.log(abs(size) / u)), gain, left)
    return best


@dataclass(frozen=True)
class LoudnessChange:
    """A change of the size of fast noise: time from the start of the stretch, s, and the factor from then on."""

    time: float
    factor: float


def loudness_change(stretch: Stretch) -> LoudnessChange | None:
    """Return the clearest change of the size of the noise between two parts of a stretch; None where there is none.

    ``t = (mean after - mean before) / (s sqrt(1/k + 1/(p - k)))`` of the logarithms of the mean squares in p parts,
    s from differences of neighbours, so that noise of any colour has its own scatter; the largest of all k counts.
    """
    parts = len(stretch.loudness)
    if parts < _FEWEST_PARTS or not stretch.loudness.min() > 0:
        return None
    logs = np.log(stretch.loudness)
    logs = logs - logs.mean()
    scatter = np.sqrt(np.mean(np.diff(logs) ** 2) / 2)
    before = np.arange(_EITHER_SIDE, parts - _EITHER_SIDE + 1)
    rise = -np.cumsum(logs)[before - 1] * (1 / before + 1 / (parts - before))
    t = np.abs(rise) / scatter / np.sqrt(1 / before + 1 / (parts - before))
    place = int(np.argmax(t))
    factor = float(np.exp(rise[place] / 2))
    if t[place] < NOISE_CHANGES_SIZE.limit or max(factor, 1 / factor) < _LOUDER:
        return None
    return LoudnessChange(float(before[place] / parts * stretch.count * stretch.interval), factor)


def _curves(stretch: Stretch, times: Array, starts: bool) -> Array:
    """Return the lowest cosine coefficients of ``exp(-t / time)`` over a stretch, (k, J); 0 where no log starts."""
    n, many = stretch.count, min(len(stretch.slow), _COEFFICIENTS)
    if not starts:
        return np.zeros((len(times), many))
    falls = np.exp(-stretch.interval / times)[:, None]
    turns = np.pi * np.arange(1, many + 1) / (2 * n)
    # sum_i p^(i + 1/2) cos(pi j (i + 1/2)/n), from the sum of a geometric series
    ends = 1 - np.where(np.arange(1, many + 1) % 2, -1, 1) * np.exp(-n * stretch.interval / times)[:, None]
    total = np.sqrt(falls) * (1 - falls) * ends * np.cos(turns) / ((1 - falls) ** 2 + 4 * falls * np.sin(turns) ** 2)
    return np.asarray(np.sqrt(2 / n) * total)


def _scores(analysis: Analysis, covariates: Sequence[Array]) -> Array:
    """Return the size of each covariate alone over its standard uncertainty, shape (k,)."""
    right, information = np.zeros((2, len(covariates[0])))
    start, variances = 0, analysis.variances()
    for stretch, each in zip(analysis.stretches, covariates, strict=True):
        stop, many = start + len(stretch.spectra), each.shape[1]
        weight = counted(stretch, many) / variances_of_coefficients(variances[start:stop], stretch, many)
        right = right + each @ (weight * stretch.slow[:many])
        information = information + each**2 @ weight
        start = stop
    return np.asarray(right / np.sqrt(information))

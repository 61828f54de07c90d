"""The model of accelerometers and magnetometers at rest, and the magnetometers' means in the attitudes.

s = T m,  A_i = s_i (+ k2_i s_i^2),  M_i = S_i A_i + h_i          both triads, with a T of their own

Gravity and the field have one magnitude each, and one angle between them, in every attitude:

    r0 = |f| - 1,   r1 = |m| - 1,   r2 = dip(u, e) - delta,   dip = atan2(-u.e, |u x e|),   u = m/|m|, e = f/|f|

in units of gravity, of the field, and rad. The dip is positive where the field points down.

Sources: Gebre-Egziabher et al., J. Aerosp. Eng. 19 (2006) 87 (magnitude); Vasconcelos et al., IEEE Trans. Aerosp.
Electron. Syst. 47 (2011) 1293 (soft iron as one matrix); Liu et al., Sensors 14 (2014) 8485 (constant angle to
gravity).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.columns import triad as triad_of_columns
from imulab.display import Note
from imulab.errors import DataError, OptionError
from imulab.estimation.decisions import FIELD_FOLLOWS_TURNS
from imulab.estimation.rows import LeftOut, leave_out
from imulab.procedures.tumble.attitudes import POOL_DEGREES, Attitudes, stated_covariance
from imulab.procedures.tumble.checks import untilted
from imulab.procedures.tumble.model import invert
from imulab.recording import Array, Recording, check_finite
from imulab.units import parse_unit

# The model.


Pairs = tuple[tuple[int, int], ...]
ACCELEROMETERS: Pairs = ((1, 0), (2, 0), (2, 1))
"""Misalignments m_yx, m_zx, m_zy of the triad that defines the body frame."""
MAGNETOMETERS: Pairs = ((0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1))
"""Misalignments of a triad that is turned into that frame: field along j sensed by magnetometer i."""
_AXES = "xyz"


@dataclass(frozen=True)
class Vectors:
    """The vector that a triad measures, shape (n, 3), and the parts of its derivatives.

    ``dv = T^-1 (ds - dT v)``, ``ds = (dA - sum dk_j s^j) / A'(s)``: `back` is ``T^-1``, `slope` is A'(s), `reading` A.
    """

    vector: Array
    back: Array
    slope: Array
    reading: Array
    s: Array
    scale: Array
    pairs: Pairs
    highest: int

    def slopes(self, gradient: Array) -> tuple[Array, Array]:
        """Return the derivatives by parameters, (n, k, p), and outputs, (n, k, 3), of k functions of the vector.

        `gradient` are their gradients by the vector, shape (n, k, 3). The parameters are in the order zero (3),
        scale (3), misalignments, nonlinearity.
        """
        along = gradient @ self.back
        steep = along / self.slope[:, None, :]
        by_output = steep / self.scale
        i, j = np.transpose(self.pairs).tolist()
        columns = [-by_output, -by_output * self.reading[:, None, :], -along[:, :, i] * self.vector[:, None, j]]
        columns += [-steep * (self.s**power)[:, None, :] for power in range(2, self.highest + 1)]
        return np.concatenate(columns, axis=2), by_output

    @property
    def by_parameters(self) -> Array:
        """Derivatives of the vector, shape (n, 3, p)."""
        return self.slopes(np.broadcast_to(np.eye(3), (len(self.vector), 3, 3)))[0]


def invert_triad(theta: Array, output: Array, pairs: Pairs) -> Vectors:
    """Return the vector that a triad measures, by the inverse of its model: ``v = T^-1 s``.

    Parameters
    ----------
    theta
        Zero, scale, a misalignment for each of `pairs`, then k2 of three axes, k3 ..., shape (p,).
    output
        Shape (n, 3).
    pairs
        Places (i, j) of T's free off-diagonals.
    """
    fixed = 6 + len(pairs)
    scale, powers = theta[3:6], theta[fixed:].reshape(-1, 3)
    reading = (output - theta[:3]) / scale
    s = reading if not len(powers) else invert(reading, np.zeros(3), powers).force
    turn = np.eye(3)
    turn[tuple(np.transpose(pairs))] = theta[6:fixed]
    back = np.asarray(np.linalg.inv(turn), dtype=np.float64)
    slope = 1.0 + sum((j * k * s ** (j - 1) for j, k in enumerate(powers, start=2)), np.zeros_like(s))
    return Vectors(s @ back.T, back, slope, reading, s, scale, pairs, len(powers) + 1)


@dataclass(frozen=True)
class ParameterLayout:
    """Places of the parameters: of magnetometers, the dip, of accelerometers, and of held directions."""

    mag: int
    accel: int
    directions: int = 0

    @property
    def dip_at(self) -> int:
        """Place of the dip."""
        return self.mag

    @property
    def of_accel(self) -> slice:
        """Places of the accelerometers' parameters."""
        return slice(self.mag + 1, self.mag + 1 + self.accel)

    @property
    def of_directions(self) -> slice:
        """Places of the parameters of directions held."""
        return slice(self.mag + 1 + self.accel, self.size)

    @property
    def size(self) -> int:
        """Number of all parameters."""
        return self.mag + 1 + self.accel + self.directions


@dataclass(frozen=True)
class Invariants:
    """Residuals of both triads in each attitude and their derivatives.

    `residuals` has shape (n, k): |f| - 1, |m| - 1, dip - delta, and what else is held. `by_parameters` has shape
    (n, k, p); `by_outputs`, shape (n, 3, 6), is that of the first three by the outputs of the accelerometers and then
    of the magnetometers. `force` and `field` are f and m with their derivatives.
    """

    residuals: Array
    by_parameters: Array
    by_outputs: Array
    force: Vectors
    field: Vectors


def dip_angles(field: Array, force: Array) -> Array:
    """Return ``atan2(-u.e, |u x e|)``, rad, shape (n,): positive where the field points against the specific force."""
    turn, back = [1, 2, 0], [2, 0, 1]
    across = field[:, turn] * force[:, back] - field[:, back] * force[:, turn]  # np.cross takes four times as long
    angle: Array = np.arctan2(-(field * force).sum(axis=1), np.sqrt((across**2).sum(axis=1)))
    return angle


def evaluate_invariants(theta: Array, accel: Array, mag: Array, layout: ParameterLayout) -> Invariants:
    """Return residuals and derivatives at a parameter vector.

    ``dr0 = e' df``, ``dr1 = u' dm``, ``dr2 = t' dm/|m| + v' df/|f| - d(delta)`` with
    ``t = -(e + u sin dip) / cos dip``, ``v = -(u + e sin dip) / cos dip``.

    Parameters
    ----------
    theta
        Shape (p,), as `layout` says.
    accel, mag
        Outputs, scaled so that vectors have a length of about 1, shape (n, 3).
    layout
        Places of the parameters.
    """
    m = invert_triad(theta[: layout.mag], mag, MAGNETOMETERS)
    f = invert_triad(theta[layout.of_accel], accel, ACCELEROMETERS)
    m_length, f_length = (np.sqrt((sensed.vector**2).sum(axis=1)) for sensed in (m, f))
    u, e = m.vector / m_length[:, None], f.vector / f_length[:, None]
    dip = dip_angles(m.vector, f.vector)
    sine, cosine = np.sin(dip)[:, None], np.cos(dip)[:, None]
    t = -(e + u * sine) / cosine / m_length[:, None]
    v = -(u + e * sine) / cosine / f_length[:, None]
    by_parameters, by_outputs = np.zeros((len(mag), 3, layout.size)), np.zeros((len(mag), 3, 6))
    by_parameters[:, ::2, layout.of_accel], by_outputs[:, ::2, :3] = f.slopes(np.stack([e, v], axis=1))
    by_parameters[:, 1:, : layout.mag], by_outputs[:, 1:, 3:] = m.slopes(np.stack([u, t], axis=1))
    by_parameters[:, 2, layout.dip_at] = -1.0
    residuals = np.column_stack([f_length - 1, m_length - 1, dip - theta[layout.dip_at]])
    return Invariants(residuals, by_parameters, by_outputs, f, m)


def mag_names(order: int) -> list[str]:
    """Return the names of the magnetometers' parameters in a record, and of the dip."""
    return [
        *(f"mag_bias_{axis}" for axis in _AXES),
        *(f"mag_scale_factor_{axis}" for axis in _AXES),
        *(f"mag_misalignment_{_AXES[i]}{_AXES[j]}" for i, j in MAGNETOMETERS),
        *(f"mag_k2_{axis}" for axis in _AXES if order == 2),
        "dip",
    ]


# Means of the magnetometers in the attitudes of the accelerometers, and their covariance.


FEWEST = 10  # attitudes: for nine parameters of |m|, and one to check
_BATCHES = 8  # parts of a hold whose scatter gives the variance of its mean
_LAGS, _TIME_CONSTANTS = 0.01, 4.0
"""Part of the way from the last attitude that a lag leaves at the beginning of a hold, at least; and the time constants
that a hold must last to show where its outputs end."""
_DEAD = 1e-3  # of the largest span: an axis that spans less is dead
_CLIPPED = 0.3
"""Share of the attitudes at one extreme of an axis from which it is taken for saturated."""
_FLAT = 0.05  # of the largest spread: outputs that spread less across a plane lie in it
_MAGNET_NEAR = 4.5
"""Distance from the middle of the outputs over its median, from which a magnet was near; up to 4.1 without, where axes
differ in scale by a factor of 2."""


@dataclass(frozen=True)
class FieldMeans:
    """Outputs of the magnetometers in each attitude.

    `mean` has shape (n, 3), `covariance` (n, 3, 3), not a number for attitudes that were not asked for; the latter is
    None for a table that does not state it. `unit` is that of the columns, `notes` say what was left out.
    `of_one_sample` is the standard deviation of one axis of accelerometers and of magnetometers at rest, each in the
    unit of its columns; None for a table.
    """

    mean: Array
    covariance: Array | None
    unit: str
    notes: tuple[str, ...] = ()
    of_one_sample: tuple[float, float] | None = None


def field_means(attitudes: Attitudes, kept: NDArray[np.intp]) -> FieldMeans:
    """Return the magnetometers' mean outputs in the attitudes `kept`, from 0, checked for a fit.

    Raises
    ------
    DataError
        A constant or saturated axis, outputs in one plane, an attitude far from all others, too few attitudes, and as
        for `average_outputs`.
    OptionError, UnitError
        As for `average_outputs`.
    """
    means = average_outputs(attitudes, kept)
    tilt = untilted(attitudes.mean)
    _check_means(replace(means, mean=means.mean[kept]), attitudes.recording.name, triad_of_columns("mag"), tilt)
    _check_far(means.mean[kept], [attitudes.label(i) for i in kept], kept, attitudes.recording.name)
    return means


def average_outputs(attitudes: Attitudes, kept: NDArray[np.intp]) -> FieldMeans:
    """Return the magnetometers' mean outputs in the attitudes `kept`, from 0.

    A magnetometer that is slower than its log has samples in some of the rows, and no numbers in the others.

    Raises
    ------
    DataError
        No such columns, or no samples in an attitude.
    OptionError
        Some of the attitudes were taken out by hand.
    UnitError
        The columns have different units, or one of something else.
    """
    recording = attitudes.recording
    names = triad_of_columns("mag")
    missing = [name for name in names if name not in recording]
    if missing:
        beside = "expected the magnetometers beside the accelerometers, in the same attitudes"
        raise recording.lacking(f"column {' '.join(missing)}", missing[0], beside)
    unit = recording.triad_unit("mag")
    if parse_unit(unit).quantity not in ("magnetic field", "output", "number"):
        raise DataError(
            f"{recording.name}: columns {' '.join(names)}: expected a unit of field or output such as uT, mgauss or "
            f"count, found {unit!r}"
        )
    if attitudes.pieces is not None:
        return _means_of_stretches(attitudes, kept, recording, names, unit)
    if attitudes.trace is None:
        return _means_of_table(attitudes, recording, names, unit)
    raise OptionError(f"{recording.name}: expected all attitudes that were found; drop says which to leave out")


def _means_of_table(attitudes: Attitudes, recording: Recording, names: list[str], unit: str) -> FieldMeans:
    """Return the rows of a table of attitudes as means, with the covariance that it states."""
    check_finite(recording, names)
    rows = attitudes.start.astype(np.int64) - recording.first_row
    covariance = stated_covariance(recording, names, unit)
    return FieldMeans(recording.triad("mag")[rows], None if covariance is None else covariance[rows], unit)


def _means_of_stretches(
    attitudes: Attitudes, kept: NDArray[np.intp], recording: Recording, names: list[str], unit: str
) -> FieldMeans:
    """Return the means over the stretches at rest, and their covariance by batches, shrunk towards the usual one."""
    left_out, there = _read_samples(recording, names)
    samples = np.array(left_out.recording.triad("mag"))
    pieces, time = attitudes.pieces, recording.time
    assert pieces is not None
    assert time is not None
    force, scatter = recording.triad("accel"), np.empty((len(kept), 2))
    rests: dict[int, NDArray[np.intp]] = {}
    for place, number in enumerate(kept.tolist()):
        index = np.concatenate([np.arange(a, b) for a, b, at in pieces.tolist() if at == number])
        scatter[place, 0] = force[index].var(axis=0, ddof=1).mean()
        rests[number] = index[there[index]]
        if len(rests[number]) < 2:
            raise DataError(
                f"{recording.name}: {attitudes.label(number)}: {len(rests[number])} samples of {' '.join(names)}; "
                f"expected 2 or more: leave it out with --drop {number + 1}"
            )
    rest = np.isin(np.arange(len(samples)), np.concatenate(list(rests.values())))
    notes = left_out.notes(rest)
    step = np.array([_smallest_step(samples[rest, axis]) for axis in range(3)])
    mean, batch_covariance = np.full((len(attitudes), 3), np.nan), np.full((len(attitudes), 3, 3), np.nan)
    freedom = np.ones(len(attitudes))
    if lag := _find_lag(samples, time, rests):
        notes = [*notes, _describe_lag(lag, time, rests)]
    for place, (number, whole) in enumerate(rests.items()):
        index, grown = whole, 1.0
        if lag and len(whole) >= 3 * _BATCHES:
            index, samples[whole], grown = _take_lag_off(samples[whole], time[whole], whole, lag)
        mean[number] = samples[index].mean(axis=0)
        scatter[place, 1] = samples[index].var(axis=0, ddof=1).mean()
        parts = np.array_split(index, min(_BATCHES, len(index)))
        batches = np.array([samples[part].mean(axis=0) for part in parts])
        batch_covariance[number], freedom[number] = grown * np.cov(batches.T) / len(batches), len(batches) - 1.0
    level = np.trace(batch_covariance, axis1=1, axis2=2)
    usual = level <= 3 * np.median(level[kept])
    # One shape for all, whose inverse is hardly biased, and a size of each attitude.
    common = batch_covariance[usual].mean(axis=0)
    size = (freedom * level / np.trace(common) + POOL_DEGREES) / (freedom + POOL_DEGREES)
    covariance = size[:, None, None] * common
    covariance[:, range(3), range(3)] += np.where(
        covariance[kept][:, range(3), range(3)].mean(axis=0) < 1e-3 * step**2, step**2 / 12, 0.0
    )
    of_accel, of_mag = np.sqrt(np.median(scatter, axis=0)).tolist()
    return FieldMeans(mean, covariance, unit, tuple(notes), (of_accel, of_mag))


def _find_lag(samples: Array, time: Array, rests: Mapping[int, NDArray[np.intp]]) -> float:
    """Return the time constant, s, by which the outputs come after the turns; 0 where they do not.

    In each hold the outputs are projected on the way from the last hold, and regressed on ``exp(-t / tau)``: with a lag
    the slopes of all holds are alike and positive. Their scatter is the noise, of whatever colour.
    """
    ends = {number: samples[index[-(len(index) // 3 or 1) :]].mean(axis=0) for number, index in rests.items()}
    followed = [number for number in rests if number - 1 in ends and len(rests[number]) >= 3 * _BATCHES]
    if len(followed) < FEWEST:
        return 0.0
    ways = [ends[number - 1] - ends[number] for number in followed]
    sizes = np.array([np.linalg.norm(way) for way in ways])
    holds = [
        (time[rests[number]] - time[rests[number][0]], samples[rests[number]] @ way / size)
        for number, way, size in zip(followed, ways, sizes, strict=True)
    ]
    usual = float(np.median([since[-1] for since, _ in holds]))
    lag = min(usual * np.geomspace(0.02, 1.0, 25), key=lambda tau: _regress_decay(holds, tau)[0])
    lag = min(lag * np.geomspace(0.85, 1.18, 23), key=lambda tau: _regress_decay(holds, tau)[0])
    slopes = _regress_decay(holds, lag)[1] / sizes
    mean = np.average(slopes, weights=sizes**2)
    error = np.sqrt((sizes**4 * (slopes - mean) ** 2).sum()) / (sizes**2).sum()
    return float(lag) if mean > _LAGS and mean > FIELD_FOLLOWS_TURNS.limit * error else 0.0


def _regress_decay(holds: Sequence[tuple[Array, Array]], tau: float) -> tuple[float, Array]:
    """Return the sum of squares that ``c + s exp(-t / tau)`` leaves of times and values of holds, and each hold's s."""
    left, slopes = 0.0, np.empty(len(holds))
    for place, (since, values) in enumerate(holds):
        decay = np.exp(-since / tau)
        decay -= decay.mean()
        slopes[place] = decay @ values / (decay @ decay)
        left += float(((values - values.mean() - slopes[place] * decay) ** 2).sum())
    return left, slopes


def _take_lag_off(
    samples: Array, time: Array, index: NDArray[np.intp], lag: float
) -> tuple[NDArray[np.intp], Array, float]:
    """Return the later rows of a hold, its samples without the decay, and the factor by which their variance grows."""
    since = time - time[0]
    late = since >= min(2 * lag, since[-1] / 2)
    design = np.column_stack([np.ones(len(since)), np.exp(-since / lag)])
    inverse = np.linalg.inv(design[late].T @ design[late] + 1e-12 * np.eye(2))
    decay = (inverse @ design[late].T @ samples[late])[1]
    return index[late], samples - design[:, 1:] * decay, float(inverse[0, 0] * late.sum())


def _describe_lag(lag: float, time: Array, rests: Mapping[int, NDArray[np.intp]]) -> str:
    """Return what is said of outputs that come late: a note where the holds are long enough to tell where they end."""
    hold = float(np.median([np.ptp(time[index]) for index in rests.values()]))
    what = (
        f"mag: the outputs come to rest only after the turns, with a time constant of {lag:.2g} s (a low pass near "
        f"{1 / (2 * np.pi * lag):.2g} Hz)"
    )
    if hold < _TIME_CONSTANTS * lag:
        return f"{what}, too slow for holds of {hold:.2g} s: hold each attitude for {6 * lag:.2g} s or more"
    return Note(f"{what}; what still moved in the holds was taken off")


def _read_samples(recording: Recording, names: list[str]) -> tuple[LeftOut, NDArray[np.bool_]]:
    """Return the recording without invalid samples of the magnetometers, and which rows hold a sample."""
    there = np.logical_not(np.isnan(recording.triad("mag")).all(axis=1))
    filled = {name: np.where(there, recording.column(name), 0.0) for name in names}
    check_finite(recording.with_columns(filled, {}), names)
    if there.all():
        return leave_out(recording, names), there
    left_out = leave_out(replace(recording, columns={name: recording.column(name)[there] for name in names}), names)
    columns = {name: np.array(recording.column(name)) for name in names}
    kinds = {kind: np.zeros(len(recording), dtype=np.bool_) for kind in left_out.kinds}
    for name in names:
        columns[name][there] = left_out.recording.column(name)
    for kind, rows in left_out.kinds.items():
        kinds[kind][there] = rows
    return LeftOut(recording.with_columns(columns, {}), left_out.names, kinds), there


def _smallest_step(values: Array) -> float:
    """Return the smallest step between the values of a channel, 0 for one value."""
    different = np.unique(values)
    return float(np.diff(different).min()) if len(different) > 1 else 0.0


def _check_means(means: FieldMeans, name: str, names: list[str], tilt: str) -> None:
    """Refuse too few attitudes, a dead or saturated axis, and outputs in one plane; `tilt` says that it never was."""
    n = len(means.mean)
    if n < FEWEST:
        raise DataError(
            f"{name}: {n} attitudes{tilt}; a magnetometer needs {FEWEST} or more, better 16, of several tilts and "
            "headings; 'imulab magnetometer fit' takes a unit that was waved by hand"
        )
    span = np.ptp(means.mean, axis=0)
    for axis, column in enumerate(names):
        if span[axis] <= _DEAD * span.max() and not tilt:
            raise DataError(
                f"{name}: column {column}: the output changes by {span[axis]:.3g} {means.unit} over the {n} attitudes, "
                f"other axes by {span.max():.3g} {means.unit}: a dead axis?"
            )
    count, axis, extreme = count_extremes(means.mean)
    if count > max(2, _CLIPPED * n):
        word = "largest" if extreme > means.mean[:, axis].mean() else "smallest"
        raise DataError(
            f"{name}: column {names[axis]}: {count} of {n} attitudes have the {word} output, {extreme:.6g} "
            f"{means.unit}: the axis is saturated; expected a wider range, or less iron near"
        )
    flat = np.linalg.svd(means.mean - means.mean.mean(axis=0), compute_uv=False)
    if flat[2] < _FLAT * flat[0]:
        raise DataError(
            f"{name}: the outputs of {' '.join(names)} lie in one plane over the {n} attitudes (spread across it "
            f"{100 * flat[2] / flat[0]:.1f} % of that along it){tilt}; turn the unit "
            "about two axes"
        )


def count_extremes(mean: Array) -> tuple[int, int, float]:
    """Return the most attitudes in which one axis has its largest or smallest output, that axis, and that output."""
    ends = [(axis, float(end(mean[:, axis]))) for axis in range(3) for end in (np.max, np.min)]
    near = 1e-6 * np.ptp(mean, axis=0)
    return max((int((np.abs(mean[:, axis] - value) <= near[axis]).sum()), axis, value) for axis, value in ends)


def _check_far(mean: Array, labels: Sequence[str], kept: NDArray[np.intp], name: str) -> None:
    """Refuse outputs of one attitude that are far from all others, as with a magnet near."""
    distance = np.linalg.norm(mean - np.median(mean, axis=0), axis=1)
    distance /= np.median(distance)
    worst = int(np.argmax(distance))
    if distance[worst] > _MAGNET_NEAR:
        raise DataError(
            f"{name}: {labels[worst]}: the outputs of mag_x mag_y mag_z lie {distance[worst]:.1f} times as far from "
            f"the middle of all as usual: was a magnet near? leave the attitude out with --drop {kept[worst] + 1}"
        )

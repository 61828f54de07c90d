"""Runs to levels: pooled lines, repeatability of power cycles, and how the channels differ besides the drift.

A level's line is per specific force: ``Z = (A + i B) / a``, rad/s/(m/s^2), one complex number for each axis. Without an
encoder its phase is unknown; then magnitudes are pooled, each corrected for noise (Rice: ``-sigma^2 / 2 |Z|``).

A gyroscope that has another K after a power-off has it at all levels: such a change does not average out over levels,
and cancels in zeta. The scatter of the runs is split into an effect of the power cycle and the rest, by least squares
with a value for each level and one for each cycle; a variance is added where chi-square passes its 5 % point.

Source: Mandel and Paule, Analytical Chemistry 42 (1970) 1194.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imulab.display import Finding, Note
from imulab.errors import DataError
from imulab.estimation.decisions import CYCLES_SCATTER
from imulab.estimation.least_squares import chi_square_limit, excess_variance
from imulab.procedures.centrifuge.lines import Complex, three_sigma
from imulab.procedures.centrifuge.manifest import SAME_LEVEL, Manifest, fog_share, real_covariance
from imulab.procedures.centrifuge.run import LoadedRun
from imulab.recording import Array

# Repeatability: how power cycles, and runs within them, change the drift beyond noise.


@dataclass(frozen=True)
class Deviations:
    """Deviations of the runs' lines of one axis from the line of their level.

    Attributes
    ----------
    level, cycle
        Numbers of each run's level (and sense) and power cycle, shape (n,).
    size, turn
        Relative deviation along the line, and deviation across it, rad, shape (n,).
    size_variance, turn_variance
        Their variances from noise and rates, shape (n,).
    """

    level: NDArray[np.int64]
    cycle: NDArray[np.int64]
    size: Array
    turn: Array
    size_variance: Array
    turn_variance: Array


@dataclass(frozen=True)
class Repeatability:
    """Variances beyond the noise, common to all axes; 0 where noise explains the scatter.

    Attributes
    ----------
    cycle
        Relative variance of K from power cycle to power cycle, the same at all levels.
    turn
        Variance of the direction of the drift from power cycle to power cycle, rad^2.
    run
        Relative variance of K from run to run within a power cycle.
    chi_square, freedom
        Chi-square of the power cycles' effects on K over their noise, and its degrees of freedom.
    run_freedom
        Degrees of freedom of `run`.
    """

    cycle: float = 0.0
    turn: float = 0.0
    run: float = 0.0
    chi_square: float = 0.0
    freedom: int = 0
    run_freedom: int = 0


def find_repeatability(axes: Sequence[Deviations]) -> Repeatability:
    """Return the variances of power cycles and runs beyond the noise of the runs."""
    run, _, run_freedom = _excess([_run_effects(a, a.size, a.size_variance) for a in axes])
    cycle, chi_square, freedom = _excess([_cycle_effects(a, a.size, a.size_variance + run) for a in axes])
    turn, _, _ = _excess([_cycle_effects(a, a.turn, a.turn_variance) for a in axes])
    return Repeatability(cycle, turn, run, chi_square, freedom, run_freedom)


_Scatter = tuple[Array, Array, int]
"""Deviations, their variances, and their degrees of freedom."""


def _fitted(a: Deviations, values: Array, variance: Array) -> tuple[Array, Array, int]:
    """Return the effects of the power cycles (weighted mean zero), their weights, and the rank of the design."""
    levels, cycles = np.unique(a.level), np.unique(a.cycle)
    design = np.concatenate([a.level[:, None] == levels, a.cycle[:, None] == cycles], axis=1).astype(float)
    root = 1 / np.sqrt(np.maximum(variance, 1e-24))
    effects, _, rank, _ = np.linalg.lstsq(design * root[:, None], values * root, rcond=1e-9)
    weights: Array = design[:, len(levels) :].T @ root**2
    effect = effects[len(levels) :]
    return effect - np.average(effect, weights=weights), weights, int(rank)


def _cycle_effects(a: Deviations, values: Array, variance: Array) -> _Scatter:
    if not len(values):
        return np.empty(0), np.empty(0), 0
    effect, weights, rank = _fitted(a, values, variance)
    return effect, 1 / weights, rank - len(np.unique(a.level))


def _run_effects(a: Deviations, values: Array, variance: Array) -> _Scatter:
    if not len(values):
        return np.empty(0), np.empty(0), 0
    effect, _, rank = _fitted(a, values, variance)
    left = values - effect[np.searchsorted(np.unique(a.cycle), a.cycle)]
    weights = 1 / np.maximum(variance, 1e-24)
    for level in np.unique(a.level):
        mine = a.level == level
        left[mine] -= np.average(left[mine], weights=weights[mine])
    return left, 1 / weights, len(values) - rank


def _excess(parts: Sequence[_Scatter]) -> tuple[float, float, int]:
    """Return the variance to add, chi-square without it, and the degrees of freedom."""
    values, variance = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    freedom = sum(part[2] for part in parts)
    if not freedom:
        return 0.0, 0.0, 0
    chi_square = float((values**2 / variance).sum())
    if chi_square <= chi_square_limit(freedom, CYCLES_SCATTER.level):
        return 0.0, chi_square, freedom
    return float(excess_variance(values[None], variance[None], freedom)[0]), chi_square, freedom


# Pooling: the lines of all power cycles and both senses at one specific force, with their covariance.


@dataclass(frozen=True)
class RunLine:
    """Residual lines of a run per specific force.

    Attributes
    ----------
    line
        Line of each axis, shape (p,) for p axes; real and positive where only magnitudes are known.
    noise
        Covariance of (Re, Im) of each axis from noise, shape (2p, 2p).
    rate
        The same from the uncertainty of the arm rate.
    freedom
        Degrees of freedom of the noise.
    common
        Change of (Re, Im) of each axis by a standard uncertainty of each correction, shape (c, 2p).
    """

    source: LoadedRun
    line: Complex
    noise: Array
    rate: Array
    freedom: float
    common: Array

    @property
    def vector(self) -> Array:
        """(Re, Im) of each axis, shape (2p,)."""
        return as_vector(self.line)


@dataclass(frozen=True)
class Level:
    """All runs at one specific force, with the spin axis one way.

    Attributes
    ----------
    number
        Number of the level, rising with specific force; the reference is 1.
    force
        Mean specific force of its runs, m/s^2.
    line, covariance
        Pooled line and its covariance, shapes (p,) and (2p, 2p), without what all levels share: radius and power
        cycles.
    cycles
        Weight of each power cycle in the line of each axis, shape (p,).
    component_variance
        Variance of the noise of one component, shape (p,), for the Rice correction.
    freedom
        Degrees of freedom of the variance along each line, shape (p,).
    runs
        Numbers of its runs, counted from 0.
    directed
        Whether the lines have a direction (encoder), and not only a magnitude.
    common
        Change of (Re, Im) of each axis by a standard uncertainty of each correction, shape (c, 2p), with one sign at
        all levels.
    """

    number: int
    spin_axis: str
    force: float
    line: Complex
    covariance: Array
    cycles: dict[int, Array]
    component_variance: Array
    freedom: Array
    runs: tuple[int, ...]
    directed: bool
    common: Array


@dataclass(frozen=True)
class Levels:
    """All levels: spin axis up first, then by rising force.

    Attributes
    ----------
    items, lines
        The levels, and the lines of each run by its number.
    repeatability
        Variances of power cycles and runs beyond the noise.
    """

    items: tuple[Level, ...]
    lines: dict[int, RunLine]
    repeatability: Repeatability
    warnings: tuple[str, ...]


def as_vector(line: Complex) -> Array:
    """Return (Re, Im) of each number, shape (2p,)."""
    vector: Array = np.stack([line.real, line.imag], axis=1).ravel()
    return vector


def axis_lines(run: LoadedRun, method: str) -> tuple[Complex, Complex]:
    """Return the lines of X - FOG and Y - i FOG, rad/s, and their covariance ``E[z z*]``, by one of the methods."""
    share = fog_share(len(run.channels) - 1)
    if run.fog_factor is not None:
        share[:, -1] *= run.fog_factor
    if method == "fourier":
        assert run.whole_periods is not None
        line = share @ run.whole_periods.line
    else:
        line = share @ run.line
    return line, share @ run.covariance @ share.conj().T


def level_numbers(manifest: Manifest) -> dict[int, int]:
    """Return the level of each loaded run by its index: 1 at the reference, rising with force, 0 and less below it."""
    loaded = sorted((run.arm_rate, index) for index, run in enumerate(manifest.runs) if run.role == "loaded")
    clusters: list[list[int]] = []
    first = 0.0
    for rate, index in loaded:
        if not clusters or rate > first * (1 + SAME_LEVEL):
            clusters.append([])
            first = rate
        clusters[-1].append(index)
    forces = [np.mean([manifest.force(manifest.runs[i]) for i in cluster]) for cluster in clusters]
    reference = int(np.argmin([abs(force - manifest.reference) for force in forces]))
    return {index: number - reference + 1 for number, cluster in enumerate(clusters) for index in cluster}


def pool_levels(runs: Sequence[LoadedRun], manifest: Manifest, method: str) -> Levels:
    """Return runs pooled into levels, with the scatter beyond their noise.

    Raises
    ------
    DataError
        Some runs have a Y axis and others do not.
    """
    with_y = {len(run.channels) == 3 for run in runs}
    if len(with_y) > 1:
        lacking = next(run for run in runs if len(run.channels) == 2)
        raise DataError(f"{manifest.place(lacking.index)}: no column dtg_y, which other runs have")
    numbers = level_numbers(manifest)
    groups: dict[tuple[str, int], list[LoadedRun]] = {}
    for run in runs:
        if numbers[run.index] >= 1:
            groups.setdefault((run.run.spin_axis, numbers[run.index]), []).append(run)
    keys = sorted(groups, key=lambda key: (key[0] != "up", key[1]))
    lines: dict[int, RunLine] = {}
    warnings: list[str] = []
    undirected = []
    for key in keys:
        directed = all(run.encoder for run in groups[key])
        senses = {run.run.sense for run in groups[key]}
        if not directed and len(senses) == 2:
            undirected.append(key[1])
        for run in groups[key]:
            lines[run.index] = _run_line(run, manifest, method, directed)
    if undirected:
        warnings.append(
            Finding(
                f"{manifest.name}: no table_angle at level {', '.join(map(str, sorted(set(undirected))))}: magnitudes "
                "of the two senses were averaged, so that flexure and tilt do not cancel; the direction of the drift, "
                "which apply needs, is not known",
                "record table_angle in every run",
            )
        )
    members = [[lines[run.index] for run in groups[key]] for key in keys]
    repeatability = find_repeatability(_deviations(members))
    items = [
        pooled(key[1], key[0], group, repeatability, all(line.source.encoder for line in group))
        for key, group in zip(keys, members, strict=True)
    ]
    return Levels(tuple(items), lines, repeatability, (*warnings, *_scatter_warnings(repeatability)))


def _scatter_warnings(spread: Repeatability) -> list[str]:
    warnings: list[str] = []
    if spread.cycle:
        warnings.append(
            Note(
                f"K differs between power cycles by {100 * np.sqrt(spread.cycle):.2g} % (one standard deviation) "
                "beyond the noise, at all levels alike: added to every K and the curve; zeta hardly knows of it"
            )
        )
    if spread.turn:
        warnings.append(
            Note(
                f"the direction of the drift differs between power cycles by {np.degrees(np.sqrt(spread.turn)):.2g} "
                "deg (one standard deviation) beyond the noise: added to its uncertainty"
            )
        )
    if spread.run:
        warnings.append(
            Note(
                f"K differs between runs of a power cycle by {100 * np.sqrt(spread.run):.2g} % (one standard "
                "deviation) beyond the noise: added to each run's uncertainty"
            )
        )
    return warnings


def _run_line(run: LoadedRun, manifest: Manifest, method: str, directed: bool) -> RunLine:
    line, covariance = axis_lines(run, method)
    line, covariance = line / run.force, covariance / run.force**2
    common = np.zeros((0, len(line)), dtype=np.complex128) if run.common is None else run.common / run.force
    if not directed:
        size = np.maximum(np.abs(line), 1e-300)
        unit = line.conj() / size
        covariance = covariance * np.outer(unit, unit.conj())
        common = (common * unit).real.astype(np.complex128)
        if method == "least-squares":
            size = size - np.diagonal(covariance).real / 4 / size
        line = size.astype(np.complex128)
    vector = as_vector(line)
    off, u = arm_rate_off(run)
    clear_offset = abs(off) if abs(off) > three_sigma(run.rates.net_freedom) * u else 0.0
    relative = 2 * float(np.hypot(manifest.rate_uncertainty, clear_offset)) / run.run.arm_rate
    lost = amplitude_lost(run, manifest, method)
    rate = (relative**2 + lost**2) * np.outer(vector, vector)
    return RunLine(
        run, line, real_covariance(covariance), rate, run.freedom, np.array([as_vector(row) for row in common])
    )


def arm_rate_off(run: LoadedRun) -> tuple[float, float]:
    """Return by how much the arm rate, table rate plus net rate as measured, differs from the manifest's, and u; rad/s.

    Both are zero where a rate was not measured.
    """
    rates = run.rates
    if rates.net_rate is None or rates.origin == "manifest":
        return 0.0, 0.0
    u = float(np.hypot(rates.net_uncertainty or 0.0, rates.table_uncertainty or 0.0))
    return run.run.sense * (rates.table_rate + rates.net_rate) - run.run.arm_rate, u


def amplitude_lost(run: LoadedRun, manifest: Manifest, method: str) -> float:
    """Return the relative loss of amplitude by an error of the rate used, ``(error T)^2 / 24``, at most 1.

    With an encoder, or the rate of a clear FOG line, the loss is negligible; where the manifest's rate is used, the
    measured rate, or the uncertainty of the manifest's rates, bounds it.
    """
    measured = run.rates.table_uncertainty
    if method == "least-squares" and run.rates.origin != "manifest":
        error = measured or 0.0
    elif run.rates.origin == "manifest":
        error = manifest.rate_uncertainty
    else:
        error = float(np.hypot(abs(run.rates.table_rate) - run.run.table_rate, measured or 0.0))
    return min((error * run.duration) ** 2 / 24, 1.0)


def _weights(group: list[RunLine], axis: int, excess: float) -> Array:
    """Return inverse-variance weights of a level's runs for one axis; half for each sense where there are both."""
    variance = np.array([_radial(line, axis, excess) for line in group])
    weights: Array = 1 / np.maximum(variance, 1e-12 * variance.max() + 1e-300)
    senses = np.array([line.source.run.sense for line in group])
    for sense in np.unique(senses):
        weights[senses == sense] /= weights[senses == sense].sum() * len(np.unique(senses))
    return weights


def _radial(line: RunLine, axis: int, excess: float, *, rates: bool = True) -> float:
    """Return the variance along the line of one axis, or, without that of the rates, the variance across it."""
    pair = slice(2 * axis, 2 * axis + 2)
    noise = float(np.trace(line.noise[pair, pair])) / 2
    if not rates:
        return noise
    return noise + float(np.trace(line.rate[pair, pair])) + excess * float(abs(line.line[axis])) ** 2


def pooled(number: int, spin_axis: str, group: list[RunLine], repeatability: Repeatability, directed: bool) -> Level:
    """Return the level that runs at one specific force make, widened by the scatter beyond their noise."""
    axes = len(group[0].line)
    weights = np.array([_weights(group, axis, repeatability.run + repeatability.cycle) for axis in range(axes)])
    line = np.einsum("ar,ra->a", weights, np.array([member.line for member in group]))
    spread = np.repeat(weights, 2, axis=0)
    axis_blocks = np.kron(np.eye(axes), np.ones((2, 2)))  # a run's deviation of one axis says nothing of the other
    covariance = np.zeros((2 * axes, 2 * axes))
    for r, member in enumerate(group):
        total = member.noise + member.rate + repeatability.run * axis_blocks * np.outer(member.vector, member.vector)
        covariance += spread[:, r, None] * total * spread[None, :, r]
    component = np.zeros(axes)
    dof = np.zeros(axes)
    for axis in range(axes):
        pair = slice(2 * axis, 2 * axis + 2)
        noise = weights[axis] ** 2 * [float(np.trace(member.noise[pair, pair])) / 2 for member in group]
        component[axis] = noise.sum()
        between = float((weights[axis] ** 2 * repeatability.run * np.abs([m.line[axis] for m in group]) ** 2).sum())
        known = float((weights[axis] ** 2 * [float(np.trace(m.rate[pair, pair])) for m in group]).sum())
        spent = (noise**2 / [member.freedom for member in group]).sum() + between**2 / max(repeatability.run_freedom, 1)
        dof[axis] = (noise.sum() + between + known) ** 2 / max(spent, 1e-300)
    cycles = np.array([member.source.run.power_cycle for member in group])
    return Level(
        number, spin_axis, float(np.mean([m.source.force for m in group])), line, covariance,
        {int(cycle): weights[:, cycles == cycle].sum(axis=1) for cycle in np.unique(cycles)}, component,
        np.minimum(dof, 1e9), tuple(m.source.index for m in group), directed,
        np.einsum("ar,rca->ca", spread, np.array([member.common.reshape(-1, 2 * axes) for member in group])),
    )  # fmt: skip


def _deviations(members: list[list[RunLine]]) -> list[Deviations]:
    """Return, by axis, the deviations of runs from the mean of their level and sense."""
    by_axis = []
    for axis in range(len(members[0][0].line)):
        rows: list[tuple[int, int, float, float, float, float]] = []
        label = 0
        for group in members:
            for sense in (1, -1):
                same = [member for member in group if member.source.run.sense == sense]
                variance = np.array([_radial(member, axis, 0.0) for member in same])
                if len(same) < 2:
                    continue
                line = np.array([member.line[axis] for member in same])
                mean = complex(np.average(line, weights=1 / np.maximum(variance, 1e-300)))
                if abs(mean) ** 2 < 25 * variance.max():  # hardly above the noise, the line shows no relative scatter
                    continue
                label += 1
                off = line / mean - 1
                for member, value, along in zip(same, off, variance / abs(mean) ** 2, strict=True):
                    across = _radial(member, axis, 0.0, rates=False) / abs(mean) ** 2
                    rows.append((label, member.source.run.power_cycle, value.real, value.imag, along, across))
        columns = np.array(rows).reshape(-1, 6).T
        by_axis.append(Deviations(columns[0].astype(np.int64), columns[1].astype(np.int64), *columns[2:]))
    return by_axis


# Differences between the channels besides the drift: tilt and delay of the FOG, scale mismatch and azimuth.


_STEPS = 12  # of the iterations for tilt and delay
_LEAST = 3e-4
"""Gravity terms at the net rate, on a base that is not level, look like a mismatch of up to this size."""


class MeasuredRuns:
    """Arrays over runs, X axis: signed rates, forces, lines of FOG and residual, and variances of a component."""

    def __init__(self, runs: list[LoadedRun], lines: dict[int, RunLine]) -> None:
        self.runs = runs
        self.arm = np.array([run.run.sense * run.run.arm_rate for run in runs])
        self.table = np.array([run.rates.table_rate for run in runs])
        self.force = np.array([run.force for run in runs])
        self.x = np.array([run.line[0] for run in runs])
        self.fog = np.array([run.line[-1] for run in runs])
        self.fog_variance = np.array([run.covariance[-1, -1].real / 2 for run in runs])
        self.line = np.array([lines[run.index].line[0] for run in runs])
        self.line_variance = np.array([np.trace(lines[run.index].noise[:2, :2]) / 2 for run in runs])
        self.encoder = all(run.encoder for run in runs)
        self.top = self.force > 0.999 * self.force.max()
        self.K = float(np.abs(self.line[self.top]).mean())
        labels = np.round(np.abs(self.arm), 6)
        self.levels = len(np.unique(labels))
        self.both = self.encoder and all(len(set(np.sign(self.arm[labels == label]))) == 2 for label in labels)
        self.fog_share = float((np.abs(self.fog) / self.force)[self.top].mean()) / self.K


def weighted(design: Array, values: Array, variance: Array) -> tuple[Array, Array]:
    """Return the weighted least-squares solution and its covariance."""
    weight = 1 / np.sqrt(np.maximum(variance, 1e-12 * variance.max() + 1e-300))
    inverse = np.linalg.pinv(design * weight[:, None])
    return inverse @ (values * weight), inverse @ inverse.T


def _scatter(left: Array, variance: Array, used: int) -> float:
    """Return chi-square per degree of freedom, at least 1: the factor by which a model's misfit enlarges variances."""
    floor = np.maximum(variance, 1e-12 * variance.max() + 1e-300)
    return max(1.0, float((left**2 / floor).sum()) / max(len(left) - used, 1))


def _pairs(values: Complex) -> Array:
    return np.concatenate([values.real, values.imag])


def tilted(test: MeasuredRuns) -> tuple[Array, Array, bool]:
    """Return values, covariance, and whether tau is known, of ``-w_t (delta + kappa a) exp(i w_s tau)`` for the FOG."""
    with_flexure, with_delay = test.levels >= 2, test.levels >= 3
    parameters = np.zeros(5)
    variance = np.concatenate([test.fog_variance / test.arm**2] * 2)
    measured = -test.fog / test.arm
    covariance = np.zeros((5, 5))
    everything = [0, 1, *([2, 3] if with_flexure else []), *([4] if with_delay else [])]
    for step_number in range(_STEPS):
        # The delay shows only once there is a first value of the tilt.
        kept = everything if step_number else [index for index in everything if index < 4]
        tilt = parameters[0] + 1j * parameters[1] + (parameters[2] + 1j * parameters[3]) * test.force
        # A late channel shows an earlier angle: over the true angle its line is turned back by w_s tau.
        turn = np.exp(1j * test.table * parameters[4])
        columns = [turn, 1j * turn, turn * test.force, 1j * turn * test.force, 1j * test.table * tilt * turn]
        design = np.stack([_pairs(column) for column in columns], axis=1)[:, kept]
        scale = np.maximum(np.abs(design).max(axis=0), 1e-300)
        step, matrix = weighted(design / scale, _pairs(measured - tilt * turn), variance)
        parameters[kept] += step / scale
        covariance[np.ix_(kept, kept)] = matrix / np.outer(scale, scale)
    tilt = parameters[0] + 1j * parameters[1] + (parameters[2] + 1j * parameters[3]) * test.force
    left = _pairs(measured - tilt * np.exp(1j * test.table * parameters[4]))
    return parameters, covariance * _scatter(left, variance, len(everything)), with_delay


@dataclass(frozen=True)
class Mismatch:
    """How an axis shows the Earth's rate relative to the FOG: 1 + scale + i sense azimuth, with u of both parts."""

    scale: float
    azimuth: float
    uncertainty: float
    freedom: int


def mismatch(test: MeasuredRuns, axis: int = 0, delay: float = 0.0) -> Mismatch | None:
    """Return scale mismatch and azimuth of an axis against the FOG by the Earth's rate; None where that does not show.

    `delay` is that of the FOG against the axis, s.
    """
    with_net_line = [run for run in test.runs if run.rates.net_rate is not None]
    if not with_net_line:
        return None
    # A vector fixed in the room passes Y a quarter turn before X.
    quarter = (1.0, -1j)[axis]
    expected = np.array(
        [quarter * run.room[-1] * np.exp(-1j * (run.rates.net_rate or 0.0) * delay) for run in with_net_line]
    )
    ratio = np.array([run.room[axis] for run in with_net_line]) / expected - 1
    share = [np.array([1.0, -quarter]) for _ in with_net_line]
    noise = [run.room_covariance[np.ix_([axis, -1], [axis, -1])] for run in with_net_line]
    variance = (
        np.array([(s @ C @ s.conj()).real / 2 for s, C in zip(share, noise, strict=True)]) / np.abs(expected) ** 2
    )
    # A few blocks give a run's noise at the net rate; all runs together give it better.
    seconds = np.array([run.duration for run in with_net_line])
    variance = np.maximum((variance * seconds).mean() / seconds, 1e-300)
    weight = 1 / variance
    turned = ratio.real + 1j * ratio.imag * [run.run.sense for run in with_net_line]
    value = complex((weight * turned).sum() / weight.sum())
    u = np.sqrt(_scatter(_pairs(turned - value), np.concatenate([variance] * 2), 2) / weight.sum())
    return Mismatch(value.real, value.imag, float(u), max(2 * len(with_net_line) - 2, 1))


def _clear_share(mismatch_found: Mismatch | None, sense: Array) -> Complex:
    """Return how an axis shows the FOG's rotation; a mismatch that is not clear of its uncertainty counts as none."""
    share = np.ones(len(sense), dtype=np.complex128)
    if mismatch_found is not None:
        reach = max(three_sigma(mismatch_found.freedom) * mismatch_found.uncertainty, _LEAST)
        share += mismatch_found.scale * (abs(mismatch_found.scale) > reach) + 1j * sense * mismatch_found.azimuth * (
            abs(mismatch_found.azimuth) > reach
        )
    return share


@dataclass(frozen=True)
class Delays:
    """Delays against the encoder, s, with standard uncertainties: of the FOG, of X and Y, and of their difference."""

    fog: float
    fog_uncertainty: float
    axis: float
    axis_uncertainty: float
    uncertainty: float

    @property
    def late(self) -> float:
        """How much later than X the FOG is, s."""
        return self.fog - self.axis


def delays(test: MeasuredRuns) -> Delays | None:
    """Return the delays that the lines show by turning with the table rate; None without encoder or three levels.

    The FOG's from its own lines, ``-w_t (delta + kappa a) exp(i w_s tau)``; that of X from the rest of X without them,
    ``exp(i w_s tau_x) K a exp(i theta)``. Differential flexure across the drift looks like a delay of X.
    """
    if not test.encoder or test.levels < 3:
        return None
    parameters, covariance, _ = tilted(test)
    tau, u_tau = float(parameters[4]), float(np.sqrt(covariance[4, 4]))
    axis_delay, u_own = _axis_delay(test, tau)
    lever = (_axis_delay(test, tau + u_tau)[0] - axis_delay) / max(u_tau, 1e-300)
    return Delays(
        tau, u_tau, axis_delay, float(np.hypot(u_own, lever * u_tau)), float(np.hypot(u_own, (1 - lever) * u_tau))
    )


def _axis_delay(test: MeasuredRuns, tau: float) -> tuple[float, float]:
    """Return the delay of X and its uncertainty for a delay of the FOG, s."""
    axis_delay = u = 0.0
    sense = np.array([run.run.sense for run in test.runs])
    design = np.stack([np.ones(len(test.table)), test.table], axis=1)
    for _ in range(_STEPS):
        share = _clear_share(mismatch(test, 0, tau - axis_delay), sense)
        drift = (test.x - share * test.fog * np.exp(-1j * test.table * (tau - axis_delay))) / test.force
        angle = np.angle(drift / (drift / np.maximum(test.line_variance, 1e-300)).sum())
        variance = test.line_variance / np.abs(drift) ** 2
        slope, matrix = weighted(design, angle, variance)
        u = float(np.sqrt(matrix[1, 1] * _scatter(angle - design @ slope, variance, 2)))
        before, axis_delay = axis_delay, float(slope[1])
        if abs(axis_delay - before) < 1e-9:
            break
    return axis_delay, u

"""Runs to levels: the lines of all power cycles and both senses at one specific force, pooled with their covariance.

A level's line is per unit of specific force: ``Z = (A + i B) / a``, rad/s/(m/s^2), one complex number for each axis.
Without encoder its phase means nothing; then magnitudes are pooled, each corrected for noise (Rice: ``-sigma^2 / 2
|Z|``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imulab.errors import DataError
from imulab.procedures.centrifuge.manifest import SAME_LEVEL, Manifest
from imulab.procedures.centrifuge.model import fog_share, real_covariance
from imulab.procedures.centrifuge.rates import three_sigma
from imulab.procedures.centrifuge.regress import Complex
from imulab.procedures.centrifuge.repeat import Deviations, Repeatability, find_repeatability
from imulab.procedures.centrifuge.run import LoadedRun
from imulab.recording import Array
from imulab.verdict import Note


@dataclass(frozen=True)
class RunLine:
    """The residual lines of a run per unit of specific force.

    Attributes
    ----------
    line
        Shape (p,) for p axes; real and positive where magnitudes are used.
    noise
        Covariance of (Re, Im) of each axis from noise, shape (2p, 2p).
    rate
        The same from the arm rate's uncertainty.
    freedom
        Of the noise.
    common
        What a standard uncertainty of each correction does to (Re, Im) of each axis, shape (c, 2p).
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
    """One specific force with the spin axis one way.

    Attributes
    ----------
    number
        From 1, by rising specific force, the reference being 1.
    force
        Mean over its runs, m/s^2.
    line, covariance
        Pooled, shapes (p,) and (2p, 2p), without what is common to all levels: radius and power cycles.
    cycles
        Share of each power cycle in the line of each axis, shape (p,).
    component_variance
        Of the noise of one component, shape (p,), for the Rice correction.
    freedom
        Of the variance along each line, shape (p,).
    runs
        Numbers of its runs, counted from 0.
    directed
        Whether the lines are complex.
    common
        What a standard uncertainty of each correction does to (Re, Im) of each axis, alike in sign at all levels,
        shape (c, 2p).
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
    """All levels, spin axis up first, by rising force.

    Attributes
    ----------
    items, lines
        The levels, and the lines of each run by its number.
    repeatability
        What power cycles and runs do beyond the noise.
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
    """Return the lines of X - FOG and Y - i FOG, rad/s, and their covariance ``E[z z*]``, by one method."""
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
    """Return the level of each loaded run, by index: numbers from 1 at the reference, 0 and less below it."""
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
    """Pool runs into levels.

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
    warnings = []
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
            f"{manifest.name}: no table_angle at level {', '.join(map(str, sorted(set(undirected))))}: magnitudes of "
            "the two senses were averaged, so that flexure and tilt do not cancel; the direction of the drift, which "
            "apply needs, is not known"
        )
    members = [[lines[run.index] for run in groups[key]] for key in keys]
    repeatability = find_repeatability(_deviations(members))
    items = [
        pooled(key[1], key[0], group, repeatability, all(line.source.encoder for line in group))
        for key, group in zip(keys, members, strict=True)
    ]
    return Levels(tuple(items), lines, repeatability, (*warnings, *_scatter_warnings(repeatability)))


def _scatter_warnings(found: Repeatability) -> list[str]:
    warnings: list[str] = []
    if found.cycle:
        warnings.append(
            Note(
                f"K differs between power cycles by {100 * np.sqrt(found.cycle):.2g} % (one standard deviation) beyond "
                "the noise, at all levels alike: added to every K and the curve; zeta hardly knows of it"
            )
        )
    if found.turn:
        warnings.append(
            Note(
                f"the direction of the drift differs between power cycles by {np.degrees(np.sqrt(found.turn)):.2g} deg "
                "(one standard deviation) beyond the noise: added to its uncertainty"
            )
        )
    if found.run:
        warnings.append(
            Note(
                f"K differs between runs of a power cycle by {100 * np.sqrt(found.run):.2g} % (one standard deviation) "
                "beyond the noise: added to each run's uncertainty"
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
    found = abs(off) if abs(off) > three_sigma(run.rates.net_freedom) * u else 0.0
    relative = 2 * float(np.hypot(manifest.rate_uncertainty, found)) / run.run.arm_rate
    lost = amplitude_lost(run, manifest, method)
    rate = (relative**2 + lost**2) * np.outer(vector, vector)
    return RunLine(
        run, line, real_covariance(covariance), rate, run.freedom, np.array([as_vector(row) for row in common])
    )


def arm_rate_off(run: LoadedRun) -> tuple[float, float]:
    """Return how far the arm rate, table rate plus net rate as measured, is from the manifest's, and u; rad/s.

    Both are zero where a rate was not measured.
    """
    rates = run.rates
    if rates.net_rate is None or rates.origin == "manifest":
        return 0.0, 0.0
    u = float(np.hypot(rates.net_uncertainty or 0.0, rates.table_uncertainty or 0.0))
    return run.run.sense * (rates.table_rate + rates.net_rate) - run.run.arm_rate, u


def amplitude_lost(run: LoadedRun, manifest: Manifest, method: str) -> float:
    """Return the part of the amplitude that an error of the rate used costs, ``(error T)^2 / 24``, at most 1.

    With an encoder, or the rate of a clear line of the FOG, it is next to nothing; where the manifest's rate is taken
    as it is, what was measured of the rate, or the uncertainty of the manifest's rates, says how much it may be.
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
    """Inverse-variance weights of a level's runs for one axis; half for each sense where there are both."""
    variance = np.array([_radial(line, axis, excess) for line in group])
    weights: Array = 1 / np.maximum(variance, 1e-12 * variance.max() + 1e-300)
    senses = np.array([line.source.run.sense for line in group])
    for sense in np.unique(senses):
        weights[senses == sense] /= weights[senses == sense].sum() * len(np.unique(senses))
    return weights


def _radial(line: RunLine, axis: int, excess: float, *, rates: bool = True) -> float:
    """Variance along the line of one axis; without that of the rates, across it."""
    pair = slice(2 * axis, 2 * axis + 2)
    noise = float(np.trace(line.noise[pair, pair])) / 2
    if not rates:
        return noise
    return noise + float(np.trace(line.rate[pair, pair])) + excess * float(abs(line.line[axis])) ** 2


def pooled(number: int, spin_axis: str, group: list[RunLine], found: Repeatability, directed: bool) -> Level:
    """Return the level that runs at one specific force make, their scatter beyond the noise given."""
    axes = len(group[0].line)
    weights = np.array([_weights(group, axis, found.run + found.cycle) for axis in range(axes)])
    line = np.einsum("ar,ra->a", weights, np.array([member.line for member in group]))
    spread = np.repeat(weights, 2, axis=0)
    own = np.kron(np.eye(axes), np.ones((2, 2)))  # what a run does to one axis it need not do to the other
    covariance = np.zeros((2 * axes, 2 * axes))
    for r, member in enumerate(group):
        total = member.noise + member.rate + found.run * own * np.outer(member.vector, member.vector)
        covariance += spread[:, r, None] * total * spread[None, :, r]
    component = np.zeros(axes)
    dof = np.zeros(axes)
    for axis in range(axes):
        pair = slice(2 * axis, 2 * axis + 2)
        noise = weights[axis] ** 2 * [float(np.trace(member.noise[pair, pair])) / 2 for member in group]
        component[axis] = noise.sum()
        between = float((weights[axis] ** 2 * found.run * np.abs([m.line[axis] for m in group]) ** 2).sum())
        known = float((weights[axis] ** 2 * [float(np.trace(m.rate[pair, pair])) for m in group]).sum())
        spent = (noise**2 / [member.freedom for member in group]).sum() + between**2 / max(found.run_freedom, 1)
        dof[axis] = (noise.sum() + between + known) ** 2 / max(spent, 1e-300)
    cycles = np.array([member.source.run.power_cycle for member in group])
    return Level(
        number, spin_axis, float(np.mean([m.source.force for m in group])), line, covariance,
        {int(cycle): weights[:, cycles == cycle].sum(axis=1) for cycle in np.unique(cycles)}, component,
        np.minimum(dof, 1e9), tuple(m.source.index for m in group), directed,
        np.einsum("ar,rca->ca", spread, np.array([member.common.reshape(-1, 2 * axes) for member in group])),
    )  # fmt: skip


def _deviations(members: list[list[RunLine]]) -> list[Deviations]:
    """What each axis's runs found relative to the mean of their level and sense."""
    found = []
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
                if (
                    abs(mean) ** 2 < 25 * variance.max()
                ):  # hardly above the noise, it says nothing of a relative scatter
                    continue
                label += 1
                off = line / mean - 1
                for member, value, along in zip(same, off, variance / abs(mean) ** 2, strict=True):
                    across = _radial(member, axis, 0.0, rates=False) / abs(mean) ** 2
                    rows.append((label, member.source.run.power_cycle, value.real, value.imag, along, across))
        columns = np.array(rows).reshape(-1, 6).T
        found.append(Deviations(columns[0].astype(np.int64), columns[1].astype(np.int64), *columns[2:]))
    return found

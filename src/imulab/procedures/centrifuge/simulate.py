"""A simulated centrifuge test: every term of the error model, for a plan, a manifest or levels.

The equations of motion in the time domain, which the reduction does not share: it knows lines only. A vector fixed in
the arm stands in the gyroscope's frame at the angle chi (from X, turning to Y), which grows at the table rate; one
fixed in the room stands there at minus the angle by which the gyroscope has turned. An input axis at the angle psi
(X: 0, Y: a quarter turn, FOG: its azimuth error) senses the cosine of the angle between.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Annotated

import numpy as np

from imulab.display import Shown
from imulab.errors import OptionError, quoted
from imulab.files import write_text
from imulab.options import file, measure, text
from imulab.procedures.centrifuge.lines import FEWEST_PER_PERIOD
from imulab.procedures.centrifuge.manifest import Manifest, Run, load_manifest, make_manifest, manifest_text
from imulab.procedures.centrifuge.plan import Plan, plan_centrifuge, read_levels
from imulab.quantities import fraction, in_si, whole
from imulab.recording import Array, Recording
from imulab.units import STANDARD_GRAVITY, from_si, parse_unit, to_si
from imulab.writers import write_csv

# The error model, with every term a named parameter.


_DEG_H = np.pi / 180 / 3600  # rad/s
_DEG_ROOT_H = np.pi / 180 / 60  # rad/sqrt(s)
_PER_G = 1 / STANDARD_GRAVITY  # 1/(m/s^2)
_BLOCK = 65536  # samples drawn together; it bounds memory, and the drawn numbers depend on it


@dataclass(frozen=True)
class AxisTruth:
    """One axis of the gyroscope. Its component of the specific force is ``a cos(chi - psi)``.

    Attributes
    ----------
    bias
        D_F, rad/s.
    D_x, D_y
        Drift per specific force along X and along Y, rad/s/(m/s^2).
    c1, c2
        Change of both with the magnitude, ``1 + c1 a + c2 a^2``, 1/(m/s^2), 1/(m/s^2)^2.
    cross_x, cross_y
        D_XZ, D_YZ: per product of specific force along X or Y and along the spin axis, rad/s/(m/s^2)^2.
    quadratic, cubic
        D_XX, D_XXX: per square and cube of the axis's component, rad/s/(m/s^2)^2, rad/s/(m/s^2)^3.
    scale_error
        k_x: sensed rate is 1 + k_x times the true one.
    out_of_plane
        mu: angle of the input axis to the plane, rad; senses the net rate.
    differential_flexure, differential_phase
        kappa_d: tilt of this axis against the FOG per specific force, rad/(m/s^2), and where in the frame, rad.
    angle_random_walk
        Density of the white noise, rad/sqrt(s).
    drift
        Trend, rad/s^2.
    markov, markov_time
        Coloured noise: standard deviation, rad/s, and correlation time, s.
    """

    bias: float = 0.0
    D_x: float = 0.0
    D_y: float = 0.0
    c1: float = 0.0
    c2: float = 0.0
    cross_x: float = 0.0
    cross_y: float = 0.0
    quadratic: float = 0.0
    cubic: float = 0.0
    scale_error: float = 0.0
    out_of_plane: float = 0.0
    differential_flexure: float = 0.0
    differential_phase: float = 0.0
    angle_random_walk: float = 0.0
    drift: float = 0.0
    markov: float = 0.0
    markov_time: float = 1.0


@dataclass(frozen=True)
class FogTruth:
    """The fibre-optic gyroscope: azimuth error eta against X, rad; delay, s; the rest as for an axis."""

    bias: float = 0.0
    scale_error: float = 0.0
    azimuth: float = 0.0
    out_of_plane: float = 0.0
    delay: float = 0.0
    angle_random_walk: float = 0.0
    drift: float = 0.0


@dataclass(frozen=True)
class RigTruth:
    """Centrifuge and site.

    Attributes
    ----------
    tilt, tilt_phase
        delta: table axis against the arm's axis, rad, and its direction, rad.
    flexure, flexure_phase
        kappa: further tilt per specific force, rad/(m/s^2), and its direction, rad.
    base_tilt, base_phase
        Arm's axis against the vertical, rad: gravity terms at the net rate.
    earth_rate, earth_phase
        W_N: level component of Earth rate, rad/s, and its phase at the start of a run, rad.
    gravity
        Local gravity, m/s^2.
    arm_rate_error, table_rate_error
        True rate over the manifest's, minus 1.
    """

    tilt: float = 0.0
    tilt_phase: float = 0.0
    flexure: float = 0.0
    flexure_phase: float = 0.0
    base_tilt: float = 0.0
    base_phase: float = 0.0
    earth_rate: float = 0.0
    earth_phase: float = 0.0
    gravity: float = STANDARD_GRAVITY
    arm_rate_error: float = 0.0
    table_rate_error: float = 0.0


@dataclass(frozen=True)
class Truth:
    """All parameters of a simulated test; all zero unless stated."""

    x: AxisTruth = field(default_factory=AxisTruth)
    y: AxisTruth | None = None
    fog: FogTruth = field(default_factory=FogTruth)
    rig: RigTruth = field(default_factory=RigTruth)


def typical_truth(nonlinearity: float = 0.01, at: float = 20 * STANDARD_GRAVITY) -> Truth:
    """Return a tuned gyroscope of 3.3 deg/h/g on a rig with 10 arcsec of tilt.

    Parameters
    ----------
    nonlinearity
        K(at) / K(0) - 1.
    at
        Specific force, m/s^2.
    """
    K = 3.3 * _DEG_H * _PER_G
    angle = np.radians(25.0)
    axis = AxisTruth(
        bias=12.0 * _DEG_H,
        D_x=K * np.cos(angle),
        D_y=K * np.sin(angle),
        c2=nonlinearity / at**2,
        quadratic=0.002 * _DEG_H * _PER_G**2,
        out_of_plane=4e-4,
        angle_random_walk=0.01 * _DEG_ROOT_H,
        drift=1.0 * _DEG_H / 3600,
    )
    other = AxisTruth(
        bias=-7.0 * _DEG_H,
        D_x=-0.9 * K * np.sin(angle),
        D_y=0.9 * K * np.cos(angle),
        c2=0.6 * nonlinearity / at**2,
        quadratic=-0.001 * _DEG_H * _PER_G**2,
        out_of_plane=-3e-4,
        angle_random_walk=0.01 * _DEG_ROOT_H,
        drift=-0.5 * _DEG_H / 3600,
    )
    fog = FogTruth(bias=0.4 * _DEG_H, angle_random_walk=0.005 * _DEG_ROOT_H, out_of_plane=2e-4)
    rig = RigTruth(
        tilt=np.radians(10 / 3600), tilt_phase=0.7, flexure=2e-7 * _PER_G, flexure_phase=2.1,
        base_tilt=5e-5, base_phase=0.3, earth_rate=11.6 * _DEG_H, earth_phase=1.0,
    )  # fmt: skip
    return Truth(axis, other, fog, rig)


@dataclass(frozen=True, repr=False)
class Simulation(Shown):
    """A simulated test; `blocks` gives the recording of one run, the same one every time.

    Attributes
    ----------
    manifest, truth
        The simulated test and its parameters.
    sample_rate
        Hz.
    duration, static_duration
        Of a loaded and of a static run, s.
    encoder
        Whether the recordings have a `table_angle` column.
    unit
        Unit of the rates in the recordings.
    ramp
        Duration of a spin-up from rest at the start of every loaded run, s.
    seed
        Seed of the random numbers.
    """

    manifest: Manifest
    truth: Truth
    sample_rate: float = 100.0
    duration: float = 900.0
    static_duration: float = 300.0
    encoder: bool = True
    unit: str = "deg/h"
    ramp: float = 0.0
    seed: int = 1

    def __post_init__(self) -> None:
        for name, value, low, high in (
            ("sample rate", self.sample_rate, 5.0, 1e5),
            ("duration", self.duration, 1.0, 1e6),
            ("static duration", self.static_duration, 1.0, 1e6),
            ("ramp", self.ramp, 0.0, self.duration),
        ):
            if not low <= value <= high:
                raise OptionError(f"{name} {value:g}: expected {low:g} to {high:g}")
        fastest = max(run.table_rate for run in self.manifest.runs) / (2 * np.pi)
        if self.sample_rate < FEWEST_PER_PERIOD * fastest:
            raise OptionError(
                f"sample rate {self.sample_rate:g}: expected {FEWEST_PER_PERIOD * fastest:.3g} Hz or more, "
                f"{FEWEST_PER_PERIOD} samples in a period of the table"
            )
        if self.seed < 0:
            raise OptionError(f"seed {self.seed}: expected a whole number from 0")
        if parse_unit(self.unit).quantity != "rate":
            raise OptionError(f"unit {self.unit!r}: expected a unit of rate")

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return the simulated test in words, and its runs."""
        runs = self.manifest.runs
        rows = [[run.file, str(run.power_cycle), run.role, str(run.sense)] for run in runs]
        return f"simulated centrifuge test of {len(runs)} runs", ["file", "power cycle", "role", "sense"], rows

    def save(self, folder: str | Path, progress: Callable[[int], object] = lambda _: None) -> None:
        """Write manifest.toml, a CSV file for each run, and truth.json into a folder, made if it is not there.

        Raises
        ------
        OptionError
            The folder cannot be made, or holds files of these names that are no simulation; or the manifest names
            files in other folders.
        """
        home, test = Path(folder), self.manifest
        for run in test.runs:
            if Path(run.file).name != run.file:
                raise OptionError(f"{run.file}: expected file names without folders in a manifest to simulate")
        taken = [name for name in ("manifest.toml", *(run.file for run in test.runs)) if (home / name).exists()]
        if taken and not (home / "truth.json").is_file():
            raise OptionError(
                f"{home / taken[0]}: exists and is no simulation (no truth.json beside it); expected another folder"
            )
        try:
            home.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OptionError(f"{home}: the folder cannot be made: {error.strerror}") from None
        for done, run in enumerate(test.runs, start=1):
            write_csv(self(run), home / run.file)
            progress(done)
        write_text(home / "truth.json", json.dumps(asdict(self.truth), indent=1) + "\n")
        write_text(home / "manifest.toml", manifest_text(test, ["simulated; the truth is in truth.json, SI units"]))

    def blocks(self, run: Run, size: int = _BLOCK) -> Iterator[Recording]:
        """Yield the recording of a run in blocks of `size` samples."""
        index = self.manifest.runs.index(run)
        rng = np.random.default_rng([self.seed, index])
        start_angle = rng.uniform(0, 2 * np.pi)
        seconds = self.duration if run.role == "loaded" else self.static_duration
        count = round(seconds * self.sample_rate)
        state = np.zeros(2)
        for first in range(0, count, size):
            time = np.arange(first, min(first + size, count)) / self.sample_rate
            yield self._block(run, time, start_angle, rng, state)

    def __call__(self, run: Run) -> Iterator[Recording]:
        """Yield the recording of a run in blocks."""
        return self.blocks(run)

    def _block(self, run: Run, time: Array, start_angle: float, rng: np.random.Generator, state: Array) -> Recording:
        truth = self.truth
        columns = {"time": time}
        axes = [("dtg_x", truth.x, 0.0)]
        if truth.y is not None:
            axes.append(("dtg_y", truth.y, np.pi / 2))
        motion = _Motion(self, run, time, start_angle)
        for number, (name, axis, psi) in enumerate(axes):
            rate = _gyroscope(motion, axis, psi, truth.rig)
            rate += self._noise(axis.angle_random_walk, rng, len(time))
            if axis.markov:
                rate += _markov(axis, self.sample_rate, rng, len(time), state, number)
            columns[name] = from_si(rate, self.unit)
        late = _Motion(self, run, time - truth.fog.delay, start_angle) if truth.fog.delay else motion
        fog = _fog(late, truth.fog, truth.rig) + self._noise(truth.fog.angle_random_walk, rng, len(time))
        columns["fog"] = from_si(fog, self.unit)
        units = {"time": "s"} | {name: self.unit for name in columns if name != "time"}
        if self.encoder:
            columns["table_angle"] = np.degrees(motion.chi) % 360.0
            units["table_angle"] = "deg"
        return Recording(columns=columns, units=units, metadata=dict(self.manifest.sensor), name=run.file)

    def _noise(self, walk: float, rng: np.random.Generator, count: int) -> Array:
        """Return white noise of the rate whose integral is an angle random walk, rad/s."""
        if not walk:
            return np.zeros(count)
        noise: Array = walk * np.sqrt(self.sample_rate) * rng.standard_normal(count)
        return noise


class _Motion:
    """Rates and angles of the rig over a block: signed arm rate, chi, turned angle, specific force."""

    def __init__(self, simulation: Simulation, run: Run, time: Array, start_angle: float) -> None:
        rig = simulation.truth.rig
        arm = run.sense * run.arm_rate * (1 + rig.arm_rate_error)
        table = run.sense * run.table_rate * (1 + rig.table_rate_error)
        ramp = simulation.ramp if run.role == "loaded" else 0.0
        # Turned angle in units of the steady rate: a parabola during spin-up, then a line.
        turned = time if not ramp else np.where(time < ramp, time**2 / (2 * ramp), time - ramp / 2)
        share: Array | float = 1.0 if not ramp else np.minimum(time / ramp, 1.0)
        self.time = time
        self.arm = arm * share
        self.net = (arm - table) * share
        self.chi = start_angle + table * turned
        self.net_angle = (arm - table) * turned
        self.force = self.arm**2 * simulation.manifest.radius
        self.up = 1.0 if run.spin_axis == "up" else -1.0


def _common(motion: _Motion, psi: float, out_of_plane: float, rig: RigTruth) -> Array:
    """Return the rate of the body along an input axis at the angle psi, rad/s."""
    tilted = rig.tilt * np.cos(motion.chi + rig.tilt_phase - psi)
    bent = rig.flexure * motion.force * np.cos(motion.chi + rig.flexure_phase - psi)
    rate: Array = (
        motion.net * out_of_plane
        + rig.earth_rate * np.cos(rig.earth_phase - motion.net_angle - psi)
        - motion.arm * (tilted + bent)
    )
    return rate


def _gyroscope(motion: _Motion, axis: AxisTruth, psi: float, rig: RigTruth) -> Array:
    a, chi = motion.force, motion.chi
    along_x, along_y = a * np.cos(chi), a * np.sin(chi)
    growth = 1 + axis.c1 * a + axis.c2 * a**2
    spin = motion.up * rig.gravity
    along_drift = a * np.cos(chi - psi)
    level = rig.gravity * rig.base_tilt
    base = rig.base_phase - motion.net_angle
    rate: Array = (1 + axis.scale_error) * _common(motion, psi, axis.out_of_plane, rig)
    rate += axis.bias + axis.drift * motion.time
    rate += (growth * axis.D_x + spin * axis.cross_x) * along_x + (growth * axis.D_y + spin * axis.cross_y) * along_y
    rate += axis.quadratic * along_drift**2 + axis.cubic * along_drift**3
    rate += axis.D_x * level * np.cos(base) + axis.D_y * level * np.sin(base)
    if axis.differential_flexure:
        rate += motion.arm * axis.differential_flexure * a * np.cos(chi + axis.differential_phase - psi)
    return rate


def _fog(motion: _Motion, fog: FogTruth, rig: RigTruth) -> Array:
    rate = (1 + fog.scale_error) * _common(motion, fog.azimuth, fog.out_of_plane, rig)
    return rate + fog.bias + fog.drift * motion.time


def _markov(
    axis: AxisTruth, sample_rate: float, rng: np.random.Generator, count: int, state: Array, slot: int
) -> Array:
    """Return first-order Gauss-Markov noise, continued from block to block through `state`."""
    from scipy.signal import lfilter

    decay = np.exp(-1 / (sample_rate * axis.markov_time))
    drive = axis.markov * np.sqrt(1 - decay**2) * rng.standard_normal(count)
    noise: Array
    noise, final = lfilter([1.0], [1.0, -decay], drive, zi=state[slot : slot + 1])
    state[slot] = final[0]
    return noise


# The call that simulates a plan, a manifest, or levels and rates.


_LEVELS, _RADIUS, _NET_RATE = "1,2,5,10,15,20", "2 m", "40 deg/s"


def simulate_centrifuge(
    plan: Annotated[Manifest | Plan | str | PathLike[str] | None, file("PLAN.toml")] = None,
    truth: Truth | None = None,
    *,
    levels: Annotated[Sequence[float] | str, text("A,A,...", unit="g")] = _LEVELS,
    radius: Annotated[float | str, measure("length", "m")] = _RADIUS,
    net_rate: Annotated[float | str, measure("rate", "deg/s")] = _NET_RATE,
    cycles: int | str = 2,
    both_senses: bool = False,
    duration: Annotated[float | str, measure("time", "s")] = "5 min",
    static_duration: Annotated[float | str, measure("time", "s")] = "1 min",
    rate: Annotated[float | str, measure("frequency", "Hz")] = "50 Hz",
    nonlinearity: Annotated[float | str, text("FRACTION")] = "1 %",
    tilt: Annotated[float | str, measure("angle", "arcsec")] = "10 arcsec",
    no_angle: bool = False,
    unit: Annotated[str, text("UNIT")] = "deg/h",
    seed: int | str = 1,
    ramp: float = 0.0,
) -> Simulation:
    """Simulate the test of a tuned gyroscope of 3.3 deg/h/g, or of another truth.

    Parameters
    ----------
    plan
        Manifest to simulate, as plan writes it. A plan, a manifest, or its file; `levels` to `both_senses` say the test
        where none is given.
    truth
        Everything that the test has in it; a typical gyroscope of `nonlinearity` on a rig of `tilt` if not given.
    levels
        Specific forces in g, with commas; the lowest is the reference. As numbers in m/s^2.
    radius, net_rate
        As for `plan_centrifuge`.
    cycles, both_senses
        As for `plan_centrifuge`.
    duration
        Duration of each run. In s.
    static_duration
        Duration of each static run. In s.
    rate
        Sample rate. In Hz.
    nonlinearity
        K(20 g) / K(0) - 1. Of a typical gyroscope.
    tilt
        Table axis against the arm's axis. In rad.
    no_angle
        No table_angle column.
    unit
        Unit of the rates: deg/h deg/s rad/s. In the recordings.
    seed
        Seed of the random numbers.
    ramp
        Duration of a spin-up at the start of every loaded run, s.

    Returns
    -------
    Simulation
        ``simulation(run)`` yields the blocks of a run of its ``manifest``; ``simulation.save(folder)`` writes them.

    Raises
    ------
    OptionError
        A value is out of range, or both a plan and what a plan says are given.
    ReadError
        The manifest cannot be read.

    Examples
    --------
    >>> import imulab as il
    >>> test = il.simulate_centrifuge(levels="1,10", cycles=1, duration="60 s", static_duration="30 s")
    >>> len(next(test(test.manifest.runs[1])))
    3000
    >>> test.save("test")
    >>> len(il.load_manifest("test/manifest.toml").runs)
    3
    """
    number = whole(seed, "seed")
    if plan is None:
        test = _test(levels, radius, net_rate, cycles, both_senses, f"SIM-{number}")
    else:
        for name, value, usual in (
            ("levels", levels, _LEVELS), ("radius", radius, _RADIUS), ("net_rate", net_rate, _NET_RATE),
            ("cycles", cycles, 2), ("both_senses", both_senses, False),
        ):  # fmt: skip
            if str(value) != str(usual):
                raise OptionError(f"{name}: the plan says that already; expected one or the other")
        test = _manifest(plan)
    if truth is None:
        truth = typical_truth(fraction(nonlinearity, "nonlinearity"))
        truth = replace(truth, rig=replace(truth.rig, tilt=in_si(tilt, "tilt", "angle", "arcsec")))
    return Simulation(
        test,
        truth,
        in_si(rate, "rate", "frequency", "Hz"),
        in_si(duration, "duration", "time", "s"),
        in_si(static_duration, "static_duration", "time", "s"),
        not no_angle,
        unit,
        ramp,
        number,
    )


def _manifest(plan: object) -> Manifest:
    """Return the manifest of a test, given as one, as a plan or as a file."""
    if isinstance(plan, Plan):
        return plan.manifest
    if isinstance(plan, Manifest):
        return plan
    if isinstance(plan, str | PathLike):
        return load_manifest(os.fspath(plan))
    raise OptionError(f"plan {quoted(plan)}: expected a plan, a manifest or its file")


def _test(
    levels: Sequence[float] | str,
    radius: float | str,
    net_rate: float | str,
    cycles: int | str,
    both_senses: bool,
    serial: str,
) -> Manifest:
    """Return the manifest of a test that options state; errors as those of a plan."""
    force, arm = read_levels(levels), in_si(radius, "radius", "length", "m")
    net, number = in_si(net_rate, "net_rate", "rate", "deg/s"), whole(cycles, "cycles")
    plan_centrifuge(
        force, radius=arm, net_rate=net, cycles=number, drift=1.0, dtg_noise=0.0, fog_noise=0.0, uncertainty=1.0
    )
    return make_manifest(
        levels=force, radius=arm, net_rate=net, cycles=number, both_senses=both_senses,
        radius_uncertainty=1e-5 * arm, rate_uncertainty=to_si(0.0005, "deg/s"),
        sensor={"serial": serial, "model": "simulated tuned gyroscope"},
    )  # fmt: skip

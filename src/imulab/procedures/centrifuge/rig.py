"""A simulated test as people ask for it: of a plan or manifest, or of levels and rates."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike

from imulab.errors import OptionError, quoted
from imulab.procedures.centrifuge.manifest import Manifest, load_manifest, make_manifest
from imulab.procedures.centrifuge.plan import Plan, plan_centrifuge, read_levels
from imulab.procedures.centrifuge.simulate import Simulation, Truth, typical_truth
from imulab.quantities import fraction, in_si, whole
from imulab.units import to_si

_LEVELS, _RADIUS, _NET_RATE = "1,2,5,10,15,20", "2 m", "40 deg/s"


def simulate_centrifuge(
    plan: Manifest | Plan | str | PathLike[str] | None = None,
    truth: Truth | None = None,
    *,
    levels: Sequence[float] | str = _LEVELS,
    radius: float | str = _RADIUS,
    net_rate: float | str = _NET_RATE,
    cycles: int | str = 2,
    both_senses: bool = False,
    duration: float | str = "5 min",
    static_duration: float | str = "1 min",
    rate: float | str = "50 Hz",
    nonlinearity: float | str = "1 %",
    tilt: float | str = "10 arcsec",
    no_angle: bool = False,
    unit: str = "deg/h",
    seed: int | str = 1,
    ramp: float = 0.0,
) -> Simulation:
    """Simulate the test of a tuned gyroscope of 3.3 deg/h/g, or of another truth.

    Parameters
    ----------
    plan
        The test: a plan, a manifest, or its file; by `levels` to `both_senses` where none is given.
    truth
        Everything that the test has in it; a typical gyroscope of `nonlinearity` on a rig of `tilt` if not given.
    levels
        Specific forces, m/s^2, or a text of them in g, with commas.
    radius, net_rate
        m and rad/s, or texts with a unit.
    cycles, both_senses
        Number of power cycles, and whether every level is run in both senses.
    duration, static_duration
        Of each loaded and each static run, s.
    rate
        Samples per second, Hz.
    nonlinearity
        K(20 g) / K(0) - 1.
    tilt
        Table axis against the arm's axis, rad.
    no_angle
        Whether the column `table_angle` is left out.
    unit
        Of the rates in the recordings.
    seed
        Of the random numbers.
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

"""Which runs a centrifuge test needs: rates for the wanted levels, what they will give, and what is wrong with them.

A run of duration T gives its line with ``sigma = N sqrt(2 / T)`` for noise of density N (angle random walk,
rad/sqrt(s)) of DTG and FOG together; ``u(K)/K = sigma / (K a)``, over sqrt(n) for n runs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from imulab.errors import OptionError
from imulab.procedures.centrifuge.budget import FLEXURE
from imulab.procedures.centrifuge.manifest import Manifest, make_manifest
from imulab.units import from_si, to_si

PERIODS_ASKED = 500
_NEAR = 0.05
"""A table rate this close to a multiple of the net rate, as part of the net rate, is warned of."""
_LONGEST = 7200.0
_HIGHEST_RATE = 50.0  # rad/s


@dataclass(frozen=True)
class PlannedLevel:
    """One level.

    Attributes
    ----------
    force, arm_rate, table_rate
        m/s^2 and rad/s.
    periods
        Table periods in a run.
    relative, zeta
        Predicted standard uncertainty of K, as a part of it, with all runs; and of zeta.
    needed
        Duration of a run for the wanted uncertainty, s.
    """

    force: float
    arm_rate: float
    table_rate: float
    periods: float
    relative: float
    zeta: float | None
    needed: float


@dataclass(frozen=True)
class Plan:
    """A planned test: its manifest, its levels, the time on the centrifuge, s, and warnings with what to do."""

    manifest: Manifest
    levels: tuple[PlannedLevel, ...]
    duration: float
    static_duration: float
    total: float
    warnings: tuple[str, ...]


def plan_centrifuge(
    *,
    levels: list[float],
    radius: float,
    net_rate: float,
    duration: float = 900.0,
    static_duration: float = 300.0,
    cycles: int = 2,
    both_senses: bool = False,
    K: float,
    dtg_noise: float,
    fog_noise: float,
    uncertainty: float,
    radius_uncertainty: float = 0.0,
    rate_uncertainty: float = 0.0,
) -> Plan:
    """Plan a centrifuge test.

    Parameters
    ----------
    levels
        Specific forces, m/s^2; the lowest is the reference K_1.
    radius, radius_uncertainty
        m.
    net_rate, rate_uncertainty
        rad/s.
    duration, static_duration
        Of each loaded and static run, s.
    cycles
        Power cycles.
    both_senses
        Whether each level is run in both senses.
    K
        Expected drift per specific force, rad/s/(m/s^2).
    dtg_noise, fog_noise
        Angle random walk, rad/sqrt(s).
    uncertainty
        Wanted relative standard uncertainty of K at every level.

    Raises
    ------
    OptionError
        A value is out of range, or a level is at a rate below the net rate.
    """
    _check(levels, radius, net_rate, duration, cycles, K, uncertainty)
    for name, value in (
        ("DTG noise", dtg_noise), ("FOG noise", fog_noise),
        ("radius uncertainty", radius_uncertainty), ("rate uncertainty", rate_uncertainty),
    ):  # fmt: skip
        if value < 0:
            raise OptionError(f"{name} {value:.6g}: expected 0 or more")
    manifest = make_manifest(
        levels=levels, radius=radius, net_rate=net_rate, cycles=cycles, both_senses=both_senses,
        radius_uncertainty=radius_uncertainty, rate_uncertainty=rate_uncertainty, name="plan",
    )  # fmt: skip
    runs = cycles * (2 if both_senses else 1)
    density = math.hypot(dtg_noise, fog_noise)
    planned: list[PlannedLevel] = []
    for force in sorted(levels):
        arm = math.sqrt(force / radius)
        table = arm - net_rate
        if table <= 0:
            raise OptionError(
                f"level {from_si(force, 'g'):.4g} g: arm rate {_deg(arm)} is not above the net rate {_deg(net_rate)}; "
                "expected a lower net rate, a smaller radius or a higher level"
            )
        noise = density * math.sqrt(2 / duration / runs) / (K * force)
        rate = 2 * rate_uncertainty / arm / math.sqrt(runs)
        relative = math.hypot(noise, rate)
        first = planned[0].relative if planned else relative
        margin = uncertainty**2 - rate**2
        needed = duration * noise**2 / margin if margin > 0 else math.inf
        zeta = math.hypot(relative, first) if planned else None
        planned.append(PlannedLevel(force, arm, table, duration * table / (2 * math.pi), relative, zeta, needed))
    total = cycles * static_duration + runs * len(levels) * duration
    return Plan(
        manifest, tuple(planned), duration, static_duration, total,
        tuple(_warnings(planned, net_rate, duration, runs, K, uncertainty, both_senses)),
    )  # fmt: skip


def _check(
    levels: list[float], radius: float, net_rate: float, duration: float, cycles: int, K: float, uncertainty: float
) -> None:
    if not levels or min(levels) <= 0:
        raise OptionError("levels: expected specific forces above 0")
    if len({round(from_si(level, "g"), 3) for level in levels}) < len(levels):
        raise OptionError("levels: the same level twice; expected each once (power cycles repeat them)")
    for name, value, low, high, unit in (
        ("radius", radius, 0.05, 100.0, "m"),
        ("net rate", net_rate, 1e-4, _HIGHEST_RATE, "rad/s"),
        ("duration", duration, 10.0, 1e6, "s"),
        ("uncertainty", uncertainty, 1e-7, 1.0, "of K (or percent, such as 0.8 %)"),
        ("cycles", float(cycles), 1.0, 100.0, ""),
    ):
        if not low <= value <= high:
            raise OptionError(f"{name} {value:.6g}: expected {low:g} to {high:g} {unit}".rstrip())
    if not K > 0:
        raise OptionError("K: expected more than 0")


def _warnings(
    planned: list[PlannedLevel],
    net_rate: float,
    duration: float,
    runs: int,
    K: float,
    uncertainty: float,
    both_senses: bool,
) -> list[str]:
    found = []
    for level in planned:
        name = f"{from_si(level.force, 'g'):.4g} g"
        for times, words in ((0.5, "half the net rate"), (1.0, "the net rate"), (2.0, "twice the net rate"),
                             (3.0, "three times the net rate")):  # fmt: skip
            if abs(level.table_rate - times * net_rate) > _NEAR * net_rate:
                continue
            better = net_rate * (1 + 3 * _NEAR)
            refused = " (reduce refuses it where they coincide)" if times <= 1 else ""
            found.append(
                f"{name}: table rate {_deg(level.table_rate)} is near {words}: Earth rate and the drift fall on one "
                f"line or its harmonic{refused}; take a net rate of {_deg(better)} or move the level by some percent"
            )
        if level.relative > uncertainty:
            found.append(_too_short(name, level, duration, runs, uncertainty))
    few = [level for level in planned if level.periods < PERIODS_ASKED]
    if few:
        longest = max(PERIODS_ASKED * 2 * math.pi / level.table_rate for level in few)
        names = ", ".join(f"{from_si(level.force, 'g'):.4g} g ({level.periods:.0f})" for level in few)
        found.append(
            f"{names}: fewer than the {PERIODS_ASKED} table periods that method fourier asks for "
            f"({_time(longest)} would give "
            "them at every level); method least-squares does not need them"
        )
    if not both_senses:
        top = planned[-1]
        found.append(
            f"one sense of rotation only: differential flexure ({1e6 * to_si(FLEXURE, 'g'):.1g} µrad/g would be "
            f"{100 * top.arm_rate * FLEXURE / K:.2g} % of K at {from_si(top.force, 'g'):.4g} g), scale mismatch and "
            "azimuth are not separated; run both senses (--both-senses, with table_angle recorded)"
        )
    return found


def _too_short(name: str, level: PlannedLevel, duration: float, runs: int, uncertainty: float) -> str:
    wanted = f"{100 * uncertainty:.3g} %"
    text = f"{name}: predicted u(K) {100 * level.relative:.2g} %, wanted {wanted}: "
    if math.isinf(level.needed):
        return text + "the arm rate's own uncertainty exceeds it; no duration helps"
    if level.needed <= _LONGEST:
        return text + f"run {_time(level.needed)} instead of {_time(duration)}"
    more = math.ceil(runs * level.needed / duration)
    return text + (
        f"too noisy: it takes {level.needed / 3600:.1f} h a run, or {more} runs of {_time(duration)}; a quieter "
        "gyroscope or FOG, a higher reference level, or the fitted curve, which does not rest on this level"
    )


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


def _deg(rate: float) -> str:
    return f"{from_si(rate, 'deg/s'):.4g} deg/s"

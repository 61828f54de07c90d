"""Planning a centrifuge test: its runs, the uncertainty they will reach, and the error budget.

A run of duration T gives its line with ``sigma = N sqrt(2 / T)`` for noise of density N (angle random walk,
rad/sqrt(s)) of DTG and FOG together; ``u(K)/K = sigma / (K a)``, over sqrt(n) for n runs.

The error budget states each error that survives the subtraction of the FOG, with its effect on K at the highest level
as a fraction of K. Where the data do not bound an error, the effect is that of a stated size.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from imulab.errors import OptionError, quoted
from imulab.files import write_text
from imulab.options import measure, text
from imulab.procedures.centrifuge.levels import MeasuredRuns, RunLine, arm_rate_off, delays, mismatch, tilted, weighted
from imulab.procedures.centrifuge.manifest import Manifest, make_manifest, manifest_text
from imulab.procedures.centrifuge.run import LoadedRun
from imulab.procedures.result import PlannedTest, amount
from imulab.quantities import RANDOM_WALK, fraction, in_si, of_units, whole
from imulab.report.plots import Plot
from imulab.report.traces import BAD, GOOD, LEGEND, Figure, log_axis
from imulab.units import STANDARD_GRAVITY, from_si, to_si

# Error budget: errors that survive the subtraction of the FOG.


FLEXURE = 1e-7 / STANDARD_GRAVITY  # rad/(m/s^2): 0.1 µrad per g, a stiff arm, where none is stated
_DELAY = 1e-3  # s between FOG and X that a data logger may have, where the data do not show it
_MISMATCH = 5e-3  # of a scale factor: 0.5 % between FOG and X, where the data do not show it


@dataclass(frozen=True)
class BudgetEntry:
    """One error of the budget.

    Attributes
    ----------
    error
        Name of the error.
    bounded
        Whether the data bound it.
    value, standard_uncertainty, unit
        As measured (an angle, a time, a fraction); where it is not bounded, the size that the effect is stated for.
    effect
        Effect on K at the highest level, as a fraction, of value and uncertainty after the reduction's corrections;
        where it is not bounded, of the stated size.
    removed
        The same without the subtraction or combination that removes it, where there is one.
    basis
        What bounds it, or what would be needed for that.
    """

    error: str
    bounded: bool
    value: float | None
    standard_uncertainty: float | None
    unit: str
    effect: float
    removed: float | None
    basis: str


def error_budget(
    runs: Sequence[LoadedRun], lines: dict[int, RunLine], manifest: Manifest, corrected: Collection[str] = ()
) -> list[dict[str, Any]]:
    """Return the error budget of the X axis as plain values.

    `runs` and `lines` are those before any correction; `corrected` names the errors that are corrected.
    """
    test = MeasuredRuns([run for run in runs if run.index in lines], lines)
    entries = [
        *_tilt(test), _flexure(test), *_scale_mismatch(test), *_delays(test), _table_rate(test),
        _arm_rate(test, manifest), _radius(test, manifest),
    ]  # fmt: skip
    return [asdict(_corrected_entry(entry) if entry.error in corrected else entry) for entry in entries]


def _corrected_entry(entry: BudgetEntry) -> BudgetEntry:
    """Return an entry whose value is corrected: only its uncertainty has an effect."""
    share = (entry.standard_uncertainty or 0.0) / max(
        np.hypot(entry.value or 0.0, entry.standard_uncertainty or 0.0), 1e-300
    )
    return replace(entry, effect=entry.effect * share, removed=entry.effect, basis=f"{entry.basis}; corrected")


def _tilt(test: MeasuredRuns) -> list[BudgetEntry]:
    if not test.encoder:
        size = np.abs(test.fog / test.arm)
        variance = test.fog_variance / test.arm**2
        weight = 1 / np.maximum(variance, 1e-300)
        value, u = float((weight * size).sum() / weight.sum()), float(1 / np.sqrt(weight.sum()))
        basis = "FOG line, flexure included"
        return [BudgetEntry("tilt", True, value, u, "rad", 0.0, test.fog_share, basis)]
    parameters, covariance, _ = tilted(test)
    entries = []
    top = float(test.force.max())
    for error, index, factor, unit, basis in (
        ("tilt", 0, 1.0, "rad", "FOG line at a = 0"),
        ("common flexure", 2, top, "rad/(m/s^2)", "FOG line, growth with a"),
    ):
        if index == 2 and test.levels < 2:
            continue
        pair = parameters[index] + 1j * parameters[index + 1]
        u = float(np.sqrt((covariance[index, index] + covariance[index + 1, index + 1]) / 2))
        removed = abs(pair) * factor * float(np.abs(test.arm).max()) / top / test.K
        entries.append(BudgetEntry(error, True, float(abs(pair)), u, unit, 0.0, removed, basis))
    return entries


def _flexure(test: MeasuredRuns) -> BudgetEntry:
    """Return differential flexure: the part of the lines that changes sign with the sense of rotation."""
    reach = float(np.abs(test.arm).max()) / test.K
    senses = np.sign(test.arm)
    if not test.encoder or len(np.unique(senses)) < 2:
        return BudgetEntry(
            "differential flexure", False, FLEXURE, None, "rad/(m/s^2)", FLEXURE * reach, None,
            "needs both senses, encoder",
        )  # fmt: skip
    # Per specific force: Z = D(level) + w_t kappa_d; the levels' own lines are free.
    labels = np.round(np.abs(test.arm), 6)
    design = np.zeros((len(labels), test.levels + 1))
    for column, label in enumerate(np.unique(labels)):
        design[labels == label, column] = 1.0
    design[:, -1] = test.arm
    fits = [weighted(design, part, test.line_variance) for part in (test.line.real, test.line.imag)]
    value = abs(complex(fits[0][0][-1], fits[1][0][-1]))
    u = float(np.sqrt(fits[0][1][-1, -1]))
    return BudgetEntry(
        "differential flexure", True, value, u, "rad/(m/s^2)", 0.0, value * reach,
        "difference of the senses",
    )  # fmt: skip


def _scale_mismatch(test: MeasuredRuns) -> list[BudgetEntry]:
    """Return scale mismatch and azimuth of X against the FOG, by the Earth's rate."""
    measured = mismatch(test)
    if measured is None:
        return [
            BudgetEntry("scale mismatch", False, _MISMATCH, None, "1", _MISMATCH * test.fog_share, None,
                  "needs an Earth-rate line"),
        ]  # fmt: skip
    entries = []
    for error, value, unit in (("scale mismatch", measured.scale, "1"), ("FOG azimuth", measured.azimuth, "rad")):
        effect = float(np.hypot(value, measured.uncertainty)) * test.fog_share
        entries.append(
            BudgetEntry(error, True, value, measured.uncertainty, unit, 0.0 if test.both else effect,
                  effect if test.both else None, "Earth-rate line"),
        )  # fmt: skip
    return entries


def _delays(test: MeasuredRuns) -> list[BudgetEntry]:
    """Return the delays of FOG and X against the encoder, by the turning of their lines with the table rate."""
    per_second = float(np.abs(test.table).max()) * test.fog_share
    measured = delays(test)
    if measured is None:
        basis = "needs encoder, 3 levels"
        return [BudgetEntry("delay, FOG to X", False, _DELAY, None, "s", _DELAY * per_second, None, basis)]
    effect = float(np.hypot(measured.late, measured.uncertainty)) * per_second
    return [
        BudgetEntry("delay of the FOG", True, measured.fog, measured.fog_uncertainty, "s", effect, None,
              "FOG phase over table rate"),
        BudgetEntry("delay of X", True, measured.axis, measured.axis_uncertainty, "s", effect, None,
              "drift phase over table rate"),
    ]  # fmt: skip


def _table_rate(test: MeasuredRuns) -> BudgetEntry:
    origins = {run.rates.origin for run in test.runs}
    if "manifest" in origins:
        return BudgetEntry(
            "table rate", False, None, None, "rad/s", 0.0, None,
            "needs FOG line or encoder",
        )  # fmt: skip
    if origins == {"encoder"}:
        return BudgetEntry("table rate", True, 0.0, 0.0, "rad/s", 0.0, None, "encoder")
    u = np.array([run.rates.table_uncertainty or 0.0 for run in test.runs])
    lost = (u * [run.duration for run in test.runs]) ** 2 / 24
    off = np.array([abs(run.rates.table_rate) - run.run.table_rate for run in test.runs])
    removed = (off * [run.duration for run in test.runs]) ** 2 / 24
    worst = int(np.argmax(np.abs(off)))
    return BudgetEntry(
        "table rate", True, float(off[worst]), float(u[worst]), "rad/s", float(lost.max()),
        float(min(removed.max(), 1.0)),
        "FOG line",
    )  # fmt: skip


def _arm_rate(test: MeasuredRuns, manifest: Manifest) -> BudgetEntry:
    """Return the error of the arm rate: table rate plus net rate as measured, against the manifest's."""
    runs = [run for run in test.runs if run.rates.net_rate is not None and run.rates.origin != "manifest"]
    stated = manifest.rate_uncertainty / float(np.abs(test.arm).max())
    if not runs:
        return BudgetEntry("arm rate", False, None, manifest.rate_uncertainty, "rad/s", 2 * stated, None, "manifest")
    off, u = np.array([arm_rate_off(run) for run in runs]).T
    arm = np.array([r.run.arm_rate for r in runs])
    worst = int(np.argmax(np.abs(off)))
    effect = 2 * float((np.hypot(off, u) / arm).max())
    return BudgetEntry(
        "arm rate", True, float(off[worst]), float(u[worst]), "rad/s", effect, None,
        "table + net rate",
    )  # fmt: skip


def _radius(test: MeasuredRuns, manifest: Manifest) -> BudgetEntry:
    relative = manifest.radius_uncertainty / manifest.radius
    return BudgetEntry(
        "radius",
        False,
        None,
        manifest.radius_uncertainty,
        "m",
        relative,
        None,
        "manifest; not in zeta",
    )


# The plan: rates for the wanted levels, predicted uncertainties, and warnings.


DRIFT = {"deg/h/g": 0.01745329251994329577 / 3600 / 9.80665, "rad/s/(m/s^2)": 1.0}
"""Units of K in texts, in SI."""
PERIODS_ASKED = 500  # of the table in a run, asked for by the source of method fourier
_NEAR = 0.05
"""A warning is given where the table rate is this close to a multiple of the net rate, relative to the net rate."""
_LONGEST = 7200.0  # s of a run that a plan proposes
_HIGHEST_RATE = 50.0  # rad/s


@dataclass(frozen=True)
class PlannedLevel:
    """One level.

    Attributes
    ----------
    force, arm_rate, table_rate
        Specific force, m/s^2, and rates, rad/s.
    periods
        Table periods in a run.
    relative, zeta
        Predicted relative standard uncertainty of K, with all runs, and that of zeta.
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


@dataclass(frozen=True, repr=False)
class Plan(PlannedTest):
    """A planned test: manifest, levels, durations, s, wanted u(K) / K, and warnings with what to do."""

    manifest: Manifest
    levels: tuple[PlannedLevel, ...]
    duration: float
    static_duration: float
    total: float
    wanted: float
    warnings: tuple[str, ...]

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return how long the test takes and whether it reaches the wanted uncertainty, and its levels."""
        rows = [
            [
                f"{from_si(level.force, 'g'):.4g}",
                f"{from_si(level.arm_rate, 'deg/s'):.4f}",
                f"{from_si(level.table_rate, 'deg/s'):.4f}",
                f"{level.periods:.0f}",
                f"{100 * level.relative:.3g}",
                "–" if level.zeta is None else f"{100 * level.zeta:.3g}",
                "–" if math.isinf(level.needed) else f"{level.needed / 60:.1f}",
            ]
            for level in self.levels
        ]
        too_few = sum(level.relative > self.wanted for level in self.levels)
        reach = f"{too_few} of {len(self.levels)} levels do not reach" if too_few else "every level reaches"
        head = (
            f"{len(self.manifest.runs)} runs, {self.total / 3600:.1f} h of recording ({self.duration / 60:.0f} min "
            f"each, static {self.static_duration / 60:.0f} min); {reach} u(K) = {100 * self.wanted:.3g} % (needed: how "
            "long a run must be for that)"
        )
        return head, ["level, g", "arm, deg/s", "table, deg/s", "periods", "u(K), %", "u(zeta), %", "needed, min"], rows

    def content(self) -> dict[str, Any]:
        """Return the plan for scripts, in SI."""
        return {
            "runs": len(self.manifest.runs),
            "duration": amount(self.duration, "s"),
            "static_duration": amount(self.static_duration, "s"),
            "total": amount(self.total, "s"),
            "wanted": amount(self.wanted, "1"),
            "levels": [
                {
                    "specific_force": amount(level.force, "m/s^2"),
                    "arm_rate": amount(level.arm_rate, "rad/s"),
                    "table_rate": amount(level.table_rate, "rad/s"),
                    "periods": level.periods,
                    "relative_uncertainty": level.relative,
                    "zeta_uncertainty": level.zeta,
                    "needed": amount(level.needed, "s"),
                }
                for level in self.levels
            ],
            "warnings": list(self.warnings),
        }

    def findings(self) -> tuple[str, ...]:
        """Return warnings about the test, with what to do."""
        return self.warnings

    def remarks(self) -> list[str]:
        """Return what to do at the rig, in order."""
        return [
            "1. Level arm and table. Mount the gyroscope with X and Y horizontal and its spin axis on the table's",
            "   axis, the fibre-optic gyroscope with its axis parallel to X.",
            "2. Both axes of the rig at their zero positions, at rest. Power on; warm up for 10 min.",
            f"3. Record the static run for {self.static_duration / 60:.3g} min.",
            f"4. For each loaded run: set the arm's rate, then the table's; when both are steady, record for "
            f"{self.duration / 60:.3g} min.",
            "5. Stop table and arm, save, power off. Repeat from 2 for each power cycle.",
        ]

    def save(self, path: str | Path) -> None:
        """Write the list of runs where the name ends in .csv, else the manifest.

        Raises
        ------
        OptionError
            The file cannot be written.
        """
        test = self.manifest
        if not str(path).lower().endswith(".csv"):
            comments = [f"{len(test.runs)} runs. Columns: time, dtg_x, dtg_y, fog, table_angle.", *self.remarks()]
            write_text(path, manifest_text(test, comments))
            return
        lines = ["number,file,power_cycle,role,sense,arm_rate [deg/s],table_rate [deg/s],specific_force [g]"]
        for number, run in enumerate(test.runs, start=1):
            lines.append(
                f"{number},{run.file},{run.power_cycle},{run.role},{run.sense},{from_si(run.arm_rate, 'deg/s'):.4f},"
                f"{from_si(run.table_rate, 'deg/s'):.4f},{from_si(test.force(run), 'g'):.6g}"
            )
        write_text(path, "\n".join(lines) + "\n")

    def plot(self) -> Plot:
        """Return the predicted uncertainty of K at each level, beside the wanted one."""
        force = [from_si(level.force, "g") for level in self.levels]
        reached = [100 * level.relative for level in self.levels]
        traces = [
            {"type": "scatter", "mode": "lines+markers", "name": "predicted", "x": force, "y": reached,
             "line": {"color": GOOD, "width": 2}, "marker": {"size": 8}},
            {"type": "scatter", "mode": "lines", "name": "wanted", "x": [force[0], force[-1]],
             "y": [100 * self.wanted] * 2, "line": {"color": BAD, "width": 1.5, "dash": "dash"}},
        ]  # fmt: skip
        layout = {
            "xaxis": log_axis("specific force, g", tickvals=force),
            "yaxis": log_axis("u(K) / K, %"),
            "legend": LEGEND,
        }
        caption = "u(K) / K: relative standard uncertainty of the drift per specific force."
        return Plot(
            Figure("What the test will give", caption, traces, layout, message=f"{self.shown()[0]}."), "Centrifuge plan"
        )


def plan_centrifuge(
    levels: Annotated[Sequence[float] | str, text("A,A,...", unit="g")] = "1,2,5,10,15,20,30,40",
    *,
    radius: Annotated[float | str, measure("length", "m")] = "2 m",
    net_rate: Annotated[float | str, measure("rate", "deg/s")] = "40 deg/s",
    duration: Annotated[float | str, measure("time", "s")] = "15 min",
    cycles: int | str = 2,
    both_senses: bool = False,
    drift: Annotated[float | str, text("K", unit="deg/h/g")] = "3.3 deg/h/g",
    dtg_noise: Annotated[float | str, text("N", unit="deg/sqrt(h)")] = "0.01 deg/sqrt(h)",
    fog_noise: Annotated[float | str, text("N", unit="deg/sqrt(h)")] = "0.005 deg/sqrt(h)",
    uncertainty: Annotated[float | str, text("FRACTION")] = "1 %",
    radius_uncertainty: Annotated[float | str, measure("length", "m")] = "0 m",
    rate_uncertainty: Annotated[float | str, measure("rate", "deg/s")] = "0 deg/s",
    static_duration: float = 300.0,
) -> Plan:
    """Plan a centrifuge test.

    Parameters
    ----------
    levels
        Specific forces in g, with commas; the lowest is the reference. As numbers in m/s^2; the reference is that of
        K_1.
    radius
        Arm axis to the gyroscope's centre. In m.
    net_rate
        Rate at which the gyroscope turns against the room. In rad/s.
    duration
        Duration of each run. In s.
    cycles
        Number of power cycles.
    both_senses
        Every level in both senses.
    drift
        Expected drift per g. K, rad/s/(m/s^2).
    dtg_noise
        Angle random walk of the gyroscope. In rad/sqrt(s).
    fog_noise
        Angle random walk of the FOG. In rad/sqrt(s).
    uncertainty
        Wanted standard uncertainty of K, relative. At every level.
    radius_uncertainty
        Standard uncertainty of the radius. In m.
    rate_uncertainty
        Standard uncertainty of the arm rates. In rad/s.
    static_duration
        Duration of each static run. In s.

    Raises
    ------
    OptionError
        A value is out of range, or a level is at a rate below the net rate.

    Examples
    --------
    >>> import imulab as il
    >>> plan = il.plan_centrifuge("1,10,20", duration="10 min", both_senses=True)
    >>> len(plan.manifest.runs), round(plan.levels[0].relative, 4)
    (14, 0.0059)
    >>> plan.save("plan.toml")
    """
    levels, cycles = read_levels(levels), whole(cycles, "cycles")
    radius, radius_uncertainty = (
        in_si(value, name, "length", "m")
        for value, name in ((radius, "radius"), (radius_uncertainty, "radius_uncertainty"))
    )
    net_rate, rate_uncertainty = (
        in_si(value, name, "rate", "deg/s")
        for value, name in ((net_rate, "net_rate"), (rate_uncertainty, "rate_uncertainty"))
    )
    duration, uncertainty = in_si(duration, "duration", "time", "s"), fraction(uncertainty, "uncertainty")
    K = of_units(drift, "drift", DRIFT)
    dtg_noise = of_units(dtg_noise, "dtg_noise", RANDOM_WALK)
    fog_noise = of_units(fog_noise, "fog_noise", RANDOM_WALK)
    _check(levels, radius, net_rate, duration, cycles, K, uncertainty)
    for name, value in (
        ("DTG noise", dtg_noise), ("FOG noise", fog_noise),
        ("radius uncertainty", radius_uncertainty), ("rate uncertainty", rate_uncertainty),
        ("static duration", static_duration),
    ):  # fmt: skip
        if value < 0:
            raise OptionError(f"{name} {value:.6g}: expected 0 or more")
    manifest = make_manifest(
        levels=levels, radius=radius, net_rate=net_rate, cycles=cycles, both_senses=both_senses,
        radius_uncertainty=radius_uncertainty, rate_uncertainty=rate_uncertainty, name="plan",
    )  # fmt: skip
    runs = cycles * (2 if both_senses else 1)
    test = _Test(radius, net_rate, duration, runs, K, math.hypot(dtg_noise, fog_noise), rate_uncertainty, uncertainty)
    planned = _planned_levels(sorted(levels), test)
    total = cycles * static_duration + runs * len(levels) * duration
    return Plan(
        manifest, tuple(planned), duration, static_duration, total, uncertainty,
        tuple(_warnings(planned, net_rate, duration, runs, K, uncertainty, both_senses)),
    )  # fmt: skip


@dataclass(frozen=True)
class _Test:
    """Values common to all levels: `noise` is that of DTG and FOG together, rad/sqrt(s)."""

    radius: float
    net_rate: float
    duration: float
    runs: int
    K: float
    noise: float
    rate_uncertainty: float
    wanted: float


def _planned_levels(levels: Sequence[float], test: _Test) -> list[PlannedLevel]:
    """Return arm and table rates of levels, m/s^2, ascending, with the predicted uncertainties of K and zeta."""
    planned: list[PlannedLevel] = []
    for force in levels:
        arm = math.sqrt(force / test.radius)
        table = arm - test.net_rate
        if table <= 0:
            raise OptionError(
                f"level {from_si(force, 'g'):.4g} g: arm rate {_deg(arm)} is not above the net rate "
                f"{_deg(test.net_rate)}; expected a lower net rate, a smaller radius or a higher level"
            )
        noise = test.noise * math.sqrt(2 / test.duration / test.runs) / (test.K * force)
        rate = 2 * test.rate_uncertainty / arm / math.sqrt(test.runs)
        relative = math.hypot(noise, rate)
        first = planned[0].relative if planned else relative
        margin = test.wanted**2 - rate**2
        needed = test.duration * noise**2 / margin if margin > 0 else math.inf
        zeta = math.hypot(relative, first) if planned else None
        periods = test.duration * table / (2 * math.pi)
        planned.append(PlannedLevel(force, arm, table, periods, relative, zeta, needed))
    return planned


def read_levels(stated: Sequence[float] | str) -> list[float]:
    """Return specific forces, m/s^2, from numbers, or from a text of values in g with commas.

    Raises
    ------
    OptionError
        The text or the numbers are no specific forces.
    """
    try:
        values = [float(part) for part in (stated.removesuffix("g").split(",") if isinstance(stated, str) else stated)]
    except (TypeError, ValueError):
        raise OptionError(
            f"levels {quoted(stated)}: expected specific forces in g, with commas, such as 1,2,5,10"
        ) from None
    if not isinstance(stated, str):
        return values
    if not all(0 < value < 1e4 for value in values):
        raise OptionError(f"levels {stated!r}: expected specific forces above 0 g")
    return [to_si(value, "g") for value in values]


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
    messages = []
    for level in planned:
        name = f"{from_si(level.force, 'g'):.4g} g"
        for times, words in ((0.5, "half the net rate"), (1.0, "the net rate"), (2.0, "twice the net rate"),
                             (3.0, "three times the net rate")):  # fmt: skip
            if abs(level.table_rate - times * net_rate) > _NEAR * net_rate:
                continue
            better = net_rate * (1 + 3 * _NEAR)
            refused = " (reduce refuses it where they coincide)" if times <= 1 else ""
            messages.append(
                f"{name}: table rate {_deg(level.table_rate)} is near {words}: Earth rate and the drift fall on one "
                f"line or its harmonic{refused}; take a net rate of {_deg(better)} or move the level by some percent"
            )
        if level.relative > uncertainty:
            messages.append(_warn_too_short(name, level, duration, runs, uncertainty))
    few = [level for level in planned if level.periods < PERIODS_ASKED]
    if few:
        longest = max(PERIODS_ASKED * 2 * math.pi / level.table_rate for level in few)
        names = ", ".join(f"{from_si(level.force, 'g'):.4g} g ({level.periods:.0f})" for level in few)
        messages.append(
            f"{names}: fewer than the {PERIODS_ASKED} table periods that method fourier asks for "
            f"({_time(longest)} would give "
            "them at every level); method least-squares does not need them"
        )
    if not both_senses:
        top = planned[-1]
        messages.append(
            f"one sense of rotation only: differential flexure ({1e6 * to_si(FLEXURE, 'g'):.1g} µrad/g would be "
            f"{100 * top.arm_rate * FLEXURE / K:.2g} % of K at {from_si(top.force, 'g'):.4g} g), scale mismatch and "
            "azimuth are not separated; run both senses (--both-senses, with table_angle recorded)"
        )
    return messages


def _warn_too_short(name: str, level: PlannedLevel, duration: float, runs: int, uncertainty: float) -> str:
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

"""The calibration record of a centrifuge test: parameters in SI, levels, runs, and what its figures need."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from imulab.display import Finding
from imulab.estimation.decisions import CURVE_MISSES, DRIFT_DIRECTION_TURNS
from imulab.procedures.centrifuge.levels import Levels, RunLine, amplitude_lost, axis_lines
from imulab.procedures.centrifuge.lines import in_degrees
from imulab.procedures.centrifuge.manifest import Manifest, real_covariance, window_text
from imulab.procedures.centrifuge.parameters import Estimates, power_cycles
from imulab.procedures.centrifuge.run import LoadedRun, StaticRun
from imulab.recording import Array, Source
from imulab.records.calibration import Calibration, Covariance, Parameter

_LOST = 1e-4  # of the amplitude: a larger loss by method fourier is reported


def make_record(
    *,
    manifest: Manifest,
    statics: Sequence[StaticRun],
    runs: Sequence[LoadedRun],
    levels: Levels,
    estimates: Estimates,
    budget: Sequence[Mapping[str, Any]],
    findings: Sequence[str] = (),
    options: Mapping[str, Any],
    sources: Sequence[Source] = (),
    temperature: float | None = None,
) -> Calibration:
    """Return the record of the estimates, the error budget and the findings."""
    method = str(options["method"])
    sigma = np.sqrt(np.maximum(np.diagonal(estimates.covariance), 0.0))
    model: dict[str, Any] = {
        "equation": "drift = K(a) (a_x cos direction + a_y sin direction), K(a) = K0 (1 + c1 a + c2 a^2)",
        "radius": {"value": manifest.radius, "unit": "m", "from": "manifest"},
        "gravity": {"value": manifest.gravity, "unit": "m/s^2", "from": "manifest, taken as exact"},
        "reference": _value(manifest.reference, "m/s^2"),
        "curve": {prefix.rstrip("_"): fitted.model for prefix, fitted in estimates.curves.items()},
        "highest_specific_force": _value(max(level.force for level in levels.items), "m/s^2"),
    }
    if temperature is not None:
        model["temperature"] = {"value": temperature, "unit": "degC"}
    return Calibration(
        procedure="centrifuge",
        parameters={
            name: Parameter(float(value), float(u), unit)
            for name, value, u, unit in zip(estimates.names, estimates.values, sigma, estimates.units, strict=True)
        },
        covariance=Covariance(estimates.names, tuple(map(tuple, estimates.covariance.tolist()))),
        model=model,
        fit=_fit(runs, levels, estimates, budget, method),
        options=dict(options),
        data={"spectra": _spectra(runs, levels), "statics": [_static(static) for static in statics]},
        sensor=dict(manifest.sensor),
        sources=tuple(sources),
        warnings=(*findings, *_warnings(manifest, runs, levels, estimates, method)),
        sections={"levels": _levels(levels, estimates), "runs": _runs(manifest, statics, runs, levels, method)},
    )


def _fit(
    runs: Sequence[LoadedRun],
    levels: Levels,
    estimates: Estimates,
    budget: Sequence[Mapping[str, Any]],
    method: str,
) -> dict[str, Any]:
    """Return the section ``fit``: methods, and how well the lines agree with the parameters."""
    repeated = levels.repeatability
    return {
        "method": method,
        "noise": _noise_text(runs),
        "coverage_factor_95": dict(zip(estimates.names, estimates.coverage.tolist(), strict=True)),
        "degrees_of_freedom": dict(zip(estimates.names, estimates.freedom.tolist(), strict=True)),
        "curves": {
            prefix.rstrip("_"): {
                "model": fitted.model,
                "chi_square": fitted.chi_square,
                "degrees_of_freedom": fitted.freedom,
                "probability": fitted.probability,
                "standard_uncertainty_given_model": {
                    name.removeprefix(prefix): float(u)
                    for name, u in zip(estimates.names, estimates.given_model, strict=True)
                    if name in (f"{prefix}K0", f"{prefix}c1", f"{prefix}c2")
                },
                "tried": [
                    {"model": name, "coefficients": count, "chi_square": chi_square, "chosen": chosen}
                    for name, count, chi_square, chosen in fitted.tried
                ],
            }
            for prefix, fitted in estimates.curves.items()
        },
        "direction_probability": {prefix.rstrip("_"): p for prefix, p in estimates.turning.items()},
        "repeatability": {
            "relative_standard_deviation": float(np.sqrt(repeated.cycle)),
            "direction": _value(np.sqrt(repeated.turn), "rad"),
            "within_power_cycle": float(np.sqrt(repeated.run)),
            "chi_square": repeated.chi_square,
            "degrees_of_freedom": repeated.freedom,
        },
        "power_cycles": power_cycles(levels, method),
        "error_budget": [dict(entry) for entry in budget],
    }


def _value(number: float, unit: str) -> dict[str, Any]:
    return {"value": float(number), "unit": unit}


def _noise_text(runs: Sequence[LoadedRun]) -> str:
    fewest = min(run.blocks for run in runs)
    if fewest == 0:
        return (
            "white noise from the residuals where a run is too short for blocks, else scatter of the line over blocks"
        )
    return f"scatter of the line over {fewest} blocks of a run or more (coloured noise included)"


def _levels(levels: Levels, estimates: Estimates) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for index, level in enumerate(levels.items):
        row: dict[str, Any] = next((r for r in rows if r["level"] == level.number), {})
        if not row:
            row = {"level": level.number, "specific_force": _value(level.force, "m/s^2"), "runs": []}
            rows.append(row)
        row["runs"] = sorted([*row["runs"], *level.runs])
        for axis, letter in enumerate("xy"[: len(level.line)]):
            place = 2 * (index * len(level.line) + axis)
            pair = slice(place, place + 2)
            row[letter if level.spin_axis == "up" else f"{letter}_down"] = {
                "A": level.line[axis].real,
                "B": level.line[axis].imag,
                "covariance": estimates.levels[pair, pair].tolist(),
                "directed": level.directed,
                "unit": "rad/s/(m/s^2)",
            }
            if level.number in estimates.cross:
                difference, half_sum = (values[axis] for values in estimates.cross[level.number])
                row[f"{letter}_cross"] = {"A": difference.real, "B": difference.imag, "unit": "rad/s/(m/s^2)^2"}
                row[f"{letter}_half_sum"] = {"A": half_sum.real, "B": half_sum.imag, "unit": "rad/s/(m/s^2)"}
    return sorted(rows, key=lambda row: int(row["level"]))


def _runs(
    manifest: Manifest, statics: Sequence[StaticRun], runs: Sequence[LoadedRun], levels: Levels, method: str
) -> list[dict[str, Any]]:
    reduced = {run.index: run for run in runs}
    rows = []
    for index, run in enumerate(manifest.runs):
        row: dict[str, Any] = {
            "file": run.file,
            **({} if run.window is None else {"window": window_text(run.window)}),
            "power_cycle": run.power_cycle,
            "role": run.role,
            "sense": run.sense,
            "spin_axis": run.spin_axis,
            "arm_rate": _value(run.arm_rate, "rad/s"),
            "table_rate": _value(run.table_rate, "rad/s"),
            "specific_force": _value(manifest.force(run), "m/s^2"),
        }
        if index in reduced:
            row |= _loaded(reduced[index], levels.lines.get(index), method)
        rows.append(row)
    return rows


def _loaded(run: LoadedRun, pooled: RunLine | None, method: str) -> dict[str, Any]:
    line, covariance = axis_lines(run, method)
    real = real_covariance(covariance)
    row: dict[str, Any] = {
        "table_rate_used": _value(
            run.run.table_rate if method == "fourier" else abs(run.rates.table_rate), "rad/s"
        ),
        "table_rate_from": "manifest" if method == "fourier" else run.rates.origin,
        "net_rate": None if run.rates.net_rate is None else {
            **_value(abs(run.rates.net_rate), "rad/s"), "standard_uncertainty": run.rates.net_uncertainty,
        },
        "duration": _value(run.duration, "s"),
        "periods": run.periods if run.whole_periods is None else float(run.whole_periods.periods),
        "blocks": run.blocks,
    }  # fmt: skip
    names = [*"xy"[: len(line)], "fog"]
    own_lines = run.line if method == "least-squares" or run.whole_periods is None else run.whole_periods.line
    shown = [*line, own_lines[-1]]
    fog = run.covariance[-1:, -1:]
    spreads = [*(real[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] for i in range(len(line))), real_covariance(fog)]
    for number, (name, value, spread) in enumerate(zip(names, shown, spreads, strict=True)):
        row[name] = {
            "A": value.real,
            "B": value.imag,
            "covariance": spread.tolist(),
            "unit": "rad/s",
            "mean": _value(float(run.mean[number]), "rad/s"),
            "second_harmonic": abs(run.second[number]),
            "third_harmonic": abs(run.third[number]),
            "earth_rate_line": abs(run.room[number]),
        }
        if name != "fog" and pooled is not None:
            row[name]["K"] = {
                "value": abs(pooled.line[number]),
                "standard_uncertainty": _along(pooled, number),
                "unit": "rad/s/(m/s^2)",
            }
    return row


def _along(line: RunLine, axis: int) -> float:
    pair = slice(2 * axis, 2 * axis + 2)
    return float(np.sqrt(np.trace(line.noise[pair, pair]) / 2 + np.trace(line.rate[pair, pair])))


def _static(static: StaticRun) -> dict[str, Any]:
    return {
        "file": static.run.file,
        "power_cycle": static.run.power_cycle,
        "mean": dict(zip(static.channels, static.mean.tolist(), strict=True)),
        "unit": "rad/s",
        "duration": _value(static.duration, "s"),
    }


def _spectra(runs: Sequence[LoadedRun], levels: Levels) -> list[dict[str, Any]]:
    """Return spectra around the table line, of the first run at each level."""
    shown = []
    by_index = {run.index: run for run in runs}
    for level in levels.items:
        run = next((by_index[index] for index in level.runs if by_index[index].spectrum is not None), None)
        if run is None or run.spectrum is None:
            continue
        rates, heights = run.spectrum
        names = [*run.channels, *(f"residual_{name[-1]}" for name in run.channels[:-1])]
        shown.append(
            {
                "level": level.number,
                "spin_axis": level.spin_axis,
                "file": run.run.file,
                "rate": _rounded(rates, 8),
                "height": {name: _rounded(height, 4) for name, height in zip(names, heights, strict=True)},
                "net_rate": abs(run.run.net_rate if run.rates.net_rate is None else run.rates.net_rate),
                "unit": "rad/s",
            }
        )
    return shown


def _rounded(values: Array, digits: int) -> list[float]:
    """Return numbers with so many significant digits, as many as a figure needs."""
    return [float(f"{value:.{digits}g}") for value in values.tolist()]


def _warn_fourier(manifest: Manifest, runs: Sequence[LoadedRun]) -> list[str]:
    """Return messages on runs that are too short, or too far off their table rate, for method fourier."""
    action = "reduce the runs again with --method least-squares"
    messages: list[str] = []
    few = [run for run in runs if run.whole_periods is not None and run.whole_periods.periods <= 500]
    if few:
        least = min(few, key=lambda run: run.whole_periods.periods if run.whole_periods else 0)
        periods = least.whole_periods.periods if least.whole_periods else 0
        messages.append(
            Finding(
                f"{len(few)} runs have 500 table periods or fewer (least: {least.run.file}, {periods}): drift "
                "leaks into whole-period sums; method least-squares has no such limit",
                action,
            )
        )
    off = {run.index: amplitude_lost(run, manifest, "fourier") for run in runs}
    worst = max(runs, key=lambda run: off[run.index])
    if off[worst.index] > _LOST:
        messages.append(
            Finding(
                f"method fourier takes the manifest's table rate: in {worst.run.file} the rate measured is "
                f"{in_degrees(abs(worst.rates.table_rate))}, not {in_degrees(worst.run.table_rate)}, which costs "
                f"{100 * off[worst.index]:.2g} % of the amplitude (in the uncertainty); method least-squares "
                "follows it",
                action,
            )
        )
    return messages


def _warnings(
    manifest: Manifest, runs: Sequence[LoadedRun], levels: Levels, estimates: Estimates, method: str
) -> tuple[str, ...]:
    messages = [message for run in runs for message in run.warnings]
    messages += [*levels.warnings, *estimates.warnings]
    if method == "fourier":
        messages += _warn_fourier(manifest, runs)
    for prefix, fitted in estimates.curves.items():
        if fitted.probability is not None and fitted.probability < CURVE_MISSES.level:
            messages.append(
                Finding(
                    f"{prefix.rstrip('_')}: K(a) is not described by the curve {fitted.model} within its uncertainty "
                    f"(chi-square "
                    f"{fitted.chi_square:.1f} with {fitted.freedom} degrees of freedom)",
                    "take the drift factors of the levels instead of the curve, and run more levels",
                )
            )
    for prefix, probability in estimates.turning.items():
        if probability < DRIFT_DIRECTION_TURNS.level:
            angles = [
                float(np.degrees(np.angle(level.line["xy".index(prefix[0])])))
                for level in levels.items
                if (level.spin_axis == "down") == ("down" in prefix)
            ]
            span = float(np.ptp(np.unwrap(np.radians(angles))))
            messages.append(
                Finding(
                    f"{prefix.rstrip('_')}: the direction of the drift turns by {np.degrees(span):.2g} deg between the "
                    f"levels: "
                    "nonlinearity that the magnitude does not show",
                    "check the tilt of the table at these levels, and run them again",
                )
            )
    senses = {run.run.sense for run in runs}
    if len(senses) == 1 and len(runs) > 1:
        messages.append(
            Finding(
                "one sense of rotation only: differential flexure, scale mismatch and a delay of the FOG within what "
                "the error budget leaves open are not separated from K(a), and not in u; run both senses"
                + (
                    ""
                    if all(run.encoder for run in runs)
                    else "; no table_angle: no direction of the drift, which apply needs"
                ),
                "run both senses of rotation, with table_angle recorded",
            )
        )
    return tuple(dict.fromkeys(messages))

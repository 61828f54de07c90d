"""Warm-up: speed on a large chamber test, what the models leave on the simulator, and what few bits cost."""

from __future__ import annotations

import resource
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import imulab as il
from imulab.procedures.warmup.cycles import find_power_cycle
from imulab.procedures.warmup.fit import WarmupFit
from imulab.procedures.warmup.model import SOURCE_TEMPERATURES, WarmupTable, evaluate
from imulab.procedures.warmup.simulate import LAWS, warmup_truth

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from few_bits import evaluate_float32, to_int16

HOUR = np.pi / 180 / 3600
END = 300.0
QUARTERS = (-37.5, -32.5, -27.5, -22.5, -17.5, -12.5, -7.5, -2.5, 10, 30, 42.5, 47.5, 52.5, 57.5)
Row = tuple[str, str, str]


TESTS = 20  # chamber tests, each with noise and repeatability of its own, over which the errors are pooled


def rows() -> list[Row]:
    fits = {law: [_fit(law, seed) for seed in range(1, TESTS + 1)] for law in LAWS}
    first = {law: found[0] for law, found in fits.items()}
    return [*_models(fits), *_bits(first), *_large(), *_apply(first["smooth"])]


def _fit(law: str, seed: int = 1) -> WarmupFit:
    cycles = [
        find_power_cycle(il.simulate_power_cycle(t, law=law, seed=[seed, i, c]))
        for i, t in enumerate(SOURCE_TEMPERATURES)
        for c in range(3)
    ]
    return il.fit_warmup(cycles, settling_time=END)


def _error(table: WarmupTable | None, temperatures: tuple[float, ...], law: str) -> float:
    """Rms over t < T_M, three gyroscopes and temperatures against the mean curve, deg/h."""
    squares = []
    clock = np.arange(0, 600, 0.5)
    for temperature in temperatures:
        z = warmup_truth(clock, temperature, law)[:, :3]
        z = (z - z[clock >= END].mean(axis=0))[clock < END]
        found = None if table is None else evaluate(table, clock[clock < END], temperature)
        squares.append(np.mean((z if found is None else z - found[:3].T) ** 2))
    return float(np.sqrt(np.mean(squares)) / HOUR)


def _pooled(fits: list[WarmupFit], label: str, temperatures: tuple[float, ...], law: str) -> float:
    """Rms of the error over the tests, deg/h; of the model that `auto` chose for an empty label."""
    squares = []
    for fit in fits:
        row = next((row for row in fit.models if row.label == label), None)
        table = fit.table if row is None else None if row.solution is None else row.table
        squares.append(_error(table, temperatures, law) ** 2)
    return float(np.sqrt(np.mean(squares)))


def _models(fits: dict[str, list[WarmupFit]]) -> list[Row]:
    stated = {
        "none": "84 / 115, 60 / 83, 45 / 39, 30 / 12",
        "interval-cubic": "15 / 25, 18 / 42, 4.2 / 5.2, 14 / 43; jump 108 / 202",
        "knot-cubic": "2.9 / 3.9, 3.4 / 8.8, 4.2 / 5.2, 4.1 / 10.7; jump 0",
        "knot-log-cubic": "about half of the row above; jump 0",
        "exponential (2)": "1.9 / 2.2, 2.3 / 3.2, 2.2 / 6.9, 1.7 / 7.6; jump 0",
        "exponential (3)": "as above",
    }
    found = []
    for label, asked in stated.items():
        texts = [
            " / ".join(f"{_pooled(fits[law], label, at, law):.1f}" for law in LAWS)
            for at in (SOURCE_TEMPERATURES, (10.0,), (20.0,), (30.0,))
        ]
        jumps = [
            max(next(row for row in fit.models if row.label == label).edge_jump[:3].max() for fit in fits[law]) / HOUR
            for law in LAWS
        ]
        jump = "" if label == "none" else f"; jump {' / '.join(f'{jump:.0f}' for jump in jumps)}"
        found.append(
            (
                f"warm-up rms over {TESTS} tests, deg/h, smooth / bent, at training, 10, 20, 30 degC: {label}",
                ", ".join(texts) + jump,
                asked,
            )
        )
    for what, at, one, other, asked in (
        ("auto over interval-cubic, quarter points", QUARTERS, "", "interval-cubic", "<= 0.30"),
        ("auto over interval-cubic, 10, 30, -27.5 degC", (10.0, 30.0, -27.5), "", "interval-cubic", "<= 0.30"),
        ("knot-log-cubic over knot-cubic, at training", SOURCE_TEMPERATURES, "knot-log-cubic", "knot-cubic", "<= 0.60"),
    ):
        ratios = [f"{_pooled(fits[law], one, at, law) / _pooled(fits[law], other, at, law):.2f}" for law in LAWS]
        found.append((f"warm-up: {what}, smooth / bent", " / ".join(ratios), asked))
    exits = [
        np.sqrt(np.mean([np.square(fit.calibration.fit["exit_rms"][:3]) for fit in fits[law]])) / HOUR for law in LAWS
    ]
    found.append(
        ("warm-up: |Z(T_M)| at 300 s, rms, deg/h, smooth / bent", " / ".join(f"{e:.0f}" for e in exits), "13 to 17")
    )
    return found


def _bits(fits: dict[str, WarmupFit]) -> list[Row]:
    clock = np.arange(0, 60_000) / 200
    single, power, bernstein, steps = 0.0, 0.0, 0.0, 0.0
    for fit in fits.values():
        for row in fit.models:
            if row.solution is None:
                continue
            for at in (-40.0, -33.3, 7.7, 21.0, 60.0):
                exact = evaluate(row.table, clock, at)
                rough = evaluate_float32(row.table, clock, at)
                single = max(single, float(np.abs(rough - exact)[:3].max() / HOUR))
                if row.table.time_constants:
                    continue
                for form in ("power", "bernstein"):
                    small = to_int16(row.table, form)
                    error = np.abs(evaluate(small.expand(), clock, at) - exact).max(axis=1)
                    if form == "power":
                        power = max(power, float((error / small.scale).max()))
                    else:
                        bernstein = max(bernstein, float((error / small.scale).max()))
                        steps = max(steps, float(error[:3].max() / HOUR))
    return [
        ("warm-up: float32 table and arithmetic against float64, all models", f"{single:.1g} deg/h", "<= 0.01 deg/h"),
        ("warm-up: int16 powers, error in LSB", f"{power:.2f}", "<= 2"),
        ("warm-up: int16 Bernstein, error in LSB", f"{bernstein:.2f} ({steps:.1g} deg/h)", "<= 1"),
    ]


def _large() -> list[Row]:
    """8 temperatures x 5 cycles x 6 axes at 200 Hz for 600 s: 28.8 million values, averaged and fitted."""
    recordings = [
        il.simulate_power_cycle(t, sample_rate=200.0, seed=[2, i, c])
        for i, t in enumerate(SOURCE_TEMPERATURES)
        for c in range(5)
    ]
    times = []
    for _ in range(3):
        begin = time.perf_counter()
        il.fit_warmup(recordings, model="auto", settling_time=END)
        times.append(time.perf_counter() - begin)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return [
        ("warm-up: fit of 28.8 million values, all models compared", f"{statistics.median(times):.2f} s", "<= 3 s"),
        ("warm-up: peak memory of that process, the samples included", f"{peak:.2f} GB", "<= 2 GB"),
    ]


def _apply(fit: WarmupFit) -> list[Row]:
    found = []
    for duration, what in ((600.0, "half of it warming up"), (300.0, "all of it warming up")):
        recording = il.simulate_power_cycle(-12.3, sample_rate=3e6 / duration, duration=duration, seed=3)
        for label in ("interval-cubic", "knot-log-cubic", "exponential (2)"):
            row = next(r for r in fit.models if r.label == label)
            section = {"table": row.table.to_section()}
            record = il.Calibration(**{**fit.calibration.__dict__, "sections": section})
            outputs = [recording.columns[axis] for axis in row.table.axes]
            ours, copy = _seconds(lambda r=record, x=recording: il.apply(r, x), lambda o=outputs: [c.copy() for c in o])
            title = f"warm-up: apply {label}, 3 million samples x 6 in deg/h and m/s^2, {what}, over a plain copy"
            found.append((title, f"{ours / copy:.1f}", "<= 4"))
    return found


def _seconds(*functions: Callable[[], object], repeats: int = 7) -> list[float]:
    times: list[list[float]] = [[] for _ in functions]
    for _ in range(repeats):
        for collected, function in zip(times, functions, strict=True):
            begin = time.perf_counter()
            function()
            collected.append(time.perf_counter() - begin)
    return [statistics.median(collected) for collected in times]


if __name__ == "__main__":
    for what, result, wanted in rows():
        print(f"{what}: {result}" + (f" (asked: {wanted})" if wanted else ""))

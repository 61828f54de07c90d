"""The centrifuge reduction against what it was asked to reach: time and memory, errors, coverage."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from imulab.procedures.centrifuge.fit import fit_centrifuge
from imulab.procedures.centrifuge.manifest import Run, make_manifest
from imulab.procedures.centrifuge.simulate import AxisTruth, FogTruth, RigTruth, Simulation, Truth, typical_truth
from imulab.recording import Recording

G = 9.80665
LEVELS = (1, 2, 5, 10, 15, 20, 30, 40)
NET = np.radians(40.0)


class Clocked:
    """Passes the blocks of a simulation on and keeps the time that they took to make: reading is not the reduction."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation, self.spent, self.samples = simulation, 0.0, 0

    def __call__(self, run: Run) -> Iterator[Recording]:
        blocks: Iterator[Recording] = iter(self.simulation(run))
        while True:
            begin = time.perf_counter()
            block = next(blocks, None)
            self.spent += time.perf_counter() - begin
            if block is None:
                return
            self.samples += len(block)
            yield block


def forty_three_million() -> list[tuple[str, str, str]]:
    """Six power cycles, eight runs each, 15 min at 1 kHz, X, Y, FOG and encoder; and without encoder."""
    rows = []
    for encoder in (True, False):
        test = make_manifest(levels=[n * G for n in LEVELS], radius=2.0, net_rate=NET, cycles=6)
        source = Clocked(Simulation(test, typical_truth(), 1000.0, 900.0, 60.0, encoder))
        begin = time.perf_counter()
        fit_centrifuge(test, source)
        spent = time.perf_counter() - begin - source.spent
        what = "with table_angle" if encoder else "without table_angle"
        rows.append(
            (
                f"six power cycles x 8 runs x 15 min at 1 kHz ({source.samples / 1e6:.1f} million samples x 3), "
                f"{what}, reading excluded",
                f"{spent:.1f} s",
                "<= 20 s on 2 cores",
            )
        )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    rows.append(("the same, peak memory of the process, simulator included", f"{peak:.0f} MB", "<= 1 GB"))
    return rows


def quiet(truth: Truth) -> Truth:
    """The same test without noise."""
    still = {"angle_random_walk": 0.0}
    y = None if truth.y is None else replace(truth.y, **still)
    return Truth(replace(truth.x, **still), y, replace(truth.fog, **still), truth.rig)


def accuracy() -> list[tuple[str, str, str]]:
    """K(20 g) of two power cycles of 15 min; both senses against flexure; a rate error without encoder."""
    test = make_manifest(levels=[n * G for n in (1, 2, 5, 10, 15, 20)], radius=2.0, net_rate=NET, cycles=2)
    truth = typical_truth(0.01)
    true = np.hypot(truth.x.D_x, truth.x.D_y) * 1.01
    force = 20 * G
    errors = []
    for seed in range(40):
        found = fit_centrifuge(test, Simulation(test, truth, 20.0, 900.0, 20.0, True, seed=seed)).calibration
        value = {n: found.parameters[f"x_{n}"].value for n in ("K0", "c1", "c2") if f"x_{n}" in found.parameters}
        errors.append(value["K0"] * (1 + value.get("c1", 0.0) * force + value.get("c2", 0.0) * force**2) / true - 1)
    rows = [
        (
            "K(20 g), two power cycles of 15 min, rms error",
            f"{100 * np.sqrt(np.mean(np.square(errors))):.3f} %",
            "<= 0.05 %",
        )
    ]

    K = true / 1.01
    flexed = Truth(AxisTruth(D_x=K, differential_flexure=1e-7 / G, differential_phase=0.4), None, FogTruth(),
                   RigTruth(tilt=np.radians(10 / 3600), earth_rate=truth.rig.earth_rate))  # fmt: skip
    both = make_manifest(levels=[n * G for n in (1, 10, 20, 40)], radius=2.0, net_rate=NET, both_senses=True)
    found = fit_centrifuge(both, Simulation(both, flexed, 50.0, 300.0, 20.0, True)).calibration
    left = max(abs(found.value(f"x_K_{n}") / K - 1) for n in range(1, 5))
    rows.append(("0.1 µrad/g of differential flexure, both senses, left in K", f"{100 * left:.1e} %", "<= 0.01 %"))
    wrong = replace(flexed, x=AxisTruth(D_x=K), rig=replace(flexed.rig, table_rate_error=1e-4))
    one = make_manifest(levels=[n * G for n in (1, 10, 20, 40)], radius=2.0, net_rate=NET)
    found = fit_centrifuge(one, Simulation(one, wrong, 50.0, 900.0, 20.0, False)).calibration
    left = max(abs(found.value(f"x_K_{n}") / K - 1) for n in range(1, 5))
    rows.append(("table rate off by 1e-4, no table_angle, left in K", f"{100 * left:.1e} %", "<= 0.02 %"))
    return rows


def _coverage(encoder: bool, trials: int) -> dict[str, float]:
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
    from centrifuge_trials import coverage_of

    return coverage_of(trials, encoder=encoder)


def coverage(trials: int = 400) -> list[tuple[str, str, str]]:
    """Coverage of the 95 % intervals on a shortened test (see tests/centrifuge_trials.py)."""
    found = []
    with ProcessPoolExecutor(2) as pool:  # no time is measured here
        both = list(pool.map(_coverage, (True, False), (trials, trials)))
    for encoder, shares in zip((True, False), both, strict=True):
        what = "with table_angle" if encoder else "without table_angle"
        for name, share in shares.items():
            label = f"95 % intervals of {name}, {trials} shortened tests, {what}"
            found.append((label, f"{100 * share:.1f} %", "93 to 97 %"))
    return found


def rows() -> list[tuple[str, str, str]]:
    """Return what was found beside what was asked."""
    return [*forty_three_million(), *accuracy(), *coverage()]

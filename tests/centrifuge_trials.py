"""Many shortened centrifuge tests: what their intervals cover. Shared by the slow test and the benchmark."""

from __future__ import annotations

import numpy as np

from imulab.procedures.centrifuge.fit import fit_centrifuge
from imulab.procedures.centrifuge.manifest import make_manifest
from imulab.procedures.centrifuge.simulate import Simulation, typical_truth

G = 9.80665
LEVELS = (1, 3, 6, 10)


def coverage_of(trials: int, *, encoder: bool = True, seed: int = 0) -> dict[str, float]:
    """Share of 95 % intervals that hold the truth: K_i, zeta_i and the curve's parameters, each pooled over both axes.

    Two power cycles, runs of 60 s at 20 Hz (14 table periods at 1 g), radius and arm rates known; K grows as
    1 + c2 a^2, and the curve's model is given.
    """
    truth = typical_truth(0.01)
    test = make_manifest(levels=[n * G for n in LEVELS], radius=2.0, net_rate=np.radians(40.0), cycles=2)
    force = np.array(sorted({test.force(run) for run in test.runs if run.role == "loaded"}))
    expected = {}
    for letter, axis in (("x", truth.x), ("y", truth.y)):
        K0 = float(np.hypot(axis.D_x, axis.D_y))
        K = K0 * (1 + axis.c2 * force**2)
        expected |= {f"{letter}_K_{n}": K[n - 1] for n in range(1, len(K) + 1)}
        expected |= {f"{letter}_zeta_{n}": K[n - 1] / K[0] - 1 for n in range(2, len(K) + 1)}
        expected |= {f"{letter}_K0": K0, f"{letter}_c2": axis.c2}
        if encoder:
            expected[f"{letter}_direction"] = float(np.arctan2(axis.D_y, axis.D_x))
    kinds = {"K_i": "_K_", "zeta_i": "_zeta_", "the curve": ("_K0", "_c2", "_direction")}
    hits: dict[str, list[bool]] = {kind: [] for kind in kinds}
    for trial in range(trials):
        simulation = Simulation(test, truth, 20.0, 60.0, 5.0, encoder, seed=seed + trial)
        record = fit_centrifuge(test, simulation, curve="c2").calibration
        for name, value in expected.items():
            parameter = record.parameters[name]
            half = record.fit["coverage_factor_95"][name] * parameter.standard_uncertainty
            kind = next(k for k, marks in kinds.items() if any(m in name for m in np.atleast_1d(marks)))
            hits[kind].append(abs(parameter.value - value) <= half)
    return {kind: float(np.mean(held)) for kind, held in hits.items()}

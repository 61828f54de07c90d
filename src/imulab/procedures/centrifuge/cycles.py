"""K and zeta of each power cycle by itself: how far a test repeats."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.procedures.centrifuge.levels import Levels, pooled
from imulab.procedures.centrifuge.model import K_UNIT
from imulab.procedures.centrifuge.repeat import Repeatability


def power_cycles(levels: Levels, method: str) -> list[dict[str, Any]]:
    """Return K_i and zeta_i of every power cycle, with what noise and rates leave uncertain of them.

    ``zeta_i = K_i / K_1 - 1`` with both K of the same cycle; a cycle without the reference has no zeta. Prefixes are
    those of the parameters.
    """
    repeatability = Repeatability(run=levels.repeatability.run, run_freedom=levels.repeatability.run_freedom)
    rows: list[dict[str, Any]] = []
    for cycle in sorted({cycle for level in levels.items for cycle in level.cycles}):
        row: dict[str, Any] = {"power_cycle": cycle}
        for level in levels.items:
            group = [levels.lines[index] for index in level.runs]
            mine = [line for line in group if line.source.run.power_cycle == cycle]
            if not mine:
                continue
            own = pooled(level.number, level.spin_axis, mine, repeatability, level.directed)
            for axis, letter in enumerate("xy"[: len(own.line)]):
                size = float(abs(own.line[axis]))
                unit = np.array([own.line[axis].real, own.line[axis].imag]) / max(size, 1e-300)
                pair = slice(2 * axis, 2 * axis + 2)
                u = float(np.sqrt(unit @ own.covariance[pair, pair] @ unit))
                if level.directed and method == "least-squares":
                    size -= float(own.component_variance[axis]) / (2 * max(size, 1e-300))
                found = row.setdefault(letter if level.spin_axis == "up" else f"{letter}_down", {})
                found[f"K_{level.number}"] = {"value": size, "standard_uncertainty": u, "unit": K_UNIT}
        for found in row.values():
            if isinstance(found, dict) and "K_1" in found:
                found |= _zeta(found)
        rows.append(row)
    return rows


def _zeta(found: dict[str, Any]) -> dict[str, Any]:
    first = found["K_1"]
    zeta = {}
    for name, K in found.items():
        if name == "K_1":
            continue
        ratio = K["value"] / first["value"]
        relative = np.hypot(K["standard_uncertainty"] / K["value"], first["standard_uncertainty"] / first["value"])
        zeta[name.replace("K", "zeta")] = {
            "value": ratio - 1, "standard_uncertainty": float(abs(ratio) * relative), "unit": "1",
        }  # fmt: skip
    return zeta

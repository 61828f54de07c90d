"""What the array commands print."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from json import dumps

from imulab.procedures.gyro_array.compare import Comparison
from imulab.procedures.gyro_array.experiments import ExperimentRow
from imulab.procedures.gyro_array.model import unit_of_angle
from imulab.procedures.gyro_array.traces import method_texts
from imulab.report.elements import plain_number
from imulab.shown import aligned

_TITLE = {
    "static": "at rest, 100 Hz, 2000 s",
    "dynamic": "on a rate table, -12.5 cos(0.2 pi t - 0.2 pi) deg/s, 50 Hz, 100 s",
}


def experiment(name: str, seeds: int, rows: list[ExperimentRow]) -> str:
    """Return the two tables of an experiment: without and with a calibrated start."""
    lines = [f"{name}: 6 gyros {_TITLE[name]}; medians of {seeds} seeds"]
    for calibrated in (False, True):
        lines += ["", f"{'with' if calibrated else 'without'} a calibrated start"]
        body = [
            [r.method, *(plain_number(v, 4) for v in (r.rate_std, r.rate_max, r.angle_std, r.angle_max))]
            for r in rows
            if r.calibrated == calibrated
        ]
        lines += aligned(["method", "rate std deg/s", "rate max deg/s", "angle std deg", "angle max deg"], body)
    return "\n".join(lines)


def experiment_json(name: str, seeds: int, rows: list[ExperimentRow]) -> str:
    """Return the same as JSON."""
    return dumps({"experiment": name, "seeds": seeds, "rows": [asdict(row) for row in rows]}, indent=1)


def comparison(found: Comparison) -> str:
    """Return a table of all seven methods for each axis."""
    model, data = found.record.model, found.record.data
    lines = [
        f"{found.elements.count} gyros on each axis, {found.record.fit['samples']} samples at "
        f"{found.record.fit['sample_rate']['value']:.6g} Hz; truth: {model['truth']}"
    ]
    for a, axis in enumerate(found.elements.axes):
        unit = found.elements.units[a]
        angle, factor = unit_of_angle(unit)
        halves = any(not isinstance(rows, str) and rows[a].split_half is not None for rows in found.figures.values())
        titles = [
            "method", f"rate std {unit}", f"rate max {unit}", f"angle std {angle}", f"angle max {angle}", "reduction",
            "noise/limit", "bandwidth Hz", *([f"split-half {unit}"] if halves else []),
        ]  # fmt: skip
        body, reasons = [], []
        for method, rows in found.figures.items():
            if isinstance(rows, str):
                body.append([method, *["–"] * (len(titles) - 1)])
                reasons.append(f"({method} cannot run: {rows})")
                continue
            body.append([method, *method_texts(rows[a], factor, 4, halves=halves)])
        lines += ["", *([f"axis {axis}"] if axis else []), *aligned(titles, body), *reasons]
        lines.append(
            f"single gyro, mean of {_gyros_of_mean(found.elements.names[a], data['working'][a])}: "
            f"{plain_number(data['single'][a], 4)} {unit}; limit of one sample {plain_number(data['limit'][a], 4)} "
            f"{unit}"
        )
    lines.append(
        "rate std with the mean removed; reduction: single gyro over method; bandwidth at -3 dB, half the sampling "
        "rate where nothing is filtered"
    )
    return "\n".join(lines)


def _gyros_of_mean(names: Sequence[str], working: Sequence[str]) -> str:
    """Return which gyros the mean single gyro is the mean of."""
    if len(working) == len(names):
        return "all"
    failed = " ".join(name for name in names if name not in working)
    return f"the {len(working)} that work (not {failed})" if working else "none"

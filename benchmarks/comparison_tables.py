"""The tables of docs/comparison.md, made from the figures in comparison.json."""

from __future__ import annotations

import re
import statistics
from typing import Any

RECORDINGS = ("Xsens MTi", "MPU-9150, unit 1", "MPU-9150, unit 2", "cave survey, six recordings")
PEERS = ("plain least squares", "imu_tk", "imu_tk, means of rests", "imu-calib-toolkit")
TIE = 0.02
"""Two programs are equal where the median of the ratios of their errors is this near to 1."""
ABSENT = "not measured here"


def filled(page: str, measured: dict[str, Any]) -> str:
    """Return the page with each part between `<!-- made: NAME -->` and `<!-- end -->` made anew."""
    parts = {
        "prediction": prediction(measured["quarter"], measured["processes"]),
        "verdict": verdict(measured["quarter"]),
        "prediction, third": prediction(measured["third"], None),
        "verdict, third": verdict(measured["third"]),
        "orders": orders(measured),
        "cost": cost(measured),
        "session": session(measured["session"]),
        "versions": ", ".join(f"{name} {number}" for name, number in measured["versions"].items()) + ".",
    }

    def made(found: re.Match[str]) -> str:
        return f"<!-- made: {found[1]} -->\n\n{parts[found[1]]}\n\n<!-- end -->"

    return re.sub(r"<!-- made: (.*?) -->\n.*?<!-- end -->", made, page, flags=re.DOTALL)


def _table(title: list[str], rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(row) + " |" for row in [title, ["---"] * len(title), *rows])


def _spread(values: list[float | None] | None, recorded: bool) -> str:
    if values is None:
        return ABSENT if recorded else "needs a recording"
    good = [value for value in values if value is not None]
    failed = len(values) - len(good)
    shown = f"{statistics.median(good):.0f} ({min(good):.0f} to {max(good):.0f})" if good else ""
    return shown + (f" {failed} of {len(values)} failed" if failed else "")


def prediction(errors: dict[str, Any], processes: dict[str, list[float]] | None) -> str:
    """Program by recording: median, smallest and largest of the splits."""
    rows = []
    for program in ("imulab", "imulab, all attitudes alike", *PEERS):
        recorded = [not (program.startswith("imu_tk") and name == RECORDINGS[-1]) for name in RECORDINGS]
        row = [program] + [
            _spread(errors[name].get(program), known) for name, known in zip(RECORDINGS, recorded, strict=True)
        ]
        if processes is not None:
            row.append(f"{processes[program][0]:.2f} s" if program in processes else "")
        rows.append(row)
    return _table(["µg", *RECORDINGS] + (["time, Xsens MTi"] if processes is not None else []), rows)


def _against(ours: list[float], theirs: list[float | None] | None) -> str:
    if theirs is None:
        return ""
    ratios = [mine / other for mine, other in zip(ours, theirs, strict=True) if other is not None]
    ratio = statistics.median(ratios)
    better = sum(value < 1 - TIE for value in ratios)
    worse = sum(value > 1 + TIE for value in ratios)
    word = "**loses**" if ratio > 1 + TIE else "**wins**" if ratio < 1 - TIE else "ties"
    return f"{word}: {better} better, {worse} worse, {len(ratios) - better - worse} equal"


def verdict(errors: dict[str, Any]) -> str:
    """Whether imulab wins, ties or loses against each program, split by split."""
    rows = [
        [peer] + [_against(errors[name]["imulab"], errors[name].get(peer)) for name in RECORDINGS] for peer in PEERS
    ]
    return _table(["imulab against", *RECORDINGS], rows)


def orders(measured: dict[str, Any]) -> str:
    """Which order imulab chose, of all splits."""
    rows = []
    for name in RECORDINGS:
        of = [measured[f"orders, {part}"][name] for part in ("quarter", "third")]
        rows.append([name, *(", ".join(f"{order}: {n} times" for order, n in sorted(o.items())) for o in of)])
    return _table(["order chosen", "a quarter left out", "a third left out"], rows)


def cost(measured: dict[str, Any]) -> str:
    """Processor time and memory of whole processes, and time of the fit alone."""
    processes, fits = measured["processes"], measured["fits"]
    rows = []
    for program in ("imulab", "imu_tk"):
        spent = processes.get(program)
        shown = [f"{spent[0]:.2f} s", f"{spent[1]:.0f} MB"] if spent else [ABSENT] * 2
        rows.append([f"{program}, whole process, from the recording", *shown, _ratio(spent, processes["imulab"])])
    for program in ("imulab", "imulab, order 1", "imu-calib-toolkit"):
        taken = fits.get(program)
        rows.append(
            [
                f"{program}, fit alone, from 38 attitudes",
                f"{1e3 * taken:.1f} ms" if taken else ABSENT,
                "",
                _ratio([taken] if taken else None, [fits["imulab"]]),
            ]
        )
    return _table(["", "time", "peak memory", "time over imulab's"], rows)


def _ratio(spent: list[float] | None, ours: list[float]) -> str:
    return f"{spent[0] / ours[0]:.2f}" if spent else ""


def session(found: dict[str, Any]) -> str:
    """imucal's own session."""
    value = {name: f"{found[name]:.0f}" if name in found else ABSENT for name in ("imucal", "imu-calib-toolkit")}
    largest = found.get("misalignment")
    bound = f"none is left; largest misalignment {largest}, no warning" if largest else ABSENT
    rows = [
        ["imucal", "six rests, taken as level, and three turns", value["imucal"]],
        ["imu-calib-toolkit", "six rests; leaves misalignment out by itself", value["imu-calib-toolkit"]],
        ["imu-calib-toolkit", f"all {found['attitudes']} rests", bound],
        ["imulab", f"all {found['attitudes']} rests", f"refuses: {found['imulab']}"],
    ]
    return _table(["program", "is given", "rms of \\|f\\| - g at three rests that were not used, µg"], rows)

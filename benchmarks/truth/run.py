"""Run every scenario and write docs/truth.md (``make truth``), or the sections of the modules that are named.

``--all`` makes ten times as many trials, and 500 at least: 5 % are then two standard deviations above 3 %
(``make truth-all``).
"""

from __future__ import annotations

import importlib
import math
import sys
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

from _findings import head  # noqa: E402
from scenario import Scenario, Trial  # noqa: E402

PAGE = HERE.parent.parent / "docs" / "truth.md"
HEAD = """# Is it true?

Each row is a disturbance, a habit or a default that people have, simulated many times with a known truth. The
simulators are in `benchmarks/truth/` (of whole arrays it is that of `imulab array simulate --imus`) and share no code
with the fits. A row holds if the stated 95 % intervals contain the truth as often as asked, or if imulab says what is
wrong as often as asked. `make truth` makes this page anew in some minutes on two processors;
`make truth-all` has 500 trials or more in each row, which tell 3 from 5 %.

*Coverage* is the share of stated 95 % intervals that hold the truth, over all quantities and trials of the row.
*Warned* is the share of trials in which imulab named the fault or refused the data. Limits that were asked are in
brackets. A row falls short where it misses a limit by more than two standard deviations of its own sampling.
"""

REAL = "Real recordings"
FOUND = "What was found to be wrong"
TITLES = "| disturbance | trials | coverage | warned | rms error | |\n|---|---|---|---|---|---|"


def modules() -> list[str]:
    """Return the names of the modules that hold scenarios."""
    return sorted(
        path.stem for path in HERE.glob("*.py") if path.stem not in {"run", "scenario"} and path.stem[0] != "_"
    )


def attempt(module: str, index: int, seed: int) -> Trial:
    """Run one trial of one scenario, in whatever process."""
    scenario = importlib.import_module(module).SCENARIOS[index]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trial: Trial = scenario.trial(seed)
    return trial


def missed(share: float, low: float, high: float, count: int) -> bool:
    """Whether a share, in %, lies outside its limits by more than two standard deviations of its sampling."""

    def spread(limit: float) -> float:
        return 200 * math.sqrt(max(limit / 100 * (1 - limit / 100), 0.0) / max(count, 1))

    return share < low - spread(low) or share > high + spread(high)


def row(scenario: Scenario, trials: list[Trial]) -> tuple[str, bool]:
    """Return the row of one scenario, and whether it holds."""
    n = len(trials)
    inside = [inner for trial in trials for inner in trial.covered]
    coverage = 100 * float(np.mean(inside)) if inside else math.nan
    warned = 100 * float(np.mean([trial.warned for trial in trials]))
    errors = np.array([trial.error for trial in trials])
    errors = errors[np.isfinite(errors)]
    rms = float(np.sqrt(np.mean(errors**2))) if errors.size else math.nan
    held = True
    shown = "" if math.isnan(coverage) else f"{coverage:.0f} %"
    if scenario.coverage is not None:
        low, high = scenario.coverage
        # Quantities of one trial are not independent: the trials count.
        held &= not missed(coverage, low, high, n) if inside else scenario.warned is not None
        shown += f" ({low:g} to {high:g})"
    said = f"{warned:.0f} %"
    if scenario.warned is not None:
        held &= not missed(warned, scenario.warned, 100.0, n)
        said += f" (at least {scenario.warned:g})"
    if scenario.false_alarms is not None:
        held &= not missed(warned, 0.0, scenario.false_alarms, n)
        said += f" (at most {scenario.false_alarms:g})"
    error = "" if math.isnan(rms) else f"{rms:.3g} {scenario.unit}"
    if scenario.largest_error is not None:
        held &= rms <= scenario.largest_error
        error += f" (at most {scenario.largest_error:g})"
    verdict = "holds" if held else "**falls short**"
    return f"| {scenario.name} | {n} | {shown} | {said} | {error} | {verdict} |", held


def recordings() -> str:
    """Return the section of verdicts on real recordings; empty where there are none here."""
    from _recordings import DATA, verdicts

    if not DATA.is_dir():
        return ""
    lines = [f"| {name} | {state} | {why} |".replace("|f|", "f").replace("|m|", "m") for name, state, why in verdicts()]
    head = "| recording | verdict | why |\n|---|---|---|\n"
    return (
        f"\n## {REAL}\n\nThey are not part of the project, and nobody knows of a fault in them.\n\n{head}"
        + "\n".join(lines)
        + "\n"
    )


def with_sections(page: str, sections: dict[str, str]) -> str:
    """Return the page with sections, by title, in the place of those of the same title, or at its end."""
    parts = page.split("\n## ")[1:]
    kept = {part.split("\n", 1)[0]: f"\n## {part}" for part in parts} | sections
    kept.pop(FOUND, None)
    real = kept.pop(REAL, "")
    return HEAD + head(kept) + "".join(kept.values()) + real


def count(scenario: Scenario, *, every: bool) -> int:
    """Return how many trials are made."""
    return max(10 * scenario.trials, 500) if every else scenario.trials


def main(wanted: list[str]) -> int:
    """Run the scenarios of the wanted modules, or of all, and write their sections of the page."""
    every = "--all" in wanted
    wanted = [name for name in wanted if name != "--all"]
    names = [name for name in modules() if not wanted or name in wanted]
    started = time.perf_counter()
    groups: dict[str, list[str]] = {}
    short = []
    with ProcessPoolExecutor(2) as pool:
        for module in names:
            for index, scenario in enumerate(importlib.import_module(module).SCENARIOS):
                begun = time.perf_counter()
                n = count(scenario, every=every)
                trials = list(
                    pool.map(attempt, [module] * n, [index] * n, range(n), chunksize=max(1, min(n // 16, 20)))
                )
                line, held = row(scenario, trials)
                groups.setdefault(scenario.group, []).append(line)
                short += [] if held else [scenario.name]
                print(f"{time.perf_counter() - begun:6.1f} s {scenario.group}: {line}", flush=True)
    minutes = (time.perf_counter() - started) / 60
    sections = {group: f"\n## {group}\n\n{TITLES}\n" + "\n".join(lines) + "\n" for group, lines in groups.items()}
    if not wanted or wanted == ["recordings"]:
        sections |= {REAL: real} if (real := recordings()) else {}
    page = PAGE.read_text(encoding="utf-8") if wanted else ""
    PAGE.write_text(with_sections(page, sections), encoding="utf-8")
    print(f"{minutes:.1f} minutes; " + (f"falls short: {'; '.join(short)}" if short else "every row holds"))
    return 1 if short else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

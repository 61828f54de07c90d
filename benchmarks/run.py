"""Measurements against what they were asked to reach, and against peers: one Markdown table, written to RESULTS.md.

Ratios are medians of interleaved runs in one process; absolute times depend on the machine.
"""

from __future__ import annotations

import io
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import numpy as np

import imulab as il
from imulab.estimate import chi_square_limit
from imulab.tumble.gyro import fit_gyro
from imulab.tumble.plan import plan_tumble
from imulab.tumble.solve import Problem, solve_norm

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from reference import tumble as reference

G = 9.80665
HERE = Path(__file__).resolve().parent
ROWS: list[tuple[str, str, str]] = []


def seconds(*functions: Callable[[], object], repeats: int = 5) -> list[float]:
    """Median time of each function, the functions taking turns."""
    times: list[list[float]] = [[] for _ in functions]
    for _ in range(repeats):
        for collected, function in zip(times, functions, strict=True):
            begin = time.perf_counter()
            function()
            collected.append(time.perf_counter() - begin)
    return [statistics.median(collected) for collected in times]


def process(*arguments: str) -> Callable[[], object]:
    return lambda: subprocess.run([sys.executable, *arguments], check=True, capture_output=True)


def row(what: str, found: str, asked: str = "") -> None:
    ROWS.append((what, found, asked))
    print(f"{what}: {found}" + (f" (asked: {asked})" if asked else ""), flush=True)


def starting() -> None:
    bare, loaded, shown = seconds(process("-c", ""), process("-c", "import imulab"), process("-m", "imulab", "--help"))
    row("`import imulab`, beyond a bare Python", f"{loaded - bare:.3f} s", "< 0.25 s")
    row("`imulab --help`, whole process", f"{shown:.2f} s", "< 0.5 s")


def reading() -> None:
    rng = np.random.default_rng(1)
    rows = 1_000_000
    data = np.column_stack([np.arange(rows) / 100, 9.8 * rng.standard_normal((rows, 6))])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "r.csv"
        names = ["time [s]"] + [f"{s}_{a} [{u}]" for s, u in (("accel", "m/s^2"), ("gyro", "deg/s")) for a in "xyz"]
        for digits, label in (("%.6f", "6 decimals"), ("%.17g", "17 digits")):
            np.savetxt(path, data, fmt=digits, delimiter=",", header=",".join(names), comments="")
            few = b"\n".join(path.read_bytes().split(b"\n")[1:200_001])
            ours, numpy_few = seconds(
                lambda: il.read(path), lambda few=few: np.loadtxt(io.BytesIO(few), delimiter=","), repeats=3
            )
            row(f"read CSV, 1 million rows x 7 columns, {label}", f"{ours:.2f} s", "about 1 s")
            row(f"the same against `numpy.loadtxt`, {label}", f"{ours / (5 * numpy_few):.2f} times its time")
            try:
                import polars
            except ImportError:
                continue
            ours, peer = seconds(lambda: il.read(path), lambda: polars.read_csv(path), repeats=5)
            row(f"the same against `polars.read_csv` (2 threads), {label}", f"{ours / peer:.2f} times its time")


def segmenting() -> None:
    rng = np.random.default_rng(2)
    count = 10_000_000
    index = np.arange(count)
    hold, phase = index // 2500, index % 2500
    up = rng.standard_normal((hold[-1] + 1, 3))
    up *= G / np.linalg.norm(up, axis=1, keepdims=True)
    columns = {"time": index / 100}
    for i, axis in enumerate("xyz"):
        moving = np.where(phase > 2000, 3 * np.sin(0.05 * (i + 1) * phase), 0.0)
        columns[f"accel_{axis}"] = up[hold, i] + moving + 0.01 * rng.standard_normal(count)
    recording = il.Recording(columns, {"time": "s"} | {f"accel_{a}": "m/s^2" for a in "xyz"})
    (found,) = seconds(lambda: il.find_attitudes(recording), repeats=3)
    row("find attitudes in 10 million samples", f"{found:.2f} s", "<= 2 s")


def fitting() -> None:
    rng = np.random.default_rng(3)
    truth = reference.random_truth(rng, 1)
    outputs = np.array([reference.forward(G * u, truth, 1) for u in reference.random_attitudes(rng, 38)])
    outputs += 1e-3 * rng.standard_normal(outputs.shape)
    table = il.Recording(
        {f"accel_{a}": outputs[:, i].copy() for i, a in enumerate("xyz")}, {f"accel_{a}": "m/s^2" for a in "xyz"}
    )
    attitudes = il.find_attitudes(table)
    ours, peer = seconds(
        lambda: il.fit_tumble(attitudes, order=1, gravity=G), lambda: plain_scipy_fit(outputs), repeats=31
    )
    row("fit of 38 attitudes, order 1, record included", f"{1e3 * ours:.1f} ms", "<= 3 ms")
    row("the same against plain `scipy.optimize.least_squares`", f"{ours / peer:.2f} times its time")

    truth = reference.random_truth(rng, 4)
    clean = np.array([reference.forward(G * u, truth, 4) for u in reference.random_attitudes(rng, 24)]) / G
    noisy = clean + 2e-5 * rng.standard_normal((10_000, 24, 3))
    covariance = np.broadcast_to(4e-10 * np.eye(3), (1, 24, 3, 3))
    (batch,) = seconds(lambda: solve_norm(Problem(noisy, covariance, 4), limit=chi_square_limit(6)), repeats=3)
    row("10,000 fits of 24 attitudes, order 4, one batch, nominal start", f"{batch:.1f} s", "<= 4 s")
    (planned,) = seconds(lambda: plan_tumble(order=4, attitudes=24), repeats=3)
    row("plan of 24 attitudes, order 4", f"{planned:.2f} s", "<= 3 s")
    recording = il.simulate_tumble(order=1, attitudes=38, seed=1)
    attitudes = il.find_attitudes(recording)
    record = il.fit_tumble(attitudes, order=1, gravity=G).calibration
    (gyro,) = seconds(lambda: fit_gyro(record, attitudes, recording), repeats=5)
    row("gyroscope triad from 37 turns, 26,400 samples", f"{gyro:.2f} s", "<= 1 s")


def efficiency() -> None:
    """Rms error over the Cramér-Rao bound and coverage of 95 % intervals, through the public fit."""
    sigma, trials = 2e-4, 2000
    for order, count in ((1, 24), (2, 24), (4, 24), (4, 48)):
        rng = np.random.default_rng(1000 * order + count)
        truth = reference.random_truth(rng, order)
        directions = reference.random_attitudes(rng, count)
        clean = np.array([reference.forward(G * u, truth, order) for u in directions])
        bound = np.sqrt(np.diag(reference.bound(directions, truth, order, G, np.full((count, 3), sigma))))
        for known in (True, False):
            errors, covered = [], []
            for _ in range(trials):
                noisy = clean + sigma * rng.standard_normal(clean.shape)
                columns = {f"accel_{a}": noisy[:, i].copy() for i, a in enumerate("xyz")}
                columns |= {f"std_accel_{a}": np.full(count, sigma) for a in "xyz"} if known else {}
                table = il.Recording(columns, dict.fromkeys(columns, "m/s^2"))
                record = il.fit_tumble(il.find_attitudes(table), order=order, gravity=G).calibration
                error = np.array([p.value for p in record.parameters.values()]) - list(truth.values())
                half = [record.fit["coverage_factor_95"] * p.standard_uncertainty for p in record.parameters.values()]
                errors.append(error)
                covered.append(np.abs(error) <= half)
            ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / bound
            row(
                f"order {order}, {count} attitudes, noise {'known' if known else 'estimated'}: rms / Cramér-Rao bound",
                f"{ratio.min():.3f} to {ratio.max():.3f}, pooled {np.sqrt(np.mean(ratio**2)):.3f}; "
                f"95 % intervals cover {100 * np.mean(covered):.1f} %",
                "<= 1.05 (5,000 trials); 93 to 97 %",
            )


def plain_scipy_fit(outputs: np.ndarray) -> np.ndarray:
    """What one would write without imulab: nine parameters, finite differences."""
    from scipy.optimize import least_squares

    def misfit(p: np.ndarray) -> np.ndarray:
        s = outputs / p[3:6] - p[0:3]
        x = s[:, 0]
        y = s[:, 1] - p[6] * x
        z = s[:, 2] - p[7] * x - p[8] * y
        return np.sqrt(x * x + y * y + z * z) - G

    return np.asarray(least_squares(misfit, [0.0] * 3 + [1.0] * 3 + [0.0] * 3, method="lm").x)


def main() -> None:
    for part in (starting, reading, segmenting, fitting, efficiency):
        part()
    names = ("imulab", "numpy", "scipy", "polars")
    lines = [
        "# Measurements",
        "",
        "Made by `make bench`; medians of interleaved runs. "
        f"Python {platform.python_version()}, {', '.join(f'{n} {version(n)}' for n in names)}, "
        f"{platform.machine()}, 2 cores.",
        "",
        "| what | found | asked |",
        "|---|---|---|",
        *(f"| {what} | {found} | {asked} |" for what, found, asked in ROWS),
        "",
        "Ratios to the bound are of 2,000 trials, known to 1.6 % each; `make test-all` pins them at 5,000 trials.",
    ]
    (HERE / "RESULTS.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()

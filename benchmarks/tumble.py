"""Tumble: speed against a plain solver and imucal, accuracy against the Cramér-Rao bound."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from timing import Row, exponent, seconds

import imulab as il
from imulab.procedures.tumble.gyro.fit import fit_gyro_triad
from imulab.procedures.tumble.plan import plan_attitudes
from imulab.procedures.tumble.solve import TumbleProblem, solve_norm

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from reference import tumble as reference

G = 9.80665
AXES = "xyz"


def table(outputs: np.ndarray, sigma: float | None = None) -> il.Recording:
    columns = {f"accel_{a}": outputs[:, i].copy() for i, a in enumerate(AXES)}
    columns |= {f"std_accel_{a}": np.full(len(outputs), sigma) for a in AXES} if sigma else {}
    return il.Recording(columns, dict.fromkeys(columns, "m/s^2"))


def rows() -> list[Row]:
    return [
        *segmenting(), *fitting(), *monte_carlo(), *planning(), *published(), *six_positions(), *growth(), *efficiency()
    ]  # fmt: skip


def segmenting() -> list[Row]:
    recording = _holds(10_000_000)
    (found,) = seconds(lambda: il.find_attitudes(recording), repeats=3)
    return [("find attitudes in 10 million samples", f"{found:.2f} s", "<= 2 s")]


def _holds(count: int) -> il.Recording:
    rng = np.random.default_rng(2)
    index = np.arange(count)
    hold, phase = index // 2500, index % 2500
    up = rng.standard_normal((hold[-1] + 1, 3))
    up *= G / np.linalg.norm(up, axis=1, keepdims=True)
    columns = {"time": index / 100}
    for i, axis in enumerate(AXES):
        moving = np.where(phase > 2000, 3 * np.sin(0.05 * (i + 1) * phase), 0.0)
        columns[f"accel_{axis}"] = up[hold, i] + moving + 0.01 * rng.standard_normal(count)
    return il.Recording(columns, {"time": "s"} | {f"accel_{a}": "m/s^2" for a in AXES})


def fitting() -> list[Row]:
    rng = np.random.default_rng(3)
    truth = reference.random_truth(rng, 1)
    outputs = np.array([reference.forward(G * u, truth, 1) for u in reference.random_attitudes(rng, 38)])
    outputs += 1e-3 * rng.standard_normal(outputs.shape)
    attitudes = il.find_attitudes(table(outputs))
    ours, peer = seconds(
        lambda: il.fit_tumble(attitudes, order=1, gravity=G), lambda: plain_scipy_fit(outputs), repeats=31
    )
    problem = TumbleProblem(outputs[None] / G, None, 1)
    bare, again = seconds(lambda: solve_norm(problem), lambda: plain_scipy_fit(outputs), repeats=31)
    return [
        ("fit of 38 attitudes, order 1, record included", f"{1e3 * ours:.1f} ms", "<= 3 ms"),
        (
            "the same against plain `scipy.optimize.least_squares` (numbers only)",
            f"{ours / peer:.2f} times its time",
            "",
        ),
        ("the solver alone against the same", f"{bare / again:.2f} times its time", ""),
    ]


def monte_carlo() -> list[Row]:
    """One batch against the loop of plain fits that one would write."""
    rng = np.random.default_rng(4)
    truth = reference.random_truth(rng, 4)
    clean = np.array([reference.forward(G * u, truth, 4) for u in reference.random_attitudes(rng, 24)]) / G
    noisy = clean + 2e-5 * rng.standard_normal((10_000, 24, 3))
    covariance = np.broadcast_to(4e-10 * np.eye(3), (1, 24, 3, 3))
    (batch,) = seconds(lambda: solve_norm(TumbleProblem(noisy, covariance, 4, excess=False)), repeats=3)
    linear = reference.random_truth(rng, 1)
    first = np.array([reference.forward(G * u, linear, 1) for u in reference.random_attitudes(rng, 24)])
    many = first + 2e-4 * rng.standard_normal((2_000, 24, 3))
    ours, loop = seconds(
        lambda: solve_norm(TumbleProblem(many / G, None, 1)),
        lambda: [plain_scipy_fit(one) for one in many[:200]],
        repeats=3,
    )
    return [
        ("10,000 fits of 24 attitudes, order 4, one batch, nominal start", f"{batch:.1f} s", "<= 4 s"),
        ("Monte Carlo, order 1: a batch against a loop of `scipy.optimize.least_squares`",
         f"{10 * loop / ours:.0f} times faster", ""),
    ]  # fmt: skip


def planning() -> list[Row]:
    (planned,) = seconds(lambda: plan_attitudes(order=4, attitudes=24), repeats=3)
    recording = il.simulate_tumble(order=1, attitudes=38, seed=1)
    attitudes = il.find_attitudes(recording)
    record = il.fit_tumble(attitudes, order=1, gravity=G).calibration
    (gyro,) = seconds(lambda: fit_gyro_triad(record, attitudes, recording), repeats=5)
    return [
        ("plan of 24 attitudes, order 4", f"{planned:.2f} s", "<= 3 s"),
        ("gyroscope triad from 37 turns, 26,400 samples", f"{gyro:.2f} s", "<= 1 s"),
    ]


def published() -> list[Row]:
    """The published method's claim, misalignments to arcseconds, with the source's order and its attitudes."""
    ups, sigma, trials = plan_attitudes(order=4, attitudes=24, distinct_verticals=True).directions, 20e-6 * G, 200
    found: list[Row] = []
    for size, part in (("navigation grade", 0.05), ("MEMS size", 1.0)):
        rng = np.random.default_rng(8)
        errors: dict[str, list[float]] = {"linearised": [], "norm": []}
        for _ in range(trials):
            truth = {
                name: (name[0] == "s") + part * (x - (name[0] == "s"))
                for name, x in reference.random_truth(rng, 4).items()
            }
            outputs = np.array([reference.forward(G * u, truth, 4) for u in ups])
            attitudes = il.find_attitudes(table(outputs + sigma * rng.standard_normal(outputs.shape), sigma))
            for method, values in errors.items():
                record = il.fit_tumble(attitudes, order=4, method=method, gravity=G, loss="square").calibration
                values += [record.value(f"misalignment_{m}") - truth[f"misalignment_{m}"] for m in ("yx", "zx", "zy")]
        rms = {method: np.degrees(np.sqrt(np.mean(np.square(values)))) * 3600 for method, values in errors.items()}
        text = f"{rms['linearised']:.1f} arcsec; method norm {rms['norm']:.1f}"
        found.append(
            (f"misalignments by method linearised, {size}, 20 ug, {trials} units", text, "arcseconds (source)")
        )
    return found


def six_positions() -> list[Row]:
    """imucal's Ferraris calibration needs six level positions, imulab any 24: error of |f| within 1 g after each."""
    try:
        from imucal import FerrarisCalibration
        from imucal.ferraris_calibration import FerrarisSignalRegions
    except ImportError:
        return [("against imucal on six positions", "not measured: imucal is not installed (`pip install imucal`)", "")]
    rng = np.random.default_rng(5)
    sigma, samples, trials = 1e-3 * G, 500, 200
    faces = np.concatenate([np.eye(3), -np.eye(3)])[[0, 3, 1, 4, 2, 5]]
    spin = np.deg2rad(np.linspace(0, 360, samples)) * 0 + 2 * np.pi
    turns = {f"gyr_{a}_rot": np.eye(3)[i] * np.degrees(spin[:, None]) for i, a in enumerate(AXES)}
    errors: dict[str, list[float]] = {"0": [], "0.5": [], "imulab": []}
    probe = G * reference.random_attitudes(rng, 100)
    one = None
    for _ in range(trials):
        truth = reference.random_truth(rng, 1)
        probed = np.array([reference.forward(f, truth, 1) for f in probe])
        for tilt in (0.0, 0.5):
            positions = faces + np.deg2rad(tilt) * rng.standard_normal((6, 3))
            positions /= np.linalg.norm(positions, axis=1, keepdims=True)
            means = np.array([reference.forward(G * u, truth, 1) for u in positions])
            signal = means[:, None] + sigma * rng.standard_normal((6, samples, 3))
            names = [f"acc_{a}_{end}" for a in AXES for end in ("p", "a")]
            still = {f"gyr_{a}_{end}": np.zeros((samples, 3)) for a in AXES for end in ("p", "a")}
            moving = {f"acc_{a}_rot": np.zeros((samples, 3)) for a in AXES}
            regions = FerrarisSignalRegions(**dict(zip(names, signal, strict=True)), **still, **moving, **turns)
            found = FerrarisCalibration(grav=G).compute(regions, 100.0, from_acc_unit="m/s^2", from_gyr_unit="deg/s")
            corrected = (probed - found.b_a) @ np.linalg.inv(found.K_a @ found.R_a).T
            errors[f"{tilt:g}"].append(_worst(corrected, probe))
            one = regions if tilt == 0 else one
        outputs = np.array([reference.forward(G * u, truth, 1) for u in reference.random_attitudes(rng, 24)])
        outputs += sigma / np.sqrt(samples) * rng.standard_normal(outputs.shape)
        record = il.fit_tumble(il.find_attitudes(table(outputs)), order=1, gravity=G).calibration
        applied = il.apply(record, table(probed)).triad("accel")
        errors["imulab"].append(_worst(applied, probe))
    attitudes = il.find_attitudes(table(outputs))
    ours, peer = seconds(
        lambda: il.fit_tumble(attitudes, order=1, gravity=G),
        lambda: FerrarisCalibration(grav=G).compute(one, 100.0, from_acc_unit="m/s^2", from_gyr_unit="deg/s"),
        repeats=15,
    )
    rms = {name: 1e3 * np.sqrt(np.mean(np.square(values))) / G for name, values in errors.items()}
    return [
        ("error of |f| within 1 g after imulab, 24 unknown attitudes", f"{rms['imulab']:.3f} mg", ""),
        ("the same after imucal, six positions exactly level", f"{rms['0']:.3f} mg", ""),
        ("the same after imucal, six positions level to 0.5 deg", f"{rms['0.5']:.3f} mg", ""),
        ("fit with uncertainties against imucal's", f"{ours / peer:.2f} times its time", ""),
    ]


def _worst(corrected: np.ndarray, truth: np.ndarray) -> float:
    """Rms error of the magnitude: what neither frame convention can hide."""
    return float(np.sqrt(np.mean((np.linalg.norm(corrected, axis=1) - np.linalg.norm(truth, axis=1)) ** 2)))


def growth() -> list[Row]:
    sizes = [100_000.0, 1_000_000.0, 10_000_000.0]
    recordings = [_holds(int(n)) for n in sizes]
    found = [seconds(lambda r=recording: il.find_attitudes(r), repeats=3)[0] for recording in recordings]
    rng = np.random.default_rng(6)
    truth = reference.random_truth(rng, 2)
    fits, counts = [], [24.0, 240.0, 2400.0]
    for n in counts:
        outputs = np.array([reference.forward(G * u, truth, 2) for u in reference.random_attitudes(rng, int(n))])
        attitudes = il.find_attitudes(table(outputs + 1e-3 * rng.standard_normal(outputs.shape)))
        fits.append(seconds(lambda a=attitudes: il.fit_tumble(a, order=2, gravity=G), repeats=3)[0])
    return [
        ("growth: attitudes in 0.1, 1, 10 million samples", _grown(sizes, found), "exponent 1"),
        ("growth: fit of 24, 240, 2,400 attitudes, order 2", _grown(counts, fits), ""),
    ]


def _grown(sizes: list[float], times: list[float]) -> str:
    return ", ".join(f"{t:.3g} s" for t in times) + f"; exponent {exponent(sizes, times):.2f}"


def efficiency() -> list[Row]:
    """Rms error over the Cramér-Rao bound and coverage of 95 % intervals, through the public fit."""
    sigma, trials = 2e-4, 2000
    found: list[Row] = []
    for order, count in ((1, 24), (2, 24), (4, 24), (4, 48)):
        rng = np.random.default_rng(1000 * order + count)
        truth = reference.random_truth(rng, order)
        directions = reference.random_attitudes(rng, count)
        clean = np.array([reference.forward(G * u, truth, order) for u in directions])
        bound = np.sqrt(np.diag(reference.bound(directions, truth, order, G, np.full((count, 3), sigma))))
        for known in (True, False):
            errors, covered = [], []
            for _ in range(trials):
                noisy = table(clean + sigma * rng.standard_normal(clean.shape), sigma if known else None)
                record = il.fit_tumble(il.find_attitudes(noisy), order=order, gravity=G).calibration
                error = np.array([p.value for p in record.parameters.values()]) - list(truth.values())
                half = [record.fit["coverage_factor_95"] * p.standard_uncertainty for p in record.parameters.values()]
                errors.append(error)
                covered.append(np.abs(error) <= half)
            ratio = np.sqrt(np.mean(np.square(errors), axis=0)) / bound
            found.append(
                (
                    f"order {order}, {count} attitudes, noise {'known' if known else 'estimated'}: "
                    "rms / Cramér-Rao bound, 2,000 trials",
                    f"{ratio.min():.3f} to {ratio.max():.3f}, pooled {np.sqrt(np.mean(ratio**2)):.3f}; "
                    f"95 % intervals cover {100 * np.mean(covered):.1f} %",
                    "<= 1.05 (5,000 trials); 93 to 97 %",
                )
            )
    return found


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

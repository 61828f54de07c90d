"""What the methods ask of accuracy, on simulated and on real recordings, each figure beside what was asked."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from timing import Row

import imulab as il
from imulab.procedures.centrifuge.manifest import Manifest, Run
from imulab.procedures.centrifuge.simulate import Simulation, Truth, typical_truth
from imulab.procedures.gyro_array.elements import find_elements
from imulab.procedures.gyro_array.stream import FuseOptions, open_stream
from imulab.procedures.tumble.gyro.fit import fit_gyro_triad
from imulab.procedures.tumble.plan import plan_attitudes
from imulab.procedures.views import compare_records
from imulab.recording import Recording

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from reference import tumble as reference
from reference.centrifuge import fourier
from reference.warmup import cubic

G = 9.80665
XYZ = "xyz"
DATA = Path(os.environ.get("IMULAB_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
# Worst axis per unit noise of |f|: attitudes, order, parameters with the figures of the method's table.
PLANS = (
    (24, 2, {"k2": 1.2}),
    (24, 3, {"k2": 1.6, "k3": 2.1}),
    (24, 4, {"k2": 5.4, "k3": 3.0, "k4": 4.5}),
    (48, 2, {"k2": 0.8}),
    (48, 3, {"k2": 1.0, "k3": 1.4}),
    (48, 4, {"k2": 3.8, "k3": 2.0, "k4": 3.2}),
)


def rows() -> list[Row]:
    real = [*_xsens(), *_sap5(), *_mpu9150()] if (DATA / "xsens_mti").is_dir() else []
    return [*_recovery(), *_plans(), *_array(), *_warmup(), *_centrifuge(), *real]


def _table(outputs: np.ndarray, unit: str = "m/s^2") -> il.Recording:
    columns = {f"accel_{a}": outputs[:, i].copy() for i, a in enumerate(XYZ)}
    return il.Recording(columns, dict.fromkeys(columns, unit))


def _recovery() -> list[Row]:
    made = []
    for order in range(1, 6):
        rng, truths, founds = np.random.default_rng(order), [], []
        for _ in range(20):
            truth = reference.random_truth(rng, order)
            up = reference.random_attitudes(rng, 12 * (order + 2))
            outputs = np.array([reference.forward(G * u, truth, order) for u in up])
            found = il.fit_tumble(il.find_attitudes(_table(outputs)), order=order, gravity=G).calibration
            truths.append(list(truth.values()))
            founds.append([found.value(name) for name in truth])
        size = np.sqrt(np.mean(np.square(truths), axis=0))  # a single value may happen to be near zero
        worst = np.max(np.abs(np.subtract(founds, truths)) / size)
        made.append((f"tumble, order {order}, noise-free: worst error over size, 20 units", f"{worst:.0e}", "<= 1e-9"))
    return made


def _plans() -> list[Row]:
    made = []
    for count, order, table in PLANS:
        found = plan_attitudes(order=order, attitudes=count).uncertainties(1.0)
        worst = {stem: max(value for name, value in found.items() if name.startswith(stem)) for stem in table}
        made.append(
            (
                f"plan of {count} attitudes, order {order}: uncertainty of {' / '.join(table)}, per unit noise",
                " / ".join(f"{value:.2f}" for value in worst.values()),
                " / ".join(f"{value:.1f}" for value in table.values()),
            )
        )
    return made


def _array() -> list[Row]:
    """White noise of six gyros with unequal noise: `robust` against inverse variances that nobody knows."""
    made = []
    for title, rate, count, motion in (
        ("dynamic, 50 Hz, 100 s", 50.0, 5000, -12.5),
        ("static, 100 Hz, 2000 s", 100.0, 200_000, 0.0),
    ):
        ratios = []
        for seed in range(20 if motion else 5):
            rng = np.random.default_rng(seed)
            sigma = 0.05 * rng.uniform(0.6, 1.6, 6)
            truth = motion * np.cos(0.2 * np.pi * np.arange(count) / rate - 0.2 * np.pi)
            readings = truth[:, None] + sigma * rng.standard_normal((count, 6)) + 0.02 * rng.standard_normal(6)
            ours = _robust(readings, rate) - truth
            known = readings @ (sigma**-2 / np.sum(sigma**-2)) - truth
            ratios.append(float(ours.std() / known.std()))
        made.append(
            (f"array `robust`, {title}: std over that of known variances, worst of {len(ratios)} seeds",
             f"{max(ratios):.3f}", "<= 1.02")
        )  # fmt: skip
    motion = 20 * np.sin(0.8 * np.arange(3000) / 50)
    readings = motion[:, None] + np.linspace(-0.5, 0.5, 6)
    leak = np.ptp(_robust(readings, 50.0) - readings.mean(axis=1)) / np.ptp(motion)
    return [*made, ("array `robust`, noise-free motion: gain error against the mean", f"{leak:.0e}", "< 1e-6")]


def _robust(readings: np.ndarray, rate: float) -> np.ndarray:
    columns = {"time": np.arange(len(readings)) / rate} | {f"gyro_{i + 1}": z for i, z in enumerate(readings.T)}
    recording = Recording(columns, {"time": "s"} | dict.fromkeys(list(columns)[1:], "deg/s"))
    stream = open_stream(FuseOptions(), find_elements(recording), rate, readings[:100, None])
    return np.asarray(stream.process(readings[:, None, :]).rate[:, 0])


def _warmup() -> list[Row]:
    """The same cubic at every temperature, without noise."""
    b = np.random.default_rng(1).standard_normal(4) * 300 * np.pi / 180 / 3600
    time = np.arange(8000) / 20
    z = np.where(time < 300, [cubic(b, t / 300) for t in time], 0.0)
    cycles = [
        Recording(
            {"time": time, "gyro_x": 1e-3 + z}, {"time": "s", "gyro_x": "rad/s"}, {"power_on_temperature": str(t)}
        )
        for t in (-40, -30, -20, -10, 0, 40, 50, 60)
    ]
    found = il.fit_warmup(cycles, model="interval-cubic", settling_time=300.0).table.coefficients[:, 0]
    worst = np.abs(found / b - 1).max()
    return [("warm-up, cubic truth, noise-free: worst relative error of a coefficient", f"{worst:.0e}", "<= 1e-9")]


def _centrifuge() -> list[Row]:
    """The source's formulas, transcribed apart, where the period is a whole number of samples."""
    truth, net = typical_truth(), np.radians(40.0)
    still = {"angle_random_walk": 0.0}
    truth = Truth(replace(truth.x, **still), None, replace(truth.fog, **still), replace(truth.rig, flexure=0.0))
    runs = [Run(f"{n}.csv", 1, "loaded", 2 * np.pi * n + net, 2 * np.pi * n) for n in (1, 2)]
    test = Manifest(2.0, (Run("s.csv", 1, "static"), *runs), reference=2.0 * runs[0].arm_rate ** 2)
    simulation = Simulation(test, truth, 200.0, 60.3, 20.0, True)
    record = il.fit_centrifuge(test, simulation, method="fourier").calibration
    rest, worst = _columns(simulation, test.runs[0]), 0.0
    for number, run in enumerate(runs, start=1):
        c = _columns(simulation, run)
        x, fog = (c[name] - rest[name].mean() for name in ("dtg_x", "fog"))
        a, b, *_ = fourier(x - fog, run.table_rate, 1 / 200)
        expected = np.hypot(a, b) / (2.0 * run.arm_rate**2)
        worst = max(worst, abs(record.value(f"x_K_{number}") / expected - 1))
    return [
        ("centrifuge, `fourier` against the source's formulas: worst relative difference", f"{worst:.0e}", "<= 1e-12")
    ]


def _columns(simulation: Simulation, run: Run) -> dict[str, np.ndarray]:
    blocks = list(simulation(run))
    return {name: np.concatenate([block.si(name) for block in blocks]) for name in ("dtg_x", "fog")}


def _xsens() -> list[Row]:
    text = 'delimiter = "whitespace"\n[columns]\ntime = { from = 0, unit = "s" }\n'
    read = {}
    with tempfile.TemporaryDirectory() as folder:
        for short, sensor in (("acc", "accel"), ("gyro", "gyro")):
            layout = Path(folder) / f"{sensor}.toml"
            columns = (f'{sensor}_{a} = {{ from = {i}, unit = "count" }}\n' for i, a in enumerate(XYZ, start=1))
            layout.write_text(text + "".join(columns))
            read[sensor] = il.read(DATA / "xsens_mti" / f"xsens_{short}.mat", layout)
    attitudes = il.find_attitudes(read["accel"])
    record = il.fit_tumble(attitudes, order="auto", gravity=9.81744).calibration
    published = reference.upper_triangular_fit(attitudes.mean, 9.81744)
    expected = reference.to_lower_gauge(published)
    off = max(abs(record.value(n) - v) / (record.parameters[n].standard_uncertainty or 1) for n, v in expected.items())
    micro = 1e6 / 9.81744
    made: list[Row] = [
        ("Xsens MTi: attitudes; order chosen", f"{len(attitudes)}; {record.model['order']}", "38; 1"),
        ("Xsens MTi: rms / leave-one-out of |f|, µg",
         f"{record.fit['rms']['value'] * micro:.1f} / {record.fit['leave_one_out']['value'] * micro:.1f}",
         "100 / 146 (reference)"),
        ("Xsens MTi: farthest parameter from a plain scipy fit, in standard uncertainties", f"{off:.3f}", ""),
    ]  # fmt: skip
    for fit_bias, asked in ((False, "0.00152"), (True, "0.00124")):
        fit = fit_gyro_triad(record, attitudes, read["gyro"], fit_bias=fit_bias, sensitivity="no")
        ours = reference.gyro_inverse_k(published, fit.scale_factor, fit.misalignment)
        worst = np.abs(ours / [4777.99, 4764.30, 4773.40] - 1).max()
        title = f"Xsens MTi gyroscopes, {12 if fit_bias else 9} parameters, no g-sensitivity"
        made += [
            (f"{title}: half the sum of squared angles, rad²", f"{fit.cost / 2:.5f}", f"<= {asked}"),
            (f"{title}: farthest 1/K from the reference, in its gauge", f"{100 * worst:.3f} %", "<= 0.1 %"),
        ]
    fit = fit_gyro_triad(record, attitudes, read["gyro"])
    made.append(
        ("Xsens MTi gyroscopes, g-sensitivity from rest: half the sum of squared angles", f"{fit.cost / 2:.5f}", "")
    )
    return made


def _sap5() -> list[Row]:
    orders, records = [], {}
    for name in ("ab", "ai", "bh", "fb", "hj", "hj2"):
        flat = [v for v in json.loads((DATA / "sap5" / f"{name}.json").read_text())["shots"]["grav"] if v is not None]
        outputs = np.array([v for v in flat if v == v]).reshape(-1, 3)
        record = il.fit_tumble(il.find_attitudes(_table(outputs, "g")), order="auto", gravity=G).calibration
        orders.append(str(record.model["order"]))
        records[name] = record
    changes = [c for c in compare_records(records["hj"], records["hj2"]).changes if c.name.startswith("k2")]
    claimed = " ".join(c.name for c in changes if c.significant) or "none"
    return [
        ("six cave-survey instruments: order chosen", " ".join(orders), "2 on all"),
        ("one of them twice: changes of k2 claimed by `show A B`", claimed, "none"),
    ]


def _mpu9150() -> list[Row]:
    names = [f"{sensor}_{a}" for sensor in ("accel", "gyro") for a in XYZ]
    text = 'delimiter = "whitespace"\nsample_rate = { value = 100, unit = "Hz" }\n[columns]\n'
    text += "".join(
        f'{n} = {{ from = {i}, unit = "{"m/s^2" if n[0] == "a" else "rad/s"}" }}\n' for i, n in enumerate(names)
    )
    found = []
    with tempfile.TemporaryDirectory() as folder:
        layout = Path(folder) / "mpu.toml"
        layout.write_text(text)
        for name in ("imu0.log", "imu1.log"):
            attitudes = il.find_attitudes(il.read(DATA / "mpu9150" / name, layout))
            fit = il.fit_tumble(attitudes, order="auto", gravity=G).calibration.fit
            found.append(f"{fit['rms']['value'] / G * 1e3:.3f} / {fit['leave_one_out']['value'] / G * 1e3:.3f}")
    return [("two MPU-9150: rms / leave-one-out, mg", ", ".join(found), ".14 to .26 / .25 to .43")]

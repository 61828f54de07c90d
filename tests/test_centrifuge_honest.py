"""What a centrifuge test's defaults must say: the curve whichever model is right, delays found, cycles, windows."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import imulab as il
from imulab.procedures.centrifuge.manifest import load_manifest, make_manifest, manifest_text
from imulab.procedures.centrifuge.parameters import fit_curve
from imulab.procedures.centrifuge.simulate import Simulation, typical_truth

G = 9.80665
NET = np.radians(40.0)
FORCE = np.array([1.0, 2.0, 5.0, 10.0, 15.0, 20.0]) * G


@pytest.mark.parametrize("bend", [0.0, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("model", ["c1", "c2"])
def test_intervals_of_a_chosen_curve_hold_the_truth_whichever_model_is_right(
    bend: float, model: str, reduced: bool
) -> None:
    """`bend` in standard deviations of that term, at every level: never below 92 %, wider than c1+c2 by 1.5 at most."""
    sigma = 0.01 / np.sqrt(FORCE)
    covariance = np.diag(sigma**2)
    power = {"c1": 1, "c2": 2}[model]
    design = np.stack([np.ones(6), FORCE**power], axis=1)
    u = np.sqrt(np.linalg.inv(design.T @ np.linalg.inv(covariance) @ design)[1, 1])
    truth = 1 + bend * u * FORCE**power
    powers = FORCE[:, None] ** np.arange(3)
    rng = np.random.default_rng(5)
    inside, wide = np.zeros(6), np.zeros(6)
    trials = 200 if reduced else 600
    for _ in range(trials):
        found = fit_curve(FORCE, truth + sigma * rng.standard_normal(6), covariance)
        spread = np.sqrt(np.einsum("np,pq,nq->n", powers, found.covariance, powers))
        inside += np.abs(powers @ found.coefficients - truth) < 1.96 * spread
        wide += spread / trials
    full = fit_curve(FORCE, truth, covariance, "c1+c2").covariance
    assert inside.mean() / trials > 0.93
    assert inside.min() / trials > 0.90
    assert (wide / np.sqrt(np.einsum("np,pq,nq->n", powers, full, powers)) < 1.5).all()


def test_terms_that_were_chosen_away_are_zero_with_an_uncertainty_and_a_given_model_keeps_its_own() -> None:
    test = make_manifest(levels=[n * G for n in (1, 2, 5, 10)], radius=2.0, net_rate=NET)
    simulation = Simulation(test, typical_truth(0.0), 20.0, 60.0, 5.0, seed=3)
    auto = il.fit_centrifuge(test, simulation).calibration
    assert auto.model["curve"]["x"] == "constant"
    for name in ("x_c1", "x_c2"):
        assert auto.value(name) == 0.0
        assert (auto.parameters[name].standard_uncertainty or 0.0) > 0.0
    fixed = il.fit_centrifuge(test, simulation, curve="constant").calibration
    assert "x_c1" not in fixed.parameters
    given = auto.fit["curves"]["x"]["standard_uncertainty_given_model"]["K0"]
    assert given == pytest.approx(fixed.parameters["x_K0"].standard_uncertainty)
    assert np.linalg.eigvalsh(auto.covariance.array()).min() > -1e-9 * np.diagonal(auto.covariance.array()).max()


def late(delay: float, **change: Any) -> Any:
    test = make_manifest(levels=[n * G for n in (1, 5, 10, 20)], radius=2.0, net_rate=NET, both_senses=True)
    truth = typical_truth(0.0)
    truth = replace(truth, fog=replace(truth.fog, delay=delay), **change)
    simulation = Simulation(test, truth, 20.0, 120.0, 5.0, seed=2)
    K = float(np.hypot(truth.x.D_x, truth.x.D_y))
    return test, simulation, K


def test_a_late_fog_is_found_corrected_and_said() -> None:
    test, simulation, K = late(1e-3)
    record = il.fit_centrifuge(test, simulation, curve="constant").calibration
    said = [w for w in record.warnings if "late against table_angle" in w]
    assert len(said) == 1
    found = record.parameters["x_K_4"]
    assert abs(found.value - K) < 3 * (found.standard_uncertainty or 0.0)
    assert abs(found.value / K - 1) < 2e-3  # uncorrected: 1.2 %
    entry = next(e for e in record.fit["error_budget"] if e["error"] == "delay of the FOG")
    assert entry["value"] == pytest.approx(1e-3, abs=3 * entry["standard_uncertainty"])
    assert entry["removed"] > 0.01 > 2 * entry["effect"]


def test_method_fourier_puts_a_late_fog_into_the_uncertainty() -> None:
    test, simulation, K = late(1e-3)
    record = il.fit_centrifuge(test, simulation, method="fourier", curve="constant").calibration
    found = record.parameters["x_K_4"]
    assert any("added to u, not corrected" in w for w in record.warnings)
    assert 3e-3 < abs(found.value / K - 1) < 2 * (found.standard_uncertainty or 0.0) / K


def test_nothing_is_said_of_delays_where_there_are_none() -> None:
    test, simulation, _ = late(0.0)
    record = il.fit_centrifuge(test, simulation).calibration
    assert not [w for w in record.warnings if "late" in w]


def test_a_fog_line_of_nearly_no_size_without_noise_is_no_unsteady_run() -> None:
    """Scatter of rounding against a line of rounding: both are nothing."""
    quiet = typical_truth(0.0)
    rig = replace(quiet.rig, tilt=1e-12, earth_rate=0.0, flexure=0.0)
    truth = replace(
        quiet, rig=rig, x=replace(quiet.x, angle_random_walk=0.0), y=None, fog=replace(quiet.fog, angle_random_walk=0.0)
    )
    test = make_manifest(levels=[G, 5 * G], radius=2.0, net_rate=NET)
    record = il.fit_centrifuge(test, Simulation(test, truth, 20.0, 60.0, 30.0)).calibration
    assert record.value("x_K_2") == pytest.approx(float(np.hypot(truth.x.D_x, truth.x.D_y)), rel=1e-3)


def test_zeta_of_each_power_cycle_is_in_record_and_report(tmp_path: Any) -> None:
    test = make_manifest(levels=[G, 5 * G, 10 * G], radius=2.0, net_rate=NET, cycles=2)
    record = il.fit_centrifuge(test, Simulation(test, typical_truth(), 20.0, 60.0, 5.0)).calibration
    rows = record.fit["power_cycles"]
    assert [row["power_cycle"] for row in rows] == [1, 2]
    for row in rows:
        K = {name: found["value"] for name, found in row["x"].items()}
        assert K["zeta_3"] == pytest.approx(K["K_3"] / K["K_1"] - 1, abs=1e-12)
        assert row["x"]["zeta_3"]["standard_uncertainty"] > 0
    mean = np.mean([row["x"]["K_3"]["value"] for row in rows])
    assert mean == pytest.approx(record.value("x_K_3"), rel=1e-3)
    il.write_report(record, tmp_path / "r.html")
    assert "zeta of each power cycle" in (tmp_path / "r.html").read_text(encoding="utf-8")


def test_runs_of_one_log_are_told_apart_by_their_windows(tmp_path: Any, imulab: Any) -> None:
    test = make_manifest(levels=[G, 5 * G], radius=2.0, net_rate=NET)
    simulation = Simulation(test, typical_truth(), 20.0, 60.0, 30.0)
    parts = {run.file: next(iter(simulation(run))) for run in test.runs}
    start, runs, columns = 0.0, [], []
    for run in test.runs:
        part = parts[run.file]
        il.write_csv(part, tmp_path / run.file)
        seconds = float(part.columns["time"][-1])
        columns.append({**part.columns, "time": part.columns["time"] + start})
        runs.append(replace(run, file="log.csv", window=(round(start - 1, 2), round(start + seconds + 1, 2))))
        start += seconds + 40.0
    log = il.Recording(
        columns={name: np.concatenate([part[name] for part in columns]) for name in columns[0]}, units=part.units
    )
    il.write_csv(log, tmp_path / "log.csv")
    (tmp_path / "apart.toml").write_text(manifest_text(test))
    (tmp_path / "one.toml").write_text(manifest_text(replace(test, runs=tuple(runs))))
    assert load_manifest(tmp_path / "one.toml").runs[1].window == runs[1].window
    values = []
    for name in ("apart", "one"):
        done = imulab("centrifuge", "reduce", f"{name}.toml", "-o", f"{name}.json")
        assert done.returncode == 0, done.stderr
        record = json.loads((tmp_path / f"{name}.json").read_text())
        values.append([record["parameters"][key]["value"] for key in ("x_K_1", "y_K_2", "x_direction")])
    assert values[1] == pytest.approx(values[0], rel=1e-6)
    assert [source["file"] for source in record["sources"]] == ["one.toml", "log.csv"]
    assert record["runs"][1]["window"]


@pytest.mark.parametrize(
    ("window", "said"),
    [
        ('window = "0:100"', "overlaps"),
        ('window = "300:200"', "expected FROM:TO"),
        ('window = "abc"', "expected FROM:TO"),
        ("", "the same file"),
    ],
)
def test_windows_that_cannot_be_are_refused(tmp_path: Any, imulab: Any, window: str, said: str) -> None:
    test = make_manifest(levels=[G], radius=2.0, net_rate=NET)
    text = manifest_text(test).replace("c1_1g.csv", "c1_static.csv")
    static, loaded = text.rsplit("[[run]]", 1)
    (tmp_path / "m.toml").write_text(f'{static}window = "0:50"\n[[run]]{loaded}{window}\n')
    done = imulab("centrifuge", "reduce", "m.toml", "-o", "r.json")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "run 2" in done.stderr
    assert said in done.stderr
    assert not (tmp_path / "r.json").exists()

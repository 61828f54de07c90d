"""Runs to levels, levels to the curve, repeatability, and the error budget."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import imulab as il
from imulab.errors import OptionError
from imulab.procedures.centrifuge.levels import Deviations, find_repeatability
from imulab.procedures.centrifuge.manifest import fog_share, load_manifest, make_manifest, manifest_text
from imulab.procedures.centrifuge.parameters import fit_curve
from imulab.procedures.centrifuge.simulate import AxisTruth, FogTruth, RigTruth, Simulation, Truth, typical_truth
from reference import centrifuge as reference

G, DEG_H = reference.G, reference.DEG_H


K = 3.3 * DEG_H / G


NET = np.radians(40.0)


EARTH = 11.6 * DEG_H


TILTED = RigTruth(tilt=np.radians(10 / 3600), tilt_phase=0.7, earth_rate=EARTH, earth_phase=1.0)


def levels_test(*levels, **options):
    return make_manifest(levels=[n * G for n in levels], radius=2.0, net_rate=NET, **options)


def noise_free(truth: Truth) -> Truth:
    quiet = {"angle_random_walk": 0.0}
    y = None if truth.y is None else replace(truth.y, **quiet)
    return Truth(replace(truth.x, **quiet), y, replace(truth.fog, **quiet), truth.rig)


# --- levels ------------------------------------------------------------------------------------------------------


def test_directions_and_both_axes_with_the_encoder():
    truth = noise_free(typical_truth(0.02))
    test = levels_test(1, 5, 20, cycles=2)
    record = il.fit_centrifuge(test, Simulation(test, truth, 50.0, 120.0, 5.0)).calibration
    assert record.value("x_direction") == pytest.approx(np.radians(25), abs=2e-4)
    assert record.value("y_direction") == pytest.approx(np.radians(115), abs=2e-4)
    force = np.array([level["specific_force"]["value"] for level in record.sections["levels"]])
    for axis, c2 in (("x", truth.x.c2), ("y", truth.y.c2)):
        zeta = (1 + c2 * force**2) / (1 + c2 * force[0] ** 2) - 1
        for n in (2, 3):
            assert record.value(f"{axis}_zeta_{n}") == pytest.approx(zeta[n - 1], abs=2e-4)
    assert [level["runs"] for level in record.sections["levels"]] == [[1, 5], [2, 6], [3, 7]]
    run = record.sections["runs"][3]
    assert run["x"]["unit"] == "rad/s"
    assert np.arctan2(run["x"]["B"], run["x"]["A"]) == pytest.approx(np.radians(25), abs=2e-4)
    assert np.shape(run["x"]["covariance"]) == (2, 2)


def test_without_encoder_magnitudes_and_no_direction():
    test = levels_test(1, 5, 20, cycles=2, both_senses=True)
    truth = noise_free(typical_truth(0.02))
    truth = replace(truth, rig=replace(truth.rig, base_tilt=0.0))
    record = il.fit_centrifuge(test, Simulation(test, truth, 50.0, 120.0, 5.0, False)).calibration
    assert not any("direction" in name for name in record.parameters)
    assert record.value("x_zeta_3") == pytest.approx((1.02) / (1 + 0.02 / 400) - 1, abs=1e-5)
    assert sum("magnitudes of the two senses were averaged" in message for message in record.warnings) == 1


def test_a_second_set_with_the_spin_axis_down_separates_the_cross_terms():
    cross = 2e-3 * K
    truth = Truth(AxisTruth(D_x=K, cross_x=cross, cross_y=-2 * cross), None, FogTruth(), TILTED)
    up = levels_test(1, 10)
    down = tuple(replace(run, file=f"d_{run.file}", spin_axis="down") for run in up.runs if run.role == "loaded")
    test = replace(up, runs=(*up.runs, *down), gravity=9.81)
    truth = replace(truth, rig=replace(truth.rig, gravity=9.81))
    record = il.fit_centrifuge(test, Simulation(test, truth, 50.0, 120.0, 5.0)).calibration
    expected = [abs(K + s * 9.81 * (cross - 2j * cross)) for s in (1, -1)]
    for n in (1, 2):
        assert record.value(f"x_K_{n}") == pytest.approx(expected[0], rel=1e-8)
        assert record.value(f"x_down_K_{n}") == pytest.approx(expected[1], rel=1e-8)
        assert record.value(f"x_cross_{n}") == pytest.approx(abs(cross - 2j * cross), rel=1e-7)
        level = record.sections["levels"][n - 1]
        assert complex(level["x_cross"]["A"], level["x_cross"]["B"]) == pytest.approx(cross - 2j * cross, rel=1e-7)
        assert level["x_half_sum"]["A"] == pytest.approx(K, rel=1e-8)
    assert {"x_down_K0", "x_down_zeta_2", "x_down_direction"} <= set(record.parameters)


def test_levels_below_the_reference_keep_their_rows_but_have_no_number():
    test = replace(levels_test(0.5, 1, 5), reference=G)
    record = il.fit_centrifuge(test, Simulation(test, typical_truth(), 50.0, 90.0, 5.0)).calibration
    assert [level["level"] for level in record.sections["levels"]] == [1, 2]
    assert record.sections["levels"][0]["specific_force"]["value"] == pytest.approx(G, rel=1e-6)
    assert len(record.sections["runs"]) == 4
    assert "A" in record.sections["runs"][1]["x"]


def scattered(**gains):
    """Three power cycles at four levels, K of each cycle times its gain, turned by its angle."""
    test = levels_test(1, 5, 10, 20, cycles=3)
    truth = typical_truth(0.0)
    cycles = {}
    for cycle in (1, 2, 3):
        turn = gains.get("gain", (1, 1, 1))[cycle - 1] * np.exp(1j * gains.get("angle", (0, 0, 0))[cycle - 1])
        x = (truth.x.D_x + 1j * truth.x.D_y) * turn
        cycles[cycle] = replace(truth, x=replace(truth.x, D_x=x.real, D_y=x.imag))
    simulations = {cycle: Simulation(test, one, 50.0, 90.0, 5.0) for cycle, one in cycles.items()}
    return il.fit_centrifuge(test, lambda run: simulations[run.power_cycle](run), curve="constant").calibration


def test_a_change_of_k_from_power_on_to_power_on_does_not_average_out_over_levels():
    steady, changed = scattered(), scattered(gain=(0.98, 1.0, 1.02))
    found = changed.fit["repeatability"]
    # X alone changes: 2 % in X and none in Y are 1.4 % on both, whose mean of three is 0.8 %.
    assert found["relative_standard_deviation"] == pytest.approx(0.02 / np.sqrt(2), rel=0.3)
    assert found["within_power_cycle"] == 0
    assert sum("K differs between power cycles" in message for message in changed.warnings) == 1
    for name in ("x_K_4", "x_K0"):
        u = changed.parameters[name].standard_uncertainty / changed.value(name)
        assert u == pytest.approx(found["relative_standard_deviation"] / np.sqrt(3), rel=0.1)
    before, after = (record.parameters["x_zeta_4"].standard_uncertainty for record in (steady, changed))
    assert after == pytest.approx(before, rel=0.1)
    # What happens to one axis need not happen to the other.
    names = list(changed.covariance.names)
    matrix = changed.covariance.array()
    i, j = names.index("x_K_4"), names.index("y_K_4")
    assert abs(matrix[i, j]) < 0.2 * np.sqrt(matrix[i, i] * matrix[j, j])
    assert steady.fit["repeatability"]["relative_standard_deviation"] == 0
    assert changed.fit["degrees_of_freedom"]["x_K0"] < 10


def test_a_change_of_direction_from_power_on_to_power_on_is_in_the_direction():
    record = scattered(angle=np.radians([-1.0, 0.0, 1.0]))
    found = record.fit["repeatability"]
    assert found["relative_standard_deviation"] < 1e-3
    assert found["direction"]["value"] == pytest.approx(np.radians(1.0) / np.sqrt(2), rel=0.3)
    u = record.parameters["x_direction"].standard_uncertainty
    assert u == pytest.approx(found["direction"]["value"] / np.sqrt(3), rel=0.1)
    assert record.fit["direction_probability"]["x"] > 0.01


def test_repeatability_is_split_between_power_cycles_and_runs():
    rng = np.random.default_rng(7)
    level, cycle = (each.ravel() for each in np.meshgrid(np.arange(30), np.arange(40)))
    sigma = 1e-3 * np.ones(level.size)
    for of_cycle, of_run in ((0.0, 0.0), (2e-2, 0.0), (0.0, 5e-3), (2e-2, 5e-3)):
        size = of_cycle * rng.standard_normal(40)[cycle] + of_run * rng.standard_normal(level.size)
        size += sigma * rng.standard_normal(level.size)
        found = find_repeatability([Deviations(level, cycle, size, 0 * size, sigma**2, sigma**2)])
        assert np.sqrt(found.cycle) == pytest.approx(of_cycle, rel=0.4, abs=1.2e-3 if of_run else 3e-4)
        assert np.sqrt(found.run) == pytest.approx(of_run, rel=0.1, abs=3e-4)
        assert (found.freedom, found.run_freedom) == (39, 29 * 39)
        assert found.turn == 0


def test_counts_are_turned_into_rates_by_the_manifest():
    test = levels_test(1, 5)
    simulation = Simulation(test, typical_truth(), 50.0, 90.0, 5.0, unit="deg/s")
    plain = il.fit_centrifuge(test, simulation).calibration
    counted = replace(
        test, scale_factors={name: (1250.0 / np.radians(1), "count") for name in ("dtg_x", "dtg_y", "fog")}
    )

    def in_counts(run):
        for block in simulation(run):
            columns = {n: block.columns[n] * 1250.0 for n in ("dtg_x", "dtg_y", "fog")}
            yield block.with_columns(columns, dict.fromkeys(columns, "count"))

    again = il.fit_centrifuge(counted, in_counts).calibration
    for name, parameter in plain.parameters.items():
        assert again.value(name) == pytest.approx(parameter.value, rel=1e-9)


# --- curve -------------------------------------------------------------------------------------------------------


def test_the_curve_is_weighted_least_squares():
    rng = np.random.default_rng(4)
    force = G * np.array([1, 2, 5, 10, 20, 40.0])
    root = rng.standard_normal((6, 6)) * 1e-3
    covariance = root @ root.T + 1e-6 * np.eye(6)
    values = 1 + 1e-4 * force + 1e-3 * rng.standard_normal(6)
    found = fit_curve(force, values, covariance, "c1+c2")
    J = np.stack([np.ones(6), force, force**2], axis=1)
    W = np.linalg.inv(covariance)
    np.testing.assert_allclose(found.coefficients, np.linalg.solve(J.T @ W @ J, J.T @ W @ values), rtol=1e-8)
    np.testing.assert_allclose(found.from_levels @ values, found.coefficients, rtol=1e-12)
    left = values - J @ found.coefficients
    assert found.chi_square == pytest.approx(left @ W @ left, rel=1e-6)


def test_an_error_that_all_levels_share_may_be_far_larger_than_their_noise():
    """A covariance whose smaller part is lost in the rounding of the larger has no Cholesky factor of its own."""
    force = G * np.array([1, 2, 5, 10, 20, 40.0])
    common = np.outer(force, force) * 1e3
    found = fit_curve(force, 1e-7 * np.ones(6), common - 1e-6 * np.diag(np.diagonal(common)))
    assert np.isfinite(found.covariance).all()
    assert found.coefficients[0] == pytest.approx(1e-7, rel=1e-3)


def test_model_choice_takes_no_term_too_many_in_nineteen_of_twenty(reduced):
    trials = 200 if reduced else 600
    rng = np.random.default_rng(5)
    force = G * np.array([1, 2, 5, 10, 15, 20, 30, 40.0])
    sigma = 0.02 / (force / G)
    chosen = [fit_curve(force, 1 + sigma * rng.standard_normal(8), np.diag(sigma**2)).model for _ in range(trials)]
    # Two single terms, strongly correlated, at 5 % each, and their pair.
    assert 0.88 < chosen.count("constant") / trials < 0.96
    bent = [
        fit_curve(force, 1 + 2.5e-7 * force**2 + sigma * rng.standard_normal(8), np.diag(sigma**2)) for _ in range(50)
    ]
    assert sum(fit.model == "c2" for fit in bent) > 40


def test_unknown_methods_and_curves_are_refused():
    test = levels_test(1, 5)
    with pytest.raises(OptionError, match=r"expected one of least-squares fourier"):
        il.fit_centrifuge(test, lambda run: [], method="magic")
    with pytest.raises(OptionError, match="expected one of auto constant c1 c2"):
        il.fit_centrifuge(test, lambda run: [], curve="c3")
    with pytest.raises(OptionError, match="2 levels; expected at least 3"):
        il.fit_centrifuge(test, Simulation(test, typical_truth(), 50.0, 60.0, 5.0), curve="c1+c2")


# --- error budget ------------------------------------------------------------------------------------------------


def budget(record):
    return {entry["error"]: entry for entry in record.fit["error_budget"]}


def test_the_budget_finds_what_was_planted():
    truth = typical_truth()
    planted = Truth(
        replace(truth.x, scale_error=4e-3, differential_flexure=1e-7 / G, angle_random_walk=1e-8), None,
        replace(truth.fog, azimuth=2e-3, delay=1e-3, angle_random_walk=1e-8), replace(truth.rig, base_tilt=0.0),
    )  # fmt: skip
    test = replace(levels_test(1, 5, 10, 20, 40, both_senses=True), rate_uncertainty=np.radians(5e-4))
    found = budget(il.fit_centrifuge(test, Simulation(test, planted, 50.0, 200.0, 5.0)).calibration)
    assert found["tilt"]["value"] == pytest.approx(truth.rig.tilt, rel=5e-3)
    assert found["common flexure"]["value"] == pytest.approx(truth.rig.flexure, rel=0.02)
    assert found["scale mismatch"]["value"] == pytest.approx(4e-3, rel=0.05)
    assert found["delay of the FOG"]["value"] == pytest.approx(1e-3, rel=0.01)
    assert found["differential flexure"]["bounded"]
    assert found["differential flexure"]["effect"] == 0
    assert found["differential flexure"]["removed"] > 0.05
    assert found["arm rate"]["bounded"]


def test_the_budget_says_what_the_data_do_not_bound():
    test = levels_test(1, 10, 40)
    found = budget(il.fit_centrifuge(test, Simulation(test, typical_truth(), 50.0, 120.0, 5.0, False)).calibration)
    assert not found["differential flexure"]["bounded"]
    # 0.1 µrad/g at 40 g: up to 7.5 % (methods); 1 ms: 0.6 % at 10 g and more above.
    assert found["differential flexure"]["effect"] == pytest.approx(0.085, rel=0.05)
    assert not found["delay, FOG to X"]["bounded"]
    assert found["table rate"]["bounded"]
    assert found["table rate"]["effect"] < 1e-5


@pytest.mark.parametrize("late", [0.0, 1e-3])
def test_the_budget_tells_the_delay_of_the_fog_from_that_of_x(late):
    truth = replace(noise_free(typical_truth()), fog=FogTruth(delay=late))
    test = levels_test(1, 5, 10, 20, 40)
    found = budget(il.fit_centrifuge(test, Simulation(test, truth, 50.0, 120.0, 5.0)).calibration)
    assert found["delay of the FOG"]["value"] == pytest.approx(late, abs=2e-6)
    assert found["delay of X"]["value"] == pytest.approx(0.0, abs=1e-5)
    # 1 ms of w_s at 40 g turns the FOG's line by 0.76 deg, and that line is as large as the drift.
    size = found["delay of the FOG"]["removed"] if late else found["delay of the FOG"]["effect"]
    assert size == pytest.approx(late * np.radians(762.4) * 1.06, rel=0.05, abs=1e-4)


def test_fog_share_is_the_quarter_turn():
    x, y, fog = 3 + 4j, 1 - 2j, 0.5 + 0.25j
    np.testing.assert_allclose(fog_share(2) @ [x, y, fog], [x - fog, y - complex(-0.25, 0.5)])


G_HONEST = 9.80665


FORCE = np.array([1.0, 2.0, 5.0, 10.0, 15.0, 20.0]) * G_HONEST


@pytest.mark.slow
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
    test = make_manifest(levels=[n * G_HONEST for n in (1, 2, 5, 10)], radius=2.0, net_rate=NET)
    simulation = Simulation(test, typical_truth(0.0), 20.0, 60.0, 5.0, seed=3)
    auto = il.fit_centrifuge(test, simulation).calibration
    assert auto.model["curve"]["x"] == "constant"
    for name in ("x_c1", "x_c2"):
        assert auto.value(name) == 0.0
        assert (auto.parameters[name].standard_uncertainty or 0.0) > 0.0
        assert auto.fit["coverage_factor_95"][name] < 2.1
    fixed = il.fit_centrifuge(test, simulation, curve="constant").calibration
    assert "x_c1" not in fixed.parameters
    given = auto.fit["curves"]["x"]["standard_uncertainty_given_model"]["K0"]
    assert given == pytest.approx(fixed.parameters["x_K0"].standard_uncertainty)
    assert np.linalg.eigvalsh(auto.covariance.array()).min() > -1e-9 * np.diagonal(auto.covariance.array()).max()


def late(delay: float, **change: Any) -> Any:
    test = make_manifest(levels=[n * G_HONEST for n in (1, 5, 10, 20)], radius=2.0, net_rate=NET, both_senses=True)
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
    test = make_manifest(levels=[G_HONEST, 5 * G_HONEST], radius=2.0, net_rate=NET)
    record = il.fit_centrifuge(test, Simulation(test, truth, 20.0, 60.0, 30.0)).calibration
    assert record.value("x_K_2") == pytest.approx(float(np.hypot(truth.x.D_x, truth.x.D_y)), rel=1e-3)


def test_zeta_of_each_power_cycle_is_in_record_and_report(tmp_path: Any) -> None:
    test = make_manifest(levels=[G_HONEST, 5 * G_HONEST, 10 * G_HONEST], radius=2.0, net_rate=NET, cycles=2)
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
    test = make_manifest(levels=[G_HONEST, 5 * G_HONEST], radius=2.0, net_rate=NET)
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
    test = make_manifest(levels=[G_HONEST], radius=2.0, net_rate=NET)
    text = manifest_text(test).replace("c1_1g.csv", "c1_static.csv")
    static, loaded = text.rsplit("[[run]]", 1)
    (tmp_path / "m.toml").write_text(f'{static}window = "0:50"\n[[run]]{loaded}{window}\n')
    done = imulab("centrifuge", "reduce", "m.toml", "-o", "r.json")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "run 2" in done.stderr
    assert said in done.stderr
    assert not (tmp_path / "r.json").exists()

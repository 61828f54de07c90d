"""The centrifuge reduction against equations transcribed apart, and against simulated truth."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import imulab as il
from centrifuge_trials import coverage_of
from imulab.procedures.centrifuge.levels import axis_lines
from imulab.procedures.centrifuge.lines import CellSamples, compress, solve
from imulab.procedures.centrifuge.manifest import Manifest, Run, make_manifest
from imulab.procedures.centrifuge.run import reduce_run
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


def columns_of(simulation, run):
    blocks = list(simulation(run))
    return {name: np.concatenate([block.si(name) for block in blocks]) for name in blocks[0].columns}


# --- the source's method -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoder", [True, False])
def test_fourier_is_the_source_s_formulas(encoder):
    """Noise-free, periods of whole samples (table 1 and 2 Hz at 200 Hz): to 1e-12."""
    radius, static = 2.0, Run("s.csv", 1, "static")
    runs = [Run(f"{n}.csv", 1, "loaded", 2 * np.pi * n + NET, 2 * np.pi * n) for n in (1, 2)]
    force = [(run.arm_rate**2) * radius for run in runs]
    test = Manifest(radius, (static, *runs), reference=force[0])
    truth = noise_free(typical_truth())
    truth = replace(truth, rig=replace(truth.rig, flexure=0.0))
    simulation = Simulation(test, truth, 200.0, 60.3, 20.0, encoder)
    record = il.fit_centrifuge(test, simulation, method="fourier").calibration
    rest = columns_of(simulation, static)
    expected = {"x": [], "y": []}
    for index, run in enumerate(runs, start=1):
        c = columns_of(simulation, run)
        channels = {name: c[name] - rest[name].mean() for name in ("dtg_x", "dtg_y", "fog")}
        A, B, m, _ = reference.fourier(channels["dtg_x"] - channels["fog"], run.table_rate, 1 / 200)
        expected["x"].append(np.hypot(A, B) / force[index - 1])
        line = record.sections["runs"][index]["x"]
        turned = np.exp(1j * (c["table_angle"][0] - run.table_rate / 200)) if encoder else 1.0
        assert line["A"] + 1j * line["B"] == pytest.approx((A + 1j * B) * turned, rel=1e-9)
        A_F, B_F, *_ = reference.fourier(channels["fog"], run.table_rate, 1 / 200)
        A, B, *_ = reference.fourier(channels["dtg_y"], run.table_rate, 1 / 200)
        expected["y"].append(np.hypot(A + B_F, B - A_F) / force[index - 1])
        assert record.sections["runs"][index]["periods"] == m
        assert record.sections["runs"][index]["table_rate_used"]["value"] == run.table_rate
    for axis, values in expected.items():
        assert record.value(f"{axis}_K_1") == pytest.approx(values[0], rel=1e-12)
        assert record.value(f"{axis}_K_2") == pytest.approx(values[1], rel=1e-12)
        assert record.value(f"{axis}_zeta_2") == pytest.approx((values[1] - values[0]) / values[0], abs=1e-12)


def test_fourier_does_not_care_how_the_run_is_cut_into_blocks():
    test = levels_test(1, 4)
    quiet = Simulation(test, noise_free(typical_truth()), 50.0, 60.0, 10.0)
    one = il.fit_centrifuge(test, quiet, method="fourier").calibration
    for size in (11, 700):
        cut = il.fit_centrifuge(test, lambda run, n=size: quiet.blocks(run, n), method="fourier").calibration
        for name, parameter in one.parameters.items():
            if "_K_" in name:
                assert cut.value(name) == pytest.approx(parameter.value, rel=1e-11)


# --- the regression ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoder", [True, False])
def test_the_streamed_regression_is_the_full_one(encoder):
    """Against one least-squares fit with all samples in memory, at the same phase."""
    test = levels_test(3)
    simulation = Simulation(test, typical_truth(), 50.0, 70.0, 10.0, encoder, seed=5)
    found = reduce_run(simulation(test.runs[1]), test, 1)
    c = columns_of(simulation, test.runs[1])
    chi = c["table_angle"] if encoder else found.rates.table_rate * c["time"]
    for number, name in enumerate(("dtg_x", "dtg_y", "fog")):
        beta, inverse = reference.regression(c["time"], chi, found.rates.net_rate, c[name])
        assert found.line[number] == pytest.approx(beta[2] + 1j * beta[3], rel=1e-7)
        assert abs(found.second[number] - (beta[4] + 1j * beta[5])) < 1e-6 * abs(found.line[number])
        assert abs(found.third[number] - (beta[6] + 1j * beta[7])) < 1e-6 * abs(found.line[number])
        assert abs(found.room[number]) == pytest.approx(np.hypot(beta[8], beta[9]), rel=1e-6)
    assert found.rates.solution.gain(2) == pytest.approx((inverse[2, 2] + inverse[3, 3]) / 2, rel=1e-6)


def test_blocks_of_any_size_give_the_same_sums():
    rng = np.random.default_rng(1)
    time = np.arange(5000) / 100
    channels = rng.standard_normal((2, 5000))
    whole = compress([CellSamples(time, channels, None)], 5.0, 0.7)
    for sizes in ([1, 2, 3, 1000, 3994], [2500, 2500], [1] * 1200 + [3800]):
        edges = np.cumsum([0, *sizes])
        parts = [CellSamples(time[a:b], channels[:, a:b], None) for a, b in pairwise(edges)]
        cut = compress(parts, 5.0, 0.7)
        np.testing.assert_allclose(cut.moments, whole.moments, rtol=0, atol=1e-9)
        assert cut.samples == 5000
    assert whole.moments[:, 0, 0].sum() == 5000


@pytest.mark.parametrize("shift", [1e-5, 1e-3, 5e-3])
def test_lines_at_another_rate_than_assumed_come_out_right(shift):
    """The linear part within a cell: 1e-3 rad/s over cells of 1 s is 1e-3 rad."""
    time = np.arange(90000) / 100
    rate = 2 * np.pi + shift
    channel = 3 * np.cos(rate * (time - 449.995)) + 4 * np.sin(rate * (time - 449.995)) + 100 + 0.01 * time
    cells = compress([CellSamples(time, channel[None], None)], 2 * np.pi, 0.7)
    line = solve(cells, shift).line(2)[0] * np.exp(1j * 2 * np.pi * 449.995)
    loss = (shift * 0.5) ** 2 / 6
    assert abs(line) == pytest.approx(5.0, rel=2e-9 + 3 * loss)


def test_a_drifting_run_with_odd_length_has_no_error_where_whole_periods_have():
    """A ramp of 10 in 5 periods: 0.64 off by whole periods (methods), exact by regression."""
    step, rate = 1e-3, 2 * np.pi
    time = np.arange(5000) * step
    channel = np.cos(rate * time) + 100 + 10 * time / 5
    A, B, m, _ = reference.fourier(channel - 100 - 5, rate, step)
    assert m == 5
    assert abs(A + 1j * B - 1) == pytest.approx(10 / (np.pi * 5), rel=1e-2)
    cells = compress([CellSamples(time, channel[None], None)], rate, 1.3)
    assert solve(cells).line(2)[0] == pytest.approx(1.0, abs=1e-9)


# --- acceptance --------------------------------------------------------------------------------------------------


def test_tilt_looks_like_nonlinearity_without_the_fog_and_not_with_it():
    """10 arcsec, a perfectly linear gyroscope: tens of per cent from X alone, less than 0.2 % from X - FOG."""
    linear = Truth(AxisTruth(D_x=K), AxisTruth(D_y=K), FogTruth(), TILTED)
    test = levels_test(1, 5, 10, 20, 40)
    fit = il.fit_centrifuge(test, Simulation(test, linear, 50.0, 120.0, 10.0))
    alone = [abs(run.line[0]) / run.force for run in fit.runs]
    false = 100 * (np.array(alone) / alone[0] - 1)
    assert np.abs(false).max() > 20
    y_minus_fog = [abs(run.line[1] - run.line[2]) / run.force for run in fit.runs]
    assert np.abs(100 * (np.array(y_minus_fog) / y_minus_fog[0] - 1)).max() > 20
    for axis in "xy":
        for level in range(2, 6):
            assert abs(fit.calibration.value(f"{axis}_zeta_{level}")) < 2e-3
            assert abs(fit.calibration.value(f"{axis}_zeta_{level}")) < 1e-8  # noise-free it is exact
    assert "x_c1" not in fit.calibration.parameters or abs(fit.calibration.value("x_c1")) < 1e-8


def test_ten_arcsec_at_ten_g_are_seventy_degrees_per_hour():
    test = levels_test(1, 10)
    run = reduce_run(
        Simulation(test, Truth(AxisTruth(D_x=K), None, FogTruth(), TILTED), 50.0, 90.0, 5.0)(test.runs[2]), test, 2
    )
    assert abs(run.line[1]) / DEG_H == pytest.approx(70.0, rel=0.01)
    assert abs(run.line[0] - run.line[1]) / DEG_H == pytest.approx(33.0, rel=1e-6)


def test_both_senses_remove_flexure_mismatch_and_azimuth():
    flexed = Truth(
        AxisTruth(D_x=K, differential_flexure=1e-7 / G, differential_phase=0.4, scale_error=3e-3), None,
        FogTruth(azimuth=1e-3, scale_error=-2e-3), TILTED,
    )  # fmt: skip
    errors = {}
    for both in (False, True):
        test = levels_test(1, 10, 20, 40, both_senses=both)
        record = il.fit_centrifuge(test, Simulation(test, flexed, 50.0, 120.0, 5.0)).calibration
        errors[both] = max(abs(record.value(f"x_K_{n}") / K - 1) for n in range(1, 5))
    assert errors[False] > 0.03
    assert errors[True] <= 1e-4


@pytest.mark.parametrize("error", [1e-4, -3e-4])
def test_a_wrong_table_rate_is_found_on_the_fog(error):
    wrong = Truth(AxisTruth(D_x=K), None, FogTruth(), replace(TILTED, table_rate_error=error))
    test = levels_test(1, 10, 40)
    fit = il.fit_centrifuge(test, Simulation(test, wrong, 50.0, 300.0, 5.0, False))
    for n, run in enumerate(fit.runs, start=1):
        assert fit.calibration.value(f"x_K_{n}") == pytest.approx(K, rel=2e-4)
        assert run.rates.table_rate == pytest.approx(run.run.table_rate * (1 + error), rel=1e-9)
        used = fit.calibration.sections["runs"][run.index]["table_rate_used"]
        assert used["value"] == pytest.approx(run.rates.table_rate, rel=1e-15)
    # What would be lost without: 1.3 % of the amplitude for 1e-4 at 361 deg/s over 900 s (methods), here sinc(dT/2).
    plain = il.fit_centrifuge(test, Simulation(test, wrong, 50.0, 300.0, 5.0, False), method="fourier").calibration
    lost = abs(error) * test.runs[3].table_rate * 300 / 2
    assert plain.value("x_K_3") / K == pytest.approx(np.sin(lost) / lost, abs=3e-3)
    # fourier says so, and knows it in its uncertainty.
    u = plain.parameters["x_K_3"].standard_uncertainty / K
    assert u == pytest.approx(lost**2 / 6, rel=0.1)
    assert any("costs" in message and "c1_40g.csv" in message for message in plain.warnings)


def test_a_rate_taken_from_the_manifest_costs_what_its_uncertainty_may():
    """No line of the FOG, no encoder: (u_w T)^2 / 24 of the amplitude."""
    level = replace(TILTED, tilt=0.0)
    test = replace(levels_test(1, 10), rate_uncertainty=np.radians(0.05))
    truth = Truth(AxisTruth(D_x=K, angle_random_walk=1e-9), None, FogTruth(angle_random_walk=1e-8), level)
    record = il.fit_centrifuge(test, Simulation(test, truth, 50.0, 300.0, 5.0, False)).calibration
    assert record.sections["runs"][2]["table_rate_from"] == "manifest"
    u = np.hypot((np.radians(0.05) * 300) ** 2 / 24, 2 * np.radians(0.05) / test.runs[2].arm_rate)
    assert record.parameters["x_K_2"].standard_uncertainty / K == pytest.approx(u, rel=0.05)


@pytest.mark.slow
def test_k_at_20_g_within_five_parts_in_ten_thousand():
    """zeta(20 g) = 1 %, angle random walk 0.01 and 0.005 deg/sqrt(h), two power cycles of 15 min."""
    truth = typical_truth(0.01)
    test = levels_test(1, 5, 10, 20, cycles=2)
    true = np.hypot(truth.x.D_x, truth.x.D_y) * (1 + 0.01)
    errors, zetas = [], []
    for seed in range(4):
        record = il.fit_centrifuge(test, Simulation(test, truth, 20.0, 900.0, 5.0, seed=seed)).calibration
        p = {n: record.value(f"x_{n}") if f"x_{n}" in record.parameters else 0.0 for n in ("K0", "c1", "c2")}
        a = 20 * G
        errors.append(p["K0"] * (1 + p["c1"] * a + p["c2"] * a**2) / true - 1)
        zetas.append(
            (record.value("x_zeta_4") - 0.01 * (1 - 1 / 400)) / record.parameters["x_zeta_4"].standard_uncertainty
        )
    assert np.sqrt(np.mean(np.square(errors))) <= 7e-4  # 0.05 % rms, known to 35 % from four trials; see the benchmark
    assert np.abs(zetas).max() < 4


def test_uncertainties_are_the_document_s_formulas():
    """White noise, one run a level, radius and arm rate uncertain: u(K), u(zeta) and their covariance."""
    sigma_x, sigma_f = 3e-6, 2e-6
    walk = Truth(AxisTruth(D_x=K, angle_random_walk=sigma_x), None, FogTruth(angle_random_walk=sigma_f), TILTED)
    base = levels_test(1, 5, 20)
    test = replace(base, radius_uncertainty=2e-3, rate_uncertainty=np.radians(0.05))
    record = il.fit_centrifuge(test, Simulation(test, walk, 50.0, 900.0, 5.0)).calibration
    arm = np.array([run.arm_rate for run in test.runs[1:]])
    force = arm**2 * 2.0
    values = np.array([record.value(f"x_K_{n}") for n in (1, 2, 3)])
    # sigma_A = sigma sqrt(2/N) with sigma^2 = walk^2 rate: walk sqrt(2/T).
    sigma = np.hypot(sigma_x, sigma_f) * np.sqrt(2 / 900)
    u_K, covariance = reference.k_and_zeta_uncertainty(values, values * force, sigma, arm, test.rate_uncertainty, 1e-3)
    found = record.covariance.array()
    names = list(record.covariance.names)
    for n in (1, 2, 3):
        # The scatter over 64 blocks is known to 6 %.
        assert record.parameters[f"x_K_{n}"].standard_uncertainty == pytest.approx(u_K[n - 1], rel=0.2)
    index = [names.index("x_zeta_2"), names.index("x_zeta_3")]
    np.testing.assert_allclose(found[np.ix_(index, index)], covariance, rtol=0.4)
    assert np.linalg.eigvalsh(found / np.sqrt(np.outer(np.diag(found), np.diag(found)))).min() > -1e-9


def test_the_radius_is_common_to_all_k_and_in_no_zeta():
    test = levels_test(1, 5, 20)
    simulation = Simulation(test, typical_truth(), 50.0, 120.0, 5.0)
    known = il.fit_centrifuge(test, simulation).calibration
    unsure = il.fit_centrifuge(replace(test, radius_uncertainty=0.02), simulation).calibration
    for name, parameter in known.parameters.items():
        before, after = parameter.standard_uncertainty, unsure.parameters[name].standard_uncertainty
        power = {"K": 1, "K0": 1, "c1": 1, "c2": 2}.get(name.split("_")[1], 0)
        assert after == pytest.approx(np.hypot(before, power * 0.01 * parameter.value), rel=1e-6)
    names = list(unsure.covariance.names)
    i, j = names.index("x_K_3"), names.index("y_K_3")
    gained = unsure.covariance.array()[i, j] - known.covariance.array()[i, j]
    assert gained == pytest.approx(1e-4 * known.value("x_K_3") * known.value("y_K_3"), rel=1e-6)


def test_coloured_noise_is_in_the_uncertainty(reduced):
    """Gauss-Markov noise of 0.2 s: its spectrum at the line decides, not its variance."""
    trials = 5 if reduced else 12
    coloured = Truth(AxisTruth(D_x=K, markov=5 * DEG_H, markov_time=0.2), None, FogTruth(), TILTED)
    test = levels_test(1, 4)
    deviations = []
    for seed in range(trials):
        record = il.fit_centrifuge(test, Simulation(test, coloured, 50.0, 200.0, 5.0, seed=seed)).calibration
        for n in (1, 2):
            p = record.parameters[f"x_K_{n}"]
            rate = test.runs[n].table_rate
            # One-sided density of the noise at the line, over 2, over T: variance of a component is S(w) 2 / T.
            density = 2 * (5 * DEG_H) ** 2 * 0.2 / (1 + (rate * 0.2) ** 2)
            assert p.standard_uncertainty * test.force(test.runs[n]) == pytest.approx(
                np.sqrt(density * 2 / 200), rel=0.4
            )
            deviations.append((p.value - K) / p.standard_uncertainty)
    assert 0.6 < np.std(deviations) < 1.5


def test_magnitudes_are_corrected_for_noise(reduced):
    """Rice: at K a of three standard deviations the plain magnitude is 5 % too long."""
    trials = 40 if reduced else 100
    loud = Truth(AxisTruth(D_x=K, angle_random_walk=2.2e-5), None, FogTruth(), TILTED)
    test = replace(levels_test(1), reference=G)
    plain, corrected = [], []
    for seed in range(trials):
        fit = il.fit_centrifuge(test, Simulation(test, loud, 10.0, 60.0, 2.0, seed=seed))
        corrected.append(fit.calibration.value("x_K_1") / K)
        plain.append(abs(axis_lines(fit.runs[0], "least-squares")[0][0]) / fit.runs[0].force / K)
    error = np.std(plain) / np.sqrt(len(plain))
    sigma = 2.2e-5 * np.sqrt(2 / 60) / (K * G)
    assert np.mean(plain) - 1 == pytest.approx(sigma**2 / 2, abs=3 * error)
    assert np.mean(plain) - np.mean(corrected) == pytest.approx(sigma**2 / 2, rel=0.3)


RADIUS, RATE, SECONDS, NET_BY_HAND = 1.7, 20.0, 200.0, np.radians(37.0)


LEVELS = (1.0, 4.0, 11.0)


U_RATE, U_RADIUS = np.radians(0.02), 1.7e-3


NOISE = np.array([3e-6, 4e-6, 2e-6])


DRIFT = np.array([3.3 * np.exp(0.5j), 2.9 * np.exp(-2.2j)]) * DEG_H / G


NAMES = [f"{axis}_{name}" for axis in "xy" for name in ("K_1", "K_2", "K_3", "zeta_2", "zeta_3", "direction")]


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """Files of a test that imulab had no hand in, and the same as arrays by level and sense."""
    folder = tmp_path_factory.mktemp("by_hand")
    rng = np.random.default_rng(11)
    text = [
        f'radius = {{ value = {RADIUS}, standard_uncertainty = {U_RADIUS}, unit = "m" }}',
        f'rates = {{ unit = "rad/s", standard_uncertainty = {float(U_RATE)!r} }}',
    ]
    arms = np.sqrt(np.array(LEVELS) * G / RADIUS)
    still = {
        "time": np.arange(400) / RATE,
        "dtg_x": 6e-5 + 1e-7 * rng.standard_normal(400),
        "dtg_y": -3e-5 + 1e-7 * rng.standard_normal(400),
        "fog": 1e-6 + 1e-7 * rng.standard_normal(400),
        "table_angle": np.full(400, 1.0),
    }
    runs = {}
    write(folder / "still.csv", still)
    text += ["[[run]]", 'file = "still.csv"', "power_cycle = 1", 'role = "static"']
    for level, arm in enumerate(arms):
        for sense in (1, -1):
            file = f"{level}{'-+'[sense > 0]}.csv"
            table = arm - NET_BY_HAND
            columns = reference.recording(
                rng, arm=arm, table=table, sense=sense, radius=RADIUS, start=rng.uniform(0, 6), seconds=SECONDS,
                rate=RATE, noise=NOISE, drift=DRIFT * (1 + 0.002 * LEVELS[level]), tilt=5e-5 * np.exp(0.7j),
                earth=11.0 * DEG_H * np.exp(0.2j),
            )  # fmt: skip
            write(folder / file, columns)
            runs[level, sense] = columns
            text += ["[[run]]", f'file = "{file}"', "power_cycle = 1", 'role = "loaded"', f"sense = {sense}"]
            text += [f"arm_rate = {float(arm)!r}", f"table_rate = {float(table)!r}"]
    (folder / "test.toml").write_text("\n".join(text) + "\n")
    return folder, arms, still, runs


def write(path, columns):
    data = {**columns, "table_angle": np.degrees(columns["table_angle"]) % 360.0}
    titles = {"time": "s", "table_angle": "deg"}
    head = ",".join(f"{name} [{titles.get(name, 'rad/s')}]" for name in data)
    np.savetxt(path, np.stack(list(data.values()), axis=1), fmt="%.17g", delimiter=",", header=head, comments="")


def reduced(folder, imulab, *options):
    done = imulab("centrifuge", "reduce", str(folder / "test.toml"), "--json", *options)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_least_squares(rig, imulab):
    folder, arms, _, runs = rig
    record = reduced(folder, imulab, "--curve", "c1")
    found = np.array([record["parameters"][name]["value"] for name in NAMES])
    order = [record["covariance"]["names"].index(name) for name in NAMES]
    covariance = np.array(record["covariance"]["matrix"])[np.ix_(order, order)]

    lines, spread = np.zeros((3, 2, 4)), np.zeros((3, 2, 4, 4))
    for (level, sense), columns in runs.items():
        lines[level, (1 - sense) // 2], spread[level, (1 - sense) // 2] = reference.run_lines(
            columns, sense * NET_BY_HAND
        )
    for (level, sense), (line, matrix) in {
        key: (lines[key[0], (1 - key[1]) // 2], spread[key[0], (1 - key[1]) // 2]) for key in runs
    }.items():
        row = record["runs"][1 + 2 * level + (1 - sense) // 2]
        for axis, pair in (("x", slice(0, 2)), ("y", slice(2, 4))):
            assert (row[axis]["A"], row[axis]["B"]) == pytest.approx(line[pair], abs=3e-4 * np.hypot(*line[pair]))
            assert np.trace(row[axis]["covariance"]) == pytest.approx(np.trace(matrix[pair, pair]), rel=0.6)
    force = np.array(LEVELS) * G
    variances = np.stack(
        [np.trace(spread[:, :, 2 * a : 2 * a + 2, 2 * a : 2 * a + 2], axis1=2, axis2=3) for a in (0, 1)], axis=-1
    ).sum(axis=1) / (8 * force**2)[:, None]  # fmt: skip
    arm = np.repeat(arms[:, None], 2, axis=1)

    def of(lines=lines, arm=arm, radius=RADIUS):
        return reference.parameters(lines, arm, radius, variances)

    expected = of()
    # Every cause of uncertainty, by differences: noise of each line, rate of each run, the radius.
    total = np.outer(*[(of(radius=RADIUS * 1.0001) - expected) / 1e-4 * U_RADIUS / RADIUS] * 2)
    for level in range(3):
        for sense in (0, 1):
            other = arm.copy()
            other[level, sense] += 1e-6
            total += np.outer(*[(of(arm=other) - expected) / 1e-6 * U_RATE] * 2)
            step = 1e-3 * np.abs(lines[level, sense]).max()
            J = np.empty((len(NAMES), 4))
            for k in range(4):
                other = lines.copy()
                other[level, sense, k] += step
                J[:, k] = (of(lines=other) - expected) / step
            total += J @ spread[level, sense] @ J.T
    u = np.sqrt(np.diag(total))
    # The Rice correction and the weights of the direction rest on noise as estimated, here white and there by blocks.
    np.testing.assert_array_less(np.abs(found - expected), 0.02 * u)
    # 2 x 126 degrees of freedom: a standard uncertainty is known to 4.5 %.
    own = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(own, u, rtol=0.15)
    np.testing.assert_allclose(covariance / np.outer(own, own), total / np.outer(u, u), atol=0.1)
    # And the truth: the curve by hand from the K_i, K(a) = K0 (1 + c1 a).
    for axis, size in (("x", abs(DRIFT[0])), ("y", abs(DRIFT[1]))):
        for name, value in (("K0", size), ("c1", 0.002 / G)):
            p = record["parameters"][f"{axis}_{name}"]
            assert abs(p["value"] - value) < 4 * p["standard_uncertainty"]
        assert record["parameters"][f"{axis}_K0"]["unit"] == "rad/s/(m/s^2)"
        assert record["parameters"][f"{axis}_c1"]["unit"] == "1/(m/s^2)"


def test_fourier(rig, imulab):
    folder, arms, still, runs = rig
    record = reduced(folder, imulab, "--method", "fourier")
    for axis, name in (("x", "dtg_x"), ("y", "dtg_y")):
        K = []
        for level, arm in enumerate(arms):
            pair = []
            for sense in (1, -1):
                c = runs[level, sense]
                sums = {}
                for channel in (name, "fog"):
                    A, B, m, _ = reference.fourier(c[channel] - still[channel].mean(), arm - NET_BY_HAND, 1 / RATE)
                    # The sums go with +w_s t, one step at the first sample; chi is table_angle there.
                    first = c["table_angle"][0] - sense * (arm - NET_BY_HAND) / RATE
                    sums[channel] = (A + 1j * sense * B) * np.exp(1j * first)
                pair.append((sums[name] - sums["fog"] * (1 if axis == "x" else 1j)) / (arm**2 * RADIUS))
                assert record["runs"][1 + 2 * level + (1 - sense) // 2]["periods"] == m
            K.append(abs(np.mean(pair)))
        for level in range(3):
            assert record["parameters"][f"{axis}_K_{level + 1}"]["value"] == pytest.approx(K[level], rel=1e-9)
        for level in (1, 2):
            zeta = record["parameters"][f"{axis}_zeta_{level + 1}"]["value"]
            assert zeta == pytest.approx((K[level] - K[0]) / K[0], abs=1e-9)
    assert {"x_K0", "x_direction", "y_K0", "y_direction"} <= set(record["parameters"])


@pytest.mark.slow
@pytest.mark.parametrize("encoder", [True, False], ids=["table_angle", "no-table_angle"])
def test_intervals_cover(encoder, reduced):
    shares = coverage_of(40 if reduced else 2000, encoder=encoder)
    print(shares)
    # 40 trials x 8 K_i are known to about 2 % (axes share the FOG, zeta_i share K_1).
    low, high = (0.90, 0.99) if reduced else (0.93, 0.97)
    for kind, share in shares.items():
        assert low <= share <= high, kind

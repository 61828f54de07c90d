"""The order chosen from the data predicts no worse than the lowest; its uncertainty holds whatever the order."""

import json

import numpy as np
import pytest
from scipy import stats

import imulab as il
from conftest import sap5_table, table
from imulab.display import Note
from imulab.errors import ObservabilityError, OptionError
from imulab.procedures.tumble.plan import plan_attitudes
from reference import tumble as reference

G = 9.80665
SIGMA = 60e-6 * G
SAP5 = ("ab", "ai", "bh", "fb", "hj", "hj2")


@pytest.fixture(scope="module")
def planned():
    return plan_attitudes(order=3, attitudes=24).directions


def triad(rng, k2=0.0, k3=0.0):
    """A triad of 1 % scale error, 20 mg, 10 mrad, with nonlinearity of a size, in 1/g and 1/g^2, and random signs."""
    truth = {f"bias_{a}": 0.02 * G * rng.standard_normal() for a in "xyz"}
    truth |= {f"scale_factor_{a}": 1 + 0.01 * rng.standard_normal() for a in "xyz"}
    truth |= {f"misalignment_{pair}": 0.01 * rng.standard_normal() for pair in ("yx", "zx", "zy")}
    truth |= {f"k2_{a}": k2 / G * rng.choice([-1, 1]) for a in "xyz"}
    return truth | {f"k3_{a}": k3 / G**2 * rng.choice([-1, 1]) for a in "xyz"}


def measured(rng, truth, directions, sigma=SIGMA):
    clean = np.array([reference.forward(G * u, truth, 3) for u in directions])
    return clean + sigma * rng.standard_normal(clean.shape)


def fit(data, sigma=SIGMA, **options):
    return il.fit_tumble(il.find_attitudes(table(data, sigma=sigma)), gravity=G, **options).calibration


def test_sap5_predicts_what_it_has_not_seen_no_worse_than_order_one(real_data, reduced):
    trials = 10 if reduced else 30
    errors = {"auto": [], 1: []}
    for name in SAP5:
        data = sap5_table(real_data / "sap5" / f"{name}.json")
        rng = np.random.default_rng(sum(map(ord, name)))
        for _ in range(trials):
            chosen = rng.permutation(len(data))
            seen, unseen = np.split(chosen, [round(0.7 * len(data))])
            attitudes = il.find_attitudes(table(data[seen], "g"))
            try:
                records = {order: il.fit_tumble(attitudes, order=order, gravity=G).calibration for order in errors}
            except ObservabilityError:
                continue  # these seventeen do not determine order 1 either
            for order, record in records.items():
                values = {name: parameter.value for name, parameter in record.parameters.items()}
                missed = reference.residual(data[unseen], values, record.model["order"], G)
                errors[order].append(np.sqrt(np.mean(missed**2)) / G * 1e3)
    auto, one = (np.array(errors[order]) for order in ("auto", 1))
    assert len(auto) >= 170 / 30 * trials
    assert np.sqrt(np.mean(auto**2)) <= np.sqrt(np.mean(one**2))
    assert np.median(auto) <= 1.096  # mg, before the choice had a margin and a bound


@pytest.mark.parametrize(
    ("size", "names"),
    [
        ({"k2": 40e-6}, ("bias_x", "bias_y", "bias_z")),
        ({"k3": 60e-6}, ("scale_factor_x", "scale_factor_y", "scale_factor_z")),
        ({}, ("bias_x", "bias_y", "bias_z", "scale_factor_x", "scale_factor_y", "scale_factor_z")),
    ],
    ids=["k2", "k3", "none"],
)
@pytest.mark.parametrize("known", [True, False], ids=["noise-known", "noise-unknown"])
def test_intervals_of_auto_hold_whatever_the_order(planned, size, names, known, reduced):
    trials = 24 if reduced else 60
    covered = []
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        truth = triad(rng, **size)
        record = fit(measured(rng, truth, planned), SIGMA if known else None)
        factor = record.fit["coverage_factor_95"]
        covered.append(
            [abs(record.value(n) - truth[n]) < factor * record.parameters[n].standard_uncertainty for n in names]
        )
    # 92 % asked; 180 or 360 intervals of 60 tests scatter by 2.5 %.
    assert np.mean(covered) >= 0.92 - 0.045


def test_the_blend_is_that_of_the_published_formulas(planned):
    rng = np.random.default_rng(3)
    truth = {name: (1.0 if name[0] == "s" else 0.0) for name in triad(rng)}
    truth |= {f"k2_{a}": 40e-6 / G for a in "xyz"}
    data = measured(rng, truth, planned, sigma=2e-6 * G) / G
    rows = np.array([[*-u, *-(u * u), -u[1] * u[0], -u[2] * u[0], -u[2] * u[1], *-(u**3), *-(u**4)] for u in planned])
    y = np.linalg.norm(data, axis=1) - 1
    sizes, sigma = (9, 12, 15), 2e-6
    theta, cost, spread = np.zeros((3, 15)), np.zeros(3), np.zeros((3, 15, 15))
    for e, size in enumerate(sizes):
        j = rows[:, :size]
        spread[e, :size, :size] = np.linalg.inv(j.T @ j) * sigma**2
        theta[e, :size] = np.linalg.lstsq(j, -y, rcond=None)[0]
        cost[e] = np.sum((y + j @ theta[e, :size]) ** 2) / sigma**2
    nu = 24 - 15
    level = cost[2] / nu  # the noise is not stated
    total, matrix, spread = theta[0].copy(), level * spread[0], level * spread
    kappa = (np.arange(100_000) + 0.5) / 100_000
    for e in (1, 2):
        weight = kappa * (1 + kappa * (cost[e - 1] - cost[e]) / level / nu) ** (-(nu + 3) / 2)
        mean = np.sum(weight * kappa) / weight.sum()
        variance = np.sum(weight * (kappa - mean) ** 2) / weight.sum()
        step = theta[e] - theta[e - 1]
        total += (1 - mean) * step
        matrix += 1.3 * ((1 - mean) * (spread[e] - spread[e - 1]) + variance * np.outer(step, step))
    attitudes = il.find_attitudes(table(data, "g"))
    record = il.fit_tumble(attitudes, gravity=G, order="blend").calibration
    u = np.sqrt(np.diag(matrix))
    assert record.model["order"] == 3
    assert record.fit["coverage_factor_95"] == pytest.approx(stats.t.isf(0.025, nu))
    for axis, a in enumerate("xyz"):
        bias, scale = record.parameters[f"bias_{a}"], record.parameters[f"scale_factor_{a}"]
        assert bias.value / G == pytest.approx(total[axis], abs=0.05 * u[axis])
        assert bias.standard_uncertainty / G == pytest.approx(u[axis], rel=0.02)
        assert scale.value * G - 1 == pytest.approx(total[3 + axis], abs=0.05 * u[3 + axis])
        assert scale.standard_uncertainty * G == pytest.approx(u[3 + axis], rel=0.02)
    auto = il.fit_tumble(attitudes, gravity=G).calibration
    away = theta[auto.model["order"] - 1] - total
    expected = np.sqrt(np.diag(matrix) + away**2)
    for axis, a in enumerate("xyz"):
        assert auto.parameters[f"bias_{a}"].standard_uncertainty / G == pytest.approx(expected[axis], rel=0.03)


def test_a_record_of_auto_states_both_uncertainties_and_a_fixed_order_one(planned, tmp_path):
    rng = np.random.default_rng(4)
    data = measured(rng, triad(rng, k2=200e-6), planned)
    auto, fixed = fit(data), fit(data, order=2)
    assert auto.model["order"] == 2
    assert auto.fit["blend"]["highest_order"] == 3
    for name, parameter in fixed.parameters.items():
        assert parameter.standard_uncertainty_given_order is None
        assert auto.value(name) == parameter.value
        assert auto.parameters[name].standard_uncertainty_given_order == parameter.standard_uncertainty
        assert auto.parameters[name].standard_uncertainty >= 0.99 * parameter.standard_uncertainty
    assert "blend" not in fixed.fit
    auto.save(tmp_path / "auto.json")
    read = il.load(tmp_path / "auto.json")
    assert read.parameters == auto.parameters
    plain = json.loads((tmp_path / "auto.json").read_text())["parameters"]["bias_x"]
    assert plain["standard_uncertainty_given_order"] < plain["standard_uncertainty"]


def test_nonlinearity_that_the_attitudes_do_not_show_is_assumed_to_be_zero_and_said():
    rng = np.random.default_rng(5)
    phi = (1 + np.sqrt(5)) / 2
    twelve = np.array([(0, s, t * phi) for s in (-1, 1) for t in (-1, 1)])
    twelve = np.vstack([np.roll(twelve, k, axis=1) for k in range(3)]) / np.hypot(1, phi)
    data = measured(rng, triad(rng), twelve)
    record = fit(data)
    said = [w for w in record.warnings if "assume k3 = 0" in w]
    assert len(said) == 1
    assert isinstance(said[0], Note)
    assert "ppm of scale factor" in said[0]


def test_known_spread_of_nonlinearity_narrows_the_intervals_and_still_covers(planned):
    tau, names, covered, ratio = 20e-6, [f"bias_{a}" for a in "xyz"] + [f"scale_factor_{a}" for a in "xyz"], [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        truth = triad(rng) | {f"k2_{a}": tau / G * rng.standard_normal() for a in "xyz"}
        truth |= {f"k3_{a}": tau / G**2 * rng.standard_normal() for a in "xyz"}
        data = measured(rng, truth, planned)
        record = fit(data, nonlinearity=(tau, tau))
        factor, p = record.fit["coverage_factor_95"], record.parameters
        covered.append([abs(p[n].value - truth[n]) < factor * p[n].standard_uncertainty for n in names])
        one = fit(data, order=1).parameters
        ratio.append([p[n].standard_uncertainty / one[n].standard_uncertainty for n in names])
    assert np.mean(covered) >= 0.95 - 0.035
    assert np.mean(ratio) < 1.35  # tau is a third of the noise; the blend's is 2.6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"order": "blend", "method": "linearised"}, "order blend needs method norm"),
        ({"order": "blend", "monte_carlo": 1000}, "order blend needs method norm"),
        ({"order": 2, "nonlinearity": (1e-6, 1e-6)}, "nonlinearity needs order auto or blend"),
        ({"nonlinearity": (0.0, 1e-6)}, "expected two standard deviations above 0"),
    ],
)
def test_what_does_not_go_together_is_refused(planned, options, message):
    rng = np.random.default_rng(6)
    with pytest.raises(OptionError, match=message):
        fit(measured(rng, triad(rng), planned), **options)


def test_the_command_takes_order_blend_and_a_spread(imulab, tmp_path):
    imulab("tumble", "simulate", "--order", "1", "--hold", "2 s", "--move", "1 s", "-o", "r.csv")
    narrow = imulab("tumble", "fit", "r.csv", "--gravity", "9.80665", "--nonlinearity", "5ug,5ug", "-o", "a.json")
    assert narrow.returncode == 0, narrow.stderr
    assert json.loads((tmp_path / "a.json").read_text())["options"]["nonlinearity"] == pytest.approx([5e-6, 5e-6])
    whole = imulab("tumble", "fit", "r.csv", "--gravity", "9.80665", "--order", "blend", "-o", "b.json")
    assert whole.returncode == 0, whole.stderr
    assert json.loads((tmp_path / "b.json").read_text())["model"]["order"] == 3
    bad = imulab("tumble", "fit", "r.csv", "--nonlinearity", "5ug", "-o", "c.json")
    assert bad.returncode == 2
    assert "--nonlinearity '5ug': expected two standard deviations" in bad.stderr
    assert not (tmp_path / "c.json").exists()

"""Attitudes that were knocked: set aside and named by default, and nothing changed where there are none."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

import imulab as il
from conftest import table
from imulab.display import Note
from imulab.errors import OptionError
from imulab.procedures.tumble.gyro.fit import fit_gyro_triad
from imulab.procedures.tumble.orders import _best_subset, _extended, _Whitened
from imulab.procedures.views import exhibits_of
from reference import tumble as reference

G = 9.80665
SIGMA = 6e-4  # m/s^2, 60 µg
MG = 9.80665e-3


def tumbled(seed, count=24, order=2, knocks=()):
    """Outputs of a random triad with noise; each knock (attitude, size) lengthens one."""
    rng = np.random.default_rng(seed)
    truth = reference.random_truth(rng, order)
    up = reference.random_attitudes(rng, count)
    data = np.array([reference.forward(G * u, truth, order) for u in up]) + SIGMA * rng.standard_normal((count, 3))
    for index, size in knocks:
        data[index] += size * up[index]
    return truth, data


def fit(data, sigma=SIGMA, **options):
    return il.fit_tumble(il.find_attitudes(table(data, sigma=sigma)), gravity=G, **options)


def same(first, second):
    assert first.parameters == second.parameters
    assert first.covariance == second.covariance


@pytest.mark.parametrize("sigma", [SIGMA, None], ids=["noise-known", "noise-unknown"])
@pytest.mark.parametrize("order", ["auto", 2])
def test_a_knocked_attitude_is_set_aside_and_the_rest_is_fitted_as_if_it_had_not_been(order, sigma):
    truth, data = tumbled(1, knocks=[(7, 5 * MG)])
    found = fit(data, sigma, order=order)
    record = found.calibration
    assert record.fit["set_aside"] == [8]
    assert record.fit["attitudes"] == 23
    assert len(record.data["attitudes"]["residual"]) == 24
    assert found.down_weights.tolist() == [0.0 if i == 7 else 1.0 for i in range(24)]
    assert found.residuals[7] == pytest.approx(5 * MG, rel=0.2)
    named = [w for w in record.warnings if w.startswith("row 8 (line 9) set aside: ")]
    assert len(named) == 1
    assert "--loss square" in named[0]
    assert record.verdict.state == "look"
    same(record, fit(np.delete(data, 7, axis=0), sigma, order=order, loss="square").calibration)
    factor = record.fit["coverage_factor_95"]
    assert (
        np.mean([abs(p.value - truth[n]) < factor * p.standard_uncertainty for n, p in record.parameters.items()]) > 0.8
    )


@pytest.mark.parametrize("sigma", [SIGMA, None], ids=["noise-known", "noise-unknown"])
@pytest.mark.parametrize("order", ["auto", 1])
def test_where_nothing_stands_out_the_result_is_the_plain_one_bit_for_bit(order, sigma):
    _, data = tumbled(2, order=1)
    default, square = (fit(data, sigma, order=order, loss=loss).calibration for loss in ("auto", "square"))
    assert default.fit["set_aside"] == []
    same(default, square)
    assert default.data == square.data


def test_knocks_are_found_and_clean_attitudes_are_left_alone(reduced):
    trials = 14 if reduced else 40
    found, false = 0, 0
    for seed in range(trials):
        rng = np.random.default_rng(1000 + seed)
        which = rng.choice(24, 2, replace=False)
        knocks = [(int(i), float(rng.choice([-1, 1]) * rng.uniform(2, 30) * MG)) for i in which]
        aside = {number - 1 for number in fit(tumbled(seed, knocks=knocks)[1]).calibration.fit["set_aside"]}
        found += len(aside & set(which.tolist()))
        false += bool(fit(tumbled(seed)[1]).calibration.fit["set_aside"])
    assert found >= 0.95 * 2 * trials
    assert false <= trials / 20


def test_many_attitudes_are_searched_without_trying_every_set():
    _, data = tumbled(3, count=90, knocks=[(4, 3 * MG), (40, -2 * MG), (41, 8 * MG), (77, 1.5 * MG)])
    assert fit(data).calibration.fit["set_aside"] == [5, 41, 42, 78]


@pytest.mark.parametrize("m", [1, 2, 3])
def test_the_best_set_is_that_of_solving_for_every_one(m):
    rng = np.random.default_rng(m)
    basis = np.linalg.qr(rng.standard_normal((12, 5)))[0]
    r = rng.standard_normal(12)
    r = r - basis @ (basis.T @ r)
    whole = np.eye(12) - basis @ basis.T
    gains = {}
    for subset in combinations(range(12), m):
        block = whole[np.ix_(subset, subset)]
        if np.linalg.eigvalsh(block)[0] >= 0.02:
            gains[subset] = r[list(subset)] @ np.linalg.solve(block, r[list(subset)])
    best = max(gains, key=gains.get)
    white = _Whitened(r, basis)
    assert tuple(sorted(_best_subset(white, m).tolist())) == best
    greedy = np.empty(0, dtype=np.intp)
    for _ in range(m):
        greedy = _extended(white, greedy)
    assert gains[tuple(sorted(greedy.tolist()))] >= 0.8 * gains[best]


def test_the_demonstrations_recording_gives_the_truth(tmp_path):
    recording = il.simulate_tumble(order=2, gravity=9.81362, knock=7, seed=4)
    record = il.fit_tumble(il.find_attitudes(recording), gravity=9.81362).calibration
    assert record.fit["set_aside"] == [8]
    assert any(w.startswith("attitude 8 (45.1 to 46.7 s) set aside") for w in record.warnings)
    for axis in "xyz":
        bias = record.parameters[f"bias_{axis}"]
        half = record.fit["coverage_factor_95"] * bias.standard_uncertainty
        assert abs(bias.value - float(recording.metadata[f"truth_bias_{axis}"])) < half < 0.2 * MG


def test_the_report_marks_what_was_set_aside():
    record = fit(tumbled(1, knocks=[(7, 5 * MG)])[1]).calibration
    exhibits = exhibits_of(record)
    assert "1 more was set aside" in exhibits.headline
    residuals = exhibits.items[0]
    colours = residuals.traces[1]["marker"]["color"]
    assert [i for i, colour in enumerate(colours) if colour != colours[0]] == [7]
    assert "1 set aside in red, as diamonds" in residuals.caption


def test_a_prior_is_updated_without_the_knocked_attitude():
    truth, factory = tumbled(4, count=40, order=1)
    rng = np.random.default_rng(5)
    up = reference.random_attitudes(rng, 20)
    data = np.array([reference.forward(G * u, truth, 1) for u in up]) + SIGMA * rng.standard_normal((20, 3))
    data[3] += 10 * MG * up[3]
    prior = fit(factory, order=1).calibration
    updated = fit(data, prior=prior).calibration
    assert updated.fit["set_aside"] == [4]
    same(updated, fit(np.delete(data, 3, axis=0), prior=prior, loss="square").calibration)


def test_what_cannot_be_told_is_said():
    _, data = tumbled(6, count=12, order=1)
    few = fit(data, order=1).calibration
    assert any(isinstance(w, Note) and "12 attitudes are too few to tell a knocked one" in w for w in few.warnings)
    some = fit(tumbled(6, count=18)[1]).calibration
    assert any(isinstance(w, Note) and "among only 18 may stay unseen" in w for w in some.warnings)
    linearised = fit(tumbled(6, order=1)[1], order=1, method="linearised").calibration
    assert any("only method norm sets knocked ones aside" in w for w in linearised.warnings)
    assert linearised.fit["set_aside"] == []
    with pytest.raises(OptionError, match="loss huber needs method norm"):
        fit(data, order=1, method="linearised", loss="huber")


def test_turns_beside_an_attitude_that_was_set_aside_are_left_out():
    recording = il.simulate_tumble(order=1, attitudes=30, seed=1)
    attitudes = il.find_attitudes(recording)
    mean = attitudes.mean.copy()
    mean[9] *= 1.01
    knocked = replace(attitudes, mean=mean)
    record = il.fit_tumble(knocked, order=1, gravity=G).calibration
    assert record.fit["set_aside"] == [10]
    clean, found = (fit_gyro_triad(record, held, recording) for held in (attitudes, knocked))
    assert len(found.residuals) == len(clean.residuals) - 2
    assert any("2 turns left out, beside attitudes that the record set aside (10)" in note for note in found.notes)

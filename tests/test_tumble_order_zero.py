"""Order 0: bias and scale factor from six faces, and a record that every other part takes."""

import numpy as np
import pytest

import imulab as il
from conftest import table
from imulab.errors import ObservabilityError, OptionError
from reference import tumble as reference

G = 9.80665
FACES = np.vstack([np.eye(3), -np.eye(3)])
SIGMA = 3e-4


def truth_of(seed):
    truth = reference.random_truth(np.random.default_rng(seed), 1)
    return truth | {name: 0.0 for name in truth if name.startswith("misalignment")}


def attitudes_of(truth, ups=FACES, sigma=SIGMA, seed=1, stated=True):
    rng = np.random.default_rng(seed)
    data = np.array([reference.forward(G * u, truth, 1) for u in ups]) + sigma * rng.standard_normal((len(ups), 3))
    return il.find_attitudes(table(data, "m/s^2", sigma if stated else None))


def test_six_faces_without_noise_give_six_parameters():
    truth = truth_of(1)
    record = il.fit_tumble(attitudes_of(truth, sigma=0.0, stated=False), order=0, gravity=G).calibration
    for name, value in truth.items():
        assert record.value(name) == pytest.approx(value, abs=1e-9), name
        assert record.parameters[name].standard_uncertainty is None
    assert any("leave nothing to estimate the noise from" in w for w in record.warnings)


def test_intervals_cover_and_uncertainties_are_those_of_a_pair_of_faces():
    """b = (M+ + M-) / 2S and S = (M+ - M-) / 2g: sigma / sqrt 2 each, for six faces with noise known."""
    inside = []
    for seed in range(60):
        truth = truth_of(seed)
        record = il.fit_tumble(attitudes_of(truth, seed=seed), order=0, gravity=G, loss="square").calibration
        for name in record.covariance.names:
            found = record.parameters[name]
            unit = 1.0 if name.startswith("bias") else 1 / G
            assert found.standard_uncertainty == pytest.approx(SIGMA * unit / np.sqrt(2), rel=0.1), name
            inside.append(abs(found.value - truth[name]) < 1.96 * found.standard_uncertainty)
    assert len(record.covariance.names) == 6
    assert 0.92 < np.mean(inside) < 0.98


def test_misalignment_is_said_to_be_assumed():
    record = il.fit_tumble(attitudes_of(truth_of(2)), order=0, gravity=G).calibration
    assert record.model["order"] == 0
    assert record.value("misalignment_zy") == 0.0
    assert record.parameters["misalignment_zy"].standard_uncertainty is None
    assert any(w.startswith("order 0 takes every misalignment as 0") for w in record.warnings)
    assert record.fit["degrees_of_freedom"] == 0
    with pytest.raises(ObservabilityError, match="determine 6 of the 9 parameters of order 1"):
        il.fit_tumble(attitudes_of(truth_of(2)), order=1, gravity=G)
    with pytest.raises(ObservabilityError, match="of the 6 parameters of order 0"):
        il.fit_tumble(attitudes_of(truth_of(2), FACES[:5]), order=0, gravity=G)
    with pytest.raises(OptionError, match="order 0 needs method norm"):
        il.fit_tumble(attitudes_of(truth_of(2)), order=0, gravity=G, method="linearised")


def test_many_attitudes_and_trials_and_a_prior_work_too():
    truth = truth_of(3)
    ups = reference.random_attitudes(np.random.default_rng(3), 30)
    record = il.fit_tumble(attitudes_of(truth, ups), order=0, gravity=G, monte_carlo=1000).calibration
    for name, found in record.fit["monte_carlo"]["parameters"].items():
        expected = record.parameters[name].standard_uncertainty
        assert found["standard_deviation"] == pytest.approx(expected, rel=0.15), name
    updated = il.fit_tumble(attitudes_of(truth, FACES, seed=4), prior=record, gravity=G).calibration
    assert updated.model["order"] == 0
    for name in record.covariance.names:
        assert abs(updated.value(name) - truth[name]) < 4 * updated.parameters[name].standard_uncertainty


def test_the_record_goes_through_every_command(imulab, tmp_path):
    truth = truth_of(4)
    outputs = np.array([reference.forward(G * u, truth, 1) for u in FACES])
    noisy = outputs + SIGMA * np.random.default_rng(1).standard_normal((6, 3))
    il.write_csv(table(noisy, "m/s^2", SIGMA), tmp_path / "six.csv")
    done = imulab("tumble", "fit", "six.csv", "--gravity", G, "--order", "0", "-o", "six.json", "--report", "six.html")
    assert done.returncode == 0, done.stderr
    assert imulab("show", "six.json").returncode == 0
    assert imulab("tumble", "check", "six.json", "six.csv").returncode == 0
    applied = imulab("apply", "six.json", "six.csv", "-o", "out.csv")
    assert applied.returncode == 0, applied.stderr
    np.testing.assert_allclose(il.read(tmp_path / "out.csv").triad("accel"), G * FACES, atol=5 * SIGMA)
    for target in ("c", "blob", "px4", "ardupilot", "kalibr", "openvins", "ros"):
        exported = imulab("export", "--to", target, "six.json", "-o", target)
        assert exported.returncode == 0, (target, exported.stderr)
    (tmp_path / "m.csv").write_text(f"serial,procedure,file,gravity,order\nA,tumble,six.csv,{G},0\n")
    assert imulab("fleet", "run", "m.csv", "-o", "fleet").returncode == 0
    assert imulab("fleet", "report", "fleet", "-o", "fleet.html").returncode == 0
    one, other = il.load(tmp_path / "six.json"), il.load(tmp_path / "fleet" / "A.json")
    assert {n: p.value for n, p in one.parameters.items()} == {n: p.value for n, p in other.parameters.items()}

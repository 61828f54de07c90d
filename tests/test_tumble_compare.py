"""Records checked by fresh attitudes, and compared with each other."""

import json
import re

import numpy as np
import pytest
from scipy import stats

import imulab as il
from conftest import sap5_table, table
from imulab.changes import compare_records
from imulab.errors import RecordError, UnitError
from imulab.tumble.compare import check_tumble
from reference import tumble as reference

G = 9.80665


def fitted(truth, order=1, seed=0, sigma=1e-3, stated=None, unit="m/s^2", count=30):
    rng = np.random.default_rng(seed)
    data = np.array([reference.forward(G * u, truth, order) for u in reference.random_attitudes(rng, count)])
    attitudes = il.find_attitudes(table(data + sigma * rng.standard_normal(data.shape), unit, stated))
    return il.fit_tumble(attitudes, order=order, gravity=G).calibration, attitudes


@pytest.fixture(scope="module")
def truth():
    return reference.random_truth(np.random.default_rng(1), 1)


def test_residuals_of_a_check_are_those_of_the_transcribed_inverse(truth):
    record, _ = fitted(truth, 1)
    _, fresh = fitted(truth, 1, seed=5)
    found = check_tumble(record, fresh, limit=1.0).residuals
    values = {name: p.value for name, p in record.parameters.items()}
    np.testing.assert_allclose(found, reference.residual(fresh.mean, values, 1, G), atol=1e-12)


def test_a_check_passes_until_something_changed(truth):
    record, _ = fitted(truth, 1)
    _, fresh = fitted(truth, 1, seed=6)
    assert check_tumble(record, fresh, limit=5e-3).passed
    _, shifted = fitted(truth | {"bias_x": truth["bias_x"] + 0.05}, 1, seed=6)
    check = check_tumble(record, shifted, limit=5e-3)
    assert not check.passed
    assert abs(check.residuals[check.worst]) == np.abs(check.residuals).max() > 0.03


def test_a_check_elsewhere_uses_the_gravity_of_that_place(truth):
    record, _ = fitted(truth, 1)
    _, fresh = fitted(truth, 1, seed=6)
    assert check_tumble(record, fresh, limit=1.0, gravity=G + 0.02).residuals.mean() == pytest.approx(-0.02, abs=1e-3)


def test_a_check_needs_the_unit_of_the_record(truth):
    record, _ = fitted(truth, 1)
    counts = il.find_attitudes(table(np.eye(3)[[0, 1, 2] * 3] * 4096.0, "count"))
    with pytest.raises(UnitError, match=r"are in count, but the record calibrates outputs in m/s\^2"):
        check_tumble(record, counts, limit=1.0)


def test_no_change_is_claimed_where_nothing_changed(noise_as_stated, truth):
    """One false claim in twenty comparisons, and the joint probability uniform."""
    claims, probabilities = 0, []
    for seed in range(200):
        a, _ = fitted(truth, 1, seed=2 * seed, stated=1e-3)
        b, _ = fitted(truth, 1, seed=2 * seed + 1, stated=1e-3)
        comparison = compare_records(a, b)
        claims += any(change.significant for change in comparison.changes)
        probabilities.append(comparison.probability)
    assert claims <= stats.binom.ppf(0.999, 200, 0.05)
    assert stats.kstest(probabilities, "uniform").pvalue > 1e-3


def test_what_changed_is_named_with_its_size(truth):
    a, _ = fitted(truth, 1, seed=1)
    b, _ = fitted(truth | {"bias_y": truth["bias_y"] + 0.02}, 1, seed=2)
    comparison = compare_records(a, b)
    (changed,) = [change for change in comparison.changes if change.significant]
    assert changed.name == "bias_y"
    assert changed.difference == pytest.approx(0.02, abs=4 * changed.standard_uncertainty)
    assert changed.deviations > 10
    assert comparison.probability < 1e-6


def test_records_that_cannot_be_compared_are_refused(truth):
    a, _ = fitted(truth, 1, seed=1)
    other, _ = fitted(reference.random_truth(np.random.default_rng(3), 1, scale=0.1), 1, unit="g")
    bare, _ = fitted(truth, 1, count=9)
    with pytest.raises(RecordError, match=r"different output units: m/s\^2 and g"):
        compare_records(a, other)
    with pytest.raises(RecordError, match="without uncertainties"):
        compare_records(a, bare)


def test_sap5_the_same_instrument_twice_shows_no_change_of_k2(real_data):
    records = [
        il.fit_tumble(
            il.find_attitudes(table(sap5_table(real_data / "sap5" / f"{name}.json"), "g")), order=2, gravity=G
        ).calibration
        for name in ("hj", "hj2")
    ]
    changes = {change.name: change for change in compare_records(*records).changes}
    for axis in "xyz":
        assert not changes[f"k2_{axis}"].significant
        assert abs(changes[f"k2_{axis}"].deviations) < 3


def test_the_commands(imulab, tmp_path):
    for name, seed in (("a", "1"), ("b", "1")):
        imulab("tumble", "simulate", "-o", f"{name}.csv", "--seed", seed, "--attitudes", "20", "--order", "1")
        imulab("tumble", "fit", f"{name}.csv", "--gravity", str(G), "--order", "1", "-o", f"{name}.json")
    done = imulab("tumble", "check", "a.json", "b.csv")
    assert done.returncode == 0, done.stderr
    assert re.search(r"^pass: 20 attitudes, largest \|f\| - g -?\d+", done.stdout, re.MULTILINE)
    strict = imulab("tumble", "check", "a.json", "b.csv", "--limit", "1ug")
    assert strict.returncode == 1
    assert "fail: 20 attitudes" in strict.stdout
    assert "beyond the limit" in strict.stdout
    assert imulab("tumble", "check", "a.json", "b.csv", "--limit", "soft").returncode == 2
    shown = imulab("show", "a.json", "b.json")
    assert shown.stdout.startswith("b.json less a.json: no significant change")
    assert len(json.loads(imulab("show", "a.json", "b.json", "--json").stdout)["changes"]) == 9
    assert imulab("show", "a.json", "b.csv").returncode == 2
    assert imulab("show", "a.json", "b.json", "a.json").returncode == 2


def test_a_check_refuses_what_it_cannot_judge_and_names_another_unit(imulab, tmp_path):
    for seed in ("1", "2"):
        imulab("tumble", "simulate", "-o", f"{seed}.csv", "--order", "1", "--attitudes", "12", "--seed", seed)
    imulab("tumble", "fit", "1.csv", "--gravity", "9.80665", "--order", "1", "-o", "1.json")
    text = (tmp_path / "1.csv").read_text()
    (tmp_path / "wrong.csv").write_text(re.sub(r"(accel_[xyz]) \[m/s\^2\]", r"\1 [g]", text))
    for arguments, fragment in (
        (["1.csv", "--limit", "-1mg"], "limit -0.00980665 m/s^2: expected more than 0"),
        (["1.csv", "--limit", "0"], "limit 0 m/s^2: expected more than 0"),
        (["1.csv", "--gravity", "981"], "gravity 981: expected the local value in m/s^2"),
        (["1.csv", "--gravity", "-9.8"], "gravity -9.8: expected the local value in m/s^2"),
        (["wrong.csv"], "wrong.csv: columns accel_x accel_y accel_z: the specific force at rest is about 9"),
    ):
        refused = imulab("tumble", "check", "1.json", *arguments)
        assert refused.returncode == 2, (arguments, refused.stdout)
        assert refused.stderr.startswith(f"imulab: {fragment}")
        assert refused.stderr.count("\n") == 1
        assert not refused.stdout
    other = imulab("tumble", "check", "1.json", "2.csv")
    assert other.returncode == 1
    assert "2.csv: serial SIM-0002, but the record was made for SIM-0001" in other.stderr

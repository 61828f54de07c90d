"""Records checked by fresh attitudes, and compared with each other."""

import json
import re

import numpy as np
import pytest
from scipy import stats

import imulab as il
from conftest import sap5_table, table
from imulab.errors import RecordError, UnitError
from imulab.procedures.tumble.check import check_tumble
from imulab.procedures.views import compare_records
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
    found = check_tumble(record, fresh).residuals
    values = {name: p.value for name, p in record.parameters.items()}
    np.testing.assert_allclose(found, reference.residual(fresh.mean, values, 1, G), atol=1e-12)


def test_a_check_passes_until_something_changed(truth):
    record, _ = fitted(truth, 1)
    _, fresh = fitted(truth, 1, seed=6)
    assert check_tumble(record, fresh, limit=5e-3).passed
    _, shifted = fitted(truth | {"bias_x": truth["bias_x"] + 0.05}, 1, seed=6)
    check = check_tumble(record, shifted)
    assert not check.passed
    assert check.probability < 1e-6
    assert not check_tumble(record, fresh, limit=1e-4).passed
    assert abs(check.residuals[check.worst]) == np.abs(check.residuals).max() > 0.03


def test_a_check_elsewhere_uses_the_gravity_of_that_place(truth):
    record, _ = fitted(truth, 1)
    _, fresh = fitted(truth, 1, seed=6)
    assert check_tumble(record, fresh, limit=1.0, gravity=G + 0.02).residuals.mean() == pytest.approx(-0.02, abs=1e-3)


G_KNOWN, RECORD_NOISE, NOISE = 24, 20e-6 * G, 60e-6 * G


def alarms(change, count, trials, stated=True, record_stated=True):
    """Share of trials in which attitudes of a unit that has changed fail."""
    found = []
    for seed in range(trials):
        rng = np.random.default_rng([seed, count])
        truth = reference.random_truth(rng, 1)
        record, _ = fitted(truth, 1, 3 * seed, RECORD_NOISE, RECORD_NOISE if record_stated else None, count=G_KNOWN)
        noise = NOISE if record_stated else RECORD_NOISE
        new = truth | {name: truth[name] + size * rng.choice([-1, 1]) for name, size in change.items()}
        ups = reference.random_attitudes(rng, count)
        data = np.array([reference.forward(G * u, new, 1) for u in ups]) + noise * rng.standard_normal((count, 3))
        found.append(
            not check_tumble(record, il.find_attitudes(table(data, "m/s^2", noise if stated else None))).passed
        )
    return float(np.mean(found))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("count", "stated", "record_stated"), [(4, True, True), (12, True, True), (12, False, False), (24, True, True)]
)
def test_a_record_that_holds_fails_once_in_twenty(count, stated, record_stated, reduced):
    trials = 60 if reduced else 200
    share = alarms({}, count, trials, stated, record_stated)
    low, high = stats.binom.ppf([0.001, 0.999], trials, 0.05) / trials
    assert low <= share <= high


@pytest.mark.slow
@pytest.mark.parametrize(("count", "least"), [(4, 0.70), (12, 0.97)])
def test_a_tenth_of_a_milligram_is_found(count, least, reduced):
    """All three biases moved by 100 µg, the noise 60 µg in an attitude; the figures are the method's."""
    trials = 40 if reduced else 100
    share = alarms({f"bias_{axis}": 1e-4 * G for axis in "xyz"}, count, trials)
    assert share >= stats.binom.ppf(0.001, trials, least) / trials


def test_a_check_without_noise_takes_that_of_the_record_and_says_so(truth):
    record, _ = fitted(truth, 1, seed=1, stated=1e-3)
    _, fresh = fitted(truth, 1, seed=2)
    check = check_tumble(record, fresh)
    assert check.passed
    (said,) = [
        note for note in check.notes if note.startswith("nothing is known of the noise of these attitudes: the ")
    ]
    assert float(said.split("the ")[2].split(" µg")[0]) == pytest.approx(1e6 * 1e-3 / G, rel=0.1)


def test_disturbed_holds_are_no_change_of_the_unit(truth, reduced):
    """Attitudes that scatter ten times more than they say fail by that alone once in twenty."""
    trials = 20 if reduced else 60
    failed = 0
    for seed in range(trials):
        record, _ = fitted(truth, 1, seed=2 * seed, sigma=1e-4, stated=1e-4)
        _, fresh = fitted(truth, 1, seed=2 * seed + 1, sigma=1e-3, stated=1e-4)
        check = check_tumble(record, fresh)
        failed += not check.passed
        assert any("scatter by" in note for note in check.notes)
    assert failed <= stats.binom.ppf(0.999, trials, 0.1)


def test_a_record_without_uncertainties_needs_a_limit(imulab, tmp_path, truth):
    bare, attitudes = fitted(truth, 1, count=9)
    with pytest.raises(RecordError, match="states no uncertainties to test against; expected a fixed limit"):
        check_tumble(bare, attitudes)
    assert check_tumble(bare, attitudes, limit=1.0).probability is None
    assert check_tumble(bare, attitudes, limit=1.0).passed


def test_gravity_of_another_place_is_part_of_the_test(truth):
    """A record made under a gravity off by 1 mg: found where that is not known, and where it is known, not."""
    rng = np.random.default_rng(5)
    data = np.array([reference.forward((G + 0.01) * u, truth, 1) for u in reference.random_attitudes(rng, 60)])
    attitudes = il.find_attitudes(table(data + 1e-3 * rng.standard_normal(data.shape), "m/s^2", 1e-3))
    first, second = attitudes_of_half(attitudes, slice(0, 30)), attitudes_of_half(attitudes, slice(30, 60))
    for stated, here, passes in (
        (f"{G}+-0", G + 0.01, False),
        (f"{G}+-0.01", G + 0.01, True),
        (f"{G}+-0", f"{G + 0.01}+-0.01", True),
        (f"{G}+-0.01", f"{G}+-0.01", True),
        (f"{G}+-0.01", None, True),
    ):
        record = il.fit_tumble(first, order=1, gravity=stated).calibration
        assert check_tumble(record, second, gravity=here).passed == passes, (stated, here)


def attitudes_of_half(attitudes, rows):
    columns = {n: v[rows] for n, v in attitudes.recording.columns.items()}
    return il.find_attitudes(il.Recording(columns, attitudes.recording.units, name="half.csv"))


def test_a_check_needs_the_unit_of_the_record(truth):
    record, _ = fitted(truth, 1)
    counts = il.find_attitudes(table(np.eye(3)[[0, 1, 2] * 3] * 4096.0, "count"))
    with pytest.raises(UnitError, match=r"are in count, but the record calibrates outputs in m/s\^2"):
        check_tumble(record, counts, limit=1.0)


@pytest.mark.slow
def test_no_change_is_claimed_where_nothing_changed(noise_as_stated, truth, reduced):
    """One false claim in twenty comparisons, and the joint probability uniform."""
    trials = 70 if reduced else 200
    claims, probabilities = 0, []
    for seed in range(trials):
        a, _ = fitted(truth, 1, seed=2 * seed, stated=1e-3)
        b, _ = fitted(truth, 1, seed=2 * seed + 1, stated=1e-3)
        comparison = compare_records(a, b)
        claims += any(change.significant for change in comparison.changes)
        probabilities.append(comparison.probability)
    assert claims <= stats.binom.ppf(0.999, trials, 0.05)
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
    first, second, *_ = done.stdout.splitlines()
    assert first == "pass: the attitudes agree with the record"
    assert re.match(r"p = [\d.]+ \(chi-square [\d.]+ of 20\), 20 attitudes, largest \|f\| - g -?\d+", second)
    assert "the record was made from this recording" in imulab("tumble", "check", "a.json", "a.csv").stderr
    strict = imulab("tumble", "check", "a.json", "b.csv", "--limit", "1ug")
    assert strict.returncode == 1
    assert strict.stdout.startswith("fail: no change of the unit is shown, but an attitude is beyond the limit\n")
    assert "the limit is smaller than the uncertainty of the attitudes can tell" in strict.stdout
    told = json.loads(imulab("tumble", "check", "a.json", "b.csv", "--limit", "1ug", "--json").stdout)
    assert told["verdict"] == "fail"
    assert told["p"] > 0.05
    assert told["limit"] == {"value": pytest.approx(9.80665e-6), "unit": "m/s^2"}
    assert next(row["label"] for row in told["attitudes"]).startswith("attitude 1 (")
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

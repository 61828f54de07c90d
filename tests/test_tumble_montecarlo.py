"""Propagation of distributions against the bound, Student's t, and the linear intervals."""

import numpy as np
import pytest
from scipy import stats

import imulab as il
from conftest import table
from imulab.errors import OptionError
from reference import tumble as reference

G = 9.80665


def problem(order, count, sigma, seed=1):
    rng = np.random.default_rng(seed)
    truth = reference.random_truth(rng, order)
    directions = reference.random_attitudes(rng, count)
    data = np.array([reference.forward(G * u, truth, order) for u in directions])
    return truth, directions, data + sigma * rng.standard_normal(data.shape)


def propagated(data, order, trials, **options):
    stated = options.pop("stated", None)
    attitudes = il.find_attitudes(table(data, sigma=stated))
    return il.fit_tumble(attitudes, order=order, gravity=G, monte_carlo=trials, **options).calibration


@pytest.mark.parametrize("order", [1, 2, 4])
def test_trials_scatter_as_the_bound_says_where_noise_is_known(order, noise_as_stated):
    sigma = 1e-4
    truth, directions, data = problem(order, 36, sigma)
    found = propagated(data, order, 20_000, stated=sigma).fit["monte_carlo"]
    bound = np.sqrt(np.diag(reference.bound(directions, truth, order, G, np.full((36, 3), sigma))))
    assert (found["trials"], found["failed"]) == (20_000, 0)
    for name, limit in zip(truth, bound, strict=True):
        entry = found["parameters"][name]
        # The standard deviation of 20,000 trials is known to 0.5 %, one standard deviation.
        assert entry["standard_deviation"] == pytest.approx(limit, rel=0.025), name
        low, high = entry["interval_95"]
        assert (high - low) / (2 * 1.959964) == pytest.approx(limit, rel=0.03), name
        assert entry["mean"] == pytest.approx(truth[name], abs=5 * limit), name


def test_an_estimated_noise_gives_students_t():
    _, _, data = problem(1, 14, 1e-4)
    record = propagated(data, 1, 40_000)
    assert record.fit["degrees_of_freedom"] == 5
    for name, parameter in record.parameters.items():
        low, high = record.fit["monte_carlo"]["parameters"][name]["interval_95"]
        linear = 2 * stats.t.ppf(0.975, 5) * parameter.standard_uncertainty
        assert (high - low) / linear == pytest.approx(1.0, abs=0.03), name


def test_an_excess_is_propagated_as_well():
    _, _, data = problem(1, 40, 1e-3)
    record = propagated(data, 1, 20_000, stated=1e-4)
    assert record.fit["excess"]["value"] > 0
    for name, parameter in record.parameters.items():
        deviation = record.fit["monte_carlo"]["parameters"][name]["standard_deviation"]
        t = np.sqrt(31 / 29)  # standard deviation of Student's t with 31 degrees of freedom
        assert deviation == pytest.approx(t * parameter.standard_uncertainty, rel=0.04), name


def test_the_same_seed_gives_the_same_trials_and_progress_is_told():
    _, _, data = problem(1, 20, 1e-4)
    attitudes = il.find_attitudes(table(data))
    told: list[int] = []
    fits = [
        il.fit_tumble(attitudes, order=1, gravity=G, monte_carlo=5000, progress=told.append).calibration
        for _ in range(2)
    ]
    assert fits[0].fit["monte_carlo"] == fits[1].fit["monte_carlo"]
    assert told == [2000, 4000, 5000] * 2
    assert fits[0].options["monte_carlo"] == 5000


@pytest.mark.parametrize(
    ("options", "count", "message"),
    [
        ({"trials": 10}, 20, "monte-carlo 10: expected 1000 to 10000000 trials"),
        ({"trials": 1000, "method": "linearised"}, 20, "needs method norm"),
        ({"trials": 1000}, 9, "more attitudes than parameters"),
    ],
)
def test_trials_that_cannot_be_are_refused(options, count, message):
    _, _, data = problem(1, count, 1e-4)
    with pytest.raises(OptionError, match=message):
        propagated(data, 1, **options)


def test_the_command_and_its_report(imulab, tmp_path):
    imulab("tumble", "simulate", "-o", "t.csv", "--attitudes", "16", "--hold", "2", "--order", "1")
    done = imulab(
        "tumble",
        "fit",
        "t.csv",
        "--gravity",
        str(G),
        "--order",
        "1",
        "--monte-carlo",
        "2000",
        "-o",
        "t.json",
        "--report",
        "t.html",
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""  # no progress bar where standard error is no terminal
    assert "Monte Carlo" in done.stdout
    assert "ratio of widths" in (tmp_path / "t.html").read_text()
    refused = imulab("tumble", "fit", "t.csv", "--gravity", str(G), "--monte-carlo", "many", "-o", "u.json")
    assert refused.returncode == 2
    assert refused.stderr == "imulab: --monte-carlo 'many': expected a whole number\n"
    assert not (tmp_path / "u.json").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--monte-carlo", "0"], "monte-carlo 0: expected 1000 to 10000000 trials"),
        (["--monte-carlo", "2000", "--method", "linearised"], "monte-carlo needs method norm, found method linearised"),
        (["--monte-carlo", "2000", "--prior", "p.json"], "monte-carlo draws the attitudes anew, not a prior"),
    ],
)
def test_trials_that_cannot_be_are_refused_before_the_recording_is_read(imulab, options, words):
    refused = imulab("tumble", "fit", "there_is_no_such_file.csv", *options)
    assert refused.returncode == 2
    assert words in refused.stderr

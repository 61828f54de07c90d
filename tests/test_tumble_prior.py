"""Priors: a record that still holds and a field check are worth both in one fit; one that aged counts for less."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

import imulab as il
from conftest import table
from imulab.errors import OptionError, RecordError
from imulab.records.calibration import Covariance
from reference import tumble as reference

G = 9.80665
SIGMA = 2e-4
NONE = (0.0, 0.0, 0.0)


def attitudes_of(truth, order, count, seed, sigma=SIGMA, unit="m/s^2", stated=True):
    rng = np.random.default_rng(seed)
    data = np.array([reference.forward(G * u, truth, order) for u in reference.random_attitudes(rng, count)])
    return table(data + sigma * rng.standard_normal(data.shape), unit, sigma if stated else None)


def fit(recording, order=1, **options):
    return il.fit_tumble(il.find_attitudes(recording), order=order, gravity=G, **options).calibration


def joined(first, second):
    columns = {n: np.concatenate([first.columns[n], second.columns[n]]) for n in first.columns}
    return replace(first, columns=columns)


@pytest.mark.parametrize(("order", "few"), [(1, 30), (1, 5), (2, 30), (2, 7)])
def test_prior_and_data_equal_one_fit_of_everything(order, few, noise_as_stated):
    truth = reference.random_truth(np.random.default_rng(order), order)
    factory, field = (attitudes_of(truth, order, n, seed) for n, seed in ((40, 1), (few, 2)))
    updated = fit(field, order, prior=fit(factory, order), ageing=NONE)
    together = fit(joined(factory, field), order)
    for name, parameter in together.parameters.items():
        found = updated.parameters[name]
        assert found.value == pytest.approx(parameter.value, abs=0.02 * parameter.standard_uncertainty), name
        assert found.standard_uncertainty == pytest.approx(parameter.standard_uncertainty, rel=0.01), name
    size = np.sqrt(np.outer(*[np.diag(together.covariance.array())] * 2))
    np.testing.assert_allclose(updated.covariance.array() / size, together.covariance.array() / size, atol=0.02)


def test_a_vague_prior_changes_nothing_and_a_sharp_one_everything():
    truth = reference.random_truth(np.random.default_rng(3), 1)
    record, field = fit(attitudes_of(truth, 1, 30, 1)), attitudes_of(truth, 1, 30, 2)
    alone = fit(field)
    matrix = record.covariance.array()
    for factor, expected, share in ((1e6, alone, 0.0), (1e-6, record, 1.0)):
        scaled = replace(
            record, covariance=Covariance(record.covariance.names, tuple(map(tuple, (matrix * factor).tolist())))
        )
        updated = fit(field, prior=scaled, ageing=NONE)
        for name, parameter in expected.parameters.items():
            assert updated.value(name) == pytest.approx(parameter.value, abs=0.02 * parameter.standard_uncertainty), (
                name
            )
            assert updated.fit["prior"]["shares"][name] == pytest.approx(share, abs=1e-3), name


def test_shares_say_what_few_attitudes_cannot_tell(noise_as_stated):
    """Six faces of a cube say nothing of misalignment, and much of bias and scale factor.

    With a prior that does not tie misalignment to them, that is: else they do so through it.
    """
    truth = {n: (1.0 if n[0] == "s" else 0.0) for n in reference.names(1)}
    record = fit(attitudes_of(truth, 1, 12, 1))
    variances = np.diag(np.diag(record.covariance.array()))
    record = replace(record, covariance=Covariance(record.covariance.names, tuple(map(tuple, variances.tolist()))))
    rng = np.random.default_rng(2)
    faces = table(G * np.vstack([np.eye(3), -np.eye(3)]) + SIGMA * rng.standard_normal((6, 3)), sigma=SIGMA)
    shares = fit(faces, prior=record, ageing=NONE).fit["prior"]["shares"]
    assert min(shares[f"misalignment_{p}"] for p in ("yx", "zx", "zy")) > 0.95
    # all of them against the variances of (P + J' J / sigma^2)^-1 with derivatives of the transcribed residual
    values = {name: p.value for name, p in record.parameters.items()}
    jacobian = np.column_stack(
        [
            (
                reference.residual(faces.triad("accel"), values | {n: values[n] + 1e-6}, 1, G)
                - reference.residual(faces.triad("accel"), values | {n: values[n] - 1e-6}, 1, G)
            )
            / 2e-6
            for n in values
        ]
    )
    precision = np.linalg.inv(record.covariance.array())
    posterior = np.linalg.inv(precision + jacobian.T @ jacobian / SIGMA**2)
    expected = np.diag(posterior) / np.diag(record.covariance.array())
    np.testing.assert_allclose(list(shares.values()), expected, atol=0.01)


@pytest.mark.parametrize("unit", ["m/s^2", "count"])
def test_shares_are_shares_whatever_the_zero(unit):
    """With three attitudes, and a bias of 8 g in counts as some units have it, none is above 1 or below 0."""
    truth = reference.random_truth(np.random.default_rng(3), 2)
    if unit == "count":
        truth |= {f"scale_factor_{a}": 400.0 for a in "xyz"} | {f"bias_{a}": 80.0 for a in "xyz"}
    sigma = SIGMA * truth["scale_factor_x"]
    record = fit(attitudes_of(truth, 2, 24, 1, sigma, unit), 2)
    for few in (3, 6):
        updated = fit(attitudes_of(truth, 2, few, 2, sigma, unit), 2, prior=record, ageing=NONE)
        shares = updated.fit["prior"]["shares"]
        assert min(shares.values()) > 0
        assert max(shares.values()) <= 1
        for name, share in shares.items():
            ratio = updated.parameters[name].standard_uncertainty / record.parameters[name].standard_uncertainty
            assert share == pytest.approx(ratio**2)


def test_a_prior_of_a_unit_that_changed_shows():
    truth = reference.random_truth(np.random.default_rng(4), 1)
    record = fit(attitudes_of(truth, 1, 30, 1))
    moved = truth | {"bias_x": truth["bias_x"] + 0.05}
    for few in (8, 20):
        updated = fit(attitudes_of(moved, 1, few, 2), prior=record)
        (said,) = [w for w in updated.warnings if w.startswith("prior and attitudes contradict each other")]
        assert ("with 8 attitudes" in said) == (few == 8)
        assert updated.fit["prior"]["probability"] < 1e-6
        bias = updated.parameters["bias_x"]
        assert abs(bias.value - moved["bias_x"]) < 3 * bias.standard_uncertainty < 0.005
    same = fit(attitudes_of(truth, 1, 8, 2), prior=record)
    assert not any("contradict" in w for w in same.warnings)


def mixture(residual, jacobian, noise, known, sigma):
    """Mean and covariance of theta - mu over 12^3 steps of what aged, each by the formulas of Kalman, one by one."""
    steps = sigma * np.geomspace(0.05, 50, 12)
    logs, means, covariances = [], [], []
    for tau in product(steps, repeat=3):
        widened = known + np.diag(np.repeat(np.square(tau), 3))
        total = jacobian @ widened @ jacobian.T + noise
        gain = widened @ jacobian.T @ np.linalg.inv(total)
        prior = sum(np.log(t) - np.log(1 + (t / (2 * sigma)) ** 2) for t in tau)
        fit = -0.5 * (np.linalg.slogdet(total)[1] + residual @ np.linalg.solve(total, residual))
        logs.append(prior + fit)
        means.append(gain @ residual)
        covariances.append(widened - gain @ jacobian @ widened)
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    mean = weights @ np.array(means)
    apart = np.array(means) - mean
    return mean, np.einsum("k,kij->ij", weights, np.array(covariances)) + (apart.T * weights) @ apart


@pytest.mark.parametrize("few", [5, 14])
def test_what_aged_is_weighed_by_how_probable_it_makes_the_attitudes(few):
    """A nearly perfect unit, so that the transcribed residual is linear; bias_x has changed by 300 µg."""
    truth = {n: (1.0 if n[0] == "s" else 0.0) for n in reference.names(1)}
    record = fit(attitudes_of(truth, 1, 24, 1))
    moved = truth | {"bias_x": 3e-4 * G}
    field = attitudes_of(moved, 1, few, 2)
    updated = fit(field, prior=record)
    values = {name: p.value for name, p in record.parameters.items()}
    outputs = field.triad("accel")
    step = {name: 1e-6 * (G if name[0] == "b" else 1.0) for name in values}
    jacobian = np.column_stack(
        [
            (
                reference.residual(outputs, values | {n: values[n] + step[n]}, 1, G)
                - reference.residual(outputs, values | {n: values[n] - step[n]}, 1, G)
            )
            / 2e-6
            / G
            for n in values
        ]
    )
    scale = np.array([G] * 3 + [1.0] * 6)
    known = record.covariance.array() / np.outer(scale, scale)
    residual = -(reference.residual(outputs, values, 1, G) / G - (SIGMA / G) ** 2)
    noise = np.eye(few) * ((SIGMA / G) ** 2 + (updated.fit["excess"]["value"] / G) ** 2)
    mean, covariance = mixture(residual, jacobian, noise, known, float(np.sqrt(noise[0, 0])))
    for i, name in enumerate(values):
        sigma = np.sqrt(covariance[i, i]) * scale[i]
        assert updated.parameters[name].standard_uncertainty == pytest.approx(sigma, rel=2e-3), name
        assert updated.value(name) == pytest.approx(values[name] + mean[i] * scale[i], abs=0.02 * sigma), name


@pytest.mark.slow
@pytest.mark.parametrize("moved", ["nothing", "bias", "scale_factor"])
def test_intervals_cover_what_aged(moved, reduced):
    """12 attitudes by hand, noise 60 µg, a record of 20 µg; without ageing a changed group is hardly covered."""
    trials = 20 if reduced else 40
    size = {"nothing": 0.0, "bias": 1.5e-4 * G, "scale_factor": 2.5e-4}[moved]
    inside = []
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        truth = reference.random_truth(rng, 1)
        record = fit(attitudes_of(truth, 1, 24, 1000 + seed, 20e-6 * G))
        new = truth | {
            f"{moved}_{a}": truth[f"{moved}_{a}"] + size * rng.choice([-1, 1]) for a in "xyz" if moved != "nothing"
        }
        updated = fit(attitudes_of(new, 1, 12, 2000 + seed, 60e-6 * G), prior=record)
        inside += [
            abs(p.value - new[name]) < updated.fit["coverage_factor_95"] * p.standard_uncertainty
            for name, p in updated.parameters.items()
            if moved == "nothing" or name.startswith(moved)
        ]
    # The document's 92 to 96 % of a changed group, three axes of a trial taken as one and a half independent ones.
    assert np.mean(inside) > 0.92 - 2 * np.sqrt(0.92 * 0.08 / (1.5 * trials))


def test_the_same_place_is_one_place_for_prior_and_attitudes():
    """Gravity's error is common to both, or each has its own: then the better known of the two decides."""
    truth = reference.random_truth(np.random.default_rng(11), 1)
    stated = {u: f"{G}+-{u}" for u in (0.0, 0.02)}

    def made(count, seed, u, **options):
        found = il.find_attitudes(attitudes_of(truth, 1, count, seed))
        return il.fit_tumble(found, order=1, gravity=stated[u], **options).calibration

    share = {
        (a, b): made(20, 2, b, prior=made(40, 1, a), ageing=NONE).parameters["scale_factor_x"].standard_uncertainty
        for a in stated
        for b in stated
    }
    common = 0.02 / G * truth["scale_factor_x"]
    assert share[0.02, 0.02] == pytest.approx(np.hypot(share[0.0, 0.0], common), rel=0.01)
    assert share[0.0, 0.02] < 0.1 * common
    assert share[0.02, 0.0] < 0.1 * common
    exact = made(40, 1, 0.0)
    assert share[0.0, 0.02] < exact.parameters["scale_factor_x"].standard_uncertainty


def test_the_order_is_that_of_the_prior():
    truth = reference.random_truth(np.random.default_rng(5), 2)
    record = fit(attitudes_of(truth, 2, 40, 1), 2)
    assert fit(attitudes_of(truth, 2, 8, 2), "auto", prior=record).model["order"] == 2
    with pytest.raises(OptionError, match="order 1 with a prior of order 2"):
        fit(attitudes_of(truth, 2, 20, 2), 1, prior=record)


@pytest.mark.parametrize(
    ("options", "field", "error", "message"),
    [
        ({"method": "linearised"}, {}, OptionError, "a prior needs method norm and loss square"),
        ({"loss": "huber"}, {}, OptionError, "a prior needs method norm and loss square"),
        ({"monte_carlo": 1000}, {}, OptionError, "monte-carlo draws the attitudes anew, not a prior"),
        ({}, {"stated": False}, OptionError, ": a prior needs the noise of the attitudes"),
        ({}, {"unit": "V"}, RecordError, r"the prior has outputs in m/s\^2, the recording in V"),
    ],
)
def test_what_does_not_go_with_a_prior_is_refused(options, field, error, message):
    truth = reference.random_truth(np.random.default_rng(6), 1)
    record = fit(attitudes_of(truth, 1, 30, 1))
    with pytest.raises(error, match=message):
        fit(attitudes_of(truth, 1, 20, 2, **field), prior=record, **options)


def test_a_prior_without_uncertainties_is_refused():
    truth = reference.random_truth(np.random.default_rng(7), 1)
    bare = fit(attitudes_of(truth, 1, 9, 1, stated=False))
    with pytest.raises(OptionError, match="expected a tumble record that states uncertainties"):
        fit(attitudes_of(truth, 1, 20, 2), prior=bare)


def bad_priors():
    """What is wrong with a record, as a prior, and what is said."""
    truth = reference.random_truth(np.random.default_rng(8), 1)
    good = fit(attitudes_of(truth, 1, 24, 1))
    names, matrix = good.covariance.names, good.covariance.array()

    def with_covariance(changed, kept=None):
        return replace(good, covariance=Covariance(names[:kept], tuple(map(tuple, changed[:kept, :kept].tolist()))))

    certain, indefinite = matrix.copy(), matrix.copy()
    certain[4], certain[:, 4] = 0.0, 0.0
    indefinite[0, 1] = indefinite[1, 0] = 5 * np.sqrt(matrix[0, 0] * matrix[1, 1])
    yield good, with_covariance(certain), "scale_factor_y has the variance 0; a prior needs more than 0 for each"
    yield good, with_covariance(0 * matrix), "bias_x has the variance 0"
    yield good, with_covariance(-matrix), "covariance.matrix: a correlation beyond 1, or a variance below 0"
    yield good, with_covariance(indefinite), "covariance.matrix: a correlation beyond 1, or a variance below 0"
    yield good, with_covariance(matrix, 6), "no misalignment_yx, or no covariance of it"
    lacking = {name: p for name, p in good.parameters.items() if name != "bias_z"}
    yield good, replace(good, parameters=lacking), "covariance.names: expected each a parameter, once, found 'bias_z'"
    yield good, replace(good, model={**good.model, "order": 7}), "a record of order 7 cannot be a prior"
    yield good, replace(good, model={**good.model, "gauge": "upper"}), "a record in the gauge 'upper'"
    yield good, replace(good, procedure="centrifuge", fit={}), "a centrifuge record cannot be a prior"


@pytest.mark.parametrize("number", range(9))
def test_records_that_cannot_be_priors_are_refused_in_a_sentence(number, imulab, tmp_path):
    good, bad, message = list(bad_priors())[number]
    bad.save(tmp_path / "bad.json")
    il.write_csv(attitudes_of({name: p.value for name, p in good.parameters.items()}, 1, 20, 2), tmp_path / "f.csv")
    done = imulab("tumble", "fit", "f.csv", "--gravity", str(G), "--prior", "bad.json", "-o", "out.json")
    assert done.returncode == 2
    assert done.stderr.startswith("imulab: bad.json: ")
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out.json").exists()


def test_the_same_recording_does_not_count_twice_and_another_unit_is_named(imulab, tmp_path):
    for seed in ("3", "4"):
        imulab("tumble", "simulate", "-o", f"{seed}.csv", "--order", "1", "--seed", seed)
        imulab("tumble", "fit", f"{seed}.csv", "--gravity", str(G), "--order", "1", "-o", f"{seed}.json")
    twice = imulab("tumble", "fit", "3.csv", "--gravity", str(G), "--prior", "3.json")
    assert twice.returncode == 2
    assert "3.csv: the prior 3.json was made from this recording, which would count twice" in twice.stderr
    imulab("tumble", "simulate", "-o", "v.csv", "--order", "1", "--unit", "V")
    volts = imulab("tumble", "fit", "v.csv", "--gravity", str(G), "--prior", "3.json")
    assert volts.returncode == 2
    assert volts.stderr == "imulab: 3.json: the prior has outputs in m/s^2, v.csv in V\n"
    other = imulab("tumble", "fit", "3.csv", "--gravity", str(G), "--prior", "4.json")
    assert other.returncode == 0, other.stderr
    assert "the prior is of serial SIM-0004, the recording of SIM-0003" in other.stderr


def test_the_command_updates_a_record_from_few_attitudes(imulab, tmp_path):
    imulab("tumble", "simulate", "-o", "a.csv", "--order", "1", "--seed", "3", "--attitudes", "24")
    imulab("tumble", "fit", "a.csv", "--gravity", str(G), "--order", "1", "-o", "a.json")
    whole = il.read(tmp_path / "a.csv")
    il.write_csv(replace(whole, columns={n: v[:3000] for n, v in whole.columns.items()}), tmp_path / "b.csv")
    assert imulab("tumble", "fit", "b.csv", "--gravity", str(G), "--order", "1").returncode == 2  # too few alone
    done = imulab(
        "tumble", "fit", "b.csv", "--gravity", str(G), "--prior", "a.json", "-o", "b.json", "--report", "b.html",
        "--ageing", "0ug,0ppm,0urad",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Prior and data" in done.stdout
    assert "from the prior" in (tmp_path / "b.html").read_text()
    before, after = il.load(tmp_path / "a.json"), il.load(tmp_path / "b.json")
    for name in before.parameters:
        assert after.parameters[name].standard_uncertainty < before.parameters[name].standard_uncertainty * 1.0001
    assert imulab("tumble", "fit", "b.csv", "--gravity", str(G), "--prior", "b.csv").returncode == 2
    ours = ("tumble", "fit", "b.csv", "--gravity", str(G))
    for arguments, message in (
        (["--ageing", "100ug"], "ageing without a prior: expected both"),
        (["--prior", "a.json", "--ageing", "1ug,1ppm,1urad,1"], "expected up to three, as in 100ug,100ppm,50urad"),
        (
            ["--prior", "a.json", "--ageing", "100ppm"],
            "--ageing '100ppm': expected a number, or one with a unit of acc",
        ),
        (["--prior", "a.json", "--ageing=-1ug"], "expected up to three standard deviations of 0 or more"),
    ):
        refused = imulab(*ours, *arguments)
        assert refused.returncode == 2
        assert message in refused.stderr
        assert refused.stderr.count("\n") == 1

"""The tumble fit against truth, an independent least-squares fit and the published first-order method."""

import re

import numpy as np
import pytest
from scipy import stats

import imulab as il
from conftest import table
from imulab.errors import DataError, ObservabilityError, OptionError
from reference import tumble as reference

G = 9.80665


NATURAL = {"b": 0.05 * G, "s": 1.0, "m": 0.03, "2": 5e-3 / G, "3": 2e-3 / G**2, "4": 1e-3 / G**3, "5": 5e-4 / G**4}


def natural(name: str) -> float:
    return NATURAL[name[1] if name[0] == "k" else name[0]]


def outputs(truth, order, directions, gravity=G):
    return np.array([reference.forward(gravity * d, truth, order) for d in directions])


def fit(outputs, order, *, unit="m/s^2", sigma=None, gravity=G, **options):
    return il.fit_tumble(il.find_attitudes(table(outputs, unit, sigma)), order=order, gravity=gravity, **options)


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_norm_recovers_a_noise_free_mems_triad(order):
    rng = np.random.default_rng(100 + order)
    for _ in range(5):
        truth = reference.random_truth(rng, order)
        found = fit(outputs(truth, order, reference.random_attitudes(rng, 12 * (order + 2))), order).calibration
        for name, value in truth.items():
            assert found.value(name) == pytest.approx(value, rel=1e-9, abs=1e-12 * natural(name)), name


@pytest.mark.parametrize(("unit", "scale"), [("count", 4096 / G), ("V", 0.1), ("g", 1 / G), ("mg", 1000 / G)])
def test_every_output_unit_recovers_its_own_scale(unit, scale):
    rng = np.random.default_rng(7)
    truth = reference.random_truth(rng, 2, scale=scale)
    found = fit(outputs(truth, 2, reference.random_attitudes(rng, 40)), 2, unit=unit).calibration
    for name, value in truth.items():
        assert found.value(name) == pytest.approx(value, rel=1e-8), name
    assert found.parameters["scale_factor_x"].unit == f"{unit}/(m/s^2)"


def test_a_zero_far_from_the_middle_of_the_range_is_found():
    rng = np.random.default_rng(8)
    truth = reference.random_truth(rng, 1, scale=414.0) | {"bias_x": 80.0, "bias_y": 78.0, "bias_z": 81.0}
    found = fit(outputs(truth, 1, reference.random_attitudes(rng, 24)), 1, unit="count").calibration
    for name, value in truth.items():
        assert found.value(name) == pytest.approx(value, rel=1e-9), name


@pytest.mark.parametrize("loss", ["auto", "huber"])
@pytest.mark.parametrize("up", [(0.1, 0.2, 0.98), (0.0, 0.1, -0.9)])
def test_one_attitude_of_outputs_that_never_change_is_refused_by_name(up, loss):
    with pytest.raises(ObservabilityError, match="of the 9 parameters of order 1"):
        il.fit_tumble(np.tile(up, (60, 1)), rate=10.0, unit="g", gravity=G, loss=loss)


@pytest.mark.parametrize(("unit", "size"), [("g", 1.0), ("count", 8192.0), ("V", 2.5)])
def test_one_attitude_is_refused_as_too_few_in_any_unit(unit, size):
    one = il.Recording.from_arrays(accel=size * np.array([[0.01, -0.02, 1.0]]), units={"accel": unit})
    with pytest.raises(ObservabilityError, match=r"1 attitude determines \d of the 9 parameters of order 1"):
        il.fit_tumble(one, order=1, gravity=9.81)


@pytest.mark.parametrize("unit", ["m/s^2", "g"])
@pytest.mark.parametrize("offset", [-2.0, 1.0, 1.5])
def test_zeros_of_one_to_two_g_are_found_in_any_unit(unit, offset):
    rng = np.random.default_rng(5)
    ups, sigma = reference.random_attitudes(rng, 24), 6e-5
    scale = 1 + 0.01 * rng.standard_normal(3)
    data = scale * (ups + offset) + sigma * rng.standard_normal((24, 3))
    size = G if unit == "m/s^2" else 1.0
    record = fit(size * data, "auto", unit=unit, sigma=size * sigma).calibration
    for axis, true in zip("xyz", scale, strict=True):
        bias, factor = record.parameters[f"bias_{axis}"], record.parameters[f"scale_factor_{axis}"]
        assert abs(bias.value / G - offset) < 3 * bias.standard_uncertainty / G
        assert factor.value * G / size == pytest.approx(true, abs=1e-3)
    assert record.verdict.state == "good"


@pytest.mark.parametrize(
    ("factor", "state", "words"),
    [(1.05, "good", ""), (1.15, "look", "is the unit right"), (0.5, "bad", "range were twice"), (2.0, "bad", "half")],
)
def test_scale_factors_of_another_unit_or_range_are_bad(factor, state, words):
    rng = np.random.default_rng(6)
    data = factor * G * (reference.random_attitudes(rng, 24) + 1e-4 * rng.standard_normal((24, 3)))
    verdict = fit(data, "auto", sigma=1e-4 * G).calibration.verdict
    assert verdict.state == state
    assert words in " ".join(verdict.reasons)


def test_one_long_and_quiet_hold_does_not_stand_out_of_attitudes_that_scatter():
    named = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        ups = reference.random_attitudes(rng, 24)
        sigma = np.full((24, 3), 2e-4)
        sigma[0] /= 10
        data = G * ups * (1 + 2e-4 * rng.standard_normal((24, 1))) + sigma * rng.standard_normal((24, 3))
        record = fit(data, "auto", sigma=sigma).calibration
        named += any("stands out" in w or "set aside" in w for w in record.warnings)
    assert named == 0


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.slow
def test_noisy_fit_equals_the_reference_fit(order):
    rng = np.random.default_rng(20 + order)
    truth = reference.random_truth(rng, order)
    noisy = outputs(truth, order, reference.random_attitudes(rng, 30)) + 1e-3 * rng.standard_normal((30, 3))
    found, expected = fit(noisy, order).calibration, reference.reference_fit(noisy, order, G)
    for name, value in expected.items():
        # The two differ by the lengthening of |f| by noise, sigma^2 / g, far below one standard uncertainty.
        assert found.value(name) == pytest.approx(value, abs=5e-3 * found.parameters[name].standard_uncertainty), name


def test_stated_covariances_weigh_the_attitudes():
    rng = np.random.default_rng(31)
    truth = reference.random_truth(rng, 1)
    sigma = np.where(np.arange(40)[:, None] % 2 == 0, 1e-4, 1e-2) * np.ones(3)
    noisy = outputs(truth, 1, reference.random_attitudes(rng, 40)) + sigma * rng.standard_normal((40, 3))
    weighted, plain = fit(noisy, 1, sigma=sigma).calibration, fit(noisy, 1).calibration
    errors = [[abs(c.value(n) - v) / natural(n) for n, v in truth.items()] for c in (weighted, plain)]
    assert np.linalg.norm(errors[0]) < 0.1 * np.linalg.norm(errors[1])
    for name, value in truth.items():
        assert abs(weighted.value(name) - value) < 4 * weighted.parameters[name].standard_uncertainty


def test_uncertainties_equal_the_cramer_rao_bound(noise_as_stated):
    rng = np.random.default_rng(32)
    truth = reference.random_truth(rng, 2)
    directions = reference.random_attitudes(rng, 30)
    sigma = rng.uniform(1e-4, 3e-4, (30, 3))
    found = fit(outputs(truth, 2, directions), 2, sigma=sigma).calibration
    bound = reference.bound(directions, truth, 2, G, sigma)
    size = np.sqrt(np.outer(np.diag(bound), np.diag(bound)))
    np.testing.assert_allclose(found.covariance.array() / size, bound / size, rtol=0, atol=1e-3)


@pytest.mark.slow
def test_noise_makes_single_samples_long_and_the_fit_knows():
    rng = np.random.default_rng(33)
    truth = {n: (1.0 if n[0] == "s" else 0.0) for n in reference.names(1)}
    sigma = 0.03 * G  # |f| grows by sigma^2 / g = 900 ppm
    noisy = outputs(truth, 1, reference.random_attitudes(rng, 20_000)) + sigma * rng.standard_normal((20_000, 3))
    for stated in (sigma, None):
        found = fit(noisy, 1, sigma=stated).calibration
        mean = np.mean([found.value(f"scale_factor_{a}") for a in "xyz"]) - 1
        assert abs(mean) < 4 * sigma / G / np.sqrt(20_000) + 1e-4  # the third order, 3 sigma^4, remains


def test_linearised_equals_its_transcription():
    rng = np.random.default_rng(40)
    for order in (1, 2, 4):
        truth = reference.random_truth(rng, order)
        nominal = {n: (1.0 if n[0] == "s" else 0.0) for n in truth}
        small = {n: nominal[n] + 0.1 * (truth[n] - nominal[n]) for n in truth}
        data = outputs(small, order, reference.random_attitudes(rng, 40))
        start = {f"scale_factor_{a}": 1.0 for a in "xyz"}
        expected = reference.linearised(data, order, G, start=start)
        found = fit(data, order, method="linearised").calibration
        for name, value in expected.items():
            assert found.value(name) == pytest.approx(value, rel=1e-9, abs=1e-9 * natural(name)), name


def test_linearised_is_biased_at_mems_size_and_norm_is_not(reduced):
    """Method document: k2 of 50 µg/g² is off by about 1 µg/g² at MEMS size, 0.05 µg/g² at navigation size."""
    trials = 4 if reduced else 10
    rng = np.random.default_rng(41)
    errors = {"mems": [], "navigation": [], "norm": []}
    for _ in range(trials):
        mems = reference.random_truth(rng, 2) | {f"k2_{a}": 50e-6 / G for a in "xyz"}
        nominal = {n: (1.0 if n[0] == "s" else 0.0) for n in mems}
        # scale 1 %, bias 5 mg, misalignment 1 mrad
        factor = {"s": 1 / 3, "b": 1 / 10, "m": 1 / 35, "k": 1.0}
        navigation = {n: nominal[n] + factor[n[0]] * (v - nominal[n]) for n, v in mems.items()}
        directions = reference.random_attitudes(rng, 36)
        for name, truth, method in (
            ("mems", mems, "linearised"),
            ("navigation", navigation, "linearised"),
            ("norm", mems, "norm"),
        ):
            found = fit(outputs(truth, 2, directions), 2, method=method).calibration
            errors[name] += [abs(found.value(f"k2_{a}") * G * 1e6 - 50) for a in "xyz"]
            if method == "linearised":
                assert found.fit["iterations"] <= 6
    assert np.median(errors["navigation"]) < 0.1
    assert 0.2 < np.median(errors["mems"]) < 5.0
    assert max(errors["norm"]) < 1e-6


def test_huber_keeps_one_knocked_attitude_from_spoiling_the_rest():
    rng = np.random.default_rng(50)
    truth = reference.random_truth(rng, 2)
    directions = reference.random_attitudes(rng, 30)
    data = outputs(truth, 2, directions) + 2e-4 * rng.standard_normal((30, 3))
    clean = fit(data, 2, sigma=2e-4).calibration
    data[11] += 0.05 * directions[11]  # 5 mg
    square, huber = (fit(data, 2, sigma=2e-4, loss=loss).calibration for loss in ("square", "huber"))
    shift = {
        loss: max(abs(c.value(n) - clean.value(n)) / clean.parameters[n].standard_uncertainty for n in truth)
        for loss, c in (("square", square), ("huber", huber))
    }
    assert shift["huber"] < 1.5 < 20 < shift["square"]
    assert [w for w in huber.warnings if "down-weighted" in w and "row 12 (line 13)" in w]
    assert any("stands out" in w or "scatter more" in w for w in square.warnings)


@pytest.mark.parametrize("true_order", [1, 2, 3])
def test_auto_chooses_the_order_of_the_truth(true_order, reduced):
    trials = 8 if reduced else 20
    rng = np.random.default_rng(60 + true_order)
    right = 0
    for _ in range(trials):
        truth = reference.random_truth(rng, true_order)
        for name in truth:  # nonlinearity that 40 attitudes can see
            if name.startswith(f"k{true_order}"):
                truth[name] = NATURAL[str(true_order)] * np.sign(truth[name] or 1.0)
        data = outputs(truth, true_order, reference.random_attitudes(rng, 40)) + 1e-3 * rng.standard_normal((40, 3))
        result = fit(data, "auto")
        right += result.calibration.model["order"] == true_order
        assert [row.order for row in result.orders] == [1, 2, 3, 4, 5]
    assert right >= 0.9 * trials  # the F-test at 5 % lets one in twenty go higher


def test_unknown_noise_is_estimated_and_said():
    rng = np.random.default_rng(70)
    truth = reference.random_truth(rng, 1)
    data = outputs(truth, 1, reference.random_attitudes(rng, 24)) + 1e-3 * rng.standard_normal((24, 3))
    found = fit(data, 1).calibration
    assert found.fit["noise"] == "estimated from the residuals"
    assert found.fit["degrees_of_freedom"] == 15
    assert found.fit["coverage_factor_95"] == pytest.approx(2.131450)  # Student's t, 15 degrees of freedom
    assert found.fit["reduced_chi_square"] == pytest.approx(1e-6, rel=0.6)
    known = fit(data, 1, sigma=1e-3).calibration
    assert known.fit["noise"] == "known"
    assert 1.959964 < known.fit["coverage_factor_95"] < 2.03
    assert known.fit["effective_degrees_of_freedom"] > 30


def test_attitudes_that_scatter_more_than_stated_get_an_excess():
    rng = np.random.default_rng(71)
    truth = reference.random_truth(rng, 1)
    data = outputs(truth, 1, reference.random_attitudes(rng, 40)) + 1e-3 * rng.standard_normal((40, 3))
    found = fit(data, 1, sigma=1e-4).calibration
    assert found.fit["excess"]["value"] == pytest.approx(1e-3, rel=0.4)
    assert any("scatter more than their own noise" in w for w in found.warnings)
    for name, value in truth.items():
        assert abs(found.value(name) - value) < 4 * found.parameters[name].standard_uncertainty


def test_exactly_as_many_attitudes_as_parameters_state_no_uncertainty():
    rng = np.random.default_rng(72)
    truth = reference.random_truth(rng, 1)
    found = fit(outputs(truth, 1, reference.random_attitudes(rng, 9)), 1).calibration
    assert all(p.standard_uncertainty is None for p in found.parameters.values())
    assert any("no uncertainty is stated" in w for w in found.warnings)


FACES = np.vstack([np.eye(3), -np.eye(3)])


EDGES = np.array([[a, b, 0] for a in (-1, 1) for b in (-1, 1)]) / np.sqrt(2)


EIGHTEEN = np.vstack([FACES, EDGES, np.roll(EDGES, 1, axis=1), np.roll(EDGES, 2, axis=1)])


@pytest.mark.parametrize(
    ("directions", "order", "named"),
    [
        (FACES, 1, {"misalignment_yx", "misalignment_zx", "misalignment_zy"}),
        (np.repeat(FACES, 4, axis=0), 1, {"misalignment_yx", "misalignment_zx", "misalignment_zy"}),
        (EIGHTEEN, 4, {"k2_x", "k4_x", "k2_y", "k4_y", "k2_z", "k4_z"}),
        (np.repeat(EIGHTEEN, 3, axis=0), 4, {"k2_x", "k4_x", "k2_y", "k4_y", "k2_z", "k4_z"}),
    ],
)
def test_a_blind_fixture_is_refused_with_the_parameters_it_cannot_separate(directions, order, named):
    truth = reference.random_truth(np.random.default_rng(80), 1)
    truth = {n: v if n[0] == "s" else 0.0 for n, v in truth.items()} | dict.fromkeys(reference.names(order)[9:], 0.0)
    with pytest.raises(ObservabilityError) as caught:
        fit(outputs(truth, order, directions), order)
    message = str(caught.value)
    assert message.startswith("table.csv: ")
    assert f"of the {3 * (order + 2)} parameters of order {order}" in message
    assert named <= set(message.replace(";", " ").split())
    assert "would help most" in message
    assert len(message.removeprefix("table.csv: ").split()) <= 37


def test_six_faces_at_order_2_are_told_a_power_that_they_cannot_separate():
    truth = reference.random_truth(np.random.default_rng(80), 1) | dict.fromkeys(reference.names(2)[9:], 0.0)
    with pytest.raises(ObservabilityError, match=r" k2_[xyz]\b.* and 3 more; upward directions"):
        fit(outputs(truth, 2, FACES), 2)


def test_the_attitudes_that_would_help_do_help():
    truth = {n: (1.0 if n[0] == "s" else 0.0) for n in reference.names(1)}
    with pytest.raises(ObservabilityError) as caught:
        fit(outputs(truth, 1, np.vstack([FACES, EDGES])), 1)
    advice = str(caught.value).split("upward directions ")[1].split(" would help")[0]
    added = np.array([[float(x) for x in part.strip("()").split(",")] for part in advice.split(" and ")])
    added /= np.linalg.norm(added, axis=1, keepdims=True)
    found = fit(outputs(truth, 1, np.vstack([FACES, EDGES, added])), 1)
    assert found.observability.rank == 9
    assert found.observability.condition < 20


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"order": 6}, "expected one of auto 0 1 2 3 4 5 blend"),
        ({"order": "best"}, "expected one of auto 0 1 2 3 4 5 blend"),
        ({"method": "magic"}, "expected one of norm linearised"),
        ({"loss": "cauchy"}, "expected one of square huber auto"),
        ({"gravity": 981.0}, "expected the local value in m/s^2"),
        ({"method": "linearised", "loss": "huber"}, "needs method norm"),
    ],
)
def test_unknown_options_are_refused_with_what_there_is(options, message):
    rng = np.random.default_rng(90)
    data = outputs(reference.random_truth(rng, 1), 1, reference.random_attitudes(rng, 24))
    with pytest.raises(OptionError, match=re.escape(message)):
        fit(data, **({"order": 1} | options))


def test_linearised_that_ends_where_the_model_cannot_be_inverted_says_so():
    rng = np.random.default_rng(257)
    data = G * (reference.random_attitudes(rng, 24) + 0.4 * rng.standard_normal((24, 3)))
    with pytest.raises(DataError, match=r"no specific force leads to some of these attitudes; use --method norm"):
        fit(data, 3, method="linearised")


@pytest.mark.parametrize("order", [1, "auto"])
def test_huber_on_as_many_attitudes_as_parameters_leaves_nothing_to_weigh_with(order):
    """Residuals that are zero to the last bit: no scale, and no division by it."""
    data = np.vstack([np.eye(3), -np.eye(3), [[0.6, 0.8, 0.0], [0.6, 0.0, 0.8], [0.0, 0.6, 0.8]]])
    found = fit(data, order, unit="g", loss="huber")
    assert found.observability.rank == 9
    assert not found.residuals.any()
    assert "leave nothing to estimate the noise from" in " ".join(found.calibration.warnings)


def test_linearised_that_does_not_converge_says_so():
    rng = np.random.default_rng(91)
    truth = {n: (1.0 if n[0] == "s" else 0.0) for n in reference.names(1)} | {"bias_x": 0.9 * G}
    with pytest.raises(DataError, match=r"linearised does not converge.*--method norm"):
        fit(outputs(truth, 1, reference.random_attitudes(rng, 24)), 1, method="linearised")


def test_without_gravity_the_standard_value_is_used_and_warned_of():
    rng = np.random.default_rng(92)
    data = outputs(reference.random_truth(rng, 1), 1, reference.random_attitudes(rng, 24))
    found = fit(data, 1, gravity=None).calibration
    assert found.model["gravity"]["value"] == 9.80665
    assert any("no local gravity" in w and "scale factor" in w for w in found.warnings)


G_LINEARISED = 9.81362


ARCSECOND = np.pi / 180 / 3600


SOURCE = (5e-6, 2e-6 * G_LINEARISED, 3 * ARCSECOND)


def outputs_linearised(directions, *, seed=3, part=0.5):
    """Outputs of a MEMS triad whose errors are scaled by `part`."""
    truth = reference.random_truth(np.random.default_rng(seed), 2)
    nominal = {name: float(name[0] == "s") for name in truth}
    truth = {name: nominal[name] + part * (value - nominal[name]) for name, value in truth.items()}
    return np.array([reference.forward(G_LINEARISED * up, truth, 2) for up in directions])


def fit_linearised(data, **options):
    return il.fit_tumble(
        il.find_attitudes(table(data, "m/s^2", None)), order=2, gravity=G_LINEARISED, method="linearised", **options
    ).calibration


def test_each_error_of_the_model_is_its_own_unknown_of_the_sources_equation():
    """The signs and the pairing of products that docs/tumble_method.md states, from the forward model alone."""
    names, size = reference.names(2), 1e-6
    ups = reference.random_attitudes(np.random.default_rng(1), 40)
    for place, name in enumerate(names):
        truth = {each: float(each[0] == "s") for each in names}
        truth[name] += size * {"b": G_LINEARISED, "k": 1 / G_LINEARISED}.get(name[0], 1.0)
        x, y, z = a = np.array([reference.forward(G_LINEARISED * up, truth, 2) for up in ups]).T / G_LINEARISED
        products = [x * y, z * x, y * z]  # for m_yx, m_zx and m_zy
        design = np.array([*a, *a**2, *products, *a**3]).T
        unknowns = np.linalg.lstsq(design, ((a**2).sum(axis=0) - 1) / 2, rcond=None)[0]
        np.testing.assert_allclose(unknowns / size, np.eye(len(names))[place], rtol=0, atol=1e-4)


def test_the_threshold_decides_how_many_passes_are_made():
    """As many as in the transcription of the source, which knows nothing of this one."""
    data = outputs_linearised(reference.random_attitudes(np.random.default_rng(1), 30))
    start = {f"scale_factor_{axis}": 1.0 for axis in "xyz"}
    passes = []
    for factor in (1e4, 1.0, 1e-4, 1e-7):
        limits = tuple(factor * value for value in SOURCE)
        found = fit_linearised(data, threshold=limits)
        expected = reference.linearised_passes(
            data, 2, G_LINEARISED, start, (limits[0], limits[1] / G_LINEARISED, limits[2])
        )[1]
        assert found.fit["iterations"] == expected
        assert found.options["threshold"] == pytest.approx(limits, rel=1e-12)
        passes.append(expected)
    assert passes == sorted(set(passes))
    default = fit_linearised(data)
    assert default.fit["iterations"] == passes[1]
    assert default.options["threshold"] == pytest.approx(SOURCE, rel=1e-12)


def test_the_preset_scale_factors_are_where_the_iteration_starts():
    """As in the transcription of the source from the same start, in counts, whose zero is far from the middle."""
    data = 8192 / G_LINEARISED * outputs_linearised(reference.random_attitudes(np.random.default_rng(1), 30), part=0.1)
    attitudes = il.find_attitudes(table(data, "count", None))
    how = {"order": 2, "gravity": G_LINEARISED, "method": "linearised", "threshold": tuple(1e3 * x for x in SOURCE)}
    limits = (1e3 * SOURCE[0], 1e3 * SOURCE[1] / G_LINEARISED, 1e3 * SOURCE[2])
    values = []
    for preset in ((8192.0, 8192.0, 8192.0), (7900.0, 8300.0, 8100.0)):
        start = {f"scale_factor_{axis}": each / G_LINEARISED for axis, each in zip("xyz", preset, strict=True)}
        expected, passes = reference.linearised_passes(data, 2, G_LINEARISED, start, limits)
        found = il.fit_tumble(attitudes, preset=preset, **how).calibration
        assert found.fit["iterations"] == passes
        for name, value in expected.items():
            assert found.value(name) == pytest.approx(value, rel=1e-9, abs=1e-9 * natural(name)), name
        values.append(found.value("k2_x"))
    assert values[0] != pytest.approx(values[1], rel=1e-9)  # so loose a threshold leaves the start in the result
    one = il.fit_tumble(attitudes, preset=8192, **how).calibration
    text = il.fit_tumble(attitudes, preset="8192,8192,8192", **how).calibration
    assert one.value("k2_x") == text.value("k2_x") == values[0]
    assert text.options["preset"] == [8192.0] * 3
    for preset, message in (("8192,1", "expected one scale factor or three"), (-1.0, "above 0"), ("0", "above 0")):
        with pytest.raises(OptionError, match=message):
            il.fit_tumble(attitudes, preset=preset, **how)
    with pytest.raises(OptionError, match="preset needs method linearised, found method norm"):
        il.fit_tumble(attitudes, preset=8192)


@pytest.mark.slow
def test_linearised_and_its_plan_have_the_order_of_the_source_unless_another_is_given():
    data = outputs_linearised(reference.random_attitudes(np.random.default_rng(1), 30), part=0.1)
    attitudes = il.find_attitudes(table(data, "m/s^2", None))
    found = il.fit_tumble(attitudes, gravity=G_LINEARISED, method="linearised").calibration
    assert found.model["order"] == found.options["order"] == 4
    assert not any("nonlinearity, which the source" in each for each in found.warnings)
    low = il.fit_tumble(attitudes, gravity=G_LINEARISED, method="linearised", order=1).calibration
    assert any(each.startswith("order 1 has no nonlinearity, which the source") for each in low.warnings)
    assert [il.plan_tumble(24, noise="20ug", method=m).order for m in ("norm", "linearised")] == [3, 4]


def test_with_the_signs_that_are_printed_in_equation_4_the_iteration_diverges_and_with_all_minus_it_settles():
    """The source's equations (4) and (16) as docs/tumble_method.md states them, transcribed here with its own alpha."""
    data = outputs_linearised(reference.random_attitudes(np.random.default_rng(1), 30), part=1.0) / G_LINEARISED
    ends = {}
    for signs in ((-1, 1, 1), (-1, -1, -1)):
        scale, bias, alpha = np.ones(3), np.zeros(3), np.zeros(3)
        for _ in range(30):
            x, y, z = a = (data / scale - bias).T
            length = x**2 + (alpha[0] * x + y) ** 2 + (alpha[2] * x + alpha[1] * y + z) ** 2
            products = np.array([x * y, y * z, z * x]) * np.array(signs)[:, None]
            design = np.vstack([a, a**2, a**3, products]).T
            d = np.linalg.lstsq(design, (length - 1) / 2, rcond=None)[0]
            scale, bias, alpha = scale * (1 + d[3:6]), bias + d[:3], alpha + d[9:]
            if not np.all(np.isfinite(d)) or np.abs(d).max() > 1:
                break
        ends[signs] = np.abs(np.r_[d[:6], d[9:]]).max()
    assert ends[-1, 1, 1] > 1e-2
    assert ends[-1, -1, -1] < 1e-9


@pytest.mark.parametrize("alone", [0, 1, 2])
def test_each_of_the_three_changes_counts(alone):
    data = outputs_linearised(reference.random_attitudes(np.random.default_rng(1), 30))
    loose = [1.0, G_LINEARISED, 1.0]
    limits = [1e-9 * value if index == alone else value for index, value in enumerate(loose)]
    assert (
        fit_linearised(data, threshold=limits).fit["iterations"]
        > fit_linearised(data, threshold=loose).fit["iterations"]
    )


def test_a_threshold_below_rounding_is_refused_with_what_the_last_pass_changed():
    data = outputs_linearised(reference.random_attitudes(np.random.default_rng(1), 30))
    with pytest.raises(DataError, match=r"not at rest after 50 passes: .* the threshold is 1e-14 ppm, "):
        fit_linearised(data, threshold=(1e-20, 1e-20 * G_LINEARISED, 1e-20))


@pytest.mark.parametrize(
    ("threshold", "message"),
    [
        ((1e-6, 1e-6), "expected three changes above 0"),
        ((1e-6, 0.0, 1e-6), "expected three changes above 0"),
        ((1e-6, np.nan, 1e-6), "threshold: expected numbers or a text, found"),
        ((1e-6, np.inf, 1e-6), "expected three changes above 0"),
    ],
)
def test_thresholds_that_are_none_are_refused(threshold, message):
    with pytest.raises(OptionError, match=message):
        fit_linearised(outputs_linearised(np.eye(3)), threshold=threshold)


def test_the_command_and_the_fleet_take_a_threshold(imulab, tmp_path):
    il.write(il.simulate_tumble(attitudes=24, order=1, hold=2.0, gravity=G_LINEARISED, seed=4), tmp_path / "t.csv")
    fit_it = ["tumble", "fit", "t.csv", "--gravity", str(G_LINEARISED), "--order", "1"]
    text = "1e-3 ppm, 1e-3 ug, 0.001 arcsec"
    done = imulab(*fit_it, "--method", "linearised", "--threshold", text, "-o", "t.json")
    assert done.returncode == 0, done.stderr
    held = il.load(tmp_path / "t.json")
    assert held.options["threshold"] == pytest.approx([1e-9, 1e-9 * 9.80665, 1e-3 * ARCSECOND])
    assert imulab(*fit_it, "--method", "linearised", "-o", "d.json").returncode == 0
    assert held.fit["iterations"] > il.load(tmp_path / "d.json").fit["iterations"]
    (tmp_path / "m.csv").write_text(
        f'serial,procedure,file,gravity,order,method,threshold\nSN1,tumble,t.csv,{G_LINEARISED},1,linearised,"{text}"\n'
    )
    done = imulab("fleet", "run", "m.csv", "-o", "out")
    assert done.returncode == 0, done.stderr
    assert il.load(tmp_path / "out" / "SN1.json").options["threshold"] == held.options["threshold"]
    for arguments, message in (
        (["--threshold", text], "--threshold needs method linearised, found method norm"),
        (["--method", "linearised", "--threshold", "5 ppm"], "--threshold '5 ppm': expected three changes, of scale"),
        (["--method", "linearised", "--threshold", "2 ug,5 ppm,3 arcsec"], "--threshold '2 ug': expected a number, or"),
        (["--method", "linearised", "--threshold", "5 ppm,0 ug,3 arcsec"], "--threshold '5 ppm,0 ug,3 arcsec': exp"),
        (["--method", "linearised", "--threshold", "1e999,2,3"], "--threshold '1e999': expected 0, or a number of"),
    ):
        refused = imulab(*fit_it, *arguments, "-o", "no.json")
        assert refused.returncode == 2
        assert refused.stderr.startswith(f"imulab: {message}"), refused.stderr
        assert refused.stderr.count("\n") == 1
        assert not (tmp_path / "no.json").exists()


def test_an_axis_vertical_in_two_attitudes_is_warned_of_by_name():
    apart = [
        up
        for up in reference.random_attitudes(np.random.default_rng(1), 40)
        if np.abs(up).max() < np.cos(np.radians(8))
    ]
    once = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], *apart])
    assert not [warning for warning in fit_linearised(outputs_linearised(once)).warnings if "vertical" in warning]
    tilted = [0.0, np.sin(np.radians(2)), -np.cos(np.radians(2))]
    twice = np.array([*once, tilted])
    (warning,) = [warning for warning in fit_linearised(outputs_linearised(twice)).warnings if "vertical" in warning]
    last = len(twice)
    where = f"row 1 (line 2), row {last} (line {last + 1})"
    assert warning.startswith(f"axis z is vertical within 3 deg in 2 attitudes ({where}): the source of method")
    norm = il.fit_tumble(
        il.find_attitudes(table(outputs_linearised(twice), "m/s^2", None)), order=2, gravity=G_LINEARISED
    ).calibration
    assert not [warning for warning in norm.warnings if "vertical" in warning]
    assert "threshold" not in norm.options


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


@pytest.mark.slow
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


@pytest.mark.parametrize("loss", ["auto", "square", "huber"])
@pytest.mark.parametrize("order", ["auto", 0, 1, "blend"])
def test_attitudes_that_are_exact_give_exact_parameters(order, loss):
    faces = np.concatenate([np.eye(3), -np.eye(3)])
    edges = np.array(
        sorted({(a * x, b * y, 0.0) for a in (1, -1) for b in (1, -1) for x, y in ((0.6, 0.8), (0.8, 0.6))})
    )
    outputs = np.concatenate([faces, *(np.roll(edges, shift, axis=1) for shift in range(3))])
    columns = {f"accel_{axis}": outputs[:, i].copy() for i, axis in enumerate("xyz")}
    recording = il.Recording(columns, dict.fromkeys(columns, "g"))
    record = il.fit_tumble(recording, order=order, loss=loss, gravity=9.80665).calibration
    for name, parameter in record.parameters.items():
        ideal = 1 / 9.80665 if name.startswith("scale") else 0.0
        assert parameter.value == pytest.approx(ideal, abs=1e-12)
        assert 0 <= (parameter.standard_uncertainty or 0.0) < 1e-9

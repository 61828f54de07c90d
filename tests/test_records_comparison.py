"""Records of any one procedure compared: against scipy on records made by hand, and from the command line."""

import json

import numpy as np
import pytest
from scipy import stats

from imulab.cli import main
from imulab.errors import RecordError
from imulab.procedures.views import compare_records
from imulab.records.calibration import Calibration, Covariance, Parameter

NAMES = ("x_K0", "x_direction", "y_K0")


def a_record(values, matrix, names=NAMES, unit="1", freedom=None, stated=None, levels=(10.0, 50.0)):
    matrix = np.asarray(matrix, dtype=float)
    u = np.sqrt(np.diag(matrix))
    parameters = {name: Parameter(v, float(s), unit) for name, v, s in zip(names, values, u, strict=True)}
    parameters |= {name: Parameter(value, None, unit) for name, value in (stated or {}).items()}
    fit = {"noise": "known"} if freedom is None else {"noise": "estimated", "degrees_of_freedom": freedom}
    sections = {"levels": [{"specific_force": {"value": level, "unit": "m/s^2"}} for level in levels]}
    covariance = Covariance(tuple(names), tuple(map(tuple, matrix.tolist())))
    return Calibration("centrifuge", parameters, covariance, {}, fit, sections=sections)


FIRST = np.array([[4.0, 1.0, 0.0], [1.0, 2.0, 0.3], [0.0, 0.3, 1.0]])
SECOND = np.array([[1.0, -0.5, 0.1], [-0.5, 3.0, 0.0], [0.1, 0.0, 2.0]])


def test_differences_and_the_joint_probability_are_those_of_the_covariances():
    found = compare_records(a_record([1, 2, 3], FIRST), a_record([2, 1, 7], SECOND))
    d, total = np.array([1, -1, 4]), FIRST + SECOND
    assert [change.difference for change in found.changes] == d.tolist()
    np.testing.assert_allclose([change.standard_uncertainty for change in found.changes], np.sqrt(np.diag(total)))
    assert found.probability == pytest.approx(stats.chi2.sf(d @ np.linalg.inv(total) @ d, 3), rel=1e-9)


@pytest.mark.parametrize(("freedom", "both"), [(None, np.inf), (4, 8), ({"x_K0": 2, "x_direction": 30, "y_K0": 30}, 4)])
def test_a_change_is_one_beyond_what_chance_gives_any_of_them_in_a_twentieth_of_the_comparisons(freedom, both):
    share = 1 - 0.05 / 6  # two sides of three parameters
    limit = stats.t.ppf(share, both) * np.sqrt(2)
    for factor, changed in ((0.999, False), (1.001, True), (-1.001, True)):
        pair = (a_record(v, np.eye(3), freedom=freedom) for v in ([0, 0, 0], [factor * limit, 0, 0]))
        assert [change.significant for change in compare_records(*pair).changes] == [changed, False, False]


def test_no_change_is_claimed_where_nothing_changed(reduced):
    trials = 300 if reduced else 1000
    rng, root = np.random.default_rng(3), [np.linalg.cholesky(m) for m in (FIRST, SECOND)]
    claims, probabilities = 0, []
    for _ in range(trials):
        a, b = (a_record(r @ rng.standard_normal(3), r @ r.T) for r in root)
        found = compare_records(a, b)
        claims += any(change.significant for change in found.changes)
        probabilities.append(found.probability)
    assert stats.binom.ppf(0.001, trials, 0.035) <= claims <= stats.binom.ppf(0.999, trials, 0.05)
    assert stats.kstest(probabilities, "uniform").pvalue > 1e-3


def test_a_parameter_that_follows_from_others_adds_nothing_to_the_joint_probability():
    turn = np.vstack([np.eye(3), [0.5, -2.0, 1.0]])
    both = [(np.array([1.0, 2, 3]), FIRST), (np.array([2.0, 1, 7]), SECOND)]
    plain = compare_records(*(a_record(v, m) for v, m in both))
    more = compare_records(*(a_record(turn @ v, turn @ m @ turn.T, names=(*NAMES, "z")) for v, m in both))
    assert more.probability == pytest.approx(plain.probability, rel=1e-6)


def test_what_cannot_be_judged_is_shown_and_what_is_another_thing_is_left_out():
    names = ("x_K0", "x_K_2", "x_zeta_2")
    same = compare_records(a_record([0, 0, 0], FIRST, names), a_record([9, 9, 9], SECOND, names))
    assert [change.name for change in same.changes] == list(names)
    first = a_record([0, 0, 0], FIRST, names, stated={"jump": 1.0, "gone": 1.0})
    found = compare_records(first, a_record([9, 9, 9], SECOND, names, stated={"jump": 3.0}, levels=(10.0, 70.0)))
    assert [(c.name, c.difference, c.standard_uncertainty, c.deviations, c.significant) for c in found.changes[1:]] == [
        ("jump", 2.0, None, None, False)
    ]
    assert found.left_out == ("x_K_2", "x_zeta_2", "gone")
    bare = compare_records(first, Calibration("centrifuge", first.parameters, Covariance((), ()), {}, {}))
    assert bare.probability is None


def test_models_that_differ_are_named_and_what_scatters_from_test_to_test_is_not():
    parameters = {"bias_x": Parameter(0.0, 1.0, "m/s^2")}

    def record(order, gravity, temperature, settled):
        quantities = {
            "gravity": (gravity, "m/s^2"),
            "temperature": (temperature, "degC"),
            "settling_time": (settled, "s"),
        }
        model = {"order": order} | {key: {"value": value, "unit": unit} for key, (value, unit) in quantities.items()}
        return Calibration("tumble", parameters, Covariance((), ()), model, {})

    first = record(1, 9.81, 24.0, 300.0)
    assert compare_records(first, record(1, 9.81, 24.9, 310.0)).models == ()
    assert compare_records(first, record(2, 9.82, 31.5, 400.0)).models == (
        "order 1 and 2",
        "gravity 9.81 and 9.82 m/s^2",
        "temperature 24 and 31.5 degC",
        "settling_time 300 and 400 s",
    )


def test_curves_that_differ_are_named():
    """A centrifuge record names the curve of each axis in a set of its own."""

    def record(x, y):
        model = {"radius": {"value": 0.5, "unit": "m", "from": "manifest"}, "curve": {"x": x, "y": y}}
        return Calibration("centrifuge", {"x_K0": Parameter(0.0, 1.0, "rad/s")}, Covariance((), ()), model, {})

    found = compare_records(record("constant", "linear"), record("quadratic", "linear"))
    assert found.models == ("curve x constant and quadratic",)


def test_show_says_that_a_change_may_come_from_the_order(tmp_path, capsys):
    data = tmp_path / "tumble.csv"
    assert main(["tumble", "simulate", "--order", "2", "--attitudes", "18", "-o", str(data)]) == 0
    for order in "12":
        assert main(["tumble", "fit", str(data), "--order", order, "-o", str(tmp_path / f"{order}.json")]) == 0
    capsys.readouterr()
    assert main(["show", str(tmp_path / "1.json"), str(tmp_path / "2.json")]) == 0
    assert "the records differ in order 1 and 2: a change may come from that\n" in capsys.readouterr().out


def test_records_that_cannot_be_compared_are_refused():
    a = a_record([0, 0, 0], FIRST)
    other = Calibration("warmup", a.parameters, a.covariance, {}, {})
    with pytest.raises(RecordError, match="cannot compare a centrifuge record with a warmup record"):
        compare_records(a, other)
    with pytest.raises(RecordError, match="x_K0 in different units: 1 and rad"):
        compare_records(a, a_record([0, 0, 0], FIRST, unit="rad"))
    none = Calibration("centrifuge", {"x_K0": Parameter(0.0, None, "1")}, Covariance((), ()), {}, {})
    with pytest.raises(RecordError, match="without uncertainties"):
        compare_records(a, none)


def test_two_warmup_records_of_one_unit(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for seed in ("1", "2"):
        options = ["--temperatures=-20,0,20", "--cycles", "3", "--rate", "2", "--seed", seed]
        assert main(["warmup", "simulate", "-o", f"w{seed}", *options]) == 0
        files = [str(file) for file in sorted((tmp_path / f"w{seed}").iterdir())]
        fit = ["--temperatures=-20,0,20", "--model", "exponential", "--settling-time", "300", "-o", f"{seed}.json"]
        assert main(["warmup", "fit", *files, *fit]) == 0
    capsys.readouterr()
    assert main(["show", "1.json", "2.json"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "2.json less 1.json: no significant change"
    (row,) = [line.split() for line in lines if line.startswith("time_constant_1")]
    assert row[-1] == "s"
    (exit_jump,) = [line for line in lines if line.startswith("exit_jump_gyro_x")]
    assert "not stated" in exit_jump
    assert exit_jump.endswith("deg/h")
    assert lines[-1] == "the tables themselves are not compared"
    assert main(["show", "1.json", "2.json", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert {change["name"]: change["unit"] for change in content["changes"]}["time_constant_1"] == "s"

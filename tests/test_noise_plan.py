"""How long to record at rest: against the laws of the terms and what fits of simulated logs reach."""

import json

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.errors import OptionError
from imulab.procedures.noise.plan import duration_text

DEGREE = np.pi / 180
WHITE, WALK = 0.3 * DEGREE / 60, 10 * DEGREE / 3600 / 60


def term(plan, name, column="gyro"):
    (found,) = [each for each in plan.terms if (each.column, each.term) == (column, name)]
    return found


def test_lengths_are_those_of_the_laws():
    """u(N)/N = 1/sqrt(2n), u(K)/K = sqrt(2 N/(K L)), u(B)/B = 1.25 N/(B sqrt L), u(S)/S = .8 sqrt(T/L), T 2.2."""
    walk = il.plan_noise(white=WHITE, walk=WALK, for_="5 %", rate=20.0)
    assert term(walk, "walk").length == pytest.approx(2 * WHITE / WALK / 0.05**2, rel=0.03)
    assert walk.needed == walk.length == term(walk, "walk").length
    assert term(walk, "white").uncertainty == pytest.approx(1 / np.sqrt(2 * walk.length * 20), rel=0.03)
    flicker = il.plan_noise(white=WHITE, flicker=WHITE / 3.64, for_={"flicker": 0.0455}, rate=10.0)
    assert flicker.needed == pytest.approx((1.25 * 3.64 / 0.0455) ** 2, rel=0.1)  # the law is good to 5 %
    sigma = WHITE * np.sqrt(20 / 2 / 100)  # its density at 0 is 2 S^2 T = 20 N^2
    markov = il.plan_noise(white=WHITE, gm=(sigma, 100.0), for_="gm1_sigma=8%,gm1_time=22%", rate=10.0)
    assert term(markov, "gm1_sigma").length == pytest.approx(1e4, rel=0.06)
    assert term(markov, "gm1_time").length == pytest.approx(1e4, rel=0.06)


def test_what_is_wanted_of_all_terms_is_not_of_correlation_times():
    plan = il.plan_noise(white="100 ug/sqrt(Hz)", gm="30 ug:200 s", for_="10 %")
    assert np.isnan(term(plan, "gm1_time", "accel").wanted)
    assert term(plan, "gm1_sigma", "accel").wanted == 0.1


@pytest.fixture(scope="module")
def record():
    log = il.simulate_noise(white=WHITE, walk=20 * WALK, columns="gyro_x,gyro_y", duration="30 min", seed=3)
    white = il.simulate_noise(white=WHITE, columns="gyro_z", duration="30 min", seed=4)
    return il.fit_noise(log.with_columns({"gyro_z": white.column("gyro_z")}, {"gyro_z": "deg/s"})).calibration


@pytest.mark.slow
def test_a_record_states_what_the_plan_predicts(record):
    plan = il.plan_noise(from_=record)
    for name in ("gyro_x_white", "gyro_x_walk", "gyro_y_walk"):
        column, _, kind = name.rpartition("_")
        found, p = term(plan, kind, column), record.parameter(name)
        assert found.uncertainty == pytest.approx(p.standard_uncertainty / p.value, rel=0.1)
    assert plan.length == pytest.approx(1800, rel=1e-3)


@pytest.mark.slow
def test_what_is_not_seen_has_the_limit_of_the_record_or_of_a_longer_one(record):
    now, later = (term(il.plan_noise(from_=record, duration=d), "walk", "gyro_z") for d in (None, "2 h"))
    assert now.value == 0
    assert np.isnan(now.length)
    assert now.limit == record.parameter("gyro_z_walk").interval_95[1]
    # K below about 11 N/L.
    assert later.limit == pytest.approx(11 * WHITE / 7200, rel=0.5)


def test_the_record_that_was_planned_reaches_it(reduced):
    """Records of the planned length scatter as was wanted: 40 spectra by their likelihood, of data in time."""
    trials = 20 if reduced else 40
    from imulab.estimation.noise.likelihood import fit, time_limits
    from imulab.estimation.noise.terms import prepare, terms
    from noise_models import empty, transformed
    from reference import noise as reference

    plan = il.plan_noise(white=1.0, walk=0.02, for_="walk=15%", rate=2.0)
    spectrum = empty(round(plan.needed * 2), 0.5)
    rng = np.random.default_rng(5)
    logs = np.array([reference.draw(rng, {"N": 1.0, "K": 0.02}, spectrum.count, 0.5) for _ in range(trials)])
    power = transformed(logs, spectrum)
    freedom = np.broadcast_to(spectrum.freedom, power.shape)
    found = fit(prepare([spectrum]), terms("NK")[None], time_limits([spectrum]), power, freedom).values[:, 2]
    assert np.std(np.log(found)) == pytest.approx(0.15, rel=0.3)


def test_curves_and_picture_hold_every_term(record, tmp_path):
    plan = il.plan_noise(from_=record)
    plan.save(tmp_path / "p.csv")
    read = il.read(tmp_path / "p.csv")
    assert read.units["length"] == "s"
    at = np.interp(1800, read.column("length"), read.column("u_gyro_x_walk"))
    assert at == pytest.approx(term(plan, "walk", "gyro_x").uncertainty, rel=0.05)
    names = [trace["name"] for trace in plan.plot().to_dict()["data"]]
    assert {"gyro_x, rate random walk", "gyro_z, angle random walk", "wanted, 10 %"} <= {*names}


@pytest.mark.parametrize(
    ("seconds", "text"), [(5, "5.0 s"), (90, "90 s"), (1800, "30 min"), (2e4, "5.6 h"), (1e6, "12 d")]
)
def test_lengths_of_time_are_said_as_people_do(seconds, text):
    assert duration_text(seconds) == text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "no noise is given: expected one of --white"),
        ({"white": 1.0, "for_": "walk=10%"}, "for_ walk: not among the terms; expected white"),
        ({"white": 1.0, "for_": "much"}, "for_ 'much': expected a fraction such as 0.01 or 1 %"),
        ({"white": 1.0, "for_": "white=1%,white=2%"}, "for_ 'white=1%,white=2%': white twice; expected each term once"),
        ({"white": 1.0, "for_": "=5%"}, "for_ '=5%': expected the name of a term before each =, such as walk=10%"),
        ({"white": 1.0, "for_": "white=300%"}, "for_ white=300%: expected a share above 0 and up to 1"),
        ({"white": 1.0, "duration": "1 s"}, "duration 1 s: expected at least 5 s, 500 samples, which a fit needs"),
        ({"white": 1.0, "for_": "0 %"}, "for_ 0 %: expected a share above 0"),
        ({"white": 1.0, "duration": -1.0}, "duration -1 s: expected more than 0"),
        ({"white": 1.0, "rate": 0.0}, "rate 0 Hz: expected 0.001"),
    ],
)
def test_what_cannot_be_is_refused(options, message):
    with pytest.raises(OptionError) as refused:
        il.plan_noise(**options)
    assert str(refused.value).startswith(message)


def test_the_command_plans_and_refuses_in_one_line(record, tmp_path, capsys):
    record.save(tmp_path / "r.json")
    plan = ["noise", "plan", "--from", str(tmp_path / "r.json")]
    assert main([*plan, "--for", "walk=10%"]) == 0
    assert "gyro_z  rate random walk              not seen" in capsys.readouterr().out
    assert main([*plan, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)["terms"]
    assert {each["unit"] for each in said} == {"rad/s/sqrt(Hz)", "rad/s", "rad/s/sqrt(s)"}
    assert [each["wanted"] for each in said] == [0.1] * len(said)
    for words, message in (
        (["--for", "wlak=10%"], "--for wlak: not among the terms; expected flicker walk white; did you mean 'walk'?"),
        (["--white", "1"], "--white: the record says that already"),
        (["-o", str(tmp_path / "p.html")], "p.html: expected a name that ends in .csv"),
        (["--columns", "gyro_w"], "--columns gyro_w: the record has gyro_x gyro_y gyro_z"),
    ):
        assert main([*plan, *words]) == 2
        captured = capsys.readouterr()
        assert (captured.out, captured.err.count("\n")) == ("", 1)
        assert message in captured.err


def test_a_record_of_another_procedure_is_refused_by_the_name_of_the_option(tmp_path, capsys):
    il.fit_tumble(il.simulate_tumble(gravity=9.81), order=1, gravity=9.81).save(tmp_path / "t.json")
    assert main(["noise", "plan", "--from", str(tmp_path / "t.json")]) == 2
    assert "--from: a tumble record; expected one of noise fit" in capsys.readouterr().err


def test_a_plan_is_no_shorter_than_what_a_fit_takes():
    """500 samples, and 100 s for what is slow; what a record does not tell has no percentage."""
    plan = il.plan_noise(white="0.3 deg/sqrt(h)", walk="3000 deg/h/sqrt(h)", for_="50 %", rate=50.0)
    assert [each.length for each in plan.terms] == [pytest.approx(10.0), pytest.approx(100.0)]
    short = il.plan_noise(white="0.3 deg/sqrt(h)", walk="10 deg/h/sqrt(h)", duration="10 s")
    assert short.shown()[2][1][4] == "not told"

"""Plans of a calibration over temperature: temperatures, attitudes by exchange, and whether the promise is kept."""

import json

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.procedures.thermal.gyro import fit_gyroscopes
from imulab.procedures.thermal.model import Laws
from imulab.procedures.thermal.plan import Design, exchange_attitudes, legendre_nodes, order_soaks
from imulab.procedures.thermal.solve import ThermalProblem, solve
from imulab.procedures.tumble.plan import sphere_candidates
from reference import thermal as reference
from reference import thermal_gyro as reference_gyro
from reference.thermal import directions
from test_thermal_gyro import at_rest

G = reference.G


LAWS = Laws(-20.0, 60.0, (3, 2, 1))


def test_temperatures_are_ends_and_extrema_of_the_legendre_polynomial():
    """P4 = (35 x^4 - 30 x^2 + 3) / 8 has its extrema at 0 and +-sqrt(3/7): -20, -6, 20, 46 and 60 degC."""
    assert legendre_nodes(5) == pytest.approx([-1, -np.sqrt(3 / 7), 0, np.sqrt(3 / 7), 1], abs=1e-12)
    plan = il.plan_thermal("-20,60", time="6 h", turn_on_scatter=0.0)
    assert sorted({round(soak.temperature, 1) for soak in plan.soaks}) == [-20.0, -6.2, 20.0, 46.2, 60.0]


def test_soaks_beyond_the_temperatures_come_back_to_inner_ones_from_the_other_side():
    assert order_soaks(5, 6) == [0, 1, 2, 3, 4, 2]
    assert order_soaks(5, 8) == [0, 1, 2, 3, 4, 3, 2, 1]
    assert order_soaks(5, 12) == [0, 1, 2, 3, 4, 3, 2, 1, 0, 1, 2, 3]
    soaks = il.plan_thermal(time="8 h").soaks
    assert [soak.warming for soak in soaks] == [False, True, True, True, True, False, False, False]


def test_as_many_offsets_tell_the_turn_on_scatter_as_the_fit_of_these_soaks_finds():
    """Three for each soak beyond what the laws of the biases take, whatever the degrees of the others."""
    plan = il.plan_thermal(time="8 h", degrees=(1, 2, 0))
    assert len(plan.soaks) == 8
    made = il.simulate_thermal([soak.temperature for soak in plan.soaks])
    fit = il.fit_thermal(made, degrees="1,2,0").calibration.fit
    assert fit["between_recordings"]["rank"] == 18
    assert "18 independent offsets will tell the turn-on scatter" in plan.lead


def worst(temperatures, sets=None, tau=0.0):
    design = Design(LAWS, np.asarray(temperatures), tau)
    found = (
        [design.covariance(sets)]
        if sets
        else [
            exchange_attitudes(design, sphere_candidates(), [8] * len(temperatures), seed)[1] for seed in (1, 2, 3, 4)
        ]
    )
    return min(design.deviations(each).max() for each in found)


def test_exchange_does_what_was_found_for_it():
    """5 temperatures, 8 attitudes: 0.98 of an attitude's noise at worst, evenly spaced 1.03, spirals 1.08 to 1.33."""
    at = LAWS.middle + LAWS.half * legendre_nodes(5)
    assert worst(at) == pytest.approx(0.98, abs=0.015)
    assert worst(np.linspace(-20, 60, 5)) == pytest.approx(1.03, abs=0.015)
    rng = np.random.default_rng(1)
    spirals = [worst(at, [reference.directions(rng, 8) for _ in at]) for _ in range(8)]
    assert min(spirals) > 1.05
    assert 1.12 < np.mean(spirals) < 1.3


def test_recordings_count_more_than_attitudes_where_biases_scatter():
    """tau 0.1 mg, 60 ug: 5x60 is worth 100 ug at its worst, 9 temperatures with 8 each 91 to 93."""
    at, tau = LAWS.middle + LAWS.half * legendre_nodes(5), 100 / 60
    rng = np.random.default_rng(1)
    assert 60 * worst(at, [reference.directions(rng, 60) for _ in at], tau) == pytest.approx(100, abs=2)
    assert 60 * worst(LAWS.middle + LAWS.half * legendre_nodes(9), tau=tau) == pytest.approx(92, abs=2)


@pytest.mark.parametrize("tau", [pytest.param(0.0, marks=pytest.mark.slow), 1e-4])
def test_the_stated_deviation_is_that_of_simulated_tests(tau, reduced):
    """Within 5 %, over 100 units measured by the plan, in the mean over temperature and at its worst."""
    trials = 64 if reduced else 100
    plan = il.plan_thermal("-20,60", time="5 h", soak="52 min", noise="60 ug", turn_on_scatter=tau * 9.80665)
    at, squares = plan.temperature[::5], []
    place = np.repeat([soak.temperature for soak in plan.soaks], [len(soak.directions) for soak in plan.soaks])
    number = np.repeat(np.arange(len(plan.soaks)), [len(soak.directions) for soak in plan.soaks])
    up = np.vstack([soak.directions for soak in plan.soaks])
    for trial in range(trials):
        rng = np.random.default_rng([3, trial])
        triad = reference.Triad(rng)
        offset = tau * G * rng.standard_normal((len(plan.soaks), 3))
        means = [triad.output(G * u, t, offset[k]) for u, t, k in zip(up, place, number, strict=True)]
        n = len(up)
        problem = ThermalProblem(
            reading=(np.array(means) + 60e-6 * G * rng.standard_normal((n, 3))) / G,
            covariance=np.tile(np.eye(3) * 60e-6**2, (n, 1, 1)), temperature=place, rate=np.zeros(n), step=np.zeros(n),
            shared=np.ones(n, dtype=bool), recording=number, group=np.full(n, -1), tilt=2e-4, zero=np.zeros(3),
        )  # fmt: skip
        found = LAWS.design(at) @ solve(problem, LAWS, tau=tau).coefficients
        for row, t in zip(found, at, strict=True):
            force = reference.directions(rng, 1)[0]
            seen = triad.output(G * force, t) / G
            x = seen[0] / row[3] - row[0]
            y = seen[1] / row[4] - row[1] - row[6] * x
            z = seen[2] / row[5] - row[2] - row[7] * x - row[8] * y
            squares.append(((np.array([x, y, z]) - force) ** 2).mean())
    found = np.sqrt(np.array(squares).reshape(trials, -1).mean(axis=0)) * 9.80665
    stated = plan.deviation[::5]
    assert np.sqrt((found**2).mean() / (stated**2).mean()) == pytest.approx(1, abs=0.05)


def test_a_plan_goes_all_the_way(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = ["thermal", "plan", "--time", "6 h", "-o", "plan.csv", "--report", "plan.html"]
    assert main(arguments, project=False) == 0
    said = capsys.readouterr().out
    assert "corrected force at -20 degC" in said
    assert "reached by" in said
    assert main(["thermal", "plan", "--time", "6 h", "--json"], project=False) == 0
    made = json.loads(capsys.readouterr().out)
    table = il.read("plan.csv")
    assert len(table) == sum(len(soak["up"]) for soak in made["soaks"])
    assert table.triad("up") == pytest.approx(np.vstack([soak["up"] for soak in made["soaks"]]), abs=1e-6)
    page = (tmp_path / "plan.html").read_text(encoding="utf-8")
    assert page.count("<h3>") == len(made["soaks"])
    assert page.count("<svg") == len(table)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--time", "2 h"], "--time 120 min: allows 2 soaks of 45 min"),
        (["--time", "-2 h"], "expected more than 0 s"),
        (["--attitude", "0"], "--attitude 0 s: expected more than 0 s"),
        (["--temperatures=60,-20"], "--temperatures '60,-20': expected the lowest and the highest"),
        (["--temperatures=20,25"], "10 K or more apart"),
        (["--temperatures=253,333"], "-100 to 150 degC"),
        (["--temperatures=cold,warm"], "--temperatures 'cold,warm': expected numbers"),
        (["--temperatures=0,20"], "would lie within 5 K of each other"),
        (["--degrees", "auto"], "--degrees 'auto': a plan needs degrees"),
        (["--degrees", "3,2"], "expected auto, or the degrees"),
        (["--noise", "0"], "expected more than 0"),
        (["--noise", "2 m"], "--noise '2 m': expected a number, or one with a unit of acceleration"),
        (["--turn-on-scatter", "-1 mg"], "--turn-on-scatter '-1 mg': expected 0 or more"),
        (["--from", "head:90"], "cannot separate the coefficients"),
        (["-o", "plan.html"], "expected a name that ends in .csv"),
    ],
)
def test_what_cannot_be_planned_is_refused_in_one_line(options, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["thermal", "plan", *options], project=False) == 2
    refused = capsys.readouterr().err
    assert said in refused
    assert refused.count("\n") == 1
    assert not list(tmp_path.iterdir())


WALK = np.radians(0.05) / np.sqrt(50)  # rad/sqrt(s), of what `simulate_thermal` makes


HOLD = 6.0


TAU = np.radians(0.01)


def planned(soaks, attitudes, tau):
    """A plan for so many soaks, whose attitudes are the simulator's six seconds of rest."""
    time = soaks * (2700.0 + attitudes * HOLD) + 1.0
    return il.plan_thermal(
        time=time, attitude=HOLD, with_="gyro", gyro_noise=WALK, gyro_turn_on_scatter=tau, degrees=(3, 2, 1)
    )


@pytest.mark.parametrize("tau", [0.0, TAU])
def test_a_simulated_test_states_what_was_planned(tau):
    """Within 5 %: that of a rate at rest, its bias and g-sensitivity, in the mean over temperature and at its worst."""
    plan = planned(5, 12, tau)
    assert [len(soak.directions) for soak in plan.soaks] == [12] * 5
    made = il.simulate_thermal([soak.temperature for soak in plan.soaks], gyro=True, gyro_turn_on=tau)
    record = il.fit_thermal(made, degrees="3,2,1", with_="gyro", gyro_turn_on_scatter=tau).calibration
    assert record.model["gyro"]["g_sensitivity"]
    offset = np.clip(plan.temperature, *record.model["range"]) - record.model["reference_temperature"]["value"]
    powers, variances = offset[:, None] ** np.arange(4), []
    for axis in "xyz":
        own = record.cov(*(f"gyro_bias_{axis}" + (f"_t{k}" if k else "") for k in range(4)))
        felt = record.cov(*(f"gyro_g_sensitivity_{axis}{other}" for other in "xyz")) * 9.80665**2
        variances.append(np.einsum("mi,ij,mj->m", powers, own, powers) + np.trace(felt) / 3)
    stated = np.sqrt(np.mean(variances, axis=0))
    assert stated.max() == pytest.approx(plan.gyro.deviation.max(), rel=0.05)
    assert np.sqrt(np.mean(stated**2)) == pytest.approx(plan.gyro.mean, rel=0.05)
    assert record.fit["gyro"]["turns"]["turns"] == plan.gyro.turns == 55
    assert plan.gyro.turned_at == 5


@pytest.mark.slow
def test_errors_of_simulated_units_are_what_was_planned(reduced):
    """Of 200 units written apart, whose Earth has a direction of its own in each attitude."""
    plan, errors = planned(5, 12, TAU), []
    places = plan.temperature[::5]
    for trial in range(60 if reduced else 200):
        rng = np.random.default_rng([17, trial])
        gyros = reference_gyro.Gyros(rng)
        given = at_rest(rng, gyros, [soak.temperature for soak in plan.soaks], 12, TAU, WALK / np.sqrt(HOLD))
        found = fit_gyroscopes(given, -20.0, 60.0, (3, 2, 1), TAU, "unit")
        for up in directions(rng, 4):
            felt = np.zeros(3)
            if found.sensitivity:
                felt = (found.sensitivities(reference_gyro.G) - gyros.sensitivity) @ (reference_gyro.G * up)
            errors.append(found.at_rest(places) - gyros.bias_at(places) + felt)
    off = np.sqrt(np.mean(np.square(errors), axis=(0, 2)))
    assert np.sqrt(np.mean(off**2)) == pytest.approx(np.sqrt(np.mean(plan.gyro.deviation[::5] ** 2)), rel=0.05)


def test_what_the_soaks_tell_of_scale_factors_is_said(capsys):
    assert main(["thermal", "plan", "--with", "gyro", "--time", "5 h"], project=False) == 0
    said = capsys.readouterr().out
    assert "70 turns at 5 temperatures will tell scale factors, and how they follow it." in said
    assert "corrected rate at -20 degC" in said
    assert main(["thermal", "plan", "--with", "gyro", "--time", "5 h", "--attitude", "2 min"], project=False) == 0
    said = capsys.readouterr().out
    assert "No soak has the 9 attitudes whose turns tell scale factors: these soaks with as many take 5.25 h." in said
    assert main(["thermal", "plan", "--time", "5 h"], project=False) == 0
    assert "rate" not in capsys.readouterr().out
    lone = ["thermal", "plan", "--with", "gyro", "--time", "315 min", "--soak", "55 min", "--attitude", "70 s"]
    assert main([*lone, "--json"], project=False) == 0
    made = json.loads(capsys.readouterr().out)
    counts = [len(soak["up"]) for soak in made["soaks"]]
    assert made["gyro"]["turns"] == sum(count - 1 for count in counts if count >= 9)
    assert made["gyro"]["mean"]["unit"] == "rad/s"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--with", "mag"], "--with 'mag': expected gyro"),
        (["--with", "gyro", "--gyro-noise", "0"], "--gyro-noise '0': expected more than 0"),
        (["--with", "gyro", "--gyro-noise", "2 m"], "--gyro-noise '2 m': expected a number with one of deg/sqrt(h)"),
        (["--with", "gyro", "--gyro-turn-on-scatter=-1"], "--gyro-turn-on-scatter '-1': expected 0 or more"),
        (["--gyro-noise", "0.3"], "--gyro-noise: no gyroscopes are planned; expected --with gyro beside it"),
        (["--gyro-turn-on-scatter", "0.01"], "--gyro-turn-on-scatter: no gyroscopes are planned; expected --with gyro"),
    ],
)
def test_what_cannot_be_planned_of_gyroscopes_is_refused_in_one_line(options, said, capsys):
    assert main(["thermal", "plan", *options], project=False) == 2
    refused = capsys.readouterr().err
    assert said in refused
    assert refused.count("\n") == 1

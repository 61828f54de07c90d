"""What a plan over temperature promises of the gyroscopes, against simulated tests."""

import json

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.procedures.thermal.gyro import fit_gyroscopes
from reference import thermal_gyro as reference
from reference.thermal import directions
from test_thermal_gyro import at_rest

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
        gyros = reference.Gyros(rng)
        given = at_rest(rng, gyros, [soak.temperature for soak in plan.soaks], 12, TAU, WALK / np.sqrt(HOLD))
        found = fit_gyroscopes(given, -20.0, 60.0, (3, 2, 1), TAU, "unit")
        for up in directions(rng, 4):
            felt = np.zeros(3)
            if found.sensitivity:
                felt = (found.sensitivities(reference.G) - gyros.sensitivity) @ (reference.G * up)
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

"""How long a rest ramp should last: against closed forms, noise that is drawn, and what fits state afterwards."""

import json
import math
import re

import numpy as np
import pytest
from tests.reference.rest_ramp import flicker

import imulab as il
from imulab.cli import main
from imulab.errors import OptionError

DEG_H = math.radians(1) / 3600


def test_white_noise_gives_the_closed_form():
    # Of a law of degree p over n even parts, the mean over the parts of its variance is (p + 1) / n of one part's.
    plan = il.plan_ramp(degree=0, gyro_noise="0.6 deg/sqrt(h)", instability=0.0, walk=0.0, wanted="5 deg/h")
    for each in plan.others:
        assert each.law == pytest.approx(0.6 / math.sqrt(each.duration / 3600) * DEG_H, rel=1e-9)
    cubic = il.plan_ramp(degree=3, gyro_noise="0.6 deg/sqrt(h)", instability=0.0, walk=0.0, wanted="5 deg/h")
    for flat, bent in zip(plan.others, cubic.others, strict=True):
        assert bent.law == pytest.approx(4 * flat.law, rel=0.01)  # p + 1 at the ends of endlessly many parts
    assert cubic.chosen.bias == pytest.approx(math.hypot(cubic.chosen.law, 7.292115e-5 / math.sqrt(3)))


def test_drawn_noise_is_as_large_as_predicted():
    rng = np.random.default_rng(5)
    parts, duration, walk = 48, 1200.0, 40.0 / 60 * DEG_H
    white, instability = 0.3 / 60 * math.radians(1), 20 * DEG_H
    plan = il.plan_ramp(degree=1, gyro_noise=white, instability=instability, walk=walk, wanted="60 deg/h")
    predicted = next(each.law for each in plan.others if each.duration == duration)
    place = (np.arange(parts) + 0.5) / parts
    design = np.column_stack([np.ones(parts), 2 * place - 1])
    ends = []
    for _ in range(400):
        fine = 50
        # One-sided density B^2 / (pi f): over the lines that the series holds, its variance is the sum of these.
        slow = flicker(parts * fine, rng)
        lines = np.arange(1, 2 * parts * fine + 1) / (4 * parts * fine)
        slow *= instability * math.sqrt(np.sum(1 / lines) / (4 * parts * fine) / math.pi)
        steps = walk * math.sqrt(duration / parts / fine) * rng.standard_normal(parts * fine)
        noise = (slow + np.cumsum(steps)).reshape(parts, fine).mean(axis=1)
        noise += white / math.sqrt(duration / parts) * rng.standard_normal(parts)
        law = design @ np.linalg.lstsq(design, noise)[0]
        ends.append(law[[0, -1]])
    found = np.sqrt(np.mean(np.square(ends), axis=0)).max()
    assert 0.9 < found / predicted < 1.3  # least squares without weights is a little worse


def test_what_is_chosen_is_the_shortest_that_serves_and_slow():
    plan = il.plan_ramp("10,50", wanted="8 deg/h")
    assert plan.chosen.law <= plan.wanted
    assert plan.chosen.rate <= 2.01 / 60
    shorter = [each for each in plan.others if each.duration < plan.chosen.duration]
    assert all(each.law > plan.wanted or each.rate > 2.01 / 60 for each in shorter)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--wanted", "1 deg/h"], "the best of a day"),
        (["--temperatures", "10,12"], "10 K apart"),
        (["--temperatures", "50,10"], "10 K apart"),
        (["--degree", "9"], "expected 0 to 5"),
        (["--walk", "3m"], "deg/h/sqrt"),
        (["--gyro-noise", "0"], "above 0"),
    ],
)
def test_refusals(arguments, words, capsys):
    assert main(["thermal", "ramp", *arguments]) == 2
    error = capsys.readouterr().err
    assert len(error.splitlines()) == 1
    assert re.search(words, error)


def test_the_command_prints_json_in_si(capsys):
    assert main(["thermal", "ramp", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["duration"]["unit"] == "s"
    assert content["law"]["value"] <= content["wanted"]["value"]
    with pytest.raises(OptionError, match="no attitudes"):
        il.plan_ramp().save("x.csv")

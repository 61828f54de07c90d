"""Whole turns by hand with accelerometers: the axis of each turn, misalignments, and both triads in one record."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.procedures.rate.turns import _scattered
from reference import rate as reference
from test_rate_accel import ARM, BIAS, SCALE, TURN, G, accel, of_another_unit

__all__ = ["accel"]
FREQUENCY = 100.0
LEAN = np.array([[0.02, -0.03, 1.0], [1.0, 0.015, -0.01], [-0.025, 1.0, 0.02]])
"""Of the vertical on the faces z, x and y: by up to 2 deg."""


def hand(counts=(1, -1), noise=0.0, force_noise=0.0, seed=1, tilt=5e-3, stops=0.0, axes=LEAN, arm=ARM):
    rng = np.random.default_rng(seed)
    off = stops * rng.standard_normal(3 * (len(counts) + 1)).reshape(3, -1)
    moved = np.diff(off, axis=1).ravel()
    rate, force = reference.hand_turns(axes, counts, FREQUENCY, arm, tilt, stops=moved)
    out = SCALE * (rate @ TURN.T + BIAS) + noise * rng.standard_normal(rate.shape)
    return il.Recording.from_arrays(
        gyro=out, accel=force + force_noise * rng.standard_normal(force.shape), rate=FREQUENCY,
        units={"gyro": "rad/s", "accel": "m/s^2"},
    )  # fmt: skip


def test_scale_factors_and_misalignments_are_those_of_the_turns(accel):
    """Axes that lean by 2 deg, a table 5 mrad off level, an arm of 6 cm and 240 deg/s at most."""
    found = il.fit_turns(hand(noise=1e-6), accel=accel).calibration
    for i, a in enumerate("xyz"):
        assert found.value(f"gyro_scale_factor_{a}") == pytest.approx(SCALE[i], rel=15e-6)
        for k, b in enumerate("xyz"):
            if i != k:
                assert found.value(f"gyro_misalignment_{a}{b}") == pytest.approx(TURN[i, k], abs=1e-5)


def test_a_record_of_another_unit_is_said_to_be(accel):
    """By its serial number, and by |f|: 14 mg off g, where 2 mg are what a power cycle may do."""
    turns = hand(noise=1e-6, axes=np.eye(3)[[2, 0, 1]], arm=np.zeros(3))
    turns = dataclasses.replace(turns, metadata={"serial": "SIM"})
    (said,) = il.fit_turns(turns, accel=of_another_unit(accel)).calibration.verdict.reasons
    assert said.startswith("accel: the record is of serial SIM-0001, the recordings of SIM")
    (said,) = il.fit_turns(turns, accel=of_another_unit(accel, 14e-3 * G, "SIM")).calibration.verdict.reasons
    assert re.search(r"\|f\| is -14 mg off gravity in the turn at \d+.\d to \d+.\d s, more than its uncertainty", said)
    for record in (of_another_unit(accel, bias, "SIM") for bias in (0.0, 2e-3 * G)):
        assert il.fit_turns(turns, accel=record).calibration.verdict.state == "good"


def test_intervals_hold_the_misalignments(accel, reduced):
    trials = 12 if reduced else 40
    scores = []
    for seed in range(trials):
        made = hand((1, -1, 1, -1), 2e-3, 0.03, seed, stops=0.5 / np.sqrt(2), axes=LEAN)
        found = il.fit_turns(made, accel=accel).calibration
        for i, a in enumerate("xyz"):
            for name, true in [(f"gyro_scale_factor_{a}", SCALE[i])] + [
                (f"gyro_misalignment_{a}{b}", TURN[i, k]) for k, b in enumerate("xyz") if i != k
            ]:
                p = found.parameters[name]
                scores.append((name[5:8], (p.value - true) / p.standard_uncertainty))
    for kind in ("sca", "mis"):
        squares = np.mean([s**2 for k, s in scores if k == kind])
        assert 0.5 < squares < 1.6, (kind, squares)


def test_the_record_is_of_both_triads_and_corrects_both(accel, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    il.write(hand(noise=1e-4), "turns.csv")
    accel.save("accel.json")
    command = ["rate", "turn", "turns.csv", "--accel", "accel.json", "-o", "both.json", "--report", "both.html"]
    assert main(command, project=False) == 0
    assert "What is left of each turn" in Path("both.html").read_text(encoding="utf-8")
    capsys.readouterr()
    assert main(["show", "both.json"], project=False) == 0
    said = capsys.readouterr().out
    assert "gyro_misalignment_xy" in said
    assert "bias_x" in said
    assert "not stated" not in said
    p = il.load("both.json").parameters["gyro_misalignment_xy"]
    assert np.diff(p.interval_95)[0] == pytest.approx(2 * 1.959964 * p.standard_uncertainty, rel=1e-6)
    corrected = il.apply("both.json", "turns.csv")
    assert float(np.sum(corrected.si("gyro_z")[:700]) / FREQUENCY) == pytest.approx(2 * np.pi, abs=0.01)


REFUSED = {
    "no triad": ("without accelerometers", lambda a: il.fit_turns(hand(), accel=_bare(a))),
    "no columns": ("no column accel_x", lambda a: il.fit_turns(_without(hand()), accel=a)),
    "one face": ("no turns about x y", lambda a: il.fit_turns(_first(hand()), accel=a)),
    "on its side": ("by the accelerometers x is upright", lambda a: il.fit_turns(_swapped(hand()), accel=a)),
}


def _bare(record):
    kept = {name: p for name, p in record.parameters.items() if name != "bias_x"}
    return dataclasses.replace(record, parameters=kept)


def _without(made):
    return il.Recording({n: v for n, v in made.columns.items() if "accel" not in n}, made.units, name="turns.csv")


def _first(made):
    return il.Recording({n: v[:1500] for n, v in made.columns.items()}, made.units, name="turns.csv")


def _swapped(made):
    """Of each turn alone, gravity along another axis: constant, so that attitudes do not differ."""
    size = len(made)
    other = {"accel_x": np.full(size, 9.8), "accel_y": np.full(size, 0.1), "accel_z": np.full(size, 0.2)}
    return il.Recording({**made.columns, **other}, made.units, name="turns.csv")


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_is_refused_in_a_line(name, accel):
    said, call = REFUSED[name]
    with pytest.raises(il.ImulabError, match=said) as refused:
        call(accel)
    assert "\n" not in str(refused.value)


def test_turns_without_noise_state_what_is_left_and_divide_by_nothing():
    count = np.array([3.0, -3.0, 5.0])
    left = np.array([[0.0, 1e-6, 2e-16], [0.0, -2e-6, 0.0], [0.0, 1e-6, 0.0]])
    with np.errstate(all="raise"):
        found = _scattered(left, count, np.zeros((3, 3)))
    assert (found > 0).all()
    assert (found[[0, 2]] < 1e-11).all()
    # no weights but the turns made, which the least uncertainty follows: chi-square of left / count
    chi = np.sqrt(np.sum((left[:, 1] / count) ** 2) / 2)
    assert found[1] == pytest.approx(chi * np.sqrt(np.sum(count**4)) / np.sum(count**2), rel=1e-9)


def test_an_earlier_record_of_both_triads_is_joined_to_turns_with_accelerometers(accel):
    """Two alike tests as one have the mean of their scale factors, 1 / sqrt(2) as sure."""
    how = {"counts": (1, -1, 1, -1), "noise": 1e-3, "force_noise": 0.01, "stops": 0.35}
    first, second = (hand(**how, seed=seed) for seed in (11, 12))
    prior, alone = (il.fit_turns(one, accel=accel).calibration for one in (first, second))
    both = il.fit_turns(second, accel=accel, prior=prior).calibration
    assert "bias_x" in both.parameters
    assert any("the prior agrees" in warning for warning in both.warnings)
    for i, a in enumerate("xyz"):
        name = f"gyro_scale_factor_{a}"
        weight = np.array([one.parameters[name].standard_uncertainty ** -2.0 for one in (prior, alone)])
        mean = float(weight @ [prior.value(name), alone.value(name)] / weight.sum())
        found = both.parameters[name]
        assert found.value == pytest.approx(mean, abs=0.2 * found.standard_uncertainty)
        assert found.standard_uncertainty == pytest.approx(weight.sum() ** -0.5, rel=0.1)
        for k, b in enumerate("xyz"):
            if i != k:
                p = both.parameters[f"gyro_misalignment_{a}{b}"]
                assert abs(p.value - TURN[i, k]) < 4 * p.standard_uncertainty

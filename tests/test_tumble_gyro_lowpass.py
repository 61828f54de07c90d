"""Gyroscopes behind a low-pass filter: right, or said."""

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

import imulab as il
from imulab.display import Finding, Note
from reference.turns import GRAVITY, random_unit

RATE, FINE = 100, 8  # Hz, and steps of the filter in each sample
HIGHER = "a higher cut-off of the gyroscopes' filter"


def smooth(share):
    share = np.clip(share, 0, 1)
    return share - np.sin(2 * np.pi * share) / (2 * np.pi)


def body(rng, wander):
    """Body rate, rad/s, and direction of gravity at RATE * FINE: 24 holds, turned by hand in 0.5 to 1.5 s.

    A turn is one about an axis in the body, then, from a time within it, one about another by 30 deg * `wander` or so.
    """
    parts, attitude, old = [], Rotation.identity(), [np.array([0.0, 0.0, 1.0])]
    while len(old) < 24:
        first, second = rng.standard_normal((2, 3))
        first -= 0.8 * old[-1] * (first @ old[-1])
        first *= rng.uniform(np.radians(60), np.radians(150)) / np.linalg.norm(first)
        second *= wander * rng.normal(0, np.radians(30)) / np.linalg.norm(second)
        late = rng.uniform(0, 0.4)
        share = np.arange(int(rng.uniform(0.5, 1.5) * RATE * FINE))[:, None]
        share = share / len(share)
        begin, end = smooth(share / (1 - late / 2)), smooth((share - late) / (1 - late))
        new = attitude * Rotation.from_rotvec(first) * Rotation.from_rotvec(second)
        up = new.inv().apply([0.0, 0.0, 1.0])
        if max(up @ other for other in old) > np.cos(np.radians(18)) and rng.random() < 0.9:
            continue
        parts.append(np.tile(attitude.as_quat(), (int(rng.uniform(3, 4) * RATE * FINE), 1)))
        parts.append((attitude * Rotation.from_rotvec(begin * first) * Rotation.from_rotvec(end * second)).as_quat())
        attitude = new
        old.append(up)
    parts.append(np.tile(attitude.as_quat(), (3 * RATE * FINE, 1)))
    path = Rotation.from_quat(np.concatenate(parts))
    rate = np.append((path[:-1].inv() * path[1:]).as_rotvec() * RATE * FINE, np.zeros((1, 3)), axis=0)
    return rate, path.inv().apply([0.0, 0.0, 1.0])


def fitted(seed, cut_off=None, wander=0.0, knocks=0):
    """The fit of both triads, and the errors of scale factors and misalignments in standard uncertainties, (9,).

    A knock adds 5 deg or so to a turn that the gyroscopes see.
    """
    rng = np.random.default_rng(seed)
    unit = random_unit(rng)
    rate, up = body(rng, wander)
    if cut_off is not None:  # first order, in Hz
        pole = np.exp(-2 * np.pi * cut_off / (RATE * FINE))
        rate = lfilter([1 - pole], [1, -pole], rate, axis=0)
    size = len(rate) // FINE * FINE
    rate, up = (values[:size].reshape(-1, FINE, 3).mean(axis=1) for values in (rate, up))
    for at in rng.choice(np.flatnonzero(np.linalg.norm(rate, axis=1) > 1), knocks):
        bump = np.exp(-(((np.arange(len(rate)) - at) / 15) ** 2))
        rate = rate + bump[:, None] * rng.normal(0, np.radians(20), 3)
    gyro = unit.scale * (rate @ unit.misalignment.T + unit.bias) + rng.normal(0, np.radians(0.05), rate.shape)
    accel = unit.accel_scale * (GRAVITY * up + unit.accel_bias) + rng.normal(0, 0.7e-3 * GRAVITY, up.shape)
    columns = {"time": np.arange(len(gyro)) / RATE}
    columns |= {f"gyro_{a}": gyro[:, i] for i, a in enumerate("xyz")}
    columns |= {f"accel_{a}": accel[:, i] for i, a in enumerate("xyz")}
    units = {"time": "s"} | {n: "rad/s" if n[0] == "g" else "m/s^2" for n in columns if n != "time"}
    recording = il.Recording(columns, units, name="hand.csv")
    both = il.fit_gyro(il.fit_tumble(recording, order=1, gravity=GRAVITY).calibration, recording)
    i, j = np.nonzero(~np.eye(3, dtype=bool))
    found = np.concatenate([both.gyro.scale_factor, both.gyro.misalignment[i, j]])
    true = np.concatenate([unit.scale, unit.misalignment[i, j]])
    return both, (found - true) / np.sqrt(np.diag(both.gyro.covariance))[:9]


def of_filter(both):
    return [note for note in both.gyro.notes if "low-pass" in note]


@pytest.mark.parametrize("wander", [0.0, 1.0])
@pytest.mark.slow
def test_gyroscopes_without_a_filter_are_not_said_to_have_one(wander, reduced):
    for seed in range(3 if reduced else 10):
        both, z = fitted(seed, wander=wander)
        assert of_filter(both) == []
        assert np.abs(z).max() < 4.5


def test_turns_end_where_gyroscopes_have_settled(reduced):
    """At 1 Hz 0.2 % of each turn comes after the first second of the next hold: 7 standard uncertainties."""
    for seed in range(2 if reduced else 6):
        both, z = fitted(seed, cut_off=1.0)
        (note,) = of_filter(both)
        assert isinstance(note, Note)
        assert "go on turning for 1 s after the accelerometers come to rest" in note
        assert both.calibration.verdict.state == "good"
        assert np.abs(z).max() < 4.5


@pytest.mark.parametrize("cut_off", [0.3, 0.5])
@pytest.mark.slow
def test_holds_in_which_gyroscopes_do_not_settle_are_said(cut_off, reduced):
    for seed in range(2 if reduced else 6):
        both, _ = fitted(seed, cut_off=cut_off)
        (note,) = [note for note in of_filter(both) if "go on turning" in note]
        assert isinstance(note, Finding)
        assert "for 2 s" in note
        assert "or longer" in note
        assert any(HIGHER in step and "holds of 8 s" in step for step in both.calibration.verdict.next)
        assert both.calibration.verdict.state == "look"


@pytest.mark.slow
def test_a_filter_is_taken_off_turns_whose_axes_move(reduced):
    """At 5 Hz turns by hand missed by ten times their noise; those that missed most were said to be knocked."""
    for seed in range(2 if reduced else 6):
        both, z = fitted(seed, cut_off=5.0, wander=1.0)
        (note,) = of_filter(both)
        assert isinstance(note, Note)
        assert "which is taken off" in note
        assert len(both.gyro.aside) == 0
        assert np.median(both.gyro.residuals) < 0.4e-3
        assert both.calibration.verdict.state == "good"
        assert np.abs(z).max() < 4.5


@pytest.mark.parametrize("cut_off", [None, 5.0])
def test_knocked_turns_neither_look_like_a_filter_nor_hide_one(cut_off, reduced):
    """Turns that miss by degrees hid one of 5 Hz, and were blamed on one that changes rates by 100 %."""
    for seed in range(2 if reduced else 6):
        both, z = fitted(seed, cut_off, wander=1.0, knocks=3)
        assert ["which is taken off" in note for note in of_filter(both)] == [True] * (cut_off is not None)
        assert 1 <= len(both.gyro.aside) <= 3
        assert np.abs(z).max() < 4.5


@pytest.mark.slow
def test_a_filter_that_is_too_slow_for_the_turns_is_said(reduced):
    for seed in range(2 if reduced else 6):
        both, _ = fitted(seed, cut_off=1.0, wander=1.0)
        (note,) = [note for note in of_filter(both) if "too much to be taken off" in note]
        assert isinstance(note, Finding)
        assert any(HIGHER in step and "slower turns" in step for step in both.calibration.verdict.next)
        assert both.calibration.verdict.state == "look"

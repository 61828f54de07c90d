"""Changes of a log at rest that are no noise: steps, the drift of warming up, noise that grows louder."""

import numpy as np
import pytest

import imulab as il

RATE, WHITE = 50.0, 0.005
"""Samples per second, and white noise in deg/s/sqrt(Hz), of the logs here, which are drawn in time."""


def log(seed, drift=0.0, walk=0.0, louder=1.0, length=1200.0):
    """Three gyroscopes at rest, deg/s: each gets the drift, a function's values over time, in its own size."""
    rng = np.random.default_rng(seed)
    time = np.arange(int(length * RATE)) / RATE
    x = WHITE * np.sqrt(RATE) * rng.standard_normal((len(time), 3))
    if walk:
        x += walk / np.sqrt(RATE) * np.cumsum(rng.standard_normal((len(time), 3)), axis=0)
    if callable(drift):
        x += drift(time)[:, None] * np.array([1.0, -0.6, 0.8])
    x[len(time) // 2 :] *= louder
    return x


def fit(x):
    return il.fit_noise({"gyro": x}, rate=RATE, unit="deg/s").calibration


@pytest.mark.parametrize("seed", [1, 4, 8])
def test_a_walk_that_hardly_shows_is_not_taken_for_a_step(seed):
    """Of 60 such logs a step was said of 18, and is of 2."""
    record = fit(log(seed, walk=1e-4))
    assert record.verdict.state == "good"


@pytest.mark.parametrize(("size", "time"), [(0.01, 120.0), (0.03, 240.0)])
def test_a_sensor_that_warms_up_has_no_walk(size, time):
    """Of 20 such logs 1 and 17 were good, with a random walk that is not there."""
    x = log(3, drift=lambda t: size * np.exp(-t / time))
    record = fit(x)
    assert record.verdict.state == "look"
    (finding,) = [each for each in record.warnings if each.startswith("gyro_x: drifts by -")]
    words = finding.split()
    assert float(words[3]) == pytest.approx(-3600 * size, rel=0.3)
    assert float(words[words.index("of") + 1]) == pytest.approx(time, rel=0.4)
    assert any("leave out the first" in each or "record again once" in each for each in record.verdict.next)


def test_what_is_left_after_the_advice_is_good():
    x = log(3, drift=lambda t: 0.03 * np.exp(-t / 60.0))
    (action,) = {each for each in fit(x).verdict.next if each.startswith("leave out the first")}
    seconds = float(action.split()[4])
    record = fit(x[int(seconds * RATE) :])
    assert record.verdict.state == "good"
    assert set(record.model["terms"].values()) == {"N"}


def test_a_ramp_and_a_walk_are_no_warm_up():
    for x in (log(4, drift=lambda t: 2e-5 * t), log(4, walk=3e-4)):
        assert not any("warming up" in each for each in fit(x).warnings)


@pytest.mark.parametrize(("louder", "state"), [(1.5, "look"), (0.7, "look"), (1.05, "good"), (1.0, "good")])
def test_noise_that_is_louder_from_some_time_on_is_said(louder, state):
    """Of 20 logs that grow 1.5 times louder 19 were good, and say so now; less than a tenth is not said."""
    record = fit(log(5, louder=louder))
    assert record.verdict.state == state
    if state == "look":
        finding = next(each for each in record.warnings if "times as loud" in each).split()
        assert float(finding[finding.index("is") + 1]) == pytest.approx(louder, rel=0.03)
        assert float(finding[finding.index("from") + 1]) == pytest.approx(600.0, abs=20.0)

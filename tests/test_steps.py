"""Steps of the level: found where they are, and not in noise."""

import json

import numpy as np
import pytest

from imulab.cli import main
from imulab.estimation.rows import find_step


def noise(rng, n, exponent):
    """Noise whose power falls with the frequency to a power, of standard deviation 1 from sample to sample."""
    frequency = np.fft.rfftfreq(2 * n)
    frequency[0] = frequency[1]
    return np.fft.irfft(np.fft.rfft(rng.normal(size=2 * n)) * frequency ** (-exponent / 2))[:n]


KINDS = {
    "white": lambda rng, n: rng.normal(size=n),
    "flicker": lambda rng, n: noise(rng, n, 1),
    "walk": lambda rng, n: np.cumsum(rng.normal(size=n)),
    "white and flicker": lambda rng, n: rng.normal(size=n) + 0.3 * noise(rng, n, 1),
    "white and walk": lambda rng, n: rng.normal(size=n) + 0.01 * np.cumsum(rng.normal(size=n)),
    "counts": lambda rng, n: np.round(0.2 * rng.normal(size=n)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_noise_has_no_steps(kind):
    rng = np.random.default_rng(7)
    trials = 300
    false = sum(find_step(KINDS[kind](rng, n)) is not None for n in (5000, 20_000) for _ in range(trials // 2))
    assert false <= 0.01 * trials


HOUR = np.arange(90_000) / 90_000
DRIFTS = {
    "short exponential": 0.05 * np.exp(-HOUR * 3600 / 30),
    "exponential": 0.05 * np.exp(-HOUR * 3600 / 100),
    "long exponential": 0.05 * np.exp(-HOUR * 3600 / 300),
    "large exponential": 5 * np.exp(-HOUR * 3600 / 100),
    "two exponentials": 0.1 * np.exp(-HOUR * 3600 / 60) + 0.1 * np.exp(-HOUR * 3600 / 600),
    "fourth order": 0.3 * HOUR**4,
    "ramp of the temperature": 0.3 * np.clip((HOUR - 0.3) / 0.15, 0, 1),
    "from level to level": 0.3 * np.tanh((HOUR - 0.5) * 12),
}


@pytest.mark.parametrize("kind", DRIFTS)
def test_a_drift_is_no_step(kind, reduced):
    """Warm-up drifts of an hour, in noise of 0.1 from sample to sample at 25 Hz."""
    trials = 4 if reduced else 10
    rng = np.random.default_rng(10)
    assert sum(find_step(DRIFTS[kind] + 0.1 * rng.normal(size=90_000)) is not None for _ in range(trials)) == 0


def test_a_step_on_a_drift_is_found(reduced):
    trials = 8 if reduced else 20
    rng = np.random.default_rng(11)
    found = 0
    for _ in range(trials):
        samples = DRIFTS["long exponential"] + 0.1 * rng.normal(size=90_000)
        at = int(rng.integers(20_000, 80_000))
        samples[at:] += 0.06
        step = find_step(samples)
        found += step is not None and abs(step.sample - at) <= step.within
    assert found >= 0.8 * trials


def test_a_step_is_found_where_it_is_and_as_large_as_it_is(reduced):
    trials = 20 if reduced else 50
    rng = np.random.default_rng(8)
    missed = 0
    for _ in range(trials):
        at = int(rng.integers(3000, 17_000))
        samples = rng.normal(size=20_000)
        samples[at:] -= 0.6
        step = find_step(samples)
        if step is None:
            missed += 1
            continue
        assert abs(step.sample - at) < 1000
        assert step.size == pytest.approx(-0.6, abs=0.3)
    assert missed <= 0.1 * trials


@pytest.mark.parametrize("samples", [np.zeros(5000), np.ones(10), np.arange(5000.0)])
def test_what_has_no_noise_has_no_step_either(samples):
    assert find_step(samples) is None


def test_allan_says_that_a_step_is_no_noise(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(9)
    rates = rng.normal(0, 0.05, (12_000, 2))
    rates[7000:, 1] += 0.1
    rows = np.column_stack([np.arange(12_000) / 100, rates])
    np.savetxt("a.csv", rows, "%.9g", ",", header="time [s],gyro_x [deg/s],gyro_y [deg/s]", comments="")
    assert main(["allan", "a.csv", "--json"]) == 0
    out, error = capsys.readouterr()
    (line,) = [line for line in error.splitlines() if "level" in line]
    assert line.startswith(
        "imulab: warning: a.csv: column gyro_y: the level changes by 0.098 deg/s within 1.8 s near 69.92 s"
    )
    assert "gyro_x" not in line
    walk = json.loads(out)["columns"]["gyro_y"]["rate_random_walk"]["value"]
    assert walk > 0

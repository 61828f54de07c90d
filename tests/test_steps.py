"""Steps of the level: found where they are, and not in noise."""

import json

import numpy as np
import pytest

from imulab.cli import main
from imulab.estimation.steps import find_step


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


def test_a_step_is_found_where_it_is_and_as_large_as_it_is():
    rng = np.random.default_rng(8)
    missed = 0
    for _ in range(50):
        at = int(rng.integers(3000, 17_000))
        samples = rng.normal(size=20_000)
        samples[at:] -= 0.6
        step = find_step(samples)
        if step is None:
            missed += 1
            continue
        assert abs(step.sample - at) < 1000
        assert step.size == pytest.approx(-0.6, abs=0.3)
    assert missed <= 5


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
        "imulab: warning: a.csv: column gyro_y: the level changes at once by 0.098 deg/s near 69.92 s"
    )
    assert "gyro_x" not in line
    walk = json.loads(out)["columns"]["gyro_y"]["rate_random_walk"]["value"]
    assert walk > 0

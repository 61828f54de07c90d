"""Contaminated logs, drawn in the time domain, through all that a fit does: spikes, lines, band, terms."""

import numpy as np
import pytest
from scipy.signal import lfilter

import imulab as il
from noise_models import AUTO, IN_TIME
from reference import noise as reference

INTERVAL = 0.1
SIZE = 1 / np.sqrt(INTERVAL)
SMALL = 1e-3


def contaminated(name, seed, count=100_000):
    """White and slow noise with 0.1 % spikes of 20 sigma and three lines of half a sigma."""
    rng = np.random.default_rng([seed, 77])
    samples = reference.draw(rng, IN_TIME[name], count, INTERVAL)
    struck = rng.random(count) < 1e-3
    samples[struck] += 20 * SIZE * rng.choice([-1, 1], np.count_nonzero(struck))
    time = INTERVAL * np.arange(count)
    for frequency in (0.31, 1.7, 3.3):
        samples += 0.5 * SIZE * np.sin(2 * np.pi * frequency * time + rng.uniform(0, 2 * np.pi))
    return samples


def sizes(samples, terms):
    """The terms of samples whose white noise is 1, fitted as a thousandth of that in rad/s: no gyro is louder."""
    record = il.fit_noise({"gyro_x": SMALL * samples}, rate=1 / INTERVAL, unit="rad/s", terms=terms).calibration
    return {name.removeprefix("gyro_x_"): each.value / SMALL for name, each in record.parameters.items()}, record


@pytest.mark.slow
@pytest.mark.parametrize(("name", "term", "within"), [("N B", "flicker", 0.03), ("N K", "walk", 0.05)])
def test_spikes_and_lines_change_neither_white_nor_slow_noise(name, term, within, reduced):
    """N within 0.5 % and B within 3 % (K: one log tells it to 14 %), whatever is on top."""
    trials = 12 if reduced else 60
    found = [sizes(contaminated(name, seed), name.replace(" ", ""))[0] for seed in range(trials)]
    white = np.array([each["white"] for each in found])
    slow = np.array([each[term] for each in found]) / AUTO[name][1 if term == "flicker" else 2]
    print(name, "N", white.mean(), "slow", slow.mean())
    assert abs(white.mean() - 1) < 0.005
    assert abs(np.log(slow).mean()) < within + 2.5 * np.log(slow).std() / np.sqrt(trials)


def test_a_contaminated_log_is_told_for_what_it_is():
    """The noise of the truth, the spikes counted, the lines by frequency."""
    found, record = sizes(contaminated("N B", 1), "auto")
    assert found["white"] == pytest.approx(1, rel=0.01)
    assert found["flicker"] == pytest.approx(AUTO["N B"][1], rel=0.2)
    spikes, lines = (next(note for note in record.warnings if word in note) for word in ("spikes", "lines"))
    assert 70 < int(spikes.split(": ")[1].split()[0]) < 140
    assert all(f in lines for f in ("0.31 Hz", "1.7 Hz", "3.3 Hz"))


def test_behind_a_filter_the_white_noise_of_low_frequencies_is_found():
    """A pole at a tenth of the rate, 10,000 s: what is white below it, to 3 %."""
    pole = np.exp(-2 * np.pi * 0.1)
    samples = reference.draw(np.random.default_rng(4), IN_TIME["N K"], 100_000, INTERVAL)
    _, record = sizes(lfilter([1 - pole], [1, -pole], samples), "auto")
    assert record.fit["band"]["gyro_x"]["value"] < 1
    assert record.fit["filter_white"]["gyro_x"]["value"] == pytest.approx(SMALL, rel=0.03)
    assert any("on the spectrum is not level" in note for note in record.warnings)


@pytest.mark.parametrize("corner", [2.0, 10.0])
def test_white_noise_that_no_octave_shows_has_an_interval_that_holds_it(corner, reduced):
    """A minute at 100 Hz behind the sensor's filter: the end of the band shows 1 %, or half of it too much."""
    trials = 3 if reduced else 8
    pole = np.exp(-2 * np.pi * corner / 100)
    held = []
    for seed in range(trials):
        drawn = np.random.default_rng([seed, 6]).standard_normal(8000)
        samples = SMALL * lfilter([1 - pole], [1, -pole], drawn)[2000:]
        record = il.fit_noise({"gyro_x": samples}, rate=100.0, unit="rad/s").calibration
        assert any("the spectrum is level nowhere" in note for note in record.warnings)
        white = record.parameter("gyro_x_white")
        held.append(white.interval_95[0] <= 0.1 * SMALL <= white.interval_95[1])
        assert white.value == 0 or white.standard_uncertainty > 0.1 * abs(white.value - 0.1 * SMALL)
    assert np.mean(held) > 0.8  # 0 of both before

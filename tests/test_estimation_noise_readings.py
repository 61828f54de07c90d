"""Logs at rest whose rows are no readings of their own, or whose unit cannot be right: said, or mended."""

import re

import numpy as np
import pytest
from scipy.signal import lfilter

import imulab as il
from imulab.errors import DataError
from imulab.estimation.noise.cleaning import knocks_removed, ordered_blocks
from imulab.estimation.noise.readings import doubtful_units, dropouts, own_readings
from imulab.estimation.noise.rest import at_rest, long_rest
from imulab.estimation.noise.simulate import simulated

SIGMA, COUNT = 0.1, 40_000


def recording(columns, unit="deg/s", rate=100.0):
    count = len(next(iter(columns.values())))
    units = {"time": "s"} | dict.fromkeys(columns, unit)
    return il.Recording({"time": np.arange(count) / rate, **columns}, units, name="log.csv")


def gyros(samples, unit="deg/s"):
    return recording({f"gyro_{axis}": column for axis, column in zip("xyz", samples.T, strict=True)}, unit)


def white(seed=1, count=COUNT, mean=(0.3, -0.2, 0.1)):
    return SIGMA * np.random.default_rng(seed).standard_normal((count, 3)) + mean


def density(record, name="gyro_x"):
    return np.degrees(record.value(f"{name}_white"))


@pytest.mark.parametrize("rows", [2, 3, 10])
@pytest.mark.parametrize("step", [0.0, 0.2])
def test_readings_that_stand_in_several_rows_count_once(rows, step):
    """A sensor of 0.1 deg/s at 100/k Hz, logged at 100 Hz, has N = 0.1 sqrt(k/100); two rows are lost."""
    x = white(rows, mean=(0, 0, 0))
    x = step * np.round(x / step) if step else x
    held = np.delete(np.repeat(x, rows, axis=0), [5 * rows + 1, 777 * rows], axis=0)
    record = il.fit_noise(gyros(held)).calibration
    assert density(record) == pytest.approx(x[:, 0].std() * np.sqrt(rows / 100), rel=0.02)
    assert record.fit["sample_rate"]["value"] == pytest.approx(100 / rows, rel=1e-3)
    (note,) = (line for line in record.warnings if "stands in" in line)
    many = len(own_readings(gyros(held), ["gyro_x", "gyro_y", "gyro_z"])[0])
    assert COUNT - 2 <= many <= COUNT
    assert note == (
        f"log.csv: every reading stands in {rows} rows, of a sensor slower than its log: fitted are the {many} "
        "readings, each once"
    )


def test_repeats_that_cannot_be_undone_are_said():
    x = white()
    irregular = gyros(x[np.floor(0.8 * np.arange(COUNT)).astype(int)])
    (note,) = own_readings(irregular, ["gyro_x", "gyro_y", "gyro_z"])[1]
    assert "log.csv: 20 % of the rows repeat the readings before, more than chance makes" in note
    one = own_readings(irregular, ["gyro_x"])[1]
    assert one == [note]
    mixed = gyros(np.column_stack([x[:, 0], np.repeat(x[: COUNT // 2, 1], 2), x[:, 2]]))
    left, (note,) = own_readings(mixed, ["gyro_x", "gyro_y", "gyro_z"])
    assert len(left) == COUNT
    assert "column gyro_y: every reading stands in 2 rows" in note
    assert "fitted alone (--columns)" in note
    assert il.fit_noise(irregular).calibration.verdict.state == "look"
    few = np.arange(COUNT) - (np.arange(COUNT) % 33 == 7)  # 3 %, which make the white noise 3 % too large
    assert "3 % of the rows repeat the readings before" in own_readings(gyros(x[few]), ["gyro_x", "gyro_y"])[1][0]


def test_noise_of_half_a_step_is_not_stuck_where_it_stays_on_its_level_by_chance():
    """At the middle of a step two of three readings are the same: 31 in a row, once in 100 logs of this length."""
    x = white(count=10_000)
    x[:, 0] = 0.1 * np.round(0.52 * np.random.default_rng(125).normal(size=10_000))
    assert np.diff(np.flatnonzero(np.diff(x[:, 0]))).max() > 30
    assert not [note for note in own_readings(gyros(x), ["gyro_x"])[1] if "keeps one value" in note]


@pytest.mark.parametrize("step", [0.0, 0.02, 0.1])
def test_a_column_that_is_stuck_for_a_while_is_said(step):
    """100 s of 400 s of one gyroscope; steps of up to its noise, and the others are noisy meanwhile."""
    x = white()
    x[10_000:20_000, 1] = x[10_000, 1]
    x = step * np.round(x / step) if step else x
    (note,) = own_readings(gyros(x), ["gyro_x", "gyro_y", "gyro_z"])[1]
    assert note.startswith("log.csv: column gyro_y keeps one value for 10000 rows, 100 to 199.99 s")
    assert il.fit_noise(gyros(x)).calibration.verdict.state == "look"


@pytest.mark.parametrize("mean", [0.0, 0.03, 0.1, 0.2, -0.1, 0.5])
@pytest.mark.parametrize("step", [0.0, 0.02, 0.05, 0.1, 0.3])
def test_noise_and_limits_are_no_dropouts_and_no_repeats(mean, step):
    """Whole counts, rounded or cut, limits at zero, and what a filter of 30 samples leaves."""
    rng = np.random.default_rng(3)
    for count in (1000, COUNT):
        x, y = SIGMA * rng.standard_normal((2, count)) + mean
        smooth = [np.convolve(each, np.ones(30) / 30, "same") for each in (x, y)]
        if step:
            x, y, *smooth = (step * np.round(each / step) for each in (x, y, *smooth))
            assert dropouts(step * np.trunc(y / step)) is None
        assert dropouts(x) is None
        assert dropouts(np.maximum(x, 0)) is None
        assert dropouts(np.minimum(x, 0)) is None
        for pair in ((x, y), smooth):
            columns = dict(zip(("gyro_x", "gyro_y"), pair, strict=True))
            for names in (["gyro_x"], ["gyro_x", "gyro_y"]):
                assert own_readings(recording(columns), names)[1] == []


def test_dropouts_written_as_zero_are_bridged_and_named():
    x = white(4, mean=(0.9, 0.5, 0.0))
    lost = np.random.default_rng(5).choice(COUNT, COUNT // 200, replace=False)
    x[lost] = 0
    record = il.fit_noise(gyros(x)).calibration
    for name in ("gyro_x", "gyro_y", "gyro_z"):
        assert density(record, name) == pytest.approx(0.01, rel=0.015)
    (note,) = (line for line in record.warnings if "zeros" in line)
    assert note == (
        f"log.csv: columns gyro_x gyro_y gyro_z: exact zeros in 200 rows, the first row {lost.min() + 1}, in place of "
        "lost readings: bridged by straight lines"
    )
    assert record.verdict.state == "look"
    x[: COUNT // 10] = 0
    with pytest.raises(DataError, match=r"row 1, column gyro_x: 10 % of the samples are exact zeros in place of lost"):
        il.fit_noise(gyros(x))


@pytest.mark.parametrize("kind", ["held", "dropouts"])
def test_a_long_log_of_such_rows_is_looked_at_as_a_whole(kind):
    x = white()
    if kind == "held":
        x = np.repeat(x, 2, axis=0)
    else:
        x[30_000:30_020] = 0
    log, names = gyros(x), ["gyro_x"]
    blocks = [
        il.Recording({n: c[k : k + 7000] for n, c in log.columns.items()}, log.units, name=log.name, first_row=k + 1)
        for k in range(0, len(log), 7000)
    ]
    assert long_rest(iter(blocks), names) is None
    assert at_rest(log, names).notes[0].startswith("log.csv: ")


LSB = 250 / 32768
"""deg/s, of a gyroscope of 16 bits for 250 deg/s."""


@pytest.mark.parametrize(
    ("samples", "unit", "words"),
    [
        (lambda: np.radians(LSB * np.round(white() / LSB)), "deg/s", "steps of 0.000133 deg/s, but many have 0.00763"),
        (lambda: np.radians(LSB * np.round(white() / LSB)).round(6), "deg/s", "as the same numbers make in rad/s"),
        (lambda: LSB * np.round(white() / LSB), "rad/s", "as the same numbers make in deg/s"),
        (white, "rad/s", "white noise of 0.57 deg/s/√Hz is more than that of any gyroscope"),
        (lambda: white(mean=(3.3, 0, 0)) / 60, "deg/s", "at rest, these 198 deg/h"),
        (lambda: white(mean=(0.0005, 0, 0)) / 60, "deg/s", ""),
        (
            lambda: white(mean=(2.3, -0.2, 0.1)) / 3000,
            "deg/s",
            "show the Earth's 15 deg/h and little more at rest, these 2.7",
        ),
        (lambda: white(mean=(12.3, -0.2, 0.1)) / 3000, "deg/s", ""),
        (lambda: white(mean=(0, 0, 0)) / 3000, "deg/s", ""),
        (lambda: LSB * np.round(white() / LSB), "deg/s", ""),
        (lambda: np.radians(LSB * np.round(white() / LSB)), "rad/s", ""),
        (lambda: white().round(4), "deg/s", ""),
        (lambda: white().round(2), "deg/s", ""),
    ],
)
def test_a_unit_that_can_hardly_be_right_is_said(samples, unit, words):
    notes = doubtful_units(gyros(samples(), unit), ["gyro_x", "gyro_y", "gyro_z"], 100.0)
    assert len(notes) == bool(words)
    if words:
        assert words in notes[0]
        assert notes[0].startswith("log.csv: gyro_x .. gyro_z: ")
        assert notes[0].endswith(f"; is their unit, {unit}, right?")


@pytest.mark.parametrize(
    ("unit", "size", "words"),
    [("m/s^2", 1.0, "as g would be"), ("g", 9.8, "as m/s^2 would be"), ("m/s^2", 1001.0, "as mg would be"),
     ("m/s^2", 9.79, ""), ("g", 1.02, ""), ("g", 0.85, ""), ("m/s^2", 0.0, "was it taken off"),
     ("m/s^2", 32.17, "as ft/s^2 would be"), ("g", 0.5, "1/2 of g, as counts or another range"),
     ("m/s^2", 19.62, "2 times g"), ("m/s^2", 16384 * 9.8, "16384 times g, as counts"),
     ("g", 0.7, "which is no gravity; is their unit"), ("count", 0.7, "")],
)  # fmt: skip
def test_accelerometers_at_rest_show_gravity(unit, size, words):
    x = size * np.array([0.0, 0.6, 0.8]) + 1e-3 * white()
    log = recording({f"accel_{axis}": x[:, k] for k, axis in enumerate("xyz")}, unit)
    notes = doubtful_units(log, ["accel_x", "accel_y", "accel_z"], 100.0)
    assert len(notes) == bool(words)
    assert all(words in note for note in notes)
    what = (
        "set the range"
        if "times g" in words or "1/2 of g" in words
        else "record the"
        if "taken off" in words
        else "state the right"
    )
    assert all(note.action.startswith(what) for note in notes)


def one_sided(t):
    return np.where(t < 0.4, 4.0 * SIGMA, 0.0)


def ringing(t):
    return 20 * SIGMA * np.exp(-t / 0.2) * np.sin(2 * np.pi * 15 * t)


@pytest.mark.parametrize("knock", [one_sided, ringing])
@pytest.mark.parametrize("size", [1.0, 5.0])
def test_a_knock_leaves_the_noise_as_it_is(knock, size):
    """0.4 s of ten minutes: the white noise was 4 to 9 % too small, beside a Gauss-Markov term that is none."""
    t = np.arange(60_000) / 100
    quiet = SIGMA * np.random.default_rng(7).standard_normal(60_000)
    part = quiet.copy()
    part[30_000:] += size * knock(t[:30_000])
    whole, knocked = (il.fit_noise(recording({"gyro_x": each})).calibration for each in (quiet, part))
    assert not any("knock" in line for line in whole.warnings)
    assert density(knocked) == pytest.approx(density(whole), rel=0.005)
    assert knocked.model["terms"] == whole.model["terms"]
    (note,) = (line for line in knocked.warnings if "knock" in line)
    assert note.startswith("gyro_x: a knock or other part unlike the noise around, ")
    (found,) = knocked.fit["columns"]["gyro_x"]["knocks"]
    assert found["time"]["value"] == pytest.approx(300, abs=0.6)
    assert found["length"]["value"] < 2.5


@pytest.mark.parametrize("step", [0.0, 5.0, 12.0, 30.0])
@pytest.mark.parametrize(
    "sizes",
    [{"walk": 1.0}, {"flicker": 3.0}, *({"gm1_sigma": 3.0, "gm1_time": time} for time in (0.02, 0.05, 0.5, 5.0))],
)
def test_no_noise_has_knocks(sizes, step):
    for count in (4000, 60_000):
        for seed in range(3):
            x = np.concatenate(list(simulated({"white": 0.3, **sizes}, 0.01, count, seed)))
            read = step * np.round(x / step) if step else x
            assert not len(knocks_removed(read, ordered_blocks(read))[1])


@pytest.mark.slow
def test_a_narrow_band_is_said_and_the_white_noise_less_certain(reduced):
    """A filter of 5 Hz of first order: N is 1.4 % too small on average."""
    trials = 6 if reduced else 12
    pole = np.exp(-2 * np.pi * 5 / 100)
    held = 0
    for seed in range(trials):
        x = lfilter([1 - pole], [1, -pole], SIGMA * np.random.default_rng(seed).standard_normal(61_000))[1000:]
        record = il.fit_noise(recording({"gyro_x": x})).calibration
        low, high = np.degrees(record.parameter("gyro_x_white").interval_95)
        held += low < 0.01 < high
        (note,) = (line for line in record.warnings if "not level" in line)
        assert "fitted up to 1.56 Hz; from about 3.12 Hz" in note
        assert re.search(r"which may leave the white noise up to (0\.\d|[1-6]) % too small$", note)
    assert held >= 10 / 12 * trials

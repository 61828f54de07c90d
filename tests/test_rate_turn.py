"""Whole turns by hand: a real recording, a simulator apart, the number of turns, and every refusal."""

from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from reference import rate as reference

FREQUENCY = 100.0
BIAS = np.array([0.3, -0.2, 0.5])


def turned(counts, scale=1.0, stops=None, axis=2, wobble=0.0, noise=0.02, seed=1, speed=90.0):
    """Rates of turns with rests between, deg/s; stops are the errors of the stops, deg; wobble tilts the axis, deg."""
    rng = np.random.default_rng(seed)
    stops = np.zeros(len(counts) + 1) if stops is None else stops
    parts = [np.zeros((300, 3))]
    for k, count in enumerate(counts):
        angle = 360.0 * count + stops[k + 1] - stops[k]
        length = round(abs(angle) / speed * FREQUENCY)
        shape = np.sin(np.pi * (np.arange(length) + 0.5) / length)
        rate = np.zeros((length, 3))
        rate[:, axis] = angle * shape / shape.sum() * FREQUENCY
        if wobble:
            # the body tips by `wobble` about its first cross axis and back, at a rate that a turning body sees
            tip = np.radians(wobble) * np.sin(2 * np.pi * np.arange(length) / length)
            about = np.cumsum(rate[:, axis]) / FREQUENCY * np.pi / 180
            rate[:, (axis + 1) % 3] = np.gradient(tip) * FREQUENCY * 180 / np.pi
            rate[:, (axis + 2) % 3] = rate[:, axis] * np.sin(tip)
            rate[:, axis] *= np.cos(tip)
            assert about.size == length
        parts += [rate, np.zeros((300, 3))]
    out = scale * np.vstack(parts) + BIAS
    return il.Recording.from_arrays(
        gyro=out + noise * rng.standard_normal(out.shape), rate=FREQUENCY, units={"gyro": "deg/s"}
    )


@pytest.fixture(scope="module")
def session(real_data):
    return np.loadtxt(real_data / "imucal" / "example_ferraris_session.csv", delimiter=",", skiprows=1)


def of(session, rate):
    units = {"gyro": "deg/s", "accel": "m/s^2"}
    return il.Recording.from_arrays(gyro=session[:, 1:4], accel=session[:, 4:7], rate=rate, units=units)


def test_a_real_recording_has_a_turn_about_each_axis(session):
    """imucal's example: 370.0, 353.7 and 359.3 deg; by gravity alone the scales are 1.025(2), .994(7) and .996(2)."""
    found = il.fit_turns(of(session, 102.4))
    angles = [abs(float(np.degrees(found.turns[axis].angle[0]))) for axis in "xyz"]
    assert angles == pytest.approx([370.0, 353.7, 359.3], abs=0.15)
    assert [found.turns[axis].scale for axis in "xyz"] == pytest.approx([1.0280, 0.9823, 0.9980], abs=5e-4)
    for axis, gravity, spread in (("x", 1.025, 0.002), ("y", 0.994, 0.007), ("z", 0.996, 0.002)):
        own = found.turns[axis]
        assert own.scale_uncertainty == pytest.approx(1389e-6, rel=0.1)
        assert abs(own.scale - gravity) < 3 * np.hypot(own.scale_uncertainty, spread)


def test_a_sample_rate_twice_too_high_or_low_is_found_and_said(session):
    with pytest.raises(il.ImulabError, match=r"was (1\.9\d|2\.0\d) times .*is the stated sample rate 2 times too high"):
        il.fit_turns(of(session, 204.8))
    with pytest.raises(il.ImulabError, match="is the stated sample rate 2 times too low"):
        il.fit_turns(of(session, 51.2))


@pytest.mark.parametrize(
    ("counts", "ppm"),
    [
        ([1], 1389),
        ([1, -1], 1203),
        ([1] * 3 + [-1] * 3, 360),
        ([1] * 5 + [-1] * 5, 185),
        ([1] * 10 + [-1] * 10, 71),
        ([1, -1] * 5, 595),
        ([3, -3], None),
    ],
)
def test_the_uncertainty_is_that_of_the_stops(counts, ppm):
    """The slope of stop angle over turns made; the formula is worked out apart, by the stops themselves."""
    found = il.fit_turns(turned(counts, noise=1e-4), fence="0.5 deg").turns["z"]
    made = np.concatenate([[0], np.cumsum(counts)])
    expected = 0.5 / np.sqrt(2) / (360 * np.sqrt(np.sum((made - made.mean()) ** 2)))
    if len(counts) == 1:
        expected = 0.5 / 360
    assert found.scale_uncertainty == pytest.approx(expected, rel=0.01)
    if ppm is not None:
        assert 1e6 * expected == pytest.approx(ppm, abs=0.6)


def test_intervals_hold_the_scale_factor_as_often_as_they_say(reduced):
    trials = 20 if reduced else 60
    rng = np.random.default_rng(5)
    counts = [1, -1, 3, -3]
    scores = []
    for seed in range(trials):
        stops = 0.5 / np.sqrt(2) * rng.standard_normal(5)
        found = il.fit_turns(turned(counts, 1.02, stops, seed=seed, speed=360)).turns["z"]
        scores.append((found.scale - 1.02) / 1.02 / found.scale_uncertainty)
    # 60 squares scatter by 0.18 about 1
    assert 0.4 < np.mean(np.square(scores)) < 1.75


def test_turns_that_wobble_are_composed():
    found = il.fit_turns(turned([1, -1], wobble=2.0, noise=1e-4)).turns["z"]
    assert found.scale == pytest.approx(1.0, abs=300e-6)


@pytest.mark.parametrize("scale", [0.95, 1.0, 1.05])
@pytest.mark.parametrize("counts", [[1, 7, -8], [2, 12, -10], [1, -1, 20], [3, 5, -8]])
def test_the_number_of_turns_is_counted_by_the_smaller_ones(scale, counts):
    found = il.fit_turns(turned(counts, scale, speed=720)).turns["z"]
    assert found.count.tolist() == counts
    assert found.scale == pytest.approx(scale, rel=1e-3)


def test_stated_turns_are_taken():
    found = il.fit_turns(turned([20, -20], 1.04, speed=720), turns="20,-20").turns["z"]
    assert found.scale == pytest.approx(1.04, rel=1e-4)


def test_the_uncertainty_of_the_clock_is_common_to_all(session):
    record = il.fit_turns(of(session, 102.4), clock="1%").calibration
    scale = record.parameters["gyro_scale_factor_x"]
    assert scale.standard_uncertainty / scale.value == pytest.approx(np.hypot(0.01, 0.5 / 370), rel=0.01)
    block = record.cov("gyro_scale_factor_x", "gyro_scale_factor_y")
    assert block[0, 1] == pytest.approx(1e-4 * scale.value * record.value("gyro_scale_factor_y"), rel=1e-6)


def test_a_record_of_turns_is_applied_shown_and_reported(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    il.write(turned([1, -1], 1.02), "turns.csv")
    assert main(["rate", "turn", "turns.csv", "-o", "t.json", "--report", "t.html"], project=False) == 0
    assert "What is left of each turn" in Path("t.html").read_text(encoding="utf-8")
    capsys.readouterr()
    assert main(["show", "t.json"], project=False) == 0
    assert "gyro_scale_factor_z" in capsys.readouterr().out
    corrected = il.apply("t.json", "turns.csv")
    made = np.sum(corrected.column("gyro_z")[:720]) / FREQUENCY
    assert made == pytest.approx(360, abs=1.0)


REFUSED = {
    "no rest": (lambda: il.fit_turns(np.full((500, 3), 90.0), rate=100, unit="deg/s"), "rests of 0.5 s found"),
    "not whole": (lambda: il.fit_turns(turned([1.25, -1.25])), "turns; expected a whole number"),
    "half": (lambda: il.fit_turns(turned([0.5, -0.5])), "half a turn, or a whole one with a stated sample rate"),
    "too many": (lambda: il.fit_turns(turned([10, -10], 1.05, speed=720)), "begin with one turn, or say how many"),
    "no turn": (lambda: il.fit_turns(turned([0.2, -0.2])), "no whole turn between two rests"),
    "numbers": (lambda: il.fit_turns(turned([1]), turns="one"), "turns 'one': expected whole numbers"),
    "too few": (lambda: il.fit_turns(turned([1, -1]), turns="1"), "1 given, 2 found"),
    "fence": (lambda: il.fit_turns(turned([1]), fence=0), "fence 0: expected the uncertainty"),
    "counts": (lambda: il.fit_turns(np.zeros((500, 3)), rate=100, unit="count"), "counted in a unit of rate"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_is_refused_in_a_line(name):
    call, said = REFUSED[name]
    with pytest.raises(il.ImulabError, match=said) as refused:
        call()
    assert "\n" not in str(refused.value)


def _with(recording, **columns):
    units = {**recording.units}
    return il.Recording({**recording.columns, **columns}, units, name="turns.csv")


def test_a_first_motion_is_whole_within_a_fifth_of_a_turn():
    """Three turns that miss by 0.3 turn are 3.3 turns, or 3 with a scale factor of 1.1: neither is taken."""
    with pytest.raises(
        il.ImulabError, match=r"3 turns with a scale factor of 1\.100, or 3\.30 turns, which are not whole"
    ):
        il.fit_turns(turned([3.3, -3.3]))
    assert il.fit_turns(turned([3, -3], 1.05)).turns["z"].scale == pytest.approx(1.05, rel=1e-3)
    assert il.fit_turns(turned([3, -3], 1.1), turns="3,-3").turns["z"].scale == pytest.approx(1.1, rel=1e-3)
    assert il.fit_turns(turned([1, 3, -3, -1], 1.08)).turns["z"].count.tolist() == [1, 3, -3, -1]


def test_turns_that_wobble_in_a_cone_are_composed_where_the_integral_about_one_axis_errs():
    """An axis that cones at 1 deg, five times a turn: ``d^2 (m - 1) / 2`` is -914 ppm at full d."""
    counts, frequency = [1] * 5 + [-1] * 5, 40.0
    rates = reference.wobbling_turns(counts, frequency, wobble=1.0, rounds=-5, stops=np.zeros(11), speed=180, rest=1)
    found = il.fit_turns({"gyro": np.degrees(1.02 * rates)}, rate=frequency, unit="deg/s").turns["z"]
    assert found.scale / 1.02 - 1 == pytest.approx(0, abs=10e-6)
    moving = np.abs(rates).max(axis=1) > 0
    edges = np.flatnonzero(np.diff(moving.astype(int))).reshape(-1, 2) + 1
    angles = [rates[a:b, 2].sum() / frequency for a, b in edges.tolist()]
    one_axis = np.dot(counts, angles) / 10 / (2 * np.pi) - 1
    u = (np.arange(1000) + 0.5) / 1000
    size = np.radians(1.0) ** 2 * np.mean((1 - np.cos(np.pi * u) ** 8) ** 2 * (1 - np.cos(2 * np.pi * u)))
    assert one_axis == pytest.approx(size * (-5 - 1) / 2, rel=0.03)
    assert abs(one_axis) > 4 * 185e-6


@pytest.mark.parametrize("noise", [1e-5, 3e-4, 2e-3, 5e-3])
def test_turns_that_begin_slowly_are_not_taken_for_rest(noise):
    """Three turns in 18 s: the first tenths of a second are below the noise of a sample, and were in the zero."""
    rates, _ = reference.hand_turns(np.eye(3)[[2, 0, 1]], [1, -1, 3, -3], FREQUENCY, np.zeros(3), speed=60)
    rates = rates + noise * np.random.default_rng(1).standard_normal(rates.shape)
    found = il.fit_turns({"gyro": rates}, rate=FREQUENCY, unit="rad/s").turns
    for axis in "xyz":
        assert found[axis].scale == pytest.approx(1.0, abs=10e-6 + 0.06 * noise)
        assert found[axis].scale_uncertainty < 450e-6


@pytest.mark.parametrize("size", [4, 10])
def test_stamps_in_bursts_are_evened_and_said(size):
    """Samples taken evenly, stamped as blocks of them arrive: 0.2 ms apart, then a pause."""
    made = turned([1, -1, 3, -3], 1.02, noise=1e-3)
    count = np.arange(len(made))
    stamps = (count // size) * size / FREQUENCY + (count % size) * 2e-4
    found = il.fit_turns(_with(made, time=stamps))
    assert found.turns["z"].scale == pytest.approx(1.02, abs=100e-6)
    assert any("time stamps come in bursts" in w and "taken as even" in w for w in found.calibration.warnings)
    assert not any("bursts" in w for w in il.fit_turns(made).calibration.warnings)


def test_stamps_in_late_bursts_err_by_a_percent_if_they_are_believed(reduced):
    """Blocks of 0.2 s that come up to 50 ms late, turns of a second: slope of the angle at stops over turns."""
    trials = 4 if reduced else 12
    counts, size, speed, believed, evened = [1, -1, 3, -3], 20, 360, [], []
    made = turned(counts, 1.02, noise=1e-3, speed=speed)
    lengths = [round(360 * abs(count) / speed * FREQUENCY) + 300 for count in counts]
    stops = 150 + np.concatenate([[0], np.cumsum(lengths)])
    count = np.arange(len(made))
    for seed in range(trials):
        late = np.random.default_rng(seed).uniform(0, 0.05, len(made) // size + 1)[count // size]
        stamps = count // size * size / FREQUENCY + count % size * 2e-4 + late
        z = made.column("gyro_z") - BIAS[2]
        angle = np.concatenate([[0], np.cumsum((z[1:] + z[:-1]) / 2 * np.diff(stamps))])[stops]
        believed.append(np.polyfit(360 * np.cumsum([0, *counts]), angle, 1)[0] / 1.02 - 1)
        found = il.fit_turns(_with(made, time=stamps))
        evened.append(found.turns["z"].scale / 1.02 - 1)
        assert any("time stamps come in bursts" in w for w in found.calibration.warnings)
    assert np.abs(believed).max() > 1e-2
    assert np.sqrt(np.mean(np.square(believed))) > 5e-3
    assert np.abs(evened).max() < 1e-3
    assert np.sqrt(np.mean(np.square(evened))) < 3e-4


def test_stamps_that_jitter_as_the_samples_do_are_kept():
    made = turned([1, -1], 1.02, noise=1e-3)
    rng = np.random.default_rng(2)
    moved = made.column("time") + rng.uniform(-2e-3, 2e-3, len(made))
    found = il.fit_turns(_with(made, time=moved))
    assert not any("bursts" in w for w in found.calibration.warnings)
    assert found.turns["z"].scale == pytest.approx(1.02, abs=2e-3)


def test_a_gap_inside_a_turn_is_refused_and_a_short_one_or_one_at_rest_is_not():
    made = turned([1, -1], noise=1e-3, speed=200)
    keep = np.ones(len(made), dtype=bool)

    def without(a, b):
        mask = keep.copy()
        mask[a:b] = False
        return il.Recording({n: v[mask] for n, v in made.columns.items()}, made.units, name="turns.csv")

    with pytest.raises(il.ImulabError, match=r"samples are missing from 3\.\d+ to 4\.\d+ s, while the unit turned at"):
        il.fit_turns(without(380, 410))
    for gap in ((390, 393), (640, 700)):
        assert il.fit_turns(without(*gap)).turns["z"].scale == pytest.approx(1, abs=1e-3)


def test_a_turn_faster_than_the_range_is_refused():
    made = turned([1, -1], noise=0.02, speed=200)
    clipped = _with(made, gyro_z=np.clip(made.column("gyro_z"), -250, 250))
    with pytest.raises(il.ImulabError, match=r"gyro_z stands still at 250 deg/s .* saturated; turn more slowly"):
        il.fit_turns(clipped)
    coarse = _with(made, **{n: np.round(made.column(n) / 0.5) * 0.5 for n in ("gyro_x", "gyro_y", "gyro_z")})
    assert il.fit_turns(coarse).turns["z"].scale == pytest.approx(1, abs=3e-3)


def test_a_unit_that_was_lifted_and_tipped_over_on_its_way_is_refused():
    """Tipped by 80 deg in the middle of each turn: another gyroscope sees most of it."""
    parts = [np.zeros((300, 3))]
    for way in (1, 1, -1, -1):
        u = (np.arange(400) + 0.5) / 400
        turn = way * 90 * (1 - np.cos(2 * np.pi * u))
        tip = np.radians(80) * np.sin(np.pi * u) ** 2
        rate = np.column_stack([np.degrees(np.gradient(tip)) * FREQUENCY, turn * np.sin(tip), turn * np.cos(tip)])
        parts += [rate, np.zeros((300, 3))]
    out = 1.02 * np.vstack(parts) + 0.02 * np.random.default_rng(1).standard_normal((len(np.vstack(parts)), 3))
    with pytest.raises(il.ImulabError, match=r"is about y and z together .*was the unit lifted or tipped"):
        il.fit_turns({"gyro": out}, rate=FREQUENCY, unit="deg/s")


def test_a_stated_number_of_turns_that_does_not_go_with_the_others_is_refused():
    with pytest.raises(il.ImulabError, match=r"-2 turns as stated, but -1\.00 as the others go: is --turns right"):
        il.fit_turns(turned([1, 1, -1, -1]), turns="1,1,-1,-2")


@pytest.mark.parametrize("clock", ["-1", "300%"])
def test_a_clock_that_is_no_uncertainty_is_refused_and_leaves_no_record(clock, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    il.write(turned([1, -1]), "turns.csv")
    assert main(["rate", "turn", "turns.csv", "--clock", clock, "-o", "t.json"], project=False) == 2
    assert "expected an uncertainty of 0 or more" in capsys.readouterr().err
    assert not Path("t.json").exists()

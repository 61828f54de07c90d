"""Whole turns by hand: a real recording, a simulator apart, the number of turns, and every refusal."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.procedures.rate.turn_errors import tilt_shift
from imulab.procedures.rate.turns import _uncertainty_of_slopes
from reference import rate as reference
from test_rate_axes import ARM, SCALE, TURN, G, accel, of_another_unit
from test_rate_axes import BIAS as BIAS_ACCEL

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


@pytest.mark.slow
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


def test_turns_stated_the_other_way_round_are_said_with_those_to_state():
    verdict = il.fit_turns(turned([-1, -2, 1], 1.02), turns="1,2,-1").calibration.verdict
    assert verdict.state == "bad"
    assert verdict.reasons == ("gyro_z turned the other way round than stated: its scale factor is -1.02",)
    assert verdict.next == ("state the turns as --turns -1,-2,1, positive by the right-hand rule about their own axis",)


def test_turns_to_state_are_those_of_all_axes():
    parts = [turned([n], axis=axis) for n, axis in ((1, 0), (-1, 1), (1, 2), (-1, 1))]
    rates = np.vstack([np.column_stack([part.column(f"gyro_{a}") for a in "xyz"]) for part in parts])
    both = il.Recording.from_arrays(gyro=rates, rate=FREQUENCY, units={"gyro": "deg/s"})
    verdict = il.fit_turns(both, turns="1,1,1,1").calibration.verdict
    assert verdict.next[0].startswith("state the turns as --turns 1,-1,1,-1, positive")
    assert il.fit_turns(both, turns="1,-1,1,-1").calibration.verdict.state == "good"


def test_turns_the_other_way_round_in_another_unit_are_doubted_too():
    reasons = il.fit_turns(turned([-1, -2, 1], 180 / np.pi), turns="1,2,-1").calibration.verdict.reasons
    assert any("the other way round" in reason for reason in reasons)
    assert any("is the unit right?" in reason for reason in reasons)


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


__all__ = ["accel"]


LEAN = np.array([[0.02, -0.03, 1.0], [1.0, 0.015, -0.01], [-0.025, 1.0, 0.02]])


"""Of the vertical on the faces z, x and y: by up to 2 deg."""


def hand(counts=(1, -1), noise=0.0, force_noise=0.0, seed=1, tilt=5e-3, stops=0.0, axes=LEAN, arm=ARM):
    rng = np.random.default_rng(seed)
    off = stops * rng.standard_normal(3 * (len(counts) + 1)).reshape(3, -1)
    moved = np.diff(off, axis=1).ravel()
    rate, force = reference.hand_turns(axes, counts, FREQUENCY, arm, tilt, stops=moved)
    out = SCALE * (rate @ TURN.T + BIAS_ACCEL) + noise * rng.standard_normal(rate.shape)
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


@pytest.mark.slow
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


REFUSED_ACCEL = {
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


@pytest.mark.parametrize("name", REFUSED_ACCEL)
def test_what_cannot_be_is_refused_in_a_line_accel(name, accel):
    said, call = REFUSED_ACCEL[name]
    with pytest.raises(il.ImulabError, match=said) as refused:
        call(accel)
    assert "\n" not in str(refused.value)


def test_turns_without_noise_state_what_is_left_and_divide_by_nothing():
    count = np.array([3.0, -3.0, 5.0])
    left = np.array([[0.0, 1e-6, 2e-16], [0.0, -2e-6, 0.0], [0.0, 1e-6, 0.0]])
    with np.errstate(all="raise"):
        found = _uncertainty_of_slopes(left, count, np.zeros((3, 3)))
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


EARTH = np.degrees(7.292115e-5)  # deg/s


def made_turns(up=1.0, tilt=0.0, lost=0.0, fence=0.0, seed=0, counts=(1, 1, 1, -1, -1, -1), noise=0.01):
    """Turns about z at latitude 48 deg, by plain equations, with the specific force that goes with them."""
    rng = np.random.default_rng(seed)
    stops = fence / np.sqrt(2) * rng.standard_normal(len(counts) + 1)
    x = np.arange(400) / 400
    rates = [np.zeros(300)]
    for k, count in enumerate(counts):
        rates += [(360 * count + stops[k + 1] - stops[k]) * (1 - np.cos(2 * np.pi * x)) / 4, np.zeros(300)]
    w = np.concatenate(rates)
    heading = np.radians(np.cumsum(w) / 100)
    axis = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    gyro = w[:, None] * axis
    gyro[:, 2] += up * EARTH * np.sin(np.radians(48))
    gyro[:, 0] += EARTH * np.cos(np.radians(48)) * np.cos(heading)
    gyro += 0.1 + noise * rng.standard_normal(gyro.shape)
    kept = rng.random(len(gyro)) >= lost
    force = np.tile([0.0, 0.0, up * 9.81], (len(gyro), 1))
    return gyro[kept], force[kept]


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_the_earths_rate_is_taken_off_a_bias_or_is_in_its_uncertainty(up):
    gyro, force = made_turns(up)
    off = EARTH * np.sin(np.radians(48))
    hour = 3600.0

    def bias(columns, **how):
        units = {name: {"gyro": "deg/s", "accel": "m/s^2"}[name] for name in columns}
        fit = il.fit_turns(il.Recording.from_arrays(rate=100.0, units=units, **columns), **how)
        assert fit.calibration.verdict.state == "good"
        p = fit.calibration.parameters["gyro_bias_z"]
        return np.degrees(p.value) - 0.1, np.degrees(p.standard_uncertainty), fit.calibration.warnings

    error, u, notes = bias({"gyro": gyro})
    assert hour * error == pytest.approx(up * hour * off, abs=2)
    assert hour * u > 8
    assert any("--latitude" in note for note in notes)
    error, u, notes = bias({"gyro": gyro}, latitude="48 deg")
    assert abs(error) < 1.96 * u
    assert any("which way is up" in note for note in notes)
    error, u, _ = bias({"gyro": gyro, "accel": force}, latitude="48 deg")
    assert abs(hour * error) < 2
    assert hour * u < 2


def test_a_tilted_axis_is_in_the_uncertainty_and_said_where_it_is_seen():
    def turned(lean, **how):
        return il.fit_turns({"gyro": made_turns(tilt=lean)[0]}, rate=100, unit="deg/s", **how).calibration

    level, leaning = turned(0.0), turned(np.radians(3))
    u = [record.parameters["gyro_scale_factor_z"].standard_uncertainty / 57.3 for record in (level, leaning)]
    assert u[0] < 1.1 * 360e-6  # stops alone
    assert u[1] > 1.5 * u[0]  # misalignments of 10 mrad times the tilt
    assert not any("off its own" in reason for reason in level.verdict.reasons)
    assert any("3 deg off its own" in reason for reason in leaning.verdict.reasons)
    assert leaning.verdict.next == ("turn about x, y and z, with the record of the accelerometers (--accel)",)
    for stated in ("0 deg", "3 deg"):
        assert turned(np.radians(3), tilt=stated).verdict.state == "good"


@pytest.mark.parametrize("lean", [0.0, 0.5, 2.0])
def test_a_tilt_four_times_the_stated_one_is_still_covered(lean):
    """Turns about a fixed axis are one rotation by ``|B a|``, of which the gyroscope's own component is taken."""
    rng = np.random.default_rng(4)
    axis = np.array([np.sin(np.radians(lean)), 0.0, np.cos(np.radians(lean))])
    covered = []
    for _ in range(300):
        seen = (np.eye(3) + 0.01 * rng.standard_normal((3, 3)) * (1 - np.eye(3))) @ axis
        size = np.linalg.norm(seen)
        stated = 1 + (size - 1) * seen[2] / size
        shift, u = tilt_shift(seen[:2], np.radians(0.5))
        covered.append(abs(stated - 1 - shift) <= 1.96 * u)
    assert np.mean(covered) > 0.9


def test_lost_samples_are_in_the_uncertainty_and_said():
    counts = (1, -1) * 5
    for lost in (0.0, 0.005):
        gyro = made_turns(lost=lost, fence=0.5, counts=counts, seed=2)[0]
        record = il.fit_turns({"gyro": gyro}, rate=100, unit="deg/s").calibration
        p = record.parameters["gyro_scale_factor_z"]
        error, u = p.value / (180 / np.pi) - 1, p.standard_uncertainty / (180 / np.pi)
        assert abs(error) < 2 * u
        assert (u > 2e-3) == (lost > 0)
        assert any("samples were lost" in reason for reason in record.verdict.reasons) == (lost > 0)

"""What an array's readings say before any number is believed: motion, mounting, units, dead gyros."""

import numpy as np
import pytest

import imulab as il
from imulab.errors import DataError
from imulab.procedures.gyro_array.compare import compare_methods
from imulab.procedures.gyro_array.elements import Checks, common_motion, find_rest
from imulab.procedures.gyro_array.fit import calibrate_array
from imulab.procedures.gyro_array.fuse import fuse
from imulab.procedures.gyro_array.stream import FuseOptions
from imulab.recording import Recording
from test_gyro_array_fit import UPSIDE_DOWN, motion
from test_gyro_array_fuse import array_recording as recording_of

DEG = np.pi / 180
SWAPPED = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])


def turned(rng: np.random.Generator) -> np.ndarray:
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def array_recording(readings: np.ndarray, rate: float, name: str = "a.csv") -> Recording:
    return recording_of(readings[:, 0] if readings.shape[1] == 1 else readings, rate, name)


def readings_of(rates: np.ndarray, sensing: np.ndarray, seed: int = 1) -> np.ndarray:
    """Readings (m, axes, n), deg/s."""
    rng = np.random.default_rng(seed)
    out = np.einsum("iab,tb->tai", sensing, rates)
    bias = rng.normal(0, 0.5, out.shape[1:])
    return out + bias + 0.05 * rng.uniform(0.6, 1.6, out.shape[1:]) * rng.standard_normal(out.shape)


def sensing_of(kind: str, n: int = 6) -> np.ndarray:
    rng = np.random.default_rng(5)
    sensing = np.eye(3) + 0.01 * rng.standard_normal((n, 3, 3))
    if kind == "upside down":
        sensing[1::2] = UPSIDE_DOWN @ sensing[1::2]
    elif kind == "any":
        sensing = np.array([turned(rng) @ one for one in sensing])
    return sensing


# ---- rest -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["same", "upside down", "any"])
@pytest.mark.parametrize("size", [40.0, 5.0, 0.5])
def test_motion_is_no_rest_however_the_elements_are_mounted(kind, size):
    rates = motion(6000, 3, np.random.default_rng(2)) * size / 40
    with pytest.raises(DataError, match=r"s\.csv: (the array moves: its elements go together|no stretch of 5 s)"):
        calibrate_array(array_recording(readings_of(rates, sensing_of(kind)), 100.0, "s.csv"))


@pytest.mark.parametrize("kind", ["same", "upside down", "any"])
def test_the_longest_stretch_at_rest_is_used_and_said(kind):
    rates = motion(9000, 3, np.random.default_rng(3))
    rates[:1000] = 0.0
    rates[3000:7000] = 0.0
    readings = readings_of(rates, sensing_of(kind))
    record = calibrate_array(array_recording(readings, 100.0, "s.csv")).calibration
    (line,) = [w for w in record.warnings if "at rest" in w]
    assert "s.csv: not at rest throughout (gyro_" in line
    assert "used is the longest stretch at rest, 30 to 69.99 s (39.99 of 89.99 s); --window" in line
    assert record.fit["samples"] == 4000
    found = np.array([e["bias"]["value"] for e in record.sections["elements"]]).T
    np.testing.assert_allclose(found, DEG * readings[3000:7000].mean(axis=0), atol=1e-12)
    assert record.verdict.state == "look"
    assert record.verdict.next == ("record again at rest, or state the part at rest (--window)",)


def test_a_board_of_whole_imus_that_moved_is_sent_to_their_calibration():
    record = il.calibrate_array(il.simulate_imus(elements=3, attitudes=8, duration="12 s", seed=3)).calibration
    action = record.verdict.next[0]
    assert action.startswith("calibrate the whole IMUs (array calibrate --imus), or record again at rest")


@pytest.mark.parametrize("fault", ["drift", "shared", "steps", "loud", "knock"])
def test_what_happens_at_rest_is_no_motion(fault):
    rng = np.random.default_rng(4)
    readings = readings_of(np.zeros((8000, 3)), sensing_of("any"))
    time = np.arange(8000)[:, None, None] / 8000
    if fault == "drift":  # all follow one temperature, each in its own way
        readings += 0.4 * time * rng.standard_normal((3, 6))
    elif fault == "shared":
        readings += 0.05 * rng.standard_normal((8000, 1, 1))
    elif fault == "steps":
        readings = 0.2 * np.round(readings / 0.2)
    elif fault == "loud":
        readings[:, :, 2] += 2.0 * rng.standard_normal((8000, 3))
    else:
        readings[7990:] += 3.0
    found = find_rest((DEG * readings).__getitem__, len(readings), 100.0, [["a"] * 6] * 3, "s.csv")
    assert (found.start, found.stop) == ((0, 7900) if fault == "knock" else (0, 8000))


def test_a_steady_turn_and_a_zero_that_is_none_are_refused():
    still = readings_of(np.zeros((4000, 3)), sensing_of("any"))
    steady = readings_of(np.tile([0.0, 12.0, 0.0], (4000, 1)), sensing_of("any"))
    with pytest.raises(DataError, match="all elements read 12 deg/s: the array turns steadily"):
        calibrate_array(array_recording(steady, 100.0, "s.csv"))
    still[:, 1, 3] += 150.0
    with pytest.raises(DataError, match=r"column gyro_y_4: 150.* deg/s on average, which is no zero"):
        calibrate_array(array_recording(still, 100.0, "s.csv"))


def test_elements_go_together_by_what_the_array_turns():
    rates = np.random.default_rng(6).standard_normal((500, 3))
    off = np.einsum("iab,tb->tai", np.array([turned(np.random.default_rng(i)) for i in range(5)]), rates)
    noise = 0.01 * np.random.default_rng(7).standard_normal(off.shape)
    moves, ratio = common_motion(off + noise, np.full((3, 5), 0.01))
    assert moves == pytest.approx(1.0, rel=0.05)
    assert 80 < ratio < 130
    assert common_motion(noise, np.full((3, 5), 0.01))[1] < 2


@pytest.mark.slow
def test_the_real_array_finds_its_own_rest(real_data):
    log = il.read(real_data / "mimu4444" / "exp_1.bin")  # as logged: rests and turns, every second element upside down
    record = calibrate_array(log, log).calibration
    assert record.fit["duration"]["value"] == pytest.approx(28.2, abs=0.1)
    biases = np.degrees([e["bias"]["value"] for e in record.sections["elements"]])
    assert np.abs(biases).max() < 3
    assert any("longest stretch at rest, 467.712 to 495.92 s" in line for line in record.warnings)
    reads = "elements 2 4 6 8 (gyro_x_2 ..): x reads -y, y reads -x, z reads -z of the first"
    assert any(reads in line for line in record.warnings)
    assert np.isfinite(fuse(log, FuseOptions(calibration=record)).rate).all()
    moving = log.time > 496
    cut = Recording({n: c[moving] for n, c in log.columns.items()}, log.units, name="moving")
    with pytest.raises(DataError, match=r"moving: (the array moves|no stretch)"):
        calibrate_array(cut)
    for messages in (compare_methods(log).warnings, compare_methods(log, calibration=record).warnings):
        assert not any("follows only" in line for line in messages)


# ---- mounting -------------------------------------------------------------------------------------------------------


def checked(readings: np.ndarray) -> Checks:
    axes, n = readings.shape[1:]
    names = [[f"gyro_{x}_{i + 1}" if axes == 3 else f"gyro_{i + 1}" for i in range(n)] for x in "xyz"[:axes]]
    checks = Checks(names)
    for part in np.array_split(readings, 7):
        checks.watch(part)
    return checks


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (SWAPPED, "x reads +y, y reads +x of the first (left-handed, which no mounting does"),
        (np.diag([1.0, 1, -1]), "z reads -z of the first (left-handed"),
        (np.diag([-1.0, -1, 1]), "x reads -x, y reads -y of the first"),
        (np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]), "x reads +y, y reads +z, z reads +x of the first"),
        (UPSIDE_DOWN, "x reads -y, y reads -x, z reads -z of the first"),
    ],
)
def test_interchanged_and_reversed_axes_of_an_element_are_named(change, said):
    sensing = sensing_of("same")
    sensing[2] = change @ sensing[2]
    rates = motion(4000, 3, np.random.default_rng(8))
    (line,) = checked(readings_of(rates, sensing)).turned()
    assert line.startswith("element 3 (gyro_x_3 ..): ")
    assert said in line
    sensing = sensing_of("same")
    sensing[0] = change @ sensing[0]  # the first is the odd one
    (line,) = checked(readings_of(rates, sensing)).turned()
    assert line.startswith("element 1 (gyro_x_1 ..): ")
    assert "of most elements" in line
    assert checked(readings_of(0 * rates, sensing)).lines() == []
    assert checked(readings_of(rates, sensing_of("same"))).lines() == []


def test_motion_about_one_axis_tells_of_that_axis_alone():
    sensing = sensing_of("same")
    sensing[3] = np.diag([1.0, 1, -1]) @ sensing[3]
    sensing[4] = SWAPPED @ sensing[4]
    rates = motion(4000, 3, np.random.default_rng(8)) * [0, 0, 1]
    (line,) = checked(readings_of(rates, sensing)).turned()
    assert line == "element 4 (gyro_x_4 ..): z reads -z of the first"


def test_one_reversed_gyro_of_an_axis_is_named_also_where_it_is_the_first():
    rates = motion(4000, 1, np.random.default_rng(9))
    for odd in (0, 3):
        sensing = np.ones((5, 1, 1))
        sensing[odd] = -1
        (line,) = checked(readings_of(rates, sensing)).turned()
        whom = "the other gyros" if odd == 0 else "the first gyro"
        assert line == f"gyro_{odd + 1} turns against {whom} of the axis"


# ---- units and dead gyros -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("moves", [True, False])
@pytest.mark.parametrize(("factor", "label"), [(np.pi / 180, "rad/s labelled deg/s"), (3600.0, "deg/h labelled deg/s")])
def test_mixed_units_are_said_everywhere(imulab, tmp_path, moves, factor, label):
    rates = motion(6000, 1, np.random.default_rng(10)) * moves
    readings = readings_of(rates, np.ones((6, 1, 1)))
    readings[:, :, [0, 2, 4]] *= factor
    (line,) = checked(readings).units()
    assert label in line
    assert f"the {'readings' if moves else 'noise'} of gyro_{'2' if factor < 1 else '1'} gyro_" in line
    il.write_csv(array_recording(readings, 100.0, "a.csv"), tmp_path / "a.csv")
    commands = [["fuse", "a.csv", "-o", "o.csv"]]
    if not moves and factor < 1:  # the zeros of a gyro in deg/h labelled deg/s are refused
        commands += [["calibrate", "a.csv"], ["compare", "a.csv"]]
    for command in commands:
        done = imulab("array", *command)
        assert done.returncode == 0, done.stderr
        assert "times as large as that of" in done.stderr + done.stdout
    if not moves and factor < 1:
        assert calibrate_array(array_recording(readings, 100.0, "a.csv")).calibration.verdict.state == "bad"


def test_gyros_of_unlike_noise_are_no_mixed_units():
    readings = readings_of(np.zeros((4000, 1)), np.ones((6, 1, 1)))
    readings[:, 0, 0] = 0.1 + 0.1 * (readings[:, 0, 0] - 0.1)  # ten times better
    assert checked(readings).units() == []


def test_dead_gyros_are_said(imulab, tmp_path):
    readings = readings_of(np.zeros((4000, 1)), np.ones((6, 1, 1)))
    dead = np.broadcast_to(readings[0], readings.shape).copy()
    assert checked(readings).dead() == []
    assert checked(dead).dead() == [
        "gyro_1 to gyro_6: no reading ever changes: all gyros are dead, and so is the result"
    ]
    il.write_csv(array_recording(dead, 100.0, "a.csv"), tmp_path / "a.csv")
    for command in ("fuse", "compare"):
        for method in ([], ["--method", "mean"])[: 2 if command == "fuse" else 1]:
            done = imulab("array", command, "a.csv", *method)
            assert done.returncode == 0, done.stderr
            assert "all gyros are dead" in done.stderr
    refused = imulab("array", "calibrate", "a.csv")
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert "a dead gyro" in refused.stderr
    one = readings.copy()
    one[:, 0, 1] = 0.25
    il.write_csv(array_recording(one, 100.0, "a.csv"), tmp_path / "b.csv")
    done = imulab("array", "fuse", "b.csv", "--method", "mean", "-o", "o.csv")
    assert "gyro_2: no reading ever changes: a dead gyro" in done.stderr


def test_a_gyro_that_is_logged_twice_is_said():
    readings = readings_of(np.zeros((4000, 1)), np.ones((5, 1, 1)))
    readings[:, 0, 3] = readings[:, 0, 1]
    said = "gyro_2 and gyro_4 read the same throughout: one gyro, logged twice?"
    assert checked(readings).doubled()[0].startswith(said)
    recording = array_recording(readings, 100.0)
    for lines in (fuse(recording).notes, compare_methods(recording).warnings):
        assert any(said in line for line in lines)
    assert compare_methods(recording).record.verdict.state == "bad"
    with pytest.raises(DataError, match=r"a\.csv: gyro_2 and gyro_4 read the same"):  # no covariance to invert
        calibrate_array(recording)


def test_a_dead_gyro_in_motion_is_refused_by_calibrate():
    still = array_recording(readings_of(np.zeros((4000, 1)), np.ones((4, 1, 1))), 100.0, "still.csv")
    moving = readings_of(motion(6000, 1, np.random.default_rng(1)), np.ones((4, 1, 1)))
    moving[:, 0, 2] = 1.5
    with pytest.raises(DataError, match=r"moving.csv: column gyro_3: all samples are 1.5: a dead gyro"):
        calibrate_array(still, array_recording(moving, 100.0, "moving.csv"))


# ---- comparison -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [0.0, 0.061, 0.2])
def test_a_healthy_array_at_rest_is_not_said_to_lag(step):
    readings = readings_of(np.zeros((4000, 1)), np.ones((6, 1, 1)))
    if step:
        readings = step * np.round(readings / step)
    assert not any("follows only" in line for line in compare_methods(array_recording(readings, 100.0)).warnings)

"""Whole IMUs fused by the C core: against dense least squares, the Cramer-Rao bound, and with faults."""

import numpy as np
import pytest

from imulab.device.imus import GATE, ImusSettings, ImusStream, imus_table
from imulab.device.unit import ALONE, BEYOND, EXCLUDED, GATED, STUCK
from imulab.errors import DataError, OptionError, RecordError
from reference import imus as reference

STEP = 0.01


def settings_of(board, **changes):
    """The settings of a reference board, some of its numbers changed."""
    names = ("accel", "accel_bias", "accel_noise", "gyro", "gyro_bias", "gyro_noise", "position", "at")
    values = {name: changes.get(name, getattr(board, name)) for name in (*names, "accel_limit", "gyro_limit")}
    return ImusSettings(**values, rate=1 / STEP)


def fused(board, readings, step=STEP, **changes):
    return ImusStream.of(settings_of(board, **changes)).process(np.full(len(readings), step), readings)


def noisy(board, motion, rng):
    """Readings of a motion with white noise, shape (n, 2, K, 3)."""
    y = board.readings(*motion)
    return y + rng.normal(size=y.shape) * np.stack([board.accel_noise, board.gyro_noise])[None, :, :, None]


def any_axis(n, rate, rng):
    """Motion at one rate, rad/s, about axes of any direction: force, rate, angular acceleration."""
    axis = rng.normal(size=(n, 3))
    w = rate * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    return rng.normal(0, 10, (n, 3)), w, rng.normal(0, 100, (n, 3))


def at_point(board, motion):
    """The force of a motion at the output point of a board."""
    force, rate, acceleration = motion
    return force + np.cross(acceleration, board.at) + np.cross(rate, np.cross(rate, board.at))


def numbers(out):
    return np.hstack([out.force, out.rate, out.acceleration, out.force_std, out.rate_std, out.acceleration_std])


LINE = 0.02 * np.array([[-1.0, 0, 0], [0, 0, 0], [2, 0, 0], [1, 0, 0]])
BALL = np.random.default_rng(0).normal(size=(32, 3))
BALL *= 0.03 / np.linalg.norm(BALL, axis=1, keepdims=True)


@pytest.mark.parametrize(
    "position",
    [reference.CUBE, reference.FOUR, reference.PLANE, reference.FOUR[:3], reference.FOUR[:2], LINE],
    ids=["cube", "four", "plane", "three", "two", "line"],
)
def test_the_core_equals_dense_least_squares_sample_by_sample_with_every_fault(position):
    rng = np.random.default_rng(1)
    board = reference.make_board(position, rng, limit=8.0)
    board.at += np.array([0.01, -0.02, 0.005])
    board.stuck, board.quiet = 50, 100
    y = noisy(board, reference.hand_motion(360, STEP, rng), rng)
    y[100:160, 0, 0] = y[100, 0, 0]  # an accelerometer stuck,
    y[200, 0, 1] += 3  # a knock of one,
    y[220:224, 1, 0] = np.nan
    y[260:280, 0, 1] = np.nan
    y[300:310, 0, -1, 1] += 2
    y[320:330, 1, 1] += 0.2  # a gyroscope off,
    y[:, 1] = np.clip(y[:, 1], -8.0, 8.0)  # all at the end of their range,
    y[340:343] = np.nan  # nothing,
    y[350] = y[349]  # and a row twice
    fusion = reference.Fusion(board)
    rows = [fusion.step(STEP, sample) for sample in y]
    expected, out = np.array([row[0] for row in rows]), fused(board, y)
    found = numbers(out)
    assert np.array_equal(np.isnan(found), np.isnan(expected))
    assert np.nanmax(np.abs(found[:, :6] - expected[:, :6])) < 6e-11
    assert np.nanmax(np.abs(found[:, 6:9] - expected[:, 6:9])) < 2e-9
    assert np.nanmax(np.abs(found[:, 9:] - expected[:, 9:])) < 1e-10
    assert np.array_equal((out.flags & BEYOND) != 0, [row[1] for row in rows])
    for sensor in range(2):
        used = [np.flatnonzero((health[sensor] & EXCLUDED) == 0).tolist() for health in out.health]
        assert used == [sorted(int(k) for k in row[2 + sensor]) for row in rows]


@pytest.mark.parametrize("rate", [0.0, 34.0])
@pytest.mark.parametrize(
    "position", [reference.FOUR, reference.CUBE, reference.PLANE, BALL], ids=["four", "cube", "plane", "ball"]
)
def test_errors_are_as_large_as_the_cramer_rao_bound_says(position, rate):
    rng = np.random.default_rng(3)
    board = reference.make_board(position, rng, limit=100.0)
    board.accel, board.gyro = (np.tile(np.eye(3), (len(position), 1, 1)) for _ in range(2))
    motion = any_axis(8000, rate, rng)
    out = fused(board, noisy(board, motion, rng), step=0.0)
    truth = (at_point(board, motion), motion[1], motion[2])
    stated = (out.force_std, out.rate_std, out.acceleration_std)
    for value, true, deviation in zip((out.force, out.rate, out.acceleration), truth, stated, strict=True):
        assert np.sqrt(np.mean(((value - true) / deviation) ** 2)) == pytest.approx(1, abs=0.02)
    w, rho = motion[1][0], board.position - board.position.mean(axis=0)
    slope = [np.hstack([np.eye(3), -reference.skew(r), (w @ r) * np.eye(3) + np.outer(w, r) - 2 * np.outer(r, w)])
             for r in rho]  # fmt: skip
    rows = np.vstack(slope) / board.accel_noise[0]
    information = rows.T @ rows
    information[6:, 6:] += len(rho) / board.gyro_noise[0] ** 2 * np.eye(3)
    bound = np.sqrt(np.diag(np.linalg.inv(information)))
    found = np.concatenate([out.force_std[0], out.acceleration_std[0], out.rate_std[0]])
    assert found == pytest.approx(bound, rel=1e-3)  # at the fused rate, which is not quite the true one
    assert np.count_nonzero(out.health & GATED) <= 3  # one in a million, of up to 500,000


@pytest.mark.parametrize("speed", [2292.0, 3438.0])
@pytest.mark.parametrize(
    ("turn", "moved", "bias", "limit"),
    [(0.0, 0.0, 0.0, 0.5), (1e-4, 1e-4, 1e-3, 3.0), (1e-3, 5e-4, 0.05, None)],
    ids=["true", "fine", "coarse"],
)
def test_rates_beyond_the_range_of_the_gyroscopes_are_bridged(speed, turn, moved, bias, limit):
    rng = np.random.default_rng(4)
    board = reference.make_board(reference.CUBE, rng)
    motion = any_axis(1500, np.radians(speed), rng)
    y = noisy(board, motion, rng)
    y[:, 1] = np.clip(y[:, 1], -board.gyro_limit[0], board.gyro_limit[0])

    def turned(matrices):
        return np.array([t @ (np.eye(3) + reference.skew(rng.normal(0, turn, 3))) for t in matrices])

    position = board.position + rng.normal(0, moved, (8, 3))
    biases = board.accel_bias + rng.normal(0, bias, (8, 3))
    out = fused(
        board, y, step=0.0, accel=turned(board.accel), gyro=turned(board.gyro), position=position, accel_bias=biases
    )
    bridged = (out.flags & BEYOND) != 0
    alone = np.linalg.solve(board.gyro, (y[:, 1] - board.gyro_bias)[..., None])[..., 0].mean(axis=1) - motion[1]
    error = np.degrees(np.sqrt(np.mean((out.rate - motion[1])[bridged] ** 2)))
    assert bridged.mean() > 0.4
    assert error < (0.005 * speed if limit is None else limit)
    assert np.degrees(np.sqrt(np.mean(alone[bridged] ** 2))) > 50
    if turn == 0:
        z = ((out.rate - motion[1]) / out.rate_std)[bridged]
        assert np.sqrt(np.mean(z**2)) == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("value", ["zero", "held"])
@pytest.mark.parametrize("position", [reference.FOUR, reference.CUBE], ids=["four", "cube"])
def test_an_accelerometer_that_dies_in_motion_is_dropped_within_two_samples(position, value):
    rng = np.random.default_rng(5)
    board = reference.make_board(position, rng, limit=100.0)
    found, false, error, trials = 0, 0, [], 60
    for _ in range(trials):
        motion = reference.hand_motion(14, STEP, rng, size=10.0)
        y, k = noisy(board, motion, rng), rng.integers(len(position))
        y[10:, 0, k] = 0 if value == "zero" else y[9, 0, k]
        out = fused(board, y)
        left_out = (out.health[:, 0] & EXCLUDED) != 0
        false += int(left_out[:10].sum())
        found += bool(left_out[11:, k].all() and left_out[11].sum() == 1)
        error.append(np.square(out.force[11:] - at_point(board, motion)[11:]).mean())
    assert false == 0
    assert found >= trials - 1
    assert np.sqrt(np.median(error)) < 2 * board.accel_noise[0] / np.sqrt(len(position) - 1)


def test_with_three_left_the_turning_about_the_line_of_two_is_the_gyroscopes():
    rng = np.random.default_rng(6)
    board = reference.make_board(reference.FOUR[:3], rng, limit=100.0)
    motion = reference.hand_motion(60, STEP, rng)
    y = noisy(board, motion, rng)
    y[30:, 0, 2] = np.nan
    out = fused(board, y)
    assert (out.flags[30:] & ALONE).all()
    assert not (out.flags[:30] & ALONE).any()
    delay = np.abs(np.diff(motion[2], axis=0)).max()
    assert np.abs(out.acceleration[31:] - motion[2][31:]).max() < delay + 5 * np.nanmax(out.acceleration_std[31:])
    assert np.sqrt(np.mean(((out.force - at_point(board, motion)) / out.force_std)[31:] ** 2)) < 1.3


def test_an_imu_dead_from_the_start_changes_nothing_but_the_uncertainty():
    rng = np.random.default_rng(7)
    board = reference.make_board(reference.CUBE, rng, limit=100.0)
    motion = reference.hand_motion(300, STEP, rng)
    y = noisy(board, motion, rng)
    y[:, :, 3] = 0
    out = fused(board, y)
    used = (out.health & EXCLUDED) == 0
    assert not used[1:, :, 3].any()
    assert used[:, :, [0, 1, 2, 4, 5, 6, 7]].all()
    assert (out.health[-1, :, 3] & STUCK).all()
    z = ((out.force - at_point(board, motion)) / out.force_std)[1:]
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1, abs=0.1)
    assert out.force_std[1:] == pytest.approx(0.03 / np.sqrt(7), rel=0.02)


def test_noise_of_all_in_motion_drops_nobody():
    """Chips that are not read at one instant scatter by many times their noise at rest."""
    rng = np.random.default_rng(8)
    board = reference.make_board(reference.CUBE, rng, limit=100.0)
    y = noisy(board, reference.hand_motion(2000, STEP, rng), rng)
    y[500:] += rng.normal(size=y[500:].shape) * np.array([0.6, 0.1])[:, None, None]
    out = fused(board, y)
    assert np.mean((out.health & EXCLUDED) != 0) < 0.01


def test_streams_give_the_same_in_blocks():
    rng = np.random.default_rng(9)
    board = reference.make_board(reference.FOUR, rng)
    y = noisy(board, reference.hand_motion(200, STEP, rng), rng)
    y[50:90, 0, 1] = y[49, 0, 1]
    stream, step = ImusStream.of(settings_of(board)), np.full(200, STEP)
    parts = [numbers(stream.process(step[a:b], y[a:b])) for a, b in ((0, 1), (1, 60), (60, 60), (60, 200))]
    assert np.array_equal(np.vstack(parts), numbers(fused(board, y)))


def test_boards_that_cannot_be_are_refused():
    rng = np.random.default_rng(10)
    board = reference.make_board(reference.FOUR, rng)
    flat = board.gyro.copy()
    flat[2, 1] = flat[2, 0]
    with pytest.raises(RecordError, match="IMU 3: the matrix of its gyroscopes cannot be inverted"):
        imus_table(settings_of(board, gyro=flat))
    with pytest.raises(OptionError, match="33 IMUs: expected 2 to 32"):
        imus_table(settings_of(reference.make_board(np.zeros((33, 3)), rng)))
    with pytest.raises(RecordError, match="contents that cannot be"):
        ImusStream.of(settings_of(board, accel_noise=np.array([0.0, 1, 1, 1])))
    with pytest.raises(DataError, match=r"expected readings of shape \(m, 2, 4, 3\)"):
        ImusStream.of(settings_of(board)).process(np.zeros(3), np.zeros((3, 2, 3, 3)))
    assert pytest.approx(board.gate) == GATE


def test_chips_that_are_read_up_to_a_millisecond_apart_are_no_fault():
    rng = np.random.default_rng(11)
    board = reference.make_board(reference.CUBE, rng, limit=100.0)
    motion = reference.hand_motion(2000, STEP, rng)
    y = noisy(board, motion, rng)
    late = rng.uniform(-5e-4, 5e-4, (2000, 8, 1))
    y[:, 1] += late * np.einsum("kij,nj->nki", board.gyro, motion[2])
    out = fused(board, y)
    assert np.mean((out.health[:, 1] & EXCLUDED) != 0) < 0.002
    y[1000:, 1, 5] = 0
    assert ((fused(board, y).health[1001:, 1, 5] & EXCLUDED) != 0).mean() > 0.9

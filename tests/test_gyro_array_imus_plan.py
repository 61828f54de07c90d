"""Plans of boards of whole IMUs: the predicted covariance against the dense least squares of all unknowns."""

from __future__ import annotations

import json

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.errors import OptionError
from imulab.procedures.gyro_array.imus import solve
from imulab.procedures.gyro_array.imus.model import ACCEL, ACCEL_LATENCY, GYRO, GYRO_LATENCY, NUMBERS, POSITION, Board
from imulab.procedures.gyro_array.imus.simulate import path_by_hand

NOISE = (0.03, 0.002)


def read(numbers, motion, change):
    """Return what two IMUs read, a sample after the other, from the equations as they are written."""
    rows = []
    for (s, al, w), slope in zip(motion.reshape(-1, 3, 3), change.reshape(-1, 3, 3), strict=True):
        for n in numbers.reshape(2, NUMBERS):

            def at(late, s=s, al=al, w=w, slope=slope, n=n):
                force, turn, rate = s - late * slope[0], al - late * slope[1], w - late * slope[2]
                there = force + np.cross(turn, n[POSITION]) + np.cross(rate, np.cross(rate, n[POSITION]))
                return n[ACCEL].reshape(3, 3) @ there + n[9:12], n[GYRO].reshape(3, 3) @ rate + n[25:28]

            rows.append(np.concatenate([at(n[ACCEL_LATENCY])[0] / NOISE[0], at(n[GYRO_LATENCY])[1] / NOISE[1]]))
    return np.concatenate(rows)


def derivative(function, at, h=1e-6):
    return np.stack([(function(at + h * e) - function(at - h * e)) / (2 * h) for e in np.eye(len(at))], axis=1)


def test_the_covariance_is_that_of_the_dense_least_squares():
    path, _ = path_by_hand(3, 3.0, 6.0, "xyz", np.random.default_rng(4))
    time = 21.0 + 0.02 * np.arange(16)
    force, rate, turn = path.at(time)
    motion = np.concatenate([force, turn, rate], axis=1)
    numbers = np.zeros((2, NUMBERS))
    numbers[:, ACCEL] = numbers[:, GYRO] = np.eye(3).ravel()
    numbers[1, POSITION] = [0.03, 0.02, -0.01]
    still = 9.8 * np.eye(3)
    measured = solve.Measured(
        None, None, time, np.zeros(1, dtype=int), np.repeat(still[:, None], 2, axis=1), np.zeros((3, 2, 3)),
        np.full(3, 50.0), np.full((2, 3), NOISE[0]), np.full((2, 3), NOISE[1]), np.stack([np.eye(3)] * 2), 9.8,
    )  # fmt: skip
    size = solve.Held(solve.mean_scale(measured), 1.0, 0.01)
    covariance = solve.expected_covariance(measured, Board(numbers), motion, still, size)

    problem = solve._Problem(measured, [size])
    change, none = problem.changes(motion), np.zeros((3, 9))
    at_rest = np.concatenate([still, np.zeros((3, 6))], axis=1)
    root = np.sqrt(50.0)

    def all_rows(unknown):
        board, moving, resting = np.split(unknown, [2 * NUMBERS, 2 * NUMBERS + motion.size])
        resting = np.concatenate([resting.reshape(3, 3), np.zeros((3, 6))], axis=1)
        return np.concatenate(
            [
                read(board, moving.reshape(-1, 9), change),
                root * read(board, resting, none),
                np.linalg.norm(resting[:, :3], axis=1) / 1e-4,
                moving.reshape(-1, 9)[:, 3:6].ravel() / 1e3,  # two IMUs do not tell the turn about their line
                (board.reshape(2, NUMBERS) / np.where(np.isfinite(solve.PRIOR), solve.PRIOR, 1e30)).ravel(),
                [size.row @ board / 0.01],
            ]
        )

    jacobian = derivative(all_rows, np.concatenate([numbers.ravel(), motion.ravel(), at_rest[:, :3].ravel()]))
    fixed = [1, 2, 5, 12, 13, 14, 28]
    free = [i for i in range(jacobian.shape[1]) if i not in fixed]
    # By the singular values: the information's condition is beyond what its inverse bears.
    inverse = np.linalg.inv(np.linalg.qr(jacobian[:, free])[1])
    expected = np.sqrt(np.square(inverse).sum(axis=1))[: 2 * NUMBERS - len(fixed)]
    found = np.sqrt(np.diag(covariance))[[i for i in range(2 * NUMBERS) if i not in fixed]]
    np.testing.assert_allclose(found, expected, rtol=2e-3)


def test_uncertainties_follow_the_noise_and_the_duration():
    options = {"elements": 3, "duration": "16 s", "attitudes": 8, "rate": "50 Hz"}
    plan = il.plan_imus(**options)
    louder = il.plan_imus(**options, accel_noise="0.06 m/s^2", gyro_noise="0.2 deg/s")
    assert louder.chosen.position == pytest.approx(2 * plan.chosen.position, rel=0.05)
    assert louder.chosen.gyro_latency == pytest.approx(2 * plan.chosen.gyro_latency, rel=0.05)
    assert [each.duration for each in plan.others] == [2, 4, 8, 16, 32]
    assert all(a.position > b.position for a, b in zip(plan.others, plan.others[1:], strict=False))


def test_the_command_prints_the_plan_and_how_to_move(capsys):
    words = ["array", "plan", "--imus", "--elements", "2", "--duration", "8 s", "--attitudes", "4"]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "4 attitudes do not tell common scale factors" in printed
    assert "turn it about all three axes" in printed
    assert main([*words, "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["position"]["value"] == il.plan_imus(elements=2, duration="8 s", attitudes=4).chosen.position


def test_values_out_of_range_are_refused():
    with pytest.raises(OptionError, match=r"span 5: expected 0\.001 to 1"):
        il.plan_imus(span=5.0)

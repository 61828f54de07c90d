"""The simulated board against rigid-body mechanics by other means: differences, and SciPy's rotations."""

from __future__ import annotations

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.errors import OptionError
from imulab.procedures.gyro_array.imus import simulate

GRAVITY = np.array([0.0, 0.0, 9.80665])


def truth(board, name):
    count = sum(key.startswith("truth_position_") for key in board.metadata)
    return np.array([[float(text) for text in board.metadata[f"truth_{name}_{k + 1}"].split()] for k in range(count)])


def test_rates_and_forces_are_those_of_the_path_by_differences():
    path, _ = simulate.path_by_hand(3, 6.0, 6.0, "xyz", np.random.default_rng(2))
    time, h = np.linspace(20, 24, 60), 1e-5
    force, rate, acceleration = path.at(time)

    def turned(t):
        return simulate._turned(path.angles(t))

    before, after = turned(time - h), turned(time + h)
    spin = np.swapaxes(turned(time), 1, 2) @ (after - before) / (2 * h)  # R' dR/dt = [w]x
    np.testing.assert_allclose(np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], 1), rate, atol=1e-6)
    np.testing.assert_allclose(
        (path.at(time + h)[1] - path.at(time - h)[1]) / (2 * h), acceleration, rtol=1e-6, atol=1e-4
    )
    speed = (path.position(time + 1e-4) - 2 * path.position(time) + path.position(time - 1e-4)) / 1e-8
    np.testing.assert_allclose(np.einsum("nij,nj->ni", turned(time), force), speed + GRAVITY, atol=2e-5)


def test_an_imu_reads_what_its_place_on_the_board_does():
    """The force at IMU 2 from its own path through space, not from lever arms."""
    path, _ = simulate.path_by_hand(3, 6.0, 6.0, "xyz", np.random.default_rng(2))
    time, h, r = np.linspace(20, 24, 40), 1e-4, np.array([0.04, 0.04, 0.0])
    force, rate, acceleration = path.at(time)
    there = force + np.cross(acceleration, r) + np.cross(rate, np.cross(rate, r))

    def place(t):
        return path.position(t) + simulate._turned(path.angles(t)) @ r

    in_space = (place(time + h) - 2 * place(time) + place(time - h)) / h**2 + GRAVITY
    np.testing.assert_allclose(np.einsum("nij,nj->ni", simulate._turned(path.angles(time)), there), in_space, atol=1e-4)


def test_readings_at_rest_and_their_noise():
    board = il.simulate_imus(elements=3, attitudes=2, duration="2 s", seed=3)
    still = slice(0, 480)
    accel = np.stack([board.columns[f"accel_{axis}_2"] for axis in "xyz"], 1)[still]
    force = np.linalg.solve(truth(board, "accel")[1].reshape(3, 3), accel.mean(0) - truth(board, "accel_bias")[1])
    assert np.linalg.norm(force) == pytest.approx(9.80665, abs=0.01)
    assert accel.std(0) == pytest.approx(np.full(3, 0.03), rel=0.2)
    gyro = np.stack([board.columns[f"gyro_{axis}_2"] for axis in "xyz"], 1)[still]
    assert gyro.std(0) == pytest.approx(np.full(3, 0.1), rel=0.2)
    assert gyro.mean(0) == pytest.approx(np.degrees(truth(board, "gyro_bias")[1]), abs=0.03)


def test_readings_in_motion_are_late_and_old():
    options = {"elements": 2, "attitudes": 1, "duration": "20 s", "seed": 4}
    at_once, old = (il.simulate_imus(**options, age=age) for age in ("0 ms", "1 ms"))
    parts = [np.stack([board.columns[f"gyro_{axis}_1"] for axis in "xyz"], 1)[700:2400] for board in (at_once, old)]
    slope = np.gradient(parts[0], 0.01, axis=0)
    apart = parts[1] - parts[0]
    # Noise is the same, so that age alone sets them apart: uniform over 1 ms by its root mean square.
    age = np.sqrt((apart**2).sum() / (slope**2).sum())
    assert age == pytest.approx(1e-3 / np.sqrt(12), rel=0.1)


def test_a_board_turns_about_the_axes_that_it_is_told():
    board = il.simulate_imus(elements=2, attitudes=1, duration="10 s", about="x")
    rms = [np.sqrt(np.mean(board.columns[f"gyro_{axis}_1"][600:1600] ** 2)) for axis in "xyz"]
    assert rms[0] > 250
    assert max(rms[1:]) < 0.05 * rms[0]


def test_the_command_writes_what_the_function_returns(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["--elements", "3", "--attitudes", "2", "--duration", "2 s", "--seed", "7", "-o", "a.csv"]
    assert main(["array", "simulate", "--imus", *words]) == 0
    assert "3 IMUs, serial SIM-0007" in capsys.readouterr().out
    il.write(il.simulate_imus(elements=3, attitudes=2, duration=2, seed=7), "b.csv")
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    # The switch may stand anywhere, and has help of its own.
    assert main(["array", "simulate", *words[:-1], "c.csv", "--imus"]) == 0
    assert (tmp_path / "c.csv").read_bytes() == (tmp_path / "a.csv").read_bytes()
    capsys.readouterr()
    assert main(["array", "simulate", "--imus", "--help"]) == 0
    assert "--attitudes" in capsys.readouterr().out
    assert main(["array", "simulate", "--attitudes", "3", "-o", "d.csv"]) == 2
    assert main(["array", "--help"]) == 0
    assert capsys.readouterr().out.count("simulate") == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"elements": 1}, "elements 1: expected 2 to 64"),
        ({"about": "yz"}, "about 'yz': expected one of xyz xy x"),
        ({"age": "1 s"}, "age 1: expected 0 to 0.02"),
    ],
)
def test_values_out_of_range_are_refused(options, message):
    with pytest.raises(OptionError, match=message):
        il.simulate_imus(**options)

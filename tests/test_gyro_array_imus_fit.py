"""A board's calibration against simulated truth, what disturbs it, and a real board."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import imulab as il
from imulab.cli import main
from imulab.errors import DataError, ObservabilityError, OptionError, UnitError
from imulab.procedures.gyro_array.imus.fit import count_attitudes, parse_distance, warn_shaking
from imulab.procedures.gyro_array.imus.model import (
    ACCEL,
    ACCEL_BIAS,
    ACCEL_LATENCY,
    GYRO,
    GYRO_LATENCY,
    POSITION,
    Board,
)
from imulab.procedures.gyro_array.imus.prepare import prepare
from imulab.procedures.gyro_array.imus.record import record_values
from imulab.procedures.gyro_array.imus.schema import imus_of
from imulab.procedures.gyro_array.imus.size import by_gravity
from imulab.procedures.gyro_array.imus.solve import Weights, _Problem

G = 9.80665
REAL = Path(os.environ.get("IMULAB_DATA", Path(__file__).parents[2] / "shared/data")) / "mimu4444" / "exp_1.bin"


def a_board(**options):
    return il.simulate_imus(
        **({"elements": 3, "attitudes": 8, "duration": "12 s", "rate": "62.5 Hz", "seed": 3} | options)
    )


def truth_of(board):
    """Return the true parameters of the record, shape (K, 29)."""

    def told(name):
        count = sum(key.startswith("truth_position_") for key in board.metadata)
        return np.array([[float(x) for x in board.metadata[f"truth_{name}_{k + 1}"].split()] for k in range(count)])

    late = told("latency")
    numbers = np.zeros((len(late), 29))
    for name, place in (("accel", ACCEL), ("accel_bias", ACCEL_BIAS), ("position", POSITION), ("gyro", GYRO)):
        numbers[:, place] = told(name)
    numbers[:, 25:28], numbers[:, ACCEL_LATENCY], numbers[:, GYRO_LATENCY] = told("gyro_bias"), late[:, 0], late[:, 1]
    return record_values(Board(numbers), np.zeros((numbers.size, numbers.size)))[0]


def errors(record, board, names):
    """Return errors over standard uncertainties of the parameters that begin with one of the names."""
    from imulab.procedures.gyro_array.imus.schema import PER_IMU

    truth, z = truth_of(board), []
    for k in range(len(truth)):
        for (name, _), value in zip(PER_IMU, truth[k], strict=True):
            stated = record.parameters.get(f"{name}_{k + 1}")
            if stated is not None and name.startswith(names):
                difference = stated.value - value
                if name.startswith("rotation") and abs(difference) > np.pi:
                    continue  # a half turn has two rotation vectors
                z.append(difference / stated.standard_uncertainty)
    return np.array(z)


@pytest.fixture(scope="module")
def simulated():
    board = a_board(age="0 ms")
    return board, il.calibrate_imus(board, gravity=G).calibration


@pytest.mark.parametrize(
    "names",
    [
        "position",
        "accel_latency",
        "gyro_latency",
        "accel_bias",
        "accel_scale_factor",
        "accel_misal",
        "gyro_scale",
        "gyro_misal",
    ],
)
def test_errors_are_as_large_as_their_uncertainties(simulated, names):
    board, record = simulated
    z = errors(record, board, (names,))
    assert len(z) >= 2
    assert 0.2 < np.sqrt(np.mean(z**2)) < 2.2
    assert np.abs(z).max() < 4.0


def test_positions_are_told_to_a_tenth_of_a_millimetre(simulated):
    board, record = simulated
    found = np.array([imu.position.value for imu in imus_of(record).imus])
    assert np.abs(found - truth_of(board)[:, 0:3]).max() < 2e-4
    assert imus_of(record).size_from == "gravity"
    assert imus_of(record).not_determined == []
    assert record.verdict.state == "good"


def test_common_scale_and_bias_are_those_of_all_imus(simulated):
    board, record = simulated
    common = imus_of(record).common
    told = [board.metadata[f"truth_accel_{k + 1}"] for k in range(3)]
    accel = np.array([[float(x) for x in text.split()] for text in told]).reshape(3, 3, 3)
    nominal = np.array([np.eye(3), np.diag([1, -1, -1]), np.eye(3)])  # every second IMU lies on the other side
    mean = np.einsum("kij,kil->jl", nominal, accel).diagonal() / 3
    z = (np.array(common.accel_scale_factor.value) - mean) / common.accel_scale_factor.standard_uncertainty
    assert np.abs(z).max() < 3.5


def test_few_attitudes_leave_common_scale_and_bias_null():
    record = il.calibrate_imus(a_board(attitudes=1, age="0 ms"), gravity=G).calibration
    held = imus_of(record)
    assert held.common.accel_scale_factor is None
    assert held.common.accel_bias is None
    assert record.parameters["accel_bias_x_2"].standard_uncertainty is None
    assert any("common scale factors and biases" in name for name in held.not_determined)
    assert held.size_from == "gyro scale"
    assert any(name.startswith("size of the board") for name in held.not_determined)


def test_a_stated_distance_gives_the_size():
    board = a_board(attitudes=1, age="0 ms")
    true = float(np.linalg.norm(truth_of(board)[1, 0:3]))
    record = il.calibrate_imus(board, gravity=G, distance=f"1:2:{1e3 * true:.4f}mm+-0.02mm").calibration
    assert imus_of(record).size_from == "stated"
    position = np.array([imu.position.value for imu in imus_of(record).imus])
    assert np.linalg.norm(position[1]) == pytest.approx(true, abs=6e-5)
    wrong = il.calibrate_imus(board, gravity=G, distance=f"1:2:{1.2e3 * true:.4f}mm+-0.02mm").calibration
    assert any("nominal scale makes the board" in text for text in wrong.verdict.reasons)


def test_the_age_of_readings_is_found():
    record = il.calibrate_imus(a_board(age="2 ms", duration="20 s"), gravity=G).calibration
    assert imus_of(record).fit.age.value == pytest.approx(2e-3 / np.sqrt(12), rel=0.15)


def test_directions_count_as_attitudes_when_they_are_apart():
    angles = np.radians([0, 5, 30, 31, 90, 180])
    assert count_attitudes(np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)) == 4


def test_a_distance_as_text():
    known = parse_distance("1:8:53.9mm+-0.1mm")
    assert (known.first, known.second, known.length, known.u) == (0, 7, pytest.approx(0.0539), pytest.approx(1e-4))
    for text in ("1:8", "1:1:5mm", "0:2:5mm", "1:2:-5mm"):
        with pytest.raises(OptionError, match="distance"):
            parse_distance(text)


# Disturbed recordings.


def with_columns(board, **columns):
    return replace(board, columns={**board.columns, **columns})


def test_a_dead_or_stuck_imu_is_refused_by_its_column():
    board = a_board(duration="6 s")
    dead = with_columns(board, gyro_y_2=np.zeros(len(board)))
    with pytest.raises(DataError, match=r"column gyro_y_2: all samples are 0: a dead sensor"):
        il.calibrate_imus(dead, gravity=G)
    stuck = board.columns["accel_z_3"].copy()
    stuck[3500:] = stuck[3500]
    with pytest.raises(DataError, match=r"column accel_z_3: .* a stuck sensor"):
        il.calibrate_imus(with_columns(board, accel_z_3=stuck), gravity=G)


def test_wrong_units_are_refused_by_name():
    board = a_board(duration="6 s")
    in_g = {name: board.columns[name] / G for name in ("accel_x_2", "accel_y_2", "accel_z_2")}
    with pytest.raises(DataError, match=r"accelerometers of IMU 2: 0\.9.* m/s\^2 at rest"):
        il.calibrate_imus(with_columns(board, **in_g), gravity=G)
    in_rad = {name: np.radians(board.columns[name]) for name in ("gyro_x_2", "gyro_y_2", "gyro_z_2")}
    with pytest.raises(
        DataError, match=r"of IMU 2 disagree .* gyro_x_2 \.\. gyro_z_2 are 57\.3 times too small: is their unit"
    ):
        il.calibrate_imus(with_columns(board, **in_rad), gravity=G)
    smaller = {name: board.columns[name] / 2.5 for name in in_rad}
    with pytest.raises(DataError, match=r"gyroscopes of IMU 2 read 0\.4.* times the rate of the others"):
        il.calibrate_imus(with_columns(board, **smaller), gravity=G)
    with pytest.raises(UnitError, match="accel_x_1"):
        il.calibrate_imus(replace(board, units={**board.units, "accel_x_1": "deg/s"}), gravity=G)


def test_missing_columns_are_named():
    board = a_board(duration="6 s")
    columns = {name: values for name, values in board.columns.items() if name != "accel_y_3"}
    with pytest.raises(DataError, match="no column accel_y_3; expected 3 whole IMUs"):
        il.calibrate_imus(replace(board, columns=columns), gravity=G)
    with pytest.raises(DataError, match=r"one IMU, .* all instances: --instance all"):
        il.calibrate_imus(il.simulate_tumble(attitudes=6), gravity=G)
    with pytest.raises(DataError, match=r"expected columns accel_x_1 \.\. accel_z_K"):
        il.calibrate_imus(il.simulate_array(elements=3, duration=10.0), gravity=G)


def test_dropouts_and_repeated_rows_are_left_out(simulated):
    board, _ = simulated
    columns = {name: values.copy() for name, values in board.columns.items()}
    rng = np.random.default_rng(1)
    for row in rng.choice(np.arange(3400, 3900), 6, replace=False):
        for name in columns:
            if name != "time":
                columns[name][row] = columns[name][row - 1]
    columns["gyro_x_2"][3700:3703] = np.nan
    disturbed = il.calibrate_imus(replace(board, columns=columns), gravity=G).calibration
    assert any("3 of" in text and "not finite" in text for text in disturbed.warnings)
    assert any("exact repeats of the row before" in text for text in disturbed.warnings)
    z = errors(disturbed, board, ("position", "accel_latency", "gyro_latency"))
    assert np.abs(z).max() < 4.0


def test_a_loose_imu_is_named():
    board = a_board(duration="20 s", age="0 ms")
    columns = dict(board.columns)
    half = len(board) - 1000  # in the middle of the motion IMU 3 slips, as by a knock
    moved = shifted(board, 3, [1.5e-3, -1.5e-3, 1.5e-3])
    for axis in "xyz":
        name = f"accel_{axis}_3"
        columns[name] = np.where(np.arange(len(board)) < half, board.columns[name], moved.columns[name])
    record = il.calibrate_imus(replace(board, columns=columns), gravity=G).calibration
    assert record.verdict.state == "look"
    assert any("IMU 3 sits elsewhere" in text for text in record.verdict.reasons)


def test_an_imu_on_another_clock_is_named():
    """100 ppm of the motion's halves are a millisecond, of which positions are wrong by more than they say."""
    board = a_board(duration="20 s", age="0 ms")
    columns = {
        name: make_interp_spline(board.columns["time"], values, k=5)(board.columns["time"] * (1 + 1e-4))
        if name.endswith("_3")
        else values
        for name, values in board.columns.items()
    }
    record = il.calibrate_imus(replace(board, columns=columns), gravity=G).calibration
    assert record.verdict.state == "look"
    assert any("gyroscopes of IMU 3 answer" in text and "another clock" in text for text in record.verdict.reasons)


def test_biases_that_drift_between_rests_are_said():
    board = a_board(age="0 ms")
    ramp = np.linspace(-0.1, 0.1, len(board))
    drift = {f"accel_{axis}_2": board.columns[f"accel_{axis}_2"] + ramp for axis in "xyz"}
    record = il.calibrate_imus(with_columns(board, **drift), gravity=G).calibration
    assert record.verdict.state == "look"
    assert any("accelerometers disagree by" in text for text in record.verdict.reasons)


@pytest.mark.parametrize("attitudes", [1, 3])
def test_few_attitudes_and_chance_repeats_at_rest_ask_for_no_look(attitudes):
    """Biases of 0.2 m/s^2 and scale factors of 1 % that few attitudes do not tell are no drift."""
    board = a_board(elements=4, attitudes=attitudes, age="0 ms", seed=5)
    coarse = {name: np.round(values / 0.15) * 0.15 for name, values in board.columns.items() if name.startswith("gyro")}
    for each in (board, with_columns(board, **coarse)):
        record = il.calibrate_imus(each, gravity=G).calibration
        assert record.verdict.state == "good", record.verdict.reasons
        z = errors(record, each, ("position", "rotation", "accel_misalignment", "accel_latency"))
        assert np.abs(z).max() < 4.0


def test_uncertainties_grow_with_what_biases_drift():
    """Drifts below what is said: 0.04 m/s^2 rms over a recording, differently in each accelerometer."""
    z, biases = [], []
    for seed in (2, 3, 4):
        board = a_board(elements=4, attitudes=12, duration="20 s", age="0 ms", seed=seed)
        rng, time = np.random.default_rng(seed), board.columns["time"]
        ramp = (time - (time[-1] - 25) / 2) / time[-1]  # 0 in the middle of the rests
        drift = {
            name: values + 0.04 * rng.normal() * ramp
            for name, values in board.columns.items()
            if name.startswith("accel")
        }
        record = il.calibrate_imus(with_columns(board, **drift), gravity=G).calibration
        biases += [*errors(record, board, "accel_bias")]
        z += [*errors(record, board, ("position", "accel_scale", "rotation"))]
    assert np.mean(np.abs(biases) < 1.96) > 0.85
    assert np.mean(np.abs(z) < 1.96) > 0.85


def shaken(board, size, frequency):
    """Return a board whose motion, its last 25 s less 5, is shaken along and about its axes, m/s^2 and Hz."""
    time, columns = board.columns["time"], dict(board.columns)
    for k in range(1, sum(name.startswith("accel_x") for name in columns) + 1):
        told = {what: np.array(board.metadata[f"truth_{what}_{k}"].split(), float) for what in ("accel", "position")}
        late = float(board.metadata[f"truth_latency_{k}"].split()[0])
        phase = 2 * np.pi * frequency * (time - late)[:, None] + np.array([0.3, 1.9, 4.0])
        force = size * (np.sin(phase) + np.cross(3 * np.sin(phase + 1.0), told["position"]))
        force[(time < time[-1] - 24) | (time > time[-1] - 6)] = 0
        for axis, values in zip("xyz", (force @ told["accel"].reshape(3, 3).T).T, strict=True):
            columns[f"accel_{axis}_{k}"] = columns[f"accel_{axis}_{k}"] + values
    return with_columns(board, **{name: columns[name] for name in columns if name.startswith("accel")})


@pytest.mark.parametrize(
    ("size", "frequency", "reason"),
    [(1.5, 37.3, "accelerometers shake in motion"), (0.3, 87.3, "accelerometers scatter"), (0.05, 37.3, None)],
)
def test_vibration_beyond_what_the_rate_follows_is_said(size, frequency, reason):
    board = a_board(elements=4, attitudes=8, duration="20 s", rate="100 Hz", age="0 ms")
    record = il.calibrate_imus(shaken(board, size, frequency), gravity=G).calibration
    assert record.verdict.state == ("look" if reason else "good")
    assert reason is None or any(reason in text for text in record.verdict.reasons)


@pytest.mark.parametrize(("rows", "shakes", "said"), [(6, True, False), (12, False, False), (12, True, True)])
def test_vibration_is_told_within_runs_of_motion_alone(rows, shakes, said):
    rng = np.random.default_rng(5)
    first = rows * np.arange(30)  # runs from other places of the recording, with other readings
    time = np.arange(30.0 * rows) / 100
    levels = np.repeat(rng.normal(0, 5, (30, 3)), rows, axis=0)
    force = levels + 0.01 * rng.standard_normal(levels.shape) + 2.0 * shakes * np.sin(2 * np.pi * 37.3 * time)[:, None]
    measured = SimpleNamespace(time=time, first=first, accel=[lambda _: force], accel_noise=np.full((1, 3), 0.01))
    assert bool(warn_shaking(SimpleNamespace(measured=measured))) is said


def shifted(board, number, by):
    """Return a board whose IMU reads as if it sat elsewhere, by lever arms from rates of the gyroscopes' derivative."""
    truth = {name: np.array(board.metadata[f"truth_{name}_1"].split(), float) for name in ("gyro", "gyro_bias")}
    rate = np.radians(np.stack([board.columns[f"gyro_{axis}_1"] for axis in "xyz"], 1)) - truth["gyro_bias"]
    rate = rate @ np.linalg.inv(truth["gyro"].reshape(3, 3)).T
    kernel = np.ones(5) / 5
    rate = np.stack([np.convolve(column, kernel, mode="same") for column in rate.T], 1)
    slope = np.gradient(rate, np.median(np.diff(board.columns["time"])), axis=0)
    force = np.cross(slope, by) + np.cross(rate, np.cross(rate, by))
    accel = np.array(board.metadata[f"truth_accel_{number}"].split(), float).reshape(3, 3)
    readings = force @ accel.T
    return with_columns(
        board,
        **{f"accel_{a}_{number}": board.columns[f"accel_{a}_{number}"] + readings[:, i] for i, a in enumerate("xyz")},
    )


def test_motion_that_does_not_turn_about_all_axes_is_refused_or_said():
    with pytest.raises(ObservabilityError, match="does not turn about every axis"):
        il.calibrate_imus(a_board(about="x", attitudes=1), gravity=G)
    with pytest.raises(DataError, match="samples in motion"):
        il.calibrate_imus(a_board(turning="5 deg/s", attitudes=1), gravity=G)


def test_clipped_readings_are_left_out_and_said():
    board = a_board(duration="20 s", age="0 ms")
    names = [f"gyro_{axis}_{k}" for axis in "xyz" for k in (1, 2, 3)]
    clipped = with_columns(board, **{name: np.clip(board.columns[name], -350, 350) for name in names})
    record = il.calibrate_imus(clipped, gravity=G).calibration
    assert imus_of(record).fit.clipped > 0.1
    at_end = np.any([np.abs(clipped.columns[name]) == 350 for name in names], axis=0)
    assert imus_of(record).fit.bridged == pytest.approx(at_end.mean(), rel=1e-9)
    assert any("have a reading at its limit" in text for text in record.verdict.reasons)
    # Taken for readings, the clipped samples would make the board larger by millimetres.
    found = np.array([imu.position.value for imu in imus_of(record).imus])
    assert np.abs(found - truth_of(board)[:, 0:3]).max() < 4e-4
    assert np.abs(errors(record, board, ("position", "gyro_scale"))).max() < 4.5


def test_the_share_that_fusion_bridges_is_that_of_the_range_which_fusion_takes():
    """Stated: what lies beyond; else what three equal readings in a row show, not two."""
    board = a_board(duration="20 s", age="0 ms")
    stated = il.calibrate_imus(board, gravity=G, gyro_range="200 deg/s").calibration
    columns = [values for name, values in board.columns.items() if name.startswith("gyro")]
    beyond = np.any([np.abs(values) >= 200 for values in columns], axis=0).mean()
    assert beyond > 0.1
    assert imus_of(stated).fit.bridged == pytest.approx(beyond, rel=1e-9)
    assert il.fuse_imus(board, calibration=stated).bridged.mean() == pytest.approx(beyond, abs=0.02)
    twice = board.columns["gyro_x_1"].copy()
    top = int(np.argmax(twice))
    twice[top + 1] = twice[top]
    record = il.calibrate_imus(with_columns(board, gyro_x_1=twice), gravity=G).calibration
    assert imus_of(record).fit.bridged == 0


def test_a_short_motion_is_said():
    record = il.calibrate_imus(a_board(duration="4 s", attitudes=1, rate="100 Hz"), gravity=G).calibration
    assert any("s of motion: below 5 s" in text for text in record.verdict.reasons)


def test_two_imus_in_one_place_are_named():
    board = a_board(elements=3, age="0 ms")
    rng = np.random.default_rng(4)
    twin = {f"accel_{axis}_3": board.columns[f"accel_{axis}_2"] + rng.normal(0, 0.03, len(board)) for axis in "xyz"}
    twin |= {f"gyro_{axis}_3": board.columns[f"gyro_{axis}_2"] + rng.normal(0, 0.1, len(board)) for axis in "xyz"}
    record = il.calibrate_imus(with_columns(board, **twin), gravity=G).calibration
    assert any("IMUs 2 and 3 are" in text and "one sensor, recorded twice" in text for text in record.verdict.reasons)


def test_the_command_makes_the_record_of_the_function(tmp_path, monkeypatch, capsys, simulated):
    monkeypatch.chdir(tmp_path)
    il.write(simulated[0], "board.csv")
    words = ["array", "calibrate", "board.csv", "--imus", "--gravity", str(G), "-o", "r.json", "--report", "r.html"]
    assert main(words) == 0
    assert "size of the board from gravity" in capsys.readouterr().out
    il.calibrate_imus("board.csv", gravity=str(G)).save("f.json")
    one, other = (json.loads((tmp_path / name).read_text()) for name in ("r.json", "f.json"))
    for content in (one, other):
        del content["created"], content["content_sha256"]
    assert one == other
    assert (tmp_path / "r.html").stat().st_size > 10_000


# The size by gravity: boards that are put down softly, or fall onto a face between two samples.


def turned_from_face_to_face(rng, hard, scale=1.0, drift=0.0):
    """Return rests, gyroscopes' readings and gravity of turns of 40 to 60 deg, of which the hard ones stop at once."""
    step, still, noise = 0.016, 125, np.radians(0.2)
    turn, forces = Rotation.identity(), [np.array([0.0, 0.0, G])]
    blocks, rests, begin = [], [], 0
    for abrupt in (*hard, None):
        blocks.append(np.zeros((still, 3)))
        rests.append((begin, begin + still))
        begin += still
        if abrupt is None:
            break
        axis, angle = rng.normal(size=3), np.radians(rng.uniform(40, 60))
        axis /= np.linalg.norm(axis)
        lasts, grid = rng.uniform(0.6, 0.9), step * np.arange(80)
        rise = np.clip(grid / lasts, 0, 1)
        rate = (2 * rise if abrupt else 1 - np.cos(2 * np.pi * rise)) * (rise < 1) * angle / lasts
        blocks.append(rate[:, None] * axis)
        begin += len(grid)
        turn = turn * Rotation.from_rotvec(angle * axis)
        forces.append(turn.inv().apply(forces[0]))
    rate = np.concatenate(blocks)
    time = step * np.arange(len(rate))
    readings = rate / scale + (drift * time / time[-1])[:, None] + rng.normal(0, noise, (2, *rate.shape))
    numbers = np.zeros((2, 29))
    numbers[:, GYRO] = np.eye(3).ravel()
    measured = SimpleNamespace(
        gyro=[make_interp_spline(time, each, k=5) for each in readings], gyro_noise=np.full((2, 3), noise),
        rest_gyro=np.array([[each[a:b].mean(0) for each in readings] for a, b in rests]),
    )  # fmt: skip
    broken = np.zeros(len(time), bool)
    prepared = SimpleNamespace(measured=measured, time=time, broken=broken, rests=np.array(rests), rate=1 / step)
    return prepared, Board(numbers), np.array(forces)


@pytest.mark.parametrize("drift", [0.0, 0.2])
def test_gravity_tells_the_scale_as_well_as_it_says_where_boards_fall_onto_faces(drift):
    z, error = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        factor = by_gravity(*turned_from_face_to_face(rng, [True, False, True, True] * 4, 1.004, np.radians(drift)))
        z.append((factor.value - 1.004) / factor.u)
        error.append(factor.value - 1.004)
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.4
    # A fall ends within 1/sqrt(12) of 16 ms at 150 deg/s: 0.7 deg of 50, 1.4 %; soft turns tell tenths of that.
    assert np.sqrt(np.mean(np.square(error))) < 6e-4


def test_falls_alone_tell_the_scale_as_their_instants_do():
    z, stated = [], []
    for seed in range(40):
        factor = by_gravity(*turned_from_face_to_face(np.random.default_rng(seed), [True] * 16))
        z.append((factor.value - 1) / factor.u)
        stated.append(factor.u)
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.4
    assert 2e-3 < np.mean(stated) < 6e-3


# The equations, against dense ones from differences of the model as it is written.


def written_model(numbers, motion):
    """Return what one sample reads, accelerometers then gyroscopes, IMU by IMU, shape (6 K,)."""
    s, al, w = motion.reshape(3, 3)
    accel = [n[0:9].reshape(3, 3) @ (s + np.cross(w, np.cross(w, n[12:15])) + np.cross(al, n[12:15])) for n in numbers]
    gyro = [n[16:25].reshape(3, 3) @ w + n[25:28] for n in numbers]
    return np.concatenate([*(a + n[9:12] for a, n in zip(accel, numbers, strict=True)), *gyro])


def differences(function, at):
    steps = 1e-5 * np.maximum(1.0, np.abs(at))
    return np.stack(
        [(function(at + e) - function(at - e)) / (2 * h) for h, e in zip(steps, np.diag(steps), strict=True)], axis=1
    )


def test_equations_are_those_of_dense_least_squares():
    prepared = prepare(a_board(duration="6 s", attitudes=1), G)
    n, numbers, motion = 60, prepared.start.numbers, prepared.motion[:60]
    measured = replace(prepared.measured, time=prepared.measured.time[:n], first=prepared.measured.first[:1])
    rng = np.random.default_rng(3)
    accel_weight, gyro_weight = rng.uniform(1, 3, (2, n))
    weights = Weights(accel_weight, gyro_weight, np.ones(1), 0.3e-3)
    problem = _Problem(measured, [])
    readings = measured.at(prepared.start)
    total, scores = problem.equations(prepared.start, motion, readings, weights)
    change = problem.changes(motion)
    dense, right = np.zeros((87, 87)), np.zeros(87)
    for i in range(n):
        h = differences(lambda x: written_model(numbers, x), motion[i])
        j = differences(lambda x, sample=motion[i]: written_model(x.reshape(3, 29), sample), numbers.ravel())
        for k in range(3):  # by the latencies: the readings move backwards in time
            j[3 * k : 3 * k + 3, 29 * k + 15] = -h[3 * k : 3 * k + 3] @ change[i]
            j[9 + 3 * k : 12 + 3 * k, 29 * k + 28] = -h[9 + 3 * k : 12 + 3 * k] @ change[i]
        e = np.concatenate([readings[0][i].ravel(), readings[1][i].ravel()]) - written_model(numbers, motion[i])
        covariance = np.diag(
            np.concatenate([(accel_weight[i] * measured.accel_noise) ** 2, (gyro_weight[i] * measured.gyro_noise) ** 2])
            .reshape(-1)
        )  # fmt: skip
        for k in range(9, 18, 3):
            old = 0.3e-3 * h[k : k + 3, 6:9] @ motion[i, 3:6]
            covariance[k : k + 3, k : k + 3] += np.outer(old, old)
        inverse = np.linalg.inv(covariance)
        m = h.T @ inverse @ h + np.diag([0] * 3 + [1e-6] * 3 + [0] * 3)
        g = h.T @ inverse @ j
        dense += j.T @ inverse @ j - g.T @ np.linalg.solve(m, g)
        right += j.T @ inverse @ e - g.T @ np.linalg.solve(m, h.T @ inverse @ e)
    size = np.sqrt(np.abs(np.outer(np.diag(dense), np.diag(dense)))) + 1e-12
    assert np.abs((total.sum(0) - dense) / size).max() < 1e-4
    assert (
        np.abs((scores.sum(0) - right) / np.sqrt(np.diag(size))).max()
        < 1e-3 * np.abs(right / np.sqrt(np.diag(size))).max()
    )


# Many trials, and a real board.


@pytest.mark.slow
def test_intervals_of_95_percent_cover_the_truth(record_property, reduced):
    """Over many boards 93 to 97 % of what is told, within two standard deviations of what so few trials can tell."""
    z = {name: [] for name in ("position", "accel_latency", "gyro_latency", "accel_bias")}
    trials = 6 if reduced else 30
    for seed in range(trials):
        board = a_board(elements=4, attitudes=12, duration="20 s", rate="100 Hz", age="0 ms", seed=100 + seed)
        record = il.calibrate_imus(board, gravity=G).calibration
        for name, values in z.items():
            values += errors(record, board, (name,)).tolist()
    for name, values in z.items():
        covered = np.mean(np.abs(values) < 1.96)
        record_property(name, f"{covered:.3f} of {len(values)}, rms z {np.sqrt(np.mean(np.square(values))):.3f}")
        # Coordinates of one board share its motion: counted as three for each board.
        doubt = 2 * np.sqrt(0.95 * 0.05 / (3 * trials))
        assert 0.93 - doubt < covered <= 1.0, name


@pytest.mark.skipif(not REAL.is_file(), reason="no real recording here")
def test_a_real_board_has_the_size_of_its_drawing():
    """MIMU4444, 19.05 mm between columns of chips; size by the nominal scale of 96 gyroscopes, as its table has it."""
    record = il.calibrate_imus(str(REAL), gravity=9.82).calibration
    held = imus_of(record)
    position = np.array([imu.position.value for imu in held.imus])
    nominal = 0.01905
    # Chips 1, 3, 5, 7 lie alike, so that where their sensing points are cancels.
    size = np.mean([position[4, 0], position[6, 0], -position[2, 1], -position[6, 1]]) / nominal
    by_nominal_scale = size * held.fit.size.gyro_scale.value
    assert by_nominal_scale == pytest.approx(0.9967, abs=0.005)
    assert abs(size - 1) < 4 * held.fit.size.gravity.standard_uncertainty
    assert np.degrees(held.fit.gyro_residual.value) == pytest.approx(7.0, abs=1.0)
    assert held.fit.age.value == pytest.approx(0.29e-3, abs=0.04e-3)
    assert held.fit.halves < 1.5
    assert record.sources[0].file.endswith("exp_1.bin")
    assert 0.1 < held.fit.clipped < 0.2
    assert any("reading at its limit" in text for text in record.verdict.reasons)
    assert not any("disagree" in text or "answer" in text for text in record.verdict.reasons)


@pytest.mark.skipif(not REAL.is_file(), reason="no real recording here")
def test_accelerometers_of_a_real_board_answer_as_late_as_their_readings_must_be_moved():
    """Centripetal forces between the four chips that lie alike, against products of the mean rate; apart from the fit.

    The accelerometers are moved until nothing is left along the derivative of the products.
    """
    recording = il.read(str(REAL))
    time = recording.columns["time"]
    accel, gyro = (
        {k: np.stack([recording.si(f"{sensor}_{a}_{k}") for a in "xyz"], 1) for k in (1, 3, 5, 7)}
        for sensor in ("accel", "gyro")
    )
    rate = np.mean(list(gyro.values()), 0)
    rate -= rate[:1200].mean(0)
    fastest = np.max([np.abs(each).max(1) for each in gyro.values()], 0) > np.radians(1900)
    use = np.flatnonzero(~np.convolve(fastest, np.ones(9), "same").astype(bool) & (time > 496) & (time < 596))
    x, y, z = rate.T
    products = np.column_stack([x * y, x * z, y * z, x * x, y * y, z * z])
    slopes = np.zeros_like(products)
    slopes[2:-2] = (products[4:] + products[3:-1] - products[1:-3] - products[:-4]) / (6 * 0.016)
    splines = {k: make_interp_spline(time, readings, k=5) for k, readings in accel.items()}

    def left_along_slope(late, axis, plus, minus, squares):
        moved = {k: spline(time[use] + late) for k, spline in splines.items()}
        force = (sum(moved[k] for k in plus) - sum(moved[k] for k in minus))[:, axis]
        centripetal = slopes[:, squares].sum(1)
        columns = [centripetal, *slopes[:, :3].T, *products.T]
        design = np.column_stack([*(c[use] for c in columns), sum(moved.values()), np.ones(len(use))])
        return np.linalg.lstsq(design, force, rcond=None)[0][0]

    sides = ((0, (5, 7), (1, 3), [4, 5]), (1, (1, 5), (3, 7), [3, 5]))
    late = np.mean([brentq(left_along_slope, 0, 5e-3, args=side) for side in sides])
    record = il.calibrate_imus(recording, gravity=9.82).calibration
    fitted = [imu.accel_latency.value - imu.gyro_latency.value for imu in imus_of(record).imus]
    assert np.mean(fitted) == pytest.approx(late, abs=0.25e-3)
    assert np.std(fitted) < 0.05e-3

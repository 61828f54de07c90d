"""The record of a board of whole IMUs: numbers there and back, what takes it and what refuses it by name."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import imulab as il
from imulab.cli import main
from imulab.errors import DataError, RecordError
from imulab.gravity import Gravity
from imulab.procedures.gyro_array.imus import figures, schema
from imulab.procedures.gyro_array.imus.model import ACCEL, GYRO, NUMBERS, Board
from imulab.procedures.gyro_array.imus.record import GAUGE, make_record, parameters_of, record_values
from imulab.procedures.gyro_array.imus.schema import imus_of
from imulab.recording import Recording
from imulab.records.sections import Above0, Length, StatedGravity

FLIPPED = np.diag([1.0, -1.0, -1.0])
"""IMU 2 lies on the other side of the board: a rotation by 180 deg, where a rotation vector changes its sign."""


def a_board(rng):
    """Return a board of three IMUs and a covariance of its numbers, without the seven that the gauge fixes."""
    numbers = np.zeros((3, NUMBERS))
    for k in range(3):
        turned = np.eye(3) if k == 0 else FLIPPED @ Rotation.from_rotvec(rng.normal(0, 0.03, 3)).as_matrix()
        numbers[k, ACCEL] = (np.tril(np.eye(3) + rng.normal(0, 0.01, (3, 3))) @ turned).ravel()
        numbers[k, GYRO] = ((np.eye(3) + rng.normal(0, 0.01, (3, 3))) @ turned).ravel()
        numbers[k, 9:16], numbers[k, 25:29] = rng.normal(0, 0.02, 7), rng.normal(0, 0.01, 4)
    numbers[0, 12:15] = numbers[0, 28] = 0.0
    root = 1e-4 * rng.normal(size=(3 * NUMBERS, 3 * NUMBERS)) / np.sqrt(3 * NUMBERS)
    root[[1, 2, 5, 12, 13, 14, 28]] = 0.0
    return Board(numbers), root @ root.T


def a_record(unknown=(), recording=None):
    rng = np.random.default_rng(5)
    board, covariance = a_board(rng)
    length, freely = (
        Length(value=0.1, unit="1"),
        schema.Three(value=[5.0] * 3, standard_uncertainty=[None] * 3, unit="rad/s"),
    )
    summary = schema.ImusSummary(
        sample_rate=Above0(value=100.0, unit="Hz"), duration=Above0(value=40.0, unit="s"), samples_in_motion=4000,
        rests=12, clipped=0.0, axis_rates=freely, accel_residual=length, gyro_residual=length, accel_factor=1.0,
        gyro_factor=1.0, age=Length(value=0.0, unit="s"), coherence=1.0, widening=1.0, size=schema.BoardSize(),
    )  # fmt: skip
    motion = schema.MotionData(time=[0.0], rate=[1.0], accel_residual=[[0.1] * 3], gyro_residual=[[0.1] * 3])
    record = make_record(
        recording or Recording({"time": np.arange(3.0)}, {"time": "s"}, {"serial": "B7"}),
        board,
        covariance,
        (np.full((3, 3), 0.03), np.full((3, 3), 0.002)),
        model=schema.ImusModel(
            kind="imus",
            imus=3,
            gauge=GAUGE,
            gravity=StatedGravity.of(Gravity(9.81, "argument")),
            units=["m/s^2", "deg/s"],
        ),
        fit=summary,
        data=schema.ImusData(motion=motion),
        common=schema.Common(),
        size_from="gyro scale",
        not_determined=["size"],
        options={"gravity": 9.81},
        unknown=unknown,
    )
    return record, board, covariance


def test_a_record_returns_the_board_that_it_was_made_of(tmp_path):
    record, board, _ = a_record()
    record.save(tmp_path / "board.json")
    held = imus_of(il.load(tmp_path / "board.json"))
    np.testing.assert_allclose(held.board.numbers, board.numbers, rtol=0, atol=1e-14)
    np.testing.assert_allclose(held.accel_noise, 0.03)
    np.testing.assert_allclose(held.gyro_noise, 0.002)
    assert (held.origin, held.size_from, held.not_determined) == ("imu 1", "gyro scale", ["size"])


def test_readings_of_the_record_are_those_of_its_equations(tmp_path):
    record, board, _ = a_record()
    force, rate = np.array([1.0, -2.0, 9.0]), np.array([3.0, 1.0, -2.0])
    for k, imu in enumerate(imus_of(record).imus):
        to_imu = Rotation.from_rotvec(imu.rotation.value).as_matrix().T
        (yx, zx, zy), (gxy, gxz, gyx, gyz, gzx, gzy) = imu.accel.misalignment.value, imu.gyro.misalignment.value
        skewed = np.array([[1, 0, 0], [yx, 1, 0], [zx, zy, 1]])
        accel = np.array(imu.accel.scale_factor.value) * (skewed @ to_imu @ force + imu.accel.bias.value)
        skewed = np.array([[1, gxy, gxz], [gyx, 1, gyz], [gzx, gzy, 1]])
        gyro = np.array(imu.gyro.scale_factor.value) * (skewed @ to_imu @ rate + imu.gyro.bias.value)
        np.testing.assert_allclose(accel, board.accel[k] @ force + board.accel_bias[k], atol=1e-13)
        np.testing.assert_allclose(gyro, board.gyro[k] @ rate + board.gyro_bias[k], atol=1e-13)


def test_uncertainties_are_those_of_boards_drawn_at_random():
    _, board, covariance = a_record()
    _, carried = record_values(board, covariance)
    drawn = np.random.default_rng(6).multivariate_normal(board.numbers.ravel(), covariance, 400)
    others = [[parameters_of(each)[0] for each in numbers.reshape(3, NUMBERS)] for numbers in drawn]
    spread, stated = np.std(others, axis=0).ravel(), np.sqrt(np.diag(carried))
    ratio = spread[stated > 1e-12] / stated[stated > 1e-12]
    assert len(ratio) == 3 * NUMBERS - 7
    assert np.all(np.abs(ratio - 1) < 0.16)  # 4.5 standard deviations of 400 draws


def test_the_gauge_has_no_parameters():
    record, _, _ = a_record()
    fixed = {"gyro_latency_1", *(f"{what}_{axis}_1" for what in ("position", "rotation") for axis in "xyz")}
    assert not fixed & set(record.parameters)
    assert len(record.parameters) == 3 * NUMBERS - 7
    assert set(record.covariance.names) == set(record.parameters)


def test_what_cannot_be_stated_is_null_and_without_covariance():
    record, _, _ = a_record(unknown=[schema.AT_ACCEL_BIAS])
    assert record.parameters["accel_bias_x_2"].standard_uncertainty is None
    assert "accel_bias_x_2" not in record.covariance.names
    assert imus_of(record).imus[1].accel.bias.standard_uncertainty == [None] * 3


def test_axes_that_are_left_handed_are_refused():
    _, board, covariance = a_record()
    numbers = board.numbers.copy()
    numbers[2, ACCEL] = (np.diag([1.0, 1.0, -1.0]) @ board.accel[2]).ravel()
    with pytest.raises(DataError, match="IMU 3: its axes are left-handed"):
        record_values(Board(numbers), covariance)


def test_show_lists_the_imus(tmp_path, capsys):
    record, board, _ = a_record()
    record.save(tmp_path / "board.json")
    assert main(["show", str(tmp_path / "board.json")]) == 0
    printed = capsys.readouterr().out
    assert "Where each IMU sits" in printed
    row = next(line for line in printed.splitlines() if line.split()[:1] == ["2"])
    assert float(row.split()[1]) == pytest.approx(1e3 * board.position[1, 0], abs=0.02)


def test_imus_one_above_the_other_share_a_label_on_the_board():
    record = il.calibrate_imus(il.simulate_imus(elements=8, attitudes=8, duration="12 s", seed=3)).calibration
    (points,) = [trace for trace in record.plot("x and y").figure.traces if trace["mode"] == "markers+text"]
    place = np.round(np.transpose([points["x"], points["y"]]), -1)  # corners of a square of 40 mm, two IMUs at each
    assert sorted(filter(None, points["text"])) == sorted(
        {", ".join(str(j + 1) for j in np.flatnonzero((place == corner).all(axis=1))) for corner in place}
    )
    assert len(set(points["hovertext"])) == 4


@pytest.mark.parametrize(
    "words",
    [
        ["apply", "REC", "rec.csv", "-o", "o.csv"],
        ["export", "--to", "px4", "REC", "-o", "out"],
    ],
)
def test_what_takes_no_board_refuses_it_by_name(tmp_path, capsys, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    record, _, _ = a_record()
    record.save(tmp_path / "REC")
    (tmp_path / "rec.csv").write_text(
        "time [s],accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2]\n0,0,0,9.8\n0.01,0,0,9.8\n"
    )
    assert main(words) == 2
    message = capsys.readouterr().err
    assert "array" in message
    assert not (tmp_path / "o.csv").exists()
    assert not (tmp_path / "out").exists()


def test_a_record_of_one_imu_or_of_something_else_is_refused():
    record, _, _ = a_record()
    with pytest.raises(RecordError, match=r"as imus has, found 3|expected two or more"):
        imus_of(
            il.Calibration(**{**record.__dict__, "sections": {**record.sections, "imus": record.sections["imus"][:1]}})
        )
    with pytest.raises(RecordError, match="--imus', found one of a comparison"):
        imus_of(il.Calibration(**{**record.__dict__, "model": {**record.model, "kind": "comparison"}}))


def test_the_report_draws_the_board_with_its_ellipses():
    record, board, _ = a_record()
    exhibits = figures.exhibits(record)
    drawn = next(item for item in exhibits.figures if item.title == "The board, x and y")
    ellipses, places = drawn.traces[:-1], drawn.traces[-1]
    np.testing.assert_allclose(places["x"], 1e3 * board.position[:, 0], rtol=1e-6)
    assert len(ellipses) == 2  # IMU 1 is the origin
    factor = int(re.search(r"drawn (\d+) times", drawn.caption)[1])
    covariance = record.covariance.block(["position_x_2", "position_y_2"])
    # The ellipse of 95 % reaches sqrt(5.991) standard deviations along each axis.
    reach = [np.ptp(ellipses[0][axis]) / 2 / factor for axis in "xy"]
    np.testing.assert_allclose(reach, 1e3 * np.sqrt(5.991 * np.diag(covariance)), rtol=0.01)
    late = next(item for item in exhibits.figures if item.title == "How late each IMU answers")
    np.testing.assert_allclose(late.traces[0]["y"], 1e3 * board.numbers[:, 15], rtol=1e-6)
    residuals = next(item for item in exhibits.figures if item.title == "Residuals of the gyroscopes in motion")
    assert residuals.traces[-1]["y"][0] == pytest.approx(np.degrees(0.002), rel=1e-5)

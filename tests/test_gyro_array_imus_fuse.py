"""Whole IMUs fused from recordings: columns, latencies, blocks, points, limits and refusals."""

from itertools import pairwise

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.gravity import Gravity
from imulab.procedures.gyro_array.imus import schema, simulate
from imulab.procedures.gyro_array.imus.columns import RangeFinder
from imulab.procedures.gyro_array.imus.fuse import BoardFuser, board_of, ranges, read_late
from imulab.procedures.gyro_array.imus.model import NUMBERS, Board
from imulab.procedures.gyro_array.imus.record import GAUGE, make_record
from imulab.records.sections import Above0, Length, StatedGravity
from test_gyro_array_imus_record import a_record

G = 9.80665


def truth(board, name):
    """A truth in the head of a simulated board, a row an IMU."""
    count = sum(key.startswith("truth_position") for key in board.metadata)
    return np.array([[float(v) for v in board.metadata[f"truth_{name}_{k + 1}"].split()] for k in range(count)])


def true_record(board, limits=None):
    """The record of a simulated board whose calibration is without error; `limits` as in `make_record`."""
    names = ("accel", "accel_bias", "position", "latency", "gyro", "gyro_bias")
    accel, bias, position, late, gyro, gyro_bias = (truth(board, name) for name in names)
    count = len(accel)
    numbers = np.hstack([accel, bias, position, late[:, :1], gyro, gyro_bias, late[:, 1:]])
    assert numbers.shape == (count, NUMBERS)
    three, length = (
        schema.Three(value=[5.0] * 3, standard_uncertainty=[None] * 3, unit="rad/s"),
        Length(value=0.1, unit="1"),
    )
    summary = schema.ImusSummary(
        sample_rate=Above0(value=100.0, unit="Hz"), duration=Above0(value=40.0, unit="s"), samples_in_motion=4000,
        rests=12, clipped=0.0, axis_rates=three, accel_residual=length, gyro_residual=length, accel_factor=1.0,
        gyro_factor=1.0, age=Length(value=0.0, unit="s"), coherence=1.0, widening=1.0, size=schema.BoardSize(),
    )  # fmt: skip
    motion = schema.MotionData(time=[0.0], rate=[1.0], accel_residual=[[0.1] * count], gyro_residual=[[0.1] * count])
    gravity = StatedGravity.of(Gravity(9.80665, "argument"))
    return make_record(
        board, Board(numbers), 1e-12 * np.eye(NUMBERS * count),
        (np.full((count, 3), 0.03), np.full((count, 3), np.radians(0.1))),
        limits,
        model=schema.ImusModel(kind="imus", imus=count, gauge=GAUGE, gravity=gravity, units=["m/s^2", "deg/s"]),
        fit=summary, data=schema.ImusData(motion=motion), common=schema.Common(), size_from="gyro scale",
        not_determined=[], options={},
    )  # fmt: skip


@pytest.fixture(scope="module")
def board():
    return il.simulate_imus(elements=4, attitudes=1, duration="6 s", rate="200 Hz", age="0 s", seed=3)


@pytest.fixture(scope="module")
def record(board):
    return true_record(board)


def motion_at(board, point):
    """True force at a point from IMU 1, rate and angular acceleration of the board above."""
    path, _ = simulate.path_by_hand(1, 6.0, np.radians(380.0), "xyz", np.random.default_rng(3))
    force, rate, acceleration = path.at(board.si("time"))
    return force + np.cross(acceleration, point) + np.cross(rate, np.cross(rate, point)), rate, acceleration


def test_force_rate_and_angular_acceleration_are_those_of_the_path(board, record):
    out = il.fuse_imus(board, calibration=record)
    force, rate, acceleration = motion_at(board, truth(board, "position").mean(axis=0))
    inner = slice(3, -3)
    for found, true, deviation in (
        (out.force, force, out.force_std), (out.rate, rate, out.rate_std),
        (out.acceleration, acceleration, out.acceleration_std),
    ):  # fmt: skip
        z = ((found - true) / deviation)[inner]
        assert np.sqrt(np.mean(z**2)) == pytest.approx(0.96, abs=0.06)  # interpolation averages a little
    assert out.used.mean() > 0.999
    raw = il.fuse_imus(board, calibration=true_record(without_latency(board)))
    z = ((raw.force - force) / raw.force_std)[inner]
    assert np.sqrt(np.mean(z**2)) > 1.5  # what the latencies cost where they are left in


def without_latency(board):
    head = {key: "0 0" if key.startswith("truth_latency") else value for key, value in board.metadata.items()}
    return il.Recording(board.columns, board.units, head, board.name)


@pytest.mark.parametrize("at", ["imu:3", "0.01,-0.02,0.005"])
def test_the_force_is_that_at_the_point(board, record, at):
    point = truth(board, "position")[2] if at == "imu:3" else np.array([0.01, -0.02, 0.005])
    out = il.fuse_imus(board, calibration=record, at=at)
    z = ((out.force - motion_at(board, point)[0]) / out.force_std)[3:-3]
    assert np.sqrt(np.mean(z**2)) == pytest.approx(0.96, abs=0.06)  # interpolation averages a little


def part_of(board, rows):
    columns = {name: values[rows] for name, values in board.columns.items()}
    return il.Recording(columns, board.units, board.metadata, board.name)


def test_blocks_give_the_same_to_the_last_bit_wherever_they_are_cut(board, record):
    known = board_of(record, "centroid", ranges([board], None, None))
    whole = il.fuse_imus(board, calibration=record).recording()
    for cuts in ([1, 2, 3, 500], [len(board) - 1], list(range(7, len(board), 7))):
        edges = [0, *cuts, len(board)]
        blocks = [part_of(board, slice(a, b)) for a, b in pairwise(edges)]
        fuser = BoardFuser(known)
        parts = [part.recording() for part in fuser.fuse(blocks)]
        for name, column in whole.columns.items():
            assert np.array_equal(np.concatenate([part.columns[name] for part in parts]), column, equal_nan=True)
    assert max(len(part) for part in parts) < 40  # what waits stays small


def test_late_readings_are_a_polynomial_of_degree_5_and_linear_beside_faults():
    time = np.cumsum(np.random.default_rng(1).uniform(0.008, 0.012, 40))
    curve = np.polynomial.Polynomial([1.0, -2.0, 300.0, 40.0, -5e3, 9e4])
    values = np.stack([curve(time), np.full(40, 0.7), time], axis=1)
    found = read_late(time, values, slice(5, 30), 0.0021, 1e30, 0.015)
    np.testing.assert_allclose(found[:, 0], curve(time[5:30] + 0.0021), rtol=1e-9)
    assert (found[:, 1] == 0.7).all()  # held readings stay held
    values[15] = np.nan
    found = read_late(time, values, slice(5, 30), 0.0021, 1e30, 0.015)
    assert np.flatnonzero(np.isnan(found[:, 2])).tolist() == [9, 10]
    np.testing.assert_allclose(found[[6, 12], 2], time[[11, 17]] + 0.0021, rtol=1e-12)
    clipped = np.minimum(values, time[20])
    found = read_late(time, clipped, slice(18, 24), 0.0021, time[20], 0.015)
    assert (found[2:, 2] == time[20]).all()
    gap = np.concatenate([time[:20], time[20:] + 1.0])
    found = read_late(gap, values, slice(19, 21), 0.0021, 1e30, 0.015)
    assert np.array_equal(found[0], values[19])  # nothing is read from within a gap
    ends = read_late(time, values, slice(0, 40), -0.0021, 1e30, 0.015)
    assert np.array_equal(ends[0], values[0])
    assert np.array_equal(read_late(time[:1], values[:1], slice(0, 1), 0.01, 1e30, 0.015), values[:1])


def test_ends_of_ranges_are_found_however_blocks_are_cut():
    rng = np.random.default_rng(2)
    y = rng.normal(size=(400, 2, 3, 3)) * np.array([20.0, 3.0])[:, None, None]
    y[:, 1, 1] = np.clip(40 * np.sin(np.arange(400) / 20)[:, None] + y[:, 1, 1], -34.9, 34.8)
    y[10:30, 0, 2, 1] = y[10, 0, 2, 1] = 5.0  # held, but nowhere near an end
    for size in (400, 7, 1):
        finder = RangeFinder(3)
        for a in range(0, 400, size):
            finder.watch(y[a : a + size])
        assert finder.limits().tolist() == [[1e30] * 3, [1e30, 34.8, 1e30]]


def clipped_board(board, limit):
    columns = dict(board.columns)
    for name in columns:
        if name.startswith("gyro"):
            columns[name] = np.clip(columns[name], -limit, limit)
    return il.Recording(columns, board.units, board.metadata, board.name)


def test_clipped_gyroscopes_are_bridged_and_flagged(board, record):
    out = il.fuse_imus(clipped_board(board, 300.0), calibration=record)
    rate = motion_at(board, np.zeros(3))[1]
    beyond = (np.abs(np.degrees(rate)) > 320).any(axis=1)
    assert beyond.mean() > 0.05
    assert out.bridged[beyond].all()
    assert not out.bridged[(np.abs(np.degrees(rate)) < 200).all(axis=1)].any()
    error = np.degrees(np.linalg.norm(out.rate - rate, axis=1))[out.bridged]
    assert np.median(error) < 5
    stated = il.fuse_imus(clipped_board(board, 300.0), calibration=record, gyro_range="300 deg/s")
    assert np.array_equal(stated.bridged, out.bridged)


def test_only_a_range_that_is_stated_now_overrules_that_of_the_record(board, record):
    """A reading that a log repeats at its maximum is no end of a range that the record holds."""
    columns = {name: values.copy() for name, values in board.columns.items()}
    top = int(np.argmax(columns["gyro_x_1"][10:-10])) + 10
    columns["gyro_x_1"][top - 2 : top + 3] = columns["gyro_x_1"][top]
    repeated = il.Recording(columns, board.units, board.metadata, "repeated.csv")
    wide = true_record(board, np.array([[1e30] * 4, [np.radians(2000.0)] * 4]))
    assert il.fuse_imus(repeated, calibration=record).bridged[top]  # nothing else is known of the range
    assert not il.fuse_imus(repeated, calibration=wide).bridged.any()
    assert il.fuse_imus(repeated, calibration=wide, gyro_range="300 deg/s").bridged[top]
    apart = [
        [entry.samples for entry in il.compare_imus(repeated, calibration=known, **by).gyro["turning"] if entry]
        for known, by in ((record, {}), (wide, {}), (record, {"gyro_range": "2000 deg/s"}))
    ]
    assert apart[0] != apart[1] == apart[2]


def disturbed(board):
    """Knocks, repeated rows, dropouts and an IMU that is dead from the start."""
    columns = {name: values.copy() for name, values in board.columns.items()}
    for name, values in columns.items():
        if name.endswith("_4"):
            values[:] = 0.0
        if name != "time":
            values[650:653] = values[649]
            values[700:704] = np.nan
    columns["accel_x_2"][[300, 620, 710]] += 30.0
    columns["gyro_y_1"][500:520] = np.nan
    time = columns["time"]
    time[800:] += 0.7
    return il.Recording(columns, board.units, board.metadata, "bad.csv")


def test_disturbed_data_cost_what_they_touch_and_are_named(board, record, tmp_path, capsys):
    bad = disturbed(board)
    il.write(bad, tmp_path / "bad.csv")
    record.save(tmp_path / "rec.json")
    out_file = tmp_path / "out.csv"
    assert main(["array", "fuse", str(tmp_path / "bad.csv"), "--imus", "--calibration", str(tmp_path / "rec.json"),
                 "-o", str(out_file)]) == 0  # fmt: skip
    said = capsys.readouterr()
    assert "samples of 4 IMUs fused" in said.out
    assert "accelerometer 4: left out of" in said.err
    assert "gyroscope 4: left out of" in said.err
    assert "a gap of 0.705 s" in said.err
    out = il.read(out_file)
    assert list(out.columns) == ["time", *(f"{s}_{x}" for s in ("accel", "gyro", "angular_accel") for x in "xyz"),
                                 *(f"std_{s}_{x}" for s in ("accel", "gyro", "angular_accel") for x in "xyz"),
                                 "bridged"]  # fmt: skip
    assert [out.units[n] for n in ("accel_x", "gyro_y", "angular_accel_z", "std_gyro_x", "bridged")] == [
        "m/s^2", "deg/s", "rad/s^2", "deg/s", "1",
    ]  # fmt: skip
    lost = np.flatnonzero(np.isnan(out.columns["gyro_x"]))
    assert set(lost) <= set(range(699, 705))
    assert {701, 702} <= set(lost)
    whole = il.fuse_imus(board, calibration=record)
    error = np.abs(out.columns["accel_x"] - whole.force[:, 0])
    away = np.setdiff1d(np.arange(len(board)), np.concatenate([np.arange(645, 658), np.arange(695, 760)]))
    assert np.nanquantile(error[away], 0.99) < 0.1  # the dead IMU is not in it


def test_a_stream_from_a_pipe_and_a_file_give_the_same(board, record, tmp_path, capsysbinary, monkeypatch):
    il.write(board, tmp_path / "b.csv")
    record.save(tmp_path / "rec.json")
    words = ["array", "fuse", str(tmp_path / "b.csv"), "--imus", "--calibration", str(tmp_path / "rec.json")]
    assert main(words) == 0
    printed = capsysbinary.readouterr().out
    assert main([*words, "-o", str(tmp_path / "o.csv")]) == 0
    assert (tmp_path / "o.csv").read_bytes() == printed


def recording_with(board, **changes):
    columns, units = dict(board.columns), dict(board.units)
    for name, value in changes.items():
        if value is None:
            del columns[name], units[name]
        elif isinstance(value, str):
            units[name] = value
        else:
            columns[name] = value
    return il.Recording(columns, units, board.metadata, "b.csv")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"accel_z_3": None}, ["no column accel_z_3; expected 4 whole IMUs"]),
        ({"gyro_x_2": "count"}, ["column gyro_x_2", "count", "expected a unit of rate"]),
        ({f"{s}_{x}_4": None for s in ("accel", "gyro") for x in "xyz"}, ["3 IMUs; the record has 4"]),
        ({f"{s}_{x}_{k}": None for s in ("accel", "gyro") for x in "xyz" for k in (2, 3, 4)},
         ["expected columns accel_x_1 .. accel_z_K"]),
        ({"time": None}, ["time"]),
        ({"time": "back"}, ["row 501", "time runs backwards"]),
    ],
    ids=["column", "unit", "count", "single", "no time", "backwards"],
)  # fmt: skip
def test_what_cannot_be_fused_is_refused_by_name(board, record, tmp_path, capsys, changes, words):
    if changes.get("time") == "back":
        time = board.columns["time"].copy()
        time[500:] -= 1.0
        changes = {"time": time}
    il.write(recording_with(board, **changes), tmp_path / "b.csv")
    record.save(tmp_path / "rec.json")
    status = main(["array", "fuse", str(tmp_path / "b.csv"), "--imus", "--calibration", str(tmp_path / "rec.json"),
                   "-o", str(tmp_path / "o.csv")])  # fmt: skip
    message = capsys.readouterr().err
    assert status == 2
    assert message.count("\n") == 1
    assert all(word in message for word in ["b.csv", *words])
    assert not (tmp_path / "o.csv").exists()


@pytest.mark.parametrize(
    ("at", "message"),
    [
        ("imu:5", "expected an IMU from 1 to 4"),
        ("imu:0", "expected an IMU from 1 to 4"),
        ("here", "expected centroid, imu:N, or x,y,z in m"),
        ("centriod", "did you mean 'centroid'?"),
        ("1,2", "expected centroid, imu:N, or x,y,z in m"),
        ("1,2,nan", "expected centroid, imu:N, or x,y,z in m"),
    ],
)
def test_points_that_are_not_there_are_refused(board, record, at, message):
    with pytest.raises(il.ImulabError, match=message):
        il.fuse_imus(board, calibration=record, at=at)


def test_a_record_of_something_else_is_refused(board, tmp_path, capsys):
    fit = il.calibrate_array(il.simulate_array(experiment="static", duration=60.0))
    with pytest.raises(il.ImulabError, match="expected the record of 'imulab array calibrate --imus'"):
        il.fuse_imus(board, calibration=fit)
    a_record()[0].save(tmp_path / "rec.json")
    il.write(il.simulate_array(duration=5.0), tmp_path / "g.csv")
    assert main(["array", "fuse", str(tmp_path / "g.csv"), "--calibration", str(tmp_path / "rec.json")]) == 2
    assert "'imulab array fuse --imus' takes" in capsys.readouterr().err


def test_the_result_shows_itself(board, record):
    out = il.fuse_imus(clipped_board(board, 300.0), calibration=record)
    exhibits = out.exhibits()
    assert "bridged by the accelerometers" in exhibits.headline
    assert exhibits.items[0].traces[-1]["name"] == "bridged"
    assert len(exhibits.items[1].rows) == 4
    assert "4 IMUs" in repr(out)

"""Logs of PX4 and ArduPilot with several IMUs: read on one clock, calibrated, or refused with a measured reason."""

import io
import re
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.errors import DataError, ObservabilityError, OptionError, ReadError
from imulab.procedures.gyro_array.imus.schema import imus_of
from imulab.readers.instances import LoggedTriad, imus_on_one_clock
from reference.flightlogs import ulog
from reference.handheld import (
    G,
    a_board,
    ardupilot,
    filtered,
    move,
    px4,
    px4_vehicle,
    read,
    streams,
)

PLACES = np.array([[0, 0, 0], [0.03, 0.01, 0], [-0.01, 0.02, 0.005]])
RATES = {"accel": 200, "gyro": 250}


def shared_stamps(data, board, motion, rng):
    """The same with accelerometers read at the stamps of their gyroscopes."""
    out = dict(data)
    for k in range(len(board.position)):
        t = data["gyro", k][0]
        out["accel", k] = (t, read(board, motion, k, "accel", (t - 5_000_000) / 1e6, rng, 0.03))
    return out


@pytest.fixture(scope="module")
def hand():
    """A board of three IMUs, its motion by hand, and its streams at raw rates."""
    rng = np.random.default_rng(4)
    board, motion = a_board(rng, PLACES), move(rng, duration=12.0)
    return board, motion, streams(board, motion, rng, RATES)


@pytest.fixture
def file(tmp_path):
    def write(data, name="log.ulg"):
        path = tmp_path / name
        path.write_bytes(data)
        return path

    return write


def errors(record, board):
    """Errors over standard uncertainties of positions and latencies that the gauge leaves free."""
    imus = imus_of(record).imus
    z = []
    for k, imu in enumerate(imus):
        for value, truth in (
            (imu.position, board.position[k]),
            (imu.accel_latency, board.accel_late[k]),
            (imu.gyro_latency, board.gyro_late[k]),
        ):
            got, u = np.atleast_1d(value.value), np.atleast_1d(np.array(value.standard_uncertainty, dtype=float))
            z += ((got - truth)[u > 0] / u[u > 0]).tolist()
    return np.array(z)


def changed(data, keys, change):
    return {key: change(*part) if key in keys else part for key, part in data.items()}


# --- reading -------------------------------------------------------------------------------------------------------


def test_all_instances_are_read_as_the_official_readers_read_them(hand, file):
    from pymavlink.DFReader import DFReader_binary
    from pyulog import ULog

    data = hand[2]
    log = px4(data)
    recording = il.read(file(log), instance="all")
    assert list(recording.columns)[:4] == ["time", "accel_x_1", "accel_y_1", "accel_z_1"]
    assert sum(name.startswith("gyro_y_") for name in recording.columns) == 3
    assert {recording.units["accel_x_3"], recording.units["gyro_z_2"]} == {"m/s^2", "rad/s"}
    by_oracle = {(d.name, d.multi_id): d.data for d in ULog(io.BytesIO(log)).data_list}
    own = by_oracle["sensor_accel", 0]  # the slowest triad is the clock, and is not interpolated
    inside = np.isin(np.rint(recording.time * 1e6).astype(int), own["timestamp_sample"])
    assert inside.all()
    at = np.searchsorted(own["timestamp_sample"], np.rint(recording.time * 1e6).astype(int))
    np.testing.assert_allclose(recording.columns["accel_x_1"], own["x"][at].astype(float), atol=1e-9)
    path = file(ardupilot(data, raw=True), "log.bin")
    raw = il.read(path, instance="all")
    np.testing.assert_allclose(raw.columns["gyro_z_2"], recording.columns["gyro_z_2"], atol=1e-6)
    reader, stamps = DFReader_binary(str(path)), []
    while (message := reader.recv_match(type="ACC")) is not None:
        stamps += [message.SampleUS] * (message.I == 0)
    reader.close()
    assert np.isin(np.rint(raw.time * 1e6).astype(int), stamps).all()


def test_readings_are_interpolated_to_where_the_motion_was(hand, file):
    board, motion, data = hand
    quiet = np.random.default_rng(0)
    exact = {
        key: (t, read(board, motion, key[1], key[0], (t - 5_000_000) / 1e6, quiet, 1e-6))
        for key, (t, _) in data.items()
    }
    recording = il.read(file(px4(exact)), instance="all")
    for sensor, within in (("accel", 1e-3), ("gyro", 1e-4)):
        truth = read(board, motion, 2, sensor, recording.time - 5.0, quiet, 0.0)
        got = np.column_stack([recording.columns[f"{sensor}_{axis}_3"] for axis in "xyz"])
        assert np.quantile(np.abs(got - truth), 0.99) < within  # the simulated angular acceleration has kinks
    assert "interpolated to the time stamps of sensor_accel 0 (200 Hz)" in recording.notes[-1]


def test_nothing_is_made_up_in_a_gap(hand, file):
    def holed(t, v):
        keep = (t < 20_000_000) | (t > 20_500_000)
        return t[keep], v[keep]

    data = changed(hand[2], [("gyro", 1)], holed)
    recording = il.read(file(px4(data)), instance="all")
    within = (recording.time > 20.01) & (recording.time < 20.49)
    assert np.isnan(recording.columns["gyro_x_2"][within]).all()
    assert np.isfinite(recording.columns["gyro_x_1"]).all()
    assert any("1 of sensor_gyro 1, 0.5" in note for note in recording.notes)


def test_gyroscopes_stand_beside_the_accelerometer_of_their_device(hand, file):
    swapped = {("gyro", 0): 1001, ("gyro", 1): 1000}
    recording = il.read(file(px4(hand[2], swapped)), instance="all")
    as_logged = il.read(file(px4(hand[2])), instance="all")
    difference = recording.columns["gyro_x_1"][100:-100] - as_logged.columns["gyro_x_2"][100:-100]
    assert np.abs(difference).max() < 1e-9
    assert any("of the same device" in note for note in recording.notes)


def test_devices_of_which_some_match_are_paired_and_the_rest_stand_in_order(hand, file):
    # Of accelerometers 1000, 1001, 1002 and gyroscopes 1001, 7, 1000 the last accelerometer has a chip of two numbers.
    recording = il.read(file(px4(hand[2], {("gyro", 0): 1001, ("gyro", 1): 7, ("gyro", 2): 1000})), instance="all")
    as_logged = il.read(file(px4(hand[2])), instance="all")
    for to, logged in ((1, 3), (2, 1), (3, 2)):
        difference = recording.columns[f"gyro_x_{to}"] - as_logged.columns[f"gyro_x_{logged}"]
        assert np.abs(difference[100:-100]).max() < 1e-9
    assert any(note.endswith("numbers differ: sensor_gyro 1 beside sensor_accel 2") for note in recording.notes)
    assert not any("numbers differ" in note for note in as_logged.notes)


@pytest.mark.parametrize(("skipped", "much"), [(2.0, False), (30.0, True)])
def test_an_instance_that_begins_late_is_named(hand, file, skipped, much):
    data = changed(hand[2], [("accel", 1)], lambda t, v: (t[t > t[0] + 1e6 * skipped], v[t > t[0] + 1e6 * skipped]))
    recording = il.read(file(px4(data)), instance="all")
    (said,) = [note for note in recording.notes if "rows begin there" in note]
    assert re.search(rf"sensor_accel 1 begins {skipped:.3g}\d*(\.\d+)? s after sensor_\w+ \d: ", said)
    assert said.startswith("truncated stream: ") == much
    assert not any("rows begin there" in note for note in il.read(file(px4(hand[2])), instance="all").notes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda d: {k: v for k, v in d.items() if k != ("gyro", 2)},
            "3 accelerometers and 2 gyroscopes: sensor_",
        ),
        (lambda d: {k: v for k, v in d.items() if k[1] == 0}, "of two IMUs or more are needed, found sensor_accel 0"),
        (lambda d: changed(d, [("gyro", 1)], lambda t, v: (t, 0 * v)), "sensor_gyro 1: 1 different readings"),
        (lambda d: changed(d, [("accel", 2)], lambda t, v: (t + 10**9, v)), "they have no time in common"),
    ],
)
def test_logs_that_are_no_board_are_refused(hand, file, change, message):
    with pytest.raises(ReadError, match=message):
        il.read(file(px4(change(hand[2]))), instance="all")


def test_time_that_runs_backwards_is_refused(hand):
    triads = {(sensor, k): LoggedTriad(f"{sensor} {k}", *hand[2][sensor, k]) for sensor, k in hand[2]}
    stamps = hand[2]["gyro", 1][0].copy()
    stamps[500] = stamps[400]
    triads["gyro", 1] = replace(triads["gyro", 1], ticks=stamps)
    accels, gyros = ([triads[sensor, k] for k in range(3)] for sensor in ("accel", "gyro"))
    with pytest.raises(ReadError, match="the time of gyro 1 goes backwards: expected more than"):
        imus_on_one_clock(accels, gyros, "log", {}, ())


def test_one_sensor_twice_and_a_sensor_that_changes_are_refused(hand, file):
    with pytest.raises(ReadError, match="sensor_accel 0 and sensor_accel 1 are one sensor, device 1000"):
        il.read(file(px4(hand[2], {("accel", 1): 1000})), instance="all")
    data = {key: (t[:200], v[:200]) for key, (t, v) in hand[2].items()}
    log = px4(data)
    at = log.rindex((1002).to_bytes(4, "little"))
    with pytest.raises(ReadError, match="2 changes from one sensor to another, by its device_id"):
        il.read(file(log[:at] + b"\x07" + log[at + 1 :]), instance="all")


def test_a_log_of_one_imu_says_what_to_log(file, capsys):
    fields = (
        "uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;int32_t accelerometer_timestamp_relative;"
        "float[3] accelerometer_m_s2;uint32_t accelerometer_integral_dt;"
    )
    rows = [(0, (t, 0.1, 0.2, 0.3, 4000, 0, 0.1, 0.2, 9.8, 4000)) for t in range(0, 10**6, 4000)]
    path = file(ulog({"sensor_combined": fields}, [(0, 0, "sensor_combined")], rows))
    assert main(["array", "calibrate", str(path), "--imus", "--gravity", "9.80665"]) == 2
    assert "sensor_combined holds the one IMU that PX4 flies by; log sensor_accel and" in capsys.readouterr().err
    with pytest.raises(OptionError, match="instance 'both': expected a whole number"):
        il.read(path, instance="both")


@pytest.mark.parametrize("kind", [b"char[04]", b"float[1]"])
def test_a_device_that_is_no_whole_number_is_not_read(hand, file, kind):
    infinity = 0x7F800000  # as a float
    log = px4({key: (t[:100], v[:100]) for key, (t, v) in hand[2].items()}, dict.fromkeys(hand[2], infinity))
    with pytest.raises(ReadError, match=f"sensor_accel 0 and .* are one sensor, device {infinity}"):
        il.read(file(log), instance="all")
    recording = il.read(file(log.replace(b"uint32_t device_id", kind + b" device_id")), instance="all")
    assert sum(name.startswith("gyro_x_") for name in recording.columns) == 3


@pytest.mark.parametrize("key", ["TimeUS", "SampleUS"])
def test_text_in_the_place_of_a_time_is_refused(hand, file, key):
    log = ardupilot({key: (t[:50], v[:50]) for key, (t, v) in hand[2].items()}, raw=True)
    types = {"TimeUS": b"nBQfff", "SampleUS": b"QBnfff"}[key]
    with pytest.raises(ReadError, match=f"message ACC: expected a whole number in field {key}, found type 'n'"):
        il.read(file(log.replace(b"QBQfff", types), "log.bin"), instance="all")


# --- calibration ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["px4", "ardupilot", "two", "jitter"])
def test_raw_logs_tell_positions_and_latencies(hand, file, kind):
    board, motion, data = hand
    if kind == "jitter":
        data = streams(board, motion, np.random.default_rng(8), RATES, jitter=8e-4)
    if kind == "two":
        data = {key: part for key, part in data.items() if key[1] < 2}
        board = replace(board, position=board.position[:2])
    log = ardupilot(data, raw=True) if kind == "ardupilot" else px4(data)
    record = il.calibrate_imus(file(log, "log.bin" if kind == "ardupilot" else "log.ulg"), gravity=G).calibration
    z = errors(record, board)
    assert len(z) == (6 if kind == "two" else 11)
    assert np.abs(z).max() < 4.0
    assert np.sqrt(np.mean(z**2)) < 2.0
    u = [u for imu in imus_of(record).imus[1:] for u in imu.position.standard_uncertainty]
    assert min(u) < 1e-4
    assert max(u) < (3e-3 if kind == "two" else 1e-4)
    if kind == "two":
        assert any(name.startswith("gyroscopes' matrix") for name in imus_of(record).not_determined)


def test_vehicle_imu_and_filtered_imu_messages_tell_them_too(hand, file):
    board, motion, _ = hand
    rng = np.random.default_rng(5)
    raw = shared_stamps(streams(board, motion, rng, {"accel": 200, "gyro": 200}, jitter=0), board, motion, rng)
    for data, name in ((px4_vehicle(raw, 1), "v.ulg"), (ardupilot(filtered(raw, 20.0, 1)), "f.bin")):
        record = il.calibrate_imus(file(data, name), gravity=G).calibration
        assert np.abs(errors(record, board)).max() < 4.5
    # A filter makes the noise alike from row to row: the uncertainties are those of raw readings, not smaller.
    plain = il.calibrate_imus(file(ardupilot(raw), "r.bin"), gravity=G).calibration
    u = [np.array(imus_of(r).imus[1].position.standard_uncertainty) for r in (record, plain)]
    assert (u[0] > 0.8 * u[1]).all()
    narrow = il.calibrate_imus(file(ardupilot(filtered(raw, 8.0, 1)), "n.bin"), gravity=G).calibration
    assert any("were filtered at about" in reason for reason in narrow.verdict.reasons)


def test_a_thinned_log_says_its_rate(hand, file):
    board, motion, _ = hand
    rng = np.random.default_rng(5)
    raw = shared_stamps(streams(board, motion, rng, {"accel": 200, "gyro": 200}, jitter=0), board, motion, rng)
    with pytest.raises(ObservabilityError, match="cannot tell where its IMUs sit: 25 readings a second of each IMU"):
        il.calibrate_imus(file(ardupilot(filtered(raw, 20.0, 8)), "log.bin"), gravity=G)


@pytest.mark.parametrize(
    ("motion", "vibration", "message"),
    [
        ({"size": 0.08, "shake": 1}, 0.0, r"turned by only \d\.\d deg/s rms about axis [xyz] of IMU 1 in the 10 s"),
        (
            {"size": 0.6, "about": (0.1, 0.1, 1), "shake": 1},
            0.0,
            r"turned by only 3.* [34]\d about z\), where 30 are needed about each",
        ),
        ({"size": 1.5, "shake": 3}, 3.0, r"it lies nowhere still: its accelerometers scatter by 2\.\d m"),
    ],
)
def test_an_ordinary_flight_gets_the_sentence(file, motion, vibration, message):
    rng = np.random.default_rng(6)
    board = a_board(rng, PLACES)
    flown = move(rng, attitudes=1, duration=30, **motion)
    with pytest.raises(ObservabilityError, match=f"this log cannot tell where its IMUs sit: .*{message}"):
        il.calibrate_imus(file(px4(streams(board, flown, rng, RATES, vibration=vibration))), gravity=G)


def test_motors_that_run_in_motion_only_are_seen(file):
    rng = np.random.default_rng(7)
    board, flown = a_board(rng, PLACES), move(rng, attitudes=1, duration=20, size=1.5, shake=3)
    still, shaken = (streams(board, flown, np.random.default_rng(7), RATES, vibration=v) for v in (0.0, 0.3))
    data = {key: (t, np.where((t < 9_000_000)[:, None], v, shaken[key][1])) for key, (t, v) in still.items()}
    with pytest.raises(ObservabilityError, match=r"in motion its accelerometers vibrate by 0\.\d+ m/s\^2 rms above 30"):
        il.calibrate_imus(file(px4(data)), gravity=G)


# --- disturbed logs ------------------------------------------------------------------------------------------------


def clocked(share):
    return lambda t, v: (t[0] + np.rint((t - t[0]) * (1 + share)).astype(np.int64), v)


@pytest.mark.parametrize(("share", "shown"), [(0.01, "1 %"), (-0.01, "1 %"), (1e-3, "0.1 %")])
def test_an_instance_with_a_wrong_clock_is_named(hand, file, share, shown):
    data = changed(hand[2], [("accel", 1), ("gyro", 1)], clocked(share))
    way = "fast" if share > 0 else "slow"
    with pytest.raises(DataError, match=f"gyroscopes of IMU 2 run {shown} {way} against IMU 1's.*with --instance all"):
        il.calibrate_imus(file(px4(data)), gravity=G)


def test_the_clock_of_an_accelerometer_is_checked_however_its_imu_is_turned(hand, file):
    turn = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    data = changed(hand[2], [("accel", 1), ("gyro", 1)], lambda t, v: (t, v @ turn))
    record = il.calibrate_imus(file(px4(data)), gravity=G).calibration
    assert not any("time stamps" in reason for reason in record.verdict.reasons)
    with pytest.raises(DataError, match=r"accelerometers of IMU 2 run (0\.1\d?|0\.09\d?) % fast against IMU 1's"):
        il.calibrate_imus(file(px4(changed(data, [("accel", 1)], clocked(1e-3)))), gravity=G)


def test_a_small_drift_is_said(hand, file):
    data = changed(hand[2], [("accel", 1), ("gyro", 1)], clocked(3e-5))
    record = il.calibrate_imus(file(px4(data)), gravity=G).calibration
    assert any("gyroscopes of IMU 2 run" in reason and "ppm fast" in reason for reason in record.verdict.reasons)


@pytest.mark.parametrize(("share", "code"), [(2, 0), (8, 2)])
def test_an_instance_that_stops_early_is_named(hand, file, capsys, share, code):
    data = changed(hand[2], [("gyro", 2)], lambda t, v: (t[: len(t) // share], v[: len(t) // share]))
    assert main(["array", "calibrate", str(file(px4(data))), "--imus", "--gravity", "9.80665"]) == code
    out, err = capsys.readouterr()
    assert re.search(r"sensor_gyro 2 ends \d+(\.\d+)? s before sensor_", out + err)
    assert ("cannot tell where its IMUs sit: it is turned by only" in err) == (code == 2)
    assert "look: " in out or code
    assert "Traceback" not in err


def test_dropouts_and_repeated_rows_leave_true_intervals(hand, file):
    board, _, data = hand
    rng = np.random.default_rng(9)

    def worn(t, v):
        keep = rng.random(len(t)) > 0.005
        for start in (49.0, 52.0, 55.0):
            keep &= ~((t > 1e6 * start) & (t < 1e6 * (start + 0.2)))
        at = np.sort(np.concatenate([np.flatnonzero(keep), rng.choice(np.flatnonzero(keep), 200)]))
        return t[at], v[at]

    record = il.calibrate_imus(file(px4(changed(data, list(data), worn))), gravity=G).calibration
    assert np.abs(errors(record, board)).max() < 4.0
    assert any(text.startswith("gaps are left out of all IMUs") for text in record.warnings)
    assert any(text.startswith("rows that repeat the row before") for text in record.warnings)


def test_a_log_is_calibrated_and_fused_by_the_commands(hand, file, capsys, tmp_path):
    path, record, fused = file(px4(hand[2])), tmp_path / "rec.json", tmp_path / "fused.csv"
    assert main(["array", "calibrate", str(path), "--imus", "--gravity", "9.80665", "-o", str(record)]) == 0
    assert "interpolated to the time stamps of sensor_accel 0" in str(il.load(record).warnings)
    assert main(["array", "fuse", str(path), "--imus", "--calibration", str(record), "-o", str(fused)]) == 0
    assert "samples of 3 IMUs fused" in capsys.readouterr().out
    assert main(["array", "compare", str(path), "--imus", "--calibration", str(record)]) == 2
    assert "a board of 3 IMUs: expected 4 or more" in capsys.readouterr().err
    assert main(["convert", str(path), "--instance", "all", "-o", str(tmp_path / "board.csv")]) == 0
    again = il.calibrate_imus(tmp_path / "board.csv", gravity=G).calibration
    np.testing.assert_allclose(
        [imu.position.value for imu in imus_of(again).imus],
        [imu.position.value for imu in imus_of(il.load(record)).imus],
        atol=1e-6,
    )

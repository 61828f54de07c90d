"""PX4 ULog and ArduPilot DataFlash: read by imulab, and by the official readers as a check of the files."""

import io

import numpy as np
import pytest

import imulab as il
from imulab.errors import ImulabError, OptionError, ReadError
from imulab.readers.streams import one_clock
from imulab.records.calibration import Calibration, Covariance, Parameter
from reference.flightlogs import dataflash, ulog

ACCEL = (
    "uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;float x;float y;float z;float temperature;"
    "uint32_t error_count;uint8_t[3] clip_counter;uint8_t samples;uint8_t[4] _padding0;"
)
GYRO = ACCEL.replace("uint8_t[4] _padding0", "uint8_t[4] _padding0")
COMBINED = (
    "uint64_t timestamp;float[3] gyro_rad;uint32_t gyro_integral_dt;int32_t accelerometer_timestamp_relative;"
    "float[3] accelerometer_m_s2;uint32_t accelerometer_integral_dt;uint8_t accelerometer_clipping;"
)
FORMATS = {
    "sensor_accel": ACCEL,
    "sensor_gyro": GYRO,
    "sensor_combined": COMBINED,
    "other": "uint64_t timestamp;float v;",
}
AXES = "xyz"


def vectors(count, seed):
    return np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)


def sensor(number, times, values, warm=20.0, delay=150):
    for i, t in enumerate(times.tolist()):
        row = (t + delay, t, 77, *values[i].tolist(), warm + 0.5 * i, 0, 0, 0, 0, 1)
        yield t + delay, (number, row)


def ordered(*streams):
    return [message for _, message in sorted((m for s in streams for m in s), key=lambda m: m[0])]


def px4_log(accel_times, gyro_times, accel, gyro, **options):
    data = ordered(
        sensor(3, accel_times, accel),
        sensor(4, gyro_times, gyro),
        sensor(5, accel_times, -accel, 40.0),
        ((t, (9, (t, 1.0))) for t in accel_times.tolist()),
    )
    subscriptions = [(0, 3, "sensor_accel"), (0, 4, "sensor_gyro"), (1, 5, "sensor_accel"), (0, 9, "other")]
    return ulog(FORMATS, subscriptions, data, **options)


@pytest.fixture
def file(tmp_path):
    def write(data: bytes, name: str = "log.ulg"):
        path = tmp_path / name
        path.write_bytes(data)
        return path

    return write


@pytest.fixture(scope="module")
def streams():
    accel_times = 5_000_000 + np.cumsum(np.random.default_rng(1).integers(4800, 5200, 400))
    gyro_times = 4_999_000 + np.arange(1700) * 1250
    return accel_times, gyro_times, vectors(400, 2), vectors(1700, 3)


def check(recording, streams, sign=1, warm=20.0):
    accel_times, gyro_times, accel, gyro = streams
    own = recording.stream("accel")
    np.testing.assert_array_equal(own.time, accel_times / 1e6)
    np.testing.assert_array_equal(own.triad("accel"), sign * accel.astype(float))
    np.testing.assert_array_equal(own.column("temperature"), np.float32(warm) + 0.5 * np.arange(len(accel)))
    if gyro is not None:
        own = recording.stream("gyro")
        np.testing.assert_array_equal(own.time, gyro_times / 1e6)
        np.testing.assert_array_equal(own.triad("gyro"), gyro.astype(float))


# --- PX4 -----------------------------------------------------------------------------------------------------------


def test_accelerometer_gyroscope_and_temperature_of_a_ulog(file, streams):
    recording = il.read(file(px4_log(*streams, info={"sys_name": "PX4", "ver_hw": "FMU_V6X"})))
    check(recording, streams)
    assert recording.units == {
        "time": "s",
        **{f"accel_{a}": "m/s^2" for a in AXES},
        "temperature": "degC",
        "time_gyro": "s",
        **{f"gyro_{a}": "rad/s" for a in AXES},
    }
    assert recording.metadata["autopilot"] == "PX4"
    assert recording.metadata["hardware"] == "FMU_V6X"
    assert not any("interpolated" in note for note in recording.notes)
    assert any(note.startswith("instance 0 of sensor_accel 0, sensor_accel 1") for note in recording.notes)


def test_the_official_reader_agrees_that_the_file_is_a_ulog(streams):
    from pyulog import ULog

    log = ULog(io.BytesIO(px4_log(*streams)))
    (mine,) = [d for d in log.data_list if d.name == "sensor_accel" and d.multi_id == 0]
    np.testing.assert_array_equal(mine.data["timestamp_sample"], streams[0])
    np.testing.assert_array_equal(mine.data["y"], streams[2][:, 1])


def test_another_instance(file, streams):
    path = file(px4_log(*streams))
    accel_times, gyro_times, accel, gyro = streams
    recording = il.read(path, instance=1)
    for other in ("1", np.int64(1)):
        assert np.array_equal(il.read(path, instance=other).columns["accel_x"], recording.columns["accel_x"])
    for wrong in (1.5, [0], "-1", -1, True):
        with pytest.raises(OptionError, match=r"instance.*: expected a (whole )?number"):
            il.read(path, instance=wrong)
    check(recording, (accel_times, gyro_times, accel, None), -1, 40.0)
    assert "gyro_x" not in recording
    with pytest.raises(OptionError, match="no sensor_accel sensor_gyro of instance 2; found sensor_accel 0,"):
        il.read(path, instance=2)
    with pytest.raises(OptionError, match="topic 'imu'; of a ULog these can be read: sensor_accel sensor_gyro"):
        il.read(path, topic="imu")
    gyro_only = il.read(path, topic="sensor_gyro")
    np.testing.assert_array_equal(gyro_only.triad("gyro"), gyro)
    np.testing.assert_array_equal(gyro_only.time, gyro_times / 1e6)


def test_blocks_join_to_the_whole(file, streams, monkeypatch):
    path = file(px4_log(*streams))
    monkeypatch.setattr("imulab.readers.logs.BLOCK_BYTES", 3001)
    monkeypatch.setattr("imulab.readers.streams._ROWS", 50)
    blocks = list(il.read_blocks(path))
    assert len(blocks) > 4
    assert [b.first_row for b in blocks] == np.cumsum([1, *map(len, blocks[:-1])]).tolist()
    check(il.read(path), streams)


def test_sensor_combined_with_its_own_clock_for_the_accelerometer(file):
    times = 1_000_000 + np.arange(300) * 4000
    accel, gyro = vectors(300, 4), vectors(300, 5)
    relative = np.full(300, -500)
    relative[100] = 2**31 - 1  # no accelerometer sample
    rows = [
        (1, (t, *gyro[i].tolist(), 4000, relative[i], *accel[i].tolist(), 4000, 0))
        for i, t in enumerate(times.tolist())
    ]
    path = file(ulog(FORMATS, [(0, 1, "sensor_combined")], rows))
    recording = one_clock(il.read(path), "accel")
    there = (np.arange(300) != 100) & (np.arange(300) != 0)  # before the first sample of the gyroscope
    np.testing.assert_array_equal(recording.time, (times - 500)[there] / 1e6)
    np.testing.assert_array_equal(recording.triad("accel"), accel[there])
    for i, axis in enumerate(AXES):
        expected = np.interp((times - 500)[there], times, gyro[:, i].astype(float))
        np.testing.assert_allclose(recording.column(f"gyro_{axis}"), expected, atol=1e-12)
    assert any("already corrected" in note for note in recording.notes)


def test_a_gap_of_the_gyroscope_is_not_bridged(file, streams):
    accel_times, gyro_times, accel, gyro = streams
    there = (gyro_times < 5_500_000) | (gyro_times > 5_900_000)
    recording = one_clock(il.read(file(px4_log(accel_times, gyro_times[there], accel, gyro[there]))), "accel")
    missing = np.isnan(recording.column("gyro_x"))
    np.testing.assert_array_equal(
        missing,
        (accel_times > gyro_times[there & (gyro_times < 5_500_000)][-1])
        & (accel_times < gyro_times[there & (gyro_times > 5_900_000)][0]),
    )


def test_streams_one_behind_the_other_are_read_and_joined(file, streams, monkeypatch):
    """A log that holds all accelerometer samples, then all of the gyroscope's."""
    accel_times, gyro_times, accel, gyro = streams
    mine, theirs = list(sensor(3, accel_times, accel)), list(sensor(4, gyro_times, gyro))
    subscriptions = [(0, 3, "sensor_accel"), (0, 4, "sensor_gyro")]

    def log(messages, name):
        return file(ulog(FORMATS, subscriptions, [message for _, message in messages]), name)

    path = log([*mine, *theirs], "behind.ulg")
    check(il.read(path), streams)
    monkeypatch.setattr("imulab.readers.streams._ROWS", 50)
    monkeypatch.setattr("imulab.readers.streams._PATIENCE", 200)
    monkeypatch.setattr("imulab.readers.logs.BLOCK_BYTES", 1000)
    check(il.read(path), streams)
    # One that only ends early does not hold up the other.
    ended = log(sorted([*mine, *theirs[:200]], key=lambda m: m[0]), "ended.ulg")
    recording = il.read(ended)
    np.testing.assert_array_equal(recording.stream("accel").triad("accel"), accel)
    assert recording.notes[-1].startswith("truncated stream: the gyroscope ends 1.7")
    recording = one_clock(recording, "accel")
    there = accel_times <= gyro_times[199]
    assert (~there).sum() > 300
    np.testing.assert_array_equal(recording.triad("accel"), accel[there])
    rows, ends = recording.notes[-2:]
    assert rows.startswith(f"{(~there).sum()} rows of the accelerometer left out where the gyroscope")
    assert ends.startswith("truncated stream: the gyroscope ends 1.7")


@pytest.mark.parametrize("rows", [1 << 16, 50])
def test_nothing_is_made_up_where_a_stream_has_not_begun_or_has_ended(file, streams, monkeypatch, rows):
    monkeypatch.setattr("imulab.readers.streams._ROWS", rows)
    monkeypatch.setattr("imulab.readers.logs.BLOCK_BYTES", 3001)
    accel_times, gyro_times, accel, gyro = streams
    # Much longer than the steps of the gyroscope, 1.25 ms: the first rows stay, without its readings.
    part = (gyro_times > 5_300_000) & (gyro_times < 6_700_000)
    first, last = gyro_times[part][0], gyro_times[part][-1]
    recording = one_clock(il.read(file(px4_log(accel_times, gyro_times[part], accel, gyro[part]))), "accel")
    before_end = accel_times <= last
    np.testing.assert_array_equal(recording.triad("accel"), accel[before_end])
    known = accel_times[before_end] >= first
    lost = (accel_times[-1] - last) / 1e6
    (said,) = [note for note in recording.notes if "rows end there" in note]
    assert said.startswith(f"truncated stream: the gyroscope ends {lost:.4g} s before the accelerometer")
    assert f"{lost:.4g} s ({100 * lost / ((accel_times[-1] - accel_times[0]) / 1e6):.2g} %) of the acc" in said
    for axis in AXES:
        np.testing.assert_array_equal(np.isfinite(recording.column(f"gyro_{axis}")), known)
    # By a few steps: these rows are left out, and nothing else.
    near = (gyro_times > accel_times[0] + 100) & (gyro_times < accel_times[-1] - 6000)
    first, last = gyro_times[near][0], gyro_times[near][-1]
    kept = (accel_times >= first) & (accel_times <= last)
    recording = one_clock(il.read(file(px4_log(accel_times, gyro_times[near], accel, gyro[near]))), "accel")
    assert 2 <= np.count_nonzero(~kept) <= 4
    np.testing.assert_array_equal(recording.time, accel_times[kept] / 1e6)
    np.testing.assert_array_equal(recording.triad("accel"), accel[kept])
    assert np.isfinite(recording.triad("gyro")).all()
    said = [note for note in recording.notes if "of the accelerometer left out where the gyroscope" in note]
    assert [int(note.split()[0]) for note in said] == [np.count_nonzero(~kept)]
    blocks = list(il.read_blocks(file(px4_log(accel_times, gyro_times[near], accel, gyro[near]))))
    assert [b.first_row for b in blocks] == np.cumsum([1, *map(len, blocks[:-1])]).tolist()


def test_every_command_warns_of_a_gyroscope_that_stops_early(file, streams, imulab):
    accel_times, gyro_times, accel, gyro = streams
    path = file(px4_log(accel_times, gyro_times[:160], accel, gyro[:160]))
    done = imulab("convert", path, "-o", "out.csv")
    assert done.returncode == 0
    (line,) = [line for line in done.stderr.splitlines() if "warning" in line]
    assert "truncated stream: the gyroscope ends" in line
    assert "warning: truncated stream" in imulab("show", path).stdout
    with pytest.raises(ReadError, match="the accelerometer and the gyroscope have no time in common"):
        il.read(file(px4_log(accel_times, gyro_times[:160] - 1_000_000, accel, gyro[:160]), "apart.ulg"))


def low_rate_log(accel_count, combined_count):
    accel_times = 1_000_000 + np.arange(accel_count) * 200_000
    times = 1_000_000 + np.arange(combined_count) * 4000
    accel, both = vectors(accel_count, 4), vectors(combined_count, 5)
    combined = (
        (t, (9, (t, *both[i].tolist(), 4000, 0, *(-both[i]).tolist(), 4000, 0))) for i, t in enumerate(times.tolist())
    )
    data = ordered(sensor(3, accel_times, accel), sensor(4, accel_times, accel), combined)
    subscriptions = [(0, 3, "sensor_accel"), (0, 4, "sensor_gyro"), (0, 9, "sensor_combined")]
    return ulog(FORMATS, subscriptions, data), accel, both


def test_the_topic_of_the_higher_rate_is_read(file):
    data, accel, both = low_rate_log(6, 250)
    recording = il.read(file(data))
    np.testing.assert_array_equal(recording.triad("accel"), -both)
    np.testing.assert_array_equal(recording.triad("gyro"), both)
    assert (
        "sensor_combined, which has 250 samples, is read rather than 6 of sensor_accel and 6 of sensor_gyro; "
        "a topic chooses" in recording.notes
    )
    assert len(il.read(file(data), topic="sensor_accel")) == 6
    # What the sensors gave themselves is preferred where there is about as much of it.
    data, accel, both = low_rate_log(6, 6)
    recording = il.read(file(data))
    np.testing.assert_array_equal(recording.triad("accel"), accel)
    assert not any("sensor_combined" in note for note in recording.notes)


def test_the_combined_topic_is_not_read_where_one_sensor_has_plainly_more(file):
    slow, fast, both = (1_000_000 + np.arange(200, step=step) * 1000 for step in (10, 1, 4))
    gyro = vectors(200, 3)
    combined = ((t, (9, (t, 0, 0, 0, 4000, 0, 0, 0, 0, 4000, 0))) for t in both.tolist())
    data = ordered(sensor(3, slow, vectors(20, 1)), sensor(4, fast, gyro), combined)
    subscriptions = [(0, 3, "sensor_accel"), (0, 4, "sensor_gyro"), (0, 9, "sensor_combined")]
    recording = il.read(file(ulog(FORMATS, subscriptions, data)))
    np.testing.assert_array_equal(recording.stream("gyro").triad("gyro"), gyro)
    assert (
        "sensor_combined, which has 50 samples, is not read: there are 20 of sensor_accel and 200 of sensor_gyro; "
        "a topic chooses" in recording.notes
    )


@pytest.mark.parametrize("gyros", [0, 5])
def test_raw_accelerations_of_ardupilot_do_not_cost_the_gyroscope(file, gyros):
    slow, fast = 1_000_000 + np.arange(10) * 40_000, 1_000_000 + np.arange(400) * 1000
    few, many = vectors(10, 1), vectors(400, 2)
    rows = ordered(
        imu_rows(slow, few, -few),
        ((t, ("ACC", (t, 0, t, *many[i].tolist()))) for i, t in enumerate(fast.tolist())),
        ((t, ("GYR", (t, 0, t, 0.0, 0.0, 0.0))) for t in slow[:gyros].tolist()),
    )
    recording = il.read(file(dataflash({**IMU, **RAW}, rows), "raw.bin"))
    np.testing.assert_array_equal(recording.triad("gyro"), -few)
    assert (
        f"ACC, which has 400 samples, is not read but 10 of IMU: of GYR there are {gyros}; a topic chooses"
        in recording.notes
    )


def test_raw_messages_of_ardupilot_are_read_where_they_are_logged_faster(file):
    slow, fast = 1_000_000 + np.arange(10) * 40_000, 1_000_000 + np.arange(400) * 1000
    few, many = vectors(10, 1), vectors(400, 2)
    rows = ordered(
        imu_rows(slow, few, few),
        ((t, ("ACC", (t, 0, t, *many[i].tolist()))) for i, t in enumerate(fast.tolist())),
        ((t, ("GYR", (t, 0, t, *(-many[i]).tolist()))) for i, t in enumerate(fast.tolist())),
    )
    path = file(dataflash({**IMU, **RAW}, rows), "raw.bin")
    recording = il.read(path)
    np.testing.assert_array_equal(recording.triad("accel"), many)
    np.testing.assert_array_equal(recording.triad("gyro"), -many)
    assert "ACC, which has 400 samples, is read rather than 10 of IMU; a topic chooses" in recording.notes
    np.testing.assert_array_equal(il.read(path, topic="IMU").triad("accel"), few)


def test_a_cut_ulog_is_read_up_to_the_cut_with_a_warning(file, streams, imulab):
    whole = px4_log(*streams)
    path = file(whole[: len(whole) // 2 + 7])
    recording = il.read(path)
    (note,) = [n for n in recording.notes if n.startswith("truncated")]
    assert f"at byte {len(whole) // 2 + 7}"[:-3] in note
    own = recording.stream("accel")
    n = len(own)
    assert 150 < n < 250
    np.testing.assert_array_equal(own.triad("accel"), streams[2][:n])
    done = imulab("convert", path, "-o", "out.csv")
    assert done.returncode == 0
    assert [line for line in done.stderr.splitlines() if "warning" in line and "truncated" in line]
    assert "warning: truncated" in imulab("show", path).stdout


def test_data_appended_after_a_crash_are_left_alone(file, streams):
    body = px4_log(*streams)
    flags = bytes(8) + bytes([1]) + bytes(7)
    offset = len(px4_log(*streams, flags=flags + bytes(24)))
    whole = px4_log(*streams, flags=flags + offset.to_bytes(8, "little") + bytes(16)) + b"\xff\xffgarbage"
    assert len(body) < offset
    recording = il.read(file(whole))
    check(recording, streams)
    assert not any("truncated" in note for note in recording.notes)
    with pytest.raises(ReadError, match="needs a newer reader"):
        il.read(file(px4_log(*streams, flags=bytes(8) + bytes([2]) + bytes(31))))


ULOG_DAMAGE = {
    "empty": (lambda w: b"", "the file is empty"),
    "header": (lambda w: w[:10], "header of 16 bytes, found 10"),
    "only header": (lambda w: w[:16], "no sensor_accel sensor_gyro or sensor_combined; topics found: none"),
    "type": (lambda w: w + b"\x05\x00\x01abcde", r"damaged at byte \d+: expected a ULog message, found 05 00 01"),
    "no format": (lambda w: w.replace(b"sensor_accel:", b"sensor_accol:"), "sensor_accel is logged, but its format"),
    "field": (lambda w: w.replace(b"float x;float y", b"float X;float y"), "sensor_accel has no field x"),
    "format": (
        lambda w: w.replace(b"uint32_t device_id;float x", b"uint99_t device_id;float x"),
        "found 'uint99_t devi",
    ),
    "time": (
        lambda w: w.replace(b"uint64_t timestamp_sample", b"float[1] timestamp_sample"),
        "expected whole microseconds in timestamp_sample",
    ),
    "utf-8": (lambda w: w.replace(b"sensor_gyro:", b"sensor_gyr\xff:"), "expected UTF-8 text"),
}


@pytest.mark.parametrize("case", ULOG_DAMAGE)
def test_a_damaged_ulog_is_refused(file, streams, case):
    change, message = ULOG_DAMAGE[case]
    changed = change(px4_log(*streams))
    with pytest.raises(ReadError, match=message):
        il.read(file(changed))


# --- ArduPilot -----------------------------------------------------------------------------------------------------

IMU = {"IMU": (150, "QBffffffIIfBBHH", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz")}
RAW = {
    "ACC": (160, "QBQfff", "TimeUS,I,SampleUS,AccX,AccY,AccZ"),
    "GYR": (161, "QBQfff", "TimeUS,I,SampleUS,GyrX,GyrY,GyrZ"),
}
MSG = {"MSG": (170, "QZ", "TimeUS,Message")}


def imu_rows(times, accel, gyro, instance=0, warm=30.0):
    for i, t in enumerate(times.tolist()):
        yield t, ("IMU", (t, instance, *gyro[i].tolist(), *accel[i].tolist(), 0, 0, warm + 0.5 * i, 1, 1, 1000, 1000))


@pytest.fixture(scope="module")
def samples():
    return 2_000_000 + np.arange(300) * 2500, vectors(300, 6), vectors(300, 7)


def ardupilot_log(samples):
    times, accel, gyro = samples
    rows = ordered(imu_rows(times, accel, gyro), imu_rows(times, -accel, -gyro, 1, 50.0))
    return dataflash({**IMU, **MSG}, [("MSG", (1, b"ArduCopter V4.5.7 (abc)")), *rows])


def test_imu_messages_of_a_dataflash_log(file, samples):
    times, accel, gyro = samples
    path = file(ardupilot_log(samples), "log.bin")
    for instance, sign, warm in ((0, 1, 30.0), (1, -1, 50.0)):
        recording = il.read(path, instance=instance)
        np.testing.assert_array_equal(recording.time, times / 1e6)
        np.testing.assert_array_equal(recording.triad("accel"), sign * accel)
        np.testing.assert_array_equal(recording.triad("gyro"), sign * gyro)
        np.testing.assert_array_equal(recording.column("temperature"), warm + 0.5 * np.arange(300))
        assert recording.metadata["autopilot"] == "ArduCopter V4.5.7 (abc)"
        assert any(f"instance {instance} of 2 of IMU" in note for note in recording.notes)
    with pytest.raises(OptionError, match="no IMU of instance 2; found IMU 0, IMU 1"):
        il.read(path, instance=2)
    with pytest.raises(OptionError, match="of a DataFlash log these can be read: IMU ACC GYR"):
        il.read(path, topic="BARO")


def test_the_official_reader_agrees_that_the_file_is_a_dataflash_log(file, samples):
    from pymavlink import DFReader

    log = DFReader.DFReader_binary(str(file(ardupilot_log(samples), "log.bin")))
    first = log.recv_match(type="IMU")
    assert (first.TimeUS, first.I) == (2_000_000, 0)
    assert first.AccY == pytest.approx(float(samples[1][0, 1]))
    log.close()


def test_raw_accelerometer_and_gyroscope_messages(file):
    accel_times, gyro_times = 10_000 + np.arange(400) * 1000, 9_700 + np.arange(820) * 500
    accel, gyro = vectors(400, 8), vectors(820, 9)
    rows = ordered(
        ((t, ("ACC", (t, 0, t - 100, *accel[i].tolist()))) for i, t in enumerate(accel_times.tolist())),
        ((t, ("GYR", (t, 0, t - 90, *gyro[i].tolist()))) for i, t in enumerate(gyro_times.tolist())),
    )
    recording = il.read(file(dataflash(RAW, rows), "raw.bin"))
    for sensor, times, values in (("accel", accel_times, accel), ("gyro", gyro_times, gyro)):
        own = recording.stream(sensor)
        np.testing.assert_allclose(np.diff(own.time), np.diff(times) / 1e6, atol=1e-12)
        np.testing.assert_array_equal(own.triad(sensor), values)


def test_old_logs_have_one_message_name_an_instance_and_milliseconds(file):
    fields = "IffffffIIf", "TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T"
    messages = {"IMU": (150, *fields), "IMU2": (151, *fields)}
    accel = vectors(50, 10)
    rows = []
    for i in range(50):
        rows.append(("IMU", (i * 20, 0, 0, 0, *accel[i].tolist(), 0, 0, 25.0)))
        rows.append(("IMU2", (i * 20, 0, 0, 0, *(-accel[i]).tolist(), 0, 0, 26.0)))
    path = file(dataflash(messages, rows), "old.bin")
    np.testing.assert_array_equal(il.read(path).triad("accel"), accel)
    second = il.read(path, instance=1)
    np.testing.assert_array_equal(second.triad("accel"), -accel)
    np.testing.assert_array_equal(second.time, np.arange(50) * 20 / 1000)


@pytest.mark.parametrize("title", ["T", "Temp"])
def test_the_temperature_of_new_and_old_imu_messages(file, title):
    fields = "QfffffffIf", f"TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,Spare,ErrA,{title}"
    rows = [("IMU", (i * 1000, 0, 0, 0, 1, 2, 3, 0, 0, 20.0 + i)) for i in range(9)]
    recording = il.read(file(dataflash({"IMU": (150, *fields)}, rows), "old.bin"))
    np.testing.assert_array_equal(recording.column("temperature"), 20.0 + np.arange(9))


def test_scaled_fields_are_scaled(file):
    messages = {"IMU": (150, "Qccceeec", "TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,T")}
    recording = il.read(file(dataflash(messages, [("IMU", (5, 1, 2, 3, 981, -5, 0, 2150))] * 3), "c.bin"))
    np.testing.assert_allclose(recording.triad("gyro")[0], [0.01, 0.02, 0.03])
    np.testing.assert_allclose(recording.triad("accel")[0], [9.81, -0.05, 0.0])
    assert recording.column("temperature")[0] == 21.5


@pytest.mark.parametrize("tail", [b"", b"\xff" * 5000, b"\0" * 5000])
def test_a_cut_or_filled_log_is_read_up_to_there_with_a_warning(file, samples, tail):
    whole = ardupilot_log(samples)
    cut = len(whole) // 2 if not tail else len(whole)
    recording = il.read(file(whole[:cut] + tail, "cut.bin"))
    assert any(note.startswith("truncated") for note in recording.notes)
    np.testing.assert_array_equal(recording.triad("accel"), samples[1][: len(recording)])
    assert len(recording) == 300 if tail else 140 < len(recording) < 160


DATAFLASH_DAMAGE = {
    "junk": (
        lambda w: w[:9000] + w[9000:].replace(b"\xa3\x95\x96", b"\x13\x37\x96", 1),
        r"damaged at byte 9\d+: .* found 13 37",
    ),
    "no imu": (lambda w: w.replace(b"IMU\0", b"IMV\0"), "no IMU, ACC or GYR messages; messages found: IMV MSG"),
    "field": (lambda w: w.replace(b"AccZ", b"AccW"), "message IMU has no field AccZ"),
    "types": (lambda w: w.replace(b"QBffffffIIfBBHH", b"QBdddddddddBBHH"), "message IMU: fields of"),
    "text for time": (
        lambda w: w.replace(b"QBffff", b"ZBffff"),
        "expected a whole number in field TimeUS, found type 'Z'",
    ),
    "fraction for instance": (lambda w: w.replace(b"QBffff", b"Qfffff"), "a whole number in field I, found type 'f'"),
    "text for a reading": (
        lambda w: w.replace(b"QBffff", b"QBfnff"),
        "expected a number in field GyrY, found type 'n'",
    ),
    "only head": (lambda w: w[:89], "messages found: none"),
    "three bytes": (lambda w: w[:3], "messages found: none"),
}


@pytest.mark.parametrize("case", DATAFLASH_DAMAGE)
def test_a_damaged_dataflash_log_is_refused(file, samples, case):
    change, message = DATAFLASH_DAMAGE[case]
    with pytest.raises(ImulabError, match=message):
        il.read(file(change(ardupilot_log(samples)), "bad.bin"))


def test_a_text_log_of_ardupilot_asks_for_the_binary_one(file):
    with pytest.raises(ReadError, match=r"an ArduPilot log as text; expected the binary log \(\.bin\)"):
        il.read(file(b"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\n", "log.log"))


def test_a_refusal_stays_one_line_where_there_is_also_something_to_warn_of(file, streams, imulab, tmp_path):
    cut = file(px4_log(*streams)[:-5], "cut.ulg")
    for unit, lines in (("count", 1), ("m/s^2", 4)):
        terms = {"bias": (0.0, "m/s^2"), "scale_factor": (1.0, f"{unit}/(m/s^2)")}
        parameters = {f"{stem}_{a}": Parameter(v, None, of) for stem, (v, of) in terms.items() for a in AXES}
        parameters |= {f"misalignment_{pair}": Parameter(0.0, None, "rad") for pair in ("yx", "zx", "zy")}
        model = {"order": 1, "output_unit": unit, "temperature": {"value": -60.0, "unit": "degC"}}
        Calibration("tumble", parameters, Covariance((), ()), model, {}).save(tmp_path / "rec.json")
        done = imulab("apply", "rec.json", cut, "-o", "out.csv")
        assert done.stderr.count("\n") == lines, done.stderr
        assert (tmp_path / "out.csv").exists() == (unit == "m/s^2")
        assert ("outputs in count" in done.stderr) == (done.returncode == 2) == (unit == "count")
    assert "truncated" in done.stderr
    assert "K away" in done.stderr
    assert "resampled: accel from 199.721 Hz to 800 Hz" in done.stderr
    assert "corrected by rec.json: out.csv" in done.stderr


@pytest.fixture
def cut(file, streams, imulab):
    """A cut log, and records of an accelerometer triad and of a warm-up table, beside it."""
    assert imulab("tumble", "simulate", "-o", "t.csv").returncode == 0
    assert imulab("tumble", "fit", "t.csv", "--gravity", 9.81, "-o", "t.json").returncode == 0
    return file(px4_log(*streams)[:-5], "cut.ulg").name


REFUSED = {
    "tumble fit": "tumble fit cut.ulg --gravity 9.81 -o r.json",
    "tumble gyro": "tumble gyro cut.ulg --accel t.json -o r.json",
    "array calibrate": "array calibrate cut.ulg -o r.json",
    "warmup fit": "warmup fit cut.ulg --temperature-column --latest-start 10 -o r.json",
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_procedure_refuses_a_cut_log_in_one_line_that_says_so(case, cut, imulab, tmp_path):
    done = imulab(*REFUSED[case].split())
    print(done.stderr, done.stdout)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "cut.ulg" in done.stderr
    assert "truncated: the last message, at byte" in done.stderr
    assert not (tmp_path / "r.json").exists()

"""ROS 1 bags, MCAP and ROS 2 sqlite files made by rosbags, read without it."""

import hashlib
import shutil
import sqlite3
import struct

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1

import bags
import imulab as il
from imulab.errors import ImulabError, OptionError, ReadError
from imulab.readers import logs
from imulab.readers.streams import one_clock

IMU, TEMPERATURE, FIELD = "sensor_msgs/msg/Imu", "sensor_msgs/msg/Temperature", "std_msgs/msg/String"
EPOCH = bags.EPOCH
COUNT = 700
KINDS = ["bag", "mcap", "sqlite"]
AXES = "xyz"


@pytest.fixture(scope="module")
def truth():
    rng = np.random.default_rng(1)
    stamps = EPOCH + np.cumsum(rng.integers(4_000_000, 6_000_000, COUNT)) - 5_000_000
    return stamps, rng.normal(size=(COUNT, 3)), rng.normal(size=(COUNT, 3))


def imus(truth, topic="/imu", **options):
    stamps, accel, gyro = truth
    for i, stamp in enumerate(stamps.tolist()):
        # The stamp of the log is later than that of the header, by a varying delay.
        yield (
            topic,
            IMU,
            stamp + 1_000_000 + i % 7,
            lambda t, k, i=i, s=stamp: bags.imu(t, k, s, accel[i], gyro[i], **options),
        )


def text(topic="/chatter"):
    return topic, FIELD, EPOCH, lambda t, k: t.types["std_msgs/msg/String"](data="hello")


def merged(*streams):
    return sorted((m for s in streams for m in s), key=lambda m: m[2])


def check(recording, truth):
    stamps, accel, gyro = truth
    np.testing.assert_array_equal(recording.triad("accel"), accel)
    np.testing.assert_array_equal(recording.triad("gyro"), gyro)
    np.testing.assert_array_equal(recording.time, (stamps - stamps[0]) / 1e9)
    first = int(stamps[0])
    assert recording.metadata["epoch"] == f"{first // 10**9}.{first % 10**9:09d} s"
    assert recording.units["accel_x"] == "m/s^2"
    assert recording.units["gyro_x"] == "rad/s"


@pytest.mark.parametrize("kind", KINDS)
def test_every_sample_comes_out_with_its_header_stamp(tmp_path, truth, kind):
    path = bags.write(tmp_path, kind, merged(imus(truth), [text()]))
    check(il.read(path), truth)


@pytest.mark.parametrize("method", ["LZ4", "BZ2"])
def test_compressed_bags(tmp_path, truth, method):
    path = bags.write(tmp_path, "bag", imus(truth), compression=Writer1.CompressionFormat[method])
    check(il.read(path), truth)


def test_a_bare_mcap_file_and_a_bag_in_two_files(tmp_path, truth):
    half = COUNT // 2
    messages = list(imus(truth))
    one = bags.write(tmp_path, "mcap", messages[:half], name="one")
    two = bags.write(tmp_path, "mcap", messages[half:], name="two")
    (first,), (second,) = one.glob("*.mcap"), two.glob("*.mcap")
    check(il.read(bags.write(tmp_path, "mcap", messages, name="all") / "all.mcap"), truth)
    folder = tmp_path / "split"
    folder.mkdir()
    shutil.copy(first, folder / "split_9.mcap")
    shutil.copy(second, folder / "split_10.mcap")
    check(il.read(folder), truth)


def test_blocks_join_to_the_whole(tmp_path, truth, monkeypatch):
    monkeypatch.setattr("imulab.readers.streams._ROWS", 100)
    path = bags.write(tmp_path, "sqlite", imus(truth))
    monkeypatch.setattr("imulab.readers.rosbag._AT_ONCE", 64)
    blocks = list(il.read_blocks(path))
    assert len(blocks) > 3
    assert blocks[1].first_row == len(blocks[0]) + 1
    np.testing.assert_array_equal(np.concatenate([b.triad("gyro") for b in blocks]), truth[2])


# --- what may be missing -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_a_covariance_of_minus_one_means_not_reported(tmp_path, truth, kind):
    recording = il.read(bags.write(tmp_path, kind, imus(truth, gyro_cov=-1.0)))
    assert list(recording.columns) == ["time", "accel_x", "accel_y", "accel_z"]
    assert any("does not report the gyroscope" in note for note in recording.notes)
    recording = il.read(bags.write(tmp_path, kind, imus(truth, accel_cov=-1.0), name="other"))
    assert list(recording.columns) == ["time", "gyro_x", "gyro_y", "gyro_z"]
    with pytest.raises(ReadError, match="reports neither"):
        il.read(bags.write(tmp_path, kind, imus(truth, accel_cov=-1.0, gyro_cov=-1.0), name="third"))


def test_nan_means_not_reported(tmp_path, truth):
    stamps, accel, gyro = truth
    recording = il.read(bags.write(tmp_path, "mcap", imus((stamps, accel, np.full_like(gyro, np.nan)))))
    assert "gyro_x" not in recording


def test_a_single_message_without_a_reading_is_nan(tmp_path, truth):
    stamps, accel, gyro = truth
    messages = list(imus(truth))
    t, i, when, _ = messages[40]
    messages[40] = (
        t,
        i,
        when,
        lambda types, k: bags.imu(types, k, int(stamps[40]), accel[40], gyro[40], accel_cov=-1.0),
    )
    recording = il.read(bags.write(tmp_path, "bag", messages))
    assert np.flatnonzero(np.isnan(recording.column("accel_x"))).tolist() == [40]
    assert not np.isnan(recording.triad("gyro")).any()


def test_a_quantity_that_is_reported_from_the_second_chunk_on_is_there(tmp_path, truth, monkeypatch):
    """A filter that starts up: its first messages have no rate."""
    stamps, accel, gyro = truth
    gyro = gyro.copy()
    gyro[:150] = np.nan
    path = official(tmp_path / "a.mcap", (stamps, accel, gyro))
    recording = il.read(path)
    np.testing.assert_array_equal(recording.triad("gyro"), gyro)
    monkeypatch.setattr("imulab.readers.rosbag._SAMPLES_LOOKED_AT", 60)
    assert "gyro_x" not in il.read(path)


@pytest.mark.parametrize("kind", KINDS)
def test_frames_of_different_length_in_one_topic(tmp_path, truth, kind):
    stamps, accel, gyro = truth
    frames = ["a", "imu_link", "", "a_long_name_of_a_frame"]
    messages = [
        ("/imu", IMU, s, lambda t, k, i=i, s=s: bags.imu(t, k, s, accel[i], gyro[i], frame=frames[i % 4]))
        for i, s in enumerate(stamps.tolist())
    ]
    check(il.read(bags.write(tmp_path, kind, messages)), truth)


# --- several topics ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_several_topics_are_listed_and_one_can_be_chosen(tmp_path, truth, kind):
    stamps, accel, gyro = truth
    path = bags.write(tmp_path, kind, merged(imus(truth, "/imu/a"), imus((stamps, gyro, accel), "/imu/b")))
    with pytest.raises(OptionError, match=r"several Imu topics.*--topic: /imu/a /imu/b"):
        il.read(path)
    check(il.read(path, topic="/imu/a"), truth)
    check(il.read(path, topic="imu/b"), (stamps, gyro, accel))
    with pytest.raises(OptionError, match="no Imu topic /imu/c; Imu topics found: /imu/a /imu/b"):
        il.read(path, topic="/imu/c")
    with pytest.raises(OptionError, match="no instances"):
        il.read(path, topic="/imu/a", instance=1)


@pytest.mark.parametrize("kind", KINDS)
def test_without_imu_topics_those_that_are_there_are_listed(tmp_path, kind):
    path = bags.write(tmp_path, kind, [text(), text("/rosout")])
    with pytest.raises(
        ReadError, match=r"no topic of sensor_msgs/Imu; topics found: /chatter \(std_msgs/String\), /rosout"
    ):
        il.read(path)


def test_accelerometer_and_gyroscope_topics_keep_their_clocks(tmp_path):
    accel_times = np.arange(0, 2.0, 0.01)
    gyro_times = np.arange(-0.003, 2.01, 0.0025)
    rng = np.random.default_rng(3)
    accel, gyro = rng.normal(size=(len(accel_times), 3)), rng.normal(size=(len(gyro_times), 3))
    zero = np.zeros(3)

    def stream(topic, times, make):
        for i, t in enumerate(times):
            stamp = EPOCH + round(t * 1e9)
            yield topic, IMU, stamp, lambda ty, k, i=i, s=stamp: make(ty, k, i, s)

    messages = merged(
        stream("/cam/accel", accel_times, lambda t, k, i, s: bags.imu(t, k, s, accel[i], zero)),
        stream("/cam/gyro", gyro_times, lambda t, k, i, s: bags.imu(t, k, s, zero, gyro[i])),
    )
    recording = il.read(bags.write(tmp_path, "mcap", messages), topic="/cam/accel,/cam/gyro")
    own = recording.stream("gyro")
    np.testing.assert_allclose(own.time, gyro_times, atol=1e-9)
    np.testing.assert_array_equal(own.triad("gyro"), gyro)
    assert recording.notes == ()
    recording = one_clock(recording, "accel")
    np.testing.assert_array_equal(recording.triad("accel"), accel)
    for i, axis in enumerate(AXES):
        expected = np.interp(accel_times, gyro_times, gyro[:, i])
        np.testing.assert_allclose(recording.column(f"gyro_{axis}"), expected, atol=1e-6)
    (note,) = recording.notes
    assert "gyroscope (400 Hz) interpolated to the clock of the accelerometer (100 Hz)" in note


def test_temperature_of_the_same_namespace_is_interpolated(tmp_path, truth):
    stamps, _, _ = truth
    warm = [
        ("/imu/temperature", TEMPERATURE, s, lambda t, k, i=i, s=s: bags.temperature(t, k, s, 20 + 0.1 * i))
        for i, s in enumerate(range(int(stamps[0]), int(stamps[-1]), 100_000_000))
    ]
    other = [("/room/temperature", TEMPERATURE, EPOCH, lambda t, k: bags.temperature(t, k, EPOCH, 3.0))]
    recording = il.read(bags.write(tmp_path, "bag", merged(imus(truth, "/imu/data"), warm, other)))
    seconds = (stamps - stamps[0]) / 1e9
    last = (len(warm) - 1) * 0.1
    expected = np.where(seconds <= last, 20 + seconds, np.nan)  # after its last message it is not known
    assert np.isnan(expected).any()
    np.testing.assert_allclose(recording.column("temperature"), expected, atol=1e-9)
    assert recording.units["temperature"] == "degC"


def test_temperatures_that_could_belong_to_it_are_named_not_chosen(tmp_path, truth):
    others = [
        (f"/{name}/temperature", TEMPERATURE, EPOCH, lambda t, k: bags.temperature(t, k, EPOCH, 3.0)) for name in "ab"
    ]
    recording = il.read(bags.write(tmp_path, "mcap", merged(imus(truth, "/imu/data"), others)))
    assert "temperature" not in recording
    assert any("/a/temperature /b/temperature" in note for note in recording.notes)


def test_a_window_of_time(tmp_path, truth):
    recording = il.read(bags.write(tmp_path, "mcap", imus(truth)), window=(0.5, 1.0))
    assert recording.time[0] >= 0.5 > recording.time[0] - 0.007
    assert recording.time[-1] <= 1.0 < recording.time[-1] + 0.007
    assert recording.first_row > 80


# --- damage --------------------------------------------------------------------------------------------------------


def data_file(path):
    return path if path.is_file() else next(p for p in path.iterdir() if p.suffix in (".mcap", ".db3"))


@pytest.mark.parametrize("kind", KINDS)
def test_every_cut_is_refused_in_one_line(tmp_path, truth, kind):
    stamps, accel, gyro = truth
    few = (stamps[:60], accel[:60], gyro[:60])
    file = data_file(bags.write(tmp_path, kind, imus(few)))
    whole = file.read_bytes()
    cut = tmp_path / f"cut{file.suffix}"
    places = {1, 5, 12, 13, 14, 40, len(whole) // 3, len(whole) // 2, len(whole) - 4096, len(whole) - 100}
    for size in sorted(places | {len(whole) - 37, len(whole) - 8, len(whole) - 1} | {0}):
        cut.write_bytes(whole[: max(size, 0)])
        with pytest.raises(ImulabError) as error:
            il.read(cut)
        assert "\n" not in str(error.value)
        assert str(cut) in str(error.value)


def test_the_command_line_says_truncated(tmp_path, truth, imulab):
    for kind in KINDS:
        file = data_file(bags.write(tmp_path, kind, imus(truth), name=f"{kind}0"))
        cut = tmp_path / f"cut_{kind}{file.suffix}"
        cut.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
        done = imulab("convert", cut, "-o", "out.csv")
        assert done.returncode == 2
        assert done.stderr.count("\n") == 1
        assert "truncated" in done.stderr
        assert not (tmp_path / "out.csv").exists()


def official(path, truth, **options):
    """An MCAP file by the official library."""
    from mcap.writer import Writer

    types = bags.typestore("mcap")
    stamps, accel, gyro = truth
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=20_000, **options)
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema(IMU, "ros2msg", b"# not needed")
        channel = writer.register_channel("/imu", "cdr", schema)
        for i, stamp in enumerate(stamps.tolist()):
            data = bytes(types.serialize_cdr(bags.imu(types, "mcap", stamp, accel[i], gyro[i]), IMU))
            writer.add_message(channel, stamp, data, stamp)
        writer.finish()
    return path


@pytest.mark.parametrize("method", ["NONE", "LZ4", "ZSTD"])
@pytest.mark.parametrize("chunks", [True, False])
def test_files_of_the_official_mcap_library(tmp_path, truth, method, chunks):
    from mcap.writer import CompressionType

    options = {"compression": CompressionType[method], "use_chunking": chunks}
    check(il.read(official(tmp_path / "a.mcap", truth, **options)), truth)
    options |= {
        "use_statistics": False,
        "repeat_channels": False,
        "repeat_schemas": False,
        "use_summary_offsets": False,
    }
    check(il.read(official(tmp_path / "b.mcap", truth, **options)), truth)


def test_a_large_attachment_is_passed_over_unread(tmp_path, truth, monkeypatch):
    from mcap.writer import Writer

    monkeypatch.setattr("imulab.readers.logs.BLOCK_BYTES", 10_000)
    start = Writer.start

    def start_with_attachment(self, *arguments, **options):
        start(self, *arguments, **options)
        self.add_attachment(0, 0, "video", "video/mp4", b"\x05" * 1_000_000)

    monkeypatch.setattr(Writer, "start", start_with_attachment)
    path = official(tmp_path / "a.mcap", truth)
    read, sizes = logs.walk, []
    monkeypatch.setattr("imulab.readers.logs.walk", lambda *a, **k: (sizes.append(len(a[1])), read(*a, **k))[1])
    check(il.read(path), truth)
    assert max(sizes) < 200_000
    data = bytearray(path.read_bytes())
    at = data.index(b"video/mp4") - 4 - 5 - 4 - 16 - 9  # type, name and their lengths, two times, the record's head
    assert data[at] == 9
    data[at + 1 : at + 9] = (1 << 40).to_bytes(8, "little")
    path.write_bytes(data)
    with pytest.raises(ReadError, match=r"damaged|truncated"):
        il.read(path)


@pytest.mark.parametrize("missing", ["repeat_schemas", "repeat_channels"])
def test_a_summary_that_lacks_schemas_or_channels_is_no_loss(tmp_path, truth, missing):
    check(il.read(official(tmp_path / "a.mcap", truth, **{missing: False})), truth)


def test_a_damaged_chunk_is_noticed_by_its_checksum(tmp_path, truth):
    from mcap.writer import CompressionType

    file = official(tmp_path / "a.mcap", truth, compression=CompressionType.NONE)
    data = bytearray(file.read_bytes())
    data[data.index(struct.pack("<d", truth[1][300, 1])) + 6] ^= 0x10
    file.write_bytes(bytes(data))
    with pytest.raises(ReadError, match=r"the chunk that begins at \d+ ns is damaged \(its CRC-32 does not match\)"):
        il.read(file)


def test_a_bag_that_was_not_closed_asks_for_reindex(tmp_path, truth):
    file = bags.write(tmp_path, "bag", imus(truth))
    data = bytearray(file.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = bytes(8)
    file.write_bytes(bytes(data))
    with pytest.raises(ReadError, match="rosbag reindex"):
        il.read(file)


def test_a_folder_that_is_no_bag_or_lacks_a_file(tmp_path, truth):
    with pytest.raises(ReadError, match="found a folder that is no ROS 2 bag"):
        il.read(tmp_path)
    path = bags.write(tmp_path, "mcap", imus(truth))
    data_file(path).rename(path / "renamed.mcap")
    with pytest.raises(ReadError, match=r"rec\.mcap is listed in metadata\.yaml, but it is not there"):
        il.read(path)


def test_of_a_folder_only_the_listed_files_are_read_in_their_order(tmp_path, truth):
    path = bags.write(tmp_path, "mcap", imus(truth))
    shutil.copy(data_file(path), path / "a_copy.mcap")
    check(il.read(path), truth)


def test_a_sqlite_bag_with_messages_that_are_not_in_it_yet_is_refused(tmp_path, truth, imulab):
    path = bags.write(tmp_path, "sqlite", imus(truth))
    file = data_file(path)
    db = sqlite3.connect(file)
    db.execute("PRAGMA journal_mode=WAL")
    db.execute("PRAGMA wal_autocheckpoint=0")
    db.execute("INSERT INTO messages (topic_id, timestamp, data) SELECT topic_id, timestamp + 1, data FROM messages")
    db.commit()
    done = imulab("show", path)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert f"the bag was not closed: {file.name}-wal" in done.stderr
    db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    assert len(il.read(path)) == 2 * COUNT
    db.close()


def test_messages_that_are_no_imu_are_refused(tmp_path):
    path = tmp_path / "bad.db3"
    with sqlite3.connect(path) as db:
        db.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        db.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        db.execute("INSERT INTO topics VALUES(1, '/imu', 'sensor_msgs/msg/Imu', 'cdr')")
        db.execute("INSERT INTO messages VALUES(1, 1, 0, ?)", (b"\0\1\0\0" + bytes(60),))
    db.close()
    with pytest.raises(ReadError, match="a message of 64 bytes is no sensor_msgs/Imu"):
        il.read(path)


def test_the_stored_hash_is_that_of_the_file(tmp_path, truth):
    path = bags.write(tmp_path, "bag", imus(truth))
    assert il.read(path).source.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()

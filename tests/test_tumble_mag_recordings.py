"""Magnetometers in bags and flight logs that the formats' own libraries write or read, on a clock of their own."""

import io
import re

import numpy as np
import pytest

import bags
import imulab as il
from imulab.display import Note
from imulab.errors import OptionError
from imulab.readers.streams import on_clock_of, one_clock
from imulab.units import to_si
from reference.flightlogs import dataflash, ulog

AXES = "xyz"


def read(path, **options):
    """Return a recording with its magnetometers in the rows of the accelerometers."""
    return one_clock(il.read(path, **options), "accel")


EPOCH = bags.EPOCH
IMU, FIELD, TEMPERATURE = (f"sensor_msgs/msg/{name}" for name in ("Imu", "MagneticField", "Temperature"))
SENSOR = "uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;float x;float y;float z;"
FORMATS = {
    "sensor_accel": f"{SENSOR}float temperature;uint32_t error_count;",
    "sensor_gyro": f"{SENSOR}float temperature;uint32_t error_count;",
    "sensor_mag": f"{SENSOR}float temperature;uint32_t error_count;",
    "vehicle_magnetometer": (
        "uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;float[3] magnetometer_ga;"
        "uint8_t calibration_count;uint8_t[7] _padding0;"
    ),
}
MESSAGES = {
    "IMU": (129, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"),
    "MAG": (130, "QBhhhhhhhhhBI", "TimeUS,I,MagX,MagY,MagZ,OfsX,OfsY,OfsZ,MOX,MOY,MOZ,Health,S"),
}


def vectors(count, seed, size=1.0):
    return np.random.default_rng(seed).normal(size=(count, 3)) * size


def nearest(clock, ticks, values, step):
    """Each sample in the row nearest to it, by comparing it with every row; of several the nearest one."""
    rows = np.full((len(clock), 3), np.nan)
    for i in range(len(clock)):
        mine = [k for k, t in enumerate(ticks) if abs(t - clock[i]) <= step and np.argmin(abs(clock - t)) == i]
        if mine:
            rows[i] = values[min(mine, key=lambda k: abs(ticks[k] - clock[i]))]
    return rows


def merged(*streams):
    return sorted((m for s in streams for m in s), key=lambda m: m[2])


def imus(stamps, topic="/imu/data"):
    accel = vectors(len(stamps), 1)
    for i, stamp in enumerate(stamps.tolist()):
        yield topic, IMU, stamp, lambda t, k, i=i, s=stamp: bags.imu(t, k, s, accel[i], accel[i])


def fields(stamps, values, topic="/imu/mag", **options):
    for i, stamp in enumerate(stamps.tolist()):
        yield (
            topic,
            FIELD,
            stamp,
            lambda t, k, i=i, s=stamp: bags.magnetic_field(t, k, s, values[i], **options),
        )


def clocks(seed=0, rows=400, step=5_000_000, slower=7):
    """Ticks of rows, and of a slower stream that begins earlier and ends later."""
    rng = np.random.default_rng(seed)
    clock = EPOCH + np.cumsum(rng.integers(int(0.9 * step), int(1.1 * step), rows))
    slow = EPOCH - slower * step + np.cumsum(rng.integers(int(0.8 * slower * step), int(1.2 * slower * step), rows))
    return clock, slow[slow < clock[-1] + 3 * step]


@pytest.mark.parametrize("kind", ["bag", "mcap", "sqlite"])
def test_a_field_stands_in_the_row_nearest_in_time_and_nowhere_else(tmp_path, kind):
    clock, ticks = clocks()
    values = vectors(len(ticks), 2, 4e-5)
    recording = read(bags.write(tmp_path, kind, merged(imus(clock), fields(ticks, values))))
    assert recording.units["mag_x"] == "T"
    expected = nearest(clock, ticks, values, np.median(np.diff(clock)))
    np.testing.assert_array_equal(recording.triad("mag"), expected)
    there = np.isfinite(expected[:, 0]).sum()
    (note,) = [n for n in recording.notes if n.startswith("magnetometer")]
    assert isinstance(note, Note)
    assert f"{there} of its {len(ticks)} samples stand in the rows" in note
    assert f"the other {400 - there} of 400 rows hold none (nan)" in note
    assert recording.metadata["topic"] == "/imu/data,/imu/mag"
    assert len(recording) == 400  # neither its late beginning nor its early end takes rows away


def test_a_faster_magnetometer_leaves_its_nearest_samples(tmp_path):
    ticks, clock = clocks(4, rows=300, slower=3)
    clock = clock[(clock > ticks[0]) & (clock < ticks[-1])]
    values = vectors(len(ticks), 5, 4e-5)
    recording = read(bags.write(tmp_path, "mcap", merged(imus(clock), fields(ticks, values))))
    expected = nearest(clock, ticks, values, np.median(np.diff(clock)))
    assert np.isfinite(expected).all()
    np.testing.assert_array_equal(recording.triad("mag"), expected)
    assert f"{len(clock)} of its {len(ticks)} samples" in recording.notes[-1]


def test_a_field_in_every_row_needs_no_note(tmp_path):
    clock, _ = clocks()
    values = vectors(400, 6, 4e-5)
    recording = read(bags.write(tmp_path, "mcap", merged(imus(clock), fields(clock, values))))
    np.testing.assert_array_equal(recording.triad("mag"), values)
    assert recording.notes == ()


def test_a_magnetometer_whose_clock_is_wrong_does_not_cost_the_rest(tmp_path):
    clock, _ = clocks()
    values = vectors(400, 6, 4e-5)
    back = clock.copy()
    back[100:110] -= 10_000_000_000

    def at(stamps, topic="/imu/mag"):
        for i, (stamp, logged) in enumerate(zip(stamps.tolist(), clock.tolist(), strict=True)):
            yield topic, FIELD, logged, lambda t, k, i=i, s=stamp: bags.magnetic_field(t, k, s, values[i])

    for number, (stamps, kept) in enumerate(((back, 390), (np.zeros(400, dtype=np.int64), 0))):
        path = bags.write(tmp_path, "mcap", merged(imus(clock), at(stamps)), name=f"rec{number}")
        recording = read(path)
        assert len(recording) == 400
        assert np.isfinite(recording.column("mag_x")).sum() == kept
        assert f"{kept} of its 400 samples" in recording.notes[-1]


def test_a_field_that_is_not_reported_is_nan(tmp_path):
    clock, _ = clocks()
    messages = merged(imus(clock), fields(clock, vectors(400, 6, 4e-5), first_covariance=-1.0))
    assert np.isnan(read(bags.write(tmp_path, "mcap", messages)).triad("mag")).all()


@pytest.mark.parametrize("unit", ["T", "mT", "gauss", "uT", "mgauss", "nT"])
@pytest.mark.parametrize("size", [22e-6, 66e-6])
def test_a_driver_that_does_not_write_tesla_is_found_out(tmp_path, unit, size):
    clock, _ = clocks(rows=50)
    values = vectors(50, 7)
    values *= size / np.linalg.norm(values, axis=1)[:, None]
    written = values / to_si(1.0, unit)
    recording = read(bags.write(tmp_path, "mcap", merged(imus(clock), fields(clock, written))))
    np.testing.assert_allclose(recording.triad("mag"), values, rtol=1e-12)
    said = [n for n in recording.notes if "none on Earth is" in n]
    assert [n.endswith(f"its readings are taken as {unit}") for n in said] == ([True] if unit != "T" else [])


def test_a_field_of_no_unit_is_left_and_said(tmp_path):
    clock, _ = clocks(rows=50)
    values = np.full((50, 3), 3.0e7)
    recording = read(bags.write(tmp_path, "mcap", merged(imus(clock), fields(clock, values))))
    np.testing.assert_array_equal(recording.triad("mag"), values)
    assert "no other unit fits: its readings are left as they are" in recording.notes[0]


def test_the_magnetometer_of_the_namespace_is_read_and_a_topic_chooses_another(tmp_path):
    clock, _ = clocks(rows=50)
    near, far = np.full((50, 3), 4e-5), np.full((50, 3), 3e-5)
    messages = merged(imus(clock), fields(clock, near), fields(clock, far, "/gps/mag"))
    path = bags.write(tmp_path, "mcap", messages)
    assert read(path).column("mag_x")[0] == 4e-5
    for topic in ("/imu/data,/gps/mag", "/gps/mag", "gps/mag"):
        recording = read(path, topic=topic)
        assert recording.column("mag_x")[0] == 3e-5
        assert recording.metadata["topic"] == "/imu/data,/gps/mag"
    with pytest.raises(OptionError, match="no Imu topic /mag; Imu topics found: /imu/data; of MagneticField: /imu/mag"):
        read(path, topic="/imu/data,/mag")


def test_magnetometers_that_could_belong_to_it_are_named_not_chosen(tmp_path):
    clock, _ = clocks(rows=50)
    values = np.full((50, 3), 4e-5)
    messages = merged(imus(clock), fields(clock, values, "/a/mag"), fields(clock, values, "/b/mag"))
    recording = read(bags.write(tmp_path, "mcap", messages))
    assert "mag_x" not in recording
    (note,) = recording.notes
    assert note == (
        "magnetometer left out: several topics could be it: /a/mag /b/mag; --topic /imu/data,/a/mag takes the first"
    )


# --- flight logs -----------------------------------------------------------------------------------------------------


def px4(accel_ticks, mags, titles=("sensor_mag",) * 2):
    """A ULog of one accelerometer and gyroscope, and of magnetometers, each its ticks and values."""
    accel = vectors(len(accel_ticks), 8).astype(np.float32)
    numbered = [(t, n, v) for n in (3, 4) for t, v in zip(accel_ticks.tolist(), accel.tolist(), strict=True)]
    messages = [(t, (n, (t + 90, t, 77, *v, 20.0, 0))) for t, n, v in numbered]
    places = {}
    subscriptions = [(0, 3, "sensor_accel"), (0, 4, "sensor_gyro")]
    for number, (title, (ticks, values)) in enumerate(zip(titles, mags, strict=False), start=5):
        subscriptions.append((places.get(title, 0), number, title))
        places[title] = places.get(title, 0) + 1
        rest = (20.0, 0) if title == "sensor_mag" else (1,)
        for t, v in zip(ticks.tolist(), values.tolist(), strict=True):
            messages.append((t, (number, (t + 70, t, 99, *v, *rest))))
    data = [message for _, message in sorted(messages, key=lambda m: m[0])]
    formats = {title: FORMATS[title] for _, _, title in subscriptions}
    return ulog(formats, subscriptions, data)


@pytest.fixture
def file(tmp_path):
    def write(data, name="log.bin"):
        (tmp_path / name).write_bytes(data)
        return tmp_path / name

    return write


@pytest.fixture(scope="module")
def boot():
    """Microseconds since boot of an accelerometer at 200 Hz and of two magnetometers at 30 and 80 Hz."""
    clock, slow = clocks(11, step=5_000)
    _, other = clocks(12, step=5_000, slower=2)
    shift = EPOCH - 5_000_000
    return clock - shift, (slow - shift, other[other > clock[0]] - shift)


def test_sensor_mag_of_a_ulog_and_its_instances(file, boot):
    clock, (slow, other) = boot
    values = [vectors(len(t), 9, 0.3).astype(np.float32) for t in (slow, other)]
    data = px4(clock, list(zip((slow, other), values, strict=True)))
    from pyulog import ULog

    theirs = [d for d in ULog(io.BytesIO(data)).data_list if d.name == "sensor_mag"]
    for ticks, mine, one in zip((slow, other), values, theirs, strict=True):
        np.testing.assert_array_equal(one.data["timestamp_sample"], ticks)
        np.testing.assert_array_equal(one.data["z"], mine[:, 2])
    path = file(data)
    step = np.median(np.diff(clock))
    recording = read(path)
    assert recording.units["mag_y"] == "gauss"
    np.testing.assert_array_equal(recording.triad("mag"), nearest(clock, slow, values[0].astype(float), step))
    assert "instance 0 of 2 of sensor_mag; a topic chooses: sensor_mag:1" in recording.notes
    second = read(path, topic="sensor_accel,sensor_mag:1")
    np.testing.assert_array_equal(second.triad("mag"), nearest(clock, other, values[1].astype(float), step))
    assert "gyro_x" in read(path, topic="sensor_mag:1")
    with pytest.raises(OptionError, match="no sensor_mag of instance 2; magnetometers found: sensor_mag 0, sensor_mag"):
        read(path, topic="sensor_mag:2")
    with pytest.raises(OptionError, match="expected sensor_mag or sensor_mag:N once"):
        read(path, topic="sensor_mag:x")


def test_blocks_join_to_the_whole(file, boot, monkeypatch):
    clock, (slow, _) = boot
    path = file(px4(clock, [(slow, vectors(len(slow), 9, 0.3))]))
    whole = read(path)
    monkeypatch.setattr("imulab.readers.logs.BLOCK_BYTES", 3001)
    monkeypatch.setattr("imulab.readers.streams._ROWS", 7)
    blocks = list(on_clock_of(il.read_blocks(path), "accel"))
    assert len(blocks) > 4
    np.testing.assert_array_equal(np.vstack([b.triad("mag") for b in blocks]), whole.triad("mag"))
    counts = [re.sub(r"\(.*? Hz\)", "", note) for note in (blocks[-1].notes[-1], whole.notes[-1])]
    assert counts[0] == counts[1]  # rates are those of the first block


def test_the_corrected_magnetometer_is_read_where_the_measured_one_is_not_logged(file, boot):
    clock, (slow, _) = boot
    values = vectors(len(slow), 9, 0.3).astype(np.float32)
    recording = read(file(px4(clock, [(slow, values)], ["vehicle_magnetometer"])))
    step = np.median(np.diff(clock))
    np.testing.assert_array_equal(recording.triad("mag"), nearest(clock, slow, values.astype(float), step))
    assert "vehicle_magnetometer holds fields that PX4 has already corrected and turned" in recording.notes


def ardupilot(clock, mags, messages=MESSAGES, healthy=lambda i: 1):
    accel = vectors(len(clock), 8).tolist()
    rows = [(t, "IMU", (t, 0, *v, *v)) for t, v in zip(clock.tolist(), accel, strict=True)]
    for place, (ticks, values) in enumerate(mags):
        for i, (t, v) in enumerate(zip(ticks.tolist(), values.tolist(), strict=True)):
            rows.append((t, "MAG", (t, place, *v, 1, 2, 3, 4, 5, 6, healthy(i), t // 1000)))
    return dataflash(messages, [(name, row) for _, name, row in sorted(rows, key=lambda r: r[0])])


def test_mag_messages_of_a_dataflash_log_and_their_instances(file, boot):
    clock, (slow, other) = boot
    values = [np.rint(vectors(len(t), 9, 300)).astype(int) for t in (slow, other)]
    path = file(ardupilot(clock, list(zip((slow, other), values, strict=True))))
    from pymavlink.DFReader import DFReader_binary

    log = DFReader_binary(str(path))
    theirs = []
    while (message := log.recv_match(type="MAG")) is not None:
        if message.I == 1:
            theirs.append((message.TimeUS, message.MagX, message.MagY, message.MagZ))
    log.close()
    np.testing.assert_array_equal(theirs, np.column_stack([other, values[1]]))
    step = np.median(np.diff(clock))
    recording = read(path)
    assert recording.units["mag_x"] == "mgauss"
    np.testing.assert_array_equal(recording.triad("mag"), nearest(clock, slow, values[0].astype(float), step))
    assert "instance 0 of 2 of MAG; a topic chooses: MAG:1" in recording.notes
    assert any("corrected by its COMPASS_ parameters" in note for note in recording.notes)
    second = read(path, topic="IMU,MAG:1")
    np.testing.assert_array_equal(second.triad("mag"), nearest(clock, other, values[1].astype(float), step))
    with pytest.raises(OptionError, match="no MAG of instance 3; instances found: 0 1"):
        read(path, topic="MAG:3")


def test_a_compass_that_does_not_answer_has_no_field(file, boot):
    clock, (slow, _) = boot
    values = np.rint(vectors(len(slow), 9, 300)).astype(int)
    recording = read(file(ardupilot(clock, [(slow, values)], healthy=lambda i: i % 2)))
    step = np.median(np.diff(clock))
    expected = nearest(clock, slow[1::2], values[1::2].astype(float), step)
    np.testing.assert_array_equal(recording.triad("mag"), expected)


def test_mag_messages_of_another_kind_do_not_cost_the_rest(file, boot):
    clock, (slow, _) = boot
    odd = {**MESSAGES, "MAG": (130, "QBhhhhhhhhhBI", "TimeUS,I,A,B,C,OfsX,OfsY,OfsZ,MOX,MOY,MOZ,Health,S")}
    recording = read(file(ardupilot(clock, [(slow, np.ones((len(slow), 3), dtype=int))], odd)))
    assert "mag_x" not in recording
    assert len(recording) == len(clock)


def test_the_accelerometers_of_a_log_are_judged_as_without_its_magnetometer(file, boot):
    """What is said of a magnetometer does not lower the verdict on other sensors."""
    clock, (slow, _) = boot
    recording = read(file(ardupilot(clock, [(slow, np.ones((len(slow), 3), dtype=int))])))
    assert all(isinstance(note, Note) for note in recording.notes if "agnetometer" in note or "MAG" in note)

"""Files changed at random: each is read, or refused in one line; nothing else ever comes out.

IMULAB_FUZZ=20000 tries that many inputs a reader instead of a few; docs/recordings.md says how many have been tried.
"""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import bags
import imulab as il
from imulab.errors import ImulabError
from imulab.readers import _logs, _text
from reference.flightlogs import dataflash, ulog

COUNT = int(os.environ.get("IMULAB_FUZZ", "60"))
FUZZ = settings(
    max_examples=COUNT,
    deadline=None,
    database=None,
    derandomize="IMULAB_FUZZ" not in os.environ,
    suppress_health_check=list(HealthCheck),
)
LAYOUT = '[columns]\ntime = { from = "t", unit = "s" }\naccel_x = { from = "x", unit = "g" }\n'
IMU, TEMPERATURE = "sensor_msgs/msg/Imu", "sensor_msgs/msg/Temperature"


def px4() -> bytes:
    formats = {
        "sensor_accel": "uint64_t timestamp;uint64_t timestamp_sample;float x;float y;float z;float temperature;",
        "sensor_gyro": "uint64_t timestamp;float x;float y;float z;",
        "sensor_combined": "uint64_t timestamp;float[3] gyro_rad;int32_t accelerometer_timestamp_relative;"
        "float[3] accelerometer_m_s2;",
    }
    data = []
    for i in range(12):
        data += [(1, (9 + i * 100, i * 100, 1.0, 2.0, 3.0, 20.0)), (2, (i * 100 + 50, 1.0, 2.0, 3.0))]
    subscriptions = [(0, 1, "sensor_accel"), (0, 2, "sensor_gyro"), (0, 3, "sensor_combined")]
    return ulog(formats, subscriptions, data, info={"sys_name": "PX4"}, flags=bytes(40))


def ardupilot() -> bytes:
    kinds = {"IMU": (130, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ"), "MSG": (131, "QZ", "TimeUS,Message")}
    rows = [("IMU", (i * 100, i % 2, *[float(i)] * 6)) for i in range(12)]
    return dataflash(kinds, [("MSG", (1, b"ArduPlane")), *rows])


def ros(folder: Path, kind: str) -> bytes:
    def messages():
        for i in range(8):
            stamp = bags.EPOCH + i * 10**7
            yield "/imu", IMU, stamp, lambda t, k, s=stamp: bags.imu(t, k, s, (1, 2, 3), (4, 5, 6))
            yield "/imu/t", TEMPERATURE, stamp, lambda t, k, s=stamp: bags.temperature(t, k, s, 20.0)

    path = bags.write(folder, kind, messages(), name=kind)
    return (path if path.is_file() else next(p for p in path.iterdir() if p.suffix in (".mcap", ".db3"))).read_bytes()


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fuzz")
    columns = {"time": np.arange(9.0), "accel_x": np.ones(9)}
    small = il.Recording(columns, {"time": "s", "accel_x": "g"}, {"serial": "S"})
    for name in ("a.parquet", "a.csv"):
        il.write(small, folder / name)
    import h5py
    import scipy.io

    scipy.io.savemat(folder / "a.mat", {"t": np.arange(9.0), "x": np.ones((9, 2))})
    with h5py.File(folder / "a.h5", "w") as file:
        file["t"], file["x"] = np.arange(9.0), np.ones(9)
    (folder / "layout.toml").write_text(LAYOUT)
    content = {kind: ros(folder, kind) for kind in ("bag", "mcap", "sqlite")} | {
        "ulog": px4(),
        "dataflash": ardupilot(),
    }
    content |= {name: (folder / f"a.{name}").read_bytes() for name in ("parquet", "csv", "mat", "h5")}
    return folder, content


EDIT = st.tuples(st.floats(0, 1, exclude_max=True), st.binary(max_size=9), st.integers(0, 9))
EDITS = st.lists(EDIT, min_size=1, max_size=5)
NUMBERS = st.sampled_from([0, 1, 127, 128, 255, 256, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1])


def edited(data: bytes, edits) -> bytes:
    """Replace some bytes at some places (0 bytes: insert; nothing: delete)."""
    for place, new, old in edits:
        at = int(place * len(data))
        data = data[:at] + new + data[at + old :]
    return data


def survives(path: Path, data: bytes, layout: Path | None) -> None:
    path.write_bytes(data)
    try:
        recording = il.read(path, layout)
    except ImulabError as error:
        message = str(error)
        if "\n" in message or not message:
            raise AssertionError(f"not one line: {message!r}") from error
    else:
        if not len(recording) or len({len(column) for column in recording.columns.values()}) != 1:
            raise AssertionError("an empty or ragged recording")


KINDS = ["ulog", "dataflash", "bag", "mcap", "sqlite", "parquet", "mat", "h5", "csv"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.slow
def test_a_changed_file_is_read_or_refused(files, kind):
    folder, content = files
    path, layout = folder / f"changed.{kind}", {"h5": folder / "layout.toml", "mat": _layout(folder)}.get(kind)

    @FUZZ
    @given(
        EDITS,
        st.floats(0, 1),
        st.lists(st.tuples(st.floats(0, 1, exclude_max=True), NUMBERS, st.sampled_from([2, 4, 8])), max_size=3),
    )
    def run(edits, keep, lengths):
        data = edited(content[kind], edits)
        for place, number, size in lengths:  # lengths and counts that cannot be
            data = edited(data, [(place, (number % 256**size).to_bytes(size, "little"), size)])
        survives(path, data if keep > 0.3 else data[: int(len(data) * keep / 0.3)], layout)

    run()


FAULTS = ["tumble_one_still_1Hz.csv", "live_huge_time_steps_h30.csv", "plot_null.txt", "ulg_one_gyro_late.ulg"]


@pytest.mark.parametrize("name", FAULTS)
@pytest.mark.slow
def test_a_file_that_once_failed_is_read_or_refused_however_it_is_changed(real_data, tmp_path, name):
    content = (real_data / "faults" / name).read_bytes()

    @FUZZ
    @given(EDITS)
    def run(edits):
        survives(tmp_path / name, edited(content, edits), None)

    run()


@pytest.mark.parametrize("kind", [0, 1, 2, 3])
@pytest.mark.slow
def test_the_walk_never_leaves_the_block(kind):
    heads = [b"\x05\0D\1\0abc", b"\xa3\x95\x80\x81\x09", b"\x05\x1a\0\0\0\0\0\0\0", b"\x10\0\0\0\x04\0\0\0op=\x02"]

    @settings(FUZZ, max_examples=4 * COUNT)
    @given(st.lists(st.one_of(st.sampled_from(heads), st.binary(max_size=30)), max_size=8), st.integers(0, 9))
    def run(parts, room):
        block = b"".join(parts)
        arrays = [np.full(room, -7, np.int64) for _ in range(3)]
        lengths = np.zeros(256, np.uint8)
        count, position, status = _logs.walk(kind, block, 0, lengths, *arrays)
        assert 0 <= count <= room
        assert 0 <= position <= len(block)
        assert status in (0, 1, 2)
        assert (status == 1) == (count == room) or status != 1
        offsets, sizes, keys = (a[:count] for a in arrays)
        assert (offsets >= 0).all()
        assert (sizes >= 0).all()
        assert (keys >= 0).all()
        assert (offsets + sizes <= position).all()
        assert (np.diff(offsets) > 0).all()
        assert all((a[count:] == -7).all() for a in arrays)

    run()


@pytest.mark.slow
@settings(FUZZ, max_examples=4 * COUNT)
@given(
    st.lists(
        st.sampled_from(
            [b"1", b"-2.5", b"1e5", b"nan", b"", b" ", b",", b"\n", b"\r\n", b".", b"e", b"12345678", b"\xff", b'"']
        ),
        max_size=40,
    ),
    st.sampled_from([",", " ", ";"]),
    st.integers(1, 4),
)
def test_the_parser_of_text_writes_only_its_rows(parts, delimiter, fields):
    block = b"".join(parts)
    rows = block.count(b"\n") + 1
    out = np.full((fields, rows + 2), -77.0)
    slots = np.arange(fields, dtype=np.int32)
    done, problem, _ = _text.parse(block, delimiter, slots, out, rows + 2)
    assert 0 <= done <= rows
    assert problem in (0, 1, 2)
    assert (out[:, done + 1 :] == -77.0).all()


def test_the_fuzzer_starts_from_files_that_can_be_read(files, tmp_path):
    folder, content = files
    for kind, data in content.items():
        path = tmp_path / f"good.{kind}"
        path.write_bytes(data)
        assert len(il.read(path, {"h5": folder / "layout.toml", "mat": _layout(folder)}.get(kind)))
    shutil.rmtree(tmp_path, ignore_errors=True)


def _layout(folder: Path) -> Path:
    path = folder / "matrix.toml"
    path.write_text(LAYOUT.replace('"x"', '"x[0]"'))
    return path

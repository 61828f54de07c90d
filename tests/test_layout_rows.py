"""Which lines and rows a layout takes, dates in them, and streams that bring bad or endless lines."""

import datetime
import io
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from imulab.errors import ReadError
from imulab.readers import _text, read, read_blocks
from imulab.recording import Layout, LayoutColumn

SIZES = [1, 3, 16, 61, 1 << 21]


@pytest.fixture
def file(tmp_path):
    def write(content: bytes | str, name: str = "log.txt") -> Path:
        path = tmp_path / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return write


def columns(*names: str, date: bool = False, **keys) -> Layout:
    entries = {
        name: LayoutColumn(i, "s" if name == "time" else "g", date=date and name == "time")
        for i, name in enumerate(names)
    }
    return Layout(entries, name="foreign", **{"delimiter": ",", **keys})


# --- dates ------------------------------------------------------------------------------------------------------


def nanoseconds(*dates: str) -> tuple[tuple[int, int, int], list[int]]:
    out = np.empty((1, len(dates)))
    slots = np.array([1 << 30], np.int32)
    answer = _text.parse("\n".join(dates).encode(), ";", slots, out, len(dates))
    return answer, out[0, : answer[0]].view(np.int64).tolist()


def test_ten_thousand_dates_are_those_of_the_standard_library():
    rng = np.random.default_rng(8)
    epoch = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
    texts, expected = [], []
    for number in rng.integers(-(2**52), 2**52, 10_000).tolist():
        zone = datetime.timezone(datetime.timedelta(minutes=int(rng.integers(-14 * 60, 14 * 60 + 1))))
        moment = (epoch + datetime.timedelta(microseconds=number)).astimezone(zone)
        texts.append(moment.isoformat(sep="T" if number % 2 else " "))
        expected.append(1000 * number)
    assert nanoseconds(*texts) == ((len(texts), 0, 1), expected)


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("2026-11-22T15:04:05.123456789Z", "2026-11-22T15:04:05.123456789"),
        ("2026-11-22T15:04:05.1234567899Z", "2026-11-22T15:04:05.123456789"),
        ("2026-11-22T15:04:05,5", "2026-11-22T15:04:05.5"),
        ("20261122T150405-0530", "2026-11-22T20:34:05"),
        ("2026-11-22 15:04+02", "2026-11-22T13:04:00"),
        ("2026-11-22 15:04:05 +02:00", "2026-11-22T13:04:05"),
        (' "2024-02-29t23:59:59z" ', "2024-02-29T23:59:59"),
        ("2016-12-31T23:59:60Z", "2017-01-01T00:00:00"),
        ("1700-03-01T00:00", "1700-03-01T00:00:00"),
        ("2200-12-31T00:00", "2200-12-31T00:00:00"),
    ],
)
def test_a_date_is_read_as_it_is_written(text, same):
    assert nanoseconds(text) == ((1, 0, 1), [int(np.datetime64(same, "ns").astype(np.int64))])


@pytest.mark.parametrize(
    "text",
    [
        " ",
        "2026-11-22",
        "15:04:05",
        "2026-13-01T00:00",
        "2026-02-29T00:00",
        "2026-11-22T24:00",
        "2026-11-22T15:60",
        "2026-11-22T15:04:61",
        "2026-11-22T15:04:05.",
        "2026-1122T15:04",
        "2026-11-22T15:04:05+2",
        "2026-11-22T15",
        "22.11.2026 15:04:05",
        "2026-11-22T15:04:05Zulu",
        "1699-01-01T00:00",
        "2201-01-01T00:00",
        "1700000000",
        "nan",
    ],
)
def test_what_is_no_date_is_not_read(text):
    assert nanoseconds("2026-11-22T15:04", text)[0] == (1, 3, 0)


@pytest.mark.parametrize("size", SIZES)
def test_dates_become_seconds_since_the_first_row_across_a_change_of_the_clocks(file, monkeypatch, size):
    monkeypatch.setattr("imulab.readers.text._BLOCK_BYTES", size)
    rows = ["02:59:59.999999000+02:00", "02:00:00.000000250+01:00", "02:00:00.000001+01:00", "02:00:00.000001+01:00"]
    recording = read(file("".join(f"2026-10-25T{row},1\n" for row in rows)), columns("time", "accel_x", date=True))
    assert recording.units["time"] == "s"
    np.testing.assert_array_equal(recording.time, [0, 1250e-9, 2e-6, 2e-6])


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "22.11.2026 15:04:09,1",
            "row 3 (line 3), column time: expected a date and time such as 2026-11-22T15:04:05.250Z,",
        ),
        (",1", "row 3 (line 3), column time: expected a date and time such as 2026-11-22T15:04:05.250Z, found ''"),
        (
            "2026-11-22 15:04:02,1",
            "row 3 (line 3), column time: time runs backwards: expected 2026-11-22T15:04:06.000000000 UTC or later, "
            "found 2026-11-22T15:04:02.000000000",
        ),
    ],
)
def test_a_row_without_a_date_or_with_an_earlier_one_is_named(file, monkeypatch, size, line, message):
    monkeypatch.setattr("imulab.readers.text._BLOCK_BYTES", size)
    content = f"2026-11-22 15:04:05,1\n2026-11-22 15:04:06,1\n{line}\n2026-11-22 15:04:09,1\n"
    with pytest.raises(ReadError) as caught:
        read(file(content), columns("time", "accel_x", date=True))
    assert message in str(caught.value)


def test_a_layout_file_says_that_time_is_a_date(file):
    layout = file('delimiter = ","\n[columns]\ntime = { from = "When", unit = "iso" }\n', "l.toml")
    content = "When,T\n2026-11-22T15:04:05Z,20\n2026-11-22T15:04:06.5Z,21\n"
    assert read(file(content), layout).time.tolist() == [0, 1.5]


def test_messages_of_prefixes_and_skipped_rows(file):
    with pytest.raises(ReadError, match=r"row 2 \(line 2\): expected 2 fields behind the prefix, found none"):
        read(file("IMU,0,1\nIMU\nIMU,2,1\n"), columns("time", "accel_x", prefix="IMU"))
    found = read(file("0,1\n1,\n2,3\n"), columns("time", "accel_x", skip_incomplete=True))
    assert found.notes[0].startswith("1 row was skipped that lacks a reading of time accel_x ")


# --- prefix and skip_incomplete -----------------------------------------------------------------------------------

MIXED = "GPS,1,2,3,4\nIMU,0,1.5,x\n\nIMU , 1,2.5,y\nIMUX,9,9,9\n#IMU,9,9,9\nIMU,2,3.5\r\n"


@pytest.mark.parametrize("size", SIZES)
def test_only_lines_with_the_prefix_count_and_without_it(file, monkeypatch, size):
    monkeypatch.setattr("imulab.readers.text._BLOCK_BYTES", size)
    recording = read(file(MIXED.replace("2,3.5", "2,3.5,z")), columns("time", "accel_x", prefix="IMU"))
    assert recording.time.tolist() == [0, 1, 2]
    assert recording.column("accel_x").tolist() == [1.5, 2.5, 3.5]
    assert recording.place(2) == "row 3"  # rows are no lines here


@pytest.mark.parametrize("size", SIZES)
def test_a_bad_line_with_the_prefix_is_named_by_its_line_in_the_file(file, monkeypatch, size):
    monkeypatch.setattr("imulab.readers.text._BLOCK_BYTES", size)
    with pytest.raises(ReadError, match=r"row 3 \(line 7\): expected 3 fields, found 2"):
        read(file(MIXED), columns("time", "accel_x", prefix="IMU"))
    bad = MIXED.replace("2,3.5", "2,?,z")
    with pytest.raises(ReadError, match=r"row 3 \(line 7\), column accel_x: expected a number, found '\?'"):
        read(file(bad), columns("time", "accel_x", prefix="IMU"))


def test_a_prefix_stands_beside_titles_and_blanks_too(file):
    layout = 'delimiter = ","\nprefix = "$IMU"\n[columns]\ntime = { from = "t", unit = "s" }\n'
    recording = read(file("type,a,t\n$GPS,1\n$IMU,7,0.5\n$IMU,8,1\n"), file(layout, "l.toml"))
    assert recording.time.tolist() == [0.5, 1]
    blanks = columns("time", "accel_x", prefix="IMU", delimiter=" ")
    assert read(file("GPS 5\n IMU\t0.5 1\nIMU   1 2\n"), blanks).time.tolist() == [0.5, 1]


def test_a_file_without_the_prefix_is_refused(file):
    with pytest.raises(ReadError, match=r"no line whose first field is 'ACC', the prefix in foreign"):
        read(file(MIXED), columns("time", prefix="ACC"))


# As MicroStrain's SensorConnect writes channels of different rates.
SPARSE = '# made up\nTime,ax,gx,T\n0,1,,\n1,,5,\n2,3,6,20.5\n3,nan,7,\n4,5,8\n5\n6,"",9,\n7,8,1,\n'


@pytest.mark.parametrize("size", SIZES)
def test_rows_that_lack_what_is_asked_for_are_skipped_and_counted(file, monkeypatch, size):
    monkeypatch.setattr("imulab.readers.text._BLOCK_BYTES", size)
    layout = """
delimiter = ","
skip_incomplete = true
[columns]
gyro_x = { from = "gx", unit = "deg/s" }
time = { from = "Time", unit = "s" }
accel_x = { from = "ax", unit = "g" }
"""
    path = file(SPARSE)
    layout = file(layout, "l.toml")
    for recording in (read(path, layout), *read_blocks(path, layout)):
        assert recording.place(0) == f"row {recording.first_row}"
    recording = read(path, layout)
    assert recording.time.tolist() == [2, 4, 7]
    assert recording.column("accel_x").tolist() == [3, 5, 8]
    assert recording.column("gyro_x").tolist() == [6, 8, 1]
    assert recording.notes == (
        f"5 rows were skipped that lack a reading of gyro_x time accel_x (skip_incomplete in {layout})",
    )


def test_rows_of_other_streams_are_skipped_whatever_their_length(file):
    found = read(
        file("1 2\n0 5 7 8\n3\n1 6 9 9 9\n"), columns("time", "accel_x", "accel_y", skip_incomplete=True, delimiter=" ")
    )
    assert found.column("accel_y").tolist() == [7, 9]
    assert found.notes[0].startswith("2 rows were skipped that lack a reading of time accel_x accel_y")


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("8,x,1,", "row 5 (line 11), column accel_x: expected a number, found 'x'"),
        ("8,1,2,3,4", "row 5 (line 11): expected 4 fields, found 5"),
    ],
)
def test_a_row_that_is_wrong_is_refused_and_not_skipped(file, row, message):
    layout = Layout(
        {"time": LayoutColumn("Time", "s"), "accel_x": LayoutColumn("ax", "g")},
        delimiter=",",
        header=True,
        skip_incomplete=True,
    )
    with pytest.raises(ReadError) as caught:
        read(file(SPARSE + row + "\n"), layout)
    assert message in str(caught.value)


def test_a_file_of_incomplete_rows_only_is_refused(file):
    with pytest.raises(ReadError, match="no rows of data: 2 rows were skipped that lack a reading of time accel_x"):
        read(file("1,\n2,\n"), columns("time", "accel_x", skip_incomplete=True))


def test_other_kinds_of_file_refuse_what_belongs_to_text(file, tmp_path):
    import pyarrow
    import pyarrow.parquet

    pyarrow.parquet.write_table(pyarrow.table({"t": [0.0, 1.0]}), tmp_path / "f.parquet")
    layout = file('prefix = "A"\n[columns]\ntime = { from = "t", unit = "s" }\n', "l.toml")
    with pytest.raises(ReadError, match="prefix is for text, and this is a Parquet file"):
        read(tmp_path / "f.parquet", layout)
    layout = file('[columns]\ntime = { from = "t", unit = "iso" }\n', "l.toml")
    with pytest.raises(ReadError, match='column time: unit "iso" is for text, and this is a Parquet file'):
        read(tmp_path / "f.parquet", layout)


def test_choosing_never_writes_beyond_its_buffer():
    with pytest.raises(ValueError, match="output buffer is too small"):
        _text.choose(b"1,2", ",", bytearray(3), b"", b"", False)


# --- streams ------------------------------------------------------------------------------------------------------

HEAD = b"time [s],accel_x [g]\n"


@pytest.fixture
def pipe(monkeypatch):
    """Standard input as a pipe that brings these pieces."""

    def open_pipe(content: bytes) -> None:
        end, start = os.pipe()
        process = os.fork()
        if process == 0:
            try:
                os.close(end)
                with os.fdopen(start, "wb") as stream:
                    stream.write(content)
            finally:
                os._exit(0)
        os.close(start)
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(os.fdopen(end, "rb")))

    return open_pipe


def test_a_bad_line_of_a_stream_does_not_lose_the_good_rows_before_it(pipe):
    pipe(HEAD + b"0,1\n1,2\n2,oops\n3,4\n")
    rows = read_blocks("-")
    block = next(rows)
    assert block.time.tolist() == [0, 1]
    with pytest.raises(ReadError, match=r"standard input: row 3 \(line 4\), column accel_x: expected a number"):
        next(rows)


def test_a_date_of_a_stream_that_runs_backwards_does_not_lose_the_good_rows_before_it(pipe):
    pipe(b"2026-11-22 15:04:05,1\n2026-11-22 15:04:06,2\n2026-11-22 15:04:02,3\n2026-11-22 15:04:09,4\n")
    rows = read_blocks("-", columns("time", "accel_x", date=True))
    block = next(rows)
    assert (block.time.tolist(), block.column("accel_x").tolist()) == ([0, 1], [1, 2])
    with pytest.raises(ReadError, match=r"row 3 \(line 3\), column time: time runs backwards"):
        next(rows)


@pytest.mark.parametrize("above", [b"", b"0,1\n1,2\n"])
def test_a_line_of_fifty_megabytes_is_refused_at_once(pipe, above):
    pipe(HEAD + above + b"7" * 50_000_000)
    row = 1 + above.count(b"\n")
    with pytest.raises(
        ReadError, match=rf"row {row} \(line {row + 1}\): expected a line of text, found more than 1048576"
    ):
        read("-")


def test_two_hundred_thousand_comment_lines_are_read(file):
    recording = read(file(b"".join(b"# key %d: %d\n" % (k, k) for k in range(200_000)) + HEAD + b"0,1\n"))
    assert len(recording.metadata) == 200_000
    assert recording.metadata["key 199999"] == "199999"
    assert recording.place(0) == "row 1 (line 200002)"

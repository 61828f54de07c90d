"""Which lines and rows a layout takes, dates in them, and streams that bring bad or endless lines."""

import datetime
import io
import os
import sys
from pathlib import Path

import h5py
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest

from imulab.errors import DataError, ReadError, UnitError
from imulab.readers import _text, load_layout, read, read_blocks
from imulab.recording import Layout, LayoutColumn, check_time

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


@pytest.mark.slow
def test_two_hundred_thousand_comment_lines_are_read(file):
    recording = read(file(b"".join(b"# key %d: %d\n" % (k, k) for k in range(200_000)) + HEAD + b"0,1\n"))
    assert len(recording.metadata) == 200_000
    assert recording.metadata["key 199999"] == "199999"
    assert recording.place(0) == "row 1 (line 200002)"


@pytest.fixture
def layout(tmp_path):
    def write(text: str) -> Path:
        path = tmp_path / "foreign.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.fixture
def file_columns(tmp_path):
    def write(content: bytes, name: str = "log.txt") -> Path:
        path = tmp_path / name
        path.write_bytes(content)
        return path

    return write


# A TMP36 puts out 750 mV at 25 degC and 10 mV more a kelvin, an MPU-6050 at +-2 g 16384 LSB/g.
ANALOGUE = """
[columns]
time = { from = "t", unit = "ms", scale = 2 }
accel_x = { from = "ax", unit = "LSB", scale_factor = { value = 16384, unit = "LSB/g" } }
gyro_x.from = "gx"
gyro_x.unit = "mV"
gyro_x.scale_factor = { value = 0.02, unit = "V/(deg/s)" }
gyro_x.zero = { value = 2.5, unit = "V" }
temperature = { from = "T", unit = "V" }
[zero]
temperature = { value = 500, unit = "mV" }
[scale_factor]
temperature = { value = 10, unit = "mV/degC" }
"""


READ = {"t": [0, 5, 10], "ax": [-16384, 0, 8192], "gx": [2500, 2520, 500], "T": [0.75, 0.5, 0.0]}


def expect(recording):
    assert recording.column("time").tolist() == [0, 10, 20]
    assert recording.column("accel_x").tolist() == [-1, 0, 0.5]
    np.testing.assert_allclose(recording.column("gyro_x"), [0, 1, -100], atol=1e-13)
    np.testing.assert_allclose(recording.column("temperature"), [25, 0, -50], atol=1e-13)
    assert dict(recording.units) == {"time": "ms", "accel_x": "g", "gyro_x": "deg/s", "temperature": "degC"}


def test_outputs_become_readings_by_zero_and_scale_factor(layout, file_columns):
    rows = "\n".join(",".join(map(str, row)) for row in zip(*READ.values(), strict=True))
    content = ",".join(READ) + "\n" + rows + "\n"
    expect(read(file_columns(content.encode()), layout('delimiter = ","\n' + ANALOGUE)))


def test_outputs_become_readings_in_other_kinds_of_file_too(layout, tmp_path):
    with h5py.File(tmp_path / "f.h5", "w") as made:
        for name, values in READ.items():
            made[name] = np.array(values)
    pyarrow.parquet.write_table(pyarrow.table(READ), tmp_path / "f.parquet")
    expect(read(tmp_path / "f.h5", layout(ANALOGUE)))
    expect(read(tmp_path / "f.parquet", layout(ANALOGUE)))


@pytest.mark.parametrize("size", [7, 64, 1 << 21])
@pytest.mark.parametrize("bits", [8, 16, 32])
def test_a_counter_that_begins_again_is_carried_on_and_its_gaps_stay(layout, file_columns, monkeypatch, size, bits):
    monkeypatch.setattr("imulab.readers.text._BLOCK_BYTES", size)
    numbers = 2**bits - 5 + np.arange(0, 20)
    kept = np.delete(numbers, [3, 4, 5, 11])
    content = b"".join(b"%d 1\n" % (number % 2**bits) for number in kept.tolist())
    made = layout(
        'sample_rate = 50\n[columns]\ntime = { from = 0, unit = "count" }\naccel_x = { from = 1, unit = "g" }\n'
    )
    recording = read(file_columns(content), made)
    assert recording.units["time"] == "s"
    np.testing.assert_array_equal(recording.time, kept / 50)


COUNTER = 'sample_rate = 100\n[columns]\ntime = { from = 0, unit = "count"%s }\n'


@pytest.mark.parametrize(("last", "size"), [(1001, 7), (40_000, 1 << 21), (40_000, 7), (199, 1 << 21), (230, 64)])
def test_a_counter_that_starts_anew_before_it_is_full_is_time_that_runs_backwards(
    layout, file_columns, monkeypatch, last, size
):
    monkeypatch.setattr("imulab.readers.text._BLOCK_BYTES", size)
    numbers = [*range(last - 9, last + 1), 0, 1, 2]
    recording = read(file_columns("".join(f"{number}\n" for number in numbers).encode()), layout(COUNTER % ""))
    np.testing.assert_array_equal(recording.time, np.array(numbers) / 100)
    with pytest.raises(DataError, match=r"row 11 \(line 11\), column time: time runs backwards"):
        check_time(recording)


@pytest.mark.parametrize("size", [7, 1 << 21])
def test_a_counter_is_carried_on_before_it_is_scaled(layout, file_columns, monkeypatch, size):
    monkeypatch.setattr("imulab.readers.text._BLOCK_BYTES", size)
    numbers = np.arange(240, 280)
    content = b"".join(b"%d\n" % (number % 256) for number in numbers.tolist())
    recording = read(file_columns(content), layout(COUNTER % ", scale = 3.7"))
    np.testing.assert_allclose(recording.time, 3.7 * numbers / 100, rtol=1e-14)


def test_a_counter_of_larger_steps_is_carried_on(layout, file_columns):
    numbers = np.arange(65_000, 67_000, 50)
    content = b"".join(b"%d\n" % (number % 65_536) for number in numbers.tolist())
    np.testing.assert_array_equal(read(file_columns(content), layout(COUNTER % "")).time, numbers / 100)


TITLES = "时间,加速度X\n0,1\n1,2\n"


BY_NAME = """
[columns]
time = { from = "时间", unit = "s" }
accel_x = { from = "加速度X", unit = "g" }
"""


def test_titles_are_read_in_the_encoding_of_the_layout(layout, file_columns):
    content = "第一行\n".encode("gbk") + TITLES.encode("gbk")
    recording = read(file_columns(content), layout('delimiter = ","\nencoding = "gbk"\nskip_lines = 1\n' + BY_NAME))
    assert recording.column("accel_x").tolist() == [1, 2]
    with pytest.raises(ReadError, match=r'line 1: expected UTF-8 text; the layout says .* encoding = "gbk"'):
        read(file_columns(TITLES.encode("gbk")), layout('delimiter = ","\n' + BY_NAME))


@pytest.mark.parametrize("head", [b"", b"# \xb0C\n"])
def test_bytes_that_are_no_utf_8_in_lines_that_are_skipped_do_not_matter(layout, file_columns, head):
    columns = '[columns]\ntime = { from = "t", unit = "s" }\n'
    content = b"T = 20 \xb0C\n# \xff\xfe: \x80\n" + head + b"t\n1\n"
    assert read(file_columns(content), layout('delimiter = ","\nskip_lines = 2\n' + columns)).time.tolist() == [1]


FOG = '[columns]\nfog = { from = 0, unit = "V", %s }\n'


REFUSED = {
    "scale 0": (FOG % "scale = 0", "column fog: scale = 0; expected a number other than 0"),
    "scale tiny": (
        FOG % "scale = 1e-320",
        "column fog: scale: expected a size from 1e-30 to 1e+30, found",
    ),
    "factor tiny": (
        FOG % 'scale_factor = { value = 1e-320, unit = "V/(deg/s)" }',
        "column fog: scale_factor: expected a size from 1e-30 to 1e+30, found",
    ),
    "zero huge": (
        FOG % 'zero = { value = 1e300, unit = "V" }',
        "column fog: zero: expected a number of at most 1e+100, found 1e+300",
    ),
    "rate tiny": (
        "sample_rate = 1e-308\n" + FOG % "scale = 1",
        "sample_rate: expected a number of Hz from 1e-06 to 1e+09, found 1e-308",
    ),
    "scale inf": (FOG % "scale = inf", "column fog: scale: expected a number, found inf"),
    "scale text": (FOG % 'scale = "2"', "column fog: scale: expected a number, found '2'"),
    "factor number": (
        FOG % "scale_factor = 2",
        "column fog: scale_factor: expected scale_factor = { value = 0.02, unit",
    ),
    "factor 0": (
        FOG % 'scale_factor = { value = 0, unit = "V/(deg/s)" }',
        "column fog: scale_factor: expected a value other than 0",
    ),
    "factor nan": (
        FOG % 'scale_factor = { value = nan, unit = "V/(deg/s)" }',
        "column fog: scale_factor: expected a number, found nan",
    ),
    "unit of the factor": (
        FOG % 'scale_factor = { value = 1, unit = "deg/s" }',
        "column fog: scale_factor: unit 'deg/s': expected an output per unit of what is measured, such as V/(deg/s)",
    ),
    "unit of another output": (
        FOG % 'scale_factor = { value = 1, unit = "count/(deg/s)" }',
        "column fog: unit = 'V'; expected count, the output in the scale factor's unit count/(deg/s)",
    ),
    "unit of another quantity": (
        FOG % 'scale_factor = { value = 1, unit = "V/g" }',
        "column fog: expected a unit of rate or output, found 'g' (acceleration)",
    ),
    "unit of the zero": (
        FOG % 'zero = { value = 1, unit = "deg/s" }',
        "column fog: zero: cannot convert deg/s (rate) to V (output)",
    ),
    "zero number": (FOG % "zero = 2.5", "column fog: zero: expected zero = { value = 2.5, unit"),
    "zero inf": (FOG % 'zero = { value = inf, unit = "V" }', "column fog: zero: expected a number, found inf"),
    "table of another column": (
        FOG % "scale = 1" + '[zero]\nfogg = { value = 1, unit = "V" }\n',
        "zero: no column 'fogg'; columns: fog; did you mean 'fog'?",
    ),
    "table": ("zero = 1\n" + FOG % "scale = 1", "zero: expected lines such as gyro_x = { value = 2.5"),
    "twice": (
        FOG % 'zero = { value = 1, unit = "V" }' + '[zero]\nfog = { value = 1, unit = "V" }\n',
        "column fog: zero is given twice, here and under [zero]",
    ),
    "encoding": ('encoding = "gbkk"\n' + FOG % "scale = 1", "encoding = 'gbkk'; expected the name of an encoding such"),
    "encoding number": ("encoding = 8\n" + FOG % "scale = 1", "encoding = 8; expected the name of an encoding such"),
    "encoding wide": (
        'encoding = "utf-16"\n' + FOG % "scale = 1",
        "encoding = 'utf-16'; expected one that writes letters and digits as ASCII does",
    ),
    **{
        f"encoding {name}": (
            f'encoding = "{name}"\n' + FOG % "scale = 1",
            f"encoding = '{name}'; expected one that writes letters and digits as ASCII does",
        )
        for name in ("idna", "utf-7", "punycode", "unicode_escape", "raw_unicode_escape", "utf-32", "cp037")
    },
    "encoding rot13": ('encoding = "rot13"\n' + FOG % "scale = 1", "encoding = 'rot13'; expected the name of an"),
    "unit of counted time": (
        'sample_rate = 100\n[columns]\ntime = { from = 0, unit = "s" }\n',
        "both a time column and sample_rate; expected one of them, or a time of unit count",
    ),
    "prefix": ('prefix = ""\n' + FOG % "scale = 1", "prefix = ''; expected the first field of the lines that count"),
    "prefix of two": ('prefix = "A B"\n' + FOG % "scale = 1", "prefix = 'A B'; expected the first field of the lines"),
    "prefix number": ("prefix = 3\n" + FOG % "scale = 1", "prefix = 3; expected the first field of the lines"),
    "skip_incomplete": (
        "skip_incomplete = 1\n" + FOG % "scale = 1",
        "skip_incomplete = 1; expected true or false",
    ),
    "misspelt key": (
        "skip_incompleet = true\n" + FOG % "scale = 1",
        "unknown key 'skip_incompleet'; known keys: columns delimiter header",
    ),
    "dates of a rate": (
        '[columns]\nfog = { from = 0, unit = "iso" }\n',
        "column fog: expected a unit of rate or output, found 'iso' (dates)",
    ),
    "scaled dates": (
        '[columns]\ntime = { from = 0, unit = "iso", scale = 2 }\n',
        "column time: scale: expected none for dates",
    ),
    "unit of time": ('[columns]\ntime = { from = 0, unit = "count" }\n', "column time: expected a unit of time, found"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_layout_with_a_wrong_value_is_refused_in_one_line(layout, case):
    text, message = REFUSED[case]
    path = layout(text)
    with pytest.raises((ReadError, UnitError)) as caught:
        load_layout(path)
    assert str(caught.value).startswith(f"{path}: {message}")


def test_the_command_says_it_in_one_line(imulab, tmp_path, layout, file_columns):
    layout(FOG % "scale = 0")
    file_columns(b"1\n")
    done = imulab("convert", "log.txt", "--layout", "foreign.toml", "-o", "out.csv")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "imulab: foreign.toml: column fog: scale = 0; expected a number other than 0\n"
    assert not (tmp_path / "out.csv").exists()


def test_a_reading_too_large_for_a_number_warns_of_no_line_of_source(imulab, tmp_path, layout, file_columns):
    layout(FOG % "scale = 1e30")
    file_columns(b"1\n1e300\n")
    done = imulab("convert", "log.txt", "--layout", "foreign.toml", "-o", "out.csv")
    assert done.returncode == 0
    assert "Warning" not in done.stderr

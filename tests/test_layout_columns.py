"""What a layout says of its columns: scale, zero, scale factor, counters, encodings."""

from pathlib import Path

import h5py
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest

from imulab.errors import DataError, ReadError, UnitError
from imulab.readers import load_layout, read
from imulab.recording import check_time


@pytest.fixture
def layout(tmp_path):
    def write(text: str) -> Path:
        path = tmp_path / "foreign.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.fixture
def file(tmp_path):
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


def test_outputs_become_readings_by_zero_and_scale_factor(layout, file):
    rows = "\n".join(",".join(map(str, row)) for row in zip(*READ.values(), strict=True))
    content = ",".join(READ) + "\n" + rows + "\n"
    expect(read(file(content.encode()), layout('delimiter = ","\n' + ANALOGUE)))


def test_outputs_become_readings_in_other_kinds_of_file_too(layout, tmp_path):
    with h5py.File(tmp_path / "f.h5", "w") as made:
        for name, values in READ.items():
            made[name] = np.array(values)
    pyarrow.parquet.write_table(pyarrow.table(READ), tmp_path / "f.parquet")
    expect(read(tmp_path / "f.h5", layout(ANALOGUE)))
    expect(read(tmp_path / "f.parquet", layout(ANALOGUE)))


@pytest.mark.parametrize("size", [7, 64, 1 << 21])
@pytest.mark.parametrize("bits", [8, 16, 32])
def test_a_counter_that_begins_again_is_carried_on_and_its_gaps_stay(layout, file, monkeypatch, size, bits):
    monkeypatch.setattr("imulab.readers.text._BLOCK_BYTES", size)
    numbers = 2**bits - 5 + np.arange(0, 20)
    kept = np.delete(numbers, [3, 4, 5, 11])
    content = b"".join(b"%d 1\n" % (number % 2**bits) for number in kept.tolist())
    made = layout(
        'sample_rate = 50\n[columns]\ntime = { from = 0, unit = "count" }\naccel_x = { from = 1, unit = "g" }\n'
    )
    recording = read(file(content), made)
    assert recording.units["time"] == "s"
    np.testing.assert_array_equal(recording.time, kept / 50)


COUNTER = 'sample_rate = 100\n[columns]\ntime = { from = 0, unit = "count"%s }\n'


@pytest.mark.parametrize(("last", "size"), [(1001, 7), (40_000, 1 << 21), (40_000, 7), (199, 1 << 21), (230, 64)])
def test_a_counter_that_starts_anew_before_it_is_full_is_time_that_runs_backwards(
    layout, file, monkeypatch, last, size
):
    monkeypatch.setattr("imulab.readers.text._BLOCK_BYTES", size)
    numbers = [*range(last - 9, last + 1), 0, 1, 2]
    recording = read(file("".join(f"{number}\n" for number in numbers).encode()), layout(COUNTER % ""))
    np.testing.assert_array_equal(recording.time, np.array(numbers) / 100)
    with pytest.raises(DataError, match=r"row 11 \(line 11\), column time: time runs backwards"):
        check_time(recording)


@pytest.mark.parametrize("size", [7, 1 << 21])
def test_a_counter_is_carried_on_before_it_is_scaled(layout, file, monkeypatch, size):
    monkeypatch.setattr("imulab.readers.text._BLOCK_BYTES", size)
    numbers = np.arange(240, 280)
    content = b"".join(b"%d\n" % (number % 256) for number in numbers.tolist())
    recording = read(file(content), layout(COUNTER % ", scale = 3.7"))
    np.testing.assert_allclose(recording.time, 3.7 * numbers / 100, rtol=1e-14)


def test_a_counter_of_larger_steps_is_carried_on(layout, file):
    numbers = np.arange(65_000, 67_000, 50)
    content = b"".join(b"%d\n" % (number % 65_536) for number in numbers.tolist())
    np.testing.assert_array_equal(read(file(content), layout(COUNTER % "")).time, numbers / 100)


TITLES = "时间,加速度X\n0,1\n1,2\n"
BY_NAME = """
[columns]
time = { from = "时间", unit = "s" }
accel_x = { from = "加速度X", unit = "g" }
"""


def test_titles_are_read_in_the_encoding_of_the_layout(layout, file):
    content = "第一行\n".encode("gbk") + TITLES.encode("gbk")
    recording = read(file(content), layout('delimiter = ","\nencoding = "gbk"\nskip_lines = 1\n' + BY_NAME))
    assert recording.column("accel_x").tolist() == [1, 2]
    with pytest.raises(ReadError, match=r'line 1: expected UTF-8 text; the layout says .* encoding = "gbk"'):
        read(file(TITLES.encode("gbk")), layout('delimiter = ","\n' + BY_NAME))


@pytest.mark.parametrize("head", [b"", b"# \xb0C\n"])
def test_bytes_that_are_no_utf_8_in_lines_that_are_skipped_do_not_matter(layout, file, head):
    columns = '[columns]\ntime = { from = "t", unit = "s" }\n'
    content = b"T = 20 \xb0C\n# \xff\xfe: \x80\n" + head + b"t\n1\n"
    assert read(file(content), layout('delimiter = ","\nskip_lines = 2\n' + columns)).time.tolist() == [1]


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
        "column fog: zero: expected a size from 1e-30 to 1e+30, found 1e+300",
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


def test_the_command_says_it_in_one_line(imulab, tmp_path, layout, file):
    layout(FOG % "scale = 0")
    file(b"1\n")
    done = imulab("convert", "log.txt", "--layout", "foreign.toml", "-o", "out.csv")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "imulab: foreign.toml: column fog: scale = 0; expected a number other than 0\n"
    assert not (tmp_path / "out.csv").exists()


def test_a_reading_too_large_for_a_number_warns_of_no_line_of_source(imulab, tmp_path, layout, file):
    layout(FOG % "scale = 1e30")
    file(b"1\n1e300\n")
    done = imulab("convert", "log.txt", "--layout", "foreign.toml", "-o", "out.csv")
    assert done.returncode == 0
    assert "Warning" not in done.stderr

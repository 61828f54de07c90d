"""Files to recordings: native CSV, foreign text through layouts, and the parser of numbers."""

import gc
import hashlib
import io
import sys
import threading
import time
from decimal import Decimal
from pathlib import Path

import numpy as np
import polars
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import imulab as il
from imulab import readers
from imulab.errors import ReadError, UnitError
from imulab.readers import Layout, _text, load_layout, read, read_blocks, text
from imulab.recording import LayoutColumn

FIXED = settings(derandomize=True, database=None, deadline=None, max_examples=150)
HEAD = b"time [s],accel_x [m/s^2],temperature [degC]\n"


@pytest.fixture
def file(tmp_path):
    def write(content: bytes, name: str = "unit 7.csv") -> Path:
        path = tmp_path / name
        path.write_bytes(content)
        return path

    return write


def parse(tokens: list[str], delimiter: str = ",") -> tuple[tuple[int, int, int], list[float]]:
    """Each token a row of one column; the parser's answer and the numbers."""
    out = np.full((1, len(tokens)), -77.0)
    answer = _text.parse("\n".join(tokens).encode(), delimiter, np.zeros(1, np.int32), out, len(tokens))
    return answer, out[0].tolist()


def bits(values):
    return np.asarray(values, dtype=np.float64).view(np.uint64).tolist()


# --- the parser of numbers against Python's correctly rounded float() ------------------------------------------


@FIXED
@given(st.lists(st.floats(), min_size=1, max_size=30))
def test_every_double_reads_back_exactly(values):
    answer, found = parse([repr(value) for value in values])
    assert answer[:2] == (len(values), 0)
    assert [repr(value) for value in found] == [repr(value) for value in values]  # the sign of zero included


@FIXED
@given(st.from_regex(r"[+-]?[0-9]{0,22}(\.[0-9]{0,22})?([eE][+-]?[0-9]{0,3})?", fullmatch=True))
@pytest.mark.slow
def test_a_decimal_is_rounded_or_refused_as_float_does(token):
    answer, found = parse([token, "0"])
    try:
        expected = float(token or "nan")  # an empty field is a missing reading
    except ValueError:
        assert answer == (0, 1, 0)
    else:
        assert answer[:2] == (2, 0)
        np.testing.assert_array_equal(found, [expected, 0.0])
        assert token == "" or np.signbit(found[0]) == np.signbit(expected)


@FIXED
@given(st.integers(2**50, 2**53 - 1), st.integers(2**52, 2**53 - 1), st.integers(0, 9), st.integers(-1, 1))
def test_halfway_cases_and_their_neighbours_are_rounded_to_even(whole, half, shift, nudge):
    # Odd halves, quarters and eighths lie halfway between doubles of this size; so do odd integers of 54 bits.
    tokens = [f"{whole}.{fraction + nudge:03d}" for fraction in (125, 250, 375, 500, 625, 750, 875)]
    tokens.append(str(((2 * half + 1) << shift) + nudge))
    assert bits(parse(tokens)[1]) == bits([float(token) for token in tokens])


def test_a_hundred_thousand_decimals_of_every_length_are_rounded_as_float_does():
    rng = np.random.default_rng(20261120)
    count = 100_000
    numbers, lengths = rng.integers(10**18, 10**19, count, np.uint64), rng.integers(1, 20, count)
    zeros = rng.integers(0, 30, count) * rng.integers(0, 2, count)  # before the first digit, in every other number
    rows = zip(numbers, lengths, zeros, strict=True)
    digits = ["0" * before + str(number)[:length] for number, length, before in rows]
    points, powers = rng.integers(0, 20 + zeros), rng.integers(-60, 30, count)
    tokens = [f"{d[:p]}.{d[p:]}" + (f"e{e}" if e > -30 else "") for d, p, e in zip(digits, points, powers, strict=True)]
    answer, found = parse(tokens)
    assert answer[:2] == (count, 0)
    assert bits(found) == bits([float(token) for token in tokens])


@pytest.mark.parametrize("token", [" 1.5", "1.5\t", "\t 1.5 ", "1.5\r", "+1.5", "01.5", "1.5e0", "15E-1"])
def test_blanks_signs_and_zeros_around_a_number_do_not_matter(token):
    assert parse([token]) == ((1, 0, 1), [1.5])


@pytest.mark.parametrize(
    "token", ["nan", "NaN", "inf", "-inf", "Infinity", "1e400", "-1e-400", "0e99999", "9" * 400, "0." + "1" * 1074]
)
def test_what_is_no_plain_decimal_reads_as_float_does(token):
    np.testing.assert_array_equal(parse([token])[1], [float(token)])


@pytest.mark.parametrize(
    "token",
    ["-", "+", ".", "e5", "1e", "1e+", "--1", "+-1", "1.2.3", "0x10", "1_000", "1 2", "one", "1,5", "\xa0", "1\0"],
)
def test_what_is_no_number_is_not_read(token):
    assert parse([token], ";")[0] == (0, 1, 0)


def test_the_parser_writes_wanted_fields_into_their_columns():
    out = np.full((2, 3), -1.0)
    slots = np.array([1, -1, 0], np.int32)
    assert _text.parse(b"1,x,3\n4,,6\n", ",", slots, out, 3) == (2, 0, 3)
    assert out.tolist() == [[3, 6, -1], [1, 4, -1]]
    assert _text.parse(b"1,x,3\n4,5\n", ",", slots, out, 3) == (1, 2, 2)
    assert _text.parse(b"1,x,3\n4,5,6,7\n", ",", slots, out, 3) == (1, 2, 4)
    assert _text.parse(b"", ",", slots, out, 3) == (0, 0, 0)


@pytest.mark.parametrize("size", [0, 1, 254, 255, 256, 5000])
def test_line_ends_are_counted(size):
    block = np.random.default_rng(size).choice(np.frombuffer(b"\n\r0,\xff", np.uint8), size).tobytes()
    assert _text.line_ends(block) == block.count(b"\n")
    assert _text.line_ends(b"\n" * size) == size


@pytest.mark.parametrize(("slot", "rows", "delimiter"), [(2, 3, ","), (0, 2, ","), (0, 3, "é")])
def test_the_parser_never_writes_beyond_its_buffer(slot, rows, delimiter):
    with pytest.raises(ValueError, match="output buffer is too small"):
        _text.parse(b"1\n2\n3\n", delimiter, np.array([slot], np.int32), np.empty((2, rows)), rows)


# --- native CSV ------------------------------------------------------------------------------------------------


def test_a_file_is_read_with_its_units_metadata_and_hash(file):
    content = b"# serial: SN 42\n# made in 2026\n#note : a: b\n\n" + HEAD + b"0,1.5,20\n0.01,-2e-1,\n"
    path = file(content)
    recording = read(path)
    assert {name: column.tolist() for name, column in recording.columns.items() if name != "temperature"} == {
        "time": [0, 0.01],
        "accel_x": [1.5, -0.2],
    }
    np.testing.assert_array_equal(recording.column("temperature"), [20, np.nan])
    assert dict(recording.units) == {"time": "s", "accel_x": "m/s^2", "temperature": "degC"}
    assert dict(recording.metadata) == {"serial": "SN 42", "note": "a: b"}
    assert recording.source is not None
    assert recording.source.file == recording.name == str(path)
    assert recording.source.sha256 == hashlib.sha256(content).hexdigest()
    assert recording.place(0) == "row 1 (line 6)"


ROWS = b"0,1,20\n1,2,21\n2,3,22\n"


@pytest.mark.parametrize(
    "content",
    [
        HEAD + ROWS[:-1],
        HEAD + ROWS + b"\n \n\t\n\r\n\n",
        (HEAD + ROWS).replace(b"\n", b"\r\n"),
        (HEAD + ROWS).replace(b"\n", b"\r\n") + b"\r\n\r\n",
        b"\xef\xbb\xbf" + HEAD + ROWS,
        b"\xef\xbb\xbf# serial: 7\n" + HEAD + ROWS,
        b"\n\n" + HEAD + ROWS,
        (HEAD + ROWS).replace(b",", b" , "),
        b'"time [s]","accel_x [m/s^2]","temperature [degC]"\n' + ROWS,
    ],
)
def test_the_usual_variants_of_text_read_alike(file, content):
    recording = read(file(content))
    assert {name: column.tolist() for name, column in recording.columns.items()} == {
        "time": [0, 1, 2],
        "accel_x": [1, 2, 3],
        "temperature": [20, 21, 22],
    }
    assert recording.source.sha256 == hashlib.sha256(content).hexdigest()


def test_numbers_equal_those_of_another_reader(file):
    rng = np.random.default_rng(3)
    values = rng.standard_normal((2000, 3)) * 10.0 ** rng.integers(-12, 12, (2000, 3))
    path = file(HEAD + b"\n".join(b"%.17g,%.9g,%.4g" % tuple(row) for row in values))
    other = polars.read_csv(path, schema_overrides=[polars.Float64] * 3)
    recording = read(path)
    for name, theirs in zip(recording.columns, other.iter_columns(), strict=True):
        assert bits(recording.column(name)) == bits(theirs.to_numpy())


FIFTY = b"".join(b"%d,1,20\n" % k for k in range(49))
REFUSED = {
    "letters": (HEAD + FIFTY + b"0.5,x1,20\n", "row 50 (line 51), column accel_x: expected a number, found 'x1'"),
    "quoted": (HEAD + FIFTY + b'0.5,1,"2\n', "row 50 (line 51), column temperature: expected a number, found '\"2'"),
    "comments": (b"# a\n# b: c\n\n" + HEAD + FIFTY + b"?,1,2\n", "row 50 (line 54), column time: expected a number"),
    "too long": (
        HEAD + b"1,0.%s,2\n" % (b"1" * 1100),
        "row 1 (line 2), column accel_x: expected a number of at most 1100 characters, found '0.111",
    ),
    "long": (HEAD + b"1,%s,2\n" % (b"z" * 500), "row 1 (line 2), column accel_x: expected a number, found 'zzz"),
    "ragged short": (HEAD + FIFTY + b"0.5,1\n0.6,1,20\n", "row 50 (line 51): expected 3 fields, found 2"),
    "ragged long": (HEAD + FIFTY + b"0.5,1,20,4\n", "row 50 (line 51): expected 3 fields, found 4"),
    "blank": (HEAD + FIFTY + b"\n9,1,20\n", "row 50 (line 51): expected 3 fields, found an empty line"),
    "blanks": (HEAD + FIFTY + b" \t \r\n\n9,1,20\n", "row 50 (line 51): expected 3 fields, found an empty line"),
    "decimal comma": (HEAD + b"0;1;2\n", "row 1 (line 2), column time: expected a number, found '0;1;2'"),
    "comment below": (HEAD + b"0,1,2\n# end\n", "row 2 (line 3), column time: expected a number, found '# end'"),
    "no rows": (HEAD, "no rows of data"),
    "no rows, blank": (HEAD + b"\n\n", "no rows of data"),
    "comments only": (b"# serial: 1\n# model: 2\n", "only comments; expected a line of titles"),
    "empty": (b"", "the file is empty"),
    "blank only": (b"\n \n\r\n", "the file is empty"),
    "binary": (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "expected text, found binary data"),
    "utf-16": ("time [s],x\n1,2\n".encode("utf-16"), "expected text, found binary data"),
    "latin-1": ("time [s],temperature [°C]\n0,1\n".encode("latin-1"), "line 1: expected UTF-8 text"),
    "numbers": (b"# c\n0.1, 2e3\n", "line 2: expected titles such as 'time [s],accel_x [m/s^2]', found numbers"),
    "twice": (b"#\ntime [s],accel_x [g],accel_x [g]\n", "line 2: column accel_x appears twice"),
    "nameless": (b"time [s],,accel_x [g]\n0,1,2\n", "line 1: a column without a name"),
    "unit missing": (b"time [s],accel_x\n0,1\n", "column accel_x has no unit; expected a title such as 'accel_x ["),
    "unit wrong": (b"time [s],accel_x [deg/s]\n0,1\n", "column accel_x: expected a unit of acceleration or output"),
    "unit unknown": (b"time [sec],accel_x [g]\n0,1\n", "column time: unknown unit 'sec'; known units: s ms us"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_file_that_is_not_native_csv_is_refused_with_the_place(file, case):
    content, message = REFUSED[case]
    path = file(content)
    with pytest.raises(UnitError if case.startswith("unit") else ReadError) as caught:
        read(path)
    assert str(caught.value).startswith(str(path))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "z" * 41 not in str(caught.value)


def test_a_file_that_is_not_there_or_no_file_is_refused(tmp_path):
    with pytest.raises(ReadError, match=r"absent\.csv: no such file"):
        read(tmp_path / "absent.csv")
    with pytest.raises(ReadError, match="expected a file, found a folder"):
        read(tmp_path)
    with pytest.raises(ReadError, match="no such file"):
        next(read_blocks(tmp_path / "absent.csv"))


def test_a_dash_reads_standard_input(monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(HEAD + ROWS)))
    recording = read("-")
    assert recording.column("accel_x").tolist() == [1, 2, 3]
    assert recording.name == recording.source.file == "standard input"
    assert recording.source.sha256 == hashlib.sha256(HEAD + ROWS).hexdigest()
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(HEAD + b"0,1\n")))
    with pytest.raises(ReadError, match=r"^standard input: row 1 \(line 2\): expected 3 fields, found 2"):
        read("-")


# --- blocks ----------------------------------------------------------------------------------------------------

LONG = b"# serial: SN42\n" + HEAD + b"".join(b"%d,%d.25,2e1\r\n" % (k, 3 * k) for k in range(200)) + b"\n\r\n\n"
SIZES = [1, 2, 3, 7, 16, 61, 200, 1024]


@pytest.mark.parametrize("size", SIZES)
def test_a_file_of_many_blocks_equals_the_file_read_whole(file, monkeypatch, size):
    path = file(LONG)
    whole = read(path)
    assert len(whole) == 200
    monkeypatch.setattr("imulab.readers.text._BLOCK_BYTES", size)
    joined, blocks = read(path), list(read_blocks(path))
    assert len(blocks) > 3
    assert joined.source == whole.source
    assert [block.first_row for block in blocks] == [1, *(1 + np.cumsum([len(b) for b in blocks])[:-1])]
    for name, column in whole.columns.items():
        assert bits(joined.column(name)) == bits(column)
        assert bits(np.concatenate([block.column(name) for block in blocks])) == bits(column)
    for block in blocks:
        assert (block.units, block.metadata, block.lines_before) == (whole.units, whole.metadata, 2)
    assert blocks[-1].place(len(blocks[-1]) - 1) == whole.place(199) == "row 200 (line 202)"


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    ("line", "message"),
    [
        (b"1,oops,3", "row 150 (line 152), column accel_x: expected a number, found 'oops'"),
        (b"1,2", "row 150 (line 152): expected 3 fields, found 2"),
        (b"\n\n", "row 150 (line 152): expected 3 fields, found an empty line"),
    ],
)
def test_rows_are_numbered_through_all_blocks(file, monkeypatch, size, line, message):
    lines = LONG.split(b"\r\n")  # the first holds the head and row 1
    lines[149] = line
    monkeypatch.setattr("imulab.readers.text._BLOCK_BYTES", size)
    with pytest.raises(ReadError) as caught:
        read(file(b"\n".join(lines)))
    assert message in str(caught.value)


# --- layouts ---------------------------------------------------------------------------------------------------


def toml(file, text: str) -> Path:
    return file(text.encode(), "foreign.toml")


COLUMNS = '[columns]\ntime = { from = 0, unit = "ms" }\naccel_x = { from = 2, unit = "count" }\n'


@pytest.mark.parametrize(
    ("delimiter", "content"),
    [
        ("whitespace", b"0  7 -1.5\n\t10 \t8 2.5 \r\n20 9 0\n\n"),
        (",", b"0,7,-1.5\n10,x,2.5\n20,,0\n"),
        (";", b"0;7;-1.5\r\n10;1,5;2.5\r\n20;9; 0"),
        ("\\t", b"0\t7\t-1.5\n10\t\t2.5\n20\t9\t0\n \n"),
    ],
)
def test_a_layout_takes_columns_by_number(file, delimiter, content):
    layout = toml(file, f'delimiter = "{delimiter}"\n{COLUMNS}[metadata]\nserial = "SN42"\nyear = 2026\n')
    recording = read(file(content, "log.txt"), layout)
    assert {k: v.tolist() for k, v in recording.columns.items()} == {"time": [0, 10, 20], "accel_x": [-1.5, 2.5, 0]}
    assert dict(recording.units) == {"time": "ms", "accel_x": "count"}
    assert dict(recording.metadata) == {"serial": "SN42", "year": "2026"}
    assert recording.source.sha256 == hashlib.sha256(content).hexdigest()
    assert recording.place(1) == "row 2 (line 2)"


@pytest.mark.parametrize("head", ["a,Time (s),b,Acc X", '"a","Time (s)","b","Acc X"', "# a, Time (s), b, Acc X"])
def test_a_layout_takes_columns_by_name_below_skipped_lines(file, head):
    layout = toml(
        file,
        'delimiter = ","\nskip_lines = 2\n[columns]\naccel_x = { from = "Acc X", unit = "mg" }\n'
        'time = { from = "Time (s)", unit = "s" }\ngyro_x = { from = 2, unit = "deg/s" }\n',
    )
    recording = read(file(f"logger 3\nfree text, with commas\n{head}\n9,0.5,8,7\n".encode()), layout)
    assert {k: v.tolist() for k, v in recording.columns.items()} == {"accel_x": [7], "time": [0.5], "gyro_x": [8]}
    assert recording.place(0) == "row 1 (line 4)"


@pytest.mark.parametrize("size", SIZES)
def test_head_comments_above_foreign_rows_are_skipped(file, monkeypatch, size):
    monkeypatch.setattr("imulab.readers.text._BLOCK_BYTES", size)
    recording = read(file(b"# a\n#b c\n#\n" + b"10 1 2\n" * 5), toml(file, COLUMNS))
    assert recording.column("accel_x").tolist() == [2] * 5
    assert recording.place(0) == "row 1 (line 4)"


def test_a_byte_order_mark_above_foreign_rows_is_skipped(file):
    recording = read(file(b"\xef\xbb\xbf10 1 2\n20 1 3\n"), toml(file, COLUMNS))
    assert recording.column("time").tolist() == [10, 20]


@pytest.mark.parametrize("size", SIZES)
def test_a_sample_rate_makes_the_time_through_all_blocks(file, monkeypatch, size):
    monkeypatch.setattr("imulab.readers.text._BLOCK_BYTES", size)
    head = 'sample_rate = { value = 0.0625, unit = "kHz" }\n'
    layout = toml(file, head + '[columns]\naccel_x = { from = 0, unit = "V" }\n')
    recording = read(file(b"".join(b"%d\n" % k for k in range(100))), layout)
    assert list(recording.columns) == ["time", "accel_x"]
    assert recording.units["time"] == "s"
    assert recording.time.tolist() == [float(k * Decimal("0.016")) for k in range(100)]
    assert recording.column("accel_x").tolist() == list(range(100))


@pytest.mark.parametrize("field", ["\u00a0", "\x0c5", "5\u00a0g", "\x0b"])
def test_a_field_with_an_odd_blank_in_it_is_refused_as_it_stands(file, field):
    with pytest.raises(ReadError) as caught:
        read(file(f"0 1 2\n10 1 {field}\n".encode()), toml(file, COLUMNS))
    assert f"row 2 (line 2), column accel_x: expected a number, found {field!r}" in str(caught.value)


FOG = '[columns]\nfog = { from = 0, unit = "V" }\n'
LAYOUTS = {
    "unknown key": (
        'delimeter = ","\n' + COLUMNS,
        "unknown key 'delimeter'; known keys: columns delimiter header",
    ),
    "delimiter": ('delimiter = "|"\n' + COLUMNS, "delimiter '|'; expected 'whitespace' ',' ';' or a tab"),
    "delimiters": ('delimiter = [","]\n' + COLUMNS, "delimiter [',']; expected 'whitespace' ',' ';' or a tab"),
    "no columns": ('delimiter = ","\n', "no [columns]; expected lines such as accel_x = { from = 1"),
    "empty columns": ("[columns]\n", "no [columns]"),
    "skip_lines": ("skip_lines = -1\n" + COLUMNS, "skip_lines = -1; expected a number of lines"),
    "header": ('header = "yes"\n' + COLUMNS, "header = 'yes'; expected true or false"),
    "metadata": ("metadata = 3\n" + COLUMNS, "metadata = 3; expected a table"),
    "two times": ("sample_rate = 100\n" + COLUMNS, "both a time column and sample_rate; expected one of them"),
    "no unit": ("[columns]\naccel_x = { from = 1 }\n", "column accel_x: expected accel_x = { from = 1, unit ="),
    "column key": (
        '[columns]\nfog = { from = 0, unit = "V", scal = 2 }\n',
        "column fog: unknown key 'scal'; known keys: from unit scale zero scale_factor day_first bits; did you "
        "mean 'scale'?",
    ),
    "from": ('[columns]\nfog = { from = -1, unit = "V" }\n', "column fog: from = -1; expected a column number from 0"),
    "unit of rate": (
        'sample_rate = { value = 1, unit = "s" }\n' + FOG,
        "sample_rate: expected a unit of frequency",
    ),
    "rate alone": ("sample_rate = { value = 1 }\n" + FOG, "sample_rate: expected { value = 100, unit ="),
    "rate 0": ("sample_rate = 0\n" + FOG, "sample_rate: expected a number of Hz from 1e-06 to 1e+09, found 0"),
    "rate true": (
        'sample_rate = { value = true, unit = "Hz" }\n' + FOG,
        "sample_rate: expected a number, found True",
    ),
    "not TOML": ("columns = [", "the layout file is not TOML"),
    "unit unknown": (
        '[columns]\nfog = { from = 0, unit = "vo" }\n',
        "column fog: unknown unit 'vo'; known units: rad/s mrad/s",
    ),
    "unit wrong": (
        '[columns]\nfog = { from = 0, unit = "s" }\n',
        "column fog: expected a unit of rate or output, found",
    ),
}


@pytest.mark.parametrize("case", LAYOUTS)
def test_a_layout_that_is_none_is_refused(file, case):
    text, message = LAYOUTS[case]
    path = toml(file, text)
    with pytest.raises(UnitError if case.startswith("unit") else ReadError) as caught:
        load_layout(path)
    assert str(caught.value).startswith(f"{path}: {message}")


def test_a_layout_that_cannot_be_read_is_refused(tmp_path, file):
    with pytest.raises(ReadError, match=r"absent\.toml: no such layout file"):
        load_layout(tmp_path / "absent.toml")
    with pytest.raises(ReadError, match=r"latin\.toml: line 1: expected a layout file of UTF-8 text"):
        load_layout(file(b"\xff\xfe", "latin.toml"))


@pytest.mark.parametrize(
    ("origins", "content", "message"),
    [
        ((0, 3), "1 2 3\n", "foreign takes accel_x from column 3, found 3 columns"),
        ((1, 1), "1 2 3\n", "foreign takes both time and accel_x from column 1"),
        (("t", "ax"), "t ay\n1 2\n", "foreign takes accel_x from a column named 'ax', found t ay"),
        (("t", 5), "t ay\n1 2\n", "foreign takes accel_x from column 5, found 2 columns"),
        (("t", "ax"), "t ax ax\n1 2 3\n", "foreign takes accel_x from a column named 'ax', found"),
        ((0, 1), "1 2 3\n1 2\n", "row 2 (line 2): expected 3 fields, found 2"),
        ((0, 1), "1 2 3\n\n4 5 6\n", "row 2 (line 2): expected 3 fields, found an empty line"),
        ((0, 2), "1 ? 3\n1 ? n/a\n", "row 2 (line 2), column accel_x: expected a number, found 'n/a'"),
        ((0, 1), "# nothing\n", "no rows of data"),
    ],
)
def test_a_file_that_does_not_fit_its_layout_is_refused(file, origins, content, message):
    columns = {"time": LayoutColumn(origins[0], "s"), "accel_x": LayoutColumn(origins[1], "g")}
    layout = Layout(columns, header=isinstance(origins[0], str), name="foreign")
    path = file(content.encode())
    with pytest.raises(ReadError) as caught:
        read(path, layout)
    assert str(caught.value).startswith(str(path))
    assert message in str(caught.value)


def test_quoted_numbers_are_read(file):
    recording = read(file(b'"time [s]","accel_x [g]"\n"0.5","-1.25"\n1.5,"2"\n'))
    assert recording.column("time").tolist() == [0.5, 1.5]
    assert recording.column("accel_x").tolist() == [-1.25, 2.0]


def test_columns_outside_the_vocabulary_keep_a_unit_that_is_not_known(file):
    recording = read(file(b"time [s],mag_x [uT]\n0,1\n1,2\n"))
    assert recording.units == {"time": "s", "mag_x": "uT"}


@pytest.mark.parametrize(
    ("titles", "message"),
    [
        (b"Time [s],accel_x [g]", "column 'Time': expected the name 'time'"),
        (b"timestamp [s],accel_x [g]", "column 'timestamp': expected the name 'time'"),
        (b"time [s],Accel X [g]", "column 'Accel X': expected the name 'accel_x'"),
        (b"time [s];accel_x [g]", "separated by ';', expected ','; describe the file with --layout"),
        (b"time [s]\taccel_x [g]", "separated by a tab"),
    ],
)
def test_titles_that_nearly_are_ours_are_refused_with_what_is_meant(file, titles, message):
    with pytest.raises(UnitError) as caught:
        read(file(titles + b"\n0,1\n1,2\n"))
    assert message in str(caught.value)


def test_a_decimal_comma_is_recognised(file):
    layout = Layout({"time": LayoutColumn(0, "s"), "accel_x": LayoutColumn(1, "g")}, delimiter=";", name="foreign")
    with pytest.raises(ReadError, match="found '0,5' \\(a decimal comma\\? expected a point\\)"):
        read(file(b"0,5;1,25\n"), layout)


def test_a_record_in_the_place_of_a_recording_is_recognised(file):
    with pytest.raises(ReadError, match=r"expected a recording, found JSON \(a calibration record\?\)"):
        read(file(b'{\n "format": "imulab.calibration"\n}\n'))


@pytest.mark.parametrize(
    ("head", "kind"),
    [
        ("<!DOCTYPE html>\n<html>", "a web page"),
        ("\ufeff<HTML>", "a web page"),
        ("\n<gpx><trk/>\n</gpx>\n", r"an XML file \(imulab show reads certificates\)"),
        ("<!-- made by hand -->\n<a/>\n", "an XML file"),
    ],
)
def test_pages_are_no_recordings(tmp_path, head, kind):
    path = tmp_path / "page.csv"
    path.write_text(head, encoding="utf-8")
    with pytest.raises(ReadError, match=f"page.csv: expected a recording, found {kind}"):
        il.read(path)


def test_a_line_without_an_end_is_refused_in_few_words(file):
    with pytest.raises(ReadError, match="line 1: expected a line of text, found more than 1048576 bytes") as met:
        read(file(b"a" * 3_000_000))
    assert len(str(met.value)) < 300


def test_blocks_that_are_joined_as_they_are_read_make_the_same_recording(tmp_path, monkeypatch):
    count = 150_000
    columns = {"time": np.arange(count) / 100, "gyro_x": np.random.default_rng(1).standard_normal(count)}
    il.write(il.Recording(columns, {"time": "s", "gyro_x": "deg/s"}, {"serial": "7"}), tmp_path / "long.parquet")
    monkeypatch.setattr(readers, "_PART", 40_000)
    found = il.read(tmp_path / "long.parquet")
    assert {name: np.array_equal(values, columns[name]) for name, values in found.columns.items()} == {
        "time": True,
        "gyro_x": True,
    }
    assert (found.units["gyro_x"], found.metadata["serial"], found.first_row) == ("deg/s", "7", 1)


# --- the hash of a large file, in a thread of its own ------------------------------------------------------------


class SlowHash:
    """A hash that takes longer than reading, and counts blocks; `broken`: the one at which it raises an error."""

    def __init__(self, broken: int | None = None):
        self.blocks, self.broken, self.sum = 0, broken, hashlib.sha256()

    def update(self, data):
        time.sleep(0.01)
        if self.blocks == self.broken:
            raise MemoryError("no room for the hash")
        self.sum.update(data)
        self.blocks += 1

    def hexdigest(self):
        return self.sum.hexdigest()


@pytest.fixture
def slow_hash(monkeypatch):
    def install(broken: int | None = None) -> SlowHash:
        slow = SlowHash(broken)
        monkeypatch.setattr(text.hashlib, "sha256", lambda: slow)
        return slow

    return install


def test_few_blocks_wait_for_a_slow_hash(slow_hash):
    slow, blocks = slow_hash(), [bytes([k]) * text.WORTH_SHARING for k in range(30)]
    digest, most = text.Hash(), 0
    for number, block in enumerate(blocks, start=1):
        digest.update(block)
        most = max(most, number - slow.blocks)
    digest.stop()
    assert 2 <= most <= 6
    assert digest.hexdigest() == hashlib.new("sha256", b"".join(blocks)).hexdigest()


def threads_end(before: int) -> bool:
    deadline = time.monotonic() + 10
    while threading.active_count() > before and time.monotonic() < deadline:
        gc.collect()
        time.sleep(0.01)
    return threading.active_count() <= before


LARGE_FILE = b"accel_x [m/s^2],temperature [degC]\n" + b"1.23456789,20\n" * 1_500_000  # ten blocks


@pytest.mark.parametrize("broken", [0, 2, 9])
def test_an_error_of_the_hash_ends_reading(file, slow_hash, broken):
    before = threading.active_count()
    slow_hash(broken)
    with pytest.raises(MemoryError, match="no room for the hash"):
        read(file(LARGE_FILE))
    assert threads_end(before)


def test_an_error_of_a_row_or_an_early_end_of_reading_leaves_no_thread_behind(file, slow_hash):
    before = threading.active_count()
    slow_hash()
    with pytest.raises(ReadError, match="expected a number, found 'bad'"):
        read(file(LARGE_FILE[:14_000_035] + b"bad,20\n" + LARGE_FILE[14_000_035:]))
    assert threads_end(before)
    blocks = read_blocks(file(LARGE_FILE))
    assert len(next(blocks)) > 0
    del blocks
    assert threads_end(before)

"""JSON recordings through a layout: records, one a line, and arrays by key; and what is refused of them."""

import json
from pathlib import Path

import numpy as np
import pytest

from imulab.errors import ReadError
from imulab.readers import read, read_blocks
from imulab.recording import Layout, LayoutColumn


@pytest.fixture
def file(tmp_path):
    def write(content: object, name: str = "log.json") -> Path:
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
        return path

    return write


def layout(time: str = "t", accel: str = "ax", **keys) -> Layout:
    columns = {"time": LayoutColumn(time, "s"), "accel_x": LayoutColumn(accel, "g")}
    return Layout(columns, name="foreign", **keys)


TIME, ACCEL = [0, 0.5, 1], [1.25, -3e-3, 7]
FLAT = [{"t": t, "name": "x", "ax": a} for t, a in zip(TIME, ACCEL, strict=True)]
NESTED = [{"t": t, "acc": {"x": a, "xyz": [0, a, 9]}} for t, a in zip(TIME, ACCEL, strict=True)]
SHAPES = {
    "records": (FLAT, "t", "ax"),
    "records in an object": ({"log": {"rows": FLAT}, "n": 3}, "log.rows.t", "log.rows.ax"),
    "nested": (NESTED, "t", "acc.x"),
    "place in an array": (NESTED, "t", "acc.xyz[1]"),
    "arrays": ({"t": TIME, "ax": ACCEL, "serial": "A"}, "t", "ax"),
    "nested arrays": ({"t": TIME, "acc": {"x": ACCEL}}, "t", "acc.x"),
    "matrix": ({"t": TIME, "acc": [[0, a] for a in ACCEL]}, "t", "acc[1]"),
    "dot in a key": ({"t": TIME, "acc.x": ACCEL}, "t", "acc.x"),
    "lines": (b"\n\n".join(json.dumps(row).encode() for row in FLAT) + b"\n", "t", "ax"),
    "mark and blanks": (b"\xef\xbb\xbf \r\n" + json.dumps(FLAT, indent=2).encode(), "t", "ax"),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_gives_the_same_columns(file, shape):
    content, time, accel = SHAPES[shape]
    recording = read(file(content), layout(time, accel))
    assert recording.time.tolist() == TIME
    assert recording.column("accel_x").tolist() == ACCEL
    assert dict(recording.units) == {"time": "s", "accel_x": "g"}


def test_a_layout_file_converts_and_dates_are_seconds_since_the_first(file, tmp_path):
    made = file(
        b"""
[columns]
time = { from = "when", unit = "iso" }
gyro_x = { from = "out.g", unit = "mV", zero = { value = 2.5, unit = "V" } }
temperature = { from = "T", unit = "degC", scale = 0.5 }
[scale_factor]
gyro_x = { value = 20, unit = "mV/(deg/s)" }
[metadata]
serial = "SN9"
""",
        "l.toml",
    )
    stamps = ["2026-11-22T15:04:05Z", "2026-11-22T16:04:05.250+01:00", "2026-11-22 15:04:06"]
    rows = [
        {"when": w, "out": {"g": g}, "T": t} for w, g, t in zip(stamps, [2500, 2520, 500], [40, 50, None], strict=True)
    ]
    recording = read(file(rows), made)
    assert recording.time.tolist() == [0, 0.25, 1]
    np.testing.assert_allclose(recording.column("gyro_x"), [0, 1, -100], atol=1e-13)
    np.testing.assert_array_equal(recording.column("temperature"), [20, 25, np.nan])
    assert recording.units["gyro_x"] == "deg/s"
    assert recording.metadata["serial"] == "SN9"


def test_more_rows_than_a_block_have_the_rate_of_the_layout(file):
    count = 70_000
    made = Layout({"accel_x": LayoutColumn("a", "g")}, name="foreign", sample_rate=100)
    path = file({"a": list(range(count))})
    first, second = read_blocks(path, made)
    assert (len(first), second.first_row) == (65536, 65537)
    recording = read(path, made)
    np.testing.assert_array_equal(recording.column("accel_x"), np.arange(count))
    np.testing.assert_array_equal(recording.time, np.arange(count) / 100)


def test_incomplete_rows_are_skipped_and_counted_and_errors_name_rows_of_the_file(file):
    rows = [{"t": 0, "ax": 1}, {"t": 1, "gx": 5}, {"t": 2, "ax": None}, {"ax": 2}, {"t": 3, "ax": 4, "gx": 7}]
    recording = read(file(rows), layout(skip_incomplete=True))
    assert recording.time.tolist() == [0, 3]
    assert recording.column("accel_x").tolist() == [1, 4]
    assert recording.notes == ("3 rows were skipped that lack a reading of time accel_x (skip_incomplete in foreign)",)
    rows[4]["ax"] = "4"
    with pytest.raises(ReadError, match="row 5, key 'ax': expected a number, found '4'"):
        read(file(rows), layout(skip_incomplete=True))
    with pytest.raises(ReadError, match="no rows of data: 2 rows were skipped that lack a reading of time accel_x"):
        read(file([{"t": 0, "ax": None}, {"t": None, "ax": 1}]), layout(skip_incomplete=True))


def test_the_last_bit_of_every_number_is_read(file):
    numbers = np.random.default_rng(3).normal(size=2000) * 10.0 ** np.arange(-100, 100).repeat(10)
    path = file({"t": list(range(2000)), "ax": [float(number) for number in numbers]})
    np.testing.assert_array_equal(read(path, layout()).column("accel_x"), numbers)


ROWS = [{"t": 0, "ax": 1}, {"t": 1, "ax": 2}]
DEEP = b"[" * 200_000
REFUSED = {
    "cut": (b'[{"t": 0,\n "ax": 1}, {"t"', "line 2, column 16: not JSON: expecting ':' delimiter; the file ends there"),
    "no JSON": (b'[{"t": 0,\n "ax" 1}]', "line 2, column 7: not JSON: expecting ':' delimiter"),
    "a bad line": (b'{"t": 0, "ax": 1}\n\n{"t": 1; "ax": 2}\n', "line 3, column 8: not JSON: expecting ',' delimiter"),
    "a cut line": (
        b'{"t": 0, "ax": 1}\r\n{"t": 1, "ax": 2}\n{"t": 2, "a',
        "line 3, column 10: not JSON: unterminated string starting at",
    ),
    "no UTF-8": (b'[{"t\xff": 0}]', "byte 4: expected UTF-8 text, as JSON is"),
    "deep": (DEEP, "nests arrays or objects hundreds of levels deep"),
    "many digits": (b'[{"t": 0, "ax": ' + b"9" * 5000 + b"}]", "a whole number of thousands of digits"),
    "large": (
        b'[{"t": 0, "ax": 1' + b"0" * 400 + b"}]",
        "row 1, key 'ax': expected a number, found 1000000000000000000000000000000000000...",
    ),
    "infinite": (b'[{"t": 0, "ax": 1e999}]', "row 1, key 'ax': expected a number, found inf"),
    "NaN": (
        b'[{"t": 0, "ax": 1}, {"t": 1, "ax": NaN}]',
        "row 2, key 'ax': expected a number, found NaN (missing readings are written null)",
    ),
    "Infinity": (b'{"t": [0, 1], "ax": [1, -Infinity]}', "row 2, key 'ax': expected a number, found -Infinity"),
    "text": ([*ROWS, {"t": 2, "ax": "3"}], "row 3, key 'ax': expected a number, found '3'"),
    "truth": ({"t": [0], "ax": [True]}, "row 1, key 'ax': expected a number, found true"),
    "object": ([{"t": 0, "ax": {"x": 1, "y": 2}}], "row 1, key 'ax': expected a number, found an object (x y)"),
    "array": ([{"t": 0, "ax": [1, 2]}], "row 1, key 'ax': expected a number, found an array of 2"),
    "record lacks a key": (
        [*ROWS, {"t": 2, "ax2": 1}],
        "foreign takes accel_x from 'ax': row 3: no such key, found t ax2; did you mean 'ax2'?; skip_incomplete = true",
    ),
    "no record has the key": ([{"t": 0, "Ax": 1}], "row 1: no such key, found t Ax; did you mean 'Ax'?"),
    "no array of the key": (
        {"t": [0], "a": {"x": [1]}},
        "foreign takes accel_x from 'ax': no such key, found t a.x; did you mean 'a.x'?",
    ),
    "lengths": ({"t": [0, 1], "ax": [1, 2, 3]}, "columns of different length: time 2, accel_x 3"),
    "object for an array": (
        {"t": [0], "ax": {"x": 1}},
        "foreign takes accel_x from 'ax': expected an array, found an object (x)",
    ),
    "number for an array": ({"t": 0, "ax": 1}, "foreign takes time from 't': expected an array, found 0"),
    "number for a record": ([{"t": 0, "ax": 1}, 7], "row 2: expected an object with the key 't', found 7"),
    "no rows": ([], "no rows of data"),
    "record of imulab": (
        {"format": "imulab.calibration", "version": 1},
        "expected a recording, found JSON (a calibration record?)",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_wrong_is_named_in_one_line(file, case):
    content, message = REFUSED[case]
    with pytest.raises(ReadError) as caught:
        read(file(content), layout())
    assert str(caught.value).startswith(f"{file(content)}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_layouts_that_do_not_fit_json_are_refused(file):
    with pytest.raises(ReadError, match=r'takes time from column 0; in a JSON file they have names: from = "key"'):
        read(file(FLAT), layout(time=0))
    with pytest.raises(ReadError, match="prefix is for text, and this is a JSON file"):
        read(file(FLAT), layout(prefix="IMU"))
    with pytest.raises(ReadError, match=r"row 1: expected an array with a place \[3\], found an array of 3"):
        read(file(NESTED), layout(accel="acc.xyz[3]"))
    dated = Layout({"time": LayoutColumn("t", "s", date=True)}, name="foreign")
    for bad, shown in (("22.11.2026", "'22.11.2026'"), (5, "5"), ("a\nb", r"'a\\nb'"), (None, "null"), ("", "''")):
        rows = [{"t": "2026-11-22T15:04:05Z"}, {"t": bad}, {"t": "2026-11-22T15:04:06Z"}]
        with pytest.raises(ReadError) as caught:
            read(file(rows), dated)
        said = "row 2, key 't': expected a date and time such as 2026-11-22T15:04:05.250Z, found "
        assert str(caught.value).endswith(said + shown.replace("\\\\", "\\"))


def test_a_file_that_is_too_large_is_refused_before_it_is_read(file, monkeypatch):
    monkeypatch.setattr("imulab.readers.jsonfile.LARGEST", 20)
    with pytest.raises(ReadError, match="MB of JSON; expected at most 0 MB, which are held in memory"):
        read(file(FLAT), layout())


def test_the_commands_read_json_and_list_its_keys(imulab, file, tmp_path):
    file({"t": TIME, "acc": {"x": ACCEL}})
    done = imulab("show", "log.json")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        "imulab: log.json: not a calibration record; of a recording --layout says which key is what; found t acc.x\n"
    )
    file(b'[columns]\ntime = { from = "t", unit = "s" }\naccel_x = { from = "acc.x", unit = "g" }\n', "l.toml")
    assert imulab("convert", "log.json", "--layout", "l.toml", "-o", "out.csv").returncode == 0
    assert (tmp_path / "out.csv").read_text() == "time [s],accel_x [g]\n0.0,1.25\n0.5,-0.003\n1.0,7.0\n"
    file(b'{"t": [0, NaN], "acc": {"x": [1, 2]}}', "bad.json")
    done = imulab("convert", "bad.json", "--layout", "l.toml", "-o", "no.csv")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (
        "imulab: bad.json: row 2, key 't': expected a number, found NaN (missing readings are written null)\n"
    )
    assert not (tmp_path / "no.csv").exists()
    assert "JSON" in imulab("show", "--formats").stdout


def test_text_whose_lines_begin_with_a_bracket_is_still_text(file):
    made = Layout({"accel_x": LayoutColumn(1, "g")}, name="foreign")
    assert read(file(b"[12.5] 1\n[12.6] 2\n", "log.txt"), made).column("accel_x").tolist() == [1, 2]


def test_an_empty_file_is_refused(file):
    with pytest.raises(ReadError, match=r"log\.json: "):
        read(file(b""), layout())


def test_torn_lines_of_records_are_left_out_where_asked(imulab, tmp_path):
    lines = [json.dumps({"t": k / 100, "acc": {"x": k, "y": 0.0, "z": 1.0}}) for k in range(300)]
    lines[100], lines[-1] = lines[100][:15] + lines[101], lines[-1][:20]
    (tmp_path / "f.jsonl").write_text("\n".join(lines))
    axes = "".join(f'accel_{axis} = {{ from = "acc.{axis}", unit = "g" }}\n' for axis in "xyz")
    (tmp_path / "l.toml").write_text(f'[columns]\ntime = {{ from = "t", unit = "s" }}\n{axes}')
    done = imulab("show", "f.jsonl", "--layout", "l.toml")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert done.stderr.endswith("; --damaged skip passes over such lines and counts them\n")
    found = read(tmp_path / "f.jsonl", tmp_path / "l.toml", damaged="skip", name="f.jsonl")
    np.testing.assert_array_equal(found.column("accel_x"), np.delete(np.arange(299), 100))
    assert found.notes[0].startswith("2 damaged lines are left out; the first: line 101, column ")
    (tmp_path / "f.jsonl").write_text("\n".join(line[:20] if k % 9 == 4 else line for k, line in enumerate(lines)))
    with pytest.raises(ReadError, match="not JSON"):
        read(tmp_path / "f.jsonl", tmp_path / "l.toml", damaged="skip")

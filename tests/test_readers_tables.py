"""Parquet, HDF5 and MATLAB files made by the official libraries; convert, windows, and the choice of a reader."""

import contextlib
import hashlib
import shutil
import sys

import h5py
import numpy as np
import polars
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io

import imulab as il
from imulab.errors import ImulabError, OptionError, ReadError, UnitError
from imulab.readers.formats import FORMATS
from imulab.recording import Recording

ROWS = 1000
LAYOUT = """
[columns]
time = {{ from = "{t}", unit = "s" }}
accel_x = {{ from = "{x}", unit = "g" }}
accel_y = {{ from = "{y}", unit = "g" }}
[metadata]
serial = "SN42"
"""


@pytest.fixture(scope="module")
def truth():
    rng = np.random.default_rng(1)
    return {"t": np.arange(ROWS) / 100, "x": rng.normal(size=ROWS), "y": rng.normal(size=ROWS)}


@pytest.fixture
def layout(tmp_path):
    def write(text):
        path = tmp_path / "layout.toml"
        path.write_text(text)
        return path

    return write


def check(recording, truth):
    for name, key in (("time", "t"), ("accel_x", "x"), ("accel_y", "y")):
        np.testing.assert_array_equal(recording.column(name), truth[key])
    assert recording.units == {"time": "s", "accel_x": "g", "accel_y": "g"}
    assert recording.metadata["serial"] == "SN42"


def native(rows=ROWS):
    rng = np.random.default_rng(2)
    units = {"time": "s", "accel_x": "mg", "gyro_1": "deg/h", "temperature": "K", "pressure": "1"}
    columns = {name: rng.normal(size=rows) * 1e3 for name in units}
    columns["time"] = np.arange(rows) / 7
    columns["pressure"][:2] = [np.nan, np.inf]
    return Recording(columns, units, {"serial": "SN 42", "place": "Ålesund: hall 3"})


def same(after, before):
    assert list(after.units.items()) == list(before.units.items())
    assert list(after.columns) == list(before.columns)
    for name, column in before.columns.items():
        np.testing.assert_array_equal(after.column(name).view(np.uint64), column.view(np.uint64))
    assert dict(after.metadata) == dict(before.metadata)


# --- Parquet -------------------------------------------------------------------------------------------------------


def test_parquet_reads_back_exactly_with_its_metadata(tmp_path, monkeypatch):
    path = tmp_path / "out.parquet"
    before = native()
    il.write(before, path)
    same(il.read(path), before)
    assert il.read(path).source.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert pq.read_schema(path).metadata[b"serial"] == b"SN 42"
    assert polars.read_parquet(path).columns == [
        "time [s]",
        "accel_x [mg]",
        "gyro_1 [deg/h]",
        "temperature [K]",
        "pressure",
    ]
    monkeypatch.setattr("imulab.readers.parquet.ROWS", 64)
    blocks = list(il.read_blocks(path))
    assert len(blocks) == 16
    assert blocks[2].first_row == 129
    assert blocks[2].place(0) == "row 129"


def test_parquet_of_polars_with_integers_nulls_and_single_precision(tmp_path):
    path = tmp_path / "a.parquet"
    polars.DataFrame(
        {
            "time [ms]": [0, 10, 20],
            "accel_x [count]": polars.Series([1, None, -3], dtype=polars.Int16),
            "temperature [degC]": polars.Series([1.5, 2.5, None], dtype=polars.Float32),
            "ok": [True, False, True],
        }
    ).write_parquet(path)
    recording = il.read(path)
    np.testing.assert_array_equal(recording.column("accel_x"), [1, np.nan, -3])
    np.testing.assert_array_equal(recording.column("temperature"), [1.5, 2.5, np.nan])
    np.testing.assert_array_equal(recording.column("ok"), [1, 0, 1])
    assert recording.time.tolist() == [0.0, 0.01, 0.02]


def test_foreign_parquet_through_a_layout(tmp_path, truth, layout):
    path = tmp_path / "a.parquet"
    polars.DataFrame(truth).write_parquet(path)
    check(il.read(path, layout(LAYOUT.format(t="t", x="x", y="y"))), truth)
    with pytest.raises(ReadError, match="takes accel_y from a column named 'q', found t x y"):
        il.read(path, layout(LAYOUT.format(t="t", x="x", y="q")))


def test_parquet_that_is_no_recording_is_refused(tmp_path):
    path = tmp_path / "a.parquet"
    for frame, kind, message in (
        ({"time [s]": ["a"], "accel_x [g]": [1.0]}, ReadError, r"column time \[s\]: expected numbers, found"),
        ({"time": [1.0]}, UnitError, "column time has no unit"),
        ({"time [s]": polars.Series([], dtype=polars.Float64)}, ReadError, "no rows of data"),
    ):
        polars.DataFrame(frame).write_parquet(path)
        with pytest.raises(kind, match=message):
            il.read(path)


# --- HDF5 and MATLAB -----------------------------------------------------------------------------------------------


def test_hdf5_vectors_groups_matrices_and_tables(tmp_path, truth, layout):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["t"] = truth["t"]
        file["imu/x"] = truth["x"][:, None]
        file["imu/both"] = np.column_stack([truth["x"], truth["y"]])
        table = np.zeros(ROWS, dtype=[("when", "<f8"), ("y", "<f8")])
        table["y"] = truth["y"]
        file["imu/table"] = table
    for x, y in (("imu/x", "imu/both[1]"), ("imu/both[0]", "imu/table/y"), ("/imu/x", "/imu/both[1]")):
        check(il.read(path, layout(LAYOUT.format(t="t", x=x, y=y))), truth)
    for y, message in (
        ("imu/both", "matrix of 1000 x 2; say which column"),
        ("imu/both[2]", r"column 2 of a matrix with 2 columns \(counted from 0\)"),
        ("imu/z", r"takes accel_y from 'imu/z', found imu/both \(1000 x 2\), imu/table/when"),
        ("imu", "takes accel_y from 'imu', found"),
    ):
        with pytest.raises(ReadError, match=message):
            il.read(path, layout(LAYOUT.format(t="t", x="imu/x", y=y)))
    with pytest.raises(ReadError, match=r"say with --layout FILE\.toml which dataset .* datasets found: imu/both"):
        il.read(path)
    with pytest.raises(ReadError, match="takes time from column 0; in a HDF5 file they have names"):
        il.read(path, layout('[columns]\ntime = { from = 0, unit = "s" }\n'))


def test_hdf5_of_different_lengths_or_texts_is_refused(tmp_path, truth, layout):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["t"], file["x"], file["y"], file["s"] = truth["t"], truth["x"], truth["y"][:-1], [b"a"] * ROWS
        file["one"], file["none"] = 3.0, np.empty(0)
    with pytest.raises(ReadError, match="columns of different length: time 1000, accel_x 1000, accel_y 999"):
        il.read(path, layout(LAYOUT.format(t="t", x="x", y="y")))
    for x, message in (("s", "expected real numbers, found"), ("one", "single value"), ("none", "different length")):
        with pytest.raises(ReadError, match=message):
            il.read(path, layout(LAYOUT.format(t="t", x=x, y="x")))


def matlab73(path, truth):
    """As MATLAB writes it: a head of text before HDF5, matrices transposed."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (("t", truth["t"][None, :]), ("acc", np.stack([truth["x"], truth["y"]]))):
            file[name] = values
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
    data = bytearray(path.read_bytes())
    data[:19] = b"MATLAB 7.3 MAT-file"
    path.write_bytes(bytes(data))


def test_matlab_73_has_its_matrices_transposed(tmp_path, truth, layout):
    path = tmp_path / "a.mat"
    matlab73(path, truth)
    check(il.read(path, layout(LAYOUT.format(t="t", x="acc[0]", y="acc[1]"))), truth)


@pytest.mark.parametrize("compressed", [True, False])
def test_matlab_5_vectors_matrices_and_structs(tmp_path, truth, layout, compressed):
    path = tmp_path / "a.mat"
    content = {
        "t": truth["t"],
        "x": truth["x"][:, None],
        "m": np.column_stack([truth["x"], truth["y"]]),
        "imu": {"y": truth["y"], "deep": {"y": truth["y"]}},
        "name": "text",
        "z": truth["x"] * 1j,
    }
    scipy.io.savemat(path, content, do_compression=compressed)
    for x, y in (("x", "imu/y"), ("m[0]", "m[1]"), ("x", "imu/deep/y")):
        check(il.read(path, layout(LAYOUT.format(t="t", x=x, y=y))), truth)
    for x, message in (
        ("q", "takes accel_x from 'q', found t x m imu name z"),
        ("imu/q", "takes accel_x from 'imu/q', found y deep"),
        ("m", "say which column"),
        ("imu", "expected real numbers, found a struct"),
        ("z", "expected real numbers, found complex ones"),
        ("t/x", "found no struct"),
        ("name", "expected"),
    ):
        with pytest.raises(ReadError, match=message):
            il.read(path, layout(LAYOUT.format(t="t", x=x, y="x")))
    with pytest.raises(
        ReadError, match=r"variables found: t \(1 x 1000\), x \(1000 x 1\), m \(1000 x 2\), imu/y "
    ) as met:
        il.read(path)
    assert "imu/deep/y (1 x 1000), name (1 x 4)" in str(met.value)


def test_a_layout_can_give_the_sample_rate(tmp_path, truth, layout):
    text = 'sample_rate = { value = 50, unit = "Hz" }\n[columns]\naccel_x = { from = "x", unit = "g" }\n'
    polars.DataFrame(truth).write_parquet(tmp_path / "a.parquet")
    scipy.io.savemat(tmp_path / "a.mat", truth)
    for name in ("a.parquet", "a.mat"):
        recording = il.read(tmp_path / name, layout(text))
        np.testing.assert_array_equal(recording.time, np.arange(ROWS) / 50)


# --- which reader --------------------------------------------------------------------------------------------------


def test_content_decides_and_a_delimiter_means_text(tmp_path, layout):
    before = native(5)
    il.write(before, tmp_path / "a.parquet")
    shutil.copy(tmp_path / "a.parquet", tmp_path / "b.csv")
    same(il.read(tmp_path / "b.csv"), before)
    (tmp_path / "c.mat").write_text("0 1.5\n1 2.5\n")
    text = layout(
        'delimiter = "whitespace"\n[columns]\ntime = { from = 0, unit = "s" }\nfog = { from = 1, unit = "V" }\n'
    )
    assert il.read(tmp_path / "c.mat", text).column("fog").tolist() == [1.5, 2.5]
    with pytest.raises(ReadError, match="expected text, found binary data"):
        il.read(tmp_path / "a.parquet", text)


def test_what_a_kind_of_file_does_not_have_cannot_be_chosen(tmp_path):
    il.write(native(5), tmp_path / "a.parquet")
    il.write(native(5), tmp_path / "a.csv")
    for name in ("a.parquet", "a.csv"):
        with pytest.raises(OptionError, match=r"has no topics to choose from; leave out the topic '/imu'"):
            il.read(tmp_path / name, topic="/imu")
        with pytest.raises(OptionError, match="has no instances"):
            il.read(tmp_path / name, instance=0)


def test_a_window_keeps_row_numbers(tmp_path):
    before = native(1000)
    for name in ("a.csv", "a.parquet"):
        il.write(before, tmp_path / name)
        recording = il.read(tmp_path / name, window=(10.0, 20.0))
        there = (before.time >= 10) & (before.time <= 20)
        np.testing.assert_array_equal(recording.column("gyro_1"), before.column("gyro_1")[there])
        assert recording.first_row == np.argmax(there) + 1
        assert recording.source.sha256 == hashlib.sha256((tmp_path / name).read_bytes()).hexdigest()
        assert len(il.read(tmp_path / name, window=(None, 1.0))) == 8
        with pytest.raises(OptionError, match=r"nothing in the window 500 to inf s; .* from 0 to 142\.714 s"):
            il.read(tmp_path / name, window=(500.0, None))
    with pytest.raises(OptionError, match="expected a start before its end"):
        il.read(tmp_path / "a.csv", window=(2.0, 1.0))


@pytest.mark.parametrize("kind", [kind for kind in FORMATS if kind.extra], ids=lambda kind: kind.name)
def test_a_missing_library_is_named_with_its_extra(tmp_path, monkeypatch, truth, layout, kind):
    text = layout(LAYOUT.format(t="t", x="x", y="y"))
    if kind.module == "parquet":
        path = tmp_path / "a.parquet"
        polars.DataFrame(truth).write_parquet(path)
    elif kind.module == "hdf5":
        path = tmp_path / "a.h5"
        with h5py.File(path, "w") as file:
            file["t"] = truth["t"]
    else:
        return  # lz4 is needed for compressed chunks only; tested with the bags
    monkeypatch.setitem(sys.modules, kind.library, None)
    install = rf"pip install '\.\[{kind.extra}\]'"
    with pytest.raises(ReadError, match=f"needs {kind.library}, which is not here: {install}"):
        il.read(path, text)
    if kind.writes:
        with pytest.raises(OptionError, match=install):
            il.write(native(3), tmp_path / "b.parquet")


# --- damage --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["parquet", "h5", "mat", "mat73"])
def test_every_cut_and_damage_is_refused_in_one_line_or_read(tmp_path, truth, layout, kind, reduced):
    trials = 20 if reduced else 60
    text = layout(LAYOUT.format(t="t", x="x", y="y"))
    path = tmp_path / f"a.{kind}"
    if kind == "parquet":
        polars.DataFrame(truth).write_parquet(path)
    elif kind == "h5":
        with h5py.File(path, "w") as file:
            for name, values in truth.items():
                file[name] = values
    elif kind == "mat":
        scipy.io.savemat(path, truth)
    else:
        with h5py.File(path, "w", userblock_size=512) as file:
            for name, values in truth.items():
                file[name] = values[None, :]
        path.write_bytes(b"MATLAB 7.3 MAT-file" + path.read_bytes()[19:])
    whole = path.read_bytes()
    for size in (0, 3, 20, 130, 520, len(whole) // 2, len(whole) - 600, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(ImulabError) as error:
            il.read(path, text)
        assert "\n" not in str(error.value)
        assert path.name in str(error.value)
    rng = np.random.default_rng(3)
    for _ in range(trials):
        data = bytearray(whole)
        for place in rng.integers(0, len(data), 8):
            data[place] = rng.integers(256)
        path.write_bytes(bytes(data))
        with contextlib.suppress(ImulabError):
            il.read(path, text)


# --- command line --------------------------------------------------------------------------------------------------


def test_convert_keeps_everything_both_ways(tmp_path, imulab):
    before = native(200)
    il.write(before, tmp_path / "a.csv")
    for source, target in (("a.csv", "b.parquet"), ("b.parquet", "c.csv")):
        done = imulab("convert", source, "-o", target)
        assert (done.returncode, done.stderr, done.stdout) == (0, "", "")
    same(il.read(tmp_path / "c.csv"), before)
    assert (tmp_path / "c.csv").read_bytes() == (tmp_path / "a.csv").read_bytes()
    assert imulab("convert", "b.parquet").stdout == (tmp_path / "a.csv").read_text()
    part = imulab("convert", "a.csv", "--window", "1:2")
    assert part.stdout.count("\n") == 3 + 8


def test_show_says_what_is_inside(tmp_path, imulab):
    before = native(200)
    time = before.columns["time"].copy()
    time[100:] += 5
    il.write(before.with_columns({"time": time}, {}), tmp_path / "a.parquet")
    shown = imulab("show", "a.parquet").stdout
    for fragment in (
        "a.parquet: 200 samples",
        "duration 33.4286 s",
        "rate 7 Hz",
        "gaps 1 (the widest 5.14286 s)",
        "deg/h",
    ):
        assert fragment in shown
    formats = imulab("show", "--formats").stdout
    for kind in FORMATS:
        assert kind.name in formats


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        (["convert", "a.csv", "-o", "b.xlsx"], ["b.xlsx", ".csv or .parquet"]),
        (["convert", "a.csv", "-o", "a.csv"], ["would overwrite"]),
        (["convert", "missing.bag", "-o", "b.csv"], ["missing.bag: no such file"]),
        (["convert", "a.csv", "-o", "b.csv", "--window", "x"], ["--window 'x'", "FROM:TO"]),
        (["convert", "a.csv", "-o", "b.csv", "--window", "5:4"], ["start before its end"]),
        (["convert", "a.csv", "-o", "b.csv", "--instance", "x"], ["--instance 'x'"]),
        (["convert", "a.csv", "-o", "b.csv", "--topic", "/imu"], ["no topics"]),
        (["convert", "."], ["folder that is no ROS 2 bag"]),
        (["show"], ["--formats"]),
    ],
)
def test_a_wrong_convert_gets_one_line(tmp_path, imulab, arguments, fragments):
    il.write(native(10), tmp_path / "a.csv")
    done = imulab(*arguments)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    for fragment in fragments:
        assert fragment in done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["a.csv"]


def test_head_comments_pass_through_parquet_whatever_their_names(tmp_path, imulab):
    comments = {"geodetic_height": "520 m", "geo": "site B", "pandas_version": "3", "huggingface": "x", "a": "b: c"}
    (tmp_path / "a.csv").write_text(
        "".join(f"# {key}: {value}\n" for key, value in comments.items()) + "time [s],accel_x [g]\n0,1\n1,2\n"
    )
    assert imulab("convert", "a.csv", "-o", "a.parquet").returncode == 0
    assert il.read(tmp_path / "a.parquet").metadata == comments


def test_what_other_writers_keep_in_parquet_metadata_is_left_out(tmp_path):
    table = pa.table({"time [s]": [0.0, 1.0], "accel_x [g]": [1.0, 2.0]})
    theirs = {"pandas": '{"index_columns": []}', "geo": '{"version": "1.0"}', "org.apache.spark.version": "3.5"}
    pq.write_table(table.replace_schema_metadata({**theirs, "serial": "S1"}), tmp_path / "a.parquet")
    assert il.read(tmp_path / "a.parquet").metadata == {"serial": "S1"}


def test_show_states_the_duration_of_a_single_sample(tmp_path, imulab):
    (tmp_path / "a.csv").write_text("time [s],accel_x [g]\n5,1\n")
    assert "duration 0 s" in imulab("show", "a.csv").stdout


def test_show_says_where_time_runs_backwards(tmp_path, imulab):
    (tmp_path / "a.csv").write_text("time [s],accel_x [g]\n0,1\n1,1\n2,1\n1.5,1\n2.5,1\n")
    (tmp_path / "b.csv").write_text("time [s],accel_x [g]\n0,1\n1,1\n2,1\n")
    assert "time runs backwards once" in imulab("show", "a.csv").stdout
    assert "backwards" not in imulab("show", "b.csv").stdout

"""Recordings to native CSV that reads back exactly."""

import io

import numpy as np
import polars
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imulab.errors import ImulabError, OptionError
from imulab.readers import read
from imulab.readers.text import TextFile
from imulab.recording import Recording
from imulab.writers import write_csv, write_csv_to

FIXED = settings(derandomize=True, database=None, deadline=None, max_examples=150)
UNITS = {"time": "s", "accel_x": "m/s^2", "gyro_1": "deg/h", "temperature": "degC", "pressure": "1", "rate": "rad/s"}


def written(recording) -> bytes:
    stream = io.BytesIO()
    write_csv_to(recording, stream)
    return stream.getvalue()


def reread(data: bytes) -> Recording:
    (block,) = TextFile(io.BytesIO(data), "written", None).blocks()
    return block


def make(rows: int, **changes) -> Recording:
    rng = np.random.default_rng(rows)
    columns = {name: rng.standard_normal(rows) * 10.0 ** rng.integers(-9, 9, rows) for name in UNITS}
    return Recording(**{"columns": columns, "units": UNITS, "metadata": {"serial": "SN 42"}, **changes})


def same(after: Recording, before: Recording) -> None:
    assert list(after.columns) == list(before.columns)
    assert {name: after.units[name] for name in after.columns} == {n: before.units[n] for n in before.columns}
    for name, column in before.columns.items():
        # repr tells every double from every other, the sign of zero included, and takes all NaN as one.
        assert [repr(x) for x in after.column(name).tolist()] == [repr(x) for x in column.tolist()]


@pytest.mark.slow
@FIXED
@given(st.lists(st.tuples(*[st.floats()] * len(UNITS)), min_size=1, max_size=20))
def test_every_number_reads_back_exactly(rows):
    columns = {name: np.array(values) for name, values in zip(UNITS, zip(*rows, strict=True), strict=True)}
    before = Recording(columns, UNITS)
    same(reread(written(before)), before)


HEADS = st.text(st.characters(exclude_categories=["C", "Z"], exclude_characters=":#"), min_size=1, max_size=8)


@FIXED
@given(st.dictionaries(HEADS, HEADS | st.just(""), max_size=3))
def test_metadata_reads_back(metadata):
    assert dict(reread(written(make(1, metadata=metadata))).metadata) == metadata


def test_the_file_is_comments_titles_and_rows():
    before = Recording(
        {"time": np.array([0.0, 0.01]), "accel_x": np.array([-0.0, np.nan]), "pressure": np.array([1e22, np.inf])},
        {"time": "s", "accel_x": "m/s^2", "pressure": "1"},
        metadata={"serial": "SN 42", "place": "Ålesund: hall 3"},
    )
    assert written(before).decode() == (
        "# serial: SN 42\n# place: Ålesund: hall 3\ntime [s],accel_x [m/s^2],pressure\n0.0,-0.0,1e+22\n0.01,nan,inf\n"
    )


def test_another_reader_finds_the_same_numbers(tmp_path):
    before = make(500)
    write_csv(before, tmp_path / "out.csv")
    frame = polars.read_csv(tmp_path / "out.csv", comment_prefix="#", schema_overrides=[polars.Float64] * len(UNITS))
    assert frame.columns == [
        "time [s]",
        "accel_x [m/s^2]",
        "gyro_1 [deg/h]",
        "temperature [degC]",
        "pressure",
        "rate [rad/s]",
    ]
    for column, theirs in zip(before.columns.values(), frame.iter_columns(), strict=True):
        assert theirs.to_numpy().tobytes() == column.tobytes()


@pytest.mark.parametrize("size", [1, 3, 100, 1000])
def test_blocks_make_the_file_of_the_whole(size):
    whole = make(300)
    blocks = [
        Recording({name: column[start : start + size] for name, column in whole.columns.items()}, UNITS, whole.metadata)
        for start in range(0, 300, size)
    ]
    assert written(iter(blocks)) == written(whole)


def test_more_rows_than_are_formed_at_once_are_all_written(monkeypatch):
    before = make(100)
    whole = written(before)
    assert whole.count(b"\n") == 102
    monkeypatch.setattr("imulab.writers._ROWS_AT_ONCE", 7)
    assert written(before) == whole


def test_titles_stand_above_their_own_columns_whatever_the_order_of_the_units():
    before = Recording({"accel_x": np.array([1.0, 2.0]), "time": np.array([0.0, 1.0])}, {"time": "s", "accel_x": "g"})
    same(reread(written(before)), before)


def test_a_column_without_a_unit_is_written_with_its_title():
    before = Recording({"time": np.array([0.0, 1.0]), "pressure": np.array([5.0, 6.0])}, {"time": "s"})
    after = reread(written(before))
    assert {name: column.tolist() for name, column in after.columns.items()} == {"time": [0, 1], "pressure": [5, 6]}


@pytest.mark.parametrize(
    "change",
    [
        {"metadata": {"note": "first line\nsecond line"}},
        {"metadata": {"note": "x\r\n0,1,2,3,4,5"}},
        {"columns": {"a,b": np.ones(2)}, "units": {"a,b": "1"}},
        {"columns": {"a\nb": np.ones(2)}, "units": {"a\nb": "1"}},
    ],
)
def test_text_that_would_break_the_file_is_refused_or_made_to_fit(change):
    try:
        before = make(2, **change)
        data = written(before)
    except ImulabError:
        return
    after = reread(data)
    assert len(after.columns) == len(before.columns)
    for mine, theirs in zip(after.columns.values(), before.columns.values(), strict=True):
        assert mine.tolist() == theirs.tolist()


def test_a_written_file_is_read_with_its_hash_and_name(tmp_path):
    path = tmp_path / "out.CSV"
    before = make(50)
    write_csv(before, path)
    after = read(path)
    same(after, before)
    assert dict(after.metadata) == {"serial": "SN 42"}
    assert path.read_bytes() == written(before)


@pytest.mark.parametrize("name", ["out.xlsx", "out", "out.csv.gz"])
def test_another_kind_of_file_is_refused(tmp_path, name):
    with pytest.raises(OptionError, match=r"out.*: cannot write this kind of file; expected a name that ends in \.csv"):
        write_csv(make(1), tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_failure_half_way_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "out.csv"
    path.write_bytes(b"old")

    def blocks():
        yield make(10)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        write_csv(blocks(), path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]

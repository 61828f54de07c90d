"""Recordings: columns with units, what may be in them, and how messages name the place."""

import mmap
import sys
from datetime import datetime, timedelta

import numpy as np
import polars
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imulab.columns import parse_column_title
from imulab.errors import DataError, UnitError
from imulab.recording import Recording, check_finite, check_time, release

# The vocabulary of native files and the quantities that its columns may hold.
ALLOWED = {
    "time": ["s", "ms", "us"],
    "accel_x": ["m/s^2", "g", "mg", "count", "V"],
    "std_accel_z": ["m/s^2", "g", "mg", "count", "V"],
    "truth_accel_y": ["m/s^2", "g", "mg"],
    "gyro_1": ["rad/s", "deg/s", "deg/h", "count", "V"],
    "gyro_x_12": ["rad/s", "deg/s", "deg/h", "count", "V"],
    "truth_gyro_z": ["rad/s", "deg/s"],
    "dtg_x": ["rad/s", "deg/h", "count", "V"],
    "fog": ["deg/s", "count", "V"],
    "temperature": ["degC", "K", "count", "V"],
    "table_angle": ["rad", "deg", "count"],
}
WRONG = {
    "time": ["count", "Hz", "g"],
    "accel_x": ["deg/s", "s", "m", "rad"],
    "std_accel_z": ["deg/s", "ppm"],
    "truth_accel_y": ["rad"],
    "gyro_1": ["m/s^2", "deg"],
    "gyro_x_12": ["g", "degC"],
    "truth_gyro_z": ["m/s^2"],
    "dtg_x": ["deg", "count/(deg/s)"],
    "fog": ["s"],
    "temperature": ["s", "g"],
    "table_angle": ["deg/s", "m"],
}


def make(name="unit 7.csv", lines_before=1, first_row=1, units=None, **columns):
    defaults = {"time": "s", "accel_x": "g", "accel_y": "g", "accel_z": "g"}
    known = {key: (units or {}).get(key, defaults.get(key, "1")) for key in columns}
    arrays = {key: np.asarray(values, dtype=float) for key, values in columns.items()}
    return Recording(arrays, known, name=name, lines_before=lines_before, first_row=first_row)


def test_a_column_takes_every_unit_of_its_quantity():
    for name, unit in [(name, unit) for name, units in ALLOWED.items() for unit in units]:
        assert parse_column_title(f"{name} [{unit}]", "f") == (name, unit)
        assert Recording({name: np.zeros(2)}, {name: unit}).units[name] == unit, name


def test_a_column_with_a_unit_of_another_quantity_is_refused():
    for name, unit in [(name, unit) for name, units in WRONG.items() for unit in units]:
        with pytest.raises(UnitError) as caught:
            Recording({name: np.zeros(2)}, {name: unit}, name="unit 7.csv")
        message = str(caught.value)
        assert message.startswith(f"unit 7.csv: column {name}: expected a unit of "), unit
        assert f"found {unit!r}" in message


@pytest.mark.parametrize("name", list(ALLOWED))
def test_a_column_of_the_vocabulary_needs_a_unit(name):
    with pytest.raises(UnitError, match=f"unit 7.csv: column {name}: expected a unit of .* found ''"):
        Recording({name: np.zeros(2)}, {}, name="unit 7.csv")
    with pytest.raises(UnitError) as caught:
        parse_column_title(name, "unit 7.csv")
    assert f"unit 7.csv: column {name} has no unit; expected a title such as '{name} [" in str(caught.value)
    # The title that the message suggests is one.
    suggested = str(caught.value).split("such as '")[1].partition("'")[0]
    assert parse_column_title(suggested, "f")[0] == name


def test_other_columns_may_have_any_unit_or_none():
    assert parse_column_title("pressure", "f") == ("pressure", "1")
    assert parse_column_title("timeout [deg/h]", "f") == ("timeout", "deg/h")
    assert parse_column_title(' "accel_x [m/s²]" ', "f") == ("accel_x", "m/s^2")
    assert parse_column_title("gyro_y [ °/s ] ", "f") == ("gyro_y", "deg/s")


@pytest.mark.parametrize(
    ("title", "content"),
    [
        ("accel_x [g", "column title 'accel_x [g': expected 'name [unit]'"),
        ("accel_x [g] raw", "column title 'accel_x [g] raw': expected 'name [unit]'"),
        ("accel_x [gee]", "column accel_x: unknown unit 'gee'; known units: m/s^2 g mg ug count"),
        ("accel_x []", "column accel_x: unknown unit ''"),
    ],
)
def test_a_title_that_is_none_is_refused(title, content):
    with pytest.raises(UnitError) as caught:
        parse_column_title(title, "unit 7.csv")
    assert str(caught.value).startswith("unit 7.csv: ")
    assert content in str(caught.value)


def test_columns_of_different_length_are_refused():
    with pytest.raises(DataError, match=r"unit 7.csv: columns of different length: \[2, 3\]"):
        make(time=[0, 1, 2], accel_x=[0, 1])


def test_samples_are_as_read_and_si_is_derived():
    recording = make(time=[0, 10, 20], accel_x=[1, -2, 0.5], units={"time": "ms", "accel_x": "mg"})
    assert recording.column("accel_x").tolist() == [1, -2, 0.5]
    np.testing.assert_allclose(recording.si("accel_x"), [9.80665e-3, -19.6133e-3, 4.903325e-3], rtol=1e-15)
    np.testing.assert_allclose(recording.time, [0, 0.01, 0.02], rtol=1e-15)
    assert make(accel_x=[1]).time is None
    assert len(recording) == 3
    assert len(Recording({}, {})) == 0
    assert "accel_x" in recording
    assert "accel_y" not in recording


def test_a_missing_column_is_refused_with_those_that_are_there():
    with pytest.raises(DataError, match="no column accel_z; found time accel_x"):
        make(time=[0], accel_x=[1]).column("accel_z")
    with pytest.raises(DataError, match="no column accel_y; found accel_x"):
        make(accel_x=[1]).triad("accel")
    with pytest.raises(DataError, match="no column accel_y"):
        make(accel_x=[1]).triad_unit("accel")


def test_a_triad_is_its_three_columns_side_by_side_in_one_unit():
    recording = make(accel_z=[5, 6], accel_x=[1, 2], accel_y=[3, 4], units={"accel_x": "mg", "accel_y": "mg"})
    assert recording.triad("accel").tolist() == [[1, 3, 5], [2, 4, 6]]
    with pytest.raises(UnitError) as caught:
        recording.triad_unit("accel")
    assert "unit 7.csv: the axes of a triad must share one unit" in str(caught.value)
    assert "accel_x [mg], accel_y [mg], accel_z [g]; if a title is wrong, --unit accel=UNIT" in str(caught.value)


def test_spellings_of_one_unit_are_one_unit():
    units = {"accel_x": "m/s^2", "accel_y": "m/s²", "accel_z": "m/s2"}
    assert make(accel_x=[1], accel_y=[1], accel_z=[1], units=units).triad_unit("accel") == "m/s^2"


def test_replaced_columns_keep_their_place_and_new_ones_follow():
    before = make(time=[0, 1], accel_x=[1, 2], pressure=[3, 4])
    after = before.with_columns({"accel_x": np.array([9.0, 8.0]), "gyro_x": np.zeros(2)}, {"gyro_x": "deg/s"})
    assert list(after.columns) == list(after.units) == ["time", "accel_x", "pressure", "gyro_x"]
    assert after.column("accel_x").tolist() == [9, 8]
    assert before.column("accel_x").tolist() == [1, 2]
    assert after.column("pressure") is before.column("pressure")
    assert (after.name, after.lines_before) == (before.name, before.lines_before)


def test_places_count_rows_from_one_and_lines_with_the_head():
    assert make(time=[0], lines_before=1).place(49) == "row 50 (line 51)"
    assert make(time=[0], lines_before=7, first_row=1000).place(2) == "row 1002 (line 1009)"
    assert make(time=[0], lines_before=None).place(np.int64(0)) == "row 1"


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_named_and_counted(bad):
    values = np.zeros(60)
    values[[49, 52]] = bad, np.nan
    recording = make(accel_x=np.zeros(60), accel_y=values)
    check_finite(recording, ["accel_x"])
    with pytest.raises(DataError) as caught:
        check_finite(recording, ["accel_x", "accel_y"])
    found = f"row 50 (line 51), column accel_y: expected a finite number, found {bad}"
    assert f"unit 7.csv: {found} (and 1 more)" == str(caught.value)
    with pytest.raises(DataError, match=r"column accel_y.*nan$"):
        check_finite(make(accel_y=[0, np.nan]), ["accel_y"])


@pytest.mark.parametrize(
    ("times", "verb", "expected", "found"),
    [
        ([0, 10, 20, 20, 30], "stands still", "20 ms", "20 ms"),
        ([0, 10, 20, 15, 30], "runs backwards", "20 ms", "15 ms"),
    ],
)
def test_time_that_does_not_rise_is_refused_in_the_unit_of_the_file(times, verb, expected, found):
    with pytest.raises(DataError) as caught:
        check_time(make(time=times, units={"time": "ms"}))
    message = str(caught.value)
    assert message.startswith(f"unit 7.csv: row 4 (line 5), column time: time {verb}")
    assert f"expected more than {expected}, found {found}" in message


def test_time_that_is_missing_somewhere_is_refused_as_not_finite():
    with pytest.raises(DataError, match=r"row 2 \(line 3\), column time: expected a finite number, found nan"):
        check_time(make(time=[0, np.nan, 2]))


def test_a_time_of_day_that_runs_back_is_shown_with_the_digits_that_differ():
    with pytest.raises(DataError) as caught:
        check_time(make(time=[1700000000.00, 1700000000.02, 1700000000.01]))
    assert "expected more than 1700000000.02 s, found 1700000000.01 s" in str(caught.value)


def test_rising_time_is_returned_in_seconds():
    assert check_time(make(time=[-1, 0, 5], units={"time": "s"})).tolist() == [-1, 0, 5]


@pytest.mark.parametrize(
    ("values", "unit", "metadata", "expected"),
    [
        ([20.0, np.nan, 22.0], "degC", {}, 21.0),
        ([293.15, 295.15, 297.15], "K", {"temperature": "5"}, 22.0),
        ([295.15, np.inf], "K", {}, 22.0),
        ([1, 2, 3], "count", {"temperature": "23.5 degC"}, 23.5),  # the column cannot tell, the head can
        ([np.nan], "degC", {"temperature": "23.5"}, 23.5),
        ([np.nan], "degC", {}, None),
        ([2048], "count", {}, None),
        (None, None, {"power_on_temperature": "-10"}, -10.0),
        (None, None, {"power_on_temperature": "-10", "temperature": "296.65 K"}, 23.5),
        (None, None, {"temperature": "warm", "power_on_temperature": "4 °C"}, 4.0),
        (None, None, {"temperature": "nan"}, None),
        (None, None, {"temperature": "2048 count"}, None),
        (None, None, {}, None),
    ],
)
def test_the_temperature_is_the_mean_of_the_column_or_else_that_of_the_head(values, unit, metadata, expected):
    columns = {} if values is None else {"temperature": np.array(values, dtype=float)}
    found = Recording(columns, {"temperature": unit} if columns else {}, metadata).mean_temperature()
    assert found is None if expected is None else found == pytest.approx(expected, abs=1e-12)


def test_a_polars_frame_becomes_a_recording():
    frame = polars.DataFrame({"time [ms]": [0, 1], "accel_x [m/s²]": [1.5, None], "pressure": [7.0, 8.0]})
    recording = Recording.from_frame(frame, name="frame 3")
    assert dict(recording.units) == {"time": "ms", "accel_x": "m/s^2", "pressure": "1"}
    assert all(column.dtype == np.float64 for column in recording.columns.values())
    np.testing.assert_array_equal(recording.column("accel_x"), [1.5, np.nan])
    with pytest.raises(UnitError, match="frame 3: column accel_x has no unit"):
        Recording.from_frame(frame.rename({"accel_x [m/s²]": "accel_x"}), name="frame 3")


@settings(derandomize=True, database=None, deadline=None, max_examples=30)
@given(values=st.lists(st.floats(allow_nan=False), min_size=1, max_size=20))
def test_a_frame_and_back_is_the_same_recording(values):
    before = make(time=np.arange(len(values)), accel_x=values, pressure=values)
    for library in ("pandas", "polars"):
        after = Recording.from_frame(before.to_frame(library))
        assert list(after.columns) == list(before.columns)
        assert dict(after.units) == dict(before.units)
        for name, column in before.columns.items():
            assert after.column(name).tobytes() == column.tobytes()


def test_a_frame_that_names_a_column_twice_is_refused():
    frame = polars.DataFrame({"time [s]": [0.0, 1.0], "time [ms]": [0.0, 1.0]})
    with pytest.raises(DataError, match="frame: column time appears twice"):
        Recording.from_frame(frame)


@pytest.mark.parametrize("values", [["a", "b"], [datetime(2026, 1, 1)], [timedelta(seconds=1)]])
def test_a_frame_whose_column_holds_no_numbers_is_refused(values):
    with pytest.raises(DataError, match="column time"):
        Recording.from_frame(polars.DataFrame({"time [s]": values}))


def test_frames_without_their_library_say_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "polars", None)
    with pytest.raises(DataError, match="needs polars, which is not installed: pip install polars"):
        make(time=[0]).to_frame("polars")
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(DataError, match="needs pandas or polars, which is not installed: pip install pandas"):
        make(time=[0]).to_frame()


@pytest.mark.skipif(not hasattr(mmap, "MADV_DONTNEED"), reason="memory is not given back here")
def test_the_callers_map_keeps_its_changes(tmp_path):
    np.arange(8192.0).tofile(tmp_path / "x.bin")
    mine = np.memmap(tmp_path / "x.bin", np.float64, "c")
    mine *= 2
    release(mine)
    np.testing.assert_array_equal(mine, 2 * np.arange(8192.0))

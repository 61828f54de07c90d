"""Odd data that people have: what comes out is right, or one sentence says what was expected."""

import datetime
import io
from pathlib import Path

import numpy as np
import pandas as pd
import polars as pl
import pytest

import imulab as il

G = 9.81
HOW = {"order": 1, "gravity": G}
READ = {"rate": 100.0, "unit": "m/s^2"}
DATES = {"periods": 4600, "freq": "10ms"}


class Arraylike:
    """What is no array, but says what it holds as one."""

    def __init__(self, values):
        self.values = values

    def __array__(self, dtype=None, copy=None):
        return self.values


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """A recording as what people make of it, and its fit."""
    made = il.simulate_tumble(attitudes=12, order=1, hold="2 s", gravity=G)
    path = tmp_path_factory.mktemp("odd") / "rec.csv"
    il.write(made, path)
    assert len(made) == 4600
    frame, accel = made.to_frame(), made.triad("accel")
    masked = np.ma.masked_array(accel.copy(), mask=np.zeros_like(accel, dtype=bool))
    masked[100:110] = np.ma.masked
    masked.data[100:110] = 1e6
    read_only = accel.copy()
    read_only.flags.writeable = False
    names = {"frame": frame, "timeless": frame.drop(columns="time [s]"), "a": accel, "masked": masked, "path": path}
    names |= {"polars": made.to_frame("polars"), "read_only": read_only}
    return names, il.fit_tumble(made, **HOW).calibration


def by_index(given, index):
    """The frame without its column of times, which the index holds instead."""
    made = given["timeless"].copy()
    made.index = index
    return made


def two_levels(given, *above):
    return pd.DataFrame(given["a"], columns=pd.MultiIndex.from_product([*above, list("xyz")]))


RIGHT = {
    "of the other byte order": lambda g: (g["a"].astype(">f8"), READ),
    "of Python's numbers": lambda g: (g["a"].astype(object), READ),
    "a frame of Python's numbers": lambda g: (g["frame"].astype(object), {}),
    "nullable numbers": lambda g: (g["frame"].astype("Float64"), {}),
    "numbers of Arrow": lambda g: (g["frame"].astype("float64[pyarrow]"), {}),
    "by columns in memory": lambda g: (np.asfortranarray(g["a"]), READ),
    "every second row": lambda g: (np.repeat(g["a"], 2, 0)[::2], READ),
    "read-only": lambda g: (g["read_only"], READ),
    "masked, nothing left out": lambda g: (np.ma.masked_array(g["a"]), READ),
    "lists of lists": lambda g: (g["a"].tolist(), READ),
    "tuples": lambda g: (tuple(map(tuple, g["a"].tolist())), READ),
    "like an array": lambda g: (Arraylike(g["a"]), READ),
    "lists by name": lambda g: ({"accel": g["a"].tolist()}, READ),
    "series by name": lambda g: ({f"accel_{n[6]}": g["frame"][n] for n in g["frame"] if n[:2] == "ac"}, READ),
    "a path": lambda g: (g["path"], {}),
    "a column of texts": lambda g: (g["frame"].assign(run="a"), {}),
    "texts of polars": lambda g: (g["polars"].with_columns(pl.lit("a").alias("run")), {}),
    "a category": lambda g: (g["frame"].assign(run=pd.Categorical(["a"] * 4600)), {}),
    "a category of polars": lambda g: (g["polars"].with_columns(pl.lit("a").cast(pl.Categorical).alias("run")), {}),
    "a text": lambda g: (str(g["path"]), {}),
    "dates of a time zone": lambda g: (by_index(g, pd.date_range("2026-1-1", tz="Europe/Berlin", **DATES)), {}),
    "durations": lambda g: (by_index(g, pd.timedelta_range(0, **DATES)), {}),
    "an index that is named": lambda g: (by_index(g, pd.Index(g["frame"]["time [s]"], name="time [s]")), {}),
    "a column of durations": lambda g: (g["timeless"].assign(time=pd.timedelta_range(0, **DATES)), {}),
    "Python's dates": lambda g: (
        g["timeless"].assign(time=pd.Series(list(pd.date_range("2026", **DATES).to_pydatetime()), dtype=object)), {}
    ),
    "dates of polars": lambda g: (
        g["polars"].drop("time [s]").with_columns(pl.Series("time", pd.date_range("2026", tz="UTC", **DATES))), {}
    ),
    "durations of polars": lambda g: (
        g["polars"].drop("time [s]").with_columns(pl.Series("time", pd.timedelta_range(0, **DATES))), {}
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", RIGHT)
def test_odd_data_of_the_same_numbers_give_the_same_fit(what, given):
    names, expected = given
    data, reading = RIGHT[what](names)
    found = il.fit_tumble(data, **HOW, **reading).calibration
    for name, parameter in expected.parameters.items():
        assert found.value(name) == pytest.approx(parameter.value, rel=1e-9), name


NUMBERS = "expected numbers, found texts"
FILE = "data: expected a file name, a Recording, a data frame of pandas or polars, or arrays, found"
RATE = "rate {}: expected a number of samples per second, such as 100.0"
LINES = {
    "complex": (lambda g: (g["a"].astype(complex), READ), "expected an array of numbers"),
    "a clock that froze": (
        lambda g: (g["frame"].assign(**{"time [s]": g["frame"].iloc[:, 0].clip(upper=20)}), {}),
        "time stands still for",
    ),
    "a text among numbers": (
        lambda g: (g["frame"].astype(object).replace({g["frame"].iloc[5, 1]: "x"}), {}),
        f"column accel_x [m/s^2]: {NUMBERS}",
    ),
    "a column twice": (
        lambda g: (pd.concat([g["frame"], g["frame"].iloc[:, 1:2]], axis=1), {}),
        "column accel_x [m/s^2] appears twice",
    ),
    "lists in a column": (lambda g: (pl.DataFrame({"accel [g]": [[1.0, 2.0, 3.0]] * 4}), {}), "column accel [g]: "),
    "arrays in a column": (
        lambda g: (pl.DataFrame({"accel [g]": pl.Series([[1.0, 2, 3]] * 4, dtype=pl.Array(pl.Float64, 3))}), {}),
        "column accel [g]: expected a number in each row, found (3,) of them",
    ),
    "three levels": (lambda g: (two_levels(g, ["imu"], ["accel"]), {"unit": "g"}), "found imu_accel_x"),
    "columns by number": (lambda g: (pd.DataFrame(g["a"]), READ), "unit 'm/s^2': expected that of a column"),
    "periods": (lambda g: (by_index(g, pd.period_range("2026", periods=4600, freq="s")), {}), "the index holds period"),
    "an index without a name": (lambda g: (by_index(g, pd.Index(g["frame"]["time [s]"].array)), {}), "index holds flo"),
    "an index without a unit": (
        lambda g: (by_index(g, pd.Index(np.arange(4600.0), name="time")), {}),
        "column time has no unit; expected a title such as 'time [s]'",
    ),
    "a date that is missing": (
        lambda g: (g["timeless"].assign(time=[pd.NaT, *pd.timedelta_range(0, periods=4599, freq="10ms")]), {}),
        "row 1, column time: expected a finite number, found nan",
    ),
    "dates as texts": (
        lambda g: (g["timeless"].assign(time=pd.date_range("2026", **DATES).astype(str)), {}), f"column time: {NUMBERS}"
    ),
    "a frame that is not there yet": (lambda g: (g["polars"].lazy(), {}), f"{FILE} a LazyFrame, which collect() makes"),
    "a series": (lambda g: (g["frame"].iloc[:, 1], {}), "found an array of shape (4600,)"),
    "no rows": (lambda g: (g["frame"].iloc[:0], {}), "frame: no samples"),
    "no rows of polars": (lambda g: (g["polars"].head(0), {}), "frame: no samples"),
    "no rows of an array": (lambda g: (g["a"][:0], {"unit": "g"}), "arrays: no samples"),
    "one row": (lambda g: (g["frame"].iloc[:1], {}), "frame: 1 sample over 0 s is too few"),
    "masked": (lambda g: (g["masked"], READ), "row 101, column accel_x: expected a finite number, found nan (and 9"),
    "transposed": (lambda g: (g["a"].T, READ), "expected an array of shape (n, 3), found (3, 4600) (transposed?)"),
    "two axes": (lambda g: (g["a"][:, :2], READ), "expected an array of shape (n, 3), found (4600, 2)"),
    "a number": (lambda g: (np.float64(3), READ), "found an array of shape ()"),
    "rate 0": (lambda g: (g["a"], {**READ, "rate": 0}), RATE.format(0)),
    "rate below 0": (lambda g: (g["a"], {**READ, "rate": -1.0}), RATE.format("-1.0")),
    "rate NaN": (lambda g: (g["a"], {**READ, "rate": np.nan}), "rate: expected a number, found nan"),
    "infinite rate": (lambda g: (g["a"], {**READ, "rate": np.inf}), RATE.format("inf")),
    "unit of another quantity": (
        lambda g: (g["a"], {**READ, "unit": "deg/s"}),
        "column accel_x has no unit; expected units={'accel': 'm/s^2'}; unit 'deg/s' is one of rate",
    ),
    "unknown unit": (
        lambda g: (g["frame"].rename(columns={"accel_x [m/s^2]": "accel_x [G]"}), {}),
        "column accel_x: unknown unit 'G'; known units: m/s^2 g mg ug count V mV A mA pulse/s; did you mean 'g'?",
    ),
    "bytes": (lambda g: (b"rec.csv", {}), f"{FILE} b'rec.csv'"),
    "an open file": (lambda g: (io.BytesIO(g["path"].read_bytes()), {}), f"{FILE} <_io.BytesIO"),
    "rows one by one": (lambda g: (iter(g["a"].tolist()), READ), f"{FILE} <list_iterator"),
    "a set": (lambda g: ({1, 2, 3}, READ), f"{FILE} {{1, 2, 3}}"),
    "nothing by name": (lambda g: ({}, READ), "expected data, found no columns"),
    "records": (lambda g: (g["frame"].to_records(), {}), "expected an array of numbers"),
    "a folder": (lambda g: (g["path"].parent, {}), "expected a file"),
    "times of another length": (lambda g: (g["a"], {"time": np.arange(4599), "unit": "g"}), "time has 4599"),
    "times in a column": (lambda g: (g["a"], {"time": np.arange(4600)[:, None], "unit": "g"}), "(n,), found (4600, 1)"),
    "times backwards": (lambda g: (g["a"], {"time": np.arange(4600)[::-1], "unit": "g"}), "time runs backwards"),
    "one date": (
        lambda g: (g["a"], {"time": [datetime.datetime(2026, 1, 1)] * 4600, "unit": "g"}), "time stands still"
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", LINES)
def test_odd_data_end_in_one_sentence(what, given):
    make, words = LINES[what]
    data, reading = make(given[0])
    with pytest.raises(il.ImulabError) as refused:
        il.fit_tumble(data, **HOW, **reading)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_what_is_missing_stays_missing():
    of = il.Recording.from_frame
    for column in (pd.array([1, None, 3], dtype="Int64"), pd.Series([1, None, 3], dtype=object)):
        np.testing.assert_array_equal(of(pd.DataFrame({"accel_x [g]": column})).column("accel_x"), [1, np.nan, 3])
    decimals = pl.DataFrame({"accel_x [g]": pl.Series([1, None, 3]).cast(pl.Decimal(10, 2))})
    np.testing.assert_array_equal(of(decimals).column("accel_x"), [1, np.nan, 3])
    levels = two_levels({"a": np.eye(3)}, ["accel"])
    np.testing.assert_array_equal(of(levels, unit="g").triad("accel"), np.eye(3))


def test_what_a_mask_leaves_out_is_in_no_result(given):
    names, record = given
    corrected = il.apply(record, names["masked"], **READ).triad("accel")
    assert np.isnan(corrected[100:110]).all()
    assert np.isfinite(corrected[:100]).all()
    with pytest.raises(il.ImulabError, match="expected finite samples"):
        il.allan_deviation(np.ma.masked_array(np.arange(9.0), mask=[1] + [0] * 8), 10.0)


@pytest.mark.parametrize("column", ["pandas", "polars", "list"])
def test_the_allan_deviation_takes_samples_of_every_library(column, given):
    samples = given[0]["a"][:, 0]
    one = {"pandas": pd.Series(samples), "polars": pl.Series(samples), "list": samples.tolist()}[column]
    expected = il.allan_deviation(samples, 100.0)
    np.testing.assert_array_equal(il.allan_deviation(one, 100.0).deviation, expected.deviation)


def test_a_file_is_named_by_a_path_or_a_text_and_by_nothing_else(given):
    path = given[0]["path"]
    assert len(il.read(Path(path))) == len(il.read(str(path)))
    with path.open("rb") as stream, pytest.raises(il.ImulabError, match="expected the name of a file, found <_io"):
        il.read(stream)

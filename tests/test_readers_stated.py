"""Columns as a person states them: what is known of each, and layouts that read back what was stated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.errors import OptionError, ReadError
from imulab.readers.stated import columns_of_table, layout_of_columns, table_of_file

NAMES = ["time", "accel_x", "accel_y", "accel_z", "gyro_x", "temperature"]
UNITS = ["ms", "g", "g", "g", "deg/s", "degC"]


def rows(separator: str, comma: bool = False) -> str:
    lines = [separator.join(f"{each:.2f}" for each in (10 * k, 0.1, 0.2, 1.0, k, 25.5)) for k in range(40)]
    return "\n".join(lines).replace(".", "," if comma else ".") + "\n"


@pytest.mark.parametrize(
    ("head", "separator", "comma"),
    [
        ("logger v3\n\nzeit;p;q;r;u;warm\n", ";", False),
        ("zeit;p;q;r;u;warm\n", ";", True),
        ("", " ", False),
        ("", "\t", False),
        ("# made by a logger\n", ",", False),
        ("zeit,p,q,r,u,warm\nms,g,g,g,deg/s,degC\n", ",", False),
        ("x,x,x,x,x,x\n", ",", False),
    ],
    ids=["preamble", "decimal comma", "blanks", "tabs", "comment", "units row", "one title"],
)
def test_a_layout_of_stated_columns_reads_them_back(tmp_path, head, separator, comma):
    file = tmp_path / "log.txt"
    file.write_text(head + rows(separator, comma))
    table = table_of_file(file)
    text = layout_of_columns(table, {k: (n, u) for k, (n, u) in enumerate(zip(NAMES, UNITS, strict=True))}, None, "log")
    (tmp_path / "L.toml").write_text(text)
    found = il.read(file, str(tmp_path / "L.toml"))
    assert found.units == dict(zip(NAMES, UNITS, strict=True))
    assert len(found) == 40
    np.testing.assert_allclose(found.columns["gyro_x"], np.arange(40))


def test_what_titles_and_readings_say_is_filled_in_and_the_rest_left_open(tmp_path):
    file = tmp_path / "log.csv"
    lines = [f"{10 * k},0.1,0.2,{1 + k % 3 / 100},{k % 5},2,3" for k in range(60)]
    file.write_text("\n".join(["t,Acc X,Acc Y,Acc Z,Gyro X,Gyro Y,Gyro Z", *lines]) + "\n")
    columns, supposed = columns_of_table(table_of_file(file), "log.csv")
    assert [each.column for each in columns] == [
        "time", "accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z",
    ]  # fmt: skip
    assert [each.unit for each in columns] == ["ms", "g", "g", "g", "", "", ""]
    assert "|f| is 1" in supposed


def test_a_clock_without_a_unit_has_that_of_its_steps(tmp_path):
    file = tmp_path / "log.csv"
    file.write_text("t;p;q\n" + "".join(f"{20 * k};0.1;0.2\n" for k in range(50)))
    columns, _ = columns_of_table(table_of_file(file), "log.csv")
    assert [(each.column, each.unit) for each in columns] == [("time", "ms"), ("", ""), ("", "")]


def test_a_rate_stands_for_the_time(tmp_path):
    file = tmp_path / "log.csv"
    file.write_text("a,b\n" + "1,2\n" * 30)
    table = table_of_file(file)
    with pytest.raises(OptionError, match="how many rows"):
        layout_of_columns(table, {0: ("fog", "deg/h")}, None, "log")
    (tmp_path / "L.toml").write_text(layout_of_columns(table, {0: ("fog", "deg/h")}, 50.0, "log"))
    assert il.read(file, str(tmp_path / "L.toml")).time[-1] == pytest.approx(29 / 50)


@pytest.mark.parametrize(("data", "said"), [(b"", "no rows"), (b"a,b\nx,y\n" * 9, "no rows"), (b"\0\1" * 99, "binary")])
def test_what_is_no_table_is_said(tmp_path, data, said):
    file = Path(tmp_path / "log.csv")
    file.write_bytes(data)
    with pytest.raises(ReadError, match=said):
        table_of_file(file)

"""The page that compares programs shows the figures that were measured, and says who was not there."""

import importlib.util
import json
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
BENCHMARKS = REPOSITORY / "benchmarks"


@pytest.fixture(scope="module")
def tables():
    spec = importlib.util.spec_from_file_location("comparison_tables", BENCHMARKS / "comparison_tables.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def measured():
    return json.loads((BENCHMARKS / "comparison.json").read_text(encoding="utf-8"))


def test_the_tables_of_the_page_are_those_of_the_measurements(tables, measured):
    page = (REPOSITORY / "docs" / "comparison.md").read_text(encoding="utf-8")
    assert page.count("<!-- made: ") == page.count("<!-- end -->") == 8
    assert tables.filled(page, measured) == page, "make compare writes both"


def test_every_program_was_there_for_the_committed_page(tables, measured):
    page = tables.filled((REPOSITORY / "docs" / "comparison.md").read_text(encoding="utf-8"), measured)
    assert not any(tables.ABSENT in line for line in page.splitlines() if line.startswith("|"))


def test_a_program_that_is_absent_is_said_to_be_not_measured(tables, measured):
    for part in ("quarter", "third"):
        for errors in measured[part].values():
            for name in [name for name in errors if name.startswith(("imu_tk", "imu-calib"))]:
                del errors[name]
    measured["processes"].pop("imu_tk")
    measured["fits"].pop("imu-calib-toolkit")
    for name in ("imucal", "imu-calib-toolkit", "misalignment"):
        measured["session"].pop(name)
    rows = tables.prediction(measured["quarter"], measured["processes"]).splitlines()
    assert [tables.ABSENT in row for row in rows] == [False] * 5 + [True] * 3
    rows = tables.session(measured["session"]).splitlines()
    assert [tables.ABSENT in row for row in rows] == [False] * 2 + [True] * 3 + [False]
    rows = tables.cost(measured).splitlines()
    assert [tables.ABSENT in row for row in rows] == [False] * 3 + [True, False, False, True]


def test_who_wins_is_decided_by_the_median_of_the_ratios(tables):
    errors = {name: {"imulab": [100.0, 100.0, 100.0, 100.0, 90.0]} for name in tables.RECORDINGS}
    cells = [[200.0, 100.0, 110.0, 103.0, None], [100.0, 101.0, 99.0, 50.0, 90.0], [97.0, 97.0, 97.0, 200.0, 90.0]]
    for name, values in zip(tables.RECORDINGS, cells, strict=False):
        errors[name]["imu_tk"] = values
    row = next(line for line in tables.verdict(errors).splitlines() if line.startswith("| imu_tk |"))
    assert row.split(" | ")[1:] == [
        "**wins**: 3 better, 0 worse, 1 equal",
        "ties: 0 better, 1 worse, 4 equal",
        "**loses**: 1 better, 3 worse, 1 equal",
        " |",
    ]
    failed = tables.prediction(errors, None).splitlines()[5]
    assert failed.split(" | ")[1] == "106 (100 to 200) 1 of 5 failed"

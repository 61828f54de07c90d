"""What the page on firmware says of a Cortex-M4F is what an emulated one does."""

import importlib.util
import shutil
from itertools import pairwise

import pytest

import madeup
from conftest import REPOSITORY

PAGE = (REPOSITORY / "docs" / "runtime.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def target():
    spec = importlib.util.spec_from_file_location("target", REPOSITORY / "benchmarks" / "target.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def rows(target):
    text = PAGE.partition(target.MARKS[0])[2].partition(target.MARKS[1])[0]
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line.strip()]
    assert lines[0] == target.TITLES
    return {line[0]: list(map(float, line[1:])) for line in lines[2:]}


def test_the_table_has_every_case_and_numbers_that_can_be(target):
    found = rows(target)
    assert len(found) == 24
    assert sum(title.startswith("array of six gyros") for title in found) == 4
    for title, (flash, state, stack, small, fast) in found.items():
        assert 1000 < flash < 32257 + 8192  # all of the core, its numbers, and libm
        assert state in (0, 52, 140, 328, 532, 944) or state > 1000
        assert 0 < stack < 2404
        assert 30 < fast < (25000 if title.startswith("board") else 3000)
        assert 0.7 < small / fast < 1.5
    first, second = found["accelerometers, order 1"], found["accelerometers, order 2"]
    assert second[3] > 3 * first[3]  # a square root of each axis, and the turning points
    for four, eight in pairwise([list(cells) for title, cells in found.items() if title.startswith("board")][::2]):
        assert 2 * four[1] > eight[1] > four[1]  # a part of the state does not depend on the number of IMUs
        assert 2 * four[4] > eight[4] > four[4]
    for laws, held in (
        ("accelerometers over temperature, degrees 3 2 1", f"the same, {target.HELD}"),
        ("accelerometers and gyroscopes over temperature", f"accelerometers and gyroscopes, {target.HELD}"),
    ):
        assert first[3] < found[held][3] < found[laws][3] / 4


def test_one_sample_costs_what_the_page_says(target):
    missing = [tool for tool in target.TOOLS if shutil.which(tool) is None]
    if missing:
        pytest.skip(f"no {missing[0]} on this machine")
    flash, state, stack, small, fast = rows(target)["accelerometers, order 1"]
    found = target.measured([madeup.tumble(1)])
    assert found["state"] == state
    for name, said in (("flash", flash), ("stack", stack), ("instructions -Os", small), ("instructions -O2", fast)):
        assert abs(found[name] - said) <= 0.1 * said  # compilers differ by version

"""Records and blobs of version 0.1.0, written before its modules were moved, load and correct to the same numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.cli import main

BEFORE = Path(__file__).resolve().parent / "data" / "before"
"""Made by that version's own commands: NAME.json and NAME.blob, a recording, and what `apply` or `fuse` made of it."""
RECORDINGS = {"tumble": "triads", "six_axes": "counts", "warmup": "warmup", "centrifuge": "centrifuge"}


def _same(out: Path, expected: Path) -> None:
    found, kept = il.read(out), il.read(expected)
    assert found.units == kept.units
    assert found.corrected_by == kept.corrected_by
    for name, values in kept.columns.items():
        np.testing.assert_allclose(found.columns[name], values, rtol=1e-13, atol=1e-13, err_msg=name)


@pytest.mark.parametrize("kind", ["json", "blob"])
@pytest.mark.parametrize("name", RECORDINGS)
def test_a_record_and_a_blob_correct_as_before(tmp_path, name, kind):
    out = tmp_path / "out.csv"
    assert main(["apply", str(BEFORE / f"{name}.{kind}"), str(BEFORE / f"{RECORDINGS[name]}.csv"), "-o", str(out)]) == 0
    _same(out, BEFORE / f"{name}{'.blob' if kind == 'blob' else ''}.expected.csv")


@pytest.mark.parametrize("kind", ["json", "blob"])
def test_an_array_fuses_as_before(tmp_path, kind):
    out = tmp_path / "out.csv"
    given = ["--calibration", str(BEFORE / f"array.{kind}"), "-o", str(out)]
    assert main(["array", "fuse", str(BEFORE / "array.csv"), *given]) == 0
    _same(out, BEFORE / f"array{'.blob' if kind == 'blob' else ''}.expected.csv")


@pytest.mark.parametrize("name", ["tumble", "warmup", "centrifuge", "array"])
def test_a_record_is_shown_drawn_and_written_again_as_before(tmp_path, capsys, name):
    record = BEFORE / f"{name}.json"
    assert main(["show", str(record)]) == 0
    assert main(["report", str(record), "-o", str(tmp_path / "r.html")]) == 0
    il.load(record).save(tmp_path / "again.json")
    assert (tmp_path / "again.json").read_text() == record.read_text()

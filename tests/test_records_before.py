"""Records, blobs, manifests and tables that earlier versions wrote are read to the numbers that those versions gave."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.cli import main

WRITTEN = Path(__file__).resolve().parent / "data" / "written_by"


"""A folder for each version, made by its own commands; what stands in `recordings` was the same for both.

`NAME.json.applied.csv` and `NAME.blob.applied.csv` are what that version's `apply` or `array fuse` made of a recording;
`numbers.csv` was taken from the text of the records without imulab. More of 0.1.0 stands in `data/before`.
"""


RECORDINGS = {
    "tumble": "nine_axes",
    "six_axes": "nine_axes",
    "nine_axes": "nine_axes",
    "second_order": "second_order",
    "array": "array",
    "warmup": "warmup",
    "warmup_cubic": "warmup",
    "centrifuge": "centrifuge",
    "thermal": "thermal",
    "thermal_gyro": "thermal",
    "rate": "nine_axes",
    "turns": "turns",
}


VERSIONS = ["0.1.0", "0.2.0"]


def records(version: str) -> list[str]:
    return sorted(file.stem for file in (WRITTEN / version).glob("*.json") if file.stem != "allan")


RECORDS = [(version, name) for version in VERSIONS for name in records(version)]


APPLIED = [(version, name) for version, name in RECORDS if name in RECORDINGS]


def correct(record: Path, name: str, out: Path) -> il.Recording:
    recording = WRITTEN / "recordings" / f"{RECORDINGS[name]}.csv"
    words = ["array", "fuse", recording, "--calibration", record] if name == "array" else ["apply", record, recording]
    assert main([*map(str, words), "-o", str(out), "-q"]) == 0
    return il.read(out)


def assert_same_columns(actual: il.Recording, expected: il.Recording, left_alone: Sequence[str] = ()) -> None:
    """Compare recordings; the columns `left_alone` must be those that were to be corrected."""
    assert actual.units == expected.units
    assert list(actual.columns) == list(expected.columns)
    for title, values in expected.columns.items():
        if title not in left_alone:
            np.testing.assert_allclose(actual.columns[title], values, rtol=1e-13, atol=1e-13, err_msg=title)
    recording = il.read(WRITTEN / "recordings" / "turns.csv")
    for title in left_alone:
        np.testing.assert_array_equal(actual.columns[title], recording.columns[title])


def not_held(name: str, kind: str) -> list[str]:
    """Gyroscopes that a blob of turns does not hold: 0.2.0 passed them through the core all the same, as floats."""
    axes = json.loads((WRITTEN / "0.2.0" / f"{name}.json").read_text())["model"].get("axes", "xyz")
    return [f"gyro_{axis}" for axis in "xyz" if axis not in axes] if name == "turns" and kind == "blob" else []


@pytest.mark.parametrize("version", VERSIONS)
def test_parameters_are_those_that_were_written(version):
    with (WRITTEN / version / "numbers.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert {row["record"] for row in rows} == set(records(version)) - {"comparison"}
    for row in rows:
        parameter = il.load(WRITTEN / version / f"{row['record']}.json").parameters[row["parameter"]]
        assert parameter.value == float(row["value"])
        assert parameter.unit == row["unit"]
        uncertainty = row["standard_uncertainty"]
        assert parameter.standard_uncertainty == (None if uncertainty == "None" else float(uncertainty))


@pytest.mark.parametrize(("version", "name"), RECORDS)
def test_a_record_is_shown_drawn_and_written_again(version, name, tmp_path, capsys):
    record = WRITTEN / version / f"{name}.json"
    assert main(["show", str(record)]) == 0
    assert il.load(record).verdict.state in capsys.readouterr().out
    assert main(["report", str(record), "-o", str(tmp_path / "report.html")]) == 0
    assert "</html>" in (tmp_path / "report.html").read_text(encoding="utf-8")
    il.load(record).save(tmp_path / "again.json")
    assert (tmp_path / "again.json").read_text(encoding="utf-8") == record.read_text(encoding="utf-8")


@pytest.mark.parametrize("kind", ["json", "blob"])
@pytest.mark.parametrize(("version", "name"), APPLIED)
def test_a_record_and_its_blob_correct_as_before(version, name, kind, tmp_path):
    expected = il.read(WRITTEN / version / f"{name}.{kind}.applied.csv")
    actual = correct(WRITTEN / version / f"{name}.{kind}", name, tmp_path / "out.csv")
    assert_same_columns(actual, expected, not_held(name, kind))
    hashes = [[text.rpartition("sha256:")[2] for text in file.corrected_by] for file in (actual, expected)]
    assert hashes[0] == hashes[1]


@pytest.mark.parametrize(("version", "name"), APPLIED)
def test_firmware_exported_today_corrects_as_the_blob_that_was_written(version, name, tmp_path):
    assert main(["export", str(WRITTEN / version / f"{name}.json"), "--to", "c", "-o", str(tmp_path / "c")]) == 0
    expected = il.read(WRITTEN / version / f"{name}.blob.applied.csv")
    assert_same_columns(
        correct(tmp_path / "c" / "unit.blob", name, tmp_path / "out.csv"), expected, not_held(name, "blob")
    )


@pytest.mark.parametrize("version", VERSIONS)
def test_a_manifest_of_a_rate_test_gives_what_one_of_today_gives(version, tmp_path):
    il.simulate_rate(rates="0,100", hold=4, rate=20, faces="+z").save(tmp_path)
    today = il.fit_rate(tmp_path / "test.toml", order=1).calibration
    shutil.copy(WRITTEN / version / "rate.toml", tmp_path / "test.toml")
    before = il.fit_rate(tmp_path / "test.toml", order=1).calibration
    assert {name: p.value for name, p in before.parameters.items()} == {n: p.value for n, p in today.parameters.items()}


@pytest.mark.parametrize("version", VERSIONS)
def test_a_manifest_of_a_centrifuge_test_is_simulated_and_reduced(version, tmp_path):
    plan = ["centrifuge", "simulate", "--plan", str(WRITTEN / version / "centrifuge.toml")]
    short = ["--duration", "40 s", "--static-duration", "10 s", "--rate", "20"]
    assert main([*plan, *short, "-o", str(tmp_path)]) == 0
    record = il.fit_centrifuge(tmp_path / "manifest.toml").calibration
    forces = [level["specific_force"]["value"] for level in record.sections["levels"]]
    np.testing.assert_allclose(forces, [9.80665, 5 * 9.80665], rtol=1e-3)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_manifest_and_limits_of_a_fleet_are_read(version, tmp_path):
    il.simulate_fleet(tmp_path, units=8)
    shutil.copy(WRITTEN / version / "fleet.csv", tmp_path / "first.csv")
    il.run_fleet(tmp_path / "first.csv", tmp_path / "records", workers=1, history="none")
    assert len(list((tmp_path / "records").glob("LINE-*.json"))) == 8
    limits = WRITTEN / version / "limits.toml"
    il.write_fleet_report(tmp_path / "records", tmp_path / "line.html", limits=limits, history="none")
    assert "40" in (tmp_path / "line.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("version", VERSIONS)
def test_a_table_of_warm_up_corrects_as_the_record_that_it_is_from(version, tmp_path):
    assert main(["warmup", "table", str(WRITTEN / version / "warmup_table.csv"), "-o", str(tmp_path / "a.json")]) == 0
    expected = il.read(WRITTEN / version / "warmup_cubic.json.applied.csv")
    assert_same_columns(correct(tmp_path / "a.json", "warmup_cubic", tmp_path / "out.csv"), expected)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_plan_of_attitudes_is_added_to(version, capsys):
    plan = ["tumble", "plan", "--attitudes", "4", "--order", "1", "--noise", "30ug"]
    assert main([*plan, "--add", str(WRITTEN / version / "attitudes.csv")]) == 0
    assert "4 attitudes with the 12 already there" in capsys.readouterr().out


@pytest.mark.parametrize("version", VERSIONS)
def test_what_allan_printed_serves_an_export(version, tmp_path):
    record, noise = (str(WRITTEN / version / name) for name in ("nine_axes.json", "allan.json"))
    assert main(["export", record, "--to", "kalibr", "--noise", noise, "-o", str(tmp_path)]) == 0


BEFORE = Path(__file__).resolve().parent / "data" / "before"


"""Made by that version's own commands: NAME.json and NAME.blob, a recording, and what `apply` or `fuse` made of it."""


RECORDINGS_BEFORE = {"tumble": "triads", "six_axes": "counts", "warmup": "warmup", "centrifuge": "centrifuge"}


def _same(out: Path, expected: Path) -> None:
    found, kept = il.read(out), il.read(expected)
    assert found.units == kept.units
    assert found.corrected_by == kept.corrected_by
    for name, values in kept.columns.items():
        np.testing.assert_allclose(found.columns[name], values, rtol=1e-13, atol=1e-13, err_msg=name)


@pytest.mark.parametrize("kind", ["json", "blob"])
@pytest.mark.parametrize("name", RECORDINGS_BEFORE)
def test_a_record_and_a_blob_correct_as_before(tmp_path, name, kind):
    out = tmp_path / "out.csv"
    assert (
        main(["apply", str(BEFORE / f"{name}.{kind}"), str(BEFORE / f"{RECORDINGS_BEFORE[name]}.csv"), "-o", str(out)])
        == 0
    )
    _same(out, BEFORE / f"{name}{'.blob' if kind == 'blob' else ''}.expected.csv")


@pytest.mark.parametrize("kind", ["json", "blob"])
def test_an_array_fuses_as_before(tmp_path, kind):
    out = tmp_path / "out.csv"
    given = ["--calibration", str(BEFORE / f"array.{kind}"), "-o", str(out)]
    assert main(["array", "fuse", str(BEFORE / "array.csv"), *given]) == 0
    _same(out, BEFORE / f"array{'.blob' if kind == 'blob' else ''}.expected.csv")


@pytest.mark.parametrize("name", ["tumble", "six_axes", "warmup", "centrifuge", "array"])
def test_a_record_is_shown_drawn_and_written_again_as_before(tmp_path, capsys, name):
    record = BEFORE / f"{name}.json"
    assert main(["show", str(record)]) == 0
    assert main(["report", str(record), "-o", str(tmp_path / "r.html")]) == 0
    il.load(record).save(tmp_path / "again.json")
    assert (tmp_path / "again.json").read_text() == record.read_text()

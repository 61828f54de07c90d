"""What a corrected recording says of itself: its records, and no second correction by one of them unless asked."""

import re
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
import madeup
from imulab.cli import main
from imulab.device.unit import load_blob
from imulab.errors import DataError
from imulab.procedures.apply import loaded, warnings_of
from imulab.recording import Recording
from imulab.writers import write

ACCEL = {f"accel_{axis}": np.array([10.0, -200.0, 3000.0]) for axis in "xyz"}
GYRO = {f"gyro_{axis}": np.array([1.0, 20.0, -300.0]) for axis in "xyz"}


def flight(**columns):
    made = columns or ACCEL
    return Recording(made, dict.fromkeys(made, "count"), name="flight.csv", metadata={"serial": "SN42"})


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_corrected_file_names_every_record_and_its_hash(tmp_path, kind, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    first, second = (
        madeup.tumble(1),
        replace(madeup.tumble(2), model={**madeup.tumble(2).model, "output_unit": "m/s^2"}),
    )
    second = replace(
        second,
        parameters={
            name: replace(p, unit=p.unit.replace("count", "m/s^2"), value=1.0 if "scale" in name else p.value)
            for name, p in second.parameters.items()
        },
    )
    first.save("a.json")
    second.save("b.json")
    write(flight(), "raw.csv")
    assert main(["apply", "a.json", "b.json", "raw.csv", "-o", f"out.{kind}"]) == 0
    expected = tuple(f"{name}.json sha256:{r.to_dict()['content_sha256']}" for name, r in (("a", first), ("b", second)))
    assert il.read(f"out.{kind}").corrected_by == expected
    if kind == "csv":
        assert re.findall(r"^# corrected_by: (.*)$", (tmp_path / "out.csv").read_text(), re.M) == list(expected)
    capsys.readouterr()
    assert main(["apply", "b.json", f"out.{kind}", "-o", "again.csv"]) == 2
    assert f"out.{kind}: already corrected by b.json" in capsys.readouterr().err
    assert not (tmp_path / "again.csv").exists()
    assert main(["apply", "b.json", f"out.{kind}", "--again", "-o", "again.csv"]) == 0
    assert f"was corrected before, by {expected[0]}" in capsys.readouterr().err
    assert il.read("again.csv").corrected_by == (*expected, expected[1])
    assert main(["convert", f"out.{kind}", "-o", "converted.csv"]) == 0
    assert il.read("converted.csv").corrected_by == expected


def test_a_blob_is_known_by_the_records_that_it_was_made_from(tmp_path):
    record = madeup.tumble(1)
    il.export("blob", [record], tmp_path)
    blob = load_blob(tmp_path / "unit.blob")
    once = il.apply(record, flight())
    again = replace(once, columns=flight().columns, units=flight().units)
    with pytest.raises(DataError, match="already corrected by"):
        il.apply(blob, again)
    assert il.apply(blob, again, again=True).corrected_by[1].endswith(loaded(blob).holds[0])


def test_what_a_record_leaves_unchanged_is_not_called_corrected():
    time = {"time": np.arange(3.0), "gyro_x": np.zeros(3), "gyro_z": np.zeros(3)}
    cold = Recording(time, {"time": "s", "gyro_x": "rad/s", "gyro_z": "rad/s"}, name="cold.csv")
    assert il.apply(madeup.warmup(), cold).corrected_by == ()


def test_a_record_of_six_axes_corrects_the_triad_that_is_there_and_says_so():
    record = madeup.tumble(1, gyro=True)
    both = il.apply(record, flight(**ACCEL, **GYRO))
    for there, away, words in ((ACCEL, "gyroscopes", "accelerometers"), (GYRO, "accelerometers", "gyroscopes")):
        alone = flight(**there)
        corrected = il.apply(record, alone)
        for name in there:
            np.testing.assert_array_equal(corrected.column(name), both.column(name))
        assert warnings_of(record, alone) == [f"flight.csv: no {away} in it: its {words} alone are corrected"]
    assert warnings_of(record, flight(**ACCEL, **GYRO)) == []


def test_gyroscopes_whose_g_sensitivity_needs_the_accelerometers_are_refused_without_them():
    with pytest.raises(DataError, match=r"g-sensitivity, which needs accel_x, accel_y and accel_z; found gyro_x"):
        il.apply(madeup.tumble(1, gyro=True, sensitive=True), flight(**GYRO))


def test_a_record_of_one_triad_is_not_applied_to_the_other():
    with pytest.raises(DataError, match="no column accel_x; found gyro_x"):
        il.apply(madeup.tumble(1), flight(**GYRO))

"""The options that say what part of a recording to read: the same wherever one is read."""

import json

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.cli.app import commands
from imulab.errors import DataError, OptionError
from imulab.readers import read_blocks
from test_readers_logs import low_rate_log

PART = {"layout", "topic", "instance", "window"}
NOT_BY_ELEMENT = {"array merge", "array calibrate", "array fuse", "array compare"}
"""What an array is needed for."""
BY_MANIFEST = {"centrifuge reduce"}
"""The manifest of a test says the window of each run."""
LIVE = {"live"}
"""A stream is one sensor's, from now on."""


def test_every_command_that_reads_a_recording_has_the_same_options():
    every = {command.path: {option.name for option in command.options} for command in commands()}
    reading = {path: names for path, names in every.items() if names & {*PART, "element"}}
    assert {"show", "convert", "apply", "allan", "tumble fit", "tumble gyro", "tumble check", "warmup fit"} <= set(
        reading
    )
    for path, names in reading.items():
        if path not in BY_MANIFEST | LIVE:
            wanted = PART if path in NOT_BY_ELEMENT else {*PART, "element"}
            assert names & {*PART, "element"} == wanted, path


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        capsys.readouterr()
        return main([*map(str, arguments)]), *capsys.readouterr()

    return run


def array_csv(path, count=1500, gyros=3):
    rng = np.random.default_rng(3)
    names = [f"gyro_{n + 1}" for n in range(gyros)]
    rows = np.column_stack([np.arange(count) / 50, rng.normal(0, 0.05, (count, gyros))])
    np.savetxt(path, rows, "%.9g", ",", header=",".join(["time [s]", *(f"{n} [deg/s]" for n in names)]), comments="")
    return path


def test_the_commands_of_arrays_take_a_window(run, tmp_path):
    array_csv(tmp_path / "a.csv")
    status, _, error = run("array", "fuse", "a.csv", "--window", "10:20", "-o", "part.csv")
    assert status == 0, error
    assert il.read(tmp_path / "part.csv").time[[0, -1]].tolist() == [10.0, 20.0]
    status, out, _ = run("array", "compare", "a.csv", "--window", "10:20", "--json")
    assert json.loads(out)["fit"]["samples"] == 501
    status, _, error = run("array", "calibrate", "a.csv", "--window", "5:", "-o", "one.json")
    assert status == 0, error
    status, _, error = run("array", "calibrate", "a.csv", "--interval", "5,30", "-o", "two.json")
    assert status == 0, error
    one, two = il.load(tmp_path / "one.json"), il.load(tmp_path / "two.json")
    assert {n: p.value for n, p in one.parameters.items()} == {n: p.value for n, p in two.parameters.items()}
    status, _, error = run("array", "calibrate", "a.csv", "--interval", "5,20", "--window", "5:20")
    assert (status, error.count("\n")) == (2, 1)
    assert "--interval together with --window" in error
    for name in ("fuse", "compare", "calibrate"):
        status, _, error = run("array", name, "a.csv", "--instance", "1")
        assert status == 2
        assert "a text file has no instances to choose from" in error
        assert run("array", name, "a.csv", "--window", "40:50")[0] == 2


def test_allan_takes_the_part_that_is_asked_for(run, tmp_path):
    data, _, _ = low_rate_log(100, 400)
    (tmp_path / "log.ulg").write_bytes(data)
    whole = json.loads(run("allan", "log.ulg", "--json")[1])
    assert whole["samples"] == 400
    part = json.loads(run("allan", "log.ulg", "--window", "1.2:", "--json")[1])
    assert part["samples"] == 350
    slow = json.loads(run("allan", "log.ulg", "--topic", "sensor_accel", "--json")[1])
    assert slow["samples"] == 100
    assert (
        "no sensor_combined of instance 3"
        in run("allan", "log.ulg", "--topic", "sensor_combined", "--instance", "3")[2]
    )


# --- one IMU of several ----------------------------------------------------------------------------------------------


def several(path, count=200):
    rng = np.random.default_rng(4)
    titles = [f"{s}_{a}_{n} [{u}]" for n in (1, 2, 12) for s, u in (("accel", "g"), ("gyro", "deg/s")) for a in "xyz"]
    rows = np.column_stack([np.arange(count) / 50, rng.normal(0, 0.05, (count, 18)), np.full(count, 25.0)])
    header = ",".join(["time [s]", *titles, "temperature [degC]"])
    np.savetxt(path, rows, "%.17g", ",", header=header, comments="")
    return path


def test_an_element_is_read_as_a_file_of_one_imu(tmp_path):
    file = several(tmp_path / "a.csv")
    whole, one = il.read(file), il.read(file, element=12)
    triads = [f"{sensor}_{axis}" for sensor in ("accel", "gyro") for axis in "xyz"]
    assert list(one.columns) == ["time", *triads, "temperature"]
    for name in triads:
        np.testing.assert_array_equal(one.columns[name], whole.columns[f"{name}_12"])
        assert one.units[name] == whole.units[f"{name}_12"]
    assert one.metadata["element"] == "12"
    (block,) = read_blocks(file, element=2, window=(1.0, 2.0))
    np.testing.assert_array_equal(block.columns["gyro_z"], whole.columns["gyro_z_2"][50:101])


def test_an_element_that_is_not_there_or_not_chosen(tmp_path):
    file = several(tmp_path / "a.csv")
    with pytest.raises(OptionError, match="no element 3; elements found: 1 2 12"):
        il.read(file, element=3)
    with pytest.raises(OptionError, match="element 0: expected a number from 1"):
        il.read(file, element=0)
    with pytest.raises(DataError, match=r"one of each of 3 IMUs; choose one, from 1 to 12 \(--element 1\)"):
        il.find_attitudes(il.read(file))
    (tmp_path / "one.csv").write_text("time [s],accel_x [g]\n0,1\n1,2\n")
    with pytest.raises(OptionError, match="no columns of several IMUs; leave out the element 1"):
        il.read(tmp_path / "one.csv", element=1)


def test_a_tumble_of_one_imu_of_a_real_array(run, real_data, tmp_path):
    """Each IMU has zeros of its own; and the calibrated magnitudes of all agree on gravity."""
    log = real_data / "mimu4444" / "exp_1.bin"
    status, _, error = run("tumble", "fit", log)
    assert (status, error.count("\n")) == (2, 1)
    assert "one of each of 8 IMUs; choose one, from 1 to 8 (--element 1)" in error
    for element in (1, 2):
        assert run("tumble", "fit", log, "--element", element, "-o", f"{element}.json")[0] == 0
    records = [il.load(tmp_path / f"{element}.json") for element in (1, 2)]
    assert [record.sensor["element"] for record in records] == ["1", "2"]
    assert [record.fit["attitudes"] for record in records] == [21, 21]
    zeros = [record.parameters["bias_z"].value for record in records]
    assert abs(zeros[0] - zeros[1]) > 0.1
    assert all(record.fit["rms"]["value"] < 300e-6 * 9.81 for record in records)
    status, _, error = run("apply", "1.json", log, "--element", "2", "--window", "0:5", "-o", "c.csv")
    assert "element 2, but the record was made for 1" in error
    assert list(il.read(tmp_path / "c.csv").columns) == [
        "time",
        *(f"{s}_{a}" for s in ("gyro", "accel") for a in "xyz"),
    ]

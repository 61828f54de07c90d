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
NOT_BY_ELEMENT = {
    "array merge", "array calibrate", "array calibrate --imus", "array fuse", "array fuse --imus", "array compare",
    "array compare --imus",
}  # fmt: skip
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
            assert "units" in names, path


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


def test_units_are_stated_on_the_command_line_and_in_python(run, tmp_path):
    wrong = il.simulate_tumble(attitudes=12, order=1, hold="3 s", gravity=9.81)
    axes = [f"accel_{axis}" for axis in "xyz"]
    wrong = wrong.with_columns({axis: wrong.columns[axis] / 9.80665 for axis in axes}, {})
    still = wrong.with_columns({}, dict.fromkeys(axes, "g"))
    assert wrong.units["accel_x"] == "m/s^2"
    il.write(wrong, tmp_path / "wrong.csv")
    il.write(wrong, tmp_path / "wrong.parquet")
    il.write(still, tmp_path / "right.csv")
    right = il.fit_tumble(tmp_path / "right.csv", order=1, gravity=9.81)
    for name in ("wrong.csv", "wrong.parquet"):
        status, out, error = run("show", name, "--unit", "accel=g")
        assert status == 0
        assert "note: accel is read in g as stated, not in m/s^2" in out
        fit = il.fit_tumble(tmp_path / name, order=1, gravity=9.81, units={"accel": "g"})
        assert fit.calibration.parameters["bias_x"] == right.calibration.parameters["bias_x"]
        assert (
            run("tumble", "fit", name, "--gravity", "9.81", "--order", "1", "--unit", "accel=g", "-o", "r.json")[0] == 0
        )
        assert il.load(tmp_path / "r.json").parameters["bias_x"].value == right.calibration.parameters["bias_x"].value
    blocks = list(read_blocks(tmp_path / "wrong.csv", units={"accel_y": "mg"}))
    assert [blocks[0].units[f"accel_{axis}"] for axis in "xyz"] == ["m/s^2", "mg", "m/s^2"]
    for words, message in (
        ("gyr=deg/s", "unit of gyr: no such column; columns: time accel_x"),
        ("accle=g", "; did you mean 'accel'?"),
        ("accel=deg/s", "column accel_x: expected a unit of acceleration or output, found 'deg/s' (rate)"),
        ("accel", "--unit 'accel': expected NAME=UNIT, each name once, such as accel=g,gyro=deg/s"),
        ("accel=gee", "--unit accel=gee: unknown unit 'gee'"),
    ):
        status, _, error = run("show", "wrong.csv", "--unit", words)
        assert (status, error.count("\n")) == (2, 1)
        assert message in error
    assert il.read(tmp_path / "wrong.csv", units={"time": "ms"}).time[1] == pytest.approx(still.time[1] / 1000)


def test_titles_without_a_unit_take_the_stated_one(run, tmp_path):
    rows = "".join(f"{0.01 * k:.2f},0.1,0.2,1.0\n" for k in range(50))
    (tmp_path / "f.csv").write_text(f"time,accel_x,accel_y,accel_z\n{rows}")
    status, _, error = run("show", "f.csv")
    assert status == 2
    assert "--unit time=s" in error
    status, out, error = run("show", "f.csv", "--unit", "time=s,accel=g")
    assert (status, error) == (0, "")
    assert "note:" not in out
    assert il.read(tmp_path / "f.csv", units={"time": "s", "accel": "g"}).units["accel_z"] == "g"


def test_a_log_that_writes_other_units_than_its_format_has(run, tmp_path):
    data, _, _ = low_rate_log(100, 400)
    (tmp_path / "log.ulg").write_bytes(data)
    plain, stated = (il.read(tmp_path / "log.ulg", units=units) for units in (None, {"accel": "g", "gyro": "deg/s"}))
    assert (plain.units["accel_x"], stated.units["accel_x"], stated.units["gyro_z"]) == ("m/s^2", "g", "deg/s")
    np.testing.assert_array_equal(plain.columns["accel_x"], stated.columns["accel_x"])
    assert run("convert", "log.ulg", "--unit", "accel=g,gyro=deg/s", "-o", "out.csv")[0] == 0
    assert il.read(tmp_path / "out.csv").units["gyro_x"] == "deg/s"


def test_increments_are_a_kind_of_their_own_with_their_rate(run, tmp_path):
    """The rate of increments is their mean over a sample, here compared with the division written out."""
    rng = np.random.default_rng(6)
    gained = rng.normal(0, 1e-3, (200, 3))
    rows = "".join(f"{k / 125},{x!r},{y!r},{z!r}\n" for k, (x, y, z) in enumerate(gained.tolist()))
    (tmp_path / "f.csv").write_text(f"time [s],gyro_x [deg],gyro_y [deg],gyro_z [deg]\n{rows}")
    status, _, error = run("show", "f.csv")
    assert status == 2
    assert "column gyro_x: expected a unit of rate or output, found 'deg' (angle); of increments per sample" in error
    assert error.endswith("state their rate too, such as deg@100Hz\n")
    assert "did you mean" not in error
    found = il.read(tmp_path / "f.csv", units={"gyro": "deg@125 Hz"})
    assert found.units["gyro_x"] == "deg@125Hz"
    np.testing.assert_allclose(found.si("gyro_x"), np.radians(gained[:, 0]) / (1 / 125), rtol=1e-13)
    il.write(found, tmp_path / "own.csv")
    again = il.read(tmp_path / "own.csv")
    assert again.units == found.units
    np.testing.assert_array_equal(again.columns["gyro_y"], gained[:, 1])
    for wrong in ("deg@", "deg@0Hz", "g@100Hz", "deg@100"):
        with pytest.raises(il.ImulabError, match="unknown unit"):
            il.read(tmp_path / "f.csv", units={"gyro": wrong})


def test_units_of_two_files_go_to_the_one_that_has_the_sensor(run, tmp_path):
    both = il.simulate_tumble(attitudes=16, order=1, gravity=9.81)
    il.fit_tumble(both, order=1, gravity=9.81).save(tmp_path / "r.json")
    for sensor in ("accel", "gyro"):
        names = ["time", *(f"{sensor}_{axis}" for axis in "xyz")]
        columns = {name: both.columns[name] for name in names}
        if sensor == "gyro":
            columns |= {name: both.si(name) for name in names[1:]}
        il.write(il.Recording(columns, {n: both.units[n] for n in names}), tmp_path / f"{sensor}.csv")
    words = ["tumble", "gyro", "gyro.csv", "--accel", "r.json", "--accel-file", "accel.csv"]
    status, _, error = run(*words, "--unit", "gyro=rad/s,accel=m/s^2", "-o", "g.json")
    assert status == 0, error
    scale = il.load(tmp_path / "g.json").parameters["gyro_scale_factor_x"]
    assert scale.value == pytest.approx(np.radians(float(both.metadata["truth_gyro_scale_factor_x"])), abs=5e-3)
    stated = {"gyro": "rad/s", "accel": "m/s^2"}
    record, gyro, accel = (tmp_path / name for name in ("r.json", "gyro.csv", "accel.csv"))
    same = il.fit_gyro(record, gyro, accel_data=accel, units=stated).calibration
    assert same.parameters["gyro_scale_factor_x"] == scale

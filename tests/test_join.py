"""Sensors of one unit in files of their own, joined to one recording."""

import numpy as np
import pytest

import imulab as il
from imulab.errors import DataError, OptionError

G = 9.81


@pytest.fixture(scope="module")
def nine():
    return il.simulate_tumble(attitudes=14, order=1, hold="2 s", gravity=G, field="48 uT")


def only(recording, sensor, unit, time, **more):
    return il.Recording.from_arrays(
        **{sensor: recording}, time=time, units={sensor: unit}, name=f"{sensor}.csv", **more
    )


def parts(nine):
    """Accelerometers, gyroscopes half a row later, and magnetometers in every fifth row, 1 ms late."""
    mag = only(nine.triad("mag")[2::5], "mag", "uT", nine.time[2::5] + 1e-3)
    gyro = only(nine.triad("gyro"), "gyro", "deg/s", nine.time + 5e-3)
    return only(nine.triad("accel"), "accel", "m/s^2", nine.time, metadata={"serial": "7"}), gyro, mag


def test_sensors_of_their_own_come_to_one_clock(nine):
    accel, gyro, mag = parts(nine)
    joined = il.join_recordings(accel, [gyro, mag])
    rows = slice(1, None)  # before the first sample of the gyroscopes
    np.testing.assert_allclose(joined.time, nine.time[rows], atol=1e-9)
    np.testing.assert_array_equal(joined.triad("accel"), nine.triad("accel")[rows])
    for axis in "xyz":
        expected = np.interp(nine.time[rows], gyro.time, gyro.column(f"gyro_{axis}"))
        np.testing.assert_allclose(joined.column(f"gyro_{axis}"), expected, atol=1e-4)
    expected = np.full_like(nine.triad("mag"), np.nan)
    expected[2::5] = nine.triad("mag")[2::5]
    np.testing.assert_array_equal(joined.triad("mag"), expected[rows])
    assert joined.metadata == {"serial": "7"}
    said = " ".join(joined.notes)
    assert "gyro.csv (100 Hz) interpolated to the clock of the accel.csv (100 Hz)" in said
    assert "mag.csv (20 Hz) not interpolated" in said


def test_a_joined_recording_calibrates_the_magnetometers(nine):
    accel, _, mag = parts(nine)
    record = il.fit_mag(il.join_recordings(accel, [mag]), gravity=G, field="48 uT", order=1).calibration
    for name in ("mag_bias_x", "mag_scale_factor_y", "dip"):
        parameter = record.parameters[name]
        assert abs(parameter.value - float(nine.metadata[f"truth_{name}"])) < 4.5 * parameter.standard_uncertainty


def test_what_does_not_go_together_is_refused(nine):
    accel, _, mag = parts(nine)
    later = mag.with_columns({"time": mag.time + 1000.0}, {})
    with pytest.raises(DataError, match=r"mag.csv: time 1000.02 to .* s has nothing in common with accel.csv, 0 to "):
        il.join_recordings(accel, [later])
    with pytest.raises(DataError, match=r"accel.csv: column accel_x, which accel.csv has too; expected other sensors"):
        il.join_recordings(accel, [accel])
    back = mag.with_columns({"time": mag.time[::-1].copy()}, {})
    with pytest.raises(DataError, match=r"mag.csv: row 2, column time: time runs backwards"):
        il.join_recordings(accel, [back])
    table = il.Recording.from_arrays(mag=np.ones((9, 3)), unit="uT", name="table.csv")
    with pytest.raises(DataError, match=r"table.csv: no column time, by which it could be joined"):
        il.join_recordings(accel, [table])
    with pytest.raises(OptionError, match="expected one recording or more to join"):
        il.join_recordings(accel, [])


def test_the_command_joins_the_files_of_a_phone(nine, imulab, tmp_path):
    times = nine.time
    for sensor, name, every, factor in (
        ("accel", "TotalAcceleration", 1, 1.0),
        ("gyro", "Gyroscope", 1, np.pi / 180),
        ("mag", "Magnetometer", 3, 1.0),
    ):
        values = nine.triad(sensor)[::every, ::-1] * factor
        columns = [times[::every] * 1e9, times[::every], *values.T]
        rows = "".join(",".join(map(repr, map(float, row))) + "\n" for row in zip(*columns, strict=True))
        (tmp_path / f"{name}.csv").write_text("time,seconds_elapsed,z,y,x\n" + rows)
    layout = ["--layout", "sensorlogger-accel"]
    more = ["--with", "Gyroscope.csv@sensorlogger-gyro", "--with", "Magnetometer.csv@sensorlogger-mag"]
    done = imulab("convert", "TotalAcceleration.csv", *layout, *more, "-o", "nine.csv")
    assert done.returncode == 0, done.stderr
    assert "Magnetometer.csv" in done.stderr
    found = il.read(tmp_path / "nine.csv")
    np.testing.assert_array_equal(found.triad("accel"), nine.triad("accel"))
    np.testing.assert_allclose(np.degrees(found.triad("gyro")), nine.triad("gyro"), rtol=1e-12)
    np.testing.assert_array_equal(found.triad("mag")[::3], nine.triad("mag")[::3])
    assert np.isnan(found.column("mag_x")[1::3]).all()
    for wrong, message in (
        ("Magnetometer.csv@", "expected FILE or FILE@LAYOUT"),
        ("none.csv@sensorlogger-mag", "none.csv: no such file"),
        ("Magnetometer.csv@sensorlogger", "no such layout file"),
    ):
        done = imulab("convert", "TotalAcceleration.csv", *layout, "--with", wrong, "-o", "wrong.csv")
        assert done.returncode == 2
        assert message in done.stderr
        assert done.stderr.count("\n") == 1
        assert not (tmp_path / "wrong.csv").exists()

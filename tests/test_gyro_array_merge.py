"""``imulab array merge``: files of one gyroscope each, joined by time."""

from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.errors import DataError, OptionError
from imulab.procedures.gyro_array.merge import merge_recordings
from imulab.readers.streams import one_clock
from imulab.recording import Recording


def motion(time):
    """A rate that no shift repeats, rad/s."""
    sines = [np.sin(2 * np.pi * f * time + p) for f, p in ((0.31, 0.2), (0.83, 1.1), (1.27, 2.5), (0.11, 0.4))]
    return np.sum(sines, axis=0) * np.exp(-(((time - 20) / 8) ** 2))


def gyro(start, stop, rate, *, late=0.0, unit="rad/s", noise=0.0, seed=1, name="gyro_z", sign=1.0):
    """One gyroscope; `late`: what its clock shows later."""
    time = start + np.arange(round((stop - start) * rate)) / rate
    rng = np.random.default_rng(seed)
    values = sign * motion(time) + noise * rng.standard_normal(len(time))
    if unit == "deg/s":
        values = np.degrees(values)
    return Recording(columns={"time": time + late, name: values}, units={"time": "s", name: unit}, name=f"{seed}.csv")


def save(folder, *recordings):
    names = []
    for number, recording in enumerate(recordings, start=1):
        names.append(f"g{number}.csv")
        il.write_csv(recording, folder / names[-1])
    return names


def test_joined_on_the_first_within_the_overlap_in_one_unit(imulab, tmp_path):
    files = save(tmp_path, gyro(0, 40, 100), gyro(2.003, 41, 250, unit="deg/s"), gyro(-3, 35.5, 190, sign=-1))
    done = imulab("array", "merge", *files, "-o", "array.csv")
    assert done.returncode == 0, done.stderr
    assert "g2.csv: 250 Hz interpolated to the times of the first file, 100 Hz" in done.stderr
    array = il.read(tmp_path / "array.csv")
    time = array.columns["time"]
    assert list(array.columns) == ["time", "gyro_1", "gyro_2", "gyro_3"]
    assert set(array.units.values()) == {"s", "rad/s"}
    assert 2.003 <= time[0] < 2.013
    assert 35.48 < time[-1] <= 35.5
    # Linear interpolation is off by at most step^2/8 of the second derivative: (2 pi 1.3)^2 * 4 / 8 / 190^2 = 1e-3.
    np.testing.assert_array_equal(array.columns["gyro_1"], motion(time))
    np.testing.assert_allclose(array.columns["gyro_2"], motion(time), atol=1e-3)
    np.testing.assert_allclose(array.columns["gyro_3"], -motion(time), atol=1e-3)
    assert array.metadata["element_2"] == "g2.csv"
    assert merge_recordings([il.read(tmp_path / file) for file in files]).recording.from_file
    assert imulab("array", "fuse", "array.csv", "-o", "rate.csv").returncode == 0


def test_no_reading_is_made_up_across_a_gap():
    second = gyro(0, 40, 200, seed=2)
    kept = (second.columns["time"] < 10) | (second.columns["time"] >= 11)
    second = Recording(
        columns={name: values[kept] for name, values in second.columns.items()}, units=second.units, name="2.csv"
    )
    array = merge_recordings([gyro(0, 40, 100), second]).recording
    gap = (array.columns["time"] > 9.995) & (array.columns["time"] < 11)
    np.testing.assert_array_equal(np.isnan(array.columns["gyro_2"]), gap)


def test_triads_and_one_axis_of_them():
    def triad(seed):
        rng = np.random.default_rng(seed)
        columns = {"time": np.arange(50) / 100, **{f"gyro_{axis}": rng.normal(size=50) for axis in "xyz"}}
        return Recording(columns=columns, units={"time": "s", **dict.fromkeys(list(columns)[1:], "deg/s")})

    both = [triad(1), triad(2)]
    array = merge_recordings(both).recording
    assert list(array.columns)[1:] == [f"gyro_{axis}_{i}" for i in (1, 2) for axis in "xyz"]
    np.testing.assert_array_equal(array.columns["gyro_y_2"], both[1].columns["gyro_y"])
    array = merge_recordings(both, axis="y").recording
    assert list(array.columns) == ["time", "gyro_1", "gyro_2"]
    np.testing.assert_array_equal(array.columns["gyro_2"], both[1].columns["gyro_y"])


@pytest.mark.parametrize("late", [0.7312, -412.25])
def test_clocks_that_began_apart_are_said_and_moved(late):
    first, second = gyro(0, 40, 100, noise=0.02), gyro(5, 38, 250, late=late, noise=0.02, seed=2, sign=-1)
    if abs(late) < 10:
        notes = merge_recordings([first, second]).notes
        assert any("2.csv: its motion comes 0.73" in note and "--align moves it" in note for note in notes), notes
    else:
        with pytest.raises(DataError, match=r"no time in common with 1\.csv"):
            merge_recordings([first, second])
    array = merge_recordings([first, second], align=True).recording
    time = array.columns["time"]
    brisk = np.abs(time - 20) < 8
    # 2 ms of error at a slope of some 12 rad/s^2 would be 0.024 rad/s rms or more.
    assert np.std((array.columns["gyro_2"] + motion(time))[brisk]) < 0.03


def test_a_motion_that_repeats_or_rest_gives_no_offset():
    time = np.arange(4000) / 100
    for values in (np.sin(2 * np.pi * time), np.zeros(4000)):
        first, second = (
            Recording(
                columns={
                    "time": time + late,
                    "gyro": values + np.random.default_rng(seed).normal(size=4000, scale=0.1),
                },
                units={"time": "s", "gyro": "rad/s"},
                name=name,
            )
            for seed, late, name in ((1, 0, "a.csv"), (2, 0.25, "b.csv"))
        )
        assert not any("its motion comes" in note for note in merge_recordings([first, second]).notes)
        with pytest.raises(DataError, match=r"b\.csv: --align: found no motion that fits a\.csv"):
            merge_recordings([first, second], align=True)


@pytest.mark.parametrize("jumps", [(), (700, 1300)])
def test_readings_that_hardly_change_have_no_offset(imulab, tmp_path, jumps):
    """A dead gyroscope, and one whose last digit changes at rest."""
    for name, later in (("a.csv", 0), ("b.csv", 40)):
        rate = np.full(2000, 0.5)
        for jump in jumps:
            rate[jump + later] += 0.01
        columns = {"time": np.arange(2000) / 100, "gyro": rate}
        il.write_csv(
            Recording(columns=columns, units={"time": "s", "gyro": "deg/s"}, metadata={"serial": name}), tmp_path / name
        )
    done = imulab("array", "merge", "a.csv", "b.csv", "-o", "array.csv")
    assert (done.returncode, done.stderr) == (0, "")
    done = imulab("array", "merge", "a.csv", "b.csv", "--align", "-o", "moved.csv")
    assert done.returncode == 2
    assert done.stderr == "imulab: b.csv: --align: found no motion that fits a.csv at one offset of time only\n"


def test_the_head_holds_what_all_agree_on_and_the_serial_of_each():
    heads = (
        {"serial": "A1", "model": "G9", "board": "7", "truth_bias": "0.1"},
        {"serial": "A2", "model": "G8", "board": "7", "truth_bias": "0.1"},
        {"board": "7", "truth_bias": "0.1"},
    )
    alone = [replace(gyro(0, 10, 100, seed=i), metadata=head) for i, head in enumerate(heads, start=1)]
    assert merge_recordings(alone).recording.metadata == {
        "board": "7",
        "element_serials": "A1 A2 unknown",
        "element_1": "1.csv",
        "element_2": "2.csv",
        "element_3": "3.csv",
    }
    same = [replace(one, metadata={"serial": "BOARD 3"}) for one in alone]
    assert merge_recordings(same).recording.metadata["serial"] == "BOARD 3"


def test_how_far_the_times_differ_is_said():
    first, second = gyro(0, 10, 100), gyro(0.003, 10, 100, seed=2)
    (said,) = merge_recordings([first, second]).notes
    assert said == (
        "2.csv: 100 Hz interpolated to the times of the first file, 100 Hz, "
        "which lie up to 0.003 s from its own samples"
    )
    assert merge_recordings([first, gyro(0, 10, 100, seed=2)]).notes == ()


def test_refusals_name_the_file(imulab, tmp_path):
    files = save(tmp_path, gyro(0, 10, 100), gyro(20, 30, 100), gyro(0, 10, 100, unit="count", name="gyro"))
    accel = Recording(columns={"time": np.arange(9.0), "accel_x": np.ones(9)}, units={"time": "s", "accel_x": "g"})
    il.write_csv(accel, tmp_path / "accel.csv")
    (tmp_path / "copy.csv").write_bytes((tmp_path / files[0]).read_bytes())
    for arguments, message in (
        ((files[0],), "expected 2 to 64 recordings, a gyroscope each, found 1"),
        ((files[0], files[1]), "g2.csv: 20 to 29.99 s, no time in common with g1.csv, 0 to 9.99 s"),
        ((files[0], files[0]), "g1.csv: given twice; expected a file for each gyroscope"),
        ((files[0], "copy.csv"), "copy.csv: the same file as g1.csv"),
        ((files[0], "accel.csv"), "accel.csv: no gyroscope; expected gyro_x gyro_y gyro_z or one column gyro"),
        ((files[0], "accel.csv", "--axis", "z"), "accel.csv: no column gyro_z; found time accel_x"),
        ((files[0], files[2]), "g3.csv: column gyro: cannot convert count (output) to rad/s (rate), the unit of g1"),
        ((files[0], files[1], "--axis", "w"), "--axis 'w': expected x, y or z"),
        ((files[0], files[1], "--column", "gyro_z", "--axis", "z"), "expected one of them"),
    ):
        done = imulab("array", "merge", *arguments, "-o", "out.csv")
        assert done.returncode == 2
        assert message in done.stderr
        assert done.stderr.count("\n") == 1
        assert not (tmp_path / "out.csv").exists()


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


def test_sensors_of_their_own_keep_their_clocks_and_come_to_one(nine):
    accel, gyro, mag = parts(nine)
    kept = il.join_recordings(accel, [gyro, mag])
    for sensor, part in (("accel", accel), ("gyro", gyro), ("mag", mag)):
        own = kept.stream(sensor)
        np.testing.assert_allclose(own.time, part.time, atol=1e-9)
        np.testing.assert_array_equal(own.triad(sensor), part.triad(sensor))
    joined = one_clock(kept, "accel")
    rows = slice(1, None)  # before the first sample of the gyroscopes
    np.testing.assert_allclose(joined.time, nine.time[rows], atol=1e-9)
    np.testing.assert_array_equal(joined.triad("accel"), nine.triad("accel")[rows])
    for axis in "xyz":
        expected = np.interp(nine.time[rows], gyro.time, gyro.column(f"gyro_{axis}"))
        np.testing.assert_allclose(joined.column(f"gyro_{axis}"), expected, atol=1e-4)
    expected = np.full_like(nine.triad("mag"), np.nan)
    expected[2::5] = nine.triad("mag")[2::5]
    np.testing.assert_array_equal(joined.triad("mag"), expected[rows])
    assert joined.metadata == {"serial": "7", "resampled": "gyro from 100 Hz to 100 Hz"}
    said = " ".join(joined.notes)
    assert "gyroscope (100 Hz) interpolated to the clock of the accelerometer (100 Hz)" in said
    assert "magnetometer (20 Hz) not interpolated" in said


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
    found = il.read(tmp_path / "nine.csv")
    np.testing.assert_array_equal(found.triad("accel"), nine.triad("accel"))
    np.testing.assert_allclose(np.degrees(found.triad("gyro")), nine.triad("gyro"), rtol=1e-12)
    own = found.stream("mag")
    np.testing.assert_array_equal(own.triad("mag"), nine.triad("mag")[::3])
    np.testing.assert_allclose(own.time, times[::3], atol=1e-9)
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

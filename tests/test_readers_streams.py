"""Sensors with clocks of their own in one recording: read, written, shown, and used without interpolation."""

from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.errors import DataError
from imulab.procedures.noise.figures import exhibits
from imulab.readers.streams import one_clock

G = 9.81362
WHITE = 0.002  # rad/s, standard deviation of a sample of the gyroscopes
RATE = 400.0
RANDOM_WALK = np.degrees(WHITE / np.sqrt(RATE)) * 60  # deg/sqrt(h)


def at_rest(seconds=60.0, seed=83, accel_rate=100.0):
    """Accelerometers at 100 Hz, gyroscopes at 400 Hz from 1.25 ms later on; white noise."""
    rng = np.random.default_rng(seed)
    slow, fast = np.arange(0, seconds, 1 / accel_rate), np.arange(0, seconds, 1 / RATE) + 1.25e-3
    return il.Recording.from_arrays(
        accel=[0, -9.7, 0.3] + 0.02 * rng.normal(size=(len(slow), 3)),
        time=slow,
        gyro=WHITE * rng.normal(size=(len(fast), 3)),
        time_gyro=fast,
        units={"accel": "m/s^2", "gyro": "rad/s"},
        name="rest.csv",
    )


def two_clocks(recording, every=4):
    """A recording of one clock, of which the accelerometers' samples are every fourth."""
    columns = {}
    for name, values in recording.columns.items():
        if name.startswith("gyro"):
            columns.setdefault("time_gyro", recording.time)
            columns[name] = values
        elif not name.startswith("truth"):
            part = values[::every]
            columns[name] = np.concatenate([part, np.full(len(values) - len(part), np.nan)])
    units = {**recording.units, "time_gyro": "s"}
    return replace(recording, columns=columns, units={name: units[name] for name in columns})


def test_a_recording_knows_the_clock_of_each_column():
    recording = at_rest(1.0)
    assert recording.clocks == {
        "time": ["accel_x", "accel_y", "accel_z"],
        "time_gyro": ["gyro_x", "gyro_y", "gyro_z"],
    }
    assert [len(recording.stream(name)) for name in ("accel", "gyro", "time_gyro", "time")] == [100, 400, 400, 100]
    assert recording.stream("gyro").time[0] == 1.25e-3
    assert len(recording) == 400
    assert np.isnan(recording.column("accel_x")[100:]).all()
    array = il.simulate_array(experiment="static", duration=2.0)
    assert list(array.clocks) == ["time"]


def test_a_sensor_alone_with_a_clock_of_its_own_has_a_time():
    recording = at_rest(20.0)
    alone = il.Recording(
        {name: values for name, values in recording.columns.items() if "gyro" in name},
        {name: unit for name, unit in recording.units.items() if "gyro" in name},
    )
    assert alone.time is None
    assert one_clock(alone).time[1] == pytest.approx(3.75e-3)
    assert il.fit_noise(alone, terms="N").calibration.fit["sample_rate"]["value"] == pytest.approx(RATE)


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_files_keep_the_clocks(tmp_path, monkeypatch, ending):
    monkeypatch.chdir(tmp_path)
    recording = at_rest(3.0)
    il.write(recording, f"own.{ending}")
    again = il.read(f"own.{ending}")
    assert again.clocks == recording.clocks
    for name, values in recording.columns.items():
        np.testing.assert_array_equal(again.column(name), values)
    part = il.read(f"own.{ending}", window=(1.0, 2.0))
    assert [len(part.stream(name)) for name in ("accel", "gyro")] == [101, 400]
    assert np.isfinite(part.stream("gyro").triad("gyro")).all()


def test_padding_may_stand_between_blocks(tmp_path):
    recording = at_rest(3.0)
    parts = []
    for start in (0.0, 1.0, 2.0):
        block = il.readers.selection.windowed(iter([recording]), (start, start + 0.9999), "rest.csv")
        parts += list(block)
    il.write(parts, tmp_path / "blocks.csv")
    again = il.read(tmp_path / "blocks.csv")
    for name, values in recording.columns.items():
        np.testing.assert_array_equal(again.column(name), values)


@pytest.mark.slow
def test_noise_is_that_of_the_samples_and_not_of_their_interpolation():
    """The gyroscopes' angle random walk was .68 deg/sqrt(h) where .34 is true, and the verdict good."""
    off = []
    for seed in range(6):
        recording = at_rest(seed=seed)
        record = il.fit_noise(recording, terms="N").calibration
        for axis in "xyz":
            parameter = record.parameters[f"gyro_{axis}_white"]
            true = WHITE / np.sqrt(RATE)
            off.append((parameter.value - true) / parameter.standard_uncertainty)
            assert abs(parameter.value / true - 1) < 0.05
            assert record.fit["columns"][f"gyro_{axis}"]["interval"]["value"] == pytest.approx(1 / RATE)
            assert record.fit["columns"][f"accel_{axis}"]["interval"]["value"] == pytest.approx(0.01)
    assert np.mean(np.abs(off) < 1.96) > 0.7
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.6
    curve = il.allan_deviation(recording, column="gyro_x")
    assert np.degrees(curve.coefficients.angle_random_walk.value) * 60 == pytest.approx(RANDOM_WALK, rel=0.05)
    assert curve.tau[0] == pytest.approx(1 / RATE)


def test_commands_show_each_clock_and_resample_only_when_asked(tmp_path, imulab):
    il.write(at_rest(), tmp_path / "own.csv")
    shown = imulab("show", "own.csv").stdout
    assert "time (accel_x accel_y accel_z): 6000 samples" in shown
    assert "time_gyro (gyro_x gyro_y gyro_z): 24000 samples" in shown
    allan = imulab("allan", "own.csv").stdout
    assert "6000 samples at 100 Hz (accel_x accel_y accel_z), 24000 samples at 400 Hz (gyro_x gyro_y gyro_z)" in allan
    done = imulab("convert", "own.csv", "--one-clock", "-o", "one.csv")
    assert "accelerometer (100 Hz) interpolated to the clock of the gyroscope (400 Hz)" in done.stderr
    assert (tmp_path / "one.csv").read_text().startswith("# resampled: accel from 100 Hz to 400 Hz\n")
    for command in (("noise", "fit"), ("allan",)):
        done = imulab(*command, "one.csv")
        assert done.returncode == 2
        assert "accel_x accel_y accel_z: resampled from 100 Hz to 400 Hz, which changes the noise" in done.stderr
    assert imulab("noise", "fit", "one.csv", "--columns", "gyro_x").returncode == 0
    with pytest.raises(DataError, match="resampled from 100 Hz to 400 Hz"):
        il.allan_deviation(il.read(tmp_path / "one.csv"), column="accel_x")


def test_with_joins_files_of_two_rates_without_touching_a_sample(tmp_path, imulab):
    recording = at_rest(3.0)
    il.write(recording.stream("accel"), tmp_path / "accel.csv")
    il.write(recording.stream("gyro"), tmp_path / "gyro.csv")
    assert imulab("convert", "accel.csv", "--with", "gyro.csv", "-o", "own.csv").returncode == 0
    again = il.read(tmp_path / "own.csv")
    for sensor in ("accel", "gyro"):
        np.testing.assert_array_equal(again.stream(sensor).triad(sensor), recording.stream(sensor).triad(sensor))


def test_units_and_a_window_are_stated_for_all_files_that_are_joined(tmp_path, imulab):
    recording = at_rest(3.0)
    for sensor in ("accel", "gyro"):
        il.write(recording.stream(sensor), tmp_path / f"{sensor}.csv")
    both = ("convert", "accel.csv", "--with", "gyro.csv", "-o", "own.csv")
    assert imulab(*both, "--unit", "accel=g,gyro_x=deg/s", "--window", "+1:+2").returncode == 0
    joined = il.read(tmp_path / "own.csv")
    assert [joined.units[name] for name in ("accel_z", "gyro_x", "gyro_y")] == ["g", "deg/s", "rad/s"]
    for sensor in ("accel", "gyro"):
        part, known = joined.stream(sensor), recording.stream(sensor)
        inside = (known.time >= 1) & (known.time <= 2)
        np.testing.assert_array_equal(part.triad(sensor), known.triad(sensor)[inside])
    (tmp_path / "own.csv").unlink()
    done = imulab(*both, "--unit", "accel=g,mag=uT")
    assert (done.returncode, done.stderr) == (2, "imulab: --unit mag: no such column in accel.csv, gyro.csv\n")
    assert not (tmp_path / "own.csv").exists()


@pytest.mark.parametrize(("clock", "late"), [("2024-12-31T23:59:59.{:03}Z", 0.253), ("23:59:59.{:03}", 0.253)])
def test_files_with_dates_of_their_own_are_joined_by_them(tmp_path, clock, late):
    """A second of each sensor, the gyroscope's a quarter of a second later."""
    for name, first in (("accel", 0), ("gyro", 1000 * late)):
        rows = "".join(f"{clock.format(round(first + 10 * k))},{k},0,1\n" for k in range(70))
        (tmp_path / f"{name}.csv").write_text(rows)
        axes = "".join(
            f'{name}_{axis} = {{ from = {k}, unit = "{unit}" }}\n'
            for k, axis, unit in zip((1, 2, 3), "xyz", ["g" if name == "accel" else "deg/s"] * 3, strict=True)
        )
        (tmp_path / f"{name}.toml").write_text(
            f'delimiter = ","\n[columns]\ntime = {{ from = 0, unit = "iso" }}\n{axes}'
        )
    accel, gyro = (il.read(tmp_path / f"{name}.csv", tmp_path / f"{name}.toml") for name in ("accel", "gyro"))
    joined = il.join_recordings(accel, [gyro])
    times = joined.stream("gyro").time
    np.testing.assert_allclose(times, late + gyro.time, atol=2e-9)
    assert any(f"begins {late} s after" in note for note in joined.notes)
    backwards = il.join_recordings(gyro, [accel])
    np.testing.assert_allclose(backwards.stream("accel").time, accel.time - late, atol=2e-9)


def test_files_whose_readings_share_stamps_are_joined(tmp_path):
    recording = at_rest(3.0)
    accel, gyro = (recording.stream(sensor) for sensor in ("accel", "gyro"))
    coarse = gyro.with_columns({"time": np.floor(gyro.time / 0.01 + 1e-9) * 0.01}, {})
    joined = il.join_recordings(accel, [coarse])
    np.testing.assert_array_equal(joined.stream("gyro").triad("gyro"), gyro.triad("gyro"))
    assert any("share time stamps" in note for note in joined.notes)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.slow
def test_gyroscopes_are_calibrated_by_all_their_samples(seed):
    """As on one clock at the full rate, within what a quarter of the accelerometers' samples may move them."""
    recording = il.simulate_tumble(gravity=G, rate=RATE, order=1, seed=seed)
    own = two_clocks(recording)
    whole = il.fit_tumble(recording, order=1, gravity=G, with_=["gyro"]).calibration
    record = il.fit_tumble(own, order=1, gravity=G, with_=["gyro"]).calibration
    alone = il.fit_gyro(il.fit_tumble(own, order=1, gravity=G), own).calibration
    for axis in "xyz":
        for name in (f"gyro_scale_factor_{axis}", f"gyro_bias_{axis}"):
            mine = record.parameters[name]
            assert mine.value == alone.parameters[name].value
            assert abs(mine.value - whole.parameters[name].value) < 1.5 * mine.standard_uncertainty
            assert abs(mine.value - float(recording.metadata[f"truth_{name}"])) < 4 * mine.standard_uncertainty
            assert mine.standard_uncertainty < 1.3 * whole.parameters[name].standard_uncertainty


@pytest.mark.slow
def test_thermal_gyroscopes_are_calibrated_on_their_clock():
    recordings = il.simulate_thermal("0,20,40", attitudes=12, gyro=True)
    own = [two_clocks(each, every=1) for each in recordings]
    assert all(len(each.clocks) == 2 for each in own)
    whole, record = (il.fit_thermal(each, with_=["gyro"]).calibration for each in (recordings, own))
    for name, parameter in whole.parameters.items():
        assert record.parameters[name].value == pytest.approx(parameter.value, rel=1e-9, abs=1e-12)


def test_a_recording_of_two_clocks_shows_itself():
    recording = at_rest(20.0)
    assert "8000 samples over 19.99 s" in recording._repr_html_()
    accel, gyro = (recording.plot(name) for name in ("accel", "gyro"))
    assert len(recording.plot()) == 2
    assert accel.figure.traces[0]["x"][-1] == pytest.approx(19.99, abs=0.1)
    assert gyro.figure.traces[0]["x"][0] == pytest.approx(1.25e-3, abs=0.05)
    assert il.Recording.from_frame(recording.to_frame()).clocks == recording.clocks


def test_one_clock_is_the_fastest_and_apply_says_what_it_interpolated(tmp_path, imulab):
    recording = at_rest(3.0)
    joined = one_clock(recording)
    assert len(joined) == pytest.approx(1190, abs=12)
    assert "time_gyro" not in joined
    tumble = il.simulate_tumble(gravity=G, rate=RATE, order=1)
    record = il.fit_tumble(tumble, order=1, gravity=G)
    record.save(tmp_path / "r.json")
    il.write(two_clocks(tumble), tmp_path / "own.csv")
    done = imulab("apply", "r.json", "own.csv", "-o", "out.csv")
    assert done.returncode == 0
    assert "imulab: note: own.csv: resampled: accel from 100 Hz to 400 Hz" in done.stderr
    corrected = il.read(tmp_path / "out.csv")
    assert corrected.metadata["resampled"] == "accel from 100 Hz to 400 Hz"
    expected = np.interp(corrected.time, tumble.time[::4], tumble.column("truth_accel_x")[::4])
    assert abs(np.mean(corrected.column("accel_x") - expected)) < 0.01


def test_clocks_that_cannot_be_are_refused_by_name():
    recording = at_rest(3.0)
    later = recording.with_columns({"time_gyro": recording.column("time_gyro") + 100.0}, {})
    with pytest.raises(il.ImulabError, match="the gyroscope and the accelerometer have no time in common"):
        one_clock(later)
    back = recording.column("time_gyro").copy()
    back[200:] -= 0.2
    with pytest.raises(DataError, match="time runs backwards"):
        il.fit_noise(recording.with_columns({"time_gyro": back}, {}), columns=["gyro_x"])
    with pytest.raises(DataError, match="time_gyro has 300 rows, gyro_x has 1200: expected as many"):
        il.Recording.from_arrays(gyro=np.zeros((1200, 3)), time_gyro=np.arange(300.0), unit="deg/s", name="arrays")


def test_a_report_names_the_rate_of_each_sensor():
    page = il.fit_noise(at_rest(20.0), terms="N").calibration
    assert ("sampling rate", "accel 100 Hz, gyro 400 Hz") in exhibits(page).facts


def test_sensors_in_a_file_each_are_told_how_to_be_joined(tmp_path, imulab):
    recording = at_rest(20.0)
    il.write(recording.stream("accel"), tmp_path / "a.csv")
    il.write(recording.stream("gyro"), tmp_path / "g.csv")
    done = imulab("noise", "fit", "a.csv", "g.csv")
    assert done.returncode == 2
    assert done.stderr == (
        "imulab: g.csv: no sensor of a.csv in it; sensors of one unit in a file each are joined by "
        "imulab convert a.csv --with g.csv -o both.csv\n"
    )

"""Layouts guessed from titles: from heads of the shipped layouts, which are taken away, and from titles in use."""

import json

import numpy as np
import pytest

import imulab as il
from imulab.errors import ReadError
from imulab.readers import guess, shipped
from imulab.readers.guess import LayoutGuess
from imulab.readers.layout import load_layout
from imulab.readers.titles import read_title
from test_readers_shipped import FILES

G = 9.80665
REFUSED = {"kitti-oxts", "motioncal", "movella-dot", "movella-dot-mag", "sensorlogger-accel", "sensorlogger-gyro"}
"""Layouts whose heads hold no titles, or no unit of a sensor in titles or in readings that are random."""
LATER = {"fusion", "fusion-mag", "gcsv", "gcsv-gyro", "kalibr", "mt-manager", "mt-manager-mag", "picoquake", "shimmer"}
LATER |= {"actigraph", "actigraph-us", "witmotion", "ulog2csv", "ulog2csv-accel", "ulog2csv-gyro"}
"""Layouts that came after the 27 by which the guess is measured."""


def written(path, titles, columns, delimiter=",", more=""):
    rows = "".join(delimiter.join(f"{x:.6g}" for x in row) + "\n" for row in zip(*columns, strict=True))
    path.write_text(f"{titles}\n{more}{rows}", encoding="utf-8")
    return path


def tilting(rows=2000, rate=100.0):
    """Time, specific force in m/s^2 and rates in rad/s of a body that turns about two axes, integrated here."""
    t = np.arange(rows) / rate
    w = np.column_stack([0.8 * np.sin(0.7 * t), 0.6 * np.cos(0.5 * t), 0.05 * np.ones(rows)])
    up = np.array([0.0, 0.0, 1.0])
    f = []
    for row in w:
        f.append(up * G)
        angle = np.linalg.norm(row) / rate
        axis = row / np.linalg.norm(row)
        up = up * np.cos(angle) - np.cross(axis, up) * np.sin(angle) + axis * (axis @ up) * (1 - np.cos(angle))
    return t, np.array(f), w


def test_heads_of_the_shipped_layouts_without_them(tmp_path, monkeypatch):
    """At least 20 of 27 are right, and where one is not, it is refused."""
    monkeypatch.setattr(guess, "advice", lambda head: "")
    right = set()
    for name, make in FILES.items():
        if name in LATER:
            continue
        path = tmp_path / f"{name}.csv"
        path.write_bytes(make().encode())
        if name in REFUSED:
            with pytest.raises(ReadError):
                il.guess_layout(path)
            continue
        found = il.read(path, il.guess_layout(path).layout)
        expected = il.read(path, name)
        for column in expected.columns:
            assert found.units[column] == expected.units[column], (name, column)
            np.testing.assert_array_equal(found.columns[column], expected.columns[column])
        right.add(name)
    assert len(right) >= 20
    assert len(right | REFUSED) == 27
    assert {entry.name for entry in shipped.shipped()} == right | REFUSED | LATER


@pytest.mark.parametrize(
    ("title", "sensor", "axis", "unit"),
    [
        ("Accelerometer X (g)", "accel", 0, "g"),
        ("a_x", "accel", 0, ""),
        ("az", "accel", 2, ""),
        ("Acc_Y", "accel", 1, ""),
        ("ACCX", "accel", 0, ""),
        ("accX_g", "accel", 0, "g"),
        ("acc_x_mps2", "accel", 0, "m/s^2"),
        ("AccX(m/s/s)", "accel", 0, "m/s^2"),
        ("accelerometer_m_s2[2]", "accel", 2, "m/s^2"),
        ("linear_acceleration.y", "accel", 1, ""),
        ("xacc", "accel", 0, ""),
        ("gx", "gyro", 0, ""),
        ("imu_gx", "gyro", 0, ""),
        ("raw_gz", "gyro", 2, ""),
        ("imu_g_y", "gyro", 1, ""),
        ("ax_g", "accel", 0, "g"),
        ("GyroX(deg/s)", "gyro", 0, "deg/s"),
        ("gyroADC[0]", "gyro", 0, "count"),
        ("gyro_rad[1]", "gyro", 1, "rad/s"),
        ("AsX(°/s)", "gyro", 0, "deg/s"),
        ("angular_velocity.x", "gyro", 0, ""),
        ("omega_x", "gyro", 0, ""),
        ("w_RS_S_z [rad s^-1]", "gyro", 2, "rad/s"),
        ("UncalMagXMicroT", "mag", 0, "uT"),
        ("hx", "mag", 0, ""),
        ("MAGNETIC FIELD Z (μT)", "mag", 2, "uT"),
        ("DeltaAngle X (rad)", "gyro", 0, "rad"),
        ("dv_z [m/s]", "accel", 2, "m/s"),
        ("elapsedRealtimeNanos", "time", None, "ns"),
        ("Time since start in ms ", "time", None, "ms"),
        ("timestamp [ns]", "time", None, "ns"),
        ("T(°)", "temperature", None, "deg"),
        ("Temperature (°C)", "temperature", None, "degC"),
        ("PacketCounter", "counter", None, ""),
        ("AngleX(deg)", "", 0, "deg"),
        ("FreeAcc_X", "", 0, ""),
        ("BiasXMps2", "", 0, "m/s^2"),
        ("gx (g)", "accel", 0, "g"),
        ("axisP[0]", "", 0, ""),
        ("Absolute field (µT)", "", None, "uT"),
        ("Zeit (s)", "time", None, "s"),
        ("Zeitstempel", "time", None, ""),
        ("ts", "time", None, ""),
        ("Beschleunigung x (m/s^2)", "accel", 0, "m/s^2"),
    ],
)
def test_a_title_says_sensor_axis_and_unit(title, sensor, axis, unit):
    found = read_title(title)
    assert (found.sensor, found.axis, found.unit) == (sensor, axis, unit)
    assert found.increment == title.lower().startswith(("delta", "dv"))


def test_units_that_titles_lack_are_told_by_the_readings_and_it_is_said(tmp_path):
    t, f, w = tilting()
    for factor, accel in ((1.0, "m/s^2"), (1 / G, "g"), (1000 / G, "mg")):
        for turn, gyro in ((1.0, "rad/s"), (180 / np.pi, "deg/s")):
            path = written(tmp_path / "f.csv", "t,ax,ay,az,gx,gy,gz", [1000 * t, *(f * factor).T, *(w * turn).T])
            found = il.guess_layout(path)
            read = il.read(path, found.layout)
            assert (read.units["accel_x"], read.units["gyro_x"]) == (accel, gyro)
            assert read.time[1] == pytest.approx(0.01)
            assert len(found.supposed) == 3
            assert found.toml.count("no unit in the title") == 7


def turned_by_hand(real_data):
    """Specific force and rates of real recordings with hands in them, at 100 Hz or so, and the unit of the rates."""
    imucal = np.genfromtxt(real_data / "imucal" / "example_ferraris_session.csv", delimiter=",", skip_header=1)
    yield imucal[:, 4:7], imucal[:, 1:4], "deg/s"
    for name in ("imu0.log", "imu1.log"):
        rows = np.loadtxt(real_data / "mpu9150" / name, max_rows=8000)
        yield rows[:, :3], rows[:, 3:6], "rad/s"


def test_that_axes_may_be_swapped_or_reversed_is_said(tmp_path):
    t, f, w = tilting()
    found = il.guess_layout(
        written(
            tmp_path / "f.csv", "t (s),ay (g),-ax (g),az (g),gx (deg/s),gy (deg/s),gz (deg/s)", [t, *(f / G).T, *w.T]
        )
    )
    assert found.toml.splitlines()[1].startswith(
        "# Axes and their directions are as the titles say: swapped or reversed ones "
    )
    assert 'accel_x = { from = "-ax (g)", unit = "g" }' in found.toml
    assert any(line.endswith("the minus of -ax (g) is not applied; scale = -1 applies it") for line in found.supposed)


def test_a_hand_s_turns_tell_the_unit_of_rates_and_other_columns_do_not(real_data, tmp_path):
    titles = "ax,ay,az,gx,gy,gz"
    per = {"rad/s": 1.0, "deg/s": np.pi / 180}
    for f, w, unit in turned_by_hand(real_data):
        for wanted in per:
            scaled = w * per[unit] / per[wanted]
            found = il.guess_layout(written(tmp_path / "f.csv", titles, [*f.T, *scaled.T]), sample_rate=100)
            assert il.read(tmp_path / "f.csv", found.layout).units["gyro_z"] == wanted
        for wrong in (-w, w[::-1], w[:, [1, 2, 0]]):
            path = written(tmp_path / "f.csv", titles, [*f.T, *wrong.T])
            with pytest.raises(ReadError, match="neither the title nor the readings say its unit"):
                il.guess_layout(path, sample_rate=100)


def test_a_rate_at_rest_has_no_unit_and_is_refused(imulab, tmp_path):
    rng = np.random.default_rng(4)
    t = np.arange(3000) / 100
    columns = [t, *(np.array([0, 0, G]) + rng.normal(0, 0.02, (3000, 3))).T, *rng.normal(0, 0.1, (3, 3000))]
    written(tmp_path / "f.csv", "Time,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z", columns)
    done = imulab("layout", "guess", "f.csv", "-o", "l.toml")
    assert done.returncode == 2
    assert not (tmp_path / "l.toml").exists()
    assert done.stderr == (
        "imulab: f.csv: column 'Gyr_X': neither the title nor the readings say its unit; --unit gyro=deg/s states it\n"
    )
    # What is refused without a layout ends with the command that helps, and that command works.
    refused = imulab("show", "f.csv")
    assert refused.returncode == 2
    assert refused.stderr.endswith(
        "; neither titles nor readings say the unit of gyro, deg/s is a guess"
        "; imulab layout guess f.csv --unit gyro=deg/s -o L.toml writes a layout for it (--layout L.toml)\n"
    )
    assert imulab("layout", "guess", "f.csv", "--unit", "gyro=deg/s", "-o", "L.toml").returncode == 0
    assert il.read(tmp_path / "f.csv", tmp_path / "L.toml").units["gyro_x"] == "deg/s"


def test_a_units_row_below_the_titles_and_a_line_that_names_the_separator(tmp_path):
    path = tmp_path / "f.csv"
    titles = "\t".join(["S1_Time_CAL", *(f"S1_{s}_{a}_CAL" for s in ("Accel_LN", "Gyro") for a in "XYZ")])
    units = "\t".join(["ms", *["m/(s^2)"] * 3, *["deg/s"] * 3])
    rows = "".join(f"{1e12 + 20 * k:.3f}\t0.1\t0.2\t9.8\t1\t2\t3\t\n" for k in range(20))
    path.write_text(f"sep=\t\n{titles}\t\n{units}\t\n{rows}")
    found = il.guess_layout(path)
    assert found.supposed == ()
    assert {c.unit for name, c in found.layout.columns.items() if name.startswith("accel")} == {"m/s^2"}
    assert found.layout.columns["gyro_z"].unit == "deg/s"
    assert found.layout.columns["time"].unit == "ms"


def test_calibrated_readings_go_before_raw_ones_and_what_is_left_is_named(tmp_path):
    titles = "Time (s),Acc RAW X,Acc RAW Y,Acc RAW Z,Acc CAL X (g),Acc CAL Y (g),Acc CAL Z (g)"
    rows = np.tile([0, 100, 200, 4096, 0.02, 0.05, 1.0], (20, 1))
    rows[:, 0] = np.arange(20) * 0.01
    found = il.guess_layout(written(tmp_path / "f.csv", titles, rows.T))
    assert found.layout.columns["accel_x"].origin == "Acc CAL X (g)"
    assert "# Not taken: Acc RAW X, Acc RAW Y, Acc RAW Z\n" in found.toml


def test_acceleration_without_gravity_is_not_taken(tmp_path):
    rng = np.random.default_rng(5)
    columns = [np.arange(50) * 0.01, *rng.normal(0, 0.02, (3, 50))]
    titles = "Time (s),Linear Acceleration x (m/s^2),Linear Acceleration y (m/s^2),Linear Acceleration z (m/s^2)"
    with pytest.raises(ReadError, match=r"'Linear Acceleration x \(m/s\^2\)' has no gravity in it, by which"):
        il.guess_layout(written(tmp_path / "f.csv", titles, columns))


def test_semicolons_with_decimal_commas_and_tabs(tmp_path):
    path = tmp_path / "f.csv"
    titles = ["Time (s)", *(f"Acceleration {axis} (m/s^2)" for axis in "xyz")]
    rows = [[f"{0.01 * k:.2f}", "0.10", "-0.25", "9.81"] for k in range(20)]
    for delimiter, comma in ((";", True), ("\t", True), ("\t", False), (";", False)):
        text = "\n".join(delimiter.join(row).replace(*((".", ",") if comma else ("", ""))) for row in rows)
        path.write_text(delimiter.join(titles) + "\n" + text + "\n")
        read = il.read(path, il.guess_layout(path).layout)
        assert read.columns["accel_z"][3] == 9.81
        assert read.units["time"] == "s"


def test_no_title_of_a_time_asks_for_the_rate(imulab, tmp_path):
    written(tmp_path / "f.csv", "ax,ay,az", np.tile([0.01, 0.02, 9.81], (20, 1)).T)
    done = imulab("layout", "guess", "f.csv")
    assert done.returncode == 2
    assert done.stderr.endswith("--sample-rate HZ states how many rows there are in a second\n")
    toml = imulab("layout", "guess", "f.csv", "--sample-rate", "50Hz").stdout
    (tmp_path / "l.toml").write_text(toml)
    assert il.read(tmp_path / "f.csv", load_layout(tmp_path / "l.toml")).time[-1] == 19 / 50


def test_increments_get_the_rate_of_the_clock(tmp_path):
    t = np.arange(50) / 125
    columns = [t, *np.tile([0.001, 0.002, -0.001], (50, 1)).T, *np.tile([0.0, 0.0, G / 125], (50, 1)).T]
    titles = "time (s),dAng X (rad),dAng Y (rad),dAng Z (rad),dVel X (m/s),dVel Y (m/s),dVel Z (m/s)"
    path = written(tmp_path / "f.csv", titles, columns)
    found = il.guess_layout(path)
    read = il.read(path, found.layout)
    assert read.units["gyro_x"] == "rad@125Hz"
    np.testing.assert_allclose(read.si("gyro_y"), 0.25, rtol=1e-12)
    np.testing.assert_allclose(read.si("accel_z"), G, rtol=1e-5)
    assert len(found.supposed) == 2


def test_files_that_need_no_layout_or_hold_no_text_are_refused(imulab, tmp_path):
    il.write(il.simulate_tumble(attitudes=8, hold="2 s"), tmp_path / "own.csv")
    (tmp_path / "b.bin").write_bytes(b"\0\1\2" * 900)
    (tmp_path / "words.csv").write_text("name,place\nA,B\n")
    for name, words in (
        ("own.csv", "titles with units, as imulab writes them; it needs no layout"),
        ("b.bin", "found binary data"),
        ("words.csv", "no line of titles names the axes of a sensor; the first is 'name,place'"),
        ("none.csv", "no such file"),
    ):
        done = imulab("layout", "guess", name)
        assert done.returncode == 2
        assert words in done.stderr
        assert done.stderr.count("\n") == 1
    done = imulab("layout", "guess", "words.csv", "-o", "l.csv")
    assert "expected a name that ends in .toml" in done.stderr


def test_the_guess_is_saved_and_shows_itself(imulab, tmp_path):
    path = tmp_path / "f.csv"
    path.write_bytes(FILES["x-imu3"]().encode())
    found = il.guess_layout(path)
    assert isinstance(found, LayoutGuess)
    assert repr(found) == found.toml == imulab("layout", "guess", "f.csv").stdout
    found.save(tmp_path / "l.toml")
    assert imulab("layout", "guess", "f.csv", "-o", "m.toml").stdout == "layout: m.toml\n"
    assert (tmp_path / "l.toml").read_bytes() == (tmp_path / "m.toml").read_bytes()
    assert imulab("show", "f.csv", "--layout", "m.toml").returncode == 0


def test_a_clock_without_a_unit_asks_for_it_and_takes_it(imulab, tmp_path):
    columns = [np.arange(20) * 1.0, *np.tile([0.01, 0.02, 9.81], (20, 1)).T]
    written(tmp_path / "f.csv", "Time,ax,ay,az", columns)
    done = imulab("layout", "guess", "f.csv")
    assert done.returncode == 2
    assert done.stderr.endswith("neither the title nor its steps say the unit of time; --unit time=ms states it\n")
    done = imulab("layout", "guess", "f.csv", "--unit", "time=ms,accel=m/s^2")
    assert 'time = { from = "Time", unit = "ms" }\n' in done.stdout
    assert "guess" not in done.stderr
    for wrong, words in (("gyro", "expected NAME=UNIT"), ("accel=gg", "unknown unit 'gg'")):
        done = imulab("layout", "guess", "f.csv", "--unit", wrong)
        assert done.returncode == 2
        assert done.stderr.startswith("imulab: --unit ")
        assert words in done.stderr


def test_dates_and_times_of_day_are_a_time(tmp_path):
    titles = "Timestamp,Accelerometer X (g),Accelerometer Y (g),Accelerometer Z (g)\n"
    path = tmp_path / "f.csv"
    for date, more in (
        ("2024-11-22 17:41:4{}", ""),
        ("17:41:4{}.000", ""),
        ("22/11/2024 17:41:4{}.000", ", day_first = true"),
        ("11/22/2024 17:41:4{}", ", day_first = false"),
    ):
        path.write_text(titles + "".join(f"{date.format(k)},0.1,0.2,0.9\n" for k in range(8)))
        found = il.guess_layout(path)
        assert f'time = {{ from = "Timestamp", unit = "iso"{more} }}\n' in found.toml
        assert il.read(path, found.layout).time.tolist() == list(range(8))
    path.write_text(titles + "".join(f"11/12/2024 17:41:4{k},0.1,0.2,0.9\n" for k in range(8)))
    with pytest.raises(ReadError, match="'11/12/2024 17:41:40' may be day or month first"):
        il.guess_layout(path)


def test_arrays_within_objects_and_flat_triples_alone(tmp_path):
    turned = 9.81 * np.array([[0.6, 0.0, 0.8], [0.8, 0.6, 0.0]] * 10)
    (tmp_path / "flat.json").write_text(json.dumps({"acc": turned.ravel().tolist(), "rate": 50}))
    inner = {"t": (np.arange(20) / 50).tolist(), "accel": turned.tolist()}
    (tmp_path / "inner.json").write_text(json.dumps({"meta": {"id": 7, "tags": ["a"]}, "log": inner}))
    for name, options in (("flat", {"sample_rate": 50.0}), ("inner", {})):
        found = il.guess_layout(tmp_path / f"{name}.json", **options)
        read = il.read(tmp_path / f"{name}.json", found.layout)
        np.testing.assert_allclose(read.triad("accel"), turned)
        assert (read.units["accel_z"], read.time[-1]) == ("m/s^2", pytest.approx(19 / 50))


def test_a_json_file_without_a_layout_names_the_command_that_writes_one(imulab, tmp_path):
    rows = [{"ts": k / 50, "acc": {"x": 0.0, "y": 0.1, "z": 9.8}} for k in range(30)]
    (tmp_path / "f.json").write_text(json.dumps(rows))
    done = imulab("show", "f.json")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    command = "imulab layout guess f.json -o L.toml"
    assert f"; {command} writes a layout for it (--layout L.toml)\n" in done.stderr
    assert imulab(*command.split()[1:]).returncode == 0
    assert "rate 50 Hz" in imulab("show", "f.json", "--layout", "L.toml").stdout


def test_a_refusal_to_guess_says_what_to_do(imulab, tmp_path):
    (tmp_path / "f.csv").write_text("t,fx,fy,fz\n0,1,2,3\n1,1,2,3\n")
    assert imulab("layout", "guess", "f.csv").stderr.endswith(
        "; a layout can be written by hand: imulab show --formats ends with an example\n"
    )


def test_native_titles_without_a_time_get_their_rate(imulab, tmp_path):
    (tmp_path / "f.csv").write_text("accel_x [g],accel_y [g],accel_z [g]\n" + "0,0,1\n0,0.1,1\n" * 10)
    assert "it needs no layout" in imulab("layout", "guess", "f.csv").stderr
    assert imulab("layout", "guess", "f.csv", "--sample-rate", "20Hz", "-o", "l.toml").returncode == 0
    found = il.read(tmp_path / "f.csv", tmp_path / "l.toml")
    assert (found.units["accel_x"], found.time[-1]) == ("g", pytest.approx(19 / 20))


@pytest.mark.parametrize(
    ("titles", "time"),
    [("ax,ay,az", 'from = 0, unit = "iso"'), ("millis,ax,ay,az", 'from = "millis", unit = "ms"')],
)
def test_the_times_of_a_serial_monitor(tmp_path, titles, time):
    rows = [f"23:59:{50 + k // 10:02}.{k % 10}00 -> " + ("" if titles[0] == "a" else f"{100 * k},") for k in range(90)]
    text = f"23:59:49.900 -> {titles}\n" + "".join(f"{row}0.1,{k}e-3,9.8\n" for k, row in enumerate(rows))
    (tmp_path / "f.txt").write_text(text)
    found = il.guess_layout(tmp_path / "f.txt")
    assert f"time = {{ {time} }}" in found.toml
    read = il.read(tmp_path / "f.txt", found.layout)
    np.testing.assert_allclose(read.time, np.arange(90) / 10, atol=1e-9)
    np.testing.assert_allclose(read.column("accel_y"), np.arange(90) * 1e-3)


def test_a_counter_that_begins_again_is_guessed_with_its_bits(tmp_path):
    counts = (2**32 - 1_000_000 + 20_000 * np.arange(200)) % 2**32
    rows = "".join(f"{count},0.1,0.2,9.8\n" for count in counts)
    (tmp_path / "f.csv").write_text(f"micros,ax,ay,az\n{rows}")
    found = il.guess_layout(tmp_path / "f.csv")
    assert 'time = { from = "micros", unit = "us", bits = 32 }' in found.toml
    np.testing.assert_allclose(np.diff(il.read(tmp_path / "f.csv", found.layout).time), 0.02, atol=1e-9)
    (tmp_path / "n.csv").write_text(f"time [us],accel_x [g],accel_y [g],accel_z [g]\n{rows}")
    with pytest.raises(
        il.ImulabError, match=r"found 0 us; a counter that began again at 2\^32: bits = 32 beside its unit"
    ):
        il.fit_tumble(tmp_path / "n.csv")


def test_dates_that_are_not_read_are_shown_and_points_have_the_day_first(tmp_path):
    for date, told in (("11-Dec-2024", None), ("11.12.2024", True)):
        rows = "".join(f"{date} 08:00:{k:02}.500,0.1,0.2,9.8\n" for k in range(50))
        (tmp_path / "f.csv").write_text(f"Timestamp,Acc X,Acc Y,Acc Z\n{rows}")
        if told:
            assert il.guess_layout(tmp_path / "f.csv").layout.columns["time"].day_first is True
            continue
        with pytest.raises(
            ReadError, match=r"found 'Timestamp', which holds '11-Dec-2024 08:00:00.500', no number and"
        ):
            il.guess_layout(tmp_path / "f.csv")


@pytest.mark.parametrize("depth", [900, 5000, 100_000])
def test_json_that_nests_deeply_is_refused_in_a_line(imulab, tmp_path, depth):
    (tmp_path / "deep.json").write_text('{"a":' * depth + "[1,2,3]" + "}" * depth)
    for command in (("layout", "guess"), ("show",)):
        done = imulab(*command, "deep.json")
        assert (done.returncode, done.stderr.count("\n")) == (2, 1)
        assert "internal" not in done.stderr


@pytest.mark.parametrize("rate", [0.0, -5.0, 1e-7, 1e10])
def test_a_rate_that_no_sensor_has_is_refused(tmp_path, rate):
    (tmp_path / "a.csv").write_text("a_x,a_y,a_z\n1,2,3\n2,3,4\n1,1,1\n", encoding="utf-8")
    with pytest.raises(ReadError, match=r"a\.csv: sample_rate: expected a number of Hz from"):
        il.guess_layout(tmp_path / "a.csv", units={"accel": "g"}, sample_rate=rate)


@pytest.mark.parametrize(
    ("text", "said"), [("", "the file is empty"), ("\n \n", "the file is empty"), ("# a\n", "only comments; expected")]
)
def test_a_file_without_titles_is_said_to_have_none(tmp_path, text, said):
    (tmp_path / "f.csv").write_text(text)
    with pytest.raises(guess.GuessError, match=f"f.csv: {said}"):
        il.guess_layout(tmp_path / "f.csv")

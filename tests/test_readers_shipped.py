"""Layouts that come with imulab: files in each format, made here from what is documented of it."""

import json
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.errors import ReadError
from imulab.readers.layout import shipped_file, shipped_names
from imulab.readers.shipped import fitting, shipped
from imulab.units import to_si

G = 9.80665
DOCS = Path(__file__).parent.parent / "docs"
ROWS = 5
TIME = np.arange(ROWS) * 0.01
ACCEL = np.random.default_rng(1).normal(0, 5, (ROWS, 3))
GYRO = np.random.default_rng(2).normal(0, 2, (ROWS, 3))
MAG = np.random.default_rng(3).normal(0, 30e-6, (ROWS, 3))  # T
RAW = np.column_stack([np.rint(ACCEL / G * 8192), np.rint(np.degrees(GYRO) * 16), np.rint(MAG * 1e7)]).astype(int)
CELSIUS = 20 + np.arange(ROWS) / 4


def lines(*columns, delimiter=",", before=""):
    """Rows of numbers; a column may be texts."""
    return "".join(f"{before}{delimiter.join(map(str, row))}\n" for row in zip(*columns, strict=True))


def stamps(factor, start=0):
    return [start + round(float(t) * factor) for t in TIME]


def euroc():
    titles = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    titles += "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\r\n"
    return titles + lines(stamps(1e9, 1403636579758555392), *GYRO.T, *ACCEL.T)


def blackbox(accel, gyro, units):
    acceleration, rotation = units
    titles = ["loopIteration", "time (us)", "axisP[0]", "vbatLatest (V)"]
    titles += [f"gyroADC[{i}]{rotation}" for i in range(3)] + [f"accSmooth[{i}]{acceleration}" for i in range(3)]
    head = ", ".join([*titles, "flightModeFlags (flags)", "stateFlags (flags)"]) + "\n"
    counts = [range(ROWS), stamps(1e6, 39_000_000), [-3] * ROWS, [15.82] * ROWS]
    return head + lines(*counts, *gyro.T, *accel.T, ["ANGLE_MODE|HORIZON_MODE"] * ROWS, ["0"] * ROWS, delimiter=", ")


def microstrain(*, mag=False):
    head = "FILE_INFO\nListSeparator=comma\nDecimalSeparator=period\n\nSESSION_INFO\nStartTime,02/10/2017 16:13:52\n\n"
    head += "DEVICE_INFO\nModelName,3DM-GX3-35\nSerialNumber,6225-01353\n\nDATA_START\n"
    head += "GPS TFlags,GPS Week,GPS TOW,Roll [x800C],X Accel [x8004],Y Accel [x8004],Z Accel [x8004],"
    head += "X Gyro [x8005],Y Gyro [x8005],Z Gyro [x8005],"
    head += "X Mag [x8006],Y Mag [x8006],Z Mag [x8006]," if mag else ""
    head += "Lat [x8103],Flags [x8103],Flags [x8108]\n"
    empty = [""] * ROWS
    week = [[5] * ROWS, [1969] * ROWS, 137649.863104 + TIME, [0.01] * ROWS]
    return head + lines(*week, *(ACCEL / G).T, *GYRO.T, *((MAG * 1e4).T if mag else ()), empty, empty, empty)


def movella(*, mag=False):
    head = (
        "sep=,\nDeviceTag:,bei\nFirmwareVersion:,1.6.0\nAppVersion:,2021.0\nStartTime: ,2021-08-30_17:05:05_000 GMT+8\n"
    )
    head += "© Xsens Technologies B. V. 2005-2021\n\n"
    head += "PacketCounter,SampleTimeFine,Euler_X,Euler_Y,Euler_Z,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z"
    head += ",Mag_X,Mag_Y,Mag_Z\n" if mag else "\n"
    euler = [[-179.9] * ROWS, [0.25] * ROWS, [-136.1] * ROWS]
    more = MAG.T if mag else ()
    return head + lines(range(ROWS), stamps(1e6, 2974023062), *euler, *ACCEL.T, *np.degrees(GYRO).T, *more)


def gnsslogger():
    head = "# \n# Header Description:\n# \n# Version: v3.0.6.4 Platform: 13 Manufacturer: Google Model: Pixel 6\n# \n"
    head += "# Raw,utcTimeMillis,TimeNanos,LeapSecond\n# \n"
    head += "# UncalAccel,utcTimeMillis,elapsedRealtimeNanos,UncalAccelXMps2,UncalAccelYMps2,UncalAccelZMps2,"
    head += "BiasXMps2,BiasYMps2,BiasZMps2\n# \n# UncalGyro,utcTimeMillis,elapsedRealtimeNanos,UncalGyroXRadPerSec,"
    head += "UncalGyroYRadPerSec,UncalGyroZRadPerSec,DriftXRadPerSec,DriftYRadPerSec,DriftZRadPerSec\n# \n"
    head += "# UncalMag,utcTimeMillis,elapsedRealtimeNanos,UncalMagXMicroT,UncalMagYMicroT,UncalMagZMicroT,"
    head += "BiasXMicroT,BiasYMicroT,BiasZMicroT\n# \n"
    head += "Fix,GPS,28.14,-82.29,-14.2,0.09,5.8,108.3,1663712656000,,,445420306913617,11.1,0\n"
    zero = [[0.0] * ROWS] * 3
    clocks = stamps(1e3, 1663164669190), stamps(1e9, 65972054923181)
    accel = lines(*clocks, *ACCEL.T, *zero, before="UncalAccel,").splitlines()
    gyro = lines(*clocks, *GYRO.T, *zero, before="UncalGyro,").splitlines()
    mag = lines(*clocks, *(MAG * 1e6).T, *zero, before="UncalMag,").splitlines()
    mixed = [line for together in zip(accel, gyro, mag, strict=True) for line in together]
    return head + "\n".join(mixed) + "\nRaw,1663707711608,32083712000000,18,,\n"


def flysight():
    head = "$FLYS,1\n$VAR,FIRMWARE_VER,v2023.09.22\n$COL,BARO,time,pressure,temperature\n$UNIT,BARO,s,Pa,deg C\n"
    head += "$COL,MAG,time,x,y,z,temperature\n$UNIT,MAG,s,gauss,gauss,gauss,deg C\n"
    head += "$COL,IMU,time,wx,wy,wz,ax,ay,az,temperature\n$UNIT,IMU,s,deg/s,deg/s,deg/s,g,g,g,deg C\n$DATA\n"
    imu = lines(TIME + 59970.376, *np.degrees(GYRO).T, *(ACCEL / G).T, CELSIUS, before="$IMU,").splitlines()
    mag = lines(TIME + 59970.376, *(MAG * 1e4).T, CELSIUS, before="$MAG,").splitlines()
    return head + "".join(f"{a}\n$BARO,59970.4,98123.1,25.1\n{b}\n" for a, b in zip(imu, mag, strict=True))


def kitti():
    dates = [f"2011-09-26T13:02:25.{nanoseconds:09d}" for nanoseconds in stamps(1e9, 900_000_000)]
    filler = [[0.5] * ROWS]
    return lines(dates, *filler * 11, *ACCEL.T, *filler * 3, *GYRO.T, *filler * 10, delimiter=" ")


def xyz(pattern):
    return [pattern.format(axis, axis.upper()) for axis in "xyz"]


def quoted(*titles):
    return ",".join(f'"{title}"' for title in titles) + "\n"


PHONE = "time,seconds_elapsed,z,y,x\n"


def androsensor(*, mag=False):
    titles = [*xyz("ACCELEROMETER {1} (m/s²)"), *xyz("GYROSCOPE {1} (rad/s)"), "Time since start in ms ", "DATE"]
    columns = [*ACCEL.T, *GYRO.T, stamps(1e3, 7), ["2014-05-07 10:12:15:123"] * ROWS]
    if mag:
        titles[6:6], columns[6:6] = xyz("MAGNETIC FIELD {1} (\u03bcT)"), list((MAG * 1e6).T)
    return ";".join(titles) + "\n" + lines(*columns, delimiter=";")


def motioncal():
    raw = lines(*RAW.T, before="Raw:").splitlines()
    more = "Uni:0.1,-0.2,9.8,0.01,0.0,-0.02,20.1,-3.0,41.2\n"
    return "Adafruit AHRS - IMU Calibration!\n" + "".join(f"{line}\r\n{more}" for line in raw)


def mt_manager(*, mag=False):
    head = (
        "// General information:\r\n//  MT Manager version: 4.6.0\r\n// Device information:\r\n//  DeviceId: 0378\r\n"
    )
    titles = ["PacketCounter", "SampleTimeFine", *xyz("Acc_{1}"), *xyz("Gyr_{1}"), *(xyz("Mag_{1}") if mag else ())]
    rows = [range(ROWS), stamps(1e4, 1234500), *ACCEL.T, *GYRO.T, *(MAG.T if mag else ())]
    return head + "\t".join(titles) + "\r\n" + lines(*rows, delimiter="\t")


def gcsv(*, accel=True):
    head = "GYROFLOW IMU LOG\nversion,1.3\nid,custom_logger_name\norientation,YxZ\nnote,development_test\n"
    head += "frame_readout_time,15.23\ntscale,0.001\ngscale,0.00122173047\n"
    head += "ascale,0.00048828125\nt,gx,gy,gz,ax,ay,az\n" if accel else "t,gx,gy,gz\n"
    counts = np.rint(GYRO / 0.00122173047).astype(int), np.rint(ACCEL / G / 0.00048828125).astype(int)
    return head + lines(stamps(1e3, 7), *counts[0].T, *(counts[1].T if accel else ()))


def shimmer():
    titles = ["S_A1_Timestamp_Unix_CAL", *xyz("S_A1_Accel_LN_{1}_CAL"), *xyz("S_A1_Gyro_{1}_CAL")]
    units = ["ms", *["m/(s^2)"] * 3, *["deg/s"] * 3]
    rows = lines(stamps(1e3, 1733938900000), *ACCEL.T, *np.degrees(GYRO).T, delimiter="\t").replace("\n", "\t\n")
    return "sep=\t\n" + "".join("\t".join(row) + "\t\n" for row in (titles, units)) + rows


def ulog2csv(sensor):
    readings = {"accel": ACCEL, "gyro": GYRO}[sensor]
    head = "timestamp,timestamp_sample,device_id,x,y,z,temperature,error_count,samples\n"
    same = [[one] * ROWS for one in (1310988, 0, 1)]
    return head + lines(stamps(1e6, 400), stamps(1e6, 100), same[0], *readings.T, CELSIUS, *same[1:])


def picoquake():
    head = "# PLab PicoQuake Data\n# Time: 2024-04-21 15:54:46.333682, Device: D4E9 (E6632891E36F2029)\n"
    head += f"# Num. samples: {ROWS}, Duration: 0.05 s\n"
    head += "# Config: sample_rate = 100.0 Hz, filter = 42 Hz, acc_range = 4 g, gyro_range = 250.0 dps\n"
    head += "# Integrity: True, Skipped samples: 0\ncount,a_x,a_y,a_z,g_x,g_y,g_z\n"
    return head + lines(range(ROWS), *(ACCEL / G).T, *np.degrees(GYRO).T)


def fusion(*, mag=False):
    titles = ["Time (s)", *xyz("Gyroscope {1} (deg/s)"), *xyz("Accelerometer {1} (g)")]
    titles += xyz("Magnetometer {1} (uT)") if mag else []
    return ",".join(titles) + "\n" + lines(TIME, *np.degrees(GYRO).T, *(ACCEL / G).T, *((MAG * 1e6).T if mag else ()))


def actigraph(date_format, pattern):
    head = f"------------ Data File Created By ActiGraph GT3X+ ActiLife v6.13.3 date format {date_format} at "
    head += "100 Hz  Filter Normal -----------\nSerial Number: SN0001\nStart Time 17:16:00\nStart Date 11/12/2024\n"
    head += (
        "Epoch Period (hh:mm:ss) 00:00:00\n"
        + "-" * 50
        + "\nTimestamp,Accelerometer X,Accelerometer Y,Accelerometer Z\n"
    )
    return head + lines([pattern.format(t) for t in stamps(1e3)], *(ACCEL / G).T)


def witmotion():
    titles = ["address", "Time(s)", "ChipTime", *xyz("a{0}(g)"), *xyz("w{0}(deg/s)"), "T(°)"]
    clock = [f" 23:59:59.{t:03d}" for t in stamps(1e3, 900)]
    chip = [f"2024-12-11 23:59:59.{t}" for t in stamps(1e3, 900)]
    rows = lines(["0x50"] * ROWS, clock, chip, *(ACCEL / G).T, *np.degrees(GYRO).T, CELSIUS, delimiter="\t")
    return "StartTime: 2024-12-11 17:41:40.000\n" + "\t".join(titles) + "\t\n" + rows.replace("\n", "\t\n")


FILES = {
    "actigraph": lambda: actigraph("dd/MM/yyyy", "11/12/2024 17:41:40.{:03d}"),
    "actigraph-us": lambda: actigraph("M/d/yyyy", "12/11/2024 17:41:40.{:03d}"),
    "witmotion": witmotion,
    "fusion": fusion,
    "fusion-mag": lambda: fusion(mag=True),
    "gcsv": gcsv,
    "gcsv-gyro": lambda: gcsv(accel=False),
    "kalibr": lambda: (
        ",".join(["timestamp", *xyz("omega_{0}"), *xyz("alpha_{0}")])
        + "\n"
        + lines(stamps(1e9, 1385030208736607488), *GYRO.T, *ACCEL.T)
    ),
    "mt-manager": mt_manager,
    "mt-manager-mag": lambda: mt_manager(mag=True),
    "picoquake": picoquake,
    "shimmer": shimmer,
    "ulog2csv": lambda: (
        ",".join(["timestamp", *(f"gyro_rad[{k}]" for k in range(3)), "gyro_integral_dt"])
        + ","
        + ",".join(["accelerometer_timestamp_relative", *(f"accelerometer_m_s2[{k}]" for k in range(3))])
        + "\n"
        + lines(stamps(1e6, 100), *GYRO.T, [4000] * ROWS, [0] * ROWS, *ACCEL.T)
    ),
    "ulog2csv-accel": lambda: ulog2csv("accel"),
    "ulog2csv-gyro": lambda: ulog2csv("gyro"),
    "androsensor": androsensor,
    "androsensor-mag": lambda: androsensor(mag=True),
    "betaflight": lambda: blackbox(ACCEL / G, np.degrees(GYRO), (" (g)", " (deg/s)")),
    "betaflight-raw": lambda: blackbox(ACCEL, GYRO, ("", "")),
    "euroc": euroc,
    "flysight": flysight,
    "flysight-mag": flysight,
    "gnsslogger-accel": gnsslogger,
    "gnsslogger-gyro": gnsslogger,
    "gnsslogger-mag": gnsslogger,
    "kitti-oxts": kitti,
    "microstrain": microstrain,
    "microstrain-mag": lambda: microstrain(mag=True),
    "motioncal": motioncal,
    "movella-dot": movella,
    "movella-dot-mag": lambda: movella(mag=True),
    "phyphox": lambda: (
        quoted("Time (s)", *xyz("Acceleration {0} (m/s^2)"), "Absolute acceleration (m/s^2)")
        + lines(TIME, *ACCEL.T, np.linalg.norm(ACCEL, axis=1))
    ),
    "phyphox-gyro": lambda: (
        quoted("Time (s)", *xyz("Gyroscope {0} (rad/s)"), "Absolute (rad/s)")
        + lines([f"{t:.9E}" for t in TIME], *GYRO.T, np.linalg.norm(GYRO, axis=1))
    ),
    "phyphox-mag": lambda: (
        quoted("Time (s)", *xyz("Magnetic field {0} (µT)"), "Absolute field (µT)")
        + lines(TIME, *(MAG * 1e6).T, np.linalg.norm(MAG, axis=1))
    ),
    "physics-toolbox-mag": lambda: (
        "time,gFx,gFy,gFz,wx,wy,wz,p,Bx,By,Bz,Azimuth\n"
        + lines(TIME, *(ACCEL / G).T, *GYRO.T, [1013.2] * ROWS, *(MAG * 1e6).T, [12.0] * ROWS)
    ),
    "physics-toolbox": lambda: "time,gFx,gFy,gFz,wx,wy,wz,p\n" + lines(TIME, *(ACCEL / G).T, *GYRO.T, [1013.2] * ROWS),
    "sensorlogger-accel": lambda: PHONE + lines(stamps(1e9, 1718030736872695300), TIME, *ACCEL.T[::-1]),
    "sensorlogger-gyro": lambda: PHONE + lines(stamps(1e9, 1718030736872695300), TIME, *GYRO.T[::-1]),
    "sensorlogger-mag": lambda: PHONE + lines(stamps(1e9, 1718030736872695300), TIME, *(MAG * 1e6).T[::-1]),
    "tum-vi": lambda: (
        "# timestamp[ns] w.x w.y w.z a.x a.y a.z\n"
        + lines(stamps(1e9, 1520530308181901469), *GYRO.T, *ACCEL.T, delimiter=" ")
    ),
    "x-imu3": lambda: (
        ",".join(["Timestamp (us)", *xyz("Gyroscope {1} (deg/s)"), *xyz("Accelerometer {1} (g)")])
        + "\n"
        + lines(stamps(1e6, 12_000_000), *np.degrees(GYRO).T, *(ACCEL / G).T)
    ),
    "x-imu3-mag": lambda: "Timestamp (us),X (a.u.),Y (a.u.),Z (a.u.)\n" + lines(stamps(1e6, 12_000_000), *MAG.T),
}
OF_ALL = ("accel", "gyro", "mag")
ALIKE = {
    **{
        f"{app}-{sensor}": [f"{app}-{s}" for s in OF_ALL] for app in ("sensorlogger", "gnsslogger") for sensor in OF_ALL
    },
    "flysight": ["flysight", "flysight-mag"],
    "flysight-mag": ["flysight", "flysight-mag"],
    "kitti-oxts": [],
    **{f"ulog2csv-{sensor}": ["ulog2csv-accel", "ulog2csv-gyro"] for sensor in ("accel", "gyro")},
}
"""Which layouts fit a file of each, where that is not just its own."""
APPS = ("androsensor", "microstrain", "movella-dot", "physics-toolbox", "mt-manager", "fusion")
SENSORS = {
    **{f"{app}-{sensor}": [sensor] for app in ("sensorlogger", "gnsslogger") for sensor in OF_ALL},
    **{f"{app}-mag": ["mag"] for app in ("phyphox", "x-imu3", "flysight")},
    **{f"{app}-mag": list(OF_ALL) for app in APPS},
    **{f"ulog2csv-{sensor}": [sensor] for sensor in ("accel", "gyro")},
    "gcsv-gyro": ["gyro"],
    **{name: ["accel"] for name in ("actigraph", "actigraph-us")},
    "motioncal": list(OF_ALL),
    "phyphox": ["accel"],
    "phyphox-gyro": ["gyro"],
}
"""What a layout reads, where that is not accelerometer and gyroscope."""


def test_every_layout_has_a_file_here_and_a_line_in_the_docs():
    assert sorted(FILES) == shipped_names()
    text = (DOCS / "recordings.md").read_text()
    for entry in shipped():
        assert f"| `{entry.name}` |" in text
        source = shipped_file(entry.name).read_text().splitlines()[1]
        assert source.startswith("# ")


@pytest.mark.parametrize("name", FILES)
def test_a_file_is_read_by_the_name_of_its_layout(tmp_path, name):
    path = tmp_path / "f.csv"
    path.write_bytes(FILES[name]().encode())
    found = il.read(path, name)
    assert len(found) == ROWS
    time = found.si("time")
    # Nanoseconds since 1970 are held to 0.24 us.
    np.testing.assert_allclose(time - time[0], TIME, atol=5e-7, rtol=0)
    of = {"accel": ACCEL, "gyro": GYRO, "mag": MAG}
    if name == "motioncal":
        of = {"accel": RAW[:, :3] * G / 8192, "gyro": np.radians(RAW[:, 3:6] / 16), "mag": RAW[:, 6:] * 1e-7}
    if name.startswith("gcsv"):
        steps = {"accel": 0.00048828125 * G, "gyro": 0.00122173047}
        of = {sensor: np.rint(of[sensor] / step) * step for sensor, step in steps.items()}
    assert [sensor for sensor in of if f"{sensor}_x" in found] == SENSORS.get(name, ["accel", "gyro"])
    for sensor in SENSORS.get(name, ["accel", "gyro"]):
        read = np.column_stack([found.si(f"{sensor}_{axis}") for axis in "xyz"])
        np.testing.assert_allclose(read, of[sensor], rtol=1e-14)
        assert (found.triad_unit(sensor) == "count") == (name == "betaflight-raw")
    if "temperature" in found:
        np.testing.assert_allclose(found.si("temperature"), CELSIUS)


@pytest.mark.parametrize("name", FILES)
def test_the_first_message_names_the_layout_that_fits(imulab, tmp_path, name):
    (tmp_path / "f.csv").write_bytes(FILES[name]().encode())
    expected = ALIKE.get(name, [name])
    assert fitting((tmp_path / "f.csv").read_bytes()) == expected
    done = imulab("tumble", "fit", "f.csv", "--gravity", "9.81", "-o", "r.json")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "--layout" in done.stderr
    if expected:
        tried = " or ".join(f"--layout {one}" for one in expected)
        assert done.stderr.endswith(f"looks like a file of {' or '.join(expected)}: try {tried}\n")


def test_the_wrong_layout_gets_one_line_that_names_the_right_one(imulab, tmp_path):
    (tmp_path / "f.csv").write_text(FILES["phyphox"]())
    done = imulab("show", "f.csv", "--layout", "euroc")
    assert done.returncode == 2
    assert re.fullmatch(
        r"imulab: .*f\.csv: euroc takes time from a column named 'timestamp \[ns\]', found Time \(s\) .*; "
        r"looks like a file of phyphox: try --layout phyphox\n",
        done.stderr,
    )
    assert imulab("show", "f.csv", "--layout", "phyphox").returncode == 0


def test_titles_may_stand_below_any_comments_and_a_hundred_other_lines(tmp_path):
    path = tmp_path / "f.csv"
    path.write_text("# a comment\n" * 300 + "a line of its own\n\n" * 49 + FILES["phyphox"]())
    assert len(il.read(path, "phyphox")) == ROWS
    path.write_text("a line of its own\n" * 101 + FILES["phyphox"]())
    with pytest.raises(
        ReadError, match=r"phyphox takes time from a column named 'Time \(s\)', found a line of its own"
    ):
        il.read(path, "phyphox")
    path.write_text("# only comments\n" * 3)
    with pytest.raises(ReadError, match="found no titles"):
        il.read(path, "phyphox")
    numbered = tmp_path / "l.toml"
    numbered.write_text('header = true\nskip_lines = 9\n[columns]\naccel_x = { from = 0, unit = "g" }\n')
    with pytest.raises(ReadError, match="no rows of data"):
        il.read(path, numbered)


def test_a_name_that_is_none_lists_those_that_are(tmp_path):
    (tmp_path / "f.csv").write_text(FILES["phyphox"]())
    with pytest.raises(ReadError, match=r"^phypox: no such layout file; .* androsensor .*did you mean 'phyphox'"):
        il.read(tmp_path / "f.csv", "phypox")


@pytest.mark.parametrize(("layout", "near"), [("im.toml", ""), ("l/phypox.toml", "; did you mean 'phyphox'?")])
def test_a_file_that_is_none_is_refused_without_the_list_of_names(tmp_path, layout, near):
    (tmp_path / "f.csv").write_text(FILES["phyphox"]())
    known = "imulab show --formats lists those that come with imulab"
    with pytest.raises(ReadError, match=f"^{layout}: no such layout file; {known}{re.escape(near)}$"):
        il.read(tmp_path / "f.csv", layout)


def test_titles_that_nothing_fits_call_for_a_layout(imulab, tmp_path):
    (tmp_path / "f.csv").write_text("Time (s),Ax,Ay,Az\n0,1,2,3\n")
    done = imulab("show", "f.csv")
    assert done.returncode == 2
    assert done.stderr.endswith(
        "; imulab layout guess f.csv --unit accel=m/s^2 -o L.toml writes a layout for it (--layout L.toml)\n"
    )
    (tmp_path / "f.csv").write_text("Time (s),Fore,Aft,Up\n0,1,2,3\n")
    done = imulab("show", "f.csv")
    assert "; a layout says where columns of other titles are: --layout (imulab show --formats" in done.stderr


@pytest.mark.skipif(not shutil.which("bash"), reason="the command in the docs is for a shell")
def test_kitti_is_put_into_one_file_by_the_command_in_the_docs(tmp_path):
    (tmp_path / "oxts" / "data").mkdir(parents=True)
    rows = [line.partition(" ") for line in kitti().splitlines()]
    (tmp_path / "oxts" / "timestamps.txt").write_text("".join(row[0].replace("T", " ") + "\n" for row in rows))
    for i, row in enumerate(rows):
        (tmp_path / "oxts" / "data" / f"{i:010d}.txt").write_text(row[2] + "\n" * (i % 2))
    (command,) = re.findall(r"^    (tr .*)$", (DOCS / "recordings.md").read_text(), re.M)
    subprocess.run(["bash", "-c", command], cwd=tmp_path, check=True)
    assert (tmp_path / "oxts.txt").read_text() == kitti()


def test_formats_lists_them_and_prints_one(imulab):
    shown = imulab("show", "--formats").stdout
    for entry in shipped():
        assert re.search(rf"^{entry.name} +{re.escape(entry.about)} +{' '.join(entry.sensors)}", shown, re.M)
    printed = imulab("show", "--formats", "euroc").stdout
    assert printed == shipped_file("euroc").read_text()
    said = json.loads(imulab("show", "--formats", "--json").stdout)
    assert [entry["name"] for entry in said["layouts"]] == [entry.name for entry in shipped()]
    assert {"name": "ROS 1 bag", "files": ".bag", "use": "read", "layout": ""}.items() <= said["formats"][5].items()
    one = json.loads(imulab("show", "--formats", "euroc", "--json").stdout)["euroc"]
    assert one == tomllib.loads(shipped_file("euroc").read_text())
    refused = imulab("show", "--formats", "nothing")
    assert refused.returncode == 2
    assert "nothing: expected the name of a layout: actigraph" in refused.stderr


def test_a_fleet_takes_a_layout_by_name(imulab, tmp_path):
    assert imulab("tumble", "simulate", "-o", "native.csv").returncode == 0
    native = il.read(tmp_path / "native.csv")
    triad = to_si(native.triad("accel"), native.triad_unit("accel"))
    text = quoted("Time (s)", *xyz("Acceleration {0} (m/s^2)")) + lines(native.time, *triad.T)
    (tmp_path / "f.csv").write_text(text)
    (tmp_path / "m.csv").write_text("serial,procedure,file,layout,order\nA,tumble,f.csv,phyphox,0\n")
    done = imulab("fleet", "run", "m.csv", "-o", "out")
    assert done.returncode == 0, done.stderr
    assert "phyphox" in (tmp_path / "out" / "A.json").read_text()


@pytest.mark.parametrize(("delimiter", "decimal"), [(";", ","), ("\t", ",")])
def test_other_separators_are_named_with_what_to_change(imulab, tmp_path, delimiter, decimal):
    text = FILES["x-imu3"]().replace(",", delimiter).replace(".", decimal)
    (tmp_path / "f.csv").write_text(text)
    written = delimiter.replace("\t", "\\t")
    said = f'x-imu3) and set delimiter = "{written}" and decimal = "{decimal}"\n'
    for layout in ([], ["--layout", "x-imu3"]):
        done = imulab("tumble", "fit", "f.csv", "--gravity", "9.81", "-o", "r.json", *layout)
        assert done.returncode == 2
        assert done.stderr.endswith(said)
        assert done.stderr.count("\n") == 1
    mended = shipped_file("x-imu3").read_text().replace('delimiter = ","', f'delimiter = "{written}"\ndecimal = ","')
    (tmp_path / "l.toml").write_text(mended)
    assert len(il.read(tmp_path / "f.csv", tmp_path / "l.toml")) == ROWS


@pytest.mark.parametrize("rows", ["0,1,\n1,2,\n", "0,1,\r\n1,2,\r\n"])
def test_a_delimiter_at_the_end_of_every_row_is_passed_over(tmp_path, rows):
    (tmp_path / "f.csv").write_bytes(b"t,a\n" + rows.encode())
    layout = tmp_path / "l.toml"
    columns = '[columns]\ntime = { from = "t", unit = "s" }\naccel_x = { from = "a", unit = "g" }\n'
    for more in ("", "skip_incomplete = true\n"):
        layout.write_text('delimiter = ","\n' + more + columns)
        assert il.read(tmp_path / "f.csv", layout).column("accel_x").tolist() == [1, 2]
    (tmp_path / "n.csv").write_bytes(b"time [s],accel_x [g]\n" + rows.encode())
    assert il.read(tmp_path / "n.csv").column("accel_x").tolist() == [1, 2]
    (tmp_path / "n.csv").write_bytes(b"time [s],accel_x [g]\n" + rows.encode() + b"2,3\n")
    with pytest.raises(ReadError, match=r"row 3 \(line 4\): expected 3 fields, found 2"):
        il.read(tmp_path / "n.csv")


def test_a_line_of_titles_without_end_is_not_printed_as_a_whole(tmp_path):
    (tmp_path / "f.csv").write_text("a" * 50 + "," + ",".join(f"title{i}" for i in range(10_000)) + "\n1,2\n")
    with pytest.raises(ReadError) as caught:
        il.read(tmp_path / "f.csv", "euroc")
    assert len(str(caught.value)) < 600


def test_a_file_is_not_taken_for_that_of_a_program_whose_mark_it_lacks(imulab, tmp_path):
    """Titles of MT Manager are those of Movella DOT, in rad/s and tenths of a millisecond instead of deg/s and us."""
    (tmp_path / "mt.txt").write_text(mt_manager())
    assert fitting((tmp_path / "mt.txt").read_bytes()) == ["mt-manager"]
    bare = mt_manager().splitlines(keepends=True)[4:]
    (tmp_path / "bare.txt").write_text("".join(bare))
    (tmp_path / "bare.csv").write_text("".join(bare).replace("\t", ","))
    for name in ("bare.txt", "bare.csv"):
        assert fitting((tmp_path / name).read_bytes()) == []
        done = imulab("show", name)
        assert "movella" not in done.stderr + done.stdout
        assert "imulab layout guess" in done.stderr + done.stdout
    done = imulab("show", "mt.txt", "--layout", "movella-dot")
    assert done.returncode == 2
    assert done.stderr.endswith("looks like a file of mt-manager: try --layout mt-manager\n")
    # A comma in place of the tab is no reason to read it as the other program's.
    (tmp_path / "comma.csv").write_text(mt_manager().replace("\t", ","))
    assert il.read(tmp_path / "comma.csv", "mt-manager").units["gyro_x"] == "rad/s"
    noted = imulab("convert", "comma.csv", "--layout", "movella-dot", "-o", "out.csv")
    assert "none of DeviceTag:, Xsens DOT, Movella DOT stands above the titles" in noted.stderr


@pytest.mark.parametrize(("delimiter", "decimal"), [(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ",")])
def test_phyphox_in_all_its_separators(tmp_path, delimiter, decimal):
    path = tmp_path / "f.csv"
    rows = FILES["phyphox"]().splitlines()
    swapped = [delimiter.join(field.replace(".", decimal) for field in row.split(",")) for row in rows[1:]]
    path.write_text("\n".join([rows[0].replace(",", delimiter), *swapped]) + "\n")
    assert fitting(path.read_bytes()) == ["phyphox"]
    np.testing.assert_array_equal(il.read(path, "phyphox").triad("accel"), ACCEL)


def test_numbers_above_the_rows_that_are_not_there_are_named(tmp_path):
    path = tmp_path / "f.gcsv"
    path.write_text(gcsv().replace("gscale,0.00122173047\n", ""))
    with pytest.raises(ReadError, match="takes the scale of gyro_x from the number behind 'gscale' above the rows"):
        il.read(path, "gcsv")
    path.write_text(picoquake().replace("sample_rate", "data_rate"))
    assert il.read(path, "picoquake").time[-1] == pytest.approx((ROWS - 1) / 100)
    path.write_text(picoquake().replace("sample_rate = 100.0", "rate"))
    with pytest.raises(ReadError, match=r"takes the sample rate from the number behind 'sample_rate.data_rate'"):
        il.read(path, "picoquake")


def test_a_row_of_units_is_read_and_must_agree(tmp_path):
    path = tmp_path / "f.csv"
    path.write_text(shimmer().replace("deg/s", "rad/s"))
    with pytest.raises(ReadError, match=r"line 3: the row of units says rad/s for 'S_A1_Gyro_X_CAL', shimmer says"):
        il.read(path, "shimmer")
    path.write_text(shimmer().replace("S_A1_Gyro_X", "S_B2_Gyro_X_CAL\tS_A1_Gyro_X"))
    with pytest.raises(ReadError, match=r"from one column named '\*_Gyro_X_CAL', found S_A1_.*, S_B2_Gyro_X_CAL"):
        il.read(path, "shimmer")


def test_a_layout_without_a_delimiter_takes_that_of_the_file(tmp_path):
    path, layout = tmp_path / "f.csv", tmp_path / "l.toml"
    by_number = "[columns]\n" + "".join(f'accel_{a} = {{ from = {k}, unit = "g" }}\n' for k, a in enumerate("xyz", 1))
    for delimiter in (",", ";", "\t", " ", ", "):
        path.write_text(lines(TIME, *ACCEL.T, delimiter=delimiter))
        layout.write_text("sample_rate = 100\n" + by_number)
        np.testing.assert_array_equal(il.read(path, layout).triad("accel"), ACCEL)
    named = by_number
    for k, axis in enumerate("xyz", 1):
        named = named.replace(f"from = {k}", f'from = "A {axis}"')
    for delimiter in (",", ";", "\t"):
        path.write_text(delimiter.join(["t", "A x", "A y", "A z"]) + "\n" + lines(TIME, *ACCEL.T, delimiter=delimiter))
        layout.write_text("sample_rate = 100\n" + named)
        np.testing.assert_array_equal(il.read(path, layout).triad("accel"), ACCEL)

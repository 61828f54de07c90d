"""Readers and writers against the libraries that people use, in interleaved runs of one process."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from timing import Row, measured

import imulab as il
from imulab.recording import Recording

ROUNDS = 5
MESSAGES = 40_000
CSV_ROWS = 7_500_000  # 1 GB
EPOCH = 1_700_000_000_000_000_000


def _seconds(work: Callable[[], Any]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def _compared(mine: Callable[[], Any], theirs: Callable[[], Any], rounds: int = ROUNDS) -> tuple[float, float, float]:
    """Median times of both, and the median of the ratios theirs / mine, run by run."""
    runs = [(_seconds(mine), _seconds(theirs)) for _ in range(rounds)]
    return (
        statistics.median(m for m, _ in runs),
        statistics.median(t for _, t in runs),
        statistics.median(t / m for m, t in runs),
    )


def _bag(folder: Path, kind: str) -> Path:
    """A bag of MESSAGES Imu messages, made by rosbags."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
    t = types.types
    path = folder / ("r.bag" if kind == "bag" else kind)
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    with Writer1(path) if kind == "bag" else Writer2(path, version=9, storage_plugin=plugin) as writer:
        name = "sensor_msgs/msg/Imu"
        connection = writer.add_connection("/imu", name, typestore=types)
        for i in range(MESSAGES):
            stamp = EPOCH + i * 5_000_000
            parts = {"stamp": t["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)}
            header = t["std_msgs/msg/Header"](frame_id="imu", **parts, **({"seq": i} if kind == "bag" else {}))
            vector = t["geometry_msgs/msg/Vector3"](x=0.1 * i, y=0.2, z=9.8)
            message = t[name](
                header,
                t["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
                *(np.zeros(9), vector, np.zeros(9), vector, np.zeros(9)),
            )
            data = types.serialize_ros1(message, name) if kind == "bag" else types.serialize_cdr(message, name)
            writer.write(connection, stamp, bytes(data))
    return path


def _by_rosbags(path: Path) -> None:
    """What a script does: each message deserialised, its numbers into lists."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    store = Stores.ROS1_NOETIC if path.suffix == ".bag" else Stores.ROS2_HUMBLE
    rows = []
    with AnyReader([path], default_typestore=get_typestore(store)) as reader:
        for connection, _, raw in reader.messages():
            m = reader.deserialize(raw, connection.msgtype)
            stamp, a, w = m.header.stamp, m.linear_acceleration, m.angular_velocity
            rows.append((stamp.sec + 1e-9 * stamp.nanosec, a.x, a.y, a.z, w.x, w.y, w.z))
    np.array(rows)


def _wide(rows: int, decimals: int | None) -> Recording:
    rng = np.random.default_rng(1)
    units = {"time": "s", **{f"accel_{a}": "m/s^2" for a in "xyz"}, **{f"gyro_{a}": "rad/s" for a in "xyz"}}
    columns = {name: rng.normal(size=rows) for name in units}
    columns["time"] = np.arange(rows) / 200
    if decimals is not None:
        columns = {name: np.round(values, decimals) for name, values in columns.items()}
    return Recording(columns, units)


def _memory(*arguments: str) -> str:
    """Peak memory of a command."""
    return f"{measured('-m', 'imulab', *arguments)[1]:.0f} MB"


def _peaks(what: str, file: Path, theirs: str) -> Row:
    """Peak memory of a process that reads this file, ours and the peer's."""
    ours = measured("-c", f"import imulab; imulab.read({str(file)!r})")[1]
    peer = measured("-c", theirs)[1]
    return (f"{what}, peak memory of a process", f"{ours:.0f} MB (the peer's {peer:.0f} MB)", "")


def rows() -> list[Row]:
    """Return what was measured, what was found, what was asked."""
    import polars

    found = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for kind, title in (("mcap", "MCAP"), ("bag", "ROS 1 bag"), ("sqlite", "ROS 2 sqlite")):
            path = _bag(folder, kind)
            mine, theirs, ratio = _compared(lambda path=path: il.read(path), lambda path=path: _by_rosbags(path))
            rate = f"{MESSAGES / mine:,.0f} messages/s (rosbags {MESSAGES / theirs:,.0f}), {ratio:.0f} times"
            found.append((f"read {title}, {MESSAGES} Imu messages", rate, "the library's own rate"))
            by_rosbags = (
                f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); from pathlib import Path; "
                f"import recordings; recordings._by_rosbags(Path({str(path)!r}))"
            )
            found.append(_peaks(f"read {title}, {MESSAGES} Imu messages", path, by_rosbags))
        for decimals, title in ((6, "6 decimals"), (None, "17 digits")):
            file = folder / "wide.csv"
            recording = _wide(1_000_000, decimals)
            write = _seconds(lambda recording=recording, file=file: il.write(recording, file))
            fields = 7 * len(recording)
            found.append((f"write CSV, 1 million rows x 7, {title}", f"{1e9 * write / fields:.0f} ns a number", ""))
            mine, theirs, ratio = _compared(
                lambda file=file: il.read(file), lambda file=file: polars.read_csv(file), 2 * ROUNDS
            )
            text = f"{mine:.2f} s with SHA-256 (polars {theirs:.2f} s), ratio {1 / ratio:.2f}"
            found.append((f"read CSV, 1 million rows x 7, {title}", text, "ratio <= 1.5"))
        il.write((_wide(250_000, None) for _ in range(CSV_ROWS // 250_000)), file)
        mine, theirs, ratio = _compared(lambda: il.read(file), lambda: polars.read_csv(file), 3)
        text = f"{mine:.2f} s with SHA-256 (polars {theirs:.2f} s), ratio {1 / ratio:.2f}"
        what = f"read CSV, {file.stat().st_size / 1e9:.2f} GB"
        found.append((what, text, "ratio <= 1.5"))
        found.append(_peaks(what, file, f"import polars; polars.read_csv({str(file)!r})"))
        for target in ("out.parquet", "out.csv"):
            peak = _memory("convert", str(file), "-o", str(folder / target))
            found.append((f"convert that file to .{target.partition('.')[2]}, peak memory", peak, "< 400 MB"))
        peak = _memory("convert", str(folder / "out.parquet"), "-o", str(folder / "again.csv"))
        found.append(("convert it back to .csv, peak memory", peak, "< 400 MB"))
    return found

"""ROS bags made by the rosbags library."""

from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

EPOCH = 1_700_000_000_123_456_789


def typestore(kind: str):
    return get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)


def imu(types, kind, stamp, accel, gyro, frame="imu_link", accel_cov=0.0, gyro_cov=0.0, seq=0):
    t = types.types
    header = {"stamp": t["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9), "frame_id": frame}
    if kind == "bag":
        header["seq"] = seq
    vector = t["geometry_msgs/msg/Vector3"]

    def covariance(first):
        return np.array([first] + [0.0] * 8)

    return t["sensor_msgs/msg/Imu"](
        header=t["std_msgs/msg/Header"](**header),
        orientation=t["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=covariance(-1.0),
        angular_velocity=vector(*map(float, gyro)),
        angular_velocity_covariance=covariance(gyro_cov),
        linear_acceleration=vector(*map(float, accel)),
        linear_acceleration_covariance=covariance(accel_cov),
    )


def magnetic_field(types, kind, stamp, field, frame="imu_link", first_covariance=0.0):
    t = types.types
    header = {"stamp": t["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9), "frame_id": frame}
    if kind == "bag":
        header["seq"] = 0
    return t["sensor_msgs/msg/MagneticField"](
        header=t["std_msgs/msg/Header"](**header),
        magnetic_field=t["geometry_msgs/msg/Vector3"](*map(float, field)),
        magnetic_field_covariance=np.array([first_covariance] + [0.0] * 8),
    )


def temperature(types, kind, stamp, value, frame="imu_link"):
    t = types.types
    header = {"stamp": t["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9), "frame_id": frame}
    if kind == "bag":
        header["seq"] = 0
    return t["sensor_msgs/msg/Temperature"](
        header=t["std_msgs/msg/Header"](**header), temperature=float(value), variance=0.0
    )


def write(folder: Path, kind: str, messages, *, compression=None, name="rec") -> Path:
    """Write (topic, type, stamp, message function) as a bag; kind bag, mcap or sqlite. Returns the path to read."""
    types = typestore(kind)
    path = folder / (f"{name}.bag" if kind == "bag" else name)
    if kind == "bag":
        writer = Writer1(path)
        if compression:
            writer.set_compression(compression)
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
    with writer:
        connections = {}
        for topic, msgtype, stamp, make in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=types)
            message = make(types, kind)
            data = types.serialize_ros1(message, msgtype) if kind == "bag" else types.serialize_cdr(message, msgtype)
            writer.write(connections[topic], stamp, bytes(data))
    return path

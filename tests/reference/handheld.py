"""A rigid board with several IMUs, put down and turned by hand or flown, and what autopilots log of it.

Rates are written down, turned into attitudes step by step, and everything is a spline over a fine grid: what an IMU
reads is worked out at its own times. Nothing of imulab. Logs by `reference.flightlogs`.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, lfilter
from scipy.spatial.transform import Rotation

from reference.flightlogs import dataflash, ulog

G = 9.80665
GRID = 1e-3  # s


@dataclass
class Motion:
    """Splines over time, s: specific force at the origin, m/s^2, and rate, rad/s, in the body frame."""

    force: CubicSpline
    rate: CubicSpline
    end: float


def _sines(t, rng, low, high, count=6):
    frequency = np.exp(rng.uniform(np.log(low), np.log(high), (3, count)))
    phase = rng.uniform(0, 2 * np.pi, (3, count))
    return np.sin(2 * np.pi * frequency[None] * t[:, None, None] + phase).sum(2)


def _ramp(t, begin, end, ease=1.0):
    return np.clip((t - begin) / ease, 0, 1) ** 2 * np.clip((end - t) / ease, 0, 1) ** 2


def move(rng, *, attitudes=8, duration=20.0, size=6.0, about=(1, 1, 1), shake=6.0, band=(0.3, 2.0)):
    """Rests of 4 s in attitudes a turn of 1.5 s apart, then motion of `size` rad/s rms about each of some axes."""
    begin = attitudes * 5.5
    t = np.arange(0, begin + duration + 4, GRID)
    rate = np.zeros((len(t), 3))
    for j in range(1, attitudes):
        axis = rng.normal(size=3)
        angle = rng.uniform(1.2, 2.2)
        phase = (t - (5.5 * j - 1.5)) / 1.5
        bump = np.where((phase > 0) & (phase < 1), 2 / 1.5 * np.sin(np.pi * phase) ** 2, 0.0)
        rate += bump[:, None] * angle * axis / np.linalg.norm(axis)
    sway = _sines(t, rng, *band)
    moving = _ramp(t, begin, begin + duration)[:, None]
    rate += moving * sway * size / np.sqrt(np.mean(sway**2, axis=0)) * np.array(about)
    pull = _sines(t, rng, 0.5, 4.0)
    pull *= shake / np.sqrt(np.mean(pull**2))
    # The attitude, turn by turn from the middle of each step.
    turns = Rotation.from_rotvec((rate[1:] + rate[:-1]) / 2 * GRID).as_matrix()
    attitude = np.empty((len(t), 3, 3))
    attitude[0] = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    for i, turn in enumerate(turns):
        attitude[i + 1] = attitude[i] @ turn
    force = np.einsum("nji,nj->ni", attitude, moving * pull + np.array([0, 0, G]))
    return Motion(CubicSpline(t, force), CubicSpline(t, rate), float(t[-1]))


@dataclass
class Board:
    """Positions from IMU 1, m, latencies of accelerometers and gyroscopes from the gyroscopes of IMU 1, s, and rest."""

    position: np.ndarray
    accel_late: np.ndarray
    gyro_late: np.ndarray
    accel: np.ndarray
    gyro: np.ndarray
    accel_bias: np.ndarray
    gyro_bias: np.ndarray


def a_board(rng, position):
    """IMUs turned by 2 deg, scale factors of 1 %, biases of .1 m/s^2 and .5 deg/s, latencies within 2 ms."""
    position = np.asarray(position, dtype=float)
    k = len(position)

    def matrices(frame):
        turned = Rotation.from_rotvec(rng.normal(0, 0.03, (k, 3))).as_matrix() if frame is None else frame
        return np.eye(3) * (1 + rng.normal(0, 0.01, (k, 1, 3))) @ turned, turned

    accel, turned = matrices(None)
    accel[0], turned[0] = np.diag(np.diag(accel[0])), np.eye(3)
    gyro, _ = matrices(turned)
    late = rng.uniform(-2e-3, 2e-3, (2, k))
    late[1, 0] = 0
    return Board(
        position, late[0], late[1], accel, gyro, rng.normal(0, 0.1, (k, 3)), np.radians(rng.normal(0, 0.5, (k, 3)))
    )


def read(board, motion, k, sensor, t, rng, noise):
    """What a triad reads at times t, with white noise."""
    w = motion.rate(t - (board.accel_late if sensor == "accel" else board.gyro_late)[k])
    if sensor == "gyro":
        values = w @ board.gyro[k].T + board.gyro_bias[k]
    else:
        at = t - board.accel_late[k]
        al = motion.rate(at, 1)
        felt = motion.force(at) + np.cross(al, board.position[k]) + np.cross(w, np.cross(w, board.position[k]))
        values = felt @ board.accel[k].T + board.accel_bias[k]
    return values + rng.normal(0, noise, values.shape)


NOISE = {"accel": 0.03, "gyro": 2e-3}


def streams(board, motion, rng, rates, *, jitter=20e-6, vibration=0.0):
    """Stamps, us, and readings of each triad, {(sensor, k): (stamps, values)}; `rates`, Hz, by sensor or by both."""
    out = {}
    for k in range(len(board.position)):
        for sensor in ("accel", "gyro"):
            rate = rates.get((sensor, k), rates.get(sensor))
            t = 0.02 + rng.uniform(0, 1 / rate) + np.arange(int((motion.end - 0.1) * rate)) / rate
            t = np.round(t + rng.uniform(-jitter, jitter, len(t)), 6)
            values = read(board, motion, k, sensor, t, rng, NOISE[sensor])
            if vibration and sensor == "accel":
                values += vibration * np.sqrt(2) * np.sin(2 * np.pi * 87.0 * t[:, None] + np.array([0, 1, 2]))
            out[sensor, k] = (np.rint(t * 1e6).astype(np.int64) + 5_000_000, values)
    return out


def filtered(streams_, cutoff, keep):
    """Streams behind a low-pass of two poles, Hz, of which each `keep`-th sample is logged."""
    out = {}
    for key, (stamps, values) in streams_.items():
        b, a = butter(2, cutoff, fs=1e6 / np.median(np.diff(stamps)))
        low = lfilter(b, a, values - values[0], axis=0) + values[0]
        out[key] = (stamps[::keep], low[::keep])
    return out


_SENSOR = "uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;float x;float y;float z;"
_VEHICLE = (
    "uint64_t timestamp;uint64_t timestamp_sample;uint32_t accel_device_id;uint32_t gyro_device_id;"
    "float[3] delta_angle;float[3] delta_velocity;uint32_t delta_angle_dt;uint32_t delta_velocity_dt;"
)


def px4(data, devices=None):
    """A ULog of sensor_accel and sensor_gyro."""
    subscriptions, messages = [], []
    for number, ((sensor, k), (stamps, values)) in enumerate(data.items()):
        subscriptions.append((k, number, f"sensor_{sensor}"))
        device = (devices or {}).get((sensor, k), 1000 + k)
        messages += [
            (t + 300, (number, (t + 300, t, device, *row)))
            for t, row in zip(stamps.tolist(), values.tolist(), strict=True)
        ]
    messages.sort(key=lambda each: each[0])
    formats = {"sensor_accel": _SENSOR, "sensor_gyro": _SENSOR}
    return ulog(formats, subscriptions, [m for _, m in messages], info={"sys_name": "PX4"})


def px4_vehicle(data, period):
    """A ULog of vehicle_imu: sums of readings over `period` samples, at the stamps of the gyroscopes."""
    subscriptions, messages = [], []
    for k in sorted({k for _, k in data}):
        subscriptions.append((k, k, "vehicle_imu"))
        stamps = data["gyro", k][0]
        step = int(np.median(np.diff(stamps)))
        count = min(len(data["accel", k][0]), len(stamps)) // period
        sums = [
            data[s, k][1][: count * period].reshape(count, period, 3).sum(1) * step / 1e6 for s in ("gyro", "accel")
        ]
        ends = stamps[: count * period].reshape(count, period)[:, -1] + step // 2
        messages += [
            (t + 300, (k, (t + 300, t, 1000 + k, 2000 + k, *angle, *velocity, period * step, period * step)))
            for t, angle, velocity in zip(ends.tolist(), *(s.tolist() for s in sums), strict=True)
        ]
    messages.sort(key=lambda each: each[0])
    return ulog({"vehicle_imu": _VEHICLE}, subscriptions, [m for _, m in messages])


def ardupilot(data, raw=False):
    """A DataFlash log: of ACC and GYR with their sample times, or of IMU at the gyroscope's times."""
    messages = []
    if raw:
        kinds = {"ACC": (10, "QBQfff", "TimeUS,I,SampleUS,AccX,AccY,AccZ"),
                 "GYR": (11, "QBQfff", "TimeUS,I,SampleUS,GyrX,GyrY,GyrZ")}  # fmt: skip
        for (sensor, k), (stamps, values) in data.items():
            title = "ACC" if sensor == "accel" else "GYR"
            messages += [
                (t, (title, (t + 700 + 130 * k, k, t, *row)))
                for t, row in zip(stamps.tolist(), values.tolist(), strict=True)
            ]
    else:
        kinds = {"IMU": (10, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")}
        for k in sorted({k for _, k in data}):
            (stamps, rates), (_, forces) = data["gyro", k], data["accel", k]
            messages += [
                (t, ("IMU", (t, k, *w, *f)))
                for t, w, f in zip(stamps.tolist(), rates.tolist(), forces.tolist(), strict=False)
            ]
    messages.sort(key=lambda each: each[0])
    return dataflash(kinds, [m for _, m in messages])

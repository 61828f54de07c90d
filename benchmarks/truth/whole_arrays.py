"""Boards of whole IMUs turned and shaken by hand, and what loosens, drifts, lags or drops out on them.

The boards are those of `imulab array simulate --imus`, which shares nothing with the fit.
"""

from __future__ import annotations

from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray
from scenario import Scenario, Trial
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

import imulab as il
from imulab.display import Note

GROUP = "Whole arrays"
Array = NDArray[np.float64]
G = 9.80665
QUANTITIES = {
    "positions": ("position", 1e6, "µm"),
    "rotations": ("rotation", 1e6, "µrad"),
    "latencies of accelerometers": ("accel_latency", 1e6, "µs"),
    "latencies of gyroscopes": ("gyro_latency", 1e6, "µs"),
    "biases of accelerometers": ("accel_bias", 1e3, "mm/s^2"),
    "scale factors of accelerometers": ("accel_scale_factor", 1e6, "ppm"),
}
"""Names in the record, a unit for errors, and its name."""


def truth_of(board: il.Recording, name: str, k: int) -> Array:
    """Return what the head of the board says of IMU k, counted from 1, as the record's parameters would."""

    def stated(what: str) -> Array:
        return np.array(board.metadata[f"truth_{what}_{k}"].split(), dtype=float)

    matrix = stated("accel").reshape(3, 3)
    # Ta = L Q' with L lower triangular: L L' = Ta Ta'.
    lower = np.linalg.cholesky(matrix @ matrix.T)
    if name == "position":
        return stated("position")
    if name in ("accel_latency", "gyro_latency"):
        return stated("latency")[[int(name == "gyro_latency")]]
    if name == "accel_scale_factor":
        return np.diag(lower)
    if name == "accel_bias":
        return stated("accel_bias") / np.diag(lower)
    return Rotation.from_matrix((np.linalg.inv(lower) @ matrix).T).as_rotvec()


def motion(board: il.Recording) -> tuple[Array, Array]:
    """Return the rate and angular acceleration of the body, by the gyroscopes of IMU 1 and their means of five."""
    matrix, bias = (np.array(board.metadata[f"truth_{name}_1"].split(), float) for name in ("gyro", "gyro_bias"))
    rate = np.radians(np.stack([board.columns[f"gyro_{axis}_1"] for axis in "xyz"], 1)) - bias
    rate = rate @ np.linalg.inv(matrix.reshape(3, 3)).T
    rate = np.stack([np.convolve(column, np.ones(5) / 5, mode="same") for column in rate.T], 1)
    return rate, np.gradient(rate, 0.01, axis=0)


def disturb(board: il.Recording, what: str, size: float, rng: np.random.Generator) -> il.Recording:
    """Return the board with a disturbance; the motion is in its last 20 s but 5."""
    columns = {name: values.copy() for name, values in board.columns.items()}
    n, names = len(board), [name for name in columns if name != "time"]
    middle, ramp, of_3 = n - 1500, np.linspace(-0.5, 0.5, n), [f"{s}_{a}_3" for s in ("accel", "gyro") for a in "xyz"]
    if what == "loose":  # m, in each coordinate, by a knock in the middle of the motion
        rate, slope = motion(board)
        by = size * rng.choice([-1.0, 1.0], 3)
        force = np.cross(slope, by) + np.cross(rate, np.cross(rate, by))
        readings = force @ np.array(board.metadata["truth_accel_3"].split(), float).reshape(3, 3).T
        for axis, values in zip("xyz", readings.T, strict=True):
            columns[f"accel_{axis}_3"][middle:] += values[middle:]
    elif what in ("gyro", "accel"):  # a bias that drifts, deg/s or m/s^2 over the recording, differently in each
        for name in names:
            if name.startswith(what):
                columns[name] += size * rng.uniform(-1, 1) * ramp
    elif what == "clock":  # of IMU 3, which runs fast
        for name in of_3:
            columns[name] = CubicSpline(columns["time"], columns[name])(columns["time"] * (1 + size))
    elif what == "late":  # IMU 3 is read a sample late from the middle of the motion on
        for name in of_3:
            columns[name][middle:] = np.roll(columns[name], 1)[middle:]
    elif what == "repeated":  # two rows after each other, in so many places
        for row in rng.choice(np.arange(500, n - 500, 7), int(size), replace=False):
            for name in names:
                columns[name][row : row + 2] = columns[name][row - 1]
    elif what == "knocks":  # m/s^2 on the accelerometers of IMU 3, for two samples, ten times
        for row in rng.choice(np.arange(n - 2300, n - 700), 10, replace=False):
            for axis in "xyz":
                columns[f"accel_{axis}_3"][row : row + 2] += size * rng.uniform(-1, 1)
    elif what == "shaken":  # m/s^2 along and 3 times as many rad/s^2 about each axis in the motion, at 37.3 Hz
        time = columns["time"]
        for k in range(1, len(names) // 6 + 1):
            late, place, matrix = (
                np.array(board.metadata[f"truth_{name}_{k}"].split(), float)
                for name in ("latency", "position", "accel")
            )
            phase = 2 * np.pi * 37.3 * (time - late[0])[:, None] + np.array([0.3, 1.9, 4.0])
            force = size * (np.sin(phase) + np.cross(3 * np.sin(phase + 1.0), place))
            force[(time < time[-1] - 24) | (time > time[-1] - 6)] = 0
            for axis, values in zip("xyz", (force @ matrix.reshape(3, 3).T).T, strict=True):
                columns[f"accel_{axis}_{k}"] += values
    elif what == "dropout":  # s without rows, in the motion
        keep = np.ones(n, bool)
        keep[middle : middle + int(100 * size)] = False
        columns = {name: values[keep] for name, values in columns.items()}
    return il.Recording(columns, board.units, board.metadata, name="board.csv")


@lru_cache(maxsize=40)
def fitted(
    seed: int, imus: int, duration: float, age: float, rate: float, what: str, size: float
) -> tuple[dict[str, tuple[Array, Array]] | None, bool]:
    """Return errors and standard uncertainties by name, or None where it is refused, and whether it is warned of."""
    attitudes = int(size) if what == "attitudes" else 12
    board = il.simulate_imus(
        elements=imus, attitudes=attitudes, duration=duration, age=age, rate=rate, seed=1000 + seed
    )
    board = disturb(board, what, size, np.random.default_rng(seed))
    try:
        record = il.calibrate_imus(board, gravity=G).calibration
    except il.ImulabError:
        return None, True
    found = {}
    for name, _, _ in QUANTITIES.values():
        off, u = [], []
        for k in range(1, imus + 1):
            truth = truth_of(board, name, k)
            keys = [f"{name}_{k}"] if len(truth) == 1 else [f"{name}_{axis}_{k}" for axis in "xyz"]
            for key, value in zip(keys, truth, strict=True):
                stated = record.parameters.get(key)
                # A half turn has two rotation vectors; what the frame fixes has no uncertainty.
                if stated is not None and stated.standard_uncertainty and abs(stated.value - value) < np.pi:
                    off.append(stated.value - value)
                    u.append(stated.standard_uncertainty)
        found[name] = np.array(off), np.array(u)
    warned = any(not isinstance(each, Note) for each in record.warnings) or record.verdict.state != "good"
    return found, warned


def trial(
    seed: int, quantity: str = "positions", imus: int = 4, duration: float = 20.0, age: float = 0.0,
    rate: float = 100.0, what: str = "", size: float = 0.0,
) -> Trial:  # fmt: skip
    """Fit one board, and compare one quantity of all its IMUs."""
    found, warned = fitted(seed, imus, duration, age, rate, what, size)
    if found is None:
        return Trial(warned=True)
    name, factor, _ = QUANTITIES[quantity]
    off, u = found[name]
    return Trial(tuple((np.abs(off) < 1.96 * u).tolist()), warned, factor * float(np.sqrt(np.mean(off**2))))


def row(name: str, trials: int = 8, quantity: str = "positions", **options: object) -> Scenario:
    """Return a scenario of one disturbance."""
    asked = {key: options.pop(key) for key in ("coverage", "warned", "false_alarms", "largest_error") if key in options}
    what = partial(trial, quantity=quantity, **options)  # type: ignore[arg-type]
    return Scenario(GROUP, name, what, trials=trials, unit=QUANTITIES[quantity][2], **asked)  # type: ignore[arg-type]


WIDE = (88.0, 100.0)
SCENARIOS = [
    *(row(f"4 IMUs, nothing disturbed: {name}", 16, name, false_alarms=4.0) for name in QUANTITIES),
    row("8 IMUs, 40 s, nothing disturbed: positions", 4, imus=8, duration=40.0, false_alarms=4.0),
    row("32 IMUs, 10 s, nothing disturbed: positions", 2, imus=32, duration=10.0, false_alarms=4.0),
    *(
        row(f"readings up to 1 ms old, 62.5 Hz: {name}", 12, name, age=1e-3, rate=62.5, coverage=(92.0, 100.0))
        for name in ("positions", "latencies of gyroscopes")
    ),
    *(
        row(
            f"attitudes at rest: {count}",
            what="attitudes",
            size=count,
            coverage=WIDE,
            false_alarms=4.0,
        )
        for count in (1, 3)
    ),
    row("the board shakes by 1.5 m/s^2 at 37 Hz in motion", what="shaken", size=1.5, coverage=None, warned=95.0),
    row("an IMU slips by 2.6 mm in the motion", what="loose", size=1.5e-3, coverage=None, warned=95.0),
    row("gyroscopes' biases drift by up to 0.1 deg/s", what="gyro", size=0.1, coverage=WIDE),
    *(
        row(
            f"accelerometers' biases drift by up to 0.02 m/s^2: {name}",
            8,
            name,
            what="accel",
            size=0.02,
            coverage=WIDE,
        )
        for name in ("positions", "biases of accelerometers")
    ),
    row("accelerometers' biases drift by up to 0.2 m/s^2", what="accel", size=0.2, coverage=None, warned=95.0),
    row("one IMU's clock is 2 ppm fast", what="clock", size=2e-6, coverage=WIDE),
    row("one IMU's clock is 100 ppm fast", what="clock", size=1e-4, coverage=None, warned=95.0),
    row("one IMU is a sample late from the middle on", what="late", coverage=None, warned=95.0),
    row("two rows repeated, ten times", what="repeated", size=10, coverage=WIDE),
    row("one IMU is knocked by 20 m/s^2 ten times", what="knocks", size=20.0, coverage=WIDE),
    row("0.5 s without rows in the motion", what="dropout", size=0.5, coverage=WIDE),
]

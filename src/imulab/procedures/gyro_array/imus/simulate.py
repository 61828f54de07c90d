"""A board of IMUs that lies still in several attitudes and is then turned and shaken by hand.

Angles and positions are splines over time, so that rates, angular accelerations and forces are their derivatives, exact
at any time: each chip reads them as late as it is. Nothing here is shared with the fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from imulab.errors import OptionError, listed
from imulab.options import choice, measure
from imulab.quantities import in_si, whole
from imulab.recording import Array, Recording

_KNOT = 0.01  # s
_TURN, _EASE = 1.5, 2.0  # s, from one attitude to the next, and into and out of the motion
_HALF = 0.02  # m
_G = 9.80665
_MOST = 64
_ABOUT = ("xyz", "xy", "x")


@dataclass(frozen=True)
class _Path:
    """Euler angles (about z, then y, then x) and position over time, with their derivatives."""

    angles: Any
    position: Any

    def at(self, time: Array) -> tuple[Array, Array, Array]:
        """Return specific force, rate and angular acceleration in the body frame, shape (n, 3) each."""
        (x, y, _), first, second = (np.moveaxis(self.angles(time, nu), 1, 0) for nu in range(3))
        sin_x, cos_x, sin_y, cos_y = np.sin(x), np.cos(x), np.sin(y), np.cos(y)
        dx, dy, dz = first
        rate = np.stack([dx - dz * sin_y, dy * cos_x + dz * cos_y * sin_x, dz * cos_y * cos_x - dy * sin_x], axis=1)
        across = dz * dy * sin_y
        acceleration = np.stack(
            [
                second[0] - second[2] * sin_y - dz * dy * cos_y,
                second[1] * cos_x
                - dy * dx * sin_x
                + second[2] * cos_y * sin_x
                - across * sin_x
                + dz * dx * cos_y * cos_x,
                second[2] * cos_y * cos_x
                - across * cos_x
                - dz * dx * cos_y * sin_x
                - second[1] * sin_x
                - dy * dx * cos_x,
            ],
            axis=1,
        )
        to_body = np.swapaxes(_turned(self.angles(time)), 1, 2)
        force = np.einsum("nij,nj->ni", to_body, self.position(time, 2) + np.array([0.0, 0.0, _G]))
        return force, rate, acceleration


def _turned(angles: Array) -> Array:
    """Return the matrices from body to level ground, shape (n, 3, 3), Rz Ry Rx."""
    sin, cos = np.sin(angles).T, np.cos(angles).T
    zero, one = np.zeros_like(sin[0]), np.ones_like(sin[0])

    def matrix(rows: list[list[Array]]) -> Array:
        return np.moveaxis(np.array(rows), 2, 0)

    about_x = matrix([[one, zero, zero], [zero, cos[0], -sin[0]], [zero, sin[0], cos[0]]])
    about_y = matrix([[cos[1], zero, sin[1]], [zero, one, zero], [-sin[1], zero, cos[1]]])
    about_z = matrix([[cos[2], -sin[2], zero], [sin[2], cos[2], zero], [zero, zero, one]])
    return np.asarray(about_z @ about_y @ about_x)


def simulate_imus(
    *,
    elements: int | str = 8,
    attitudes: int | str = 12,
    duration: Annotated[float | str, measure("time", "s")] = "40 s",
    rate: Annotated[float | str, measure("frequency", "Hz")] = "100 Hz",
    turning: Annotated[float | str, measure("rate", "deg/s")] = "380 deg/s",
    about: Annotated[str, choice(_ABOUT)] = "xyz",
    age: Annotated[float | str, measure("time", "s")] = "1 ms",
    seed: int | str = 1,
) -> Recording:
    """Simulate a board of whole IMUs that is put down in several attitudes, then turned and shaken by hand.

    The board lies for 5 s in each attitude. Each IMU has misalignments of 2 deg, scale factors of 1 %, biases of
    0.2 m/s^2 and 1 deg/s, latencies within 2 ms, and white noise of 0.03 m/s^2 and 0.1 deg/s a sample. The truth is in
    the head, SI, in the frame of the accelerometers of IMU 1.

    Parameters
    ----------
    elements
        Number of IMUs. At the corners of a cube of 40 mm, or on the sphere about it where there are more than eight.
    attitudes
        Attitudes at rest, before the motion.
    duration
        Of the motion. In s.
    rate
        Sampling rate. In Hz.
    turning
        Root mean square of the rate in motion. In rad/s.
    about
        The axes that the motion turns about.
    age
        Readings are up to so old. In s; each chip samples by a clock of its own, a sawtooth against that of the logger.
    seed
        Seed of the random numbers.

    Raises
    ------
    OptionError
        A value is out of range.

    Examples
    --------
    >>> import imulab as il
    >>> board = il.simulate_imus(elements=4, attitudes=6, duration="10 s")
    >>> "accel_x_4" in board, board.metadata["truth_position_2"]
    (True, '0.04 0.04 0')
    """
    imus, attitudes, seed = whole(elements, "elements"), whole(attitudes, "attitudes"), whole(seed, "seed")
    length, hertz = in_si(duration, "duration", "time", "s"), in_si(rate, "rate", "frequency", "Hz")
    size, old = in_si(turning, "turning", "rate", "deg/s"), in_si(age, "age", "time", "s")
    if about not in _ABOUT:
        raise OptionError(f"about {about!r}: expected one of {listed(_ABOUT, about)}")
    for what, value, low, high in (
        ("elements", imus, 2, _MOST),
        ("attitudes", attitudes, 1, 100),
        ("duration", length, 1, 3600),
        ("rate", hertz, 20, 10_000),
        ("turning", size, 0, 40),
        ("age", old, 0, 0.02),
        ("seed", seed, 0, 2**53),
    ):
        if not low <= value <= high:
            raise OptionError(f"{what} {value:g}: expected {low:g} to {high:g}, in SI")
    rng = np.random.default_rng(seed)
    path, end = path_by_hand(attitudes, length, size, about, rng)
    time = np.arange(int(end * hertz)) / hertz
    position = _positions(imus)
    columns: dict[str, Array] = {"time": time}
    head = {"serial": f"SIM-{seed:04d}", "model": "simulated board"}
    for k in range(imus):
        accel, gyro = _matrices(k, rng)
        bias = rng.normal(0, 0.2, 3), np.radians(rng.normal(0, 1.0, 3))
        late = rng.uniform(-2e-3, 2e-3, 2) * (1.0, k > 0)
        # A clock of the chip's own runs by some parts in a thousand fast or slow against the logger's.
        sawtooth = old * (time * rng.uniform(0.5, 1.5) * hertz * rng.uniform(0.01, 0.2) % 1 - 0.5)
        force, w, al = path.at(time - late[0] - sawtooth)
        force = force + np.cross(al, position[k]) + np.cross(w, np.cross(w, position[k]))
        outputs = force @ accel.T + bias[0] + rng.normal(0, 0.03, (len(time), 3))
        rates = path.at(time - late[1] - sawtooth)[1] @ gyro.T + bias[1]
        rates = np.degrees(rates) + rng.normal(0, 0.1, (len(time), 3))
        for axis, name in enumerate("xyz"):
            columns[f"accel_{name}_{k + 1}"], columns[f"gyro_{name}_{k + 1}"] = outputs[:, axis], rates[:, axis]
        truth = {
            "position": position[k],
            "latency": late,
            "accel": accel.ravel(),
            "gyro": gyro.ravel(),
            "accel_bias": bias[0],
            "gyro_bias": bias[1],
        }
        head |= {f"truth_{name}_{k + 1}": " ".join(f"{v:.9g}" for v in values) for name, values in truth.items()}
    units = {name: "s" if name == "time" else "m/s^2" if name[0] == "a" else "deg/s" for name in columns}
    return Recording(columns, units, head, "simulated board")


def _positions(imus: int) -> Array:
    """Return the positions of the IMUs relative to the first, m, shape (K, 3)."""
    corners = np.array(
        [[-1, -1, -1], [1, 1, -1], [1, -1, 1], [-1, 1, 1], [1, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]]
    )
    if imus <= len(corners):
        places = corners[:imus] * _HALF
    else:
        z = 1 - 2 * (np.arange(imus) + 0.5) / imus
        angle = math.pi * (3 - math.sqrt(5)) * np.arange(imus)
        places = math.sqrt(3) * _HALF * np.stack([*(np.sqrt(1 - z**2) * (np.cos(angle), np.sin(angle))), z], axis=1)
    return np.asarray(places - places[0])


def _matrices(k: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return what the accelerometers and gyroscopes of an IMU make of the body's force and rate, shape (3, 3) each."""
    mounted = np.eye(3)
    if k % 2:  # every second IMU lies on the other side of the board
        mounted = np.diag([1.0, -1.0, -1.0])

    def near_one() -> Array:
        return np.asarray(np.diag(1 + rng.normal(0, 0.01, 3)) + 0.005 * np.triu(rng.normal(0, 1, (3, 3)), 1).T)

    def tilt() -> Array:
        angles = np.radians(rng.normal(0, 2.0, (1, 3)))
        return np.asarray(_turned(angles)[0])

    chip = np.eye(3) if k == 0 else mounted @ tilt()
    upper = 0.005 * np.triu(rng.normal(0, 1, (3, 3)), 1)
    return near_one() @ chip, (near_one() + upper) @ _turned(np.radians(rng.normal(0, 0.1, (1, 3))))[0] @ chip


def path_by_hand(
    attitudes: int, duration: float, turning: float, about: str, rng: np.random.Generator
) -> tuple[_Path, float]:
    """Return the path and when it ends, s."""
    from scipy.interpolate import make_interp_spline

    still = 5.0
    end = attitudes * (still + _TURN) + duration + still
    time = np.arange(0.0, end + 2 * _KNOT, _KNOT)
    faces = np.array([[0, 0], [math.pi, 0], [math.pi / 2, 0], [-math.pi / 2, 0], [0, math.pi / 2], [0, -math.pi / 2]])
    lying = np.column_stack([*faces[np.arange(attitudes) % 6].T, rng.uniform(-3, 3, attitudes)])
    lying += rng.uniform(-0.5, 0.5, lying.shape)  # by hand, and 12 are not 6
    angles = np.repeat(lying[:1], len(time), axis=0)
    for j in range(1, attitudes):
        begin = j * (still + _TURN) - _TURN
        angles += _eased((time - begin) / _TURN)[:, None] * (lying[j] - lying[j - 1])
    begin = attitudes * (still + _TURN) - _TURN
    moving = _eased((time - begin) / _EASE) - _eased((time - begin - duration - _TURN + _EASE) / _EASE)
    # The third angle rests at 0 so that the axes do not fall on one line.
    sway = _sum_of_sines(time, 3, (0.3, 2.0), rng) * [axis in about for axis in "xyz"]
    speed = np.gradient(sway, _KNOT, axis=0)
    sway *= turning / math.sqrt(np.square(speed).sum(1).mean())
    shake = _sum_of_sines(time, 3, (0.5, 4.0), rng)
    pull = np.gradient(np.gradient(shake, _KNOT, axis=0), _KNOT, axis=0)
    shake *= 6.0 / math.sqrt(np.square(pull).mean())
    return _Path(
        make_interp_spline(time, angles + moving[:, None] * sway, k=5),
        make_interp_spline(time, moving[:, None] * shake, k=5),
    ), end


def _eased(share: Array) -> Array:
    """Return 0 before, 1 after, with two smooth derivatives between."""
    x = np.clip(share, 0.0, 1.0)
    return np.asarray(x**3 * (10 - 15 * x + 6 * x**2))


def _sum_of_sines(time: Array, axes: int, band: tuple[float, float], rng: np.random.Generator) -> Array:
    frequency = np.exp(rng.uniform(math.log(band[0]), math.log(band[1]), (axes, 6)))
    phase = rng.uniform(0, 2 * math.pi, (axes, 6))
    angle = 2 * math.pi * frequency[None] * time[:, None, None] + phase
    return np.asarray((np.sin(angle) / frequency).sum(2))

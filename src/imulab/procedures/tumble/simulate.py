"""A simulated tumble test, and a simulated production line.

The forward model is written here on its own, apart from the inverse that `imulab.procedures.tumble.model` fits with.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated

import numpy as np

from imulab.arguments import Folder
from imulab.columns import triad
from imulab.errors import OptionError
from imulab.files import write_text
from imulab.options import PROGRAM, measure, parsed, text
from imulab.procedures.tumble import HIGHEST_ORDER
from imulab.procedures.tumble.mag.simulate import HeadingTurns, rotate, simulate_field
from imulab.quantities import in_si, whole, whole_number
from imulab.recording import Array, Recording
from imulab.units import STANDARD_GRAVITY, conversion_factor, parse_unit
from imulab.writers import write_csv

# A simulated tumble test: a unit turned by hand through static attitudes, with its truth.


_MOST_SAMPLES = 1e7  # of a simulated test: it bounds memory
_RING_FREQUENCY = 12.0  # Hz
_RING_DECAY = 0.08  # s
_KNOCK = 30.0  # m/s^2
_HAND_SWAY = 0.6  # m/s^2
_MEMS_NONLINEARITY = {2: 5e-3, 3: 2e-3, 4: 1e-3, 5: 5e-4}  # in inverse powers of g
_PER_G = {"V": 1.0, "mV": 1000.0, "A": 0.001, "mA": 1.0}
"""Scale factor of outputs, per g; counts otherwise."""


@dataclass(frozen=True)
class _Path:
    """Attitude over time: the upward direction and the rate in the body frame, shape (n, 3), hold and turns."""

    time: Array
    upward: Array
    rate: Array
    hold: np.ndarray
    since_hold: Array
    turns: HeadingTurns


def simulate_tumble(
    *,
    attitudes: Annotated[int | str | Array, parsed(whole_number, "N")] = 24,
    order: int | str = 2,
    truth: Mapping[str, float] | None = None,
    gravity: Annotated[float | str, measure("acceleration", "m/s^2")] = "9.80665 m/s^2",
    rate: Annotated[float | str, measure("frequency", "Hz")] = "100 Hz",
    hold: Annotated[float | str, measure("time", "s")] = "5 s",
    move: Annotated[float | str, measure("time", "s")] = "2 s",
    noise: Annotated[float | str, measure("acceleration", "mg")] = "0.7 mg",
    unit: Annotated[str, text("UNIT")] = "m/s^2",
    scale: float | None = None,
    knock: int | str | None = None,
    knock_shift: float = 5e-3 * STANDARD_GRAVITY,
    gyro: Annotated[bool, PROGRAM] = True,
    field: Annotated[float | str | Array | None, measure("magnetic field", "uT", "48uT")] = None,
    dip: Annotated[float | str, measure("angle", "deg")] = "67 deg",
    temperature: float = 24.0,
    seed: int | str = 1,
) -> Recording:
    """Simulate a tumble recording with columns time, accel_*, gyro_*, temperature, truth_accel_*.

    Between holds the unit turns about one axis with a smooth rate, swayed by the hand; each hold begins with a short
    ringing. ``M = S (A + b)``, ``A = s + k2 s^2 + ...``, ``s = T f`` plus white noise; the truth is in the metadata.

    Parameters
    ----------
    attitudes
        Number of static attitudes. Spread evenly over the sphere; or upward directions in the body frame, shape (n, 3).
    order
        Order of the true nonlinearity, 1 to 5. Of a random truth.
    truth
        Parameters in SI by the names of a record; without it a random MEMS-size sensor.
    gravity
        Local gravity. In m/s^2.
    rate
        Sample rate. In Hz.
    hold
        Duration of an attitude. In s.
    move
        Duration of the motion between two. In s.
    noise
        Standard deviation of one sample. In m/s^2.
    unit
        Unit of the outputs: m/s^2 g mg count V. Of the accelerometers' columns; ``count`` also rounds to whole counts.
    scale
        Nominal scale factor, output per m/s^2; for acceleration units the conversion factor.
    knock
        Number of an attitude that is knocked. From 1; half-way through it keeps a shifted zero.
    knock_shift
        That shift, along the vertical, m/s^2.
    gyro
        Whether the recording has gyroscope columns.
    field
        Magnitude of the magnetic field, for columns mag_*. In T, with truth_mag_*; or the field in the body frame in
        the first attitude, shape (3,), which has a dip of its own. None without a field.
    dip
        Its dip, positive where it points down. In rad.
    temperature
        degC.
    seed
        Seed of the random numbers.

    Raises
    ------
    OptionError
        A value is out of range.

    Examples
    --------
    >>> import imulab as il
    >>> il.simulate_tumble(attitudes=12, hold="3 s", unit="g").units["accel_x"]
    'g'
    """
    order, seed = whole(order, "order"), whole(seed, "seed")
    knock = None if knock is None else whole(knock, "knock")
    sample_rate, gravity = in_si(rate, "rate", "frequency", "Hz"), in_si(gravity, "gravity", "acceleration", "m/s^2")
    hold, move = in_si(hold, "hold", "time", "s"), in_si(move, "move", "time", "s")
    noise = in_si(noise, "noise", "acceleration", "mg")
    _check(order, sample_rate, hold, move, noise, gravity, seed)
    rng = np.random.default_rng(seed)
    directions = _directions(attitudes, rng)
    if knock is not None and not 1 <= knock <= len(directions):
        raise OptionError(f"knock {knock}: expected the number of an attitude, 1 to {len(directions)}")
    sensor = _sensor(truth, order, _nominal_scale(unit, scale), rng)
    samples = len(directions) * (hold + move) * sample_rate
    if samples > _MOST_SAMPLES:
        raise OptionError(f"{samples:.3g} samples of all attitudes together: expected at most {_MOST_SAMPLES:.0e}")
    path = _path(directions, sample_rate, hold, move, rng)
    force = gravity * path.upward
    felt = force + _disturbances(path, hold, knock, rng)
    if knock is not None:
        struck = (path.hold == knock - 1) & (path.since_hold >= hold / 2)
        felt[struck] += knock_shift * path.upward[struck]
    output = _forward(felt + noise * rng.standard_normal(felt.shape), sensor)
    if parse_unit(unit).symbol == "count":
        output = np.round(output)
    columns, units = {"time": path.time}, {"time": "s"}
    _put(columns, units, "accel", output, unit)
    if gyro:
        rates, gyro_truth = _gyro(path.rate, rng, sensor)
        sensor |= gyro_truth
        _put(columns, units, "gyro", rates, "deg/s")
    if field is not None:
        magnetometers = simulate_field(path.turns, directions[0], field, dip, sensor, seed)
        sensor |= magnetometers.truth
        _put(columns, units, "mag", magnetometers.outputs, "uT")
        _put(columns, units, "truth_mag", magnetometers.field, "uT")
    columns["temperature"] = np.round(temperature + 0.05 * rng.standard_normal(len(path.time)), 2)
    units["temperature"] = "degC"
    _put(columns, units, "truth_accel", force, "m/s^2")
    metadata = {"serial": f"SIM-{seed:04d}", "model": "simulated triad", "gravity": f"{gravity!r} m/s^2"}
    metadata |= {f"truth_{name}": repr(float(value)) for name, value in sensor.items()}
    return Recording(columns=columns, units=units, metadata=metadata, name="simulated tumble")


def _directions(attitudes: int | str | Array, rng: np.random.Generator) -> Array:
    """Return the upward directions that were given, or so many spread evenly, shape (n, 3)."""
    if isinstance(attitudes, int | str):
        return _spread(whole(attitudes, "attitudes"), rng)
    directions = np.asarray(attitudes, dtype=np.float64)
    if directions.ndim != 2 or directions.shape[1] != 3 or not np.isfinite(directions).all():
        raise OptionError(f"attitudes: expected upward directions, shape (n, 3), found shape {directions.shape}")
    return directions


def _sensor(
    truth: Mapping[str, float] | None, order: int, nominal: float, rng: np.random.Generator
) -> dict[str, float]:
    """Return the parameters that were given, or random ones."""
    sensor = _random_sensor(rng, order, nominal) if truth is None else dict(truth)
    for name in _random_sensor(np.random.default_rng(0), 1, nominal):
        if name not in sensor:
            raise OptionError(f"truth: no {name!r}; expected bias, scale factor and misalignment of each axis")
    return sensor


def _put(columns: dict[str, Array], units: dict[str, str], stem: str, values: Array, unit: str) -> None:
    """Add the columns of a triad, shape (m, 3)."""
    for name, column in zip(triad(stem), values.T, strict=True):
        columns[name], units[name] = column.copy(), unit


def _check(order: int, sample_rate: float, hold: float, move: float, noise: float, gravity: float, seed: int) -> None:
    if not 1 <= order <= HIGHEST_ORDER:
        raise OptionError(f"order {order}: expected 1 to {HIGHEST_ORDER}")
    for name, value, low, high in (
        ("sample rate", sample_rate, 10.0, 1e5),
        ("hold", hold, 0.5, 3600.0),
        ("move", move, 0.2, 3600.0),
        ("noise", noise, 0.0, 1e3),
        ("gravity", gravity, 0.5, 50.0),
    ):
        if not low <= value <= high:
            raise OptionError(f"{name} {value:g}: expected {low:g} to {high:g}")
    if seed < 0:
        raise OptionError(f"seed {seed}: expected a whole number from 0")


def _spread(count: int, rng: np.random.Generator) -> Array:
    """Directions spread evenly over the sphere and loosely turned, shape (count, 3)."""
    if not 2 <= count <= 10_000:
        raise OptionError(f"attitudes {count}: expected 2 to 10000")
    index = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * index / count), np.pi * (1 + 5**0.5) * index
    points = np.column_stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    points = rng.permutation(points @ turn.T) + 0.05 * rng.standard_normal((count, 3))
    directions: Array = points / np.linalg.norm(points, axis=1, keepdims=True)
    return directions


def _nominal_scale(unit: str, scale: float | None) -> float:
    known = parse_unit(unit, ("acceleration", "output"))
    if known.quantity == "acceleration":
        return conversion_factor("m/s^2", known.symbol)
    if known.quantity != "output":
        raise OptionError(f"unit {unit}: expected m/s^2 g mg count V")
    return scale if scale is not None else _PER_G.get(known.symbol, 4096.0) / STANDARD_GRAVITY


def _random_sensor(rng: np.random.Generator, order: int, nominal: float) -> dict[str, float]:
    """MEMS-size errors: scale 3 %, bias 50 mg, misalignment 2 deg, k2 5 mg/g^2, ..."""
    g = STANDARD_GRAVITY
    sensor = {f"bias_{a}": 0.05 * g * rng.uniform(-1, 1) for a in "xyz"}
    sensor |= {f"scale_factor_{a}": nominal * (1 + 0.03 * rng.uniform(-1, 1)) for a in "xyz"}
    sensor |= {f"misalignment_{p}": np.radians(2) * rng.uniform(-1, 1) for p in ("yx", "zx", "zy")}
    for power in range(2, order + 1):
        size = _MEMS_NONLINEARITY[power] / g ** (power - 1)
        sensor |= {f"k{power}_{a}": size * rng.uniform(-1, 1) for a in "xyz"}
    return sensor


def _forward(force: Array, sensor: Mapping[str, float]) -> Array:
    """Outputs of the triad for specific forces, shape (n, 3)."""
    fx, fy, fz = force.T
    sensed = {
        "x": fx,
        "y": sensor["misalignment_yx"] * fx + fy,
        "z": sensor["misalignment_zx"] * fx + sensor["misalignment_zy"] * fy + fz,
    }
    output = np.empty_like(force)
    for column, (axis, s) in enumerate(sensed.items()):
        reading = s + sum(sensor.get(f"k{power}_{axis}", 0.0) * s**power for power in range(2, HIGHEST_ORDER + 1))
        output[:, column] = sensor[f"scale_factor_{axis}"] * (reading + sensor[f"bias_{axis}"])
    return output


def _path(directions: Array, sample_rate: float, hold: float, move: float, rng: np.random.Generator) -> _Path:
    """Hold each direction, and turn to the next about one axis with a minimum-jerk angle."""
    count = len(directions)
    resting, moving = round(hold * sample_rate), round(move * sample_rate)
    samples = count * resting + (count - 1) * moving
    index = np.arange(samples)
    number, phase = index // (resting + moving), index % (resting + moving)
    tau = np.clip((phase - resting + 1) / (moving + 1), 0.0, 1.0)
    angle = tau**3 * (10 - 15 * tau + 6 * tau**2)
    speed = 30 * tau**2 * (1 - tau) ** 2 * sample_rate / (moving + 1)
    axis, full = _turns(directions, rng)
    turns = HeadingTurns(np.vstack([axis, axis[-1:]]), np.append(full, 0.0), number, angle)
    axis, full = turns.axis[number], turns.full[number]
    # The body turns by +angle about the axis, so that the upward direction turns by -angle in its frame.
    turned = rotate(directions[number], axis, -full * angle)
    return _Path(
        time=index / sample_rate,
        upward=turned,
        rate=axis * (full * speed)[:, None],
        hold=np.where(phase < resting, number, -1),
        since_hold=phase / sample_rate,
        turns=turns,
    )


def _turns(directions: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Axis and angle that turn the body from each direction up to the next one up, shapes (n - 1, 3) and (n - 1,)."""
    here, there = directions[:-1], directions[1:]
    across, between = np.cross(there, here), here + there
    tilt = rng.uniform(-0.7, 0.7, len(here))[:, None]
    axis = np.cos(tilt) * _unit(across, [1.0, 0.0, 0.0]) + np.sin(tilt) * _unit(between, [0.0, 0.0, 1.0])
    axis = _unit(axis, [1.0, 0.0, 0.0])
    a = here - axis * np.einsum("ni,ni->n", axis, here)[:, None]
    b = there - axis * np.einsum("ni,ni->n", axis, there)[:, None]
    angle = np.arctan2(np.einsum("ni,ni->n", axis, np.cross(b, a)), np.einsum("ni,ni->n", a, b))
    return axis, angle


def _unit(vectors: Array, instead: list[float]) -> Array:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    unit: Array = np.where(length > 1e-9, vectors / np.maximum(length, 1e-9), instead)
    return unit


def _disturbances(path: _Path, hold: float, knock: int | None, rng: np.random.Generator) -> Array:
    """Sway while the hand moves the unit, ringing when it is put down and when it is knocked, m/s^2."""
    count = len(path.time)
    moving = path.hold < 0
    sway = np.zeros((count, 3))
    for frequency in (1.3, 2.9, 6.1):
        phase = rng.uniform(0, 2 * np.pi, 3)
        sway += _HAND_SWAY * np.sin(2 * np.pi * frequency * path.time[:, None] + phase)
    sway *= moving[:, None]
    ring = np.exp(-path.since_hold / _RING_DECAY) * np.sin(2 * np.pi * _RING_FREQUENCY * path.since_hold)
    sway += np.where(moving, 0.0, ring)[:, None] * rng.uniform(0.2, 1.0, 3)
    if knock is not None:
        since = path.since_hold - hold / 2
        struck = (path.hold == knock - 1) & (since >= 0)
        pulse = _KNOCK * np.exp(-np.maximum(since, 0) / _RING_DECAY) * np.cos(2 * np.pi * _RING_FREQUENCY * since)
        sway += np.where(struck, pulse, 0.0)[:, None] * np.array([1.0, -0.6, 0.4])
    return sway


def _gyro(rate: Array, rng: np.random.Generator, known: Mapping[str, float]) -> tuple[Array, dict[str, float]]:
    """Outputs of a gyroscope triad, deg/s: M = S (T w + b), and its truth in SI: that known, or else a random one."""
    bias = np.radians(0.3) * rng.uniform(-1, 1, 3)
    scale = 1 + 0.01 * rng.uniform(-1, 1, 3)
    misalignment = np.eye(3) + np.radians(1) * rng.uniform(-1, 1, (3, 3)) * (1 - np.eye(3))
    if "gyro_bias_x" in known:
        bias = np.array([known[f"gyro_bias_{a}"] for a in "xyz"])
        scale = np.radians([known[f"gyro_scale_factor_{a}"] for a in "xyz"])
        misalignment = np.array([[known.get(f"gyro_misalignment_{a}{b}", 1.0) for b in "xyz"] for a in "xyz"])
    sensed = rate @ misalignment.T + bias + np.radians(0.05) * rng.standard_normal(rate.shape)
    truth = {f"gyro_bias_{a}": float(bias[i]) for i, a in enumerate("xyz")}
    truth |= {f"gyro_scale_factor_{a}": float(np.degrees(scale[i])) for i, a in enumerate("xyz")}
    truth |= {
        f"gyro_misalignment_{a}{b}": float(misalignment[i, j])
        for i, a in enumerate("xyz")
        for j, b in enumerate("xyz")
        if i != j
    }
    return np.degrees(sensed * scale), truth


# A simulated production line: units that are calibrated twice, with what a line must notice built in.


_FEWEST, _MOST = 8, 2000  # units of a simulated fleet: fewer have no statistics, more take minutes
_BEGIN = datetime(2026, 3, 2, 9)
_AGAIN = timedelta(days=182)
_FAR_OFF, _CHANGED = 4, 6  # number of the unit with a bias far off the others', and of that whose bias changes
LIMITS = """[tumble]
"bias_*" = { lower = -40, upper = 40, unit = "mg" }
"scale_factor_*" = { lower = -9000, upper = 9000, unit = "ppm" }
"misalignment_*" = { lower = -6, upper = 6, unit = "mrad" }
"""


def simulate_fleet(
    folder: Folder,
    *,
    units: int | str = 12,
    rate: Annotated[float | str, measure("frequency", "Hz")] = "100 Hz",
    seed: int | str = 1,
) -> tuple[Path, Path]:
    """Write the recordings of a line's units, two manifests and limits; return the paths of the manifests.

    ``first.csv`` calibrates every unit, one a day; ``second.csv`` the same units half a year later. The zero of z
    drifts by 2 mg from unit to unit, unit 5 is 60 mg off in x, and unit 7 changes by 5 mg in y between the two.

    Parameters
    ----------
    folder
        Made if it is not there.
    units
        Number of units, 8 or more. At most 2000.
    rate
        Sample rate.
    seed
        Seed of the random numbers.

    Raises
    ------
    OptionError
        A value is out of range, or the folder cannot be written to.

    Examples
    --------
    >>> import imulab as il
    >>> [manifest.name for manifest in il.simulate_fleet("line", units=8)]
    ['first.csv', 'second.csv']
    """
    units, seed = whole(units, "units"), whole(seed, "seed")
    if not _FEWEST <= units <= _MOST:
        raise OptionError(f"units {units}: expected {_FEWEST} to {_MOST}")
    if seed < 0:
        raise OptionError(f"seed {seed}: expected a whole number from 0")
    home = Path(folder)
    try:
        home.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OptionError(f"{home}: the folder cannot be made: {error.strerror}") from None
    rng = np.random.default_rng(seed)
    mg = 1e-3 * STANDARD_GRAVITY
    truths = [
        {f"bias_{a}": float(v) for a, v in zip("xyz", rng.normal(0, 4 * mg, 3), strict=True)}
        | {f"scale_factor_{a}": float(1 + v) for a, v in zip("xyz", rng.normal(0, 2e-3, 3), strict=True)}
        | {f"misalignment_{p}": float(v) for p, v in zip(("yx", "zx", "zy"), rng.normal(0, 1.5e-3, 3), strict=True)}
        for _ in range(units)
    ]
    for number, truth in enumerate(truths):
        truth["bias_z"] += 2 * number * mg
    truths[_FAR_OFF]["bias_x"] += 60 * mg
    manifests = []
    for name, begin in (("first", _BEGIN), ("second", _BEGIN + _AGAIN)):
        rows = ["serial,procedure,file,gravity,order"]
        for number, truth in enumerate(truths):
            moved = 5 * mg if name == "second" and number == _CHANGED else 0.0
            recording = simulate_tumble(
                attitudes=16, truth=truth | {"bias_y": truth["bias_y"] + moved}, hold=3.0, move=1.0, gyro=False,
                rate=rate, seed=int(rng.integers(1 << 31)),
            )  # fmt: skip
            serial, date = f"LINE-{number + 1:04d}", (begin + timedelta(days=number)).isoformat()
            file = f"{name}_{number + 1:04d}.csv"
            head = {"serial": serial, "date": date, **{k: v for k, v in recording.metadata.items() if k != "serial"}}
            write_csv(replace(recording, metadata=head), home / file)
            rows.append(f"{serial},tumble,{file},{STANDARD_GRAVITY},1")
        manifests.append(home / f"{name}.csv")
        write_text(manifests[-1], "\n".join(rows) + "\n")
    write_text(home / "limits.toml", LIMITS)
    return manifests[0], manifests[1]

"""A board of whole IMUs calibrated from one recording: rests, then motion by hand; and what is to be said of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Unpack

import numpy as np

from imulab.display import Bad, Finding, Note
from imulab.errors import OptionError
from imulab.estimation.rows import quantile
from imulab.gravity import Gravity, Height, Latitude, LocalGravity, at_place, gravity_findings, local_gravity
from imulab.options import RARE, measure, text
from imulab.procedures.gyro_array.imus.columns import readings_of
from imulab.procedures.gyro_array.imus.fuse import ranges
from imulab.procedures.gyro_array.imus.logs import prepare_board, with_all_instances
from imulab.procedures.gyro_array.imus.model import (
    ACCEL,
    ACCEL_BIAS,
    ACCEL_LATENCY,
    ACCELERATION,
    FORCE,
    GYRO,
    GYRO_LATENCY,
    NUMBERS,
    POSITION,
    RATE,
    predicted,
)
from imulab.procedures.gyro_array.imus.prepare import MOVING, Prepared, names_of
from imulab.procedures.gyro_array.imus.record import GAUGE, make_record
from imulab.procedures.gyro_array.imus.schema import (
    AT_ACCEL_BIAS,
    AT_ACCEL_SCALE,
    BoardSize,
    Common,
    ImusData,
    ImusModel,
    ImusSummary,
    MotionData,
    SizeFrom,
    Three,
)
from imulab.procedures.gyro_array.imus.size import Factor, by_gravity
from imulab.procedures.gyro_array.imus.solve import (
    PRIOR,
    STRETCHES,
    Held,
    Solution,
    common_accel,
    mean_scale,
    solve,
    with_scale,
)
from imulab.procedures.result import Result, as_recording
from imulab.quantities import in_si, quantity, whole_number, with_uncertainty
from imulab.recording import Array, Data, Reading, Recording
from imulab.records.calibration import Calibration
from imulab.records.sections import Above0, Length, Measured, StatedGravity

_ATTITUDES = 6  # fewest that tell common scale factors and biases of the accelerometers
_APART = math.cos(math.radians(20.0))  # between directions that count as two attitudes
_HELD = (0.01, 0.1)  # from nominal, of common scale and bias, m/s^2, where they are not told
_UNTOLD = 0.5  # of a prior's standard deviation: what is less is told by the recording
_SHORT, _CLIPPED, _BEYOND, _SIGMA = 5.0, 0.1, 0.5, 3.0  # s, share, m, standard deviations
_UNLIKE_REST = 3.0  # times the noise at rest
_UNEXPLAINED = 1.5  # the same of accelerometers, beyond what the age of readings explains
_SHAKEN = 25.0  # times the noise at rest above a third of the sampling rate, where splines no longer follow
_QUARTILE = 1.15  # standard deviations that three quarters of normal numbers stay within
_BOARD = 2e-4  # m: uncertainty of a stated distance, unless stated
_ONE_CHIP = 3e-4  # m: two chips are farther apart, on two sides of a board too
_BENT, _SLIPPED = 2e-5, 1e-4  # m, s: differences of halves below these do no harm
_LATER = 6.0  # standard deviations: twice as many latencies as IMUs are compared, with ages that a sawtooth moves
_DRIFTED = 0.01  # m/s^2 between rests, above which positions of 20 mm boards are wrong by 0.1 mm and more


@dataclass(frozen=True, repr=False)
class ImusFit(Result):
    """Result of `calibrate_imus`; ``calibration`` is the record.

    Examples
    --------
    >>> import imulab as il
    >>> board = il.simulate_imus(elements=2, attitudes=6, duration="10 s", rate="50 Hz")
    >>> il.calibrate_imus(board, gravity=9.80665).calibration.model["kind"]
    'imus'
    """

    calibration: Calibration


@dataclass(frozen=True)
class Distance:
    """A distance between two IMUs, counted from 0, that is known from the board's drawing; m."""

    first: int
    second: int
    length: float
    u: float

    @property
    def option(self) -> dict[str, str]:
        """The option that states it."""
        return {"distance": f"{self.first + 1}:{self.second + 1}:{self.length!r}m+-{self.u!r}m"}


def parse_distance(stated: str, option: str = "distance") -> Distance:
    """Return a text such as ``1:8:53.9mm`` or ``1:8:53.9mm+-0.1mm``.

    Raises
    ------
    OptionError
        It is none.
    """
    words = stated.split(":")
    if len(words) != 3:
        raise OptionError(f"{option} {stated!r}: expected IMU:IMU:LENGTH, such as 1:8:53.9mm+-0.1mm")
    first, second = (whole_number(word, option) - 1 for word in words[:2])
    value, spread = with_uncertainty(words[2])
    length = quantity(value.strip(), option, "length", "m")
    u = _BOARD if spread is None else quantity(spread.strip(), option, "length", "m")
    if first == second or min(first, second) < 0 or length <= 0 or u <= 0:
        raise OptionError(f"{option} {stated!r}: expected two IMUs, counted from 1, and a length above 0")
    return Distance(first, second, length, u)


def calibrate_imus(
    data: Data,
    *,
    distance: Annotated[str | None, text("IMU:IMU:LENGTH")] = None,
    tolerance: Annotated[float | str, measure("number", "1")] = 0.01,
    gyro_range: Annotated[float | str | None, measure("rate", "deg/s"), RARE] = None,
    accel_range: Annotated[float | str | None, measure("acceleration", "g"), RARE] = None,
    gravity: LocalGravity = None,
    latitude: Latitude = None,
    height: Height = None,
    **reading: Unpack[Reading],
) -> ImusFit:
    """Calibrate a board of whole IMUs from one recording: it lies still in several attitudes and is turned and shaken.

    Of each IMU: where it sits, how it is turned, how late its accelerometers and gyroscopes answer, their biases, scale
    factors and misalignments; no reference but gravity. ``y_a = Ta [s + (W^2 + [al]x) r](t - ta) + ba``,
    ``y_g = Tg w(t - tg) + bg``, with s, al, w free in each sample.

    Parameters
    ----------
    data
        A file, recording or data frame with columns ``accel_x_1 .. gyro_z_K`` of K IMUs; of a PX4 or ArduPilot log all
        instances are read.
    distance
        A distance on the board that is known: 1:8:53.9mm+-0.1mm. Between the sensing elements of two IMUs; without an
        uncertainty 0.2 mm. It gives the size of the board where it tells that better than gravity between rests.
    tolerance
        How well the mean scale factor of all gyroscopes is known. A standard uncertainty; the size of the board, known
        half as well, rests on it where neither gravity between rests nor a distance tell more.
    gyro_range, accel_range
        Largest reading of the gyroscopes, and of the accelerometers, for fusion; found where the recording reaches it.
    gravity
        As for `fit_tumble`.
    latitude, height
        As for `fit_tumble`.
    reading
        How files are to be understood: `units`, `layout`, `topic`, `instance`, `window`, `element`.

    Raises
    ------
    DataError
        Columns are missing, dead or in another unit; there is no rest, or too little motion within the range.
    ObservabilityError
        The motion does not turn about every axis, or a log cannot tell for another reason, which is stated.
    OptionError
        An option has a value that cannot be.

    Source: Skog et al., IEEE Trans. Signal Process. 64 (2016) 4218; Carlsson, Skog, Jalden, IEEE Sensors J. 21 (2021)
    8451.

    Examples
    --------
    >>> import imulab as il
    >>> board = il.simulate_imus(elements=2, attitudes=6, duration="10 s", rate="50 Hz")
    >>> il.calibrate_imus(board, gravity=9.80665).calibration.sections["origin"]
    'imu 1'
    """
    known = None if distance is None else parse_distance(distance)
    spread = in_si(tolerance, "tolerance", "number", "1")
    if not 1e-6 <= spread <= 0.2:
        raise OptionError(f"tolerance {spread:g}: expected a standard uncertainty of 1e-6 to 0.2, such as 0.01")
    stated = at_place(gravity, latitude, height)
    recording = as_recording(data, with_all_instances(data, reading), calibrate_imus)
    named = {"gyro_range": gyro_range, "accel_range": accel_range}
    return fit_board(recording, local_gravity(stated, recording), known, spread, named)


def fit_board(
    recording: Recording,
    gravity: Gravity,
    distance: Distance | None,
    tolerance: float,
    stated: dict[str, float | str | None],
) -> ImusFit:
    """Calibrate a board; `stated` are its ``gyro_range`` and ``accel_range``; errors as for `calibrate_imus`."""
    prepared = prepare_board(recording, gravity.value)
    measured = prepared.measured
    limits = np.broadcast_to(ranges([recording], stated["gyro_range"], stated["accel_range"]), (2, measured.count))
    if distance is not None and max(distance.first, distance.second) >= measured.count:
        raise OptionError(f"distance: expected IMUs 1 to {measured.count}, as {recording.name} has")
    row = mean_scale(measured)
    attitudes = count_attitudes(_directions(prepared))
    held = [] if attitudes >= _ATTITUDES else _held_nominal(prepared)
    nominal = Held(row, 1.0, tolerance)
    solution = solve(measured, prepared.start, prepared.motion, nominal, held)
    factors: dict[SizeFrom, Factor | None] = {
        "gravity": by_gravity(prepared, solution.board, solution.force),
        "stated": None if distance is None else _by_distance(solution, distance),
        "gyro scale": Factor(1.0, tolerance),
    }
    source = min((u.u, name) for name, u in factors.items() if u is not None)[1]
    factor = factors[source]
    assert factor is not None
    solution = with_scale(solution, factor.value)
    size = Held(row, 1 / factor.value, factor.u)
    covariance, widening = solution.covariance(size)
    apart, deviation = solution.halves(size)
    names, unknown = _not_determined(prepared, covariance, source, attitudes)
    summary = _summary(prepared, solution, factors, factor, widening, apart, deviation, _bridged(recording, limits))
    findings = [
        *gravity_findings(gravity, recording),
        *prepared.notes,
        *warn_motion(prepared, attitudes),
        *warn_positions(solution, covariance),
        *warn_halves(solution, apart, deviation),
        *warn_rests(prepared, solution),
        *warn_scatter(summary, _scatter_by_age(prepared, solution)),
        *warn_shaking(prepared),
        *warn_size(factors, source),
    ]
    at_rest = measured.accel_noise / prepared.correlation[0], measured.gyro_noise / prepared.correlation[1]
    record = make_record(
        recording, solution.board, covariance, at_rest, limits,
        model=ImusModel(
            kind="imus", imus=measured.count, gauge=GAUGE, gravity=StatedGravity.of(gravity),
            units=[recording.units["accel_x_1"], recording.units["gyro_x_1"]],
        ),
        fit=summary, data=ImusData(motion=_motion_data(prepared, solution)),
        common=_common(prepared, solution, covariance) if attitudes >= _ATTITUDES else Common(),
        size_from=source, not_determined=names, unknown=unknown, warnings=findings,
        options={
            "gravity": gravity.option, "tolerance": tolerance, **({} if distance is None else distance.option),
            **{name: value for name, value in stated.items() if value is not None},
        },
    )  # fmt: skip
    return ImusFit(record)


def _held_nominal(prepared: Prepared) -> list[Held]:
    """Return common scale factors and biases as near to their nominal values as those of ordinary chips are."""
    rows = common_accel(prepared.measured)
    return [Held(row, 1.0, _HELD[0]) for row in rows[:3]] + [Held(row, 0.0, _HELD[1]) for row in rows[3:]]


def _directions(prepared: Prepared) -> Array:
    """Return the mean direction of gravity in each rest, in the nominal body frame, shape (rests, 3)."""
    mean = np.einsum("kji,nkj->ni", prepared.measured.nominal, prepared.measured.rest_accel)
    return np.asarray(mean / np.linalg.norm(mean, axis=1, keepdims=True))


def count_attitudes(directions: Array) -> int:
    """Return the number of directions, shape (n, 3), that are 20 deg or more apart."""
    chosen: list[Array] = []
    for direction in directions:
        if all(float(direction @ other) < _APART for other in chosen):
            chosen.append(direction)
    return len(chosen)


def _by_distance(solution: Solution, distance: Distance) -> Factor:
    length = float(np.linalg.norm(np.subtract(*solution.board.position[[distance.first, distance.second]])))
    return Factor(math.sqrt(length / distance.length), 0.5 * distance.u / distance.length)


# What the record holds beside the board.


def _bridged(recording: Recording, limits: Array) -> float:
    """Return the share of samples with a gyroscope at the end of its range, as fusion takes it."""
    rates = readings_of(recording, names_of(recording))[:, 1]
    return float((np.abs(rates) >= limits[1, :, None]).any(axis=(1, 2)).mean())


def _summary(
    prepared: Prepared, solution: Solution, factors: dict[SizeFrom, Factor | None], chosen: Factor, widening: float,
    apart: Array, deviation: Array, bridged: float,
) -> ImusSummary:  # fmt: skip
    def size_of(name: SizeFrom) -> Measured | None:
        factor = factors[name]
        if factor is None:
            return None
        return Measured(value=(chosen.value / factor.value) ** 2, standard_uncertainty=2 * factor.u, unit="1")

    def rms(values: Array) -> float:
        return float(np.sqrt(np.square(values).mean()))

    accel, gyro = solution.residuals
    z = (apart / deviation)[1:, POSITION]
    return ImusSummary(
        sample_rate=Above0(value=prepared.rate, unit="Hz"), duration=Above0(value=prepared.duration, unit="s"),
        samples_in_motion=len(solution.motion), rests=len(prepared.rests), clipped=prepared.clipped,
        bridged=bridged,
        axis_rates=Three(value=prepared.axis_rates.tolist(), standard_uncertainty=[None] * 3, unit="rad/s"),
        accel_residual=Length(value=rms(accel), unit="m/s^2"), gyro_residual=Length(value=rms(gyro), unit="rad/s"),
        accel_factor=float(np.median(solution.weights.accel)), gyro_factor=float(np.median(solution.weights.gyro)),
        age=Length(value=solution.weights.age, unit="s"), coherence=_coherence(prepared, solution),
        widening=widening, halves=rms(z),
        size=BoardSize(gravity=size_of("gravity"), stated=size_of("stated"), gyro_scale=size_of("gyro scale")),
    )  # fmt: skip


def _coherence(prepared: Prepared, solution: Solution) -> float:
    """Return the correlation of the angular acceleration from the accelerometers with the derivative of the rate."""
    time, motion = prepared.measured.time, solution.motion
    run = np.searchsorted(prepared.measured.first, np.arange(len(time)), side="right")
    inner = run[2:] == run[:-2]
    slope = (motion[2:, RATE] - motion[:-2, RATE])[inner] / (time[2:] - time[:-2])[inner, None]
    al = motion[1:-1, ACCELERATION][inner]
    return float((slope * al).sum() / max(math.sqrt((slope**2).sum() * (al**2).sum()), 1e-300))


def _scatter_by_age(prepared: Prepared, solution: Solution) -> float:
    """Return the scatter of the accelerometers in motion over that at rest, as far as the age of readings makes it."""
    measured = prepared.measured
    change = np.median([np.square(spline(measured.time, 1)).mean(axis=1) for spline in measured.accel])
    return float(math.sqrt(1 + solution.weights.age**2 * change / np.square(measured.accel_noise).mean()))


def _motion_data(prepared: Prepared, solution: Solution) -> MotionData:
    accel, gyro = (np.square(values).mean(axis=2) for values in solution.residuals)
    parts = np.array_split(np.arange(len(accel)), STRETCHES)
    time = prepared.measured.time - prepared.time[0]
    rate = np.square(solution.motion[:, RATE]).sum(axis=1)
    return MotionData(
        time=[float(time[part].mean()) for part in parts],
        rate=[float(math.sqrt(rate[part].mean())) for part in parts],
        accel_residual=[np.sqrt(accel[part].mean(axis=0)).tolist() for part in parts],
        gyro_residual=[np.sqrt(gyro[part].mean(axis=0)).tolist() for part in parts],
    )


def _common(prepared: Prepared, solution: Solution, covariance: Array) -> Common:
    """Return the mean scale factors and biases of all accelerometers along the body axes."""
    rows, numbers = common_accel(prepared.measured), solution.board.numbers.ravel()
    values = [float(row @ numbers) for row in rows]
    u = [float(math.sqrt(row @ covariance @ row)) for row in rows]
    return Common(
        accel_scale_factor=Three(value=values[:3], standard_uncertainty=list(u[:3]), unit="1"),
        accel_bias=Three(value=values[3:], standard_uncertainty=list(u[3:]), unit="m/s^2"),
    )


_NAMES = (
    ("accelerometers' matrix", ACCEL),
    ("accelerometers' bias", ACCEL_BIAS),
    ("position", POSITION),
    ("accelerometers' latency", slice(ACCEL_LATENCY, ACCEL_LATENCY + 1)),
    ("gyroscopes' matrix", GYRO),
    ("gyroscopes' latency", slice(GYRO_LATENCY, GYRO_LATENCY + 1)),
)


def _not_determined(
    prepared: Prepared, covariance: Array, source: SizeFrom, attitudes: int
) -> tuple[list[str], list[slice]]:
    """Return what the recording does not tell, by name, and the parameters without an uncertainty for that reason."""
    names = []
    if source == "gyro scale":
        names.append("size of the board and mean scale of the gyroscopes: nominal")
    unknown = []
    if attitudes < _ATTITUDES:
        names.append(f"common scale factors and biases of the accelerometers: nominal, {attitudes} attitudes of 6")
        unknown = [AT_ACCEL_BIAS, AT_ACCEL_SCALE]
    deviation = np.sqrt(np.diag(covariance)).reshape(-1, NUMBERS)
    for name, place in _NAMES:
        undetermined = [k + 1 for k, u in enumerate(deviation[:, place]) if (u > _UNTOLD * PRIOR[place]).any()]
        if undetermined:
            names.append(f"{name} of IMU {' '.join(map(str, undetermined))}")
    return names, unknown


# What is said of a fit.


def warn_motion(prepared: Prepared, attitudes: int) -> list[str]:
    """Return what rests and motion leave out."""
    findings: list[str] = []
    slowest = float(prepared.axis_rates.min())
    if slowest < MOVING:
        axis = "xyz"[int(np.argmin(prepared.axis_rates))]
        findings.append(
            Finding(
                f"turned about body {axis} by {math.degrees(slowest):.2g} deg/s rms only: positions and gyroscopes' "
                "matrices are poorly told",
                "record again, turned about all three axes",
            )
        )
    if prepared.duration < _SHORT:
        findings.append(
            Finding(
                f"{prepared.duration:.2g} s of motion: below 5 s positions can be wrong by millimetres",
                "turn and shake the board for 10 s or more",
            )
        )
    if prepared.clipped > _CLIPPED:
        findings.append(
            Finding(
                f"{100 * prepared.clipped:.2g} % of the samples in motion have a reading at its limit: left out",
                "turn more slowly, or set a larger range",
            )
        )
    if attitudes < _ATTITUDES:
        findings.append(
            Note(
                f"{attitudes} attitudes at rest: common scale factors and biases of the accelerometers are not told "
                "and held nominal (six or more tell them)"
            )
        )
    return findings


def warn_positions(solution: Solution, covariance: Array) -> list[str]:
    """Return which IMUs lie in one place, or beyond a board."""
    findings: list[str] = []
    position, count = solution.board.position, len(solution.board.numbers)
    blocks = covariance.reshape(count, NUMBERS, count, NUMBERS)[:, POSITION, :, POSITION]
    for i in range(count):
        for j in range(i):
            apart = position[i] - position[j]
            spread = blocks[i, :, i] + blocks[j, :, j] - blocks[i, :, j] - blocks[j, :, i]
            length = float(np.linalg.norm(apart))
            u = math.sqrt(max(float(apart @ spread @ apart), 0.0)) / max(length, 1e-12)
            if length < max(_SIGMA * u, _ONE_CHIP):
                findings.append(
                    Finding(
                        f"IMUs {j + 1} and {i + 1} are {1e3 * length:.2g} mm apart, with a standard uncertainty of "
                        f"{1e3 * u:.2g} mm: are they one sensor, recorded twice?",
                        "leave one out, or turn the board faster",
                    )
                )
    far = np.flatnonzero(np.linalg.norm(position, axis=1) > _BEYOND)
    if far.size:
        k = int(far[0])
        findings.append(
            Bad(
                f"IMU {k + 1} is {np.linalg.norm(position[k]):.2g} m from IMU 1, beyond a board of {_BEYOND:g} m: are "
                "all on one rigid body, and are units and times right?",
                "check the columns, and record again",
            )
        )
    return findings


def warn_halves(solution: Solution, apart: Array, deviation: Array) -> list[str]:
    """Return which IMUs sit elsewhere, or are read later, in the second half of the motion."""
    findings: list[str] = []
    z = np.sqrt(np.square((apart / deviation)[:, POSITION]).mean(axis=1))
    size = np.linalg.norm(apart[:, POSITION], axis=1)
    moved = [k for k in range(1, len(z)) if z[k] > _SIGMA and size[k] > _BENT]
    if moved:
        worst = max(moved, key=lambda k: float(size[k]))
        who = f"IMU {worst + 1} sits" if len(moved) == 1 else f"{len(moved)} of {len(z) - 1} IMUs sit"
        findings.append(
            Finding(
                f"{who} elsewhere against IMU 1 in the second half of the motion, by up to {1e3 * size[worst]:.2g} mm "
                f"or {z[worst]:.2g} standard deviations: is an IMU loose, does the board bend, or did it get a knock?",
                "fix the IMUs, and record again",
            )
        )
    for sensors, place in (("accelerometers", ACCEL_LATENCY), ("gyroscopes", GYRO_LATENCY)):
        later, z = apart[:, place], apart[:, place] / deviation[:, place]
        sure = (np.abs(later) > _SLIPPED) & (np.abs(z) > _LATER)
        if sure.any():
            k = int(np.argmax(np.abs(later) * sure))
            findings.append(
                Finding(
                    f"the {sensors} of IMU {k + 1} answer {'later' if later[k] > 0 else 'earlier'} against the "
                    f"gyroscopes of IMU 1 in the second half of the motion than in the first, by "
                    f"{1e3 * abs(later[k]):.2g} ms ({abs(z[k]):.2g} standard deviations): do they run on "
                    "another clock, or were samples lost?",
                    "record all IMUs on one clock",
                )
            )
    return findings


def warn_rests(prepared: Prepared, solution: Solution) -> list[str]:
    """Return by what the IMUs' forces at rest differ beyond their noise."""
    measured = prepared.measured
    still = np.zeros((len(solution.force), 9))
    still[:, FORCE] = solution.force
    left = measured.rest_accel - predicted(solution.board, still)[1]
    scatter = np.sqrt(np.square(left).mean(axis=(1, 2)))
    factor = scatter * np.sqrt(measured.rest_count / np.square(measured.accel_noise).mean())
    if np.median(factor) < _SIGMA or np.median(scatter) < _DRIFTED:
        return []
    return [
        Finding(
            f"the accelerometers disagree by {np.median(scatter):.2g} m/s^2 from rest to rest, {np.median(factor):.2g} "
            "times their noise: do their biases drift, or does the board bend?",
            "let the board warm up first, and record faster",
        )
    ]


def warn_scatter(summary: ImusSummary, by_age: float = 1.0) -> list[str]:
    """Return how much more the readings scatter in motion than at rest, of which their age explains `by_age` times."""
    findings: list[str] = []
    if summary.age.value:
        findings.append(
            Note(
                f"the gyroscopes' readings are {1e3 * summary.age.value:.2g} ms old, more or less, by their scatter "
                "along the angular acceleration: each chip has a clock of its own"
            )
        )
    factor = max(summary.accel_factor, summary.gyro_factor)
    if factor > _UNLIKE_REST or summary.accel_factor > _UNEXPLAINED * by_age:
        what = "accelerometers" if summary.accel_factor >= summary.gyro_factor else "gyroscopes"
        findings.append(
            Finding(
                f"the {what} scatter {factor:.2g} times as much in motion as at rest: the IMUs are not read at "
                "the same instant, or the board shakes beyond half the sampling rate",
                "give each IMU its own time or synchronise them, or record faster",
            )
        )
    return findings


def warn_shaking(prepared: Prepared) -> list[str]:
    """Return a warning of vibration above a third of the sampling rate, where it is 25 times the noise or more."""
    measured = prepared.measured
    run = np.searchsorted(measured.first, np.arange(len(measured.time)), side="right")
    whole = run[6:] == run[:-6]
    if not whole.any():
        return []
    # Sixth differences leave 1e-3 of what a hand does below a tenth of the sampling rate, and half above a third.
    # By their upper quartile, as knocks are few and a motor may run for a third of the motion only.
    shaking = [quantile(np.abs(np.diff(each(measured.time), 6, axis=0)[whole]), 0.75) for each in measured.accel]
    size = max(shaking) / _QUARTILE / 2**6
    factor = size * 2**6 / math.sqrt(924 * float(np.square(measured.accel_noise).mean()))
    if factor < _SHAKEN:
        return []
    return [
        Finding(
            f"the accelerometers shake in motion by {size:.2g} m/s^2 above a third of the sampling rate, {factor:.2g} "
            "times their noise there: positions and latencies can be off by more than stated",
            "record faster, with motors and fans off",
        )
    ]


def warn_size(factors: dict[SizeFrom, Factor | None], source: SizeFrom) -> list[str]:
    """Return what the size of the board rests on, and which of its sources disagree."""
    chosen = factors[source]
    assert chosen is not None
    by = {
        "gravity": "gravity turned from rest to rest",
        "stated": "a stated distance",
        "gyro scale": "the gyroscopes' nominal scale",
    }
    findings: list[str] = [
        Note(f"the size of the board is from {by[source]}, known to {200 * chosen.u:.2g} % (standard uncertainty)")
    ]
    gravity, stated = factors["gravity"], factors["stated"]
    others: Sequence[Factor] = [factor for factor in (gravity, stated, factors["gyro scale"]) if factor is not None]
    worst = max(others, key=lambda other: abs(other.value - chosen.value) / math.hypot(other.u, chosen.u))
    z = abs(worst.value - chosen.value) / math.hypot(worst.u, chosen.u)
    if worst is not chosen and z > _SIGMA:
        other = next(by[name] for name, factor in factors.items() if factor is worst)
        findings.append(
            Finding(
                f"{other} makes the board {100 * abs((chosen.value / worst.value) ** 2 - 1):.2g} % "
                f"{'larger' if worst.value < chosen.value else 'smaller'} than {by[source]} does ({z:.2g} standard "
                "deviations): is a distance, the unit of the gyroscopes or the time wrong?",
                "check the distance, the units and the time stamps",
            )
        )
    return findings

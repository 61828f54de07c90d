"""Fusion of whole IMUs into one specific force, rate and angular acceleration by the C core, block by block.

Latencies are taken out first: the reading of a triad at time t is the one at t + latency, by interpolation of degree 5
over the six samples about it; linear where one of these is missing, at the end of its range or beyond a gap.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from os import PathLike, fspath
from typing import Annotated, Any, ClassVar, Unpack

import numpy as np
from numpy.typing import NDArray

from imulab.device.imus import NO_LIMIT, FusedImus, ImusSettings, ImusStream
from imulab.device.unit import ALONE, BEYOND, EXCLUDED, GATED, NOT_FINITE, STUCK, Blob, is_blob, load_blob
from imulab.display import Finding, Note, join_alike, prefixed
from imulab.errors import DataError, OptionError, RecordError, meant
from imulab.estimation.clock import GAP
from imulab.options import RARE, READING, measure, parsed, text
from imulab.procedures.gyro_array.elements import SampleClock
from imulab.procedures.gyro_array.imus.columns import SENSORS, RangeFinder, readings_of
from imulab.procedures.gyro_array.imus.logs import with_all_instances
from imulab.procedures.gyro_array.imus.model import ACCEL_LATENCY, GYRO_LATENCY
from imulab.procedures.gyro_array.imus.prepare import names_of
from imulab.procedures.gyro_array.imus.schema import imus_of
from imulab.procedures.result import Drawn, Record, as_record, as_recording
from imulab.quantities import in_si, span
from imulab.recording import Array, Data, Part, Recording, Window
from imulab.records.calibration import Calibration, warn_other_unit
from imulab.report.noise_figures import thinned
from imulab.report.traces import BAD, DASHES, GOOD, TIME, Exhibits, Figure, ReportTable, figure_axis, rounded, scatter
from imulab.units import from_si

_NONE = 1e-7  # s: a latency below is none
_OFF = "off the others"
_RARE = 0.01  # share of samples off the others that chips without a common clock have in motion
_KINDS = ((STUCK, "stuck"), (NOT_FINITE, "no number"), (BEYOND, "at the end of its range"), (GATED, _OFF))
_FAILED = {"stuck", "no number"}
_WORDS = {"accel": "accelerometer", "gyro": "gyroscope"}
_COLOURS = (GOOD, BAD, "#8e6bbd")


# What is known of the board.


@dataclass(frozen=True)
class KnownBoard:
    """A calibrated board: positions and noise where they are known, latencies, s, and ends of ranges, shape (2, K)."""

    name: str
    settings: ImusSettings | None
    blob: bytes | None
    latency: Array
    limits: Array
    sensor: Mapping[str, str]

    @property
    def count(self) -> int:
        """Number of IMUs."""
        return int(self.latency.shape[1])


def board_of(calibration: Calibration | Blob, at: str = "centroid", limits: Array | None = None) -> KnownBoard:
    """Return the board of a record, or of an exported blob, that gives the specific force `at` a point.

    `limits` are the ends of the ranges, shape (2, K) or (2, 1); ``NO_LIMIT`` where the record is to say.

    Raises
    ------
    RecordError
        It is the record of something else, or the blob holds no whole IMUs.
    OptionError
        `at` is no point of the board, or other than that of the blob.
    """
    if isinstance(calibration, Blob):
        section = next((s for s in calibration.text["sections"] if s["kind"] == "imus"), None)
        if section is None:
            raise RecordError(f"{calibration.name}: the blob holds no whole IMUs")
        if at != "centroid":
            raise OptionError(
                f"--at {at}: the blob {calibration.name} gives the force at the point it was exported for"
            )
        latency = np.array([section["accel_latency"], section["gyro_latency"]])
        limits = np.array([[end or NO_LIMIT for end in section[name]] for name in ("accel_range", "gyro_range")])
        return KnownBoard(calibration.name, None, calibration.data, latency, limits, calibration.sensor)
    held = imus_of(calibration)
    board, noise = held.board, held.accel_noise
    ends = held.limits
    if limits is not None and limits.shape[1] in (1, len(noise)):  # others are of another board, which fusion refuses
        ends = np.where(limits < NO_LIMIT, limits, ends)
    settings = ImusSettings(
        board.accel, board.accel_bias, noise, board.gyro, board.gyro_bias, held.gyro_noise, board.position,
        point_of(at, board.position, noise), ends[0], ends[1], float(held.fit.sample_rate.value),
    )  # fmt: skip
    latency = np.array([board.numbers[:, ACCEL_LATENCY], board.numbers[:, GYRO_LATENCY]])
    return KnownBoard("the record", settings, None, latency, ends, calibration.sensor)


def point_of(at: str, position: Array, noise: Array) -> Array:
    """Return the output point, m from IMU 1, of a text: ``centroid``, ``imu:N`` or ``x,y,z``.

    Raises
    ------
    OptionError
        It is none of these, or there is no such IMU.
    """
    if at == "centroid":
        return np.asarray(np.average(position, axis=0, weights=noise**-2.0))
    kind, _, number = at.partition(":")
    if kind == "imu" and number.isascii() and number.isdecimal():
        if not 1 <= int(number) <= len(position):
            raise OptionError(f"--at {at}: expected an IMU from 1 to {len(position)}")
        return np.array(position[int(number) - 1])
    try:
        point = np.array([float(part) for part in at.split(",")])
    except ValueError:
        point = np.empty(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise OptionError(
            f"--at {at!r}: expected centroid, imu:N, or x,y,z in m from IMU 1, such as 0.01,0,-0.005"
            f"{meant(['centroid', 'imu'], kind)}"
        )
    return point


# Readings as late as they are.


@dataclass
class _Readings:
    """Samples that are not fused yet, and those before that interpolation needs."""

    time: Array
    raw: Array
    """The same in the unit of the recording."""
    values: Array
    done: int = 0
    """Rows at the head that are fused."""

    def add(self, time: Array, raw: Array, values: Array) -> None:
        self.time, self.raw = np.concatenate([self.time, time]), np.concatenate([self.raw, raw])
        self.values = np.concatenate([self.values, values])

    def ready(self, latest: float, *, last: bool) -> slice:
        """Return the rows whose readings are there, three samples after the latest of them included."""
        after = np.searchsorted(self.time, self.time[self.done :] + latest, "right") + 3
        return slice(self.done, len(self.time) if last else self.done + int(np.sum(after <= len(self.time))))

    def drop(self, stop: int, earliest: float) -> None:
        """Forget what no row from `stop` on needs."""
        if stop:
            first = self.time[min(stop, len(self.time) - 1)] + earliest
            begin = min(max(int(np.searchsorted(self.time, first, "right")) - 4, 0), max(stop - 1, 0))
            self.time, self.raw, self.values = self.time[begin:], self.raw[begin:], self.values[begin:]
            self.done = stop - begin


def read_late(time: Array, values: Array, rows: slice, latency: float, limit: float, longest: float) -> Array:
    """Return the readings of a triad, shape (n, 3), at the times of `rows` plus `latency`, shape (rows, 3).

    Where these lie before the first sample, after the last, or in a gap of more than `longest` s, the reading of the
    row itself.
    """
    at, count = time[rows] + latency, len(time)
    if count < 2 or abs(latency) <= _NONE:
        return values[rows].copy()
    left = np.searchsorted(time, at, "right") - 1
    j = np.clip(left, 0, count - 2)
    step = time[j + 1] - time[j]
    before, after = values[j], values[j + 1]
    linear = before + ((at - time[j]) / step)[:, None] * (after - before)
    about = np.clip(j[:, None] + np.arange(-2, 4), 0, count - 1)
    t, v = time[about] - time[j][:, None], values[about]
    with np.errstate(invalid="ignore", over="ignore"):
        fine = (j >= 2) & (j + 3 < count) & (np.diff(t, axis=1) <= longest).all(axis=1)
        fine &= (np.abs(v) < limit).all(axis=(1, 2))  # False where one is no number
        smooth, x = before.copy(), at - time[j]
        for i in np.delete(np.arange(6), 2):
            others = np.delete(np.arange(6), i)
            away = np.where(fine[:, None], t[:, [i]] - t[:, others], 1.0)
            smooth += ((x[:, None] - t[:, others]) / away).prod(axis=1)[:, None] * (v[:, i] - before)
        resampled = np.where(fine[:, None], smooth, linear)
        resampled = np.where(np.abs(after) >= limit, after, np.where(np.abs(before) >= limit, before, resampled))
    outside = (left < 0) | (left > count - 2) | (step > longest)
    return np.asarray(np.where(outside[:, None], values[rows], resampled))


def read_all_late(time: Array, values: Array, rows: slice, latency: Array, limits: Array, longest: float) -> Array:
    """Return the readings of all triads, (n, 2, K, 3), as `read_late` does; latencies and limits of shape (2, K)."""
    late = np.empty_like(values[rows])
    for sensor, k in np.ndindex(latency.shape):
        late[:, sensor, k] = read_late(
            time, values[:, sensor, k], rows, float(latency[sensor, k]), float(limits[sensor, k]), longest
        )
    return late


# Fusion of recordings, as a whole or block by block.


@dataclass(frozen=True, repr=False)
class FusedBoard(Drawn):
    """One force, rate and angular acceleration of a board, each with its standard uncertainty, from its IMUs' noise.

    Attributes
    ----------
    time
        s, shape (m,).
    force, rate, acceleration
        At the output point, m/s^2; rad/s; rad/s^2, shape (m, 3).
    force_std, rate_std, acceleration_std
        Standard uncertainties, likewise; nan where nothing is determined.
    bridged
        Samples whose rate is beyond the range of a gyroscope: the accelerometers tell it; shape (m,).
    used
        Whether each accelerometer and gyroscope was used, shape (m, 2, K).
    notes
        What was left out, when and why.

    Examples
    --------
    >>> import imulab as il
    >>> hasattr(il.FusedBoard, "recording")
    True
    """

    time: Array
    force: Array
    rate: Array
    acceleration: Array
    force_std: Array
    rate_std: Array
    acceleration_std: Array
    bridged: NDArray[np.bool_]
    used: NDArray[np.bool_]
    block: Recording
    unit: str
    notes: tuple[str, ...] = ()

    subject: ClassVar[str] = "Fused board"

    def recording(self) -> Recording:
        """Return it as a recording with the time and the head of the readings: ``write`` takes it."""
        columns, units = {"time": self.block.columns["time"]}, {"time": self.block.units["time"]}
        for before, parts in (
            ("", (self.force, self.rate, self.acceleration)),
            ("std_", (self.force_std, self.rate_std, self.acceleration_std)),
        ):
            for sensor, values, unit in zip(
                ("accel", "gyro", "angular_accel"), parts, ("m/s^2", self.unit, "rad/s^2"), strict=True
            ):
                for i, axis in enumerate("xyz"):
                    name = f"{before}{sensor}_{axis}"
                    columns[name], units[name] = np.ascontiguousarray(from_si(values[:, i], unit)), unit
        columns["bridged"], units["bridged"] = self.bridged.astype(np.float64), "1"
        return replace(self.block, columns=columns, units=units, notes=())

    def exhibits(self) -> Exhibits:
        """Return the rate over time with what was bridged, and how long each triad was used."""
        return _exhibits(self)

    def __repr__(self) -> str:
        return f"FusedBoard({len(self.time)} samples of {self.used.shape[2]} IMUs)"


@dataclass
class BoardFuser:
    """Fusion over the blocks of a recording: the state between them, and the warnings at the end."""

    board: KnownBoard
    clock: SampleClock = field(default_factory=SampleClock)
    name: str = "recording"
    samples: int = 0
    bridged: int = 0
    alone: int = 0
    left_out: dict[tuple[int, int], dict[str, Any]] = field(default_factory=dict)
    until: float = np.nan  # time of the last sample that was fused
    other: list[str] = field(default_factory=list)

    def fuse(self, blocks: Iterable[Recording]) -> Iterator[FusedBoard]:
        """Yield what consecutive blocks give; the result does not depend on where they are cut.

        Raises
        ------
        DataError
            Columns are missing, or time that does not rise.
        UnitError
            A column has a unit of something else.
        RecordError
            The record has another number of IMUs.
        """
        held: _Readings | None = None
        names: Mapping[str, list[list[str]]] = {}
        stream: ImusStream | None = None
        block = None
        for block in blocks:
            self.name = block.name
            if held is None:
                names = self._columns(block)
                self.other = warn_other_unit(self.board.sensor, block)
                held = _Readings(np.empty(0), np.empty(0), np.empty((0, 2, self.board.count, 3)))
            self.clock.watch(block)
            held.add(block.si("time"), block.columns["time"], readings_of(block, names))
            if self.clock.settled:
                stream = stream or self._open()
                yield from self._fused(stream, held, block, names, last=False)
        if held is not None and block is not None:
            yield from self._fused(stream or self._open(), held, block, names, last=True)

    def notes(self) -> list[str]:
        """Return messages after the last block: another unit, gaps, and what was left out."""
        return [*self.other, *self.clock.lines(self.name), *self.lines()]

    def lines(self, *, failed: bool = False) -> list[str]:
        """Return messages on sensors that were left out, a line each, and on too few; only `failed` ones if asked."""
        by_sensor: dict[str, list[tuple[str, str]]] = {}
        for (sensor, k), lost in sorted(self.left_out.items()):
            if failed and not _FAILED.intersection(lost["why"]):
                continue
            why = " and ".join(dict.fromkeys(lost["why"])) or _OFF
            text = f"left out of {lost['samples']} of {self.samples} samples, first at {lost['first']:.6g} s: {why}"
            scattered = why == _OFF and lost["samples"] < _RARE * self.samples
            finding = (
                Note(text) if scattered else Finding(text, "look at this sensor; the others were fused without it")
            )
            by_sensor.setdefault(_WORDS[SENSORS[sensor]], []).append((str(k + 1), finding))
        lines = [
            prefixed(f"{word}{'s' * (len(which) > 1)} {' '.join(which)}", finding)
            for word, findings in by_sensor.items()
            for which, finding in join_alike(findings)
        ]
        if self.alone:
            text = f"fewer than three accelerometers left in {self.alone} samples: nothing to compare them with"
            lines.append(Finding(text, "do not trust the angular acceleration there"))
        return [prefixed(self.name, line) for line in lines]

    def share(self) -> str:
        """Return how much was fused, and how much of it bridged."""
        share = 100 * self.bridged / max(self.samples, 1)
        return f"{self.samples} samples of {self.board.count} IMUs fused, {share:.3g} % bridged by the accelerometers"

    def _columns(self, block: Recording) -> Mapping[str, list[list[str]]]:
        names = names_of(block)
        if len(names["accel"]) != self.board.count:
            raise RecordError(f"{block.name}: {len(names['accel'])} IMUs; {self.board.name} has {self.board.count}")
        return names

    def _open(self) -> ImusStream:
        if self.board.settings is None:
            return ImusStream(self.board.blob or b"", self.board.count)
        return ImusStream.of(replace(self.board.settings, rate=self.clock.rate))

    def _fused(
        self, stream: ImusStream, held: _Readings, block: Recording, names: Mapping[str, list[list[str]]], *, last: bool
    ) -> Iterator[FusedBoard]:
        latency, limits, longest = self.board.latency, self.board.limits, GAP / self.clock.rate
        rows = held.ready(float(max(latency.max(), 0.0)), last=last)
        if rows.start == rows.stop:
            return
        readings = read_all_late(held.time, held.values, rows, latency, limits, longest)
        time, raw = held.time[rows], held.raw[rows]
        step = np.diff(time, prepend=self.until)
        step = np.where(step <= longest, step, 0.0)  # of the first sample, and after a gap: not known
        self.until = float(time[-1])
        out = stream.process(step, readings)
        held.drop(rows.stop, float(min(latency.min(), 0.0)))
        columns = {"time": raw}
        part = replace(block, columns=columns, units={"time": block.units["time"]}, notes=())
        yield self._result(out, time, part, block.units[names["gyro"][0][0]])

    def _result(self, out: FusedImus, time: Array, part: Recording, unit: str) -> FusedBoard:
        excluded = (out.health & EXCLUDED) != 0
        for sensor, k in np.argwhere(excluded.any(axis=0)).tolist():
            at = np.flatnonzero(excluded[:, sensor, k])
            lost = self.left_out.setdefault((sensor, k), {"samples": 0, "first": float(time[at[0]]), "why": []})
            met = int(np.bitwise_or.reduce(out.health[at, sensor, k]))
            lost["samples"] += len(at)
            lost["why"] += [word for bit, word in _KINDS if met & bit and word not in lost["why"]]
        bridged = (out.flags & BEYOND) != 0
        self.samples += len(time)
        self.bridged += int(bridged.sum())
        self.alone += int(np.count_nonzero(out.flags & ALONE)) if self.board.count > 2 else 0
        return FusedBoard(
            time, out.force, out.rate, out.acceleration, out.force_std, out.rate_std, out.acceleration_std,
            bridged, ~excluded, part, unit,
        )  # fmt: skip


def fuse_imus(
    data: Data,
    *,
    calibration: Record | Blob,
    at: Annotated[str, text("centroid|imu:N|X,Y,Z", ("centroid",))] = "centroid",
    gyro_range: Annotated[float | str | None, measure("rate", "deg/s"), RARE] = None,
    accel_range: Annotated[float | str | None, measure("acceleration", "g"), RARE] = None,
    window: Annotated[Window | None, parsed(span, "FROM:TO", unit="s"), READING] = None,
    **reading: Unpack[Part],
) -> FusedBoard:
    """Fuse a board of whole IMUs into one specific force, rate and angular acceleration.

    Parameters
    ----------
    data
        A file, recording or data frame with the columns accel_x_1 .. gyro_z_K.
    calibration
        Record of array calibrate --imus. Or its file, or the blob of one.
    at
        Point of the specific force. ``centroid`` of the accelerometers, ``imu:N``, or x,y,z, in m from IMU 1.
    gyro_range, accel_range
        Largest reading of the gyroscopes, and of the accelerometers; else as the record holds it, or the data
        reach it.
    window
        Part to fuse. First and last time, s, as ``(10, 60)`` or ``"10:60"``; ``"+10:+60"`` counts from the start.
    reading
        How arrays and files are to be understood: `time`, `unit` or `units`; `layout`, `topic`, `instance`.

    Raises
    ------
    DataError
        Columns are missing, no time, or time that does not rise.
    UnitError
        A column has a unit of something else.
    RecordError
        The record is of something else, or of another number of IMUs.
    OptionError
        `at` is no point of the board.

    Examples
    --------
    >>> import imulab as il
    >>> board = il.simulate_imus(elements=4, attitudes=6, duration="10 s", rate="50 Hz")
    >>> fused = il.fuse_imus(board, calibration=il.calibrate_imus(board, gravity=9.80665))
    >>> fused.force.shape == (len(board), 3)
    True
    """
    recording = as_recording(data, {**with_all_instances(data, reading), "window": window}, fuse_imus)
    known: Calibration | Blob
    if isinstance(calibration, Blob):
        known = calibration
    elif isinstance(calibration, str | PathLike) and is_blob(fspath(calibration)):
        known = load_blob(fspath(calibration))
    else:
        known = as_record(calibration, "fuse_imus: calibration")
    fuser = BoardFuser(board_of(known, at, limits_of(known, [recording], gyro_range, accel_range)))
    parts = list(fuser.fuse([recording]))
    if not parts:
        raise DataError(f"{recording.name}: no samples to fuse")
    return replace(joined_boards(parts), notes=(*fuser.notes(), f"{recording.name}: {fuser.share()}"))


def limits_of(
    known: Calibration | Blob,
    blocks: Iterable[Recording],
    gyro_range: float | str | None,
    accel_range: float | str | None,
) -> Array | None:
    """Return the ends of the ranges for `board_of`; a blob has them in itself.

    Raises
    ------
    OptionError
        A range is stated for a blob, or is none.
    """
    if not isinstance(known, Blob):
        return ranges(blocks, gyro_range, accel_range, known)
    for name, value in (("gyro_range", gyro_range), ("accel_range", accel_range)):
        if value is not None:
            raise OptionError(f"{name}: the blob {known.name} holds the range that it was exported with")
    return None


def ranges(
    blocks: Iterable[Recording],
    gyro_range: float | str | None,
    accel_range: float | str | None,
    record: Calibration | None = None,
) -> Array:
    """Return the ends of the ranges, shape (2, K) or (2, 1).

    They are as stated, else as the record holds them, else as recordings reach them: three equal readings at an extreme
    can also come of a log in which each reading stands several times.
    """
    finder: RangeFinder | None = None
    for block in blocks:
        names = names_of(block)
        finder = finder or RangeFinder(len(names["accel"]))
        finder.watch(readings_of(block, names))
    stated = [
        None if accel_range is None else in_si(accel_range, "accel_range", "acceleration", "g"),
        None if gyro_range is None else in_si(gyro_range, "gyro_range", "rate", "deg/s"),
    ]
    ends = np.full((2, 1), NO_LIMIT) if finder is None else finder.limits()
    held = ends if record is None else imus_of(record).limits
    if ends.shape[1] in (1, held.shape[1]):  # others are of another board, which fusion refuses
        ends = np.where(held < NO_LIMIT, held, ends)
    for sensor, value in enumerate(stated):
        if value is not None:
            if not 0 < value < NO_LIMIT:
                raise OptionError(f"{SENSORS[sensor]}_range: expected more than 0")
            ends[sensor] = value
    return ends


def joined_boards(parts: list[FusedBoard]) -> FusedBoard:
    """Return consecutive parts as one."""
    names = (
        "time", "force", "rate", "acceleration", "force_std", "rate_std", "acceleration_std", "bridged", "used",
    )  # fmt: skip
    whole: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    times = np.concatenate([part.block.columns["time"] for part in parts])
    return replace(parts[0], block=replace(parts[0].block, columns={"time": times}), **whole)


def _exhibits(fused: FusedBoard) -> Exhibits:
    traces = []
    for i, axis in enumerate("xyz"):
        time, rate = thinned(fused.time, from_si(fused.rate[:, i], fused.unit))
        line = {"color": _COLOURS[i], "width": 1.2, "dash": DASHES[i]}
        traces.append(scatter(rounded(time, 10), rounded(rate), "lines", name=f"gyro_{axis}", line=line))
    share = float(fused.bridged.mean())
    begins = np.flatnonzero(fused.bridged & ~np.insert(fused.bridged[:-1], 0, False))
    if begins.size:
        rate = from_si(fused.rate[begins, 0], fused.unit)
        marker = {"symbol": "diamond", "color": "#c99a2e", "size": 8}
        traces.append(scatter(rounded(fused.time[begins], 10), rounded(rate), "markers", name="bridged", marker=marker))
    figure = Figure(
        title="Fused rate over time",
        caption="Marks: where the rate went beyond the range of a gyroscope."
        if begins.size
        else "Nothing was bridged.",
        traces=traces,
        layout={"xaxis": figure_axis(TIME), "yaxis": figure_axis(f"rate, {fused.unit}")},
    )
    used = 100 * fused.used.mean(axis=0)
    rows = [[str(k + 1), f"{used[0, k]:.4g} %", f"{used[1, k]:.4g} %"] for k in range(used.shape[1])]
    table = ReportTable("Share of the samples in which each was used", "", ["IMU", "accelerometer", "gyroscope"], rows)
    return Exhibits(
        headline=f"{len(fused.time)} samples of {fused.used.shape[2]} IMUs fused; {100 * share:.3g} % beyond the range "
        "of the gyroscopes, bridged by the accelerometers",
        facts=[("bridged", f"{100 * share:.3g} %")],
        items=[figure, table],
    )

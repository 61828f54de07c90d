"""What fusing a board of whole IMUs buys: each IMU is predicted by the others, fused, averaged, or one by one.

No truth is needed: what an IMU reads is compared with a prediction that it has no part in. The prediction by the fused
others has their lever arms and their angular acceleration in it (Skog et al., IEEE Trans. Signal Process. 64(16) 4218,
2016); a mean, or another IMU alone, has not, and misses the accelerations of turning.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Unpack

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from imulab.device.imus import ImusSettings, ImusStream
from imulab.device.unit import EXCLUDED
from imulab.display import Finding, Note, prefixed
from imulab.errors import DataError, RecordError
from imulab.estimation.clock import GAP
from imulab.estimation.sampling import sampling_rate
from imulab.options import RARE, READING, measure, parsed
from imulab.procedures.gyro_array.imus.columns import readings_of
from imulab.procedures.gyro_array.imus.fuse import BoardFuser, board_of, ranges, read_all_late
from imulab.procedures.gyro_array.imus.logs import with_all_instances
from imulab.procedures.gyro_array.imus.prepare import MOVING, names_of
from imulab.procedures.gyro_array.imus.schema import imus_of
from imulab.procedures.result import Drawn, Record, amount, as_record, as_recording
from imulab.quantities import span
from imulab.recording import Array, Data, Part, Window
from imulab.records.calibration import Calibration
from imulab.report.traces import GOOD, LEGEND, MARGIN, SYMBOLS, Exhibits, Figure, ReportTable, figure_axis, scatter
from imulab.report.traces import plain_number as number

_FEWEST = 4  # IMUs: three others, not in one line, tell the angular acceleration
_FEWEST_SAMPLES = 50  # of one IMU, turning or not, whose rms is worth a statement
_FAR = 3.0  # times the stated uncertainty: beyond, what the fusion states does not hold
_CONTRADICTED = 5.0  # times what the record scatters by in motion: beyond, it does not hold for the recording
_COLOURS = (GOOD, "#8e6bbd", "#8a8a8a")


class ImuDifference(Struct, frozen=True):
    """How far an IMU is from what others say, rms over three axes: m/s^2 of accelerometers, rad/s of gyroscopes.

    Attributes
    ----------
    fused
        From the fused others, at the place of the IMU; None where they do not tell it.
    mean
        From the mean of the others, each corrected, without lever arms.
    single
        From one of the others; root mean square over them.
    stated
        Uncertainty of the difference from the fused others, by the noise at rest; None as `fused`.
    samples
        Samples that it is of; readings at the end of a range do not count.

    Examples
    --------
    >>> import imulab as il
    >>> still = il.ImuDifference(fused=None, mean=0.21, single=0.34, stated=None, samples=900)
    >>> still.mean < still.single
    True
    """

    fused: float | None
    mean: float
    single: float
    stated: float | None
    samples: int


@dataclass(frozen=True, repr=False)
class BoardComparison(Drawn):
    """How well the others predict each IMU of a board.

    Attributes
    ----------
    accel, gyro
        By ``turning`` (faster than 30 deg/s) and ``slow``: an `ImuDifference` for each IMU, None of too few samples.
    notes
        What speaks against the fusion, and what was left out.

    Examples
    --------
    >>> import imulab as il
    >>> board = il.simulate_imus(elements=4, attitudes=6, duration="10 s", rate="50 Hz")
    >>> compared = il.compare_imus(board, calibration=il.calibrate_imus(board, gravity=9.80665))
    >>> compared.accel["turning"][0].fused < compared.accel["turning"][0].mean / 10
    True
    """

    accel: dict[str, list[ImuDifference | None]]
    gyro: dict[str, list[ImuDifference | None]]
    notes: tuple[str, ...]

    subject: ClassVar[str] = "Fused board"

    def __repr__(self) -> str:
        return f"BoardComparison({len(self.accel['slow'])} IMUs)"

    def content(self) -> dict[str, Any]:
        """Return it for scripts, in SI."""

        def plain(rows: list[ImuDifference | None], unit: str) -> list[dict[str, Any] | None]:
            return [
                None if row is None else {
                    **{
                        name: None if value is None else amount(value, unit)
                        for name in ("fused", "mean", "single", "stated")
                        for value in [getattr(row, name)]
                    },
                    "samples": row.samples,
                }
                for row in rows
            ]  # fmt: skip

        return {
            "accel": {part: plain(rows, "m/s^2") for part, rows in self.accel.items()},
            "gyro": {part: plain(rows, "rad/s") for part, rows in self.gyro.items()},
            "notes": [str(note) for note in self.notes],
        }

    def headline(self) -> str:
        """Return in a sentence how far each is from what the others say."""
        turning = any(self.accel["turning"])
        part, begin = ("turning", "Turning, the") if turning else ("slow", "The")
        fused, mean, single = (_middle(self.accel[part], name) for name in ("fused", "mean", "single"))
        if fused is None or mean is None or single is None:
            return f"{begin} others do not determine the specific force of an IMU"
        return (
            f"{begin} specific force of an IMU is {number(fused, 2)} m/s² from the fused others, {number(mean, 2)} "
            f"from their mean, {number(single, 2)} from one of them (median)"
        )

    def exhibits(self) -> Exhibits:
        """Return the figures of each IMU as tables and drawings."""
        items: list[Figure | ReportTable] = []
        for title, rows, unit, factor in (
            ("Accelerometers", self.accel, "m/s²", 1.0), ("Gyroscopes", self.gyro, "deg/s", math.degrees(1)),
        ):  # fmt: skip
            items.append(_figure(title, rows["turning" if any(rows["turning"]) else "slow"], unit, factor))
            for part, words in (("turning", "faster than 30 deg/s"), ("slow", "slower, or at rest")):
                if any(rows[part]):
                    items.append(_table(f"{title}, {words}", rows[part], unit, factor))
        return Exhibits(self.headline(), [("IMUs", str(len(self.accel["slow"])))], items)


def compare_imus(
    data: Data,
    *,
    calibration: Record,
    gyro_range: Annotated[float | str | None, measure("rate", "deg/s"), RARE] = None,
    accel_range: Annotated[float | str | None, measure("acceleration", "g"), RARE] = None,
    window: Annotated[Window | None, parsed(span, "FROM:TO", unit="s"), READING] = None,
    **reading: Unpack[Part],
) -> BoardComparison:
    """Compare each IMU of a board with what the others, fused or not, say at its place.

    Parameters
    ----------
    data
        A file, recording or data frame with the columns accel_x_1 .. gyro_z_K; best another than the calibration's.
    calibration
        Record of array calibrate --imus. Or its file.
    gyro_range, accel_range
        Largest reading of the gyroscopes, and of the accelerometers; else as the record holds it, or the data
        reach it.
    window
        Part to compare. First and last time, s, as ``(10, 60)`` or ``"10:60"``; ``"+10:+60"`` counts from the start.
    reading
        How arrays and files are to be understood: `time`, `unit` or `units`; `layout`, `topic`, `instance`.

    Raises
    ------
    DataError
        Columns are missing, no time, or too few samples.
    UnitError
        A column has a unit of something else.
    RecordError
        The record is of something else, of another number of IMUs, or of fewer than four.

    Examples
    --------
    >>> import imulab as il
    >>> board = il.simulate_imus(elements=4, attitudes=6, duration="10 s", rate="50 Hz")
    >>> len(il.compare_imus(board, calibration=il.calibrate_imus(board, gravity=9.80665)).gyro["turning"])
    4
    """
    recording = as_recording(data, {**with_all_instances(data, reading), "window": window}, compare_imus)
    record = as_record(calibration, "compare_imus: calibration")
    board = board_of(record, limits=ranges([recording], gyro_range, accel_range, record))
    names = names_of(recording)
    if board.settings is None or board.count < _FEWEST:
        raise RecordError(f"a board of {board.count} IMUs: expected {_FEWEST} or more, to predict each from the others")
    if len(names["accel"]) != board.count:
        raise RecordError(f"{recording.name}: {len(names['accel'])} IMUs; the record has {board.count}")
    fuser = BoardFuser(board)
    for _ in fuser.fuse([recording]):
        pass
    time, logged = recording.si("time"), readings_of(recording, names)
    rate, notes = sampling_rate(recording)
    settings = replace(board.settings, rate=rate)
    limits = np.broadcast_to(board.limits, (2, board.count))
    logged = read_all_late(time, logged, slice(0, len(time)), board.latency, limits, GAP / rate)
    whole = np.all(np.isfinite(logged) & (np.abs(logged) < limits[..., None]), axis=3)
    step = np.diff(time, prepend=time[:1])
    step[step > GAP / rate] = 0.0
    force, turn = _corrected(logged, settings)
    parts = _parts(turn, whole[:, 1])
    accel: dict[str, list[ImuDifference | None]] = {part: [] for part in parts}
    gyro: dict[str, list[ImuDifference | None]] = {part: [] for part in parts}
    for k in range(board.count):
        others = np.delete(np.arange(board.count), k)
        out = ImusStream.of(_some(settings, others, settings.position[k])).process(step, logged[:, :, others])
        sound = whole[:, :, others] & ((out.health & EXCLUDED) == 0)
        for part, rows in parts.items():
            chosen = rows & whole[:, 0, k]
            accel[part].append(_apart(force, k, sound[:, 0], chosen, out.force, out.force_std, settings.accel_noise[k]))
            chosen = rows & whole[:, 1, k]
            gyro[part].append(_apart(turn, k, sound[:, 1], chosen, out.rate, out.rate_std, settings.gyro_noise[k]))
    if not any(row for rows in accel.values() for row in rows):
        raise DataError(f"{recording.name}: no IMU has {_FEWEST_SAMPLES} samples within its range")
    rates = turn[parts["turning"][:, None] & whole[:, 1]]
    messages = [*recording.notes, *_findings(accel, gyro, _motion_scatter(record, rates))]
    notes += fuser.lines(failed=True)
    named = [prefixed(recording.name, line) for line in messages]
    return BoardComparison(accel, gyro, (*fuser.other, *notes, *named))


def _corrected(logged: Array, settings: ImusSettings) -> tuple[Array, Array]:
    """Return specific forces and rates of each IMU in the body frame, shape (n, K, 3) each."""
    force = np.einsum("kab,nkb->nka", np.linalg.inv(settings.accel), logged[:, 0] - settings.accel_bias)
    return force, np.einsum("kab,nkb->nka", np.linalg.inv(settings.gyro), logged[:, 1] - settings.gyro_bias)


def _parts(turn: Array, whole: NDArray[np.bool_]) -> dict[str, NDArray[np.bool_]]:
    """Return the samples that turn and the others, by the median rate of the gyroscopes within their range."""
    size = np.where(whole, np.linalg.norm(turn, axis=2), np.nan)
    known = whole.any(axis=1)
    middle = np.zeros(len(turn))
    middle[known] = np.nanmedian(size[known], axis=1)
    turning = middle > MOVING
    return {"turning": turning, "slow": known & ~turning}


def _some(settings: ImusSettings, chosen: NDArray[np.int_], at: Array) -> ImusSettings:
    """Return the settings of some of the IMUs, with the specific force at a point."""
    each = {name: getattr(settings, name)[chosen] for name in settings.__annotations__ if name not in ("at", "rate")}
    return replace(settings, at=at, **each)


def _apart(
    values: Array, k: int, sound: NDArray[np.bool_], rows: NDArray[np.bool_], fused: Array, std: Array, noise: float
) -> ImuDifference | None:
    """Return how far IMU k is from the others; `values` are those of all, `sound` which of the others count."""
    rows = rows & sound.any(axis=1)
    determined = rows & np.isfinite(fused).all(axis=1)
    if known := determined.sum() >= _FEWEST_SAMPLES:
        rows = determined
    if rows.sum() < _FEWEST_SAMPLES:
        return None
    mine, others = values[rows, k], np.delete(values, k, axis=1)[rows]
    counts = sound[rows, :, None]
    mean = np.where(counts, others, 0.0).sum(axis=1) / counts.sum(axis=1)
    single = np.where(counts, others - mine[:, None], 0.0)
    return ImuDifference(
        fused=_rms(fused[rows] - mine) if known else None,
        mean=_rms(mean - mine),
        single=math.sqrt(float((single**2).sum() / (3 * counts.sum()))),
        stated=math.sqrt(float(np.mean(std[rows] ** 2)) + noise**2) if known else None,
        samples=int(rows.sum()),
    )


def _rms(values: Array) -> float:
    return math.sqrt(float(np.mean(values**2)))


def _middle(rows: list[ImuDifference | None], name: str) -> float | None:
    values = [value for row in rows if row is not None and (value := getattr(row, name)) is not None]
    return float(np.median(values)) if values else None


def _motion_scatter(record: Calibration, turn: Array) -> tuple[float, float]:
    """Return how many times the noise at rest accelerometers and gyroscopes may scatter in motion, by the record.

    That is what they scattered by when it was made, times the square of how much faster these rates, (n, 3), are:
    readings of unlike age differ by the angular acceleration.
    """
    held = imus_of(record)
    faster = max(_rms(turn) / _rms(np.array(held.fit.axis_rates.value)), 1.0) if len(turn) else 1.0
    pairs = ((held.fit.accel_residual, held.accel_noise), (held.fit.gyro_residual, held.gyro_noise))
    accel, gyro = (max(residual.value / float(np.median(noise)), 1.0) * faster**2 for residual, noise in pairs)
    return accel, gyro


def _is_worse(row: ImuDifference) -> bool:
    """Return whether the mean is nearer than the fused others, and noise, which these have more of, is not why."""
    return row.fused is not None and row.stated is not None and row.fused > max(row.mean, _FAR * row.stated)


def _findings(
    accel: dict[str, list[ImuDifference | None]],
    gyro: dict[str, list[ImuDifference | None]],
    scatter: tuple[float, float],
) -> list[str]:
    """Return what speaks against the fusion in this recording; `scatter` is that in motion, times the noise at rest."""
    lines: list[str] = []
    for part, where in (("turning", "turning"), ("slow", "slower than 30 deg/s")):
        worse = " ".join(str(k + 1) for k, row in enumerate(accel[part]) if row is not None and _is_worse(row))
        if worse:
            nearer = f"{where}, the mean of the others is nearer to the accelerometers of IMU {worse}"
            lines.append(_broken(f"{nearer} than the others fused"))
        for word, rows, usual in (("accelerometers", accel[part], scatter[0]), ("gyroscopes", gyro[part], scatter[1])):
            times = {
                k: row.fused / row.stated
                for k, row in enumerate(rows, start=1)
                if row is not None and row.fused and row.stated
            }
            most = _CONTRADICTED * usual if part == "turning" else _FAR
            off = " ".join(str(k) for k, each in times.items() if each > most)
            text = "times as far from the fused others as the noise at rest makes them"
            if off and not (worse and rows is accel[part]):
                lines.append(_broken(f"{where}, the {word} of IMU {off} are {number(max(times.values()), 2)} {text}"))
            elif not off and part == "turning" and times and (middle := float(np.median([*times.values()]))) > _FAR:
                much = f"{where}, the {word} are {number(middle, 2)} {text}"
                lines.append(Note(f"{much}; synchronised IMUs, or a time of each, lower that"))
    if not any(accel["turning"]):
        lines.append(Note("nothing turns faster than 30 deg/s: lever arms do not show"))
    return lines


def _broken(text: str) -> Finding:
    return Finding(f"{text}: the calibration does not hold for this recording", "calibrate the board again")


_COLUMNS = ("the others fused", "their mean", "one of them", "stated")


def _table(title: str, rows: list[ImuDifference | None], unit: str, factor: float) -> ReportTable:
    def cells(row: ImuDifference | None) -> list[str]:
        if row is None:
            return ["–"] * (len(_COLUMNS) + 1)
        values = (row.fused, row.mean, row.single, row.stated)
        return [*("–" if v is None else number(factor * v, 3) for v in values), str(row.samples)]

    caption = (
        "Root mean square of the difference between an IMU and what others say at its place; stated is what the noise "
        "at rest makes of the first."
    )
    titles = ["IMU", *(f"{name}, {unit}" for name in _COLUMNS), "samples"]
    return ReportTable(title, caption, titles, [[str(k + 1), *cells(row)] for k, row in enumerate(rows)])


def _figure(title: str, rows: list[ImuDifference | None], unit: str, factor: float) -> Figure:
    there = [(str(k + 1), row) for k, row in enumerate(rows) if row is not None]
    traces = [
        scatter(
            [k for k, _ in there], [None if (v := getattr(row, name)) is None else factor * v for _, row in there],
            "markers", name=label, marker={"color": colour, "symbol": symbol, "size": size, "line": {"width": 2}},
        )
        for name, label, colour, symbol, size in zip(
            ("fused", "mean", "single"), ("by the others fused", "by their mean", "by one of them"), _COLOURS,
            ("circle-open", *SYMBOLS[1:3]), (15, 8, 8), strict=True,  # a ring, which an equal mean does not hide
        )
    ]  # fmt: skip
    layout = {
        "xaxis": figure_axis("IMU", type="category"),
        "yaxis": figure_axis(f"rms difference, {unit}", rangemode="tozero"),
        "legend": LEGEND,
        "margin": MARGIN,
    }
    return Figure(f"{title}: each predicted by the others", "Lower is better.", traces, layout)

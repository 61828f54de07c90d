"""All IMUs of a flight log as one recording of whole IMUs on one clock.

Each triad is logged with time stamps of its own. The clock is that of the slowest triad, so that no reading counts
twice; the others are interpolated to it by quintic splines, which pass readings that are band-limited, and their noise
nearly whole. Nothing is made up across gaps: rows there hold no numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imulab.display import Finding, Note
from imulab.errors import ReadError
from imulab.estimation.sampling import WIDEST_GAP
from imulab.readers.streams import loss
from imulab.recording import RESAMPLED, Array, Recording

INSTANCES = "instances"
"""Key in the head of a recording that was made from several instances; its value names them."""
_GAP = 2.5  # usual steps: one missing sample is bridged, more are not
_SHORTEST = 8  # samples of a stretch without a gap
_NEARLY = 0.95  # of a rate: of triads so close the first gyroscope is the clock
_UNITS = {"accel": "m/s^2", "gyro": "rad/s"}


@dataclass(frozen=True)
class LoggedTriad:
    """Samples of one accelerometer or gyroscope of a log.

    Attributes
    ----------
    what
        Its message and instance: ``sensor_gyro 1``.
    ticks, values
        Time stamps, microseconds, shape (n,), and readings, m/s^2 or rad/s, shape (n, 3).
    device
        Number of the sensor, 0 where the log does not tell it.
    """

    what: str
    ticks: NDArray[np.int64]
    values: Array
    device: int = 0

    @property
    def step(self) -> float:
        """Usual step, microseconds."""
        return float(np.median(np.diff(self.ticks)))


def imus_on_one_clock(
    accels: Sequence[LoggedTriad],
    gyros: Sequence[LoggedTriad],
    name: str,
    metadata: Mapping[str, str],
    notes: Sequence[str],
) -> Recording:
    """Return ``time``, ``accel_x_1 .. gyro_z_K``, the time in s since boot.

    Raises
    ------
    ReadError
        Fewer than two IMUs, an accelerometer without its gyroscope, one sensor twice, or triads that have no time in
        common or whose time runs backwards.
    """
    logged = " and ".join(
        dict.fromkeys(", ".join(each.what for each in triads) or "none" for triads in (accels, gyros))
    )
    if min(len(accels), len(gyros)) < 2:
        raise ReadError(
            f"{name}: accelerometers and gyroscopes of two IMUs or more are needed, found {logged}; log the raw "
            "readings of all instances: sensor_accel and sensor_gyro (PX4), IMU or ACC and GYR (ArduPilot)"
        )
    if len(accels) != len(gyros):
        raise ReadError(f"{name}: {len(accels)} accelerometers and {len(gyros)} gyroscopes: {logged}; log all of them")
    notes = list(notes)
    gyros = _paired(accels, gyros, name, notes)
    triads = [_without_repeats(each, name) for each in (*gyros, *accels)]
    notes += _losses([*gyros, *accels], triads)
    latest, soonest = max(triads, key=lambda t: t.ticks[0]), min(triads, key=lambda t: t.ticks[-1])
    start, end = int(latest.ticks[0]), int(soonest.ticks[-1])
    if start >= end:
        raise ReadError(
            f"{name}: {soonest.what} ends at {end / 1e6:.6g} s and {latest.what} begins at {start / 1e6:.6g} s: they "
            "have no time in common"
        )
    notes += _ends(triads, latest, soonest)
    slowest = max(each.step for each in triads)
    clock = next(each for each in triads if each.step >= _NEARLY * slowest)
    ticks = clock.ticks[(clock.ticks >= start) & (clock.ticks <= end)]
    columns: dict[str, Array] = {"time": ticks / 1e6}
    for sensor, part in (("accel", triads[len(gyros) :]), ("gyro", triads[: len(gyros)])):
        for k, triad in enumerate(part):
            values = _at(triad, ticks)
            columns |= {f"{sensor}_{axis}_{k + 1}": np.ascontiguousarray(values[:, i]) for i, axis in enumerate("xyz")}
    units = {key: _UNITS.get(key.partition("_")[0], "s") for key in columns}
    rates = [1e6 / each.step for each in triads]
    notes.append(
        Note(
            f"{len(accels)} IMUs, of {logged}, interpolated to the time stamps of {clock.what} ({1e6 / clock.step:.6g} "
            f"Hz) from {min(rates):.6g} to {max(rates):.6g} Hz"
        )
    )
    head = {
        **metadata,
        INSTANCES: logged,
        RESAMPLED: f"accel and gyro from {min(rates):.6g} to {max(rates):.6g} Hz to {1e6 / clock.step:.6g} Hz",
    }
    return Recording(columns, units, head, name, notes=tuple(notes), from_file=True)


def _paired(
    accels: Sequence[LoggedTriad], gyros: Sequence[LoggedTriad], name: str, notes: list[str]
) -> list[LoggedTriad]:
    """Return the gyroscopes in the order of their accelerometers: by device where that tells, the rest in order."""
    for triads in (accels, gyros):
        devices = [each.device for each in triads if each.device]
        twice = next((each for each in triads if each.device and devices.count(each.device) > 1), None)
        if twice is not None:
            both = " and ".join(each.what for each in triads if each.device == twice.device)
            raise ReadError(f"{name}: {both} are one sensor, device {twice.device}; expected sensors of their own")
    by_device = {each.device: each for each in gyros if each.device}
    known = {each.device for each in accels}
    rest = iter([each for each in gyros if each.device not in known or not each.device])
    ordered = [by_device.get(each.device) or next(rest) for each in accels]
    if [each.what for each in ordered] != [each.what for each in gyros]:
        notes.append(Note("gyroscopes are put beside the accelerometers of the same device, not of the same instance"))
    pairs = [(g, a) for g, a in zip(ordered, accels, strict=True) if g.device != a.device and g.what != a.what]
    if pairs:
        shown = ", ".join(f"{gyro.what} beside {accel.what}" for gyro, accel in pairs)
        notes.append(Note(f"put in the order of instances, as their device numbers differ: {shown}"))
    return ordered


def _without_repeats(triad: LoggedTriad, name: str) -> LoggedTriad:
    """Return a triad without rows that repeat the stamp or the readings of the row before, or are not finite."""
    good = np.isfinite(triad.values).all(axis=1)
    ticks, values = triad.ticks[good], triad.values[good]
    step = np.diff(ticks)
    if step.size and step.min() < 0:
        at = int(np.argmax(step < 0))
        raise ReadError(
            f"{name}: the time of {triad.what} goes backwards: expected more than {ticks[at] / 1e6:.9g} s, found "
            f"{ticks[at + 1] / 1e6:.9g} s"
        )
    kept = np.concatenate([[True], (step > 0) & (np.diff(values, axis=0) != 0).any(axis=1)])[: len(ticks)]
    if kept.sum() < 2 * _SHORTEST:
        raise ReadError(f"{name}: {triad.what}: {int(kept.sum())} different readings; expected a sensor that lives")
    return replace(triad, ticks=ticks[kept], values=values[kept])


def _losses(logged: Sequence[LoggedTriad], kept: Sequence[LoggedTriad]) -> list[str]:
    """Return what repeats and what is missing, of the triad with most of it."""
    notes: list[str] = []
    repeats = [len(before.ticks) - len(after.ticks) for before, after in zip(logged, kept, strict=True)]
    if sum(repeats):
        worst = int(np.argmax(repeats))
        few = repeats[worst] < 0.01 * len(logged[worst].ticks)
        text = (
            f"rows that repeat the row before, or hold no numbers, are left out: {repeats[worst]} of "
            f"{len(logged[worst].ticks)} of {logged[worst].what}, {sum(repeats)} in all"
        )
        notes.append(Note(text) if few else Finding(text, "check that the sensor is logged as fast as it samples"))
    steps = [np.diff(each.ticks) for each in kept]
    gaps = [each[each > _GAP * np.median(each)] for each in steps]
    if any(each.size for each in gaps):
        worst = int(np.argmax([each.sum() for each in gaps]))
        notes.append(
            Finding(
                f"gaps are left out of all IMUs: {len(gaps[worst])} of {kept[worst].what}, "
                f"{gaps[worst].sum() / 1e6:.3g} s long, the widest {gaps[worst].max() / 1e6:.3g} s",
                "record again with a faster card or fewer topics",
            )
        )
    return notes


def _ends(triads: Sequence[LoggedTriad], latest: LoggedTriad, soonest: LoggedTriad) -> list[str]:
    """Return what is left out before the last triad begins and after the first ends, where that is more than a gap."""
    first, last = min(triads, key=lambda each: each.ticks[0]), max(triads, key=lambda each: each.ticks[-1])
    notes: list[str] = []
    for bound, other, left, at_start in (
        (latest, first, float(latest.ticks[0] - first.ticks[0]), True),
        (soonest, last, float(last.ticks[-1] - soonest.ticks[-1]), False),
    ):
        if left > WIDEST_GAP * max(bound.step, other.step):
            share = left / float(other.ticks[-1] - other.ticks[0])
            notes.append(loss(bound.what, other.what, left / 1e6, share, at_start=at_start))
    return notes


def _at(triad: LoggedTriad, ticks: NDArray[np.int64]) -> Array:
    """Return the readings at these time stamps, shape (n, 3), NaN in gaps.

    A reading at the end of its range stays there: splines do not pass the largest reading.
    """
    from scipy.interpolate import make_interp_spline

    values = np.full((len(ticks), 3), np.nan)
    cuts = np.flatnonzero(np.diff(triad.ticks) > _GAP * triad.step) + 1
    low, high = triad.values.min(axis=0), triad.values.max(axis=0)
    for part in np.split(np.arange(len(triad.ticks)), cuts):
        if len(part) < _SHORTEST:
            continue
        stamps = triad.ticks[part]
        inside = (ticks >= stamps[0]) & (ticks <= stamps[-1])
        spline = make_interp_spline((stamps - stamps[0]) / 1e6, triad.values[part], k=5)
        values[inside] = np.clip(spline((ticks[inside] - stamps[0]) / 1e6), low, high)
    return values

"""Are these recordings of one unit over temperature? One clear sentence for each way in which they may not be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from imulab.columns import triad
from imulab.errors import DataError, OptionError
from imulab.procedures.thermal.choices import LEAST_SPAN, SETTLE
from imulab.procedures.thermal.holds import Holds
from imulab.recording import Array, Recording, check_finite
from imulab.units import parse_unit

_KELVIN = 150.0  # degC; no unit is calibrated above it, and every kelvin above -120 degC is
_JUMP, _QUICK = 5.0, 2.0  # K; s
_COLDEST = -120.0  # degC
_STUCK, _SHORT, _READINGS, _STEPS = 200, 20.0, 20, 1.5
"""A reading that stays for so many samples, so many times as long as nearly all others, of which there are so many, and
that changes by so many steps otherwise."""
_LATER = (1.5, 1.25)
"""How many times as long as the one before the last step to a reading takes, and the one before it, if it settles."""
_SHARED, _DISTINCT = 0.3, 0.9
"""Share of rows that are in another recording, too, which is one by chance where rows hardly repeat in either."""
_MIX = np.uint64(0x9E3779B97F4A7C15)


def prepared(
    recordings: Sequence[Recording], column: str | None, settle: float | None, *, span: float = LEAST_SPAN
) -> list[Recording]:
    """Return recordings with a column temperature that spans `span` K, without what lies inside the settling time.

    Raises
    ------
    DataError
        They are of two units, of two sensors' temperatures, one is there twice, or their temperature cannot be.
    OptionError
        The settling time is less than 0.
    """
    given = [_with_temperature(recording, column) for recording in recordings]
    _check_together(given)
    for recording in given:
        _check_temperature(recording)
    given = _with_constant_named(given)
    low = min(float(recording.si("temperature").min()) for recording in given)
    high = max(float(recording.si("temperature").max()) for recording in given)
    if high - low < span:
        where = given[0].name if len(given) == 1 else f"{given[0].name} and {len(given) - 1} more"
        raise DataError(
            f"{where}: column temperature: spans {high - low:.1f} K ({low:.1f} to {high:.1f} degC); expected at least "
            f"{span:g} K: imulab tumble fit calibrates at one temperature"
        )
    return [_settled(recording, settle) for recording in given]


def _with_temperature(recording: Recording, column: str | None) -> Recording:
    """Return the recording with the chosen column as its temperature."""
    candidates = [
        name
        for name, unit in recording.units.items()
        if name.startswith("temperature") and parse_unit(unit).quantity == "temperature"
    ]
    if column is not None:
        recording.column(column)
        if column not in candidates:
            raise DataError(
                f"{recording.name}: column {column}: expected a temperature, found {recording.units[column]}"
            )
        return recording.with_columns(
            {"temperature": recording.column(column)}, {"temperature": recording.units[column]}
        )
    if len(candidates) > 1:
        raise DataError(
            f"{recording.name}: {len(candidates)} columns of temperature: {' '.join(candidates)}; expected one, that "
            "of the unit's own sensor: choose it with --temperature-column"
        )
    if candidates:
        return _called(recording, candidates[0])
    raise DataError(
        f"{recording.name}: no column temperature; found {' '.join(recording.columns)}: expected what the unit's own "
        "thermometer says (--temperature-column NAME where it is called otherwise)"
    )


def _called(recording: Recording, column: str) -> Recording:
    return recording.with_columns({"temperature": recording.column(column)}, {"temperature": recording.units[column]})


def _check_together(recordings: Sequence[Recording]) -> None:
    first = recordings[0]
    seen: list[tuple[str, NDArray[np.uint64]]] = []
    for recording in recordings:
        for key in ("serial", "element"):
            mine, its = first.metadata.get(key), recording.metadata.get(key)
            if mine and its and mine != its:
                raise DataError(
                    f"{recording.name}: {key} {its}, but {first.name} is of {key} {mine}; expected recordings of "
                    "one unit"
                )
        unit, other = first.triad_unit("accel"), recording.triad_unit("accel")
        if unit != other:
            raise DataError(
                f"{recording.name}: columns accel_x accel_y accel_z are in {other}, but in {unit} in {first.name}; "
                "expected one unit"
            )
        own = np.sort(_marks(recording))
        for before, marks in seen:
            if np.array_equal(own, marks):
                raise DataError(f"{recording.name}: the same recording as {before}, which would count twice")
            shared = _share(own, marks)
            if shared > _SHARED and min(len(np.unique(each)) / len(each) for each in (own, marks)) > _DISTINCT:
                raise DataError(
                    f"{recording.name}: {100 * shared:.0f} % of its rows are in {before}, too, and would count twice; "
                    "expected recordings of their own"
                )
        seen.append((recording.name, own))


def _share(own: NDArray[np.uint64], other: NDArray[np.uint64]) -> float:
    """Return the share of rows that are in another recording, from a few thousand of them, both in order."""
    if not (len(own) and len(other)):
        return 0.0
    few = own[:: max(1, len(own) // 4000)]
    return float((other[np.searchsorted(other, few).clip(max=len(other) - 1)] == few).mean())


def _marks(recording: Recording) -> NDArray[np.uint64]:
    """Return a number for each row of outputs, shape (n,), the same for the same row alone."""
    found = np.zeros(len(recording), dtype=np.uint64)
    for name in triad("accel"):
        bits = np.ascontiguousarray(recording.column(name), dtype=np.float64).view(np.uint64)
        found = (found ^ bits ^ (bits >> np.uint64(29))) * _MIX
        found ^= found >> np.uint64(32)
    return found


def _check_temperature(recording: Recording) -> None:
    check_finite(recording, ["temperature"])
    values, time = recording.si("temperature"), recording.time
    if not values.size:
        raise DataError(f"{recording.name}: no samples")
    if values.min() > _KELVIN:
        raise DataError(
            f"{recording.name}: column temperature: {values.min():.1f} to {values.max():.1f} degC cannot be; are these "
            "kelvins? expected a title such as 'temperature [K]'"
        )
    if values.min() < _COLDEST:
        raise DataError(
            f"{recording.name}: column temperature: {values.min():.1f} degC cannot be; expected {_COLDEST:g} to "
            f"{_KELVIN:g} degC"
        )
    if time is not None:
        _check_stuck(recording, values)
    if time is not None and values.size > 1:
        jump = np.abs(np.diff(values))
        index = int(np.argmax(jump))
        if jump[index] > _JUMP and time[index + 1] - time[index] < _QUICK:
            raise DataError(
                f"{recording.name}: {recording.place(index + 1)}, column temperature: jumps from {values[index]:.1f} "
                f"to {values[index + 1]:.1f} degC in {time[index + 1] - time[index]:.2g} s; expected a "
                "thermometer of the unit, which follows within minutes"
            )


def _check_stuck(recording: Recording, values: Array) -> None:
    """Refuse a thermometer that stops: one reading for long, where others change every few samples."""
    edges = np.concatenate([[0], np.flatnonzero(np.diff(values)) + 1, [len(values)]])
    runs, changes = np.diff(edges), np.abs(np.diff(values[edges[:-1]]))
    longest = int(np.argmax(runs))
    # A reading whose steps are larger than its noise goes from one to the next, and rests at one where nothing warms.
    if not changes.size or np.median(changes) < _STEPS * changes.min():
        return
    if len(runs) < _READINGS or runs[longest] < max(_STUCK, _SHORT * np.quantile(np.delete(runs, longest), 0.95)):
        return
    first, last = int(edges[longest]), int(edges[longest + 1]) - 1
    if _settles(values[:first], values[first]):
        return
    raise DataError(
        f"{recording.name}: {recording.place(first)} to {recording.place(last)}, column temperature: stuck at "
        f"{values[first]:.6g} degC over {runs[longest]} samples, where others change every few; expected a thermometer "
        "that goes on: choose the part before it (--window)"
    )


def _settles(before: Array, value: float) -> bool:
    """Return whether readings came to rest at a value step by step, each step later than the one before it.

    An exponential approach takes at least 1.71 and 1.41 times as long for its last step and the one before as for that
    before these; a thermometer that stops while it drifts took as long for each.
    """
    away = np.round(np.abs(before - value), 6)
    levels = np.unique(away[away > 0])[: len(_LATER) + 2]
    if len(levels) < len(_LATER) + 2:
        return False
    left = np.array([int(np.flatnonzero(away >= level)[-1]) for level in levels])
    steps = -np.diff(left)
    return bool(np.all(steps[:-1] > np.array(_LATER) * steps[1:]))


def _with_constant_named(recordings: Sequence[Recording]) -> list[Recording]:
    """Return the same, with a note on each that has one temperature throughout while that of others changes."""
    counts = [
        0 if recording.time is None else len(np.unique(recording.column("temperature"))) for recording in recordings
    ]
    if max(counts) < _READINGS:
        return list(recordings)
    note = "column temperature: the same value in every row, while it changes in other recordings: a thermometer stuck?"
    return [
        replace(recording, notes=(*recording.notes, f"{recording.name}: {note}")) if count == 1 else recording
        for recording, count in zip(recordings, counts, strict=True)
    ]


def _settled(recording: Recording, settle: float | None) -> Recording:
    """Return what lies after the settling time: by default where the head says that time counts from power-on."""
    time = recording.time
    if settle is not None and not settle >= 0:
        raise OptionError(f"settle {settle:g} s: expected 0 s or more")
    if settle is None:
        settle = SETTLE if "power_on_temperature" in recording.metadata else 0.0
    if time is None or not settle:
        return recording
    kept = time >= settle
    if np.count_nonzero(kept) < 2:
        raise DataError(
            f"{recording.name}: ends {time[-1]:.0f} s after power-on, inside the settling time of {settle:g} s; "
            "expected a longer recording, or another --settle"
        )
    return replace(
        recording,
        columns={name: values[kept] for name, values in recording.columns.items()},
        first_row=recording.first_row + int(np.argmax(kept)),
    )


def check_holds(holds: Holds, gravity: float, nominal: float | None) -> None:
    """Check that the holds can be those of accelerometers under `gravity`, m/s^2, `nominal` m/s^2 per output.

    Raises
    ------
    DataError
        The magnitudes are nowhere near it, or an axis is dead.
    """
    if nominal is not None:
        length = np.linalg.norm(holds.mean, axis=1) * nominal
        far = np.flatnonzero((length < gravity / 2) | (length > 2 * gravity))
        if far.size:
            raise DataError(
                f"{holds.label(int(far[0]))}: columns accel_x accel_y accel_z: the specific force at rest is "
                f"{length[far[0]]:.4g} m/s^2, expected {gravity:.4g} m/s^2: is the unit wrong?"
            )
    span = np.ptp(holds.mean, axis=0)
    if span.min() <= 0:
        name = triad("accel")[int(np.argmin(span))]
        raise DataError(f"{holds.recordings[0].name}: column {name}: the same output in every hold: a dead axis")

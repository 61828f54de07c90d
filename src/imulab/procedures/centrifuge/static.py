"""A static run of a centrifuge test: the mean of each channel, once it is sure that nothing moved."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from imulab.errors import DataError
from imulab.estimation.ranked import MAD_TO_SIGMA
from imulab.procedures.centrifuge.cells import COLUMNS, CONSTANT, Cells, TooSlowError, compress
from imulab.procedures.centrifuge.channels import Channels
from imulab.procedures.centrifuge.manifest import Manifest, Run
from imulab.procedures.centrifuge.spectra import PEAK, detrended, even_series, in_degrees, interpolated
from imulab.recording import Array, Recording
from imulab.units import from_si, to_si

_STEP = to_si(5.0, "deg/h")
"""A second off the straight line through the record by less than this is no motion, however small the noise."""
_STEP_SIGMA, _STEP_STEPS = 10.0, 8.0
_DRIFT = to_si(20.0, "deg/h")
"""More than a warm gyroscope drifts over a static record, or a table held by its servo shakes."""
_LINE = to_si(1.0, "deg/h")
"""More than rest shows at a rate that the table has in this test."""
_LOWEST_BIN = 3
"""A drift that bends shows in the first bins of a spectrum."""
_AROUND = 16
_FEWEST = 64
_TURNED = np.radians(0.05)


@dataclass(frozen=True)
class StaticRun:
    """Mean of each channel over a static run, rad/s, shape (k,), and its duration, s."""

    run: Run
    index: int
    channels: tuple[str, ...]
    mean: Array
    samples: int
    duration: float


def reduce_static(blocks: Iterable[Recording], manifest: Manifest, index: int) -> StaticRun:
    """Return the means of a static run.

    Raises
    ------
    DataError
        It moves: a channel steps, drifts or shows a line at a rate that a centrifuge may have, or the table turns.
    """
    place = manifest.place(index)
    channels = Channels(blocks, manifest, index)
    try:
        cells = compress(channels, 2 * np.pi, 1.0)  # cells of one second
    except TooSlowError:
        raise DataError(f"{place}: expected 8 samples per second or more in a static run") from None
    if cells is None:
        raise DataError(f"{place}: shorter than one second; expected a static run of some minutes")
    count = cells.moments[:, CONSTANT, CONSTANT]
    sums = cells.moments[:, CONSTANT, COLUMNS:]
    fastest = max((run.table_rate for run in manifest.runs), default=0.0)
    motion = _turn(cells) or _line(cells, channels.names, 1.1 * fastest) or _step(cells, channels.names)
    if motion:
        raise DataError(f"{place}: a static run that moves: column {motion}; expected a record at rest")
    mean = sums.sum(axis=0) / count.sum() + cells.offset
    return StaticRun(manifest.runs[index], index, channels.names, mean, cells.samples, cells.duration)


def _turn(cells: Cells) -> str | None:
    if cells.series_angle is None:
        return None
    reach = float(np.ptp(np.unwrap(cells.series_angle)))
    return f"table_angle goes over {np.degrees(reach):.3g} deg" if reach > _TURNED else None


def _line(cells: Cells, names: tuple[str, ...], fastest: float) -> str | None:
    """What a channel shows as a line: Earth rate at the net rate, tilt at the table rate of a rig that turns."""
    for name, values in zip(names, cells.series, strict=True):
        series = even_series(cells, detrended(cells.series_time, values))
        count = len(series)
        if count < _FEWEST:
            return None
        window = 1 - np.cos(2 * np.pi * (np.arange(count) + 0.5) / count)
        height: Array = np.asarray(2 * np.abs(np.fft.rfft(window * series)) / window.sum(), dtype=np.float64)
        rates: Array = np.asarray(2 * np.pi * np.fft.rfftfreq(count, cells.series_step), dtype=np.float64)
        padded = np.pad(height, _AROUND, mode="reflect")
        floor = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * _AROUND + 1), axis=1)
        high = height > np.maximum(
            PEAK * np.maximum(floor, np.median(height)), np.where(rates > fastest, _DRIFT, _LINE)
        )
        high[:_LOWEST_BIN] = False
        if high.any():
            index = int(np.argmax(np.where(high, height, 0.0)))
            rate = interpolated(rates[index - 1 : index + 2], height[index - 1 : index + 2])
            return (
                f"{name} shows a line of {from_si(float(height[index]), 'deg/h'):.3g} deg/h at {in_degrees(rate, 4)}, "
                "as if the gyroscope turned"
            )
    return None


def _step(cells: Cells, names: tuple[str, ...]) -> str | None:
    """What a channel's means over one second do besides noise: a step, or a drift that is none of a warm gyroscope."""
    count = cells.moments[:, CONSTANT, CONSTANT]
    means = cells.moments[:, CONSTANT, COLUMNS:] / count[:, None]
    squares = np.einsum("ckk->ck", cells.moments[:, COLUMNS:, COLUMNS:])
    within = np.sqrt(np.median(np.maximum(squares / count[:, None] - means**2, 0.0), axis=0) / count[0])
    time = cells.centre - cells.centre.mean()
    slope = time @ means / max(float(time @ time), 1e-300)
    flat = means - time[:, None] * slope
    left = np.abs(flat - np.median(flat, axis=0))
    steps = MAD_TO_SIGMA / np.sqrt(2) * np.median(np.abs(np.diff(flat, axis=0)), axis=0) if len(flat) > 3 else 0.0
    limit = np.maximum(np.maximum(_STEP_SIGMA * within, _STEP_STEPS * steps), _STEP)
    if (left > limit).any():
        cell, channel = np.unravel_index(int(np.argmax(left / limit)), left.shape)
        return (
            f"{names[channel]} is {from_si(float(left[cell, channel]), 'deg/h'):.3g} deg/h off its mean at "
            f"{cells.centre[cell]:.1f} s"
        )
    drift = np.abs(slope) * np.ptp(cells.centre)
    if (drift > np.maximum(limit, _DRIFT)).any():
        worst = int(np.argmax(drift / np.maximum(limit, _DRIFT)))
        return f"{names[worst]} drifts by {from_si(float(drift[worst]), 'deg/h'):.3g} deg/h over the record"
    return None

"""Spectra of a run's series: where a line is, and how far it stands out."""

from __future__ import annotations

import numpy as np

from imulab.procedures.centrifuge.cells import Cells
from imulab.procedures.centrifuge.regress import Complex
from imulab.recording import Array
from imulab.units import from_si, to_si

SEARCH = to_si(1.0, "deg/s")
"""How far from the manifest's rate a line is looked for."""
FAINT = to_si(0.001, "deg/h")
"""A line below this is none, however quiet the channel."""
PEAK = 6.0
"""Height of a peak of the spectrum over the median: one false alarm in 1e10 bins of noise."""
FINE = 4
"""Points of a spectrum per inverse of the run."""


def even_series(cells: Cells, values: Array) -> Array:
    """Return what belongs to the bins of a run at even steps: zero where the recording has a gap, shape (n,)."""
    place = np.round((cells.series_time - cells.series_time[0]) / cells.series_step).astype(np.int64)
    if place[-1] == len(place) - 1:
        return values
    even = np.zeros(int(place[-1]) + 1)
    even[place] = values
    return even


def hann_spectrum(step: float, values: Array, frequencies: Array) -> Complex:
    """Return the Hann-windowed spectrum of values a `step` apart, a line showing as its ``A - i B``, shape (f,)."""
    count = len(values)
    window = 1 - np.cos(2 * np.pi * (np.arange(count) + 0.5) / count)
    weighted = window * values / window.sum() * 2
    # Times as start of a stretch plus a multiple of the step: few exponentials, and the rest is a matrix product.
    stretch = max(1, int(np.sqrt(count)))
    padded = np.append(weighted, np.zeros(-count % stretch)).reshape(-1, stretch)
    inner = padded @ np.exp(-1j * np.outer(np.arange(stretch) * step, frequencies))
    outer = np.exp(-1j * np.outer(np.arange(0, count, stretch) * step, frequencies))
    spectrum: Complex = (inner * outer).sum(axis=0)
    return spectrum


def detrended(time: Array, values: Array) -> Array:
    """Return values less the straight line through them."""
    middle = time - time.mean()
    slope = (middle * values).sum() / (middle * middle).sum()
    left: Array = values - values.mean() - slope * middle
    return left


def search_line(cells: Cells, series: Array, rate: float, within: float) -> tuple[float, float]:
    """Return the shift of a line from `rate`, rad/s, and its height over the median of the spectrum around it."""
    values = even_series(cells, detrended(cells.series_time, series))
    count = len(values)
    window = 1 - np.cos(2 * np.pi * (np.arange(count) + 0.5) / count)
    size = FINE * count
    height = np.abs(np.fft.rfft(window * values, size)).astype(np.float64)
    step = float(2 * np.pi / (size * cells.series_step))
    centre = min(round(abs(rate) / step), len(height) - 1)
    around = np.concatenate([np.arange(-24, -3), np.arange(4, 25)]) * FINE + centre
    near = height[around[(around > 2 * FINE) & (around < len(height))]]
    floor = max(float(np.median(near)) if near.size else 0.0, 1e-300)
    reach = int(within / step)
    if reach < FINE // 2:
        return 0.0, float(height[centre]) / floor
    low, high = max(centre - reach, 0), min(centre + reach + 1, len(height))
    found: Array = np.asarray(height[low:high], dtype=np.float64)
    grid: Array = np.arange(low, high, dtype=np.float64) * step - abs(rate)
    shift = interpolated(grid, found)
    return float(np.sign(rate)) * shift, float(found.max()) / floor


def interpolated(grid: Array, height: Array) -> float:
    """Abscissa of the highest point, by a parabola through it and its neighbours."""
    index = int(np.argmax(height))
    if not 0 < index < len(grid) - 1:
        return float(grid[index])
    low, top, high = height[index - 1 : index + 2]
    curvature = low - 2 * top + high
    part = 0.5 * (low - high) / curvature if curvature < 0 else 0.0
    return float(grid[index] + part * (grid[1] - grid[0]))


def strongest_line(cells: Cells, series: Array, above: float) -> float | None:
    """Return the rate of the highest line faster than `above`, rad/s; None where none stands out."""
    values = even_series(cells, detrended(cells.series_time, series))
    count = len(values)
    window = 1 - np.cos(2 * np.pi * (np.arange(count) + 0.5) / count)
    height: Array = np.asarray(2 * np.abs(np.fft.rfft(window * values)) / window.sum(), dtype=np.float64)
    rates: Array = np.asarray(2 * np.pi * np.fft.rfftfreq(count, cells.series_step), dtype=np.float64)
    fast = rates > above
    if not fast.any() or height[fast].max() < max(PEAK * float(np.median(height)), FAINT):
        return None
    index = int(np.argmax(np.where(fast, height, 0.0)))
    part = slice(max(index - 1, 0), index + 2)
    return interpolated(rates[part], height[part])


def in_degrees(rate: float, digits: int = 6) -> str:
    """Return a rate as messages give it."""
    return f"{from_si(rate, 'deg/s'):.{digits}g} deg/s"

"""The warm-up table in few bits: float32, and int16 with one scale for each axis.

An int16 table keeps ``round(c / s)`` with the scale ``s = max |c| / 32767`` of the axis (1 LSB = s). Cubics have two
forms: powers of u, whose rounding adds up to ``(1 + u + u^2 + u^3) / 2 <= 2`` LSB; and Bernstein coefficients,

    Z = sum_i b_i C(3, i) u^i (1 - u)^(3 - i),

a weighted mean of the b_i, so that rounding adds at most 1/2 LSB, and the LSB is smaller because no b_i exceeds the
curve by much. Blobs and C sources hold floats; what int16 and float arithmetic would cost is measured by the
benchmarks with this. Source: Farouki and Rajan, Computer Aided Geometric Design 4 (1987) 191.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import comb

import numpy as np
from numpy.typing import NDArray

from imulab.errors import OptionError
from imulab.procedures.warmup.model import WarmupTable
from imulab.recording import Array

FORMS = ("power", "bernstein")
_FULL = 32767

_TO_BERNSTEIN = np.array([[comb(i, k) / comb(3, k) if k <= i else 0.0 for k in range(4)] for i in range(4)])


@dataclass(frozen=True)
class Int16Table:
    """A table in 16-bit integers.

    Attributes
    ----------
    table
        Everything but the coefficients.
    form
        ``power`` or ``bernstein``; amplitudes of exponentials are kept as they are under either.
    values
        Shape (r, axes, p).
    scale
        One LSB of each axis, in the units of the table, shape (axes,).
    slopes, slope_scale
        The same for the slopes of exponential amplitudes.
    """

    table: WarmupTable
    form: str
    values: NDArray[np.int16]
    scale: Array
    slopes: NDArray[np.int16] | None = None
    slope_scale: Array | None = None

    def expand(self) -> WarmupTable:
        """Return the table that the integers stand for, in double precision."""
        coefficients = self.values * self.scale[:, None]
        if self.form == "bernstein" and not self.table.time_constants:
            coefficients = coefficients @ np.linalg.inv(_TO_BERNSTEIN).T
        slopes = None
        if self.slopes is not None and self.slope_scale is not None:
            slopes = self.slopes * self.slope_scale[:, None]
        return replace(self.table, coefficients=coefficients, slopes=slopes)


def to_int16(table: WarmupTable, form: str = "bernstein") -> Int16Table:
    """Round a table to 16-bit integers.

    Raises
    ------
    OptionError
        The form is not known.
    """
    if form not in FORMS:
        raise OptionError(f"form {form!r}: expected one of {' '.join(FORMS)}")
    coefficients = table.coefficients
    if form == "bernstein" and not table.time_constants:
        coefficients = coefficients @ _TO_BERNSTEIN.T
    values, scale = _round(coefficients)
    if table.slopes is None:
        return Int16Table(table, form, values, scale)
    return Int16Table(table, form, values, scale, *_round(table.slopes))


def _round(values: Array) -> tuple[NDArray[np.int16], Array]:
    scale = np.abs(values).max(axis=(0, 2)) / _FULL
    scale = np.where(scale > 0, scale, 1.0)
    return np.rint(values / scale[:, None]).astype(np.int16), scale


def evaluate_float32(table: WarmupTable, time: Array, temperature: float) -> NDArray[np.float32] | None:
    """Return Z before T_M in single precision throughout, shape (axes, n), as a unit without doubles computes it.

    Coefficients, power-on temperature and every step are float32; `time` is counted in integer ticks, so that the time
    itself carries one rounding. None outside the table.
    """
    f = np.float32
    edges = table.temperatures.astype(f)
    at = f(temperature)
    if not edges[0] <= at <= edges[-1]:
        return None
    row = min(int(np.searchsorted(edges, at, side="right")) - 1, len(edges) - 2)
    c = table.coefficients.astype(f)
    if table.model == "interval-cubic":
        chosen = c[row]
    else:
        width = edges[row + 1] - edges[row]
        s = (at - edges[row]) / width
        if table.slopes is None:
            chosen = (f(1) - s) * c[row] + s * c[row + 1]
        else:
            d = table.slopes.astype(f)
            rest = f(1) - s
            chosen = (f(1) + f(2) * s) * rest * rest * c[row] + s * s * (f(3) - f(2) * s) * c[row + 1]
            chosen = chosen + width * (s * rest * rest * d[row] - s * s * rest * d[row + 1])
    t = time.astype(f)
    if table.time_constants:
        rates = np.array(table.time_constants).astype(f)
        z = np.zeros((len(table.axes), len(t)), dtype=f)
        for j, tau in enumerate(rates):
            z += chosen[:, j, None] * np.exp(-t / tau)
        return z
    if table.time_scale is None:
        u = t / f(table.settling_time)
    else:
        scale = f(table.time_scale)
        u = np.log1p(t / scale) / np.log1p(f(table.settling_time) / scale)
    z = chosen[:, 3, None] * u + chosen[:, 2, None]
    return np.asarray((z * u + chosen[:, 1, None]) * u + chosen[:, 0, None], dtype=f)

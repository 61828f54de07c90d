"""How a gyro array is fused, as settings and as the table that the C core runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from imulab.device.methods import METHODS, STARTS
from imulab.device.tables import DeviceTable, Field
from imulab.errors import OptionError, RecordError, listed
from imulab.recording import Array

MOST_ELEMENTS = 64
MOST_COUNT = 1_000_000_000
"""Largest starting count of the growing memory."""


@dataclass(frozen=True)
class Fusion:
    """The method that a unit fuses by, with its memory: None for the growing one that begins at k = `start`."""

    method: str = "robust"
    memory: float | None = None
    start: int = 1

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise OptionError(f"method {self.method!r}: expected one of {listed(METHODS, self.method)}")

    def to_dict(self) -> dict[str, Any]:
        """Return it as a record or a blob holds it."""
        return {"method": self.method, "memory": "growing" if self.memory is None else self.memory, "start": self.start}


def fusion_of(held: Any) -> Fusion:
    """Return what a record or a blob holds; robust with growing memory where it says nothing.

    Raises
    ------
    RecordError
        It is no such method, memory or count.
    """
    if held is None:
        return Fusion()
    if isinstance(held, Mapping):
        method, memory, start = held.get("method"), held.get("memory", "growing"), held.get("start", 1)
        gain = isinstance(memory, float) and 0 < memory < 1
        if method in METHODS and (gain or memory == "growing") and type(start) is int and 1 <= start <= MOST_COUNT:
            return Fusion(str(method), memory if isinstance(memory, float) else None, start)
    raise RecordError(f"fusion: expected a method, a memory and a starting count, found {str(held)[:60]}")


@dataclass(frozen=True)
class ArraySettings:
    """How an array is fused; times in s become samples at `rate`.

    Attributes
    ----------
    method, elements, axes
        Name of the method, gyros per axis, 1 or 3 axes.
    memory, start
        None for the growing memory that begins at k = `start`, or a fixed gain in (0, 1).
    initial_bias
        ``first``, ``zero``, or biases (axes, elements) in the unit of the data.
    kernel
        Of ``support``: ``gaussian`` or ``exponential``.
    bias, matrices
        Calibration, removed first: z = matrix (reading - bias); (axes, elements) and (elements, axes, axes).
    weights
        (axes, elements): of ``covariance``; for ``robust`` inverse variances, relative, to start with.
    gain
        Of ``kalman``: (axes, elements + 1, elements), steady-state gain of rate and biases.
    rate
        Samples per second.
    gate, spread_gate
        Of ``robust``: standard deviations of a gyro's own noise, and of the array in this sample.
    weight_cap, weight_floor, scale_tolerance
        Largest weight; smallest variance in mean variances; share of the rate by which healthy gyros may differ.
    memory_time, stuck_time, jump_time, quiet_time
        Of ``robust``, s.
    """

    method: str
    elements: int
    axes: int = 1
    memory: float | None = None
    start: int = 1
    initial_bias: Any = "first"
    kernel: str = "gaussian"
    bias: Any = None
    matrices: Any = None
    weights: Any = None
    gain: Any = None
    rate: float = 100.0
    gate: float = 6.0
    spread_gate: float = 4.0
    weight_cap: float = 0.5
    weight_floor: float = 0.05
    scale_tolerance: float = 0.01
    memory_time: float = 100.0
    stuck_time: float = 0.5
    jump_time: float = 0.5
    quiet_time: float = 1.0


def array_table(settings: ArraySettings) -> DeviceTable:
    """Return the table of an array's settings.

    Raises
    ------
    OptionError
        The method is unknown, or an array has another shape.
    """
    s, n, axes = settings, settings.elements, settings.axes
    if s.method not in METHODS:
        raise OptionError(f"unknown method {s.method!r}; known methods: {listed(METHODS, s.method)}")
    if s.kernel not in ("gaussian", "exponential"):
        raise OptionError(
            f"unknown kernel {s.kernel!r}; known kernels: {listed(('gaussian', 'exponential'), s.kernel)}"
        )
    if axes not in (1, 3):
        raise OptionError(f"{axes} axes: expected 1 or 3")
    least = 3 if s.method == "robust" else 1
    if not least <= n <= MOST_ELEMENTS:
        raise OptionError(f"{s.method}: expected {least} to {MOST_ELEMENTS} gyros per axis, found {n}")
    if s.memory is not None and not 0 < s.memory < 1:
        raise OptionError(f"memory {s.memory}: expected growing, or a gain between 0 and 1")
    if not (s.rate > 0 and np.isfinite(s.rate)):
        raise OptionError(f"rate {s.rate}: expected more than 0 Hz")
    given = s.initial_bias if not isinstance(s.initial_bias, str) else None
    if given is None and s.initial_bias not in STARTS:
        raise OptionError(f"initial bias {s.initial_bias!r}: expected first, zero or biases")

    def samples(time: float, least: int) -> np.int64:
        return np.int64(min(max(round(time * s.rate), least), 2**31))

    words = {
        "method": METHODS.index(s.method),
        "elements": n,
        "axes": axes,
        "initial": 2 if given is not None else STARTS.index(s.initial_bias),
        "kernel": ("gaussian", "exponential").index(s.kernel),
        "start": s.start,
        "cap": samples(s.memory_time, 100),
        "stuck": samples(s.stuck_time, 20),
        "jump": samples(s.jump_time, 10),
        "quiet": samples(s.quiet_time, 5),
    }
    numbers = {
        "memory": s.memory or 0.0,
        "gate": s.gate,
        "spread_gate": s.spread_gate,
        "scale_tolerance": s.scale_tolerance,
        "weight_cap": s.weight_cap,
        "weight_floor": s.weight_floor,
    }
    pointed = {
        "offset": _shaped(s.bias, (axes, n), "bias"),
        "matrix": _shaped(s.matrices, (n, axes, axes), "matrices"),
        "bias": _shaped(given, (axes, n), "initial bias"),
        "weight": _shaped(s.weights, (axes, n), "weights"),
        "gain": _shaped(s.gain, (axes, n + 1, n), "gain"),
    }
    fields = [Field(name, np.array(value, dtype=np.int64)) for name, value in words.items()]
    fields += [Field(name, np.array(value, dtype=np.float64)) for name, value in numbers.items()]
    fields += [Field(name, values, pointed=True) for name, values in pointed.items()]
    return DeviceTable("array", tuple(fields), {"elements": n, "axes": axes, "method": s.method})


def _shaped(values: Any, shape: tuple[int, ...], name: str) -> Array | None:
    if values is None:
        return None
    found = np.asarray(values, dtype=np.float64)
    if found.size != np.prod(shape):
        raise OptionError(f"{name}: expected shape {shape}, found {found.shape}")
    if not np.isfinite(found).all():
        raise OptionError(f"{name}: expected finite numbers")
    return found.reshape(shape)

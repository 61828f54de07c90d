"""Python face of the C core: tables loaded once, arrays in and out, streams that keep the core's state.

What runs here is the source that `imulab export` writes for a unit; nothing is computed in this module. Arithmetic is
double on the desk; a blob brings its float numbers.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import imulab.device._runtime as _runtime
from imulab.device.array_settings import ArraySettings, array_table
from imulab.device.tables import DeviceTable, pack
from imulab.errors import DataError, OptionError, RecordError
from imulab.recording import Array

NOT_FINITE, GATED, STUCK, JUMPED, EXCLUDED, QUIET, BEYOND, ALONE = (1 << bit for bit in range(8))
_STATE = b"imulab.stream 1\n"


class DeviceUnit:
    """The tables of one unit in the C core.

    Parameters
    ----------
    blob
        The bytes of `imulab.device.tables.pack`, or of an exported blob.

    Raises
    ------
    RecordError
        The core refuses them: cut, corrupt, newer, or with contents that cannot be.
    """

    def __init__(self, blob: bytes) -> None:
        try:
            self._unit = _runtime.load(blob)
        except ValueError as error:
            raise RecordError(str(error)) from None

    @classmethod
    def of(cls, *tables: DeviceTable) -> DeviceUnit:
        """Return the unit of these tables, in double."""
        return cls(pack(tables, 8))

    def tumble(self, output: Sequence[Array]) -> tuple[list[Array], int]:
        """Return the specific force, m/s^2, of three columns of outputs, each (n,), and the flags met."""
        force = [np.empty(len(output[0])) for _ in range(3)]
        return force, _runtime.tumble(self._unit, _columns(output), tuple(force))

    def gyro(self, output: Sequence[Array], force: Sequence[Array] | None) -> tuple[list[Array], int]:
        """Return the angular rate, rad/s, of outputs under a specific force, m/s^2 (needed for g-sensitivity only)."""
        rate = [np.empty(len(output[0])) for _ in range(3)]
        under = None if force is None else _columns(force)
        return rate, _runtime.gyro(self._unit, _columns(output), under, tuple(rate))

    def mag(self, output: Sequence[Array]) -> tuple[list[Array], int]:
        """Return the field, T or parts of the local one, of three columns of outputs, each (n,), and the flags met."""
        field = [np.empty(len(output[0])) for _ in range(3)]
        return field, _runtime.mag(self._unit, _columns(output), tuple(field))

    def thermal(self, temperature: Array, output: Sequence[Array]) -> tuple[list[Array], int]:
        """Return the specific force, m/s^2, of outputs at temperatures, degC, (n,) each, and the flags met."""
        force = [np.empty(len(output[0])) for _ in range(3)]
        (at,) = _columns([temperature])
        return force, _runtime.thermal(self._unit, at, _columns(output), tuple(force))

    def thermal_gyro(
        self, temperature: Array, output: Sequence[Array], force: Sequence[Array] | None
    ) -> tuple[list[Array], int]:
        """Return the angular rate, rad/s, of outputs at temperatures, degC, under a specific force as in `gyro`."""
        rate = [np.empty(len(output[0])) for _ in range(3)]
        (at,) = _columns([temperature])
        under = None if force is None else _columns(force)
        return rate, _runtime.thermal_gyro(self._unit, at, _columns(output), under, tuple(rate))

    def centrifuge(self, force: Sequence[Array], rate: Sequence[Array | None]) -> tuple[list[Array | None], int]:
        """Return the rates of the x and y input axes, rad/s, less their drift under the level specific force, m/s^2."""
        out = [None if column is None else np.array(column, dtype=np.float64) for column in rate]
        return out, _runtime.centrifuge(self._unit, _columns(force), tuple(out))

    def warmup(
        self,
        temperature: float,
        tick: float,
        ticks: NDArray[np.uint32],
        output: Sequence[Array | None],
        *,
        factors: Sequence[float] | None = None,
        into: Sequence[Array | None] | None = None,
    ) -> tuple[list[Array | None], bool]:
        """Return outputs less the warm-up bias, and whether the table covers the power-on temperature, degC.

        `ticks` counts time since power-on in ticks of `tick` seconds; None stands for a column that is not there.
        `factors` turn the table's units into those of the columns. The columns given are left as they are; `into` are
        columns to fill instead of new ones.
        """
        given = [None if column is None else np.ascontiguousarray(column, dtype=np.float64) for column in output]
        out = [None if c is None else np.empty_like(c) for c in given] if into is None else list(into)
        scale = np.ones(len(given)) if factors is None else np.array(factors, dtype=np.float64)
        count = np.ascontiguousarray(ticks, dtype=np.uint32)
        covered = _runtime.warmup(self._unit, float(temperature), float(tick), count, tuple(given), scale, tuple(out))
        return out, covered


def _columns(columns: Sequence[Array]) -> tuple[Array, ...]:
    return tuple(np.ascontiguousarray(column, dtype=np.float64) for column in columns)


# ---- gyro array ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FusedBlock:
    """Fused samples: `rate` (m, axes); `flags` (m, axes, elements) uint8 and `weights` (m, axes, elements) if asked."""

    rate: Array
    flags: NDArray[np.uint8] | None
    weights: Array | None


class Stream:
    """A gyro array being fused: owns the core's state, so that blocks give what one call over the whole gives.

    Raises
    ------
    OptionError
        A setting cannot be.
    """

    _blob: bytes | None = None  # where the unit came out of one, and the settings do not make it

    def __init__(self, settings: ArraySettings) -> None:
        self._configure(settings)
        try:
            self._state: bytearray = _runtime.array_start(self._unit)
        except ValueError as error:
            raise OptionError(f"{settings.method}: {error}") from None

    def _configure(self, settings: ArraySettings) -> None:
        blob = pack([array_table(settings)], 8)
        try:
            self._unit = _runtime.load(blob)
        except ValueError as error:
            raise OptionError(f"{settings.method}: {error}") from None
        self.settings = settings

    @classmethod
    def of_blob(cls, blob: bytes, settings: ArraySettings) -> Stream:
        """Return the stream of an exported blob, as the unit runs it; `settings` repeat its method, elements and axes.

        Raises
        ------
        RecordError
            The blob cannot be used, or holds no array.
        """
        stream = cls.__new__(cls)
        try:
            stream._unit = _runtime.load(blob)
            stream._state = _runtime.array_start(stream._unit)
        except ValueError as error:
            raise RecordError(f"the blob cannot fuse an array: {error}") from None
        stream.settings = settings
        stream._blob = blob
        return stream

    @property
    def rate(self) -> float:
        """Samples per second, which turns the times in the settings into samples; may change on the way."""
        return self.settings.rate

    @rate.setter
    def rate(self, value: float) -> None:
        if self._blob is not None:
            raise OptionError("the sampling rate of a blob's stream is the blob's")
        self._configure(replace(self.settings, rate=float(value)))

    def process(
        self, readings: Array, *, flags: bool = True, weights: bool = False, still: NDArray[np.bool_] | None = None
    ) -> FusedBlock:
        """Fuse the next samples.

        Parameters
        ----------
        readings
            Shape (m, axes, elements), or (m, elements) for one axis; any unit, which the rate has as well.
        flags, weights
            Whether to return them per sample.
        still
            Samples in which the unit is known to stand still, shape (m,): zero-rate updates.

        Raises
        ------
        DataError
            The shape does not fit.
        """
        n, axes = self.settings.elements, self.settings.axes
        block = np.ascontiguousarray(readings, dtype=np.float64)
        if block.shape[1:] not in ((axes, n), (axes * n,)):
            raise DataError(f"expected readings of shape (m, {axes}, {n}), found {block.shape}")
        rate = np.empty((len(block), axes))
        out_flags = np.empty((len(block), axes, n), dtype=np.uint8) if flags else None
        out_weights = np.empty((len(block), axes, n)) if weights else None
        quiet = None if still is None else np.ascontiguousarray(still, dtype=np.bool_)
        if quiet is not None and quiet.shape != (len(block),):
            raise DataError(f"expected still of shape ({len(block)},), found {quiet.shape}")
        _runtime.array_block(self._unit, self._state, block, quiet, rate, out_flags, out_weights)
        return FusedBlock(rate, out_flags, out_weights)

    def state(self) -> bytes:
        """Return settings and state as bytes, to go on with later by `from_state`, also in another process."""
        content = asdict(self.settings) | ({} if self._blob is None else {"blob": self._blob.hex()})
        head = json.dumps(content, default=_listed, sort_keys=True).encode("utf-8")
        body = _STATE + struct.pack("<I", len(head)) + head + bytes(self._state)
        return body + struct.pack("<I", zlib.crc32(body))

    @classmethod
    def from_state(cls, state: bytes) -> Stream:
        """Return the stream that `state` was taken from.

        Raises
        ------
        RecordError
            The bytes are no such state, are cut or altered, or of another build of the core.
        """
        at = len(_STATE) + 4
        if not state.startswith(_STATE) or len(state) < at + 4:
            raise RecordError("not the state of a stream")
        if struct.unpack("<I", state[-4:])[0] != zlib.crc32(state[:-4]):
            raise RecordError("the state of the stream is cut or altered (CRC-32)")
        size = struct.unpack("<I", state[at - 4 : at])[0]
        content = json.loads(state[at : at + size])
        blob = content.pop("blob", None)
        settings = ArraySettings(**content)
        stream = cls(settings) if blob is None else cls.of_blob(bytes.fromhex(blob), settings)
        inner = state[at + size : -4]
        if len(inner) != len(stream._state):
            raise RecordError("the state of the stream is of another build of the core")
        stream._state[:] = inner
        return stream


def array_stream(method: str = "robust", elements: int = 0, axes: int = 1, **settings: Any) -> Stream:
    """Return a stream of the C core that fuses an array; settings are those of `ArraySettings`."""
    if settings.get("memory") == "growing":
        settings["memory"] = None
    return Stream(ArraySettings(method, elements, axes, **settings))


def fuse_table(table: DeviceTable, readings: Array) -> Array:
    """Return the rates (m, axes) of readings (m, axes * elements) fused from the start by an array's table."""
    unit = _runtime.load(pack([table], 8))
    rate = np.empty((len(readings), table.columns["axes"]))
    block = np.ascontiguousarray(readings, dtype=np.float64)
    _runtime.array_block(unit, _runtime.array_start(unit), block, None, rate, None, None)
    return rate


def _listed(value: Any) -> Any:
    return np.asarray(value).tolist()

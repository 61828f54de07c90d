"""The C core on this computer: tables of a unit, streams with state, blobs, and vectors for the self-test.

The tables of one unit loaded once, arrays in and out, streams that keep the core's state, the bytes ("blob") that
its firmware loads, and the vectors by which it tests itself.

What runs here is the source that `imulab export` writes for a unit; nothing is computed in this module. Arithmetic is
double on the desk; a blob brings its float numbers.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

import imulab.device._runtime as _runtime
from imulab.columns import triad
from imulab.device.tables import KINDS, TEXT, ArraySettings, DeviceTable, array_table, field_of, pack
from imulab.display import first_hidden
from imulab.errors import DataError, OptionError, RecordError, UnitError
from imulab.files import open_file
from imulab.recording import Array, Recording
from imulab.records.calibration import BLOB_MAGIC, Calibration, plain_values
from imulab.records.sections import Part, Positive, Size, check_sizes, holds, read
from imulab.units import STANDARD_GRAVITY, conversion_factor, from_si, parse_unit, to_si

# One unit: its tables are loaded once; arrays in and out.


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
        columns = [None if column is None else np.ascontiguousarray(column, dtype=np.float64) for column in output]
        out = [None if c is None else np.empty_like(c) for c in columns] if into is None else list(into)
        scale = np.ones(len(columns)) if factors is None else np.array(factors, dtype=np.float64)
        count = np.ascontiguousarray(ticks, dtype=np.uint32)
        covered = _runtime.warmup(self._unit, float(temperature), float(tick), count, tuple(columns), scale, tuple(out))
        return out, covered


def _columns(columns: Sequence[Array]) -> tuple[Array, ...]:
    return tuple(np.ascontiguousarray(column, dtype=np.float64) for column in columns)


# Recordings corrected by a unit.


def outputs_of(recording: Recording, sensor: str, needed: str) -> list[Array]:
    """Return the columns of a triad in the unit that a record calibrates; errors as for `output_factor`."""
    factor = output_factor(recording.name, triad(sensor), recording.triad_unit(sensor), needed)
    return [recording.column(name) * factor for name in triad(sensor)]


def output_factor(name: str, columns: Sequence[str], unit: str, needed: str) -> float:
    """Return the factor from the unit of columns to the unit of the outputs that a record calibrates.

    Raises
    ------
    UnitError
        There is none; the message names the recording, the columns and both units.
    """
    try:
        return conversion_factor(unit, needed)
    except UnitError:
        what = f"column {columns[0]} is" if len(columns) == 1 else f"columns {' '.join(columns)} are"
        raise UnitError(f"{name}: {what} in {unit}, but the record calibrates outputs in {needed}") from None


def correct_gyroscopes(
    unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording, temperature: Array | None = None
) -> Recording:
    """Return the recording with gyro_* as body rate, in their unit if that is one of rate, else in rad/s.

    accel_* are the specific force (already corrected), which the g-sensitivity needs. `columns` is what the section
    says: ``output_unit``, and ``axes`` where it holds single gyroscopes; at `temperature`, degC, shape (n,), where its
    laws follow that, which ``range`` bounds.

    Raises
    ------
    UnitError
        The columns' unit cannot be converted to the record's.
    DataError
        The recording lacks a gyroscope, or the accelerometers that the g-sensitivity needs.
    """

    def rates(output: Sequence[Array], force: Sequence[Array] | None, at: Array | None) -> list[Array]:
        return (unit.gyro(output, force) if at is None else unit.thermal_gyro(at, output, force))[0]

    axes, accel = str(columns.get("axes", "xyz")), triad("accel")
    outputs, kept = [np.zeros(len(recording))] * 3, {}
    if "axes" not in columns:
        recording.triad_unit("gyro")  # refuses what is no triad
    for axis in axes:
        name = f"gyro_{axis}"
        if name not in recording:
            raise recording.lacking(f"column {name}, which the record corrects", name)
        stated = parse_unit(recording.units[name])
        kept[name] = stated.symbol if stated.quantity == "rate" else "rad/s"
        of_unit = [name] if "axes" in columns else triad("gyro")
        factor = output_factor(recording.name, of_unit, recording.units[name], str(columns["output_unit"]))
        outputs["xyz".index(axis)] = recording.column(name) * factor
    force, still = None, None if temperature is None else np.full(1, columns["range"][0])
    if all(name in recording for name in accel):
        force = [to_si(recording.column(name), recording.units[name]) for name in accel]
    elif np.isnan(rates([np.zeros(1)] * 3, None, still)[0][0]):
        raise DataError(
            f"{recording.name}: the record corrects the gyroscopes' g-sensitivity, which needs accel_x, accel_y and "
            f"accel_z; found {' '.join(recording.columns)}"
        )
    corrected = dict(zip(("gyro_x", "gyro_y", "gyro_z"), rates(outputs, force, temperature), strict=True))
    return recording.with_columns({name: from_si(corrected[name], symbol) for name, symbol in kept.items()}, kept)


def correct_magnetometers(unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
    """Return the recording with mag_* as the field in the body frame: uT, or parts of the local field (unit 1).

    Raises
    ------
    UnitError
        The columns' unit cannot be converted to the record's.
    DataError
        The recording has no magnetometer triad.
    """
    field, _ = unit.mag(outputs_of(recording, "mag", str(columns["output_unit"])))
    known = "uT" if columns["field_unit"] == "T" else "1"
    return recording.with_columns(
        {name: from_si(values, known) for name, values in zip(triad("mag"), field, strict=True)},
        dict.fromkeys(triad("mag"), known),
    )


# ---- gyro array ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FusedBlock:
    """Fused samples: `rate` (m, axes); `flags` (m, axes, elements) uint8 and `weights` (m, axes, elements) if asked."""

    rate: Array
    flags: NDArray[np.uint8] | None
    weights: Array | None


class Stream:
    """Fusion of a gyro array with the core's state, so that blocks give the same as one call over the whole.

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
    def from_blob(cls, blob: bytes, settings: ArraySettings) -> Stream:
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
        stream = cls(settings) if blob is None else cls.from_blob(bytes.fromhex(blob), settings)
        inner = state[at + size : -4]
        if len(inner) != len(stream._state):
            raise RecordError("the state of the stream is of another build of the core")
        stream._state[:] = inner
        return stream


def array_stream(method: str = "robust", elements: int = 0, axes: int = 1, **settings: Any) -> Stream:
    """Return a stream of the C core that fuses an array, with the settings of `ArraySettings`."""
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


# Vectors of the self-test, for tables that several procedures make.


VECTORS = 64  # inputs and outputs that the exported self-test compares


def golden_gyroscopes(table: DeviceTable, rng: np.random.Generator) -> dict[str, Any]:
    """Return outputs under a specific force, and their rates."""
    rates = rng.uniform(-5, 5, (VECTORS, 3))  # rad/s, about 300 deg/s
    if any(field.name == "high" for field in table.fields):
        rates *= 0.9 * np.minimum(1, np.minimum(-field_of(table, "low"), field_of(table, "high")) / 5)
    force = rng.uniform(-2 * STANDARD_GRAVITY, 2 * STANDARD_GRAVITY, (VECTORS, 3))
    output = (rates + field_of(table, "bias")) / field_of(table, "gain")
    output[1, 2] = np.nan
    rate, _ = DeviceUnit.of(table).gyro(list(output.T), list(force.T))
    return {"": VECTORS, "scale": 5.0, "output": output, "force": force, "rate": np.column_stack(rate)}


def golden_magnetometers(table: DeviceTable, rng: np.random.Generator) -> dict[str, Any]:
    """Return outputs of fields up to twice the local one, and those fields."""
    size = 1e-4 if table.columns["field_unit"] == "T" else 2.0
    output = (rng.uniform(-size, size, (VECTORS, 3)) + field_of(table, "bias")) / field_of(table, "gain")
    output[1, 0] = np.nan
    field, _ = DeviceUnit.of(table).mag(list(output.T))
    return {"": VECTORS, "scale": size, "output": output, "field": np.column_stack(field)}


# Blobs: the tables of one unit as the bytes that its firmware loads, read back on the desk.


FORMAT = "imulab.blob"
_HEAD = 16  # bytes of the head of a blob


class _Kind(Part):
    kind: str
    record: str | None = None
    """SHA-256 of the record that it is from; blobs of version 0.1 do not say."""


class _Text(Part):
    sensor: dict[str, str]
    software: str
    records: list[str]
    sections: list[_Kind]


class _Triad(Part):
    output_unit: str


class _Thermal(Part):
    output_unit: str
    temperature: str
    range: Annotated[list[float], 2]


class _Centrifuge(Part):
    axes: list[str]
    highest: Size


class _Warmup(Part):
    axes: Annotated[list[str], "columns"]
    units: Annotated[list[str], "columns"]
    range: Annotated[list[float], 2]
    end: Size


class _Array(Part):
    elements: int
    axes: int
    method: str
    rate: Positive


class _Imus(Part):
    imus: int
    at: Annotated[list[float], 3]
    rate: Positive
    accel_latency: Annotated[list[float], "imus"]
    gyro_latency: Annotated[list[float], "imus"]
    accel_range: Annotated[list[Positive | None], "imus"]
    gyro_range: Annotated[list[Positive | None], "imus"]


_COLUMNS: dict[str, type[Part]] = {
    "tumble": _Triad,
    "gyro": _Triad,
    "mag": _Triad,
    "thermal": _Thermal,
    "thermal_gyro": _Thermal,
    "centrifuge": _Centrifuge,
    "warmup": _Warmup,
    "array": _Array,
    "imus": _Imus,
}
"""Keys of the text for a section of each kind."""


@dataclass(frozen=True)
class Blob:
    """A blob: its bytes, and its description (sensor, columns and units of each section)."""

    name: str
    data: bytes
    text: Mapping[str, Any]

    @property
    def sensor(self) -> Mapping[str, str]:
        """What its records say of the unit, as `Calibration.sensor`."""
        sensor: Mapping[str, str] = self.text["sensor"]
        return sensor


def make_blob(records: Sequence[Calibration], tables: Sequence[DeviceTable]) -> bytes:
    """Return the blob of these tables, float numbers, with what the desk needs to apply it.

    Raises
    ------
    RecordError
        A number is beyond the range of a float.
    """
    text = {
        "format": FORMAT,
        "sensor": {key: value for record in records for key, value in record.sensor.items()},
        "software": records[0].software,
        "records": [record.to_dict()["content_sha256"] for record in records],
        "sections": [{"kind": table.kind, **table.columns} for table in tables],
    }
    return pack(tables, 4, plain_values(text, ""))


def is_blob(path: str | Path) -> bool:
    """Return whether a file begins like a blob; False where it cannot be read."""
    try:
        if not Path(path).is_file():
            return False  # a pipe can be read only once
        with open_file(path) as stream:
            return stream.read(len(BLOB_MAGIC)) == BLOB_MAGIC
    except OSError:
        return False


def load_blob(path: str | Path) -> Blob:
    """Return a blob from a file, checked by the core's loader.

    Raises
    ------
    RecordError
        The file is missing, cut, corrupt, of a newer version, or no blob.
    """
    try:
        with open_file(path) as stream:
            data = stream.read()
    except OSError as error:
        raise RecordError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        DeviceUnit(data)
    except RecordError as error:
        raise RecordError(f"{path}: not a blob that can be used: {error}") from None
    text = next((payload for kind, payload in _sections(data) if kind == TEXT), None)
    try:
        content = json.loads((text or b"").decode("utf-8"))
        if content["format"] != FORMAT or not all(section["kind"] for section in content["sections"]):
            raise ValueError
    except (ValueError, KeyError, TypeError):
        raise RecordError(f"{path}: the blob has no description of its units: it is for firmware only") from None
    names = {number: name for name, number in KINDS.items()}
    try:
        _check_text(content, [names[kind] for kind, _ in _sections(data) if kind != TEXT])
    except RecordError as error:
        raise RecordError(f"{path}: {error}") from None
    if place := first_hidden(content):
        raise RecordError(f"{path}: {place} holds a control or bidirectional character; expected plain text")
    return Blob(str(path), data, content)


def _check_text(text: Any, kinds: list[str]) -> None:
    """Refuse a description of sections, of these kinds, that `make_blob` does not write."""
    _complete(_Text, text, "its text")
    check_sizes(text)
    stated = [section["kind"] for section in text["sections"]]
    if stated != kinds:
        raise RecordError(f"its text speaks of {' '.join(map(str, stated))}, but it holds {' '.join(kinds)}")
    for number, kind in enumerate(kinds):
        _complete(_COLUMNS[kind], text["sections"][number], f"sections[{number}]")


def _complete(kind: type[Part], text: Any, place: str) -> None:
    held = read(kind, text, place)
    missing = [key for key in kind.__struct_fields__ if not holds(held, key)]
    if missing:
        raise RecordError(f"{place} lacks {missing[0]}")


def _sections(data: bytes) -> Iterator[tuple[int, bytes]]:
    at, end = _HEAD, len(data) - 4
    while at < end:
        kind, size = struct.unpack_from("<II", data, at)
        yield kind, data[at + 8 : at + 8 + size]
        at += 8 + size

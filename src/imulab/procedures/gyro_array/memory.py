"""Method and memory as texts, and as a calibration carries them."""

from __future__ import annotations

import numpy as np

from imulab.device.array_settings import MOST_COUNT, Fusion, fusion_of
from imulab.device.blob import Blob
from imulab.device.methods import METHODS
from imulab.errors import OptionError, listed
from imulab.procedures.gyro_array.blobs import fusion_of_blob
from imulab.records.calibration import Calibration


def carried(calibration: Calibration | Blob | None) -> Fusion:
    """Return the method and memory that a calibration record or a blob carries: robust and growing where none does."""
    if isinstance(calibration, Blob):
        return fusion_of_blob(calibration)
    return fusion_of(None if calibration is None else calibration.model.get("fusion"))


def fusion_of_record(record: Calibration, method: str | None, memory: str | None) -> Fusion:
    """Return how a unit is to fuse: by the texts that are given, else as its record carries.

    Raises
    ------
    OptionError
        A text is unknown.
    """
    return fusion_text(method, memory, "{}", carried(record))


def memory_text(memory: str | float, start: int) -> str:
    """Return ``growing memory``, ``growing memory from 100 on`` or ``memory 0.01``."""
    if isinstance(memory, float):
        return f"memory {memory:g}"
    return "growing memory" + (f" from {start} on" if start > 1 else "")


def fusion_text(method: str | None, memory: str | None, label: str = "--{}", held: Fusion | None = None) -> Fusion:
    """Return method and memory of two texts, each that of `held` where it is None.

    Raises
    ------
    OptionError
        One is unknown.
    """
    before = held or Fusion()
    if method is not None and method not in METHODS:
        raise OptionError(f"{label.format('method')} {method!r}: expected one of {listed(METHODS, method)}")
    gain, start = before.memory, before.start
    if memory is not None:
        kind, start = parse_memory(memory, label.format("memory"))
        gain = kind if isinstance(kind, float) else None
    return Fusion(method or before.method, gain, start)


def parse_memory(text: str, option: str = "--memory") -> tuple[str | float, int]:
    """Return memory and starting count of a text such as ``growing``, ``growing:100`` or ``0.01``.

    Raises
    ------
    OptionError
        It is none of these.
    """
    kind, colon, count = text.partition(":")
    if kind == "growing" and (not colon or (count.isascii() and count.isdecimal() and 0 < int(count) <= MOST_COUNT)):
        return "growing", int(count) if colon else 1
    try:
        gain = float(text)
    except ValueError:
        gain = np.nan
    if not 0 < gain < 1:
        raise OptionError(f"{option} {text!r}: expected growing, growing:COUNT, or a gain between 0 and 1")
    return gain, 1

"""How data are to be understood, as a caller says it: the layout of a foreign file, a part of it, units of arrays."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, TypeAlias, TypedDict

import numpy as np
from numpy.typing import ArrayLike

from imulab.frames import Frame
from imulab.options import PROGRAM, READING, file, parsed, text
from imulab.quantities import span, whole_number
from imulab.recording import Array, Recording

Data: TypeAlias = str | os.PathLike[str] | Recording | Frame | ArrayLike | Mapping[str, ArrayLike]
"""A file, a recording, a data frame of pandas or polars, an array of samples, or arrays by name."""
Ends: TypeAlias = tuple[float | None, float | None]
Window: TypeAlias = Annotated[str | Ends, "(FROM, TO) in s, such as (10, 60) or '10:60'"]
"""First and last time to read, s, each None for no bound; the bounds belong to the window."""


@dataclass(frozen=True, slots=True)
class LayoutColumn:
    """Where a column comes from (0-based number, or name in the header), and how it becomes a reading.

    A reading in `unit` is (what was read x `scale` - `zero`) / `scale_factor`. Dates become seconds since the first.
    """

    origin: int | str
    unit: str
    scale: float = 1.0
    zero: float = 0.0
    scale_factor: float = 1.0
    date: bool = False

    def convert(self, values: Array) -> None:
        """Turn what was read into readings, in place; a number that no reading can be becomes infinite."""
        with np.errstate(over="ignore", invalid="ignore"):
            if self.scale != 1.0:
                values *= self.scale
            if self.zero != 0.0:
                values -= self.zero
            if self.scale_factor != 1.0:
                values /= self.scale_factor


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the columns of a foreign file are.

    ``delimiter`` is one character, a blank meaning any run of blanks; ``decimal`` a point or a comma; ``sample_rate``
    in Hz or None; ``encoding`` that of the header's names; ``prefix`` the first field of the lines that count (what
    that field begins with, where the prefix ends with a colon), or nothing; ``text`` says that the file is delimited
    text whatever it looks like (it names a delimiter); ``if_needed`` that it is left out where a file says itself what
    its columns are.
    """

    columns: Mapping[str, LayoutColumn]
    delimiter: str = " "
    header: bool = False
    skip_lines: int = 0
    sample_rate: float | None = None
    metadata: Mapping[str, str] | None = None
    name: str = "layout"
    text: bool = False
    decimal: str = "."
    encoding: str = "utf-8"
    prefix: str = ""
    skip_incomplete: bool = False
    if_needed: bool = False

    @property
    def units(self) -> dict[str, str]:
        """Name to unit of the columns as `Readings` makes them."""
        known = {name: column.unit for name, column in self.columns.items()}
        return (
            known if self.sample_rate is None else {**({} if "time" in known else {"time": "s"}), **known, "time": "s"}
        )

    def behind_prefix(self, fields: list[str]) -> list[str] | None:
        """Return the fields of a line behind the prefix, None where it does not begin with it."""
        first = fields[0].strip()
        if not self.prefix:
            return fields
        if first == self.prefix:
            return fields[1:]
        glued = self.prefix.endswith(":") and first.startswith(self.prefix)
        return [first.removeprefix(self.prefix), *fields[1:]] if glued else None

    def skipped(self, count: int, *, so_far: bool = False) -> str:
        """Say how many rows were skipped by ``skip_incomplete``."""
        what, lack = ("rows were", "lack") if count > 1 else ("row was", "lacks")
        columns, far = " ".join(self.columns), " so far" if so_far else ""
        return f"{count} {what}{far} skipped that {lack} a reading of {columns} (skip_incomplete in {self.name})"


class Part(TypedDict, total=False):
    """How data are to be understood: arrays and data frames by `time` to `units`, files by `layout` to `instance`.

    Attributes
    ----------
    time
        Times of an array, s, shape (n,).
    unit
        Unit of the sensors whose quantity it measures.
    units
        Units by sensor or column.
    layout
        Columns of a foreign file; see imulab show --formats.
    topic
        Topic of a bag or log, where there are several; with a comma, the magnetometer's beside it.
    instance
        Sensor of a flight log, from 0; the first if not given.
    element
        One IMU of a file of several, from 1.
    """

    time: Annotated[ArrayLike | None, PROGRAM]
    unit: Annotated[str | None, PROGRAM]
    units: Annotated[Mapping[str, str] | None, PROGRAM]
    layout: Annotated[str | os.PathLike[str] | Layout | None, file("NAME|L.toml"), READING]
    topic: Annotated[str | None, text("TOPIC"), READING]
    instance: Annotated[int | None, parsed(whole_number, "N"), READING]
    element: Annotated[int | None, parsed(whole_number, "N"), READING]


class Sampling(Part, total=False):
    """The same, and how often arrays were sampled.

    Attributes
    ----------
    rate
        Samples per second, Hz, of arrays without `time`.
    """

    rate: float | None


class Reading(Sampling, total=False):
    """The same, and which part of them.

    Attributes
    ----------
    window
        Part to read; either side may be left out. First and last time, s, as ``(10, 60)`` or ``"10:60"``.
    """

    window: Annotated[Window | None, parsed(span, "FROM:TO", unit="s"), READING]

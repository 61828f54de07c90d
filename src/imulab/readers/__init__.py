"""Files to recordings: one module per family of formats, one dispatch."""

from __future__ import annotations

import hashlib
import logging
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, date, datetime
from importlib import import_module
from pathlib import Path
from time import perf_counter
from typing import Any, BinaryIO

import numpy as np
from numpy.lib.stride_tricks import as_strided

from imulab.columns import kind_of
from imulab.display import Note
from imulab.errors import ImulabError, ReadError, UnitError, file_name
from imulab.files import open_file
from imulab.readers.formats import FORMATS, TEXT, is_packed, page, recognised, unpacked
from imulab.readers.layout import IfNeeded, load_layout, spread_packets
from imulab.readers.selection import Selection
from imulab.readers.text import TextFile, without_stray_times
from imulab.recording import Array, Layout, Recording, Source, Window, is_large, on_disk, packed

__all__ = ["Layout", "Selection", "load_layout", "read", "read_blocks"]

_LOG = logging.getLogger(__name__)
"""Logger of each file's format, rows, times, and reading time."""
_HEAD = 1 << 16  # bytes that show the format
_SOUND_ROWS = 40  # above a line that cannot be read: it is damaged, and not the layout wrong
_PART = 1 << 22
"""Rows up to which blocks are joined as they are read."""


def read(
    file: str | Path,
    layout: str | Path | Layout | None = None,
    *,
    topic: str | None = None,
    instance: int | str | None = None,
    window: Window | None = None,
    element: int | None = None,
    units: Mapping[str, str] | None = None,
    damaged: str | None = None,
    serial: str | None = None,
    name: str | None = None,
) -> Recording:
    """Read a recording as a whole.

    Parameters
    ----------
    file
        Path of the file, or the folder of a ROS 2 bag; ``-`` reads text from standard input.
    layout
        Where the columns of a foreign file are: the path of a layout file, or a `Layout`.
    topic
        Which topic of a bag or log, where there are several; with a comma between, the magnetometer's beside it.
    instance
        Which sensor of a flight log, from 0; by default the first. ``all``: all of them, as whole IMUs on one clock.
    window
        First and last time to read, s; None for no bound.
    element
        Which IMU of a file of several, from 1; its columns are called as those of a file of one.
    units
        Units of sensors or columns, ``{"accel": "g"}``, in place of those that the file says.
    damaged
        ``"skip"`` passes over lines of text that cannot be read, and counts them; they are refused if not given.
    serial
        Serial number of the unit, in place of the one in the file's head.
    name
        What messages and the source call the file; its path if not given.

    Returns
    -------
    Recording
        With its source's name and SHA-256.

    Raises
    ------
    ReadError, UnitError
        The file cannot be read; the message names file, row and column.
    OptionError
        The file has no such topic, instance, element, window, or column to state the unit of.

    Examples
    --------
    >>> import imulab as il
    >>> il.write_csv(il.simulate_tumble(gravity=9.81), "tumble.csv")
    >>> recording = il.read("tumble.csv")
    >>> recording.units["gyro_x"], recording.metadata["gravity"], recording.source.file
    ('deg/s', '9.81 m/s^2', 'tumble.csv')
    """
    selection = Selection(topic, instance, window, element, units, damaged, serial)
    return _read(file, layout, selection, name, in_memory=True)


def read_mapped(
    file: str | Path, layout: str | Path | Layout | None = None, *, name: str | None = None, **part: Any
) -> Recording:
    """Return what `read` returns; the columns of a large file lie in temporary files and cannot be written to."""
    return _read(file, layout, Selection(**part), name, in_memory=not is_large(file))


def _read(
    file: str | Path, layout: str | Path | Layout | None, selection: Selection, name: str | None, *, in_memory: bool
) -> Recording:
    name, known = name or _name(file), _layout(layout)
    hashed = _Hash(in_memory)
    blocks = _log_reading(selection.of(_blocks(file, name, known, selection, hashed), name))
    if not in_memory:
        recording = on_disk(blocks)
        return replace(recording, source=Source(name, hashed.of(file), measured(recording.metadata)))
    first, parts, notes = _gather(blocks)
    source, stated = Source(name, hashed.of(file), measured(first.metadata)), first.units
    first = replace(first, columns={})
    # The parts of a column are freed as soon as they are joined, so that a large file is not in memory twice.
    joined = {key: _join([part.pop(key) for part in parts]) for key in list(parts[0])}
    return packed(replace(first, columns=joined, units=stated, source=source, notes=notes))


def measured(head: Mapping[str, str]) -> str | None:
    """Return the day that the head of a recording states, or the time of its first sample in UTC; None without."""
    with suppress(ValueError):
        return str(date.fromisoformat(head.get("date", "")[:10]))
    with suppress(ValueError, OverflowError, OSError):  # a time of day alone ends with "after midnight"
        begin = datetime.fromtimestamp(float(head.get("epoch", "").removesuffix(" s")), UTC)
        return begin.strftime("%Y-%m-%dT%H:%M:%SZ")
    return None


def _gather(blocks: Iterator[Recording]) -> tuple[Recording, list[dict[str, Array]], tuple[str, ...]]:
    """Return the first block, the parts of every column, and all notes.

    Small arrays that go one by one leave holes, which the system does not get back: a part is of 32 MiB.
    """
    first = next(blocks)
    parts, notes, begun = [dict(first.columns)], dict.fromkeys(first.notes), 0
    rows = len(first)
    for block in blocks:
        parts.append(dict(block.columns))
        notes |= dict.fromkeys(block.notes)
        rows += len(block)
        if rows >= _PART and next(iter(block.columns.values())).base is None:
            parts[begun:] = [{key: np.concatenate([part.pop(key) for part in parts[begun:]]) for key in first.columns}]
            begun, rows = len(parts), 0
    return first, parts, tuple(notes)


def read_blocks(
    file: str | Path,
    layout: str | Path | Layout | None = None,
    *,
    topic: str | None = None,
    instance: int | str | None = None,
    window: Window | None = None,
    element: int | None = None,
    units: Mapping[str, str] | None = None,
    damaged: str | None = None,
    serial: str | None = None,
    name: str | None = None,
) -> Iterator[Recording]:
    """Read a recording in blocks of some ten thousand rows, for what does not fit in memory.

    Parameters and errors are those of `read`; every block has the metadata, and knows its first row.

    Examples
    --------
    >>> import imulab as il
    >>> il.write(il.simulate_tumble(), "recording.csv")
    >>> sum(len(block) for block in il.read_blocks("recording.csv")) == len(il.read("recording.csv"))
    True
    """
    selection = Selection(topic, instance, window, element, units, damaged, serial)
    name = name or _name(file)
    yield from _log_reading(selection.of(_blocks(file, name, _layout(layout), selection, None), name))


def _log_reading(blocks: Iterator[Recording]) -> Iterator[Recording]:
    """Yield blocks, and log at the end how many rows were read, and in what time."""
    rows, seconds, name, columns, ends = 0, 0.0, "", "", list[float]()
    while True:
        begun = perf_counter()
        block = next(blocks, None)
        seconds += perf_counter() - begun
        if block is None:
            break
        rows, name, columns = rows + len(block), block.name, " ".join(block.columns)
        if block.time is not None and len(block):
            ends = [*ends[:1], float(block.time[0]), float(block.time[-1])]
        yield block
    times = f", {ends[0]:.6g} to {ends[-1]:.6g} s" if ends else ""
    if name:
        _LOG.info("%s: %d rows%s, columns %s; read in %.2f s", name, rows, times, columns, seconds)


def _join(parts: list[Array]) -> Array:
    """Return the parts of a column joined, without a copy where they are contiguous in memory."""
    first = parts[0]
    if len(parts) == 1:
        return first
    begins = [part.__array_interface__["data"][0] for part in parts]
    follows = [begin + part.nbytes for begin, part in zip(begins, parts, strict=True)]
    contiguous = first.base is not None and all(part.base is first.base and part.strides == (8,) for part in parts)
    if contiguous and begins[1:] == follows[:-1]:
        return as_strided(first, shape=(sum(map(len, parts)),), strides=(8,))
    return np.concatenate(parts)


class _Hash:
    """SHA-256 of a source: updated while text is read, computed afterwards for other formats."""

    def __init__(self, in_memory: bool) -> None:
        self.in_memory = in_memory
        self.text: TextFile | None = None

    def of(self, file: str | Path) -> str:
        if self.text is not None:
            return self.text.sha256()
        total = hashlib.sha256()
        path = Path(file)
        parts = [path]
        if path.is_dir():
            from imulab.readers.rosbag import files_of

            parts = files_of(path, str(file))
        for part in parts:
            with open_file(part) as stream:
                while data := stream.read(1 << 22):
                    total.update(data)
        return total.hexdigest()


def _blocks(
    file: str | Path, name: str, layout: Layout | None, selection: Selection, hashed: _Hash | None
) -> Iterator[Recording]:
    """Yield the blocks of a file in the format that its first bytes show, unpacked where it is packed as a whole."""
    if is_packed(_head(file, 4)):
        with unpacked(Path(file), name) as content:
            yield from _content_blocks(content, name, layout, selection, None)
        return
    yield from _content_blocks(file, name, layout, selection, hashed)


def _content_blocks(
    file: str | Path, name: str, layout: Layout | None, selection: Selection, hashed: _Hash | None
) -> Iterator[Recording]:
    """Yield the blocks of a file that is not packed."""
    if str(file) != "-" and Path(file).is_dir():
        kind = next(kind for kind in FORMATS if kind.module == "rosbag")
    else:
        kind = TEXT
        # A pipe can be read once: it is text, or is refused.
        if not is_pipe(file) and not (layout is not None and layout.text and not layout.if_needed):
            with _open(file, name) as stream:
                try:
                    begin = stream.read(1024)
                    kind = recognised(begin)
                except OSError as error:
                    raise ReadError(f"{name}: cannot be read: {error.strerror}") from None
            if what := page(begin):
                what += "" if what == "a web page" else " (imulab show reads certificates)"
                raise ReadError(f"{name}: expected a recording, found {what}")
    chosen = {"layout": layout and layout.name, "topic": selection.topic, "instance": selection.instance}
    parts = "".join(f", {key} {value}" for key, value in chosen.items() if value is not None)
    _LOG.info("%s: a %s file%s", name, kind.name, parts)
    if kind.layout == "none" and layout is not None and layout.if_needed:
        layout = None
    if kind.layout == "none" and layout is not None:
        raise ReadError(f"{name}: a {kind.name} file says itself what its columns are; leave out {layout.name}")
    if kind is not TEXT:
        try:
            yield from _spread(_FAMILIES[kind.module](Path(file), name, layout, selection), layout)
        except ReadError as error:
            from imulab.readers.guess import advice_on_guess
            from imulab.readers.jsonfile import LARGEST, KeysError

            if not isinstance(error, KeysError):
                raise
            more = advice_on_guess(_head(file, LARGEST), name)
            raise ReadError(f"{error}; {more}" if more else str(error)) from None
        except OSError as error:
            raise ReadError(f"{name}: cannot be read: {error.strerror or error}") from None
        return
    selection.refuse(name, "a text file")
    try:
        yield from _spread(_text_blocks(file, name, layout, selection, hashed), layout)
    except (ReadError, UnitError) as error:
        raise _advise(error, file, name, layout) from None


def _spread(blocks: Iterator[Recording], layout: Layout | None) -> Iterator[Recording]:
    """Yield blocks as they are, or with the rows of packets spread where the layout has such."""
    return spread_packets(blocks, layout) if layout is not None and layout.packet else blocks


def _text_blocks(
    file: str | Path, name: str, layout: Layout | None, selection: Selection, hashed: _Hash | None
) -> Iterator[Recording]:
    with _open(file, name) as stream:
        text = TextFile(
            stream,
            name,
            layout,
            selection.units,
            skip_damaged=selection.damaged == "skip",
            hashed=hashed is not None,
            whole=hashed is not None and hashed.in_memory,
        )
        if hashed is not None:
            hashed.text = text
        notes: list[str] | None = None
        rows = text.blocks()
        for block in without_stray_times(rows, name) if selection.damaged == "skip" else rows:
            if notes is None:
                notes = text.doubts if layout or any(map(_is_known, block.columns)) else _note_layout(file, name)
            yield replace(block, notes=(*block.notes, *notes)) if notes else block
        if hashed is not None:
            text.drain()


def _is_known(column: str) -> bool:
    """Return whether imulab knows the quantity of a column; time columns occur in other programs' files too."""
    return column.startswith("truth_") or kind_of(column) not in (None, "time")


def _note_layout(file: str | Path, name: str) -> list[str]:
    """Return a note on the layout that fits a file without a known column."""
    from imulab.readers.guess import advice_on_guess
    from imulab.readers.shipped import advice

    head = _head(file)
    hint = advice(head) or (advice_on_guess(head, name) if head else "")
    return [Note(hint)] if hint else []


def _advise(error: ImulabError, file: str | Path, name: str, layout: Layout | None) -> ImulabError:
    """Return a refusal of a text file with advice: the layout that reads it, or what a layout is."""
    from imulab.readers.guess import advice_on_guess
    from imulab.readers.shipped import advice, is_titled

    head = _head(file)
    more = advice(head, None if layout is None else layout.name)
    of_titles = isinstance(error, UnitError) or ": row " in str(error) or "found numbers" in str(error)
    if not more and head and layout is None and of_titles and not is_titled(head):
        more = advice_on_guess(head, name)
        if not more and "--layout" not in str(error):
            more = "a layout says where columns of other titles are: --layout (imulab show --formats lists them)"
    row = re.search(r": row (\d+) \(line \d+\)", str(error))
    if not more and row and int(row[1]) > _SOUND_ROWS and "expected" in str(error):
        more = "--damaged skip passes over such lines and counts them"
    return type(error)(f"{error}; {more}") if more else error


def _head(file: str | Path, size: int = _HEAD) -> bytes:
    """Return the first bytes of a file, or nothing where it can be read only once."""
    if is_pipe(file):
        return b""
    try:
        with open_file(file) as stream:
            return stream.read(size)
    except OSError:
        return b""


def _family(module: str, *, by_layout: bool) -> Callable[..., Iterator[Recording]]:
    """Return the reader of a family of formats, imported when it is used."""

    def blocks(path: Path, name: str, layout: Layout | None, selection: Selection) -> Iterator[Recording]:
        reader = import_module(f"imulab.readers.{module}")
        if by_layout:
            selection.refuse(name, "such a file")
            stated = [selection.units] if module == "parquet" else []
            skip = {"skip_damaged": selection.damaged == "skip"} if module == "jsonfile" else {}
            yield from reader.blocks(path, name, layout, *stated, **skip)
        else:
            yield from reader.blocks(path, name, selection)

    return blocks


_FAMILIES = {kind.module: _family(kind.module, by_layout=kind.layout != "none") for kind in FORMATS}


def is_pipe(file: str | Path) -> bool:
    """Return whether a name is standard input, a pipe or a device, which can be read only once."""
    return str(file) == "-" or (Path(file).exists() and not Path(file).is_file() and not Path(file).is_dir())


def _name(file: str | Path) -> str:
    """Return the name of a file in messages and records; bytes that are no UTF-8 become escapes."""
    return "standard input" if str(file) == "-" else os.fsencode(file_name(file)).decode("utf-8", "backslashreplace")


def _layout(layout: str | Path | Layout | None) -> Layout | None:
    if isinstance(layout, IfNeeded):
        return replace(load_layout(str(layout)), if_needed=True)
    return load_layout(layout) if isinstance(layout, str | Path) else layout


def _open(file: str | Path, name: str) -> BinaryIO:
    if str(file) == "-":
        if sys.stdin.buffer.closed:
            raise ReadError(f"{name}: was read before; expected one file that is '-'")
        return sys.stdin.buffer
    try:
        return open_file(file)
    except FileNotFoundError:
        raise ReadError(f"{name}: no such file") from None
    except IsADirectoryError:
        raise ReadError(f"{name}: expected a file, found a folder") from None
    except OSError as error:
        raise ReadError(f"{name}: cannot be read: {error.strerror}") from None

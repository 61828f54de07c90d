"""Program that reads one file for the page in its own process, and prints its content, a JSON object a line.

``python -P -m imulab.live.page.contents FILE FOLDER READING`` writes the curves into the folder. So a damaged, hostile
or large file costs the server nothing, and can be given up at any time.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from imulab.columns import triad
from imulab.errors import ImulabError
from imulab.estimation.clock import read_clock
from imulab.files import open_file, permit
from imulab.live.page.curves import Head, Writer
from imulab.options import options_of, part_of, read_options
from imulab.readers.formats import is_packed
from imulab.recording import Array, Reading, Recording

_EVERY = 0.15  # s between two messages of progress
_TURNED = math.radians(5.0)  # an attitude that lies so far from the first is another one


def contents(file: str, folder: Path, reading: dict[str, str]) -> Iterator[dict[str, Any]]:
    """Write the curves of a file, and yield its content as far as read.

    Parameters
    ----------
    file
        Path of the file.
    folder
        Folder of the curves.
    reading
        Options of reading, as typed: ``layout``, ``topic``, ``instance``, ``window``, ``element``.

    Yields
    ------
    dict
        ``head``: the fields of `Head`, with ``metadata`` and ``notes``, again and again, the last with ``done``; then
        ``attitudes``: begin and end of each, s, or ``unknown``: why there are none, and ``turned``: whether they lie
        another way than the first. Of a file that breaks, ``error``
        says where, and the others are of the rows before.

    Raises
    ------
    ImulabError
        The file cannot be read, not even its first rows.
    """
    options = read_options(options_of(Reading), reading, "--{}")
    writer, notes, last_sent, metadata = Writer(folder), dict[str, None](), 0.0, dict[str, str]()
    broken: dict[str, str] = {}
    with_numbers: set[str] = set()
    try:
        for block in _blocks(file, options):
            writer.add(block)
            notes |= dict.fromkeys(block.notes)
            with_numbers |= {
                name for name, values in block.columns.items() if name not in with_numbers and np.isfinite(values).any()
            }
            metadata = dict(block.metadata)
            if monotonic() - last_sent > _EVERY:
                last_sent = monotonic()
                yield {"head": asdict(writer.head), "metadata": metadata, "notes": list(notes)}
    except ImulabError as error:
        metadata = _add_good_rows(file, folder, options, str(error), writer) or metadata
        if not writer.head.rows:
            raise
        broken = {"error": str(error)}
    writer.head.usual = usual_step(folder, writer.head)
    empty = [] if broken else [name for name in writer.head.units if name not in with_numbers]
    notes |= {f"{name}: no number in any row, nothing is drawn of it": None for name in empty}
    yield {"head": asdict(writer.head), "metadata": metadata, "notes": list(notes), **broken, "done": True}
    yield attitudes(folder, writer.head, Path(file).name)


def _blocks(file: str | Path, options: Mapping[str, Any]) -> Iterator[Recording]:
    from imulab.readers import read_blocks
    from imulab.readers.streams import on_clock_of

    return on_clock_of(read_blocks(file, options["layout"], **part_of(options)))


def _add_good_rows(file: str, folder: Path, options: Mapping[str, Any], error: str, writer: Writer) -> dict[str, str]:
    """Write the rows of a text file above the line that an error names, and return their metadata."""
    named = re.search(r"\(line (\d+)\)", error)
    good = folder / Path(file).name
    metadata: dict[str, str] = {}
    if named is None:
        return metadata
    with open_file(file) as lines, good.open("wb") as out:
        if is_packed(lines.peek(4)):
            return metadata
        out.writelines(islice(lines, int(named[1]) - 1))
    permit(good)
    row = 0
    with suppress(ImulabError):
        for block in _blocks(good, options):
            new = max(writer.head.rows - row, 0)
            row += len(block)
            metadata = dict(block.metadata)
            if new < len(block):
                columns = {name: values[new:] for name, values in block.columns.items()}
                writer.add(replace(block, columns=columns))
    good.unlink()
    return metadata


def usual_step(folder: Path, head: Head) -> float:
    """Return the usual step of the times that a `Writer` has written, s: the inverse of the mean rate."""
    step = read_clock(_all(folder / "time.values", head.rows)).step if head.timed and head.rows > 1 else np.nan
    return step if np.isfinite(step) else head.usual


def attitudes(folder: Path, head: Head, name: str) -> dict[str, Any]:
    """Return the static attitudes of a recording that a `Writer` has written, or an error as text."""
    from imulab.procedures.tumble.attitudes import find_attitudes

    names = triad("accel")
    numbers = {each: number for number, each in enumerate(head.units)}
    if not head.timed or not set(names) <= set(head.units):
        rates = (_all(folder / f"{number}.values", head.rows) for each, number in numbers.items() if "gyro" in each)
        return {"attitudes": [], "turned": any(_changes(each, head.usual) for each in rates)}
    columns = {each: _all(folder / f"{numbers[each]}.values", head.rows) for each in names}
    columns["time"] = _all(folder / "time.values", head.rows)
    units = {**{each: head.units[each] for each in names}, "time": "s"}
    try:
        known = find_attitudes(Recording(columns, units, name=name))
    except ImulabError as error:
        return {"attitudes": [], "unknown": str(error)}
    up = known.mean / np.maximum(np.linalg.norm(known.mean, axis=1, keepdims=True), 1e-300)
    ends = zip(known.start.tolist(), known.stop.tolist(), strict=True)
    return {"attitudes": [list(each) for each in ends], "turned": bool((up @ up[0] < math.cos(_TURNED)).any())}


def _changes(rate: Array, step: float) -> bool:
    """Whether means over a second spread by half as much as the samples: noise at rest averages out."""
    length = max(round(1 / step), 1) if step > 0 else 1
    means = rate[: len(rate) // length * length].reshape(-1, length).mean(axis=1)
    return not np.std(means) < 0.5 * np.std(rate)


def _all(path: Path, count: int) -> Array:
    return np.memmap(path, "<f8", "r", shape=(count,)) if count else np.empty(0)


def main() -> int:
    """Read the file that the command line names; return 2 where it cannot be read to its end."""
    file, folder, reading = sys.argv[1:4]
    broken = False
    try:
        for message in contents(file, Path(folder), json.loads(reading)):
            print(json.dumps(message), flush=True)
            broken |= "error" in message
    except ImulabError as error:
        print(json.dumps({"error": str(error)}), flush=True)
        return 2
    except MemoryError:
        print(json.dumps({"error": f"{Path(file).name}: too large for the memory of this machine"}), flush=True)
        return 2
    return 2 if broken else 0


if __name__ == "__main__":
    sys.exit(main())

"""Logs at rest as they are given: short ones as recordings, large files block by block or with columns on disk."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from os import PathLike
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from imulab.disk import is_large, on_disk
from imulab.estimation.noise.long_rest import long_rest
from imulab.estimation.noise.rest import Rest
from imulab.procedures.inputs import as_blocks, as_recording
from imulab.reading import Data, Reading
from imulab.recording import Recording, Source


def given_log(
    data: Data,
    reading: Reading,
    function: Callable[..., Any],
    choose: Callable[[Recording], Sequence[str]],
    named: Callable[[NDArray[Any]], Mapping[str, Any]] | None = None,
) -> Recording | Rest:
    """Return a log as a function was given it; else as `read_log`. Errors as for `as_recording`."""
    return read_log(
        Path(data) if isinstance(data, str | PathLike) else None,
        lambda: as_blocks(data, reading, function),
        lambda: as_recording(data, reading, function, columns=named),
        choose,
    )


def read_log(
    path: Path | None,
    blocks: Callable[[], tuple[Iterator[Recording], Source | None]],
    whole: Callable[[], Recording],
    choose: Callable[[Recording], Sequence[str]],
) -> Recording | Rest:
    """Return a log; of a large file at rest, read block by block, what is left without its rows.

    Where a large one has to be looked at as a whole, its columns lie in temporary files.

    Parameters
    ----------
    path
        Of its file, None where it has none.
    blocks
        Reads it block by block, and says its source.
    whole
        Reads it as a whole, where it is short.
    choose
        Returns the columns to fit, given the first block.
    """
    if not is_large(path):
        return whole()
    read, source = blocks()
    first = next(read)
    names = choose(first)
    found = long_rest(chain([first], read), names) if names else None
    if found is None:
        return replace(on_disk(blocks()[0]), source=source)
    return replace(found, recording=replace(found.recording, source=source))

"""The folder of a ROS 2 bag: its data files and their order."""

from __future__ import annotations

import re
from pathlib import Path

from imulab.errors import ReadError


def files_of(folder: Path, name: str) -> list[Path]:
    """Return the data files of a ROS 2 bag's folder in order: those that its metadata lists, or else all.

    Raises
    ------
    ReadError
        There is none, or one that the folder's metadata lists is missing or compressed as a whole.
    """
    found = sorted((p for p in folder.iterdir() if p.suffix in (".mcap", ".db3")), key=_natural)
    metadata = folder / "metadata.yaml"
    listed: list[str] = []
    if metadata.is_file():
        listed = re.findall(r"^\s*-\s+['\"]?([^'\"\s]+\.(?:mcap|db3)(?:\.zstd)?)['\"]?\s*$", _text(metadata), re.M)
    for entry in listed:
        if entry.endswith(".zstd"):
            raise ReadError(f"{name}: {entry} is compressed as a whole; decompress it first with 'zstd -d'")
        if not (folder / Path(entry).name).is_file():
            raise ReadError(f"{name}: {entry} is listed in metadata.yaml, but it is not there")
    if listed:
        return [folder / Path(entry).name for entry in listed]
    if not found:
        common = next((ending for ending in (".csv", ".parquet") if any(folder.glob(f"*{ending}"))), "")
        raise ReadError(
            f"{name}: expected a file, found a folder that is no ROS 2 bag (no .mcap or .db3 in it)"
            + (f"; name the files in it: {name}/*{common}" if common else "")
        )
    return found


def _natural(path: Path) -> list[tuple[int, str]]:
    return [(int(part) if part.isdecimal() else -1, part) for part in re.split(r"(\d+)", path.name)]


def _text(path: Path) -> str:
    return path.read_bytes().decode("utf-8", "replace")

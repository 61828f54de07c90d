"""Calibration records: written whole, checked when read, and compared."""

from __future__ import annotations

from pathlib import Path

from imulab.errors import readable
from imulab.files import open_file

# Recognition of records by the first bytes of a file.


_LARGEST_RECORD = 1 << 26  # bytes; no record is larger


def is_json(file: str) -> bool:
    """Return whether a file is a record and not a recording: a JSON object with one of two marks of records."""
    from imulab.records.calibration import FORMAT

    if file == "-" or (Path(file).exists() and not Path(file).is_file()):
        return False  # a pipe can be read only once, as a recording
    with readable(file), open_file(file) as stream:
        if not stream.read(64).lstrip().startswith(b"{"):
            return False
        stream.seek(0)
        content = stream.read(_LARGEST_RECORD)
        return FORMAT.encode() in content or b'"content_sha256"' in content

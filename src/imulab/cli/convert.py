"""``imulab convert``: any recording to native CSV or Parquet."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from itertools import chain
from typing import TYPE_CHECKING

from imulab.cli.fit_options import READ, reading, with_options
from imulab.cli.options import (
    OutputFile,
    RecordingFile,
    check_outputs,
    with_notes,
)

if TYPE_CHECKING:
    from imulab.recording import Recording


@with_options(READ)
def convert(
    file: RecordingFile,
    options: dict[str, str | None],
    output: OutputFile = None,
) -> None:
    """Write a recording of any kind as native CSV or Parquet to OUT, or as CSV to standard output."""
    from imulab.readers import read_blocks

    check_outputs([output], [name for name in (file, options["layout"]) if name])
    write_out(with_notes(read_blocks(file, **reading(options))), output)


def write_out(blocks: Iterable[Recording], output: str | None) -> None:
    """Write blocks to a file by its ending, or as CSV to standard output."""
    from imulab.writers import check_writable, write, write_csv_to

    if output:
        check_writable(output)
        write(blocks, output)
        return
    # The first block is made before anything is written, so that a refusal leaves no head behind.
    rest = iter(blocks)
    write_csv_to(chain([next(rest)], rest), sys.stdout.buffer)
    sys.stdout.buffer.flush()

"""``imulab convert``: any recording to native CSV or Parquet."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from itertools import chain
from typing import TYPE_CHECKING, Annotated

import typer

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
    with_files: Annotated[
        list[str] | None,
        typer.Option(
            "--with",
            metavar="FILE[@LAYOUT]",
            help="Another sensor of the same unit, on the same clock, whose columns are added; repeatable.",
        ),
    ] = None,
    output: OutputFile = None,
) -> None:
    """Write a recording of any kind as native CSV or Parquet to OUT, or as CSV to standard output."""
    from imulab.readers import read, read_blocks
    from imulab.readers.join import file_and_layout, join_recordings

    others = [file_and_layout(text) for text in with_files or []]
    inputs = [name for pair in ((file, options["layout"]), *others) for name in pair if name]
    check_outputs([output], inputs)
    blocks: Iterable[Recording] = read_blocks(file, **reading(options))
    if others:
        first = read(file, **reading(options))
        blocks = [join_recordings(first, [read(other, layout) for other, layout in others])]
    write_out(with_notes(blocks), output)


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

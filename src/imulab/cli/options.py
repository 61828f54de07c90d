"""What several commands take, and what they say."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from imulab.cli.speech import hold, speech
from imulab.cli.speech import note as note
from imulab.cli.speech import warn as warn
from imulab.errors import ImulabError, OptionError
from imulab.quantities import labelled
from imulab.quantities import quantity as quantity
from imulab.quantities import whole_number as whole_number
from imulab.records.recognition import is_json as is_json

if TYPE_CHECKING:
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration

Result = TypeVar("Result")
RecordingFile = Annotated[str, typer.Argument(metavar="FILE", help="Recording; - reads standard input.")]
RecordFile = Annotated[str, typer.Argument(metavar="RECORD", help="Calibration record.")]
OutputFile = Annotated[str | None, typer.Option("-o", "--output", metavar="OUT", help="File to write.")]
ReportFile = Annotated[str | None, typer.Option("--report", metavar="R.html", help="Report to write.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")]


def with_notes(
    blocks: Iterable[Recording], *, notes: bool = True, tell: Callable[[str, str], object] | None = None
) -> Iterator[Recording]:
    """Pass blocks on, and say on standard error what the reader did to the data, each thing once.

    `tell` takes a file's name and what is wrong with it; a warning at once if not given.
    """
    shown: set[str] = set()
    for block in blocks:
        yield block  # first: where the data are refused, the refusal is the one line there is
        for message in block.notes:
            kind = message.partition(":")[0]
            if kind not in shown and message.startswith("truncated"):
                tell(block.name, message) if tell else warn(f"{block.name}: {message}")
            elif message not in shown and notes and not message.startswith("truncated"):
                note(f"{block.name}: {message}")
            shown |= {kind, message}


def read_recording(file: str, **how: Any) -> Recording:
    """Read a recording as a whole, and warn where it was cut, in the line of a refusal if there is one."""
    from imulab.readers import read

    recording = read(file, **how)
    list(with_notes([recording], notes=False, tell=hold))
    return recording


def call(function: Callable[..., Result], *given: Any, **options: Any) -> Result:
    """Call a public function with a command's options; a refusal names them as the command line does."""
    with labelled("--{}", options):
        return function(*given, **options)


class GivenFiles:
    """Access to the files that a command names, for `imulab.procedures`."""

    def recording(self, name: str, layout: str | None, **part: Any) -> Recording:
        """Read a recording as a whole, and warn where it was cut."""
        return read_recording(name, layout=layout, **part)

    def record(self, name: str) -> Calibration:
        """Read a calibration record."""
        from imulab.procedures.loading import load

        return load(name)

    def blocks(self, name: str, layout: str | None, **part: Any) -> Iterator[Recording]:
        """Read a recording in blocks, and warn where it was cut."""
        from imulab.readers import read_blocks

        return with_notes(read_blocks(name, layout, **part), notes=False, tell=hold)

    def path(self, name: str) -> Path:
        """Return the path of a file."""
        return Path(name)

    def beside(self, name: str, file: str) -> str:
        """Return the name of a file that is named relative to another."""
        return str(Path(name).parent / file)


def check_outputs(outputs: list[str | None], inputs: list[str]) -> None:
    """Check before the work that each output has a folder to go to, and is no input nor another output.

    Raises
    ------
    OptionError
        An output cannot be written, or would overwrite another file of this command.
    """
    from imulab.atomic_write import check_no_paper, real_path

    taken = {Path(os.path.realpath(name)): name for name in inputs if name != "-"}
    for name in outputs:
        if name is None:
            continue
        if name in ("", "-"):
            raise OptionError(f"output {name!r}: expected the name of a file to write")
        check_no_paper(name)
        target = real_path(name)
        if target in taken:
            raise OptionError(f"{name}: would overwrite {taken[target]}; expected another name")
        if not target.parent.is_dir():
            raise OptionError(f"{name}: cannot be written: no such folder")
        taken[target] = name


@contextmanager
def naming(file: str) -> Iterator[None]:
    """Put the name of a file in front of what is refused for its sake, where the message does not have it."""
    try:
        yield
    except ImulabError as error:
        if str(error).startswith(file):
            raise
        raise type(error)(f"{file}: {error}") from None


@contextmanager
def progress_bar(title: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """Show how far long work has come, on standard error and only where that is a terminal."""
    if total is None or speech().quiet or not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=total)
        yield lambda done: bar.update(task, completed=done)

"""What several commands take, and how texts on the command line become values."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from imulab.errors import OptionError, ReadError, UnitError
from imulab.units import parse_unit, to_si

if TYPE_CHECKING:
    from imulab.recording import Recording

RecordingFile = Annotated[str, typer.Argument(metavar="FILE", help="Recording; - reads standard input.")]
RecordFile = Annotated[str, typer.Argument(metavar="RECORD", help="Calibration record.")]
LayoutFile = Annotated[str | None, typer.Option("--layout", metavar="L.toml", help="Columns of a foreign file.")]
OutputFile = Annotated[str | None, typer.Option("-o", "--output", metavar="OUT", help="File to write.")]
ReportFile = Annotated[str | None, typer.Option("--report", metavar="R.html", help="Report to write.")]
Topic = Annotated[
    str | None, typer.Option("--topic", metavar="TOPIC", help="Topic of a bag or log, where there are several.")
]
Instance = Annotated[
    str | None, typer.Option("--instance", metavar="N", help="Sensor of a flight log, from 0; the first if not given.")
]
Window = Annotated[
    str | None, typer.Option("--window", metavar="FROM:TO", help="Part to read, s; either side may be left out.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")]

_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\S.*)?")


def quantity(text: str, option: str, kind: str, default_unit: str) -> float:
    """Return a text such as ``0.7mg`` or ``5 s`` in SI.

    Raises
    ------
    OptionError
        It is no number with a unit of this kind.
    """
    match = _QUANTITY.fullmatch(text)
    expected = f"{option} {text!r}: expected a number, or one with a unit of {kind} such as 1 {default_unit}"
    if match is None:
        raise OptionError(expected)
    try:
        unit = parse_unit(match[2].strip() if match[2] else default_unit)
    except UnitError as error:
        raise OptionError(f"{option} {text!r}: {error}") from None
    if unit.quantity != kind:
        raise OptionError(expected)
    return to_si(float(match[1]), unit.symbol)


def whole_number(text: str, option: str) -> int:
    """Return a text as a whole number.

    Raises
    ------
    OptionError
        It is none.
    """
    try:
        return int(text)
    except ValueError:
        raise OptionError(f"{option} {text!r}: expected a whole number") from None


def chosen(topic: str | None, instance: str | None, window: str | None) -> dict[str, Any]:
    """Return the options of `read` that choose a part of a file.

    Raises
    ------
    OptionError
        The instance is no number, or the window is not FROM:TO.
    """
    part: tuple[float | None, ...] | None = None
    if window is not None:
        ends = window.split(":")
        if len(ends) != 2 or not any(end.strip() for end in ends):
            raise OptionError(f"--window {window!r}: expected FROM:TO in seconds, such as 10:60, 10: or :60")
        part = tuple(quantity(end, "--window", "time", "s") if end.strip() else None for end in ends)
    number = None if instance is None else whole_number(instance, "--instance")
    return {"topic": topic, "instance": number, "window": part}


def heard(blocks: Iterable[Recording], *, notes: bool = True) -> Iterator[Recording]:
    """Pass blocks on, and say on standard error what the reader did to the data, each thing once."""
    said: set[str] = set()
    for block in blocks:
        yield block  # first: where the data are refused, the refusal is the one line there is
        for note in block.notes:
            kind = note.partition(":")[0]
            if kind not in said and note.startswith("truncated"):
                warn(f"{block.name}: {note}")
            elif note not in said and notes and not note.startswith("truncated"):
                print(f"imulab: note: {block.name}: {note}", file=sys.stderr)
            said |= {kind, note}


def read_recording(file: str, layout: str | None, part: dict[str, Any]) -> Recording:
    """Read a recording as a whole, and warn where it was cut."""
    from imulab.readers import read

    recording = read(file, layout, **part)
    list(heard([recording], notes=False))
    return recording


def check_outputs(outputs: list[str | None], inputs: list[str]) -> None:
    """Check before the work that each output has a folder to go to, and is no input nor another output.

    Raises
    ------
    OptionError
        An output cannot be written, or would overwrite another file of this command.
    """
    taken = {Path(name).resolve(): name for name in inputs if name != "-"}
    for name in outputs:
        if name is None:
            continue
        if name in ("", "-"):
            raise OptionError(f"output {name!r}: expected the name of a file to write")
        if Path(name).resolve() in taken:
            raise OptionError(f"{name}: would overwrite {taken[Path(name).resolve()]}; expected another name")
        if not Path(name).resolve().parent.is_dir():
            raise OptionError(f"{name}: cannot be written: no such folder")
        taken[Path(name).resolve()] = name


def is_json(file: str) -> bool:
    """Return whether a file is a record rather than a recording, by its first character."""
    if file == "-" or Path(file).is_dir():
        return False
    try:
        with Path(file).open("rb") as stream:
            return stream.read(64).lstrip().startswith(b"{")
    except FileNotFoundError:
        raise ReadError(f"{file}: no such file") from None
    except OSError as error:
        raise ReadError(f"{file}: cannot be read: {error.strerror}") from None


@contextmanager
def progress_bar(title: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """Show how far long work has come, on standard error and only where that is a terminal."""
    if total is None or not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=total)
        yield lambda done: bar.update(task, completed=done)


def warn(message: str) -> None:
    """Print one line on standard error."""
    print(f"imulab: warning: {message}", file=sys.stderr)

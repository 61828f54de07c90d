"""Options common to several commands, and messages of commands on standard error."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO, TypeVar

from imulab.cli.command import Argument, option
from imulab.display import Note, printable
from imulab.errors import ImulabError, OptionError, first_of
from imulab.options import FLAG, OUTPUT, options_of, read_options
from imulab.quantities import labelled
from imulab.quantities import quantity as quantity
from imulab.quantities import whole_number as whole_number
from imulab.records import is_json as is_json

if TYPE_CHECKING:
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration


# Messages on standard error: how many, and in which colours.


_COLOURS = {"good": 32, "pass": 32, "look": 33, "warning": 33, "bad": 31, "fail": 31}


@dataclass
class Speech:
    """Messages of one run of a command, and those that it still holds back."""

    quiet: bool = False
    verbose: bool = False
    project: bool = True
    """Whether a project file counts."""
    held: dict[str, str] = field(default_factory=dict)
    """Warnings that wait for what becomes of their file: its name to the warning."""
    released: set[str] = field(default_factory=set)
    stop: Callable[[], None] = lambda: None
    """Ends what ``verbose`` began."""


_SPEECH: ContextVar[Speech] = ContextVar("speech")


def speech() -> Speech:
    """Return the messages of the running command."""
    try:
        return _SPEECH.get()
    except LookupError:  # a function of the command line that is called by itself
        _SPEECH.set(Speech())
        return _SPEECH.get()


@contextmanager
def begin(*, project: bool) -> Iterator[None]:
    """Start a command, perhaps within another, with no messages."""
    now = Speech(project=project)
    token = _SPEECH.set(now)
    try:
        yield
    finally:
        now.stop()
        _SPEECH.reset(token)


def choose(*, quiet: bool, verbose: bool, project: bool) -> None:
    """Set how many messages are printed, and whether a project file is used."""
    now = speech()
    now.quiet, now.verbose, now.project = quiet, verbose, now.project and project
    if verbose:
        now.stop = _listen()


def _listen() -> Callable[[], None]:
    """Start to print the readers' log; return a function that stops it."""
    import logging

    class Told(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            tell(record.getMessage())

    logger, handler = logging.getLogger("imulab"), Told()
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)

    def stop() -> None:
        logger.removeHandler(handler)
        logger.setLevel(level)

    return stop


def tell(message: str) -> None:
    """Print one line on standard error where ``--verbose`` asks for it."""
    if speech().verbose:
        print(printable(f"imulab: {message}"), file=sys.stderr)


def note(message: str) -> None:
    """Print one line on standard error that is no warning; nothing with ``--quiet``, and no warning a second time."""
    release()
    warned = any(text == message or text.endswith(f": {message}") for text in speech().released)
    if not warned and not speech().quiet:
        print(printable(f"imulab: note: {message}"), file=sys.stderr)


def warn(message: str) -> None:
    """Print one line on standard error, after the lines that were held; a `Note` is printed as a note."""
    release()
    if message in speech().released:
        return
    if isinstance(message, Note):
        note(message)
    else:
        _warning(message)


def hold(name: str, message: str) -> None:
    """Hold a warning about a file until it is known whether the file is refused."""
    speech().held.setdefault(name, message)


def release() -> None:
    """Print the held warnings, because the work went on."""
    now = speech()
    for name in list(now.held):
        message = f"{name}: {now.held.pop(name)}"
        now.released.add(message)
        _warning(message)


def explained(message: str) -> str:
    """Return a refusal with the held warnings about its file, so that one mistake makes one line."""
    held = speech().held
    about = [name for name in held if name in message] or (list(held) if len(held) == 1 else [])
    notes = "; ".join(held[name] if name in message else f"{name}: {held[name]}" for name in about)
    held.clear()
    return f"{message} ({notes})" if notes else message


def coloured(word: str, stream: TextIO | None = None) -> str:
    """Return a word such as ``good`` in its colour if the stream is a terminal with colours.

    ``NO_COLOR`` turns them off (no-color.org). The word alone carries the meaning.
    """
    stream = stream or sys.stdout
    if word not in _COLOURS or os.environ.get("NO_COLOR") or os.environ.get("TERM", "dumb") == "dumb":
        return word
    return f"\x1b[{_COLOURS[word]}m{word}\x1b[0m" if stream.isatty() else word


def _warning(message: str) -> None:
    print(f"imulab: {coloured('warning', sys.stderr)}: {printable(message)}", file=sys.stderr)


# Reading and checks that several commands share.


Result = TypeVar("Result")
RecordingFile = Annotated[str, Argument("FILE", "Recording; - reads standard input.")]
RecordFile = Annotated[str, Argument("RECORD", "Calibration record.")]
OutputFile = Annotated[str | None, option("OUT", "File to write.", "-o", "--output"), OUTPUT]
ReportFile = Annotated[str | None, option("R.html", "Report to write.", "--report"), OUTPUT]
AsJson = Annotated[bool, option("", "Print the result as JSON, and nothing else.", "--json"), OUTPUT]


def with_notes(
    blocks: Iterable[Recording], *, notes: bool = True, tell: Callable[[str, str], object] | None = None
) -> Iterator[Recording]:
    """Yield blocks, and print the reader's notes on the data, each once.

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
    """Return a recording as a whole; a warning that it was cut is part of the line of a refusal, if there is one."""
    from imulab.readers import read_mapped

    recording = read_mapped(file, **how)
    list(with_notes([recording], notes=False, tell=hold))
    return recording


def call(function: Callable[..., Result], *arguments: Any, **options: Any) -> Result:
    """Call a public function with a command's options; a refusal names them as the command line does."""
    with labelled("--{}", options):
        return function(*arguments, **options)


def how_to_read() -> Any:
    """Return the class of reading options; it is not imported for lists of commands."""
    from imulab.recording import Reading

    return Reading


def reading(options: dict[str, Any]) -> dict[str, Any]:
    """Return the options of `imulab.read` that a command has, removed from its options."""
    chosen = [option for option in options_of(how_to_read()) if option.keyword in options]
    return read_options(chosen, {option.name: options.pop(option.keyword) for option in chosen}, FLAG)


class GivenFiles:
    """Access to the files that a command names, for `imulab.procedures`."""

    def recording(self, name: str, layout: str | None, **part: Any) -> Recording:
        """Read a recording as a whole, and warn where it was cut."""
        from imulab.estimation.sampling import mend_stamps

        return mend_stamps(read_recording(name, layout=layout, **part))

    def record(self, name: str) -> Calibration:
        """Read a calibration record."""
        from imulab.procedures.registry import load

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
        from imulab.files import check_within

        path = Path(name).parent / file
        check_within(path)  # before it is asked whether there is such a file
        return str(path)


def check_outputs(
    outputs: list[str | None], inputs: list[str], *, report: str | None = None, paper: bool = False
) -> None:
    """Refuse, before the work, an output without a folder, or one that is an input or another output.

    `report` is the output that is an HTML page; `paper` says that the command writes printed pages.

    Raises
    ------
    OptionError
        An output cannot be written, or would overwrite another file of this command.
    """
    from imulab.files import check_no_paper, check_page, real_path

    taken = {Path(os.path.realpath(name)): name for name in inputs if name != "-"}
    for name in (*outputs, report):
        if name is None:
            continue
        if name == "-":
            raise OptionError("output '-': expected the name of a file to write")
        if not paper:
            check_no_paper(name)
        target = real_path(name)
        if target in taken:
            raise OptionError(f"{name}: would overwrite {taken[target]}; expected another name")
        if not target.parent.is_dir():
            raise OptionError(f"{name}: cannot be written: no such folder")
        taken[target] = name
    if report is not None:
        check_page(report)


NO_RECORD = (".html", ".htm", ".csv", ".parquet", ".yaml", ".yml", ".toml", ".txt", ".params", ".param")
"""Endings of files that a record, which is JSON, would be taken for."""


def check_record_outputs(output: str | None, report: str | None, inputs: list[str], *others: str | None) -> None:
    """Refuse, before the work, outputs of a fit; errors as for `check_outputs`, and a record's name of another format.

    Raises
    ------
    OptionError
        See above.
    """
    check_outputs([*others, output], inputs, report=report)
    if output is not None and (path := Path(output)).suffix.lower() in NO_RECORD:
        page = f"; --report {output} writes a page" if path.suffix.lower() in (".html", ".htm") else ""
        raise OptionError(f"{output}: a record is JSON; expected a name such as {path.with_suffix('.json')}{page}")


def warn_older(folder: str, written: Iterable[str]) -> None:
    """Warn of recordings that were in a folder before, which a pattern such as ``FOLDER/*.csv`` names too."""
    older = sorted({path.name for path in Path(folder).glob("*.csv")} - set(written))
    if older:
        names = first_of(older, 3)
        many = "1 CSV file from before is" if len(older) == 1 else f"{len(older)} CSV files from before are"
        warn(f"{folder}: {many} still there ({names}): {folder}/*.csv takes in what is not of this run")


@contextmanager
def naming(file: str) -> Iterator[None]:
    """Add the name of a file to a refusal that lacks it."""
    try:
        yield
    except ImulabError as error:
        if str(error).startswith(f"{file}:"):
            raise
        raise type(error)(f"{file}: {error}") from None


@contextmanager
def progress_bar(title: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """Show the progress of long work on standard error, if that is a terminal."""
    if total is None or speech().quiet or not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=total)
        yield lambda done: bar.update(task, completed=done)

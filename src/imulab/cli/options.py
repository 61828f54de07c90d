"""Options that several commands take, and what commands say on standard error beside their results."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from importlib import import_module
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO, TypeVar

import typer

from imulab.display import Note, printable
from imulab.errors import ImulabError, OptionError
from imulab.procedures.procedure import ELEMENT, FLAG, READING, Option, read_options
from imulab.quantities import labelled
from imulab.quantities import quantity as quantity
from imulab.quantities import whole_number as whole_number
from imulab.records import is_json as is_json

if TYPE_CHECKING:
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration


# What a command says on standard error beside its result, how much of it, and in which colours.


_COLOURS = {"good": 32, "pass": 32, "look": 33, "warning": 33, "bad": 31, "fail": 31}


@dataclass
class Speech:
    """What one run of a command has said and still holds back."""

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
    """Return that of the command that runs."""
    try:
        return _SPEECH.get()
    except LookupError:  # a function of the command line that is called by itself
        _SPEECH.set(Speech())
        return _SPEECH.get()


@contextmanager
def begin(*, project: bool) -> Iterator[None]:
    """Begin a command, maybe within another: nothing has been said."""
    now = Speech(project=project)
    token = _SPEECH.set(now)
    try:
        yield
    finally:
        now.stop()
        _SPEECH.reset(token)


def choose(*, quiet: bool, verbose: bool, project: bool) -> None:
    """Set how much is said, and whether a project file counts."""
    now = speech()
    now.quiet, now.verbose, now.project = quiet, verbose, now.project and project
    if verbose:
        now.stop = _listen()


def _listen() -> Callable[[], None]:
    """Begin to print what the readers tell of their work; return what ends it."""
    import logging

    class Told(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            tell(record.getMessage())

    logger, told = logging.getLogger("imulab"), Told()
    level = logger.level
    logger.addHandler(told)
    logger.setLevel(logging.INFO)

    def stop() -> None:
        logger.removeHandler(told)
        logger.setLevel(level)

    return stop


def tell(message: str) -> None:
    """Print one line on standard error where ``--verbose`` asks for it."""
    if speech().verbose:
        print(printable(f"imulab: {message}"), file=sys.stderr)


def note(message: str) -> None:
    """Print one line on standard error that is worth knowing and no warning; nothing with ``--quiet``."""
    release()
    if not speech().quiet:
        print(printable(f"imulab: note: {message}"), file=sys.stderr)


def warn(message: str) -> None:
    """Print one line on standard error, after what was held; a `Note` is called one."""
    if isinstance(message, Note):
        if message not in speech().released:
            note(message)
        return
    release()
    if message not in speech().released:
        _warning(message)


def hold(name: str, message: str) -> None:
    """Keep a warning about a file until it is known what becomes of the file."""
    speech().held.setdefault(name, message)


def release() -> None:
    """Print the warnings held so far: the work went on."""
    now = speech()
    for name in list(now.held):
        message = f"{name}: {now.held.pop(name)}"
        now.released.add(message)
        _warning(message)


def explained(message: str) -> str:
    """Return a refusal with what is held about the file that it speaks of, so that one mistake makes one line."""
    held = speech().held
    about = [name for name in held if name in message] or (list(held) if len(held) == 1 else [])
    found = "; ".join(held[name] if name in message else f"{name}: {held[name]}" for name in about)
    held.clear()
    return f"{message} ({found})" if found else message


def coloured(word: str, stream: TextIO | None = None) -> str:
    """Return a word such as ``good`` in its colour where the stream is a terminal that has colours.

    ``NO_COLOR`` turns them off (no-color.org). The word alone carries the meaning.
    """
    stream = stream or sys.stdout
    if word not in _COLOURS or os.environ.get("NO_COLOR") or os.environ.get("TERM", "dumb") == "dumb":
        return word
    return f"\x1b[{_COLOURS[word]}m{word}\x1b[0m" if stream.isatty() else word


def _warning(message: str) -> None:
    print(f"imulab: {coloured('warning', sys.stderr)}: {printable(message)}", file=sys.stderr)


# Options on the command line, made from the one definition that manifests and functions share.


READ = (*READING, ELEMENT)
"""How a recording is read."""


def reading(texts: Mapping[str, str | None]) -> dict[str, Any]:
    """Return the options of `imulab.read`, from the texts of those that a command has."""
    return read_options([option for option in READ if option.name in texts], texts, FLAG)


def with_options(options: Sequence[Option]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that puts the options in the place of a command's parameter `options`.

    The command gets the texts that were given by the names of the options, None where none was.
    """

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        def run(**given: Any) -> Any:
            texts = {option.name: _text(given.pop(option.keyword)) for option in options}
            return command(options=texts, **given)

        parameters: list[Parameter] = []
        for parameter in signature(command, eval_str=True).parameters.values():
            parameters += map(_parameter, options) if parameter.name == "options" else [parameter]
        parameters = [parameter.replace(kind=Parameter.KEYWORD_ONLY) for parameter in parameters]
        run.__name__, run.__doc__ = command.__name__, command.__doc__
        run.__signature__ = signature(command).replace(parameters=parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return run

    return decorate


def _parameter(option: Option) -> Parameter:
    """An option as a parameter of a command, which typer reads."""
    if option.switch:
        kind: Any = Annotated[bool, typer.Option(option.flag, help=option.help)]
        return Parameter(option.keyword, Parameter.KEYWORD_ONLY, default=False, annotation=kind)
    offered = _beginning(option.choices) if option.choices else None
    info = typer.Option(option.flag, metavar=option.shows, help=option.help, autocompletion=offered)
    return Parameter(
        option.keyword, Parameter.KEYWORD_ONLY, default=option.default, annotation=Annotated[str | None, info]
    )


def one_of(choices: Iterable[str], help: str, *flags: str, metavar: str | None = None) -> Any:  # noqa: A002
    """Return an option of few words, which its help lists and a shell completes."""
    words = tuple(choices)
    return typer.Option(*flags, metavar=metavar or "|".join(words), help=help, autocompletion=_beginning(words))


def lists(where: str) -> Callable[[str], list[str]]:
    """Return what completes a word of a list that costs an import: ``imulab.exporters:EXPORTERS``."""
    module, _, name = where.partition(":")
    return lambda incomplete: _beginning(getattr(import_module(module), name))(incomplete)


def _beginning(choices: Iterable[str]) -> Callable[[str], list[str]]:
    def words(incomplete: str) -> list[str]:
        return [choice for choice in choices if choice.startswith(incomplete)]

    return words


def _text(value: Any) -> str | None:
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else value


# What several commands take, and what they say.


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
        return str(Path(name).parent / file)


def check_outputs(outputs: list[str | None], inputs: list[str]) -> None:
    """Check before the work that each output has a folder to go to, and is no input nor another output.

    Raises
    ------
    OptionError
        An output cannot be written, or would overwrite another file of this command.
    """
    from imulab.files import check_no_paper, real_path

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

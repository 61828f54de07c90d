"""What a command says on standard error beside its result, how much of it, and in which colours."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import TextIO

from imulab.printable import printable
from imulab.verdict import Note

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

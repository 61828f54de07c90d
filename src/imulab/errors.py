"""The errors that imulab raises for mistakes of the user.

Every message is one line that names the place (file, column, row or time), what was expected and what was
found. The command line prints the message alone and exits with 2.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress

from imulab.display import one_thing, printable

_DIGITS = re.compile(r"\d{60,}")


def listed(known: Iterable[str], word: object) -> str:
    """Return the known words for a message, and the likely one: ``square huber; did you mean 'huber'?``."""
    names = list(known)
    return " ".join(names) + meant(names, word)


def quoted(value: object, longest: int = 60) -> str:
    """Return a value for a message, as Python writes it (a day as TOML does), cut if it is long."""
    if isinstance(value, list):
        text = f"[{', '.join(quoted(each, longest) for each in value)}]"
    else:
        text = str(value) if hasattr(value, "isoformat") else repr(value)
    return text if len(text) <= longest else text[: longest - 3] + "..."


def several(words: Iterable[str], longest: int = 300) -> str:
    """Return words for a message, as many as fit in a line."""
    text = " ".join(words)
    return text if len(text) <= longest else text[: longest - 4] + " ..."


def first_of(names: Sequence[str], most: int, between: str = ", ") -> str:
    """Return the first names for a message, and how many more there are: ``x, y and 3 more``."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return between.join(names[:most]) + more


def meant(known: Iterable[str], word: object, alike: float = 0.6) -> str:
    """Return ``; did you mean 'huber'?`` if a word is nearly one of the known ones, and of no second as much.

    `alike` is how much of two words must agree, from 0 to 1.
    """
    from difflib import SequenceMatcher, get_close_matches

    names, text = {name.lower(): name for name in known}, str(word).lower()
    close = get_close_matches(text, names, n=2, cutoff=alike)
    tied = len(close) == 2 and len({SequenceMatcher(None, name, text).ratio() for name in close}) == 1
    return f"; did you mean {names[close[0]]!r}?" if close and not tied and names[close[0]] != word else ""


def install(extra: str) -> str:
    """Return how to install the packages of an extra, for a message; no index has imulab, its source folder has."""
    return f"pip install '.[{extra}]' in imulab's source folder"


def file_name(value: object) -> str | os.PathLike[str]:
    """Return the name of a file.

    Raises
    ------
    OptionError
        It is something else, or empty.
    """
    if isinstance(value, str | os.PathLike) and str(value):
        return value
    raise OptionError(f"expected the name of a file, found {quoted(value)}")


class ImulabError(Exception):
    """Base of all errors that name a mistake in the input rather than in imulab; the message is one line.

    Examples
    --------
    >>> import imulab as il
    >>> try:
    ...     il.normal_gravity(0.8, height=1e6)
    ... except il.ImulabError as error:
    ...     print(error)
    height 1e+06 m: expected -500 to 10000 m
    """

    def __init__(self, message: str = "") -> None:
        # Texts out of files may hold ends of lines and what a terminal obeys, and numbers thousands of digits.
        text = one_thing(printable(" ".join(message.splitlines())))
        super().__init__(_DIGITS.sub(lambda match: f"{match[0][:12]}...({len(match[0])} digits)", text))

    def _render_traceback_(self) -> list[str]:
        """Return what a notebook shows: the line of the cell or script, and the message; all with IMULAB_DEBUG=1."""
        from traceback import extract_tb, format_exception

        if os.environ.get("IMULAB_DEBUG"):
            return format_exception(self)
        inside = (__file__.removesuffix("errors.py"), f"{os.sep}IPython{os.sep}")
        outside = [each for each in extract_tb(self.__traceback__) if not any(part in each.filename for part in inside)]
        lines = [f"----> {outside[-1].lineno} {outside[-1].line}"] if outside and outside[-1].line else []
        return [*lines, f"{type(self).__name__}: {self}"]


class ReadError(ImulabError):
    """A file cannot be read as what it should be."""


class UnitError(ImulabError):
    """A unit is unknown, or cannot be converted to the one that is needed."""


class RecordError(ImulabError):
    """A calibration record is damaged, of a newer version, or no record at all."""


class LackingError(RecordError):
    """A calibration record lacks what is asked of it; it may be read for what it has."""


class DataError(ImulabError):
    """The samples cannot be what they are said to be: not finite, clipped, dead axis, time running backwards."""


class SegmentError(ImulabError):
    """The recording does not hold the static attitudes, runs or cycles that the procedure needs."""


class ObservabilityError(ImulabError):
    """The attitudes cannot separate the parameters of the model; the message names them."""


class OptionError(ImulabError):
    """An option has a value that cannot be used; the message lists what can."""


def folder_in_place(name: object, what: str = "a file", inside: Iterable[str] = ()) -> str:
    """Return the refusal of a folder in place of a file, which names those files in it that may be meant."""
    if not str(name):
        return "expected the name of a file, found ''"
    files = [os.path.join(str(name), each) for each in sorted(inside)]  # noqa: PTH118
    inside_it = f"; it holds {first_of(files, 3)}" if files else ""
    return f"{name}: expected {what}, found a folder{inside_it}"


@contextmanager
def readable(name: object, kind: type[ImulabError] = ReadError, ending: str = "") -> Iterator[None]:
    """Raise an error of the system on reading a file as one line that names the file.

    `ending` is that of files to name where it is a folder, such as ``.json``.
    """
    try:
        yield
    except FileNotFoundError:
        raise kind(f"{name}: no such file") from None
    except IsADirectoryError:
        inside: list[str] = []
        if ending:
            with suppress(OSError):  # the name need not be a path
                inside = [each for each in os.listdir(str(name)) if each.endswith(ending)]  # noqa: PTH208
        raise kind(folder_in_place(name, inside=inside)) from None
    except OSError as error:
        raise kind(f"{name}: cannot be read: {error.strerror}") from None

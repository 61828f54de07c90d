"""What the page is put together from: each part brings its addresses and its messages on the socket.

Messages are JSON objects with a ``type``; each part documents its own. All parts share two from the server: ``hello``
(``areas``: the names of the parts, ``version``) is the first on every socket, and ``refused`` (``text``: why) answers a
message that could not be done.
"""

from __future__ import annotations

import asyncio
import json
import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, is_dataclass
from typing import Any, ClassVar

import numpy as np
from starlette.routing import BaseRoute

Message = dict[str, Any]
_MOST_WAITING = 1000


class Part:
    """One area of the page; `guided.GuidedPart` is the guided session.

    Attributes
    ----------
    name
        Of its area in ``index.html`` and of its module under ``static``.
    routes
        Addresses beside those of the others.
    handlers
        What is called with a page's message, by its type, in the server's thread: what takes long belongs in
        another. An ImulabError that it raises becomes ``refused``.
    """

    name: ClassVar[str] = ""

    def __init__(self) -> None:
        self.routes: Sequence[BaseRoute] = ()
        self.handlers: Mapping[str, Callable[[Message], object]] = {}

    def begin(self, hub: Hub) -> None:
        """Begin, once the server runs: from now on `hub.tell` reaches the pages."""

    def greet(self) -> Iterable[Message]:
        """Yield what a page is told when it has come, or has come back."""
        return ()

    def end(self) -> None:
        """End what runs beside the server; it may be called again."""


class Hub:
    """The pages that are connected, and the way to them from every thread."""

    def __init__(self) -> None:
        self._lines: set[Line] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self.stop: Callable[[], None] = lambda: None
        """Ends the server, from every thread."""

    @property
    def pages(self) -> int:
        """How many pages are connected."""
        return len(self._lines)

    def tell(self, message: Message, *, latest: bool = False) -> None:
        """Tell every page, from any thread; with `latest`, in place of what still waits of the same type."""
        text = to_json(message)
        if self._loop is not None:
            with suppress(RuntimeError):  # the server has ended
                self._loop.call_soon_threadsafe(self._put, str(message["type"]), text, latest)

    def begin(self, loop: asyncio.AbstractEventLoop) -> None:
        """Begin to pass messages on."""
        self._loop = loop

    def join(self, line: Line) -> None:
        """Connect a page."""
        self._lines.add(line)

    def leave(self, line: Line) -> None:
        """Let go of a page."""
        self._lines.discard(line)

    def _put(self, kind: str, text: str, latest: bool) -> None:
        for line in self._lines:
            line.put(kind, text, latest=latest)


class Line:
    """What waits for one page: a slow one gets the latest view, and does not hold the others up."""

    def __init__(self) -> None:
        self._waiting: deque[str] = deque(maxlen=_MOST_WAITING)
        self._latest: dict[str, str] = {}
        self._some = asyncio.Event()

    def put(self, kind: str, text: str, *, latest: bool = False) -> None:
        """Add a message."""
        if latest:
            self._latest[kind] = text
        else:
            self._waiting.append(text)
        self._some.set()

    async def get(self) -> list[str]:
        """Return what waits, once there is something."""
        await self._some.wait()
        self._some.clear()
        found = [*self._waiting, *self._latest.values()]
        self._waiting.clear()
        self._latest.clear()
        return found


def to_json(message: object) -> str:
    """Return a message as JSON; dataclasses as objects, numbers that are none as null, lone surrogates as ``?``."""
    text = json.dumps(_plain(message), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.encode("utf-8", "replace").decode("utf-8")


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value

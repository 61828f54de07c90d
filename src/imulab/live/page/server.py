"""The server of the page, the parts that make the page, and the checks of who may use it.

The server listens on this machine only, unless an option says otherwise. That alone does not keep other pages of the
same browser out, so every request also needs the token of this run, the address as its Host, and this page as its
Origin.

Messages are JSON objects with a ``type``; each part documents its own. Two are common to all parts: ``hello``
(``areas``: the names of the parts, ``version``) is the first on every socket, and ``refused`` (``text``: why) answers a
message that could not be carried out.

Addresses: ``/`` the page, ``/static/..`` its files, ``/ws`` the socket, ``/api/..`` those of the parts.
"""

from __future__ import annotations

import asyncio
import errno
import json
import math
import secrets
import signal
import socket
import sys
import threading
import webbrowser
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import asdict, is_dataclass
from http.cookies import CookieError, SimpleCookie
from importlib.resources import files
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import parse_qs

import h11
import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.types import Message as AsgiMessage
from starlette.websockets import WebSocket, WebSocketDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol

from imulab._version import VERSION
from imulab.errors import ImulabError, OptionError, quoted

# Access: who may use the server, what the browser may do with its answers, and which files it reaches.


TOKEN_HEADER = "x-imulab-token"
LOCAL, EVERY = "127.0.0.1", ("0.0.0.0", "::")
_NAMES = (LOCAL, "localhost")
_HTTP_PORT = 80  # which browsers leave out of the Host header
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "frame-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Nothing inline, nothing from elsewhere: the text of a file that reached the page as HTML would still not run."""
_REPORT_POLICY = "sandbox allow-scripts allow-popups allow-modals"
_HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cache-control": "no-cache",
}
_STRANGER = "This is not the address that imulab has shown: open that one, with its token."
_FOREIGN = "Another page has asked for this: refused."


def new_token() -> str:
    """Return a token that cannot be guessed."""
    return secrets.token_urlsafe(24)


def in_address(host: str) -> str:
    """Return a host as it stands in an address: IPv6 in brackets."""
    return f"[{host}]" if ":" in host else host


def _split_host(host: str) -> tuple[str, str, str]:
    """Return name, colon and port of the header Host; the colons of IPv6 stand in brackets."""
    name, bracket, rest = host.rpartition("]")
    before, colon, port = rest.partition(":")
    return name + bracket + before, colon, port


class Guard:
    """Middleware that passes only requests of the page itself, and sets the policy on every answer.

    Parameters
    ----------
    app
        The guarded application.
    token
        Part of the address of ``/``; a cookie then replaces it. Programs send it in the header ``X-Imulab-Token``.
    limit
        Most bytes of one request.
    once
        Replaces the token in the address a single time, because other users of the machine see the address that a
        browser is started with.
    host
        Address at which the server listens.
    """

    def __init__(self, app: ASGIApp, token: str, limit: int, once: str = "", host: str = LOCAL) -> None:
        self._host = host
        self._app, self._token, self._limit, self._once = app, token, limit, once
        self._key = new_token()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or pass it on."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        answer = self._refusal(scope)
        if answer is not None and scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": ""})
            return

        async def headed(message: AsgiMessage) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        if answer is not None:
            await answer(scope, receive, headed)
        else:
            await self._app(scope, self._limit_body(receive), headed)

    def _refusal(self, scope: Scope) -> Response | None:
        """Return the answer to a request that is refused; None for the others."""
        headers, port = Headers(scope=scope), scope["server"][1]
        host = headers.get("host", "")
        name, colon, offered = _split_host(host)
        if not self._is_here(name) or offered != ("" if port == _HTTP_PORT and not colon else str(port)):
            return PlainTextResponse(_STRANGER, 421)
        if headers.get("origin", f"http://{host}") != f"http://{host}" or (
            headers.get("sec-fetch-site", "none") in ("cross-site", "same-site") and scope.get("path") != "/"
        ):
            return PlainTextResponse(_FOREIGN, 403)
        if scope["type"] == "http":
            length = headers.get("content-length", "0")
            if not length.isdigit() or int(length) > self._limit:
                return PlainTextResponse(f"Too large: at most {self._limit >> 20} MiB at once.", 413)
        cookie = f"imulab_{port}"
        offered = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]
        if scope["type"] == "http" and scope["path"] == "/" and self._admits(offered):
            answer = RedirectResponse("/", 303)
            answer.set_cookie(cookie, self._key, httponly=True, samesite="strict", path="/")
            return answer
        if _same(headers.get(TOKEN_HEADER, ""), self._token) or _same(_cookie(headers, cookie), self._key):
            return None
        return PlainTextResponse(_STRANGER, 403)

    def _is_here(self, name: str) -> bool:
        """Return whether a name is one of the server's address; a foreign name may lead here, too."""
        if self._host in EVERY and (name.replace(".", "").isdigit() or name.startswith("[")):
            return True
        return name.lower() in (*_NAMES, in_address(self._host).lower())

    def _admits(self, token: str) -> bool:
        """Return whether the token in an address admits its browser."""
        if self._once and _same(token, self._once):
            self._once = ""
            return True
        return _same(token, self._token)

    def _limit_body(self, receive: Receive) -> Receive:
        """Return `receive` for a body that ends with an error beyond the limit."""
        taken = 0

        async def counted() -> AsgiMessage:
            nonlocal taken
            message = await receive()
            if message["type"] == "http.request":
                taken += len(message.get("body", b""))
                if taken > self._limit:
                    raise OptionError(f"too large: expected at most {self._limit >> 20} MiB at once")
            return message

        return counted


def _same(first: str, other: str) -> bool:
    return secrets.compare_digest(first.encode("utf-8"), other.encode("utf-8"))


def _cookie(headers: Headers, name: str) -> str:
    try:
        cookie = SimpleCookie(headers.get("cookie", "")).get(name)
    except CookieError:
        return ""
    return cookie.value if cookie else ""


def inside(folder: Path, name: str) -> Path:
    """Return the path of a file directly in the session's folder.

    Raises
    ------
    OptionError
        The name leads elsewhere: it is no file name, has a folder in front, or is a link out of the folder.
    """
    path = folder / name
    plain = name not in ("", ".", "..") and not set(name) & {"/", "\\", "\0", ":"}
    if not plain or path.resolve().parent != folder.resolve():
        raise OptionError(f"{quoted(name)}: expected the name of a file in the session's folder, without a path")
    return path


def report_response(text: str) -> HTMLResponse:
    """Return a report as an answer: a page with scripts that cannot reach the session."""
    return HTMLResponse(text, headers={"content-security-policy": _REPORT_POLICY})


async def receive_file(request: Request, path: Path) -> int:
    """Write the body of a request to a file, completely or not at all; return its length.

    Raises
    ------
    OptionError
        It is longer than the limit, or cannot be written.
    """
    from imulab.files import replacing

    size = 0
    with replacing(path) as out:
        async for piece in request.stream():
            out.write(piece)
            size += len(piece)
    return size


# Parts: each brings its addresses and its messages on the socket.


Message = dict[str, Any]
_MOST_WAITING = 1000  # messages for a slow page; older ones are dropped


class PagePart:
    """One area of the page; `guided.GuidedPart` is the guided session.

    Attributes
    ----------
    name
        Name of its area in ``index.html`` and of its module under ``static``.
    routes
        Addresses of the part.
    handlers
        Functions by type of a page's message, called in the server's thread: long work belongs in another thread. An
        ImulabError that they raise becomes ``refused``.
    """

    name: ClassVar[str] = ""

    def __init__(self) -> None:
        self.routes: Sequence[BaseRoute] = ()
        self.handlers: Mapping[str, Callable[[Message], object]] = {}

    def begin(self, hub: Hub) -> None:
        """Start, once the server runs: from now on `hub.tell` reaches the pages."""

    def greet(self) -> Iterable[Message]:
        """Yield the messages for a page that has connected, or connected again."""
        return ()

    def end(self) -> None:
        """End all work of the part; it may be called again."""


class Hub:
    """The connected pages, and the way to send them messages from every thread."""

    def __init__(self) -> None:
        self._lines: set[TextLine] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self.stop: Callable[[], None] = lambda: None
        """Ends the server, from every thread."""

    @property
    def pages(self) -> int:
        """Number of connected pages."""
        return len(self._lines)

    def tell(self, message: Message, *, latest: bool = False) -> None:
        """Send a message to every page, from any thread; with `latest`, it replaces a waiting one of its type."""
        text = to_json(message)
        if self._loop is not None:
            with suppress(RuntimeError):  # the server has ended
                self._loop.call_soon_threadsafe(self._put, str(message["type"]), text, latest)

    def begin(self, loop: asyncio.AbstractEventLoop) -> None:
        """Start to pass messages on."""
        self._loop = loop

    def join(self, line: TextLine) -> None:
        """Connect a page."""
        self._lines.add(line)

    def leave(self, line: TextLine) -> None:
        """Disconnect a page."""
        self._lines.discard(line)

    def _put(self, kind: str, text: str, latest: bool) -> None:
        for line in self._lines:
            line.put(kind, text, latest=latest)


class TextLine:
    """Messages that wait for one page: a slow page gets the latest view, and does not delay the others."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[str, str]] = deque(maxlen=_MOST_WAITING)
        self._some = asyncio.Event()

    def put(self, kind: str, text: str, *, latest: bool = False) -> None:
        """Add a message, behind all that were told before it; with `latest`, it replaces a waiting one of its kind."""
        replaces = kind if latest else ""
        if latest:
            self._waiting = deque((each for each in self._waiting if each[0] != replaces), _MOST_WAITING)
        self._waiting.append((replaces, text))
        self._some.set()

    async def get(self) -> list[str]:
        """Return the waiting messages, once there are any."""
        await self._some.wait()
        self._some.clear()
        messages = [text for _, text in self._waiting]
        self._waiting.clear()
        return messages


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


# The server: `imulab live SOURCE --page` and `imulab open` serve different parts.


UPLOAD_LIMIT = 4 << 30
"""Largest request, bytes: 4 GiB."""
_SOCKET_LIMIT = 1 << 16  # bytes of a message from a page
_GRACE = 2  # s for open requests when the server ends
_HEAD, _STALLED = 10.0, 60.0
"""s in which the head of a request has to come, and s without a byte of its body; then its connection is closed."""


class Patient(H11Protocol):
    """uvicorn's protocol, which would wait for ever for the rest of a request, with a limit."""

    _late: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for the head of a request."""
        super().connection_made(transport)
        self._wait(_HEAD)

    def data_received(self, data: bytes) -> None:
        """Take bytes, and wait for the rest of the head or of the body, if there is one."""
        began = self.conn.their_state is not h11.IDLE or self._late is None
        super().data_received(data)
        state = self.conn.their_state
        if self.transport.get_protocol() is not self:
            self._wait(None)  # it has become a socket
        elif state is not h11.IDLE:
            self._wait(_STALLED if state is h11.SEND_BODY else None)
        elif began:
            self._wait(_HEAD)

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no longer."""
        self._wait(None)
        super().connection_lost(exc)

    def _wait(self, seconds: float | None) -> None:
        if self._late is not None:
            self._late.cancel()
        self._late = None if seconds is None else self.loop.call_later(seconds, self.transport.close)


def application(token: str, parts: Sequence[PagePart], *, host: str = LOCAL, limit: int = UPLOAD_LIMIT) -> Starlette:
    """Return the application of a page with these parts at an address; its `state` has `hub`, `token` and `once`."""
    hub, once = Hub(), new_token()
    known = {kind: take for part in parts for kind, take in part.handlers.items()}
    hello = {"type": "hello", "areas": [part.name for part in parts], "version": VERSION}

    @asynccontextmanager
    async def alive(app: Starlette) -> AsyncIterator[None]:
        hub.begin(asyncio.get_running_loop())
        for part in parts:
            part.begin(hub)
        yield
        for part in parts:
            part.end()

    async def speak(page: WebSocket) -> None:
        await page.accept()
        line = TextLine()
        for message in (hello, *(each for part in parts for each in part.greet())):
            line.put("greeting", to_json(message))
        hub.join(line)
        writer = asyncio.create_task(_write(page, line))
        try:
            while True:
                _take(await page.receive_text(), known, line)
        except WebSocketDisconnect:
            pass
        finally:
            hub.leave(line)
            writer.cancel()

    static = files("imulab.live.page") / "static"
    report = files("imulab.report")
    shared = {"report.css": report / "style.css", "plotly.js": report / "vendor" / "plotly-cartesian.min.js"}
    routes = [
        Route("/", lambda request: FileResponse(str(static / "index.html"))),
        WebSocketRoute("/ws", speak),
        *(Route(f"/static/{name}", _file(str(path))) for name, path in shared.items()),
        Mount("/static", StaticFiles(directory=str(static))),
        *(route for part in parts for route in part.routes),
    ]
    app = Starlette(
        routes=routes,
        lifespan=alive,
        middleware=[Middleware(Guard, token=token, limit=limit, once=once, host=host)],
        exception_handlers={ImulabError: _refused},
    )
    app.state.hub, app.state.token, app.state.once = hub, token, once
    return app


def serve(
    parts: Sequence[PagePart],
    port: int = 0,
    *,
    host: str | None = None,
    browser: bool = True,
    limit: int = UPLOAD_LIMIT,
    tell: Callable[[str], object] = print,
) -> None:
    """Serve a page until Ctrl-C or `Hub.stop`, and say where: one line with the address, token included.

    Parameters
    ----------
    parts
        Parts of the page.
    port
        Port to listen at; 0 for a free one.
    host
        Address to listen at, ``0.0.0.0`` for all; None for the one that only this machine reaches.
    browser
        Whether to open a browser there.
    limit
        Most bytes of one request.
    tell
        Called with the line that states the address.

    Raises
    ------
    OptionError
        The port is taken, or not permitted, or the address does not belong to this machine.
    """
    listening = _listen(port, host or LOCAL)
    app = application(new_token(), parts, host=host or LOCAL, limit=limit)
    config = uvicorn.Config(
        app, log_level="critical", access_log=False, http=Patient, ws="websockets-sansio", ws_max_size=_SOCKET_LIMIT,
        timeout_graceful_shutdown=_GRACE, server_header=False,
    )  # fmt: skip
    server = uvicorn.Server(config)

    def stop() -> None:
        server.should_exit = True

    app.state.hub.stop = stop
    address = f"http://{_address_for_others(host or LOCAL)}:{listening.getsockname()[1]}/?token="
    try:
        with _end_on_hangup(stop):
            tell(address + app.state.token)
            sys.stdout.flush()
            if browser:
                _open(address + app.state.once)
            server.run(sockets=[listening])
    finally:
        listening.close()
        for part in parts:  # a second Ctrl-C would end the server before this is done
            part.end()


@contextmanager
def _end_on_hangup(stop: Callable[[], None]) -> Iterator[None]:
    """End the server as by Ctrl-C when its terminal is closed, so that nothing keeps running."""
    if sys.platform == "win32" or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGHUP, lambda *_: stop())
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)


def _open(address: str) -> None:
    """Open a browser if there is one; the address has been printed."""
    with suppress(webbrowser.Error, OSError):
        webbrowser.open(address)


def _address_for_others(host: str) -> str:
    """Return the address at which others reach a server that listens at `host`."""
    if host not in EVERY:
        return in_address(host)
    with socket.socket(_family(host), socket.SOCK_DGRAM) as probe, suppress(OSError):
        # Addresses of documents; nothing is sent, but the way there has an address of this end.
        probe.connect(("2001:db8::1" if ":" in host else "192.0.2.1", 9))
        return in_address(str(probe.getsockname()[0]))
    return "[::1]" if ":" in host else LOCAL


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def _listen(port: int, host: str = LOCAL) -> socket.socket:
    listening = socket.socket(_family(host), socket.SOCK_STREAM)
    if sys.platform != "win32":  # there it would let two programs listen at once
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((host, port))
        listening.listen()
    except OSError as error:
        listening.close()
        if host != LOCAL and error.errno != errno.EADDRINUSE:
            raise OptionError(f"--host {host}: cannot be listened at: {error.strerror}") from None
        raise OptionError(f"--port {port}: cannot be listened at: {error.strerror}; 0 takes a free one") from None
    return listening


def _file(path: str) -> Any:
    return lambda request: FileResponse(path)


async def _write(page: WebSocket, line: TextLine) -> None:
    with suppress(WebSocketDisconnect, RuntimeError):  # it has gone: the reader finds out, too
        while True:
            for text in await line.get():
                await page.send_text(text)


def _take(text: str, known: Mapping[str, Callable[[Message], object]], line: TextLine) -> None:
    """Pass a page's message to the part that handles it."""
    try:
        message = json.loads(text)
        take = known.get(str(message.get("type"))) if isinstance(message, dict) else None
        if take is None:
            raise OptionError("unknown message: reload the page")
        take(message)
    except (ImulabError, ValueError, RecursionError) as error:
        reason = str(error) if isinstance(error, ImulabError) else "no JSON: reload the page"
        line.put("refused", to_json({"type": "refused", "text": reason}))


async def _refused(request: Request, error: Exception) -> Response:
    return JSONResponse({"error": str(error)}, 400)

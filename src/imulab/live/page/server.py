"""The server of the page: `imulab live SOURCE --page` and `imulab open` put different parts into the same one.

Addresses: ``/`` the page, ``/static/..`` its files, ``/ws`` the socket, ``/api/..`` those of the parts. What a part is,
and what is said on the socket, is in `parts`.
"""

from __future__ import annotations

import asyncio
import errno
import json
import signal
import socket
import sys
import threading
import webbrowser
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager, suppress
from importlib.resources import files
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from imulab._version import VERSION
from imulab.errors import ImulabError, OptionError
from imulab.live.page.parts import Hub, Line, Message, Part, to_json
from imulab.live.page.security import EVERY, LOCAL, Guard, in_address, new_token

UPLOAD_LIMIT = 4 << 30
"""Bytes of one request, 4 GiB."""
_SOCKET_LIMIT = 1 << 16
_GRACE = 2


def application(token: str, parts: Sequence[Part], *, host: str = LOCAL, limit: int = UPLOAD_LIMIT) -> Starlette:
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
        line = Line()
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
    parts: Sequence[Part],
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
        Of the page.
    port
        To listen at; 0 for a free one.
    host
        Address of this machine to listen at, ``0.0.0.0`` for all; None for the one that only this machine reaches.
    browser
        Whether to open a browser there.
    limit
        Bytes that one request may bring.
    tell
        Takes the line.

    Raises
    ------
    OptionError
        The port is taken, or not permitted, or the address is none of this machine.
    """
    listening = _listen(port, host or LOCAL)
    app = application(new_token(), parts, host=host or LOCAL, limit=limit)
    config = uvicorn.Config(
        app,
        log_level="critical",
        access_log=False,
        ws="websockets-sansio",
        ws_max_size=_SOCKET_LIMIT,
        timeout_graceful_shutdown=_GRACE,
        server_header=False,
    )
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
        for part in parts:  # a second Ctrl-C ends the server before it has done so
            part.end()


@contextmanager
def _end_on_hangup(stop: Callable[[], None]) -> Iterator[None]:
    """End the server as by Ctrl-C where its terminal is closed, so that nothing that it runs is left behind."""
    if sys.platform == "win32" or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGHUP, lambda *_: stop())
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)


def _open(address: str) -> None:
    """Open a browser where there is one; the address has been printed."""
    with suppress(webbrowser.Error, OSError):
        webbrowser.open(address)


def _address_for_others(host: str) -> str:
    """Return the address by which others reach a server that listens at `host`."""
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


async def _write(page: WebSocket, line: Line) -> None:
    with suppress(WebSocketDisconnect, RuntimeError):  # it has gone: the reader finds out, too
        while True:
            for text in await line.get():
                await page.send_text(text)


def _take(text: str, known: Mapping[str, Callable[[Message], object]], line: Line) -> None:
    """Hand a page's message to the part that knows it."""
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

"""Who may speak to the server, what the browser may do with its answers, and which files it reaches.

The server listens on this machine only, unless it is told otherwise. That alone does not keep other pages of the same
browser out, so every request also needs the token of this run, the address as its Host, and this page as its Origin.
"""

from __future__ import annotations

import secrets
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from urllib.parse import parse_qs

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from imulab.errors import OptionError, quoted

TOKEN_HEADER = "x-imulab-token"
LOCAL, EVERY = "127.0.0.1", ("0.0.0.0", "::")
_NAMES = (LOCAL, "localhost")
_HTTP_PORT = 80
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "frame-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Nothing inline, nothing from elsewhere: a file's text that reached the page as HTML would still not run."""
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
    """Return a token that nobody can guess."""
    return secrets.token_urlsafe(24)


def in_address(host: str) -> str:
    """Return a host as it stands in an address: IPv6 in brackets."""
    return f"[{host}]" if ":" in host else host


def _parted(host: str) -> tuple[str, str, str]:
    """Return name, colon and port of the header Host; the colons of IPv6 stand in brackets."""
    name, bracket, rest = host.rpartition("]")
    before, colon, port = rest.partition(":")
    return name + bracket + before, colon, port


class Guard:
    """Lets a request through that comes from the page itself, and puts the policy on every answer.

    Parameters
    ----------
    app
        What is guarded.
    token
        Given in the address of ``/``, which a cookie of its own then stands for; programs give it in the header
        ``X-Imulab-Token``.
    limit
        Bytes that one request may bring.
    once
        Given in the address in place of the token, a single time: other users of the machine see the address that a
        browser is started with.
    host
        The address that is listened at.
    """

    def __init__(self, app: ASGIApp, token: str, limit: int, once: str = "", host: str = LOCAL) -> None:
        self._host = host
        self._app, self._token, self._limit, self._once = app, token, limit, once
        self._key = new_token()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or hand it on."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        answer = self._refusal(scope)
        if answer is not None and scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": ""})
            return

        async def headed(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        if answer is not None:
            await answer(scope, receive, headed)
        else:
            await self._app(scope, self._counted(receive), headed)

    def _refusal(self, scope: Scope) -> Response | None:
        """Return the answer to a request that goes no further; None for the others."""
        headers, port = Headers(scope=scope), scope["server"][1]
        host = headers.get("host", "")
        name, colon, given = _parted(host)
        if not self._is_here(name) or given != ("" if port == _HTTP_PORT and not colon else str(port)):
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
        given = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]
        if scope["type"] == "http" and scope["path"] == "/" and self._opens(given):
            answer = RedirectResponse("/", 303)
            answer.set_cookie(cookie, self._key, httponly=True, samesite="strict", path="/")
            return answer
        if _same(headers.get(TOKEN_HEADER, ""), self._token) or _same(_cookie(headers, cookie), self._key):
            return None
        return PlainTextResponse(_STRANGER, 403)

    def _is_here(self, name: str) -> bool:
        """Whether a name is one of the address that is listened at: a foreign name may lead here, too."""
        if self._host in EVERY and (name.replace(".", "").isdigit() or name.startswith("[")):
            return True
        return name.lower() in (*_NAMES, in_address(self._host).lower())

    def _opens(self, given: str) -> bool:
        """Whether what an address holds lets its browser in."""
        if self._once and _same(given, self._once):
            self._once = ""
            return True
        return _same(given, self._token)

    def _counted(self, receive: Receive) -> Receive:
        """Return `receive` for a body that ends with an error where it is longer than is taken."""
        taken = 0

        async def counted() -> Message:
            nonlocal taken
            message = await receive()
            if message["type"] == "http.request":
                taken += len(message.get("body", b""))
                if taken > self._limit:
                    raise OptionError(f"too large: expected at most {self._limit >> 20} MiB at once")
            return message

        return counted


def _same(one: str, other: str) -> bool:
    return secrets.compare_digest(one.encode("utf-8"), other.encode("utf-8"))


def _cookie(headers: Headers, name: str) -> str:
    try:
        found = SimpleCookie(headers.get("cookie", "")).get(name)
    except CookieError:
        return ""
    return found.value if found else ""


def inside(folder: Path, name: str) -> Path:
    """Return the path of a file right in the session's folder.

    Raises
    ------
    OptionError
        The name leads elsewhere: it is none of a file, has a folder before it, or is a link out of the folder.
    """
    path = folder / name
    plain = name not in ("", ".", "..") and not set(name) & {"/", "\\", "\0", ":"}
    if not plain or path.resolve().parent != folder.resolve():
        raise OptionError(f"{quoted(name)}: expected the name of a file in the session's folder, without a path")
    return path


def report_response(text: str) -> HTMLResponse:
    """Return a report as an answer: a page of its own that cannot reach the session, though it has scripts."""
    return HTMLResponse(text, headers={"content-security-policy": _REPORT_POLICY})


async def receive_file(request: Request, path: Path) -> int:
    """Write the body of a request to a file as it comes, whole or not at all; return its length.

    Raises
    ------
    OptionError
        It is longer than the guard lets through, or cannot be written.
    """
    from imulab.atomic_write import replacing

    size = 0
    with replacing(path) as out:
        async for piece in request.stream():
            out.write(piece)
            size += len(piece)
    return size

"""The server of the page: who gets in, what the browser may do with its answers, and what it reaches of the disk."""

from __future__ import annotations

import asyncio
import http.client
import json
import queue
import re
import socket
import threading
from collections.abc import Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import pytest

pytest.importorskip("starlette", reason="the page needs the extra live")
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse
from starlette.routing import Route
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from benchpage import PATIENCE
from imulab.errors import OptionError
from imulab.live.page import server
from imulab.live.page.server import Guard, Hub, PagePart, TextLine, inside, receive_file, to_json

LIMIT = 1000


def awaited(coroutine: Coroutine[Any, Any, Any]) -> Any:
    """Return its result, from a thread of its own: a browser that other tests have open keeps a loop in this one."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, coroutine).result()


class Echo(PagePart):
    """A part that says again what it hears, and stores what is sent to it."""

    name = "workbench"

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder
        self.routes = [Route("/api/files/{name:path}", self.store, methods=["PUT"])]
        self.handlers = {"say": self.say}

    async def store(self, request: Request) -> JSONResponse:
        size = await receive_file(request, inside(self.folder, request.path_params["name"]))
        return JSONResponse({"size": size})

    def begin(self, hub: Hub) -> None:
        self.hub = hub

    def greet(self) -> list[dict[str, object]]:
        return [{"type": "welcome"}]

    def say(self, message: dict[str, object]) -> None:
        if message.get("text") == "nonsense":
            raise OptionError("text 'nonsense': expected sense")
        self.hub.tell({"type": "said", "text": message.get("text")})


class Answer(NamedTuple):
    status: int
    headers: dict[str, str]
    body: bytes


class Running:
    """A server of its own thread."""

    def __init__(self, folder: Path) -> None:
        self.part, lines = Echo(folder), queue.Queue()
        options = {"browser": False, "limit": LIMIT, "tell": lines.put}
        self.thread = threading.Thread(target=server.serve, args=([self.part],), kwargs=options, daemon=True)
        self.thread.start()
        self.address = lines.get(timeout=PATIENCE)
        self.host, _, rest = self.address.removeprefix("http://").partition("/")
        self.token = rest.removeprefix("?token=")

    def ask(self, path: str, method: str = "GET", body: object = None, **headers: str) -> Answer:
        connection = http.client.HTTPConnection(self.host, timeout=PATIENCE)
        connection.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
        answer = connection.getresponse()
        found = Answer(answer.status, {name.lower(): value for name, value in answer.headers.items()}, answer.read())
        connection.close()
        return found

    @property
    def key(self) -> dict[str, str]:
        return {"x_imulab_token": self.token}

    def socket(self, **headers: str):
        given = {"X-Imulab-Token": self.token} | headers
        return connect(f"ws://{self.host}/ws", additional_headers=given, open_timeout=PATIENCE, proxy=None)


@pytest.fixture
def running(tmp_path) -> Iterator[Running]:
    found = Running(tmp_path)
    yield found
    found.part.hub.stop()
    found.thread.join(PATIENCE)
    assert not found.thread.is_alive()


def test_the_address_leads_to_the_page_and_its_token_into_a_cookie(running):
    assert running.address.startswith("http://127.0.0.1:")
    assert len(running.token) >= 32
    answer = running.ask(f"/?token={running.token}")
    assert (answer.status, answer.headers["location"]) == (303, "/")
    cookie = answer.headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=strict" in cookie
    page = running.ask("/", cookie=cookie.partition(";")[0])
    assert running.token not in cookie
    assert page.status == 200
    assert b'<div id="session"' in page.body
    policy = page.headers["content-security-policy"]
    assert "unsafe" not in policy
    assert "default-src 'none'" in policy
    assert page.headers["x-content-type-options"] == "nosniff"


def test_the_address_that_a_browser_is_started_with_opens_once(tmp_path, monkeypatch):
    """Every user of the machine sees the words that a program was started with."""
    opened: queue.Queue[str] = queue.Queue()
    monkeypatch.setattr("webbrowser.open", opened.put)
    part, lines = Echo(tmp_path), queue.Queue()
    options = {"limit": LIMIT, "tell": lines.put}
    thread = threading.Thread(target=server.serve, args=([part],), kwargs=options, daemon=True)
    thread.start()
    address, words = lines.get(timeout=PATIENCE), opened.get(timeout=PATIENCE)
    host, _, rest = words.removeprefix("http://").partition("/")
    assert address.partition("token=")[2] not in words
    found = []
    for _ in range(2):
        connection = http.client.HTTPConnection(host, timeout=PATIENCE)
        connection.request("GET", f"/{rest}")
        found.append(connection.getresponse().status)
        connection.close()
    assert found == [303, 403]
    part.hub.stop()
    thread.join(PATIENCE)


@pytest.mark.parametrize(("listened", "host", "status"), [
    ("0.0.0.0", "192.168.1.5:8000", 200), ("0.0.0.0", "evil.example:8000", 421), ("box", "BOX:8000", 200),
    ("10.0.0.2", "10.0.0.2:8000", 200), ("10.0.0.2", "10.0.0.3:8000", 421), ("10.0.0.2", "10.0.0.2:1", 421),
    ("::1", "[::1]:8000", 200), ("::1", "[::2]:8000", 421), ("::1", "[::1]:1", 421), ("::1", "::1:8000", 421),
    ("::1", "[::1]", 421), ("::1", "[::1]8000", 421), ("::", "[fe80::5]:8000", 200), ("::", "evil.example:8000", 421),
    ("10.0.0.2", "[::1]:8000", 421), ("::1", "[::1]evil:8000", 421),
])  # fmt: skip
def test_a_page_for_others_still_answers_to_its_own_address_alone(listened, host, status):
    assert guarded(8000, host, listened) == status


@pytest.mark.parametrize(("port", "host", "status"), [
    (80, "127.0.0.1", 200), (80, "localhost", 200), (80, "127.0.0.1:80", 200), (80, "evil.example", 421),
    (8080, "127.0.0.1", 421),
])  # fmt: skip
def test_the_usual_port_may_be_left_out_of_the_host(port, host, status):
    assert guarded(port, host) == status


def guarded(port: int, host: str, listened: str = "127.0.0.1") -> int:
    """Return what the guard answers to a request with the token."""
    sent: list[dict] = []

    async def app(scope, receive, send):
        await PlainTextResponse("in")(scope, receive, send)

    async def receive():
        return {"type": "http.request", "body": b""}

    async def send(message):
        sent.append(message)

    headers = [(b"host", host.encode()), (b"origin", f"http://{host}".encode()), (b"x-imulab-token", b"secret")]
    scope = {"type": "http", "method": "GET", "path": "/x", "query_string": b"", "headers": headers,
             "server": ("127.0.0.1", port)}  # fmt: skip
    awaited(Guard(app, "secret", LIMIT, host=listened)(scope, receive, send))
    return sent[0]["status"]


@pytest.mark.parametrize("path", ["/", "/static/app.js", "/static/plotly.js", "/api/files/x", "/?token=wrong"])
def test_nothing_is_given_without_the_token(running, path):
    answer = running.ask(path)
    assert answer.status == 403
    assert b"token" in answer.body


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"host": "evil.example"}, 421),  # a name that leads here (DNS rebinding)
        ({"host": "127.0.0.1:1"}, 421),
        ({"origin": "http://evil.example"}, 403),
        ({"origin": "null"}, 403),
        ({"sec_fetch_site": "cross-site"}, 403),
        ({"sec_fetch_site": "same-site"}, 403),  # a page of another port of this machine
    ],
)
def test_another_page_is_refused_though_it_has_the_token(running, headers, status):
    assert running.ask("/static/app.js", **running.key, **headers).status == status


def test_the_socket_is_behind_the_same_guard(running):
    for headers in ({"X-Imulab-Token": "wrong"}, {"Origin": "http://evil.example"}):
        with pytest.raises((InvalidStatus, ConnectionClosed)), running.socket(**headers) as page:
            page.recv(timeout=PATIENCE)


def test_static_files_come_with_their_kind_and_from_their_folder_alone(running):
    for name, kind in [
        ("app.js", "javascript"),
        ("page.css", "css"),
        ("report.css", "css"),
        ("plotly.js", "javascript"),
    ]:
        answer = running.ask(f"/static/{name}", **running.key)
        assert answer.status == 200
        assert kind in answer.headers["content-type"]
    for name in ("../server.py", "..%2fserver.py", "%2e%2e/server.py", "/etc/passwd", "..\\server.py"):
        assert running.ask(f"/static/{name}", **running.key).status == 404


def test_no_script_of_the_page_looks_behind_which_older_safaris_do_not_read():
    scripts = [*Path(server.__file__).parent.rglob("*.js")]
    assert any(script.name == "dom.js" for script in scripts)
    assert [script.name for script in scripts if re.search(r"\(\?<[=!]", script.read_text("utf-8"))] == []


def test_messages_reach_the_part_and_every_page(running):
    with running.socket() as one, running.socket(Origin=f"http://{running.host}") as other:
        for page in (one, other):
            assert json.loads(page.recv(timeout=PATIENCE)) == {
                "type": "hello", "areas": ["workbench"], "version": server.VERSION,
            }  # fmt: skip
            assert json.loads(page.recv(timeout=PATIENCE)) == {"type": "welcome"}
        one.send('{"type": "say", "text": "<b>µ</b>"}')
        assert [json.loads(page.recv(timeout=PATIENCE))["text"] for page in (one, other)] == ["<b>µ</b>"] * 2


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"type": "say", "text": "nonsense"}', "expected sense"),
        ('{"type": "unheard of"}', "unknown message"),
        ('{"type": ["say"]}', "unknown message"),
        ("[]", "unknown message"),
        ("{", "no JSON"),
        ("[" * 60_000, "no JSON"),
    ],
)
def test_a_message_that_cannot_be_done_is_answered_by_a_sentence(running, text, said):
    with running.socket() as page:
        page.recv(timeout=PATIENCE), page.recv(timeout=PATIENCE)
        page.send(text)
        answer = json.loads(page.recv(timeout=PATIENCE))
        assert answer["type"] == "refused"
        assert said in answer["text"]
        page.send('{"type": "say", "text": "still there"}')
        assert json.loads(page.recv(timeout=PATIENCE))["text"] == "still there"


def test_an_upload_lands_in_the_folder_within_the_limit(running, tmp_path):
    def put(name: str, body: object) -> Answer:
        return running.ask(f"/api/files/{name}", "PUT", body, **running.key)

    assert put("rec.csv", b"x" * LIMIT).status == 200
    assert put("long.csv", b"x" * (LIMIT + 1)).status == 413
    answer = put("long.csv", iter([b"x" * 600, b"x" * 600]))
    assert answer.status == 400
    assert "too large" in json.loads(answer.body)["error"]
    for name in ("..%2fout.csv", "%2e%2e%2fout.csv", "a%2fb.csv", "a%5cb.csv", "C:x.csv", "%00.csv", ".."):
        assert put(name, b"x").status in (400, 404)
    assert [path.name for path in tmp_path.iterdir()] == ["rec.csv"]
    assert not (tmp_path.parent / "out.csv").exists()


def test_a_link_out_of_the_folder_leads_nowhere(tmp_path):
    folder = tmp_path / "session"
    folder.mkdir()
    (tmp_path / "secret").write_text("x")
    (folder / "link.csv").symlink_to(tmp_path / "secret")
    with pytest.raises(OptionError, match="expected the name of a file in the session's folder"):
        inside(folder, "link.csv")
    assert inside(folder, "rec.csv") == folder / "rec.csv"


def test_a_slow_page_gets_the_latest_view_and_every_word():
    line = TextLine()
    for number in range(5):
        line.put("view", f"view {number}", latest=True)
        line.put("event", f"event {number}")
    assert awaited(line.get()) == [*(f"event {k}" for k in range(4)), "view 4", "event 4"]


def test_numbers_that_are_none_are_null():
    assert to_json({"type": "x", "a": float("inf"), "b": (1.5, float("nan"))}) == '{"type":"x","a":null,"b":[1.5,null]}'


def test_a_page_for_others_tells_an_address_that_they_reach():
    listening = server._listen(0, "0.0.0.0")
    address = server._address_for_others("0.0.0.0"), listening.getsockname()[1]
    with socket.create_connection(address, timeout=PATIENCE):
        pass
    listening.close()
    assert server._address_for_others("10.1.2.3") == "10.1.2.3"
    with pytest.raises(OptionError, match=r"--host 192\.0\.2\.7: cannot be listened at"):
        server.serve([], host="192.0.2.7", browser=False)


@pytest.mark.parametrize("host", ["::1", "::"])
def test_a_page_listens_at_addresses_of_version_six(host):
    try:
        listening = server._listen(0, host)
    except OptionError:
        pytest.skip("this machine has no IPv6")
    address = server._address_for_others(host)
    assert address[0] + address[-1] == "[]"
    with socket.create_connection((address[1:-1], listening.getsockname()[1]), timeout=PATIENCE):
        pass
    listening.close()


def test_a_port_that_is_taken_is_one_sentence():
    taken = server._listen(0)
    number = taken.getsockname()[1]
    with pytest.raises(OptionError, match=f"--port {number}: cannot be listened at: .*; 0 takes a free one"):
        server.serve([], number, browser=False)
    taken.close()


def test_half_requests_are_closed_and_whole_ones_are_not(running, monkeypatch):
    monkeypatch.setattr(server, "_HEAD", 2.0)
    monkeypatch.setattr(server, "_STALLED", 2.0)
    host, _, port = running.host.partition(":")
    begun = f"GET / HTTP/1.1\r\nHost: {running.host}\r\n"
    body = f"PUT /api/files/half HTTP/1.1\r\nHost: {running.host}\r\nX-Imulab-Token: {running.token}\r\n"
    halves = ["", "GET", begun, f"{begun}\r\n{begun}", f"{body}Content-Length: 100\r\n\r\nsome"]
    links = [socket.create_connection((host, int(port)), timeout=PATIENCE) for _ in halves]
    with running.socket() as page:  # a page that says nothing stays
        for link, half in zip(links, halves, strict=True):
            link.sendall(half.encode())
        for link in links:
            while link.recv(1 << 16):
                pass
            link.close()
        page.send('{"type": "say", "text": "still here"}')
        while "still here" not in page.recv(timeout=PATIENCE):
            pass
    assert running.ask("/", **running.key).status == 200
    assert not (running.part.folder / "half").exists()

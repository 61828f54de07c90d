"""The workbench: files that are dropped on the page, their curves, and the commands that are run on them.

Addresses, below ``/api/workbench``: ``files`` (GET; PUT, GET and DELETE of one), ``zip`` (a folder), ``reports`` (one
that a command of this session has drawn), ``forms``, ``open`` and ``curves`` of a recording, ``command`` (what a form
would run), ``jobs`` (POST runs it, DELETE cancels it), ``results`` (GET: what to see first of one; DELETE: forget it,
or all that have ended), ``statistics`` of a range, ``layouts`` that come with imulab, and ``columns`` of a file, as far
as known, or the layout of those that were stated. Messages to pages: ``files``, ``opening``, ``job``, ``cleared``.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from filecmp import cmp
from itertools import count, takewhile
from pathlib import Path
from shlex import join
from typing import IO, Any, BinaryIO, ClassVar
from urllib.parse import quote

from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, Response, StreamingResponse
from starlette.routing import Route

from imulab.errors import OptionError, quoted
from imulab.files import confined, open_file, write_text
from imulab.live.page.files import FolderFiles, Opening, Openings, checked
from imulab.live.page.jobs import Form, Jobs, PageJob
from imulab.live.page.results import result_of
from imulab.live.page.server import Hub, Message, PagePart, receive_file, report_response, to_json
from imulab.options import options_of
from imulab.recording import Reading

_WIDEST = 4000  # pixels of a drawing that a page asks for
_LONGEST = 1 << 20
"""Largest JSON object, bytes."""
_READING = tuple(option.name for option in options_of(Reading))
_HERE = "/api/workbench"
_ANY = "application/octet-stream"
_FEW = 2  # inputs that give an output the name of the last
_PATIENCE = 20  # s for the columns of a file
_PIECE = 1 << 20  # bytes sent in one piece


class Workbench(PagePart):
    """The part of the page where recordings become records.

    Parameters
    ----------
    files
        Files of the session.
    forms
        Forms of the offered commands.
    """

    name: ClassVar[str] = "workbench"

    def __init__(self, files: FolderFiles, forms: Mapping[str, Form]) -> None:
        super().__init__()
        self._files, self._forms = files, forms
        self._hub = Hub()
        self._jobs, self._openings = Jobs(self._tell_job), Openings(self._tell_opening)
        self._coming: set[str] = set()
        self._dropped: set[str] = set()  # may be replaced: whoever dropped one has it
        self._lists = count()
        self._describing = asyncio.Semaphore(1)  # a process of its own tells the columns of a file
        shown = to_json([form.shown for form in forms.values()])
        self.routes = [
            Route(f"{_HERE}/files", self._list),
            Route(f"{_HERE}/files/{{name:path}}", self._receive, methods=["PUT"]),
            Route(f"{_HERE}/files/{{name:path}}", self._remove, methods=["DELETE"]),
            Route(f"{_HERE}/files/{{name:path}}", self._send),
            Route(f"{_HERE}/zip/{{name:path}}", self._zip),
            Route(f"{_HERE}/reports/{{name:path}}", self._report),
            Route(f"{_HERE}/forms", lambda request: Response(shown, media_type="application/json")),
            Route(f"{_HERE}/open", self._open, methods=["POST"]),
            Route(f"{_HERE}/curves", self._curves),
            Route(f"{_HERE}/statistics", self._statistics),
            Route(f"{_HERE}/layouts", self._layouts),
            Route(f"{_HERE}/columns", self._columns, methods=["POST"]),
            Route(f"{_HERE}/results/{{number:int}}", self._result),
            Route(f"{_HERE}/results/{{number:int}}", self._clear, methods=["DELETE"]),
            Route(f"{_HERE}/results", self._clear, methods=["DELETE"]),
            Route(f"{_HERE}/command", self._command, methods=["POST"]),
            Route(f"{_HERE}/jobs", self._run, methods=["POST"]),
            Route(f"{_HERE}/jobs/{{number:int}}", self._cancel, methods=["DELETE"]),
        ]

    def begin(self, hub: Hub) -> None:
        """Start to send messages, and to read the recording that pages show first."""
        self._hub = hub
        first = next((entry.name for entry in self._files.entries() if entry.kind == "recording"), None)
        if first is not None and self._files.is_given(first):
            self._openings.open(first, {}, self._files.readable)

    def greet(self) -> Iterable[Message]:
        """Yield the files and the commands that were run."""
        yield self._list_message()
        for job in list(self._jobs.jobs.values()):
            yield _job_message(job)

    def end(self) -> None:
        """End running commands, and remove temporary files."""
        self._jobs.end()
        self._openings.end()

    def _list_message(self) -> Message:
        """Return the list of files, numbered, because an answer and a message can reach a page in the other order."""
        number = next(self._lists)
        return {"type": "files", "number": number, "folder": str(self._files.folder), "files": self._files.entries()}

    def _tell_job(self, job: PageJob) -> None:
        if job.ended is not None:  # first what it made
            self._hub.tell(self._list_message())
        self._hub.tell(_job_message(job))

    def _tell_opening(self, opening: Opening) -> None:
        self._hub.tell(_opening_message(opening))

    async def _list(self, request: Request) -> Response:
        return _json(self._list_message())

    async def _receive(self, request: Request) -> Response:
        """Take a dropped file; it replaces one that was dropped before and that no command reads now."""
        jobs = self._jobs.jobs.values()
        used = {path for job in jobs for path in job.outputs}  # a report is one that was drawn
        busy = self._coming | used | {path for job in jobs if job.is_open for path in job.inputs}
        former = str(checked(self._files.folder, request.path_params["name"]))
        replaces = former in self._dropped - busy and Path(former).is_file()
        name = former if replaces else self._files.unused(request.path_params["name"], self._coming | used)
        self._coming.add(name)
        place = Path(name).with_name(f".{Path(name).name}") if replaces else Path(name)
        try:
            await receive_file(request, place)
            replaces = replaces and not await run_in_threadpool(cmp, place, name, shallow=False)
            if replaces:
                place.replace(name)
                self._jobs.mark_replaced(name)
        finally:
            self._coming.discard(name)
            if place.name != Path(name).name:
                place.unlink(missing_ok=True)
        self._dropped.add(name)
        self._hub.tell(self._list_message())
        return _json({"name": name, "replaced": replaces})

    async def _remove(self, request: Request) -> Response:
        name = self._files.path(request.path_params["name"])
        path = Path(name)
        if not self._files.owns(name) or not path.is_file():
            raise OptionError(f"{name}: is not in the session's folder")
        path.unlink()
        self._dropped.discard(name)
        self._hub.tell(self._list_message())
        return _json({})

    async def _send(self, request: Request) -> Response:
        name = self._files.path(request.path_params["name"])
        if Path(name).is_dir():
            raise OptionError(f"{name}: is a folder")
        stream = self._opened(name)  # it is closed once it is sent
        size = os.fstat(stream.fileno()).st_size  # a recording that is still written grows meanwhile
        headers = {**_download_header(Path(name).name), "content-length": str(size)}
        return StreamingResponse(_pieces(stream, size), headers=headers, media_type=_ANY)

    async def _zip(self, request: Request) -> Response:
        name = self._files.path(request.path_params["name"])
        if not Path(name).is_dir():
            raise OptionError(f"{name}: expected a folder")
        packed = await run_in_threadpool(_pack, Path(name), self._files.readable, self._openings.place)
        task = BackgroundTask(Path(packed).unlink, missing_ok=True)
        return FileResponse(
            packed, headers=_download_header(f"{Path(name).name}.zip"), media_type=_ANY, background=task
        )

    async def _report(self, request: Request) -> Response:
        """Return a report that a command of this session has made; other pages can only be saved."""
        name = self._files.path(request.path_params["name"])
        drawn = {path for job in self._jobs.jobs.values() if job.state == "done" for path in job.outputs}
        if name not in drawn or not name.endswith(".html"):
            raise OptionError(f"{name}: no report of this session; save it to look at it")
        with self._opened(name) as stream:
            return report_response(stream.read().decode("utf-8"))

    def _opened(self, name: str) -> BinaryIO:
        """Return an open file of the session; a link that was put in its place in the meantime leads nowhere."""
        try:
            return open_file(name, self._files.readable)
        except OSError as error:
            raise OptionError(f"{name}: cannot be read: {error.strerror}") from None

    async def _open(self, request: Request) -> Response:
        asked = await _object(request)
        reading = asked.get("reading") or {}
        if not isinstance(reading, dict) or not all(
            key in _READING and isinstance(text, str) for key, text in reading.items()
        ):
            raise OptionError(f"reading: expected texts for {' '.join(_READING)}")
        name = self._files.path(str(asked.get("file")))
        layout = reading.get("layout", "")
        if layout not in self._openings.previews and (set(layout) & {"/", "\\"} or Path(layout or "\0").exists()):
            reading = {**reading, "layout": self._files.path(layout)}
        return _json(_opening_message(self._openings.open(name, reading, self._files.readable)))

    async def _columns(self, request: Request) -> Response:
        """Return what is known of the columns of a file; or write the layout of columns that were stated.

        With a ``name`` it is a file of the session, else one for a preview.
        """
        asked = await _object(request)
        name, stated = self._files.path(str(asked.get("file"))), _stated(asked.get("columns"), asked.get("sample_rate"))
        async with self._describing:
            answer = await run_in_threadpool(_columns_of, name, stated, self._files.readable)
        if stated is None:
            return _json(answer)
        if not (saved := asked.get("name")):
            return _json({"layout": self._openings.new_layout(answer["toml"]), **answer})
        path = self._files.unused(str(saved).removesuffix(".toml") + ".toml", self._coming)
        write_text(path, answer["toml"])
        self._hub.tell(self._list_message())
        return _json({"layout": path, **answer})

    async def _layouts(self, request: Request) -> Response:
        from imulab.readers.shipped import shipped

        return _json([{"name": each.name, "about": each.about, "sensors": each.sensors} for each in shipped()])

    async def _result(self, request: Request) -> Response:
        job = self._jobs.jobs.get(request.path_params["number"])
        done = job is not None and job.state == "done"
        return _json(await run_in_threadpool(result_of, job.outputs) if job and done else {})

    async def _clear(self, request: Request) -> Response:
        self._hub.tell({"type": "cleared", "numbers": self._jobs.forget(request.path_params.get("number"))})
        return _json({})

    async def _statistics(self, request: Request) -> Response:
        query = request.query_params
        start, stop, number = (_number(query.get(key), key) for key in ("from", "to", "opening"))
        opening = self._openings.known(int(number or 0))
        return _json(await run_in_threadpool(self._openings.statistics, opening, start, stop))

    async def _curves(self, request: Request) -> Response:
        query = request.query_params
        start, stop, width, number = (_number(query.get(key), key) for key in ("from", "to", "width", "opening"))
        opening = self._openings.known(int(number or 0))
        shown = await run_in_threadpool(
            self._openings.view, opening, start, stop, int(min(max(width or 1000, 10), _WIDEST))
        )
        return _json({key: value for key, value in asdict(shown).items() if key != "rows"})

    def _fill_form(self, asked: Mapping[str, Any]) -> tuple[Form, list[str], list[str], list[str]]:
        """Return the form, the words, the outputs and the files that go in, for the values of a page."""
        form = self._forms.get(str(asked.get("command")))
        values = asked.get("values")
        if form is None or not isinstance(values, dict):
            raise OptionError(f"command {quoted(asked.get('command'))}: not among those offered")
        inputs = [Path(each) for field in form.fields if not field.flag for each in _listed(values.get(field.name))]
        outputs: list[str] = []
        used: list[str] = []
        running = {path for job in self._jobs.jobs.values() if job.is_open for path in job.outputs}
        taken = running | self._coming

        def output(name: str, ending: str) -> str:
            """Return a name from the last file, with the command's where the ending alone would not tell them apart."""
            stem = _stem(inputs, self._files.folder) if inputs else form.path.replace(" ", "-")
            done = str(values.get("to") or form.path.split()[-1].lstrip("-"))
            default_name = (
                f"{stem}-{done}{ending}"
                if inputs and ending in ("", *(each.suffix for each in inputs))
                else f"{stem}{ending}"
            )
            outputs.append(
                self._files.new(name, taken.union(outputs))
                if name
                else self._files.unused(default_name, taken.union(outputs))
            )
            return outputs[-1]

        def file(name: str) -> str:
            used.append(path := self._files.path(name))
            return path

        words = form.words(values, file, output)
        return form, words, outputs, used

    async def _command(self, request: Request) -> Response:
        asked = await _object(request)
        form, words, outputs, _ = self._fill_form(asked)
        return _json({"command": join(["imulab", *words]), "outputs": outputs, "wrong": form.wrong(asked["values"])})

    async def _run(self, request: Request) -> Response:
        form, words, outputs, used = self._fill_form(await _object(request))
        job = self._jobs.run(form.path, words, outputs, self._files.within(words), used)
        self._dropped.difference_update(outputs)
        return _json(_job_message(job))

    async def _cancel(self, request: Request) -> Response:
        await run_in_threadpool(self._jobs.cancel, request.path_params["number"])
        return _json({})


def _listed(value: Any) -> list[str]:
    return [str(each) for each in (value if isinstance(value, list) else [value]) if each]


def _stem(inputs: list[Path], folder: Path) -> str:
    """Return the name that outputs have from their inputs: the last one's, or what many have in common."""
    last = inputs[-1].name.partition(".")[0]
    if len(inputs) <= _FEW:
        return last
    if len(folders := {each.parent for each in inputs}) == 1 and (common := folders.pop()).parent == folder:
        return common.name
    alike = takewhile(lambda letters: len(set(letters)) == 1, zip(*(each.name for each in inputs), strict=False))
    return "".join(letters[0] for letters in alike).partition(".")[0].rstrip("0123456789_-+ ") or last


def _stated(columns: Any, sample_rate: Any) -> dict[str, Any] | None:
    """Return checked statements on columns, None where there are none."""
    if columns is None:
        return None
    if not isinstance(columns, list) or not all(
        isinstance(each, list) and list(map(type, each)) == [int, str, str] for each in columns
    ):
        raise OptionError("columns: expected [place, name, unit] for each")
    return {"columns": columns, "sample_rate": str(sample_rate or "")[:100]}


def _columns_of(name: str, stated: dict[str, Any] | None, within: list[str]) -> dict[str, Any]:
    """Return what a process of its own says of the columns of a file."""
    words = [sys.executable, "-P", "-m", "imulab.live.page.columns", name]
    try:
        ran = subprocess.run(
            [*words, json.dumps(stated)] if stated else words,
            stdin=subprocess.DEVNULL, capture_output=True, text=True, encoding="utf-8", env=confined(within),
            timeout=_PATIENCE, check=False,
        )  # fmt: skip
        answer: dict[str, Any] = json.loads(ran.stdout)
    except (subprocess.TimeoutExpired, ValueError):
        answer = {"error": f"{name}: its columns cannot be told"}
    if "error" in answer:
        raise OptionError(answer["error"])
    return answer


def _json(value: Any) -> Response:
    return Response(to_json(value), media_type="application/json")


def _job_message(job: PageJob) -> Message:
    there = [path for path in job.outputs if os.path.lexists(path)] if job.ended is not None else []
    return {"type": "job", **asdict(job), "within": None, "outputs": there}


def _opening_message(opening: Opening) -> Message:
    identity = {"file": opening.name, "reading": opening.reading, "opening": opening.number}
    return {"type": "opening", **identity, **opening.about}


def _number(text: str | None, key: str) -> float | None:
    if not text:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise OptionError(f"{key} {quoted(text)}: expected a number")
    return value


async def _object(request: Request) -> dict[str, Any]:
    text = bytearray()
    async for piece in request.stream():
        text += piece
        if len(text) > _LONGEST:
            raise OptionError(f"expected a JSON object of at most {_LONGEST >> 10} KiB")
    try:
        document = json.loads(text)
    except (ValueError, RecursionError):
        document = None
    if not isinstance(document, dict):
        raise OptionError("expected a JSON object")
    return document


def _download_header(name: str) -> dict[str, str]:
    """Return the header of a file that the browser saves, whatever type it has."""
    return {"content-disposition": f"attachment; filename*=UTF-8''{quote(name, safe='')}"}


def _pieces(stream: IO[bytes], size: int) -> Iterator[bytes]:
    """Yield the first bytes of a file, then close it."""
    with stream:
        while size and (piece := stream.read(min(size, _PIECE))):
            size -= len(piece)
            yield piece


def _pack(folder: Path, roots: list[str], place: Path) -> str:
    """Return a new archive in `place` with the files of a folder, and of the session: no link leads elsewhere."""
    handle, name = tempfile.mkstemp(suffix=".zip", dir=place)
    with os.fdopen(handle, "wb") as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and not path.is_symlink():
                entry = zipfile.ZipInfo.from_file(path, path.relative_to(folder.parent))
                entry.compress_type = zipfile.ZIP_DEFLATED
                with open_file(path, roots) as source, archive.open(entry, "w") as target:
                    shutil.copyfileobj(source, target, 1 << 20)
    return name

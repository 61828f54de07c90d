"""Commands that the page runs, each in its own process, and the forms that are made from their definitions."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from itertools import count
from pathlib import Path
from time import time
from typing import IO, Any

from imulab.errors import ImulabError, OptionError, listed, quoted
from imulab.files import confined
from imulab.options import Option

# Forms, made from the definitions of the command line.


_FILE = re.compile(r"FILE|RECORD|[A-Z]+\.[a-z]+")
_LONGEST_TEXT = 10_000  # characters of a field


@dataclass(frozen=True)
class FormField:
    """One parameter of a command.

    Attributes
    ----------
    name
        Name in the values of a form.
    flag
        Flag as typed; empty for an argument. `unflag` turns off a switch that has no default.
    kind
        ``file`` or ``files`` of the session, ``output``, ``switch``, ``either`` (on, off or neither), ``text``, or
        ``texts``: any number of them, with the option once for each.
    shows
        Placeholder of the value in the help.
    help
        Help of the command's option.
    default
        Text of the default.
    choices
        Allowed words.
    other
        Whether other texts are allowed too.
    required
        Whether it must be filled.
    group
        Group on the page; empty for an argument.
    ending
        Ending of an output's name; empty for a folder.
    """

    name: str
    flag: str
    kind: str
    shows: str
    help: str
    default: str
    choices: tuple[str, ...] = ()
    other: bool = True
    required: bool = False
    group: str = ""
    ending: str = ""
    unflag: str = ""


@dataclass(frozen=True)
class Form:
    """A command: its path (``tumble fit``), its line in the list of commands, its help, and its fields in order."""

    path: str
    summary: str
    help: str
    fields: tuple[FormField, ...]
    options: Mapping[str, Option] = dataclass_field(default_factory=dict, repr=False)

    @property
    def shown(self) -> dict[str, Any]:
        """What a page is told of it."""
        return {key: getattr(self, key) for key in ("path", "summary", "help", "fields")}

    def wrong(self, values: Mapping[str, Any]) -> dict[str, str]:
        """Return a sentence for each text that its option does not take, by the names of fields."""
        refusals: dict[str, str] = {}
        for field in self.fields:
            option, text = self.options.get(field.name), values.get(field.name)
            if option is None or field.kind != "text" or not isinstance(text, str) or not text.strip():
                continue
            try:
                option.value(text.strip(), option.name.replace("_", " "))
            except ImulabError as error:
                refusals[field.name] = str(error)
        refusals |= _wrong_gravity(
            {f.name: str(values.get(f.name) or "").strip() for f in self.fields if f.group == "gravity"}
        )
        return refusals

    def words(
        self, values: Mapping[str, Any], file: Callable[[str], str], output: Callable[[str, str], str]
    ) -> list[str]:
        """Return the words of the command line for these values.

        Parameters
        ----------
        values
            Values by the names of fields: a text, a list of texts for files and texts, or a truth value, which asks for
            an output under a new name. Empty ones count as not filled.
        file
            Returns the command line's path of a file of the session.
        output
            Returns the path of an output from its name (empty for a new name) and its ending.

        Raises
        ------
        OptionError
            A value is not allowed in its field, or a required one is missing.
        """
        fields = {field.name: field for field in self.fields}
        for name in values:
            if name not in fields:
                raise OptionError(f"{self.path}: no field {quoted(name)}; expected {listed(fields, name)}")
        words = self.path.split()
        for field in sorted(self.fields, key=lambda field: bool(field.flag)):
            words += _words(field, values.get(field.name), file, output)
        return words


def _wrong_gravity(typed: Mapping[str, str]) -> dict[str, str]:
    """Return why gravity, latitude and height, as typed, state none, at the one that the sentence begins with."""
    from imulab.gravity import gravity_option, of_place

    gravity, latitude, height, place = (typed.get(name) or None for name in ("gravity", "latitude", "height", "place"))
    try:
        gravity_option(gravity, *of_place(place, gravity, latitude, height), "{}", beside=True)
    except ImulabError as error:
        text = str(error)
        return {next((name for name in typed if text.startswith(name)), "gravity"): text}
    return {}


def forms(commands: Iterable[Any]) -> dict[str, Form]:
    """Return the forms of commands of the command line, by their paths."""
    all_commands = {command.path: command for command in commands}
    return {path: _form(command, all_commands) for path, command in all_commands.items()}


def _form(command: Any, all_commands: Container[str]) -> Form:
    """Return the form of a command; a switch that makes another command of it is that command's form."""
    name = " ".join(command.name)
    drawn = any(option.keyword == "report" for option in command.options)
    arguments = [
        FormField(each.keyword, "", "files" if each.many else "file", each.shows, "", "", (), False, each.required)
        for each in command.arguments
    ]
    options = [
        _field(option, drawn=drawn) for option in command.options if f"{name} {option.flags[-1]}" not in all_commands
    ]
    known = {option.keyword: option for option in command.options}
    text = " ".join(command.help.split())
    return Form(command.path, command.summary.rstrip("."), text, (*arguments, *options), known)


def _field(option: Option, *, drawn: bool) -> FormField:
    """Return the field of an option; `drawn` says that the command writes a report beside its output, a record."""
    shows, text = option.shows if option.takes_value else "", f"{option.help} [{option.unit}]" * bool(option.unit)
    field = FormField(option.keyword, option.flags[-1], option.kind, shows, text or option.help, "", group=option.group)
    field = replace(field, required=option.required)
    if "-o" in option.flags or field.flag == "--report":
        return replace(field, flag=option.flags[0], kind="output", ending=_ending(shows, drawn=drawn))
    if not option.takes_value:
        return replace(field, unflag=option.opposite)
    alternatives = [part for part in shows.split("|") if part]
    files = [part for part in alternatives if _FILE.fullmatch(part)]
    field = replace(field, default=option.default or "", choices=option.words)
    if files:
        return replace(field, kind="file", other=len(files) < len(alternatives))
    if option.kind == "texts" and shows.startswith("FILE"):  # from a form, each in its own layout
        return replace(field, kind="files", other=False)
    return replace(field, other=not option.words or {*alternatives} != {*option.words})


def _ending(shows: str, *, drawn: bool) -> str:
    if "." in shows:
        return "." + shows.rpartition(".")[2].lower()
    if shows == "DIR":
        return ""
    return ".json" if drawn else ".csv"


def _words(field: FormField, value: Any, file: Callable[[str], str], output: Callable[[str, str], str]) -> list[str]:
    called = field.flag or field.shows or field.name
    if field.kind == "switch" or field.kind == "either":
        if not isinstance(value, bool | None):
            raise OptionError(f"{called}: expected yes or no, found {quoted(value)}")
        return [field.flag] if value else [field.unflag] if value is False and field.unflag else []
    named = field.kind == "output" and value is True
    texts = [] if named else [text for text in _texts(value, called) if text.strip()]
    if field.kind == "output":
        if not (named or texts or field.required):
            return []
        return [field.flag, output(texts[0] if texts else "", field.ending)]
    if not texts:
        if field.required:
            raise OptionError(f"{called}: expected {'a file' if 'file' in field.kind else 'a value'}")
        return []
    if field.kind == "files":
        return [word for text in texts for word in (_option(field.flag, file(text)) if field.flag else [file(text)])]
    if field.kind == "texts":
        return [word for text in texts for word in _option(field.flag, text.strip())]
    (text,) = texts[:1]
    if field.kind == "file":
        text = _file_or_word(field, text, file)
    elif field.choices and not field.other and text not in field.choices:
        raise OptionError(f"{called} {quoted(text)}: expected one of {listed(field.choices, text)}")
    if not field.flag:
        return [text]
    return [] if text == field.default else _option(field.flag, text)


def _file_or_word(field: FormField, text: str, file: Callable[[str], str]) -> str:
    """Return the command line's path of a file of the session, or a word that names no other file."""
    try:
        return file(text)
    except OptionError:
        if not field.other or set(text) & {"/", "\\"} or Path(text).exists():
            raise
        return text


def _option(flag: str, text: str) -> list[str]:
    return [f"{flag}={text}"] if text.startswith("-") else [flag, text]


def _texts(value: Any, called: str) -> Sequence[str]:
    texts = [] if value is None else value if isinstance(value, list) else [value]
    for text in texts:
        if not isinstance(text, str) or "\0" in text or len(text) > _LONGEST_TEXT:
            raise OptionError(f"{called}: expected a text, found {quoted(text)}")
    return texts


# Jobs: each command runs in its own process, as if typed.


# Most bytes of output, lines, and characters of a line, that are kept of a job
_LONGEST, _MOST_LINES, _LONGEST_LINE = 1 << 20, 1000, 4000
_GRACE, _EVERY = 5.0, 0.1  # s for a process to end before it is killed; s between two messages
_WINDOWS = sys.platform == "win32"


@dataclass
class PageJob:
    """One command that was run.

    Attributes
    ----------
    number
        Number in this session, from 1.
    path
        Path of the command: ``tumble fit``.
    command
        The command to type, quoted for a shell.
    words
        Its words without quotes, and without the program's name.
    outputs, inputs
        Paths of its outputs, and of the files that it was given.
    replaced
        Those files, at first or second hand, that have been replaced since.
    state
        ``waiting``, ``running``, ``done``, ``refused`` (exit status 2, or 1 of a test that failed), ``cancelled``.
    messages, text
        Lines of standard error, and standard output.
    began, ended
        Seconds since 1970; it begins when it no longer waits.
    within
        Folders and files that it may read; None for all.
    """

    number: int
    path: str
    command: str
    words: list[str]
    outputs: list[str]
    state: str = "waiting"
    status: int | None = None
    messages: list[str] = dataclass_field(default_factory=list)
    text: str = ""
    began: float = dataclass_field(default_factory=time)
    ended: float | None = None
    within: list[str] | None = None
    inputs: list[str] = dataclass_field(default_factory=list)
    replaced: list[str] = dataclass_field(default_factory=list)

    @property
    def is_open(self) -> bool:
        """Whether it runs or waits."""
        return self.state in ("waiting", "running")


class Jobs:
    """The commands of a session, `most` at a time; `tell` is called with every change, from other threads."""

    def __init__(self, tell: Callable[[PageJob], object], most: int | None = None) -> None:
        self.jobs: dict[int, PageJob] = {}
        self._tell, self._most = tell, most or _cores()
        self._lock = threading.RLock()
        self._processes: dict[int, subprocess.Popen[str]] = {}
        self._watches: dict[int, threading.Thread] = {}
        self._due: set[int] = set()
        self._numbers = count(1)

    def run(
        self,
        path: str,
        words: Sequence[str],
        outputs: Sequence[str],
        within: Sequence[str] | None = None,
        inputs: Sequence[str] = (),
    ) -> PageJob:
        """Start a command in the working folder, or let it wait while as many run as may; return its job.

        `within` names the folders and files that it may read, None for all; `inputs` are the files that it was given.

        Raises
        ------
        OptionError
            It cannot be started.
        """
        roots = None if within is None else [os.path.realpath(root) for root in within]
        with self._lock:
            number = next(self._numbers)
            command = shlex.join(["imulab", *words])
            job = PageJob(number, path, command, list(words), list(outputs), within=roots, inputs=list(inputs))
            if len(self._processes) < self._most:
                self._begin(job)
            self.jobs[number] = job
        self._tell(job)
        return job

    def _begin(self, job: PageJob) -> None:
        process = self._processes[job.number] = _start(job)
        job.state, job.began = "running", time()
        watch = self._watches[job.number] = threading.Thread(target=self._watch, args=(job, process), daemon=True)
        watch.start()

    def _begin_next(self) -> None:
        """Start the jobs that waited longest, as many as may run."""
        with self._lock:
            for job in [job for job in self.jobs.values() if job.state == "waiting"]:
                if len(self._processes) >= self._most:
                    return
                try:
                    self._begin(job)
                except OptionError as error:
                    job.state, job.status, job.messages, job.ended = "refused", 2, [f"imulab: {error}"], time()
                self._tell(job)

    def cancel(self, number: int) -> None:
        """End a command and remove its unfinished outputs."""
        with self._lock:
            job, process = self.jobs.get(number), self._processes.get(number)
            if job is None or not job.is_open:
                return
            job.state = "cancelled"
        if process is None:  # it waited
            job.ended = time()
            self._tell(job)
            return
        _signal(process, signal.SIGTERM)
        try:
            process.wait(_GRACE)
        except subprocess.TimeoutExpired:
            _signal(process, signal.SIGTERM if _WINDOWS else signal.SIGKILL)
        self._watches[number].join(_GRACE)

    def forget(self, number: int | None = None) -> list[int]:
        """Forget what has ended, or one of it; return the numbers. What it made stays."""
        with self._lock:
            ended = [each for each, job in self.jobs.items() if not job.is_open and number in (None, each)]
            for each in ended:
                del self.jobs[each]
        return ended

    def mark_replaced(self, name: str) -> None:
        """Note in each job that has used a file, or what another made of it, that the file has been replaced."""
        former = {name}
        for job in list(self.jobs.values()):  # in the order in which they were asked for
            if former.intersection(job.inputs) or any(_mentions(each, name) for each in job.inputs):
                job.replaced = list(dict.fromkeys([*job.replaced, name]))
                former.update(job.outputs)
                self._tell(job)

    def end(self) -> None:
        """End all commands, those that wait first."""
        for job in sorted(self.jobs.values(), key=lambda job: job.state == "running"):
            self.cancel(job.number)

    def _watch(self, job: PageJob, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        assert process.stderr is not None
        reader = threading.Thread(target=self._listen, args=(job, process.stderr), daemon=True)
        reader.start()
        job.text = _read(process.stdout)
        reader.join()
        job.status = process.wait()
        job.ended = time()
        if job.state == "running":
            job.state = "done" if job.status == 0 else "refused"
        for path in [] if job.state == "done" else job.outputs:
            with suppress(OSError):
                Path(path).rmdir()  # a folder that the command made before it was refused
        with self._lock:
            del self._processes[job.number]
        self._tell(job)
        self._begin_next()

    def _listen(self, job: PageJob, stream: IO[str]) -> None:
        with stream:
            for line in stream:
                if len(job.messages) < _MOST_LINES:
                    job.messages.append(line.rstrip()[:_LONGEST_LINE])
                    self._report_soon(job)

    def _report_soon(self, job: PageJob) -> None:
        """Report a job after a short delay, so that many lines make one message."""
        if job.number not in self._due:
            self._due.add(job.number)
            timer = threading.Timer(_EVERY, self._report_due, (job,))
            timer.daemon = True
            timer.start()

    def _report_due(self, job: PageJob) -> None:
        self._due.discard(job.number)
        if job.ended is None:
            self._tell(job)


def _mentions(manifest: str, name: str) -> bool:
    """Return whether a manifest of a test names a file."""
    with suppress(OSError, UnicodeDecodeError):
        return manifest.endswith(".toml") and Path(name).name in Path(manifest).read_text(encoding="utf-8")
    return False


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _read(stream: IO[str]) -> str:
    more = 0
    with stream:
        text = stream.read(_LONGEST)
        while part := stream.read(1 << 16):
            more += len(part)
    return f"{text}\n... and {more} characters more" if more else text


def _signal(process: subprocess.Popen[str], number: int) -> None:
    """Signal a command and the processes that it has started."""
    with suppress(ProcessLookupError):
        if _WINDOWS:
            process.terminate()
        else:
            os.killpg(process.pid, number)


def _start(job: PageJob) -> subprocess.Popen[str]:
    """Return the process of a command; raise OptionError where it cannot be started."""
    where = os.environ if job.within is None else confined(job.within)
    try:
        # -P: no imports from the working folder.
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "imulab", *job.words],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            encoding="utf-8",
            errors="replace",
            env={**where, "PYTHONUTF8": "1", "NO_COLOR": "1"},
            start_new_session=not _WINDOWS,
        )
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "a text that is none"
        raise OptionError(f"imulab {job.words[0]}: cannot be started: {reason}") from None

"""``imulab live``.

A guided test while the unit is connected, in the terminal or on a page; ``imulab open``, the workbench.
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import imulab as il
from imulab.cli.command import Argument, Command, option
from imulab.cli.options import (
    GivenFiles,
    OutputFile,
    ReportFile,
    check_record_outputs,
    note,
    reading,
    warn,
    whole_number,
)
from imulab.errors import ImulabError, OptionError
from imulab.options import FLAG, OUTPUT, RARE

if TYPE_CHECKING:
    from imulab.gravity import Gravity
    from imulab.live.page.bench import Workbench
    from imulab.live.page.files import FolderFiles
    from imulab.live.runner import Runner
    from imulab.recording import Layout
    from imulab.records.calibration import Calibration


# Common to `imulab live --page` and `imulab open`: options of the page, and a session on it.


FOLDER = "imulab-files"
_NOT_OFFERED = ("live", "open", "demo", "fleet ")
PagePort = Annotated[str | None, option("N", "Port of the page; a free one if not given.", "--port"), RARE]
PageHost = Annotated[
    str | None,
    option("ADDRESS", "Address of this machine to listen at, for others; 0.0.0.0 or ::, all.", "--host"),
    RARE,
]
NoBrowser = Annotated[bool, option("", "Print the address of the page, and open no browser.", "--no-browser"), RARE]


def port_number(text: str | None) -> int:
    """Return the port to listen at; 0, a free one, of None."""
    port = 0 if text is None else whole_number(text, "--port")
    if not 0 <= port <= 65535:
        raise OptionError(f"--port {port}: expected 0 (a free one) to 65535")
    return port


def checked_host(text: str | None) -> str | None:
    """Return the address to listen at, with a warning where others reach it; None, this machine alone, of None."""
    if text is not None and text not in ("localhost", "::1") and not text.startswith("127."):
        warn(f"whoever reaches {text} and has the address below can use the page; it is not encrypted")
    return text


def checked_page(page: bool, port: str | None, host: str | None, *, no_browser: bool, plain: bool) -> int | None:
    """Return the port of the page, or None without a page."""
    if not page:
        for value, name in ((port, "--port"), (host, "--host"), (no_browser or None, "--no-browser")):
            if value is not None:
                raise OptionError(f"{name}: expected --page with it")
        return None
    if plain:
        raise OptionError("--page together with --plain: expected one or the other")
    from imulab.live.page import require_server

    require_server()
    return port_number(port)


def again(save: str, texts: Mapping[str, str | None], output: str | None, record: Calibration) -> str:
    """Return the command that makes the same record from the recording."""
    from imulab.live.view import FURTHER

    typed = [word for key, text in texts.items() if text is not None for word in (f"--{key}", text)]
    further = [name for name in FURTHER if f"{name}_bias_x" in record.parameters]
    others = ["--with", ",".join(further)] if further else []
    return shlex.join(["imulab", "tumble", "fit", save, *typed, *others, *(["-o", output] if output else [])])


def workbench(named: Sequence[str] = (), later: Sequence[str] = ()) -> tuple[Workbench, FolderFiles]:
    """Return the workbench and its files: those of its folder, those named, and those that may come later."""
    from imulab.cli.app import commands
    from imulab.live.page.bench import Workbench
    from imulab.live.page.files import FolderFiles
    from imulab.live.page.jobs import forms

    offered = [each for each in commands() if not each.path.startswith(_NOT_OFFERED)]
    files = FolderFiles(Path(FOLDER), named, later)
    return Workbench(files, forms(offered)), files


def on_page(
    runner: Runner,
    made: Callable[[], Calibration],
    command: Callable[[Calibration], str],
    outputs: Sequence[str | None],
    place: Callable[[Mapping[str, str]], Gravity],
    *,
    port: int,
    host: str | None,
    browser: bool,
) -> None:
    """Show a session on the page, with the workbench, until it is ended there or by Ctrl-C.

    `outputs` are the names of the record, None where none was given, and of the other files to be written; `place`
    takes what the page says of the place.

    Raises
    ------
    ImulabError
        Why the session ended, where it was no ordinary end.
    KeyboardInterrupt
        It was ended before there was a record.
    """
    from imulab.live.page.guided import GuidedPart
    from imulab.live.page.server import serve

    part = GuidedPart(runner, made, command, Path(outputs[0] or "record.json").name, place)
    bench, files = workbench(later=[name for name in (runner.recorder.path, *outputs) if name])
    try:
        serve([part, bench], port, host=checked_host(host), browser=browser, tell=_tell_address)
    except KeyboardInterrupt:
        if part.record is None:
            raise
    else:
        if part.record is None and part.error is None:
            note(runner.kept())
    finally:
        files.end()
    if part.error is not None:
        with _saying_what_is_kept(runner):
            raise part.error


def _tell_address(address: str) -> None:
    """Print where the page is, and how it is ended, also where no key reaches it."""
    print(address)
    note("Ctrl-C ends it" + ("" if os.name == "nt" else f", or elsewhere: kill {os.getpid()}"))


# ``imulab open``: the workbench, in the browser of this machine.


def open(  # noqa: A001 -- the name of the command
    files: Annotated[list[str] | None, Argument("[FILE...]", "Recordings and records to begin with.")] = None,
    *,
    port: PagePort = None,
    host: PageHost = None,
    no_browser: NoBrowser = False,
) -> None:
    """Open the workbench in the browser.

    Drop a recording, see it, calibrate it, take record, report and firmware.

    Prints one line with the address, which only this machine reaches. What is dropped or made is kept in the folder
    imulab-files. Ctrl-C ends it.
    """
    from imulab.live.page import require_server

    number = port_number(port)
    require_server()
    from imulab.live.page.server import serve

    part, session = workbench(files or [])
    session.make()
    try:
        serve([part], number, host=checked_host(host), browser=not no_browser, tell=_tell_address)
    finally:
        if session.end():
            note(f"what was dropped and made is in {FOLDER}")


# ``imulab live``: a guided test while the unit is connected, from the plug to the record.


_WAIT = 0.05  # s for which one look at the source waits for samples
_EVERY = 0.1  # s between two drawings of the terminal: ten a second look smooth


def live(
    source: Annotated[
        str,
        Argument(
            "SOURCE",
            "serial:PORT[@BAUD] (serial: lists ports), udp:PORT, tcp:HOST:PORT, -, replay:FILE[@SPEED], "
            "simulate[:key=value,..].",
        ),
    ],
    *,
    save: Annotated[str | None, option("REC.csv", "Recording to write; needed."), OUTPUT] = None,
    output: OutputFile = None,
    report: ReportFile = None,
    target: Annotated[str | None, option('"bias 100 ug, .."', "Standard uncertainties at which it is enough.")] = None,
    attitudes: Annotated[str | None, option("N", "Number of attitudes, instead of a target.")] = None,
    page: Annotated[bool, option("", "Show it in a browser on this machine."), OUTPUT] = False,
    port: PagePort = None,
    host: PageHost = None,
    no_browser: NoBrowser = False,
    plain: Annotated[bool, option("", "A line for each event; ends when it is enough."), OUTPUT] = False,
    resume: Annotated[bool, option("", "Go on with the file of --save."), OUTPUT] = False,
    follow: Annotated[bool, option("", "The simulated unit does what the guide says.")] = False,
    **options: Any,
) -> None:
    """Guide a test while the unit is connected.

    A tumble test: what to do next, when a hold is accepted, when it is enough. The recording is written out every
    second; at its end the record is that of `imulab tumble fit` on it.
    """
    from imulab.live.guide import read_targets
    from imulab.live.runner import Runner
    from imulab.live.session import Session
    from imulab.live.sources import open_source
    from imulab.procedures.tumble.procedure import TASK

    if source == "serial:":
        _list_ports()
        return
    listened = checked_page(page, port, host, no_browser=no_browser, plain=plain)
    if save is None:
        raise OptionError("--save: expected the name of the recording to write, such as --save rec.csv")
    layout, units = options["layout"], reading({"units": options.pop("units")})["units"]
    values = TASK.values({name: text for name, text in options.items() if text is not None}, FLAG)
    session = Session(values["order"], values["gravity"], read_targets(target), _number_of_attitudes(attitudes, target))
    check_record_outputs(output, report, [name for name in (_source_name(source), layout) if name], save)
    fitted = {**options, "layout": None}
    opened = partial(open_source, source, layout, units=units, follow=follow)
    runner = Runner.open(opened, session, save, _layout(layout), resume=resume, units=units)
    made = partial(_make_record, save, fitted, output, report)
    with _offer_layout(), closing(runner):
        try:
            if listened is not None:
                command, place = partial(again, save, fitted, output), partial(_gravity_of_place, fitted)
                paged = partial(on_page, port=listened, host=host, browser=not no_browser)
                paged(runner, made, command, (output, report), place)
            else:
                _in_terminal(runner, made, plain=plain or not sys.stdout.isatty(), typed=source != "-")
        except KeyboardInterrupt:
            note(runner.kept())
            raise


def _gravity_of_place(fitted: dict[str, str | None], texts: Mapping[str, str]) -> Gravity:
    """Return the gravity of a place by the options' texts, which the record is then fitted with."""
    from imulab.procedures.tumble.procedure import TASK

    gravity: Gravity = TASK.values(dict(texts), FLAG)["gravity"]
    fitted.update({"gravity": None, "latitude": None, "height": None, "place": None} | dict(texts))
    return gravity


def _make_record(save: str, fitted: dict[str, str | None], output: str | None, report: str | None) -> Calibration:
    """Fit the recording with all triads that it has, write and show the record, and say how to make it."""
    from imulab.cli.show import finish

    if not Path(save).exists():
        raise OptionError(f"{save}: not written, as no row of readings came that could be used")
    record, _, why = _all_triads(save, fitted)
    finish(record, output, report, json=False)
    _say_how(save, again(save, fitted, None, record), why)
    return record


def _all_triads(save: str, fitted: dict[str, str | None]) -> tuple[Calibration, list[str], list[str]]:
    """Return the record of a recording, without further triads that are refused, and the reasons for these."""
    from imulab.live.view import fit_triads, further_triads
    from imulab.procedures.registry import run_task
    from imulab.readers import read

    def fit(further: list[str]) -> Calibration:
        return run_task("tumble", [save], {**fitted, "with": ",".join(further) or None}, GivenFiles())

    return fit_triads(fit, further_triads(read(save).columns))


def _in_terminal(runner: Runner, made: Callable[[], Calibration], *, plain: bool, typed: bool) -> None:
    """Guide the test in the terminal, make its record, and show corrected readings until the end."""
    (_print_events if plain else _draw_view)(runner, typed=typed)
    runner.recorder.close()
    if wrong := runner.session.view().counts.summary():
        note(f"of what came beside {runner.recorder.rows} samples: {wrong}")
    with _saying_what_is_kept(runner):
        record = made()
    if not plain and typed:
        _show_corrected(runner, record)


def _number_of_attitudes(text: str | None, target: str | None) -> int | None:
    number = None if text is None else whole_number(text, "--attitudes")
    if number is not None and not 4 <= number <= 200:
        raise OptionError(f"--attitudes {number}: expected 4 to 200")
    if number is not None and target is not None:
        raise OptionError("--attitudes together with --target: expected one or the other")
    return number


def _say_how(save: str, command: str, why: list[str]) -> None:
    """Print the command that makes the same record, and why it lacks gyroscopes or magnetometers."""
    note(f"the recording is {save}; {command} makes the same record")
    for each in why:
        note(each)


def _source_name(source: str) -> str:
    """Return the file, port or settings that a source names, without its speed."""
    name = source.partition(":")[2]
    return name.rpartition("@")[0] or name


def _layout(name: str | None) -> Layout | None:
    from dataclasses import replace

    from imulab.readers.layout import IfNeeded, load_layout

    if name is None:
        return None
    return replace(load_layout(str(name)), if_needed=True) if isinstance(name, IfNeeded) else load_layout(name)


def _list_ports() -> None:
    from imulab.live.links import serial_ports

    ports = serial_ports()
    for port, what in ports:
        print(f"serial:{port}  {what}")
    if not ports:
        print("no serial port on this machine")


@contextmanager
def _saying_what_is_kept(runner: Runner) -> Iterator[None]:
    """Say what the recording keeps of a session that ends without a record."""
    try:
        yield
    except ImulabError as error:
        if runner.recorder.rows and runner.kept() not in str(error):
            note(runner.kept())
        raise


@contextmanager
def _offer_layout() -> Iterator[None]:
    """Print the first lines of an unknown stream, and a layout to start from."""
    from imulab.live.formats import UnknownFormatError

    try:
        yield
    except UnknownFormatError as error:
        for line in error.lines:
            print(f"  {line}", file=sys.stderr)
        if error.guess is not None:
            head = f"# A guess ({error.guess.why}); check it, save it as layout.toml, and add --layout layout.toml:"
            print(f"{head}\n{error.guess.toml}", file=sys.stderr)
        raise


def _show_corrected(runner: Runner, record: Calibration) -> None:
    """Show readings corrected by the record until a key is pressed or the stream ends."""
    from time import monotonic

    from rich.live import Live

    from imulab.live.terminal import keys, pressed
    from imulab.live.view import corrected_reading
    from imulab.procedures.apply import loaded

    ready, gravity = loaded(record), runner.session.guide.local_gravity
    gyro = any(name.startswith("gyro_") for name in record.parameters)
    with keys(wanted=True) as usable, Live(auto_refresh=False, transient=True) as screen:
        drawn = 0.0
        while usable and not runner.ended and not pressed(usable):
            blocks = runner.listen(_WAIT)
            if blocks and monotonic() - drawn > _EVERY:
                reading = corrected_reading(ready, blocks[-1], gyro=gyro).text(gravity)
                screen.update(f"turn the unit and see: {reading}   any key ends", refresh=True)
                drawn = monotonic()


def _print_events(runner: Runner, *, typed: bool) -> None:
    """Print a line for each event, until the target is met or the stream ends.

    Raises
    ------
    DataError
        A simulated unit is not expected to give a record.
    """
    while not runner.ended and not runner.session.enough:
        for event in runner.step(_WAIT):
            print(f"{event.time:8.1f} s  {event.text}", flush=True)
        runner.refuse_hopeless()


def _draw_view(runner: Runner, *, typed: bool) -> None:
    """Draw the view until the user finishes or the stream ends."""
    from time import monotonic

    from rich.live import Live

    from imulab.live.terminal import direction_of_key, draw, keys, pressed

    by_hand = runner.source.by_hand
    with keys(wanted=typed) as usable, Live(auto_refresh=False, transient=True) as screen:
        drawn = 0.0
        while not runner.ended and not (runner.session.enough and not usable):
            events = runner.step_or_ask(_WAIT) if usable else runner.step(_WAIT)
            if (asked := runner.asked) is not None and asked.guess is not None and events:
                for line in (*asked.lines, *asked.guess.toml.splitlines()):
                    screen.console.print(f"  {line}", markup=False, highlight=False)
            if not usable:
                runner.refuse_hopeless()
            key = pressed(usable)
            if key == "g":
                events += runner.take_guess()
            if key == "q":
                break
            if key == "u":
                events += runner.drop()
            if by_hand and (direction := direction_of_key(key, runner.session.next)) is not None:
                runner.turn(direction)
            for event in events:
                if event.kind not in ("state", "next", "format"):
                    screen.console.print(f"{event.time:8.1f} s  {event.text}", markup=False, highlight=False)
            if events or monotonic() - drawn > _EVERY:
                screen.update(draw(runner.session.view(), *screen.console.size, by_hand=by_hand), refresh=True)
                drawn = monotonic()


COMMANDS = (
    Command(
        "live",
        live,
        lambda: [il.fit_tumble],
        only=("order", "gravity", "latitude", "height", "place", "layout", "units"),
    ),
    Command("open", open),
)

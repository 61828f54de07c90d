"""``imulab live``: a guided test while the unit is connected, from the plug to the record."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from imulab.cli.fit_options import with_options
from imulab.cli.live_page import NoBrowser, PageHost, PagePort, again, checked_page, on_page
from imulab.cli.options import GivenFiles, OutputFile, ReportFile, check_outputs, note, whole_number
from imulab.errors import OptionError
from imulab.procedures.options import FLAG, LAYOUT
from imulab.procedures.tumble.task import GRAVITY, ORDER, TASK

if TYPE_CHECKING:
    from imulab.live.runner import Runner
    from imulab.reading import Layout
    from imulab.records.calibration import Calibration

_WAIT = 0.05
_EVERY = 0.1


@with_options((ORDER, *GRAVITY, LAYOUT))
def live(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="serial:PORT[@BAUD] (serial: lists ports), udp:PORT, tcp:HOST:PORT, -, replay:FILE[@SPEED], "
            "simulate[:key=value,..].",
        ),
    ],
    *,
    save: Annotated[str | None, typer.Option("--save", metavar="REC.csv", help="Recording to write.")] = None,
    output: OutputFile = None,
    report: ReportFile = None,
    options: dict[str, str | None],
    target: Annotated[
        str | None,
        typer.Option(metavar='"bias 100 ug, .."', help="Standard uncertainties at which it is enough."),
    ] = None,
    attitudes: Annotated[
        str | None, typer.Option(metavar="N", help="Number of attitudes, instead of a target.")
    ] = None,
    page: Annotated[bool, typer.Option("--page", help="Show it in a browser on this machine.")] = False,
    port: PagePort = None,
    host: PageHost = None,
    no_browser: NoBrowser = False,
    plain: Annotated[bool, typer.Option("--plain", help="A line for each event; ends when it is enough.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the file of --save.")] = False,
    follow: Annotated[bool, typer.Option("--follow", help="The simulated unit does what the guide says.")] = False,
) -> None:
    """Guide a tumble test of a unit that is connected: what to do next, when a hold is accepted, when it is enough.

    The recording is written out every second; at its end the record is that of `imulab tumble fit` on it.
    """
    from imulab.live.runner import Runner
    from imulab.live.session import Session
    from imulab.live.sources import open_source
    from imulab.live.targets import read_targets

    if source == "serial:":
        _list_ports()
        return
    listened = checked_page(page, port, host, no_browser=no_browser, plain=plain)
    if save is None:
        raise OptionError("--save: expected the name of the recording to write, such as --save rec.csv")
    layout = options["layout"]
    values = TASK.values({name: text for name, text in options.items() if text is not None}, FLAG)
    planned = _number_of_attitudes(attitudes, target)
    session = Session(values["order"], values["gravity"], read_targets(target), planned)
    check_outputs([save, output, report], [name for name in (_replayed(source), layout) if name])
    fitted = {**options, "layout": None}
    known = _layout(layout)
    runner = Runner.open(lambda: open_source(source, layout, follow=follow), session, save, known, resume=resume)
    made = partial(_make_record, save, fitted, output, report)
    plain = plain or not sys.stdout.isatty()
    with _offering(), closing(runner):
        try:
            if listened is not None:
                said = partial(again, save, fitted, output)
                on_page(runner, made, said, (output, report), port=listened, host=host, browser=not no_browser)
            else:
                _in_terminal(runner, made, plain=plain, typed=source != "-")
        except KeyboardInterrupt:
            note(runner.kept())
            raise


def _make_record(save: str, fitted: dict[str, str | None], output: str | None, report: str | None) -> Calibration:
    """Fit the recording with all triads that it has, write and show the record, and say how to make it."""
    from imulab.cli.result import finish

    record, further, why = _all_triads(save, fitted)
    finish(record, output, report, json=False)
    _say_how(save, further, why)
    return record


def _all_triads(save: str, fitted: dict[str, str | None]) -> tuple[Calibration, list[str], list[str]]:
    """Fit a recording; a further triad that is refused is left out, so that no session is in vain. Return why, too."""
    from imulab.live.further import fit_triads, further_of
    from imulab.procedures.run import run_task
    from imulab.readers import read

    def fit(further: list[str]) -> Calibration:
        return run_task("tumble", [save], {**fitted, "with": ",".join(further) or None}, GivenFiles())

    return fit_triads(fit, further_of(read(save).columns))


def _in_terminal(runner: Runner, made: Callable[[], Calibration], *, plain: bool, typed: bool) -> None:
    """Guide the test in the terminal, make its record, and show corrected readings until the end."""
    (_plain if plain else _drawn)(runner, typed=typed)
    runner.recorder.close()
    if wrong := runner.session.view().counts.summary():
        note(f"of what came beside {runner.recorder.rows} samples: {wrong}")
    record = made()
    if not plain and typed:
        _corrected(runner, record)


def _number_of_attitudes(text: str | None, target: str | None) -> int | None:
    number = None if text is None else whole_number(text, "--attitudes")
    if number is not None and not 4 <= number <= 200:
        raise OptionError(f"--attitudes {number}: expected 4 to 200")
    if number is not None and target is not None:
        raise OptionError("--attitudes together with --target: expected one or the other")
    return number


def _say_how(save: str, further: list[str], why: list[str]) -> None:
    """Say which command makes the same record, and why it has no gyroscopes or magnetometers where it should."""
    others = f" --with {','.join(further)}" if further else ""
    note(f"the recording is {save}; imulab tumble fit {save}{others} makes the same record")
    for each in why:
        note(each)


def _replayed(source: str) -> str:
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
    from imulab.live.sources import serial_ports

    ports = serial_ports()
    for port, what in ports:
        print(f"serial:{port}  {what}")
    if not ports:
        print("no serial port on this machine")


@contextmanager
def _offering() -> Iterator[None]:
    """Show the first lines of an unknown stream, and a layout to start from."""
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


def _corrected(runner: Runner, record: Calibration) -> None:
    """Show what the record makes of the readings that still come, until a key is pressed or the stream ends."""
    from time import monotonic

    from rich.live import Live

    from imulab.live.corrected import corrected_reading
    from imulab.live.terminal import keys, pressed
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


def _plain(runner: Runner, *, typed: bool) -> None:
    """Print a line for each event, until it is enough or the stream ends."""
    while not runner.ended and not runner.session.enough:
        for event in runner.step(_WAIT):
            print(f"{event.time:8.1f} s  {event.text}", flush=True)


def _drawn(runner: Runner, *, typed: bool) -> None:
    """Draw the view until a person finishes or the stream ends."""
    from time import monotonic

    from rich.live import Live

    from imulab.live.terminal import draw, keys, pressed, turned

    by_hand = runner.source.by_hand
    with keys(wanted=typed) as usable, Live(auto_refresh=False, transient=True) as screen:
        drawn = 0.0
        while not runner.ended and not (runner.session.enough and not usable):
            events = runner.step(_WAIT)
            key = pressed(usable)
            if key == "q":
                break
            if key == "u":
                events += runner.drop()
            if by_hand and (direction := turned(key, runner.session.next)) is not None:
                runner.turn(direction)
            for event in events:
                if event.kind not in ("state", "next", "format"):
                    screen.console.print(f"{event.time:8.1f} s  {event.text}", markup=False, highlight=False)
            if events or monotonic() - drawn > _EVERY:
                screen.update(draw(runner.session.view(), *screen.console.size, by_hand=by_hand), refresh=True)
                drawn = monotonic()

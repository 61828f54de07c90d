"""The demonstration: five procedures and a fleet on simulated instruments, by the commands a user would type."""

from __future__ import annotations

import contextlib
import io
import os
import shlex
import shutil
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from imulab.display import Verdict
from imulab.errors import ImulabError, OptionError, install
from imulab.files import write_text
from imulab.procedures.registry import load
from imulab.procedures.views import exhibits_of
from imulab.report import Card, render_index
from imulab.report.traces import Figure


@dataclass(frozen=True)
class Scenario:
    """A question, the commands that answer it, the record or fleet's folder that they write, and the report."""

    name: str
    question: str
    commands: str
    record: str
    report: str

    @property
    def lines(self) -> list[str]:
        """The commands, one a line."""
        return [line for line in self.commands.strip().splitlines() if line.strip()]


SCENARIOS = (
    Scenario(
        "tumble",
        "What are the errors of this accelerometer triad, with gravity as the only reference?",
        """
imulab tumble simulate --order 2 --gravity 9.81362 --knock 7 --seed 4 --rate "40 Hz" -o tumble.csv
imulab tumble fit tumble.csv --gravity 9.81362 -o tumble.json --report tumble.html
imulab apply tumble.json tumble.csv -o tumble_corrected.csv
""",
        "tumble.json",
        "tumble.html",
    ),
    Scenario(
        "gyro array",
        "What does fusing six cheap gyroscopes really buy?",
        """
imulab array simulate --experiment static --duration "160 s" -o array_still.csv
imulab array simulate --experiment dynamic --session 1 -o array.csv
imulab array simulate --experiment dynamic --session 1 --fault stuck:3:40:20 -o array_fault.csv
imulab array calibrate array_still.csv -o array_calibration.json --report array_calibration.html
imulab array fuse array_fault.csv --calibration array_calibration.json -o array_rate.csv
imulab array compare array.csv --calibration array_calibration.json -o array.json --report array.html
""",
        "array.json",
        "array.html",
    ),
    Scenario(
        "warm-up",
        "How large is the bias of the minutes after power-on, and what is left with a table in the unit?",
        """
imulab warmup simulate --rate "0.8 Hz" --duration "20 min" --cycles 2 -o warmup
imulab warmup fit warmup/*.csv --model auto --settling-time "15 min" -o warmup.json --report warmup.html
""",
        "warmup.json",
        "warmup.html",
    ),
    Scenario(
        "centrifuge",
        "How does the g-sensitive drift of a flexible gyroscope change with g?",
        """
imulab centrifuge simulate --levels 1,5,10,20 --duration "3 min" --both-senses --rate "12 Hz" -o centrifuge
imulab centrifuge reduce centrifuge/manifest.toml -o centrifuge.json --report centrifuge.html
""",
        "centrifuge.json",
        "centrifuge.html",
    ),
    Scenario(
        "noise",
        "What must a filter be told of the noise of this unit, and how sure is that?",
        """
imulab noise simulate --white "0.3 deg/sqrt(h)" --flicker "12 deg/h" --walk "60 deg/h/sqrt(h)" --rate 6 -o rest.csv
imulab noise fit rest.csv -o noise.json --report noise.html
imulab noise plan --from noise.json --for walk=10%
""",
        "noise.json",
        "noise.html",
    ),
    Scenario(
        "fleet",
        "Is the production line still making the same thing?",
        """
imulab fleet simulate --rate "15 Hz" -o line
imulab fleet run line/first.csv -o line/records --workers 1
imulab fleet run line/second.csv -o line/records --workers 1
imulab fleet report line/records --limits line/limits.toml -o fleet.html
""",
        "line/records",
        "fleet.html",
    ),
    Scenario(
        "firmware",
        "Does the unit compute what the desk has validated?",
        """
imulab export --to c tumble.json -o firmware
make -C firmware test
""",
        "",
        "",
    ),
)


_LIVE = (
    "live in the browser, with a simulated unit and the workbench beside it:\n"
    "    imulab live simulate --follow --save live.csv --page     (without --page in the terminal)\n"
    f"    the page needs more packages: {install('live')}"
)


def run(folder: str | Path, main: Callable[[list[str]], int]) -> str:
    """Run the scenarios in `folder`, with an index page; return the results as text.

    `main` is the command line: it takes the words behind ``imulab`` and returns the exit status.

    Raises
    ------
    OptionError
        The folder cannot be made.
    """
    home = Path(folder)
    try:
        home.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OptionError(f"{home}: the folder cannot be made: {error.strerror}") from None
    lines: list[str] = []
    cards: list[Card] = []
    with _inside(home):
        for scenario in SCENARIOS:
            output = ""
            lines.append(f"{scenario.name}: {scenario.question}")
            for line in scenario.lines:
                lines.append(f"  $ {line}")
                output = _done(line, main)
            answer, figure, verdict = (output, None, None) if not scenario.record else _found(scenario)
            lines += [f"  {answer}", ""]
            cards.append(Card(scenario.question, answer, scenario.lines, figure, scenario.report, verdict))
        lead = (
            "Five procedures and a production line on simulated instruments: the question, the answer, and the "
            "commands that found it."
        )
        write_text("index.html", render_index("imulab demonstration", lead, cards))
    return "\n".join([*lines, f"firmware: {home / 'firmware'}", _LIVE, f"open {home / 'index.html'}"])


@contextlib.contextmanager
def _inside(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def _done(line: str, main: Callable[[list[str]], int]) -> str:
    """Run a command; return the last line that it printed.

    Raises
    ------
    ImulabError
        It failed, with what it said.
    """
    words = shlex.split(line)
    if words[0] == "make":
        if shutil.which("make") is None or (shutil.which("cc") is None and "CC" not in os.environ):
            return "not run: no make or no C compiler here"
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        if done.returncode:
            raise ImulabError(f"{line}: {' '.join(done.stderr.split())}")
        return next(text for text in done.stdout.splitlines() if "self-test" in text)
    spread = [name for word in words[1:] for name in (sorted(map(str, Path().glob(word))) if "*" in word else [word])]
    printed, complained = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(complained):
        status = main(spread)
    if status:
        raise ImulabError(f"{line}: {' '.join(complained.getvalue().split())}")
    return next((text for text in reversed(printed.getvalue().splitlines()) if text.strip()), "")


def _found(scenario: Scenario) -> tuple[str, Figure | None, Verdict | None]:
    if Path(scenario.record).is_dir():
        from imulab.fleet.report import exhibits_of_folder

        exhibits, verdict = exhibits_of_folder(scenario.record, limits="line/limits.toml"), None
    else:
        record = load(scenario.record)
        exhibits, verdict = exhibits_of(record), record.verdict
    figures = exhibits.figures
    return exhibits.headline, figures[0] if figures else None, verdict

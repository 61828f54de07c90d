"""Small inputs of every command, a call of each that works, and texts that no option means."""

from __future__ import annotations

import contextlib
import io
import os
import resource
import shutil
import signal
import sys
from pathlib import Path
from typing import Any

from imulab.cli import main
from imulab.cli.app import commands

MADE = (
    "tumble simulate --attitudes 15 --order 1 --hold 2s --rate 50 --seed 1 -o tumble.csv",
    "tumble fit tumble.csv --gravity 9.81 --order 1 -o tumble.json",
    "tumble simulate --attitudes 15 --order 1 --hold 2s --rate 50 --seed 1 --field 48uT --dip 60deg -o six.csv",
    "tumble fit six.csv --gravity 9.81 --order 1 --with mag -o six.json",
    "thermal simulate --temperatures=-10,20,50 --attitudes 12 --ramps 0 --gyro --rate 20 --seed 1 -o gyro",
    "array simulate --experiment static --elements 4 --duration 20s --seed 1 -o still.csv",
    "array calibrate still.csv -o array.json",
    "array simulate --imus --elements 2 --attitudes 3 --duration 6s --rate 50 -o imus.csv",
    "centrifuge simulate --levels 1,3,5 --cycles 1 --duration 30s --static-duration 30s --rate 50 --seed 1 -o spin",
    "centrifuge reduce spin/manifest.toml -o spin.json",
    "warmup simulate --temperatures=-20,0,20 --cycles 1 --duration 600s --rate 1 --units 1 --seed 1 -o cold",
    "warmup fit cold/*.csv --temperatures=-20,0,20 --settling-time 300s -o warm.json",
    "noise simulate --white 1e-3 --rate 20 --duration 200s --columns gyro_x --seed 1 -o rest.csv",
    "noise fit rest.csv -o noise.json",
    "thermal simulate --temperatures=-10,20,50 --attitudes 6 --ramps 0 --rate 20 --seed 1 -o hot",
    "thermal fit hot/tumble*.csv --gravity 9.81 -o hot.json",
    "rate simulate --rates 50,100,200 --faces +z,-z --cycles 1 --hold 2s --rate 50 --seed 1 -o turned",
    "rate fit turned/test.toml -o rate.json",
    "magnetometer simulate --duration 20s --seed 1 -o wave.csv",
    "magnetometer fit wave.csv -o wave.json",
    "fleet simulate --units 8 --seed 1 -o fleet",
)
CALLS = {
    "apply": "tumble.json tumble.csv -o OUT.csv",
    "show": "tumble.csv",
    "report": "tumble.json -o OUT.html",
    "convert": "tumble.csv -o OUT.csv",
    "export": "tumble.json --to c -o OUT",
    "allan": "rest.csv",
    "live": "simulate:speed=0 --plain --attitudes 12 --save OUT.csv -o OUT.json",
    "tumble plan": "--attitudes 12 --order 1 --noise 20ug -o OUT.csv",
    "tumble simulate": "--attitudes 9 --hold 1s --rate 20 -o OUT.csv",
    "tumble fit": "tumble.csv --gravity 9.81 --order 1 -o OUT.json",
    "tumble gyro": "gyro/tumble_20.csv --accel tumble.json -o OUT.json",
    "tumble mag": "six.csv --accel tumble.json -o OUT.json",
    "tumble check": "tumble.json tumble.csv --gravity 9.81",
    "array plan": "--imus --elements 2 --duration 4s --attitudes 2",
    "array simulate --imus": "--elements 2 --attitudes 2 --duration 2s -o OUT.csv",
    "array calibrate --imus": "imus.csv -o OUT.json",
    "array simulate": "--experiment static --duration 2s -o OUT.csv",
    "array merge": "first_gyro.csv second_gyro.csv -o OUT.csv",
    "array calibrate": "still.csv -o OUT.json",
    "array fuse": "still.csv -o OUT.csv",
    "array compare": "still.csv",
    "centrifuge plan": "-o OUT.toml",
    "centrifuge simulate": "--levels 1,3 --cycles 1 --duration 30s --rate 20 -o OUT",
    "centrifuge reduce": "spin/manifest.toml -o OUT.json",
    "warmup plan": "-o OUT.csv",
    "warmup simulate": "--temperatures=-20,0,20 --cycles 1 --duration 300s --rate 1 -o OUT",
    "warmup fit": "cold/*.csv --temperatures=-20,0,20 --settling-time 300s -o OUT.json",
    "warmup table": "warm.json -o OUT.csv",
    "noise fit": "rest.csv -o OUT.json",
    "noise plan": "--from noise.json",
    "noise check": "noise.json rest.csv",
    "noise simulate": "--white 1e-3 --rate 20 --duration 10s -o OUT.csv",
    "thermal plan": "-o OUT.csv",
    "thermal simulate": "--temperatures=-10,20,50 --attitudes 6 --ramps 0 --rate 20 -o OUT",
    "thermal fit": "hot/tumble*.csv --gravity 9.81 -o OUT.json",
    "thermal check": "hot.json hot/tumble*.csv --gravity 9.81",
    "rate plan": "--rates 50,100 --arw 0.3deg/sqrt(h) -o OUT.toml",
    "rate simulate": "--rates 50,100 --faces +z,-z --cycles 1 --hold 1s --rate 20 -o OUT",
    "rate fit": "turned/test.toml -o OUT.json",
    "rate turn": "turned/pz_1.csv --turns 2 -o OUT.json",
    "magnetometer plan": "--turn level",
    "magnetometer simulate": "--duration 5s -o OUT.csv",
    "magnetometer fit": "wave.csv -o OUT.json",
    "magnetometer check": "wave.json wave.csv",
    "fleet run": "fleet/first.csv --workers 1 -o OUT",
    "fleet status": "done",
    "fleet certificate": "done --lab lab.toml -o OUT",
    "fleet report": "done -o OUT.html",
    "fleet simulate": "--units 8 -o OUT",
    "layout guess": "foreign.csv -o OUT.toml",
    "certificate": "tumble.json --lab lab.toml -o OUT.xml",
}
NONSENSE = (
    "",
    " ",
    "x",
    "nan",
    "inf",
    "-inf",
    "-1",
    "0",
    "1",
    "0.5",
    "1e300",
    "-1e300",
    "1e308",
    "1e400",
    "-1e400",
    "1e-300",
    "1e-320",
    "1e9",
    "9" * 300,
    "9" * 5000,
    "1,2",
    "1,1",
    ",",
    "1e300,2e300",
    "0,0,0",
    "nan,nan",
    "[]",
    "{}",
    ":",
    "+1:+2",
    "1:0",
    "nan:nan",
    "0:1e300",
    "a=b",
    "accel=g",
    "accel=1e300",
    "-",
    "--",
    "*",
    "%s",
    "{0}",
    "/dev/null",
    "/",
    ".",
    "missing.csv",
    "tumble.json",
    "tumble.csv",
    "x\x1b[31m",
    "x\u202ey",
    "\udcff",
    "1 parsec",
    "1e300 g",
    "1e300 s",
    "1e300 deg/s",
    "1e300 Hz",
    "1e9 s",
    "1e-300 s",
    "1+-1e400",
    "auto",
    "all",
    "none",
    "a" * 5000,
    "1" + "e" * 300,
    "1_0",
    "٣",
    "1e300us",
    "-40,-40,-40",
    "1e400,2",
)
SECONDS, GIGABYTES = 20, 3


def words_of(folder: Path, text: str, out: str) -> list[str]:
    """The words of a call, with patterns replaced by the names of files, and OUT by a name."""
    words: list[str] = []
    for word in text.split():
        found = sorted(str(f.relative_to(folder)) for f in folder.glob(word)) if "*" in word else []
        words += found or [word.replace("OUT", out)]
    return words


def make_inputs(folder: Path) -> None:
    """Write the small inputs that the calls read."""
    for name, period in (("first_gyro", 7), ("second_gyro", 5)):
        rows = [f"{0.01 * k:.2f},{0.1 * (k % period):.1f}" for k in range(200)]
        (folder / f"{name}.csv").write_text("\n".join(["time [s],gyro_z [deg/s]", *rows, ""]))
    readings = [f"{0.01 * k:.2f},{0.1 * (k % 7):.1f},0.2,9.8" for k in range(200)]
    lab = (Path(__file__).parent / "data" / "lab.toml").read_text(encoding="utf-8")
    for single, of_all in (
        ("EX-2026-0042", "EX-{serial}"), ("[2026-11-24,", "[2026-03-01,"), ("received = 2026-11-20", ""),
    ):  # fmt: skip
        lab = lab.replace(single, of_all)
    (folder / "lab.toml").write_text(lab, encoding="utf-8")
    (folder / "foreign.csv").write_text("\n".join(["t,ax,ay,az", *readings, ""]))
    with contextlib.chdir(folder):
        for line in (*MADE, "fleet run fleet/first.csv -o done"):
            said = io.StringIO()
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
                status = main(words_of(folder, line, "OUT"))
            assert status == 0, f"{line}: {said.getvalue()}"


def outcome(words: list[str]) -> tuple[int | str, str]:
    """The exit status of a command in a process of its own, of bounded time and memory, and what it said."""
    for left in Path().glob("OUT*"):
        shutil.rmtree(left) if left.is_dir() else left.unlink()
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        # Of processor time, since the tests share the machine; a call that only waits has longer.
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
        signal.alarm(4 * SECONDS)
        # What this process holds already, which in a whole run of tests is much, and so much more.
        held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        most = held + (GIGABYTES << 30)
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        resource.setrlimit(resource.RLIMIT_FSIZE, (200 << 20, 200 << 20))
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        os.dup2(write, 2)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        if words[:2] == ["fleet", "certificate"]:  # the threads that lay pages out are lost to a forked process
            os.execv(sys.executable, [sys.executable, "-m", "imulab", *words])
        status = 97
        sys.stdin, sys.stdout, sys.stderr = (
            os.fdopen(0, closefd=False),
            os.fdopen(1, "w", closefd=False),
            os.fdopen(2, "w", closefd=False, errors="replace"),
        )
        try:
            status = main(words)
        except BaseException as error:
            print("ESCAPED", type(error).__name__, error, file=sys.stderr)
        sys.stderr.flush()
        os._exit(status)
    os.close(write)
    with os.fdopen(read, encoding="utf-8", errors="replace") as stream:
        said = stream.read(20_000)
    _, status = os.waitpid(child, 0)
    return (os.WEXITSTATUS(status) if os.WIFEXITED(status) else f"signal {os.WTERMSIG(status)}"), said


def calls(folder: Path) -> list[tuple[str, str, list[str]]]:
    """Command, option and words of every call with one option replaced by a nonsense."""
    found: list[tuple[str, str, list[str]]] = []
    for command in commands():
        if command.path not in CALLS:
            continue
        base = [*command.path.split(), *words_of(folder, CALLS[command.path], "OUT")]
        for option in command.options:
            if not option.takes_value or option.keyword in ("output", "save"):
                continue
            for text in NONSENSE:
                flag: Any = option.flags[-1]
                found.append((command.path, flag, [*base, f"{flag}={text}"]))
        for index, word in enumerate(base):
            if (folder / word).exists() or word.startswith("simulate:"):
                found += [(command.path, word, [*base[:index], text, *base[index + 1 :]]) for text in NONSENSE]
    return found

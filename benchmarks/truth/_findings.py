"""What a campaign of 6,410 trials found, and the rows that have tried it since: the tables at the head of the page.

What they say of today is read off the page's sections, so that it never differs from them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """What was wrong, its figures of then, and the rows of one section that try it."""

    what: str
    before: str
    group: str
    rows: tuple[str, ...]


TURNS, MAG, WHOLE = "Tumble: gyroscopes turned by hand", "Tumble: magnetometers", "Whole turns by hand"
ASYMMETRY, UNITS = "Tumble: scale factors that differ between + and -", "Tumble: units and far zeros"
NOISE, RATE, ARRAY = "Noise at rest", "Rate table", "Gyro array"
SILENT = [
    Finding(
        "gyroscopes that are not quiet in the holds of a tumble: ends of turns were cut off",
        "-223 ppm, 81 % (white .3 deg/s); -1780 ppm, 14 % (vibration); -0.3 %, 6 % (tremor .3 mrad); good in most",
        TURNS,
        ("white noise of .3 deg/s a sample", "vibration of 1 deg/s at 23 Hz", "tremor of .3 mrad at 8 Hz"),
    ),
    Finding(
        "scale factors that differ between + and -, taken for k2",
        "bias 74 % at 100 ppm, 0 % at 400",
        ASYMMETRY,
        tuple(f"± {q} ppm, noise of {n} ug, 24 attitudes: bias" for q, n in ((100, 20), (400, 20), (200, 60))),
    ),
    Finding(
        "samples lost without a trace, turns between attitudes",
        "-0.93 %, 4.9 u at 1 %",
        TURNS,
        ("1 % of the samples lost", "1 % of the samples lost, in tens", ".3 % of the samples lost"),
    ),
    Finding(
        "the same, whole turns", "0.57 %, 40 % at 0.5 %", WHOLE,
        ("0.5 % of the samples lost", "0.5 % of the samples lost, five times on and back"),
    ),
    Finding(
        "hysteresis hidden in its own scatter, one cycle of rates",
        "said 15 of 15 at 40 ppm, 0 of 15 at 200 and 1000 ppm; good",
        RATE,
        ("no loop, one cycle", *(f"loop of {loop} ppm, one cycle" for loop in (100, 200, 1000))),
    ),
    Finding(
        "the Earth's rate is not in the bias of whole turns", "11 deg/h, 5 to 42 %", WHOLE,
        ("bias, no latitude", "bias, latitude", "bias, latitude and accelerometers"),
    ),
    Finding(
        "noise of the recorded rate, sines and sweeps",
        "-0.1 %, 2.2 u (2 deg/s of 100); -3 % (5); good 30 of 30",
        RATE,
        tuple(f"{kind}, recorded rate noisy by {n} deg/s of 100" for n in (2, 5) for kind in ("sine", "sweep")),
    ),
    Finding(
        "a tilted axis, whole turns", "-609 ppm, 68 % at 2 deg; good 60 of 60", WHOLE,
        ("axis tilted by 0.5 deg", "axis tilted by 2 deg"),
    ),
    Finding("slow magnetometers", "0.75 %, 38 %", MAG, ("slow magnetometers, low pass 0.3 Hz",)),
    Finding(
        "alias of the mains; gradient of the field", "64 %; 61 %", MAG,
        ("alias of the mains at 0.1 Hz, 0.5 µT", "gradient of 10 µT/m, magnetometers 5 cm off"),
    ),
    Finding(
        "elements behind the thermometer; a loop approached from one side; scale factors that scatter between cycles",
        "70 %; 45 %; 84 %; good",
        "Thermal",
        (
            "elements 1.5 K behind the thermometer at the ends",
            "a loop of 0.3 mg, soaks from one side: noted",
            "scale factors that scatter by 100 ppm",
        ),
    ),
    Finding(
        "logs of 25 Hz with brisk turns", "-123 to -380 ppm; thermal 75 %", TURNS,
        ("25 Hz, means, turns of 1 s", "25 Hz, points, turns of .6 s"),
    ),
    Finding(
        "an array's element that is not linear in rate", "9 u; good 40 of 40", ARRAY,
        tuple(f"element 3 not linear, {b} % at 200 deg/s, {n}: scale factors" for b in ("0.1", "0.6")
              for n in ("one axis", "three axes")),
    ),
    Finding(
        "temperatures of a warm-up exchanged; every log begun late", "14.9 deg/h, 2.5 claimed", "Warm-up",
        (
            "fit: two temperatures exchanged, 1 cycles",
            "fit: two temperatures exchanged, 3 cycles",
            "fit: all logs begun 10 s late, thermometer",
        ),
    ),
    Finding(
        "two axes exchanged, with magnetometers and no hemisphere", "good 7 of 10", MAG,
        ("x and y of the accelerometers exchanged", "x and y of the magnetometers exchanged"),
    ),
    Finding(
        "accelerometers at rest whose output is no gravity, noise", "good", NOISE,
        tuple(f"accelerometers of 9.8 m/s^2, f: {kind}" for kind in ("half", "twice", "counts", "ft/s^2", "none")),
    ),
    Finding(
        "the same, tumble", "look", UNITS, ("half of what is stated", "twice what is stated"),
    ),
    Finding(
        "noise of an angular rate in another unit", "good with notes; values 57 times off", NOISE,
        ("rad/s read as deg/s, a gyro of 16 bits",),
    ),
    Finding(
        "temperature in whole degrees", "slope 49 ± 6 of 108 (deg/h)/K; a false walk", NOISE,
        ("--regress temperature, in whole degrees: slope; no walk",),
    ),
    Finding("zeros at 1 to 2 g", "bias -1080 ± 400 mg, good", UNITS, ("zeros at 1 g", "zeros at -2 g")),
]  # fmt: skip
NUMBERS = [1, 2, 3, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 15, 16, 17, 18]
ACCUSED = [
    Finding(
        "accelerometers beside magnetometers in a hand that sways", "u 5.7 -> 56 µg, error 5.4 -> 9 µg", MAG,
        ("accelerometers beside magnetometers, sway of 1.5 mrad",),
    ),
    Finding(
        "one long and quiet first hold", "blamed in 20 of 60", "Tumble: a long first hold",
        tuple(f"scatter of 200 ug, first hold {quiet} times as quiet" for quiet in (5, 20)),
    ),
    Finding(
        "vibration of 8 to 15 Hz called a change of level", "7 of 16", NOISE,
        ("vibration of 8 to 15 Hz that swings, one to six sigma: no change of level",),
    ),
    Finding(
        "a step of the level called a random walk", "58 of 60 columns", NOISE,
        ("a step of 25 deg/h, 10 u, that looks like a random walk",),
    ),
    Finding(
        "a phone named where poses are structured", "three recordings", MAG,
        ("half of the attitudes in two pointing directions, gradient", "a phone of 1 µT from the middle on"),
    ),
    Finding("clean: accelerometers", "", ASYMMETRY,
            ("none, noise of 20 ug, 24 attitudes: bias", "none, noise of 60 ug, 24 attitudes: bias")),
    Finding("clean: accelerometers and magnetometers", "mostly a magnetic attitude set aside", MAG,
            ("magnetometers, nothing disturbed",)),
    Finding("clean: thermal", "", "Thermal", ("soaks from one side, nothing disturbed",)),
    Finding("clean: rates", "", RATE, ("sine, recorded rate exact", "sweep, recorded rate exact")),
    Finding("clean: whole turns", "", WHOLE, ("scale factor, three on and three back",)),
    Finding("clean: noise", "", NOISE, ("N and B of a gyro, 400 s at 100 Hz",)),
    Finding("clean: array", "", ARRAY,
            tuple(f"all elements linear, {n}: scale factors" for n in ("one axis", "three axes"))),
]  # fmt: skip
HEAD = """
## What was found to be wrong

Coverage, share of trials warned of, and rms error of today, of each row that tries the finding. A finding stands until
all of its rows hold.

### Silently wrong

{silent}

### Accused wrongly, and clean tests

What a table cannot try, such as texts, refusals and comparisons of records, is in `tests/`.

{accused}
"""


def table(findings: list[Finding], numbers: list[int] | None, rows: dict[tuple[str, str], list[str]]) -> str:
    """Return a table of findings, with the cells of their rows by section and name."""
    lines = ["| | what | before | now, row by row | |", "|---|---|---|---|---|"]
    for index, finding in enumerate(findings):
        slug = re.sub(r"[^\w -]", "", finding.group.lower()).replace(" ", "-")
        number = numbers[index] if numbers else index + 1
        now = []
        verdicts = []
        for name in finding.rows:
            cells = rows.get((finding.group, name))
            if cells is None:
                verdicts.append("not run")
                continue
            coverage, warned, error = (re.sub(r" \((at|\d).*", "", cell) for cell in cells[1:4])
            shown = [coverage, f"{warned} warned", error]
            now.append(f"{name}: {', '.join(each for each in shown if each)}")
            verdicts.append(cells[4])
        worst = next((word for word in ("**falls short**", "not run") if word in verdicts), "holds")
        where = f"[{finding.what}](#{slug})"
        lines.append(f"| {number} | {where} | {finding.before} | {'; '.join(now)} | {worst} |")
    return "\n".join(lines)


def head(sections: dict[str, str]) -> str:
    """Return the tables of findings from the page's sections, by title."""
    rows = {}
    for title, text in sections.items():
        for line in text.splitlines():
            if line.startswith("| ") and line.count("|") == 7:
                name, *cells = (cell.strip() for cell in line.strip("|").split("|"))
                rows[title, name] = cells
    return HEAD.format(silent=table(SILENT, NUMBERS, rows), accused=table(ACCUSED, None, rows))

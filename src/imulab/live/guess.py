"""A layout to start from for a stream of numbers that nobody has described: offered, never taken."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from imulab.columns import triad
from imulab.readers.text import is_number
from imulab.recording import Array
from imulab.units import STANDARD_GRAVITY

_FEWEST = 5
_UNITS = (("m/s^2", STANDARD_GRAVITY), ("g", 1.0), ("mg", 1000.0))
_NEAR = 0.25
_STEADY = 0.2


@dataclass(frozen=True)
class Guess:
    """A layout as the text of a file, and what it was guessed from."""

    toml: str
    why: str


def guess_layout(lines: list[str], seconds: float) -> Guess | None:
    """Return a layout that may fit, or None where the lines hold no rows of numbers.

    Parameters
    ----------
    lines
        The first lines of the stream.
    seconds
        How long they took to come, which tells the unit of a time.
    """
    if sum(line.startswith("{") for line in lines) > len(lines) / 2:
        return _of_json(lines, seconds)
    delimiter = max(",;\t", key=lambda sign: sum(line.count(sign) for line in lines))
    split: Callable[[str], list[str]] = lambda line: [field.strip() for field in line.split(delimiter)]  # noqa: E731
    shown = {",": '","', ";": '";"', "\t": '"\\t"'}[delimiter]
    if not any(delimiter in line for line in lines):
        split, shown = str.split, '"whitespace"'
    rows = [split(line) for line in lines]
    prefix = _prefix(rows)
    rows = [row[1:] for row in rows if row[0] == prefix] if prefix else rows
    titles = next((row for row in rows if not any(map(is_number, row))), None)
    numbers = [row for row in rows if all(map(is_number, row))]
    width = max(map(len, numbers), default=0)
    table = np.array([list(map(float, row)) for row in numbers if len(row) == width])
    if len(table) < _FEWEST or width < 3:
        return None
    head = [f"delimiter = {shown}", *([f"prefix = {json.dumps(prefix)}"] if prefix else [])]
    named: list[str | int] = list(range(width))
    if titles is not None and len(titles) == width:
        named = list(titles)
    return _guess(head, named, table, seconds)


def _of_json(lines: list[str], seconds: float) -> Guess | None:
    rows = []
    for line in lines:
        try:
            document = json.loads(line)
        except ValueError:
            continue
        if isinstance(document, dict):
            rows.append(_flat(document))
    keys = list(rows[-1]) if rows else []
    rows = [row for row in rows if list(row) == keys]
    if len(rows) < _FEWEST or len(keys) < 3:
        return None
    return _guess([], list(keys), np.array([list(row.values()) for row in rows]), seconds)


def _flat(document: dict[str, object], before: str = "") -> dict[str, float]:
    found: dict[str, float] = {}
    for key, value in document.items():
        if isinstance(value, dict):
            found |= _flat(value, f"{before}{key}.")
        elif isinstance(value, list):
            found |= _flat({str(place): each for place, each in enumerate(value)}, f"{before}{key}.")
        elif isinstance(value, int | float):
            found[f"{before}{key}"] = float(value)
    return found


def _guess(head: list[str], names: list[str | int], table: Array, seconds: float) -> Guess | None:
    """Return the layout: a first column that rises is the time, three whose length is steady the accelerometers."""
    columns, why = ["[columns]"], []
    steps = np.diff(table[:, 0])
    first = 0
    if (steps > 0).all():
        ticks = float(table[-1, 0] - table[0, 0]) / max(seconds, 1e-3)
        unit = "s" if ticks < 30 else "ms" if ticks < 3e4 else "us"
        columns.append(f'time = {{ from = {json.dumps(names[0])}, unit = "{unit}" }}')
        why.append("the first column rises")
        first = 1
    sizes = {start: np.linalg.norm(table[:, start : start + 3], axis=1) for start in range(first, table.shape[1] - 2)}
    steady = {start: float(np.ptp(size) / size.mean()) for start, size in sizes.items() if size.mean() > 0}
    if not steady:
        return None
    at_g = [s for s in steady if any(abs(sizes[s].mean() / g - 1) < _NEAR for _, g in _UNITS) and steady[s] < _STEADY]
    start = at_g[0] if at_g else min((s for s in steady if (s - first) % 3 == 0), key=steady.__getitem__)
    length = float(np.median(sizes[start]))
    unit = next((unit for unit, g in _UNITS if abs(length / g - 1) < _NEAR), "count")
    columns += _triad("accel", names, start, unit)
    why.append(f"the next three have a length of {length:.4g}")
    if start + 6 <= table.shape[1]:
        columns += _triad("gyro", names, start + 3, "deg/s" if unit != "count" else "count")
        why.append("that the gyroscopes follow, and their unit, is only supposed")
    return Guess("\n".join([*head, *columns, ""]), "; ".join(why))


def _triad(stem: str, names: list[str | int], start: int, unit: str) -> list[str]:
    return [
        f'{name} = {{ from = {json.dumps(names[start + k])}, unit = "{unit}" }}' for k, name in enumerate(triad(stem))
    ]


def _prefix(rows: list[list[str]]) -> str:
    """Return the first field that most lines share where it is no number."""
    first = [row[0] for row in rows if len(row) > 1]
    pairs = [one for one, other in pairwise(first) if one == other and not is_number(one)]
    return max(set(pairs), key=pairs.count) if len(pairs) > len(first) / 2 else ""

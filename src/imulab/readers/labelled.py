"""Labelled text: ``Acceleration X: -2.76, Y: -7.99, Z: -5.00 m/s^2``, ``t:0,aX:0.1``, ``ax=0.1 ay=0.2``.

Each number has its name before it, or the three of a sensor one name (``Accel: 0.1, 0.2, 9.8`` are ``Accel x`` ..).
A bare axis behind another takes the words of the one before (``Acceleration Y``). A row holds what a layout takes, from
one line or from several; it is whole when all of it is there.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from imulab.errors import ReadError, several
from imulab.readers.titles import known_unit, read_title

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_PAIR = re.compile(
    rf"([A-Za-zµμ°_][^:=,;\t]*?)\s*[:=]\s*({_NUMBER}|nan)(?![\w:.])[ \t]*([^\s,;:=\d+-][^\s,;:=]*(?![^,;\n]*[:=]))?"
)
_BETWEEN = r"[ \t]*[,;\t ][ \t]*"
_TWO_MORE = re.compile(rf"{_BETWEEN}({_NUMBER}){_BETWEEN}({_NUMBER})(?![\w:=.])(?![ \t]*[,;]?[ \t]*[-+.\d])")
_AXES = ("x", "y", "z")


def pairs(line: str) -> Iterator[tuple[str, str, str]]:
    """Yield label, number, and the unit behind it or nothing, of each labelled number in a line."""
    before = ""
    for match in _PAIR.finditer(line):
        label, number, unit = match.groups()
        label = " ".join(label.split())
        if (others := _TWO_MORE.match(line, match.end(2))) and _is_sensor(label):
            for axis, each in zip(_AXES, (number, *others.groups()), strict=True):
                yield f"{label} {axis}", each, ""
            before = ""
            continue
        if label.lower() in _AXES and before[-1:].lower() in _AXES and len(before) > 1:
            label = before[:-1] + label
        before = label
        yield label, number, known_unit(unit) if unit else ""


def _is_sensor(label: str) -> bool:
    """Return whether three numbers behind a label are those of its axes: ``Accel: 0.1, 0.2, 9.8``."""
    return read_title(label).axis is None and read_title(f"{label} x").sensor in ("accel", "gyro", "mag")


class LabelledLines:
    """Lines of labelled numbers to rows of fields, separated by commas, in the order of the labels.

    Parameters
    ----------
    labels
        What a row holds.
    skips
        Whether rows that lack some are left out and counted, in `incomplete`, instead of refused.
    name, layout
        Names of the file and of the layout, for messages.
    """

    def __init__(self, labels: Sequence[str], name: str, layout: str, *, skips: bool) -> None:
        self._labels, self._name, self._layout, self._skips = list(labels), name, layout, skips
        self._wanted = set(labels)
        self._row: dict[str, str] = {}
        self._found = dict[str, None]()
        self.line = self.rows = self.incomplete = 0

    def check(self, head: str) -> None:
        """Refuse a file whose first lines lack a label.

        Raises
        ------
        ReadError
            The message lists the labels that there are.
        """
        there = dict.fromkeys(label for line in head.splitlines() for label, _, _ in pairs(line))
        missing = next((label for label in self._labels if label not in there), None)
        if missing is not None:
            labels = several(there, 200) or "no labelled numbers, such as ax: 0.1"
            raise ReadError(f"{self._name}: {self._layout} takes a number labelled {missing!r}, found {labels}")

    def read(self, lines: bytes) -> bytes:
        """Return the rows that these whole lines complete.

        Raises
        ------
        ReadError
            A label comes again before its row is whole.
        """
        out: list[str] = []
        for line in lines.decode("utf-8", "replace").splitlines():
            self.line += 1
            for label, number, _ in pairs(line):
                if label not in self._wanted:
                    continue
                if label in self._row:
                    self._refuse_incomplete()
                self._row[label] = number
                if len(self._row) == len(self._wanted):
                    out.append(",".join(self._row[each] for each in self._labels))
                    self._row = {}
                    self.rows += 1
        return ("\n".join(out) + "\n").encode() if out else b""

    def _refuse_incomplete(self) -> None:
        self.incomplete += 1
        missing = next(label for label in self._labels if label not in self._row)
        self._row = {}
        if not self._skips and self.rows:  # a stream often begins in the middle of a row
            raise ReadError(
                f"{self._name}: row {self.rows + 1} (line {self.line}): no number labelled {missing!r} before the next "
                "row begins; skip_incomplete = true in the layout leaves such rows out and counts them"
            )

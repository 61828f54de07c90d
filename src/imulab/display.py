r"""How results and texts show themselves.

Texts of files made safe to print, results as a headline and a table, and the verdict on a result.

A record, a title or a comment is somebody else's text. Unicode knows more line ends than ``\n`` (U+0085, U+2028), and
marks that reverse what is shown (Unicode TR 36, bidirectional text spoofing).

A procedure writes its findings as sentences. A plain ``str`` asks a person to look; a `Bad` one forbids use as it is; a
`Note` is worth knowing and changes nothing.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any, Literal, Self

# Texts from files, made safe to print: no character that ends a line, moves the cursor or reverses text.


# Lone surrogates stand in file names that are not UTF-8; they and noncharacters are in no text that is exchanged.
_NEVER_SHOWN = "\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufdd0-\ufdef\ufeff\ufffe\uffff"
_REVERSES = re.compile("[\u202a-\u202e\u2066-\u2069]")
_HIDDEN = re.compile(f"[\x00-\x1f{_NEVER_SHOWN}]")
_HIDDEN_IN_LINES = re.compile(f"[\x00-\x09\x0b-\x1f{_NEVER_SHOWN}]")

_PLAIN = bytes([*b"\t\n\r", *range(0x20, 0x7F)])


def has_hidden(text: str) -> bool:
    """Return whether a text has a control or bidirectional character."""
    return _HIDDEN.search(text) is not None


def reverses(text: str) -> bool:
    """Return whether a text has a bidirectional embedding, override or isolate."""
    return _REVERSES.search(text) is not None


def may_hide(data: bytes) -> bool:
    r"""Return whether the texts of a JSON file may have a control or bidirectional character: one, or a ``\``."""
    others = data.translate(None, _PLAIN)
    return b"\\" in data or (bool(others) and has_hidden(others.decode("utf-8")))


def _escape(match: re.Match[str]) -> str:
    r"""Return a character as Python writes it in `repr`: ``\x1b``, ``\u2028``."""
    code = ord(match[0])
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"


def printable(text: str, *, lines: bool = False) -> str:
    """Return a text with its control and bidirectional characters as escapes; with `lines`, line breaks stay."""
    return (_HIDDEN_IN_LINES if lines else _HIDDEN).sub(_escape, text)


def first_hidden(value: Any, where: str = "") -> str | None:
    """Return the place in plain JSON values of the first text or key with a hidden character, or None."""
    if isinstance(value, str):
        return where.lstrip(".") if has_hidden(value) else None
    if isinstance(value, Mapping):
        for key, item in value.items():
            place = f"{where}.{printable(str(key))}"
            if has_hidden(str(key)):
                return place.lstrip(".")
            if hidden := first_hidden(item, place):
                return hidden
    elif isinstance(value, Sequence) and not set(map(type, value)) <= {float, int}:
        for index, item in enumerate(value):
            if hidden := first_hidden(item, f"{where}[{index}]"):
                return hidden
    return None


# Results that are no records, shown as a headline and a table, in text or HTML.


LINES = 12
"""Of a result, as Python shows it."""
WIDTH = 150  # most characters of a line in a notebook


class Shown:
    """A result that prints itself as `shown` returns it."""

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return a headline, the titles of a table, and its rows."""
        raise NotImplementedError

    def __repr__(self) -> str:
        headline, titles, rows = self.shown()
        lines = [headline, *(aligned(titles, rows) if rows else [])]
        if len(lines) > LINES:
            lines = [*lines[: LINES - 1], f"... and {len(lines) - LINES + 1} more"]
        return "\n".join(line if len(line) <= WIDTH else line[: WIDTH - 4] + " ..." for line in lines)

    def _repr_html_(self) -> str:
        headline, titles, rows = self.shown()
        return f"<div><strong>{escape(headline)}</strong>{html_table(titles, rows) if rows else ''}</div>"


def html_table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as HTML."""
    right = _numeric_columns(rows, len(titles))
    styles = [f' style="text-align: {"right" if number else "left"}; padding: 1px 8px"' for number in right]
    head = "".join(f"<th{style}>{escape(title)}</th>" for title, style in zip(titles, styles, strict=True))
    cells = (zip(row, styles, strict=True) for row in rows)
    body = "".join("<tr>" + "".join(f"<td{s}>{escape(cell)}</td>" for cell, s in row) + "</tr>" for row in cells)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def aligned(titles: list[str], rows: list[list[str]]) -> list[str]:
    """Return a table as lines of text, with texts to the left and numbers to the right."""
    table = [titles, *rows]
    widths = [max(len(row[i]) for row in table) for i in range(len(titles))]
    numeric = _numeric_columns(rows, len(titles))
    return [
        "  ".join(
            cell.rjust(width) if right else cell.ljust(width)
            for cell, width, right in zip(row, widths, numeric, strict=True)
        ).rstrip()
        for row in table
    ]


def _numeric_columns(rows: Sequence[Sequence[str]], count: int) -> list[bool]:
    """Return which columns hold numbers."""
    return [all(_numeric(row[i]) for row in rows) for i in range(count)]


def _numeric(text: str) -> bool:
    return text in ("–", "not stated", "in noise") or text.lstrip("+-")[:1].isdigit()


# The verdict on a result: usable as it is, to be looked at first, or not usable.


State = Literal["good", "look", "bad"]

_LOOK = "look at the figures of the report (--report FILE.html) for what the reasons name"
_CLAUSES = re.compile(r"[:;] (?![^(]*\))")  # not those within parentheses
_IMPERATIVE = re.compile(
    r"(?:add|ask|calibrate|check|choose|compare|correct|cut|drop|export|find|fit|fix|give|hold|keep|leave|let|look|make|"
    r"measure|mend|mount|move|name|open|place|plan|put|read|record|repeat|run|see|set|simulate|start|state|take|test|turn|"
    r"update|use|wait|warm|write)\b"
)


_THINGS = "(attitude|spike|sample|row|turn|hold|soak|log|cycle|column|line|field|run|gyro|dwell|stop)"
_ONE = re.compile(rf"(?<![\w.,:/-])1 {_THINGS}s\b")
_ONE_IS = re.compile(rf"((?<![\w.,:/-])1 {_THINGS}(?: over \S+ s| at rest)?) are(?= too few)")


def one_thing(text: str) -> str:
    """Return a text with ``1 attitude`` in place of ``1 attitudes``."""
    return _ONE_IS.sub(r"\1 is", _ONE.sub(r"1 \1", text)) if "1 " in text else text


class Finding(str):
    """What a user should know of a result; `action` is what to do about it, where the text does not end with that."""

    __slots__ = ("action",)
    action: str

    def __new__(cls, text: str, action: str = "") -> Self:
        """Return a text as a finding."""
        finding = super().__new__(cls, one_thing(text))
        finding.action = action
        return finding


class Note(Finding):
    """A finding that does not lower the verdict."""

    __slots__ = ()


class Bad(Finding):
    """A finding after which the result must not be used as it is."""

    __slots__ = ()


def prefixed(prefix: str, finding: str) -> str:
    """Return a finding as ``prefix: finding``, of the same class and with the same action."""
    return _reworded(finding, f"{prefix}: {finding}")


def _reworded(finding: str, text: str) -> str:
    return type(finding)(text, finding.action) if isinstance(finding, Finding) else text


_NUMBER = re.compile(r"(?<![\w^.])-?(?:\d{1,3}(?:,\d{3})+|\d+)(?:\.\d+)?(?:e[+-]?\d+)?\b")
_APART = 3  # sensors, of which each may have numbers of its own: the axes of a triad


def _value(number: str) -> float:
    """Return the value of a number as a message writes it, with or without commas between thousands."""
    return float(number.replace(",", ""))


def join_alike(findings: Iterable[tuple[str, str]]) -> list[tuple[list[str], str]]:
    """Return findings on sensors, from pairs of name and finding, each with the names of those that share it.

    Those of more than three sensors that differ in their numbers alone are one, with the range of each number.

    Examples
    --------
    >>> join_alike((f"gyro_{n}", f"stuck from {n}.5 s") for n in range(1, 6))
    [(['gyro_1', 'gyro_2', 'gyro_3', 'gyro_4', 'gyro_5'], 'stuck from 1.5…5.5 s')]
    """
    alike: dict[tuple[type, str, tuple[str, ...]], list[tuple[str, str]]] = {}
    for name, finding in findings:
        action = getattr(finding, "action", "")
        parts = tuple(re.sub(rf"^ {_THINGS}\b", r" \1s", part) for part in _NUMBER.split(finding))
        alike.setdefault((type(finding), action, parts), []).append((name, finding))
    result: list[tuple[list[str], str]] = []
    for (_, _, parts), members in alike.items():
        same: dict[str, list[str]] = {}
        for name, finding in members:
            same.setdefault(finding, []).append(name)
        names = list(dict.fromkeys(name for name, _ in members))
        if len(names) <= _APART or len(same) == 1:
            result += [(those, finding) for finding, those in same.items()]
            continue
        columns = zip(*(_NUMBER.findall(finding) for finding in same), strict=True)
        ranges = ["…".join(dict.fromkeys((min(texts, key=_value), max(texts, key=_value)))) for texts in columns]
        whole = "".join(part + number for part, number in zip(parts, [*ranges, ""], strict=True))
        result.append((names, _reworded(members[0][1], whole)))
    return result


@dataclass(frozen=True, slots=True)
class Verdict:
    """``good``, ``look`` or ``bad``, and the findings that led to it, the gravest first.

    `next` holds what to do now, an action each; it is empty where the state is ``good``. Records of older versions have
    none, and are written again without it (`has_next`).
    """

    state: State
    reasons: tuple[str, ...] = ()
    next: tuple[str, ...] = ()
    has_next: bool = field(default=True, repr=False, compare=False)


UNJUDGED = Verdict("good")
"""Stands for a verdict that has not been formed yet."""

SENTENCES: dict[State, str] = {
    "good": "nothing in the data speaks against this result",
    "look": "understand this before you use the result",
    "bad": "do not use this result as it is",
}


def verdict_of(findings: Iterable[str]) -> Verdict:
    """Return the verdict that a procedure's findings lead to."""
    findings = tuple(findings)
    grave = [finding for finding in findings if isinstance(finding, Bad)]
    doubtful = [finding for finding in findings if not isinstance(finding, Bad | Note)]
    reasons = [*grave, *doubtful]
    actions = tuple(dict.fromkeys(filter(None, map(action_of, reasons))))
    state: State = "bad" if grave else "look" if doubtful else "good"
    return Verdict(state, tuple(map(str, reasons)), actions or ((_LOOK,) if reasons else ()))


def action_of(finding: str) -> str:
    """Return what a finding asks for: its action, or the last clause of its text if that is one, or nothing.

    A text says what is the case, how large it is and, behind its last colon or semicolon, what to do.
    """
    action: str = getattr(finding, "action", "")
    if action:
        return action
    clause = _CLAUSES.split(finding)[-1].strip()
    return clause if _IMPERATIVE.match(clause) and clause != finding else ""


def as_judged(findings: Iterable[str], verdict: Verdict) -> tuple[str, ...]:
    """Return findings, read back as plain texts, with the classes that led to a verdict.

    What is no reason is a `Note`; the first reason of a bad verdict is `Bad` (the others cannot be told apart). Actions
    that are not in the texts stay with the first reason.
    """
    worst = verdict.reasons[0] if verdict.state == "bad" and verdict.reasons else None
    kept = {action_of(reason) for reason in verdict.reasons}
    further = "; ".join(action for action in verdict.next if action not in kept and action != _LOOK)
    first = verdict.reasons[0] if verdict.reasons else None

    def judged(finding: str) -> str:
        action = further if finding == first else ""
        if finding == worst:
            return Bad(finding, action)
        if finding in verdict.reasons:
            return Finding(finding, action) if action else str(finding)
        return Note(finding)

    return tuple(map(judged, findings))

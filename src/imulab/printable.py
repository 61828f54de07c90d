r"""Texts that files bring along, made safe to print: no character that ends a line, moves the cursor or turns text.

A record, a title or a comment is somebody else's text. Unicode knows more line ends than ``\n`` (U+0085, U+2028), and
marks that reverse what is shown (Unicode TR 36, bidirectional text spoofing).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

_HIDDEN = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff]")
_HIDDEN_IN_LINES = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff]")


def has_hidden(text: str) -> bool:
    """Return whether a text holds a control or bidirectional character."""
    return _HIDDEN.search(text) is not None


def _escape(found: re.Match[str]) -> str:
    r"""Return a character as Python writes it in `repr`: ``\x1b``, ``\u2028``."""
    code = ord(found[0])
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"


def printable(text: str, *, lines: bool = False) -> str:
    """Return a text with its control and bidirectional characters as escapes; with `lines`, line breaks stay."""
    return (_HIDDEN_IN_LINES if lines else _HIDDEN).sub(_escape, text)


def first_hidden(value: Any, where: str = "") -> str | None:
    """Return where in plain JSON values the first text or key with a hidden character stands, or None."""
    if isinstance(value, str):
        return where.lstrip(".") if has_hidden(value) else None
    if isinstance(value, Mapping):
        for key, item in value.items():
            place = f"{where}.{printable(str(key))}"
            if has_hidden(str(key)):
                return place.lstrip(".")
            if found := first_hidden(item, place):
                return found
    elif isinstance(value, Sequence) and not set(map(type, value)) <= {float, int}:
        for index, item in enumerate(value):
            if found := first_hidden(item, f"{where}[{index}]"):
                return found
    return None

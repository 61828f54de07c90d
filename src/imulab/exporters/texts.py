"""Texts of records in exported files, apart from the exporters so that none has a way around it.

A serial, a time or a unit of a record is somebody else's text, which is brought into the form that its place takes as
a text. What writes a file takes such texts through this module alone: whole comments, so that no part is forgotten.

Source: ISO C99, 5.1.1.2 (trigraphs and joined lines come before comments) and 6.4.9; YAML 1.2, 5.1 (characters);
CommonMark 0.31, 6.1 (code spans).
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from imulab.display import printable

_ENDS_COMMENT = re.compile(r"\*(?=/)|/(?=\*)|\?(?=\?)")
_BACKTICKS = re.compile("`+")


def in_c_comment(text: str) -> str:
    """Return a text as a part of a C comment of either kind: it ends none, and no compiler warns of it."""
    return _ENDS_COMMENT.sub(r"\g<0> ", printable(text).replace("\\", "|"))


def c_comment(*lines: str) -> list[str]:
    """Return a C comment, of one line or a block."""
    texts = [in_c_comment(line) for line in lines]
    return [f"/* {texts[0]} */"] if len(texts) == 1 else ["/*", *(f" * {text}".rstrip() for text in texts), " */"]


def hash_comments(lines: Sequence[str]) -> list[str]:
    """Return comments of YAML and of parameter files, a line each."""
    return [f"# {printable(line)}".rstrip() for line in lines]


def property_value(text: str) -> str:
    """Return a text as a value of library.properties, which ends with its line and has no escapes."""
    return printable(text)


def markdown_code(text: str) -> str:
    """Return a text as a code span of Markdown, in which nothing is a link, an image, HTML or emphasis."""
    text = printable(text)
    fence = "`" * (1 + max((len(run) for run in _BACKTICKS.findall(text)), default=0))
    space = " " if text.startswith("`") or text.endswith("`") or not text.strip() else ""
    return f"{fence}{space}{text}{space}{fence}"

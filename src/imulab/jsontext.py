"""Plain JSON values as text: with an indent as a file, without spaces and with sorted keys to be hashed.

The texts are those of the standard library, whose encoder is slow with an indent; each number is written once for both.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from imulab.digits import decimal_rows

_string = json.encoder.encode_basestring
_MANY = 64
"""Numbers in a list that are worth the way through an array."""


def json_text(content: Mapping[str, Any]) -> str:
    """Return ``json.dumps(content, indent=1, ensure_ascii=False)`` and a line break."""
    return _texts(content, "\n")[1] + "\n"


def sealed_text(content: Mapping[str, Any]) -> tuple[str, str]:
    """Return the `content_sha256` of a record's content, and the text of its file with it as the last key."""
    compact, indented = _texts(content, "\n")
    sha256 = hashlib.sha256(compact.encode("utf-8")).hexdigest()
    return sha256, f'{indented[:-2]},\n "content_sha256": "{sha256}"\n}}\n'


def content_sha256(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the record's JSON without ``content_sha256``: keys sorted, no spaces, UTF-8.

    Raises
    ------
    ValueError
        A number is not finite, or a text is no Unicode.
    """
    text = json.dumps(
        {key: value for key, value in content.items() if key != "content_sha256"},
        sort_keys=True,
        separators=(",", ":"),
        ensure_ascii=False,
        allow_nan=False,
    )
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


def all_floats(values: Any) -> bool:
    """Whether a list or tuple holds floats and nothing else, as most do."""
    return set(map(type, values)) == {float}


def _texts(value: Any, line: str) -> tuple[str, str]:
    """Return both texts; `line` is a line break with the indent of what surrounds the value."""
    inner = line + " "
    if isinstance(value, dict):
        if not value:
            return "{}", "{}"
        items = {key: _texts(item, inner) for key, item in value.items()}
        compact = ",".join([f"{_string(key)}:{items[key][0]}" for key in sorted(items)])
        indented = ("," + inner).join([f"{_string(key)}: {item[1]}" for key, item in items.items()])
        return f"{{{compact}}}", f"{{{inner}{indented}{line}}}"
    if isinstance(value, list):
        if not value:
            return "[]", "[]"
        if all_floats(value):
            numbers = _numbers(value)
            return f"[{numbers}]", f"[{inner}{numbers.replace(',', ',' + inner)}{line}]"
        each = [_texts(item, inner) for item in value]
        return f"[{','.join([a for a, _ in each])}]", f"[{inner}{(',' + inner).join([b for _, b in each])}{line}]"
    kind = type(value)
    if kind is str:
        text = _string(value)
    elif kind is float:
        text = float.__repr__(value)
    else:
        text = "null" if value is None else json.dumps(value, ensure_ascii=False, allow_nan=False)
    return text, text


def _numbers(values: list[float]) -> str:
    if len(values) < _MANY:
        return ",".join(map(float.__repr__, values))
    return str(decimal_rows(np.array(values)[None]), "ascii")[:-1]

"""Plain JSON values as text: with an indent as a file, without spaces and with sorted keys to be hashed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any


def json_text(content: Mapping[str, Any]) -> str:
    """Return JSON with an indent of 1, and a line break.

    Raises
    ------
    TypeError
        A value is not of JSON's kinds (NumPy's are not).
    ValueError
        A number is not finite.
    """
    return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def sealed_text(content: Mapping[str, Any]) -> tuple[str, str]:
    """Return the `content_sha256` of a record's content, and the text of its file with it as the last key.

    Raises
    ------
    TypeError
        A value is not of JSON's kinds (NumPy's are not).
    ValueError
        A number is not finite, or a text is no Unicode.
    """
    sha256 = content_sha256(content)
    return sha256, json_text({**content, "content_sha256": sha256})


def content_sha256(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the record's JSON without ``content_sha256``: keys sorted, no spaces, UTF-8.

    Raises
    ------
    TypeError
        A value is not of JSON's kinds (NumPy's are not).
    ValueError
        A number is not finite, or a text is no Unicode.
    """
    plain = {key: value for key, value in content.items() if key != "content_sha256"}
    text = json.dumps(plain, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()

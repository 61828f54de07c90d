"""Plain JSON values as text: with an indent as a file, without spaces and with sorted keys to be hashed.

The texts are those of the standard library, whose encoder is slow with an indent; C (`_digits`) writes both at once.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

from imulab.writers import _digits
from imulab.writers.decimals import prepare


def json_text(content: Mapping[str, Any]) -> str:
    """Return ``json.dumps(content, indent=1, ensure_ascii=False)`` and a line break."""
    return _texts(content)[1].decode("utf-8") + "\n"


def sealed_text(content: Mapping[str, Any]) -> tuple[str, str]:
    """Return the `content_sha256` of a record's content, and the text of its file with it as the last key.

    Raises
    ------
    TypeError
        A value is not of JSON's kinds (NumPy's are not), or a key no text.
    ValueError
        A number is not finite, or a text is no Unicode.
    """
    compact, indented = _texts(content)
    sha256 = hashlib.sha256(compact).hexdigest()
    return sha256, f'{indented[:-2].decode("utf-8")},\n "content_sha256": "{sha256}"\n}}\n'


def content_sha256(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the record's JSON without ``content_sha256``: keys sorted, no spaces, UTF-8.

    Raises
    ------
    ValueError
        A number is not finite, or a text is no Unicode.
    """
    compact, _ = _texts({key: value for key, value in content.items() if key != "content_sha256"})
    return hashlib.sha256(compact).hexdigest()


def _texts(content: Mapping[str, Any]) -> tuple[bytes, bytes]:
    prepare()
    return _digits.json(content)

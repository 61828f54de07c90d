"""The texts of a record against those of the standard library, to the byte."""

import hashlib
import json
import struct
import subprocess
import sys
from collections import OrderedDict, namedtuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imulab.records.json_text import content_sha256, json_text, sealed_text
from imulab.writers import _digits

finite = st.floats(allow_nan=False, allow_infinity=False)
whole = st.integers() | st.integers(-(2**70), 2**70)
unicode = st.text(st.characters(exclude_categories=["Cs"]))
values = st.recursive(
    st.none() | st.booleans() | whole | finite | unicode,
    lambda inner: st.lists(inner) | st.lists(inner).map(tuple) | st.dictionaries(unicode, inner),
    max_leaves=40,
)


def compact(content: object) -> str:
    return json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def indented(content: object) -> str:
    return json.dumps(content, indent=1, ensure_ascii=False)


@given(values)
def test_both_texts_are_those_of_the_standard_library(content):
    assert _digits.json(content) == (compact(content).encode(), indented(content).encode())


@given(st.dictionaries(unicode, values))
def test_the_hash_is_of_the_compact_text_and_the_last_key_of_the_file(content):
    content.pop("content_sha256", None)
    sha256, text = sealed_text({**content, "format": "imulab.calibration"})
    whole = {**content, "format": "imulab.calibration", "content_sha256": sha256}
    assert text == json_text(whole) == indented(whole) + "\n"
    assert sha256 == hashlib.sha256(compact({**content, "format": "imulab.calibration"}).encode()).hexdigest()
    assert content_sha256(whole) == sha256


def test_any_double_is_written_as_python_writes_it():
    bits = np.random.default_rng(1).integers(0, 2**64, 100_000, dtype=np.uint64)
    numbers = [x for x in bits.view(np.float64).tolist() if np.isfinite(x)]
    assert len(numbers) > 90_000
    assert _digits.json(numbers) == (compact(numbers).encode(), indented(numbers).encode())


def test_keys_are_sorted_by_code_point():
    keys = ["\uffff", "\U00010000", "a", "", "aa", "B", "é", "\x00", "~", "a\x00", '"', "\\"]
    content = {key: {k: i for i, k in enumerate(reversed(keys))} for key in keys}
    assert _digits.json(content) == (compact(content).encode(), indented(content).encode())


def test_every_character_is_escaped_as_the_standard_library_escapes_it():
    content = ["".join(map(chr, range(0x300))), "\u2028\u2029\ufeff\U0010ffff"]
    assert _digits.json(content)[0].decode() == compact(content)


def test_subclasses_of_the_plain_kinds_are_written_as_these():
    point = namedtuple("point", "x y")
    content = [np.float64(0.1), np.str_("text"), point(1.5, [2])]
    assert _digits.json(content)[1].decode() == indented([0.1, "text", [1.5, [2]]])


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -np.inf, np.float64("nan"), "\ud800", {"\udfff": 1}])
def test_what_json_does_not_know_is_refused(bad):
    for content in (bad, [1.0, bad], {"a": {"b": (bad,)}}):
        with pytest.raises(ValueError, match=r"not JSON compliant|surrogates not allowed"):
            _digits.json(content)


@pytest.mark.parametrize("bad", [{1}, np.zeros(2), np.float32(1), np.int64(1), np.bool_(1), b"", {1: 2}, OrderedDict()])
def test_other_kinds_are_refused(bad):
    with pytest.raises(TypeError, match=r"not JSON serializable|keys must be str"):
        _digits.json({"a": [bad]})


def test_what_holds_itself_is_refused():
    content: list[object] = []
    content.append({"again": content})
    with pytest.raises(RecursionError):
        _digits.json(content)


def test_without_integers_of_128_bits_the_numbers_are_the_same():
    """A process that has not given C its powers of ten writes numbers as one on a machine that cannot use them."""
    numbers = np.random.default_rng(2).integers(0, 2**64, 2000, dtype=np.uint64).view(np.float64)
    numbers = [*numbers[np.isfinite(numbers)].tolist(), 0.0, -0.0, 1e16, 1e-5, 5e-324, 0.1, 100.0]
    code = (
        "import struct, sys; from imulab.writers import _digits; data = sys.stdin.buffer.read();"
        "sys.stdout.buffer.write(_digits.json(struct.unpack(f'{len(data) // 8}d', data))[0])"
    )
    packed = struct.pack(f"{len(numbers)}d", *numbers)
    found = subprocess.run([sys.executable, "-c", code], input=packed, capture_output=True, check=True).stdout
    assert found == compact(numbers).encode()

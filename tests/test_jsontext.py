"""The texts of a record against those of the standard library, to the byte."""

import hashlib
import json

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from imulab.records.calibration import content_sha256, json_text, sealed_bytes, sealed_text

finite = st.floats(allow_nan=False, allow_infinity=False)
whole = st.integers() | st.integers(-(2**70), 2**70)
unicode = st.text(st.characters(exclude_categories=["Cs"]))
values = st.recursive(
    st.none() | st.booleans() | whole | finite | unicode,
    lambda inner: st.lists(inner) | st.lists(inner).map(tuple) | st.dictionaries(unicode, inner),
    max_leaves=40,
)


@given(st.dictionaries(unicode, values))
def test_the_hash_is_of_the_compact_text_and_the_last_key_of_the_file(content):
    content.pop("content_sha256", None)
    plain = {**content, "format": "imulab.calibration"}
    sha256, text = sealed_text(plain)
    whole = {**plain, "content_sha256": sha256}
    assert text == json_text(whole)
    assert list(json.loads(text))[-1] == "content_sha256"
    assert json.loads(text) == json.loads(json.dumps(whole))
    compact = json.dumps(plain, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    assert sha256 == hashlib.sha256(compact.encode()).hexdigest()
    assert content_sha256(whole) == sha256


def test_the_text_is_indented_by_one_with_letters_as_they_are():
    content = {"é": [1e-05, 1e16, 0.1, -0.0, True, None], "a": {}, "b": [], "c": "\x00\u2028"}
    assert json_text(content) == (
        '{\n "é": [\n  1e-05,\n  1e+16,\n  0.1,\n  -0.0,\n  true,\n  null\n ],\n'
        ' "a": {},\n "b": [],\n "c": "\\u0000\u2028"\n}\n'
    )


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -np.inf, np.float64("nan"), "\ud800", {"\udfff": 1}])
def test_what_json_does_not_know_is_refused(bad):
    for content in ({"a": bad}, {"a": [1.0, bad]}, {"a": {"b": (bad,)}}):
        with pytest.raises(ValueError, match=r"not JSON compliant|surrogates not allowed"):
            sealed_text(content)


@pytest.mark.parametrize("bad", [{1}, np.zeros(2), np.float32(1), np.int64(1), np.bool_(1), b""])
def test_other_kinds_are_refused(bad):
    with pytest.raises(TypeError, match="not JSON serializable"):
        sealed_text({"a": [bad]})


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])  # a busy machine is no fault
@given(st.dictionaries(unicode, values))
def test_the_bytes_of_a_file_are_rearranged_to_what_the_hash_is_of(content):
    content.pop("content_sha256", None)
    content["format"] = "imulab.calibration"
    sha256, text = sealed_text(content)
    rearranged = sealed_bytes(text.encode())
    if rearranged is None:  # a key has an escape
        assert "\\" in text
    else:
        assert rearranged.decode() == json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
        assert hashlib.sha256(rearranged).hexdigest() == sha256


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])  # a busy machine is no fault
@given(st.lists(finite | whole | st.floats(1e-9, 1e-3) | st.floats(1e15, 1e25)))
def test_numbers_are_read_as_the_standard_library_reads_them(numbers):
    text = json.dumps([*numbers, 1e-07, 1e22, -0.0, 5e-324, 1.7976931348623157e308, 2.2250738585072011e-308])
    assert list(map(repr, msgspec.json.decode(text))) == list(map(repr, json.loads(text)))


@pytest.mark.parametrize(
    "text",
    [
        '{"a": 1, "a": 2, "content_sha256": "0"}',
        '{"b": {"a": 1, "a": 2}, "content_sha256": "0"}',
        '{"b": [{"a": 1, "a": 1}], "content_sha256": "0"}',
        '{"content_sha256": "1", "b": 1, "content_sha256": "0"}',
        '{"b": 1, "\\u0061": 1, "a": 1, "content_sha256": "0"}',
    ],
)
def test_a_key_that_appears_twice_is_never_rearranged_away(text):
    assert sealed_bytes(text.encode()) is None


def test_spaces_outside_of_texts_alone_are_left_out():
    text = '{"content_sha256": "0",\r\n"b":\t[ 1e-07,\n 2.50 ],"a b": {"d": " x  y", "c": [ ], "e": {}}, "f": [" z "]}'
    assert sealed_bytes(text.encode()) == b'{"a b":{"c":[],"d":" x  y","e":{}},"b":[1e-07,2.50],"f":[" z "]}'

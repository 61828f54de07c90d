"""The record: what is written, what is refused, and that files appear whole or not at all."""

import hashlib
import json
import os
import re
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import imulab as il
from imulab.cli import main
from imulab.errors import OptionError, RecordError
from imulab.files import replacing, write_text
from imulab.procedures.apply import loaded, tables_of
from imulab.procedures.registry import load, loads, loads_sealed
from imulab.procedures.views import exhibits_of
from imulab.recording import Source
from imulab.records.calibration import (
    Calibration,
    Covariance,
    Parameter,
    content_sha256,
    json_text,
    sealed_bytes,
    sealed_text,
)
from imulab.records.reading import parsed

FIXED = settings(derandomize=True, database=None, deadline=None, max_examples=200)


def record(**changes) -> Calibration:
    made = Calibration(
        procedure="tumble",
        parameters={
            "bias_x": Parameter(-0.0123456789012345, 3.1e-05, "m/s^2"),
            "scale_factor_x": Parameter(1.0, None, "count/(m/s^2)"),
        },
        covariance=Covariance(("bias_x",), ((9.61e-10,),)),
        model={"order": 2, "gravity": {"value": 9.81362, "unit": "m/s^2", "from": "argument"}, "output_unit": "count"},
        fit={"method": "norm", "attitudes": 38, "reduced_chi_square": None, "converged": True},
        options={"order": "auto", "gravity": 9.81362},
        data={"mean": [[1.5, -2.5e-300], [1e22, 0.1]], "note": 'quote " backslash \\ é \U0001f6f0'},
        sensor={"serial": "SN42", "model": "Würfel"},
        sources=(Source("tumble.csv", "0" * 64),),
        warnings=("first.", "second."),
        created="2026-11-20T12:00:00Z",
        sections={"levels": [{"level": 1, "runs": [1, 2]}]},
    )
    return replace(made, **changes)


TEXT = record().to_json().encode()


def canonical(value: object) -> str:
    """The contract's rule for the bytes that are hashed, written out: keys sorted, no spaces, UTF-8."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        short = {'"': '\\"', "\\": "\\\\", "\n": "\\n", "\r": "\\r", "\t": "\\t", "\b": "\\b", "\f": "\\f"}
        return '"' + "".join(short.get(c, f"\\u{ord(c):04x}" if c < " " else c) for c in value) + '"'
    if isinstance(value, list):
        return "[" + ",".join(map(canonical, value)) + "]"
    assert isinstance(value, dict)
    return "{" + ",".join(f"{canonical(key)}:{canonical(value[key])}" for key in sorted(value)) + "}"


def sealed(content: dict) -> bytes:
    """A record with whatever content and the hash that belongs to it."""
    rest = {key: value for key, value in content.items() if key != "content_sha256"}
    digest = hashlib.sha256(canonical(rest).encode("utf-8")).hexdigest()
    return json.dumps({**rest, "content_sha256": digest}, ensure_ascii=False).encode()


DATED = (
    ({"date": "2026-11-24T23:10:05"}, "2026-11-24"),
    ({"epoch": "1764025805.000000000 s"}, "2025-11-24T23:10:05Z"),
    ({"epoch": "86.000000000 s after midnight"}, None),
    ({"date": "on Tuesday"}, None),
)


@pytest.mark.parametrize(("head", "expected"), DATED, ids=["day", "epoch", "time of day", "words"])
def test_the_day_of_a_recording_is_kept_and_read_back(tmp_path, head, expected):
    rows = il.Recording.from_arrays(mag=np.zeros((3, 3)), rate=10.0, unit="uT")
    il.write_csv(replace(rows, metadata=head), tmp_path / "dated.csv")
    source = il.read(tmp_path / "dated.csv").source
    content = json.loads(record(sources=(source,)).to_json())
    assert content["sources"][0].get("measured") == expected
    assert loads(sealed(content), "r.json").sources[0].measured == expected


def dated(folder):
    """Write the day into the head of every recording of a folder."""
    for path in folder.glob("*.csv"):
        path.write_text("# date: 2026-11-24T08:00:00\n" + path.read_text(encoding="utf-8"), encoding="utf-8")


@pytest.mark.parametrize(
    ("simulate", "fit"),
    [
        ("noise simulate --duration 30 --white 0.3deg/sqrt(h) --columns gyro_z -o t/rest.csv", "noise fit t/rest.csv"),
        (
            "warmup simulate --temperatures 0,20 --cycles 2 -o t",
            "warmup fit t/cycle_+0_1.csv t/cycle_+20_1.csv --temperatures 0,20",
        ),
        (
            "centrifuge simulate --levels 1,5 --cycles 1 --duration 60 --static-duration 20 -o t",
            "centrifuge reduce t/manifest.toml",
        ),
    ],
    ids=["noise", "warmup", "centrifuge"],
)
def test_the_day_is_kept_by_procedures_that_read_in_blocks(tmp_path, monkeypatch, simulate, fit):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "t").mkdir()
    assert main([*simulate.split(), "-q"]) == 0
    dated(tmp_path / "t")
    assert main([*fit.split(), "-o", "rec.json", "-q"]) == 0
    days = {source.measured for source in il.load("rec.json").sources if source.file.endswith(".csv")}
    assert days == {"2026-11-24"}


@pytest.mark.parametrize("day", ["", "yesterday", "2026-13-01", "2026-11-24 10:00", 7])
def test_a_day_that_is_none_is_refused(day):
    content = json.loads(TEXT)
    content["sources"][0]["measured"] = day
    with pytest.raises(RecordError, match="measured: expected"):
        parsed(sealed(content), "r.json")


# --- what is written -------------------------------------------------------------------------------------------


def test_a_record_is_the_json_of_the_design():
    content = json.loads(TEXT)
    assert content["format"] == "imulab.calibration"
    assert content["version"] == 1
    assert content["procedure"] == "tumble"
    assert content["sources"] == [{"file": "tumble.csv", "sha256": "0" * 64}]
    assert content["parameters"]["bias_x"] == {
        "value": -0.0123456789012345,
        "standard_uncertainty": 3.1e-05,
        "unit": "m/s^2",
    }
    assert content["parameters"]["scale_factor_x"]["standard_uncertainty"] is None
    assert content["covariance"] == {"names": ["bias_x"], "matrix": [[9.61e-10]]}
    assert content["levels"] == [{"level": 1, "runs": [1, 2]}]
    assert {"sensor", "created", "software", "model", "options", "data", "fit", "warnings"} < set(content)
    assert "sections" not in content


def test_the_content_hash_follows_the_contract_to_the_byte():
    content = json.loads(TEXT)
    stated = content.pop("content_sha256")
    assert stated == hashlib.sha256(canonical(content).encode("utf-8")).hexdigest()
    assert content_sha256({**content, "content_sha256": "anything"}) == stated
    assert content_sha256(dict(reversed(content.items()))) == stated


def test_a_record_comes_back_as_it_was_saved(tmp_path):
    path = tmp_path / "sn42.json"
    record().save(path)
    back = load(path)
    assert back == record()
    assert back.to_json().encode() == path.read_bytes() == TEXT
    assert back.value("bias_x") == -0.0123456789012345
    assert back.covariance.array().tolist() == [[9.61e-10]]


FINITE = st.floats(-1e100, 1e100)


SIZE = st.floats(0, 1e100)


# Hidden characters are told in test_forged.
WORDS = st.text(st.characters(exclude_categories=["Cs", "Cc", "Cf", "Zl", "Zp"]), max_size=12)


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**60), 2**60) | FINITE | WORDS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(WORDS, inner, max_size=3),
    max_leaves=8,
)


@pytest.mark.slow
@FIXED
@given(
    st.dictionaries(WORDS, st.builds(Parameter, FINITE, st.none() | SIZE, WORDS), max_size=3),
    st.dictionaries(WORDS, PLAIN, max_size=3),
    st.dictionaries(WORDS, WORDS, max_size=2),
    st.lists(WORDS, max_size=2),
    PLAIN,
)
def test_any_record_comes_back_as_it_was_saved(parameters, data, sensor, warnings, section):
    before = record(
        parameters=parameters, covariance=Covariance((), ()), data=data, sensor=sensor, warnings=tuple(warnings),
        sections={"table": section},
    )  # fmt: skip
    text = before.to_json()
    after, _ = parsed(text.encode(), "r")  # what a procedure makes of its parts is told elsewhere
    assert after == before
    assert after.to_json() == text
    content = json.loads(text)
    assert sealed(content) == json.dumps(content, ensure_ascii=False).encode()


def test_arrays_and_numpy_numbers_are_written_as_plain_json():
    data = {"a": np.array([[1.5, 2.0]]), "b": np.float32(0.5), "c": np.int64(3), "d": np.bool_(True), "e": (1, 2)}
    assert json.loads(record(data=data).to_json())["data"] == {
        "a": [[1.5, 2.0]],
        "b": 0.5,
        "c": 3,
        "d": True,
        "e": [1, 2],
    }


def test_a_record_says_when_and_by_what_it_was_made():
    made = Calibration("tumble", {}, Covariance((), ()), {}, {})
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", made.created)
    age = datetime.now(UTC) - datetime.strptime(made.created, "%Y-%m-%dT%H:%M:%SZ").replace(tzinfo=UTC)
    assert timedelta(0) <= age < timedelta(minutes=1)
    assert re.fullmatch(r"imulab \d+\.\d+\.\d+.*", made.software)


def test_a_printed_record_shows_values_with_their_uncertainty_and_unit():
    lines = str(record()).splitlines()
    assert lines[0] == "tumble calibration of SN42"
    assert "  bias_x = -0.0123456789 ± 3.1e-05 m/s^2" in lines
    assert "  scale_factor_x = 1 count/(m/s^2)" in lines


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), np.float32("nan")])
@pytest.mark.parametrize(
    ("field", "make", "place"),
    [
        ("parameters", lambda x: {"bias_x": Parameter(x, 1.0, "g")}, "parameters.bias_x.value"),
        ("parameters", lambda x: {"bias_x": Parameter(1.0, x, "g")}, "parameters.bias_x.standard_uncertainty"),
        ("covariance", lambda x: Covariance(("a", "b"), ((1.0, 0.0), (x, 1.0))), "covariance.matrix[1][0]"),
        ("fit", lambda x: {"rms": {"value": x}}, "fit.rms.value"),
        ("data", lambda x: {"trace": [{"v": np.array([0.0, 1.0, x])}]}, "data.trace[0].v[2]"),
        ("sections", lambda x: {"table": [[1], [x]]}, "table[1][0]"),
    ],
)
def test_a_number_that_is_not_finite_is_refused_and_nothing_is_written(tmp_path, field, make, place, bad):
    with pytest.raises(RecordError) as caught:
        record(**{field: make(bad)}).save(tmp_path / "sn42.json")
    assert str(caught.value) == f"record: {place} is {float(bad)}; a record holds finite numbers only"
    assert list(tmp_path.iterdir()) == []


# --- what is refused -------------------------------------------------------------------------------------------


def accepted_or_refused(data: bytes) -> None:
    """An altered file is refused in one line that names it, unless its content is the same to the last bit."""
    message = None
    try:
        loads(data, "sn42.json")
    except RecordError as error:
        message = str(error)
    if message is None:
        assert canonical(json.loads(data)) == canonical(json.loads(TEXT))
    else:
        assert message.startswith("sn42.json: ")
        assert "\n" not in message


def test_no_byte_can_be_altered():
    for position in range(len(TEXT)):
        for flipped in (1, 2, 8, 16, 128):
            accepted_or_refused(TEXT[:position] + bytes([TEXT[position] ^ flipped]) + TEXT[position + 1 :])


@FIXED
@given(st.integers(0, len(TEXT) - 1), st.binary(max_size=3), st.integers(0, 3))
def test_no_bytes_can_be_replaced_inserted_or_dropped(position, new, dropped):
    accepted_or_refused(TEXT[:position] + new + TEXT[position + dropped :])


@pytest.mark.parametrize("number", [b"-0.0123456789012345", b"3.1e-05", b"9.81362", b"9.61e-10", b"38", b"-2.5e-300"])
def test_no_digit_of_a_number_can_be_altered(number):
    start = TEXT.index(number)
    for position in range(start, start + len(number)):
        for digit in b"0123456789":
            if digit != TEXT[position]:
                with pytest.raises(RecordError, match=r"^sn42\.json: .*altered"):
                    loads(TEXT[:position] + bytes([digit]) + TEXT[position + 1 :], "sn42.json")


def test_a_record_that_was_cut_is_refused():
    whole = TEXT.rstrip()
    for length in range(len(whole)):
        with pytest.raises(
            RecordError, match=r"^sn42\.json: not a calibration record: it is (cut or altered|not JSON|empty)"
        ):
            loads(whole[:length], "sn42.json")
    with pytest.raises(RecordError, match="it is cut or altered"):
        loads(whole[: len(whole) // 2], "sn42.json")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "it is empty"),
        (b"time [s],accel_x [g]\n0,1\n", "it is not JSON"),
        (b"\x89PNG\r\n\x1a\n\0\0", "it is not JSON"),
        (b"[" * 100_000, "it is not JSON"),
        (b"%PDF-1.7\n", "it is a PDF (a certificate?); expected the record that it was made of"),
        (
            b'<?xml version="1.0"?>\n<dcc:digitalCalibrationCertificate>',
            "it is a certificate; expected the record that it was made of",
        ),
        (b"[1, 2]", 'expected the key "format": "imulab.calibration"'),
        (b'"imulab.calibration"', 'expected the key "format"'),
        (b'{"format": "other"}', 'expected the key "format"'),
        (b"{}", 'expected the key "format"'),
        (TEXT.replace(b"9.81362", b"NaN"), "NaN is not a finite number"),
        (TEXT.replace(b"9.81362", b"1e999"), "altered"),
        (TEXT.replace(b'"order": 2', b'"order": 2, "order": 2'), "a key appears twice"),
        (re.sub(rb',\s*"content_sha256": "[0-9a-f]+"', b"", TEXT), "the record has no content_sha256"),
        (TEXT.replace(b"SN42", b"SN43"), "was altered after it was written (its content_sha256 does not match)"),
        (TEXT.replace(b"SN42", b"\\ud800"), "altered"),
    ],
)
def test_what_is_no_record_or_was_altered_is_refused_with_the_reason(data, message):
    with pytest.raises(RecordError) as caught:
        loads(data, "sn42.json")
    assert str(caught.value).startswith("sn42.json: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_newer_version_is_refused_by_name_before_anything_else():
    newer = {"format": "imulab.calibration", "version": 7, "matrices": "elsewhere"}
    with pytest.raises(RecordError) as caught:
        loads(json.dumps(newer).encode(), "sn42.json")
    assert "sn42.json: record version 7 is newer than version 1, which imulab " in str(caught.value)
    assert "update imulab" in str(caught.value)


@pytest.mark.parametrize("version", [0, -1, "1", 1.0, True, None])
def test_a_version_that_is_none_is_refused(version):
    with pytest.raises(RecordError, match=re.escape(f"sn42.json: expected a version number from 1, found {version!r}")):
        loads(sealed({**json.loads(TEXT), "version": version}), "sn42.json")


def test_a_record_of_an_unknown_procedure_is_refused_where_the_procedure_is_needed(tmp_path):
    record = loads(sealed({**json.loads(TEXT), "procedure": "levelling"}), "sn42.json")
    message = "unknown procedure 'levelling'; known procedures: tumble gyro_array warmup centrifuge"
    for use in (exhibits_of, tables_of, loaded, lambda record: il.write_report(record, tmp_path / "r.html")):
        with pytest.raises(RecordError, match=message):
            use(record)


@pytest.mark.parametrize(
    "key", ["procedure", "sensor", "created", "software", "sources", "model", "parameters", "covariance", "fit"]
)
def test_a_record_that_lacks_a_part_is_refused(key):
    content = {name: value for name, value in json.loads(TEXT).items() if name != key}
    with pytest.raises(RecordError, match=f"the record lacks '{key}'"):
        loads(sealed(content), "sn42.json")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"covariance": {"names": ["a", "b"], "matrix": [[1.0, 2.0]]}}, "covariance: expected a 2 x 2 matrix"),
        ({"covariance": {"names": ["a"], "matrix": [[1.0, 2.0]]}}, "covariance: expected a 1 x 1 matrix"),
        ({"covariance": {"names": [], "matrix": [[1.0]]}}, "covariance: expected a 0 x 0 matrix"),
        (
            {"parameters": {"bias_x": {"value": "much", "standard_uncertainty": 1, "unit": "g"}}},
            "parameters.bias_x.value",
        ),
        (
            {"parameters": {"bias_x": {"value": 1.0, "unit": "g"}}},
            "the record lacks parameters.bias_x.standard_uncertainty",
        ),
        ({"parameters": {"bias_x": 3.5}}, "parameters.bias_x: "),
        ({"sensor": {"serial": 42}}, "sensor.serial: "),
        ({"sources": {"file": "tumble.csv"}}, "sources: "),
        ({"warnings": "one"}, "warnings: "),
    ],
)
def test_a_part_of_the_wrong_kind_is_refused_with_its_place(changes, message):
    with pytest.raises(RecordError) as caught:
        loads(sealed({**json.loads(TEXT), **changes}), "sn42.json")
    assert str(caught.value).startswith(f"sn42.json: {message}")
    assert "\n" not in str(caught.value)


def test_a_record_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(RecordError, match=r"absent\.json: no such file"):
        load(tmp_path / "absent.json")
    with pytest.raises(RecordError, match="expected a file, found a folder"):
        load(tmp_path)


# --- files, whole or not at all --------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, MemoryError])
def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path, error):
    path = tmp_path / "out.csv"
    path.write_bytes(b"old")
    with pytest.raises(error), replacing(path) as stream:  # noqa: PT012
        stream.write(b"half of the new")
        stream.flush()
        raise error
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_old_file_stays_until_the_new_one_is_complete(tmp_path):
    path = tmp_path / "out.csv"
    path.write_bytes(b"old")
    with replacing(path) as stream:
        stream.write(b"new")
        stream.flush()
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_refused_record_leaves_the_old_one(tmp_path):
    path = tmp_path / "sn42.json"
    record().save(path)
    with pytest.raises(RecordError):
        record(fit={"rms": float("nan")}).save(path)
    assert load(path) == record()
    assert list(tmp_path.iterdir()) == [path]


def test_a_place_that_cannot_be_written_is_refused(tmp_path):
    with pytest.raises(OptionError, match=r"absent/r\.json: cannot be written: No such file or directory"):
        record().save(tmp_path / "absent" / "r.json")
    with pytest.raises(OptionError, match="expected the name of a file to write, found a folder"):
        record().save(tmp_path)


@pytest.mark.parametrize("mask", [0o022, 0o077, 0o002])
def test_a_new_file_has_the_permissions_of_the_umask(tmp_path, mask):
    before = os.umask(mask)
    try:
        write_text(tmp_path / "a.txt", "é")
    finally:
        os.umask(before)
    assert (tmp_path / "a.txt").stat().st_mode & 0o777 == 0o666 & ~mask
    assert (tmp_path / "a.txt").read_bytes() == b"\xc3\xa9"


def test_a_file_may_have_the_longest_name_that_the_folder_takes(tmp_path):
    name = "n" * (os.pathconf(tmp_path, "PC_NAME_MAX") - 5) + ".json"
    record().save(tmp_path / name)
    assert load(tmp_path / name) == record()


def test_the_text_of_a_record_is_that_of_the_standard_library():
    content = {
        "text": "µ \"quoted\" \n\x01 \u2028", "": {}, "none": None, "truth": [True, False], "empty": [],
        "deep": [[], [{}]],
        "numbers": [1, 2.5, -0.0, 1e-300, 1e22, 123456789.123456789, 5e-324], "floats": [0.1, 1e100], "whole": 2**70,
        "rows": [[1.0, 2.0], [3.0, None]], "nested": {"a": {"b": [1, {"c": "d"}]}},
        "many": [*np.random.default_rng(1).standard_normal(500).tolist(), -0.0, 0.0, 5e-324, 1e16, 1e-5, -1.7e308],
    }  # fmt: skip
    assert json_text(content) == json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def test_the_sealed_text_is_the_record_with_its_hash():
    sha256, text = record(data={"b": {"z": 1, "a": [0.1] * 100}, "a": "µ"}).sealed()
    content = json.loads(text)
    assert list(content)[-1] == "content_sha256"
    assert content["content_sha256"] == content_sha256(content) == sha256
    assert text == json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    assert loads_sealed(text.encode(), "r.json")[1] == sha256


finite = st.floats(allow_nan=False, allow_infinity=False)


whole = st.integers() | st.integers(-(2**70), 2**70)


unicode = st.text(st.characters(exclude_categories=["Cs"]))


values = st.recursive(
    st.none() | st.booleans() | whole | finite | unicode,
    lambda inner: st.lists(inner) | st.lists(inner).map(tuple) | st.dictionaries(unicode, inner),
    max_leaves=40,
)


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])  # a busy machine is no fault
@given(st.dictionaries(unicode, values))
def test_the_hash_is_of_the_compact_text_and_the_last_key_of_the_file(content):
    content.pop("content_sha256", None)
    plain = {**content, "format": "imulab.calibration"}
    sha256, text = sealed_text(plain)
    whole = {**plain, "content_sha256": sha256}
    assert text == json_text(whole) == json.dumps(whole, indent=1, ensure_ascii=False) + "\n"
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

"""The verdict on a result, where it is seen: in records, on the terminal, at the head of a report."""

import json
import re
from dataclasses import replace

import pytest

import imulab as il
from imulab.display import Bad, Note, Verdict, verdict_of
from imulab.errors import RecordError
from imulab.procedures.registry import loads
from imulab.procedures.tumble.simulate import simulate_tumble
from imulab.records.calibration import content_sha256


@pytest.fixture(scope="module")
def record():
    recording = simulate_tumble(attitudes=15, order=1, hold=3.0, gravity=9.81, seed=2)
    return il.fit_tumble(il.find_attitudes(recording), order=1, gravity=9.81).calibration


@pytest.mark.parametrize(
    ("findings", "expected"),
    [
        ((), Verdict("good")),
        ((Note("the head's gravity was used"),), Verdict("good")),
        (("look here", Note("by the way")), Verdict("look", ("look here",))),
        (("look here", Bad("wrong unit")), Verdict("bad", ("wrong unit", "look here"))),
    ],
)
def test_the_gravest_finding_decides(findings, expected):
    assert verdict_of(findings) == expected
    assert verdict_of(iter(findings)) == expected


def test_a_record_keeps_its_verdict(record, tmp_path):
    bad = replace(record, warnings=(Bad("wrong unit"), Note("by the way")), verdict=verdict_of((Bad("wrong unit"),)))
    bad.save(tmp_path / "r.json")
    stored = json.loads((tmp_path / "r.json").read_text())
    assert stored["verdict"] == {"state": "bad", "reasons": ["wrong unit"]}
    assert il.load(tmp_path / "r.json").verdict == Verdict("bad", ("wrong unit",))


def test_findings_are_what_they_were_when_a_record_is_read_and_judged_anew(record, tmp_path):
    findings = (Note("by the way"), "look here", Bad("wrong unit"))
    for said in (findings, findings[:2], findings[:1]):
        replace(record, warnings=said, verdict=verdict_of(said)).save(tmp_path / "r.json")
        read = il.load(tmp_path / "r.json")
        assert list(map(type, read.warnings)) == list(map(type, said))
        assert verdict_of(read.warnings) == verdict_of(said)


def test_gyroscopes_do_not_make_doubts_of_notes(record, imulab, tmp_path):
    imulab("tumble", "simulate", "-o", "t.csv", "--attitudes", "20", "--hold", "3", "--order", "1")
    imulab("tumble", "fit", "t.csv", "--order", "1", "-o", "t.json")  # gravity of the head: a note
    imulab("tumble", "gyro", "t.csv", "--accel", "t.json", "-o", "g.json")
    one, both = (il.load(tmp_path / name) for name in ("t.json", "g.json"))
    noted = [w for w in one.warnings if w not in one.verdict.reasons]
    assert noted
    assert not set(noted) & set(both.verdict.reasons)


def test_records_from_before_there_were_verdicts_are_judged_by_their_warnings(record):
    content = {key: value for key, value in record.to_dict().items() if key not in ("verdict", "content_sha256")}
    content["warnings"] = ["the head of the file is odd"]
    content["content_sha256"] = content_sha256(content)
    assert loads(json.dumps(content).encode(), "old.json").verdict == Verdict("look", ("the head of the file is odd",))


def test_a_verdict_that_cannot_be_is_refused(record):
    content = {key: value for key, value in record.to_dict().items() if key != "content_sha256"}
    content["verdict"] = {"state": "splendid", "reasons": []}
    content["content_sha256"] = content_sha256(content)
    with pytest.raises(RecordError, match=r"odd\.json: verdict\.state: .*'splendid'"):
        loads(json.dumps(content).encode(), "odd.json")


@pytest.mark.parametrize(
    ("findings", "state", "said"),
    [
        ((), "good", "nothing in the data speaks against this result"),
        (("a thing to look at", "another"), "look", "a thing to look at (and 1 more: see the warnings)"),
        ((Bad("the unit is wrong"),), "bad", "do not use this result as it is: the unit is wrong"),
    ],
)
def test_show_and_the_report_begin_with_it(record, imulab, tmp_path, findings, state, said):
    judged = replace(record, warnings=tuple(findings), verdict=verdict_of(findings))
    judged.save(tmp_path / "r.json")
    first = imulab("show", "r.json").stdout.splitlines()[0]
    assert first.startswith(f"{state}: ")
    assert said in first
    il.write_report(judged, tmp_path / "r.html")
    page = re.sub(r"<(script|style)>.*?</\1>", "", (tmp_path / "r.html").read_text(), flags=re.DOTALL)
    assert 0 < page.index(f'class="verdict {state}"') < page.index("After calibration")
    assert all(finding in page for finding in findings)


def test_a_fit_prints_it_first(imulab, tmp_path):
    imulab("tumble", "simulate", "-o", "t.csv", "--attitudes", "20", "--hold", "3", "--order", "1")
    done = imulab("tumble", "fit", "t.csv", "--order", "1", "-o", "t.json")  # no gravity given
    assert done.stderr.startswith("imulab: note: gravity 9.80665 m/s^2 was taken from the head of t.csv")
    stored = json.loads((tmp_path / "t.json").read_text())["verdict"]
    assert done.stdout.startswith(f"{stored['state']}: ")

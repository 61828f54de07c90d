"""The verdict on a result, where it is seen: in records, on the terminal, at the head of a report."""

import ast
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

import imulab as il
from imulab.cli import main
from imulab.display import Bad, Finding, Note, Verdict, action_of, join_alike, verdict_of
from imulab.errors import RecordError
from imulab.procedures.registry import loads
from imulab.procedures.tumble.simulate import simulate_tumble
from imulab.records.calibration import content_sha256

LOOK = "look at the figures of the report (--report FILE.html) for what the reasons name"


@pytest.fixture(scope="module")
def record():
    recording = simulate_tumble(attitudes=15, order=1, hold=3.0, gravity=9.81, seed=2)
    return il.fit_tumble(il.find_attitudes(recording), order=1, gravity=9.81).calibration


@pytest.mark.parametrize(
    ("findings", "expected"),
    [
        ((), Verdict("good")),
        ((Note("the head's gravity was used"),), Verdict("good")),
        (("a: turn it", Note("by the way")), Verdict("look", ("a: turn it",), ("turn it",))),
        (
            ("a: turn it", Bad("wrong unit", "state it")),
            Verdict("bad", ("wrong unit", "a: turn it"), ("state it", "turn it")),
        ),
        (("a: turn it", "b: turn it"), Verdict("look", ("a: turn it", "b: turn it"), ("turn it",))),
        (("odd (p .1; turn it)",), Verdict("look", ("odd (p .1; turn it)",), (LOOK,))),
    ],
)
def test_the_gravest_finding_decides(findings, expected):
    assert verdict_of(findings) == expected
    assert verdict_of(iter(findings)) == expected


def test_a_record_keeps_its_verdict(record, tmp_path):
    findings = (Bad("wrong unit", "state it with --unit"), Note("by the way"))
    bad = replace(record, warnings=findings, verdict=verdict_of(findings))
    bad.save(tmp_path / "r.json")
    stored = json.loads((tmp_path / "r.json").read_text())
    assert stored["verdict"] == {"state": "bad", "reasons": ["wrong unit"], "next": ["state it with --unit"]}
    kept = il.load(tmp_path / "r.json")
    assert kept.verdict == verdict_of(kept.warnings) == Verdict("bad", ("wrong unit",), ("state it with --unit",))


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
    assert loads(json.dumps(content).encode(), "old.json").verdict == Verdict(
        "look", ("the head of the file is odd",), (LOOK,)
    )


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


G = "9.81362"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("second")
    for name, seed in (("a", 2), ("b", 1)):
        recording = il.simulate_tumble(attitudes=24, order=1, hold=3.0, gravity=float(G), seed=seed)
        il.write(recording, folder / f"{name}.csv")
    record = il.fit_tumble(il.find_attitudes(il.read(folder / "a.csv")), order=1, gravity=float(G)).calibration
    record.save(folder / "a.json")
    bad = (Bad("the unit is wrong"),)
    replace(record, warnings=bad, verdict=verdict_of(bad)).save(folder / "bad.json")
    return folder


@pytest.fixture
def run(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)

    def command(*words):
        status = main(list(words))
        found = capsys.readouterr()
        return status, found.out, found.err

    return command


def test_a_record_that_must_not_be_used_says_so_wherever_it_is_used(run, tmp_path):
    for words in (
        ["apply", "bad.json", "a.csv", "-o", str(tmp_path / "c.csv")],
        ["export", "--to", "c", "bad.json", "-o", str(tmp_path / "fw")],
    ):
        status, _, said = run(*words)
        assert status == 0
        assert "verdict is bad, do not use this result as it is: the unit is wrong" in said
    assert "verdict" not in run("apply", "a.json", "a.csv", "-o", str(tmp_path / "c.csv"))[2]


def test_a_fit_to_a_corrected_recording_says_what_it_is(run, tmp_path):
    corrected = str(tmp_path / "corrected.csv")
    assert run("apply", "a.json", "a.csv", "-o", corrected)[0] == 0
    _, out, _ = run("tumble", "fit", corrected, "--order", "1", "--gravity", G)
    assert out.startswith("look: ")
    assert "the recording was corrected by a.json: what is found is what that left" in out


def test_another_window_of_the_same_file_is_another_recording(run, tmp_path):
    first = str(tmp_path / "first.json")
    assert run("tumble", "fit", "a.csv", "--window", ":62", "--order", "1", "--gravity", G, "-o", first)[0] == 0
    assert run("tumble", "check", first, "a.csv", "--window", "62:", "--gravity", G)[1].startswith("pass: ")
    assert "was made from this recording" in run("tumble", "check", first, "a.csv", "--gravity", G)[2]
    assert run("tumble", "fit", "a.csv", "--window", "62:", "--prior", first, "--gravity", G)[0] == 0
    status, _, said = run("tumble", "fit", "a.csv", "--window", ":50", "--prior", first, "--gravity", G)
    assert status == 2
    assert "which would count twice" in said


def test_a_prior_of_another_sensor_leaves_a_result_that_must_not_be_used(run):
    status, out, said = run("tumble", "fit", "b.csv", "--prior", "a.json", "--ageing", "0ug,0ppm,0urad")
    assert status == 0
    assert out.startswith("bad: ")
    assert re.search(
        r"no ageing of bias, .* they miss the result by [\d.e+]+ µg rms, \d+ times their uncertainty", said
    )
    assert "fit without the prior" in said


def test_a_limit_below_the_noise_is_not_taken_for_a_change(run):
    status, out, _ = run("tumble", "check", "a.json", "a.csv", "--limit", "1ug", "--gravity", G)
    assert status == 1
    assert "no change of the unit is shown, but an attitude is beyond the limit\n" in out
    assert "the limit is smaller than the uncertainty of the attitudes can tell" in out


def test_a_plan_for_the_noise_of_a_recording_takes_no_model_error_for_noise(run, tmp_path):
    curved = str(tmp_path / "curved.csv")
    assert run("tumble", "simulate", "--order", "2", "--gravity", G, "-o", curved)[0] == 0
    _, out, _ = run("tumble", "plan", "--attitudes", "24", "--noise", curved)
    noise = re.search(r"noise of ([\d.]+) µg in \|f\|", out)
    assert noise is not None
    assert 20 < float(noise[1]) < 60  # 0.7 mg in each of 500 samples; k2 leaves 690 µg at order 1


@pytest.mark.parametrize(("option", "words"), [("--gravity=1g", "gravity to 29 %"), ("--gravity=10", "gravity to 3 %")])
def test_a_gravity_that_is_hardly_known_is_refused(run, option, words):
    status, _, said = run("tumble", "fit", "a.csv", option)
    assert status == 2
    assert words in said


def test_what_to_do_next_stands_after_the_state_everywhere(record, imulab, tmp_path):
    findings = (Bad("the unit is wrong", "state it: <g>"), Finding("a hold was knocked", "measure it again"))
    judged = replace(record, warnings=findings, verdict=verdict_of(findings))
    judged.save(tmp_path / "r.json")
    assert imulab("show", "r.json").stdout.splitlines()[1:3] == ["next: state it: <g>", "next: measure it again"]
    assert "\nnext: state it: <g>\n" in repr(judged)
    assert "<b>next:</b> measure it again" in judged._repr_html_()
    il.write_report(judged, tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text()
    assert page.index("<li>a hold was knocked</li>") < page.index("<b>next:</b> state it: &lt;g&gt;")


MESSAGES = {"messages", "warnings", "notes", "lines", "named"}
NO_FINDINGS = re.compile(r"plan|simulate|figures|manifest|schema|views|apply|device")


def _texts(node):
    """Yield the texts in a list of messages that state no action beside themselves, with x for what is filled in."""
    match node:
        case ast.List():
            for item in node.elts:
                yield from _texts(item)
        case ast.ListComp() | ast.GeneratorExp():
            yield from _texts(node.elt)
        case ast.Starred():
            yield from _texts(node.value)
        case ast.IfExp():
            yield from [*_texts(node.body), *_texts(node.orelse)]
        case ast.BinOp():
            yield from [*_texts(node.left), *_texts(node.right)]
        case ast.Call(func=ast.Name(id="Finding" | "Bad"), args=[text]):
            yield from _texts(text)
        case ast.JoinedStr():
            yield "".join(str(part.value) if isinstance(part, ast.Constant) else "x" for part in node.values)
        case ast.Constant(value=str()):
            yield node.value


def _lists_of_messages(function):
    """Yield the expressions by which a function adds to its messages."""
    for node in ast.walk(function):
        match node:
            case ast.Call(func=ast.Attribute(value=ast.Name(id=name), attr="append"), args=[value]) if name in MESSAGES:
                yield value
            case ast.AugAssign(target=ast.Name(id=name), value=value) if name in MESSAGES:
                yield value
            case ast.Return(value=value) if function.name.startswith(("warn", "_warn")) and value is not None:
                yield value


def test_every_finding_asks_for_something():
    source = Path(il.__file__).parent
    files = [*(source / "procedures").rglob("*.py"), *(source / "estimation").rglob("*.py"), source / "gravity.py"]
    silent = {
        f"{file.name}: {text}"
        for file in files
        if not NO_FINDINGS.search(file.name)
        for function in ast.walk(ast.parse(file.read_text()))
        if isinstance(function, ast.FunctionDef) and function.name not in ("measured", "turned", "_of_magnetometers")
        for expression in _lists_of_messages(function)
        for text in _texts(expression)
        if len(text.split()) > 3 and not action_of(text)
    }
    assert not silent


def test_findings_on_more_than_three_sensors_that_differ_by_numbers_alone_are_one():
    def off(count):
        return Finding(f"excluded {count} samples (p = {count}e-07), Hz: 1/f", "check its supply")

    pairs = [(f"gyro_x_{n}", off(n)) for n in (12, 1, 7)]
    apart = join_alike([*pairs, ("gyro_y_1", Note(off(3)))])  # a note is no finding
    assert [names for names, _ in apart] == [["gyro_x_12"], ["gyro_x_1"], ["gyro_x_7"], ["gyro_y_1"]]
    assert apart[1][1] == "excluded 1 sample (p = 1e-07), Hz: 1/f"
    ((names, text),) = join_alike([*pairs, ("gyro_x_3", off(7)), ("gyro_x_3", off(8))])
    assert names == ["gyro_x_12", "gyro_x_1", "gyro_x_7", "gyro_x_3"]
    assert text == "excluded 1…12 samples (p = 1e-07…12e-07), Hz: 1/f"
    assert (type(text), text.action) == (Finding, "check its supply")
    thousands = join_alike((str(n), f"port #2: {n},100 of {n}0,000.5 rows, {n}0,20") for n in (9, 10, 11, 12))
    assert [text for _, text in thousands] == ["port #2: 9,100…12,100 of 90,000.5…120,000.5 rows, 90…120,20"]
    asked = join_alike((str(n), Finding(f"{n} bad", "check" if n < 3 else "mend")) for n in range(8))
    assert [(names, text.action) for names, text in asked[-1:]] == [(["3", "4", "5", "6", "7"], "mend")]
    assert [text.action for _, text in asked[:-1]] == ["check"] * 3
    assert join_alike((name, "dead") for name in ("a", "b")) == [(["a", "b"], "dead")]
    assert join_alike([]) == []

"""Forms, files and jobs of the workbench, and the addresses that join them."""

from __future__ import annotations

import http.client
import json
import os
import queue
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest

pytest.importorskip("starlette", reason="the page needs the extra live")

import imulab as il
from benchpage import PATIENCE
from imulab.cli import main
from imulab.cli.app import commands
from imulab.errors import OptionError
from imulab.live.page import bench as bench_module
from imulab.live.page import results, server
from imulab.live.page.bench import Workbench
from imulab.live.page.files import FolderFiles, Openings, checked
from imulab.live.page.jobs import Jobs, forms
from imulab.live.page.server import to_json

COMMANDS = {command.path: command for command in commands()}
FORMS = forms(COMMANDS.values())
HOSTILE = (
    "../../etc/passwd",
    "/etc/passwd",
    "..",
    ".",
    "",
    ".hidden",
    "a/b.csv",
    "a\\b.csv",
    "C:x",
    "a\0b",
    "a\nb",
    "a\u202eb",
    "x" * 300,
)


def words(path: str, **values: Any) -> list[str]:
    return FORMS[path].words(values, lambda name: name, lambda name, ending: f"folder/{name or 'found'}{ending}")


@pytest.mark.parametrize("path", COMMANDS)
def test_a_form_has_what_the_help_of_its_command_has(path, capsys):
    assert main([*path.split(), "--help-all"], project=False) == 0
    shown = " ".join(capsys.readouterr().out.split())
    form = FORMS[path]
    assert " ".join(form.help.split()[:5]) in shown
    options = [field for field in form.fields if field.flag]
    of_command = {each.keyword for each in (*COMMANDS[path].arguments, *COMMANDS[path].options)}
    if f"{path.removesuffix(' --imus')} --imus" in COMMANDS:
        of_command.discard("imus")  # the switch has a form of its own
    assert {each.name for each in form.fields} == of_command
    for field in options:
        assert field.flag in shown
        assert field.shows in shown
        assert " ".join(field.help.split()) in shown
        if field.default and field.kind != "switch":
            assert field.default in shown


def test_every_argument_of_a_procedure_is_a_file_of_the_session():
    apart = {"live", "open", "demo"}
    arguments = [f for path, form in FORMS.items() if path not in apart for f in form.fields if not f.flag]
    assert {field.kind for field in arguments} == {"file", "files"}
    assert not any(field.other for field in arguments)


def test_no_text_of_a_form_is_a_file_without_being_called_one():
    """Options that the help says are files are such of the session, or are written there."""
    for path, form in FORMS.items():
        if not path.startswith(("fleet", "live", "open", "demo")):
            named = [f for f in form.fields if re.search(r"FILE|RECORD|[A-Z]\.[a-z]", f.shows)]
            assert {f.kind for f in named} <= {"file", "files", "output"}, path


@pytest.mark.parametrize(
    ("path", "values", "expected"),
    [
        ("tumble fit", {"file": "r.csv", "order": "auto"}, "tumble fit r.csv"),
        ("tumble fit", {"file": "r.csv", "order": "2", "cross": True, "output": True, "report": "a b.html"},
         "tumble fit r.csv --order 2 --cross -o folder/found.json --report 'folder/a b.html.html'"),
        ("tumble fit", {"file": "r.csv", "gravity": "-1", "output": None}, "tumble fit r.csv --gravity=-1"),
        ("apply", {"files": ["r.json", "f.csv"], "again": True}, "apply r.json f.csv --again"),
        ("tumble check", {"file": "r.csv", "record": "r.json"}, "tumble check r.json r.csv"),
        ("export", {"records": ["r.json"], "to": "c", "output": True}, "export r.json --to c -o folder/found"),
        ("tumble plan", {"attitudes": "9", "distinct_verticals": False},
         "tumble plan --attitudes 9 --repeated-verticals"),
        ("array simulate", {"fault": ["dead:1", "stuck:2", ""], "output": True},
         "array simulate --fault dead:1 --fault stuck:2 -o folder/found.csv"),
        ("noise simulate", {"gm": ["20 deg/h:300 s", " 2 deg/h:9 s"], "output": True},
         "noise simulate --gm '20 deg/h:300 s' --gm '2 deg/h:9 s' -o folder/found.csv"),
        ("warmup fit", {"files": ["a.csv"], "temperatures": "-40,0"}, "warmup fit a.csv --temperatures=-40,0"),
    ],
)  # fmt: skip
def test_values_become_the_words_that_one_would_type(path, values, expected):
    assert words(path, **values) == shlex.split(expected)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({}, "FILE: expected a file"),
        ({"file": "r.csv", "metod": "norm"}, "no field 'metod'; expected .*did you mean 'method'"),
        ({"file": "r.csv", "method": "nrom"}, "--method 'nrom': expected one of norm linearised; did you mean 'norm'"),
        ({"file": "r.csv", "cross": "yes"}, "--cross: expected yes or no"),
        ({"file": "r.csv", "gravity": {"x": 1}}, "--gravity: expected a text"),
        ({"file": "r.csv", "gravity": "9\0"}, "--gravity: expected a text"),
    ],
)
def test_values_that_cannot_be_are_refused_by_a_sentence(values, said):
    with pytest.raises(OptionError, match=said):
        words("tumble fit", **values)


def test_a_word_in_the_place_of_a_file_names_no_file_outside(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("secret").write_text("x")
    files = FolderFiles(Path("session"))
    files.make()

    def made(layout: str) -> list[str]:
        return FORMS["convert"].words(
            {"file": "session/r.csv", "layout": layout}, files.path, lambda name, ending: name
        )

    Path("session/r.csv").write_text("x")
    Path("session/l.toml").write_text("x")
    assert made("phyphox")[-2:] == ["--layout", "phyphox"]
    assert made("session/l.toml")[-2:] == ["--layout", "session/l.toml"]
    for layout in ("secret", "/etc/passwd", "../secret", "session/../secret"):
        with pytest.raises(OptionError, match=r"not among the files of this session|without a path"):
            made(layout)


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_names_are_refused(tmp_path, name):
    with pytest.raises(OptionError, match="expected the name of a file"):
        checked(tmp_path, name)


@pytest.mark.parametrize(
    "name", ["<img src=x onerror=alert(1)>.csv", "-o.csv", "a b;rm -rf $HOME`id`.csv", "µ ü.csv", "con.csv"]
)
def test_odd_names_are_names(tmp_path, name):
    assert checked(tmp_path, name) == tmp_path / name


def test_a_session_lists_its_files_with_their_kinds(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    il.write_csv(il.simulate_tumble(attitudes=12, gravity=9.81), "-given.csv")
    files = FolderFiles(Path("session"), ["-given.csv"])
    files.make()
    il.fit_tumble("-given.csv", order=1, gravity=9.81).save("session/r.json")
    Path("session/r.html").write_text("x")
    Path("session/fw").mkdir()
    Path("session/.part").write_text("x")
    Path("session/link.csv").symlink_to("/etc/passwd")
    assert [(entry.name, entry.kind) for entry in files.entries()] == [
        ("./-given.csv", "recording"), ("session/fw", "folder"), ("session/link.csv", "recording"),
        ("session/r.html", "report"), ("session/r.json", "record"),
    ]  # fmt: skip
    assert files.path("./-given.csv") == "./-given.csv"
    for name in ("r.json", "session/link.csv", "session/.part", "session/none", "session/", "/etc/passwd", "-", ""):
        with pytest.raises(OptionError):
            files.path(name)
    assert files.unused("r.json") == "session/r-2.json"
    with pytest.raises(OptionError, match="is there already"):
        files.new("r.json")
    assert files.end()


def test_an_empty_folder_goes_with_its_session(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    files = FolderFiles(Path("session"), later=["rec.csv"])
    assert not files.end()
    files.make()
    assert Path("session").is_dir()
    assert files.entries() == []
    assert not files.end()
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(OptionError, match=r"none\.csv: no such file"):
        FolderFiles(Path("session"), ["none.csv"])
    assert list(tmp_path.iterdir()) == []


def until(condition: Callable[[], Any]) -> Any:
    ends = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < ends, "it has not come to that"
        time.sleep(0.02)
    return found


def test_a_job_is_the_command_itself(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    il.write_csv(il.simulate_tumble(attitudes=12, gravity=9.81), "a b.csv")
    told: list[str] = []
    jobs = Jobs(lambda job: told.append(job.state))
    job = jobs.run("tumble fit", ["tumble", "fit", "a b.csv", "--order", "1", "-o", "r.json"], ["r.json"])
    until(lambda: job.ended)
    assert (job.state, job.status, told[0], told[-1]) == ("done", 0, "running", "done")
    assert job.command == "imulab tumble fit 'a b.csv' --order 1 -o r.json"
    assert main(shlex.split(job.command.replace("r.json", "s.json"))[1:], project=False) == 0
    assert capsys.readouterr().out.replace("s.json", "r.json") == job.text
    assert same_record(Path("r.json").read_bytes(), Path("s.json").read_bytes())


def same_record(one: bytes, other: bytes) -> bool:
    """Whether two records are the same bit for bit, apart from when they were made."""

    def apart(data: bytes) -> bytes:
        return b"\n".join(
            line for line in data.splitlines() if b'"created"' not in line and b'"content_sha256"' not in line
        )

    return apart(one) == apart(other) and len(apart(one)) > 1000


def test_a_refusal_is_said(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    jobs = Jobs(lambda job: None)
    job = jobs.run("tumble fit", ["tumble", "fit", "none.csv", "-o", "r.json"], ["r.json"])
    until(lambda: job.ended)
    assert (job.state, job.status, job.messages, job.text) == ("refused", 2, ["imulab: none.csv: no such file"], "")


def test_a_module_in_the_working_folder_is_not_imported(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("numpy", "imulab", "rich"):
        Path(f"{name}.py").write_text("open('executed', 'w')")
    job = Jobs(lambda job: None).run("show", ["show", "--formats"], [])
    until(lambda: job.ended)
    assert (job.state, Path("executed").exists()) == ("done", False)


@pytest.mark.slow
def test_cancelling_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    il.write_csv(il.simulate_tumble(attitudes=24, gravity=9.81), "rec.csv")
    jobs = Jobs(lambda job: None)
    slow = ["tumble", "fit", "rec.csv", "--order", "2", "--monte-carlo", "500000", "-o", "r.json", "--report", "r.html"]
    job = jobs.run("tumble fit", slow, ["r.json", "r.html"])
    group = jobs._processes[job.number].pid
    time.sleep(1.0)
    assert job.state == "running"
    jobs.cancel(job.number)
    until(lambda: job.ended)
    assert job.state == "cancelled"
    assert [path.name for path in tmp_path.iterdir()] == ["rec.csv"]
    with pytest.raises(ProcessLookupError):
        os.killpg(group, 0)
    jobs.cancel(job.number)  # again: nothing happens
    jobs.cancel(77)


def test_many_words_are_cut(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("imulab.live.page.jobs._LONGEST", 100)
    job = Jobs(lambda job: None).run("show", ["show", "--formats"], [])
    until(lambda: job.ended)
    assert job.text[100:].startswith("\n... and ")
    assert job.state == "done"


@pytest.fixture
def bench(tmp_path, monkeypatch) -> Iterator[SimpleNamespace]:
    """A workbench that runs, and a way to ask it."""
    monkeypatch.chdir(tmp_path)
    lines: queue.Queue[str] = queue.Queue()
    part = Workbench(files := FolderFiles(Path("session")), FORMS)
    files.make()
    options = {"browser": False, "limit": 10**7, "tell": lines.put}
    thread = threading.Thread(target=server.serve, args=([part],), kwargs=options, daemon=True)
    thread.start()
    host, _, token = lines.get(timeout=PATIENCE).removeprefix("http://").partition("/?token=")

    def ask(path: str, body: Any = None, method: str | None = None, **headers: str) -> SimpleNamespace:
        data = json.dumps(body) if isinstance(body, dict) else body
        connection = http.client.HTTPConnection(host, timeout=PATIENCE)
        given = {"x-imulab-token": token} | {key.replace("_", "-"): value for key, value in headers.items()}
        connection.request(method or ("POST" if data else "GET"), f"/api/workbench/{path}", data, given)
        answer = connection.getresponse()
        body = answer.read()
        connection.close()
        return SimpleNamespace(status=answer.status, body=body, headers=answer.headers, json=lambda: json.loads(body))

    yield SimpleNamespace(ask=ask, part=part)
    part._hub.stop()
    thread.join(PATIENCE)
    assert not thread.is_alive()


def run(bench: SimpleNamespace, path: str, **values: Any) -> Any:
    job = bench.ask("jobs", {"command": path, "values": values}).json()
    assert "error" not in job, job
    return until(lambda: (found := bench.part._jobs.jobs[job["number"]]).ended and found)


def test_a_unit_that_is_never_turned_and_a_column_without_numbers_are_told(bench):
    cycle = il.simulate_power_cycle(20.0, seed=1, sample_rate=20.0)
    still = cycle.with_columns({"mag_x": np.full(len(cycle), np.nan)}, {"mag_x": "uT"})
    for name, recording in (("cycle.csv", still), ("turned.csv", il.simulate_tumble(attitudes=8, gravity=9.81))):
        il.write_csv(recording, name)
        sent = bench.ask(f"files/{name}", Path(name).read_bytes(), "PUT").json()["name"]
        bench.ask("open", {"file": sent, "reading": {}})
        about = until(lambda sent=sent: "attitudes" in (found := bench.ask("open", {"file": sent}).json()) and found)
        assert about["turned"] == (name == "turned.csv")
        said = "mag_x: no number in any row, nothing is drawn of it"
        assert (said in about["notes"]) == (name == "cycle.csv")


def test_from_the_recording_to_the_firmware(bench, tmp_path):
    il.write_csv(il.simulate_tumble(attitudes=12, gravity=9.81), "rec.csv")
    name = bench.ask("files/rec.csv", Path("rec.csv").read_bytes(), "PUT").json()["name"]
    assert name == "session/rec.csv"
    assert bench.ask("files/other.csv", b"other", "PUT").json()["name"] == "session/other.csv"
    bench.ask("open", {"file": name, "reading": {}})
    about = until(lambda: "attitudes" in (found := bench.ask("open", {"file": name}).json()) and found)
    assert len(about["attitudes"]) == 12
    shown = bench.ask(f"curves?opening={about['opening']}&width=200").json()
    assert len(shown["low"]["accel_x"]) == len(shown["at"]) == 200
    said = bench.ask(
        "command", {"command": "tumble fit", "values": {"file": name, "output": True, "report": True}}
    ).json()
    assert said["command"] == "imulab tumble fit session/rec.csv -o session/rec.json --report session/rec.html"
    job = run(bench, "tumble fit", file=name, output=True, report=True)
    assert (job.state, job.command) == ("done", said["command"])
    record = bench.ask("files/session%2Frec.json")
    assert record.headers["content-disposition"] == "attachment; filename*=UTF-8''rec.json"
    assert main(["tumble", "fit", "session/rec.csv", "-o", "own.json"], project=False) == 0
    assert same_record(record.body, Path("own.json").read_bytes())
    report = bench.ask("reports/session%2Frec.html")
    assert report.headers["content-security-policy"].startswith("sandbox ")
    assert report.body == Path("session/rec.html").read_bytes()
    job = run(bench, "export", records=["session/rec.json"], to="c", output=True)
    packed = bench.ask(f"zip/{quote(job.outputs[0], safe='')}")
    names = zipfile.ZipFile(BytesIO(packed.body)).namelist()
    there = [path for path in (tmp_path / "session" / "rec-c").rglob("*") if path.is_file()]
    assert sorted(names) == sorted(str(path.relative_to(tmp_path / "session")) for path in there)
    kinds = {entry["short"]: entry["kind"] for entry in bench.ask("files").json()["files"]}
    assert kinds == {
        "other.csv": "recording",
        "rec-c": "folder",
        "rec.csv": "recording",
        "rec.html": "report",
        "rec.json": "record",
    }
    assert bench.ask("files/session%2Fother.csv", None, "DELETE").status == 200
    assert not Path("session/other.csv").exists()


@pytest.mark.parametrize(
    ("kind", "method"), [("files", "PUT"), ("files", "GET"), ("files", "DELETE"), ("zip", "GET"), ("reports", "GET")]
)
def test_no_address_leads_out_of_the_session(bench, tmp_path, kind, method):
    before = sorted(tmp_path.rglob("*"))
    for name in filter(None, HOSTILE):
        answer = bench.ask(f"{kind}/{quote(name, safe='')}", b"x" if method == "PUT" else None, method)
        assert answer.status in (400, 404, 405), name
        assert sorted(tmp_path.rglob("*")) == before, name


def test_a_recording_that_grows_is_saved_as_far_as_it_was(bench, monkeypatch):
    Path("session/rec.csv").write_bytes(b"0123456789" * 1000)

    def grown(stream, size):
        with Path("session/rec.csv").open("ab") as more:
            more.write(b"more")
        return pieces(stream, size)

    pieces = bench_module._pieces
    monkeypatch.setattr(bench_module, "_pieces", grown)
    assert bench.ask("files/session%2Frec.csv").body == b"0123456789" * 1000
    assert bench.ask("files/session%2Frec.csv").body == b"0123456789" * 1000 + b"more"


def test_a_page_from_elsewhere_is_not_shown_but_saved(bench):
    bench.ask("files/evil.html", b"<script>alert(1)</script>", "PUT")
    assert bench.ask("reports/session%2Fevil.html").status == 400
    saved = bench.ask("files/session%2Fevil.html")
    assert saved.headers["content-type"] == "application/octet-stream"
    assert saved.headers["content-disposition"].startswith("attachment")


def test_an_upload_beyond_the_limit_is_refused_and_leaves_nothing(bench, tmp_path):
    assert bench.ask("files/big.csv", b"x" * (10**7 + 1), "PUT").status == 413
    assert bench.ask("files/big.csv", iter([b"x" * 10**6] * 11), "PUT").status == 400
    assert list((tmp_path / "session").iterdir()) == []


@pytest.mark.parametrize(
    ("path", "body", "said"),
    [
        ("open", {"file": "/etc/passwd"}, "not among the files"),
        ("open", {"file": "none.csv"}, "not among the files"),
        ("open", {"file": 5, "reading": 7}, "not among the files|reading: expected"),
        ("curves?opening=7", None, "is not open any more"),
        ("curves?opening=x", None, "opening 'x': expected a number"),
        ("curves?opening=7&from=x", None, "from 'x': expected a number"),
        ("curves?opening=7&width=nan", None, "width 'nan': expected a number"),
        ("curves?opening=inf", None, "opening 'inf': expected a number"),
        ("command", b'{"command": "' + b"x" * (1 << 20) + b'"}', "expected a JSON object of at most 1024 KiB"),
        ("command", {"command": "live", "values": []}, "not among those offered"),
        ("jobs", {"command": "tumble fit", "values": {"file": "/etc/passwd"}}, "not among the files"),
        ("jobs", {"command": "tumble simulate", "values": {"output": "../x.csv"}}, "expected the name of a file"),
        ("jobs", b"[1", "expected a JSON object"),
        ("jobs", b"[" * 50_000, "expected a JSON object"),
    ],
)
def test_what_cannot_be_is_answered_by_a_sentence(bench, tmp_path, path, body, said):
    answer = bench.ask(path, body)
    assert answer.status == 400
    assert any(each in answer.json()["error"] for each in said.split("|"))
    assert list(tmp_path.iterdir()) == [tmp_path / "session"]


def test_two_pages_read_one_file_each_in_its_own_way(bench):
    """A layout of one page is none of the other."""
    Path("session/l.toml").write_text('[columns]\naccel_x = { from = "a", unit = "g" }\n')
    il.write_csv(il.simulate_tumble(attitudes=6, gravity=9.81), "session/rec.csv")
    Path("session/rec.csv").write_text("a [g],b [g]\n1,2\n3,4\n")
    ways = [{"file": "session/rec.csv"}, {"file": "session/rec.csv", "reading": {"layout": "session/l.toml"}}]
    numbers = [bench.ask("open", way).json()["opening"] for way in ways]
    until(lambda: all("attitudes" in bench.ask("open", way).json() or "error" in bench.ask("open", way).json()
                      for way in ways))  # fmt: skip
    assert [bench.ask("open", way).json()["opening"] for way in ways] == numbers
    assert len(set(numbers)) == 2


def test_a_name_that_is_being_written_is_not_given_twice(bench):
    values = {"output": "own.csv", "attitudes": "200"}
    job = bench.ask("jobs", {"command": "tumble simulate", "values": values}).json()
    again = bench.ask("jobs", {"command": "tumble simulate", "values": values})
    assert again.status == 400
    assert "own.csv: is" in again.json()["error"]
    until(lambda: bench.part._jobs.jobs[job["number"]].ended)


def test_a_file_that_is_dropped_again_replaces_the_older_and_its_results_say_so(bench):
    def drop(seed: int) -> dict[str, Any]:
        il.write_csv(il.simulate_tumble(attitudes=12, hold="3 s", gravity=9.81, seed=seed), "own.csv")
        return bench.ask("files/own.csv", Path("own.csv").read_bytes(), "PUT").json()

    name = drop(1)["name"]
    fit = run(bench, "tumble fit", file=name, gravity="9.81", order="1", output="rec.json")
    firmware = run(bench, "export", records=[fit.outputs[0]], to="c", output=True)
    plan = run(bench, "tumble simulate", output="other.csv")
    assert drop(1) == {"name": name, "replaced": False}  # the same again is no news
    assert [job.replaced for job in (fit, firmware, plan)] == [[], [], []]
    assert drop(2) == {"name": name, "replaced": True}
    assert Path(name).read_bytes() == Path("own.csv").read_bytes()
    assert [job.replaced for job in (fit, firmware, plan)] == [[name], [name], []]
    assert run(bench, "tumble fit", file=name, gravity="9.81", order="1").replaced == []
    own = bench.ask("files/rec.json", Path(fit.outputs[0]).read_bytes(), "PUT").json()
    assert own == {"name": "session/rec-2.json", "replaced": False}  # what a command has made is not replaced
    assert sorted(path.name for path in Path("session").iterdir() if path.name[0] == ".") == []


def test_a_result_is_bounded_in_what_is_read_and_what_is_drawn(tmp_path, monkeypatch):
    record = tmp_path / "r.json"
    il.fit_tumble(il.simulate_tumble(gravity=9.81), order=1, gravity=9.81).save(record)
    whole = results.result_of([str(record)])
    assert whole["figure"]["data"]
    monkeypatch.setattr(results, "_MOST_DRAWN", 1000)
    assert results.result_of([str(record)]) == {**whole, "figure": None}
    monkeypatch.setattr(results, "_MOST_READ", 1000)
    assert results.result_of([str(record)]) == {}


def test_a_certificate_of_a_record_is_written_beside_it(bench):
    fit = il.fit_tumble(il.simulate_tumble(order=1, gravity=9.81), order=1, gravity="9.81+-1e-5")
    assert fit.calibration.verdict.state == "good"
    fit.save("unit.json")
    main(["certificate", "--template", "-o", "LAB.toml"])
    record, lab = (
        bench.ask(f"files/{name}", Path(name).read_bytes(), "PUT").json()["name"] for name in ("unit.json", "LAB.toml")
    )
    for ending, begin in (("xml", b"<?xml"), ("pdf", b"%PDF")):
        job = run(bench, "certificate", record=record, lab=lab, language="de", output=f"unit.{ending}")
        assert Path(job.outputs[0]).read_bytes().startswith(begin)


def test_results_are_cleared_but_not_what_runs_nor_what_they_made(bench):
    fit = run(bench, "tumble simulate", output="own.csv")
    longest = {"file": fit.outputs[0], "order": "2", "gravity": "9.81", "monte_carlo": "900000"}
    more = bench.ask("jobs", {"command": "tumble fit", "values": longest}).json()
    assert bench.ask("results", None, "DELETE").status == 200
    assert fit.number not in bench.part._jobs.jobs
    assert Path(fit.outputs[0]).is_file()
    assert bench.part._jobs.jobs[more["number"]].state == "running"
    bench.ask(f"jobs/{more['number']}", None, "DELETE")
    assert until(lambda: bench.part._jobs.jobs[more["number"]].ended)
    assert run(bench, "tumble simulate", output="c.csv").number > more["number"]  # no number comes twice
    bench.ask(f"results/{more['number']}", None, "DELETE")
    assert more["number"] not in bench.part._jobs.jobs


MANIFEST = """radius = {{ value = 2.0, unit = "m" }}
rates = {{ unit = "deg/s" }}
[[run]]
file = {file!r}
power_cycle = 1
role = "static"
[[run]]
file = "other.csv"
power_cycle = 1
role = "loaded"
arm_rate = 126.87
table_rate = 10
sense = 1
spin_axis = "up"
"""


RATE_MANIFEST = """
rates.unit = "deg/s"
rates.relative_standard_uncertainty = 0.0
mounting = {{ standard_uncertainty = 0, unit = "mrad" }}
latitude = {{ value = 48, unit = "deg" }}
[[run]]
file = {file!r}
mounting = "+x"
rates = [0, 100, -100, 0]
"""
REDUCE, FIT = ("centrifuge reduce", "manifest", MANIFEST), ("rate fit", "file", RATE_MANIFEST)


@pytest.mark.parametrize(
    ("file", "command"),
    [("/etc/passwd", FIT), ("sub/link.csv", FIT), ("../secret.csv", REDUCE), ("linked/secret.csv", REDUCE)],
)
def test_a_manifest_that_was_dropped_reads_no_file_outside_the_folder(bench, file, command):
    path, field, manifest = command
    Path("secret.csv").write_text("secret,time\n0,1\n")
    Path("session/sub").mkdir()
    Path("session/sub/link.csv").symlink_to(Path("secret.csv").absolute())
    Path("session/linked").symlink_to(Path.cwd())
    bench.ask("files/m.toml", manifest.format(file=file).encode(), "PUT")
    job = run(bench, path, **{field: "session/m.toml"})
    assert (job.state, job.status) == ("refused", 2)
    assert job.messages[-1].endswith("lies elsewhere; expected a file in the session's folder")
    assert "secret,time" not in "".join(job.messages) + job.text
    assert "root:" not in "".join(job.messages) + job.text


def test_a_manifest_that_is_exchanged_after_the_form_was_checked_reads_nothing_more(bench, monkeypatch):
    Path("secret.csv").write_text("secret,time\n0,1\n")
    bench.ask("files/m.toml", MANIFEST.format(file="own.csv").encode(), "PUT")
    begin = Jobs._begin

    def exchanged(jobs: Jobs, job: Any) -> None:
        Path("session/m.toml").write_text(MANIFEST.format(file="../secret.csv"))
        begin(jobs, job)

    monkeypatch.setattr(Jobs, "_begin", exchanged)
    job = run(bench, "centrifuge reduce", manifest="session/m.toml", output=True)
    assert job.messages[-1].endswith("../secret.csv: lies elsewhere; expected a file in the session's folder")


def test_a_link_that_is_exchanged_between_check_and_opening_opens_nothing(tmp_path, monkeypatch):
    from imulab import files as module

    (tmp_path / "in").mkdir()
    (tmp_path / "in/a").write_text("inside")
    (tmp_path / "secret").write_text("secret")
    monkeypatch.setenv(module.WITHIN, json.dumps([str((tmp_path / "in").resolve())]))
    with module.open_file(tmp_path / "in/a") as stream:
        assert stream.read() == b"inside"
    check, times = module.check_within, []

    def exchanging(path: Any, roots: Any = None) -> str:
        found = check(path, roots)
        if not times:  # after the check, before the file is opened
            (tmp_path / "in/a").unlink()
            (tmp_path / "in/a").symlink_to(tmp_path / "secret")
        times.append(path)
        return found

    monkeypatch.setattr(module, "check_within", exchanging)
    with pytest.raises(OptionError, match="lies elsewhere"):
        module.open_file(tmp_path / "in/a")


def test_a_link_put_in_place_of_a_file_after_its_name_was_checked_is_neither_sent_nor_shown(
    bench, tmp_path, monkeypatch
):
    """What the page downloads is opened as what a job reads is."""
    (tmp_path / "secret").write_text("secret")
    Path("session/race").write_text("inside")
    assert bench.ask("files/session%2Frace").body == b"inside"
    find = FolderFiles.path

    def exchanging(files: FolderFiles, name: str) -> str:
        found = find(files, name)
        Path("session/race").unlink()
        Path("session/race").symlink_to(tmp_path / "secret")
        return found

    monkeypatch.setattr(FolderFiles, "path", exchanging)
    for place in ("files", "reports"):
        Path("session/race").unlink()
        Path("session/race").write_text("inside")
        answer = bench.ask(f"{place}/session%2Frace")
        assert answer.status == 400
        assert b"secret" not in answer.body.replace(b"/secret", b"")
    folder = Path("session/made")
    folder.mkdir()
    (folder / "a").write_text("inside")
    with zipfile.ZipFile(bench_module._pack(folder, ["session"], tmp_path)) as archive:
        assert archive.read("made/a") == b"inside"


def test_every_file_that_a_name_of_the_input_leads_to_is_opened_by_the_shared_opener():
    """What reads by a name of its input: no ``open``, ``read_bytes`` or ``read_text`` of a path but in `open_file`."""
    root = Path(il.__file__).parent
    other = re.compile(r"\.open\(\"r?b?\"\)|\.read_(bytes|text)\(|[^._a-z]open\(")
    for room in ("readers", "records", "device", "procedures"):
        for path in sorted((root / room).rglob("*.py")):
            if path.name != "shipped.py":  # reads what comes with imulab
                assert not other.search(path.read_text(encoding="utf-8")), path


def test_a_manifest_of_the_command_line_names_files_where_they_are(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("m.toml").write_text(MANIFEST.format(file="/data/one.csv"))
    Path("L.toml").write_text("")
    files = FolderFiles(Path("session"), ["m.toml", "L.toml"])
    assert files.within(["rate", "fit", "m.toml"]) is None
    for words in (["session/m.toml"], ["x.csv", "--layout", "L.toml"], ["session/m.toml", "--layout", "m.toml"]):
        assert files.within(["rate", "fit", *words]) == ["session", "m.toml", "L.toml"]


def test_no_more_jobs_run_than_there_are_cores_and_the_others_wait(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    told: list[tuple[int, str]] = []
    jobs = Jobs(lambda job: told.append((job.number, job.state)), most=1)
    found = [jobs.run("show", ["show", "--formats"], []) for _ in range(4)]
    assert [job.state for job in found] == ["running", "waiting", "waiting", "waiting"]
    jobs.cancel(3)
    until(lambda: all(job.ended for job in found))
    assert [job.state for job in found] == ["done", "done", "cancelled", "done"]
    assert found[0].ended <= found[1].began <= found[1].ended <= found[3].began
    assert [state for number, state in told if number == 4] == ["waiting", "running", "done"]
    last = [jobs.run("show", ["show", "--formats"], []) for _ in range(3)]
    jobs.end()
    assert {job.state for job in last} == {"cancelled"}


@pytest.mark.parametrize("name", ["con.csv", "NUL", "com1.txt", "lpt² .csv", "a?.csv", "rec.csv.", "rec "])
def test_names_that_windows_does_not_take_are_refused_there(tmp_path, monkeypatch, name):
    monkeypatch.setattr("imulab.live.page.files._WINDOWS", True)
    with pytest.raises(OptionError, match="Windows does not take"):
        checked(tmp_path, name)
    for good in ("console.csv", "com.csv", "a.con", "rec 1.csv"):
        assert checked(tmp_path, good) == tmp_path / good


def test_a_command_that_says_much_is_told_of_in_few_messages(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    told: list[int] = []
    jobs = Jobs(lambda job: told.append(len(job.messages)))
    lines = subprocess.Popen([sys.executable, "-c", "print('line\\n' * 900)"], stdout=subprocess.PIPE, text=True)
    job = jobs.run("show", ["show", "--formats"], [])
    until(lambda: job.ended)
    told.clear()
    job.ended = None
    jobs._listen(job, lines.stdout)
    lines.wait()
    until(lambda: told and told[-1] >= 900)
    assert len(told) < 20


@pytest.mark.slow
def test_the_columns_of_a_file_are_told_and_their_layout_written(bench):
    rows = "".join(f"{10 * k},0.01,0.02,{1 + k % 3 / 100},3,4,5\n" for k in range(50))
    bench.ask("files/u.csv", ("t_ms,ax,ay,az,p,q,r\n" + rows).encode(), "PUT")
    told = bench.ask("columns", {"file": "session/u.csv"}).json()
    known = [(each["column"], each["unit"]) for each in told["columns"]]
    assert known == [("time", "ms"), ("accel_x", "g"), ("accel_y", "g"), ("accel_z", "g"), ("", ""), ("", ""), ("", "")]
    assert len(told["rows"]) == 6
    stated = [[0, "time", "ms"], [3, "accel_z", "g"], [4, "gyro_x", "deg/s"]]
    made = bench.ask("columns", {"file": "session/u.csv", "columns": stated}).json()
    opened = bench.ask("open", {"file": "session/u.csv", "reading": {"layout": made["layout"]}}).json()
    message = until(lambda: (o := bench.part._openings.known(opened["opening"]).about).get("done") and o)
    assert message["head"]["units"] == {"accel_z": "g", "gyro_x": "deg/s"}
    saved = bench.ask("columns", {"file": "session/u.csv", "columns": stated, "name": "mine"}).json()
    assert saved["layout"] == "session/mine.toml"
    assert il.read("session/u.csv", "session/mine.toml").columns["gyro_x"][0] == 3
    assert (
        next(each for each in bench.ask("files").json()["files"] if each["name"] == "session/mine.toml")["kind"]
        == "layout"
    )


WHOLE = [[0, "time", "s"], [1, "accel_x", "g"]]


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ({"file": "session/u.csv", "columns": [[1, "accel_x", ""]]}, "expected the unit of accel_x"),
        ({"file": "session/u.csv", "columns": [[1, "accel_x", "g"]]}, "how many rows there are in a second"),
        ({"file": "session/u.csv", "columns": [[1, "accel_x", "g"], [2, "accel_x", "g"]]}, "chosen for two columns"),
        ({"file": "session/u.csv", "columns": [[9, "accel_x", "g"]]}, "column 10"),
        ({"file": "session/u.csv", "columns": [[-1, "accel_x", "g"]]}, "column 0"),
        ({"file": "session/u.csv", "columns": [[0, "time", "ms"]]}, "expected a column of a sensor"),
        ({"file": "session/u.csv", "columns": [["0", "time", "ms"]]}, "expected [place, name, unit]"),
        ({"file": "/etc/passwd"}, "not among the files"),
        ({"file": "session/link.csv"}, "not among the files"),
        ({"file": "session/b.bin"}, "binary data"),
        ({"file": "session/u.csv", "columns": WHOLE, "name": "../out"}, "expected the name"),
    ],
)  # fmt: skip
def test_columns_that_cannot_be_are_answered_by_a_sentence(bench, body, said):
    bench.ask("files/u.csv", b"t,a,b\n0,1,2\n1,2,3\n2,3,4\n", "PUT")
    bench.ask("files/b.bin", bytes(range(256)), "PUT")
    Path("session/link.csv").symlink_to("/etc/passwd")
    answer = bench.ask("columns", body)
    assert answer.status == 400
    assert said in answer.json()["error"]
    assert not list(Path("session").glob("*.toml"))


def test_what_to_see_first_of_a_job_is_in_its_record(bench):
    il.write_csv(il.simulate_tumble(attitudes=18, hold="2 s", gravity=9.81), "session/rec.csv")
    job = run(bench, "tumble fit", file="session/rec.csv", gravity="9.81", output=True)
    found = bench.ask(f"results/{job.number}").json()
    record = il.load("session/rec.json")
    assert found["state"] == record.verdict.state
    assert found["headline"] in job.text
    assert "esidual" in found["figure"]["title"]
    assert found["figure"]["data"]
    assert all(len(fact) == 2 for fact in found["facts"])
    shown = run(bench, "show", files=["session/rec.csv"])
    assert bench.ask(f"results/{shown.number}").json() == bench.ask("results/77").json() == {}


def test_files_in_a_folder_that_a_command_wrote_are_files_of_the_session(bench):
    run(bench, "thermal simulate", output=True, temperatures="0,20", duration="1 min", attitudes="12")
    entries = bench.ask("files").json()["files"]
    (folder,) = (each["name"] for each in entries if each["kind"] == "folder")
    inside = [each for each in entries if each["folder"] == folder]
    assert [each["kind"] for each in inside] == ["recording"] * 2
    (Path(folder) / "link.csv").symlink_to("/etc/passwd")
    assert "link.csv" not in {each["short"] for each in bench.ask("files").json()["files"]}
    for name in (f"{folder}/link.csv", f"{folder}/../../x.csv", f"{folder}/.hidden", f"{folder}//", "/etc/passwd"):
        assert bench.ask("open", {"file": name}).status == 400
    assert bench.ask("open", {"file": inside[0]["name"]}).status == 200
    told = bench.ask(
        "command",
        {"command": "thermal fit", "values": {"files": [each["name"] for each in inside] * 2, "output": True}},
    )
    assert told.json()["outputs"] == [f"session/{Path(folder).name}.json"]


def test_values_are_checked_before_they_are_run(bench):
    il.write_csv(il.simulate_tumble(attitudes=12, hold="1 s", gravity=9.81), "session/rec.csv")
    values = {"file": "session/rec.csv", "order": "7", "gravity": "9.81", "height": "520", "monte_carlo": "many"}
    wrong = bench.ask("command", {"command": "tumble fit", "values": values}).json()["wrong"]
    assert wrong.keys() == {"order", "gravity", "monte_carlo"}
    assert wrong["gravity"].startswith("gravity together with")
    good = {"file": "session/rec.csv", "order": "2", "latitude": "48.1", "height": "520"}
    assert bench.ask("command", {"command": "tumble fit", "values": good}).json()["wrong"] == {}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="there are no process groups")
def test_ctrl_c_twice_leaves_no_command_behind(tmp_path):
    il.write_csv(il.simulate_tumble(attitudes=24, gravity=9.81), tmp_path / "rec.csv")
    words = [sys.executable, "-m", "imulab", "open", "--no-browser", "rec.csv"]
    with subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        assert process.stdout is not None
        host, _, token = process.stdout.readline().strip().removeprefix("http://").partition("/?token=")
        connection = http.client.HTTPConnection(host, timeout=PATIENCE)
        values = {"file": "rec.csv", "order": "2", "monte_carlo": "900000"}
        body = json.dumps({"command": "tumble fit", "values": values})
        connection.request("POST", "/api/workbench/jobs", body, {"x-imulab-token": token})
        assert json.loads(connection.getresponse().read())["state"] == "running"
        before = until(lambda: children(process.pid))
        stuck = http.client.HTTPConnection(host, timeout=PATIENCE)  # an upload that hangs holds the first Ctrl-C up
        stuck.putrequest("PUT", "/api/workbench/files/slow.csv")
        stuck.putheader("content-length", "100")
        stuck.putheader("x-imulab-token", token)
        stuck.endheaders(b"begin")
        time.sleep(0.3)
        for _ in range(3):
            process.send_signal(signal.SIGINT)
            time.sleep(0.1)
        process.wait(PATIENCE)
        stuck.close()
        connection.close()
    until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in before))


def children(pid: int) -> list[str]:
    found = Path(f"/proc/{pid}/task").glob("*/children")
    return [each for path in found for each in path.read_text().split()]


@pytest.mark.parametrize(("arguments", "said"), [
    (["--port", "x"], "--port 'x': expected a whole number"),
    (["--port", "70000"], "--port 70000: expected 0 (a free one) to 65535"),
    (["none.csv"], "none.csv: no such file"),
    (["--host", "192.0.2.7"], "warning: whoever reaches 192.0.2.7 and has the address below can use the page; it is "
     "not encrypted\nimulab: --host 192.0.2.7: cannot be listened at: Cannot assign requested address"),
])  # fmt: skip
def test_open_refuses_by_a_sentence(imulab, tmp_path, arguments, said):
    ran = imulab("open", "--no-browser", *arguments)
    assert (ran.returncode, ran.stdout, ran.stderr) == (2, "", f"imulab: {said}\n")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_another_session_removed_is_made_again(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    files = FolderFiles(Path("session"))
    assert files.entries() == []
    assert Path(files.new("rec.csv")).parent.is_dir()


def test_a_command_that_cannot_be_started_leaves_no_job(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    jobs = Jobs(lambda job: None)
    with pytest.raises(il.ImulabError, match="cannot be started"):
        jobs.run("tumble fit", ["tumble", "fit", "a\0b"], [])
    assert jobs.jobs == {}


def test_a_message_with_half_a_character_still_is_one():
    assert to_json({"text": "found \ud800"}) == '{"text":"found ?"}'


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGHUP")
def test_closing_the_terminal_ends_the_workbench(tmp_path):
    words = [sys.executable, "-m", "imulab", "open", "--no-browser"]
    with subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert "token=" in process.stdout.readline()
        process.send_signal(signal.SIGHUP)
        assert process.wait(PATIENCE) == 0
    assert list(tmp_path.iterdir()) == []


def test_the_folders_of_a_killed_program_go_at_the_next_start(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    script = (
        "import os\nfrom imulab.live.page.files import Openings\nopen_files = Openings(print)\nos.kill(os.getpid(), 9)"
    )
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    subprocess.run([sys.executable, "-c", script], env=environment, check=False, timeout=PATIENCE)
    (left,) = tmp_path.iterdir()
    running = Openings(print)
    assert not left.exists()
    (place,) = tmp_path.iterdir()
    other = Openings(print)  # another program beside it
    assert place.exists()
    for each in (other, running):
        each.end()
    assert not list(tmp_path.iterdir())

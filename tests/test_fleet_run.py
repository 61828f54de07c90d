"""Fleets: what is done, what is left, what is refused; in one process unless the number of processes matters."""

import csv
import fcntl
import json
import os
import subprocess
import sys

import numpy as np
import pytest

import imulab as il
from fleets import G, attitudes, make_fleet, records, write_attitudes, write_manifest
from imulab.cli import main
from imulab.errors import ImulabError, OptionError, ReadError
from imulab.fleet.engine import work
from imulab.fleet.manifest import load_fleet, sha256_of
from imulab.fleet.run import fleet_status, run_fleet
from imulab.fleet.store import Store


def run(manifest, folder, **options):
    return run_fleet(str(manifest), str(folder), workers=1, **options)


def edited(manifest, change):
    with manifest.open() as stream:
        rows = list(csv.DictReader(stream))
    change(rows)
    return write_manifest(manifest, rows)


def plain(path):
    return {
        key: value
        for key, value in json.loads(path.read_text()).items()
        if key not in ("created", "software", "content_sha256")
    }


# ---- parameters are the single command's ---------------------------------------------------------------------------


@pytest.mark.slow
def test_parameters_equal_the_single_commands_to_the_last_bit(imulab, imulab_process, tmp_path):
    manifest = make_fleet(tmp_path / "in", 3)
    il.write(il.simulate_tumble(attitudes=16, order=1, hold=2.0, seed=4), tmp_path / "in" / "long.csv")
    edited(manifest, lambda rows: rows.append(
        {"serial": "LONG", "procedure": "tumble", "file": "long.csv", "latitude": "48.1", "height": "500", "order": "1"}
    ))  # fmt: skip
    done = imulab_process("fleet", "run", "in/manifest.csv", "-o", "out", "--workers", 2)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("4 units: 4 done, 0 failed")
    for serial, arguments in {
        "SN001": ["in/u1.csv", "--gravity", G],
        "LONG": ["in/long.csv", "--latitude", "48.1", "--height", "500", "--order", "1"],
    }.items():
        assert imulab("tumble", "fit", *arguments, "-o", "one.json").returncode == 0
        one, many = il.load(tmp_path / "one.json"), il.load(tmp_path / "out" / f"{serial}.json")
        assert many.parameters == one.parameters
        assert many.covariance == one.covariance
        assert many.model == one.model
        assert many.sensor["serial"] == serial


@pytest.mark.slow
def test_arrays_and_centrifuge_tests_run_through_the_same_functions(imulab, tmp_path):
    assert (
        imulab("array", "simulate", "-o", "still.csv", "--experiment", "static", "--duration", "60 s").returncode == 0
    )
    assert (
        imulab("array", "simulate", "-o", "moving.csv", "--experiment", "moving", "--duration", "30 s").returncode == 0
    )
    done = imulab(
        "centrifuge", "simulate", "-o", "c", "--levels", "1,5,10", "--cycles", 1, "--duration", "60 s",
        "--static-duration", "20 s",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    cycles = ["warmup", "simulate", "-o", "w", "--temperatures", "0,20,40", "--cycles", 2, "--rate", "2 Hz"]
    assert imulab(*cycles).returncode == 0
    warm = sorted(f"w/{path.name}" for path in (tmp_path / "w").glob("*.csv"))
    at = ["--temperatures", "0,20,40", "--model", "knot-cubic", "--settling-time", "300 s"]
    single = [
        (["warmup", "fit", *warm, *at], "W1", "warmup", ";".join(warm)),
        (["array", "calibrate", "still.csv", "--moving", "moving.csv"], "A1", "array", "still.csv;moving.csv"),
        (["array", "calibrate", "still.csv"], "A2", "array", "still.csv"),
        (["centrifuge", "reduce", "c/manifest.toml"], "C1", "centrifuge", "c/manifest.toml"),
    ]
    rows = [{"serial": serial, "procedure": procedure, "file": file} for _, serial, procedure, file in single]
    rows[0] |= {"temperatures": "0,20,40", "model": "knot-cubic", "settling-time": "300 s"}
    write_manifest(tmp_path / "m.csv", rows)
    state = run(tmp_path / "m.csv", tmp_path / "out")
    assert [row.reason for row in state.failures] == []
    for arguments, serial, _, _ in single:
        done = imulab(*arguments, "-o", "one.json")
        assert done.returncode == 0, done.stderr
        many, one = il.load(tmp_path / "out" / f"{serial}.json"), il.load(tmp_path / "one.json")
        assert (many.parameters, many.covariance) == (one.parameters, one.covariance)
        assert many.sections.get("table") == one.sections.get("table")
    assert run(tmp_path / "m.csv", tmp_path / "out").kept == 4
    runs = sorted((tmp_path / "c").glob("*.csv"))
    runs[0].write_text(runs[0].read_text() + "\n")  # a run that only the test's own manifest names
    assert run(tmp_path / "m.csv", tmp_path / "out").kept == 3


# ---- what is done, and what is done again --------------------------------------------------------------------------


def test_a_second_run_does_nothing_and_writes_nothing(tmp_path):
    manifest = make_fleet(tmp_path / "in", 4, order=1)
    assert run(manifest, tmp_path / "out").kept == 0
    before = records(tmp_path / "out")
    again = run(manifest, tmp_path / "out")
    assert (again.kept, again.count("done")) == (4, 4)
    assert records(tmp_path / "out") == before


def test_only_what_changed_is_done_again(tmp_path):
    manifest = make_fleet(tmp_path / "in", 6, order=1)
    run(manifest, tmp_path / "out")
    before = records(tmp_path / "out")
    write_attitudes(tmp_path / "in" / "u0.csv", attitudes(100))
    (tmp_path / "out" / "SN003.json").unlink()
    text = (tmp_path / "out" / "SN004.json").read_text()
    (tmp_path / "out" / "SN004.json").write_text(text.replace('"value": 0.', '"value": 1.', 1))
    (tmp_path / "in" / "u5.csv").rename(tmp_path / "in" / "moved.csv")

    def change(rows):
        rows[1]["method"] = "linearised"
        rows[5]["file"] = "moved.csv"

    edited(manifest, change)
    state = run(manifest, tmp_path / "out")
    after = records(tmp_path / "out")
    assert {serial for serial in after if after[serial] != before[serial]} == {
        "SN000",
        "SN001",
        "SN003",
        "SN004",
        "SN005",
    }
    assert state.kept == 1
    assert il.load(tmp_path / "out" / "SN001.json").fit["method"] == "linearised"


def test_a_layout_that_changed_counts_as_a_change(tmp_path):
    np.savetxt(tmp_path / "raw.txt", attitudes(3))
    layout = "[columns]\n" + "".join(f'accel_{a} = {{ from = {i}, unit = "m/s^2" }}\n' for i, a in enumerate("xyz"))
    (tmp_path / "l.toml").write_text(layout)
    row = {"serial": "A", "procedure": "tumble", "file": "raw.txt", "layout": "l.toml", "order": "1"}
    manifest = write_manifest(tmp_path / "m.csv", [row])
    assert run(manifest, tmp_path / "out").count("done") == 1
    assert run(manifest, tmp_path / "out").kept == 1
    assert fleet_status(str(tmp_path / "out")).shown()[0].startswith("1 unit of ")
    (tmp_path / "l.toml").write_text(layout + "# said otherwise\n")
    assert run(manifest, tmp_path / "out").kept == 0


def test_one_units_failure_is_that_units_alone(imulab, tmp_path):
    make_fleet(tmp_path / "in", 4, order=1)
    (tmp_path / "in" / "u1.csv").write_text("accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2]\n1,2,three\n")
    (tmp_path / "in" / "u2.csv").unlink()
    done = imulab("fleet", "run", "in/manifest.csv", "-o", "out", "--workers", 1)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith(
        "imulab: 2 of 4 units failed: SN001: u1.csv: row 1 (line 2), column accel_z: expected"
    )
    assert "failed: SN002 (u2.csv): u2.csv: no such file" in done.stdout
    assert set(records(tmp_path / "out")) == {"SN000", "SN003"}
    with (tmp_path / "out" / "parameters.csv").open() as stream:
        rows = {row["serial"]: row for row in csv.DictReader(stream)}
    assert rows["SN001"]["status"] == "failed"
    assert "row 1 (line 2)" in rows["SN001"]["reason"]
    assert rows["SN000"]["reason"] == ""
    status = imulab("fleet", "status", "out")
    assert status.returncode == 2
    assert "4 units of in/manifest.csv: 2 done, 2 failed, 0 missing" in status.stdout
    assert "failed: SN001 (u1.csv): u1.csv: row 1 (line 2)" in status.stdout
    assert status.stderr == ""
    write_attitudes(tmp_path / "in" / "u1.csv", attitudes(1))
    write_attitudes(tmp_path / "in" / "u2.csv", attitudes(2))
    before = records(tmp_path / "out")
    assert imulab("fleet", "run", "in/manifest.csv", "-o", "out", "--workers", 1).returncode == 0
    assert {k: v for k, v in records(tmp_path / "out").items() if k in before} == before
    assert imulab("fleet", "status", "out").returncode == 0


def test_a_record_whose_file_has_become_bad_is_put_aside_not_lost(tmp_path):
    manifest = make_fleet(tmp_path / "in", 1, order=1)
    run(manifest, tmp_path / "out")
    text = (tmp_path / "out" / "SN000.json").read_text()
    (tmp_path / "in" / "u0.csv").write_text("")
    assert run(manifest, tmp_path / "out").failures[0].reason == "u0.csv: the file is empty"
    assert records(tmp_path / "out") == {}
    (aside,) = (tmp_path / "out" / ".fleet" / "superseded").iterdir()
    assert aside.read_text() == text


def test_the_manifests_serial_is_the_records_and_another_in_the_file_is_a_warning(tmp_path):
    manifest = make_fleet(tmp_path / "in", 2, order=1)
    write_attitudes(tmp_path / "in" / "u0.csv", attitudes(0), "# serial: OTHER\n# date: 2026-03-01T10:00:00\n")
    write_attitudes(tmp_path / "in" / "u1.csv", attitudes(1), "# serial: SN001\n")
    state = run(manifest, tmp_path / "out")
    first, second = (il.load(tmp_path / "out" / f"SN00{i}.json") for i in range(2))
    assert first.sensor["serial"] == "SN000"
    assert [w for w in first.warnings if "serial" in w] == [
        "the file states serial 'OTHER', the manifest 'SN000': the manifest's is used"
    ]
    assert not [w for w in second.warnings if "serial" in w]
    assert state.rows[0].summary.date == "2026-03-01T10:00:00"


def test_what_a_killed_run_has_left_is_cleared(tmp_path):
    manifest = make_fleet(tmp_path / "in", 1, order=1)
    run(manifest, tmp_path / "out")
    for name in (".imulab.abc.part", ".fleet/.imulab.def.part", ".fleet/active/SN000"):
        (tmp_path / "out" / name).write_text("half")
    run(manifest, tmp_path / "out")
    assert not list((tmp_path / "out").rglob("*.part"))
    assert not list((tmp_path / "out" / ".fleet" / "active").iterdir())


def test_a_second_run_on_the_folder_is_refused_while_one_is_at_work(tmp_path, capsys):
    manifest = make_fleet(tmp_path / "in", 1, order=1)
    run(manifest, tmp_path / "out")
    with Store(tmp_path / "out").run():
        assert str(fleet_status(str(tmp_path / "out")).at_work).startswith(f"process {os.getpid()} on ")
        assert main(["fleet", "run", str(manifest), "-o", str(tmp_path / "out"), "--workers", "1"]) == 2
        assert f"another run is at work on it (process {os.getpid()} on " in capsys.readouterr().err
    run(manifest, tmp_path / "out")
    assert fleet_status(str(tmp_path / "out")).at_work is None


# ---- manifest ------------------------------------------------------------------------------------------------------


def test_a_parquet_manifest_is_as_good_as_csv(tmp_path):
    import polars

    manifest = make_fleet(tmp_path / "in", 3, order=1)
    frame = polars.read_csv(manifest).with_columns(method=polars.Series([None, "linearised", None]))
    frame.write_parquet(tmp_path / "in" / "manifest.parquet")
    units = load_fleet(str(tmp_path / "in" / "manifest.parquet")).units
    assert [u.options for u in units] == [
        {"gravity": "9.80665", "order": "1", **({"method": "linearised"} if i == 1 else {})} for i in range(3)
    ]
    assert run(tmp_path / "in" / "manifest.parquet", tmp_path / "out").count("done") == 3


def test_a_parquet_manifest_that_is_cut_or_cannot_be_read_is_said(tmp_path, monkeypatch):
    (tmp_path / "m.parquet").write_bytes(b"PAR1" + bytes(100))
    with pytest.raises(ReadError, match=r"m\.parquet: not a whole Parquet file"):
        load_fleet(str(tmp_path / "m.parquet"))
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ReadError, match=r"m\.parquet: Parquet needs pyarrow.*pip install '\.\[tables\]'"):
        load_fleet(str(tmp_path / "m.parquet"))


def test_manifest_and_files_may_be_urls(tmp_path, monkeypatch):
    manifest = make_fleet(tmp_path / "in", 2, order=1)
    state = run(manifest.as_uri(), tmp_path / "url")
    assert state.count("done") == 2
    assert run(manifest, tmp_path / "path").count("done") == 2
    assert plain(tmp_path / "url" / "SN001.json") == plain(tmp_path / "path" / "SN001.json")
    import fsspec

    from imulab.fleet import manifest as sources

    monkeypatch.setattr(sources, "SCHEMES", (*sources.SCHEMES, "memory"))
    memory = fsspec.filesystem("memory")
    for name in ("u0.csv", "u1.csv", "manifest.csv"):
        memory.pipe(f"/line/{name}", (tmp_path / "in" / name).read_bytes())
    assert run("memory://line/manifest.csv", tmp_path / "memory").count("done") == 2
    assert plain(tmp_path / "memory" / "SN001.json") == plain(tmp_path / "path" / "SN001.json")
    assert run("memory://line/manifest.csv", tmp_path / "memory").kept == 2


def test_a_url_of_no_file_fails_its_unit(tmp_path):
    address = (tmp_path / "none.csv").as_uri()
    manifest = write_manifest(tmp_path / "m.csv", [{"serial": "A", "procedure": "tumble", "file": address}])
    assert run(manifest, tmp_path / "out").failures[0].reason == f"{address}: no such file"


ROW = "A1,tumble,a.csv,9.81"


BAD_MANIFESTS = {
    "no rows": ("serial,procedure,file\n", ["m.csv: no rows below the titles"]),
    "empty": ("", ["m.csv: the file is empty", "serial,procedure,file"]),
    "no column": ("serial,file\nA,a.csv\n", ["m.csv: no column procedure; found serial file"]),
    "unknown column": ("serial,procedure,file,gravitiy\n" + ROW, ["unknown column 'gravitiy'", "gravity"]),
    "semicolons": ("serial;procedure;file\n", ["columns are separated by ';'; expected commas"]),
    "tabs": ("serial\tprocedure\tfile\n", ["columns are separated by '\\t'; expected commas"]),
    "column twice": ("serial,procedure,file,file\n" + ROW, ["column file appears twice"]),
    "unknown procedure": ("serial,procedure,file\nA,tumbel,a.csv\n", ["row 1 (line 2)", "'tumbel'", "tumble array"]),
    "duplicate": (
        "serial,procedure,file\nA,tumble,a.csv\n\nA,tumble,b.csv\n",
        ["row 2 (line 4)", "'A' is already in row 1"],
    ),
    "duplicate but for case": ("serial,procedure,file\nA,tumble,a.csv\na,tumble,b.csv\n", ["row 2", "as 'A'"]),
    "path as serial": ("serial,procedure,file\n../A,tumble,a.csv\n", ["row 1 (line 2), column serial: '../A'"]),
    "hidden serial": ("serial,procedure,file\n.fleet,tumble,a.csv\n", ["'.fleet' cannot name"]),
    "no serial": ("serial,procedure,file\n,tumble,a.csv\n", ["column serial: ''"]),
    "absolute serial": ("serial,procedure,file\n/etc/x,tumble,a.csv\n", ["'/etc/x' cannot name"]),
    "reserved serial": ("serial,procedure,file\nnul,tumble,a.csv\n", ["'nul' cannot name"]),
    "long serial": (f"serial,procedure,file\n{'A' * 200},tumble,a.csv\n", ["at most 120 bytes"]),
    "no file": ("serial,procedure,file\nA,tumble,\n", ["column file: tumble takes one recording"]),
    "too many files": ("serial,procedure,file\nA,tumble,a.csv;b.csv\n", ["found 'a.csv;b.csv'"]),
    "empty file in a list": ("serial,procedure,file\nA,array,a.csv;\n", ["array takes STILL, or STILL;MOVING"]),
    "standard input": ("serial,procedure,file\nA,tumble,-\n", ["expected names of files, found '-'"]),
    "option of another": (
        "serial,procedure,file,order\nA,tumble,a.csv,1\nB,array,b.csv,1\n",
        ["row 2 (line 3), column order: not an option of array; its options: averaging method memory"],
    ),
    "bad option": (
        "serial,procedure,file,order\nA,tumble,a.csv,9\n",
        ["row 1 (line 2): column order '9'", "auto 0 1 2"],
    ),
    "bad gravity": (
        "serial,procedure,file,gravity\nA,tumble,a.csv,much\n",
        ["column gravity 'much': expected a number"],
    ),
    "both gravities": (
        "serial,procedure,file,gravity,latitude\nA,tumble,a.csv,9.8,48\n",
        ["column gravity together with column latitude"],
    ),
    "bad window": ("serial,procedure,file,window\nA,tumble,a.csv,5\n", ["column window '5': expected FROM:TO"]),
    "too few fields": ("serial,procedure,file\nA,tumble\n", ["row 1 (line 2): expected 3 fields, found 2"]),
    "open quote": ('serial,procedure,file\n"A,tumble,a.csv\n', ["m.csv: line 2: unexpected end of data"]),
    "binary": ("serial\0,procedure,file\n", ["expected text or Parquet, found binary data"]),
    "cut parquet": ("PAR1 and then nothing", ["not a whole Parquet file"]),
    "bad centrifuge option": (
        "serial,procedure,file,curve\nA,centrifuge,a.toml,c9\n",
        ["row 1 (line 2): column curve 'c9'"],
    ),
}


@pytest.mark.parametrize("case", BAD_MANIFESTS)
def test_a_bad_manifest_is_refused_before_any_work(case, tmp_path, capsys):
    text, expected = BAD_MANIFESTS[case]
    (tmp_path / "m.csv").write_text(text)
    assert main(["fleet", "run", str(tmp_path / "m.csv"), "-o", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    for part in expected:
        assert part in error
    assert not (tmp_path / "out").exists()


def test_other_refusals_name_what_is_wrong_and_leave_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    manifest = str(make_fleet(tmp_path / "in", 1, order=1))
    (tmp_path / "file").write_text("")
    (tmp_path / "latin.csv").write_bytes(b"serial,procedure,file\n\xe9,tumble,a\n")
    for arguments, expected in [
        ([manifest, "-o", "file"], "file: expected a folder to write to, found a file"),
        (["none.csv", "-o", "out"], "none.csv: no such file"),
        (["latin.csv", "-o", "out"], "latin.csv: expected UTF-8 text or Parquet"),
        ([manifest, "-o", "out", "--engine", "spark"], "engine 'spark': unknown engine; known engines: local dask"),
        ([manifest, "-o", "out", "--scheduler", "tcp://x:1"], "--scheduler 'tcp://x:1' needs --engine dask"),
        ([manifest, "-o", "out", "--workers", "0"], "--workers 0: expected 1 or more"),
        ([manifest, "-o", "out", "--workers", "two"], "--workers 'two': expected a whole number"),
        ([manifest, "-o", "out", "--table", "t.xlsx"], "t.xlsx: cannot write this kind of file; expected a name that "),
        ([manifest, "-o", "out", "--table", "no/t.csv"], "no/t.csv: cannot be written: no such folder"),
        ([manifest, "-o", "out", "--history", "mysql://x/y"], "history mysql://x/y: expected a URL such as sqlite:///"),
        ([manifest, "-o", "out", "--history", "nothing"], "history 'nothing': expected a URL such as sqlite:///"),
        (
            [manifest, "-o", "out", "--engine", "dask", "--scheduler", "tcp://127.0.0.1:9", "--workers", "2"],
            "--workers together with --scheduler",
        ),
    ]:
        assert main(["fleet", "run", *arguments]) == 2, arguments
        error = capsys.readouterr().err
        assert expected in error
        assert error.count("\n") == 1
        assert not (tmp_path / "out").exists()
    for arguments in (["status", "in"], ["status", "nowhere"], ["report", "in", "-o", "r.html"]):
        assert main(["fleet", *arguments]) == 2
        assert "expected a folder that 'imulab fleet run' has written to" in capsys.readouterr().err
    assert not (tmp_path / "r.html").exists()


def test_errors_are_of_the_family():
    with pytest.raises(ReadError):
        load_fleet("nowhere.csv")
    assert issubclass(OptionError, ImulabError)


# ---- table ---------------------------------------------------------------------------------------------------------


def test_the_table_holds_every_parameter_exactly(tmp_path):
    import polars

    manifest = make_fleet(tmp_path / "in", 3)
    edited(
        manifest,
        lambda rows: (rows[0].update(order="1"), rows[1].update(order="2", gravity=""), rows[2].update(file="no")),
    )
    run(manifest, tmp_path / "out", table=str(tmp_path / "t.parquet"))
    run(manifest, tmp_path / "out")
    with (tmp_path / "out" / "parameters.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    frame = polars.read_parquet(tmp_path / "t.parquet")
    assert frame.columns == list(rows[0])
    assert [row["status"] for row in rows] == ["done", "done", "failed"]
    for row, other in zip(rows[:2], frame.to_dicts(), strict=False):
        record = il.load(tmp_path / "out" / f"{row['serial']}.json")
        assert row["content_sha256"] == record.to_dict()["content_sha256"] == other["content_sha256"]
        for name, parameter in record.parameters.items():
            assert float(row[f"{name} [{parameter.unit}]"]) == parameter.value
            assert float(row[f"std_{name} [{parameter.unit}]"]) == parameter.standard_uncertainty
            assert other[f"std_{name} [{parameter.unit}]"] == parameter.standard_uncertainty
    assert rows[0]["k2_x [1/(m/s^2)]"] == ""
    assert "no local gravity was given" in rows[1]["warnings"]


def test_status_as_json(tmp_path, capsys):
    manifest = make_fleet(tmp_path / "in", 3, order=1)
    (tmp_path / "in" / "u1.csv").unlink()
    assert main(["fleet", "run", str(manifest), "-o", str(tmp_path / "out"), "--workers", "1", "--json"]) == 2
    ran = json.loads(capsys.readouterr().out)
    (tmp_path / "out" / "SN002.json").unlink()
    assert main(["fleet", "status", str(tmp_path / "out"), "--json"]) == 2
    found = json.loads(capsys.readouterr().out)
    assert (ran["done"], ran["failed"], ran["missing"]) == (2, 1, 0)
    assert (found["done"], found["failed"], found["missing"]) == (1, 1, 1)
    assert found["failures"] == ran["failures"] == [
        {"serial": "SN001", "files": ["u1.csv"], "reason": "u1.csv: no such file"}
    ]  # fmt: skip


def test_a_record_to_look_at_first_is_said_with_its_reason(imulab, tmp_path):
    manifest = make_fleet(tmp_path / "in", 3)
    knocked = attitudes(2)
    knocked[5] *= 1.01
    write_attitudes(tmp_path / "in" / "u2.csv", knocked)
    write_attitudes(tmp_path / "in" / "u1.csv", attitudes(1), "# serial: OTHER\n")  # worth knowing, and no more
    ran = imulab("fleet", "run", "in/manifest.csv", "-o", "out", "--workers", 1)
    status = imulab("fleet", "status", "out")
    assert (ran.returncode, status.returncode) == (0, 0)
    assert "verdicts: 2 good, 1 look: SN002 row 6 (line 7) set aside" in ran.stdout
    assert "3 done, 0 failed, 0 missing; 2 good, 1 look: SN002 row 6 (line 7) set aside" in status.stdout
    with (tmp_path / "out" / "parameters.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [row["verdict"] for row in rows] == ["good", "good", "look"]
    assert [row["reason"][:5] for row in rows] == ["", "", "row 6"]
    assert "OTHER" in rows[1]["warnings"]
    assert imulab("fleet", "report", "out", "-o", "r.html").returncode == 0
    page = (tmp_path / "r.html").read_text()
    assert "3 of 3 units have their record: 2 good, 1 look (SN002); too few units (3 of 8) to tell which" in page
    assert "none stands out" not in page
    found = page[page.index("The verdict of each unit") :]
    assert (
        '<td>SN002</td><td class="text">tumble</td><td class="text">look</td><td class="text">row 6 (line 7)' in found
    )
    assert found.index("SN002") < found.index("SN000")
    found = json.loads(imulab("fleet", "status", "out", "--json").stdout)
    assert found["verdicts"] == {"good": 2, "look": 1, "bad": 0}
    (doubtful,) = found["doubtful"]
    assert (doubtful["serial"], doubtful["verdict"]) == ("SN002", "look")
    assert doubtful["reasons"][0].startswith("row 6")
    assert doubtful["next"]
    write_manifest(manifest, [{"serial": f"N{i}", "procedure": "tumble", "file": f"u{i}.csv"} for i in range(2)])
    alike = run(manifest, tmp_path / "alike").judged
    assert alike.startswith("2 look: N0, N1 no local gravity was given")
    assert alike.count("no local gravity") == 1


def test_without_sqlalchemy_there_is_no_history_and_one_line_says_so(tmp_path):
    manifest = make_fleet(tmp_path / "in", 1, order=1)
    code = (
        "import sys; sys.modules['sqlalchemy'] = None; from imulab.cli import main; "
        f"sys.exit(main(['fleet', 'run', {str(manifest)!r}, '-o', {str(tmp_path / 'out')!r}, '--workers', '1']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert done.stderr == (
        "imulab: warning: no history is kept: the history needs SQLAlchemy: "
        "pip install '.[fleet]' in imulab's source folder\n"
    )


def run_careful(manifest, folder):
    return run_fleet(str(manifest), str(folder), workers=1)


def test_nothing_that_a_run_reads_is_written_over(imulab, tmp_path):
    manifest = make_fleet(tmp_path / "in", 2)
    before = {path: path.read_bytes() for path in (tmp_path / "in").iterdir()}
    for table, kept in (("in/manifest.csv", "in/manifest.csv"), ("in/u1.csv", "u1.csv"), ("in/../in/u0.csv", "u0.csv")):
        done = imulab("fleet", "run", "in/manifest.csv", "-o", "out", "--table", table)
        assert done.returncode == 2
        assert done.stderr == f"imulab: {table}: would overwrite {kept}; expected another name or folder\n"
    manifest.rename(tmp_path / "in" / "parameters.csv")
    done = imulab("fleet", "run", "in/parameters.csv", "-o", "in")
    assert done.returncode == 2
    assert "in/parameters.csv: would overwrite in/parameters.csv" in done.stderr
    (tmp_path / "in" / "parameters.csv").rename(manifest)
    edited(manifest, lambda rows: [row.update(prior=f"{row['serial']}.json", order="") for row in rows])
    done = imulab("fleet", "run", "in/manifest.csv", "-o", "in")
    assert done.returncode == 2
    assert "in/SN000.json: would overwrite SN000.json" in done.stderr
    manifest.write_bytes(before[manifest])
    assert {path: path.read_bytes() for path in (tmp_path / "in").iterdir()} == before
    assert not (tmp_path / "out").exists()


def test_no_report_is_written_over_a_record(imulab, tmp_path):
    make_fleet(tmp_path / "in", 2)
    assert imulab("fleet", "run", "in/manifest.csv", "-o", "out", "--workers", 1).returncode == 0
    before = {path: path.read_bytes() for path in (*(tmp_path / "in").iterdir(), *(tmp_path / "out").glob("[!.]*"))}
    for name in ("out/SN001.json", "out/parameters.csv", "out/history.sqlite", "in/manifest.csv", "in/u0.csv"):
        done = imulab("fleet", "report", "out", "-o", name)
        assert done.returncode == 2
        assert done.stderr.startswith(f"imulab: {name}: would overwrite ")
    done = imulab("fleet", "report", "out", "-o", "r.txt")
    assert done.returncode == 2
    assert done.stderr == "imulab: r.txt: a report is HTML; expected a name that ends in .html\n"
    assert not (tmp_path / "r.txt").exists()
    done = imulab("fleet", "run", "in/manifest.csv", "-o", "out", "--workers", 1, "--table", "out/SN001.json")
    assert done.returncode == 2
    assert all(path.read_bytes() == data for path, data in before.items())


def test_a_folder_without_a_name_is_refused(imulab, tmp_path):
    make_fleet(tmp_path / "in", 1)
    done = imulab("fleet", "run", "in/manifest.csv", "-o", "")
    assert done.returncode == 2
    assert done.stderr == "imulab: -o '' is empty; expected DIR; see 'imulab fleet run --help'\n"
    with pytest.raises(OptionError, match="output '': expected the name of a folder to write to"):
        run_fleet(tmp_path / "in" / "manifest.csv", "")
    assert [path.name for path in tmp_path.iterdir()] == ["in"]


def test_a_history_that_is_not_there_is_not_made_by_a_report(imulab, tmp_path):
    make_fleet(tmp_path / "in", 1)
    assert imulab("fleet", "run", "in/manifest.csv", "-o", "out", "--workers", 1).returncode == 0
    done = imulab("fleet", "report", "out", "-o", "r.html", "--history", "sqlite:///gone.sqlite")
    assert (done.returncode, done.stderr) == (2, "imulab: history sqlite:///gone.sqlite: no such file\n")
    assert not (tmp_path / "gone.sqlite").exists()
    assert not (tmp_path / "r.html").exists()


def test_one_file_under_two_serials_is_said(tmp_path):
    manifest = make_fleet(tmp_path / "in", 4)
    assert run_careful(manifest, tmp_path / "out").notes == ()
    edited(manifest, lambda rows: rows[2].update(file="u0.csv"))
    (note,) = run_careful(manifest, tmp_path / "out").notes
    assert note == "serials SN000, SN002 were made from files of the same content: is a file named twice?"
    edited(
        manifest, lambda rows: [row.update(order="1" if number == 2 else "") for number, row in enumerate(rows)]
    )  # as of a log
    assert run_careful(manifest, tmp_path / "out").notes == ()


def test_records_of_another_version_are_kept_and_said(tmp_path, monkeypatch):
    manifest = make_fleet(tmp_path / "in", 2)
    run_careful(manifest, tmp_path / "out")
    monkeypatch.setattr("imulab.fleet.run.VERSION", "9.9")
    before = records(tmp_path / "out")
    state = run_careful(manifest, tmp_path / "out")
    assert records(tmp_path / "out") == before
    (note,) = state.notes
    assert note.startswith("2 records of another version (imulab 0.")
    assert note.endswith("use another folder")


def test_a_simulated_line_is_found_as_it_was_made(imulab, tmp_path):
    done = imulab("fleet", "simulate", "-o", "line", "--units", 10, "--seed", 3)
    assert done.stdout == "manifests: line/first.csv line/second.csv\nlimits: line/limits.toml\n"
    for name in ("first", "second"):
        assert run_careful(tmp_path / "line" / f"{name}.csv", tmp_path / "out").count("done") == 10
    for number in range(1, 11):
        truth = il.read(tmp_path / "line" / f"second_{number:04d}.csv").metadata
        record = il.load(tmp_path / "out" / f"LINE-{number:04d}.json")
        assert record.sections["fleet"]["date"] == truth["date"]
        for name, parameter in record.parameters.items():
            assert abs(parameter.value - float(truth[f"truth_{name}"])) < 5 * parameter.standard_uncertainty


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--units", "7"], "--units 7: expected 8 to 2000"),
        (["--units", "many"], "--units 'many': expected a whole number"),
        (["--seed", "-1"], "--seed -1: expected a whole number from 0"),
        (["-o", ""], "-o '' is empty; expected DIR; see 'imulab fleet simulate --help'"),
        (["-o", "file/line"], "file/line: the folder cannot be made: Not a directory"),
    ],
)
def test_a_line_that_cannot_be_is_refused(imulab, tmp_path, arguments, message):
    (tmp_path / "file").write_text("")
    done = imulab("fleet", "simulate", "-o", "line", *arguments)
    assert (done.returncode, done.stderr) == (2, f"imulab: {message}\n")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_half_written_file_of_a_killed_worker_does_not_outlive_the_run(tmp_path, monkeypatch):
    manifest = make_fleet(tmp_path / "in", 2)
    part, held = tmp_path / "out" / ".imulab.x.part", tmp_path / "out" / ".fleet" / "turn"

    def killed_under_it(unit, job):
        part.write_text("{")
        return work(unit, job)

    monkeypatch.setattr("imulab.fleet.engine.work", killed_under_it)
    assert run_careful(manifest, tmp_path / "out").count("done") == 2
    assert not part.exists()
    part.write_text("{")
    with held.open("a") as stream:  # a worker that is still at a unit may be the one that writes it
        fcntl.flock(stream, fcntl.LOCK_SH)
        Store(tmp_path / "out").tidy()
        assert part.exists()
    Store(tmp_path / "out").tidy()
    assert not part.exists()


def test_a_file_called_like_a_layout_that_comes_along_is_the_file(imulab, tmp_path):
    manifest = make_fleet(tmp_path / "in", 1)
    (tmp_path / "in" / "u0.csv").rename(tmp_path / "in" / "phyphox")
    edited(manifest, lambda rows: rows[0].update(file="phyphox"))
    first = run_careful(manifest, tmp_path / "out")
    assert [row.summary.inputs for row in first.rows] == [(sha256_of(tmp_path / "in" / "phyphox", "phyphox"),)]
    edited(manifest, lambda rows: rows[0].update(file="u0.csv", layout="phyphox"))
    (tmp_path / "in" / "u0.csv").write_text(
        "Time (s),Acceleration x (m/s^2),Acceleration y (m/s^2),Acceleration z (m/s^2)\n0,1,2,3\n"
    )
    done = imulab("fleet", "run", "in/manifest.csv", "-o", "named", "--workers", 1)
    assert "u0.csv: 1 sample over 0 s is too few to find static attitudes" in done.stderr  # its columns were known

"""Fleets: what must not be lost, and what is said of the records as a whole."""

import csv
import fcntl

import pytest

import imulab as il
from fleets import make_fleet, records, write_manifest
from imulab.fleet.engine import work
from imulab.fleet.manifest import sha256_of
from imulab.fleet.run import run_fleet
from imulab.fleet.store import Store


def run(manifest, folder):
    return run_fleet(str(manifest), str(folder), workers=1)


def edited(manifest, change):
    with manifest.open() as stream:
        rows = list(csv.DictReader(stream))
    change(rows)
    return write_manifest(manifest, rows)


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
    done = imulab("fleet", "run", "in/manifest.csv", "-o", "out", "--workers", 1, "--table", "out/SN001.json")
    assert done.returncode == 2
    assert all(path.read_bytes() == data for path, data in before.items())


def test_a_folder_without_a_name_is_refused(imulab, tmp_path):
    make_fleet(tmp_path / "in", 1)
    done = imulab("fleet", "run", "in/manifest.csv", "-o", "")
    assert (done.returncode, done.stderr) == (2, "imulab: output '': expected the name of a folder to write to\n")
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
    assert run(manifest, tmp_path / "out").notes == ()
    edited(manifest, lambda rows: rows[2].update(file="u0.csv"))
    (note,) = run(manifest, tmp_path / "out").notes
    assert note == "serials SN000, SN002 were made from files of the same content: is a file named twice?"
    edited(
        manifest, lambda rows: [row.update(order="1" if number == 2 else "") for number, row in enumerate(rows)]
    )  # as of a log
    assert run(manifest, tmp_path / "out").notes == ()


def test_records_of_another_version_are_kept_and_said(tmp_path, monkeypatch):
    manifest = make_fleet(tmp_path / "in", 2)
    run(manifest, tmp_path / "out")
    monkeypatch.setattr("imulab.fleet.run.VERSION", "9.9")
    before = records(tmp_path / "out")
    state = run(manifest, tmp_path / "out")
    assert records(tmp_path / "out") == before
    (note,) = state.notes
    assert note.startswith("2 records of another version (imulab 0.")
    assert note.endswith("use another folder")


def test_a_simulated_line_is_found_as_it_was_made(imulab, tmp_path):
    done = imulab("fleet", "simulate", "-o", "line", "--units", 10, "--seed", 3)
    assert done.stdout == "manifests: line/first.csv line/second.csv\nlimits: line/limits.toml\n"
    for name in ("first", "second"):
        assert run(tmp_path / "line" / f"{name}.csv", tmp_path / "out").count("done") == 10
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
        (["-o", ""], "output '': expected the name of a folder to write to"),
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
    assert run(manifest, tmp_path / "out").count("done") == 2
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
    first = run(manifest, tmp_path / "out")
    assert [row.summary.inputs for row in first.rows] == [(sha256_of(tmp_path / "in" / "phyphox", "phyphox"),)]
    edited(manifest, lambda rows: rows[0].update(file="u0.csv", layout="phyphox"))
    (tmp_path / "in" / "u0.csv").write_text(
        "Time (s),Acceleration x (m/s^2),Acceleration y (m/s^2),Acceleration z (m/s^2)\n0,1,2,3\n"
    )
    done = imulab("fleet", "run", "in/manifest.csv", "-o", "named", "--workers", 1)
    assert "u0.csv: 1 samples over 0 s are too few to find static attitudes" in done.stderr  # its columns were known

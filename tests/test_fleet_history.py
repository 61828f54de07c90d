"""History: SQLite by default, PostgreSQL where a server can be started; the next run knows the last."""

import csv
import json
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import pytest
from sqlalchemy import create_engine, text

from fleets import attitudes, children, command, make_fleet, wait_for, workers_of, write_attitudes, write_manifest
from imulab.cli import main
from imulab.errors import OptionError
from imulab.fleet.history import open_history
from imulab.fleet.run import run_fleet


def run(manifest, folder, **options):
    return run_fleet(str(manifest), str(folder), workers=1, **options)


def again(folder, units):
    for i in range(units):
        write_attitudes(folder / f"u{i}.csv", attitudes(500 + i))


def check_history(manifest, out, url):
    """Two calibrations of three units, and one of them a third time: each is there once, oldest first, exactly."""
    first = run(manifest, out, history=url)
    run(manifest, out, history=url)
    again(manifest.parent, 3)
    second = run(manifest, out, history=url)
    with open_history(url) as history:
        past = history.of([f"SN00{i}" for i in range(3)] + ["SN999"])
    assert set(past) == {"SN000", "SN001", "SN002"}
    for row, other in zip(first.rows, second.rows, strict=True):
        kept = past[row.unit.serial]
        assert [item.content_sha256 for item in kept] == [s.summary.content_sha256 for s in (row, other)]
        assert kept[0].parameters == row.summary.parameters  # to the last bit
        assert kept[0].freedom == row.summary.freedom
        assert kept[0].sources != kept[1].sources


def test_sqlite_in_the_folder_is_the_default(tmp_path):
    manifest = make_fleet(tmp_path / "in", 3, order=1)
    run(manifest, tmp_path / "out")
    assert (tmp_path / "out" / "history.sqlite").is_file()
    check_history(manifest, tmp_path / "again", f"sqlite:///{tmp_path / 'line.sqlite'}")
    assert not (tmp_path / "again" / "history.sqlite").exists()


def test_no_history_on_request(tmp_path):
    run(make_fleet(tmp_path / "in", 1, order=1), tmp_path / "out", history="none")
    assert not (tmp_path / "out" / "history.sqlite").exists()


def test_a_history_that_lost_a_run_is_filled_by_the_next(tmp_path):
    """The driver may be killed between record and history: the record is the truth."""
    manifest = make_fleet(tmp_path / "in", 2, order=1)
    run(manifest, tmp_path / "out")
    (tmp_path / "out" / "history.sqlite").unlink()
    assert run(manifest, tmp_path / "out").kept == 2
    with open_history(f"sqlite:///{tmp_path / 'out' / 'history.sqlite'}") as history:
        assert [len(items) for items in history.of(["SN000", "SN001"]).values()] == [1, 1]


def test_a_file_that_is_no_history_is_refused_with_its_name(tmp_path, capsys):
    manifest = make_fleet(tmp_path / "in", 1, order=1)
    (tmp_path / "bad.sqlite").write_text("this is text, and no database at all")
    url = f"sqlite:///{tmp_path / 'bad.sqlite'}"
    assert main(["fleet", "run", str(manifest), "-o", str(tmp_path / "out"), "--history", url]) == 2
    assert capsys.readouterr().err == f"imulab: --history {url}: file is not a database\n"
    assert not (tmp_path / "out").exists()
    other = tmp_path / "other.sqlite"
    engine = create_engine(f"sqlite:///{other}")
    with engine.begin() as connection:
        connection.execute(text("CREATE TABLE imulab_calibrations (id INTEGER)"))
    engine.dispose()
    assert main(["fleet", "run", str(manifest), "-o", str(tmp_path / "out"), "--history", f"sqlite:///{other}"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "other.sqlite: " in error


@dataclass(frozen=True)
class Server:
    """A private PostgreSQL server on the loopback."""

    url: str
    start: Callable[[], None]
    processes: Callable[[], list[int]]

    def kill(self) -> None:
        """End all of its processes without a warning, as a power cut would."""
        there = self.processes()
        for process in there:
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        wait_for(lambda: not any(Path(f"/proc/{process}/exe").exists() for process in there))

    def tell(self, statement: str) -> None:
        """Let the server execute a statement."""
        database = create_engine(self.url.replace("postgresql:", "postgresql+psycopg:"))
        with database.begin() as connection:
            connection.execute(text(statement))
        database.dispose()


@pytest.fixture(scope="module")
def server():
    """A server that a user other than root runs; what it has written survives its kill, as on a disk."""
    found = [shutil.which("postgres"), *sorted(Path("/usr/lib/postgresql").glob("*/bin/postgres"))]
    programs = [Path(path).parent for path in found if path]
    if not programs:
        pytest.skip("no PostgreSQL server on this machine (Debian package postgresql)")
    pytest.importorskip("psycopg")
    user = {}
    if os.geteuid() == 0:
        user = {"user": "nobody", "group": "nogroup"}
        try:
            subprocess.run(["true"], check=True, **user)
        except (LookupError, ValueError, PermissionError):
            pytest.skip("PostgreSQL does not run as root, and there is no user nobody")
    folder = Path(tempfile.mkdtemp(prefix="imulab-postgres-"))
    if user:
        shutil.chown(folder, **user)
    port = 20_000 + os.getpid() % 10_000  # none that the system lends to others while the server is down
    run_as = {"cwd": folder, "check": True, "capture_output": True, **user}
    data = folder / "data"
    subprocess.run(
        [programs[-1] / "initdb", "-D", data, "-U", "line", "--auth=trust", "--no-sync", "-E", "UTF8"], **run_as
    )
    options = f"-p {port} -c listen_addresses=127.0.0.1 -c unix_socket_directories={folder} -c fsync=off"
    pg_ctl = [programs[-1] / "pg_ctl", "-D", data, "-w", "-l", str(folder / "log")]

    def processes() -> list[int]:
        first = int((data / "postmaster.pid").read_text().split()[0])
        return [first, *children(first)]

    def start() -> None:
        for lock in (data / "postmaster.pid", folder / f".s.PGSQL.{port}.lock"):
            lock.unlink(missing_ok=True)  # a killed server that nobody has waited for counts as alive
        subprocess.run([*pg_ctl, "-o", options, "start"], **run_as)

    start()
    yield Server(f"postgresql://line@127.0.0.1:{port}/postgres", start, processes)
    subprocess.run([*pg_ctl, "-m", "immediate", "stop"], **run_as)
    shutil.rmtree(folder)


@pytest.fixture
def postgres(server):
    """URL of the server, whose history is empty."""
    server.tell("DROP TABLE IF EXISTS imulab_parameters, imulab_calibrations")
    return server.url


@pytest.mark.slow
def test_postgresql(tmp_path, postgres):
    manifest = make_fleet(tmp_path / "in", 3, order=1)
    check_history(manifest, tmp_path / "out", postgres)
    assert not (tmp_path / "out" / "history.sqlite").exists()
    assert main(["fleet", "report", str(tmp_path / "out"), "-o", str(tmp_path / "r.html"), "--history", postgres]) == 0
    assert "change since each unit" in (tmp_path / "r.html").read_text()


@pytest.mark.slow
def test_two_lines_write_into_one_history(tmp_path, postgres):
    """Folders of two lines, one unit on both: each calibration is there once."""
    rows = [{"serial": "BOTH", "procedure": "tumble", "file": "u.csv", "order": "1"}]
    for line in ("a", "b"):
        (tmp_path / line).mkdir()
        write_attitudes(tmp_path / line / "u.csv", attitudes(900 + ord(line)))
        run(write_manifest(tmp_path / line / "m.csv", rows), tmp_path / line / "out", history=postgres)
    with open_history(postgres) as history:
        assert len(history.of(["BOTH"])["BOTH"]) == 2


def check_once(url, *folders):
    """Each record of the folders is in the history once, with all of its parameters, and nothing else is.

    Records that two runs make of one unit within a second are the same to the last byte: one calibration.
    """
    made: dict[str, set] = {}
    for path in (path for folder in folders for path in folder.glob("*.json")):
        content = json.loads(path.read_text())
        made.setdefault(path.stem, set()).add((content["content_sha256"], len(content["parameters"])))
    with open_history(url) as history:
        past = history.of(list(made))
    kept = {serial: [(item.content_sha256, len(item.parameters)) for item in items] for serial, items in past.items()}
    assert {serial: sorted(items) for serial, items in kept.items()} == {s: sorted(items) for s, items in made.items()}


UNITS = 40


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Enough units for a run to be caught at its work."""
    return make_fleet(tmp_path_factory.mktemp("fleet"), UNITS, order=1)


def begun(fleet, folder, url):
    """A run in a process of its own that has made some records."""
    process = command("fleet", "run", fleet, "-o", folder, "--workers", 2, "--history", url)
    wait_for(lambda: len(list(folder.glob("*.json"))) >= 5)
    return process


@pytest.mark.parametrize(
    "lost", ["connection", *(pytest.param(lost, marks=pytest.mark.slow) for lost in ("server", "worker"))]
)
def test_what_is_lost_during_a_run_leaves_each_calibration_in_the_history_once(fleet, server, postgres, tmp_path, lost):
    folder = tmp_path / "out"
    process = begun(fleet, folder, postgres)
    if lost == "server":
        server.kill()
    elif lost == "connection":
        server.tell("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE pid <> pg_backend_pid()")
    else:
        os.kill(workers_of(process.pid)[0], signal.SIGKILL)
    out, error = process.communicate()
    assert process.returncode == 0, error
    assert out.startswith(f"{UNITS} units: {UNITS} done, 0 failed")
    if lost == "server":
        assert "the history is not complete: " in out + error
        assert "Traceback" not in error
        refused = command("fleet", "run", fleet, "-o", folder, "--history", postgres)
        message = refused.communicate()[1]
        assert (refused.returncode, message.count("\n")) == (2, 1)
        server.start()
    assert run(fleet, folder, history=postgres).kept == UNITS
    check_once(postgres, folder)


@pytest.mark.slow
def test_two_runs_at_once_into_an_empty_history_lose_nothing(fleet, postgres, tmp_path):
    folders = [tmp_path / line for line in ("a", "b")]
    runs = [command("fleet", "run", fleet, "-o", f, "--workers", 1, "--history", postgres) for f in folders]
    said = [process.communicate() for process in runs]
    assert [(process.returncode, error) for process, (_, error) in zip(runs, said, strict=True)] == [(0, "")] * 2
    check_once(postgres, *folders)


def test_the_tables_are_made_by_many_at_once(server, postgres):
    """Each round begins without tables, and eight connections find none at the same moment."""
    for _ in range(5):
        server.tell("DROP TABLE IF EXISTS imulab_parameters, imulab_calibrations")
        start = threading.Barrier(8)

        def begin(start=start):
            start.wait()
            with open_history(postgres) as history:
                return history.of(["SN000"])

        with ThreadPoolExecutor(8) as pool:
            assert [task.result() for task in [pool.submit(begin) for _ in range(8)]] == [{}] * 8


def test_an_unreachable_postgresql_is_reported_without_its_password(tmp_path, capsys):
    pytest.importorskip("psycopg")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    manifest = make_fleet(tmp_path / "in", 1, order=1)
    url = f"postgresql://line:secret@127.0.0.1:{port}/x"
    assert main(["fleet", "run", str(manifest), "-o", str(tmp_path / "out"), "--history", url]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert f"imulab: --history postgresql://line:***@127.0.0.1:{port}/x: " in error
    assert "secret" not in error


SECRETS = [
    "postgresql://127.0.0.1:{port}/x?user=u&password=hunter2",
    "postgresql://u:hunter2@b@127.0.0.1:{port}/x",
    "postgresql://u:a@hunter2@127.0.0.1:{port}/x",
    "postgresql://u:hunter2/c@127.0.0.1:{port}/x",
    "postgresql://u:hunter2?d@127.0.0.1:{port}/x",
    "postgresql://u:hunter2%40e@127.0.0.1:{port}/x",
    "postgresql://u@127.0.0.1:{port}/x?sslpassword=hunter2&sslmode=disable",
    "postgresql://127.0.0.1:{port}/x?sslmode=disable;PASSWORD=hunter2",
    "postgresql://127.0.0.1:{port}/x?odd=1&password=hunter2",
    "postgresql://u:hunter2@127.0.0.1:port/x",
    "postgresql://:hunter2@127.0.0.1:{port}/x",
    "mysql://u:hunter2@127.0.0.1:{port}/x",
    "mysql://u:a@hunter2@127.0.0.1:{port}/x?password=hunter2",
    "sqlite://u:hunter2@host/history.sqlite",
    "nonsense://u:hunter2@",
]


@pytest.mark.parametrize("url", SECRETS)
def test_no_form_of_a_url_shows_its_password(url, tmp_path, capsys, monkeypatch):
    pytest.importorskip("psycopg")
    monkeypatch.chdir(tmp_path)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with pytest.raises(OptionError) as caught, open_history(url.format(port=port)):
        pass
    told = "".join(traceback.format_exception(caught.value))
    assert "hunter2" not in told
    manifest = make_fleet(tmp_path / "in", 1, order=1)
    assert main(["fleet", "run", str(manifest), "-o", "out", "--workers", "1", "--history", url.format(port=port)]) == 2
    shown = capsys.readouterr()
    assert "hunter2" not in shown.out + shown.err
    assert shown.err.count("\n") == 1
    assert not [f for f in Path("out").rglob("*") if f.is_file() and b"hunter2" in f.read_bytes()]


def test_the_table_is_written_where_the_history_fails(tmp_path):
    manifest = make_fleet(tmp_path / "in", 1, order=1)
    run(manifest, tmp_path / "out")
    (tmp_path / "out" / "parameters.csv").unlink()
    (tmp_path / "out" / "history.sqlite").write_text("gone bad, and no database any more, as one sees")
    state = run(manifest, tmp_path / "out")
    assert state.notes[0].startswith("no history is kept: history sqlite:///")
    with (tmp_path / "out" / "parameters.csv").open() as stream:
        assert [row["status"] for row in csv.DictReader(stream)] == ["done"]


def test_a_history_needs_a_url():
    with pytest.raises(OptionError, match="expected a URL such as sqlite"), open_history("history.sqlite"):
        pass

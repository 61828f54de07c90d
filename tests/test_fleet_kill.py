"""Fleets that are killed, and fleets on a Dask cluster: real processes, real signals, a real scheduler."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

import imulab as il
from fleets import children, command, make_fleet, records, wait_for, workers_of
from imulab.fleet.run import fleet_status, run_fleet
from imulab.fleet.store import MOST_ATTEMPTS

UNITS = 80


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Enough units for a run to be caught at its work."""
    return make_fleet(tmp_path_factory.mktemp("fleet"), UNITS)


def plain(path):
    content = json.loads(path.read_text())
    return {key: value for key, value in content.items() if key not in ("created", "software", "content_sha256")}


@pytest.fixture(scope="module")
def reference(fleet, tmp_path_factory):
    """The same fleet, made by one process."""
    folder = tmp_path_factory.mktemp("reference")
    assert run_fleet(str(fleet), str(folder), workers=1).count("done") == UNITS
    return {path.stem: plain(path) for path in folder.glob("*.json")}


def check_complete(folder, reference, untouched):
    """Every record is there, whole, the same as one process makes, and those of before were not written again."""
    found = records(folder)
    assert set(found) == set(reference)
    assert {serial: found[serial] for serial in untouched} == untouched
    for serial, expected in reference.items():
        il.load(folder / f"{serial}.json")
        assert plain(folder / f"{serial}.json") == expected
    assert not list(folder.rglob("*.part"))
    assert not list((folder / ".fleet" / "active").iterdir())
    state = fleet_status(str(folder))
    assert (state.count("done"), state.at_work) == (UNITS, None)


# ---- processes of this machine -------------------------------------------------------------------------------------


def test_a_killed_run_is_finished_by_the_next(fleet, reference, tmp_path):
    folder = tmp_path / "out"
    process = command("fleet", "run", fleet, "-o", folder, "--workers", 2)
    wait_for(lambda: len(list(folder.glob("*.json"))) >= 5)
    workers = workers_of(process.pid)
    assert workers
    assert fleet_status(str(folder)).at_work is not None
    process.kill()
    process.communicate()
    before = records(folder)
    assert 5 <= len(before) < UNITS
    for serial in before:
        il.load(folder / f"{serial}.json")
    state = fleet_status(str(folder))
    assert (state.count("failed"), state.at_work) == (0, None)
    done = command("fleet", "run", fleet, "-o", folder, "--workers", 2)
    out, error = done.communicate()
    assert (done.returncode, error) == (0, "")
    check_complete(folder, reference, before)
    kept = int(out.partition(" done, ")[2].partition(" were")[0])
    assert len(before) <= kept <= len(before) + len(workers)  # a worker ends the record that it was at
    wait_for(lambda: not any(Path(f"/proc/{worker}").exists() for worker in workers), 10)


def test_a_killed_worker_costs_nothing_but_time(fleet, reference, tmp_path):
    folder = tmp_path / "out"
    process = command("fleet", "run", fleet, "-o", folder, "--workers", 2)
    wait_for(lambda: len(list(folder.glob("*.json"))) >= 5)
    before = records(folder)
    os.kill(workers_of(process.pid)[0], signal.SIGKILL)
    out, _ = process.communicate()
    assert process.returncode == 0
    assert out.startswith(f"{UNITS} units: {UNITS} done, 0 failed")
    check_complete(folder, reference, before)


POISON = """
import os, sys
def hook(event, arguments):
    if event == "open" and str(arguments[0]).endswith("poison.csv"):
        os.kill(os.getpid(), 9)
sys.addaudithook(hook)
"""


def test_a_unit_that_kills_its_process_fails_alone(tmp_path):
    manifest = make_fleet(tmp_path / "in", 12)
    (tmp_path / "in" / "u5.csv").rename(tmp_path / "in" / "poison.csv")
    manifest.write_text(manifest.read_text().replace("u5.csv", "poison.csv"))
    (tmp_path / "hook").mkdir()
    (tmp_path / "hook" / "sitecustomize.py").write_text(POISON)
    process = command(
        "fleet", "run", manifest, "-o", tmp_path / "out", "--workers", 2, env={"PYTHONPATH": str(tmp_path / "hook")}
    )
    out, error = process.communicate(timeout=120)
    assert process.returncode == 2, error
    assert out.startswith("12 units: 11 done, 1 failed")
    assert f"failed: SN005 (poison.csv): its process ended {MOST_ATTEMPTS} times while it worked on this unit" in out
    assert set(records(tmp_path / "out")) == {f"SN{i:03d}" for i in range(12) if i != 5}


@pytest.mark.parametrize("begun", [False, True])
def test_an_interrupt_of_the_terminal_ends_all_processes_without_a_word(fleet, reference, tmp_path, begun):
    folder = tmp_path / "out"
    process = command("fleet", "run", fleet, "-o", folder, "--workers", 2)
    wait_for(lambda: len(list(folder.glob("*.json"))) >= 5 if begun else children(process.pid))
    workers = workers_of(process.pid)
    assert bool(workers) or not begun
    os.killpg(process.pid, signal.SIGINT)
    out, error = process.communicate(timeout=30)
    assert (process.returncode, out, error) == (130, "", "")
    wait_for(lambda: not any(Path(f"/proc/{worker}").exists() for worker in workers), 10)
    before = records(folder)
    assert len(before) < UNITS
    done = command("fleet", "run", fleet, "-o", folder, "--workers", 2)
    assert done.communicate()[1] == ""
    check_complete(folder, reference, before)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
def test_no_process_of_a_run_hears_an_interrupt(fleet, tmp_path):
    """Held back before they start: one that is still starting would end with a traceback."""
    process = command("fleet", "run", fleet, "-o", tmp_path / "out", "--workers", 2)
    wait_for(lambda: list((tmp_path / "out").glob("*.json")))
    held_back = []
    for worker in workers_of(process.pid):
        status = Path(f"/proc/{worker}/status").read_text()
        held_back.append(int(re.search(r"SigBlk:\s*(\w+)", status)[1], 16) >> (signal.SIGINT - 1) & 1)
    process.send_signal(signal.SIGINT)
    process.communicate()
    assert held_back == [1, 1]


def test_two_runs_at_once_the_second_is_refused(fleet, tmp_path):
    folder = tmp_path / "out"
    first = command("fleet", "run", fleet, "-o", folder, "--workers", 2)
    wait_for(lambda: list(folder.glob("*.json")))
    first.send_signal(signal.SIGSTOP)  # it would be done before the second has started
    second = command("fleet", "run", fleet, "-o", folder, "--workers", 2)
    _, error = second.communicate()
    first.send_signal(signal.SIGCONT)
    assert second.returncode == 2
    assert error.count("\n") == 1
    assert f"another run is at work on it (process {first.pid} on " in error
    first.communicate()
    assert first.returncode == 0


# ---- Dask ----------------------------------------------------------------------------------------------------------


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Cluster:
    """A scheduler and workers as processes of their own on the loopback."""

    def __init__(self, folder):
        self.folder = folder
        self.address = f"tcp://127.0.0.1:{free_port()}"
        self.workers = []
        self.scheduler = self.start(
            "scheduler", "--host", "127.0.0.1", "--port", self.address.rpartition(":")[2], "--no-dashboard"
        )

    def start(self, *arguments):
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        with (self.folder / f"{arguments[0]}.log").open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "dask", *arguments], cwd=self.folder, env=environment, stdout=log, stderr=log
            )

    def add_worker(self, *, nanny=False):
        worker = self.start(
            "worker", self.address, "--nthreads", "1", "--no-dashboard", "--nanny" if nanny else "--no-nanny"
        )
        self.workers.append(worker)
        return worker

    def close(self):
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path):
    pytest.importorskip("distributed")
    cluster = Cluster(tmp_path)
    yield cluster
    cluster.close()


def on(cluster, fleet, folder):
    return command("fleet", "run", fleet, "-o", folder, "--engine", "dask", "--scheduler", cluster.address)


def test_a_cluster_makes_the_same_records_whatever_dies(cluster, fleet, reference, tmp_path):
    """One run: its driver is killed. The next: a worker is killed. The rest comes from the worker that is left."""
    folder = tmp_path / "out"
    workers = [cluster.add_worker() for _ in range(2)]
    process = on(cluster, fleet, folder)
    wait_for(lambda: len(list(folder.glob("*.json"))) >= 5)
    process.kill()
    process.communicate()
    before = records(folder)
    assert 5 <= len(before) < UNITS
    process = on(cluster, fleet, folder)
    wait_for(lambda: len(list(folder.glob("*.json"))) >= len(before) + 4)
    assert len(list(folder.glob("*.json"))) < UNITS
    workers[0].kill()
    _, error = process.communicate(timeout=120)
    assert (process.returncode, error) == (0, "")
    check_complete(folder, reference, before)


def test_workers_that_do_not_see_the_folder_send_their_records_back(fleet, reference, tmp_path):
    """A worker elsewhere: it is given no folder, as the driver does when its folder turns out to be another one."""
    from imulab.fleet.engine import DONE, LEFT, Job, work
    from imulab.fleet.manifest import load_fleet
    from imulab.fleet.store import Store

    manifest = load_fleet(str(fleet))
    unit = manifest.units[0]
    job = Job(str(tmp_path / "nowhere"), manifest.base, "token")
    away = work(unit, job)
    assert away.status == DONE
    assert not (tmp_path / "nowhere").exists()
    (tmp_path / "got.json").write_text(away.text)
    assert plain(tmp_path / "got.json") == reference[unit.serial]
    with Store(tmp_path / "other").run():
        assert work(unit, Job(str(tmp_path / "other"), manifest.base, "another token")).status == LEFT
    assert not records(tmp_path / "other")


def test_a_lost_scheduler_is_said_in_one_line(cluster, tmp_path):
    fleet, folder = make_fleet(tmp_path / "in", 30, monte_carlo=10000), tmp_path / "out"
    cluster.add_worker()
    process = on(cluster, fleet, folder)
    wait_for(lambda: len(list(folder.glob("*.json"))) >= 5)
    cluster.scheduler.kill()
    _, error = process.communicate(timeout=90)
    assert process.returncode == 2
    assert error.count("\n") == 1
    assert f"imulab: --scheduler {cluster.address}: the connection is lost" in error


def test_a_scheduler_without_workers_is_said(cluster, fleet, tmp_path):
    begin = time.monotonic()
    process = on(cluster, fleet, tmp_path / "out")
    _, error = process.communicate(timeout=60)
    assert process.returncode == 2
    assert error == f"imulab: --scheduler {cluster.address}: has no workers (waited 10 s)\n"
    assert time.monotonic() - begin < 45
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "address", ["tcp://127.0.0.1:{port}", "nonsense", "what://ever:1", "tcp://no.such.host.invalid:1"]
)
def test_an_unreachable_scheduler_is_reported_with_its_address(fleet, tmp_path, address):
    pytest.importorskip("distributed")
    address = address.format(port=free_port())
    begin = time.monotonic()
    process = command("fleet", "run", fleet, "-o", tmp_path / "out", "--engine", "dask", "--scheduler", address)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 2
    assert error.count("\n") == 1
    assert error.startswith(f"imulab: --scheduler {address}: cannot be reached")
    assert time.monotonic() - begin < 45
    assert not (tmp_path / "out").exists()


def test_a_cluster_of_its_own(fleet, reference, tmp_path):
    pytest.importorskip("distributed")
    process = command("fleet", "run", fleet, "-o", tmp_path / "out", "--engine", "dask", "--workers", 2)
    out, error = process.communicate(timeout=120)
    assert (process.returncode, error) == (0, "")
    assert out.startswith(f"{UNITS} units: {UNITS} done, 0 failed")
    check_complete(tmp_path / "out", reference, {})

"""Fleets that are killed, and fleets on a Dask cluster: real processes, real signals, a real scheduler."""

import json
import os
import platform
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import imulab as il
from fleets import children, command, make_fleet, records, wait_for, workers_of
from imulab.fleet import engine
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_scheduler_without_workers_is_said(cluster, fleet, tmp_path):
    begin = time.monotonic()
    process = on(cluster, fleet, tmp_path / "out")
    _, error = process.communicate(timeout=60)
    assert process.returncode == 2
    assert error == f"imulab: --scheduler {cluster.address}: has no workers (waited 10 s)\n"
    assert time.monotonic() - begin < 45
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_cluster_of_its_own(fleet, reference, tmp_path):
    pytest.importorskip("distributed")
    process = command("fleet", "run", fleet, "-o", tmp_path / "out", "--engine", "dask", "--workers", 2)
    out, error = process.communicate(timeout=120)
    assert (process.returncode, error) == (0, "")
    assert out.startswith(f"{UNITS} units: {UNITS} done, 0 failed")
    check_complete(tmp_path / "out", reference, {})


NAME = "OMP_NUM_THREADS"


def test_results_come_as_they_are_ready_and_all_come():
    found = list(engine.run(pow, ((2, k) for k in range(400)), 2))  # more calls than wait at a time
    assert sorted(found) == [2**k for k in range(400)]


def test_an_error_in_a_process_is_raised_here():
    with pytest.raises(ZeroDivisionError):
        list(engine.run(divmod, [(1, 0)], 1))


def test_a_process_that_ends_is_reported():
    with pytest.raises(engine.WorkersLostError):
        list(engine.run(os._exit, [(3,)], 2))


@pytest.mark.slow
def test_a_folder_for_temporary_files_may_have_a_long_name(tmp_path):
    folder = tmp_path / ("x" * 120)
    folder.mkdir()
    manifest = make_fleet(tmp_path / "in", 3)
    process = command("fleet", "run", manifest, "-o", tmp_path / "out", "--workers", 2, env={"TMPDIR": str(folder)})
    out, error = process.communicate(timeout=60)
    assert (process.returncode, error) == (0, "")
    assert out.startswith("3 units: 3 done, 0 failed")


OF_THE_TRACKER = r"(?m)^.*UserWarning: resource_tracker: .*\n +warnings\.warn\(.*\n"
"""A warning of joblib's process that looks after semaphores, which on a busy machine outlives the one it serves."""


@pytest.mark.slow
def test_an_interrupt_does_not_wait_for_what_is_under_work(tmp_path):
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from imulab.fleet import engine\n"
        "import sys\n"
        "calls = [('import time, pathlib; pathlib.Path(' + repr(sys.argv[1]) + ').touch(); time.sleep(60)',)] * 8\n"
        "list(engine.run(exec, calls, 2))\n"
    )
    begun = tmp_path / "begun"
    process = subprocess.Popen([sys.executable, "-c", code, begun], stderr=subprocess.PIPE, text=True)
    wait_for(begun.exists)
    workers = workers_of(process.pid)
    assert len(workers) == 2
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=20)
    assert process.returncode == -signal.SIGINT
    spoken = re.sub(OF_THE_TRACKER, "", error)
    assert spoken.rstrip().endswith("KeyboardInterrupt")
    assert "Warning" not in spoken
    wait_for(lambda: not any(Path(f"/proc/{worker}").exists() for worker in workers), 5)


@pytest.mark.parametrize("kind", [signal.SIGTERM, signal.SIGKILL])
def test_processes_end_with_the_one_that_started_them(tmp_path, kind):
    code = (
        "import sys\nfrom imulab.fleet import engine\n"
        "work = 'import pathlib, time; pathlib.Path(%r).touch(); time.sleep(60)'\n"
        "list(engine.run(exec, [(work % path,) for path in sys.argv[1:]], 2))\n"
    )
    begun = [tmp_path / "one", tmp_path / "other"]
    process = subprocess.Popen([sys.executable, "-c", code, *begun], stderr=subprocess.PIPE, text=True)
    wait_for(lambda: all(path.exists() for path in begun))
    workers = workers_of(process.pid)
    assert len(workers) == 2
    process.send_signal(kind)
    process.communicate(timeout=20)
    assert process.returncode == -kind
    wait_for(lambda: not any(Path(f"/proc/{worker}").exists() for worker in workers), 5)


def test_one_call_has_a_process_of_its_own():
    (found,) = engine.run(os.getpid, [()], 1)
    assert found != os.getpid()


@pytest.mark.slow
def test_a_script_needs_no_guard(tmp_path):
    script = tmp_path / "script.py"
    script.write_text("from imulab.fleet import engine\nprint(sorted(engine.run(pow, [(2, 3), (2, 4)], 2)))\n")
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=60, check=False)
    assert (done.stdout, done.stderr) == ("[8, 16]\n", "")


@pytest.mark.parametrize("before", [None, "7"])
def test_each_process_uses_one_thread_and_this_ones_settings_stay(monkeypatch, before):
    monkeypatch.delenv(NAME, raising=False)
    if before is not None:
        monkeypatch.setenv(NAME, before)
    calls = engine.run(os.getenv, [(NAME,)] * 3, 2)
    assert list(calls) == ["1"] * 3
    assert os.environ.get(NAME) == before


def test_runs_of_several_threads_have_their_own_results():
    with ThreadPoolExecutor(3) as threads:
        runs = [threads.submit(lambda k=k: list(engine.run(pow, [(k, 2)] * 200, 2))) for k in range(3)]
        assert [run.result() for run in runs] == [[k * k] * 200 for k in range(3)]


def test_no_more_processes_than_this_one_may_use(monkeypatch):
    code = "import os; os.sched_setaffinity(0, [min(os.sched_getaffinity(0))]); "
    code += "from imulab.fleet.engine import available; print(available())"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "1\n"


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc's")
def test_what_is_ended_in_vain_ends_without_a_word(capfd):
    """As joblib's thread does now and then, which looks for work that has just been dropped."""

    def results():
        try:
            yield 1
        finally:
            thread = threading.Thread(target={}.__getitem__, args=(112,))
            thread.start()
            thread.join()

    given, hook = results(), threading.excepthook
    next(given)
    engine._close(given)
    assert threading.excepthook is hook
    assert capfd.readouterr().err == ""


def test_calls_that_nobody_waits_for_any_more_are_not_begun(tmp_path):
    made = engine.run(os.mkdir, ((str(tmp_path / str(k)),) for k in range(10**6)), 2)
    next(made)
    made.close()
    assert 1 <= len(list(tmp_path.iterdir())) < 1000

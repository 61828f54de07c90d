"""Processes of this machine: what comes of calls, and what they leave behind."""

import os
import platform
import resource
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import pytest

from fleets import command, make_fleet, wait_for
from imulab.fleet import processes

NAME = "OMP_NUM_THREADS"


def test_results_come_as_they_are_ready_and_all_come():
    processes.prepare(["imulab.fleet.work"])
    found = list(processes.run(pow, ((2, k) for k in range(400)), 2))  # more calls than wait at a time
    assert sorted(found) == [2**k for k in range(400)]


def test_an_error_in_a_process_is_raised_here():
    with pytest.raises(ZeroDivisionError):
        list(processes.run(divmod, [(1, 0)], 1))


def test_a_process_that_ends_is_reported():
    with pytest.raises(processes.ProcessLostError):
        list(processes.run(os._exit, [(3,)], 2))


@pytest.mark.skipif(sys.platform != "linux", reason="others do not fork")
def test_the_process_that_forks_may_end_too():
    from multiprocessing.forkserver import _forkserver

    for _ in range(2):
        processes.prepare(["imulab.fleet.work"])
        os.kill(_forkserver._forkserver_pid, signal.SIGKILL)
        for _ in range(50):  # it takes a moment until it is known; then another is started
            with suppress(processes.ProcessLostError):
                assert sorted(processes.run(abs, [(-1,), (-2,)], 2)) == [1, 2]
                break
            time.sleep(0.02)
        else:
            pytest.fail("no other was started")


def test_a_folder_for_temporary_files_may_have_a_long_name(tmp_path):
    folder = tmp_path / ("x" * 120)
    folder.mkdir()
    manifest = make_fleet(tmp_path / "in", 3)
    process = command("fleet", "run", manifest, "-o", tmp_path / "out", "--workers", 2, env={"TMPDIR": str(folder)})
    out, error = process.communicate(timeout=60)
    assert (process.returncode, error) == (0, "")
    assert out.startswith("3 units: 3 done, 0 failed")


@pytest.mark.skipif(sys.platform == "win32", reason="has no such interrupts")
def test_a_second_interrupt_does_not_wait_for_what_is_under_work(tmp_path):
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from imulab.fleet import processes\n"
        "import sys\n"
        "calls = [('import time, pathlib; pathlib.Path(' + repr(sys.argv[1]) + ').touch(); time.sleep(60)',)] * 8\n"
        "list(processes.run(exec, calls, 2))\n"
    )
    begun = tmp_path / "begun"
    process = subprocess.Popen([sys.executable, "-c", code, begun], stderr=subprocess.PIPE, text=True)
    wait_for(begun.exists)
    process.send_signal(signal.SIGINT)
    time.sleep(0.5)
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=20)
    assert process.returncode == -signal.SIGINT
    assert error.rstrip().endswith("KeyboardInterrupt")


@pytest.mark.parametrize("forks", [True, False])
def test_a_script_needs_no_guard(tmp_path, forks):
    script = tmp_path / "script.py"
    script.write_text(
        "from imulab.fleet import processes\n"
        f"processes._FORKS &= {forks}\n"
        "print(sorted(processes.run(pow, [(2, 3), (2, 4)], 2)))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=60, check=False)
    assert (done.stdout, done.stderr) == ("[8, 16]\n", "")


@pytest.mark.parametrize("before", [None, "7"])
def test_each_process_uses_one_thread_and_this_ones_settings_stay(monkeypatch, before):
    monkeypatch.delenv(NAME, raising=False)
    if before is not None:
        monkeypatch.setenv(NAME, before)
    processes.prepare(["imulab.fleet.work"])
    calls = processes.run(os.getenv, [(NAME,)] * 3, 2)
    assert list(calls) == ["1"] * 3
    assert os.environ.get(NAME) == before


def test_runs_of_several_threads_leave_the_settings_of_all(monkeypatch):
    for name in processes._THREADS:
        monkeypatch.delenv(name, raising=False)
    before, main = dict(os.environ), sys.modules["__main__"]
    first, second = (processes.run(os.getenv, [(NAME,)] * 200, 1) for _ in range(2))
    next(first)
    assert dict(os.environ) == before  # between two results too
    next(second)
    assert list(first) + list(second) == ["1"] * 398
    with ThreadPoolExecutor(3) as threads:
        runs = [threads.submit(lambda: list(processes.run(os.getenv, [(NAME,)] * 200, 1))) for _ in range(3)]
        assert [run.result() for run in runs] == [["1"] * 200] * 3
    assert dict(os.environ) == before
    assert sys.modules["__main__"] is main


@pytest.mark.parametrize(
    ("text", "share"), [("max 100000", 8), ("250000 100000", 3), ("1000 100000", 1), ("9000000 100000", 8), ("", 8)]
)
def test_no_more_processes_than_the_control_group_has_time_for(monkeypatch, tmp_path, text, share):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    monkeypatch.setattr(processes, "_QUOTA", tmp_path / "cpu.max")
    assert processes.available() == 8
    (tmp_path / "cpu.max").write_text(text)
    assert processes.available() == share


FAULTS = """
import resource, sys
from imulab.fleet import processes

def use():
    parts = [b"x" * (3 << 20) for _ in range(5)]

if sys.argv[1] == "keep":
    processes.keep_memory()
use()
use()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    use()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc's")
def test_memory_that_one_unit_has_used_is_kept_for_the_next():
    given, kept = (int(subprocess.check_output([sys.executable, "-c", FAULTS, how])) for how in ("give", "keep"))
    pages = 10 * 5 * (3 << 20) // resource.getpagesize()
    assert kept < 0.01 * pages
    assert given > 0.5 * pages  # or there is nothing to keep


def test_calls_that_nobody_waits_for_any_more_are_not_begun(tmp_path):
    made = processes.run(os.mkdir, ((str(tmp_path / str(k)),) for k in range(10**6)), 2)
    next(made)
    made.close()
    assert 1 <= len(list(tmp_path.iterdir())) < 1000

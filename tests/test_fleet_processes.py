"""Processes of this machine: what comes of calls, and what they leave behind."""

import os
import platform
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from fleets import command, make_fleet, wait_for, workers_of
from imulab.fleet import engine

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


def test_a_folder_for_temporary_files_may_have_a_long_name(tmp_path):
    folder = tmp_path / ("x" * 120)
    folder.mkdir()
    manifest = make_fleet(tmp_path / "in", 3)
    process = command("fleet", "run", manifest, "-o", tmp_path / "out", "--workers", 2, env={"TMPDIR": str(folder)})
    out, error = process.communicate(timeout=60)
    assert (process.returncode, error) == (0, "")
    assert out.startswith("3 units: 3 done, 0 failed")


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
    assert error.rstrip().endswith("KeyboardInterrupt")
    assert "Warning" not in error
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

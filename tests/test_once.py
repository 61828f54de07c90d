"""Files that can be read once, end too early, or lie where nobody should fetch from."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

import imulab as il
from fleets import write_manifest
from imulab.cli import main
from imulab.errors import ReadError
from imulab.fleet import manifest as sources
from imulab.fleet.manifest import local_file, masked

ROWS = "time [s],accel_x [g]\n" + "".join(f"{i / 100},{i % 7}\n" for i in range(3000))


def piped(tmp_path, text):
    """A named pipe into which a thread writes the text."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    threading.Thread(target=lambda: path.write_text(text), daemon=True).start()
    return path


def test_a_pipe_is_read_from_its_first_byte(tmp_path):
    recording = il.read(piped(tmp_path, ROWS))
    assert len(recording) == 3000
    assert recording.column("accel_x")[:3].tolist() == [0, 1, 2]


def test_the_command_line_reads_a_pipe_once(tmp_path, capsys):
    assert main(["show", str(piped(tmp_path, ROWS))]) == 0
    assert "3000 samples" in capsys.readouterr().out


def test_a_record_through_a_pipe_is_refused_as_a_recording(tmp_path, capsys):
    assert main(["show", str(piped(tmp_path, '{"format": "imulab.calibration"}'))]) == 2
    assert "found JSON (a calibration record?)" in capsys.readouterr().err


@pytest.mark.parametrize("rows", [3, 3000])
def test_a_last_line_without_an_end_is_said(tmp_path, capsys, rows):
    whole = "\n".join(ROWS.split("\n")[: rows + 1])
    (tmp_path / "cut.csv").write_text(whole)
    (tmp_path / "whole.csv").write_text(whole + "\n")
    assert [len(il.read(tmp_path / name).notes) for name in ("cut.csv", "whole.csv")] == [1, 0]
    assert main(["convert", str(tmp_path / "cut.csv"), "-o", str(tmp_path / "out.csv")]) == 0
    assert "the last line has no line end: if the file was cut there" in capsys.readouterr().err


@pytest.mark.parametrize("kind", [signal.SIGTERM, signal.SIGHUP])
def test_a_command_that_is_terminated_or_loses_its_terminal_leaves_nothing(tmp_path, kind):
    command = [sys.executable, "-m", "imulab", "convert", "-", "-o", "out.csv"]
    with subprocess.Popen(command, cwd=tmp_path, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None
        process.stdin.write(ROWS.encode())
        process.stdin.flush()
        deadline = time.monotonic() + 120
        while not list(tmp_path.iterdir()) and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.02)
        there = [path.suffix for path in tmp_path.iterdir()]
        process.send_signal(kind)
        said = process.communicate(timeout=120)[1]
    assert (there, process.returncode, said) == ([".part"], 143, b"")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("address", "reason"),
    [
        (
            "nowhere://line/none.csv",
            "addresses with 'nowhere' are not read; expected a path, or one of file https s3 gs az",
        ),
        ("memory://line/a.csv", "addresses with 'memory' are not read"),
        ("ftp://host/a.csv", "addresses with 'ftp' are not read"),
        ("filecache::s3://host/a.csv", "addresses with 'filecache::s3' are not read"),
        ("file:///dev/zero", "expected a file, found a device or a pipe"),
        ("/dev/zero", "expected a file, found a device or a pipe"),
        ("https://user:secret@host/a.csv", "a login in the address would end up in records and reports"),
    ],
)
def test_an_address_from_which_nothing_is_fetched_fails_its_unit(tmp_path, address, reason):
    from imulab.fleet.run import run_fleet

    manifest = write_manifest(tmp_path / "m.csv", [{"serial": "A", "procedure": "tumble", "file": address}])
    state = run_fleet(str(manifest), str(tmp_path / "out"), workers=1)
    assert reason in state.failures[0].reason
    assert "secret" not in state.failures[0].reason


def test_a_copy_is_bounded_and_removed(tmp_path, monkeypatch):
    (tmp_path / "large.csv").write_bytes(bytes(1 << 20))
    monkeypatch.setattr(sources, "_LARGEST", 1 << 19)
    before = set((tmp_path.parent).parent.iterdir())
    with pytest.raises(ReadError, match="the most that is fetched"), local_file((tmp_path / "large.csv").as_uri(), "l"):
        pass
    assert set((tmp_path.parent).parent.iterdir()) == before


@pytest.mark.parametrize(
    "text",
    [
        "https://user:hunter2@host/a",
        "s3://hunter2@bucket/a",
        "https://host/a?x=1&password=hunter2&y=2",
        "az://box/a?sv=1&sig=hunter2",
        "postgresql://me:hunter2@host/db?sslpassword=hunter2",
    ],
)
def test_credentials_are_masked(text):
    assert "hunter2" not in masked(f"{text}: cannot be read")
    assert "cannot be read" in masked(f"{text}: cannot be read")

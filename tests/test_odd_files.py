"""What a file system, a shell and a number can be: closed streams, links in a circle, odd names, absurd values."""

import os
import subprocess
import sys

import numpy as np
import pytest

from imulab.cli import main
from imulab.errors import ReadError
from imulab.fleet.manifest import local_file


@pytest.fixture
def recording(tmp_path):
    return write(tmp_path / "a.csv", np.random.default_rng(1).normal(0, 0.01, (14_461, 3)))


@pytest.fixture
def imulab(tmp_path, monkeypatch, capsys):
    """Run the command line in this process, which is much faster where only files are odd."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        capsys.readouterr()
        status = main(arguments)
        return subprocess.CompletedProcess(arguments, status, *capsys.readouterr())

    return run


def write(path, rates, step=0.01):
    rows = np.column_stack([np.arange(len(rates)) * step, rates])
    np.savetxt(path, rows, "%.9g", ",", header="time [s],gyro_x [deg/s],gyro_y [deg/s],gyro_z [deg/s]", comments="")
    return path


def refused(done, *parts):
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("imulab: ")
    for part in parts:
        assert part in done.stderr


@pytest.mark.parametrize(
    "command",
    [
        ["show", "loop"],
        ["convert", "loop"],
        ["apply", "loop", "a.csv"],
        ["tumble", "fit", "loop"],
        ["array", "fuse", "loop"],
        ["warmup", "fit", "loop"],
        ["show", "a.csv", "--layout", "loop"],
        ["centrifuge", "reduce", "loop"],
        ["convert", "a.csv", "-o", "loop"],
        ["fleet", "run", "m.csv", "-o", "loop"],
    ],
)
def test_links_that_go_round_in_a_circle(imulab, tmp_path, recording, command):
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "m.csv").write_text("serial,procedure,file\nA1,tumble,a.csv\n")
    done = imulab(*command)
    refused(done, "loop: ")
    assert "too many levels of symbolic links" in done.stderr.lower()
    assert (tmp_path / "loop").is_symlink()


@pytest.mark.parametrize(
    "command",
    [
        ["show", "a.csv", "--layout", "imulab.toml"],
        ["centrifuge", "reduce", "imulab.toml"],
        ["tumble", "fit", "a.csv"],
    ],
)
def test_toml_nested_deeper_than_python_reads(imulab, tmp_path, recording, command):
    (tmp_path / "imulab.toml").write_text("a = " + "[" * 5000 + "]" * 5000)
    refused(imulab(*command), "imulab.toml: the ", "nests its tables or lists")


def closed(tmp_path, command, *streams):
    """Run a command with some of its standard streams closed, as a shell does with <&- and >&-."""

    def close():
        for stream in streams:
            os.close(stream)

    return subprocess.run(
        [sys.executable, "-m", "imulab", *command],
        cwd=tmp_path, capture_output=True, text=True, check=False, preexec_fn=close, timeout=120,
    )  # fmt: skip


@pytest.mark.skipif(os.name != "posix", reason="file descriptors of POSIX")
def test_closed_standard_streams(tmp_path, recording):
    lost = "imulab: standard output: cannot be written: Bad file descriptor\n"
    for command in (["show", "a.csv"], ["convert", "a.csv"], ["allan", "a.csv"], ["--help"]):
        done = closed(tmp_path, command, 0, 1)
        assert (done.returncode, done.stderr) == (2, lost), command
    assert closed(tmp_path, ["show", "a.csv"], 0, 1, 2).returncode == 2
    refused(closed(tmp_path, ["show", "-"], 0), "standard input: cannot be read: Bad file descriptor")
    assert closed(tmp_path, ["show", "gone.csv"], 2).returncode == 2
    # A file that is opened while 1 is free would get that number, and what is printed.
    done = closed(tmp_path, ["convert", "a.csv", "-o", "b.csv"], 0, 1, 2)
    assert done.returncode == 0
    assert (tmp_path / "b.csv").read_text().startswith("time [s],gyro_x [deg/s]")
    assert (tmp_path / "b.csv").read_text().count("\n") == 14_462


@pytest.mark.parametrize(
    "address", ["https://host:abc/x.csv", "https://host:99999/x.csv", "s3://host:abc/x.csv", "https://[::1/x.csv"]
)
def test_an_address_that_is_none(address):
    with pytest.raises(ReadError, match=r"no address: "), local_file(address, address):
        pass


def test_a_history_whose_port_is_no_number(imulab, tmp_path, recording):
    (tmp_path / "m.csv").write_text("serial,procedure,file\nA1,tumble,a.csv\n")
    done = imulab("fleet", "run", "m.csv", "-o", "out", "--history", "postgresql://u:secret@host:abc/x")
    refused(done, "history 'postgresql://***@host:abc/x': expected a URL such as")


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are bytes")
@pytest.mark.parametrize("name", [b"a\xff\xfe.csv", b"line\nend.csv", b"\x1b[31m.csv", b"-o.csv", b" .csv"])
def test_names_of_any_bytes(imulab, tmp_path, recording, name):
    odd = os.fsdecode(os.path.join(os.fsencode(tmp_path), name))  # noqa: PTH118
    recording.rename(odd)
    done = imulab("convert", odd, "-o", f"{odd}.csv")
    assert (done.returncode, done.stderr) == (0, "")
    for command in ("show", "allan"):
        shown = imulab(command, odd)
        assert shown.returncode == 0
        assert "14461 samples" in shown.stdout.splitlines()[0]
        assert "\x1b" not in shown.stdout
    refused(imulab("show", f"{odd}.gone"), ".csv.gone: no such file")


@pytest.mark.parametrize(
    "command",
    [["show"], ["allan"], ["convert"], ["tumble", "fit"], ["array", "fuse"], ["warmup", "fit"], ["report"]],
)
def test_a_folder_where_a_file_should_be(imulab, tmp_path, command):
    (tmp_path / "d.csv").mkdir()
    output = ["-o", "x.html"] if command == ["report"] else []
    refused(imulab(*command, "d.csv", *output), "d.csv: ")


# --- allan -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("value", "row"), [(np.inf, 500), (-np.inf, 0), (np.nan, 14_460)])
def test_one_row_without_numbers_does_not_stop_allan(imulab, tmp_path, recording, value, row):
    rates = np.loadtxt(recording, delimiter=",", skiprows=1)[:, 1:]
    whole = imulab("allan", "a.csv", "--json").stdout
    rates[row, 1] = value
    write(tmp_path / "b.csv", rates)
    done = imulab("allan", "b.csv", "--json")
    assert done.returncode == 0, done.stderr
    assert f"b.csv: 1 row without numbers (row {row + 1} (line {row + 2}))" in done.stderr
    assert deviations(done.stdout, "gyro_y") == pytest.approx(deviations(whole, "gyro_y"), rel=0.02)
    assert deviations(done.stdout, "gyro_x") == deviations(whole, "gyro_x")


def deviations(text, column):
    import json

    return json.loads(text)["columns"][column]["deviation"]


def test_numbers_that_cannot_be_squared(imulab, tmp_path, recording):
    rates = np.random.default_rng(2).normal(0, 0.01, (3000, 3))
    rates[500, 1] = 1e300
    write(tmp_path / "one.csv", rates)
    done = imulab("allan", "one.csv")
    assert done.returncode == 0
    assert "1 row of gyro_x gyro_y gyro_z left out: far from the rows on both sides" in done.stderr
    rates[500:520, 1] = 1e300
    write(tmp_path / "run.csv", rates)
    refused(imulab("allan", "run.csv"), "row 501 (line 502), column gyro_y: expected a reading, found 1e+300")
    write(tmp_path / "time.csv", rates[:400], step=1e-300)
    refused(imulab("allan", "time.csv"), "column time: 1e+300 samples in a second")

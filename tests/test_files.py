"""What a file system, a shell and a number can be: closed streams, links in a circle, odd names, absurd values."""

import os
import stat
import subprocess
import sys
from time import process_time

import numpy as np
import pytest

from imulab.cli import main
from imulab.errors import OptionError, ReadError
from imulab.files import load_toml, replacing, write_text
from imulab.fleet.manifest import local_file
from imulab.fleet.store import Store
from imulab.readers import load_layout, read


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


@pytest.mark.slow
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


CONTENTS = {
    "huge": (b"#" * 1_000_001, "expected a layout file of at most 1 MB"),
    "dots": (b"a." * 20_000 + b"a = 1\n", "line 1: more than 50 dots in a line of the layout file"),
    "numbers as keys": (b"x = 1\n" + b"1.1 . " * 5_000 + b"1 = 1\n", "line 2: more than 50 dots"),
    "quoted dots": (b'"a" . ' * 20_000 + b"a = 1\n", "line 1: more than 50 dots"),
    "digits": (b"skip_lines = " + b"9" * 5_000, "holds a whole number of more than 64 bits"),
    "hexadecimal digits": (b"skip_lines = [0x" + b"f" * 900 + b"]", "holds a whole number of more than 64 bits"),
    "bytes": (b"a = 1\nb = '\xff'\n", "line 2: expected a layout file of UTF-8 text, as TOML is"),
}


@pytest.mark.parametrize("case", CONTENTS)
def test_contents_that_are_refused_at_once(tmp_path, case):
    content, message = CONTENTS[case]
    path = tmp_path / "board.toml"
    path.write_bytes(content)
    began = process_time()
    with pytest.raises(ReadError) as caught:
        load_toml(path, "board.toml", "layout")
    assert process_time() - began < 1
    assert str(caught.value).startswith("board.toml: ")
    assert message in str(caught.value)


def test_lists_of_numbers_and_texts_with_dots_are_read(tmp_path):
    path = tmp_path / "test.toml"
    path.write_text(f"rates = [{'1.5, -0.25e-3, ' * 100}2.5]\n# {'.' * 100}\nnote = '{'.' * 100}'\n")
    assert load_toml(path, "test.toml", "manifest") == {"rates": [1.5, -0.25e-3] * 100 + [2.5], "note": "." * 100}


def odd(path, kind):
    """Make something odd of this name and return what is said of it."""
    if kind == "folder":
        path.mkdir()
        return "found a folder"
    if kind == "pipe":
        os.mkfifo(path)
        return "found a device or a pipe"
    target, said = {
        "circle": (path.name, "cannot be read: Too many levels"),
        "link": ("nothing", "found a link to a file that is not there"),
        "device": ("/dev/zero", "found a device or a pipe"),
    }[kind]
    path.symlink_to(target)
    return said


@pytest.mark.parametrize("kind", ["folder", "pipe", "circle", "link", "device"])
def test_only_files_are_layouts_and_project_files(tmp_path, monkeypatch, capsys, kind):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.txt").write_text("0 1\n")
    found = odd(tmp_path / "board", kind)
    assert main(["show", "log.txt", "--layout", "board"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("imulab: board: expected a layout file, ")
    assert found in err
    assert err.count("\n") == 1
    (tmp_path / "board").rename("imulab.toml")
    if kind == "circle":
        (tmp_path / "imulab.toml").unlink()
        odd(tmp_path / "imulab.toml", kind)
    assert main(["show", "log.txt"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("imulab: imulab.toml: expected a project file, ")
    assert found in err


def test_a_number_of_thousands_of_digits_in_json_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "r.json").write_text('{"format": "imulab-calibration", "version": ' + "9" * 5000 + "}")
    assert main(["report", "r.json", "-o", "r.html"]) == 2
    err = capsys.readouterr().err
    assert "a whole number of thousands of digits" in err
    assert "sys.set_int_max_str_digits" not in err


def test_a_path_is_a_file_and_a_bare_name_one_that_comes_along(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "phyphox").write_text('[columns]\ntime = { from = 0, unit = "s" }\n')
    (tmp_path / "log.txt").write_text("0\n1\n")
    assert read("log.txt", tmp_path.joinpath("phyphox").relative_to(tmp_path)).time.tolist() == [0, 1]
    assert read("log.txt", "./phyphox").time.tolist() == [0, 1]
    assert "accel_x" in load_layout("phyphox").columns


def test_messages_of_the_command_line_call_options_as_they_are_typed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.csv").write_text("time [s],gyro_x [rad/s]\n" + "".join(f"{i},{i % 3}\n" for i in range(50)))
    (tmp_path / "odd.csv").write_text("\x1b[31mtime [s]\x1b[0m,gyro_x [rad/s]\n0,1\n")
    for command, said in (
        ("tumble fit a.csv --loss Huber", "--loss 'Huber': expected one of square huber auto; did you mean 'huber'?"),
        ("allan a.csv --taus dens", "--taus 'dens': expected octave or dense"),
        ("show odd.csv", r"odd.csv: column title '\x1b[31mtime [s]\x1b[0m': expected plain text, found a control"),
    ):
        assert main(command.split()) == 2
        assert capsys.readouterr().err.startswith(f"imulab: {said}")
    assert main(["tumble", "check", "r.json", "a.csv", "--threshold", "5"]) == 2
    assert "did you mean" not in capsys.readouterr().err


def test_a_file_that_is_replaced_keeps_its_permissions(tmp_path):
    closed, new = tmp_path / "closed.csv", tmp_path / "new.csv"
    closed.write_text("x")
    closed.chmod(0o600)
    for path in (closed, new):
        write_text(path, "y")
    assert stat.S_IMODE(closed.stat().st_mode) == 0o600
    assert stat.S_IMODE(new.stat().st_mode) != 0o600


def test_a_message_obeys_no_terminal_and_has_no_endless_numbers():
    assert str(ReadError("a\x1b[31m\u202e" + "9" * 300)) == "a\\x1b[31m\\u202e999999999999...(300 digits)"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no limit of a file's size on this system")
def test_a_full_disk_is_told_with_the_file_of_the_fleet(tmp_path):
    """The lock is the first that is written; a limit of the size of files stands for a disk without room."""
    import resource
    import signal

    limited = Store(tmp_path / "out")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        with pytest.raises(OptionError, match=r"out/\.fleet/lock: cannot be written: File too large"), limited.run():
            pass
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def test_an_interrupt_while_a_file_is_opened_leaves_nothing(tmp_path, monkeypatch):
    opened = os.open

    def interrupted(*words, **more):
        opened(*words, **more)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "open", interrupted)
        with pytest.raises(KeyboardInterrupt), replacing(tmp_path / "out.csv"):
            pass
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "a.csv").touch()
    with pytest.raises(OptionError, match="cannot be written: Not a directory"):
        write_text(tmp_path / "a.csv" / "out.csv", "x")

"""What a TOML file cannot be: a device, a folder, a link to nowhere, too large, or made to take forever."""

import os
from time import perf_counter

import pytest

from imulab.cli import main
from imulab.errors import ReadError
from imulab.files import load_toml
from imulab.readers import load_layout, read

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
    began = perf_counter()
    with pytest.raises(ReadError) as caught:
        load_toml(path, "board.toml", "layout")
    assert perf_counter() - began < 1
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

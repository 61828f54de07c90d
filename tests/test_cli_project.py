"""The project file: what it gives, where it is found, what wins over it, and what is refused."""

import io
import json
from pathlib import Path

import pytest

import imulab as il
from imulab.cli import common, main

LAYOUT = 'delimiter = ";"\n[columns]\ntime = { from = 0, unit = "s" }\n' + "".join(
    f'accel_{axis} = {{ from = {i}, unit = "m/s^2" }}\n' for i, axis in enumerate("xyz", start=1)
)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """A native recording of 16 attitudes, and the same with semicolons and no titles."""
    folder = tmp_path_factory.mktemp("recordings")
    recording = il.simulate_tumble(order=1, gravity=9.81362, attitudes=16, hold=2.0, gyro=False, seed=3)
    il.write(recording, folder / "native.csv")
    columns = [recording.time, *recording.triad("accel").T]
    rows = zip(*(column.tolist() for column in columns), strict=True)
    (folder / "foreign.txt").write_text("".join(";".join(map(repr, row)) + "\n" for row in rows))
    return folder


@pytest.fixture
def work(tmp_path, monkeypatch, recordings):
    """A folder in a repository, where the commands run; the project file lies at the root of the repository."""
    (tmp_path / ".git").mkdir()
    folder = tmp_path / "bench" / "monday"
    folder.mkdir(parents=True)
    for file in recordings.iterdir():
        (folder / file.name).symlink_to(file)
    monkeypatch.chdir(folder)
    monkeypatch.delenv(common.OFF, raising=False)
    return tmp_path


def test_what_it_gives_is_as_if_typed(work, capsys):
    (work / "imulab.toml").write_text('gravity = "9.81362+-0.00002"\n')
    assert main(["tumble", "fit", "native.csv", "--order", "1", "-o", "by_file.json"]) == 0
    err = capsys.readouterr().err
    assert err.count("imulab.toml") == 1
    assert "imulab: note: --gravity 9.81362+-0.00002 from ../../imulab.toml\n" in err
    typed = ["--gravity", "9.81362+-0.00002", "--no-project"]
    assert main(["tumble", "fit", "native.csv", "--order", "1", "-o", "typed.json", *typed]) == 0
    assert "imulab.toml" not in capsys.readouterr().err
    records = [json.loads(Path(name).read_text()) for name in ("by_file.json", "typed.json")]
    for record in records:
        del record["created"], record["content_sha256"]
    assert records[0] == records[1]
    assert records[0]["model"]["gravity"]["from"] == "argument"
    assert records[0]["options"]["gravity"] == "9.81362+-2e-05"


def test_what_is_typed_wins(work, capsys):
    (work / "imulab.toml").write_text("latitude = 48.1\nheight = 520\n")
    assert main(["tumble", "fit", "native.csv", "--order", "1", "--gravity", "9.81362", "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["model"]["gravity"]["value"] == 9.81362
    assert "imulab.toml" not in err
    assert main(["tumble", "fit", "native.csv", "--order", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["model"]["gravity"]["from"] == (
        "normal gravity at latitude 48.1 deg, height 520 m (WGS 84)"
    )


def test_a_layout_beside_it_is_for_files_that_need_one(work, capsys):
    (work / "imulab.toml").write_text('layout = "board.toml"\n')
    (work / "board.toml").write_text(LAYOUT)
    assert main(["show", "foreign.txt"]) == 0
    out, err = capsys.readouterr()
    assert "accel_z" in out
    assert err == "imulab: note: --layout ../../board.toml from ../../imulab.toml\n"
    assert main(["tumble", "fit", "native.csv", "--order", "1", "--gravity", "9.81362", "-o", "r.json"]) == 0
    for own in (["show", "native.csv"], ["show", "r.json"], ["apply", "r.json", "native.csv", "-o", "c.csv"]):
        capsys.readouterr()
        assert main(own) == 0
        assert "imulab.toml" not in capsys.readouterr().err


def test_a_layout_that_comes_along_is_meant_by_its_name_and_a_file_by_its_path(work, capsys):
    (work / "phyphox").write_text(LAYOUT)
    (work / "imulab.toml").write_text('layout = "phyphox"\n')
    assert common.load(work / "imulab.toml", "imulab.toml") == {"layout": "phyphox"}
    (work / "imulab.toml").write_text('layout = "./phyphox"\n')
    assert common.load(work / "imulab.toml", "../../imulab.toml") == {"layout": "../../phyphox"}
    (Path.cwd() / "phyphox").write_text(LAYOUT)
    (Path.cwd() / "imulab.toml").write_text('layout = "./phyphox"\n')
    assert main(["show", "foreign.txt"]) == 0
    assert "note: --layout ./phyphox from imulab.toml" in capsys.readouterr().err


def test_a_layout_is_left_out_for_a_stream_and_for_each_file_that_does_without(work, capsys, monkeypatch):
    (work / "imulab.toml").write_text('layout = "board.toml"\n')
    (work / "board.toml").write_text(LAYOUT)
    outputs = []
    for name in ("native.csv", "foreign.txt"):
        with Path(name).open("rb") as stream:
            monkeypatch.setattr("sys.stdin", io.TextIOWrapper(stream))
            assert main(["show", "-", "--json"]) == 0
        said = json.loads(capsys.readouterr().out)
        outputs.append((said["samples"], *((key, said["columns"][key]["unit"]) for key in ("time", "accel_z"))))
    assert outputs[0] == outputs[1] == (6200, ("time", "s"), ("accel_z", "m/s^2"))
    columns = "time [s],gyro_z [rad/s]\n"
    Path("a.csv").write_text(columns + "0,1\n1,2\n2,3\n")
    Path("b.txt").write_text("0;4;5;6\n1;7;8;9\n2;7;8;9\n")
    assert main(["array", "merge", "a.csv", "b.txt", "--axis", "z", "-o", "m.csv"]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("imulab: b.txt: ")  # a.csv was read without the layout


def test_no_home_and_no_working_folder(work, capsys, monkeypatch):
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("no home directory")))
    assert common.find(Path.cwd()) is None
    file = str(Path("native.csv").resolve())
    gone = work / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert main(["tumble", "fit", file, "--order", "1", "--gravity", "9.81362", "--json"]) == 0


def test_it_is_found_up_to_the_root_of_the_repository_and_not_above(work, monkeypatch):
    assert common.find(Path.cwd()) is None
    (work.parent / "imulab.toml").write_text("gravity = 9.8\n")
    try:
        assert common.find(Path.cwd()) is None
    finally:
        (work.parent / "imulab.toml").unlink()
    (work / "imulab.toml").write_text("gravity = 9.8\n")
    assert common.find(Path.cwd()) == work / "imulab.toml"
    (work / "bench" / "imulab.toml").write_text("gravity = 9.81\n")
    assert common.find(Path.cwd()) == work / "bench" / "imulab.toml"
    monkeypatch.setenv("HOME", str(work / "bench" / "monday"))
    assert common.find(Path.cwd()) is None
    monkeypatch.setenv("HOME", str(work))
    monkeypatch.setenv(common.OFF, "1")
    assert common.find(Path.cwd()) is None


def test_verbose_says_which_one_was_used(work, capsys):
    assert main(["tumble", "fit", "native.csv", "--order", "1", "-v"]) == 0
    assert "imulab: no project file imulab.toml here or above\n" in capsys.readouterr().err
    (work / "imulab.toml").write_text("limit = '1 mg'\n")
    assert main(["tumble", "fit", "native.csv", "--order", "1", "-v"]) == 0
    assert "imulab: project file ../../imulab.toml, which says nothing for this command\n" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            "gravty = 9.81\n",
            "unknown key 'gravty'; known keys: gravity latitude height layout limits limit; did you mean 'gravity'?",
        ),
        ("gravity = \n", "the project file is not TOML: Invalid value (at line 1, column 11): 'gravity ='"),
        ("# a\u2028b\ngravity = \n", "the project file is not TOML: Invalid value (at line 2, column 11): 'gravity ='"),
        ("gravity = true\n", "gravity = True: expected a text or a number, as --gravity takes it"),
        ("layout = 3\n", "layout = 3: expected the name of a file"),
        ('layout = "none.toml"\n', "layout = 'none.toml': no such file beside it"),
        (
            "gravity = 9.8\nlatitude = 48\n",
            "gravity together with latitude or height: expected one or the other",
        ),
        ("height = 520\n", "height without latitude: expected both"),
        ('layout = "/etc"\n', "layout = '/etc': expected the name of a file, found a folder"),
        (
            'gravity = "fast"\n',
            "gravity 'fast': expected a number, or one with a unit of acceleration such as 1 m/s^2",
        ),
        ('limit = "1 kg"\n', "limit '1 kg': unknown unit 'kg'"),
        ("limit = -1\n", "limit '-1': expected more than 0"),
    ],
)
def test_what_it_cannot_say_is_refused(work, capsys, content, message):
    (work / "imulab.toml").write_text(content)
    assert main(["tumble", "fit", "native.csv", "-o", "r.json"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert not Path("r.json").exists()
    assert err.startswith(f"imulab: ../../imulab.toml: {message}")
    assert err.count("\n") == 1
    assert main(["tumble", "fit", "native.csv", "--no-project", "-q"]) == 0


def test_the_example_of_the_documentation_is_one(work):
    page = (Path(__file__).resolve().parents[1] / "docs" / "index.md").read_text()
    block = page.partition("## Project file")[2].split("\n\n")[2]
    for name in ("imulab.toml", "board.toml", "limits.toml"):
        (work / name).write_text("".join(line.removeprefix("    ") + "\n" for line in block.splitlines()))
    assert common.load(work / "imulab.toml", "../../imulab.toml") == {
        "gravity": "9.81362+-0.00002",
        "layout": "../../board.toml",
        "limits": "../../limits.toml",
        "limit": "1 mg",
    }


def test_a_simulation_keeps_its_own_gravity_and_the_demonstration_is_left_alone(work, capsys):
    (work / "imulab.toml").write_text("gravity = 9.7\n")
    assert main(["tumble", "simulate", "-o", "s.csv", "--attitudes", "6", "--hold", "1"]) == 0
    assert il.read("s.csv").metadata["gravity"].startswith("9.80665")
    assert "imulab.toml" not in capsys.readouterr().err

"""Mistakes with `imulab export`: one line, exit 2, nothing made."""

import shutil
import subprocess
from dataclasses import replace

import pytest

import madeup
from imulab.cli import main
from imulab.exporters import firmware_c


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    madeup.tumble(2).save("accel.json")
    madeup.tumble(1).save("again.json")
    madeup.warmup().save("warmup.json")
    (tmp_path / "cut.json").write_text((tmp_path / "accel.json").read_text()[:500])
    (tmp_path / "file").write_text("x")
    return tmp_path


@pytest.mark.parametrize("target", ["c", "blob"])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("missing.json -o out", "missing.json: no such file"),
        ("cut.json -o out", "cut.json: not a calibration record"),
        ("file -o out", "file: not a calibration record"),
        ("accel.json again.json -o out", "two records give a tumble table"),
        ("accel.json -o file", "expected a folder to write to, found a file"),
        ("accel.json -o file/out", "the folder cannot be made"),
        ("accel.json", "Missing option"),
        ("-o out", "Missing argument"),
    ],
)
def test_a_mistake_gets_one_line(target, arguments, message, folder, capsys):
    before = sorted(folder.rglob("*"))
    assert main(["export", "--to", target, *arguments.split()]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert message in err
    assert sorted(folder.rglob("*")) == before


def test_an_unknown_target_lists_the_known_ones(folder, capsys):
    assert main(["export", "--to", "pascal", "accel.json", "-o", "out"]) == 2
    assert "unknown target; known targets: c blob px4 ardupilot" in capsys.readouterr().err
    assert not (folder / "out").exists()


def contents(folder):
    """The files of a folder and of those in it, by their names from it on."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_it_says_what_it_wrote(folder, capsys):
    assert main(["export", "--to", "c", "accel.json", "warmup.json", "-o", "new/out"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sorted(line.removeprefix("c: new/out/") for line in lines) == sorted(contents(folder / "new/out"))


def test_a_second_export_replaces_the_first(folder):
    for record in ("accel.json", "again.json", "accel.json"):
        assert main(["export", "--to", "c", record, "-o", "out"]) == 0
    first = contents(folder / "out")
    assert main(["export", "--to", "c", "accel.json", "-o", "other"]) == 0
    assert contents(folder / "other") == first


def test_a_serial_cannot_end_a_comment(folder, capsys):
    record = replace(madeup.tumble(1), sensor={"serial": "*/ int main(void) { /* \\\n??/ µ"})
    record.save("odd.json")
    assert main(["export", "--to", "c", "odd.json", "-o", "out"]) == 0
    text = (folder / "out" / "unit.c").read_text(encoding="utf-8")
    assert text.index("*/") > text.index("int main(void)")
    compiler = shutil.which("cc")
    if compiler:
        strict = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-fsyntax-only"]
        subprocess.run([compiler, *strict, folder / "out" / "unit.c", folder / "out" / "selftest.c"], check=True)


@pytest.mark.parametrize("change", ["edited", "new"])
def test_sources_that_were_changed_after_they_were_compiled_are_not_exported(folder, capsys, monkeypatch, change):
    """After a pull without a build the sources would be of two versions, and none of them that of the desk."""
    source = folder / "runtime"
    shutil.copytree(firmware_c._CHECKOUT, source)
    monkeypatch.setattr(firmware_c, "_CHECKOUT", source)
    if change == "edited":
        (source / "warmup.c").write_text((source / "warmup.c").read_text() + "/* newer */\n")
    else:
        (source / "later.c").write_text("")
    name = "warmup.c" if change == "edited" else "later.c"
    assert main(["export", "--to", "c", "accel.json", "-o", "out"]) == 2
    err = capsys.readouterr().err
    assert err == f"imulab: {name}: the compiled part is older than the source: build again (pip install -e .)\n"
    assert not (folder / "out").exists()


def test_a_record_that_does_not_follow_power_on_needs_no_power_on_temperature(folder, capsys):
    (folder / "in.csv").write_text("time [s],accel_x [count],accel_y [count],accel_z [count]\n0,1,2,3\n")
    assert main(["apply", "accel.json", "in.csv", "--temperature-column", "-o", "out.csv"]) == 0
    assert "power_on_temperature" not in (folder / "out.csv").read_text()

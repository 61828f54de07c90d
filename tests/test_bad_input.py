"""Every way to get a tumble test wrong: exit status 2, one helpful line, and no file."""

import json
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.recording import Recording

G = 9.80665


@pytest.fixture(scope="module")
def good() -> Recording:
    return il.simulate_tumble(attitudes=16, order=1, hold=3.0, move=1.5, seed=2)


def changed(recording, **columns):
    return recording.with_columns(columns, {})


def first_rows(recording, count):
    return replace(recording, columns={k: v[:count] for k, v in recording.columns.items()})


def put(values, index, value):
    copy = np.array(values)
    copy[index] = value
    return copy


def only(recording, names):
    return replace(
        recording,
        columns={n: recording.columns[n] for n in names},
        units={n: recording.units[n] for n in names},
    )


def gyro_as_accelerometer(recording):
    still = {f"accel_{a}": recording.columns[f"gyro_{a}"] for a in "xyz"}
    return only(changed(recording, **still), ["time", "accel_x", "accel_y", "accel_z"])


def in_unit(recording, unit):
    return replace(recording, units={**recording.units, **{f"accel_{a}": unit for a in "xyz"}})


CASES = {
    "nan": (
        lambda r: changed(r, accel_y=put(r.columns["accel_y"], slice(49, 55), np.nan)),
        ["bad.csv", "row 50 (line ", "column accel_y", "expected a finite number, found nan"],
    ),
    "infinity": (
        lambda r: changed(r, accel_z=put(r.columns["accel_z"], 7, np.inf)),
        ["bad.csv", "row 8 (line ", "column accel_z", "found inf"],
    ),
    "clipped": (
        lambda r: changed(r, accel_x=np.clip(r.columns["accel_x"], None, 0.9 * G)),
        ["bad.csv", "column accel_x", "clipped", "largest value", "8.825985 m/s^2", "row "],
    ),
    "time backwards": (
        lambda r: changed(r, time=put(r.columns["time"], 100, 0.5)),
        ["bad.csv", "row 101 (line ", "column time", "runs backwards", "expected more than 0.99 s", "found 0.5 s"],
    ),
    "time standing still": (
        lambda r: changed(r, time=put(r.columns["time"], 100, r.columns["time"][99])),
        ["bad.csv", "row 101 (line ", "column time", "stands still", "found 0.99 s"],
    ),
    "too few attitudes": (
        lambda r: first_rows(r, 2000),
        ["bad.csv: 5 attitudes determine 5 of the 9 parameters of order 1; they cannot separate ", "misalignment_z",
         "and 1 more; upward directions (", "would help most"],
    ),
    "no attitude at all": (
        lambda r: changed(r, **{f"accel_{a}": r.columns[f"accel_{a}"] + 3 * np.sin(9 * r.columns["time"]) *
                                (1 + np.sin(0.7 * r.columns["time"])) for a in "xyz"}),
        ["bad.csv"],
    ),
    "too short": (lambda r: first_rows(r, 50), ["bad.csv", "50 samples", "too few"]),
    "unit g instead of m/s^2": (
        lambda r: in_unit(r, "g"),
        ["bad.csv", "columns accel_x accel_y accel_z", "expected 1 g", "is the unit wrong?"],
    ),
    "unit m/s^2 instead of g": (
        lambda r: changed(r, **{f"accel_{a}": r.columns[f"accel_{a}"] / G for a in "xyz"}),
        ["bad.csv", "expected 9.807 m/s^2", "is the unit wrong?"],
    ),
    "two axes swapped": (
        lambda r: changed(r, accel_x=r.columns["accel_y"], accel_y=r.columns["accel_x"]),
        ["bad.csv", "columns accel_x accel_y accel_z", "swapped or reversed", "taken as y x z"],
    ),
    "an axis reversed": (
        lambda r: changed(r, accel_z=-r.columns["accel_z"]),
        ["bad.csv", "swapped or reversed", "taken as x y -z"],
    ),
    "the same column twice": (
        lambda r: changed(r, accel_y=r.columns["accel_x"]),
        ["bad.csv", "columns accel_x and accel_y hold the same samples"],
    ),
    "dead axis": (
        lambda r: changed(r, accel_z=np.full(len(r), 0.25)),
        ["bad.csv", "column accel_z", "dead axis"],
    ),
    "noisy dead axis": (
        lambda r: changed(r, accel_z=0.01 * np.random.default_rng(1).standard_normal(len(r))),
        ["bad.csv", "column accel_z", "dead axis"],
    ),
    "a gyroscope's file": (gyro_as_accelerometer, ["bad.csv", "accel_x"]),
    "a gyroscope's columns": (
        lambda r: only(r, ["time", "gyro_x", "gyro_y", "gyro_z"]),
        ["bad.csv", "no column accel_x; found time gyro_x gyro_y gyro_z"],
    ),
}  # fmt: skip


def is_one_line(text: str) -> bool:
    return text.startswith("imulab: ") and text.endswith("\n") and text.count("\n") == 1


@pytest.mark.parametrize("case", CASES)
def test_a_bad_recording_gets_one_line_and_leaves_nothing(case, good, imulab, tmp_path):
    change, fragments = CASES[case]
    il.write_csv(change(good), tmp_path / "bad.csv")
    (tmp_path / "old.json").write_text("an older record")
    options = ["--gravity", G, "--order", "1", "--report", "new.html"]
    if case == "a gyroscope's file":  # in counts, as a raw log would be: its unit gives nothing away
        text = (tmp_path / "bad.csv").read_text().replace("[m/s^2]", "[count]")
        (tmp_path / "bad.csv").write_text(text)
        fragments = [*fragments, "is this a gyroscope's recording?"]
    done = imulab("tumble", "fit", "bad.csv", *options, "-o", "old.json")
    assert done.returncode == 2, done.stderr
    assert is_one_line(done.stderr), done.stderr
    for fragment in fragments:
        assert fragment in done.stderr
    assert done.stdout == ""
    assert (tmp_path / "old.json").read_text() == "an older record"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bad.csv", "old.json"]


def test_the_recording_that_these_were_made_from_is_good(good, imulab, tmp_path):
    il.write_csv(good, tmp_path / "good.csv")
    done = imulab("tumble", "fit", "good.csv", "--gravity", G, "--order", "1", "-o", "r.json", "--report", "r.html")
    assert done.returncode == 0, done.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == ["good.csv", "r.html", "r.json"]


def test_rows_of_a_table_are_named(imulab, tmp_path):
    rng = np.random.default_rng(3)
    u = rng.standard_normal((20, 3))
    u *= G / np.linalg.norm(u, axis=1, keepdims=True)
    text = "accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2]\n" + "\n".join(",".join(map(repr, r)) for r in u.tolist())
    lines = text.split("\n")
    lines[12] = "1.0,abc,2.0"
    (tmp_path / "t.csv").write_text("\n".join(lines))
    done = imulab("tumble", "fit", "t.csv", "--gravity", G)
    assert done.returncode == 2
    assert done.stderr == "imulab: t.csv: row 12 (line 13), column accel_y: expected a number, found 'abc'\n"


def test_clipped_rows_of_a_table(imulab, tmp_path):
    rng = np.random.default_rng(4)
    u = rng.standard_normal((60, 3))
    u = np.minimum(u * G / np.linalg.norm(u, axis=1, keepdims=True), [np.inf, 0.7 * G, np.inf])
    text = "accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2]\n" + "\n".join(",".join(map(repr, r)) for r in u.tolist())
    (tmp_path / "t.csv").write_text(text)
    done = imulab("tumble", "fit", "t.csv", "--gravity", G)
    assert done.returncode == 2
    assert "column accel_y: clipped" in done.stderr
    assert is_one_line(done.stderr)


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        (["frobnicate"], ["No such command 'frobnicate'", "known commands:", "tumble"]),
        (["tumble", "frobnicate"], ["known commands: plan simulate fit gyro mag check"]),
        (["tumble", "fit"], ["Missing argument 'FILE'"]),
        (["tumble", "fit", "good.csv", "--frob"], ["--frob"]),
        (["tumble", "fit", "good.csv", "--order", "7"], ["--order '7': expected one of auto 0 1 2 3 4 5 blend"]),
        (["tumble", "fit", "good.csv", "--method", "magic"], ["expected one of norm linearised"]),
        (["tumble", "fit", "good.csv", "--loss", "cauchy"], ["expected one of square huber auto"]),
        (["tumble", "fit", "good.csv", "--gravity", "ten"], ["--gravity", "'ten'"]),
        (["tumble", "fit", "good.csv", "--gravity", "981"], ["expected the local value in m/s^2"]),
        (["tumble", "fit", "good.csv", "--gravity", "9.8", "--latitude", "48"], ["expected one or the other"]),
        (["tumble", "fit", "good.csv", "--height", "300"], ["--height without --latitude"]),
        (["tumble", "fit", "good.csv", "--latitude", "91"], ["latitude 91 deg: expected -90 to 90 deg"]),
        (["tumble", "fit", "good.csv", "-o", "good.csv"], ["good.csv: would overwrite good.csv"]),
        (["tumble", "fit", "good.csv", "-o", "no/such/folder/r.json"], ["no/such/folder/r.json: cannot be written"]),
        (["tumble", "fit", "good.csv", "-o", "r.json", "--report", "no/r.html"], ["no/r.html: cannot be written"]),
        (["tumble", "fit", "missing.csv"], ["missing.csv: no such file"]),
        (["tumble", "fit", "good.csv", "--layout", "missing.toml"], ["missing.toml: no such layout file"]),
        (["tumble", "simulate", "-o", "s.csv", "--order", "6"], ["order 6: expected 1 to 5"]),
        (["tumble", "simulate", "-o", "s.csv", "--noise", "fast"], ["--noise 'fast'", "1 mg"]),
        (["tumble", "simulate", "-o", "s.csv", "--unit", "deg/s"], ["expected m/s^2 g mg count V"]),
        (["tumble", "simulate", "-o", "s.csv", "--knock", "99"], ["knock 99", "1 to 24"]),
        (["tumble", "simulate", "-o", "s.txt"], ["s.txt", "ends in .csv"]),
        (["apply", "good.csv"], ["expected at least one RECORD and the FILE"]),
        (["apply", "good.csv", "good.csv"], ["good.csv: not a calibration record"]),
        (["show", "missing.csv"], ["missing.csv: no such file"]),
        (["report", "good.csv", "-o", "r.html"], ["good.csv: not a calibration record"]),
    ],
)
def test_a_wrong_command_line_gets_one_line(arguments, fragments, good, imulab, tmp_path):
    il.write_csv(first_rows(good, 1000), tmp_path / "good.csv")
    done = imulab(*arguments)
    assert done.returncode == 2, done.stderr
    assert is_one_line(done.stderr), done.stderr
    for fragment in fragments:
        assert fragment in done.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == ["good.csv"]


@pytest.mark.parametrize("command", ["show", "apply", "report"])
@pytest.mark.parametrize(
    ("damage", "fragment"),
    [
        (lambda text: text.replace('"value": 9.8', '"value": 9.7', 1), "altered after it was written"),
        (lambda text: text[: len(text) // 2], "cut or altered"),
        (lambda text: text.replace('"version": 1', '"version": 2', 1), "newer than version 1"),
        (lambda text: json.dumps({"hello": 1}), "not a calibration record"),
        (lambda text: text.replace('"order": 1', '"order": NaN', 1), "not a finite number"),
    ],
)
def test_a_damaged_record_is_refused_by_every_command(command, damage, fragment, good, imulab, tmp_path):
    record = il.fit_tumble(il.find_attitudes(good), order=1, gravity=G).calibration.to_json()
    damaged = damage(record)
    assert damaged != record
    (tmp_path / "r.json").write_text(damaged)
    il.write_csv(first_rows(good, 10), tmp_path / "f.csv")
    arguments = {"show": ["r.json"], "apply": ["r.json", "f.csv"], "report": ["r.json", "-o", "r.html"]}[command]
    done = imulab(command, *arguments)
    assert done.returncode == 2
    assert is_one_line(done.stderr)
    assert "r.json" in done.stderr
    assert fragment in done.stderr
    assert done.stdout == ""
    assert sorted(p.name for p in tmp_path.iterdir()) == ["f.csv", "r.json"]


def test_a_fault_of_imulab_itself_is_one_line_and_status_1(monkeypatch, capsys):
    from imulab import cli, gravity

    monkeypatch.setattr(gravity, "normal_gravity", lambda *_: 1 / 0)
    assert cli.main(["tumble", "fit", "x.csv", "--latitude", "48"]) == 1
    error = capsys.readouterr().err
    assert is_one_line(error)
    assert "internal error: ZeroDivisionError" in error

"""Fleets of units with gyroscopes: every procedure that knows them, as its own command, and in the line's report."""

import csv
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import imulab as il
from fleets import write_manifest
from imulab.cli import main
from imulab.fleet.run import run_fleet


def run(*arguments):
    return main([*map(str, arguments)], project=False)


def plain(path):
    """What a record says but for when and by what it was made, and what the fleet adds."""
    left_out = ("created", "software", "content_sha256", "fleet")
    return {key: value for key, value in json.loads(path.read_text()).items() if key not in left_out}


def unnamed(recording):
    """Without its serial number, which the manifest says."""
    return replace(recording, metadata={k: v for k, v in recording.metadata.items() if k != "serial"})


def with_accelerometers(made, accel):
    """A rate test with the outputs of accelerometers of this record, the table axis upright, but for noise."""
    misalignment = np.eye(3)
    misalignment[[1, 2, 2], [0, 0, 1]] = [accel.value(f"misalignment_{pair}") for pair in ("yx", "zx", "zy")]
    scale, bias = (np.array([accel.value(f"{name}_{a}") for a in "xyz"]) for name in ("scale_factor", "bias"))
    recordings = []
    for number, (each, one) in enumerate(zip(made.recordings, made.test.runs, strict=True)):
        up = np.zeros(3)
        up["xyz".index(one.mounting[1])] = 9.81 if one.mounting[0] == "+" else -9.81
        noise = np.random.default_rng(number).normal(0, 1e-3, (len(each), 3))
        outputs = scale * (misalignment @ up + bias) + noise
        columns = {f"accel_{a}": outputs[:, k] for k, a in enumerate("xyz")}
        recordings.append(unnamed(each).with_columns(columns, dict.fromkeys(columns, "m/s^2")))
    return replace(made, recordings=tuple(recordings))


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    """Recordings of one unit for each procedure, the records that some of these rest on, and a row for each."""
    folder = tmp_path_factory.mktemp("line")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        il.write(unnamed(il.simulate_tumble(attitudes=16, order=1, hold=3.0, seed=4, gravity=9.81)), "tumble.csv")
        for number, soak in enumerate(il.simulate_thermal(attitudes=10, gyro=True, seed=1)):
            il.write(unnamed(soak), f"soak_{number}.csv")
        il.write(unnamed(il.simulate_magnetometer(duration="20 s", seed=3)), "waved.csv")
        (ramp,) = il.simulate_thermal("0,40", attitudes=0, ramps=1, gyro=True, duration="10 min", seed=5)
        il.write(unnamed(ramp), "ramp.csv")
        rest = il.simulate_noise(white="0.005 deg/s/sqrt(Hz)", rate="20 Hz", duration="20 min", columns="gyro_x,gyro_y")
        il.write(unnamed(rest), "rest.csv")
        assert run("tumble", "fit", "tumble.csv", "--order", 1, "--gravity", "9.81+-0", "-o", "accel.json") == 0
        assert run("tumble", "gyro", "tumble.csv", "--accel", "accel.json", "-o", "prior.json") == 0
        with_accelerometers(il.simulate_rate("0,100,200", hold="5 s", seed=2), il.load("accel.json")).save("r")
    soaks = ";".join(f"soak_{number}.csv" for number in range(5))
    rows = [
        {"serial": "A", "procedure": "tumble", "file": "tumble.csv", "order": "1", "gravity": "9.81+-0", "with": "gyro",
         "latitude": "48.1"},
        {"serial": "B", "procedure": "thermal", "file": soaks, "with": "gyro", "gyro-turn-on-scatter": "0.01 deg/s",
         "degrees": "3,2,1"},
        {"serial": "C", "procedure": "rate", "file": "r/test.toml"},
        {"serial": "D", "procedure": "rate", "file": "r/test.toml", "accel": "accel.json", "prior": "prior.json",
         "latitude": "48"},
        {"serial": "E", "procedure": "noise", "file": "rest.csv", "terms": "NBK"},
        {"serial": "F", "procedure": "magnetometer", "file": "waved.csv", "field": "48 uT"},
        {"serial": "G", "procedure": "thermal", "file": "ramp.csv", "degrees": "2,0,0"},
    ]  # fmt: skip
    return folder, rows


@pytest.mark.slow
def test_each_record_is_the_single_commands_to_the_last_bit(line, monkeypatch):
    folder, rows = line
    monkeypatch.chdir(folder)
    write_manifest(folder / "fleet.csv", rows)
    state = run_fleet("fleet.csv", "out", workers=1)
    assert [(each.unit.serial, each.reason) for each in state.failures] == []
    for row in rows:
        options = [each for name, value in row.items() if name not in ("serial", "procedure", "file")
                   for each in (f"--{name}", value)]  # fmt: skip
        one, many = folder / f"one_{row['serial']}.json", folder / "out" / f"{row['serial']}.json"
        assert run(row["procedure"], "fit", *row["file"].split(";"), *options, "-o", one) == 0
        single, fleet = plain(one), plain(many)
        assert fleet.pop("sensor") == {**single.pop("sensor"), "serial": row["serial"]}
        assert fleet == single
    assert any(name.startswith("gyro_") for name in il.load("out/A.json").parameters)


def test_what_a_record_rests_on_counts_among_its_files(line, monkeypatch, tmp_path):
    folder, rows = line
    shutil.copytree(folder, tmp_path / "in", ignore=shutil.ignore_patterns("out", "one_*"))
    monkeypatch.chdir(tmp_path)
    write_manifest(tmp_path / "in" / "fleet.csv", rows[3:4])
    assert run_fleet("in/fleet.csv", "out", workers=1).kept == 0
    assert run_fleet("in/fleet.csv", "out", workers=1).kept == 1
    for name in ("accel.json", "prior.json"):
        record = il.load(tmp_path / "in" / name)
        replace(record, warnings=(*record.warnings, "another")).save(tmp_path / "in" / name)
        assert run_fleet("in/fleet.csv", "out", workers=1).kept == 0
        assert run_fleet("in/fleet.csv", "out", workers=1).kept == 1


@pytest.mark.parametrize(
    ("row", "column", "value", "said"),
    [
        (0, "with", "gyr", "gyro"),
        (0, "latitude", "95", "expected -90 to 90 deg"),
        (0, "height", "100", "expected one or the other"),
        (1, "gyro-turn-on-scatter", "0.1 mg", "rate"),
        (1, "with", "mag", "gyro"),
        (2, "latitude", "48 m", "angle"),
        (2, "order", "9", "auto"),
        (4, "terms", "NX", "N"),
    ],
)
def test_a_wrong_value_is_refused_in_one_line_before_any_work(line, monkeypatch, capsys, row, column, value, said):
    folder, rows = line
    monkeypatch.chdir(folder)
    write_manifest(folder / "wrong.csv", [*rows[:row], {**rows[row], column: value}, *rows[row + 1 :]])
    assert run("fleet", "run", "wrong.csv", "-o", "wrong") == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert f"wrong.csv: row {row + 1} (line {row + 2}): column " in error
    assert f"column {column.replace('-', '_')}" in error
    assert said in error
    assert not (folder / "wrong").exists()


def test_a_fault_of_a_unit_with_gyroscopes_is_that_units(line, monkeypatch):
    """A prior without gyroscopes, an accelerometers' record that is none, soaks that lack the columns."""
    folder, rows = line
    monkeypatch.chdir(folder)
    bare = il.read("tumble.csv")
    kept = [name for name in bare.columns if not name.startswith("gyro_")]
    il.write(replace(bare, columns={n: bare.columns[n] for n in kept}, units={n: bare.units[n] for n in kept}), "b.csv")
    wrong = [
        {**rows[0], "file": "b.csv"},
        {**rows[3], "prior": "accel.json"},
        {**rows[3], "serial": "F", "accel": "absent.json"},
        rows[2],
    ]
    write_manifest(folder / "faults.csv", wrong)
    state = run_fleet("faults.csv", "faults", workers=1)
    assert state.count("done") == 1
    reasons = {each.unit.serial: each.reason for each in state.failures}
    assert reasons["A"].startswith("b.csv: no column gyro_x")
    assert reasons["D"].startswith("accel.json: prior: a tumble record without gyroscopes")
    assert "absent.json" in reasons["F"]
    assert not any("\n" in reason for reason in reasons.values())


@pytest.mark.slow
def test_the_report_shows_gyroscopes_in_the_units_that_people_read(line, monkeypatch):
    folder, rows = line
    monkeypatch.chdir(folder)
    write_manifest(folder / "all.csv", rows[:-1])
    run_fleet("all.csv", "shown", workers=1)
    (folder / "limits.toml").write_text(
        '[rate]\n"gyro_scale_factor_*" = { lower = -2500, upper = 2500, unit = "ppm" }\n'
        '[tumble]\n"gyro_bias_*" = { lower = -1, upper = 1, unit = "deg/s" }\n'
        '[thermal]\ngyro_bias_x_t1 = { lower = -0.1, upper = 0.1, unit = "deg/h/K" }\n'
    )
    assert run("fleet", "report", "shown", "-o", "line.html", "--limits", "limits.toml") == 0
    page = re.sub(r"<script.*?</script>", "", (folder / "line.html").read_text(encoding="utf-8"), flags=re.DOTALL)
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", page))
    found = dict(re.findall(r"\b((?:gyro_)?(?:bias|scale_factor|misalignment)\w+) (\S+) 1 ", text))
    assert found["gyro_bias_x"] == "deg/h"
    assert found["gyro_bias_x_t1"] == "deg/h/K"
    assert found["bias_x_t2"] == "µg/K²"
    assert "gyro_scale_factor_y ppm off nominal 1 " in text
    assert found["scale_factor_y_t1"] == "ppm/K"
    assert found["gyro_misalignment_zy"] == "mrad"
    beyond = dict(re.findall(r"\b(gyro_scale_factor_[xyz]) ppm off nominal 2 (\d+) ", text))
    assert beyond == {"gyro_scale_factor_x": "0", "gyro_scale_factor_y": "2", "gyro_scale_factor_z": "0"}
    record = il.load("shown/A.json")
    shown = float(re.search(r"gyro_scale_factor_y ppm off nominal 1 \S+ (\S+)", text)[1])
    assert shown == pytest.approx(1e6 * (record.value("gyro_scale_factor_y") * np.pi / 180 - 1), abs=1)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for seed in (1, 2):
        il.simulate_thermal("-20,0,25,45,60", attitudes=10, seed=seed).save(f"u{seed}")
    return tmp_path


def names(seed, count=5):
    return ";".join(f"u{seed}/tumble_{t}.csv" for t in (-20, 0, 25, 45, 60)[:count])


def manifest(rows):
    with Path("fleet.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, fieldnames=["serial", "procedure", "file", "degrees", "turn-on-scatter"])
        writer.writeheader()
        writer.writerows(rows)


def test_several_recordings_of_each_unit_are_fitted_as_one_alone(folder):
    manifest(
        [
            {"serial": "SIM-0001", "procedure": "thermal", "file": names(1), "degrees": "3,2,1"},
            {"serial": "SIM-0002", "procedure": "thermal", "file": names(2), "turn-on-scatter": "0.1 mg"},
            {"serial": "SIM-0003", "procedure": "thermal", "file": "u1/tumble_0.csv"},
            {"serial": "SIM-0004", "procedure": "thermal", "file": f"{names(1, 3)};u2/tumble_60.csv"},
        ]
    )
    state = il.run_fleet("fleet.csv", "out", workers=1)
    assert state.count("done") == 2
    alone, mixed = (row.reason for row in state.failures)
    assert alone.startswith("u1/tumble_0.csv: column temperature: spans 0.2 K")
    assert mixed.startswith("u1/tumble_-20.csv is of serial SIM-0001, u2/tumble_60.csv of SIM-0002; expected")
    files = names(1).split(";")
    assert main(["thermal", "fit", *files, "--degrees", "3,2,1", "-o", "one.json"], project=False) == 0
    one, many = il.load("one.json"), il.load("out/SIM-0001.json")
    assert (many.parameters, many.covariance, many.fit) == (one.parameters, one.covariance, one.fit)
    assert il.load("out/SIM-0002.json").fit["between_recordings"]["from"] == "argument"
    assert il.run_fleet("fleet.csv", "out", workers=1).kept == 2


@pytest.mark.slow
def test_units_are_compared_at_temperatures_that_they_share(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    il.simulate_thermal("-20,0,20,40,60", attitudes=10, seed=1).save("wide")
    il.simulate_thermal("-21,-10,0,10,21", attitudes=10, seed=1).save("cold")
    rows = [
        {"serial": name, "procedure": "thermal", "file": ";".join(map(str, sorted(Path(name).glob("tumble_*.csv")))),
         "degrees": degrees}
        for name, degrees in (("wide", "3,2,1"), ("cold", "2,1,0"))
    ]  # fmt: skip
    manifest(rows)
    assert il.run_fleet("fleet.csv", "out", workers=1).count("done") == 2
    with Path("out/parameters.csv").open(encoding="utf-8") as stream:
        table = {row["serial"]: row for row in csv.DictReader(stream)}
    for serial, at in (("wide", (0, 20, 40)), ("cold", (-20, 0, 20))):
        record = il.load(f"out/{serial}.json")
        middle = record.model["reference_temperature"]["value"]
        assert float(table[serial]["reference_temperature [degC]"]) == middle
        names = [name for name in record.parameters if name == "bias_x" or name.startswith("bias_x_t")]
        for temperature in at:
            powers = (temperature - middle) ** np.arange(len(names))
            column = f"bias_x at {temperature:.1f} degC [m/s^2]"
            expected = powers @ [record.value(name) for name in names]
            assert float(table[serial][column]) == pytest.approx(expected, rel=1e-12)
            u = float(table[serial][f"std_{column}"])
            assert u == pytest.approx(np.sqrt(powers @ record.cov(*names) @ powers), rel=1e-9)
    assert table["cold"]["bias_x at 40.0 degC [m/s^2]"] == ""
    # One unit twice, measured over other ranges: its values agree where its coefficients are 20 K apart.
    there = [float(table[serial]["bias_x at 0.0 degC [m/s^2]"]) for serial in table]
    assert (
        abs(np.diff(there)[0])
        < 5e-3
        < abs(il.load("out/wide.json").value("bias_x") - il.load("out/cold.json").value("bias_x"))
    )
    Path("limits.toml").write_text('[thermal]\n"bias_x at *" = { lower = -1, upper = 1, unit = "g" }\n')
    assert main(["fleet", "report", "out", "-o", "r.html", "--limits", "limits.toml"], project=False) == 0
    page = Path("r.html").read_text(encoding="utf-8")
    assert re.search(r"reference temperature from -?0\.\d to 20\.\d degC", page)
    assert "bias_x at 20.0 degC</td>" in page
    assert "<td>bias_x</td>" not in page
    assert "<td>bias_x_t1</td>" not in page
    manifest([{**row, "degrees": "spline,1,0"} for row in rows])
    assert il.run_fleet("fleet.csv", "splines", workers=1).count("done") == 2
    assert main(["fleet", "report", "splines", "-o", "splines.html"], project=False) == 0
    found = set(re.findall(r"<tr><td>(bias_x[^<]*)</td>", Path("splines.html").read_text(encoding="utf-8")))
    assert {"bias_x at 0.0 degC", "bias_x at 40.0 degC"} <= found
    assert all(name.startswith("bias_x at ") for name in found)
    rows[1] = {**rows[0], "serial": "again"}
    manifest(rows)
    assert il.run_fleet("fleet.csv", "out", workers=1).count("done") == 2
    assert main(["fleet", "report", "out", "-o", "same.html"], project=False) == 0
    assert "<td>bias_x_t1</td>" in Path("same.html").read_text(encoding="utf-8")

"""Units over temperature in a fleet: several recordings in a row of the manifest, and what fails its unit alone."""

import csv
import re
from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.cli import main


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

"""Units over temperature in a fleet: several recordings in a row of the manifest, and what fails its unit alone."""

import csv
from pathlib import Path

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
    assert mixed.startswith("u2/tumble_60.csv: serial SIM-0002, but u1/tumble_-20.csv is of serial SIM-0001; expected")
    files = names(1).split(";")
    assert main(["thermal", "fit", *files, "--degrees", "3,2,1", "-o", "one.json"], project=False) == 0
    one, many = il.load("one.json"), il.load("out/SIM-0001.json")
    assert (many.parameters, many.covariance, many.fit) == (one.parameters, one.covariance, one.fit)
    assert il.load("out/SIM-0002.json").fit["between_recordings"]["from"] == "argument"
    assert il.run_fleet("fleet.csv", "out", workers=1).kept == 2

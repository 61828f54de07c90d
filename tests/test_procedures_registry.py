"""A procedure that nobody knows but the registry goes all the way: fit, record, report, apply, show and a fleet."""

from pathlib import Path
from typing import Annotated

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.cli.options import GivenFiles
from imulab.device.tables import DeviceTable, Field, whole
from imulab.device.unit import correct_gyroscopes, golden_gyroscopes
from imulab.options import file, measure, read_options
from imulab.procedures.procedure import Procedure, Section, Task, source_of
from imulab.procedures.registry import PROCEDURES, run_task
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.records.triads import Accelerometers, Triads
from imulab.report import traces

RATE = (0.01, -0.02, 0.03)
NAMES = tuple(f"drift_{axis}" for axis in "xyz")


def fit_drift(
    data,
    *,
    skip: Annotated[float | str, measure("time", "s")] = "0 s",
    layout: Annotated[str | None, file("NAME|L.toml")] = None,
):
    """Find the drift at rest.

    Parameters
    ----------
    skip
        Time at the start to leave out.
    layout
        Columns of a foreign file.
    """


def _values(texts, label):
    return read_options(DriftProcedure.task.options, texts, label)


def _fit(files, values, access, progress):
    recording = access.recording(files[0], values["layout"])
    at_rest = recording.column("time") >= values["skip"]
    found = {name: recording.column(f"gyro_{name[-1]}")[at_rest] for name in NAMES}
    spread = {name: float(column.std() / np.sqrt(len(column))) for name, column in found.items()}
    return Calibration(
        procedure="drift",
        parameters={name: Parameter(float(found[name].mean()), spread[name], "rad/s") for name in NAMES},
        covariance=Covariance(NAMES, tuple(map(tuple, np.diag([spread[name] ** 2 for name in NAMES]).tolist()))),
        model={"output_unit": "rad/s"},
        fit={"samples": int(at_rest.sum())},
        options={"skip": values["skip"]},
        sensor={"serial": recording.metadata["serial"]},
        sources=(source_of(access, files[0]),),
    )


def _tables(record):
    drift = np.array([record.value(name) for name in NAMES])
    fields = (
        Field("has_sensitivity", whole(False)),
        Field("gain", np.ones(3)),
        Field("bias", drift),
        Field("turn", np.eye(3)),
    )
    return (DeviceTable("gyro", fields, {"output_unit": "rad/s"}),)


def _exhibits(record):
    rows = [[name, f"{record.value(name):.3f}"] for name in NAMES]
    return traces.Exhibits(
        "What drifts at rest.", [("samples", "1000")], [traces.ReportTable("Drift", "", ["", ""], rows)]
    )


class DriftSection(Section):
    kind = "gyro"
    triad = "gyro"

    def golden(self, table, random):
        return golden_gyroscopes(table, random)

    def apply(self, unit, columns, recording):
        return correct_gyroscopes(unit, columns, recording)


class DriftProcedure(Procedure):
    name = "drift"
    command = "drifts"
    title = "Drift at rest"
    line_title = "Drifts"
    task = Task("one recording", (1, 1), lambda: fit_drift, _values, _fit)
    sections = (DriftSection(),)

    def check(self, record):
        pass

    def exhibits(self, record):
        return _exhibits(record)

    def tables(self, record, fusion=None):
        return _tables(record)


class ExportedDrift(DriftProcedure):
    """One whose records other programs can hold."""

    states_triads = True

    def triads(self, record):
        accel = Accelerometers(np.full(3, 2.0), np.eye(3), np.ones(3), np.array([[0.1, 0, 0]]), np.zeros(3), "m/s^2")
        return Triads(accel, None)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.setitem(PROCEDURES, "drifts", DriftProcedure())
    monkeypatch.chdir(tmp_path)
    for k in (1, 2):
        rng = np.random.default_rng(k)
        columns = {"time": np.arange(1000) / 100}
        columns |= {f"gyro_{a}": r + 1e-4 * rng.standard_normal(1000) for a, r in zip("xyz", RATE, strict=True)}
        units = {name: "s" if name == "time" else "rad/s" for name in columns}
        il.write_csv(il.Recording(columns, units, {"serial": f"SN{k}"}), f"{k}.csv")
    return tmp_path


@pytest.fixture
def record(here):
    made = run_task("drifts", ["1.csv"], {"skip": "1 s"}, GivenFiles())
    made.save("1.json")
    return made


def test_its_fit_is_a_record(record):
    assert [record.value(name) for name in NAMES] == pytest.approx(RATE, abs=2e-5)
    assert record.fit["samples"] == 900
    assert il.load("1.json") == record


def test_its_record_is_reported_and_shown(record, capsys):
    assert main(["report", "1.json", "-o", "1.html"]) == 0
    page = Path("1.html").read_text(encoding="utf-8")
    assert "Drift at rest" in page
    assert "What drifts at rest." in page
    capsys.readouterr()
    assert main(["show", "1.json"]) == 0
    shown = capsys.readouterr().out
    assert "drift calibration of SN1" in shown
    assert "drift_y" in shown


def test_its_record_corrects_recordings(record):
    assert main(["apply", "1.json", "1.csv", "-o", "out.csv"]) == 0
    corrected = il.read("out.csv")
    for axis in "xyz":
        assert abs(corrected.column(f"gyro_{axis}").mean()) < 2e-5
    assert main(["export", "--to", "blob", "1.json", "-o", "fw"]) == 0
    assert main(["apply", "fw/unit.blob", "1.csv", "-o", "by_blob.csv"]) == 0
    np.testing.assert_allclose(il.read("by_blob.csv").column("gyro_x"), corrected.column("gyro_x"), atol=1e-8)


def test_its_record_is_exported_where_its_entry_states_triads(record, monkeypatch, capsys):
    assert main(["export", "--to", "ros", "1.json", "-o", "ros"]) == 2
    reason = "ros: a drift record cannot be exported: it states no accelerometers; use --to c or --to blob"
    assert reason in capsys.readouterr().err
    monkeypatch.setitem(PROCEDURES, "drifts", ExportedDrift())
    assert main(["export", "--to", "ros", "1.json", "-o", "ros", "--lossy"]) == 0
    said = capsys.readouterr().err
    assert "k2_x" in said
    assert "bias, scale factor and misalignment are those of the whole model" in said
    assert Path("ros/imu_calib.yaml").read_text().splitlines()[-14:] == [
        "SM:",
        *(f"  - {value}" for value in np.diag([0.5] * 3).ravel()),
        "bias:",
        *["  - 1.0"] * 3,
    ]


def test_a_fleet_runs_it(here, capsys):
    (here / "line.csv").write_text("serial,procedure,file,skip\nSN1,drifts,1.csv,1 s\nSN2,drifts,2.csv,\n")
    assert main(["fleet", "run", "line.csv", "-o", "out", "--workers", "1"]) == 0
    assert capsys.readouterr().out.startswith("2 units: 2 done, 0 failed")
    assert il.load("out/SN1.json").fit["samples"] == 900
    assert il.load("out/SN2.json").fit["samples"] == 1000
    assert main(["fleet", "report", "out", "-o", "line.html"]) == 0
    assert "Drifts" in (here / "line.html").read_text(encoding="utf-8")
    (here / "line.csv").write_text("serial,procedure,file,skip\nSN1,drifts,1.csv,a while\n")
    assert main(["fleet", "run", "line.csv", "-o", "other", "--workers", "1"]) == 2
    assert "skip" in capsys.readouterr().err

"""A centrifuge record at run time, the command line from plan to corrected data, and the report."""

import csv
import json
import re
import tomllib
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.errors import DataError, OptionError, RecordError, UnitError
from imulab.procedures.centrifuge.manifest import make_manifest
from imulab.procedures.centrifuge.plan import plan_centrifuge
from imulab.procedures.centrifuge.simulate import Simulation, typical_truth
from imulab.procedures.views import exhibits_of, render_record
from imulab.recording import Recording
from imulab.report.traces import Figure

G = 9.80665
DEG_H = np.pi / 180 / 3600
NET = np.radians(40.0)


def record_of(encoder=True, **change):
    test = make_manifest(
        levels=[G, 5 * G, 20 * G], radius=2.0, net_rate=NET, cycles=2, both_senses=True, sensor={"serial": "D7"}
    )
    truth = replace(typical_truth(0.02), **change)
    return il.fit_centrifuge(test, Simulation(test, truth, 50.0, 60.0, 5.0, encoder)).calibration


@pytest.fixture(scope="module")
def record():
    return record_of()


def flight(units=("deg/h", "g"), **columns):
    force = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, -2.0], [6.0, 8.0], [np.nan, 1.0]])
    data = {"time": np.arange(5.0), "dtg_x": np.full(5, 100.0), "dtg_y": np.full(5, -50.0),
            "accel_x": force[:, 0].copy(),
            "accel_y": force[:, 1].copy(), "fog": np.arange(5.0)} | columns  # fmt: skip
    unit = {"time": "s", "dtg_x": units[0], "dtg_y": units[0], "accel_x": units[1], "accel_y": units[1], "fog": "deg/h"}
    return Recording(data, {name: unit.get(name, "1") for name in data}, name="flight.csv", lines_before=1)


@pytest.mark.parametrize(("rate", "per_rate"), [("deg/h", DEG_H), ("rad/s", 1.0)])
def test_apply_subtracts_the_curve_along_its_direction(record, rate, per_rate):
    raw = flight((rate, "g"))
    corrected = il.apply(record, raw)
    for axis in "xy":
        p = {
            n: record.value(f"{axis}_{n}") if f"{axis}_{n}" in record.parameters else 0.0
            for n in ("K0", "c1", "c2", "direction")
        }
        for i, (x, y) in enumerate(zip(raw.si("accel_x"), raw.si("accel_y"), strict=True)):
            a = (x * x + y * y) ** 0.5
            drift = (
                p["K0"]
                * (1 + p["c1"] * a + p["c2"] * a * a)
                * (x * np.cos(p["direction"]) + y * np.sin(p["direction"]))
            )
            found = corrected.column(f"dtg_{axis}")[i]
            assert found == pytest.approx(raw.column(f"dtg_{axis}")[i] - drift / per_rate, rel=1e-12, nan_ok=True)
    assert list(corrected.columns) == list(raw.columns)
    assert corrected.units == raw.units
    for name in ("time", "fog", "accel_x", "accel_y"):
        np.testing.assert_array_equal(corrected.column(name), raw.column(name))
    assert np.isnan(corrected.column("dtg_x")[4])


def test_apply_takes_the_drift_out_of_the_test_s_own_recording(record):
    """At 20 g what is left of X - FOG at the table rate is the noise."""
    test = make_manifest(levels=[G, 20 * G], radius=2.0, net_rate=NET)
    run = test.runs[2]
    (block,) = Simulation(test, typical_truth(0.02), 50.0, 100.0, 5.0)(run)
    chi = block.si("table_angle")
    force = test.force(run) * np.stack([np.cos(chi), np.sin(chi)])
    flown = block.with_columns({"accel_x": force[0], "accel_y": force[1]}, {"accel_x": "m/s^2", "accel_y": "m/s^2"})
    corrected = il.apply(record, flown)
    left = [2 * abs(np.mean((r.si("dtg_x") - r.si("fog")) * np.exp(-1j * chi))) / DEG_H for r in (flown, corrected)]
    assert left[0] == pytest.approx(66, rel=0.05)
    assert left[1] < 0.5


def test_apply_refuses_what_it_cannot_correct(record):
    with pytest.raises(RecordError, match="no x_direction: it was made without table_angle"):
        il.apply(record_of(False), flight())
    with pytest.raises(DataError, match=r"flight.csv: no column dtg_x or dtg_y; found time fog"):
        il.apply(
            record,
            Recording({"time": np.arange(2.0), "fog": np.zeros(2)}, {"time": "s", "fog": "deg/h"}, name="flight.csv"),
        )
    with pytest.raises(UnitError, match="column dtg_x is in count"):
        il.apply(record, flight(("count", "g")))
    with pytest.raises(UnitError, match="column accel_x is in V"):
        il.apply(record, flight(("deg/h", "V")))
    whole = flight()
    lame = Recording({k: whole.columns[k] for k in ("dtg_x", "accel_x")}, whole.units, name="flight.csv")
    with pytest.raises(DataError, match="no column accel_y"):
        il.apply(record, lame)
    with pytest.raises(RecordError, match="no curve for dtg_y"):
        il.apply(record_of(y=None), flight())


def test_a_record_without_direction_is_refused_by_its_name(imulab, tmp_path):
    record_of(False).save(tmp_path / "r.json")
    il.write_csv(flight(), tmp_path / "f.csv")
    for command in (["apply", "r.json", "f.csv", "-o", "c.csv"], ["export", "--to", "c", "r.json", "-o", "fw"]):
        done = imulab(*command)
        assert done.returncode == 2
        assert done.stderr.startswith("imulab: r.json: the record has no x_direction: it was made without table_angle")
        assert done.stderr.count("\n") == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["f.csv", "r.json"]


def test_apply_warns_once_beyond_the_highest_level(record, imulab, tmp_path):
    record.save(tmp_path / "r.json")
    force = np.array([0.0, 0.0, 0.0, 25.0, 30.0])
    il.write_csv(flight(accel_x=force, accel_y=0 * force), tmp_path / "f.csv")
    done = imulab("apply", "r.json", "f.csv", "-o", "c.csv")
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("warning") == 1
    assert "f.csv: 2 samples beyond 20 g (up to 30 g), the highest level" in done.stderr


def test_the_record_keeps_the_contract(record, tmp_path):
    record.save(tmp_path / "r.json")
    content = json.loads((tmp_path / "r.json").read_text())
    assert content["procedure"] == "centrifuge"
    assert content["sensor"] == {"serial": "D7"}
    units = {
        "K": "rad/s/(m/s^2)",
        "K0": "rad/s/(m/s^2)",
        "zeta": "1",
        "c1": "1/(m/s^2)",
        "c2": "1/(m/s^2)^2",
        "direction": "rad",
    }
    for name, parameter in content["parameters"].items():
        assert parameter["unit"] == units[name.split("_")[1]]
    assert content["covariance"]["names"] == list(content["parameters"])
    assert {f"x_K_{n}" for n in (1, 2, 3)} | {"x_zeta_2", "x_zeta_3", "x_K0", "x_direction"} <= set(
        content["parameters"]
    )
    assert content["levels"][0]["level"] == 1
    assert content["levels"][0]["specific_force"]["unit"] == "m/s^2"
    for row in content["runs"]:
        assert {"file", "power_cycle", "role", "sense", "arm_rate", "table_rate", "specific_force"} <= set(row)
        if row["role"] == "loaded":
            assert {"A", "B", "covariance", "unit"} <= set(row["x"])
            assert "table_rate_used" in row
    assert il.load(tmp_path / "r.json").parameters == record.parameters


def test_plan_simulate_reduce_apply_report(imulab, tmp_path):
    """The whole way by the command line; what plan writes is what simulate and reduce take."""
    done = imulab("centrifuge", "plan", "--levels", "1,10", "--cycles", "1", "--both-senses", "-o", "plan.toml")
    assert done.returncode == 0, done.stderr
    assert "u(K), %" in done.stdout
    assert "fewer than the 500 table periods" in done.stderr
    assert len(tomllib.loads((tmp_path / "plan.toml").read_text())["run"]) == 5
    for step in ("Level arm and table", "at their zero positions", "Stop table and arm, save, power off"):
        assert step in done.stdout
        assert step in (tmp_path / "plan.toml").read_text()
    options = ["--duration", "60 s", "--static-duration", "10 s", "--rate", "20 Hz"]
    done = imulab("centrifuge", "simulate", "--plan", "plan.toml", "-o", "sim", *options)
    assert done.returncode == 0, done.stderr
    for method in ("least-squares", "fourier"):
        name = f"{method}.json"
        done = imulab(
            "centrifuge", "reduce", "sim/manifest.toml", "--method", method, "-o", name, "--report", f"{method}.html"
        )
        assert done.returncode == 0, done.stderr
        record = il.load(tmp_path / name)
        assert record.fit["method"] == method
        assert len(record.sources) == 6
        assert record.sources[1].file == "c1_static.csv"
        assert re.fullmatch("[0-9a-f]{64}", record.sources[1].sha256)
        assert record.value("x_K_2") * G / DEG_H == pytest.approx(3.3, rel=0.02)
    page = (tmp_path / "least-squares.html").read_text()
    assert "Spectrum around the table rate" in page
    assert imulab("report", "least-squares.json", "-o", "again.html").returncode == 0
    assert (tmp_path / "again.html").read_text() == page
    shown = imulab("show", "least-squares.json").stdout
    assert "Error budget (X axis)" in shown
    printed = imulab("centrifuge", "reduce", "sim/manifest.toml", "--json").stdout
    assert json.loads(printed)["parameters"].keys() == record.parameters.keys()


def test_the_report_shows_what_was_asked(record):
    exhibits = exhibits_of(record)
    titles = [item.title for item in exhibits.items]
    assert [t for t in titles if isinstance(next(i for i in exhibits.items if i.title == t), Figure)] == [
        "Change of the drift factor with specific force", "Complex drift factor of each level",
        "Repeatability over power cycles",
        "Spectrum around the table rate",
    ]  # fmt: skip
    repeated = next(item for item in exhibits.figures if item.title == "Repeatability over power cycles")
    assert {trace["name"] for trace in repeated.traces} <= {f"power cycle {n}" for n in range(1, 9)}
    assert exhibits.headline.startswith("X drifts by 3.")
    undirected = exhibits_of(record_of(False))
    assert undirected.headline
    assert "Complex drift factor of each level" not in [item.title for item in undirected.items]
    assert exhibits_of(record_of(y=None)).items


def test_the_headline_says_by_how_much_the_drift_is_not_linear(record):
    test = make_manifest(levels=[G, 5 * G, 20 * G], radius=2.0, net_rate=NET)
    linear = il.fit_centrifuge(test, Simulation(test, typical_truth(0.0), 50.0, 60.0, 5.0), curve="constant")
    K0 = r"3\.\d+ ± 0\.0\d+ deg/h per g"
    assert re.fullmatch(
        rf"X drifts linearly with g, by {K0} from 1 g to 20 g; the factor at 20 g is [\d.]+ ± [\d.]+ % "
        r"(larger|smaller) than that at 1 g\.",
        exhibits_of(linear.calibration).headline,
    )
    falling = exhibits_of(record_of(y=None, x=replace(typical_truth(0.02).x, c1=-3e-4))).headline
    assert re.search(
        r"at 20 g the factor is [\d.]+ ± [\d.]+ % smaller measured .* [\d.]+ ± [\d.]+ % smaller by", falling
    )
    one = make_manifest(levels=[5 * G], radius=2.0, net_rate=NET)
    found = il.fit_centrifuge(one, Simulation(one, typical_truth(), 50.0, 60.0, 5.0)).calibration
    assert re.fullmatch(rf"X drifts by {K0} at 5 g\.", exhibits_of(found).headline)


def test_the_table_of_runs_has_drift_and_uncertainty_of_each(record):
    table = next(item for item in exhibits_of(record).items if item.title == "Runs")
    assert table.columns == [
        "run", "file", "cycle", "g", "sense", "table rate, deg/s", "periods", "X drift ± u, deg/h",
        "Y drift ± u, deg/h", "FOG line, deg/h",
    ]  # fmt: skip
    assert "Table rates from: encoder." in table.caption
    loaded = [
        (row, run) for row, run in zip(table.rows, record.sections["runs"], strict=True) if run["role"] == "loaded"
    ]
    assert all(len(row) == len(table.columns) for row in table.rows)
    assert [row[0] for row in table.rows] == [str(n) for n in range(1, len(table.rows) + 1)]  # as messages count
    assert table.rows[0][3:6] == ["0", "static", "–"]
    for row, run in loaded:
        assert float(row[3]) == pytest.approx(run["specific_force"]["value"] / G, rel=1e-3)
        assert row[4] == f"{run['sense']:+d}"
        K = run["x"]["K"]
        drift, u = map(float, row[7].split(" ± "))
        assert drift == pytest.approx(K["value"] * run["specific_force"]["value"] / DEG_H, abs=2 * u)
        assert u == pytest.approx(np.sqrt(run["x"]["covariance"][0][0]) / DEG_H, rel=0.06)


def test_the_table_of_runs_says_what_differs_between_them():
    test = make_manifest(levels=[G, 5 * G], radius=2.0, net_rate=NET)
    down = tuple(replace(run, file=f"d_{run.file}", spin_axis="down") for run in test.runs)
    both = replace(test, runs=(*test.runs, *down))
    record = il.fit_centrifuge(both, Simulation(both, typical_truth(), 50.0, 60.0, 5.0)).calibration
    table = next(item for item in exhibits_of(record).items if item.title == "Runs")
    assert all(len(row) == len(table.columns) for row in table.rows)
    half = len(test.runs)
    assert [row[table.columns.index("spin axis")] for row in table.rows] == ["up"] * half + ["down"] * half
    page = render_record(record)
    assert '<th scope="col" class="text">file</th>' in page
    assert '<th scope="col">g</th>' in page


# --- plan --------------------------------------------------------------------------------------------------------


def plan(**change):
    options = {"levels": [G, 5 * G, 20 * G], "radius": 2.0, "net_rate": NET, "drift": 3.3 * DEG_H / G,
               "dtg_noise": 0.01 * DEG_H * 60,
               "fog_noise": 0.005 * DEG_H * 60, "uncertainty": 0.01} | change  # fmt: skip
    return plan_centrifuge(**options)


def test_the_plan_predicts_what_the_reduction_finds():
    planned = plan(duration=200.0, cycles=2)
    truth = typical_truth()
    found = il.fit_centrifuge(planned.manifest, Simulation(planned.manifest, truth, 50.0, 200.0, 5.0)).calibration
    for n, level in enumerate(planned.levels, start=1):
        parameter = found.parameters[f"x_K_{n}"]
        assert parameter.standard_uncertainty / parameter.value == pytest.approx(level.relative, rel=0.2)
        if n > 1:
            assert found.parameters[f"x_zeta_{n}"].standard_uncertainty == pytest.approx(level.zeta, rel=0.2)


def test_the_plan_counts_periods_as_the_source_does():
    """At 2 m radius 15 min give 500 periods only above 3.6 g; 1 g has 217 (methods)."""
    periods = {n: plan(levels=[G, n * G]).levels[1].periods for n in (3.5, 3.6, 3.7)}
    assert plan().levels[0].periods == pytest.approx(217, abs=0.5)
    assert periods[3.5] < 500 < periods[3.6]


def test_the_plan_warns_of_what_reduce_would_stumble_over():
    arm = np.radians(80.0)
    near = plan(levels=[arm**2 * 2.0, 20 * G])
    assert any("near the net rate" in w and "take a net rate of" in w for w in near.warnings)
    assert any("near half the net rate" in w for w in plan(levels=[np.radians(60.0) ** 2 * 2.0, 20 * G]).warnings)
    short = plan(uncertainty=1e-3).warnings
    assert any(w.startswith("1 g: predicted u(K) 0.68 %, wanted 0.1 %: too noisy: it takes 11.5 h") for w in short)
    assert any(
        w.startswith("1 g: predicted u(K) 0.68 %, wanted 0.4 %: run 43 min") for w in plan(uncertainty=4e-3).warnings
    )
    assert any("no duration helps" in w for w in plan(rate_uncertainty=np.radians(5.0)).warnings)
    assert not any("predicted u(K)" in w for w in plan().warnings)


def test_the_needed_duration_gives_the_wanted_uncertainty():
    level = plan(uncertainty=2e-3).levels[0]
    again = plan(uncertainty=2e-3, duration=level.needed).levels[0]
    assert again.relative == pytest.approx(2e-3, rel=1e-9)


def test_plan_writes_a_list_of_runs_too(imulab, tmp_path):
    done = imulab("centrifuge", "plan", "--levels", "1,10", "--cycles", "2", "-o", "plan.csv")
    assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader((tmp_path / "plan.csv").read_text().splitlines()))
    assert len(rows) == 6
    assert rows[1]["arm_rate [deg/s]"] == "126.8726"


@pytest.mark.parametrize(
    ("arguments", "fragment"),
    [
        (["--levels", "1,x"], "--levels '1,x': expected specific forces in g"),
        (["--levels", "0.01"], "is not above the net rate"),
        (["--net-rate", "40 m"], "--net-rate '40 m'"),
        (["--dtg-noise", "1 deg/h"], "expected a number with one of deg/sqrt(h)"),
        (["--uncertainty", "much"], "expected a fraction such as 0.01 or 1 %"),
        (["--cycles", "0"], "cycles 0"),
        (["-o", "plan.txt"], "plan.txt: expected a name that ends in .toml"),
        (["--levels", "1,1"], "the same level twice"),
        (["--rate-uncertainty", "-1 deg/s"], "rate uncertainty -0.0174533: expected 0 or more"),
        (["--radius-uncertainty", "-1 m"], "radius uncertainty -1: expected 0 or more"),
    ],
)
def test_a_plan_that_cannot_be_is_refused(arguments, fragment, imulab, tmp_path):
    done = imulab("centrifuge", "plan", *arguments)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert fragment in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "fragment"),
    [
        (["--plan", "plan.toml", "-o", "s", "--levels", "1,2"], "--levels: --plan plan.toml says that already"),
        (["--plan", "plan.toml", "-o", "s", "--both-senses"], "--both-senses: --plan plan.toml says that already"),
        (["--plan", "plan.toml", "-o", "."], "c1_static.csv: exists and is no simulation (no truth.json beside it)"),
        (["-o", "s", "--rate", "5 Hz", "--levels", "1,5"], "sample rate 5: expected 5.42 Hz or more"),
        (["-o", "plan.toml"], "plan.toml: the folder cannot be made"),
    ],
)
def test_a_simulation_that_cannot_be_or_would_destroy_is_refused(arguments, fragment, imulab, tmp_path):
    assert imulab("centrifuge", "plan", "--levels", "1,5", "-o", "plan.toml").returncode == 0
    (tmp_path / "c1_static.csv").write_text("a recording of days of work\n")
    done = imulab("centrifuge", "simulate", *arguments)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert fragment in done.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c1_static.csv", "plan.toml"]
    assert (tmp_path / "c1_static.csv").read_text() == "a recording of days of work\n"


def test_a_simulation_takes_the_place_of_an_older_one_but_not_of_its_plan(imulab, tmp_path):
    options = ["--duration", "10 s", "--static-duration", "5 s", "--rate", "20 Hz", "--levels", "1,5", "--cycles", "1"]
    for _ in range(2):
        assert imulab("centrifuge", "simulate", "-o", "s", *options).returncode == 0
    done = imulab("centrifuge", "simulate", "--plan", "s/manifest.toml", "-o", "s")
    assert done.returncode == 2
    assert "s/manifest.toml: would overwrite s/manifest.toml" in done.stderr


def test_a_plan_out_of_range_is_refused():
    with pytest.raises(OptionError, match="radius"):
        plan(radius=0.0)

"""From a folder of recordings to a corrected one, by the command line; and every refusal, one line each."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.errors import DataError
from imulab.procedures.warmup.figures import exhibits
from imulab.procedures.warmup.model import evaluate, record_table
from reference import flightlogs
from reference import warmup as reference

HOUR = np.pi / 180 / 3600
SMALL = ["--temperatures", "-20,0,20"]


@pytest.fixture(scope="module")
def chamber(tmp_path_factory):
    """A folder with six power cycles at three temperatures, and the records of two models."""
    home = tmp_path_factory.mktemp("chamber")
    assert main(["warmup", "simulate", "-o", str(home), *SMALL, "--cycles", "2", "--rate", "5", "--seed", "3"]) == 0
    files = sorted(map(str, home.glob("*.csv")))
    for model in ("interval-cubic", "auto"):
        arguments = [*SMALL, "--settling-time", "300", "--model", model, "-o", str(home / f"{model}.json")]
        assert main(["warmup", "fit", *files, *arguments, "--report", str(home / f"{model}.html")]) == 0
    return home


def refused(capsys, *arguments):
    assert main(list(map(str, arguments))) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert captured.err.startswith("imulab: ")
    return captured.err


def with_head(source, target, text):
    """Copy a recording, its power-on temperature replaced by a line (or taken away)."""
    lines = [line for line in Path(source).read_text().splitlines() if "power_on_temperature" not in line]
    Path(target).write_text("\n".join([*([text] if text else []), *lines]) + "\n")
    return target


def test_fit_prints_the_comparison_and_writes_record_and_report(chamber, capsys):
    files = sorted(map(str, chamber.glob("*.csv")))
    assert main(["warmup", "fit", *files, *SMALL, "--settling-time", "300"]) == 0
    shown = capsys.readouterr().out
    for name in ("none", "interval-cubic", "knot-cubic", "knot-log-cubic", "exponential (2)", "exponential (3)"):
        assert name in shown
    record = il.load(chamber / "auto.json")
    assert record.procedure == "warmup"
    assert record.parameters["settling_time"].value == 300
    assert len(record.sources) == 6
    assert record.sensor["serial"] == "SIM-0003"
    section = record.sections["table"]
    assert section["temperatures"] == [-20, 0, 20]
    assert section["axes"] == ["gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"]
    html = (chamber / "auto.html").read_text()
    assert "Power cycles and what the unit subtracts" in html
    assert "http://" not in re.sub(r"<script>.*?</script>", "", html, flags=re.S)


@pytest.mark.parametrize("model", ["interval-cubic", "auto"])
def test_apply_subtracts_the_curve_and_nothing_else(chamber, model, capsys):
    file = chamber / "cycle_+0_1.csv"
    out = chamber / "out.csv"
    assert main(["apply", str(chamber / f"{model}.json"), str(file), "-o", str(out)]) == 0
    before, after = il.read(file), il.read(out)
    section = il.load(chamber / f"{model}.json").sections["table"]
    temperature = float(before.metadata["power_on_temperature"])
    assert after.units == before.units
    assert after.metadata == before.metadata
    time = before.column("time")
    for i, (axis, factor) in enumerate(
        (("gyro_x", 1 / HOUR), ("gyro_y", 1 / HOUR), ("gyro_z", 1 / HOUR), ("accel_x", 1))
    ):
        for k in (0, 13, 700, 1499, 1500, 2999):
            z = reference.z_at(section, i, time[k], temperature) * factor
            assert after.column(axis)[k] == pytest.approx(before.column(axis)[k] - z, rel=1e-12, abs=1e-12)
    np.testing.assert_array_equal(after.column("temperature"), before.column("temperature"))
    np.testing.assert_array_equal(after.column("accel_z")[1500:], before.column("accel_z")[1500:])
    assert capsys.readouterr().err.startswith("imulab: note: 3000 rows of ")


@pytest.mark.parametrize(
    "line",
    [None, "# power_on_temperature: nan", "# power_on_temperature: 21.01", "# power_on_temperature: -21.01 degC"],
)
def test_outside_the_table_nothing_is_written_and_one_line_says_why(chamber, tmp_path, line, capsys):
    file = with_head(chamber / "cycle_+0_1.csv", tmp_path / "r.csv", line)
    assert "temperature" in refused(capsys, "apply", chamber / "auto.json", file, "-o", tmp_path / "out.csv")
    assert not (tmp_path / "out.csv").exists()
    with pytest.raises(DataError, match=r"temperature.*nothing corrected"):
        il.apply(il.load(chamber / "auto.json"), file)


def test_apply_warns_where_the_ordinary_compensation_does_not_come_first(chamber, tmp_path, capsys):
    recording = il.simulate_tumble(order=1, gravity=9.81, attitudes=12, hold=2.0)
    fit = il.fit_tumble(recording, order=1, gravity=9.81)
    il.fit_gyro(fit.calibration, recording).save(tmp_path / "t.json")
    (file, *_) = sorted(chamber.glob("cycle*.csv"))
    orders = [("t.json", "w.json"), ("w.json", "t.json")]
    (tmp_path / "w.json").write_bytes((chamber / "auto.json").read_bytes())
    warned = []
    for names in orders:
        assert main(["apply", *(str(tmp_path / name) for name in names), str(file), "-o", str(tmp_path / "o.csv")]) == 0
        warned.append("a warm-up record before that of the ordinary compensation" in capsys.readouterr().err)
    assert warned == [False, True]


def test_the_plan_names_the_fixture_and_its_axes(capsys, tmp_path):
    assert main(["warmup", "plan", "-o", str(tmp_path / "plan.csv")]) == 0
    where = "x, y and z of the unit point east, up and south"
    assert where in capsys.readouterr().out
    assert where in il.read(tmp_path / "plan.csv").metadata["fixture"]


def test_apply_converts_units_and_keeps_nan_where_it_is(chamber, tmp_path):
    recording = il.read(chamber / "cycle_+0_1.csv")
    degrees = recording.column("gyro_x") / 3600
    degrees[5] = np.nan
    other = il.Recording(
        {**recording.columns, "gyro_x": degrees}, {**recording.units, "gyro_x": "deg/s"}, recording.metadata
    )
    record = il.load(chamber / "auto.json")
    found = il.apply(record, other).column("gyro_x")
    want = il.apply(record, recording).column("gyro_x") / 3600
    assert np.isnan(found[5])
    assert np.isnan(found).sum() == 1
    np.testing.assert_allclose(np.delete(found, 5), np.delete(want, 5), rtol=1e-9, atol=1e-12)


def test_apply_refuses_what_it_cannot_correct(chamber, tmp_path, capsys):
    record = chamber / "auto.json"
    recording = il.read(chamber / "cycle_+0_1.csv")
    columns = dict(recording.columns)

    def write(name, columns, units):
        il.write_csv(il.Recording(columns, units, recording.metadata), tmp_path / name)
        return tmp_path / name

    counts = write("counts.csv", columns, {**recording.units, "gyro_y": "count"})
    assert "column gyro_y is in count, but the record corrects rad/s" in refused(
        capsys, "apply", record, counts, "-o", tmp_path / "o.csv"
    )
    untimed = write("untimed.csv", {k: v for k, v in columns.items() if k != "time"}, recording.units)
    assert "no column time" in refused(capsys, "apply", record, untimed)
    none = write("none.csv", {"time": columns["time"], "mag_x": columns["gyro_x"]}, {"time": "s", "mag_x": "uT"})
    assert "no column gyro_x" in refused(capsys, "apply", record, none)
    bad = with_head(chamber / "cycle_+0_1.csv", tmp_path / "bad.csv", "# power_on_temperature: warm")
    assert "expected a temperature" in refused(capsys, "apply", record, bad, "-o", tmp_path / "o.csv")
    assert not (tmp_path / "o.csv").exists()


@pytest.mark.parametrize("model", ["interval-cubic", "knot-cubic", "knot-log-cubic", "exponential"])
def test_the_table_goes_through_a_spreadsheet_to_the_last_bit(chamber, tmp_path, model, capsys):
    files = sorted(map(str, chamber.glob("cycle*.csv")))
    rec, table, again = tmp_path / "a.json", tmp_path / "t.csv", tmp_path / "b.json"
    options = [*SMALL, "--settling-time", "300", "--model", model, "--exit", "taper", "--taper-time", "45 s"]
    assert main(["warmup", "fit", *files, *options, "-o", str(rec)]) == 0
    assert main(["warmup", "table", str(rec), "-o", str(table)]) == 0
    assert main(["warmup", "table", str(table), "-o", str(again)]) == 0
    assert il.load(again).sections["table"] == il.load(rec).sections["table"]
    assert il.load(again).sensor["serial"] == "SIM-0003"
    for command in (["show", str(again)], ["report", str(again), "-o", str(tmp_path / "r.html")]):
        assert main(command) == 0
    # A row edited in deg/h is the same row.
    lines = table.read_text().splitlines()
    row = next(i for i, line in enumerate(lines) if "gyro_x,rad/s" in line)
    head, values = lines[row].split(",rad/s,")
    lines[row] = ",".join([head, "deg/h", *(repr(float(v) / HOUR) for v in values.split(","))])
    table.write_text("\n".join(lines) + "\n")
    assert main(["warmup", "table", str(table), "-o", str(again)]) == 0
    time = np.linspace(0, 400, 50)
    want = evaluate(record_table(il.load(rec)), time, -20.0)
    np.testing.assert_allclose(evaluate(record_table(il.load(again)), time, -20.0), want, rtol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("model: interval-cubic", "model: cubic", "'# model: cubic': expected one of interval-cubic"),
        ("settling_time: 300.0 s", "settling_time: five minutes", "settling_time"),
        ("exit: zero", "exit: later", "known rules: zero hold taper"),
        ("gyro_x,rad/s", "gyro_x,mph", "line 8: unknown unit 'mph'"),
        ("gyro_x,rad/s", "gyro_y,rad/s", "line 9: gyro_y at -20 to 0 degC appears twice"),
        ("-20.0,0.0,gyro_x", "-20.0,-1.0,gyro_x", "no row for gyro_y"),
        ("rad/s,", "rad/s,x", "line 8: expected a number, found 'x"),
        ("-20.0,0.0,gyro_x,", "-20.0,0.0,gyro_x,,", "line 8: expected 8 fields, found 9"),
        ("unit,c0,c1,c2,c3", "unit,c3,c2,c1,c0", "line 7: expected the titles from [degC],to [degC],axis,unit,c0,c1"),
    ],
)
def test_a_damaged_spreadsheet_is_refused(chamber, tmp_path, old, new, words, capsys):
    assert main(["warmup", "table", str(chamber / "interval-cubic.json"), "-o", str(tmp_path / "t.csv")]) == 0
    capsys.readouterr()
    text = (tmp_path / "t.csv").read_text()
    assert old in text
    (tmp_path / "t.csv").write_text(text.replace(old, new, 1))
    assert words in refused(capsys, "warmup", "table", tmp_path / "t.csv", "-o", tmp_path / "t.json")
    assert not (tmp_path / "t.json").exists()


def test_a_spreadsheet_of_four_time_constants_is_refused_since_no_unit_holds_it(tmp_path, capsys):
    lines = ["# model: exponential", "# settling_time: 300 s", "# time_constants: 10 20 40 80 s"]
    lines += ["temperature [degC],axis,unit,A1,A2,A3,A4"]
    lines += [f"{t},gyro_x,deg/h,1,2,3,4" for t in (0, 20)]
    (tmp_path / "t.csv").write_text("\n".join(lines) + "\n")
    message = refused(capsys, "warmup", "table", tmp_path / "t.csv", "-o", tmp_path / "t.json")
    assert "time_constants 10 20 40 80; expected one to 3" in message
    assert not (tmp_path / "t.json").exists()


def test_table_refuses_a_blob_with_the_reason(chamber, tmp_path, capsys):
    assert main(["export", "--to", "blob", str(chamber / "auto.json"), "-o", str(tmp_path)]) == 0
    capsys.readouterr()
    for name in ("t.csv", "t.json"):
        message = refused(capsys, "warmup", "table", tmp_path / "unit.blob", "-o", tmp_path / name)
        assert "unit.blob: a blob, which holds a unit's numbers without uncertainties" in message


def test_a_window_chooses_the_part_of_each_file(chamber, tmp_path):
    files = sorted(map(str, chamber.glob("cycle*.csv")))
    options = [*SMALL, "--settling-time", "300", "--model", "knot-cubic"]
    assert main(["warmup", "fit", *files, *options, "--window", ":400", "-o", str(tmp_path / "w.json")]) == 0
    windowed = il.load(tmp_path / "w.json")
    assert {round(cycle["end"]) for cycle in windowed.data["cycles"]} <= {400, 401}
    recordings = [il.read(file, window=(None, 400.0)) for file in files]
    same = il.fit_warmup(recordings, temperatures=[-20, 0, 20], settling_time=300, model="knot-cubic")
    np.testing.assert_allclose(windowed.sections["table"]["coefficients"], same.table.coefficients, rtol=1e-9)


def test_plan_writes_the_programme_and_says_what_is_missing(tmp_path, capsys):
    assert main(["warmup", "plan", "--cycles", "3", "-o", str(tmp_path / "p.csv")]) == 0
    captured = capsys.readouterr()
    assert "24 power cycles" in captured.out
    assert "--temperatures -40,-30,-20,-10,0,20,40,50,60" in captured.out
    assert "the interval 0 to 40 degC is 40 K wide" in captured.err
    rows = il.read(tmp_path / "p.csv")
    assert rows.column("power").sum() == 24
    recorded = rows.column("power") == 1
    np.testing.assert_array_equal(np.unique(rows.column("set_point")[recorded]), [-40, -30, -20, -10, 0, 40, 50, 60])
    ends = rows.column("start") + rows.column("duration")
    np.testing.assert_allclose(ends[:-1], rows.column("start")[1:])
    # 24 soaks of 60 min and recordings of 10 min; 63 + 100 + 37 K at 2 K/min.
    assert ends[-1] == pytest.approx(24 * 70 + 200 / 2)
    assert "29:40 h" in captured.out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["plan", "--temperatures", "0"], "two or more"),
        (["plan", "--temperatures", "a,b"], "expected numbers such as -40,-30,0"),
        (["plan", "--cycles", "0"], "cycles 0"),
        (["plan", "--soak", "10 m"], "--soak"),
        (["plan", "--ramp", "fast"], "--ramp 'fast': expected a number"),
        (["simulate", "-o", "d", "--law", "straight"], "expected one of smooth bent"),
        (["simulate", "-o", "d", "--cycles", "0"], "--cycles 0"),
        (["simulate", "-o", "d", "--duration", "5 s"], "duration 5"),
        (["fit"], "Missing argument"),
        (["fit", "nowhere.csv"], "nowhere.csv: no such file"),
        (["fit", "nowhere.csv", "--settling-time", "5 m"], "--settling-time"),
        (["fit", "nowhere.csv", "-o", "no/such/r.json"], "no such folder"),
        (
            ["fit", "nowhere.csv", "--axes", "gyro_x,gyro_x"],
            "--axes 'gyro_x,gyro_x': expected names of columns, each once",
        ),
        (["fit", "nowhere.csv", "--axes", ""], "--axes ''"),
        (["fit", "nowhere.csv", "--instance", "first"], "--instance"),
        (["fit", "nowhere.csv", "--window", "10"], "--window '10': expected FROM:TO"),
        (["table", "nowhere.json", "-o", "t.csv"], "nowhere.json: no such file"),
    ],
)
def test_usage_errors_are_one_line(tmp_path, monkeypatch, arguments, words, capsys):
    monkeypatch.chdir(tmp_path)
    assert words in refused(capsys, "warmup", *arguments)
    assert not list(tmp_path.iterdir())


def test_bad_files_are_named_with_their_row(chamber, tmp_path, capsys):
    files = sorted(chamber.glob("cycle*.csv"))
    fit = ["warmup", "fit", *SMALL, "--settling-time", "300", "-o", tmp_path / "r.json"]
    good = files[1:]

    def changed(name, function):
        text = files[0].read_text().splitlines()
        (tmp_path / name).write_text("\n".join(function(text)) + "\n")
        return tmp_path / name

    def edit(row, column, value):
        def function(lines):
            first = next(i for i, line in enumerate(lines) if not line.startswith("#")) + 1
            cells = lines[first + row - 1].split(",")
            cells[column] = value
            lines[first + row - 1] = ",".join(cells)
            return lines

        return function

    cases = [
        (lambda x: [line for line in x if "power_on" not in line], "no power_on_temperature in the head of the file"),
        (edit(50, 2, "nan"), "row 50 (line 56), column gyro_y: expected a finite number, found nan"),
        (edit(3, 0, "0.2"), "row 3 (line 9), column time: time stands still"),
        (lambda x: [*x[:6], *x[40:]], "row 1 (line 7), column time: the first sample is 6.8 s after power-on"),
        (lambda x: [line.replace("[deg/h]", "[deg/s]") for line in x], "all files must share one unit"),
        (
            lambda x: [line.replace("gyro_x [deg/h]", "gyro_x [rad/s]") for line in x],
            "must share one unit, found gyro_x",
        ),
        (lambda x: [line.replace("e: ", "e: 1") if "power_on" in line else line for line in x], "fits no calibration"),
    ]
    for number, (function, words) in enumerate(cases):
        name = changed(f"bad{number}.csv", function)
        message = refused(capsys, *fit, *good, name)
        assert words in message
        assert "bad" in message
    assert "given twice" in refused(capsys, *fit, *files, files[0])
    only = [file for file in files if "+20" not in file.name]
    assert "no power cycle at 20 degC" in refused(capsys, *fit, *only)
    assert not (tmp_path / "r.json").exists()
    late = changed("late.csv", lambda x: [*x[:6], *x[40:]])
    assert main(list(map(str, [*fit, *good, late, "--latest-start", "10 s"]))) == 0


def test_other_procedures_records_have_no_table_and_other_commands_know_this_one(chamber, tmp_path, capsys):
    record = chamber / "auto.json"
    assert main(["show", str(record)]) == 0
    assert "Models compared" in capsys.readouterr().out
    assert main(["report", str(record), "-o", str(tmp_path / "r.html")]) == 0
    damaged = json.loads(record.read_text())
    damaged["table"]["settling_time"] = 0
    from imulab.records.calibration import content_sha256

    damaged["content_sha256"] = content_sha256(damaged)
    (tmp_path / "d.json").write_text(json.dumps(damaged))
    capsys.readouterr()
    file = chamber / "cycle_+0_1.csv"
    said = "d.json: table.settling_time: expected a number above 0, found 0"
    assert said in refused(capsys, "apply", tmp_path / "d.json", file, "-o", tmp_path / "o.csv")


def test_fit_of_several_units_says_how_they_differ(tmp_path, capsys):
    simulate = ["warmup", "simulate", "-o", str(tmp_path), "--temperatures", "0,20", "--cycles", "2", "--rate", "2"]
    assert main([*simulate, "--units", "3"]) == 0
    files = sorted(map(str, tmp_path.glob("*.csv")))
    options = ["--temperatures", "0,20", "--settling-time", "300", "--model", "knot-log-cubic"]
    assert main(["warmup", "fit", *files, *options, "--pool", "type", "-o", str(tmp_path / "type.json")]) == 0
    shown = capsys.readouterr().out
    assert "Spread between 3 units" in shown
    assert "unit left out" in shown
    assert "unit_spread_gyro_x" in il.load(tmp_path / "type.json").parameters


def test_what_is_lost_in_the_noise_is_said_and_not_printed_as_zero(chamber):
    """A floor of 0 is no floor, and a spread of units within twice its uncertainty asks for no table each."""
    record = il.load(chamber / "auto.json")
    found = dict(record.fit["repeatability"])
    found |= {"cycle": [0.0] * 6, "standard_uncertainty": [1 * HOUR] * 6, "unit": [0.0, 1.9 * HOUR, 2.1 * HOUR] * 2}
    shown = exhibits(replace(record, fit=record.fit | {"repeatability": found}))
    assert "power cycles repeat to in noise" not in shown.headline
    assert "of cycles, in noise." in shown.items[0].caption
    spread = next(item for item in shown.items if item.title.startswith("Spread between"))
    assert [row[1:4] for row in spread.rows[:3]] == [
        ["in noise", "in noise", "one per type"],
        ["1.9", "in noise", "one per type"],
        ["2.1", "in noise", "each unit"],
    ]


def test_flight_logs_are_fitted_by_topic_instance_and_first_temperature(tmp_path, capsys):
    """Three minutes on the pad, then flight: 3 s after boot, two accelerometers, the second with twice the curve."""
    rng = np.random.default_rng(12)
    formats = {
        "sensor_accel": "uint64_t timestamp;uint64_t timestamp_sample;uint32_t device_id;"
        "float x;float y;float z;float temperature;"
    }
    files = []
    for at in (0, 20):
        for cycle in (1, 2):
            time = np.arange(3.0, 900.0, 0.1)
            flying = np.where(time > 240, rng.standard_normal(len(time)) * 3, 0.0)
            data = []
            for i, t in enumerate(time):
                micro = round(1e6 * t)
                for instance in (0, 1):
                    x = (1 + instance) * 0.02 * np.exp(-t / 50) + flying[i] + 1e-4 * rng.standard_normal()
                    row = (micro, micro, 1, x, 0.001 * rng.standard_normal(), 9.8, at + 0.01 * t)
                    data.append((3 + instance, row))
            log = flightlogs.ulog(formats, [(0, 3, "sensor_accel"), (1, 4, "sensor_accel")], data)
            files.append(tmp_path / f"log_{at}_{cycle}.ulg")
            files[-1].write_bytes(log)
    fit = ["warmup", "fit", *files, "--temperatures", "0,20", "--settling-time", "200", "--model", "exponential"]
    assert "no power_on_temperature" in refused(capsys, *fit)
    fit += ["--temperature-column"]
    assert "instance 7" in refused(capsys, *fit, "--instance", "7")
    for instance in ("0", "1"):
        out = tmp_path / f"{instance}.json"
        assert main(list(map(str, [*fit, "--instance", instance, "--axes", "accel_x", "-o", out]))) == 0
        assert "the unit moved; those seconds are left out" in capsys.readouterr().err
        settled = np.exp(-np.arange(200.0, 239.0, 0.1) / 50).mean()  # the reference ends with the take-off
        at = np.array([3.0, 30.0, 100.0])
        want = (1 + int(instance)) * 0.02 * (np.exp(-at / 50) - settled)
        np.testing.assert_allclose(evaluate(record_table(il.load(out)), at, 10.0)[0], want, atol=2e-5)

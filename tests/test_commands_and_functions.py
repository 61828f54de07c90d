"""Every command has its function, whose options it has, and gives the same result bit for bit."""

import inspect
import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.cli.app import commands
from imulab.estimation.noise_coefficients import coefficients_dict
from imulab.records.calibration import json_text

FUNCTIONS = {
    "apply": il.apply,
    "show": il.compare_records,  # of two records; of one file: il.load or il.read, which show themselves
    "report": il.write_report,
    "convert": il.write,
    "export": il.export,
    "layout guess": il.guess_layout,
    "certificate": il.write_certificate,
    "allan": il.allan_deviation,
    "tumble plan": il.plan_tumble,
    "tumble simulate": il.simulate_tumble,
    "tumble fit": il.fit_tumble,
    "tumble gyro": il.fit_gyro,
    "tumble mag": il.fit_mag,
    "tumble check": il.check_tumble,
    "array plan": il.plan_imus,
    "array simulate": il.simulate_array,
    "array simulate --imus": il.simulate_imus,
    "array merge": il.merge_array,
    "array calibrate": il.calibrate_array,
    "array calibrate --imus": il.calibrate_imus,
    "array fuse": il.fuse,
    "array fuse --imus": il.fuse_imus,
    "array compare": il.compare_methods,
    "array compare --imus": il.compare_imus,
    "centrifuge plan": il.plan_centrifuge,
    "centrifuge simulate": il.simulate_centrifuge,
    "centrifuge reduce": il.fit_centrifuge,
    "warmup plan": il.plan_warmup,
    "warmup simulate": il.simulate_warmup,
    "warmup fit": il.fit_warmup,
    "warmup table": il.warmup_table,
    "noise fit": il.fit_noise,
    "noise plan": il.plan_noise,
    "noise check": il.check_noise,
    "noise simulate": il.simulate_noise,
    "thermal plan": il.plan_thermal,
    "thermal ramp": il.plan_ramp,
    "thermal simulate": il.simulate_thermal,
    "thermal fit": il.fit_thermal,
    "thermal check": il.check_thermal,
    "rate plan": il.plan_rate,
    "rate simulate": il.simulate_rate,
    "rate fit": il.fit_rate,
    "rate turn": il.fit_turns,
    "magnetometer plan": il.plan_magnetometer,
    "magnetometer simulate": il.simulate_magnetometer,
    "magnetometer fit": il.fit_magnetometer,
    "magnetometer check": il.check_magnetometer,
    "fleet run": il.run_fleet,
    "fleet status": il.fleet_status,
    "fleet report": il.write_fleet_report,
    "fleet certificate": il.write_fleet_certificates,
    "fleet simulate": il.simulate_fleet,
}
WITHOUT = {"demo", "live", "open"}
"""One runs other commands, the others are a person's session at a terminal or in a browser."""
COMMANDS = {command.path: command for command in commands()}
G = 9.80665
DEGREE = np.pi / 180


def test_every_command_has_a_function():
    assert {*FUNCTIONS} | WITHOUT == {*COMMANDS}


@pytest.mark.slow
def test_what_a_program_wants_of_a_noise_fit_is_as_on_the_command_line(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    ran("noise", "fit", "log1.csv", "--for", "px4", "--rate", "100", "--step", "8 ms")
    said = dict(line.split(": ") for line in capsys.readouterr().out.splitlines() if line.startswith("EKF2"))
    found = il.fit_noise("log1.csv").wants("px4", rate=100.0, step="8 ms")
    assert said == {key: f"{value:.4g}" for key, value in found.items()}


def test_the_unit_of_a_bare_number_is_that_of_the_help():
    """Every call ``in_si(value, "option", kind, unit)`` of a function, against what its signature says."""
    seen, wrong = 0, []
    for path, function in FUNCTIONS.items():
        units = {option.keyword: option.reads.unit for option in COMMANDS[path].options}
        read = re.findall(r'in_si\(\w+, "(\w+)", "\w+", "([^"]+)"\)', inspect.getsource(function))
        for name, unit in read:
            if name in units and unit != "1":
                seen += 1
                if units[name] != unit:
                    wrong.append((path, name, unit, units[name]))
    assert wrong == []
    assert seen > 20


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Files that several commands read."""
    place = tmp_path_factory.mktemp("commands")
    il.write_csv(il.simulate_tumble(attitudes=12, order=1, hold="2 s"), place / "tumble.csv")
    for seed in (1, 2):
        fit = il.fit_tumble(il.simulate_tumble(attitudes=12, order=1, hold="2 s", seed=seed), order=1, gravity=G)
        fit.save(place / f"unit{seed}.json")
    still = il.simulate_array(experiment="static", duration=30.0)
    il.calibrate_array(still).save(place / "array.json")
    cycles = il.simulate_warmup([-40, 0, 60], cycles=2, duration="400 s", rate="2 Hz")
    for number, cycle in enumerate(cycles):
        head = {key: text for key, text in cycle.metadata.items() if key != "power_on_temperature"}
        il.write(replace(cycle, metadata=head), place / f"cycle{number}.csv")
    il.fit_warmup(cycles, temperatures=(-40, 0, 60), model="knot-cubic").save(place / "warm.json")
    il.plan_centrifuge("1,10", cycles=1).save(place / "plan.toml")
    il.write(il.simulate_tumble(attitudes=14, order=1, hold="2 s", field="48 uT"), place / "mag.csv")
    il.write(still, place / "still.csv")
    il.write(il.simulate_array(session=1, duration=60.0), place / "board.csv")
    log = {"white": "0.3 deg/sqrt(h)", "walk": "30 deg/h/sqrt(h)", "duration": "5 min", "columns": ["gyro_z"]}
    for seed in (1, 2):
        il.write(il.simulate_noise(**log, seed=seed), place / f"log{seed}.csv")
    il.fit_noise(place / "log1.csv").save(place / "noise.json")
    il.simulate_centrifuge(levels="1,10,20", cycles=1, duration=60, static_duration=30).save(place / "rig")
    return place


def ran(*words, status=0):
    assert main([str(word) for word in words], project=False) == status


def same(one, other):
    """Whether two files, or all files of two folders, are the same bit for bit, but for when they were made."""
    if one.is_dir():
        names = sorted(path.relative_to(one) for path in one.rglob("*") if path.is_file())
        assert names == sorted(path.relative_to(other) for path in other.rglob("*") if path.is_file()) != []
        return all(same(one / name, other / name) for name in names)
    texts = [path.read_bytes() for path in (one, other)]
    if one.suffix == ".json" and b"content_sha256" in texts[0]:
        contents = [json.loads(text) for text in texts]
        for content in contents:
            del content["created"], content["content_sha256"]
        return contents[0] == contents[1]
    return texts[0] == texts[1]


CYCLES = [f"cycle{number}.csv" for number in range(6)]
MADE = {
    "tumble plan": (
        ["--attitudes", "12", "--noise", "20ug", "--order", "1", "--add", "tumble.csv", "-o", "one.csv"],
        lambda out: il.plan_tumble(12, noise="20ug", order=1, add="tumble.csv").save(out),
    ),
    "tumble plan of a record's noise": (
        ["--attitudes", "14", "--order", "1", "--noise", "unit1.json", "--from", "fixture:45", "--report", "one.html"],
        lambda out: il.plan_tumble(14, order=1, noise="unit1.json", from_="fixture:45").report(out),
    ),
    "tumble simulate": (
        ["--attitudes", "6", "--noise", "1 mg", "--hold", "1 s", "--unit", "g", "-o", "one.csv"],
        lambda out: il.write(il.simulate_tumble(attitudes=6, noise=1e-3 * G, hold=1, unit="g"), out),
    ),
    "array simulate": (
        ["--duration", "10 s", "--elements", "3", "--fault", "stuck:2:3:4", "--walk", "0", "-o", "one.csv"],
        lambda out: il.write(il.simulate_array(duration=10, elements=3, fault=["stuck:2:3:4"], walk=0.0), out),
    ),
    "array merge": (
        ["tumble.csv", "tumble2.csv", "--axis", "x", "-o", "one.csv"],
        lambda out: il.write(il.merge_array(["tumble.csv", "tumble2.csv"], axis="x").recording, out),
    ),
    "centrifuge plan": (
        ["--levels", "1,10", "--both-senses", "-o", "one.toml"],
        lambda out: il.plan_centrifuge([G, 10 * G], both_senses=True).save(out),
    ),
    "centrifuge simulate": (
        ["--plan", "plan.toml", "--duration", "20 s", "--static-duration", "10 s", "--tilt", "0", "-o", "one"],
        lambda out: il.simulate_centrifuge("plan.toml", duration=20, static_duration=10, tilt=0.0).save(out),
    ),
    "warmup plan": (
        ["--temperatures", "-40,0,60", "--soak", "30 min", "-o", "one.csv"],
        lambda out: il.plan_warmup([-40, 0, 60], soak=1800).save(out),
    ),
    "warmup simulate": (
        ["--temperatures", "-40,60", "--cycles", "1", "--units", "2", "--rate", "1", "-o", "one"],
        lambda out: il.simulate_warmup([-40, 60], cycles=1, units=2, rate=1.0).save(out),
    ),
    "noise plan": (
        ["--white", "0.3 deg/sqrt(h)", "--walk", "1e-6", "--for", "walk=20%", "--rate", "50", "-o", "one.csv"],
        lambda out: il.plan_noise(white=DEGREE * 0.3 / 60, walk=1e-6, for_={"walk": 0.2}, rate=50.0).save(out),
    ),
    "rate plan": (
        [
            "--rates",
            "0,90,300",
            "--noise",
            "noise.json",
            "--of",
            "reading",
            "--uncertainty",
            "50ppm",
            "-o",
            "one.toml",
        ],
        lambda out: il.plan_rate("0,90,300", noise="noise.json", of="reading", uncertainty=5e-5).save(out),
    ),
    "noise simulate": (
        [
            "--white",
            "0.3 deg/sqrt(h)",
            "--gm",
            "20 deg/h:60 s",
            "--duration",
            "100 s",
            "--columns",
            "gyro_z",
            "-o",
            "one.csv",
        ],
        lambda out: il.write(
            il.simulate_noise(white=DEGREE * 0.3 / 60, gm=("20 deg/h", 60), duration=100, columns=["gyro_z"]), out
        ),
    ),
    "thermal plan": (
        [
            "--temperatures=0,50",
            "--time",
            "5 h",
            "--noise",
            "40ug",
            "--degrees",
            "2,1,0",
            "--from",
            "head:30",
            "-o",
            "one.csv",
        ],
        lambda out: il.plan_thermal([0, 50], time=18000.0, noise="40ug", degrees=(2, 1, 0), from_="head:30").save(out),
    ),
    "thermal simulate": (
        ["--temperatures", "-20,60", "--attitudes", "3", "--ramps", "1", "--duration", "2 min", "-o", "one"],
        lambda out: il.simulate_thermal([-20, 60], attitudes=3, ramps=1, duration=120.0).save(out),
    ),
    "rate simulate": (
        ["--rates", "50,100", "--faces", "+z", "--hold", "2 s", "--noise", "0.01", "--loop", "10 ppm", "-o", "one"],
        lambda out: il.simulate_rate(
            [50 * DEGREE, 100 * DEGREE], faces="+z", hold=2, noise=0.01 * DEGREE, loop=1e-5
        ).save(out),
    ),
    "magnetometer simulate": (
        ["--turn", "level", "--duration", "20 s", "--noise", "0.2uT", "-o", "one.csv"],
        lambda out: il.write(il.simulate_magnetometer(turn="level", duration=20.0, noise="0.2 uT"), out),
    ),
    "warmup table": (
        ["warm.json", "--per-second", "-o", "one.csv"],
        lambda out: il.warmup_table("warm.json", per_second=True).save(out),
    ),
    "fleet simulate": (
        ["--units", "8", "--seed", "3", "-o", "one"],
        lambda out: il.simulate_fleet(out, units=8, seed=3),
    ),
    "export": (
        ["--to", "kalibr", "unit1.json", "--lossy", "-o", "one"],
        lambda out: il.export("kalibr", "unit1.json", out, lossy=True),
    ),
    "export of an array": (
        ["--to", "c", "array.json", "--method", "mean", "-o", "one"],
        lambda out: il.export("c", ["array.json"], out, method="mean"),
    ),
    "tumble fit of a place": (
        ["tumble.csv", "--order", "1", "--latitude", "47.4", "--height", "400", "-o", "one.json"],
        lambda out: il.fit_tumble("tumble.csv", order=1, latitude="47.4 deg", height="400 m").save(out),
    ),
    "tumble gyro": (
        ["tumble.csv", "--accel", "unit1.json", "--g-sensitivity", "no", "--clock", "20 ppm", "-o", "one.json"],
        lambda out: il.fit_gyro("unit1.json", "tumble.csv", g_sensitivity="no", clock="20 ppm").save(out),
    ),
    "tumble gyro of two files": (
        ["tumble.csv", "--accel", "unit1.json", "--accel-file", "tumble.csv", "--fit-bias", "-o", "one.json"],
        lambda out: il.fit_gyro("unit1.json", "tumble.csv", accel_data="tumble.csv", fit_bias=True).save(out),
    ),
    "tumble mag": (
        ["mag.csv", "--accel", "unit1.json", "--field", "48", "--order", "1", "--drop", "3", "-o", "one.json"],
        lambda out: il.fit_mag("mag.csv", accel="unit1.json", field="48 uT", order=1, drop=[3]).save(out),
    ),
    "array calibrate": (
        [
            "still.csv",
            "--moving",
            "board.csv",
            "--averaging",
            "2",
            "--method",
            "mean",
            "--window",
            ":25",
            "-o",
            "one.json",
        ],
        lambda out: il.calibrate_array(
            "still.csv", "board.csv", averaging=2.0, method="mean", window=(None, 25.0)
        ).save(out),
    ),
    "array fuse": (
        ["board.csv", "--calibration", "array.json", "--memory", "0.01", "--still", "0:5", "-o", "one.csv"],
        lambda out: il.write(
            il.fuse("board.csv", calibration="array.json", memory=0.01, still=(0.0, 5.0)).recording(), out
        ),
    ),
    "array compare": (
        ["board.csv", "--calibration", "array.json", "--memory", "growing:9", "-o", "one.json"],
        lambda out: il.compare_methods("board.csv", calibration="array.json", memory="growing:9").record.save(out),
    ),
    "centrifuge reduce": (
        ["rig/manifest.toml", "-o", "one.json"],
        lambda out: il.fit_centrifuge("rig/manifest.toml").save(out),
    ),
    "noise fit": (
        ["log1.csv", "log2.csv", "--terms", "NK", "--horizon", "5 s", "--steps", "remove", "-o", "one.json"],
        lambda out: il.fit_noise(["log1.csv", "log2.csv"], terms="NK", horizon=5.0, steps="remove").save(out),
    ),
    "warmup fit": (
        [
            *CYCLES,
            "--temperatures",
            "-40,0,60",
            "--model",
            "knot-cubic",
            "--settling-limit",
            "9 %",
            "--exit",
            "hold",
            "--temperature-column",
            "--tolerance",
            "5",
            "-o",
            "one.json",
        ],
        lambda out: il.fit_warmup(
            CYCLES,
            temperatures=(-40, 0, 60),
            model="knot-cubic",
            settling_limit="9 %",
            exit="hold",
            temperature_column=True,
            tolerance=5.0,
        ).save(out),
    ),
    "report": (["unit1.json", "-o", "one.html"], lambda out: il.write_report("unit1.json", out)),
    "convert": (["tumble.csv", "-o", "one.csv"], lambda out: il.write(il.read("tumble.csv"), out)),
    "apply": (
        ["unit1.json", "tumble.csv", "-o", "one.csv"],
        lambda out: il.write(il.apply("unit1.json", "tumble.csv"), out),
    ),
    "apply of a warm-up table": (
        ["warm.json", "cycle0.csv", "--temperature-column", "--latest-start", "9 s", "-o", "one.csv"],
        lambda out: il.write(il.apply("warm.json", "cycle0.csv", temperature_column=True, latest_start=9.0), out),
    ),
    "tumble fit": (
        ["tumble.csv", "--order", "1", "--loss", "square", "-o", "one.json"],
        lambda out: il.fit_tumble("tumble.csv", order=1, loss="square").save(out),
    ),
}


@pytest.mark.parametrize("row", MADE)
def test_a_command_and_its_function_give_the_same(row, folder, tmp_path, monkeypatch, capsys):
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    il.write_csv(il.simulate_tumble(attitudes=12, order=1, hold="2 s", seed=2), tmp_path / "tumble2.csv")
    monkeypatch.chdir(tmp_path)
    words, function = MADE[row]
    ran(*row.partition(" of ")[0].split(), *words)
    (out,) = (tmp_path / word for word in words if word.startswith("one"))
    other = out.with_name("other" + out.suffix)
    function(other)
    assert same(out, other)


def test_the_other_options_of_a_tumble_fit_are_read_as_on_the_command_line(folder):
    data = il.find_attitudes(folder / "tumble.csv")
    rest = (5e-6, 2e-6 * G, np.radians(3 / 3600))
    for given, meant in (
        (
            {"order": "1", "method": "linearised", "threshold": "5ppm,2ug,3arcsec"},
            {"order": 1, "method": "linearised", "threshold": rest},
        ),
        ({"nonlinearity": "20ug,20ug"}, {"nonlinearity": (20e-6, 20e-6)}),
        ({"order": "1", "monte_carlo": "1000"}, {"order": 1, "monte_carlo": 1000}),
        (
            {"prior": folder / "unit1.json", "ageing": "100ug,50ppm", "loss": "square"},
            {"prior": il.load(folder / "unit1.json"), "ageing": (1e-4 * G, 5e-5), "loss": "square"},
        ),
    ):
        one, other = (il.fit_tumble(data, gravity=G, **options).calibration for options in (given, meant))
        for name, parameter in one.parameters.items():
            assert parameter.value == pytest.approx(other.value(name), rel=1e-12)


def test_records_are_compared_as_on_the_command_line(folder, capsys):
    first, second = folder / "unit1.json", folder / "unit2.json"
    ran("show", first, second, "--json")
    said = json.loads(capsys.readouterr().out)
    found = il.compare_records(first, second)
    assert said["probability"] == found.probability
    assert [change["difference"] for change in said["changes"]] == [change.difference for change in found.changes]


def test_a_record_is_checked_as_on_the_command_line(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    ran("tumble", "check", "unit1.json", "tumble.csv", "--limit", "5 mg", "--json")
    said = json.loads(capsys.readouterr().out)
    found = il.check_tumble("unit1.json", "tumble.csv", limit="5 mg")
    assert (said["p"], said["chi_square"], said["limit"]["value"]) == (found.probability, found.chi_square, found.limit)
    assert [each["residual"] for each in said["attitudes"]] == found.residuals.tolist()
    assert [each["standard_uncertainty"] for each in said["attitudes"]] == found.standard_uncertainty.tolist()


@pytest.mark.slow
def test_noise_is_checked_as_on_the_command_line(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    ran("noise", "check", "noise.json", "log2.csv", "--tolerance", "2 %", "--json")
    said = json.loads(capsys.readouterr().out)
    found = il.check_noise("noise.json", "log2.csv", tolerance=0.02)
    assert said == json.loads(json_text(found.to_json()))
    assert found.passed


@pytest.mark.slow
def test_the_noise_of_columns_is_told_as_on_the_command_line(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    ran("allan", "still.csv", "--taus", "dense", "--window", "3:25", "--json")
    said = json.loads(capsys.readouterr().out)["columns"]
    for name, column in said.items():
        found = il.allan_deviation("still.csv", column=name, taus="dense", window="3:25")
        for what in ("tau", "deviation", "standard_uncertainty"):
            assert column[what] == getattr(found, what).tolist()
        told = coefficients_dict(found.coefficients, found.unit)
        assert {key: column[key] for key in told} == json.loads(json.dumps(told))


def test_rows_without_numbers_are_bridged_in_an_allan_curve_as_on_the_command_line(tmp_path, capsys):
    log = il.simulate_noise(white="0.3 deg/sqrt(h)", duration="2 min", columns=["gyro_x", "gyro_y"])
    log.columns["gyro_x"][[40, 41, 900]] = np.nan
    il.write(log, tmp_path / "log.csv")
    ran("allan", tmp_path / "log.csv", "--json")
    said = json.loads(capsys.readouterr().out)
    for name, column in said["columns"].items():
        found = il.allan_deviation(tmp_path / "log.csv", column=name)
        assert column["deviation"] == found.deviation.tolist()
        told = coefficients_dict(found.coefficients, found.unit)
        assert {key: column[key] for key in told} == json.loads(json.dumps(told))
        assert any("3 rows without numbers" in note for note in found.notes)
        assert set(found.notes) <= set(said["warnings"])


def test_a_fleet_is_run_and_reported_as_on_the_command_line(tmp_path, capsys):
    first, _ = il.simulate_fleet(tmp_path / "line", units=8)
    state = il.run_fleet(first, tmp_path / "one", workers=1, history="none")
    ran("fleet", "run", first, "-o", tmp_path / "other", "--workers", "1", "--history", "none", "-q")
    for row in state.rows:
        assert same(tmp_path / "one" / f"{row.unit.serial}.json", tmp_path / "other" / f"{row.unit.serial}.json")
    capsys.readouterr()
    ran("fleet", "status", tmp_path / "one", "--json")
    said = json.loads(capsys.readouterr().out)
    found = il.fleet_status(tmp_path / "one")
    assert (said["units"], said["done"], said["failures"]) == (len(found.rows), found.count("done"), [])
    limits = tmp_path / "line" / "limits.toml"
    il.write_fleet_report(tmp_path / "one", tmp_path / "one.html", limits=limits, history="none")
    ran("fleet", "report", tmp_path / "one", "-o", tmp_path / "other.html", "--limits", limits, "--history", "none")
    assert same(tmp_path / "one.html", tmp_path / "other.html")


@pytest.mark.parametrize(
    "made",
    [
        lambda: il.plan_tumble(24, noise="20ug"),
        lambda: il.plan_thermal(),
        lambda: il.plan_warmup(),
        lambda: il.plan_centrifuge(),
        lambda: il.plan_noise(white="0.3 deg/sqrt(h)", walk="10 deg/h/sqrt(h)", gm="5 deg/h:100 s"),
        lambda: il.plan_rate(arw="0.3 deg/sqrt(h)"),
        lambda: il.simulate_centrifuge(),
        lambda: il.simulate_warmup(),
        lambda: il.simulate_thermal(attitudes=2),
        lambda: il.simulate_rate(hold=1.0),
    ],
    ids=["tumble", "soaks", "warmup", "centrifuge", "noise", "rates", "rig", "cycles", "chamber", "table"],
)
def test_results_show_themselves_in_twelve_lines_at_most(made):
    result = made()
    headline, titles, rows = result.shown()
    text, html = repr(result), result._repr_html_()
    assert len(text.splitlines()) <= 12
    assert text.startswith(headline[:100])
    assert html.count("<tr") == (len(rows) + 1 if rows else 0)
    assert all(f">{title}</th>" in html for title in titles if rows)


def test_the_plot_of_a_plan_has_its_attitudes_in_order(tmp_path):
    plan = il.plan_tumble(12, noise="20ug", order=1)
    (trace,) = plan.plot().to_dict()["data"]
    saved = il.read(_saved(plan, tmp_path / "plan.csv"))
    assert trace["x"] == pytest.approx(saved.column("roll").tolist(), abs=1e-3)
    assert trace["y"] == pytest.approx(saved.column("pitch").tolist(), abs=1e-3)


def _saved(plan, path):
    plan.save(path)
    return path


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: il.plan_tumble(12), "noise: expected the noise"),
        (lambda: il.plan_tumble(12, noise="20ugg"), "noise '20ugg': "),
        (lambda: il.plan_tumble(12.5, noise="20ug"), "attitudes 12.5: expected a whole number"),
        (lambda: il.plan_tumble(12, noise="20ug", from_=[1, 2]), "from_: expected upward directions, shape"),
        (lambda: il.plan_warmup(soak=True), "soak True: expected a number in SI, or a text with a unit"),
        (lambda: il.plan_warmup("cold"), "temperatures 'cold': expected numbers"),
        (lambda: il.plan_warmup(repeatability="much"), "repeatability 'much': expected a fraction"),
        (lambda: il.plan_centrifuge(5), "plan_centrifuge: levels: expected numbers or a text, found 5"),
        (lambda: il.plan_centrifuge(drift="3 deg/h"), "drift '3 deg/h': expected a number with one of deg/h/g"),
        (lambda: il.simulate_centrifuge("plan.toml", levels="1,2"), "levels: the plan says that already"),
        (
            lambda: il.simulate_centrifuge(7),
            "simulate_centrifuge: plan: expected a manifest or a plan or the name of its file",
        ),
        (lambda: il.simulate_array(fault=["stuck"]), "fault 'stuck': expected KIND:GYRO"),
        (lambda: il.merge_array(["a.csv"], axis="u"), "axis 'u': expected x, y or z"),
        (lambda: il.compare_records(1, 2), "compare_records: first: expected a record or the name of its file"),
        (lambda: il.export("px5", [], "out"), "to 'px5': unknown target; known targets: "),
        (lambda: il.run_fleet("m.csv", "out", workers="two"), "workers 'two': expected a whole number"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line_that_names_the_keyword(call, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(il.ImulabError) as refused:
        call()
    assert str(refused.value).startswith(said)
    assert "\n" not in str(refused.value)
    assert list(tmp_path.iterdir()) == []

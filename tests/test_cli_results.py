"""What commands print: verdicts first, JSON alone, one spelling of intervals, and units of bare numbers in the help."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.errors import OptionError
from imulab.procedures.centrifuge.plan import plan_centrifuge
from imulab.quantities import interval

ROOT = Path(__file__).resolve().parents[1]
G = "9.80665"


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A recording, its record, and the recording corrected by it."""
    folder = tmp_path_factory.mktemp("bench")
    simulate = ["tumble", "simulate", "--attitudes", "20", "--order", "1", "--seed", "3"]
    assert main([*simulate, "-o", f"{folder}/a.csv"]) == 0
    assert main(["tumble", "fit", f"{folder}/a.csv", "--gravity", G, "--order", "1", "-o", f"{folder}/a.json"]) == 0
    assert main(["apply", f"{folder}/a.json", f"{folder}/a.csv", "-o", f"{folder}/c.csv"]) == 0
    return folder


@pytest.fixture
def run(bench, monkeypatch, capsys):
    monkeypatch.chdir(bench)

    def call(*arguments):
        capsys.readouterr()
        status = main(list(arguments))
        out, err = capsys.readouterr()
        return status, out, err

    return call


def test_a_check_says_first_whether_it_passed(run):
    status, out, err = run("tumble", "check", "a.json", "a.csv", "--gravity", G)
    assert status == 0
    assert out.splitlines()[0] == "pass: the attitudes agree with the record"
    assert re.match(r"p = [\d.]+ \(chi-square [\d.]+ of 20\), 20 attitudes", out.splitlines()[1])
    assert err.count("\n") == 1
    assert err.startswith("imulab: warning: the record was made from this recording")


def test_a_check_of_data_that_the_record_corrected_is_refused(run):
    status, out, err = run("tumble", "check", "a.json", "c.csv", "--gravity", G)
    assert (status, out) == (2, "")
    assert "c.csv: already corrected by a.json: a second time would take its errors off twice; expected the" in err


def test_the_gyroscopes_are_printed_without_the_accelerometers(run):
    status, out, _ = run("tumble", "gyro", "a.csv", "--accel", "a.json", "-o", "both.json")
    assert status == 0
    names = [line.split()[0] for line in out.splitlines() if re.match(r"(gyro_)?(bias|scale|misal|k2)", line)]
    assert len(names) >= 12
    assert all(name.startswith("gyro_") for name in names)
    assert "accelerometers: unchanged from a.json" in out.splitlines()
    both, alone = il.load("both.json"), il.load("a.json")
    assert {name: both.parameters[name] for name in alone.parameters} == dict(alone.parameters)


def test_a_recording_as_json_is_what_numpy_finds(run):
    status, out, err = run("show", "a.csv", "--json", "--window", "1:20")
    assert (status, err) == (0, "")
    told, read = json.loads(out), il.read("a.csv", window=(1, 20))
    assert (told["samples"], told["gaps"], told["metadata"]["serial"]) == (len(read), 0, "SIM-0003")
    assert told["sample_rate"] == {"value": pytest.approx(100, rel=1e-9), "unit": "Hz"}
    assert told["duration"] == {"value": pytest.approx(19), "unit": "s"}
    assert list(told["columns"]) == list(read.columns)
    for name, column in told["columns"].items():
        values = read.columns[name]
        assert column == {
            "unit": read.units[name],
            "min": values.min(),
            "mean": pytest.approx(values.mean(), rel=1e-9, abs=1e-12),
            "max": values.max(),
            "missing": 0,
        }


def test_a_recording_without_numbers_is_json_all_the_same(run):
    Path("empty.csv").write_text("time [s],accel_x [g]\n0,nan\n")
    told = json.loads(run("show", "empty.csv", "--json")[1])
    assert told["columns"]["accel_x"] == {"unit": "g", "min": None, "mean": None, "max": None, "missing": 1}
    assert told["sample_rate"]["value"] is None


@pytest.mark.slow
def test_the_plan_of_a_tumble_as_json(run):
    asked = ["tumble", "plan", "--attitudes", "18", "--noise", "20ug"]
    status, out, err = run(*asked, "--json", "-o", "plan.csv")
    assert (status, err) == (0, "")
    plan, text = json.loads(out), run(*asked)[1]
    assert len(plan["attitudes"]) == 18
    np.testing.assert_allclose(np.linalg.norm([row["up"] for row in plan["attitudes"]], axis=1), 1.0)
    assert plan["noise"] == {"value": pytest.approx(20e-6 * 9.80665), "unit": "m/s^2"}
    printed = dict(re.findall(r"^(\w+_[xyz]+) +([\d.]+)  ", text, re.MULTILINE))
    assert printed.keys() == plan["parameters"].keys()
    factors = {"m/s^2": 9.80665, "m/s^2/(m/s^2)": 1, "rad": 1, "1/(m/s^2)": 1 / 9.80665, "1/(m/s^2)^2": 9.80665**-2}
    for name, parameter in plan["parameters"].items():
        shown = 1e-6 * float(printed[name]) * factors[parameter["unit"]]
        assert parameter["standard_uncertainty"] == pytest.approx(shown, rel=6e-3), name
    fitted = il.load("a.json").parameters
    assert all(plan["parameters"][name]["unit"] == fitted[name].unit for name in fitted)


def test_the_plan_of_a_warm_up_as_json(run):
    asked = ["warmup", "plan", "--temperatures=-20,0,40", "--cycles", "3"]
    status, out, err = run(*asked, "--json")
    assert status == 0
    assert err.startswith("imulab: warning: the interval ")
    plan, text = json.loads(out), run(*asked)[1]
    assert plan["temperatures"] == [-20, 0, 40]
    assert sum(step["duration"] for step in plan["steps"]) == pytest.approx(plan["duration"]["value"])
    minutes = round(plan["duration"]["value"] / 60)
    assert f"the chamber is busy for {minutes // 60}:{minutes % 60:02d} h" in text
    assert sum(step["cycle"] > 0 and "record" in step["action"] for step in plan["steps"]) == 9


def test_the_plan_of_a_centrifuge_says_which_levels_reach_what_is_wanted(run):
    asked = ["centrifuge", "plan", "--levels", "1,5,20", "--both-senses"]
    status, out, _ = run(*asked, "--json")
    assert status == 0
    plan, text = json.loads(out), run(*asked, "-q")[1]
    assert "every level reaches u(K) = 1 % (needed: how long a run must be for that)" in text.splitlines()[0]
    assert [round(level["specific_force"]["value"] / 9.80665) for level in plan["levels"]] == [1, 5, 20]
    assert plan["levels"][0]["arm_rate"]["value"] == pytest.approx(np.sqrt(9.80665 / 2))
    assert all(level["relative_uncertainty"] < plan["wanted"]["value"] for level in plan["levels"])
    assert "1 of 3 levels do not reach u(K) = 0.4 %" in run(*asked, "--uncertainty", "0.4 %", "-q")[1]


def test_the_warning_of_one_sense_is_of_the_levels_that_were_asked_for():
    rest = {"dtg_noise": 0.0, "fog_noise": 0.0, "uncertainty": 0.01, "net_rate": 0.1}
    drift = np.radians(3.3) / 3600 / 9.80665
    for top, radius, K in ((40.0, 2.0, drift), (10.0, 1.0, drift), (10.0, 1.0, 2 * drift)):
        levels = [9.80665, top * 9.80665]
        (said,) = [
            w for w in plan_centrifuge(levels=levels, radius=radius, drift=K, **rest).warnings if "one sense" in w
        ]
        part = 100 * np.sqrt(top * 9.80665 / radius) * 1e-7 / 9.80665 / K
        assert f"(0.1 µrad/g would be {part:.2g} % of K at {top:g} g)" in said


@pytest.mark.parametrize("text", ["468:496", "468,496", "468 to 496", "468 s:496 s", "468 to 496 s"])
def test_an_interval_is_read_as_it_is_printed(text):
    assert interval(text, "--still") == (468.0, 496.0)


@pytest.mark.parametrize("text", ["5", "9:3", "1:2:3", ":", "a to b"])
def test_what_is_no_interval_is_refused(text):
    with pytest.raises(OptionError, match=r"^--still '.*': expected "):
        interval(text, "--still")


def test_a_window_may_be_given_as_messages_print_it(run):
    by_colon, by_word = (run("show", "a.csv", "--window", text)[1] for text in ("10:20", "10 to 20 s"))
    assert by_colon == by_word
    assert "duration 10 s" in by_colon


def _expanded(word):
    """What a shell makes of a word with a star in it."""
    return sorted(str(path) for path in Path().glob(word)) if "*" in word else []


def test_the_warm_up_of_the_gallery_runs_as_written(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    lines = re.findall(r"^    imulab (warmup .*)$", page, re.MULTILINE)
    assert [line.split()[1] for line in lines] == ["simulate", "fit"]
    for line in lines:
        words = [name for word in shlex.split(line) for name in (_expanded(word) or [word])]
        assert main(words) == 0, capsys.readouterr().err
    assert il.load("warm.json").procedure == "warmup"

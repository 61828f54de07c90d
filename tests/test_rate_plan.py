"""Plans of a rate test: what they predict against simulated tests, the manifest, and every refusal."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.procedures.rate.schema import load_test
from imulab.procedures.rate.simulate import RateRecordings
from reference import rate as reference

DEGREE = reference.DEGREE
WALK = 0.3 * DEGREE / 60
FREQUENCY = 20.0


def simulated(plan, seed):
    """The recordings of a plan by the reference simulator, with white noise of the walk that was planned for."""
    rng = np.random.default_rng(seed)
    stays = {each.rate: each.duration for each in plan.rates}
    made = []
    for run in plan.test.runs:
        counts = [round(stays[abs(rate)] * FREQUENCY) for rate in run.rates]
        table = np.repeat(run.rates, counts)
        out = np.zeros((len(table), 3))
        out[:, run.axis] = run.sign * table
        out += WALK * np.sqrt(FREQUENCY) * rng.standard_normal(out.shape)
        gyro = {f"gyro_{a}": out[:, i] for i, a in enumerate("xyz")}
        columns = {"time": np.arange(len(table)) / FREQUENCY, **gyro}
        units = {name: "s" if name == "time" else "rad/s" for name in columns}
        made.append(il.Recording(columns, units, {}, name=run.file))
    return RateRecordings(plan.test, tuple(made), {})


def test_what_a_plan_does_not_know_is_to_be_filled_in(tmp_path):
    """It wrote neither key, and a fit stated misalignments to 0.001 mrad."""
    plan = il.plan_rate("0,100,300", arw=WALK, uncertainty="10 ppm", cycles=1)
    plan.save(tmp_path / "t.toml")
    text = (tmp_path / "t.toml").read_text(encoding="utf-8")
    empty = load_test(tmp_path / "t.toml")
    assert (empty.relative_uncertainty, empty.mounting_uncertainty, empty.latitude) == (None, None, None)
    filled = re.sub(r"^# (rates\.|mounting|latitude)", r"\1", text, flags=re.M)
    (tmp_path / "t.toml").write_text(filled, encoding="utf-8")
    test = load_test(tmp_path / "t.toml")
    assert test.relative_uncertainty == 1e-4
    assert test.mounting_uncertainty == pytest.approx(3e-4)
    assert test.latitude == pytest.approx(np.radians(48.1))
    head = plan.shown()[0]
    assert head.endswith(
        "on top come what all rates of the table have in common (--table-uncertainty) and the mounting, "
        "in every misalignment"
    )
    known = il.plan_rate("0,100,300", arw=WALK, uncertainty="10 ppm", faces="+z", table_uncertainty=1e-5)
    assert "on top" not in known.shown()[0]


@pytest.mark.parametrize("order", [1, 3])
def test_a_simulated_test_gives_what_was_predicted(order):
    plan = il.plan_rate("0,20,100,200,300", arw=WALK, uncertainty="10 ppm", order=order)
    stated = [il.fit_rate(simulated(plan, seed), order=order).calibration for seed in range(2)]
    assert len(plan.predicted) == 12 + 3 * (order - 1)
    for kind in ("scale_factor", "misalignment", *(f"k{power}" for power in range(2, order + 1))):
        names = [name for name in plan.predicted if name.startswith(f"gyro_{kind}")]
        u = [record.parameters[name].standard_uncertainty for record in stated for name in names]
        assert np.mean(u) == pytest.approx(plan.predicted[names[0]], rel=0.05), kind


def test_the_uncertainty_of_the_scale_factor_is_that_of_least_squares():
    """One zero a run and a slope, each dwell u: u(S)/S = u / sqrt(sum over runs and dwells of the rate squared)."""
    plan = il.plan_rate("0,100,300", arw=WALK, uncertainty="10 ppm", cycles=2)
    u = {each.rate: each.uncertainty for each in plan.rates}
    rates = [rate for run in plan.test.runs if run.axis == 0 for rate in run.rates]
    expected = 1 / np.sqrt(sum((rate / u[abs(rate)]) ** 2 for rate in rates))
    assert plan.predicted["gyro_scale_factor_x"] == pytest.approx(expected, rel=1e-6)
    common = il.plan_rate("0,100,300", arw=WALK, uncertainty="10 ppm", cycles=2, table_uncertainty=1e-4)
    assert common.predicted["gyro_scale_factor_x"] == pytest.approx(np.hypot(expected, 1e-4), rel=1e-6)
    assert any("in common" in warning for warning in common.warnings)


def test_stays_are_long_enough_and_of_whole_turns():
    floor = 0.664 * 2 * DEGREE / 3600
    plan = il.plan_rate("0,10,300", arw=WALK, bias_instability="2 deg/h", uncertainty="3 ppm")
    wanted = 3e-6 * 300 * DEGREE
    for each in plan.rates:
        used = each.duration - 0.6
        assert used >= WALK**2 / (wanted**2 - floor**2) * (1 - 1e-9)
        assert each.uncertainty == pytest.approx(np.hypot(WALK / np.sqrt(used), floor), rel=1e-9)
        assert each.turns == pytest.approx(round(each.turns), abs=1e-6)
    assert plan.warnings == ()
    assert min(each.duration for each in il.plan_rate(arw=1e-7).rates) >= 5
    reading = il.plan_rate("10,300", arw=WALK, of="reading", uncertainty="100 ppm")
    assert [each.wanted for each in reading.rates] == pytest.approx([1e-3 * DEGREE, 0.03 * DEGREE])


def test_what_is_out_of_reach_is_said():
    (said,) = il.plan_rate(arw=WALK, bias_instability="5 deg/h", uncertainty="2 ppm").warnings
    assert "bias instability alone makes 3.07 ppm of full scale" in said  # 0.664 * 5 deg/h over 300 deg/s
    (said,) = il.plan_rate("10,300", arw=WALK, of="reading", uncertainty="5 ppm").warnings
    assert "out of reach at 10 deg/s: it takes more than 10 min at a rate" in said


def test_a_manifest_is_that_which_rate_fit_takes(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["--rates", "0,100,300", "--arw", "0.3deg/sqrt(h)", "--cycles", "1", "--latitude", "48.1", "-o", "t.toml"]
    assert main(["rate", "plan", *words, "--table-uncertainty", "20ppm"], project=False) == 0
    assert "manifest: t.toml" in capsys.readouterr().out
    test = load_test("t.toml")
    assert [run.mounting for run in test.runs] == ["+x", "+y", "+z"]
    assert test.relative_uncertainty == pytest.approx(2e-5)
    assert test.latitude == pytest.approx(48.1 * DEGREE)
    up = [0, 100, 300, 100, 0, -100, -300, -100, 0]
    assert test.runs[0].rates == pytest.approx([rate * DEGREE for rate in up])
    plan = il.plan_rate("0,100,300", arw="0.3 deg/sqrt(h)", cycles=1, uncertainty="10 ppm")
    for run, recording in zip(test.runs, simulated(plan, 1).recordings, strict=True):
        il.write(recording, run.file)
    assert main(["rate", "fit", "t.toml", "-o", "r.json"], project=False) == 0
    assert main(["rate", "plan", *words[:-1], "t.csv"], project=False) == 0
    assert len(Path("t.csv").read_text(encoding="utf-8").splitlines()) == 1 + 3 * len(up)


def test_noise_is_taken_from_a_record(tmp_path):
    log = il.simulate_noise(white="0.3 deg/sqrt(h)", flicker="5 deg/h", rate=20.0, duration="1 h", columns=["gyro_z"])
    il.fit_noise(log).save(tmp_path / "noise.json")
    planned = il.plan_rate(noise=tmp_path / "noise.json", uncertainty="20 ppm")
    given = il.plan_rate(arw="0.3 deg/sqrt(h)", bias_instability="5 deg/h", uncertainty="20 ppm")
    for name, u in given.predicted.items():
        assert planned.predicted[name] == pytest.approx(u, rel=0.2)


def test_turns_by_hand_are_as_many_as_it_takes(capsys):
    plan = il.plan_rate(turn="0.02 %")
    assert (plan.turns, plan.stops) == (5, 11)
    assert 1e6 * plan.reached[[0, 2, 4]] == pytest.approx([1203, 360, 185], abs=0.6)  # docs/rate.md
    assert len(plan.plot().figure.traces[0]["x"]) == 5
    assert main(["rate", "plan", "--turn", "0.1%", "--fence", "1deg", "--json"], project=False) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["turns"] == len(said["reached"]) == 3  # twice 360 ppm


def test_a_plan_is_drawn():
    plan = il.plan_rate("0,100,300", arw=WALK)
    predicted, wanted = plan.plot().figure.traces
    assert predicted["x"] == pytest.approx([0, 100, 300])
    assert wanted["y"] == pytest.approx([20] * 3)
    assert plan.plot().figure.message == f"{plan.shown()[0]}."


@pytest.mark.parametrize(
    "made", [lambda: il.plan_rate(arw=WALK), lambda: il.plan_rate(turn="0.02 %"), il.plan_centrifuge]
)
def test_the_axes_of_a_plan_have_a_unit_numbers_and_words_for_their_letters(made):
    figure = made().plot().figure
    upward = figure.layout["yaxis"]
    (letters, unit) = upward["title"]["text"].split(", ")
    assert unit.startswith(("ppm", "%"))
    assert figure.caption.startswith(f"{letters}: ")
    assert "standard uncertainty" in figure.caption
    assert (upward["type"], upward["dtick"]) == ("log", "D2")  # less than a decade would have no number otherwise


REFUSED = {
    "no noise": (lambda: il.plan_rate(), "arw: expected the angle random walk"),
    "a walk": (lambda: il.plan_rate(arw="3 deg/h"), "arw '3 deg/h': expected a number with one of"),
    "no walk": (lambda: il.plan_rate(arw=0), "expected more than 0"),
    "one rate": (lambda: il.plan_rate("10,-10", arw=WALK), "expected two sizes of rates or more"),
    "few rates": (lambda: il.plan_rate("10,20", arw=WALK, order=5), "4 different rates, expected 7 or more"),
    "faces": (lambda: il.plan_rate(arw=WALK, faces="up"), "faces 'up': expected body axes"),
    "cycles": (lambda: il.plan_rate(arw=WALK, cycles=0), "cycles 0: expected 1 to 100"),
    "order": (lambda: il.plan_rate(arw=WALK, order=6), "order 6: expected one of"),
    "of": (lambda: il.plan_rate(arw=WALK, of="scale"), "of 'scale': expected one of full reading"),
    "uncertainty": (lambda: il.plan_rate(arw=WALK, uncertainty=0), "uncertainty 0: expected more than 0"),
    "turns": (lambda: il.plan_rate(turn=1e-9), "turn 0.001 ppm: 1000 turns on and back reach"),
    "fence": (lambda: il.plan_rate(turn=1e-3, fence=0), "fence 0: expected the uncertainty"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_is_refused_in_a_line(name):
    call, said = REFUSED[name]
    with pytest.raises(il.ImulabError, match=said) as refused:
        call()
    assert "\n" not in str(refused.value)


def test_another_record_or_two_noises_are_refused(tmp_path):
    il.fit_rate(il.simulate_rate(hold="3 s")).save(tmp_path / "rate.json")
    with pytest.raises(il.ImulabError, match="holds no noise of gyroscopes"):
        il.plan_rate(noise=tmp_path / "rate.json")
    with pytest.raises(il.ImulabError, match="arw: the record of noise says that already"):
        il.plan_rate(noise=tmp_path / "rate.json", arw=WALK)
    assert main(["rate", "plan", "--turn", "0.1%", "-o", str(tmp_path / "t.toml")], project=False) == 2
    assert not (tmp_path / "t.toml").exists()

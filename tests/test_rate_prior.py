"""An earlier record beside a new one: the same as one fit of both, and whether they agree."""

import dataclasses

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.errors import DataError, RecordError
from imulab.procedures.rate.simulate import RateRecordings
from imulab.procedures.views import exhibits_of

HOW = {"noise": "0.02 deg/s", "rate": "50 Hz", "hold": "4 s", "rates": "0,50,100,200"}


def simulated(seed, **how):
    """A test of the unit of seed 1 with noise of its own: its outputs, and noise, are of the seed."""
    made = il.simulate_rate(seed=1, **{**HOW, "noise": "0", **how})
    rng = np.random.default_rng(seed)
    recordings = []
    for run, one in zip(made.test.runs, made.recordings, strict=True):
        columns = {n: v if n == "time" else v + 0.02 * rng.standard_normal(len(v)) for n, v in one.columns.items()}
        recordings.append(dataclasses.replace(one, columns=columns, name=f"{seed}_{run.file}"))
    runs = tuple(dataclasses.replace(run, file=f"{seed}_{run.file}") for run in made.test.runs)
    return RateRecordings(dataclasses.replace(made.test, runs=runs), tuple(recordings), made.truth)


def joined(*tests):
    runs = tuple(run for one in tests for run in one.test.runs)
    return RateRecordings(
        dataclasses.replace(tests[0].test, runs=runs), tuple(r for one in tests for r in one.recordings), {}
    )


MODEL = ("gyro_scale_factor", "gyro_misalignment", "gyro_k3")


@pytest.mark.parametrize("order", [1, 3])
def test_two_records_are_what_one_fit_of_both_tests_gives(order):
    first, second = simulated(11), simulated(12)
    prior = il.fit_rate(first, order=order).calibration
    alone = il.fit_rate(second, order=order).calibration
    both = il.fit_rate(second, order=order, prior=prior).calibration
    whole = il.fit_rate(joined(first, second), order=order).calibration
    names = [name for name in whole.parameters if name.startswith(MODEL)]
    assert len(names) == (9 if order == 1 else 12)
    for name in names:
        u = whole.parameters[name].standard_uncertainty
        # their noises are estimated apart, so that the weights differ by some percent
        assert both.value(name) == pytest.approx(whole.value(name), abs=0.3 * u), name
        assert both.parameters[name].standard_uncertainty == pytest.approx(u, rel=0.1), name
        assert u < 0.8 * alone.parameters[name].standard_uncertainty
    assert both.value("gyro_bias_x") == pytest.approx(
        alone.value("gyro_bias_x"), abs=3 * alone.parameters["gyro_bias_x"].standard_uncertainty
    )
    assert any("the prior agrees" in warning for warning in both.warnings)


def test_what_one_table_makes_is_not_averaged_away():
    """Two tests on a table of 1e-4: S stays at 1e-4; of two tables it would be 0.7e-4."""
    first, second = (
        dataclasses.replace(one, test=dataclasses.replace(one.test, relative_uncertainty=1e-4))
        for one in (simulated(11), simulated(12))
    )
    prior = il.fit_rate(first, order=1).calibration
    scale = il.fit_rate(second, order=1, prior=prior).calibration.parameters["gyro_scale_factor_x"]
    assert scale.standard_uncertainty / scale.value == pytest.approx(1e-4, rel=0.01)


def test_records_that_do_not_agree_are_said_to():
    first, second = simulated(11), simulated(12)
    bent = dataclasses.replace(
        second,
        recordings=tuple(
            dataclasses.replace(one, columns={**one.columns, "gyro_y": one.column("gyro_y") * 1.0003})
            for one in second.recordings
        ),
    )
    prior = il.fit_rate(first, order=1).calibration
    (said,) = (w for w in il.fit_rate(bent, order=1, prior=prior).calibration.warnings if "prior" in w)
    assert "the prior does not agree" in said
    assert "gyro_scale_factor_y differs by" in said


def test_a_prior_that_does_not_agree_is_to_be_looked_at():
    """The record is judged with what the prior makes of it; it was judged before."""
    first, second = simulated(11), simulated(12)
    prior = il.fit_rate(first, order=1).calibration
    assert il.fit_rate(second, order=1, prior=prior).calibration.verdict.state == "good"
    scale = prior.parameters["gyro_scale_factor_y"]
    moved = {"gyro_scale_factor_y": dataclasses.replace(scale, value=scale.value * 1.0003)}
    other = dataclasses.replace(prior, parameters=prior.parameters | moved)
    for record in (
        il.fit_rate(second, order=1, prior=other).calibration,
        il.fit_turns(turned(), prior=prior, clock="1ppm").calibration,
    ):
        assert record.verdict.state == "look"
        assert any("the prior does not agree (probability" in reason for reason in record.verdict.reasons)
    # 2.2 sigma of each of nine parameters are no significant one of nine, but all of them together are.
    alone = il.fit_rate(second, order=1).calibration
    moved = {
        n: dataclasses.replace(
            p,
            value=alone.value(n) + 2.2 * np.hypot(p.standard_uncertainty, alone.parameters[n].standard_uncertainty),
        )
        for n, p in prior.parameters.items()
        if n.startswith(MODEL)
    }
    record = il.fit_rate(second, order=1, prior=dataclasses.replace(prior, parameters=prior.parameters | moved))
    (said,) = record.calibration.verdict.reasons
    assert "the prior does not agree (probability" in said
    assert "no one parameter" in said


def test_a_prior_of_another_unit_is_said_to_be():
    prior = il.fit_rate(simulated(11), order=1).calibration
    other = dataclasses.replace(prior, sensor={"serial": "SN7"})
    (said,) = il.fit_rate(simulated(12), order=1, prior=other).calibration.verdict.reasons
    assert said == "prior: the record is of serial SN7, the recordings of SIM: is it of this unit?"


def turned(scale=1.01):
    gyro = np.random.default_rng(1).normal(0, 0.02, (2400, 3))
    gyro[300:900, 2] += 60 * scale
    gyro[1300:1900, 2] -= 60 * scale
    return il.Recording.from_arrays(gyro=gyro, rate=100.0, units={"gyro": "deg/s"})


def test_turns_correct_the_scale_factor_of_a_tumble_record(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    made = il.simulate_tumble(attitudes=18, order=1, hold="2 s", gyro=True, seed=3)
    prior = il.fit_gyro(il.fit_tumble(made, order=1, gravity=9.80665).calibration, made).calibration
    known = prior.parameters["gyro_scale_factor_z"]
    nominal = il.fit_turns(turned(), clock="10ppm").calibration.parameters["gyro_scale_factor_z"]
    assert known.unit == nominal.unit
    own = il.fit_turns(turned(known.value / nominal.value * 1.01), clock="10ppm").calibration
    scale = own.parameters["gyro_scale_factor_z"]
    both = il.fit_turns(turned(known.value / nominal.value * 1.01), clock="10ppm", prior=prior).calibration
    assert both.procedure == "tumble"
    weight = 1 / np.array([known.standard_uncertainty, scale.standard_uncertainty]) ** 2
    expected = weight @ [known.value, scale.value] / weight.sum()
    found = both.parameters["gyro_scale_factor_z"]
    assert found.value == pytest.approx(expected, abs=0.05 * found.standard_uncertainty)
    assert found.standard_uncertainty == pytest.approx(weight.sum() ** -0.5, rel=0.01)
    for name in ("gyro_misalignment_xy", "gyro_scale_factor_x", "bias_x"):
        assert name in both.parameters
    prior.save("prior.json")
    il.write(turned(known.value / nominal.value * 1.01), "t.csv")
    assert main(["rate", "turn", "t.csv", "--prior", "prior.json", "-o", "both.json"], project=False) == 0
    assert main(["show", "both.json"], project=False) == 0
    il.apply("both.json", made)
    il.export("c", "both.json", "c")
    capsys.readouterr()


def test_what_cannot_be_a_prior_is_refused_in_a_line(tmp_path):
    il.fit_tumble(il.simulate_tumble(attitudes=12, order=1, hold="2 s"), order=1, gravity=9.8).save(tmp_path / "a.json")
    other = simulated(11)
    radians = dataclasses.replace(other, recordings=tuple(
        dataclasses.replace(r, columns={n: v if n == "time" else np.radians(v) for n, v in r.columns.items()},
                            units={n: "s" if n == "time" else "rad/s" for n in r.units})
        for r in other.recordings))  # fmt: skip
    x = simulated(11, faces="+x")
    for data, prior, said in (
        (simulated(12), tmp_path / "a.json", "a tumble record without gyroscopes"),
        (simulated(12), il.fit_rate(radians, order=1), "its gyroscopes are in rad/s, those of the recording in deg/s"),
        (simulated(12, faces="+z"), il.fit_rate(x, order=1), "holds none of the parameters found here"),
    ):
        with pytest.raises(il.ImulabError, match=said) as refused:
            il.fit_rate(data, order=1, prior=prior)
        assert "\n" not in str(refused.value)
    il.write(turned(), tmp_path / "t.csv")
    il.fit_turns(tmp_path / "t.csv").save(tmp_path / "t.json")
    with pytest.raises(il.ImulabError, match="the prior was made from this recording, which would count twice"):
        il.fit_turns(tmp_path / "t.csv", prior=tmp_path / "t.json")


def test_the_report_shows_what_both_records_say_and_what_their_fit_makes_of_it(tmp_path):
    """Values of the table to its two digits of the uncertainty."""
    prior, alone = (il.fit_rate(simulated(seed), order=1).calibration for seed in (11, 12))
    both = il.fit_rate(simulated(12), order=1, prior=prior).calibration
    of = both.fit["prior"]["parameters"]["gyro_scale_factor_x"]
    assert of["prior"]["value"] == prior.value("gyro_scale_factor_x")
    assert of["test"]["value"] == alone.value("gyro_scale_factor_x")
    (table,) = (item for item in exhibits_of(both).items if item.title == "The earlier record and this test")
    (row,) = (row for row in table.rows if row[0] == "gyro_scale_factor_x")
    for text, record in zip(row[1:4], (prior, alone, both), strict=True):
        p = record.parameters["gyro_scale_factor_x"]
        value, u = (float(part) for part in text.split(" ± "))
        assert u == pytest.approx(1e6 * np.pi / 180 * p.standard_uncertainty, rel=0.06)
        assert value == pytest.approx(1e6 * (p.value * np.pi / 180 - 1), abs=0.06 * u)
    assert row[4] == "ppm off nominal"
    both.save(tmp_path / "b.json")
    assert il.load(tmp_path / "b.json").fit["prior"]["probability"] == both.fit["prior"]["probability"]


@pytest.fixture(scope="module")
def thermal():
    made = il.simulate_thermal((-20, 0, 20, 40, 60), attitudes=14, gyro=True, seed=3)
    return il.fit_thermal(list(made), with_="gyro").calibration


def turned_thermal(scale, temperature):
    """One turn on and one back about z at 60 deg/s, by a gyroscope of this scale factor, at one temperature."""
    gyro = np.random.default_rng(1).normal(0, 0.02, (2400, 3))
    gyro[300:900, 2] += 60 * scale
    gyro[1300:1900, 2] -= 60 * scale
    made = il.Recording.from_arrays(gyro=gyro, rate=100.0, units={"gyro": "deg/s"})
    if temperature is None:
        return made
    return made.with_columns({"temperature": np.full(2400, temperature)}, {"temperature": "degC"})


def at(record, axis, temperature):
    """The scale factor by the record's powers of T - T0, in units of the nominal one, and its uncertainty."""
    names = [name for name in record.parameters if name.startswith(f"gyro_scale_factor_{axis}")]
    powers = (temperature - record.model["reference_temperature"]["value"]) ** np.arange(len(names))
    nominal = np.degrees(1.0)
    values = np.array([record.value(name) for name in names])
    return powers @ values / nominal, np.sqrt(powers @ record.cov(*names) @ powers) / nominal


@pytest.mark.parametrize("temperature", [-10.0, 35.0])
def test_turns_are_joined_with_the_law_at_their_temperature(thermal, temperature):
    prior, u_prior = at(thermal, "z", temperature)
    own = il.fit_turns(turned_thermal(prior, None), clock="10ppm").calibration.parameters["gyro_scale_factor_z"]
    value, u = own.value / np.degrees(1.0), own.standard_uncertainty / np.degrees(1.0)
    both = il.fit_turns(turned_thermal(prior, temperature), clock="10ppm", prior=thermal).calibration
    weight = np.array([u_prior, u]) ** -2.0
    found = both.parameters["gyro_scale_factor_z"]
    assert found.value / np.degrees(1.0) == pytest.approx(weight @ [prior, value] / weight.sum(), abs=0.05 * u_prior)
    assert found.standard_uncertainty / np.degrees(1.0) == pytest.approx(weight.sum() ** -0.5, rel=0.02)
    assert any("the prior agrees" in warning for warning in both.warnings)
    assert {"gyro_scale_factor_x", "gyro_misalignment_xy"} <= set(both.parameters)
    assert "bias_x" not in both.parameters


def test_another_temperature_than_the_column_says_is_seen(thermal):
    """The law moves by 93 ppm/K: turns made at 60 degC, with a thermometer that says -20, do not agree."""
    scale, _ = at(thermal, "x", 60.0)
    gyro = turned_thermal(1.0, None).triad("gyro")
    gyro = np.column_stack([gyro[:, 2] * scale, gyro[:, 1], gyro[:, 0]])
    made = il.Recording.from_arrays(gyro=gyro, rate=100.0, units={"gyro": "deg/s"})
    cold = made.with_columns({"temperature": np.full(2400, -19.0)}, {"temperature": "degC"})
    said = il.fit_turns(cold, clock="10ppm", fence="0.1 deg", prior=thermal).calibration.warnings
    assert any("the prior does not agree" in warning for warning in said)


def test_a_rate_test_takes_it_too(thermal):
    test = il.simulate_rate("0,50,100", faces="+z", hold="3 s", rate="50 Hz", seed=5)
    warm = [
        one.with_columns({"temperature": np.full(len(one), 25.0)}, {"temperature": "degC"}) for one in test.recordings
    ]
    alone = il.fit_rate(dataclasses.replace(test, recordings=tuple(warm)), order=1).calibration
    both = il.fit_rate(dataclasses.replace(test, recordings=tuple(warm)), order=1, prior=thermal).calibration
    prior, u_prior = at(thermal, "z", 25.0)
    own = alone.parameters["gyro_scale_factor_z"]
    weight = np.array([u_prior * np.degrees(1.0), own.standard_uncertainty]) ** -2.0
    expected = weight @ [prior * np.degrees(1.0), own.value] / weight.sum()
    found = both.parameters["gyro_scale_factor_z"]
    assert found.value == pytest.approx(expected, abs=0.05 * found.standard_uncertainty)


def test_what_it_cannot_tell_is_refused_in_a_line(thermal, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for temperature, said in (
        (None, "no column temperature; a thermal record is a prior at the temperature of the recording"),
        (75.0, r"made at 75.0 degC, outside the -19.\d to 59.\d degC of the thermal record, which is no prior there"),
    ):
        with pytest.raises(RecordError, match=said):
            il.fit_turns(turned_thermal(1.0, temperature), prior=thermal)
    plain = il.fit_thermal(list(il.simulate_thermal((0, 20, 40), attitudes=12, seed=3)), degrees="1,0,0")
    plain.save("plain.json")
    il.write(turned_thermal(1.0, 20.0), "t.csv")
    assert main(["rate", "turn", "t.csv", "--prior", "plain.json", "-o", "both.json"], project=False) == 2
    (line,) = [each for each in capsys.readouterr().err.splitlines() if "prior" in each]
    assert "a thermal record without scale factors of gyroscopes; expected one of thermal fit --with gyro" in line
    assert not (tmp_path / "both.json").exists()


def test_runs_at_different_temperatures_have_no_one_prior(thermal):
    """At their mean the law is off by what the temperatures make of it: 1,600 ppm stated as 16."""
    test = il.simulate_rate("0,50,100", hold="3 s", rate="50 Hz", seed=5)

    def at_temperatures(*temperatures):
        made = tuple(
            one.with_columns({"temperature": np.full(len(one), t)}, {"temperature": "degC"})
            for one, t in zip(test.recordings, temperatures, strict=True)
        )
        return il.fit_rate(dataclasses.replace(test, recordings=made), order=1, prior=thermal)

    said = "prior: py_1.csv was made at -15.0 degC, pz_1.csv at 55.0; .* recordings at one temperature, 5 K apart"
    with pytest.raises(DataError, match=said) as refused:
        at_temperatures(20.0, -15.0, 55.0)
    assert "\n" not in str(refused.value)
    warm = at_temperatures(22.6, 25.0, 27.4).calibration
    assert warm.fit["prior"]["parameters"]

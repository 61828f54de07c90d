"""A thermal record as prior of turns and of a rate test: its gyroscopes at the temperature of the recording."""

import dataclasses

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.errors import DataError, RecordError


@pytest.fixture(scope="module")
def thermal():
    made = il.simulate_thermal((-20, 0, 20, 40, 60), attitudes=14, gyro=True, seed=3)
    return il.fit_thermal(list(made), with_="gyro").calibration


def turned(scale, temperature):
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
    own = il.fit_turns(turned(prior, None), clock="10ppm").calibration.parameters["gyro_scale_factor_z"]
    value, u = own.value / np.degrees(1.0), own.standard_uncertainty / np.degrees(1.0)
    both = il.fit_turns(turned(prior, temperature), clock="10ppm", prior=thermal).calibration
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
    gyro = turned(1.0, None).triad("gyro")
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
            il.fit_turns(turned(1.0, temperature), prior=thermal)
    plain = il.fit_thermal(list(il.simulate_thermal((0, 20, 40), attitudes=12, seed=3)), degrees="1,0,0")
    plain.save("plain.json")
    il.write(turned(1.0, 20.0), "t.csv")
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

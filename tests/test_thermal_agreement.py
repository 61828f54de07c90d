"""Recordings that are hardly of one unit: what is wrong with them is asked about, and who stands apart is named."""

import numpy as np
import pytest

import imulab as il
from conftest import some_of
from imulab.cli import main
from imulab.recording import Recording
from imulab.writers import write
from reference import thermal as reference

G = reference.G
SOAKS = (-20.0, 0.0, 25.0, 45.0, 60.0)
COLUMNS = ("accel_x", "accel_y", "accel_z")


def table(outputs, temperature, name):
    """A table of attitudes, 60 ug of noise in each, as a laboratory would write it."""
    columns = dict(zip(COLUMNS, outputs.T, strict=True))
    columns |= {f"std_{key}": np.full(len(outputs), 60e-6 * G) for key in COLUMNS}
    columns["temperature"] = np.full(len(outputs), temperature)
    units = {key: "degC" if key == "temperature" else "m/s^2" for key in columns}
    return Recording(columns=columns, units=units, name=name, metadata={"gravity": f"{G} m/s^2"})


def soaks(seed, change=None, at=None, temperatures=SOAKS):
    """Soaks of one unit with 0.1 mg of turn-on scatter; `change` alters outputs and reading of one, or all."""
    rng, triad = np.random.default_rng([seed, 8]), reference.Triad(np.random.default_rng([seed, 1]))
    other = reference.Triad(np.random.default_rng([seed, 2]))
    found = []
    for number, temperature in enumerate(temperatures):
        outputs, _ = reference.soak(triad, rng, temperature, 12, 60e-6 * G, 1e-4 * G)
        reading = temperature
        if change is not None and at in (number, None):
            outputs, reading = change(outputs, temperature, lambda t: reference.soak(other, rng, t, 12, 60e-6 * G)[0])
        found.append(table(outputs, reading, f"soak_{number}.csv"))
    return found


def asked(recordings):
    record = il.fit_thermal(recordings).calibration
    said = [each for each in record.warnings if "all of one unit" in each or "of which noise explains" in each]
    assert record.verdict.state == ("look" if said else record.verdict.state)
    return said


@pytest.mark.parametrize("seed", some_of(2, range(5)))
def test_one_unit_is_not_asked_about(seed):
    assert not asked(soaks(seed))


@pytest.mark.parametrize("at", [0, 1, 2, 4])
@pytest.mark.parametrize("seed", some_of(2, range(3)))
def test_one_tumble_of_another_unit_without_a_serial_number_is_found_and_named(seed, at):
    """At the end of the range, too, where the law could go with it: all but that recording agree."""
    said = asked(soaks(seed, lambda _, t, other: (other(t), t), at))
    assert said
    assert f"Without soak_{at}.csv the others agree to" in said[0]


@pytest.mark.parametrize(
    "change",
    [
        lambda outputs, t, _: (outputs[:, [1, 0, 2]], t),
        lambda outputs, t, _: (outputs, 1.8 * t + 32.0),
        lambda outputs, t, _: (outputs, 0.0),
    ],
    ids=["axes named otherwise", "degrees Fahrenheit", "a thermometer that stays"],
)
def test_one_recording_unlike_the_others_is_asked_about(change):
    said = asked(soaks(2, change, 2))
    assert said
    assert "Without soak_2.csv" in said[0]


def test_a_jump_of_the_outputs_within_a_recording_is_asked_about():
    jump = np.repeat([0.0, 3e-3 * G], 6)[:, None]
    said = asked(soaks(1, lambda outputs, t, _: (outputs + jump, t), 2))
    assert any("within recordings |f| scatters by" in each for each in said)


def test_temperatures_above_what_sensors_bear_are_asked_about(tmp_path, capsys):
    files = []
    for each in soaks(1, lambda outputs, t, _: (outputs, 1.8 * t + 32.0)):
        files.append(str(tmp_path / each.name))
        write(each, files[-1])
    assert main(["thermal", "fit", *files, "-o", str(tmp_path / "t.json")]) == 0
    said = capsys.readouterr().err
    assert "temperatures up to 140 degC, above what sensors are rated to: are these degrees Fahrenheit?" in said


def test_a_simulation_without_a_recording_is_refused(tmp_path, capsys):
    assert main(["thermal", "simulate", "--attitudes", "0", "-o", str(tmp_path / "none")]) == 2
    assert "attitudes 0, ramps 0: make no recording" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_a_simulated_unit_comes_back_to_temperatures_in_files_of_their_own(tmp_path):
    assert main(["thermal", "simulate", "--temperatures=0,20,0", "--attitudes", "3", "-o", str(tmp_path)]) == 0
    assert sorted(path.name for path in tmp_path.glob("*.csv")) == ["tumble_0.csv", "tumble_0_2.csv", "tumble_20.csv"]


EIGHT = (-20.0, 0.0, 20.0, 40.0, 60.0, -20.3, 20.3, 60.3)


def off(recordings):
    record = il.fit_thermal(recordings).calibration
    return [each for each in record.warnings if "lies off the other recordings by" in each], record.verdict.state


@pytest.mark.parametrize("seed", some_of(2, range(4)))
def test_a_recording_that_lies_off_by_far_more_than_the_others_scatter_is_asked_about(seed):
    """A twin of the unit whose biases differ by 3 mg, which passed as one unit as long as nobody left it out."""
    twin = 3e-3 * G * np.array([1.0, -1.0, 0.6])
    said, state = off(soaks(seed, lambda outputs, t, _: (outputs + twin, t), 5, EIGHT))
    assert state == "look"
    assert said[0].startswith("soak_5.csv: lies off the other recordings by")
    assert not off(soaks(seed, temperatures=EIGHT))[0]


def test_scale_factors_tell_a_twin_among_five_recordings():
    stretched = np.array([1.002, 0.998, 1.0015])
    said, state = off(soaks(3, lambda outputs, t, _: (outputs * stretched, t), 2))
    assert state == "look"
    assert "soak_2.csv: lies off the other recordings by" in said[0]
    assert "ppm in scale factors" in said[0]
    assert not off(soaks(3))[0]

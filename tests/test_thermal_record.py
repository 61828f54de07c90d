"""Recordings that are hardly of one unit: what is wrong with them is asked about, and who stands apart is named."""

import numpy as np
import pytest

import imulab as il
from conftest import some_of
from imulab.cli import main
from imulab.procedures.thermal.record import deviation_of_force, predict_gyro_scale
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


@pytest.mark.slow
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


def test_laws_that_bend_more_than_three_temperatures_show_are_not_blamed_on_another_unit(tmp_path):
    assert main(["thermal", "simulate", "--temperatures", "0,25,50", "-o", str(tmp_path)]) == 0
    record = il.fit_thermal(sorted(tmp_path.glob("*.csv"))).calibration
    assert any("do the laws bend more than so few temperatures show, or is a" in each for each in record.warnings)
    assert record.verdict.next == ("record five temperatures or more, or state --degrees",)


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


NOISE = 60e-6


NAMES = [
    *(f"bias_{a}" for a in "xyz"),
    *(f"scale_factor_{a}" for a in "xyz"),
    *(f"misalignment_{ij}" for ij in ("yx", "zx", "zy")),
]


def soaks_calibrations(attitudes, offset=0.0):
    """Tables of attitudes at five temperatures; `offset` moves all biases of the third, g."""
    rng = np.random.default_rng(41)
    triad, made = reference.Triad(rng), []
    for number, at in enumerate((-20, 0, 20, 40, 60)):
        moved = np.full(3, offset * G * (number == 2))
        outputs = np.array([triad.output(G * u, at, moved) for u in reference.directions(rng, attitudes)])
        outputs += NOISE * G * rng.standard_normal(outputs.shape)
        columns = {f"accel_{a}": outputs[:, k] for k, a in enumerate("xyz")}
        columns |= {f"std_accel_{a}": np.full(attitudes, NOISE * G) for a in "xyz"}
        units = dict.fromkeys(columns, "m/s^2") | {"temperature": "degC"}
        columns["temperature"] = at + 1e-3 * (-1.0) ** np.arange(attitudes)  # a thermometer of fine steps
        made.append(il.Recording(columns, units, {"gravity": f"{G} m/s^2"}, f"soak_{number}"))
    return triad, made


def report_of(record, folder):
    il.write_report(record, folder / "r.html")
    return (folder / "r.html").read_text(encoding="utf-8")


def test_each_equals_the_tumble_calibration_of_its_recording():
    _, given = soaks_calibrations(24)
    record = il.fit_thermal(given, degrees="3,2,1", gravity=f"{G}+-0").calibration
    alone = record.data["calibrations"]
    assert alone["recording"] == [each.name for each in given]
    assert alone["temperature"] == pytest.approx([-20, 0, 20, 40, 60], abs=1e-9)
    for row, u, recording in zip(alone["values"], alone["standard_uncertainty"], given, strict=True):
        tumble = il.fit_tumble(recording, order=1, gravity=f"{G}+-0").calibration
        expected = np.array([tumble.value(name) for name in NAMES])
        stated = np.sqrt(np.diag(tumble.cov(*NAMES)))
        assert np.abs((np.array(row) - expected) / stated).max() < 0.05
        # A tumble test estimates the scatter of its attitudes from these alone.
        np.testing.assert_allclose(u, stated, rtol=0.3)


def test_each_is_the_truth_within_its_uncertainty_whatever_its_power_cycle_did(tmp_path):
    triad, given = soaks_calibrations(24, offset=3e-4)
    record = il.fit_thermal(given, degrees="3,2,1", gravity=f"{G}+-0").calibration
    alone = record.data["calibrations"]
    truth = np.array([np.concatenate(triad.at(at)) for at in alone["temperature"]])
    truth[:, :3] += np.outer(np.arange(5) == 2, np.full(3, 3e-4 * G))
    standard = (np.array(alone["values"]) - truth) / np.array(alone["standard_uncertainty"])
    assert 18 < (standard**2).sum() < 85  # chi-square of 45: 1 in 10,000 either way
    assert "Points: what each recording at a steady temperature gives alone" in report_of(record, tmp_path)


def test_too_few_attitudes_give_none(tmp_path):
    record = il.fit_thermal(soaks_calibrations(8)[1], degrees="1,0,0").calibration
    assert "calibrations" not in record.data
    assert "Points: what each" not in report_of(record, tmp_path)


@pytest.mark.slow
def test_scale_factors_of_gyroscopes_are_drawn_over_temperature(tmp_path):
    made = il.simulate_thermal((-20, 0, 20, 40, 60), attitudes=14, gyro=True, seed=3)
    record = il.fit_thermal(list(made), with_="gyro").calibration
    at = np.array(record.model["range"])
    values, u = predict_gyro_scale(record, at)
    for k, axis in enumerate("xyz"):
        names = [n for n in record.parameters if n.startswith(f"gyro_scale_factor_{axis}")]
        powers = (at - record.model["reference_temperature"]["value"])[:, None] ** np.arange(len(names))
        np.testing.assert_allclose(values[k], powers @ [record.value(n) for n in names], rtol=1e-12)
        expected = np.sqrt(np.einsum("ni,ij,nj->n", powers, record.cov(*names), powers))
        np.testing.assert_allclose(u[k], expected, rtol=1e-6)
    assert "Scale factor of the gyroscopes over temperature" in report_of(record, tmp_path)


def test_the_deviation_of_the_corrected_force_is_that_of_drawn_laws(tmp_path):
    """Laws drawn from the record's covariance correct the outputs of an ideal unit in all directions."""
    _, given = soaks_calibrations(24, offset=3e-4)
    record = il.fit_thermal(given, degrees="3,2,1", gravity=f"{G}+-0").calibration
    rng, at = np.random.default_rng(7), np.array([-20.0, 13.0, 60.0])
    names, t = list(record.covariance.names), at - record.model["reference_temperature"]["value"]
    mean = np.array([record.value(name) for name in names])
    drawn = rng.multivariate_normal(mean, record.cov(*names), size=20_000)

    def law(values, label):
        own = [k for k, name in enumerate(names) if name == label or name.startswith(f"{label}_t")]
        return sum(values[:, k, None] * t**power for power, k in enumerate(own))

    up = rng.standard_normal((len(drawn), 3))
    f = G * up / np.linalg.norm(up, axis=1)[:, None]
    errors = np.zeros((len(drawn), 3, 3))
    for k in range(3):
        now, true = ({name: law(each, name)[:, k] for name in NAMES} for each in (drawn, mean[None]))
        sensed = np.stack([
            f[:, 0],
            true["misalignment_yx"] * f[:, 0] + f[:, 1],
            true["misalignment_zx"] * f[:, 0] + true["misalignment_zy"] * f[:, 1] + f[:, 2],
        ])  # fmt: skip
        read = [true[f"scale_factor_{a}"] * (sensed[i] + true[f"bias_{a}"]) for i, a in enumerate("xyz")]
        x, y, z = (read[i] / now[f"scale_factor_{a}"] - now[f"bias_{a}"] for i, a in enumerate("xyz"))
        y = y - now["misalignment_yx"] * x
        z = z - now["misalignment_zx"] * x - now["misalignment_zy"] * y
        errors[:, k] = np.stack([x, y, z], axis=1) - f
    np.testing.assert_allclose(deviation_of_force(record, at), np.sqrt(np.mean(errors**2, axis=(0, 2))), rtol=0.03)
    assert "Standard deviation of the corrected force over temperature" in report_of(record, tmp_path)


@pytest.mark.slow
def test_a_misalignment_that_attitudes_at_one_temperature_do_not_show_is_named():
    made = {ramps: il.simulate_thermal(ramps=ramps, turn_on="0", seed=2) for ramps in (3, 4)}
    given = {ramps: [each for each in m if "ramp" in each.name or "25" in each.name] for ramps, m in made.items()}
    few, more = (il.fit_thermal(given[ramps], turn_on_scatter="0.1 mg").calibration for ramps in (3, 4))
    said = "the holds do not tell whether misalignment follows the temperature"
    assert few.model["degrees"]["misalignment"] == 0
    assert any(said in warning for warning in few.warnings)
    assert more.model["degrees"]["misalignment"] == 1
    assert not any(said in warning for warning in more.warnings)


def test_a_thermometer_in_whole_kelvins_widens_what_each_recording_gives_alone(reduced):
    """Points are drawn where the thermometer reads, half a kelvin off at most: 0.3 mg/K of bias moves them so far."""
    trials = 3 if reduced else 6
    standard = []
    for seed in range(trials):
        rng = np.random.default_rng([43, seed])
        triad, made = reference.Triad(rng), []
        for at in np.array([-20.0, 0.0, 20.0, 40.0, 60.0]) + rng.uniform(-0.5, 0.5, 5):
            outputs = np.array([triad.output(G * u, at) for u in reference.directions(rng, 24)])
            outputs += NOISE * G * rng.standard_normal(outputs.shape)
            columns = {f"accel_{a}": outputs[:, k] for k, a in enumerate("xyz")}
            columns |= {f"std_{name}": np.full(24, NOISE * G) for name in columns}
            units = dict.fromkeys(columns, "m/s^2") | {"temperature": "degC"}
            columns["temperature"] = np.full(24, round(at))
            made.append(il.Recording(columns, units, {"gravity": f"{G} m/s^2"}, f"soak_{round(at)}"))
        alone = il.fit_thermal(made, degrees="3,2,1").calibration.data["calibrations"]
        for reading, row, u in zip(alone["temperature"], alone["values"], alone["standard_uncertainty"], strict=True):
            standard += [(row[k] - triad.at(reading)[0][k]) / u[k] for k in range(3)]
    assert 0.7 < np.sqrt(np.mean(np.square(standard))) < 1.3

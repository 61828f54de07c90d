"""What each recording gives alone, beside the laws: held against a tumble calibration of that recording."""

import numpy as np
import pytest

import imulab as il
from imulab.procedures.thermal.record import deviation_of_force, gyro_scale_predicted
from reference import thermal as reference

G = reference.G
NOISE = 60e-6
NAMES = [
    *(f"bias_{a}" for a in "xyz"),
    *(f"scale_factor_{a}" for a in "xyz"),
    *(f"misalignment_{ij}" for ij in ("yx", "zx", "zy")),
]


def soaks(attitudes, offset=0.0):
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
    _, given = soaks(24)
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
    triad, given = soaks(24, offset=3e-4)
    record = il.fit_thermal(given, degrees="3,2,1", gravity=f"{G}+-0").calibration
    alone = record.data["calibrations"]
    truth = np.array([np.concatenate(triad.at(at)) for at in alone["temperature"]])
    truth[:, :3] += np.outer(np.arange(5) == 2, np.full(3, 3e-4 * G))
    standard = (np.array(alone["values"]) - truth) / np.array(alone["standard_uncertainty"])
    assert 18 < (standard**2).sum() < 85  # chi-square of 45: 1 in 10,000 either way
    assert "Points: what each recording at a steady temperature gives alone" in report_of(record, tmp_path)


def test_too_few_attitudes_give_none(tmp_path):
    record = il.fit_thermal(soaks(8)[1], degrees="1,0,0").calibration
    assert "calibrations" not in record.data
    assert "Points: what each" not in report_of(record, tmp_path)


def test_scale_factors_of_gyroscopes_are_drawn_over_temperature(tmp_path):
    made = il.simulate_thermal((-20, 0, 20, 40, 60), attitudes=14, gyro=True, seed=3)
    record = il.fit_thermal(list(made), with_="gyro").calibration
    at = np.array(record.model["range"])
    values, u = gyro_scale_predicted(record, at)
    for k, axis in enumerate("xyz"):
        names = [n for n in record.parameters if n.startswith(f"gyro_scale_factor_{axis}")]
        powers = (at - record.model["reference_temperature"]["value"])[:, None] ** np.arange(len(names))
        np.testing.assert_allclose(values[k], powers @ [record.value(n) for n in names], rtol=1e-12)
        expected = np.sqrt(np.einsum("ni,ij,nj->n", powers, record.cov(*names), powers))
        np.testing.assert_allclose(u[k], expected, rtol=1e-6)
    assert "Scale factor of the gyroscopes over temperature" in report_of(record, tmp_path)


def test_the_deviation_of_the_corrected_force_is_that_of_drawn_laws(tmp_path):
    """Laws drawn from the record's covariance correct the outputs of an ideal unit in all directions."""
    _, given = soaks(24, offset=3e-4)
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

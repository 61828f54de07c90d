"""The uncertainty of a mean at rest, from the noise of a log ten times as long, and of the stretch itself."""

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.errors import RecordError
from imulab.estimation.column_noise import columns_noise
from imulab.estimation.distributions import normal_cdf
from imulab.records.mean_noise import mean_uncertainties
from reference import noise as reference

COUNT, INTERVAL, WHITE = 20_000, 0.1, 0.1
MEAN = COUNT // 10
TRUTHS = {
    "white": {"N": WHITE},
    "walk": {"N": WHITE, "K": np.sqrt(3) * WHITE / 100},
    "1/f": {"N": WHITE, "B": WHITE / np.sqrt(2 * np.log(2) / np.pi * 30)},
    "Gauss-Markov": {"N": WHITE, "G": (np.sqrt(0.1) * WHITE, 100.0)},
}


def true_uncertainty(kind, duration):
    """Of a mean as the document has it: Allan variance of 1/f noise and walk, variance of a Gauss-Markov mean."""
    square, truth = WHITE**2 / duration, TRUTHS[kind]
    square += truth.get("B", 0.0) ** 2 * 2 * np.log(2) / np.pi + truth.get("K", 0.0) ** 2 * duration / 3
    if "G" in truth:
        sigma, time = truth["G"]
        x = duration / time
        square += 2 * sigma**2 / x**2 * (x - 1 + np.exp(-x))
    return np.sqrt(square)


def ratios(kind, count, duration, trials, seed=1):
    """Stated over true uncertainty of means over a duration, from records of `count` samples drawn in time."""
    rng = np.random.default_rng(seed)
    samples = [reference.draw(rng, TRUTHS[kind], count, INTERVAL) for _ in range(trials)]
    found = columns_noise(samples, 1 / INTERVAL)
    return np.array([each.mean_uncertainty(duration) for each in found]) / true_uncertainty(kind, duration)


@pytest.mark.slow
@pytest.mark.parametrize("kind", TRUTHS)
def test_a_log_ten_times_as_long_tells_the_uncertainty_of_a_mean(kind):
    """Of a true normal error 2u cover so much, u being what each log says."""
    found = ratios(kind, COUNT, MEAN * INTERVAL, 25)
    assert np.mean(2 * normal_cdf(2 * found) - 1) >= 0.9
    if kind == "white":
        assert np.median(found) <= 1.05


def test_of_white_noise_a_stretch_tells_its_own_mean():
    found = ratios("white", MEAN, MEAN * INTERVAL, 25)
    assert 0.95 <= np.median(found) <= 1.6  # 5 with the guard against noise that does not show
    assert np.mean(2 * normal_cdf(2 * found) - 1) >= 0.9


def noise_record(kind, seed=1, names=("gyro_1",), terms="auto", count=COUNT, scale=1.0, **head):
    rng = np.random.default_rng(seed)
    columns = {name: scale * reference.draw(rng, TRUTHS[kind], count, INTERVAL) for name in names}
    units = dict.fromkeys(columns, "rad/s") | {"time": "s"}
    log = il.Recording({"time": INTERVAL * np.arange(count), **columns}, units, head)
    return il.fit_noise(log, terms=terms).calibration


@pytest.mark.parametrize("kind", ["white", "walk"])
def test_a_noise_record_tells_the_uncertainty_of_a_mean(kind, reduced):
    trials = 3 if reduced else 8
    found = []
    for seed in range(trials):
        u, said = mean_uncertainties(noise_record(kind, seed), ["gyro_1"], MEAN * INTERVAL, "rad/s", {})
        assert not said
        found.append(float(u[0]) / true_uncertainty(kind, MEAN * INTERVAL))
    assert np.mean(2 * normal_cdf(2 * np.array(found)) - 1) >= 0.9
    if kind == "white":
        assert np.median(found) <= 1.05


def test_of_one_model_it_is_the_sum_of_its_terms_at_any_duration():
    record = noise_record("walk", terms="NK")
    white, walk = (record.value(f"gyro_1_{term}") for term in ("white", "walk"))
    for duration in (0.5, 3.0, 40.0, 130.0):
        (u,) = mean_uncertainties(record, ["gyro_1"], duration, "rad/s", {})[0]
        # The expectation of u^2 is larger than at the best parameters, by half the variance of its logarithm.
        assert 1 <= u / np.sqrt(white**2 / duration + walk**2 * duration / 3) < 1.05


def array_at_rest(count=MEAN):
    rng = np.random.default_rng(5)
    columns = {f"gyro_{k}": 1e-3 * reference.draw(rng, TRUTHS["walk"], count, INTERVAL) for k in (1, 2, 3)}
    units = dict.fromkeys(columns, "rad/s") | {"time": "s"}
    return il.Recording({"time": INTERVAL * np.arange(count), **columns}, units, {"serial": "A"}, name="still.csv")


@pytest.mark.slow
def test_an_array_takes_the_uncertainty_of_its_biases_from_a_noise_record(tmp_path, capsys):
    still = array_at_rest()
    record = noise_record("walk", 3, ("gyro_1", "gyro_2", "gyro_3"), scale=1e-3, serial="A")
    found = il.calibrate_array(still, noise=record).calibration
    expected, _ = mean_uncertainties(record, ["gyro_1", "gyro_2", "gyro_3"], MEAN * INTERVAL, "rad/s", {})
    stated = [found.parameter(f"bias_{k}").standard_uncertainty for k in (1, 2, 3)]
    assert stated == pytest.approx(expected, rel=1e-6)
    assert not any("slower noise" in line for line in found.warnings)
    alone = il.calibrate_array(still).calibration
    assert sum("--noise RECORD" in line for line in alone.warnings) == 1
    assert alone.verdict.state == "good"
    il.write_csv(still, tmp_path / "still.csv")
    record.save(tmp_path / "noise.json")
    command = ["array", "calibrate", str(tmp_path / "still.csv"), "--noise", str(tmp_path / "noise.json"), "-o"]
    assert main([*command, str(tmp_path / "a.json")]) == 0
    assert il.load(tmp_path / "a.json").parameters == found.parameters
    capsys.readouterr()
    assert main([*command, str(tmp_path / "noise.json")]) == 2
    assert "would overwrite" in capsys.readouterr().err


@pytest.mark.slow
def test_noise_records_that_do_not_serve_are_refused_or_said():
    still = array_at_rest()
    with pytest.raises(RecordError, match="no column gyro_2; its columns: gyro_1"):
        il.calibrate_array(still, noise=noise_record("white"))
    with pytest.raises(RecordError, match="expected a record of imulab noise fit, found a gyro_array record"):
        il.calibrate_array(still, noise=il.calibrate_array(still).calibration)
    with pytest.raises(RecordError, match="gyro_1 of the record is in rad/s; expected m/s"):
        mean_uncertainties(noise_record("white"), ["gyro_1"], 10.0, "m/s^2", {})
    short = noise_record("white", 2, ("gyro_1", "gyro_2", "gyro_3"), count=MEAN, scale=1e-3, serial="B")
    warnings = il.calibrate_array(still, noise=short).calibration.warnings
    assert any("the record is of 200 s, and noise that is slower does not show in it" in line for line in warnings)
    assert any("the record is of serial B, the recording of A" in line for line in warnings)


@pytest.mark.slow
def test_the_zeros_of_a_triad_are_no_more_certain_than_its_noise_record_says():
    recording = il.simulate_tumble(gravity=9.81)
    accelerometers = il.fit_tumble(recording, order=1, gravity=9.81).calibration
    alone = il.fit_gyro(accelerometers, recording).gyro
    names = [f"gyro_{axis}" for axis in "xyz"]
    louder = noise_record("walk", 7, names)
    found = il.fit_gyro(accelerometers, recording, noise=louder)
    least = np.sqrt(np.diag(found.gyro.covariance)[9:])
    attitudes = il.find_attitudes(recording)
    resting = float((attitudes.stop - attitudes.start).sum())
    expected, _ = mean_uncertainties(louder, names, resting, "rad/s", {})
    assert (expected > np.sqrt(np.diag(alone.covariance)[9:])).all()
    assert least == pytest.approx(expected, rel=0.05)

"""Whether a log agrees with a record of noise: false alarms, what is found, and what is said of it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

import imulab as il
from conftest import some_of
from imulab.cli import main
from imulab.errors import DataError, OptionError, RecordError, UnitError
from imulab.estimation.noise.agreement import agreement
from imulab.estimation.noise.spectrum import transformed
from imulab.estimation.noise.terms import prepare
from imulab.procedures.noise.check import times
from noise_models import empty
from reference import noise as reference

NOISE = {"white": "0.3 deg/sqrt(h)", "walk": "60 deg/h/sqrt(h)", "rate": "50 Hz"}


def spectra(rng, count, **terms):
    """Of samples at 2 Hz, drawn in time by the reference."""
    return transformed(reference.draw(rng, terms, count, 0.5, burn=count), 0.5).spectra


def share(rejected, trials, limit):
    """Whether so many of so many trials can be of a rate, at one in a thousand on each side."""
    return binom.cdf(rejected, trials, limit) > 1e-3 < binom.sf(rejected - 1, trials, limit)


TRUTHS = ({"N": 1.0}, {"N": 1.0, "K": 0.03}, {"N": 1.0, "B": 0.2}, {"N": 1.0, "G": (0.5, 40.0)})


def probabilities(truth, other, trials, seed=1):
    rng = np.random.default_rng(seed)
    pairs = ((spectra(rng, 12_000, **truth), spectra(rng, 6_000, **other)) for _ in range(trials))
    return np.array([agreement(a, b, 0.5).probability for a, b in pairs])


@pytest.mark.slow
@pytest.mark.parametrize("truth", TRUTHS, ids=["".join(truth) for truth in TRUTHS])
def test_logs_of_the_same_noise_fail_as_often_as_is_said(truth, request):
    """Logs of four noises, drawn in the time domain."""
    trials = 12 if request.config.getoption("--reduced") else 400
    p = probabilities(truth, truth, trials, 7)
    for limit in (0.01, 0.05, 0.5):
        assert share(np.count_nonzero(p < limit), trials, limit)


@pytest.mark.slow
def test_a_larger_noise_is_found():
    """Of 6,000 samples u(N)/N is .9 %, of the record .6 %: 5 % are 4.3 of both; the walk's 20 % and 14 %."""
    assert np.mean(probabilities(TRUTHS[1], {"N": 1.05, "K": 0.03}, 4) < 0.05) >= 0.75
    assert np.mean(probabilities(TRUTHS[1], {"N": 1.0, "K": 0.09}, 4) < 0.05) >= 0.85


def test_a_tolerance_lets_small_changes_pass():
    rng = np.random.default_rng(5)
    record, log = spectra(rng, 200_000, N=1.0), spectra(rng, 200_000, N=1.01)
    exact = agreement(record, log, 0.5).probability
    lenient = agreement(record, log, 0.5, tolerance=0.02).probability
    assert exact < 0.01
    assert lenient > 0.05


def drawn(rng, count, logs, size):
    """Spectra at 100 Hz, N = `size` and a walk, as squares of normal variables about the variances of the model."""
    spectrum = empty(count, 0.01)
    variance = prepare([spectrum]).variances(np.array([[size, 0.0, 0.002, 0, 0, 0, 0, 0]]))[0]
    used = np.maximum(spectrum.freedom, 1)
    return [replace(spectrum, power=variance * rng.chisquare(used) / used) for _ in range(logs)]


@pytest.mark.slow
@pytest.mark.parametrize(("count", "logs"), [(10_000_000, 1), (1_000_000, 10)])
@pytest.mark.parametrize(
    ("change", "passes"), some_of(3, [(0.009, True), (-0.009, True), (0.012, False), (0.006, True)])
)
def test_long_and_many_logs_keep_to_the_tolerance(count, logs, change, passes):
    """u(N)/N of 1e7 samples is 0.02 %: less than 1 % always passes, and 1.2 % is found."""
    rng = np.random.default_rng(logs)
    first, second = drawn(rng, count, logs, 1.0), drawn(rng, count, logs, 1.0 + change)
    found = agreement(first, second, 50.0, tolerance=0.01)
    assert (found.probability > 0.2) == passes
    assert (found.probability < 1e-6) == (not passes)
    assert np.sqrt(found.octaves.ratio[-1]) == pytest.approx(1 + change, abs=0.002)


@pytest.fixture(scope="module")
def record():
    return il.fit_noise(il.simulate_noise(**NOISE, duration="15 min")).calibration


def simulated(seed=2, **more):
    return il.simulate_noise(**{**NOISE, "duration": "10 min", **more}, seed=seed)


@pytest.mark.slow
def test_an_unchanged_unit_passes(record):
    found = il.check_noise(record, simulated())
    assert found.passed
    assert found.probability > 0.05
    assert not any(map(found.differs, found.columns))


@pytest.mark.slow
def test_what_changed_is_said_with_its_interval(record):
    louder = simulated(white="0.33 deg/sqrt(h)")
    found = il.check_noise(record, louder)
    assert not found.passed
    change = next(each for each in found.columns["gyro_x"].changes if each.term == "white")
    assert change.low < 1.1 < change.high
    assert change.high - change.low < 0.05
    assert "angle random walk 10 % larger (" in repr(found) or "angle random walk 9 % larger (" in repr(found)


@pytest.mark.slow
def test_one_column_of_several_is_named(record):
    log = simulated()
    wild = simulated(walk="300 deg/h/sqrt(h)")
    mixed = log.with_columns({"gyro_y": wild.column("gyro_y")}, {"gyro_y": "deg/s"})
    found = il.check_noise(record, mixed)
    assert [name for name in found.columns if found.differs(name)] == ["gyro_y"]
    # Of k columns the least p is worth 1 - (1 - p)^k.
    least = found.columns["gyro_y"].probability
    assert found.probability == pytest.approx(1 - (1 - least) ** 3, abs=1e-12)


def test_noise_that_the_model_has_not_got_is_found(record):
    """Vibration of half an octave, 30 % of the white noise there, is no term of any model."""
    log = simulated()
    x = log.column("gyro_x")
    f = np.fft.rfftfreq(len(x), 0.02)
    hum = np.fft.irfft(np.fft.rfft(np.random.default_rng(3).standard_normal(len(x))) * ((f > 3.5) & (f < 5)), len(x))
    found = il.check_noise(record, log.with_columns({"gyro_x": x + 0.6 * np.std(x) * hum}, {"gyro_x": "deg/s"}))
    assert found.differs("gyro_x")
    assert "noise from 3.1 to 6.2 Hz" in found.columns["gyro_x"].text()


@pytest.mark.slow
def test_several_logs_add_up_and_files_are_taken(record, tmp_path):
    for seed in (2, 3):
        il.write_csv(simulated(seed), tmp_path / f"{seed}.csv")
    found = il.check_noise(record, [tmp_path / "2.csv", tmp_path / "3.csv"])
    assert found.passed
    assert found.log.fit["logs"] == 2
    other = replace(il.read(tmp_path / "2.csv"), metadata={"serial": "B"})
    found = il.check_noise(replace(record, sensor={"serial": "A"}), other)
    assert any("is of serial B, the record of A" in note for note in found.notes)


@pytest.mark.parametrize(
    ("ratio", "text"),
    [
        ((1.1, 1.09, 1.112), "10 % larger (9 to 11 %)"),
        ((0.9, 0.88, 0.93), "10 % smaller (7 to 12 %)"),
        ((1.0004, 0.991, 1.01), "0.0 % larger (-0.9 to 1.0 %)"),
        ((2.1, 1.7, 2.6), "2.1 times the record's (1.7 to 2.6)"),
        ((0.8, 0.2, 3.0), "0.8 times the record's (0.2 to 3)"),
    ],
)
def test_ratios_in_words(ratio, text):
    assert times(*ratio) == text


@pytest.mark.parametrize(
    ("made", "options", "error", "message"),
    [
        (lambda: simulated(rate="20 Hz"), {}, DataError, "20 samples in a second, but the record is of 50; expected"),
        (lambda: simulated(white="100 ug/sqrt(Hz)", walk=None), {}, DataError, "none of the record's columns gyro_x"),
        (
            lambda: simulated(white="3 count/sqrt(Hz)", walk=None, columns="gyro_x"),
            {},
            UnitError,
            "column gyro_x in count, but the record has it in rad/s",
        ),
        (simulated, {"tolerance": "x"}, OptionError, "tolerance 'x': expected a fraction"),
        (simulated, {"tolerance": 1.5}, OptionError, "tolerance 1.5: expected a share from 0 to 1"),
        (simulated, {"false_alarm": 0.0}, OptionError, "false_alarm 0.0: expected a share between 0 and 1"),
        (lambda: simulated(duration="4 s"), {}, DataError, "200 samples in a row; expected at least 500"),
    ],
)
def test_what_cannot_be_is_refused(record, made, options, error, message):
    with pytest.raises(error) as refused:
        il.check_noise(record, made(), **options)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_the_command_says_pass_or_fail_first(record, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record.save("r.json")
    il.write_csv(simulated(columns="gyro_x"), "same.csv")
    il.write_csv(simulated(walk="600 deg/h/sqrt(h)", columns="gyro_x"), "other.csv")
    il.fit_tumble(il.simulate_tumble(gravity=9.81), gravity=9.81).save("t.json")
    assert main(["noise", "check", "r.json", "same.csv"]) == 0
    assert capsys.readouterr().out.startswith("pass: the log agrees with the noise of the record\np = ")
    assert main(["noise", "check", "r.json", "other.csv", "--report", "o.html"]) == 1
    said = capsys.readouterr().out
    assert said.startswith("fail: the noise is not that of the record; most in gyro_")
    assert "imulab noise fit other.csv -o NEW.json" in said
    page = (tmp_path / "o.html").read_text(encoding="utf-8")
    assert "Noise check: fail" in page
    assert "by octaves" in page
    assert main(["noise", "check", "r.json", "other.csv", "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert (found["verdict"], sorted(found["columns"])) == ("fail", ["gyro_x"])
    for words, message in (
        (["t.json", "same.csv"], "t.json: a tumble record holds no model of noise; expected a record of noise fit"),
        (["same.csv", "same.csv"], "same.csv: not a calibration record"),
        (["r.json", "same.csv", "--false-alarm", "2"], "--false-alarm 2: expected a share between 0 and 1"),
        (["r.json", "same.csv", "--report", "r.json"], "r.json: would overwrite r.json"),
        (["r.json", "none.csv"], "none.csv"),
    ):
        assert main(["noise", "check", *words]) == 2
        captured = capsys.readouterr()
        assert (captured.out, captured.err.count("\n")) == ("", 1)
        assert message in captured.err


def test_a_record_of_another_procedure_is_refused():
    tumble = il.fit_tumble(il.simulate_tumble(gravity=9.81), gravity=9.81).calibration
    with pytest.raises(RecordError, match="a tumble record holds no model of noise"):
        il.check_noise(tumble, simulated(duration="10 s"))

"""The noise procedure: from logs at rest to records, reports, comparisons and fleets; what it refuses."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import t as student

import imulab as il
from imulab.cli import main
from imulab.errors import DataError, OptionError, RecordError, UnitError
from imulab.estimation.noise.simulate import simulated
from imulab.procedures.noise.figures import exhibits
from imulab.procedures.views import render_record
from imulab.records.calibration import sealed_text
from noise_models import AUTO, IN_TIME
from reference import noise as reference

DEGREE = np.pi / 180


COUNT = 60_000


def samples(seed, count=COUNT, interval=0.01, **sizes):
    return np.concatenate(list(simulated(sizes, interval, count, seed)))


def log(seed=11, count=COUNT, unit="deg/s", **more):
    """A gyro of white noise and walk, an accelerometer of white noise: degrees and m/s^2."""
    columns = {
        "time": 0.01 * np.arange(count),
        "gyro_x": samples(seed, count, white=0.005, walk=0.001),
        "accel_z": 9.81 + samples(seed + 50, count, white=0.001),
        **more,
    }
    units = {"time": "s", "gyro_x": unit, "accel_z": "m/s^2", "temperature": "degC"}
    return il.Recording(columns, {name: units.get(name, unit) for name in columns}, {"serial": "N-1"}, name="rest.csv")


@pytest.fixture(scope="module")
def fit():
    return il.fit_noise(log())


@pytest.fixture(scope="module")
def record(fit):
    return fit.calibration


def test_terms_have_values_intervals_and_si_units(record):
    white, walk = (record.parameter(f"gyro_x_{term}") for term in ("white", "walk"))
    assert (white.unit, walk.unit) == ("rad/s/sqrt(Hz)", "rad/s/sqrt(s)")
    for parameter, truth in ((white, 0.005 * DEGREE), (walk, 0.001 * DEGREE)):
        low, high = parameter.interval_95
        assert low < truth < high
        assert abs(parameter.value - truth) < 4 * parameter.standard_uncertainty
    # u(N)/N = 1/sqrt(2n), n coefficients: half of the samples, as the band ends at half of what there is.
    assert white.standard_uncertainty / white.value == pytest.approx(1 / np.sqrt(COUNT), rel=0.15)
    assert record.model["terms"] == {"gyro_x": "NK", "accel_z": "N"}


def test_a_term_that_is_not_seen_has_a_limit(record):
    absent = record.parameter("accel_z_walk")
    assert (absent.value, absent.standard_uncertainty) == (0.0, None)
    low, high = absent.interval_95
    # No record shows a walk below about 11 N/L.
    assert low == 0
    assert 1 < high / (0.001 / (0.01 * COUNT)) < 30


def test_what_a_filter_wants_of_white_noise_and_walk_is_these(record):
    """Of N and K the walk over any horizon is K, and the white noise N."""
    for name, truth in (("filter_white", 0.005 * DEGREE), ("filter_walk", 0.001 * DEGREE)):
        found = record.fit[name]["gyro_x"]
        low, high = found["interval_95"]
        assert low < truth < high
    assert record.fit["horizon"] == {"value": 10.0, "unit": "s"}
    assert record.fit["band"]["gyro_x"] == {"value": 25.0, "unit": "Hz"}
    assert record.fit["test"]["gyro_x"] > 0.01


def test_the_uncertainty_of_a_mean_is_that_of_white_noise(record):
    """Of an accelerometer of white noise alone u is N/sqrt(t)."""
    bias = record.fit["bias_uncertainty"]["accel_z"]
    t, u = (np.array(bias[key]["value"]) for key in ("time", "standard_uncertainty"))
    assert t[-1] == pytest.approx(60)
    np.testing.assert_allclose(u, 0.001 / np.sqrt(t), rtol=0.25)


def test_what_is_as_fast_as_the_end_of_the_band_is_white_noise():
    """Noise of 0.05 s is white to all that is slower: N^2 + 2 S^2 T; the walk beside it stays what it is."""
    fast = 0.005 * np.sqrt(0.3 / 2 / 0.05)
    x = samples(3, 360_000, white=0.005, gm1_sigma=fast, gm1_time=0.05, walk=5e-4)
    found = il.fit_noise(
        il.Recording({"time": 0.01 * np.arange(len(x)), "gyro_x": x}, {"time": "s", "gyro_x": "deg/s"})
    )
    record = found.calibration
    assert record.fit["columns"]["gyro_x"]["chosen"] == "NGK"
    assert record.model["terms"] == {"gyro_x": "NK"}
    assert list(record.parameters) == ["gyro_x_white", "gyro_x_flicker", "gyro_x_walk"]
    white, walk = (record.parameter(f"gyro_x_{term}") for term in ("white", "walk"))
    truth = 0.005 * DEGREE * np.sqrt(1.3)
    assert white.value == pytest.approx(truth, rel=0.04)  # the shortest time constant that is allowed is 0.08 s
    assert white.interval_95[1] / white.value == pytest.approx(np.exp(1.96 * white.standard_uncertainty / white.value))
    assert record.fit["filter_white"]["gyro_x"]["value"] == pytest.approx(white.value, rel=0.01)
    assert record.fit["filter_walk"]["gyro_x"]["value"] == pytest.approx(5e-4 * DEGREE, rel=0.35)
    assert walk.interval_95[0] < 5e-4 * DEGREE < walk.interval_95[1]
    (note,) = (line for line in record.warnings if "end of the band" in line)
    assert note.startswith("gyro_x: the white noise, 0.351 deg/sqrt(h) at low frequencies, falls to 0.302")
    drawn = {trace.get("name") for item in exhibits(record).items for trace in getattr(item, "traces", [])}
    assert {"white", "walk"} < drawn
    assert "Gauss-Markov" not in drawn


def test_the_record_comes_back_from_its_file(fit, tmp_path):
    fit.save(tmp_path / "n.json")
    again = il.load(tmp_path / "n.json")
    assert again == fit.calibration
    assert again.parameter("gyro_x_walk").interval_95 == fit.calibration.parameter("gyro_x_walk").interval_95
    assert render_record(again) == render_record(fit.calibration)


def test_an_interval_that_misses_its_value_is_refused(record, tmp_path):
    content = json.loads(record.to_json())
    content["parameters"]["gyro_x_white"]["interval_95"] = [1.0, 2.0]
    content.pop("content_sha256")
    (tmp_path / "n.json").write_text(sealed_text(content)[1])
    with pytest.raises(il.ImulabError, match="gyro_x_white: interval_95 from 1 to 2"):
        il.load(tmp_path / "n.json")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["fit"]["columns"]["gyro_x"].update(unit=3), r"fit.columns.gyro_x.unit: expected a text"),
        (lambda c: c["data"]["columns"]["gyro_x"]["spectra"][0]["power"].pop(), r"spectra\[0\]"),
        (lambda c: c["data"]["columns"].pop("gyro_x"), "lacks data.columns.gyro_x.spectra"),
        (lambda c: c["data"]["columns"]["gyro_x"]["allan"]["low"].pop(), r"allan"),
    ],
)
def test_a_record_that_was_made_up_wrongly_is_refused(record, tmp_path, change, message):
    content = json.loads(record.to_json())
    content.pop("content_sha256")
    change(content)
    (tmp_path / "n.json").write_text(sealed_text(content)[1])
    with pytest.raises(il.ImulabError, match=message):
        il.load(tmp_path / "n.json")


def test_the_table_of_models_names_next_what_the_choice_found_next():
    """Least deviance plus 4 a parameter, whatever the weights; here a model weighs more than the one that is chosen."""
    log = il.simulate_noise(white="0.3 deg/sqrt(h)", flicker="12 deg/h", walk="60 deg/h/sqrt(h)", duration="30 min",
                            rate=50.0)  # fmt: skip
    fit = il.fit_noise(log)
    (table,) = (each for each in exhibits(fit.calibration).items if each.title == "Models")
    heavier = 0
    for name, chosen, following, weights, *_ in table.rows:
        found = fit.calibration.fit["columns"][name]["candidates"]
        price = {
            each["model"]: each["deviance"] + 4 * (len(each["model"]) + each["model"].count("G")) for each in found
        }
        first, second = sorted(price, key=price.get)[:2]
        assert (chosen, following) == (first, f"{second} +{price[second] - price[first]:.1f}")
        weight = {each["model"]: f"{each['model']} {each['weight']:.0%}" for each in found}
        assert weights.split(", ")[0] == weight[chosen]
        heavier += len(weights.split(", ")) - 1
        assert weights.split(", ")[-1] == max(weight.values(), key=lambda text: int(text.split()[1][:-1]))
    assert heavier > 0


def test_several_logs_add_up(record):
    both = il.fit_noise([log(1), log(2)]).calibration
    ratio = (
        both.parameter("accel_z_white").standard_uncertainty / record.parameter("accel_z_white").standard_uncertainty
    )
    assert ratio == pytest.approx(1 / np.sqrt(2), rel=0.15)
    assert both.fit["logs"] == 2


@pytest.mark.slow
def test_two_records_are_compared(record):
    other = il.fit_noise(log(7)).calibration
    noisier = il.Recording(
        {name: column * (1.0 if name == "time" else 1.05) for name, column in log(7).columns.items()},
        log().units,
        log().metadata,
        name="noisier.csv",
    )
    same = il.compare_records(record, other)
    changed = il.compare_records(record, il.fit_noise(noisier).calibration)
    assert not any(change.significant for change in same.changes)
    assert {"gyro_x_white", "accel_z_white"} <= {change.name for change in changed.changes if change.significant}


def test_magnetometers_that_are_left_out_are_named():
    made = il.simulate_noise(white="0.3 deg/sqrt(h)", duration="1 min", columns=["gyro_x"])
    field = {"mag_x": 50 + 0.1 * np.random.default_rng(1).standard_normal(len(made))}
    both = made.with_columns(field, {"mag_x": "uT"})
    record = il.fit_noise(both).calibration
    assert "mag_x: magnetometers are not fitted unless --columns names them" in record.warnings
    assert record.verdict.state == "good"
    assert "mag_x_white" in il.fit_noise(both, columns=["mag_x"]).calibration.parameters


def test_like_is_compared_with_like():
    """Between models of other terms only the white noise means the same, and not beside Gauss-Markov noise."""
    made = il.simulate_noise(white="0.3 deg/sqrt(h)", walk="30 deg/h/sqrt(h)", duration="5 min", columns=["gyro_x"])
    walk, flicker, markov = (il.fit_noise(made, terms=terms).calibration for terms in ("NK", "NB", "NG"))
    compared = il.compare_records(walk, flicker)
    assert [change.name for change in compared.changes] == ["gyro_x_white"]
    assert compared.probability > 0.01
    assert {"gyro_x_walk", "gyro_x_flicker"} <= set(compared.left_out)
    assert len(il.compare_records(walk, walk).changes) >= 2
    with pytest.raises(RecordError, match=r"no parameter that means the same in both: .*gyro_x NK and NG"):
        il.compare_records(walk, markov)


@pytest.mark.slow
def test_drift_with_temperature_is_told_apart_and_taken_out():
    t = np.arange(COUNT) / COUNT
    temperature = 25 + 3 * np.sin(2 * np.pi * 1.5 * t) + t
    drifting = log(temperature=temperature)
    drifting = drifting.with_columns({"gyro_x": 0.02 * temperature + samples(3, white=0.005)}, {"gyro_x": "deg/s"})
    said = il.fit_noise(drifting, columns=["gyro_x"]).calibration
    assert any("follows the temperature" in warning and "--regress temperature" in warning for warning in said.warnings)
    (found,) = [each for each in said.fit["columns"]["gyro_x"]["drifts"] if each["follows"] == "temperature"]
    slope = found["slope"]
    assert abs(slope["value"] - 0.02 * DEGREE) < 4 * slope["standard_uncertainty"]
    assert slope["unit"] == "(rad/s)/K"
    left = il.fit_noise(drifting, columns=["gyro_x"], regress="temperature").calibration
    assert left.model["terms"]["gyro_x"] == "N"
    assert said.model["terms"]["gyro_x"] != "N"


def columns_of(disturbance, seed=0, count=60_000):
    """Three gyroscopes of 0.005 deg/s/sqrt(Hz) at 100 Hz."""
    rng = np.random.default_rng([seed, 19])
    t = np.arange(count) / 100
    made = {f"gyro_{axis}": 0.05 * rng.standard_normal(count) + disturbance(t, rng) for axis in "xyz"}
    units = {"time": "s"} | dict.fromkeys(made, "deg/s")
    return il.Recording({"time": t, **made}, units, name="log")


def vibration(t, rng):
    """A resonance whose size swings: by sidebands it is no line."""
    swing = 1 + 0.6 * np.sin(2 * np.pi * t / 50 + rng.uniform(0, 6))
    return rng.uniform(0.05, 0.3) * swing * np.sin(2 * np.pi * rng.uniform(8, 15) * t)


def narrow_band(t, rng):
    frequency = rng.uniform(8, 15)
    p = np.exp(-2 * np.pi * 0.02 * frequency / 100)
    y = lfilter([1], [1, -2 * p * np.cos(2 * np.pi * frequency / 100), p * p], rng.standard_normal(len(t)))
    return 0.2 * y / y.std()


@pytest.mark.parametrize("disturbance", [vibration, narrow_band])
def test_vibration_is_no_change_of_level(disturbance):
    record = il.fit_noise(columns_of(disturbance, count=30_000)).calibration
    assert not any("level changes" in line for line in record.warnings)


@pytest.mark.slow
def test_a_small_step_is_named_and_not_only_a_random_walk():
    """.006 deg/s, 13 standard uncertainties: a model of white noise and walk took it for walk without a word."""
    record = il.fit_noise(columns_of(lambda t, _: np.where(t > 250, 0.006, 0.0))).calibration
    for column in ("gyro_x", "gyro_y", "gyro_z"):
        (step,) = record.fit["columns"][column]["steps"]
        assert step["time"]["value"] == pytest.approx(250, abs=10)
        assert step["size"]["value"] == pytest.approx(np.radians(0.006), rel=0.35)
    taken = il.fit_noise(columns_of(lambda t, _: np.where(t > 250, 0.006, 0.0)), steps="remove").calibration
    assert set(taken.model["terms"].values()) == {"N"}


@pytest.mark.parametrize("seed", [1, 2])
def test_a_temperature_in_whole_degrees_gives_the_slope_and_says_what_it_hides(seed):
    """Regression on the steps themselves gives a thirteenth of the slope."""
    rng = np.random.default_rng(seed)
    t = np.arange(40_000) / 20
    temperature = 25 + rng.uniform() + 2 * np.sin(2 * np.pi * t / 1500 + rng.uniform(0, 6))
    slope = 108 * DEGREE / 3600
    rate = 0.0004 * rng.standard_normal(len(t)) + slope * temperature
    columns = {"time": t, "gyro_x": rate, "temperature": np.round(temperature + 0.02 * rng.standard_normal(len(t)))}
    log = il.Recording(columns, {"time": "s", "gyro_x": "rad/s", "temperature": "degC"}, name="log")
    record = il.fit_noise(log, regress="temperature").calibration
    (drift,) = (each for each in record.fit["columns"]["gyro_x"]["drifts"] if each["follows"] == "temperature")
    assert abs(drift["slope"]["value"] - slope) < 3 * drift["slope"]["standard_uncertainty"]
    assert drift["slope"]["value"] == pytest.approx(slope, rel=0.15)
    # The line through the changes of level is off by up to half a step: no random walk, and no doubt of a fit.
    assert any("in steps of 1 K show it: slow noise below " in warning for warning in record.warnings)
    assert record.verdict.state == "good"
    assert record.model["terms"] == {"gyro_x": "N"}
    assert (
        record.parameters["gyro_x_walk"].interval_95[1] > 3e-6
    )  # rad/s/sqrt(s): frequencies that would show it are out
    two = log.with_columns({"temperature": np.where(t < 900, 25.0, 26.0)}, {})
    with pytest.raises(DataError, match="by more than one step of its readings"):
        il.fit_noise(two, regress="temperature")


def test_a_walk_beyond_what_whole_degrees_hide_is_found():
    rng = np.random.default_rng(5)
    t = np.arange(40_000) / 20
    temperature = 25.3 + 2 * np.sin(2 * np.pi * t / 1500)
    walk = 2e-5 * np.cumsum(rng.standard_normal(len(t))) / np.sqrt(20)
    rate = 0.0004 * rng.standard_normal(len(t)) + 108 * DEGREE / 3600 * temperature + walk
    columns = {"time": t, "gyro_x": rate, "temperature": np.round(temperature + 0.02 * rng.standard_normal(len(t)))}
    log = il.Recording(columns, {"time": "s", "gyro_x": "rad/s", "temperature": "degC"}, name="log")
    walked = il.fit_noise(log, regress="temperature").calibration.parameters["gyro_x_walk"]
    assert walked.value == pytest.approx(2e-5, rel=0.4)
    assert walked.interval_95[0] > 5e-6


def test_noise_of_the_thermometer_leaves_no_walk_of_what_is_taken_out():
    """Under the walk of the raw column the slope leans to high frequencies, where the thermometer's noise is."""
    rng = np.random.default_rng(1)
    t = np.arange(40_000) / 20
    temperature = 25 + 2 * np.sin(2 * np.pi * t / 1500)
    slope = 108 * DEGREE / 3600
    rate = 0.0004 * rng.standard_normal(len(t)) + slope * temperature
    columns = {"time": t, "gyro_x": rate, "temperature": temperature + 0.02 * rng.standard_normal(len(t))}
    log = il.Recording(columns, {"time": "s", "gyro_x": "rad/s", "temperature": "degC"}, name="log")
    record = il.fit_noise(log, regress="temperature").calibration
    (drift,) = (each for each in record.fit["columns"]["gyro_x"]["drifts"] if each["follows"] == "temperature")
    assert drift["slope"]["value"] == pytest.approx(slope, rel=0.005)
    assert record.model["terms"] == {"gyro_x": "N"}


def test_a_ramp_is_a_parameter():
    ramp = log().with_columns({"gyro_x": samples(3, white=0.005) + 1e-4 * 0.01 * np.arange(COUNT)}, {"gyro_x": "deg/s"})
    found = il.fit_noise(ramp, columns=["gyro_x"], regress="time").calibration.parameter("gyro_x_ramp")
    assert found.unit == "rad/s^2"
    assert abs(found.value - 1e-4 * DEGREE) < 4 * found.standard_uncertainty


def test_several_steps_of_a_column_are_one_sentence():
    record = il.fit_noise(columns_of(lambda t, _: 0.03 * (t > 200) - 0.02 * (t > 400)), columns=["gyro_x"]).calibration
    assert len(record.fit["columns"]["gyro_x"]["steps"]) == 2
    (sentence,) = [each for each in record.warnings if "the level changes by" in each]
    assert "2 steps, 200 to 400 s: the level changes by up to 108 deg/h" in sentence


def test_spikes_lines_and_steps_are_counted_and_said():
    t = 0.01 * np.arange(COUNT)
    x = samples(5, white=0.005) + 0.02 * np.sin(2 * np.pi * 31 * t) + 0.03 * (t > 300)
    x[::5000] += 1.0
    odd = log().with_columns({"gyro_x": x}, {"gyro_x": "deg/s"})
    record = il.fit_noise(odd, columns=["gyro_x"]).calibration
    column = record.fit["columns"]["gyro_x"]
    assert column["spikes"] == 12
    assert column["lines"][0]["frequency"]["value"] == pytest.approx(31, abs=0.01)
    (step,) = column["steps"]
    assert step["time"]["value"] == pytest.approx(300, abs=1)
    assert step["size"]["value"] == pytest.approx(0.03 * DEGREE, rel=0.1)
    text = " ".join(record.warnings)
    for words in ("12 spikes replaced", "line", "the level changes by"):
        assert words in text
    assert record.verdict.state == "look"
    without = il.fit_noise(odd, columns=["gyro_x"], steps="remove").calibration
    assert without.model["terms"]["gyro_x"] == "N"


def test_a_model_that_does_not_fit_is_said(record):
    poor = il.fit_noise(log(), terms="N", columns=["gyro_x"]).calibration
    assert poor.fit["test"]["gyro_x"] < 0.01
    assert poor.verdict.state == "look"
    assert "no model of these terms fits" in poor.verdict.reasons[0]
    assert "gyro_x_walk" not in poor.parameters


def test_of_a_short_log_white_noise_and_limits_are_told():
    short = il.fit_noise(log(count=5000), columns=["gyro_x"]).calibration
    assert set(short.parameters) == {"gyro_x_white", "gyro_x_flicker", "gyro_x_walk"}
    assert [short.value(f"gyro_x_{term}") for term in ("flicker", "walk")] == [0, 0]
    assert any("below 100 s" in warning for warning in short.warnings)


def with_time(recording, change):
    time = recording.time.copy()
    change(time)
    return recording.with_columns({"time": time}, {"time": "s"})


def stuck(time):
    time[300] = time[299]


def moving(recording):
    x = recording.column("gyro_x") + 20 * np.sin(recording.time / 7)
    return recording.with_columns({"gyro_x": x}, {"gyro_x": "deg/s"})


def replaced(**columns):
    return log().with_columns(columns, dict.fromkeys(columns, "deg/s"))


@pytest.mark.parametrize(
    ("made", "options", "error", "message"),
    [
        (lambda: moving(log()), {}, DataError, "rest.csv: column gyro_x: .*did the unit move"),
        (lambda: log(count=400), {}, DataError, "400 samples in a row; expected at least 500"),
        (lambda: replaced(gyro_x=np.full(COUNT, 0.5)), {}, DataError, "gyro_x: all samples are 0.5 deg/s"),
        (lambda: replaced(gyro_x=np.minimum(samples(1, white=0.005), 0.03)), {}, DataError, "are at its limit"),
        (lambda: with_time(log(), stuck), {}, DataError, "row 301, column time: time stands still"),
        (
            lambda: il.Recording({"gyro_x": np.ones(600)}, {"gyro_x": "deg/s"}, name="x"),
            {},
            DataError,
            "no column time",
        ),
        (log, {"columns": ["gyro_q"]}, OptionError, "no column 'gyro_q'; expected one of gyro_x accel_z"),
        (log, {"terms": "NXB"}, OptionError, "terms 'NXB': expected auto, or N and any"),
        (log, {"terms": "K"}, OptionError, "terms 'K': expected auto, or N"),
        (log, {"horizon": 5000.0}, OptionError, "horizon 5000 s: expected at most the length of the record, 600 s"),
        (
            lambda: log(count=700),
            {"horizon": 10.0},
            OptionError,
            "horizon 10 s: expected at most .* 7 s in one stretch",
        ),
        (log, {"horizon": -1.0}, OptionError, "horizon -1 s: expected more than 0"),
        (log, {"band": 0.0}, OptionError, "band 0 Hz: expected more than 0"),
        (log, {"band": 1e-5}, OptionError, "band: expected 0.000833 Hz, the lowest frequency that these data show"),
        (log, {"regress": "pressure"}, OptionError, "regress 'pressure': expected one of time temperature"),
        (log, {"regress": "temperature"}, DataError, "rest.csv: regress temperature: expected a column temperature"),
        (log, {"steps": "keep"}, OptionError, "steps 'keep': expected one of say remove"),
        (lambda: [log(), log(unit="count")], {}, UnitError, "column gyro_x in count, but rest.csv has it in rad/s"),
        (lambda: [], {}, DataError, "found an empty list"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(made, options, error, message):
    with pytest.raises(error, match=message) as refused:
        il.fit_noise(made(), **options)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("words", "message"), [(["--horizon", "5000"], "--horizon 5000 s: expected at"), (["--band", "1e-5"], "--band: ex")]
)
def test_a_fit_calls_options_as_they_are_typed(tmp_path, capsys, words, message):
    il.write_csv(log(), tmp_path / "rest.csv")
    assert main(["noise", "fit", str(tmp_path / "rest.csv"), *words]) == 2
    assert capsys.readouterr().err.startswith(f"imulab: {message}")


def test_arrays_and_files_are_taken_alike(tmp_path):
    il.write_csv(log(), tmp_path / "rest.csv")
    of_file = il.fit_noise(tmp_path / "rest.csv").calibration
    gyro = il.fit_noise({"gyro_x": log().column("gyro_x")}, rate=100.0, unit="deg/s").calibration
    assert gyro.value("gyro_x_white") == pytest.approx(of_file.value("gyro_x_white"), rel=1e-6)


@pytest.mark.slow
def test_it_goes_through_commands_and_a_fleet(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for k in (1, 2):
        il.write_csv(log(k + 9), f"{k}.csv")
    assert main(["noise", "fit", "1.csv", "-o", "1.json", "--report", "1.html"]) == 0
    assert "angle random walk" in capsys.readouterr().out
    assert main(["show", "1.json"]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("good")
    assert "velocity random walk" in shown
    assert main(["noise", "fit", "2.csv", "-o", "2.json"]) == 0
    capsys.readouterr()
    assert main(["show", "1.json", "2.json"]) == 0
    assert "deg/sqrt(h)" in capsys.readouterr().out
    assert main(["apply", "1.json", "1.csv", "-o", "o.csv"]) == 2
    assert "noise record cannot be applied: it says how large the noise is" in capsys.readouterr().err
    Path("line.csv").write_text("serial,procedure,file,horizon\nN-1,noise,1.csv,20 s\nN-1b,noise,2.csv,\n")
    main(["fleet", "run", "line.csv", "-o", "out", "--workers", "1"])
    assert "2 done" in capsys.readouterr().out
    assert il.load("out/N-1.json").fit["horizon"]["value"] == 20.0
    assert main(["fleet", "report", "out", "-o", "line.html"]) == 0
    assert "gyro_x_white" in Path("line.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("scale", "words"),
    [(1 / 57.3, "no usual gyroscope has steps of"), (1.0, "")],
)
@pytest.mark.slow
def test_a_doubted_unit_is_bad_and_survives_quiet(tmp_path, capsys, scale, words):
    """A bag in deg/s and g, read as rad/s and m/s^2, gives a filter noise that is 57 and 9.8 times off."""
    rng = np.random.default_rng(3)
    step = 250 / 32768
    columns = {"time": np.arange(6000) / 100}
    for k, axis in enumerate("xyz"):
        columns[f"gyro_{axis}"] = scale * step * np.round((0.2 + 0.05 * rng.standard_normal(6000)) / step)
        columns[f"accel_{axis}"] = 9.81 * scale**0 * (k == 2) + 0.01 * rng.standard_normal(6000)
    if words:
        columns["accel_z"] = columns["accel_z"] / 9.81
    units = {"time": "s"} | {name: "deg/s" if name[0] == "g" else "m/s^2" for name in columns if name != "time"}
    path = tmp_path / "log.csv"
    il.write(il.Recording(columns, units, name="log.csv"), path)
    verdict = il.fit_noise(path).calibration.verdict
    assert verdict.state == ("bad" if words else "good")
    assert main(["noise", "fit", str(path), "-q", "--for", "kalibr"]) == 0
    error = capsys.readouterr().err
    assert (words in error) if words else not error
    assert not words or "as g would be; is their unit, m/s^2, right?" in error


@pytest.mark.parametrize("target", ["c", "blob", "px4", "kalibr"])
def test_it_is_no_calibration_to_export(record, tmp_path, target, capsys):
    record.save(tmp_path / "n.json")
    assert main(["export", "--to", target, str(tmp_path / "n.json"), "-o", str(tmp_path / "fw")]) == 2
    message = capsys.readouterr().err
    assert "noise record" in message
    assert "use --to c" not in message
    assert not (tmp_path / "fw").exists()


def test_a_log_shorter_than_the_usual_horizon_is_fitted_to_its_own_length():
    rng = np.random.default_rng(3)
    record = il.fit_noise({"gyro": rng.standard_normal((600, 3))}, rate=100.0, unit="deg/s").calibration
    assert record.fit["horizon"]["value"] == pytest.approx(6.0)
    assert any("horizon 6 s: more than a tenth of the record" in note for note in record.warnings)


def test_an_output_of_coarse_steps_is_said():
    """Steps of 2.5 sigma add 14 % to the white noise."""
    rate = np.round(0.1 * np.random.default_rng(1).standard_normal((20_000, 1)) / 0.25) * 0.25
    record = il.fit_noise({"gyro_x": rate[:, 0]}, rate=100.0, unit="deg/s").calibration
    assert record.value("gyro_x_white") == pytest.approx(1.14 * 0.01 * DEGREE, rel=0.03)
    assert any("steps of 0.25 deg/s, 2.2 times the noise of a sample" in note for note in record.warnings)
    fine = np.round(rate / 0.01 + np.random.default_rng(2).standard_normal((20_000, 1)) * 10) * 0.01
    record = il.fit_noise({"gyro_x": fine[:, 0]}, rate=100.0, unit="deg/s").calibration
    assert not any("steps of" in note for note in record.warnings)


INTERVAL = 0.1


SIZE = 1 / np.sqrt(INTERVAL)


SMALL = 1e-3


def contaminated(name, seed, count=100_000):
    """White and slow noise with 0.1 % spikes of 20 sigma and three lines of half a sigma."""
    rng = np.random.default_rng([seed, 77])
    samples = reference.draw(rng, IN_TIME[name], count, INTERVAL)
    struck = rng.random(count) < 1e-3
    samples[struck] += 20 * SIZE * rng.choice([-1, 1], np.count_nonzero(struck))
    time = INTERVAL * np.arange(count)
    for frequency in (0.31, 1.7, 3.3):
        samples += 0.5 * SIZE * np.sin(2 * np.pi * frequency * time + rng.uniform(0, 2 * np.pi))
    return samples


def sizes(samples, terms):
    """The terms of samples whose white noise is 1, fitted as a thousandth of that in rad/s: no gyro is louder."""
    record = il.fit_noise({"gyro_x": SMALL * samples}, rate=1 / INTERVAL, unit="rad/s", terms=terms).calibration
    return {name.removeprefix("gyro_x_"): each.value / SMALL for name, each in record.parameters.items()}, record


@pytest.mark.slow
@pytest.mark.parametrize(("name", "term", "within"), [("N B", "flicker", 0.03), ("N K", "walk", 0.05)])
def test_spikes_and_lines_change_neither_white_nor_slow_noise(name, term, within, reduced):
    """N within 0.5 % and B within 3 % (K: one log tells it to 14 %), whatever is on top."""
    trials = 6 if reduced else 60
    found = [sizes(contaminated(name, seed), name.replace(" ", ""))[0] for seed in range(trials)]
    white = np.array([each["white"] for each in found])
    slow = np.array([each[term] for each in found]) / AUTO[name][1 if term == "flicker" else 2]
    print(name, "N", white.mean(), "slow", slow.mean())
    assert abs(white.mean() - 1) < 0.005
    assert abs(np.log(slow).mean()) < within + student.isf(0.006, trials - 1) * np.log(slow).std(ddof=1) / np.sqrt(
        trials
    )


def test_a_contaminated_log_is_told_for_what_it_is():
    """The noise of the truth, the spikes counted, the lines by frequency."""
    found, record = sizes(contaminated("N B", 1), "auto")
    assert found["white"] == pytest.approx(1, rel=0.01)
    assert found["flicker"] == pytest.approx(AUTO["N B"][1], rel=0.2)
    spikes, lines = (next(note for note in record.warnings if word in note) for word in ("spikes", "lines"))
    assert 70 < int(spikes.split(": ")[1].split()[0]) < 140
    assert all(f in lines for f in ("0.31 Hz", "1.7 Hz", "3.3 Hz"))


def test_behind_a_filter_the_white_noise_of_low_frequencies_is_found():
    """A pole at a tenth of the rate, 10,000 s: what is white below it, to 3 %."""
    pole = np.exp(-2 * np.pi * 0.1)
    samples = reference.draw(np.random.default_rng(4), IN_TIME["N K"], 100_000, INTERVAL)
    _, record = sizes(lfilter([1 - pole], [1, -pole], samples), "auto")
    assert record.fit["band"]["gyro_x"]["value"] < 1
    assert record.fit["filter_white"]["gyro_x"]["value"] == pytest.approx(SMALL, rel=0.03)
    assert any("on the spectrum is not level" in note for note in record.warnings)


@pytest.mark.parametrize("corner", [2.0, 10.0])
def test_white_noise_that_no_octave_shows_has_an_interval_that_holds_it(corner, reduced):
    """A minute at 100 Hz behind the sensor's filter: the end of the band shows 1 %, or half of it too much."""
    trials = 3 if reduced else 8
    pole = np.exp(-2 * np.pi * corner / 100)
    held = []
    for seed in range(trials):
        drawn = np.random.default_rng([seed, 6]).standard_normal(8000)
        samples = SMALL * lfilter([1 - pole], [1, -pole], drawn)[2000:]
        record = il.fit_noise({"gyro_x": samples}, rate=100.0, unit="rad/s").calibration
        assert any("the spectrum is level nowhere" in note for note in record.warnings)
        white = record.parameter("gyro_x_white")
        held.append(white.interval_95[0] <= 0.1 * SMALL <= white.interval_95[1])
        assert white.value == 0 or white.standard_uncertainty > 0.1 * abs(white.value - 0.1 * SMALL)
    assert np.mean(held) > 0.8  # 0 of both before

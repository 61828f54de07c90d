"""A rate test with accelerometers: the table axis in the body, both triads in one record, bias and g-sensitivity."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

import imulab as il
from imulab.cli import main
from imulab.procedures.rate.schema import RateTest, Run, manifest_text
from imulab.procedures.rate.simulate import RateRecordings
from reference import rate as reference

DEGREE = reference.DEGREE
G = 9.80665
WAY = [0, 50, 100, 200, 300, 200, 100, 50, 0, -50, -100, -200, -300, -200, -100, -50, 0]
SCALE, BIAS = np.array([1.004, 0.997, 1.01]), np.array([0.003, -0.006, 0.001])
TURN = np.array([[1.0, 2e-3, -1e-3], [3e-3, 1.0, 5e-4], [-2e-3, 1e-3, 1.0]])
SENSITIVITY = 0.1 * DEGREE / G * np.array([[0.3, 0.8, 0.3], [-1.3, 0.9, 0.4], [-0.5, 0.6, 0.4]])
ARM = np.array([0.05, 0.02, 0.03])
SIX = ("+x", "-x", "+y", "-y", "+z", "-z")
FREQUENCY = 50.0
TRUTH = {f"gyro_bias_{a}": BIAS[i] for i, a in enumerate("xyz")}
TRUTH |= {f"gyro_scale_factor_{a}": SCALE[i] for i, a in enumerate("xyz")}
TRUTH |= {f"gyro_misalignment_{a}{b}": TURN[i, k] for i, a in enumerate("xyz") for k, b in enumerate("xyz") if i != k}
TRUTH |= {f"gyro_g_sensitivity_{a}{b}": SENSITIVITY[i, k] for i, a in enumerate("xyz") for k, b in enumerate("xyz")}


@pytest.fixture(scope="module")
def accel():
    """A record of accelerometers without errors."""
    made = il.simulate_tumble(attitudes=24, order=1, hold="2 s", unit="m/s^2")
    found = il.fit_tumble(made, order=1, gravity=G).calibration
    values = {name: float(name.startswith("scale_factor")) for name in found.parameters}
    parameters = {name: dataclasses.replace(p, value=values[name]) for name, p in found.parameters.items()}
    return dataclasses.replace(found, parameters=parameters)


def whole(faces, lean=0.0, tilt=0.0, arm=ARM, noise=0.0, seed=1, accelerometers=True, leans=None, table=None):
    """A test of several runs, whose table axis leans by `lean` rad from each face."""
    rng, made, runs = np.random.default_rng(seed), [], []
    table = reference.steps(WAY, 8.0, FREQUENCY) if table is None else table
    for number, face in enumerate(faces):
        axis = lean * rng.standard_normal(3) if leans is None else leans[number].copy()
        axis["xyz".index(face[1])] = 1 if face[0] == "+" else -1
        rate, force = reference.mounted(table, FREQUENCY, axis, arm, tilt)
        out = SCALE * (rate @ TURN.T + BIAS + force @ SENSITIVITY.T) + noise * rng.standard_normal(rate.shape)
        columns = {"time": np.arange(len(table)) / FREQUENCY, "table_rate": table}
        columns |= {f"gyro_{a}": out[:, i] for i, a in enumerate("xyz")}
        columns |= {f"accel_{a}": force[:, i] for i, a in enumerate("xyz")} if accelerometers else {}
        units = {name: {"time": "s"}.get(name, "m/s^2" if name.startswith("accel") else "rad/s") for name in columns}
        made.append(il.Recording(columns, units, {}, name=f"{number}.csv"))
        runs.append(Run(f"{number}.csv", face))
    return RateRecordings(RateTest(tuple(runs), relative_uncertainty=0.0), tuple(made), {})


def test_the_table_axis_is_that_of_the_accelerometers(accel):
    """Leans of 1 deg, a table 2 mrad off level, an arm of 6 cm: 1 deg takes 152 ppm from S if it is not seen."""
    made = whole(SIX, lean=np.radians(1), tilt=2e-3)
    found = il.fit_rate(made, accel=accel, order=1).calibration
    for i in "xyz":
        assert found.value(f"gyro_scale_factor_{i}") == pytest.approx(TRUTH[f"gyro_scale_factor_{i}"], rel=5e-7)
        for k in "xyz".replace(i, ""):
            assert found.value(f"gyro_misalignment_{i}{k}") == pytest.approx(
                TRUTH[f"gyro_misalignment_{i}{k}"], abs=1e-5
            )
    without = il.fit_rate(made, order=1).calibration
    assert (
        max(abs(without.value(f"gyro_misalignment_{p}") - TRUTH[f"gyro_misalignment_{p}"]) for p in ("xy", "zx")) > 1e-3
    )
    level = whole(SIX, lean=np.radians(1), arm=np.zeros(3))
    exact = il.fit_rate(level, accel=accel, order=1).calibration
    for name, true in TRUTH.items():
        assert exact.value(name) == pytest.approx(true, abs=1e-9), name


def of_another_unit(accel, bias=0.0, serial="SIM-0001"):
    """The record of accelerometers whose biases are others, m/s^2."""
    moved = {n: dataclasses.replace(p, value=p.value + bias) for n, p in accel.parameters.items() if n == "bias_z"}
    return dataclasses.replace(accel, parameters={**accel.parameters, **moved}, sensor={"serial": serial})


def test_a_record_of_another_unit_is_said_to_be(accel):
    """By its serial number, and by |f|: 14 mg off g, where 2 mg are what a power cycle may do."""
    made = whole(SIX[::2], arm=np.zeros(3))
    named = [dataclasses.replace(one, metadata={"serial": "SIM"}) for one in made.recordings]
    made = dataclasses.replace(made, recordings=tuple(named))
    (said,) = il.fit_rate(made, accel=of_another_unit(accel), order=1).calibration.verdict.reasons
    assert said.startswith("accel: the record is of serial SIM-0001, the recordings of SIM")
    found = il.fit_rate(made, accel=of_another_unit(accel, 14e-3 * G, "SIM"), order=1).calibration
    (said,) = found.verdict.reasons
    assert found.verdict.state == "look"
    assert "|f| is -14 mg off gravity in 2.csv (+z along the table axis), more than its uncertainty" in said
    for record in (of_another_unit(accel, bias, "SIM") for bias in (0.0, 2e-3 * G)):
        assert il.fit_rate(made, accel=record, order=1).calibration.verdict.state == "good"
    other = of_another_unit(accel)
    stated = dataclasses.replace(made, test=dataclasses.replace(made.test, sensor={"serial": "SIM-0001"}))
    found = il.fit_rate(stated, accel=other, order=1).calibration
    assert not any("accel:" in each for each in found.warnings)  # the manifest's is the unit's
    assert il.fit_rate(made, accel=other, order=1).calibration.sensor["serial"] == "SIM"


def swept(largest=200.0, low=0.05, duration=90.0):
    """The rate of a table, rad/s, whose frequency rises to 1 Hz."""
    t = np.arange(int(duration * FREQUENCY)) / FREQUENCY
    return largest * DEGREE * np.sin(2 * np.pi * (low * t + (1 - low) * t**2 / (2 * duration)))


@pytest.mark.parametrize("noise", [0.0, 1e-3])
def test_the_table_axis_is_found_from_a_sweep_too(accel, noise):
    """Leans of 1 deg, a table 2 mrad off level, an arm of 6 cm, whose tangential acceleration the sweep has, too."""
    made = whole(SIX[::2], lean=np.radians(1), tilt=2e-3, noise=noise, table=swept())
    found = il.fit_rate(made, accel=accel, order=1).calibration
    reach = 1.0 if noise else 0.0
    for i in "xyz":
        own = found.parameters[f"gyro_scale_factor_{i}"]
        # what the arm's centripetal force does to G is found from six faces only: 0.1 deg/s/g of 6 cm
        assert abs(own.value / TRUTH[f"gyro_scale_factor_{i}"] - 1) < 2e-5 + 4 * reach * own.standard_uncertainty
        for k in "xyz".replace(i, ""):
            across = found.parameters[f"gyro_misalignment_{i}{k}"]
            off = abs(across.value - TRUTH[f"gyro_misalignment_{i}{k}"])
            assert off < 2e-5 + 4 * reach * across.standard_uncertainty
    blind = il.fit_rate(made, order=1).calibration
    assert max(abs(blind.value(n) - v) for n, v in TRUTH.items() if "misalignment" in n) > 5e-3


@pytest.mark.parametrize("correlation", [0.0, 0.2])
@pytest.mark.slow
def test_a_sweep_states_the_error_of_its_axis_whatever_the_noise(accel, correlation, reduced):
    """Noise of the accelerometers alone, white or correlated over 0.2 s, in which it erred by 4 times its statement."""
    trials = 3 if reduced else 8
    names = accel.covariance.names
    zero = dataclasses.replace(accel.covariance, matrix=tuple(map(tuple, (1e-20 * np.eye(len(names))).tolist())))
    exact = dataclasses.replace(accel, covariance=zero)
    keep = np.exp(-1 / FREQUENCY / correlation) if correlation else 0.0
    lean = np.tan(np.radians(1)) * np.eye(3)[[1, 2, 0]]
    made, scores = whole(SIX[::2], tilt=2e-3, leans=lean, table=swept()), []
    for seed in range(trials):
        rng, noisy = np.random.default_rng(seed), []
        for one in made.recordings:
            own = 0.05 * lfilter([np.sqrt(1 - keep**2)], [1, -keep], rng.standard_normal((len(one) + 200, 3)), axis=0)
            columns = {f"accel_{a}": one.column(f"accel_{a}") + own[200:, i] for i, a in enumerate("xyz")}
            noisy.append(one.with_columns(columns, dict.fromkeys(columns, "m/s^2")))
        found = il.fit_rate(dataclasses.replace(made, recordings=tuple(noisy)), accel=exact, order=1).calibration
        turns = {n: p for n, p in found.parameters.items() if "gyro_misalignment" in n}
        scores.append([(p.value - TRUTH[n]) / p.standard_uncertainty for n, p in turns.items()])
    # the root of a mean of 48 squares scatters by 0.10 about 1
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.3


def test_a_sweep_that_hardly_turns_the_table_tells_no_axis(accel):
    made = whole(SIX[::2], table=swept(20.0, 0.2))
    with pytest.raises(il.ImulabError, match=r"0.csv .*the table axis .* by a whole turn or more, found \d+ deg"):
        il.fit_rate(made, accel=accel, order=1)


def test_an_axis_off_by_a_degree_takes_its_cosine_from_the_scale_factor(accel):
    """1 - cos(1 deg) = 152 ppm of a scale factor, and T times the lean, where nobody sees it."""
    lean = np.tan(np.radians(1)) * np.eye(3)[[1, 2, 0]]
    made = whole(SIX[::2], arm=np.zeros(3), leans=lean)
    blind, seen = (il.fit_rate(made, accel=record, order=1).calibration for record in (None, accel))
    for i, axis in enumerate("xyz"):
        across = TURN[i] @ (np.eye(3)[i] + lean[i]) * np.cos(np.radians(1)) - 1
        off = blind.value(f"gyro_scale_factor_{axis}") / SCALE[i] - 1
        assert off == pytest.approx(across, abs=1e-9)
        assert off == pytest.approx(-152e-6 + TURN[i] @ lean[i], abs=2e-6)
        assert seen.value(f"gyro_scale_factor_{axis}") == pytest.approx(SCALE[i], rel=1e-9)


def test_six_faces_tell_bias_from_g_sensitivity(reduced):
    trials = 2 if reduced else 4
    scores = []
    for seed in range(trials):
        made = whole(SIX, arm=np.zeros(3), noise=3e-4, seed=seed, accelerometers=False)
        found = il.fit_rate(made, order=1).calibration
        scores += [(p.value - TRUTH[n]) / p.standard_uncertainty for n, p in found.parameters.items() if n in TRUTH]
    assert len(scores) == trials * len(TRUTH)
    assert 0.4 < np.mean(np.square(scores)) < 1.4  # 96 of noise, 48 that hold the faces' scatter beside their own


def test_three_faces_hold_the_mean_of_g_sensitivity_in_the_bias():
    found = il.fit_rate(whole(SIX[::2], arm=np.zeros(3)), order=1).calibration
    assert not any("g_sensitivity" in name for name in found.parameters)
    for i, axis in enumerate("xyz"):
        assert found.value(f"gyro_bias_{axis}") == pytest.approx(BIAS[i] + G * SENSITIVITY[i].mean(), abs=1e-9)
        assert (
            abs(found.value(f"gyro_bias_{axis}") - BIAS[i])
            < 4 * found.parameters[f"gyro_bias_{axis}"].standard_uncertainty
        )


def test_the_lever_arm_is_no_power_of_the_rate(accel):
    """f loses w^2 r across the axis, so that without the accelerometers k2 is - G r."""
    made = whole(SIX)
    found = il.fit_rate(made, accel=accel, order=2).calibration
    without = il.fit_rate(made, order=2).calibration
    for i, axis in enumerate("xyz"):
        assert abs(found.value(f"gyro_k2_{axis}")) < 1e-9
        expected = SENSITIVITY[i] @ (ARM * (np.arange(3) != i))
        assert without.value(f"gyro_k2_{axis}") == pytest.approx(-expected, abs=1e-9)


def test_the_uncertainty_of_the_accelerometers_is_in_the_misalignment(accel):
    """A misalignment of the accelerometers by u turns the frame: T_yx and T_xy take it over."""
    found = il.fit_rate(whole(SIX, arm=np.zeros(3)), accel=accel, order=1).calibration
    stated = found.parameters["gyro_misalignment_xy"].standard_uncertainty
    worst = max(accel.parameters[f"misalignment_{p}"].standard_uncertainty for p in ("yx", "zx", "zy"))
    biases = [accel.parameters[f"bias_{a}"].standard_uncertainty / G for a in "xyz"]
    assert 0 < stated < 2 * np.hypot(worst, max(biases))
    other = dataclasses.replace(accel.parameters["misalignment_yx"], value=1e-3)
    turned = dataclasses.replace(accel, parameters={**accel.parameters, "misalignment_yx": other})
    moved = il.fit_rate(whole(SIX, arm=np.zeros(3)), accel=turned, order=1).calibration
    change = max(abs(moved.value(f"gyro_misalignment_{p}") - TRUTH[f"gyro_misalignment_{p}"]) for p in ("xy", "yx"))
    assert change == pytest.approx(1e-3, rel=0.02)


def test_both_triads_are_one_record_that_is_applied_and_exported(accel, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    made = whole(SIX)
    for recording in made.recordings:
        il.write(recording, recording.name)
    (tmp_path / "t.toml").write_text(manifest_text(made.test), encoding="utf-8")
    accel.save("accel.json")
    words = ["rate", "fit", "t.toml", "--accel", "accel.json", "--order", "1", "-o", "both.json", "--report", "r.html"]
    assert main(words, project=False) == 0
    assert main(["show", "both.json"], project=False) == 0
    assert "gyro_g_sensitivity_xx" in capsys.readouterr().out
    assert "What the best line leaves of gyro_x" in Path("r.html").read_text(encoding="utf-8")
    fast = made.recordings[0].with_columns({"gyro_x": 2 * made.recordings[0].column("gyro_x")}, {"gyro_x": "rad/s"})
    il.write(fast, "fast.csv")
    assert main(["apply", "both.json", "fast.csv", "-o", "corrected.csv"], project=False) == 0
    assert "beyond 300 deg/s (up to 600" in capsys.readouterr().err
    assert main(["export", "--to", "c", "both.json", "-o", "c"], project=False) == 0
    rng = np.random.default_rng(2)
    rate, force = rng.uniform(-3, 3, (40, 3)), rng.uniform(-G, G, (40, 3))
    out = SCALE * (rate @ TURN.T + BIAS + force @ SENSITIVITY.T)
    flight = il.Recording.from_arrays(gyro=out, accel=force, rate=50.0, units={"gyro": "rad/s", "accel": "m/s^2"})
    assert il.load("both.json").procedure == "tumble"
    np.testing.assert_allclose(il.apply("both.json", flight).triad("gyro"), rate, atol=1e-6)


def test_accelerometers_without_a_record_tell_the_face():
    made = whole(("+z",), arm=np.zeros(3))
    (right,) = made.recordings
    flipped = {name: -right.column(name) if name.startswith("accel") else right.column(name) for name in right.columns}
    wrong = dataclasses.replace(right, columns=flipped)
    said = [il.fit_rate(one, axis="+z", order=1).calibration.warnings for one in (right, wrong)]
    assert not any("accelerometers see" in line for line in said[0])
    assert any("the accelerometers see -z up: is mounting wrong, or their sign?" in line for line in said[1])


def test_what_cannot_be_is_refused_in_a_line(accel):
    made = whole(SIX, arm=np.zeros(3))
    swapped = dataclasses.replace(made, recordings=tuple(
        dataclasses.replace(r, columns={n: -v if n.startswith("accel") else v for n, v in r.columns.items()})
        for r in made.recordings))  # fmt: skip
    bare = whole(SIX, arm=np.zeros(3), accelerometers=False)
    rate = il.fit_rate(bare, order=1).calibration
    for data, record, said in (
        (swapped, accel, "by the accelerometers -x points up: is mounting wrong"),
        (bare, accel, "no column accel_x; the table axis by accelerometers needs all three"),
        (whole(("+x", "+y"), arm=np.zeros(3)), accel, "accel needs runs about x, y and z"),
        (made, rate, "a rate record without accelerometers; expected one of tumble fit"),
    ):
        with pytest.raises(il.ImulabError, match=said) as refused:
            il.fit_rate(data, accel=record, order=1)
        assert "\n" not in str(refused.value)


def test_a_record_of_both_triads_is_checked_by_holds_without_noise_that_are_alike(accel):
    """Rests of a table between its rates are one attitude, many times."""
    made = whole(SIX, arm=np.zeros(3), lean=np.radians(1))
    both = il.fit_rate(made, accel=accel, order=1).calibration
    found = il.check_tumble(both, made.recordings[0])
    assert found.passed

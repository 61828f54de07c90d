"""Rates that change all the time: delay and bandwidth apart from the scale factor, by a simulator that steps finely."""

import dataclasses
import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.procedures.rate.dwells import find_dwells
from imulab.procedures.rate.schema import RateTest, Run
from imulab.procedures.rate.sweeps import KERNELS, moments
from reference.rate import DEGREE

FREQUENCY, OVER = 200, 20


SCALE, LAG, DELAY = 1.004, 5e-3, 4e-3


def swept(kind="chirp", duration=30.0, noise=0.0, k3=0.0, name="z.csv", angle=False, seed=1, sign=1, loop=0.0):
    """A unit behind a first-order lag and a delay, stepped 20 times a sample; rates of the table in deg/s.

    What it feels differs from rising to falling rates by `loop` of the largest rate at 0, and the less the faster.
    """
    fine = FREQUENCY * OVER
    t = np.arange(int(duration * fine)) / fine
    phase = 2 * np.pi * (t if kind == "sine" else 0.05 * t + 1.95 * t**2 / (2 * duration))
    table = 100 * np.sin(phase)
    if kind == "ramp":
        table = 100 * (np.abs(4 * ((t / 10 + 0.25) % 1) - 2) - 1)
    if kind == "staircase":
        table = 20.0 * np.floor(t / 0.4 % 10)
    keep, felt, last = np.exp(-1 / fine / LAG), np.empty_like(table), table[0]
    branches = 100 * loop / 2 * np.sign(np.gradient(table)) * (1 - (table / 100) ** 2)
    for k, value in enumerate(table + branches):
        last = keep * last + (1 - keep) * value
        felt[k] = last
    shift = round(DELAY * fine)
    felt = np.concatenate([np.full(shift, felt[0]), felt[:-shift]])[::OVER] * DEGREE * sign
    rng = np.random.default_rng(seed)
    out = {"gyro_x": 2e-3 * felt, "gyro_y": -3e-3 * felt, "gyro_z": SCALE * (felt + k3 * felt**3 + 3e-3)}
    columns = {n: v / DEGREE + noise * rng.standard_normal(len(v)) for n, v in out.items()}
    at = {"time": np.arange(len(felt)) / FREQUENCY}
    turned = {"table_rate": table[::OVER]}
    if angle:
        turned = {"table_angle": np.degrees(np.cumsum(table * DEGREE) / fine)[::OVER]}
    units = {n: "s" if n == "time" else "deg" if "angle" in n else "deg/s" for n in (*at, *columns, *turned)}
    return il.Recording({**at, **columns, **turned}, units, name=name)


TRUE_DELAY = LAG + DELAY - 0.5 / FREQUENCY / OVER  # the lag takes the rate at the end of each fine step


@pytest.mark.parametrize("angle", [False, True])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_sweep_tells_delay_and_bandwidth_from_the_scale_factor(angle, sign):
    fit = il.fit_rate(swept(angle=angle, sign=sign), axis="+z" if sign > 0 else "-z")
    found = fit.calibration.parameters
    assert found["gyro_scale_factor_z"].value * DEGREE == pytest.approx(SCALE, rel=3e-6)
    assert found["gyro_delay_z"].value == pytest.approx(TRUE_DELAY + angle * 0.5 / FREQUENCY / OVER, abs=3e-5)
    assert found["gyro_bandwidth_z"].value == pytest.approx(1 / (2 * np.pi * LAG), rel=2e-3)
    assert found["gyro_bandwidth_z"].unit == "Hz"
    assert fit.calibration.model["from"] == "sweeps"


def test_a_sweep_shows_powers_of_the_rate():
    found = il.fit_rate(swept(k3=1e-4, noise=2e-3)).calibration
    assert found.fit["axes"]["z"]["order"] == 3
    k3 = found.parameters["gyro_k3_z"]
    assert abs(k3.value - 1e-4) < 4 * k3.standard_uncertainty
    assert k3.standard_uncertainty < 1e-5


def test_of_one_sine_the_amplitude_at_its_frequency_is_found_and_said():
    record = il.fit_rate(swept("sine")).calibration
    omega = 2 * np.pi
    fine = 1 / (FREQUENCY * OVER)
    keep = np.exp(-fine / LAG)
    response = (1 - keep) / (1 - keep * np.exp(-1j * omega * fine))  # of the lag as it is stepped
    expected = SCALE * abs(response)
    assert record.value("gyro_scale_factor_z") * DEGREE == pytest.approx(expected, rel=2e-6)
    delay = DELAY - np.angle(response) / omega
    assert record.value("gyro_delay_z") == pytest.approx(delay, abs=1e-6)
    assert "gyro_bandwidth_z" not in record.parameters
    said = "one sine of 1 Hz: the scale factor is the amplitude at that frequency, the delay holds hysteresis"
    assert any(said in w for w in record.warnings)


def test_a_slow_triangle_serves_as_a_sweep():
    found = il.fit_rate(swept("ramp", noise=0.02)).calibration
    scale = found.parameters["gyro_scale_factor_z"]
    assert abs(scale.value * DEGREE - SCALE) < 4 * scale.standard_uncertainty * DEGREE
    assert scale.standard_uncertainty < 50e-6 * scale.value
    assert found.value("gyro_delay_z") == pytest.approx(TRUE_DELAY, abs=2e-4)


@pytest.mark.parametrize("kind", ["sine", "ramp"])
def test_where_each_rate_is_passed_equally_fast_no_loop_is_told_from_a_delay(kind):
    """A loop of 1000 ppm is a delay of 0.07 ms in a sine of 1 Hz; what that leaves of it was given as hysteresis."""
    record = il.fit_rate(swept(kind, loop=1e-3)).calibration
    assert "gyro_hysteresis_z" not in record.parameters
    assert record.fit["axes"]["z"]["loop"] is None
    assert any("the delay" in w and "hysteresis" in w for w in record.warnings)
    assert "gyro_hysteresis_z" in il.fit_rate(swept(loop=1e-3)).calibration.parameters


@pytest.mark.parametrize("loop", [1e-3, -2e-4])
def test_a_loop_comes_apart_from_the_delay(loop):
    """Without noise; 264 to 450 ppm of 1000 before, and 0.1 ms of delay."""
    found = il.fit_rate(swept(loop=loop), order=1).calibration
    assert found.value("gyro_hysteresis_z") == pytest.approx(loop, rel=3e-3, abs=2e-6)
    assert found.value("gyro_delay_z") == pytest.approx(TRUE_DELAY, abs=3e-6)
    assert found.value("gyro_bandwidth_z") == pytest.approx(1 / (2 * np.pi * LAG), rel=3e-3)
    assert found.fit["axes"]["z"]["loop"] < 1e-6
    assert any("(hysteresis), which no calibration removes" in w for w in found.warnings)


def test_loop_and_delay_of_a_noisy_sweep_err_by_what_is_stated(reduced):
    trials = 5 if reduced else 12
    clean, scores, loops = swept(loop=1e-3, duration=60.0), [], []
    still = swept(duration=60.0)
    for seed in range(trials):
        noise = 0.05 * np.random.default_rng(seed).standard_normal(len(clean))
        for made in (clean, still):
            noisy = made.with_columns({"gyro_z": made.column("gyro_z") + noise}, {"gyro_z": "deg/s"})
            found = il.fit_rate(noisy, order=1).calibration
            of, delay = found.fit["axes"]["z"], found.parameters["gyro_delay_z"]
            loops.append(of["loop"])
            if made is clean:
                off = (of["fitted_loop"] - 1e-3) / of["fitted_loop_uncertainty"]
                scores.append([off, (delay.value - TRUE_DELAY) / delay.standard_uncertainty])
                assert of["fitted_loop_uncertainty"] < 1e-4
    squares = np.square(scores).mean(axis=0)  # 12 scatter by 0.41 about 1
    assert (squares > 0.1).all()
    assert (squares < 1 + 3 * 0.41).all()
    assert max(loops[::2]) < 1e-3  # told at 1 %
    assert np.mean(np.array(loops[1::2]) < 0.01) < 0.3


def wandering(count, step, white, flicker, rng):
    """Noise of density white^2 + flicker^2 / f, (deg/s)^2/Hz on both sides, of twice `count` samples."""
    frequency = np.fft.rfftfreq(2 * count, step)
    frequency[0] = np.inf
    spectrum = np.fft.rfft(rng.standard_normal(2 * count)) * np.sqrt((white**2 + flicker**2 / frequency) / step)
    return np.fft.irfft(spectrum, 2 * count)


@pytest.mark.slow
@pytest.mark.parametrize("flicker", [0.0, 0.01])
@pytest.mark.parametrize("kind", ["sine", "chirp"])
def test_the_bias_of_a_sweep_errs_by_what_is_stated_whatever_wanders(kind, flicker, reduced):
    """Half the mean square by which it differs from the mean zero of the next 120 s; 100 times the variance before."""
    trials = 14 if reduced else 40
    step, count = 0.02, 6000
    time, off, stated = np.arange(count) * step, [], []
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        phase = 0.3 * time if kind == "sine" else 0.05 * time + 1.95 * time**2 / 240
        table = 100 * np.sin(2 * np.pi * phase + rng.uniform(0, 6))
        zero = wandering(count, step, 0.005, flicker, rng)
        columns = {"time": time, "gyro_z": SCALE * table + 0.2 + zero[:count], "table_rate": table}
        made = il.Recording(columns, {n: "s" if n == "time" else "deg/s" for n in columns}, name="z.csv")
        bias = il.fit_rate(made, order=1).calibration.parameters["gyro_bias_z"]
        next_one = 0.2 + zero[count:].mean()
        off.append((bias.value / DEGREE * SCALE - next_one) ** 2 / 2)
        stated.append((bias.standard_uncertainty / DEGREE * SCALE) ** 2)
    # 40 squares scatter by 0.22; by 0.3 and more where few periods of what wanders show it
    assert 0.3 < np.mean(off) / np.mean(stated) < 2.0


def test_the_errors_of_a_sweep_are_those_that_the_record_states(reduced):
    trials = 5 if reduced else 12
    clean, scores = swept(), []
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        noisy = {n: v + 0.05 * rng.standard_normal(len(v)) for n, v in clean.columns.items() if n.startswith("gyro")}
        made = dataclasses.replace(clean, columns={**clean.columns, **noisy})
        found = il.fit_rate(made).calibration.parameters
        true = {"scale_factor": SCALE / DEGREE, "delay": TRUE_DELAY, "bandwidth": 1 / (2 * np.pi * LAG)}
        scores.append(
            [(found[f"gyro_{n}_z"].value - v) / found[f"gyro_{n}_z"].standard_uncertainty for n, v in true.items()]
        )
    # 12 squares scatter by 0.41 about 1
    squares = np.square(scores).mean(axis=0)
    assert (squares > 0.1).all()
    assert (squares < 1 + 3 * 0.41).all()


def test_steps_with_slow_ramps_between_are_steps():
    times, rates = [0.0], [0.0]
    for rate in (0, 50, 100, 50, 0, -50, -100, -50, 0):
        times += [times[-1] + 10, times[-1] + 13]
        rates += [rate, rate]
    time = np.arange(int(times[-1] * 50)) / 50
    table = np.interp(time, times, rates)
    columns = {"time": time, "gyro_z": SCALE * table, "table_rate": table}
    made = il.Recording(columns, {n: "s" if n == "time" else "deg/s" for n in columns}, name="z.csv")
    fit = il.fit_rate(made)
    assert fit.calibration.model["from"] == "steps"
    assert sorted(np.round(fit.dwells[0].rate / DEGREE)) == [-100, -50, -50, 0, 0, 0, 50, 50, 100]


def test_a_manifest_says_that_a_run_is_a_sweep(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    il.write(swept(), "z.csv")
    text = '[[run]]\nfile = "z.csv"\nmounting = "+z"\n'
    for more, status, said in (
        ("sweep = true", 0, ""),
        ("", 0, ""),
        ("sweep = 1", 2, "sweep: expected true or false"),
        ("sweep = true\nrates = [0, 10, -10]", 2, "no rates beside true"),
    ):
        Path("t.toml").write_text(text + more, encoding="utf-8")
        assert main(["rate", "fit", "t.toml", "-o", "r.json", "--report", "r.html"], project=False) == status
        assert said in capsys.readouterr().err
    page = Path("r.html").read_text(encoding="utf-8")
    assert "Sweeps" in page
    assert "delay, ms" in page
    sweeps = json.loads(Path("r.json").read_text())["fit"]["sweeps"]
    assert sweeps[0]["file"] == "z.csv"
    assert main(["show", "r.json"], project=False) == 0
    assert "gyro_delay_z" in capsys.readouterr().out


def _clipped():
    made = swept()
    return dataclasses.replace(made, columns={**made.columns, "gyro_z": np.clip(made.column("gyro_z"), -80, 80)})


def _without_table():
    made = swept()
    return dataclasses.replace(made, columns={n: v for n, v in made.columns.items() if n != "table_rate"})


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (_clipped, "while the rate changes: its output is saturated"),
        (lambda: swept("staircase"), "are the steps too short"),
        (_without_table, "no column table_rate or table_angle"),
        (lambda: dataclasses.replace(swept(), columns={**(s := swept()).columns, "gyro_x": s.column("gyro_z"),
                                                       "gyro_z": s.column("gyro_x")}), "are seen by gyro_x"),
    ],
)  # fmt: skip
def test_what_is_no_sweep_is_refused_in_a_line(made, said):
    with pytest.raises(il.ImulabError, match=said) as refused:
        il.fit_rate(made())
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize(
    ("parts", "single"),
    [
        (((100, 0.3), (30, 1.1)), False),
        (((100, 1 / 60),), True),
        (((100, 0.1),), True),
        (((80, 0.2), (50, 0.9), (30, 2.1)), False),
    ],
)
def test_what_one_rate_cannot_tell_does_not_spoil_the_scale_factor(parts, single, noise):
    """Derivatives that the rate and others make up, or that are noise of the table's column, are left out."""
    rng = np.random.default_rng(3)
    time = np.arange(6000) / 100
    table = sum(size * np.sin(2 * np.pi * f * time) for size, f in parts)
    columns = {"time": time, "gyro_z": SCALE * table + 0.02 * rng.standard_normal(6000)}
    columns["table_rate"] = table + noise * rng.standard_normal(6000)
    made = il.Recording(columns, {n: "s" if n == "time" else "deg/s" for n in columns}, name="z.csv")
    fit = il.fit_rate(made)
    scale = fit.calibration.parameters["gyro_scale_factor_z"]
    assert abs(scale.value * DEGREE - SCALE) < 4 * scale.standard_uncertainty * DEGREE
    assert scale.standard_uncertainty < 30e-6 * scale.value
    assert (fit.dwells[0].sweep.frequency is not None) == single


@pytest.mark.slow
@pytest.mark.parametrize("colour", [0.0, 0.9])
@pytest.mark.parametrize(("frequency", "periods"), [(0.1, 4.3), (1.0, 10)])
def test_sines_of_few_periods_state_the_error_of_their_scale_factor(frequency, periods, colour, reduced):
    """Against white noise, and noise whose samples go with those before: stated as if white it erred by 1.3 to 2.4."""
    trials = 16 if reduced else 60
    time = np.arange(int(100 * periods / frequency)) / 100
    scores = []
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        table = 100 * np.sin(2 * np.pi * (frequency * time + rng.random()))
        noise = 0.05 * rng.standard_normal(len(time))
        for k in range(1, len(noise)):
            noise[k] += colour * noise[k - 1]
        columns = {"time": time, "gyro_z": SCALE * table + 0.3 + noise, "table_rate": table}
        made = il.Recording(columns, {n: "s" if n == "time" else "deg/s" for n in columns}, name="z.csv")
        scale = il.fit_rate(made).calibration.parameters["gyro_scale_factor_z"]
        scores.append((scale.value * DEGREE - SCALE) / (scale.standard_uncertainty * DEGREE))
    # the root of a mean of 60 squares scatters by 0.09 about 1, and by 0.06 more as the noise is found from the run
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.33


def test_a_simulated_sweep_gives_its_truth_back(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    made = il.simulate_rate("0,100", sweep="60 s", lag="6 ms", noise="0", rate="200 Hz", latitude="0 deg", seed=4)
    fit = il.fit_rate(made, order=1).calibration
    for name, value in made.truth.items():
        if name.startswith(("gyro_scale_factor", "gyro_misalignment", "gyro_delay")):
            size = 57.3 if "scale" in name else 1.0
            assert fit.value(name) == pytest.approx(value, abs=1e-5 * size), name
    for axis in "xyz":
        assert fit.value(f"gyro_bandwidth_{axis}") == pytest.approx(1 / (2 * np.pi * 6e-3), rel=0.01)
    words = [
        "rate",
        "simulate",
        "-o",
        "sweeps",
        "--sweep",
        "30s",
        "--lag",
        "5ms",
        "--rate",
        "200 Hz",
        "--rates",
        "0,80",
    ]
    assert main(words, project=False) == 0
    assert "sweep = true" in (tmp_path / "sweeps" / "test.toml").read_text()
    assert main(["rate", "fit", "sweeps/test.toml", "-o", "s.json"], project=False) == 0
    record = json.loads((tmp_path / "s.json").read_text())["parameters"]
    delay = record["gyro_delay_z"]
    assert abs(delay["value"] - 5e-3) < 4 * delay["standard_uncertainty"]
    capsys.readouterr()
    for wrong, said in (
        ("--sweep=5s", "sweep, rate: expected 20 s"),
        ("--lag=2s", "lag 2s: expected a time constant"),
        ("--hold=3s", "hold: a sweep rests at no rate"),
    ):
        assert main(["rate", "simulate", "-o", "no", "--sweep", "30s", wrong], project=False) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "no").exists()


def _chirps(count, seed=0):
    """Chirps of 60 s at 1 kHz of a gyroscope without delay, with noise, deg/s."""
    time = np.arange(count) / 1000
    within = time % 60
    table = 100 * np.sin(2 * np.pi * (0.05 * within + 1.95 * within**2 / 120))
    noise = 0.05 * np.random.default_rng(seed).standard_normal((3, count))
    gyros = {f"gyro_{a}": gain * table + own for a, gain, own in zip("xyz", (2e-3, -3e-3, SCALE), noise, strict=True)}
    columns = {"time": time, **gyros, "table_rate": table}
    return il.Recording(columns, {n: "s" if n == "time" else "deg/s" for n in columns}, name="z.csv")


def test_a_long_sweep_takes_a_few_columns_of_memory():
    """Twelve columns of all samples beside the recording; thirty before it went block by block."""
    made = _chirps(600_000)
    il.fit_rate(_chirps(60_000))  # what is imported once is not counted
    tracemalloc.start()
    found = il.fit_rate(made).calibration.parameters["gyro_scale_factor_z"]
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 12 * 8 * len(made)
    assert abs(found.value * DEGREE - SCALE) < 4 * found.standard_uncertainty * DEGREE


def test_gaps_in_a_sweep_leave_out_what_is_beside_them():
    made = swept()
    keep = np.ones(len(made), dtype=bool)
    for first, last in ((700, 760), (2000, 2001), (4100, 4500)):
        keep[first:last] = False
    cut = dataclasses.replace(made, columns={n: v[keep] for n, v in made.columns.items()})
    found = il.fit_rate(cut).calibration.parameters
    assert found["gyro_scale_factor_z"].value * DEGREE == pytest.approx(SCALE, rel=1e-5)
    assert found["gyro_delay_z"].value == pytest.approx(TRUE_DELAY, abs=3e-5)


def test_derivatives_are_those_of_fornberg():
    """Central differences of eighth order, Math. Comp. 51 (1988) 699, table 1."""
    first = [1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280]
    fourth = [7 / 240, -2 / 5, 169 / 60, -122 / 15, 91 / 8, -122 / 15, 169 / 60, -2 / 5, 7 / 240]
    np.testing.assert_allclose(KERNELS[[0, 3]], [first, fourth], atol=1e-12)


def test_the_covariance_by_parts_is_that_of_bell_and_mccaffrey():
    """``A_b = (I - H_b)^(-1/2)`` before the residuals of each part b, written out with the whole matrices."""
    rng = np.random.default_rng(0)
    count = 32 * 6
    x = np.column_stack([np.ones(count), rng.standard_normal((count, 2)) * np.linspace(0.1, 3, count)[:, None]])
    y = x @ [1.0, 2.0, 3.0] + rng.standard_normal(count)
    inverse = np.linalg.inv(x.T @ x)
    left, expected = y - x @ inverse @ x.T @ y, np.zeros((3, 3))
    for k in range(32):
        own = slice(6 * k, 6 * k + 6)
        size, turn = np.linalg.eigh(np.eye(6) - x[own] @ inverse @ x[own].T)
        score = inverse @ x[own].T @ (turn / np.sqrt(size)) @ turn.T @ left[own]
        expected += np.outer(score, score)
    found = moments(count, lambda part: x[part].T, [y])
    columns = [0, 1, 2]
    covariance = found.covariance(columns, columns, 0, found.fit(columns, 0))
    np.testing.assert_allclose(covariance, expected, rtol=1e-9)


def test_the_level_part_of_the_earths_rate_does_not_average_out_of_a_sweep():
    """The table swings to and fro, so that the cosine and sine of its angle have a mean."""
    made = il.simulate_rate("0,100", faces="+z", sweep="60s", rate="100 Hz", seed=1)
    (found,) = il.fit_rate(made, order=1).dwells
    angle = np.cumsum(made.recordings[0].si("table_rate")) / 100
    expected = np.array([np.cos(angle).mean(), np.sin(angle).mean()])
    assert np.hypot(*expected) > 0.1
    np.testing.assert_allclose(found.level, np.tile(expected, (len(found.rate), 1)), atol=0.02)


UP = [0, 10, 50, 100, 200, 300]


WAY = [*UP, *UP[-2::-1], *(-r for r in UP[1:]), *(-r for r in UP[-2::-1])]


USUAL = {"density": 0.005, "hold": 8.0, "frequency": 100.0, "acceleration": 200.0}


CONDITIONS = {
    "1e-5 deg/s/sqrt(Hz)": {"density": 1e-5},
    "1e-4 deg/s/sqrt(Hz)": {"density": 1e-4},
    "1e-3 deg/s/sqrt(Hz)": {"density": 1e-3},
    "5e-3 deg/s/sqrt(Hz)": {},
    "0.02 deg/s/sqrt(Hz)": {"density": 0.02},
    "0.05 deg/s/sqrt(Hz)": {"density": 0.05},
    "2 s": {"hold": 2.0},
    "2 s, 0.05 deg/s/sqrt(Hz)": {"hold": 2.0, "density": 0.05},
    "ripple once a turn": {"ripple": 1e-3},
    "ripple and 1e-5 deg/s/sqrt(Hz)": {"ripple": 1e-3, "density": 1e-5},
    "knocks": {"knocks": 5},
    "coarse outputs": {"step": 0.25},
    "coarse outputs without noise": {"step": 0.25, "density": 0.0},
    "a slow table": {"acceleration": 20.0},
    "a quick table that rings": {"acceleration": 2000.0, "ring": 0.02},
    "drift": {"drift": 0.1},
    "20 Hz": {"frequency": 20.0},
    "1 kHz, no order": {"frequency": 1000.0, "shuffled": True},
}


def simulated(
    seed, *, density, hold, frequency, acceleration, ripple=0.0, knocks=0, step=0.0, ring=0.0, drift=0.0, shuffled=False
):
    """A run, its commanded rates, deg/s, and from when to when the table was at each, s."""
    rng = np.random.default_rng(seed)
    way = [WAY[k] for k in rng.permutation(len(WAY))] if shuffled else WAY
    way = [r for k, r in enumerate(way) if k == 0 or r != way[k - 1]]
    times, rates, spans = [0.0], [float(way[0])], []
    for rate in way:
        ramp = abs(rate - rates[-1]) / acceleration
        times += [times[-1] + ramp, times[-1] + ramp + hold]
        rates += [rate, rate]
        spans.append((times[-2], times[-1]))
    time = np.arange(int(times[-1] * frequency)) / frequency
    table = np.interp(time, times, rates)
    angle = np.cumsum(table) / frequency
    table = table * (1 + ripple * np.sin(np.radians(angle)))
    for begin, _ in spans[1:]:
        since = time - begin
        table = table + np.where(since > 0, ring * 50 * np.exp(-np.maximum(since, 0) / 0.1) * np.cos(60 * since), 0.0)
    out = (1 + 0.02 * rng.standard_normal()) * table + 0.5 * rng.standard_normal() + drift * time / time[-1]
    for at in rng.uniform(0, time[-1], knocks):
        out = out + np.where(np.abs(time - at) < 0.05, 20.0, 0.0)
    out = out + density * np.sqrt(frequency / 2) * rng.standard_normal(len(time))
    if step:
        out = np.round(out / step) * step
    rest = density * np.sqrt(frequency / 2) * rng.standard_normal((2, len(time)))
    columns = {"time": time, "gyro_x": rest[0], "gyro_y": rest[1], "gyro_z": out}
    units = {name: "s" if name == "time" else "deg/s" for name in columns}
    return il.Recording(columns, units, name="run.csv"), way, spans


@pytest.mark.slow
@pytest.mark.parametrize("name", CONDITIONS)
def test_every_dwell_is_found_and_none_at_a_wrong_rate(name, reduced):
    for seed in range(3 if reduced else 30):
        made, way, spans = simulated(seed, **{**USUAL, **CONDITIONS[name]})
        test = RateTest((Run("run.csv", "+z", tuple(np.array(way) * DEGREE)),))
        found = find_dwells(made, test, 0)
        seen = set()
        for start, stop, rate in zip(found.start, found.stop, np.array(found.rate) / DEGREE, strict=True):
            (k,) = [k for k, (a, b) in enumerate(spans) if a <= (start + stop) / 2 <= b]
            assert spans[k][0] <= start < stop <= spans[k][1]
            assert rate == pytest.approx(way[k], abs=1e-9)
            seen.add(k)
        assert len(seen) == len(way), f"seed {seed}"


@pytest.mark.parametrize("sweep", [False, True])
@pytest.mark.parametrize("noise", [0.0, 2.0, 5.0])
def test_noise_of_the_recorded_rate_takes_nothing_off_the_scale_factor(noise, sweep):
    """2 deg/s of 100 took 0.1 % off the scale factor of a sine, 5 deg/s 3 %; no more than the Cramer-Rao bound."""
    rng = np.random.default_rng(4)
    time = np.arange(4000) / 100
    rate = 100 * np.sin(2 * np.pi * (0.05 * time + 0.025 * time**2 if sweep else 0.3 * time))
    gyro = np.zeros((4000, 3))
    gyro[:, 2] = rate
    gyro += 0.1 * rng.standard_normal(gyro.shape)
    table = rate + noise * rng.standard_normal(4000)
    units = {"gyro": "deg/s", "table_rate": "deg/s"}
    made = il.Recording.from_arrays(time=time, gyro=gyro, table_rate=table, units=units)
    record = il.fit_rate(made, latitude=0.0).calibration
    p = record.parameters["gyro_scale_factor_z"]
    error, u = p.value / (180 / np.pi) - 1, p.standard_uncertainty / (180 / np.pi)
    bound = np.hypot(0.1, noise) / np.sqrt(4000 * 5000)
    assert record.verdict.state == "good"
    assert abs(error) < 3 * u
    assert 0.7 * bound < u < (2 if noise else 3.5) * bound

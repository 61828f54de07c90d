"""The noise of a unit by the command line: what each program's filter wants, and every refusal, one line each."""

import json

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.estimation.noise.simulate import simulated
from imulab.procedures import registry
from imulab.procedures.noise.figures import exhibits
from imulab.procedures.noise.wants import STEPS, noise_for
from imulab.records.calibration import Calibration, Covariance, Parameter

DEGREE = np.pi / 180
RATE = 200.0
PROGRAMS = ("kalibr", "openvins", "vins", "px4", "ardupilot", "gtsam", "ros", "matlab")


def samples(seed, **sizes):
    return np.concatenate(list(simulated(sizes, 1 / RATE, 40_000, seed)))


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """A log of six axes and its record."""
    folder = tmp_path_factory.mktemp("noise")
    columns = {"time": np.arange(40_000) / RATE}
    columns |= {f"gyro_{a}": samples(k, white=0.005 + 0.001 * k, walk=0.001) for k, a in enumerate("xyz")}
    columns |= {f"accel_{a}": samples(10 + k, white=0.001 + 2e-4 * k, walk=2e-4) for k, a in enumerate("xyz")}
    units = {name: "s" if name == "time" else "deg/s" if name[0] == "g" else "m/s^2" for name in columns}
    il.write_csv(il.Recording(columns, units, {"serial": "N-7"}), folder / "rest.csv")
    assert main(["noise", "fit", str(folder / "rest.csv"), "-o", str(folder / "n.json")]) == 0
    return folder


@pytest.fixture(scope="module")
def record(home):
    return il.load(home / "n.json")


def sizes(record, sensor):
    """The largest of three axes, from the record."""
    return (
        max(record.fit[key][f"{sensor}_{axis}"]["value"] for axis in "xyz") for key in ("filter_white", "filter_walk")
    )


@pytest.mark.slow
@pytest.mark.parametrize(("sensor", "g", "b"), [("gyro", "GYR", "gyr"), ("accel", "ACC", "acc")])
def test_each_filter_grows_as_white_noise_and_walk_do(record, sensor, g, b):
    """N^2 t of the angle (velocity) and K_h^2 t of the bias, by each filter's own recursion, over 10 s."""
    white, walk = sizes(record, sensor)
    rate, t, long = RATE, 10.0, {"gyro": "gyroscope", "accel": "accelerometer"}[sensor]
    dt, found = 1 / rate, {}
    for name in ("kalibr", "openvins"):  # sigma_c/sqrt(dt) a sample: Qd = sigma^2/dt dt^2; walk sigma sqrt(dt)
        k = noise_for(record, name)
        found[name] = (k[f"{long}_noise_density"] ** 2 / dt * dt**2, k[f"{long}_random_walk"] ** 2 * dt, t * rate)
        assert k["update_rate"] == pytest.approx(rate)
    k = noise_for(record, "vins")  # midpoint: V n_0, V n_1, V = dt/2, both of variance n^2; bias dt w
    found["vins"] = (2 * (dt / 2) ** 2 * k[f"{b}_n"] ** 2, (dt * k[f"{b}_w"]) ** 2, t * rate)
    k, d = noise_for(record, "px4"), STEPS["px4"]  # (D p)^2 a step
    found["px4"] = ((d * k[f"EKF2_{g}_NOISE"]) ** 2, (d * k[f"EKF2_{g}_B_NOISE"]) ** 2, t / d)
    k, d = noise_for(record, "ardupilot", step=0.01), 0.01
    names = ("EK3_GYRO_P_NSE", "EK3_GBIAS_P_NSE") if sensor == "gyro" else ("EK3_ACC_P_NSE", "EK3_ABIAS_P_NSE")
    found["ardupilot"] = ((d * k[names[0]]) ** 2, (d * k[names[1]]) ** 2, t / d)
    k = noise_for(record, "gtsam")  # covariance/dt of a sample, times dt^2; bias covariance dt
    names = ("gyroscope", "biasOmega") if sensor == "gyro" else ("accelerometer", "biasAcc")
    found["gtsam"] = (k[f"{names[0]}Covariance"] / dt * dt**2, k[f"{names[1]}Covariance"] * dt, t * rate)
    for name, (of_angle, of_bias, steps) in found.items():
        assert steps * of_angle == pytest.approx(white**2 * t, rel=1e-6), name
        assert steps * of_bias == pytest.approx(walk**2 * t, rel=1e-6), name


def test_the_variance_for_ros_is_that_of_the_samples_where_the_noise_is_slow_too():
    """1/f noise makes the white noise of a filter larger, but not the variance of a sample."""
    names = [f"gyro_{axis}" for axis in "xyz"]
    columns = {name: samples(40 + k, white=1e-3, flicker=1e-3) for k, name in enumerate(names)}
    columns["time"] = np.arange(len(columns["gyro_x"])) / RATE
    units = dict.fromkeys(names, "rad/s") | {"time": "s"}
    found = il.fit_noise(il.Recording(columns, units)).calibration
    u = max(found.fit["bias_uncertainty"][name]["standard_uncertainty"]["value"][-1] for name in names)
    measured = max(float(columns[name].var()) for name in names)
    stated = noise_for(found, "ros")["angular_velocity_covariance"] - u**2
    assert stated == pytest.approx(measured, rel=0.08)  # the mean is taken off, and 1/f noise has a variance as well
    assert noise_for(found, "gtsam")["gyroscopeCovariance"] * RATE > 1.5 * stated


def test_the_variance_of_a_ros_sample_and_matlab_sizes(record):
    _, walk = sizes(record, "gyro")
    white = max(record.value(f"gyro_{axis}_white") for axis in "xyz")
    u = max(record.fit["bias_uncertainty"][f"gyro_{a}"]["standard_uncertainty"]["value"][-1] for a in "xyz")
    assert noise_for(record, "ros")["angular_velocity_covariance"] == pytest.approx(white**2 * RATE + u**2)
    matlab = noise_for(record, "matlab")
    assert matlab["gyroparams.NoiseDensity"] == pytest.approx(white)
    assert matlab["insfilterMARG.GyroscopeNoise"] == pytest.approx(white**2 * RATE)
    assert matlab["insfilterMARG.GyroscopeBiasNoise"] == pytest.approx(walk**2 / RATE)


@pytest.fixture(scope="module")
def fitted_once():
    """What the command fits with: it fits the log for the first program alone, and all others have the same record."""
    run_task, made = registry.run_task, []

    def run(*arguments):
        if not made:
            made.append(run_task(*arguments))
        return made[0]

    return run


@pytest.mark.parametrize("program", PROGRAMS)
def test_the_command_prints_key_and_value_a_line(home, record, capsys, monkeypatch, fitted_once, program):
    monkeypatch.setattr(registry, "run_task", fitted_once)
    assert main(["noise", "fit", str(home / "rest.csv"), "--for", program]) == 0
    lines = capsys.readouterr().out.splitlines()
    printed = {key: float(value) for key, value in (line.split(": ") for line in lines)}
    assert printed == {key: pytest.approx(value, rel=1e-3) for key, value in noise_for(record, program).items()}


def test_a_walk_that_was_not_seen_is_no_silent_zero(tmp_path, imulab):
    samples = np.random.default_rng(3).normal(0, 0.02, (6000, 3))
    il.write(
        il.Recording.from_arrays(accel=samples + np.array([0, 0, 9.8]), rate=100.0, unit="m/s^2"), tmp_path / "a.csv"
    )
    done = imulab("noise", "fit", "a.csv", "--terms", "N", "--for", "kalibr")
    assert "accelerometer_random_walk: 0\n" in done.stdout
    assert "accelerometer_random_walk: none was seen in 60 s, and 0 makes a filter trust a bias for ever" in done.stderr


def test_export_takes_the_record(home, record, tmp_path, capsys):
    parameters = {f"bias_{a}": Parameter(0.0, 1e-4, "m/s^2") for a in "xyz"}
    parameters |= {f"scale_factor_{a}": Parameter(1.0, 1e-4, "m/s^2/(m/s^2)") for a in "xyz"}
    parameters |= {f"misalignment_{pair}": Parameter(0.0, 1e-4, "rad") for pair in ("yx", "zx", "zy")}
    model = {"order": 1, "gravity": {"value": 9.81, "unit": "m/s^2", "from": "argument"}, "output_unit": "m/s^2"}
    Calibration("tumble", parameters, Covariance((), ()), model, {}).save(tmp_path / "c.json")
    white, walk = sizes(record, "gyro")
    for target in ("kalibr", "openvins"):
        arguments = ["export", "--to", target, str(tmp_path / "c.json"), "-o", str(tmp_path / target)]
        assert main([*arguments, "--noise", str(home / "n.json")]) == 0, capsys.readouterr().err
        (file,) = (tmp_path / target).iterdir()
        lines = dict(
            line.strip().split("  #")[0].split(": ") for line in file.read_text().splitlines() if "  # " in line
        )
        assert float(lines["gyroscope_noise_density"]) == pytest.approx(white)
        assert float(lines["gyroscope_random_walk"]) == pytest.approx(walk)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--for", "kalibre"], "--for 'kalibre': expected one of kalibr"),
        (["--rate", "100"], "--rate and --step say how the filter of --for runs: expected --for"),
        (["--for", "vins", "--rate", "0"], "--rate 0 Hz: expected more than 0"),
        (["--for", "px4", "--step", "x"], "--step 'x': expected a number"),
        (["--terms", "NXB"], "--terms 'NXB': expected auto, or N and any"),
        (["--horizon", "0"], "--horizon 0 s: expected more than 0"),
        (["--band", "-1"], "--band -1 Hz: expected more than 0"),
        (["--columns", "gyro_x,"], "--columns 'gyro_x,': expected names of columns"),
        (["--columns", "gyro_w"], "no column 'gyro_w'; expected one of"),
        (["--regress", "humidity"], "--regress 'humidity': expected one of no time temperature"),
        (["--steps", "x"], "--steps 'x': expected one of say remove"),
        (["--window", "0:1"], "expected at least 500"),
    ],
)
def test_mistakes_are_refused_in_one_line(home, tmp_path, capsys, arguments, message):
    capsys.readouterr()
    output = tmp_path / "out.json"
    assert main(["noise", "fit", str(home / "rest.csv"), *arguments, "-o", str(output)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert message in captured.err
    assert not output.exists()


def test_the_table_for_filters_has_the_limit_of_a_walk_that_was_not_seen():
    samples = np.random.default_rng(3).normal(0, 0.02, (20_000, 3))
    record = il.fit_noise({"gyro": samples}, rate=100.0, unit="rad/s").calibration
    table = next(item for item in exhibits(record).items if getattr(item, "title", "").startswith("For filters"))
    zero = [row for row in table.rows if record.fit["filter_walk"][row[0]]["value"] == 0]
    assert zero
    for name, _, _, walk, interval, *_ in zero:
        limit = record.parameters[f"{name}_walk"].unseen_limit
        assert limit > 0
        assert (walk, interval) == (f"< {limit:.2g}", f"0 to {limit:.2g}")


def test_the_keys_of_a_program_are_written_where_the_name_says_so(imulab, tmp_path):
    yaml = pytest.importorskip("yaml")
    imulab("noise", "simulate", "--duration", "300 s", "--white", "0.3 deg/sqrt(h)", "-o", "rest.csv")
    done = imulab("noise", "fit", "rest.csv", "--for", "kalibr", "-o", "k.yaml")
    printed = dict(line.split(": ") for line in done.stdout.splitlines() if not line.startswith("kalibr"))
    assert done.stdout.endswith("kalibr: k.yaml\n")
    written = yaml.safe_load((tmp_path / "k.yaml").read_text())
    assert written == {key: float(value) for key, value in printed.items()}
    assert all(isinstance(value, float) for value in written.values())
    for program, name, row in (
        ("px4", "p.params", "1\t1\tEKF2_GYR_NOISE\t0."),
        ("ardupilot", "a.param", "EK3_GYRO_P_"),
    ):
        assert imulab("noise", "fit", "rest.csv", "--for", program, "-o", name).returncode == 0
        assert f"\n{row}" in (tmp_path / name).read_text()
    assert imulab("noise", "fit", "rest.csv", "--for", "px4", "-o", "r.json").stdout.endswith("record: r.json\n")
    assert il.load(tmp_path / "r.json").procedure == "noise"
    done = imulab("noise", "fit", "rest.csv", "--for", "kalibr", "--json", "-o", "j.yaml")
    assert json.loads(done.stdout)["procedure"] == "noise"
    assert yaml.safe_load((tmp_path / "j.yaml").read_text()) == written


@pytest.mark.parametrize("name", ["r.html", "r.csv", "r.yaml", "r.params"])
def test_a_record_is_not_written_under_another_format_s_name(imulab, tmp_path, name):
    recording = il.simulate_tumble(gravity=9.81, attitudes=12, order=1)
    il.write(recording, tmp_path / "t.csv")
    for words in ("noise fit t.csv", "noise fit t.csv --for kalibr", "tumble fit t.csv", "rate turn t.csv"):
        if "--for" in words and name == "r.yaml":
            continue
        done = imulab(*words.split(), "-o", name)
        assert (done.returncode, f"{name}: a record is JSON; expected a name such as r.json" in done.stderr) == (
            2,
            True,
        )
        assert not (tmp_path / name).exists()

"""Powers of the rate: which are taken, that desk and unit invert them, and what other programs leave out."""

import numpy as np
import pytest

import imulab as il
import madeup
from imulab.cli import main
from imulab.procedures.rate.solve import RateProblem, choose_orders
from reference import rate as reference
from test_rate import BIAS, SCALE, TURN, whole

DEGREE = reference.DEGREE
LARGEST = 300 * DEGREE
NOISE = 0.3 / 60 * DEGREE / np.sqrt(8)  # 0.3 deg/sqrt(h) over dwells of 8 s


def problem(rng, k=(), cycles=3, each=0.0, noise=NOISE):
    """Dwells of one gyroscope, made here: rates with errors of their own, which all visits share."""
    sizes = DEGREE * np.array([0.0, 10, 50, 100, 200, 300])
    way = np.concatenate([sizes, sizes[-2::-1], -sizes[1:], -sizes[-2::-1]])
    table, run = np.tile(way, cycles), np.repeat(np.arange(cycles), len(way))
    rates, which = np.unique(table, return_inverse=True)
    turned = table + (each * rng.standard_normal(len(rates)))[which]
    mean = turned + sum(c * turned ** (p + 2) for p, c in enumerate(k)) + 1e-3 * rng.standard_normal(cycles)[run]
    mean = mean + noise * rng.standard_normal(len(table))
    same = np.zeros(len(table), dtype=int)
    variance = np.full((len(table), 1), noise**2)
    return RateProblem(
        (2,), run, same + 2, same + 1, table, table, mean[:, None], variance, np.zeros((len(run), 2)), 0 * table
    )


@pytest.mark.parametrize("each", [0.0, 5e-6 * LARGEST, 20e-6 * LARGEST])
def test_linear_gyroscopes_seldom_get_powers(each, reduced):
    trials = 50 if reduced else 150
    rng = np.random.default_rng(4)
    bent = sum(choose_orders(problem(rng, each=each))[0] > 1 for _ in range(trials))
    assert bent <= 7 / 150 * trials  # more than 7 of 150 at 2 % happens once in 50; 0 to 2 are found


def test_powers_that_are_there_are_taken():
    rng = np.random.default_rng(5)
    k2, k3 = 30e-6 / LARGEST, 60e-6 / LARGEST**2
    assert all(choose_orders(problem(rng, (k2,)))[0] == 2 for _ in range(10))
    assert sum(choose_orders(problem(rng, (0.0, k3)))[0] == 3 for _ in range(20)) >= 18


def test_auto_gives_each_gyroscope_its_powers_and_apply_inverts_them(tmp_path):
    k3 = np.array([0.0, 3e-5, 0.0])
    how = {"noise": 1e-5, "rng": np.random.default_rng(1)}
    record = il.fit_rate(whole(powers=(np.zeros(3), k3), **how)).calibration
    assert record.options["order"] == "auto"
    assert [record.fit["axes"][axis]["order"] for axis in "xyz"] == [1, 3, 1]
    assert record.model["gyro_order"] == 3
    assert record.fit["axes"]["y"]["by_polynomial"] < 2e-6 < 50e-6 < record.value("gyro_nonlinearity_y")
    assert "gyro_k3_y" in record.parameters
    assert "gyro_k3_x" not in record.parameters
    rates = np.random.default_rng(3).uniform(-3, 3, (50, 3))
    s = rates @ TURN.T
    out = SCALE * (s + k3 * s**3 + BIAS)
    flight = il.Recording.from_arrays(gyro=out / DEGREE, rate=100.0, units={"gyro": "deg/s"})
    np.testing.assert_allclose(il.apply(record, flight).triad("gyro") * DEGREE, rates, atol=2e-5)
    record.save(tmp_path / "r.json")
    il.write_report(il.load(tmp_path / "r.json"), tmp_path / "r.html")
    assert ">powers leave</th>" in (tmp_path / "r.html").read_text(encoding="utf-8")
    il.export("blob", il.load(tmp_path / "r.json"), tmp_path / "fw")
    assert (tmp_path / "fw" / "unit.blob").read_bytes()[8] == 2
    by_blob = il.apply(str(tmp_path / "fw" / "unit.blob"), flight).triad("gyro") * DEGREE
    np.testing.assert_allclose(by_blob, rates, atol=3e-5)


def test_without_powers_blobs_stay_what_they_were(tmp_path):
    il.export("blob", madeup.tumble(2, gyro=True), tmp_path)
    assert (tmp_path / "unit.blob").read_bytes()[8] == 1


def test_other_programs_leave_the_powers_out_only_when_asked(tmp_path):
    unit = {"m": "m/s^2", "g": "rad/s"}
    made = madeup.tumble(1, gyro=True, powers=3)
    parameters = {
        name: type(p)(
            1.0 if "scale" in name else p.value, None, p.unit.replace("count", unit["g" if "gyro" in name else "m"])
        )
        for name, p in made.parameters.items()
    }
    model = {**made.model, "output_unit": "m/s^2", "gyro_output_unit": "rad/s"}
    record = type(made)("tumble", parameters, made.covariance, model, {}, sensor=made.sensor)
    for target in ("kalibr", "openvins", "fusion", "ros", "px4"):
        with pytest.raises(il.ImulabError, match=r"gyro_k2 gyro_k3.*within \+-300 deg/s"):
            il.export(target, record, tmp_path / target)
    rate = 300 * DEGREE
    cost = max(
        abs(parameters[f"gyro_k2_{a}"].value) * rate**2 + abs(parameters[f"gyro_k3_{a}"].value) * rate**3 for a in "xyz"
    )
    with pytest.raises(il.ImulabError, match=f"up to {np.degrees(cost):.3g} deg/s within"):
        il.export("kalibr", record, tmp_path / "kalibr")
    assert il.export("kalibr", record, tmp_path / "kalibr", lossy=True)


def test_rates_beyond_the_test_are_told(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    il.fit_rate(
        whole(powers=(np.zeros(3), np.full(3, 3e-5)), noise=1e-5, rng=np.random.default_rng(1))
    ).calibration.save("r.json")
    for speed, said in ((195.0, False), (300.0, True)):
        flight = il.Recording.from_arrays(gyro=np.full((50, 3), speed), rate=100.0, units={"gyro": "deg/s"})
        il.write(flight, "f.csv")
        capsys.readouterr()
        assert main(["apply", "r.json", "f.csv", "-o", "out.csv"], project=False) == 0
        error = capsys.readouterr().err
        assert ("50 samples beyond 200 deg/s (up to 3" in error) == said


def test_the_threshold_is_the_least_rate_that_shows():
    """A dead zone of 0.03 deg/s: rates of 0.05 deg/s or less come out at less than half."""
    way = [0, 0.01, 0.02, 0.05, 0.1, 10, 100, 200, 100, 0, -0.01, -0.02, -0.05, -0.1, -10, -100, -200, -100, 0]
    made = whole(way=way, faces=("+z",), noise=1e-6, rng=np.random.default_rng(1))
    (one,) = made.recordings
    true = (one.column("gyro_z") - SCALE[2] * BIAS[2]) / SCALE[2]
    dead = np.sign(true) * np.maximum(np.abs(true) - 0.03 * DEGREE, 0)
    cut = il.Recording({**one.columns, "gyro_z": SCALE[2] * (dead + BIAS[2])}, one.units, name="+z.csv")
    found = il.fit_rate(type(made)(made.test, (cut,), {})).calibration.parameters["gyro_threshold_z"]
    assert found.value == pytest.approx(0.1 * DEGREE, rel=1e-6)
    assert found.standard_uncertainty == pytest.approx(0.05 * DEGREE / np.sqrt(12), rel=1e-6)
    assert not any("threshold" in name for name in il.fit_rate(whole(faces=("+z",))).calibration.parameters)

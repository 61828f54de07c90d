"""Logs at rest of given noise: coefficients as people write them, and what such logs hold."""

from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.errors import OptionError
from imulab.procedures.noise.schema import coefficient
from imulab.procedures.noise.simulate import noise_log

DEGREE, G = np.pi / 180, 9.80665


@pytest.mark.parametrize(
    ("term", "text", "value", "unit"),
    [
        ("white", "0.3 deg/sqrt(h)", 0.3 * DEGREE / 60, "rad/s"),
        ("white", "0.3 °/√hr", 0.3 * DEGREE / 60, "rad/s"),
        ("white", "0.005 deg/s/√Hz", 0.005 * DEGREE, "rad/s"),
        ("white", "5 mdps/sqrt(Hz)", 0.005 * DEGREE, "rad/s"),
        ("white", "18 deg/h/sqrt(Hz)", 0.005 * DEGREE, "rad/s"),
        ("white", "100 µg/√Hz", 1e-4 * G, "m/s^2"),
        ("white", "0.06 m/s/sqrt(h)", 1e-3, "m/s^2"),
        ("white", "2 count/sqrt(Hz)", 2, "count"),
        ("flicker", "5 deg/h", 5 * DEGREE / 3600, "rad/s"),
        ("flicker", "40 ug", 40e-6 * G, "m/s^2"),
        ("walk", "6 deg/h/sqrt(h)", 6 * DEGREE / 3600 / 60, "rad/s"),
        ("walk", "1e-5 rad/s^2/sqrt(Hz)", 1e-5, "rad/s"),
        ("walk", "1e-4 m/s^3/√Hz", 1e-4, "m/s^2"),
        ("walk", "3 ug/sqrt(s)", 3e-6 * G, "m/s^2"),
        ("quantisation", "1 arcsec", DEGREE / 3600, "rad/s"),
        ("quantisation", "2 mm/s", 2e-3, "m/s^2"),
        ("quantisation", "2 V s", 2, "V"),
        ("white", "2e-4", 2e-4, None),
        ("white", 2e-4, 2e-4, None),
    ],
)
def test_coefficients_are_read_in_the_units_of_data_sheets(term, text, value, unit):
    assert coefficient(text, term, term) == (pytest.approx(value, rel=1e-12), unit)


def test_a_log_has_the_allan_deviation_of_its_terms():
    """Against the curve of the definition, at averaging times where one term is nearly all there is."""
    white, walk = 0.3 * DEGREE / 60, 0.02 * DEGREE
    log = il.simulate_noise(white="0.3 deg/sqrt(h)", walk=walk, rate="50 Hz", duration="2 h", columns="gyro_x,gyro_y")
    for name in ("gyro_x", "gyro_y"):
        curve = il.allan_deviation(log.si(name), 50.0)
        at = dict(zip(curve.tau.tolist(), curve.deviation.tolist(), strict=True))
        assert at[0.02] == pytest.approx(white / np.sqrt(0.02), rel=0.02)
        assert at[20.48] == pytest.approx(walk * np.sqrt(20.48 / 3), rel=0.15)
    assert abs(np.corrcoef(np.diff(log.si("gyro_x")), np.diff(log.si("gyro_y")))[0, 1]) < 0.01


@pytest.mark.slow
def test_a_record_is_simulated_and_found_again(tmp_path):
    first = il.fit_noise(il.simulate_noise(white="100 ug/sqrt(Hz)", walk="300 ug/sqrt(h)", duration="20 min"))
    first = replace(first.calibration, sensor={"serial": "A-7"})
    first.save(tmp_path / "r.json")
    log = il.simulate_noise(from_=tmp_path / "r.json", duration="20 min", seed=9)
    assert list(log.columns) == ["time", "accel_x", "accel_y", "accel_z"]
    assert log.metadata["truth_accel_x_white"].endswith("m/s^2/sqrt(Hz)")
    assert log.metadata["serial"] == "A-7"
    again = il.fit_noise(log)
    assert all(not change.significant for change in il.compare_records(first, again.calibration).changes)


def test_blocks_are_the_log_and_no_more_than_one_is_made_at_a_time(tmp_path, capsys):
    words = [
        "noise",
        "simulate",
        "--white",
        "0.1 deg/sqrt(h)",
        "--walk",
        "1e-6",
        "--columns",
        "gyro_z",
        "--rate",
        "1 kHz",
    ]
    assert main([*words, "--duration", "300 s", "-o", str(tmp_path / "long.csv")]) == 0
    assert "300000 samples of gyro_z, 300 s at 1000 Hz" in capsys.readouterr().out
    whole = il.simulate_noise(white="0.1 deg/sqrt(h)", walk=1e-6, columns=["gyro_z"], rate=1000.0, duration=300.0)
    np.testing.assert_array_equal(il.read(tmp_path / "long.csv").column("gyro_z"), whole.column("gyro_z"))
    terms = {"white": 1.0, "flicker": None, "walk": None, "quantisation": None, "gm": None}
    month = noise_log(from_=None, **terms, rate="1 kHz", duration="700 h", columns="gyro_x", seed=1).blocks()
    assert len(next(month)) < 1e6
    assert next(month).column("time")[0] > 100


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "no noise is given: expected one of --white --flicker --walk --quantisation --gm"),
        ({"white": "0.3 degs"}, "white '0.3 degs': expected a number with a unit such as 0.3 deg/sqrt(h)"),
        ({"white": "0.3 deg/h"}, "white '0.3 deg/h': expected a number with a unit such as"),
        ({"white": "0,3 deg/sqrt(h)"}, "white '0,3 deg/sqrt(h)': expected a number with"),
        ({"white": -1.0}, "white -1.0: expected more than 0"),
        (
            {"white": "0.3 deg/sqrt(h)", "walk": "3 ug/sqrt(s)"},
            "walk: noise of an output in m/s^2; expected that of one in rad/s",
        ),
        (
            {"white": "0.3 deg/sqrt(h)", "columns": "accel_x"},
            "columns accel_x: noise of an output in rad/s is of no such sensor",
        ),
        ({"gm": "3 deg/h"}, "gm '3 deg/h': expected standard deviation and time, such as 20 deg/h:300 s"),
        ({"gm": "3 deg/h:-3 s"}, "gm -3 s: expected a correlation time above 0"),
        ({"gm": ["1 deg/h:1 s"] * 3}, "gm: expected at most 2"),
        ({"white": 1.0, "columns": "gyro_x,gyro_x"}, "columns 'gyro_x,gyro_x': expected names of columns"),
        ({"white": 1.0, "rate": 0.0}, "rate 0 Hz: expected 0.001"),
        ({"white": 1.0, "duration": "1 ms"}, "duration 0.001 s: expected 2 to"),
        (
            {"white": 1.0, "duration": 1e7},
            "duration 1e+07 s: 1000000000 samples of 3 columns at once; imulab noise simul",
        ),
        ({"white": 1.0, "seed": -1}, "seed -1: expected a whole number from 0"),
    ],
)
def test_what_cannot_be_is_refused(options, message):
    with pytest.raises(OptionError) as refused:
        il.simulate_noise(**options)
    assert str(refused.value).startswith(message)


def test_the_command_refuses_in_one_line_and_writes_nothing(tmp_path, capsys):
    il.fit_noise(il.simulate_noise(white=1e-3, duration="10 s", rate="100 Hz")).save(tmp_path / "r.json")
    for words, message in (
        (["--from", str(tmp_path / "r.json"), "--white", "1"], "--white: the record says that already"),
        (["--from", str(tmp_path / "r.json"), "--columns", "gyro_q"], "--columns gyro_q: the record has gyro_x gyro_y"),
        (["--white", "x"], "--white 'x': expected a number with a unit such as 0.3 deg/sqrt(h)"),
        (["--gm", "3:2 h:1"], "--gm '3:2 h:1': expected standard deviation and time"),
    ):
        assert main(["noise", "simulate", *words, "-o", str(tmp_path / "o.csv")]) == 2
        captured = capsys.readouterr()
        assert captured.err.count("\n") == 1
        assert message in captured.err
        assert not (tmp_path / "o.csv").exists()

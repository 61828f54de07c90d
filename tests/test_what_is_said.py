"""What commands and functions say: serial numbers, arguments, limits of what was not seen, frames for frames."""

import math
import re

import numpy as np
import pytest

import imulab as il
from imulab.cli.app import commands
from imulab.errors import OptionError
from imulab.procedures.noise.wants import PROGRAMS

FITS = ("tumble fit", "tumble gyro", "tumble mag", "array calibrate", "warmup fit", "noise fit", "thermal fit")
FITS = (*FITS, "rate fit", "rate turn")


def test_every_fit_takes_a_serial_number():
    options = {command.path: {option.name for option in command.options} for command in commands()}
    for path in FITS:
        assert "serial" in options[path], path


def test_the_stated_serial_number_is_the_record_s(imulab, tmp_path):
    recording = il.simulate_tumble(gravity=9.81, attitudes=12, order=1)
    il.write(recording, tmp_path / "f.csv")
    done = imulab("tumble", "fit", "f.csv", "--gravity", "9.81", "--order", "1", "--serial", "SN 7/b", "-o", "r.json")
    assert done.returncode == 0
    assert il.load(tmp_path / "r.json").sensor["serial"] == "SN 7/b"
    for data in (recording, tmp_path / "f.csv"):
        assert il.fit_tumble(data, gravity=9.81, order=1, serial="A").calibration.sensor["serial"] == "A"
    still = il.simulate_array(experiment="static", duration=60.0)
    assert il.calibrate_array(still, serial="B").calibration.sensor["serial"] == "B"


def test_dir_lists_public_names_alone():
    assert dir(il) == sorted(il.__all__)
    assert all(hasattr(il, name) for name in dir(il))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: il.fit_tumble(),
            r"fit_tumble: missing a required argument: 'data'; expected fit_tumble\(data, .*layout=.*window=\)",
        ),
        (
            lambda: il.fit_gyro(),
            r"fit_gyro: missing required arguments: 'accel', 'data'; expected fit_gyro\(accel, data, accel_data=.*",
        ),
        (lambda: il.read("x", foo=1, bar=2), r"read: unknown options 'foo', 'bar'; known: file layout topic .*"),
        (
            lambda: il.fit_tumble("x", gravty=1, foo=2),
            r"fit_tumble: unknown options 'gravty', 'foo'; .*mean 'gravity'\?",
        ),
        (
            lambda: il.normal_gravity(),
            r"normal_gravity: missing a required argument: 'latitude'; expected normal_gravity\(.*",
        ),
    ],
)
def test_messages_about_arguments_name_all_of_them(call, message):
    with pytest.raises(OptionError) as caught:
        call()
    assert re.fullmatch(message, str(caught.value))


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_a_frame_is_corrected_to_a_frame_of_its_library(library):
    pytest.importorskip(library)
    recording = il.simulate_tumble(gravity=9.81, attitudes=12, order=1)
    fit = il.fit_tumble(recording, gravity=9.81, order=1)
    frame = recording.to_frame(library)
    for record in (fit, fit.calibration):
        corrected = record.apply(frame)
        assert type(corrected) is type(frame)
        assert list(corrected.columns) == list(frame.columns)
        expected = fit.apply(recording)
        assert isinstance(expected, il.Recording)
        np.testing.assert_array_equal(np.asarray(corrected["accel_y [m/s^2]"]), expected.columns["accel_y"])


@pytest.fixture(scope="module")
def noise():
    log = il.simulate_noise(white="0.3 deg/sqrt(h)", rate=50.0, duration="10 min", columns=["gyro_z"])
    return il.fit_noise(log)


def test_what_was_not_seen_is_a_limit_and_not_zero(noise):
    limit = noise.calibration.parameters["gyro_z_walk"].interval_95[1]
    assert noise.calibration.parameters["gyro_z_walk"].unseen_limit == limit > 0
    assert re.search(r"gyro_z_walk +< \d", repr(noise))
    assert f"gyro_z_walk < {limit:.2g} rad/s/sqrt(s)" in str(noise.calibration)
    assert not re.search(r"\b0 (deg|rad)", repr(noise) + str(noise.calibration))
    frame = noise.to_frame("polars")
    row = dict(zip(frame.columns, frame.row(list(frame["parameter"]).index("gyro_z_walk")), strict=True))
    assert math.isnan(row["value"])
    assert row["below"] == limit
    white = dict(zip(frame.columns, frame.row(0), strict=True))
    assert math.isnan(white["below"])
    assert white["value"] > 0


def test_what_a_filter_wants_of_a_saved_record(imulab, tmp_path, noise):
    noise.save(tmp_path / "n.json")
    for program in PROGRAMS:
        done = imulab("noise", "fit", "n.json", "--for", program)
        assert done.returncode == 0
        wanted = {key: f"{value:.4g}" for key, value in noise.wants(program).items()}
        assert dict(line.split(": ") for line in done.stdout.splitlines()) == wanted
    text = imulab("noise", "fit", "--help").stdout
    assert all(program in text for program in PROGRAMS)
    done = imulab("show", "n.json").stdout
    assert re.search(r"column +N_h +unit +K_h +95 % of K_h +unit", done)
    assert "rad/s/sqrt(Hz)" in done
    il.fit_tumble(il.simulate_tumble(gravity=9.81, attitudes=12, order=1), gravity=9.81, order=1).save(
        tmp_path / "t.json"
    )
    done = imulab("noise", "fit", "t.json", "--for", "px4")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)


def test_single_rows_without_numbers_are_bridged_in_a_tumble_test():
    recording = il.simulate_tumble(gravity=9.81, attitudes=16, order=1)
    columns = {name: values.copy() for name, values in recording.columns.items()}
    columns["accel_y"][[700, 1500, 1501]] = np.nan
    columns["gyro_z"][2000] = np.nan
    torn = recording.with_columns(columns, {})
    whole = il.fit_tumble(recording, order=1, gravity=9.81).calibration
    fit = il.fit_tumble(torn, order=1, gravity=9.81).calibration
    for name, parameter in whole.parameters.items():
        assert abs(fit.parameters[name].value - parameter.value) < 0.2 * parameter.standard_uncertainty
    assert any("3 rows without numbers (the first row 701) bridged from their neighbours" in w for w in fit.warnings)
    both = il.fit_gyro(whole, torn).calibration
    expected = il.fit_gyro(whole, recording).calibration.parameters["gyro_scale_factor_z"]
    found = both.parameters["gyro_scale_factor_z"]
    assert abs(found.value - expected.value) < 0.2 * expected.standard_uncertainty
    columns["accel_y"][700:706] = np.nan
    with pytest.raises(il.ImulabError, match=r"row 701.*, column accel_y: expected a finite number, found nan"):
        il.fit_tumble(recording.with_columns(columns, {}), order=1, gravity=9.81)

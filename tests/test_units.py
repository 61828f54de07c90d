"""Units against the values that define them."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imulab.errors import OptionError, UnitError
from imulab.quantities import parse_units
from imulab.units import (
    STANDARD_GRAVITY,
    conversion_factor,
    from_si,
    likely_times,
    parse_scale_factor,
    parse_unit,
    si_unit,
    to_si,
)

# What one of each unit is in SI (SI brochure, 9th edition, tables 1, 4, 7 and 8; IAU: 1 arcsec = pi/648000 rad; gravity
# 3rd CGPM 1901; 0 degC = 273.15 K). The digits of pi/180 and pi/648000 are OEIS A019685 and A209538.
ONE = {
    "s": 1.0,
    "ms": 0.001,
    "us": 0.000001,
    "ns": 0.000000001,
    "min": 60.0,
    "h": 3600.0,
    "m/s^2": 1.0,
    "g": 9.80665,
    "mg": 0.00980665,
    "ug": 0.00000980665,
    "rad": 1.0,
    "mrad": 0.001,
    "urad": 0.000001,
    "deg": 0.017453292519943295769,
    "arcsec": 0.0000048481368110953599359,
    "rad/s": 1.0,
    "deg/s": 0.017453292519943295769,
    "deg/h": 0.0000048481368110953599359,
    "mrad/s": 0.001,
    "mdeg/s": 0.000017453292519943295769,
    "deg/min": 0.00029088820866572159616,
    "degC": 1.0,
    "count": 1.0,
    "V": 1.0,
    "mV": 1.0,
    "A": 1.0,
    "mA": 1.0,
    "pulse/s": 1.0,
    "count/(deg/s)": 57.295779513082320877,
    "V/(deg/s)": 57.295779513082320877,
    "mA/(deg/s)": 57.295779513082320877,
    "m": 1.0,
    "Hz": 1.0,
    "1": 1.0,
    "ppm": 0.000001,
}
QUANTITIES = {
    "time": ["s", "ms", "us", "ns", "min", "h"],
    "acceleration": ["m/s^2", "g", "mg", "ug"],
    "angle": ["rad", "mrad", "urad", "deg", "arcsec"],
    "rate": ["rad/s", "mrad/s", "deg/s", "mdeg/s", "deg/min", "deg/h"],
    "temperature": ["degC", "K"],
    "length": ["m"],
    "frequency": ["Hz"],
    "number": ["1", "ppm"],
}
PAIRS = [(a, b) for symbols in QUANTITIES.values() for a in symbols for b in symbols]
EPS = np.finfo(float).eps


@pytest.mark.parametrize(("symbol", "value"), ONE.items())
def test_one_of_each_unit_is_its_published_si_value(symbol, value):
    # Factor and product are rounded once or twice each.
    assert math.isclose(to_si(1.0, symbol), value, rel_tol=3 * EPS)


def test_kelvin_becomes_degrees_celsius():
    assert to_si(300.0, "K") == pytest.approx(26.85, abs=300 * EPS)
    assert from_si(-40.0, "K") == pytest.approx(233.15, abs=300 * EPS)


@settings(derandomize=True, database=None, deadline=None, max_examples=100)
@given(value=st.floats(1e-12, 1e6) | st.floats(-1e6, -1e-12) | st.just(0.0))
@pytest.mark.slow
def test_every_unit_comes_back_from_si(value):
    for symbol in (*ONE, "K"):
        back = from_si(to_si(value, symbol), symbol)
        # Two roundings, and for K one more at the size of the larger of value and offset.
        limit = 2 * EPS * abs(value) + (EPS * (abs(value) + 273.15) if symbol == "K" else 0.0)
        assert abs(back - value) <= limit, symbol


def test_arrays_are_converted_as_their_elements():
    values = np.array([0.0, -1.5, 360.0])
    assert to_si(values, "deg/h").tolist() == [to_si(value, "deg/h") for value in values.tolist()]
    assert from_si(values, "mg").tolist() == [from_si(value, "mg") for value in values.tolist()]


@pytest.mark.parametrize("symbol", ["count", "V", "mV", "A", "mA", "pulse/s", "m/s^2", "rad/s", "degC", "s"])
def test_counts_volts_and_si_keep_every_bit(symbol):
    values = np.random.default_rng(1).standard_normal(100)
    assert to_si(values, symbol).tobytes() == values.tobytes()
    assert from_si(values, symbol).tobytes() == values.tobytes()


def test_intervals_convert_as_differences_of_values():
    for source, target in PAIRS:
        through_si = from_si(to_si(1000.0, source), target) - from_si(to_si(0.0, source), target)
        # Values of up to 1e3 s are 1e9 us: relative rounding only; K and degC have the offset's rounding besides.
        expected = pytest.approx(through_si, rel=4 * EPS, abs=1273.15 * EPS)
        assert conversion_factor(source, target) * 1000.0 == expected, (source, target)


def test_a_unit_converts_to_itself_by_exactly_one():
    assert {symbol: conversion_factor(symbol, symbol) for symbol in (*ONE, "K")} == dict.fromkeys((*ONE, "K"), 1.0)


@pytest.mark.parametrize(
    ("source", "target"),
    [
        ("count", "m/s^2"),
        ("g", "count"),
        ("V", "g"),
        ("count", "V"),
        ("mV", "count"),
        ("mA", "mV"),
        ("A", "V"),
        ("pulse/s", "count"),
        ("count/(deg/s)", "V/(deg/s)"),
        ("deg", "deg/s"),
        ("s", "Hz"),
        ("ppm", "count"),
    ],
)
def test_a_conversion_between_quantities_is_refused_naming_both(source, target):
    with pytest.raises(UnitError) as caught:
        conversion_factor(source, target)
    assert f"cannot convert {source} (" in str(caught.value)
    assert f" to {target} (" in str(caught.value)


@pytest.mark.parametrize(
    ("spelling", "symbol"),
    [
        (" m/s² ", "m/s^2"),
        ("m/s2", "m/s^2"),
        ("m/s**2", "m/s^2"),
        ("\N{MICRO SIGN}g", "ug"),
        ("\N{GREEK SMALL LETTER MU}g", "ug"),
        ("\N{MICRO SIGN}s", "us"),
        ("\N{GREEK SMALL LETTER MU}s", "us"),
        ("°C", "degC"),
        ("°/s", "deg/s"),
        ("°", "deg"),
        ("counts", "count"),
        ("℃", "degC"),
        ("dps", "deg/s"),
        ("mdps", "mdeg/s"),
        ("°/min", "deg/min"),
        ("pulses/s", "pulse/s"),
    ],
)
def test_usual_spellings_are_understood(spelling, symbol):
    assert parse_unit(spelling).symbol == symbol


@pytest.mark.parametrize("text", ["", "furlong", "G", "M/S^2", "deg/ s", "m/s^3"])
def test_an_unknown_unit_is_refused_with_the_known_ones(text):
    with pytest.raises(UnitError) as caught:
        parse_unit(text)
    message = str(caught.value)
    assert f"unknown unit {text!r}" in message
    assert {*ONE, "K"} <= set(message.split("known units: ")[1].partition(";")[0].split())


@pytest.mark.parametrize(
    "text", ["rpm", "rev/s", "mm/s^2", "ft/s^2", "urad/s", "kg", "pT", "mV/g", "mGal", "degF", "deg/m", "Mrad"]
)
def test_another_unit_is_no_slip_of_a_known_one(text):
    with pytest.raises(UnitError) as caught:
        parse_unit(text)
    assert "did you mean" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "guess"),
    [
        ("accel=G", "g"),
        ("accel=M/S^2", "m/s^2"),
        ("accel=mGal", None),
        ("gyro=rads", "rad/s"),
        ("gyro=degps", "deg/s"),
        ("gyro=DEG/sec", "deg/s"),
        ("gyro=deg/s2", None),
        ("gyro=deg/m", None),
        ("table_angle=degs", None),
        ("temperature=degF", None),
        ("temperature=deg C", "degC"),
        ("mag=nt", "nT"),
        ("mag=degs", None),
    ],
)
def test_a_guess_is_of_the_columns_quantity_and_of_the_same_size(text, guess):
    with pytest.raises(OptionError) as caught:
        parse_units(text, "--unit")
    assert str(caught.value).partition("; did you mean ")[2] == (f"{guess!r}?" if guess else "")


@pytest.mark.parametrize("convert", [lambda unit: to_si(1.0, unit), lambda unit: from_si(1.0, unit)])
def test_conversion_in_an_unknown_unit_is_refused(convert):
    with pytest.raises(UnitError, match="unknown unit 'parsec'"):
        convert("parsec")


def test_standard_gravity_is_that_of_the_cgpm():
    assert STANDARD_GRAVITY == 9.80665


def test_millivolts_and_volts_convert_to_each_other():
    assert conversion_factor("mV", "V") == 0.001
    assert conversion_factor("V", "mV") == 1000.0


def test_milliamperes_and_amperes_convert_to_each_other():
    assert conversion_factor("mA", "A") == 0.001
    assert conversion_factor("A", "mA") == 1000.0


@pytest.mark.parametrize(
    ("text", "output", "measured"),
    [
        ("V/(deg/s)", "V", "deg/s"),
        ("mV/g", "mV", "g"),
        ("mA/g", "mA", "g"),
        ("LSB/dps", "count", "deg/s"),
        ("count/(m/s^2)", "count", "m/s^2"),
        ("pulse/s/(deg/h)", "pulse/s", "deg/h"),
        ("mV/°C", "mV", "degC"),
    ],
)
def test_a_scale_factor_is_an_output_per_unit_of_what_is_measured(text, output, measured):
    assert [unit.symbol for unit in parse_scale_factor(text)] == [output, measured]


@pytest.mark.parametrize("text", ["V", "g/V", "V/count", "deg/s", "V/(furlong)", "", "/"])
def test_what_is_no_scale_factor_is_refused_with_an_example(text):
    with pytest.raises(UnitError, match="expected an output per unit of what is measured, such as V/"):
        parse_scale_factor(text)


@pytest.mark.parametrize(
    ("unit", "expected"),
    [("mg", "m/s^2"), ("deg/h", "rad/s"), ("K", "degC"), ("ms", "s"), ("kHz", "Hz"), ("mV", "mV"), ("count", "count"),
     ("count/(deg/s)", "count/(deg/s)"), ("dps", "rad/s")],
)  # fmt: skip
def test_values_in_si_have_the_si_unit_of_their_quantity(unit, expected):
    assert si_unit(unit) == expected


def test_no_unit_of_time_is_proposed_that_is_the_stated_one_by_another_name():
    assert likely_times("µs", 200.0, 20.0) == likely_times("us", 200.0, 20.0) == ""
    assert likely_times("ms", 2e5, 0.06) == "200 Hz if it is in s"

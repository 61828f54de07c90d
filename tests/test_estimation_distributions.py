"""Distribution functions against scipy.special, and where that has fewer digits against sums of 60 digits by mpmath."""

import subprocess
import sys

import numpy as np
import pytest
from scipy import special

from imulab.estimation import distributions as d

SAME = {"rtol": 1e-12, "atol": 1e-300}
FREEDOM = np.logspace(-1, 3, 17)[:, None, None]
OTHER_FREEDOM = np.logspace(-0.9, 3, 13)  # of F(1, 1) scipy has 1e-7
DEVIATIONS = np.linspace(-24, 24, 97)[:, None]
PROBABILITIES = np.concatenate([np.logspace(-60, -1, 60), np.linspace(0.01, 0.99, 99), 1 - np.logspace(-12, -2, 41)])


def test_the_normal_distribution_to_the_smallest_numbers():
    value = np.linspace(-37.5, 9, 20001)
    np.testing.assert_allclose(d.normal_cdf(value), special.ndtr(value), **SAME)
    p = np.concatenate([np.logspace(-300, -1, 2001), PROBABILITIES, 0.5 + np.logspace(-15, -1, 57)])
    np.testing.assert_allclose(d.normal_quantile(p), special.ndtri(p), **SAME)


def test_chi_square_from_a_tenth_of_a_degree_of_freedom_on():
    value = FREEDOM * np.exp(DEVIATIONS * np.sqrt(2 / FREEDOM))
    np.testing.assert_allclose(d.chi_square_tail(value, FREEDOM), special.chdtrc(FREEDOM, value), **SAME)
    freedom = np.logspace(-1, 5, 25)[:, None]
    quantiles = special.chdtri(freedom, PROBABILITIES)
    np.testing.assert_allclose(d.chi_square_upper_quantile(PROBABILITIES, freedom), quantiles, **SAME)


def test_f_of_all_pairs_of_degrees_of_freedom():
    value = np.exp(DEVIATIONS * np.sqrt(2 / FREEDOM + 2 / OTHER_FREEDOM))
    tails = special.fdtrc(FREEDOM, OTHER_FREEDOM, value)
    reliable = tails > 1e-250  # below, some of scipy's are wrong by half
    assert np.mean(reliable) > 0.9
    ours = d.f_tail(value, FREEDOM, OTHER_FREEDOM)
    np.testing.assert_allclose(ours[reliable], tails[reliable], **SAME)
    freedom, other = np.logspace(0, 4, 9)[:, None, None], np.logspace(0, 4, 9)[:, None]
    quantiles = special.fdtri(freedom, other, PROBABILITIES)
    np.testing.assert_allclose(d.f_quantile(PROBABILITIES, freedom, other), quantiles, **SAME)


def test_t_on_both_sides():
    freedom, value = np.logspace(-1, 6, 29)[:, None], np.linspace(-40, 40, 321)  # nearer to 0 scipy loses digits
    np.testing.assert_allclose(d.t_cdf(value, freedom), special.stdtr(freedom, value), **SAME)
    freedom = np.logspace(0, 5, 21)[:, None]
    np.testing.assert_allclose(d.t_quantile(PROBABILITIES, freedom), special.stdtrit(freedom, PROBABILITIES), **SAME)


def test_the_sine_integral():
    value = np.concatenate([np.linspace(0, 100, 5001), np.logspace(-9, 6, 301), [-3.0, -30.0]])
    np.testing.assert_allclose(d.sine_integral(value), special.sici(value)[0], **SAME)


@pytest.mark.parametrize(
    ("freedom", "value", "tail"),
    [
        (0.01, 1e-6, 0.067305644091016237),
        (0.01, 30.0, 9.7547167578884017e-11),
        (0.5, 1400.0, 1.9961522273582565e-307),
        (1.0, 1e-8, 0.99992021154405269),
        (3.0, 1200.0, 7.3316715915506779e-260),
        (1e4, 9000.0, 0.99999999999987302),
        (1e4, 14140.75, 2.2049991978975633e-149),  # 8e-12 beside it in scipy
        (163095.25, 173807.5, 1.3288492757319454e-75),
        (1e6, 999000.0, 0.76017673145987281),
        (1e6, 1e6, 0.4998119368033945),
        (1e6, 1050000.0, 2.185638417489726e-265),
        (1e10, 10001000000.0, 7.7001065428595144e-13),
        (1e10, 9999700000.0, 0.98305326700064899),
    ],
)
def test_chi_square_where_sums_are_long(freedom, value, tail):
    assert d.chi_square_tail(value, freedom) == pytest.approx(tail, rel=1e-12)
    if 1e-100 < tail < 0.9:
        assert d.chi_square_upper_quantile(tail, freedom) == pytest.approx(value, rel=1e-12 * max(1, 1 / freedom))


@pytest.mark.parametrize(
    ("value", "freedom", "other", "tail"),
    [
        (0.001, 0.01, 0.01, 0.51695486452528821),
        (1e6, 0.1, 5.0, 3.7636613284763539e-13),
        (33.75, 56.25, 3162.25, 1.7167329938727337e-276),  # half as much again in scipy
        (64.875, 53.25, 1000.0, 1.4205883459988569e-284),
        (1.25, 2.0, 1e10, 0.28650479690495647),
        (30.0, 20.0, 1e8, 2.8809380874210306e-114),
        (0.0001, 7.0, 1e6, 0.99999999999993106),
        (1.125, 1e5, 1e5, 1.1544261933154671e-77),
        (1.0, 1e6, 1e6, 0.5),
        (0.9921875, 1e6, 3e6, 0.99999920481222585),
        (1.0000152587890625, 1e10, 1e10, 0.22275148861451895),
        (200.0, 3e5, 12.0, 9.8690065904807568e-13),
    ],
)
def test_f_where_fractions_are_long(value, freedom, other, tail):
    assert d.f_tail(value, freedom, other) == pytest.approx(tail, rel=1e-12)
    if 1e-15 < tail < 0.3:
        assert d.f_quantile(1 - tail, freedom, other) == pytest.approx(value, rel=1e-12 + 2e-16 / tail)


@pytest.mark.parametrize(
    ("value", "freedom", "tail"),
    [
        (1e-8, 1.0, 0.49999999681690114),  # 3e-9 beside it in scipy
        (1e-8, 1e6, 0.49999999601057819),
        (3.0, 0.1, 0.37384707698634222),
        (1e8, 0.5, 3.207009754142229e-5),
        (1e60, 2.0, 5.0000000000000005e-121),
        (300.0, 193.25, 3.6337507920219108e-260),
        (30.0, 1e5, 3.6892684361111168e-197),
        (25.0, 1e8, 3.0596927612737393e-138),
        (5.0, 1e12, 2.866515719275123e-7),
        (1.0, 1e10, 0.15865525394355559),
    ],
)
def test_t_where_scipy_has_fewer_digits(value, freedom, tail):
    assert d.t_cdf(-value, freedom) == pytest.approx(tail, rel=1e-12)
    assert d.t_cdf(value, freedom) == pytest.approx(1 - tail, rel=1e-12)
    if tail < 0.4:
        assert d.t_quantile(tail, freedom) == pytest.approx(-value, rel=1e-12 / min(1, freedom))


@pytest.mark.parametrize("freedom", [1e-2, 0.7, 1, 13, 1e3, 1e6, 1e9, 1e12])
def test_quantiles_are_the_inverses(freedom):
    p = np.concatenate([np.logspace(-100, -1, 34), np.linspace(0.1, 0.9, 9)])
    # A value of so many degrees of freedom, rounded, moves the probability by its slope.
    rounding = 1e-12 + 1e-15 * np.sqrt(freedom) * np.sqrt(-2 * np.log(p))
    value = d.chi_square_upper_quantile(p, freedom)
    within = (value > 1e-300) & np.isfinite(value)
    assert np.all(np.abs(d.chi_square_tail(value, freedom) / p - 1)[within] < 10 * rounding[within])
    value = d.t_quantile(p, freedom)
    within = np.abs(value) < 1e150
    np.testing.assert_allclose(d.t_cdf(value, freedom)[within], p[within], rtol=2e-12)


def test_infinitely_many_degrees_of_freedom():
    value = np.linspace(0.1, 8, 21)
    np.testing.assert_array_equal(d.t_cdf(value, np.inf), d.normal_cdf(value))
    np.testing.assert_array_equal(d.t_quantile(PROBABILITIES, np.inf), d.normal_quantile(PROBABILITIES))
    np.testing.assert_allclose(d.f_tail(value, 3, np.inf), special.chdtrc(3, 3 * value), **SAME)
    np.testing.assert_allclose(d.f_tail(value, np.inf, 3), special.chdtr(3, 3 / value), **SAME)
    np.testing.assert_allclose(d.f_quantile(0.2, 3, np.inf), special.chdtri(3, 0.8) / 3, **SAME)
    np.testing.assert_array_equal(d.f_tail([0.9, 1.1], np.inf, np.inf), [1, 0])
    assert d.chi_square_tail(5.0, np.inf) == 1
    assert d.chi_square_upper_quantile(0.5, np.inf) == np.inf


def test_ends_and_what_has_no_answer():
    inf, nan = np.inf, np.nan
    np.testing.assert_array_equal(d.normal_cdf([-inf, 0, inf, nan]), [0, 0.5, 1, nan])
    np.testing.assert_array_equal(d.normal_quantile([0, 0.5, 1, -0.1, 1.1, nan]), [-inf, 0, inf, nan, nan, nan])
    np.testing.assert_array_equal(d.chi_square_tail([-1, 0, inf, nan], 3), [1, 1, 0, nan])
    np.testing.assert_array_equal(d.chi_square_tail(1.0, [0, -1, nan]), [0, nan, nan])
    np.testing.assert_array_equal(d.chi_square_upper_quantile([0, 1, -0.1, nan], 3), [inf, 0, nan, nan])
    np.testing.assert_array_equal(d.f_tail([-1, 0, inf, nan], 3, 4), [1, 1, 0, nan])
    np.testing.assert_array_equal(d.f_tail(1.0, [0, 3, 3], [3, -1, nan]), [nan, nan, nan])
    np.testing.assert_array_equal(d.f_quantile([0, 1, 2], 3, 4), [0, inf, nan])
    np.testing.assert_array_equal(d.t_cdf([-inf, 0, inf, nan], 3), [0, 0.5, 1, nan])
    np.testing.assert_array_equal(d.t_quantile([0, 0.5, 1, nan], 3), [-inf, 0, inf, nan])
    np.testing.assert_array_equal(d.sine_integral([-inf, 0, inf]), [-np.pi / 2, 0, np.pi / 2])


def test_shapes_are_those_that_numpy_broadcasts():
    assert d.f_tail(np.ones((4, 1)), np.ones(3), 2).shape == (4, 3)
    assert d.t_cdf(np.empty((0, 2)), 3).shape == (0, 2)
    assert isinstance(d.chi_square_tail(3, 2), float)
    many = np.arange(1.0, 13.0).reshape(3, 4)[:, ::2].T  # with gaps
    np.testing.assert_allclose(d.chi_square_tail(many, 2), np.exp(-many / 2), **SAME)
    with pytest.raises(ValueError, match="broadcast"):
        d.t_cdf(np.ones(2), np.ones(3))


def test_no_module_of_other_packages_is_replaced():
    code = (
        "import sys, imulab.estimation.distributions\n"
        "print('scipy.special' in sys.modules)\n"
        "import scipy.special\n"
        "print(type(scipy.special).__name__, 'scipy.special._basic' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\nmodule True\n"


@pytest.mark.parametrize(
    ("probability", "text"),
    [
        (0.8, "p = 0.8"),
        (0.0314, "p = 0.031"),
        (3.21e-5, "p = 3e-05"),
        (1e-39, "p below 1e-12"),
        (0.0, "p below 1e-12"),
        (float("nan"), "not tested"),
    ],
)
def test_a_probability_is_never_nought_and_has_the_digits_that_it_deserves(probability, text):
    assert d.probability_text(probability) == text
    assert d.probability_fact(probability) == text.removeprefix("p ").removeprefix("= ")

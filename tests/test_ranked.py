"""Medians, quantiles and distinct values against NumPy's own."""

import numpy as np
import pytest

from imulab.estimation.rows import distinct, median, medians, quantile


@pytest.mark.parametrize("count", [1, 2, 3, 10, 101])
def test_they_are_those_of_numpy(count):
    values = np.random.default_rng(count).normal(size=(4, count)).round(1)
    for axis in (0, 1):
        assert np.array_equal(medians(values, axis), np.median(values, axis=axis))
    assert median(values) == np.median(values)
    for share in (0.0, 0.05, 0.5, 0.99, 1.0):
        assert quantile(values[0], share) == pytest.approx(np.quantile(values[0], share), rel=1e-14, abs=1e-15)
    assert np.array_equal(distinct(values), np.unique(values))


def test_a_value_that_is_no_number_makes_the_median_of_its_row_none():
    assert np.array_equal(medians(np.array([[1.0, np.nan, 3.0], [1.0, 2.0, 3.0]])), [np.nan, 2.0], equal_nan=True)
    assert distinct(np.empty(0)).size == 0

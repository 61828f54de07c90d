"""Residuals that follow direction or time are named as often as they should be, and no oftener."""

from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from conftest import table
from imulab.estimation.decisions import RESIDUALS_FOLLOW_DIRECTION
from imulab.procedures.tumble.attitudes import Trace
from reference import tumble as reference

G = 9.80665
UG = G * 1e-6


def warned(rng, count, *, sigma, order=1, cross=(0.0, 0.0, 0.0), power=(0, 0.0), drift=(0.0, 0.0, 0.0), stated=True):
    """Fit simulated attitudes, and return the warnings on direction and on time; sizes in units of g."""
    truth = reference.random_truth(rng, 1)
    u = reference.random_attitudes(rng, count)
    force = G * u
    rows = []
    for f in force:
        t = [[1, 0, 0], [truth["misalignment_yx"], 1, 0], [truth["misalignment_zx"], truth["misalignment_zy"], 1]]
        s = np.array(t) @ f
        a = s + np.array(cross) / G * s * np.roll(s, -1) + power[1] / G ** (power[0] - 1) * s ** power[0] * [1, 0, 0]
        rows.append([truth[f"scale_factor_{i}"] * (v + truth[f"bias_{i}"]) for i, v in zip("xyz", a, strict=True)])
    time = np.linspace(0, 1, count)
    data = np.array(rows) + sigma * rng.standard_normal((count, 3)) + G * np.outer(time, drift)
    attitudes = il.find_attitudes(table(data, sigma=sigma if stated else None))
    still = Trace(time=np.arange(3.0), variance=np.ones(3), threshold=1.0, quiet=1.0)
    attitudes = replace(attitudes, start=100 * time, stop=100 * time + 3, trace=still)
    found = il.fit_tumble(attitudes, order=order, gravity=G).calibration.warnings
    return (
        next((w for w in found if "function of the direction" in w), ""),
        next((w for w in found if w.startswith("the zeros drift")), ""),
    )


@pytest.mark.parametrize(("count", "stated"), [(24, True), (24, False), (48, True)])
def test_where_nothing_is_wrong_they_are_silent(count, stated, reduced):
    trials = 100 if reduced else 300
    rng = np.random.default_rng(count + stated)
    found = [warned(rng, count, sigma=20 * UG, stated=stated) for _ in range(trials)]
    for alarms in zip(*found, strict=True):
        share = np.mean([bool(w) for w in alarms])
        level = RESIDUALS_FOLLOW_DIRECTION.level
        assert share <= level + 3 * np.sqrt(level / trials)


def test_cross_terms_are_named_with_their_sizes():
    rng = np.random.default_rng(1)
    cross = np.array([200e-6, -150e-6, 300e-6])
    for _ in range(10):
        direction, _ = warned(rng, 36, sigma=10 * UG, order=2, cross=cross)
        assert "products of two axes" in direction
        for name, value in zip(("k_xy", "k_yz", "k_zx"), cross, strict=True):
            stated, uncertainty = direction.split(name)[1].split(" ± ")[:2]
            assert abs(float(stated) - 1e6 * value) < 5 * float(uncertainty.split()[0].rstrip(",)"))


def test_an_order_that_is_too_low_is_named():
    rng = np.random.default_rng(2)
    direction, _ = warned(rng, 36, sigma=10 * UG, order=1, power=(2, 300e-6))
    assert "the next order (k2_x +" in direction
    assert "--order 2 fits it" in direction
    direction, _ = warned(rng, 36, sigma=10 * UG, order=2, power=(3, 300e-6))
    assert "k3_x +" in direction


def test_misalignment_that_order_0_leaves_out_is_named():
    direction, _ = warned(np.random.default_rng(6), 36, sigma=10 * UG, order=0)
    assert "the next order (misalignment_yx " in direction
    assert "--order 1 fits it" in direction


def test_a_drift_of_the_zero_is_stated_as_the_residuals_show_it():
    rng = np.random.default_rng(3)
    found = [warned(rng, 36, sigma=10 * UG, drift=(0, 100e-6, 0))[1] for _ in range(20)]
    values = [float(w.split(" y ")[1].split()[0]) for w in found if w]
    assert len(values) >= 18
    assert np.mean(values) == pytest.approx(0.1, abs=0.02)


def test_exact_data_have_no_pattern():
    assert warned(np.random.default_rng(4), 24, sigma=1e-16) == ("", "")


def test_few_attitudes_tell_nothing():
    assert warned(np.random.default_rng(5), 15, sigma=10 * UG, cross=(1e-3, 0, 0))[0] == ""


def test_no_order_is_asked_for_that_there_is_not():
    direction, _ = warned(np.random.default_rng(6), 60, sigma=2 * UG, order=5, power=(6, 2e-3))
    assert "--order 6" not in direction

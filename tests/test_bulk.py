"""Axes that show the bulk: what is clipped, what is not, and the marks for what is."""

import numpy as np
import pytest

from imulab.fleet.figures import staggered
from imulab.report.traces import bulk, edge_marks, edge_note


def test_a_single_far_value_does_not_flatten_the_rest():
    values = np.append(np.random.default_rng(1).normal(3.0, 1.0, 200), 4000.0)
    found = bulk(values)
    inside = values[:-1]
    assert np.flatnonzero(found.beyond).tolist() == [200]
    assert found.low < inside.min()
    assert found.high > inside.max()
    assert np.ptp(inside) / (found.high - found.low) > 0.8  # the bulk fills the axis


@pytest.mark.parametrize(
    "values",
    [
        np.random.default_rng(2).normal(size=500),
        np.random.default_rng(2).uniform(size=500),
        np.array([1.0, 2.0, 900.0]),  # too few to know what is usual
        np.ones(50),
        np.append(np.zeros(20), np.full(20, 100.0)),  # two groups, and no outlier
        np.full(9, np.nan),
    ],
)
def test_what_fits_on_one_axis_is_not_clipped(values):
    assert bulk(values) is None


def test_what_is_known_to_be_usual_sets_the_axis_with_room_for_its_bars():
    values = np.array([-1.0, 0.0, 1.0, 2.0, 60.0, -80.0])
    found = bulk(values, np.array([True, True, True, True, False, False]), room=0.5)
    assert found.low == pytest.approx(-1.5 - 0.08 * 4)
    assert found.high == pytest.approx(2.5 + 0.08 * 4)
    assert found.beyond.tolist() == [False, False, False, False, True, True]


@pytest.mark.parametrize("upright", [True, False])
def test_marks_stand_at_the_edge_with_the_value(upright):
    values = np.array([-1.0, 0.0, 1.0, 2.0, 60.0, -80.0])
    found = bulk(values, np.abs(values) < 10)
    labels = [f"{v:g} µg" for v in values]
    down, up = edge_marks(found, values, [1, 2, 3, 4, 5, 6], labels, upright=upright)
    on, along = ("y", "x") if upright else ("x", "y")
    assert (down[on], down[along], down["text"]) == ([found.low], [6], ["-80 µg"])
    assert (up[on], up[along], up["text"]) == ([found.high], [5], ["60 µg"])
    assert down["marker"]["symbol"] != up["marker"]["symbol"]


def test_the_value_of_one_mark_stands_above_the_bars():
    assert staggered(np.array([False, True, False]), 5)[1] > 5


def test_many_marks_keep_their_values_for_hovering():
    values = np.append(np.linspace(0, 1, 100), np.linspace(50, 60, 8))
    (marks,) = edge_marks(bulk(values), values, range(108), [f"{v:.0f}" for v in values])
    assert marks["mode"] == "markers"
    assert len(marks["text"]) == 8
    assert edge_note(0) == ""
    assert "8 points" in edge_note(8)

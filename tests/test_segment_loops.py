"""The loops of segmentation that are in C against their plain form."""

import numpy as np
import pytest

from conftest import some_of
from imulab.procedures.tumble import _segment
from imulab.procedures.tumble.attitudes import find_attitudes
from reference import segment as reference
from reference.tumble import random_attitudes
from test_segment import DIRECTIONS, G, disturbed, recording, tumble


def walk(seed, count=400):
    """Blocks that rest and move by turns: means, scatters, and where time breaks off."""
    rng = np.random.default_rng(seed)
    moving = np.repeat(rng.random(count // 20 + 1) < 0.5, 20)[:count]
    mean = G * random_attitudes(rng, count // 20 + 1).repeat(20, axis=0)[:count]
    mean += np.where(moving, 1.0, 1e-3)[:, None] * rng.standard_normal((count, 3))
    return mean, np.where(moving, 1.0, 1e-4)[:, None] * rng.random((count, 3)), rng.random(count) < 0.01


@pytest.mark.parametrize("length", [4, 10, 37])
def test_blocks_are_those_of_the_plain_form(length):
    samples, time, _ = tumble(DIRECTIONS[:4])
    time = time + np.where(np.arange(len(time)) > 1000, 3.0, 0.0) + 1e-3 * np.random.default_rng(2).random(len(time))
    count = len(time) // length
    mean, scatter, longest = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
    _segment.blocks(*np.ascontiguousarray(samples.T), time, length, mean, scatter, longest)
    expected = reference.blocks(samples, time, length)
    np.testing.assert_allclose(mean, expected[0], rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(scatter, expected[1], rtol=1e-10, atol=1e-28)
    np.testing.assert_array_equal(longest, expected[2])


def test_a_block_of_equal_samples_has_no_scatter():
    mean, scatter, longest = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    _segment.blocks(
        np.full(30, 0.1), np.full(30, -9.81), np.full(30, 1e9 / 3), np.arange(30.0), 10, mean, scatter, longest
    )
    np.testing.assert_array_equal(mean, np.tile([0.1, -9.81, 1e9 / 3], (3, 1)))
    assert not scatter.any()
    np.testing.assert_array_equal(longest, 1.0)


@pytest.mark.parametrize("seed", some_of(2, range(5)))
@pytest.mark.parametrize("width", [1, 3, 10])
def test_windows_and_stretches_are_those_of_the_plain_form(seed, width):
    mean, scatter, broken = walk(seed)
    variance = np.empty(len(mean) - width + 1)
    _segment.windows(mean, scatter, broken, width, variance)
    expected = reference.window_variance(mean, scatter, broken, width)
    np.testing.assert_allclose(variance, expected, rtol=1e-12)
    for limit in np.quantile(variance, [0.0, 0.1, 0.3, 0.5, 0.7, 0.95], method="lower"):
        for trim, fewest in ((0, 1), (0, 5), (2, 2), (3, 10)):
            start, stop = np.empty((2, len(variance)), dtype=np.int64)
            count = _segment.stretches(variance, limit, width, trim, fewest, start, stop)
            found = list(zip(start[:count].tolist(), stop[:count].tolist(), strict=True))
            assert found == reference.stretches(variance, limit, width, trim, fewest)


@pytest.mark.parametrize("same", [0.0, 2e-3, 0.3, 1.0, 3.0])
def test_attitudes_of_stretches_are_those_of_the_plain_form(same):
    mean, _, _ = walk(7)
    found = [(k, k + 7 + k % 3) for k in range(0, 380, 11)]
    start, stop = np.array(found).T.astype(np.int64).copy()
    attitude, means = np.empty(len(found), dtype=np.int64), np.empty((len(found), 3))
    count = _segment.attitudes(mean, start, stop, same, attitude, means)
    expected = reference.attitudes(mean, found, same)
    assert attitude.tolist() == expected[0]
    np.testing.assert_allclose(means[:count], expected[1], rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("seed", some_of(2, range(5)))
@pytest.mark.parametrize("count", [11, 24, 200])
def test_the_error_of_the_ellipsoid_is_that_of_leaving_each_attitude_out(seed, count):
    rng = np.random.default_rng(seed)
    points = random_attitudes(rng, count) * [1.1, 0.9, 1.0] + [0.3, -0.2, 0.1] + 1e-3 * rng.standard_normal((count, 3))
    assert _segment.ellipsoid_error(points) == pytest.approx(reference.ellipsoid_error(points), rel=1e-9)


def test_points_that_determine_no_ellipsoid_have_no_error():
    circle = np.column_stack([np.cos(np.arange(20)), np.sin(np.arange(20)), np.zeros(20)])
    for points in (random_attitudes(np.random.default_rng(1), 10), circle, np.ones((20, 3)), np.empty((0, 3))):
        assert _segment.ellipsoid_error(np.ascontiguousarray(points)) == np.inf


@pytest.mark.parametrize("moved", [0.0, np.radians(0.5)])
def test_the_attitudes_of_a_recording_are_the_best_of_the_plain_sweep(moved):
    samples, time, _, _ = disturbed(moved)
    found = find_attitudes(recording(samples, time))
    mean, scatter, longest = reference.blocks(samples, time, 10)
    variance = reference.window_variance(mean, scatter, longest > 0.25, 10)
    quiet = np.quantile(variance, 0.05)
    sweep = {}
    for factor in np.geomspace(1.5, 400.0, 18):
        pieces = reference.stretches(variance, factor * quiet, 10, 3, 10)
        number, means = reference.attitudes(mean, pieces, 2e-3)
        sweep.setdefault(tuple(pieces), (reference.ellipsoid_error(means), number, len(means), factor))
    enough = [pieces for pieces in sweep if sweep[pieces][2] >= 0.75 * np.median([item[2] for item in sweep.values()])]
    best = min(enough, key=lambda pieces: sweep[pieces][0])
    assert found.pieces[:, :2].tolist() == [[10 * start, 10 * stop] for start, stop in best]
    assert found.pieces[:, 2].tolist() == sweep[best][1]
    assert found.trace.threshold == pytest.approx(sweep[best][3] * quiet, rel=1e-9)


@pytest.mark.parametrize("size", [1, 3, 7])
def test_batches_are_those_of_the_plain_form(size):
    mean, _, _ = walk(3)
    found = [(k, k + 7 + k % 5) for k in range(0, 380, 13)]
    number = [k // 2 for k in range(len(found))]
    centre = G * random_attitudes(np.random.default_rng(4), max(number) + 1)
    first, moments, counts, scatters = reference.batches(mean, found, number, centre, size)
    start, stop = np.array(found).T.astype(np.int64).copy()
    ours = np.empty(len(first), dtype=np.int64), np.empty((len(first), 9))
    many, scatter = np.empty(len(counts), dtype=np.int64), np.empty((len(counts), 9, 9))
    _segment.batches(mean, start, stop, np.array(number), centre, size, *ours, many, scatter)
    assert (ours[0].tolist(), many.tolist()) == (first, counts)
    np.testing.assert_allclose(ours[1], moments, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(scatter, scatters, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("length", [1, 4, 13])
def test_the_motion_of_a_hold_is_that_of_the_plain_form(length):
    rng = np.random.default_rng(8)
    samples = rng.standard_normal((60 * length, 3)).cumsum(axis=0)
    found, number = [(0, 9), (9, 12), (15, 16), (20, 22), (30, 60)], [0, 0, 1, 1, 2]
    centre = rng.standard_normal((3, 3))
    mean = reference.blocks(samples, np.arange(60.0 * length), length)[0]
    start, stop = np.array(found).T.astype(np.int64).copy()
    sums = np.empty((3, 3, 3, 3))
    _segment.motion(*np.ascontiguousarray(samples.T), length, mean, start, stop, np.array(number), centre, *sums)
    np.testing.assert_allclose(sums, reference.motion(samples, length, found, number, centre), rtol=1e-11, atol=1e-11)


def test_buffers_that_do_not_go_together_are_refused():
    three, many = np.zeros((4, 3)), np.zeros(40)
    index = np.zeros(4, dtype=np.int64)
    calls = (
        lambda: _segment.blocks(many, many, many[:-1], many, 10, three, three.copy(), np.zeros(4)),
        lambda: _segment.blocks(many, many, many, many, 11, three, three.copy(), np.zeros(4)),
        lambda: _segment.blocks(many, many, many, many, 2**62, three, three.copy(), np.zeros(4)),
        lambda: _segment.windows(three, three, np.zeros(4, dtype=bool), 2, np.zeros(4)),
        lambda: _segment.windows(three, three, np.zeros(4, dtype=bool), 2**63 - 1, np.zeros(4)),
        lambda: _segment.stretches(many, 1.0, 1, 0, 1, index, index[:2].copy()),
        lambda: _segment.stretches(np.arange(40) % 2.0, 0.5, 1, 0, 1, index, index.copy()),
        lambda: _segment.stretches(many, 1.0, 2**63 - 1, 0, 1, index, index.copy()),
        lambda: _segment.stretches(many, 1.0, 1, 2**62, 1, index, index.copy()),
        lambda: _segment.attitudes(three, index, index + 5, 0.1, index.copy(), three.copy()),
        lambda: _segment.attitudes(three, index, index, 0.1, index.copy(), three.copy()),
        lambda: _segment.batches(
            three, index, index + 2, index, three, 1, index.copy(), np.zeros((4, 9)), index, np.zeros(324)
        ),
        lambda: _segment.batches(
            three, index, index + 1, index + 9, three, 1, index.copy(), np.zeros((4, 9)), index, np.zeros(324)
        ),
        lambda: _segment.motion(many, many, many, 11, three, index, index + 1, index, three, *np.zeros((3, 4, 3, 3))),
        lambda: _segment.motion(
            many, many, many[:-1], 4, three, index, index + 1, index, three, *np.zeros((3, 4, 3, 3))
        ),
        lambda: _segment.motion(many, many, many, 4, three, index, index + 9, index, three, *np.zeros((3, 4, 3, 3))),
    )
    for call in calls:
        with pytest.raises(ValueError, match="do not go together"):
            call()

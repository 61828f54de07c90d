"""Rotations from sampled rates against exact rotations, another library and a fine integration."""

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid, solve_ivp
from scipy.spatial.transform import Rotation

from imulab.procedures.tumble.gyro.rotation import frame_rotations, weighted_turns

EPS = np.finfo(float).eps


def carried(rate, time, start=0, stop=None):
    """The matrix of one segment, by default of all samples."""
    last = len(time) - 1 if stop is None else stop
    return frame_rotations(np.asarray(rate, dtype=float), np.asarray(time), np.array([start]), np.array([last]))[0]


def test_what_stands_still_outside_turns_backwards_in_the_body():
    # The body yaws by +90 deg about its z axis: what was ahead (x) is now to the right (-y).
    time = np.linspace(0, 1, 11)
    rate = np.tile([0.0, 0.0, np.pi / 2], (11, 1))
    np.testing.assert_allclose(carried(rate, time) @ [1, 0, 0], [0, -1, 0], atol=20 * EPS)


@pytest.mark.parametrize("samples", [2, 3, 8, 9, 1000])
@pytest.mark.parametrize("rate", [[0.3, -0.2, 0.5], [20.0, 35.0, -11.0], [0, 0, 1e-9], [0, 0, 0]])
def test_a_constant_rate_is_exact(rate, samples):
    time = np.linspace(5, 7, samples)
    exact = Rotation.from_rotvec(-2.0 * np.array(rate)).as_matrix()
    # Each of the steps rounds its angle and quaternion.
    np.testing.assert_allclose(carried(np.tile(rate, (samples, 1)), time), exact, atol=4 * EPS * samples + 60 * EPS)


def test_about_a_fixed_axis_the_angle_is_the_trapezoidal_integral():
    rng = np.random.default_rng(2)
    time = np.cumsum(rng.uniform(0.001, 0.02, 500))  # any spacing
    speed = rng.uniform(-3, 3, 500)
    axis = np.array([2.0, -1.0, 2.0]) / 3
    angle = cumulative_trapezoid(speed, time)[-1]
    exact = Rotation.from_rotvec(-angle * axis).as_matrix()
    np.testing.assert_allclose(carried(speed[:, None] * axis, time), exact, atol=2000 * EPS)


def smooth_rate(t):
    t = np.asarray(t, dtype=float)
    return np.stack([1.5 * np.sin(2.0 * t), 1.0 * np.cos(3.0 * t), 0.8 + 0.4 * np.sin(t)], axis=-1)


@pytest.fixture(scope="module")
def fine():
    """The matrix of dv/dt = -w x v over 2 s by an adaptive integration of eighth order."""

    def columns(t, v):
        return np.concatenate([-np.cross(smooth_rate(t), v[i : i + 3]) for i in (0, 3, 6)])

    end = solve_ivp(columns, (0, 2), np.eye(3).ravel(), method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    return end.reshape(3, 3).T


def test_a_changing_axis_converges_with_the_square_of_the_step(fine):
    errors = [
        np.linalg.norm(carried(smooth_rate(t), t) - fine) for t in (np.linspace(0, 2, n) for n in (101, 201, 401))
    ]
    # Per unit of time the trapezoid errs by h^2 |w''| / 12 and the constant axis by h^2 |w x w'| / 12.
    t = np.linspace(0, 2, 2001)
    w, dw = smooth_rate(t), np.gradient(smooth_rate(t), t, axis=0)
    ddw = np.gradient(dw, t, axis=0)
    rate_of_error = (np.linalg.norm(ddw, axis=1) + np.linalg.norm(np.cross(w, dw), axis=1)) / 12
    bound = np.sqrt(2) * np.trapezoid(rate_of_error, t)  # a rotation by e differs by sqrt(2) e in the Frobenius norm
    for error, step in zip(errors, (0.02, 0.01, 0.005), strict=True):
        assert error < 1.01 * bound * step**2
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.02)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.02)


def test_segments_of_any_length_are_as_alone():
    rng = np.random.default_rng(7)
    time = np.arange(400) / 100
    rate = rng.standard_normal((400, 3))
    start = np.array([0, 10, 10, 100, 399, 250])
    stop = np.array([399, 11, 73, 228, 399, 253])
    together = frame_rotations(rate, time, start, stop)
    assert together.shape == (6, 3, 3)
    for k in range(6):
        np.testing.assert_allclose(together[k], carried(rate, time, start[k], stop[k]), atol=8 * EPS)
        sub = slice(start[k], stop[k] + 1)
        if stop[k] > start[k]:
            np.testing.assert_allclose(together[k], carried(rate[sub], time[sub]), atol=8 * EPS)


def test_rotations_compose_and_are_proper():
    rng = np.random.default_rng(8)
    time = np.arange(300) / 50
    rate = 5 * rng.standard_normal((300, 3))
    first, second, whole = frame_rotations(rate, time, np.array([0, 120, 0]), np.array([120, 299, 299]))
    np.testing.assert_allclose(second @ first, whole, atol=600 * EPS)
    for matrix in (first, second, whole):
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=8 * EPS)
        assert np.linalg.det(matrix) == pytest.approx(1.0, abs=8 * EPS)


def test_no_time_turns_nothing():
    time = np.arange(5) / 10
    np.testing.assert_array_equal(carried(np.ones((5, 3)), time, 3, 3), np.eye(3))


def test_sums_are_those_of_each_step_on_its_own():
    """The sum of C' x, with C to the middle of each step, against one matrix exponential after the other."""
    rng = np.random.default_rng(9)
    rate, step, weights = rng.normal(0, 3, (2, 17, 3)), rng.uniform(0, 0.1, (2, 17)), rng.standard_normal((2, 17, 4))
    found = weighted_turns(rate, step, weights)
    for m in range(2):
        whole, sums = Rotation.identity(), np.zeros((4, 3, 3))
        for w, dt, x in zip(rate[m], step[m], weights[m], strict=True):
            middle = (Rotation.from_rotvec(-w * dt / 2) * whole).as_matrix()
            sums += (x * dt)[:, None, None] * middle.T
            whole = Rotation.from_rotvec(-w * dt) * whole
        np.testing.assert_allclose(found.matrix[m], whole.as_matrix(), atol=100 * EPS)
        np.testing.assert_allclose(found.weighted[m], sums, atol=100 * EPS)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_stays_in_its_segment(bad):
    rate = np.ones((40, 3))
    rate[25, 1] = bad
    turns = frame_rotations(rate, np.arange(40) / 10, np.array([0, 20, 26]), np.array([24, 39, 39]))
    assert np.isfinite(turns).all(axis=(1, 2)).tolist() == [True, False, True]


@pytest.mark.parametrize(("start", "stop"), [(-1, 3), (3, 2), (0, 5)])
def test_a_segment_beyond_the_samples_is_refused(start, stop):
    with pytest.raises(ValueError, match="a segment beyond the steps"):
        carried(np.ones((5, 3)), np.arange(5.0), start, stop)

"""Nested models blended: shares against their closed forms, and coverage of what is stated whichever model is right."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats

from imulab.estimation.least_squares import blend, noise_share


def test_a_step_of_three_terms_without_gain_is_two_thirds_noise_and_a_large_gain_leaves_four_over_it() -> None:
    mean, spread = noise_share([0.0, 200.0, 1e5], [3, 3, 3])
    assert mean == pytest.approx([2 / 3, 4 / 200, 4 / 1e5], rel=1e-3)
    assert spread == pytest.approx([1 / 18, 2 * (2 / 200) ** 2, 2 * (2 / 1e5) ** 2], rel=1e-2)


@pytest.mark.parametrize("added", [1, 2, 3])
@pytest.mark.parametrize("gain", [0.3, 4.0, 25.0])
@pytest.mark.parametrize("freedom", [None, 9])
@pytest.mark.parametrize("prior", [0.0, 0.5])
def test_shares_are_moments_of_the_stated_density(added: int, gain: float, freedom: int | None, prior: float) -> None:
    def density(root: float) -> float:  # in the square root, which has no pole at zero
        k = root**2
        tail = np.exp(-k * gain / 2) if freedom is None else (1 + k * gain / freedom) ** (-(freedom + added) / 2)
        return float(root ** (added + 2 * prior - 1) * tail)

    mass, first, second = (integrate.quad(lambda r, n=n: r ** (2 * n) * density(r), 0, 1)[0] for n in (0, 1, 2))
    mean, spread = noise_share([gain], [added], freedom, prior)
    assert mean[0] == pytest.approx(first / mass, rel=5e-3)
    assert spread[0] == pytest.approx(second / mass - (first / mass) ** 2, rel=1e-2)


@pytest.mark.parametrize("size", [0.0, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("estimated", [False, True])
def test_intervals_hold_the_truth_whichever_of_two_nested_models_is_right(size: float, estimated: bool) -> None:
    """A straight line that may bend: 95 % intervals of its value at zero, bend of `size` standard deviations."""
    x = np.linspace(-1, 1, 12)
    design = np.stack([np.ones(12), x, x**2], axis=1)
    small, large = (np.linalg.inv(design[:, :n].T @ design[:, :n]) for n in (2, 3))
    bend = size * np.sqrt(large[2, 2])
    rng = np.random.default_rng(4)
    covariances = np.zeros((2, 3, 3))
    covariances[0, :2, :2], covariances[1] = small, large
    inside = 0
    trials = 2000
    for _ in range(trials):
        y = bend * x**2 + rng.standard_normal(12)
        values = np.zeros((2, 3))
        values[0, :2], values[1] = small @ design[:, :2].T @ y, large @ design.T @ y
        squares = [float(((y - design @ v) ** 2).sum()) for v in values]
        freedom, factor = (9, stats.t.ppf(0.975, 9)) if estimated else (None, 1.96)
        found = blend(
            values, covariances, [squares[0] - squares[1]], [1], scale=squares[1] / 9 if estimated else 1.0,
            freedom=freedom, prior=0.0,
        )  # fmt: skip
        chosen = values[int(squares[0] - squares[1] > 3.84)]
        inside += abs(chosen[0]) < factor * np.sqrt(found.about(chosen)[0, 0])
    assert 0.925 <= inside / trials <= 0.99

"""Which powers of the rate a gyroscope's output supports: by F-test, and by each rate predicted from the others.

What dwells leave of a polynomial is compared rate by rate: an error of one commanded rate is shared by all its visits,
which therefore are no further evidence of a bend. Source: F-test of nested models; leave-one-out prediction.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from imulab.estimation.least_squares import chi_square_probability, f_test
from imulab.procedures.rate.solve import Problem
from imulab.recording import Array

HIGHEST = 5
_CHANCE = 0.01
_EXACT = 1e-10
_AS_NOISE = 0.2
"""Probability beyond which what is left of the rates is their noise, which then is known better than by them."""


def choose_orders(problem: Problem) -> tuple[int, ...]:
    """Return the highest power of the rate of each gyroscope that its dwells support; 1 where none was turned about.

    A higher order is taken if its gain is more than noise and the scatter of the rates explain (chi-square and F-test,
    1 %), against the order chosen so far and that below it, and if it predicts each rate from the others better, by
    more than the standard error of that comparison.
    """
    return tuple(_order_of(problem, i) for i in range(len(problem.gyros)))


def _order_of(problem: Problem, gyro: int) -> int:
    own = problem.axis == problem.gyros[gyro]
    if not own.any():
        return 1
    key = np.unique(np.round(problem.table[own] * problem.sign[own], 6), return_inverse=True)[1]
    count = int(key.max()) + 1
    zeros = (problem.run[own][:, None] == np.unique(problem.run[own])).astype(np.float64)
    rate = problem.rate[own] / np.abs(problem.rate[own]).max()
    powers = np.column_stack([rate**p for p in range(1, max(min(HIGHEST, count - 2), 1) + 1)])
    values = problem.mean[own, gyro]
    slope = float(np.ptp(values) / max(np.ptp(problem.rate[own]), 1e-300))
    stated = problem.rate_uncertainty[own] * slope
    of_rate = np.outer(stated, stated) * (key[:, None] == key)
    noise = problem.variance[own, gyro] + (_EXACT * np.abs(values).max()) ** 2
    lower = np.linalg.cholesky(np.diag(noise) + of_rate)
    visits = (key[:, None] == np.arange(count)).astype(np.float64)

    def cost(columns: Array) -> float:
        white = np.linalg.solve(lower, np.column_stack([columns, values]))
        left = white[:, -1] - white[:, :-1] @ np.linalg.lstsq(white[:, :-1], white[:, -1], rcond=None)[0]
        return float(left @ left)

    def predicted(columns: Array) -> Array:
        white = np.linalg.solve(lower, np.column_stack([columns, values]))
        found = []
        for k in range(count):
            rest, which = key != k, key == k
            fit = np.linalg.lstsq(white[rest, :-1], white[rest, -1], rcond=None)[0]
            spread = noise[which].sum() / which.sum() ** 2 + of_rate[which, which][0]
            found.append(float((values[which] - columns[which] @ fit).mean() ** 2 / spread))
        return np.array(found)

    within = cost(np.column_stack([zeros, visits]))
    models = {p: np.column_stack([powers[:, :p], zeros]) for p in range(1, powers.shape[1] + 1)}
    costs = {p: max(cost(columns) - within, 0.0) for p, columns in models.items()}
    chosen, best = 1, predicted(models[1])
    for order in range(2, len(models) + 1):
        if not all(_significant(costs, below, order, count) for below in {chosen, order - 1}):
            continue
        squares = predicted(models[order])
        gain = best - squares
        if gain.mean() > gain.std(ddof=1) / np.sqrt(count):
            chosen, best = order, squares
    return chosen


def _significant(costs: Mapping[int, float], below: int, order: int, count: int) -> bool:
    by_noise = chi_square_probability(costs[below] - costs[order], order - below)
    if chi_square_probability(costs[order], count - order - 1) > _AS_NOISE:
        return by_noise < _CHANCE
    return max(by_noise, f_test(costs[below], below + 1, costs[order], order + 1, count)) < _CHANCE

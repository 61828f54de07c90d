"""The laws over temperature against what theory allows, over many simulated units that share nothing with the fit.

Noise is known here, so that uncertainties are those of it alone; a record's hold unexplained scatter too, and are 6 to
10 % wider where there is none.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

import imulab as il
from imulab.procedures.thermal.degrees import clusters_of, left_out, seen, splits
from imulab.procedures.thermal.model import Laws
from imulab.procedures.thermal.solve import ThermalProblem, concluded, solve
from reference import thermal as reference
from test_thermal import AT, LAWS, problem, truth

G, NOISE = reference.G, 60e-6
pytestmark = pytest.mark.slow


def by_hand(rng, count):
    """Upward directions as a hand finds them: anywhere."""
    up = rng.standard_normal((count, 3))
    return up / np.linalg.norm(up, axis=1)[:, None]


def of_noise_alone(found):
    return concluded(found.laws, found.coefficients, found.rows, (0.0, np.inf), found.scatter, converged=True)


def test_each_coefficient_errs_by_what_is_stated(reduced):
    """Five temperatures, eight planned attitudes each: RMS over stated 0.98 to 1.02 for all 27 (5,000 units)."""
    trials, margin = (150, 0.2) if reduced else (5000, 0.05)
    plan = il.plan_thermal("-20,60", time="5 h", soak="52 min", noise="60 ug", turn_on_scatter=0.0)
    counts = [len(soak.directions) for soak in plan.soaks]
    up, n = np.vstack([soak.directions for soak in plan.soaks]), sum(counts)
    place = np.repeat([soak.temperature for soak in plan.soaks], counts)
    at = 20.0 + 40.0 * np.cos(np.pi * (np.arange(8) + 0.5) / 8)
    design, standard = LAWS.design(at).reshape(-1, LAWS.size), []
    for trial in range(trials):
        rng = np.random.default_rng([31, trial])
        triad = reference.Triad(rng)
        means = np.array([triad.output(G * u, t) for u, t in zip(up, place, strict=True)]) / G
        given = ThermalProblem(
            reading=means + NOISE * rng.standard_normal((n, 3)), covariance=np.tile(np.eye(3) * NOISE**2, (n, 1, 1)),
            temperature=place, rate=np.zeros(n), step=np.zeros(n), shared=np.ones(n, dtype=np.bool_),
            recording=np.repeat(np.arange(5), counts), group=np.full(n, -1), tilt=2e-4, zero=np.zeros(3),
        )  # fmt: skip
        found = of_noise_alone(solve(given, LAWS, tau=0.0))
        rows = [triad.at(t) for t in at]
        true = np.linalg.lstsq(design, np.array([[*(np.array(b) / G), *s, *m] for b, s, m in rows]).ravel())[0]
        standard.append((found.coefficients - true) / np.sqrt(np.diag(found.covariance)))
    rms = np.sqrt(np.mean(np.square(standard), axis=0))
    assert rms == pytest.approx(np.ones(LAWS.size), abs=margin)


@pytest.mark.parametrize(
    ("temperatures", "count", "most"),
    [((-20, 0, 25, 45, 60), 12, 1.6), ((-20, -7, 7, 20, 33, 47, 60), 9, 1.35)],
)
def test_a_temperature_left_out_is_missed_by_what_is_stated(temperatures, count, most, reduced):
    """Chi-square per attitude 1.01 and 1.00 (250 units); rms 1.44 and 1.24 of an attitude's noise."""
    trials, margin = (40, 0.25) if reduced else (250, 0.1)
    squares, errors = [], []
    cluster = clusters_of(np.repeat(np.array(temperatures, float), count))
    for trial in range(trials):
        rng = np.random.default_rng([21, trial, count])
        found = solve(problem(rng, reference.Triad(rng), temperatures, count), LAWS, tau=0.0)
        held = left_out(splits(of_noise_alone(found), cluster), np.ones(LAWS.size, dtype=np.bool_))
        assert len(held) == len(temperatures) - 2
        squares += [each.chi_square for each in held]
        errors += [each.rms**2 for each in held]
    assert np.mean(squares) == pytest.approx(1, abs=margin)
    assert np.sqrt(np.mean(errors)) <= most * NOISE * (1.1 if reduced else 1)


def separate(reading):
    """Bias, scale factor and misalignment of one temperature's attitudes alone, by a general optimiser."""

    def forces(p):
        x, y, z = (reading / p[3:6] - p[:3]).T
        y = y - p[6] * x
        return np.stack([x, y, z - p[7] * x - p[8] * y], axis=1)

    return least_squares(lambda p: np.linalg.norm(forces(p), axis=1) - 1, np.repeat([0.0, 1.0, 0.0], 3), xtol=1e-12).x


def without(given, number):
    kept = given.recording != number
    recording = given.recording[kept] - (given.recording[kept] > number)
    arrays = ("reading", "covariance", "temperature", "rate", "step", "shared", "group")
    return replace(given, recording=recording, **{name: getattr(given, name)[kept] for name in arrays})


@pytest.mark.parametrize(("count", "ratio"), [(10, 0.12), (12, 0.33), (15, 0.38)])
def test_one_fit_errs_by_less_than_half_of_a_cubic_through_calibrations(count, ratio, reduced, monkeypatch):
    """Force at a temperature left out, attitudes by hand: 134, 92 and 71 ug against 1095, 278 and 187 (60 units)."""
    trials = 12 if reduced else 60
    spiral = reference.directions
    monkeypatch.setattr(reference, "directions", by_hand)
    at, errors = np.array([-20.0, 0.0, 25.0, 45.0, 60.0]), {"one": [], "cubic": []}
    for trial in range(trials):
        rng = np.random.default_rng([22, trial, count])
        triad = reference.Triad(rng)
        given = problem(rng, triad, at, count)
        alone = np.array([separate(given.reading[given.recording == k]) for k in range(5)])
        up = spiral(rng, 12)
        for k in (1, 2, 3):
            others = np.delete(np.arange(5), k)
            cubic = [np.prod((at[k] - at[others[others != i]]) / (at[i] - at[others[others != i]])) for i in others]
            laws = {
                "one": LAWS.design(at[k : k + 1])[0] @ solve(without(given, k), LAWS, tau=0.0).coefficients,
                "cubic": np.array(cubic) @ alone[others],
            }
            for way, p in laws.items():
                read = np.array([triad.output(G * u, at[k]) for u in up]) / G
                x, y, z = (read / p[3:6] - p[:3]).T
                y = y - p[6] * x
                errors[way].append(np.mean((np.stack([x, y, z - p[7] * x - p[8] * y], axis=1) - up) ** 2))
    one, cubic = (np.sqrt(np.mean(errors[way])) for way in ("one", "cubic"))
    assert one <= 0.5 * cubic
    if not reduced:
        assert one / cubic == pytest.approx(ratio, abs=0.02)


def test_what_counts_as_observable_is_known_as_stated_and_what_does_not_is_not(reduced, monkeypatch):
    """Few attitudes by hand, noise of 60 ug to 10 mg: 1,526 of 2,160 fits are accepted and err by 0.97 to 1.00 of what
    is stated, two of them by more than 5 u somewhere; a tenth of those not accepted do, and more at little noise."""
    trials, margin = (6, 0.15) if reduced else (60, 0.05)
    monkeypatch.setattr(reference, "directions", by_hand)
    ratios, beyond = {True: [], False: []}, {True: [], False: []}
    for degrees in ((3, 2, 0), (2, 1, 0), (3, 2, 1)):
        laws = Laws(-20.0, 60.0, degrees)
        design = laws.design(AT)
        for noise in (60e-6, 1e-3, 1e-2):
            for count in (4, 5, 6, 8):
                for trial in range(trials):
                    rng = np.random.default_rng([11, trial, count, int(noise * 1e6), sum(degrees)])
                    triad = reference.Triad(rng, degrees)
                    found = solve(problem(rng, triad, (-20, 0, 25, 45, 60), count, noise=noise), laws, tau=0.0)
                    u = np.sqrt(np.einsum("tpc,cd,tpd->tp", design, found.covariance, design))
                    accepted = found.converged and seen(found).rank == laws.size
                    error = np.abs(design @ found.coefficients - truth(triad))
                    error = error / np.maximum(u, 1e-12)
                    ratios[accepted].append(np.mean(error**2))
                    beyond[accepted].append(error.max() > 5)
    assert np.sqrt(np.mean(ratios[True])) == pytest.approx(1, abs=margin)
    assert np.mean(beyond[True]) < 0.01
    assert np.mean(beyond[False]) > 0.1

"""From power cycles to a table: exact on what a model can hold, as good as it should be on what none can."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator
from scipy.optimize import minimize
from scipy.stats import binom

import imulab as il
from imulab import simulate_power_cycle
from imulab.errors import DataError
from imulab.procedures.warmup.cycles import find_power_cycle, make_curves
from imulab.procedures.warmup.model import (
    _nelder_mead,
    _pchip_slopes,
    coefficient_covariance,
    evaluate,
    solve,
    statistics,
)
from imulab.procedures.warmup.simulate import warmup_truth
from imulab.recording import Recording
from reference import warmup as reference

AT = [-40.0, -30, -20, -10, 0, 40, 50, 60]
HOUR = np.pi / 180 / 3600
END = 300.0


def cycle_of(function, temperature, *, rate=20.0, duration=400.0, name="c", serial=None, axes=("gyro_x", "accel_x")):
    """A noise-free cycle: function(t) before T_M, zero after; the second axis is half of the first."""
    time = np.arange(round(rate * duration)) / rate
    z = np.where(time < END, function(time), 0.0)
    units = {"time": "s"} | {axis: "rad/s" if axis.startswith("gyro") else "m/s^2" for axis in axes}
    head = {"power_on_temperature": str(temperature)} | ({"serial": serial} if serial else {})
    columns = {axis: 1e-3 + z / (i + 1) for i, axis in enumerate(axes)}
    return Recording({"time": time, **columns}, units, head, name=name)


def random_cubic(rng):
    b = 300 * HOUR * rng.standard_normal(4)
    return lambda t: reference.cubic(b, t / END), b


@pytest.fixture(scope="module")
def simulated():
    """Three cycles at each temperature, both laws."""
    return {
        law: [
            find_power_cycle(simulate_power_cycle(t, law=law, seed=[1, i, c]))
            for i, t in enumerate(AT)
            for c in range(3)
        ]
        for law in ("smooth", "bent")
    }


@pytest.fixture(scope="module")
def fits(simulated):
    return {law: il.fit_warmup(cycles, settling_time=END) for law, cycles in simulated.items()}


# --- exact ------------------------------------------------------------------------------------------------------


def test_a_cubic_in_each_interval_is_recovered_to_rounding():
    rng = np.random.default_rng(1)
    function, b = random_cubic(rng)
    cycles = [cycle_of(function, t, name=f"{t}") for t in AT]
    table = il.fit_warmup(cycles, model="interval-cubic", settling_time=END).table
    for row in table.coefficients:
        np.testing.assert_allclose(row[0], b, rtol=1e-9)
        np.testing.assert_allclose(row[1], b / 2, rtol=1e-9)


def test_each_interval_pools_its_two_end_points_as_the_raw_samples_would():
    rng = np.random.default_rng(2)
    functions = [random_cubic(rng)[0] for _ in AT]
    cycles = [
        cycle_of(f, t + shift, name=f"{t}{shift}") for f, t in zip(functions, AT, strict=True) for shift in (-1, 1)
    ]
    table = il.fit_warmup(cycles, model="interval-cubic", settling_time=END, axes=["gyro_x"]).table
    time = cycles[0].column("time")
    for i in range(7):
        ends = [f(time) for f in functions[i : i + 2] for _ in range(2)]
        want = reference.source_fit([time] * 4, ends, END) * END ** np.arange(4)
        np.testing.assert_allclose(table.coefficients[i, 0], want, rtol=1e-9)


def test_knots_take_the_temperature_of_each_cycle_into_account():
    rng = np.random.default_rng(3)
    knots = 300 * HOUR * rng.standard_normal((len(AT), 4))

    def at(temperature):
        b = np.array([np.interp(temperature, AT, knots[:, k]) for k in range(4)])
        return lambda t: reference.cubic(b, t / END)

    cycles = [
        cycle_of(at(t), t, name=f"{t}")
        for nominal in AT
        for t in nominal + np.array([-0.7, 0.1, 0.6])
        if AT[0] <= t <= AT[-1]
    ]
    found = il.fit_warmup(cycles, model="knot-cubic", settling_time=END, axes=["gyro_x"]).table
    np.testing.assert_allclose(found.coefficients[:, 0], knots, rtol=1e-6, atol=1e-9 * HOUR)


@pytest.mark.slow
def test_exponentials_find_their_time_constants_and_amplitudes():
    cycles = [
        cycle_of(lambda t, a=a: HOUR * ((200 - 2 * a) * np.exp(-t / 15) - (50 + a) * np.exp(-t / 90)), a, name=f"{a}")
        for a in AT
    ]
    fit = il.fit_warmup(cycles, model="exponential", settling_time=END, axes=["gyro_x"])
    two = next(row for row in fit.models if row.count == 2)
    np.testing.assert_allclose(two.table.time_constants, [15, 90], rtol=2e-3)
    np.testing.assert_allclose(
        two.table.coefficients[:, 0] / HOUR, [[200 - 2 * a, -50 - a] for a in AT], rtol=5e-3, atol=0.5
    )


def test_binning_costs_nothing_against_the_raw_samples(simulated):
    recording = il.simulate_power_cycle(-20, seed=[9])
    cycles = [
        find_power_cycle(replace(recording, metadata=recording.metadata | {"power_on_temperature": t})) for t in "01"
    ]
    fit = il.fit_warmup(
        [replace(c, name=str(i)) for i, c in enumerate(cycles)],
        temperatures=[0, 1],
        tolerance=0.4,
        model="knot-log-cubic",
        settling_time=END,
    )
    time, y = recording.column("time"), recording.si("gyro_x")
    early = time < END
    tau = fit.table.time_scale
    functions = [lambda t, k=k: (np.log1p(t / tau) / np.log1p(END / tau)) ** k for k in range(4)]
    raw = reference.least_squares(functions, time[early], y[early] - y[~early].mean())
    curve = np.column_stack([f(time[early]) for f in functions]) @ raw
    found = evaluate(fit.table, time[early], 0.0)[0]
    # Both estimate the same curve; they differ by a small part of what noise makes of either (2 deg/h).
    assert np.sqrt(np.mean((found - curve) ** 2)) < 0.4 * HOUR


# --- the simulated chamber -----------------------------------------------------------------------------------------


def truth(temperature, law):
    """Mean curve before T_M of the three gyroscopes, less the settled mean of a 600 s cycle; and its times."""
    time = np.arange(0, 600, 0.5)
    z = warmup_truth(time, temperature, law)[:, :3]
    return time[time < END], (z - z[time >= END].mean(axis=0))[time < END]


def error(table, temperatures, law):
    """Root mean square over time, axes and temperatures, deg/h."""
    squares = []
    for temperature in temperatures:
        time, z = truth(temperature, law)
        left = z if table is None else z - evaluate(table, time, temperature)[:3].T
        squares.append(np.mean(left**2))
    return float(np.sqrt(np.mean(squares)) / HOUR)


# Root mean square errors stated for an independent simulator: at the calibration temperatures, at 10, 20 and 30 degC.
STATED = {
    "smooth": {
        "none": (84, 60, 45, 30),
        "interval-cubic": (15, 18, 4.2, 14),
        "knot-cubic": (2.9, 3.4, 4.2, 4.1),
        "exponential (2)": (1.9, 2.3, 2.2, 1.7),
    },
    "bent": {
        "none": (115, 83, 39, 12),
        "interval-cubic": (25, 42, 5.2, 43),
        "knot-cubic": (3.9, 8.8, 5.2, 10.7),
        "exponential (2)": (2.2, 3.2, 6.9, 7.6),
    },
}
JUMPS = {"smooth": 108, "bent": 202}
BETTER = {("smooth", "knot-cubic"): {3}, ("bent", "exponential (2)"): {3}}
"""Entries that come out better than stated by more than 1.5: 1.6 and 1.8 times, both at 30 degC."""


@pytest.mark.slow
@pytest.mark.parametrize("law", ["smooth", "bent"])
def test_the_table_of_models_comes_out_as_stated(law, reduced):
    """Entry by entry, pooled over tests: one test's errors are the draw of three cycles at each temperature."""
    squares = {name: [] for name in STATED[law]}
    jumps = []
    for seed in range(4 if reduced else 8):
        cycles = [
            find_power_cycle(simulate_power_cycle(t, law=law, sample_rate=2.0, seed=[100 + seed, i, c]))
            for i, t in enumerate(AT)
            for c in range(3)
        ]
        rows = {row.label: row for row in il.fit_warmup(cycles, settling_time=END).models}
        for name, collected in squares.items():
            table = None if name == "none" else rows[name].table
            collected.append([error(table, at, law) ** 2 for at in (AT, [10], [20], [30])])
        jumps.append(rows["interval-cubic"].edge_jump[:3].max() / HOUR)
    for name, stated in STATED[law].items():
        found = np.sqrt(np.mean(squares[name], axis=0))
        print(law, name, np.round(found, 1), stated)
        assert (found / stated).max() < 1.5
        low = {column for column in range(4) if found[column] / stated[column] <= 1 / 1.5}
        assert low <= BETTER.get((law, name), set())
        assert 1 / 1.5 < np.sqrt(np.mean(found**2) / np.mean(np.square(stated))) < 1.5
    assert 1 / 1.5 < np.mean(jumps) / JUMPS[law] < 1.5


@pytest.mark.parametrize("law", ["smooth", "bent"])
@pytest.mark.slow
def test_auto_leaves_less_than_a_third_of_the_source_between_the_temperatures(fits, law):
    held_out = [-37.5, -35, -32.5, -27.5, -25, -22.5, -17.5, -12.5, -7.5, -2.5, 10, 20, 30, 42.5, 47.5, 52.5, 57.5]
    quarters = [-37.5, -32.5, -27.5, -22.5, -17.5, -12.5, -7.5, -2.5, 10, 30, 42.5, 47.5, 52.5, 57.5]
    fit = fits[law]
    source = next(row for row in fit.models if row.label == "interval-cubic").table
    for at in (held_out, quarters, [10, 30, -27.5]):
        assert error(fit.table, at, law) <= 0.30 * error(source, at, law)
    assert next(row for row in fit.models if row.label == fit_label(fit)).edge_jump.max() == 0
    print(
        law,
        fit_label(fit),
        [round(error(fit.table, at, law) / error(source, at, law), 3) for at in (held_out, quarters)],
    )


def fit_label(fit):
    return next(row["model"] for row in fit.calibration.fit["models"] if row["chosen"])


@pytest.mark.slow
@pytest.mark.parametrize("law", ["smooth", "bent"])
def test_the_logarithm_leaves_at_most_six_tenths_of_the_cubic_in_time(fits, law):
    rows = {row.label: row for row in fits[law].models}
    assert error(rows["knot-log-cubic"].table, AT, law) <= 0.6 * error(rows["knot-cubic"].table, AT, law)


@pytest.mark.slow
def test_left_out_errors_are_those_of_refits_without_the_cycle(simulated, fits):
    cycles, curves = simulated["bent"], fits["bent"].curves
    errors = []
    for i, cycle in enumerate(cycles):
        table = il.fit_warmup(cycles[:i] + cycles[i + 1 :], model="knot-cubic", settling_time=END).table
        at = float(np.clip(cycle.temperature, -40, 60))
        z = sum(
            curves.shares[i, :, n, None] * evaluate(table, curves.nodes[i, :, n], at).T for n in (0, 1)
        )  # bin averages of a cubic, exactly
        w = curves.seconds[i] / curves.seconds[i].sum()
        errors.append(w @ (curves.mean[i] - z) ** 2 - curves.expected_noise()[i])
    found = next(row for row in fits["bent"].models if row.label == "knot-cubic").left_cycle
    np.testing.assert_allclose(found, np.sqrt(np.mean(errors, axis=0)), rtol=1e-6)


def test_repeatability_and_noise_are_those_simulated(fits):
    fit = fits["smooth"]
    noise = np.sqrt(fit.curves.noise) / HOUR
    np.testing.assert_allclose(noise[:3], 0.3 * 60, rtol=0.05)
    # 2.5 % of each stage; the stages' curves add up to 85 deg/h.
    assert 0.8 < np.sqrt(np.mean(fit.repeatability.cycle[:3] ** 2)) / HOUR < 2.6
    assert fit.repeatability.freedom == 16


def test_the_settling_time_is_where_the_curves_stay_small(simulated):
    loose = il.fit_warmup(simulated["smooth"], model="knot-cubic", settling_limit={"gyro": 40 * HOUR})
    tight = il.fit_warmup(simulated["smooth"], model="knot-cubic", settling_limit={"gyro": 15 * HOUR})
    assert loose.table.settling_time < tight.table.settling_time <= 570
    times = np.arange(loose.table.settling_time, 600.0)
    largest = max(np.abs(warmup_truth(times, t)[:, :3] - warmup_truth(times, t)[:, :3].mean(axis=0)).max() for t in AT)
    assert largest < 1.3 * 40 * HOUR


def test_units_of_a_type_are_told_apart_from_cycles():
    def many(spread):
        return [
            find_power_cycle(
                il.simulate_power_cycle(t, serial=f"U{u}", unit_spread=spread, seed=[u, i, c], accel=False)
            )
            for u in range(4)
            for i, t in enumerate((-40, -20, 0))
            for c in range(2)
        ]

    same = il.fit_warmup(many(0.0), temperatures=[-40, -20, 0], pool="type", settling_time=END, model="knot-log-cubic")
    apart = il.fit_warmup(many(0.1), temperatures=[-40, -20, 0], pool="type", settling_time=END, model="knot-log-cubic")
    assert same.repeatability.unit.mean() < same.repeatability.cycle.mean() < 0.5 * apart.repeatability.unit.mean()
    with pytest.raises(DataError, match="--pool type fits one"):
        il.fit_warmup(many(0.0), temperatures=[-40, -20, 0])


def with_slow_noise(cycle, rng):
    """A power cycle with 1/f noise of 30 deg/h and a walk of 100 deg/h/sqrt(h) added, much above its white noise."""
    columns, n = dict(cycle.columns), len(cycle)
    interval = float(cycle.time[1] - cycle.time[0])
    frequency = np.fft.rfftfreq(4 * n, interval)
    frequency[0] = np.inf
    for name in ("gyro_x", "gyro_y", "gyro_z"):
        # One-sided densities B^2 / (pi f) and K^2 / (2 pi^2 f^2); four times the length, so that nothing wraps.
        density = 30**2 / (np.pi * frequency) + (100 / 60) ** 2 / (2 * np.pi**2 * frequency**2)
        size = np.sqrt(density * n / interval)
        spectrum = size * (rng.standard_normal(len(size)) + 1j * rng.standard_normal(len(size)))
        columns[name] = columns[name] + np.fft.irfft(spectrum, 4 * n)[:n]
    return replace(cycle, columns=columns)


@pytest.mark.slow
@pytest.mark.parametrize("slow_noise", [False, True])
def test_intervals_of_the_curve_cover(reduced, slow_noise):
    """The curve's uncertainty from repeatability: 95 % intervals at one temperature, five cycles, pooled over three.

    The scatter between cycles holds what a cycle's mean at rest, its reference, is uncertain by, whatever the colour.
    """
    trials, inside, total = (15 if reduced else 600), 0, 0
    rng = np.random.default_rng(7)
    at = np.array([-40.0, -30, -20])
    times = np.array([2.0, 20, 60, 120, 200, 290])
    for trial in range(trials):
        made = [
            simulate_power_cycle(t, seed=[trial, i, c], sample_rate=2, scatter=0, accel=False)
            for i, t in enumerate(at)
            for c in range(5)
        ]
        cycles = [find_power_cycle(with_slow_noise(each, rng) if slow_noise else each) for each in made]
        curves, _ = make_curves(cycles, at, tolerance=1, settling_time=END, limit={})
        sums = statistics(curves, "knot-log-cubic", (20.0,))
        solution = solve(curves, "knot-log-cubic", (20.0,), sums, np.ones(len(cycles)))
        covariance = coefficient_covariance(curves, solution, sums, np.arange(len(cycles)))
        u = np.log1p(times / 20) / np.log1p(END / 20)
        basis = np.stack([u**k for k in range(4)], axis=1)
        for k, t in enumerate(at):
            fine = np.arange(0, 600, 0.5) + 0.0
            z = warmup_truth(fine, t)[:, :3]
            early = fine < END
            design = np.stack([(np.log1p(fine[early] / 20) / np.log1p(END / 20)) ** j for j in range(4)], axis=1)
            # The curve that the model would fit without noise: its own misfit is not what the interval speaks of.
            best = np.linalg.lstsq(design, (z - z[~early].mean(axis=0))[early], rcond=None)[0]
            miss = basis @ (solution.table.coefficients[k].T - best)
            half = 2.45 * np.sqrt(np.einsum("tp,apq,tq->ta", basis, covariance[k], basis))  # Student, 6 degrees
            inside += int((np.abs(miss) <= half).sum())
            total += miss.size
    print(f"coverage, slow noise {slow_noise}: {100 * inside / total:.2f} % of {total}")
    # Axes, temperatures and trials are apart; the times of a curve are not, and count once. By chance once in 10,000.
    apart = total // len(times)
    fewest, most = binom.interval(1 - 1e-4, apart, 0.95)
    assert fewest / apart <= inside / total <= most / apart


@pytest.mark.parametrize("count", [3, 5, 8])
def test_slopes_at_knots_are_those_of_scipys_monotone_cubics(count):
    rng = np.random.default_rng(count)
    for _ in range(50):
        knots = np.cumsum(rng.uniform(0.5, 9.0, count))
        values = np.round(rng.standard_normal((count, 3, 2)), 1)  # rounded, so that neighbours are alike at times
        expected = PchipInterpolator(knots, values, axis=0).derivative()(knots)
        np.testing.assert_allclose(_pchip_slopes(knots, values), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_simplex_goes_where_scipys_goes(count):
    rng = np.random.default_rng(count)

    def valley(p):
        return float((100 * (p[1:] - p[:-1] ** 2) ** 2).sum() + ((1 - p) ** 2).sum())

    for _ in range(10):
        simplex = rng.standard_normal((count + 1, count))
        options = {"initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-9, "maxiter": 200}
        expected = minimize(valley, simplex[0], method="Nelder-Mead", options=options).x
        np.testing.assert_allclose(_nelder_mead(valley, simplex.copy(), 1e-3, 1e-9), expected, rtol=1e-9)

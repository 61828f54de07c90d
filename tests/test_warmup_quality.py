"""What makes no warm-up test is refused, what makes a poor one is named; motion, noise and settling are found."""

from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.errors import DataError, OptionError
from imulab.procedures.warmup.cycles import find_power_cycle, make_curves
from imulab.procedures.warmup.model import coefficients_of, evaluate, fitted_noise, solve, statistics
from imulab.recording import Recording
from test_warmup_fit import END, HOUR, cycle_of


def flat(t):
    return 100 * HOUR * np.exp(-t / 60)


@pytest.mark.slow
def test_warnings_name_what_is_wrong_with_the_test():
    rng = np.random.default_rng(4)

    def noisy(recording, **metadata):
        extra = {n: v + 1e-6 * rng.standard_normal(len(v)) for n, v in recording.columns.items() if n != "time"}
        return replace(recording.with_columns(extra, {}), metadata=recording.metadata | metadata)

    good = [noisy(cycle_of(flat, t, name=f"good{t}{c}")) for t in (-20, 0, 20) for c in (1, 2)]
    assert il.fit_warmup(good, temperatures=[-20, 0, 20], settling_time=END).calibration.verdict.state == "good"
    moving = noisy(cycle_of(flat, -20, name="moving"))
    for axis in ("gyro_x", "accel_x"):
        moving.columns[axis][4000:4200] += 0.05 * np.sin(np.arange(200))
    short = noisy(cycle_of(flat, 0, name="short", duration=310))
    warm = noisy(cycle_of(flat, 20.4, name="warm"), set_point="19")
    far = noisy(cycle_of(flat, 0.8, name="far"))
    late = noisy(cycle_of(flat, -20, name="late"))
    late = late.with_columns({"time": late.column("time") + 2.5}, {})
    fit = il.fit_warmup([*good, moving, short, warm, far, late], temperatures=[-20, 0, 20], settling_time=END)
    text = "\n".join(fit.calibration.warnings)
    for words in (
        "moved; those seconds are left out: moving (12 s, first at 199 s)",
        "ends before T_M + 30 s = 330 s, so that the second half of the cycle is its reference: short (310 s)",
        "not cold: at power-on warmer than the chamber",
        "warm (+1.4 K)",
        "more than 0.5 K from the set point: far (+0.8 K)",
        "the first sample comes late after power-on: late (2.5 s)",
    ):
        assert words in text
    alone = il.fit_warmup(good[:3] + good[4:], temperatures=[-20, 0, 20], settling_time=END)
    assert any("one cycle only at 0 degC" in message for message in alone.calibration.warnings)
    drifting = [cycle_of(lambda t: flat(t), t, name=f"d{t}{c}") for t in (-20, 0) for c in (1, 2)]
    drifting = [noisy(r.with_columns({"gyro_x": r.column("gyro_x") + 2e-7 * r.column("time")}, {})) for r in drifting]
    found = il.fit_warmup(drifting, temperatures=[-20, 0], settling_time=END).calibration.warnings
    assert any("gyro still drifts in the settled part of 4 of 4" in message for message in found)


@pytest.mark.parametrize("late", [0.0, 10.0])
@pytest.mark.slow
def test_logs_that_all_begin_late_are_said_where_there_is_a_thermometer(late):
    def begun(on, name):
        made = cycle_of(lambda t: flat(t + late), on, name=name)
        inside = on + 10 * (1 - np.exp(-(made.column("time") + late) / 80))
        units = {"temperature": "degC"}
        return replace(
            made.with_columns({"temperature": inside}, units), metadata=made.metadata | {"set_point": str(on)}
        )

    cycles = [begun(on, f"c{on}{k}") for on in (-20, 0, 20) for k in (1, 2)]
    verdict = il.fit_warmup(cycles, temperatures=[-20, 0, 20], settling_time=END).calibration.verdict
    assert any("logged from some time after power-on" in reason for reason in verdict.reasons) == (late > 0)
    assert any("start the log before power comes on" in line for line in verdict.next) == (late > 0)


def sloping_cycles(slope):
    """Two cycles at each of three temperatures: an exponential, and a straight line of so much of it each second."""

    def law(t):
        return flat(t) - 100 * HOUR * slope * t

    return [cycle_of(law, t, name=f"c{t}{c}") for t in (-20, 0, 20) for c in (1, 2)]


@pytest.mark.slow
def test_a_time_constant_at_the_limit_of_the_search_is_said_to_be_so():
    """A slope, which no exponential of these cycles is; not where the one beside the true one has nothing to do."""
    said = []
    for slope in (1 / 600, 0.0):
        cycles = sloping_cycles(slope)
        fit = il.fit_warmup(cycles, temperatures=[-20, 0, 20], settling_time=END, model="exponential")
        said.append(any("s is the longest that is sought, 3 T_M" in message for message in fit.calibration.warnings))
        longest = [p for p in fit.calibration.parameters.values() if p.value == pytest.approx(3 * END, rel=0.02)]
        assert all(parameter.standard_uncertainty is None for parameter in longest)  # it was 1 ms
    assert said == [True, False]


def test_an_axis_of_one_value_has_no_time_constants_to_speak_of():
    said = []
    for slope in (1 / 600, 0.0):
        cycles = sloping_cycles(slope)
        cycles = [r.with_columns({"gyro_y": np.full(len(r), 1e-3)}, {"gyro_y": "rad/s"}) for r in cycles]
        fit = il.fit_warmup(cycles, temperatures=[-20, 0, 20], settling_time=END, model="exponential")
        said.append(any("s is the longest that is sought, 3 T_M" in message for message in fit.calibration.warnings))
    assert said == [True, False]


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("exchanged", [None, (1, 2), (0, 3)])
def test_exchanged_temperatures_are_named(exchanged, count):
    """The amplitude of a curve goes as a parabola of the temperature: what fits no neighbours is no such law."""
    at, labels = [-40, -20, 0, 20, 40], [-40, -20, 0, 20, 40]
    if exchanged:
        a, b = exchanged
        labels[a], labels[b] = labels[b], labels[a]
    rng = np.random.default_rng(1)

    def curve(true):
        size = (100 + 2 * true - 0.01 * true**2) * (1 + 0.02 * rng.standard_normal())
        return lambda t: size * HOUR * np.exp(-t / 60)

    cycles = [
        cycle_of(curve(true), label, name=f"c{true}_{number}")
        for true, label in zip(at, labels, strict=True)
        for number in range(1, count + 1)
    ]
    warnings = il.fit_warmup(cycles, temperatures=at, settling_time=END, model="knot-cubic").calibration.warnings
    lines = [line for line in warnings if "only when they are exchanged" in line]
    assert bool(lines) == bool(exchanged)
    if exchanged:
        low, high = (at[k] for k in exchanged)
        assert f"the curves at {low} and {high} degC fit" in lines[0]
        assert f"c{low}_1" in lines[0]


@pytest.mark.parametrize(("factor", "words"), [(0.5, "1/2 of g"), (1 / 9.80665, "as g would be"), (1.0, "")])
def test_accelerometers_that_show_no_gravity_are_bad(factor, words):
    cycles = [cycle_of(flat, t, name=f"c{t}{c}") for t in (-20, 0) for c in (1, 2)]
    raised = {"accel_x": 0.0, "accel_y": 0.0, "accel_z": 9.80665}
    cycles = [
        cycle.with_columns(
            {k: factor * (0 * cycle.column("accel_x") + g) + 1e-3 * cycle.column("accel_x") for k, g in raised.items()},
            dict.fromkeys(raised, "m/s^2"),
        )
        for cycle in cycles
    ]
    verdict = il.fit_warmup(cycles, temperatures=[-20, 0], settling_time=END).calibration.verdict
    assert (verdict.state == "bad") == bool(words)
    assert words in verdict.reasons[0] if words else not any("gravity" in reason for reason in verdict.reasons)


def test_a_unit_that_cannot_be_is_asked_about():
    cycles = [cycle_of(lambda t: 3600 * flat(t), t, name=f"c{t}{c}") for t in (-20, 0) for c in (1, 2)]
    verdict = il.fit_warmup(cycles, temperatures=[-20, 0], settling_time=END).calibration.verdict
    assert verdict.state == "bad"
    asked = [message for message in verdict.reasons if "does its column have the right unit?" in message]
    assert [message.split()[0] for message in asked] == ["gyro_x"]


@pytest.mark.parametrize(
    ("temperatures", "options", "kind", "words"),
    [
        (
            [-20, 0, 21.5],
            {},
            DataError,
            "c2: power-on temperature 21.5 degC fits no calibration temperature within 1 K; "
            r"expected one of .* \(--temperatures names others, --tolerance takes more\)",
        ),
        ([-20, -20, 0], {}, DataError, "no power cycle at 20 degC among 3 files: every interval needs"),
        ([], {}, DataError, "no power cycles"),
        ([-20, 0, 20], {"temperatures": [0.0]}, OptionError, "two or more, ascending"),
        ([-20, 0, 20], {"temperatures": [20.0, 0]}, OptionError, "two or more, ascending"),
        ([-20, 0, 20], {"tolerance": 11}, OptionError, "tolerance 11 K"),
        ([-20, 0, 20], {"model": "quartic"}, OptionError, "expected one of interval-cubic knot-cubic"),
        ([-20, 0, 20], {"exit": "fade"}, OptionError, "expected one of zero hold taper"),
        ([-20, 0, 20], {"pool": "all"}, OptionError, "expected one of unit type"),
        ([-20, 0, 20], {"pool": "type"}, DataError, "no serial in the head"),
        ([-20, 0, 20], {"settling_time": -5}, OptionError, "settling time"),
        ([-20, 0, 20], {"settling_time": 5}, DataError, "5 s of samples before T_M"),
        ([-20, 0, 20], {"axes": ["gyro_q"]}, DataError, "no column gyro_q; found gyro_x accel_x"),
    ],
)
def test_what_makes_no_test_is_refused(temperatures, options, kind, words):
    cycles = [cycle_of(flat, t, name=f"c{i}", duration=360, rate=5) for i, t in enumerate(temperatures)]
    with pytest.raises(kind, match=words):
        il.fit_warmup(cycles, **({"temperatures": [-20, 0, 20]} | options))


def test_a_flight_log_is_fitted_where_the_vehicle_stood_still():
    """400 s at rest, then flight: the same table as from the 400 s alone, and the flight is named."""
    rng = np.random.default_rng(6)
    logs, cut = [], []
    for t in (0, 20):
        for c in (1, 2):
            whole = cycle_of(lambda s, t=t: (1 + t / 40) * flat(s), t, name=f"log{t}{c}", duration=700)
            time = whole.column("time")
            flying = np.where(time > 400, 0.2 * np.sin(3 * time) * np.sin(1.7 * time + 1), 0.0)
            noise = 1e-6 * rng.standard_normal((2, len(time)))
            columns = {axis: whole.column(axis) + flying + noise[i] for i, axis in enumerate(("gyro_x", "accel_x"))}
            logs.append(whole.with_columns(columns, {}))
            early = {name: values[time < 399] for name, values in logs[-1].columns.items()}
            cut.append(replace(logs[-1], columns=early))
    options = {"temperatures": [0, 20], "settling_time": END, "model": "knot-log-cubic"}
    fit = il.fit_warmup(logs, **options)
    assert any("the unit moved" in message and "first at" in message for message in fit.calibration.warnings)
    time = np.arange(0, 300.0)
    want = evaluate(il.fit_warmup(cut, **options).table, time, 10.0)
    np.testing.assert_allclose(evaluate(fit.table, time, 10.0), want, atol=2 * HOUR)


def test_a_log_that_is_flight_for_the_most_part_is_fitted_where_it_stood_still():
    """350 s at rest and 1250 s of flight, whose turns move the bins' means too: the same table as from the rest."""
    rng = np.random.default_rng(8)
    logs, cut = [], []
    for t in (0, 20):
        for c in (1, 2):
            whole = cycle_of(lambda s, t=t: (1 + t / 40) * flat(s), t, name=f"log{t}{c}", duration=1600)
            time = whole.column("time")
            turns = 0.5 * np.sin(time / 9) + 0.05 * rng.standard_normal(len(time))
            flying = np.where(time > 350, turns, 0.0)
            noise = 1e-6 * rng.standard_normal((2, len(time)))
            columns = {axis: whole.column(axis) + flying + noise[i] for i, axis in enumerate(("gyro_x", "accel_x"))}
            logs.append(whole.with_columns(columns, {}))
            early = {name: values[time < 349] for name, values in logs[-1].columns.items()}
            cut.append(replace(logs[-1], columns=early))
    options = {"temperatures": [0, 20], "settling_time": END, "model": "knot-log-cubic"}
    fit = il.fit_warmup(logs, **options)
    assert any("log01 (1251 s, first at 349 s)" in message for message in fit.calibration.warnings)
    time = np.arange(0, 300.0)
    want = evaluate(il.fit_warmup(cut, **options).table, time, 10.0)
    np.testing.assert_allclose(evaluate(fit.table, time, 10.0), want, atol=2 * HOUR)


def test_a_cycle_that_moves_throughout_is_known_by_the_others():
    rng = np.random.default_rng(9)
    cycles = [cycle_of(flat, t, name=f"c{t}{c}") for t in (0, 20) for c in (1, 2)]
    for cycle in cycles:
        cycle.columns["gyro_x"] += 1e-6 * rng.standard_normal(len(cycle))
    cycles[2].columns["gyro_x"] += 1e-4 * rng.standard_normal(len(cycles[2]))
    with pytest.raises(DataError, match=r"c201: the unit moved .* 0 s at rest are too few \(noise of gyro_x 1\d\d tim"):
        il.fit_warmup(cycles, temperatures=[0, 20], settling_time=END)


@pytest.mark.parametrize("step", [0.061, 0.1])
def test_steps_coarser_than_the_noise_are_no_motion_and_no_stuck_output(step):
    """16 bits over 2000 deg/s, or a log of one decimal, and noise of a third or a fifth of a step."""
    rng = np.random.default_rng(12)
    degree = np.pi / 180
    cycles = []
    for number, temperature in enumerate((0, 0, 20, 20)):
        whole = cycle_of(lambda t: 0.3 * degree * np.exp(-t / 40), temperature, name=f"c{number}", axes=("gyro_x",))
        read = whole.column("gyro_x") / degree + 0.02 * rng.standard_normal(len(whole))
        cycles.append(whole.with_columns({"gyro_x": step * np.round(read / step) * degree}, {}))
    fit = il.fit_warmup(cycles, temperatures=[0, 20], settling_time=END, model="exponential")
    assert not [message for message in fit.calibration.warnings if "moved" in message or "stuck" in message]
    time = np.arange(0, 300.0)
    error = evaluate(fit.table, time, 10.0)[0] / degree - 0.3 * np.exp(-time / 40)
    assert np.sqrt(np.mean(error**2)) < step / np.sqrt(12)
    knocked = cycles[2].columns["gyro_x"]
    knocked[2000:2040] += 20 * step * degree * rng.choice([-1, 1], 40)
    knocked[5000:5200] = knocked[5000]  # 10 s of a stuck link are no fault that steps of this size show
    fit = il.fit_warmup(cycles, temperatures=[0, 20], settling_time=END, model="exponential")
    assert [message for message in fit.calibration.warnings if "c2 (4 s, first at 99 s)" in message]


@pytest.mark.slow
@pytest.mark.parametrize("model", ["interval-cubic", "knot-cubic", "knot-log-cubic", "exponential"])
def test_noise_alone_leaves_nothing_at_the_tests(model):
    """A fit follows some of the noise of its own cycles: what is taken off is that much smaller."""
    scales = {"knot-log-cubic": (20.0,), "exponential": (20.0, 90.0)}.get(model, ())
    rng = np.random.default_rng(10)
    at, left, unseen = np.array([-20.0, 0, 20]), [], []
    for _ in range(60):
        noise = {(t, c): HOUR * 100 * rng.standard_normal(900) for t in at for c in (1, 2)}
        cycles = [
            find_power_cycle(
                Recording(
                    {"time": np.arange(900) / 2, "gyro_x": values},
                    {"time": "s", "gyro_x": "rad/s"},
                    {"power_on_temperature": str(t + rng.uniform(-0.5, 0.5))},
                )
            )
            for (t, _), values in noise.items()
        ]
        curves, _ = make_curves(cycles, at, tolerance=1, settling_time=END, limit={})
        sums = statistics(curves, model, scales)
        solution = solve(curves, model, scales, sums, np.ones(6))
        square = sums.mean_square(coefficients_of(curves, solution.table))
        left.append((square - fitted_noise(curves, solution, sums)).mean() / HOUR**2)
        unseen.append((square - curves.expected_noise()).mean() / HOUR**2)
    error = np.std(left) / np.sqrt(len(left))
    print(model, np.mean(left), error, np.mean(unseen))
    assert abs(np.mean(left)) < 3.5 * error
    assert np.mean(unseen) < -3.5 * error  # so the plain noise would take off too much


def test_the_settling_time_is_the_longest_of_the_units():
    def cycles(tau):
        return [
            cycle_of(lambda s, tau=tau[u]: 200 * HOUR * np.exp(-s / tau), t, name=f"{u}{t}", serial=u)
            for u in tau
            for t in (0, 20)
        ]

    quick, mixed = cycles({"A": 20.0, "B": 20.0, "C": 20.0}), cycles({"A": 20.0, "B": 20.0, "C": 60.0})
    options = {"temperatures": [0, 20], "pool": "type", "model": "knot-cubic"}
    # 200 exp(-t / tau) is below 5 % from 3 tau on; the mean over units would be there at 118 s
    assert il.fit_warmup(quick, **options).table.settling_time == pytest.approx(60, abs=15)
    assert il.fit_warmup(mixed, **options).table.settling_time == pytest.approx(180, abs=20)


def test_a_table_that_outlasts_its_data_says_so():
    cycles = [cycle_of(flat, t, name=f"{t}{c}") for t in (0, 20) for c in (1, 2)]
    warnings = il.fit_warmup(cycles, temperatures=[0, 20], settling_time=500).calibration.warnings
    assert any("no cycle at 0 20 degC lasts to T_M = 500 s: the table goes on from 400 s" in text for text in warnings)


def test_repeatability_lost_in_the_noise_has_an_uncertainty(reduced):
    trials = 16 if reduced else 40
    rng = np.random.default_rng(11)
    values = []
    for _ in range(trials):  # no scatter but noise: the square is as often below zero, and 95 % lie within two of it
        cycles = [cycle_of(flat, t, name=f"{t}{c}", rate=2) for t in (0, 20) for c in (1, 2, 3)]
        for cycle in cycles:
            cycle.columns["gyro_x"] += 1e-4 * rng.standard_normal(len(cycle))
        fit = il.fit_warmup(cycles, temperatures=[0, 20], settling_time=END, model="knot-cubic", axes=["gyro_x"])
        values.append((fit.repeatability.cycle[0], fit.repeatability.uncertainty[0]))
    value, uncertainty = np.array(values).T
    assert (uncertainty > 0).all()
    assert 0.3 < (value == 0).mean() < 0.8
    assert (value <= 2 * uncertainty).mean() >= 0.9


def logged(law, at, number, seed):
    """Twenty minutes at 1 Hz of a law of time, deg/s, with white noise of 0.004 deg/s."""
    time = np.arange(1200.0)
    rates = law(time)[:, None] * [1.0, -0.7, 0.5] + 0.004 * np.random.default_rng(seed).standard_normal((1200, 3))
    columns = {"time": time} | {f"gyro_{axis}": rates[:, k] for k, axis in enumerate("xyz")}
    return Recording(
        columns,
        {"time": "s"} | {f"gyro_{axis}": "deg/s" for axis in "xyz"},
        name=f"{at}-{number}",
        metadata={"power_on_temperature": str(at)},
    )


@pytest.mark.parametrize(("slope", "state"), [(0.0, "good"), (4e-6, "look")])
def test_what_still_drifts_settles_later_and_a_drift_that_goes_on_is_said(slope, state):
    """A slow exponential, 120 s: by its size alone it has settled when a tenth of it is still to come."""
    temperatures = [-20, 0, 20, 40, 60]

    def law(time):
        return 0.012 * np.exp(-time / 20) + 0.018 * np.exp(-time / 120) + slope * time

    later = []
    for seed in range(3):
        cycles = [logged(law, at, k, [seed, k, at + 20]) for at in temperatures for k in range(3)]
        record = il.fit_warmup(cycles, temperatures=temperatures).calibration
        assert record.verdict.state == state
        later.append(record.value("settling_time"))
        if state == "good":
            assert record.value("time_constant_2") == pytest.approx(120, abs=12)
    assert (max(later) > 300) == (state == "good")

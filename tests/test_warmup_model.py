"""Tables: which row, which value, which exit; in floats and in 16 bits."""

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from few_bits import evaluate_float32, to_int16
from imulab.errors import RecordError
from imulab.procedures.warmup.model import WarmupTable, amplitude_slopes, edge_jumps, evaluate, exit_jump, table_from
from reference import warmup as reference

AT = np.array([-40.0, -30, -20, -10, 0, 40, 50, 60])
HOUR = np.pi / 180 / 3600


def a_table(model="interval-cubic", exit_rule="zero", seed=1):
    rng = np.random.default_rng(seed)
    rows = 7 if model == "interval-cubic" else 8
    size = 2 if model == "exponential" else 4
    c = 300 * HOUR * rng.standard_normal((rows, 3, size))
    return WarmupTable(
        model=model,
        temperatures=AT,
        axes=("gyro_x", "gyro_y", "gyro_z"),
        units=("rad/s",) * 3,
        coefficients=c,
        settling_time=300.0,
        exit=exit_rule,
        time_scale=20.0 if model == "knot-log-cubic" else None,
        time_constants=(25.0, 120.0) if model == "exponential" else (),
        slopes=amplitude_slopes(AT, c, (25.0, 120.0)) if model == "exponential" else None,
    )


MODELS = ["interval-cubic", "knot-cubic", "knot-log-cubic", "exponential"]


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("exit_rule", ["zero", "hold", "taper"])
def test_a_table_is_evaluated_as_its_equations_say(model, exit_rule):
    table = a_table(model, exit_rule)
    section = table.to_section()
    time = np.array([0.0, 0.5, 17.3, 299.999, 300.0, 301.0, 333.3, 360.0, 4000.0])
    for temperature in (-40.0, -35.5, -30.0, -0.001, 0.0, 13.7, 39.999, 40.0, 60.0):
        found = evaluate(table, time, temperature)
        want = [[reference.z_at(section, a, t, temperature) for t in time] for a in range(3)]
        np.testing.assert_allclose(found, want, rtol=1e-12, atol=1e-18)


@pytest.mark.parametrize("temperature", [-40.01, 60.01, np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("model", MODELS)
def test_outside_means_outside(model, temperature):
    assert evaluate(a_table(model), np.array([1.0]), temperature) is None


def test_edges_belong_to_the_interval_that_begins_there_and_the_last_is_closed():
    table = a_table()
    for temperature, row in ((-40, 0), (-30, 1), (-30.0001, 0), (0, 4), (39.99, 4), (40, 5), (60, 6)):
        np.testing.assert_array_equal(table.coefficients_at(temperature), table.coefficients[row])


def test_nan_in_time_comes_out_and_time_before_power_on_counts_as_power_on():
    z = evaluate(a_table(), np.array([np.nan, -3.0, 0.0]), 10.0)
    assert np.isnan(z[:, 0]).all()
    np.testing.assert_array_equal(z[:, 1], z[:, 2])


def test_between_knots_the_curve_at_the_time_constants_runs_on_scipys_monotone_cubics():
    table = a_table("exponential")
    instants = np.array(table.time_constants)
    curve = PchipInterpolator(AT, np.stack([evaluate(table, instants, at) for at in AT]), axis=0)
    for temperature in np.linspace(-40, 60, 37):
        found = evaluate(table, instants, temperature)
        np.testing.assert_allclose(found, curve(temperature), rtol=1e-12, atol=1e-18)


def test_errors_that_cancel_in_the_curve_at_the_knots_cancel_between_them():
    """Amplitudes of 20 and 32 s (the closest that a fit may find) off by +1 and nearly -1: what is left is small."""
    constants = (20.0, 32.0)
    rng = np.random.default_rng(4)
    amplitudes = np.column_stack([100 - AT, 0.02 * AT**2])[:, None, :]
    off = 10 * rng.standard_normal(len(AT))[:, None, None] * np.array([1.0, -np.exp(-1) / np.exp(-20 / 32)])
    time = np.linspace(0, 300, 301)

    def curve(amplitude, slopes, temperature):
        row = np.searchsorted(AT, temperature) - 1
        h, s = AT[row + 1] - AT[row], (temperature - AT[row]) / (AT[row + 1] - AT[row])
        at = (1 + 2 * s) * (1 - s) ** 2 * amplitude[row] + s * s * (3 - 2 * s) * amplitude[row + 1]
        at = at + h * (s * (1 - s) ** 2 * slopes[row] - s * s * (1 - s) * slopes[row + 1])
        return (at @ np.exp(-time / np.array(constants)[:, None]))[0]

    left = []
    for slopes_of in (
        lambda a: amplitude_slopes(AT, a, constants),
        lambda a: PchipInterpolator(AT, a).derivative()(AT),
    ):
        changes = [
            curve(amplitudes + off, slopes_of(amplitudes + off), t) - curve(amplitudes, slopes_of(amplitudes), t)
            for t in np.linspace(-39.5, 59.5, 50)
        ]
        left.append(np.sqrt(np.mean(np.square(changes))))
    at_knots = np.sqrt(np.mean(np.square((off @ np.exp(-time / np.array(constants)[:, None]))[:, 0])))
    assert left[0] < 1.1 * at_knots
    assert left[1] > 1.3 * at_knots  # what each amplitude by itself would leave


def test_slopes_of_constants_that_coincide_are_finite():
    c = np.random.default_rng(2).standard_normal((len(AT), 2, 2))
    found = amplitude_slopes(AT, c, (50.0, 50.0))
    np.testing.assert_allclose(found, PchipInterpolator(AT, c, axis=0).derivative()(AT), rtol=1e-13)


def test_jumps_are_those_seen_on_either_side_of_an_edge():
    table = a_table()
    time = np.linspace(0, 299.999, 400)
    jumps = edge_jumps(table, time)
    for k, edge in enumerate(AT[1:-1]):
        apart = evaluate(table, time, edge) - evaluate(table, time, edge - 1e-9)
        np.testing.assert_allclose(jumps[k], np.abs(apart).max(axis=1), rtol=1e-9)
    for model in MODELS[1:]:
        knots = a_table(model)
        for edge in AT[1:-1]:
            apart = evaluate(knots, time, edge) - evaluate(knots, time, edge - 1e-9)
            assert np.abs(apart).max() < 1e-6 * np.abs(knots.coefficients).max()
    np.testing.assert_allclose(exit_jump(table)[3], evaluate(table, np.array([300 - 1e-9]), -5.0)[:, 0], rtol=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_the_section_of_the_record_reads_back(model):
    table = a_table(model, "taper")
    again = table_from(table.to_section())
    assert again.to_section() == table.to_section()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"model": "quartic"}, "known models"),
        ({"exit": "fade"}, "known rules"),
        ({"temperatures": [-40, -30, -30, -10, 0, 40, 50, 60]}, "ascending"),
        ({"temperatures": [-40, 60]}, "shape"),
        ({"units": ["rad/s"]}, "units"),
        ({"units": ["rad/s", "rad/s", "furlong"]}, "furlong"),
        ({"settling_time": 0.0}, "settling_time"),
        ({"axes": ["gyro_x", "gyro_x", "gyro_z"]}, "axes"),
        ({"coefficients": "many"}, "table"),
    ],
)
def test_a_damaged_table_is_refused(change, words):
    with pytest.raises(RecordError, match=words):
        table_from(a_table().to_section() | change)
    section = a_table().to_section()
    del section["settling_time"]
    with pytest.raises(RecordError, match="settling_time"):
        table_from(section)


@pytest.mark.parametrize("model", MODELS)
def test_float32_is_within_a_hundredth_of_a_degree_per_hour(model):
    table = a_table(model)
    time = np.arange(0, 60_000) / 200
    for temperature in (-40.0, -33.3, 0.0, 21.7, 60.0):
        error = evaluate_float32(table, time, temperature) - evaluate(table, time, temperature)
        assert evaluate_float32(table, time, temperature).dtype == np.float32
        assert 0 < np.abs(error).max() <= 0.01 * HOUR
    assert evaluate_float32(table, time, 60.01) is None


@pytest.mark.parametrize(("form", "most"), [("power", 2.0), ("bernstein", 1.0)])
@pytest.mark.parametrize("model", MODELS)
def test_sixteen_bits_cost_as_many_steps_as_the_form_allows(model, form, most):
    worst = 0.0
    for seed in range(20):
        table = a_table(model, seed=seed)
        small = to_int16(table, form)
        assert small.values.dtype == np.int16
        rough = small.expand()
        time = np.linspace(0, 299.9, 200)
        for temperature in (-40.0, -35.0, 0.0, 21.7, 60.0):
            error = np.abs(evaluate(rough, time, temperature) - evaluate(table, time, temperature)).max(axis=1)
            worst = max(worst, (error / small.scale).max())
    # Amplitudes of exponentials have one form only: two halves of a step, and what the slopes add.
    assert 0.1 < worst <= (2.0 if model == "exponential" else most)

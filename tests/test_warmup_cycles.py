"""Samples to bins: exact averages, blocks, motion, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.errors import DataError, UnitError
from imulab.procedures.warmup.cycles import bin_edges, common_axes, find_power_cycle, gauss_nodes, merge
from imulab.recording import Recording


def a_cycle(*, rate=50.0, duration=400.0, temperature="-20", unit="deg/h", seed=1, **columns):
    rng = np.random.default_rng(seed)
    time = np.arange(round(rate * duration)) / rate
    found = {"time": time, "gyro_x": 100 * np.exp(-time / 60) + rng.standard_normal(len(time))}
    found["gyro_y"] = rng.standard_normal(len(time))
    found |= columns
    units = {"time": "s", "gyro_x": unit, "gyro_y": unit}
    head = {} if temperature is None else {"power_on_temperature": temperature}
    return Recording(found, units | {name: "degC" for name in columns if name == "temperature"}, head, name="c.csv")


def blocks_of(recording, *sizes):
    edges = np.cumsum([0, *sizes, len(recording)])
    for start, stop in zip(edges[:-1], np.minimum(edges[1:], len(recording)), strict=True):
        part = {name: values[start:stop] for name, values in recording.columns.items()}
        yield replace(recording, columns=part, first_row=int(start) + 1)


def test_two_nodes_have_the_moments_of_any_samples():
    rng = np.random.default_rng(2)
    x = rng.uniform(-0.5, 0.5, (50, 7)) ** 3
    nodes, shares = gauss_nodes(np.column_stack([(x**k).mean(axis=1) for k in (1, 2, 3)]))
    for k in (0, 1, 2, 3):
        np.testing.assert_allclose((shares * nodes**k).sum(axis=1), (x**k).mean(axis=1), rtol=1e-9, atol=1e-15)
    alone, share = gauss_nodes(np.array([[0.3, 0.09, 0.027]]))
    np.testing.assert_allclose(alone, 0.3, atol=1e-6)
    np.testing.assert_allclose(share.sum(), 1.0)


def test_bins_and_merged_bins_average_cubics_of_uneven_times_exactly():
    rng = np.random.default_rng(3)
    time = np.cumsum(rng.exponential(0.03, 12_000))
    cubic = 1 - 0.02 * time + 3e-5 * time**2 - 4e-8 * time**3
    head = {"power_on_temperature": "0"}
    cycle = find_power_cycle(Recording({"time": time, "gyro_x": cubic}, {"time": "s", "gyro_x": "rad/s"}, head))
    edges = bin_edges(300.0)
    for bins in (cycle.bins, merge(cycle.bins, edges)):
        at = (bins.shares * (1 - 0.02 * bins.nodes + 3e-5 * bins.nodes**2 - 4e-8 * bins.nodes**3)).sum(axis=1)
        np.testing.assert_allclose(at, bins.mean[:, 0], rtol=0, atol=1e-13)
    wide = merge(cycle.bins, edges)
    inside = (time >= edges[5]) & (time < edges[6])
    assert wide.count[5] == inside.sum()
    np.testing.assert_allclose(wide.mean[5, 0], cubic[inside].mean(), rtol=1e-13)
    np.testing.assert_allclose(wide.variance[5, 0], cubic[inside].var(), rtol=1e-9)


def test_blocks_give_what_the_whole_gives():
    recording = a_cycle()
    whole = find_power_cycle(recording)
    parts = find_power_cycle(blocks_of(recording, 7, 1, 4_000, 33, 9_000))
    for name in ("start", "count", "nodes", "shares", "mean", "variance"):
        np.testing.assert_allclose(getattr(parts.bins, name), getattr(whole.bins, name), rtol=1e-9, atol=1e-12)
    assert parts.last == whole.last


def test_units_become_si():
    cycle = find_power_cycle(a_cycle())
    assert cycle.units == ("rad/s", "rad/s")
    np.testing.assert_allclose(cycle.bins.mean[0, 0], np.radians(a_cycle().column("gyro_x")[:50].mean() / 3600))
    assert find_power_cycle(a_cycle(unit="count")).units == ("count", "count")


@pytest.mark.parametrize(("text", "value"), [("-20", -20.0), ("-20 degC", -20.0), ("253.15 K", -20.0)])
def test_the_power_on_temperature_is_read_from_the_head(text, value):
    assert find_power_cycle(a_cycle(temperature=text)).temperature == pytest.approx(value)


def test_the_column_stands_in_only_when_asked():
    recording = a_cycle(temperature=None)
    time = recording.column("time")
    warm = recording.with_columns({"temperature": -19.5 + 0.01 * time}, {"temperature": "degC"})
    with pytest.raises(DataError, match="no power_on_temperature"):
        find_power_cycle(warm)
    assert find_power_cycle(warm, temperature_from_column=True).temperature == pytest.approx(-19.5)


def shifted(recording, by):
    return recording.with_columns({"time": recording.column("time") + by}, {})


def with_nan(recording):
    values = recording.column("gyro_y").copy()
    values[4321] = np.nan
    return recording.with_columns({"gyro_y": values}, {})


@pytest.mark.parametrize(
    ("recording", "words"),
    [
        (a_cycle(temperature=None), "c.csv: no power_on_temperature in the head"),
        (a_cycle(temperature="nan"), "c.csv: power_on_temperature is nan"),
        (a_cycle(temperature="cold"), "expected a temperature such as -20.* found 'cold'"),
        (a_cycle(temperature="20 s"), "found '20 s'"),
        (shifted(a_cycle(), 5.01), "row 1, column time: the first sample is 5.01 s after power-on"),
        (shifted(a_cycle(), -2), "2 s before power-on"),
        (with_nan(a_cycle()), "row 4322, column gyro_y: expected a finite number, found nan"),
        (shifted(a_cycle(), 0).with_columns({"time": a_cycle().column("time")[::-1].copy()}, {}), "runs backwards"),
        (Recording({"time": np.arange(9.0)}, {"time": "s"}, {}, name="c.csv"), "no column gyro_"),
    ],
)
def test_what_cannot_be_a_power_cycle_is_refused(recording, words):
    with pytest.raises(DataError, match=words):
        find_power_cycle(recording)


def test_rows_of_zeros_before_power_on_are_no_part_of_the_cycle():
    off = a_cycle().column("time") < 20
    columns = {axis: np.where(off, 0.0, a_cycle().column(axis)) for axis in ("gyro_x", "gyro_y")}
    logged_before = a_cycle().with_columns(columns, {})
    with pytest.raises(DataError, match=r"c\.csv: row 1001, column time: every axis is zero before 20 s, as before"):
        find_power_cycle(logged_before)
    with pytest.raises(DataError, match="every axis is zero before 20 s, as before"):
        find_power_cycle(blocks_of(logged_before, 1000))  # of which the first has no other row
    assert find_power_cycle(logged_before, latest_start=30).first == pytest.approx(20.0)


def test_a_late_start_is_taken_when_told():
    assert find_power_cycle(shifted(a_cycle(), 5.01), latest_start=6).first == pytest.approx(5.01)


def test_blocks_that_run_backwards_are_refused():
    first, second = a_cycle(), a_cycle()
    with pytest.raises(DataError, match="time does not rise"):
        find_power_cycle([first, replace(second, first_row=20_001)])


def test_axes_of_one_kind_share_a_unit_and_so_do_files():
    mixed = Recording(
        dict(a_cycle().columns), {"time": "s", "gyro_x": "deg/h", "gyro_y": "deg/s"}, a_cycle().metadata, name="c.csv"
    )
    with pytest.raises(UnitError, match=r"one unit, found gyro_x \[deg/h\], gyro_y \[deg/s\]"):
        find_power_cycle(mixed)
    one, other = find_power_cycle(a_cycle()), find_power_cycle(replace(a_cycle(unit="deg/s"), name="d.csv"))
    with pytest.raises(UnitError, match=r"d\.csv: column gyro_x is in deg/s, but in deg/h in c.csv"):
        common_axes([one, other])


def test_files_share_their_axes_and_are_given_once(tmp_path):
    one = find_power_cycle(a_cycle())
    fewer = a_cycle()
    lacking = replace(fewer, columns={k: v for k, v in fewer.columns.items() if k != "gyro_y"}, name="d.csv")
    with pytest.raises(DataError, match=r"d\.csv: no column gyro_y, which c.csv has"):
        common_axes([one, find_power_cycle(lacking)])
    il.write_csv(a_cycle(duration=30), tmp_path / "a.csv")
    read = [find_power_cycle(il.read(tmp_path / "a.csv")) for _ in range(2)]
    with pytest.raises(DataError, match="given twice"):
        common_axes(read)


def test_noise_above_the_curve_does_not_make_the_settling_time_the_shortest():
    """The last bin begins before the latest settling time: no bin was left for the level, and 0/0 made T_M 30 s."""
    chosen = []
    for seed in (26, 28, 31):
        rng = np.random.default_rng(seed)
        time = np.arange(0, 600, 0.2)
        cycles = []
        for temperature in (-20.0, 0.0, 20.0):
            curve = 0.03 * np.exp(-time / 120)
            x = curve[:, None] + 0.05 * np.sqrt(5) * rng.standard_normal((len(time), 3))
            columns = {"time": time} | {f"gyro_{axis}": x[:, i] for i, axis in enumerate("xyz")}
            units = {"time": "s"} | {f"gyro_{axis}": "deg/s" for axis in "xyz"}
            head = {"power_on_temperature": f"{temperature:g}"}
            cycles.append(il.Recording(columns=columns, units=units, metadata=head))
        chosen.append(il.fit_warmup(cycles, temperatures=(-20.0, 0.0, 20.0), model="knot-cubic").table.settling_time)
    assert min(chosen) > 30

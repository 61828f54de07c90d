"""Recordings to static attitudes: where they are, what they are, how well they are known, and what is refused."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

from conftest import some_of
from imulab.errors import DataError, ImulabError, SegmentError, UnitError
from imulab.procedures.tumble import attitudes as held
from imulab.procedures.tumble import attitudes as segment
from imulab.procedures.tumble.attitudes import find_attitudes
from imulab.recording import Recording
from reference import tumble as reference

G = 9.8
AXES = ["accel_x", "accel_y", "accel_z"]


def recording(samples, time=None, unit="m/s^2", **changes) -> Recording:
    columns = {} if time is None else {"time": np.asarray(time, dtype=float)}
    columns |= {name: np.array(samples[:, i], dtype=float) for i, name in enumerate(AXES)}
    units = {"time": "s"} | dict.fromkeys(AXES, unit)
    return Recording(columns, {name: units[name] for name in columns}, name="hall 3.csv", lines_before=1, **changes)


def tumble(directions, *, rate=100.0, hold=5.0, move=2.0, noise=0.007, sway=0.6, seed=1):
    """A unit held in each direction and turned along great circles, swayed; samples, time, and first and last + 1."""
    rng = np.random.default_rng(seed)
    resting, moving = round(hold * rate), round(move * rate)
    parts, holds, count = [], [], 0
    for k, here in enumerate(directions):
        parts.append(np.tile(G * here, (resting, 1)))
        holds.append((count, count + resting))
        if k + 1 < len(directions):
            there = directions[k + 1]
            angle = np.arccos(np.clip(here @ there, -1, 1))
            tau = (np.arange(moving) + 0.5) / moving
            s = (1 - np.cos(np.pi * tau)) / 2
            path = (np.sin((1 - s) * angle)[:, None] * here + np.sin(s * angle)[:, None] * there) / np.sin(angle)
            parts.append(G * path + sway * np.sin(2 * np.pi * np.outer(tau * move, [1.3, 2.9, 6.1])))
            count += resting + moving
    samples = np.vstack(parts)
    return samples + noise * rng.standard_normal(samples.shape), np.arange(len(samples)) / rate, np.array(holds)


DIRECTIONS = reference.random_attitudes(np.random.default_rng(20), 20)


def inside(attitudes, time, holds, settling=0.3, slack=0.35, block=0.0):
    """Each hold is one attitude that lies inside it (to a block) and leaves out little more than the settling edges."""
    begin, end = time[holds[:, 0]], time[holds[:, 1] - 1]
    assert len(attitudes) == len(holds)
    assert np.all(attitudes.start >= begin - block)
    assert np.all(attitudes.stop <= end + block)
    assert np.all(attitudes.start - begin <= settling + slack)
    assert np.all(end - attitudes.stop <= settling + slack)


# --- where they are --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [1e-5, 1e-3, 0.007, 0.05])
@pytest.mark.parametrize("rate", [25.0, 100.0, 400.0])
def test_every_hold_is_found_at_any_rate_and_noise(rate, noise):
    samples, time, holds = tumble(DIRECTIONS, rate=rate, noise=noise)
    attitudes = find_attitudes(recording(samples, time))
    inside(attitudes, time, holds, block=4 / rate)
    np.testing.assert_allclose(attitudes.mean, G * DIRECTIONS, rtol=0, atol=6 * noise / np.sqrt(3.5 * rate))
    assert attitudes.unit == "m/s^2"


def test_the_settling_edges_are_dropped():
    samples, time, holds = tumble(DIRECTIONS)
    for first, _ in holds:  # ringing of 0.5 m/s^2 that dies within 0.3 s
        since = np.arange(60) / 100
        samples[first : first + 60] += (0.5 * np.exp(-since / 0.05) * np.cos(2 * np.pi * 12 * since))[:, None]
    for settling in (0.3, 0.8):
        attitudes = find_attitudes(recording(samples, time), settling=settling)
        inside(attitudes, time, holds, settling, slack=0.6)
        # What is left of the ringing after 0.3 s is 0.5 exp(-6) = 1.2e-3 for a few samples of 400.
        np.testing.assert_allclose(attitudes.mean, G * DIRECTIONS, rtol=0, atol=5 * 0.007 / np.sqrt(300))


def test_the_thresholds_that_are_tried_do_not_matter(monkeypatch):
    samples, time, holds = tumble(DIRECTIONS)
    usual = find_attitudes(recording(samples, time))
    deviation = np.sqrt(np.diagonal(usual.covariance, axis1=1, axis2=2))
    for factors in (np.geomspace(2.0, 300.0, 18), np.geomspace(1.7, 500.0, 31), np.geomspace(4.0, 40.0, 5)):
        monkeypatch.setattr(segment, "_THRESHOLDS", factors)
        other = find_attitudes(recording(samples, time))
        inside(other, time, holds)
        assert np.all(np.abs(other.mean - usual.mean) < 0.5 * deviation)


def test_the_unit_of_the_columns_does_not_matter():
    samples, time, _ = tumble(DIRECTIONS)
    ours, theirs = find_attitudes(recording(samples, time)), find_attitudes(recording(4096 * samples, time, "count"))
    np.testing.assert_array_equal(theirs.pieces, ours.pieces)
    np.testing.assert_array_equal(theirs.mean, 4096 * ours.mean)
    np.testing.assert_allclose(theirs.covariance, 4096.0**2 * ours.covariance, rtol=1e-12)


def disturbed(turn: float):
    """A tumble whose fifth hold is knocked in its middle and rests `turn` rad away afterwards."""
    samples, time, holds = tumble(DIRECTIONS, hold=8.0)
    first, last = holds[4]
    knock = slice(first + 380, first + 420)
    samples[knock] += 5 * np.sin(np.arange(40))[:, None]
    across = np.cross(DIRECTIONS[4], [0, 0, 1])
    samples[first + 420 : last] += G * turn * across / np.linalg.norm(across)
    return samples, time, holds, knock


def test_an_attitude_that_was_interrupted_is_one():
    samples, time, holds, knock = disturbed(0.0)
    attitudes = find_attitudes(recording(samples, time))
    inside(attitudes, time, holds)
    pieces = attitudes.pieces[attitudes.pieces[:, 2] == 4]
    assert len(pieces) == 2
    assert len(attitudes.pieces) == 21
    assert pieces[0, 1] <= knock.start
    assert pieces[1, 0] >= knock.stop
    assert attitudes.samples[4] == (pieces[:, 1] - pieces[:, 0]).sum()
    np.testing.assert_allclose(attitudes.mean[4], G * DIRECTIONS[4], rtol=0, atol=5 * 0.007 / np.sqrt(600))


def test_an_attitude_that_was_knocked_to_another_is_two():
    samples, time, holds, _ = disturbed(np.radians(0.5))
    attitudes = find_attitudes(recording(samples, time))
    assert len(attitudes) == len(holds) + 1
    moved = attitudes.mean[5] - attitudes.mean[4]
    assert np.linalg.norm(moved) == pytest.approx(G * np.radians(0.5), abs=0.007 * np.sqrt(2 / 300) * 5)


def test_no_attitude_spans_a_gap_in_time():
    samples, time, holds = tumble(DIRECTIONS, hold=8.0)
    first, _ = holds[7]
    time = np.where(np.arange(len(time)) < first + 400, time, time + 30)  # the recorder stood still while the unit did
    attitudes = find_attitudes(recording(samples, time))
    inside(attitudes, time, holds)
    assert len(attitudes.pieces) == 21
    for start, stop, _ in attitudes.pieces:
        assert np.diff(time[start:stop]).max() < 0.011


def test_two_holds_with_only_a_gap_between_them_are_two():
    samples, time, holds = tumble(DIRECTIONS)
    keep = np.ones(len(time), dtype=bool)
    for last, first in zip(holds[:-1, 1], holds[1:, 0], strict=True):
        keep[last:first] = False  # the recorder was stopped for every motion
    attitudes = find_attitudes(recording(samples[keep], time[keep]))
    assert len(attitudes) == 20
    np.testing.assert_allclose(attitudes.mean, G * DIRECTIONS, rtol=0, atol=5 * 0.007 / np.sqrt(300))


# --- mean and covariance ---------------------------------------------------------------------------------------


def test_the_mean_is_that_of_the_samples_of_the_pieces():
    samples, time, _, _ = disturbed(0.0)
    attitudes = find_attitudes(recording(samples, time))
    for k in range(len(attitudes)):
        own = np.vstack([samples[a:b] for a, b, owner in attitudes.pieces if owner == k])
        np.testing.assert_allclose(attitudes.mean[k], own.mean(axis=0), rtol=1e-13, atol=1e-13)
        assert attitudes.samples[k] == len(own)


def test_the_covariance_of_the_mean_is_that_of_batch_means(monkeypatch):
    samples, time, _ = tumble(DIRECTIONS)
    monkeypatch.setattr(held, "POOL_DEGREES", 0.0)  # each attitude on its own
    attitudes = find_attitudes(recording(samples, time))
    lengths = attitudes.pieces[:, 1] - attitudes.pieces[:, 0]
    batch = int(np.median(lengths // 13)) // 10 * 13  # ten batches, of whole blocks of 0.13 s
    for (start, stop, k), length in zip(attitudes.pieces, lengths, strict=True):
        expected = reference.batch_covariance_of_mean(samples[start:stop], batch)
        used = length // batch * batch / (length // 13 * 13)  # the batches may leave some over
        np.testing.assert_allclose(attitudes.covariance[k], expected * used, rtol=1e-9, atol=1e-20)


def test_the_covariance_knows_that_samples_are_not_white():
    phi, sigma, count = 0.9, 0.01, 60
    directions = reference.random_attitudes(np.random.default_rng(60), count)
    samples, time, _ = tumble(directions, hold=20.0, noise=0.0)
    white = np.random.default_rng(61).standard_normal(samples.shape)
    samples = samples + lfilter([sigma * np.sqrt(1 - phi**2)], [1, -phi], white, axis=0)
    attitudes = find_attitudes(recording(samples, time))
    assert len(attitudes) == count

    def variance(n):  # of the mean of n samples of a first-order autoregression
        return sigma**2 / n**2 * (n * (1 + phi) / (1 - phi) - 2 * phi * (1 - phi**n) / (1 - phi) ** 2)

    lengths = attitudes.samples
    batch = int(np.median(lengths // 13)) // 10 * 13
    batches = lengths // batch
    # Batches are a little correlated: (V(L) - V(m L)) / (m - 1) is what batch means find on average.
    expected = (variance(batch) - variance(batches * batch)) / (batches - 1) * (batches * batch / lengths)
    assert np.all((expected / variance(lengths) > 0.85) & (expected < variance(lengths)))
    stated = np.diagonal(attitudes.covariance, axis1=1, axis2=2)
    freedom = 3 * (batches - 1).sum()
    assert (stated / expected[:, None]).mean() == pytest.approx(1, abs=4 * np.sqrt(2 / freedom))
    errors = attitudes.mean - G * directions
    quadratic = (errors**2 / variance(lengths)[:, None]).sum()
    assert chi2.ppf(1e-4, 3 * count) < quadratic < chi2.isf(1e-4, 3 * count)
    naive = [samples[a:b].var(axis=0).mean() / (b - a) for a, b, _ in attitudes.pieces]
    assert np.all(naive < 0.1 * variance(lengths))


def test_the_covariance_knows_which_axes_move_together():
    samples, time, _ = tumble(DIRECTIONS, noise=0.0)
    root = np.linalg.cholesky([[1, 0.8, 0], [0.8, 1, 0], [0, 0, 4]])
    samples = samples + 0.01 * np.random.default_rng(5).standard_normal(samples.shape) @ root.T
    covariance = find_attitudes(recording(samples, time)).covariance.sum(axis=0)
    deviation = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(deviation, deviation)
    spread = 1 / np.sqrt(20 * 9)  # of a correlation of 0 from as many degrees of freedom
    np.testing.assert_allclose(correlation[0, 1], 0.8, atol=4 * spread * (1 - 0.8**2))
    np.testing.assert_allclose(correlation[2, :2], 0, atol=4 * spread)
    assert deviation[2] / deviation[0] == pytest.approx(2, rel=4 * spread)


# --- tables of attitudes ---------------------------------------------------------------------------------------


def with_std(table: Recording, units, values) -> Recording:
    names = [f"std_{name}" for name in AXES[: len(values)]]
    columns = {name: np.full(len(table), value) for name, value in zip(names, values, strict=True)}
    return table.with_columns(columns, dict(zip(names, units, strict=True)))


def test_a_table_is_taken_row_by_row():
    rows = np.vstack([DIRECTIONS, DIRECTIONS[:2] + 1e-12])  # nearly equal rows stay apart
    attitudes = find_attitudes(recording(rows, unit="g"))
    np.testing.assert_array_equal(attitudes.mean, rows)
    assert attitudes.covariance is None
    assert attitudes.samples.tolist() == [1] * 22
    assert attitudes.notes == ()
    assert (attitudes.unit, attitudes.trace, attitudes.temperature) == ("g", None, None)
    assert attitudes.label(2) == "row 3 (line 4)"


def test_rows_that_repeat_earlier_ones_count_once():
    rows = np.vstack([DIRECTIONS[:3], DIRECTIONS])
    attitudes = find_attitudes(with_std(recording(rows, unit="g"), ["g"] * 3, [1e-3] * 3))
    np.testing.assert_array_equal(attitudes.mean, DIRECTIONS)
    assert len(attitudes.covariance) == 20
    assert attitudes.label(3) == "row 7 (line 8)"
    (note,) = attitudes.notes
    assert note.startswith("3 of 23 rows are duplicates of earlier ones, such as row 4 (line 5) of row 1 (line 2)")


def test_stated_deviations_become_covariances_in_the_unit_of_the_means():
    attitudes = find_attitudes(
        with_std(recording(DIRECTIONS, unit="g"), ["mg", "ug", "m/s^2"], [2.0, 500.0, 9.80665e-3])
    )
    expected = np.diag([2e-3**2, 5e-4**2, 1e-3**2])
    np.testing.assert_allclose(attitudes.covariance, np.tile(expected, (20, 1, 1)), rtol=1e-14)


@pytest.mark.parametrize(("mean", "std"), [("g", "count"), ("count", "m/s^2"), ("V", "count")])
def test_deviations_in_a_unit_that_does_not_convert_are_refused(mean, std):
    with pytest.raises(UnitError, match=rf"std_accel_x.*{re.escape(std)}"):
        find_attitudes(with_std(recording(DIRECTIONS, unit=mean), [std] * 3, [1.0] * 3))


def test_deviations_of_only_some_axes_are_refused():
    with pytest.raises(DataError, match="no column std_accel_z"):
        find_attitudes(with_std(recording(DIRECTIONS), ["g", "g"], [1.0, 1.0]))


@pytest.mark.parametrize("value", [0.0, -1.0])
def test_a_deviation_that_is_not_positive_is_refused_with_its_row(value):
    table = with_std(recording(DIRECTIONS), ["m/s^2"] * 3, [1.0] * 3)
    table.columns["std_accel_y"][6] = value
    with pytest.raises(SegmentError) as caught:
        find_attitudes(table)
    where = "row 7 (line 8), column std_accel_y"
    assert f"hall 3.csv: {where}: expected a positive standard deviation, found {value:g}" == str(caught.value)


# --- temperature, labels ---------------------------------------------------------------------------------------


def test_the_temperature_of_the_test_is_kept_where_it_is_known():
    warm = recording(DIRECTIONS).with_columns({"temperature": np.linspace(294, 296, 20)}, {"temperature": "K"})
    assert find_attitudes(warm).temperature == pytest.approx(21.85, abs=1e-12)
    assert find_attitudes(recording(DIRECTIONS)).temperature is None


def test_attitudes_are_named_by_their_times():
    samples, time, _ = tumble(DIRECTIONS)
    attitudes = find_attitudes(recording(samples, time))
    assert re.fullmatch(r"attitude 2 \(7\.\d to 11\.\d s\)", attitudes.label(1))
    assert attitudes.times().startswith("0 to 5 s, 7 to 12 s, 14 to 19 s, ")
    assert attitudes.times().endswith(", ...")
    trace = attitudes.trace
    assert trace.quiet < trace.threshold < np.quantile(trace.variance, 0.95)
    resting = 100 * np.mean(trace.variance <= trace.threshold)
    assert f"{resting:.0f} % of the time below the threshold" in trace.describe()


# --- what is refused -------------------------------------------------------------------------------------------


def test_too_short_a_recording_is_refused():
    samples, time, _ = tumble(DIRECTIONS[:2])
    with pytest.raises(SegmentError) as caught:
        find_attitudes(recording(samples[:150], time[:150]))
    assert "hall 3.csv: 150 samples over 1.49 s are too few" in str(caught.value)
    assert "window of 1 s" in str(caught.value)
    with pytest.raises(SegmentError, match="1 samples"):
        find_attitudes(recording(samples[:1], time[:1]))


@pytest.mark.parametrize("time", [None, []])
def test_a_recording_without_samples_is_refused(time):
    with pytest.raises(ImulabError, match=r"hall 3\.csv: "):
        find_attitudes(recording(np.empty((0, 3)), time))


def test_a_recording_without_a_hold_is_refused_with_what_its_trace_shows():
    samples, time, _ = tumble(DIRECTIONS)
    with pytest.raises(SegmentError) as caught:
        find_attitudes(recording(samples, time), shortest=20.0)
    assert "hall 3.csv: no static attitude found: standard deviation within a window" in str(caught.value)
    assert "% of the time below the threshold" in str(caught.value)


@pytest.mark.parametrize(
    ("column", "value", "content"),
    [
        ("accel_y", np.nan, "row 3001 (line 3002), column accel_y: expected a finite number, found nan"),
        ("time", 29.99, "row 3001 (line 3002), column time: time stands still"),
        ("time", 1.0, "row 3001 (line 3002), column time: time runs backwards"),
    ],
)
def test_samples_that_cannot_be_are_refused_with_their_row(column, value, content):
    samples, time, _ = tumble(DIRECTIONS)
    bad = recording(samples, time)
    bad.columns[column][3000] = value
    with pytest.raises(DataError) as caught:
        find_attitudes(bad)
    assert f"hall 3.csv: {content}" in str(caught.value)


def test_a_triad_in_several_units_is_refused():
    mixed = replace(recording(DIRECTIONS), units=dict(zip(AXES, ["g", "mg", "g"], strict=True)))
    with pytest.raises(UnitError, match="must share one unit"):
        find_attitudes(mixed)


# --- clipping --------------------------------------------------------------------------------------------------

CUBE = np.vstack([np.eye(3), -np.eye(3)])
FIXTURE = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], dtype=float)
FIXTURE /= np.linalg.norm(FIXTURE, axis=1, keepdims=True)


@pytest.mark.parametrize(("sign", "side"), [(1, "largest"), (-1, "smallest")])
@pytest.mark.parametrize("step", [0.0, 0.002])
def test_a_flat_top_at_rest_is_called_clipped(sign, side, step):
    samples, time, holds = tumble(np.vstack([DIRECTIONS, CUBE]))
    if step:
        samples = step * np.round(samples / step)
    samples[:, 2] = np.minimum(sign * samples[:, 2], G - 0.004) * sign
    with pytest.raises(DataError) as caught:
        find_attitudes(recording(samples, time))
    message = str(caught.value)
    row = int(re.search(r"^hall 3\.csv: row (\d+) \(line \d+\), column accel_z: clipped: ", message)[1])
    upright = holds[22 if sign == 1 else 25]
    assert upright[0] <= row - 1 < upright[1]
    assert f"exactly the {side} value {sign * (G - 0.004):.9g} m/s^2" in message


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.25, 0.4, 0.7, 1.0, 3.0])
@pytest.mark.parametrize("seed", some_of(2, [1, 2, 3]))
def test_coarse_counts_are_not_called_clipped(noise, seed):
    scale = 256 / G  # 256 counts per g; noise in counts
    directions = np.vstack([reference.random_attitudes(np.random.default_rng(seed), 20), CUBE])
    samples, time, holds = tumble(directions, noise=noise / scale, sway=0.0, seed=seed)  # extremes are at rest
    # Where hardly a count changes, holds that lie between two counts may count as disturbed.
    assert len(find_attitudes(recording(np.round(scale * samples), time, "count"))) >= (0.75 if noise else 1) * len(
        holds
    )


@pytest.mark.parametrize("noise", [0.0, 0.3, 2.0])
@pytest.mark.parametrize("part", [1, 100, 2000])
def test_the_smallest_step_of_all_samples_decides_where_a_part_could(noise, part, monkeypatch):
    samples, time, _ = tumble(DIRECTIONS, noise=noise * G / 256)
    counts = np.round(256 / G * samples)
    counts[:3000] = 8 * np.round(counts[:3000] / 8)  # the first samples have larger steps than the others
    monkeypatch.setattr(segment, "_A_PART", part)
    few = find_attitudes(recording(counts, time, "count"))
    monkeypatch.setattr(segment, "_A_PART", None)
    exact = find_attitudes(recording(counts, time, "count"))
    np.testing.assert_array_equal(few.covariance, exact.covariance)
    np.testing.assert_array_equal(few.mean, exact.mean)
    assert few.trace.threshold == exact.trace.threshold


def test_clipping_in_motion_only_is_no_matter():
    samples, time, holds = tumble(DIRECTIONS)
    moving = np.ones(len(time), dtype=bool)
    for first, last in holds:
        moving[first:last] = False
    samples[moving] *= 3
    clipped = np.clip(samples, -1.5 * G, 1.5 * G)
    assert np.count_nonzero(np.abs(clipped) == 1.5 * G) > 100
    inside(find_attitudes(recording(clipped, time)), time, holds)


def test_clipped_rows_of_a_table_are_called_so():
    rows = np.minimum(reference.random_attitudes(np.random.default_rng(2), 60), 0.8)
    first = int(np.argmax(rows[:, 0] == 0.8))
    count = int((rows[:, 0] == 0.8).sum())
    with pytest.raises(DataError) as caught:
        find_attitudes(recording(rows, unit="g"))
    assert f"row {first + 1} (line {first + 2}), column accel_x: clipped: {count} attitudes" in str(caught.value)
    assert "exactly the largest value 0.8 g" in str(caught.value)


@pytest.mark.parametrize("rows", [np.repeat(CUBE, 4, axis=0), np.round(500 * FIXTURE), np.repeat(FIXTURE, 3, axis=0)])
def test_the_equal_values_of_a_fixture_are_not_called_clipped(rows):
    assert len(find_attitudes(recording(rows, unit="count"))) == len(np.unique(rows, axis=0))


def test_deviations_may_be_named_by_their_axis_alone():
    long = with_std(recording(DIRECTIONS), ["g"] * 3, [1e-3, 2e-3, 3e-3])
    columns = {name.replace("std_accel_", "std_"): values for name, values in long.columns.items()}
    units = {name.replace("std_accel_", "std_"): unit for name, unit in long.units.items()}
    short = Recording(columns, units, name="short.csv")
    np.testing.assert_array_equal(find_attitudes(short).covariance, find_attitudes(long).covariance)


@pytest.mark.parametrize("option", ["settling", "shortest"])
def test_times_beyond_any_recording_find_nothing(option):
    samples, time, _ = tumble(DIRECTIONS[:4])
    with pytest.raises(SegmentError, match="no static attitude found"):
        find_attitudes(recording(samples, time), **{option: 1e30})


def test_a_recording_that_takes_no_time_is_too_short():
    samples, time, _ = tumble(DIRECTIONS[:4])
    with pytest.raises(SegmentError, match="are too few to find static attitudes"):
        find_attitudes(recording(samples, 1e-25 * time))

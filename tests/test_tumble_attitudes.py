"""Recordings to static attitudes: where they are, what they are, how well they are known, and what is refused."""

import dataclasses
import re
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy.signal import butter, lfilter, sosfilt
from scipy.stats import chi2

import imulab as il
from conftest import some_of
from imulab.cli import main
from imulab.display import Note
from imulab.errors import DataError, ImulabError, SegmentError, UnitError
from imulab.procedures.tumble import _segment
from imulab.procedures.tumble import attitudes as held
from imulab.procedures.tumble import attitudes as segment
from imulab.procedures.tumble.attitudes import find_attitudes
from imulab.procedures.tumble.model import length_noise, norm_and_jacobian
from imulab.recording import Recording, on_disk
from reference import segment as reference_loops
from reference import tumble as reference
from reference.tumble import random_attitudes

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


@pytest.mark.parametrize(
    ("rate", "hold", "noted"),
    [(6.0, 60.0, []), (4.0, 60.0, []), (4.0, 1000.0, [True]), (0.4, 60.0, [False])],
    ids=["usual", "over in a second if it is in ms", "slow", "too slow"],
)
def test_the_unit_of_time_is_doubted_by_the_rule_of_every_log(rate, hold, noted):
    samples, time, _ = tumble(DIRECTIONS, rate=rate, hold=hold, move=8.0)
    notes = find_attitudes(recording(samples, time), window=5.0).notes
    assert [isinstance(line, Note) for line in notes if "unit of time" in line] == noted


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
    with pytest.raises(SegmentError, match="1 sample over"):
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
    bad.columns[column][3000 : 3005 if np.isnan(value) else 3001] = value
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
    expected = reference_loops.blocks(samples, time, length)
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
    expected = reference_loops.window_variance(mean, scatter, broken, width)
    np.testing.assert_allclose(variance, expected, rtol=1e-12)
    for limit in np.quantile(variance, [0.0, 0.1, 0.3, 0.5, 0.7, 0.95], method="lower"):
        for trim, fewest in ((0, 1), (0, 5), (2, 2), (3, 10)):
            start, stop = np.empty((2, len(variance)), dtype=np.int64)
            count = _segment.stretches(variance, limit, width, trim, fewest, start, stop)
            found = list(zip(start[:count].tolist(), stop[:count].tolist(), strict=True))
            assert found == reference_loops.stretches(variance, limit, width, trim, fewest)


@pytest.mark.parametrize("same", [0.0, 2e-3, 0.3, 1.0, 3.0])
def test_attitudes_of_stretches_are_those_of_the_plain_form(same):
    mean, _, _ = walk(7)
    found = [(k, k + 7 + k % 3) for k in range(0, 380, 11)]
    start, stop = np.array(found).T.astype(np.int64).copy()
    attitude, means = np.empty(len(found), dtype=np.int64), np.empty((len(found), 3))
    count = _segment.attitudes(mean, start, stop, same, attitude, means)
    expected = reference_loops.attitudes(mean, found, same)
    assert attitude.tolist() == expected[0]
    np.testing.assert_allclose(means[:count], expected[1], rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("seed", some_of(2, range(5)))
@pytest.mark.parametrize("count", [11, 24, 200])
def test_the_error_of_the_ellipsoid_is_that_of_leaving_each_attitude_out(seed, count):
    rng = np.random.default_rng(seed)
    points = random_attitudes(rng, count) * [1.1, 0.9, 1.0] + [0.3, -0.2, 0.1] + 1e-3 * rng.standard_normal((count, 3))
    assert _segment.ellipsoid_error(points) == pytest.approx(reference_loops.ellipsoid_error(points), rel=1e-9)


def test_points_that_determine_no_ellipsoid_have_no_error():
    circle = np.column_stack([np.cos(np.arange(20)), np.sin(np.arange(20)), np.zeros(20)])
    for points in (random_attitudes(np.random.default_rng(1), 10), circle, np.ones((20, 3)), np.empty((0, 3))):
        assert _segment.ellipsoid_error(np.ascontiguousarray(points)) == np.inf


@pytest.mark.parametrize("moved", [0.0, np.radians(0.5)])
def test_the_attitudes_of_a_recording_are_the_best_of_the_plain_sweep(moved):
    samples, time, _, _ = disturbed(moved)
    found = find_attitudes(recording(samples, time))
    mean, scatter, longest = reference_loops.blocks(samples, time, 10)
    variance = reference_loops.window_variance(mean, scatter, longest > 0.25, 10)
    quiet = np.quantile(variance, 0.05)
    sweep = {}
    for factor in np.geomspace(1.5, 400.0, 18):
        pieces = reference_loops.stretches(variance, factor * quiet, 10, 3, 10)
        number, means = reference_loops.attitudes(mean, pieces, 2e-3)
        sweep.setdefault(tuple(pieces), (reference_loops.ellipsoid_error(means), number, len(means), factor))
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
    first, moments, counts, scatters = reference_loops.batches(mean, found, number, centre, size)
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
    mean = reference_loops.blocks(samples, np.arange(60.0 * length), length)[0]
    start, stop = np.array(found).T.astype(np.int64).copy()
    sums = np.empty((3, 3, 3, 3))
    _segment.motion(*np.ascontiguousarray(samples.T), length, mean, start, stop, np.array(number), centre, *sums)
    np.testing.assert_allclose(
        sums, reference_loops.motion(samples, length, found, number, centre), rtol=1e-11, atol=1e-11
    )


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


G_HOLD, RATE = 9.81362, 100.0


TRUTH = {
    "bias_x": 0.02 * G_HOLD, "bias_y": -0.03 * G_HOLD, "bias_z": 0.01 * G_HOLD,
    "scale_factor_x": 1.01, "scale_factor_y": 0.99, "scale_factor_z": 1.005,
    "misalignment_yx": 0.01, "misalignment_zx": -0.008, "misalignment_zy": 0.006,
}  # fmt: skip


MG = 1e-3 * G_HOLD


def forward(force):
    """Outputs of a specific force (n, 3): S (T f + b)."""
    b, s, (yx, zx, zy) = np.array(list(TRUTH.values())).reshape(3, 3)
    return s * (force @ np.array([[1, 0, 0], [yx, 1, 0], [zx, zy, 1]]).T + b)


def turned(vectors, angles):
    """Vectors (n, 3) turned by rotation vectors (n, 3), by Rodrigues's formula."""
    size = np.linalg.norm(angles, axis=1, keepdims=True)
    axis = angles / np.maximum(size, 1e-300)
    along = axis * (axis * vectors).sum(axis=1, keepdims=True)
    return along + np.cos(size) * (vectors - along) + np.sin(size) * np.cross(axis, vectors)


def slow_noise(rng, count, cutoff):
    """Noise of unit variance below a frequency, (count, 3)."""
    filtered = butter(2, cutoff / (RATE / 2), output="sos")
    unit = np.sqrt((sosfilt(filtered, np.eye(1, 5000)[0]) ** 2).sum())
    return sosfilt(filtered, rng.standard_normal((count + 2000, 3)), axis=0)[2000:] / unit


def held_hold(seed, sway=0.0, tremor=0.0, tilt=0.0, noise=0.3 * MG, hold=6.0, count=24):
    """Recording of a unit that is held in `count` directions; sway in rad rms per axis, tremor at 8 Hz in m/s^2."""
    rng = np.random.default_rng(seed)
    directions = reference.random_attitudes(rng, count)
    resting, moving = round(hold * RATE), round(1.5 * RATE)
    time = np.arange(resting) / RATE
    s = (1 - np.cos(np.pi * (np.arange(moving) + 0.5) / moving)) / 2
    parts = []
    for k, up in enumerate(directions):
        wave = np.cos(2 * np.pi * 8.0 * time[:, None] + rng.uniform(0, 2 * np.pi, 3))
        angles = sway * slow_noise(rng, resting, 0.5) + tilt * wave[:, [1, 2, 0]]
        parts.append(G_HOLD * turned(np.tile(up, (resting, 1)), angles) + tremor * wave)
        there = directions[(k + 1) % count]
        angle = np.arccos(up @ there)
        path = (np.sin((1 - s) * angle)[:, None] * up + np.sin(s * angle)[:, None] * there) / np.sin(angle)
        parts.append(G_HOLD * path + 0.6 * np.sin(2 * np.pi * np.outer(s, [1.3, 2.9, 6.1])))
    outputs = forward(np.vstack(parts))
    outputs = outputs + noise * rng.standard_normal(outputs.shape)
    columns = {"time": np.arange(len(outputs)) / RATE}
    columns |= {f"accel_{axis}": outputs[:, i].copy() for i, axis in enumerate("xyz")}
    return Recording(columns, dict.fromkeys(columns, "m/s^2") | {"time": "s"}, name="hand.csv")


def fitted(attitudes, **options):
    return il.fit_tumble(attitudes, **{"order": 1, "gravity": G_HOLD, **options}).calibration


def errors(record):
    """Errors of the parameters and their standard uncertainties."""
    found = [(record.parameters[name], value) for name, value in TRUTH.items()]
    return np.array([p.value - value for p, value in found]), np.array([p.standard_uncertainty for p, _ in found])


def noise_of_attitudes(record):
    """Median of the stated standard uncertainties of |f|, in g."""
    return np.median(record.data["attitudes"]["standard_uncertainty"]) / G_HOLD


@pytest.mark.parametrize(("degrees", "bias"), [(0.3, 3e-6), (0.5, 5e-6), (1.0, 8e-6)])
def test_sway_of_a_hand_neither_shortens_gravity_nor_hides_what_is_known(degrees, bias, reduced):
    trials = 6 if reduced else 16
    found, stated, noise, off = [], [], [], []
    for seed in range(trials):
        record = fitted(il.find_attitudes(held_hold(seed, sway=np.radians(degrees))))
        error, u = errors(record)
        found.append(error)
        stated.append(u)
        noise.append(noise_of_attitudes(record) / (0.3e-3 / np.sqrt(np.median(record.data["attitudes"]["samples"]))))
        off.append(error[3:6] @ np.ones(3) / 3)
    assert abs(np.mean(off)) < bias + 3 * np.std(off) / np.sqrt(len(off))
    scores = np.array(found) / np.array(stated)
    assert 0.8 < np.sqrt(np.mean(scores**2)) < 1.2  # the uncertainty is that of the true scatter
    assert np.mean(noise) < (1.6 if degrees == 1.0 else 1.2)  # in units of the sensor's own noise; it was 20 to 50


def test_a_unit_at_rest_keeps_its_noise(reduced):
    trials = 5 if reduced else 12
    at_rest, moving = [], []
    for seed in range(trials):
        attitudes = il.find_attitudes(held_hold(seed))
        moving.append(noise_of_attitudes(fitted(attitudes)))
        at_rest.append(noise_of_attitudes(fitted(dataclasses.replace(attitudes, motion=None))))
    assert np.mean(moving) == pytest.approx(np.mean(at_rest), rel=0.01)
    assert np.mean(moving) == pytest.approx(0.3e-3 / np.sqrt(530), rel=0.05)


def test_shaking_is_not_taken_for_gravity(reduced):
    """Block by block the magnitude of f is taken, sample by sample it would be 200 ug too long."""
    trials = 4 if reduced else 8
    off = [errors(fitted(il.find_attitudes(held_hold(seed, tremor=20 * MG))))[0][3:6].mean() for seed in range(trials)]
    assert abs(np.mean(off)) < 8e-6 + 3 * np.std(off) / np.sqrt(len(off))


@pytest.mark.parametrize(("tilt", "shortened"), [(0.0, 0), (0.02, 200), (0.05, 1250)])
def test_a_hand_that_trembles_is_told_so(tilt, shortened):
    """8 Hz is too fast for blocks of an eighth of a second: what it may do is said, two axes of tilt^2 / 4 each."""
    record = fitted(il.find_attitudes(held_hold(2, tilt=tilt)))
    said = [warning for warning in record.warnings if "the unit shakes" in warning]
    assert len(said) == (tilt > 0)
    if said:
        most = float(said[0].split("up to ")[1].split(" ppm")[0])
        assert 0.8 * shortened < most < 1.2 * shortened
        assert -1e6 * errors(record)[0][3:6].mean() < 1.2 * shortened


@pytest.mark.parametrize("options", [{"method": "linearised"}, {"loss": "huber"}, {"monte_carlo": 2000}])
def test_every_estimator_averages_magnitudes(options):
    attitudes = il.find_attitudes(held_hold(3, sway=np.radians(0.5)))
    record, usual = fitted(attitudes, **options), fitted(attitudes)
    error, u = errors(record)
    assert np.all(np.abs(error[3:6]) < 4 * u[3:6])  # biases of this size are beyond the linearised method
    np.testing.assert_allclose(u, errors(usual)[1], rtol=0.5)
    if "monte_carlo" in options:
        spread = [record.fit["monte_carlo"]["parameters"][name]["standard_deviation"] for name in TRUTH]
        np.testing.assert_allclose(spread, u, rtol=0.1)


def test_moments_are_the_variance_of_the_mean_of_squares():
    """Against the squares themselves, formed block by block."""
    rng = np.random.default_rng(4)
    theta = np.array([[0.02, -0.03, 0.01, 1.02, 0.97, 1.01, 0.01, -0.02, 0.005]])
    up = reference.random_attitudes(rng, 5)
    blocks = np.einsum("nij,nkj->nki", 0.01 * rng.standard_normal((5, 3, 3)), rng.standard_normal((5, 12, 3)))
    x, y, z = np.moveaxis(blocks, 2, 0)
    rows = np.stack([x, y, z, x * x, y * y, z * z, x * y, x * z, y * z], axis=2)
    moments = np.array([np.cov(each.T) / 12 for each in rows])
    norm, jacobian, _, _ = norm_and_jacobian(theta, up[None], 1)
    motion = il.find_attitudes(held_hold(0, count=12)).motion
    motion = msgspec.structs.replace(motion[np.arange(5)], moments=moments, freedom=np.full(5, 1e12))
    _, variance = length_noise(theta, jacobian, np.zeros((1, 5, 3, 3)), motion)
    inverse = [[reference.inverse(each, named(theta[0]), 1) for each in up[i] + blocks[i]] for i in range(5)]
    # To first order in |f| - 1: the linear part holds 1 / |f|, half the square does not.
    expected = [np.var(np.square(f).sum(axis=1) / 2, ddof=1) / 12 for f in inverse]
    np.testing.assert_allclose(variance[0], expected, rtol=4 * np.abs(norm - 1).max())


def named(theta):
    """A scaled parameter vector as the reference's parameters."""
    scale = theta[3:6]
    return dict(zip(TRUTH, [*(theta[:3] / scale), *scale, *theta[6:9]], strict=True))


def test_a_scatter_below_the_stated_noise_is_said():
    rng = np.random.default_rng(2)
    outputs = forward(G_HOLD * reference.random_attitudes(rng, 24))
    outputs += 1e-4 * rng.standard_normal(outputs.shape)
    columns = {f"accel_{axis}": outputs[:, i].copy() for i, axis in enumerate("xyz")}
    for std, said in ((1e-4, False), (1e-3, True)):
        stated = {f"std_accel_{axis}": np.full(24, std) for axis in "xyz"}
        table = Recording(columns | stated, dict.fromkeys(columns | stated, "m/s^2"), name="table.csv")
        warnings = fitted(il.find_attitudes(table)).warnings
        assert any("scatter less than their own noise" in each for each in warnings) == said


def test_shaking_that_makes_the_noise_look_too_large_is_not_blamed_on_columns_that_are_not_there():
    recording = il.simulate_tumble(order=1, seed=4, attitudes=16, hold=4.0)
    shaking = 0.3 * np.sin(2 * np.pi * 1.75 * recording.time)
    shaken = recording.with_columns({f"accel_{a}": recording.column(f"accel_{a}") + shaking for a in "xyz"}, {})
    found = il.fit_tumble(shaken, order=1, gravity=G_HOLD).calibration
    assert any("scatter less than their own noise" in each for each in found.warnings)
    assert any("something firm" in each for each in found.verdict.next)
    assert not any("std_" in each for each in found.verdict.next)


def test_samples_without_a_time_are_no_table_of_attitudes(imulab, tmp_path):
    """The next command that the refusal names leads to the fit of the recording with its time."""
    recording = il.simulate_tumble(gravity=9.81, attitudes=16, gyro=False)
    columns = {name: values for name, values in recording.columns.items() if name.startswith("accel_")}
    il.write_csv(Recording(columns, recording.units, name="r"), tmp_path / "r.csv")
    fit = ("tumble", "fit", "r.csv", "--gravity", "9.81", "--order", "1", "-o", "r.json")
    done = imulab(*fit)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert f"{len(recording)} rows without a time that go over into each other: samples of a recording" in done.stderr
    guess = "layout guess r.csv --sample-rate 100Hz -o L.toml"
    assert guess in done.stderr
    assert imulab(*guess.split()).returncode == 0
    assert imulab(*fit, "--layout", "L.toml").returncode == 0
    il.write_csv(recording, tmp_path / "r.csv")
    known = il.fit_tumble(tmp_path / "r.csv", gravity=9.81, order=1).calibration
    assert il.load(tmp_path / "r.json").value("bias_x") == pytest.approx(known.value("bias_x"), rel=1e-9)


@pytest.mark.parametrize(
    ("rows", "each", "doubted"), [(400, 1, False), (400, 5, False), (300, 75, True), (1500, 1, True)]
)
def test_tables_of_many_attitudes_are_taken_and_those_like_samples_doubted(rows, each, doubted):
    rng = np.random.default_rng(3)
    up = rng.standard_normal((rows // each, 3))
    up = np.repeat(9.81 * up / np.linalg.norm(up, axis=1, keepdims=True), each, axis=0)
    attitudes = il.find_attitudes(up + 0.01 * rng.standard_normal(up.shape), unit="m/s^2")
    assert len(attitudes) == rows
    assert any("no time column" in note for note in attitudes.notes) == doubted


def test_a_large_file_gives_the_record_of_a_small_one_without_its_columns_in_memory(tmp_path, monkeypatch):
    file, records = tmp_path / "log.csv", [tmp_path / "small.json", tmp_path / "large.json"]
    il.write_csv(il.simulate_tumble(order=1, attitudes=24, gravity=9.81), file)
    assert main(["tumble", "fit", str(file), "--gravity", "9.81", "-o", str(records[0])]) == 0
    monkeypatch.setattr("imulab.recording.LARGE", 0)
    mapped = []

    def watched(recording, **how):
        mapped.extend(isinstance(values.base, np.memmap) for values in recording.columns.values())
        return find_attitudes(recording, **how)

    monkeypatch.setattr(held, "find_attitudes", watched)
    assert main(["tumble", "fit", str(file), "--gravity", "9.81", "-o", str(records[1])]) == 0
    small, large = map(il.Calibration.load, records)
    assert mapped
    assert all(mapped)
    assert large.parameters == small.parameters
    assert (large.sources, large.warnings) == (small.sources, small.warnings)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux tells what a process has in memory")
def test_memory_of_a_column_on_disk_is_given_back_when_another_is_asked_for():
    def mapped():
        status = Path("/proc/self/status").read_text()
        return 1024 * int(status.partition("RssFile:")[2].split()[0])

    n = 1 << 19
    block = Recording({"time": np.arange(n, dtype=np.float64), "gyro_x": np.ones(n)}, {"time": "s", "gyro_x": "deg/s"})
    recording = on_disk(iter([block]))
    before = mapped()
    assert recording.column("time").sum() == n * (n - 1) / 2
    assert mapped() - before > 7 * n
    assert recording.si("gyro_x").sum() == pytest.approx(np.radians(n))
    assert mapped() - before < 7 * n


@pytest.mark.parametrize(("seconds", "kind"), [(40.0, "look"), (3.0, "good")])
def test_a_gap_is_said_and_asks_to_look_where_it_is_long(seconds, kind):
    recording = il.simulate_tumble(attitudes=24, seed=1)
    time = recording.si("time")
    kept = (time < 20.0) | (time >= 20.0 + seconds)
    cut = replace(recording, columns={name: column[kept] for name, column in recording.columns.items()})
    record = il.fit_tumble(cut, gravity=9.80665).calibration
    text = f"1 gap in time, the longest {seconds + 0.01:.3g} s after row 2000: an attitude within it is lost"
    assert [line for line in record.warnings if "gap" in line] == [text]
    assert record.verdict.state == kind
    assert not any("gap" in line for line in il.fit_tumble(recording, gravity=9.80665).calibration.warnings)

"""The time of samples from the stamps of a device: wraps, gaps, wild stamps, other rates, clocks that are set."""

from __future__ import annotations

import numpy as np
import pytest

from imulab.live.formats import LineStream
from imulab.live.session import Watch
from imulab.live.stamps import Counts
from imulab.recording import Recording


def stamped(
    stamps: np.ndarray | list[float], unit: str = "ms", sizes: int | list[int] = 5, sent: int = 1
) -> tuple[LineStream, Recording]:
    """Samples whose accel_z is their number, each sent so many times, with these stamps, in pieces of so many."""
    stream = LineStream("device")
    rows = [f"{stamp:.10g},1,0,{k // sent}\n" for k, stamp in enumerate(stamps)]
    ends = np.cumsum(sizes) if isinstance(sizes, list) else np.arange(sizes, len(rows) + sizes, sizes)
    pieces = ["".join(rows[a:b]).encode() for a, b in zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True)]
    pieces[0] = f"time [{unit}],accel_x [g],accel_y [g],accel_z [g]\n".encode() + pieces[0]
    blocks = [block for k, piece in enumerate(pieces) for block in stream.feed(piece, 0.05 * k)]
    blocks += stream.finish()
    columns = {name: np.concatenate([block.columns[name] for block in blocks]) for name in ("time", "accel_z")}
    return stream, Recording(columns, {name: blocks[0].units[name] for name in columns})


def test_stamps_that_wrap_around_repeat_or_come_late():
    stamps = (2**32 - 1_000_000 + 5000 * np.arange(600)) % 2**32
    order = list(range(600))
    order[300:302] = [301, 300]  # reordered
    order.insert(400, 400)  # repeated
    del order[500:503]  # lost
    stream, found = stamped(stamps[order], "us", 1)
    assert np.diff(found.columns["time"]).min() > 0
    assert found.columns["time"][-1] - found.columns["time"][0] == 599 * 5000
    counts = stream.counts
    assert (counts.repeated, counts.reordered, counts.lost, counts.restarts) == (1, 1, 4, 0)


def test_a_device_that_starts_again_goes_on_in_time():
    stream, found = stamped(10_000.0 * (np.arange(600) % 300), "us", 1)
    assert len(found) == 600
    assert np.diff(found.columns["time"]).min() > 0
    assert stream.counts.restarts == 1


@pytest.mark.parametrize("wild", [7_217_000, 3_499, 0, 95_000, 4_294_967_000])
@pytest.mark.parametrize("at", [0, 299, 304, 455])  # the first of all, and each place in a piece
def test_one_wild_stamp_costs_its_sample_and_no_other(wild, at):
    stamps = [100_000.0 + 10 * k for k in range(600)]
    stamps[at] = wild
    stream, found = stamped(stamps)
    kept = np.delete(np.arange(600), at)
    np.testing.assert_array_equal(found.columns["accel_z"], kept)
    np.testing.assert_array_equal(found.columns["time"], 100_000 + 10 * kept)
    counts = stream.counts
    assert (counts.stray, counts.restarts, counts.lost) == (1, 0, int(at > 0))


@pytest.mark.parametrize("length", [2**16, 2**32])
def test_counters_of_milliseconds_wrap_around(length):
    stream, found = stamped([(length - 3000 + 10.0 * k) % length for k in range(600)])
    np.testing.assert_array_equal(np.diff(found.columns["time"]), 10)
    assert vars(stream.counts) == vars(Counts())


def test_a_gap_is_believed_and_a_clock_that_was_set_is_no_gap():
    gap = [10.0 * k + 5_000 * (k >= 303) for k in range(600)]
    stream, found = stamped(gap)
    np.testing.assert_array_equal(found.columns["time"], gap)
    assert (stream.counts.gaps, stream.counts.lost, stream.counts.restarts) == (1, 500, 0)
    stream, found = stamped([10.0 * k + 7e9 * (k >= 303) for k in range(600)])
    assert len(found) == 600
    assert np.ptp(found.columns["time"]) == 5990 - 10 + 1000
    assert (stream.counts.restarts, stream.counts.stray) == (1, 0)


def test_a_sample_that_is_sent_twice_is_counted_once():
    stream, found = stamped([10.0 * (k // 2) for k in range(600)], sent=2)
    np.testing.assert_array_equal(found.columns["accel_z"], np.arange(300))
    assert vars(stream.counts) == vars(Counts(repeated=300))


@pytest.mark.parametrize("sizes", [1, 7, 64])
@pytest.mark.parametrize(
    ("rate", "unit", "tick"), [(200.0, "ms", 10.0), (1600.0, "ms", 1.0), (50.0, "s", 1.0), (100.0, "s", 0.02)]
)
def test_samples_that_share_stamps_are_all_kept_and_lie_evenly(rate, unit, tick, sizes):
    """By the number of samples, which the stamps themselves do not show."""
    ticks = rate * tick * {"ms": 1e-3, "s": 1.0}[unit]
    count = int(max(20 * ticks, 4 * rate))
    stamps = tick * np.floor(np.arange(count) / ticks + 1e-9) + (2**32 - 5000 if unit == "ms" else 0)
    stamps = stamps % 2**32 if unit == "ms" else stamps
    stream, found = stamped(stamps, unit, sizes)
    kept = found.columns["accel_z"].astype(int)
    np.testing.assert_array_equal(kept, np.arange(len(kept)))
    assert len(kept) > count - 2 * ticks - 2
    time = found.si("time") - found.si("time")[0]
    assert (np.diff(time) > 0).all()
    seconds = tick * {"ms": 1e-3, "s": 1.0}[unit]
    assert np.abs(time - kept / rate).max() < seconds
    assert time[-1] == pytest.approx(kept[-1] / rate, abs=0.25 * seconds)
    assert vars(stream.counts) == vars(Counts())


def test_an_interruption_under_shared_stamps_loses_nothing():
    stream = LineStream("device")
    rows = [f"{10 * (k // 2) + (30_000 if k >= 2000 else 0)},1,0,{k}\n".encode() for k in range(4000)]
    stream.feed(b"time [ms],accel_x [g],accel_y [g],accel_z [g]\n" + b"".join(rows[:2000]), 0.0)
    blocks = stream.feed(b"", 3.0)
    stream.cut()
    blocks += stream.feed(b"".join(rows[2000:]), 40.0)
    kept = np.concatenate([block.columns["accel_z"] for block in blocks])
    assert (kept[0], kept[-1], len(kept)) == (0, 3997, 3996)
    assert (stream.counts.lost, stream.counts.gaps) == (0, 0)


def test_samples_lost_under_shared_stamps_are_a_gap():
    number = np.delete(np.arange(4000), slice(2000, 2400))
    stream, found = stamped(10.0 * (number // 2))
    assert np.diff(found.columns["time"]).max() == pytest.approx(5 * 401, abs=10)
    assert (stream.counts.gaps, stream.counts.lost) == (1, pytest.approx(400, abs=2))


def test_another_rate_is_no_loss():
    stamps = np.cumsum([10.0] * 300 + [25.0] * 300)
    stream, found = stamped(stamps.tolist())
    np.testing.assert_array_equal(found.columns["time"], stamps)
    assert stream.counts.lost <= 10  # those of the piece in which it changes


def test_stamps_of_bursts_lose_nothing():
    """A driver that stamps at arrival: sixteen samples within a millisecond, then nothing for 160 ms."""
    stamps = [160.0 * (k // 16) + 0.0625 * (k % 16) for k in range(1600)]
    stream, found = stamped(stamps, sizes=1)
    np.testing.assert_array_equal(found.columns["time"], stamps)
    assert stream.counts.stray == stream.counts.restarts == 0


@pytest.mark.parametrize("size", [1, 5])
@pytest.mark.parametrize("rate", [1.0, 3.3, 7.0])
def test_a_rate_that_slows_for_good_loses_nothing(rate, size):
    """From 100 Hz to 1 Hz the steps grow beyond any gap that one next stamp bears out."""
    stamps = np.cumsum([10] * 200 + [round(1000 / rate)] * 100)
    stream, found = stamped(stamps, sizes=size)
    np.testing.assert_array_equal(found.columns["accel_z"], np.arange(300))
    np.testing.assert_array_equal(found.columns["time"], stamps)
    assert vars(stream.counts) == vars(Counts())


@pytest.mark.parametrize("size", [1, 5])
@pytest.mark.parametrize("step", [100_000, 500_000, 1_000_000])  # microseconds
def test_a_counter_of_24_bits_wraps_around_at_slow_rates(step, size):
    stream, found = stamped((100_000 + step * np.arange(500)) % 2**24, "us", size)
    np.testing.assert_array_equal(found.columns["time"], 100_000 + step * np.arange(500))
    assert vars(stream.counts) == vars(Counts())


@pytest.mark.parametrize("off", [-9, -3, 4, 8])  # steps
def test_a_stamp_some_steps_off_at_a_slow_rate_is_no_restart(off):
    stamps = 1000.0 * np.arange(100, 400)
    stamps[150] += 1000 * off
    stream, found = stamped(stamps, sizes=1)
    np.testing.assert_array_equal(found.columns["time"], 1000.0 * np.delete(np.arange(100, 400), 150))
    assert (stream.counts.stray, stream.counts.restarts, stream.counts.lost) == (1, 0, 1)


def test_a_wild_first_stamp_is_left_out_of_pieces_of_one():
    stream, found = stamped([3.0, *(100_000.0 + 10 * np.arange(300))], sizes=1)
    np.testing.assert_array_equal(found.columns["time"], 100_000 + 10 * np.arange(300))
    assert vars(stream.counts) == vars(Counts(stray=1))


COUNTERS = {"ms": (2**16, 2**32), "us": (2**24, 2**32)}
LENGTH = {"ms": 1e-3, "us": 1e-6}
APART = 60
"""So many samples at least lie between one event and another."""


def random_stream(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, str]:
    """Stamps, the true time in ticks, which are wild, how many are lost, and the unit; 1 Hz to 2 kHz (ms: 200 Hz)."""
    unit = str(rng.choice(list(COUNTERS)))
    wrap = int(rng.choice(COUNTERS[unit]))
    slowest, fastest = 1 / LENGTH[unit], {"ms": 5, "us": 500}[unit]
    steps = np.repeat(np.exp(rng.uniform(np.log(fastest), np.log(slowest), 3)), rng.integers(200, 400, 3))
    steps = np.round(steps * rng.uniform(0.95, 1.05, len(steps)))
    changes = np.flatnonzero(np.abs(np.diff(np.log(steps))) > 0.11) + 1
    places = np.arange(APART, len(steps) - APART, APART) + rng.integers(0, 3)
    near = np.abs(places[:, None] - changes).min(axis=1, initial=len(steps))
    free = rng.permutation(places[near >= APART])
    lost, (gaps, wild) = 0, np.split(free[:6], [3])
    for k in gaps.tolist():
        missing = int(min(np.exp(rng.uniform(0, 7)), 0.2 * wrap / steps[k], 300 / LENGTH[unit] / steps[k]))
        steps[k] *= missing + 1
        lost += missing
    true = np.cumsum(steps)
    for _ in range(1000):
        begin = int(rng.integers(wrap)) if rng.random() < 0.5 else int(wrap - rng.uniform(0, 1) * true[-1]) % wrap
        stamps = (true + begin) % wrap
        wraps = np.flatnonzero(np.diff(stamps) < 0) + 1
        events = np.concatenate([changes, free[:6], [0, len(true)]])
        if not len(wraps) or np.abs(wraps[:, None] - events).min() >= 8:
            break
    else:
        return random_stream(rng)
    off = rng.uniform(4, np.minimum(100, 0.5 * wrap / steps[wild])) * steps[wild] * rng.choice([-1, 1], len(wild))
    far = stamps[wild] + wrap * rng.uniform(0.2, 0.8, len(wild))
    stamps[wild] = np.round(np.where(rng.random(len(wild)) < 0.5, far, stamps[wild] + off)) % wrap
    return stamps, true, wild, lost, unit


@pytest.mark.slow
def test_random_streams_keep_their_time(reduced):
    """Other rates, gaps, wraps and wild stamps against the true time, in pieces of 1 ms or 20 ms."""
    for seed in range(20 if reduced else 500):
        rng = np.random.default_rng(seed)
        stamps, true, wild, lost, unit = random_stream(rng)
        arrived = np.floor(true * LENGTH[unit] / rng.choice([1e-3, 0.02]))
        stream, found = stamped(stamps, unit, np.unique(arrived, return_counts=True)[1].tolist())
        number = found.columns["accel_z"].astype(int)
        np.testing.assert_array_equal(number, np.delete(np.arange(len(true)), wild), err_msg=f"{seed}")
        np.testing.assert_array_equal(np.diff(found.columns["time"]), np.diff(true[number]), err_msg=f"{seed}")
        counts = stream.counts
        assert (counts.stray + counts.reordered, counts.repeated, counts.restarts) == (len(wild), 0, 0), seed
        assert counts.lost == pytest.approx(lost + len(wild), rel=0.15, abs=3), seed


def test_wild_stamps_are_said_once_and_again_when_they_are_many():
    watch, counts = Watch(), Counts(stray=1)
    assert [text[:50] for text in watch.counts(counts, 10)] == ["a sample whose time fits neither those before nor "]
    counts.stray = 9
    assert watch.counts(counts, 1000) == []
    counts.stray = 20
    (said,) = watch.counts(counts, 1000)
    assert said.startswith("20 of 1020 samples have a time that fits neither those before nor those after")
    assert watch.counts(Counts(stray=500), 1000) == []
    assert len(Watch().counts(Counts(stray=600), 2)) == 2  # few came through: all the more reason to say so

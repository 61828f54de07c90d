"""The rule of the clock: mean rate, jitter, gaps, coarse and repeated stamps, by times made with a known truth."""

import json
from itertools import pairwise

import numpy as np
import pytest

import imulab as il
from imulab.cli.show import recording_json
from imulab.errors import DataError
from imulab.estimation import clock
from imulab.estimation.clock import read_clock, same_rows
from imulab.estimation.column_noise import analyse
from imulab.estimation.sampling import mend_blocks, mend_stamps, sampling_rate
from imulab.recording import Recording

N = 30_000
NUMBER = np.arange(N)


def noise(count, seed=1):
    return np.random.default_rng(seed).standard_normal(count)


def log(time, values=None, unit="s", name="r.csv"):
    values = noise(len(time)) if values is None else values
    columns = {"time": np.asarray(time, dtype=float)} | {f"gyro_{axis}": values + k for k, axis in enumerate("xyz")}
    return Recording(columns, {"time": unit} | {f"gyro_{axis}": "deg/s" for axis in "xyz"}, name=name, lines_before=1)


def lose(keep, rate):
    return NUMBER[keep] / rate


@pytest.mark.parametrize("far", [0.01, 1.4, 1.6, 40.0, np.nan, -3.0])
@pytest.mark.parametrize("place", [99, 100, 101, 250])
def test_a_clock_is_read_part_by_part_as_at_once(far, place, monkeypatch):
    time = 0.01 * (NUMBER[:300] + 0.1 * noise(300))
    time[place:] = time[place - 1] + 0.01 * (far + NUMBER[: 300 - place])
    expected = read_clock(time)
    monkeypatch.setattr(clock, "_AT_ONCE", 100)
    found = read_clock(time)
    assert found.doubt == expected.doubt
    assert [found.rate, found.jitter, found.widest] == pytest.approx(
        [expected.rate, expected.jitter, expected.widest], rel=1e-12, nan_ok=True
    )
    np.testing.assert_array_equal(found.gaps, expected.gaps)


@pytest.mark.parametrize("jitter", [0.02, 0.1, 0.2])
def test_late_stamps_are_no_gaps_and_the_rate_is_samples_over_time(jitter):
    time = np.sort(NUMBER / 100.06 + noise(N) * jitter / 100.06)
    clock = read_clock(time)
    assert clock.rate == pytest.approx((N - 1) / (time[-1] - time[0]), rel=1e-12)
    assert len(clock.gaps) == 0
    assert clock.jitter == pytest.approx(np.sqrt(2) * jitter / 100.06, rel=0.02)
    rate, notes = sampling_rate(log(time))
    assert (rate, notes) == (clock.rate, [])


def test_a_stall_whose_readings_follow_at_once_is_no_gap():
    late = np.zeros(N)
    for start in range(500, N - 100, 1000):
        late[start : start + 20] = (20 - np.arange(20)) / 200 * 0.999
    clock = read_clock(NUMBER / 200 + late)
    assert (len(clock.gaps), clock.rate) == (0, pytest.approx(200, rel=1e-9))


@pytest.mark.parametrize("jitter", [0, 0.1, 0.2])
def test_lost_samples_are_gaps_and_leave_the_rate_as_it_is(jitter):
    keep = np.random.default_rng(2).random(N) > 0.01
    time = lose(keep, 100) + noise(keep.sum()) * jitter / 100
    clock = read_clock(np.sort(time))
    assert clock.rate == pytest.approx(100, rel=1e-3 if jitter else 1e-9)
    lost = int(np.count_nonzero(~keep[np.argmax(keep) : N - np.argmax(keep[::-1])]))
    assert clock.missing.sum() == pytest.approx(lost, rel=0.03 if jitter else 0)


@pytest.mark.parametrize(
    ("time", "rate"),
    [
        (np.floor(NUMBER / 1.6) / 1e3, 1600),
        (np.floor(NUMBER / 0.85) / 1e3, 850),
        (np.round(NUMBER / 0.7) / 1e3, 700),
        (np.round(NUMBER / 200 + 12, 2), 200),
        (np.round(NUMBER / 190 + 12, 2), 190),
        (np.floor(NUMBER / 102.4 + 0.3), 102.4),
        (np.floor(NUMBER / 50), 50),
        (np.floor(NUMBER * 1.2 + 1e-6) / 1e3, 1000 / 1.2),
        (np.floor(NUMBER / 100 / 0.02) * 0.02, 100),
        (np.repeat(NUMBER[: N // 2] / 100, 2), 200),
        (np.floor(NUMBER / 100 / 0.015625) * 0.015625, 100),
        (np.floor(NUMBER[:1000] / 100 + 0.3), 100),
        (np.floor(NUMBER / 0.99 + 1e-6) / 1e3, 990),
        (np.floor(NUMBER / 0.98 + 1e-6) / 1e3, 980),
        (np.floor(NUMBER / 1.99 + 1e-6) / 1e3, 1990),
    ],
    ids=[
        "ms 1600",
        "ms 850",
        "ms 700",
        "2 digits 200",
        "2 digits 190",
        "s 102.4",
        "s 50",
        "1.2 ms",
        "20 ms",
        "pairs",
        "15.6 ms",
        "10 s",
        "ms 990",
        "ms 980",
        "ms 1990",
    ],
)
def test_coarse_stamps_give_the_rate_by_number_over_time(time, rate):
    recording = log(time)
    mended = mend_stamps(recording)
    assert sampling_rate(mended)[0] == pytest.approx(rate, rel=2e-4)
    assert sampling_rate(mended)[1] == []
    assert len(mended) == len(time)
    assert np.array_equal(mended.column("gyro_x"), recording.column("gyro_x"))
    tick = np.diff(np.unique(time)).max()
    assert np.abs(mended.time - time).max() < 1.1 * tick
    assert (np.diff(mended.time) > 0).all()


def fetched(kind):
    """Return the time at which a program has each of N readings, taken every .01 s, in hand."""
    if kind == "bursts, the last cut short":
        return np.minimum(NUMBER // 25 * 25 + 24, N - 1) / 100
    longest = 0.35 if kind == "seldom" else 0.06
    at = np.cumsum(np.random.default_rng(5).uniform(0.4 * longest, longest, 2 * N))
    return at[np.searchsorted(at, NUMBER / 100)]


@pytest.mark.parametrize("kind", ["bursts, the last cut short", "seldom", "often"])
@pytest.mark.parametrize("backwards", [False, True])
def test_a_stamp_is_of_the_last_reading_where_readings_are_stamped_as_they_are_fetched(kind, backwards):
    time = fetched(kind)
    if backwards:  # the same as though each stamp were of its first reading
        time = (time[-1] - time)[::-1]
    clock = read_clock(time)
    assert clock.rate == pytest.approx(100, rel=3e-5)
    assert not clock.missing.size
    late = clock.even - NUMBER / 100
    assert np.ptp(late) < 0.003
    assert np.diff(clock.even) == pytest.approx(0.01, rel=1e-3)


@pytest.mark.parametrize(("first", "last"), [(0, 0), (4, 0), (0, 7), (6, 3), (9, 9)])
@pytest.mark.parametrize(("rate", "tick"), [(10, 1.0), (100, 1.0), (1000, 0.1)])
def test_a_log_that_begins_or_ends_within_a_stamp_is_still_stamped_by_its_first_readings(first, last, rate, tick):
    each = round(rate * tick)
    number = np.arange(first * each // 10, 300 * each - last * each // 10)
    clock = read_clock(np.floor(number / each) * tick)
    assert clock.rate == pytest.approx(rate, rel=1e-9)
    assert clock.even == pytest.approx(number / rate, abs=1e-6)


@pytest.mark.parametrize("kind", ["seldom", "often"])
@pytest.mark.parametrize("cut", [1, 2, 3, 7])
def test_a_log_that_begins_or_ends_between_two_fetches_is_still_stamped_by_its_last_readings(kind, cut):
    clock = read_clock(fetched(kind)[cut:-cut])
    late = clock.even - NUMBER[cut:-cut] / 100
    assert clock.rate == pytest.approx(100, rel=3e-5)
    assert np.ptp(late) < 0.003
    assert 0 < np.median(late) < {"seldom": 0.2, "often": 0.04}[kind]


def test_readings_lost_between_two_fetches_are_a_gap_behind_the_last_that_came():
    kept = np.ones(N, dtype=bool)
    time = fetched("seldom")
    row = int(np.flatnonzero(np.diff(time) > 0)[300])
    kept[row + 1 : row + 301] = False
    clock = read_clock(time[kept])
    assert (clock.rate, clock.gaps.tolist()) == (pytest.approx(100, rel=1e-4), [row])
    assert clock.missing.tolist() == [300]


def test_a_gap_beside_the_beat_of_a_clock_stays():
    clock = read_clock(np.delete(np.floor(NUMBER / 0.99 + 1e-6) / 1e3, slice(7010, 7310)))
    assert (clock.rate, clock.missing.tolist()) == (pytest.approx(990, rel=1e-4), [300])


def test_a_sample_that_a_program_loses_now_and_then_is_a_gap():
    clock = read_clock(np.delete(NUMBER / 100, slice(50, None, 50)))
    assert (clock.rate, clock.missing.sum()) == (pytest.approx(100, rel=1e-9), N // 50 - 1)


def test_samples_lost_under_coarse_stamps_stay_a_gap():
    time = np.floor(np.delete(NUMBER, slice(7000, 7300)) / 1.6) / 1e3
    clock = read_clock(time)
    assert (clock.rate, clock.missing.tolist()) == (pytest.approx(1600, rel=1e-4), [300])
    assert np.diff(clock.even).max() == pytest.approx(301 / 1600, rel=0.02)


@pytest.mark.parametrize("values", [np.round(0.3 * noise(N)), np.zeros(N)], ids=["quiet counts", "constant"])
def test_equal_counts_at_coarse_stamps_are_readings(values):
    mended = mend_stamps(log(np.floor(NUMBER / 100), values))
    assert len(mended) == N
    assert sampling_rate(mended)[0] == pytest.approx(100, rel=1e-4)


@pytest.mark.parametrize("kind", ["some", "each", "in place of the next"])
def test_a_message_that_came_twice_is_dropped_and_counted(kind):
    """The rate, the rows and the white noise are those of the messages."""
    rng = np.random.default_rng(4)
    values = noise(N, 6)
    if kind == "some":
        rows = np.sort(np.concatenate([NUMBER, rng.choice(NUMBER, 900, replace=False)]))
    elif kind == "each":
        rows = np.repeat(NUMBER, 2)
    else:
        rows = np.where(NUMBER % 3 == 2, NUMBER - 1, NUMBER)
    repeated = log(NUMBER[rows] / 100, values[rows])
    mended = mend_stamps(repeated)
    assert np.array_equal(mended.column("gyro_x"), values[np.unique(rows)])
    count = len(rows) - len(np.unique(rows))
    missing = "; another one is missing for each" if kind == "in place of the next" else ""
    assert mended.notes[0] == f"{count} rows that came twice, with stamp and all values, are dropped{missing}"
    found = analyse(repeated)
    assert found["sample_rate"]["value"] == pytest.approx(100, rel=1e-9)
    white = found["columns"]["gyro_x"]["angle_random_walk"]
    assert abs(white["value"] - np.radians(1) / 10) < 3 * white["standard_uncertainty"]
    assert found["warnings"][0].startswith(f"r.csv: {count} rows that came twice")


@pytest.mark.parametrize("share", [0.05, 1.0])
def test_messages_that_come_twice_leave_the_rate_of_coarse_stamps(share):
    """700 Hz in whole milliseconds are no 1000 Hz with losses, because some messages came twice."""
    often = np.where(np.random.default_rng(8).random(N) < share, 2, 1)
    mended = mend_stamps(log(np.repeat(np.round(NUMBER / 0.7) / 1e3, often), np.repeat(noise(N), often)))
    assert len(mended) == N
    assert sampling_rate(mended) == (pytest.approx(700, rel=1e-4), [])


@pytest.mark.parametrize(
    ("time", "said"),
    [
        (np.where(NUMBER < 500, NUMBER, np.maximum(NUMBER - 100, 500)) / 100, r"502 .* still for 101 rows"),
        (np.where(NUMBER == 500, 499, NUMBER) / 100, "501 .* still: expected more than 4.99 s, found 4.99"),
        (np.full(N, 7.0), "time stands still"),
        (np.floor(NUMBER[:150] / 100), "time stands still"),
        (np.floor(NUMBER[np.random.default_rng(1).random(N) > 0.3] / 100), "the sampling rate cannot be told"),
    ],
    ids=["frozen", "once", "always", "short", "losses"],
)  # fmt: skip
def test_what_cannot_be_told_names_the_row_and_sample_rate(time, said):
    with pytest.raises(DataError, match=f"r.csv: row .*{said}.*sample_rate"):
        mend_stamps(log(time))


def test_time_that_runs_backwards_is_refused_as_such():
    time = NUMBER / 100
    time[9000] = time[8990]
    time[50] = time[49]
    with pytest.raises(DataError, match=r"row 9001 .*runs backwards"):
        sampling_rate(mend_stamps(log(np.where(NUMBER == 50, 0.5, time))))


def test_same_rows_look_back_over_blocks():
    columns = {"time": np.arange(4.0), "a": np.array([1, 1, np.nan, np.nan]), "b": np.array([2.0, 2, 2, 2])}
    assert same_rows(columns).tolist() == [False, True, False, True]
    assert same_rows(columns, {"a": 1.0, "b": 2.0}).tolist() == [True, True, False, True]
    assert same_rows({"time": np.arange(2.0)}).tolist() == [False, False]


def test_show_and_noise_have_one_rule(imulab, tmp_path):
    time = np.sort(1655928838.6 + NUMBER / 100.06 + 0.002 * noise(N, 3))
    recording = log(1e6 * time, unit="us")
    il.write_csv(recording, tmp_path / "r.csv")
    shown = imulab("show", "r.csv").stdout
    assert "rate 100.062 Hz, gaps 0, jitter 2.8 ms" in shown
    assert "start 1655928838.6 s, end 1655929138.4 s" in shown
    assert "time 1655928838.6 to 1655929138.4 s (2022-06-22 20:13:58 UTC), until 2022-06-22 20:18:58 UTC" in shown
    assert "  1655928838604082  " in shown
    told = json.loads(imulab("show", "r.csv", "--json").stdout)
    assert told["sample_rate"]["value"] == pytest.approx(analyse(il.read(tmp_path / "r.csv"))["sample_rate"]["value"])
    assert told["start"] == {"value": pytest.approx(time[0]), "unit": "s", "utc": "2022-06-22 20:13:58"}
    assert told["end"] == {"value": pytest.approx(time[-1]), "unit": "s", "utc": "2022-06-22 20:18:58"}
    assert (told["gaps"], told["missing"], told["repeated"]) == (0, 0, 0)


def test_show_counts_what_is_repeated_and_missing(imulab, tmp_path):
    rows = np.where(NUMBER % 3 == 2, NUMBER - 1, NUMBER)[:300]
    il.write_csv(log(rows / 100, noise(300)[rows]), tmp_path / "twice.csv")
    shown = imulab("show", "twice.csv").stdout
    assert "rate 100 Hz, gaps 99 (the widest 0.02 s), missing 99, repeated 100" in shown
    il.write_csv(log(np.floor(NUMBER[:150] / 100)), tmp_path / "short.csv")
    assert "rate unknown: time stands still" in imulab("show", "short.csv").stdout
    assert "sample_rate" in imulab("show", "short.csv").stdout


@pytest.mark.parametrize("window", ["+1:+2.5", "+1:", ":+2.5"])
@pytest.mark.parametrize("first", [0.0, 100.0, 1655928838.5], ids=["zero", "boot", "epoch"])
def test_a_window_with_signs_counts_from_the_start(imulab, tmp_path, window, first):
    recording = log(first + NUMBER[:400] / 100)
    il.write_csv(recording, tmp_path / "r.csv")
    since = (NUMBER[:400] / 100).tolist()
    low, high = 1.0 if window[0] == "+" else 0.0, 2.5 if "2.5" in window else 9.0
    inside = [t for t in since if low <= t <= high]
    part = il.read(tmp_path / "r.csv", window=window)
    assert part.time - first == pytest.approx(inside, abs=1e-6)
    assert f"r.csv: {len(inside)} samples" in imulab("show", "r.csv", "--window", window).stdout
    assert len(il.read(tmp_path / "r.csv", window=window)) == len(inside)


def test_a_window_of_a_frame_counts_from_its_start():
    recording = il.simulate_tumble(gravity=9.81)
    how = {"gravity": 9.81, "order": 1}
    late = recording.with_columns({"time": recording.column("time") + 1655928838.5}, {})
    first = il.fit_tumble(recording, window=(0, 100), **how).calibration
    for data in (late, late.to_frame()):
        again = il.fit_tumble(data, window="+0:+100", **how).calibration
        assert again.value("bias_x") == pytest.approx(first.value("bias_x"), rel=1e-6)


def test_a_window_that_misses_times_since_1970_says_how_to_type_one(imulab, tmp_path):
    il.write_csv(log(1655928838.5 + NUMBER[:400] / 100), tmp_path / "r.csv")
    done = imulab("show", "r.csv", "--window", "0:60")
    assert done.returncode == 2
    assert done.stderr == (
        "imulab: r.csv: nothing in the window 0 to 60 s; the file runs from 1655928838.5 to 1655928842.5 s; "
        "a window such as +0:+60 counts from the start\n"
    )


def test_times_since_1970_are_drawn_from_the_start():
    figure = log(1655928838.5 + NUMBER[:400] / 100).plot("gyro").figure
    assert figure.layout["xaxis"]["title"]["text"] == "time from 2022-06-22 20:13:58 UTC on, s"
    assert figure.traces[0]["x"][:2] == pytest.approx([0.0, 0.01], abs=1e-6)
    figure = log(500 + NUMBER[:400] / 100).plot("gyro").figure
    assert figure.layout["xaxis"]["title"]["text"] == "time, s"
    assert figure.traces[0]["x"][0] == 500
    report = il.fit_tumble(
        il.simulate_tumble(gravity=9.81).with_columns(
            {"time": il.simulate_tumble(gravity=9.81).column("time") + 1655928838.5}, {}
        ),
        gravity=9.81,
    )
    (rest,) = [figure for figure in report.plot() if figure.figure.title == "Where the unit was at rest"]
    assert rest.figure.layout["xaxis"]["title"]["text"].startswith("time from 2022-06-22")
    assert 0 <= min(shape["x0"] for shape in rest.figure.layout["shapes"]) < 20


@pytest.mark.parametrize("kind", ["coarse", "twice"])
def test_blocks_are_mended_as_the_whole_is(kind):
    if kind == "coarse":
        recording = log(np.floor(NUMBER / 100 + 0.3))
    else:
        rows = np.sort(np.concatenate([NUMBER, [1, 10_001, 20_000]]))
        recording = log(rows / 100, noise(N)[rows])
    edges = [0, 7000, 15_000, len(recording)]
    blocks = [
        Recording({name: values[a:b] for name, values in recording.columns.items()}, recording.units, first_row=a + 1)
        for a, b in pairwise(edges)
    ]
    whole, parts = mend_stamps(recording), list(mend_blocks(iter(blocks)))
    assert np.concatenate([part.time for part in parts]).tolist() == whole.time.tolist()
    assert len(whole) == N


def test_late_stamps_are_no_gaps_of_an_array():
    array = il.simulate_array(experiment="static", duration=60.0)
    time = array.column("time")
    late = np.where(np.arange(len(time)) % 100 == 50, 0.8 * (time[1] - time[0]), 0.0)
    rough = array.with_columns({"time": time + late}, {})
    assert il.fuse(rough).notes == il.fuse(array).notes


def test_a_long_file_is_read_in_parts_by_the_same_rule(imulab, tmp_path, monkeypatch):
    """The summary of parts is that of the whole, but for the steps between them."""
    keep = np.random.default_rng(2).random(N) > 0.01
    recording = log(lose(keep, 100))
    monkeypatch.setattr("imulab.cli.show._MOST_ROWS", 4000)
    blocks = [
        Recording({name: values[a : a + 1000] for name, values in recording.columns.items()}, recording.units)
        for a in range(0, len(recording), 1000)
    ]
    parts, whole = (json.loads(recording_json(each)) for each in (blocks, [recording]))
    assert parts["sample_rate"]["value"] == pytest.approx(whole["sample_rate"]["value"], rel=1e-9)
    assert (parts["gaps"], parts["missing"]) == (whole["gaps"], whole["missing"])
    assert (parts["start"], parts["end"], parts["duration"]) == (whole["start"], whole["end"], whole["duration"])


@pytest.mark.slow
def test_a_replay_of_coarse_stamps_gives_what_the_file_gives(imulab, tmp_path):
    """A tumble test at 100 Hz with stamps of whole hundredths rounded to two readings each."""
    recording = il.simulate_tumble(gravity=9.81, attitudes=12)
    coarse = recording.with_columns({"time": np.floor(recording.column("time") / 0.02 + 1e-9) * 0.02}, {})
    il.write_csv(coarse, tmp_path / "coarse.csv")
    how = ["--gravity", "9.81", "--order", "1"]
    done = imulab("live", "replay:coarse.csv@0", *how, "--plain", "--save", "r.csv", "-o", "live.json")
    assert done.returncode == 0, done.stderr
    assert len(il.read(tmp_path / "r.csv")) == len(coarse)
    assert imulab("tumble", "fit", "coarse.csv", *how, "-o", "file.json").returncode == 0
    live, file = (il.load(tmp_path / name) for name in ("live.json", "file.json"))
    for name, parameter in file.parameters.items():
        assert abs(live.value(name) - parameter.value) < 0.3 * parameter.standard_uncertainty, name


@pytest.mark.parametrize("kind", ["pairs", "whole seconds", "twice"])
def test_an_array_with_shared_stamps_is_fused_as_its_readings_are(imulab, tmp_path, kind):
    even = il.simulate_array(duration=30.0, rate=100.0)
    rows = np.arange(len(even))
    if kind == "twice":
        rows = np.sort(np.concatenate([rows, [100, 1000]]))
        stamps = even.column("time")[rows]
    else:
        stamps = np.floor(even.column("time") / (1.0 if kind == "whole seconds" else 0.02) + 1e-9)
        stamps = stamps * (1.0 if kind == "whole seconds" else 0.02)
    shared = {name: values[rows] for name, values in even.columns.items()} | {"time": stamps}
    il.write_csv(even, tmp_path / "even.csv")
    il.write_csv(Recording(shared, even.units, name="shared.csv"), tmp_path / "shared.csv")
    for name in ("even", "shared"):
        assert imulab("array", "fuse", f"{name}.csv", "-o", f"{name}_rate.csv").returncode == 0
    fused, known = (il.read(tmp_path / f"{name}_rate.csv") for name in ("shared", "even"))
    assert len(fused) == len(known)
    for name in known.columns:
        tolerance = 0.02 if name == "time" else 1e-9
        np.testing.assert_allclose(
            fused.column(name) - fused.column(name)[0], known.column(name) - known.column(name)[0], atol=tolerance
        )
    np.testing.assert_allclose(il.fuse(tmp_path / "shared.csv").rate, il.fuse(tmp_path / "even.csv").rate, atol=1e-9)


def test_a_unit_of_time_that_makes_the_rate_unusual_is_doubted(imulab, tmp_path):
    recording = il.simulate_tumble(gravity=9.81, attitudes=12)
    wrong = recording.with_columns({"time": np.round(1.7339389e12 + recording.time * 1e3)}, {})
    il.write_csv(wrong, tmp_path / "ms.csv")
    doubt = "column time [s]: 10 s from row to row (0.1 Hz): is the unit of time right: 100 Hz if it is in ms?"
    assert f"\n{doubt} --unit time=UNIT states it\n" in imulab("show", "ms.csv").stdout
    fit = ("tumble", "fit", "ms.csv", "--gravity", "9.81", "--with", "gyro", "-o", "r.json")
    done = imulab(*fit)
    assert (done.returncode, done.stderr) == (2, f"imulab: ms.csv: {doubt} --unit time=UNIT states it\n")
    assert imulab(*fit, "--unit", "time=ms").returncode == 0
    assert "is the unit" not in imulab("show", "ms.csv", "--unit", "time=ms").stdout

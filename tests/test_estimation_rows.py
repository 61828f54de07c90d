"""Rows that are not readings: zeros, repeats, torn frames; and the sensors whose rows look like them."""

import json

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.display import Note
from imulab.errors import DataError
from imulab.estimation import rows
from imulab.estimation.rows import (
    count_changes,
    distinct,
    find_step,
    frozen_runs,
    leave_out,
    long_runs,
    median,
    medians,
    quantile,
    stuck_run,
)
from imulab.procedures.tumble.gyro.fit import fit_gyro_triad
from imulab.recording import Recording
from test_tumble_attitudes import errors, fitted
from test_tumble_attitudes import held_hold as held

EVERY = 50


AT_REST = {"accel": [1000.0, -4000.0, 15000.0], "gyro": [500.0, -300.0, 100.0]}


def counts(sensor="accel", noise=5.0, level=None, count=20000, seed=1):
    """A triad at rest in whole counts, as a 16-bit sensor gives them."""
    rng = np.random.default_rng(seed)
    samples = np.round(np.array(AT_REST[sensor] if level is None else level) + noise * rng.standard_normal((count, 3)))
    return of(samples, sensor)


def of(samples, sensor="accel", unit="count"):
    columns = {"time": np.arange(len(samples)) / 100.0}
    columns |= {f"{sensor}_{axis}": samples[:, i].copy() for i, axis in enumerate("xyz")}
    return Recording(columns, dict.fromkeys(columns, unit) | {"time": "s"}, name="log.csv")


def names(sensor):
    return [f"{sensor}_{axis}" for axis in "xyz"]


def zeroed(samples, rows):
    samples[rows] = 0.0


def repeated(samples, rows):
    samples[rows] = samples[rows - 1]


def one_axis(samples, rows):
    samples[rows, 2] = 0.0


def spiked(samples, rows):
    samples[rows, 0] += 3000.0


def torn(samples, rows):
    samples[rows] = np.roll(samples[rows], 1, axis=1)


def spoilt(recording, fault, sensor="accel", every=EVERY):
    samples = recording.triad(sensor)
    rows = np.arange(every - 1, len(samples), every)
    fault(samples, rows)
    return recording.with_columns({name: samples[:, i] for i, name in enumerate(names(sensor))}, {}), rows


@pytest.mark.parametrize("sensor", ["accel", "gyro"])
@pytest.mark.parametrize(
    ("fault", "kind"),
    [
        (zeroed, "exact zeros"),
        (repeated, "exact repeats"),
        (one_axis, "an exact zero of one"),
        (spiked, "far"),
        (torn, "far"),
    ],
)
def test_what_loggers_do_is_found_named_and_bridged(fault, kind, sensor):
    clean = counts(sensor)
    bad, rows = spoilt(clean, fault, sensor)
    left_out = leave_out(bad, names(sensor))
    found = np.logical_or.reduce(list(left_out.kinds.values()))
    assert set(rows) <= set(np.flatnonzero(found))
    assert np.count_nonzero(found) <= 1.05 * len(rows)  # a few that repeat by chance
    note = next(note for note in left_out.notes() if kind in note)
    assert "left out" in note
    assert f"first at row {rows[0] + 1}" in note or kind == "exact repeats"
    samples, without = left_out.recording.triad(sensor), np.setdiff1d(np.arange(len(clean)), np.flatnonzero(found))
    np.testing.assert_array_equal(samples[without], bad.triad(sensor)[without])
    assert np.abs(samples - clean.triad(sensor)).max() < 60


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.2, 0.5, 1.0, 3.0, 30.0])
@pytest.mark.parametrize("level", [(0.0, 0.2, -0.4), (1.0, -2.0, 3.0), (16384.0, 0.0, 0.0)])
def test_sensors_that_repeat_and_read_zero_by_themselves_are_left_alone(noise, level):
    recording = counts("gyro", noise, level)
    assert leave_out(recording, names("gyro")).notes() == []


def test_a_log_that_is_faster_than_its_sensor_is_left_alone():
    recording = counts(count=10000)
    twice = of(np.repeat(recording.triad("accel"), 2, axis=0))
    assert leave_out(twice, names("accel")).notes() == []


def frozen(recording, first, behind):
    """The recording with all readings of some rows as in the first of them."""
    columns = {name: np.array(values) for name, values in recording.columns.items()}
    for name in columns.keys() - {"time"}:
        columns[name][first:behind] = columns[name][first]
    return Recording(columns, recording.units, name=recording.name)


@pytest.mark.parametrize("seconds", [20, 31, 60])
def test_a_link_that_stands_still_from_attitude_to_attitude_is_no_attitude(seconds):
    """31 s of one reading counted as an attitude of their own, verdict good."""
    clean = held(5)
    start = int(np.searchsorted(clean.time, 42.0))
    bad = frozen(clean, start, start + int(np.searchsorted(clean.time, seconds)))
    record = fitted(bad)
    assert record.verdict.state == "look"
    assert any("left out: exact repeats of the row before" in warning for warning in record.warnings)
    error, u = errors(record)
    assert np.abs(error / u).max() < 4
    assert np.median(u / errors(fitted(clean))[1]) < 2


def test_an_attitude_of_one_reading_is_refused():
    clean = held(5, hold=40.0, count=9)
    start = int(np.searchsorted(clean.time, 45.0))
    with pytest.raises(DataError, match=r"of the rows of the attitude at .* are no readings \(exact repeats"):
        fitted(frozen(clean, start, start + int(np.searchsorted(clean.time, 31.0))))


def test_outputs_that_stand_still_by_themselves_are_not_frozen():
    """A coarse sensor whose noise is within one step in some attitudes, and a log of changes alone."""
    rng = np.random.default_rng(3)
    level = np.repeat(rng.uniform(-9, 9, (40, 3)), 500, axis=0)
    for noise in (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.7):
        assert frozen_runs(np.round(level + noise * rng.standard_normal(level.shape)).T) == [], noise
    changes = rng.random(20000) < 0.02
    held_rows = np.maximum.accumulate(np.where(changes, np.arange(20000), 0))
    assert frozen_runs(rng.standard_normal((3, 20000))[:, held_rows]) == []


@pytest.mark.parametrize("kind", ["student", "low-pass", "drift"])
def test_odd_noise_is_left_alone(kind):
    rng = np.random.default_rng(6)
    noise = {
        "student": rng.standard_t(6, (20000, 3)),
        "low-pass": np.apply_along_axis(np.convolve, 0, rng.standard_normal((20000, 3)), np.ones(8) / 8, "same"),
        "drift": rng.standard_normal((20000, 3)).cumsum(axis=0),
    }[kind]
    assert leave_out(of(1e3 + noise), names("accel")).notes() == []


@pytest.mark.parametrize("fault", [zeroed, one_axis, spiked, torn])
def test_a_tumble_fit_is_as_without_the_rows(fault):
    clean = held(5)
    samples = clean.triad("accel")
    bad, _ = spoilt(clean, fault) if fault is not spiked else spoilt(clean, lambda s, r: zeroed(s, r[::2]))
    attitudes = il.find_attitudes(bad)
    assert any("left out" in note and not isinstance(note, Note) for note in attitudes.notes)
    error, u = errors(fitted(attitudes))
    assert np.abs(error / u).max() < 4
    whole = errors(fitted(il.find_attitudes(clean)))
    assert np.abs(error - whole[0]).max() < 3 * u.max()
    np.testing.assert_allclose(u, whole[1], rtol=0.5)
    np.testing.assert_array_equal(samples, clean.triad("accel"))  # the caller's own are as they were


def test_too_many_are_refused_by_name():
    bad, _ = spoilt(held(5), zeroed, every=12)
    with pytest.raises(
        DataError, match=r"^hand.csv: row \d+, columns accel_x accel_y accel_z: [89] % of the rows of the att"
    ):
        il.find_attitudes(bad)


@pytest.mark.parametrize("fault", [zeroed, one_axis])
def test_gyroscopes_turn_as_without_the_rows(fault):
    recording = il.simulate_tumble(order=1, attitudes=24, seed=3, gravity=9.81362)
    attitudes = il.find_attitudes(recording)
    record = il.fit_tumble(attitudes, order=1, gravity=9.81362).calibration
    clean = fit_gyro_triad(record, attitudes, recording)
    bad, _ = spoilt(recording, fault, "gyro")
    found = fit_gyro_triad(record, attitudes, bad)
    assert any("left out" in note for note in found.notes)
    u = np.sqrt(np.diag(clean.covariance))[:3]
    assert np.abs(found.scale_factor - clean.scale_factor).max() < 3 * u.max()
    with pytest.raises(DataError, match="expected at most 5 %"):
        fit_gyro_triad(record, attitudes, spoilt(recording, zeroed, "gyro", every=10)[0])


def still_array(count=12000, elements=6, seed=2):
    rng = np.random.default_rng(seed)
    columns = {"time": np.arange(count) / 100.0}
    for i in range(elements):
        columns[f"gyro_{i + 1}"] = 0.3 * (i + 1) + 0.05 * rng.standard_normal(count)
    return Recording(columns, dict.fromkeys(columns, "deg/s") | {"time": "s"}, name="array.csv")


def blanked(recording, every=EVERY):
    rows = np.arange(every - 1, len(recording), every)
    columns = {name: values.copy() for name, values in recording.columns.items()}
    for name in columns:
        if name != "time":
            columns[name][rows] = 0.0
    return recording.with_columns(columns, {}), rows


def test_an_array_is_calibrated_as_without_the_rows():
    clean = still_array()
    bad, rows = blanked(clean)
    record, usual = il.calibrate_array(bad).calibration, il.calibrate_array(clean).calibration
    assert any(f"{len(rows)} rows of gyro_1 .. gyro_6 left out: exact zeros" in each for each in record.warnings)
    for name, parameter in usual.parameters.items():
        assert abs(record.parameters[name].value - parameter.value) < 3 * parameter.standard_uncertainty
    with pytest.raises(DataError, match="expected at most 5 %"):
        il.calibrate_array(blanked(clean, every=15)[0])


def test_allan_is_as_without_the_rows():
    from imulab.estimation.column_noise import analyse

    clean = still_array()
    bad, rows = blanked(clean)
    found, usual = analyse(bad), analyse(clean)
    assert any(f"{len(rows)} rows" in each and "left out" in each for each in found["warnings"])
    for name in ("gyro_1", "gyro_6"):
        values = [each["columns"][name]["angle_random_walk"]["value"] for each in (found, usual)]
        assert values[0] == pytest.approx(values[1], rel=0.03)
    with pytest.raises(DataError, match="expected at most 5 %"):
        analyse(blanked(clean, every=15)[0])


@pytest.mark.parametrize("method", ["mean", "robust"])
def test_fusion_gives_no_rate_where_no_gyro_gave_a_reading(method):
    clean = still_array(count=3000)
    bad, rows = blanked(clean)
    fused = il.fuse(bad, il.FuseOptions(method=method))
    usual = il.fuse(clean, il.FuseOptions(method=method))
    assert np.flatnonzero(np.isnan(fused.rate[:, 0])).tolist() == rows.tolist()
    assert any(f"{len(rows)} rows left out: every gyro is exactly zero" in note for note in fused.notes)
    good = np.setdiff1d(np.arange(len(clean)), rows)
    assert np.abs(fused.rate[good] - usual.rate[good]).max() < 0.1
    coarse = clean.with_columns({n: np.round(v / 40) for n, v in clean.columns.items() if n != "time"}, {})
    assert np.isfinite(il.fuse(coarse, il.FuseOptions(method="mean")).rate).all()


def test_the_commands_name_them_in_one_line(imulab, tmp_path):
    il.write_csv(spoilt(held(5), zeroed)[0], tmp_path / "bad.csv")
    done = imulab("tumble", "fit", "bad.csv", "--order", "1", "--gravity", "9.81362", "-o", "out.json")
    assert done.returncode == 0, done.stderr
    assert "left out: exact zeros, first at row 50 (line 51)" in done.stderr + done.stdout
    il.write_csv(spoilt(held(5), zeroed, every=10)[0], tmp_path / "worse.csv")
    done = imulab("tumble", "fit", "worse.csv", "--order", "1", "--gravity", "9.81362", "-o", "worse.json")
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "worse.json").exists()


def test_a_table_pasted_twice_does_not_count_twice():
    rng = np.random.default_rng(3)
    rows = rng.standard_normal((12, 3))
    rows = 9.81362 * rows / np.linalg.norm(rows, axis=1, keepdims=True) + 1e-3 * rng.standard_normal((12, 3))
    columns = {f"accel_{axis}": np.tile(rows[:, i], 2) for i, axis in enumerate("xyz")}
    table = Recording(columns, dict.fromkeys(columns, "m/s^2"), name="table.csv")
    record = il.fit_tumble(il.find_attitudes(table), order=1, gravity=9.81362).calibration
    assert record.fit["degrees_of_freedom"] == 3
    assert any("duplicate" in warning for warning in record.warnings)


def noise(rng, n, exponent):
    """Noise whose power falls with the frequency to a power, of standard deviation 1 from sample to sample."""
    frequency = np.fft.rfftfreq(2 * n)
    frequency[0] = frequency[1]
    return np.fft.irfft(np.fft.rfft(rng.normal(size=2 * n)) * frequency ** (-exponent / 2))[:n]


KINDS = {
    "white": lambda rng, n: rng.normal(size=n),
    "flicker": lambda rng, n: noise(rng, n, 1),
    "walk": lambda rng, n: np.cumsum(rng.normal(size=n)),
    "white and flicker": lambda rng, n: rng.normal(size=n) + 0.3 * noise(rng, n, 1),
    "white and walk": lambda rng, n: rng.normal(size=n) + 0.01 * np.cumsum(rng.normal(size=n)),
    "counts": lambda rng, n: np.round(0.2 * rng.normal(size=n)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_noise_has_no_steps(kind):
    rng = np.random.default_rng(7)
    trials = 300
    false = sum(find_step(KINDS[kind](rng, n)) is not None for n in (5000, 20_000) for _ in range(trials // 2))
    assert false <= 0.01 * trials


HOUR = np.arange(90_000) / 90_000


DRIFTS = {
    "short exponential": 0.05 * np.exp(-HOUR * 3600 / 30),
    "exponential": 0.05 * np.exp(-HOUR * 3600 / 100),
    "long exponential": 0.05 * np.exp(-HOUR * 3600 / 300),
    "large exponential": 5 * np.exp(-HOUR * 3600 / 100),
    "two exponentials": 0.1 * np.exp(-HOUR * 3600 / 60) + 0.1 * np.exp(-HOUR * 3600 / 600),
    "fourth order": 0.3 * HOUR**4,
    "ramp of the temperature": 0.3 * np.clip((HOUR - 0.3) / 0.15, 0, 1),
    "from level to level": 0.3 * np.tanh((HOUR - 0.5) * 12),
}


@pytest.mark.parametrize("kind", DRIFTS)
def test_a_drift_is_no_step(kind, reduced):
    """Warm-up drifts of an hour, in noise of 0.1 from sample to sample at 25 Hz."""
    trials = 4 if reduced else 10
    rng = np.random.default_rng(10)
    assert sum(find_step(DRIFTS[kind] + 0.1 * rng.normal(size=90_000)) is not None for _ in range(trials)) == 0


def test_a_step_on_a_drift_is_found(reduced):
    trials = 8 if reduced else 20
    rng = np.random.default_rng(11)
    found = 0
    for _ in range(trials):
        samples = DRIFTS["long exponential"] + 0.1 * rng.normal(size=90_000)
        at = int(rng.integers(20_000, 80_000))
        samples[at:] += 0.06
        step = find_step(samples)
        found += step is not None and abs(step.sample - at) <= step.within
    assert found >= 0.8 * trials


@pytest.mark.slow
def test_a_step_is_found_where_it_is_and_as_large_as_it_is(reduced):
    trials = 20 if reduced else 50
    rng = np.random.default_rng(8)
    missed = 0
    for _ in range(trials):
        at = int(rng.integers(3000, 17_000))
        samples = rng.normal(size=20_000)
        samples[at:] -= 0.6
        step = find_step(samples)
        if step is None:
            missed += 1
            continue
        assert abs(step.sample - at) < 1000
        assert step.size == pytest.approx(-0.6, abs=0.3)
    assert missed <= 0.1 * trials


@pytest.mark.parametrize("samples", [np.zeros(5000), np.ones(10), np.arange(5000.0)])
def test_what_has_no_noise_has_no_step_either(samples):
    assert find_step(samples) is None


def test_allan_says_that_a_step_is_no_noise(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(9)
    rates = rng.normal(0, 0.05, (12_000, 2))
    rates[7000:, 1] += 0.1
    rows = np.column_stack([np.arange(12_000) / 100, rates])
    np.savetxt("a.csv", rows, "%.9g", ",", header="time [s],gyro_x [deg/s],gyro_y [deg/s]", comments="")
    assert main(["allan", "a.csv", "--json"]) == 0
    out, error = capsys.readouterr()
    (line,) = [line for line in error.splitlines() if "level" in line]
    assert line.startswith(
        "imulab: warning: a.csv: column gyro_y: the level changes by 0.098 deg/s within 1.8 s near 69.92 s"
    )
    assert "gyro_x" not in line
    walk = json.loads(out)["columns"]["gyro_y"]["rate_random_walk"]["value"]
    assert walk > 0


@pytest.mark.parametrize("count", [1, 2, 3, 10, 101])
def test_they_are_those_of_numpy(count):
    values = np.random.default_rng(count).normal(size=(4, count)).round(1)
    for axis in (0, 1):
        assert np.array_equal(medians(values, axis), np.median(values, axis=axis))
    assert median(values) == np.median(values)
    for share in (0.0, 0.05, 0.5, 0.99, 1.0):
        assert quantile(values[0], share) == pytest.approx(np.quantile(values[0], share), rel=1e-14, abs=1e-15)
    assert np.array_equal(distinct(values), np.unique(values))


def test_a_value_that_is_no_number_makes_the_median_of_its_row_none():
    assert np.array_equal(medians(np.array([[1.0, np.nan, 3.0], [1.0, 2.0, 3.0]])), [np.nan, 2.0], equal_nan=True)
    assert distinct(np.empty(0)).size == 0


def test_a_coarse_sensor_that_stays_on_a_step_is_not_stuck_and_a_fine_one_is():
    rng = np.random.default_rng(3)
    noise, time = rng.standard_normal((4, 12_000)), np.arange(12_000)
    others = list(noise[1:])
    drifting = 0.1 * noise[0] + 0.4 * np.sin(time / 2000)  # of steps: it toggles near their ends only
    assert stuck_run(np.round(drifting), others) is None
    assert stuck_run(np.round(1.5 * noise[0]), others) is None
    held = np.where((time >= 3000) & (time < 3500), 1.0, np.round(1.5 * noise[0]))
    begin, length = stuck_run(held, others)
    assert abs(begin - 3000) < 5
    assert 500 <= length < 510
    assert stuck_run(held, [np.round(0.1 * each) for each in others]) is None  # nobody changes
    ends = np.where((time >= 3000) & (time < 3500), 9.0, noise[0])
    assert stuck_run(ends, others) == (3000, 500)
    assert stuck_run(ends, others, moving=True) is None


def test_a_coarse_sensor_that_rests_between_motions_is_not_stuck():
    """Steps of 1 and noise of 0.1, beside sensors with noise of 1, which change in each row at rest, too."""
    rng = np.random.default_rng(3)
    motion = 200 * np.sin(np.arange(8000) / 20)
    motion[3000:3400] = motion[3000]
    others = [motion + rng.standard_normal(8000) for _ in range(3)]
    coarse = np.round(motion + 0.1 * rng.standard_normal(8000))
    coarse[3000:3400] = coarse[3000]
    assert stuck_run(coarse, others, moving=True) is None
    coarse[5000:5500] = coarse[5000]
    assert stuck_run(coarse, others, moving=True) == (5000, 500)


@pytest.mark.parametrize("at_once", [64, 1 << 16])
def test_long_runs_are_those_between_all_changes(at_once, monkeypatch):
    monkeypatch.setattr(rows, "_AT_ONCE", at_once)
    rng = np.random.default_rng(7)
    for _ in range(300):
        values = rng.integers(0, rng.integers(2, 6), rng.integers(1, 400)).astype(float)
        for _ in range(rng.integers(0, 4)):
            begin = rng.integers(0, len(values))
            values[begin : begin + rng.integers(1, 90)] = values[begin]
        edges = np.concatenate([[0], np.flatnonzero(np.diff(values)) + 1, [len(values)]])
        assert count_changes(values) == len(edges) - 2
        for least in (4, 5, 20, 51):
            long = np.diff(edges) >= least
            first, behind = long_runs(values, least)
            assert first.tolist() == edges[:-1][long].tolist()
            assert behind.tolist() == edges[1:][long].tolist()


@pytest.mark.parametrize(
    ("values", "step"),
    [([], 0.0), ([3.0], 0.0), ([1.0, 1.0], 0.0), ([0.5, 2.0, 1.0], 0.5), ([np.nan, 1.0, np.nan, 3.0, -np.inf], 2.0)],
)
def test_the_resolution_is_the_smallest_step_of_finite_values(values, step):
    assert rows.resolution(np.array(values)) == step

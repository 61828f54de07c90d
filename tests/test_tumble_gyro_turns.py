"""Clocks, rates and turns that are not what the gyroscopes' fit takes them for: right, or said."""

import re
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.display import Bad, Note
from imulab.errors import OptionError
from imulab.procedures.tumble.gyro.fit import fit_gyro_triad, with_gyro
from imulab.procedures.views import exhibits_of
from reference.turns import GRAVITY, accelerometers, gyroscopes, random_path, random_unit


def campaign(seed, *, scale=1.0, apart=False, fast=0.0, late=0.0, cubic=0.0, limit=None, change=None):
    """A unit, its record, the accelerometers' attitudes and the gyroscopes' recording (rad/s).

    `fast`: the gyroscopes' clock runs fast by so much; `late`: their samples are stamped so late, s.
    """
    rng = np.random.default_rng(seed)
    unit, path = random_unit(rng), random_path(rng)
    time = np.arange(0, path.end, 0.01)
    accel = accelerometers(unit, path, time, rng)
    gyro = gyroscopes(unit, path, time - late, rng, cubic=cubic, limit=limit)
    columns = {"time": time * (1 + fast), **{name: scale * values for name, values in gyro.items()}}
    if change is not None:
        columns, accel = change(columns, accel, path)
    units = {"time": "s"} | {f"gyro_{a}": "rad/s" for a in "xyz"} | {f"accel_{a}": "m/s^2" for a in "xyz"}
    both = il.Recording(columns={**columns, **accel}, units=units, name="both.csv")
    own = recording = both
    if apart:
        own = il.Recording(columns={"time": time, **accel}, units=units, name="accel.csv")
        recording = il.Recording(columns=columns, units=units, name="gyro.csv")
    attitudes = il.find_attitudes(own)
    record = il.fit_tumble(attitudes, order=1, gravity=GRAVITY).calibration
    return unit, record, attitudes, recording


def scores(unit, fit):
    i, j = np.nonzero(~np.eye(3, dtype=bool))
    found = np.concatenate([fit.scale_factor, fit.misalignment[i, j], fit.bias])
    true = np.concatenate([unit.scale, unit.misalignment[i, j], unit.bias])
    return (found - true) / np.sqrt(np.diag(fit.covariance))


def said(record, fit, recording):
    return with_gyro(record, fit, recording, recording).warnings


def test_the_clock_is_a_common_part_of_all_three_scale_factors():
    unit, record, attitudes, recording = campaign(1)
    plain, wide = (fit_gyro_triad(record, attitudes, recording, clock=u) for u in (0.0, 1e-3))
    s = plain.scale_factor
    added = wide.covariance - plain.covariance
    np.testing.assert_allclose(added[:3, :3], 1e-6 * np.outer(s, s), rtol=1e-6)
    np.testing.assert_allclose(added[:3, 9:], -1e-6 * np.outer(s, plain.bias), rtol=1e-3)
    np.testing.assert_array_equal(wide.scale_factor, plain.scale_factor)
    default = fit_gyro_triad(record, attitudes, recording)
    assert default.clock.uncertainty == pytest.approx(50e-6, rel=0.3)
    assert np.abs(scores(unit, default)).max() < 5


@pytest.mark.slow
def test_two_clocks_are_compared_and_their_difference_is_part_of_the_uncertainty(reduced):
    trials = 4 if reduced else 6
    found = []
    for seed in range(trials):
        unit, record, attitudes, recording = campaign(seed, apart=True, fast=2e-3, late=0.2)
        fit = fit_gyro_triad(record, attitudes, recording)
        other = fit.clock.comparison
        # The accelerometers' clock, the true one, runs slow against the gyroscopes'.
        found.append((other.rate - (1 / 1.002 - 1)) / other.rate_uncertainty)
        assert other.rate_uncertainty < 120e-6
        (note,) = [w for w in fit.notes if "against the gyroscopes'" in w]
        assert re.search(r"runs -\d{4} ppm \(u \d+ ppm\)", note)
        assert np.abs(scores(unit, fit)).max() < 5
        assert 1.5e-3 < fit.clock.uncertainty < 2.5e-3
        mended = fit_gyro_triad(record, attitudes, recording, clock_of="accel")
        assert np.abs(mended.scale_factor / unit.scale - 1).max() < 4e-4
        assert np.abs(scores(unit, mended)).max() < 5
        assert not [w for w in mended.notes if "against the gyroscopes'" in w]
    assert 0.4 < np.sqrt(np.mean(np.square(found))) < 1.8


def test_clocks_that_agree_add_nothing_and_are_not_spoken_of():
    _, record, attitudes, recording = campaign(3, apart=True)
    fit = fit_gyro_triad(record, attitudes, recording)
    assert fit.notes == ()
    assert abs(fit.clock.comparison.rate) < 4 * fit.clock.comparison.rate_uncertainty
    assert abs(fit.clock.comparison.delay) < 2e-3


def test_late_samples_of_the_gyroscopes_do_no_harm_and_are_noted():
    unit, record, attitudes, recording = campaign(2, late=0.01)
    fit = fit_gyro_triad(record, attitudes, recording)
    (note,) = fit.notes
    assert isinstance(note, Note)
    assert float(re.search(r"come \+([\d.]+) ms after", note)[1]) == pytest.approx(10, abs=2)
    assert np.abs(scores(unit, fit)).max() < 5
    assert with_gyro(record, fit, recording, recording).verdict.state == record.verdict.state


def test_scale_factors_that_change_with_the_rate_are_said_with_their_size(reduced):
    trials = 2 if reduced else 4
    for seed in range(trials):
        _, record, attitudes, recording = campaign(seed, cubic=1e-3)  # 0.1 % at 100 deg/s
        fit = fit_gyro_triad(record, attitudes, recording)
        (note,) = [w for w in fit.notes if "depends on the rate" in w]
        assert "on a rate table" in note
        found = fit.nonlinearity
        true = 1e-3 * (found.largest / np.radians(100)) ** 2
        assert np.abs((found.odd - true) / found.odd_uncertainty).max() < 5
        straight = fit_gyro_triad(*campaign(seed)[1:])
        assert not [w for w in straight.notes if "depends on the rate" in w]


def knocked(columns, accel, path):
    time = columns["time"]
    for k in (4, 11, 17):
        pulse = 0.4 * np.exp(-0.5 * ((time - path.begin[k] - 0.4 * path.duration[k]) / 0.03) ** 2)
        columns = columns | {"gyro_y": columns["gyro_y"] + pulse}
    return columns, accel


def lost(count, *, stamped):
    def change(columns, accel, path):
        time = columns["time"]
        keep = np.ones(len(time), dtype=bool)
        for k in (3, 9, 10, 15):
            first = np.searchsorted(time, path.begin[k] + 0.45 * path.duration[k])
            keep[first : first + count] = False
        columns = {name: values[keep] for name, values in columns.items()}
        if not stamped:
            columns["time"] = 0.01 * np.arange(keep.sum())
        return columns, {name: values[keep] for name, values in accel.items()}

    return change


@pytest.mark.parametrize(
    ("change", "words", "turns"),
    [
        (knocked, "set aside: it misses by", 3),
        (lost(12, stamped=False), "set aside: it misses by", 4),
        (lost(12, stamped=True), r"4 turns left out, samples are missing during them: gaps of up to 0\.13 s", 1),
    ],
)
@pytest.mark.slow
def test_turns_with_a_knock_or_with_lost_samples_are_named_and_do_not_count(change, words, turns):
    for seed in range(3):
        unit, record, attitudes, recording = campaign(seed, change=change)
        fit = fit_gyro_triad(record, attitudes, recording)
        notes = [w for w in fit.notes if re.search(words, w)]
        assert turns <= len(notes) <= turns + 1
        assert np.abs(scores(unit, fit)).max() < 5
        assert np.abs(fit.scale_factor / unit.scale - 1).max() < 3e-4
        both = with_gyro(record, fit, recording, recording)
        assert len(both.fit["gyro"]["set_aside"]) == len(fit.aside)
        figure = next(f for f in exhibits_of(both).items if f.title.startswith("What the gyroscopes miss"))
        assert len(figure.traces[0]["y"]) == len(fit.residuals) + len(fit.aside)
        assert ("Hatched and red: set aside." in figure.caption) == (len(fit.aside) > 0)


def test_one_attitude_cut_out_of_the_recording_leaves_the_verdict_good():
    """As a session cuts one that its person dropped: one turn of many is lost, and nothing is wrong with the others."""
    recording = il.simulate_tumble(attitudes=20, order=1, gravity=9.81, hold="4 s", move="1 s", gyro=True, seed=3)
    attitudes, time = il.find_attitudes(recording), recording.column("time")
    keep = (time < attitudes.start[8] - 1.0) | (time > attitudes.stop[8] + 0.6)
    cut = il.Recording({n: recording.column(n)[keep] for n in recording.columns}, recording.units)
    fit = il.fit_gyro(il.fit_tumble(cut, order=1, gravity=9.81).calibration, cut)
    assert any("1 turn left out, samples are missing" in warning for warning in fit.calibration.warnings)
    assert fit.calibration.verdict.state == "good"


@pytest.mark.slow
def test_nothing_is_set_aside_without_reason(reduced):
    trials = 8 if reduced else 16
    aside = sum(len(fit_gyro_triad(*campaign(seed)[1:]).aside) for seed in range(20, 20 + trials))
    assert aside <= trials / 8  # 2 of 16 times 23 turns


def test_turns_beyond_the_range_are_left_out():
    unit, record, attitudes, recording = campaign(5, limit=np.radians(120))
    fit = fit_gyro_triad(record, attitudes, recording)
    assert any("left out, clipped" in w for w in fit.notes)
    assert np.abs(scores(unit, fit)).max() < 5


def faster(factor):
    return lambda columns, accel, path: (columns | {"time": columns["time"] * factor}, accel)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"scale": np.degrees(1)}, "are the rates in deg/s"),
        ({"scale": np.radians(1)}, "are the rates in rad/s"),
        ({"change": faster(2.0)}, "is the sample rate twice what the time stamps say"),
        ({"change": faster(0.5)}, "is the sample rate half what the time stamps say"),
        ({"scale": 1.3}, "is the unit right"),
    ],
)
def test_a_wrong_unit_or_sample_rate_is_no_result(options, words):
    _, record, attitudes, recording = campaign(4, **options)
    both = with_gyro(record, fit_gyro_triad(record, attitudes, recording), recording, recording)
    (warning,) = [w for w in both.warnings if words in w]
    assert "e+" not in warning
    assert isinstance(warning, Bad)
    assert both.verdict.state == "bad"


def test_three_scale_factors_that_are_off_alike_are_said():
    unit, record, attitudes, recording = campaign(6)
    alike = recording.with_columns(
        {f"gyro_{a}": 1.02 * recording.columns[f"gyro_{a}"] / unit.scale[i] for i, a in enumerate("xyz")}, {}
    )
    assert any("all by the same" in w for w in said(record, fit_gyro_triad(record, attitudes, alike), alike))
    assert not any(
        "all by the same" in w for w in said(record, fit_gyro_triad(record, attitudes, recording), recording)
    )


def test_a_g_sensitivity_with_which_turns_miss_more_is_not_taken_by_itself():
    """The zero follows gravity at rest but not in the turns: a housing that bends under a hand does that."""
    unit, record, attitudes, recording = campaign(7)
    force = il.apply(record, recording).triad("accel")
    extra = np.radians(0.05) * np.roll(force, 1, axis=1) / GRAVITY
    still = np.zeros(len(recording), dtype=bool)
    for a, b in zip(attitudes.start, attitudes.stop, strict=True):
        still |= (recording.columns["time"] >= a) & (recording.columns["time"] <= b)
    only_at_rest = {f"gyro_{a}": recording.columns[f"gyro_{a}"] + extra[:, i] * still for i, a in enumerate("xyz")}
    everywhere = {f"gyro_{a}": recording.columns[f"gyro_{a}"] + extra[:, i] for i, a in enumerate("xyz")}
    assert fit_gyro_triad(record, attitudes, recording.with_columns(everywhere, {})).sensitivity is not None
    fit = fit_gyro_triad(record, attitudes, recording.with_columns(only_at_rest, {}))
    assert fit.sensitivity is None
    assert (
        fit_gyro_triad(record, attitudes, recording.with_columns(only_at_rest, {}), sensitivity="yes").cost > fit.cost
    )
    assert np.abs(scores(unit, fit)[:9]).max() < 5


@pytest.mark.parametrize(
    ("options", "words"),
    [({"clock": -1.0}, "relative uncertainty of a clock's rate"), ({"clock_of": "host"}, "one of gyro accel")],
)
def test_options_that_cannot_be_are_refused(options, words):
    _, record, attitudes, recording = campaign(1)
    with pytest.raises(OptionError, match=words):
        fit_gyro_triad(record, attitudes, recording, **options)


def test_the_command_takes_the_clock(imulab, tmp_path):
    _, record, _, recording = campaign(1, apart=True, fast=1e-3)
    own = campaign(1)[3]
    record.save(tmp_path / "accel.json")
    il.write(recording, tmp_path / "gyro.csv")
    columns = {name: own.columns[name] for name in ("time", "accel_x", "accel_y", "accel_z")}
    il.write(replace(own, columns=columns, units={name: own.units[name] for name in columns}), tmp_path / "accel.csv")
    command = ("tumble", "gyro", "gyro.csv", "--accel", "accel.json", "--accel-file", "accel.csv", "-o", "both.json")
    done = imulab(*command, "--clock", "20 ppm")
    assert done.returncode == 0, done.stderr
    assert "use --clock-of accel" in done.stderr
    held = il.load(tmp_path / "both.json")
    assert held.fit["gyro"]["clock"]["accel_clock_rate"]["value"] == pytest.approx(-1e-3, abs=2e-4)
    assert imulab(*command, "--clock-of", "accel").returncode == 0
    for wrong in (("--clock", "5 s"), ("--clock-of", "mine")):
        refused = imulab(*command, *wrong)
        assert refused.returncode == 2
        assert refused.stderr.count("\n") == 1


def jittered(size):
    """Time stamps of a host that gets to a sample late: the sensor itself runs evenly."""

    def change(columns, accel, path):
        rng = np.random.default_rng(len(columns["time"]))
        late = columns["time"] + rng.uniform(0, size, len(columns["time"]))
        return columns | {"time": np.maximum.accumulate(late) + 1e-9 * np.arange(len(late))}, accel

    return change


def polled(columns, accel, path):
    """Samples taken when a host gets to them, and stamped rightly."""
    rng = np.random.default_rng(len(columns["time"]))
    number = np.sort(rng.choice(len(columns["time"]), 2 * len(columns["time"]) // 3, replace=False))
    return {n: v[number] for n, v in columns.items()}, {n: v[number] for n, v in accel.items()}


@pytest.mark.slow
def test_stamps_that_jitter_are_evened_where_the_turns_say_that_the_samples_do_not(reduced):
    trials = 3 if reduced else 8
    plain, wrong = [], []
    for seed in range(trials):
        for size in (0.004, 0.04):
            unit, record, attitudes, recording = campaign(seed, change=jittered(size))
            fit = fit_gyro_triad(record, attitudes, recording)
            assert any("jitter by" in w for w in fit.notes)
            assert np.abs(scores(unit, fit)).max() < 5
            plain += (fit.scale_factor / unit.scale - 1).tolist()
        unit, record, attitudes, recording = campaign(seed, change=polled)
        fit = fit_gyro_triad(record, attitudes, recording)
        assert not any("jitter by" in w for w in fit.notes)
        wrong += (fit.scale_factor / unit.scale - 1).tolist()
    assert np.sqrt(np.mean(np.square(plain))) < 6e-5  # 790 ppm at 0.04 s as they come
    assert np.sqrt(np.mean(np.square(wrong))) < 1.2e-4


def test_counted_time_stamps_are_noted_unless_the_clock_is_stated():
    _, record, attitudes, recording = campaign(1)
    assert any(
        "--clock 10000ppm" in w and isinstance(w, Note)
        for w in said(record, fit_gyro_triad(record, attitudes, recording), recording)
    )
    stated = fit_gyro_triad(record, attitudes, recording, clock=0.01)
    assert not any("--clock" in w for w in said(record, stated, recording))

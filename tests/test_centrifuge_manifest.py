"""Every way to get a centrifuge test wrong: exit status 2, one line that names run and file, and no record."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.errors import DataError, ReadError, UnitError
from imulab.procedures.centrifuge.manifest import load_manifest, make_manifest, manifest_text
from imulab.procedures.centrifuge.simulate import Simulation, typical_truth

G = 9.80665
NET = np.radians(40.0)
LOADED = "c1_5g.csv"


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A small good test on disk: one static run, 1 g and 5 g of 40 s at 20 Hz."""
    folder = tmp_path_factory.mktemp("good")
    test = make_manifest(levels=[G, 5 * G], radius=2.0, net_rate=NET)
    simulation = Simulation(test, typical_truth(), 20.0, 40.0, 30.0)
    for run in test.runs:
        il.write_csv(simulation(run), folder / run.file)
    (folder / "m.toml").write_text(manifest_text(test))
    return folder


@pytest.fixture
def folder(good, tmp_path):
    for file in good.iterdir():
        shutil.copy(file, tmp_path)
    return tmp_path


def edit(folder, old, new, count=1):
    text = (folder / "m.toml").read_text()
    assert old in text, old
    (folder / "m.toml").write_text(text.replace(old, new, count))


def recorded(folder, file, change):
    recording = il.read(folder / file)
    il.write_csv(change(recording), folder / file)


def refused(imulab, folder):
    before = sorted(p.name for p in folder.iterdir())
    done = imulab("centrifuge", "reduce", "m.toml", "-o", "r.json", "--report", "r.html")
    assert done.returncode == 2, (done.stdout, done.stderr)
    assert done.stdout == ""
    assert done.stderr.startswith("imulab: ")
    assert done.stderr.count("\n") == 1, done.stderr
    assert sorted(p.name for p in folder.iterdir()) == before
    return done.stderr


def test_the_good_one_is_good(folder, imulab):
    done = imulab("centrifuge", "reduce", "m.toml", "-o", "r.json", "--report", "r.html")
    assert done.returncode == 0, done.stderr
    assert {"r.json", "r.html"} <= {p.name for p in folder.iterdir()}


MANIFEST_CASES = {
    "misspelt rate": ("arm_rate =", "armrate =", ["m.toml: run 2 (c1_1g.csv)", "unknown key 'armrate'", "arm_rate"]),
    "misspelt key at the top": ("radius =", "radious =", ["m.toml: unknown key 'radious'", "radius"]),
    "arm rate of 0": ("arm_rate = 126.8726", "arm_rate = 0", ["run 2 (c1_1g.csv)", "arm_rate = 0", "more than 0"]),
    "table rate of 0": (
        "table_rate = 86.8726", "table_rate = 0",
        ["run 2 (c1_1g.csv)", "table_rate = 0", "more than 0"],
    ),
    "table rate equal to the net rate": (
        "table_rate = 86.8726", "table_rate = 63.4363", ["run 2 (c1_1g.csv)", "equals the net rate of 63.4363 deg/s"],
    ),
    "table rate half the net rate": (
        "table_rate = 86.8726", "table_rate = 42.290866666666", ["run 2 (c1_1g.csv)", "half the net rate"],
    ),
    "no reference run": (
        'reference = { value = 1', 'reference = { value = 3',
        ["run 3 (c1_5g.csv)", "no reference run (K_1)", "5 % of 3 g"],
    ),
    "no reference run of the spin axis down": (
        "table_rate = 243.6958", 'table_rate = 243.6958\nspin_axis = "down"',
        [f"run 3 ({LOADED})", "no reference run (K_1) with the spin axis down", "126.873 deg/s of the arm as in c1_1g"],
    ),
    "a reference run of the spin axis down at another level": (
        "arm_rate = 283.6958\ntable_rate = 243.6958", 'arm_rate = 127.5\ntable_rate = 87.5\nspin_axis = "down"',
        [f"run 3 ({LOADED})", "no reference run (K_1) with the spin axis down", "nearest is this one at 127.5 deg/s"],
    ),
    "no static run": (
        'role = "static"', 'role = "loaded"\narm_rate = 300\ntable_rate = 260',
        ["no static run", "run 1 (c1_static.csv)"],
    ),
    "unknown role": ('role = "loaded"', 'role = "spun"', ["run 2 (c1_1g.csv)", "role", "'spun'", "static or loaded"]),
    "sense of 2": (
        "table_rate = 86.8726", "table_rate = 86.8726\nsense = 2",
        ["run 2 (c1_1g.csv)", "sense", "1 or -1"],
    ),
    "spin axis sideways": (
        "table_rate = 86.8726", 'table_rate = 86.8726\nspin_axis = "left"',
        ["spin_axis", "up or down"],
    ),
    "power cycle 0": ("power_cycle = 1", "power_cycle = 0", ["run 1 (c1_static.csv)", "power_cycle", "found 0"]),
    "a file twice": ('file = "c1_5g.csv"', 'file = "c1_1g.csv"', ["run 3 (c1_1g.csv)", "the same file as run 2"]),
    "a missing file": ('file = "c1_5g.csv"', 'file = "gone.csv"', ["run 3 (gone.csv)", "no such file"]),
    "unit of the rates": (
        'rates = { unit = "deg/s"', 'rates = { unit = "deg"',
        ["m.toml: rates", "unit of rate", "'deg'"],
    ),
    "unknown unit": ('unit = "m" }', 'unit = "furlong" }', ["m.toml: radius", "unknown unit 'furlong'"]),
    "radius of 0": ("radius = { value = 2.0", "radius = { value = 0.0", ["m.toml: radius", "more than 0"]),
    "a text for a number": (
        "arm_rate = 126.8726", 'arm_rate = "fast"',
        ["run 2 (c1_1g.csv): arm_rate", "expected a number"],
    ),
    "not TOML": ("radius =", "radius ==", ["m.toml: the manifest file is not TOML"]),
    "rates that do not match": (
        "arm_rate = 283.6958", "arm_rate = 287.6958",
        [f"run 3 ({LOADED})", "rates do not match", "Earth-rate line is at 39.98", "net rate 44 deg/s"],
    ),
    "table rate that does not match": (
        "table_rate = 243.6958", "table_rate = 253.6958", [f"run 3 ({LOADED})", "deg/s"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", MANIFEST_CASES)
def test_a_bad_manifest_is_refused(case, folder, imulab):
    old, new, fragments = MANIFEST_CASES[case]
    edit(folder, old, new)
    message = refused(imulab, folder)
    for fragment in fragments:
        assert fragment in message, message


def scaled(recording, factor, names=("dtg_x", "dtg_y", "fog")):
    return recording.with_columns({n: recording.columns[n] * factor for n in names}, {})


def first_seconds(recording, seconds):
    count = int(np.searchsorted(recording.time, seconds))
    return replace(recording, columns={k: v[:count] for k, v in recording.columns.items()})


def without(recording, *names):
    kept = {k: v for k, v in recording.columns.items() if k not in names}
    return replace(recording, columns=kept, units={k: recording.units[k] for k in kept})


def in_unit(recording, unit, *names):
    return replace(recording, units={**recording.units, **dict.fromkeys(names, unit)})


def rows(recording, kept):
    return replace(recording, columns={k: v[kept] for k, v in recording.columns.items()})


def stepped(recording, name, size, start):
    values = recording.columns[name].copy()
    values[int(start * len(values)) :] += size
    return recording.with_columns({name: values}, {})


def turning(recording):
    angle = np.degrees(NET) * recording.time
    rate = 11.0 * np.cos(np.radians(angle))
    return recording.with_columns({"fog": recording.columns["fog"] + rate}, {})


def with_nan(recording):
    values = recording.columns["fog"].copy()
    values[49] = np.nan
    return recording.with_columns({"fog": values}, {})


RECORDING_CASES = {
    "less than one period": (LOADED, lambda r: first_seconds(r, 1.2), ["less than one period of the table (1.477 s"]),
    "too short for the net rate": (
        LOADED, lambda r: first_seconds(r, 1.7),
        ["too short to tell", "expected 1.767 s or more"],
    ),
    "no fog": (LOADED, lambda r: without(r, "fog"), ["no column fog; found time dtg_x dtg_y table_angle"]),
    "no time": (LOADED, lambda r: without(r, "time"), ["no column time"]),
    "no y in one run": (LOADED, lambda r: without(r, "dtg_y"), ["no column dtg_y, which other runs have"]),
    "not a number": (
        LOADED, with_nan, [f"m.toml: run 3 ({LOADED}): row 50 (line 51), column fog: expected a finite number"],
    ),
    "a time that stands still": (
        LOADED, lambda r: r.with_columns({"time": np.minimum(r.time, 30.0)}, {}),
        [f"m.toml: run 3 ({LOADED}): row 602 (line 603), column time"],
    ),
    "counts without scale factor": (
        LOADED, lambda r: in_unit(r, "count", "dtg_x"),
        ["column dtg_x is in count", "[scale_factor]"],
    ),
    "an angle in counts": (
        LOADED, lambda r: in_unit(r, "count", "table_angle"),
        ["column table_angle is in count", "deg or rad"],
    ),
    "all columns in the wrong unit": (
        LOADED, lambda r: in_unit(r, "deg/s", "dtg_x", "dtg_y", "fog"),
        ["column fog shows Earth rate as", "unit or scale factor wrong"],
    ),
    "mixed units": (
        LOADED, lambda r: scaled(r, 3600.0, ("dtg_x",)),
        ["column dtg_x shows Earth rate as", "mixed units"],
    ),
    "angle the other way": (
        LOADED, lambda r: r.with_columns({"table_angle": -r.columns["table_angle"]}, {}),
        ["table_angle turns at -243.", "sense"],
    ),
    "a static run with a step": (
        "c1_static.csv", lambda r: stepped(r, "dtg_x", 300.0, 0.8),
        ["a static run that moves", "column dtg_x"],
    ),
    "a static run on a turning table": (
        "c1_static.csv", turning, ["a static run that moves", "column fog shows a line of"],
    ),
    "a static run that shakes once a second": (
        "c1_static.csv",
        lambda r: r.with_columns({"dtg_x": r.columns["dtg_x"] + 40 * np.sin(2 * np.pi * r.time)}, {}),
        ["a static run that moves", "column dtg_x shows a line of 3", "deg/s, as if"],
    ),
    "a static run that creeps": (
        "c1_static.csv",
        lambda r: r.with_columns({"fog": r.columns["fog"] + r.time}, {}),
        ["a static run that moves", "column fog drifts by 28.8 deg/h"],
    ),
    "a loaded run in the place of the static one": (
        "c1_static.csv",
        lambda r: without(il.read(f"{r.name.rpartition('/')[0]}/{LOADED}"), "table_angle"),
        ["a static run that moves", "column dtg_x shows a line of", "as if the gyroscope turned"],
    ),
    "the FOG the other way round": (
        LOADED, lambda r: scaled(r, -1.0, ("fog",)),
        [f"run 3 ({LOADED})", "column dtg_x shows Earth rate 1", "is an axis or a sign reversed"],
    ),
    "X and Y exchanged": (
        LOADED, lambda r: r.with_columns({"dtg_x": r.columns["dtg_y"], "dtg_y": r.columns["dtg_x"]}, {}),
        [f"run 3 ({LOADED})", "column dtg_x shows Earth rate -", "columns exchanged"],
    ),
    "most of a run missing": (
        LOADED, lambda r: rows(r, (r.time < 8) | (r.time > 38)),
        [f"run 3 ({LOADED}): gaps: 9.9", "in a run of 39.65 s"],
    ),
    "a static run whose table turns": (
        "c1_static.csv",
        lambda r: r.with_columns({"table_angle": 0.1 * r.time}, {}),
        ["a static run that moves", "column table_angle"],
    ),
    "a jump of the drift in the middle": (
        LOADED,
        lambda r: r.with_columns({"dtg_x": r.columns["dtg_x"] * np.where(abs(r.time - 20) < 3, 3.0, 1.0)}, {}),
        ["the line at the table rate changes near", "steady rates"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", RECORDING_CASES)
def test_a_bad_recording_is_refused_naming_run_and_file(case, folder, imulab):
    file, change, fragments = RECORDING_CASES[case]
    recorded(folder, file, change)
    message = refused(imulab, folder)
    assert file in message
    for fragment in fragments:
        assert fragment in message, message


# --- ramps -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoder", [True, False])
def test_a_ramp_at_the_start_is_cut_and_said(encoder):
    test = make_manifest(levels=[G, 10 * G], radius=2.0, net_rate=NET)
    truth = typical_truth()
    ramped = Simulation(test, truth, 50.0, 400.0, 20.0, encoder, ramp=25.0)
    record = il.fit_centrifuge(test, ramped).calibration
    steady = il.fit_centrifuge(test, Simulation(test, truth, 50.0, 400.0, 20.0, encoder)).calibration
    cut = [message for message in record.warnings if "rate ramp in the first" in message]
    assert len(cut) == 2
    assert "c1_10g.csv" in cut[1]
    for n in (1, 2):
        error = record.value(f"x_K_{n}") - steady.value(f"x_K_{n}")
        assert abs(error) < 2.5 * record.parameters[f"x_K_{n}"].standard_uncertainty
    assert 340 < record.sections["runs"][2]["duration"]["value"] < 376


@pytest.mark.parametrize("encoder", [True, False])
def test_a_slow_ramp_all_along_is_refused(encoder):
    test = make_manifest(levels=[G, 10 * G], radius=2.0, net_rate=NET)
    ramped = Simulation(test, typical_truth(), 50.0, 200.0, 20.0, encoder, ramp=190.0)
    with pytest.raises(DataError, match=r"c1_10?g\.csv\): "):
        il.fit_centrifuge(test, ramped)


def test_a_net_rate_slightly_off_is_a_warning():
    test = make_manifest(levels=[G, 10 * G], radius=2.0, net_rate=NET)
    truth = typical_truth()
    off = replace(truth, rig=replace(truth.rig, arm_rate_error=2e-4))
    record = il.fit_centrifuge(test, Simulation(test, off, 50.0, 300.0, 20.0)).calibration
    assert any("net rate measured on Earth rate is 40.08" in message for message in record.warnings)


def test_without_lines_on_the_fog_there_are_warnings_and_the_manifest_s_rates():
    test = make_manifest(levels=[G, 10 * G], radius=2.0, net_rate=NET)
    truth = typical_truth()
    bare = replace(truth, rig=replace(truth.rig, tilt=0.0, flexure=0.0, earth_rate=0.0, base_tilt=0.0))
    fit = il.fit_centrifuge(test, Simulation(test, bare, 50.0, 300.0, 20.0, False))
    assert sum("no significant FOG line at the table rate" in m for m in fit.calibration.warnings) == 2
    assert sum("no significant Earth-rate line" in m for m in fit.calibration.warnings) == 2
    assert fit.runs[0].rates.table_rate == test.runs[1].table_rate
    assert fit.runs[0].rates.origin == "manifest"


def test_y_the_other_way_round_is_a_warning(folder, imulab):
    recorded(folder, LOADED, lambda r: scaled(r, -1.0, ("dtg_y",)))
    done = imulab("centrifuge", "reduce", "m.toml", "-o", "r.json")
    assert done.returncode == 0
    assert f"run 3 ({LOADED}): column dtg_y shows Earth rate" in done.stderr


def test_a_channel_that_never_changes_is_a_warning(folder, imulab):
    recorded(folder, LOADED, lambda r: scaled(r, 0.0, ("fog",)))
    done = imulab("centrifuge", "reduce", "m.toml", "-o", "r.json")
    assert f"run 3 ({LOADED}): column fog never changes" in done.stderr


def test_files_exchanged_without_encoder_are_told_by_the_line_that_is_there(folder, imulab):
    for file in ("c1_static.csv", "c1_1g.csv", LOADED):
        recorded(folder, file, lambda r: without(r, "table_angle"))
    shutil.copy(folder / LOADED, folder / "c1_1g.csv")
    done = imulab("centrifuge", "reduce", "m.toml", "-o", "r.json")
    assert "no significant FOG line at the table rate 86.8726 deg/s (its strongest line is at 243." in done.stderr
    assert "no table_angle: no direction of the drift, which apply needs" in done.stderr


@pytest.mark.parametrize("encoder", [True, False])
def test_a_gap_costs_samples_and_nothing_else(encoder):
    test = make_manifest(levels=[G, 5 * G], radius=2.0, net_rate=NET)
    truth = typical_truth()
    quiet = replace(truth, x=replace(truth.x, angle_random_walk=0.0), fog=replace(truth.fog, angle_random_walk=0.0),
                    y=None, rig=replace(truth.rig, table_rate_error=1e-4))  # fmt: skip
    simulation = Simulation(test, quiet, 20.0, 80.0, 20.0, encoder)

    def with_gap(run):
        for block in simulation(run):
            yield rows(block, (block.time < 20.0) | (block.time > 33.7)) if run.role == "loaded" else block

    whole, holed = (il.fit_centrifuge(test, source).calibration for source in (simulation, with_gap))
    for n in (1, 2):
        assert holed.value(f"x_K_{n}") == pytest.approx(whole.value(f"x_K_{n}"), rel=1e-4)


def test_the_rates_found_are_named_to_the_hundredth_even_in_short_runs(folder, imulab):
    """The far line is interpolated: a bin of 40 s is 9 deg/s wide."""
    edit(folder, "arm_rate = 283.6958", "arm_rate = 263.6958")
    found = re.search(r"Earth-rate line is at ([\d.]+) deg/s", refused(imulab, folder))
    assert float(found[1]) == pytest.approx(40.0, abs=0.5)


# --- the manifest itself -----------------------------------------------------------------------------------------


def test_a_manifest_reads_back_as_it_was_written(tmp_path):
    test = make_manifest(
        levels=[G, 2.5 * G], radius=1.5, net_rate=NET, cycles=2, both_senses=True, radius_uncertainty=2e-5,
        rate_uncertainty=1e-5, gravity=9.8015, sensor={"serial": 'A "7"'},
    )  # fmt: skip
    test = replace(test, scale_factors={"fog": (1250.0, "count")})
    (tmp_path / "m.toml").write_text(manifest_text(test, ["a comment"]))
    again = load_manifest(tmp_path / "m.toml")
    assert again.sensor == test.sensor
    assert again.scale_factors["fog"][0] == pytest.approx(1250.0, rel=1e-12)
    for one, other in zip(test.runs, again.runs, strict=True):
        assert other.arm_rate == pytest.approx(one.arm_rate, rel=1e-10)
        assert replace(other, arm_rate=0, table_rate=0) == replace(one, arm_rate=0, table_rate=0)
    for name in ("radius", "radius_uncertainty", "rate_uncertainty", "gravity", "reference"):
        assert getattr(again, name) == pytest.approx(getattr(test, name), rel=1e-8)


def test_errors_have_their_kinds(tmp_path):
    with pytest.raises(ReadError, match="no such manifest"):
        load_manifest(tmp_path / "none.toml")
    (tmp_path / "m.toml").write_text('radius = { value = 2, unit = "s" }\nrates = { unit = "deg/s" }\nrun = []\n')
    with pytest.raises(UnitError, match=r"radius: expected a unit of length, found 's' \(time\)"):
        load_manifest(tmp_path / "m.toml")

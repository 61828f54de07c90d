"""What a person at a notebook gets wrong ends in one sentence, whatever the function."""

import inspect
import pickle
from collections.abc import Callable, Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import polars as pl
import pytest

import imulab as il
from imulab import arguments
from imulab.procedures.tumble.fit import fit_tumble
from imulab.recording import Array


@pytest.fixture(scope="module")
def recording():
    return il.simulate_tumble(attitudes=12, order=1, hold="2 s")


@pytest.fixture(scope="module")
def fit(recording):
    return il.fit_tumble(recording, order=1)


NO_FILE = "expected the name of a file, found "
WRONG = {
    "load a number": (lambda r, f: il.load(3), NO_FILE + "3"),
    "load nothing": (lambda r, f: il.load(None), NO_FILE + "None"),
    "load a recording": (lambda r, f: il.load(r), NO_FILE),
    "read a number": (lambda r, f: il.read(3), NO_FILE + "3"),
    "read bytes": (lambda r, f: il.read(b"x.csv"), NO_FILE + "b'x.csv'"),
    "read a recording": (lambda r, f: il.read(r), NO_FILE),
    "write swapped": (lambda r, f: il.write("x.csv", r), "write: blocks: expected a recording"),
    "write_csv swapped": (lambda r, f: il.write_csv("x.csv", r), "write_csv: blocks: expected a recording"),
    "write an array": (
        lambda r, f: il.write_csv(np.ones((3, 3)), "x.csv"),
        "expected a recording or a list of recordings",
    ),
    "save to a number": (lambda r, f: f.save(3), NO_FILE + "3"),
    "save a record to nothing": (lambda r, f: f.calibration.save(None), NO_FILE + "None"),
    "report as text": (
        lambda r, f: f.report("r.txt"),
        r"r\.txt: a report is HTML; expected a name that ends in \.html",
    ),
    "report as a printed page": (lambda r, f: f.report("r.pdf"), r"r\.pdf: no such file is written; reports are HTML"),
    "sheet as a picture": (
        lambda r, f: il.plan_tumble(attitudes=12, order=1, noise="20 ug").report("s.png"),
        r"s\.png: no such file",
    ),
    "save a figure to a number": (lambda r, f: f.plot().save(3), NO_FILE + "3"),
    "a manifest of a number": (lambda r, f: il.load_manifest(3), NO_FILE + "3"),
    "gravity in a list": (lambda r, f: il.fit_tumble(r, gravity=[9.81]), r"gravity \[9.81\]: expected a number"),
    "latitude as text": (lambda r, f: il.normal_gravity("52 N", 0), "latitude '52 N': unknown unit 'N'"),
    "a frame of an array": (lambda r, f: il.Recording.from_frame(np.ones((3, 3))), "expected a data frame of pandas"),
    "a frame of a mapping": (lambda r, f: il.Recording.from_frame({"a": [1]}), "expected a data frame of pandas"),
    "metadata as text": (
        lambda r, f: il.Recording.from_arrays(accel=np.ones((3, 3)), unit="g", metadata="x"),
        "metadata: expected a mapping",
    ),
    "units as text": (lambda r, f: il.Recording({"accel_x": np.ones(3)}, "g"), "units: expected a mapping"),
    "columns as an array": (lambda r, f: il.Recording(np.ones((3, 3)), {}), "columns: expected a mapping"),
}


@pytest.mark.parametrize("call", WRONG)
def test_it_ends_in_one_sentence(call, recording, fit, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    function, message = WRONG[call]
    with pytest.raises(il.ImulabError, match=message) as caught:
        function(recording, fit)
    assert "\n" not in str(caught.value)
    assert not any(tmp_path.iterdir())


CALLS = [
    ('fit_tumble(r, window=("a",3))', "fit_tumble: window: expected"),
    ('export(rec,"c","x")', "export: to: expected a text"),
    ('export("c","x",rec)', "export: folder: expected the name of a folder"),
    ('allan_deviation(np.ones(50), 10., ["a"])', "allan_deviation: taus: expected a text or a list"),
    ('allan_deviation(np.ones(50), "100 Hz")', "allan_deviation: rate: expected a number"),
    ("fuse(board, still=3)", "fuse: still: expected 2 numbers"),
    ("calibrate_array(still, averaging='two')", "averaging 'two': expected a number"),
    ("fit_gyro(rec, r, clock='fast')", "clock 'fast': expected"),
    ('fit_warmup(cyc, temperatures="cold")', "temperatures 'cold': expected numbers"),
    ('fit_warmup(cyc, temperatures=(-40,0,60), tolerance="1 K")', "tolerance '1 K': expected a number"),
    ("rec.plot(99)", "plot 99: expected a number from 0 to 3"),
    ("r.plot(99)", "plot 99: expected a number from 0 to 3"),
    ('check_tumble(rec, r, limit="2 s")', "limit '2 s': expected a number, or one with a unit of acceleration"),
    ("fit_tumble()", "fit_tumble: missing a required argument: 'data'"),
    ("fit_tumble(r, gravty=9.8)", "fit_tumble: unknown option 'gravty'"),
    ("fit_tumble(r, order=2.5)", "order 2.5: expected one of auto 0 1 2 3 4 5 blend"),
    ("fit_tumble(r, gravity=nan)", "gravity nan: expected the local value in m/s^2, about 9.78 to 9.83 on"),
    ('fit_tumble(r, gravity="9.81 s")', "gravity '9.81 s': expected a number"),
    ("fit_tumble(r, gravity=-9.8)", "gravity -9.8: expected the local value in m/s^2, about 9.78 to 9.83"),
    ("fit_tumble(pd.DataFrame())", "frame: expected data"),
    ("fit_tumble(pl.DataFrame())", "frame: expected data"),
    ("fit_tumble(bare)", "frame: column time has no unit"),
    ('fit_tumble("dir")', "dir: expected a file"),
    ('fit_tumble("text.txt")', "text.txt: row 1"),
    ('fit_tumble("empty.csv")', "empty.csv: the file is empty"),
    ('fit_tumble([1,"a",None])', "data: expected an array of numbers, a row for each sample"),
    (
        'fit_tumble(r.triad("accel"), rate=-5, unit="g")',
        "rate -5: expected a number of samples per second, such as 100.0",
    ),
    ('fit_tumble(r.triad("accel"), rate="fast", unit="g")', "fit_tumble: rate: expected a number"),
    ('fit_tumble(r.triad("accel").T, rate=100, unit="g")', "arrays: accel: expected an array of shape"),
    ("fit_tumble(r, 2)", "fit_tumble: too many positional arguments"),
    ("fit_tumble(r, prior=r)", "fit_tumble: prior: expected a record or the name of its file"),
    ("fit_tumble(r, ageing=3)", "fit_tumble: ageing: expected numbers"),
    ('fit_tumble(r, ageing=("a",), prior=rec, loss="square")', "fit_tumble: ageing: expected numbers"),
    ("fit_tumble(r, nonlinearity=3)", "fit_tumble: nonlinearity: expected 2 numbers"),
    ("fit_tumble(r, nonlinearity=(1,))", "fit_tumble: nonlinearity: expected 2 numbers"),
    ('fit_tumble(r, monte_carlo="many")', "monte_carlo 'many': expected a whole number"),
    ('fit_tumble(r, threshold=3, method="linearised")', "fit_tumble: threshold: expected numbers"),
    ('fit_tumble(at.mean, unit="m/s^2", covariance="a")', "fit_tumble: covariance: expected numbers"),
    ("fit_tumble(r, progress=3, monte_carlo=1000, order=1)", "fit_tumble: progress: expected a function"),
    ('fit_tumble(r, cross="yes")', "fit_tumble: cross: expected True or False"),
    ("fit_tumble(r, loss=None)", "fit_tumble: loss: expected a text"),
    ('fit_tumble("rec.csv", layout=3)', "layout: expected a layout or the name of its file"),
    ('fit_tumble("rec.csv", window=(nan,1))', "fit_tumble: window: expected"),
    ('fit_tumble(bare, units={"accel":3})', "fit_tumble: units['accel']: expected a text"),
    (
        'fit_tumble({"accel":r.triad("accel")}, rate=0, unit="g")',
        "rate 0: expected a number of samples per second, such as 100.0",
    ),
    (
        'fit_tumble(np.full((100,3),np.nan), rate=10, unit="g")',
        "arrays: row 1, column accel_x: expected a finite number",
    ),
    ("fit_tumble(rec)", "data: expected a file name, a Recording, a data frame of pandas or"),
    ('fit_tumble("rec.csv", topic=3)', "fit_tumble: topic: expected a text"),
    ('find_attitudes(r, window="1 s")', "find_attitudes: window: expected a number"),
    ("find_attitudes(r, window=-1)", "window -1 s: expected 0 or more"),
    ('find_attitudes(r, sensor="foo")', "simulated tumble: no column foo_x"),
    ("find_attitudes(r, shortest=nan)", "find_attitudes: shortest: expected a number"),
    ("find_attitudes(r, window=(1,2))", "find_attitudes: window: expected a number"),
    ("check_tumble(r, rec)", "record: expected a record or the name of its file"),
    ("check_tumble(rec, r, limit=nan)", "limit nan m/s^2: expected more than 0"),
    ("check_tumble(rec)", "check_tumble: missing a required argument: 'data'"),
    ("fit_gyro(rec, r, g_sensitivity=3)", "fit_gyro: g_sensitivity: expected a text"),
    ('fit_gyro(rec, r, fit_bias="no")', "fit_gyro: fit_bias: expected True or False"),
    ("fit_gyro(rec, r, clock=nan)", "clock nan: expected the relative uncertainty"),
    ('plan_tumble(12, nois="20ug")', "plan_tumble: unknown option 'nois'"),
    ('plan_tumble(12, noise="20 s")', "noise '20 s': expected a number"),
    ('plan_tumble(12, noise="20ug", method="x")', "method 'x': expected one of norm linearised"),
    ('plan_tumble(-3, noise="20ug")', "-3 attitudes: expected 1 to 300"),
    ("simulate_tumble(24)", "simulate_tumble: too many positional arguments"),
    ('simulate_tumble(truth={"foo":1.})', "truth: no 'bias_x'"),
    ('simulate_tumble(scale="x")', "simulate_tumble: scale: expected a number"),
    ('simulate_tumble(seed="x")', "seed 'x': expected a whole number"),
    ("simulate_tumble(attitudes=[1,2,3])", "attitudes: expected upward directions, shape"),
    ("simulate_tumble(hold=nan)", "hold nan: expected 0.5 to 3600"),
    ("calibrate_array(still, 3)", "moving: expected a file name, a Recording, a data frame of pandas or"),
    ("calibrate_array(still, serial=3)", "calibrate_array: serial: expected a text"),
    ("calibrate_array(still, averaging=nan)", "averaging"),
    ('fuse(board, rate_walk="x", method="kalman")', "fuse: rate_walk: expected a number"),
    ("fuse(board, rate_walk=-1)", "rate walk -1: expected 0 or more"),
    ("fuse(board, still=(1,))", "fuse: still: expected 2 numbers"),
    ('fuse(board, still="2:1")', "still '2:1': expected FROM:TO in seconds"),
    ('fuse(board.to_frame(), rate="x")', "rate 'x': expected a number"),
    ("fuse(board, still=(5,2))", "still 5:2: expected a start before its end"),
    ("fuse(board, FuseOptions(still=3))", "still: expected 2 numbers"),
    ('fuse(board, FuseOptions(start="a"))', "start: expected a whole number"),
    ('compare_methods(board, count_from="x")', "compare_methods: count_from: expected a whole number"),
    ("compare_methods(board, count_from=-2)", "count_from -2: expected 1 or more"),
    ("merge_array(r)", "recordings: expected a list of recordings, one of each gyroscope"),
    ("merge_array([r])", "expected 2 to 64 recordings, a gyroscope each"),
    ("merge_array([r,r], axis=3)", "merge_array: axis: expected a text"),
    ("merge_array(frame)", "recordings: expected a list of recordings, one of each gyroscope"),
    ("simulate_array(axes=2)", "axes 2: expected 1 or 3"),
    ("simulate_array(fault=[3])", "simulate_array: fault: expected a list"),
    ('simulate_array("static")', "simulate_array: too many positional arguments"),
    ('simulate_array(spread=("a","b"))', "simulate_array: spread: expected 2 numbers or a text"),
    ("allan_deviation(np.ones(50), nan)", "allan_deviation: rate: expected a number"),
    ("allan_deviation(np.ones(50),10., taus=[np.nan])", "taus: expected finite averaging times"),
    ('allan_deviation(np.array(["a"]*5), 10.)', "data: expected an array of numbers, a row for each sample"),
    ('allan_deviation(still, column="gyro_1", window=("a",1))', "allan_deviation: window: expected"),
    (
        "allan_deviation(np.ones(50), 10., window=(1,2))",
        "window does not go with such data: samples have their rate alone",
    ),
    ('fit_noise(still, terms="x")', "terms 'x': expected auto, or N and any of the others, each once, G up"),
    ("fit_noise(still, terms=3)", "fit_noise: terms: expected a text"),
    ('fit_noise(still, horizon="10 m")', "horizon '10 m': expected a number, or one with a unit of time"),
    ("fit_noise(still, horizon=nan)", "horizon nan s: expected more than 0"),
    ('fit_noise(still, band="x")', "band 'x': expected a number"),
    ('fit_noise(still, columns="gyro_9")', "no column 'gyro_9'; expected one of"),
    ("fit_noise(still, columns=[])", "columns: expected one or more"),
    ("fit_noise(still, steps=3)", "fit_noise: steps: expected a text"),
    ("fit_noise([still,3])", "data: expected an array of numbers, a row for each sample"),
    ("fit_noise(still, horizn=3)", "fit_noise: unknown option 'horizn'"),
    ("fit_noise([pd.DataFrame()])", "frame: expected data"),
    ("fit_warmup(cyc[0])", "cycles: expected a list of power cycles, one for each test"),
    ('fit_warmup(cyc, temperatures=["a","b"])', "fit_warmup: temperatures: expected numbers"),
    ('fit_warmup(cyc, temperatures=(-40,0,60), settling_time="x")', "settling_time 'x': expected a number"),
    (
        "fit_warmup(cyc, temperatures=(-40,0,60), settling_limit=3)",
        "fit_warmup: settling_limit: expected a mapping from names",
    ),
    (
        'fit_warmup(cyc, temperatures=(-40,0,60), settling_limit={"gyro":"x"})',
        "fit_warmup: settling_limit['gyro']: expected a number",
    ),
    ("fit_warmup(cyc, temperatures=(-40,0,60), axes=3)", "fit_warmup: axes: expected a text or a list of texts"),
    ('fit_warmup(cyc, temperatures=(-40,0,60), axes="gyro_x,")', "axes 'gyro_x,': expected names of columns"),
    (
        'fit_warmup(cyc, temperatures=(-40,0,60), settling_limit={"foo":1.})',
        "settling_limit 'foo': expected limits for gyro accel",
    ),
    ("find_power_cycle(3)", "recording: expected a recording or a list of recordings"),
    ('find_power_cycle("rec.csv")', "recording: expected a recording or a list of recordings"),
    ("find_power_cycle([3])", "recording: expected a recording or a list of recordings"),
    ("plan_warmup(3)", "plan_warmup: temperatures: expected numbers or a text"),
    ("plan_warmup(start=nan)", "plan_warmup: start: expected a number"),
    ("warmup_table(rec)", "a tumble record has no warm-up table"),
    ('warmup_table(warm.calibration, per_second="x")', "warmup_table: per_second: expected True or False"),
    ('simulate_power_cycle("x")', "simulate_power_cycle: temperature: expected a number"),
    ('simulate_power_cycle(20, sample_rate="10 Hz")', "simulate_power_cycle: sample_rate: expected a number"),
    ("simulate_power_cycle(20, seed=-1)", "seed -1: expected 0 or more"),
    ("simulate_power_cycle(20, random_walk=-1)", "random_walk -1: expected 0 or more"),
    ('fit_centrifuge("rec.csv")', "the manifest file is not TOML: Expected '=' after a key in a"),
    ('fit_centrifuge("plan.toml", method=3)', "fit_centrifuge: method: expected a text"),
    ('fit_centrifuge("plan.toml", 3)', "fit_centrifuge: recording_of: expected a function"),
    ('load_manifest("dir")', "dir: expected a manifest file"),
    ('plan_centrifuge(["a"])', "plan_centrifuge: levels: expected numbers or a text"),
    ('plan_centrifuge(both_senses="x")', "plan_centrifuge: both_senses: expected True or False"),
    ("plan_centrifuge(static_duration=-5.)", "static duration -5: expected 0 or more"),
    ("simulate_centrifuge(truth=3)", "simulate_centrifuge: truth: expected a truth"),
    ('simulate_centrifuge(ramp="x")', "simulate_centrifuge: ramp: expected a number"),
    ('read("dir")', "dir: expected a file"),
    ('read("rec.csv", 3)', "read: layout: expected a layout or the name of its file"),
    ('read("rec.csv", instance="a")', "instance 'a': expected a whole number, or all"),
    ('read("rec.csv", window=3)', "read: window: expected"),
    ('read("rec.csv", wndow=3)', "read: unknown option 'wndow'"),
    ('list(read_blocks("rec.csv", window=("a",1)))', "read_blocks: window: expected"),
    ('read("rec.csv", window=(1,2,3))', "read: window: expected"),
    ('write(r, "dir")', "dir: cannot write this kind of file"),
    ('write([3], "x.csv")', "write: blocks: expected a recording or a list of recordings"),
    ('write([], "x.csv")', "expected a Recording to write"),
    ('write_csv(rec, "x.csv")', "blocks: expected a recording or a list of recordings"),
    ("apply(r, rec)", "record: expected a record or a blob or the name of its file"),
    ("apply(rec)", "apply: missing a required argument: 'data'"),
    ('apply(rec, r, again="x")', "apply: again: expected True or False"),
    ('apply("dir", r)', "dir: expected a file, found a folder"),
    ('load("dir")', "dir: expected a file, found a folder"),
    ("load()", "load: missing a required argument: 'path'"),
    ('export("c", [3], "out")', "records: expected a record or a list or the name of its file"),
    ('export("c", 3, "out")', "records: expected a record or a list or the name of its file"),
    ('export("c", rec, 3)', "export: folder: expected the name of a folder"),
    ('export("c", [], "out")', "export: records: expected one or more"),
    ('export("px4", rec, "out", device_id=-1)', "device_id -1: expected a number from 0 to 4294967295"),
    ('export("c", rec, "out", tell=3)', "export: tell: expected a function"),
    ('export("c", r, "out")', "records: expected a record or a list or the name of its file"),
    ('export("kalibr", rec, "out", noise={"a":1})', "the noise: lacks 'columns'"),
    ('write_report(3, "x.html")', "record: expected a record or the name of its file"),
    ('write_report(rec, "dir")', "dir: expected the name of a file to write"),
    ("compare_records(rec)", "compare_records: missing a required argument: 'second'"),
    ('compare_records("dir", rec)', "dir: expected a file, found a folder"),
    ("normal_gravity([48])", "latitude [48]: expected a number"),
    ('normal_gravity("48 deg", "520 s")', "height '520 s'"),
    ("normal_gravity(48, hight=3)", "normal_gravity: unknown option 'hight'"),
    ('run_fleet(3, "out")', "manifest: expected a fleet manifest or the name of its file"),
    ('run_fleet("rec.csv","out",engine=3)', "run_fleet: engine: expected a text"),
    ('run_fleet("rec.csv","out",progress=3)', "run_fleet: progress: expected a function"),
    ("fleet_status(3)", "fleet_status: folder: expected the name of a folder"),
    ('fleet_status("dir")', "expected a folder that 'imulab fleet run' has written to"),
    ('write_fleet_report("dir","x.html", limits=3)', "write_fleet_report: limits: expected the name of a file"),
    ('simulate_fleet("fl", units=0)', "units 0: expected 8 to 2000"),
    ("f.plot(3.5)", "plot 3.5: expected a number from 0 to 3"),
    ("f.report(3)", "Result.report: path: expected the name of a file"),
    ("f.cov(3)", "the record lacks the covariance of 3"),
    ("Calibration.load(3)", "Calibration.load: path: expected the name of a file"),
    ("rec.apply(r, again=3)", "Calibration.apply: again: expected True or False"),
    ('rec.export("c")', "Calibration.export: missing a required argument: 'folder'"),
    ('rec.export("c", 3)', "Calibration.export: folder: expected the name of a file"),
    ("r.plot(3.5)", "plot 3.5: expected a number from 0 to 3"),
    ("r.with_columns(3, {})", "columns: expected a mapping from names"),
    ('r.with_columns({"a": 3}, {})', "columns['a']: expected an array of numbers, shape"),
    ('Recording({"accel_x":[1,2]}, {"accel_x":"g"})', "columns['accel_x']: expected an array of numbers, shape"),
    ('Recording({"accel_x":np.ones(3)}, {"accel_x":3})', "units['accel_x']: expected a text"),
    ("Recording.from_arrays(np.ones((3,3)))", "Recording.from_arrays: too many positional arguments"),
    ('Recording.from_arrays(accel=np.ones((3,3)), unit="g", metadata={"a":3})', "metadata['a']: expected a text"),
    ('Recording.from_frame(frame, "g")', "Recording.from_frame: units: expected a mapping from names"),
    (
        'Recording({"accel_x":np.ones((3,2))}, {"accel_x":"g"})',
        "columns['accel_x']: expected an array of numbers, shape",
    ),
]
"""What a person writes, and how the sentence goes on that answers it."""


@pytest.fixture(scope="module")
def names(recording, fit, tmp_path_factory):
    """What the calls are made of, and a folder with the files that they name."""
    folder = tmp_path_factory.mktemp("wrong")
    (folder / "dir").mkdir()
    (folder / "text.txt").write_text("hello\nworld\n")
    (folder / "empty.csv").write_text("")
    il.write(recording, folder / "rec.csv")
    il.plan_centrifuge("1,10", cycles=1).save(folder / "plan.toml")
    still = il.simulate_array(experiment="static", duration=30.0)
    cycles = il.simulate_warmup([-40, 0, 60], cycles=2, duration="400 s", rate="2 Hz")
    frame = recording.to_frame()
    return folder, {name: getattr(il, name) for name in il.__all__} | {
        "np": np, "pd": pd, "pl": pl, "nan": np.nan, "r": recording, "f": fit, "rec": fit.calibration,
        "at": il.find_attitudes(recording), "still": still, "board": il.simulate_array(duration=20.0), "cyc": cycles,
        "warm": il.fit_warmup(cycles, temperatures=(-40, 0, 60), model="knot-cubic"), "frame": frame,
        "bare": frame.rename(columns=lambda title: title.split(" [")[0]),
    }  # fmt: skip


@pytest.mark.parametrize(("call", "words"), CALLS, ids=[call for call, _ in CALLS])
def test_a_wrong_call_ends_in_one_sentence(call, words, names, monkeypatch):
    folder, known = names
    monkeypatch.chdir(folder)
    before = sorted(folder.rglob("*"))
    with pytest.raises(il.ImulabError) as caught:
        eval(call, dict(known))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert sorted(folder.rglob("*")) == before


def test_a_checked_function_is_what_it_was():
    assert pickle.loads(pickle.dumps(il.fit_tumble)) is il.fit_tumble
    assert inspect.signature(il.fit_tumble) == inspect.signature(fit_tumble)
    assert il.normal_gravity(np.int64(1)) == il.normal_gravity(latitude=1.0)


@pytest.mark.parametrize(
    ("hint", "good", "bad"),
    [
        (float, [1, 2.5, np.float32(1), np.int64(3), np.inf], [True, "1", np.nan, [1.0], None, 1j, np.ones(1)]),
        (int, [3, np.int8(3)], [3.0, True, "3"]),
        (bool, [True, np.bool_(False)], [0, "no", None]),
        (float | None, [None, 1.0], ["x"]),
        (Sequence[float], [[1, 2.0], (), np.ones(3), {1.0}], ["12", [1, "a"], 3, {"a": 1.0}, [np.nan]]),
        (tuple[float, float], [(1, 2), [1, 2], np.ones(2)], [(1,), (1, 2, 3), ("a", 2), 3]),
        (Sequence[str], [["a"], ("a", "b")], ["a", [1], None]),
        (Mapping[str, float], [{}, {"a": 1}], [{"a": "x"}, [1]]),
        (Callable[[int], None], [print], [3]),
        (Iterable[il.Recording], [[], iter([3])], [[3], "x", pd.DataFrame({"a": [1.0]})]),
        (str | PathLike[str], ["x", Path("x")], [3, b"x", None]),
        (Array, [np.ones(3), [1, 2]], [["a"], [[1], [1, 2]]]),
        (Any, [None, 3], []),
    ],
)
def test_a_value_fits_its_annotation_or_does_not(hint, good, bad):
    for value in good:
        arguments.check(value, hint, "f: x")
    for value in bad:
        with pytest.raises(il.ImulabError, match=r"^f: x(\['a'\])?: expected .*, found "):
            arguments.check(value, hint, "f: x")

"""``imulab array``: files and streams, what is printed, and what is refused."""

import json
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.device import METHODS
from imulab.device.tables import Fusion
from imulab.display import Note
from imulab.procedures.gyro_array.compare import compare_methods, run_experiment
from imulab.procedures.gyro_array.fit import calibrate_array
from imulab.procedures.gyro_array.fuse import Fuser, fuse
from imulab.procedures.gyro_array.simulate import Fault, simulate_array
from imulab.procedures.gyro_array.stream import FuseOptions
from imulab.procedures.views import exhibits_of
from test_gyro_array_fuse import array_recording, dynamic

G = 9.80665


@pytest.fixture(scope="module")
def run_file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("array")
    faults = (Fault("stuck", 3, 10.0, 5.0), Fault("jump", 5, 20.0))
    il.write_csv(simulate_array(duration=40.0, fault=faults, seed=3), folder / "run.csv")
    il.write_csv(simulate_array(experiment="static", duration=60.0, seed=3, session=1), folder / "still.csv")
    calibrate_array(il.read(folder / "still.csv")).calibration.save(folder / "array.json")
    return folder


def test_the_way_from_simulation_to_comparison(imulab, tmp_path):
    array = ["--seed", "4", "--mounting", "alternate", "--scale-spread", "0.01"]
    steps = [
        ["simulate", "--experiment", "static", "--duration", "60 s", *array, "-o", "still.csv"],
        ["simulate", "--experiment", "moving", *array, "-o", "moving.csv"],
        ["simulate", "--duration", "20 s", *array, "--fault", "stuck:2:10", "-o", "run.csv"],
        ["calibrate", "still.csv", "--moving", "moving.csv", "-o", "a.json", "--report", "a.html"],
        ["fuse", "run.csv", "--calibration", "a.json", "-o", "fused.csv"],
        ["compare", "run.csv", "--calibration", "a.json", "-o", "c.json", "--report", "c.html"],
    ]
    for arguments in steps:
        done = imulab("array", *arguments)
        assert done.returncode == 0, done.stderr
    fused, run = il.read(tmp_path / "fused.csv"), il.read(tmp_path / "run.csv")
    assert list(fused.columns) == ["time", "rate"]
    assert fused.units == {"time": "s", "rate": "deg/s"}
    assert fused.metadata["serial"] == "ARRAY-0004"
    np.testing.assert_array_equal(fused.columns["time"], run.columns["time"])
    assert (fused.columns["rate"] - run.columns["truth_rate"]).std() < 0.03
    for name in ("a.json", "c.json"):
        assert imulab("show", name).returncode == 0
        assert imulab("report", name, "-o", "again.html").returncode == 0
    printed = imulab("array", "calibrate", "still.csv", "--json")
    assert json.loads(printed.stdout)["procedure"] == "gyro_array"
    refused = imulab("array", "fuse", "run.csv", "--calibration", "c.json")
    assert refused.returncode == 2
    assert "c.json: expected the record of an array calibration, found one of a comparison" in refused.stderr


def test_what_happened_to_a_gyro_is_one_line_that_names_its_column(imulab, run_file):
    done = imulab("array", "fuse", run_file / "run.csv")
    assert done.returncode == 0
    lines = done.stderr.splitlines()
    assert len(lines) == 2
    assert lines[0].startswith("imulab: warning: gyro_3: stuck 2")
    assert "from 10.5 s" in lines[0]
    assert lines[1].startswith("imulab: warning: gyro_5: jumped 51 samples from 20.4")
    assert done.stdout.splitlines()[9].startswith("time [s],rate [deg/s]")


def test_the_verdict_is_printed_first_where_the_rate_goes_to_a_file(imulab, run_file, tmp_path):
    done = imulab("array", "fuse", run_file / "run.csv", "-o", tmp_path / "out.csv")
    assert done.stdout.startswith("look: understand this before you use the result: gyro_3: stuck 2")
    assert [line.partition(":")[0] for line in done.stdout.splitlines()] == ["look", "next"]
    good = simulate_array(duration=20.0, seed=2)
    il.write_csv(good, tmp_path / "good.csv")
    done = imulab("array", "fuse", tmp_path / "good.csv", "-o", tmp_path / "out.csv")
    assert done.stdout == "good: nothing in the data speaks against this result\n"


@pytest.mark.parametrize(
    ("elements", "rate", "words"),
    [
        (2, 100.0, ["method feedback with 2 gyros on each axis: its source states it for more than 3, and no gyro"]),
        (3, 100.0, ["method feedback with 3 gyros on each axis: its source states it for more than 3"]),
        (4, 100.0, []),
        (6, 400.0, ["method feedback at 400 Hz: its source states it for 50 to 200 Hz"]),
        (6, 20.0, ["method feedback at 20 Hz"]),
        (6, 50.0, []),
        (6, 200.0, []),
    ],
)
def test_feedback_says_where_its_source_does_not_reach(elements, rate, words):
    run = simulate_array(elements=elements, rate=rate, duration=30.0, seed=3)
    still = simulate_array(experiment="static", elements=elements, rate=rate, duration=30.0, seed=3)
    said = [fuse(run, FuseOptions(method="feedback")).notes, compare_methods(run).warnings]
    said.append(calibrate_array(still, fusion=Fusion("feedback")).calibration.warnings)
    for found in said:
        mine = [line for line in found if "method feedback" in line]
        assert len(mine) == len(words)
        assert all(word in line and isinstance(line, Note) for word, line in zip(words, mine, strict=True))
    assert not [line for line in fuse(run, FuseOptions(method="mean")).notes if "method feedback" in line]


def test_compare_runs_with_the_memory_that_is_given(imulab, run_file, tmp_path):
    done = imulab("array", "compare", run_file / "run.csv", "--memory", "0.05", "-o", tmp_path / "c.json")
    assert done.returncode == 0, done.stderr
    record = il.load(tmp_path / "c.json")
    assert record.model["memory"] == "memory 0.05"
    plain = compare_methods(il.read(run_file / "run.csv")).record
    mine, other = (r.data["figures"]["feedback"][0]["rate_std"] for r in (record, plain))
    assert mine != other


def test_lines_are_fused_as_they_come(run_file):
    lines = (run_file / "run.csv").read_bytes().splitlines(keepends=True)
    head = next(i for i, line in enumerate(lines) if line.startswith(b"time")) + 1
    process = subprocess.Popen(
        [sys.executable, "-m", "imulab", "array", "fuse", "-"], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE
    )  # fmt: skip
    got = []
    process.stdin.write(b"".join(lines[:head]))
    for k in range(60):
        process.stdin.write(lines[head + k])
        process.stdin.flush()
        if k == 0:
            while not (line := process.stdout.readline()).startswith(b"time"):
                assert line.startswith(b"#")
        got.append(process.stdout.readline())  # blocks until this very line has been fused
    time.sleep(0.01)
    assert process.poll() is None
    out, _ = process.communicate(b"".join(lines[head + 60 : head + 1000]), timeout=60)
    got += out.splitlines(keepends=True)
    assert len(got) == 1000
    whole = fuse(il.read(run_file / "run.csv")).rate[:, 0]
    np.testing.assert_array_equal([float(line.split(b",")[1]) for line in got], whole[:1000])


def test_a_stream_tells_of_a_gyro_at_once_and_sums_up_at_its_end(imulab_process, run_file):
    done = imulab_process("array", "fuse", "-", "--rate", "50 Hz", stdin=(run_file / "run.csv").read_text())
    lines = [line.removeprefix("imulab: warning: ") for line in done.stderr.splitlines()]
    assert "gyro_3: stuck at 10.5 s" in lines
    assert lines.index("gyro_3: stuck at 10.5 s") < lines.index("gyro_5: jumped at 20.48 s")
    assert sum(line.endswith("(of 2000 samples)") for line in lines) == 2


def test_a_record_of_another_array_is_said_once_of_a_file_and_of_a_stream(imulab_process, tmp_path):
    array = simulate_array(experiment="static", duration=60.0)
    il.calibrate_array(replace(array, metadata={"serial": "A1"})).calibration.save(tmp_path / "a1.json")
    il.write_csv(replace(array, metadata={"serial": "A2"}), tmp_path / "a2.csv")
    text = (tmp_path / "a2.csv").read_text()
    for name, pipe in ((str(tmp_path / "a2.csv"), None), ("-", text)):
        words = ("--calibration", str(tmp_path / "a1.json"), "-o", str(tmp_path / "out.csv"))
        done = imulab_process("array", "fuse", name, *words, stdin=pipe)
        assert done.stderr.count("serial A2, but the record was made for A1") == 1, done.stderr


def test_a_reader_that_goes_away_ends_it_quietly(run_file):
    shell = f"{sys.executable} -m imulab array fuse {run_file / 'run.csv'} | head -3"
    done = subprocess.run(["sh", "-c", shell], capture_output=True, text=True, check=False, timeout=60)
    assert len(done.stdout.splitlines()) == 3
    assert "Traceback" not in done.stderr


def test_readings_may_be_nan_inf_or_missing(imulab, tmp_path):
    recording = array_recording(dynamic(count=200)[0])
    il.write_csv(recording, tmp_path / "a.csv")
    lines = (tmp_path / "a.csv").read_text().splitlines()
    fields = [line.split(",") for line in lines]
    fields[51][2], fields[61][3], fields[71][4] = "nan", "inf", ""
    fields[81][1:] = [""] * 6
    (tmp_path / "b.csv").write_text("\n".join(",".join(f) for f in fields) + "\n")
    done = imulab("array", "fuse", "b.csv", "-o", "out.csv")
    assert done.returncode == 0, done.stderr
    rate = il.read(tmp_path / "out.csv").columns["rate"]
    assert np.flatnonzero(np.isnan(rate)).tolist() == [80]
    for name in ("gyro_2", "gyro_3", "gyro_4"):
        assert f"{name}: non-finite 2 samples" in done.stderr


def test_every_method_and_start_runs(imulab, run_file):
    record = run_file / "array.json"
    for method in ("feedback", "covariance", "kalman"):  # the others run in test_compare_prints_all_seven
        extra = ["--calibration", record] if method in ("covariance", "kalman") else ["--initial-bias", "zero"]
        done = imulab("array", "fuse", run_file / "run.csv", "--method", method, *extra)
        assert done.returncode == 0, done.stderr
        assert len(done.stdout.splitlines()) == 2000 + 10
    options = ["--method", "feedback", "--memory", "growing:100", "--initial-bias", record]
    assert imulab("array", "fuse", run_file / "run.csv", *options).returncode == 0


def test_parquet_comes_out_the_same(imulab, run_file, tmp_path):
    assert imulab("array", "fuse", run_file / "run.csv", "-o", "a.parquet").returncode == 0
    assert imulab("array", "fuse", run_file / "run.csv", "-o", "a.csv").returncode == 0
    csv, parquet = il.read(tmp_path / "a.csv"), il.read(tmp_path / "a.parquet")
    assert parquet.units == csv.units
    assert parquet.metadata == csv.metadata
    np.testing.assert_array_equal(parquet.columns["rate"], csv.columns["rate"])


def test_three_axes_come_out_as_three_columns_in_their_unit(imulab, tmp_path):
    il.write_csv(simulate_array(axes=3, duration=4.0, unit="rad/s"), tmp_path / "a.csv")
    done = imulab("array", "fuse", "a.csv", "-o", "out.csv")
    assert done.returncode == 0
    assert il.read(tmp_path / "out.csv").units == {"time": "s", "rate_x": "rad/s", "rate_y": "rad/s", "rate_z": "rad/s"}


# ---- compare --------------------------------------------------------------------------------------------------------


def test_compare_prints_all_seven_in_plain_decimals(imulab, run_file):
    done = imulab("array", "compare", run_file / "run.csv")
    assert done.returncode == 0, done.stderr
    rows = {line.split()[0]: line.split()[1:] for line in done.stdout.splitlines() if line.split()[:1]}
    assert set(METHODS) <= set(rows)
    assert "covariance cannot run: method covariance needs --calibration" in done.stdout
    for method in METHODS:
        if method == "covariance":
            continue
        for value in rows[method][:7]:
            assert "e" not in value
            assert sum(c.isdigit() for c in value.lstrip("0.")) >= 3


def test_compare_finds_errors_reduction_and_limit():
    recording = array_recording(dynamic()[0])
    _, truth, sigma = dynamic()
    with_truth = recording.with_columns({"truth_rate": np.radians(truth)}, {"truth_rate": "rad/s"})
    found = compare_methods(with_truth).figures
    mean = found["mean"][0]
    error = np.mean([recording.columns[f"gyro_{i + 1}"] for i in range(6)], axis=0) - truth
    assert mean.rate_std == pytest.approx(error.std(), rel=1e-12)
    assert mean.rate_max == pytest.approx(np.abs(error).max(), rel=1e-12)
    assert mean.angle_max == pytest.approx(np.abs(np.cumsum(error) / 50).max(), rel=1e-12)
    limit = np.sum(sigma**-2) ** -0.5
    assert found["robust"][0].over_limit == pytest.approx(1.0, abs=0.04)
    assert mean.over_limit == pytest.approx(np.sqrt(np.mean(sigma**2) / 6) / limit, rel=0.06)
    assert mean.reduction == pytest.approx(np.mean(sigma) / mean.rate_std, rel=0.05)


def test_compare_measures_bandwidth_and_warns_of_filtering(monkeypatch):
    from imulab.procedures.gyro_array import stream

    recording = simulate_array(experiment="static", duration=200.0, seed=2)
    found = compare_methods(recording)
    assert found.figures["mean"][0].bandwidth == 50.0
    assert not any("mean:" in message for message in found.warnings)
    slow = np.radians(0.05)  # process noise of a unit that hardly moves
    monkeypatch.setattr(stream, "RATE_WALK", slow)
    real = stream.steady_gain
    gains = []

    def narrow(white, walk, rate_walk, step):
        gains.append(real(white, walk, np.degrees(slow), step))
        return gains[-1]

    monkeypatch.setattr(stream, "steady_gain", narrow)
    filtered = compare_methods(recording)
    gain = gains[0][0].sum()
    # A first-order recursive filter with gain K has its -3 dB point where |K / (1 - (1 - K) e^-jw)|^2 = 1/2.
    cosine = (1 + (1 - gain) ** 2 - 2 * gain**2) / (2 * (1 - gain))
    expected = np.arccos(cosine) / (2 * np.pi) * 100
    kalman_row = filtered.figures["kalman"][0]
    assert kalman_row.bandwidth == pytest.approx(expected, rel=0.1)
    assert kalman_row.rate_std < 0.7 * filtered.figures["robust"][0].rate_std
    assert any(message.startswith("kalman: its bandwidth is") for message in filtered.warnings)


def at_rest(rate: float = 100.0) -> np.ndarray:
    """Readings of four gyros at rest, deg/s, with biases of 0.1 to 0.4."""
    return 0.1 * np.arange(1, 5) + 0.05 * np.random.default_rng(1).standard_normal((3000, 4))


def test_compare_measures_against_the_gyros_that_work():
    # The mean of all would be the size of the fault: "53 times quieter" than a dead gyro in motion.
    faults = (Fault("stuck", 3, 10.0, 20.0), Fault("jump", 5, 40.0))
    broken = compare_methods(simulate_array(duration=60.0, fault=faults, seed=2))
    whole = compare_methods(simulate_array(duration=60.0, seed=2))
    assert broken.record.data["working"] == [["gyro_1", "gyro_2", "gyro_4", "gyro_6"]]
    assert whole.record.data["working"] == [[f"gyro_{i}" for i in range(1, 7)]]
    readings = simulate_array(duration=60.0, seed=2)
    singles = [np.std(readings.columns[n] - readings.columns["truth_rate"]) for n in ("gyro_1", "gyro_2", "gyro_4",
                                                                                    "gyro_6")]  # fmt: skip
    assert broken.record.data["single"][0] == pytest.approx(np.mean(singles), rel=1e-9)
    assert broken.figures["robust"][0].reduction == pytest.approx(whole.figures["robust"][0].reduction, rel=0.25)
    assert broken.figures["mean"][0].reduction < 0.2
    assert 0.99 < broken.figures["robust"][0].over_limit < 1.1
    assert "than the mean single gyro that works (gyro_3, gyro_5 did not)" in exhibits_of(broken.record).headline
    assert "than the mean single gyro;" in exhibits_of(whole.record).headline


def test_a_record_of_another_array_is_warned_of_by_fuse_and_compare(tmp_path):
    array = {"mounting": "alternate", "scale_spread": 0.01}
    still, moving, run = (
        simulate_array(experiment=name, duration=30.0, seed=1, **array) for name in ("static", "moving", "dynamic")
    )
    record = calibrate_array(still, moving).calibration
    assert compare_methods(run, calibration=record).record.verdict.state == "good"
    assert not il.fuse(run, calibration=record).notes
    other = replace(simulate_array(duration=30.0, seed=8), name="other.csv")  # not mounted the same way
    serial = "other.csv: serial ARRAY-0008, but the record was made for ARRAY-0001"
    mounting = "other.csv: in motion gyro_2 gyro_4 gyro_6, corrected by the record, differ from gyro_1 by up to 20"
    compared = compare_methods(other, calibration=record)
    assert serial in compared.record.verdict.reasons
    assert any("about the robust rate by 8.8" in reason for reason in compared.record.verdict.reasons)
    assert serial in il.fuse(other, initial_bias=record).notes
    il.export("blob", record, tmp_path)
    assert il.fuse(other, calibration=tmp_path / "unit.blob").notes[0] == serial
    nameless = replace(other, metadata={})
    for lines in (compared.warnings, il.fuse(nameless, calibration=record).notes):
        assert [line for line in lines if line.startswith(mounting)]
    assert il.fuse(nameless, calibration=record).notes[0].startswith(mounting)


def test_compare_asks_to_look_where_fuse_does():
    run = simulate_array(duration=40.0, seed=3, fault=(Fault("stuck", 3, 10.0, 5.0), Fault("jump", 5, 20.0)))
    compared = compare_methods(run)
    assert compared.record.verdict.state == "look"
    reasons = compared.record.verdict.reasons
    assert [r.split(":")[0] for r in reasons if "excluded" in r] == ["gyro_3", "gyro_5"]
    assert [line for line in fuse(run).health.lines() if line not in reasons] == []


def test_compare_says_where_a_record_no_longer_holds():
    still = simulate_array(experiment="static", duration=30.0, seed=1)
    run = simulate_array(duration=30.0, seed=1)
    gyro_2 = {"gyro_2": 1.2 * run.columns["gyro_2"], "gyro_4": 0.9 * run.columns["gyro_4"]}
    changed = replace(run, columns={**run.columns, **gyro_2, "gyro_6": 1.1 * run.columns["gyro_6"]})
    record = calibrate_array(still).calibration
    for recording, count in ((run, 0), (changed, 1)):
        lines = compare_methods(recording, calibration=record).record.verdict.reasons
        assert len([line for line in lines if "the record does not hold for this recording" in line]) == count


def test_compare_says_who_follows_a_dead_gyro(imulab, tmp_path):
    readings = at_rest()
    readings[:, 1] = 0.25
    found = compare_methods(array_recording(readings, 100.0))
    assert found.record.data["working"] == [["gyro_1", "gyro_3", "gyro_4"]]
    assert found.record.data["single"][0] == pytest.approx(readings[:, [0, 2, 3]].std(axis=0).mean(), rel=1e-9)
    assert found.figures["feedback"][0].reduction is None  # all the weight is the dead gyro's
    assert found.figures["robust"][0].over_limit == pytest.approx(1.0, abs=0.03)
    assert "mean: it follows only 0.75 ± 0.01 of a motion: gyro_2 does not move and counts in it" in found.warnings
    assert not any(message.startswith("robust:") for message in found.warnings)
    il.write_csv(array_recording(readings, 100.0), tmp_path / "dead.csv")
    printed = imulab("array", "compare", "dead.csv").stdout
    assert f"mean of the 3 that work (not gyro_2): {found.record.data['single'][0]:.5f} deg/s" in printed
    assert max(map(len, " ".join(printed.split("single gyro")[0].split("method")[1].split()).split())) < 14


def test_compare_runs_with_readings_that_are_no_numbers(imulab, tmp_path):
    readings = at_rest()
    readings[:, 1] = np.nan
    readings[100:140, 0] = np.inf
    readings[200] = np.nan
    il.write_csv(array_recording(readings, 100.0), tmp_path / "n.csv")
    done = imulab("array", "compare", "n.csv")
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    rows = {line.split()[0]: line.split()[1:] for line in done.stdout.splitlines() if line.split()[:1]}
    assert set(METHODS) <= set(rows)
    assert "(feedback cannot run: its output is no number from 0 s on: a reading that is none spoils it)" in done.stdout
    assert float(rows["robust"][0]) == pytest.approx(0.05 / np.sqrt(3), rel=0.06)
    assert "mean of the 3 that work (not gyro_2)" in done.stdout
    il.write_csv(array_recording(np.full((600, 4), np.nan), 100.0), tmp_path / "none.csv")
    none = imulab("array", "compare", "none.csv")
    assert (none.returncode, none.stdout, none.stderr.count("\n")) == (2, "", 1)
    assert "none.csv: columns gyro_1 to gyro_4: expected finite readings, found none" in none.stderr


def test_compare_warns_where_noise_below_the_limit_is_a_filter_whose_bandwidth_does_not_show():
    # A first-order filter of gain K > 0.83 never falls to -3 dB, and is quieter than any weights all the same.
    readings = 0.2 * np.random.default_rng(5).standard_normal((4000, 6)) * np.linspace(0.8, 1.2, 6)
    found = compare_methods(array_recording(readings, 62.5))
    kalman = found.figures["kalman"][0]
    assert kalman.over_limit < 0.97
    (message,) = [m for m in found.warnings if m.startswith("kalman:")]
    assert "low-pass filtering, which does not lower the angle error" in message
    assert not any(m.startswith(("mean:", "robust:", "least-squares:")) for m in found.warnings)


def test_gyros_mounted_the_other_way_round_are_named(imulab, tmp_path):
    array = {"seed": 3, "mounting": "alternate"}
    run, still = simulate_array(duration=10.0, **array), simulate_array(experiment="static", duration=60.0, **array)
    named = "run.csv: gyro_2 gyro_4 gyro_6 turn against the first gyro of the axis"
    il.write_csv(run, tmp_path / "run.csv")
    calibrate_array(still, simulate_array(experiment="moving", **array)).calibration.save(tmp_path / "aligned.json")
    calibrate_array(still).calibration.save(tmp_path / "biases.json")
    for extra, expected in (
        ([], True),
        (["--calibration", "biases.json"], True),
        (["--calibration", "aligned.json"], False),
    ):
        for command in ("fuse", "compare"):
            done = imulab("array", command, "run.csv", *extra)
            assert done.returncode == 0, done.stderr
            assert (named in done.stderr) == expected
    assert Fuser(FuseOptions()).notes() == []
    fuser = Fuser(FuseOptions())
    list(fuser.fuse([simulate_array(duration=10.0, seed=3)]))
    assert fuser.notes() == []
    list((rest := Fuser(FuseOptions())).fuse([still]))
    assert rest.notes() == []


def test_clocks_of_their_own_are_brought_to_one_everywhere():
    def skewed(recording):
        clocks = {f"time_{i}": recording.columns["time"] + 0.002 * i for i in range(1, 7)}
        return recording.with_columns(clocks, dict.fromkeys(clocks, "s"))

    array = {"seed": 5, "scale_spread": 0.01}
    still = skewed(simulate_array(experiment="static", duration=60.0, **array))
    moving = simulate_array(experiment="moving", **array)
    late = {  # each element samples the motion when its own clock says so
        f"gyro_{i}": np.interp(moving.columns["time"] + 0.002 * i, moving.columns["time"], moving.columns[f"gyro_{i}"])
        for i in range(1, 7)
    }
    moving = skewed(moving.with_columns(late, dict.fromkeys(late, "deg/s")))
    record = calibrate_array(still, moving).calibration
    residual = max(np.degrees(e["residual"]["value"]) for e in record.sections["elements"])
    assert residual < 0.2  # 60 deg/s at 0.8 Hz are 0.6 deg/s in 2 ms
    assert len(compare_methods(still, calibration=record).figures["robust"]) == 1


def test_compare_without_truth_uses_the_longest_stretch_at_rest():
    still = simulate_array(experiment="static", duration=20.0, seed=1).columns["gyro_1"]
    rng = np.random.default_rng(1)
    motion = np.zeros(6000)
    motion[1000:2500] = 30 * np.sin(np.arange(1500) / 40)
    readings = motion[:, None] + 0.05 * rng.standard_normal((6000, 6))
    found = compare_methods(array_recording(readings, 100.0))
    assert found.record.fit["samples"] == 3500
    assert any("longest stretch at rest, 25 to 59.99 s" in message for message in found.warnings)
    assert len(still) == 2000


def test_compare_refuses_motion_without_truth():
    readings = 30 * np.sin(np.arange(3000) / 40)[:, None] + 0.05 * np.random.default_rng(1).standard_normal((3000, 6))
    from imulab.errors import DataError

    with pytest.raises(DataError, match="neither a column truth_rate nor a stretch of 5 s at rest"):
        compare_methods(array_recording(readings, 100.0))


def test_the_report_of_a_comparison_comes_from_its_record():
    faults = (Fault("stuck", 2, 5.0, 5.0), Fault("nan", 3, 2.0, 2.0), Fault("jump", 4, 12.0))
    record = compare_methods(simulate_array(duration=20.0, fault=faults)).record
    shown = exhibits_of(record)
    titles = [item.title for item in shown.items]
    assert titles == [
        "Methods", "Allan deviation of each method", "Angle error over time", "Weight and health of each gyro "
        "under robust",
    ]  # fmt: skip
    marks = {trace.get("name") for trace in shown.items[-1].traces}
    assert {"stuck", "non-finite", "jumped"} <= marks
    json.dumps(record.to_dict(), allow_nan=False)


@pytest.mark.slow
def test_the_source_s_dynamic_experiment():
    rows = {(r.method, r.calibrated): r for r in run_experiment("dynamic", seeds=6)}
    assert len(rows) == 13
    robust, mean, feedback = (rows[m, False] for m in ("robust", "mean", "feedback"))
    assert robust.rate_std < 0.95 * mean.rate_std
    assert feedback.rate_std > 1.1 * mean.rate_std  # here the source's claim does not hold
    assert rows["kalman", False].rate_std <= mean.rate_std
    assert rows["robust", True].angle_max < 0.5 * robust.angle_max


# ---- refusals -------------------------------------------------------------------------------------------------------

GOOD = array_recording(dynamic(count=300)[0])


def _text(recording=GOOD, **units) -> str:
    titles = ",".join(f"{n} [{units.get(n, u)}]" for n, u in recording.units.items())
    rows = zip(*(c.tolist() for c in recording.columns.values()), strict=True)
    return titles + "\n" + "\n".join(",".join(map(repr, row)) for row in rows) + "\n"


def _row(number: int, change) -> str:
    lines = _text().splitlines()
    lines[number] = change(lines[number])
    return "\n".join(lines) + "\n"


def _without(*names: str) -> str:
    kept = {n: c for n, c in GOOD.columns.items() if n not in names}
    return _text(type(GOOD)(kept, {n: GOOD.units[n] for n in kept}))


@pytest.mark.parametrize(
    ("text", "options", "fragments"),
    [
        (_without("gyro_3", "gyro_4", "gyro_5", "gyro_6"), [],
         ["robust needs 3 gyros on each axis, found 2 (gyro_1 gyro_2)"]),
        (_without("gyro_3", "gyro_4", "gyro_5", "gyro_6"), ["--method", "least-squares"],
         ["least-squares needs 3 gyros"]),
        (_text(gyro_4="rad/s"), [], ["must share one unit", "gyro_4 [rad/s]", "gyro_1 [deg/s]"]),
        (_without("time"), [], ["no column time"]),
        (_without("gyro_2"), [], ["no column gyro_2; expected 6 elements"]),
        (_text().replace("gyro_6 [", "gyro_0 [", 1), [], ["bad.csv: column gyro_0: expected elements numbered 1 2 3"]),
        (_without(*[f"gyro_{i}" for i in range(1, 7)]), [], ["no columns gyro_1 gyro_2 .. (one axis)", "found time"]),
        (_row(50, lambda r: r + ",1.0"), [], ["row 50 (line 51)", "expected 7 fields, found 8"]),
        (_row(50, lambda r: r.rsplit(",", 1)[0]), [], ["row 50 (line 51)", "expected 7 fields, found 6"]),
        (_row(50, lambda r: r.replace(",", ",x", 1)), [], ["row 50 (line 51)", "column gyro_1", "expected a number"]),
        (_row(50, lambda r: "0.5," + r.split(",", 1)[1]), [], ["row 50 (line 51)", "column time", "runs backwards"]),
        (_row(50, lambda r: "nan," + r.split(",", 1)[1]), [], ["row 50 (line 51)", "column time", "found nan"]),
        (None, ["--method", "median"],
         ["expected one of mean support least-squares feedback robust covariance kalman"]),
        (None, ["--memory", "1.5"], ["--memory '1.5'", "growing, growing:COUNT, or a gain between 0 and 1"]),
        (None, ["--initial-bias", "last"], ["--initial-bias 'last'", "first, zero, or the file of a record"]),
        (None, ["--method", "covariance"], ["covariance needs --calibration"]),
        (None, ["--calibration", "none.json"], ["none.json: no such file"]),
        (None, ["--calibration", "bad.csv"], ["bad.csv: not a calibration record"]),
        (None, ["-o", "out.txt"], ["out.txt", ".csv"]),
        (None, ["-o", "bad.csv"], ["bad.csv: would overwrite bad.csv"]),
        (None, ["--still", "5"], ["--still '5'", "FROM:TO"]),
    ],
)  # fmt: skip
def test_a_bad_input_gets_one_line_and_leaves_nothing(text, options, fragments, imulab, tmp_path):
    (tmp_path / "bad.csv").write_text(_text() if text is None else text)
    output = [] if "-o" in options else ["-o", "out.csv"]
    done = imulab("array", "fuse", "bad.csv", *options, *output)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("imulab: ")
    assert done.stderr.count("\n") == 1
    for fragment in fragments:
        assert fragment in done.stderr
    assert done.stdout == ""
    assert [p.name for p in tmp_path.iterdir()] == ["bad.csv"]


def test_a_record_that_does_not_fit_is_refused_with_both_names(imulab, run_file, tmp_path):
    record = run_file / "array.json"
    il.write_csv(simulate_array(elements=4, duration=2.0), tmp_path / "four.csv")
    (tmp_path / "raw.csv").write_text(_text(**dict.fromkeys([f"gyro_{i}" for i in range(1, 7)], "count")))
    compare_methods(simulate_array(duration=5.0)).record.save(tmp_path / "other.json")
    for name, option, given, expected in (
        (
            "four.csv",
            "--calibration",
            record,
            "four.csv: 4 gyros on 1 axis; the record of the calibration holds 6 on 1",
        ),
        ("four.csv", "--initial-bias", record, "four.csv: 4 gyros on 1 axis"),
        ("raw.csv", "--calibration", record, "raw.csv: column gyro_1 is in count; the record of the calibration is in"),
        ("four.csv", "--calibration", "other.json", "other.json: expected the record of an array calibration"),
        ("four.csv", "--initial-bias", "other.json", "other.json: expected the record of an array calibration"),
    ):
        refused = imulab("array", "fuse", name, option, given)
        assert (refused.returncode, refused.stdout, refused.stderr.count("\n")) == (2, "", 1)
        assert expected in refused.stderr


def test_a_truth_for_some_axes_only_is_refused():
    recording = simulate_array(axes=3, duration=10.0)
    columns = {name: values for name, values in recording.columns.items() if name != "truth_rate_y"}
    with pytest.raises(il.errors.DataError, match="column truth_rate_x without truth_rate_y; expected truth_rate_x tr"):
        compare_methods(type(recording)(columns, {name: recording.units[name] for name in columns}, name="a.csv"))


def test_clocks_that_disagree_are_refused(imulab, tmp_path):
    clocks = {f"time_{i}": GOOD.columns["time"] + (2.0 if i == 4 else 0.0) for i in range(1, 7)}
    il.write_csv(GOOD.with_columns(clocks, dict.fromkeys(clocks, "s")), tmp_path / "c.csv")
    done = imulab("array", "fuse", "c.csv")
    assert done.returncode == 2
    assert "column time_4: the clocks disagree: " in done.stderr
    assert "expected less than 0.5 s apart" in done.stderr
    backwards = clocks["time_4"] - 2
    backwards[20] = 0.1
    recording = GOOD.with_columns(clocks | {"time_4": backwards}, dict.fromkeys(clocks, "s"))
    il.write_csv(recording, tmp_path / "d.csv")
    assert "row 21 (line 22), column time_4: the clock runs backwards" in imulab("array", "fuse", "d.csv").stderr


@pytest.mark.parametrize(
    ("arguments", "fragment"),
    [
        (["compare"], "expected FILE, or --experiment static|dynamic"),
        (["compare", "--experiment", "shaken"], "experiment 'shaken': expected one of static dynamic"),
        (["compare", "--experiment", "static", "--seeds", "0"], "seeds 0: expected 1 to 10000"),
        (["simulate", "-o", "s.csv", "--experiment", "wild"], "expected one of static dynamic moving"),
        (["simulate", "-o", "s.csv", "--axes", "2"], "axes 2: expected 1 or 3"),
        (["simulate", "-o", "s.csv", "--elements", "0"], "elements 0: expected 1 to 64"),
        (["simulate", "-o", "s.csv", "--fault", "stuck"], "expected KIND:GYRO"),
        (["simulate", "-o", "s.csv", "--fault", "sick:1"], "fault 'sick': expected one of dead stuck spikes"),
        (["simulate", "-o", "s.csv", "--fault", "dead:9"], "fault of gyro 9: expected 1 to 6"),
        (["simulate", "-o", "s.csv", "--unit", "count"], "unit count: expected rad/s deg/s deg/h"),
        (["simulate", "-o", "s.csv", "--correlation-time", "0 s"], "correlation time 0 s: expected more than 0"),
        (["simulate", "-o", "s.csv", "--session", "-1"], "session -1: expected 0 to 9223372036854775807"),
        (["simulate", "-o", "s.csv", "--spread", "2,1"], "spread 2,1: expected LOW,HIGH with 0 <= LOW <= HIGH"),
        (["simulate", "-o", "s.csv", "--spread", "1,2,3"], "--spread '1,2,3': expected LOW,HIGH"),
        (["simulate", "-o", "s.csv", "--white", "-0.1 deg/s"], "white -0.00174533: expected a standard deviation"),
        (
            ["simulate", "-o", "s.csv", "--duration", "1000000 s", "--rate", "100 kHz"],
            "of 6 gyros: expected 2 to 2e+08",
        ),
        (["simulate", "-o", "s.csv", "--duration", "0.1 s", "--rate", "1 Hz"], "0.1 s at 1 Hz of 6 gyros: expected 2"),
        (["simulate", "-o", "s.csv", "--fault", "stuck:3:-5"], "fault stuck: start -5 s, duration inf s: expected 0"),
        (["simulate", "-o", "s.csv", "--fault", "stuck:3:5:-1"], "duration -1 s: expected 0 or later, and more than 0"),
        (["compare", "no.csv", "--seeds", "x"], "--seeds 'x': expected a whole number"),
        (["calibrate", "no.csv"], "no.csv: no such file"),
        (["fuse", "no.csv"], "no.csv: no such file"),
    ],
)
def test_a_wrong_command_line_gets_one_line(arguments, fragment, imulab, tmp_path):
    done = imulab("array", *arguments)
    assert done.returncode == 2
    assert fragment in done.stderr
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []

"""Fusion on the C core against the methods document in plain Python, the closed forms, and itself in pieces."""

import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest

import imulab as il
from conftest import some_of
from imulab.cli import main
from imulab.device import METHODS
from imulab.device.tables import ArraySettings
from imulab.device.unit import Blob, Stream, array_stream, make_blob
from imulab.procedures.apply import tables_of
from imulab.procedures.gyro_array.elements import find_elements
from imulab.procedures.gyro_array.fit import calibrate_array
from imulab.procedures.gyro_array.fuse import Fuser, fuse
from imulab.procedures.gyro_array.simulate import Fault, simulate_array
from imulab.procedures.gyro_array.stream import FuseOptions, open_stream, parse_memory
from imulab.recording import Recording
from reference import gyro_array as reference


def array_recording(readings: np.ndarray, rate: float = 50.0, name: str = "a.csv") -> Recording:
    """Readings (m, n) or (m, 3, n) as a recording in deg/s."""
    columns = {"time": np.arange(len(readings)) / rate}
    for i in range(readings.shape[-1]):
        if readings.ndim == 2:
            columns[f"gyro_{i + 1}"] = readings[:, i].copy()
        else:
            columns |= {f"gyro_{axis}_{i + 1}": readings[:, a, i].copy() for a, axis in enumerate("xyz")}
    return Recording(columns, {c: "s" if c == "time" else "deg/s" for c in columns}, name=name, lines_before=1)


def dynamic(seed: int = 1, count: int = 5000, elements: int = 6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The source's dynamic case, made here: readings (m, n), truth (m,), and each gyro's white noise."""
    rng = np.random.default_rng(seed)
    time = np.arange(count) / 50
    truth = -12.5 * np.cos(0.2 * np.pi * time - 0.2 * np.pi)
    sigma = 0.05 * rng.uniform(0.6, 1.6, elements)
    walk = 2e-4 * np.sqrt(0.02) * np.cumsum(rng.standard_normal((count, elements)), axis=0)
    bias = 0.02 * rng.standard_normal(elements)
    return truth[:, None] + sigma * rng.standard_normal((count, elements)) + walk + bias, truth, sigma


def faulty() -> np.ndarray:
    readings = dynamic()[0]
    readings[2000:3000, 0] = readings[1999, 0]
    readings[2500:, 3] += 2
    readings[500::97, 1] += 300
    readings[1000:1200, 4] = np.nan
    readings[0, 5] += 300
    readings[4000:4050] = np.nan
    return readings


def transcribed(method: str, readings: np.ndarray, **settings: object) -> np.ndarray:
    kind = {
        "mean": reference.Mean,
        "feedback": reference.Feedback,
        "least-squares": reference.LeastSquares,
        "support": reference.Support,
        "robust": reference.Robust,
    }[method]
    recursion = kind(readings.shape[1], **settings)
    return np.array([recursion.step(row) for row in readings.tolist()])


@pytest.mark.parametrize("method", ["mean", "support", "least-squares", "feedback", "robust"])
@pytest.mark.parametrize("memory", [None, 0.02])
@pytest.mark.parametrize("elements", [3, 6, 9])
def test_each_method_agrees_with_its_transcription(method, memory, elements):
    readings = dynamic(count=1500, elements=elements)[0]
    settings = {} if method == "mean" else {"memory": memory}
    ours = fuse(array_recording(readings), FuseOptions(method=method, memory="growing" if memory is None else memory))
    np.testing.assert_allclose(ours.rate[:, 0], transcribed(method, readings, **settings), rtol=0, atol=12.5e-12)


@pytest.mark.parametrize(("initial", "start"), [("first", 1), ("zero", 1), ("first", 500), ("record", 1)])
def test_feedback_agrees_with_its_transcription_from_every_start(initial, start, tmp_path):
    readings = dynamic(count=1500)[0]
    options = FuseOptions(method="feedback", initial_bias=initial if initial != "record" else "first", start=start)
    expected_start: object = initial
    if initial == "record":
        still = array_recording(np.random.default_rng(3).standard_normal((1000, 6)) * 0.05 + np.arange(6) * 0.1)
        record = calibrate_array(still).calibration
        options = FuseOptions(method="feedback", initial_bias=record)
        expected_start = [np.degrees(e["bias"]["value"]) for e in record.sections["elements"]]
    ours = fuse(array_recording(readings), options)
    theirs = transcribed("feedback", readings, initial_bias=expected_start, start=start)
    np.testing.assert_allclose(ours.rate[:, 0], theirs, rtol=0, atol=12.5e-12)


@pytest.mark.parametrize("memory", [None, 0.02])
@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("elements", [3, 4, 9])
def test_robust_weighs_healthy_gyros_as_the_document_does(elements, known, memory):
    # Beyond 10 s the cap of the weights moves: what the best gyro leaves to the others falls.
    readings, truth, _ = dynamic(3, count=2500, elements=elements)
    readings -= truth[:, None]
    readings[:, 0] *= 0.3
    readings += 0.01 * truth[:, None]  # too slow for lateness and scale factors to show
    reliability = np.linspace(0.5, 3.0, elements) if known else None
    weights = {} if reliability is None else {"weights": reliability[None]}
    ours = array_stream("robust", elements, rate=50.0, memory=memory, **weights).process(readings, weights=True)
    recursion = reference.Robust(elements, rate=50.0, memory=memory, reliability=reliability)
    theirs = [(recursion.step(row), np.array(recursion.weights)) for row in readings.tolist()]
    np.testing.assert_allclose(ours.rate[:, 0], [rate for rate, _ in theirs], rtol=0, atol=12.5e-12)
    np.testing.assert_allclose(ours.weights[:, 0], [weights for _, weights in theirs], rtol=0, atol=1e-10)
    assert not ours.flags.any()


# ---- closed forms of the source's recursion -------------------------------------------------------------------------


def noise_free(count: int = 800) -> np.ndarray:
    time = np.arange(count) / 50
    return 7.0 * np.sin(0.9 * time) + 0.2 * time


@pytest.mark.parametrize("gain", [0.01, 0.3])
def test_feedback_with_a_fixed_gain_has_a_scale_factor_error_of_exactly_the_gain(gain):
    # Zr = (1 - g) zbar(k) + g zbar(1) - c, on noise-free motion with biases that `first` takes up: c = 0.
    zbar = noise_free()
    readings = zbar[:, None] + np.array([-0.3, 0.1, 0.2, 0.0])
    ours = fuse(array_recording(readings), FuseOptions(method="feedback", memory=gain))
    np.testing.assert_allclose(ours.rate[:, 0], (1 - gain) * zbar + gain * zbar[0], atol=1e-12)


def test_feedback_with_growing_memory_freezes_early_motion_into_its_output():
    # Zr = zbar(k) - c - sum_{j >= 2} (zbar(j) - zbar(j - 1)) / j
    zbar = noise_free()
    readings = zbar[:, None] + np.array([-0.3, 0.1, 0.2, 0.0])
    ours = fuse(array_recording(readings), FuseOptions(method="feedback"))
    frozen = np.concatenate([[0.0], np.cumsum(np.diff(zbar) / np.arange(2, len(zbar) + 1))])
    np.testing.assert_allclose(ours.rate[:, 0], zbar - frozen, atol=1e-11)
    step = np.where(np.arange(400) >= 1, 20.0, 0.0)[:, None] + np.zeros(4)
    assert fuse(array_recording(step), FuseOptions(method="feedback")).rate[-1, 0] == pytest.approx(10.0, abs=1e-12)


def test_feedback_with_a_start_subtracts_its_mean_for_good():
    zbar = np.zeros(500)
    readings = zbar[:, None] + np.array([0.2, 0.4, 0.0, 0.6])
    zero = fuse(array_recording(readings), FuseOptions(method="feedback", initial_bias="zero"))
    assert zero.rate[-1, 0] == pytest.approx(0.3, abs=1e-12)  # c = 0: the common bias stays


# ---- robust: no motion leak, best weights ---------------------------------------------------------------------------


def test_robust_lets_no_motion_leak():
    motion = noise_free(3000)
    readings = motion[:, None] + np.linspace(-0.5, 0.5, 6)
    ours = fuse(array_recording(readings)).rate[:, 0]
    gain = np.polyfit(readings.mean(axis=1), ours, 1)[0]
    assert abs(gain - 1) < 1e-9
    np.testing.assert_allclose(ours, readings.mean(axis=1), atol=1e-9)
    assert not fuse(array_recording(readings)).flags.any()


@pytest.mark.parametrize("seed", some_of(2, [1, 2, 3]))
def test_robust_comes_within_2_percent_of_the_best_fixed_weights(seed):
    readings, truth, sigma = dynamic(seed)
    best = readings @ (sigma**-2 / np.sum(sigma**-2)) - truth
    ours = fuse(array_recording(readings)).rate[:, 0] - truth
    assert ours.std() <= 1.02 * best.std()
    assert ours.std() < 0.95 * (readings.mean(axis=1) - truth).std()


# ---- kalman and covariance ------------------------------------------------------------------------------------------


def test_the_gain_of_kalman_is_that_of_an_iterated_riccati_equation():
    from imulab.procedures.gyro_array.stream import steady_gain

    white, walk, rate_walk, dt = np.array([0.04, 0.06, 0.08]), np.array([1e-3, 2e-3, 1e-3]), 0.3, 0.02
    gain = steady_gain(white, walk, rate_walk, dt)
    assert np.allclose(gain[1:].sum(axis=0), 0)
    # Rate and biases relative to their mean, propagated until nothing changes.
    n = 3
    relative = np.eye(n) - 1 / n
    h = np.column_stack([np.ones(n), relative])
    q = np.zeros((n + 1, n + 1))
    q[0, 0] = rate_walk**2 * dt
    q[1:, 1:] = relative @ np.diag(walk**2 * dt) @ relative
    p = np.eye(n + 1)
    for _ in range(200_000):
        ahead = p + q
        k = ahead @ h.T @ np.linalg.inv(h @ ahead @ h.T + np.diag(white**2))
        after = (np.eye(n + 1) - k @ h) @ ahead
        if np.abs(after - p).max() < 1e-18:
            break
        p = after
    np.testing.assert_allclose(gain, k, atol=1e-6)


def test_kalman_runs_without_a_record_and_follows_the_motion_no_worse_than_the_mean():
    for seed in (1, 2, 3):
        readings, truth, _ = dynamic(seed)
        ours = fuse(array_recording(readings), FuseOptions(method="kalman")).rate[:, 0] - truth
        assert ours.std() <= (readings.mean(axis=1) - truth).std()


@pytest.mark.parametrize("method", ["robust", "kalman", "least-squares"])
def test_a_gyro_that_comes_back_has_its_full_weight_within_30_s(method):
    readings = dynamic()[0]
    gone = readings.copy()
    gone[1000:1500, 2] = np.nan
    whole, back = (
        fuse(array_recording(r), FuseOptions(method=method, rate=50.0), weights=True) for r in (readings, gone)
    )
    after = 1500 + 30 * 50
    np.testing.assert_allclose(back.weights[after, 0, 2], whole.weights[after, 0, 2], rtol=0.15)
    assert np.abs(back.rate[after:] - whole.rate[after:]).max() < 0.01


def test_covariance_uses_the_full_matrix_of_a_record():
    rng = np.random.default_rng(8)
    shared = 0.2 * rng.standard_normal(40_000)
    noise = 0.1 * rng.standard_normal((40_000, 4))
    noise[:, 0] += shared
    noise[:, 1] += shared
    record = calibrate_array(array_recording(noise), averaging_time=0.1).calibration
    truth = np.diag([0.05, 0.05, 0.01, 0.01])
    truth[0, 1] = truth[1, 0] = 0.04
    best = np.linalg.solve(truth, np.ones(4))
    weights = np.array(record.sections["correlation"]["weights"][0])
    np.testing.assert_allclose(weights, best / best.sum(), atol=0.02)
    ours = fuse(array_recording(noise), FuseOptions(method="covariance", calibration=record))
    bias = np.degrees([e["bias"]["value"] for e in record.sections["elements"]])
    np.testing.assert_allclose(ours.rate[:, 0], (noise - bias) @ weights, atol=1e-12)


# ---- pieces, clocks, gaps -------------------------------------------------------------------------------------------


def pieces(recording: Recording, cuts: list[int]) -> list[Recording]:
    ends = [0, *cuts, len(recording)]
    return [
        Recording({n: c[a:b] for n, c in recording.columns.items()}, recording.units, name="a.csv", first_row=a + 1)
        for a, b in pairwise(ends)
    ]


@pytest.mark.parametrize("method", METHODS)
def test_pieces_give_the_whole_to_the_last_bit(method):
    recording = array_recording(np.delete(faulty(), [700, 701, 702], axis=0))
    record = None
    if method in ("covariance", "kalman"):  # without a record the noise for kalman is that of the first piece
        record = calibrate_array(array_recording(np.random.default_rng(1).standard_normal((2000, 6)))).calibration
    options = FuseOptions(method=method, calibration=record)
    whole = fuse(recording, options, weights=True)
    for cuts in ([17, 18, 19, 2500], [64, 65, 4000], [3000]):
        parts = list(Fuser(options, weights=True).fuse(pieces(recording, cuts)))
        np.testing.assert_array_equal(np.concatenate([p.rate for p in parts]), whole.rate)
        np.testing.assert_array_equal(np.concatenate([p.flags for p in parts]), whole.flags)


def test_single_lines_from_the_first_on_give_the_whole_to_the_last_bit():
    recording = array_recording(dynamic(count=300)[0])
    whole = fuse(recording)
    parts = list(Fuser(FuseOptions()).fuse(pieces(recording, list(range(1, 300)))))
    assert [len(p.rate) for p in parts] == [1] * 300
    np.testing.assert_array_equal(np.concatenate([p.rate for p in parts]), whole.rate)


def test_three_axes_are_three_times_one():
    readings = np.stack([dynamic(seed)[0] for seed in (1, 2, 3)], axis=1)
    together = fuse(array_recording(readings))
    for a in range(3):
        np.testing.assert_array_equal(together.rate[:, a], fuse(array_recording(readings[:, a])).rate[:, 0])


def test_gaps_are_reported_with_place_and_length_and_fusion_goes_on():
    readings = dynamic(count=1000)[0]
    recording = array_recording(readings)
    time = recording.columns["time"] + np.where(np.arange(1000) >= 400, 3.0, 0.0)
    ours = fuse(recording.with_columns({"time": time}, {}))
    assert ours.notes == ("a.csv: a gap of 3.02 s before row 401 (line 402) at 11 s",)
    np.testing.assert_array_equal(ours.rate, fuse(recording).rate)


def test_a_time_in_whole_milliseconds_has_no_gaps():
    # 700 Hz: steps of 1 and 2 ms. One sample in a hundred missing at 100 Hz: that is a gap.
    recording = array_recording(np.random.default_rng(1).standard_normal((7000, 4)))
    coarse = recording.with_columns({"time": np.round(np.arange(7000) / 0.7)}, {"time": "ms"})
    fuser = Fuser(FuseOptions())
    list(fuser.fuse([coarse]))
    assert fuser.notes() == []
    assert fuser.clock.rate == pytest.approx(700, rel=0.1)
    holes = np.delete(np.arange(7000) * 10.0, np.arange(50, 7000, 100))
    kept = {n: c[: len(holes)] for n, c in recording.columns.items()} | {"time": holes}
    fuser = Fuser(FuseOptions())
    list(fuser.fuse([Recording(kept, recording.units | {"time": "ms"}, name="a.csv")]))
    assert fuser.notes()[-1] == "a.csv: 67 more gaps; 1.4 s in all 70 together"


def test_elements_on_clocks_of_their_own_are_brought_to_one():
    time = np.arange(3000) / 50
    rng = np.random.default_rng(4)
    shift = np.array([0.0, 0.004, -0.007, 0.0023])
    motion = lambda t: 20 * np.sin(1.3 * t)  # noqa: E731
    readings = np.column_stack([motion(time + d) for d in shift]) + 0.01 * rng.standard_normal((3000, 4))
    recording = array_recording(readings)
    clocks = {f"time_{i + 1}": time + d for i, d in enumerate(shift)}
    own = recording.with_columns(clocks, dict.fromkeys(clocks, "s"))
    naive, right = fuse(recording, FuseOptions(method="mean")), fuse(own, FuseOptions(method="mean"))
    inside = len(right.time)
    assert 2995 < inside < 3000
    error = right.rate[:, 0] - motion(right.time)
    assert error.std() < 0.007
    assert np.abs(naive.rate[:, 0] - motion(time)).max() > 2 * np.abs(error).max() / 3
    parts = list(Fuser(FuseOptions(method="mean")).fuse(pieces(own, [1, 2, 3, 50, 51, 1700])))
    np.testing.assert_array_equal(np.concatenate([p.time for p in parts]), right.time)
    np.testing.assert_array_equal(np.concatenate([p.rate for p in parts]), right.rate)


def test_zero_rate_updates_take_the_common_bias_off():
    recording = simulate_array(experiment="static", duration=120.0, turn_on=np.radians(0.5), seed=4)
    plain = fuse(recording)
    updated = fuse(recording, FuseOptions(still=(0.0, 30.0)))
    after = recording.time > 30
    assert abs(updated.rate[after].mean()) < 0.15 * abs(plain.rate[after].mean())


def test_a_calibrated_start_ends_nearer_after_2000_s():
    still = simulate_array(experiment="static", duration=60.0, session=1, seed=5)
    run = simulate_array(experiment="static", seed=5)
    record = calibrate_array(still).calibration
    angles = [
        abs(fuse(run, options, flags=False).rate.sum() / 100)
        for options in (FuseOptions(), FuseOptions(calibration=record), FuseOptions(initial_bias=record))
    ]
    assert angles[1] < 0.5 * angles[0]
    assert angles[2] == pytest.approx(angles[1], rel=0.2)


# ---- real array -----------------------------------------------------------------------------------------------------


def test_the_real_array_reaches_its_split_half_figures(real_data, capsys):
    recording = il.read(real_data / "mimu4444" / "exp_1.bin")
    columns = recording.columns
    aligned = np.empty((len(recording), 3, 8))
    for i in range(8):
        x, y, z = (columns[f"gyro_{a}_{i + 1}"] for a in "xyz")
        aligned[:, :, i] = np.column_stack([-y, -x, -z] if i % 2 else [x, y, z])
    quiet = (recording.time > 468.2) & (recording.time < 496.0)
    found = {}
    for method in ("mean", "least-squares", "feedback", "robust"):
        odd, even = (
            fuse(array_recording(aligned[:, :, k::2], rate=62.5), FuseOptions(method=method), flags=False).rate[quiet]
            for k in (0, 1)
        )
        found[method] = (odd - even).std(axis=0)
        with capsys.disabled():
            print(f"\n  split half, deg/s, {method}: {np.round(found[method], 4).tolist()}", end="")
    assert (found["robust"] <= [0.138, 0.138, 0.097]).all()
    assert (found["robust"] < 0.92 * found["mean"]).all()
    assert (found["robust"] < found["least-squares"]).all()
    np.testing.assert_allclose(found["mean"], [0.197, 0.174, 0.103], atol=0.002)


@pytest.mark.slow
def test_a_jump_in_the_real_array_reaches_the_mean_and_not_robust(real_data):
    # Gyro 4 steps by -0.12 deg/s about z at 46 to 80 s. An eighth of it is 0.42 deg over the 28 s at rest.
    whole = il.read(real_data / "mimu4444" / "exp_1.bin")

    def part(start, stop):
        here = (whole.time >= start) & (whole.time < stop)
        return Recording({n: c[here] for n, c in whole.columns.items()}, whole.units, name="part")

    def angle(method, record, start):
        fused = fuse(part(start, 495.93), FuseOptions(method=method, calibration=record))
        if method == "robust" and start == 0.0:
            jumped = (fused.flags[:, 2] & 8 > 0) & (fused.time < 460.0)[:, None]
            assert np.flatnonzero(jumped.any(axis=0)).tolist() == [3]
            assert fused.time[jumped[:, 3]][0] == pytest.approx(75.3, abs=0.1)
        return abs(fused.rate[fused.time >= 467.7, 2].sum() / 62.5)

    before = calibrate_array(part(0.0, 19.0), whole).calibration
    assert angle("mean", before, 0.0) == pytest.approx(1.12, abs=0.02)
    assert angle("robust", before, 0.0) == pytest.approx(1.12 - 0.42, abs=0.05)
    after = calibrate_array(part(468.5, 495.5), whole).calibration
    assert angle("robust", after, 0.0) == pytest.approx(0.42, abs=0.05)
    assert angle("robust", after, 300.0) < 0.05


# ---- options --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "memory"),
    [("growing", ("growing", 1)), ("growing:250", ("growing", 250)), ("0.01", (0.01, 1)), ("1e-3", (0.001, 1))],
)
def test_memory_is_growing_or_a_gain(text, memory):
    assert parse_memory(text) == memory


@pytest.mark.parametrize(
    "text", ["0", "1", "-0.1", "nan", "inf", "growing:0", "growing:99999999999", "growing:x", "fading", ""]
)
def test_other_memories_are_refused(text):
    from imulab.errors import OptionError

    with pytest.raises(OptionError, match="expected growing, growing:COUNT, or a gain between 0 and 1"):
        parse_memory(text)


def test_faults_of_the_simulator_are_where_they_should_be():
    plain = simulate_array(duration=20.0)
    broken = simulate_array(duration=20.0, fault=(Fault("stuck", 2, 5.0, 5.0), Fault("jump", 3, 10.0, size=0.1)))
    stuck = broken.columns["gyro_2"][250:500]
    assert np.ptp(stuck) == 0
    np.testing.assert_array_equal(broken.columns["gyro_2"][500:], plain.columns["gyro_2"][500:])
    assert np.allclose(broken.columns["gyro_3"][500:] - plain.columns["gyro_3"][500:], np.degrees(0.1))


_RESUME = """
import sys
import numpy as np
from imulab.device.unit import Stream, array_stream
stream = Stream.from_state(open(sys.argv[1], "rb").read())
np.save(sys.argv[3], stream.process(np.load(sys.argv[2])).rate)
"""


@pytest.mark.parametrize("kind", ["robust", "feedback", "kalman", "blob"])
def test_a_saved_stream_goes_on_in_another_process_to_the_last_bit(kind, tmp_path):
    still = simulate_array(experiment="static", duration=60.0, seed=2)
    record = calibrate_array(still).calibration
    recording = simulate_array(duration=20.0, seed=2, fault=(Fault("stuck", 3, 9.0, 4.0),))
    elements = find_elements(recording)
    readings = elements.readings(recording)
    if kind == "blob":
        blob = Blob("unit.blob", make_blob([record], tables_of(record)), {})
        settings = ArraySettings("robust", 6, 1, rate=100.0)
        whole, first = (Stream.from_blob(blob.data, settings) for _ in range(2))
        readings = np.radians(readings)
    else:
        options = FuseOptions(method=kind, calibration=None if kind == "feedback" else record)
        whole, first = (open_stream(options, elements, 50.0, readings) for _ in range(2))
    expected = whole.process(readings).rate
    begun = first.process(readings[:500]).rate
    (tmp_path / "state").write_bytes(first.state())
    np.save(tmp_path / "rest.npy", readings[500:])
    files = [str(tmp_path / name) for name in ("state", "rest.npy", "out.npy")]
    subprocess.run([sys.executable, "-c", _RESUME, *files], check=True)
    np.testing.assert_array_equal(np.concatenate([begun, np.load(tmp_path / "out.npy")]), expected)
    assert np.abs(expected[500:]).max() > 0
    state = bytearray(first.state())
    state[len(state) // 2] ^= 1
    for broken, text in ((bytes(state), "cut or altered"), (first.state()[:-1], "cut or altered"), (b"", "not the st")):
        with pytest.raises(il.errors.RecordError, match=text):
            Stream.from_state(broken)


def test_a_blob_fuses_as_the_unit_does(imulab, tmp_path):
    array = {"seed": 6, "scale_spread": 0.01, "mounting": "alternate"}
    still = simulate_array(experiment="static", duration=60.0, **array)
    record = calibrate_array(still, simulate_array(experiment="moving", **array)).calibration
    run = simulate_array(duration=20.0, rate=100.0, **array)
    record.save(tmp_path / "a.json")
    il.write_csv(run, tmp_path / "run.csv")
    assert imulab("export", "--to", "blob", "a.json", "-o", "unit").returncode == 0
    (blob,) = (tmp_path / "unit").glob("*.blob")
    done = imulab("array", "fuse", "run.csv", "--calibration", blob, "-o", "blob.csv")
    assert done.returncode == 0, done.stderr
    desk = fuse(run, FuseOptions(calibration=record))
    unit = il.read(tmp_path / "blob.csv").columns["rate"]
    np.testing.assert_allclose(unit, desk.rate[:, 0], atol=2e-5)
    refused = imulab("array", "fuse", "run.csv", "--calibration", blob, "--method", "mean")
    assert refused.returncode == 2
    assert "this blob fuses by robust with growing memory, and by nothing else" in refused.stderr
    export = ("export", "--to", "blob", "a.json", "--method", "feedback", "--memory", "0.01", "-o", "unit2")
    assert imulab(*export).returncode == 0
    done = imulab("array", "fuse", "run.csv", "--calibration", "unit2/unit.blob", "-o", "blob2.csv")
    assert done.returncode == 0, done.stderr
    desk = fuse(run, FuseOptions(method="feedback", memory=0.01, calibration=record))
    np.testing.assert_allclose(il.read(tmp_path / "blob2.csv").columns["rate"], desk.rate[:, 0], atol=2e-5)
    il.write_csv(simulate_array(duration=2.0, elements=4), tmp_path / "four.csv")
    assert "four.csv: 4 gyros on 1 axis; the blob" in imulab("array", "fuse", "four.csv", "--calibration", blob).stderr
    refused = imulab("array", "fuse", "run.csv", "--calibration", blob, "--initial-bias", "zero")
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert "a blob holds the biases it starts from: no --initial-bias" in refused.stderr


@pytest.mark.parametrize(
    ("title", "size", "asked"),
    [
        ("s", 1000.0, "10 s from row to row (0.1 Hz): is the unit of time right: 100 Hz if it is in ms?"),
        ("ms", 1.0, "1e-05 s from row to row (1e+05 Hz): is the unit of time right: 100 Hz if it is in s?"),
    ],
)
def test_times_in_another_unit_than_titled_are_asked_for(tmp_path, capsys, title, size, asked):
    source = il.simulate_array(elements=4, duration=60.0, rate=100.0, seed=1)
    path = tmp_path / "a.csv"
    il.write_csv(source.with_columns({"time": source.time * size}, {}), path)
    path.write_text(path.read_text().replace("time [s]", f"time [{title}]"))
    out = str(tmp_path / "out.csv")
    assert main(["array", "fuse", str(path), "-o", out]) == 0
    said = capsys.readouterr()
    assert f"a.csv: column time [{title}]: {asked}" in said.err
    assert said.out.startswith("look: ")
    assert main(["array", "fuse", str(path), "-o", out, "--unit", "time=s"]) == 0
    assert "is the unit of time right" not in capsys.readouterr().err

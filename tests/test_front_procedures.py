"""Arrays, warm-up and centrifuge from data as people have it: the same results in every form, and as the commands'."""

import tracemalloc

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.errors import ImulabError, OptionError
from imulab.procedures.gyro_array.fuse import fuse as fuse_recording
from imulab.procedures.result import as_blocks

TEMPERATURES = (-40.0, 0.0, 60.0)


@pytest.fixture(scope="module")
def array(tmp_path_factory):
    folder = tmp_path_factory.mktemp("array")
    il.write_csv(il.simulate_array(experiment="static", duration=60.0), folder / "still.csv")
    il.write_csv(il.simulate_array(session=1, duration=30.0), folder / "run.csv")
    still = il.read(folder / "still.csv")
    return folder, still, np.column_stack([still.column(f"gyro_{number}") for number in range(1, 7)])


def parameters(record):
    return {name: (p.value, p.standard_uncertainty) for name, p in record.parameters.items()}


@pytest.mark.slow
def test_an_array_is_calibrated_in_every_form_as_by_the_command(array, tmp_path):
    folder, still, readings = array
    assert main(["array", "calibrate", str(folder / "still.csv"), "-o", str(tmp_path / "cli.json"), "--json"]) == 0
    expected = parameters(il.load(tmp_path / "cli.json"))
    unit, time = still.units["gyro_1"], still.column("time")
    for data, reading in (
        (folder / "still.csv", {}),
        (still, {}),
        (still.to_frame("polars"), {}),
        (readings, {"time": time, "unit": unit}),
    ):
        assert parameters(il.calibrate_array(data, **reading).calibration) == expected
    by_rate = il.calibrate_array(readings, rate=100.0, unit=unit, method="feedback", memory=0.01).calibration
    assert by_rate.parameters["bias_3"].value == pytest.approx(expected["bias_3"][0], rel=1e-12)
    assert by_rate.model["fusion"] == {"method": "feedback", "memory": 0.01, "start": 1}


def test_readings_of_triads_become_the_columns_of_their_axes():
    board = il.simulate_array(experiment="moving", axes=3, elements=4, duration=20.0)
    triads = [np.column_stack([board.column(f"gyro_{axis}_{n}") for axis in "xyz"]) for n in range(1, 5)]
    stacked = np.stack(triads, axis=1)
    assert stacked.shape == (len(board), 4, 3)
    found = il.fuse(stacked, method="mean", time=board.column("time"), unit=board.units["gyro_x_1"])
    np.testing.assert_array_equal(found.rate, il.fuse(board, method="mean").rate)
    np.testing.assert_allclose(found.rate, stacked.mean(axis=1), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("options", [{}, {"method": "feedback", "memory": "growing:20"}, {"method": "mean"}])
def test_fusing_takes_keywords_and_gives_what_the_command_writes(array, tmp_path, options):
    folder, _, _ = array
    words = [word for key, value in options.items() for word in (f"--{key}", value)]
    assert main(["array", "fuse", str(folder / "run.csv"), *words, "-o", str(tmp_path / "out.csv")]) == 0
    found = il.fuse(folder / "run.csv", **options)
    np.testing.assert_array_equal(found.rate[:, 0], il.read(tmp_path / "out.csv").column("rate"))
    board = il.read(folder / "run.csv")
    if not options:
        np.testing.assert_array_equal(found.rate, il.fuse(board, il.FuseOptions()).rate)
        np.testing.assert_array_equal(found.rate, fuse_recording(board).rate)


def test_method_and_memory_of_a_calibration_are_taken_from_it(array, tmp_path):
    folder, still, _ = array
    il.calibrate_array(still, method="feedback", memory=0.01).save(tmp_path / "array.json")
    carried = il.fuse(folder / "run.csv", calibration=tmp_path / "array.json")
    stated = il.fuse(folder / "run.csv", calibration=il.load(tmp_path / "array.json"), method="feedback", memory=0.01)
    np.testing.assert_array_equal(carried.rate, stated.rate)
    assert not np.array_equal(carried.rate, il.fuse(folder / "run.csv").rate)
    compared = il.compare_methods(folder / "run.csv", calibration=tmp_path / "array.json")
    assert compared.record.model["memory"] == "memory 0.01"


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda s, r: il.fuse(s, "mean"), "options: expected keywords, as in fuse.data, method='mean'.*, found 'mean'"),
        (lambda s, r: il.fuse(s, il.FuseOptions(), method="mean"), "options together with other keywords"),
        (lambda s, r: il.fuse(s, method="average"), "method 'average': expected one of mean"),
        (lambda s, r: il.fuse(s, memory="growth"), "memory 'growth': expected growing, growing:COUNT, or a gain"),
        (lambda s, r: il.fuse(s, metod="mean"), "fuse: unknown option 'metod'.*did you mean 'method'"),
        (lambda s, r: il.fuse(s, calibration=s), "fuse: calibration: expected a record .*, found the recording"),
        (lambda s, r: il.fuse(s, initial_bias=3), "fuse: initial_bias: expected a record .*, found 3"),
        (lambda s, r: il.fuse(r, unit="deg/s"), "fuse: arrays: no time: expected rate=, time= or a column 'time'"),
        (lambda s, r: il.fuse(r, rate=100.0), "column gyro_1 has no unit"),
        (lambda s, r: il.fuse(np.ones((9, 6, 2)), rate=1, unit="dps"), r"shape \(m, n\) or \(m, n, 3\), found"),
        (lambda s, r: il.calibrate_array(r, unit="deg/s"), "calibrate_array: arrays: no time"),
        (lambda s, r: il.calibrate_array(s, 3.0), "moving: expected a file name.* found 3.0"),
        (lambda s, r: il.compare_methods(s, calibration=s), "compare_methods: calibration: expected a record"),
    ],
)  # fmt: skip
def test_calls_of_the_array_that_cannot_be_are_refused_in_a_line(array, call, words):
    _, still, readings = array
    with pytest.raises(ImulabError, match=words) as refused:
        call(still, readings)
    assert "\n" not in str(refused.value)


@pytest.fixture(scope="module")
def cycles(tmp_path_factory):
    folder = tmp_path_factory.mktemp("warmup")
    paths = [folder / f"{number}_{at:g}.csv" for number in (1, 2) for at in TEMPERATURES]
    for path, (number, at) in zip(paths, [(n, t) for n in (1, 2) for t in TEMPERATURES], strict=True):
        il.write_csv(il.simulate_power_cycle(at, seed=(1, number)), path)
    return paths


@pytest.mark.slow
def test_power_cycles_are_fitted_in_every_form_as_by_the_command(cycles, tmp_path):
    output, options = tmp_path / "cli.json", {"temperatures": TEMPERATURES, "model": "exponential"}
    given = ["--temperatures", "-40,0,60", "--model", "exponential", "-o", str(output)]
    assert main(["warmup", "fit", *map(str, cycles), *given]) == 0
    expected = parameters(il.load(output))
    recordings = [il.read(path) for path in cycles]
    frames = [il.Recording.from_frame(each.to_frame(), metadata=dict(each.metadata)) for each in recordings]
    for form in (cycles, recordings, frames, [il.find_power_cycle(each) for each in recordings]):
        assert parameters(il.fit_warmup(form, **options).calibration) == expected


@pytest.mark.slow
def test_power_cycles_of_hours_are_averaged_as_they_are_read(tmp_path):
    peaks = []
    for duration in (500.0, 2000.0):
        path = tmp_path / f"{duration:g}.csv"
        il.write_csv(il.simulate_power_cycle(0.0, duration=duration, sample_rate=200.0), path)
        tracemalloc.start()
        made, source = as_blocks(path, {}, il.fit_warmup)
        cycle = il.find_power_cycle(made, source=source)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] - peaks[0] < 0.2 * 300_000 * 8 * 8  # of the 19 MB that 300,000 rows more take
    whole = il.read(path)
    assert cycle.source == whole.source
    for name, values in vars(il.find_power_cycle(whole).bins).items():
        np.testing.assert_allclose(getattr(cycle.bins, name), values, rtol=1e-9)


@pytest.mark.parametrize("single", ["cycle.csv", il.Recording({}, {}), np.zeros((3, 3)), None, 3, {"time": [0]}])
def test_a_single_power_cycle_is_refused_in_a_line(single):
    with pytest.raises(OptionError, match="fit_warmup: cycles: expected a list of power cycles"):
        il.fit_warmup(single)


@pytest.fixture(scope="module")
def centrifuge(tmp_path_factory):
    folder = tmp_path_factory.mktemp("centrifuge") / "test"
    made = ["--levels", "1,10,20", "--duration", "60 s", "--static-duration", "30 s", "-o", str(folder)]
    assert main(["centrifuge", "simulate", *made]) == 0
    return folder / "manifest.toml"


def test_a_centrifuge_test_is_reduced_from_its_manifest_as_by_the_command(centrifuge, tmp_path):
    assert main(["centrifuge", "reduce", str(centrifuge), "-o", str(tmp_path / "cli.json")]) == 0
    expected = il.load(tmp_path / "cli.json")
    found = il.fit_centrifuge(centrifuge).calibration
    assert parameters(found) == parameters(expected)
    assert found.sources == expected.sources
    by_hand = il.fit_centrifuge(il.load_manifest(centrifuge), lambda run: il.read_blocks(centrifuge.parent / run.file))
    assert parameters(by_hand.calibration) == parameters(expected)


def test_a_manifest_that_cannot_be_is_refused_in_a_line(centrifuge):
    with pytest.raises(OptionError, match="needs recording_of, a function of a run"):
        il.fit_centrifuge(il.load_manifest(centrifuge))
    with pytest.raises(OptionError, match="manifest: expected a manifest or the name of its file, found 3"):
        il.fit_centrifuge(3)
    with pytest.raises(ImulabError, match=r"no\.toml: no such manifest file"):
        il.fit_centrifuge("no.toml")


@pytest.mark.slow
def test_the_gyroscopes_are_fitted_in_every_form_as_by_the_command(tmp_path):
    il.write_csv(il.simulate_tumble(order=1, gravity=9.81, seed=7), tmp_path / "rec.csv")
    recording = il.read(tmp_path / "rec.csv")
    il.fit_tumble(recording, order=1, gravity=9.81).save(tmp_path / "a.json")
    given = [str(tmp_path / "rec.csv"), "--accel", str(tmp_path / "a.json"), "-o", str(tmp_path / "cli.json")]
    assert main(["tumble", "gyro", *given]) == 0
    expected = parameters(il.load(tmp_path / "cli.json"))
    triads = {sensor: recording.triad(sensor) for sensor in ("accel", "gyro")}
    units = {"accel": "m/s^2", "gyro": "deg/s"}
    gyros = (triads["gyro"], {"time": recording.time, "unit": "deg/s", "accel_data": recording})
    for data, reading in (
        (tmp_path / "rec.csv", {}),
        (recording.to_frame(), {}),
        (triads, {"time": recording.time, "units": units}),
        gyros,
    ):
        found = il.fit_gyro(tmp_path / "a.json", data, **reading)
        # Sums over thousands of turns may differ in their last bit by where the arrays lie in memory.
        for name, pair in parameters(found.calibration).items():
            assert pair == pytest.approx(expected[name], rel=1e-11), name
        assert len(repr(found).splitlines()) <= 12
    with pytest.raises(ImulabError, match=r"fit_gyro: accel: expected a record .*, found the recording"):
        il.fit_gyro(recording, recording)


def test_the_allan_deviation_takes_samples_or_a_column(array):
    folder, still, readings = array
    plain = il.allan_deviation(still.si("gyro_2"), rate=100.0)
    for data, more in ((still, {}), (folder / "still.csv", {}), (still.to_frame("polars"), {})):
        curve = il.allan_deviation(data, column="gyro_2", **more)
        np.testing.assert_allclose(curve.deviation, plain.deviation, rtol=1e-9)
    by_name = il.allan_deviation({"gyro_2": readings[:, 1]}, 100.0, unit=still.units["gyro_2"])
    np.testing.assert_allclose(by_name.deviation, plain.deviation, rtol=1e-9)


def test_samples_without_a_column_have_the_coefficients_of_one():
    """White noise of 1 at 10 Hz has N = 1/sqrt(10); two missing samples are bridged and counted, 2 % are refused."""
    samples = np.random.default_rng(3).standard_normal(20_000)
    holed = samples.copy()
    holed[[70, 9000]] = np.nan
    plain, found = (il.allan_deviation(each, 10.0) for each in (samples, holed))
    of_column = il.allan_deviation({"gyro_x": samples}, 10.0, unit="rad/s")
    np.testing.assert_allclose(plain.deviation, of_column.deviation, rtol=1e-9)
    for curve in (plain, found, of_column, il.allan_deviation(holed, 10.0, "dense")):
        white = curve.coefficients.angle_random_walk
        assert abs(white.value - 10**-0.5) < 3 * white.standard_uncertainty
        assert white.value == pytest.approx(of_column.coefficients.angle_random_walk.value, rel=1e-3)
    assert plain.notes == ()
    assert found.notes == ("samples: 2 rows without numbers (the first row 71) bridged from their neighbours",)
    assert "white noise" in [row[1] for row in found.exhibits().items[0].rows]
    holed[:400] = np.nan
    with pytest.raises(ImulabError, match=r"^samples: row 1, column samples: expected a finite number, found nan"):
        il.allan_deviation(holed, 10.0)
    tiny = il.allan_deviation(1e-300 * samples, 10.0).coefficients
    assert tiny.angle_random_walk.reason == "the samples differ by too little to be squared"
    assert il.allan_deviation(samples[:40], 10.0).coefficients is None


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda s: il.allan_deviation(s.si("gyro_1"), 1e300), "sampling rate 1e.300: expected a positive number"),
        (lambda s: il.allan_deviation(s), "several columns; expected column=, one of gyro_1"),
        (lambda s: il.allan_deviation(s, column="gyro_9"), "no column 'gyro_9'; expected column=, one of gyro_1"),
        (lambda s: il.allan_deviation(s.si("gyro_1")), "samples without a time: expected rate=, in Hz"),
        (lambda s: il.allan_deviation(s, 100.0, column="gyro_1"), "rate does not go with such data"),
        (lambda s: il.allan_deviation(3.0, 100.0), "expected samples, found the number 3.0"),
        (lambda s: il.allan_deviation(None, 100.0), "data: expected a file name"),
        (lambda s: il.allan_deviation(s.si("gyro_1"), 0.0), "sampling rate 0: expected a positive number"),
    ],
)
def test_allan_deviations_that_cannot_be_are_refused_in_a_line(array, call, words):
    with pytest.raises(ImulabError, match=words):
        call(array[1])


def test_other_results_show_themselves_in_a_few_lines(array):
    _, still, _ = array
    tumble = il.simulate_tumble(order=1, gravity=9.81)
    check = il.check_tumble(il.fit_tumble(tumble, order=1, gravity=9.81).calibration, tumble, gravity=9.81)
    assert repr(check).startswith("Check(pass, p = ")
    assert f"number {check.worst + 1} by {1e6 * abs(check.residuals[check.worst]) / 9.80665:.3g} µg" in repr(check)
    assert repr(il.fuse(still)) == "Fused(6000 samples of 6 gyros on 1 axes, in deg/s)"
    assert "least deviation" in repr(il.allan_deviation(still, column="gyro_1"))
    assert len(repr(il.compare_methods(still)).splitlines()) == 8

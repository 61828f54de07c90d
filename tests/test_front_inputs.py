"""Data as people have it: arrays and data frames of pandas and polars, and what is refused of them in one line."""

import re

import numpy as np
import pandas
import polars
import pytest

import imulab as il
from imulab.errors import DataError, ImulabError, OptionError, UnitError

G = 9.80665
TRIAD = np.arange(12.0).reshape(4, 3)
FRAMES = pytest.mark.parametrize("library", [pandas, polars], ids=["pandas", "polars"])


def test_arrays_become_the_columns_that_a_file_would_have():
    made = il.Recording.from_arrays(
        accel=TRIAD.tolist(), gyro=TRIAD + 100, temperature=[20, 21, 22, 23], rate=50, unit="mg", units={"gyro": "dps"},
        std_accel=np.ones((4, 3)), pressure=[1, 2, 3, 4], metadata={"serial": "7"}, name="bench",
    )  # fmt: skip
    axes = ["accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z"]
    assert list(made.columns) == ["time", *axes, "temperature", "std_accel_x", "std_accel_y", "std_accel_z", "pressure"]
    assert [made.units[name] for name in (*axes, "std_accel_y", "temperature", "time", "pressure")] == [
        *["mg"] * 3, *["deg/s"] * 3, "mg", "degC", "s", "1",
    ]  # fmt: skip
    np.testing.assert_array_equal(made.column("time"), [0.0, 0.02, 0.04, 0.06])
    np.testing.assert_array_equal(made.triad("accel"), TRIAD)
    np.testing.assert_array_equal(made.column("gyro_z"), TRIAD[:, 2] + 100)
    assert (made.name, made.metadata["serial"]) == ("bench", "7")


@pytest.mark.parametrize("unit", ["count", "V", "mA"])
def test_the_unit_of_a_raw_output_is_that_of_every_sensor_but_not_of_the_temperature(unit):
    made = il.Recording.from_arrays(accel=TRIAD, mag=TRIAD, temperature=np.ones(4), time=np.arange(4), unit=unit)
    assert {made.units[name] for name in made.columns if name[0] in "am"} == {unit}
    assert (made.units["temperature"], made.units["time"]) == ("degC", "s")


def test_without_time_and_rate_the_rows_are_attitudes():
    assert il.Recording.from_arrays(accel=TRIAD, unit="g").time is None


def test_dates_become_seconds_since_the_first():
    dates = np.datetime64("2026-11-23T02:00:00") + np.array([0, 10, 25, 1000]) * np.timedelta64(1, "ms")
    made = il.Recording.from_arrays(accel=TRIAD, time=dates, unit="g")
    np.testing.assert_allclose(made.column("time"), [0.0, 0.01, 0.025, 1.0], atol=1e-15)


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        ({"accel": TRIAD}, UnitError, r"arrays: column accel_x has no unit; expected units=\{'accel': 'm/s\^2'\}"),
        ({"accel": TRIAD, "gyro": TRIAD, "unit": "g"}, UnitError, r"gyro_x has no unit; expected units=\{'gyro'"),
        ({"mag": TRIAD, "accel": TRIAD, "unit": "g"}, UnitError, r"mag_x has no unit; expected units=\{'mag': 'uT'\}"),
        ({"accel": TRIAD, "unit": "furlong"}, UnitError, "unknown unit 'furlong'"),
        ({"accel": TRIAD, "unit": 9.81}, OptionError, "unit: expected a text, found 9.81"),
        ({"accel": TRIAD, "unit": "deg/s"}, UnitError, "accel_x has no unit"),
        ({"gyro": TRIAD, "units": {"gyro": "g"}}, UnitError, "gyro_x: expected a unit of rate or output, found 'g'"),
        ({"gyro": TRIAD, "units": {"gyr": "g"}}, UnitError, "gyro_x has no unit"),
        ({"gyro": TRIAD, "unit": "dps", "units": {"gyr": "g"}}, OptionError, "no column 'gyr'.*did you mean 'gyro'"),
        ({"gyro": TRIAD, "units": {"gyro": "dps"}, "unit": "g"}, OptionError, "unit 'g': expected that of a column"),
        ({"gyro": TRIAD, "units": "deg/s"}, OptionError, "units: expected a mapping from names, found 'deg/s'"),
        ({"accel": TRIAD.T, "unit": "g"}, DataError, r"accel: expected .* \(n, 3\), found \(3, 4\) \(transposed\?\)"),
        ({"accel": TRIAD[:, 0], "unit": "g"}, DataError, r"accel: expected an array of shape \(n, 3\), found \(4,\)"),
        ({"gyro_1": TRIAD[None], "unit": "dps"}, DataError, r"gyro_1: expected an array of shape \(n,\), found \(1, 4"),
        ({"accel": [["a", "b", "c"]], "unit": "g"}, DataError, "column accel: expected numbers, found texts"),
        ({"accel": [[1, 2, 3], [4, 5]], "unit": "g"}, DataError, "column accel: expected numbers"),
        ({"accel": TRIAD, "gyro": TRIAD[1:], "unit": "count"}, DataError, "gyro_x has 3 rows, accel_x has 4"),
        ({"accel": TRIAD, "unit": "g", "rate": 1, "time": [0, 1, 2, 3]}, OptionError, "time and rate: expected one"),
        ({"accel": TRIAD, "unit": "g", "rate": 0}, OptionError, "rate 0: expected a number of samples per second"),
        ({"accel": TRIAD, "unit": "g", "rate": "100 Hz"}, OptionError, "rate: expected a number, found '100 Hz'"),
        ({"acel": TRIAD, "unit": "g"}, OptionError, "unknown name 'acel'; did you mean 'accel'?"),
        ({"Accel": TRIAD, "unit": "g"}, UnitError, "column 'Accel': expected the name 'accel'"),
        ({"unit": "g"}, DataError, "expected data, found no columns"),
    ],
)  # fmt: skip
def test_arrays_that_cannot_be_are_refused_in_a_line(given, error, words):
    with pytest.raises(error, match=words) as refused:
        il.Recording.from_arrays(**given)
    assert "\n" not in str(refused.value)


@FRAMES
def test_a_frame_is_read_as_a_file_is(library):
    frame = library.DataFrame(
        {"time [ms]": [0, 10, 20, 30], "accel_x [m/s²]": [1.0, 2.0, 3.0, 4.0], "gyro_x": [1, 2, 3, 4], "p": [0.5] * 4}
    )
    made = il.Recording.from_frame(frame, {"gyro": "deg/s"}, metadata={"serial": "7"})
    assert dict(made.units) == {"time": "ms", "accel_x": "m/s^2", "gyro_x": "deg/s", "p": "1"}
    np.testing.assert_array_equal(made.column("gyro_x"), [1.0, 2.0, 3.0, 4.0])
    assert all(column.dtype == np.float64 for column in made.columns.values())
    assert made.metadata["serial"] == "7"


@FRAMES
@pytest.mark.parametrize(
    ("columns", "given", "words"),
    [
        (
            {"accel_x": [1.0]}, {},
            r"column accel_x has no unit; expected a title such as 'accel_x \[m/s\^2\]', or units=\{'accel': 'm/s\^2'",
        ),
        ({"time": [1.0]}, {}, r"column time has no unit; expected a title such as 'time \[s\]'"),
        ({"temperature": [1.0]}, {"unit": "count"}, "column temperature has no unit"),
        ({"accel_x [g]": [1.0]}, {"units": {"accel": "mg"}}, "column accel_x .g.: units has 'mg' for it; expected one"),
        ({"accel_x [g": [1.0]}, {}, "expected 'name .unit.'"),
        ({"Accel_X [g]": [1.0]}, {}, "expected the name 'accel_x'"),
        ({"accel_x [g]": ["1.5"]}, {}, "column accel_x .g.: expected numbers, found texts"),
        ({"time [s]": [1.0], "accel_x [g]": [1.0]}, {"rate": 10}, "time and rate: expected one of the two"),
    ],
)  # fmt: skip
def test_frames_that_cannot_be_are_refused_in_a_line(library, columns, given, words):
    with pytest.raises(ImulabError, match=words) as refused:
        il.Recording.from_frame(library.DataFrame(columns), **given)
    assert "\n" not in str(refused.value)
    assert str(refused.value).startswith("frame: ")


@FRAMES
def test_missing_values_of_a_frame_are_not_numbers(library):
    values = pandas.array([1, None], dtype="Int64") if library is pandas else [1, None]
    made = il.Recording.from_frame(library.DataFrame({"accel_x [g]": values}))
    np.testing.assert_array_equal(made.column("accel_x"), [1.0, np.nan])


@pytest.mark.parametrize("where", ["column", "index"])
def test_dates_of_a_frame_become_seconds(where):
    dates = pandas.date_range("2026-11-23", periods=3, freq="20ms", tz="Europe/Berlin")
    frame = pandas.DataFrame({"accel_x [g]": [1.0, 2.0, 3.0]}, index=dates if where == "index" else None)
    if where == "column":
        frame["time"] = dates.tz_localize(None)
    np.testing.assert_allclose(il.Recording.from_frame(frame).column("time"), [0.0, 0.02, 0.04], atol=1e-15)


def test_a_pandas_frame_of_two_levels_is_read_and_one_that_names_a_column_twice_is_refused():
    frame = pandas.DataFrame(TRIAD, columns=pandas.MultiIndex.from_product([["accel"], ["x", "y", "z"]]))
    np.testing.assert_array_equal(il.Recording.from_frame(frame, unit="g").triad("accel"), TRIAD)
    frame.columns = ["accel_x [g]", "accel_y [g]", "accel_x [g]"]
    with pytest.raises(DataError, match=r"column accel_x \[g\] appears twice"):
        il.Recording.from_frame(frame)


def test_a_frame_has_the_library_that_is_asked_for():
    made = il.Recording.from_arrays(accel=TRIAD, unit="g")
    assert isinstance(made.to_frame(), pandas.DataFrame)
    assert isinstance(made.to_frame("polars"), polars.DataFrame)
    with pytest.raises(OptionError, match="library 'dask': expected one of pandas polars"):
        made.to_frame("dask")


@pytest.fixture(scope="module")
def logged(tmp_path_factory):
    """One recording as a file, and what people make of it."""
    path = tmp_path_factory.mktemp("front") / "rec.csv"
    il.write_csv(il.simulate_tumble(order=2, gravity=G, seed=4), path)
    recording = il.read(path)
    head = {"metadata": dict(recording.metadata)}
    time, accel = recording.column("time"), recording.triad("accel")
    return {
        "path": (path, {}),
        "text": (str(path), {}),
        "recording": (recording, {}),
        "pandas": (recording.to_frame("pandas"), {}),
        "polars": (recording.to_frame("polars"), {}),
        "untitled": (pandas.DataFrame(accel, columns=["accel_x", "accel_y", "accel_z"]).assign(time=time), {
            "unit": "m/s^2", "units": {"time": "s"},
        }),
        "array": (accel, {"time": time, "unit": "m/s^2"}),
        "list": (accel.tolist(), {"time": time, "unit": "m/s^2"}),
        "mapping": ({"time": time, "accel [m/s^2]": accel}, {}),
        "made": (il.Recording.from_arrays(accel=accel, time=time, unit="m/s^2", **head), {}),
        "attitudes": (il.find_attitudes(recording), {}),
    }  # fmt: skip


FORMS = ("path", "text", "recording", "pandas", "polars", "untitled", "array", "list", "mapping", "made", "attitudes")


@pytest.mark.parametrize("form", FORMS)
def test_a_tumble_test_is_fitted_in_every_form_to_the_same_bits(logged, form):
    data, reading = logged[form]
    found = il.fit_tumble(data, order=2, gravity=G, **reading).calibration
    by_hand = il.fit_tumble(il.find_attitudes(il.read(logged["path"][0])), order=2, gravity=G).calibration
    # The temperature of the test is in the file alone; no parameter depends on it.
    assert found.parameters == by_hand.parameters
    assert found.covariance == by_hand.covariance
    assert bool(found.sources) == (form in ("path", "text", "recording", "attitudes"))


def test_the_rate_of_an_array_stands_for_its_times(logged):
    accel = logged["array"][0]
    found = il.find_attitudes(accel, rate=100.0, unit="m/s^2", window=1.0)
    np.testing.assert_allclose(found.mean, logged["attitudes"][0].mean, rtol=1e-12)


def test_a_check_and_a_correction_take_files_frames_and_arrays(logged, tmp_path):
    path, recording = logged["path"][0], logged["recording"][0]
    il.fit_tumble(path, order=2, gravity=G).save(tmp_path / "rec.json")
    record = il.load(tmp_path / "rec.json")
    expected = il.check_tumble(record, il.find_attitudes(recording), gravity=G)
    for data, reading in (logged["pandas"], logged["array"]):
        assert il.check_tumble(tmp_path / "rec.json", data, gravity=G, **reading).probability == expected.probability
    corrected = il.apply(record, recording).triad("accel")
    for data, reading in (logged[form] for form in ("path", "polars", "array", "mapping")):
        np.testing.assert_array_equal(il.apply(tmp_path / "rec.json", data, **reading).triad("accel"), corrected)


def test_a_window_and_an_imu_of_several_are_cut_out_of_everything(logged):
    path, recording = logged["path"][0], logged["recording"][0]
    expected = il.find_attitudes(il.read(path, window=(20.0, 90.0)))
    for data, reading in (logged["recording"], logged["pandas"], logged["array"]):
        for window in ("20:90", (20.0, 90.0)):
            fit = il.fit_tumble(data, order=1, gravity=G, window=window, **reading)
            assert len(fit.residuals) == len(expected)
    titled = recording.to_frame().rename(columns=lambda title: re.sub("^(accel|gyro)_(.)", r"\1_\2_7", title))
    one = il.find_attitudes(titled, element=7)
    np.testing.assert_array_equal(one.mean, il.find_attitudes(recording).mean)
    with pytest.raises(DataError, match="no column accel_x, but one of each of 1 IMUs"):
        il.find_attitudes(titled)


def test_means_of_attitudes_may_have_covariances():
    rng = np.random.default_rng(5)
    directions = rng.normal(size=(30, 3))
    means = directions / np.linalg.norm(directions, axis=1)[:, None] + rng.normal(0, 1e-4, (30, 3)) + [0.01, 0.02, 0.03]
    columns = {f"accel_{axis}": means[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"std_accel_{axis}": np.full(30, 1e-4) for axis in "xyz"}
    table = il.Recording.from_arrays(unit="g", **columns)
    stated = il.fit_tumble(table, order=1, gravity=G).calibration
    for covariance in (1e-8 * np.eye(3), np.broadcast_to(1e-8 * np.eye(3), (30, 3, 3))):
        given = il.fit_tumble(means, unit="g", order=1, gravity=G, covariance=covariance).calibration
        for name, parameter in stated.parameters.items():
            assert given.parameters[name].value == pytest.approx(parameter.value, rel=1e-12)
            assert given.parameters[name].standard_uncertainty == pytest.approx(parameter.standard_uncertainty)
    without = il.fit_tumble(means, unit="g", order=1, gravity=G).calibration
    assert without.fit["noise"] != stated.fit["noise"]


@pytest.mark.parametrize(
    ("covariance", "words"),
    [
        (np.eye(2), r"covariance: expected the shape \(3, 3\) or \(9, 3, 3\), found \(2, 2\)"),
        (np.ones((3, 3)), "covariance: expected positive definite"),
        (np.triu(np.ones((3, 3))), "covariance: expected symmetric"),
        (np.full((3, 3), np.nan), "covariance: expected symmetric matrices of finite numbers"),
        ("1e-8", r"covariance: expected the shape"),
        (["a"], "covariance: expected numbers"),
    ],
)
def test_covariances_that_cannot_be_are_refused(covariance, words):
    with pytest.raises(DataError, match=words):
        il.fit_tumble(np.random.default_rng(1).normal(size=(9, 3)), unit="g", covariance=covariance)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda r, a: il.fit_tumble(r, gravty=9.8), "fit_tumble: unknown option 'gravty'.*did you mean 'gravity'"),
        (lambda r, a: il.fit_tumble(r, unit="g"), "fit_tumble: unit does not go with such data: a recording has its"),
        (lambda r, a: il.fit_tumble(r, layout="x.toml"), "fit_tumble: layout does not go with such data: only files"),
        (lambda r, a: il.fit_tumble("rec.csv", rate=100), "fit_tumble: rate does not go with such data: a file says"),
        (lambda r, a: il.fit_tumble(a, rate=100), "fit_tumble: rate does not go with attitudes"),
        (lambda r, a: il.fit_tumble(a, covariance=np.eye(3)), "covariance: the recording itself says how certain"),
        (lambda r, a: il.fit_tumble(r.triad("accel")), "arrays: column accel_x has no unit; expected units="),
        (lambda r, a: il.fit_tumble(r.triad("accel")[:, 0], unit="g"), "data: expected an array of numbers, a row for"),
        (lambda r, a: il.fit_tumble(None), "data: expected a file name, a Recording, .*, found None"),
        (lambda r, a: il.fit_tumble(lambda: 3), "data: expected a file name, a Recording, .*, found <function"),
        (lambda r, a: il.fit_tumble("no.csv"), "no.csv: no such file"),
        (lambda r, a: il.fit_tumble(r.to_frame(), time=r.time), "time does not go with such data: a data frame has it"),
        (lambda r, a: il.fit_tumble(r, window=10), r"window: expected \(FROM, TO\) in s, .*, found 10"),
        (lambda r, a: il.fit_tumble(r, window="10"), "window '10': expected FROM:TO"),
        (lambda r, a: il.fit_tumble(r, window=(1e6, 2e6)), "nothing in the window"),
        (lambda r, a: il.fit_tumble(r, element="2"), "element: expected a whole number, found '2'"),
        (lambda r, a: il.fit_tumble(r, element=2), "no columns of several IMUs"),
        (lambda r, a: il.fit_tumble(r, prior=r), "fit_tumble: prior: expected a record .*wrong order"),
        (lambda r, a: il.check_tumble(r, a), "check_tumble: record: expected a record .*, found the recording"),
        (lambda r, a: il.apply(r, r), "apply: record: expected a record .*, found the recording"),
        (lambda r, a: il.find_attitudes(r, windw=2), "find_attitudes: unknown option 'windw'.*did you mean 'window'"),
        (lambda r, a: il.find_attitudes(a), "find_attitudes: data: expected a file name.*found Attitudes"),
    ],
)
def test_a_call_that_cannot_be_is_refused_in_a_line(logged, call, words):
    with pytest.raises(ImulabError, match=words) as refused:
        call(logged["recording"][0], logged["attitudes"][0])
    assert "\n" not in str(refused.value)


SCRIPT = """
import imulab as il
import LIBRARY

fit = il.fit_tumble(LIBRARY.read_csv("recording.csv"), gravity=9.81362)
fit.save("sn42.json")
fit.plot("residual").save("residuals.html")
"""


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_five_lines_lead_from_a_data_frame_to_a_record_and_a_picture(library, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = il.simulate_tumble(order=1, gravity=9.81362)
    made.to_frame("polars").write_csv("recording.csv")
    script = SCRIPT.replace("LIBRARY", library)
    assert sum(bool(line) for line in script.splitlines()) == 5
    exec(script, {})
    off = il.load("sn42.json").value("bias_x") - float(made.metadata["truth_bias_x"])
    assert abs(off) < 1e-3
    assert "Residual" in (tmp_path / "residuals.html").read_text(encoding="utf-8")


def test_the_only_figure_is_saved_as_a_picture_without_being_chosen(tmp_path, monkeypatch):
    saved = []
    monkeypatch.setattr("imulab.report.plots.Plot.save", lambda plot, path: saved.append((plot.name, path)))
    il.allan_deviation(np.arange(64.0) % 3, rate=10.0).plot().save(tmp_path / "one.png")
    assert saved == [("Allan deviation, samples", tmp_path / "one.png")]

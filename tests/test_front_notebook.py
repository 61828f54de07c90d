"""What a person types first in a notebook: data frames of their own, fits handed on, and mistakes."""

import numpy as np
import polars
import pytest

import imulab as il
from imulab.errors import DataError, OptionError


@pytest.fixture(scope="module")
def frame():
    return il.simulate_tumble(attitudes=18, order=1, gravity=9.81).to_frame()


@pytest.fixture(scope="module")
def fit(frame):
    return il.fit_tumble(frame, order=1, gravity=9.81)


@pytest.fixture(scope="module")
def cycles():
    return il.simulate_warmup(temperatures=(-20.0, 0.0, 40.0), cycles=1, duration="10 min")


def test_a_corrected_frame_has_the_index_and_the_texts_of_the_frame(frame, fit):
    some = frame.iloc[1000:1010].assign(label="run A")
    corrected = fit.apply(some)
    assert corrected.index.equals(some.index)
    assert list(corrected["label"]) == ["run A"] * 10
    some["corrected"] = corrected["accel_x [m/s^2]"]
    assert np.isfinite(some["corrected"]).all()
    again = fit.apply(polars.from_pandas(some))
    assert again["label"].to_list() == ["run A"] * 10
    np.testing.assert_array_equal(again["accel_x [m/s^2]"], corrected["accel_x [m/s^2]"])


def test_a_cell_that_is_run_twice_corrects_once(frame, fit):
    corrected = fit.apply(frame)
    with pytest.raises(DataError, match=r"already corrected by tumble.*again=True"):
        fit.apply(corrected.iloc[100:200])
    twice = fit.apply(corrected, again=True)
    assert len(twice.attrs["corrected_by"]) == 2


def test_columns_of_others_keep_title_type_and_values(frame, fit):
    some = frame.iloc[:50].assign(ok=True, n=range(50), **{"speed [km/h]": 3.5})
    corrected = fit.apply(some)
    for title in ("ok", "n", "speed [km/h]"):
        assert corrected[title].dtype == some[title].dtype
        assert list(corrected[title]) == list(some[title])
    assert set(corrected.columns) == set(some.columns)
    assert set(fit.apply(polars.from_pandas(some)).columns) == set(some.columns)


def test_a_sensor_of_texts_is_refused_as_before(frame, fit):
    with pytest.raises(DataError, match=r"column accel_x.*expected numbers, found texts"):
        fit.apply(frame.assign(**{"accel_x [m/s^2]": "1.0 g"}))


def test_columns_of_other_names_are_answered_by_the_line_that_renames_them(frame):
    own = frame.rename(columns=lambda title: title.split(" [")[0].replace("accel_", "a"))[["ax", "ay", "az"]]
    with pytest.raises(DataError, match=r"no column accel_x; found ax ay az; .*df\.rename\(columns=\{'ax': 'accel_x'"):
        il.fit_tumble(own.rename_axis("row"), gravity=9.81)


def test_warm_up_cycles_in_frames_state_where_they_began(cycles):
    frames = [cycle.to_frame() for cycle in cycles]
    with pytest.raises(DataError, match=r"metadata=\{'power_on_temperature': -20\}"):
        il.fit_warmup(frames)
    numbers = [float(cycle.metadata["power_on_temperature"]) for cycle in cycles]
    stated = [
        il.Recording.from_frame(each, metadata={"power_on_temperature": at})
        for each, at in zip(frames, numbers, strict=True)
    ]
    record = il.fit_warmup(stated, temperatures=(-20, 0, 40)).calibration
    with pytest.raises(DataError, match="nothing corrected; expected it in the metadata"):
        record.apply(frames[0])
    with pytest.raises(DataError, match=r"not within the table.*nothing corrected"):
        il.apply(record, il.Recording.from_frame(frames[0], metadata={"power_on_temperature": 95}))
    whole = il.apply(record, stated[0])
    assert whole.corrected_by
    begun = frames[0].assign(**{"temperature [degC]": numbers[0]})
    title = next(name for name in frames[0].columns if name.startswith("gyro"))
    corrected = record.apply(begun, temperature_column=True)
    np.testing.assert_allclose(corrected[title], whole.column(title.split(" [")[0]), rtol=1e-12)


def test_a_plan_takes_the_fit_whose_noise_it_is_for_and_says_its_own(fit):
    plan = il.plan_tumble(18, noise=fit, order=1)
    assert plan.uncertainties() == plan.uncertainties(plan.noise)
    stated = il.plan_tumble(18, noise="20 ug", order=1)
    assert stated.uncertainties()["bias_x"] == pytest.approx(stated.uncertainties("20 ug")["bias_x"])
    assert plan.noise == il.plan_tumble(18, noise=fit.calibration, order=1).noise


def test_a_record_is_no_page(fit, tmp_path):
    for name in ("r.html", "r.PDF"):
        with pytest.raises(OptionError, match="a record is JSON"):
            fit.save(tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_arguments_in_the_wrong_order_are_said_to_be(fit, tmp_path):
    with pytest.raises(OptionError, match=r"a TumbleFit .arguments in the wrong order"):
        il.export(fit, "c", tmp_path)


def test_a_notebook_shows_the_line_and_the_message_alone(monkeypatch):
    with pytest.raises(OptionError) as caught:
        il.normal_gravity(0.8, height=1e6)
    shown = caught.value._render_traceback_()
    assert shown[-1] == f"OptionError: {caught.value}"
    assert len(shown) == 2
    assert "il.normal_gravity(0.8, height=1e6)" in shown[0]
    monkeypatch.setenv("IMULAB_DEBUG", "1")
    assert any("gravity.py" in line for line in caught.value._render_traceback_())


def test_the_text_of_a_curve_has_its_unit():
    still = il.simulate_array(experiment="static", duration=60.0)
    curve = il.allan_deviation(still, column="gyro_1")
    least = 3600 * np.degrees(curve.deviation.min())
    assert f"least deviation {least:.3g} deg/h at" in repr(curve)
    assert "least deviation 0 at" in repr(il.allan_deviation(np.tile([1.0, -1.0], 8), rate=10.0))


def test_metadata_may_be_numbers_and_nothing_else():
    made = il.Recording({"accel_x": np.zeros(3)}, {"accel_x": "g"}, {"serial": 42, "power_on_temperature": -20.5})
    assert made.metadata == {"serial": "42", "power_on_temperature": "-20.5"}
    with pytest.raises(DataError, match="expected a text"):
        il.Recording({"accel_x": np.zeros(3)}, {"accel_x": "g"}, {"serial": ["a"]})

"""A live session from the plug to the record: over pseudo-terminals, with its recording, cut short in every way."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from datetime import date
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.errors import OptionError
from imulab.live.guide import read_targets
from imulab.live.runner import Recorder
from imulab.live.session import Session
from imulab.live.view import in_words

FIT = ["--gravity", "9.81+-0", "--order", "1"]


def session_of(recording: il.Recording, **options: object) -> tuple[Session, list]:
    session, events = Session(order=1, **options), []
    times = recording.time
    for start in range(0, len(times), 5):
        part = {name: column[start : start + 5] for name, column in recording.columns.items()}
        events += session.feed(il.Recording(part, recording.units, recording.metadata))
    return session, events


def content(record: Path) -> dict:
    found = json.loads(record.read_text())
    return {key: value for key, value in found.items() if key not in ("created", "content_sha256")}


def test_a_session_sees_the_attitudes_that_segmentation_finds_later():
    recording = il.simulate_tumble(attitudes=14, order=1, gravity=9.81, gyro=False)
    session, events = session_of(recording, planned=14)
    found = il.find_attitudes(recording)
    kept = session.guide.kept
    assert len(kept) == len(found) == 14
    means = np.array([each.mean for each in kept])
    # Both mean the same hold, cut a little differently: they differ by far less than 0.7 mg per sample.
    assert np.abs(means - found.mean).max() < 5e-4 * 9.81
    assert [event.kind for event in events].count("accepted") == 14
    assert session.enough


def test_a_hold_is_shown_within_a_second_of_stillness():
    recording = il.simulate_tumble(attitudes=8, order=1, gravity=9.81, hold="4 s", move="2 s", gyro=False)
    _, events = session_of(recording, planned=8)
    shown = [event.time for event in events if event.text in ("hold still",)]
    begins = 6.0 * np.arange(1, 8)
    # The unit rings for 0.4 s (five times 0.08 s) when it is put down; it is still from then on.
    late = [min(t for t in shown if t > begin) - begin - 0.4 for begin in begins]
    assert max(late) <= 1.0


@pytest.mark.slow
def test_a_knocked_attitude_is_named_and_can_be_dropped():
    recording = il.simulate_tumble(
        attitudes=16, order=1, gravity=9.81, noise="0.1 mg", knock=9, knock_shift=0.02 * 9.81, gyro=False
    )
    session, events = session_of(recording, planned=20)
    knocked = [event.text for event in events if event.kind == "knocked"]
    assert any("knocked? put it down again, or press u to drop it" in text for text in knocked)
    number = next(held.number for held in session.view().attitudes if held.aside)
    assert session.drop() is not None
    assert number not in [held.number for held in session.view().attitudes]


def test_an_attitude_is_dropped_by_its_number():
    session, _ = session_of(il.simulate_tumble(attitudes=9, order=1, gravity=9.81, gyro=False), planned=9)
    third = session.guide.kept[2]
    assert session.drop(3) == (third.start, third.stop)
    assert [held.number for held in session.view().attitudes] == [1, 2, 4, 5, 6, 7, 8, 9]
    with pytest.raises(OptionError, match="attitude 3: there is none of this number; expected one of 1 2 4 5 6 7 8 9"):
        session.drop(3)


@pytest.mark.slow
def test_each_parameter_is_held_against_its_target():
    recording = il.simulate_tumble(attitudes=16, order=1, gravity=9.81, gyro=False)
    session, _ = session_of(recording, targets=read_targets("bias 100 ug, scale_factor 200 ppm"))
    fit, known = session.guide.fit, {each.name: each for each in session.view().parameters}
    for axis in "xyz":
        bias, scale = (fit.calibration.parameters[f"{stem}_{axis}"] for stem in ("bias", "scale_factor"))
        assert known[f"bias_{axis}"].share == pytest.approx(bias.standard_uncertainty / (1e-4 * 9.80665))
        assert known[f"scale_factor_{axis}"].share == pytest.approx(scale.standard_uncertainty / scale.value / 2e-4)
    assert {each.share for name, each in known.items() if name.startswith("misalignment")} == {None}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c: {k: v / 9.81 if k[:5] == "accel" else v for k, v in c.items()}, "is its unit g"),
        (lambda c: c | {"accel_y": np.zeros(len(c["time"]))}, "accel_y has read 0 since the beginning"),
        (lambda c: c | {"accel_z": np.minimum(c["accel_z"], 6.0)}, "clipped"),
        (lambda c: c | {"temperature": 20 + 0.1 * c["time"]}, "temperature"),
    ],
)
def test_what_is_wrong_with_a_unit_is_said_when_it_happens(change, said):
    recording = il.simulate_tumble(attitudes=12, order=1, gravity=9.81, hold="6 s", gyro=False)
    changed = il.Recording(change(dict(recording.columns)), recording.units)
    _, events = session_of(changed)
    warnings = [event.text for event in events if event.kind == "warning"]
    assert sum(said in text for text in warnings) >= 1
    assert len(warnings) == len(set(warnings))


@pytest.mark.parametrize(
    ("settings", "warned", "times"),
    [
        ("gravity=1", "no record can be made of these 9 attitudes: columns accel_x accel_y accel_z: the", 2),
        ("hold=0.3", "10 times put down without an attitude: each needs 1.8 s at rest", 13),
        ("hold=1.5", "10 times put down without an attitude: each needs 1.8 s at rest", 8),
        ("hold=60,move=100,rate=20,noise=500mg", "", 0),
    ],
)
def test_a_simulation_without_a_record_warns_and_comes_to_an_end(
    settings, warned, times, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    source = f"simulate:speed=0,{settings}"
    assert main(["live", source, "--plain", "--attitudes", "8", "--save", "rec.csv", "-o", "r.json"]) == 2
    out, err = capsys.readouterr()
    ending = warned.partition(" ")[2].partition("9 ")[0] or "no new attitude for 300 s"
    assert err.startswith("imulab: simulated unit: ")
    assert err.count("\n") == 1
    assert ending in err
    assert "rec.csv keeps" in err
    assert warned in out
    assert out.count("no record can be made") + out.count("put down without an attitude") == times
    assert out.count("(1 to go)") <= 2  # order 1 has 9 parameters
    assert not (tmp_path / "r.json").exists()


@pytest.mark.slow
def test_a_good_unit_is_not_warned_of(reduced):
    for seed in range(1, 3 if reduced else 6):
        _, events = session_of(il.simulate_tumble(attitudes=12, order=1, gravity=9.81, gyro=False, seed=seed))
        assert not [event.text for event in events if event.kind in ("warning", "knocked")]


@pytest.mark.slow
def test_the_same_samples_give_the_same_events():
    recording = il.simulate_tumble(attitudes=8, order=1, gravity=9.81)
    assert session_of(recording)[1] == session_of(recording)[1]


def test_directions_in_words():
    assert in_words(np.array([-1.0, 0.0, 0.05])) == "x down"
    assert in_words(np.array([-0.8, 0.6, 0.0])) == "x half down, y half up"


def test_the_record_equals_that_of_tumble_fit(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["live", "simulate:speed=0,gravity=9.81", "--follow", "--plain", "--attitudes", "12", *FIT]
    assert main([*words, "--save", "rec.csv", "-o", "live.json", "--report", "r.html"]) == 0
    assert main(["tumble", "fit", "rec.csv", *FIT, "-o", "fit.json"]) == 0
    assert content(tmp_path / "live.json") == content(tmp_path / "fit.json")
    assert content(tmp_path / "live.json")["fit"]["attitudes"] == 12
    assert (tmp_path / "r.html").stat().st_size > 10_000


def test_a_recording_that_is_there_is_not_overwritten(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("rec.csv").write_text("mine\n")
    assert main(["live", "simulate:speed=0", "--follow", "--plain", "--save", "rec.csv"]) == 2
    assert "rec.csv: is there already; --resume goes on with it" in capsys.readouterr().err
    assert Path("rec.csv").read_text() == "mine\n"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["simulate"], "--save: expected the name"),
        (["simulate", "--save", "rec.parquet"], "expected a name that ends in .csv"),
        (["simulate", "--save", "rec.csv", "--attitudes", "3"], "expected 4 to 200"),
        (["simulate", "--save", "rec.csv", "--attitudes", "9", "--target", "bias 1 mg"], "one or the other"),
        (["simulate", "--save", "rec.csv", "--target", "bias 0.1"], "'bias 0.1': 0.1 without a unit: expected one of"),
        (["simulate", "--save", "rec.csv", "--order", "7"], "--order '7'"),
        (["tcp:no.such.host.invalid:9", "--save", "rec.csv"], "no machine of this name"),
        (["replay:none.csv", "--save", "rec.csv", "--plain"], "none.csv: no such file"),
        (["udp:5005", "--save", "rec.csv", "--layout", "none.toml"], "no such layout"),
    ],
)
def test_mistakes_are_one_line_and_leave_no_file(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["live", *words]) == 2
    error = capsys.readouterr().err.strip()
    assert said in error
    assert "\n" not in error
    assert not list(tmp_path.iterdir())


def test_twenty_sudden_ends_leave_a_recording_to_go_on_with(tmp_path):
    path = tmp_path / "rec.csv"
    recording = il.simulate_tumble(attitudes=2, gravity=9.81, gyro=False)
    rng = np.random.default_rng(5)
    for turn in range(20):
        recorder = Recorder(str(path), resume=turn > 0)
        for _ in recorder.before():
            pass
        recorder.write(recorder.placed(recording), 0.0)
        recorder.flush()
        recorder._file.close()  # what a killed process leaves: no end of the line, here and there
        data = path.read_bytes()
        path.write_bytes(data[: len(data) - int(rng.integers(0, 60))])
    Recorder(str(path), resume=True).close()
    read = il.read(path)
    assert np.diff(read.time).min() > 0
    assert 20 * len(recording) - 20 * 3 <= len(read) <= 20 * len(recording)


@pytest.mark.parametrize("arrives", [True, False])
def test_a_recording_of_what_arrives_has_its_day(tmp_path, arrives):
    recording = il.simulate_tumble(attitudes=2, gravity=9.81, gyro=False)
    head = recording.metadata | ({"format": "lines"} if arrives else {})
    before = str(date.today())
    recorder = Recorder(str(tmp_path / "rec.csv"), resume=False)
    recorder.write(replace(recording, metadata=head), 0.0)
    recorder.close()
    day = il.read(tmp_path / "rec.csv").source.measured
    assert day in ((before, str(date.today())) if arrives else (None,))


def test_a_full_disk_keeps_whole_lines(tmp_path, monkeypatch):
    recording = il.simulate_tumble(attitudes=2, gravity=9.81, gyro=False)
    recorder = Recorder(str(tmp_path / "rec.csv"), resume=False)
    recorder.write(recording, 0.0)
    recorder.flush()

    class Full:
        """A file on a disk that takes 100 bytes more."""

        def __init__(self, file):
            self.file, self.left = file, 100

        def write(self, data):
            if not self.left:
                raise OSError(28, "No space left on device")
            self.left = 0
            return self.file.write(data[:100])

        def __getattr__(self, name):
            return getattr(self.file, name)

    recorder._file = Full(recorder._file)
    later = recording.with_columns({"time": recording.columns["time"] + 100}, {})
    recorder.write(later, 0.0)
    with pytest.raises(OptionError, match="the disk is full; what came before is kept"):
        recorder.flush()
    recorder._file.close()
    kept = il.read(tmp_path / "rec.csv")
    assert len(recording) <= len(kept) < len(recording) + 3
    np.testing.assert_allclose(kept.time[-1], np.append(recording.time, later.time)[len(kept) - 1])


def test_the_view_is_drawn_in_every_state():
    from rich.console import Console

    from imulab.live.terminal import draw

    console = Console(width=120, record=True, file=StringIO())
    console.print(draw(Session(order=1).view()))
    recording = il.simulate_tumble(attitudes=12, order=1, gravity=9.81, gyro=False)
    session, _ = session_of(recording, planned=12)
    console.print(draw(session.view(), 120, 40))
    text = console.export_text()
    assert "misalignment yx zx zy" in text
    assert "enough: five more would bring" in text


def test_what_five_more_attitudes_would_bring_is_of_the_order_that_is_fitted():
    """Attitudes are planned for order 3, which has a parameter more than 14 attitudes."""
    recording = il.simulate_tumble(attitudes=14, order=1, gravity=9.81, hold="3 s", move="1 s", gyro=False)
    session = Session(order="auto", planned=14)
    session.feed(recording)
    now, then = map(float, re.findall(r"[\d.]+", session.view().enough))
    assert 0.5 * now < then < now


def test_what_a_higher_order_explains_is_no_knocked_attitude():
    recording = il.simulate_tumble(
        attitudes=14, order=2, gravity=9.81, noise="0.1 mg", hold="3 s", move="1 s", seed=7, gyro=False
    )
    _, events = session_of(recording, planned=14)
    assert not [event.text for event in events if event.kind == "knocked"]
    (said,) = [event.text for event in events if event.text.startswith("the model is too simple: order ")]
    assert "none is set aside; fit with --order " in said


@pytest.mark.slow
def test_it_is_not_enough_before_the_degrees_of_freedom_that_a_record_is_not_remarked_on_for():
    recording = il.simulate_tumble(attitudes=16, order=1, gravity=9.81, gyro=False)
    session, events = session_of(recording, targets=read_targets("bias 50 mg"))
    (first,) = [event.time for event in events if event.kind == "enough"][:1]
    accepted = [event.time for event in events if event.kind == "accepted" and event.time <= first]
    assert len(accepted) == 9 + 5
    assert session.guide.fit is not None
    assert not [w for w in session.guide.fit.calibration.verdict.reasons if "of freedom" in w]


def test_the_view_has_the_last_ten_seconds_of_readings():
    recording = il.simulate_tumble(attitudes=4, order=1, gravity=9.81, hold="4 s", move="1 s", gyro=False)
    session, _ = session_of(recording)
    rows = np.array(session.view().strip)
    assert rows.shape == (100, 7)
    np.testing.assert_allclose(np.diff(rows[:, 0]), 0.1, atol=0.011)
    assert -0.1 <= rows[-1, 0] <= 0
    times, values = recording.time, recording.triad("accel")
    end = times[len(times) // 10 * 10 - 1]
    for time, *ranges in rows[::9].tolist():
        tenth = values[(times > end + time - 0.095) & (times < end + time + 0.005)]
        assert len(tenth) == 10
        np.testing.assert_allclose(ranges, [*tenth.min(axis=0), *tenth.max(axis=0)], rtol=1e-4)


def test_where_the_unit_lies_as_wanted_it_is_to_be_put_down():
    session, _ = session_of(il.simulate_tumble(attitudes=4, order=1, gravity=9.81, gyro=False), planned=12)
    session.state, wanted = "moving", session.next
    session._reading = 9.81 * wanted
    assert session.view().advice == "that is it: put it down"
    session._reading = -9.81 * wanted
    assert session.view().advice.startswith("turn it: ")

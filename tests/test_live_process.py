"""`imulab live` as a process on a pseudo-terminal: from the plug to the record, killed, unplugged and refused."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.gravity import Gravity
from imulab.live.runner import Runner
from imulab.live.session import Session
from imulab.live.sources import open_source
from liveports import content, device, lines_of, live

pytest.importorskip("serial", reason="pyserial is in the extra [live]")
FIT = ["--gravity", "9.81+-0", "--order", "1"]
SPEED = 8


def tumble(attitudes: int, **options: object) -> il.Recording:
    """A test at 100 Hz with holds of 4 s."""
    given = {"order": 1, "gravity": 9.81, "hold": "4 s", "move": "1 s", "gyro": False, "noise": "0.3 mg"} | options
    return il.simulate_tumble(attitudes=attitudes, **given)


def fitted(folder: Path, *words: str) -> dict:
    done = subprocess.run(
        [sys.executable, "-m", "imulab", "tumble", "fit", "rec.csv", *words, "-o", "fit.json"],
        cwd=folder,
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return content(folder / "fit.json")


def test_from_the_plug_to_the_record(tmp_path):
    recording = tumble(20)
    with device(lines_of(recording), 100 * SPEED) as unit:
        words = [f"serial:{unit.port}", "--plain", "--attitudes", "10", *FIT, "--save", "rec.csv", "-o", "live.json"]
        with live(words, tmp_path) as process:
            assert process.ended() == 0, process.text
    assert "titles with units: time accel_x accel_y accel_z" in process.text
    saved = il.read(tmp_path / "rec.csv")
    sent = np.searchsorted(np.round(recording.time * 1e6), np.round(saved.si("time") * 1e6))
    assert unit.follow(sent)
    for name in ("accel_x", "accel_y", "accel_z"):
        np.testing.assert_array_equal(saved.columns[name], recording.columns[name][sent].round(5))
    assert content(tmp_path / "live.json") == fitted(tmp_path, *FIT)


@pytest.mark.slow
def test_a_place_stands_for_gravity_and_is_in_the_command_that_makes_the_record_again(tmp_path):
    words = [
        "simulate:speed=40",
        "--follow",
        "--plain",
        "--attitudes",
        "12",
        "--order",
        "1",
        "--place",
        "48.1,11.6,520",
    ]
    with live([*words, "--save", "rec.csv", "-o", "live.json"], tmp_path) as process:
        assert process.ended() == 0, process.text
    assert "imulab tumble fit rec.csv --order 1 --place 48.1,11.6,520 makes the same record" in process.text
    record = content(tmp_path / "live.json")
    assert record["model"]["gravity"]["from"].startswith("normal gravity at latitude 48.1 deg, height 520 m")
    assert record == fitted(tmp_path, "--order", "1", "--place", "48.1,11.6,520")


def kills(folder: Path, times: int, seed: int) -> None:
    """Kill a session again and again, then let it end; what it had a second before is in the file each time."""
    rng, recording = np.random.default_rng(seed), tumble(100 + 7 * times, seed=seed)
    lines, stamps = lines_of(recording), np.round(recording.time * 1e6)
    with device(lines, 100 * SPEED) as unit:
        words = [f"serial:{unit.port}", "--plain", "--resume", "--attitudes", "12", *FIT, "--save", "rec.csv"]
        kept = np.empty(0)
        for _ in range(times):
            sent = len(unit.sent)
            with live(words, folder) as process:
                begun = process.said("titles with units")
                last = begun + rng.uniform(0, 3)
                while process.running and time.monotonic() < last:
                    time.sleep(0.01)
                killed = time.monotonic()
                process.kill()
            before, kept = kept, saved_stamps(folder)
            assert (kept[: len(before)] == before).all()
            new = kept[len(before) :]
            due = [stamps[k] for k, t in unit.sent[sent:] if t < killed - 1.0 - SLACK]
            if killed > begun + 1.0 + SLACK:
                assert len(new)
                assert new[-1] >= due[-1]
            # Whole rows that follow one another, from where this session began to listen.
            assert unit.follow(np.searchsorted(stamps, new))
        with live([*words, "-o", "live.json"], folder) as process:
            assert process.ended() == 0, process.text
    saved = il.read(folder / "rec.csv")
    places = np.searchsorted(stamps, np.round(saved.si("time") * 1e6))
    for name in ("accel_x", "accel_y", "accel_z"):
        np.testing.assert_array_equal(saved.columns[name], recording.columns[name][places].round(5))
    assert content(folder / "live.json") == fitted(folder, *FIT)


SLACK = 0.3
"""What the pipe, the pseudo-terminal and two busy processors may take, s."""


def saved_stamps(folder: Path) -> np.ndarray:
    """Stamps of the rows that are whole, read apart from imulab."""
    rows = (folder / "rec.csv").read_bytes().split(b"\n")[:-1]
    return np.array([float(row.split(b",")[0]) for row in rows if row[:1].isdigit()])


@pytest.mark.slow
def test_killed_twenty_times_and_gone_on_with(tmp_path, reduced):
    kills(tmp_path, 3 if reduced else 20, 2)


def rows_of(recording: il.Recording, seconds: int) -> list[str]:
    """Titles, and each sample as a row; every sample of the last `seconds` twice, one with a stamp of hours ahead."""
    values = np.column_stack([recording.time, recording.triad("accel")])
    rows = [",".join(f"{value:.4f}" for value in row) for row in values.tolist()]
    rows[1700] = f"7217.0000,{rows[1700].partition(',')[2]}"
    last = len(rows) - 100 * seconds
    rows[last:] = [row for row in rows[last:] for _ in (0, 1)]
    return ["time [s],accel_x [m/s^2],accel_y [m/s^2],accel_z [m/s^2]", *rows]


def from_standard_input(folder: Path, lines: list[str]) -> subprocess.CompletedProcess[str]:
    words = ["live", "-", "--plain", "--attitudes", "40", *FIT, "--save", "rec.csv", "-o", "live.json"]
    return subprocess.run(
        [sys.executable, "-m", "imulab", *words],
        cwd=folder, input="\n".join([*lines, ""]), capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip


@pytest.mark.slow
def test_what_was_wrong_with_a_stream_is_said_and_left_out(tmp_path):
    recording = tumble(14)
    done = from_standard_input(tmp_path, rows_of(recording, 10))
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("a sample whose time fits neither those before nor those after is left out") == 1
    assert "samples came again and are left out: is each sent once?" in done.stdout
    count = len(recording) - 1
    left = "1 lost, 1000 came again and left out, 1 with a time that fits nowhere and left out"
    assert f"imulab: note: of what came beside {count} samples: {left}\n" in done.stderr
    np.testing.assert_array_equal(il.read(tmp_path / "rec.csv").time, np.delete(recording.time, 1700).round(4))


@pytest.mark.slow
def test_titles_that_become_others_end_a_session_that_can_be_gone_on_with(tmp_path):
    lines = rows_of(tumble(14), 0)
    lines.insert(4000, lines[0].replace("accel_x", "gyro_x"))
    done = from_standard_input(tmp_path, lines)
    assert done.returncode == 2
    said = done.stderr.splitlines()[-1]
    assert said.startswith("imulab: standard input: the stream's titles have changed from 'time [s],accel_x ")
    assert ": expected the same columns and units to the end. rec.csv keeps " in said
    assert said.endswith(" attitudes: --resume goes on with it")
    assert len(il.read(tmp_path / "rec.csv")) == 3999 - 1


@pytest.mark.slow
def test_the_gyroscopes_follow_the_accelerometers(tmp_path):
    recording = tumble(20, gyro=True)
    with device(lines_of(recording), 100 * SPEED) as unit:
        words = [f"serial:{unit.port}", "--plain", "--attitudes", "14", *FIT, "--save", "rec.csv", "-o", "live.json"]
        with live(words, tmp_path) as process:
            assert process.ended() == 0, process.text
    fitted(tmp_path, *FIT)
    words = ["tumble", "gyro", "rec.csv", "--accel", "fit.json", "-o", "both.json"]
    subprocess.run([sys.executable, "-m", "imulab", *words], cwd=tmp_path, capture_output=True, timeout=60, check=True)
    assert content(tmp_path / "live.json") == content(tmp_path / "both.json")
    assert "gyro_scale_factor_x" in content(tmp_path / "live.json")["parameters"]


@pytest.mark.slow
@pytest.mark.parametrize("dead", [False, True])
def test_the_magnetometers_follow_too_or_are_left_out_with_the_reason(tmp_path, dead):
    recording = tumble(20, gyro=True, field="48 uT")
    if dead:
        recording = recording.with_columns({"mag_x": np.full(len(recording), 12.0)}, {})
    il.write_csv(recording, tmp_path / "given.csv")
    words = ["replay:given.csv@20", "--plain", "--attitudes", "14", *FIT, "--save", "rec.csv", "-o", "live.json"]
    with live(words, tmp_path) as process:
        assert process.ended() == 0, process.text
    assert "a quarter turn about the vertical from the last" in process.text
    further = "gyro" if dead else "gyro,mag"
    assert content(tmp_path / "live.json") == fitted(tmp_path, *FIT, "--with", further)
    command = f"imulab tumble fit rec.csv --order 1 --gravity 9.81+-0 --with {further}"
    assert f"{command} makes the same record" in process.text
    assert ("the magnetometers are not calibrated: rec.csv: column mag_x" in process.text) == dead


@pytest.mark.slow
def test_the_view_has_gyroscopes_and_magnetometers_while_the_session_lasts(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    recording = tumble(18, gyro=True, field="48 uT")
    il.write_csv(recording, "given.csv")
    session = Session(1, Gravity(9.81, "test"), (), 18)
    runner = Runner.open(lambda: open_source("replay:given.csv@40"), session, "rec.csv", None, resume=False)
    end, said = time.monotonic() + 40, []
    try:
        while time.monotonic() < end and len(said) < 2:
            said += [event.text for event in runner.step(0.05) if event.kind == "further"]
        rows = {row.name: row for row in session.view().parameters}
    finally:
        runner.close()
    assert said == [
        f"the {triad} are calibrated from the attitudes so far; each further one makes them better"
        for triad in ("gyroscopes", "magnetometers")
    ]
    assert abs(rows["dip"].value - 67) < 6 * rows["dip"].standard_uncertainty
    for axis in "xyz":
        bias, truth = rows[f"gyro_bias_{axis}"], float(recording.metadata[f"truth_gyro_bias_{axis}"])
        assert abs(bias.value - 3600 * np.degrees(truth)) < 6 * bias.standard_uncertainty
        assert rows[f"gyro_scale_factor_{axis}"].standard_uncertainty is not None

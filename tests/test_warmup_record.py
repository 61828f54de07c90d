"""What a warm-up record must refuse, hold and say: clocks, starts, edges, dead columns, the worst temperature."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.display import Bad, Finding, Note
from imulab.errors import DataError
from imulab.exporters import export
from imulab.procedures.registry import load_any
from imulab.procedures.views import exhibits_of
from imulab.procedures.warmup.fit import fit_warmup
from imulab.procedures.warmup.model import evaluate, record_table

AT = (-20.0, 0.0, 20.0)
AXES = ("gyro_x", "gyro_y")
HOUR = np.pi / 180 / 3600


def curve(time: Any, power_on: float) -> Any:
    """Deg/h: two stages whose size is linear in the power-on temperature."""
    return (60 - power_on) * np.exp(-time / 15.0) + (40 + 0.5 * power_on) * np.exp(-time / 70.0)


def cycle(power_on: float, seed: int, seconds: float = 400.0) -> il.Recording:
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 0.2)
    columns = {
        axis: (1 + k) * curve(time, power_on) * (1 + 0.02 * rng.standard_normal()) + rng.normal(5, 2, len(time))
        for k, axis in enumerate(AXES)
    }
    head = {"power_on_temperature": f"{power_on:g}", "serial": "U1"}
    return il.Recording({"time": time, **columns}, {"time": "s", **dict.fromkeys(AXES, "deg/h")}, head, name="cycle")


def cycles(shift: float = 0.0) -> list[il.Recording]:
    return [cycle(t + shift * (-1) ** k, 10 * i + k) for i, t in enumerate(AT) for k in range(2)]


def fit(recordings: list[il.Recording] | None = None, **options: Any) -> Any:
    return fit_warmup(recordings or cycles(), **{"temperatures": AT, "settling_time": 300.0, **options})


@cache
def fitted(model: str, **options: str) -> Any:
    """The record of a model, made once."""
    return fit(model=model, **options).calibration


@pytest.fixture(scope="module")
def folder(tmp_path_factory: Any) -> Path:
    path: Path = tmp_path_factory.mktemp("warm")
    fit(model="exponential").calibration.save(path / "zero.json")
    fit(model="exponential", beyond="hold").calibration.save(path / "hold.json")
    return path


def changed(recording: il.Recording, **columns: Any) -> il.Recording:
    return replace(recording, columns={**recording.columns, **columns})


def with_temperature(recording: il.Recording, temperature: Any) -> il.Recording:
    columns = {**recording.columns, "temperature": temperature}
    return replace(recording, columns=columns, units={**recording.units, "temperature": "degC"})


def refused(capsys: Any, folder: Path, recording: il.Recording, *options: str) -> str:
    il.write_csv(recording, folder / "in.csv")
    out = folder / "out.csv"
    assert main(["apply", str(folder / "zero.json"), str(folder / "in.csv"), "-o", str(out), *options]) == 2
    error: str = capsys.readouterr().err
    assert error.count("\n") == 1
    assert not out.exists()
    return error


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t - 3.0, "before power-on"),
        (lambda t: t + 20.0, "the first sample is 20 s after power-on; expected at most 5 s"),
        (lambda t: np.where(np.arange(len(t)) == 100, np.nan, t), "row 101"),
        (lambda t: np.where(np.arange(len(t)) == 100, t - 1.0, t), "runs backwards"),
        (lambda t: 1e3 * t, "expected 2e-05 to 4 s: is the unit of time right: "),
        (lambda t: 1e-5 * t, "expected 2e-05 to 4 s: is the unit of time right?"),
    ],
    ids=["negative", "late", "nan", "backwards", "milliseconds", "too fast"],
)
def test_apply_asks_of_time_what_fit_asks(folder: Path, capsys: Any, change: Any, words: str) -> None:
    recording = cycle(3.0, 1)
    wrong = changed(recording, time=change(recording.columns["time"]))
    assert words in refused(capsys, folder, wrong)
    with pytest.raises(il.ImulabError, match=words.replace("(", ".")):
        fit([*cycles()[1:], wrong])


@pytest.mark.parametrize(("title", "factor", "right"), [("ms", 1.0, "s"), ("s", 1e3, "ms"), ("min", 1.0, "s")])
def test_a_unit_of_time_that_is_wrong_is_asked_for_by_the_one_that_is_likely(
    title: str, factor: float, right: str
) -> None:
    recording = cycle(3.0, 1)
    wrong = replace(
        changed(recording, time=factor * recording.columns["time"]), units={**recording.units, "time": title}
    )
    with pytest.raises(il.ImulabError, match=rf"is the unit of time right: 5 Hz if it is in {right}\?"):
        fit([*cycles()[1:], wrong])


def test_a_late_start_is_allowed_when_it_is_asked_for(folder: Path, capsys: Any) -> None:
    recording = cycle(3.0, 1)
    time = recording.columns["time"] + 20.0
    late = changed(recording, time=time)
    il.write_csv(late, folder / "late.csv")
    out = folder / "late_out.csv"
    options = ["--latest-start", "30 s", "-o", str(out)]
    assert main(["apply", str(folder / "zero.json"), str(folder / "late.csv"), *options]) == 0
    z = evaluate(record_table(il.load(folder / "zero.json")), time, 3.0)
    want = late.columns["gyro_x"] - z[0] / HOUR
    np.testing.assert_allclose(il.read(out).column("gyro_x"), want, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("temperature", [None, "nan", "21.01", "-21.01"])
def test_nothing_corrected_is_refused_and_says_why(folder: Path, capsys: Any, temperature: str | None) -> None:
    recording = cycle(0.0, 1)
    head = {} if temperature is None else {"power_on_temperature": temperature}
    assert "temperature" in refused(capsys, folder, replace(recording, metadata=head))


def test_a_recording_from_after_the_warm_up_has_nothing_to_correct(folder: Path, capsys: Any) -> None:
    recording = cycle(0.0, 1)
    late = changed(recording, time=recording.columns["time"] + 500.0)
    assert "the correction has ended (300 s)" in refused(capsys, folder, late, "--latest-start", "1000 s")


@pytest.mark.parametrize("model", ["interval-cubic", "knot-cubic", "knot-log-cubic", "exponential"])
@pytest.mark.parametrize(("temperature", "edge"), [(-45.0, -20.0), (21.0, 20.0), (80.0, 20.0), (5.0, 5.0)])
def test_beyond_hold_goes_on_as_at_the_edges_on_the_desk_and_in_the_unit(
    tmp_path: Path, model: str, temperature: float, edge: float
) -> None:
    record = fitted(model, beyond="hold")
    start = cycle(temperature, 5)
    z = evaluate(record_table(fitted(model)), start.columns["time"], edge)
    assert z is not None
    want = start.columns["gyro_y"] - z[1] / HOUR
    np.testing.assert_allclose(il.apply(record, start).column("gyro_y"), want, atol=1e-9)
    (blob,) = export("blob", [record], tmp_path)
    found = il.apply(load_any(blob), start).column("gyro_y")
    np.testing.assert_allclose(found, want, atol=0.02)
    held = evaluate(record_table(record), start.columns["time"], temperature)
    np.testing.assert_allclose(held, z)


def test_hold_survives_record_and_spreadsheet(folder: Path, capsys: Any) -> None:
    assert il.load(folder / "hold.json").sections["table"]["beyond"] == "hold"
    assert "beyond" not in il.load(folder / "zero.json").sections["table"]
    table, again = str(folder / "t.csv"), str(folder / "again.json")
    assert main(["warmup", "table", str(folder / "hold.json"), "-o", table]) == 0
    assert main(["warmup", "table", table, "-o", again]) == 0
    assert il.load(again).sections["table"] == il.load(folder / "hold.json").sections["table"]
    with pytest.raises(il.ImulabError, match="beyond 'later': expected one of zero hold"):
        fit(beyond="later")


@pytest.mark.parametrize("model", ["interval-cubic", "knot-cubic", "knot-log-cubic", "exponential"])
@pytest.mark.parametrize(("temperature", "edge"), [(-20.371, -20.0), (-21.0, -20.0), (20.9, 20.0), (5.0, 5.0)])
def test_a_start_within_the_tolerance_of_an_outer_temperature_is_corrected_as_there(
    tmp_path: Path, model: str, temperature: float, edge: float
) -> None:
    record = fitted(model)
    start = cycle(temperature, 5)
    z = evaluate(record_table(record), start.columns["time"], edge)
    assert z is not None
    want = start.columns["gyro_y"] - z[1] / HOUR
    np.testing.assert_allclose(il.apply(record, start).column("gyro_y"), want, atol=1e-9)
    (blob,) = export("blob", [record], tmp_path)
    np.testing.assert_allclose(il.apply(load_any(blob), start).column("gyro_y"), want, atol=0.02)
    np.testing.assert_allclose(evaluate(record_table(record), start.columns["time"], temperature), z)


@pytest.mark.parametrize("temperature", [-21.01, 21.01, 60.0])
def test_a_start_beyond_the_tolerance_is_not_corrected(temperature: float) -> None:
    record = fit().calibration
    start = cycle(temperature, 5)
    with pytest.raises(DataError, match=r"not within the table.*nothing corrected"):
        il.apply(record, start)
    assert evaluate(record_table(record), start.columns["time"], temperature) is None


def test_a_table_from_before_there_was_a_tolerance_ends_at_its_edges() -> None:
    record = fit().calibration
    table = {key: value for key, value in record.sections["table"].items() if key != "tolerance"}
    old = replace(record, sections={"table": table})
    start = cycle(-20.01, 5)
    with pytest.raises(DataError, match=r"not within the table.*nothing corrected"):
        il.apply(old, start)
    inside = cycle(-20.0, 5)
    np.testing.assert_allclose(il.apply(old, inside).column("gyro_y"), il.apply(record, inside).column("gyro_y"))


def test_a_power_on_temperature_comes_from_the_column_when_that_is_asked_for(folder: Path, capsys: Any) -> None:
    recording = cycle(3.0, 1, seconds=30000.0)  # several blocks, of which only the first knows the power-on
    warming = 3.0 + np.minimum(recording.columns["time"] / 20, 12.0)
    bare = replace(with_temperature(recording, warming), metadata={})
    assert "no power_on_temperature" in refused(capsys, folder, bare)
    out = folder / "column.csv"
    command = ["apply", str(folder / "zero.json"), str(folder / "in.csv"), "-o", str(out), "--temperature-column"]
    assert main(command) == 0
    found, want = il.read(out), il.apply(il.load(folder / "zero.json"), recording)
    np.testing.assert_allclose(found.column("gyro_x"), want.column("gyro_x"), rtol=1e-12, atol=1e-9)
    assert found.metadata["power_on_temperature"] == "3.0"
    assert found.metadata["power_on_temperature_from"] == "the first reading of the column temperature"
    err = capsys.readouterr().err
    assert "150000 rows of " in err
    assert err.count("the power-on temperature was taken from the first reading of the column temperature") == 1
    assert "no reading in a column temperature" in refused(
        capsys, folder, replace(cycle(3.0, 1), metadata={}), "--temperature-column"
    )


def test_a_power_on_temperature_of_the_head_counts_before_the_column(folder: Path) -> None:
    recording = cycle(3.0, 1)
    both = with_temperature(recording, np.full(len(recording), 19.0))
    il.write_csv(both, folder / "both.csv")
    out = folder / "both_out.csv"
    assert (
        main(["apply", str(folder / "zero.json"), str(folder / "both.csv"), "-o", str(out), "--temperature-column"])
        == 0
    )
    want = il.apply(il.load(folder / "zero.json"), recording)
    np.testing.assert_allclose(il.read(out).column("gyro_x"), want.column("gyro_x"), rtol=1e-12, atol=1e-9)


def test_axes_that_a_recording_lacks_are_left_and_noted_once(folder: Path, capsys: Any) -> None:
    recording = cycle(3.0, 1)
    part = replace(recording, columns={k: v for k, v in recording.columns.items() if k != "gyro_y"})
    il.write_csv(part, folder / "part.csv")
    out = folder / "part_out.csv"
    assert main(["apply", str(folder / "zero.json"), str(folder / "part.csv"), "-o", str(out)]) == 0
    notes = [line for line in capsys.readouterr().err.splitlines() if "gyro_y" in line]
    assert len(notes) == 1
    assert notes[0].startswith("imulab: note: ")
    assert "no gyro_y in it: " in notes[0]
    want = il.apply(il.load(folder / "zero.json"), recording)
    np.testing.assert_allclose(il.read(out).column("gyro_x"), want.column("gyro_x"), rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("model", ["interval-cubic", "knot-cubic"])
def test_a_table_goes_out_and_comes_back_in_powers_of_seconds(tmp_path: Path, model: str) -> None:
    record = fit(model=model).calibration
    record.save(tmp_path / "r.json")
    table, again = str(tmp_path / "t.csv"), str(tmp_path / "again.json")
    assert main(["warmup", "table", str(tmp_path / "r.json"), "--per-second", "-o", table]) == 0
    lines = [line for line in Path(table).read_text().splitlines() if not line.startswith("#")]
    assert lines[0].endswith("axis,unit,c0,c1 [1/s],c2 [1/s^2],c3 [1/s^3]")
    powers = np.array([float(cell) for cell in lines[1].split(",")[-4:]])  # the coldest row of gyro_x
    at = 137.0
    z = evaluate(record_table(record), np.array([at]), -20.0)
    assert z is not None
    assert powers @ at ** np.arange(4) == pytest.approx(z[0, 0], rel=1e-12)
    assert main(["warmup", "table", table, "-o", again]) == 0
    mine, its = il.load(again).sections["table"], record.sections["table"]
    np.testing.assert_allclose(mine.pop("coefficients"), its["coefficients"], rtol=1e-14)
    assert mine == {key: value for key, value in its.items() if key != "coefficients"}


def test_only_cubics_in_time_have_powers_of_seconds(folder: Path, capsys: Any) -> None:
    assert main(["warmup", "table", str(folder / "zero.json"), "--per-second", "-o", str(folder / "p.csv")]) == 2
    assert "a table of model exponential has no powers of t" in capsys.readouterr().err
    assert not (folder / "p.csv").exists()


@pytest.mark.slow
def test_a_stuck_gyro_a_pause_and_rows_of_zeros_are_said() -> None:
    good = cycles()
    stuck = [changed(r, gyro_x=np.full(len(r), 7.0)) for r in good]
    (said,) = (w for w in fit(stuck).calibration.warnings if "never changes" in w)
    assert isinstance(said, Bad)
    assert said.startswith("gyro_x never changes in cycle")
    paused = good[1].columns["gyro_y"].copy()
    paused[500:560] = paused[500]
    (said,) = (
        w for w in fit([good[0], changed(good[1], gyro_y=paused), *good[2:]]).calibration.warnings if "stuck" in w
    )
    assert isinstance(said, Bad)
    every = np.arange(len(good[0])) % 50 == 3
    zeroed = [changed(r, **{axis: np.where(every, 0.0, r.columns[axis]) for axis in AXES}) for r in good]
    found = fit(zeroed, model="exponential")
    assert [w for w in found.calibration.warnings if "exactly zero were left out" in w]
    clean = fit(model="exponential")
    time = np.linspace(0, 290, 30)
    off = evaluate(found.table, time, 3.0) - evaluate(clean.table, time, 3.0)
    assert np.abs(off).max() < 1.5 * HOUR  # with the zeros in: 3 deg/h
    assert not [w for w in clean.calibration.warnings if "stuck" in w or "never" in w or "zero" in w]


@pytest.mark.slow
@pytest.mark.parametrize(("every", "kind"), [(3000, Note), (500, Finding)])
def test_few_rows_of_zeros_are_a_note(every: int, kind: type) -> None:
    """Outputs in steps of a sixth of their noise read zero on all axes by chance, once in some thousand rows."""
    rows = [np.arange(len(r)) % every == 7 for r in cycles()]
    zeroed = [
        changed(r, **{axis: np.where(row, 0.0, r.columns[axis]) for axis in AXES})
        for r, row in zip(cycles(), rows, strict=True)
    ]
    (said,) = (w for w in fit(zeroed, model="exponential").calibration.warnings if "exactly zero were left out" in w)
    assert type(said) is kind


def test_a_knock_that_fills_whole_bins_is_left_out_and_an_odd_cycle_is_named() -> None:
    good = [replace(r, name=f"cycle_{k}.csv") for k, r in enumerate(cycles())]
    knocked = good[1].columns["gyro_x"].copy()
    knocked[500:510] += 3e4  # 100 to 102 s
    found = fit([good[0], changed(good[1], gyro_x=knocked), *good[2:]], model="exponential")
    assert [w for w in found.calibration.warnings if "moved" in w and "cycle_1.csv (4 s, first at 99 s)" in w]
    clean = fit(good, model="exponential")
    time = np.linspace(0, 290, 30)
    off = evaluate(found.table, time, -20.0) - evaluate(clean.table, time, -20.0)
    assert np.abs(off).max() < 0.5 * HOUR
    stepped = good[3].columns["gyro_y"] + 300.0 * (good[3].columns["time"] > 100)
    odd = fit([*good[:3], changed(good[3], gyro_y=stepped), *good[4:]], model="exponential").calibration
    (said,) = (w for w in odd.warnings if "differs from the others" in w)
    assert "gyro_y" in said
    assert "cycle_3.csv" in said
    assert not [w for w in clean.calibration.warnings if "differs" in w or "moved" in w]


def test_time_must_rise_from_block_to_block(folder: Path) -> None:
    from imulab.procedures.apply import apply_blocks

    start = cycle(3.0, 1)
    first = replace(start, columns={n: v[:500] for n, v in start.columns.items()})
    second = replace(start, columns={n: v[400:] for n, v in start.columns.items()}, first_row=501)
    with pytest.raises(il.ImulabError, match=r"row 501.*time does not rise"):
        list(apply_blocks([il.load(folder / "zero.json")], [first, second]))


def test_the_worst_temperature_is_what_the_gap_makes_of_a_bent_law() -> None:
    """Z = c(T) exp(-t / 40 s), c quadratic in T: linear knots err by c'' h^2 / 8 in the middle of the wide gap."""
    at, size = (-20.0, -10.0, 0.0, 30.0, 40.0), 0.05
    time = np.arange(0.0, 400.0, 0.2)
    rng = np.random.default_rng(3)
    recordings = [
        il.Recording(
            {"time": time, "gyro_x": size * t**2 * np.exp(-time / 40.0) + 1e-3 * rng.standard_normal(len(time)),
             "gyro_y": 1e-3 * rng.standard_normal(len(time))},
            {"time": "s", "gyro_x": "deg/h", "gyro_y": "deg/h"}, {"power_on_temperature": f"{t:g}"}, name=f"{t:g} {k}",
        )
        for t in at for k in range(2)
    ]  # fmt: skip
    record = fit(recordings, temperatures=at, model="knot-cubic").calibration
    assert record.fit["worst_temperature"]["value"] == 15.0
    shape = np.exp(-np.arange(0.0, 300.0, 0.2) / 40.0)
    reference = np.exp(-np.arange(300.0, 400.0, 0.2) / 40.0).mean()
    want = size * 30.0**2 / 4 * np.sqrt(np.mean((shape - reference) ** 2))
    assert record.value("worst_temperature_error_gyro_x") / HOUR == pytest.approx(
        np.hypot(want, record.value("training_error_gyro_x") / HOUR), rel=0.1
    )
    misfit = record.fit["curve_misfit"]["rms"]["gyro_x"]
    assert misfit["unit"] == "rad/s"
    assert misfit["value"][0] / HOUR > 0.01  # a cubic is no exponential, most of all at first
    worst = record.value("worst_temperature_error_gyro_x") / HOUR
    (note,) = [each for each in record.warnings if "at the worst power-on temperature" in each]
    assert f"near 15 degC, expect {worst:.3g} deg/h (gyro_x) rms in the worst axis" in note
    label, shown = exhibits_of(record).facts[2]
    assert label == "at worst, near 15 °C"
    assert float(shown.removesuffix(" deg/h, rms of axes")) == pytest.approx(worst / np.sqrt(2), rel=0.06)


@pytest.mark.parametrize("kind", ["whole seconds", "twice"])
def test_shared_stamps_are_corrected_as_the_readings_they_are(folder: Path, kind: str) -> None:
    """The rows, their order and their stamps stay; the correction is that of even times, or of the stamp."""
    from imulab.procedures.apply import apply_blocks

    even = cycle(3.0, 1)
    rows = np.arange(len(even))
    if kind == "twice":
        rows = np.sort(np.append(rows, 70))
    stamps = np.floor(even.columns["time"] + 1e-9) if kind == "whole seconds" else even.columns["time"][rows]
    shared = replace(even, columns={name: values[rows] for name, values in even.columns.items()} | {"time": stamps})
    record = il.load(folder / "zero.json")
    known = il.apply(record, even)
    blocks = [
        replace(shared, columns={n: v[a : a + 501] for n, v in shared.columns.items()}, first_row=a + 1)
        for a in range(0, len(rows), 501)
    ]
    for found in ([il.apply(record, shared)], list(apply_blocks([record], blocks))):
        time = np.concatenate([block.columns["time"] for block in found])
        np.testing.assert_array_equal(time, stamps)
        for axis in AXES:
            values = np.concatenate([block.columns[axis] for block in found])
            np.testing.assert_allclose(
                values, known.columns[axis][rows], rtol=0, atol=1e-9 * HOUR if kind == "twice" else 0.5
            )


def test_a_clock_that_stood_still_is_not_corrected(folder: Path) -> None:
    start = cycle(3.0, 1)
    time = start.columns["time"].copy()
    time[500:600] = time[500]
    with pytest.raises(il.ImulabError, match=r"row 502.*time stands still for 100 rows"):
        il.apply(il.load(folder / "zero.json"), replace(start, columns={**start.columns, "time": time}))

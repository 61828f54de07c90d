"""A thermal record at work: recordings corrected, the same in C and in a blob, and what a person can get wrong."""

from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.procedures.apply import apply_blocks, warnings_of
from reference import thermal as reference

G = reference.G
KINDS = (("bias", "xyz"), ("scale_factor", "xyz"), ("misalignment", ("yx", "zx", "zy")))


@pytest.fixture(scope="module")
def made():
    return list(il.simulate_thermal(attitudes=8))


@pytest.fixture(scope="module")
def record(made):
    return il.fit_thermal(made).calibration


def triad_of(record):
    """The record's laws in the triad written apart, whose temperatures count from 20 degC."""
    triad = reference.Triad(np.random.default_rng(0))
    triad.laws = [
        [[record.value(n) for n in record.parameters if n == f"{kind}_{axis}" or n.startswith(f"{kind}_{axis}_t")]
         for axis in axes]
        for kind, axes in KINDS
    ]  # fmt: skip
    return triad


def wandering(n=400, seed=4):
    """Outputs of any size at temperatures within the range and beyond it."""
    rng = np.random.default_rng(seed)
    temperature = np.repeat(rng.uniform(-40, 80, n // 4), 4)
    return il.Recording.from_arrays(
        accel=rng.uniform(-20, 20, (n, 3)), temperature=temperature, rate=100.0, unit="m/s^2"
    )


def test_corrected_as_by_the_model_inverted_by_hand(record):
    given = wandering()
    triad, middle = triad_of(record), record.model["reference_temperature"]["value"]
    held = np.clip(given.column("temperature"), *record.model["range"])
    expected = [triad.correct(m, t - middle + 20.0) for m, t in zip(given.triad("accel"), held, strict=True)]
    assert np.abs(il.apply(record, given).triad("accel") - expected).max() < 1e-12 * 20


def test_blocks_of_any_size_give_the_same_bits(record):
    given = wandering()
    whole = il.apply(record, given).triad("accel")
    for size in (1, 7, 100):
        pieces = [slice(k, k + size) for k in range(0, len(given), size)]
        blocks = [replace(given, columns={k: v[part] for k, v in given.columns.items()}) for part in pieces]
        found = np.vstack([block.triad("accel") for block in apply_blocks([record], blocks)])
        assert found.tobytes() == whole.tobytes()


def test_the_exported_unit_agrees_to_the_last_bit(record, tmp_path, self_test):
    il.export("c", record, tmp_path / "unit")
    run = self_test(tmp_path / "unit")
    assert run.returncode == 0, run.stdout
    assert "pass, worst 0 of full scale" in run.stdout


def test_a_blob_corrects_as_its_record_does_in_single_precision(record, tmp_path):
    (file,) = il.export("blob", record, tmp_path)
    given = wandering()
    found, expected = (il.apply(one, given).triad("accel") for one in (file, record))
    assert 0 < np.abs(found - expected).max() < 2e-6 * 2 * G


def test_a_row_without_a_temperature_is_not_a_number(record):
    given = wandering()
    temperature = given.column("temperature").copy()
    temperature[10] = np.nan
    lost = given.with_columns({"temperature": temperature}, {})
    found = il.apply(record, lost).triad("accel")
    assert np.isnan(found[10]).all()
    assert np.isfinite(np.delete(found, 10, axis=0)).all()
    said = warnings_of(record, lost)
    assert any("1 rows without a temperature" in each for each in said)
    assert any("of 400 rows lie outside the -19.7" in each and "as at the end of the range" in each for each in said)


def test_kelvins_and_the_chosen_column_are_understood(record, made):
    given = wandering()
    kelvins = given.with_columns({"temperature": given.column("temperature") + 273.15}, {"temperature": "K"})
    expected = il.apply(record, given).triad("accel")
    assert np.abs(il.apply(record, kelvins).triad("accel") - expected).max() < 1e-11
    board = [
        each.with_columns({"temperature_board": each.column("temperature"), "temperature": np.full(len(each), 21.0)},
                          {"temperature_board": "degC"})
        for each in made
    ]  # fmt: skip
    chosen = il.fit_thermal(board, temperature_column="temperature_board").calibration
    both = given.with_columns({"temperature_board": given.column("temperature")}, {"temperature_board": "degC"})
    both = both.with_columns({"temperature": np.full(len(both), 21.0)}, {})
    assert np.abs(il.apply(chosen, both).triad("accel") - expected).max() < 1e-12
    with pytest.raises(il.ImulabError, match="no column temperature_board"):
        il.apply(chosen, given)


def test_what_cannot_be_corrected_is_refused_in_one_line(record, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = wandering()
    il.write(replace(given, columns={k: v for k, v in given.columns.items() if k != "temperature"}), "bare.csv")
    il.write(given, "full.csv")
    record.save("thermal.json")
    assert main(["apply", "thermal.json", "bare.csv", "-o", "out.csv"], project=False) == 2
    said = capsys.readouterr().err.strip()
    assert "no column temperature" in said
    assert "\n" not in said
    assert not (tmp_path / "out.csv").exists()
    assert main(["apply", "thermal.json", "full.csv", "-o", "out.csv"], project=False) == 0
    with pytest.raises(il.ImulabError, match="already"):
        il.apply(record, il.apply(record, given))


def test_what_would_correct_twice_or_out_of_turn_is_refused(record, made, tmp_path):
    tumble = il.fit_tumble(il.simulate_tumble(gravity=G), order=1, gravity=G).calibration
    warmup = il.fit_warmup(il.simulate_warmup([0, 20, 40], rate=1.0), temperatures="0,20,40").calibration
    gyros = il.fit_warmup(
        il.simulate_warmup([0, 20, 40], rate=1.0), temperatures="0,20,40", axes="gyro_x,gyro_y,gyro_z"
    ).calibration
    for records, said in (
        ([tumble, record], "a tumble and a thermal record together"),
        ([record, tumble], "a tumble and a thermal record together"),
        ([warmup, record], "a warm-up record before a thermal one"),
        ([record, warmup], "whose cycles no thermal record had corrected"),
    ):
        with pytest.raises(il.ImulabError, match=said):
            next(apply_blocks(records, [wandering()]))
        with pytest.raises(il.ImulabError, match=said):
            il.export("c", records, tmp_path / "out")
        assert not (tmp_path / "out").exists()
    assert il.export("blob", [record, gyros], tmp_path / "out")

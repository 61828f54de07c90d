"""A thermal record at work: recordings corrected, the same in C and in a blob, and what a person can get wrong."""

import hashlib
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.procedures.apply import apply_blocks, warn_before_applying
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


@pytest.mark.slow
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
    said = warn_before_applying(record, lost)
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


def cycle(triad, ambient, number, rng, noise=2e-4):
    """A power cycle at rest, z up: the sensor is 8 K warmer after some minutes, its outputs 20 s behind."""
    time = np.arange(0.1, 600.0, 0.1)
    heat, slow, fast = 8.0, 120.0, 20.0
    thermometer = ambient + heat * (1 - np.exp(-time / slow))
    lagging = ambient + heat * (1 - (slow * np.exp(-time / slow) - fast * np.exp(-time / fast)) / (slow - fast))
    laws = [[np.polynomial.polynomial.polyval(lagging - 20.0, law) for law in group] for group in triad.laws]
    bias, scale, _ = laws  # a force along z alone is not turned by misalignment
    sensed = (0.0, 0.0, G)
    output = [scale[i] * (sensed[i] + bias[i]) + noise * rng.standard_normal(len(time)) for i in range(3)]
    columns = {"time": time, **{f"accel_{a}": output[i] for i, a in enumerate("xyz")}, "temperature": thermometer}
    units = {"time": "s", **{f"accel_{a}": "m/s^2" for a in "xyz"}, "temperature": "degC"}
    head = {"power_on_temperature": f"{ambient:.2f}", "gravity": f"{G} m/s^2"}
    return il.Recording(columns=columns, units=units, metadata=head, name=f"cycle_{ambient:g}_{number}.csv")


@pytest.fixture(scope="module")
def unit():
    rng = np.random.default_rng(2)
    triad = reference.Triad(rng)
    soaks = []
    for k, at in enumerate((-20, 0, 25, 45, 60)):
        outputs, temperature = reference.soak(triad, rng, at, 12, 20e-6 * G)
        columns = {f"accel_{axis}": outputs[:, i] for i, axis in enumerate("xyz")}
        columns |= {f"std_accel_{axis}": np.full(12, 20e-6 * G) for axis in "xyz"}
        units = dict.fromkeys(columns, "m/s^2") | {"temperature": "degC"}
        soaks.append(
            il.Recording(columns=columns | {"temperature": temperature}, units=units,
                         metadata={"gravity": f"{G} m/s^2"}, name=f"soak_{k}")
        )  # fmt: skip
    thermal = il.fit_thermal(soaks, degrees="3,2,1").calibration
    cycles = [cycle(triad, at, number, rng) for at in (-10.0, 10.0, 30.0) for number in (1, 2)]
    options = {"temperatures": "-10,10,30", "settling_time": "300 s", "model": "knot-cubic"}
    raw = il.fit_warmup(cycles, **options).calibration
    after = il.fit_warmup([il.apply(thermal, each) for each in cycles], **options).calibration
    return triad, thermal, cycles, raw, after


def test_a_warm_up_record_names_the_thermal_record_of_its_cycles(unit, tmp_path):
    _, thermal, _, raw, after = unit
    assert raw.model["after"] is None
    assert after.model["after"] == thermal.sealed()[0]
    after.save(tmp_path / "after.json")
    assert il.load(tmp_path / "after.json").model["after"] == thermal.sealed()[0]


def test_in_the_right_order_what_the_temperature_does_not_tell_is_taken_off(unit):
    """The error against the settled law shrinks at each step; the raw curve with the thermal record is worse."""
    triad, thermal, _, raw, after = unit
    fresh = cycle(triad, 11.0, 9, np.random.default_rng(9))
    early = fresh.column("time") < 300

    def off(recording):
        error = recording.triad("accel")[early] - [0.0, 0.0, G]
        return np.sqrt(np.mean([part.mean(axis=0) ** 2 for part in np.array_split(error, 60)]))

    once = il.apply(thermal, fresh)
    both = il.apply(after, once)
    assert off(both) < 0.5 * off(once) < 0.5 * off(fresh)
    wrong = il.apply(replace(raw, model={**raw.model, "after": thermal.sealed()[0]}), once)
    assert off(wrong) > 5 * off(both)


@pytest.mark.parametrize(
    ("pick", "said"),
    [
        (lambda thermal, raw, after: [thermal, raw], "whose cycles no thermal record had corrected"),
        (lambda thermal, raw, after: [raw, thermal], "a warm-up record before a thermal one"),
        (lambda thermal, raw, after: [after, thermal], "a warm-up record before a thermal one"),
        (lambda thermal, raw, after: [after], "with none before it"),
        (lambda thermal, raw, after: [replace(thermal, options={**thermal.options, "tilt": 1e-3}), after],
         "with another before it"),
    ],
    ids=["raw after", "raw before", "before", "alone", "another"],
)  # fmt: skip
def test_the_wrong_order_and_double_compensation_are_refused_by_name(unit, tmp_path, pick, said):
    _, thermal, cycles, raw, after = unit
    records = pick(thermal, raw, after)
    with pytest.raises(il.ImulabError, match=said):
        next(apply_blocks(records, [cycles[0]]))
    for target in ("c", "blob"):
        with pytest.raises(il.ImulabError, match=said):
            il.export(target, records, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_recording_that_was_corrected_before_counts(unit):
    _, thermal, cycles, raw, after = unit
    once = il.apply(thermal, cycles[0])
    assert "(thermal: accel) sha256:" in once.corrected_by[0]
    with pytest.raises(il.ImulabError, match="whose cycles no thermal record had corrected"):
        il.apply(raw, once)
    with pytest.raises(il.ImulabError, match="with none before it"):
        il.apply(after, cycles[0])
    assert len(il.apply(after, once).corrected_by) == 2


def test_cycles_corrected_by_different_records_are_refused(unit):
    _, thermal, cycles, _, _ = unit
    some = [il.apply(thermal, cycles[0]), *cycles[1:]]
    with pytest.raises(il.ImulabError, match=r"cycle_-10_2\.csv: corrected over temperature by none, but cycle_-10_1"):
        il.fit_warmup(some, temperatures="-10,10,30", settling_time="300 s", model="knot-cubic")


def test_a_warm_up_of_other_columns_stands_beside_the_laws(unit, tmp_path):
    """Gyroscopes whose temperature nobody corrected, beside accelerometers over temperature."""
    _, thermal, _, _, _ = unit
    gyros = il.fit_warmup(
        il.simulate_warmup([0, 20, 40], rate=1.0), temperatures="0,20,40", axes="gyro_x,gyro_y,gyro_z"
    )
    assert il.export("blob", [thermal, gyros.calibration], tmp_path)


def test_a_bundle_of_both_corrects_as_the_records_do(unit, tmp_path, monkeypatch, capsys, self_test):
    _, thermal, cycles, _, after = unit
    monkeypatch.chdir(tmp_path)
    il.export("c", [thermal, after], "unit")
    run = self_test(tmp_path / "unit")
    assert run.returncode == 0, run.stdout
    (blob,) = il.export("blob", [thermal, after], ".")
    expected = il.apply(after, il.apply(thermal, cycles[0]))
    assert il.apply(blob, cycles[0]).triad("accel") == pytest.approx(expected.triad("accel"), abs=4e-6 * G)
    thermal.save("thermal.json")
    after.save("after.json")
    il.write(cycles[0], "cycle.csv")
    assert main(["apply", "after.json", "cycle.csv", "-o", "out.csv"], project=False) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert main(["apply", "thermal.json", "after.json", "cycle.csv", "-o", "out.csv"], project=False) == 0
    assert il.read("out.csv").triad("accel") == pytest.approx(expected.triad("accel"), abs=1e-8)


OPTIONS = {"temperatures": "-10,10,30", "settling_time": "300 s", "model": "knot-cubic"}


@pytest.fixture(scope="module")
def by_blob(unit, tmp_path_factory):
    """A warm-up record of cycles that a blob of the thermal record corrected; blobs of it alone, and of both."""
    _, thermal, cycles, _, _ = unit
    (alone,) = il.export("blob", thermal, tmp_path_factory.mktemp("alone"))
    after = il.fit_warmup([il.apply(alone, each) for each in cycles], **OPTIONS).calibration
    (both,) = il.export("blob", [thermal, after], tmp_path_factory.mktemp("both"))
    return alone, after, both


def test_cycles_corrected_by_a_blob_name_the_thermal_record_in_it(unit, by_blob):
    """So the right chain is the right one, whichever of it comes from a blob and which from a record."""
    _, thermal, cycles, _, _ = unit
    alone, after, both = by_blob
    assert after.model["after"] == thermal.sealed()[0]
    expected = il.apply(after, il.apply(thermal, cycles[0])).triad("accel")
    for chain in ([alone, after], [both]):
        result = cycles[0]
        for each in chain:
            result = il.apply(each, result)
        assert result.triad("accel") == pytest.approx(expected, abs=4e-6 * G)


def test_wrong_chains_with_a_blob_are_refused_by_name(unit, by_blob):
    _, thermal, cycles, raw, _ = unit
    alone, after, both = by_blob
    for chain, said in (
        ([alone, raw], "whose cycles no thermal record had corrected"),
        ([after], "with none before it"),
        ([alone, thermal], r"already corrected by thermal"),
        ([thermal, alone], r"already corrected by unit\.blob"),
        ([both, after], "already corrected by warmup"),
        ([thermal, both], r"already corrected by unit\.blob"),
    ):
        result = cycles[0]
        for each in chain[:-1]:
            result = il.apply(each, result)
        with pytest.raises(il.ImulabError, match=said):
            il.apply(chain[-1], result)


def test_the_head_names_blob_and_records_in_files_too(unit, by_blob, tmp_path, monkeypatch, capsys):
    _, thermal, cycles, _, _ = unit
    alone, after, both = by_blob
    monkeypatch.chdir(tmp_path)
    il.write(cycles[0], "cycle.csv")
    assert main(["apply", str(both), "cycle.csv", "-o", "out.csv"], project=False) == 0
    own = hashlib.sha256(both.read_bytes()).hexdigest()
    assert il.read("out.csv").corrected_by == (
        f"unit.blob sha256:{own}",
        f"unit.blob (thermal: accel) sha256:{thermal.sealed()[0]}",
        f"unit.blob sha256:{after.sealed()[0]}",
    )
    thermal.save("thermal.json")
    after.save("after.json")
    for wrong in (["after.json"], ["thermal.json"], [str(alone)]):
        capsys.readouterr()
        assert main(["apply", *wrong, "out.csv", "-o", "twice.csv"], project=False) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert "already corrected by" in error

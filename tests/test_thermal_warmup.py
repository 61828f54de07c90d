"""Thermal and warm-up together: the order is kept by name, and nothing is taken off twice.

The unit of the figures is made here by hand: a rate that follows the temperature with a lag of 20 s, warms itself by
8 K, and is put out with white noise.
"""

import hashlib
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.procedures.apply import apply_blocks
from reference import thermal as reference

G = reference.G


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

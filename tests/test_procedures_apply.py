"""Records applied to recordings: the transcribed forward model undone, units, missing readings, blocks, warnings."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
import madeup
from imulab.cli import main
from imulab.device.unit import load_blob
from imulab.display import Note, Verdict
from imulab.errors import DataError, RecordError, UnitError
from imulab.procedures.apply import DoubtfulSamples, apply, apply_blocks, loaded, warn_before_applying, warn_of_unit
from imulab.recording import Recording
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.writers import write
from reference import tumble as reference

G = 9.80665


PER_SI = {"m/s^2": 1.0, "g": 1 / G, "mg": 1000 / G, "ug": 1e6 / G, "count": 4096 / G, "V": 0.1}  # output per m/s^2


AXES = ["accel_x", "accel_y", "accel_z"]


def record(truth, order: int, unit: str, **model) -> Calibration:
    units = {"b": "m/s^2", "s": f"{unit}/(m/s^2)", "m": "rad", "2": "1/(m/s^2)"}
    units |= {str(power): f"1/(m/s^2)^{power - 1}" for power in (3, 4, 5)}
    parameters = {n: Parameter(value, None, units[n[1] if n[0] == "k" else n[0]]) for n, value in truth.items()}
    return Calibration("tumble", parameters, Covariance((), ()), {"order": order, "output_unit": unit, **model}, {})


def recording(outputs, unit: str, **columns) -> Recording:
    made = {name: np.array(outputs[:, i]) for i, name in enumerate(AXES)}
    extra = {name: np.asarray(values, dtype=float) for name, (values, _) in columns.items()}
    units = dict.fromkeys(AXES, unit) | {name: unit for name, (_, unit) in columns.items()}
    return Recording({**made, **extra}, units, name="flight.csv", metadata={"serial": "SN42"}, lines_before=2)


def simulated(order: int, unit: str, count: int = 200):
    """Specific forces within +-2 g, m/s^2, and what a random unit of MEMS size makes of them."""
    rng = np.random.default_rng(100 * order + len(unit))
    truth = reference.random_truth(rng, order, PER_SI[unit])
    forces = rng.uniform(-2 * G, 2 * G, (count, 3))
    return truth, forces, np.array([reference.forward(force, truth, order) for force in forces])


@pytest.mark.parametrize("unit", ["m/s^2", "g", "mg", "count", "V"])
@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_applying_a_record_undoes_the_forward_model(order, unit):
    truth, forces, outputs = simulated(order, unit)
    corrected = apply(record(truth, order, unit), recording(outputs, unit))
    assert [corrected.units[name] for name in AXES] == ["m/s^2"] * 3
    np.testing.assert_allclose(corrected.triad("accel"), forces, rtol=0, atol=1e-12 * 2 * G)


def test_strong_forces_far_from_the_linear_range_are_found_as_well():
    truth, forces, _ = simulated(2, "g")
    truth |= {f"k2_{axis}": -1e-2 / G for axis in "xyz"}  # 10 mg/g^2: 16 % at 16 g
    outputs = np.array([reference.forward(8 * force, truth, 2) for force in forces])
    corrected = apply(record(truth, 2, "g"), recording(outputs, "g"))
    np.testing.assert_allclose(corrected.triad("accel"), 8 * forces, rtol=0, atol=1e-12 * 16 * G)


@pytest.mark.parametrize("made_in", ["m/s^2", "g", "mg"])
@pytest.mark.parametrize("logged_in", ["m/s^2", "g", "mg", "ug"])
def test_a_recording_in_another_unit_of_acceleration_is_converted(made_in, logged_in):
    truth, forces, outputs = simulated(3, made_in)
    logged = outputs * (PER_SI[logged_in] / PER_SI[made_in])
    corrected = apply(record(truth, 3, made_in), recording(logged, logged_in))
    np.testing.assert_allclose(corrected.triad("accel"), forces, rtol=0, atol=1e-12 * 2 * G)


@pytest.mark.parametrize(("made_in", "logged_in"), [("count", "m/s^2"), ("g", "count"), ("V", "count"), ("m/s^2", "V")])
def test_a_unit_that_cannot_be_converted_is_refused_naming_both(made_in, logged_in):
    truth, _, outputs = simulated(1, made_in)
    with pytest.raises(UnitError) as caught:
        apply(record(truth, 1, made_in), recording(outputs, logged_in))
    message = str(caught.value)
    assert message.startswith("flight.csv: ")
    assert f"are in {logged_in}," in message
    assert message.endswith(f"outputs in {made_in}")


def test_axes_in_different_units_are_refused():
    truth, _, outputs = simulated(1, "g")
    mixed = recording(outputs, "g").with_columns({}, {"accel_y": "mg"})
    with pytest.raises(UnitError, match=r"share one unit, found accel_x \[g\], accel_y \[mg\], accel_z \[g\]"):
        apply(record(truth, 1, "g"), mixed)


def test_a_recording_without_the_triad_is_refused():
    truth, _, outputs = simulated(1, "g")
    whole = recording(outputs, "g")
    lame = Recording({name: whole.column(name) for name in AXES[:2]}, whole.units, name="flight.csv")
    with pytest.raises(DataError, match=r"flight\.csv: no column accel_z; found accel_x accel_y"):
        apply(record(truth, 1, "g"), lame)


@pytest.mark.parametrize(
    ("procedure", "message"),
    [("warmup", "lacks its table"), ("gyro_array", "array fuse --calibration"), ("centrifuge", "lacks x_K0")],
)
def test_a_record_with_nothing_to_apply_here_is_refused(procedure, message):
    other = Calibration(procedure, {}, Covariance((), ()), {}, {})
    with pytest.raises(RecordError, match=message):
        apply(other, recording(np.zeros((2, 3)), "g"))


@pytest.mark.parametrize("lacking", ["order", "output_unit", "scale_factor_y", "misalignment_zx", "k2_z"])
def test_a_record_that_lacks_what_is_applied_is_refused_naming_it(lacking):
    truth, _, outputs = simulated(2, "g")
    whole = record(truth, 2, "g")
    lame = replace(
        whole,
        parameters={name: value for name, value in whole.parameters.items() if name != lacking},
        model={name: value for name, value in whole.model.items() if name != lacking},
    )
    with pytest.raises(RecordError, match=lacking):
        apply(lame, recording(outputs, "g"))


# The misalignment is lower triangular: x reaches y and z, y reaches z, z reaches nothing else.
TOUCHED = {"accel_x": [True, True, True], "accel_y": [False, True, True], "accel_z": [False, False, True]}


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("order", [1, 2, 3, 5])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_reading_that_is_no_number_stays_in_the_channels_it_touches(order, axis, bad):
    truth, forces, outputs = simulated(order, "g")
    outputs[17, AXES.index(axis)] = bad
    with np.errstate(all="ignore"):
        corrected = apply(record(truth, order, "g"), recording(outputs, "g")).triad("accel")
    lost = np.zeros((len(forces), 3), dtype=bool)
    lost[17] = TOUCHED[axis]
    assert np.array_equal(~np.isfinite(corrected), lost)
    np.testing.assert_allclose(corrected[~lost], forces[~lost], rtol=0, atol=1e-12 * 2 * G)


@pytest.mark.parametrize("order", [1, 3])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_a_wild_reading_is_corrected_without_a_warning_of_numpy(order, bad):
    truth, _, outputs = simulated(order, "g")
    outputs[[17, 18, 19], [0, 1, 2]] = bad
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        apply(record(truth, order, "g"), recording(outputs, "g"))


def test_a_wild_reading_does_not_spoil_the_others():
    truth, forces, outputs = simulated(3, "g")
    outputs[17, 2] = 1e300
    with np.errstate(all="ignore"):
        corrected = apply(record(truth, 3, "g"), recording(outputs, "g")).triad("accel")
    others = np.arange(len(forces)) != 17
    np.testing.assert_allclose(corrected[others], forces[others], rtol=0, atol=1e-12 * 2 * G)


def test_columns_that_the_record_does_not_touch_pass_unchanged():
    truth, _, outputs = simulated(2, "g", count=50)
    rng = np.random.default_rng(4)
    before = recording(
        outputs,
        "g",
        time=(np.arange(50), "ms"),
        gyro_x=(rng.standard_normal(50), "deg/s"),
        truth_accel_x=(rng.standard_normal(50), "m/s^2"),
        pressure=(np.full(50, np.nan), "1"),
    )
    after = apply(record(truth, 2, "g"), before)
    assert list(after.columns) == list(before.columns)
    for name in ("time", "gyro_x", "truth_accel_x", "pressure"):
        assert after.column(name).tobytes() == before.column(name).tobytes()
        assert after.units[name] == before.units[name]
    assert (after.name, after.metadata, after.lines_before) == (before.name, before.metadata, 2)
    np.testing.assert_array_equal(before.triad("accel"), outputs)


@pytest.mark.parametrize("size", [1, 7, 64, 500])
@pytest.mark.parametrize("order", [1, 4])
def test_blocks_are_corrected_as_the_whole(size, order):
    truth, _, outputs = simulated(order, "count", count=300)
    outputs[100, 1] = np.nan
    made = record(truth, order, "count")
    whole = apply(made, recording(outputs, "count")).triad("accel")
    blocks = (recording(outputs[start : start + size], "count") for start in range(0, 300, size))
    joined = np.vstack([block.triad("accel") for block in apply_blocks([made], blocks)])
    assert joined.tobytes() == whole.tobytes()


def test_records_are_applied_in_the_order_given():
    first, forces, outputs = simulated(2, "g")
    second = reference.random_truth(np.random.default_rng(9), 1, 1.0)
    chain = [loaded(record(first, 2, "g"), again=True), loaded(record(second, 1, "m/s^2"), again=True)]
    (corrected,) = apply_blocks(chain, [recording(outputs, "g")])
    expected = np.array([reference.inverse(force, second, 1) for force in forces])
    np.testing.assert_allclose(corrected.triad("accel"), expected, rtol=0, atol=2e-12 * 2 * G)
    with pytest.raises(UnitError, match=r"are in m/s\^2,"):
        list(apply_blocks([chain[1], loaded(record(first, 2, "count"), again=True)], [recording(outputs, "g")]))


# --- temperature -----------------------------------------------------------------------------------------------


def at(values, unit="degC", **metadata) -> Recording:
    made = recording(np.zeros((len(values), 3)), "g", temperature=(values, unit))
    return Recording(made.columns, made.units, name="flight.csv", metadata=metadata)


MADE = {"temperature": {"value": 24.0, "unit": "degC"}}


@pytest.mark.parametrize("mean", [3.9, 44.1, -40.0])
def test_a_record_made_far_from_the_recordings_temperature_is_warned_of(mean):
    truth, _, _ = simulated(1, "g")
    (message,) = warn_before_applying(record(truth, 1, "g", **MADE), at([mean - 1, mean + 1]))
    assert message.startswith(
        f"flight.csv: temperature {mean:.1f} degC is {abs(mean - 24):.0f} K away from the 24.0 degC"
    )


def test_a_temperature_in_the_head_of_the_recording_counts_too():
    truth, _, outputs = simulated(1, "g")
    warm = Recording(
        {name: outputs[:, i] for i, name in enumerate(AXES)}, dict.fromkeys(AXES, "g"), {"temperature": "61.5 degC"}
    )
    (message,) = warn_before_applying(record(truth, 1, "g", **MADE), warm)
    assert "temperature 61.5 degC" in message


@pytest.mark.parametrize("mean", [4.0, 24.0, 44.0])
def test_twenty_kelvin_are_not_far(mean):
    truth, _, _ = simulated(1, "g")
    assert warn_before_applying(record(truth, 1, "g", **MADE), at([mean])) == []


def test_an_unknown_temperature_is_not_warned_of():
    truth, _, _ = simulated(1, "g")
    assert warn_before_applying(record(truth, 1, "g"), at([90.0])) == []
    assert warn_before_applying(record(truth, 1, "g", **MADE), recording(np.zeros((2, 3)), "g")) == []
    assert warn_before_applying(record(truth, 1, "g", **MADE), at([np.nan])) == []


def test_outputs_beyond_a_turning_point_have_no_specific_force():
    """k3 = -2 mg/g^3: the output turns back at s = 1 / sqrt(3 * 0.002) = 12.9 g, A = 8.6 g."""
    truth, _, _ = simulated(3, "g")
    nominal = {n: (1 / G if n[0] == "s" else -2e-3 / G**2 if n[:2] == "k3" else 0.0) for n in truth}
    readings = np.array([[r, 0.0, 0.0] for r in (1.0, 8.0, 8.6, 8.61, 10.0, 16.0, -8.6, -8.61)])
    corrected = apply(record(nominal, 3, "g"), recording(readings, "g")).triad("accel")[:, 0] / G
    assert np.isnan(corrected).tolist() == [False, False, False, True, True, True, False, True]
    np.testing.assert_allclose(corrected[:3] - 2e-3 * corrected[:3] ** 3, [1.0, 8.0, 8.6], rtol=1e-12)


def test_a_record_in_other_units_is_refused():
    truth, _, outputs = simulated(1, "g")
    whole = record(truth, 1, "g")
    altered = replace(whole, parameters={**whole.parameters, "bias_x": Parameter(10.0, None, "mg")})
    with pytest.raises(RecordError, match=r"has bias_x in 'mg', expected 'm/s\^2'"):
        apply(altered, recording(outputs, "g"))


def test_a_record_of_another_unit_is_warned_of():
    truth, _, outputs = simulated(1, "g")
    other = replace(record(truth, 1, "g"), sensor={"serial": "SN41"})
    (message,) = warn_before_applying(other, recording(outputs, "g"))
    assert message == "flight.csv: serial SN42, but the record was made for SN41"


def test_python_is_told_what_the_command_warns_of(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    truth, _, outputs = simulated(1, "g")
    bad = Verdict("bad", ("the attitudes scatter",), ("measure again",))
    made = replace(record(truth, 1, "g", **MADE), sensor={"serial": "SN41"}, verdict=bad)
    warm = recording(outputs, "g", temperature=(np.full(len(outputs), 60.0), "degC"))
    made.save("r.json")
    write(warm, "flight.csv")
    assert main(["apply", "r.json", "flight.csv", "-q", "-o", "out.csv"], project=False) == 0
    lines = [line.removeprefix("imulab: warning: ") for line in capsys.readouterr().err.splitlines()]
    assert [line[:30] for line in lines] == [
        "the record's verdict is bad, d", "flight.csv: serial SN42, but t", "flight.csv: temperature 60.0 d"
    ]  # fmt: skip
    assert list(il.apply(made, warm).notes) == lines
    assert list(made.apply(warm).notes) == lines
    for block in apply_blocks([loaded(made)], [warm]):
        assert block.notes == ()  # the command line says it once


ACCEL = {f"accel_{axis}": np.array([10.0, -200.0, 3000.0]) for axis in "xyz"}


GYRO = {f"gyro_{axis}": np.array([1.0, 20.0, -300.0]) for axis in "xyz"}


def flight(**columns):
    made = columns or ACCEL
    return Recording(made, dict.fromkeys(made, "count"), name="flight.csv", metadata={"serial": "SN42"})


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_corrected_file_names_every_record_and_its_hash(tmp_path, kind, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    first, second = (
        madeup.tumble(1),
        replace(madeup.tumble(2), model={**madeup.tumble(2).model, "output_unit": "m/s^2"}),
    )
    second = replace(
        second,
        parameters={
            name: replace(p, unit=p.unit.replace("count", "m/s^2"), value=1.0 if "scale" in name else p.value)
            for name, p in second.parameters.items()
        },
    )
    first.save("a.json")
    second.save("b.json")
    write(flight(), "raw.csv")
    assert main(["apply", "a.json", "b.json", "raw.csv", "--again", "-o", f"out.{kind}"]) == 0
    expected = tuple(f"{name}.json sha256:{r.to_dict()['content_sha256']}" for name, r in (("a", first), ("b", second)))
    assert il.read(f"out.{kind}").corrected_by == expected
    if kind == "csv":
        assert re.findall(r"^# corrected_by: (.*)$", (tmp_path / "out.csv").read_text(), re.M) == list(expected)
    capsys.readouterr()
    assert main(["apply", "b.json", f"out.{kind}", "-o", "again.csv"]) == 2
    assert f"out.{kind}: already corrected by b.json" in capsys.readouterr().err
    assert not (tmp_path / "again.csv").exists()
    assert main(["apply", "b.json", f"out.{kind}", "--again", "-o", "again.csv"]) == 0
    assert f"was corrected before, by {expected[0]}" in capsys.readouterr().err
    assert il.read("again.csv").corrected_by == (*expected, expected[1])
    assert main(["convert", f"out.{kind}", "-o", "converted.csv"]) == 0
    assert il.read("converted.csv").corrected_by == expected


TURNED = Recording(
    {"time": np.arange(4.0), **{f"{s}_{a}": np.full(4, 0.1) for s in ("accel", "gyro", "mag", "dtg") for a in "xyz"}},
    {"time": "s", **{f"{s}_{a}": "rad/s" for s in ("gyro", "dtg") for a in "xyz"},
     **{f"accel_{a}": "m/s^2" for a in "xyz"}, **{f"mag_{a}": "uT" for a in "xyz"}},
    {"power_on_temperature": "25", "serial": "SN42"}, name="flight.csv",
)  # fmt: skip


def in_si(made, **model):
    """A made-up record for outputs in m/s^2 and rad/s."""
    parameters = {name: replace(p, unit=p.unit.replace("count", "m/s^2")) for name, p in made.parameters.items()}
    for name in [name for name in parameters if name.startswith("gyro_scale")]:
        parameters[name] = replace(parameters[name], unit="rad/s/(rad/s)")
    return replace(made, parameters=parameters, model={**made.model, "output_unit": "m/s^2", **model})


def mag_records():
    waved = il.simulate_magnetometer(field="48 uT", duration="30 s")
    return [il.fit_magnetometer(waved, field=f"{field} uT").calibration for field in (48, 49)]


@pytest.mark.parametrize(
    ("records", "message", "expected"),
    [
        (lambda: [in_si(madeup.tumble(1)), in_si(madeup.tumble(2))],
         "bias and scale factor of accel_x accel_y accel_z", "one of them"),
        (lambda: [in_si(madeup.tumble(1, gyro=True), gyro_output_unit="rad/s"),
                  il.fit_rate(il.simulate_rate()).calibration],
         "bias and scale factor of gyro_x gyro_y gyro_z",
         "{first} alone, or one fitted without gyroscopes (no --with gyro)"),
        (lambda: [madeup.warmup(), madeup.warmup("knot-cubic")], "the change after power-on of gyro_x gyro_z",
         "one of them"),
        (lambda: [madeup.centrifuge(), replace(madeup.centrifuge(), created="2001-01-01T00:00:00Z")],
         "drift under acceleration of dtg_x dtg_y", "one of them"),
        (mag_records, "hard and soft iron of mag_x mag_y mag_z", "one of them"),
    ],
    ids=["tumble", "gyroscopes", "warm-up", "centrifuge", "magnetometers"],
)  # fmt: skip
def test_two_records_that_take_off_the_same_error_are_refused(
    records, message, expected, tmp_path, monkeypatch, capsys
):
    """By `apply` on the command line and in Python, from a blob, and by `export`; unless they are to be so."""
    monkeypatch.chdir(tmp_path)
    first, second = (replace(each, sensor={"serial": "SN42"}) for each in records())
    first.save("a.json")
    second.save("b.json")
    write(TURNED, "flight.csv")
    assert main(["apply", "a.json", "b.json", "flight.csv", "-o", "out.csv"], project=False) == 2
    said = f"a.json and b.json both take off {message}: expected {expected.format(first='a.json')}"
    said += ", or --again (again=True)"
    assert f"imulab: {said} if the second was made of what the first left\n" == capsys.readouterr().err
    assert not (tmp_path / "out.csv").exists()
    assert main(["apply", "a.json", "b.json", "flight.csv", "--again", "-o", "out.csv"], project=False) == 0
    capsys.readouterr()
    (blob,) = il.export("blob", first, "blob")
    for once, name in ((il.apply(first, TURNED), f"{first.procedure} SN42"), (il.apply(blob, TURNED), "unit.blob")):
        what = re.escape(f"{name} and {second.procedure} SN42 both take off {message}: ")
        with pytest.raises(RecordError, match=what + re.escape(f"expected {expected.format(first=name)}")):
            il.apply(second, once)
    for target in ("c", "blob"):
        assert main(["export", "--to", target, "a.json", "b.json", "-o", "out"], project=False) == 2
        said = f"imulab: a.json and b.json both take off {message}: expected {expected.format(first='a.json')}\n"
        assert capsys.readouterr().err == said
        with pytest.raises(RecordError, match=f"{first.procedure} SN42 and {second.procedure} SN42 both take off"):
            il.export(target, [first, second], "out")
    assert not (tmp_path / "out").exists()


def test_a_file_that_another_record_corrected_is_said_in_python_too(tmp_path, monkeypatch, capsys):
    """Once, however many records correct it then; of what Python corrected itself nothing is said."""
    monkeypatch.chdir(tmp_path)
    first, second = in_si(madeup.tumble(1)), in_si(madeup.tumble(2))
    second.save("b.json")
    once = il.apply(first, TURNED)
    write(once, "once.csv")
    (line,) = once.corrected_by
    twice = il.apply(second, "once.csv")
    assert (once.notes, twice.notes) == ((), (f"was corrected before, by {line}",))
    assert isinstance(twice.notes[0], Note)
    assert il.apply(madeup.centrifuge(), twice).notes == twice.notes
    madeup.centrifuge().save("c.json")
    assert main(["apply", "b.json", "c.json", "once.csv", "-q", "-o", "out.csv"], project=False) == 0
    assert capsys.readouterr().err.count(f"imulab: warning: once.csv: {twice.notes[0]}\n") == 1
    ready = [loaded(second), loaded(madeup.centrifuge())]
    assert [block.notes for block in apply_blocks(ready, il.read_blocks("once.csv"))] == [()]


def test_records_of_other_errors_or_other_axes_are_applied_together(tmp_path):
    """A frame of pandas remembers what was taken off; tables for other temperatures do not touch each other."""
    nine = in_si(madeup.tumble(1, gyro=True), gyro_output_unit="rad/s")
    chain = [nine, madeup.centrifuge(), madeup.warmup()]
    for pick in (chain, chain[:2], chain[1:]):
        (corrected,) = apply_blocks(pick, [TURNED])
        assert len(corrected.corrected_by) == len(pick)
    frame = nine.apply(TURNED.to_frame())
    with pytest.raises(RecordError, match="both take off bias and scale factor"):
        il.apply(in_si(madeup.tumble(2)), frame.iloc[:2])
    hot = madeup.warmup("knot-cubic")
    table = {**hot.sections["table"], "temperatures": [t + 100 for t in madeup.EDGES]}
    (corrected,) = apply_blocks([madeup.warmup(), replace(hot, sections={"table": table})], [TURNED])
    assert len(corrected.corrected_by) == 1


def test_a_blob_is_known_by_the_records_that_it_was_made_from(tmp_path):
    record = madeup.tumble(1)
    il.export("blob", [record], tmp_path)
    blob = load_blob(tmp_path / "unit.blob")
    once = il.apply(record, flight())
    again = replace(once, columns=flight().columns, units=flight().units)
    with pytest.raises(DataError, match="already corrected by"):
        il.apply(blob, again)
    assert il.apply(blob, again, again=True).corrected_by[1].endswith(loaded(blob).holds[0])


def test_what_a_record_leaves_unchanged_is_refused_with_the_reason():
    time = {"time": np.arange(3.0), "gyro_x": np.zeros(3), "gyro_z": np.zeros(3)}
    cold = Recording(time, {"time": "s", "gyro_x": "rad/s", "gyro_z": "rad/s"}, name="cold.csv")
    with pytest.raises(
        DataError, match=r"cold\.csv: no power_on_temperature in the head of the file: nothing corrected"
    ):
        il.apply(madeup.warmup(), cold)


def test_a_record_of_six_axes_corrects_the_triad_that_is_there_and_says_so():
    record = madeup.tumble(1, gyro=True)
    both = il.apply(record, flight(**ACCEL, **GYRO))
    for there, away, words in ((ACCEL, "gyroscopes", "accelerometers"), (GYRO, "accelerometers", "gyroscopes")):
        alone = flight(**there)
        corrected = il.apply(record, alone)
        for name in there:
            np.testing.assert_array_equal(corrected.column(name), both.column(name))
        assert warn_before_applying(record, alone) == [f"flight.csv: no {away} in it: its {words} alone are corrected"]
    assert warn_before_applying(record, flight(**ACCEL, **GYRO)) == []


def test_gyroscopes_whose_g_sensitivity_needs_the_accelerometers_are_refused_without_them():
    with pytest.raises(DataError, match=r"g-sensitivity, which needs accel_x, accel_y and accel_z; found gyro_x"):
        il.apply(madeup.tumble(1, gyro=True, sensitive=True), flight(**GYRO))


def test_a_record_of_one_triad_is_not_applied_to_the_other():
    with pytest.raises(DataError, match="no column accel_x; found gyro_x"):
        il.apply(madeup.tumble(1), flight(**GYRO))


# --- the unit of the recording ------------------------------------------------------------------------------------


def logged(forces, unit="m/s^2", rate=50.0):
    """What a unit with biases of 30 mg makes of specific forces, m/s^2, and its record."""
    bias = np.array([0.3, -0.2, 0.25])
    values = {n: bias["xyz".index(n[-1])] if n[0] == "b" else float(n[0] == "s") for n in reference.names(1)}
    outputs = forces + bias + np.random.default_rng(1).normal(0.0, 0.02, np.shape(forces))
    columns = {name: outputs[:, i] / (1.0 if unit == "m/s^2" else G) for i, name in enumerate(AXES)}
    units = {"time": "s", **dict.fromkeys(AXES, unit)}
    return record(values, 1, "m/s^2"), Recording(
        {"time": np.arange(len(outputs)) / rate, **columns}, units, name="f.csv"
    )


def turned_over(count=3000):
    angle = np.repeat(np.linspace(0.0, 6.0, 12), count // 12)
    return G * np.column_stack([np.sin(angle), np.cos(angle) * np.sin(3 * angle), np.cos(angle) * np.cos(3 * angle)])


def under_way(size=1.0):
    """A car that brakes and turns with some m/s^2 for seconds."""
    level = size * np.repeat(np.random.default_rng(5).normal(0, 1, (60, 3)), 50, axis=0)
    return level * [1, 1, 0] + [0, 0, G]


def turning(rate=1.0):
    """A unit that turns about a level axis at a rate, rad/s."""
    angle = rate * np.arange(3000) / 50
    return G * np.column_stack([np.sin(angle), np.cos(angle), np.zeros(3000)])


@pytest.mark.parametrize("forces", [turned_over(), under_way(2.5), turning()], ids=["turned", "under way", "turning"])
@pytest.mark.parametrize(
    ("true", "stated"), [("m/s^2", "g"), ("m/s^2", "mg"), ("g", "m/s^2"), ("g", "mg"), ("mg", "g"), ("mg", "m/s^2")]
)
def test_a_unit_in_which_there_is_no_gravity_is_warned_of(true, stated, forces, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    made, log = logged(forces, "m/s^2" if true == "m/s^2" else "g")
    if true == "mg":
        log = log.with_columns({name: 1000 * log.column(name) for name in AXES}, {})
    made.save("r.json")
    for unit, lines in ((stated, 1), (true, 0)):
        write(log.with_columns({}, dict.fromkeys(AXES, unit)), "f.csv")
        assert main(["apply", "r.json", "f.csv", "-q", "-o", "out.csv"], project=False) == 0
        said = capsys.readouterr().err
        assert said.count("\n") == lines
        assert len(il.apply(made, "f.csv").notes) == lines
    write(log.with_columns({}, dict.fromkeys(AXES, stated)), "f.csv")
    (note,) = il.apply("r.json", "f.csv").notes
    assert main(["apply", "r.json", "f.csv", "-q", "-o", "out.csv"], project=False) == 0
    said = capsys.readouterr().err
    assert said == f"imulab: warning: f.csv: {note}\n"
    assert f"which is no gravity, as {true} would be; is their unit, {stated}, right? --unit accel={true}" in said
    assert said.startswith("imulab: warning: f.csv: accel_x .. accel_z: |f| is ")


def centrifuge_at(levels):
    return np.repeat([[level * G, 0.0, G] for level in levels], 3000 // len(levels), axis=0)


HEALTHY = {
    "turned over": turned_over(),
    "under way": under_way(30.0),
    "vibrating": np.random.default_rng(3).normal([0, 0, G], 30, (3000, 3)),
    "in free fall": np.zeros((3000, 3)),
    "at 10 g": centrifuge_at([10]),
    "at 100 g": centrifuge_at([100]),
    "at many g": centrifuge_at([1, 2, 4, 6, 8, 9, 9.8, 10, 12, 15]),
    "swung up": np.linspace(0, 20 * G, 3000)[:, None] * [1, 0, 0] + [0, 0, G],
}


def test_a_still_log_of_10_g_is_no_warning_since_a_centrifuge_shows_it_too():
    """With biases of 30 mg, 10 g are as near to 9.81 m/s^2 as a unit at rest; in one position a note says so."""
    at_rest, log = logged(np.full((3000, 3), [0.0, 0.0, G]))
    (note,) = warn_of_unit(loaded(at_rest), log.with_columns({}, dict.fromkeys(AXES, "g")))
    assert isinstance(note, Note)
    assert "if the sensor is at rest, their unit is m/s^2, not g: --unit accel=m/s^2" in note


@pytest.mark.parametrize("unit", ["m/s^2", "g"])
@pytest.mark.parametrize("forces", HEALTHY.values(), ids=HEALTHY)
def test_a_healthy_log_is_not_asked_for_its_unit(forces, unit):
    made, log = logged(forces, unit)
    assert [said for said in warn_of_unit(loaded(made), log) if not isinstance(said, Note)] == []


def test_the_unit_of_a_few_rows_or_of_gaps_is_judged_without_them():
    """Without a time every row is an attitude; rows that are no numbers count for nothing; none is no unit."""
    made, log = logged(turned_over())
    stated = log.with_columns({"accel_y": np.where(np.arange(len(log)) % 3, log.column("accel_y"), np.nan)}, {})
    stated = replace(stated, units={"time": "s", **dict.fromkeys(AXES, "g")})
    table = replace(stated, columns={name: stated.column(name)[:4] for name in AXES})
    nothing = replace(stated, columns={name: np.full(4, np.nan) for name in AXES})
    ready = loaded(made)
    assert [len(warn_of_unit(ready, each)) for each in (stated, table, nothing)] == [1, 1, 0]
    warmth = {"temperature": np.full(len(stated), np.nan)}
    assert len(warn_of_unit(ready, stated.with_columns(warmth, {"temperature": "degC"}))) == 1


def test_counts_stated_as_g_are_asked_for_their_unit():
    made, log = logged(turned_over())
    counts = log.with_columns({name: 16384 / G * log.column(name) for name in AXES}, dict.fromkeys(AXES, "g"))
    (said,) = warn_of_unit(loaded(made), counts)
    assert "g, more than any accelerometer reads, as counts would be; is their unit, g, right?" in said


GYROS = ("gyro_x", "gyro_y", "gyro_z")


@pytest.fixture(scope="module")
def turned_by_hand():
    """A recording with both triads, gyroscopes in deg/s, and its record."""
    log = il.simulate_tumble(gravity=9.81, order=1, attitudes=12, seed=3)
    log = log.with_columns({name: np.degrees(log.si(name)) for name in GYROS}, dict.fromkeys(GYROS, "deg/s"))
    log = Recording({name: log.column(name) for name in ("time", *AXES, *GYROS)}, log.units, name="f.csv")
    return log, il.fit_gyro(il.fit_tumble(log, order=1, gravity=9.81).calibration, log).calibration


@pytest.mark.parametrize("stated", ["rad/s", "deg/h"])
def test_gyroscopes_that_turn_as_gravity_in_another_unit_are_warned_of(
    stated, turned_by_hand, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    log, made = turned_by_hand
    wrong = log.with_columns({}, dict.fromkeys(GYROS, stated))
    (note,) = il.apply(made, wrong).notes
    assert note == (
        f"gyro_x .. gyro_z: gravity turns in the accelerometers as by rates in deg/s; is their unit, {stated}, right? "
        "--unit gyro=deg/s states another"
    )
    made.save("r.json")
    write(wrong, "f.csv")
    assert main(["apply", "r.json", "f.csv", "-q", "-o", "out.csv"], project=False) == 0
    assert capsys.readouterr().err == f"imulab: warning: f.csv: {note}\n"
    assert main(["apply", "r.json", "f.csv", "--unit", "gyro=deg/s", "-q", "-o", "out.csv"], project=False) == 0
    assert capsys.readouterr().err == ""


def test_the_unit_of_gyroscopes_is_not_asked_for_where_nothing_tells(turned_by_hand):
    log, made = turned_by_hand
    assert il.apply(made, log).notes == ()
    radians = log.with_columns({name: log.si(name) for name in GYROS}, dict.fromkeys(GYROS, "rad/s"))
    assert il.apply(made, radians).notes == ()
    wrong = log.with_columns({}, dict.fromkeys(GYROS, "rad/s"))
    still = replace(wrong, columns={name: wrong.column(name)[:200] for name in wrong.columns})
    assert il.apply(made, still).notes == ()  # at rest
    shaken = {name: wrong.column(name) + np.random.default_rng(1).normal(0, 30, len(wrong)) for name in AXES}
    assert il.apply(made, wrong.with_columns(shaken, {})).notes == ()
    wild = {"accel_z": wrong.column("accel_z") * np.where(np.arange(len(wrong)) < 300, 1e200, 1.0)}  # overflows squares
    assert il.apply(made, wrong.with_columns(wild, {})).notes == ()
    gyros = Recording({name: wrong.column(name) for name in ("time", *GYROS)}, wrong.units, name="f.csv")
    assert warn_of_unit(loaded(made), gyros) == []
    # A record whose scale factors have the same wrong unit makes the rates right.
    scaled = {
        n: replace(p, value=57.29577951 * p.value) if "gyro_scale" in n else p for n, p in made.parameters.items()
    }
    assert warn_of_unit(loaded(replace(made, parameters=scaled)), wrong) == []


def test_readings_that_are_lost_or_beyond_the_test_are_said_by_command_and_function(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    truth, _, outputs = simulated(2, "m/s^2")
    outputs *= 0.3
    outputs[50, 1], outputs[20:22, 0], outputs[90, 0], outputs[:, 2] = 4e30, np.inf, -np.inf, np.nan
    made, held = record(truth, 2, "m/s^2"), recording(outputs, "m/s^2", gyro_x=(np.full(200, np.inf), "rad/s"))
    force = (4e30 / truth["scale_factor_y"] - truth["bias_y"]) / G
    lost = "what is corrected with it is not a number there"
    lines = [
        f"flight.csv: 1 samples beyond 2 g (up to {force:.4g} g): the record's nonlinearity was measured within 1 g",
        f"flight.csv: row 21 (line 23), column accel_x: expected a number, found inf (and 2 more): {lost}",
        f"flight.csv: column accel_z: expected numbers, found none in 200 rows: {lost}",
    ]
    assert list(il.apply(made, held).notes) == lines
    blocks = DoubtfulSamples([made], [loaded(made)])
    for start in range(0, 200, 7):
        blocks.add(replace(recording(outputs[start : start + 7], "m/s^2"), first_row=start + 1))
    assert blocks.warnings() == lines
    made.save("r.json")
    write(replace(held, metadata={"a": "1"}), "flight.csv")  # its row 21 is line 23
    assert main(["apply", "r.json", "flight.csv", "-o", "c.csv", "--quiet"]) == 0
    assert capsys.readouterr().err.splitlines() == [f"imulab: warning: {line}" for line in lines]

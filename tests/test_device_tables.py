"""Blobs: what is cut, altered, newer or none gets one line; a whole one gives what its record gives, in float."""

import json
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
import madeup
from imulab.cli import main
from imulab.device.tables import KINDS, monotone_range, pack
from imulab.device.unit import ArraySettings, Blob, DeviceUnit, array_table, is_blob, load_blob, make_blob
from imulab.errors import RecordError
from imulab.exporters import export
from imulab.procedures.apply import apply, apply_blocks, loaded, tables_of, tables_of_all, warn_before_applying
from imulab.procedures.registry import load_any
from imulab.procedures.warmup.device import warmup_table
from imulab.recording import Recording
from imulab.records.calibration import Calibration, Parameter

G = madeup.G


@pytest.fixture(scope="module")
def record():
    return madeup.tumble(3, gyro=True, sensitive=True)


@pytest.fixture(scope="module")
def data(record):
    return make_blob([record], tables_of_all([record]))


@pytest.fixture
def blob(data, tmp_path):
    path = tmp_path / "unit.blob"
    path.write_bytes(data)
    return path


@pytest.fixture(scope="module")
def flight():
    rng = np.random.default_rng(1)
    raw = {f"accel_{a}": rng.uniform(-8000, 8000, 500) for a in "xyz"}
    raw |= {f"gyro_{a}": rng.uniform(-3000, 3000, 500) for a in "xyz"}
    return Recording(
        {"time": np.arange(500) * 0.01, **raw, "pressure": np.ones(500)},
        {"time": "s", **dict.fromkeys(raw, "count"), "pressure": "1"},
        name="flight.csv",
        metadata={"serial": "SN42"},
    )


def closed(body):
    """A blob's bytes with size and CRC made to fit."""
    body = body[:12] + struct.pack("<I", len(body) + 4) + body[16:]
    return body + struct.pack("<I", zlib.crc32(body))


def spoilt(data, how):
    body = data[:-4]
    if how == "cut":
        return data[:-20]
    if how == "cut in the head":
        return data[:13]
    if how == "longer":
        return data + b"\0"
    if how == "altered":
        return data[:400] + bytes([data[400] ^ 4]) + data[401:]
    if how == "newer":
        return closed(body[:8] + b"\4\0" + body[10:])
    if how == "without text":
        return pack(tables_of(madeup.tumble(1)), 4)
    assert how == "not finite"
    return closed(body[:-4] + struct.pack("<f", np.nan))  # the last number of the last section


REASONS = {
    "cut": "the table is cut off",
    "cut in the head": "the table is cut off",
    "longer": "bytes follow the table",
    "altered": "the table is corrupt (CRC-32)",
    "newer": "the table is of a newer version",
    "not finite": "a number that is not finite",
    "without text": "no description of its units: it is for firmware only",
}


def one_line(capsys, *arguments):
    status = main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("imulab: ")
    return status, err


@pytest.mark.parametrize("how", REASONS)
def test_a_spoilt_blob_is_refused_by_every_command_that_takes_one(how, data, flight, tmp_path, capsys):
    path, out = tmp_path / "unit.blob", tmp_path / "out.csv"
    path.write_bytes(spoilt(data, how))
    il.write(flight, tmp_path / "flight.csv")
    for command in (["show", path], ["show", path, "--json"], ["apply", path, tmp_path / "flight.csv", "-o", out]):
        status, message = one_line(capsys, *command)
        assert status == 2
        assert str(path) in message
        assert REASONS[how] in message
        assert not out.exists()
    with pytest.raises(RecordError, match=r"unit\.blob"):
        load_blob(path)


@pytest.mark.parametrize("content", [b"", b"\x89IMULAB", b"\x89PNG\r\n\x1a\n", b"IMULAB", b"{}", b"\0" * 1000])
def test_what_is_no_blob_is_refused(content, flight, tmp_path, capsys):
    path, out = tmp_path / "unit.blob", tmp_path / "out.csv"
    path.write_bytes(content)
    il.write(flight, tmp_path / "flight.csv")
    for command in (["show", path], ["apply", path, tmp_path / "flight.csv", "-o", out]):
        status, message = one_line(capsys, *command)
        assert status == 2
        assert "unit.blob" in message
        assert not out.exists()
    assert not is_blob(path)
    with pytest.raises(RecordError):
        load_blob(path)


def test_a_blob_that_is_not_there_is_refused(flight, tmp_path, capsys):
    il.write(flight, tmp_path / "flight.csv")
    for command in (["show", tmp_path / "no.blob"], ["apply", tmp_path / "no.blob", tmp_path / "flight.csv"]):
        status, message = one_line(capsys, *command)
        assert status == 2
        assert "no.blob" in message
    with pytest.raises(RecordError, match=r"no\.blob: cannot be read: No such file"):
        load_blob(tmp_path / "no.blob")


def test_commands_that_need_a_record_say_why_a_blob_is_none(blob, flight, tmp_path, capsys):
    il.write(flight, tmp_path / "flight.csv")
    out = tmp_path / "out"
    for command in (
        ["report", blob, "-o", out],
        ["tumble", "check", blob, tmp_path / "flight.csv"],
        ["tumble", "gyro", tmp_path / "flight.csv", "--accel", blob, "-o", out],
        ["tumble", "fit", tmp_path / "flight.csv", "--prior", blob, "-o", out],
        ["export", "--to", "c", blob, "-o", out],
        ["show", blob, blob],
    ):
        status, message = one_line(capsys, *command)
        assert status == 2
        assert "unit.blob: a blob, which holds a unit's numbers without uncertainties or history" in message
        assert not out.exists()


def test_show_says_what_is_in_a_blob(blob, data, record, capsys):
    assert main(["show", str(blob)]) == 0
    text = capsys.readouterr().out
    assert f"blob of SN42: {len(data)} bytes, float numbers" in text
    assert "tumble: output_unit count" in text
    assert "gyro: output_unit count" in text
    assert record.to_dict()["content_sha256"] in text
    assert main(["show", str(blob), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sensor"]["serial"] == "SN42"


def test_a_blob_gives_what_its_record_gives_to_float_accuracy(blob, record, flight):
    exact, found = apply(record, flight), apply(load_any(blob), flight)
    assert list(found.columns) == list(flight.columns)
    assert found.units == exact.units
    assert np.array_equal(found.column("pressure"), flight.column("pressure"))
    for kind, scale in (("accel", 20.0), ("gyro", 5.0)):
        difference = np.abs(found.triad(kind) - exact.triad(kind)).max()
        assert 0 < difference < 2e-6 * scale


def test_apply_by_command_line_takes_a_blob(blob, record, flight, tmp_path):
    il.write(flight, tmp_path / "flight.csv")
    record.save(tmp_path / "record.json")
    for name in ("unit.blob", "record.json"):
        assert (
            main(["apply", str(tmp_path / name), str(tmp_path / "flight.csv"), "-o", str(tmp_path / f"{name}.csv")])
            == 0
        )
    by_blob, by_record = (il.read(tmp_path / f"{name}.csv") for name in ("unit.blob", "record.json"))
    np.testing.assert_allclose(by_blob.triad("accel"), by_record.triad("accel"), atol=4e-5)


def test_blocks_by_a_blob_are_those_of_the_whole(blob, flight):
    whole = apply(load_blob(blob), flight).triad("accel")
    parts = [
        Recording({name: column[at : at + 77] for name, column in flight.columns.items()}, flight.units)
        for at in range(0, 500, 77)
    ]
    joined = np.vstack([part.triad("accel") for part in apply_blocks([load_blob(blob)], parts)])
    assert joined.tobytes() == whole.tobytes()


def test_a_blob_of_another_unit_is_warned_of(blob, flight):
    other = Recording(flight.columns, flight.units, name="flight.csv", metadata={"serial": "SN1"})
    assert warn_before_applying(load_blob(blob), other) == ["flight.csv: serial SN1, but the record was made for SN42"]
    assert warn_before_applying(load_blob(blob), flight) == []


def test_a_blob_and_its_copy_hold_the_same_and_the_record_that_they_were_made_from(blob, record, data, tmp_path):
    (tmp_path / "copy.blob").write_bytes(data)
    holds = loaded(load_blob(blob)).holds
    assert holds == loaded(load_blob(tmp_path / "copy.blob")).holds
    assert holds[0] != loaded(record).holds[0]
    assert holds[1:] == loaded(record).holds


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("wings", r"unit\.blob: a section 'wings' cannot be applied"),
        ("array", r"unit\.blob: nothing in this blob corrects a recording; array fuse takes it"),
    ],
)
def test_a_blob_with_a_section_that_apply_does_not_take_is_refused(kind, message, tmp_path):
    text = {"format": "imulab.blob", "sensor": {}, "software": "x", "records": [], "sections": [{"kind": kind}]}
    data = pack(tables_of(madeup.tumble(1)), 4, text)
    with pytest.raises(RecordError, match=message):
        loaded(Blob("unit.blob", data, text))
    (tmp_path / "unit.blob").write_bytes(data)
    with pytest.raises(RecordError, match=rf"unit\.blob: its text speaks of {kind}, but it holds tumble"):
        load_blob(tmp_path / "unit.blob")


@pytest.mark.parametrize(
    "text", [{}, {"format": "other"}, {"format": "imulab.blob"}, {"format": "imulab.blob", "sections": 3}]
)
def test_a_blob_without_a_description_of_its_units_is_for_firmware_only(text, tmp_path):
    (tmp_path / "unit.blob").write_bytes(pack(tables_of(madeup.tumble(1)), 4, text))
    with pytest.raises(RecordError, match="for firmware only"):
        load_blob(tmp_path / "unit.blob")


def test_export_writes_exactly_one_blob_and_what_it_holds_is_checked(record, tmp_path):
    files = export("blob", [record, madeup.warmup(), madeup.centrifuge()], tmp_path / "new" / "folder")
    assert [path.name for path in (tmp_path / "new" / "folder").iterdir()] == ["unit.blob"]
    made = load_blob(files[0])
    assert isinstance(made, Blob)
    assert [section["kind"] for section in made.text["sections"]] == ["tumble", "gyro", "warmup", "centrifuge"]


def test_two_records_of_one_kind_or_of_two_units_are_refused(record):
    other_axis = madeup.warmup()
    other_axis.sections["table"]["axes"] = ["gyro_y", "accel_x"]
    with pytest.raises(RecordError, match=r"a\.json and warmup SN42 each give a table of kind warmup; a unit has one"):
        tables_of_all([madeup.warmup(), other_axis], files=["a.json", ""])
    other = Calibration(**{**vars(madeup.warmup()), "sensor": {"serial": "SN7"}})
    with pytest.raises(RecordError, match="records of different units: SN42 SN7"):
        tables_of_all([record, other])


def fields_of(table):
    return {field.name: field.values for field in table.fields}


def test_a_table_has_the_record_s_numbers():
    record = madeup.tumble(2, gyro=True, sensitive=True)
    accel, gyro = tables_of(record)
    assert (accel.kind, gyro.kind) == ("tumble", "gyro")
    fields = fields_of(accel)
    assert fields["order"] == 2
    assert fields["gain"].tolist() == [1 / record.value(f"scale_factor_{a}") for a in "xyz"]
    assert fields["misalignment"].tolist() == [record.value(f"misalignment_{p}") for p in ("yx", "zx", "zy")]
    assert fields["nonlinearity"].tolist() == [[record.value(f"k2_{a}") for a in "xyz"]]
    matrix = np.eye(3)
    for i, a in enumerate("xyz"):
        for j, b in enumerate("xyz"):
            matrix[i, j] = 1.0 if i == j else record.value(f"gyro_misalignment_{a}{b}")
    np.testing.assert_allclose(fields_of(gyro)["turn"] @ matrix, np.eye(3), atol=1e-15)
    assert fields_of(gyro)["sensitivity"][0, 1] == record.value("gyro_g_sensitivity_xy")


@pytest.mark.parametrize(
    ("k", "low", "high"),
    [
        ([], -np.inf, np.inf),
        ([0.0], -np.inf, np.inf),
        ([0.5], -0.5, np.inf),  # s + s^2/2 turns at s = -1
        ([-0.5], -np.inf, 0.5),
        ([0.0, -1 / 3], -2 / 3, 2 / 3),  # s - s^3/3 turns at +-1
        ([0.0, 1 / 3], -np.inf, np.inf),
        ([0.0, 0.0, -0.25], -np.inf, 0.75),  # s - s^4/4 turns at 1
        ([0.0, 0.0, 0.0, 0.0], -np.inf, np.inf),
    ],
)
def test_the_range_ends_at_the_turning_points_next_to_zero(k, low, high):
    np.testing.assert_allclose(monotone_range(np.array(k)), (low, high), rtol=1e-12)


def test_the_range_is_that_of_a_fine_search():
    rng = np.random.default_rng(1)
    for _ in range(20):
        k = rng.uniform(-0.2, 0.2, 4)
        s = np.linspace(-20, 20, 40_001)
        a = s + sum(c * s ** (p + 2) for p, c in enumerate(k))
        rising = np.diff(a) > 0
        zero = 20_000
        last = zero + int(np.argmin(rising[zero:])) if not rising[zero:].all() else None
        first = zero - int(np.argmin(rising[:zero][::-1])) if not rising[:zero].all() else None
        low, high = monotone_range(k)
        assert (high == np.inf) == (last is None)
        assert (low == -np.inf) == (first is None)
        if last is not None:
            assert high == pytest.approx(a[last], abs=1e-4)
        if first is not None:
            assert low == pytest.approx(a[first], abs=1e-4)


def changed(record, name, value=None, unit=None):
    old = record.parameters[name]
    new = Parameter(old.value if value is None else value, None, unit or old.unit)
    return replace(record, parameters={**record.parameters, name: new})


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (changed(madeup.tumble(1), "scale_factor_y", 0.0), "a scale factor of 0"),
        (changed(madeup.tumble(1, gyro=True), "gyro_scale_factor_y", 0.0), "a scale factor of 0"),
        (changed(madeup.tumble(1), "bias_x", unit="mg"), "has bias_x in 'mg', expected 'm/s\\^2'"),
        (replace(madeup.tumble(1), model={"order": 6, "output_unit": "count"}), "order 6, expected a whole number"),
        (
            replace(madeup.tumble(1), model={"order": 1.0, "output_unit": "count"}),
            "order: .*, found 1.0",
        ),
        (
            replace(madeup.tumble(1), model={"order": True, "output_unit": "count"}),
            "order: .*, found True",
        ),
        (replace(madeup.centrifuge(), parameters={}), "lacks x_K0"),
        (
            replace(
                madeup.centrifuge(),
                parameters={n: p for n, p in madeup.centrifuge().parameters.items() if n != "y_direction"},
            ),
            "has no y_direction: it was made without table_angle",
        ),
        (replace(madeup.warmup(), sections={}), "lacks its table"),
    ],
)
def test_records_that_cannot_be_are_refused(record, message):
    with pytest.raises(RecordError, match=message):
        tables_of(record)


def test_a_centrifuge_of_one_axis_leaves_the_other_alone():
    whole = madeup.centrifuge()
    one = replace(whole, parameters={n: p for n, p in whole.parameters.items() if n[0] == "y" and n != "y_c2"})
    fields = fields_of(tables_of(one)[0])
    assert fields["has"].tolist() == [0, 1]
    assert fields["c2"].tolist() == [0, 0]  # a term that model choice dropped means 0
    out, _ = DeviceUnit.of(*tables_of(one)).centrifuge([np.full(2, 9.8), np.zeros(2)], [np.zeros(2), np.zeros(2)])
    assert (out[0] == 0).all()
    assert (out[1] != 0).all()


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("model", "spline", "model 'spline'"),
        ("exit", "never", "exit 'never'"),
        ("coefficients", [[[0.0] * 4] * 2] * 3, r"coefficients of shape \(3, 2, 4\), expected \(8, 2, 4\)"),
    ],
)
def test_warmup_tables_that_do_not_fit_are_refused(key, value, message):
    with pytest.raises(RecordError, match=message):
        warmup_table({**madeup.warmup().sections["table"], key: value})


def test_numbers_beyond_a_float_are_refused_by_name():
    record = changed(madeup.tumble(1), "bias_x", 1e300)
    assert pack(tables_of(record), 8)
    with pytest.raises(RecordError, match=r"tumble bias: .* is beyond what 4 bytes hold"):
        pack(tables_of(record), 4)


@pytest.mark.parametrize("width", [4, 8])
def test_the_layout_is_that_of_the_document(width):
    record = madeup.tumble(2)
    text = {"b": "µ", "a": 1}
    data = pack(tables_of(record), width, text)
    assert data[:8] == b"\x89IMULAB\n"
    assert struct.unpack_from("<HHI", data, 8) == (1, width, len(data))
    assert struct.unpack("<I", data[-4:])[0] == zlib.crc32(data[:-4])
    described = b'{"a": 1, "b": "\xc2\xb5"}'
    assert struct.unpack_from("<II", data, 16) == (0, len(described))
    at = 24 + len(described)
    assert data[24:at] == described
    kind, size, order = struct.unpack_from("<III", data, at)
    assert (kind, order) == (KINDS["tumble"], 2)
    assert size == 4 + 18 * width == len(data) - at - 8 - 4
    numbers = np.frombuffer(data, f"<f{width}", 18, at + 12)
    fields = fields_of(tables_of(record)[0])
    expected = np.concatenate(
        [fields[n].ravel() for n in ("gain", "bias", "misalignment", "low", "high", "nonlinearity")]
    )
    assert np.array_equal(numbers, expected.astype(f"<f{width}"))


def test_an_array_table_announces_its_optional_tables():
    table = array_table(ArraySettings("robust", 4, bias=np.zeros(4), weights=np.ones(4)))
    words = struct.unpack_from("<11I", table.payload(4))
    assert words[:3] == (4, 4, 1)
    assert words[10] == 0b01001
    assert len(table.payload(4)) == 4 * (11 + 6 + 4 + 4)

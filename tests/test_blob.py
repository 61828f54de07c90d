"""Blobs: what is cut, altered, newer or none gets one line; a whole one gives what its record gives, in float."""

import json
import struct
import zlib

import numpy as np
import pytest

import imulab as il
import madeup
from imulab.cli import main
from imulab.device.tables import pack
from imulab.device.unit import Blob, is_blob, load_blob, make_blob
from imulab.errors import RecordError
from imulab.exporters import export
from imulab.procedures.apply import apply, apply_blocks, loaded, tables_of, tables_of_all, warnings_of
from imulab.procedures.registry import load_any
from imulab.recording import Recording
from imulab.records.calibration import Calibration

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
        return closed(body[:8] + b"\3\0" + body[10:])
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
    assert warnings_of(load_blob(blob), other) == ["flight.csv: serial SN1, but the record was made for SN42"]
    assert warnings_of(load_blob(blob), flight) == []


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
    with pytest.raises(RecordError, match="two records give a tumble table; a unit has one"):
        tables_of_all([record, madeup.tumble(1)])
    other = Calibration(**{**vars(madeup.warmup()), "sensor": {"serial": "SN7"}})
    with pytest.raises(RecordError, match="records of different units: SN42 SN7"):
        tables_of_all([record, other])

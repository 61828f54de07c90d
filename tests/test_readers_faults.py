"""Text as loggers leave it: labels, torn lines, zeros behind the end, columns of text, packed files, flat triples."""

import bz2
import gzip
import json
import lzma
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.errors import OptionError, ReadError, RecordError
from imulab.readers import read_blocks
from imulab.readers.labelled import pairs
from imulab.readers.text import LONGEST_LINE

HEAD = "time [s],accel_x [g],accel_y [g],accel_z [g]\n"


def rows(count, more=""):
    return [f"{k / 100:.2f},{0.001 * k:.3f},0.2,0.98{more}\n" for k in range(count)]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "f.csv"


# Labels.


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        (
            "Acceleration X: -2.76, Y: -7.99, Z: -5.00 m/s^2",
            [("Acceleration X", "-2.76", ""), ("Acceleration Y", "-7.99", ""), ("Acceleration Z", "-5.00", "m/s^2")],
        ),
        ("t:0,aX:0.1,aY:-1e-3", [("t", "0", ""), ("aX", "0.1", ""), ("aY", "-1e-3", "")]),
        ("ax=0.5 ay=+1. az=.25", [("ax", "0.5", ""), ("ay", "+1.", ""), ("az", ".25", "")]),
        ("Temperature: 26.01 degC", [("Temperature", "26.01", "degC")]),
        (
            "Accel: 6.9, 4.70, -5 | Gyro: .1 2. 3e-2",
            [(f"Accel {axis}", number, "") for axis, number in zip("xyz", ("6.9", "4.70", "-5"), strict=True)]
            + [(f"Gyro {axis}", number, "") for axis, number in zip("xyz", (".1", "2.", "3e-2"), strict=True)],
        ),
        ("Accel: 1, 2, 3, 4", [("Accel", "1", "")]),
        ("t: 1, 2, 3", [("t", "1", "")]),
        ("12:30:15 started", []),
        ("MPU6050 Found!", []),
    ],
)
def test_labels_numbers_and_units_of_a_line(line, expected):
    assert list(pairs(line)) == expected


def labelled(count=60):
    rng = np.random.default_rng(8)
    accel, gyro = np.round(rng.normal(0, 3, (count, 3)), 2), np.round(rng.normal(0, 1, (count, 3)), 2)
    text = "MPU6050 Found!\nGyro range set to: +- 500 deg/s\n\n"
    for a, w in zip(accel, gyro, strict=True):
        text += (
            f"Acceleration X: {a[0]}, Y: {a[1]}, Z: {a[2]} m/s^2\nRotation X: {w[0]}, Y: {w[1]}, Z: {w[2]} rad/s\n\n"
        )
    return text, accel, gyro


def test_labelled_text_of_several_lines_a_row(imulab, path):
    text, accel, gyro = labelled()
    path.write_text(text)
    assert imulab("layout", "guess", "f.csv", "--sample-rate", "50", "-o", "l.toml").returncode == 0
    found = il.read(path, path.parent / "l.toml")
    np.testing.assert_array_equal(found.triad("accel"), accel)
    np.testing.assert_array_equal(found.triad("gyro"), gyro)
    assert (found.units["accel_x"], found.units["gyro_x"], found.time[-1]) == ("m/s^2", "rad/s", 59 / 50)
    refused = imulab("show", "f.csv")
    assert refused.returncode == 2
    assert "imulab layout guess f.csv --sample-rate HZ -o L.toml" in refused.stderr


def test_labelled_rows_that_lack_a_label(path, tmp_path):
    text, _, _ = labelled()
    lines = text.splitlines(keepends=True)
    del lines[13]
    path.write_text("".join(lines))
    toml = "labelled = true\nsample_rate = 50\n[columns]\n" + "".join(
        f'{sensor}_{axis} = {{ from = "{word} {axis.upper()}", unit = "{unit}" }}\n'
        for sensor, word, unit in (("accel", "Acceleration", "m/s^2"), ("gyro", "Rotation", "rad/s"))
        for axis in "xyz"
    )
    (tmp_path / "l.toml").write_text(toml)
    with pytest.raises(
        ReadError, match=r"row 4 \(line 15\): no number labelled 'Rotation X' before the next row begins"
    ):
        il.read(path, tmp_path / "l.toml")
    (tmp_path / "l.toml").write_text("skip_incomplete = true\n" + toml)
    found = il.read(path, tmp_path / "l.toml")
    assert len(found) == 59
    assert "1 row was skipped" in found.notes[0]
    (tmp_path / "l.toml").write_text(toml.replace("Rotation X", "Spin X"))
    with pytest.raises(ReadError, match=r"takes a number labelled 'Spin X', found Acceleration X Acceleration Y"):
        il.read(path, tmp_path / "l.toml")
    (tmp_path / "l.toml").write_text('delimiter = ","\n' + toml)
    with pytest.raises(ReadError, match="delimiter together with labelled = true"):
        il.read(path, tmp_path / "l.toml")


def test_commas_before_blanks_are_no_part_of_numbers(path, tmp_path):
    path.write_text("".join(f"Acceleration X: {k}.5, Y: -7.99, Z: -5.00 m/s^2\nother 1\n" for k in range(30)))
    columns = "".join(f'accel_{a} = {{ from = {k}, unit = "m/s^2" }}\n' for a, k in zip("xyz", (1, 3, 5), strict=True))
    toml = f'delimiter = "whitespace"\nprefix = "Acceleration"\nsample_rate = 50\n[columns]\n{columns}'
    (tmp_path / "l.toml").write_text(toml)
    np.testing.assert_array_equal(il.read(path, tmp_path / "l.toml").columns["accel_x"], np.arange(30) + 0.5)


# Torn lines.


def test_torn_lines_are_refused_or_left_out_and_counted(imulab, path):
    lines = rows(3000)
    lines[1200] = "12.00,0.1,0.2,0.0.98\n"
    lines[2000] = "20.00,0.1\n"
    path.write_text(HEAD + "".join(lines))
    done = imulab("show", "f.csv")
    assert done.returncode == 2
    assert done.stderr == (
        "imulab: f.csv: row 1201 (line 1202), column accel_z: expected a number, found '0.0.98'; --damaged skip passes "
        "over such lines and counts them\n"
    )
    found = il.read(path, damaged="skip")
    assert len(found) == 2998
    (note,) = found.notes
    assert note.startswith(
        "2 damaged lines are left out; the first: row 1201 (line 1202), column accel_z: expected a n"
    )
    whole = [line for k, line in enumerate(lines) if k not in (1200, 2000)]
    np.testing.assert_array_equal(found.columns["accel_x"], [float(line.split(",")[1]) for line in whole])
    shown = imulab("show", "f.csv", "--damaged", "skip")
    assert shown.returncode == 0
    assert "2998 samples" in shown.stdout
    assert "note: 2 damaged lines are left out" in shown.stdout
    assert sum(len(block) for block in read_blocks(path, damaged="skip")) == 2998
    with pytest.raises(OptionError, match="damaged 'drop': expected one of refuse skip"):
        il.read(path, damaged="drop")


def test_torn_lines_in_every_block_of_a_large_file(path):
    lines = rows(300_000)
    bad = list(range(7, 300_000, 9973))
    for k in bad:
        lines[k] = lines[k][:9] + "x\n"
    path.write_text(HEAD + "".join(lines))
    found = il.read(path, damaged="skip")
    assert len(found) == 300_000 - len(bad)
    kept = np.delete(np.arange(300_000), bad)
    np.testing.assert_array_equal(found.columns["time"], kept / 100)
    assert f"{len(bad)} damaged lines" in found.notes[0]


def test_a_file_of_damaged_lines_is_refused(path):
    lines = rows(400)
    lines[1::3] = ["nothing\n"] * len(lines[1::3])
    path.write_text(HEAD + "".join(lines))
    with pytest.raises(ReadError, match=r"21 lines of the first \d+ cannot be read, which are no torn lines"):
        il.read(path, damaged="skip")


def test_torn_lines_of_a_layout_with_a_prefix(path, tmp_path):
    lines = [f"a/g:\t{k}\t-200\t16000\n" for k in range(100)]
    lines[50] = "a/g:\t12\t-a/g:\t51\t9265\n"
    path.write_text("".join(lines))
    columns = "".join(f'accel_{a} = {{ from = {k}, unit = "count" }}\n' for k, a in enumerate("xyz"))
    for more in ("", "skip_incomplete = true\n"):
        (tmp_path / "l.toml").write_text(
            f'delimiter = "\\t"\nprefix = "a/g:"\n{more}sample_rate = 50\n[columns]\n{columns}'
        )
        found = il.read(path, tmp_path / "l.toml", damaged="skip")
        np.testing.assert_array_equal(found.columns["accel_x"], np.delete(np.arange(100), 50))


# Zeros behind the end.


@pytest.mark.parametrize("zeros", [1, 511, 4096, 5_000_000])
def test_zeros_behind_the_end_are_cut_and_counted(imulab, path, zeros):
    text = HEAD + "".join(rows(1000))
    path.write_bytes(text.encode()[:-9] + bytes(zeros))
    found = il.read(path)
    assert len(found) == 999
    assert str(found.notes[0]) == (
        f"truncated: {zeros} bytes of zero behind the rows, and a line cut there, are left out"
    )
    path.write_bytes(text.encode() + bytes(zeros))
    assert len(il.read(path)) == 1000
    shown = imulab("convert", "f.csv", "-o", "out.csv")
    assert f"warning: f.csv: truncated: {zeros} bytes of zero" in shown.stderr


def test_text_behind_zeros_is_refused(path):
    text = (HEAD + "".join(rows(100_000))).encode()
    path.write_bytes(text + bytes(5_000_000) + text)
    with pytest.raises(ReadError, match=r"bytes of zero before byte .*: expected text, found a gap"):
        il.read(path)
    path.write_bytes(bytes(LONGEST_LINE))
    with pytest.raises(ReadError, match="the file is empty"):
        il.read(path)


# Columns of text.


def test_a_column_of_text_is_left_out_with_a_note(imulab, path):
    path.write_text(HEAD.replace("\n", ",activity,mark\n") + "".join(rows(200, ",walking,")))
    found = il.read(path)
    assert list(found.columns) == ["time", "accel_x", "accel_y", "accel_z", "mark"]
    assert [str(note) for note in found.notes] == ["column activity holds text, which is left out"]
    np.testing.assert_array_equal(found.columns["accel_x"], np.arange(200) / 1000)
    lines = rows(200, ",walking,")
    lines[150] = lines[150].replace(",\n", ",start\n")
    path.write_text(HEAD.replace("\n", ",activity,mark\n") + "".join(lines))
    found = il.read(path)
    assert np.isnan(found.columns["mark"]).all()
    assert "column mark holds text from row 151 on, which is no reading (nan)" in found.notes
    assert imulab("convert", "f.csv", "-o", "out.csv").returncode == 0
    # A column of a sensor must hold numbers.
    path.write_text(HEAD + "".join(rows(5)).replace("0.98", "high"))
    with pytest.raises(ReadError, match=r"row 1 .*, column accel_z: expected a number, found 'high'"):
        il.read(path)


def test_a_column_of_text_in_parquet(path, tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    names = ["time [s]", *(f"accel_{a} [g]" for a in "xyz"), "activity"]
    arrays = [pyarrow.array(np.arange(5.0) + k) for k in range(4)] + [pyarrow.array(["walk"] * 5)]
    parquet.write_table(pyarrow.table(dict(zip(names, arrays, strict=True))), tmp_path / "f.parquet")
    found = il.read(tmp_path / "f.parquet")
    assert list(found.columns) == ["time", "accel_x", "accel_y", "accel_z"]
    assert [str(note) for note in found.notes] == ["column activity holds text, which is left out"]


# Packed files.


def test_gz_and_zip_of_one_file_are_read_as_what_they_hold(imulab, path, tmp_path):
    path.write_text(HEAD + "".join(rows(500)))
    plain = il.read(path)
    (tmp_path / "f.csv.gz").write_bytes(gzip.compress(path.read_bytes()))
    with zipfile.ZipFile(tmp_path / "f.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("log/f.csv", path.read_bytes())
        archive.writestr("__MACOSX/log/._f.csv", b"\0")
    for name in ("f.csv.gz", "f.zip"):
        found = il.read(tmp_path / name)
        np.testing.assert_array_equal(found.triad("accel"), plain.triad("accel"))
        assert found.source.file == str(tmp_path / name)
        assert "500 samples" in imulab("show", name).stdout
    (tmp_path / "l.csv.gz").write_bytes(gzip.compress(path.read_bytes().replace(b" [", b"_").replace(b"]", b"")))
    assert imulab("layout", "guess", "l.csv.gz", "-o", "l.toml").returncode == 0
    assert il.read(tmp_path / "l.csv.gz", tmp_path / "l.toml").units["accel_x"] == "g"


@pytest.mark.slow
def test_packed_files_that_are_refused(imulab, path, tmp_path):
    path.write_text(HEAD + "".join(rows(500)))
    data = path.read_bytes()
    (tmp_path / "cut.gz").write_bytes(gzip.compress(data)[:-40])
    (tmp_path / "f.bz2").write_bytes(bz2.compress(data))
    (tmp_path / "f.xz").write_bytes(lzma.compress(data))
    (tmp_path / "f.gz.gz").write_bytes(gzip.compress(gzip.compress(data)))
    with tarfile.open(tmp_path / "f.tar.gz", "w:gz") as archive:
        archive.add(path, "f.csv")
    (tmp_path / "bomb.gz").write_bytes(gzip.compress(b"0" * 80_000_000))
    for name, entries in (("two.zip", ["a.csv", "b.csv"]), ("none.zip", []), ("x.xlsx", ["[Content_Types].xml"])):
        with zipfile.ZipFile(tmp_path / name, "w") as archive:
            archive.writestr("empty/", b"")
            for entry in entries:
                archive.writestr(entry, data)
    for name, message in (
        ("cut.gz", "truncated or damaged, cannot be unpacked"),
        ("bomb.gz", "unpacks to more than 67 MB"),
        ("two.zip", "expected one file in it, found a.csv, b.csv; unpack it, and name one"),
        ("none.zip", "expected one file in it, found none"),
        ("x.xlsx", "a spreadsheet; expected text: save the sheet as CSV"),
        ("f.bz2", "expected text, found what bzip2 packed: unpack it first"),
        ("f.xz", "expected text, found what xz packed: unpack it first"),
        ("f.tar.gz", "expected text, found what tar packed: unpack it first"),
        ("f.gz.gz", "expected text, found what gzip packed: unpack it first"),
    ):
        done = imulab("show", name)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1)
        assert message in done.stderr
    assert "80000000" not in imulab("show", "bomb.gz", "--unpack-limit", "100MB").stderr


# Flat triples.


def test_flat_triples_in_json(imulab, tmp_path):
    accel = [[0.1, 0.2, 9.81]] * 20
    accel[7] = [None] * 3
    flat = [number for row in accel for number in row]
    document = {"t": [k / 100 for k in range(20)], "acc": flat}
    (tmp_path / "f.json").write_text(json.dumps(document))
    guessed = imulab("layout", "guess", "f.json", "-o", "l.toml")
    assert guessed.returncode == 0
    found = il.read(tmp_path / "f.json", tmp_path / "l.toml")
    assert len(found) == 20
    assert np.isnan(found.triad("accel")[7]).all()
    np.testing.assert_array_equal(np.delete(found.triad("accel"), 7, axis=0), [[0.1, 0.2, 9.81]] * 19)
    toml = (tmp_path / "l.toml").read_text()
    (tmp_path / "m.toml").write_text(toml.replace("[0::3]", "[0]"))
    done = imulab("show", "f.json", "--layout", "m.toml")
    assert 'where x, y, z lie flat in one array, from = "..[0::3]"' in done.stderr
    (tmp_path / "m.toml").write_text(toml.replace("[0::3]", "[3::3]"))
    assert "expected a first place below the step" in imulab("show", "f.json", "--layout", "m.toml").stderr
    (tmp_path / "f.json").write_text(json.dumps({**document, "acc": flat[:-1]}))
    assert (
        "an array of 59 numbers, which are no whole groups of 3"
        in imulab("show", "f.json", "--layout", "l.toml").stderr
    )


def test_records_of_json_are_guessed(imulab, tmp_path):
    records = [
        {"ts": 1000 + 10 * k, "acc": {"x": 0.0, "y": 0.0, "z": 9.8}, "gyro_dps": [0.1, 0.2, 0.3]} for k in range(9)
    ]
    (tmp_path / "f.json").write_text(json.dumps(records).replace("ts", "time"))
    done = imulab("layout", "guess", "f.json")
    assert 'accel_z = { from = "acc.z", unit = "m/s^2" }' in done.stdout
    assert 'gyro_y = { from = "gyro_dps[1]", unit = "deg/s" }' in done.stdout


def test_parquet_of_repeated_values_has_a_budget(tmp_path):
    """173 kB that unpacked to 40 million rows took 1.6 GB of memory."""
    arrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    path = tmp_path / "rle.parquet"
    zeros = arrow.array(np.zeros(3_000_000))
    names = ["time [s]", "gyro_x [rad/s]", "gyro_y [rad/s]", "gyro_z [rad/s]"]
    parquet.write_table(arrow.table(dict.fromkeys(names, zeros)), path)
    assert path.stat().st_size < 300_000
    with pytest.raises(
        ReadError, match=r"rle.parquet: unpacks to more than 67 MB, which no measured data of this size"
    ):
        list(il.read_blocks(path))
    noise = np.random.default_rng(1).normal(size=200_000)
    parquet.write_table(arrow.table(dict.fromkeys(names[1:], noise)), path)
    assert len(il.read(path)) == 200_000


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="a device that never ends is needed")
def test_a_record_without_end_is_refused():
    with pytest.raises(RecordError, match="/dev/zero: more than 256 MiB; expected a record"):
        il.load("/dev/zero")


@pytest.mark.parametrize(("torn", "state"), [(1, "good"), (12, "look")])
def test_a_torn_line_among_thousands_does_not_lower_the_verdict(imulab, tmp_path, torn, state):
    recording = il.simulate_tumble(order=1, gravity=9.81, attitudes=24, hold=2.0, gyro=False, seed=5)
    il.write_csv(recording, tmp_path / "r.csv")
    lines = (tmp_path / "r.csv").read_text().splitlines(keepends=True)
    for place in range(1000, 1000 + 50 * torn, 50):
        lines[place] = lines[place][:20] + lines[place + 1]
    (tmp_path / "r.csv").write_text("".join(lines))
    fit = ("tumble", "fit", "r.csv", "--order", "1", "--gravity", "9.81+-0", "-o", "r.json")
    refused = imulab(*fit)
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert refused.stderr.endswith("; --damaged skip passes over such lines and counts them\n")
    assert imulab(*fit, "--damaged", "skip").stdout.startswith(f"{state}: ")

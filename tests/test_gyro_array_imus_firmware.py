"""A board of whole IMUs in exported firmware: the same as `array fuse --imus`, and as dense least squares."""

import json
import subprocess
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from conftest import STRICT
from imulab.cli import main
from imulab.device.tables import Fusion, pack
from imulab.device.unit import BEYOND, EXCLUDED, Blob, load_blob
from imulab.errors import OptionError
from imulab.exporters import EXPORTERS
from imulab.procedures.apply import tables_of
from imulab.procedures.gyro_array.imus.columns import readings_of
from imulab.procedures.gyro_array.imus.figures import exhibits
from imulab.procedures.gyro_array.imus.fuse import board_of
from imulab.procedures.gyro_array.imus.prepare import names_of
from reference import imus as reference
from test_exporters_firmware_c import arduino, worst
from test_gyro_array_imus_fuse import clipped_board, true_record, without_latency

RANGE = 300.0  # deg/s
STEPS = """
int main(void) {
    static double z[1 + 6 * UNIT_IMUS], out[19];
    static il_real all[6 * UNIT_IMUS];
    static il_imus_fused fused;
    if (!compensation_start()) return 1;
    while (fread(z, sizeof z, 1, stdin) == 1) {
        for (int i = 0; i < 6 * UNIT_IMUS; i++) all[i] = (il_real)z[1 + i];
        out[18] = fuse_board((il_real)z[0], all, &fused);
        const il_real *const found[] = {fused.force, fused.rate, fused.acceleration,
                                        fused.force_std, fused.rate_std, fused.acceleration_std};
        for (int i = 0; i < 18; i++) out[i] = (double)found[i / 3][i % 3];
        (void)fwrite(out, sizeof out, 1, stdout);
    }
    return 0;
}
"""


@pytest.fixture(scope="module")
def board():
    """A board with one accelerometer dead for a while, a gyroscope that gives no number, and a clipped part."""
    made = il.simulate_imus(elements=4, attitudes=1, duration="6 s", rate="100 Hz", age="0 s", seed=3)
    made = clipped_board(made, RANGE)
    columns = {name: values.copy() for name, values in made.columns.items()}
    for axis in "xyz":
        columns[f"accel_{axis}_4"][700:760] = 0.0
        columns[f"gyro_{axis}_2"][650:655] = np.nan
    return il.Recording(columns, made.units, made.metadata, "board.csv")


@pytest.fixture(scope="module")
def record(board):
    """The true record, but for the latencies, which firmware does not take out."""
    return true_record(without_latency(board))


@pytest.fixture(scope="module")
def rows(board):
    """Steps and readings, shape (n, 1 + 6 K)."""
    time, readings = board.si("time"), readings_of(board, names_of(board))
    return np.hstack([np.diff(time, prepend=time[0])[:, None], readings.reshape(len(time), -1)])


@pytest.fixture(scope="module")
def in_c(record, rows, compiler, core, tmp_path_factory):
    """What the code in the README of the exported folder makes of the rows, as double and as float, shape (n, 19)."""
    folder = tmp_path_factory.mktemp("board")
    il.export("c", record, folder, gyro_range=f"{RANGE} deg/s")
    code = (folder / "README.md").read_text(encoding="utf-8").split("```")[1].removeprefix("c\n")
    declared = [line.removesuffix(" {") + ";" for line in code.splitlines() if line.endswith(") {") and line[0] != " "]
    text = "\n".join(["#include <stdio.h>", '#include "unit.h"', *declared, code, STEPS])
    (folder / "project.c").write_text(text, encoding="utf-8")
    found = {}
    for real in ("double", "float"):
        files = [folder / "project.c", core / f"{real}.o", folder / "unit.c"]
        options = [*STRICT, "-pedantic", f"-DIMULAB_REAL={real}", f"-I{folder}"]
        subprocess.run([compiler, *options, *files, "-o", folder / real, "-lm"], check=True)
        done = subprocess.run([folder / real], input=rows.tobytes(), capture_output=True, check=True)
        found[real] = np.frombuffer(done.stdout).reshape(len(rows), 19)
    return found


def numbers(out):
    return np.hstack([out.force, out.rate, out.acceleration, out.force_std, out.rate_std, out.acceleration_std])


def test_the_exported_c_gives_what_fuse_imus_gives(in_c, board, record):
    out = il.fuse_imus(board, calibration=record, gyro_range=f"{RANGE} deg/s")
    expected = numbers(out)
    assert 0.05 < out.bridged.mean() < 0.9
    assert np.array_equal(in_c["double"][:, :18], expected, equal_nan=True)
    single, bridged = in_c["float"], out.bridged
    for found in (in_c["double"], single):
        assert np.array_equal((found[:, 18].astype(int) & BEYOND) != 0, bridged)
        assert np.array_equal((found[:, 18].astype(int) & EXCLUDED) != 0, ~out.used.all(axis=(1, 2)))
        assert (~out.used[705:760, 0, 3]).all()
    error = np.abs(single[:, :18] - expected)
    assert error[~bridged, 3:6].max() < 1.6e-5  # rad/s
    assert error[~bridged, :3].max() < 2e-6 * np.abs(expected[:, :3]).max()
    assert (error[bridged, :9] < 0.2 * expected[bridged, 9:]).all()
    assert (error[:, 9:] < 4e-4 * expected[:, 9:]).all()


def test_the_exported_c_is_dense_least_squares(in_c, record, rows):
    known = board_of(record, "centroid", np.array([[1e30], [np.radians(RANGE)]])).settings
    names = ("accel", "accel_bias", "accel_noise", "gyro", "gyro_bias", "gyro_noise", "position", "accel_limit")
    board = reference.Board(**{name: getattr(known, name) for name in names}, gyro_limit=known.gyro_limit, at=known.at)
    board.stuck, board.quiet = 50, 100
    fusion = reference.Fusion(board)
    part = slice(300, 900)
    expected = [fusion.step(row[0], row[1:].reshape(2, 4, 3)) for row in rows[: part.stop]][part]
    dense, bridged = np.array([row[0] for row in expected]), np.array([row[1] for row in expected])
    error = np.abs(in_c["double"][part, :18] - dense)
    assert 0.05 < bridged.mean() < 0.95
    assert error[:, 3:6].max() < 6e-11  # rad/s
    assert error[:, 6:9].max() < 2e-9
    assert np.abs(in_c["float"][part][~bridged, 3:6] - dense[~bridged, 3:6]).max() < 1.6e-5


@pytest.mark.parametrize(
    ("count", "more"),
    [
        (2, {}),
        (3, {"gyro_range": "250 deg/s"}),
        (4, {"at": "imu:2"}),
        (5, {"gyro_range": 2000.0, "accel_range": "16 g"}),
        (8, {"gyro_range": "2000 deg/s", "accel_range": "30 g"}),
    ],
)
def test_the_exported_self_test_passes(count, more, self_test, tmp_path):
    record = true_record(il.simulate_imus(elements=count, attitudes=1, duration="1 s"))
    files = il.export("c", record, tmp_path, **more)
    assert all(file.is_file() for file in files)
    for real in ("double", "float"):
        done = self_test(tmp_path, real)
        assert done.returncode == 0, done.stdout
        assert worst(done.stdout) <= (0 if real == "double" else 2e-6)
        assert "2280 numbers" in done.stdout
    golden = (tmp_path / "golden.h").read_text(encoding="utf-8")
    flags = {int(word.strip("{}u ")) for word in golden.split("golden_imus_flags[120] = ")[1].split(";")[0].split(",")}
    assert any(flag & BEYOND for flag in flags) == (count == 8)  # three cannot tell a rate of 250 deg/s well enough


def test_the_self_test_notices_a_wrong_number(self_test, record, tmp_path):
    il.export("c", record, tmp_path)
    text = (tmp_path / "unit.c").read_text(encoding="utf-8")
    place = text.split("imus_position[] = {")[1].split("}")[0].split(", ")[4]
    moved = f"R({float(place[2:-1]) + 1e-5!r})"  # m
    (tmp_path / "unit.c").write_text(text.replace(place, moved, 1), encoding="utf-8")
    done = self_test(tmp_path)
    assert done.returncode == 1
    assert "FAIL" in done.stdout


@pytest.mark.slow
def test_the_arduino_example_fuses_the_board(tools, board, record, rows, tmp_path):
    il.export("c", record, tmp_path)
    some = rows[560:640]
    found = arduino(tmp_path, some[:, 1:])
    part = {name: values[560:640] for name, values in board.columns.items()}
    out = il.fuse_imus(il.Recording(part, board.units, {}, "part"), calibration=record, gyro_range=1e5)
    assert np.abs(found[:, 3:6] - out.rate).max() < 1e-4  # in float, and with readings of nine digits
    assert np.abs(found[:, :3] - out.force).max() < 1e-4


def test_the_readme_tells_how_late_each_imu_is_and_whether_rates_are_bridged(board, record, tmp_path):
    late = true_record(board)
    il.export("c", late, tmp_path / "a")
    il.export("c", late, tmp_path / "b", gyro_range="2000 deg/s")
    first, second = ((tmp_path / name / "README.md").read_text(encoding="utf-8") for name in "ab")
    values = board_of(late).latency * 1e3
    assert all(f"| {k + 1} | {a:.4f} | {g:.4f} |" in first for k, (a, g) in enumerate(values.T))
    assert "range was not stated (`imulab export --gyro-range`)" in first
    assert "range was not stated" not in second
    assert first.count("| not known | not known |") == 4
    assert second.count("| not known | 34.9066 |") == 4
    assert "-DIL_IMUS=4" in first


# The blob, on the desk.


@pytest.fixture(scope="module")
def blob(board, tmp_path_factory):
    folder = tmp_path_factory.mktemp("blob")
    (file,) = il.export("blob", true_record(board), folder, gyro_range=f"{RANGE} deg/s")
    return file


def test_the_blob_fuses_as_its_record_does_latencies_included(board, blob, tmp_path, capsys):
    out = il.fuse_imus(board, calibration=true_record(board), gyro_range=f"{RANGE} deg/s")
    again = il.fuse_imus(board, calibration=blob)
    assert np.array_equal(again.bridged, out.bridged)
    assert np.array_equal(again.used, out.used)
    both = ~out.bridged & np.isfinite(out.rate).all(axis=1)
    assert np.abs(again.rate - out.rate)[both].max() < 1.6e-5
    il.write(board, tmp_path / "b.csv")
    words = ["array", "fuse", str(tmp_path / "b.csv"), "--imus", "--calibration", str(blob)]
    assert main([*words, "-o", str(tmp_path / "o.csv")]) == 0
    assert np.allclose(il.read(tmp_path / "o.csv").si("gyro_x"), again.rate[:, 0], rtol=1e-9, equal_nan=True)
    assert main(["show", str(blob)]) == 0
    assert "imus" in capsys.readouterr().out
    for option, word in (
        ("--gyro-range", "the range that it was exported with"),
        ("--at", "the point it was exported"),
    ):
        value = "100 deg/s" if option == "--gyro-range" else "imu:1"
        assert main([*words, option, value]) == 2
        said = capsys.readouterr().err
        assert option in said
        assert word in said
        assert said.count("\n") == 1


def test_a_blob_whose_text_speaks_of_other_imus_is_refused(board, record):
    (table,) = tables_of(record)
    section = {"kind": "imus", **table.columns, "accel_latency": [0.0] * 3, "gyro_latency": [0.0] * 3}
    text = {"format": "imulab.blob", "sensor": {}, "software": "x", "records": [], "sections": [section]}
    columns = {name: values for name, values in board.columns.items() if not name.endswith("_4")}
    three = il.Recording(columns, board.units, {}, "three.csv")
    with pytest.raises(il.ImulabError, match="the blob's table and its text, which says 3 IMUs, differ"):
        il.fuse_imus(three, calibration=Blob("unit.blob", pack([table], 4, text), text))


@pytest.mark.parametrize("end", [250.0, 300.0])  # deg/s: in float above itself, and below
def test_a_blob_in_float_takes_clipped_readings_for_the_end_of_the_range(end, tmp_path):
    clipped = clipped_board(il.simulate_imus(elements=4, attitudes=1, duration="2 s", age="0 s", seed=3), end)
    record = true_record(clipped)
    (blob,) = il.export("blob", record, tmp_path, gyro_range=f"{end} deg/s")
    told = il.fuse_imus(clipped, calibration=record, gyro_range=f"{end} deg/s")
    assert told.bridged.mean() > 0.03
    assert np.array_equal(il.fuse_imus(clipped, calibration=blob).bridged, told.bridged)


def test_a_board_of_mixed_ranges_keeps_those_of_each_imu(tmp_path):
    """The range of the narrowest IMU for all of them took the latency out of the others only below it."""
    board = il.simulate_imus(elements=4, attitudes=1, duration="6 s", rate="100 Hz", age="0 s", seed=3)
    limits = np.array([[1e30, 160.0, 160.0, 1e30], [*np.radians([250.0, 2000.0, 2000.0]), 1e30]])
    mixed = true_record(board, limits)
    (blob,) = il.export("blob", mixed, tmp_path)
    read = board_of(load_blob(blob))
    assert np.array_equal(read.limits, limits)
    out, again = (il.fuse_imus(board, calibration=known) for known in (mixed, blob))
    assert out.bridged.mean() > 0.05
    assert np.array_equal(again.bridged, out.bridged)
    assert (np.abs(again.rate - out.rate) < 1e-3 * out.rate_std).all()  # 600 of them with one range for all
    il.export("c", mixed, tmp_path / "c")
    readme = (tmp_path / "c" / "README.md").read_text(encoding="utf-8")
    assert "The end of some gyroscopes' range was not stated" in readme
    ends = [line.rsplit("|", 3)[1:3] for line in readme.split("gyroscopes end at")[1].splitlines()[2:6]]
    assert ends == [[" not known ", " 4.36332 "], *[[" 160 ", " 34.9066 "]] * 2, [" not known "] * 2]


def test_the_text_of_the_blob_holds_what_only_the_desk_needs(blob, record):
    text = json.loads(blob.read_bytes().partition(b"{")[2].partition(b"}]")[0].join((b"{", b"}]}")))
    (section,) = text["sections"]
    assert section["imus"] == 4
    assert section["gyro_range"] == pytest.approx([np.radians(RANGE)] * 4)
    assert section["accel_range"] == [None] * 4
    assert len(section["accel_latency"]) == len(section["gyro_latency"]) == 4


# Refusals.


def test_apply_points_to_array_fuse(board, record, blob, tmp_path, capsys):
    record.save(tmp_path / "rec.json")
    il.write(board, tmp_path / "b.csv")
    for name, words in (("rec.json", "with --imus that of whole IMUs"), (str(blob), "array fuse --imus takes it")):
        assert main(["apply", str(tmp_path / name), str(tmp_path / "b.csv"), "-o", str(tmp_path / "o.csv")]) == 2
        said = capsys.readouterr().err
        assert words in said
        assert said.count("\n") == 1
    il.write(il.simulate_array(duration=5.0), tmp_path / "g.csv")
    assert main(["array", "fuse", str(tmp_path / "g.csv"), "--calibration", str(blob)]) == 2
    assert "holds no array" in capsys.readouterr().err


@pytest.mark.parametrize("target", [name for name in EXPORTERS if name not in ("c", "blob")])
def test_other_programs_cannot_take_a_board(target, record, tmp_path):
    with pytest.raises(OptionError, match="fuses no array of gyroscopes or of whole IMUs; use --to c or --to blob"):
        il.export(target, record, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--at", "imu:9"], "--at imu:9: expected an IMU from 1 to 4"),
        (["--at", "here"], "--at 'here': expected centroid, imu:N, or x,y,z"),
        (["--gyro-range", "0 deg/s"], "--gyro-range: expected more than 0"),
        (["--gyro-range", "3 m"], "--gyro-range"),
        (["--method", "mean"], "--method: for gyros on one axis; whole IMUs take"),
        (["--memory", "0.1"], "--memory: for gyros on one axis; whole IMUs take"),
    ],
)
def test_wrong_options_of_the_export_are_refused(options, message, record, tmp_path, capsys):
    record.save(tmp_path / "rec.json")
    assert main(["export", "--to", "c", str(tmp_path / "rec.json"), "-o", str(tmp_path / "out"), *options]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_options_of_a_board_are_refused_for_other_records(tmp_path):
    array = il.calibrate_array(il.simulate_array(experiment="static", duration=30.0)).calibration
    with pytest.raises(OptionError, match="gyro_range: for whole IMUs; expected the record of"):
        il.export("c", array, tmp_path / "out", gyro_range="2000 deg/s")
    fit = il.fit_tumble(il.simulate_tumble(gravity=9.81), order=1, gravity=9.81)
    with pytest.raises(OptionError, match="at and accel_range: how a gyro array or whole IMUs are fused; expected"):
        il.export("c", fit, tmp_path / "out", at="centroid", accel_range="16 g")


@pytest.mark.parametrize("first", ["array", "board"])
def test_each_record_is_fused_by_the_options_that_its_kind_takes(first, record, tmp_path):
    still = il.simulate_array(experiment="static", duration=30.0)
    array = il.calibrate_array(still, method="mean", memory=0.01).calibration
    records = [replace(array, sensor=record.sensor), record]
    records = records if first == "array" else records[::-1]

    def exported(**options):
        (blob,) = il.export("blob", records, tmp_path, **options)
        sections = {section["kind"]: section for section in load_blob(blob).text["sections"]}
        return [sections["array"][name] for name in ("method", "memory")], sections["imus"]

    fused, board = exported(gyro_range="2000 deg/s")
    assert fused == ["mean", 0.01]  # as its record states, not by default
    assert board["gyro_range"] == pytest.approx([np.radians(2000.0)] * 4)
    fused, board = exported(memory=0.02, at="imu:1")
    assert (fused, board["at"]) == (["mean", 0.02], [0.0, 0.0, 0.0])
    fused, board = exported(method="robust")
    assert (fused, board["gyro_range"]) == (["robust", 0.01], [None] * 4)


def test_a_board_beside_other_records_and_with_too_many_imus(record, tmp_path):
    array = il.calibrate_array(il.simulate_array(experiment="static", duration=30.0)).calibration
    il.export("c", [replace(array, sensor=record.sensor), record], tmp_path / "both")
    assert "#define UNIT_HAS 272u" in (tmp_path / "both" / "unit.h").read_text(encoding="utf-8")
    many = true_record(il.simulate_imus(elements=33, attitudes=1, duration="1 s"))
    with pytest.raises(OptionError, match="33 IMUs: expected 2 to 32"):
        il.export("c", many, tmp_path / "many")
    assert not (tmp_path / "many").exists()
    assert tables_of(record, Fusion(at="imu:1"))[0].columns["at"] == [0.0, 0.0, 0.0]


def test_ranges_that_the_record_holds_reach_fusion_and_unit(tmp_path):
    """Stated, or as the recording reaches them; nobody has to state them again."""
    board = il.simulate_imus(elements=4, attitudes=6, duration="20 s", rate="50 Hz", age="0 s")
    fit = il.calibrate_imus(board, gravity=9.80665, gyro_range=f"{RANGE} deg/s", accel_range="16 g").calibration
    held = fit.sections["imus"][0]
    assert held["gyro_range"] == {"value": pytest.approx(np.radians(RANGE)), "unit": "rad/s"}
    assert held["accel_range"] == {"value": pytest.approx(16 * 9.80665), "unit": "m/s^2"}
    assert fit.options["gyro_range"] == f"{RANGE} deg/s"
    (table,) = (item for item in exhibits(fit).items if item.title == "Ends of the ranges")
    assert ["2", "156.91", "300.00"] in table.rows
    clipped = clipped_board(board, RANGE)
    alone, told = (il.fuse_imus(board, calibration=fit, **by) for by in ({}, {"gyro_range": f"{RANGE} deg/s"}))
    assert alone.bridged.any()  # the board itself goes beyond without reaching an end
    assert np.array_equal(alone.bridged, told.bridged)
    assert not il.fuse_imus(board, calibration=true_record(board)).bridged.any()
    (blob,) = il.export("blob", fit, tmp_path)
    (section,) = load_blob(blob).text["sections"]
    assert section["gyro_range"] == pytest.approx([np.radians(RANGE)] * 4)
    reached = il.calibrate_imus(clipped, gravity=9.80665).calibration
    ends = [imu["gyro_range"]["value"] for imu in reached.sections["imus"]]
    assert ends == pytest.approx([np.radians(RANGE)] * len(ends))
    assert reached.sections["imus"][0]["accel_range"] is None
    assert 0 < reached.fit["bridged"] < 1

"""What was validated on the desk is what runs in the unit: Python against the exported C, as compiled there."""

import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import yaml

import imulab as il
import madeup
from conftest import REPOSITORY, STRICT
from imulab.cli import main
from imulab.device import METHODS
from imulab.device.tables import Fusion, pack
from imulab.device.unit import ArraySettings, DeviceUnit, Stream, array_table
from imulab.exporters import export
from imulab.exporters.firmware_c import _header
from imulab.procedures.apply import tables_of
from imulab.procedures.gyro_array.fit import calibrate_array
from imulab.procedures.warmup import MODELS
from reference import magnetometer

G = madeup.G


DRIVER = REPOSITORY / "tests" / "firmware" / "driver.c"


@pytest.fixture(scope="session")
def many(reduced):
    """How many rows go through both: a wrong order of operations differs in a good part of them already."""
    return 100_000 if reduced else 1_000_000


@pytest.fixture(scope="session")
def records():
    return [madeup.tumble(5, gyro=True, sensitive=True), madeup.centrifuge(), madeup.warmup()]


@pytest.fixture(scope="session")
def exported(made_once, records):
    return made_once("firmware", lambda folder: export("c", records, folder))


@pytest.fixture(scope="session")
def built(compiler, exported, made_once):
    """The exported C with a small program around it, as double and as float."""

    def fill(folder):
        for name, define in (("double", []), ("float", ["-DIMULAB_REAL=float"])):
            # More elements than firmware has by default: every array that Python fuses can be fused here as well.
            options = ["-O2", *STRICT, *define, "-DIL_ARRAY_ELEMENTS=64", f"-I{exported}"]
            sources = [DRIVER, exported / "imulab.c", exported / "unit.c"]
            subprocess.run([compiler, *options, *sources, "-o", folder / name, "-lm"], check=True)

    folder = made_once("drivers", fill)
    return {name: folder / name for name in ("double", "float")}


@pytest.fixture(scope="session")
def array_recordings():
    """An array at rest and moving."""
    array = {"elements": 4, "axes": 3, "unit": "deg/s"}
    still = il.simulate_array(experiment="static", duration=30.0, **array)
    return still, il.simulate_array(experiment="moving", duration=40.0, **array)


@pytest.fixture
def c_core(built, tmp_path):
    """Run rows of numbers through a function of the compiled core; tables None takes the numbers in unit.c."""

    def run(real, tables, function, rows, *arguments):
        source = "unit"
        if tables is not None:
            source = str(tmp_path / "unit.blob")
            (tmp_path / "unit.blob").write_bytes(pack(tables, 8 if real == "double" else 4))
        command = [built[real], source, *function.split(), *map(repr, arguments)]
        done = subprocess.run(command, input=np.ascontiguousarray(rows).tobytes(), capture_output=True, check=True)
        return np.frombuffer(done.stdout).reshape(len(rows), -1)

    return run


def bits(values):
    """The bits of numbers; all that are not numbers are one."""
    return np.where(np.isnan(values), np.nan, values).view(np.uint64)


def assert_same(found, expected):
    assert found.shape == expected.shape
    assert np.array_equal(bits(found), bits(expected))


def assert_near(found, expected, limit):
    there = np.isfinite(expected)
    assert np.array_equal(np.isfinite(found), there)
    assert np.abs(found[there] - expected[there]).max() <= limit


def outputs_of(table, reach, rng, many, *, odd=True):
    """Random outputs within `reach` of what a triad measures, one in 1,000 of them no number."""
    fields = {field.name: field.values for field in table.fields}
    rows = (rng.uniform(-reach, reach, (many, 3)) + fields["bias"]) / fields["gain"]
    if odd:
        rows[rng.integers(0, many, many // 1000), rng.integers(0, 3, many // 1000)] = np.nan
        rows[rng.integers(0, many, many // 1000), rng.integers(0, 3, many // 1000)] = -np.inf
    return rows


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_tumble_to_the_last_bit(order, c_core, many):
    rng = np.random.default_rng(order)
    tables = tables_of(madeup.tumble(order))
    rows = outputs_of(tables[0], 16 * G, rng, many)  # at orders above 1 some lie beyond a turning point
    force, flags = DeviceUnit.of(*tables).tumble(list(rows.T))
    assert flags & 1
    assert_same(c_core("double", tables, "tumble", rows), np.column_stack(force))
    rows = outputs_of(tables[0], 2 * G, rng, many)
    force, _ = DeviceUnit.of(*tables).tumble(list(rows.T))
    assert_near(c_core("float", tables, "tumble", rows), np.column_stack(force), 2e-6 * 2 * G)


@pytest.mark.parametrize(("sensitive", "powers"), [(False, 1), (True, 1), (False, 3), (True, 5)])
def test_gyro_to_the_last_bit(sensitive, powers, c_core, many):
    rng = np.random.default_rng(3)
    table = tables_of(madeup.tumble(1, gyro=True, sensitive=sensitive, powers=powers))[1]
    rows = outputs_of(table, 5.0, rng, many)  # rad/s, about 300 deg/s
    force = rng.uniform(-2 * G, 2 * G, (many, 3))
    force[7, 1] = np.nan
    rate, _ = DeviceUnit.of(table).gyro(list(rows.T), list(force.T) if sensitive else None)
    name, wide = ("gyro-force", np.hstack([rows, force])) if sensitive else ("gyro", rows)
    assert_same(c_core("double", [table], name, wide), np.column_stack(rate))
    assert_near(c_core("float", [table], name, wide)[8:], np.column_stack(rate)[8:], 2e-6 * 5)


@pytest.mark.parametrize(("turn", "unit"), [("wave", "uT"), ("wave", "count"), ("level", "uT")])
def test_magnetometers_alone_to_the_last_bit(turn, unit, c_core, many):
    rng = np.random.default_rng(6)
    made = il.simulate_magnetometer(turn=turn)
    if unit == "count":
        made = replace(made, units=made.units | dict.fromkeys(("mag_x", "mag_y", "mag_z"), unit))
    (table,) = tables_of(il.fit_magnetometer(made).calibration)
    rows = outputs_of(table, 1e-4 if table.columns["field_unit"] == "T" else 2.0, rng, many)
    field, _ = DeviceUnit.of(table).mag(list(rows.T))
    assert_same(c_core("double", [table], "mag", rows), np.column_stack(field))
    assert_near(c_core("float", [table], "mag", rows), np.column_stack(field), 2e-6 * np.nanmax(np.abs(field)))


def test_centrifuge_to_the_last_bit(c_core, records, many):
    rng = np.random.default_rng(4)
    tables = tables_of(records[1])
    rows = np.hstack([rng.uniform(-100, 100, (many, 2)), rng.uniform(-1e-2, 1e-2, (many, 2))])
    rows[5] = [np.nan, 1.0, 0.0, 0.0]
    rows[6, 3] = np.inf
    rate, _ = DeviceUnit.of(*tables).centrifuge(list(rows.T[:2]), list(rows.T[2:]))
    assert_same(c_core("double", tables, "centrifuge", rows), np.column_stack(rate))
    assert_near(c_core("float", tables, "centrifuge", rows), np.column_stack(rate), 2e-6 * 1e-2)


@pytest.mark.parametrize("rule", ["zero", "hold", "taper"])
@pytest.mark.parametrize("model", MODELS)
def test_warmup_to_the_last_bit(model, rule, c_core, many):
    rng = np.random.default_rng(5)
    tables = tables_of(madeup.warmup(model, rule))
    ticks = rng.integers(0, int(1.3 * madeup.SETTLED / madeup.TICK), many // 4).astype(np.uint32)
    for temperature in (-40.0, -30.0, 21.5, 60.0):
        raw = rng.uniform(-1, 1, (2, len(ticks))) * 1e-3
        left, covered = DeviceUnit.of(*tables).warmup(temperature, madeup.TICK, ticks, list(raw))
        assert covered
        rows = ticks.astype(np.float64)[:, None]
        bias = c_core("double", tables, "warmup", rows, temperature, madeup.TICK)
        assert_same(raw.T - bias, np.column_stack(left))
        if temperature == 21.5:  # 0.01 deg/h
            found = c_core("float", tables, "warmup", rows, temperature, madeup.TICK)
            assert_near(found, bias, 0.01 * np.pi / 180 / 3600)


def readings(rng, elements, many, *, odd):
    """A turn of up to 3 rad/s seen by unequal gyros, and what a robust method has to bear."""
    turn = 3 * np.sin(np.arange(many) * 2e-3)[:, None]
    z = turn + 2e-3 * rng.uniform(0.5, 1.5, elements) * rng.standard_normal((many, elements))
    z += 0.01 * rng.standard_normal(elements)
    if odd:
        tenth, faults = many // 10, many // 500
        z[rng.integers(0, many, faults), rng.integers(0, elements, faults)] = np.nan
        z[rng.integers(0, many, faults), rng.integers(0, elements, faults)] += 5.0
        z[2 * tenth : 2 * tenth + 1000, 1] = z[2 * tenth, 1]
        z[4 * tenth :, 2] += 0.05
        z[6 * tenth : 6 * tenth + 100, 1:] = np.nan
        z[7 * tenth : 7 * tenth + 10] = np.inf
    return z


def settings_of(method, elements):
    rng = np.random.default_rng(6)
    more = {}
    if method == "covariance":
        more["weights"] = rng.uniform(0.5, 2, elements)
    if method == "kalman":
        gain = np.vstack([np.full(elements, 0.3 / elements), 1e-3 * (np.eye(elements) - 1 / elements)])
        more["gain"] = gain * rng.uniform(0.9, 1.1, gain.shape)
    return ArraySettings(method, elements, rate=50.0, **more)


@pytest.mark.parametrize("method", METHODS)
def test_array_to_the_last_bit(method, c_core, many):
    """Blocks in Python, single steps in C."""
    settings = settings_of(method, 6)
    z = readings(np.random.default_rng(7), 6, many, odd=True)
    rate = Stream(settings).process(z, flags=False).rate
    assert_same(c_core("double", [array_table(settings)], "array", z), rate)
    if method in (
        "feedback",
        "least-squares",
    ):  # without a defence: a spike goes through with weights of float accuracy
        z = readings(np.random.default_rng(7), 6, many, odd=False)
        rate = Stream(settings).process(z, flags=False).rate
        assert_same(c_core("double", [array_table(settings)], "array", z), rate)
    assert_near(c_core("float", [array_table(settings)], "array", z), rate, 2e-6 * 5)  # full scale 5 rad/s


def test_the_numbers_in_unit_c_are_those_of_the_records(c_core, records):
    rng = np.random.default_rng(8)
    accel, gyro = tables_of(records[0])
    for table, name in ((accel, "tumble"), (gyro, "gyro-force")):
        rows = outputs_of(table, 2.0, rng, 1000, odd=False)
        rows = np.hstack([rows, rng.uniform(-G, G, (1000, 3))]) if name == "gyro-force" else rows
        assert_same(c_core("double", None, name, rows), c_core("double", [table], name, rows))
    rows = rng.uniform(-100, 100, (1000, 4))
    expected = c_core("double", tables_of(records[1]), "centrifuge", rows)
    assert_same(c_core("double", None, "centrifuge", rows), expected)
    ticks = np.arange(0.0, 1e5, 77.0)[:, None]
    expected = c_core("double", tables_of(records[2]), "warmup", ticks, 33.3, 0.005)
    assert_same(c_core("double", None, "warmup", ticks, 33.3, 0.005), expected)


def make_test(folder, *options):
    done = subprocess.run(["make", "-C", str(folder), "test", *options], capture_output=True, text=True, check=False)
    lines = [line for line in done.stdout.splitlines() if line.startswith("imulab self-test")]
    return done.returncode, lines[0] if len(lines) == 1 else done.stdout + done.stderr


def worst(line):
    return float(line.split("worst ")[1].split()[0])


@pytest.mark.parametrize(
    ("name", "real"),
    [
        ("gcc", "double"),
        ("clang", "float"),
        pytest.param("gcc", "float", marks=pytest.mark.slow),
        pytest.param("clang", "double", marks=pytest.mark.slow),
    ],
)
def test_the_exported_self_test_passes(name, real, exported, tmp_path):
    if shutil.which(name) is None:
        pytest.skip(f"no {name} on this machine")
    folder = shutil.copytree(exported, tmp_path / "unit")
    # By both compilers as the Makefile says, and of the other number each without optimisation.
    options = [] if (name, real) in (("gcc", "double"), ("clang", "float")) else ["CFLAGS=-O0"]
    code, line = make_test(folder, f"CC={name}" + (" -DIMULAB_REAL=float" if real == "float" else ""), *options)
    assert code == 0, line
    assert "pass" in line
    assert real in line
    assert worst(line) <= (0 if real == "double" else 2e-6)


def test_the_self_test_notices_a_wrong_number(exported, tmp_path, self_test):
    folder = tmp_path / "altered"
    shutil.copytree(exported, folder)
    text = (folder / "unit.c").read_text()
    gain = text.split(".gain = {R(")[1].split(")")[0]
    (folder / "unit.c").write_text(text.replace(gain, repr(float(gain) * (1 + 1e-5)), 1))
    done = self_test(folder)
    line = done.stdout
    assert done.returncode != 0
    assert "FAIL" in line
    assert worst(line) > 1e-6


def test_the_readme_speaks_of_flags_only_where_there_are_some(exported, tmp_path):
    export("c", [madeup.warmup()], tmp_path)
    alone, all_of_them = ((folder / "README.md").read_text(encoding="utf-8") for folder in (tmp_path, exported))
    assert "returns flags" not in alone
    assert "Each call but that for the warm-up returns flags" in all_of_them
    assert all("stop at `UINT32_MAX`" in text for text in (alone, all_of_them))


@pytest.mark.parametrize("define", [[], ["-DIMULAB_REAL=float"]])
def test_the_code_in_the_readme_compiles_and_runs(define, exported, tmp_path, compiler, core):
    blocks = (exported / "README.md").read_text(encoding="utf-8").split("```")[1::2]
    assert [block.startswith("c\n") for block in blocks] == [True, True]
    # What the README shows is made static here: a real project has a header for it.
    code = "\n".join(block[2:] for block in blocks)
    declared = [line.removesuffix(" {") + ";" for line in code.splitlines() if line.endswith(") {") and line[0] != " "]
    steps = """
int main(void) {
    il_real accel[3] = {100, 200, 4000}, gyro[3] = {1, 2, 3};
    if (!compensation_start((il_real)25, (il_real)0.005)) return 1;
    if (correct_accelerometers(accel) != 0) return 2;
    if (correct_gyroscopes(gyro, accel) != 0) return 3;
    if (remove_drift(accel, gyro) != 0) return 4;
    remove_warmup(1000, gyro);
    if (numbers_from_flash((const uint8_t *)"no table, for certain", 21)) return 5;
    return gyro[0] == gyro[0] && accel[2] > 5 ? 0 : 6;
}
"""
    source = tmp_path / "project.c"
    source.write_text("\n".join(['#include "unit.h"', *declared, code, steps]), encoding="utf-8")
    files = [source, core / ("float.o" if define else "double.o"), exported / "unit.c"]
    command = [compiler, *STRICT, *define, f"-I{exported}", *files, "-o", tmp_path / "project", "-lm"]
    subprocess.run(command, check=True)
    assert subprocess.run([tmp_path / "project"], check=False).returncode == 0


def test_the_readme_of_an_array_leads_to_what_fuse_gives(compiler, core, tmp_path):
    """In the unit and at the rate that it names; readings in rad/s, so that no conversion rounds."""
    record = il.calibrate_array(il.simulate_array(experiment="static", duration=60.0, unit="rad/s")).calibration
    flight = il.simulate_array(session=1, rate=100.0, duration=20.0, unit="rad/s")
    export("c", [record], tmp_path)
    code = (tmp_path / "README.md").read_text(encoding="utf-8").split("```")[1].removeprefix("c\n")
    assert "all gyros, in rad/s, to one rate per axis, in rad/s; 100 times a second" in code
    steps = """
int main(void) {
    double z[6];
    if (!compensation_start()) return 1;
    while (scanf("%lf %lf %lf %lf %lf %lf", z, z + 1, z + 2, z + 3, z + 4, z + 5) == 6) {
        const il_real reading[1][6] = {{z[0], z[1], z[2], z[3], z[4], z[5]}};
        il_real rate[1];
        fuse(reading, rate);
        printf("%.17g\\n", rate[0]);
    }
    return 0;
}
"""
    (tmp_path / "project.c").write_text(f"#include <stdio.h>\n{code}{steps}", encoding="utf-8")
    files = [tmp_path / "project.c", core / "double.o", tmp_path / "unit.c"]
    command = [compiler, "-std=c99", "-ffp-contract=off", f"-I{tmp_path}", *files, "-o", tmp_path / "project", "-lm"]
    subprocess.run(command, check=True)
    rows = np.column_stack([flight.column(f"gyro_{n}") for n in range(1, 7)])
    text = "\n".join(" ".join(map(repr, row)) for row in rows.tolist())
    done = subprocess.run([tmp_path / "project"], input=text, capture_output=True, text=True, check=True)
    expected = il.fuse(flight, il.FuseOptions(calibration=record)).rate[:, 0]
    assert np.array_equal(np.array(done.stdout.split(), dtype=float), expected)


@pytest.mark.parametrize(
    "fusion",
    [
        Fusion("feedback"),
        Fusion("feedback", 0.01),
        Fusion("feedback", None, 100),
        *map(Fusion, ("mean", "covariance", "support", "least-squares")),
        Fusion("robust", 0.02),
    ],
    ids=str,
)
def test_the_self_test_passes_with_the_method_that_was_chosen(self_test, array_recordings, tmp_path, fusion):
    record = calibrate_array(*array_recordings, fusion=fusion).calibration
    export("c", [record], tmp_path)
    assert f".method = {METHODS.index(fusion.method)}," in (tmp_path / "unit.c").read_text(encoding="utf-8")
    for real in ("double", "float"):
        done = self_test(tmp_path, real)
        assert done.returncode == 0, done.stdout
        assert "pass" in done.stdout


def test_export_takes_the_method_of_the_record_or_another(tmp_path, capsys):
    for experiment, name in (("static", "still.csv"), ("dynamic", "run.csv")):
        il.write_csv(il.simulate_array(experiment=experiment, duration=30.0), tmp_path / name)
    record, out = str(tmp_path / "r.json"), str(tmp_path / "unit")

    def method(*more):
        assert main(["export", "--to", "c", record, "-o", out, *more]) == 0
        text = (tmp_path / "unit" / "unit.c").read_text(encoding="utf-8")
        found = re.search(r"\.method = (\d),", text), re.search(r"\.start = (\d+),", text)
        return METHODS[int(found[0][1])], int(found[1][1]), re.search(r"\.memory = R\((.*)\)", text)[1]

    still = str(tmp_path / "still.csv")
    assert main(["array", "calibrate", still, "-o", record]) == 0
    assert method() == ("robust", 1, "0.0")
    assert method("--method", "feedback") == ("feedback", 1, "0.0")
    assert main(["array", "calibrate", still, "--method", "feedback", "--memory", "growing:50", "-o", record]) == 0
    assert method() == ("feedback", 50, "0.0")
    assert method("--memory", "0.02") == ("feedback", 1, "0.02")
    assert method("--method", "mean") == ("mean", 50, "0.0")
    capsys.readouterr()
    run, fused = str(tmp_path / "run.csv"), str(tmp_path / "f.csv")
    assert main(["array", "fuse", run, "--calibration", record, "-o", fused]) == 0
    assert capsys.readouterr().out.startswith("good: ")
    options = il.FuseOptions(method="feedback", start=50, calibration=il.load(record))
    expected = il.fuse(il.read(run), options).rate[:, 0]
    np.testing.assert_allclose(il.read(fused).column("rate"), expected, rtol=1e-12)
    for wrong, words in (
        (["--method", "median"], "--method 'median': expected one of mean"),
        (["--memory", "2"], "--memory '2': expected growing"),
        (["--method", "kalman"], "method kalman has no table for a unit"),
    ):
        assert main(["export", "--to", "c", record, "-o", str(tmp_path / "no"), *wrong]) == 2
        assert words in capsys.readouterr().err
        assert not (tmp_path / "no").exists()


def test_a_large_array_has_room_in_the_header():
    small, large = (array_table(ArraySettings("mean", n)) for n in (6, 48))
    assert "#define IL_ARRAY_ELEMENTS 32\n" in _header([small])
    assert "#define IL_ARRAY_ELEMENTS 48\n" in _header([large])


def test_the_header_compiles_as_c_plus_plus(exported, tmp_path, compiler, core):
    compile_with = shutil.which("c++")
    if compile_with is None:
        pytest.skip("no C++ compiler on this machine")
    source = tmp_path / "main.cpp"
    source.write_text(
        '#include "unit.h"\nint main() {\n  il_real in[3] = {0, 0, 0}, out[3];\n'
        "  return il_tumble_apply(&unit_tumble, in, out) == 0 ? 0 : 1;\n}\n"
    )
    objects = [core / "double.o", tmp_path / "unit.o"]
    subprocess.run([compiler, "-c", exported / "unit.c", "-o", objects[-1]], check=True)
    strict = ["-Wall", "-Wextra", "-Wpedantic", "-Werror", f"-I{exported}"]
    subprocess.run([compile_with, *strict, source, *objects, "-o", tmp_path / "main", "-lm"], check=True)
    subprocess.run([tmp_path / "main"], check=True)


def test_nothing_but_the_self_test_has_a_main_and_the_core_is_the_same_for_every_unit(exported, tmp_path):
    export("c", [madeup.tumble(1)], tmp_path)
    assert (tmp_path / "imulab.c").read_bytes() == (exported / "imulab.c").read_bytes()
    assert (tmp_path / "imulab.h").read_bytes() == (exported / "imulab.h").read_bytes()
    core, own = {"imulab.c", "imulab.h"}, {"unit.c", "unit.h", "unit.blob"}
    others = {"Makefile", "README.md", "golden.h", "selftest.c"}
    libraries = {"library.properties", "library.json", "src", "zephyr", "examples"}
    assert {path.name for path in tmp_path.iterdir()} == core | own | others | libraries
    assert [path.name for path in tmp_path.glob("*.c") if " main(" in path.read_text()] == ["selftest.c"]
    every = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert [path.name for path in every if '"golden.h"' in path.read_text("latin-1")] == ["selftest.c"]
    assert [path.name for path in every if " main(" in path.read_text("latin-1")] == ["selftest.c"]


def test_double_never_occurs_in_the_float_build(exported, tmp_path):
    compile_with = shutil.which("arm-none-eabi-gcc")
    if compile_with is None:
        pytest.skip("no arm-none-eabi-gcc on this machine")
    target = ["-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-Os", "-DIMULAB_REAL=float"]
    for name in ("imulab", "unit"):
        command = [compile_with, *target, *STRICT, "-c", exported / f"{name}.c", "-o", tmp_path / f"{name}.o"]
        subprocess.run(command, check=True)
    symbols = subprocess.run(
        ["arm-none-eabi-nm", "-u", tmp_path / "imulab.o"], capture_output=True, text=True, check=True
    ).stdout.split()
    assert {"expf", "log1pf"} <= set(symbols)
    counts = {"__aeabi_ul2f"}  # whole numbers of 64 bits to float
    assert not {n for n in symbols if n.startswith("__aeabi_") or n in ("exp", "log1p", "sqrt")} - counts


WARN = ["-Wall", "-Wextra", "-Werror"]


SINGLE = 2e-6  # of full scale


def run(*command, **options):
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False, timeout=120, **options)
    assert done.returncode == 0, done.stderr or done.stdout
    return done.stdout


def arduino(folder, rows):
    """What the example prints for rows of outputs; only src and the example are compiled, as Arduino does it."""
    build, sketch = folder / "build", folder / "examples" / "Corrected" / "Corrected.ino"
    build.mkdir()
    flags = ["-DARDUINO=10819", f"-I{folder / 'src'}", *WARN]  # optimised elsewhere
    sources = sorted((folder / "src").glob("*.c"))
    assert len(sources) == 2
    for source in sources:
        run("gcc", "-std=gnu11", *flags, "-c", source, "-o", build / f"{source.stem}.o")
    stub = REPOSITORY / "tests" / "firmware"
    frame = build / "frame.cpp"
    frame.write_text(
        f'#include <Arduino.h>\n#include "{sketch}"\n'
        "int main() {\n  setup();\n  while (Serial.available()) loop();\n  return 0;\n}\n"
    )
    objects = [build / f"{source.stem}.o" for source in sources]
    run("g++", "-std=gnu++11", *flags, f"-I{stub}", frame, *objects, "-o", build / "sketch", "-lm")
    text = "\n".join(" ".join(f"{value:.9g}" for value in row) for row in rows)
    return np.array([line.split() for line in run(build / "sketch", input=text).splitlines()], dtype=float)


@pytest.mark.slow
def test_the_arduino_example_corrects_as_the_desk_does(tools, tmp_path):
    records = [madeup.tumble(2, gyro=True, sensitive=True), madeup.centrifuge(), madeup.warmup()]
    export("c", records, tmp_path)
    rng = np.random.default_rng(1)
    tables = [table for record in records for table in tables_of(record)]
    unit = DeviceUnit.of(*tables)
    fields = {table.kind: {field.name: field.values for field in table.fields} for table in tables}

    def outputs(kind, reach):
        return (rng.uniform(-reach, reach, (100, 3)) + fields[kind]["bias"]) / fields[kind]["gain"]

    accel, gyro = outputs("tumble", 2 * G), outputs("gyro", 5.0)
    level, drifting = rng.uniform(-50, 50, (100, 2)), rng.uniform(-1e-2, 1e-2, (100, 2))
    warm = rng.uniform(-1e-3, 1e-3, (100, 2))
    found = arduino(tmp_path, np.hstack([accel, gyro, level, drifting, warm]))
    force, _ = unit.tumble(list(accel.T))
    rate, _ = unit.gyro(list(gyro.T), list(force))
    left, _ = unit.centrifuge(list(level.T), list(drifting.T))
    compensated, _ = unit.warmup(25.0, 0.01, np.arange(100, dtype=np.uint32), list(warm.T))
    for part, expected, scale in (
        (slice(0, 3), force, 2 * G),
        (slice(3, 6), rate, 5.0),
        (slice(6, 8), left, 1e-2),
        (slice(8, 10), compensated, 1e-2),
    ):
        assert np.abs(found[:, part] - np.column_stack(expected)).max() < SINGLE * scale


@pytest.mark.slow
def test_the_arduino_example_of_nine_axes_and_of_an_array(tools, tmp_path):
    rng = np.random.default_rng(5)
    truth = magnetometer.random_unit(rng, np.radians(67.0), magnetometer.random_rotation(rng))
    turned = np.array([magnetometer.random_rotation(rng) for _ in range(24)])
    outputs, mag = magnetometer.simulate(truth, turned, rng, accel=5e-4, field=3e-3, dip=np.radians(0.17))
    recording = il.Recording.from_arrays(accel=outputs, mag=mag, units={"accel": "g", "mag": "count"})
    nine = il.fit_mag(recording, gravity=G, order=1).calibration
    export("c", [nine], tmp_path / "nine")
    corrected = il.apply(nine, recording)
    found = arduino(tmp_path / "nine", np.hstack([outputs, mag]))
    assert np.abs(found[:, :3] - corrected.triad("accel")).max() < 5 * SINGLE * G
    assert np.abs(found[:, 3:] - corrected.triad("mag")).max() < 5 * SINGLE * np.abs(mag).max()
    array = il.calibrate_array(il.simulate_array(experiment="static", duration=20.0, unit="rad/s")).calibration
    flight = il.simulate_array(session=1, rate=100.0, duration=2.0, unit="rad/s")
    export("c", [array], tmp_path / "array")
    readings = np.column_stack([flight.column(f"gyro_{n}") for n in range(1, 7)])
    rate = arduino(tmp_path / "array", readings)[:, 0]
    expected = il.fuse(flight, il.FuseOptions(calibration=array)).rate[:, 0]
    assert np.abs(rate - expected).max() < 5 * SINGLE * np.abs(readings).max()


@pytest.fixture(scope="module")
def exported_library(tmp_path_factory):
    folder = tmp_path_factory.mktemp("library")
    export("c", [madeup.tumble(3, gyro=True)], folder)
    return folder


APPLICATION = """
#include <imulab_unit.h>
#include <stdio.h>
int main(void) {
    il_real accel[3] = {100, 200, 4000};
    const unsigned flags = il_tumble_apply(&unit_tumble, accel, accel);
    printf("%u %u\\n", flags, (unsigned)sizeof(il_real));
    return 0;
}
"""


def test_arduino_finds_a_library_by_its_manifest(exported_library):
    lines = (exported_library / "library.properties").read_text().splitlines()
    properties = dict(line.split("=", 1) for line in lines)
    needed = {"name", "version", "author", "maintainer", "sentence", "paragraph", "category", "architectures"}
    assert needed <= set(properties)
    assert (exported_library / "src" / properties["includes"]).is_file()
    assert properties["category"] == "Sensors"


def test_platformio_builds_what_its_manifest_says(tools, exported_library, tmp_path):
    manifest = json.loads((exported_library / "library.json").read_text())
    build = manifest["build"]
    (tmp_path / "app.c").write_text(APPLICATION)
    sources = sorted((exported_library / build["srcDir"]).rglob("*.c"))
    for source in sources:
        run("gcc", *WARN, *build["flags"], "-c", source, "-o", tmp_path / f"{source.stem}.o")
    objects = [tmp_path / f"{source.stem}.o" for source in sources]
    include = f"-I{exported_library / build['includeDir']}"  # the library's flags are not those of the application
    run("gcc", *WARN, include, tmp_path / "app.c", *objects, "-o", tmp_path / "app", "-lm")
    assert run(tmp_path / "app") == "0 4\n"
    assert (exported_library / build["includeDir"] / manifest["headers"]).is_file()


ZEPHYR = """
cmake_minimum_required(VERSION 3.20)
project(app C)
set(CONFIG_IMULAB_UNIT {chosen})
add_library(zephyr_interface INTERFACE)
function(zephyr_include_directories)
  foreach(folder ${{ARGV}})
    get_filename_component(path ${{folder}} ABSOLUTE BASE_DIR ${{CMAKE_CURRENT_SOURCE_DIR}})
    target_include_directories(zephyr_interface INTERFACE ${{path}})
  endforeach()
endfunction()
macro(zephyr_library_named name)
  set(ZEPHYR_CURRENT_LIBRARY ${{name}})
  add_library(${{name}} STATIC "")
  target_link_libraries(${{name}} PUBLIC zephyr_interface)
endmacro()
function(zephyr_library_sources)
  target_sources(${{ZEPHYR_CURRENT_LIBRARY}} PRIVATE ${{ARGV}})
endfunction()
function(zephyr_library_compile_definitions)
  target_compile_definitions(${{ZEPHYR_CURRENT_LIBRARY}} PRIVATE ${{ARGV}})
endfunction()
add_subdirectory({module} module)
if(CONFIG_IMULAB_UNIT)
  add_executable(app app.c)
  target_link_libraries(app imulab_unit zephyr_interface m)
endif()
"""


@pytest.mark.parametrize("chosen", ["y", "n"])
def test_zephyr_builds_the_module_where_it_is_chosen(tools, exported_library, tmp_path, chosen):
    """With the few functions of Zephyr's build that the module calls, transcribed from its extensions.cmake."""
    if shutil.which("cmake") is None:
        pytest.skip("no cmake on this machine")
    module = yaml.safe_load((exported_library / "zephyr" / "module.yml").read_text())
    assert set(module) == {"name", "build"}
    assert (exported_library / module["build"]["kconfig"]).read_text().startswith("config IMULAB_UNIT\n")
    (tmp_path / "app.c").write_text(APPLICATION)
    text = ZEPHYR.format(chosen=chosen, module=exported_library / module["build"]["cmake"])
    (tmp_path / "CMakeLists.txt").write_text(text)
    run("cmake", "-S", tmp_path, "-B", tmp_path / "build")
    run("cmake", "--build", tmp_path / "build")
    if chosen == "y":
        assert run(tmp_path / "build" / "app") == "0 4\n"
    assert (tmp_path / "build" / "app").exists() == (chosen == "y")


def test_a_project_that_takes_every_source_links(tools, exported_library, tmp_path):
    """What the libraries compile is nothing where the sources themselves are compiled."""
    sources = sorted(exported_library.rglob("*.c"))
    assert len(sources) == 5
    strict = ["-std=c99", "-pedantic", *WARN, "-ffp-contract=off"]
    run("gcc", *strict, *sources, "-o", tmp_path / "selftest", "-lm")
    assert "pass" in run(tmp_path / "selftest")


def test_the_name_of_a_unit_cannot_break_the_manifests(tmp_path):
    record = madeup.tumble(1)
    odd = 'SN "7"\n=x\\ }'
    export("c", [replace(record, sensor={"serial": odd})], tmp_path)
    lines = (tmp_path / "library.properties").read_text().splitlines()
    assert all("=" in line for line in lines)
    assert 'SN "7"' in json.loads((tmp_path / "library.json").read_text())["description"]
    sketch = (tmp_path / "examples" / "Corrected" / "Corrected.ino").read_text().splitlines()
    assert [line.startswith("//") for line in sketch[:4]] == [True, True, True, False]

"""The exported folder as a library of Arduino, PlatformIO and Zephyr, compiled as their builds do it."""

import json
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import yaml

import imulab as il
import madeup
from conftest import REPOSITORY
from imulab.device.unit import DeviceUnit
from imulab.exporters import export
from imulab.procedures.apply import tables_of
from reference import magnetometer

G = madeup.G
WARN = ["-Wall", "-Wextra", "-Werror"]
SINGLE = 2e-6  # of full scale


@pytest.fixture(scope="module")
def tools():
    for name in ("gcc", "g++"):
        if shutil.which(name) is None:
            pytest.skip(f"no {name} on this machine")


def run(*command, **options):
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False, timeout=120, **options)
    assert done.returncode == 0, done.stderr or done.stdout
    return done.stdout


def arduino(folder, rows):
    """What the example prints for rows of outputs; only src and the example are compiled, as Arduino does it."""
    build, sketch = folder / "build", folder / "examples" / "Corrected" / "Corrected.ino"
    build.mkdir()
    flags = ["-DARDUINO=10819", "-O2", f"-I{folder / 'src'}", *WARN]
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
def exported(tmp_path_factory):
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


def test_arduino_finds_a_library_by_its_manifest(exported):
    lines = (exported / "library.properties").read_text().splitlines()
    properties = dict(line.split("=", 1) for line in lines)
    needed = {"name", "version", "author", "maintainer", "sentence", "paragraph", "category", "architectures"}
    assert needed <= set(properties)
    assert (exported / "src" / properties["includes"]).is_file()
    assert properties["category"] == "Sensors"


def test_platformio_builds_what_its_manifest_says(tools, exported, tmp_path):
    manifest = json.loads((exported / "library.json").read_text())
    build = manifest["build"]
    (tmp_path / "app.c").write_text(APPLICATION)
    sources = sorted((exported / build["srcDir"]).rglob("*.c"))
    for source in sources:
        run("gcc", *WARN, *build["flags"], "-c", source, "-o", tmp_path / f"{source.stem}.o")
    objects = [tmp_path / f"{source.stem}.o" for source in sources]
    include = f"-I{exported / build['includeDir']}"  # the library's flags are not those of the application
    run("gcc", *WARN, include, tmp_path / "app.c", *objects, "-o", tmp_path / "app", "-lm")
    assert run(tmp_path / "app") == "0 4\n"
    assert (exported / build["includeDir"] / manifest["headers"]).is_file()


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
def test_zephyr_builds_the_module_where_it_is_chosen(tools, exported, tmp_path, chosen):
    """With the few functions of Zephyr's build that the module calls, transcribed from its extensions.cmake."""
    if shutil.which("cmake") is None:
        pytest.skip("no cmake on this machine")
    module = yaml.safe_load((exported / "zephyr" / "module.yml").read_text())
    assert set(module) == {"name", "build"}
    assert (exported / module["build"]["kconfig"]).read_text().startswith("config IMULAB_UNIT\n")
    (tmp_path / "app.c").write_text(APPLICATION)
    text = ZEPHYR.format(chosen=chosen, module=exported / module["build"]["cmake"])
    (tmp_path / "CMakeLists.txt").write_text(text)
    run("cmake", "-S", tmp_path, "-B", tmp_path / "build")
    run("cmake", "--build", tmp_path / "build")
    if chosen == "y":
        assert run(tmp_path / "build" / "app") == "0 4\n"
    assert (tmp_path / "build" / "app").exists() == (chosen == "y")


def test_a_project_that_takes_every_source_links(tools, exported, tmp_path):
    """What the libraries compile is nothing where the sources themselves are compiled."""
    sources = sorted(exported.rglob("*.c"))
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

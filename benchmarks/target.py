"""What an exported unit costs on a Cortex-M4F: flash, memory, stack and instructions a sample, from QEMU.

``make footprint`` writes the table into docs/runtime.md. Needs gcc-arm-none-eabi, libnewlib-arm-none-eabi and
qemu-system-arm (Debian's names). The emulator counts instructions, not cycles: a Cortex-M4F takes 1 cycle for most, 2
for single loads, 14 for a division or a square root in single precision, and what its flash makes it wait.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import imulab as il
import madeup
from imulab.device.tables import Fusion
from imulab.exporters import ExportOptions, export
from imulab.records.calibration import Calibration

ROOT = Path(__file__).resolve().parents[1]
TARGET = ROOT / "runtime" / "tests" / "target"
PAGE = ROOT / "docs" / "runtime.md"
MARKS = ("<!-- footprint: made by make footprint -->\n", "<!-- end of footprint -->\n")
TOOLS = ("arm-none-eabi-gcc", "arm-none-eabi-size", "qemu-system-arm")
M4F = ["-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard"]
FLAGS = [*M4F, "-std=gnu99", "-DIMULAB_REAL=float", "-DIL_ARRAY_ELEMENTS=6", "-ffp-contract=off"]
LINK = ["-ffunction-sections", "-fdata-sections", "-Wl,--gc-sections", "--specs=rdimon.specs", "-nostartfiles"]
QEMU = ["qemu-system-arm", "-M", "mps2-an386", "-nographic", "-semihosting-config", "enable=on,target=native"]
HELD = "the temperature as before"
BRIDGED = "beyond the gyroscopes' range"
TITLES = ["one sample of", "flash, bytes", "state, bytes", "stack, bytes", "instructions, -Os", "instructions, -O2"]


def cases() -> Iterator[tuple[str, list[Calibration], Fusion | None]]:
    """Yield titles, records and how sensors are fused; `defines` says what the title's end asks of the samples."""
    for order in (1, 2, 3):
        yield f"accelerometers, order {order}", [madeup.tumble(order)], None
    yield "accelerometers and gyroscopes, order 1", [madeup.tumble(1, gyro=True)], None
    yield "the same with g-sensitivity", [madeup.tumble(1, gyro=True, sensitive=True)], None
    yield "the same with powers of the rate to 3", [madeup.tumble(1, gyro=True, sensitive=True, powers=3)], None
    yield "nine axes, order 1", [_nine()], None
    soaks = il.simulate_thermal("-20,-5,10,25,40,60", gyro=True)
    cubic, spline = (il.fit_thermal(soaks, degrees=f"{bias},2,1").calibration for bias in ("3", "spline"))
    yield "accelerometers over temperature, degrees 3 2 1", [cubic], None
    yield f"the same, {HELD}", [cubic], None
    yield "accelerometers over temperature, a spline with 6 knots", [spline], None
    six = il.fit_thermal(soaks, degrees="3,2,1", with_="gyro").calibration
    yield "accelerometers and gyroscopes over temperature", [six], None
    yield f"accelerometers and gyroscopes, {HELD}", [six], None
    yield "drift of a flexible gyroscope, two axes", [madeup.centrifuge()], None
    for model in ("knot-cubic", "knot-log-cubic", "exponential"):
        yield f"warm-up of two axes, `{model}`", [madeup.warmup(model)], None
    array = il.calibrate_array(il.simulate_array(experiment="static", duration=30.0)).calibration
    for method in ("mean", "feedback", "least-squares", "robust"):
        yield f"array of six gyros, `{method}`", [array], Fusion(method)
    for name, count in (("four", 4), ("eight", 8)):
        made = il.simulate_imus(elements=count, attitudes=6, duration="20 s", seed=1)
        board, ranged = il.calibrate_imus(made, gravity=9.80665).calibration, Fusion(gyro_range=34.9)
        yield f"board of {name} whole IMUs", [board], ranged
        yield f"board of {name} whole IMUs, {BRIDGED}", [board], ranged


def defines(title: str, records: Sequence[Calibration]) -> list[str]:
    """Return what is compiled in for a case: how samples are made, and room for the IMUs of the board alone."""
    imus = [f"IL_IMUS={record.model['imus']}" for record in records if "imus" in record.model]
    return imus + [name for name, end in (("HELD", HELD), ("BRIDGED", BRIDGED)) if title.endswith(end)]


def _nine() -> Calibration:
    recording = il.simulate_tumble(attitudes=16, order=1, gravity=9.80665, field="48 uT")
    accel = il.fit_tumble(recording, order=1, gravity=9.80665)
    six = il.fit_gyro(accel, recording, g_sensitivity="no").calibration
    return il.fit_mag(recording, accel=six, gravity=9.80665, field="48 uT").calibration


def measured(records: Sequence[Calibration], fusion: Fusion | None = None, *defined: str) -> dict[str, float]:
    """Return flash, state and stack, bytes, and instructions a sample by each optimisation; `defined` as compiled."""
    found: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        export("c", list(records), folder, ExportOptions(fusions=[fusion] * len(records)))
        for level in ("-Os", "-O2"):
            image = _built(folder, level, "count", *defined)
            done = subprocess.run(
                [*QEMU, "-icount", "shift=0", "-kernel", str(image)], capture_output=True, text=True, timeout=300
            )
            said = dict(re.findall(r"(\w+) ([\d.]+)", done.stdout))
            if done.returncode or "instructions" not in said:
                sys.exit(f"the emulator says: {done.stdout}{done.stderr}")
            found |= {f"instructions {level}": float(said["instructions"])}
            if level == "-Os":
                found |= {"stack": float(said["stack"]), "state": float(said["state"])}
                found["flash"] = _size(_built(folder, level, "CALLS")) - _size(_built(folder, level, "EMPTY"))
    return found


def _built(folder: Path, level: str, what: str, *defined: str) -> Path:
    """Return an image of the unit that counts, or that only has or lacks its calls."""
    image = folder / f"{what}{level}.elf"
    sources = [TARGET / "sample.c", *([TARGET / "start.c"] if what == "count" else [])]
    define = [f"-D{name}" for name in (*defined, *([] if what == "count" else [what]))]
    command = ["arm-none-eabi-gcc", *FLAGS, level, *define, *LINK, f"-I{folder}", "-T", TARGET / "mps2.ld"]
    command += [*sources, folder / "imulab.c", folder / "unit.c", "-o", image, "-lm"]
    subprocess.run(list(map(str, command)), check=True)
    return image


def _size(image: Path) -> int:
    done = subprocess.run(["arm-none-eabi-size", str(image)], check=True, capture_output=True, text=True)
    text, data = done.stdout.splitlines()[1].split()[:2]
    return int(text) + int(data)


def table() -> str:
    """Return the table in Markdown."""
    lines = [f"| {' | '.join(TITLES)} |", f"|{'---|' * len(TITLES)}"]
    for title, records, fusion in cases():
        found = measured(records, fusion, *defines(title, records))
        names = ("flash", "state", "stack", "instructions -Os", "instructions -O2")
        lines.append(f"| {title} | {' | '.join(f'{found[name]:.0f}' for name in names)} |")
        print(lines[-1], flush=True)
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, and put the table into the page."""
    missing = [tool for tool in TOOLS if shutil.which(tool) is None]
    if missing:
        sys.exit(f"not here: {' '.join(missing)} (Debian: gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm)")
    text = PAGE.read_text(encoding="utf-8")
    begin, end = (text.index(mark) for mark in MARKS)
    PAGE.write_text(f"{text[: begin + len(MARKS[0])]}\n{table()}\n{text[end:]}", encoding="utf-8")


if __name__ == "__main__":
    main()

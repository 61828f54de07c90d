"""imulab beside other programs on the same public recordings: comparison.json, and the tables of docs/comparison.md.

The attitudes of a recording are divided at random; a program is given those of one part and predicts |f| = g in the
others. Programs that are not on the machine are said to be not measured.
"""

from __future__ import annotations

import importlib.util
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from comparison_tables import filled
from timing import compiled, seconds

import imulab as il

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "tests"))
from reference import tumble as reference  # noqa: E402

DATA = Path(os.environ.get("IMULAB_DATA", HERE.parents[1] / "shared" / "data"))
MEASURED = HERE / "comparison.json"
PAGE = HERE.parent / "docs" / "comparison.md"
XYZ = "xyz"
G = 9.80665
SPLITS = 20
REPEATS = 9
FEW = {"quarter": 4, "third": 3}
"""One attitude in so many is left out."""
Predict = Callable[[np.ndarray], np.ndarray]
"""From mean outputs, shape (n, 3), to |f|, m/s^2, shape (n,)."""


@dataclass(frozen=True)
class Case:
    """One recording: its attitudes, local gravity, and what programs want besides."""

    group: str
    attitudes: il.Attitudes
    gravity: float
    nominal: tuple[float, float]
    """Zero, output, and output per m/s^2, by the sheet of the unit."""
    rows: np.ndarray | None = None
    """Time, s, and x, y, z, shape (n, 4), where there is a recording and not only a value of each attitude."""
    first: int = 0
    """Rows at rest at the beginning, for imu_tk."""


def cases(folder: Path) -> list[Case]:
    """Return the recordings of DATA; `folder` is for layouts."""
    layout = folder / "xsens.toml"
    columns = "".join(f'accel_{a} = {{ from = {i}, unit = "count" }}\n' for i, a in enumerate(XYZ, start=1))
    layout.write_text(f'delimiter = "whitespace"\n[columns]\ntime = {{ from = 0, unit = "s" }}\n{columns}')
    file = DATA / "xsens_mti" / "xsens_acc.mat"
    attitudes = il.find_attitudes(il.read(file, layout))
    found = [Case("Xsens MTi", attitudes, 9.81744, (32768.0, 415.0), np.loadtxt(file), 5000)]
    columns = "".join(f'accel_{a} = {{ from = {i}, unit = "m/s^2" }}\n' for i, a in enumerate(XYZ))
    layout = folder / "mpu9150.toml"
    layout.write_text(f'delimiter = "whitespace"\nsample_rate = {{ value = 100, unit = "Hz" }}\n[columns]\n{columns}')
    for unit, name in enumerate(("imu0.log", "imu1.log"), start=1):
        file = DATA / "mpu9150" / name
        rows = np.loadtxt(file)[:, :3]
        attitudes = il.find_attitudes(il.read(file, layout))
        rows = np.column_stack([np.arange(len(rows)) / 100, rows])
        found.append(Case(f"MPU-9150, unit {unit}", attitudes, G, (0.0, 1.0), rows, int(100 * attitudes.stop[0])))
    for name in ("ab", "ai", "bh", "fb", "hj", "hj2"):
        flat = json.loads((DATA / "sap5" / f"{name}.json").read_text())["shots"]["grav"]
        outputs = np.array([v for v in flat if v is not None and v == v]).reshape(-1, 3)
        found.append(Case("cave survey, six recordings", il.find_attitudes(_table(outputs, "g")), G, (0.0, 1 / G)))
    return found


def _table(outputs: np.ndarray, unit: str) -> il.Recording:
    columns = {f"accel_{a}": outputs[:, i].copy() for i, a in enumerate(XYZ)}
    return il.Recording(columns, dict.fromkeys(columns, unit))


def _linear(matrix: np.ndarray, zero: np.ndarray) -> Predict:
    return lambda outputs: np.asarray(np.linalg.norm((outputs - zero) @ matrix.T, axis=1))


def by_imulab(case: Case, kept: np.ndarray, notes: dict[str, Any]) -> Predict:
    """The defaults: order and loss `auto`."""
    record = il.fit_tumble(case.attitudes.only(kept), gravity=case.gravity).calibration
    chosen, order = notes.setdefault(case.group, {}), str(record.model["order"])
    chosen[order] = chosen.get(order, 0) + 1
    return _corrected(record, case)


def by_imulab_from_means(case: Case, kept: np.ndarray, notes: dict[str, Any]) -> Predict:
    """The same without the noise of each attitude, so that all weigh alike, as in the other programs."""
    means = _table(case.attitudes.mean[kept], case.attitudes.unit)
    return _corrected(il.fit_tumble(il.find_attitudes(means), gravity=case.gravity).calibration, case)


def _corrected(record: il.Calibration, case: Case) -> Predict:
    def norm(outputs: np.ndarray) -> np.ndarray:
        return np.asarray(np.linalg.norm(il.apply(record, _table(outputs, case.attitudes.unit)).triad("accel"), axis=1))

    return norm


def by_least_squares(case: Case, kept: np.ndarray, notes: dict[str, Any]) -> Predict:
    """Nine parameters, plain |f| least squares by scipy."""
    found = reference.upper_triangular_fit(case.attitudes.mean[kept], case.gravity)
    turn = np.array([[1, -found["yz"], found["zy"]], [0, 1, -found["zx"]], [0, 0, 1]])
    zero = np.array([found[f"zero_{a}"] for a in XYZ])
    return _linear(turn / [found[f"inverse_k_{a}"] for a in XYZ], zero)


def by_imu_tk(case: Case, kept: np.ndarray, notes: dict[str, Any], means: bool = False) -> Predict:
    """The program IMU_TK on the recording without the rows of the attitudes that are left out."""
    assert case.rows is not None
    time = case.rows[:, 0]
    left_out = np.setdiff1d(np.arange(len(case.attitudes)), kept)
    intervals = zip(case.attitudes.start[left_out], case.attitudes.stop[left_out], strict=True)
    cut = np.logical_or.reduce([(begin <= time) & (time <= end) for begin, end in intervals])
    with tempfile.TemporaryDirectory() as folder:
        np.savetxt(Path(folder) / "cut.txt", case.rows[~cut], fmt="%.9g")
        subprocess.run(imu_tk(case, "cut.txt", means), cwd=folder, check=True, capture_output=True, timeout=60)
        numbers = np.loadtxt(Path(folder) / "found.txt")
    return _linear(numbers[:3], numbers[3])


def by_imu_tk_with_means(case: Case, kept: np.ndarray, notes: dict[str, Any]) -> Predict:
    """The same with the mean of each rest instead of its first 100 samples."""
    return by_imu_tk(case, kept, notes, means=True)


def imu_tk(case: Case, file: str | Path, means: bool = False) -> list[str]:
    """Return the command that calibrates a file of times and outputs into found.txt."""
    numbers = [str(case.gravity), str(case.first), str(case.nominal[0]), str(int(means))]
    return [os.environ["IMU_TK"], str(file), *numbers, "found.txt"]


def by_toolkit(case: Case, kept: np.ndarray, notes: dict[str, Any]) -> Predict:
    """imu-calib-toolkit on the mean of each attitude, which is an input of its own; it wants m/s^2."""
    zero, scale = case.nominal
    fit = _toolkit()
    matrix, bias = fit((case.attitudes.mean[kept] - zero) / scale, case.gravity)
    return _linear(matrix / scale, zero + scale * bias)


def _toolkit() -> Callable[[np.ndarray, float], tuple[np.ndarray, np.ndarray]]:
    folder = os.environ["IMU_CALIB_TOOLKIT"]
    if folder not in sys.path:
        sys.path.insert(0, folder)
    from imu_calib.calib.fit_acc_multi_pose import fit_acc_multi_pose
    from imu_calib.models.data_structures import AccPose

    def fit(means: np.ndarray, gravity: float) -> tuple[np.ndarray, np.ndarray]:
        poses = [AccPose(mean, str(number)) for number, mean in enumerate(means)]
        matrix, bias, _ = fit_acc_multi_pose(poses, gravity_magnitude=gravity)
        return np.asarray(matrix), np.asarray(bias)

    return fit


PROGRAMS = {
    "imulab": by_imulab,
    "imulab, all attitudes alike": by_imulab_from_means,
    "plain least squares": by_least_squares,
    "imu_tk": by_imu_tk,
    "imu_tk, means of rests": by_imu_tk_with_means,
    "imu-calib-toolkit": by_toolkit,
}
NEEDS = {"imu_tk": "IMU_TK", "imu_tk, means of rests": "IMU_TK", "imu-calib-toolkit": "IMU_CALIB_TOOLKIT"}
Errors = dict[str, dict[str, list[float | None]]]
"""By recording and program, for each split: rms of |f| - g in the attitudes left out, ug; None where it failed."""


def here(program: str) -> bool:
    return program not in NEEDS or NEEDS[program] in os.environ


def predictions(found: list[Case], few: int, notes: dict[str, Any]) -> Errors:
    errors: Errors = {}
    for number, case in enumerate(found):
        count = len(case.attitudes)
        for split in range(SPLITS):
            # The first attitude stays: imu_tk takes its threshold from the rest at the beginning.
            order = 1 + np.random.default_rng([number, split]).permutation(count - 1)
            out, kept = np.sort(order[: count // few]), np.sort(np.append(order[count // few :], 0))
            for program, fit in PROGRAMS.items():
                if not here(program) or (program.startswith("imu_tk") and case.rows is None):
                    continue
                rms = None
                try:
                    error = fit(case, kept, notes)(case.attitudes.mean[out]) / case.gravity - 1
                    rms = round(1e6 * float(np.sqrt(np.mean(error**2))), 1)
                except (subprocess.SubprocessError, OSError, ValueError) as failure:
                    print(f"{program}, {case.group}, split {split}: {failure}", file=sys.stderr)
                errors.setdefault(case.group, {}).setdefault(program, []).append(rms)
        print(f"{case.group}: {count} attitudes, one in {few} left out", flush=True)
    return errors


_MEASURER = """
import os, subprocess, sys
child = subprocess.Popen(sys.argv[1:], stdout=subprocess.DEVNULL)
_, status, used = os.wait4(child.pid, 0)
print(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)
sys.exit(status != 0)
"""


def processes(case: Case, folder: Path) -> dict[str, list[float]]:
    """Processor time, s, and peak memory, MB, of whole processes from the recording to the result, medians."""
    file = DATA / "xsens_mti" / "xsens_acc.mat"
    fit = ["tumble", "fit", str(file), "--layout", "xsens.toml", "--gravity", str(case.gravity), "-o", "found.json"]
    commands = {"imulab": [sys.executable, "-m", "imulab", *fit]}
    if here("imu_tk"):
        commands |= {"imu_tk": imu_tk(case, file)}
    taken: dict[str, list[list[float]]] = {name: [] for name in commands}
    for _ in range(REPEATS + 1):  # the first does not count: Python compiles then
        for name, command in commands.items():
            # A small process stands between, because a child begins with the memory of the process that starts it.
            call = [sys.executable, "-c", _MEASURER, *command]
            done = subprocess.run(call, cwd=folder, check=True, capture_output=True, text=True, env=compiled())
            taken[name].append([float(word) for word in done.stdout.split()])
    return {name: [statistics.median(column) for column in zip(*runs[1:], strict=True)] for name, runs in taken.items()}


def fits(case: Case) -> dict[str, float]:
    """Processor time, s, of a fit to attitudes that are already found, in turn within one process."""
    work = {"imulab": lambda: il.fit_tumble(case.attitudes, gravity=case.gravity)}
    work["imulab, order 1"] = lambda: il.fit_tumble(case.attitudes, order=1, gravity=case.gravity)
    if here("imu-calib-toolkit"):
        fit, means = _toolkit(), (case.attitudes.mean - case.nominal[0]) / case.nominal[1]
        work["imu-calib-toolkit"] = lambda: fit(means, case.gravity)
    return dict(zip(work, seconds(*work.values(), repeats=5 * REPEATS, clock=time.process_time), strict=True))


def session() -> dict[str, Any]:
    """imucal's own session: six rests on the faces of a box, then a turn about each axis and a rest with it."""
    table = np.loadtxt(DATA / "imucal" / "example_ferraris_session.csv", delimiter=",", skiprows=1)
    time, rate, force = table[:, 0] / 102.4, table[:, 1:4], table[:, 4:7]
    units = {"time": "s"} | {f"accel_{a}": "m/s^2" for a in XYZ}
    attitudes = il.find_attitudes(il.Recording(dict(zip(units, [time, *force.T], strict=True)), units))
    found: dict[str, Any] = {"attitudes": len(attitudes)}
    try:
        il.fit_tumble(attitudes, gravity=9.81)
    except il.ImulabError as refusal:
        found["imulab"] = str(refusal).partition(": ")[2]

    def rms(predict: Predict) -> float:
        return round(1e6 * float(np.sqrt(np.mean((predict(attitudes.mean[6:]) / 9.81 - 1) ** 2))), 1)

    if importlib.util.find_spec("imucal"):
        info = _imucal(attitudes, time, rate, force)
        found["imucal"] = rms(_linear(np.linalg.inv(info.K_a @ info.R_a), info.b_a))
    if here("imu-calib-toolkit"):
        found["imu-calib-toolkit"] = rms(_linear(*_toolkit()(attitudes.mean[:6], 9.81)))
        matrix = _toolkit()(attitudes.mean, 9.81)[0]
        found["misalignment"] = round(
            float(np.max(np.abs(matrix - np.diag(np.diag(matrix))) / np.diag(matrix)[:, None])), 3
        )
    return found


def _imucal(attitudes: il.Attitudes, time: np.ndarray, rate: np.ndarray, force: np.ndarray) -> Any:
    from imucal import FerrarisCalibration
    from imucal.ferraris_calibration import FerrarisSignalRegions

    parts = {}
    for number, face in enumerate(f"{a}_{end}" for a in XYZ for end in "pa"):
        rest = (attitudes.start[number] <= time) & (time <= attitudes.stop[number])
        parts |= {f"acc_{face}": force[rest], f"gyr_{face}": rate[rest]}
    for i, a in enumerate(XYZ):
        others = 3 * np.abs(np.delete(rate, i, axis=1)).max(axis=1)
        fast = np.flatnonzero((time > attitudes.stop[5]) & (np.abs(rate[:, i]) > np.maximum(20, others)))
        turn = max(np.split(fast, np.flatnonzero(np.diff(fast) > 51) + 1), key=len)
        rows = slice(turn[0] - 51, turn[-1] + 52)
        parts |= {f"acc_{a}_rot": force[rows], f"gyr_{a}_rot": rate[rows]}
    regions = FerrarisSignalRegions(**parts)
    return FerrarisCalibration(grav=9.81).compute(regions, 102.4, from_acc_unit="m/s^2", from_gyr_unit="deg/s")


def main() -> None:
    if not (DATA / "xsens_mti").is_dir():
        sys.exit("the recordings are not here: IMULAB_DATA names their folder")
    for name in set(NEEDS.values()):
        if name in os.environ and not Path(os.environ[name]).exists():
            sys.exit(f"{name}: {os.environ[name]} is not there; docs/comparison.md says what it names")
    measured: dict[str, Any] = {"splits": SPLITS, "versions": {n: version(n) for n in ("imulab", "numpy", "scipy")}}
    if importlib.util.find_spec("imucal"):
        measured["versions"]["imucal"] = version("imucal")
    with tempfile.TemporaryDirectory() as folder:
        found = cases(Path(folder))
        for name, few in FEW.items():
            orders: dict[str, Any] = {}
            measured[name] = predictions(found, few, orders)
            measured[f"orders, {name}"] = orders
        measured |= {"processes": processes(found[0], Path(folder)), "fits": fits(found[0]), "session": session()}
    MEASURED.write_text(json.dumps(measured, indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(filled(PAGE.read_text(encoding="utf-8"), measured), encoding="utf-8")
    print(f"wrote {MEASURED.name} and {PAGE.name}")


if __name__ == "__main__":
    main()

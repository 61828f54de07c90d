"""Verdicts on real recordings without a known fault, for the page of `make truth`; nothing is simulated here."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

DATA = Path(os.environ.get("IMULAB_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
SAP5 = ("ab", "ai", "bh", "fb", "hj")
G = 9.80665
NINE = "".join(
    f'{sensor}_{axis} = {{ from = {3 * k + i}, unit = "{unit}" }}\n'
    for k, (sensor, unit) in enumerate((("accel", "m/s^2"), ("gyro", "rad/s")))
    for i, axis in enumerate("xyz")
)


def layout(text: str) -> Path:
    """A layout as a file."""
    path = Path(tempfile.mkdtemp()) / "layout.toml"
    path.write_text(text, encoding="utf-8")
    return path


def xsens() -> Any:
    """Accelerometers and gyroscopes, which are in two files."""
    import imulab as il

    head = 'delimiter = "whitespace"\n[columns]\ntime = { from = 0, unit = "s" }\n'
    accel, gyro = (
        layout(head + "".join(f'{s}_{a} = {{ from = {i}, unit = "count" }}\n' for i, a in enumerate("xyz", start=1)))
        for s in ("accel", "gyro")
    )
    accelerometers = il.read(DATA / "xsens_mti" / "xsens_acc.mat", accel)
    record = il.fit_tumble(accelerometers, gravity=9.81744).calibration
    return il.fit_gyro(record, il.read(DATA / "xsens_mti" / "xsens_gyro.mat", gyro), accel_data=accelerometers)


def mpu9150(name: str) -> Any:
    """Accelerometers and gyroscopes."""
    import imulab as il

    head = 'delimiter = "whitespace"\nsample_rate = { value = 100, unit = "Hz" }\n[columns]\n'
    return il.fit_tumble(il.read(DATA / "mpu9150" / name, layout(head + NINE)), gravity=G, with_="gyro")


def sap5(name: str) -> Any:
    """Accelerometers and magnetometers, a table of attitudes."""
    import imulab as il
    from imulab.recording import Recording

    shots = json.loads((DATA / "sap5" / f"{name}.json").read_text())["shots"]
    columns = {}
    for sensor, key in (("accel", "grav"), ("mag", "mag")):
        values = np.array([v for v in shots[key] if v is not None and v == v]).reshape(-1, 3)
        columns |= {f"{sensor}_{axis}": values[:, i].copy() for i, axis in enumerate("xyz")}
    units = {column: "g" if column[0] == "a" else "count" for column in columns}
    table = Recording(columns, units, name=f"{name}.json")
    return il.fit_mag(table, gravity=G)


def mimu4444() -> Any:
    """Noise of the first of eight units while the board rests."""
    import imulab as il

    return il.fit_noise(il.read(DATA / "mimu4444" / "exp_1.bin"), element=1, window="0:18.5")


def imucal() -> Any:
    """Gyroscopes by whole turns."""
    import imulab as il

    rows = np.loadtxt(DATA / "imucal" / "example_ferraris_session.csv", delimiter=",", skiprows=1)
    units = {"gyro": "deg/s", "accel": "m/s^2"}
    return il.fit_turns(il.Recording.from_arrays(gyro=rows[:, 1:4], accel=rows[:, 4:7], rate=102.4, units=units))


RECORDINGS: dict[str, Callable[[], Any]] = {
    "xsens_mti, accelerometers and gyroscopes": xsens,
    **{f"mpu9150 {log}, accelerometers and gyroscopes": partial(mpu9150, log) for log in ("imu0.log", "imu1.log")},
    **{f"sap5 {name}, accelerometers and magnetometers": partial(sap5, name) for name in SAP5},
    "mimu4444 at rest, noise": mimu4444,
    "imucal, whole turns": imucal,
}


def verdicts() -> list[tuple[str, str, str]]:
    """Name, state, and reasons or refusal of each recording."""
    from imulab.errors import ImulabError

    rows = []
    for name, fit in RECORDINGS.items():
        try:
            verdict = fit().calibration.verdict
            rows.append((name, verdict.state, "; ".join(verdict.reasons)))
        except ImulabError as error:
            rows.append((name, "refused", str(error)))
    return rows


if __name__ == "__main__":
    for row in verdicts():
        print(*row, sep=" | ")

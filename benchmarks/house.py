"""Starting: processor time, which other work on the machine changes less than it changes the time of day."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np
from timing import Row, processor_seconds

import imulab as il

DATA = Path(os.environ.get("IMULAB_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
_XSENS = """
delimiter = "whitespace"
[columns]
time = { from = 0, unit = "s" }
accel_x = { from = 1, unit = "count" }
accel_y = { from = 2, unit = "count" }
accel_z = { from = 3, unit = "count" }
"""


def rows() -> list[Row]:
    bare, loaded, shown = processor_seconds(["-c", ""], ["-c", "import imulab"], ["-m", "imulab", "--help"])
    return [
        ("`import imulab`, beyond a bare Python, processor time", f"{loaded - bare:.3f} s", "< 0.25 s"),
        ("`imulab --help`, whole process, processor time", f"{shown:.2f} s", "< 0.5 s"),
        *_commands(),
    ]


def _commands() -> list[Row]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rng = np.random.default_rng(3)
        columns = {"time": np.arange(1_000_000) / 100, "gyro_x": rng.standard_normal(1_000_000)}
        il.write_csv(il.Recording(columns, {"time": "s", "gyro_x": "deg/s"}), folder / "noise.csv")
        (folder / "xsens.toml").write_text(_XSENS)
        file = (
            Path(os.environ.get("IMULAB_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
            / "xsens_mti"
            / "xsens_acc.mat"
        )
        commands = {
            "`allan` of a million samples": (["allan", str(folder / "noise.csv")], "<= 0.45 s"),
            "`tumble fit` of the Xsens recording": (
                ["tumble", "fit", str(file), "--layout", str(folder / "xsens.toml"), "--gravity", "9.81744",
                 "-o", str(folder / "out.json")], "<= 0.35 s",
            ),
        }  # fmt: skip
        if not file.exists():
            commands.popitem()
        numpy, *times = processor_seconds(
            ["-c", "import numpy"], *(["-m", "imulab", *words] for words, _ in commands.values())
        )
    found = [
        (f"{what}, whole process, processor time", f"{spent:.2f} s", asked)
        for (what, (_, asked)), spent in zip(commands.items(), times, strict=True)
    ]
    return [*found, ("`import numpy` in a bare Python, for comparison, processor time", f"{numpy:.2f} s", "")]

"""A simulated production line: units that are calibrated twice, with what a line must notice built in."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from imulab.arguments import Folder
from imulab.atomic_write import write_text
from imulab.errors import OptionError
from imulab.procedures.tumble.simulate import simulate_tumble
from imulab.quantities import whole
from imulab.units import STANDARD_GRAVITY
from imulab.writers import write_csv

_FEWEST, _MOST = 8, 2000
_BEGIN = datetime(2026, 3, 2, 9)
_AGAIN = timedelta(days=182)
_FAR_OFF, _CHANGED = 4, 6
LIMITS = """[tumble]
"bias_*" = { lower = -40, upper = 40, unit = "mg" }
"scale_factor_*" = { lower = -9000, upper = 9000, unit = "ppm" }
"misalignment_*" = { lower = -6, upper = 6, unit = "mrad" }
"""


def simulate_fleet(folder: Folder, *, units: int | str = 12, seed: int | str = 1) -> tuple[Path, Path]:
    """Write the recordings of a line's units, two manifests and limits; return the paths of the manifests.

    ``first.csv`` calibrates every unit, one a day; ``second.csv`` the same units half a year later. The zero of z
    drifts by 2 mg from unit to unit, unit 5 is 60 mg off in x, and unit 7 changes by 5 mg in y between the two.

    Parameters
    ----------
    folder
        Made if it is not there.
    units
        8 to 2000.
    seed
        Of the random numbers.

    Raises
    ------
    OptionError
        A value is out of range, or the folder cannot be written to.

    Examples
    --------
    >>> import imulab as il
    >>> [manifest.name for manifest in il.simulate_fleet("line", units=8)]
    ['first.csv', 'second.csv']
    """
    units, seed = whole(units, "units"), whole(seed, "seed")
    if not _FEWEST <= units <= _MOST:
        raise OptionError(f"units {units}: expected {_FEWEST} to {_MOST}")
    if seed < 0:
        raise OptionError(f"seed {seed}: expected a whole number from 0")
    home = Path(folder)
    try:
        home.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OptionError(f"{home}: the folder cannot be made: {error.strerror}") from None
    rng = np.random.default_rng(seed)
    mg = 1e-3 * STANDARD_GRAVITY
    truths = [
        {f"bias_{a}": float(v) for a, v in zip("xyz", rng.normal(0, 4 * mg, 3), strict=True)}
        | {f"scale_factor_{a}": float(1 + v) for a, v in zip("xyz", rng.normal(0, 2e-3, 3), strict=True)}
        | {f"misalignment_{p}": float(v) for p, v in zip(("yx", "zx", "zy"), rng.normal(0, 1.5e-3, 3), strict=True)}
        for _ in range(units)
    ]
    for number, truth in enumerate(truths):
        truth["bias_z"] += 2 * number * mg
    truths[_FAR_OFF]["bias_x"] += 60 * mg
    manifests = []
    for name, begin in (("first", _BEGIN), ("second", _BEGIN + _AGAIN)):
        rows = ["serial,procedure,file,gravity,order"]
        for number, truth in enumerate(truths):
            moved = 5 * mg if name == "second" and number == _CHANGED else 0.0
            recording = simulate_tumble(
                attitudes=16, truth=truth | {"bias_y": truth["bias_y"] + moved}, hold=3.0, move=1.0, gyro=False,
                seed=int(rng.integers(1 << 31)),
            )  # fmt: skip
            serial, date = f"LINE-{number + 1:04d}", (begin + timedelta(days=number)).isoformat()
            file = f"{name}_{number + 1:04d}.csv"
            head = {"serial": serial, "date": date, **{k: v for k, v in recording.metadata.items() if k != "serial"}}
            write_csv(replace(recording, metadata=head), home / file)
            rows.append(f"{serial},tumble,{file},{STANDARD_GRAVITY},1")
        manifests.append(home / f"{name}.csv")
        write_text(manifests[-1], "\n".join(rows) + "\n")
    write_text(home / "limits.toml", LIMITS)
    return manifests[0], manifests[1]

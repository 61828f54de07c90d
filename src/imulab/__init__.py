"""imulab: inertial sensors from test recordings to calibration records, reports and firmware.

Frames, units and notation, valid everywhere:

- SI inside: s, m/s^2, rad, rad/s; temperature in degC. Engineering units only in files, messages and reports.
- Specific force, not acceleration: +g on the upward axis at rest. Body frame right-handed; vectors have shape (n, 3),
  time first axis.
- Terms of IEEE Std 528, 1293, 813, 836: bias b, scale factor S, input-axis misalignment m, nonlinearity k2, k3, ...
- ``M = S (A + b)``, ``A = s + k2 s^2 + ...``, ``s = T f``: output M, specific force f, along the input axes s.
- An uncertainty is a standard uncertainty (one sigma, GUM) unless an interval is named.

The way through the package::

    import imulab as il
    recording = il.read("tumble.csv")
    fit = il.fit_tumble(il.find_attitudes(recording), order="auto", gravity=9.81362)
    print(fit.calibration)
    fit.calibration.save("sn42.json")
    il.write_report(fit.calibration, "sn42.html")
    corrected = il.apply(il.load("sn42.json"), il.read("flight.csv"))
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from imulab._version import VERSION as __version__  # noqa: N811

if TYPE_CHECKING:
    from imulab.applying import apply as apply
    from imulab.attitudes import Attitudes as Attitudes
    from imulab.calibration import Calibration as Calibration
    from imulab.calibration import load as load
    from imulab.centrifuge.fit import CentrifugeFit as CentrifugeFit
    from imulab.centrifuge.fit import fit_centrifuge as fit_centrifuge
    from imulab.centrifuge.manifest import load_manifest as load_manifest
    from imulab.centrifuge.simulate import simulate_centrifuge as simulate_centrifuge
    from imulab.errors import ImulabError as ImulabError
    from imulab.exporters import export as export
    from imulab.gravity import normal_gravity as normal_gravity
    from imulab.gyro_array.compare import compare_methods as compare_methods
    from imulab.gyro_array.fit import ArrayFit as ArrayFit
    from imulab.gyro_array.fit import calibrate_array as calibrate_array
    from imulab.gyro_array.fuse import Fused as Fused
    from imulab.gyro_array.fuse import FuseOptions as FuseOptions
    from imulab.gyro_array.fuse import fuse as fuse
    from imulab.gyro_array.simulate import simulate_array as simulate_array
    from imulab.noise import allan_deviation as allan_deviation
    from imulab.present import write_report as write_report
    from imulab.readers import read as read
    from imulab.readers import read_blocks as read_blocks
    from imulab.recording import Recording as Recording
    from imulab.segment import find_attitudes as find_attitudes
    from imulab.tumble.compare import check_tumble as check_tumble
    from imulab.tumble.fit import TumbleFit as TumbleFit
    from imulab.tumble.fit import fit_tumble as fit_tumble
    from imulab.tumble.simulate import simulate_tumble as simulate_tumble
    from imulab.warmup.cycles import find_power_cycle as find_power_cycle
    from imulab.warmup.fit import WarmupFit as WarmupFit
    from imulab.warmup.fit import fit_warmup as fit_warmup
    from imulab.warmup.plan import plan_warmup as plan_warmup
    from imulab.warmup.simulate import simulate_warmup as simulate_warmup
    from imulab.writers import write as write
    from imulab.writers import write_csv as write_csv

_HOME = {
    "ArrayFit": "gyro_array.fit",
    "FuseOptions": "gyro_array.fuse",
    "Fused": "gyro_array.fuse",
    "allan_deviation": "noise",
    "calibrate_array": "gyro_array.fit",
    "check_tumble": "tumble.compare",
    "compare_methods": "gyro_array.compare",
    "fuse": "gyro_array.fuse",
    "simulate_array": "gyro_array.simulate",
    "Attitudes": "attitudes",
    "Calibration": "calibration",
    "CentrifugeFit": "centrifuge.fit",
    "ImulabError": "errors",
    "Recording": "recording",
    "TumbleFit": "tumble.fit",
    "WarmupFit": "warmup.fit",
    "apply": "applying",
    "export": "exporters",
    "find_attitudes": "segment",
    "find_power_cycle": "warmup.cycles",
    "fit_centrifuge": "centrifuge.fit",
    "fit_tumble": "tumble.fit",
    "fit_warmup": "warmup.fit",
    "load": "calibration",
    "load_manifest": "centrifuge.manifest",
    "normal_gravity": "gravity",
    "plan_warmup": "warmup.plan",
    "read": "readers",
    "read_blocks": "readers",
    "simulate_centrifuge": "centrifuge.simulate",
    "simulate_tumble": "tumble.simulate",
    "simulate_warmup": "warmup.simulate",
    "write": "writers",
    "write_csv": "writers",
    "write_report": "present",
}

__all__ = ["__version__", *_HOME]


def __getattr__(name: str) -> Any:
    """Import public names when they are first used, so that ``import imulab`` costs nothing."""
    if name not in _HOME:
        raise AttributeError(f"module 'imulab' has no attribute {name!r}")
    value = getattr(import_module(f"imulab.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])

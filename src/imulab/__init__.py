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
    fit = il.fit_tumble(recording, order="auto", gravity=9.81362)
    print(fit.calibration)
    fit.calibration.save("sn42.json")
    il.write_report(fit.calibration, "sn42.html")
    corrected = il.apply(il.load("sn42.json"), il.read("flight.csv"))
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from imulab._version import VERSION as __version__  # noqa: N811
from imulab.views import Views, hand_down

if TYPE_CHECKING:
    from imulab.certificate.issue import write_certificate as write_certificate
    from imulab.certificate.issue import write_fleet_certificates as write_fleet_certificates
    from imulab.errors import ImulabError as ImulabError
    from imulab.fleet.report import write_fleet_report as write_fleet_report
    from imulab.fleet.run import fleet_status as fleet_status
    from imulab.fleet.run import run_fleet as run_fleet
    from imulab.gravity import normal_gravity as normal_gravity
    from imulab.procedures.apply import apply as apply
    from imulab.procedures.centrifuge.fit import CentrifugeFit as CentrifugeFit
    from imulab.procedures.centrifuge.fit import fit_centrifuge as fit_centrifuge
    from imulab.procedures.centrifuge.manifest import load_manifest as load_manifest
    from imulab.procedures.centrifuge.plan import plan_centrifuge as plan_centrifuge
    from imulab.procedures.centrifuge.simulate import simulate_centrifuge as simulate_centrifuge
    from imulab.procedures.exporting import export as export
    from imulab.procedures.gyro_array.fit import ArrayFit as ArrayFit
    from imulab.procedures.gyro_array.fuse import Fused as Fused
    from imulab.procedures.gyro_array.imus.compare import BoardComparison as BoardComparison
    from imulab.procedures.gyro_array.imus.compare import ImuDifference as ImuDifference
    from imulab.procedures.gyro_array.imus.compare import compare_imus as compare_imus
    from imulab.procedures.gyro_array.imus.fit import ImusFit as ImusFit
    from imulab.procedures.gyro_array.imus.fit import calibrate_imus as calibrate_imus
    from imulab.procedures.gyro_array.imus.fuse import FusedBoard as FusedBoard
    from imulab.procedures.gyro_array.imus.fuse import fuse_imus as fuse_imus
    from imulab.procedures.gyro_array.imus.plan import plan_imus as plan_imus
    from imulab.procedures.gyro_array.imus.simulate import simulate_imus as simulate_imus
    from imulab.procedures.gyro_array.public import calibrate_array as calibrate_array
    from imulab.procedures.gyro_array.public import compare_methods as compare_methods
    from imulab.procedures.gyro_array.public import fuse as fuse
    from imulab.procedures.gyro_array.public import merge_array as merge_array
    from imulab.procedures.gyro_array.simulate import simulate_array as simulate_array
    from imulab.procedures.gyro_array.stream import FuseOptions as FuseOptions
    from imulab.procedures.magnetometer.check import check_magnetometer as check_magnetometer
    from imulab.procedures.magnetometer.fit import MagnetometerFit as MagnetometerFit
    from imulab.procedures.magnetometer.fit import fit_magnetometer as fit_magnetometer
    from imulab.procedures.magnetometer.plan import plan_magnetometer as plan_magnetometer
    from imulab.procedures.magnetometer.simulate import simulate_magnetometer as simulate_magnetometer
    from imulab.procedures.noise.allan import allan_deviation as allan_deviation
    from imulab.procedures.noise.check import check_noise as check_noise
    from imulab.procedures.noise.fit import NoiseFit as NoiseFit
    from imulab.procedures.noise.fit import fit_noise as fit_noise
    from imulab.procedures.noise.plan import plan_noise as plan_noise
    from imulab.procedures.noise.simulate import simulate_noise as simulate_noise
    from imulab.procedures.rate.fit import RateFit as RateFit
    from imulab.procedures.rate.fit import fit_rate as fit_rate
    from imulab.procedures.rate.plan import plan_rate as plan_rate
    from imulab.procedures.rate.simulate import simulate_rate as simulate_rate
    from imulab.procedures.rate.turns import TurnsFit as TurnsFit
    from imulab.procedures.rate.turns import fit_turns as fit_turns
    from imulab.procedures.registry import load as load
    from imulab.procedures.thermal.check import check_thermal as check_thermal
    from imulab.procedures.thermal.fit import ThermalFit as ThermalFit
    from imulab.procedures.thermal.fit import fit_thermal as fit_thermal
    from imulab.procedures.thermal.plan import plan_thermal as plan_thermal
    from imulab.procedures.thermal.plan_ramp import plan_ramp as plan_ramp
    from imulab.procedures.thermal.simulate import simulate_thermal as simulate_thermal
    from imulab.procedures.tumble.attitudes import Attitudes as Attitudes
    from imulab.procedures.tumble.attitudes import find_attitudes as find_attitudes
    from imulab.procedures.tumble.check import check_tumble as check_tumble
    from imulab.procedures.tumble.fit import TumbleFit as TumbleFit
    from imulab.procedures.tumble.fit import fit_tumble as fit_tumble
    from imulab.procedures.tumble.gyro.fit import fit_gyro as fit_gyro
    from imulab.procedures.tumble.mag.fit import MagFit as MagFit
    from imulab.procedures.tumble.mag.fit import fit_mag as fit_mag
    from imulab.procedures.tumble.plan import plan_tumble as plan_tumble
    from imulab.procedures.tumble.simulate import simulate_fleet as simulate_fleet
    from imulab.procedures.tumble.simulate import simulate_tumble as simulate_tumble
    from imulab.procedures.views import compare_records as compare_records
    from imulab.procedures.views import write_report as write_report
    from imulab.procedures.warmup.cycles import find_power_cycle as find_power_cycle
    from imulab.procedures.warmup.fit import WarmupFit as WarmupFit
    from imulab.procedures.warmup.fit import fit_warmup as fit_warmup
    from imulab.procedures.warmup.plan import plan_warmup as plan_warmup
    from imulab.procedures.warmup.simulate import simulate_power_cycle as simulate_power_cycle
    from imulab.procedures.warmup.simulate import simulate_warmup as simulate_warmup
    from imulab.procedures.warmup.spreadsheet import warmup_table as warmup_table
    from imulab.readers import read as read
    from imulab.readers import read_blocks as read_blocks
    from imulab.readers.guess import guess_layout as guess_layout
    from imulab.readers.streams import join_recordings as join_recordings
    from imulab.recording import Recording as Recording
    from imulab.records.calibration import Calibration as Calibration
    from imulab.writers import write as write
    from imulab.writers import write_csv as write_csv

_HOME = {
    "ArrayFit": "procedures.gyro_array.fit",
    "FuseOptions": "procedures.gyro_array.stream",
    "Fused": "procedures.gyro_array.fuse",
    "ImusFit": "procedures.gyro_array.imus.fit",
    "allan_deviation": "procedures.noise.allan",
    "calibrate_array": "procedures.gyro_array.public",
    "calibrate_imus": "procedures.gyro_array.imus.fit",
    "check_noise": "procedures.noise.check",
    "check_thermal": "procedures.thermal.check",
    "check_tumble": "procedures.tumble.check",
    "compare_imus": "procedures.gyro_array.imus.compare",
    "compare_methods": "procedures.gyro_array.public",
    "fuse": "procedures.gyro_array.public",
    "run_fleet": "fleet.run",
    "simulate_array": "procedures.gyro_array.simulate",
    "BoardComparison": "procedures.gyro_array.imus.compare",
    "ImuDifference": "procedures.gyro_array.imus.compare",
    "FusedBoard": "procedures.gyro_array.imus.fuse",
    "fuse_imus": "procedures.gyro_array.imus.fuse",
    "simulate_imus": "procedures.gyro_array.imus.simulate",
    "Attitudes": "procedures.tumble.attitudes",
    "Calibration": "records.calibration",
    "CentrifugeFit": "procedures.centrifuge.fit",
    "ImulabError": "errors",
    "Recording": "recording",
    "MagnetometerFit": "procedures.magnetometer.fit",
    "check_magnetometer": "procedures.magnetometer.check",
    "fit_magnetometer": "procedures.magnetometer.fit",
    "plan_magnetometer": "procedures.magnetometer.plan",
    "simulate_magnetometer": "procedures.magnetometer.simulate",
    "MagFit": "procedures.tumble.mag.fit",
    "RateFit": "procedures.rate.fit",
    "TurnsFit": "procedures.rate.turns",
    "fit_turns": "procedures.rate.turns",
    "ThermalFit": "procedures.thermal.fit",
    "TumbleFit": "procedures.tumble.fit",
    "WarmupFit": "procedures.warmup.fit",
    "apply": "procedures.apply",
    "compare_records": "procedures.views",
    "export": "procedures.exporting",
    "find_attitudes": "procedures.tumble.attitudes",
    "find_power_cycle": "procedures.warmup.cycles",
    "fit_gyro": "procedures.tumble.gyro.fit",
    "fit_mag": "procedures.tumble.mag.fit",
    "NoiseFit": "procedures.noise.fit",
    "fit_noise": "procedures.noise.fit",
    "fit_centrifuge": "procedures.centrifuge.fit",
    "fit_rate": "procedures.rate.fit",
    "fit_thermal": "procedures.thermal.fit",
    "fit_tumble": "procedures.tumble.fit",
    "fit_warmup": "procedures.warmup.fit",
    "fleet_status": "fleet.run",
    "guess_layout": "readers.guess",
    "join_recordings": "readers.streams",
    "load": "procedures.registry",
    "load_manifest": "procedures.centrifuge.manifest",
    "merge_array": "procedures.gyro_array.public",
    "normal_gravity": "gravity",
    "plan_centrifuge": "procedures.centrifuge.plan",
    "plan_imus": "procedures.gyro_array.imus.plan",
    "plan_noise": "procedures.noise.plan",
    "plan_rate": "procedures.rate.plan",
    "plan_tumble": "procedures.tumble.plan",
    "plan_thermal": "procedures.thermal.plan",
    "plan_ramp": "procedures.thermal.plan_ramp",
    "plan_warmup": "procedures.warmup.plan",
    "read": "readers",
    "read_blocks": "readers",
    "simulate_centrifuge": "procedures.centrifuge.simulate",
    "simulate_fleet": "procedures.tumble.simulate",
    "simulate_noise": "procedures.noise.simulate",
    "simulate_power_cycle": "procedures.warmup.simulate",
    "simulate_rate": "procedures.rate.simulate",
    "simulate_thermal": "procedures.thermal.simulate",
    "simulate_tumble": "procedures.tumble.simulate",
    "simulate_warmup": "procedures.warmup.simulate",
    "warmup_table": "procedures.warmup.spreadsheet",
    "write": "writers",
    "write_certificate": "certificate.issue",
    "write_csv": "writers",
    "write_fleet_certificates": "certificate.issue",
    "write_fleet_report": "fleet.report",
    "write_report": "procedures.views",
}

__all__ = ["__version__", *_HOME]


def _views() -> Views:
    """Return the functions that show, apply and export recordings and records; their methods call them."""
    from imulab.procedures import views

    return views


hand_down(_views)


def __getattr__(name: str) -> Any:
    """Import public names when they are first used, so that ``import imulab`` costs nothing."""
    if name not in _HOME:
        from imulab.errors import meant

        hint = "" if name.startswith("_") else meant(_HOME, name)
        raise AttributeError(f"module 'imulab' has no attribute {name!r}{hint}")
    value = getattr(import_module(f"imulab.{_HOME[name]}"), name)
    if not isinstance(value, type):
        from imulab.arguments import checked

        value = checked(value)
        value.__module__ = __name__  # where pickle finds it
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)

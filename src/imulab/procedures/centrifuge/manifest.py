"""The manifest of a centrifuge test: which file was recorded at which level, and what such a test measures.

A line at the phase chi is written as the complex number ``Z = A + i B`` for ``A cos chi + B sin chi``. chi is the angle
from the X input axis to the specific force, turning from X to Y: ``arg Z`` is the direction of the largest drift in the
gyroscope's frame. A vector fixed in the arm reaches Y a quarter turn after X: Y shows ``i Z`` where X shows ``Z``.

The file is TOML; its keys are those of docs/centrifuge.md. An unknown key is refused by name, so that misspelt keys do
not pass.

Source: CN102636185A; IEEE Std 813 (two-axis gyroscopes), IEEE Std 836 (precision centrifuge), IEEE Std 528.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from imulab.errors import ReadError, UnitError, file_name
from imulab.files import check_keys, load_toml, number_of, scale_factor_of, unit_of
from imulab.recording import Array
from imulab.units import STANDARD_GRAVITY, from_si, to_si

# Specific force, the drift K(a) a, and the names of its parameters.


Force = TypeVar("Force", float, Array)

K_UNIT = "rad/s/(m/s^2)"
CURVE_UNITS = {"K0": K_UNIT, "c1": "1/(m/s^2)", "c2": "1/(m/s^2)^2"}
CROSS_UNIT = "rad/s/(m/s^2)^2"


def specific_force(arm_rate: float, radius: float) -> float:
    """Return the specific force ``a = w^2 R``, m/s^2, of an arm rate, rad/s, at a radius, m."""
    return arm_rate**2 * radius


def curve(force: Force, K0: float, c1: float = 0.0, c2: float = 0.0) -> Force:
    """Return ``K(a) = K0 (1 + c1 a + c2 a^2)``, rad/s/(m/s^2), at specific forces, m/s^2."""
    return K0 * (1 + (c1 + c2 * force) * force)


def fog_share(axes: int) -> np.ndarray:
    """Return the matrix from the lines of (X, [Y,] FOG) to those of the residuals (X - FOG, [Y - i FOG])."""
    return np.array([[1, 0, -1], [0, 1, -1j]] if axes == 2 else [[1, -1]], dtype=np.complex128)


def real_covariance(covariance: np.ndarray) -> Array:
    """Return the covariance of (Re z_1, Im z_1, Re z_2, ...) of circular complex numbers with ``E[z z*] = covariance``.

    Circular: the noise has no preferred phase, so that both components have the same variance.
    """
    size = len(covariance)
    real = np.empty((2 * size, 2 * size))
    real[0::2, 0::2] = real[1::2, 1::2] = covariance.real / 2
    real[1::2, 0::2] = covariance.imag / 2
    real[0::2, 1::2] = -covariance.imag / 2
    return real


# Entries of a manifest: quantities and windows. A wrong one is refused with its place.


Window = tuple[float | None, float | None]
"""First and last time of a part of a file, s; None for no bound."""


def quantity_of(entry: Any, key: str, kind: str, name: str) -> tuple[float, float]:
    """Return value and standard uncertainty of ``{ value, standard_uncertainty, unit }`` in SI."""
    place = f"{name}: {key}"
    if not isinstance(entry, dict) or not {"value", "unit"} <= set(entry):
        raise ReadError(f"{place}: expected {example(key)}, found {entry!r}")
    check_keys(entry, ("value", "unit", "standard_uncertainty") if key == "radius" else ("value", "unit"), place)
    unit = unit_of(entry["unit"], kind, place)
    value = to_si(number_of(entry["value"], place), unit)
    uncertainty = to_si(number_of(entry.get("standard_uncertainty", 0.0), place), unit)
    if not value > 0:
        raise ReadError(f"{place} {entry['value']!r}: expected more than 0")
    if uncertainty < 0:
        raise ReadError(f"{place}: standard_uncertainty {entry['standard_uncertainty']!r}: expected 0 or more")
    return value, uncertainty


def example(key: str) -> str:
    """Return an example of a key of a manifest, for messages."""
    return {
        "radius": 'radius = { value = 2.0, standard_uncertainty = 2e-5, unit = "m" }',
        "gravity": 'gravity = { value = 9.8015, unit = "m/s^2" }',
        "rates": 'rates = { unit = "deg/s", standard_uncertainty = 0.0005 }',
        "reference": 'reference = { value = 1.0, unit = "g" }',
        "scale_factor": 'fog = { value = 1250.0, unit = "count/(deg/s)" }',
        "run": "tables [[run]], one for each file",
    }[key]


def window_text(window: Window) -> str:
    """Return a window as it stands in a manifest, FROM:TO in seconds."""
    return ":".join("" if end is None else f"{end:.12g}" for end in window)


def overlap(first_window: Window, other: Window) -> bool:
    """Return whether two windows share more than a bound; a window overlaps itself unless it is empty."""

    def ends(window: Window) -> tuple[float, float]:
        first, last = window
        return (-math.inf if first is None else first), (math.inf if last is None else last)

    (first, last), (begin, end) = ends(first_window), ends(other)
    return first < end and begin < last


def window_of(text: Any, place: str) -> Window | None:
    """Return the window of a text FROM:TO in seconds; None without one."""
    if text is None:
        return None
    try:
        first, last = (float(end) if end.strip() else None for end in str(text).split(":"))
    except ValueError:
        first = last = math.nan
    if any(math.isnan(end) for end in (first, last) if end is not None) or not overlap((first, last), (first, last)):
        raise ReadError(f'{place}: window {text!r}: expected FROM:TO in seconds, such as "100:1000", "100:" or ":900"')
    return first, last


# The manifest: runs with their rates, radius, and units.


COLUMNS = ("dtg_x", "dtg_y", "fog")
ROLES = ("static", "loaded")
SPIN_AXES = ("up", "down")
SAME_LEVEL = 1e-3
"""Loaded runs whose arm rates agree within this, relative, are one level."""
_SAME_RATE = 1e-3
"""Lines closer than this part of the net rate cannot be separated by any run."""
_KEYS = ("radius", "gravity", "rates", "reference", "sensor", "scale_factor", "run")
_RUN_KEYS = ("file", "power_cycle", "role", "arm_rate", "table_rate", "sense", "spin_axis", "window")
_REFERENCE = {"value": 1.0, "unit": "g"}


@dataclass(frozen=True)
class Run:
    """One recording of the test; rates are magnitudes, rad/s (0 for a static run), `sense` 1 or -1.

    `window` is the part of the file of this run, from and to, s, either None for no bound; None for the whole file.
    """

    file: str
    power_cycle: int
    role: str
    arm_rate: float = 0.0
    table_rate: float = 0.0
    sense: int = 1
    spin_axis: str = "up"
    window: Window | None = None

    @property
    def label(self) -> str:
        """File, and window where there is one."""
        return self.file if self.window is None else f"{self.file} {window_text(self.window)}"

    @property
    def net_rate(self) -> float:
        """Rate at which the gyroscope turns against the room, rad/s, with the run's sense."""
        return self.sense * (self.arm_rate - self.table_rate)


@dataclass(frozen=True)
class Manifest:
    """A centrifuge test as it was made.

    Attributes
    ----------
    radius, radius_uncertainty
        Arm axis to the centre of the gyroscope, m.
    rate_uncertainty
        Standard uncertainty of every arm rate, independent from run to run, rad/s.
    gravity
        Local gravity, m/s^2; it enters the gravity terms only.
    reference
        Specific force of the level of K_1, m/s^2.
    rate_unit
        Unit of the rates in the file.
    scale_factors
        For columns in count or V: output per rate, and its unit.
    name
        Path of the manifest for messages.
    """

    radius: float
    runs: tuple[Run, ...]
    radius_uncertainty: float = 0.0
    rate_uncertainty: float = 0.0
    gravity: float = STANDARD_GRAVITY
    reference: float = STANDARD_GRAVITY
    rate_unit: str = "deg/s"
    sensor: Mapping[str, str] = field(default_factory=dict)
    scale_factors: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    name: str = "manifest"

    def place(self, index: int) -> str:
        """Return the name of run `index`, counted from 0, in messages: manifest, number from 1, and file."""
        return f"{self.name}: run {index + 1} ({self.runs[index].label})"

    def force(self, run: Run) -> float:
        """Return the specific force of a run, m/s^2."""
        return specific_force(run.arm_rate, self.radius)


def load_manifest(path: str | Path, name: str | None = None) -> Manifest:
    """Read a manifest; `name` is what messages call it, its path if not given.

    Raises
    ------
    ReadError
        The file is missing, is not TOML, or has a key or value that a manifest cannot have.
    UnitError
        A unit is unknown or of another quantity.

    Examples
    --------
    >>> import imulab as il
    >>> il.simulate_centrifuge(levels="1,10", cycles=1, duration="60 s", static_duration="30 s").save("test")
    >>> il.load_manifest("test/manifest.toml").radius
    2.0
    """
    name = name or str(file_name(path))
    table = load_toml(path, name, "manifest")
    return parse_manifest(table, name)


def parse_manifest(table: Mapping[str, Any], name: str) -> Manifest:
    """Return the manifest that a TOML table states; errors as for `load_manifest`."""
    check_keys(table, _KEYS, name)
    for key in ("radius", "rates", "run"):
        if key not in table:
            raise ReadError(f"{name}: no {key}; expected {example(key)}")
    radius, radius_uncertainty = quantity_of(table["radius"], "radius", "length", name)
    gravity, _ = quantity_of(table.get("gravity", _REFERENCE), "gravity", "acceleration", name)
    reference, _ = quantity_of(table.get("reference", _REFERENCE), "reference", "acceleration", name)
    rates = table["rates"]
    if not isinstance(rates, dict) or "unit" not in rates:
        raise ReadError(f"{name}: rates: expected {example('rates')}, found {rates!r}")
    check_keys(rates, ("unit", "standard_uncertainty"), f"{name}: rates")
    rate_unit = unit_of(rates["unit"], "rate", f"{name}: rates")
    rate_uncertainty = to_si(
        number_of(rates.get("standard_uncertainty", 0.0), f"{name}: rates: standard_uncertainty"), rate_unit
    )
    if rate_uncertainty < 0:
        raise ReadError(f"{name}: rates: standard_uncertainty {rates['standard_uncertainty']!r}: expected 0 or more")
    entries = table["run"]
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise ReadError(f"{name}: run: expected tables [[run]], one for each file")
    manifest = Manifest(
        radius=radius,
        runs=tuple(_run(entry, f"{name}: run {number}", rate_unit) for number, entry in enumerate(entries, 1)),
        radius_uncertainty=radius_uncertainty,
        rate_uncertainty=rate_uncertainty,
        gravity=gravity,
        reference=reference,
        rate_unit=rate_unit,
        sensor=_sensor(table.get("sensor", {}), name),
        scale_factors=_scale_factors(table.get("scale_factor", {}), name),
        name=name,
    )
    check_runs(manifest)
    return manifest


def check_runs(manifest: Manifest) -> None:
    """Refuse runs that do not make a test together.

    Raises
    ------
    ReadError
        A file twice without windows that lie apart, no loaded run, a power cycle without static run, lines that
        coincide, no reference run.
    """
    runs_of_file: dict[str, list[int]] = {}
    static = {run.power_cycle for run in manifest.runs if run.role == "static"}
    loaded = [run for run in manifest.runs if run.role == "loaded"]
    for index, run in enumerate(manifest.runs):
        place = manifest.place(index)
        for other in runs_of_file.setdefault(run.file, []):
            if run.window is None or (window := manifest.runs[other].window) is None:
                raise ReadError(
                    f"{place}: the same file as run {other + 1}; expected a file for each run, or a window in each "
                    'run of one file, such as window = "100:1000"'
                )
            if overlap(run.window, window):
                raise ReadError(
                    f"{place}: its window overlaps {window_text(window)} of run {other + 1}; expected windows that "
                    "lie apart"
                )
        runs_of_file[run.file].append(index)
        if run.role != "loaded":
            continue
        if run.power_cycle not in static:
            raise ReadError(
                f'{place}: power cycle {run.power_cycle} has no static run; expected at least one with role = "static"'
            )
        _check_lines(run, place)
    if not loaded:
        raise ReadError(f'{manifest.name}: no run with role = "loaded"')
    _check_reference(manifest)


def _check_lines(run: Run, place: str) -> None:
    net = abs(run.net_rate)
    for times, words in ((1, "equals the net rate"), (2, "is half the net rate")):
        if abs(times * run.table_rate - net) <= _SAME_RATE * net:
            raise ReadError(
                f"{place}: table_rate {_degrees(run.table_rate)} {words} of {_degrees(net)} (arm_rate less table_rate)"
                ": the lines of Earth rate and of specific force coincide; expected another net rate or level"
            )


def _check_reference(manifest: Manifest) -> None:
    def nearest(spin_axes: tuple[str, ...]) -> tuple[int, Run]:
        return min(
            ((i, run) for i, run in enumerate(manifest.runs) if run.role == "loaded" and run.spin_axis in spin_axes),
            key=lambda item: abs(manifest.force(item[1]) - manifest.reference),
        )

    index, reference = nearest(SPIN_AXES)
    if abs(manifest.force(reference) / manifest.reference - 1) > 0.05:
        raise ReadError(
            f"{manifest.place(index)}: no reference run (K_1): expected a loaded run within 5 % of "
            f"{_in_g(manifest.reference)} (reference), the nearest is this one at {_in_g(manifest.force(reference))}"
        )
    for spin_axis in sorted({run.spin_axis for run in manifest.runs if run.role == "loaded"}):
        run_index, run = nearest((spin_axis,))
        if abs(run.arm_rate / reference.arm_rate - 1) > SAME_LEVEL:
            raise ReadError(
                f"{manifest.place(run_index)}: no reference run (K_1) with the spin axis {spin_axis}: expected one at "
                f"{_degrees(reference.arm_rate)} of the arm as in {reference.file}, the nearest is this one at "
                f"{_degrees(run.arm_rate)}"
            )


def _run(entry: Mapping[str, Any], place: str, rate_unit: str) -> Run:
    file = entry.get("file")
    if not isinstance(file, str) or not file:
        raise ReadError(f'{place}: expected file = "NAME.csv", found {file!r}')
    place = f"{place} ({file})"
    check_keys(entry, _RUN_KEYS, place)
    cycle, role = entry.get("power_cycle"), entry.get("role")
    if type(cycle) is not int or cycle < 1:
        raise ReadError(f"{place}: power_cycle: expected a whole number from 1, found {cycle!r}")
    if role not in ROLES:
        raise ReadError(f"{place}: role: expected {' or '.join(ROLES)}, found {role!r}")
    sense, spin_axis = entry.get("sense", 1), entry.get("spin_axis", "up")
    if type(sense) is not int or sense not in (1, -1):
        raise ReadError(f"{place}: sense: expected 1 or -1, found {sense!r}")
    if spin_axis not in SPIN_AXES:
        raise ReadError(f"{place}: spin_axis: expected up or down, found {spin_axis!r}")
    rates = []
    for key in ("arm_rate", "table_rate"):
        if role == "static":
            if entry.get(key, 0) != 0:
                raise ReadError(f"{place}: {key} = {entry[key]!r} in a static run; expected none")
            rates.append(0.0)
            continue
        if key not in entry:
            raise ReadError(f"{place}: no {key}; a loaded run needs arm_rate and table_rate")
        value = number_of(entry[key], f"{place}: {key}")
        if not value > 0:
            raise ReadError(
                f"{place}: {key} = {entry[key]!r}: expected more than 0 (a reversed run has positive rates and "
                "sense = -1)"
            )
        rates.append(to_si(value, rate_unit))
    return Run(file, cycle, str(role), rates[0], rates[1], sense, str(spin_axis), window_of(entry.get("window"), place))


def _sensor(table: Any, name: str) -> dict[str, str]:
    if not isinstance(table, dict) or not all(isinstance(v, str | int | float) for v in table.values()):
        raise ReadError(f'{name}: sensor: expected texts such as serial = "DTG-7"')
    return {key: str(value) for key, value in table.items()}


def _scale_factors(table: Any, name: str) -> dict[str, tuple[float, str]]:
    if not isinstance(table, dict):
        raise ReadError(f"{name}: scale_factor: expected {example('scale_factor')}, found {table!r}")
    check_keys(table, COLUMNS, f"{name}: scale_factor")
    factors = {}
    for key, entry in table.items():
        place = f"{name}: scale_factor: {key}"
        known = scale_factor_of(entry, place, example("scale_factor"))
        if known.measured.quantity != "rate":
            raise UnitError(f"{place}: expected a unit of output per rate, found {entry['unit']!r}")
        factors[key] = (known.value * (1.0 / known.measured.factor), known.output.symbol)
    return factors


def _degrees(rate: float) -> str:
    return f"{from_si(rate, 'deg/s'):.6g} deg/s"


def _in_g(force: float) -> str:
    return f"{from_si(force, 'g'):.4g} g"


def make_manifest(
    *,
    levels: list[float],
    radius: float,
    net_rate: float,
    cycles: int = 1,
    both_senses: bool = False,
    radius_uncertainty: float = 0.0,
    rate_uncertainty: float = 0.0,
    gravity: float = STANDARD_GRAVITY,
    sensor: Mapping[str, str] | None = None,
    name: str = "manifest",
) -> Manifest:
    """Return the manifest of a test at these levels: per power cycle a static run, then every level.

    Parameters
    ----------
    levels
        Specific forces, m/s^2; the lowest is the reference.
    radius, radius_uncertainty
        m.
    net_rate, rate_uncertainty
        rad/s; the table turns at the arm rate less `net_rate`.
    cycles
        Number of power cycles.
    both_senses
        Whether every level is run in both senses.
    """
    runs = []
    for cycle in range(1, cycles + 1):
        runs.append(Run(f"c{cycle}_static.csv", cycle, "static"))
        for force in sorted(levels):
            arm_rate = to_si(round(from_si(math.sqrt(force / radius), "deg/s"), 4), "deg/s")
            label = f"{from_si(force, 'g'):.6g}".replace(".", "p")
            for sense in (1, -1) if both_senses else (1,):
                mark = ("", "", "_reversed")[sense]
                runs.append(Run(f"c{cycle}_{label}g{mark}.csv", cycle, "loaded", arm_rate, arm_rate - net_rate, sense))
    return Manifest(
        radius=radius,
        runs=tuple(runs),
        radius_uncertainty=radius_uncertainty,
        rate_uncertainty=rate_uncertainty,
        gravity=gravity,
        reference=min(levels),
        sensor=sensor or {},
        name=name,
    )


def manifest_text(manifest: Manifest, comments: list[str] | None = None) -> str:
    """Return the manifest as TOML, with comments at its head."""
    unit = manifest.rate_unit
    lines = [f"# {comment}" for comment in comments or []]
    uncertainty = f", standard_uncertainty = {manifest.radius_uncertainty!r}" if manifest.radius_uncertainty else ""
    lines.append(f'radius = {{ value = {manifest.radius!r}{uncertainty}, unit = "m" }}')
    lines.append(f'gravity = {{ value = {manifest.gravity!r}, unit = "m/s^2" }}')
    spread = from_si(manifest.rate_uncertainty, unit)
    lines.append(f'rates = {{ unit = "{unit}"' + (f", standard_uncertainty = {spread:.12g}" if spread else "") + " }")
    lines.append(f'reference = {{ value = {from_si(manifest.reference, "g"):.9g}, unit = "g" }}')
    if manifest.sensor:
        lines += ["", "[sensor]", *(f"{key} = {_quoted(value)}" for key, value in manifest.sensor.items())]
    if manifest.scale_factors:
        lines += ["", "[scale_factor]"]
        for key, (value, output) in manifest.scale_factors.items():
            lines.append(f'{key} = {{ value = {from_si(value, f"{output}/(deg/s)")!r}, unit = "{output}/(deg/s)" }}')
    for run in manifest.runs:
        lines += [
            "",
            "[[run]]",
            f"file = {_quoted(run.file)}",
            f"power_cycle = {run.power_cycle}",
            f'role = "{run.role}"',
        ]
        if run.role == "loaded":
            lines.append(f"arm_rate = {from_si(run.arm_rate, unit):.12g}")
            lines.append(f"table_rate = {from_si(run.table_rate, unit):.12g}")
            lines.append(f"# {_in_g(manifest.force(run))}")
        if run.sense != 1:
            lines.append(f"sense = {run.sense}")
        if run.spin_axis != "up":
            lines.append(f'spin_axis = "{run.spin_axis}"')
        if run.window is not None:
            lines.append(f'window = "{window_text(run.window)}"')
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'

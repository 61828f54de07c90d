"""The sections of a rate record, with types, and the manifest of a rate test.

The manifest is TOML with the keys of docs/rate.md. An unknown key is refused by name, so that a misspelt one does not
pass.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, TypeVar

import numpy as np

from imulab.errors import ReadError, RecordError, file_name, folder_in_place, quoted
from imulab.files import check_keys, load_toml, number_of, unit_of, value_and_unit
from imulab.procedures.rate import AXES, MOUNTINGS
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.sections import Measured, Part, Quantity, Size, part
from imulab.units import from_si, to_si

# The record.


T = TypeVar("T")
Direction: TypeAlias = Literal["rising", "falling", "turning"]
PerDwell = Annotated[list[T], "dwells"]
PerTurn = Annotated[list[T], "turns"]


class TurnsModel(Part):
    """``model`` of turns."""

    gyro_order: int
    gyro_output_unit: str
    axes: str
    from_: str


class RateModel(TurnsModel):
    """``model``."""

    frame: str
    largest_rate: Quantity
    temperature: Quantity | None = None


class ModelSection(Part):
    """The section that records of steps and of turns share."""

    model: RateModel


class AxisFit(Part):
    """One of ``fit.axes``."""

    probability: Size
    by_noise: Size
    loop: Size | None
    fitted_loop: float | None
    fitted_loop_uncertainty: Size | None
    repeatability: Size | None
    repeatability_by_noise: Size | None
    by_polynomial: Size
    order: int
    scatter: Size


class SweptRun(Part):
    """One of ``fit.sweeps``; s and Hz."""

    file: str
    axis: str
    frequency: Size | None
    delay: float
    delay_uncertainty: Size
    bandwidth: Size | None
    bandwidth_uncertainty: Size | None
    bandwidth_beyond: Size | None


class PriorParameter(Part):
    """One parameter of ``fit.prior``: by the prior, and by the test without it."""

    prior: Measured
    test: Measured


class RatePrior(Part):
    """``fit.prior``: the parameters that both records hold, by each alone."""

    probability: Size | None
    parameters: dict[str, PriorParameter]


class RateSummary(Part):
    """``fit``."""

    runs: int
    dwells: int
    rates_from: str
    chi_square: Size
    degrees_of_freedom: float
    between_runs: Size
    table_uncertainty: Size | None
    rate_uncertainty: Quantity
    proportional_uncertainty: Size
    mounting_uncertainty: Size | None
    latitude: float | None
    axes: dict[str, AxisFit]
    sweeps: list[SweptRun] | None = None
    prior: RatePrior | None = None


class DwellResiduals(Part):
    """``data.dwells``: gyroscope, rate, rad/s, and residual of the line, a fraction of the largest rate."""

    axis: PerDwell[str]
    rate: PerDwell[float]
    residual: PerDwell[float]
    standard_uncertainty: PerDwell[float]
    direction: PerDwell[Direction]


class RateEvidence(Part):
    """``data``."""

    dwells: DwellResiduals


class TurnsSummary(Part):
    """``fit`` of turns; the fence in rad, the clock's relative uncertainty."""

    turns: int
    fence: Quantity
    clock: Size | None
    prior: RatePrior | None = None


class WholeTurns(Part):
    """``data.turns``; angles in rad."""

    axis: PerTurn[str]
    start: PerTurn[float]
    stop: PerTurn[float]
    count: PerTurn[float]
    angle: PerTurn[float]
    residual: PerTurn[float]
    standard_uncertainty: PerTurn[float]


class TurnsEvidence(Part):
    """``data`` of turns."""

    turns: WholeTurns


class TurnsRecord(Part):
    """A record of turns."""

    model: TurnsModel
    fit: TurnsSummary
    data: TurnsEvidence


class RateRecord(Part):
    """A rate record."""

    model: RateModel
    fit: RateSummary
    data: RateEvidence


def check(record: Calibration) -> None:
    """Check the sections of a record as it is read from its file; raises RecordError."""
    if record.model.get("from") == "turns":
        part(record, TurnsRecord)
    else:
        part(record, RateRecord)
    axes = model_of(record).axes
    if not axes or any(axis not in AXES for axis in axes) or len(set(axes)) < len(axes):
        raise RecordError(f"model.axes: expected axes such as xyz, found {axes!r}")


def model_of(record: Calibration) -> RateModel:
    """Return the model of a record of steps or of turns; errors as for `rate_of`."""
    return part(record, ModelSection).model


def rate_of(record: Calibration) -> RateRecord:
    """Return the sections of a record; raises RecordError for a wrong part, for a missing one when it is asked for."""
    return part(record, RateRecord)


def turns_of(record: Calibration) -> TurnsRecord:
    """Return the sections of a record of turns; errors as for `rate_of`."""
    return part(record, TurnsRecord)


# The manifest: which file was recorded with which body axis along the table's, at which rates.


_KEYS = ("rates", "mounting", "latitude", "sensor", "run")
_RATES = 'rates = { unit = "deg/s", relative_standard_uncertainty = 1e-4 }'
_FILL_IN = {
    "relative_uncertainty": "# rates.relative_standard_uncertainty = 1e-4  # fill in: of the table, common to all "
    "rates, such as 1e-5 to 1e-4",
    "mounting_uncertainty": '# mounting = { standard_uncertainty = 0.3, unit = "mrad" }  # fill in: of the table axis '
    "across each face, such as 0.1 to 1 mrad; not used with --accel",
    "latitude": '# latitude = { value = 48.1, unit = "deg" }  # fill in: else the Earth\'s rate stays in the bias',
}
_MOUNTING = 'mounting = { standard_uncertainty = 0.3, unit = "mrad" }'


@dataclass(frozen=True)
class Run:
    """One recording: the body axis along the table's (``+z``), and its rates, rad/s, None if recorded.

    `sweep` states that the rate changes all the time; if it is not stated, the recording shows it.
    """

    file: str
    mounting: str
    rates: tuple[float, ...] | None = None
    sweep: bool = False

    @property
    def axis(self) -> int:
        """Number of the body axis along the table's."""
        return AXES.index(self.mounting[1])

    @property
    def sign(self) -> int:
        """1 where that axis points up, -1 where it points down."""
        return 1 if self.mounting[0] == "+" else -1


@dataclass(frozen=True)
class RateTest:
    """A rate test as it was run.

    Attributes
    ----------
    runs
        The recordings.
    relative_uncertainty
        Standard uncertainty that all rates have in common, a fraction; None where the manifest does not state it.
    rate_uncertainty
        Standard uncertainty of each commanded rate, the same error at every visit, rad/s.
    proportional_uncertainty
        Further standard uncertainty of each commanded rate, a fraction of it.
    mounting_uncertainty
        Standard uncertainty of the table axis across each face, rad; None where the manifest does not state it.
    latitude
        Latitude, rad; None where the manifest does not state it.
    """

    runs: tuple[Run, ...]
    relative_uncertainty: float | None = None
    rate_uncertainty: float = 0.0
    mounting_uncertainty: float | None = None
    latitude: float | None = None
    sensor: Mapping[str, str] = field(default_factory=dict)
    name: str = "test"
    proportional_uncertainty: float = 0.0

    def rate_spread(self, rate: Array) -> Array:
        """Return the standard uncertainty of single commanded rates, rad/s, shape (n,); 0 for a table at rest."""
        return np.where(rate == 0, 0.0, np.hypot(self.rate_uncertainty, self.proportional_uncertainty * rate))

    def place(self, index: int) -> str:
        """Return the name of run `index`, counted from 0, for messages."""
        run = self.runs[index]
        return f"{run.file} ({run.mounting} along the table axis)"


def load_test(path: str | Path, name: str | None = None) -> RateTest:
    """Return the test of a manifest; `name` is what messages call it.

    Raises
    ------
    ReadError
        The file is missing, is not TOML, or has a key or value that a manifest cannot have.
    UnitError
        A unit is unknown or of another quantity.
    """
    name = name or str(file_name(path))
    table = load_toml(path, name, "manifest")
    check_keys(table, _KEYS, name)
    rates = table.get("rates", {"unit": "deg/s"})
    if not isinstance(rates, dict) or "unit" not in rates:
        raise ReadError(f"{name}: rates: expected {_RATES}, found {quoted(rates)}")
    sizes = ("relative_standard_uncertainty", "standard_uncertainty", "proportional_standard_uncertainty")
    check_keys(rates, ("unit", *sizes), f"{name}: rates")
    unit = unit_of(rates["unit"], "rate", f"{name}: rates")
    relative, each, part = (
        None if key not in rates else _read_size(rates[key], f"{name}: rates: {key}") for key in sizes
    )
    entries = table.get("run")
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise ReadError(f"{name}: run: expected tables [[run]], one for each file")
    sensor = table.get("sensor", {})
    if not isinstance(sensor, dict) or not all(isinstance(value, str | int | float) for value in sensor.values()):
        raise ReadError(f'{name}: sensor: expected texts such as serial = "SN42"')
    return RateTest(
        runs=tuple(_read_run(entry, f"{name}: run {number}", unit) for number, entry in enumerate(entries, 1)),
        relative_uncertainty=relative,
        rate_uncertainty=to_si(each or 0.0, unit),
        mounting_uncertainty=_read_mounting(table.get("mounting"), f"{name}: mounting"),
        latitude=_read_latitude(table.get("latitude"), f"{name}: latitude"),
        sensor={key: str(value) for key, value in sensor.items()},
        name=name,
        proportional_uncertainty=part or 0.0,
    )


def refuse_folder(path: Path, name: str) -> None:
    """Refuse a folder with a manifest in place of a recording.

    Raises
    ------
    ReadError
        It is one; the message names the manifest.
    """
    manifests = [each.name for each in path.glob("*.toml")] if path.is_dir() else []
    if manifests:
        raise ReadError(folder_in_place(name, "a manifest or one recording", manifests))


def _read_size(value: Any, place: str) -> float:
    number = number_of(value, place)
    if number < 0:
        raise ReadError(f"{place}: expected 0 or more, found {value!r}")
    return number


def _read_mounting(entry: Any, place: str) -> float | None:
    if entry is None:
        return None
    if not isinstance(entry, dict) or set(entry) != {"standard_uncertainty", "unit"}:
        raise ReadError(f"{place}: expected {_MOUNTING}, found {quoted(entry)}")
    unit = unit_of(entry["unit"], "angle", place)
    return to_si(_read_size(entry["standard_uncertainty"], place), unit)


def _read_latitude(entry: Any, place: str) -> float | None:
    if entry is None:
        return None
    value, unit = value_and_unit(entry, place, 'latitude = { value = 48.1, unit = "deg" }')
    latitude = to_si(value, unit_of(unit, "angle", place))
    if abs(latitude) > math.pi / 2:
        raise ReadError(f"{place}: expected -90 to 90 deg, found {value:g} {unit}")
    return latitude


def _read_run(entry: Mapping[str, Any], place: str, unit: str) -> Run:
    file, mounting, rates = entry.get("file"), entry.get("mounting"), entry.get("rates")
    if not isinstance(file, str) or not file:
        raise ReadError(f'{place}: expected file = "NAME.csv", found {quoted(file)}')
    check_keys(entry, ("file", "mounting", "rates", "sweep"), f"{place} ({file})")
    if mounting not in MOUNTINGS:
        raise ReadError(f"{place} ({file}): mounting: expected one of {' '.join(MOUNTINGS)}, found {quoted(mounting)}")
    sweep = entry.get("sweep", False)
    if not isinstance(sweep, bool) or (sweep and rates is not None):
        raise ReadError(
            f"{place} ({file}): sweep: expected true or false, and no rates beside true, found {quoted(sweep)}"
        )
    if rates is None:
        return Run(file, str(mounting), sweep=sweep)
    if not isinstance(rates, list) or len(set(map(str, rates))) < 2:
        raise ReadError(f"{place} ({file}): rates: expected a list of two rates or more, found {quoted(rates)}")
    numbers = tuple(to_si(number_of(rate, f"{place} ({file}): rates"), unit) for rate in rates)
    return Run(file, str(mounting), numbers)


def manifest_text(test: RateTest, comments: Sequence[str] = (), to_fill_in: bool = False) -> str:
    """Return the manifest of a test as TOML, rates in deg/s, under lines of comment.

    Keys that the test does not state are left out, or with `to_fill_in` written as comments with usual values.
    """
    parts = ['unit = "deg/s"']
    if test.relative_uncertainty is not None:
        parts.append(f"relative_standard_uncertainty = {test.relative_uncertainty!r}")
    if test.rate_uncertainty:
        parts.append(f"standard_uncertainty = {from_si(test.rate_uncertainty, 'deg/s'):.9g}")
    if test.proportional_uncertainty:
        parts.append(f"proportional_standard_uncertainty = {test.proportional_uncertainty!r}")
    # a key a line, since TOML lets no inline table go over several, and one can be filled in alone
    lines = [*(f"# {comment}" for comment in comments), *(f"rates.{part}" for part in parts)]
    if to_fill_in and test.relative_uncertainty is None:
        lines.append(_FILL_IN["relative_uncertainty"])
    if test.mounting_uncertainty is not None:
        lines.append(f'mounting = {{ standard_uncertainty = {1e3 * test.mounting_uncertainty:.9g}, unit = "mrad" }}')
    elif to_fill_in:
        lines.append(_FILL_IN["mounting_uncertainty"])
    if test.latitude is not None:
        lines.append(f'latitude = {{ value = {from_si(test.latitude, "deg"):.9g}, unit = "deg" }}')
    elif to_fill_in:
        lines.append(_FILL_IN["latitude"])
    for run in test.runs:
        lines += ["", "[[run]]", f'file = "{run.file}"', f'mounting = "{run.mounting}"']
        if run.rates is not None:
            listed_rates = ", ".join(f"{from_si(rate, 'deg/s'):.9g}" for rate in run.rates)
            lines.append(f"rates = [{listed_rates}]")
        if run.sweep:
            lines.append("sweep = true")
    return "\n".join(lines) + "\n"

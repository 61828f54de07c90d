"""The warm-up table as CSV for spreadsheets, which reads back to the last bit."""

from __future__ import annotations

import csv
import io
import os
from dataclasses import dataclass
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from imulab.device.unit import is_blob
from imulab.display import Finding, Shown
from imulab.errors import OptionError, ReadError, RecordError, UnitError, listed
from imulab.files import open_file, write_text
from imulab.procedures.result import Record, as_record
from imulab.procedures.warmup import MODELS
from imulab.procedures.warmup.model import WarmupTable, amplitude_slopes, check_table, record_table
from imulab.records import is_json
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.units import conversion_factor, si_unit

_CUBIC = ("interval-cubic", "knot-cubic")


@dataclass(frozen=True, repr=False)
class TableSheet(Shown):
    """The table of a warm-up record as CSV, and the record.

    Attributes
    ----------
    text
        Text of the CSV file.
    record
        The stated record, or one that holds the stated table.
    """

    text: str
    record: Calibration

    @property
    def rows(self) -> list[list[str]]:
        """Titles, then a row for each interval or knot and axis."""
        return [line.split(",") for line in self.text.splitlines() if not line.startswith("#")]

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return the settings and the rows."""
        titles, *rows = self.rows
        head = ", ".join(line.removeprefix("# ") for line in self.text.splitlines() if line.startswith("#"))
        return f"warm-up table: {head}", titles, rows

    def save(self, path: str | Path) -> None:
        """Write the table where the name ends in .csv, else the record.

        Raises
        ------
        OptionError
            The file cannot be written.
        """
        if str(path).lower().endswith(".csv"):
            write_text(path, self.text)
        else:
            self.record.save(path)


def warmup_table(data: Record, *, per_second: bool = False) -> TableSheet:
    """Return the table of a warm-up record as CSV, or a record made of such a table, which was edited.

    Parameters
    ----------
    data
        A warm-up record, its file, or the CSV file of a table.
    per_second
        Write cubics in powers of t in s, not of t / settling time.

    Raises
    ------
    RecordError, ReadError
        The file is neither, or the record is of another procedure.
    OptionError
        The table is no cubic in t, which has no powers of t.

    Examples
    --------
    >>> import imulab as il
    >>> cycles = il.simulate_warmup([-40, 0, 60], cycles=2)
    >>> fit = il.fit_warmup(cycles, temperatures=(-40, 0, 60), model="knot-cubic")
    >>> sheet = il.warmup_table(fit.calibration, per_second=True)
    >>> sheet.rows[0][:4]
    ['temperature [degC]', 'axis', 'unit', 'c0']
    >>> sheet.save("table.csv")
    >>> il.warmup_table("table.csv").record.procedure
    'warmup'
    """
    if not isinstance(data, Calibration):
        file = os.fspath(data) if isinstance(data, str | PathLike) else None
        if file is not None and not (is_json(file) or is_blob(file)):  # a blob is refused as a record, with the reason
            made = make_table_record(read_table(file), file)
            return TableSheet(write_table(made, per_second=per_second), made)
        data = as_record(data, "warmup_table")
    return TableSheet(write_table(data, per_second=per_second), data)


def write_table(record: Calibration, *, per_second: bool = False) -> str:
    """Return the table of a record as CSV: settings as ``# key: value``, then a row for each interval or knot and axis.

    Coefficients of cubics belong to powers of ``t / T_M``; with `per_second`, to powers of t in s, as the titles say.

    Raises
    ------
    RecordError
        The record is no warm-up record.
    OptionError
        The table is no cubic in t, which has no powers of t.
    """
    if record.procedure != "warmup":
        raise RecordError(f"a {record.procedure} record has no warm-up table")
    table = record_table(record)
    interval = table.model == "interval-cubic"
    settings: dict[str, str] = {
        "model": table.model,
        "settling_time": f"{table.settling_time!r} s",
        "exit": table.exit,
        "taper_time": f"{table.taper_time!r} s",
    }
    if table.beyond != "zero":
        settings["beyond"] = table.beyond
    if table.tolerance:
        settings["tolerance"] = f"{table.tolerance!r} K"
    if table.time_scale is not None:
        settings["time_scale"] = f"{table.time_scale!r} s"
    if table.time_constants:
        settings["time_constants"] = " ".join(map(repr, table.time_constants)) + " s"
    if "serial" in record.sensor:
        settings["serial"] = record.sensor["serial"]
    coefficients = table.coefficients
    if per_second:
        if table.model not in _CUBIC:
            raise OptionError(
                f"per_second: a table of model {table.model} has no powers of t; expected one of {' '.join(_CUBIC)}"
            )
        coefficients = coefficients / table.settling_time ** np.arange(4)
    titles = _titles(table.model, table.coefficients.shape[2], per_second)
    lines = [f"# {key}: {value}" for key, value in settings.items()] + [",".join(titles)]
    edges = table.temperatures.tolist()
    for r, block in enumerate(coefficients.tolist()):
        place = edges[r : r + 2] if interval else edges[r : r + 1]
        for axis, unit, row in zip(table.axes, table.units, block, strict=True):
            lines.append(",".join([*map(repr, place), axis, unit, *map(repr, row)]))
    return "\n".join(lines) + "\n"


def _titles(model: str, size: int, per_second: bool = False) -> list[str]:
    places = ["from [degC]", "to [degC]"] if model == "interval-cubic" else ["temperature [degC]"]
    terms = [f"A{j + 1}" if model == "exponential" else f"c{j}" for j in range(size)]
    if per_second:
        terms = ["c0", "c1 [1/s]", "c2 [1/s^2]", "c3 [1/s^3]"]
    return [*places, "axis", "unit", *terms]


def read_table(path: str | Path) -> tuple[WarmupTable, str | None]:
    """Return a table from CSV in either form that `write_table` makes, and the serial number in its head.

    The unit of a row may be any of its kind (deg/h for a rate); it is converted. Slopes of exponential amplitudes
    are computed anew.

    Raises
    ------
    ReadError
        The file is no such table; the message names the line.
    """
    try:
        with open_file(path) as stream:
            text = stream.read().decode("utf-8-sig")
    except FileNotFoundError:
        raise ReadError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ReadError(f"{path}: cannot be read as text: {error}") from None
    settings: dict[str, str] = {}
    rows: list[tuple[int, list[str]]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip().strip('"').rstrip(",").strip()
        if stripped.startswith("#"):
            key, colon, value = stripped.lstrip("# ").partition(":")
            if colon:
                settings[key.strip()] = value.strip()
        elif stripped:
            rows.append((number, [cell.strip() for cell in next(csv.reader(io.StringIO(line)))]))
    table = _table(str(path), settings, rows)
    try:
        check_table(table)
    except RecordError as error:
        raise ReadError(f"{path}: {error}") from None
    return table, settings.get("serial")


def _table(path: str, settings: dict[str, str], rows: list[tuple[int, list[str]]]) -> WarmupTable:
    model = settings.get("model", "")
    if model not in MODELS:
        raise ReadError(f"{path}: '# model: {model}': expected one of {listed(MODELS, model)}")
    if len(rows) < 2:
        raise ReadError(f"{path}: expected a line of titles and rows of coefficients")
    interval = model == "interval-cubic"
    constants = tuple(_seconds(path, settings, "time_constants")) if model == "exponential" else ()
    size = len(constants) or 4
    lead = 2 if interval else 1
    number, titles = rows[0]
    expected = _titles(model, size)
    per_second = model in _CUBIC and titles == _titles(model, size, True)
    if titles != expected and not per_second:
        raise ReadError(f"{path}: line {number}: expected the titles {','.join(expected)}, found {','.join(titles)}")
    units, blocks = _read_rows(path, rows[1:], lead, size)
    order = sorted(blocks)
    if interval:
        for left, right in pairwise(order):
            if left[1] != right[0]:
                raise ReadError(f"{path}: intervals end at {left[1]:g} and go on at {right[0]:g} degC: expected no gap")
        temperatures = np.array([order[0][0], *(at[1] for at in order)])
    else:
        temperatures = np.array([at[0] for at in order])
    values = np.array([[blocks[at][axis] for axis in units] for at in order])
    settling_time = _seconds(path, settings, "settling_time")[0]
    if per_second:
        values = values * settling_time ** np.arange(4)
    slopes = None
    if model == "exponential" and len(temperatures) > 1:
        slopes = amplitude_slopes(temperatures, values, constants)
    return WarmupTable(
        model=model,
        temperatures=temperatures,
        axes=tuple(units),
        units=tuple(units.values()),
        coefficients=values,
        settling_time=settling_time,
        exit=settings.get("exit", "zero"),
        beyond=settings.get("beyond", "zero"),
        tolerance=_numbers(path, settings, "tolerance", "K")[0] if "tolerance" in settings else 0.0,
        taper_time=_seconds(path, settings, "taper_time")[0] if "taper_time" in settings else 60.0,
        time_scale=_seconds(path, settings, "time_scale")[0] if model == "knot-log-cubic" else None,
        time_constants=constants,
        slopes=slopes,
    )


def _read_rows(
    path: str, rows: list[tuple[int, list[str]]], lead: int, size: int
) -> tuple[dict[str, str], dict[tuple[float, ...], dict[str, list[float]]]]:
    """Return the SI unit of each axis, and the coefficients in SI of each interval or knot and axis."""
    units: dict[str, str] = {}
    blocks: dict[tuple[float, ...], dict[str, list[float]]] = {}
    for number, cells in rows:
        place = f"{path}: line {number}"
        if len(cells) != lead + 2 + size:
            raise ReadError(f"{place}: expected {lead + 2 + size} fields, found {len(cells)}")
        at = tuple(_value(place, cell) for cell in cells[:lead])
        axis, unit = cells[lead : lead + 2]
        try:
            si = si_unit(unit)
            factor = conversion_factor(unit, si)
        except UnitError as error:
            raise ReadError(f"{place}: {error}") from None
        if units.setdefault(axis, si) != si:
            raise ReadError(f"{place}: {axis} in {unit}, but in {units[axis]} above")
        block = blocks.setdefault(at, {})
        if axis in block:
            raise ReadError(f"{place}: {axis} at {' to '.join(f'{t:g}' for t in at)} degC appears twice")
        block[axis] = [_value(place, cell) * factor for cell in cells[lead + 2 :]]
    for at in sorted(blocks):
        missing = [axis for axis in units if axis not in blocks[at]]
        if missing:
            raise ReadError(f"{path}: no row for {missing[0]} at {' to '.join(f'{t:g}' for t in at)} degC")
    return units, blocks


def _seconds(path: str, settings: dict[str, str], key: str) -> list[float]:
    return _numbers(path, settings, key, "s")


def _numbers(path: str, settings: dict[str, str], key: str, unit: str) -> list[float]:
    text = settings.get(key, "")
    try:
        values = [float(part) for part in text.removesuffix(unit).split()]
    except ValueError:
        values = []
    if not values:
        raise ReadError(f"{path}: '# {key}: {text}': expected a number of {'seconds' if unit == 's' else unit}")
    return values


def _value(place: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ReadError(f"{place}: expected a number, found {text!r}")
    return value


def make_table_record(read: tuple[WarmupTable, str | None], file: str) -> Calibration:
    """Return a record that holds an edited table; it has no uncertainties."""
    from hashlib import file_digest

    from imulab.recording import Source

    table, serial = read
    with open_file(file) as stream:
        digest = file_digest(stream, "sha256").hexdigest()
    model: dict[str, Any] = {
        "model": table.model,
        "settling_time": {"value": table.settling_time, "unit": "s", "from": "table"},
    }
    return Calibration(
        procedure="warmup",
        parameters={"settling_time": Parameter(table.settling_time, None, "s")},
        covariance=Covariance((), ()),
        model=model,
        fit={},
        options={},
        sensor={"serial": serial} if serial else {},
        sources=(Source(file, digest),),
        warnings=(
            Finding(
                "made from an edited table: no uncertainties, and no test data behind it",
                "apply it to a fresh power cycle and look at what is left (imulab apply)",
            ),
        ),
        sections={"table": table.to_section()},
    )

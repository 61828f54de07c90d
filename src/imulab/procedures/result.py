"""The base classes of results of fits, plans and checks, and their input data as recordings."""

from __future__ import annotations

import hashlib
import inspect
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeAlias, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imulab._version import VERSION
from imulab.arguments import check, checked, described, types_of, unknown_options
from imulab.display import Bad, Finding, Note, Shown, Verdict, aligned, verdict_of
from imulab.errors import DataError, OptionError
from imulab.estimation.sampling import mend_stamps
from imulab.files import open_file, write_page
from imulab.frames import columns_of_arrays, is_frame, unmasked
from imulab.options import file
from imulab.readers import read, read_blocks
from imulab.readers.selection import Selection
from imulab.readers.streams import on_clock_of, one_clock
from imulab.recording import Data, Reading, Recording, Sampling, Source, Window, joined
from imulab.records.calibration import Calibration, Parameter
from imulab.report import render_page, render_plan
from imulab.report.traces import Exhibits, Figure, ReportTable
from imulab.writers import write_csv

if TYPE_CHECKING:
    from typing import Unpack

    import pandas
    import polars

    from imulab.recording import Array
    from imulab.report.plots import Plot, Plots
    from imulab.views import AnyPlot, AnyPlots


# Results of fits.


class Result:
    """A fit: its ``calibration`` is the record, and every method is the record's own."""

    calibration: Calibration

    def __repr__(self) -> str:
        return f"{type(self).__name__} with a {self.calibration!r}"

    def _repr_html_(self) -> str:
        return self.calibration._repr_html_()

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """The parameters of the record, by name."""
        return self.calibration.parameters

    @property
    def verdict(self) -> Verdict:
        """Whether the result may be used, with reasons and what to do next."""
        return self.calibration.verdict

    @checked
    def save(self, path: str | Path) -> None:
        """Write the record; errors as for `Calibration.save`."""
        self.calibration.save(path)

    @checked
    def report(self, path: str | Path) -> None:
        """Write the report; errors as for `Calibration.report`."""
        self.calibration.report(path)

    @overload
    def plot(self, name: None = None) -> AnyPlots: ...
    @overload
    def plot(self, name: str | int) -> AnyPlot: ...
    @checked
    def plot(self, name: str | int | None = None) -> AnyPlots | AnyPlot:
        """Return the report's figures, or one of them; see `Calibration.plot`."""
        return self.calibration.plot(name)

    @overload
    def to_frame(self, library: Literal["pandas"] | None = None) -> pandas.DataFrame: ...
    @overload
    def to_frame(self, library: Literal["polars"]) -> polars.DataFrame: ...
    @checked
    def to_frame(self, library: str | None = None) -> pandas.DataFrame | polars.DataFrame:
        """Return the parameters as a data frame; see `Calibration.to_frame`."""
        return self.calibration.to_frame(library)  # type: ignore[arg-type]

    def cov(self, *names: str) -> Array:
        """Return the covariance; see `Calibration.cov`."""
        return self.calibration.cov(*names)

    @checked
    def apply(
        self,
        data: Data,
        *,
        again: bool = False,
        heading: bool | str = False,
        latest_start: float | str = "5 s",
        temperature_column: bool = False,
        **reading: Unpack[Reading],
    ) -> Any:
        """Return data corrected by the record, of a data frame a data frame; see `Calibration.apply`."""
        return self.calibration.apply(
            data, again=again, heading=heading, latest_start=latest_start, temperature_column=temperature_column,
            **reading,
        )  # fmt: skip

    @checked
    def export(self, target: str, folder: str | Path, **options: Any) -> list[Path]:
        """Write the record in the form of firmware or another program; see `Calibration.export`."""
        return self.calibration.export(target, folder, **options)


class Drawn(Shown):
    """A result that is no record, shown by the exhibits of its report; `subject` names it."""

    subject: ClassVar[str]

    def exhibits(self) -> Exhibits:
        """Return headline, facts, figures and tables of its report."""
        raise NotImplementedError

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return the headline and the first table."""
        exhibits = self.exhibits()
        table = next((item for item in exhibits.items if isinstance(item, ReportTable)), None)
        return exhibits.headline, *(([], []) if table is None else (table.columns, table.rows))

    @overload
    def plot(self, name: None = None) -> Plots: ...
    @overload
    def plot(self, name: str | int) -> Plot: ...
    @checked
    def plot(self, name: str | int | None = None) -> Plots | Plot:
        """Return the figures, which show themselves in a notebook, or the one whose title has these words.

        Raises
        ------
        OptionError
            There is no such figure; the message lists them.
        """
        from imulab.report.plots import Plots

        exhibits = self.exhibits()
        plots = Plots([item for item in exhibits.items if isinstance(item, Figure)], self.subject)
        return plots if name is None else plots[name]


# Input data: a file, a recording, a data frame, or arrays.


Record: TypeAlias = Annotated[Calibration | Result | str | os.PathLike[str], file("RECORD")]
"""A record, a fit that holds it, or its file."""


_HINTS = types_of(Reading)
_OF_ARRAYS = ("rate", "time", "unit")
_OF_FILES = ("layout", "topic", "instance", "damaged")
_UNITS = ("units",)
_PART = ("window", "element", "serial")
OWN_CLOCKS = "own"
"""What leaves each sensor on its own clock."""
_TITLED = "a file says itself, by its titles or a layout"
_EXPECTED = "a file name, a Recording, a data frame of pandas or polars, or arrays"


def as_recording(
    data: Data,
    reading: Mapping[str, Any] | Reading | Sampling,
    function: Callable[..., Any],
    columns: Callable[[NDArray[Any]], Mapping[str, ArrayLike]] | None = None,
    name: str = "data",
    clock: str | None = None,
) -> Recording:
    """Return data as a recording whose time rises (`mend_stamps`); else as for `as_read`.

    `clock` is the sensor to whose clock all are brought where they have clocks of their own, the fastest if not given;
    `OWN_CLOCKS` leaves them as they are.
    """
    recording = mend_stamps(_own_clocks(data, reading, function, columns, name))
    return recording if clock == OWN_CLOCKS else one_clock(recording, clock)


def as_read(
    data: Data,
    reading: Mapping[str, Any] | Reading | Sampling,
    function: Callable[..., Any],
    columns: Callable[[NDArray[Any]], Mapping[str, ArrayLike]] | None = None,
    name: str = "data",
) -> Recording:
    """Return data as a recording, row by row, on the clock of the fastest sensor.

    Parameters
    ----------
    data
        A file, a recording, a data frame or arrays.
    reading
        Options of how to understand them.
    function
        The public function that was called with them, for messages.
    columns
        Returns the columns, by name, of an array without names; a triad of accelerometers if not given.
    name
        The name of the argument.

    Raises
    ------
    OptionError
        A keyword that the function does not know, or that does not go with such data.
    DataError
        The data are something else; and what reading them raises.
    """
    return one_clock(_own_clocks(data, reading, function, columns, name))


def _own_clocks(
    data: Data,
    reading: Mapping[str, Any] | Reading | Sampling,
    function: Callable[..., Any],
    columns: Callable[[NDArray[Any]], Mapping[str, ArrayLike]] | None,
    name: str,
) -> Recording:
    called = function.__name__
    check_keywords(reading, function)
    stated = {key: value for key, value in reading.items() if value is not None}
    part: dict[str, Any] = {key: stated.get(key) for key in _PART}
    if isinstance(data, str | os.PathLike):
        _refuse(stated, _OF_ARRAYS, called, _TITLED)
        return read(os.fspath(data), **_pick(stated, (*_OF_FILES, *_UNITS)), **part)
    _refuse(stated, _OF_FILES, called, "only files have that")
    if isinstance(data, Recording):
        _refuse(stated, (*_OF_ARRAYS, *_UNITS), called, "a recording has its own")
        return _select_part(data, **part)
    arrays = _pick(stated, ("rate", "unit", "units"))
    if is_frame(data):
        _refuse(stated, ("time",), called, "a data frame has it as the column 'time'")
        return _select_part(Recording.from_frame(data, **arrays), **part)  # type: ignore[arg-type]
    named: Mapping[str, ArrayLike]
    if isinstance(data, Mapping):
        named = data
    else:
        samples = _as_array(data, called, name)
        named = {"accel": samples} if columns is None else columns(samples)
    whole = {"rate": None, "unit": None, "units": None, **arrays, "name": "arrays"}
    return _select_part(
        Recording(*columns_of_arrays({**_pick(stated, ("time",)), **named}, **whole), name="arrays"), **part
    )


def as_blocks(
    data: Data,
    reading: Mapping[str, Any] | Reading | Sampling,
    function: Callable[..., Any],
    name: str = "data",
    clock: str | None = None,
) -> tuple[Iterator[Recording], Source | None]:
    """Return data in blocks, for means over long files, and the source file; else as for `as_recording`."""
    if not isinstance(data, str | os.PathLike):
        whole = as_recording(data, reading, function, name=name, clock=clock)
        return iter((whole,)), whole.source
    check_keywords(reading, function)
    stated = {key: value for key, value in reading.items() if value is not None}
    _refuse(stated, _OF_ARRAYS, function.__name__, _TITLED)
    part = _pick(stated, _PART)
    path, source = Path(data), None
    if path.is_file():
        with open_file(path) as stream:
            source = Source(str(data), hashlib.file_digest(stream, "sha256").hexdigest())
    blocks = read_blocks(path, **_pick(stated, (*_OF_FILES, *_UNITS)), **part)
    return (blocks if clock == OWN_CLOCKS else on_clock_of(blocks, clock)), source


def as_record(record: Record, called: str) -> Calibration:
    """Return a record: that of a fit, or read where its file is named.

    Raises
    ------
    OptionError
        It is neither.
    RecordError
        The file holds none.
    """
    if isinstance(record, Calibration):
        return record
    if isinstance(record, Result):
        return record.calibration
    if isinstance(record, str | os.PathLike):
        return Calibration.load(record)
    raise OptionError(f"{called}: expected a record or the name of its file, found {described(record)}")


def check_keywords(keywords: Mapping[str, Any], function: Callable[..., Any]) -> None:
    """Refuse keywords that a function does not have.

    Raises
    ------
    OptionError
        There is one, and the message suggests the nearest; or an option of reading has another type.
    """
    if not keywords:
        return
    parameters = [p.name for p in inspect.signature(function).parameters.values() if p.kind is not p.VAR_KEYWORD]
    known = dict.fromkeys([*parameters, *Sampling.__annotations__, *Reading.__annotations__])
    if unknown := [key for key in keywords if key not in known]:
        raise OptionError(unknown_options(function.__name__, unknown, known))
    for key in keywords:
        if (hint := _HINTS.get(key)) is not None and keywords[key] is not None:
            check(keywords[key], hint, f"{function.__name__}: {key}")


def _as_array(data: object, called: str, name: str) -> NDArray[Any]:
    """Return samples without a name as an array of numbers."""
    if isinstance(data, np.ndarray | list | tuple) or hasattr(data, "__array__"):
        try:
            samples = unmasked(data)
        except ValueError:
            samples = np.empty(0, dtype=object)
        if samples.dtype.kind in "iufbO" and samples.ndim > 1:
            return samples
        shape = f"an array of shape {samples.shape}" if samples.dtype.kind in "iufb" else "a list of something else"
        raise DataError(f"{called}: {name}: expected an array of numbers, a row for each sample, found {shape}")
    raise DataError(f"{called}: {name}: expected {_EXPECTED}, found {described(data)}")


def _select_part(recording: Recording, window: Window | None, element: int | None, serial: str | None) -> Recording:
    """Return the part of a recording within a window of time, and one IMU of several, with a serial number."""
    if window is None and element is None and serial is None:
        return recording
    parts = list(Selection(window=window, element=element, serial=serial).of(iter([recording]), recording.name))
    if len(parts) == 1:
        return parts[0]
    return joined(parts)


def _refuse(stated: Mapping[str, Any], keys: Iterable[str], called: str, reason: str) -> None:
    """Refuse options that do not go with the kind of data."""
    for key in keys:
        if key in stated:
            raise OptionError(f"{called}: {key} does not go with such data: {reason}")


def _pick(stated: Mapping[str, Any], keys: Iterable[str]) -> dict[str, Any]:
    """Return the stated options among some."""
    return {key: stated[key] for key in keys if key in stated}


# Plans.


def amount(value: float | None, unit: str) -> dict[str, Any]:
    """Return a value with its unit for scripts, null where it is none or not finite."""
    return {"value": finite(value), "unit": unit}


def finite(value: float | None) -> float | None:
    """Return a number, None where it is none or not finite."""
    return value if value is not None and math.isfinite(value) else None


class PlannedTest(Shown):
    """A plan: `shown` gives it in a sentence and a table; text, JSON and warnings of all commands are made here."""

    def tables(self) -> list[tuple[list[str], list[list[str]]]]:
        """Return further tables, titles and rows of each."""
        return []

    def remarks(self) -> list[str]:
        """Return the lines below the tables."""
        return []

    def content(self) -> dict[str, Any]:
        """Return the plan for scripts, in SI."""
        raise NotImplementedError

    def findings(self) -> Sequence[str]:
        """Return warnings about the plan, with what to do."""
        return ()

    def text(self) -> str:
        """Return the plan as a command prints it."""
        lead, titles, rows = self.shown()
        lines = [lead, *aligned(titles, rows)]
        for more, cells in self.tables():
            lines += ["", *aligned(more, cells)]
        return "\n".join([*lines, *self.remarks()])

    no_file: ClassVar[str] = "this plan has no file"
    """Why there is nothing to write of a plan that has no table of attitudes."""

    def save(self, path: str | Path) -> None:
        """Write the plan.

        Raises
        ------
        OptionError
            The file cannot be written, or the plan has none.
        """
        raise OptionError(f"{path}: {self.no_file}; expected the plan without -o")


class PlannedAttitudes(PlannedTest):
    """A plan of attitudes to measure by hand: its table as CSV, and a sheet to print with a picture of each."""

    sheet_title: ClassVar[str]

    @property
    def lead(self) -> str:
        """The plan and its prediction in a few sentences."""
        raise NotImplementedError

    @property
    def predicted(self) -> list[tuple[str, str, str]]:
        """The predicted uncertainties as name, text and unit."""
        raise NotImplementedError

    def recording(self) -> Recording:
        """Return the attitudes as a table."""
        raise NotImplementedError

    def pictures(self) -> list[dict[str, Any]]:
        """Return the pictures of the sheet, one for each attitude."""
        raise NotImplementedError

    def save(self, path: str | Path) -> None:
        """Write the attitudes as CSV, the columns of `recording`.

        Raises
        ------
        OptionError
            The file cannot be written.
        """
        write_csv(self.recording(), path)

    def sheet(self) -> str:
        """Return the sheet to print, a picture for each attitude, as HTML text."""
        return render_plan(self.sheet_title, self.lead, self.pictures(), self.predicted)

    def report(self, path: str | Path) -> None:
        """Write the sheet to print as an HTML file; errors as for `save`."""
        write_page(path, self.sheet())


# Checks of a record by new data.


def columns_as_rows(**columns: Iterable[Any]) -> list[dict[str, Any]]:
    """Return columns of equal length as rows of plain values, for JSON."""
    plain = [np.asarray(list(values)).tolist() for values in columns.values()]
    return [dict(zip(columns, row, strict=True)) for row in zip(*plain, strict=True)]


class RecordCheck(Drawn):
    """A test of a record by new data.

    The class of a procedure states whether it `passed`, what that means, and what was measured; this class makes text,
    JSON and page of it. `data` is the label of a tested file on the page.
    """

    data: ClassVar[str]
    notes: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether the data agree with the record."""
        raise NotImplementedError

    @property
    def verdict(self) -> str:
        """``pass`` or ``fail``."""
        return "pass" if self.passed else "fail"

    def meaning(self) -> str:
        """Return the outcome in a sentence."""
        raise NotImplementedError

    def next_step(self, record: str, files: Sequence[str]) -> str:
        """Return what to do after a failed test."""
        raise NotImplementedError

    def measured(self) -> list[str]:
        """Return what was measured, as lines of text."""
        raise NotImplementedError

    def content(self) -> dict[str, Any]:
        """Return what was measured, for scripts, in SI."""
        raise NotImplementedError

    def stated(self) -> list[tuple[str, str]]:
        """Return stated values beside record and files, as label and value."""
        return []

    def text(self, record: str, files: Sequence[str], verdict: str) -> str:
        """Return the verdict, what to do next, and what was measured; `verdict` may be coloured."""
        step = [] if self.passed else [self.next_step(record, files)]
        return "\n".join([f"{verdict}: {self.meaning()}", *step, *self.measured()])

    def to_json(self, notes: Sequence[str] | None = None) -> dict[str, Any]:
        """Return the same for scripts; `notes` are those of a command instead of its own."""
        kept = self.notes if notes is None else notes
        return {"verdict": self.verdict, **self.content(), "notes": [str(note) for note in kept]}

    def exhibits_with(
        self, facts: list[tuple[str, str]], items: Sequence[Figure | ReportTable], more: str = ""
    ) -> Exhibits:
        """Return exhibits under the common headline of all tests; `more` ends it."""
        return Exhibits(f"{self.verdict.capitalize()}: {self.meaning()}{more}.", facts, list(items))

    def page(self, held: Calibration, record: str, files: Sequence[str], notes: Sequence[str]) -> str:
        """Return the report as HTML text; `held` is the record in the file `record`, `notes` are the command's."""
        failed = [] if self.passed else [Bad(self.meaning()), self.next_step(record, files)]
        return render_page(
            f"{self.subject}: {self.verdict}",
            held.sensor.get("serial", "unit without serial number"),
            self.exhibits(),
            verdict=verdict_of([*failed, *notes]),
            notes=[note for note in notes if isinstance(note, Note)],
            provenance=[
                ("record", f"{record}, created {held.created}"),
                *((self.data, file) for file in files),
                *self.stated(),
                ("software", f"imulab {VERSION}"),
            ],
        )


def warn_made_from(record: Calibration, recordings: Iterable[Recording]) -> list[str]:
    """Return a warning for each recording from which a record that is tested was made."""
    sources = {source.sha256 for source in record.sources}
    return [
        Finding(
            f"{each.name}: the record was made from this recording, which says nothing of whether it still holds",
            "check with a fresh recording",
        )
        for each in recordings
        if each.source is not None and each.source.sha256 in sources
    ]

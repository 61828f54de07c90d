"""What a procedure is to the rest of the package: its fit, what its record gives a unit, and how it is shown.

An entry names functions of its folder by `deferred`, so that the registry costs nothing until one of them is called.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from imulab.procedures.options import Option

if TYPE_CHECKING:
    import numpy as np

    from imulab.device.array_settings import Fusion
    from imulab.device.tables import DeviceTable
    from imulab.device.unit import DeviceUnit
    from imulab.recording import Recording, Source
    from imulab.records.calibration import Calibration, Parameter
    from imulab.records.comparison import Change
    from imulab.records.triads import AccelerometerLaws, GyroscopeLaws, LinearFit, Triads
    from imulab.report.elements import Exhibits


def deferred(where: str) -> Callable[..., Any]:
    """Return a function that is imported when it is first called; `where` is ``"imulab.module:name"``."""
    module, _, name = where.partition(":")

    def call(*given: Any, **named: Any) -> Any:
        return getattr(import_module(module), name)(*given, **named)

    call.__name__ = name
    return call


class Files(Protocol):
    """Where a fit gets what its files hold; `name` is what the command line or the manifest calls a file."""

    def recording(self, name: str, layout: str | None, **part: Any) -> Recording:
        """Return a recording as a whole; options as for `imulab.read`."""

    def record(self, name: str) -> Calibration:
        """Return a calibration record."""

    def blocks(self, name: str, layout: str | None, **part: Any) -> Iterator[Recording]:
        """Return a recording in blocks; options as for `imulab.read_blocks`."""

    def path(self, name: str) -> Path:
        """Return where a file lies on this machine."""

    def beside(self, name: str, file: str) -> str:
        """Return the name of a file that file `name` names relative to itself."""


@dataclass(frozen=True)
class Task:
    """How a procedure is run on the files of one unit.

    Attributes
    ----------
    files
        What the files are, for messages.
    count
        Fewest and most files; None for any number.
    options
        The options of its fit.
    values
        Texts of options and how messages call an option (``"--{}"``) to checked values; raises OptionError.
    fit
        Names of the files, values, access to files and a progress callback to the record.
    """

    files: str
    count: tuple[int, int | None]
    options: tuple[Option, ...]
    values: Callable[[Mapping[str, str], str], dict[str, Any]]
    fit: Callable[[Sequence[str], Mapping[str, Any], Files, Callable[[int], None]], Calibration]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the options."""
        return tuple(option.name for option in self.options)


@dataclass(frozen=True)
class Section:
    """One kind of section in a unit's tables: the struct ``il_<kind>`` of the C core.

    Attributes
    ----------
    kind
        Name of the struct.
    golden
        Table and random numbers to the vectors of an exported unit's self-test: input, and what the core makes of it.
    apply
        The unit, what the section says of its columns, and a recording to the corrected recording; None where a section
        corrects no columns of their own.
    triad
        ``accel`` or ``gyro`` where the section corrects that triad: it is left out where a recording has none of it.
    unchanged
        What the section says of its columns and a recording to the reason why it leaves it as it is, or None.
    remarks
        The same to what a user should know about correcting that recording, `unchanged` included.
    since_power_on
        Whether the correction follows the time since power-on.
    """

    kind: str
    golden: Callable[[DeviceTable, np.random.Generator], dict[str, Any]]
    apply: Callable[[DeviceUnit, Mapping[str, Any], Recording], Recording] | None = None
    triad: str | None = None
    unchanged: Callable[[Mapping[str, Any], Recording], str | None] | None = None
    remarks: Callable[[Mapping[str, Any], Recording], list[str]] | None = None
    since_power_on: bool = False


@dataclass(frozen=True)
class Row:
    """One parameter as people read it: bias in mg, misalignment in mrad, k2 in µg/g² ..."""

    name: str
    value: float
    standard_uncertainty: float | None
    unit: str


@dataclass(frozen=True)
class OnLine:
    """What units of a line are compared by, where a record's parameters mean what only that record says.

    Attributes
    ----------
    parameters
        Further parameters, which mean the same in every record that has them.
    about
        What the record's own parameters are about, and its unit: ``reference_temperature``.
    means, tolerance
        That number, and further ones that say what these parameters mean, as the knots of splines; records are compared
        by them where all these agree within the tolerance.
    own
        The names of these parameters.
    freedom
        The fewest degrees of freedom of an uncertainty among `parameters`; None where all are known well.
    """

    parameters: Mapping[str, Parameter]
    about: tuple[str, str]
    means: tuple[float, ...]
    tolerance: float
    own: frozenset[str]
    freedom: float | None


@dataclass(frozen=True)
class Procedure:
    """A procedure's entry in the registry.

    Attributes
    ----------
    name
        In records.
    command
        On the command line and in manifests of fleets.
    title
        Of its reports.
    line_title
        Of its part in the report of a fleet.
    task
        How it is run on the files of one unit.
    check
        Of a record read from its file: raises RecordError where its sections are not what the procedure writes.
    exhibits
        Record to headline, facts, figures and tables.
    tables
        Record to the tables of a unit, in the order in which they are applied.
    fusion
        Record, and texts of method and memory or None, to how the unit is to fuse, which `tables` then takes; None
        where it fuses nothing.
    noise
        Record to what exporters make noise keys of, in the form of ``allan --json``; None where it states no noise.
    sections
        The kinds of these tables.
    triads
        Record to its accelerometers and gyroscopes as matrices, which other programs' files are made from; None where
        it states none.
    laws
        Record to the laws of its accelerometers over temperature, which autopilots take as offsets; None where it
        states none.
    gyro_laws
        The same of its gyroscopes, None for a record without.
    linear_fit
        Record (and whether to keep the misalignment) to its accelerometers fitted anew without nonlinearity, for
        programs that hold none; None where they cannot be.
    elsewhere
        Why another program's file cannot hold its records, where they state no triads; ``{target}`` is that program.
    not_applied
        Why its records correct no recording by `apply`, and what takes them; None where they do.
    rows
        Record to its parameters in the units in which people read them; by their units if None.
    summary
        Record to the table that it shows of itself first, titles and rows of text; of all its parameters if None.
    change_unit
        Change of a parameter and record to the factor from SI and the unit in which it is read; by unit if None.
    same_meaning
        Name of a parameter and two records to whether it means the same in both; by its unit alone if None.
    comparable
        Two records to the same two with parameters that mean the same in both, None where theirs do; raises RecordError
        where there are none.
    on_line
        Record to what units of a line are compared by; None where a parameter means the same in all records.
    heading
        Record to what adds magnetic heading and dip to a recording that it corrected; raises RecordError where it holds
        no magnetometers. None where no record of the procedure does.
    beyond
        Record and recording to how many samples lie beyond what the record was made at, and the largest specific force
        among them, m/s^2; None where no such limit is known.
    joined
        Record of another procedure, whose ``fit`` and ``data`` hold this one's under its name, to what it shows of it.
    beyond_message
        Record, that number and that force to what a user should know.
    """

    name: str
    command: str
    title: str
    line_title: str
    task: Task
    check: Callable[[Calibration], None]
    exhibits: Callable[[Calibration], Exhibits]
    tables: Callable[..., tuple[DeviceTable, ...]]
    sections: tuple[Section, ...]
    fusion: Callable[[Calibration, str | None, str | None], Fusion] | None = None
    noise: Callable[[Calibration], Mapping[str, Any]] | None = None
    triads: Callable[[Calibration], Triads] | None = None
    laws: Callable[[Calibration], AccelerometerLaws] | None = None
    gyro_laws: Callable[[Calibration], GyroscopeLaws | None] | None = None
    linear_fit: Callable[..., LinearFit] | None = None
    elsewhere: str | None = None
    not_applied: str | None = None
    rows: Callable[[Calibration], Sequence[Row]] | None = None
    summary: Callable[[Calibration], tuple[list[str], list[list[str]]]] | None = None
    change_unit: Callable[[Change, Calibration], tuple[float, str]] | None = None
    same_meaning: Callable[[str, Calibration, Calibration], bool] | None = None
    comparable: Callable[[Calibration, Calibration], tuple[Calibration, Calibration]] | None = None
    on_line: Callable[[Calibration], OnLine] | None = None
    heading: Callable[[Calibration], Callable[[Recording], Recording]] | None = None
    beyond: Callable[[Calibration, Recording], tuple[int, float]] | None = None
    beyond_message: Callable[[Calibration, int, float], str] | None = None
    joined: Callable[[Calibration], Exhibits] | None = None

    def section(self, kind: str) -> Section:
        """Return one of its kinds of section."""
        return next(known for known in self.sections if known.kind == kind)


def source_of(access: Files, name: str, called: str | None = None) -> Source | None:
    """Return a file as a source of a record, under the name that the record calls it; None for what is no file."""
    from imulab.recording import Source

    path = access.path(name)
    if name == "-" or not path.is_file():
        return None
    with path.open("rb") as stream:
        return Source(called or name, hashlib.file_digest(stream, "sha256").hexdigest())

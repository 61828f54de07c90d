"""The base classes of procedures: a fit from files, the use of its record in a unit, and how it is shown.

Each procedure's folder has a class of `Procedure` that overrides what it has. It imports the rest of its folder when
one of its methods is called, so that the registry loads quickly.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from msgspec import Struct

from imulab.errors import OptionError
from imulab.files import open_file
from imulab.options import Option, options_of

if TYPE_CHECKING:
    import numpy as np

    from imulab.device.tables import DeviceTable, Fusion
    from imulab.device.unit import DeviceUnit
    from imulab.recording import Recording, Source
    from imulab.records.calibration import Calibration, Parameter
    from imulab.records.triads import AccelerometerLaws, GyroscopeLaws, LinearFit, Magnetometers, Triads
    from imulab.report.parameters import Row
    from imulab.report.traces import Exhibits


class Files(Protocol):
    """Access to the files of a fit; `name` is that on the command line or in the manifest."""

    def recording(self, name: str, layout: str | None, **part: Any) -> Recording:
        """Return a recording as a whole; options as for `imulab.read`."""

    def record(self, name: str) -> Calibration:
        """Return a calibration record."""

    def blocks(self, name: str, layout: str | None, **part: Any) -> Iterator[Recording]:
        """Return a recording in blocks; options as for `imulab.read_blocks`."""

    def path(self, name: str) -> Path:
        """Return the path of a file on this machine."""

    def beside(self, name: str, file: str) -> str:
        """Return the name of `file`, which the file `name` states relative to itself."""


class Task(Struct, frozen=True):
    """How a procedure is run on the files of one unit.

    Attributes
    ----------
    files
        Description of the files, for messages.
    count
        Fewest and most files; None for any number.
    function
        Returns the public function of the fit, whose signature states the options.
    values
        Returns checked values for texts of options and the label of options in messages (``"--{}"``); raises
        OptionError.
    fit
        Returns the record for names of files, values, access to files and a progress callback.
    without
        Keywords of the function that are no options, since they are the files.
    more
        Typed dictionaries of further options.
    """

    files: str
    count: tuple[int, int | None]
    function: Callable[[], Callable[..., Any]]
    values: Callable[[Mapping[str, str], str], dict[str, Any]]
    fit: Callable[[Sequence[str], Mapping[str, Any], Files, Callable[[int], None]], Calibration]
    without: tuple[str, ...] = ()
    more: tuple[type, ...] = ()

    @property
    def options(self) -> tuple[Option, ...]:
        """The options of its fit."""
        options = (option for owner in (self.function(), *self.more) for option in options_of(owner))
        return tuple(option for option in options if option.keyword not in self.without)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the options."""
        return tuple(option.name for option in self.options)


class Section:
    """One kind of section in a unit's tables: the struct ``il_<kind>`` of the C core.

    Attributes
    ----------
    kind
        Name of the struct.
    triad
        ``accel``, ``gyro`` or ``mag`` where the section corrects that triad; it is left out for recordings without.
    corrects
        Whether it corrects columns of a recording.
    since_power_on
        Whether the correction follows the time since power-on.
    """

    kind: ClassVar[str]
    triad: ClassVar[str] = ""
    corrects: ClassVar[bool] = True
    since_power_on: ClassVar[bool] = False

    def golden(self, table: DeviceTable, random: np.random.Generator) -> dict[str, Any]:
        """Return the vectors of an exported unit's self-test: inputs, and the core's outputs by a table."""
        raise NotImplementedError

    def apply(self, unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
        """Return the corrected recording; `columns` are the properties of the section's columns."""
        raise NotImplementedError

    def unchanged(self, columns: Mapping[str, Any], recording: Recording) -> str | None:
        """Return why a recording stays as it is, None where it is corrected."""
        return None

    def remarks(self, columns: Mapping[str, Any], recording: Recording) -> list[str]:
        """Return warnings and notes about correcting a recording, such as why it stays as it is."""
        return []


class GyroscopeSection(Section):
    """Bias, scale factor, misalignment and g-sensitivity of gyroscopes, of tumble and rate tests."""

    kind = "gyro"
    triad = "gyro"

    def golden(self, table: DeviceTable, random: np.random.Generator) -> dict[str, Any]:
        from imulab.device.unit import golden_gyroscopes

        return golden_gyroscopes(table, random)

    def apply(self, unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
        from imulab.device.unit import correct_gyroscopes

        return correct_gyroscopes(unit, columns, recording)


class MagnetometerSection(Section):
    """Bias and matrix of magnetometers, beside accelerometers or alone."""

    kind = "mag"
    triad = "mag"

    def golden(self, table: DeviceTable, random: np.random.Generator) -> dict[str, Any]:
        from imulab.device.unit import golden_magnetometers

        return golden_magnetometers(table, random)

    def apply(self, unit: DeviceUnit, columns: Mapping[str, Any], recording: Recording) -> Recording:
        from imulab.device.unit import correct_magnetometers

        return correct_magnetometers(unit, columns, recording)


class OnLine(Struct, frozen=True):
    """Parameters by which units of a line are compared, where those of a record depend on its reference temperature.

    Attributes
    ----------
    parameters
        Further parameters, which mean the same in every record that has them.
    about
        The quantity on which the record's own parameters depend, and its unit: ``reference_temperature``.
    means, tolerance
        That quantity, and further numbers on which they depend, such as knots of splines; records are compared by their
        own parameters if all these agree within the tolerance.
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


class Procedure:
    """A procedure, as the registry knows it.

    Attributes
    ----------
    name
        Name in records.
    command
        Name on the command line and in manifests of fleets.
    title
        Title of its reports.
    line_title
        Title of its part in the report of a fleet.
    task
        How it is run on the files of one unit.
    sections
        The kinds of tables that it gives a unit.
    elsewhere
        Why another program's file cannot hold its records, where they state no triads; ``{target}`` is that program.
    not_applied
        Why its records correct no recording by `apply`, and which command uses them; empty where they do.
    states_triads
        Whether its records state accelerometers and gyroscopes as matrices, which other programs' files are made from.
    over_temperature
        Whether its records hold laws over temperature, which autopilots take as offsets.
    has_heading
        Whether a record can hold magnetometers, which give magnetic heading and dip.
    joins
        Whether records of other procedures can hold its results beside their own, in ``fit`` and ``data`` by its name.
    """

    name: ClassVar[str]
    command: ClassVar[str]
    title: ClassVar[str]
    line_title: ClassVar[str]
    task: ClassVar[Task]
    sections: ClassVar[tuple[Section, ...]] = ()
    elsewhere: ClassVar[str] = "it states no accelerometers"
    not_applied: ClassVar[str] = ""
    states_triads: ClassVar[bool] = False
    over_temperature: ClassVar[bool] = False
    has_heading: ClassVar[bool] = False
    joins: ClassVar[bool] = False

    def section(self, kind: str) -> Section:
        """Return one of its kinds of section."""
        return next(known for known in self.sections if known.kind == kind)

    # Content and presentation of a record.

    def check(self, record: Calibration) -> None:
        """Check a record from its file; raises RecordError where its sections are not what the procedure writes."""
        raise NotImplementedError

    def exhibits(self, record: Calibration) -> Exhibits:
        """Return headline, facts, figures and tables of a record."""
        raise NotImplementedError

    def joined(self, record: Calibration) -> Exhibits:
        """Return the exhibits of this procedure's results in a record of another one."""
        raise NotImplementedError

    def summary(self, record: Calibration) -> tuple[list[str], list[list[str]]]:
        """Return titles and rows of a record's first table; empty for the table of all parameters."""
        return [], []

    def reservations(self, record: Calibration) -> list[str]:
        """Return what must stand beside the values of a record in a certificate: what they rest on, or do not hold."""
        return []

    def rows(self, record: Calibration) -> Sequence[Row]:
        """Return the parameters in the units in which people read them."""
        from imulab.report.parameters import rows_of

        return rows_of(record)

    # Two records of a unit, and the units of a line.

    def same_meaning(self, name: str, first: Calibration, second: Calibration) -> bool:
        """Return whether a parameter means the same in two records."""
        return True

    def comparable(self, first: Calibration, second: Calibration) -> tuple[Calibration, Calibration]:
        """Return two records with parameters that mean the same in both; raises RecordError where there are none."""
        return first, second

    def on_line(self, record: Calibration) -> OnLine | None:
        """Return how units of a line are compared, None where a parameter means the same in all records."""
        return None

    # Use of a record in a unit, and for recordings.

    def tables(self, record: Calibration, fusion: Fusion | None = None) -> tuple[DeviceTable, ...]:
        """Return the tables of a unit, in the order in which they are applied; sensors are fused by `fusion`."""
        raise NotImplementedError

    def fused_by(self, record: Calibration) -> tuple[str, ...]:
        """Return the keywords of `imulab.export` that say how a unit fuses the sensors of a record; none by default."""
        return ()

    def fusion(self, record: Calibration, stated: Mapping[str, Any]) -> Fusion:
        """Return how the unit is to fuse: by keywords of `imulab.export` that are stated, else as its record says."""
        raise NotImplementedError

    def heading(self, record: Calibration, *, true: bool = False) -> Callable[[Recording], Recording]:
        """Return a function that adds magnetic or true heading and dip to a recording that the record corrected.

        Raises
        ------
        RecordError
            It holds no magnetometers, or true headings are asked of one without a place.
        """
        raise NotImplementedError

    def beyond(self, record: Calibration, recording: Recording) -> tuple[int, float]:
        """Return the number of samples beyond the range of the record's test, and the largest of them, SI."""
        return 0, 0.0

    def beyond_message(self, record: Calibration, count: int, largest: float) -> str:
        """Return the warning of so many samples, the largest in SI, beyond the range of the record's test."""
        raise NotImplementedError

    # A record for other programs.

    def noise(self, record: Calibration) -> Mapping[str, Any]:
        """Return the noise for exporters, in the form of ``allan --json``.

        Raises
        ------
        OptionError
            Its records state no noise.
        """
        raise OptionError(f"expected what 'imulab allan --json' printed, found a {record.procedure} record")

    def triads(self, record: Calibration) -> Triads:
        """Return accelerometers, gyroscopes and magnetometers as matrices."""
        raise NotImplementedError

    def magnetometers(self, record: Calibration) -> Magnetometers | None:
        """Return the magnetometers of a record that holds them alone, None for one that does not."""
        return None

    def linear_fit(self, record: Calibration, *, misalignment: bool) -> LinearFit:
        """Return the accelerometers fitted anew without nonlinearity (and misalignment), for programs without."""
        from imulab.records.triads import NOT_FITTED

        return NOT_FITTED

    def laws(self, record: Calibration) -> AccelerometerLaws | None:
        """Return the laws of the accelerometers over temperature, None for a record without."""
        raise NotImplementedError

    def gyro_laws(self, record: Calibration) -> GyroscopeLaws | None:
        """Return the laws of the gyroscopes over temperature, None for a record without."""
        return None


def noting_head(blocks: Iterator[Recording], heads: dict[str, Mapping[str, str]], name: str) -> Iterator[Recording]:
    """Yield the blocks of a file, and note its head under its name in `heads`, for `source_of`."""
    for block in blocks:
        heads.setdefault(name, block.metadata)
        yield block


def source_of(
    access: Files, name: str, called: str | None = None, *, heads: Mapping[str, Mapping[str, str]] | None = None
) -> Source | None:
    """Return a file as a source of a record, under `called` or its own name; None for what is no file.

    `heads` holds the heads of recordings that were read, which may tell their day.
    """
    from imulab.readers import measured
    from imulab.recording import Source

    path = access.path(name)
    if name == "-" or not path.is_file():
        return None
    with open_file(path) as stream:
        day = measured((heads or {}).get(name, {}))
        return Source(called or name, hashlib.file_digest(stream, "sha256").hexdigest(), day)

"""The calibration record: what a procedure determined, with uncertainty, provenance and the data behind its figures.

A record is JSON, one procedure a file. It is written whole or not at all, holds finite numbers only, and carries
a SHA-256 of each source file and of its own content, so that an altered record is noticed.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
from msgspec import Raw
from msgspec.json import Decoder
from msgspec.json import format as indented
from numpy.typing import NDArray

from imulab._version import VERSION
from imulab.arguments import checked
from imulab.display import UNJUDGED, Finding, Verdict, first_hidden, has_hidden, may_hide, printable, verdict_of
from imulab.errors import LackingError, OptionError, RecordError
from imulab.files import write_text
from imulab.frames import data_frame
from imulab.recording import Recording, Source
from imulab.views import AnyPlot, AnyPlots, views

if TYPE_CHECKING:
    from typing import Unpack

    import pandas
    import polars

    from imulab.recording import Data, Reading


# Plain JSON values as text: with an indent as a file, without spaces and with sorted keys to be hashed.


_SPACES = b" \n\t\r"
_SEAL = "content_sha256"
_decode_object = Decoder(dict[str, Raw]).decode
_decode_array = Decoder(list[Raw]).decode


def json_text(content: Mapping[str, Any]) -> str:
    """Return JSON with an indent of 1, and a line break.

    Raises
    ------
    TypeError
        A value is not of JSON's kinds (NumPy's are not).
    ValueError
        A number is not finite, or a text is no Unicode.
    """
    return _indented(_compact(content))


def sealed_text(content: Mapping[str, Any]) -> tuple[str, str]:
    """Return the `content_sha256` of a record's content, and the text of its file with that as the last key.

    Raises
    ------
    TypeError
        A value is not of JSON's kinds (NumPy's are not).
    ValueError
        A number is not finite, or a text is no Unicode.
    """
    plain = {key: value for key, value in content.items() if key != _SEAL}
    text = _compact({**plain, _SEAL: ""})  # numbers are written once, for the hash and for the file
    hashed = sealed_bytes(text.encode("utf-8"))
    sha256 = content_sha256(plain) if hashed is None else hashlib.sha256(hashed).hexdigest()
    return sha256, _indented(text[: -len('"}')] + sha256 + '"}')


def _compact(content: Mapping[str, Any]) -> str:
    return json.dumps(content, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def _indented(text: str) -> str:
    """Return JSON as the standard library indents it, which does so in Python, value by value."""
    return indented(text, indent=1) + "\n"


def content_sha256(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the record's JSON without ``content_sha256``: keys sorted, no spaces, UTF-8.

    Raises
    ------
    TypeError
        A value is not of JSON's kinds (NumPy's are not).
    ValueError
        A number is not finite, or a text is no Unicode.
    """
    plain = {key: value for key, value in content.items() if key != "content_sha256"}
    text = json.dumps(plain, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


def sealed_bytes(data: bytes) -> bytes | None:
    """Return the bytes that `content_sha256` hashes, rearranged from a record's file, each value as it stands there.

    Writing numbers takes longer than all else of a record's reading. None where a key appears twice, or has an escape.

    Raises
    ------
    ValueError
        The bytes are no JSON, or no object.
    """
    members = _decode_object(data)
    seal = bytes(members.pop(_SEAL, b""))
    escapes = b"\\" in data
    pieces: list[bytes] = []
    if not _add_object(members, escapes, pieces):
        return None
    text = b"".join(pieces)
    others = len(f',"{_SEAL}":') + len(seal.translate(None, _SPACES))
    # a key that appears twice is in the file, but not in the text
    return text if len(data.translate(None, _SPACES)) == len(text.translate(None, _SPACES)) + others else None


def _add_object(members: Mapping[str, Raw], escapes: bool, pieces: list[bytes]) -> bool:
    """Add the text of an object; return False where a key has an escape."""
    before = b'{"'
    for key in sorted(members):
        if escapes and ('"' in key or "\\" in key or not key.isprintable()):
            return False
        pieces += (before, key.encode(), b'":')
        if not _add_value(bytes(members[key]), escapes, pieces):
            return False
        before = b',"'
    pieces.append(b"}" if members else b"{}")
    return True


def _add_value(text: bytes, escapes: bool, pieces: list[bytes]) -> bool:
    """Add the text of a value; errors as for `_add_object`."""
    if text[:1] == b"{":
        return _add_object(_decode_object(text), escapes, pieces)
    if text[:1] == b"[" and b'"' in text:
        before = b"["
        for item in _decode_array(text):
            pieces.append(before)
            if not _add_value(bytes(item), escapes, pieces):
                return False
            before = b","
        pieces.append(b"]")
    else:
        pieces.append(text if text[:1] == b'"' else text.translate(None, _SPACES))
    return True


# The record.


FORMAT = "imulab.calibration"
SCHEMA_VERSION = 1  # of records; it rises when old readers cannot read new records
BLOB_MAGIC = b"\x89IMULAB\n"


@dataclass(frozen=True, slots=True)
class Parameter:
    """A value with its standard uncertainty (None where none can be stated) and its SI or output unit.

    Where the order of a model was chosen from the data, `standard_uncertainty_given_order` is what it would be if that
    order were known to be right. `interval_95` is the interval that holds the value with 95 %, where it is not about
    that of a normal distribution.
    """

    value: float
    standard_uncertainty: float | None
    unit: str
    standard_uncertainty_given_order: float | None = None
    interval_95: tuple[float, float] | None = None

    @property
    def unseen_limit(self) -> float | None:
        """What a parameter is below that was not seen; None for one that was, or without a limit."""
        return unseen_limit(self.value, self.standard_uncertainty, self.interval_95)


def unseen_limit(value: float, uncertainty: float | None, interval: tuple[float, float] | None) -> float | None:
    """Return the limit of a parameter without which the data are as well described: 0, with an interval above it."""
    unseen = value == 0 and uncertainty is None and interval is not None and interval[1] > 0
    return interval[1] if interval is not None and unseen else None


@dataclass(frozen=True, slots=True)
class Covariance:
    """Covariance matrix of the parameters in the order of `names`, in products of their units."""

    names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]

    def array(self) -> NDArray[np.float64]:
        """Return the matrix, shape (p, p)."""
        return np.array(self.matrix, dtype=np.float64).reshape(len(self.names), len(self.names))

    def block(self, names: Sequence[str]) -> NDArray[np.float64]:
        """Return the matrix of some of the parameters, in this order, shape (q, q).

        Raises
        ------
        RecordError
            The record lacks it.
        """
        for name in names:
            if name not in self.names:
                raise LackingError(f"the record lacks the covariance of {name}")
        index = [self.names.index(name) for name in names]
        return self.array()[np.ix_(index, index)]


@dataclass(frozen=True)
class Calibration:
    """One calibration of one unit by one procedure.

    Attributes
    ----------
    procedure
        Name of the procedure; `imulab.procedures.registry` knows what it is.
    parameters
        Name to value, standard uncertainty and unit.
    covariance
        Of all parameters that have an uncertainty.
    model, options, data, fit
        What was fitted, with which options, the data behind the figures, and how well it fitted.
    sensor, created, software, sources
        Provenance.
    warnings
        What a user of the record must know, a sentence each.
    verdict
        Whether the result can be used as it is; made from the warnings if not given.
    sections
        Further top-level keys that a procedure adds (``table``, ``elements``, ``levels``, ``runs`` ...).
    version
        Version of the schema that the record was read from.

    Examples
    --------
    >>> import imulab as il
    >>> record = il.fit_tumble(il.simulate_tumble(order=1, gravity=9.81362), gravity=9.81362).calibration
    >>> record.procedure, record.parameters["bias_x"].unit, record.verdict.state
    ('tumble', 'm/s^2', 'good')
    """

    procedure: str
    parameters: Mapping[str, Parameter]
    covariance: Covariance
    model: Mapping[str, Any]
    fit: Mapping[str, Any]
    options: Mapping[str, Any] = field(default_factory=dict)
    data: Mapping[str, Any] = field(default_factory=dict)
    sensor: Mapping[str, str] = field(default_factory=dict)
    sources: tuple[Source, ...] = ()
    warnings: tuple[str, ...] = ()
    created: str = field(default_factory=lambda: datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"))
    software: str = f"imulab {VERSION}"
    sections: Mapping[str, Any] = field(default_factory=dict)
    version: int = SCHEMA_VERSION
    verdict: Verdict = UNJUDGED

    def __post_init__(self) -> None:
        if self.verdict is UNJUDGED:
            object.__setattr__(self, "verdict", verdict_of(self.warnings))

    def value(self, name: str) -> float:
        """Return the value of a parameter; errors as for `parameter`."""
        return self.parameter(name).value

    def parameter(self, name: str) -> Parameter:
        """Return a parameter.

        Raises
        ------
        RecordError
            The record lacks it.
        """
        if name not in self.parameters:
            raise LackingError(f"the record lacks {name}")
        return self.parameters[name]

    def to_dict(self) -> dict[str, Any]:
        """Return the record as plain JSON values, ``content_sha256`` included.

        Raises
        ------
        RecordError
            A number is not finite.
        """
        plain: dict[str, Any] = plain_values(self._content(), "")
        return {**plain, "content_sha256": content_sha256(plain)}

    def sealed(self) -> tuple[str, str]:
        """Return the record's ``content_sha256`` and its JSON text, which ends with it; errors as for `to_dict`."""
        content = self._content()
        try:
            sealed = sealed_text(content)
        except (TypeError, ValueError):  # arrays, or a number that is not finite, which gets its name here
            content = plain_values(content, "")
            sealed = sealed_text(content)
        if not may_hide(sealed[1].encode("utf-8")) or first_hidden(content) is None:
            return sealed
        return sealed_text(plain_values(content, ""))

    def _content(self) -> dict[str, Any]:
        """Return the record as it stands in its file, without ``content_sha256``."""
        return {
            "format": FORMAT,
            "version": self.version,
            "procedure": self.procedure,
            "sensor": dict(self.sensor),
            "created": self.created,
            "software": self.software,
            "sources": [
                {"file": source.file, "sha256": source.sha256}
                | ({} if source.measured is None else {"measured": source.measured})
                for source in self.sources
            ],
            "model": self.model,
            "parameters": {
                name: {"value": p.value, "standard_uncertainty": p.standard_uncertainty, "unit": p.unit}
                | (
                    {}
                    if p.standard_uncertainty_given_order is None
                    else {"standard_uncertainty_given_order": p.standard_uncertainty_given_order}
                )
                | ({} if p.interval_95 is None else {"interval_95": list(p.interval_95)})
                for name, p in self.parameters.items()
            },
            "covariance": {"names": self.covariance.names, "matrix": self.covariance.matrix},
            "options": self.options,
            "fit": self.fit,
            "verdict": {"state": self.verdict.state, "reasons": list(self.verdict.reasons)}
            | ({"next": list(self.verdict.next)} if self.verdict.has_next else {}),
            "warnings": list(self.warnings),
            **self.sections,
            "data": self.data,
        }

    def to_json(self) -> str:
        """Return the record as JSON text."""
        return self.sealed()[1]

    @checked
    def save(self, path: str | Path) -> None:
        """Write the record, whole or not at all.

        Raises
        ------
        RecordError
            A number is not finite.
        OptionError
            The file cannot be written there, or its name is that of a page.
        """
        if str(path).lower().endswith((".html", ".htm", ".pdf")):
            raise OptionError(f"{path}: a record is JSON, expected a name such as record.json; its report is a page")
        write_text(path, self.to_json())

    @classmethod
    @checked
    def load(cls, path: str | PathLike[str]) -> Calibration:
        """Return a record from a file; see `imulab.load`."""
        record: Calibration = views().load(Path(path))
        return record

    @checked
    def report(self, path: str | Path) -> None:
        """Write the report as one HTML file; see `imulab.write_report`."""
        views().write_report(self, path)

    @overload
    def plot(self, name: None = None) -> AnyPlots: ...
    @overload
    def plot(self, name: str | int) -> AnyPlot: ...
    @checked
    def plot(self, name: str | int | None = None) -> AnyPlots | AnyPlot:
        """Return the report's figures, which show themselves in a notebook, or the one whose title has these words.

        Raises
        ------
        OptionError
            There is no such figure; the message lists them.
        RecordError
            The record lacks the data that they need.

        Examples
        --------
        >>> import imulab as il
        >>> fit = il.fit_tumble(il.find_attitudes(il.simulate_tumble(gravity=9.81)), order=1, gravity=9.81)
        >>> fit.calibration.plot("sphere").save("sphere.html")
        """
        return views().plots(self, name)

    @overload
    def to_frame(self, library: Literal["pandas"] | None = None) -> pandas.DataFrame: ...
    @overload
    def to_frame(self, library: Literal["polars"]) -> polars.DataFrame: ...
    @checked
    def to_frame(self, library: str | None = None) -> pandas.DataFrame | polars.DataFrame:
        """Return the parameters in SI as a data frame of pandas, or of the `library` ``"polars"``.

        A parameter that was not seen has no value (nan), and its limit in the column ``below``.

        Raises
        ------
        DataError
            The library is not installed.
        """
        parameters = self.parameters.values()
        nan = math.nan
        columns: dict[str, list[Any]] = {
            "parameter": list(self.parameters),
            "value": [nan if p.unseen_limit else p.value for p in parameters],
            "standard_uncertainty": [nan if (u := p.standard_uncertainty) is None else u for p in parameters],
            "unit": [p.unit for p in parameters],
        }
        if any(p.unseen_limit for p in parameters):
            columns["below"] = [p.unseen_limit or nan for p in parameters]
        return data_frame(columns, library)

    def cov(self, *names: str) -> NDArray[np.float64]:
        """Return the covariance of these parameters, or of all in ``covariance.names``, shape (p, p), SI.

        Raises
        ------
        RecordError
            The record lacks it.
        """
        return self.covariance.block(names) if names else self.covariance.array()

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
        """Return data corrected by the record: a file, a recording, a data frame or arrays; see `imulab.apply`.

        Of a data frame this is a frame of the same library and index, with titles ``name [unit]`` and its columns of
        texts; of all else a `Recording`. A frame has no `notes`: `imulab.apply` returns a recording, whose `notes` hold
        what is to be doubted.
        """
        return views().apply_to(
            self, data, reading, again=again, heading=heading, latest_start=latest_start,
            temperature_column=temperature_column,
        )  # fmt: skip

    @checked
    def export(self, target: str, folder: str | Path, **options: Any) -> list[Path]:
        """Write the record in the form of firmware or another program; see `imulab.export` for targets and options."""
        return views().export_to(self, target, folder, **options)

    def __repr__(self) -> str:
        return views().text(self)

    def _repr_html_(self) -> str:
        return views().html(self)

    def __str__(self) -> str:
        lines = [f"{self.procedure} calibration of {self.sensor.get('serial', 'a unit without serial number')}"]
        for name, p in self.parameters.items():
            uncertainty = "" if p.standard_uncertainty is None else f" ± {p.standard_uncertainty:.2g}"
            value = f"< {p.unseen_limit:.2g}" if p.unseen_limit else f"= {p.value:.9g}"
            lines.append(f"  {name} {value}{uncertainty} {p.unit}")
        return "\n".join(lines)


def warn_other_unit(sensor: Mapping[str, str], recording: Recording) -> list[str]:
    """Return a warning for each of serial number and element in which a recording is of another unit than a record.

    `sensor` is that of the record; what one of the two does not state is not compared.
    """
    return [
        Finding(f"{recording.name}: {key} {its}, but the record was made for {mine}", "use the record of this unit")
        for key in ("serial", "element")
        if (mine := sensor.get(key)) and (its := recording.metadata.get(key)) and mine != its
    ]


def plain_values(value: Any, where: str) -> Any:
    """Return `value` as plain JSON types; refuse numbers that are not finite."""
    kind = type(value)
    if value is None or (kind is str and not has_hidden(value)) or (kind is float and math.isfinite(value)):
        return value  # as most are
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, np.ndarray):
        value = value.tolist()
    elif isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        raise RecordError(f"record: {where.lstrip('.')} is {value}; a record holds finite numbers only")
    if kind is dict or isinstance(value, Mapping):
        return {printable(str(key)): plain_values(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        if set(map(type, value)) == {float} and all(map(math.isfinite, value)):
            return list(value)
        return [plain_values(item, f"{where}[{index}]") for index, item in enumerate(value)]
    return value

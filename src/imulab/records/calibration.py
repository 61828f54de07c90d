"""The calibration record: what a procedure found, with uncertainty, provenance and the data behind its figures.

A record is JSON, one procedure a file. It is written whole or not at all, holds finite numbers only, and carries
a SHA-256 of each source file and of its own content, so that an altered record is noticed.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab._version import VERSION
from imulab.atomic_write import write_text
from imulab.errors import RecordError
from imulab.printable import first_hidden, has_hidden, printable
from imulab.recording import Source
from imulab.records.json_text import content_sha256, sealed_text
from imulab.records.json_text import json_text as json_text
from imulab.records.sections import check_sizes
from imulab.verdict import UNJUDGED, Verdict, as_judged, verdict_of

FORMAT = "imulab.calibration"
SCHEMA_VERSION = 1
BLOB_MAGIC = b"\x89IMULAB\n"
_CREATED = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d+)?(?:Z|[+-]\d\d:\d\d)", re.ASCII)
_ROUNDING = 1.0 + 1e-6


@dataclass(frozen=True, slots=True)
class Parameter:
    """A value with its standard uncertainty (None where none can be stated) and its SI or output unit.

    Where the order of a model was chosen from the data, `standard_uncertainty_given_order` is what it would be if that
    order were known to be right.
    """

    value: float
    standard_uncertainty: float | None
    unit: str
    standard_uncertainty_given_order: float | None = None


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
                raise RecordError(f"the record lacks the covariance of {name}")
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
            raise RecordError(f"the record lacks {name}")
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
        return sealed if first_hidden(content) is None else sealed_text(plain_values(content, ""))

    def _content(self) -> dict[str, Any]:
        """Return the record as it goes into its file, without ``content_sha256``."""
        return {
            "format": FORMAT,
            "version": self.version,
            "procedure": self.procedure,
            "sensor": dict(self.sensor),
            "created": self.created,
            "software": self.software,
            "sources": [{"file": source.file, "sha256": source.sha256} for source in self.sources],
            "model": self.model,
            "parameters": {
                name: {"value": p.value, "standard_uncertainty": p.standard_uncertainty, "unit": p.unit}
                | (
                    {}
                    if p.standard_uncertainty_given_order is None
                    else {"standard_uncertainty_given_order": p.standard_uncertainty_given_order}
                )
                for name, p in self.parameters.items()
            },
            "covariance": {"names": self.covariance.names, "matrix": self.covariance.matrix},
            "options": self.options,
            "fit": self.fit,
            "verdict": {"state": self.verdict.state, "reasons": list(self.verdict.reasons)},
            "warnings": list(self.warnings),
            **self.sections,
            "data": self.data,
        }

    def to_json(self) -> str:
        """Return the record as JSON text."""
        return self.sealed()[1]

    def save(self, path: str | Path) -> None:
        """Write the record, whole or not at all.

        Raises
        ------
        RecordError
            A number is not finite.
        OptionError
            The file cannot be written there.
        """
        write_text(path, self.to_json())

    def __str__(self) -> str:
        lines = [f"{self.procedure} calibration of {self.sensor.get('serial', 'a unit without serial number')}"]
        for name, p in self.parameters.items():
            uncertainty = "" if p.standard_uncertainty is None else f" ± {p.standard_uncertainty:.2g}"
            lines.append(f"  {name} = {p.value:.9g}{uncertainty} {p.unit}")
        return "\n".join(lines)


def parsed(data: bytes, name: str) -> tuple[Calibration, str]:
    """Return a record from the bytes of its file, and its ``content_sha256``.

    What its procedure says of its sections is still to be checked: `imulab.procedures.loading.load` does both.

    Raises
    ------
    RecordError
        It is no record, is of a newer version, was altered, or lacks something.
    """
    if data.startswith(BLOB_MAGIC):
        raise RecordError(
            f"{name}: a blob, which holds a unit's numbers without uncertainties or history: expected the record it "
            "was made from (show, apply and array fuse take blobs)"
        )
    try:
        content = json.loads(data.decode("utf-8"), parse_constant=_refuse_constant, object_pairs_hook=_unique)
    except (ValueError, RecursionError) as error:
        if type(error) is ValueError and "int_max_str_digits" in str(error):
            raise RecordError(
                f"{name}: not a calibration record: it holds a whole number of thousands of digits"
            ) from None
        reason = "it is cut or altered" if FORMAT.encode() in data[:2000] else "it is not JSON"
        if not data.lstrip().startswith(b"{"):
            raise RecordError(f"{name}: not a calibration record: it is not JSON (a recording?)") from None
        raise RecordError(f"{name}: not a calibration record: {reason} ({error})") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise RecordError(f'{name}: not a calibration record: expected the key "format": "{FORMAT}"')
    version = content.get("version")
    if type(version) is not int or version < 1:
        raise RecordError(f"{name}: expected a version number from 1, found {version!r}")
    if version > SCHEMA_VERSION:
        raise RecordError(
            f"{name}: record version {version} is newer than version {SCHEMA_VERSION}, "
            f"which imulab {VERSION} reads: update imulab"
        )
    stated = content.pop("content_sha256", None)
    if stated is None:
        raise RecordError(f"{name}: the record has no content_sha256: it was altered after it was written")
    try:
        found = content_sha256(content)
    except ValueError as error:  # a number beyond the range of a double, or text that is no Unicode
        raise RecordError(f"{name}: the record was altered after it was written ({error})") from None
    if stated != found:
        raise RecordError(f"{name}: the record was altered after it was written (its content_sha256 does not match)")
    return _validated(content, name), found


@cache
def _adapter() -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter(Calibration)


def _validated(content: dict[str, Any], name: str) -> Calibration:
    from pydantic import ValidationError

    known = {f.name for f in fields(Calibration)} - {"sections"}
    sections = {key: value for key, value in content.items() if key not in known and key != "format"}
    for key in (
        "procedure",
        "sensor",
        "created",
        "software",
        "sources",
        "model",
        "parameters",
        "covariance",
        "fit",
    ):
        if key not in content:
            raise RecordError(f"{name}: the record lacks {key!r}")
    try:
        record: Calibration = _adapter().validate_python(
            {key: value for key, value in content.items() if key in known} | {"sections": sections}
        )
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise RecordError(f"{name}: {where}: {first['msg']}, found {_short(first['input'])}") from None
    if place := first_hidden(content):
        raise RecordError(f"{name}: {place} holds a control or bidirectional character; expected plain text")
    if not _CREATED.fullmatch(record.created):
        raise RecordError(f"{name}: created: expected a time such as 2026-11-20T12:00:00Z, found {record.created!r}")
    size = len(record.covariance.names)
    if len(record.covariance.matrix) != size or any(len(row) != size for row in record.covariance.matrix):
        raise RecordError(f"{name}: covariance: expected a {size} x {size} matrix")
    try:
        _check_numbers(record)
        check_sizes(content)
    except RecordError as error:
        raise RecordError(f"{name}: {error}") from None
    return replace(record, warnings=as_judged(record.warnings, record.verdict))


def _check_numbers(record: Calibration) -> None:
    """Check that uncertainties are none below zero, and that the covariance is one of known parameters."""
    for key, p in record.parameters.items():
        for value in (p.standard_uncertainty, p.standard_uncertainty_given_order):
            if value is not None and value < 0:
                raise RecordError(f"parameters.{key}: a standard uncertainty of {value:g}; expected 0 or more")
    names, matrix = record.covariance.names, record.covariance.array()
    unknown = [key for key in names if key not in record.parameters]
    if unknown or len(set(names)) < len(names):
        found = unknown[0] if unknown else next(key for key in names if names.count(key) > 1)
        raise RecordError(f"covariance.names: expected each a parameter, once, found {found!r}")
    spread = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    if (np.diag(matrix) < 0).any() or (np.abs(matrix) > _ROUNDING * np.outer(spread, spread)).any():
        raise RecordError("covariance.matrix: a correlation beyond 1, or a variance below 0")
    if (np.abs(matrix - matrix.T) > (_ROUNDING - 1) * np.outer(spread, spread)).any():
        raise RecordError("covariance.matrix: expected a symmetric matrix")


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


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        raise ValueError("a key appears twice")
    return content


def _refuse_constant(text: str) -> None:
    raise ValueError(f"{text} is not a finite number")


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."

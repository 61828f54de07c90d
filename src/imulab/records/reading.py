"""Records from the bytes of their files, checked for damage, missing parts and impossible values."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import fields, replace
from datetime import datetime
from typing import Any

import msgspec
import numpy as np

from imulab._version import VERSION
from imulab.display import as_judged, first_hidden, may_hide
from imulab.errors import RecordError
from imulab.quantities import SMALLEST
from imulab.records.calibration import BLOB_MAGIC, FORMAT, SCHEMA_VERSION, Calibration, content_sha256, sealed_bytes
from imulab.records.sections import check_sizes, read

_CREATED = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(?:\.\d+)?(?:Z|[+-]\d\d:\d\d)", re.ASCII)
_MEASURED = re.compile(r"\d{4}-\d\d-\d\d(?:T\d\d:\d\d:\d\dZ)?", re.ASCII)
_SCALE_FACTOR = re.compile(r"(?:\w+_)?scale_factor_[xyz](?:_at_\d+)?")
_ROUNDING = 1.0 + 1e-6  # of a covariance in decimals, relative
_NEEDED = ("procedure", "sensor", "created", "software", "sources", "model", "parameters", "covariance", "fit")


def parsed(data: bytes, name: str) -> tuple[Calibration, str]:
    """Return a record from the bytes of its file, and its ``content_sha256``.

    What its procedure says of its sections is still to be checked: `imulab.procedures.registry.load` does both.

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
    content, computed = _as_sealed(data) or (_content(data, name), None)
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
        computed = computed or content_sha256(content)
    except ValueError as error:  # a number beyond the range of a double, or text that is no Unicode
        raise RecordError(f"{name}: the record was altered after it was written ({error})") from None
    if stated != computed:
        raise RecordError(f"{name}: the record was altered after it was written (its content_sha256 does not match)")
    return _validated(content, name, plain=not may_hide(data)), computed


def _as_sealed(data: bytes) -> tuple[dict[str, Any], str] | None:
    """Return the content of a record's file and its ``content_sha256`` if the file is as it was sealed, else None.

    Everything else, a file that is laid out in another way included, is left to slower reading.
    """
    try:
        text = sealed_bytes(data)
        content = msgspec.json.decode(data)
    except (ValueError, RecursionError):
        return None
    computed = None if text is None else hashlib.sha256(text).hexdigest()
    return (content, computed) if computed is not None and content.get("content_sha256") == computed else None


def _content(data: bytes, name: str) -> Any:
    """Return the JSON value of a record's file; errors as for `parsed`."""
    try:
        return json.loads(data.decode("utf-8"), parse_constant=_refuse_constant, object_pairs_hook=_unique)
    except (ValueError, RecursionError) as error:
        if type(error) is ValueError and "int_max_str_digits" in str(error):
            raise RecordError(
                f"{name}: not a calibration record: it holds a whole number of thousands of digits"
            ) from None
        reason = "it is cut or altered" if FORMAT.encode() in data[:2000] else "it is not JSON"
        if not data.lstrip().startswith(b"{"):
            what = "not JSON (a recording?); expected the .json that a fit writes"
            if not data.strip():
                what = "empty; expected the .json that a fit writes"
            if data.startswith(b"%PDF-"):
                what = "a PDF (a certificate?); expected the record that it was made of"
            elif b"digitalCalibrationCertificate" in data[:4096]:
                what = "a certificate; expected the record that it was made of"
            raise RecordError(f"{name}: not a calibration record: it is {what}") from None
        raise RecordError(f"{name}: not a calibration record: {reason} ({error})") from None


def _validated(content: dict[str, Any], name: str, *, plain: bool) -> Calibration:
    known = {f.name for f in fields(Calibration)} - {"sections"}
    sections = {key: value for key, value in content.items() if key not in known and key != "format"}
    for key in _NEEDED:
        if key not in content:
            raise RecordError(f"{name}: the record lacks {key!r}")
    try:
        check_sizes(content)
        record = read(Calibration, {key: content[key] for key in known & content.keys()} | {"sections": sections})
    except RecordError as error:
        raise RecordError(f"{name}: {error}") from None
    if not plain and (place := first_hidden(content)):
        raise RecordError(f"{name}: {place} holds a control or bidirectional character; expected plain text")
    if not _CREATED.fullmatch(record.created):
        raise RecordError(f"{name}: created: expected a time such as 2026-11-20T12:00:00Z, found {record.created!r}")
    for source in record.sources:
        if source.measured is not None and not _is_day(source.measured):
            raise RecordError(
                f"{name}: sources: measured: expected a day such as 2026-11-20, found {source.measured!r}"
            )
    size = len(record.covariance.names)
    if len(record.covariance.matrix) != size or any(len(row) != size for row in record.covariance.matrix):
        raise RecordError(f"{name}: covariance: expected a {size} x {size} matrix")
    try:
        _check_numbers(record)
    except RecordError as error:
        raise RecordError(f"{name}: {error}") from None
    verdict = replace(record.verdict, has_next="next" in content.get("verdict", {"next": ()}))
    return replace(record, warnings=as_judged(record.warnings, verdict), verdict=verdict)


def _is_day(text: str) -> bool:
    try:
        return _MEASURED.fullmatch(text) is not None and bool(datetime.fromisoformat(text))
    except ValueError:
        return False


def _check_numbers(record: Calibration) -> None:
    """Refuse uncertainties below zero, and a covariance of unknown parameters."""
    for key, p in record.parameters.items():
        if _SCALE_FACTOR.fullmatch(key) and not abs(p.value) >= SMALLEST:
            raise RecordError(f"parameters.{key}: a scale factor of {p.value:g}; expected another than 0")
        for value in (p.standard_uncertainty, p.standard_uncertainty_given_order):
            if value is not None and value < 0:
                raise RecordError(f"parameters.{key}: a standard uncertainty of {value:g}; expected 0 or more")
        if p.interval_95 is not None and not p.interval_95[0] <= p.value <= p.interval_95[1]:
            low, high = p.interval_95
            raise RecordError(f"parameters.{key}: interval_95 from {low:g} to {high:g}; expected it to hold the value")
    names, matrix = record.covariance.names, record.covariance.array()
    unknown = [key for key in names if key not in record.parameters]
    if unknown or len(set(names)) < len(names):
        wrong = unknown[0] if unknown else next(key for key in names if names.count(key) > 1)
        raise RecordError(f"covariance.names: expected each a parameter, once, found {wrong!r}")
    spread = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    if (np.diag(matrix) < 0).any() or (np.abs(matrix) > _ROUNDING * np.outer(spread, spread)).any():
        raise RecordError("covariance.matrix: a correlation beyond 1, or a variance below 0")
    if (np.abs(matrix - matrix.T) > (_ROUNDING - 1) * np.outer(spread, spread)).any():
        raise RecordError("covariance.matrix: expected a symmetric matrix")
    stated = spread > 0
    correlation = matrix[np.ix_(stated, stated)] / np.outer(spread[stated], spread[stated])
    if correlation.size and (least := float(np.linalg.eigvalsh(correlation)[0])) < 1 - _ROUNDING:
        raise RecordError(
            f"covariance.matrix: a combination of parameters has a variance below 0 (the correlations have an "
            f"eigenvalue of {least:.3g})"
        )


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        raise ValueError("a key appears twice")
    return content


def _refuse_constant(text: str) -> None:
    raise ValueError(f"{text} is not a finite number")

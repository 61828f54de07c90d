"""What a certificate says, from its file: the XML, or the PDF that it is attached to, and whether its signature holds.

A small file of its own: nothing that writes certificates needs it. The summary is of any Digital Calibration
Certificate, whoever wrote it; nothing in the XML is followed or expanded.
"""

from __future__ import annotations

import math
import re
import zlib
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from imulab.certificate.digits import limits_text, rounded, times_power
from imulab.display import aligned, printable
from imulab.errors import ReadError, install, readable
from imulab.files import open_file

_NAMES = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si", "ds": "http://www.w3.org/2000/09/xmldsig#"}
_TITLES = ["parameter", "value", "U", "k", "unit", "limits", "conformity"]
_LARGEST = 50_000_000
_STREAM = re.compile(rb"/EmbeddedFile\b[^\n]*?>>\s*stream\r?\n")
_LINES = (
    ("certificate", "dcc:administrativeData/dcc:coreData/dcc:uniqueIdentifier"),
    ("issued", "dcc:administrativeData/dcc:coreData/dcc:issueDate"),
    ("laboratory", "dcc:administrativeData/dcc:calibrationLaboratory/dcc:contact/dcc:name/dcc:content"),
    ("customer", "dcc:administrativeData/dcc:customer/dcc:name/dcc:content"),
    ("item", "dcc:administrativeData/dcc:items/dcc:item/dcc:name/dcc:content"),
    ("serial", "dcc:administrativeData/dcc:items/dcc:item/dcc:identifications/dcc:identification/dcc:value"),
)


def certificate_in(path: str) -> bytes | None:
    """Return the XML of a certificate, of its own file or attached to a PDF; None where a file is neither.

    Raises
    ------
    ReadError
        It is a PDF without a certificate, or cannot be read.
    """
    if path == "-" or not Path(path).is_file():
        return None
    with readable(path), open_file(path) as stream:
        begin = stream.read(4096)
        if not begin.startswith(b"%PDF-") and b"digitalCalibrationCertificate" not in begin:
            return None
        data = begin + stream.read(_LARGEST)
    if not data.startswith(b"%PDF-"):
        return data
    for match in _STREAM.finditer(data):
        try:
            text = zlib.decompressobj().decompress(data[match.end() :], _LARGEST)
        except zlib.error:
            text = data[match.end() : match.end() + _LARGEST].partition(b"endstream")[0]
        if b"digitalCalibrationCertificate" in text[:4096]:
            return text
    raise ReadError(f"{path}: a PDF without a Digital Calibration Certificate in it; expected a record or recording")


def describe_certificate(xml: bytes, path: str) -> str:
    """Return number, laboratory, item and results of a certificate, and whether its signature holds.

    Raises
    ------
    ReadError
        It is no sound XML, or was changed after it was signed.
    """
    if b"<!DOCTYPE" in xml or b"<!ENTITY" in xml:
        raise ReadError(f"{path}: a certificate with a document type of its own; expected none")
    try:
        root = ElementTree.fromstring(xml)
    except ElementTree.ParseError as error:
        raise ReadError(f"{path}: not a whole certificate: {error}") from None
    version = f"Digital Calibration Certificate {root.get('schemaVersion', '')}".strip()
    lines = [f"{printable(path)}: {version}"]
    lines += [f"{title}: {text}" for title, place in _LINES if (text := _text(root, place))]
    for statement in root.iterfind("dcc:administrativeData/dcc:statements/dcc:statement[dcc:conformity]", _NAMES):
        texts = _text(statement, "dcc:conformity"), _text(statement, "dcc:declaration/dcc:content")
        lines.append(f"conformity: {', '.join(filter(None, texts))}")
    for section in root.iterfind("dcc:measurementResults/dcc:measurementResult", _NAMES):
        rows = [_row(each) for each in section.iterfind(".//dcc:quantity[@refType='basic_calibrationValue']", _NAMES)]
        lines += ["", _text(section, "dcc:name/dcc:content")]
        shown = 7 if any(row[-1] != "–" for row in rows) else 5
        lines += aligned(_TITLES[:shown], [row[:shown] for row in rows]) if rows else []
    return "\n".join([*lines, "", f"signature: {_signature(root, xml, path)}"])


def _text(parent: Any, place: str) -> str:
    return printable(" ".join((parent.findtext(place, "", _NAMES) or "").split()))


def _row(quantity: Any) -> list[str]:
    """Return name, value, U, k, unit, limits and decision of a quantity as texts; a dash for what is not there."""
    value, name = _text(quantity, ".//si:value"), _text(quantity, "dcc:name/dcc:content")
    unit = _text(quantity, ".//si:unit").replace("\\tothe", "^").replace("\\", " ").strip()
    unit = re.sub(r"\{([^{}]*)\}", r"\1", unit)
    univariate = ".//si:measurementUncertaintyUnivariate//si:"
    expanded, standard, low, high, k = (
        _text(quantity, univariate + place)
        for place in ("valueExpandedMU", "valueStandardMU", "intervalMin", "intervalMax", "coverageFactor")
    )
    spread, power = expanded or standard or "–", 0
    known = [_number(value), *(_number(text) for text in (low, high) if text)]
    if (u := _number(spread)) > 0 and all(map(math.isfinite, [*known, u])):
        (value, *ends), spread, power = rounded(known, u)
        spread = " … ".join(ends) if ends else spread
    lower, upper = (
        _number(_text(quantity, f".//dcc:quantity[@refType='basic_toleranceLimit{end}']//si:value"))
        for end in ("Lower", "Upper")
    )
    limits = limits_text(lower, upper, power).strip() if math.isfinite(lower) or math.isfinite(upper) else "–"
    factor = f"{_number(k):.4g}" if k else "–" if low or not standard else "1"
    unit = "1" if unit == "one" else unit
    unit = f"×{times_power(unit, power)}" if power else unit
    return [name, value or "–", spread, factor, unit, limits, _text(quantity, ".//dcc:conformity") or "–"]


def _number(text: str) -> float:
    """Return the number of a text; not a number where there is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _signature(root: Any, xml: bytes, path: str) -> str:
    """Return whether a signature is there and holds.

    Raises
    ------
    ReadError
        It does not hold: the certificate was changed.
    """
    signature = root.find("ds:Signature", _NAMES)
    if signature is None:
        return "none, so a change would not show; imulab certificate --sign KEY.pem makes one"
    try:
        signxml, x509, serialization = map(
            import_module, ("signxml", "cryptography.x509", "cryptography.hazmat.primitives.serialization")
        )
    except ImportError:
        return f"there is one, which was not verified: {install('sign')}, and show it again"
    encoded = "".join((signature.findtext(".//ds:X509Certificate", "", _NAMES) or "").split())
    pem = f"-----BEGIN CERTIFICATE-----\n{encoded}\n-----END CERTIFICATE-----\n"
    try:
        signer = x509.load_pem_x509_certificate(pem.encode())
        signxml.XMLVerifier().verify(xml, x509_cert=pem)
        # An empty address is that of the whole document; another is of a part, beside which anything may stand, and
        # of two signatures another than this may be the one that holds.
        signatures, addresses = (list(root.iter(f"{{{_NAMES['ds']}}}{tag}")) for tag in ("Signature", "Reference"))
        whole = len(signatures) == 1 and [each.get("URI") for each in addresses] == [""]
    except Exception as error:  # of the libraries' own kinds
        raise ReadError(f"{path}: the signature does not hold, so the certificate was changed: {error}") from None
    if not whole:
        raise ReadError(f"{path}: the signature is of a part of the certificate; expected one of the whole")
    digest = sha256(signer.public_bytes(serialization.Encoding.DER)).hexdigest()
    return (
        f"holds, nothing was changed since {printable(signer.subject.rfc4514_string())} signed it; that this is the "
        f"laboratory's key is not checked: compare the SHA-256 of its certificate, {digest}"
    )

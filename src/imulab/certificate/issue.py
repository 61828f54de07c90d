"""The public functions: a record and LAB.toml to the file of a certificate, and a folder of records to one each.

Alone, as the other modules write no file and read no record.
"""

from __future__ import annotations

import os
from pathlib import Path

from imulab.arguments import checked
from imulab.certificate.dcc import dcc_xml
from imulab.certificate.laboratory import Laboratory, Language, load_laboratory
from imulab.certificate.model import Certificate, make_certificate, with_before
from imulab.errors import ImulabError, OptionError
from imulab.files import replacing
from imulab.procedures.registry import load_sealed
from imulab.procedures.result import Record, as_record


@checked
def write_certificate(
    record: Record,
    path: str | Path,
    *,
    lab: str | Path,
    limits: str | Path | None = None,
    before: Record | None = None,
    language: Language | None = None,
    fonts: str | Path | None = None,
) -> None:
    """Write the certificate of a record, whole or not at all: XML for programs, or a PDF for people that holds it.

    The XML is PTB's Digital Calibration Certificate 3.3.0, the PDF is PDF/A-3 with that attached. Values, uncertainties
    and covariances are the record's, bit for bit in the XML; persons and places are those of the laboratory.

    Parameters
    ----------
    record
        A record, a fit that holds it, or its file.
    path
        File to write, XML or PDF by its name.
    lab
        TOML file of the laboratory; the guide on certificates lists its keys.
    limits
        TOML file of limits, as of a fleet's report: whether each parameter conforms, by the rule in `lab`. None if not
        given.
    before
        The unit's record from before it was adjusted, which the certificate then holds too.
    language
        "en" or "de"; that of `lab` if not given.
    fonts
        Folder of fonts for letters that the PDF's own do not have.

    Raises
    ------
    RecordError
        The record was altered, is bad, is not reviewed where its verdict is look, or is of no unit.
    ReadError
        The laboratory's file cannot be read, or lacks something.
    OptionError
        The file cannot be written there, the laboratory's file says something else than the record, or a letter is in
        none of the fonts.
    UnitError
        The D-SI has no name for a unit.

    Examples
    --------
    >>> import imulab as il
    >>> fit = il.fit_tumble(il.simulate_tumble(gravity=9.81), order=1, gravity=9.81)
    >>> il.write_certificate(fit, "sn42.pdf", lab="LAB.toml")
    Traceback (most recent call last):
    imulab.errors.ReadError: LAB.toml: no such laboratory file
    """
    if Path(path).suffix not in (".xml", ".pdf"):
        raise OptionError(f"output {str(path)!r}: expected a name that ends with .xml or .pdf")
    stated = load_laboratory(str(lab))
    made = _certificate(record, stated, limits, language)
    if before is not None:
        made = with_before(made, _certificate(before, stated, limits, language))
    content = dcc_xml(made)
    if Path(path).suffix == ".pdf":
        from imulab.certificate.page import pdf  # typst is of an extra, and takes 20 ms to load

        content = pdf(made, content, None if fonts is None else str(fonts))
    with replacing(path) as stream:
        stream.write(content)


def _certificate(record: Record, lab: Laboratory, limits: str | Path | None, language: Language | None) -> Certificate:
    if isinstance(record, str | os.PathLike):
        name, (calibration, sha256) = f"{record}: ", load_sealed(os.fspath(record))
    else:
        name, calibration = "", as_record(record, "write_certificate")
        sha256 = calibration.sealed()[0]
    try:
        return make_certificate(calibration, sha256, lab, None if limits is None else str(limits), language)
    except ImulabError as error:
        raise type(error)(f"{name}{error}") from None

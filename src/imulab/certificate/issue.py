"""The public function: a record and LAB.toml to the file of a certificate.

Alone, as the other modules write no file and read no record.
"""

from __future__ import annotations

import os
from pathlib import Path

from imulab.arguments import checked
from imulab.certificate.dcc import dcc_xml
from imulab.certificate.laboratory import load_laboratory
from imulab.certificate.model import make_certificate
from imulab.errors import ImulabError, OptionError
from imulab.files import replacing
from imulab.procedures.registry import load_sealed
from imulab.procedures.result import Record, as_record


@checked
def write_certificate(record: Record, path: str | Path, *, lab: str | Path, limits: str | Path | None = None) -> None:
    """Write the Digital Calibration Certificate of a record, PTB's DCC 3.3.0, whole or not at all.

    Values, uncertainties and covariances are the record's, bit for bit; persons and places are those of the laboratory.

    Parameters
    ----------
    record
        A record, a fit that holds it, or its file.
    path
        XML file to write.
    lab
        TOML file of the laboratory; the guide on certificates lists its keys.
    limits
        TOML file of limits, as of a fleet's report: whether each parameter conforms, by the rule in `lab`. None if not
        given.

    Raises
    ------
    RecordError
        The record was altered, is bad, is not reviewed where its verdict is look, or is of no unit.
    ReadError
        The laboratory's file cannot be read, or lacks something.
    OptionError
        The file cannot be written there, or the laboratory's file says something else than the record.
    UnitError
        The D-SI has no name for a unit.

    Examples
    --------
    >>> import imulab as il
    >>> fit = il.fit_tumble(il.simulate_tumble(gravity=9.81), order=1, gravity=9.81)
    >>> il.write_certificate(fit, "sn42.xml", lab="LAB.toml")
    Traceback (most recent call last):
    imulab.errors.ReadError: LAB.toml: no such laboratory file
    """
    if Path(path).suffix != ".xml":
        raise OptionError(f"output {str(path)!r}: expected a name that ends with .xml")
    stated = load_laboratory(str(lab))
    if isinstance(record, str | os.PathLike):
        name, (calibration, sha256) = f"{record}: ", load_sealed(os.fspath(record))
    else:
        name, calibration = "", as_record(record, "write_certificate")
        sha256 = calibration.sealed()[0]
    try:
        text = dcc_xml(make_certificate(calibration, sha256, stated, None if limits is None else str(limits)))
    except ImulabError as error:
        raise type(error)(f"{name}{error}") from None
    with replacing(path) as stream:
        stream.write(text)

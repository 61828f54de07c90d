"""The public functions: a record and LAB.toml to the file of a certificate, and a folder of records to one each.

Alone, as the other modules write no file and read no record.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from msgspec.structs import replace

from imulab.arguments import Folder, checked
from imulab.certificate.dcc import dcc_xml
from imulab.certificate.laboratory import Laboratory, LaboratoryError, Language, load_laboratory
from imulab.certificate.model import (
    SERIAL,
    Certificate,
    make_certificate,
    rule_of_conformity,
    with_before,
    with_days_of_recordings,
)
from imulab.certificate.texts import LANGUAGES
from imulab.errors import ImulabError, OptionError, RecordError, listed
from imulab.files import replacing
from imulab.fleet.limits import load_limits
from imulab.fleet.run import FleetState, fleet_status
from imulab.fleet.statistics import parameter_units
from imulab.fleet.store import Store
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
    sign: str | Path | None = None,
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
    sign
        PEM file of a private key and its certificate, by which the XML is signed (XMLDSig).

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
    imulab.errors.ReadError: LAB.toml: no such laboratory file; imulab certificate --template -o LAB.toml writes one
    """
    if Path(path).suffix not in (".xml", ".pdf"):
        raise OptionError(f"output {str(path)!r}: expected a name that ends with .xml or .pdf")
    stated = _laboratory(lab, language)
    made = _certificate(record, stated, limits)
    if before is not None:
        made = with_before(made, _certificate(before, stated, limits))
    _write(made, [Path(path)], lab, fonts, sign)


@checked
def write_fleet_certificates(
    folder: Folder,
    output: Folder,
    *,
    lab: str | Path,
    limits: str | Path | None = None,
    language: Language | None = None,
    fonts: str | Path | None = None,
    sign: str | Path | None = None,
    progress: Callable[[int], object] | None = None,
) -> dict[str, str]:
    """Return why units of a fleet have no certificate, by serial number; of all others PDF and XML are written.

    Parameters
    ----------
    folder, output
        Folder of the fleet, and the one in which ``SERIAL.pdf`` and ``SERIAL.xml`` are written.
    lab
        As for `write_certificate`; its number has ``{serial}``. Where a recording tells its day, that is the day of
        calibration, within those that `lab` states.
    limits, language, fonts, sign
        As for `write_certificate`.
    progress
        Called with the number of units that are done.

    Raises
    ------
    ReadError, OptionError
        The folder is none of a fleet, a folder cannot be made; the laboratory's file, the limits or their rule, the
        fonts or the key cannot be used.

    Examples
    --------
    >>> import imulab as il
    >>> il.write_fleet_certificates("line", "certificates", lab="LAB.toml")
    Traceback (most recent call last):
    imulab.errors.ReadError: LAB.toml: no such laboratory file; imulab certificate --template -o LAB.toml writes one
    """
    stated = _laboratory(lab, language)
    if SERIAL not in stated.certificate.number:
        raise OptionError(
            f"{lab}: certificate.number {stated.certificate.number!r}: expected {SERIAL} in it, so that each unit's "
            "certificate has a number of its own"
        )
    store, refused = Store(Path(folder)), {}
    units = store.manifest().units
    if stated.item.serial is not None and len(units) > 1:
        raise OptionError(f"{lab}: item.serial {stated.item.serial!r}: each unit of a fleet has its own; leave it out")
    _check_common(stated, limits, fonts, sign)
    if limits is not None:
        _check_limits(str(limits), fleet_status(folder))
    new = not Path(output).exists()
    try:
        Path(output).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OptionError(f"{output}: cannot be made: {error.strerror}") from None
    for count, unit in enumerate(units, start=1):
        try:
            if not store.record(unit.serial).exists():
                raise RecordError(f"it has no record: {store.reason(unit.serial) or 'fleet run makes it'}")
            made = _certificate(store.record(unit.serial), stated, limits)
            made = with_days_of_recordings(made)
            _write(made, [Path(output) / f"{unit.serial}{ending}" for ending in (".xml", ".pdf")], lab, fonts, sign)
        except LaboratoryError:
            with suppress(OSError):  # it holds files of earlier units
                if new:
                    Path(output).rmdir()
            raise
        except ImulabError as error:
            refused[unit.serial] = str(error)
        if progress is not None:
            progress(count)
    return refused


def _check_common(
    lab: Laboratory, limits: str | Path | None, fonts: str | Path | None, sign: str | Path | None
) -> None:
    """Refuse once what would be refused for every unit of a fleet."""
    from imulab.certificate.page import load_typst

    load_typst(None if fonts is None else str(fonts))
    if limits is not None:
        rule_of_conformity(lab, str(limits))
    if sign is not None:
        from imulab.certificate.signature import signed

        signed(b"<trial/>", str(sign), lab.certificate.issued)


def _check_limits(limits: str, fleet: FleetState) -> None:
    """Refuse once limits that no record of a fleet can be held against."""
    summaries = [row.summary for row in fleet.rows if row.summary is not None]
    units = parameter_units(summaries)
    procedures = dict.fromkeys(summary.procedure for summary in summaries) or [""]
    limits_by_procedure = [load_limits(limits, units, only=procedure) for procedure in procedures]
    if summaries and not any(limits_by_procedure):
        raise OptionError(f"{limits}: no limits of a parameter of these records")


def _write(
    certificate: Certificate, paths: list[Path], lab: str | Path, fonts: str | Path | None, sign: str | Path | None
) -> None:
    """Write the files of a certificate; all are made before the first is written, as a PDF may be refused."""
    xml = dcc_xml(certificate)
    if sign is not None:
        from imulab.certificate.signature import signed  # signxml is of an extra, and takes 90 ms to load

        xml = signed(xml, str(sign), certificate.lab.certificate.issued)
    contents = [xml] * len(paths)
    if any(path.suffix == ".pdf" for path in paths):
        from imulab.certificate.page import pdf  # typst is of an extra, and takes 20 ms to load

        page = pdf(certificate, xml, str(lab), None if fonts is None else str(fonts))
        contents = [page if path.suffix == ".pdf" else xml for path in paths]
    for path, content in zip(paths, contents, strict=True):
        with replacing(path) as stream:
            stream.write(content)


def _laboratory(lab: str | Path, language: str | None) -> Laboratory:
    """Return what the laboratory states, in this language if it is not None."""
    stated = load_laboratory(str(lab))
    if language is None:
        return stated
    if language not in LANGUAGES:
        raise OptionError(f"language {language!r}: expected one of {listed(LANGUAGES, str(language))}")
    return replace(stated, certificate=replace(stated.certificate, language=language))


def _certificate(record: Record, lab: Laboratory, limits: str | Path | None) -> Certificate:
    if isinstance(record, str | os.PathLike):
        name, (calibration, sha256) = f"{record}: ", load_sealed(os.fspath(record))
    else:
        name, calibration = "", as_record(record, "write_certificate")
        sha256 = calibration.sealed()[0]
    try:
        return make_certificate(calibration, sha256, lab, None if limits is None else str(limits))
    except ImulabError as error:
        raise type(error)(f"{name}{error}") from None

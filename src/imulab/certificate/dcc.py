"""A certificate as PTB's Digital Calibration Certificate, XML.

Numbers are written by `repr`, so that every double is read back as it was. Prefixes stand before all names: a default
namespace breaks digests of signatures. Source: PTB dcc.xsd 3.3.0, SI_Format.xsd 2.2.1 and dcc.sch, which wants methods,
software and conditions inside a measurement result.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from decimal import Decimal
from xml.etree import ElementTree as ET

from imulab.certificate.laboratory import Address, Condition, Equipment, Party
from imulab.certificate.model import NORMAL, Certificate, Result
from imulab.certificate.texts import Words, agreed_rule, equipment_text, evaluation, remarks, statements
from imulab.certificate.units import dsi_unit
from imulab.estimation.distributions import chi_square_upper_quantile
from imulab.fleet.limits import Conformity, Limits

SCHEMA = "3.3.0"
"""Version of the schema that is written."""
_SPACES = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}
_XSI = "http://www.w3.org/2001/XMLSchema-instance"
_COVERED = 0.95
"""Probability of the ellipsoid of all parameters together, whose factor is the root of a quantile of chi-square."""
_ISSUED_UNDER = "ISO/IEC 17025:2017"


def dcc_xml(certificate: Certificate) -> bytes:
    """Return the certificate as XML, UTF-8, indented; the same certificate gives the same bytes."""
    root = ET.Element(
        "dcc:digitalCalibrationCertificate",
        {
            **{f"xmlns:{prefix}": space for prefix, space in _SPACES.items()},
            "xmlns:xsi": _XSI,
            "schemaVersion": SCHEMA,
            "xsi:schemaLocation": f"{_SPACES['dcc']} https://ptb.de/dcc/v{SCHEMA}/dcc.xsd",
        },
    )
    words = Words(certificate.lab.certificate.language)
    _administrative(root, certificate, words)
    results = _add(root, "measurementResults")
    before = certificate.before
    if before is not None:
        _measurement(_add(results, "measurementResult"), before, words, "before")
    _measurement(_add(results, "measurementResult"), certificate, words, "after" if before is not None else "")
    for content in root.iter("dcc:content"):
        content.attrib.setdefault("lang", words.language)
    ET.indent(root)
    text: str = ET.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'.encode()


# Elements and texts.


def _add(parent: ET.Element, name: str, text: str | None = None, **attributes: str) -> ET.Element:
    """Return a new child, of the name space ``dcc`` where the name states none."""
    child = ET.SubElement(parent, name if ":" in name else f"dcc:{name}", attributes)
    child.text = text
    return child


def _words(parent: ET.Element, name: str, text: str, language: str | None = None) -> None:
    """Add a text, in the language of the certificate if not stated."""
    _add(_add(parent, name), "content", text, **({} if language is None else {"lang": language}))


def _optional(parent: ET.Element, name: str, text: object | None) -> None:
    if text is not None:
        _add(parent, name, str(text))


# The head: who, what, when.


def _administrative(root: ET.Element, certificate: Certificate, words: Words) -> None:
    lab, head = certificate.lab, _add(root, "administrativeData")
    _software(_add(head, "dccSoftware"), certificate.record.software)
    core, identity = _add(head, "coreData"), lab.certificate
    _add(core, "countryCodeISO3166_1", lab.laboratory.address.country)
    for language in dict.fromkeys((words.language, "en")):  # the record's own sentences are English
        _add(core, "usedLangCodeISO639_1", language)
    _add(core, "mandatoryLangCodeISO639_1", words.language)
    _add(core, "uniqueIdentifier", identity.number)
    if lab.customer.order is not None:
        _identification(_add(core, "identifications"), "customer", lab.customer.order, words("order"))
    _optional(core, "receiptDate", identity.received)
    _add(core, "beginPerformanceDate", str(identity.performed[0]))
    _add(core, "endPerformanceDate", str(identity.performed[1]))
    _add(core, "performanceLocation", identity.location)
    _add(core, "issueDate", str(identity.issued))
    if identity.replaces is not None:
        amended = _add(core, "reportAmendedSubstituted")
        _add(amended, "typeOfChange", "amended")
        _add(amended, "replacedUniqueIdentifier", identity.replaces)
    _item(_add(head, "items"), certificate, words)
    laboratory = _add(head, "calibrationLaboratory")
    _optional(laboratory, "calibrationLaboratoryCode", lab.laboratory.code)
    _contact(_add(laboratory, "contact"), lab.laboratory)
    persons = _add(head, "respPersons")
    for person in lab.persons:
        entry = _add(persons, "respPerson")
        _words(_add(entry, "person"), "name", person.name)
        _add(entry, "role", person.role)
        if person.signs:
            _add(entry, "mainSigner", "true")
    _contact(_add(head, "customer"), lab.customer)
    _statements(_add(head, "statements"), certificate, words)


def _software(parent: ET.Element, software: str) -> None:
    """Add a program; PTB's Schematron wants a letter before the numbers of a release."""
    name, _, release = software.partition(" ")
    entry = _add(parent, "software")
    _words(entry, "name", name)
    _add(entry, "release", f"v{release}")


def _identification(parent: ET.Element, issuer: str, value: str, name: str) -> None:
    entry = _add(parent, "identification")
    _add(entry, "issuer", issuer)
    _add(entry, "value", value)
    _words(entry, "name", name)


def _item(parent: ET.Element, certificate: Certificate, words: Words) -> None:
    stated, item = certificate.lab.item, _add(parent, "item")
    _words(item, "name", stated.name)
    _words(item, "description", words("stated condition", stated.condition))
    _words(_add(item, "manufacturer"), "name", stated.manufacturer)
    _optional(item, "model", certificate.model)
    _identification(_add(item, "identifications"), "manufacturer", certificate.serial, words("serial number"))


def _contact(parent: ET.Element, party: Party) -> None:
    _words(parent, "name", party.name)
    _optional(parent, "eMail", party.email)
    _location(_add(parent, "location"), party.address)


def _location(parent: ET.Element, address: Address) -> None:
    _add(parent, "street", address.street)
    _optional(parent, "streetNo", address.number)
    _add(parent, "postCode", address.postcode)
    _add(parent, "city", address.city)
    _add(parent, "countryCode", address.country)


def _statements(parent: ET.Element, certificate: Certificate, words: Words) -> None:
    for clause, text in statements(certificate, words):
        entry = _add(parent, "statement")
        _add(entry, "norm", _ISSUED_UNDER)
        _add(entry, "reference", clause)
        _words(entry, "declaration", text)
    entry = _add(parent, "statement")
    _add(entry, "traceable", "true")
    _add(entry, "norm", _ISSUED_UNDER)
    _add(entry, "reference", "7.8.4.1 c")
    _words(entry, "declaration", certificate.lab.traceability.statement)
    if (next_time := certificate.lab.certificate.recalibration) is not None:
        entry = _add(parent, "statement", refType="basic_recalibration")
        _words(entry, "declaration", words("recalibration", next_time.agreed, next_time.date))
        _add(entry, "date", str(next_time.date))
    for remark, language in remarks(certificate, words):
        _words(_add(parent, "statement"), "declaration", remark, language)
    if (rule := agreed_rule(certificate, words)) is not None and certificate.state is not None:
        entry = _add(parent, "statement")
        _add(entry, "norm", _ISSUED_UNDER)
        _add(entry, "reference", "7.8.6")
        _words(entry, "declaration", rule)
        _add(entry, "conformity", certificate.state)


# The results.


def _measurement(result: ET.Element, certificate: Certificate, words: Words, adjustment: str) -> None:
    """Add what was measured; `adjustment` is ``before`` or ``after`` it, empty without one."""
    lab, record = certificate.lab, certificate.record
    _words(result, "name", f"{lab.method.name}, {words(adjustment)}" if adjustment else lab.method.name)
    method = _add(_add(result, "usedMethods"), "usedMethod")
    _words(method, "name", lab.method.name)
    _words(
        method,
        "description",
        f"{words('procedure')}: {lab.method.procedure}; {words('deviations')}: {lab.method.deviations}; "
        f"{words('evaluation')}: {evaluation(certificate, words)}",
    )
    for standard in lab.method.standards:
        _add(method, "norm", standard)
    _software(_add(result, "usedSoftware"), record.software)
    if lab.equipment:
        equipment = _add(result, "measuringEquipments")
        for known in lab.equipment:
            _equipment(_add(equipment, "measuringEquipment", refType="basic_normalUsed"), known, words)
    conditions = ET.Element("dcc:influenceConditions")
    for name, stated in certificate.conditions(words("gravity"), words("temperature")):
        entry = _add(conditions, "influenceCondition")
        _words(entry, "name", name)
        if adjustment:
            _add(entry, "status", f"{adjustment}Adjustment")
        _condition(_add(_add(_add(entry, "data"), "quantity"), "si:real"), stated)
    if len(conditions):
        result.append(conditions)
    entry = _add(_add(result, "results"), "result")
    _words(entry, "name", words("parameters"))
    data = _add(entry, "data")
    covered = [each.name for each in certificate.results if each.name in record.covariance.names]
    ids = {name: f"{adjustment}parameter_{number}" for number, name in enumerate(covered, start=1)}
    for each in certificate.results:
        shared = {"id": ids[each.name]} if each.name in ids else {}
        _quantity(_add(data, "quantity", refType="basic_calibrationValue", **shared), each, words)
    if covered:
        _covariance(data, certificate, ids, words)
    _provenance(_add(result, "measurementMetaData"), certificate, words)


def _equipment(parent: ET.Element, standard: Equipment, words: Words) -> None:
    _words(parent, "name", standard.name)
    _words(parent, "description", equipment_text(standard, words))
    _identification(_add(parent, "identifications"), "other", standard.certificate, words("certificate"))


def _condition(real: ET.Element, condition: Condition) -> None:
    _add(real, "si:value", repr(condition.value))
    _add(real, "si:unit", dsi_unit(condition.unit)[0])
    if condition.expanded_uncertainty:
        _expanded(real, condition.expanded_uncertainty, condition.coverage_factor, NORMAL[1], "normal")


def _expanded(real: ET.Element, uncertainty: float, factor: float, probability: float, distribution: str) -> None:
    expanded = _add(_add(real, "si:measurementUncertaintyUnivariate"), "si:expandedMU")
    _add(expanded, "si:valueExpandedMU", repr(uncertainty))
    _add(expanded, "si:coverageFactor", _plain(factor))
    _add(expanded, "si:coverageProbability", _plain(probability))
    _add(expanded, "si:distribution", distribution)


def _plain(number: float) -> str:
    """Return a number without an exponent, which coverage factors and probabilities must not have."""
    return f"{Decimal(repr(number)):f}"


def _quantity(quantity: ET.Element, result: Result, words: Words) -> None:
    _words(quantity, "name", result.name)
    real = _add(quantity, "si:real")
    _add(real, "si:label", result.name)
    _add(real, "si:value", repr(result.value))
    _add(real, "si:unit", result.dsi)
    if result.interval is None:
        _expanded(
            real,
            result.expanded_uncertainty,
            result.coverage_factor,
            result.probability,
            result.distribution,
        )
    else:
        covered = _add(_add(real, "si:measurementUncertaintyUnivariate"), "si:coverageIntervalMU")
        _add(covered, "si:valueStandardMU", repr(result.standard_uncertainty))
        _add(covered, "si:intervalMin", repr(result.interval[0]))
        _add(covered, "si:intervalMax", repr(result.interval[1]))
        _add(covered, "si:coverageProbability", _plain(result.probability))
    if result.definition or result.decision is not None:
        told = _add(quantity, "measurementMetaData")
        if result.definition:
            unit = _add(told, "metaData")
            _add(unit, "nonSIDefinition", result.definition)
            _add(unit, "nonSIUnit", result.unit)
        if result.decision is not None and result.limits is not None:
            data = _add(told, "metaData", refType="basic_conformity")
            _conformity(data, result, result.decision, result.limits, words)


def _conformity(parent: ET.Element, result: Result, decision: Conformity, limits: Limits, words: Words) -> None:
    """Add a decision with its probability, the limits, and those within which a value passes."""
    _words(parent, "declaration", words("probability", words.number(f"{decision.probability:.4f}")))
    _add(parent, "conformity", decision.state)
    data = _add(parent, "data")
    for kind, ends in (("tolerance", limits), ("acceptance", decision.acceptance)):
        for end, value in (("Lower", ends.lower), ("Upper", ends.upper)):
            if math.isfinite(value):
                quantity = _add(data, "quantity", refType=f"basic_{kind}Limit{end}")
                real = _add(quantity, "si:real")
                _add(real, "si:value", repr(value))
                _add(real, "si:unit", result.dsi)


def _covariance(data: ET.Element, certificate: Certificate, ids: Mapping[str, str], words: Words) -> None:
    """Add the standard uncertainties and the covariance matrix, a column for each parameter of `ids`."""
    names, covariance = list(ids), certificate.record.covariance
    chosen = [result for result in certificate.results if result.name in ids]
    quantity = _add(data, "quantity", refId=" ".join(ids.values()))
    _words(quantity, "name", words("covariance"))
    values = _add(quantity, "si:realListXMLList")
    _add(values, "si:labelXMLList", " ".join(names))
    _add(values, "si:valueXMLList", " ".join(repr(result.value) for result in chosen))
    _add(values, "si:unitXMLList", " ".join(result.dsi for result in chosen))
    standard = _add(_add(values, "si:measurementUncertaintyUnivariateXMLList"), "si:standardMUXMLList")
    _add(standard, "si:valueStandardMUXMLList", " ".join(repr(result.standard_uncertainty) for result in chosen))
    region = _add(_add(values, "si:measurementUncertaintyMultivariateXMLList"), "si:ellipsoidalRegionMUXMLList")
    matrix = _add(region, "si:covarianceMatrixXMLList")
    for result, column in zip(chosen, covariance.block(names).tolist(), strict=True):
        entries = _add(matrix, "si:columnXMLList")
        for other, value in zip(chosen, column, strict=True):
            entry = _add(entries, "si:covarianceXMLList")
            _add(entry, "si:valueXMLList", repr(value))
            _add(entry, "si:unitXMLList", dsi_unit(f"({result.unit})*({other.unit})")[0])
    reach = math.sqrt(float(chi_square_upper_quantile(1 - _COVERED, len(names))))
    _add(region, "si:coverageFactorXMLList", _plain(reach))
    _add(region, "si:coverageProbabilityXMLList", _plain(_COVERED))


def _provenance(parent: ET.Element, certificate: Certificate, words: Words) -> None:
    """Add the hashes of the record and of the recordings that it was made from."""
    for name, sha256 in certificate.sources(words("record")):
        entry = _add(parent, "metaData", refType="imulab_source")
        _words(entry, "name", name)
        _add(entry, "reference", f"sha256:{sha256}")

"""The sentences of a certificate in each language, once for the XML and the PDF.

What the laboratory and the record say is printed as it stands there; the record's own sentences are English.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from decimal import Decimal
from typing import Any, get_args

from imulab.certificate.digits import printed_unit
from imulab.certificate.laboratory import Equipment, Language
from imulab.certificate.model import Certificate
from imulab.procedures.registry import procedure_of

LANGUAGES = get_args(Language)
_TEXTS: Mapping[str, tuple[str, str]] = {
    "title": ("Calibration certificate", "Kalibrierschein"),
    "number": ("No.", "Nr."),
    "page": ("Page {} of {}", "Seite {} von {}"),
    "end": ("End of the certificate", "Ende des Kalibrierscheins"),
    "laboratory": ("Laboratory", "Laboratorium"),
    "customer": ("Customer", "Auftraggeber"),
    "order": ("order", "Auftrag"),
    "item": ("Item", "Kalibriergegenstand"),
    "manufacturer": ("Manufacturer", "Hersteller"),
    "model": ("Model", "Typ"),
    "serial": ("Serial number", "Seriennummer"),
    "condition": ("Condition of the item", "Zustand des Gegenstands"),
    "received": ("Received", "Eingang"),
    "performed": ("Calibrated", "Kalibriert"),
    "to": ("{} to {}", "{} bis {}"),
    "place": ("Place of calibration", "Ort der Kalibrierung"),
    "issued": ("Issued", "Ausgestellt"),
    "replaces": ("Replaces", "Ersetzt"),
    "reason": (
        "This certificate amends and replaces certificate {}. Reason: {}",
        "Dieser Kalibrierschein ändert und ersetzt den Kalibrierschein {}. Grund: {}",
    ),
    "at laboratory": ("laboratory", "Laboratorium"),
    "at customer": ("customer", "Auftraggeber"),
    "at laboratoryBranch": ("branch of the laboratory", "Außenstelle des Laboratoriums"),
    "at customerBranch": ("branch of the customer", "Außenstelle des Auftraggebers"),
    "at other": ("another place", "anderer Ort"),
    "method and conditions": ("Method and conditions", "Verfahren und Bedingungen"),
    "method": ("Method", "Verfahren"),
    "procedure": ("Procedure", "Anweisung"),
    "standards": ("Standards", "Normen"),
    "deviations": ("Deviations", "Abweichungen"),
    "evaluation": ("Evaluation", "Auswertung"),
    "evaluated": ("{}, procedure {}", "{}, Prozedur {}"),
    "with": ("options: {}", "Optionen: {}"),
    "conditions": ("Conditions", "Bedingungen"),
    "gravity": ("Gravity in the evaluation", "Schwerebeschleunigung in der Auswertung"),
    "temperature": ("Temperature of the item", "Temperatur des Gegenstands"),
    "equipment": ("Standards used", "Verwendete Normale"),
    "standard": ("Certificate {} of {}", "Kalibrierschein {} von {}"),
    "standard uncertainty": ("standard uncertainty {} {}", "Standardmessunsicherheit {} {}"),
    "certificate": ("certificate", "Kalibrierschein"),
    "traceability": ("Traceability", "Metrologische Rückführung"),
    "results": ("Results", "Ergebnisse"),
    "before": ("before the adjustment", "vor der Justierung"),
    "after": ("after the adjustment", "nach der Justierung"),
    "parameters": ("Parameters", "Parameter"),
    "parameter": ("Parameter", "Parameter"),
    "value": ("Value", "Wert"),
    "unit": ("Unit", "Einheit"),
    "limits": ("Limits", "Grenzwerte"),
    "conformity": ("Conformity", "Konformität"),
    "covariance": ("Covariance of the parameters", "Kovarianz der Parameter"),
    "correlations": ("Correlations, numbered as above", "Korrelationen, nummeriert wie oben"),
    "no correlations": (
        "The covariance matrix of {} parameters is in the attached file.",
        "Die Kovarianzmatrix von {} Parametern steht in der angehängten Datei.",
    ),
    "U": (
        "U = k u is the expanded uncertainty: the standard uncertainty u times the coverage factor k, for a coverage "
        "probability of {}, evaluated by JCGM 100:2008. It holds what the evaluation states; drift in later use is "
        "not in it.",
        "U = k u ist die erweiterte Messunsicherheit: die Standardmessunsicherheit u mal dem Erweiterungsfaktor k, für "
        "eine Überdeckungswahrscheinlichkeit von {}, ermittelt nach JCGM 100:2008. Sie enthält, was die Auswertung "
        "angibt; eine Drift bei späterem Gebrauch ist nicht enthalten.",
    ),
    "t": ("{} (Student's t)", "{} (t-Verteilung)"),
    "normal": ("{} (normal)", "{} (Normalverteilung)"),
    "or": (" or ", " oder "),
    "interval": (
        "Where an interval stands in place of U, it holds the value with 95 %.",
        "Wo statt U ein Intervall steht, enthält es den Wert mit einer Wahrscheinlichkeit von 95 %.",
    ),
    "not SI": ("Unit outside the SI: {}.", "Einheit außerhalb des SI: {}."),
    "statement of conformity": ("Statement of conformity", "Konformitätsaussage"),
    "simple": ("a value passes within its limits", "ein Wert besteht innerhalb seiner Grenzen"),
    "guarded": (
        "a value passes within its limits less its expanded uncertainty",
        "ein Wert besteht innerhalb seiner um die erweiterte Messunsicherheit verengten Grenzen",
    ),
    "bands": (
        "a value passes within its limits less its expanded uncertainty, passes on condition within its limits, fails "
        "on condition beyond them by at most its expanded uncertainty",
        "ein Wert besteht innerhalb seiner um die erweiterte Messunsicherheit verengten Grenzen, besteht bedingt "
        "innerhalb seiner Grenzen, besteht bedingt nicht bis zur erweiterten Messunsicherheit jenseits davon",
    ),
    "agreed": (
        "Conformity with {}, decided by the rule {} ({}), as agreed: {}.",
        "Konformität mit {}, bewertet nach der Entscheidungsregel {} ({}), wie vereinbart: {}.",
    ),
    "all conform": (
        "Probability that all values conform: {}.",
        "Wahrscheinlichkeit, dass alle Werte konform sind: {}.",
    ),
    "p": (
        "p is the probability that the value of the parameter lies within its limits (JCGM 106:2012, 7).",
        "p ist die Wahrscheinlichkeit, dass der Wert des Parameters innerhalb seiner Grenzen liegt (JCGM 106:2012, 7).",
    ),
    "probability": ("Probability of conformity: {}", "Wahrscheinlichkeit der Konformität: {}"),
    "overall": ("All together", "Insgesamt"),
    "pass": ("pass", "bestanden"),
    "conditionalPass": ("conditional pass", "bedingt bestanden"),
    "conditionalFail": ("conditional fail", "bedingt nicht bestanden"),
    "fail": ("fail", "nicht bestanden"),
    "remarks": ("Remarks", "Bemerkungen"),
    "reviewed": ("Reviewed: {}", "Geprüft: {}"),
    "exact": (
        "Gravity {} m/s² was taken as exact in the evaluation.",
        "Die Schwerebeschleunigung {} m/s² galt in der Auswertung als exakt.",
    ),
    "left out": (
        "{} values without uncertainty are in the record, not in this certificate.",
        "{} Werte ohne Messunsicherheit stehen im Datensatz, nicht in diesem Kalibrierschein.",
    ),
    "one left out": (
        "1 value without uncertainty is in the record, not in this certificate.",
        "1 Wert ohne Messunsicherheit steht im Datensatz, nicht in diesem Kalibrierschein.",
    ),
    "hopeless": (
        "{}: the uncertainty is more than half of the tolerance, no value can pass.",
        "{}: Die Messunsicherheit ist mehr als die halbe Toleranz, kein Wert kann bestehen.",
    ),
    "only this": (
        "The results relate only to the item calibrated, in the condition described.",
        "Die Ergebnisse gelten nur für den kalibrierten Gegenstand in dem beschriebenen Zustand.",
    ),
    "whole": (
        "The certificate must not be reproduced except in full without the laboratory's written approval.",
        "Der Kalibrierschein darf ohne schriftliche Genehmigung des Laboratoriums nur vollständig vervielfältigt "
        "werden.",
    ),
    "recalibration": ("Next calibration, as agreed ({}): {}", "Nächste Kalibrierung, wie vereinbart ({}): {}"),
    "provenance": ("Provenance", "Herkunft"),
    "record": ("record", "Datensatz"),
    "attached": (
        "The same certificate for programs is attached to this file (Digital Calibration Certificate {}).",
        "Derselbe Kalibrierschein für Programme ist an diese Datei angehängt (Digital Calibration Certificate {}).",
    ),
    "serial number": ("serial number", "Seriennummer"),
    "stated condition": ("Condition: {}", "Zustand: {}"),
}


class Words:
    """The texts of a language.

    Examples
    --------
    >>> Words("de")("page", 1, 2)
    'Seite 1 von 2'
    """

    def __init__(self, language: str) -> None:
        self.language = language
        self._index = LANGUAGES.index(language)

    def __call__(self, key: str, *values: object) -> str:
        """Return a text with its places filled."""
        return _TEXTS[key][self._index].format(*values) if values else _TEXTS[key][self._index]

    def number(self, text: str) -> str:
        """Return a number as people write it: a comma in German, a minus sign of its own length."""
        return (text.replace(".", ",") if self.language == "de" else text).replace("-", "\N{MINUS SIGN}")


def statements(certificate: Certificate, words: Words) -> Iterator[tuple[str, str]]:
    """Yield clause of ISO/IEC 17025:2017 and text of what is stated of the certificate as a whole."""
    yield "7.8.2.1 l", words("only this")
    yield "7.8.2.1", words("whole")
    if certificate.lab.certificate.replaces is not None:
        yield "7.8.8", words("reason", certificate.lab.certificate.replaces, certificate.lab.certificate.reason)


def remarks(certificate: Certificate, words: Words) -> list[tuple[str, str]]:
    """Return what the reader must know besides, each with its language; the record's own sentences are English."""
    record = certificate.record
    reasons = [(reason, "en") for reason in (*record.verdict.reasons, *procedure_of(record).reservations(record))]
    if certificate.before is not None:
        reasons += [(f"before the adjustment: {reason}", "en") for reason in certificate.before.record.verdict.reasons]
    others: list[str] = []
    if certificate.lab.certificate.reviewed is not None:
        others.append(words("reviewed", certificate.lab.certificate.reviewed))
    gravity = record.model.get("gravity")
    if isinstance(gravity, Mapping) and str(gravity.get("from", "")).endswith("taken as exact"):
        others.append(words("exact", words.number(repr(gravity["value"]))))
    if certificate.left_out:
        others.append(words("one left out" if certificate.left_out == 1 else "left out", certificate.left_out))
    bands = {each.name: each.decision.acceptance for each in certificate.results if each.decision is not None}
    if hopeless := [name for name, band in bands.items() if band.lower > band.upper]:
        others.append(words("hopeless", ", ".join(hopeless)))
    return reasons + [(text, words.language) for text in others]


def agreed_rule(certificate: Certificate, words: Words) -> str | None:
    """Return by which rule was decided, and the probability that all values conform; None without decisions."""
    agreed = certificate.lab.conformity
    if agreed is None or certificate.all_conform is None:
        return None
    rule = words("agreed", agreed.specification, agreed.rule, words(agreed.rule), agreed.agreed)
    return f"{rule} {words('all conform', words.number(probability_text(certificate.all_conform)))}"


def evaluation(certificate: Certificate, words: Words) -> str:
    """Return which program evaluated by which procedure with which options."""
    record = certificate.record
    made = words("evaluated", record.software, record.procedure)
    options = ", ".join(f"{key} {_plain(value)}" for key, value in record.options.items() if value is not None)
    return f"{made}; {words('with', options)}" if options else made


def equipment_text(standard: Equipment, words: Words) -> str:
    """Return the certificate of a standard, who issued it, and its uncertainty where stated."""
    text, known = words("standard", standard.certificate, standard.issuer), standard.standard_uncertainty
    if known is None:
        return text
    value = words.number(f"{Decimal(repr(known.value)):f}")
    return f"{text}, {words('standard uncertainty', value, printed_unit(known.unit))}"


def probability_text(probability: float) -> str:
    """Return a probability to three digits, none of which is 0 or 1 by rounding."""
    return "> 0.999" if probability > 0.9995 else "< 0.001" if probability < 0.0005 else f"{probability:.3f}"


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_plain(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return " ".join(_plain(item) for item in value)
    return str(value)

"""A certificate as a PDF for people, with the XML attached: PDF/A-3a for archives, PDF/UA-1 for screen readers.

Typst lays out what stands in `page.typ`; texts go to it as data. Sources: ISO 19005-3; ISO 14289-1; typst 0.15.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime, time
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import to_builtins

from imulab.certificate.dcc import SCHEMA
from imulab.certificate.digits import limits_text, printed_unit, rounded, significant, smaller_units, times_power
from imulab.certificate.laboratory import LaboratoryError, Party, counted
from imulab.certificate.model import Certificate, Result
from imulab.certificate.texts import (
    Words,
    agreed_rule,
    equipment_text,
    evaluation,
    probability_text,
    remarks,
    statements,
)
from imulab.errors import OptionError, install

_ATTACHMENT = "certificate.xml"
_STANDARDS = ["a-3a", "ua-1"]
_MOST_CORRELATED = 16
"""Parameters whose correlations fit across a page."""
_MISSING = re.compile(r"the text `?\"(.+?)\"`? could not be displayed")


def pdf(certificate: Certificate, xml: bytes, lab: str, fonts: str | None = None) -> bytes:
    """Return the certificate as a PDF that holds its XML; the same certificate gives the same bytes.

    Parameters
    ----------
    certificate
        What is printed.
    xml
        The same as `dcc_xml` wrote it.
    lab
        Name of the laboratory's file in messages.
    fonts
        Folder of further fonts.

    Raises
    ------
    OptionError
        Typst is not installed, or its fonts lack a letter.
    """
    typst = load_typst(fonts)
    folders = [] if fonts is None else [fonts]
    families = {font.family for font in typst.Fonts(False, False, folders).fonts()} if folders else set()
    page = _page(certificate) | {"fonts": sorted(families)}
    compiler = typst.Compiler(
        files("imulab.certificate").joinpath("page.typ").read_bytes(),
        font_paths=folders,
        ignore_system_fonts=True,
        sys_inputs={"data": json.dumps(page), "xml": xml.decode()},
    )
    day = datetime.combine(certificate.lab.certificate.issued, time(), UTC)
    try:
        made: bytes = compiler.compile(format="pdf", pdf_standards=_STANDARDS, timestamp=day)
    except typst.TypstError as error:
        if missing := _MISSING.search(str(error)):
            raise _no_letter(missing[1], certificate, lab) from None
        reason = f"the PDF cannot be laid out: {str(error).splitlines()[0]}"
        if "decode image" in str(error):  # Typst says no other way that it is the logo
            raise LaboratoryError(f"{lab}: laboratory.logo: {reason}") from None
        raise OptionError(reason) from None
    return made


def load_typst(fonts: str | None) -> Any:
    """Return Typst; raise an OptionError where it is not installed, or `fonts` is no folder."""
    try:
        typst = import_module("typst")
    except ImportError:
        raise OptionError(f"a PDF needs typst, which is not here: {install('certificate')}") from None
    if fonts is not None and not Path(fonts).is_dir():
        raise OptionError(f"fonts {fonts!r}: expected a folder of fonts")
    return typst


def _no_letter(letters: str, certificate: Certificate, lab: str) -> OptionError:
    """Say which letter no font has, and where it stands."""
    texts = _texts(to_builtins(certificate.lab), "")
    serial = certificate.serial  # which the number may hold
    place = next((counted(place) for place, text in texts if letters in text.replace(serial, "")), "")
    codes = " ".join(f"U+{ord(letter):04X}" for letter in letters)
    reason = (
        f"no font of the PDF has the letter {letters!r} ({codes}); expected --fonts DIR with a font that has it, or "
        "another spelling (the XML takes every letter)"
    )
    return LaboratoryError(f"{lab}: {place}: {reason}") if place else OptionError(f"the record: {reason}")


def _texts(value: Any, place: str) -> Iterator[tuple[str, str]]:
    """Yield the texts of a file of the laboratory, each with its place."""
    if isinstance(value, str):
        yield place, value
    elif isinstance(value, Mapping | list):
        items = value.items() if isinstance(value, Mapping) else enumerate(value)
        for key, item in items:
            step = f"[{key}]" if isinstance(key, int) else f".{key}"
            yield from _texts(item, f"{place}{step}".removeprefix("."))


# What is printed, as plain texts.


def _page(certificate: Certificate) -> dict[str, Any]:
    lab, words = certificate.lab, Words(certificate.lab.certificate.language)
    issued = lab.certificate.issued
    logo = lab.laboratory.logo
    return {
        "language": words.language,
        "title": words("title"),
        "number_label": words("number"),
        "number": lab.certificate.number,
        "laboratory": lab.laboratory.name,
        "issued": {"year": issued.year, "month": issued.month, "day": issued.day},
        "whole": words("whole"),
        "page": words("page", "#", "%"),
        "end": words("end"),
        "attachment": _ATTACHMENT,
        "description": words("attached", SCHEMA),
        "logo": None if logo is None else list(Path(logo).read_bytes()),
        "logo_format": None if logo is None else Path(logo).suffix[1:].lower().replace("jpeg", "jpg"),
        "head": _head(certificate, words),
        "sections": list(_sections(certificate, words)),
        "signers": [[person.name, person.role] for person in lab.persons if person.signs],
    }


def _head(certificate: Certificate, words: Words) -> list[tuple[str, str]]:
    lab, identity = certificate.lab, certificate.lab.certificate
    first, last = identity.performed
    customer = _party(lab.customer)
    if lab.customer.order is not None:
        customer += f"; {words('order')} {lab.customer.order}"
    rows = [
        (words("laboratory"), _party(lab.laboratory)),
        (words("customer"), customer),
        (words("item"), lab.item.name),
        (words("manufacturer"), lab.item.manufacturer),
        (words("model"), certificate.model),
        (words("serial"), certificate.serial),
        (words("condition"), lab.item.condition),
        (words("received"), identity.received),
        (words("performed"), first if first == last else words("to", first, last)),
        (words("place"), words(f"at {identity.location}")),
        (words("issued"), identity.issued),
        (words("replaces"), identity.replaces),
    ]
    return [(label, str(text)) for label, text in rows if text is not None]


def _party(party: Party) -> str:
    at = party.address
    street = at.street if at.number is None else f"{at.street} {at.number}"
    code = "" if party.code is None else f" ({party.code})"
    email = "" if party.email is None else f"; {party.email}"
    return f"{party.name}{code}; {street}, {at.postcode} {at.city}, {at.country}{email}"


def _sections(certificate: Certificate, words: Words) -> Iterator[dict[str, Any]]:
    lab = certificate.lab
    yield _section(words("method and conditions"), {"kind": "pairs", "rows": _method(certificate, words)})
    before = certificate.before
    if before is not None:
        yield _section(f"{words('results')}, {words('before')}", *_results(before, words))
        yield _section(f"{words('results')}, {words('after')}", *_results(certificate, words))
    else:
        yield _section(words("results"), *_results(certificate, words))
    if (rule := agreed_rule(certificate, words)) is not None and certificate.state is not None:
        overall = f"{words('overall')}: {words(certificate.state)}."
        yield _section(words("statement of conformity"), *map(_text, (rule, words("p"), overall)))
    notes = [_text(text, language) for text, language in remarks(certificate, words)]
    notes += [_text(text) for clause, text in statements(certificate, words) if clause != "7.8.2.1"]
    if (following := lab.certificate.recalibration) is not None:
        notes.append(_text(words("recalibration", following.agreed, following.date)))
    yield _section(words("remarks"), *notes)
    hashes = [(name, f"sha256:{sha256}") for name, sha256 in certificate.sources(words("record"))]
    if before is not None:
        hashes += [
            (f"{name}, {words('before')}", f"sha256:{sha256}") for name, sha256 in before.sources(words("record"))
        ]
    yield _section(words("provenance"), _text(words("attached", SCHEMA)), {"kind": "hashes", "rows": hashes})


def _section(title: str, *blocks: Mapping[str, Any]) -> dict[str, Any]:
    return {"title": title, "blocks": blocks}


def _text(text: str, language: str | None = None) -> dict[str, Any]:
    return {"kind": "text", "text": text, "language": language}


def _method(certificate: Certificate, words: Words) -> list[tuple[str, str]]:
    lab = certificate.lab
    conditions = []
    for name, condition in certificate.conditions(words("gravity"), words("temperature")):
        unit = printed_unit(condition.unit)
        if condition.expanded_uncertainty:
            (value,), spread, power = rounded([condition.value], condition.expanded_uncertainty)
            shown = f"({words.number(value)} ± {words.number(spread)}) {times_power(unit, power)}"
        else:
            shown = f"{words.number(f'{condition.value:.9g}')} {unit}"
        conditions.append((name, shown))
    standards = [(words("standards"), ", ".join(lab.method.standards))] if lab.method.standards else []
    return [
        (words("method"), lab.method.name),
        (words("procedure"), lab.method.procedure),
        *standards,
        (words("deviations"), lab.method.deviations),
        (words("evaluation"), evaluation(certificate, words)),
        *conditions,
        *((words("equipment"), f"{each.name}; {equipment_text(each, words)}") for each in lab.equipment),
        (words("traceability"), lab.traceability.statement),
    ]


# The table of results.


def _results(certificate: Certificate, words: Words) -> Iterator[dict[str, Any]]:
    results = certificate.results
    sizes = [
        (result.unit, size)
        for result in results
        for size in (result.value, result.expanded_uncertainty, *(result.interval or ()))
    ]
    units = smaller_units(sizes)
    judged = any(result.decision is not None for result in results)
    head = ["", words("parameter"), words("value"), "U", words("unit"), "k"]
    align = ["right", "name", "right", "right", "left", "right"]
    if judged:
        head += [words("limits"), words("conformity"), "p"]
        align += ["right", "left", "right"]
    rows = [_row(number, result, units, words, judged) for number, result in enumerate(results, start=1)]
    for column in (2, 3):
        _align_decimals(rows, column, "," if words.language == "de" else ".")
    yield {
        "kind": "table",
        "head": head,
        "align": align,
        "rows": rows,
        "size": 8.5 if judged else 9.5,
        "inset": 4,
        "breakable": True,
    }
    kinds = {
        words("normal" if result.distribution == "normal" else "t", words.number(f"{100 * result.probability:g} %"))
        for result in results
        if result.interval is None
    }
    if kinds:
        yield _text(words("U", words("or").join(sorted(kinds))))
    if any(result.interval is not None for result in results):
        yield _text(words("interval"))
    if definitions := dict.fromkeys(result.definition for result in results if result.definition):
        yield _text(words("not SI", "; ".join(definitions)))
    yield from _correlations(certificate, words)


def _row(number: int, result: Result, units: Mapping[str, tuple[str, int]], words: Words, judged: bool) -> list[Any]:
    unit, power = units[result.unit]
    if result.dsi == r"\one" and not result.definition:
        unit = "1"
    if result.interval is None:
        (value,), spread, common = rounded([result.value], result.expanded_uncertainty, power)
        k = words.number(significant(result.coverage_factor))
    else:
        (value, low, high), _, common = rounded([result.value, *result.interval], result.standard_uncertainty, power)
        spread, k = f"{low} … {high}", "–"
    row = [str(number), result.name, *map(words.number, (value, spread)), times_power(unit, common), k]
    if not judged:
        return row
    if result.decision is None or result.limits is None:
        return [*row, "–", "–", "–"]
    ends = limits_text(result.limits.lower, result.limits.upper, power + common)
    state = {"text": words(result.decision.state), "pad": 0, "sign": False, "state": result.decision.state}
    shown = probability_text(result.decision.probability)
    return [*row, words.number(ends), state, words.number(shown)]


def _align_decimals(rows: Sequence[list[Any]], column: int, sign: str) -> None:
    """Make cells of the numbers of a column, with the digits that each lacks to the longest fraction of its unit."""
    longest: dict[str, int] = {}
    for row in rows:
        longest[row[4]] = max(longest.get(row[4], 0), len(row[column].partition(sign)[2]) * ("…" not in row[column]))
    for row in rows:
        text, most = row[column], longest[row[4]]
        if "…" not in text:
            lacks = most - len(text.partition(sign)[2])
            row[column] = {"text": text, "pad": lacks, "sign": bool(most and sign not in text), "state": ""}


def _correlations(certificate: Certificate, words: Words) -> Iterator[dict[str, Any]]:
    names = certificate.record.covariance.names
    numbers = [n for n, result in enumerate(certificate.results, start=1) if result.name in names]
    if len(numbers) < 2:
        return
    if len(numbers) > _MOST_CORRELATED:
        yield _text(words("no correlations", len(numbers)))
        return
    block = certificate.record.covariance.block([certificate.results[n - 1].name for n in numbers])
    spread = np.sqrt(np.diag(block))
    matrix = block / np.outer(spread, spread)
    rows = []
    for row, n in enumerate(numbers):
        known = [_correlation(value, words) for value in matrix[row, :row].tolist()]
        rows.append([str(n), *known, "1", *[""] * (len(numbers) - row - 1)])
    yield {"kind": "caption", "text": words("correlations")}
    yield {
        "kind": "table", "head": ["", *map(str, numbers)], "align": ["right"] * (len(numbers) + 1), "rows": rows,
        "size": 8 if len(numbers) < 13 else 6.5, "inset": 3, "breakable": False,
    }  # fmt: skip


def _correlation(value: float, words: Words) -> str:
    text = f"{value:.2f}"
    return words.number(text.removeprefix("-") if float(text) == 0 else text)

"""What the laboratory states of a certificate: LAB.toml, its checks, and a commented one to start from.

Nothing of it is invented: what the certificate needs and the file lacks is refused by its place.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Iterable, Mapping
from datetime import date, timedelta
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct, inspect

from imulab.certificate.units import dsi_unit
from imulab.display import first_hidden
from imulab.errors import OptionError, ReadError, UnitError, first_of, listed, quoted
from imulab.files import load_toml, unit_of
from imulab.fleet.limits import Rule
from imulab.quantities import LARGEST


def _as(text: str, **limits: Any) -> Meta:
    """Return limits of a value, and what messages expect of it."""
    return Meta(description=text, **limits)


Text = Annotated[str, _as("a text that is not empty and has no space at its ends", pattern=r"^\S+(\s+\S+)*$")]
"""A text that the schema of certificates takes."""
Texts = Annotated[list[Text], _as('a list of texts such as ["IEEE Std 1293-2018"]')]
Day = Annotated[date, _as("a day such as 2026-11-24")]
Unit = Annotated[Text, _as("a unit of at most 64 characters, without a space at its ends", max_length=64)]
Number = Annotated[float, _as("a number", ge=-LARGEST, le=LARGEST)]
Size = Annotated[float, _as("a number above 0", gt=0, le=LARGEST)]
Country = Annotated[str, _as("two capital letters such as DE", pattern="^[A-Z]{2}$")]
Language = Literal["en", "de"]
Location = Literal["laboratory", "customer", "laboratoryBranch", "customerBranch", "other"]


class LaboratoryError(OptionError):
    """The laboratory's file cannot be used, whatever the unit."""


class _Table(Struct, frozen=True, forbid_unknown_fields=True):
    """A table of the file; a key that it does not know may be misspelt, and is refused."""


class Address(_Table, frozen=True, kw_only=True):
    """Where a laboratory or a customer is; the country by ISO 3166-1."""

    street: Text
    number: Text | None = None
    postcode: Text
    city: Text
    country: Country


class Party(_Table, frozen=True, kw_only=True):
    """The laboratory or the customer; `logo` is the laboratory's, PNG, JPEG or SVG."""

    name: Text
    address: Address
    email: Text | None = None
    code: Text | None = None
    logo: Text | None = None
    order: Text | None = None


class Person(_Table, frozen=True, kw_only=True):
    """Who is responsible; who `signs` authorises the certificate."""

    name: Text
    role: Text
    signs: Annotated[bool, _as("true or false")] = False


class Recalibration(_Table, frozen=True, kw_only=True):
    """The day of the next calibration, which is stated only where the customer agreed to it (7.8.4.3)."""

    date: Day
    agreed: Text


class Identity(_Table, frozen=True, kw_only=True):
    """The table ``certificate``: number, dates and place."""

    number: Text
    issued: Day
    performed: Annotated[tuple[Day, Day], _as("the first and the last day, such as [2026-11-24, 2026-11-25]")]
    location: Location
    language: Language = "en"
    received: Day | None = None
    reviewed: Text | None = None
    replaces: Text | None = None
    reason: Text | None = None
    recalibration: Recalibration | None = None


class Item(_Table, frozen=True, kw_only=True):
    """What was calibrated; model and serial must be those of the record."""

    name: Text
    manufacturer: Text
    condition: Text
    model: Text | None = None
    serial: Text | None = None


class Method(_Table, frozen=True, kw_only=True):
    """How it was calibrated: the laboratory's procedure, and where it deviates."""

    name: Text
    procedure: Text
    standards: Texts = []
    deviations: Text


class Traceability(_Table, frozen=True, kw_only=True):
    """How the results are traceable to the SI."""

    statement: Text


class Stated(_Table, frozen=True, kw_only=True):
    """A value with its unit."""

    value: Size
    unit: Unit


class Equipment(_Table, frozen=True, kw_only=True):
    """A standard; the one of `quantity` gravity is compared with the gravity of the record."""

    name: Text
    certificate: Text
    issuer: Text
    quantity: Literal["gravity"] | None = None
    standard_uncertainty: Stated | None = None


class Condition(_Table, frozen=True, kw_only=True):
    """A condition of the environment, with its expanded uncertainty."""

    name: Text
    value: Number
    unit: Unit
    expanded_uncertainty: Size
    coverage_factor: Annotated[float, _as("a number of 1 or more", ge=1, le=LARGEST)] = 2.0


class Conformity(_Table, frozen=True, kw_only=True):
    """By which rule it is decided whether values conform, where the customer agreed to it, and to what (7.1.3)."""

    rule: Rule
    agreed: Text
    specification: Text


class Laboratory(_Table, frozen=True, kw_only=True):
    """LAB.toml as a whole."""

    certificate: Identity
    laboratory: Party
    customer: Party
    persons: list[Person]
    item: Item
    method: Method
    traceability: Traceability
    equipment: list[Equipment] = []
    conditions: list[Condition] = []
    conformity: Conformity | None = None


TEMPLATE = """\
[certificate]
number = "EX-2026-0042"                  # unique in the laboratory
issued = 2026-11-27
performed = [2026-11-24, 2026-11-24]     # first and last day of the measurement
location = "laboratory"                  # or customer, laboratoryBranch, customerBranch, other
# received = 2026-11-20
# reviewed = "why a record whose verdict is look may be certified"
# replaces = "EX-2026-0041"              # which certificate this one amends, and why
# reason = "the customer's address was wrong"
# recalibration = { date = 2027-11-24, agreed = "offer 2026-118" }
language = "en"                          # or de
[laboratory]
name = "Example Inertial Laboratory"
address = { street = "Plumb Line", number = "1", postcode = "12345", city = "Exampletown", country = "DE" }
# code, email, logo = "logo.svg"
[customer]
name = "Example Drones Ltd"
address = { street = "Propeller Road", number = "2", postcode = "54321", city = "Hovertown", country = "DE" }
# order, email
[[persons]]
name = "A. Example"
role = "Head of laboratory"
signs = true                             # at least one person signs
[item]
name = "Accelerometer triad"
manufacturer = "Example Sensors AG"
condition = "as received, not adjusted"
# model and serial, which must be those of the record
[method]
name = "Multi-position tumble calibration in the local gravity field"
procedure = "QP-ACC-01, issue 3"
standards = ["IEEE Std 1293-2018"]
deviations = "none"
[traceability]
statement = "Gravity is traceable to the SI by the measurement named among the standards used."
[[equipment]]
name = "Local gravity value"
quantity = "gravity"
certificate = "GRAV-2024-017"
issuer = "Example National Metrology Institute"
standard_uncertainty = { value = 1e-6, unit = "m/s^2" }
[[conditions]]
name = "Ambient temperature"
value = 23.0
unit = "degC"
expanded_uncertainty = 0.5
# [conformity]                           # only where limits are given
# rule = "guarded"                       # or simple, bands
# agreed = "offer 2026-118 of 2026-11-02"
# specification = "data sheet DS-0815 rev. C, table 2"
"""
"""A LAB.toml to start from."""
_NAMES_SOMEBODY = (
    *("certificate.number", "laboratory.name", "customer.name", "persons[0].name", "item.manufacturer"),
    *("equipment[0].certificate", "equipment[0].issuer"),
)
_OF_TUMBLE = ("item.name", "method.name")
_LARGEST_LOGO = 2_000_000
_KEY = re.compile(r"(unknown|missing required) field `(.*)`$")
_WORD = re.compile(r"[^.\[\]]+")
_INDEX = re.compile(r"\[(\d+)\]\.?")


def load_laboratory(path: str) -> Laboratory:
    """Return the checked LAB.toml.

    Raises
    ------
    ReadError
        It cannot be read; a table or key is unknown, missing or of another kind; a text is empty, begins or ends with
        a space, or has a control character; nobody signs; days are out of order; a standard of gravity has no
        uncertainty.
    UnitError
        A unit is none of acceleration where one is expected, or has no name in the D-SI.
    """
    if not os.path.lexists(path):
        raise ReadError(f"{path}: no such laboratory file; imulab certificate --template -o LAB.toml writes one")
    table = load_toml(path, path, "laboratory")
    if hidden := first_hidden(table):
        raise ReadError(f"{path}: {counted(hidden)}: a control or bidirectional character; expected text alone")
    try:
        lab = msgspec.convert(table, Laboratory)
    except msgspec.ValidationError as error:
        raise ReadError(f"{path}: {_reason(str(error), table)}") from None
    if lab.laboratory.logo is not None:
        lab = msgspec.structs.replace(lab, laboratory=_with_logo(lab.laboratory, path))
    identity = lab.certificate
    first, last = identity.performed
    if not any(person.signs for person in lab.persons):
        raise ReadError(f"{path}: persons: nobody signs; expected signs = true for who authorises the certificate")
    if not first <= last <= identity.issued:
        raise ReadError(f"{path}: certificate: performed {first} to {last}, issued {identity.issued}: out of order")
    if (identity.replaces is None) != (identity.reason is None):
        raise ReadError(f"{path}: certificate: expected replaces and reason together: which certificate, and why")
    if identity.replaces == identity.number:
        raise ReadError(f"{path}: certificate: replaces {identity.replaces!r} is its own number; expected another")
    if identity.recalibration is not None and identity.recalibration.date <= identity.issued:
        raise ReadError(
            f"{path}: certificate.recalibration: {identity.recalibration.date}; expected a day after the day of issue"
        )
    if identity.received is not None and identity.received > first:
        raise ReadError(f"{path}: certificate: received {identity.received}, after the first day of work {first}")
    for standard in lab.equipment:
        if standard.quantity is not None:
            if standard.standard_uncertainty is None:
                raise ReadError(f"{path}: equipment {standard.name}: expected standard_uncertainty of gravity")
            unit_of(standard.standard_uncertainty.unit, "acceleration", f"{path}: equipment {standard.name}")
    for condition in lab.conditions:
        try:
            dsi_unit(condition.unit)
        except UnitError as error:
            raise UnitError(f"{path}: conditions {condition.name}: {error}") from None
    return lab


def day_remarks(path: str, created: str, today: date) -> list[str]:
    """Return a warning of a day of issue before that on which the record was `created`, or after `today`, in UTC."""
    issued, made, day = load_laboratory(path).certificate.issued, date.fromisoformat(created[:10]), timedelta(days=1)
    if issued < made - day:
        return [f"{path}: certificate.issued {issued}: before the record was made, on {made}; expected a later day"]
    if issued > today + day:
        return [f"{path}: certificate.issued {issued}: in the future; expected the day of issue"]
    return []


def template_remarks(path: str, parameters: Iterable[str] = (), *, tumbled: bool = True) -> list[str]:
    """Return warnings of what a LAB.toml still has from the template, which names nobody and a test by tumbling.

    `parameters` are those of the record that is certified; `tumbled`: by the procedure of the template.
    """
    names = list(parameters)
    lab, template = load_toml(path, path, "laboratory"), tomllib.loads(TEMPLATE)

    def unchanged(places: Iterable[str]) -> list[str]:
        values = ((place, _value(lab, place)) for place in places)
        return [
            f"{counted(place)} = {value!r}" for place, value in values if value and value == _value(template, place)
        ]

    remarks = []
    if same := unchanged(_NAMES_SOMEBODY):
        remarks.append(f"{path}: still as the template has it, which names nobody: {first_of(same, 3)}")
    of_tumble = tumbled and not any(name.startswith(("gyro_", "mag_")) for name in names)
    if not of_tumble and (same := unchanged(_OF_TUMBLE)):
        remarks.append(
            f"{path}: {' and '.join(same)}: the template's, of accelerometers that were tumbled; the record holds "
            f"{first_of(names, 3)}: say what was calibrated, and how"
        )
    return remarks


def counted(place: str) -> str:
    """Return a place such as ``persons[0].name`` as a person counts: ``persons 1: name``."""
    return _INDEX.sub(lambda index: f" {int(index[1]) + 1}: ", place).rstrip(": ")


def _value(table: Any, place: str) -> Any:
    """Return the value at a place such as ``persons[0].name``, None where there is none."""
    for key in _WORD.findall(place):
        try:
            table = table[int(key) if isinstance(table, list) else key]
        except (KeyError, IndexError, TypeError):
            return None
    return table


def _with_logo(laboratory: Party, path: str) -> Party:
    """Return the laboratory with the path of its logo, which lies beside the file."""
    logo, place = Path(path).parent / str(laboratory.logo), f"{path}: laboratory.logo {laboratory.logo!r}"
    if logo.suffix.lower() not in (".png", ".jpg", ".jpeg", ".svg"):
        raise ReadError(f"{place}: expected a name that ends with .png, .jpg or .svg")
    if not logo.is_file():
        raise ReadError(f"{place}: no such file beside it")
    if logo.stat().st_size > _LARGEST_LOGO:
        raise ReadError(f"{place}: larger than 2 MB; expected a smaller picture")
    return msgspec.structs.replace(laboratory, logo=str(logo))


def _reason(message: str, table: Mapping[str, Any]) -> str:
    """Return the place of a mistake, what is expected there and what is found, from a message of msgspec's."""
    what, _, where = message.partition(" - at `$")
    where = where.rstrip("`").lstrip(".")
    kind, place = _kind_at(where), f"{counted(where)}: " if where else ""
    if key := _KEY.search(what):
        known = {field.name: field.type for field in _plain(kind).fields}
        if key[1] == "unknown":
            return f"{place}unknown key {quoted(key[2])}; known keys: {listed(known, key[2])}"
        return f"{place}no {key[2]}; expected {_expected(known[key[2]], key[2])}"
    return f"{place}expected {_expected(kind, where)}, found {quoted(_value(table, where))}"


def _kind_at(where: str) -> Any:
    """Return the type of a place, as msgspec describes types."""
    kind: Any = inspect.type_info(Laboratory)
    for key in _WORD.findall(where):
        kind = _plain(kind)
        if isinstance(kind, inspect.StructType):
            kind = next(field.type for field in kind.fields if field.name == key)
        else:
            kind = kind.item_types[0] if isinstance(kind, inspect.TupleType) else kind.item_type
    return kind


def _plain(kind: Any) -> Any:
    """Return a type without None and without what messages say of it."""
    if isinstance(kind, inspect.UnionType):
        kind = next(each for each in kind.types if not isinstance(each, inspect.NoneType))
    return kind.type if isinstance(kind, inspect.Metadata) else kind


def _expected(kind: Any, name: str) -> str:
    """Return a type in words; `name` is that of its key."""
    if isinstance(kind, inspect.UnionType):
        kind = next(each for each in kind.types if not isinstance(each, inspect.NoneType))
    if isinstance(kind, inspect.Metadata):
        return str((kind.extra_json_schema or {})["description"])
    if isinstance(kind, inspect.LiteralType):
        return " or ".join(map(str, kind.values))
    if isinstance(kind, inspect.StructType):
        return f"a table with {', '.join(field.name for field in kind.fields if field.required)}"
    return f"tables [[{name}]], one or more"

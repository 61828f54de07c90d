"""What a certificate says, from a record and LAB.toml, with every refusal: one model for all that is written of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import date, datetime, timedelta

import msgspec
import numpy as np

from imulab.certificate.laboratory import Condition, Laboratory, Stated
from imulab.certificate.units import dsi_unit
from imulab.errors import OptionError, RecordError
from imulab.fleet.limits import Conformity, Limits, Rule, decide, load_limits, probability_of_all, worst
from imulab.records.calibration import Calibration, Parameter
from imulab.units import to_si

SERIAL = "{serial}"
"""In the number of a certificate: the serial number of the item."""
NORMAL = (2.0, 0.9545, "normal")
"""Coverage factor, probability and distribution where the record states no factor of its own."""


@dataclass(frozen=True)
class Result:
    """One parameter: its value and expanded uncertainty ``U = k u`` in its unit.

    Attributes
    ----------
    unit, dsi, definition
        Unit of the record, as the D-SI writes it, and the definition of what in it is not of the SI.
    interval
        The interval of 95 % where it is not that of U.
    limits, decision
        Its limits, and whether it conforms; None without limits.
    """

    name: str
    value: float
    standard_uncertainty: float
    coverage_factor: float
    probability: float
    distribution: str
    unit: str
    dsi: str
    definition: str
    interval: tuple[float, float] | None
    limits: Limits | None = None
    decision: Conformity | None = None

    @property
    def expanded_uncertainty(self) -> float:
        """Return U."""
        return self.coverage_factor * self.standard_uncertainty


@dataclass(frozen=True)
class Certificate:
    """All that a certificate holds.

    `left_out` counts parameters without an uncertainty; `all_conform` is the probability that all values that have
    limits lie within them, None without limits. `before` is the same of the unit before it was adjusted.
    """

    lab: Laboratory
    record: Calibration
    sha256: str
    serial: str
    model: str | None
    results: tuple[Result, ...]
    left_out: int
    all_conform: float | None = None
    before: Certificate | None = None

    def conditions(self, gravity: str, temperature: str) -> list[tuple[str, Condition]]:
        """Return the conditions by name: those of the laboratory, and what the record states under these names."""
        stated = [(condition.name, condition) for condition in self.lab.conditions]
        for name, key in ((gravity, "gravity"), (temperature, "temperature")):
            if isinstance(known := self.record.model.get(key), Mapping):
                k, u = NORMAL[0], float(known.get("standard_uncertainty") or 0.0)
                value = float(known["value"])
                if known["unit"] == "degC":
                    value = round(value, 2)  # a mean of readings, whose further digits nobody knows
                condition = Condition(name=name, value=value, unit=known["unit"], expanded_uncertainty=k * u)
                stated.append((name, condition))
        return stated

    def sources(self, record: str) -> list[tuple[str, str]]:
        """Return the names and hashes of the record, under this name, and of the recordings it was made from."""
        return [(record, self.sha256), *((source.file, source.sha256) for source in self.record.sources)]

    @property
    def state(self) -> str | None:
        """The worst of all decisions; None without limits."""
        states = [result.decision.state for result in self.results if result.decision is not None]
        return worst(states) if states else None


def make_certificate(record: Calibration, sha256: str, lab: Laboratory, limits: str | None = None) -> Certificate:
    """Return the certificate of a record whose seal was checked; `sha256` is its ``content_sha256``.

    `limits` is a TOML file of limits.

    Raises
    ------
    RecordError
        The record cannot have one: its verdict, no serial number, no parameter with an uncertainty, an uncertainty of
        gravity below that of the laboratory's standard.
    OptionError
        LAB.toml says something else than the record.
    UnitError
        The D-SI has no name for a unit.
    """
    _check_verdict(record, lab)
    serial = record.sensor.get("serial")
    if not serial:
        raise RecordError("the record names no serial number: fit again with --serial; a certificate is of one item")
    for key in ("serial", "model"):  # the schema of certificates takes no text that begins or ends with a space
        if (text := record.sensor.get(key, "")) != text.strip():
            raise RecordError(f"{key} {text!r}: a space at an end; fit again with --{key} without it")
    number = lab.certificate.number.replace(SERIAL, serial)
    lab = msgspec.structs.replace(lab, certificate=msgspec.structs.replace(lab.certificate, number=number))
    for key, stated in (("serial", lab.item.serial), ("model", lab.item.model)):
        if stated is not None and stated != record.sensor.get(key, stated):
            raise OptionError(f"item.{key} {stated!r}: the record says {record.sensor[key]!r}")
    for standard in lab.equipment:
        if standard.quantity is not None and standard.standard_uncertainty is not None:
            _check_gravity(record, standard.name, standard.standard_uncertainty)
    if len(record.model.get("serials", ())) > 1:
        raise RecordError("the record is of several units; a certificate is of one item")
    _check_days(record, lab)
    results = tuple(_results(record))
    if not results:
        raise RecordError("no parameter of the record has an uncertainty: there is nothing to certify")
    model = record.sensor.get("model", lab.item.model)
    together = None
    if limits is not None:
        results, together = _decide(record, results, lab, limits)
    return Certificate(lab, record, sha256, serial, model, results, len(record.parameters) - len(results), together)


def with_before(certificate: Certificate, before: Certificate) -> Certificate:
    """Return a certificate with the one of the same unit before it was adjusted.

    Raises
    ------
    OptionError
        The two are not of one unit and one procedure, or in the wrong order.
    """
    for what, found, expected in (
        ("serial", before.serial, certificate.serial),
        ("procedure", before.record.procedure, certificate.record.procedure),
    ):
        if found != expected:
            raise OptionError(f"before: {what} {found!r}; expected {expected!r}, that of the record after it")
    if before.sha256 == certificate.sha256:
        raise OptionError("before: the same record; expected the one from before the adjustment")
    earlier, later = (
        [source.measured for source in each.record.sources if source.measured is not None]
        for each in (before, certificate)
    )
    if earlier and later and min(earlier)[:10] > max(later)[:10]:
        raise OptionError(f"before: measured {min(earlier)}, after {max(later)}, the last day of the record after it")
    return replace(certificate, before=before)


def with_days_of_recordings(certificate: Certificate) -> Certificate:
    """Return a certificate whose days of work are those that its recordings tell, where they do."""
    days = sorted(source.measured for source in certificate.record.sources if source.measured is not None)
    if not days or any("T" in day for day in days):  # a time in UTC does not tell the day of the place
        return certificate
    performed = date.fromisoformat(days[0]), date.fromisoformat(days[-1])
    identity = msgspec.structs.replace(certificate.lab.certificate, performed=performed)
    return replace(certificate, lab=msgspec.structs.replace(certificate.lab, certificate=identity))


def rule_of_conformity(lab: Laboratory, limits: str) -> Rule:
    """Return the rule by which values conform to limits; raise an OptionError where LAB.toml has none."""
    if lab.conformity is None:
        raise OptionError(
            f"{limits}: limits need a rule that the customer agreed to; expected [conformity] in LAB.toml with rule, "
            "agreed, specification"
        )
    return lab.conformity.rule


def _decide(
    record: Calibration, results: tuple[Result, ...], lab: Laboratory, limits: str
) -> tuple[tuple[Result, ...], float]:
    """Return the results with their decisions, and the probability that all conform."""
    rule = rule_of_conformity(lab, limits)
    units = {(record.procedure, name): parameter.unit for name, parameter in record.parameters.items()}
    known = {name: each for (_, name), each in load_limits(limits, units, only=record.procedure).items()}
    freedom = record.fit.get("effective_degrees_of_freedom")
    decided: list[Result] = []
    for result in results:
        if (ends := known.pop(result.name, None)) is None:
            decided.append(result)
            continue
        u, k = result.standard_uncertainty, result.coverage_factor
        decision = decide(result.value, u, k, ends, rule, freedom)
        decided.append(replace(result, limits=ends, decision=decision))
    if known:
        raise OptionError(f"{limits}: {', '.join(sorted(known))}: no uncertainty in the record, nothing can be decided")
    judged = [result for result in decided if result.limits is not None]
    if not judged:
        raise OptionError(f"{limits}: no limits of a parameter of this record")
    covariance = np.diag([result.standard_uncertainty**2 for result in judged])
    rows = [row for row, result in enumerate(judged) if result.name in record.covariance.names]
    covariance[np.ix_(rows, rows)] = record.covariance.block([judged[row].name for row in rows])
    within = [result.limits for result in judged if result.limits is not None]
    return tuple(decided), probability_of_all([result.value for result in judged], covariance, within, freedom)


def _check_verdict(record: Calibration, lab: Laboratory) -> None:
    state, reasons = record.verdict.state, "; ".join(record.verdict.reasons)
    if state == "bad":
        raise RecordError(f"the record's verdict is bad: {reasons}")
    if state == "look" and lab.certificate.reviewed is None:
        raise RecordError(
            "the record's verdict is look; expected certificate.reviewed to say why it may be certified: " + reasons
        )


_ZONES = timedelta(hours=12), timedelta(hours=14)
"""How far clocks are behind and ahead of UTC at most."""


def _check_days(record: Calibration, lab: Laboratory) -> None:
    """Refuse days of work that are not those of the recordings, where these tell theirs."""
    first, last = lab.certificate.performed
    for source in record.sources:
        if source.measured is None:
            continue
        begin = datetime.fromisoformat(source.measured)
        behind, ahead = _ZONES if begin.tzinfo else (timedelta(), timedelta())
        if (begin + ahead).date() < first or (begin - behind).date() > last:
            raise OptionError(
                f"certificate.performed {first} to {last}: {source.file} says that it was measured {source.measured}"
            )


def _check_gravity(record: Calibration, standard: str, uncertainty: Stated) -> None:
    """Refuse a record whose gravity is stated better than that of the standard it is traced to."""
    gravity = record.model.get("gravity")
    if not isinstance(gravity, Mapping):
        raise RecordError(
            f"{standard}: equipment of gravity, but the record is made without gravity; leave this equipment out"
        )
    if "standard_uncertainty" not in gravity:  # a centrifuge: no result depends on how well it is known
        raise RecordError(
            f"{standard}: equipment of gravity, but a {record.procedure} record takes gravity as exact; leave this "
            "equipment out"
        )
    stated = gravity.get("standard_uncertainty")
    least = to_si(uncertainty.value, uncertainty.unit)
    if stated is None or stated < least * (1 - 1e-9):
        found = "none" if stated is None else f"{stated:g} m/s^2"
        raise RecordError(
            f"uncertainty of gravity in the record: {found}, below {least:g} m/s^2 of {standard}; fit again with "
            f"--gravity {gravity['value']!r}+-{least:g} (a fleet: in the manifest's column gravity)"
        )


def _results(record: Calibration) -> list[Result]:
    return [
        _result(record, name, parameter, u)
        for name, parameter in record.parameters.items()
        if (u := parameter.standard_uncertainty) is not None and u > 0
    ]


def _result(record: Calibration, name: str, parameter: Parameter, u: float) -> Result:
    factor = record.fit.get("coverage_factor_95")
    if isinstance(factor, Mapping):
        factor = factor.get(name)
    k, probability, distribution = NORMAL
    if isinstance(factor, int | float) and factor >= 1:
        k, probability, distribution = float(factor), 0.95, "t"
    dsi, definition = dsi_unit(parameter.unit)
    interval = parameter.interval_95
    if interval is not None:
        probability = 0.95
    return Result(
        name, parameter.value, u, k, probability, distribution, parameter.unit, dsi, definition, interval
    )  # fmt: skip

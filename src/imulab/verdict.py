"""The verdict on a result: can it be used as it is, should a person look first, or must it not be used.

A procedure writes its findings as sentences. A plain ``str`` asks a person to look; a `Bad` one forbids use as it is; a
`Note` is worth knowing and changes nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

State = Literal["good", "look", "bad"]


class Note(str):
    """A finding that does not lower the verdict."""

    __slots__ = ()


class Bad(str):
    """A finding after which the result must not be used as it is."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class Verdict:
    """``good``, ``look`` or ``bad``, and the findings that led to it, the gravest first."""

    state: State
    reasons: tuple[str, ...] = ()


UNJUDGED = Verdict("good")
"""Stands for a verdict that has not been formed yet."""

SENTENCES: dict[State, str] = {
    "good": "nothing in the data speaks against this result",
    "look": "understand this before you use the result",
    "bad": "do not use this result as it is",
}


def verdict_of(findings: Iterable[str]) -> Verdict:
    """Return the verdict that a procedure's findings lead to."""
    findings = tuple(findings)
    grave = [finding for finding in findings if isinstance(finding, Bad)]
    doubtful = [finding for finding in findings if not isinstance(finding, Bad | Note)]
    return Verdict("bad" if grave else "look" if doubtful else "good", tuple(map(str, grave + doubtful)))


def as_judged(findings: Iterable[str], verdict: Verdict) -> tuple[str, ...]:
    """Return findings, read back as plain texts, as what they were when they led to a verdict.

    What is no reason is a `Note`; the first reason of a bad verdict is `Bad` (the others cannot be told apart).
    """
    worst = verdict.reasons[0] if verdict.state == "bad" and verdict.reasons else None
    return tuple(
        Bad(finding) if finding == worst else finding if finding in verdict.reasons else Note(finding)
        for finding in findings
    )

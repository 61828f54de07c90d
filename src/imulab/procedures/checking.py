"""A test of a record by new data: what it means, what to do next, and what was measured, as text, JSON and report."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, ClassVar

import numpy as np

from imulab._version import VERSION
from imulab.display import Bad, Note, verdict_of
from imulab.procedures.result import Drawn
from imulab.records.calibration import Calibration
from imulab.report import render_page
from imulab.report.traces import Exhibits, Figure, ReportTable


def probability_text(probability: float | None, least: float = 1e-12) -> str:
    """Return a probability for a sentence: ``p = 0.031``; below `least` it is told as such."""
    if probability is None:
        return "not tested"
    return f"p = {probability:.2g}" if probability >= least else f"p below {least:g}"


def probability_fact(probability: float | None, least: float = 1e-12) -> str:
    """Return a probability as a value beside its label: ``0.031``."""
    return probability_text(probability, least).removeprefix("p ").removeprefix("= ")


def columns_as_rows(**columns: Iterable[Any]) -> list[dict[str, Any]]:
    """Return columns of equal length as rows of plain values, for JSON."""
    plain = [np.asarray(list(values)).tolist() for values in columns.values()]
    return [dict(zip(columns, row, strict=True)) for row in zip(*plain, strict=True)]


class RecordCheck(Drawn):
    """A test of a record by new data.

    A procedure's says whether it `passed`, what that means, what was measured, and what the report shows; this class
    makes text, JSON and page of it. `data` is what the page calls a file that was tested.
    """

    data: ClassVar[str]
    notes: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether the data agree with the record."""
        raise NotImplementedError

    @property
    def verdict(self) -> str:
        """``pass`` or ``fail``."""
        return "pass" if self.passed else "fail"

    def meaning(self) -> str:
        """Return what the test says, in words."""
        raise NotImplementedError

    def next_step(self, record: str, files: Sequence[str]) -> str:
        """Return what to do, or to know, where the test failed."""
        raise NotImplementedError

    def measured(self) -> list[str]:
        """Return what was measured, as lines of text."""
        raise NotImplementedError

    def content(self) -> dict[str, Any]:
        """Return what was measured, for scripts, in SI."""
        raise NotImplementedError

    def stated(self) -> list[tuple[str, str]]:
        """Return what was stated beside record and files, as label and value."""
        return []

    def text(self, record: str, files: Sequence[str], verdict: str) -> str:
        """Return the verdict, what to do next, and what was measured; `verdict` may be coloured."""
        step = [] if self.passed else [self.next_step(record, files)]
        return "\n".join([f"{verdict}: {self.meaning()}", *step, *self.measured()])

    def to_json(self, notes: Sequence[str] | None = None) -> dict[str, Any]:
        """Return the same for scripts; `notes` are those of a command instead of its own."""
        kept = self.notes if notes is None else notes
        return {"verdict": self.verdict, **self.content(), "notes": [str(note) for note in kept]}

    def exhibits_with(
        self, facts: list[tuple[str, str]], items: Sequence[Figure | ReportTable], more: str = ""
    ) -> Exhibits:
        """Return exhibits under the headline that all tests have; `more` ends it."""
        return Exhibits(f"{self.verdict.capitalize()}: {self.meaning()}{more}.", facts, list(items))

    def page(self, held: Calibration, record: str, files: Sequence[str], notes: Sequence[str]) -> str:
        """Return the report; `held` is the record in the file `record`, `notes` are those of the command."""
        failed = [] if self.passed else [Bad(self.meaning()), self.next_step(record, files)]
        return render_page(
            f"{self.subject}: {self.verdict}",
            held.sensor.get("serial", "unit without serial number"),
            self.exhibits(),
            verdict=verdict_of([*failed, *notes]),
            notes=[note for note in notes if isinstance(note, Note)],
            provenance=[
                ("record", f"{record}, created {held.created}"),
                *((self.data, file) for file in files),
                *self.stated(),
                ("software", f"imulab {VERSION}"),
            ],
        )

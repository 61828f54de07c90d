"""A plan of a test, and what every procedure's command prints, writes and says of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

from imulab.display import Shown, aligned
from imulab.files import write_page
from imulab.recording import Recording
from imulab.report import render_plan
from imulab.writers import write_csv


def amount(value: float | None, unit: str) -> dict[str, Any]:
    """Return a value with its unit for scripts, null where it is none or not finite."""
    return {"value": finite(value), "unit": unit}


def finite(value: float | None) -> float | None:
    """Return a number, None where it is none or not finite."""
    return value if value is not None and math.isfinite(value) else None


class PlannedTest(Shown):
    """A plan: `shown` gives it in a sentence and a table; text, JSON and warnings of all commands are made here."""

    def tables(self) -> list[tuple[list[str], list[list[str]]]]:
        """Return further tables, titles and rows of each."""
        return []

    def remarks(self) -> list[str]:
        """Return what is said below the tables."""
        return []

    def content(self) -> dict[str, Any]:
        """Return the plan for scripts, in SI."""
        raise NotImplementedError

    def findings(self) -> Sequence[str]:
        """Return what is wrong with the plan, with what to do."""
        return ()

    def text(self) -> str:
        """Return the plan as a command prints it."""
        lead, titles, rows = self.shown()
        lines = [lead, *aligned(titles, rows)]
        for more, cells in self.tables():
            lines += ["", *aligned(more, cells)]
        return "\n".join([*lines, *self.remarks()])

    def save(self, path: str | Path) -> None:
        """Write the plan.

        Raises
        ------
        OptionError
            The file cannot be written.
        """
        raise NotImplementedError


class PlannedAttitudes(PlannedTest):
    """A plan of attitudes to measure by hand: its table as CSV, and a sheet to print with a picture of each."""

    sheet_title: ClassVar[str]

    @property
    def lead(self) -> str:
        """What the plan is and predicts, in a few sentences."""
        raise NotImplementedError

    @property
    def predicted(self) -> list[tuple[str, str, str]]:
        """What the test will give, as people read it: name, text and unit."""
        raise NotImplementedError

    def recording(self) -> Recording:
        """Return the attitudes as a table."""
        raise NotImplementedError

    def pictures(self) -> list[dict[str, Any]]:
        """Return what the sheet shows of each attitude."""
        raise NotImplementedError

    def save(self, path: str | Path) -> None:
        """Write the attitudes as CSV, the columns of `recording`.

        Raises
        ------
        OptionError
            The file cannot be written.
        """
        write_csv(self.recording(), path)

    def sheet(self) -> str:
        """Return the sheet to print, a picture for each attitude, as HTML text."""
        return render_plan(self.sheet_title, self.lead, self.pictures(), self.predicted)

    def report(self, path: str | Path) -> None:
        """Write the sheet to print as an HTML file; errors as for `save`."""
        write_page(path, self.sheet())

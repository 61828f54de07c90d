"""Two records of one unit beside each other, as they show themselves."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from imulab.procedures.inputs import Record, as_record
from imulab.procedures.registry import procedure_of
from imulab.procedures.reports import change_unit
from imulab.procedures.result import Drawn
from imulab.records.calibration import Calibration
from imulab.records.comparison import Comparison, compared
from imulab.report.elements import BAD, GOOD, QUIET, Exhibits, Figure, ReportTable, format_uncertain, plain_number
from imulab.report.traces import axis, scatter


@dataclass(frozen=True, repr=False)
class Changes(Drawn, Comparison):
    """Two records of one unit.

    Attributes
    ----------
    changes
        Parameters that both have, second record less first: difference, standard uncertainty, whether significant.
    probability
        Of differences as large as all of them together, were nothing changed; None where a covariance is missing.
    left_out
        Parameters that one record alone has, or that mean something else in the other.
    models
        In what the two models differ, a text each: a change may come from that.
    record
        The first of the two.
    """

    record: Calibration = field(kw_only=True)

    subject: ClassVar[str] = "Two records of a unit"

    def exhibits(self) -> Exhibits:
        """Return each change in units of its uncertainty, and as a table."""
        together = "" if self.probability is None else f"; all together: p = {self.probability:.2g} if nothing changed"
        models = f"; the records differ in {', '.join(self.models)}" if self.models else ""
        headline = f"{verdict(self)}{together}{models}."
        table = ReportTable("Changes", "", TITLES, change_rows(self, self.record))
        return Exhibits(headline[0].upper() + headline[1:], [], [_figure(self, table.rows), table])


TITLES = ["parameter", "change", "u", "change / u", "unit", ""]
"""Of `change_rows`."""


def compare_records(first: Record, second: Record) -> Changes:
    """Compare two records of one unit by one procedure, in units of their combined uncertainty.

    ``d = p_2 - p_1``, ``u^2(d) = u_1^2 + u_2^2`` less what both have in common; a change counts as significant where
    ``|d| / u`` exceeds what chance gives one of all the parameters in twenty comparisons (Bonferroni).

    Parameters
    ----------
    first, second
        Records, or their files.

    Raises
    ------
    RecordError
        They are of different procedures or in different units, or one states no uncertainty.
    OptionError
        One is no record.

    Examples
    --------
    >>> import imulab as il
    >>> first, second = (il.fit_tumble(il.simulate_tumble(gravity=9.81), order=n, gravity=9.81) for n in (1, 2))
    >>> il.compare_records(first.calibration, second.calibration).models
    ('order 1 and 2',)
    """
    one, other = (as_record(record, "compare_records") for record in (first, second))
    procedure = procedure_of(one)
    pair = procedure.comparable(one, other) if other.procedure == one.procedure else (one, other)
    return Changes(**vars(compared(*pair, procedure.same_meaning)), record=one)


def verdict(comparison: Comparison) -> str:
    """Return which parameters changed."""
    changed = [change.name for change in comparison.changes if change.significant]
    judged = sum(change.standard_uncertainty is not None for change in comparison.changes)
    named = f"{len(changed)} of {judged} parameters changed: {' '.join(changed)}"
    return named if changed else "no significant change"


def change_rows(comparison: Comparison, record: Calibration) -> list[list[str]]:
    """Return each change in the units in which people read it, of records like this one."""
    rows = []
    for change in comparison.changes:
        factor, unit = change_unit(change, record)
        u = change.standard_uncertainty
        texts = (plain_number(change.difference * factor, 3), "not stated")
        difference, uncertainty = texts if u is None else format_uncertain(change.difference * factor, u * abs(factor))
        deviations = "–" if change.deviations is None else f"{change.deviations:+.1f}"
        rows.append([change.name, difference, uncertainty, deviations, unit, "changed" if change.significant else ""])
    return rows


def _figure(comparison: Comparison, rows: list[list[str]]) -> Figure:
    judged = [(c, row) for c, row in zip(comparison.changes, rows, strict=True) if c.deviations is not None]
    marks = [change.significant for change, _ in judged]
    trace = scatter(
        [change.deviations for change, _ in judged], [change.name for change, _ in judged], "markers",
        error_x={"type": "constant", "value": 1, "color": QUIET, "thickness": 1},
        marker={"size": 9, "color": [BAD if mark else GOOD for mark in marks],
                "symbol": ["diamond" if mark else "circle" for mark in marks]},
        text=[f"{row[1]} ± {row[2]} {row[4]}" for _, row in judged],
        hovertemplate="%{y}: %{x:.1f} u<br>%{text}<extra></extra>",
    )  # fmt: skip
    return Figure(
        title="Change of each parameter in units of its standard uncertainty",
        message=f"{sum(marks)} of {len(marks)} parameters changed." if any(marks) else "No significant change.",
        caption="Second record less first; bars: one standard uncertainty. Red diamonds: more than chance explains "
        "among so many parameters.",
        traces=[trace],
        layout={
            "xaxis": axis("change / u", zeroline=True, zerolinecolor=QUIET),
            "yaxis": axis("", automargin=True, autorange="reversed", dtick=1),
            "showlegend": False,
        },
        height=120 + 22 * len(judged),
    )

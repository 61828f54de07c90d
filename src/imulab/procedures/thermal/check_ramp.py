"""The test whether new recordings at rest contradict a record of rest ramps, and its report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from imulab.errors import DataError
from imulab.estimation.decisions import THERMAL_CHECK
from imulab.estimation.distributions import probability_fact, probability_text
from imulab.procedures.result import RecordCheck, columns_as_rows, warn_made_from
from imulab.procedures.thermal.check_gyro import GyroCheck, check_gyros, gyro_figure, select_in_range
from imulab.procedures.thermal.holds import Holds, prepare_recordings
from imulab.procedures.thermal.model import AXES
from imulab.procedures.thermal.ramp import find_parts
from imulab.quantities import in_si
from imulab.recording import Recording
from imulab.records.calibration import Calibration
from imulab.report.traces import Exhibits
from imulab.units import from_si


@dataclass(frozen=True, repr=False)
class RampCheck(RecordCheck):
    """How well a record of rest ramps still holds.

    Attributes
    ----------
    holds
        The parts of the recordings at rest.
    gyro
        The test of the gyroscopes in them.
    notes
        Notes on what was and was not tested.
    """

    holds: Holds
    gyro: GyroCheck
    notes: tuple[str, ...]

    subject: ClassVar[str] = "Thermal check at rest"
    data: ClassVar[str] = "recording"

    def __repr__(self) -> str:
        state, chance = "pass" if self.passed else "fail", probability_text(self.probability)
        return f"RampCheck({state}, {chance}, {len(self.gyro.holds)} parts)"

    @property
    def probability(self) -> float:
        """Probability of the less likely of the tests, times their number (Bonferroni)."""
        made = [p for p in (self.gyro.within, self.gyro.between) if p is not None]
        return min([1.0, *(len(made) * p for p in made)])

    @property
    def passed(self) -> bool:
        """Whether the tests find no contradiction."""
        return self.probability >= THERMAL_CHECK.level

    def meaning(self) -> str:
        """Return what the test says, in words."""
        if self.passed:
            return "the recordings agree with the record"
        return (
            "the gyroscopes at rest are off the record's laws by more than these explain: the unit has changed, it "
            "turned, or unit or temperature are not as assumed"
        )

    def next_step(self, record: str, files: Sequence[str]) -> str:
        """Return how to follow the change."""
        return "record a rest ramp again, and fit a record that follows the change (imulab thermal fit)"

    def measured(self) -> list[str]:
        """Return the tests, and the largest residual."""
        row, axis = self.gyro.worst
        both = (self.gyro.residuals[row, axis], self.gyro.standard_uncertainty[row, axis])
        off, u = from_si(np.array(both), "deg/h")
        return [
            f"{probability_text(self.probability)} over {len(self.gyro.holds)} parts (within recordings "
            f"{probability_text(self.gyro.within)}, common to each {probability_text(self.gyro.between)}), largest law "
            f"less output {off:+.3g} ± {u:.2g} deg/h ({AXES[axis]}, {self.holds.label(int(self.gyro.holds[row]))})"
        ]

    def content(self) -> dict[str, Any]:
        """Return what was measured, for scripts, in SI."""
        gyro = self.gyro
        rows = columns_as_rows(
            label=[self.holds.label(int(k)) for k in gyro.holds], residual=gyro.residuals,
            standard_uncertainty=gyro.standard_uncertainty,
        )  # fmt: skip
        return {
            "p": self.probability,
            "gyro": {"p_within": gyro.within, "p_between": gyro.between, "holds": rows},
        }

    def exhibits(self) -> Exhibits:
        """Return what its report shows."""
        tests = {
            "p, if nothing changed": self.probability,
            "p within recordings": self.gyro.within,
            "p of what each has in common": self.gyro.between,
        }
        facts = [(name, probability_fact(p)) for name, p in tests.items()]
        return self.exhibits_with(facts, [gyro_figure(self.holds, self.gyro)])


def check_ramp(
    record: Calibration,
    recordings: Sequence[Recording],
    turn_on_scatter: float | str | None,
    settle: float | str | None,
    temperature_column: str | None,
) -> RampCheck:
    """Return the test of recordings at rest under a record of rest ramps; options as for `check_thermal`.

    Raises
    ------
    DataError
        The recordings have no gyroscopes at rest within the record's range, or no temperature.
    """
    column = temperature_column or record.options.get("temperature_column")
    settling = None if settle is None else in_si(settle, "settle", "time", "s")
    prepared = prepare_recordings(recordings, column, settling, span=0.0, sensor="gyro")
    parts, gaps = find_parts(prepared)
    holds, notes = select_in_range(record, parts)
    gyro, more = check_gyros(record, holds, np.tile([0.0, 0.0, 1.0], (len(holds), 1)), turn_on_scatter)
    if gyro is None:
        raise DataError(f"{recordings[0].name}: {'; '.join(map(str, more))}")
    return RampCheck(holds, gyro, (*gaps, *notes, *more, *warn_made_from(record, prepared)))

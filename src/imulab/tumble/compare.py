"""Fresh attitudes against a record."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from imulab.attitudes import Attitudes
from imulab.calibration import Calibration
from imulab.errors import RecordError
from imulab.recording import Array
from imulab.tumble.apply import output_factor, specific_force


@dataclass(frozen=True)
class Check:
    """How well a record still holds.

    Attributes
    ----------
    residuals
        |f| - g of each attitude under the record, m/s^2, shape (n,).
    limit
        m/s^2.
    """

    residuals: Array
    limit: float

    @property
    def passed(self) -> bool:
        """Whether every attitude is within the limit."""
        return bool((np.abs(self.residuals) <= self.limit).all())

    @property
    def worst(self) -> int:
        """Index of the attitude that is farthest off."""
        return int(np.argmax(np.abs(self.residuals)))


def check_tumble(record: Calibration, attitudes: Attitudes, *, limit: float, gravity: float | None = None) -> Check:
    """Hold fresh attitudes against an existing record, without refitting.

    Parameters
    ----------
    record
        Of procedure tumble.
    attitudes
        From `find_attitudes`.
    limit
        Largest | |f| - g | that passes, m/s^2.
    gravity
        Where the attitudes were measured, m/s^2; that of the record if not given.

    Raises
    ------
    RecordError
        The record is of another procedure.
    UnitError
        The attitudes' unit cannot be converted to the record's.
    """
    if record.procedure != "tumble":
        raise RecordError(f"a {record.procedure} record cannot be checked by attitudes; expected a tumble record")
    factor = output_factor(attitudes.recording.name, "accel", attitudes.unit, str(record.model["output_unit"]))
    force = specific_force(record, attitudes.mean * factor)
    local = float(record.model["gravity"]["value"]) if gravity is None else gravity
    return Check(np.linalg.norm(force, axis=1) - local, limit)

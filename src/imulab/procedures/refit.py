"""Records at a smaller model, for targets that hold less: one dispatch over the procedures that can."""

from __future__ import annotations

from imulab.procedures.tumble.refit import refit_linear
from imulab.records.calibration import Calibration

_LINEAR = {"tumble": refit_linear}


def linear_record(record: Calibration, *, misalignment: bool) -> Calibration | None:
    """Return a record fitted anew without nonlinearity (and misalignment), or None where it cannot be."""
    refit = _LINEAR.get(record.procedure)
    return None if refit is None else refit(record, misalignment=misalignment)

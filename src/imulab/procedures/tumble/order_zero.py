"""Order 0, bias and scale factor only: what a record says of the misalignment that six faces of a cube cannot tell."""

from __future__ import annotations

from dataclasses import replace

from imulab.procedures.tumble.model import MISALIGNMENTS
from imulab.records.calibration import Calibration, Parameter
from imulab.verdict import Note


def with_assumed_alignment(record: Calibration) -> Calibration:
    """Return a record of order 0 with misalignments of 0, without uncertainty, and a note that they are assumed."""
    assumed = {f"misalignment_{pair}": Parameter(0.0, None, "rad") for pair in MISALIGNMENTS}
    note = Note(
        "order 0 takes every misalignment as 0: each mrad that there is puts 1 mg per g of one axis into another; "
        "order 1 and nine or more attitudes over the sphere determine it"
    )
    return replace(
        record, parameters={**record.parameters, **assumed}, warnings=(*record.warnings, note), verdict=record.verdict
    )

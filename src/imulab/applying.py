"""Records to corrected recordings: one dispatch over the procedures.

Not named after its function: a submodule ``imulab.apply`` would take the place of ``imulab.apply()`` once imported.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from imulab.calibration import Calibration
from imulab.errors import RecordError
from imulab.recording import Recording
from imulab.tumble.apply import apply_tumble, beyond_test
from imulab.warmup.apply import apply_warmup, temperature_warning

_FAR_IN_TEMPERATURE = 20.0

_APPLY = {"tumble": apply_tumble, "warmup": apply_warmup}


def apply(record: Calibration, recording: Recording) -> Recording:
    """Return the recording corrected by a record; columns that it does not touch pass unchanged.

    Raises
    ------
    RecordError
        The record's procedure has nothing to apply here.
    UnitError
        The recording's unit cannot be converted to the record's.
    DataError
        The recording lacks the columns that the record corrects.
    """
    try:
        correct = _APPLY[record.procedure]
    except KeyError:
        known = " ".join(_APPLY)
        raise RecordError(f"a {record.procedure} record cannot be applied; known procedures: {known}") from None
    return correct(record, recording)


def apply_blocks(records: Iterable[Calibration], blocks: Iterable[Recording]) -> Iterator[Recording]:
    """Correct consecutive blocks of a recording by several records in the order given."""
    chain = list(records)
    for block in blocks:
        for record in chain:
            block = apply(record, block)
        yield block


def warnings_of(record: Calibration, recording: Recording) -> list[str]:
    """Return what a user should know about applying this record to this recording."""
    found = []
    mine, its = record.sensor.get("serial"), recording.metadata.get("serial")
    if mine and its and mine != its:
        found.append(f"{recording.name}: serial {its}, but the record was made for {mine}")
    if record.procedure == "warmup":
        message = temperature_warning(record, recording)
        return [*found, message] if message else found
    made = record.model.get("temperature")
    here = recording.mean_temperature()
    if made is None or here is None or abs(here - made["value"]) <= _FAR_IN_TEMPERATURE:
        return found
    return [
        *found,
        f"{recording.name}: temperature {here:.1f} degC is {abs(here - made['value']):.0f} K away from the "
        f"{made['value']:.1f} degC at which the record was made",
    ]


def beyond_test_of(record: Calibration, recording: Recording) -> tuple[int, float]:
    """Return how many samples lie far beyond what the record was made at, and the largest, m/s^2."""
    return beyond_test(record, recording) if record.procedure == "tumble" else (0, 0.0)

"""The further triads of a session, gyroscopes and magnetometers: fitted to the saved recording while it goes on.

A fit runs in a process of its own, beside the session.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Container
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from time import monotonic

from imulab.columns import triad
from imulab.errors import ImulabError
from imulab.gravity import Gravity
from imulab.live.view import Known
from imulab.procedures.reports import parameter_rows
from imulab.procedures.tumble.fit import fit_tumble
from imulab.procedures.tumble.segment import find_attitudes
from imulab.readers import read
from imulab.records.calibration import Calibration

_REST = 5.0
"""The next fit waits for so many times as long as the last took, so that it stays beside the session."""
FURTHER = {"gyro": "gyroscopes", "mag": "magnetometers"}
"""The triads that are fitted on top of the accelerometers, by the first part of their columns' names."""
Found = tuple[tuple[Known, ...], tuple[str, ...]]
"""Parameters of the further triads, and why some have none."""


class FurtherFits:
    """Fits of a recording that grows, one at a time."""

    def __init__(self, path: str, order: int | str, gravity: Gravity | None) -> None:
        self._given = (path, order, gravity)
        self._process: BaseProcess | None = None
        self._answer: Connection | None = None
        self._begun = self._after = 0.0

    @property
    def ready(self) -> bool:
        """Whether another fit can begin."""
        return self._process is None and monotonic() >= self._after

    def begin(self) -> None:
        """Fit what the file holds now."""
        context = get_context("spawn")
        self._answer, theirs = context.Pipe(duplex=False)
        self._process = context.Process(target=_fit, args=(theirs, *self._given), daemon=True)
        self._process.start()
        theirs.close()
        self._begun = monotonic()

    def found(self) -> Found | None:
        """Return what a fit has found; None while there is none that has ended."""
        if self._process is None or self._answer is None or not self._answer.poll():
            return None
        try:
            found: Found = self._answer.recv()
        except EOFError:
            found = (), ("the fit of the further triads was ended from outside",)
        self._after = monotonic() + _REST * (monotonic() - self._begun)
        self.close()
        return found

    def close(self) -> None:
        """End a fit that is still running."""
        if self._process is not None and self._answer is not None:
            self._process.kill()
            self._process.join(1.0)
            self._answer.close()
            self._process = None


def fit_triads(fit: Callable[[list[str]], Calibration], there: list[str]) -> tuple[Calibration, list[str], list[str]]:
    """Fit the accelerometers and further triads; one that is refused is left out. Return why, too.

    Parameters
    ----------
    fit
        Makes a record with these further triads.
    there
        Those that the recording has, of `FURTHER`.
    """
    try:
        return fit(there), there, []
    except ImulabError:
        if not there:
            raise
    record, further, why = fit([]), list[str](), list[str]()
    for name in there:
        try:
            record, further = fit([*further, name]), [*further, name]
        except ImulabError as error:
            why.append(f"the {FURTHER[name]} are not calibrated: {error}")
    return record, further, why


def further_of(columns: Container[str]) -> list[str]:
    """Return the further triads that a recording or block of these columns has."""
    return [name for name in FURTHER if all(column in columns for column in triad(name))]


def _fit(answer: Connection, path: str, order: int | str, gravity: Gravity | None) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the session, which ends this process too
    try:
        recording = read(path)
        attitudes = find_attitudes(recording)
        record, further, why = fit_triads(
            lambda names: fit_tumble(attitudes, order=order, gravity=gravity, with_=names).calibration,
            further_of(recording.columns),
        )
    except ImulabError as error:
        answer.send(((), (str(error),)))
        return
    rows = [row for row in parameter_rows(record) if row.name.split("_")[0] in further or row.name == "dip"]
    answer.send((tuple(Known(row.name, row.value, row.standard_uncertainty, row.unit) for row in rows), tuple(why)))

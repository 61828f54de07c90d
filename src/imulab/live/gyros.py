"""The gyroscopes of a session: fitted to the saved recording, by a process of its own while the session goes on."""

from __future__ import annotations

import signal
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from time import monotonic

from imulab.errors import ImulabError
from imulab.gravity import Gravity
from imulab.live.view import Known
from imulab.procedures.reports import parameter_rows
from imulab.procedures.tumble.fit import fit_tumble
from imulab.procedures.tumble.segment import find_attitudes
from imulab.readers import read

_REST = 5.0
"""The next fit waits for so many times as long as the last took, so that it stays beside the session."""
Found = tuple[tuple[Known, ...], str]
"""Parameters of the gyroscopes, and why there are none."""


class GyroFits:
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
            found = (), "the gyroscopes are not calibrated: the fit was ended from outside"
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


def _fit(answer: Connection, path: str, order: int | str, gravity: Gravity | None) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the session, which ends this process too
    try:
        record = fit_tumble(find_attitudes(read(path)), order=order, gravity=gravity, with_=("gyro",)).calibration
    except ImulabError as error:
        answer.send(((), f"the gyroscopes are not calibrated: {error}"))
        return
    rows = [row for row in parameter_rows(record) if row.name.startswith("gyro_")]
    answer.send((tuple(Known(row.name, row.value, row.standard_uncertainty, row.unit) for row in rows), ""))

"""The folder of a fleet: records, and beside them who is at work, what failed and what was asked.

A record is ``<serial>.json``, written whole or not at all, and is by itself the only truth of what is done. The rest
lies in ``.fleet``: `lock` (held by the run at work), `run` (its token), `turn` (held by workers for one unit at a
time), `manifest.json`, `failed/<serial>.json` and `active/<serial>`. File locks end with the process that holds them,
however it ends.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import time
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from imulab.errors import OptionError, RecordError
from imulab.files import write_text
from imulab.fleet.manifest import FleetManifest, FleetUnit
from imulab.procedures.registry import load_sealed
from imulab.records.calibration import Calibration

MOST_ATTEMPTS = 3
"""Number of times that a unit's process may end before the unit is not tried again."""
_PATIENCE = 60.0  # s of waiting for a folder that another process holds
_HIDDEN = ".fleet"


@dataclass(frozen=True)
class Store:
    """The folder of a fleet; it holds only the path, so that a worker elsewhere can open it too."""

    folder: Path

    @property
    def hidden(self) -> Path:
        """Folder of all files that are no records."""
        return self.folder / _HIDDEN

    def record(self, serial: str) -> Path:
        """Path of a unit's record."""
        return self.folder / f"{serial}.json"

    def failure(self, serial: str) -> Path:
        """Path of the reason why a unit failed."""
        return self.hidden / "failed" / f"{serial}.json"

    def mark(self, serial: str) -> Path:
        """Path of the mark of a unit that is being worked on, with a byte for each start."""
        return self.hidden / "active" / serial

    # --- one run at a time -----------------------------------------------------------------------------------------

    @contextmanager
    def run(self) -> Iterator[str]:
        """Hold the folder for one run, and yield its token.

        Raises
        ------
        OptionError
            Another run holds it, or the folder cannot be used.
        """
        try:
            for name in ("failed", "active"):
                (self.hidden / name).mkdir(parents=True, exist_ok=True)
            stream = (self.hidden / "lock").open("a+b", buffering=0)  # nothing is left to be written when it is closed
        except OSError as error:
            raise OptionError(f"{self.folder}: cannot be written: {error.strerror}") from None
        with stream:
            if not any(_lock_attempts(stream.fileno())):
                raise OptionError(f"{self.folder}: another run is at work on it ({self._holder()})")
            try:
                stream.truncate(0)
                stream.write(f"process {os.getpid()} on {socket.gethostname()}".encode())
            except OSError as error:
                raise OptionError(f"{self.hidden / 'lock'}: cannot be written: {error.strerror}") from None
            token = uuid.uuid4().hex
            write_text(self.hidden / "run", token)
            self._wait_for_orphans()
            self.clear()
            yield token

    def at_work(self) -> str | None:
        """Return the process that works on the folder, or None."""
        try:
            stream = (self.hidden / "lock").open("r", encoding="utf-8")
        except OSError:
            return None
        with stream:
            return None if _lock(stream.fileno(), exclusive=False) else self._holder()

    def _holder(self) -> str:
        try:
            return (self.hidden / "lock").read_text(encoding="utf-8") or "a process that has just begun"
        except OSError:
            return "its process is not known"

    def _wait_for_orphans(self) -> None:
        """Wait until workers whose run was killed have ended their present units; then the token stops them."""
        end = time.monotonic() + _PATIENCE
        with (self.hidden / "turn").open("a") as stream:
            while not _lock(stream.fileno(), exclusive=True):
                if time.monotonic() > end:
                    raise OptionError(f"{self.folder}: workers of an earlier run still work on units; try again later")
                time.sleep(0.05)

    def token(self) -> str | None:
        """Return the token of the last run, or None where this process does not see the folder."""
        try:
            return (self.hidden / "run").read_text(encoding="utf-8")
        except OSError:
            return None

    @contextmanager
    def turn(self, token: str) -> Iterator[bool | None]:
        """Hold the right to work on one unit.

        Gives True, or False where a later run has taken the folder over, or None where this process does not see it.
        """
        try:
            stream = (self.hidden / "turn").open("a")
        except OSError:
            yield None
            return
        with stream:
            while not _lock(stream.fileno(), exclusive=False):
                time.sleep(0.01)
            yield self.token() == token

    # --- what is there ---------------------------------------------------------------------------------------------

    def clear(self) -> None:
        """Remove what a killed run has left: unfinished files, marks, and reasons of units that are tried again."""
        self._clear_parts()
        for name in ("failed", "active"):
            for path in (self.hidden / name).iterdir():
                path.unlink(missing_ok=True)

    def tidy(self) -> None:
        """Remove unfinished files of workers that were killed in this run, if no unit is being worked on."""
        with (self.hidden / "turn").open("a") as stream:
            if _lock(stream.fileno(), exclusive=True):
                self._clear_parts()

    def _clear_parts(self) -> None:
        for part in (*self.folder.glob(".imulab.*.part"), *self.hidden.rglob(".imulab.*.part")):
            part.unlink(missing_ok=True)

    def begin(self, serial: str) -> int:
        """Mark a unit as being worked on, and return how often this was started and not ended before."""
        with self.mark(serial).open("ab") as stream:
            before = stream.seek(0, os.SEEK_END)
            stream.write(b".")
        return before

    def end(self, serial: str) -> None:
        """Remove the mark."""
        self.mark(serial).unlink(missing_ok=True)

    def marked(self) -> set[str]:
        """Return the serials of units with a mark."""
        try:
            return {path.name for path in (self.hidden / "active").iterdir()}
        except OSError:
            return set()

    def fail(self, unit: FleetUnit, reason: str) -> None:
        """Write why a unit failed; a record that it has of other files or options is moved to the folder superseded."""
        write_text(self.failure(unit.serial), json.dumps({**asdict(unit), "reason": reason}, ensure_ascii=False))
        record = self.record(unit.serial)
        if record.exists():
            aside = self.hidden / "superseded"
            aside.mkdir(exist_ok=True)
            with suppress(OSError):
                shutil.move(record, aside / f"{unit.serial}.{time.time_ns()}.json")

    def reason(self, serial: str) -> str | None:
        """Return the reason why a unit failed, or None."""
        try:
            return str(json.loads(self.failure(serial).read_text(encoding="utf-8"))["reason"])
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def made_for(self, unit: FleetUnit) -> tuple[Calibration, str] | None:
        """Return the unit's record and its hash if it is whole and was made from files and options of this name.

        That the files still hold the same is for the caller to see.
        """
        try:
            record, sha256 = load_sealed(self.record(unit.serial))
        except RecordError:
            return None
        made = record.sections.get("fleet")
        return (record, sha256) if isinstance(made, Mapping) and _request_in(made) == request_of(unit) else None

    # --- what was asked --------------------------------------------------------------------------------------------

    def keep_manifest(self, manifest: FleetManifest) -> None:
        """Write the manifest and the options of this run."""
        write_text(self.hidden / "manifest.json", json.dumps(asdict(manifest), ensure_ascii=False))

    def manifest(self) -> FleetManifest:
        """Return the manifest and the options of the last run.

        Raises
        ------
        OptionError
            The folder is none of a fleet.
        """
        try:
            content = json.loads((self.hidden / "manifest.json").read_text(encoding="utf-8"))
            units = tuple(
                FleetUnit(item["serial"], item["procedure"], tuple(item["files"]), dict(item["options"]))
                for item in content["units"]
            )
            return FleetManifest(content["name"], content["base"], units)
        except (OSError, ValueError, KeyError, TypeError):
            raise OptionError(f"{self.folder}: expected a folder that 'imulab fleet run' has written to") from None


def request_of(unit: FleetUnit) -> dict[str, Any]:
    """Return the description of the work on a unit, as its record holds it."""
    return {"procedure": unit.procedure, "files": list(unit.files), "options": dict(unit.options)}


def _request_in(made: Mapping[str, Any]) -> dict[str, Any]:
    return {key: made.get(key) for key in ("procedure", "files", "options")}


def _lock_attempts(descriptor: int) -> Iterator[bool]:
    """Try for a moment to get the lock, because `at_work` may be reading it."""
    for _ in range(20):
        yield _lock(descriptor, exclusive=True)
        time.sleep(0.02)


def _lock(descriptor: int, *, exclusive: bool) -> bool:
    """Take a lock that ends with the process, without waiting; return whether it was free."""
    try:
        import fcntl
    except ImportError:
        raise OptionError("fleet needs file locks, which this system does not have") from None
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        raise OptionError(f"the folder's file system has no file locks ({error.strerror}); use another") from None
    return True

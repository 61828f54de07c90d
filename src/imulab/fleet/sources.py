"""Files by path or URL: a cluster reads from its own storage, and every file that was used is known by its hash."""

from __future__ import annotations

import hashlib
import os
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from imulab.errors import ImulabError, ReadError, readable

if TYPE_CHECKING:
    from imulab.readers import Layout
    from imulab.recording import Recording
    from imulab.records.calibration import Calibration

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+(::[A-Za-z][A-Za-z0-9+.-]*)*://")
_BLOCK = 1 << 22
SCHEMES = ("file", "https", "s3", "gs", "az")
"""Where files may be fetched from; a manifest is somebody else's text, and fsspec knows dozens of others."""
_LARGEST = 1 << 33
_LOGIN = re.compile(r"(?<=://)[^/@\s]*@")
_SECRET = re.compile(r"([?&][\w-]*(?:pass|pwd|token|secret|key|sig|auth)[\w-]*=)[^&\s]+", re.IGNORECASE)


def is_url(name: str) -> bool:
    """Return whether a name is a URL rather than a path."""
    return _URL.match(name) is not None


def masked(text: str) -> str:
    """Return a text in which the credentials of URLs are replaced by asterisks."""
    return _SECRET.sub(r"\1***", _LOGIN.sub("***@", text))


def parent_of(path: str) -> str:
    """Return the folder or URL that a manifest's paths are relative to."""
    return path.rpartition("/")[0] if is_url(path) else str(Path(os.path.realpath(path)).parent)


@contextmanager
def local_file(address: str, name: str) -> Iterator[Path]:
    """Give a file (or folder) as one of this machine: itself, or a copy of what a URL names, for the time of the block.

    Raises
    ------
    ReadError
        There is no such file, it is no regular file or too large, the URL cannot be opened or is of a scheme that is
        not read, or fsspec is not there to open it.
    """
    name = masked(name)
    if not is_url(address):
        path = Path(address)
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise ReadError(f"{name}: expected a file, found a device or a pipe")
        yield path
        return
    scheme = address.partition("://")[0].lower()
    if scheme not in SCHEMES:
        raise ReadError(
            f"{name}: addresses with {scheme!r} are not read; expected a path, or one of {' '.join(SCHEMES)}"
        )
    if _LOGIN.search(address):
        raise ReadError(
            f"{name}: a login in the address would end up in records and reports; expected it in the environment"
        )
    try:
        _ = urlsplit(address).port
    except ValueError as error:
        raise ReadError(f"{name}: no address: {' '.join(str(error).split())}") from None
    with tempfile.TemporaryDirectory(prefix="imulab-", ignore_cleanup_errors=True) as folder:
        yield _fetched(address, name, Path(folder))


def _fetched(address: str, name: str, folder: Path) -> Path:
    try:
        import fsspec
    except ImportError:
        raise ReadError(f"{name}: a URL needs fsspec: pip install 'imulab[fleet]'") from None
    target = folder / (re.sub(r"[^\w.-]", "_", address.rstrip("/").rpartition("/")[2]) or "file")
    try:
        system, path = fsspec.core.url_to_fs(address)
        if system.isdir(path):
            if system.du(path) > _LARGEST:
                raise _too_large(name)
            system.get(path.rstrip("/") + "/", str(target) + "/", recursive=True)
        elif system.info(path)["type"] != "file":
            raise ReadError(f"{name}: expected a file, found a device or a pipe")
        else:
            with system.open(path, "rb") as stream, target.open("wb") as copy:
                while data := stream.read(_BLOCK):
                    copy.write(data)
                    if copy.tell() > _LARGEST:
                        raise _too_large(name)
    except ReadError:
        raise
    except FileNotFoundError:
        raise ReadError(f"{name}: no such file") from None
    except ImportError as error:
        raise ReadError(f"{name}: cannot be opened: {masked(str(error))}") from None
    except Exception as error:  # fsspec passes on whatever its back ends raise
        reason = masked(" ".join(str(error).split())) or type(error).__name__
        raise ReadError(f"{name}: cannot be read: {reason}") from None
    return target


def _too_large(name: str) -> ReadError:
    return ReadError(
        f"{name}: larger than {_LARGEST >> 30} GiB, the most that is fetched; expected a path of this machine"
    )


def sha256_of(path: Path, name: str) -> str:
    """Return the SHA-256 of a file's bytes, or of those of a bag's files in its order.

    Raises
    ------
    ReadError
        It cannot be read.
    """
    total = hashlib.sha256()
    with readable(name):
        parts: Sequence[Path] = [path]
        if path.is_dir():
            from imulab.readers.rosfolder import files_of

            parts = files_of(path, name)
        for part in parts:
            with part.open("rb") as stream:
                hashlib.file_digest(stream, lambda: total)
    return total.hexdigest()


class UnitFiles:
    """Access to one unit's files for `imulab.procedures`; remembers the hash of each and what the first head says.

    Attributes
    ----------
    inputs
        Name to SHA-256 of every file that was used, in the order of use.
    serials
        Serials that heads of files state, without repetition.
    date
        Value of the first ``date`` at the head of a file.
    """

    def __init__(self, base: str) -> None:
        self._base = base
        self._stack = ExitStack()
        self._local: dict[str, Path] = {}
        self.inputs: dict[str, str] = {}
        self.serials: list[str] = []
        self.date: str | None = None

    def __enter__(self) -> UnitFiles:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._stack.close()

    def path(self, name: str) -> Path:
        """Return a local path for a name that is relative to the manifest; URLs are fetched once."""
        if name not in self._local:
            if is_url(name):
                address = name
            elif is_url(self._base):
                address = f"{self._base}/{name}"
            else:
                address = str(Path(self._base) / name)
            self._local[name] = self._stack.enter_context(local_file(address, name))
        return self._local[name]

    def sha256(self, name: str) -> str:
        """Return the SHA-256 of a file by its name."""
        return sha256_of(self.path(name), name)

    def _layout(self, name: str | None) -> Layout | None:
        if name is None:
            return None
        from imulab.readers import load_layout
        from imulab.readers.layout import shipped_file

        shipped = shipped_file(name)
        path = shipped or self.path(name)
        self.inputs.setdefault(name, sha256_of(path, name))
        return load_layout(path, name)

    def blocks(self, name: str, layout: str | None, **part: Any) -> Iterator[Recording]:
        """Read a recording in blocks."""
        from imulab.readers import read_blocks

        known = self._layout(layout)
        self.inputs[name] = self.sha256(name)
        for number, block in enumerate(read_blocks(self.path(name), known, name=name, **part)):
            if not number:
                self.remember_head(block)
            yield block

    def beside(self, name: str, file: str) -> str:
        """Return the name of a file that file `name` names relative to itself, and note `name` as used."""
        if name not in self.inputs:
            self.inputs[name] = self.sha256(name)
        if is_url(file) or (not is_url(name) and Path(file).is_absolute()):
            return file
        folder, slash, _ = name.rpartition("/")
        return f"{folder}{slash}{file}"

    def recording(self, name: str, layout: str | None, **part: Any) -> Recording:
        """Read a recording as a whole; messages and the record call it as the manifest does."""
        from imulab.readers import read

        known = self._layout(layout)
        recording = read(self.path(name), known, name=name, **part)
        if recording.source is not None:
            self.inputs[name] = recording.source.sha256
        self.remember_head(recording)
        return recording

    def record(self, name: str) -> Calibration:
        """Read a calibration record."""
        from imulab.procedures.loading import loads

        with readable(name):
            data = self.path(name).read_bytes()
        self.inputs[name] = hashlib.sha256(data).hexdigest()
        return loads(data, name)

    def remember_head(self, recording: Recording) -> None:
        """Remember what the head of a recording says of unit and date."""
        serial = recording.metadata.get("serial")
        if serial and serial not in self.serials:
            self.serials.append(serial)
        if self.date is None:
            self.date = recording.metadata.get("date")

    def unchanged(self, inputs: Sequence[Any]) -> bool:
        """Return whether every file of a record's list is there with the hash that the record states."""
        try:
            return bool(inputs) and all(self._has(item["file"], item["sha256"]) for item in inputs)
        except (ImulabError, KeyError, TypeError):
            return False

    def _has(self, name: str, sha256: str) -> bool:
        """Return whether a file, or the layout of this name that comes with imulab, has this hash."""
        from imulab.readers.layout import shipped_file

        shipped = shipped_file(name)
        return (shipped is not None and sha256_of(shipped, name) == sha256) or self.sha256(name) == sha256

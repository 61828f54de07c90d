"""Links to a unit: serial ports, UDP and TCP, each opened by a function that can open it again after it was lost."""

from __future__ import annotations

import errno
import select
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from imulab.errors import OptionError, ReadError, install
from imulab.quantities import whole_number

BAUD = 115_200  # of a serial port, where none is stated
PATIENCE = 0.1  # s that one read waits, so that its thread can be ended
CHUNK = 1 << 16  # bytes of one read; a UDP datagram has fewer
_OPENING = 5.0  # s in which another machine has to answer
_QUIET = 3.0  # s without a byte after which another connection to the same server is tried, and another sender believed
GONE = (OSError, TypeError, ValueError)
"""What reading a link raises once it is lost: the last two are pyserial's, of a port that is gone."""


class AbsentError(ReadError):
    """Nobody is at the other end of a link yet; who is expected there may come."""


@dataclass(frozen=True)
class Link:
    """An open link.

    Attributes
    ----------
    read
        Returns bytes, empty for a moment without any, None at an orderly end; raises one of `GONE` where it is lost.
    write
        Sends bytes, if the link can.
    close
        Closes it.
    """

    read: Callable[[], bytes | None]
    write: Callable[[bytes], object] | None = None
    close: Callable[[], object] = lambda: None


@dataclass(frozen=True)
class LinkKind:
    """How a unit is reached: the name of the source, what opens a link, and what kind of link it is.

    Attributes
    ----------
    polled
        Whether the unit can be polled.
    held_back
        Whether the sender waits where nobody reads.
    """

    name: str
    open: Callable[[], Link]
    polled: bool = False
    held_back: bool = False


def serial_ports() -> list[tuple[str, str]]:
    """Return the serial ports of this machine with the devices at them.

    Raises
    ------
    OptionError
        pyserial is not installed.
    """
    _pyserial()
    from serial.tools.list_ports import comports

    return sorted((port.device, port.description or "") for port in comports())


def _pyserial() -> Any:
    try:
        import serial
    except ImportError:
        raise OptionError(f"serial ports need pyserial, which is not here: {install('live')}") from None
    return serial


def serial_link(rest: str) -> LinkKind:
    """Return the link to a serial port, ``PORT[@BAUD]``."""
    serial = _pyserial()
    port, at, rate = rest.rpartition("@")
    if not at:
        port, rate = rest, str(BAUD)
    baud = whole_number(rate, f"serial:{rest}: baud rate")
    name = f"serial:{port}@{baud}"
    if not 50 <= baud <= 20_000_000:
        raise OptionError(f"{name}: expected a baud rate of 50 to 20000000")

    def opened() -> Link:
        try:
            device = serial.Serial(port, baud, timeout=PATIENCE, write_timeout=1.0, exclusive=True)
        except (OSError, ValueError) as error:
            raise ReadError(f"{name}: {_why_no_port(port, error)}") from None
        return Link(lambda: bytes(device.read(max(1, device.in_waiting))), device.write, device.close)

    return LinkKind(name, opened, polled=True)


def _why_no_port(port: str, error: Exception) -> str:
    number = getattr(error, "errno", None)
    text = str(error).lower()
    if number == errno.ENOENT or "filenotfound" in text:
        known = " ".join(device for device, _ in serial_ports()) or "none"
        return f"no such port; ports of this machine: {known}"
    if number in (errno.EACCES, errno.EPERM) and "lock" not in text:
        return (
            "not permitted; add yourself to the group that owns the port (on most Linux systems: sudo usermod -aG "
            "dialout $USER, then log in anew)"
        )
    if number in (errno.EBUSY, errno.EAGAIN) or "lock" in text:
        return "the port is busy: another program has it open (a serial monitor? close it)"
    return f"cannot be opened: {reason(error)}"


def udp_link(rest: str) -> LinkKind:
    """Return the link to a port of this machine that datagrams come to."""
    name = f"udp:{rest}"
    port = _port(rest, name)
    return LinkKind(name, lambda: _udp(name, port))


def _udp(name: str, port: int) -> Link:
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        link.bind(("", port))
    except OSError as error:
        link.close()
        raise ReadError(f"{name}: {_why_no_address(error)}") from None
    link.settimeout(PATIENCE)
    sender: Any = None
    heard = 0.0

    def read() -> bytes:
        nonlocal sender, heard
        try:
            data, address = link.recvfrom(CHUNK)
        except TimeoutError:
            return b""
        now = time.monotonic()
        # One unit only: the one that sent first, or one that begins when it has gone, as it does after a restart.
        if address != sender and now - heard < _QUIET:
            return b""
        sender, heard = address, now
        # A line of text in its own datagram often has no end of line.
        return data + b"\n" if data[-1:] != b"\n" and data.isascii() and data.decode().isprintable() else data

    return Link(read, close=link.close)


def tcp_link(rest: str) -> LinkKind:
    """Return the link to a server, ``HOST:PORT``."""
    name = f"tcp:{rest}"
    host, colon, text = rest.rpartition(":")
    if not colon or not host:
        raise OptionError(f"{name}: expected tcp:HOST:PORT")
    address = (host.strip("[]"), _port(text, name))

    def opened() -> Link:
        try:
            server = _Server(address)
        except (ConnectionRefusedError, TimeoutError) as error:
            why = "nobody listens at" if isinstance(error, ConnectionRefusedError) else "no answer from"
            raise AbsentError(f"{why} {name} yet, trying again") from None
        except OSError as error:
            raise ReadError(f"{name}: {_why_no_address(error)}") from None
        return Link(server.read, server.write, server.close)

    return LinkKind(name, opened, polled=True, held_back=True)


class _Server:
    """A connection to a server.

    A unit that lost its power leaves the connection open and silent. So a silent one gets a second beside it, and the
    one on which bytes come first is kept.
    """

    def __init__(self, address: tuple[str, int]) -> None:
        self._address = address
        self._link = socket.create_connection(address, timeout=_OPENING)
        self._second: socket.socket | None = None
        self._tried = time.monotonic()
        self._begun = False

    def read(self) -> bytes | None:
        """Return what has come, on either connection."""
        both = [self._link] if self._second is None else [self._link, self._second]
        ready = select.select(both, [], [], PATIENCE)[0]
        if self._link in ready:
            data = self._link.recv(CHUNK)
            self._begun, self._tried = True, time.monotonic()
            self._forget_second()
            return data or None
        if ready and self._second is not None:
            data = self._second.recv(CHUNK)
            if data:
                self._link.close()
                self._link, self._second, self._tried = self._second, None, time.monotonic()
            else:
                self._forget_second()
            return data
        if self._begun and time.monotonic() - self._tried > _QUIET:
            self._forget_second()
            with suppress(OSError):
                self._second = socket.create_connection(self._address, timeout=_QUIET / 3)
            self._tried = time.monotonic()
        return b""

    def write(self, data: bytes) -> None:
        """Send bytes on both connections."""
        self._link.sendall(data)
        if self._second is not None:
            self._second.sendall(data)

    def close(self) -> None:
        """Close both connections."""
        self._forget_second()
        self._link.close()

    def _forget_second(self) -> None:
        if self._second is not None:
            self._second.close()
            self._second = None


def _port(text: str, name: str) -> int:
    port = whole_number(text, f"{name}: port")
    if not 1 <= port <= 65535:
        raise OptionError(f"{name}: expected a port of 1 to 65535")
    return port


def _why_no_address(error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return "the port is busy: another program listens there"
    if error.errno in (errno.EACCES, errno.EPERM):
        return "not permitted: ports below 1024 belong to the administrator; expected another"
    if isinstance(error, socket.gaierror):
        return "no machine of this name"
    return f"cannot be opened: {reason(error)}"


def reason(error: Exception) -> str:
    """Return why an operation of the system failed, on one line."""
    return " ".join((getattr(error, "strerror", None) or str(error) or type(error).__name__).split())

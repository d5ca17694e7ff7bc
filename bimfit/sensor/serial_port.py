"""Opening a serial port, with messages that say what to do. pyserial is imported inside."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from bimfit.errors import SensorError

if TYPE_CHECKING:
    import serial

HOKUYO_VENDOR = 0x15D1


class Unplugged(Exception):
    """The port went away while it was open."""


def find_port() -> str:
    """The port of the one Hokuyo rangefinder that is plugged in by USB.

    Raises
    ------
    SensorError
        When there is none, or more than one.
    """
    from serial.tools import list_ports

    found = sorted(port.device for port in list_ports.comports() if port.vid == HOKUYO_VENDOR)
    if not found:
        raise SensorError("no Hokuyo rangefinder is plugged in", remedy=f"name the port; {_ports_there()}")
    if len(found) > 1:
        raise SensorError(f"there are several rangefinders: {', '.join(found)}", remedy="name the port")
    return found[0]


def open_port(port: str, baud: int, timeout: float) -> serial.Serial:
    """Open a port for this program alone.

    Raises
    ------
    SensorError
        When it does not exist, may not be opened, is in use, or is no serial port.
    """
    import serial

    try:
        return serial.Serial(
            port, baud, timeout=timeout, write_timeout=1.0, exclusive=True if os.name == "posix" else None
        )
    except (serial.SerialException, OSError, ValueError) as error:
        raise _explain(port, error) from error


@contextmanager
def unplugging() -> Iterator[None]:
    """Turn whatever pyserial raises when the device goes into :class:`Unplugged`."""
    import serial

    try:
        yield
    except (serial.SerialException, OSError, TypeError) as error:
        # TypeError: pyserial 3.5 when the port is closed by another thread.
        raise Unplugged(str(error)) from error


def _ports_there() -> str:
    from serial.tools import list_ports

    there = [port.device for port in list_ports.comports()]
    return (
        "ports there: " + ", ".join(sorted(there))
        if there
        else "there is no serial port at all; is it plugged in?"
    )


def _explain(port: str, error: Exception) -> SensorError:
    code = getattr(error, "errno", None)
    text = str(error)
    if code in (errno.ENOENT, errno.ENXIO, errno.ENODEV) or "FileNotFoundError" in text:
        return SensorError("no such port", file=port, remedy=_ports_there())
    if code in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK) or "exclusively lock" in text:
        return SensorError("another program uses the port", file=port, remedy="close it first")
    if code in (errno.EACCES, errno.EPERM):
        return SensorError("no permission to open the port", file=port, remedy=_permission(port))
    if "PermissionError" in text:  # Windows: in use, or not allowed
        return SensorError(
            "another program uses the port, or it may not be opened", file=port, remedy="close it first"
        )
    if code == errno.ENOTTY or "Could not configure port" in text or code in (errno.EISDIR, errno.EINVAL):
        return SensorError("this is not a serial port", file=port, remedy=_ports_there())
    return SensorError(f"the port cannot be opened: {text}", file=port)


def _permission(port: str) -> str:
    group = "dialout"
    try:
        import grp

        owner = grp.getgrgid(Path(port).stat().st_gid).gr_name
        group = owner if owner != "root" else group
    except (ImportError, OSError, KeyError):
        pass
    return f"join the group that owns it, sudo usermod -aG {group} $USER, and log in again"

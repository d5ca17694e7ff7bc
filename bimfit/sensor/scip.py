"""SCIP 2.0 as values: numbers, sums, requests and what the status codes mean. No I/O.

Source: Hokuyo's protocol specification C-42-03320B, corrected by recorded dialogues of a URG-04LX and a
URG-04LX-UG01 where the two differ. :mod:`bimfit.sensor.replies` reads what comes back.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from bimfit.errors import SensorError
from bimfit.geometry.range_codes import FIRST_MEASUREMENT as FIRST_MEASUREMENT
from bimfit.geometry.range_codes import reason as reason

IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]

LINE = 64  # characters of data a line, without its sum
STRING = re.compile(r"[A-Za-z0-9 ._+@]{1,16}")
SCAN_REQUEST = re.compile(rb"([MG])([DS])(\d{4})(\d{4})(\d{2})(?:(\d)(\d{2}))?(?:;([A-Za-z0-9 ._+@]{1,16}))?")

_SCAN_STATUS = {
    "00": "accepted",
    "01": "the start step is not a number",
    "02": "the end step is not a number",
    "03": "the cluster count is not a number",
    "04": "the end step is out of range",
    "05": "the end step is before the start step",
}
_STREAM_STATUS = {
    **_SCAN_STATUS,
    "06": "the scan interval is not a number",
    "07": "the number of scans is not a number",
    "98": "resumed after checking itself",
    "99": "data",
}
_GET_STATUS = {**_SCAN_STATUS, "10": "the laser is off", "98": "resumed after checking itself"}
_SET_STATUS = {"00": "set", "01": "not a number", "02": "invalid value", "03": "set to that already"}
_TIME_STATUS = {
    "00": "done",
    "01": "bad control code",
    "02": "the time mode is on already",
    "03": "the time mode is off already",
    "04": "asked for outside the time mode",
}
_ANY_STATUS = {
    "0A": "internal error",
    "0B": "the request buffer is full",
    "0C": "too few parameters",
    "0D": "undefined request",
    "0E": "undefined request, or not in this mode",
    "0F": "too few parameters",
    "0G": "the string is longer than 16 characters",
    "0H": "the string has characters that are not allowed",
    "0L": "the device is in no state to measure",
    "10": "the laser is off",
    "0": "done (SCIP 1.1)",
    "E": "unknown request (SCIP 1.1)",
}
STATUS: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {
        "MD": _STREAM_STATUS,
        "MS": _STREAM_STATUS,
        "GD": _GET_STATUS,
        "GS": _GET_STATUS,
        "BM": {"00": "laser on", "01": "the laser does not work", "02": "the laser is on already"},
        "QT": {"00": "laser off"},
        "RS": {"00": "reset"},
        "TM": _TIME_STATUS,
        "SS": {**_SET_STATUS, "04": "not supported"},
        "CR": _SET_STATUS,
        "HS": _SET_STATUS,
        "VV": {"00": "done"},
        "PP": {"00": "done"},
        "II": {"00": "done"},
        "SCIP2.0": {"00": "done"},
    }
)
# Statuses besides 00 after which things are as asked.
_HARMLESS = {
    "BM": {"02"},
    "SS": {"03", "04"},
    "CR": {"03"},
    "HS": {"03"},
    "TM": {"02", "03"},
    "SCIP2.0": {"0", "0E"},
}


def checksum(data: bytes) -> int:
    """Sum character of a line: low six bits of the sum of its bytes, plus 0x30. ``Hokuyo`` gives ``o``."""
    return (sum(data) & 0x3F) + 0x30


def with_sum(data: bytes) -> bytes:
    """A line followed by its sum character."""
    return data + bytes((checksum(data),))


def encode(value: int, width: int) -> bytes:
    """Write a number as ``width`` characters of six bits, most significant first: 1234, 2 gives ``CB``.

    Raises
    ------
    ValueError
        When the value is negative or does not fit.
    """
    if not 0 <= value < 1 << (6 * width):
        raise ValueError(f"{value} does not fit in {width} characters of six bits")
    return bytes(((value >> shift) & 0x3F) + 0x30 for shift in range(6 * (width - 1), -1, -6))


def decode(text: bytes) -> int:
    """Read a number written by :func:`encode`.

    Raises
    ------
    ValueError
        When a character lies outside 0x30 .. 0x6F.
    """
    value = 0
    for character in text:
        if not 0x30 <= character <= 0x6F:
            raise ValueError(f"{text!r} is not a six-bit number")
        value = value << 6 | (character - 0x30)
    return value


def encode_values(values: IntArray, width: int) -> bytes:
    """Write many numbers one after the other, ``width`` characters each.

    Raises
    ------
    ValueError
        When a value is negative or does not fit.
    """
    values = np.asarray(values, dtype=np.int64)
    if values.size and (values.min() < 0 or values.max() >= 1 << (6 * width)):
        raise ValueError(f"values do not fit in {width} characters of six bits")
    shifts = 6 * np.arange(width - 1, -1, -1)
    return (((values[:, None] >> shifts) & 0x3F) + 0x30).astype(np.uint8).tobytes()


def decode_values(text: bytes, width: int) -> IntArray:
    """Read many numbers of ``width`` characters each, shape (len(text) / width,).

    Raises
    ------
    ValueError
        When the text is not whole numbers of such characters.
    """
    characters = np.frombuffer(text, dtype=np.uint8).astype(np.int64) - 0x30
    if len(text) % width or (characters.size and (characters.min() < 0 or characters.max() > 0x3F)):
        raise ValueError("not a block of six-bit numbers")
    return np.asarray(
        characters.reshape(-1, width) @ (1 << (6 * np.arange(width - 1, -1, -1))), dtype=np.int64
    )


def data_lines(text: bytes) -> bytes:
    """Break data characters into lines of 64, each with its sum and LF; values may straddle lines."""
    return b"".join(with_sum(text[k : k + LINE]) + b"\n" for k in range(0, len(text), LINE))


def command(name: str, parameter: str = "", string: str = "") -> bytes:
    """A request, ended by LF.

    Parameters
    ----------
    name : str
        ``VV``, ``PP``, ``II``, ``BM``, ``QT``, ``RS``, ``TM``, ``SS``, ``CR``, ``HS`` or ``SCIP2.0``.
    parameter : str
        What follows the name, digits.
    string : str
        At most 16 of letters, digits, space and ``. _ + @``; the device echoes it.

    Raises
    ------
    SensorError
        When the string cannot be sent.
    """
    if string and not STRING.fullmatch(string):
        raise SensorError(f"{string!r} cannot be sent: at most 16 of letters, digits, space . _ + @")
    return f"{name}{parameter}{';' + string if string else ''}\n".encode("ascii")


@dataclass(frozen=True)
class ScanRequest:
    """A request for ranges: MD and MS stream, GD and GS get the latest scan.

    Attributes
    ----------
    name : {"MD", "MS", "GD", "GS"}
        The last letter sets the width of a value: D 3 characters, S 2.
    start, end : int
        First and last step, 0 to 9999.
    cluster : int
        Steps merged into one value, the least valid one of them; 0 is 1.
    interval : int
        Scans skipped between two that are sent, 0 to 9. MD and MS only.
    count : int
        Scans to send, 0 until QT or RS; in an echo, those that remain. MD and MS only.
    string : str
        Echoed by the device.
    """

    name: str
    start: int
    end: int
    cluster: int = 1
    interval: int = 0
    count: int = 0
    string: str = ""

    def __post_init__(self) -> None:
        if self.name not in ("MD", "MS", "GD", "GS"):
            raise SensorError(f"{self.name} does not ask for a scan")
        if not 0 <= self.start <= self.end <= 9999:
            raise SensorError(f"steps {self.start} to {self.end} make no scan")
        if not (0 <= self.cluster <= 99 and 0 <= self.interval <= 9 and 0 <= self.count <= 99):
            raise SensorError("cluster and count are 0 to 99, interval is 0 to 9")
        if self.string and not STRING.fullmatch(self.string):
            raise SensorError(f"{self.string!r} cannot be sent: at most 16 of letters, digits, space . _ + @")

    @property
    def streams(self) -> bool:
        """Whether scans keep coming."""
        return self.name[0] == "M"

    @property
    def width(self) -> int:
        """Characters a value."""
        return 3 if self.name[1] == "D" else 2

    @property
    def step(self) -> int:
        """Steps a value."""
        return max(self.cluster, 1)

    @property
    def size(self) -> int:
        """Values a scan."""
        return math.ceil((self.end - self.start + 1) / self.step)

    @property
    def middles(self) -> FloatArray:
        """The step in the middle of each value's group, shape (size,); the last group may be shorter."""
        first = self.start + self.step * np.arange(self.size)
        return np.asarray((first + np.minimum(first + self.step - 1, self.end)) / 2.0, dtype=np.float64)

    def encode(self) -> bytes:
        """The request without its line end, which is also the echo with ``count`` scans remaining."""
        tail = f"{self.interval:1d}{self.count:02d}" if self.streams else ""
        string = f";{self.string}" if self.string else ""
        return f"{self.name}{self.start:04d}{self.end:04d}{self.cluster:02d}{tail}{string}".encode("ascii")

    @classmethod
    def parse(cls, line: bytes) -> ScanRequest | None:
        """Read a request or an echo; None when it is not one."""
        found = SCAN_REQUEST.fullmatch(line)
        if found is None:
            return None
        kind, letter, start, end, cluster, interval, count, string = found.groups()
        if (kind == b"M") != (interval is not None) or int(start) > int(end):
            return None
        return cls(
            (kind + letter).decode(),
            int(start),
            int(end),
            int(cluster),
            int(interval or 0),
            int(count or 0),
            (string or b"").decode(),
        )

    def answered_by(self, echo: ScanRequest) -> bool:
        """Whether a scan's echo answers this request: the same, but for the number of scans that remain."""
        if replace(self, count=0) != replace(echo, count=0):
            return False
        return echo.count < self.count if self.count else echo.count == 0


def meaning(name: str, status: str) -> str:
    """What a status says in answer to the request ``name``, in a few words."""
    known = STATUS.get(name[:2] if name[:2] in STATUS else name, {}).get(status) or _ANY_STATUS.get(status)
    if known is None and name[:2] in ("MD", "MS", "GD", "GS") and status.isdigit():
        code = int(status)
        if code >= 50:
            return f"hardware trouble {status}"
        if code >= 21 and name[0] == "M":
            return f"checking itself ({status})"
    return known or f"unknown status {status}"


def accepted(name: str, status: str) -> bool:
    """Whether things are as the request ``name`` wanted them after this status."""
    key = name[:2] if name[:2] in STATUS else name
    return status == "00" or status in _HARMLESS.get(key, ()) or (status == "99" and key in ("MD", "MS"))


@dataclass(frozen=True)
class Parameters:
    """What the device says of itself in answer to PP.

    Attributes
    ----------
    model : str
        Name of the model.
    dmin, dmax : int
        Nearest and farthest range, mm.
    ares : int
        Steps a turn.
    amin, amax, afrt : int
        First and last measured step, and the step that looks ahead.
    scan : int
        Turns a minute.
    """

    model: str = "URG-04LX-UG01(Simple-URG)"
    dmin: int = 20
    dmax: int = 5600
    ares: int = 1024
    amin: int = 44
    amax: int = 725
    afrt: int = 384
    scan: int = 600

    @property
    def period(self) -> float:
        """Seconds a turn."""
        return 60.0 / self.scan

    def bearings(self, steps: FloatArray) -> FloatArray:
        """Bearings of steps, rad, 0 ahead, counter-clockwise seen from above."""
        return np.asarray((np.asarray(steps) - self.afrt) * (2.0 * math.pi / self.ares), dtype=np.float64)

    def steps(self, low: float, high: float) -> tuple[int, int]:
        """First and last measured step of the bearings from ``low`` to ``high``, rad.

        Raises
        ------
        SensorError
            When the device does not look there.
        """
        turn = self.ares / (2.0 * math.pi)
        first = max(math.ceil(low * turn - 1e-6) + self.afrt, self.amin)
        last = min(math.floor(high * turn + 1e-6) + self.afrt, self.amax)
        if not first <= last:
            raise SensorError(f"the rangefinder has no beams from {low:g} to {high:g} rad")
        return first, last

    @classmethod
    def from_fields(cls, fields: Mapping[str, str]) -> Parameters:
        """Make it of the fields of a PP reply.

        Raises
        ------
        SensorError
            When one is missing, not a number, or together they make no scanner.
        """
        try:
            names = ("DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN")
            found = cls(fields.get("MODL", ""), *(int(fields[name]) for name in names))
        except (KeyError, ValueError) as error:
            raise SensorError(f"the device describes itself incompletely: {error}") from error
        if not (0 < found.dmin < found.dmax and 0 <= found.amin < found.amax < found.ares and found.scan > 0):
            raise SensorError(f"the device describes itself as impossible: {found}")
        return found

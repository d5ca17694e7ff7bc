"""Bytes from a SCIP device to events, incrementally. No I/O.

Lines end with LF and an empty line ends a reply. Nothing is believed that is not proven, for a sum of six
bits lets one injury in 64 pass: a scan needs the echo of what was asked, the right number of characters,
lines of exactly 64 of them but the last, every sum, and ranges that a device can measure. Whether its time
stamp goes on from the last one's is for :class:`bimfit.sensor.clock.StampOrder` to say.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

from bimfit.errors import SensorError
from bimfit.sensor.scip import LINE, IntArray, ScanRequest, checksum, decode, decode_values

MAX_LINE = 160
MAX_LINES = 2048
FARTHEST = 0xFFFF
"""No device of this family sends more, mm, though three characters could."""
_ECHO_AT_END = re.compile(
    rb"(?:[MG][DS]\d{10}(?:\d{3})?|SCIP2\.0|TM\d|SS\d{6}|CR\d\d|HS\d|VV|PP|II|BM|QT|RS)"
    rb"(?:;[A-Za-z0-9 ._+@]{1,16})?$"
)
_ECHO = re.compile(rb"[A-Z%][ -~]*")


@dataclass(frozen=True)
class Reply:
    """An answer without ranges.

    Attributes
    ----------
    echo : str
        The request as the device repeats it.
    status : str
        Two characters, or one from a device in SCIP 1.1.
    lines : tuple of bytes
        What follows, sums included.
    """

    echo: str
    status: str
    lines: tuple[bytes, ...] = ()

    @property
    def name(self) -> str:
        """The command answered."""
        return self.echo if self.echo.startswith("SCIP") else self.echo[:2]


@dataclass(frozen=True)
class ScanReply:
    """A scan with every sum right.

    Attributes
    ----------
    request : ScanRequest
        The echo; its ``count`` is the number of scans that remain.
    stamp : int
        The device's clock at step 0, ms, 24 bits.
    values : ndarray, shape (request.size,)
        mm, or codes below 20.
    """

    request: ScanRequest
    stamp: int
    values: IntArray


@dataclass(frozen=True)
class Damaged:
    """Bytes that make no reply.

    Attributes
    ----------
    why : str
        What is wrong with them.
    data : bytes
        The first of them, at most 200.
    scan : bool
        Whether they look like what is left of a scan.
    echo : bool
        Whether the echo at a scan's beginning is among them.
    """

    why: str
    data: bytes
    scan: bool
    echo: bool


Event = Reply | ScanReply | Damaged


class _Bad(Exception):
    """What is wrong with a reply."""


class ReplyParser:
    """Cuts a stream of bytes into replies; never raises on what it is fed.

    Parameters
    ----------
    expect : ScanRequest, optional
        Only scans in answer to this request are believed: the echo carries no sum of its own.
    """

    def __init__(self, expect: ScanRequest | None = None) -> None:
        self.expect = expect
        self._partial = bytearray()
        self._lines: list[bytes] = []

    def feed(self, data: bytes) -> list[Event]:
        """Take bytes, in pieces of any size, and return what they complete."""
        self._partial += data
        *lines, rest = bytes(self._partial).split(b"\n")
        events: list[Event] = []
        for line in (text.removesuffix(b"\r") for text in lines):  # as some converters end lines
            if line:
                self._lines.append(line)
                if len(line) > MAX_LINE or len(self._lines) > MAX_LINES:
                    events.append(self._overflow())
            elif self._lines:
                events.extend(self._reply(self._lines))
                self._lines = []
        self._partial = bytearray(rest)
        if len(rest) > MAX_LINE:
            self._lines.append(rest)
            events.append(self._overflow())
            self._partial = bytearray(self._lines.pop())
        return events

    def flush(self) -> list[Event]:
        """Give up what is incomplete, as when the line is lost; it is returned as damaged."""
        if self._partial:
            self._lines.append(bytes(self._partial))
        self._partial.clear()
        lines, self._lines = self._lines, []
        return [_damaged(lines, "cut off")] if lines else []

    def _overflow(self) -> Damaged:
        """Give up what does not end, but for the end of its last line: an echo may follow noise there."""
        *lines, last = self._lines
        self._lines = [last[-MAX_LINE:]]
        ahead = last[:-MAX_LINE]
        return _damaged([*lines, *([ahead] if ahead else [])], "it does not end")

    def _reply(self, lines: list[bytes]) -> Iterator[Event]:
        try:
            yield self._parse(lines)
            return
        except _Bad as error:
            why = str(error)
        # A lost line end glues a broken reply, or noise, to the next one, which may be whole.
        for k in range(len(lines) - 1, -1, -1):
            found = _ECHO_AT_END.search(lines[k])
            if found is None or (k == 0 and found.start() == 0):
                continue
            try:
                event = self._parse([lines[k][found.start() :], *lines[k + 1 :]])
            except _Bad:
                continue
            ahead = lines[k][: found.start()]
            yield _damaged([*lines[:k], *([ahead] if ahead else [])], why)
            yield event
            return
        yield _damaged(lines, why)

    def _parse(self, lines: list[bytes]) -> Event:
        if len(lines) < 2:
            raise _Bad("no status")
        echo, status, *rest = lines
        if not _ECHO.fullmatch(echo):
            raise _Bad("no echo")
        code = _status(status)
        request = ScanRequest.parse(echo)
        if request is not None and (code == "99" if request.streams else code == "00"):
            return self._scan(request, rest)
        if not _belongs(echo, rest):
            raise _Bad("lines that do not belong to the reply")
        return Reply(echo.decode("ascii"), code, tuple(rest))

    def _scan(self, request: ScanRequest, rest: list[bytes]) -> ScanReply:
        if self.expect is not None and not self.expect.answered_by(request):
            raise _Bad("a scan that nobody asked for")
        if not rest or len(rest[0]) != 5:
            raise _Bad("no time stamp")
        size = request.size * request.width
        data = rest[1:]
        lengths = [len(line) - 1 for line in data]
        if (
            sum(lengths) != size
            or any(length != LINE for length in lengths[:-1])
            or not 0 < lengths[-1] <= LINE
        ):
            raise _Bad("characters missing or too many")
        text = b"".join(_summed(line) for line in data)
        try:
            stamp, values = decode(_summed(rest[0])), decode_values(text, request.width)
        except ValueError as error:
            raise _Bad("characters out of range") from error
        if values.max() > FARTHEST:
            raise _Bad("a range that no device measures")
        return ScanReply(request, stamp, values)


def _status(line: bytes) -> str:
    if len(line) == 1 and line in b"0123456789E":
        return line.decode()
    code = _summed(line) if len(line) == 3 else b""
    if not re.fullmatch(rb"[0-9][0-9A-Z]", code):
        raise _Bad("no status")
    return code.decode("ascii")


def _summed(line: bytes) -> bytes:
    if checksum(line[:-1]) != line[-1]:
        raise _Bad("a sum is wrong")
    return line[:-1]


def _belongs(echo: bytes, rest: list[bytes]) -> bool:
    # Without this, a reply whose end was lost would swallow the scan behind it.
    if echo[:2] in (b"VV", b"PP", b"II"):
        return all(b":" in line and line[-2:-1] == b";" for line in rest)
    return not rest or (echo[:3] == b"TM1" and len(rest) == 1 and len(rest[0]) == 5)


def _damaged(lines: list[bytes], why: str) -> Damaged:
    data = b"\n".join(lines)
    echo = bool(re.search(rb"[MG][DS]\d{10}", data))
    scan = echo or b"\n99b" in data or any(_is_data(line) for line in lines)
    return Damaged(why, data[:200], scan, echo)


def _is_data(line: bytes) -> bool:
    return len(line) == LINE + 1 and checksum(line[:-1]) == line[-1]


def fields(reply: Reply) -> dict[str, str]:
    """Read the ``KEY:value;sum`` lines of a VV, PP or II reply.

    The sum leaves the ``;`` out, as on every recorded device; some printed examples differ.

    Raises
    ------
    SensorError
        When a line has another form or its sum is wrong.
    """
    found: dict[str, str] = {}
    for line in reply.lines:
        body, mark, tail = line.rpartition(b";")
        key, colon, value = body.partition(b":")
        if not mark or not colon or len(tail) != 1 or checksum(body) != tail[0] or not body.isascii():
            raise SensorError(f"the answer to {reply.echo} came damaged: {line!r}")
        found[key.decode("ascii")] = value.decode("ascii")
    return found


def device_time(state: dict[str, str]) -> int | None:
    """The device's clock in an II reply, ms: six *hexadecimal* digits. None when it is not given."""
    text = state.get("TIME", "")
    return int(text, 16) if re.fullmatch(r"[0-9A-Fa-f]{1,6}", text) else None

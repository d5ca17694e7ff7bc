"""A SCIP 2.0 rangefinder as a state machine: requests and the time go in, timed packets come out. No I/O.

Faithful to a recorded dialogue of a URG-04LX: plain replies leave at one phase of the rotation, scans at
another.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field

from bimfit.sensor import scip
from bimfit.sensor.clock import SCAN_PHASE
from bimfit.sensor.models import UG01, Identity
from bimfit.sensor.scip import IntArray, Parameters, ScanRequest

REPLY_PHASE = 0.94
"""Recorded of turns of 100 ms: a stamp is taken at step 0; plain replies leave 94 ms after it."""
BAUD_RATES = (19200, 38400, 57600, 115200, 250000, 500000, 750000)


@dataclass(frozen=True)
class Packet:
    """Bytes that leave the device at a time (s since power on); with ``stamp`` (ms, 24 bits) for a scan."""

    time: float
    data: bytes
    stamp: int | None = None


@dataclass
class _Stream:
    request: ScanRequest
    line: bytes  # as it was asked for, for the echo
    turn: int  # the next rotation to send
    left: int  # scans left, when counted


@dataclass
class Device:
    """One rangefinder from power on.

    Parameters
    ----------
    measure : callable (seconds) -> ndarray, shape (amax - amin + 1,)
        Values of the rotation that starts at ``seconds``: mm or codes, steps amin to amax.
    parameters, identity : Parameters, Identity
        What it is.
    scip1 : bool
        Starts in SCIP 1.1, as older devices do.
    laser : bool
        Whether the laser is on at the start.
    late_scan : bool
        After the answer to QT one more scan arrives.
    clock : int
        The device's clock at time 0, ms.
    """

    measure: Callable[[float], IntArray]
    parameters: Parameters = field(default_factory=Parameters)
    identity: Identity = UG01
    scip1: bool = False
    laser: bool = False
    late_scan: bool = False
    clock: int = 0

    def __post_init__(self) -> None:
        self._old = self.scip1
        self._timing = False
        self._motor = 0
        self._sensitive = 0
        self._baud = 19200
        self._line = bytearray()
        self._out: list[Packet] = []
        self._stream: _Stream | None = None
        self._pending: list[tuple[ScanRequest, bytes, int]] = []
        self._seen: tuple[float, IntArray] | None = None

    @property
    def streaming(self) -> bool:
        """Whether scans keep coming by themselves."""
        return self._stream is not None

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the host at time ``now``; requests end with LF or CR."""
        for byte in data:
            if byte not in b"\r\n":
                self._line.append(byte)
                del self._line[128:]
            elif self._line:
                line = bytes(self._line)
                self._line.clear()
                self._answer(line, now)

    def hush(self) -> None:
        """Forget the answers that have not left."""
        self._out.clear()
        self._pending.clear()

    def next_time(self) -> float | None:
        """When the next packet is due; None when nothing is."""
        times = [packet.time for packet in self._out] + [self._ready(turn) for _, _, turn in self._pending]
        if self._stream is not None:
            times.append(self._ready(self._stream.turn))
        return min(times, default=None)

    def take(self, now: float) -> list[Packet]:
        """Packets due until ``now``, in order."""
        due = [packet for packet in self._out if packet.time <= now]
        self._out = [packet for packet in self._out if packet.time > now]
        for request, line, turn in [item for item in self._pending if self._ready(item[2]) <= now]:
            due.append(self._scan(request, line, turn, b"00"))
        self._pending = [item for item in self._pending if self._ready(item[2]) > now]
        while self._stream is not None and self._ready(self._stream.turn) <= now:
            due.append(self._stream_scan(self._stream))
        return sorted(due, key=lambda packet: packet.time)

    def stamp(self, now: float) -> int:
        """The device's clock, ms, 24 bits."""
        return int(self.clock + now * 1000.0 + 1e-6) % (1 << 24)

    def _turn(self, now: float) -> int:
        """The first rotation that starts at ``now`` or later."""
        return -int((-now / self.parameters.period + 1e-9) // 1)

    def _answering(self, now: float) -> int:
        """The rotation at whose reply phase a request that comes now is looked at."""
        return self._turn(now - REPLY_PHASE * self.parameters.period)

    def _reply_time(self, now: float) -> float:
        return (self._answering(now) + REPLY_PHASE) * self.parameters.period

    def _ready(self, turn: int) -> float:
        return (turn + SCAN_PHASE) * self.parameters.period

    def _stream_scan(self, stream: _Stream) -> Packet:
        request, line = stream.request, stream.line
        if request.count:
            stream.left -= 1
            line = line[:13] + b"%02d" % stream.left + line[15:]
        packet = self._scan(request, line, stream.turn, b"99")
        stream.turn += request.interval + 1
        if stream.request.count and not stream.left:
            self._stream, self.laser = None, False
        return packet

    def _scan(self, request: ScanRequest, line: bytes, turn: int, status: bytes) -> Packet:
        start = turn * self.parameters.period
        values = self._values(request, start)
        stamp = self.stamp(start)
        lines = [line, scip.with_sum(status), scip.with_sum(scip.encode(stamp, 4))]
        body = scip.data_lines(scip.encode_values(values, request.width))
        return Packet(self._ready(turn), b"\n".join(lines) + b"\n" + body + b"\n", stamp)

    def _values(self, request: ScanRequest, start: float) -> IntArray:
        import numpy as np

        if self._seen is None or self._seen[0] != start:
            self._seen = start, self.measure(start)  # once a turn, whoever asks for it
        measured = self._seen[1]
        steps = np.arange(request.start, request.end + 1)
        known = (steps >= self.parameters.amin) & (steps <= self.parameters.amax)
        values = np.full(steps.size, 19, dtype=np.int64)
        values[known] = measured[steps[known] - self.parameters.amin]
        if request.step > 1:
            # The least valid value of a group, or its first code when none is valid.
            pad = request.size * request.step - values.size
            groups = np.concatenate([values, np.repeat(values[-1:], pad)]).reshape(-1, request.step)
            least = np.where(groups >= scip.FIRST_MEASUREMENT, groups, 1 << 20).min(axis=1)
            values = np.where(least < 1 << 20, least, groups[:, 0])
        return np.asarray(np.minimum(values, (1 << (6 * request.width)) - 1), dtype=np.int64)

    def _reply(self, line: bytes, status: str, now: float, *lines: bytes) -> None:
        time = self._reply_time(now)
        body = b"".join(part + b"\n" for part in (line, scip.with_sum(status.encode()), *lines))
        self._out.append(Packet(time, body + b"\n"))

    def _answer(self, line: bytes, now: float) -> None:
        if self._old:
            known = line == b"SCIP2.0"
            self._old = not known
            time = self._reply_time(now)
            self._out.append(Packet(time, line + (b"\n0\n\n" if known else b"\nE\n\n")))
            return
        body, mark, string = line.partition(b";")
        text = body.decode("ascii", "replace")
        if mark and len(string) > 16:
            self._reply(line, "0G", now)
        elif mark and not re.fullmatch(rb"[A-Za-z0-9 ._+@]*", string):
            self._reply(line, "0H", now)
        elif text[:2] == "TM":
            self._time_mode(line, text, now)
        elif self._timing:
            self._reply(line, "0E", now)
        elif text[:2] in ("MD", "MS", "GD", "GS"):
            self._scan_request(line, text, now)
        elif text in ("VV", "PP", "II"):
            self._reply(line, "00", now, *self._describe(text, now))
        elif text in ("BM", "QT", "RS"):
            self._switch(line, text, now)
        elif text[:2] in ("SS", "CR", "HS"):
            self._reply(line, self._setting(text), now)
        else:
            self._reply(line, "0E", now)

    def _switch(self, line: bytes, text: str, now: float) -> None:
        if text == "BM":
            self._reply(line, "02" if self.laser else "00", now)
            self.laser = True
            return
        stream, self._stream, self.laser = self._stream, None, False
        self._pending.clear()
        self._reply(line, "00", now)
        if self.late_scan and stream is not None:
            turn = max(stream.turn, self._answering(self._out[-1].time))
            self._out.append(self._scan(stream.request, stream.line, turn, b"99"))
        if text == "RS":
            self._motor, self._sensitive, self._baud = 0, 0, 19200
            self.clock = -int(now * 1000.0)

    def _time_mode(self, line: bytes, text: str, now: float) -> None:
        code = text[2:]
        if not code:
            self._reply(line, "0C", now)
        elif code == "0":
            self._reply(line, "02" if self._timing else "00", now)
            self._timing, self.laser, self._stream = True, False, None
        elif code == "1" and self._timing:
            self._reply(line, "00", now)
            time = self._out[-1].time
            stamp = scip.with_sum(scip.encode(self.stamp(time), 4))
            self._out[-1] = Packet(time, self._out[-1].data[:-1] + stamp + b"\n\n")
        elif code == "1":
            self._reply(line, "04", now)
        elif code == "2":
            self._reply(line, "00" if self._timing else "03", now)
            self._timing = False
        else:
            self._reply(line, "01", now)

    def _setting(self, text: str) -> str:
        name, value = text[:2], text[2:]
        length = {"SS": 6, "CR": 2, "HS": 1}[name]
        if len(value) != length:
            return "0C" if len(value) < length else "0D"
        if not value.isdigit():
            return "01"
        number = int(value)
        if name == "SS":
            allowed, current = number in BAUD_RATES, self._baud
            self._baud = number if allowed else current
        elif name == "CR":
            allowed, current = number <= 10 or number == 99, self._motor
            self._motor = number if allowed else current
        else:
            allowed, current = number <= 1, self._sensitive
            self._sensitive = number if allowed else current
        if not allowed:
            return "02"
        return "03" if number == current else "00"

    def _scan_request(self, line: bytes, text: str, now: float) -> None:
        status = self._check(text)
        request = ScanRequest.parse(text.encode("ascii")) if status == "00" else None
        if request is None:
            self._reply(line, status, now)
        elif not request.streams:
            if self.laser:
                # Requests are looked at at the reply phase; the rotation that is then ending is the latest.
                self._pending.append((request, line, self._answering(now)))
            else:
                self._reply(line, "10", now)
        else:
            self._reply(line, "00", now)
            # A rotation that began before the laser was lit cannot be measured.
            first = self._answering(now) + (not self.laser)
            self.laser = True
            self._stream = _Stream(request, line, first, request.count)

    def _check(self, text: str) -> str:
        streams = text[0] == "M"
        length = 15 if streams else 12
        if len(text) != length:
            return "0C" if len(text) < length else "0D"
        parts = [("01", text[2:6]), ("02", text[6:10]), ("03", text[10:12])]
        parts += [("06", text[12:13]), ("07", text[13:15])] if streams else []
        for status, digits in parts:
            if not (digits.isdigit() and digits.isascii()):
                return status
        if int(text[6:10]) > self.parameters.amax:
            return "04"
        return "05" if int(text[6:10]) < int(text[2:6]) else "00"

    def _describe(self, text: str, now: float) -> list[bytes]:
        it, has = self.identity, self.parameters
        if text == "VV":
            known = [("VEND", it.vendor), ("PROD", it.product), ("FIRM", it.firmware)]
            known += [("PROT", it.protocol), ("SERI", it.serial)]
        elif text == "PP":
            known = [("MODL", it.model)]
            names = ("dmin", "dmax", "ares", "amin", "amax", "afrt", "scan")
            known += [(name.upper(), str(getattr(has, name))) for name in names]
        else:
            time = self._reply_time(now)
            known = [("MODL", it.model), ("LASR", "ON" if self.laser else "OFF"), ("SCSP", it.speed)]
            known += [("MESM", it.mode), ("SBPS", it.baud)]
            known += [("TIME", f"{self.stamp(time):06X}"), ("STAT", it.status)]
        lines = [f"{key}:{value}".encode("ascii") for key, value in known]
        return [line + b";" + bytes((scip.checksum(line),)) for line in lines]

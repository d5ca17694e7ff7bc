"""The line to a SCIP device: bytes out, events in, requests and their answers. Knows nothing of streams."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from bimfit.errors import SensorError
from bimfit.sensor import scip
from bimfit.sensor.clock import HostClock, StampUnwrapper
from bimfit.sensor.replies import Damaged, Reply, ReplyParser, ScanReply
from bimfit.sensor.serial_port import open_port, unplugging

if TYPE_CHECKING:
    import serial

PATIENCE = 1.0  # s for one answer; a device answers within a turn, 0.1 s
TICK = 0.02


class Line:
    """An open port and what has come through it.

    Attributes
    ----------
    scans : deque of (ScanReply, float)
        Whole scans not yet taken, each with the host time when its last byte was read.
    replies : deque of Reply
        Answers since the last request.
    damaged, noise : int
        Broken scans, and other bytes that made no reply.
    heard : bytes
        The last bytes that came.
    """

    def __init__(self, port: str, baud: int, clock: Callable[[], float]) -> None:
        self.port = port
        self._clock = clock
        self._serial: serial.Serial = open_port(port, baud, TICK)
        self._lock = threading.RLock()
        self._closed = False
        self.parser = ReplyParser()
        self.scans: deque[tuple[ScanReply, float]] = deque()
        self.replies: deque[Reply] = deque(maxlen=64)
        self.damaged = 0
        self.noise = 0
        self.heard = b""
        self._stream_echo = ""
        self._broken = False

    def close(self) -> None:
        """Close the port; what is half read counts as damaged."""
        if not self._closed:
            self._closed = True
            self._sort(self.parser.flush(), 0.0)
            self._serial.close()

    def write(self, data: bytes) -> None:
        """Send bytes. Raises Unplugged."""
        with self._lock, unplugging():
            self._serial.write(data)

    def pump(self) -> bool:
        """Read what is there, waiting a little for a first byte; whether anything came. Raises Unplugged."""
        with self._lock:
            with unplugging():
                data = self._serial.read(max(1, self._serial.in_waiting))
            if data:
                self.heard = (self.heard + data)[-60:]
                self._sort(self.parser.feed(data), self._clock())
            return bool(data)

    def drain(self, quiet: float, limit: float) -> None:
        """Read until nothing came for ``quiet`` seconds, at most ``limit`` seconds."""
        start = last = time.monotonic()
        while time.monotonic() < min(last + quiet, start + limit):
            if self.pump():
                last = time.monotonic()

    def ask(self, request: bytes, patience: float = PATIENCE, tries: int = 2) -> Reply | None:
        """Send a request and wait for its answer; scans that come meanwhile are kept. Raises Unplugged."""
        echo = request.rstrip(b"\n").decode("ascii")
        with self._lock:
            for _ in range(tries):
                self.replies.clear()
                self.write(request.rstrip(b"\n") + b"\n")
                deadline = time.monotonic() + patience
                while time.monotonic() < deadline:
                    self.pump()
                    for reply in self.replies:
                        if reply.echo == echo:
                            return reply
        return None

    def ask_stream(self, request: bytes) -> Reply | None:
        """Ask for a stream; scans from before its answer are dropped."""
        self._stream_echo = request.decode("ascii")
        return self.ask(request)

    def _sort(self, events: list[Reply | ScanReply | Damaged], arrival: float) -> None:
        for event in events:
            if isinstance(event, ScanReply):
                self.scans.append((event, arrival))
            elif isinstance(event, Reply):
                if event.echo == self._stream_echo and event.status == "00":
                    self.scans.clear()
                self.replies.append(event)
            else:
                self._count(event)
                continue
            self._broken = False

    def _count(self, event: Damaged) -> None:
        # A broken scan may come in pieces; only another echo begins another one.
        if event.scan and (event.echo or not self._broken):
            self.damaged += 1
            self._broken = True
        elif not self._broken:
            self.noise += 1


def start_up(line: Line, timeout: float) -> None:
    """Bring a device to rest in SCIP 2.0, whatever state it was left in. Raises Unplugged.

    Raises
    ------
    SensorError
        When nothing answers, or what answers is no rangefinder.
    """
    line.heard = b""
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        line.write(b"\n")  # ends a request that a crashed program left unfinished
        line.drain(0.03, 0.15)
        reply = line.ask(b"QT", min(PATIENCE, max(deadline - time.monotonic(), 0.1)), tries=1)
        if reply is None:
            continue
        if reply.status == "E":
            line.ask(b"SCIP2.0")
        elif reply.status == "0E":
            line.ask(b"TM2")
        elif reply.status in ("00", "0"):
            return
    if not line.heard:
        raise SensorError(
            "nothing answers", file=line.port, remedy="is this the right port, and has the rangefinder power?"
        )
    raise SensorError(
        f"what answers is no SCIP 2.0 rangefinder: {line.heard[-24:]!r}",
        file=line.port,
        remedy="try another port",
    )


def must_answer(line: Line, request: bytes) -> Reply:
    """Ask, and insist on a good answer. Raises Unplugged.

    Raises
    ------
    SensorError
        When the answer does not come or is a refusal.
    """
    reply = line.ask(request)
    if reply is None:
        raise SensorError(f"no answer to {request.decode()}", file=line.port)
    if not scip.accepted(reply.name, reply.status):
        what = scip.meaning(reply.name, reply.status)
        raise SensorError(f"the rangefinder refuses {request.decode()}: {what}", file=line.port)
    return reply


def bound_clock(line: Line, clock: Callable[[], float], host: HostClock, unwrap: StampUnwrapper) -> None:
    """Ask for the device's clock in its time mode, if it has one. Raises Unplugged."""
    reply = line.ask(b"TM0")
    if reply is None or reply.status not in ("00", "02"):
        return
    try:
        for _ in range(2):
            sent = clock()
            reply = line.ask(b"TM1", tries=1)
            received = clock()
            stamp = reply.lines[0] if reply is not None and reply.status == "00" and reply.lines else b""
            if len(stamp) == 5 and scip.with_sum(stamp[:-1]) == stamp:
                host.ask(sent, unwrap(scip.decode(stamp[:-1])) / 1000.0, received)
    finally:
        line.ask(b"TM2")

"""Asking a line for scans, one or a stream of them, and taking them as they come."""

from __future__ import annotations

import time
from collections.abc import Callable

from bimfit.errors import SensorError
from bimfit.sensor import scip
from bimfit.sensor.line import Line
from bimfit.sensor.replies import Reply, ScanReply
from bimfit.sensor.scip import ScanRequest

SILENCE = 1.0  # s without a scan before the device is started anew


def begin_stream(line: Line, request: ScanRequest) -> bool:
    """Ask for a stream; whether the device answers. Raises Unplugged.

    Raises
    ------
    SensorError
        When the device refuses.
    """
    line.parser.expect = request
    reply = line.ask_stream(request.encode())
    if reply is not None and not scip.accepted(reply.name, reply.status):
        what = scip.meaning(reply.name, reply.status)
        raise SensorError(f"the rangefinder refuses: {what}", file=line.port)
    return reply is not None


def next_scan(
    line: Line, request: ScanRequest, period: float, over: Callable[[], bool] = lambda: False
) -> tuple[ScanReply, float] | None:
    """The next scan and its arrival; None after a silence, or when it is ``over``. Raises Unplugged.

    Raises
    ------
    SensorError
        When the device refuses, or says that it is broken.
    """
    deadline = time.monotonic() + max(SILENCE, 5 * period * (request.interval + 1))
    while not line.scans:
        if time.monotonic() > deadline or over():
            return None
        line.pump()
        for reply in list(line.replies):
            if reply.name == request.name and reply.status not in ("00", "98", "99"):
                _check_fault(line, reply)
    return line.scans.popleft()


def _check_fault(line: Line, reply: Reply) -> None:
    code = int(reply.status) if reply.status.isdigit() else -1
    if not 21 <= code <= 49:  # those check themselves and go on
        what = scip.meaning(reply.name, reply.status)
        raise SensorError(f"the rangefinder reports: {what}", file=line.port)

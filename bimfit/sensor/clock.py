"""The device's clock, unwrapped and tied to the host's."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable

STAMP_BITS = 24
# Recorded: a scan starts to arrive that long after its own stamp, and a full one takes 2.3 ms.
SCAN_DELAY = 0.101


def host_clock() -> Callable[[], float]:
    """A clock of seconds since 1970 that never jumps: the monotonic clock, set once."""
    start = time.time() - time.monotonic()
    return lambda: start + time.monotonic()


class StampUnwrapper:
    """Counts on where the 24-bit millisecond stamp starts again from 0, every 4.66 hours."""

    def __init__(self, bits: int = STAMP_BITS) -> None:
        self._turn = 1 << bits
        self._last: int | None = None

    def __call__(self, stamp: int) -> int:
        """Milliseconds since the count began; up to half a turn back counts as late, not as wrapped."""
        if self._last is None:
            self._last = stamp
            return stamp
        half = self._turn // 2
        step = (stamp - self._last + half) % self._turn - half
        total = self._last + step
        self._last = max(self._last, total)
        return total


class HostClock:
    """Maps the device's seconds to the host's.

    The offset comes from the first scans and the delay that is known of them, held within the bounds that
    questions and answers in the device's time mode prove. It then follows the drift of the device's quartz: a
    scan is never early, so the least lateness of a while moves only with the drift, however long the host may
    sleep now and then.

    Parameters
    ----------
    window : float
        How far back scans count for the drift, s.
    """

    def __init__(self, window: float = 30.0) -> None:
        self.window = window
        self.bounds = (-math.inf, math.inf)
        self._first: float | None = None
        self._base = math.nan
        self._recent: deque[tuple[float, float]] = deque()

    def ask(self, sent: float, device: float, received: float) -> None:
        """Note an answer in the time mode: the device's clock showed ``device`` between two host times."""
        low, high = self.bounds
        self.bounds = (max(low, sent - device), min(high, received - device))

    def observe(self, device: float, arrival: float) -> None:
        """Note that a scan stamped ``device`` arrived whole at host time ``arrival``."""
        lateness = arrival - device
        if self._first is None:
            self._first = device
        # A monotonic queue: lateness grows along it, so its head is the least of the window.
        while self._recent and self._recent[-1][1] >= lateness:
            self._recent.pop()
        self._recent.append((device, lateness))
        while self._recent[0][0] < device - self.window:
            self._recent.popleft()
        if device - self._first < self.window:
            self._base = self._recent[0][1]

    @property
    def offset(self) -> float:
        """Host seconds - device seconds, now; NaN before anything is known."""
        low, high = self.bounds
        if not self._recent:
            return (low + high) / 2.0 if math.isfinite(low + high) else math.nan
        drift = self._recent[0][1] - self._base
        return min(max(self._base - SCAN_DELAY, low), high) + drift

    def to_host(self, device: float) -> float:
        """Host time of a device time, s; NaN before anything is known."""
        return device + self.offset

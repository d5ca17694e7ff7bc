"""The device's clock, unwrapped and tied to the host's."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable

STAMP_BITS = 24
SCAN_PHASE = 1.01
"""Recorded: a scan starts to arrive that long after its own stamp, turns, and a full one takes 2.3 ms."""


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


class StampOrder:
    """Whether scans' stamps go on as the clock of one device does.

    The sums that guard a scan are weak, and a line that stutters may send one twice. A stamp that does not
    come after the last one, or a long time after it, is not believed; unless the next one follows it, as when
    the device's clock was set, or the host slept. One that was believed before is never believed again.

    Parameters
    ----------
    turn : float
        Time between two scans, s.
    """

    LONGEST = 30.0

    def __init__(self, turn: float) -> None:
        self._turn = turn
        self._last: int | None = None
        self._doubted: int | None = None
        self._believed: deque[int] = deque(maxlen=100)

    def believes(self, stamp: int) -> bool:
        """Take a scan's stamp (ms, 24 bits)."""
        if stamp in self._believed:
            return False
        good = self._follows(self._last, stamp, self.LONGEST) or self._follows(
            self._doubted, stamp, 3.0 * self._turn
        )
        if self._last is None or good:
            self._last, self._doubted = stamp, None
            self._believed.append(stamp)
            return True
        self._doubted = stamp
        return False

    def _follows(self, before: int | None, stamp: int, most: float) -> bool:
        if before is None:
            return False
        step = (stamp - before) % (1 << STAMP_BITS) / 1000.0
        return 0.5 * self._turn < step < max(most, 3.0 * self._turn)


class HostClock:
    """Maps the device's seconds to the host's.

    The offset comes from the first scans and the delay that is known of them, held within the bounds that
    questions and answers in the device's time mode prove. It then follows the drift of the device's quartz: a
    scan is never early, so the least lateness of a while moves only with the drift, however long the host may
    sleep now and then.

    Parameters
    ----------
    delay : float
        How long after its own stamp a scan arrives, s.
    window : float
        How far back scans count for the drift, s.
    """

    def __init__(self, delay: float = SCAN_PHASE * 0.1, window: float = 30.0) -> None:
        self.delay = delay
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
        return min(max(self._base - self.delay, low), high) + drift

    def to_host(self, device: float) -> float:
        """Host time of a device time, s; NaN before anything is known."""
        return device + self.offset

"""Ctrl-C and its like held back while a library draws that breaks down when it is torn out of its work."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


@contextmanager
def held_back() -> Iterator[None]:
    """Let signals that came meanwhile take effect at the end, as if they came then."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        came.append(number)

    # what was ignored, or set by none of Python's, stays as it is
    before = {number: signal.getsignal(number) for number in _ENDING}
    before = {number: old for number, old in before.items() if callable(old) or old is signal.SIG_DFL}
    for number in before:
        signal.signal(number, note)
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)
        if came:
            signal.raise_signal(came[0])

"""SIGTERM and SIGHUP as exceptions, so that a laser is switched off on the way out."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals that ask a process to end: SIGHUP comes when its terminal is closed, and not on Windows."""


@contextmanager
def termination_raises() -> Iterator[None]:
    """Let them raise SystemExit, as Ctrl-C raises KeyboardInterrupt, unless a handler is set already."""
    main = threading.current_thread() is threading.main_thread()
    unset = [number for number in ENDING if main and signal.getsignal(number) is signal.SIG_DFL]
    for number in unset:
        signal.signal(number, _terminate)
    try:
        yield
    finally:
        for number in unset:
            signal.signal(number, signal.SIG_DFL)


def _terminate(number: int, frame: FrameType | None) -> None:
    raise SystemExit(128 + number)

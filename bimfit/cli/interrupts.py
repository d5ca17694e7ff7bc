"""Ctrl-C and SIGTERM as the ordinary way to end what runs until interrupted."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""SIGHUP comes when the terminal is closed, and not on Windows."""


@contextmanager
def stoppable() -> Iterator[None]:
    """Let the first of those signals raise KeyboardInterrupt; later ones do not disturb the way out.

    SIGINT counts even where a shell has it ignored, as it does for what a script starts in the background;
    SIGHUP stays ignored where nohup has it so.
    """

    def stop(number: int, frame: FrameType | None) -> None:
        for name in ENDING:
            signal.signal(name, signal.SIG_IGN)
        raise KeyboardInterrupt

    with _handled(stop, ENDING[:2]), _handled(stop, _unless_ignored(ENDING[2:])):
        yield


@contextmanager
def undisturbed() -> Iterator[None]:
    """Let none of them disturb what has to be finished, such as the writing of a file."""
    with _handled(signal.SIG_IGN, ENDING):
        yield


@contextmanager
def _handled(handler: signal._HANDLER, numbers: tuple[signal.Signals, ...]) -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in numbers}
    try:
        for number in before:
            signal.signal(number, handler)
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def _unless_ignored(numbers: tuple[signal.Signals, ...]) -> tuple[signal.Signals, ...]:
    return tuple(number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN)

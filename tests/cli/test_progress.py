"""Progress is for a terminal; the first run says why it takes so long."""

from __future__ import annotations

import io
import time

import numba

from bimfit import _kernels
from bimfit.cli.progress import terminal_progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def _fresh():
    return numba.njit(lambda x: x + 1)


def test_compiling_is_told_while_it_is_watched_and_only_then():
    told = []
    add = _fresh()
    with _kernels.compiling(lambda: told.append(1)):
        add(1)
        first = len(told)
        add(2)
    assert first > 0
    assert len(told) == first
    add(1.0)
    assert len(told) == first


def test_a_terminal_shows_that_kernels_are_compiled(monkeypatch):
    screen = Terminal()
    monkeypatch.setattr("sys.stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    with terminal_progress() as update:
        update("fitting", 0.5)
        _fresh()(1)
        time.sleep(0.3)  # the bar is drawn ten times a second
    assert "compiling for this machine" in screen.getvalue()


def test_nothing_is_drawn_elsewhere(monkeypatch):
    screen = io.StringIO()
    monkeypatch.setattr("sys.stderr", screen)
    with terminal_progress() as update:
        update("fitting", 0.5)
    assert screen.getvalue() == ""

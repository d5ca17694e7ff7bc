"""Progress on stderr, and only on a terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import ModuleType

_COMPILING = "compiling for this machine, only this once (a minute or so)"


@contextmanager
def terminal_progress() -> Iterator[Callable[[str, float], None]]:
    """Give a callable (step, share done) that draws a bar on a terminal and does nothing elsewhere."""
    if not sys.stderr.isatty():
        yield lambda step, share: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bars, ExitStack() as open_:
        task = bars.add_task("starting", total=1.0)
        watched: list[ModuleType] = []

        def update(step: str, share: float) -> None:
            bars.update(task, description=step, completed=share)
            # loaded by what needs it, a second after the start
            kernels = sys.modules.get("bimfit._kernels")
            if kernels is not None and not watched:
                watched.append(kernels)
                open_.enter_context(kernels.compiling(lambda: bars.update(task, description=_COMPILING)))

        yield update

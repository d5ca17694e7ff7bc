"""How every kernel is compiled, and when what the cache holds of it is out of date."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import numba as nb
from numba.core import event


def jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile without the interpreter lock; cache on disk where some directory can be written.

    Division by zero gives inf or NaN as in NumPy, instead of an exception from inside a kernel.
    """
    return _compiled(function)


def jit_fast(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same with fast arithmetic: only for kernels that never see an inf or a NaN."""
    return _compiled(function, fastmath=True)


def jit_sums(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same where sums may be taken in another order, which makes vector code; inf and NaN are safe."""
    return _compiled(function, fastmath={"reassoc", "contract"})


def jit_bare(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same for what allocates nothing: without counts of references, a third of a busy loop's time."""
    return _compiled(function, _nrt=False)


def jit_inner(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same for a part of another kernel's hot loop: compiled into it, since a call's arrays cost more."""
    return _compiled(function, forceinline=True)


def jit_inner_sums(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same for sums."""
    return _compiled(function, forceinline=True, fastmath={"reassoc", "contract"})


def jit_inner_bare(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same without counts of references."""
    return _compiled(function, _nrt=False, forceinline=True)


def jit_inner_fast(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same with fast arithmetic."""
    return _compiled(function, _nrt=False, forceinline=True, fastmath=True)


def _compiled(function: Callable[..., Any], **more: bool | set[str]) -> Callable[..., Any]:
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": False, **more}
    try:
        compiled: Callable[..., Any] = nb.njit(cache=True, **options)(function)
        _go_stale_together(compiled, Path(function.__code__.co_filename))
    except RuntimeError:  # numba found no directory for its cache: a read-only installation
        compiled = nb.njit(**options)(function)
    return compiled


def _go_stale_together(compiled: Callable[..., Any], file: Path) -> None:
    """Let the cached code depend on every kernel of its room and on this file.

    Numba looks at the kernel's own file alone: a callee that was edited in another one would stay as it was.
    """
    index = getattr(getattr(compiled, "_cache", None), "_cache_file", None)
    if index is not None:
        index._source_stamp = _stamps(file.parent)


@lru_cache
def _stamps(room: Path) -> tuple[tuple[str, float, int], ...]:
    """Name, time of change and size of a room's kernel files."""
    files = [Path(__file__), *sorted(room.glob("_kernels*.py"))]
    return tuple((file.name, stat.st_mtime, stat.st_size) for file in files for stat in (file.stat(),))


@contextmanager
def compiling(tell: Callable[[], None]) -> Iterator[None]:
    """Call ``tell`` whenever a kernel has to be compiled because no earlier run left it in the cache."""

    class Listener(event.Listener):  # type: ignore[misc]
        def on_start(self, _: event.Event) -> None:
            tell()

        def on_end(self, _: event.Event) -> None:
            pass

    listener = Listener()
    event.register("numba:compile", listener)
    try:
        yield
    finally:
        event.unregister("numba:compile", listener)

"""Files that appear whole or not at all, and never in place of an input."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from bimfit.errors import ExportError


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside ``path`` that takes its place when the block ends well.

    The temporary name keeps the suffix, so that writers that look at it choose the right format.

    Raises
    ------
    ExportError
        When the folder cannot be made or written to.
    """
    target = Path(path)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.is_dir():
            raise ExportError("is a folder", file=target, remedy="name a file")
        handle, name = tempfile.mkstemp(prefix=f".{target.stem}-", suffix=target.suffix, dir=target.parent)
        os.close(handle)
    except OSError as error:
        reason = f"cannot be written: {error.strerror}"
        raise ExportError(reason, file=target, remedy="choose another place") from error
    part = Path(name)
    try:
        yield part
        part.chmod(0o666 & ~_umask())
        part.replace(target)
    except OSError as error:
        raise ExportError(f"cannot be written: {error.strerror or error}", file=target) from error
    finally:
        part.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a text file, whole or not at all.

    Raises
    ------
    ExportError
        When it cannot be written.
    """
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8", newline="\n")


def protect_inputs(outputs: Iterable[Path], inputs: Iterable[Path]) -> None:
    """Refuse to write where an input lies.

    Raises
    ------
    ExportError
        Naming the output that would replace an input.
    """
    taken = {_identity(path) for path in inputs}
    for path in outputs:
        if _identity(path) in taken:
            reason = "is an input of this run and is never overwritten"
            raise ExportError(reason, file=path, remedy="choose another -o")


def _identity(path: Path) -> object:
    try:
        stat = path.stat()
        return stat.st_dev, stat.st_ino
    except OSError:
        return path.absolute()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask

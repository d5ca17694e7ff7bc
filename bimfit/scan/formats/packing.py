"""Files packed by gzip."""

from __future__ import annotations

import gzip
import shutil
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bimfit.errors import ScanError

GZIP = b"\x1f\x8b"


@contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """Give the path of what is packed, under its own name without ``.gz``, for as long as the block lasts.

    Raises
    ------
    ScanError
        When it is cut short or damaged, or there is no room for it.
    """
    with tempfile.TemporaryDirectory(prefix="bimfit-") as folder:
        inner = Path(folder) / (path.stem if path.suffix.lower() == ".gz" else path.name)
        try:
            with gzip.open(path, "rb") as packed, inner.open("wb") as plain:
                shutil.copyfileobj(packed, plain, 1 << 20)
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            raise ScanError(f"packed by gzip, but cut short or damaged: {error}", file=path) from error
        except OSError as error:
            raise ScanError(f"cannot be unpacked: {error.strerror or error}", file=path) from error
        yield inner

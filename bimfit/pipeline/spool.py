"""A line scan that grows on disk while it is measured, so that no crash takes what came before."""

from __future__ import annotations

import contextlib
import itertools
from pathlib import Path
from typing import IO

from bimfit.errors import ExportError
from bimfit.geometry.line_scan import LineScan
from bimfit.scan.formats import read_scan, write_scan
from bimfit.scan.formats.delimited import UNFINISHED, beam_lines, beam_names


class Spool:
    """Takes sweeps as they come and keeps them in ``NAME.part.csv`` beside the file they are for.

    Each sweep goes to the system at once, in one piece, so that the death of this process costs at most the
    one that is being written; reading such a file leaves its torn last line out and says so. A file that an
    earlier run left is never touched: another number is taken. Memory does not grow.

    Parameters
    ----------
    target : Path
        What :meth:`finish` makes of it, a CSV or an NPZ file.

    Raises
    ------
    ExportError
        When it cannot be written.
    """

    def __init__(self, target: Path) -> None:
        self.target = target
        self.beams = 0
        self._size = 0
        self.path = target
        self._stream: IO[bytes] | None = None
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            self._stream = self._opened()
        except OSError as error:
            reason = f"cannot be written: {error.strerror}"
            raise ExportError(reason, file=target, remedy="choose another place") from error

    def _opened(self) -> IO[bytes]:
        """A new file, numbered where there are others; ``path`` names it."""
        for number in itertools.count(1):
            count = f"-{number}" if number > 1 else ""
            self.path = self.target.with_name(f"{self.target.stem}{count}{UNFINISHED}")
            with contextlib.suppress(FileExistsError):
                return self.path.open("xb", buffering=0)
        raise AssertionError("numbers do not end")

    def add(self, scan: LineScan) -> None:
        """Write beams behind those that are there; they have the columns of the first ones.

        Raises
        ------
        ExportError
            When the disc takes no more; what came before stays.
        """
        assert self._stream is not None
        head = "" if self.beams else ",".join(beam_names(scan)) + "\n"
        text = head + "".join(beam_lines(scan))
        data = memoryview(text.encode("utf-8"))
        try:
            while data:  # a full disc may take a part of it first
                data = data[self._stream.write(data) :]
        except OSError as error:
            raise ExportError(f"cannot be written: {error.strerror}", file=self.path) from error
        self.beams += len(scan)
        self._size = self._stream.tell()

    def finish(self) -> None:
        """Give the file its name; an NPZ file is made of it, which takes memory for all of it.

        Raises
        ------
        ExportError
            When it cannot be written; what was measured stays where it is.
        """
        self.close()
        try:
            if self.target.suffix.lower() == ".csv":
                self.path.replace(self.target)
            else:
                write_scan(read_scan(self.path), self.target)
                self.path.unlink()
        except (OSError, ExportError) as error:
            text = error.message if isinstance(error, ExportError) else f"cannot be written: {error.strerror}"
            raise ExportError(
                text, file=self.target, remedy=f"what was measured is in {self.path}"
            ) from error

    def close(self) -> None:
        """End the writing; the file stays as it is, but for one that holds nothing."""
        if self._stream is not None:
            with contextlib.suppress(OSError):
                self._stream.truncate(self._size)  # no row that was torn by Ctrl-C or a full disc
            self._stream.close()
            self._stream = None
            if not self.beams:
                with contextlib.suppress(OSError):
                    self.path.unlink()

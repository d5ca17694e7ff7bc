"""Numbers out of text files: fast where all is well, exact about the place where it is not."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from bimfit.errors import ScanError
from bimfit.geometry.pose import Array
from bimfit.scan.formats.decimals import parse_columns

CHUNK = 1 << 25
"""Bytes of text parsed at a time: what bounds the memory beyond the numbers themselves."""


def first_lines(path: Path, size: int = 1 << 16) -> bytes:
    """The start of a file.

    Raises
    ------
    ScanError
        When it cannot be read or holds nothing.
    """
    try:
        with path.open("rb") as stream:
            head = stream.read(size)
    except OSError as error:
        raise ScanError(f"cannot be read: {error.strerror}", file=path) from error
    if not head.strip():
        raise ScanError("the file is empty", file=path)
    return head


def read_table(
    path: Path,
    skip: int,
    delimiter: str,
    names: Sequence[str],
    wanted: Sequence[int],
    may_be_empty: Sequence[int] = (),
    rows: int | None = None,
    *,
    comma: bool = False,
) -> Array:
    """Read columns of numbers from delimited text.

    Parameters
    ----------
    path : Path
    skip : int
        Lines before the first row.
    delimiter : str
        One character; a space stands for any run of spaces and tabs.
    names : sequence of str
        A name for every column of the file, for messages; rows must have just as many cells.
    wanted : sequence of int
        Columns to read.
    may_be_empty : sequence of int
        Of these, the columns whose empty cells are NaN; elsewhere an empty cell is an error.
    rows : int, optional
        How many lines to read at most; None reads to the end.
    comma : bool
        Whether decimals are set off by a comma, as spreadsheets in many countries write them.

    Returns
    -------
    ndarray, shape (rows, len(wanted))

    Raises
    ------
    ScanError
        Naming line and column of the first cell that is no number, or the first row of another length.
    """
    parts = list(read_blocks(path, skip, delimiter, names, wanted, may_be_empty, rows, comma=comma))
    return np.concatenate(parts) if parts else np.zeros((0, len(wanted)))


def read_blocks(
    path: Path,
    skip: int,
    delimiter: str,
    names: Sequence[str],
    wanted: Sequence[int],
    may_be_empty: Sequence[int] = (),
    rows: int | None = None,
    *,
    comma: bool = False,
) -> Iterator[Array]:
    """The same as :func:`read_table`, some tens of megabytes of text at a time."""
    for block, line in text_blocks(path, skip, rows):
        yield parse_block(path, block, line, delimiter, names, wanted, may_be_empty, comma=comma)


def text_blocks(
    path: Path, skip: int, rows: int | None = None, *, torn: bool = False
) -> Iterator[tuple[bytes, int]]:
    """Some tens of megabytes of whole lines at a time, and the number of the first of them in the file.

    Where the file may be ``torn``, a last line without an end is left out.
    """
    line = skip + 1
    with path.open("rb") as stream:
        for _ in range(skip):
            stream.readline()
        for block in _first(_whole_lines(stream, torn), rows):
            yield block, line
            line += block.count(b"\n")


def _whole_lines(stream: BinaryIO, torn: bool) -> Iterator[bytes]:
    rest = b""
    while block := stream.read(CHUNK):
        block = rest + block
        cut = block.rfind(b"\n") + 1
        rest = block[cut:]
        if cut:
            yield block[:cut].replace(b"\r\n", b"\n") if b"\r" in block else block[:cut]
    if rest.strip() and not torn:
        yield rest.replace(b"\r", b"") + b"\n"


def _first(blocks: Iterator[bytes], lines: int | None) -> Iterator[bytes]:
    """Blocks up to a number of lines."""
    for block in blocks:
        if lines is None:
            yield block
            continue
        count = block.count(b"\n")
        if count >= lines:
            ends = np.flatnonzero(np.frombuffer(block, np.uint8) == 10)
            if lines:
                yield block[: ends[lines - 1] + 1]
            return
        lines -= count
        yield block


def parse_block(
    path: Path,
    block: bytes,
    line: int,
    delimiter: str,
    names: Sequence[str],
    wanted: Sequence[int],
    may_be_empty: Sequence[int],
    *,
    comma: bool = False,
) -> Array:
    """Columns of numbers of a block of lines, as :func:`read_table` reads them.

    Raises
    ------
    ScanError
        Naming line and column.
    """
    wanted, empty = list(wanted), set(may_be_empty)
    block = block.replace(b",", b".") if comma else block
    quick = _quick(block, delimiter, len(names), wanted)
    if quick is not None:
        holes = np.asarray(np.isnan(quick).any(axis=0))
        if not any(holes[k] and column not in empty for k, column in enumerate(wanted)):
            return quick
    return _slow(path, block, line, delimiter, names, wanted, empty)


def _quick(block: bytes, delimiter: str, width: int, wanted: list[int]) -> Array | None:
    """Everything at once; None where a row or a cell needs a closer look."""
    if b'"' in block:
        return None
    if b"\n\n" in block or block.startswith(b"\n"):
        block = b"\n".join(line for line in block.split(b"\n") if line) + b"\n"
        if block == b"\n":
            return np.zeros((0, len(wanted)))
    return parse_columns(block, ord(delimiter), width, wanted)


def _slow(
    path: Path,
    block: bytes,
    line: int,
    delimiter: str,
    names: Sequence[str],
    wanted: list[int],
    empty: set[int],
) -> Array:
    """A row at a time, to find the cell to blame, or to read what needs more than splitting."""
    try:
        text = block.decode("utf-8")
    except UnicodeDecodeError as error:
        bad = line + block.count(b"\n", 0, error.start)
        raise ScanError("not text", file=path, place=f"line {bad}") from error
    rows = []
    for number, cells in _rows(path, text, line, delimiter):
        if len(cells) != len(names):
            raise ScanError(
                f"{len(cells)} cells where {len(names)} are expected", file=path, place=f"line {number}"
            )
        rows.append([_number(path, cells[k], number, names[k], k in empty) for k in wanted])
    return np.array(rows, np.float64).reshape(-1, len(wanted))


def _rows(path: Path, text: str, line: int, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    if delimiter == " ":
        for offset, row in enumerate(text.split("\n")):
            if row.strip():
                yield line + offset, row.split()
        return
    reader = csv.reader(io.StringIO(text), delimiter=delimiter)
    try:
        for cells in reader:
            if any(cell.strip() for cell in cells):
                yield line + reader.line_num - 1, cells
    except csv.Error as error:
        raise ScanError(f"not CSV: {error}", file=path, place=f"line {line + reader.line_num - 1}") from error


def _number(path: Path, cell: str, line: int, name: str, may_be_empty: bool) -> float:
    text = cell.strip()
    place = f"line {line}, column {name}"
    if not text:
        if may_be_empty:
            return math.nan
        raise ScanError("the cell is empty", file=path, place=place)
    try:
        value = float(text) if "_" not in text else None
    except ValueError:
        value = None
    if value is None:
        raise ScanError(f"{text[:40]!r} is not a number", file=path, place=place)
    if not math.isfinite(value) and not may_be_empty:
        raise ScanError(f"{text!r} is not a finite number", file=path, place=place)
    return value


def number_at(path: Path, row: int, skip: int) -> int:
    """The line of the file that holds data row ``row``, counting from 0 and leaving blank lines out."""
    seen = -1
    with path.open("rb") as stream:
        for number, text in enumerate(stream, start=1):
            if number > skip and text.strip(b" \t\r\n,;"):
                seen += 1
                if seen == row:
                    return number
    return skip + row + 1

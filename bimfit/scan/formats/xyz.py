"""Plain text points: XYZ, ASC, TXT and PTS, in whatever of their dialects."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.scan.cloud import PointCloud, usable
from bimfit.scan.formats.delimited import BEAM, csv_chunks, read_csv
from bimfit.scan.formats.options import ReadOptions
from bimfit.scan.formats.text import first_lines, read_blocks

_MOST_HEADER = 20
_WAYS = ((";", False), (",", False), (" ", False), (";", True), (" ", True))
"""Delimiters and whether a comma sets off decimals, the usual ones first."""


def read_xyz(path: Path) -> LineScan | PointCloud:
    """Read a row a point: x y z, then intensity (4 or 7 columns) and colours or normals (6 or 7 columns).

    Spaces, tabs, commas or semicolons between the numbers; header lines, comments and the point count of PTS
    are skipped. A text file with the header of a line scan is read as one.

    Raises
    ------
    ScanError
        Naming the line of the first row that is not such a row.
    """
    lines = _head(path)
    if _is_line_scan(lines):
        return read_csv(path)
    pieces = list(_pieces(path, lines))
    table = np.concatenate(pieces)
    if not usable(table[:, :3]).any():
        raise ScanError("the file holds no point", file=path)
    return _cloud(path, table)


def xyz_chunks(path: Path, options: ReadOptions) -> Iterator[LineScan | PointCloud]:
    """Read plain text points in pieces.

    Raises
    ------
    ScanError
        As :func:`read_xyz` does, at the latest after the last piece.
    """
    lines = _head(path)
    if _is_line_scan(lines):
        yield from csv_chunks(path)
        return
    seen = 0
    for table in _pieces(path, lines):
        piece = _cloud(path, table)
        seen += len(piece)
        yield piece
    if not seen:
        raise ScanError("the file holds no point", file=path)


def _head(path: Path) -> list[str]:
    head = first_lines(path)
    if b"\0" in head:
        raise ScanError("not a text file", file=path)
    return head.decode("utf-8-sig", errors="replace").split("\n")


def _pieces(path: Path, lines: list[str]) -> Iterator[Array]:
    skip, delimiter, width, comma = _layout(path, lines)
    names = ["x", "y", "z", *(f"{k + 1}" for k in range(3, width))]
    return read_blocks(path, skip, delimiter, names, range(width), range(width), comma=comma)


def _cloud(path: Path, table: Array) -> PointCloud:
    width = table.shape[1]
    finite = usable(table[:, :3])
    lost = not finite.all()
    table = table[finite] if lost else table
    rest = table[:, 3:]
    intensity = rest[:, 0].copy() if width in (4, 7) else None
    triple = rest[:, -3:] if width in (6, 7) else None
    colors = triple is not None and bool(
        np.all((triple == np.round(triple)) & (triple >= 0) & (triple <= 255)) and np.any(triple > 1)
    )
    return PointCloud(
        np.ascontiguousarray(table[:, :3]),
        normals=triple.copy() if triple is not None and not colors and _unit(triple) else None,
        colors=triple.astype(np.uint8) if triple is not None and colors else None,
        intensity=intensity,
        source=str(path),
        notes=(f"{int(np.count_nonzero(~finite))} rows without coordinates left out",) if lost else (),
    )


def write_xyz(scan: LineScan | PointCloud, path: Path) -> None:
    """Write x y z a line such that reading gives every number back exactly."""
    assert isinstance(scan, PointCloud)
    with path.open("w", encoding="ascii", newline="\n") as stream:
        stream.writelines(f"{x!r} {y!r} {z!r}\n" for x, y, z in scan.points.tolist())


def looks_like_points(head: bytes) -> bool:
    """Whether the start of a file is text with rows of numbers, or the header of a line scan."""
    if b"\0" in head:
        return False
    lines = head.decode("utf-8-sig", errors="replace").split("\n")
    try:
        return _is_line_scan(lines) or bool(_layout(Path(), lines))
    except ScanError:
        return False


def _is_line_scan(lines: list[str]) -> bool:
    return set(BEAM[1:]) <= {word.strip().lower() for word in re.split(r"[,;\t]", lines[0])}


def _layout(path: Path, lines: list[str]) -> tuple[int, str, int, bool]:
    """Lines before the first point, delimiter, how many numbers a row has, and if commas set off decimals."""
    for number, line in enumerate(lines):
        if number > _MOST_HEADER:
            break
        if not line.strip() or line.lstrip().startswith(("#", "//", "%")):
            continue
        for delimiter, comma in _WAYS:
            if delimiter == " " or delimiter in line:
                width = _width(line, delimiter, comma)
                if width >= 3:
                    return number, delimiter, width, comma
    raise ScanError(
        "no row of at least three numbers", file=path, place=f"first {len(lines[:_MOST_HEADER])} lines"
    )


def _width(line: str, delimiter: str, comma: bool) -> int:
    """How many numbers a line has; 0 where one is none."""
    words = line.split() if delimiter == " " else line.split(delimiter)
    try:
        return len([float(word.replace(",", ".") if comma else word) for word in words])
    except ValueError:
        return 0


def _unit(vectors: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> bool:
    return bool(np.allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=1e-2))

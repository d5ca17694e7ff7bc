"""CSV with a header: line scans as CONTRACT.md has them, and points (x, y, z)."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan, continued
from bimfit.geometry.pose import Array
from bimfit.scan.cloud import FARTHEST, PointCloud, usable
from bimfit.scan.formats.options import ANY, ReadOptions
from bimfit.scan.formats.text import first_lines, number_at, parse_block, read_blocks, text_blocks

BEAM = ("scan", "ox", "oy", "oz", "dx", "dy", "dz", "range")
UNFINISHED = ".part.csv"
"""How the name of a table ends that is still being written; its last line may be torn."""
_BLANK = b" \t\r\n,;"
UNIT_SLACK = 1e-3
"""How far a direction's length may be from 1: four decimals are enough."""


@dataclass(frozen=True)
class _Layout:
    """How a table is written: its columns' names, lines up to and with the header, delimiter, decimals."""

    header: list[str]
    skip: int
    delimiter: str
    comma: bool

    @property
    def columns(self) -> dict[str, int]:
        """Where each name comes first."""
        return {name: k for k, name in reversed(list(enumerate(self.header)))}


def read_csv(path: Path) -> LineScan | PointCloud:
    """Read a CSV file with a header.

    Raises
    ------
    ScanError
        Naming file, line and column: a missing column, text in a number, a direction that is not of unit
        length, a row of another length; a file without rows.
    """
    pieces = list(csv_chunks(path))
    if len(pieces) == 1:
        return pieces[0]
    if isinstance(pieces[0], PointCloud):
        return _one_cloud([piece for piece in pieces if isinstance(piece, PointCloud)])
    return continued([piece for piece in pieces if isinstance(piece, LineScan)])


def csv_chunks(path: Path, options: ReadOptions = ANY) -> Iterator[LineScan | PointCloud]:
    """Read a CSV file in pieces.

    Raises
    ------
    ScanError
        As :func:`read_csv` does, at the latest after the last piece.
    """
    layout = _layout(path)
    names = set(layout.header)
    if {"x", "y", "z"} <= names and not set(BEAM[1:]) & names:
        yield from _points(path, layout)
        return
    missing = [name for name in BEAM if name not in names]
    if missing:
        if len(missing) == len(BEAM):
            raise ScanError(
                "no header of a line scan",
                file=path,
                place=f"line {layout.skip}",
                remedy=f"expected {','.join(BEAM)}",
            )
        raise ScanError(
            f"column {', '.join(missing)} is missing",
            file=path,
            place=f"line {layout.skip}",
            remedy=f"a line scan has the columns {','.join(BEAM)}",
        )
    yield from _beams(path, layout)


def _beams(path: Path, layout: _Layout) -> Iterator[LineScan]:
    needed = [layout.columns[name] for name in BEAM]
    extras = _numeric_extras(path, layout, needed)
    blank = [layout.columns["range"]]
    row = 0
    torn = path.name.endswith(UNFINISHED)
    for block, line in text_blocks(path, layout.skip, torn=torn):
        if not block.strip(_BLANK):
            continue
        parse = partial(parse_block, path, block, line, layout.delimiter, layout.header, comma=layout.comma)
        try:
            table = parse(needed + extras, blank + extras)
        except ScanError:
            # perhaps a column that is none of ours; then it is left out, else the same error comes again
            extras = []
            table = parse(needed, blank)
        first = row
        row += len(table)
        if len(table):
            scan = check_beams(
                path,
                dict(zip(BEAM, table[:, : len(BEAM)].T, strict=True)),
                {layout.header[k]: table[:, len(BEAM) + i].copy() for i, k in enumerate(extras)},
                lambda k, first=first: f"line {number_at(path, first + k, layout.skip)}",
            )
            said = "a recording that was not finished; its whole lines were read"
            yield replace(scan, notes=(*scan.notes, said)) if torn else scan
    if not row:
        raise ScanError("the file holds no beam", file=path)


def check_beams(
    path: Path,
    columns: dict[str, Array],
    extra: dict[str, NDArray[np.generic]],
    place: object,
) -> LineScan:
    """Make a scan of the contract's eight columns, each of shape (n,).

    Parameters
    ----------
    place : callable
        Says where row k of the columns is in the file.

    Raises
    ------
    ScanError
        When a value cannot be used, naming place and column.
    """
    assert callable(place)
    if not len(columns["range"]):
        raise ScanError("the file holds no beam", file=path)
    for name in BEAM[:-1]:
        bad = ~(np.abs(columns[name]) <= (2**53 if name == "scan" else FARTHEST))
        if bad.any():
            row = int(np.argmax(bad))
            raise ScanError(
                "not a finite number, or not in any world", file=path, place=f"{place(row)}, column {name}"
            )
    numbers = columns["scan"]
    odd = numbers != np.round(numbers)
    if odd.any():
        row = int(np.argmax(odd))
        raise ScanError(
            f"{numbers[row]:g} is not a sweep's number", file=path, place=f"{place(row)}, column scan"
        )
    directions = np.stack([columns[name] for name in ("dx", "dy", "dz")], axis=1)
    sizes = np.sqrt(np.einsum("ij,ij->i", directions, directions))
    off = ~(np.abs(sizes - 1.0) <= UNIT_SLACK)
    if off.any():
        row = int(np.argmax(off))
        raise ScanError(
            f"the direction has length {sizes[row]:.6g} instead of 1",
            file=path,
            place=f"{place(row)}, column dx,dy,dz",
        )
    # Decimals cut short are mended; full float64 is left alone, so that files round-trip.
    short = np.abs(sizes - 1.0) > 1e-12
    directions[short] /= sizes[short, None]
    ranges = np.array(columns["range"], np.float64)
    if (ranges < 0.0).any() and np.isfinite(ranges[ranges < 0.0]).any():
        row = int(np.argmax((ranges < 0.0) & np.isfinite(ranges)))
        raise ScanError(
            f"{ranges[row]:g} is not a range",
            file=path,
            place=f"{place(row)}, column range",
            remedy="leave it empty where nothing came back",
        )
    notes: tuple[str, ...] = ()
    if (zero := ranges == 0.0).any():
        notes = ("ranges of 0 count as nothing came back",)
    ranges[zero | ~(np.abs(ranges) <= FARTHEST)] = np.nan
    origins = np.stack([columns[name] for name in ("ox", "oy", "oz")], axis=1).astype(np.float64)
    return LineScan(numbers.astype(np.int64), origins, directions, ranges, str(path), notes, extra)


def write_csv(scan: LineScan | PointCloud, path: Path) -> None:
    """Write a scan such that reading gives every number back exactly."""
    if isinstance(scan, PointCloud):
        names, columns = ["x", "y", "z"], list(scan.points.T)
        if scan.intensity is not None:
            names, columns = [*names, "intensity"], [*columns, scan.intensity]
    else:
        names, columns = list(beam_names(scan)), _beam_columns(scan)
    with path.open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(",".join(names) + "\n")
        stream.writelines(_lines(columns))


def beam_names(scan: LineScan) -> tuple[str, ...]:
    """The columns of a line scan's table."""
    return (*BEAM, *scan.extra)


def beam_lines(scan: LineScan) -> Iterator[str]:
    """The rows of a line scan's table, each with its line end."""
    return _lines(_beam_columns(scan))


def _beam_columns(scan: LineScan) -> list[NDArray[Any]]:
    return [scan.scan, *scan.origins.T, *scan.directions.T, scan.ranges, *scan.extra.values()]


def _lines(columns: Sequence[NDArray[Any]]) -> Iterator[str]:
    for start in range(0, len(columns[0]), 1 << 16):
        cells = [["" if x != x else repr(x) for x in c[start : start + (1 << 16)].tolist()] for c in columns]
        for row in zip(*cells, strict=True):
            yield ",".join(row) + "\n"


def _layout(path: Path) -> _Layout:
    head = first_lines(path)
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise ScanError("its text is UTF-16", file=path, remedy="save it as CSV in UTF-8")
    try:
        text = head.decode("utf-8-sig", errors="ignore" if len(head) == 1 << 16 else "strict")
    except UnicodeDecodeError as error:
        raise ScanError("not a text file", file=path, remedy="expected CSV with a header") from error
    if "\0" in text:
        raise ScanError("not a text file", file=path, remedy="expected CSV with a header")
    lines = text.split("\n")
    for number, line in enumerate(lines, start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            if "\r" in line.rstrip("\r"):
                raise ScanError(
                    "its lines end in CR alone", file=path, remedy="save it as CSV with line ends LF or CR LF"
                )
            delimiter = max(",;\t", key=line.count)
            names = [name.strip().lower() for name in _cells(line.rstrip("\r"), delimiter)]
            # where the delimiter is another, a comma in the first row is a decimal one
            comma = delimiter != "," and number < len(lines) and "," in lines[number]
            return _Layout(names, number, delimiter, comma)
    raise ScanError("no header", file=path, remedy=f"expected {','.join(BEAM)}")


def _cells(line: str, delimiter: str) -> list[str]:
    try:
        return next(csv.reader(io.StringIO(line), delimiter=delimiter), [])
    except csv.Error:
        return line.split(delimiter)


def _numeric_extras(path: Path, layout: _Layout, needed: Sequence[int]) -> list[int]:
    """Further named columns whose first cell is a number."""
    header = layout.header
    with path.open("rb") as stream:
        for _ in range(layout.skip):
            stream.readline()
        first = stream.readline().decode("utf-8", errors="replace")
    cells = _cells(first.rstrip("\r\n"), layout.delimiter)
    out = []
    for k, name in enumerate(header):
        if k in needed or not name or header.index(name) != k or k >= len(cells):
            continue
        try:
            float(cells[k].replace(",", ".") if layout.comma else cells[k])
        except ValueError:
            continue
        out.append(k)
    return out


def _points(path: Path, layout: _Layout) -> Iterator[PointCloud]:
    wanted = [layout.columns[name] for name in ("x", "y", "z")]
    bright = layout.columns.get("intensity")
    cells = wanted if bright is None else [*wanted, bright]
    kept = 0
    for table in read_blocks(
        path, layout.skip, layout.delimiter, layout.header, cells, cells, comma=layout.comma
    ):
        finite = usable(table[:, :3])
        lost = len(finite) - int(finite.sum())
        kept += len(finite) - lost
        yield PointCloud(
            np.ascontiguousarray(table[finite, :3]),
            intensity=None if bright is None else table[finite, 3],
            source=str(path),
            notes=(f"{lost} rows without coordinates left out",) if lost else (),
        )
    if not kept:
        raise ScanError("the file holds no point", file=path)


def _one_cloud(pieces: list[PointCloud]) -> PointCloud:
    bright = [piece.intensity for piece in pieces if piece.intensity is not None]
    return replace(
        pieces[0],
        points=np.concatenate([piece.points for piece in pieces]),
        intensity=np.concatenate(bright) if bright else None,
        notes=tuple(dict.fromkeys(note for piece in pieces for note in piece.notes)),
    )

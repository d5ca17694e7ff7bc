"""CSV with a header: line scans as CONTRACT.md has them, and points (x, y, z)."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.scan.cloud import FARTHEST, PointCloud, usable
from bimfit.scan.formats.text import first_lines, number_at, read_table

BEAM = ("scan", "ox", "oy", "oz", "dx", "dy", "dz", "range")
UNIT_SLACK = 1e-3
"""How far a direction's length may be from 1: four decimals are enough."""


def read_csv(path: Path) -> LineScan | PointCloud:
    """Read a CSV file with a header.

    Raises
    ------
    ScanError
        Naming file, line and column: a missing column, text in a number, a direction that is not of unit
        length, a row of another length; a file without rows.
    """
    header, skip, delimiter = _header(path)
    columns = {name: k for k, name in reversed(list(enumerate(header)))}
    if {"x", "y", "z"} <= columns.keys() and not set(BEAM[1:]) & columns.keys():
        return _points(path, header, columns, skip, delimiter)
    missing = [name for name in BEAM if name not in columns]
    if missing:
        if len(missing) == len(BEAM):
            raise ScanError(
                "no header of a line scan",
                file=path,
                place=f"line {skip}",
                remedy=f"expected {','.join(BEAM)}",
            )
        raise ScanError(
            f"column {', '.join(missing)} is missing",
            file=path,
            place=f"line {skip}",
            remedy=f"a line scan has the columns {','.join(BEAM)}",
        )
    needed = [columns[name] for name in BEAM]
    extras = _numeric_extras(path, header, needed, skip, delimiter)
    blank = [columns["range"]]
    try:
        table = read_table(path, skip, delimiter, header, needed + extras, blank + extras)
    except ScanError:
        # perhaps a column that is none of ours; then it is left out, else the same error comes again
        extras = []
        table = read_table(path, skip, delimiter, header, needed, blank)
    return check_beams(
        path,
        dict(zip(BEAM, table[:, : len(BEAM)].T, strict=True)),
        {header[k]: table[:, len(BEAM) + i].copy() for i, k in enumerate(extras)},
        lambda row: f"line {number_at(path, row, skip)}",
    )


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
        notes = (f"{int(zero.sum())} ranges are 0 and count as nothing came back",)
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
        names = [*BEAM, *scan.extra]
        columns = [scan.scan, *scan.origins.T, *scan.directions.T, scan.ranges, *scan.extra.values()]
    with path.open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(",".join(names) + "\n")
        for start in range(0, len(columns[0]), 1 << 16):
            cells = [
                ["" if x != x else repr(x) for x in c[start : start + (1 << 16)].tolist()] for c in columns
            ]
            stream.writelines(",".join(row) + "\n" for row in zip(*cells, strict=True))


def _header(path: Path) -> tuple[list[str], int, str]:
    """Column names, how many lines up to and with the header, and the delimiter."""
    head = first_lines(path)
    try:
        text = head.decode("utf-8-sig", errors="ignore" if len(head) == 1 << 16 else "strict")
    except UnicodeDecodeError as error:
        raise ScanError("not a text file", file=path, remedy="expected CSV with a header") from error
    if "\0" in text:
        raise ScanError("not a text file", file=path, remedy="expected CSV with a header")
    for number, line in enumerate(text.split("\n"), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            delimiter = max(",;\t", key=line.count)
            names = [name.strip().lower() for name in _cells(line.rstrip("\r"), delimiter)]
            return names, number, delimiter
    raise ScanError("no header", file=path, remedy=f"expected {','.join(BEAM)}")


def _cells(line: str, delimiter: str) -> list[str]:
    try:
        return next(csv.reader(io.StringIO(line), delimiter=delimiter), [])
    except csv.Error:
        return line.split(delimiter)


def _numeric_extras(
    path: Path, header: Sequence[str], needed: Sequence[int], skip: int, delimiter: str
) -> list[int]:
    """Further named columns whose first cell is a number."""
    with path.open("rb") as stream:
        for _ in range(skip):
            stream.readline()
        first = stream.readline().decode("utf-8", errors="replace")
    cells = _cells(first.rstrip("\r\n"), delimiter)
    out = []
    for k, name in enumerate(header):
        if k in needed or not name or header.index(name) != k or k >= len(cells):
            continue
        try:
            float(cells[k])
        except ValueError:
            continue
        out.append(k)
    return out


def _points(path: Path, header: list[str], columns: dict[str, int], skip: int, delimiter: str) -> PointCloud:
    wanted = [columns[name] for name in ("x", "y", "z")]
    bright = columns.get("intensity")
    cells = wanted if bright is None else [*wanted, bright]
    table = read_table(path, skip, delimiter, header, cells, cells)
    finite = usable(table[:, :3])
    if not finite.any():
        raise ScanError("the file holds no point", file=path)
    table = table[finite]
    lost = len(finite) - len(table)
    return PointCloud(
        np.ascontiguousarray(table[:, :3]),
        intensity=None if bright is None else table[:, 3].copy(),
        source=str(path),
        notes=(f"{lost} rows without coordinates left out",) if lost else (),
    )

"""PTX (Leica): structured scans with their scanner's pose; what did not come back is written as 0 0 0.

A scan is: columns, rows, the scanner's position, its three axes, a 4 x 4 matrix for row vectors (translation
in its last row), then a line a point, column after column. A file may hold several.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan, joined
from bimfit.geometry.pose import Array, transform_points
from bimfit.scan.cloud import PointCloud, joined_clouds, usable
from bimfit.scan.formats.options import ReadOptions
from bimfit.scan.formats.organised import beams_of
from bimfit.scan.formats.text import read_table

_HEADER = 10
_RIGID = 1e-3


def read_ptx(path: Path) -> LineScan | PointCloud:
    """Read every scan of a PTX file and carry it into world coordinates by its matrix.

    Where the columns of all scans are sweeps as seen from their scanner, the file is a line scan that knows
    its missing returns; else a cloud of the points.

    Raises
    ------
    ScanError
        When a header does not hold together, a matrix is not rigid, or the file is cut short.
    """
    read = [(beams, cloud) for beams, cloud in _scans(path)]
    if not sum(len(cloud) for _, cloud in read):
        raise ScanError("the file holds no point", file=path)
    whole = [beams for beams, _ in read if beams is not None]
    if len(whole) == len(read):
        return joined(whole, str(path))
    return joined_clouds([cloud for _, cloud in read])


def ptx_chunks(path: Path, options: ReadOptions) -> Iterator[LineScan | PointCloud]:
    """Read a PTX file a scan at a time; as beams if the first scan's columns are sweeps, else as points.

    Raises
    ------
    ScanError
        As :func:`read_ptx` does, at the latest after the last scan.
    """
    as_beams: bool | None = None
    seen = number = 0
    for beams, cloud in _scans(path):
        seen += len(cloud)
        as_beams = beams is not None if as_beams is None else as_beams
        if as_beams and beams is not None:
            yield replace(beams, scan=beams.scan + number)
            number += int(beams.scan.max()) + 1 if len(beams) else 0
        else:
            yield cloud
    if not seen:
        raise ScanError("the file holds no point", file=path)


def _scans(path: Path) -> Iterator[tuple[LineScan | None, PointCloud]]:
    """Every scan in world coordinates, as beams where it can be, and as points."""
    skip = 0
    while (head := _lines(path, skip)) and head[0].strip():
        columns, rows, T = _header(path, head, skip)
        width = len(_lines(path, skip + _HEADER, 1)[0].split()) if columns * rows else 3
        if width < 3:
            raise ScanError("cut short, or no row of numbers", file=path, place=f"line {skip + _HEADER + 1}")
        names = ["x", "y", "z", *(f"{k + 1}" for k in range(3, width))]
        table = read_table(path, skip + _HEADER, " ", names, range(3), range(3), columns * rows)
        if len(table) < columns * rows:
            raise ScanError(f"cut short: {len(table)} of {columns * rows} points", file=path)
        table[~usable(table) | (table == 0.0).all(axis=1)] = np.nan
        grid = table.reshape(columns, rows, 3)
        beams = beams_of(grid, np.zeros(3), str(path), np.dtype(np.float64))
        points = transform_points(T, table[np.isfinite(table).all(axis=1)])
        # where the columns are no sweeps, the scanner did not stand where the header has it
        eye = None if beams is None else T[:3, 3].copy()
        yield None if beams is None else beams.transformed(T), PointCloud(points, eye, source=str(path))
        skip += _HEADER + columns * rows


def _lines(path: Path, skip: int, count: int = _HEADER) -> list[str]:
    with path.open("rb") as stream:
        lines = [line.decode("latin-1") for line in islice(stream, skip, skip + count)]
    return lines if lines or count > 1 else [""]


def _header(path: Path, lines: list[str], skip: int) -> tuple[int, int, Array]:
    place = f"lines {skip + 1} to {skip + _HEADER}"
    try:
        columns, rows = int(lines[0]), int(lines[1])
        matrix = np.array([[float(word) for word in line.split()] for line in lines[6:10]])
        for line in lines[2:6]:
            if len([float(word) for word in line.split()]) != 3:
                raise ValueError(line)
    except (ValueError, IndexError) as error:
        raise ScanError("no header of a PTX scan", file=path, place=place) from error
    if columns < 0 or rows < 0 or matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ScanError("the header of the scan does not hold together", file=path, place=place)
    T = matrix.T
    R = T[:3, :3]
    if (
        np.abs(R).max() > 2.0
        or np.abs(R @ R.T - np.eye(3)).max() > _RIGID
        or np.linalg.det(R) < 0.0
        or not usable(T[None, :3, 3])[0]
    ):
        raise ScanError("the scanner's matrix is not a rigid motion", file=path, place=place)
    return columns, rows, T

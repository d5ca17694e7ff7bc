"""Profile tables of laser line sensors: a profile a row, a height a cell, 0 or nothing where it is missing.

Distances between cells and between rows come from the options, from lines above the table
(``pitch_x, 0.05``, ``# y_pitch = 0.1``, ``unit, mm``), or from the table itself where its first row names
where the columns lie and its first column where the rows do (``y,0.00,0.05,0.10,...``).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.scan.formats.heights import beams_of_heights
from bimfit.scan.formats.options import UNITS, ReadOptions, unit_name
from bimfit.scan.formats.text import first_lines, read_table

_MILLIMETRE = 1e-3
_LEAST_COLUMNS = 16
_MOST_HEADER = 40
_HEAD = 1 << 20
_SETTING = re.compile(
    r"^\W*(?:([xyz])[\s_-]*)?(pitch|step|spacing|interval|unit)(?:[\s_-]*([xyz]))?\s*"
    r"(?:[\[(]\s*(\w+)\s*[\])])?\s*[,;:=\t]\s*([^\s,;]+)\s*[,;]*\s*$",
    re.IGNORECASE,
)
_NOTHING = (-999.0, -9999.0, -99999.0, -999999.0, -32768.0, -2147483648.0, -99.9999, -999.9999, -99999.9999)
"""What sensors write where they measured nothing, besides 0."""


@dataclass(frozen=True)
class _Layout:
    skip: int
    delimiter: str
    columns: int
    settings: dict[str, str]
    places: Array | None
    """Where the columns lie, in the file's unit; then the first cell of every row says where the row does."""


def looks_like_profiles(head: bytes) -> bool:
    """Whether the start of a file is a table of numbers too wide to be anything else."""
    if b"\0" in head:
        return False
    layout = _layout(head.decode("utf-8-sig", errors="replace"))
    return layout is not None


def read_profiles(path: Path, options: ReadOptions) -> LineScan:
    """Read a table of profiles; millimetres, unless the options or the file say otherwise.

    Raises
    ------
    ScanError
        Naming the line of a cell that is no number or a row of another length; when there is no table, no
        height, or the distances between cells or rows are not given.
    """
    layout = _layout(first_lines(path, _HEAD).decode("utf-8-sig", errors="replace"))
    if layout is None:
        raise ScanError(
            "no table of profiles", file=path, remedy=f"expected rows of {_LEAST_COLUMNS} or more numbers"
        )
    unit = _unit(path, layout, options)
    names = [f"{k + 1}" for k in range(layout.columns)]
    table = read_table(
        path, layout.skip, layout.delimiter, names, range(layout.columns), range(layout.columns)
    )
    xs: Array
    ys: Array
    if layout.places is not None:
        ys, xs, table = table[:, 0] * unit, layout.places * unit, table[:, 1:]
        if not np.isfinite(ys).all():
            raise ScanError("a row does not say where it lies", file=path)
    else:
        across, along = (_pitch(path, layout, options, unit, axis) for axis in "xy")
        xs = across * np.arange(table.shape[1], dtype=np.float64)
        ys = along * np.arange(len(table), dtype=np.float64)
    table[np.isin(table, (0.0, *_NOTHING)) | ~(np.abs(table) < 1e9)] = np.nan
    up = options.pixel[2] or unit
    rows, columns = table.shape
    if not np.isfinite(table).any():
        raise ScanError("the file holds no height", file=path)
    missing = int(np.isnan(table).sum())
    note = f"{rows} profiles of {columns} heights, {missing:,} of them missing, in {unit_name(up)}"
    return beams_of_heights(table * up, xs, ys, str(path), (note,))


def _unit(path: Path, layout: _Layout, options: ReadOptions) -> float:
    named = layout.settings.get("unit", "").lower()
    if options.unit is not None:
        return options.unit
    if named and named not in UNITS:
        raise ScanError(
            f"unknown unit {named[:20]!r}", file=path, remedy=f"say --scan-unit {', '.join(UNITS)}"
        )
    return UNITS[named] if named else _MILLIMETRE


def _pitch(path: Path, layout: _Layout, options: ReadOptions, unit: float, axis: str) -> float:
    """Distance between columns (x) or rows (y), m."""
    given = options.pixel["xy".index(axis)]
    if given is not None:
        return given
    text = layout.settings.get(axis) or layout.settings.get("")
    try:
        value = float(text) if text else math.nan
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value != 0.0):
        which = "columns" if axis == "x" else "rows"
        raise ScanError(
            f"the file does not say how far apart its {which} are", file=path,
            remedy="give --pixel ACROSS,ALONG, such as --pixel 0.05mm,0.1mm",
        )  # fmt: skip
    return value * unit


def _layout(text: str) -> _Layout | None:
    """Where the table begins; None where there is none."""
    settings: dict[str, str] = {}
    named = 0
    for number, raw in enumerate(text.split("\n")[:_MOST_HEADER]):
        line = raw.rstrip("\r")
        if _take_setting(line, settings) or not line.strip() or line.lstrip().startswith(("#", "//", "%")):
            continue
        delimiter = max(",;\t", key=line.count)
        cells = line.split(delimiter)
        if len(cells) >= _LEAST_COLUMNS and all(map(_is_number, cells)):
            # as many words above it name its columns: then they are no profile's heights
            return None if named == len(cells) else _Layout(number, delimiter, len(cells), settings, None)
        if len(cells) > _LEAST_COLUMNS and not _is_number(cells[0]) and all(map(_is_place, cells[1:])):
            places = np.array([float(cell) for cell in cells[1:]])
            if (np.abs(np.diff(places)) > 0.0).all():
                return _Layout(number + 1, delimiter, len(cells), settings, places)
        named = len(cells)
    return None


def _take_setting(line: str, settings: dict[str, str]) -> bool:
    """Keep what a line above the table says of pitch or unit; whether it does."""
    found = _SETTING.match(line)
    if not found:
        return False
    before, what, after, unit, value = found.groups()
    key = "unit" if what.lower() == "unit" else (before or after or "").lower()
    settings[key] = value
    if unit:
        settings.setdefault("unit", unit)
    return True


def _is_place(cell: str) -> bool:
    return bool(cell.strip()) and _is_number(cell) and math.isfinite(float(cell))


def _is_number(cell: str) -> bool:
    """Whether a cell is a number or empty."""
    text = cell.strip()
    if "_" in text:  # which float() takes for part of a number
        return False
    try:
        float(text or "0")
    except ValueError:
        return False
    return True

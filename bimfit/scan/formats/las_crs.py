"""The unit of length that a LAS or LAZ file's coordinate system states.

Two forms occur: OGC well-known text (WKT 1 as LAS 1.4 R15 has it, and WKT 2), and GeoTIFF keys. A code of the
EPSG register alone states no unit here, since the register is not at hand.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bimfit.errors import ScanError
from bimfit.scan.formats.las_header import check_header
from bimfit.scan.formats.options import UNITS, unit_name

_PROJECTED = ("PROJCS", "PROJCRS", "PROJECTEDCRS", "LOCAL_CS", "ENGCRS", "ENGINEERINGCRS", "GEOCCS")
_VERTICAL = ("VERT_CS", "VERTCRS", "VERTICALCRS")
_GEOGRAPHIC = ("GEOGCS", "GEOGCRS", "GEOGRAPHICCRS")
_UNIT = ("UNIT", "LENGTHUNIT")
_TOKEN = re.compile(r'"((?:[^"]|"")*)"|([A-Za-z_][A-Za-z0-9_]*)|([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)|([][(),])')
_MOST_TEXT = 1 << 16
# keys of GeoTIFF 1.1 and codes of its linear units
_MODEL, _SYSTEM, _LINEAR, _LINEAR_SIZE, _UPRIGHT = 1024, 3072, 3076, 3077, 4099
_IN_DEGREES = 2
_CODES = {9001: 1.0, 9002: UNITS["ft"], 9003: UNITS["usft"]}
_LEAST, _MOST = 1e-4, 1e4
_OWN, _LONGEST = 32767, 40


@dataclass(frozen=True)
class _Node:
    """A keyword of well-known text with what stands in its brackets."""

    name: str
    values: list[str | float] = field(default_factory=list)
    children: list[_Node] = field(default_factory=list)

    def walk(self) -> Iterator[_Node]:
        """Yield the node and all below it."""
        waiting = [self]
        while waiting:
            node = waiting.pop()
            yield node
            waiting.extend(reversed(node.children))


def las_unit(path: Path) -> tuple[float | None, str]:
    """Metres a unit of length, as the file's coordinate system states; None where it states none.

    Returns
    -------
    unit : float or None
    note : str
        That a coordinate system is named and its unit is not, else empty.

    Raises
    ------
    ScanError
        When positions are degrees, heights have another unit than positions, or the unit is not known.
    """
    from bimfit.scan.formats.las import las_errors

    try:
        import laspy
    except ImportError:
        return None, ""  # reading it says so
    check_header(path)
    with las_errors(path), laspy.open(path) as reader:
        records = [*reader.header.vlrs, *(reader.header.evlrs or ())]
    text, keys = None, None
    for record in records:
        kind = type(record).__name__
        if kind == "WktCoordinateSystemVlr":
            text = str(record.string)[:_MOST_TEXT]
        elif kind == "GeoKeyDirectoryVlr":
            keys = record
    if text is not None and text.strip("\0 \n\t"):
        flat, upright, degrees = units_of_wkt(text)
    elif keys is not None:
        try:
            flat, upright, degrees = _units_of_keys(keys, records)
        except ValueError as error:
            raise ScanError(str(error), file=path, remedy="give --scan-unit") from error
    else:
        return None, ""
    if degrees:
        raise ScanError(
            "its positions are longitudes and latitudes in degrees", file=path, remedy="project it first"
        )
    if flat is not None and upright is not None and not math.isclose(flat, upright, rel_tol=1e-5):
        raise ScanError(
            f"its coordinate system has positions in {unit_name(flat)} and heights in {unit_name(upright)}",
            file=path,
            remedy="convert it to one unit, or give --scan-unit if all three are in one",
        )
    return flat, _without_unit(text, keys) if flat is None else ""


def _without_unit(text: str | None, keys: Any) -> str:
    """A note that a coordinate system is named whose unit is not, if there is one."""
    names = [] if text is None else [n.values[0] for r in _parsed(text) for n in r.walk() if n.values]
    codes = [] if keys is None else [int(k.value_offset) for k in keys.geo_keys if int(k.id) == _SYSTEM]
    name = f"EPSG:{codes[0]}" if codes and codes[0] != _OWN else str(names[0])[:_LONGEST] if names else ""
    return f"its coordinate system ({name}) states no unit of length: --scan-unit does" if name else ""


def units_of_wkt(text: str) -> tuple[float | None, float | None, bool]:
    """Metres a unit of positions and of heights, and whether positions are degrees, of well-known text."""
    nodes = [node for root in _parsed(text) for node in root.walk()]
    flat = next((_unit(node) for node in nodes if node.name in _PROJECTED), None)
    upright = next((_unit(node) for node in nodes if node.name in _VERTICAL), None)
    plane = any(node.name in _PROJECTED for node in nodes)
    return flat, upright, not plane and any(node.name in _GEOGRAPHIC for node in nodes)


def _unit(system: _Node) -> float | None:
    """The unit of a coordinate system: its own, or that of its first axis."""
    axes = [child for axis in system.children if axis.name == "AXIS" for child in axis.children]
    for node in (*reversed(system.children), *axes):
        if node.name in _UNIT and len(node.values) > 1 and isinstance(node.values[1], float):
            return _known(node.values[1])
    return None


def _known(size: float) -> float | None:
    """The named unit of that size, to the digits that files give; None for a size that is none."""
    if not _LEAST < size < _MOST:
        return None
    # feet and US survey feet differ by 2e-6
    return next((u for u in UNITS.values() if math.isclose(u, size, rel_tol=5e-7)), size)


def _parsed(text: str) -> list[_Node]:
    """Well-known text as trees; what is not well-formed is passed over."""
    roots: list[_Node] = []
    open_: list[_Node] = []
    word: str | None = None
    for quoted, name, number, mark in _TOKEN.findall(text):
        if mark in ("[", "(") and word is not None:
            node = _Node(word)
            (open_[-1].children if open_ else roots).append(node)
            open_.append(node)
        elif mark in ("]", ")") and open_:
            open_.pop()
        elif open_ and number:
            open_[-1].values.append(_float(number))
        elif open_ and not name and not mark:
            open_[-1].values.append(quoted)
        word = name.upper() if name else None
    return roots


def _float(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _units_of_keys(directory: Any, records: list[Any]) -> tuple[float | None, float | None, bool]:
    """As :func:`units_of_wkt`, of GeoTIFF keys."""
    found = {int(key.id): key for key in directory.geo_keys}

    def plain(number: int) -> int | None:
        key = found.get(number)
        return None if key is None or key.tiff_tag_location else int(key.value_offset)

    flat = _CODES.get(plain(_LINEAR) or 0)
    if flat is None and _LINEAR_SIZE in found:
        doubles = next((r for r in records if type(r).__name__ == "GeoDoubleParamsVlr"), None)
        numbers = [] if doubles is None else [float(getattr(d, "value", d)) for d in doubles.doubles]
        place = int(found[_LINEAR_SIZE].value_offset)
        flat = _known(numbers[place]) if place < len(numbers) else None
    elif flat is None and plain(_LINEAR) is not None:
        raise ValueError(
            f"its coordinate system has the unit {plain(_LINEAR)} of GeoTIFF, which is not known"
        )
    return flat, _CODES.get(plain(_UPRIGHT) or 0), plain(_MODEL) == _IN_DEGREES

"""PLY, ASCII and binary, in the precision of the file (Turk 1994; http://paulbourke.net/dataformats/ply/).

Open3D writes PLY in double precision but prints six digits in ASCII, reads what is cut short without a word,
and knows no viewpoint; hence a reader of our own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.scan.cloud import PointCloud, joined_clouds
from bimfit.scan.formats.options import ReadOptions
from bimfit.scan.formats.packed import PIECE, clouds_of, packed_rows
from bimfit.scan.formats.text import first_lines, read_blocks, read_table

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
_ORDER = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class _Element:
    name: str
    count: int
    names: list[str]
    types: list[str]  # of lists: "count type:item type"

    @property
    def has_lists(self) -> bool:
        return any(":" in kind for kind in self.types)


@dataclass
class _Header:
    form: str
    elements: list[_Element]
    comments: list[str]
    size: int  # bytes
    lines: int


def read_ply(path: Path) -> PointCloud:
    """Read the vertices of a PLY file as a cloud; faces are left aside.

    A comment ``viewpoint x y z`` says where the sensor stood.

    Raises
    ------
    ScanError
        When it is no PLY file, is cut short, or has no vertices with x, y and z.
    """
    return joined_clouds(list(_pieces(path, None)))


def ply_chunks(path: Path, options: ReadOptions) -> Iterator[PointCloud]:
    """Read the vertices of a PLY file in pieces.

    Raises
    ------
    ScanError
        As :func:`read_ply` does, at the latest after the last piece.
    """
    return _pieces(path, PIECE)


def _pieces(path: Path, size: int | None) -> Iterator[PointCloud]:
    """Clouds of ``size`` vertices each, or of all."""
    header = _header(path)
    vertex = next((e for e in header.elements if e.name == "vertex"), None)
    if vertex is None or not {"x", "y", "z"} <= set(vertex.names):
        raise ScanError("no vertices with x, y and z", file=path)
    if vertex.has_lists:
        raise ScanError("vertices with list properties are not supported", file=path)
    if not vertex.count:
        raise ScanError("the file holds no point", file=path)
    faces = sum(e.count for e in header.elements if e.name == "face")
    notes = (f"a mesh: its {vertex.count} vertices are read, its {faces} faces are not",) if faces else ()
    read = _ascii if header.form == "ascii" else _binary
    yield from clouds_of(path, read(path, header, vertex, size), _viewpoint(header.comments), notes)


def write_ply(scan: LineScan | PointCloud, path: Path) -> None:
    """Write a cloud as binary PLY in double precision."""
    assert isinstance(scan, PointCloud)
    fields: list[tuple[str, str, NDArray[np.generic]]] = [
        (name, "double", column) for name, column in zip("xyz", scan.points.T, strict=True)
    ]
    if scan.normals is not None:
        fields += [(f"n{axis}", "double", column) for axis, column in zip("xyz", scan.normals.T, strict=True)]
    if scan.colors is not None:
        colors = zip(("red", "green", "blue"), scan.colors.T, strict=True)
        fields += [(name, "uchar", column) for name, column in colors]
    if scan.intensity is not None:
        fields.append(("intensity", "double", scan.intensity))
    table = np.empty(len(scan), [(name, "<" + _TYPES[kind]) for name, kind, _ in fields])
    for name, _, column in fields:
        table[name] = column
    eye = scan.viewpoint
    head = ["ply", "format binary_little_endian 1.0", "comment written by bimfit, metres"]
    head += [] if eye is None else ["comment viewpoint " + " ".join(repr(float(x)) for x in eye)]
    head += [
        f"element vertex {len(scan)}",
        *(f"property {kind} {name}" for name, kind, _ in fields),
        "end_header\n",
    ]
    with path.open("wb") as stream:
        stream.write("\n".join(head).encode("ascii"))
        stream.write(table.tobytes())


def _header(path: Path) -> _Header:
    head = first_lines(path, 1 << 20)
    if not head.startswith(b"ply"):
        raise ScanError("not a PLY file", file=path)
    end = head.find(b"end_header")
    stop = head.find(b"\n", end) + 1
    if end < 0 or not stop:
        raise ScanError("the header has no end", file=path)
    out = _Header("", [], [], stop, head.count(b"\n", 0, stop))
    for number, line in enumerate(head[:end].decode("latin-1").splitlines(), start=1):
        words = line.split()
        try:
            _header_line(out, words, line)
        except (KeyError, IndexError, ValueError) as error:
            raise ScanError(f"cannot make sense of {line!r}", file=path, place=f"line {number}") from error
    if out.form not in _ORDER:
        raise ScanError("the header names no known format", file=path)
    return out


def _header_line(out: _Header, words: list[str], line: str) -> None:
    if not words or words[0] in ("ply", "obj_info"):
        return
    if words[0] == "format":
        out.form = words[1]
    elif words[0] == "comment":
        out.comments.append(line.split("comment", 1)[1].strip())
    elif words[0] == "element":
        if int(words[2]) < 0:
            raise ValueError(line)
        out.elements.append(_Element(words[1], int(words[2]), [], []))
    elif words[0] == "property":
        element = out.elements[-1]
        kind = f"{_TYPES[words[2]]}:{_TYPES[words[3]]}" if words[1] == "list" else _TYPES[words[1]]
        element.types.append(kind)
        element.names.append(words[-1])
    else:
        raise ValueError(line)


def _viewpoint(comments: list[str]) -> Array | None:
    for comment in comments:
        words = comment.split()
        if len(words) == 4 and words[0] == "viewpoint":
            try:
                return np.array([float(word) for word in words[1:]])
            except ValueError:
                return None
    return None


def _ascii(
    path: Path, header: _Header, vertex: _Element, size: int | None
) -> Iterator[dict[str, NDArray[np.generic]]]:
    before = sum(e.count for e in header.elements[: header.elements.index(vertex)])
    every = range(len(vertex.names))
    read = read_blocks if size else _whole
    seen = 0
    for table in read(path, header.lines + before, " ", vertex.names, every, every, vertex.count):
        seen += len(table)
        # What was a whole number in the file is one again (colours); coordinates are exact as printed.
        yield {
            name: column.astype(kind) if kind[0] in "iu" else column
            for name, kind, column in zip(vertex.names, vertex.types, table.T, strict=True)
        }
    if seen < vertex.count:
        raise ScanError(f"cut short: {seen} of {vertex.count} vertices", file=path)


def _whole(*args: Any) -> Iterator[Array]:
    yield read_table(*args)


def _binary(
    path: Path, header: _Header, vertex: _Element, size: int | None
) -> Iterator[dict[str, NDArray[np.generic]]]:
    order = _ORDER[header.form]
    start = header.size
    for element in header.elements[: header.elements.index(vertex)]:
        start += _length(path, start, element, order)
    kind = np.dtype([(f"{k}", order + t) for k, t in enumerate(vertex.types)])
    for table in packed_rows(path, kind, vertex.count, start, size, "vertices"):
        yield {name: table[f"{k}"].astype(kind[k].newbyteorder("=")) for k, name in enumerate(vertex.names)}


def _length(path: Path, start: int, element: _Element, order: str) -> int:
    """Bytes that a whole element takes."""
    if not element.has_lists:
        return element.count * sum(np.dtype(t).itemsize for t in element.types)
    data = path.read_bytes()
    at = start
    for _ in range(element.count):
        for kind in element.types:
            count, item = kind.split(":") if ":" in kind else ("", kind)
            number = 1
            if count:
                size = np.dtype(count).itemsize
                if at + size > len(data):
                    raise ScanError(f"cut short within {element.name}", file=path)
                number = int(np.frombuffer(data, order + count, 1, at)[0])
                at += size
            at += number * np.dtype(item).itemsize
    return at - start

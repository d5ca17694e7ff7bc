"""PCD 0.7: ascii, binary, binary_compressed (https://pointclouds.org/documentation/tutorials/pcd_file_format.html).

Open3D reads PCD coordinates into single precision and drops VIEWPOINT; hence a reader of our own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.scan.cloud import PointCloud, joined_clouds, usable
from bimfit.scan.formats.options import ReadOptions
from bimfit.scan.formats.organised import beams_of
from bimfit.scan.formats.packed import PIECE, clouds_of, packed_rows
from bimfit.scan.formats.text import first_lines, read_blocks

_MOST_BYTES = 1 << 20
"""No point has more."""
_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")


@dataclass
class _Header:
    names: list[str] = field(default_factory=list)
    types: list[str] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    width: int = 0
    height: int = 1
    points: int = 0
    viewpoint: Array | None = None
    data: str = ""
    size: int = 0
    lines: int = 0

    @property
    def columns(self) -> list[str]:
        """A name for every number of a point."""
        out = []
        for name, count in zip(self.names, self.counts, strict=True):
            out += [name] if count == 1 else [f"{name}[{k}]" for k in range(count)]
        return out


def read_pcd(path: Path) -> LineScan | PointCloud:
    """Read a PCD file.

    An organised cloud (HEIGHT over 1) whose rows or columns are sweeps as seen from its VIEWPOINT becomes a
    line scan, rows of NaN being beams that did not come back
    (:func:`~bimfit.scan.formats.organised.beams_of`). A VIEWPOINT at the origin in an unorganised file is
    what writers put there when they know nothing, and counts as unknown.

    Raises
    ------
    ScanError
        When it is no PCD file, is cut short or damaged, or has no x, y and z.
    """
    header = _checked(path)
    eye = header.viewpoint if header.viewpoint is not None else np.zeros(3)
    if header.height > 1:
        (columns,) = _columns(path, header, None)
        points = np.stack([columns[n].astype(np.float64) for n in "xyz"], axis=1)
        points[~usable(points)] = np.nan
        grid = points.reshape(header.height, header.width, 3)
        scan = beams_of(grid, eye, str(path), columns["x"].dtype)
        return scan if scan is not None else joined_clouds(list(clouds_of(path, [columns], _known(eye))))
    return joined_clouds(list(clouds_of(path, _columns(path, header, None), _known(eye))))


def pcd_chunks(path: Path, options: ReadOptions) -> Iterator[LineScan | PointCloud]:
    """Read a PCD file in pieces; organised and compressed ones are one piece.

    Raises
    ------
    ScanError
        As :func:`read_pcd` does, at the latest after the last piece.
    """
    header = _checked(path)
    if header.height > 1:
        yield read_pcd(path)
        return
    eye = header.viewpoint if header.viewpoint is not None else np.zeros(3)
    yield from clouds_of(path, _columns(path, header, PIECE), _known(eye))


def _known(eye: Array) -> Array | None:
    return eye if np.any(eye != 0.0) else None


def _checked(path: Path) -> _Header:
    header = _header(path)
    if not {"x", "y", "z"} <= set(header.names):
        raise ScanError("no fields x, y and z", file=path)
    if header.points <= 0:
        raise ScanError("the file holds no point", file=path)
    return header


def _columns(path: Path, header: _Header, size: int | None) -> Iterator[dict[str, NDArray[np.generic]]]:
    """The fields of ``size`` points at a time, or of all."""
    if header.data == "ascii":
        yield from _ascii(path, header, size)
    elif header.data == "binary":
        yield from _binary(path, header, size)
    else:
        yield _compressed(path, header)


def write_pcd(scan: LineScan | PointCloud, path: Path) -> None:
    """Write a cloud as binary PCD in double precision."""
    assert isinstance(scan, PointCloud)
    names, columns = ["x", "y", "z"], list(scan.points.T)
    if scan.normals is not None:
        names, columns = [*names, "normal_x", "normal_y", "normal_z"], [*columns, *scan.normals.T]
    if scan.intensity is not None:
        names, columns = [*names, "intensity"], [*columns, scan.intensity]
    eye = scan.viewpoint if scan.viewpoint is not None else np.zeros(3)
    count = len(names)
    head = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE{' 8' * count}",
        f"TYPE{' F' * count}",
        f"COUNT{' 1' * count}",
        f"WIDTH {len(scan)}",
        "HEIGHT 1",
        f"VIEWPOINT {' '.join(repr(float(x)) for x in eye)} 1 0 0 0",
        f"POINTS {len(scan)}",
        "DATA binary\n",
    ]
    with path.open("wb") as stream:
        stream.write("\n".join(head).encode("ascii"))
        stream.write(np.ascontiguousarray(np.stack(columns, axis=1), "<f8").tobytes())


def _header(path: Path) -> _Header:
    head = first_lines(path, 1 << 16)
    if not head.lstrip().startswith((b"# .PCD", b"VERSION", b"#", b"FIELDS")):
        raise ScanError("not a PCD file", file=path)
    out, values, at = _Header(), {}, 0
    while True:
        stop = head.find(b"\n", at) + 1
        if not stop:
            raise ScanError("not a PCD file: its header has no DATA line", file=path)
        words = head[at:stop].decode("latin-1").split()
        at, out.lines = stop, out.lines + 1
        if not words or words[0].startswith("#"):
            continue
        if words[0] not in _KEYS:
            raise ScanError(
                f"not a PCD file: {words[0][:40]!r} in its header", file=path, place=f"line {out.lines}"
            )
        values[words[0]] = words[1:]
        if words[0] == "DATA":
            break
    out.size = at
    try:
        _fill(out, values)
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise ScanError(f"the header does not hold together: {error!r}", file=path) from error
    return out


def _fill(out: _Header, values: dict[str, list[str]]) -> None:
    names = values["FIELDS"]
    counts = [int(x) for x in values.get("COUNT", ["1"] * len(names))]
    kinds = [f"{t.lower()}{int(s)}" for t, s in zip(values["TYPE"], values["SIZE"], strict=True)]
    if not len(names) == len(counts) == len(kinds) or min(counts, default=0) < 1:
        raise ValueError("FIELDS, SIZE, TYPE and COUNT differ in number")
    if sum(np.dtype(kind).itemsize * count for kind, count in zip(kinds, counts, strict=True)) > _MOST_BYTES:
        raise ValueError("a point that large")
    out.names, out.counts, out.types = names, counts, [np.dtype(f"<{kind}").str for kind in kinds]
    out.width, out.height = int(values["WIDTH"][0]), int(values.get("HEIGHT", ["1"])[0])
    out.points = int(values["POINTS"][0]) if "POINTS" in values else out.width * out.height
    if out.width * out.height != out.points:
        out.width, out.height = out.points, 1
    if "VIEWPOINT" in values:
        eye = np.array([float(x) for x in values["VIEWPOINT"][:3]])
        out.viewpoint = eye if eye.shape == (3,) and usable(eye[None])[0] else None
    out.data = values["DATA"][0]
    if out.data not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"DATA {out.data}")


def _ascii(path: Path, header: _Header, size: int | None) -> Iterator[dict[str, NDArray[np.generic]]]:
    names = header.columns
    wanted = [k for k, name in enumerate(names) if "[" not in name]
    blocks = read_blocks(path, header.lines, " ", names, wanted, wanted, header.points)
    seen = 0
    for table in blocks if size else [np.concatenate([np.zeros((0, len(wanted))), *blocks])]:
        seen += len(table)
        yield {names[k]: column for k, column in zip(wanted, table.T, strict=True)}
    if seen < header.points:
        raise ScanError(f"cut short: {seen} of {header.points} points", file=path)


def _binary(path: Path, header: _Header, size: int | None) -> Iterator[dict[str, NDArray[np.generic]]]:
    kind = np.dtype(
        [(f"{k}", t, (c,)) for k, (t, c) in enumerate(zip(header.types, header.counts, strict=True))]
    )
    for table in packed_rows(path, kind, header.points, header.size, size, "points"):
        yield {name: table[f"{k}"][:, 0] for k, name in enumerate(header.names) if header.counts[k] == 1}


def _compressed(path: Path, header: _Header) -> dict[str, NDArray[np.generic]]:
    data = path.read_bytes()[header.size :]
    if len(data) < 8:
        raise ScanError("cut short", file=path)
    packed, full = (int(x) for x in np.frombuffer(data, "<u4", 2))
    sizes = [np.dtype(t).itemsize * c for t, c in zip(header.types, header.counts, strict=True)]
    if len(data) < 8 + packed:
        raise ScanError(f"cut short: {len(data) - 8} of {packed} compressed bytes", file=path)
    if full != sum(sizes) * header.points:
        raise ScanError("damaged: its size does not fit its fields", file=path)
    raw = lzf_decompress(data[8 : 8 + packed], full)
    if raw is None:
        raise ScanError("damaged: the compressed data make no sense", file=path)
    out: dict[str, NDArray[np.generic]] = {}
    at = 0
    for name, kind, count, size in zip(header.names, header.types, header.counts, sizes, strict=True):
        if count == 1:
            out[name] = np.frombuffer(raw, kind, header.points, at)
        at += size * header.points
    return out


def lzf_decompress(data: bytes, size: int) -> bytes | None:
    """Undo LibLZF compression; None where the data are damaged or do not give ``size`` bytes."""
    out = bytearray()
    at, end = 0, len(data)
    try:
        while at < end and len(out) <= size:
            control = data[at]
            at += 1
            if control < 32:  # as many bytes as they are, and one
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            back = (control & 31) << 8
            if length == 7:
                length += data[at]
                at += 1
            back += data[at] + 1
            at += 1
            length += 2
            start = len(out) - back
            if start < 0:
                return None
            chunk = out[start : start + length]
            while len(chunk) < length:  # it runs into what it is itself writing
                chunk += chunk[: length - len(chunk)]
            out += chunk
    except IndexError:
        return None
    return bytes(out) if len(out) == size and at == end else None

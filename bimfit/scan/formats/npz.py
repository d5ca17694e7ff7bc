"""NumPy archives: the contract's columns as arrays, or points."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.scan.cloud import PointCloud, usable
from bimfit.scan.formats.delimited import BEAM, check_beams
from bimfit.scan.formats.options import ANY, ReadOptions

_PIECE = 1_000_000


def read_npz(path: Path) -> LineScan | PointCloud:
    """Read a line scan (arrays scan, ox, ..., range) or a cloud (points, or x, y and z).

    Raises
    ------
    ScanError
        When it is no such archive, or an array is missing, not numeric or of another length.
    """
    arrays = _arrays(path)
    if not set(BEAM[1:]) & arrays.keys() and ("points" in arrays or {"x", "y", "z"} <= arrays.keys()):
        return _points(path, arrays)
    missing = [name for name in BEAM if name not in arrays]
    if missing:
        raise ScanError(
            f"array {', '.join(missing)} is missing", file=path, remedy=f"a line scan has {', '.join(BEAM)}"
        )
    columns = {name: _column(path, name, arrays[name]) for name in BEAM}
    count = len(columns["range"])
    for name, column in columns.items():
        if len(column) != count:
            raise ScanError(f"{len(column)} values where range has {count}", file=path, place=f"array {name}")
    extra = {
        name: value
        for name, value in arrays.items()
        if name not in BEAM and value.shape == (count,) and value.dtype.kind in "fiub"
    }
    return check_beams(path, columns, extra, lambda row: f"row {row}")


def npz_chunks(path: Path, options: ReadOptions = ANY) -> Iterator[LineScan | PointCloud]:
    """Read a line scan in pieces; a cloud is one piece.

    The pieces are read from all arrays side by side, and never more of them than a million beams.

    Raises
    ------
    ScanError
        As :func:`read_npz` does, at the latest after the last piece.
    """
    with _damage(path), ExitStack() as stack:
        archive = stack.enter_context(zipfile.ZipFile(path))
        names = {Path(name).stem: name for name in archive.namelist() if name.endswith(".npy")}
        if not set(BEAM) <= names.keys():
            yield read_npz(path)
            return
        arrays = {name: _Stored.open(stack.enter_context(archive.open(names[name]))) for name in names}
        count = arrays["range"].count
        own = {name: one for name, one in arrays.items() if one.count == count}
        if count <= _PIECE or not set(BEAM) <= own.keys():
            yield read_npz(path)
            return
        for start in range(0, count, _PIECE):
            size = min(_PIECE, count - start)
            read = {name: one.read(size) for name, one in own.items()}
            columns = {name: _column(path, name, read.pop(name)) for name in BEAM}
            yield check_beams(path, columns, read, lambda row, start=start: f"row {start + row}")


@dataclass(frozen=True)
class _Stored:
    """A one-dimensional array of numbers inside an archive, read from its front; ``count`` -1 for others."""

    stream: IO[bytes]
    count: int
    dtype: np.dtype[np.generic]

    @classmethod
    def open(cls, stream: IO[bytes]) -> _Stored:
        version = np.lib.format.read_magic(stream)
        read = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = read(stream)
        plain = len(shape) == 1 and dtype.kind in "fiub"
        return cls(stream, int(shape[0]) if plain else -1, dtype)

    def read(self, count: int) -> NDArray[np.generic]:
        data = self.stream.read(count * self.dtype.itemsize)
        return np.frombuffer(data, self.dtype, count)


def write_npz(scan: LineScan | PointCloud, path: Path) -> None:
    """Write a scan as arrays, in full precision."""
    if isinstance(scan, PointCloud):
        optional = {name: getattr(scan, name) for name in ("viewpoint", "normals", "colors", "intensity")}
        np.savez(path, points=scan.points, **{k: v for k, v in optional.items() if v is not None})
        return
    columns = [scan.scan, *scan.origins.T, *scan.directions.T, scan.ranges]
    np.savez(path, **dict(zip(BEAM, columns, strict=True)), **dict(scan.extra))  # type: ignore[arg-type]


def _arrays(path: Path) -> dict[str, NDArray[np.generic]]:
    with _damage(path), path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise ScanError("not an .npz archive", file=path)
        return {name: archive[name] for name in archive.files}


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    """Turn what damage makes NumPy, zip and zlib raise into one clear line."""
    try:
        yield
    except ScanError:
        raise
    except OSError as error:
        raise ScanError(f"cannot be read: {error.strerror or error}", file=path) from error
    except Exception as error:
        # NumPy hands on whatever its parts make of damage: zip, zlib, tokenizer, parser, memory.
        raise ScanError("not an .npz archive, or cut short", file=path) from error


def _column(path: Path, name: str, value: NDArray[np.generic]) -> NDArray[np.float64]:
    if value.dtype.kind not in "fiub" or value.ndim != 1:
        raise ScanError(
            f"expected numbers of shape (n,), got {value.dtype} {value.shape}",
            file=path,
            place=f"array {name}",
        )
    return value.astype(np.float64)


def _points(path: Path, arrays: dict[str, NDArray[np.generic]]) -> PointCloud:
    if "points" in arrays:
        raw = arrays["points"]
    else:
        raw = np.stack([_column(path, name, arrays[name]) for name in ("x", "y", "z")], axis=1)
    if raw.ndim != 2 or raw.shape[1] != 3 or raw.dtype.kind not in "fiu":
        raise ScanError(f"expected numbers of shape (n, 3), got {raw.shape}", file=path, place="array points")
    points = raw.astype(np.float64)
    keep = usable(points)
    if not keep.any():
        raise ScanError("the file holds no point", file=path)

    def along(name: str, shape: tuple[int, ...]) -> NDArray[np.generic] | None:
        value = arrays.get(name)
        return value if value is not None and value.shape == shape and value.dtype.kind in "fiu" else None

    count = len(points)
    eye, normals = along("viewpoint", (3,)), along("normals", (count, 3))
    colors, bright = along("colors", (count, 3)), along("intensity", (count,))
    lost = count - int(keep.sum())
    return PointCloud(
        points[keep],
        None if eye is None else eye.astype(np.float64),
        None if normals is None else normals[keep].astype(np.float64),
        None if colors is None else colors[keep].astype(np.uint8),
        None if bright is None else bright[keep].astype(np.float64),
        str(path),
        (f"{lost} points without coordinates left out",) if lost else (),
    )

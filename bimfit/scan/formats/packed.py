"""What PLY and PCD have in common: named columns of points, in one precision or another."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bimfit.errors import ScanError
from bimfit.geometry.pose import Array
from bimfit.scan.cloud import PointCloud, usable

Columns = Mapping[str, NDArray[np.generic]]

PIECE = 1_000_000
"""Rows read at a time where a file is read in pieces."""
COARSE = 1e-4
"""A file's own precision is worth a note where it is coarser than this, m."""
_INTENSITY = ("intensity", "scalar_intensity", "reflectance")


def packed_rows(
    path: Path, kind: np.dtype[np.void], count: int, start: int, size: int | None, what: str
) -> Iterator[NDArray[np.void]]:
    """Rows of a binary table from byte ``start`` on, ``size`` at a time, or all at once.

    Raises
    ------
    ScanError
        When the file is too short for ``count`` of them: "cut short: 5 of 8 ``what``".
    """
    have = max(path.stat().st_size - start, 0) // kind.itemsize
    if have < count:
        raise ScanError(f"cut short: {have} of {count} {what}", file=path)
    step = size or count
    for row in range(0, count, step):
        yield np.fromfile(path, kind, min(step, count - row), offset=start + row * kind.itemsize)


def clouds_of(
    path: Path, pieces: Iterable[Columns], viewpoint: Array | None, notes: tuple[str, ...] = ()
) -> Iterator[PointCloud]:
    """Clouds of pieces of a file's columns, in which at least one point has coordinates.

    Raises
    ------
    ScanError
        When none has, after the last piece.
    """
    seen = 0
    for columns in pieces:
        cloud = cloud_of(path, columns, viewpoint, notes)
        seen += len(cloud)
        yield cloud
    if not seen:
        raise ScanError("the file holds no point", file=path)


def cloud_of(
    path: Path, columns: Columns, viewpoint: Array | None, notes: tuple[str, ...] = ()
) -> PointCloud:
    """Make a cloud of a file's columns, without the points that have no coordinates.

    Parameters
    ----------
    columns : mapping of str to ndarray, shape (n,)
        At least x, y and z; normals, colours and intensity where their usual names are present.

    """
    xyz = [columns[name] for name in ("x", "y", "z")]
    points = np.stack([column.astype(np.float64) for column in xyz], axis=1)
    keep = usable(points)
    lost = len(points) - int(keep.sum())
    points = points[keep]
    notes = (*notes, *precision_note(points, xyz[0].dtype))
    if lost:
        notes = (*notes, f"{lost} points without coordinates left out")
    lower = {name.lower(): name for name in columns}
    bright = next((columns[lower[name]] for name in _INTENSITY if name in lower), None)
    return PointCloud(
        points,
        viewpoint,
        _normals(columns, keep),
        _colors(columns, keep),
        None if bright is None else bright[keep].astype(np.float64),
        str(path),
        notes,
    )


def precision_note(points: Array, dtype: np.dtype[np.generic]) -> tuple[str, ...]:
    """A note where the file's number type cannot hold its coordinates to 0.1 mm."""
    if dtype != np.dtype(np.float32) or not len(points):
        return ()
    step = float(np.spacing(np.float32(np.abs(points).max())))
    if step <= 2 * COARSE:
        return ()
    return (
        f"coordinates are stored in single precision, in steps of {step:.3g} units so far from the origin",
    )


def _normals(columns: Columns, keep: NDArray[np.bool_]) -> Array | None:
    for names in (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z")):
        if all(name in columns for name in names):
            return np.stack([columns[name][keep].astype(np.float64) for name in names], axis=1)
    return None


def _colors(columns: Columns, keep: NDArray[np.bool_]) -> NDArray[np.uint8] | None:
    names = ("red", "green", "blue")
    if all(name in columns for name in names):
        scale = 1.0 if all(columns[name].dtype.kind in "iu" for name in names) else 255.0
        values = np.stack([columns[name][keep].astype(np.float64) * scale for name in names], axis=1)
        with np.errstate(invalid="ignore"):
            return np.clip(np.nan_to_num(values), 0, 255).astype(np.uint8)
    for name in ("rgb", "rgba"):
        if name in columns:
            raw = columns[name][keep]
            # PCL packs the bytes into the bits of a float
            bits = raw.astype(np.float32).view(np.uint32) if raw.dtype.kind == "f" else raw.astype(np.uint32)
            return np.stack([(bits >> shift) & 255 for shift in (16, 8, 0)], axis=1).astype(np.uint8)
    return None

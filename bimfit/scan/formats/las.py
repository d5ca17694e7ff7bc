"""LAS and LAZ through laspy, a chunk at a time."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from bimfit.errors import ScanError
from bimfit.scan.cloud import PointCloud, usable

_CHUNK = 1_000_000


def read_las(path: Path) -> PointCloud:
    """Read a LAS or LAZ file; its integers and scale give float64 coordinates without loss.

    Raises
    ------
    ScanError
        When it is no such file, is cut short, holds no point, or laspy is not installed.
    """
    try:
        import laspy
    except ImportError as error:
        raise ScanError(
            "reading LAS needs the package laspy", file=path, remedy='pip install "bimfit[las]"'
        ) from error
    points, intensity = [], []
    try:
        with laspy.open(path) as reader:
            count, scales = reader.header.point_count, np.asarray(reader.header.scales, float)
            for chunk in reader.chunk_iterator(_CHUNK):
                points.append(
                    np.stack([np.asarray(getattr(chunk, axis), np.float64) for axis in "xyz"], axis=1)
                )
                intensity.append(np.asarray(chunk.intensity, np.float64))
    except OSError as error:
        raise ScanError(f"cannot be read: {error.strerror or error}", file=path) from error
    except (
        ValueError,
        TypeError,
        RuntimeError,
        OverflowError,
        MemoryError,
        struct.error,
        laspy.LaspyException,
    ) as error:
        raise ScanError(f"not a LAS file, or damaged: {error}", file=path) from error
    found = np.concatenate(points) if points else np.zeros((0, 3))
    if not len(found):
        raise ScanError("the file holds no point", file=path)
    if len(found) < count:
        raise ScanError(f"cut short: {len(found)} of {count} points", file=path)
    keep = usable(found)
    if not keep.any():
        raise ScanError("the file holds no point", file=path)
    step = float(np.max(np.abs(scales)))
    notes = (f"coordinates are stored in steps of {step:g} units",) if step > 5e-4 else ()
    return PointCloud(found[keep], intensity=np.concatenate(intensity)[keep], source=str(path), notes=notes)

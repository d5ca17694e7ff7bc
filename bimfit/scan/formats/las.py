"""LAS and LAZ through laspy, a chunk at a time."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bimfit.errors import ExportError, ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.scan.boxes import Boxes
from bimfit.scan.cloud import PointCloud, usable
from bimfit.scan.formats.las_header import check_header
from bimfit.scan.formats.options import ANY, ReadOptions
from bimfit.scan.formats.packed import COARSE

_CHUNK = 500_000
_BLOCK = 1 << 15
_STEP = 1e-4


def read_las(path: Path, options: ReadOptions = ANY) -> PointCloud:
    """Read a LAS or LAZ file; its integers and scale give float64 coordinates without loss.

    Raises
    ------
    ScanError
        When it is no such file, is cut short, holds no point, or laspy is not installed.
    """
    pieces = list(las_chunks(path, replace(options, boxes=None)))
    return replace(
        pieces[0],
        points=np.concatenate([piece.points for piece in pieces]),
        intensity=np.concatenate([np.zeros(0) if p.intensity is None else p.intensity for p in pieces]),
    )


def las_chunks(path: Path, options: ReadOptions) -> Iterator[PointCloud]:
    """Read a LAS or LAZ file in pieces; points outside the boxes are dropped before they become floats.

    Raises
    ------
    ScanError
        As :func:`read_las` does, at the latest after the last piece.
    """
    try:
        import laspy
    except ImportError as error:
        raise ScanError(
            "reading LAS needs the package laspy", file=path, remedy='pip install "bimfit[las]"'
        ) from error
    wanted = options.file_boxes(1.0)
    boxes = None if wanted is None else Boxes.of(wanted)
    seen = good = 0
    check_header(path)
    with las_errors(path), laspy.open(path) as reader:
        header = reader.header
        scale, offset = np.asarray(header.scales, float), np.asarray(header.offsets, float)
        notes = step_note(scale, options)
        count = int(header.point_count)
        if boxes is not None and not header.are_points_compressed:
            for number, record in _plain_records(path, header, boxes):
                seen += number
                yield las_piece(path, record, scale, offset, None, notes)
            good = seen
        else:
            for chunk in reader.chunk_iterator(_CHUNK):
                seen += len(chunk)
                piece = las_piece(path, chunk, scale, offset, boxes, notes)
                good += len(chunk) if boxes is not None else len(piece)
                yield piece
    if seen and seen < count:
        raise ScanError(f"cut short: {seen} of {count} points", file=path)
    if not good:
        raise ScanError("the file holds no point", file=path)


def _plain_records(path: Path, header: Any, boxes: Boxes) -> Iterator[tuple[int, Any]]:
    """The records of an uncompressed file that lie in boxes, and how many were looked at for each piece.

    They pass through one buffer that fits the processor's cache, which takes a fraction of the time that
    making an array of each chunk does.
    """
    from laspy import ScaleAwarePointRecord

    scale, offset = np.asarray(header.scales, float), np.asarray(header.offsets, float)
    buffer = np.empty(_BLOCK, header.point_format.dtype())
    width = buffer.itemsize
    room: Any = buffer.view(np.uint8)
    left = int(header.point_count)
    with path.open("rb", buffering=0) as stream:
        stream.seek(int(header.offset_to_point_data))
        while left > 0:
            kept, seen = [buffer[:0]], 0
            while seen < _CHUNK and left > 0:
                number = (stream.readinto(room[: min(_BLOCK, left, _CHUNK - seen) * width]) or 0) // width
                raw = buffer[:number]
                kept.append(raw[boxes.find(raw["X"], raw["Y"], raw["Z"], scale, offset)[0]])
                seen += number
                # nothing more where records are still to come: the file is cut short
                left = left - number if number else 0
            yield seen, ScaleAwarePointRecord(np.concatenate(kept), header.point_format, scale, offset)


def step_note(scale: Array, options: ReadOptions) -> tuple[str, ...]:
    """A note where the steps in which coordinates are stored, (3,) in the file's unit, do not hold 0.1 mm."""
    step = float(np.max(np.abs(scale)))
    coarse = 0.5 * step * (options.unit or 1.0) > COARSE * (1.0 + 1e-9)
    return (f"coordinates are stored in steps of {step:g} units",) if coarse else ()


def las_piece(
    path: Path, chunk: Any, scale: Array, offset: Array, boxes: Boxes | None, notes: tuple[str, ...]
) -> PointCloud:
    """Some of the file's points as laspy has them; those outside the boxes never become floats."""
    if boxes is not None:
        raw = chunk.array
        chunk = chunk[boxes.find(raw["X"], raw["Y"], raw["Z"], scale, offset)[0]]
    with np.errstate(over="ignore", invalid="ignore"):  # what a damaged scale makes is left out below
        points = np.stack([np.asarray(getattr(chunk, axis), np.float64) for axis in "xyz"], axis=1)
    intensity = np.asarray(chunk.intensity, np.float64)
    keep = usable(points)
    if not keep.all():
        points, intensity = points[keep], intensity[keep]
    return PointCloud(points, intensity=intensity, source=str(path), notes=notes)


@contextmanager
def las_errors(path: Path) -> Iterator[None]:
    """Turn what laspy raises on damaged files into one clear line."""
    import laspy

    try:
        yield
    except OSError as error:
        raise ScanError(f"cannot be read: {error.strerror or error}", file=path) from error
    except (
        ValueError,
        TypeError,
        RuntimeError,
        OverflowError,
        IndexError,
        MemoryError,
        struct.error,
        laspy.LaspyException,
    ) as error:
        raise ScanError(f"not a LAS file, or damaged: {error}", file=path) from error
    except BaseException as error:
        # how lazrs, written in Rust, says that damage led it astray; it is no Exception
        if type(error).__name__ != "PanicException":
            raise
        raise ScanError(f"not a LAS file, or damaged: {error}", file=path) from error


def write_las(scan: LineScan | PointCloud, path: Path) -> None:
    """Write a cloud as LAS 1.4, or LAZ where the name says so, in steps of 0.1 mm from a whole-metre offset.

    Raises
    ------
    ExportError
        When the cloud is too wide for such steps, or laspy is not installed.
    """
    try:
        import laspy
    except ImportError as error:
        raise ExportError(
            "writing LAS needs the package laspy", file=path, remedy='pip install "bimfit[las]"'
        ) from error
    assert isinstance(scan, PointCloud)
    header = laspy.LasHeader(point_format=6 if scan.colors is None else 7, version="1.4")
    middle = np.round(scan.bounds.mean(axis=0)) if len(scan) else np.zeros(3)
    header.scales, header.offsets = np.full(3, _STEP), middle
    if len(scan) and float(np.abs(scan.points - middle).max()) / _STEP >= 2**31 - 1:
        raise ExportError("too wide for LAS in steps of 0.1 mm", file=path, remedy="use .ply")
    las = laspy.LasData(header)
    las.x, las.y, las.z = scan.points.T
    if scan.intensity is not None:
        # sixteen bits; shares of one are stretched over them
        shares = len(scan) and float(np.nanmax(np.abs(scan.intensity))) <= 1.0
        las.intensity = np.clip(np.nan_to_num(scan.intensity) * (65535.0 if shares else 1.0), 0, 65535)
    if scan.colors is not None:
        las.red, las.green, las.blue = (scan.colors.astype(np.uint16) * 257).T
    las.write(path)

"""Scan files: one registry, a file a format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bimfit.errors import ExportError, ScanError
from bimfit.files import whole_file
from bimfit.geometry.line_scan import LineScan
from bimfit.scan.cloud import PointCloud
from bimfit.scan.formats.delimited import read_csv, write_csv
from bimfit.scan.formats.las import read_las
from bimfit.scan.formats.npz import read_npz, write_npz
from bimfit.scan.formats.pcd import read_pcd, write_pcd
from bimfit.scan.formats.ply import read_ply, write_ply
from bimfit.scan.formats.ptx import read_ptx
from bimfit.scan.formats.text import first_lines
from bimfit.scan.formats.xyz import looks_like_points, read_xyz, write_xyz

Scan = LineScan | PointCloud


@dataclass(frozen=True)
class Format:
    """A kind of scan file.

    Attributes
    ----------
    name : str
    extensions : tuple of str
        Lower case, with the dot.
    read : callable
        Path -> scan, in the file's own unit.
    write : callable or None
        (scan, path) -> None; None where the format is only read.
    magic : tuple of bytes
        What such files start with; empty where that says nothing.
    beams : bool
        Whether a line scan can be written without losing its beams.
    """

    name: str
    extensions: tuple[str, ...]
    read: Callable[[Path], Scan]
    write: Callable[[Scan, Path], None] | None = None
    magic: tuple[bytes, ...] = ()
    beams: bool = False


FORMATS: tuple[Format, ...] = (
    Format("CSV", (".csv",), read_csv, write_csv, beams=True),
    Format("NPZ", (".npz",), read_npz, write_npz, (b"PK\x03\x04",), beams=True),
    Format("PLY", (".ply",), read_ply, write_ply, (b"ply\n", b"ply\r\n")),
    Format("PCD", (".pcd",), read_pcd, write_pcd, (b"# .PCD", b"VERSION 0.7", b"VERSION .7")),
    Format("LAS", (".las", ".laz"), read_las, None, (b"LASF",)),
    Format("PTX", (".ptx",), read_ptx),
    Format("XYZ", (".xyz", ".txt", ".pts", ".asc"), read_xyz, write_xyz),
)


def read_scan(path: str | Path, unit: float = 1.0) -> Scan:
    """Read a line scan or a point cloud, whichever the file holds.

    Parameters
    ----------
    path : str or Path
        The content names the format where it can (PLY, PCD, NPZ), else the extension, else whether it looks
        like rows of numbers.
    unit : float
        Metres a unit of length of the file.

    Raises
    ------
    ScanError
        In one clear line, when the file cannot be read or holds no scan.
    """
    source = Path(path)
    if not (np.isfinite(unit) and unit > 0.0):
        raise ScanError(f"a unit must be a positive number of metres, got {unit}", file=source)
    if source.is_dir():
        raise ScanError("is a folder", file=source, remedy="name a scan file")
    head = first_lines(source)
    scan = _format_of(source, head).read(source)
    return scan if unit == 1.0 else scaled(scan, unit)


def write_scan(scan: Scan, path: str | Path) -> None:
    """Write a scan, whole or not at all, in the format that the extension names.

    Raises
    ------
    ExportError
        When the extension is unknown or cannot hold what the scan holds, or the file cannot be written.
    """
    target = Path(path)
    able = [f for f in FORMATS if f.write is not None and (f.beams or isinstance(scan, PointCloud))]
    for form in able:
        if target.suffix.lower() in form.extensions and form.write is not None:
            with whole_file(target) as part:
                form.write(scan, part)
            return
    kind = "a point cloud" if isinstance(scan, PointCloud) else "a line scan"
    names = ", ".join(extension for form in able for extension in form.extensions)
    raise ExportError(
        f"{kind} cannot be written as {target.suffix or 'a file without extension'}",
        file=target,
        remedy=f"use {names}",
    )


def scaled(scan: Scan, factor: float) -> Scan:
    """The scan with all lengths times ``factor``."""
    if isinstance(scan, PointCloud):
        eye = scan.viewpoint
        return replace(scan, points=scan.points * factor, viewpoint=None if eye is None else eye * factor)
    return replace(scan, origins=scan.origins * factor, ranges=scan.ranges * factor)


def _format_of(path: Path, head: bytes) -> Format:
    # what a file says of itself beats its name
    for form in FORMATS:
        if any(head.startswith(magic) for magic in form.magic):
            return form
    suffix = path.suffix.lower()
    for form in FORMATS:
        if suffix in form.extensions:
            return form
    if looks_like_points(head):
        return next(form for form in FORMATS if form.name == "XYZ")
    known = ", ".join(extension for form in FORMATS for extension in form.extensions)
    raise ScanError(
        f"unknown kind of scan file {suffix or '(no extension)'}", file=path, remedy=f"known are {known}"
    )

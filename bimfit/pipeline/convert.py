"""convert(): a scan from one kind of file to another."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bimfit.errors import ScanError
from bimfit.files import protect_inputs
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.pipeline.scan_file import Scan, load_scan
from bimfit.scan.cloud import PointCloud
from bimfit.scan.formats import FORMATS, write_scan
from bimfit.scan.formats.options import ANY, ReadOptions


@dataclass(frozen=True)
class Converted:
    """What was written.

    Attributes
    ----------
    scan : LineScan or PointCloud
        As written, in metres.
    said : str
        Its kind and size, in a line.
    notes : tuple of str
        What a user should know of how it was read and of what was left out.
    """

    scan: Scan
    said: str
    notes: tuple[str, ...]


def convert(source: Path, target: Path, options: ReadOptions = ANY, pose: Array | None = None) -> Converted:
    """Read a scan and write it in metres, in the format that the target's extension names.

    Beams stay beams where the format holds them (CSV, NPZ); else their returns are written as points, and the
    notes say so.

    Parameters
    ----------
    source, target : Path
        The target is never the source.
    options : ReadOptions
    pose : ndarray, shape (4, 4), optional
        T_world_scanner, to carry it by.

    Raises
    ------
    ScanError
        When the source cannot be read.
    ExportError
        When the target cannot be written, is the source, or its extension names no format.
    """
    protect_inputs([target], [source])
    scan = load_scan(source, options)
    notes = scan.notes
    if pose is not None:
        scan = scan.transformed(pose)
    if isinstance(scan, LineScan) and not _holds_beams(target):
        scan, lost = _points(source, scan)
        notes = (*notes, lost)
    write_scan(scan, target)
    return Converted(scan, _said(scan), notes)


def _holds_beams(path: Path) -> bool:
    return any(form.beams and path.suffix.lower() in form.extensions for form in FORMATS)


def _points(path: Path, scan: LineScan) -> tuple[PointCloud, str]:
    """The returns of a line scan as a cloud, and what is lost by that."""
    back = scan.returned
    if not back.any():
        raise ScanError(
            "the scan holds no return, and the format holds no beams", file=path, remedy="use .csv"
        )
    one = len(np.unique(scan.origins, axis=0)) == 1
    bright = scan.extra.get("intensity")
    cloud = PointCloud(
        scan.hits,
        scan.origins[0].copy() if one else None,
        intensity=None if bright is None else np.asarray(bright, np.float64)[back],
        source=scan.source,
    )
    silent = int(np.count_nonzero(~back))
    parts = [f"{silent:,} beams without return"] if silent else []
    parts += [] if one else ["where each beam came from"]
    parts += ["times"] if "time" in scan.extra else []
    lost = f"beams are written as points; left out: {', '.join(parts) or 'nothing but their order'}"
    return cloud, lost


def _said(scan: Scan) -> str:
    if isinstance(scan, PointCloud):
        return f"{len(scan):,} points"
    return f"{len(scan):,} beams in {len(scan.sweeps):,} sweeps"

"""convert(): a scan from one kind of file to another."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bimfit.errors import ScanError
from bimfit.files import protect_inputs
from bimfit.geometry.line_scan import LineScan
from bimfit.geometry.pose import Array
from bimfit.scan.cloud import PointCloud
from bimfit.scan.formats import FORMATS, read_scan, write_scan
from bimfit.scan.formats.options import ANY, ReadOptions, unit_name

Scan = LineScan | PointCloud


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
    scan = load_any(source, options)
    notes = scan.notes
    if pose is not None:
        scan = scan.transformed(pose)
    if isinstance(scan, LineScan) and not _holds_beams(target):
        scan, lost = _points(source, scan)
        notes = (*notes, lost)
    write_scan(scan, target)
    return Converted(scan, _said(scan), notes)


def load_any(path: Path, options: ReadOptions = ANY) -> Scan:
    """Read a scan file, or a recorded dialogue with a SCIP rangefinder.

    Raises
    ------
    ScanError
        When it is neither, or cannot be read.
    """
    known = {extension for form in FORMATS for extension in form.extensions}
    if path.is_file() and path.suffix.lower() not in known:
        scan = _dialogue(path)
        if scan is not None:
            return scan
    return read_scan(path, options=options)


def _dialogue(path: Path) -> LineScan | None:
    """The sweeps of a SCIP dialogue; None where the file is none."""
    from bimfit.sensor.dialogue import read_dialogue
    from bimfit.sensor.sweep import line_scan

    try:
        sweeps = read_dialogue(path)
    except ScanError:
        return None
    scan = line_scan(sweeps, source=str(path))
    said = f"SCIP dialogue: {len(scan):,} beams in {len(sweeps):,} sweeps, stored in {unit_name(1e-3)}"
    return replace(scan, notes=(*scan.notes, said))


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

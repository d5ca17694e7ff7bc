"""Scan files, and among them recorded dialogues with a SCIP rangefinder, which rooms below do not know."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

from bimfit.errors import ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.scan.cloud import PointCloud
from bimfit.scan.formats import FORMATS, read_scan, scan_chunks
from bimfit.scan.formats.options import ANY, ReadOptions, unit_name

Scan = LineScan | PointCloud
_HEAD = 1 << 18


def load_scan(path: Path, options: ReadOptions = ANY) -> Scan:
    """Read a scan file or a recorded SCIP dialogue.

    Raises
    ------
    ScanError
        When it is neither, or cannot be read.
    """
    found = dialogue_scan(path)
    return read_scan(path, options=options) if found is None else found


def load_pieces(path: Path, options: ReadOptions = ANY) -> Iterator[Scan]:
    """The same in pieces, for files that do not fit into memory.

    Raises
    ------
    ScanError
        While the pieces are drawn.
    """
    found = dialogue_scan(path)
    return scan_chunks(path, options) if found is None else iter((found,))


def dialogue_scan(path: Path) -> LineScan | None:
    """The sweeps of a recorded SCIP dialogue, in the sensor's coordinates; None where the file is none.

    Where nobody noted when the bytes came, the device's own clock serves for the beams' times.
    """
    if not _is_dialogue(path):
        return None
    from bimfit.sensor.dialogue import read_dialogue
    from bimfit.sensor.sweep import line_scan

    try:
        found = read_dialogue(path)
    except ScanError:
        return None
    sweeps = [
        dataclasses.replace(sweep, stamp_host=sweep.stamp_device) if math.isnan(sweep.stamp_host) else sweep
        for sweep in found
    ]
    scan = line_scan(sweeps, source=str(path))
    said = f"SCIP dialogue: {len(scan):,} beams in {len(sweeps):,} sweeps, stored in {unit_name(1e-3)}"
    return dataclasses.replace(scan, notes=(*scan.notes, said))


def _is_dialogue(path: Path) -> bool:
    from bimfit.sensor.dialogue import looks_like_dialogue

    known = {extension for form in FORMATS for extension in form.extensions}
    if known & {suffix.lower() for suffix in path.suffixes[-2:]}:
        return False
    try:
        with path.open("rb") as stream:
            head = stream.read(_HEAD)
    except OSError:
        return False  # whoever reads it says why
    return looks_like_dialogue(head)

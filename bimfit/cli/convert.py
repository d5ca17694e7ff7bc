"""``bimfit convert``: a scan from one kind of file to another."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bimfit.cli.options import read_pose
from bimfit.cli.reading import reading

if TYPE_CHECKING:
    from bimfit.scan.formats.options import ReadOptions


@reading
def run(
    how: ReadOptions,
    scan: Path = typer.Argument(..., metavar="IN", help="A scan in any of the known formats."),
    output: Path = typer.Argument(
        ..., metavar="OUT", help="Beams: csv or npz; points: also ply, pcd, las, laz, xyz."
    ),
    scan_pose: str | None = typer.Option(
        None,
        "--scan-pose",
        metavar="POSE|FILE",
        help="Carry it by this pose: x,y,z,rx,ry,rz (m, rad) or a file of 16 numbers.",
    ),
) -> int:
    """Write a scan as another kind of file, in metres, and say what it holds."""
    from bimfit.pipeline.convert import convert

    made = convert(scan, output, how, None if scan_pose is None else read_pose(scan_pose))
    for note in made.notes:
        print(f"bimfit: note: {note}", file=sys.stderr)
    print(f"{output}: {made.said}")
    return 0

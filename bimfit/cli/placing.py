"""Where a scan lies: the options that ``fit`` and ``compare`` share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from bimfit.cli.options import angle, length, read_pose
from bimfit.cli.reading import READING, read_options
from bimfit.cli.sharing import shared_options
from bimfit.errors import ConfigError

if TYPE_CHECKING:
    from bimfit.pipeline.placing import Placing
    from bimfit.registration.alignment import AlignConfig

_OPTIONS: dict[str, tuple[Any, Any]] = {
    "scan_pose": (
        str | None,
        typer.Option(
            None,
            "--scan-pose",
            metavar="POSE|FILE",
            help="Scanner pose in the model (with --trajectory: on the moving body): x,y,z,rx,ry,rz (m, rad) "
            "or a file of 16 numbers.",
        ),
    ),
    "trajectory": (
        Path | None,
        typer.Option(
            None,
            "--trajectory",
            metavar="FILE",
            help="Poses of a moving sensor, TUM format: time x y z qx qy qz qw; beams have a column time.",
        ),
    ),
    "scan_crs": (
        str,
        typer.Option(
            "auto", "--scan-crs", metavar="CRS", help="Coordinates of the scan: project, map, or auto."
        ),
    ),
    **READING,
    "align": (
        bool,
        typer.Option(
            False, "--align", help="Move the scan to where it fits the joint's surroundings best, proven."
        ),
    ),
    "align_window": (
        str | None,
        typer.Option(
            None,
            "--align-window",
            metavar="SHIFT,ANGLE",
            help="How far it may be off, such as 50mm,3deg; means --align.",
        ),
    ),
}


def placing(command: Callable[..., int]) -> Callable[..., int]:
    """Give a command the options that place a scan, as one argument ``where`` (a Placing)."""
    return shared_options(command, "where", _OPTIONS, _placing, "Where the scan lies")


def _placing(
    *,
    scan_pose: str | None,
    trajectory: Path | None,
    scan_crs: str,
    align: bool,
    align_window: str | None,
    **how: Any,
) -> Placing:
    from bimfit.pipeline.placing import CRS, Placing
    from bimfit.scan.trajectory import read_tum

    if scan_crs not in CRS:
        raise ConfigError(f"--scan-crs {scan_crs}: is none of {', '.join(CRS)}")
    return Placing(
        pose=None if scan_pose is None else read_pose(scan_pose),
        trajectory=None if trajectory is None else read_tum(trajectory),
        crs=scan_crs,
        options=read_options(**how),
        align=_align(align, align_window),
    )


def _align(align: bool, window: str | None) -> AlignConfig | None:
    from bimfit.registration.alignment import AlignConfig

    if window is None:
        return AlignConfig() if align else None
    shift, _, turn = window.partition(",")
    if not turn:
        raise ConfigError(f"--align-window {window}: wants two values", remedy="such as 50mm,3deg")
    return AlignConfig(length(shift, "--align-window"), angle(turn, "--align-window"))

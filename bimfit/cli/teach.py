"""``bimfit teach``: a profile from slices of a scan."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bimfit.cli.choosing import choosing
from bimfit.cli.options import build_config
from bimfit.cli.placing import placing
from bimfit.cli.progress import terminal_progress

if TYPE_CHECKING:
    from bimfit.bim.selection import Selection
    from bimfit.pipeline.placing import Placing


@choosing
@placing
def run(
    choice: Selection,
    where: Placing,
    scan: Path = typer.Argument(..., metavar="SCAN", help="Line scan of the joint."),
    model: Path = typer.Option(
        ..., "--model", metavar="MODEL.ifc", help="The model: where the joint runs, and a first guess."
    ),
    output: Path = typer.Option(..., "-o", "--output", metavar="PROFILE", help="Profile to write (json)."),
    slices: int | None = typer.Option(
        None, "--slices", min=3, metavar="N", help="Learn from so many stations, evenly spread; default: all."
    ),
    spacing: str | None = typer.Option(None, "--spacing", help="Distance between stations, such as 10mm."),
    sigma: str | None = typer.Option(None, "--sigma", help="The sensor's range noise, such as 3mm."),
    config: Path | None = typer.Option(None, "--config", metavar="FILE.toml", help="Settings."),
) -> int:
    """Teach the cross-section of a joint from a scan, for bimfit fit --profile to use in place of BIM's."""
    from bimfit.files import protect_inputs
    from bimfit.pipeline.profile_file import write_profile
    from bimfit.pipeline.teach import teach

    settings = build_config(config, spacing=spacing, sigma=sigma)
    protect_inputs([output], [path for path in (model, scan, config) if path is not None])
    with terminal_progress() as progress:
        profile = teach(model, scan, settings, joints=choice, placing=where, slices=slices, progress=progress)
    write_profile(profile, output)
    print(f"taught joint {profile.taught['joint']} from {profile.taught['slices']} slices: {output}")
    return 0

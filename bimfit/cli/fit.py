"""``bimfit fit``: the main job."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bimfit.cli.choosing import choosing
from bimfit.cli.help import METHOD, SLICES, WRITTEN
from bimfit.cli.limits import HELP as LIMITS_HELP
from bimfit.cli.limits import read_limits
from bimfit.cli.options import MISSING_HELP, build_config
from bimfit.cli.placing import placing
from bimfit.cli.progress import terminal_progress
from bimfit.errors import ConfigError

if TYPE_CHECKING:
    from bimfit.bim.selection import Selection
    from bimfit.pipeline.placing import Placing
    from bimfit.pipeline.records import SurveyResult


@choosing
@placing
def run(
    choice: Selection,
    where: Placing,
    model: Path = typer.Argument(..., metavar="MODEL.ifc", help="The building model."),
    scan: Path = typer.Argument(
        ...,
        metavar="SCAN",
        help="Line scan (csv, npz, bag, log, ...) or points (e57, las, ply, pcd, xyz, ...).",
    ),
    output: Path = typer.Option(..., "-o", "--output", metavar="DIR", help="Where the results go."),
    method: str = typer.Option(
        "grcsm",
        "--method",
        rich_help_panel=METHOD,
        metavar="M",
        help="The matcher: grcsm, block, mrcsm, icp-point, ...",
    ),
    motion: str = typer.Option(
        "auto",
        "--motion",
        rich_help_panel=METHOD,
        help="Motion along the joint: auto, independent, const, rigid, linear, smooth, kinked.",
    ),
    paper: bool = typer.Option(
        False,
        "--paper",
        rich_help_panel=METHOD,
        help="The method as printed: whole outlines, block tables, grid answers, no smoothing.",
    ),
    window: str | None = typer.Option(
        None,
        "--window",
        rich_help_panel=METHOD,
        metavar="U,V,THETA",
        help="Half widths, such as 121.5mm,121.5mm,45deg.",
    ),
    tolerance: str | None = typer.Option(
        None, "--tolerance", rich_help_panel=METHOD, metavar="U,V,THETA", help="Such as 1mm,1mm,0.6deg."
    ),
    spacing: str | None = typer.Option(
        None, "--spacing", rich_help_panel=SLICES, help="Distance between stations, such as 10mm."
    ),
    thickness: str | None = typer.Option(
        None, "--thickness", rich_help_panel=SLICES, help="Thickness of a cloud's slices, such as 10mm."
    ),
    sigma: str | None = typer.Option(
        None, "--sigma", rich_help_panel=SLICES, help="The sensor's range noise, such as 3mm."
    ),
    missing: str | None = typer.Option(
        None, "--missing", rich_help_panel=SLICES, metavar="gap|unknown", help=MISSING_HELP
    ),
    shape: str | None = typer.Option(
        None,
        "--shape",
        rich_help_panel=METHOD,
        metavar="FREEDOMS",
        help="Free the components' shapes, with priors: bevel-angle=2deg,face-angle=1deg,thickness=1mm.",
    ),
    profile: Path | None = typer.Option(
        None,
        "--profile",
        rich_help_panel=METHOD,
        metavar="FILE",
        help="A profile that bimfit teach wrote, in place of the design.",
    ),
    config: Path | None = typer.Option(
        None, "--config", rich_help_panel=METHOD, metavar="FILE.toml", help="Settings."
    ),
    pictures: bool = typer.Option(True, help="Draw pictures.", rich_help_panel=WRITTEN),
    report: bool = typer.Option(True, help="Write report.html.", rich_help_panel=WRITTEN),
    as_built: bool = typer.Option(
        True, help="Write the model with the gaps as as-built.ifc.", rich_help_panel=WRITTEN
    ),
    move_elements: bool = typer.Option(
        False,
        "--move-elements",
        rich_help_panel=WRITTEN,
        help="In as-built.ifc, put components where they are.",
    ),
    limits: str | None = typer.Option(
        None, "--limits", rich_help_panel=WRITTEN, metavar="LIMITS", help=LIMITS_HELP
    ),
    bcf: Path | None = typer.Option(
        None,
        "--bcf",
        rich_help_panel=WRITTEN,
        metavar="FILE",
        help="Write joints that break the limits or were not measured there.",
    ),
    bcf_version: str = typer.Option(
        "2.1", "--bcf-version", rich_help_panel=WRITTEN, metavar="V", help="2.1 or 3.0."
    ),
) -> int:
    """Fit the joints of a model to a scan and write the as-built gap."""
    from bimfit.pipeline.deliver import Deliverables, check_deliverables, deliver
    from bimfit.pipeline.limits import Limits
    from bimfit.pipeline.output import check_folder
    from bimfit.pipeline.profile_file import read_profile
    from bimfit.pipeline.survey import survey

    matcher = _method(method, paper=paper)
    settings = build_config(
        config,
        window=window,
        tolerance=tolerance,
        spacing=spacing,
        thickness=thickness,
        sigma=sigma,
        missing=missing,
        shape=shape,
    )
    wanted = Deliverables(
        pictures=pictures,
        report=report,
        as_built=as_built,
        move_elements=move_elements,
        limits=Limits() if limits is None else read_limits(limits),
        bcf=bcf,
        bcf_version=bcf_version,  # type: ignore[arg-type]  # checked below
    )
    check_folder(output)
    inputs = [model, scan, *(path for path in (config, choice.pairs, profile) if path is not None)]
    check_deliverables(wanted, output, inputs)
    with terminal_progress() as progress:
        result = survey(
            model,
            scan,
            settings,
            joints=choice,
            method=matcher,
            motion=motion,
            placing=where,
            profile=None if profile is None else read_profile(profile),
            progress=progress,
        )
        _, said = deliver(result, output, wanted, progress)
    return _tell(result, output, said)


def _method(name: str, *, paper: bool) -> str:
    if paper and name not in ("grcsm", "paper"):
        raise ConfigError(f"--paper and --method {name} are two methods", remedy="give one of them")
    return "paper" if paper else name


def _tell(result: SurveyResult, output: Path, said: Sequence[str]) -> int:
    """Print what came out, notes and failures on standard error; the exit status."""
    from bimfit.pipeline.aligning import describe_alignment
    from bimfit.pipeline.output import describe

    if result.placed is not None and result.placed.alignment is not None:
        print(describe_alignment(result.placed.alignment))
    for one in result.joints:
        print(describe(one))
    print(f"results in {output}")
    for note in (*said, *result.notes):
        print(f"bimfit: note: {note}", file=sys.stderr)
    for one in result.failed:
        print(f"bimfit: joint {one.joint.id} could not be estimated: {one.reason}", file=sys.stderr)
    return 1 if result.failed else 0

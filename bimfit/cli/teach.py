"""``bimfit teach``: a profile from slices of a scan."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bimfit.cli.choosing import choosing
from bimfit.cli.options import build_config, length
from bimfit.cli.placing import placing
from bimfit.cli.progress import terminal_progress
from bimfit.errors import ConfigError

if TYPE_CHECKING:
    from bimfit.bim.selection import Selection
    from bimfit.pipeline.placing import Placing
    from bimfit.pipeline.teach_line import JointLine


@choosing
@placing
def run(
    choice: Selection,
    where: Placing,
    scan: Path = typer.Argument(..., metavar="SCAN", help="Line scan or points of the joint."),
    model: Path | None = typer.Option(
        None, "--model", metavar="MODEL.ifc", help="The model: where the joint runs, and a first guess."
    ),
    line: str | None = typer.Option(
        None,
        "--line",
        metavar="X,Y,Z,X,Y,Z",
        help="Without a model: a line along the gap, about at its mouth.",
    ),
    out: str | None = typer.Option(
        None, "--out", metavar="X,Y,Z", help="With --line: out of the mouth; default: towards the sensor."
    ),
    depth: str | None = typer.Option(
        None, "--depth", help="With --line: how deep the gap is where no beam sees it; default: 20mm."
    ),
    output: Path = typer.Option(..., "-o", "--output", metavar="PROFILE", help="Profile to write (json)."),
    slices: int | None = typer.Option(
        None, "--slices", min=3, metavar="N", help="Learn from so many stations, evenly spread; default: all."
    ),
    spacing: str | None = typer.Option(None, "--spacing", help="Distance between stations, such as 10mm."),
    thickness: str | None = typer.Option(
        None, "--thickness", help="Thickness of a cloud's slices, such as 10mm."
    ),
    sigma: str | None = typer.Option(None, "--sigma", help="The sensor's range noise, such as 3mm."),
    config: Path | None = typer.Option(None, "--config", metavar="FILE.toml", help="Settings."),
) -> int:
    """Teach the cross-section of a joint from a scan, for bimfit fit --profile to use in place of BIM's."""
    from bimfit.files import protect_inputs
    from bimfit.pipeline.profile_file import write_profile
    from bimfit.pipeline.teach import teach
    from bimfit.pipeline.teach_line import teach_line

    where_to = _joint_line(line, out, depth)
    if (model is None) == (where_to is None):
        raise ConfigError("give a --model or a --line", remedy="one says where the joint runs, not both")
    settings = build_config(config, spacing=spacing, thickness=thickness, sigma=sigma)
    protect_inputs([output], [path for path in (model, scan, config) if path is not None])
    with terminal_progress() as progress:
        if model is not None:
            profile = teach(
                model, scan, settings, joints=choice, placing=where, slices=slices, progress=progress
            )
        else:
            assert where_to is not None
            profile = teach_line(scan, where_to, settings, placing=where, slices=slices, progress=progress)
    write_profile(profile, output)
    print(f"taught joint {profile.taught['joint']} from {profile.taught['slices']} slices: {output}")
    if "disagreement" in profile.taught:
        print(profile.taught["disagreement"])
    return 0


def _joint_line(line: str | None, out: str | None, depth: str | None) -> JointLine | None:
    """The line that the options give, None where they give none."""
    from bimfit.pipeline.teach_line import JointLine

    if line is None:
        if out is not None or depth is not None:
            raise ConfigError("--out and --depth go with --line", remedy="give --line X,Y,Z,X,Y,Z")
        return None
    x = _numbers(line, "--line", 6)
    deep = None if depth is None else length(depth, "--depth")
    if deep is not None and deep <= 0.0:
        raise ConfigError(f"--depth {depth}: a depth is more than 0", remedy="write it as 20mm")
    way = None if out is None else _numbers(out, "--out", 3)
    return JointLine(
        (x[0], x[1], x[2]), (x[3], x[4], x[5]), None if way is None else (way[0], way[1], way[2]), deep
    )


def _numbers(text: str, option: str, count: int) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(math.isfinite(value) for value in values):
        raise ConfigError(
            f"{option} {text}: wants {count} numbers in metres", remedy="write 0,0,0.05,0.8,0,0.05"
        )
    return values

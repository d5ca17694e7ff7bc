"""``bimfit report``: the HTML report again, and what else follows from a results folder."""

from __future__ import annotations

import sys
from pathlib import Path

import typer

from bimfit.cli.limits import HELP as LIMITS_HELP
from bimfit.cli.limits import read_limits
from bimfit.cli.progress import terminal_progress


def run(
    folder: Path = typer.Argument(..., metavar="DIR", help="A folder that bimfit fit has written."),
    limits: str | None = typer.Option(
        None, "--limits", metavar="LIMITS", help=f"{LIMITS_HELP} Default: those of the fit."
    ),
    bcf: Path | None = typer.Option(
        None, "--bcf", metavar="FILE", help="Write joints that break the limits or were not measured there."
    ),
    bcf_version: str = typer.Option("2.1", "--bcf-version", metavar="V", help="2.1 or 3.0."),
) -> int:
    """Write report.html and the joint schedule of a results folder again, perhaps against other limits."""
    from bimfit.pipeline.deliver import report_again

    chosen = None if limits is None else read_limits(limits)
    with terminal_progress() as progress:
        files, notes = report_again(folder, chosen, bcf, bcf_version, progress)
    for path in files:
        print(path)
    for note in notes:
        print(f"bimfit: note: {note}", file=sys.stderr)
    return 0

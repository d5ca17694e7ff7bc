"""``bimfit view``: look at results in 3D."""

from __future__ import annotations

from pathlib import Path

import typer


def run(
    folder: Path = typer.Argument(..., metavar="DIR", help="A folder that bimfit fit has written."),
    picture: Path | None = typer.Option(
        None, "--picture", metavar="FILE.png", help="Draw it there instead of a window."
    ),
) -> int:
    """Show a results folder in an interactive 3D window."""
    from bimfit.pipeline.pictures import view_folder

    view_folder(folder, picture)
    return 0
